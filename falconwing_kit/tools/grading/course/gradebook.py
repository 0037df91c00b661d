"""Gradebook: the machine's records and a person's points -> one line per student, for people,
Gradescope and platforms.

A total stands only where it is final: the submission was graded or is unreadable, and a person gave
all its points.
"""

import csv
import hashlib
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.lab import Lab, total_points
from falconwing_kit.tools.grading.records import spreadsheet_cell

COMMENT = "comment"  # the rubric file's column for words to the student


@dataclass(frozen=True)
class ManualGrade:
    """What a person gave a student.

    Attributes:
        points: by the criterion's name; those not graded yet are missing.
        comment: for the student to read.
    """

    points: Mapping[str, float] = field(default_factory=dict)
    comment: str = ""


@dataclass(frozen=True)
class GradebookEntry:
    """A student's line.

    Attributes:
        lab: the lab.
        student: who.
        record: the student's last one.
        person: what a person gave.
    """

    lab: Lab
    student: str
    record: Mapping[str, Any]
    person: ManualGrade

    @property
    def machine(self) -> float | None:
        """The machine's points; None where it could not grade."""
        points = self.record["points"]
        return None if points is None else float(points)

    @property
    def total(self) -> float | None:
        """All points; None while some are missing."""
        given = [self.person.points.get(each.name) for each in self.lab.rubric]
        if self.machine is None or None in given:
            return None
        return round(math.fsum([self.machine, *(each for each in given if each is not None)]), 4)

    @property
    def of(self) -> float:
        """Points that there are."""
        return total_points(self.lab) + math.fsum(each.points for each in self.lab.rubric)

    @property
    def file_name(self) -> str:
        """A name for the student's files that every system allows and nobody else has."""
        plain = re.sub(r"[^A-Za-z0-9_@+-]+", "_", self.student).strip("_")[:48]
        mark = hashlib.sha256(self.student.encode()).hexdigest()[:6]
        return self.student if plain == self.student else f"{plain or 'student'}-{mark}"


def make_entries(
    lab: Lab, records: Mapping[str, Mapping[str, Any]], rubric: Mapping[str, ManualGrade]
) -> list[GradebookEntry]:
    """A line for each student who has a record, by name."""
    return [
        GradebookEntry(lab, name, records[name], rubric.get(name, ManualGrade()))
        for name in sorted(records)
    ]


def read_rubric(path: Path, lab: Lab, students: Iterable[str]) -> dict[str, ManualGrade]:
    """What a person gave, from the file that the rubric page saves, or one typed in a spreadsheet.

    Args:
        path: a CSV file with the columns `student`, the names of the lab's criteria, and `comment`;
            empty cells are not graded yet, criteria may be missing.
        lab: the lab.
        students: who has a record.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a column, a student or a number in it cannot be meant.
    """
    with require_file(path).open(encoding="utf-8-sig", newline="") as handle:
        reader = csv.DictReader(handle)
        columns, rows = list(reader.fieldnames or ()), list(reader)
    known = {str(spreadsheet_cell(name)): name for name in students}
    known |= {name: name for name in known.values()}
    names = [each.name for each in lab.rubric]
    strange = sorted(set(columns) - {"student", COMMENT, *names})
    if "student" not in columns or strange:
        wanted = ", ".join(["student", *names, COMMENT])
        raise InputError(
            f"{path}: expected the columns {wanted}, got {', '.join(columns) or 'nothing'}"
        )
    found: dict[str, ManualGrade] = {}
    for row in rows:
        student = known.get((row["student"] or "").strip())
        if student is None or student in found:
            why = "twice" if student else "without a record"
            raise InputError(
                f"{path}: expected every student of the records once, got {row['student']!r} {why}"
            )
        cells = {each: (row.get(each.name) or "").strip() for each in lab.rubric}
        where = f"{path}: {student}"
        points = {
            each.name: _points(where, each.name, text, each.points)
            for each, text in cells.items()
            if text
        }
        comment = (row.get(COMMENT) or "").strip()
        found[student] = ManualGrade(
            points, comment[1:] if comment[:2] in ("'=", "'+", "'-", "'@") else comment
        )
    return found


