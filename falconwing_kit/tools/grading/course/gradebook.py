"""Gradebook: automatic records and manual points -> one entry per student, and exports.

A total exists only when it is final: the submission was graded or is unreadable, and all manual
points are given.
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.lab import Lab, total_points
from falconwing_kit.tools.grading.records import (
    read_table,
    safe_file_name,
    spreadsheet_cell,
)

COMMENT, ITEMS = "comment", "items"  # columns of the rubric file: for the student, what was clicked
MAX_ITEMS = 50  # of a student


class RubricItem(NamedTuple):
    """A reason for points of any number of students: criterion, text, points (negative: lost)."""

    criterion: str
    text: str
    points: float


@dataclass(frozen=True)
class ManualGrade:
    """Points and comment of a person who grades.

    Attributes:
        points: by criterion; ungraded ones are missing.
        comment: for the student.
        items: that the points were clicked together from.
    """

    points: Mapping[str, float] = field(default_factory=dict)
    comment: str = ""
    items: tuple[RubricItem, ...] = ()


@dataclass(frozen=True)
class GradebookEntry:
    """One student's entry.

    Attributes:
        student: name.
        record: the student's last one.
        person: manual points.
        quiz_points: what the quiz is worth in this course; 0 if it does not count.
    """

    lab: Lab
    student: str
    record: Mapping[str, Any]
    person: ManualGrade
    quiz_points: float = 0.0

    @property
    def quiz(self) -> float | None:
        """Points of the quiz; None where it was not marked."""
        if self.record["status"] in ("unreadable", "wrong lab"):
            return 0.0
        marked = self.record.get("quiz")
        return None if marked is None else self.quiz_points * marked["right"] / marked["of"]

    @property
    def machine(self) -> float | None:
        """Automatic points; None where grading failed."""
        points = self.record["points"]
        return None if points is None else float(points)

    @property
    def total(self) -> float | None:
        """All points; 0 for nothing handed in; None while some are missing."""
        if self.record["status"] == "missing":
            return 0.0
        given = [self.person.points.get(each.name) for each in self.lab.rubric]
        given += [self.quiz] if self.quiz_points else []
        if self.machine is None or None in given:
            return None
        return round(math.fsum([self.machine, *(each for each in given if each is not None)]), 4)

    @property
    def of(self) -> float:
        """Maximum points."""
        return math.fsum(
            [total_points(self.lab), self.quiz_points, *(each.points for each in self.lab.rubric)]
        )

    @property
    def file_name(self) -> str:
        """A unique file name for the student that is valid on every system."""
        return safe_file_name(self.student)


def make_entries(
    lab: Lab,
    records: Mapping[str, Mapping[str, Any]],
    rubric: Mapping[str, ManualGrade],
    quiz_points: float = 0.0,
) -> list[GradebookEntry]:
    """An entry for each student with a record, by name."""
    return [
        GradebookEntry(lab, name, records[name], rubric.get(name, ManualGrade()), quiz_points)
        for name in sorted(records)
    ]


def read_rubric(path: Path, lab: Lab, students: Iterable[str]) -> dict[str, ManualGrade]:
    """Manual points from the rubric page's file, or from a spreadsheet.

    Args:
        path: a CSV file with the columns `student`, the names of the lab's criteria, and `comment`;
            empty cells are not graded yet, criteria and the page's `items` may be missing.
        students: with a record.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a column, a student or a number is invalid.
    """
    columns, rows = read_table(path)
    known = {str(spreadsheet_cell(name)): name for name in students}
    known |= {name: name for name in known.values()}
    names = [each.name for each in lab.rubric]
    unknown = sorted(set(columns) - {"student", COMMENT, ITEMS, *names})
    if "student" not in columns or unknown:
        expected = ", ".join(["student", *names, COMMENT])
        raise InputError(
            f"{path}: expected the columns {expected}, got {', '.join(columns) or 'nothing'}"
        )
    found: dict[str, ManualGrade] = {}
    for row in rows:
        student = known.get(row["student"])
        if student is None or student in found:
            why = "twice" if student else "without a record"
            raise InputError(
                f"{path}: expected every student of the records once, got {row['student']!r} {why}"
            )
        cells = {each: row.get(each.name, "") for each in lab.rubric}
        where = f"{path}: {student}"
        points = {
            each.name: _points(where, each.name, text, each.points)
            for each, text in cells.items()
            if text
        }
        comment = row.get(COMMENT, "")
        found[student] = ManualGrade(
            points,
            comment[1:] if spreadsheet_cell(comment[1:]) == comment else comment,
            _items(where, row.get(ITEMS, ""), names),
        )
    return found


def _items(where: str, text: str, criteria: Sequence[str]) -> tuple[RubricItem, ...]:
    """Items of the page's column, which is JSON: a list of criterion, text, points."""
    try:
        found = [
            RubricItem(str(name), str(words)[:200], float(points))
            for name, words, points in json.loads(text or "[]")
        ]
    except (ValueError, TypeError):
        found = [RubricItem("", "", math.nan)]
    if len(found) > MAX_ITEMS or not all(
        item.criterion in criteria and math.isfinite(item.points) for item in found
    ):
        raise InputError(f"{where}: expected {ITEMS} as the rubric page saves them, or nothing")
    return tuple(found)


