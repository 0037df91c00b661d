"""A missing or failing function stops the cells that need it, with one sentence, and no others."""

from pathlib import Path

import pytest

import falconwing_kit.tools.grading as grading
from falconwing_kit.tools.grading.find import lab_folder, lab_folders, load_checks
from falconwing_kit.tools.grading.notebooks import SourceCell
from tests.labs.missing import cells_that_need, run_without

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("lab01", "lab02", "lab11")  # benchmarks/bench_missing.py runs all labs
CASES = [
    (folder.name[:5], exercise.name)
    for folder in lab_folders(ROOT / "labs")
    if folder.name[:5] in QUICK
    for exercise in load_checks(folder).exercises
]


@pytest.fixture(autouse=True)
def no_films(monkeypatch):
    """The moving figures take seconds, and have tests of their own."""
    import matplotlib.pyplot as plt

    monkeypatch.setattr(grading, "moving_figure", lambda *_: None)
    monkeypatch.setattr(grading, "moving_pictures", lambda *_: None)
    monkeypatch.setattr(plt, "show", lambda: None)
    yield
    plt.close("all")


@pytest.mark.parametrize(("lab", "function"), CASES)
def test_a_missing_function_stops_only_the_cells_that_need_it(lab, function):
    """Which cells need it: those that name it or what such a cell makes, read off the source."""
    folder = lab_folder(lab, ROOT / "labs")
    needed = cells_that_need(folder, function)
    said = 0
    for each in run_without(folder, [function], {}):
        assert each.error == "", (each.number, each.printed)
        assert "Traceback" not in each.printed
        sentence = [line for line in each.printed.splitlines() if "This cell" in line]
        assert not sentence or each.number in needed, (each.number, sentence)
        assert all(f"your {function}" in line for line in sentence)
        said += len(sentence)
    assert said >= 1


def run_cells(*cells):
    """Cells after they ran in a fresh shell, in lab 1's folder."""
    start = "from falconwing_kit.tools.grading import keep_going\nkeep_going()"
    sources = [SourceCell(text) for text in (start, *cells)]
    return run_without(lab_folder("lab01", ROOT / "labs"), [], {}, sources)[1:]


def test_a_function_that_fails_shows_its_traceback_and_the_next_cell_runs():
    """The student needs the traceback; the cell after it needs nothing of it."""
    first, second = run_cells(
        "def min_speed(m):\n    return m / 0\nv = min_speed(3)", "print('next')"
    )
    assert first.error == "" and "ZeroDivisionError" in first.printed
    assert "This cell ended in your min_speed" in first.printed
    assert second.printed.strip() == "next"


def test_an_unwritten_method_is_named_by_its_class():
    """The exercise is the class; nobody looks for `__init__`."""
    stub = (
        "class min_speed:\n    def __init__(self):\n        raise NotImplementedError('write it')"
    )
    _, used, after = run_cells(stub, "speed = min_speed()", "print('next')")
    assert used.error == "" and "This cell needs your min_speed, which is not" in used.printed
    assert after.printed.strip() == "next"


def test_what_a_stopped_cell_would_have_made_is_traced_back_to_the_function():
    """`speed` is missing because `min_speed` is; once it is there, nothing is said any more."""
    stub = "def min_speed(m):\n    raise NotImplementedError('write min_speed')"
    _, _, third, *_, last = run_cells(
        stub,
        "speed = min_speed(3)",
        "print(speed)",
        "min_speed = float",
        "speed = min_speed(3)",
        "print(speed)",
    )
    assert third.error == "" and third.printed.count("\n") == 1
    assert "`speed`" in third.printed and "min_speed" in third.printed
    assert last.printed.strip() == "3.0"


@pytest.mark.parametrize("code", ["nobody_made_this", "raise NotImplementedError('mine')", "1 / 0"])
def test_any_other_error_stops_as_always(code):
    """A mistake in a cell of the student's own must not look as if it had run."""
    (ran,) = run_cells(code)
    assert ran.error in ("NameError", "NotImplementedError", "ZeroDivisionError")
    assert ran.error in ran.printed and "This cell" not in ran.printed


def test_a_borrowed_function_draws_says_so_and_earns_nothing():
    """The stub is replaced until its own cell runs again; 150 g at 20 degrees, by hand:

    sqrt(2 * 0.15 * 9.8 / (1.204 * 0.076 * 0.6)) = 7.32.
    """
    stub = "def min_speed(m, t):\n    raise NotImplementedError('write min_speed')"
    use = "print(round(float(min_speed(150.0, 20.0)), 2))"
    imports = "from falconwing_kit.tools.grading import borrow, check"
    ran = run_cells(imports, stub, use, "borrow('min_speed')", use, "check(min_speed)", stub, use)
    printed = [each.printed for each in ran]
    assert "not written" in printed[2] and 'borrow("min_speed")' in printed[2]
    assert printed[4].splitlines() == ["7.32", "drawn with the kit's min_speed"]
    assert "borrowed" in printed[5] and "passed" not in printed[5]
    assert "not written" in printed[7]
    assert all(each.error == "" for each in ran)


def test_only_an_exercise_can_be_borrowed():
    """A misspelt name: the list of those that there are."""
    ran = run_cells("from falconwing_kit.tools.grading import borrow\nborrow('min_sped')")
    assert ran[0].error == "InputError" and "min_speed" in ran[0].printed


def test_outside_of_a_notebook_nothing_happens():
    """No shell: no hook, no error."""
    assert grading.keep_going() is None
