"""Every lab's notebooks run as released: the solution to its end, the untouched one partly."""

import re

import pytest

from falconwing_kit.tools.grading.find import lab_folders, load_checks, notebook_path
from falconwing_kit.tools.grading.public_checks import SYMBOLS
from tests.labs.run_notebook import ROOT, run_notebook

FOLDERS = lab_folders(ROOT / "labs")

pytestmark = [
    pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name),
    pytest.mark.timeout(600),
]


def has_film(folder):
    """Whether a lab shows one: test_quizzes.py requires it of the course, the template has none."""
    return "moving_" in (folder / "lab.py").read_text(encoding="utf-8")


def test_solution_runs_to_its_end_with_its_figures_and_every_check_passed(folder):
    """A kernel of its own says so; what the checks print is what a student reads."""
    cells = run_notebook(notebook_path(folder, solution=True).read_text(encoding="utf-8"), folder)
    lab = load_checks(folder)
    checked = {cell.name: cell.printed for cell in cells if cell.kind == "check"}
    assert set(checked) == {exercise.name for exercise in lab.exercises}
    for name, printed in checked.items():
        count = len(lab.exercise(name).checks)
        assert printed.startswith(
            f"{SYMBOLS['passed']} {name}: {count} of {count} public checks passed"
        ), printed
        assert "!" not in printed, printed
    figures = [cell for cell in cells if cell.kind == "figure"]
    assert figures and all(cell.pictures for cell in figures)
    assert [cell.complained for cell in cells if cell.complained] == []
    first = next(number for number, cell in enumerate(cells) if cell.kind == "exercise")
    moves = any(cell.films for cell in cells[:first])
    assert moves or not has_film(folder), "nothing moves before the first exercise"
    for size, words in [film for cell in cells for film in cell.films]:
        assert 10_000 < size <= 1_010_000 and len(words) > 30


def test_untouched_notebook_only_says_what_is_not_written(folder):
    """No cell fails: one sentence each names what is missing, and checks say "not written"."""
    text = notebook_path(folder).read_text(encoding="utf-8")
    # Films, and flights of pilots that the kit trained: the solution ran them, here they differ in
    # nothing, as no function of a student is in them.
    text, films = re.subn(r'"(given\.)?moving_\w+\(.*\)"', '""', text)
    text, flights = re.subn(r"\bfly_kit_pilot\(name\)", "name", text)
    cells = run_notebook(text, folder, go_on=True)
    assert films == has_film(folder) and flights == (folder.name == "lab09_masks")
    assert {(error, cell.source) for cell in cells for error in cell.errors} == set()
    assert any("which is not written yet" in cell.printed for cell in cells)
    checks = [cell for cell in cells if cell.kind == "check"]
    assert checks and all(
        f"{cell.name}: not written yet" in cell.printed and not cell.errors for cell in checks
    )
