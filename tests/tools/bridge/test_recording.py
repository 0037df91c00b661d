"""Recording: a pilot whose sticks are known to the test, a board, a camera -> what is in the log
afterwards.
"""

import os
import random
import signal
import subprocess
import sys
import types

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log, to_flight_table
from falconwing_kit.core.messages import Image
from falconwing_kit.tools.bridge.open_port import SteppedBoard
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.bridge.recording import Recording, record
from falconwing_kit.tools.cli.main import main
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.vision.monitor import FrameMonitor

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
START = 1000.0  # s: what the host's clock says when the recording begins


class Camera:
    """Thirty images a second; each is there 20 ms after it was taken."""

    def __init__(self) -> None:
        self.broken = False

    def next_image(self, t: float) -> Image | None:
        if self.broken:
            raise OSError("the camera is gone")
        number = int((t - 0.02) * 30.0)
        return (
            Image(number, number / 30.0, np.full(300, number % 256, np.uint8))
            if t >= 0.02
            else None
        )


@pytest.fixture
def flight(tmp_path):
    """A recording that a test runs on: `run(seconds, sticks)` moves the pilot's sticks [us] and the
    clock.
    """
    clock = types.SimpleNamespace(t=START - 1.0)
    board, camera, alerts = PythonBoard(), Camera(), []
    port = TrainerPort(SteppedBoard(board, lambda: clock.t), now=lambda: clock.t)
    board.set_pilot((1000, 1500, 1500, 1500))

    def tick(seconds):
        clock.t += seconds

    port.wait_ready(sleep=tick)
    clock.t = START
    port.poll()
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        recording = Recording(port, log, camera, alerts.append)

        def run(seconds, sticks="as before"):
            if sticks != "as before":
                with port.link.pause() as now:
                    now.set_pilot(sticks)
            record(recording, recording.t + seconds, pause=tick)

        yield types.SimpleNamespace(
            run=run,
            recording=recording,
            camera=camera,
            alerts=alerts,
            path=tmp_path / "flight.mcap",
            port=port,
        )


def read_after(flight):
    """The log as a reader finds it while it is still being written."""
    return read_flight_log(flight.path)


def test_sticks_are_logged_at_the_time_of_the_board(flight):
    """Full throttle from 2 s on. By hand: the radio's frames of 22 ms carry it within two frames,
    and the shipped calibration says 1000 us is 0 and 2000 us is 1. 45.45 frames a second.
    """
    flight.run(2.0)
    flight.run(2.0, (2000, 1500, 1500, 1500))
    log = read_after(flight)
    throttle = np.array([command.throttle for command in log.commands])
    rise = log.command_times[np.argmax(throttle > 0.5)]
    assert 2.0 <= rise <= 2.05
    assert set(np.unique(throttle)) == {0.0, 1.0}
    assert len(log.commands) == pytest.approx(4.0 / 0.022, abs=3)
    # Twice a second the clock is fitted anew from replies stamped to 2 ms; in the first second that
    # moves times more.
    assert np.diff(log.command_times[log.command_times > 1.0]) == pytest.approx(0.022, abs=2e-3)


def test_each_command_names_the_newest_image_before_it(flight):
    """By hand: image k is taken at k/30 s and not known before 20 ms later; a command is reported
    some 10 ms after its last edge, so the image it names is k = floor(30 t) or the one before.
    """
    flight.run(3.0)
    log = read_after(flight)
    after_start = log.command_times > 0.1
    named, t = log.command_sequences[after_start], log.command_times[after_start]
    assert np.all(named / 30.0 <= t) and np.all(t - named / 30.0 < 2 / 30.0 + 1e-3)


def test_a_command_stands_before_the_image_it_names(flight):
    """The order of the bytes in the file: what is cut off by a kill is an image, not a command."""
    flight.run(1.0)
    data, log = flight.path.read_bytes(), read_after(flight)
    for sequence in set(log.command_sequences[20:30].tolist()):
        assert data.index(f'"image_sequence": {sequence},'.encode()) < data.index(
            bytes([sequence]) * 300
        )


def test_every_image_is_logged_once_with_its_time(flight):
    """Thirty a second, also while the pilot's radio is silent."""
    flight.run(1.0)
    flight.run(2.0, None)
    log = read_after(flight)
    assert log.image_sequences.tolist() == list(range(len(log.image_sequences)))
    assert len(log.image_times) == pytest.approx(90, abs=5)
    assert log.image_times == pytest.approx(log.image_sequences / 30.0, abs=1e-6)
    assert "pilot silent" in [event.name for event in log.events]


