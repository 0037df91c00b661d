"""A class of 200 synthetic students on three platforms: none unaccounted for, five commands a lab.

    python -m pytest -m benchmark -s tests/benchmarks/bench_desk.py

The sandbox is probed and used; the small lab has one function. 51 students are in CI.
"""

import time
from collections import Counter

import pytest

from tests.benchmarks.bench_rollouts import machine
from tests.tools.grading import toys
from tests.tools.grading.test_desk import COMMANDS, require_nobody_lost, run_desk


@pytest.mark.benchmark
@toys.needs_sandbox
@pytest.mark.timeout(900)
def test_nobody_of_200_is_lost(capsys, tmp_path):
    """The counts, against those of the kinds of hand-in, by hand."""
    begin = time.monotonic()
    shown, expected = run_desk(tmp_path, 200)
    took = time.monotonic() - begin
    require_nobody_lost(tmp_path, shown, expected)
    with capsys.disabled():
        counts = " + ".join(f"{n} {state}" for state, n in Counter(expected.values()).items())
        print(f"\n\n{machine()}: {len(COMMANDS)} commands, {took:.0f} s; 200 students = {counts}")
