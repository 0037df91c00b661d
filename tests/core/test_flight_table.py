"""Flight table: what is read, what is refused with which sentence, and that gaps stay gaps."""

import os
from itertools import pairwise

import numpy as np
import pytest

from falconwing_kit.core import flight_table
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import (
    FlightTable,
    fill_missing_rows,
    interpolate_readings,
    nominal_rate_hz,
    read_flight_table,
    resample,
    slice_time,
    split_by_time,
    write_flight_table,
)

HEADER = "t,px,py,pz,roll,pitch,yaw,throttle,aileron,elevator,rudder"
ROWS = [
    f"{k * 0.05:.2f},{0.35 * k:.2f},1.0,2.0,0.1,0.05,0.2,0.5,0.01,-0.02,0.03" for k in range(20)
]


@pytest.fixture
def csv(tmp_path):
    """A file with the given content."""

    def write(content: str | bytes | list[str], header: str = HEADER):
        path = tmp_path / "flight.csv"
        if isinstance(content, list):
            content = "\n".join([header, *content]) + "\n"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


def table_of(t, **columns) -> FlightTable:
    """A flight straight ahead at 7 m/s with the given times."""
    t = np.asarray(t, dtype=float)
    values = {
        "p_world": np.column_stack([7.0 * t, 0 * t, 2.0 + 0 * t]),
        "attitude": np.zeros((len(t), 3)),
        "commands": np.column_stack([0.5 + 0 * t, np.sin(t), np.cos(t), 0 * t]),
    }
    return FlightTable("made/here.csv", t, **{**values, **columns})


def edited(row: int, column: str, cell: str, rows: list[str] = ROWS) -> list[str]:
    """The rows with one cell changed."""
    cells = rows[row].split(",")
    cells[HEADER.split(",").index(column)] = cell
    return [*rows[:row], ",".join(cells), *rows[row + 1 :]]


# Reading what is good.


def test_numbers_arrive_in_their_columns(csv):
    """The second row, typed above."""
    table = read_flight_table(csv(ROWS))
    assert table.t[1] == 0.05
    assert table.p_world[1].tolist() == [0.35, 1.0, 2.0]
    assert table.attitude[1].tolist() == [0.1, 0.05, 0.2]
    assert table.commands[1].tolist() == [0.5, 0.01, -0.02, 0.03]
    assert table.warnings == () and table.has_pose.all()
    assert table.duration == pytest.approx(0.95, abs=1e-12)
    assert table.name.endswith("/flight.csv") and not table.name.startswith("/")


def test_order_of_columns_does_not_matter(csv):
    """The header names the columns, not their place."""
    backwards = [",".join(reversed(row.split(","))) for row in ROWS]
    header = ",".join(reversed(HEADER.split(",")))
    assert np.array_equal(
        read_flight_table(csv(backwards, header)).p_world, read_flight_table(csv(ROWS)).p_world
    )


def test_windows_file_reads_the_same(csv):
    """A byte order mark and CRLF line ends, as spreadsheets write them."""
    plain = read_flight_table(csv(ROWS))
    windows = read_flight_table(csv(b"\xef\xbb\xbf" + "\r\n".join([HEADER, *ROWS, ""]).encode()))
    assert np.array_equal(plain.commands, windows.commands) and windows.warnings == ()


def test_frames_without_pose_are_kept(csv):
    """nan and empty cells mean the same; one frame of twenty is 5 %."""
    for cell in ("nan", "", "NaN"):
        rows = ROWS
        for column in ("px", "py", "pz", "roll", "pitch", "yaw"):
            rows = edited(3, column, cell, rows)
        table = read_flight_table(csv(rows))
        assert len(table.t) == 20 and table.has_pose.sum() == 19
        assert np.isnan(table.p_world[3]).all() and table.warnings == ()


