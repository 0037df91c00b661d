"""`fly --port P --source camera`: a dry run with the firmware behind a pseudo-terminal and a video
file as camera, in real time; and every step that must come before it.
"""

import io
import json
import queue
import threading
import time
import types
from collections import deque
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import write_toml
from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.flight.pilots import PILOTS
from falconwing_kit.flight.supervisor import SupervisorSettings
from falconwing_kit.tools.bridge.simulated_board import BoardOnPty, SimulatedBoard
from falconwing_kit.tools.cli import checklist as walking
from falconwing_kit.tools.cli import fly as verb
from falconwing_kit.tools.cli.fly_aircraft import AircraftPort, EnterKey, HandOverSupervisor
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.devices.grabber import Grabber
from falconwing_kit.tools.hardware.bench_record import calibration_digest, require_bench_test
from falconwing_kit.tools.hardware.checklists import load_checklists
from falconwing_kit.trainer_port.ppm import load_calibration
from tests.firmware.chip import require_tools
from tests.tools.cli.test_checklist import Terminal

CLIP = Path(__file__).parents[3] / "falconwing_kit" / "data" / "hall_clip"
RATE_HZ = 20.0
BENCH = load_checklists().bench
RADIO = replace(load_calibration(), radio="NX8", measured=date.today().isoformat())
SAFE_US = (1000.0, 1500.0, 1500.0, 1500.0)


def write_video(path, numbers):
    """Frames of the shipped clip as a video of 20 images a second."""
    import cv2

    frames = {k: cv2.imread(str(CLIP / f"{k:03d}.jpg")) for k in set(numbers)}
    height, width = frames[numbers[0]].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE_HZ, (width, height))
    for k in numbers:
        writer.write(frames[k])
    writer.release()
    return str(path)


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """A folder with a calibrated radio, and the firmware behind a serial port."""
    require_tools()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(walking, "OBSERVE_S", 0.6)
    write_toml("trainer_port.toml", RADIO)
    with BoardOnPty(SimulatedBoard()) as line:
        with line.pause() as board:
            board.set_pilot(SAFE_US)
        yield line


def pass_bench_test(monkeypatch, line, video):
    """Answer every step with yes; the computer tries its own three with the board and the video."""
    monkeypatch.setattr("sys.stdin", Terminal("y\n" * 20))
    assert (
        main(["doctor", "--bench", "--port", line.path, "--camera", video, "--out", "records"]) == 0
    )


class Steady:
    """A pilot by images: a fixed turn, as soon as there is an image."""

    mode = "steady"

    def reset(self):
        pass

    def act(self, observation):
        return Command(0.5, 0.4, 0.0, 0.0) if observation.image is not None else Command(0, 0, 0, 0)


@pytest.fixture
def steady(monkeypatch):
    """The pose pilot's place in the table is taken by one that needs no network."""
    monkeypatch.setattr(verb, "load_pilot", lambda *given, **more: Steady())


def fly(line, video, *more, hand_over="now"):
    return main(
        ["fly", "--port", line.path, "--source", "camera", "--camera", video, "--pilot", "pose",
         "--radio", "NX8", "--out", "flights", "--json", "--hand-over", hand_over, *more]
    )  # fmt: skip


def frames_until_safe(line):
    """The pulses of a flight, and of 0.3 s after it: the hand-back takes a frame or two to be on
    the pin, and even a lost one 0.225 s.
    """
    time.sleep(0.3)
    return line.ppm_frames()


def fly_to_the_end_of_the_clip(line, monkeypatch, capsys):
    """Door closed without a record, open with one; then loop, supervisor, port and chip: engaged,
    the pin leaves idle and neutral, and the video's end hands back. By hand: the last image is
    0.8 s and at most three steps old when that is noticed, and the pulses are safe 0.25 s later.
    (0.8 and not 0.4 s, so that a busy machine's pauses do not end the flight before.)
    """
    video = write_video("clip.avi", list(range(60)))  # 3 s
    assert fly(line, video) == 2
    said = capsys.readouterr().err
    assert "found none" in said and "doctor --bench" in said
    pass_bench_test(monkeypatch, line, video)
    capsys.readouterr()
    line.ppm_frames()
    assert fly(line, video, "--max-image-age", "0.8") == 1  # the supervisor ended it
    found = json.loads(capsys.readouterr().out)
    frames = frames_until_safe(line)
    moved = [frame for frame in frames if not np.allclose(frame.slots_us, SAFE_US, atol=2.0)]
    assert "0.8 allowed" in found["reason"], json.dumps(found)
    assert found["engaged_at_s"] < 3.0 and len(moved) > 50
    assert 0.8 < found["largest_image_age_s"] < 0.8 + 0.15
    assert frames[-1].slots_us == pytest.approx(SAFE_US, abs=2.0)
    log = read_flight_log(next(Path("flights").glob("*.mcap")))
    handed = next(event for event in log.events if event.details.get("reason"))
    engaged = next(event for event in log.events if event.name == "engaged")
    assert 0.8 <= handed.t - log.image_times[-1] <= 0.8 + 0.15
    moving_s = moved[-1].t_slots[-1] - moved[0].t_slots[-1]
    assert moving_s <= handed.t - engaged.t + 0.05 + 0.25  # ACTIVE is noticed one STATUS late
    assert len({command.image_sequence for command in log.commands}) > 35
    assert log.metadata["simulated"] == "no" and log.metadata["radio"] == "NX8"


