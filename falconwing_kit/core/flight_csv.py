"""Flight CSV: a text file that anybody may have written -> checked columns, or one sentence that
says what is wrong.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import short_name
from falconwing_kit.core.messages import COMMAND_NAMES

POSE_COLUMNS = ("px", "py", "pz", "roll", "pitch", "yaw")
REQUIRED_COLUMNS = ("t", *POSE_COLUMNS, *COMMAND_NAMES)
OPTIONAL_COLUMNS = ("vx", "vy", "vz", "p", "q", "r", "airspeed", "sigma_position", "sigma_attitude")
LABEL_COLUMN = "source"
MAX_FILE_BYTES = 512 * 1024**2  # about 80 hours at 20 Hz
MAX_LINE_BYTES = 64 * 1024
MAX_BAD_ROWS = (
    3  # this many rows, or one in a hundred, may have a bad time stamp before the file is refused
)
MAX_COMMAND_EXCESS = 0.1  # a command this far outside its range is not rounding but another unit
# single outliers are allowed; when this share of the angles is too large the unit is wrong
MAX_OUTLIER_SHARE = 0.05


@dataclass(frozen=True)
class _Cells:
    """What the lines held, before anything is judged."""

    numbers: dict[str, Array]  # known numeric columns, (N,) each
    words: dict[str, list[str]]  # all other columns
    lines: NDArray[np.int64]  # (N,) line number in the file, for messages
    warnings: list[str]


def read_flight_csv(path: str | Path) -> dict[str, Any]:
    """Read a flight table's file and check every cell; `read_flight_table` is the door to it.

    Args:
        path: the CSV file.

    Returns:
        The fields of a FlightTable by name.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file cannot be used as it is.
    """
    path = require_file(path)
    name = short_name(path)
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise InputError(
            f"{name}: expected a flight table of at most {MAX_FILE_BYTES >> 20} MiB, got {size >> 20} MiB"
        )
    with path.open("rb") as file:
        cells = _read_cells(name, file, _read_header(name, file))
    warnings = cells.warnings
    extra, labels = _sort_unknown_columns(cells, warnings)
    _check_finite(name, cells, extra, warnings)
    keep = _increasing_rows(name, cells.numbers["t"], cells.lines, warnings)
    numbers = {column: values[keep] for column, values in cells.numbers.items()}
    pose = _poses(name, numbers, warnings)
    return {
        "name": name,
        "t": numbers["t"],
        "p_world": pose[:, :3],
        "attitude": pose[:, 3:],
        "commands": _commands(name, numbers, cells.lines[keep], warnings),
        "extra": {column: values[keep] for column, values in extra.items()},
        "labels": {column: tuple(words[row] for row in keep) for column, words in labels.items()},
        "warnings": tuple(f"{name}: {sentence}" for sentence in warnings),
    }


def _lines(name: str, file: BinaryIO) -> Iterator[bytes]:
    """The lines as they stand in the file, none of them too long to be a row."""
    while line := file.readline(MAX_LINE_BYTES + 1):
        if len(line) > MAX_LINE_BYTES or b"\0" in line:
            raise InputError(
                f"{name}: expected lines of numbers and commas, got binary data or an endless line; is it a CSV file?"
            )
        yield line


def _decode(name: str, line: bytes, number: int) -> str:
    try:
        return line.decode("utf-8-sig" if number == 1 else "utf-8").strip("\r\n")
    except UnicodeDecodeError:
        raise InputError(
            f"{name}: line {number} is not UTF-8 text; save the table as UTF-8 CSV"
        ) from None


def _read_header(name: str, file: BinaryIO) -> list[str]:
    """Column names in the order of the file."""
    raw = next(_lines(name, file), b"")
    first = _decode(name, raw, 1)
    if not first.strip():
        raise InputError(
            f"{name}: expected a header line t,px,py,..., got an empty {'line' if raw else 'file'}"
        )
    for mark, word in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
        if "," not in first and mark in first.strip():
            raise InputError(
                f"{name}: columns are separated by {word}, expected commas; export the table again"
            )
    columns = [
        column.strip().strip('"') or f"column_{place}"
        for place, column in enumerate(first.split(","), start=1)
    ]
    repeated = (
        sorted({column for column in columns if columns.count(column) > 1})
        if len(columns) < 1000
        else []
    )
    if len(set(columns)) < len(columns):
        raise InputError(
            f"{name}: expected each column once, got {_name_list(repeated or columns)} more than once"
        )
    missing = [column for column in REQUIRED_COLUMNS if column not in columns]
    if missing:
        raise InputError(
            f"{name}: missing column {_name_list(missing)}; the header has {_name_list(columns)}"
        )
    return columns


def _read_cells(name: str, file: BinaryIO, columns: list[str]) -> _Cells:
    """All rows, numbers apart from words."""
    numeric = [
        place
        for place, column in enumerate(columns)
        if column in REQUIRED_COLUMNS + OPTIONAL_COLUMNS
    ]
    others = [place for place, column in enumerate(columns) if place not in numeric]
    flat, lines, warnings = array("d"), array("q"), list[str]()
    words: dict[str, list[str]] = {columns[place]: [] for place in others}
    seen: dict[str, str] = {}  # each different word is kept once
    for number, raw in enumerate(_lines(name, file), start=2):
        if not raw.strip():
            continue
        try:
            row = _decode(name, raw, number).split(",")
            numbers = _row_of_numbers(name, number, row, columns, numeric)
            cut = raw.endswith(b",")  # only the last line can end without a line end
        except InputError:
            cut = not raw.endswith(b"\n")
            if not cut:
                raise
        if cut:
            warnings.append(f"the last line ({number}) is cut off and was dropped")
            break
        flat.extend(numbers)
        lines.append(number)
        for place in others:
            word = row[place].strip()
            words[columns[place]].append(seen.setdefault(word, word))
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
            f"{name}: line {line} has {len(row)} cells, expected {len(columns)} as in the header"
        )
    try:
        return [float(row[place]) for place in numeric]
    except ValueError:
        for place in numeric:
            if row[place].strip() and not _is_number(row[place]):
                raise InputError(
                    f"{name}: line {line}, column {columns[place]}: expected a number or nan, got {row[place][:40]!r}"
                ) from None
        return [float(row[place]) if row[place].strip() else np.nan for place in numeric]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _sort_unknown_columns(
    cells: _Cells, warnings: list[str]
) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Numeric columns beside the required ones, and columns of words; unknown ones are kept and
    named.
    """
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
    for column in REQUIRED_COLUMNS:
        infinite = np.isinf(cells.numbers[column])
        if infinite.any():
            line = cells.lines[np.argmax(infinite)]
            raise InputError(
                f"{name}: line {line}, column {column}: expected a finite number or nan, got infinity"
            )
    for column, values in extra.items():
        if np.isinf(values).any():
            extra[column] = np.where(np.isinf(values), np.nan, values)
            warnings.append(f"infinite values in column {column} are taken as nan")