def test_half_a_pose_counts_as_none(csv):
    """A frame with a position and no attitude is not a pose; the warning counts it."""
    table = read_flight_table(csv(edited(3, "roll", "nan")))
    assert np.isnan(table.p_world[3]).all() and not table.has_pose[3]
    assert "incomplete pose, read as rows without a pose: 1" in table.warnings[0]


def test_optional_and_unknown_columns_are_kept(csv):
    """Numbers as arrays, words as words; only what is unknown is named."""
    header = HEADER + ",vx,source,battery,pilot"
    rows = [
        f"{row},{k},{'marker' if k % 2 else 'hybrid'},{7.4 - k},anna" for k, row in enumerate(ROWS)
    ]
    table = read_flight_table(csv(rows, header))
    assert table.extra["vx"].tolist() == list(range(20))
    assert table.extra["battery"][0] == 7.4
    assert table.labels["source"][:2] == ("hybrid", "marker") and table.labels["pilot"][5] == "anna"
    assert (
        len(table.warnings) == 1
        and "battery, pilot" in table.warnings[0]
        and "vx" not in table.warnings[0]
    )


def test_cut_last_line_is_dropped_with_a_warning(csv):
    """The file ends in the middle of a row, at each of its last 30 bytes.

    Only a cut inside the last number leaves a row that looks complete, which cannot be
    distinguished from a file without a final line end.
    """
    whole = "\n".join([HEADER, *ROWS]) + "\n"
    for cut in range(2, 32):
        table = read_flight_table(csv(whole[:-cut]))
        last_cell = whole[:-cut].rsplit(",", 1)[1]
        looks_whole = cut < len(",0.03\n") and last_cell not in ("", "-")
        assert len(table.t) == (20 if looks_whole else 19), cut
        assert ("cut off" in " ".join(table.warnings)) == (not looks_whole)


def test_a_file_may_end_without_a_line_end(csv):
    """Many editors write it so; nothing is lost."""
    assert len(read_flight_table(csv("\n".join([HEADER, *ROWS]))).t) == 20


# Refusing, each with its sentence.


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "empty file"),
        (b"\n" + ROWS[0].encode(), "empty line"),
        (HEADER + "\n", "at least one row"),
        (HEADER + "\n\n\n", "at least one row"),
        (HEADER.replace(",", ";") + "\n", "expected commas between columns, got semicolons"),
        (HEADER.replace(",", "\t") + "\n", "expected commas between columns, got tabs"),
        (HEADER.replace(",rudder", "") + "\n", "missing column rudder; the header has t, px"),
        (HEADER + ",px\n", "px more than once"),
        (
            "\n".join([HEADER, *ROWS[:5], "0.3,1,2"]) + "\n",
            "line 7: expected 11 cells as in the header, got 3",
        ),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "UTF-8|binary"),
        (bytes(1000), "binary data"),
        (HEADER.encode() + b"\n" + b"\xff" * 20 + b"\n", "line 2 is not UTF-8"),
        (b"1," * 50_000, "endless line"),
        (HEADER.encode() + b"\n" + b"1" * 100_000, "endless line"),
    ],
)
def test_a_file_that_is_no_flight_table_is_refused(csv, content, sentence):
    """One sentence that says what was wanted, what came and where."""
    with pytest.raises(InputError, match=sentence) as error:
        read_flight_table(csv(content))
    assert "flight.csv" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("row", "column", "cell", "sentence"),
    [
        (4, "px", "far", "line 6, column px: expected a number or nan, got 'far'"),
        (4, "px", "1.0.0", "line 6, column px"),
        (4, "px", "inf", "line 6, column px: expected a finite number or nan, got infinity"),
        (4, "pitch", "1e999", "line 6, column pitch: expected a finite number"),
        (0, "aileron", "nan", "line 2, column aileron: expected a command in the first row"),
        (
            4,
            "throttle",
            "1500",
            "line 6: expected throttle in 0..1, got 1500: looks like microseconds",
        ),
        (4, "throttle", "-1", "expected throttle in 0..1, got -1: looks like"),
        (4, "elevator", "50", "expected elevator in -1..1, got 50"),
    ],
)
def test_a_wrong_cell_is_refused_with_its_line(csv, row, column, cell, sentence):
    """Line numbers count as an editor does, the header being line 1."""
    with pytest.raises(InputError, match=sentence):
        read_flight_table(csv(edited(row, column, cell)))


