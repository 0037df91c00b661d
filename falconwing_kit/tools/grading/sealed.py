"""Sealed mistakes: a mistake's trace and words -> a text that only the same trace opens.

A list of all mistakes of an exercise, in words, would describe its solution. So `hints.json` holds
each under a key that is derived from the trace, in cells of a grid: whose function makes the
mistake has the key, and nobody else can read it without making it. A trace near a cell's edge tries
the neighbouring cells too.
"""

import base64
import hashlib
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from falconwing_kit.tools.grading.marks import CLOSE, CLOSE_SHARE, UNSTABLE, Mark
from falconwing_kit.tools.grading.mistakes import HINTS

GRID, DIGIT = 0.01, 1e-4  # a cell of a trace's totals; what is stored inside it
MOST_CELLS = 256
LISTED = "listed"  # kind of a mistake that is listed by hand and that no mutation makes
KINDS = (*sorted(HINTS), LISTED)
_BETWEEN = "\x1f"
Sealed = Mapping[str, Mapping[str, str]]  # which parts are stable -> lookup -> sealed texts


@dataclass(frozen=True)
class Words:
    """What is said of a mistake.

    Attributes:
        name, kind, place: what is wrong, of which kind, in which line of the computation.
        alternatives: names of other mistakes of the kind that the checks cannot tell from it.
    """

    name: str
    kind: str
    place: str
    alternatives: tuple[str, ...] = ()


def seal(traces: Sequence[tuple[str, Words]]) -> dict[str, dict[str, str]]:
    """All mistakes of an exercise, sealed.

    Args:
        traces: stored text of the trace, or checksum of errors, which begins with "!", and words.
    """
    found: dict[str, dict[str, str]] = {}
    for text, words in traces:
        shape, cells, inside = _of_text(text)
        ending = f" in {words.place}"  # the comma before it stays
        short = words.name.removesuffix(ending) if words.place else words.name
        kind = str(KINDS.index(words.kind))
        content = _BETWEEN.join((inside, kind, words.place, short, *words.alternatives))
        lookup, box = _locked(shape, cells, content)
        boxes = found.setdefault(shape, {})
        boxes[lookup] = f"{boxes[lookup]} {box}" if lookup in boxes else box
    return {shape: dict(sorted(boxes.items())) for shape, boxes in sorted(found.items())}


def opened(sealed: Sealed, trace: Sequence[Mark], errors: str) -> list[Words]:
    """The mistakes that a trace, or a checksum of errors, opens.

    Args:
        sealed: of an exercise.
        trace: of a wrong function.
        errors: checksum of its errors, if it only raised; else empty.
    """
    found = []
    for shape, boxes in sealed.items():
        if shape == "!":
            found += [words for _, words in _open(boxes, shape, (errors,))] if errors else []
        elif len(shape) == len(trace) and "o" in shape:
            parts = [part for part, state in zip(trace, shape, strict=True) if state == "o"]
            for cells in _cells_near(parts):
                texts = tuple(f"{p.form:04x}{c}" for p, c in zip(parts, cells, strict=True))
                for inside, words in _open(boxes, shape, texts):
                    if _is_inside(parts, cells, inside):
                        found.append(words)
    return found


def _of_text(text: str) -> tuple[str, tuple[str, ...], str]:
    """Of a stored trace which parts are stable, their cells, and the places inside the cells."""
    if text.startswith("!"):
        return "!", (text,), ""
    cells, inside = [], ""
    shape = "".join("x" if part == UNSTABLE else "o" for part in text.split(" "))
    for part in text.split(" "):
        if part != UNSTABLE:
            total = float(part[4:])
            cell = round(total / GRID)
            cells.append(f"{part[:4]}{cell}")
            inside += f"{round((total - cell * GRID) / DIGIT) + 50:02x}"
    return shape, tuple(cells), inside


def _limit(part: Mark) -> float:
    return CLOSE + CLOSE_SHARE * part.spread


def _cells_near(parts: Sequence[Mark]) -> Iterator[tuple[int, ...]]:
    """The cells in which the stored totals may lie."""
    options = []
    for part in parts:
        if not math.isfinite(part.total):
            return
        first = round((part.total - _limit(part)) / GRID)
        last = round((part.total + _limit(part)) / GRID)
        options.append(range(first, last + 1))
    if math.prod(map(len, options)) <= MOST_CELLS:
        yield from itertools.product(*options)


def _is_inside(parts: Sequence[Mark], cells: Sequence[int], inside: str) -> bool:
    if len(inside) != 2 * len(parts):
        return False
    totals = [
        cell * GRID + (int(inside[2 * i : 2 * i + 2], 16) - 50) * DIGIT
        for i, cell in enumerate(cells)
    ]
    return all(abs(p.total - t) <= _limit(p) for p, t in zip(parts, totals, strict=True))


def _locked(shape: str, cells: Sequence[str], content: str) -> tuple[str, str]:
    data = content.encode()
    lookup, stream = _keys(shape, cells, len(data))
    return lookup, base64.b64encode(
        bytes(a ^ b for a, b in zip(data, stream, strict=True))
    ).decode()


def _keys(shape: str, cells: Sequence[str], length: int) -> tuple[str, bytes]:
    secret = "|".join((shape, *cells)).encode()
    lookup = hashlib.sha256(b"lookup " + secret).hexdigest()[:8]
    return lookup, hashlib.shake_256(b"text " + secret).digest(length)


def _open(
    boxes: Mapping[str, str], shape: str, cells: tuple[str, ...]
) -> Iterator[tuple[str, Words]]:
    lookup, _ = _keys(shape, cells, 0)
    for box in boxes.get(lookup, "").split():
        with suppress(ValueError, IndexError):  # another trace's box under the same lookup
            data = base64.b64decode(box)
            _, stream = _keys(shape, cells, len(data))
            text = bytes(a ^ b for a, b in zip(data, stream, strict=True)).decode()
            inside, kind, place, short, *others = text.split(_BETWEEN)
            name = f"{short} in {place}" if short.endswith(",") else short
            yield inside, Words(name, KINDS[int(kind)], place, tuple(others))
