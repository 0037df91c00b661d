"""Lab 0, public: the exercises, their public checks, and the rubric."""

import numpy as np
from given import COHORT

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

GLIDE_RATIO = COHORT["glide_ratio"]


def _still_air(glide_range: Function) -> bool:
    """By hand: without wind R = h E, whatever the airspeed."""
    return is_same_answer(glide_range(2.0, 7.0, 0.0), 2.0 * GLIDE_RATIO)


def _half_the_airspeed(glide_range: Function) -> bool:
    """By hand: a headwind of half the airspeed halves the range, h E = 3 E."""
    return is_same_answer(glide_range(3.0, 8.0, 4.0), 1.5 * GLIDE_RATIO)


def _array_of_heights(glide_range: Function) -> bool:
    """R is proportional to h; an array comes back as an array of its shape."""
    ranges = glide_range(np.array([1.0, 2.0, 4.0]), 6.0, -1.5)
    return is_same_answer(ranges, 1.25 * GLIDE_RATIO * np.array([1.0, 2.0, 4.0]))


LAB = Lab(
    name="lab00",
    title="Gliding",
    hours=1.0,
    exercises=(
        Exercise(
            "glide_range",
            75.0,
            (
                Check(
                    "in still air the range is the height times the glide ratio",
                    _still_air,
                    "the glide ratio is the distance flown per height lost; use COHORT",
                ),
                Check(
                    "a headwind of half the airspeed halves the range",
                    _half_the_airspeed,
                    "the headwind lowers the ground speed, not the sink rate",
                ),
                Check(
                    "a tailwind of a quarter of the airspeed adds a quarter, "
                    "for every height of an array",
                    _array_of_heights,
                    "a tailwind is a negative headwind; NumPy multiplies arrays element by element",
                ),
            ),
        ),
    ),
    rubric=(
        Criterion("range", 10.0, "two falling lines that cross at zero wind; labels with units"),
        Criterion("range_reading", 5.0, "still air, where R = h E"),
        Criterion("q1", 10.0, "faster, from (V - w) / V"),
    ),
    constants={"glide_ratio": (5.0, 9.0, 1)},
)
