"""Flight table: one CSV row per camera frame <-> times, poses and commands as arrays; split, slice
and resample.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_csv import (
    LABEL_COLUMN,
    OPTIONAL_COLUMNS,
    REQUIRED_COLUMNS,
    read_flight_csv,
)
from falconwing_kit.core.frames import wrap_angle

MAX_STEP = 1.5  # nominal periods; a longer step between two rows is a gap
MIN_CAMERA_PERIOD_S, MAX_CAMERA_PERIOD_S = (
    0.005,
    0.5,
)  # between frames, 200 to 2 Hz; what is a thousand times slower is not
MIN_ROWS = 10  # to judge the unit of time by
MAX_GROWTH = (
    100  # a grid with more than this many rows per row of the table comes from a wrong time stamp
)


@dataclass(frozen=True, eq=False)
class FlightTable:
    """One flight, one row per camera frame.

    Raises:
        InputError: shapes do not fit each other, or time does not increase, or a command is not
            finite.
    """

    name: str  # where it came from, "case00/calm.csv"
    t: Array  # (N,) [s], strictly increasing
    p_world: Array  # (N, 3) [m], nan where a frame gave no pose
    attitude: Array  # (N, 3) roll, pitch, yaw [rad] as read, nan where a frame gave no pose
    commands: Array  # (N, 4) throttle, aileron, elevator, rudder
    extra: Mapping[str, Array] = field(default_factory=dict)  # further numeric columns, (N,) each
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # columns of words, N each
    warnings: tuple[str, ...] = ()  # what was unusual, one sentence each

    def __post_init__(self) -> None:
        """Check that the columns belong together."""
        rows = len(self.t)
        for name, array, shape in (
            ("t", self.t, (rows,)),
            ("p_world", self.p_world, (rows, 3)),
            ("attitude", self.attitude, (rows, 3)),
            ("commands", self.commands, (rows, 4)),
            *((name, column, (rows,)) for name, column in self.extra.items()),
        ):
            require_shape(f"{self.name}: {name}", array, shape)
        for name, words in self.labels.items():
            if len(words) != rows:
                raise InputError(f"{self.name}: {name}: expected {rows} words, got {len(words)}")
        if rows == 0 or not np.isfinite(self.t).all() or not (np.diff(self.t) > 0.0).all():
            raise InputError(
                f"{self.name}: expected at least one row and a finite time that increases from row to row"
            )
        if not np.isfinite(self.commands).all():
            raise InputError(
                f"{self.name}: expected finite commands in every row; hold the one before where one is missing"
            )

    @property
    def duration(self) -> float:
        """From the first row to the last [s]."""
        return float(self.t[-1] - self.t[0])

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(N,) True where the frame gave a pose."""
        return np.asarray(
            np.isfinite(self.p_world).all(axis=1) & np.isfinite(self.attitude).all(axis=1)
        )

    @property
    def missing_share(self) -> float:
        """Share of the rows without a pose, 0..1."""
        return float(1.0 - self.has_pose.mean())


def read_flight_table(path: str | Path) -> FlightTable:
    """Read a flight table and check every cell.

    Args:
        path: a CSV file with at least the REQUIRED_COLUMNS, in any order; seconds, metres, radians.

    Returns:
        The table; what was mended or unusual is in its warnings.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file cannot be used as it is; the text names the line and the way out.
    """
    table = FlightTable(**read_flight_csv(path))
    _require_seconds(table)
    return table


def write_flight_table(path: str | Path, table: FlightTable) -> None:
    """Write a table so that reading it gives the same numbers to the last bit.

    Args:
        path: the CSV file to write; it appears only once it is complete.
        table: the flight.

    Raises:
        InputError: the disk is full or the place is forbidden.
        FileNotFoundError: the folder does not exist.
    """
    optional = [name for name in OPTIONAL_COLUMNS if name in table.extra]
    unknown = [name for name in table.extra if name not in OPTIONAL_COLUMNS]
    words = sorted(table.labels, key=lambda name: name != LABEL_COLUMN)
    known = np.column_stack(
        [
            table.t,
            table.p_world,
            table.attitude,
            table.commands,
            *(table.extra[name] for name in optional + unknown),
        ]
    )
    with atomic_write(path, text=True) as file:
        file.write(",".join([*REQUIRED_COLUMNS, *optional, *unknown, *words]) + "\n")
        for row, row_words in zip(known, _label_rows(table, words), strict=True):
            file.write(",".join([*map(repr, row.tolist()), *row_words]) + "\n")


