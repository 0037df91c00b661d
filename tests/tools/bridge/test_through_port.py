"""Through the port: what the pin says is what flies, a silent host is noticed, and landings are as
good as without.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.messages import Command
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.tools.bridge.open_port import PORTS, simulated_board
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.bridge.through_port import PORT_DELAY_S, PortWorld
from falconwing_kit.tools.trials.trials import (
    TrialSettings,
    fly_trial,
    fly_trials,
    summarise_trials,
)
from falconwing_kit.trainer_port.ppm import Stick, load_calibration
from tests.firmware.chip import require_tools

STICKS = Command(throttle=0.55, aileron=-0.3, elevator=0.12, rudder=0.5)
MICROSECOND = 1.0 / 500.0  # of stick: 500 us from the centre to an end


class RecordingWorld:
    """Notes what reaches the radio, and when; the world gets the port's mean delay taken off."""

    def __init__(self) -> None:
        self.world = LandingTask().trial(trial_seed(0)).world
        self.came: list[tuple[float, Command]] = []

    def send(self, t, command):
        self.came.append((t + PORT_DELAY_S, command))

    def advance(self, t):
        self.t = t


@pytest.fixture(params=PORTS)
def board(request):
    if request.param == "sim":
        require_tools()
    board = simulated_board(request.param)
    yield board
    board.close()


def fly(port_world, seconds, command=STICKS, begin=0.0):
    """Send at 20 Hz as the loop does: first look, then send."""
    for k in range(round(20 * seconds)):
        port_world.advance(begin + 0.05 * k)
        port_world.send(begin + 0.05 * k, command)


def test_the_aircraft_flies_on_what_the_pin_said(board):
    """The pin has whole microseconds, so sticks come back to half of one; 1 us more for edges at
    0.25 us each.
    """
    world = RecordingWorld()
    with PortWorld(world, board) as port_world:
        fly(port_world, 0.5)
    last = world.came[-1][1]
    assert last.vector == pytest.approx(STICKS.vector, abs=1.5 * MICROSECOND)
    assert len(world.came) == pytest.approx(0.45 / 0.022, abs=2.0)  # one frame every 22 ms


def test_the_first_command_is_there_when_the_flight_begins(board):
    """A switch-over comes before the flight: no idle throttle in its first frames."""
    world = RecordingWorld()
    with PortWorld(world, board) as port_world:
        fly(port_world, 0.2)
    assert world.came[0][0] < 0.022
    assert world.came[0][1].throttle == pytest.approx(STICKS.throttle, abs=1.5 * MICROSECOND)


def test_a_new_command_reaches_the_radio_within_two_frames(board):
    """16 bytes, at most one frame of 22 ms until the next begins, and its four slots of at most 2
    ms: 31.5 ms.
    """
    world = RecordingWorld()
    with PortWorld(world, board) as port_world:
        fly(port_world, 0.5)
        fly(port_world, 0.3, replace(STICKS, elevator=-0.2), begin=0.5)
    first = next(t for t, command in world.came if command.elevator < 0.0)
    assert 0.5014 < first < 0.5 + 0.032


def test_commands_come_on_average_as_late_as_without_the_port(board):
    """By hand: 16 bytes at 115,200 baud 1.4 ms, half a frame of 22 ms and four slots of 1.5 ms are
    18.4 ms, which the world's own delay has in it already; to 2 ms.
    """
    world, late = RecordingWorld(), []
    with PortWorld(world, board) as port_world:
        fly(port_world, 0.5)
        for k in range(22):  # every 50 ms: every phase of a frame; small steps, no slew limit
            fly(port_world, 0.05, replace(STICKS, elevator=(-0.02, 0.02)[k % 2]), 0.5 + 0.05 * k)
        port_world.advance(1.65)
    for k in range(22):
        sent, sign = 0.5 + 0.05 * k, (-1.0, 1.0)[k % 2]
        late.append(min(t for t, command in world.came if t > sent and sign * command.elevator > 0))
        late[-1] -= sent
    assert np.mean(late) == pytest.approx(0.0184, abs=0.002)
    assert pytest.approx(0.0184) == PORT_DELAY_S


def test_a_silent_host_is_flown_without_throttle(board):
    """Safety rules: 200 ms and one frame after the last command the slots are safe, throttle idle,
    sticks centred.
    """
    world, events = RecordingWorld(), []
    with PortWorld(world, board, on_event=lambda *event: events.append(event)) as port_world:
        fly(port_world, 1.0)
        port_world.advance(1.6)
    safe = next(t for t, command in world.came if command.throttle < 0.01)
    assert (
        0.95 + 0.2 < safe < 0.95 + 0.225 + 0.008
    )  # the last command goes out at 0.95 s; 8 ms until four slots are out
    assert np.abs(world.came[-1][1].vector).max() < 1.5 * MICROSECOND
    assert port_world.port.status.state == "LOST"
    assert [name for _, name, _ in events if name == "dropped"] == ["dropped"]


