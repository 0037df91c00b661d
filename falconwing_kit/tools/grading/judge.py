"""Judge: one submission -> its record, from hidden cases evaluated outside the sandbox.

The student's function runs in a fresh sandbox for every exercise; its answers are compared here, in
the grader's process, which alone has the references and seeds. A record holds how many cases were
right and how the others failed, never their questions or answers.
"""

import hashlib
import hmac
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit import __version__
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import (
    Notebook,
    Source,
    collect_sources,
    parse_notebook,
    require_notebook_of,
)
from falconwing_kit.tools.grading.find import lab_folders, load_checks, load_judges
from falconwing_kit.tools.grading.lab import (
    Course,
    Exercise,
    Function,
    Judge,
    Lab,
    Values,
    course_constants,
    total_points,
)
from falconwing_kit.tools.grading.quiz import read_quiz
from falconwing_kit.tools.grading.quiz_answers import quiz_record
from falconwing_kit.tools.grading.salt import course_mark
from falconwing_kit.tools.grading.sandbox.host import (
    SandboxJob,
    StudentError,
    Worker,
    process_worker,
    sandbox_worker,
)
from falconwing_kit.tools.grading.submissions import Submission

Record = dict[str, Any]
STATES = ("graded", "late", "missing", "unreadable", "wrong lab", "error")


@dataclass(frozen=True)
class Assignment:
    """Common settings of all submissions of a run.

    Attributes:
        folder: of the lab.
        salt: the course's; empty for the open course.
        secret: of the run, from which each submission's seed is derived.
        sandboxed: run functions in a sandbox; otherwise in a plain process, without protection.
    """

    folder: Path
    salt: str = ""
    secret: str = ""
    sandboxed: bool = True


@dataclass(frozen=True)
class GradingContext:
    """Lab, course and kind of sandbox in which functions are judged.

    Attributes:
        folder: of the lab.
        lab: its public part.
        course: with its constants.
        sandboxed: run functions in a sandbox; otherwise in a plain process.
    """

    folder: Path
    lab: Lab
    course: Course
    sandboxed: bool = True

    def worker(self, exercise: Exercise, text: str) -> AbstractContextManager[Worker]:
        """A fresh worker for a function of an exercise."""
        job = SandboxJob(
            text,
            exercise.name,
            self.folder,
            self.course.constants,
            exercise.through,
            self.lab.packages,
            exercise.seconds,
            self.lab.memory_mib,
        )
        return sandbox_worker(job) if self.sandboxed else process_worker(job)


@dataclass(frozen=True)
class GradingTask:
    """One submission to grade.

    Attributes:
        submission: the student's notebook.
        seed: of an earlier record; empty derives it from the secret, the student and the notebook.
    """

    submission: Submission
    seed: str = ""


class JudgeError(Exception):
    """An error of the lab's own judge, not of the student."""


def grade_submission(work: GradingTask, assignment: Assignment) -> Record:
    """Grade one submission.

    Args:
        work: submission and seed.
        assignment: lab and settings.

    Returns:
        Texts and numbers: `status` is "graded", "unreadable" or "wrong lab" (0 points), or "error"
        (needs a person). Deterministic: the same notebook, student, assignment and seed give the
        same record.

    Raises:
        InputError: the lab itself cannot be used.
    """
    submission = work.submission
    lab = load_checks(assignment.folder)
    course = Course(course_constants(lab, assignment.salt), submission.student, assignment.salt)
    judges = load_judges(assignment.folder, course)
    context = GradingContext(assignment.folder, lab, course, assignment.sandboxed)
    record = error_record(work, assignment, lab)
    if submission.disputed:
        return record
    try:
        data = submission.read()
        record["sha256"] = hashlib.sha256(data).hexdigest()
        notebook = parse_notebook(data, "the notebook")
        require_notebook_of(notebook, lab.notebook_since, submission.name)
        sources = collect_sources(notebook, [each.name for each in lab.exercises], lab.packages)
        if not (any(source.text for source in sources.values()) or _has_cells_of(lab, notebook)):
            other = _lab_of(notebook, assignment.folder)
            why = f"a notebook of {other}, not of {lab.name}" if other else "none of its functions"
            why = f"{why}; ask for the notebook of {lab.name}"
            return record | {"status": "wrong lab", "problem": why, "points": 0.0}
        mark = course_mark(assignment.salt)
        if notebook.course != mark and notebook.course:
            others = "handed out in another course, whose numbers differ"
            record["problem"] = "; ".join(filter(None, (record["problem"], others)))
    except (InputError, OSError, MemoryError) as error:
        return record | {"status": "unreadable", "problem": str(error)[:300], "points": 0.0}
    record["seed"] = work.seed or _seed(assignment.secret, submission.student, record["sha256"])
    for exercise in lab.exercises:
        source, asked = sources[exercise.name], judges[exercise.name]
        try:
            result = grade_exercise(context, exercise, source, asked, record["seed"])
        except (JudgeError, RuntimeError, OSError) as error:
            return record | {"problem": f"{exercise.name}: {error}"[:300]}
        record["exercises"][exercise.name] = result
    questions = read_quiz(assignment.folder, assignment.salt, course.constants)
    if questions:
        record["quiz"] = quiz_record(notebook, questions)
    points = math.fsum(each["points"] for each in record["exercises"].values())
    return record | {"status": "graded", "points": round(points, 4)}