def nominal_rate_hz(table: FlightTable) -> float:
    """Frames per second of the camera: one over the median step, so lost frames do not lower it.

    Raises:
        InputError: the table has a single row.
    """
    if len(table.t) < 2:
        raise InputError(
            f"{table.name}: expected at least two rows to know the frame rate, got {len(table.t)}"
        )
    return float(1.0 / np.median(np.diff(table.t)))


def slice_time(table: FlightTable, t0: float, t1: float) -> FlightTable:
    """The rows with t0 <= t < t1, with their own time stamps.

    Args:
        table: the flight.
        t0: start [s].
        t1: end [s].

    Raises:
        InputError: no row lies in between.
    """
    rows = np.flatnonzero((table.t >= t0) & (table.t < t1))
    if len(rows) == 0:
        raise InputError(
            f"{table.name}: expected rows from {t0:g} to {t1:g} s, got a flight from {_time_range_text(table)}"
        )
    return _select_rows(table, rows)


def resample(table: FlightTable, rate_hz: float) -> FlightTable:
    """The flight on a uniform grid that starts at its first row; gaps stay gaps.

    Commands and words are held from the row before. Poses and other numbers are interpolated only
    between measured neighbours at most 1.5 nominal periods apart (angles the short way round),
    elsewhere they are nan.

    Args:
        table: the flight.
        rate_hz: rows per second of the grid, > 0.

    Returns:
        The resampled flight; angles in [-pi, pi).

    Raises:
        InputError: the rate is not positive or the grid would be absurdly long.
    """
    require_range("rate_hz", rate_hz, low=1e-6)
    _require_plausible_rows(table, table.duration * rate_hz)
    period = 1.0 / nominal_rate_hz(table)
    grid = table.t[0] + np.arange(int(table.duration * rate_hz + 1e-6) + 1) / rate_hz
    # A grid time that meets a row but for rounding, say of stamps to 10 us, is that row: a measured
    # pose beside a gap must not be lost.
    nearest = table.t[nearest_index(table.t, grid)]
    query = np.where(np.abs(nearest - grid) < 1e-3 * period, nearest, grid)
    held = np.searchsorted(table.t, query, side="right") - 1

    def column(values: Array, angle: bool = False) -> Array:
        return _interpolate(table.t, values, query, MAX_STEP * period, angle)

    return replace(
        _select_rows(table, held, grid),
        p_world=np.column_stack([column(values) for values in table.p_world.T]),
        attitude=np.column_stack([column(values, angle=True) for values in table.attitude.T]),
        extra={name: column(values) for name, values in table.extra.items()},
    )


def fill_missing_rows(table: FlightTable, rate_hz: float | None = None) -> FlightTable:
    """Insert rows without a pose where frames are missing, so that no step is longer than 1.5
    nominal periods.

    Inserted rows hold the command of the row before; measured rows keep their own time stamps.

    Args:
        table: the flight.
        rate_hz: the nominal frame rate; None for the table's own.

    Returns:
        The flight with the inserted rows, evenly spaced within each gap.

    Raises:
        InputError: the rate is not positive or absurdly many rows would be needed.
    """
    rate_hz = (
        nominal_rate_hz(table) if rate_hz is None else require_range("rate_hz", rate_hz, low=1e-6)
    )
    _require_plausible_rows(table, table.duration * rate_hz)
    periods = np.diff(table.t) * rate_hz
    copies = np.append(np.where(periods > MAX_STEP, np.rint(periods), 1.0).astype(np.int64), 1)
    first = np.concatenate([[0], np.cumsum(copies)[:-1]])
    row = np.repeat(np.arange(len(table.t)), copies)
    place_in_gap = np.arange(len(row)) - first[row]
    measured = place_in_gap == 0
    step = np.append(np.diff(table.t), 0.0) / copies
    return replace(
        _select_rows(table, row, table.t[row] + place_in_gap * step[row]),
        p_world=np.where(measured[:, None], table.p_world[row], np.nan),
        attitude=np.where(measured[:, None], table.attitude[row], np.nan),
        extra={
            name: np.where(measured, values[row], np.nan) for name, values in table.extra.items()
        },
    )


