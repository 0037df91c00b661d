"""Roll-outs: how many steps a second the aircraft model takes on one core, beside JSBSim in the
same run.

    python -m pytest -m benchmark tests/benchmarks/bench_rollouts.py

Times are CPU seconds of this process over all its threads, the best of five: other work on the
machine and further cores do not count. The table is Markdown, ready for README.
"""

import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falconwing_kit.aircraft.integrate import SUBSTEPS, roll_out
from falconwing_kit.aircraft.model import Model, paper_model
from falconwing_kit.aircraft.trim import trim
from tests.jsbsim_aircraft import STEP, JsbsimAircraft, new_fdm

pytestmark = pytest.mark.benchmark
ROW = 0.05  # s of flight that one row of a 20 Hz log stands for
STEPS = {("batch", 1): 1000, ("batch", 64): 1000, ("batch", 1024): 200, ("batch", 8192): 25}
STEPS |= {("compiled", 1): 200_000, ("compiled", 1024): 200}


def test_rollouts_per_second(capsys: pytest.CaptureFixture[str]) -> None:
    """Prints the table; asserts only that what was timed was a flight."""
    import jsbsim
    import numba

    aircraft = JsbsimAircraft()
    theirs = jsbsim_steps_per_second(aircraft) * STEP / ROW
    lines = [
        "| aircraft model | flights at once | its step | steps/s | 50 ms of flight /s "
        "| against JSBSim |"
    ]
    lines += ["|---|---|---|---|---|---|", row("JSBSim, run() only", 1, STEP, theirs, theirs)]
    compile_times = []
    for model in (paper_model(), aircraft.kit_model()):
        step = ROW / SUBSTEPS[model.form]
        compile_times.append(f"{model.form} {compile_seconds(model):.1f} s")
        for (backend, count), steps in STEPS.items():
            ours = steps_per_second(model, backend, count, steps) * step / ROW
            lines.append(row(f"{model.form} form, {backend}", count, step, ours, theirs))
    versions = f"NumPy {np.__version__}, numba {numba.__version__}, JSBSim {jsbsim.__version__}"
    with capsys.disabled():
        print(
            f"\n\n{machine()}, {versions}; one core.",
            f"Compiling once: {', '.join(compile_times)}.\n",
            sep="\n",
        )
        print("\n".join(lines))


def row(name: str, count: int, step: float, rows_per_second: float, theirs: float) -> str:
    """One line of the table; speeds in rows of 50 ms each second."""
    steps = rows_per_second * ROW / step
    ratio = rows_per_second / theirs
    times = f"{ratio:.0f}" if ratio >= 10.0 else f"{ratio:.2g}"
    rates = f"{si(steps)} | {si(rows_per_second)}"
    return f"| {name} | {count} | {step * 1e3:g} ms | {rates} | {times} x |"


def si(value: float) -> str:
    """Three digits with k or M."""
    return f"{value / 1e6:.3g} M" if value >= 1e6 else f"{value / 1e3:.3g} k"


def steps_per_second(model: Model, backend: str, count: int, steps: int) -> float:
    """Integration steps a second of `roll_out`, all flights together, from straight flight with
    held sticks.
    """
    steady = trim(model, 7.0)
    starts, sticks = np.tile(steady.state, (count, 1)), np.tile(steady.command, (count, steps, 1))
    step = ROW / SUBSTEPS[model.form]
    flown: list[Any] = []
    seconds = best_of_five(lambda: flown.append(roll_out(model, starts, sticks, step, backend)))
    assert np.abs(flown[0][:, :40, 2] - 2.0).max() < 1e-6  # it held its height
    return count * steps / seconds


def jsbsim_steps_per_second(aircraft: JsbsimAircraft) -> float:
    """JSBSim's own loop, the same aircraft from the same state, sticks held, nothing read or
    written.
    """
    steady, count = trim(aircraft.kit_model(), 7.0), 40_000
    flights = [new_fdm(aircraft, steady.state, steady.command) for _ in range(5)]

    def fly() -> None:
        run = flights.pop().run
        for _ in range(count):
            run()

    return count / best_of_five(fly)


def compile_seconds(model: Model) -> float:
    """The first call of the compiled backend: numba compiles this form and these terms."""
    steady, begin = trim(model, 7.0), time.process_time()
    roll_out(model, steady.state, steady.command[None], 0.025, "compiled")
    return time.process_time() - begin


def best_of_five(work: Callable[[], Any]) -> float:
    """CPU seconds of the quickest of five."""
    seconds = []
    for _ in range(5):
        begin = time.process_time()
        work()
        seconds.append(time.process_time() - begin)
    return min(seconds)


def machine() -> str:
    """The computer in one line."""
    cpu, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        cpu = names[0] if names else cpu
    return f"{cpu}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
