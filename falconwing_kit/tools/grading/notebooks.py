"""Notebook builder: a lab's `lab.py` -> the texts of the student's and the solution notebook.

The source is in jupytext's py:percent format: a cell begins with `# %%` and its role:
`exercise="min_speed"`, `check="min_speed"`, `figure="radius"`, `[markdown] answer="q1"`,
`quiz="quiz"` or `tags=["solution"]`. The lines between `# BEGIN SOLUTION` and `# END SOLUTION` of
an exercise are removed from the student's notebook. The questions of `quiz.toml` stand before the
quiz cell.
"""

import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from falconwing_kit import __version__
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.collect import KIT_KEY
from falconwing_kit.tools.grading.find import load_checks, notebook_path
from falconwing_kit.tools.grading.lab import course_constants
from falconwing_kit.tools.grading.quiz import SOURCE, answers_line, questions_text, read_quiz

KINDS = ("exercise", "check", "figure", "answer", "quiz")
YOUR_ANSWER = "*Your answer:*"
GOAL = (
    "goal.webp"  # of a lab, a picture of what its student will have made; `labs/goal_pictures.py`
)
KIT = ".".join(__version__.split(".")[:2])  # the kit's version in a notebook
_SOLUTION = re.compile(
    r"^([ \t]*)# BEGIN SOLUTION\n(.*?)^[ \t]*# END SOLUTION[ \t]*(?:\n|\Z)",
    re.MULTILINE | re.DOTALL,
)
# formatter directives, removed from the notebooks
_FOR_THE_FORMATTER = re.compile(r"[ \t]*# (?:fmt: (?:skip|off|on)|noqa\b.*)$", re.MULTILINE)
_QUIZ_LINE = re.compile(r"^(quiz) = \{.*?\}$", re.MULTILINE | re.DOTALL)
_MARKER = re.compile(r"^[ \t]*# (?:BEGIN|END) SOLUTION[ \t]*(?:\n|\Z)", re.MULTILINE)
_GO_TO_THE_LAB = """\
# Jupyter starts in this notebook's folder; what the lab needs lies one folder up.
import os

if not os.path.exists("given.py"):
    os.chdir("..")"""

_FILES_BESIDE = """\
import os

if not os.path.exists("given.py"):
    raise FileNotFoundError(
        "given.py is not beside this notebook: open it in the folder {folder} that your course "
        "handed out, or get the notebook for a hosted Python, which brings its files along"
    )

"""


@dataclass(frozen=True)
class SourceCell:
    """One cell of a lab's source.

    Attributes:
        text: with the markers of the solution.
        markdown: Markdown; otherwise Python.
        kind, name: one of KINDS and its name, such as "exercise" and "min_speed"; else empty.
        solution_only: not in the student's notebook.
    """

    text: str
    markdown: bool = False
    kind: str = ""
    name: str = ""
    solution_only: bool = False
    metadata: dict[str, Any] = field(default_factory=dict)

    def for_student(self) -> str:
        """The text for students, with the solution removed."""
        if self.kind == "answer":
            return YOUR_ANSWER
        left = f'raise NotImplementedError("write {self.name}")\n'
        return _SOLUTION.sub(lambda found: found[1] + left, self.text).rstrip("\n")

    def for_solution(self) -> str:
        """The text with the solution, without its markers; its notebook lies one folder down."""
        text = self.text.replace(f"]({GOAL})", f"](../{GOAL})") if self.markdown else self.text
        return _MARKER.sub("", text).rstrip("\n")


def read_cells(source: Path) -> list[SourceCell]:
    """The cells of a lab's source.

    Args:
        source: `lab.py`.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a cell's roles or markers are inconsistent.
    """
    import jupytext

    if not source.is_file():
        raise FileNotFoundError(f"{source}: expected the lab's source, found none")
    notebook = jupytext.reads(source.read_text(encoding="utf-8"), fmt="py:percent")
    cells = [_cell(source, cell) for cell in notebook.cells]
    names = [(cell.kind, cell.name) for cell in cells if cell.kind]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(
            f"{source}: expected every name once, got twice: {' '.join(sorted(twice)[0])}"
        )
    return cells


def _cell(source: Path, cell: Any) -> SourceCell:
    metadata = {key: cell.metadata[key] for key in (*KINDS, "tags") if key in cell.metadata}
    markdown, kinds = cell.cell_type == "markdown", [kind for kind in KINDS if kind in metadata]
    name = str(metadata[kinds[0]]) if kinds else ""
    where = f"{source}: the cell {name or cell.source.strip().splitlines()[:1]}"
    if len(kinds) > 1 or (kinds and markdown != (kinds[0] == "answer")):
        raise InputError(
            f"{where}: expected one of {KINDS}, and answers alone in markdown, got {kinds}"
        )
    written = len(_SOLUTION.findall(cell.source))
    if written != int(kinds == ["exercise"]) or len(_MARKER.findall(cell.source)) != 2 * written:
        raise InputError(
            f"{where}: expected BEGIN SOLUTION and END SOLUTION once in an exercise and nowhere "
            "else"
        )
    if kinds == ["exercise"] and not re.search(
        rf"^(?:def {re.escape(name)}\(|class {re.escape(name)}\b)", cell.source, re.MULTILINE
    ):
        raise InputError(
            f"{where}: expected the function or class {name} in the exercise of that name"
        )
    return SourceCell(
        text=_FOR_THE_FORMATTER.sub("", cell.source),
        markdown=markdown,
        kind=kinds[0] if kinds else "",
        name=name,
        solution_only="solution" in metadata.get("tags", ()),
        metadata=metadata,
    )