def _points(where: str, name: str, text: str, most: float) -> float:
    try:
        points = float(text.replace(",", "."))
    except ValueError:
        points = math.nan
    if not 0.0 <= points <= most:
        raise InputError(f"{where}: expected 0 to {most:g} points for {name}, got {text!r}")
    return points


def write_gradebook(path: Path, lab: Lab, entries: Sequence[GradebookEntry]) -> None:
    """The whole gradebook as CSV: points of each exercise, of each criterion, and the total where
    it is final.
    """
    exercises, criteria = [each.name for each in lab.exercises], [each.name for each in lab.rubric]
    head = [
        "student",
        *exercises,
        "machine",
        *criteria,
        "total",
        "of",
        "status",
        "note",
        "sandboxed",
        COMMENT,
    ]
    rows = []
    for entry in entries:
        done, record = entry.record["exercises"], entry.record
        machine = [done[name]["points"] if name in done else None for name in exercises]
        person = [entry.person.points.get(name) for name in criteria]
        ends = [
            entry.total,
            entry.of,
            record["status"],
            record["problem"],
            record["sandboxed"],
            entry.person.comment,
        ]
        rows.append([entry.student, *machine, entry.machine, *person, *ends])
    write_csv(path, head, rows)


def write_platform_csv(path: Path, lab: Lab, entries: Sequence[GradebookEntry]) -> None:
    """What a learning platform imports: student, final points, and the comment; who has no total
    yet is left out.
    """
    done = [entry for entry in entries if entry.total is not None]
    head = ["student", f"{lab.name} [of {done[0].of if done else 100:g}]", COMMENT]
    write_csv(path, head, [[entry.student, entry.total, entry.person.comment] for entry in done])


def write_csv(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A table, whole or not at all, in which no text is taken for a formula."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([spreadsheet_cell(value) for value in row] for row in rows)
    with atomic_write(path, text=True) as handle:
        handle.write(table.getvalue())


def gradescope_results(entry: GradebookEntry, said: Mapping[str, str]) -> dict[str, Any]:
    """A student's `results.json`, as Gradescope's autograder reads it.

    Args:
        entry: the student's line.
        said: for each exercise a sentence about its hidden cases.

    Returns:
        One test for each exercise and each criterion that a person has graded; the score is their
        sum.
    """
    tests = []
    for exercise in entry.lab.exercises:
        done = entry.record["exercises"].get(exercise.name, {"points": 0.0})
        tests.append(
            _test(exercise.name, done["points"], exercise.points, said.get(exercise.name, ""))
        )
    for each in entry.lab.rubric:
        if each.name in entry.person.points:
            tests.append(
                _test(each.name, entry.person.points[each.name], each.points, "graded by a person")
            )
    score = math.fsum(test["score"] for test in tests)
    return {
        "score": round(score, 4),
        "output": entry.person.comment or entry.record["problem"],
        "stdout_visibility": "hidden",
        "visibility": "visible",
        "tests": tests,
    }


def _test(name: str, points: float, most: float, output: str) -> dict[str, Any]:
    return {
        "name": name,
        "score": points,
        "max_score": most,
        "status": "passed" if points == most else "failed",
        "output": output,
        "visibility": "visible",
    }


def write_gradescope(
    folder: Path, entries: Sequence[GradebookEntry], said: Mapping[str, Mapping[str, str]]
) -> None:
    """A folder for each student with its `results.json`; who could not be graded gets none."""
    for entry in entries:
        if entry.machine is None:
            continue
        place = folder / entry.file_name
        place.mkdir(parents=True, exist_ok=True)
        with atomic_write(place / "results.json", text=True) as handle:
            handle.write(
                json.dumps(gradescope_results(entry, said.get(entry.student, {})), indent=1) + "\n"
            )