def _has_cells_of(lab: Lab, notebook: Notebook) -> bool:
    """Whether some cell is marked as one of the lab's, though its functions were deleted."""
    names = {each.name for each in lab.exercises} | {each.name for each in lab.rubric}
    return any(cell.name in names for cell in notebook.cells if cell.role)


def _lab_of(notebook: Notebook, folder: Path) -> str:
    """Name of the lab beside this one whose functions a notebook defines; empty if none."""
    written = set(re.findall(r"^def (\w+)\(", "\n".join(notebook.code), re.MULTILINE))
    for other in lab_folders(folder.parent):
        lab = load_checks(other)
        if written & {each.name for each in lab.exercises}:
            return lab.name
    return ""


def missing_record(student: str, assignment: Assignment, lab: Lab) -> Record:
    """The record of a student of the roster who handed in nothing."""
    nothing = GradingTask(Submission(student, Path(), problem="nothing handed in"))
    return error_record(nothing, assignment, lab) | {"status": "missing", "points": 0.0}


def record_state(record: Mapping[str, Any]) -> str:
    """One of STATES; every record has exactly one."""
    status = str(record["status"])
    return "late" if status == "graded" and record.get("late") else status


def error_record(work: GradingTask, assignment: Assignment, lab: Lab) -> Record:
    """The record of a submission that could not be graded: no points, status "error"."""
    submission = work.submission
    return {
        "lab": lab.name,
        "student": submission.student,
        "notebook": submission.name,
        "sha256": submission.sha256,
        "seed": work.seed,
        "kit": __version__,
        "numpy": np.__version__,
        "sandboxed": assignment.sandboxed,
        "status": "error",
        "problem": submission.problem,
        "points": None,
        "of": total_points(lab),
        "exercises": {},
    }


def grade_exercise(
    context: GradingContext, exercise: Exercise, source: Source, judges: Sequence[Judge], seed: str
) -> Record:
    """Judge a student's source for one exercise, in a fresh sandbox.

    Args:
        context: lab, course, and kind of sandbox.
        exercise: of the lab.
        source: the student's, from `collect_source`.
        judges: of the exercise.
        seed: of the submission, any text; with the exercise's name it determines the cases.

    Returns:
        `right` of `cases`, `points` of `of`, `categories` (number of failed cases by category) and
        `problems`.

    Raises:
        JudgeError: the lab's judge failed.
        RuntimeError: the sandbox did not start.
    """
    digest = hashlib.sha256(f"{seed}/{exercise.name}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest, "big"))
    if source.text:
        with context.worker(exercise, source.text) as worker:
            results = evaluate_cases(worker.call, judges, rng)
    else:
        results = evaluate_cases(_missing, judges, rng)
    right = results.count("right")
    return {
        "points": round(exercise.points * right / max(len(results), 1), 4),
        "of": exercise.points,
        "right": right,
        "cases": len(results),
        "categories": dict(sorted(Counter(each for each in results if each != "right").items())),
        "problems": list(source.problems),
    }


def evaluate_cases(
    function: Function, judges: Sequence[Judge], rng: np.random.Generator
) -> list[str]:
    """Call a function on all hidden cases of an exercise.

    Args:
        function: answers, or raises StudentError.
        judges: of the exercise.
        rng: draws the cases.

    Returns:
        For each case "right" or its failure: "wrong value", "wrong shape", "trial failed", "bad
        answer", or a category of StudentError.

    Raises:
        JudgeError: drawing a case or finding its right answer failed.
    """
    results = []
    for each in judges:
        watched = _Watched(function, each)
        try:
            verdicts = watched.judge.verdicts(watched, rng)
        except Exception as error:
            raise JudgeError(f"the judge cannot draw its cases: {type(error).__name__}") from error
        results += [watched.outcome(verdict) for verdict in verdicts]
    return results


class _Watched:
    """A student's function and a judge, with a record of how a case failed."""

    def __init__(self, function: Function, each: Judge) -> None:
        self.function, self.answer, self.expected = function, None, None
        self.is_values = isinstance(each, Values)
        self.reference = each.reference if isinstance(each, Values) else None
        self.judge: Judge = (
            replace(each, reference=self._right_answer) if isinstance(each, Values) else each
        )

    def __call__(self, *arguments: Any) -> Any:
        self.answer = None
        self.answer = self.function(*arguments)
        return self.answer

    def _right_answer(self, *arguments: Any) -> Any:
        try:
            self.expected = self.reference(*arguments)  # type: ignore[misc]
        except Exception as error:
            raise JudgeError(f"the judge's reference failed: {type(error).__name__}") from error
        return self.expected

    def outcome(self, verdict: Function) -> str:
        try:
            if verdict() is True:
                return "right"
        except StudentError as error:
            return error.category
        except JudgeError:
            raise
        except Exception:  # the answer made the judge's own arithmetic fail
            return "bad answer"
        if not self.is_values:
            return "trial failed"
        return "wrong value" if _shape(self.answer) == _shape(self.expected) else "wrong shape"


def _shape(value: Any) -> Any:
    """The structure of a value, without its numbers."""
    if isinstance(value, tuple | list):
        return [_shape(each) for each in value]
    if isinstance(value, dict):
        return {key: _shape(each) for key, each in value.items()}
    return (
        np.shape(value) if isinstance(value, int | float | np.ndarray | np.generic) else type(value)
    )


def _missing(*_: Any) -> Any:
    raise StudentError("missing")


def _seed(secret: str, student: str, fingerprint: str) -> str:
    return hmac.new(secret.encode(), f"{student}/{fingerprint}".encode(), "sha256").hexdigest()[:32]
