"""The supervisor on 10,000 flights with a fault drawn at random and 20 hours without one, and its
time per step beside the frame monitor's.

    python -m pytest -m benchmark -s tests/benchmarks/bench_supervisor.py

All simulated: cameras of 30 images a second, 30 to 120 ms late, one image in twenty lost.
"""

import math
import time

import numpy as np
import pytest

from falconwing_kit.core.messages import Command, Image
from falconwing_kit.flight.supervisor import Supervisor
from falconwing_kit.vision.monitor import FrameMonitor
from tests.flight.supervised_flights import FAULTS, fly

pytestmark = pytest.mark.benchmark
FLIGHTS, CLEAN_H = 10_000, 20.0


def test_no_fault_is_missed():
    """Noticed after its onset, within its limit; the slowest of each kind is printed."""
    rng, slowest = np.random.default_rng(2026), dict.fromkeys(FAULTS, 0.0)
    kinds = list(FAULTS)
    for _ in range(FLIGHTS):
        kind = kinds[rng.integers(len(kinds))]
        began, noticed = fly(rng, kind)
        assert began <= noticed <= began + FAULTS[kind] + 1e-6, kind
        slowest[kind] = max(slowest[kind], noticed - began)
    print(f"\n{FLIGHTS} flights with a fault, SIMULATED: none missed, none early")
    for kind, seconds in slowest.items():
        print(f"{kind:32} noticed after at most {1e3 * seconds:4.0f} ms")


def test_clean_flights_go_on():
    """At most one hand-back per hour in twenty hours of ten-minute flights."""
    rng, stopped = np.random.default_rng(2027), 0
    flights = round(CLEAN_H * 6)
    for _ in range(flights):
        stopped += fly(rng, "", seconds=600.0)[1] < math.inf
    print(f"\n{CLEAN_H:g} h without a fault, SIMULATED: {stopped} false hand-backs")
    assert stopped <= CLEAN_H


@pytest.mark.parametrize(("width", "height"), [(320, 240), (640, 480)])
def test_time_per_step(width, height):
    """`see` and `check` for a new image in every step, and the monitor alone."""
    rng = np.random.default_rng(1)
    images = [
        Image(k, 0.05 * k, rng.integers(0, 256, (height, width, 3), np.uint8)) for k in range(20)
    ]
    supervisor, monitor, seconds = Supervisor(by_images=True), FrameMonitor(), np.zeros((2, 200))
    for k in range(200):
        t, image = 0.05 * k, images[k % 20]
        image = Image(k, t, image.pixels)
        begin = time.process_time_ns()
        supervisor.see(image, t)
        supervisor.check(t, Command(0.5, 0.0, 0.0, 0.0, k))
        seconds[0, k] = time.process_time_ns() - begin
        begin = time.process_time_ns()
        monitor.update(image.pixels, t)
        seconds[1, k] = time.process_time_ns() - begin
    own, its = np.median(seconds, axis=1) * 1e-6
    print(f"\n{width}x{height}: supervisor {own:.3f} ms a step, frame monitor {its:.2f} ms")