def test_order_and_reversal_are_undone_by_the_same_calibration():
    """By hand: with aileron reversed in slot 4 and rudder in slot 2, other slots are sent, the same
    sticks arrive.
    """
    plain = load_calibration()
    turned = replace(
        plain,
        aileron=Stick(4, 1000, 1500, 2000, reversed=True),
        rudder=Stick(2, 1000, 1500, 2000),
        radio="test",
    )
    world = RecordingWorld()
    with PythonBoard() as board, PortWorld(world, board, turned) as port_world:
        fly(port_world, 0.3)
        assert port_world.port.status.channels_us[3] == 1650  # aileron -0.3, reversed
        assert port_world.port.status.channels_us[1] == 1750  # rudder 0.5
    assert world.came[-1][1].vector == pytest.approx(STICKS.vector, abs=MICROSECOND)


def test_the_pilots_sticks_are_measured_and_end_the_flight_when_they_move(board):
    """The board engages near the SIMULATED pilot's sticks; rudder moved by 0.25 of its half, 125
    us, is a take-over: idle and neutral within the radio's two frames and one of the board, 66 ms,
    and the 8 ms until four slots are out.
    """
    world, events = RecordingWorld(), []
    with PortWorld(world, board, on_event=lambda *event: events.append(event)) as port_world:
        fly(port_world, 0.5)
        status = port_world.port.status
        assert status.has_pilot and not status.engages_without_pilot
        assert port_world.port.pilot.channels_us == pytest.approx((1550, 1350, 1560, 1750), abs=1)
        sticks = port_world.calibration.channels_us(STICKS)
        board.set_pilot((*sticks[:3], sticks[3] + 125))
        fly(port_world, 0.4, begin=0.5)
    safe = next(t for t, command in world.came if command.throttle < 0.01)
    assert 0.45 < safe < 0.45 + 0.066 + 0.008
    assert np.abs(world.came[-1][1].vector).max() < 1.5 * MICROSECOND
    assert "pilot took over" in [name for _, name, _ in events]


def test_a_board_without_the_pilots_pulses_is_not_engaged_in_flight(monkeypatch):
    """A broken wire to the pilot's pin: cruise throttle does not engage, and the sentence says
    which stick.
    """
    board = PythonBoard()
    monkeypatch.setattr(board, "set_pilot", lambda channels_us: None)
    port_world = PortWorld(RecordingWorld(), board)
    with pytest.raises(InputError, match=r"got SAFE \(throttle 1550 us, without a pilot's signal"):
        port_world.send(0.0, STICKS)


def test_a_dead_board_is_said_before_the_flight():
    """A board that hangs for good answers nothing."""
    board = PythonBoard()
    board.run_until = lambda t: setattr(board, "t", t)
    with pytest.raises(InputError, match="STATUS"):
        PortWorld(RecordingWorld(), board)


def test_an_unknown_board_is_refused():
    """Only simulated boards fly a simulation."""
    with pytest.raises(InputError, match="sim or sim-python"):
        simulated_board("/dev/ttyACM0")


@pytest.mark.timeout(900)  # a minute of CPU, more on a busy machine
def test_a_hundred_landings_through_the_firmware_are_as_good_as_without():
    """Every one on the pad, within 5 cm of the centre line on average, and no more than 4 mm worse
    than flown without the port. A millimetre or two are the port's own: it limits the slew of the
    sticks, and a frame may wait up to 22 ms for the next one.
    """
    require_tools()
    task = LandingTask()
    through = fly_trials(task, task.expert, 100, pilot="expert", setting=TrialSettings(port="sim"))
    without = fly_trials(task, task.expert, 100, pilot="expert")
    found = summarise_trials(through)
    assert found["successes"] == 100
    assert found["ald_m"]["mean"] <= 0.05
    worse = np.array([a["ald_m"] - b["ald_m"] for a, b in zip(through, without, strict=True)])
    assert worse.mean() < 0.004
    assert sum(record["port"]["commands_dropped"] for record in through) == 0
    print(
        f"ALD {100 * found['ald_m']['mean']:.1f} cm, without the port "
        f"{100 * summarise_trials(without)['ald_m']['mean']:.1f} cm"
    )


def test_the_log_tells_what_happened_at_the_port(tmp_path):
    """The board becomes ACTIVE before the flight, so its log begins with the earlier events."""
    task = LandingTask()
    record = fly_trial(
        task, task.expert, 0, setting=TrialSettings(port="sim-python"), log=tmp_path / "flight.mcap"
    )
    log = read_flight_log(tmp_path / "flight.mcap")
    assert log.metadata["port"] == "sim-python"
    assert log.metadata["task"] == "landing" and len(json.loads(log.metadata["start"])) == 12
    assert "engaged" in [event.name for event in log.events]
    assert record["port"]["board"] == PythonBoard.kind


def test_a_full_disk_ends_no_flight_through_the_port(tmp_path, monkeypatch):
    """Events of the port cannot be logged from the first step on: a warning, and a full landing."""
    task = LandingTask()

    def refuse(self, t, name, details=None):
        raise InputError("flight.mcap: the disk is full")

    monkeypatch.setattr(FlightLogWriter, "event", refuse)
    with pytest.warns(UserWarning, match="goes on without a log"):
        record = fly_trial(
            task,
            task.expert,
            0,
            setting=TrialSettings(port="sim-python"),
            log=tmp_path / "flight.mcap",
        )
    assert record["success"]
