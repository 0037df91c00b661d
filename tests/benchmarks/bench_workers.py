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

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]
TRIALS, ROUNDS, WANTED = 60, 2, 1.8  # each run's seconds are bounded by what CI's machines take
CODE = "import sys; from falconwing_kit.tools.cli.main import main; sys.exit(main(sys.argv[1:]))"
VERB = ["fly", "--headless", "--no-render", "--json", "--trials", str(TRIALS)]


def landings(workers: int) -> tuple[float, int]:
    """Seconds of the command as typed, start included, and landings that succeeded."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", CODE, *VERB, "--workers", str(workers)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return time.perf_counter() - begin, int(json.loads(done.stdout)["successes"])


def test_two_workers_against_one():
    """In turn, the best of three rounds each, since a neighbour only ever slows a run."""
    landings(1)  # compiles
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    runs = {workers: [] for workers in (1, 2)}
    for _ in range(ROUNDS):
        for workers, found in runs.items():
            found.append(landings(workers))
    one, two = (min(seconds for seconds, _ in runs[workers]) for workers in (1, 2))
    print(f"\n{machine()}; load {load:.1f} before")
    print("| workers | seconds | landings |\n|---|---|---|")
    for workers, seconds in ((1, one), (2, two)):
        print(f"| {workers} | {seconds:.1f} | {TRIALS} |")
    print(f"ratio {one / two:.2f}, wanted {WANTED}")
    assert len({successes for found in runs.values() for _, successes in found}) == 1
