"""What a lab is made of: exercises, the checks a student sees, and the judges that only an
instructor has.

A lab is a folder, `labs/lab03_splats`. Its `checks.py` says LAB, a `Lab`; its `hidden.py` says
`judges(course)`, which a student never gets. Both ask a student's function only through a call:
they do not know whether it runs here, in the student's notebook, or in the grader's box.
"""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

Function = Callable[
    ..., Any
]  # a student's function: arrays, numbers, strings and tuples of them in and out


@dataclass(frozen=True)
class Course:
    """What makes one course's, and one student's, lab differ from another's.

    Attributes:
        constants: the lab's numbers for this course, by name, in the units the lab says.
        student: whose work is judged; empty where that is not known.
        salt: the instructor's secret; empty on a student's machine.
    """

    constants: Mapping[str, float]
    student: str = ""
    salt: str = ""


@dataclass(frozen=True)
class Check:
    """A public claim about one function, which a student can read and run.

    Attributes:
        claim: what a right function does, in a sentence: "a heavier aircraft flies faster".
        holds: calls the function and says whether the claim holds.
        hint: where to look if it does not, without giving the answer away.
    """

    claim: str
    holds: Callable[[Function], bool]
    hint: str


@dataclass(frozen=True)
class Exercise:
    """One function that a student writes.

    Attributes:
        name: of the function.
        points: that the machine gives for it.
        checks: what a student can see of it.
        through: function of the lab's `given.py` that is called in its place, with the student's
            function before the arguments; for functions that take what cannot be sent, such as a
            network. Empty: called directly.
        seconds: that all its hidden cases may take together [s].
    """

    name: str
    points: float
    checks: tuple[Check, ...]
    through: str = ""
    seconds: float = 10.0


@dataclass(frozen=True)
class Criterion:
    """Something that a person grades: a figure, or an answer; a figure's reading is one.

    Attributes:
        name: of the notebook's cell, as its `answer` or `figure` says.
        points: at most.
        look_for: what earns them, for the person who grades.
    """

    name: str
    points: float
    look_for: str


@dataclass(frozen=True)
class Lab:
    """A lab, as students know it.

    Attributes:
        name: "lab03".
        title: a few words.
        hours: time a student needs, about.
        exercises: in the order of the notebook; their points sum to 75.
        rubric: what a person grades; its points sum to 25.
        constants: numbers that differ from course to course: lowest, highest, decimals.
        packages: libraries that a student's functions may use, beside the standard library's
            mathematics and `given`.
        memory_mib: that they may take.
        notebook_since: version of the kit, such as "0.2", whose notebook was the first with the
            names that the checks use today; an older notebook is refused. Empty for any.
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
    """A judge: each hidden case is one call, and the answer is compared with the reference's.

    Attributes:
        draw: draws the arguments of a case.
        reference: takes the same arguments and gives the right answer.
        cases: how many are drawn.
        rtol, atol: how far an answer may be off, relative and absolute in the answer's unit.
        fixed: further cases that are not drawn, such as limits.
    """

    draw: Callable[[np.random.Generator], tuple[Any, ...]]
    reference: Function
    cases: int = 10
    rtol: float = 1e-6
    atol: float = 1e-9
    fixed: tuple[tuple[Any, ...], ...] = ()

    def verdicts(self, student: Function, rng: np.random.Generator) -> list[Callable[[], bool]]:
        """The cases, drawn but not yet asked: each, when called, asks the student's function once."""
        drawn = [self.draw(rng) for _ in range(self.cases)]
        return [partial(self._right, student, arguments) for arguments in (*drawn, *self.fixed)]

    def _right(self, student: Function, arguments: tuple[Any, ...]) -> bool:
        wanted = self.reference(
            *arguments
        )  # before the student's function can change what it was given
        return is_same_answer(student(*arguments), wanted, self.rtol, self.atol)


@dataclass(frozen=True)
class Trials:
    """A judge: in each trial a plant of ours calls the student's function as often as it likes and
    says whether it did.

    Attributes:
        run: flies one trial, by the function and what is drawn.
        trials: how many.
    """

    run: Callable[[Function, np.random.Generator], bool]
    trials: int = 5

    def verdicts(self, student: Function, rng: np.random.Generator) -> list[Callable[[], bool]]:
        """The trials, each of which runs when called; every trial draws from a stream of its own."""
        return [partial(self.run, student, stream) for stream in rng.spawn(self.trials)]


Judge = Values | Trials
Judges = Callable[
    [Course], Mapping[str, tuple[Judge, ...]]
]  # `hidden.judges`: for each exercise, its judges


def is_same_answer(got: Any, wanted: Any, rtol: float = 1e-6, atol: float = 1e-9) -> bool:
    """Whether an answer is the right one: same structure, same shape, finite where it should be,
    near enough.

    Args:
        got: the answer; anything may come.
        wanted: numbers, booleans, strings, arrays, or tuples, lists and dicts of them. A NaN wants
            a NaN.
        rtol, atol: |got - wanted| <= atol + rtol |wanted|, element by element.

    Returns:
        True or False; no answer makes it raise.
    """
    if isinstance(wanted, Mapping):
        return (
            isinstance(got, Mapping)
            and set(got) == set(wanted)
            and all(is_same_answer(got[key], wanted[key], rtol, atol) for key in wanted)
        )
    if isinstance(wanted, tuple | list):
        return (
            isinstance(got, tuple | list)
            and len(got) == len(wanted)
            and all(is_same_answer(a, b, rtol, atol) for a, b in zip(got, wanted, strict=True))
        )
    if isinstance(wanted, str | bool) or wanted is None:
        return isinstance(got, type(wanted) | np.bool_) and bool(got == wanted)
    return _same_numbers(got, wanted, rtol, atol)


def _same_numbers(got: Any, wanted: Any, rtol: float, atol: float) -> bool:
    right = np.asarray(wanted)
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
        salt: any text; the empty one gives the middle of each range.

    Returns:
        One number for each of `lab.constants`, rounded to its decimals.
    """
    numbers = {}
    for name, (low, high, decimals) in lab.constants.items():
        digest = hashlib.sha256(f"{salt}/{lab.name}/{name}".encode()).digest()
        share = int.from_bytes(digest[:8], "big") / 2.0**64 if salt else 0.5
        numbers[name] = round(low + share * (high - low), decimals)
    return numbers


def total_points(lab: Lab) -> float:
    """Points that the machine gives for the whole lab."""
    return math.fsum(each.points for each in lab.exercises)
