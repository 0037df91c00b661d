"""Grading: what a lab's files import: public checks, hidden judges, comparison of answers."""

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
    is_close,
    is_same_answer,
)
from falconwing_kit.tools.grading.mine import load_parts
from falconwing_kit.tools.grading.public_checks import check, check_quiz

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
    "check_quiz",
    "is_close",
    "is_same_answer",
    "load_parts",
]
