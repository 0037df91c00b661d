"""Flight table: one CSV row per camera frame <-> times, poses and commands as arrays; cut by
time, resampled, its units checked.
"""

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_file, require_range, require_shape
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.core.frames import wrap_angle
from falconwing_kit.core.messages import COMMAND_NAMES

POSE_COLUMNS = ("px", "py", "pz", "roll", "pitch", "yaw")
REQUIRED_COLUMNS = ("t", *POSE_COLUMNS, *COMMAND_NAMES)
OPTIONAL_COLUMNS = ("vx", "vy", "vz", "p", "q", "r", "airspeed", "sigma_position", "sigma_attitude")
LABEL_COLUMN = "source"

MAX_STEP = 1.5  # nominal periods; a longer step between two rows is a gap
SAME_ROW = 1e-3  # of a period: a grid time nearer to a row's time is that row's
MAX_GROWTH = 100  # grid rows per table row; a longer grid comes from a wrong time stamp
SHORT_TABLE_ROWS = 1000  # added before that ratio: a grid of 100 000 rows is never too long
MAX_FILE_BYTES = 512 * 1024**2  # about 80 hours at 20 Hz
MAX_LINE_BYTES = 64 * 1024
MAX_BAD_ROWS = 3  # or one in a hundred: rows with a bad time stamp in a file that is accepted
MAX_COMMAND_EXCESS = 0.1  # beyond its range; a larger excess is another unit, not rounding
MAX_OUTLIER_SHARE = 0.05  # of the angles; if more are too large, the unit is wrong
MIN_CAMERA_PERIOD_S, MAX_CAMERA_PERIOD_S = 0.005, 0.5  # plausible: 200 to 2 frames per second
MIN_ROWS_FOR_UNIT = 10  # rows needed to check the unit of time


