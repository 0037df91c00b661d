"""Labs with the switch PARTS: each runs to its end on a student's own earlier parts.

    python -m pytest -m benchmark -s tests/benchmarks/bench_own_parts.py

The parts are the solutions of twelve labs, collected as a student's; the notebook is the solution
with PARTS = "mine" in its first cell. Lab 8 draws its test flights by lab 3's functions: two
minutes on one core.
"""

import shutil
import time

import pytest

from falconwing_kit.tools.grading.find import lab_folder, notebook_path
from falconwing_kit.tools.grading.mine import write_package
from tests.labs.run_notebook import ROOT, run_notebook
from tests.labs.test_fly_your_own import students_labs
from tests.labs.test_parts import SWITCHED

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(900)]


@pytest.mark.parametrize("lab", SWITCHED)
def test_the_solution_runs_to_its_end_on_own_parts(lab, tmp_path):
    """Every figure is there, every check passed, no error; the cell of the switch says "yours"."""
    write_package(students_labs(), tmp_path / "my_falconwing")
    home = lab_folder(lab, ROOT / "labs")
    folder = shutil.copytree(home, tmp_path / home.name)
    text = notebook_path(home, solution=True).read_text(encoding="utf-8")
    assert text.count('PARTS = \\"kit\\"') == 1
    begin = time.monotonic()
    cells = run_notebook(text.replace('PARTS = \\"kit\\"', 'PARTS = \\"mine\\"'), folder)
    print(f"{lab}: {time.monotonic() - begin:.0f} s")
    print(*(cell.printed for cell in cells if cell.kind == "figure"), sep="")
    (switch,) = (cell for cell in cells if 'PARTS = "mine"' in cell.source)
    assert "yours" in switch.printed or "functions are mine" in switch.printed
    assert all(cell.pictures for cell in cells if cell.kind == "figure")
    checks = [cell for cell in cells if cell.kind == "check"]
    assert checks and all("public checks passed" in cell.printed for cell in checks)
    assert not any(cell.errors for cell in cells)
