"""Course gradebook: the reports of all labs -> one row for each student, with the course's result.

A lab's percentage loses `late_percent` for each begun day beyond the student's free ones, which are
used by the earliest labs. Of the labs, `drop_lowest` do not count: those without which the result
is best. The result is the mean of the others by weight.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, read_text
from falconwing_kit.tools.grading.course.exports import write_canvas_points
from falconwing_kit.tools.grading.course.gradebook import GradebookEntry, write_csv
from falconwing_kit.tools.grading.judge import record_state
from falconwing_kit.tools.grading.roster import Student
from falconwing_kit.tools.grading.rules import CourseRules

TOTALS = "totals.json"  # in a report's folder
_TOTALS = {"state", "total", "of", "late", "late_days"}
LATE_UNKNOWN = 1  # days counted where a platform says "late" only


@dataclass(frozen=True)
class LabResult:
    """One student's result in one lab.

    Attributes:
        state: one of STATES, or "no record".
        percent: before lateness, 0..100; None while it is not final.
        late_days: begun days late.
        counted: percentage that counts, after lateness; None while it is not final.
        dropped: it is one of the lowest, which do not count.
    """

    state: str
    percent: float | None
    late_days: int
    counted: float | None
    dropped: bool = False


@dataclass(frozen=True)
class CourseResult:
    """One student's course.

    Attributes:
        labs: results by lab.
        percent: of the course, 0..100; None while a lab is not final.
    """

    student: str
    labs: Mapping[str, LabResult]
    percent: float | None


def write_totals(path: Path, lab: str, entries: Sequence[GradebookEntry]) -> None:
    """Write what the course gradebook needs of a lab: state, points and lateness by student."""
    students = {
        entry.student: {
            "state": record_state(entry.record),
            "total": entry.total,
            "of": entry.of,
            "late": bool(entry.record.get("late")),
            "late_days": entry.record.get("late_days"),
            "known": entry.record.get("known", True),
        }
        for entry in entries
    }
    with atomic_write(path, text=True) as handle:
        handle.write(json.dumps({"lab": lab, "students": students}, indent=1) + "\n")


def read_totals(report: Path) -> tuple[str, dict[str, dict[str, Any]]]:
    """A lab's name and its students' totals, from the folder of a report.

    Raises:
        InputError: there are none in it.
    """
    file = report / TOTALS
    try:
        content = json.loads(read_text(file))
        students = dict(content["students"])
        for each in students.values():
            if not set(each) >= _TOTALS or not float(each["of"]) > 0.0:
                raise ValueError
        return str(content["lab"]), students
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        raise InputError(
            f"{report}: expected the folder that `falconwing report --out` wrote, found no {TOTALS}"
        ) from None


def course_results(
    labs: Mapping[str, Mapping[str, Mapping[str, Any]]],
    rules: CourseRules,
    roster: Sequence[str] | None,
) -> list[CourseResult]:
    """Every student's result, by name.

    Args:
        labs: by lab, in the course's order, the students' totals.
        rules: of the course.
        roster: ids of the course's students; None takes everyone in a lab.
    """
    everyone = {student for totals in labs.values() for student in totals}
    return [_course(student, labs, rules) for student in sorted(roster or everyone)]


def _course(
    student: str, labs: Mapping[str, Mapping[str, Mapping[str, Any]]], rules: CourseRules
) -> CourseResult:
    free, results = rules.late_days, {}
    for lab, totals in labs.items():
        found = totals.get(student)
        if found is None:
            results[lab] = LabResult("no record", None, 0, None)
            continue
        days = found["late_days"]
        days = (LATE_UNKNOWN if found["late"] else 0) if days is None else int(days)
        used = min(free, days)
        free -= used
        percent = None if found["total"] is None else 100.0 * found["total"] / found["of"]
        lost = min(1.0, rules.late_percent / 100.0 * (days - used))
        counted = None if percent is None else percent * (1.0 - lost)
        results[lab] = LabResult(str(found["state"]), percent, days, counted)
    dropped = _lowest(results, rules)
    results = {
        name: LabResult(each.state, each.percent, each.late_days, each.counted, name in dropped)
        for name, each in results.items()
    }
    return CourseResult(student, results, _mean(results, rules, dropped))


def _lowest(results: Mapping[str, LabResult], rules: CourseRules) -> frozenset[str]:
    """The labs without which the mean is best; none while a lab is not final."""
    count = min(rules.drop_lowest, len(results) - 1)
    ways = [frozenset(each) for each in combinations(results, count)] if count > 0 else []
    means = {way: _mean(results, rules, way) for way in ways}
    final = {way: mean for way, mean in means.items() if mean is not None}
    if len(final) < len(ways) or not ways:
        return frozenset()
    return max(ways, key=lambda way: final[way])


def _mean(
    results: Mapping[str, LabResult], rules: CourseRules, dropped: frozenset[str]
) -> float | None:
    """Mean by weight of the labs that count; None if one is not final, or nothing has a weight."""
    counted = [
        (each.counted, rules.lab(name).weight)
        for name, each in results.items()
        if name not in dropped
    ]
    weight = math.fsum(each for _, each in counted)
    if weight == 0.0 or any(value is None for value, _ in counted):
        return None
    return math.fsum((value or 0.0) * each for value, each in counted) / weight


def write_course(out: Path, results: Sequence[CourseResult], roster: Sequence[Student]) -> None:
    """Write `course.csv`, and `course_canvas.csv` for the final results of the roster's students.

    A lab's cell is its percentage after lateness, in brackets if dropped, or its state while it is
    not final; its lateness stands beside it.
    """
    known = {each.id: each for each in roster}
    labs = list(results[0].labs) if results else []
    head = ["student", "name", "group"]
    head += [
        column for lab in labs for column in (f"{lab} [%]", f"{lab} state", f"{lab} days late")
    ]
    rows = []
    for each in results:
        student = known.get(each.student, Student(each.student))
        row: list[object] = [each.student, student.name, student.group]
        for lab in labs:
            found = each.labs[lab]
            number = "" if found.counted is None else f"{found.counted:.1f}"
            row += [f"({number})" if found.dropped else number, found.state, found.late_days]
        rows.append([*row, "" if each.percent is None else round(each.percent, 2)])
    write_csv(out / "course.csv", [*head, "course [%]"], rows)
    points = {each.student: each.percent and round(each.percent, 2) for each in results}
    write_canvas_points(out / "course_canvas.csv", "course [%]", points, roster)
