"""Inspection: a submission -> check results, figures, answers and sources to show. No points."""

import hashlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import (
    Notebook,
    Source,
    collect_sources,
    parse_notebook,
    read_notebook,
)
from falconwing_kit.tools.grading.course.figures import figures_in, run_notebook
from falconwing_kit.tools.grading.find import load_checks, load_module, notebook_path
from falconwing_kit.tools.grading.judge import GradingContext
from falconwing_kit.tools.grading.lab import Course, Lab, course_constants
from falconwing_kit.tools.grading.notebooks import YOUR_ANSWER
from falconwing_kit.tools.grading.public_checks import outcome_lines, run_checks
from falconwing_kit.tools.grading.sandbox.host import StudentError
from falconwing_kit.tools.grading.submissions import Submission

MAX_ANSWER = 8_000  # characters
FILES, FOLDER = ("given.py", "checks.py"), "data"  # files beside a student's notebook


@dataclass(frozen=True)
class ReportContext:
    """Common settings of all submissions of a report.

    Attributes:
        folder: of the lab.
        salt: the course's; empty for the open course.
        boxed: whether a safe sandbox is available; without it no student code is run.
        run: run the notebooks for their figures; otherwise use the stored ones.
        mark: `lab_fingerprint` of the lab's files; cached results depend on it.
    """

    folder: Path
    salt: str = ""
    sandboxed: bool = True
    run: bool = True
    mark: str = ""


@dataclass(frozen=True)
class InspectionTask:
    """One submission to inspect.

    Attributes:
        submission: the student's notebook.
        failed: exercises whose public checks to run.
    """

    submission: Submission
    failed: tuple[str, ...] = ()


@dataclass(frozen=True)
class RubricPart:
    """A part of a lab that a person grades.

    Attributes:
        name: of the cell, as in the rubric.
        is_figure: a figure; otherwise an answer.
        question: the text before it in the notebook; empty for a figure.
    """

    name: str
    is_figure: bool
    question: str


def course_lab(context: ReportContext) -> tuple[Lab, Mapping[str, float]]:
    """The lab with the checks of this course, and the course's constants."""
    constants = course_constants(load_checks(context.folder), context.salt)
    lab: Lab = load_module(context.folder, "checks", constants).LAB
    return lab, constants


def lab_fingerprint(folder: Path) -> str:
    """A fingerprint of the lab's public files."""
    data = sorted(path for path in (folder / FOLDER).rglob("*") if path.is_file())
    files = [
        path
        for path in (*(folder / name for name in FILES), notebook_path(folder), *data)
        if path.is_file()
    ]
    return hashlib.sha256(
        b"".join(hashlib.sha256(path.read_bytes()).digest() for path in files)
    ).hexdigest()


def rubric_parts(folder: Path) -> list[RubricPart]:
    """The parts that a person grades, in the rubric's order, with the students' questions."""
    cells = read_notebook(notebook_path(folder)).cells if notebook_path(folder).is_file() else ()
    parts = {}
    for number, cell in enumerate(cells):
        if cell.role in ("figure", "answer"):
            before = cells[number - 1].text if number and cell.role == "answer" else ""
            question = before[before.rfind("**Question") :] if "**Question" in before else before
            question = "\n".join(line for line in question.split("\n") if not line.startswith("#"))
            parts[cell.name] = RubricPart(
                cell.name, cell.role == "figure", question.replace("**", "").strip()
            )
    return [
        parts.get(each.name, RubricPart(each.name, True, "")) for each in load_checks(folder).rubric
    ]