@pytest.mark.usefixtures("steady")
def test_the_end_of_the_video_hands_back(bench, monkeypatch, capsys):
    """With a pilot that needs no network, so that a busy machine cannot make it overrun."""
    fly_to_the_end_of_the_clip(bench, monkeypatch, capsys)


@pytest.mark.benchmark
def test_the_pose_pilot_flies_the_clip_behind_a_real_serial_port(bench, monkeypatch, capsys):
    """The network itself; on a busy machine the supervisor ends it for a pilot that took 0.2 s."""
    fly_to_the_end_of_the_clip(bench, monkeypatch, capsys)


@pytest.mark.usefixtures("steady")
def test_a_frozen_video_hands_back_and_the_pin_goes_safe(bench, monkeypatch, capsys):
    """Forty images, then the last one again and again at 20 a second: five identical ones, or one
    picture for 0.25 s, are noticed within 0.45 s, and the pin is safe at most 0.25 s after that.
    The steady pilot's 0.4 of aileron is 1700 us.
    """
    moving = write_video("clip.avi", list(range(60)))
    pass_bench_test(monkeypatch, bench, moving)
    video = write_video("frozen.avi", [*range(40), *[39] * 60])
    bench.ppm_frames()
    began = time.perf_counter()
    assert fly(bench, video) == 1
    capsys.readouterr()
    frames = frames_until_safe(bench)
    turned = [bench.to_host_time(f.t_slots[-1]) for f in frames if f.slots_us[1] > 1650.0]
    log = read_flight_log(next(Path("flights").glob("*.mcap")))
    handed = next(event for event in log.events if event.details.get("reason"))
    # The supervisor counts identical images, its monitor the time of one picture: either is first.
    words = ("identical images in a row", "old or frozen")
    assert any(word in handed.details["reason"] for word in words)
    moving = log.image_times[log.image_sequences <= 39][-1]
    assert moving < handed.t <= moving + 0.45
    engaged = next(event for event in log.events if event.name == "engaged")
    assert turned[0] > began and turned[-1] - turned[0] <= handed.t - engaged.t + 0.25
    assert frames[-1].slots_us == pytest.approx(SAFE_US, abs=2.0)


@pytest.mark.usefixtures("steady")
def test_a_flight_until_its_time_is_up_succeeds(bench, monkeypatch, capsys):
    """Exit 0, and control is handed back before the camera is closed, which may take seconds."""
    video = write_video("clip.avi", [*range(70), *range(69, -1, -1)])
    pass_bench_test(monkeypatch, bench, video)
    capsys.readouterr()
    stop, was_active = Grabber.stop, []

    def stop_slowly(images):
        time.sleep(0.02)  # for the line; the board's own timeout is 0.2 s
        with bench.pause() as board:
            was_active.append(board.led)
        return stop(images)

    monkeypatch.setattr(Grabber, "stop", stop_slowly)
    assert fly(bench, video, "--seconds", "2") == 0
    assert was_active[-1:] == [False]
    found = json.loads(capsys.readouterr().out)
    assert found["reason"] == "duration" and found["engaged_at_s"] is not None
    assert found["margin_s"] > 0.2
    log = read_flight_log(next(Path("flights").glob("*.mcap")))  # above the wing, by the files
    assert json.loads(log.metadata["p_body_camera"]) == [0.036, 0.0, -0.075]


class Keyboard:
    """Standard input on which a test types."""

    def __init__(self):
        self.typed = queue.Queue()

    def __iter__(self):
        return iter(self.typed.get, "")


