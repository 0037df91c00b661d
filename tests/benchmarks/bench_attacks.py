"""Attacks on grading, all: code as root and as a plain user, notebooks that are slow to read.

    python -m pytest -m benchmark -s tests/benchmarks/bench_attacks.py --timeout 1200

CI runs the code attacks as its own user, quick ones as a plain user, and three of the notebooks.
"""

import os
import resource
import subprocess
import sys
import time

import pytest

from falconwing_kit.tools.grading.judge import Assignment, GradingTask, grade_submission
from falconwing_kit.tools.grading.submissions import find_submissions
from tests.benchmarks.bench_rollouts import machine
from tests.tools.grading import toys
from tests.tools.grading.attacks import ATTACKS
from tests.tools.grading.hostile import NOTEBOOKS
from tests.tools.grading.plain_user import CHECKOUT, run_as_plain_user
from tests.tools.grading.test_attacks import attack_tests

pytestmark = [pytest.mark.benchmark, toys.needs_sandbox]
MOST_CPU_S = 10.0


def test_all_code_attacks_gain_nothing_from_a_plain_user(capsys):
    """The tests of tests/tools/grading/test_attacks.py, by a user without control groups."""
    begin = time.monotonic()
    done = run_as_plain_user(attack_tests("-k", "not quick"), 900)
    assert done.returncode == 0, done.stdout[-5000:]
    with capsys.disabled():
        took = time.monotonic() - begin
        print(f"\n\n{len(ATTACKS)} attacks by a plain user: {took:.0f} s; {done.stdout[-60:]}")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="this user is plain")
def test_all_code_attacks_gain_nothing_from_root(capsys, tmp_path):
    """The same tests with this process's own rights."""
    begin = time.monotonic()
    words = [word.replace("HOME", str(tmp_path)) for word in attack_tests("-k", "not quick")]
    assert subprocess.run([sys.executable, *words], cwd=CHECKOUT, check=False).returncode == 0
    with capsys.disabled():
        print(f"\n{len(ATTACKS)} attacks by root: {time.monotonic() - begin:.0f} s")


def test_no_notebook_takes_long_to_grade(capsys, tmp_path):
    """Processor time of reading, collecting and judging, with that of the sandboxes [s]."""
    rows = []
    for name, make in NOTEBOOKS.items():
        file = tmp_path / "eve.ipynb"
        file.write_bytes(make())
        (each,) = find_submissions(file, "lab00")
        begin = _processor_s()
        record = grade_submission(GradingTask(each), Assignment(toys.LAB))
        rows.append((name, _processor_s() - begin, record["status"], record["points"]))
    with capsys.disabled():
        print(f"\n\n{machine()}\n\n| notebook | CPU s | status | points |\n|---|---|---|---|")
        print(
            "\n".join(f"| {n} | {s:.2f} | {status} | {points} |" for n, s, status, points in rows)
        )
    assert max(row[1] for row in rows) <= MOST_CPU_S


def _processor_s():
    own, children = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime
