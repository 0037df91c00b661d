"""Item statistics: a class's records -> mean, completion and discrimination of each exercise."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.tools.grading.lab import Lab

UNTOUCHED = {"not written", "missing"}  # categories of an exercise that was not begun


@dataclass(frozen=True)
class ItemStatistics:
    """Statistics of one exercise over a class.

    Attributes:
        name: of the exercise.
        students: number of graded students.
        mean: mean share of its points, 0..1; NaN without students.
        full: share of students with all its points.
        untouched: share of students who did not begin it.
        discrimination: correlation of its points with those of all other exercises, -1..1; NaN if
            either does not vary. Near 0 or below: the exercise, or its judge, measures something
            else than the lab.
        commonest: most frequent category of failure, with the number of students; empty if none.
    """

    name: str
    students: int
    mean: float
    full: float
    untouched: float
    discrimination: float
    commonest: str


def item_statistics(lab: Lab, records: Sequence[Mapping[str, Any]]) -> list[ItemStatistics]:
    """Statistics of each exercise of a lab.

    Args:
        records: each student's last one; only graded ones count.

    Returns:
        One item for each exercise, in the lab's order.
    """
    done = [record["exercises"] for record in records if record["status"] == "graded"]
    points = np.array([[each[e.name]["points"] for e in lab.exercises] for each in done]).reshape(
        len(done), len(lab.exercises)
    )
    items = []
    for number, exercise in enumerate(lab.exercises):
        results = [each[exercise.name] for each in done]
        share = points[:, number] / exercise.points if results else np.empty(0)
        lost: Counter[str] = Counter()
        for result in results:
            lost.update(set(result["categories"]))
        commonest = f"{lost.most_common(1)[0][0]} ({lost.most_common(1)[0][1]})" if lost else ""
        untouched = [
            result["right"] == 0 and set(result["categories"]) <= UNTOUCHED for result in results
        ]
        others = points.sum(axis=1) - points[:, number] if results else share
        items.append(
            ItemStatistics(
                exercise.name,
                len(results),
                _mean(share),
                _mean(share == 1.0),
                _mean(np.array(untouched)),
                _correlation(share, others),
                commonest,
            )
        )
    return items


def _mean(values: np.ndarray[Any, Any]) -> float:
    return float(values.mean()) if values.size else float("nan")


def _correlation(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> float:
    """Pearson correlation; NaN if either does not vary."""
    if a.size < 3 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])