@pytest.mark.parametrize(
    ("unit", "size"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)]
)
def test_another_unit_of_time_is_recognised(csv, unit, size):
    """Rows of cameras of 5 to 60 Hz, counted from a large start as clocks do. Rows 3 s apart may be
    slow telemetry.
    """
    for rate_hz in (5, 20, 60):
        with pytest.raises(
            InputError,
            match=f"flight.csv: time looks like {unit}: expected seconds, .* divide the column",
        ):
            read_flight_table(
                csv([f"{1e9 + size / rate_hz * k!r}{row[4:]}" for k, row in enumerate(ROWS)])
            )
    slow = [f"{3.0 * k!r}{row[4:]}" for k, row in enumerate(ROWS)]
    assert nominal_rate_hz(read_flight_table(csv(slow))) == pytest.approx(1.0 / 3.0)


def test_missing_file_is_said(tmp_path):
    """The path is in the sentence."""
    with pytest.raises(FileNotFoundError, match=r"absent\.csv"):
        read_flight_table(tmp_path / "absent.csv")


def test_a_huge_file_is_refused_before_reading(csv, monkeypatch):
    """The limit is lowered for the test; the size is known before a byte is read."""
    path = csv(ROWS)
    monkeypatch.setattr(flight_table, "MAX_FILE_BYTES", 100)
    with pytest.raises(InputError, match="at most"):
        read_flight_table(path)


# Mending, each with its warning.


def test_missing_command_is_held_from_the_row_before(csv):
    """Zero-order hold: the transmitter keeps sending the last one."""
    rows = edited(5, "aileron", "nan", edited(4, "aileron", "nan", edited(3, "aileron", "0.7")))
    table = read_flight_table(csv(rows))
    assert table.commands[3:7, 1].tolist() == [0.7, 0.7, 0.7, 0.01]
    assert "rows without aileron, held from the row before: 2" in table.warnings[0]


def test_slightly_large_throttle_is_cut_and_said(csv):
    """1.02 is rounding of a full stick, not another unit."""
    table = read_flight_table(csv(edited(5, "throttle", "1.02")))
    assert table.commands[5, 0] == 1.0 and "throttle slightly outside" in table.warnings[0]


def test_single_bad_time_stamps_are_dropped(csv):
    """A repeated stamp and a step back: two rows of twenty go, and the rest increases."""
    table = read_flight_table(csv(edited(9, "t", "0.10", edited(5, "t", "0.20"))))
    assert len(table.t) == 18 and (np.diff(table.t) > 0).all()
    assert "time did not increase: 2" in table.warnings[0]


def test_a_row_without_time_is_dropped(csv):
    """nan is no time."""
    table = read_flight_table(csv(edited(5, "t", "nan")))
    assert len(table.t) == 19 and "time did not increase: 1" in table.warnings[0]


def test_time_running_backwards_is_refused(csv):
    """A file in reverse order is refused; dropping nearly all rows is no correction."""
    with pytest.raises(InputError, match=r"time must increase.*line 3"):
        read_flight_table(csv(ROWS[::-1]))


def test_a_flight_without_poses_is_read_with_a_warning(csv):
    """Commands alone may be what somebody has."""
    rows = [",".join([row.split(",")[0], *["nan"] * 6, *row.split(",")[7:]]) for row in ROWS]
    table = read_flight_table(csv(rows))
    assert not table.has_pose.any() and "no row has a pose" in table.warnings[0]


