"""The recorded ALFA flight: signs and units against laws of flight, reader against the raw files
and broken ones.
"""

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable, read_flight_table, write_flight_table
from falconwing_kit.core.frames import rotation_world_body, wrap_angle
from falconwing_kit.data import data_path
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.demo.alfa import read_alfa

FAILURE_TIME = 116.166  # s
RAW = Path(__file__).resolve().parents[4] / "shared/data/alfa_carbonz_engine_failure"


@pytest.fixture(scope="module")
def flight() -> FlightTable:
    return read_flight_table(data_path("alfa_engine_failure.csv"))


@pytest.fixture(scope="module")
def raw_folder() -> Path:
    if not RAW.is_dir():
        pytest.skip(f"the raw ALFA flight is not beside this checkout: {RAW} is missing")
    return RAW


@pytest.fixture
def raw_copy(raw_folder: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "raw"
    folder.mkdir()
    for file in raw_folder.glob("*.csv"):
        shutil.copyfile(file, folder / file.name)
    return folder


def velocity(flight: FlightTable) -> np.ndarray:
    return np.column_stack([flight.extra[name] for name in ("vx", "vy", "vz")])


def rate_of(t: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Mean rate between neighbouring poses."""
    return wrap_angle(np.diff(angle)) / np.diff(t)


def middle(values: np.ndarray) -> np.ndarray:
    return 0.5 * (values[1:] + values[:-1])


def test_bank_turns_the_nose_as_a_level_turn_does(flight: FlightTable) -> None:
    """Law of the coordinated level turn, d(yaw)/dt = (g/V) tan(roll).

    The slope may be off by 10 %: the airspeed sensor reads 6 % low and the turns are not quite
    level. The autopilot does not fly inverted, so the belly points down; tan alone could not tell.
    """
    rows = flight.has_pose
    roll, _, yaw = flight.attitude[rows].T
    law = middle(9.81 / flight.extra["airspeed"][rows] * np.tan(roll))
    turn_rate = rate_of(flight.t[rows], yaw)
    assert np.cos(roll).min() > 0.0
    slope, _ = np.polyfit(law, turn_rate, 1)
    assert np.corrcoef(law, turn_rate)[0, 1] > 0.9
    assert slope == pytest.approx(1.0, abs=0.1)


def test_bank_accelerates_towards_the_low_wing(flight: FlightTable) -> None:
    """Lift is the only large sideways force: acceleration to the right is (g + upward acceleration)
    tan(roll).

    10 % for the drag's and sideforce's share; the velocity comes from another topic than the
    attitude.
    """
    rows = flight.has_pose
    t = flight.t[rows]
    v_smooth = np.apply_along_axis(
        lambda v: np.convolve(v, np.ones(5) / 5, mode="same"), 0, velocity(flight)
    )
    a_world = np.gradient(v_smooth, flight.t, axis=0)[rows]
    roll, _, yaw = flight.attitude[rows].T
    a_right = -a_world[:, 0] * np.sin(yaw) - a_world[:, 1] * np.cos(yaw)  # world y is left of north
    law = (9.81 + a_world[:, 2]) * np.tan(roll)
    inside = (t > 1.0) & (t < t[-1] - 1.0)
    slope, _ = np.polyfit(law[inside], a_right[inside], 1)
    assert np.corrcoef(law[inside], a_right[inside])[0, 1] > 0.97
    assert slope == pytest.approx(1.0, abs=0.1)


def test_velocity_is_the_derivative_of_position(flight: FlightTable) -> None:
    """Definition. 0.25 m over 0.4 s: 0.19 m of stamp jitter, averaged over four, in both ends
    leaves half of that.
    """
    rows = np.flatnonzero(flight.has_pose)
    v_world = velocity(flight)
    travelled = np.array(
        [np.trapezoid(v_world[a : b + 1], dx=0.05, axis=0) for a, b in pairwise(rows)]
    )
    error = np.diff(flight.p_world[rows], axis=0) - travelled
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.25
    assert (
        np.abs(travelled).mean(axis=0).min() > 0.2
    )  # so that zeros or swapped axes would not pass
    for axis in range(3):
        assert np.corrcoef(np.diff(flight.p_world[rows, axis]), travelled[:, axis])[0, 1] > 0.97


def test_nose_points_where_the_air_comes_from(flight: FlightTable) -> None:
    """Triangle of velocities: ground velocity = airspeed along the nose + a steady wind.

    1.2 m/s remain for gusts and for the nose not lying exactly in the flow; the airspeed of 15 m/s
    is far above it.
    """
    rows = flight.has_pose & (flight.t < FAILURE_TIME)
    roll, pitch, yaw = flight.attitude[rows].T
    nose = rotation_world_body(roll, pitch, yaw)[:, :2, 0]
    v_air = velocity(flight)[rows, :2] - 1.07 * flight.extra["airspeed"][rows, None] * nose
    wind = v_air.mean(axis=0)
    assert np.sqrt(((v_air - wind) ** 2).mean()) < 1.2
    assert wind[0] < -0.5  # blows to the south, as the logged wind does


def test_nose_up_goes_with_climbing(flight: FlightTable) -> None:
    """Trim: at a steady angle of attack the climb angle follows pitch; one for one in the long run,
    less in gusts.
    """
    rows = flight.has_pose & (flight.t < FAILURE_TIME)
    climb = velocity(flight)[rows, 2] / flight.extra["airspeed"][rows]
    assert np.corrcoef(flight.attitude[rows, 1], climb)[0, 1] > 0.6


@pytest.mark.parametrize(
    ("axis", "name", "least"), [(0, "p", 0.85), (1, "q", 0.85), (2, "r", 0.95)]
)
def test_gyro_is_the_rate_of_the_attitude(
    flight: FlightTable, axis: int, name: str, least: float
) -> None:
    """Kinematics [Stevens, Lewis & Johnson, eq. 1.4-3]; correlation, as the rates change much
    between poses.
    """
    rows = flight.has_pose
    t, (roll, pitch, yaw) = flight.t[rows], flight.attitude[rows].T
    roll_rate, pitch_rate, yaw_rate = (rate_of(t, angle) for angle in (roll, pitch, yaw))
    roll, pitch = middle(roll), middle(pitch)
    expected = (
        roll_rate - np.sin(pitch) * yaw_rate,
        np.cos(roll) * pitch_rate + np.sin(roll) * np.cos(pitch) * yaw_rate,
        np.cos(roll) * np.cos(pitch) * yaw_rate - np.sin(roll) * pitch_rate,
    )[axis]
    assert np.corrcoef(middle(flight.extra[name][rows]), expected)[0, 1] > least


def test_aileron_rolls_to_its_own_side_and_elevator_raises_the_nose(flight: FlightTable) -> None:
    """Sign of the commands: positive aileron lowers the right wing, positive elevator raises the
    nose.

    A deflected surface gives a steady rate. The elevator is judged with the wings near level, where
    no turn asks for a pitch rate; what is left of both correlations is lost between servo samples.
    """
    rows = flight.has_pose & (flight.t < FAILURE_TIME)
    aileron, elevator = flight.commands[rows, 1], flight.commands[rows, 2]
    assert np.corrcoef(aileron, flight.extra["p"][rows])[0, 1] > 0.6
    level = np.abs(flight.attitude[rows, 0]) < np.radians(15.0)
    assert np.corrcoef(elevator[level], flight.extra["q"][rows][level])[0, 1] > 0.4


def test_aileron_and_rudder_are_one_command(flight: FlightTable) -> None:
    """The autopilot's mix of one half, seen in the raw pulses to 1 us of 400; identification has to
    know.
    """
    slope, _ = np.polyfit(flight.commands[:, 1], flight.commands[:, 3], 1)
    assert slope == pytest.approx(0.5, abs=0.01)
    assert np.corrcoef(flight.commands[:, 1], flight.commands[:, 3])[0, 1] > 0.999


def test_engine_fails_inside_the_flight_and_takes_the_speed_away(flight: FlightTable) -> None:
    """Recorded: the label comes at 116.2 s; without thrust an aircraft slows down or sinks."""
    before = (flight.t > FAILURE_TIME - 20.0) & (flight.t < FAILURE_TIME)
    after = flight.t > FAILURE_TIME + 2.0
    assert flight.t[0] < FAILURE_TIME < flight.t[-1] - 10.0
    assert flight.commands[after, 0].max() == 0.0
    assert flight.extra["airspeed"][after].mean() < flight.extra["airspeed"][before].mean() - 1.0
    assert velocity(flight)[after, 2].mean() < -0.5


def test_table_is_small_and_reads_without_warning(flight: FlightTable) -> None:
    """The file must stay small; 328 attitudes were counted in the raw file (repeats left out)."""
    assert data_path("alfa_engine_failure.csv").stat().st_size < 400_000
    assert flight.has_pose.sum() == 328
    assert flight.warnings == ()
    np.testing.assert_allclose(np.diff(flight.t), 0.05, atol=1e-9)


def test_reader_gives_the_shipped_table(
    raw_folder: Path, flight: FlightTable, tmp_path: Path
) -> None:
    """Same numbers from the raw files; 1e-9 because the table is rounded before it is written."""
    again = read_alfa(raw_folder)
    assert again.failure_time == pytest.approx(FAILURE_TIME, abs=1e-3)
    assert again.warnings == ()
    for ours, shipped in zip(
        (again.table.t, again.table.p_world, again.table.attitude, again.table.commands),
        (flight.t, flight.p_world, flight.attitude, flight.commands),
        strict=True,
    ):
        np.testing.assert_allclose(ours, shipped, atol=1e-9)
    assert again.table.extra.keys() == flight.extra.keys()
    for name, values in again.table.extra.items():
        np.testing.assert_allclose(values, flight.extra[name], atol=1e-9)


def test_logged_wind_agrees_with_the_triangle_of_velocities(
    raw_folder: Path, flight: FlightTable
) -> None:
    """The log says where wind comes from; turned round it must be within 1.5 m/s of a fit to the
    flight.
    """
    rows = flight.has_pose & (flight.t > 30.0) & (flight.t < FAILURE_TIME)
    roll, pitch, yaw = flight.attitude[rows].T
    nose = rotation_world_body(roll, pitch, yaw)[:, :2, 0] * flight.extra["airspeed"][rows, None]
    ones, zeros = np.ones(len(nose)), np.zeros(len(nose))
    matrix = np.vstack(
        [np.column_stack([nose[:, 0], ones, zeros]), np.column_stack([nose[:, 1], zeros, ones])]
    )
    _, *wind = np.linalg.lstsq(matrix, velocity(flight)[rows, :2].T.ravel(), rcond=None)[0]
    assert np.linalg.norm(read_alfa(raw_folder).wind_logged_world - wind) < 1.5


def test_missing_folder_and_missing_topic_are_named(raw_copy: Path, tmp_path: Path) -> None:
    """Bad input: the text names what is missing."""
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_alfa(tmp_path / "nowhere")
    (raw_copy / "mavros-rc-out.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"mavros-rc-out\.csv"):
        read_alfa(raw_copy)


def test_broken_files_give_one_sentence(raw_copy: Path) -> None:
    """Bad input: empty, of another topic, not numeric, cut half way."""
    path = raw_copy / "mavros-local_position-odom.csv"
    whole = path.read_bytes()
    for content, sentence in (
        (b"", "expected the columns"),
        (b"%time,field.data\n1,2\n", "expected the columns"),
        (whole.split(b"\n")[0] + b"\n", "two or more lines"),
        (whole.replace(b"-109.620780945", b"banana", 1), "not a number"),
        (whole[: len(whole) // 2], "is cut"),
        (b"\x00\xff" * 500, "expected the columns"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=sentence) as caught:
            read_alfa(raw_copy)
        assert "\n" not in str(caught.value)


def test_attitude_without_length_is_refused(raw_copy: Path) -> None:
    """Bad input: a quaternion of zeros is no rotation."""
    path = raw_copy / "mavros-imu-data.csv"
    head, line, *rest = path.read_text().splitlines()
    cells, names = line.split(","), head.split(",")
    for axis in "xyzw":
        cells[names.index(f"field.orientation.{axis}")] = "0.0"
    path.write_text("\n".join([head, ",".join(cells), *rest]) + "\n")
    with pytest.raises(InputError, match="mavros-imu-data: expected attitudes as quaternions"):
        read_alfa(raw_copy)


def test_a_cut_last_line_is_dropped_with_a_warning(raw_copy: Path, flight: FlightTable) -> None:
    """A log ends where the power went: the lines before are good."""
    path = raw_copy / "mavros-nav_info-velocity.csv"
    path.write_bytes(path.read_bytes()[:-30])
    again = read_alfa(raw_copy)
    assert len(again.warnings) == 1 and "cut off" in again.warnings[0]
    np.testing.assert_allclose(again.table.p_world[:2000], flight.p_world[:2000], atol=1e-9)


def test_export_writes_the_shipped_table(
    raw_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`falconwing export --alfa`: exit 0 with a file that equals the shipped one."""
    out = tmp_path / "again.csv"
    assert main(["export", str(raw_folder), "--alfa", "--out", str(out)]) == 0
    assert out.read_bytes() == data_path("alfa_engine_failure.csv").read_bytes()
    assert "328" in capsys.readouterr().out


def test_export_of_a_wrong_folder_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit 2: no topics in the folder, and no ROS bag of an ALFA flight."""
    out = str(tmp_path / "again.csv")
    assert main(["export", str(tmp_path), "--alfa", "--out", out]) == 2
    assert "expected a file" in capsys.readouterr().err
    assert main(["export", str(tmp_path), "--alfa", "--to", "bag", "--out", out]) == 2
    assert "--alfa: expected --to csv" in capsys.readouterr().err


def test_written_table_reads_back(flight: FlightTable, tmp_path: Path) -> None:
    """Inverse: the shipped file survives a round trip to the last byte."""
    write_flight_table(tmp_path / "copy.csv", flight)
    assert (tmp_path / "copy.csv").read_bytes() == data_path("alfa_engine_failure.csv").read_bytes()


def test_unknown_data_name_lists_what_ships() -> None:
    """Bad input: the way out is in the text."""
    with pytest.raises(InputError, match=r"case08_flight\.csv"):
        data_path("case99.csv")