@dataclass(frozen=True, eq=False)
class FlightTable:
    """One flight, one row per camera frame.

    Raises:
        InputError: columns differ in length, time does not increase, or a command is not finite.
    """

    name: str  # file it was read from, "case00/calm.csv"
    t: Array  # (N,) [s], strictly increasing
    p_world: Array  # (N, 3) [m], nan in frames without a pose
    attitude: Array  # (N, 3) roll, pitch, yaw [rad] as read, nan in frames without a pose
    commands: Array  # (N, 4) throttle, aileron, elevator, rudder
    extra: Mapping[str, Array] = field(default_factory=dict)  # further numeric columns, (N,) each
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # text columns, N each
    warnings: tuple[str, ...] = ()  # irregularities in the file, one sentence each

    def __post_init__(self) -> None:
        """Check the shapes, the time and the commands."""
        rows = len(self.t)
        for name, column, shape in (
            ("t", self.t, (rows,)),
            ("p_world", self.p_world, (rows, 3)),
            ("attitude", self.attitude, (rows, 3)),
            ("commands", self.commands, (rows, 4)),
            *((name, values, (rows,)) for name, values in self.extra.items()),
        ):
            require_shape(f"{self.name}: {name}", column, shape)
        for name, words in self.labels.items():
            if len(words) != rows:
                raise InputError(f"{self.name}: {name}: expected {rows} words, got {len(words)}")
        if rows == 0 or not np.isfinite(self.t).all() or not (np.diff(self.t) > 0.0).all():
            raise InputError(
                f"{self.name}: expected at least one row and a finite time that increases from "
                "row to row"
            )
        if not np.isfinite(self.commands).all():
            raise InputError(
                f"{self.name}: expected finite commands in every row; repeat the previous command "
                "if one is missing"
            )

    @property
    def duration(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.t[-1] - self.t[0])

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(N,) True for frames with a pose."""
        return np.asarray(
            np.isfinite(self.p_world).all(axis=1) & np.isfinite(self.attitude).all(axis=1)
        )


def read_flight_table(path: str | Path) -> FlightTable:
    """Read a flight table and check every cell.

    Args:
        path: a CSV file with at least the REQUIRED_COLUMNS, in any order; seconds, metres, radians.

    Returns:
        The table; everything corrected or irregular is in its warnings.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is unusable; the message gives the line and the correction.
    """
    path = require_file(path)
    name = short_name(path)
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise InputError(
            f"{name}: expected a flight table of at most {MAX_FILE_BYTES >> 20} MiB, "
            f"got {size >> 20} MiB"
        )
    with path.open("rb") as file:
        cells = _read_cells(name, file, _read_header(name, file))
    warnings = cells.warnings
    extra, labels = _sort_unknown_columns(cells, warnings)
    _check_finite(name, cells, extra, warnings)
    rows = _increasing_rows(name, cells.numbers["t"], cells.lines, warnings)
    numbers = {column: values[rows] for column, values in cells.numbers.items()}
    _require_seconds(name, numbers["t"])
    pose = _poses(name, numbers, warnings)
    return FlightTable(
        name=name,
        t=numbers["t"],
        p_world=pose[:, :3],
        attitude=pose[:, 3:],
        commands=_commands(name, numbers, cells.lines[rows], warnings),
        extra={column: values[rows] for column, values in extra.items()},
        labels={column: tuple(words[row] for row in rows) for column, words in labels.items()},
        warnings=tuple(f"{name}: {sentence}" for sentence in warnings),
    )


def write_flight_table(path: str | Path, table: FlightTable) -> None:
    """Write a table as CSV, atomically; reading it gives bit-identical numbers.

    Raises:
        InputError: the disk is full or the folder is not writable.
        FileNotFoundError: the folder does not exist.
    """
    optional = [name for name in OPTIONAL_COLUMNS if name in table.extra]
    unknown = [name for name in table.extra if name not in OPTIONAL_COLUMNS]
    text_columns = sorted(table.labels, key=lambda name: name != LABEL_COLUMN)
    numbers = np.column_stack(
        [
            table.t,
            table.p_world,
            table.attitude,
            table.commands,
            *(table.extra[name] for name in optional + unknown),
        ]
    )
    words: Iterable[tuple[str, ...]] = [()] * len(table.t)
    if text_columns:
        words = zip(*(table.labels[name] for name in text_columns), strict=True)
    with atomic_write(path, text=True) as file:
        file.write(",".join([*REQUIRED_COLUMNS, *optional, *unknown, *text_columns]) + "\n")
        for row, row_words in zip(numbers, words, strict=True):
            file.write(",".join([*map(repr, row.tolist()), *row_words]) + "\n")


def nominal_rate_hz(table: FlightTable) -> float:
    """Frames per second of the camera: the inverse of the median step, robust to lost frames.

    Raises:
        InputError: the table has a single row.
    """
    if len(table.t) < 2:
        raise InputError(
            f"{table.name}: expected at least two rows to compute the frame rate, "
            f"got {len(table.t)}"
        )
    return float(1.0 / np.median(np.diff(table.t)))


def slice_time(table: FlightTable, t0: float, t1: float) -> FlightTable:
    """The rows with t0 <= t < t1 [s], with unchanged time stamps.

    Raises:
        InputError: there is no such row.
    """
    rows = np.flatnonzero((table.t >= t0) & (table.t < t1))
    if len(rows) == 0:
        raise InputError(
            f"{table.name}: expected rows from {t0:g} to {t1:g} s, "
            f"got a flight from {_time_range_text(table)}"
        )
    return select_rows(table, rows)


def resample(table: FlightTable, rate_hz: float) -> FlightTable:
    """The flight on a uniform time grid that starts at its first row; gaps stay gaps.

    Commands and labels are zero-order holds of the previous row. Poses and other numbers are
    interpolated linearly between measured neighbours at most 1.5 nominal periods apart (angles the
    short way round), and are nan elsewhere.

    Returns:
        The resampled flight; angles in [-pi, pi).

    Raises:
        InputError: the rate is not positive or the grid would be implausibly long.
    """
    require_range("rate_hz", rate_hz, low=1e-6)
    _require_plausible_rows(table, table.duration * rate_hz)
    period = 1.0 / nominal_rate_hz(table)
    grid = table.t[0] + np.arange(int(table.duration * rate_hz + 1e-6) + 1) / rate_hz
    # A grid time that equals a row's time but for rounding, say of stamps to 10 us, is that row:
    # a measured pose beside a gap must not be lost.
    nearest = table.t[nearest_index(table.t, grid)]
    query = np.where(np.abs(nearest - grid) < SAME_ROW * period, nearest, grid)
    previous = np.searchsorted(table.t, query, side="right") - 1

    def column(values: Array, angle: bool = False) -> Array:
        """A column (N,) of the table at the grid times."""
        return _interpolate(table.t, values, query, MAX_STEP * period, angle)

    return replace(
        select_rows(table, previous, grid),
        p_world=np.column_stack([column(values) for values in table.p_world.T]),
        attitude=np.column_stack([column(values, angle=True) for values in table.attitude.T]),
        extra={name: column(values) for name, values in table.extra.items()},
    )


def interpolate_readings(t: Array, t_reading: Array, readings: Array) -> Array:
    """A signal on the lines between its readings; held over a longer pause, and behind the last.

    A hand moves a stick without jumps, so a reading repeated until the next one would be late by
    half of the time between them. After a pause of more than twice the usual time between readings
    the line begins that usual time before the next one.

    Args:
        t: (N,) where the signal is wanted [s].
        t_reading: (M,) times of the readings, increasing [s].
        readings: (M, k).

    Returns:
        (N, k); the first reading before it.
    """
    intervals = np.diff(t_reading)
    usual = float(np.median(intervals)) if len(intervals) else 0.0
    paused = np.flatnonzero(intervals > 2.0 * usual)
    knots = np.concatenate([t_reading, t_reading[paused + 1] - usual])
    values = np.concatenate([readings, readings[paused]])
    order = np.argsort(knots, kind="stable")
    columns = [np.interp(t, knots[order], column) for column in values[order].T]
    return np.stack(columns, axis=1)


def fill_missing_rows(table: FlightTable, rate_hz: float | None = None) -> FlightTable:
    """Insert rows without a pose for lost frames, until no step exceeds 1.5 nominal periods.

    Inserted rows repeat the previous command; measured rows keep their time stamps.

    Args:
        table: the flight.
        rate_hz: the nominal frame rate; None for the table's own.

    Returns:
        The flight with the inserted rows, evenly spaced within each gap.

    Raises:
        InputError: the rate is not positive or implausibly many rows would be needed.
    """
    rate_hz = (
        nominal_rate_hz(table) if rate_hz is None else require_range("rate_hz", rate_hz, low=1e-6)
    )
    _require_plausible_rows(table, table.duration * rate_hz)
    # Row i is repeated copies[i] times: once, or once per period of the gap behind it.
    periods = np.diff(table.t) * rate_hz
    copies = np.append(np.where(periods > MAX_STEP, np.rint(periods), 1.0).astype(np.int64), 1)
    first = np.concatenate([[0], np.cumsum(copies)[:-1]])
    row = np.repeat(np.arange(len(table.t)), copies)
    place_in_gap = np.arange(len(row)) - first[row]  # 0 for the measured row itself
    measured = place_in_gap == 0
    step = np.append(np.diff(table.t), 0.0) / copies
    return replace(
        select_rows(table, row, table.t[row] + place_in_gap * step[row]),
        p_world=np.where(measured[:, None], table.p_world[row], np.nan),
        attitude=np.where(measured[:, None], table.attitude[row], np.nan),
        extra={
            name: np.where(measured, values[row], np.nan) for name, values in table.extra.items()
        },
    )


def split_by_time(
    table: FlightTable, test_share: float = 0.3, block_s: float = 10.0
) -> tuple[tuple[FlightTable, ...], tuple[FlightTable, ...]]:
    """Split a flight into training and test blocks, evenly spread and deterministic.

    Neighbouring frames are strongly correlated, so samples are never shuffled: whole blocks of time
    are held out. A flight too short for blocks of block_s gets shorter ones, so that both parts
    have at least one.

    Args:
        table: the flight.
        test_share: share of the time to hold out, above 0 and below 1.
        block_s: length of a block [s].

    Returns:
        Training blocks (adjacent ones merged) and test blocks, both in order of time.

    Raises:
        InputError: the share or the length is out of range, or the flight has too few rows.
    """
    share = require_range("test_share", test_share, low=0.01, high=0.99)
    require_range("block_s", block_s, low=1e-3)
    _require_plausible_rows(table, table.duration / block_s)
    blocks = max(
        round(table.duration / block_s), int(np.ceil(1.0 / min(share, 1.0 - share) - 1e-9))
    )
    # A block is a test block where the rounded number of test blocks so far increases.
    test_blocks_so_far = np.floor(np.arange(blocks + 1) * share + 0.5 + 1e-9)
    is_test = np.diff(test_blocks_so_far) > 0.0
    block = np.minimum(
        ((table.t - table.t[0]) * blocks / max(table.duration, 1e-12)).astype(np.int64), blocks - 1
    )
    # Segments: each test block alone, adjacent training blocks (part -1) together.
    part = np.where(is_test[block], block, -1)
    starts = np.flatnonzero(np.diff(part, prepend=-2) != 0)
    segments = [np.arange(a, b) for a, b in zip(starts, [*starts[1:], len(part)], strict=True)]
    train = tuple(select_rows(table, rows) for rows in segments if part[rows[0]] < 0)
    test = tuple(select_rows(table, rows) for rows in segments if part[rows[0]] >= 0)
    if not train or not test or len(table.t) < 2 * blocks:
        raise InputError(
            f"{table.name}: too short to split: got {len(table.t)} rows over {table.duration:g} s"
        )
    return train, test


def nearest_index(t: Array, query: Array) -> NDArray[np.int64]:
    """Indices (M,) of the times in t (N,) nearest to the queries (M,); the earlier in a tie."""
    right = np.minimum(np.searchsorted(t, query), len(t) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(query - t[left] <= t[right] - query, left, right)


def select_rows(table: FlightTable, rows: NDArray[np.int64], t: Array | None = None) -> FlightTable:
    """The given rows, at their own times or at new ones [s]."""
    return replace(
        table,
        t=table.t[rows] if t is None else t,
        p_world=table.p_world[rows],
        attitude=table.attitude[rows],
        commands=table.commands[rows],
        extra={name: values[rows] for name, values in table.extra.items()},
        labels={name: tuple(words[row] for row in rows) for name, words in table.labels.items()},
    )


def _interpolate(t: Array, values: Array, query: Array, max_gap: float, angle: bool) -> Array:
    """Linear interpolation of the finite values; nan in gaps longer than max_gap."""
    measured = np.flatnonzero(np.isfinite(values))
    if len(measured) == 0:
        return np.full(len(query), np.nan)
    t, values = t[measured], values[measured]
    # Neighbours of each query; both are the same row where the query is a measured time.
    before = np.searchsorted(t, query, side="right") - 1
    after = np.searchsorted(t, query, side="left")
    inside = (before >= 0) & (after < len(t))
    before, after = np.clip(before, 0, None), np.clip(after, None, len(t) - 1)
    gap = t[after] - t[before]
    step = values[after] - values[before]
    step = wrap_angle(step) if angle else step
    result = values[before] + step * (query - t[before]) / np.where(gap > 0.0, gap, 1.0)
    result = wrap_angle(result) if angle else result
    return np.where(inside & (gap <= max_gap), result, np.nan)


def _require_plausible_rows(table: FlightTable, rows: float) -> None:
    """Refuse a grid that is implausibly long for the table."""
    max_rows = MAX_GROWTH * (SHORT_TABLE_ROWS + len(table.t))
    if not rows <= max_rows:
        raise InputError(
            f"{table.name}: {_time_range_text(table)} in {len(table.t)} rows would become "
            f"{rows:.3g} rows, more than {max_rows}; a time stamp is wrong, or cut the flight with "
            "slice_time first"
        )


def _time_range_text(table: FlightTable) -> str:
    """First and last time of a table, for a message."""
    return f"{table.t[0]:g} to {table.t[-1]:g} s"


# Reading a CSV file from an unknown source: bytes -> columns of cells -> checked columns.


@dataclass(frozen=True)
class _Cells:
    """Content of the lines before any check of the values."""

    numbers: dict[str, Array]  # known numeric columns, (N,) each
    words: dict[str, list[str]]  # all other columns
    lines: NDArray[np.int64]  # (N,) line number in the file, for messages
    warnings: list[str]


def _lines(name: str, file: BinaryIO) -> Iterator[bytes]:
    """The raw lines of the file, none longer than MAX_LINE_BYTES."""
    while line := file.readline(MAX_LINE_BYTES + 1):
        if len(line) > MAX_LINE_BYTES or b"\0" in line:
            raise InputError(
                f"{name}: expected lines of numbers and commas, got binary data or an endless "
                "line; is it a CSV file?"
            )
        yield line


def _decode(name: str, line: bytes, number: int) -> str:
    """A line of the file as text without its end; the first may begin with a byte order mark."""
    try:
        return line.decode("utf-8-sig" if number == 1 else "utf-8").strip("\r\n")
    except UnicodeDecodeError:
        raise InputError(
            f"{name}: line {number} is not UTF-8 text; save the table as UTF-8 CSV"
        ) from None


def _read_header(name: str, file: BinaryIO) -> list[str]:
    """Column names in the order of the file."""
    raw = next(_lines(name, file), b"")
    header = _decode(name, raw, 1)
    if not header.strip():
        raise InputError(
            f"{name}: expected a header line t,px,py,..., got an empty {'line' if raw else 'file'}"
        )
    for separator, word in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
        if "," not in header and separator in header.strip():
            raise InputError(
                f"{name}: expected commas between columns, got {word}; export the table again"
            )
    columns = [
        column.strip().strip('"') or f"column_{place}"
        for place, column in enumerate(header.split(","), start=1)
    ]
    if len(set(columns)) < len(columns):
        repeated = sorted(column for column, count in Counter(columns).items() if count > 1)
        raise InputError(
            f"{name}: expected each column once, got {_name_list(repeated)} more than once"
        )
    missing = [column for column in REQUIRED_COLUMNS if column not in columns]
    if missing:
        raise InputError(
            f"{name}: missing column {_name_list(missing)}; the header has {_name_list(columns)}"
        )
    return columns


def _read_cells(name: str, file: BinaryIO, columns: list[str]) -> _Cells:
    """All rows, with numeric and text columns separated."""
    numeric = [
        place
        for place, column in enumerate(columns)
        if column in REQUIRED_COLUMNS + OPTIONAL_COLUMNS
    ]
    others = [place for place, column in enumerate(columns) if place not in numeric]
    flat, lines, warnings = array("d"), array("q"), list[str]()
    words: dict[str, list[str]] = {columns[place]: [] for place in others}
    unique_words: dict[str, str] = {}  # one object per different word, to save memory
    for number, raw in enumerate(_lines(name, file), start=2):
        if not raw.strip():
            continue
        try:
            row = _decode(name, raw, number).split(",")
            numbers = _row_of_numbers(name, number, row, columns, numeric)
            truncated = raw.endswith(b",")  # only the last line has no line end
        except InputError:
            truncated = not raw.endswith(b"\n")
            if not truncated:
                raise
        if truncated:
            warnings.append(f"the last line ({number}) is cut off and was dropped")
            break
        flat.extend(numbers)
        lines.append(number)
        for place in others:
            word = row[place].strip()
            words[columns[place]].append(unique_words.setdefault(word, word))
    if not lines:
        raise InputError(f"{name}: expected at least one row of numbers below the header, got none")
    table = np.frombuffer(flat, dtype=np.float64).reshape(len(lines), len(numeric))
    known = {columns[place]: table[:, i].copy() for i, place in enumerate(numeric)}
    return _Cells(known, words, np.frombuffer(lines, dtype=np.int64), warnings)


def _row_of_numbers(
    name: str, line: int, row: list[str], columns: list[str], numeric: list[int]
) -> list[float]:
    """The numeric cells of a row; an empty cell is nan."""
    if len(row) != len(columns):
        raise InputError(
            f"{name}: line {line}: expected {len(columns)} cells as in the header, got {len(row)}"
        )
    try:
        return [float(row[place]) for place in numeric]  # fast path for a complete row
    except ValueError:
        numbers = []
    for place in numeric:
        try:
            numbers.append(float(row[place]) if row[place].strip() else np.nan)
        except ValueError:
            raise InputError(
                f"{name}: line {line}, column {columns[place]}: expected a number or nan, "
                f"got {row[place][:40]!r}"
            ) from None
    return numbers


def _sort_unknown_columns(
    cells: _Cells, warnings: list[str]
) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Optional numeric columns, and text columns; unknown columns are kept with a warning."""
    extra = {
        column: cells.numbers[column] for column in OPTIONAL_COLUMNS if column in cells.numbers
    }
    labels = {}
    for column, words in cells.words.items():
        try:
            if column == LABEL_COLUMN:
                raise ValueError
            extra[column] = np.array([float(word) if word else np.nan for word in words])
        except ValueError:
            labels[column] = words
    unknown = [column for column in cells.words if column != LABEL_COLUMN]
    if unknown:
        warnings.append(f"unknown column {_name_list(unknown)} kept beside the flight table's own")
    return extra, labels