def test_degrees_are_refused(csv):
    """A roll of 25 would be four turns; yaw alone shows degrees only if it starts far from zero."""
    for angles in (",25.0,5.0,0.2,", ",2.0,1.0,170.0,"):
        with pytest.raises(InputError, match="looks like degrees"):
            read_flight_table(csv([row.replace(",0.1,0.05,0.2,", angles) for row in ROWS]))


def test_unwrapped_yaw_is_read_with_a_warning(csv):
    """Ten turns in radians and a straight flight in degrees are both possible: the user decides."""
    rows = [row.replace(",0.1,0.05,0.2,", f",0.5,0.05,{3.0 * k},") for k, row in enumerate(ROWS)]
    table = read_flight_table(csv(rows))
    assert table.attitude[-1, 2] == 57.0 and "unwrapped" in table.warnings[0]


def test_single_outliers_are_not_a_unit(csv):
    """One roll of 9 in 20 rows (5 %) is a marker misread, which the format allows."""
    assert read_flight_table(csv(edited(5, "roll", "9.0"))).warnings == ()


def test_infinite_optional_number_becomes_nan(csv):
    """Programs write sigma = inf where they know nothing."""
    rows = [f"{row},{'inf' if k == 2 else 0.03}" for k, row in enumerate(ROWS)]
    table = read_flight_table(csv(rows, HEADER + ",sigma_position"))
    assert np.isnan(table.extra["sigma_position"][2]) and "sigma_position" in table.warnings[0]


# Writing.


