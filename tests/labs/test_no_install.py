"""Labs run where nothing can be installed: without compiler, networks, OpenCV, threads, processes.

All seven, with their time: tests/benchmarks/bench_no_install.py.
"""

import subprocess
import sys

import pytest

from falconwing_kit.tools.grading.find import lab_folder, notebook_path
from tests.labs.no_install import ROOT, left_out, run_notebook_without_install

THERE = {"numpy", "scipy", "matplotlib", "PIL", "IPython"}
BLOCKED = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from tests.labs.no_install import block
block()
"""


@pytest.mark.parametrize("name", ["lab02", "lab07"])
def test_solution_runs_as_in_a_browser(name):
    """Lab 2 reads pictures, lab 7 flies: no error, no failed check, and what a browser has."""
    seen = run_notebook_without_install(
        notebook_path(lab_folder(name, ROOT / "labs"), solution=True)
    )
    assert seen["errors"] == {} and seen["figures"] >= 1
    assert "public checks passed" in seen["printed"] and "failed:" not in seen["printed"]
    assert THERE.isdisjoint(left_out())
    assert {"falconwing_kit"} <= set(seen["imported"]) and "numba" not in seen["imported"]


def test_what_is_blocked_cannot_be_used():
    """Each is on this machine and not in that process, or the tests prove nothing."""
    code = """
for name in ("numba", "cv2", "torch", "tyro", "fcntl"):
    try:
        __import__(name)
    except ModuleNotFoundError:
        print(name)
"""
    done = subprocess.run(
        [sys.executable, "-c", f"{BLOCKED}{code}"], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["numba", "cv2", "torch", "tyro", "fcntl"]
    assert {"numba", "cv2", "tyro"} <= set(left_out())


def test_compiled_flight_falls_back_to_plain_python():
    """The same flight as the NumPy one to rounding, although nothing can be compiled."""
    code = """
import numpy as np
from falconwing_kit.aircraft import paper_model
from falconwing_kit.aircraft.integrate import roll_out_batch, roll_out_compiled
model = paper_model()
start = np.zeros((1, 9)); start[0, 2], start[0, 6] = 1.5, 8.0
commands = np.tile([0.6, 0.1, 0.05, 0.0], (1, 50, 1))
a, b = (f(model, start, commands, 0.02) for f in (roll_out_batch, roll_out_compiled))
assert np.abs(a[0, -1, 0]) > 5.0
print(np.abs(a - b).max())
"""
    done = subprocess.run(
        [sys.executable, "-c", f"{BLOCKED}{code}"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 1e-9  # metres and rad after 50 steps of double precision
