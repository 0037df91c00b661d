"""`falconwing bridge`, `record` and `find-port`: by the words on the command line, with boards that
are simulated.
"""

import dataclasses
import io
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
import types
from contextlib import contextmanager

import numpy as np
import pytest

from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.core.messages import Command
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.tools.bridge.bus import COMMAND, StampedCommand
from falconwing_kit.tools.bridge.open_port import open_port
from falconwing_kit.tools.bridge.ros import RosBus
from falconwing_kit.tools.cli.board_status import (
    StatusLine,
    pilot_sticks,
    port_record,
    status_text,
)
from falconwing_kit.tools.cli.main import main
from falconwing_kit.trainer_port import usb

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def run(verb, *words):
    """The verb, as `falconwing VERB WORDS`."""
    return main([verb, *words])


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """A folder without a calibration."""
    monkeypatch.chdir(tmp_path)


def test_the_bridge_says_what_the_board_is_and_does(capsys):
    """A simulated board is called so; it stands in SAFE, for nobody sent a command; its pilot's
    sticks are seen.
    """
    assert run("bridge", "--port", "sim-python", "--seconds", "0.6", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert (
        record["board"].startswith("SIMULATED board")
        and record["state"] == "SAFE"
        and record["sent"] == 0
    )
    assert 0.0 <= record["pilot_throttle"] <= 1.0 and record["board_ppm_frames"] > 10
    assert record["channels_us"] == [1000, 1500, 1500, 1500] and record["resets"] == 0


def test_the_bench_moves_the_sticks_and_never_the_throttle(capsys):
    """Sines of 0.3 of full stick around 1500 us, 500 us to the end: within 150 us of it; idle is
    1000 us.
    """
    assert run("bridge", "--port", "sim-python", "--seconds", "1.5", "--move-sticks", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    throttle, *others = record["channels_us"]
    assert record["state"] == "ACTIVE" and throttle == 1000
    assert max(abs(us - 1500) for us in others) > 10
    assert all(abs(us - 1500) <= 150 for us in others)


@pytest.mark.parametrize(
    "two", list(itertools.combinations(("--ros", "--move-sticks", "--turn-motor"), 2))
)
def test_two_givers_of_commands_are_refused(capsys, two):
    """ROS and the bench: one of them."""
    assert run("bridge", "--port", "sim-python", *two) == 2
    assert "leave one out" in capsys.readouterr().err


@pytest.fixture
def throttles(monkeypatch):
    """(time, throttle slot) of every pass through the bridge's loop, as the board reports it."""
    seen, is_over = [], StatusLine.is_over

    def watch(line, recording=None):
        if line.port.status is not None:
            seen.append((line.port.now(), line.port.status.channels_us[0]))
        return is_over(line, recording)

    monkeypatch.setattr(StatusLine, "is_over", watch)
    return seen


def typed(monkeypatch, text):
    """Somebody at a terminal."""
    terminal = io.StringIO(text)
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stdin", terminal)


@pytest.mark.parametrize("port", ["sim-python", "sim"])
def test_the_motor_is_turned_once_and_briefly(monkeypatch, capsys, throttles, port):
    """By hand: idle is 1000 us, a fifth of 1000 us more is 1200; idle for 3 s after the engagement,
    then one pulse of 2 s, to 0.15 s (STATUS every 50 ms, commands too); then the board is handed
    back. `sim` is the firmware in a simulated chip where its tools are there.
    """
    typed(monkeypatch, "propeller off\n")
    assert run("bridge", "--port", port, "--turn-motor", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["engaged"] == 1 and record["engagement"] in ("engaged", "dropped")
    levels = [us for _, us in throttles]
    assert max(levels) == 1200 and levels[0] == 1000
    high = [t for t, us in throttles if us > 1000]
    begin = next(t for t, us in throttles if us > 1000)
    assert high[-1] - begin == pytest.approx(2.0, abs=0.15)
    assert begin - throttles[0][0] > 2.9


@pytest.mark.parametrize("answer", ["", "\n", "yes\n", "y\n", "propeller on\n", "off\n"])
def test_the_motor_is_not_turned_without_the_sentence(monkeypatch, capsys, throttles, answer):
    """Exit code 2, and the port was not opened."""
    typed(monkeypatch, answer)
    assert run("bridge", "--port", "sim-python", "--turn-motor") == 2
    assert "expected 'propeller off' to be typed" in capsys.readouterr().err and throttles == []


def test_the_motor_of_an_aircraft_is_not_turned_from_a_script(monkeypatch, capsys):
    """The sentence in a pipe is nobody at the bench."""
    monkeypatch.setattr("sys.stdin", io.StringIO("propeller off\n"))
    assert run("bridge", "--port", "/dev/ttyACM0", "--turn-motor") == 2
    assert "expected a person at a terminal" in capsys.readouterr().err


def test_a_pilot_who_moves_a_stick_ends_the_pulse(monkeypatch, capsys, throttles):
    """At 1200 us the pilot's elevator goes to its end: SAFE, throttle idle, exit code 1."""
    typed(monkeypatch, "propeller off\n")
    watch = StatusLine.is_over

    def moved(line, recording=None):
        with line.port.simulation.pause() as board:
            up = line.port.status.channels_us[0] > 1000
            board.set_pilot((1000, 1500, 2000 if up else 1500, 1500))
        return watch(line, recording)

    monkeypatch.setattr(StatusLine, "is_over", moved)
    assert run("bridge", "--port", "sim-python", "--turn-motor", "--json") == 1
    said = capsys.readouterr()
    assert "handed back before the end" in said.err
    high = [t for t, us in throttles if us > 1000]
    assert high and high[-1] - high[0] < 0.5


def test_a_pilot_whose_throttle_is_up_does_not_let_the_pulse_begin(monkeypatch, capsys, throttles):
    """Half throttle by the pilot: the board does not engage on idle; exit code 1 and the reason."""
    from falconwing_kit.tools.cli import bridge

    typed(monkeypatch, "propeller off\n")
    monkeypatch.setattr(bridge, "MOTOR_ENGAGE_S", 1.0)
    watch = StatusLine.is_over

    def up(line, recording=None):
        with line.port.simulation.pause() as board:
            board.set_pilot((1500, 1500, 1500, 1500))
        return watch(line, recording)

    monkeypatch.setattr(StatusLine, "is_over", up)
    assert run("bridge", "--port", "sim-python", "--turn-motor", "--json") == 1
    assert "did not engage: throttle 1000 us" in capsys.readouterr().err
    assert {us for _, us in throttles} == {1000}


def test_the_bridge_s_table_ends_with_what_to_do_next(capsys):
    """As every verb."""
    assert run("bridge", "--port", "sim-python", "--seconds", "0.2") == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == "next: falconwing record --port sim-python --out recordings"
    assert "not measured on a radio" in said.err


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_without_avr_tools_a_plain_board_takes_the_place_and_says_so(monkeypatch, capsys):
    """Through the real serial code; the sentence names the packages."""
    from falconwing_kit.tools.bridge import build

    monkeypatch.setattr(build, "missing_tools", lambda: ["gcc-avr", "libsimavr-dev"])
    assert run("bridge", "--port", "sim", "--seconds", "0.2", "--json") == 0
    said = capsys.readouterr()
    assert (
        "apt install gcc-avr libsimavr-dev" in said.err
        and "plain Python" in json.loads(said.out)["board"]
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["bridge", "--port", "nowhere"], "nowhere: expected a serial port"),
        (
            ["bridge", "--port", "sim-python", "--seconds", "-1"],
            "--seconds: expected a finite number",
        ),
        (["bridge", "--port", "sim-python", "--calibration", "absent.toml"], "absent.toml"),
        (
            ["record", "--port", "COM3", "--source", "sim"],
            "--source sim: expected a simulated board",
        ),
        (["record", "--port", "sim-python", "--out", "file"], "--out file: expected a folder"),
        (
            ["record", "--port", "sim-python", "--camera", "absent.avi", "--seconds", "1"],
            "absent.avi",
        ),
    ],
)
def test_wrong_words_are_one_sentence(tmp_path, capsys, words, sentence):
    """Exit code 2, nothing flown."""
    (tmp_path / "file").write_text("")
    assert run(*words) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is a signal on POSIX")
@pytest.mark.parametrize("verb", ["bridge", "record"])
def test_ctrl_c_ends_cleanly(tmp_path, verb):
    """A table or JSON as usual and exit code 0; a recording's log is whole."""
    words = ["--port", "sim-python", "--json"]
    words += ["--source", "sim", "--seconds", "60"] if verb == "record" else []
    load = "import sys; from falconwing_kit.tools.cli.main import main"
    code = f"{load}; sys.exit(main({[verb, *words]!r}))"
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=ENVIRONMENT,
        text=True,
    ) as child:
        while "SIMULATED board" not in child.stderr.readline():
            pass
        end = time.monotonic() + 60.0
        while (
            verb == "record"
            and time.monotonic() < end
            and not list(tmp_path.glob("recordings/*.mcap"))
        ):
            time.sleep(0.05)
        time.sleep(0.5)
        child.send_signal(signal.SIGINT)
        out, _ = child.communicate(timeout=60)
    assert child.returncode == 0
    record = json.loads(out)
    assert "SIMULATED" in record["board"]
    if verb == "record":
        assert read_flight_log(record["file"]).warnings == ()