def test_what_is_written_is_read_back_to_the_last_bit(tmp_path):
    """Inverse, with gaps, extra columns and words; the header has the order of the design."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.04, 0.06, 50))
    p_world, attitude = rng.normal(size=(50, 3)), rng.uniform(-1, 1, (50, 3))
    p_world[7], attitude[7] = np.nan, np.nan
    extra = {"battery": rng.normal(size=50), "q": rng.normal(size=50), "vx": rng.normal(size=50)}
    labels = {"source": ("marker", "hybrid") * 25}
    table = FlightTable("a/b.csv", t, p_world, attitude, rng.uniform(0, 1, (50, 4)), extra, labels)
    write_flight_table(tmp_path / "b.csv", table)
    back = read_flight_table(tmp_path / "b.csv")
    for name in ("t", "p_world", "attitude", "commands"):
        assert np.array_equal(getattr(back, name), getattr(table, name), equal_nan=True)
    assert (
        all(np.array_equal(back.extra[name], extra[name]) for name in extra)
        and back.labels == labels
    )
    assert (tmp_path / "b.csv").read_text().split("\n")[0] == HEADER + ",vx,q,battery,source"
    assert os.listdir(tmp_path) == ["b.csv"]


def test_columns_must_belong_together():
    """A table made in Python is checked as well."""
    t = np.arange(3.0)
    with pytest.raises(InputError, match="p_world: expected shape"):
        table_of(t, p_world=np.zeros((2, 3)))
    with pytest.raises(InputError, match="time that increases"):
        table_of([0.0, 1.0, 1.0])
    with pytest.raises(InputError, match="finite commands"):
        table_of(t, commands=np.full((3, 4), np.nan))
    with pytest.raises(InputError, match="source: expected 3 words"):
        table_of(t, labels={"source": ("a",)})


# Time.


def test_lost_frames_do_not_lower_the_rate():
    """20 Hz with a third of the frames lost: most neighbours are still 50 ms apart."""
    t = np.arange(300) * 0.05
    assert nominal_rate_hz(table_of(t[np.arange(300) % 6 != 0])) == pytest.approx(20.0, rel=1e-9)


def test_slice_takes_its_start_and_leaves_its_end():
    """Neighbouring slices share no row."""
    table = table_of(np.arange(10) * 0.5)
    assert slice_time(table, 1.0, 2.0).t.tolist() == [1.0, 1.5]
    with pytest.raises(InputError, match="expected rows from 9 to 10 s"):
        slice_time(table, 9.0, 10.0)


def test_resampling_keeps_straight_lines_and_holds_commands():
    """By hand: position 7 t stays 7 t between neighbours; commands are those of the last row
    before.
    """
    t = np.array([0.0, 0.05, 0.1, 0.15])
    fine = resample(table_of(t), 40.0)
    assert fine.t == pytest.approx(np.arange(7) * 0.025, abs=1e-15)
    assert fine.p_world[:, 0] == pytest.approx(7.0 * fine.t, abs=1e-14)
    assert fine.commands[:, 1] == pytest.approx(
        np.sin([0, 0, 0.05, 0.05, 0.1, 0.1, 0.15]), abs=1e-15
    )


def test_resampling_at_the_own_rate_changes_nothing():
    """Identity, also beside frames without a pose and with stamps rounded to 10 microseconds."""
    t = np.round(np.arange(100) / 30.0, 5)
    p_world = np.column_stack([np.sin(t), np.cos(t), t])
    p_world[[5, 6, 50]] = np.nan
    table = table_of(t, p_world=p_world)
    same = resample(table, 30.0)
    assert np.array_equal(np.isnan(same.p_world), np.isnan(p_world))
    assert (
        np.nanmax(np.abs(same.p_world - p_world)) < 1e-5 * 3
    )  # stamps moved by 5 us at up to 3 m/s


def test_gaps_stay_gaps():
    """A pose missing at 0.10 s and frames missing from 0.30 to 0.40 s: nothing is made up in
    between.
    """
    t = np.delete(np.arange(12) * 0.05, [6, 7, 8])
    p_world = np.column_stack([7.0 * t, 0 * t, 0 * t])
    p_world[2] = np.nan
    fine = resample(table_of(t, p_world=p_world), 100.0)
    unknown = np.isnan(fine.p_world[:, 0])
    in_gap = ((fine.t > 0.051) & (fine.t < 0.149)) | ((fine.t > 0.251) & (fine.t < 0.449))
    assert np.array_equal(unknown, in_gap)
    assert np.isfinite(fine.commands).all()


def test_angles_are_interpolated_the_short_way_round():
    """By hand: half way from 3.1 to -3.1 is pi, which is written -pi, not 0."""
    attitude = np.array([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1]])
    middle = resample(table_of([0.0, 0.05], attitude=attitude), 40.0).attitude[1, 2]
    assert abs(middle) == pytest.approx(np.pi, abs=1e-12)


def test_missing_rows_are_inserted_and_measured_ones_kept():
    """By hand: from 0.10 to 0.26 s are 3.2 periods of 50 ms, so two rows at thirds; the jitter at
    0.30 stays.
    """
    t = [0.0, 0.05, 0.10, 0.26, 0.30, 0.35, 0.40]
    table = table_of(t, extra={"battery": np.arange(7.0)}, labels={"source": tuple("abcdefg")})
    full = fill_missing_rows(table)
    assert full.t == pytest.approx(
        [0.0, 0.05, 0.10, 0.10 + 0.16 / 3, 0.10 + 0.32 / 3, 0.26, 0.30, 0.35, 0.40]
    )
    assert set(t) <= set(full.t)
    assert np.isnan(full.p_world[3:5]).all() and np.isfinite(full.p_world[[0, 1, 2, 5, 6]]).all()
    assert np.array_equal(full.commands[3:5], np.array([table.commands[2]] * 2))
    assert np.isnan(full.extra["battery"][3]) and full.labels["source"][3] == "c"


def test_after_filling_no_step_is_long():
    """The promise, on 1000 frames with jitter of 10 % and every tenth frame lost at random."""
    rng = np.random.default_rng(5)
    t = np.arange(1000) * 0.05 + rng.uniform(-0.005, 0.005, 1000)
    table = table_of(t[rng.uniform(size=1000) > 0.1])
    full = fill_missing_rows(table, rate_hz=20.0)
    assert np.diff(full.t).max() <= 1.5 * 0.05
    assert full.has_pose.sum() == len(table.t) and 985 <= len(full.t) <= 1000


def test_a_wrong_stamp_does_not_ask_for_endless_rows():
    """Ten thousand years at 20 Hz."""
    table = table_of([0.0, 0.05, 0.1, 3e11])
    for run in (
        lambda: resample(table, 20.0),
        lambda: fill_missing_rows(table),
        lambda: split_by_time(table),
    ):
        with pytest.raises(InputError, match="a time stamp is wrong"):
            run()


@pytest.mark.parametrize("rate_hz", [0.0, -20.0, np.nan, np.inf])
def test_a_senseless_rate_is_refused(rate_hz):
    """A rate is a positive number."""
    with pytest.raises(InputError, match="rate_hz"):
        resample(table_of([0.0, 0.05]), rate_hz)


def test_one_row_has_no_rate():
    """Two are needed for a step."""
    with pytest.raises(InputError, match="two rows"):
        nominal_rate_hz(table_of([1.0]))


# Splitting.


@pytest.mark.parametrize(("share", "tests"), [(0.3, 4), (0.5, 6), (0.1, 1), (0.7, 8)])
def test_every_row_goes_to_one_side_in_whole_blocks(share, tests):
    """120 s in blocks of 10 s: 12 blocks, share * 12 of them (rounded) held out; by hand."""
    table = table_of(np.arange(2400) * 0.05)
    train, test = split_by_time(table, share)
    assert len(test) == tests
    assert all(
        9.9 <= block.duration <= 10.0 and len(block.t) == pytest.approx(200, abs=1)
        for block in test
    )
    rows = np.concatenate([block.t for block in (*train, *test)])
    assert np.array_equal(np.sort(rows), table.t)
    assert all(np.diff(block.t).max() < 0.051 for block in (*train, *test))


def test_adjoining_train_blocks_are_merged():
    """No train block begins within one frame of another's end."""
    train, _ = split_by_time(table_of(np.arange(2400) * 0.05))
    assert all(later.t[0] - earlier.t[-1] > 1.0 for earlier, later in pairwise(train))
    assert max(block.duration for block in train) > 15.0


