"""Every lab with each of its functions missing: only the cells that need it stop, in one sentence.

The quick labs are in tests/labs/test_stopped.py; all take about fifteen minutes of one core.
"""

from pathlib import Path

import pytest

import falconwing_kit.tools.grading as grading
from falconwing_kit.tools.grading.find import lab_folders, load_checks
from tests.labs.missing import cells_that_need, run_without

ROOT = Path(__file__).resolve().parents[2]
SHORTER = {  # less training and fewer rounds of a fit: the same cells run
    "epochs: int = 40": "epochs: int = 2",
    "epochs: int = 30": "epochs: int = 1",
    "epochs=60": "epochs=2",
    "rounds=7": "rounds=1",
    "rounds=5": "rounds=1",
}

CASES = [
    (folder, exercise.name)
    for folder in lab_folders(ROOT / "labs")
    for exercise in load_checks(folder).exercises
]


@pytest.mark.benchmark
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("folder", "function"), CASES, ids=lambda each: getattr(each, "name", each)
)
def test_a_missing_function_stops_only_the_cells_that_need_it(folder, function, monkeypatch):
    """Which cells need it is read off the source; no cell may fail in any other way."""
    import matplotlib.pyplot as plt

    monkeypatch.setattr(grading, "moving_figure", lambda *_: None)
    monkeypatch.setattr(grading, "moving_pictures", lambda *_: None)
    monkeypatch.setattr(plt, "show", lambda: None)
    needed = cells_that_need(folder, function)
    for each in run_without(folder, [function], SHORTER):
        sentence = [line for line in each.printed.splitlines() if "This cell" in line]
        assert each.error == "" and "Traceback" not in each.printed, (each.number, each.printed)
        assert not sentence or each.number in needed, (each.number, sentence)
        assert all(f"your {function}" in line for line in sentence)
    plt.close("all")