def test_a_recorded_approach_is_a_whole_log(tmp_path, capsys):
    """Two seconds of it, in real time: sticks at some 45 Hz and images at 20 Hz, and the log says
    simulated.
    """
    assert run("record", "--port", "sim-python", "--source", "sim", "--seconds", "2", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    log = read_flight_log(record["file"])
    assert log.metadata["simulated"] == "yes" and log.warnings == ()
    assert (
        len(log.commands) == record["commands"] > 20
        and len(log.image_times) == record["images"] > 5
    )


def test_a_busy_machine_raises_no_alarm_of_the_simulated_camera(monkeypatch, capsys):
    """Every image takes 0.35 s to draw, longer than the 0.3 s after which the monitor calls a real
    camera frozen. The flight's own time stretches: an image every 50 ms, none lost, no alarm.
    """
    look = RenderedView.look

    def slow_look(view):
        time.sleep(0.35)
        return look(view)

    monkeypatch.setattr(RenderedView, "look", slow_look)
    assert run("record", "--port", "sim-python", "--source", "sim", "--seconds", "1", "--json") == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    log = read_flight_log(found["file"])
    assert found["alarms"] == 0 and "ALERT" not in said.err
    assert len(log.image_times) >= 19
    assert np.diff(log.image_times) == pytest.approx(0.05, abs=1e-6)


def test_a_camera_that_is_not_there_costs_no_sticks(capsys):
    """The grabber goes on looking for camera 99; the sticks are recorded without images, which is
    not what was asked for: exit 1 and a sentence, with --json too.
    """
    words = ["record", "--port", "sim-python", "--camera", "99", "--seconds", "0.5"]
    assert run(*words) == 1
    said = capsys.readouterr()
    assert "next: falconwing export" in said.out
    assert "no image came: is the camera plugged in, and is it 99" in said.err
    assert run(*words, "--out", "again", "--json") == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["commands"] > 5 and "no image came" in said.err


def test_a_recording_without_sticks_is_no_success(monkeypatch, capsys):
    """The radio is off: exit code 1, and where to look."""
    from falconwing_kit.tools.cli import board_status

    monkeypatch.setattr(board_status, "move_sticks", lambda port, t: None)
    assert run("record", "--port", "sim-python", "--camera", "99", "--seconds", "0.4") == 1
    assert "no sticks came" in capsys.readouterr().out


@pytest.fixture
def boards(monkeypatch):
    """Sets what is on USB."""

    def put(*found):
        monkeypatch.setattr(usb, "find_boards", lambda: list(found))

    return put


MEGA = usb.SerialBoard("/dev/ttyACM0", "Arduino Mega 2560", True, True, "")
CLOSED = usb.SerialBoard(
    "/dev/ttyACM0", "Arduino Mega 2560", True, False, "sudo usermod -aG dialout $USER"
)
OTHER = usb.SerialBoard("/dev/ttyUSB7", "weather station", False, True, "")


@pytest.mark.parametrize(
    ("found", "code", "text"),
    [
        ([MEGA, OTHER], 0, "next: falconwing bridge --port /dev/ttyACM0"),
        ([CLOSED], 0, "sudo usermod -aG dialout $USER"),
        ([OTHER], 1, "weather station"),
        ([], 1, "no board on a USB serial port found"),
    ],
)
def test_find_port_answers(boards, capsys, found, code, text):
    """0 where one may be the Mega, 1 where none; with what to do."""
    boards(*found)
    assert run("find-port") == code
    assert text in capsys.readouterr().out
    assert run("find-port", "--json") == code
    assert len(json.loads(capsys.readouterr().out)["boards"]) == len(found)


def test_the_live_line_says_state_delay_and_sticks():
    """What a person looks at in flight; a port that is not there yet is said to wait."""
    with open_port("sim-python") as port:
        assert status_text(port) == "port waiting" and pilot_sticks(port) == []
        port.wait_ready()
        assert not StatusLine(port, 100.0).is_over()
        end = time.monotonic() + 20.0
        while port.pilot is None and time.monotonic() < end:
            time.sleep(0.01)
            port.poll()
        text = status_text(port)
        assert (
            text.startswith("SAFE  1000 1500 1500 1500 us  pilot +0.")
            and "  boots 1  frames " in text
        )
        with port.simulation.pause() as board:
            board.set_pilot(None)
        time.sleep(0.7)
        port.poll()
        assert "pilot none" in status_text(port)  # half a second after the radio's last frame


def test_the_live_line_says_why_the_board_does_not_engage_and_what_status_shows():
    """Cruise throttle without a pilot's signal; then the compile switch, and a take-over."""
    with open_port("sim-python") as port:
        port.wait_ready()
        end = time.monotonic() + 20.0
        while port.engagement != "engaging" and time.monotonic() < end:
            port.send(Command(0.5, 0.0, 0.0, 0.0), engage=True)
            time.sleep(0.02)
            port.poll()
        expected = "not engaged: throttle 1500 us, without a pilot's signal 1000 +- 20 us"
        assert expected in status_text(port)
        assert not port_record(port)["engages_without_pilot"]
        port.status = dataclasses.replace(
            port.status, engages_without_pilot=True, pilot_took_over=True
        )
        assert status_text(port).startswith("SAFE TAKEN by the pilot ENGAGES WITHOUT PILOT")
        assert port_record(port)["engages_without_pilot"]


def test_the_live_line_fits_the_terminal(monkeypatch, capsys):
    """One that wraps would leave its first half behind, four times a second; 60 columns, one of
    them for the cursor.
    """
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with open_port("sim-python") as port:
        port.wait_ready()
        StatusLine(port, 1.0).is_over()
    line = capsys.readouterr().err.rsplit("\r", 1)[1]
    assert line.startswith("SAFE  1000 1500 1500 1500 us") and line.endswith("\x1b[K")
    assert len(line) - len("\x1b[K") == 59


def test_an_alert_is_not_overlooked(capsys):
    """On its own line, with the terminal's bell."""
    StatusLine(types.SimpleNamespace(simulation=None), 1.0).alert("the disk is full")
    assert capsys.readouterr().err == "\n\aALERT: the disk is full\n"


@contextmanager
def publishing_on_ros():
    """Somebody publishes commands with engage 20 times a second, and no image."""
    bus, stop = RosBus(), threading.Event()

    def publish():
        while not stop.wait(0.05):
            bus.publish(
                COMMAND, StampedCommand(time.time(), Command(0.0, 0.1, 0.0, 0.0), engage=True)
            )

    publisher = threading.Thread(target=publish)
    publisher.start()
    try:
        yield
    finally:
        stop.set()
        publisher.join()
        bus.close()


def test_the_bridge_carries_commands_from_ros_to_the_board(ros_master, capsys):
    """Against a real ROS master, of a controller without a camera: at the end the board had the
    commands, followed, and was handed back.
    """
    words = ("bridge", "--port", "sim-python", "--ros", "--without-camera")
    with publishing_on_ros():
        assert run(*words, "--seconds", "4", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["sent"] > 20 and record["engaged"] >= 1
    assert record["engagement"] == "dropped"  # handed back at the end


def test_the_bridge_hands_back_where_a_controller_by_camera_has_no_image(ros_master, capsys):
    """After 0.4 s the supervisor ends it: eight or nine commands, and the hand-backs' frames."""
    with publishing_on_ros():
        assert run("bridge", "--port", "sim-python", "--ros", "--seconds", "3", "--json") == 0
    printed = capsys.readouterr()
    record = json.loads(printed.out)
    assert record["sent"] < 20 and record["engagement"] != "engaged"
    assert "ALERT: handed back: no image for 0.4" in printed.err