def build(folder: Path, key: str = "") -> dict[Path, str]:
    """Texts of both notebooks of a lab, without outputs.

    Args:
        folder: the lab's, with `lab.py` in it.
        key: of the course, which draws the numbers of the quiz; empty for the open course.

    Returns:
        The text of each notebook by its path; deterministic.

    Raises:
        FileNotFoundError, InputError: as `read_cells`.
    """
    plain = _with_version(read_cells(folder / "lab.py"))
    cells, solved = _with_quiz(folder, plain, key)
    student = [(cell, cell.for_student()) for cell in cells if not cell.solution_only]
    solution = [(cell, cell.for_solution()) for cell in solved]
    start = SourceCell(_GO_TO_THE_LAB, solution_only=True)
    solution.insert(1, (start, start.text))  # below the title
    return {
        notebook_path(folder): notebook_text(_with_files_beside(folder, student)),
        notebook_path(folder, solution=True): notebook_text(solution),
    }


def _with_quiz(
    folder: Path, cells: list[SourceCell], key: str
) -> tuple[list[SourceCell], list[SourceCell]]:
    """The cells with the quiz's questions and its open answers; and with the right answers."""
    place = next((i for i, cell in enumerate(cells) if cell.kind == "quiz"), None)
    if place is None:
        if (folder / SOURCE).is_file():
            raise InputError(f'{folder / "lab.py"}: expected a cell quiz="quiz", found none')
        return cells, cells
    questions = read_quiz(folder, key, course_constants(load_checks(folder), key))
    if not questions or not _QUIZ_LINE.search(cells[place].text):
        raise InputError(f"{folder}: expected {SOURCE}, and quiz = {{...}} in the quiz cell")
    text = SourceCell(questions_text(questions), markdown=True)
    both = []
    for solved in (False, True):
        before, _, after = _QUIZ_LINE.split(cells[place].text, maxsplit=1)
        words = f"{before}{answers_line(questions, solved=solved)}{after}"
        both.append([*cells[:place], text, replace(cells[place], text=words), *cells[place + 1 :]])
    return both[0], both[1]


def _with_version(cells: list[SourceCell]) -> list[SourceCell]:
    """The cells with the kit's version below the title, in case a program drops the metadata."""
    first = next((i for i, cell in enumerate(cells) if cell.markdown and not cell.kind), None)
    if first is None:
        return cells
    title = replace(
        cells[first], text=f"{cells[first].text.rstrip()}\n\n*Notebook of falconwing-kit {KIT}.*"
    )
    return [*cells[:first], title, *cells[first + 1 :]]


def notebook_text(cells: list[tuple[SourceCell, str]]) -> str:
    """A notebook in format 4.5, as JupyterLab writes it, with numbered cell ids."""
    record = {
        "cells": [_cell_record(number, cell, text) for number, (cell, text) in enumerate(cells)],
        "metadata": {
            KIT_KEY: KIT,
            "kernelspec": {
                "display_name": "Python 3 (ipykernel)",
                "language": "python",
                "name": "python3",
            },
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(record, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def _cell_record(number: int, cell: SourceCell, text: str) -> dict[str, Any]:
    record: dict[str, Any] = {
        "cell_type": "markdown" if cell.markdown else "code",
        "id": f"cell-{number:02d}",
        "metadata": cell.metadata,
        "source": text.splitlines(keepends=True),
    }
    return record if cell.markdown else record | {"execution_count": None, "outputs": []}


def _with_files_beside(
    folder: Path, cells: list[tuple[SourceCell, str]]
) -> list[tuple[SourceCell, str]]:
    """The cells, of which the first code says what is missing where the notebook is alone."""
    first = next((i for i, (cell, _) in enumerate(cells) if not cell.markdown), len(cells))
    lines = _FILES_BESIDE.format(folder=folder.resolve().name)
    begun = [(cell, lines + text) for cell, text in cells[first : first + 1]]
    return [*cells[:first], *begun, *cells[first + 1 :]]


def write_notebooks(folder: Path) -> list[Path]:
    """Write a lab's notebooks where they are missing or stale.

    Returns:
        The written paths.

    Raises:
        FileNotFoundError, InputError: as `read_cells`, or a file cannot be written.
    """
    written = stale_notebooks(folder)
    for path, text in build(folder).items():
        if path in written:
            path.parent.mkdir(exist_ok=True)
            with atomic_write(path, text=True) as handle:
                handle.write(text)
    return written


def stale_notebooks(folder: Path) -> list[Path]:
    """The lab's notebooks that differ from its source: missing, old or edited by hand."""
    texts = build(folder)
    return [
        p for p, text in texts.items() if not p.is_file() or p.read_text(encoding="utf-8") != text
    ]