def test_split_is_the_same_every_time():
    """Fitted numbers must not depend on luck."""
    table = table_of(np.arange(500) * 0.05)
    again = [[block.t[0] for block in side] for side in split_by_time(table)]
    assert again == [[block.t[0] for block in side] for side in split_by_time(table)]


def test_a_short_flight_still_has_both_sides():
    """6 s do not fill one block of 10 s."""
    train, test = split_by_time(table_of(np.arange(120) * 0.05))
    assert sum(len(block.t) for block in train) + sum(len(block.t) for block in test) == 120


def test_too_short_a_flight_is_refused():
    """Three rows cannot be split into blocks."""
    with pytest.raises(InputError, match="too short to split"):
        split_by_time(table_of([0.0, 0.05, 0.1]))
    with pytest.raises(InputError, match="test_share"):
        split_by_time(table_of(np.arange(100.0)), test_share=1.0)


def test_readings_are_joined_by_lines_and_held_over_a_pause():
    """By hand: readings every 0.1 s, a pause until 1.0 s; the line to it begins 0.1 s before."""
    t_reading = np.array([0.0, 0.1, 0.2, 0.3, 1.0])
    readings = np.array([[0.0], [1.0], [1.0], [3.0], [5.0]])
    t = np.array([-1.0, 0.05, 0.15, 0.25, 0.6, 0.9, 0.95, 1.0, 2.0])
    found = interpolate_readings(t, t_reading, readings)
    np.testing.assert_allclose(found[:, 0], [0.0, 0.5, 1.0, 2.0, 3.0, 3.0, 4.0, 5.0, 5.0])
