"""grading: labs as students get them, checks they can run, and a judge that their code never meets."""

from falconwing_kit.tools.grading.lab import (
    Check,
    Course,
    Criterion,
    Exercise,
    Function,
    Judge,
    Lab,
    Trials,
    Values,
    is_same_answer,
)
from falconwing_kit.tools.grading.public_checks import check

__all__ = [
    "Check",
    "Course",
    "Criterion",
    "Exercise",
    "Function",
    "Judge",
    "Lab",
    "Trials",
    "Values",
    "check",
    "is_same_answer",
]
