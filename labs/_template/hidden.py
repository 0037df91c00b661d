"""Lab 0, instructors only: the judges, on random cases and against a reference."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from falconwing_kit.tools.grading import Course, Judge, Values


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise, for the constants of this course."""
    glide_ratio = course.constants["glide_ratio"]

    def reference(height: Any, airspeed: float, headwind: float) -> Any:
        sink_rate = airspeed / glide_ratio
        return (airspeed - headwind) / sink_rate * np.asarray(height)

    return {"glide_range": (Values(_draw_glide, reference),)}


def _draw_glide(rng: np.random.Generator) -> tuple[Any, ...]:
    heights = rng.uniform(0.5, 4.0, int(rng.integers(1, 5)))
    return heights, float(rng.uniform(5.0, 12.0)), float(rng.uniform(-3.0, 4.0))
