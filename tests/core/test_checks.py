"""Checks: what they let through and what they say."""

import math

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError, require_file, require_range, require_shape


def test_input_error_is_a_value_error():
    """Bad values are ValueErrors, so `except ValueError` of a caller still works."""
    assert issubclass(InputError, ValueError)


@pytest.mark.parametrize("value", [0.0, 1, 0.5, np.float32(0.25)])
def test_range_returns_the_number(value):
    """Bounds belong to the interval."""
    assert require_range("x", value, low=0.0, high=1.0) == float(value)


@pytest.mark.parametrize(
    "value", [-1e-12, 1.0000001, math.nan, math.inf, -math.inf, "two", None, [1.0]]
)
def test_range_refuses_what_is_outside_or_no_number(value):
    """Each is outside [0, 1] or not a finite number; the text must name the value's name."""
    with pytest.raises(InputError, match="throttle: expected"):
        require_range("throttle", value, low=0.0, high=1.0)


def test_infinite_is_refused_even_without_bounds():
    """No bound was given, yet infinity is not a measurement."""
    with pytest.raises(InputError, match="finite"):
        require_range("x", math.inf)


def test_shape_takes_any_length_for_none():
    """(2, 3) fits (any, 3)."""
    assert require_shape("p", [[1, 2, 3], [4, 5, 6]], (None, 3)).dtype == np.float64


@pytest.mark.parametrize("array", [[1.0, 2.0], [[1.0, 2.0]], "abc", [[1.0], [2.0, 3.0]], 5.0])
def test_shape_refuses_others(array):
    """None of them is (any, 3)."""
    with pytest.raises(InputError, match=r"p: expected .*\(any, 3\)"):
        require_shape("p", array, (None, 3))


def test_file_must_be_there_and_be_a_file(tmp_path):
    """A folder is not a file; nothing is not a file; a file is."""
    with pytest.raises(FileNotFoundError, match="a folder"):
        require_file(tmp_path)
    with pytest.raises(FileNotFoundError, match="nothing"):
        require_file(tmp_path / "absent.csv")
    (tmp_path / "present.csv").write_text("x")
    assert require_file(tmp_path / "present.csv").name == "present.csv"