def test_an_image_from_before_the_recording_does_not_stop_it(flight):
    """A camera that ran before gives an image of -0.1 s; it is logged at zero."""
    flight.camera.next_image = lambda t: Image(0, -0.1, np.full(300, 7, np.uint8))
    flight.run(0.5)
    assert not flight.recording.stopped
    assert read_after(flight).image_times.tolist() == [0.0]


def test_the_log_becomes_a_flight_table(flight):
    """One row an image, each with the sticks of its time; what `falconwing export` writes for
    identification.
    """
    flight.run(2.0, (1250, 1600, 1500, 1500))
    table = to_flight_table(read_after(flight))
    assert table.commands[-1] == pytest.approx([0.25, 0.2, 0.0, 0.0], abs=1e-9)
    assert np.diff(table.t) == pytest.approx(1 / 30.0, abs=1e-6)


def test_the_log_says_that_the_board_was_simulated_or_not(flight):
    """Simulated data is called so; and whose calibration it was."""
    assert (
        read_after(flight).metadata["simulated"] == "no"
    )  # this port came without a simulation behind it
    assert read_after(flight).metadata["calibrated"] == "never"


def test_what_happens_on_the_port_is_in_the_log(flight):
    """A power loss in mid-flight: the reset, at its time."""
    flight.run(1.0)
    flight.port.link.board.power_cycle()
    flight.run(1.0)
    resets = [event for event in read_after(flight).events if event.name == "board reset"]
    assert len(resets) == 1 and 1.0 < resets[0].t < 1.2


def test_a_camera_that_fails_costs_no_sticks(flight):
    """Commands go on at 45 a second."""
    flight.run(1.0)
    flight.camera.broken = True
    flight.run(1.0)
    log = read_after(flight)
    assert "images lost" in [event.name for event in log.events]
    assert len(log.commands) == pytest.approx(2.0 / 0.022, abs=3)


class Grain:
    """Thirty pictures a second of one wall; from 1 to 2 s each is another noise, from 3 s on none
    comes.
    """

    def __init__(self, side: int = 64) -> None:
        self.draw, self.side = np.random.default_rng(0), side
        self.wall = np.kron(self.draw.integers(0, 256, (8, 8)), np.ones((8, 8)))

    def next_image(self, t: float) -> Image | None:
        if t >= 3.0:
            return None
        lit = (
            self.draw.normal(128.0, 80.0, (64, 64))
            if 1.0 <= t < 2.0
            else self.wall + self.draw.normal(0.0, 2.0, (64, 64))
        )
        pixels = np.clip(lit, 0.0, 255.0).astype(np.uint8)[: self.side, : self.side]
        return Image(int(t * 30.0), t, np.repeat(pixels[..., None], 3, axis=2))


def test_the_monitors_alarms_are_said_once_and_stand_in_the_log(flight):
    """Noise from 1 s on is reported within the manual's 300 ms, its end within a second; then the
    images stop, which is reported within a second too. Commands are still recorded.
    """
    flight.recording.images, flight.recording.monitor = Grain(), FrameMonitor()
    flight.run(4.0)
    log = read_after(flight)
    told = [
        (event.name, event.details["reason"].split(":")[0], event.t)
        for event in log.events
        if "pict" in event.name
    ]
    assert [name for name, *_ in told] == ["picture alarm", "picture clear", "picture alarm"]
    assert [reason for _, reason, _ in told] == ["noise", "", "old or frozen"]
    assert [t for *_, t in told] == pytest.approx([1.15, 2.5, 3.5], abs=0.5)
    assert 1.0 < told[0][2] <= 1.3
    assert [alert.split(":")[0] for alert in flight.alerts] == [
        "PICTURE noise",
        "PICTURE old or frozen",
    ]
    assert flight.recording.counts.alarms == 2 and len(log.commands) == pytest.approx(
        4.0 / 0.022, abs=3
    )


def test_a_picture_that_cannot_be_judged_ends_the_monitor_not_the_recording(flight):
    """16 pixels a side, of which 32 are wanted: one event, and every picture in the log."""
    flight.recording.images, flight.recording.monitor = Grain(side=16), FrameMonitor()
    flight.run(1.0)
    log = read_after(flight)
    (off,) = [event for event in log.events if event.name == "monitor off"]
    assert "32" in off.details["error"] and flight.alerts == []
    assert len(log.image_times) == pytest.approx(30, abs=3)


