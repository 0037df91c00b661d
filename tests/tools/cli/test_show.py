"""Tables and JSON on the terminal."""

import json
import math

import numpy as np
import pytest

from falconwing_kit.tools.cli.show import cell_text, next_line, print_json, print_table


def test_table_aligns_numbers_right_and_text_left(capsys):
    """Laid out by hand: the widest word of a column sets its width, two spaces stand between
    columns.
    """
    print_table(("name", "speed [m/s]"), [("calm", 7.04), ("gusty day", 10.0)], title="Flights")
    assert capsys.readouterr().out.splitlines() == [
        "Flights",
        "name       speed [m/s]",
        "---------  -----------",
        "calm              7.04",
        "gusty day           10",
    ]


def test_table_without_rows_is_its_header(capsys):
    """Nothing found is still a table."""
    print_table(("name", "x [m]"), [])
    assert capsys.readouterr().out.splitlines() == ["name  x [m]", "----  -----"]


def test_row_of_another_length_is_refused():
    """A cell too few would shift every column after it."""
    with pytest.raises(ValueError, match="zip"):
        print_table(("a", "b"), [(1,)])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (math.pi, "3.142"),
        (np.float64(0.000123456), "0.0001235"),
        (123456, "123456"),
        (np.int64(7), "7"),
        (math.nan, "-"),
        (None, "-"),
        (True, "yes"),
        (np.bool_(False), "no"),
        ("wind", "wind"),
    ],
)
def test_cell_shows_four_digits_and_no_nan(value, text):
    """Rounded by hand; whole numbers keep every digit."""
    assert cell_text(value) == text


def test_json_has_no_nan_and_reads_back(capsys):
    """JSON knows no nan and no infinity: both become null, also inside arrays."""
    record = {
        "a": math.nan,
        "b": [1, math.inf],
        "c": np.array([[1.5, np.nan]]),
        "d": np.float64(2.0),
        "e": (True, None),
    }
    print_json(record)
    assert json.loads(capsys.readouterr().out) == {
        "a": None,
        "b": [1, None],
        "c": [[1.5, None]],
        "d": 2.0,
        "e": [True, None],
    }


def test_next_line_begins_with_next(capsys):
    """The form that STYLE.md, section 7, asks for."""
    next_line("falconwing identify calm.csv")
    assert capsys.readouterr().out == "next: falconwing identify calm.csv\n"
