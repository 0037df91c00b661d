"""Autopilot series: messages of one kind in an autopilot's log -> columns over time, and poses in
north-east-down axes.
"""

import io
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError

MAX_FILE_BYTES = 1024**3
MAX_TIME_US = 1e15  # thirty years
EXTRA_COMMAND = 'pip install "falconwing-kit[logs]"'


@dataclass(frozen=True, eq=False)
class Series:
    """All messages of one kind."""

    t: NDArray[np.int64]  # (N,) time since the autopilot's start [ns]
    columns: Mapping[str, NDArray[Any]]  # (N,) each, by field


@dataclass(frozen=True, eq=False)
class NedPoses:
    """Poses as an autopilot estimates them: north-east-down, body x nose, y right, z belly."""

    t: NDArray[np.int64]  # (N,) [ns]
    p_ned: Array  # (N, 3) [m], nan where not valid
    R_ned_body: Array  # (N, 3, 3)
    v_ned: Array  # (N, 3) [m/s]


def import_reader(module: str, kind: str) -> Any:
    """A library of the extra `logs`; InputError with the command that installs it."""
    try:
        return import_module(module)
    except ImportError:
        library = module.partition(".")[0]
        raise InputError(
            f"{kind}: expected the library {library}, which is not installed; `{EXTRA_COMMAND}`"
        ) from None


def increasing(t_us: NDArray[Any], columns: Mapping[str, NDArray[Any]]) -> Series:
    """A series in which time increases; records whose time does not are left out.

    Args:
        t_us: (N,) times in the log [us], of any kind of number.
        columns: (N,) each, by field.
    """
    possible = np.flatnonzero((t_us >= 0) & (t_us < MAX_TIME_US))
    t = t_us[possible].astype(np.int64) * 1000
    later = np.diff(np.maximum.accumulate(t), prepend=-1) > 0
    rows = possible[later]
    return Series(t[later], {name: values[rows] for name, values in columns.items()})


@contextmanager
def quiet() -> Iterator[None]:
    """Nothing is printed meanwhile: readers, also in C, print a line for each damaged byte."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def stack(name: str, topic: str, series: Series, fields: tuple[str, ...]) -> Array:
    """Fields of a series as columns (N, k); InputError where one is missing."""
    missing = [field for field in fields if field not in series.columns]
    if missing:
        raise InputError(
            f"{name}: {topic}: expected the field {missing[0]}, got a log of another version "
            f"with {', '.join(list(series.columns)[:16])}"
        )
    return np.column_stack([np.asarray(series.columns[f], np.float64) for f in fields])