def test_a_radio_with_too_few_channels_is_an_event(flight):
    """Four sticks want four channels; the recording goes on."""
    flight.port.pilots.append(
        types.SimpleNamespace(device_time_us=2_000_000, channels_us=(1500, 1500))
    )
    flight.run(0.5)
    assert "bad pilot frame" in [event.name for event in read_after(flight).events]
    assert flight.recording.stopped == "" and flight.recording.counts.commands > 10


def test_an_old_log_is_never_overwritten(flight):
    """A flight cannot be flown again."""
    with pytest.raises(InputError, match="never overwritten"):
        FlightLogWriter(flight.path)


# A kill, a full disk.

CHILD = """
import sys, types
import numpy as np
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Image
from falconwing_kit.tools.bridge.recording import Recording
from falconwing_kit.tools.bridge.open_port import SteppedBoard
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.tools.bridge.python_board import PythonBoard

class Log(FlightLogWriter):
    def command(self, t, command, image=None):
        super().command(t, command, image)
        print("command", round(t * 1e6), flush=True)

    def image(self, image):
        super().image(image)
        print("image", image.sequence, flush=True)

class Camera:
    pixels = np.random.default_rng(0).integers(0, 256, 31_000, dtype=np.uint8)
    def next_image(self, t):
        return Image(int(t * 30), int(t * 30) / 30.0, self.pixels)

clock = types.SimpleNamespace(t=0.0)
def tick(seconds): clock.t += seconds
board = PythonBoard()
board.set_pilot((1000, 1500, 1500, 1500))
port = TrainerPort(SteppedBoard(board, lambda: clock.t), now=lambda: clock.t)
port.wait_ready(sleep=tick)
with Log("flight.mcap") as log:
    alert = lambda sentence: print("alert", sentence, flush=True)
    recording = Recording(port, log, Camera(), alert)
    steps = 0
    while True:
        recording.step()
        tick(0.005)
        steps += bool(recording.stopped)
        if steps == 400:
            status = port.status
            print("flown on", status.state, recording.counts.commands, flush=True)
            break
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
def test_twenty_kills_lose_no_acknowledged_command_and_at_most_one_image(tmp_path):
    """A recording that runs as fast as it can is killed 20 times, each time after another number of
    records. What it had acknowledged, by printing after the writer returned, is in the log;
    `falconwing export --to mcap` makes a whole log of it.
    """
    draw = random.Random(5)
    for kill in range(20):
        folder = tmp_path / str(kill)
        folder.mkdir()
        program = [sys.executable, "-c", CHILD]
        with subprocess.Popen(
            program, stdout=subprocess.PIPE, env=ENVIRONMENT, text=True, cwd=folder
        ) as child:
            lines = [child.stdout.readline() for _ in range(draw.randint(1, 300))]
            child.send_signal(signal.SIGKILL)
            lines += [line for line in child.stdout if line.endswith("\n")]
        words = [line.split() for line in lines]
        commands = [int(number) for word, number in words if word == "command"]
        images = [int(number) for word, number in words if word == "image"]
        assert (
            main(
                [
                    "export",
                    str(folder / "flight.mcap"),
                    "--to",
                    "mcap",
                    "--out",
                    str(folder / "saved.mcap"),
                ]
            )
            == 0
        )
        for name in ("flight.mcap", "saved.mcap"):
            log = read_flight_log(folder / name)
            assert (
                np.round(log.command_times * 1e6).astype(int).tolist()[: len(commands)] == commands
            )
            assert log.image_sequences.tolist()[: len(images) - 1] == images[:-1]
        assert log.warnings == () and commands


@pytest.mark.skipif(
    sys.platform == "win32", reason="the system's file size limit exists on POSIX only"
)
def test_a_full_disk_stops_the_recording_with_one_alert_and_the_port_goes_on(tmp_path):
    """The kernel refuses to let the file grow beyond 200,000 bytes. By hand: six images of 31 kB
    fit. Two seconds later the port still has its board, and what was acknowledged can be read.
    """
    program = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n" + CHILD
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    lines = done.stdout.splitlines()
    alerts = [line for line in lines if line.startswith("alert")]
    assert len(alerts) == 1, done.stderr
    assert alerts[0].startswith("alert RECORDING STOPPED after") and "the disk is full" in alerts[0]
    commands = [int(line.split()[1]) for line in lines if line.startswith("command")]
    assert lines[-1] == f"flown on SAFE {len(commands)}"
    log = read_flight_log(tmp_path / "flight.mcap")
    assert (
        np.round(log.command_times * 1e6).astype(int).tolist() == commands
        and len(log.image_times) == 6
    )