def _increasing_rows(
    name: str, t: Array, lines: NDArray[np.int64], warnings: list[str]
) -> NDArray[np.int64]:
    """Rows whose time is later than that of every row before."""
    latest = np.fmax.accumulate(np.concatenate([[-np.inf], t]))[:-1]
    good = t > latest
    bad = np.flatnonzero(~good)
    if len(bad) > max(MAX_BAD_ROWS, len(t) // 100) or not good.any():
        row = bad[0]
        raise InputError(
            f"{name}: time must increase from row to row, but {len(bad)} of {len(t)} rows stand still, go back or have "
            f"no time, first line {lines[row]}: t = {t[row]:g} after {latest[row]:g}; sort the rows or cut the file"
        )
    if len(bad):
        warnings.append(
            f"rows dropped because time did not increase: {len(bad)}, the first in line {lines[bad[0]]}"
        )
    return np.flatnonzero(good)


def _poses(name: str, numbers: dict[str, Array], warnings: list[str]) -> Array:
    """Poses (N, 6), a row all nan where it is incomplete."""
    pose = np.column_stack([numbers[column] for column in POSE_COLUMNS])
    measured = np.isfinite(pose)
    partial = measured.any(axis=1) & ~measured.all(axis=1)
    if partial.any():
        warnings.append(
            f"rows with only part of a pose, taken as rows without one: {partial.sum()}"
        )
        pose[partial] = np.nan
    if np.isnan(pose).all():
        warnings.append("no row has a pose")
    else:
        _check_radians(name, pose[np.isfinite(pose[:, 0]), 3:], warnings)
    return pose


def _check_radians(name: str, attitude: Array, warnings: list[str]) -> None:
    """Refuse degrees; an unwrapped yaw may pass many turns, but it starts within one."""
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
            f"{name}: roll, pitch or yaw reach {largest:.3g}, which looks like degrees; convert to radians"
        )
    if yaw_excess.mean() > MAX_OUTLIER_SHARE:
        warnings.append(
            "yaw goes on beyond two turns and is taken as unwrapped; if it is in degrees convert it first"
        )


def _commands(
    name: str, numbers: dict[str, Array], lines: NDArray[np.int64], warnings: list[str]
) -> Array:
    """Commands of every row: held where one is missing, cut where one is barely out of range."""
    filled = []
    for column, low in (("throttle", 0.0), ("aileron", -1.0), ("elevator", -1.0), ("rudder", -1.0)):
        values = numbers[column]
        known = np.isfinite(values)
        if not known[0]:
            raise InputError(
                f"{name}: line {lines[0]}, column {column}: the first row must have a command, got nan"
            )
        if not known.all():
            warnings.append(f"rows without {column}, held from the row before: {(~known).sum()}")
            values = values[np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))]
        excess = np.maximum(values - 1.0, low - values)
        worst = int(np.argmax(excess))
        if excess[worst] > MAX_COMMAND_EXCESS:
            raise InputError(
                f"{name}: line {lines[worst]}: expected {column} in {low:g}..1, got {values[worst]:g}: looks like "
                "microseconds, percent or a throttle of -1..1; convert it first"
            )
        if excess[worst] > 0.0:
            warnings.append(
                f"rows with {column} slightly outside {low:g}..1, which was cut: {(excess > 0.0).sum()}"
            )
        filled.append(np.clip(values, low, 1.0))
    return np.column_stack(filled)


def _name_list(names: list[str], most: int = 12) -> str:
    """Names in one line, not endless."""
    shown = ", ".join(name[:40] for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"
