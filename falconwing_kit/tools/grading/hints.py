"""Hints: what a function returned in the public checks -> the mistake that returns the same.

A lab's `hints.json`, written by `falconwing labs hints`, holds the right answers of some calls and,
for each mistake of a library, its name and the mark of what it returns in all calls: no code, and
no number from which a solution could be read. The library: hints_library.py and mistakes.py.
"""

import copy
import hashlib
import json
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.tools.grading.lab import Function
from falconwing_kit.tools.grading.marks import (
    Mark,
    is_plain,
    mark_of,
    matches_text,
    raised_mark,
    trace_of,
    weights,
)
from falconwing_kit.tools.grading.mistakes import FIXES, HINTS
from falconwing_kit.tools.grading.sandbox.host import ERRORS, StudentError
from falconwing_kit.tools.grading.sealed import Sealed, Words, opened

FILE = "hints.json"
PLACES = 24  # numbers of one answer that are stored, spread evenly over it
NEARBY, NEAR_SCALES = 8, (0.1, 0.8)  # calls that are varied, and by how much
RTOL, ATOL = 1e-5, 1e-9  # stored numbers have seven digits
ROUNDING = 1e-12  # far below what any check accepts as equal
Numbers = dict[str, Any]  # place in the answer -> number, text or truth value


class Answer(Numbers):
    """The shown numbers of an answer; `mark` is that of the whole answer.

    `message` is an error's own text, which the sandbox does not let out.
    """

    mark: Mark = Mark(0)
    message: str = ""


@dataclass
class Recorder:
    """A function that records what it is called with and returns.

    Attributes:
        function: any.
        calls: key of the arguments and answer, in order; an error's answer is its type's name.
    """

    function: Function
    calls: list[tuple[str, Answer]] = field(default_factory=list)

    def __call__(self, *arguments: Any) -> Any:
        """The function's answer, or its error, recorded."""
        key = call_key(arguments)
        try:
            answer = self.function(*arguments)
        except Exception as error:
            self.calls.append((key, raised(error)))
            raise
        self.calls.append((key, answered(answer)))
        return answer


def answered(answer: Any) -> Answer:
    """The record of an answer."""
    record = Answer(numbers_of(answer))
    record.mark = mark_of(answer)
    return record


def raised(error: Exception) -> Answer:
    """The record of an error: its type's name, the same in a notebook and in the sandbox."""
    name = type(error).__name__
    if isinstance(error, StudentError):
        name = error.category.removeprefix("exception:")
    record = Answer({"raised": name if name in ERRORS else "Exception"})
    record.mark = raised_mark(record["raised"])
    record.message = "" if isinstance(error, StudentError) else _message(error)
    return record


def _message(error: Exception) -> str:
    """An error's text; of a name without a value the name alone: Python changes its words."""
    text = " ".join(str(error).split())[:300]
    if isinstance(error, NameError) and (quoted := re.search(r"'(\w+)'", text)):
        return f"no value: {quoted[1]}"
    return text


def errors_text(calls: Sequence[tuple[str, Answer]]) -> str:
    """Checksum of the errors of calls that all raised, for `hints.json`; empty otherwise.

    An error's text differs between versions of Python and NumPy; then it matches nothing.
    """
    if not calls or not all(got.message for _, got in calls):
        return ""
    texts = [f"{got['raised']}: {got.message}" for _, got in calls]
    return f"!{zlib.crc32('|'.join(texts).encode()):08x}"


def copied(value: Any) -> Any:
    """A deep copy, quick for what most functions take."""
    if value is None or type(value) in (float, int, bool, str, np.float64):
        return value
    if type(value) is np.ndarray and not value.dtype.hasobject:
        return value.copy(order="K")
    if type(value) in (tuple, list):
        return type(value)(map(copied, value))
    if type(value) is dict:
        return {key: copied(each) for key, each in value.items()}
    return copy.deepcopy(value)


