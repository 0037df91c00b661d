"""Checks for public functions: a value -> the same value, or an InputError that says what to do."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class InputError(ValueError):
    """A file or an argument from the user is wrong: "name: expected X, got Y; do Z".

    The command line prints it as one sentence and exits with 2.
    """


def require_range(
    name: str, value: float, *, low: float = -math.inf, high: float = math.inf
) -> float:
    """Return the value as a float if it is finite and within [low, high].

    Raises:
        InputError: the value is not a finite number in the interval; the message starts with name.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected a number, got {value!r}") from None
    if not math.isfinite(number) or not low <= number <= high:
        raise InputError(f"{name}: expected a finite number in [{low:g}, {high:g}], got {value}")
    return number


def require_shape(name: str, array: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return the array as float64 if it has this shape; None in the shape is any length.

    Raises:
        InputError: the array is not numeric or has another shape; the message starts with name.
    """
    try:
        values = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: expected an array of numbers of shape {_shape_text(shape)}"
        ) from None
    has_shape = values.ndim == len(shape) and all(
        expected is None or expected == got
        for expected, got in zip(shape, values.shape, strict=True)
    )
    if not has_shape:
        raise InputError(
            f"{name}: expected shape {_shape_text(shape)}, got {_shape_text(values.shape)}"
        )
    return values


def require_file(path: str | Path) -> Path:
    """Return the path if it is a file.

    Raises:
        FileNotFoundError: nothing is at the path, or a folder.
    """
    file = Path(path)
    if not file.is_file():
        found = "a folder" if file.is_dir() else "nothing"
        raise FileNotFoundError(f"{file}: expected a file, found {found} there; check the path")
    return file


def _shape_text(shape: tuple[int | None, ...]) -> str:
    """A shape as a message shows it, such as "(any, 3)"."""
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"