def _check_finite(name: str, cells: _Cells, extra: dict[str, Array], warnings: list[str]) -> None:
    """Refuse infinity in required columns; replace it by nan in the others."""
    for column in REQUIRED_COLUMNS:
        infinite = np.isinf(cells.numbers[column])
        if infinite.any():
            line = cells.lines[np.argmax(infinite)]
            raise InputError(
                f"{name}: line {line}, column {column}: expected a finite number or nan, "
                "got infinity"
            )
    for column, values in extra.items():
        if np.isinf(values).any():
            extra[column] = np.where(np.isinf(values), np.nan, values)
            warnings.append(f"infinite values in column {column} are taken as nan")


def _increasing_rows(
    name: str, t: Array, lines: NDArray[np.int64], warnings: list[str]
) -> NDArray[np.int64]:
    """Indices of the rows whose time is later than that of every earlier row."""
    latest = np.fmax.accumulate(np.concatenate([[-np.inf], t]))[:-1]
    increasing = t > latest
    bad = np.flatnonzero(~increasing)
    if len(bad) > max(MAX_BAD_ROWS, len(t) // 100) or not increasing.any():
        row = bad[0]
        raise InputError(
            f"{name}: time must increase from row to row, but {len(bad)} of {len(t)} rows stand "
            f"still, go back or have no time, first line {lines[row]}: t = {t[row]:g} after "
            f"{latest[row]:g}; {_likely_time_order(t)}"
        )
    if len(bad):
        warnings.append(
            f"rows dropped because time did not increase: {len(bad)}, "
            f"the first in line {lines[bad[0]]}"
        )
    return np.flatnonzero(increasing)


def _likely_time_order(t: Array) -> str:
    """Why times (N,) do not increase from row to row, and what to do."""
    steps = np.diff(t[np.isfinite(t)])
    if len(steps) and (steps < 0.0).mean() > 0.9:
        return "the file runs backwards in time: reverse the order of its rows"
    if len(steps) and (steps < 0.0).sum() <= 3 and (steps == 0.0).sum() > 0.3 * len(steps):
        return "stamps are repeated: write them with more digits"
    if len(steps) and 0 < (steps < 0.0).sum() <= 3:
        return "the clock starts again: cut the file there into one for each flight"
    return "sort the rows or cut the file"


def likely_time_unit(t: Array) -> tuple[str, float] | None:
    """Unit in which times (N,) give a plausible camera period, and how many are a second.

    None where seconds do, or where there are too few rows to say.
    """
    step = float(np.median(np.diff(t))) if len(t) >= MIN_ROWS_FOR_UNIT else 0.0
    for unit, per_second in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        if MIN_CAMERA_PERIOD_S <= step / per_second <= MAX_CAMERA_PERIOD_S:
            return unit, per_second
    return None


def likely_command_unit(column: str, values: Array) -> str:
    """What a command (N,) outside its range likely is, and how to convert it; "" inside."""
    low = 0.0 if column == "throttle" else -1.0
    excess = np.maximum(values - 1.0, low - values)
    if excess.max() <= MAX_COMMAND_EXCESS:
        return ""
    largest = float(np.abs(values).max())
    got = f"expected {column} in {low:g}..1, got {values[np.argmax(excess)]:g}: looks like"
    if 500.0 <= largest <= 2500.0:
        zero, full = (1000, 1000) if column == "throttle" else (1500, 500)
        return f"{got} microseconds; convert it by (us - {zero}) / {full}"
    if column == "throttle" and largest <= 1.0 + MAX_COMMAND_EXCESS:
        return f"{got} a throttle of -1..1; convert it by (throttle + 1) / 2"
    if largest <= 110.0:
        return f"{got} percent, or degrees of a control surface; divide it by its largest value"
    return f"{got} the raw counts of a receiver; convert them to {low:g}..1 first"


def _require_seconds(name: str, t: Array) -> None:
    """Refuse times that give a plausible camera period only in milli-, micro- or nanoseconds."""
    unit = likely_time_unit(t)
    if unit is not None:
        raise InputError(
            f"{name}: time looks like {unit[0]}: expected seconds, got rows "
            f"{np.median(np.diff(t)):g} apart; divide the column t by {unit[1]:g}"
        )


def _poses(name: str, numbers: dict[str, Array], warnings: list[str]) -> Array:
    """Poses (N, 6); an incomplete row becomes all nan."""
    pose = np.column_stack([numbers[column] for column in POSE_COLUMNS])
    measured = np.isfinite(pose)
    partial = measured.any(axis=1) & ~measured.all(axis=1)
    if partial.any():
        warnings.append(
            f"rows with an incomplete pose, read as rows without a pose: {partial.sum()}"
        )
        pose[partial] = np.nan
    if np.isnan(pose).all():
        warnings.append("no row has a pose")
    else:
        _check_radians(name, pose[np.isfinite(pose[:, 0]), 3:], warnings)
    return pose


def _check_radians(name: str, attitude: Array, warnings: list[str]) -> None:
    """Refuse degrees. An unwrapped yaw may pass many turns, but starts within one."""
    tilted = (np.abs(attitude[:, :2]) > 2.0 * np.pi).any(axis=1)
    yaw_excess = np.abs(attitude[:, 2]) > 4.0 * np.pi
    unwrapped = (
        abs(attitude[0, 2]) <= 2.0 * np.pi
        and np.abs(np.diff(attitude[:, 2])).max(initial=0.0) < 4.0 * np.pi
    )
    if tilted.mean() > MAX_OUTLIER_SHARE or (
        yaw_excess.mean() > MAX_OUTLIER_SHARE and not unwrapped
    ):
        largest = np.abs(attitude).max()
        raise InputError(
            f"{name}: roll, pitch or yaw reach {largest:.3g}, which looks like degrees; "
            "convert to radians"
        )
    if yaw_excess.mean() > MAX_OUTLIER_SHARE:
        warnings.append(
            "yaw goes on beyond two turns and is taken as unwrapped; "
            "if it is in degrees convert it first"
        )


def _commands(
    name: str, numbers: dict[str, Array], lines: NDArray[np.int64], warnings: list[str]
) -> Array:
    """Commands (N, 4): missing ones repeat the previous row, slight excesses are clipped."""
    columns = []
    for column, low in zip(COMMAND_NAMES, (0.0, -1.0, -1.0, -1.0), strict=True):
        values = numbers[column]
        known = np.isfinite(values)
        if not known[0]:
            raise InputError(
                f"{name}: line {lines[0]}, column {column}: expected a command in the first row, "
                "got nan"
            )
        if not known.all():
            warnings.append(f"rows without {column}, held from the row before: {(~known).sum()}")
            values = values[np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))]
        excess = np.maximum(values - 1.0, low - values)
        largest = int(np.argmax(excess))
        if excess[largest] > MAX_COMMAND_EXCESS:
            raise InputError(
                f"{name}: line {lines[largest]}: {likely_command_unit(column, values)}"
            )
        if excess[largest] > 0.0:
            warnings.append(
                f"rows with {column} slightly outside {low:g}..1, clipped: {(excess > 0.0).sum()}"
            )
        columns.append(np.clip(values, low, 1.0))
    return np.column_stack(columns)


def _name_list(names: list[str], limit: int = 12) -> str:
    """The first names, separated by commas."""
    text = ", ".join(name[:40] for name in names[:limit])
    return text if len(names) <= limit else f"{text} and {len(names) - limit} more"
