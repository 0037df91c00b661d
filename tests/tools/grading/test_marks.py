"""Marks of answers: equal up to rounding, different for every kind of difference."""

import numpy as np
import pytest

from falconwing_kit.tools.grading.hints import call_key, numbers_of
from falconwing_kit.tools.grading.marks import (
    UNSTABLE,
    mark_of,
    matches_text,
    raised_mark,
    trace_of,
    trace_text,
    weights,
)

ANSWER = (np.array([[1.5, -2.0], [3e5, 4e-4]]), {"landed": np.array([True, False])}, 7.0, "SAFE")


def _changed(**change):
    numbers = change.get("numbers", ANSWER[0])
    return (numbers, change.get("names", ANSWER[1]), change.get("last", 7.0), ANSWER[3])


@pytest.mark.parametrize(
    "other",
    [
        _changed(numbers=ANSWER[0] * [1.0, -1.0]),
        _changed(numbers=ANSWER[0][::-1]),
        _changed(numbers=ANSWER[0].T),
        _changed(numbers=ANSWER[0].ravel()),
        _changed(numbers=np.where(ANSWER[0] > 1e5, np.nan, ANSWER[0])),
        _changed(names={"landed": np.array([False, True])}),
        _changed(names={"lost": np.array([True, False])}),
        _changed(last=7.01),
        ANSWER[:3],
    ],
)
def test_a_mark_sees_sign_order_shape_missing_values_and_texts(other):
    """Each of these answers would be wrong where ANSWER is right."""
    assert not mark_of(other).agrees(mark_of(ANSWER))


def test_a_mark_is_stable_under_rounding_of_another_platform():
    """Sums in another order and fused products differ by a few 1e-16 of the terms, seldom 1e-12."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal(5000) * 10.0 ** rng.uniform(-9, 6, 5000)
    near = values * (1.0 + 1e-12 * rng.standard_normal(5000)) + 1e-13 * rng.standard_normal(5000)
    assert mark_of(values).agrees(mark_of(near))
    one_wrong = values.copy()
    one_wrong[np.argmax(np.abs(values))] *= 1.01
    assert not mark_of(values).agrees(mark_of(one_wrong))


def test_weights_are_those_of_every_platform():
    """By hand, with Python's own whole numbers, place 2: the product is kept below 2**32 twice."""
    mixed = (3 * 2654435761) % 2**32
    mixed = ((mixed ^ (mixed >> 15)) * 2246822519) % 2**32
    assert weights(3)[2] == mixed / 2**32 + 0.5
    assert weights(1, 2)[0] == weights(3)[2]


def test_a_stored_trace_matches_itself_and_no_planted_one():
    """A digit changed in the third significant place of the stored text no longer matches."""
    trace = trace_of([mark_of(float(k)) for k in range(20)])
    text = trace_text(trace, trace)
    assert matches_text(trace, text)
    parts = text.split(" ")
    parts[-1] = f"{parts[-1][:4]}{1.01 * float(parts[-1][4:]):.4f}"
    assert not matches_text(trace, " ".join(parts))
    assert not matches_text(trace, " ".join(parts[:-1])) and not matches_text(trace, "")


def test_unstable_parts_are_not_compared_and_alone_match_nothing():
    """The second call's answer changes with rounding, so it is no fingerprint."""
    trace = trace_of([mark_of(1.0), mark_of(2.0)])
    text = trace_text(trace, trace_of([mark_of(1.0), mark_of(5.0)]))
    assert text.split(" ")[1] == UNSTABLE
    assert matches_text(trace_of([mark_of(1.0), mark_of(9.0)]), text)
    assert not matches_text(trace, " ".join([UNSTABLE, UNSTABLE]))


def test_an_error_is_no_answer_of_any_kind():
    """The type's name is the mark: two errors of one type agree, those of two types do not."""
    assert raised_mark("ValueError").agrees(raised_mark("ValueError"))
    assert not raised_mark("ValueError").agrees(raised_mark("TypeError"))
    assert not raised_mark("ValueError").agrees(mark_of(0.0))


@pytest.mark.parametrize("number", [1.5, -0.0, np.inf, 3, 2**63 - 1, np.float64(123456789.123)])
def test_a_number_is_recorded_as_its_array_without_dimensions(number):
    """The quick way for single numbers against the way of arrays, by which they were stored."""
    array = np.asarray(number)
    assert mark_of(number) == mark_of(array) and numbers_of(number) == numbers_of(array)
    assert call_key((number, [number])) == call_key((array, [array]))
