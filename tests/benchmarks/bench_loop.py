"""The loop: simulated seconds per second of a landing with rendered images, time per stage, and the
rate in real time.

    python -m pytest -m benchmark tests/benchmarks/bench_loop.py

Wall times are of this machine and whatever else runs on it; CPU times are of this process over all
its threads. The table is Markdown.
"""

import os
import time

import numpy as np
import pytest

from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.loop import Loop, WallClock
from falconwing_kit.flight.sources import MeasuredStates, RenderedView, fpv_camera
from falconwing_kit.flight.tasks import FlightTask, FollowTask, LandingTask
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.arena import load_scene
from tests.benchmarks.bench_rollouts import machine

pytestmark = pytest.mark.benchmark
SIZES = ((160, 120), (320, 240), (640, 480))
SEEDS = (0, 1, 2)  # of training


class TimedWorld:
    """A world that adds up the time it takes to fly and to measure."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world, self.seconds = world, 0.0

    def __getattr__(self, name: str):
        return getattr(self._world, name)

    def advance(self, t: float) -> None:
        begin = time.perf_counter()
        self._world.advance(t)
        self.seconds += time.perf_counter() - begin

    def measured(self) -> State:
        return self._world.measured()

    def send(self, t: float, command: Command) -> None:
        self._world.send(t, command)


def test_landing_with_images(capsys, tmp_path):
    """Prints the table; asserts only that the flights that were timed did what they should."""
    stages = " | ".join(f"{stage} [ms a step]" for stage in ("render", "pilot", "world", "log"))
    lines = [
        f"| headless flight | simulated s per s | per s of CPU | {stages} |",
        "|---|---|---|---|---|---|---|",
    ]
    for size in SIZES:
        lines.append(row("landing", LandingTask(), size, tmp_path))
    lines.append(row("following", FollowTask("left_turn_s_descent"), (320, 240), tmp_path))
    real = real_time(tmp_path)
    with capsys.disabled():
        print(f"\n\n{machine()}; load {os.getloadavg()[0]:.1f}\n")
        print("\n".join([*lines, "", real]))


def row(name: str, task: FlightTask, size: tuple[int, int], folder) -> str:
    """One line: medians over flights."""
    figures = np.array(
        [flown(task, size, seed, folder / f"{name}_{size[0]}_{seed}.mcap") for seed in SEEDS]
    )
    per_wall, per_cpu, *stages = np.median(figures, axis=0)
    cells = " | ".join(f"{ms:.2f}" for ms in stages)
    return f"| {name}, {size[0]} x {size[1]} | {per_wall:.2f} | {per_cpu:.2f} | {cells} |"


def flown(task: FlightTask, size: tuple[int, int], seed: int, log) -> tuple[float, ...]:
    """Simulated seconds per second of wall and of CPU, then ms a step of rendering, pilot, world
    and log.
    """
    trial = task.trial(seed)
    world, camera = TimedWorld(trial.world), fpv_camera(*size)
    view = RenderedView(world, load_scene("arena"), camera, task.airframe.p_body_camera)
    judge, pilot = task.judge(trial, camera, view), task.expert(trial)
    with FlightLogWriter(log) as writer:
        wall, cpu = time.perf_counter(), time.process_time()
        loop = Loop(pilot, world, view, MeasuredStates(world), trial.leader, log=writer)
        flight = loop.run(trial.duration, judge.watch)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    assert judge.result()["success"]
    seconds = len(flight.t) * loop.period
    images, pilot_time, log_time = (
        float(flight.seconds[stage].sum()) for stage in ("images", "pilot", "log")
    )
    stages = (
        images - world.seconds,
        pilot_time,
        world.seconds,
        log_time,
    )  # the view flies the world before it looks
    return (seconds / wall, seconds / cpu, *(1e3 * stage / len(flight.t) for stage in stages))


def real_time(folder) -> str:
    """A landing against the wall clock with images and log: does the loop keep its 20 Hz?"""
    task = LandingTask()
    trial, camera = task.trial(0), fpv_camera()
    view = RenderedView(trial.world, load_scene("arena"), camera, task.airframe.p_body_camera)
    judge, pilot = task.judge(trial, camera, view), task.expert(trial)
    with FlightLogWriter(folder / "real_time.mcap") as log:
        loop = Loop(
            pilot, trial.world, view, MeasuredStates(trial.world), clock=WallClock(), log=log
        )
        flight = loop.run(trial.duration, judge.watch)
    assert judge.result()["success"]
    median, high = flight.milliseconds("lateness")
    steps = len(flight.t) + flight.skipped
    return (
        f"Wall clock, 320 x 240: {flight.rate_hz:.2f} Hz, {flight.skipped} of {steps} steps"
        f" skipped, jitter median {median:.2f} ms, 95 % within {high:.2f} ms"
    )
