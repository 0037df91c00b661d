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
from falconwing_kit.tools.grading.mine import load_parts, whose
from falconwing_kit.tools.grading.moving import (
    Slider,
    figure_with_sliders,
    moving_figure,
    moving_pictures,
    plan_view,
    side_view,
)
from falconwing_kit.tools.grading.public_checks import check, check_quiz
from falconwing_kit.tools.grading.stopped import borrow, keep_going

__all__ = [
    "Check",
    "Course",
    "Criterion",
    "Exercise",
    "Function",
    "Judge",
    "Lab",
    "Slider",
    "Trials",
    "Values",
    "borrow",
    "check",
    "check_quiz",
    "figure_with_sliders",
    "is_close",
    "is_same_answer",
    "keep_going",
    "load_parts",
    "moving_figure",
    "moving_pictures",
    "plan_view",
    "side_view",
    "whose",
]
