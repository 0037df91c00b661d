"""Hints: what a function returned in the public checks -> the mistake that returns the same.

`falconwing labs hints` runs the solution and each listed mistake of a lab through the public checks
and stores what they return, up to PLACES numbers of a call, in the lab's `hints.json`. A student's
folder holds these numbers and the mistakes' names, not their code and not the solution's.
Calls whose arguments depend on earlier answers of a wrong function match nothing and say nothing.
"""

import copy
import hashlib
import importlib.util
import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.tools.grading.collect import Notebook, SubmittedCell, collect_source
from falconwing_kit.tools.grading.find import importable_given, load_checks, load_module
from falconwing_kit.tools.grading.lab import Exercise, Function, Lab, course_constants
from falconwing_kit.tools.grading.notebooks import SourceCell, read_cells

FILE = "hints.json"
PLACES = 24  # numbers of one answer that are stored, spread evenly over it
CALLS = 12  # different calls of an exercise that are stored
RTOL, ATOL = 1e-5, 1e-9  # stored numbers have seven digits
_INSIDE = re.compile(r"# BEGIN SOLUTION\n(.*?)[ \t]*# END SOLUTION", re.DOTALL)

Numbers = dict[str, Any]  # place in the answer -> number, text or truth value


@dataclass
class Recorder:
    """A function that records what it is called with and returns.

    Attributes:
        function: any.
        calls: key of the arguments and answer, in order; an error's answer is its type's name.
    """

    function: Function
    calls: list[tuple[str, Numbers]] = field(default_factory=list)

    def __call__(self, *arguments: Any) -> Any:
        """The function's answer, or its error, recorded."""
        key = call_key(arguments)
        try:
            answer = self.function(*arguments)
        except Exception as error:
            self.calls.append((key, {"raised": type(error).__name__}))
            raise
        self.calls.append((key, numbers_of(answer)))
        return answer


def call_key(arguments: tuple[Any, ...]) -> str:
    """Short name of a call's arguments: their structure and numbers to six digits."""
    return hashlib.sha256("|".join(_texts(arguments)).encode()).hexdigest()[:12]


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for name in value:
            yield str(name)
            yield from _texts(value[name])
    elif isinstance(value, tuple | list):
        yield f"{len(value)}"
        for each in value:
            yield from _texts(each)
    elif isinstance(value, bool | int | float | np.ndarray | np.generic):
        array = np.asarray(value)
        yield f"{array.shape}"
        yield from (f"{x:.6g}" if array.dtype.kind in "iuf" else str(x) for x in array.ravel())
    else:
        yield value if isinstance(value, str) else type(value).__name__


