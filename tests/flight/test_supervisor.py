"""The supervisor: each limit by hand, faults drawn at random, and its place in the loop."""

import math
import time

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import SAFE_COMMAND, Command, Image, State
from falconwing_kit.flight.loop import Loop
from falconwing_kit.flight.supervisor import Supervisor, SupervisorSettings
from falconwing_kit.vision.monitor import FrameMonitor
from tests.flight.supervised_flights import FAULTS, PERIOD, fly
from tests.flight.test_loop import Pilot, Recorder


def picture(number: int, t: float, value: int | None = None) -> Image:
    """An image of noise drawn from its number, or of one colour."""
    rng = np.random.default_rng(number)
    pixels = rng.integers(0, 256, (24, 32, 3), np.uint8)
    return Image(number, t, pixels if value is None else np.full_like(pixels, value))


def command(sequence: int = -1) -> Command:
    """A command that answers an image."""
    return Command(0.7, 0.0, 0.0, 0.0, sequence)


def level(roll_deg: float = 0.0, pitch_deg: float = 0.0, height: float = 1.0) -> State:
    """A state with this attitude and height."""
    return State(
        np.array([0.0, 0.0, height]), math.radians(pitch_deg), 0.0, math.radians(roll_deg),
        np.array([7.0, 0.0, 0.0]),
    )  # fmt: skip


def test_the_age_of_the_image_behind_a_command_is_limited():
    """Taken at 1.0 s: at 1.4 s it is 0.40 s old and allowed, at 1.45 s not. The margin was 0."""
    supervisor = Supervisor()
    supervisor.see(picture(7, 1.0), 1.05)
    assert [supervisor.check(t, command(7)) for t in (1.05, 1.2, 1.4)] == ["", "", ""]
    assert supervisor.margin_s == pytest.approx(0.0, abs=1e-12)
    assert "0.45 s, at most 0.4 allowed" in supervisor.check(1.45, command(7))


def test_a_new_image_helps_only_a_command_that_answers_it():
    """Image 8 is there, but the pilot still answers 7."""
    supervisor = Supervisor()
    supervisor.see(picture(7, 1.0), 1.0)
    supervisor.see(picture(8, 1.4), 1.4)
    assert supervisor.check(1.45, command(7))


def test_an_image_known_from_commands_only_counts_from_the_first_of_them():
    """As in a relay without images: ten commands on image 1 within 0.4 s pass, the next not."""
    supervisor = Supervisor()
    said = [supervisor.check(k * PERIOD, command(1)) for k in range(10)]
    assert said[:9] == [""] * 9 and said[9]


def test_a_stamp_from_the_future_does_not_make_an_image_new_for_ever():
    """An hour ahead: it counts from its arrival."""
    supervisor = Supervisor()
    supervisor.see(picture(1, 3600.0), 1.0)
    assert not supervisor.check(1.4, command(1)) and supervisor.check(1.45, command(1))


@pytest.mark.parametrize("t", [math.nan, math.inf, -math.inf])
def test_an_image_without_a_time_is_old(t):
    """A camera's driver that cannot tell when it took an image is no reason to trust it."""
    supervisor = Supervisor()
    supervisor.see(picture(1, t), 1.0)
    assert "allowed" in supervisor.check(1.0, command(1))


def test_the_times_of_images_do_not_fill_the_memory():
    """Ten minutes at 20 Hz keep the newest 64."""
    supervisor = Supervisor()
    for n in range(20 * 600):
        supervisor.check(n / 20.0, command(n))
    assert len(supervisor._taken) == 64 and not supervisor.reason


def test_a_pilot_by_images_needs_one():
    """0.4 s without any; a pilot by the state needs none."""
    by_images, by_state = Supervisor(by_images=True), Supervisor()
    for t in (0.0, 0.2, 0.4):
        assert not by_images.check(t, command())
    assert "no image for 0.45 s" in by_images.check(0.45, command())
    assert not [t for t in (0.0, 5.0, 50.0) if by_state.check(t, command())]


