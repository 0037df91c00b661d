"""A cluster for tests: a scheduler and workers of `distributed`, each a process of its own, on free
ports.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from falconwing_kit.tools.jobs.cluster import run_on_every_worker

ROOT = Path(__file__).parents[1]
Process = subprocess.Popen[bytes]


@contextmanager
def running(place: Path) -> Iterator[tuple[str, Callable[[], Process]]]:
    """A scheduler's address, and how to start a worker; all of them end with the context."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    started: list[Process] = []

    def start(*words: str) -> Process:
        program = [sys.executable, "-m", "dask", *words, "--no-dashboard", "--host", "127.0.0.1"]
        started.append(
            subprocess.Popen(program, cwd=place, env=environment, stderr=subprocess.DEVNULL)
        )
        return started[-1]

    try:
        file = place / "scheduler.json"
        start("scheduler", "--port", "0", "--scheduler-file", str(file))
        wait_for(file.exists)
        address = json.loads(file.read_text())["address"]
        yield address, lambda: start("worker", address, "--nthreads", "1", "--no-nanny")
    finally:
        for process in started:
            process.kill()
            process.wait()


def wait_for(ready: Callable[[], bool], seconds: float = 60.0) -> None:
    """Until something is so, or the time is over; a loaded machine starts slowly."""
    end = time.monotonic() + seconds
    while not ready() and time.monotonic() < end:
        time.sleep(0.05)


def wait_for_workers(address: str, count: int) -> None:
    """Until a scheduler has so many workers."""
    wait_for(lambda: len(run_on_every_worker(os.getpid, address)) >= count)
