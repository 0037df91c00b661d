"""Parts of a lab: exercises, public checks for students, hidden judges for the grader.

A lab is a folder, `labs/lab03_splats`. Its `checks.py` defines LAB, a `Lab`; its `hidden.py`, which
students do not get, defines `judges(course)`. Both only call the student's function, wherever it
runs: in this process, in the student's notebook, or in the grader's sandbox.
"""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

# a student's function: numbers, strings, arrays and tuples of them in and out
Function = Callable[..., Any]


@dataclass(frozen=True)
class Course:
    """What differs from course to course and from student to student.

    Attributes:
        constants: the lab's numbers for this course, by name.
        student: whose work is judged; empty if unknown.
        salt: the instructor's secret; empty on a student's machine.
    """

    constants: Mapping[str, float]
    student: str = ""
    salt: str = ""


@dataclass(frozen=True)
class Check:
    """A public test of one function, which a student can read and run.

    Attributes:
        claim: what a correct function does, in a sentence: "a heavier aircraft flies faster".
        holds: calls the function and returns whether the claim holds.
        hint: where to look if it does not, without the answer.
    """

    claim: str
    holds: Callable[[Function], bool]
    hint: str


@dataclass(frozen=True)
class Exercise:
    """One function or class that a student writes.

    Attributes:
        name: of the function or class.
        points: given automatically.
        checks: public ones.
        through: wrapper in the lab's `given.py`, called with the student's function and the
            arguments; for functions whose arguments cannot be sent to the sandbox, such as a
            network, and for classes, whose objects stay there. Empty: called directly.
        seconds: time limit of all hidden cases together [s].
        nearby: ask a wrong function on arguments near those of the checks too, for the hints; not
            where such arguments have no answer and a right function might never end.
        free: 30 to 80 lines of the student's own structure, of which only the behaviour is known:
            the hints name the listed mistakes alone, and no changes of the kit's lines.
    """

    name: str
    points: float
    checks: tuple[Check, ...]
    through: str = ""
    seconds: float = 10.0
    nearby: bool = True
    free: bool = False


@dataclass(frozen=True)
class Criterion:
    """A figure or a written answer, graded by a person.

    Attributes:
        name: of the notebook's cell, its `answer` or `figure`.
        points: maximum.
        look_for: what earns them, for the person who grades.
    """

    name: str
    points: float
    look_for: str


@dataclass(frozen=True)
class Lab:
    """The public part of a lab.

    Attributes:
        name: "lab03".
        title: a few words.
        hours: approximate time for a student.
        exercises: in the order of the notebook; their points sum to 75.
        rubric: graded by a person; its points sum to 25.
        constants: numbers that differ from course to course: lowest, highest, decimals.
        packages: libraries available to the functions, beside the standard library and `given`.
        memory_mib: memory limit [MiB].
        notebook_since: first version of the kit, such as "0.2", whose notebook fits these checks;
            an older notebook is refused. Empty for any.
    """

    name: str
    title: str
    hours: float
    exercises: tuple[Exercise, ...]
    rubric: tuple[Criterion, ...]
    constants: Mapping[str, tuple[float, float, int]] = field(default_factory=dict)
    packages: tuple[str, ...] = ("numpy",)
    memory_mib: int = 1024
    notebook_since: str = ""

    def exercise(self, name: str) -> Exercise:
        """The exercise of this name; KeyError if there is none."""
        return {each.name: each for each in self.exercises}[name]


@dataclass(frozen=True)
class Values:
    """A judge that compares the student's answers with a reference, one call per hidden case.

    Attributes:
        draw: draws the arguments of a case.
        reference: returns the correct answer for the same arguments.
        cases: how many are drawn.
        rtol, atol: relative tolerance, and absolute tolerance in the answer's unit.
        fixed: arguments of further cases, such as limits.
    """

    draw: Callable[[np.random.Generator], tuple[Any, ...]]
    reference: Function
    cases: int = 10
    rtol: float = 1e-6
    atol: float = 1e-9
    fixed: tuple[tuple[Any, ...], ...] = ()

    def verdicts(self, student: Function, rng: np.random.Generator) -> list[Callable[[], bool]]:
        """The drawn cases: each, when called, calls the student's function once."""
        drawn = [self.draw(rng) for _ in range(self.cases)]
        return [partial(self._right, student, arguments) for arguments in (*drawn, *self.fixed)]

    def _right(self, student: Function, arguments: tuple[Any, ...]) -> bool:
        expected = self.reference(*arguments)  # first: the student may modify the arguments
        return is_same_answer(student(*arguments), expected, self.rtol, self.atol)


