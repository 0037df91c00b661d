"""A small class on the toy lab, as records by hand: what the tests of reports work on."""

from falconwing_kit.tools.grading.find import load_checks
from tests.tools.grading import toys

LAB = load_checks(toys.LAB)


def result(points, of, right, cases, **categories):
    """An exercise's part of a record."""
    named = {name.replace("_", " "): count for name, count in categories.items()}
    return {
        "points": points,
        "of": of,
        "right": right,
        "cases": cases,
        "categories": named,
        "problems": [],
    }


def record(student, stretch=None, brake=None, **more):
    """A student's record; without results nothing was graded."""
    exercises = {"stretch": stretch, "brake": brake} if stretch else {}
    points = sum(each["points"] for each in exercises.values()) if stretch else None
    plain = {
        "student": student,
        "sha256": "",
        "status": "graded" if stretch else "error",
        "problem": "",
        "of": 75.0,
    }
    return (
        plain | {"lab": "lab00", "points": points, "sandboxed": True, "exercises": exercises} | more
    )


RIGHT = (result(50.0, 50.0, 4, 4), result(25.0, 25.0, 3, 3))
NOTHING = (result(0.0, 50.0, 0, 4, not_written=4), result(0.0, 25.0, 0, 3, missing=3))
HALF = (result(25.0, 50.0, 2, 4, wrong_value=2), result(25.0, 25.0, 3, 3))