def split_by_time(
    table: FlightTable, test_share: float = 0.3, block_s: float = 10.0
) -> tuple[tuple[FlightTable, ...], tuple[FlightTable, ...]]:
    """Split a flight into blocks to fit on and blocks to judge on; always the same blocks, evenly
    spread.

    Neighbouring frames are nearly equal, so samples are never shuffled: whole blocks of time are
        held out. A flight
    too short for blocks of block_s gets shorter ones, so that both parts have at least one.

    Args:
        table: the flight.
        test_share: share of the time to hold out, above 0 and below 1.
        block_s: length of a block [s].

    Returns:
        Train blocks (adjoining ones merged) and test blocks, both in order of time.

    Raises:
        InputError: the share or the length is out of range, or the flight is too short or too full
            of holes.
    """
    share = require_range("test_share", test_share, low=0.01, high=0.99)
    require_range("block_s", block_s, low=1e-3)
    _require_plausible_rows(table, table.duration / block_s)
    blocks = max(
        round(table.duration / block_s), int(np.ceil(1.0 / min(share, 1.0 - share) - 1e-9))
    )
    counted = np.floor(np.arange(blocks + 1) * share + 0.5 + 1e-9)
    is_test = np.diff(counted) > 0.0
    block = np.minimum(
        ((table.t - table.t[0]) * blocks / max(table.duration, 1e-12)).astype(np.int64), blocks - 1
    )
    part = np.where(is_test[block], block, -1)
    starts = np.flatnonzero(np.diff(part, prepend=-2) != 0)
    segments = [np.arange(a, b) for a, b in zip(starts, [*starts[1:], len(part)], strict=True)]
    train = tuple(_select_rows(table, rows) for rows in segments if part[rows[0]] < 0)
    test = tuple(_select_rows(table, rows) for rows in segments if part[rows[0]] >= 0)
    if not train or not test or len(table.t) < 2 * blocks:
        raise InputError(
            f"{table.name}: too short to split: got {len(table.t)} rows over {table.duration:g} s"
        )
    return train, test


def nearest_index(t: Array, query: Array) -> NDArray[np.int64]:
    """Which of the times is nearest to each query; of two equally near ones the earlier.

    Args:
        t: (N,) increasing, at least one.
        query: (M,).

    Returns:
        (M,) indices into t.
    """
    right = np.minimum(np.searchsorted(t, query), len(t) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(query - t[left] <= t[right] - query, left, right)


def _require_seconds(table: FlightTable) -> None:
    """Refuse times that are those of a camera only if they are in a thousandth, millionth or
    billionth of a second.
    """
    if len(table.t) < MIN_ROWS:
        return
    step = float(np.median(np.diff(table.t)))
    for unit, of_a_second in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        if MIN_CAMERA_PERIOD_S <= step / of_a_second <= MAX_CAMERA_PERIOD_S:
            raise InputError(
                f"{table.name}: time looks like {unit}: expected seconds, got rows {step:g} apart; "
                f"divide the column t by {of_a_second:g}"
            )


def _select_rows(
    table: FlightTable, rows: NDArray[np.int64], t: Array | None = None
) -> FlightTable:
    """The given rows, at their own times or at new ones."""
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
    """Linear interpolation of (N,) values with nan holes; nan where the measured neighbours are too
    far apart.
    """
    measured = np.flatnonzero(np.isfinite(values))
    if len(measured) == 0:
        return np.full(len(query), np.nan)
    t, values = t[measured], values[measured]
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


def _label_rows(table: FlightTable, names: list[str]) -> Iterable[tuple[str, ...]]:
    return (
        zip(*(table.labels[name] for name in names), strict=True) if names else [()] * len(table.t)
    )


def _require_plausible_rows(table: FlightTable, rows: float) -> None:
    """Refuse a grid so long that the table cannot explain it."""
    most = MAX_GROWTH * (1000 + len(table.t))
    if not rows <= most:
        raise InputError(
            f"{table.name}: {_time_range_text(table)} in {len(table.t)} rows would become {rows:.3g} rows, more than {most}; "
            "a time stamp is wrong, or cut the flight with slice_time first"
        )


def _time_range_text(table: FlightTable) -> str:
    return f"{table.t[0]:g} to {table.t[-1]:g} s"