def wait_for(condition, seconds=20.0):
    end = time.perf_counter() + seconds
    while not condition() and time.perf_counter() < end:
        time.sleep(0.05)
    return condition()


@pytest.mark.usefixtures("steady")
def test_the_person_flies_until_enter_and_again_after_a_stick(bench, monkeypatch, capsys):
    """Take-off by hand moves the sticks and ends nothing. With Enter the steady pilot's 0.4 of
    aileron, 1700 us, goes out; a stick that moves by 200 us takes over, which the pin shows as idle
    and neutral; with Enter it goes out again.
    """
    video = write_video("clip.avi", 12 * [*range(70), *range(69, -1, -1)])
    pass_bench_test(monkeypatch, bench, video)
    capsys.readouterr()
    keyboard, seen, newest = Keyboard(), {}, deque(maxlen=1)
    monkeypatch.setattr("sys.stdin", keyboard)

    def is_turning():
        newest.extend(bench.ppm_frames())
        return newest[0].slots_us[1] > 1650.0

    def has_begun():
        return any(Path("flights").glob("*.mcap"))

    def move_sticks(*channels_us):
        with bench.pause() as board:
            board.set_pilot(channels_us)

    def act():
        seen["begun"] = wait_for(has_begun)
        for throttle in (1100.0, 1600.0):
            move_sticks(throttle, 1500.0, 1700.0, 1500.0)
            time.sleep(0.5)  # twenty frames of the radio
            seen[f"by hand {throttle:.0f}"] = not is_turning()
        for name, aileron in (("first", 1500.0), ("second", 1700.0)):
            time.sleep(2.0)  # Enter counts a second after the take-over, and so from now on
            keyboard.typed.put("\n")
            seen[name] = wait_for(is_turning)
            move_sticks(1600.0, aileron + 200.0, 1700.0, 1500.0)
            seen[f"taken over {name}"] = wait_for(lambda: not is_turning())
        keyboard.typed.put("")  # the terminal is closed

    actor = threading.Thread(target=act, daemon=True)
    actor.start()
    code = fly(bench, video, "--max-image-age", "0.8", hand_over="enter")
    actor.join()
    assert all(seen.values()) and len(seen) == 7, seen
    found = json.loads(capsys.readouterr().out)
    assert "nobody can press Enter" in found["reason"]
    assert (code, found["engagements"]) == (1, 2)
    log = read_flight_log(next(Path("flights").glob("*.mcap")))
    names = [event.name for event in log.events]
    assert names.count("engaged") == names.count("pilot took over") == 2


def record(tmp_path, change=None, number=0, **more):
    """A record of a passed bench test, and what a test changes in it."""
    passed = {
        "list": BENCH.title, "date": f"{date.today().isoformat()}T1{number}:00:00",
        "port": "/dev/ttyACM0", "camera": "0", "radio": "NX8",
        "calibration": calibration_digest(RADIO),
        "steps": [{"id": step.id, "result": "yes"} for step in BENCH.steps], **more,
    }  # fmt: skip
    if change is not None:
        change(passed)
    (tmp_path / f"checklist_{number}.json").write_text(json.dumps(passed))


def result_of(name, value):
    def change(passed):
        next(step for step in passed["steps"] if step["id"] == name)["result"] = value

    return change


def test_a_passed_bench_test_opens_the_door(tmp_path):
    """The newest of the radio counts."""
    record(tmp_path, result_of("takeover", "NO"), number=0)
    record(tmp_path, number=1)
    record(tmp_path, result_of("takeover", "NO"), number=2, radio="another")
    assert require_bench_test(tmp_path, BENCH, RADIO).name == "checklist_1.json"


LONG_AGO = (date.today() - timedelta(days=181)).isoformat()


@pytest.mark.parametrize(
    ("change", "more", "sentence"),
    [
        (result_of("takeover", "NO"), {}, "'NO' at step takeover"),
        (result_of("plug_pulled", "skipped"), {}, "'skipped' at step plug_pulled"),
        (lambda passed: passed["steps"].pop(3), {}, "'not done' at step camera_voltage"),
        (None, {"steps": "all"}, "'not done' at step propeller_off"),
        (None, {"radio": "another"}, "found none"),
        (None, {"port": "sim"}, "your own port, got a SIMULATED"),
        (None, {"camera": "sim"}, "your own camera, got a SIMULATED"),
        (None, {"calibration": "0" * 16}, "another calibration"),
        (None, {"date": f"{LONG_AGO}T10:00:00"}, "181 days old"),
        (None, {"date": "soon"}, "expected a record of falconwing doctor"),
        (None, {"list": "Before each flight"}, "found none"),
        (None, {"print_check": {"result": "NO", "seen": "99 of 100 mm"}}, "of 99 of 100 mm"),
    ],
)
def test_a_missing_step_is_named(tmp_path, change, more, sentence):
    """A passed one before it does not help: the newest counts."""
    record(tmp_path, change, number=1, **more)
    with pytest.raises(InputError, match=sentence):
        require_bench_test(tmp_path, BENCH, RADIO)