@dataclass(frozen=True)
class Trials:
    """A judge that runs closed-loop trials, in which a plant calls the student's function.

    Attributes:
        run: one trial with the function and a random generator; returns whether it succeeded.
        trials: how many.
    """

    run: Callable[[Function, np.random.Generator], bool]
    trials: int = 5

    def verdicts(self, student: Function, rng: np.random.Generator) -> list[Callable[[], bool]]:
        """The trials: each runs when called, with its own random stream."""
        return [partial(self.run, student, stream) for stream in rng.spawn(self.trials)]


Judge = Values | Trials
Judges = Callable[[Course], Mapping[str, tuple[Judge, ...]]]  # `hidden.judges`, by exercise


def is_same_answer(got: Any, expected: Any, rtol: float = 1e-6, atol: float = 1e-9) -> bool:
    """Whether an answer has the structure, shapes and numbers of the expected one.

    Args:
        got: the answer, any object.
        expected: numbers, booleans, strings, arrays, or tuples, lists and dicts of them; NaN
            matches NaN only.
        rtol, atol: |got - expected| <= atol + rtol |expected|, element by element.

    Returns:
        True or False; never raises, whatever the answer.
    """
    if isinstance(expected, Mapping):
        return (
            isinstance(got, Mapping)
            and set(got) == set(expected)
            and all(is_same_answer(got[key], expected[key], rtol, atol) for key in expected)
        )
    if isinstance(expected, tuple | list):
        return (
            isinstance(got, tuple | list)
            and len(got) == len(expected)
            and all(is_same_answer(a, b, rtol, atol) for a, b in zip(got, expected, strict=True))
        )
    if isinstance(expected, str | bool) or expected is None:
        return isinstance(got, type(expected) | np.bool_) and bool(got == expected)
    return _same_numbers(got, expected, rtol, atol)


def is_close(got: Any, expected: Any, rtol: float = 1e-9, atol: float = 1e-9) -> bool:
    """Whether arrays or lists of numbers have the same shape and values; NaN matches NaN."""
    return np.shape(got) == np.shape(expected) and bool(
        np.allclose(got, expected, rtol=rtol, atol=atol, equal_nan=True)
    )


def _same_numbers(got: Any, expected: Any, rtol: float, atol: float) -> bool:
    right = np.asarray(expected)
    if not isinstance(got, int | float | np.number | np.ndarray):
        return False
    answer = np.asarray(got)
    if answer.shape != right.shape or answer.dtype.kind not in "biuf":
        return False
    if right.dtype.kind == "b" or answer.dtype.kind == "b":
        return answer.dtype.kind == right.dtype.kind and bool(np.array_equal(answer, right))
    return bool(
        np.allclose(answer.astype(float), right.astype(float), rtol=rtol, atol=atol, equal_nan=True)
    )


def course_constants(lab: Lab, salt: str) -> dict[str, float]:
    """The lab's constants for a course.

    Args:
        lab: the lab.
        salt: any text; empty for the middle of each range.

    Returns:
        One number for each of `lab.constants`, rounded to its decimals.
    """
    course = f"{salt}/{lab.name}" if salt else ""
    return {name: drawn_number(course, name, *limits) for name, limits in lab.constants.items()}


def drawn_number(course: str, name: str, low: float, high: float, decimals: int) -> float:
    """A course's number of a name, between two limits.

    Args:
        course: the key and what the name belongs to; empty for the middle.
        name: of the number.
        low, high, decimals: limits, and to how many decimals it is rounded.
    """
    digest = hashlib.sha256(f"{course}/{name}".encode()).digest()
    share = int.from_bytes(digest[:8], "big") / 2.0**64 if course else 0.5
    return round(low + share * (high - low), decimals)


def total_points(lab: Lab) -> float:
    """Points of the whole lab that are given automatically."""
    return math.fsum(each.points for each in lab.exercises)
