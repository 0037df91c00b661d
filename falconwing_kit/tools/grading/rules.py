"""Rules of a course: `course.toml` in its folder -> deadlines, late days, weights.

late_days = 3             # free ones of each student over the course
late_percent = 10         # of a lab's points, for each further day
drop_lowest = 2           # labs that do not count
quiz_points = 5           # of each lab's quiz, on top of its 100; 0 unless given

[labs.lab03]
deadline = 2027-10-08T23:59:00+02:00
weight = 2.0              # 1 unless given
canvas = "Lab 3 (4711)"   # the assignment's column in Canvas's gradebook
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.files import read_text

RULES_FILE = "course.toml"
_KEYS = {"late_days", "late_percent", "drop_lowest", "quiz_points", "labs"}
_LAB_KEYS = {"deadline", "weight", "canvas"}


@dataclass(frozen=True)
class LabRules:
    """Rules of one lab.

    Attributes:
        deadline: with its time zone; None for none.
        weight: in the course.
        canvas: column of the assignment in Canvas's gradebook; empty: the lab's name.
    """

    deadline: datetime | None = None
    weight: float = 1.0
    canvas: str = ""


@dataclass(frozen=True)
class CourseRules:
    """Rules of a course.

    Attributes:
        late_days: free ones of each student, over all labs.
        late_percent: of a lab's points, lost for each further day.
        drop_lowest: number of labs that do not count.
        labs: by name, "lab03".
        quiz_points: of a lab's quiz, beyond its other points.
    """

    late_days: int = 0
    late_percent: float = 0.0
    drop_lowest: int = 0
    labs: Mapping[str, LabRules] = field(default_factory=dict)
    quiz_points: float = 0.0

    def lab(self, name: str) -> LabRules:
        """Rules of a lab; the usual ones for a lab that is not named."""
        return self.labs.get(name, LabRules())


def read_rules(folder: Path | None) -> CourseRules:
    """Rules of the course in a folder; without a folder or file the usual ones.

    Raises:
        InputError: the file is not TOML, or a key or value is not one of these.
    """
    file = None if folder is None else folder / RULES_FILE
    if file is None or not file.exists():
        return CourseRules()
    try:
        content = tomllib.loads(read_text(file))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{file}: expected TOML, got {error}") from None
    _require_keys(file, content, _KEYS)
    labs = content.pop("labs", {})
    if not isinstance(labs, dict) or not all(isinstance(each, dict) for each in labs.values()):
        raise InputError(f"{file}: expected sections such as [labs.lab03]")
    for name, value in content.items():
        require_range(f"{file}: {name}", _number(file, name, value), low=0.0, high=100.0)
    found = {name: _lab_rules(f"{file}: {name}", each) for name, each in labs.items()}
    return CourseRules(
        int(content.get("late_days", 0)),
        float(content.get("late_percent", 0.0)),
        int(content.get("drop_lowest", 0)),
        found,
        float(content.get("quiz_points", 0.0)),
    )


def _lab_rules(where: str, content: Mapping[str, Any]) -> LabRules:
    _require_keys(where, content, _LAB_KEYS)
    deadline = content.get("deadline")
    if isinstance(deadline, date) and not isinstance(deadline, datetime):
        deadline = datetime.combine(deadline, time(23, 59, 59))
    if deadline is not None and not isinstance(deadline, datetime):
        raise InputError(f"{where}: expected a deadline such as 2027-10-08T23:59:00+02:00")
    if deadline is not None and deadline.tzinfo is None:
        deadline = deadline.astimezone()  # this machine's time zone
    weight = _number(where, "weight", content.get("weight", 1.0))
    require_range(f"{where}: weight", weight, low=0.0, high=1000.0)
    return LabRules(deadline, weight, str(content.get("canvas", "")))


def _number(where: object, name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: expected a number for {name}, got {value!r}")
    return float(value)


def _require_keys(where: object, content: Mapping[str, Any], known: set[str]) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        raise InputError(f"{where}: expected {', '.join(sorted(known))}, got {', '.join(unknown)}")


def days_late(handed_in: str, deadline: datetime | None, extension_days: int) -> int | None:
    """Begun days after a student's deadline; 0 in time; None if one of the two is unknown.

    Args:
        handed_in: time in ISO 8601, from the platform; empty if unknown.
        deadline: of the lab.
        extension_days: of the student.
    """
    if not handed_in or deadline is None:
        return None
    when = datetime.fromisoformat(handed_in)
    when = when if when.tzinfo else when.replace(tzinfo=UTC)
    late = when - deadline - timedelta(days=extension_days)
    return max(0, math.ceil(late / timedelta(days=1)))