def test_five_identical_images_in_a_row_are_a_frozen_camera():
    """Four are allowed, and a different one begins the count again; JPEGs count the same way."""
    supervisor = Supervisor()
    for number, value in enumerate([5, 5, 5, 5, None, 5, 5, 5, 5]):
        supervisor.see(picture(number, 0.05 * number, value), 0.05 * number)
        assert not supervisor.check(0.05 * number, command(number))
    supervisor.see(picture(9, 0.45, 5), 0.45)
    assert supervisor.check(0.45, command(9)) == "5 identical images in a row"
    by_jpeg = Supervisor()
    for number in range(5):
        jpeg = np.frombuffer(picture(0, 0.0, 9).jpeg, np.uint8)
        by_jpeg.see(Image(number, 0.05 * number, jpeg), 0.05 * number)
    assert by_jpeg.check(0.2, command(4))


def test_the_same_image_given_again_is_not_another_one():
    """The loop's newest image may come in every step."""
    supervisor = Supervisor()
    for _ in range(9):
        supervisor.see(picture(1, 0.0), 0.1)
    assert not supervisor.check(0.1, command(1))


@pytest.mark.parametrize(
    ("state", "word"),
    [
        (level(roll_deg=81.0), "bank of 81 deg"),
        (level(roll_deg=-81.0), "bank of -81 deg"),
        (level(roll_deg=180.0), "bank of 180 deg"),
        (level(pitch_deg=-61.0), "pitch of -61 deg"),
        (level(height=4.7), "height of 4.7 m"),
        (level(79.0, 59.0, 4.6), ""),
        (level(roll_deg=360.0), ""),
        (level(roll_deg=math.nan, pitch_deg=math.nan, height=math.nan), ""),
        (None, ""),
    ],
)
def test_the_envelope(state, word):
    """80 deg of bank, 60 of pitch, 4.65 m; what is unknown is not judged."""
    reason = Supervisor().check(0.0, command(), state)
    assert word in reason and bool(reason) == bool(word)


@pytest.mark.parametrize(
    ("given", "pilot_s"),
    [
        (None, 0.0),
        (Command(math.nan, 0.0, 0.0, 0.0), 0.0),
        (command(), 0.21),
        (command(), math.nan),
    ],
)
def test_a_pilot_that_fails_or_hangs(given, pilot_s):
    """No command, not a number, or more than the board's 200 ms."""
    assert Supervisor().check(0.0, given, None, pilot_s)
    assert not Supervisor().check(0.0, command(), None, 0.19)


def test_limits_of_time_are_options():
    """None unless asked for; counted from the first command."""
    supervisor = Supervisor(SupervisorSettings(max_active_s=60.0))
    assert not supervisor.check(100.0, command()) and not supervisor.check(160.0, command())
    assert "60 s of autonomous flight" in supervisor.check(160.05, command())
    battery = Supervisor(SupervisorSettings(battery_s=300.0))
    battery.check(0.0, command())
    assert "battery" in battery.check(300.05, command())


def test_a_reason_stays():
    """A fault that goes away is not forgiven in the same flight."""
    supervisor = Supervisor()
    first = supervisor.check(0.0, None)
    assert first and supervisor.check(0.05, command()) == first == supervisor.record["reason"]


def test_the_frame_monitor_is_asked():
    """White noise, new in each frame, five times: the paper's flag acts."""
    supervisor, rng = Supervisor(monitor=FrameMonitor()), np.random.default_rng(0)
    for number in range(12):
        t = 0.05 * number
        supervisor.see(Image(number, t, rng.integers(0, 256, (48, 64, 3), np.uint8)), t)
        supervisor.check(t, command(number))
    assert supervisor.reason.startswith("frame monitor: noise")