class Nearby:
    """Arguments near those of a function's calls, on which a wrong function is asked once more.

    The public checks ask few questions, often round numbers; different mistakes may answer them
    alike. Nothing is random: the same calls give the same arguments on every platform.
    """

    def __init__(self) -> None:
        self.taken: list[tuple[Any, ...]] = []

    def take(self, arguments: tuple[Any, ...]) -> None:
        """Keep a copy of a call's arguments, of the first NEARBY calls."""
        if len(self.taken) < NEARBY:
            with suppress(Exception):  # what cannot be copied is not asked again
                self.taken.append(copied(arguments))

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        for i, arguments in enumerate(self.taken):
            for scale in NEAR_SCALES:
                shift = _Shift(scale, i)
                yield tuple(map(shift.of, copied(arguments)))


@dataclass
class _Shift:
    """Values moved by up to `scale`, each by another share."""

    scale: float
    number: int

    def of(self, value: Any) -> Any:
        if isinstance(value, float | np.floating):
            return value * (1.0 + float(self._shares(1)[0])) + 0.1 * self.scale * self._sign()
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            shares = self._shares(value.size).reshape(value.shape)
            return (value * (1.0 + shares)).astype(value.dtype)
        if isinstance(value, np.ndarray) and value.dtype.kind in "iu" and value.size > 1:
            return self._whole(value)
        if isinstance(value, dict):
            return {key: self.of(each) for key, each in value.items()}
        if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
            return type(value)(map(self.of, value))
        return value

    def _whole(self, value: Any) -> Any:
        """Whole numbers, kept whole: of a row its steps are moved, so that times stay in order."""
        limits = np.iinfo(value.dtype)
        shares = 1.0 + self._shares(value.size).reshape(value.shape)
        if value.ndim == 1:
            steps = np.diff(value.astype(float), prepend=0.0)
            moved = np.cumsum(np.round(steps * shares))
        else:
            moved = np.round(value * shares)
        return np.clip(moved, limits.min, limits.max).astype(value.dtype)

    def _shares(self, count: int) -> Any:
        self.number += 1
        return 2.0 * self.scale * (weights(count, 7919 * self.number) - 1.0)

    def _sign(self) -> float:
        return 1.0 if self.number % 2 else -1.0


def call_key(arguments: tuple[Any, ...]) -> str:
    """Short name of a call's arguments: their structure and numbers to six digits."""
    found: list[str] = []
    _add_texts(found, arguments)
    return hashlib.sha256("|".join(found).encode()).hexdigest()[:12]


def _add_texts(found: list[str], value: Any) -> None:
    if is_plain(value):
        found += ("()", f"{value:.6g}")
    elif isinstance(value, Mapping):
        for name in value:
            found.append(str(name))
            _add_texts(found, value[name])
    elif isinstance(value, tuple | list):
        found.append(f"{len(value)}")
        for each in value:
            _add_texts(found, each)
    elif isinstance(value, bool | int | float | np.ndarray | np.generic):
        array = np.asarray(value)
        found.append(f"{array.shape}")
        found += (f"{x:.6g}" if array.dtype.kind in "iuf" else str(x) for x in array.ravel())
    else:
        found.append(value if isinstance(value, str) else type(value).__name__)


def numbers_of(answer: Any, name: str = "") -> Numbers:
    """An answer as a flat record: place, such as "[1][0, 2]", to number, text or truth value."""
    if is_plain(answer):
        return {f"{name}shape": "()", name: float(f"{answer:.7g}")}
    if isinstance(answer, Mapping):
        return _joined((numbers_of(answer[key], f"{name}[{key!r}]")) for key in answer)
    if isinstance(answer, tuple | list) and not _is_row(answer):
        found = _joined(numbers_of(each, f"{name}[{i}]") for i, each in enumerate(answer))
        return {f"{name}length": len(answer)} | found
    if isinstance(answer, str | bool | np.bool_) or answer is None:
        return {name: answer if isinstance(answer, str) else str(answer)}
    with suppress(Exception):
        array = np.asarray(answer)
        if array.dtype.kind == "c":
            return {f"{name}dtype": "complex"}
        if array.dtype.kind in "biuf":
            return {f"{name}shape": str(array.shape)} | _places(array, name)
    return {name: type(answer).__name__}


