"""The seven labs that need no installation, in plain NumPy: CPU time of all cells, lab by lab.

    python -m pytest -m benchmark -s tests/benchmarks/bench_no_install.py

On this machine's Python, not in a browser, whose Python is several times slower.
"""

import pytest

from falconwing_kit.tools.grading.find import lab_folder, load_checks, notebook_path
from falconwing_kit.tools.grading.hosted import IN_BROWSER
from tests.labs.no_install import ROOT, run_notebook_without_install

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1200)]
LIMIT_S = 300.0


def test_seven_labs_run_in_five_minutes_of_plain_numpy():
    """The project's limit; every exercise's checks pass, and no cell fails."""
    total = 0.0
    for name in IN_BROWSER:
        folder = lab_folder(name, ROOT / "labs")
        seen = run_notebook_without_install(notebook_path(folder, solution=True))
        total += seen["cpu_s"]
        print(f"{name}: {seen['cpu_s']:.1f} s, imports {' '.join(seen['imported'])}")
        assert seen["errors"] == {}
        assert seen["printed"].count("public checks passed") == len(load_checks(folder).exercises)
    print(f"all: {total:.1f} s")
    assert total <= LIMIT_S