def inspect_submission(work: InspectionTask, context: ReportContext) -> dict[str, Any]:
    """Inspect one submission.

    Args:
        work: submission and exercises.
        desk: lab and settings.

    Returns:
        `checks` (for each exercise its outcomes: claim, state, lines that are said below it),
        `figures` (for each figure its pictures and their source), `answers`,
        `sources` (of each function), and `problem` if the notebook cannot be read; plain texts,
        lists, dicts.

    Raises:
        InputError: the lab itself cannot be used.
    """
    lab, constants = course_lab(context)
    try:
        data = work.submission.read()
        notebook = parse_notebook(data, "the notebook")
        written = collect_sources(notebook, [each.name for each in lab.exercises], lab.packages)
    except (InputError, OSError, MemoryError) as error:
        return empty_inspection(str(error)[:300])
    checks = (
        _checks(GradingContext(context.folder, lab, Course(constants)), written, work.failed)
        if context.sandboxed
        else {}
    )
    parts = rubric_parts(context.folder)
    answers = {part.name: _answer(notebook, part) for part in parts if not part.is_figure}
    figures = _figures(work.submission, data, context, parts)
    seen = {
        "checks": checks,
        "figures": figures,
        "answers": answers,
        "sources": {name: source.text for name, source in written.items()},
    }
    return empty_inspection("") | seen


def empty_inspection(problem: str) -> dict[str, Any]:
    """The inspection of an unreadable submission."""
    return {"checks": {}, "figures": {}, "answers": {}, "sources": {}, "problem": problem}


def sources(notebook: Notebook, lab: Lab) -> dict[str, str]:
    """Source of each exercise's function with its dependencies; empty if missing.

    Raises:
        InputError: as `collect_sources`.
    """
    names = [each.name for each in lab.exercises]
    found = collect_sources(notebook, names, lab.packages)
    return {name: source.text for name, source in found.items()}


def _checks(
    context: GradingContext, sources: Mapping[str, Source], names: tuple[str, ...]
) -> dict[str, list[tuple[Any, ...]]]:
    """Public check results of some exercises, each in a fresh sandbox."""
    outcomes = {}
    for name in names:
        exercise, source = context.lab.exercise(name), sources[name]
        if source.text:
            with context.worker(exercise, source.text) as worker:
                found = run_checks(exercise, worker.call)
        else:
            found = run_checks(exercise, _missing)
        outcomes[name] = [(each.claim, each.state, outcome_lines(each)) for each in found]
    return outcomes


def _missing(*_: Any) -> Any:
    raise StudentError("missing")


def _answer(notebook: Notebook, part: RubricPart) -> str:
    """A student's answer; empty if the cell is unchanged."""
    texts = [
        cell.text for cell in notebook.cells if cell.role == "answer" and cell.name == part.name
    ]
    return "\n\n".join(text.replace(YOUR_ANSWER, "").strip() for text in texts)[:MAX_ANSWER]


def _figures(
    submission: Submission, data: bytes, context: ReportContext, parts: list[RubricPart]
) -> dict[str, dict[str, Any]]:
    """Pictures of each figure's cell: from a fresh run or, where it drew none, as stored."""
    names = [part.name for part in parts if part.is_figure]
    ran, stored, kept = None, json.loads(data.decode("utf-8-sig")), "not run"
    if names and context.run and context.sandboxed:
        kept = "stored"
        with _lab_files(context, submission.student) as files:
            ran = run_notebook(data, files, course_lab(context)[1])
    figures = {}
    for name in names:
        tries = [(figures_in(ran, name), "run"), (figures_in(stored, name), kept)]
        if not any(
            images for images, _ in tries
        ):  # the cell's mark was lost: whatever the notebook draws
            tries = [(figures_in(ran), "run, all"), (figures_in(stored), f"{kept}, all")]
        images, source = next(((images, how) for images, how in tries if images), ([], "none"))
        figures[name] = {"images": images, "from": source}
    return figures


@contextmanager
def _lab_files(context: ReportContext, student: str) -> Iterator[dict[Path, str]]:
    """The files beside this student's notebook, individual handouts included."""
    files = {context.folder / name: name for name in FILES}
    data = context.folder / FOLDER
    files |= {
        path: path.relative_to(context.folder).as_posix()
        for path in sorted(data.rglob("*"))
        if path.is_file()
    }
    constants = course_lab(context)[1]
    handout = (
        getattr(load_module(context.folder, "hidden", constants), "handout", None)
        if context.salt
        else None
    )
    if handout is None:
        yield files
        return
    with tempfile.TemporaryDirectory(prefix="falconwing-") as place:
        handout(Course(constants, student, context.salt), Path(place))
        mine = sorted(path for path in Path(place).rglob("*") if path.is_file())
        yield files | {path: f"data/mine/{path.relative_to(place).as_posix()}" for path in mine}
