"""Delays on the bench, with a simulated camera and board whose delays are known."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.devices.latency import (
    fit_fall,
    measure_frames,
    measure_latency,
    measure_ppm,
)
from falconwing_kit.tools.devices.lens import Lens
from falconwing_kit.tools.devices.simulated_bench import BenchTruth, SimulatedBench
from falconwing_kit.trainer_port.port import TrainerPort

SMALL = BenchTruth(lens=Lens(64, 48, 40.0, 40.0, 32.0, 24.0))
WIRE_S = 16 * 10 / 115200  # a COMMAND of four channels has 16 bytes of ten bits
SLOTS_S = 0.0055  # idle and neutral: 1000 + 3 x 1500 us


def bench_of(board, truth, seed=0):
    bench = SimulatedBench(board, truth, seed)
    port = TrainerPort(board, now=bench.now, what="SIMULATED board")
    port.wait_ready(sleep=bench.sleep)
    return bench, port


@pytest.mark.parametrize(
    "truth",
    [
        SMALL,
        replace(SMALL, camera_s=0.11, exposure_s=0.03, rate_hz=25.0),
        replace(SMALL, camera_s=0.035, exposure_s=0.002, rate_hz=60.0),
    ],
)
def test_delays_are_found_to_2_ms(truth):
    """Truth: camera_s of the simulated camera. To the pulse by hand: a command of 16 bytes on the
    wire, half a frame of 22 ms, channels of 5.5 ms.
    """
    with PythonBoard() as made:
        bench, port = bench_of(made, truth, seed=4)
        ppm = measure_ppm(port, bench.sleep)
        found = measure_latency(port, bench, bench.sleep, ppm, seed=7)
    assert found.camera_s == pytest.approx(truth.camera_s, abs=0.002)
    assert found.error95_s < 0.002
    assert found.pulse_s == pytest.approx(WIRE_S + 0.011 + SLOTS_S, abs=0.001)
    assert found.camera_to_pulse_s == pytest.approx(
        truth.camera_s + WIRE_S + 0.011 + SLOTS_S, abs=0.002
    )


def test_the_pin_agrees_with_the_delay_to_the_pulse():
    """Commands sent at many phases of the frame; the mean time until the last channel of the first
    frame that carries each, read from the simulated pin. Sixty commands: 0.9 ms of scatter.
    """
    from falconwing_kit.core.messages import Command

    with PythonBoard() as board:
        bench, port = bench_of(board, SMALL)
        pulse_s = measure_latency(
            port, bench, bench.sleep, measure_ppm(port, bench.sleep), cycles=10
        ).pulse_s
        port.send(Command(0.0, 0.0, 0.0, 0.0), engage=False)
        while port.engagement != "engaged":
            port.send(Command(0.0, 0.0, 0.0, 0.0), engage=True)
            bench.sleep(0.05)
            port.poll()
        delays = []
        for number in range(60):
            board.ppm_frames()
            aileron = 0.1 * (-1.0) ** number
            sent = bench.now()
            port.send(Command(0.0, aileron, 0.0, 0.0), engage=True)
            bench.sleep(0.0713)
            port.poll()
            frames = [f for f in board.ppm_frames() if f.slots_us[1] == 1500.0 + 500.0 * aileron]
            delays.append(frames[0].t_slots[-1] - sent)
    assert np.mean(delays) == pytest.approx(pulse_s, abs=0.0025)


def test_frame_rate_jitter_and_losses():
    """Truth: 30 Hz, 1.5 ms of jitter, every tenth image lost."""
    with PythonBoard() as board:
        bench = SimulatedBench(board, SMALL)
        found = measure_frames(bench, bench.now, bench.sleep, 20.0)
        assert found.rate_hz == pytest.approx(30.0, abs=0.02)
        # from images polled every ms; 600 of them: 3 % of scatter
        assert found.jitter_s == pytest.approx(0.0015, rel=0.15)
        assert found.lost_share == 0.0
        lossy = Lossy(bench)
        found = measure_frames(lossy, bench.now, bench.sleep, 10.0)
        assert found.lost_share == pytest.approx(0.1, abs=0.01)
        assert found.rate_hz == pytest.approx(30.0, abs=0.05)


class Lossy:
    """Without every tenth image."""

    def __init__(self, source):
        self.source, self.image = source, None

    def next_image(self, t):
        image = self.source.next_image(t)
        if image is not None and image.sequence % 10:
            self.image = image
        return self.image


@pytest.mark.parametrize("frame_us", [22000, 20500])
def test_the_pulses_period_comes_from_status(frame_us):
    """STATUS reads a count of frames at 20 Hz; over 10 s its slope gives the period to 10 us."""
    with PythonBoard(frame_us=frame_us) as board:
        bench, port = bench_of(board, SMALL)
        found = measure_ppm(port, bench.sleep, 10.0)
    assert found.frame_us == pytest.approx(frame_us, abs=10.0)
    assert found.channels_us == (1000, 1500, 1500, 1500)


class Blind:
    """A camera that does not see the LED."""

    def __init__(self, bench):
        self.bench = bench

    def next_image(self, t):
        self.bench._switched.clear()
        self.bench._switched.append((-np.inf, False))
        return self.bench.next_image(t)


def test_a_camera_that_does_not_see_the_led_is_refused():
    """Noise of 2 grey levels is no LED."""
    with PythonBoard() as board:
        bench, port = bench_of(board, SMALL)
        ppm = measure_ppm(port, bench.sleep)
        with pytest.raises(InputError, match="LED: expected the light of pin 13"):
            measure_latency(port, Blind(bench), bench.sleep, ppm)


def test_a_board_that_does_not_engage_is_refused():
    """Its state is named."""
    with PythonBoard() as board:
        bench, port = bench_of(board, SMALL)
        ppm = measure_ppm(port, bench.sleep)
        port.send = lambda command, engage: False
        with pytest.raises(InputError, match="expected it to engage at idle and neutral, got SAFE"):
            measure_latency(port, bench, bench.sleep, ppm)


def falls(delay, duration, count, rng, noise=0.0):
    """Brightness of 25 images around each of `count` hand-backs at random phases of 40 ms."""
    found = []
    for _ in range(count):
        tau = rng.uniform(0.0, 0.04) + 0.04 * np.arange(-8, 12)
        brightness = 1.0 - np.clip((tau - delay) / duration + 0.5, 0.0, 1.0)
        found.append(np.stack([tau, brightness + noise * rng.normal(size=tau.size)], axis=1))
    return found


def test_a_fall_is_found_far_below_the_cameras_period():
    """Ramps by hand at 25 images a second; the interval holds the truth in at least 33 of 40 draws
    (38 expected; below 33 has a chance of 1e-3).
    """
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(40):
        delay, duration = rng.uniform(0.03, 0.2), rng.uniform(0.004, 0.03)
        found, _, error95 = fit_fall(falls(delay, duration, 20, rng, noise=0.03))
        assert found == pytest.approx(delay, abs=0.004)
        inside += abs(found - delay) <= error95
    assert inside >= 33
    with pytest.raises(InputError, match="10 hand-backs or more, got 9"):
        fit_fall(falls(0.05, 0.01, 9, rng))


def test_an_uncertain_delay_is_not_written():
    """A camera whose arrivals scatter by 20 ms, and ten hand-backs only."""
    truth = replace(SMALL, jitter_s=0.02, rate_hz=25.0, camera_s=0.15)
    with PythonBoard() as board:
        bench, port = bench_of(board, truth)
        ppm = measure_ppm(port, bench.sleep)
        with pytest.raises(InputError, match="expected its delay to 2 ms"):
            measure_latency(port, bench, bench.sleep, ppm, cycles=10)