def _is_row(answer: Any) -> bool:
    return len(answer) > PLACES and all(isinstance(each, int | float) for each in answer)


def _joined(parts: Any) -> Numbers:
    found: Numbers = {}
    for part in parts:
        found |= part
    return found if len(found) <= 4 * PLACES else dict(list(found.items())[: 4 * PLACES])


def _places(array: Any, name: str) -> Numbers:
    picked = np.unique(np.linspace(0, array.size - 1, min(array.size, PLACES)).astype(int))
    found = {}
    for flat in picked if array.size else ():
        index = np.unravel_index(flat, array.shape)
        place = f"{name}[{', '.join(str(int(i)) for i in index)}]" if index else name
        value = array[index]
        found[place] = str(value) if array.dtype.kind == "b" else float(f"{float(value):.7g}")
    return found


def same(got: Any, expected: Any) -> bool:
    """Whether two stored values agree; NaN agrees with NaN."""
    if isinstance(got, str) or isinstance(expected, str):
        return bool(got == expected)
    if math.isnan(got) or math.isnan(expected):
        return math.isnan(got) and math.isnan(expected)
    return got == expected or abs(got - expected) <= ATOL + RTOL * abs(expected)


def same_numbers(got: Numbers, expected: Numbers) -> bool:
    """Whether two answers agree at every stored place."""
    return got.keys() == expected.keys() and all(same(got[k], expected[k]) for k in expected)


@dataclass(frozen=True)
class Diagnosis:
    """What a wrong function's answers show.

    Attributes:
        cause: the mistake in words; empty where nothing specific agrees.
        mistakes: names of the mistakes that return the same; empty for a general finding.
        steps: what to say first, second and last: where to look, what to ask oneself with the
            cause, what to change; empty without a cause.
    """

    cause: str = ""
    mistakes: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()


def _steps(words: Words) -> tuple[str, ...]:
    """Nudge, cause and fix."""
    where = f"look at {words.place}" if words.place else "go through your function line by line"
    question = HINTS.get(words.kind, "compare what each line does with the text")
    cause = "; or: ".join((words.name, *words.alternatives))
    return f"{where}: {question}", cause, FIXES.get(words.kind, "")


@dataclass(frozen=True)
class Hints:
    """Stored answers of one exercise.

    Attributes:
        expected: answers of a right function, by the key of the call, of the most telling calls.
        trace: marks of a right function's answers.
        mistakes: the library's, sealed.
    """

    expected: Mapping[str, Numbers]
    trace: str = ""
    mistakes: Sealed = field(default_factory=dict)

    def first_difference(self, key: str, got: Numbers) -> str:
        """The first place where an answer is wrong, expected beside got; empty if none is known."""
        expected = self.expected.get(key)
        if expected is None or same_numbers(got, expected):
            return ""
        if "raised" in got:
            return f"expected {_expected(expected)}, it raised {got['raised']}"
        if any(place.endswith("dtype") for place in got):
            return "expected real numbers, got complex ones: a root of a negative number?"
        for place, wanted in expected.items():
            if place not in got:
                return (
                    f"expected {wanted if place.endswith('shape') else _show(wanted)}"
                    + (f" at {place}" if place else "")
                    + ", got nothing there"
                )
            if not same(got[place], wanted):
                where = place.removesuffix("shape").removesuffix("length")
                what = "shape " if place.endswith("shape") else ""
                what = "length " if place.endswith("length") else what
                at = f" at {where}" if where else ""
                return f"expected {what}{_show(wanted)}{at}, got {what}{_show(got[place])}"
        return ""

    def diagnose(self, calls: Sequence[tuple[str, Answer]]) -> Diagnosis:
        """The mistake whose answers agree in all calls; else a relation to the right answers."""
        trace = trace_of([got.mark for _, got in calls])
        if not trace or matches_text(trace, self.trace):
            return Diagnosis()
        found = opened(self.mistakes, trace, errors_text(calls))
        if found and len({each.kind for each in found}) == 1:
            names = tuple(name for each in found for name in (each.name, *each.alternatives))
            return Diagnosis("; or: ".join(names), names, _steps(found[0]))
        pairs = [(got, self.expected[key]) for key, got in calls if key in self.expected]
        wrong = [(got, right) for got, right in pairs if not same_numbers(got, right)]
        return Diagnosis(_general(wrong) if wrong else "")