def test_a_later_failure_closes_the_door_again(tmp_path):
    """Passed in the morning, failed at noon."""
    record(tmp_path, number=1)
    record(tmp_path, result_of("surfaces", "NO"), number=2)
    with pytest.raises(InputError, match="at step surfaces"):
        require_bench_test(tmp_path, BENCH, RADIO)


def test_without_a_calibrated_radio_that_is_the_first_step(tmp_path):
    """The kit's default names no radio; a record that was made with it opens nothing."""
    default = load_calibration()
    record(tmp_path, radio="", calibration=calibration_digest(default))
    with pytest.raises(InputError, match="the first missing step is falconwing calibrate"):
        require_bench_test(tmp_path, BENCH, default)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--source", "camera", "--pilot", "pose"], "--port none, --source camera: expected"),
        (["--port", "COM3", "--pilot", "pose"], "--port COM3, --source sim: expected"),
        (["--port", "COM3", "--source", "camera"], "a pilot by images"),
        (["--port", "COM3", "--source", "camera", "--pilot", "pose", "--trials", "3"], "--trials"),
        (["--port", "COM3", "--source", "camera", "--pilot", "pose", "--seconds", "0"], "seconds"),
        (["--port", "COM3", "--source", "camera", "--pilot", "pose"], "falconwing calibrate"),
        (["--port", "COM3", "--source", "camera", "--pilot", "pose", "--radio", "X"], "--radio X"),
    ],
)
@pytest.mark.filterwarnings("ignore:the calibration")
def test_wrong_use_opens_nothing(words, sentence, tmp_path, monkeypatch, capsys):
    """Exit 2 and one sentence, before a port or a camera is touched."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main(["fly", *words]) == 2
    assert sentence in capsys.readouterr().err


def test_every_pilot_by_images_may_pass():
    """The guard asks the table, not a name."""
    assert [name for name, entry in PILOTS.items() if not entry.reads_state][:1] == ["pose"]


class FakePort:
    """A trainer port that notes what it is given."""

    def __init__(self, sticks=None):
        calibration = load_calibration()
        self.calibration, self.events, self.sent = calibration, deque(), []
        self.engagement, self.state, self.engage = "asking", "open", []
        pilot = types.SimpleNamespace(device_time_us=0, channels_us=sticks)
        self.pilot = None if sticks is None else pilot

    def now(self):
        return 0.1

    def to_host_time(self, device_us):
        return 0.0

    def poll(self):
        pass

    def send(self, command, engage):
        self.sent.append(command.vector.tolist())
        self.engage.append(engage)
        if not engage:
            self.engagement = "off"
        elif self.engagement == "off":
            self.engagement = "asking"

    def mismatch(self):
        return "a stick"

    def hand_back(self):
        pass

    def drop(self, name, **details):
        self.engagement = "dropped"
        self.events.append(types.SimpleNamespace(name=name, details=details))


@pytest.mark.parametrize(
    ("sticks", "first"),
    [(None, [0.0, 0.0, 0.0, 0.0]), ((1600, 1650, 1500, 1450), [0.6, 0.3, 0.0, -0.1])],
)
def test_the_board_engages_at_the_persons_sticks(sticks, first):
    """By hand from the shipped calibration, 1500 +- 500 us; idle and neutral without any."""
    port = FakePort(sticks)
    sink = AircraftPort(port)
    told = sink.send(0.0, Command(0.9, 0.9, 0.9, 0.9))
    port.engagement = "engaged"
    assert sink.send(0.05, Command(0.9, -0.9, 0.9, 0.9)) is None
    assert port.sent[0] == pytest.approx(first) and port.sent[1] == [0.9, -0.9, 0.9, 0.9]
    assert told is None if sticks is None else told.vector.tolist() == port.sent[0]


@pytest.mark.parametrize("end", ["dropped", "handed back"])
def test_after_the_end_idle_and_neutral_go_out(end):
    """And not the sticks: the board is SAFE, whatever the person holds."""
    port = FakePort((1600, 1650, 1500, 1450))
    sink = AircraftPort(port)
    if end == "dropped":
        port.engagement = end
    else:
        sink.hand_back()
    assert sink.send(1.0, Command(0.9, 0.9, 0.9, 0.9)) is None
    assert port.sent == [[0.0, 0.0, 0.0, 0.0]]


def test_the_person_taking_over_is_an_end_and_a_fault_is_another():
    """A stick takes over; a board that is SAFE without one has restarted, and LOST is a timeout."""
    step = types.SimpleNamespace(t=1.0)
    for name, state, text in (
        ("pilot took over", "SAFE", "the person took over"),
        ("dropped", "SAFE", "the board dropped"),
        ("dropped", "LOST", "the board dropped"),
    ):
        port = FakePort()
        sink = AircraftPort(port)
        port.drop(name, state=state, fault="none")
        sink.send(1.0, Command(0.0, 0.0, 0.0, 0.0))
        assert text in sink.stop_reason(step)
    port = FakePort()
    assert "did not engage" in AircraftPort(port).stop_reason(types.SimpleNamespace(t=15.1))
    port.state = "lost"
    assert AircraftPort(port).stop_reason(step) == "port lost"


class Key:
    """Enter, pressed by a test."""

    has_ended = pressed = False

    def take(self):
        pressed, self.pressed = self.pressed, False
        return pressed


FULL = Command(0.9, 0.9, 0.9, 0.9)
STICKS, IDLE = (1600, 1650, 1500, 1450), [0.0, 0.0, 0.0, 0.0]


def steps(sink, port, key, *moments):
    """What goes out at moments (t, Enter pressed): whether the board is asked, and whether it is
    the sticks and not the pilot's command.
    """
    went = []
    for t, pressed in moments:
        key.pressed = pressed
        sink.send(t, FULL)
        went.append((port.engage[-1], port.sent[-1] == pytest.approx([0.6, 0.3, 0.0, -0.1])))
        assert sink.stop_reason(types.SimpleNamespace(t=t)) == ""
    return went


def test_the_board_is_asked_by_enter_and_again_after_a_stick():
    """The person's sticks go out until it follows, and again once a stick has moved. Each hand-over
    begins with the pilot's reset; Enter while it follows is forgotten.
    """
    port, key, resets = FakePort(STICKS), Key(), []
    sink = AircraftPort(port, None, key, lambda: resets.append(port.engage[-1]))
    assert steps(sink, port, key, (0.0, False), (20.0, False)) == [(False, True)] * 2
    assert steps(sink, port, key, (20.05, True)) == [(True, True)]
    port.engagement = "engaged"
    assert steps(sink, port, key, (20.1, False), (20.15, True)) == [(True, False)] * 2
    port.drop("pilot took over", state="SAFE", fault="none")
    assert steps(sink, port, key, (20.2, True), (25.0, False)) == [(False, True)] * 2
    assert resets == [False]
    assert steps(sink, port, key, (25.05, True)) == [(True, True)]
    assert resets == [False, False]


def test_enter_counts_after_a_second_without_one():
    """Typed before the flight, or held down through a take-over, it asks for nothing."""
    port, key = FakePort(STICKS), Key()
    sink = AircraftPort(port, None, key)
    held = [(0.0, True), (0.9, True), (1.8, True)]  # each less than a second after the last
    assert steps(sink, port, key, *held, (2.9, True)) == [(False, True)] * 3 + [(True, True)]
    port.engagement = "engaged"
    steps(sink, port, key, (3.0, False))
    port.drop("pilot took over", state="SAFE", fault="none")
    held = [(4.0, True), (4.05, True), (5.0, True)]
    assert steps(sink, port, key, *held, (6.1, True)) == [(False, True)] * 3 + [(True, True)]


@pytest.mark.parametrize("end", ["dropped", "no pulses", "handed back"])
@pytest.mark.parametrize("t", [2.05, 30.0])
def test_a_fault_ends_a_flight_with_enter_too(end, t, capsys):
    """Idle and neutral go out, the person is told, and Enter asks for nothing more: soon after the
    hand-over, and after the 15 s in which a board has to follow.
    """
    port, key = FakePort(STICKS), Key()
    sink = AircraftPort(port, None, key)
    steps(sink, port, key, (0.0, False), (2.0, True))
    port.engagement = "engaged"
    capsys.readouterr()
    if end == "handed back":
        sink.hand_back()
    else:
        port.drop(end, state="LOST", fault="none")
    for moment in (t, t + 2.0):
        key.pressed = True
        sink.send(moment, FULL)
        assert port.sent[-1] == IDLE
    said = sink.stop_reason(types.SimpleNamespace(t=t))
    assert end == "handed back" or "the board dropped" in said
    sink.hand_back()
    err = capsys.readouterr().err
    assert err.count("LET GO") == 1 and "You fly" not in err


def test_a_board_that_does_not_follow_is_asked_no_longer(capsys):
    """After 15 s, with the stick that is off; and the person flies on."""
    port, key = FakePort(STICKS), Key()
    sink = AircraftPort(port, None, key)
    went = steps(sink, port, key, (5.0, True), (19.9, False), (20.1, False), (22.0, True))
    assert [asked for asked, _ in went] == [True, True, False, True]
    assert "does not follow: a stick" in capsys.readouterr().err


def test_sticks_that_are_measured_no_more_refuse_a_hand_over(capsys):
    """For then no stick would take over; where none were measured at all, the manual allows it with
    idle and neutral, as on the bench.
    """
    port, key = FakePort(STICKS), Key()
    sink = AircraftPort(port, None, key)
    steps(sink, port, key, (0.0, False))
    port.pilot = None
    key.pressed = True
    sink.send(2.0, FULL)
    assert port.engage[-1] is False and port.sent[-1] == IDLE
    assert "measured no more" in capsys.readouterr().err
    port, key = FakePort(), Key()
    sink, key.pressed = AircraftPort(port, None, key), True
    sink.send(2.0, FULL)
    assert port.engage[-1] is True and port.sent[-1] == IDLE


def test_the_end_of_standard_input_ends_a_flight_that_nobody_can_hand_over():
    """Unless the board is asked already."""
    port, key = FakePort(STICKS), Key()
    sink = AircraftPort(port, None, key)
    key.has_ended = True
    assert "nobody can press Enter" in sink.stop_reason(types.SimpleNamespace(t=1.0))
    assert steps(sink, port, key, (2.0, True)) == [(True, True)]


def test_enter_is_a_line_on_standard_input(monkeypatch):
    """One press, taken once; then the input is over, as after a key that is no text."""
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    key = EnterKey()
    assert wait_for(lambda: key.has_ended)
    assert key.take() and not key.take()
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"\xff\n"), "utf-8"))
    key = EnterKey()
    assert wait_for(lambda: key.has_ended)


def test_what_the_supervisor_finds_while_the_person_flies_ends_nothing(capsys):
    """An image of a second ago is too old for 0.4 s: no hand-over then, one after a new image, and
    the same fault hands back while the board follows. Its largest age is that of these images only.
    """
    port, key = FakePort(STICKS), Key()
    sink = AircraftPort(port, None, key)
    judge = HandOverSupervisor(SupervisorSettings(battery_s=60.0), sink)
    noise = np.random.default_rng(1)

    def see(sequence, t):
        pixels = noise.integers(0, 256, (120, 160, 3), np.uint8)
        judge.see(Image(sequence, t, pixels), t)

    def check(t, sequence):
        return judge.check(t, replace(FULL, image_sequence=sequence))

    see(1, 0.0)
    assert check(0.0, 1) == "" and check(2.0, 1) == ""
    assert steps(sink, port, key, (2.0, True)) == [(False, True)]
    assert "Not asked: the command answers an image of 2.00 s" in capsys.readouterr().err
    see(2, 2.0)
    assert check(2.05, 2) == ""
    assert steps(sink, port, key, (2.05, True)) == [(True, True)]
    assert check(3.0, 2) == ""  # asked, but it does not follow yet
    assert steps(sink, port, key, (3.0, False)) == [(False, True)]
    assert "does not follow: the command answers an image of 1.00 s" in capsys.readouterr().err
    see(3, 5.0)
    assert check(5.0, 3) == ""
    assert steps(sink, port, key, (5.0, True)) == [(True, True)]
    port.engagement = "engaged"
    assert check(5.3, 3) == ""
    port.drop("pilot took over", state="SAFE", fault="none")
    assert steps(sink, port, key, (5.3, False)) == [(False, True)]
    assert check(6.3, 3) == "" and judge.largest_age_s == pytest.approx(0.3)
    capsys.readouterr()
    see(4, 61.0)
    assert check(61.0, 4) == "" and check(61.05, 4) == ""
    assert capsys.readouterr().err.count("battery") == 1
    port.engagement = "engaged"
    assert "battery" in check(61.1, 4) and judge.reason
