"""The host is killed on final: the board goes safe, the aircraft glides without its motor, the log
tells the story.

Two programs, in real time. This one is the field: the firmware in a simulated chip behind a
pseudo-terminal, and the simulated aircraft that flies on what its pin says. The other is the host:
it reads the state, flies the kit's loop with the expert, sends its commands through the serial
port, writes the log, and is killed with SIGKILL.
"""

import json
import signal
import subprocess
import sys
import time

import pytest

from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log, recover
from falconwing_kit.core.messages import Command
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.tools.bridge.simulated_board import BoardOnPty, SimulatedBoard
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.ppm import load_calibration
from falconwing_kit.trainer_port.usb import SerialLink
from tests.firmware.chip import require_tools

FINAL = -4.0  # m before the pad
TIMEOUT = 0.225  # s: 200 ms without a command, and at most one frame of 22 ms
HOST = """
import json, sys, threading
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import State
from falconwing_kit.flight.loop import Loop, WallClock
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.trainer_port.usb import SerialLink
from falconwing_kit.trainer_port.port import TrainerPort

class Field:
    newest = None
    def read(self):
        for line in sys.stdin:
            self.newest = State.from_record(json.loads(line))
    def state_at(self, t):
        return self.newest

class Port:
    def __init__(self, port, log):
        self.port, self.log = port, log
    def send(self, t, command):
        self.port.poll()
        pilot = self.port.pilot
        if self.port.engagement != "engaged" and pilot is not None:
            # Until the board follows: the pilot's own sticks, near which it engages.
            command = self.port.calibration.command(pilot.channels_us)
        self.port.send(command, engage=True)
        while self.port.events:
            event = self.port.events.popleft()
            self.log.event(t, event.name, event.details)
            print(event.name, flush=True)

path, log_path = sys.argv[1:]
task, field = LandingTask(), Field()
threading.Thread(target=field.read, daemon=True).start()
link = SerialLink(path)
with FlightLogWriter(log_path) as log, TrainerPort(link, what="simulated board") as port:
    port.wait_ready()
    pilot = task.expert(task.trial(trial_seed(0)))
    Loop(pilot, Port(port, log), states=field, clock=WallClock(), log=log).run(60.0)
"""


@pytest.fixture
def line():
    require_tools()
    with BoardOnPty(SimulatedBoard()) as line:
        yield line


def pin_to_world(line, world, zero):
    """Give the aircraft what came out of the pin."""
    for frame in line.ppm_frames():
        sticks = load_calibration().command(frame.slots_us.tolist())
        world.send(line.to_host_time(float(frame.t_slots[-1])) - zero, sticks)


def tell(host, world):
    """Give the host the state that an estimator would measure."""
    host.stdin.write(json.dumps(world.measured().record) + "\n")
    host.stdin.flush()


def test_a_killed_host_leaves_a_safe_board_and_a_log(line, tmp_path):
    """Safety rules: 200 ms after the last command the slots are safe; the next host is told LOST,
    not obeyed.
    """
    world = LandingTask().trial(trial_seed(0)).world
    log_path, killed = tmp_path / "flight.mcap", 0.0
    command = [sys.executable, "-c", HOST, line.path, str(log_path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as host:
        try:
            tell(host, world)
            with line.pause() as board:  # the SIMULATED pilot, who flies until the host does
                board.set_pilot(load_calibration().channels_us(Command(0.5, 0.0, 0.0, 0.0)))
            while host.stdout.readline().strip() != "engaged":
                assert host.poll() is None
                tell(host, world)
            line.ppm_frames()  # those of the ground
            zero = time.perf_counter()
            for k in range(1, 400):
                time.sleep(max(0.0, zero + 0.05 * k - time.perf_counter()))
                pin_to_world(line, world, zero)
                world.advance(0.05 * k)
                tell(host, world)
                if world.state.p_world[0] > FINAL:
                    break
        finally:
            host.send_signal(signal.SIGKILL)
            killed = time.perf_counter()
    assert world.contact is None
    time.sleep(0.6)
    with line.pause() as board:
        frames, pin = board.ppm_frames(), [line.to_host_time(board.t)]
    safe = [
        f for f in frames if f.slots_us == pytest.approx([1000.0, 1500.0, 1500.0, 1500.0], abs=1.0)
    ]
    flown = [f for f in frames if f not in safe]
    first_safe = line.to_host_time(safe[0].t_start)
    assert first_safe - killed < TIMEOUT
    assert pin[0] - first_safe > 0.2
    assert all(f.t_start < safe[0].t_start for f in flown)

    while world.contact is None:  # the aircraft glides on, with the motor idle
        world.send(world.t, load_calibration().command(safe[-1].slots_us.tolist()))
        world.advance(world.t + 0.05)
    assert world.contact.obstacle in ("floor", "pad", "pad edge")

    recover(log_path, tmp_path / "recovered.mcap")
    log = read_flight_log(tmp_path / "recovered.mcap")
    assert "engaged" in [event.name for event in log.events]
    assert "ended" not in [event.name for event in log.events]
    assert len(log.commands) > 20
    assert log.states[-1].p_world[0] == pytest.approx(FINAL, abs=1.0)

    # The next host hears what happened, and its engaging is no silent resumption.
    with (
        FlightLogWriter(tmp_path / "next.mcap") as next_log,
        TrainerPort(SerialLink(line.path)) as port,
    ):
        assert port.wait_ready().state == "LOST"
        for event in port.events:
            next_log.event(0.0, event.name, event.details)
    told = [
        event.details
        for event in read_flight_log(tmp_path / "next.mcap").events
        if event.name == "board"
    ]
    assert told[0]["state"] == "LOST"