def _expected(numbers: Numbers) -> str:
    """The first numbers of a right answer, in short."""
    shown = [
        f"{_show(v)} at {k}" if k else _show(v) for k, v in numbers.items() if "shape" not in k
    ]
    return ", ".join(shown[:2]) or "an answer"


def _show(value: Any) -> str:
    """A number in short; what rounding left of a zero is a zero."""
    if isinstance(value, float):
        return "0" if abs(value) < ROUNDING else f"{value:.6g}"
    return str(value)


def _general(pairs: Sequence[tuple[Numbers, Numbers]]) -> str:
    """A relation that all wrong answers have to the expected ones, in words; "" if none."""
    if any(place.endswith("dtype") for got, _ in pairs for place in got):
        return "the answer is complex: a root or a power of a negative number"
    got, wanted = [], []
    for answer, expected in pairs:
        if answer.keys() != expected.keys():
            return ""
        for place, value in expected.items():
            if isinstance(answer[place], str) or isinstance(value, str):
                if answer[place] != value:
                    return ""
            elif not place.endswith("length") and not same(answer[place], value):
                if not math.isfinite(answer[place]) or not math.isfinite(value):
                    return ""
                got.append(answer[place])
                wanted.append(value)
    if len(got) < 2:
        return ""
    a, b = np.array(got), np.array(wanted)
    if np.allclose(a, -b, rtol=RTOL, atol=ATOL):
        return "where it differs, it has the opposite sign of what is expected"
    if np.all(np.abs(b) > ATOL):
        ratio = a / b
        if np.allclose(ratio, ratio[0], rtol=1e-4):
            return _unit(float(ratio[0]))
    return ""


def _unit(ratio: float) -> str:
    """The units that a constant ratio to the expected answer stands for; "" if none."""
    for value, words in (
        (math.degrees(1.0), "degrees and radians"),
        (math.radians(1.0), "degrees and radians"),
        (1000.0, "grams and kilograms, or milli"),
        (0.001, "grams and kilograms, or milli"),
    ):
        if math.isclose(ratio, value, rel_tol=1e-3):
            return f"where it differs, it is {value:.4g} times what is expected: {words}"
    return ""


def load_hints(folder: Path) -> Mapping[str, Hints]:
    """The hints of a lab's folder, by exercise; empty where they are missing or another course's.

    Args:
        folder: the lab's, with `hints.json` and `cohort.json`.
    """
    path, cohort = folder / FILE, folder / "cohort.json"
    if not path.is_file() or not cohort.is_file():
        return {}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["constants"] != json.loads(cohort.read_text(encoding="utf-8")):
            return {}
        return parse_hints(record)
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}


def parse_hints(record: Mapping[str, Any]) -> dict[str, Hints]:
    """The hints of each exercise, from the content of a `hints.json`.

    Raises:
        KeyError, TypeError, ValueError: it is not one, or one of an older kit.
    """
    return {
        name: Hints(each["expected"], each["trace"], dict(each["mistakes"]))
        for name, each in record["exercises"].items()
    }
