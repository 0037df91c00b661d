"""`fly --trials --workers`: the same landings by one process and by two -> seconds and their ratio.

    python -m pytest -m benchmark -s tests/benchmarks/bench_workers.py

Wall time, so only of a machine with two free cores; its load is printed beside. Wanted: 1.8.
"""

import json
import os
import subprocess
import sys
import time

import pytest

from tests.benchmarks.bench_rollouts import machine

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(600)]
BUDGET_S, ROUNDS, WANTED = 90.0, 2, 1.8  # of all timed runs together
FEW, MANY = 2, 22  # trials of the two runs that say how long a start and a landing take
CODE = "import sys; from falconwing_kit.tools.cli.main import main; sys.exit(main(sys.argv[1:]))"
VERB = ["fly", "--headless", "--no-render", "--json"]


def landings(workers: int, trials: int) -> tuple[float, int]:
    """Seconds of the command as typed, start included, and landings that succeeded."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", CODE, *VERB, "--trials", str(trials), "--workers", str(workers)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return time.perf_counter() - begin, int(json.loads(done.stdout)["successes"])


def test_two_workers_against_one():
    """In turn, the best of two rounds each, since a neighbour only ever slows a run; as many trials
    as the time allows, for the start of a process weighs the less the more they are.
    """
    landings(1, FEW)  # compiles
    start, _ = landings(1, FEW)
    each = max((landings(1, MANY)[0] - start) / (MANY - FEW), 0.01)
    trials = int((BUDGET_S / ROUNDS - 2.0 * start) / (1.5 * each))
    trials = min(max(trials, 2 * MANY), 400)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    runs = {workers: [] for workers in (1, 2)}
    for _ in range(ROUNDS):
        for workers, found in runs.items():
            found.append(landings(workers, trials))
    one, two = (min(seconds for seconds, _ in runs[workers]) for workers in (1, 2))
    print(f"\n{machine()}; load {load:.1f} before; start {start:.1f} s, a landing {each:.2f} s")
    print("| workers | seconds | landings |\n|---|---|---|")
    for workers, seconds in ((1, one), (2, two)):
        print(f"| {workers} | {seconds:.1f} | {trials} |")
    print(f"ratio {one / two:.2f}, wanted {WANTED}")
    assert len({successes for found in runs.values() for _, successes in found}) == 1
