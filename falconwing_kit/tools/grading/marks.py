"""Marks: what a function returned, call by call -> a few numbers that two equal functions share.

A mark cannot be turned back into the answer. It is tolerant of rounding: the numbers of an answer
enter as asinh(v / SMALL), weighted by place, in one sum. Shapes, texts, truth values and the places
of NaN and infinity enter as a checksum.
"""

import math
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

SMALL = 1e-5  # below it an absolute difference counts, above it a relative one
CLOSE, CLOSE_SHARE = 2e-4, 1e-6  # two sums agree within CLOSE + CLOSE_SHARE * spread
LAST_PART = 7
UNSTABLE = "*"
PLAIN = (float, int, np.float64)  # types of single numbers, which need no array: most answers
WHOLE = 1 << 63  # a whole number beyond it is none of NumPy's


@dataclass(frozen=True)
class Mark:
    """The mark of one answer, or of several calls together.

    Attributes:
        form: checksum of everything but the numbers.
        total: weighted sum of the numbers.
        spread: root of the sum of their squares, which bounds what rounding does to `total`.
    """

    form: int
    total: float = 0.0
    spread: float = 0.0

    def agrees(self, other: "Mark") -> bool:
        """Whether two marks are of the same answers, up to rounding."""
        limit = CLOSE + CLOSE_SHARE * max(self.spread, other.spread)
        return self.form == other.form and abs(self.total - other.total) <= limit


def is_plain(value: Any) -> bool:
    """Whether a value is a single number of an ordinary type and size."""
    return type(value) in PLAIN and (type(value) is not int or -WHOLE < value < WHOLE)


@lru_cache(maxsize=4096)
def weights(count: int, first: int = 0) -> Any:
    """Fixed weights between 0.5 and 1.5, the same on every platform: (count,), read only."""
    place = np.arange(first + 1, first + count + 1, dtype=np.uint64)
    mixed = (place * np.uint64(2654435761)) % np.uint64(2**32)
    mixed = ((mixed ^ (mixed >> np.uint64(15))) * np.uint64(2246822519)) % np.uint64(2**32)
    found = mixed.astype(float) / 2.0**32 + 0.5
    found.setflags(write=False)
    return found


def mark_of(answer: Any) -> Mark:
    """The mark of an answer: numbers, arrays, texts, and tuples, lists and dicts of them."""
    texts: list[str] = []
    arrays: list[Any] = []
    pieces: list[Any] = []
    _add_pieces(pieces, answer)
    for piece in pieces:
        if isinstance(piece, str):
            texts.append(piece)
        elif isinstance(piece, float):
            texts.append("()")
            arrays.append((piece,))
        else:
            texts.append(_form(piece))
            arrays.append(np.where(np.isfinite(piece), piece, 0.0).ravel())
    values = np.arcsinh(np.concatenate(arrays) / SMALL) if arrays else np.zeros(0)
    weighted = weights(len(values)) * values
    form = zlib.crc32("|".join(texts).encode())
    return Mark(form, float(weighted.sum()), float(np.sqrt((weighted**2).sum())))


def raised_mark(name: str) -> Mark:
    """The mark of an error, by its type's name."""
    return Mark(zlib.crc32(f"raised {name}".encode()))


def _add_pieces(found: list[Any], value: Any) -> None:
    """Texts, finite numbers and float arrays, in order."""
    if is_plain(value) and math.isfinite(value):
        found.append(float(value))
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            found.append(f"{key}:")
            _add_pieces(found, value[key])
    elif isinstance(value, tuple | list):
        found.append(f"({len(value)}")
        for each in value:
            _add_pieces(found, each)
    elif isinstance(value, str | bool | np.bool_) or value is None:
        found.append(str(value))
    else:
        found.append(_array(value))


def _array(value: Any) -> Any:
    with suppress(Exception):
        array = np.asarray(value)
        if array.dtype.kind == "b":
            bits = np.packbits(array.ravel()).tobytes()
            return f"{array.shape} {zlib.crc32(bits)}"
        if array.dtype.kind in "iuf":
            return array.astype(float)
        if array.dtype.kind == "c":
            return "complex"
    return type(value).__name__


def _form(array: Any) -> str:
    if np.isfinite(array).all():
        return str(array.shape)
    state = np.where(np.isnan(array), 1, np.where(np.isinf(array), np.sign(array) + 3, 0))
    return f"{array.shape} {zlib.crc32(state.astype(np.uint8).tobytes())}"


def trace_of(marks: Sequence[Mark]) -> tuple[Mark, ...]:
    """Marks of all calls in order, joined: call 0, 1, 2 to 3, 4 to 7, ...; at most LAST_PART + 1.

    Later calls are joined more, so that a trace is short however many calls there are.
    """
    parts: dict[int, list[tuple[int, Mark]]] = {}
    for i, mark in enumerate(marks):
        parts.setdefault(min(i.bit_length(), LAST_PART), []).append((i, mark))
    joined = []
    for members in parts.values():
        factors = [float(weights(1, i)[0]) for i, _ in members]
        total = sum(k * mark.total for k, (_, mark) in zip(factors, members, strict=True))
        spread = sum((k * mark.spread) ** 2 for k, (_, mark) in zip(factors, members, strict=True))
        form = zlib.crc32(" ".join(str(mark.form) for _, mark in members).encode())
        joined.append(Mark(form & 0xFFFF, total, spread**0.5))
    return tuple(joined)


def trace_text(trace: Sequence[Mark], again: Sequence[Mark]) -> str:
    """A trace as one text for `hints.json`.

    Args:
        trace: of a function.
        again: of the same function on arguments that differ by rounding; parts that differ from it
            are no fingerprint (a wrong formula may take the singular vectors of equal singular
            values) and are stored as UNSTABLE.
    """
    pairs = [
        (part, i < len(again) and part.agrees(again[i]) and len(trace) == len(again))
        for i, part in enumerate(trace)
    ]
    return " ".join(f"{p.form:04x}{p.total:.4f}" if stable else UNSTABLE for p, stable in pairs)


def matches_text(trace: Sequence[Mark], text: str) -> bool:
    """Whether a trace is the stored one, in all its stable parts, of which there must be one."""
    parts = text.split(" ") if text else []
    stable = [(mine, part) for mine, part in zip(trace, parts, strict=False) if part != UNSTABLE]
    if len(parts) != len(trace) or not stable:
        return False
    return all(mine.agrees(Mark(int(p[:4], 16), float(p[4:]), 0.0)) for mine, p in stable)