def test_a_picture_that_the_monitor_cannot_read_is_a_fault():
    """Bytes that are no JPEG."""
    supervisor = Supervisor(monitor=FrameMonitor())
    supervisor.see(Image(0, 0.0, np.arange(9, dtype=np.uint8)), 0.0)
    assert supervisor.check(0.0, command(0)).startswith("frame monitor: ")


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_drawn_at_random_are_noticed_in_time(fault):
    """Ninety flights of each kind; `bench_supervisor` flies 10,000, and 20 hours without a fault.

    Never before the fault: that would be a false hand-back.
    """
    rng = np.random.default_rng([11, len(fault)])
    for _ in range(90):
        began, noticed = fly(rng, fault)
        assert began <= noticed <= began + FAULTS[fault] + 1e-6, (fault, began, noticed)


def test_limits_out_of_range_are_refused():
    """One sentence each."""
    for wrong in ({"max_image_age_s": 0.0}, {"identical_images": 1}, {"max_bank": math.nan}):
        with pytest.raises(InputError, match=f"{next(iter(wrong))}: expected"):
            SupervisorSettings(**wrong)


class FrozenCamera:
    """A new image in every step until 1 s; then always the last."""

    def next_image(self, t: float) -> Image:
        number = round(min(t, 1.0) / PERIOD)
        return picture(number, number * PERIOD)


class Board(Recorder):
    """A sink that can hand back."""

    def __init__(self) -> None:
        super().__init__()
        self.handed_back_after = None

    def hand_back(self) -> None:
        self.handed_back_after = len(self.sent)


@pytest.mark.parametrize("supervised", [True, False])
def test_a_frozen_camera_ends_the_flight_only_under_supervision(supervised):
    """Image 20 is of 1.0 s; the command at 1.45 s would answer it 0.45 s late and is not sent."""
    sink = Board()
    supervisor = Supervisor(by_images=True) if supervised else None
    loop = Loop(Pilot(), sink, FrozenCamera(), supervisor=supervisor)
    flight = loop.run(5.0)
    if not supervised:
        assert flight.reason == "duration" and sink.handed_back_after is None
        return
    assert flight.reason == "handed back" and sink.handed_back_after == 29
    assert sink.sent[28][1].throttle == 0.5 and sink.sent[28][0] == pytest.approx(1.4)
    assert [sent.vector.tolist() for _, sent in sink.sent[29:]] == [
        SAFE_COMMAND.vector.tolist()
    ] * 2
    event = next(event for event in flight.events if event.name == "handed back")
    assert event.t == pytest.approx(1.45) and "0.45 s" in event.details["reason"]


def test_a_clean_flight_says_how_near_it_came_to_the_limit():
    """Each image is used at once: the margin is the whole limit."""
    camera = FrozenCamera()
    flight = Loop(Pilot(), Recorder(), camera, supervisor=Supervisor(by_images=True)).run(1.0)
    details = next(event.details for event in flight.events if event.name == "supervisor")
    assert details["largest_image_age_s"] == 0.0 and not details["reason"]


def test_a_pilot_that_raises_hands_back_at_once_under_supervision():
    """Without a supervisor the loop waits for a second of faults."""

    def fail():
        raise RuntimeError("no")

    flight = Loop(Pilot(step3=fail), Recorder(), supervisor=Supervisor()).run(1.0)
    assert (flight.reason, len(flight.t)) == ("handed back", 4)


def test_equal_pictures_under_new_numbers_end_the_flight():
    """The loop shows every new image to the supervisor: the fifth equal one comes in step 4."""

    class StuckSensor:
        def next_image(self, t: float) -> Image:
            return picture(round(t / PERIOD), t, value=90)

    flight = Loop(Pilot(), Recorder(), StuckSensor(), supervisor=Supervisor()).run(1.0)
    assert (flight.reason, len(flight.t)) == ("handed back", 5)


def test_a_slow_pilot_ends_the_flight():
    """The loop tells the supervisor how long the pilot took: 50 ms of 10 ms allowed, in step 3."""

    def ponder():
        time.sleep(0.05)
        return Command(0.5, 0.0, 0.0, 0.0)

    supervisor = Supervisor(SupervisorSettings(max_pilot_s=0.01))
    flight = Loop(Pilot(step3=ponder), Recorder(), supervisor=supervisor).run(1.0)
    assert flight.reason == "handed back" and "the pilot took" in supervisor.reason
