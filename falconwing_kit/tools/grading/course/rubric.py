"""Rubric page: figures and answers -> one page with fields for a person's points.

Points are typed, or clicked together from rubric items ("no units, -1"). An item that is changed
later changes the points of every student who has it. The page needs no server: the browser stores
the points, and a button saves points.csv, which `falconwing report --rubric points.csv` merges into
the gradebook. Students' texts are escaped.
"""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.course.gradebook import COMMENT, ITEMS, GradebookEntry, RubricItem
from falconwing_kit.tools.grading.course.looks import RubricPart
from falconwing_kit.tools.grading.lab import Lab
from falconwing_kit.tools.grading.records import spreadsheet_cell
from falconwing_kit.tools.reports.page import write_page

Looked = Mapping[str, Any]  # a result of `looks.inspect_submission`
PAGE = Path(__file__).with_name("rubric.html.j2")
FIGURES = "figures"
_FROM = {
    "run": "from a run of the notebook in the sandbox",
    "stored": "as stored in the notebook; a new run drew no figure here",
    "run, all": "all figures from a run in the sandbox: the figure's own cell was not found",
    "stored, all": "all stored figures: the figure's own cell was not found, a new run drew none",
    "not run": "as stored in the notebook, which was not run",
    "not run, all": "all stored figures: the figure's own cell was not found, the notebook not run",
    "none": "no figure",
}


def write_rubric(
    out: Path,
    lab: Lab,
    parts: Sequence[RubricPart],
    entries: Sequence[GradebookEntry],
    looked: Mapping[str, Looked],
) -> Path:
    """Write the page, and the figures into a folder beside it.

    Args:
        parts: from `looks.rubric_parts`.
        entries: with the points given already.
        looked: inspection of each student's submission.

    Returns:
        The page's path.
    """
    (out / FIGURES).mkdir(parents=True, exist_ok=True)
    page = out / "rubric.html"
    write_page(
        page,
        PAGE,
        lab=lab,
        comment=COMMENT,
        names=[each.name for each in lab.rubric],
        most={each.name: each.points for each in lab.rubric},
        items=rubric_items(lab, entries),
        items_column=ITEMS,
        given={
            str(spreadsheet_cell(entry.student)): [list(each) for each in entry.person.items]
            for entry in entries
            if entry.person.items
        },
        key=f"falconwing rubric {lab.name} {out.resolve().name}",
        criteria=list(zip(lab.rubric, parts, strict=True)),
        students=[
            _student(out, entry, parts, looked[entry.student])
            for entry in entries
            if entry.student in looked
        ],
    )
    return page


def rubric_items(lab: Lab, entries: Sequence[GradebookEntry]) -> list[RubricItem]:
    """The items that were used already, by criterion; where there are none, all and half of it."""
    used = dict.fromkeys(item for entry in entries for item in entry.person.items)
    known = {item.criterion for item in used}
    first = [
        RubricItem(each.name, text, share * each.points)
        for each in lab.rubric
        if each.name not in known
        for text, share in (("all of it", 1.0), ("half of it", 0.5))
    ]
    return [*used, *first]


def _student(
    out: Path, entry: GradebookEntry, parts: Sequence[RubricPart], seen: Looked
) -> dict[str, Any]:
    """The page's data of a student: figures, answers, and known points."""
    return {
        "name": entry.student,
        "cell": spreadsheet_cell(entry.student),
        "problem": seen["problem"],
        "figures": [
            _figure(out, entry, part, seen["figures"].get(part.name))
            for part in parts
            if part.is_figure
        ],
        "answers": [
            (part.name, seen["answers"].get(part.name, "")) for part in parts if not part.is_figure
        ],
        "points": {name: f"{points:g}" for name, points in entry.person.points.items()},
        "comment": entry.person.comment,
    }


def _figure(
    out: Path, entry: GradebookEntry, part: RubricPart, seen: Mapping[str, Any] | None
) -> tuple[str, list[str], str]:
    """A figure's name, its picture files beside the page, and their source."""
    images, source = (seen["images"], seen["from"]) if seen else ([], "none")
    files = []
    for number, image in enumerate(images):
        file = out / FIGURES / f"{entry.file_name}_{part.name}_{number}.png"
        with atomic_write(file) as handle:
            handle.write(base64.b64decode(image))
        files.append(f"{FIGURES}/{file.name}")
    return part.name, files, _FROM[source]
