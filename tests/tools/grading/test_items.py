"""Item statistics, against a class small enough to count."""

import math

import pytest

from falconwing_kit.tools.grading.course.items import item_statistics
from tests.tools.grading.classes import HALF, LAB, NOTHING, RIGHT, record, result


def test_class_of_four_by_hand():
    """stretch: 50, 25, 0, 0 of 50 is 37.5 % in the mean.

    One has all, one did not begin, most lost by wrong numbers.
    """
    wrong = (result(0.0, 50.0, 0, 4, wrong_value=3, not_written=1), result(25.0, 25.0, 3, 3))
    records = [record(str(n), *each) for n, each in enumerate((RIGHT, HALF, NOTHING, wrong))]
    stretch, brake = item_statistics(LAB, [*records, record("broken")])
    assert (stretch.students, stretch.mean, stretch.full, stretch.untouched) == (
        4,
        0.375,
        0.25,
        0.25,
    )
    assert stretch.commonest == "wrong value (2)"  # students, not cases
    assert (brake.mean, brake.untouched, brake.commonest) == (0.75, 0.25, "missing (1)")
    # Shares 1, .5, 0, 0 against 25, 25, 0, 25: covariance 2.34375, deviations sqrt(0.171875) and
    # sqrt(117.1875).
    assert stretch.discrimination == pytest.approx(
        2.34375 / math.sqrt(0.171875 * 117.1875), rel=1e-12
    )


def test_nothing_is_said_where_nothing_varies():
    """The correlation with a constant is undefined, as is the mean of no students."""
    stretch, _ = item_statistics(LAB, [record(str(n), *RIGHT) for n in range(5)])
    assert math.isnan(stretch.discrimination) and stretch.commonest == ""
    (stretch, _) = item_statistics(LAB, [record("broken")])
    assert stretch.students == 0 and math.isnan(stretch.mean)
