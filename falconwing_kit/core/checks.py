"""Checks at the door of a room: a value comes in, the same value or one clear sentence goes out."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class InputError(ValueError):
    """A file or an argument the user gave is wrong; the text says what was wanted, what came and
    what to do.

    The command line prints it as one sentence and exits with 2.
    """


def require_range(
    name: str, value: float, *, low: float = -math.inf, high: float = math.inf
) -> float:
    """Return the value if it is finite and within [low, high].

    Args:
        name: what the value is called in the message.
        value: the number to check, in the unit of its bounds.
        low: smallest allowed value.
        high: largest allowed value.

    Returns:
        The value as a float.

    Raises:
        InputError: the value is not a finite number in the interval.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected a number, got {value!r}") from None
    if not math.isfinite(number) or not low <= number <= high:
        raise InputError(f"{name}: expected a finite number in [{low:g}, {high:g}], got {value}")
    return number


def require_shape(name: str, array: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return the array as float64 if its shape fits; None in the shape stands for any length.

    Args:
        name: what the array is called in the message.
        array: the numbers to check.
        shape: wanted length of each axis.

    Returns:
        The array as float64.

    Raises:
        InputError: the array is not numeric or has another shape.
    """
    try:
        values = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: expected an array of numbers of shape {_shape_text(shape)}"
        ) from None
    fits = values.ndim == len(shape) and all(
        want is None or want == got for want, got in zip(shape, values.shape, strict=True)
    )
    if not fits:
        raise InputError(
            f"{name}: expected shape {_shape_text(shape)}, got {_shape_text(values.shape)}"
        )
    return values


def require_file(path: str | Path) -> Path:
    """Return the path if a readable file is there.

    Raises:
        FileNotFoundError: nothing is at the path, or it is a folder.
    """
    found = Path(path)
    if not found.is_file():
        kind = "a folder" if found.is_dir() else "nothing"
        raise FileNotFoundError(f"{found}: expected a file, found {kind} there; check the path")
    return found


def _shape_text(shape: tuple[int | None, ...]) -> str:
    inner = ", ".join("any" if n is None else str(n) for n in shape)
    return f"({inner})"
