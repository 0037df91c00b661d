"""Exports: a lab's entries and the roster -> files that Moodle, Canvas and Gradescope take as is.

Moodle identifies a hand-in by "Participant" and the number that its export has in each folder's
name; Canvas a student by its own number or login, which the roster has.
"""

import io
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.course.gradebook import GradebookEntry, write_csv
from falconwing_kit.tools.grading.roster import Student
from falconwing_kit.tools.grading.rules import LabRules

_MOODLES = re.compile(r"(.+)_(\d+)")
_SAME_DATE = (1980, 1, 1, 0, 0, 0)  # so that the same content gives the same bytes


def write_moodle(out: Path, entries: Sequence[GradebookEntry], feedback: Path) -> int:
    """Write `moodle.csv`, a grading worksheet, and `moodle_feedback.zip` with each student's page.

    Args:
        out: folder of the report.
        entries: of the lab; those that came from elsewhere are left out.
        feedback: folder of the pages.

    Returns:
        How many students are in them.
    """
    rows, archive = [], io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as pages:
        for entry in entries:
            found = _MOODLES.fullmatch(entry.record.get("entry", ""))
            if entry.record.get("platform") != "moodle" or not found:
                continue
            points = "" if entry.total is None else entry.total
            rows.append(
                (f"Participant {found[2]}", found[1], points, entry.of, entry.person.comment)
            )
            page = feedback / f"{entry.file_name}.html"
            name = f"{found[0]}_assignsubmission_file_/feedback.html"
            pages.writestr(zipfile.ZipInfo(name, _SAME_DATE), page.read_bytes())
    head = ("Identifier", "Full name", "Grade", "Maximum Grade", "Feedback comments")
    write_csv(out / "moodle.csv", head, rows)
    with atomic_write(out / "moodle_feedback.zip") as handle:
        handle.write(archive.getvalue())
    return len(rows)


def write_canvas(
    path: Path,
    lab: str,
    rules: LabRules,
    entries: Sequence[GradebookEntry],
    roster: Sequence[Student],
) -> int:
    """Write Canvas's gradebook of one assignment.

    Args:
        path: of the CSV file.
        lab: its name, the column where the rules name none.
        rules: of the lab.
        entries: of the lab.
        roster: with Canvas's numbers or logins.

    Returns:
        How many students are in it: those with a final total.
    """
    totals = {entry.student: entry.total for entry in entries}
    return write_canvas_points(path, rules.canvas or lab, totals, roster)


def write_canvas_points(
    path: Path, column: str, points: Mapping[str, float | None], roster: Sequence[Student]
) -> int:
    """Write points of the roster's students as Canvas's gradebook; those without are left out."""
    rows = []
    for student in roster:
        if points.get(student.id) is not None:
            login = next(iter(student.others), "")
            name = student.name or student.id
            rows.append((name, student.canvas, "", login, student.group, points[student.id]))
    head = ("Student", "ID", "SIS User ID", "SIS Login ID", "Section", column)
    write_csv(path, head, rows)
    return len(rows)
