"""Rehearsal: an approach that was recorded from the pilot's pin is the approach that was flown."""

import types

import numpy as np
import pytest

from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.tools.bridge.open_port import SteppedBoard
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.bridge.recording import Recording, record
from falconwing_kit.tools.bridge.rehearsal import SimulatedManualApproach
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.ppm import load_calibration


class Radio:
    """The default radio; what the simulated pilot gave is kept."""

    def __init__(self) -> None:
        self.given = []

    def channels_us(self, command):
        self.given.append(command)
        return load_calibration().channels_us(command)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A whole rehearsed landing in virtual time: the approach, what its pilot gave, and the log."""
    path, clock, radio = (
        tmp_path_factory.mktemp("rehearsal") / "flight.mcap",
        types.SimpleNamespace(t=0.0),
        Radio(),
    )

    def tick(seconds):
        clock.t += seconds

    link = SteppedBoard(PythonBoard(), lambda: clock.t)
    port = TrainerPort(link, now=lambda: clock.t)
    port.simulation = link
    port.wait_ready(sleep=tick)
    approach = SimulatedManualApproach(link, radio, load_scene("arena"), fpv_camera(64, 48))
    with FlightLogWriter(path) as log:
        recording = Recording(port, log, approach)
        record(recording, 12.0, pause=tick, watch=lambda now: approach.over)
    return approach, radio.given, read_flight_log(path)


def test_the_recorded_sticks_are_those_that_landed(recorded):
    """Truth: what the pilot gave in step k, at 50 k ms. Its radio sends a new frame within 22 ms,
    whose last slot is complete 6 ms later, so at 50 k + 45 ms the log has it, to half a microsecond
    of 500. A board that hears the first pulses waits for a pause before it believes them: two
    steps.
    """
    approach, given, log = recorded
    assert approach.world.contact.obstacle == "pad"
    for k, command in list(enumerate(given))[2:-1]:
        row = np.searchsorted(log.command_times, k * CONTROL_PERIOD_S + 0.045) - 1
        assert log.commands[row].vector == pytest.approx(command.vector, abs=0.5 / 500 + 1e-9), k


def test_images_come_twenty_times_a_second_and_show_the_approach(recorded):
    """By hand: one every 50 ms until it has landed after 20 m at some 7 m/s; and no two are the
    same.
    """
    _, given, log = recorded
    assert np.diff(log.image_times) == pytest.approx(CONTROL_PERIOD_S, abs=1e-6)
    assert (
        len(log.image_times) == len(given) == pytest.approx(20.0 / 7.0 / CONTROL_PERIOD_S, rel=0.4)
    )
    assert log.metadata["simulated"] == "yes" and log.metadata["scene"] == "arena"
    assert log.metadata["task"] == "landing" and "SIMULATED" in log.metadata["pilot"]
    assert len({image.jpeg for image in log.images()}) > 0.9 * len(given)


def test_a_board_that_stops_at_whole_cycles_is_not_waited_for():
    """Its time ends half a cycle of 16 MHz before the moment asked for, and never reaches it."""

    class WholeCycles(PythonBoard):
        def run_until(self, t):
            super().run_until(max(np.floor(t * 16e6 - 0.5) / 16e6, self.t))

    clock = types.SimpleNamespace(t=0.0)
    link = SteppedBoard(WholeCycles(), lambda: clock.t)
    clock.t = 0.1
    link.read()
    assert link.board.t == pytest.approx(0.1, abs=1e-6)