def _points(where: str, name: str, text: str, most: float) -> float:
    try:
        points = float(text.replace(",", "."))
    except ValueError:
        points = math.nan
    if not 0.0 <= points <= most:
        raise InputError(f"{where}: expected 0 to {most:g} points for {name}, got {text!r}")
    return points


def write_gradebook(path: Path, lab: Lab, entries: Sequence[GradebookEntry]) -> None:
    """Write the full gradebook as CSV: points of exercises and criteria, and final totals."""
    exercises, criteria = [each.name for each in lab.exercises], [each.name for each in lab.rubric]
    quiz = any("quiz" in entry.record for entry in entries)
    head = [
        "student",
        *exercises,
        "machine",
        *(["quiz right"] if quiz else []),
        *criteria,
        "total",
        "of",
        "status",
        "late days",
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
            "unknown"
            if record.get("late") and record["late_days"] is None
            else record.get("late_days", 0),
            record["problem"],
            record["sandboxed"],
            entry.person.comment,
        ]
        right = [record["quiz"]["right"] if "quiz" in record else None] if quiz else []
        rows.append([entry.student, *machine, entry.machine, *right, *person, *ends])
    write_csv(path, head, rows)


def write_platform_csv(path: Path, lab: Lab, entries: Sequence[GradebookEntry]) -> None:
    """Write a learning platform's import: student, final points, comment; no incomplete entries."""
    done = [entry for entry in entries if entry.total is not None]
    head = ["student", f"{lab.name} [of {done[0].of if done else 100:g}]", COMMENT]
    write_csv(path, head, [[entry.student, entry.total, entry.person.comment] for entry in done])


def write_csv(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table, complete or not at all, with texts quoted against formula injection."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([spreadsheet_cell(value) for value in row] for row in rows)
    with atomic_write(path, text=True) as handle:
        handle.write(table.getvalue())


def gradescope_results(entry: GradebookEntry, said: Mapping[str, str]) -> dict[str, Any]:
    """A student's `results.json`, as Gradescope's autograder reads it.

    Args:
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
    if entry.quiz_points and entry.quiz is not None:
        marked = entry.record.get("quiz", {"right": 0, "of": 0})
        words = f"{marked['right']} of {marked['of']} questions right"
        tests.append(_test("quiz", round(entry.quiz, 4), entry.quiz_points, words))
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
    """Write `results.json` for each graded student, in a folder each."""
    for entry in entries:
        if entry.machine is None:
            continue
        place = folder / entry.file_name
        place.mkdir(parents=True, exist_ok=True)
        with atomic_write(place / "results.json", text=True) as handle:
            handle.write(
                json.dumps(gradescope_results(entry, said.get(entry.student, {})), indent=1) + "\n"
            )