def numbers_of(answer: Any, name: str = "") -> Numbers:
    """An answer as a flat record: place, such as "[1][0, 2]", to number, text or truth value."""
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
        mistakes: names of the listed mistakes that return the same; empty for a general finding.
    """

    cause: str = ""
    mistakes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Hints:
    """Stored answers of one exercise.

    Attributes:
        expected: answers of a right function, by the key of the call.
        mistakes: for each named mistake its answers, by the key of the call.
    """

    expected: Mapping[str, Numbers]
    mistakes: Mapping[str, Mapping[str, Numbers]]

    def first_difference(self, key: str, got: Numbers) -> str:
        """The first place where an answer is wrong, expected beside got; empty if none is known."""
        expected = self.expected.get(key)
        if expected is None or "raised" in got or same_numbers(got, expected):
            return ""
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

    def diagnose(self, calls: list[tuple[str, Numbers]]) -> Diagnosis:
        """The mistake whose answers agree with all the calls that are known."""
        known = [(key, got) for key, got in calls if key in self.expected]
        wrong = [(key, got) for key, got in known if not same_numbers(got, self.expected[key])]
        if not wrong:
            return Diagnosis()
        found = [name for name, answers in self.mistakes.items() if _agrees(answers, known)]
        telling = any(_tells(got, self.expected[key]) for key, got in wrong)
        if found and telling:
            return Diagnosis(" or ".join(found[:2]), tuple(found))
        return Diagnosis(_general([(got, self.expected[key]) for key, got in wrong]))


def _agrees(answers: Mapping[str, Numbers], known: list[tuple[str, Numbers]]) -> bool:
    shared = [(answers[key], got) for key, got in known if key in answers]
    return bool(shared) and all(same_numbers(got, mistake) for mistake, got in shared)


def _tells(got: Numbers, expected: Numbers) -> bool:
    """Whether a wrong answer is one that few mistakes give: a finite number that is not 0."""
    return any(
        isinstance(value, float | int)
        and not place.endswith("length")
        and math.isfinite(value)
        and value not in (0.0, 1.0)
        and not same(value, expected.get(place, "none"))
        for place, value in got.items()
    )


def _show(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _general(pairs: list[tuple[Numbers, Numbers]]) -> str:
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
        return {
            name: Hints(each["expected"], each["mistakes"])
            for name, each in record["exercises"].items()
        }
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}


def library(folder: Path, lab: Lab) -> Mapping[str, tuple[tuple[str, str, str], ...]]:
    """The lab's listed mistakes: of each exercise name, old and new text; {} where there are none.

    They stand in a checkout's `tests/labs/mutants`, whose entries must also lose points.
    """
    path = folder.resolve().parents[1] / "tests" / "labs" / "mutants" / f"{lab.name}.py"
    spec = importlib.util.spec_from_file_location(f"mistakes_of_{lab.name}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        return {}
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Mapping[str, tuple[tuple[str, str, str], ...]] = module.MUTANTS
    return found


def hints_text(folder: Path, salt: str = "") -> str:
    """Content of a lab's `hints.json` for a course; "" where the lab lists no mistakes.

    Args:
        folder: the lab's, in a checkout, with `lab.py`.
        salt: the course's key; empty for the open course.
    """
    constants = course_constants(load_checks(folder), salt)
    lab: Lab = load_module(folder, "checks", constants).LAB
    listed = library(folder, lab)
    if not listed:
        return ""
    given = load_module(folder, "given", constants)
    cells = [cell for cell in read_cells(folder / "lab.py") if not cell.markdown]
    exercises = {}
    with importable_given(given):
        for each in lab.exercises:
            expected = _answers(each, _function(cells, lab, each, given))
            mistakes = {}
            for name, old, new in listed.get(each.name, ()):
                function = _function(cells, lab, each, given, old, new)
                answers, again = _answers(each, function), _answers(each, _shaken(function))
                shared = {
                    key: answers[key]
                    for key in expected
                    if key in answers and same_numbers(answers[key], again.get(key, {}))
                }
                if any(not same_numbers(shared[key], expected[key]) for key in shared):
                    mistakes[name] = shared
            exercises[each.name] = {"expected": expected, "mistakes": mistakes}
    record = {"constants": constants, "exercises": exercises}
    return json.dumps(record, ensure_ascii=False, separators=(",", ":")) + "\n"


def _answers(exercise: Exercise, function: Function) -> dict[str, Numbers]:
    """Answers in the public checks, by call; a call with two different answers is left out."""
    recorder = Recorder(function)
    with np.errstate(all="ignore"):
        for each in exercise.checks:
            with suppress(Exception):  # a wrong answer may break the check after the call
                each.holds(recorder)
    found: dict[str, Numbers] = {}
    for key, answer in recorder.calls:
        if key in found or len(found) < CALLS:
            found.setdefault(key, answer)
    return found


def _function(
    cells: list[SourceCell],
    lab: Lab,
    exercise: Exercise,
    given: Any,
    old: str = "",
    new: str = "",
) -> Function:
    """The solution's function, or with `old` replaced by `new` inside the solution."""
    submitted = []
    for cell in cells:
        text = cell.for_solution()
        if old and cell.kind == "exercise" and cell.name == exercise.name:
            inside = _INSIDE.search(cell.text)
            body = inside[1] if inside else ""
            text = cell.text.replace(body, body.replace(old, new)) if inside else text
        submitted.append(SubmittedCell(True, text))
    source = collect_source(Notebook(tuple(submitted)), exercise.name, lab.packages)
    namespace: dict[str, Any] = {"__name__": "notebook"}
    exec(compile(source.text, exercise.name, "exec"), namespace)
    function = namespace[exercise.name]

    def called(*arguments: Any) -> Any:
        arguments = copy.deepcopy(arguments)
        if exercise.through:
            return getattr(given, exercise.through)(function, *arguments)
        return function(*arguments)

    return called


def _shaken(function: Function) -> Function:
    """The function on arrays that differ by rounding, at 1e-10.

    An answer that changes with them is no fingerprint: a wrong formula may take the singular
    vectors of equal singular values, which are arbitrary.
    """
    rng = np.random.default_rng(0)

    def called(*arguments: Any) -> Any:
        near = [
            value * (1.0 + 1e-10 * rng.standard_normal(value.shape))
            if isinstance(value, np.ndarray) and value.dtype.kind == "f"
            else value
            for value in arguments
        ]
        return function(*near)

    return called
