"""Bus: the same claims for the bus inside a program and for the one through ROS; and the relay
between bus and port.
"""

import threading
import time

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.flight.supervisor import Supervisor
from falconwing_kit.tools.bridge.bus import (
    COMMAND,
    IMAGE,
    PILOT,
    STATUS,
    StampedCommand,
    StampedStatus,
    relay,
)
from falconwing_kit.tools.bridge.ros import RosBus
from falconwing_kit.trainer_port.ppm import load_calibration
from falconwing_kit.trainer_port.protocol import PilotFrame, Status
from tests.tools.bridge.local_bus import LocalBus

NOW = 1.7e9  # a time of today: seconds since 1970
STAMP = 1e-6  # what is left of a stamp after floats and whole nanoseconds [s]
PATIENCE = (
    10.0  # s, for a message that must come; a busy machine needs some, a good one milliseconds
)
JPEG = np.frombuffer(b"\xff\xd8" + bytes(range(256)) * 40, np.uint8)
BOARD = Status(
    "ACTIVE",
    "none",
    2,
    8,
    65535,
    70000,
    1,
    2,
    3,
    4_000_000_000,
    False,
    (1000, 1500, 1501, 2000),
    123,
)
MESSAGES = {
    IMAGE: Image(17, NOW, JPEG),
    COMMAND: StampedCommand(NOW, Command(0.25, -1.0, 0.5, 0.125, 17, saturated=True), engage=True),
    PILOT: StampedCommand(NOW, Command(1.0, 0.0, -0.5, 1.0)),
    STATUS: StampedStatus(NOW, BOARD),
}  # sticks are such that 32 bits hold them exactly


def test_newest_wins(ends):
    """Of ten messages sent without a pause the last one comes last, none comes twice and none out
    of order.
    """
    sender, receiver = ends
    inbox = connect(sender, receiver, IMAGE)
    for k in range(10):
        sender.publish(IMAGE, Image(k, NOW + k, JPEG))
    taken = [inbox.take(PATIENCE).sequence]
    while taken[-1] != 9:
        taken.append(inbox.take(PATIENCE).sequence)
    assert taken == sorted(set(taken))
    assert inbox.take() is None and inbox.take(0.01) is None


@pytest.mark.parametrize("topic", MESSAGES)
def test_a_message_arrives_as_it_was_sent(ends, topic):
    """Every byte, stick, counter and number is the one above; each listener gets its own."""
    sender, receiver = ends
    inboxes = [connect(sender, receiver, topic), connect(sender, receiver, topic)]
    sender.publish(topic, MESSAGES[topic])
    for inbox in inboxes:
        got, sent = inbox.take(PATIENCE), MESSAGES[topic]
        assert got.t == pytest.approx(sent.t, rel=0, abs=STAMP)
        if topic == IMAGE:
            assert got.sequence == 17 and got.pixels.tobytes() == JPEG.tobytes()
        elif topic == STATUS:
            assert got.status == BOARD
        else:
            assert (got.command, got.engage) == (sent.command, sent.engage)


def test_take_waits_for_what_is_on_its_way(ends):
    """A controller sleeps until its image is there: sent by another thread while it waits."""
    sender, receiver = ends
    inbox = connect(sender, receiver, COMMAND)
    later = threading.Timer(0.05, sender.publish, (COMMAND, MESSAGES[COMMAND]))
    later.start()
    assert inbox.take(PATIENCE).engage
    later.join()


def test_after_close_nothing_is_heard(ends):
    """A message to a closed bus is lost, and the number of listeners is zero."""
    sender, receiver = ends
    inbox = connect(sender, receiver, PILOT)
    receiver.close()
    until(lambda: sender.listeners(PILOT) == 0)
    sender.publish(PILOT, MESSAGES[PILOT])
    assert inbox.take(0.1) is None


def test_wrong_topics_and_messages_are_refused(ends):
    """One sentence with what was wanted."""
    sender, _ = ends
    with pytest.raises(
        InputError, match=r"topic: expected one of /falconwing/image, .* got '/falconwing/imgae'"
    ):
        sender.subscribe("/falconwing/imgae")
    with pytest.raises(
        InputError, match="/command: expected a message of type StampedCommand, got Command"
    ):
        sender.publish(COMMAND, Command(0.0, 0.0, 0.0, 0.0))


class FakePort:
    """A trainer port that records its calls in order."""

    calibration = load_calibration()

    def __init__(self) -> None:
        self.status, self.pilot, self.told, self.polls, self.late = None, None, [], 0, 0.0

    def now(self) -> float:
        return 50.0  # the port's clock is another than the bus's

    def poll(self) -> None:
        self.polls += 1

    def send(self, command: Command, engage: bool) -> bool:
        self.told.append((command.throttle, engage))
        return True

    def hand_back(self) -> None:
        self.told.append("hand back")

    def to_host_time(self, device_us: int) -> float:
        return 40.0 + device_us * 1e-6


def relayed(port, script, clock=lambda: NOW, **options):
    """Run a relay in which each entry of the script acts before one turn of its loop; what it
    moved, and the bus.
    """
    bus, steps = LocalBus(), iter(script)
    inboxes = {topic: bus.subscribe(topic) for topic in (PILOT, STATUS)}

    def stop():
        step = next(steps, None)
        if step is not None:
            step(bus, port)
        return step is None

    return relay(port, bus, stop, clock=clock, **options), inboxes


def order(throttle, t=NOW, engage=True):
    """A step of a script: publish a command."""
    return lambda bus, port: bus.publish(
        COMMAND, StampedCommand(t, Command(throttle, 0.0, 0.0, 0.0), engage)
    )


def rest(bus, port):
    """A step of a script in which nothing happens."""


def test_relay_sends_each_command_once_and_hands_back():
    """Two commands, three turns without: none is repeated, or the board could not time out."""
    port = FakePort()
    moved, _ = relayed(port, [order(0.5, engage=False), rest, rest, order(0.7), rest])
    assert port.told == [(0.5, False), (0.7, True), "hand back"]
    assert (moved.commands, moved.late, port.polls) == (2, 0, 5)


def test_relay_refuses_commands_with_a_stamp_far_from_now():
    """0.2 s is what the board itself waits; a stamp from the future shows clocks that disagree."""
    port = FakePort()
    stale = [
        order(k / 10, t) for k, t in enumerate([NOW - 0.19, NOW - 0.21, NOW + 0.19, NOW + 0.21])
    ]
    moved, _ = relayed(port, [*stale, rest])
    assert port.told == [(0.0, True), (0.2, True), "hand back"] and (
        moved.commands,
        moved.late,
    ) == (2, 2)


def test_relay_hands_back_when_it_breaks():
    """Whatever ends the relay, the pilot has the sticks."""
    port = FakePort()

    def interrupt(bus, port):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        relayed(port, [order(0.5), rest, interrupt])
    assert port.told == [(0.5, True), "hand back"]


def test_relay_publishes_status_and_pilot_once_each():
    """The pilot's last edge came at 2 s of the board, 42 s of the port, so 8 s ago; 1500 us are
    half throttle.
    """
    port = FakePort()

    def report(bus, port):
        port.status, port.pilot = BOARD, PilotFrame(2_000_000, 0, 0, (1500, 1500, 1500, 1500))

    moved, inboxes = relayed(port, [report, rest, rest])
    assert inboxes[STATUS].take() == StampedStatus(NOW, BOARD)
    assert inboxes[PILOT].take() == StampedCommand(
        NOW - 8.0, Command(0.5, 0.0, 0.0, 0.0), engage=False
    )
    assert (moved.reports, moved.pilot) == (1, 1) and not any(
        inbox.dropped for inbox in inboxes.values()
    )


def test_relay_lives_on_when_the_pilots_radio_has_too_few_channels():
    """Three slots are no four sticks: counted, and the next command is sent as if nothing was."""
    port = FakePort()

    def report(bus, port):
        port.pilot = PilotFrame(0, 0, 0, (1500, 1500, 1500))

    moved, inboxes = relayed(port, [report, order(0.5), rest])
    assert port.told == [(0.5, True), "hand back"] and (moved.unreadable, moved.pilot) == (1, 0)
    assert inboxes[PILOT].take() is None


@pytest.fixture(params=["Bus", "RosBus"])
def ends(request):
    """Two ends of one bus: one to publish, one to listen."""
    if request.param == "Bus":
        bus = LocalBus()
        yield bus, bus
        return
    request.getfixturevalue("ros_master")
    sender, receiver = RosBus(), RosBus()
    yield sender, receiver
    sender.close()
    receiver.close()


def connect(sender, receiver, topic):
    """A mailbox that what the sender publishes from now on will reach."""
    before = sender.listeners(topic)
    inbox = receiver.subscribe(topic)
    until(
        lambda: sender.listeners(topic) > before or (isinstance(sender, RosBus) and before > 0)
    )  # a node is one listener
    return inbox


def until(condition):
    """Wait for something that must come."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.005)


class MovingClock:
    """The bus's time: 50 ms later at every command that the script publishes."""

    def __init__(self) -> None:
        self.t = NOW

    def __call__(self) -> float:
        return self.t

    def command(self, sequence, engage=True, image=False):
        """A step of a script: 50 ms pass, and a command answers an image, which may come too."""

        def publish(bus, port):
            self.t += 0.05
            if image:
                pixels = np.full((24, 32, 3), sequence % 251, np.uint8)
                bus.publish(IMAGE, Image(sequence, self.t, pixels))
            answer = Command(1.0, 0.0, 0.0, 0.0, sequence)
            bus.publish(COMMAND, StampedCommand(self.t, answer, engage))

        return publish


def test_a_relay_under_supervision_hands_back_on_a_frozen_image():
    """Full throttle on image 1 for ten seconds: commands within 0.4 s of it pass, no other.

    The first answers it as it comes; eight more are at most 0.40 s later.
    """
    clock, port, said = MovingClock(), FakePort(), []
    script = [clock.command(1, image=k == 0) for k in range(200)]
    moved, _ = relayed(
        port, [*script, rest], clock,
        supervise=lambda: Supervisor(by_images=True), on_hand_back=said.append,
    )  # fmt: skip
    assert port.told == [(1.0, True)] * 9 + ["hand back", "hand back"]  # the second is the end
    assert (moved.commands, moved.handed_back, moved.refused) == (9, 1, 190)
    assert said == [moved.reason] and "0.45 s" in moved.reason


def test_a_controller_may_engage_again_after_letting_go():
    """After a hand-back one command without engage begins a new flight."""
    clock, port = MovingClock(), FakePort()
    bad = [clock.command(1, image=k == 0) for k in range(12)]
    good = [clock.command(50 + k, image=True) for k in range(3)]
    relayed(
        port, [*bad, *good[:1], clock.command(51, engage=False, image=True), *good[1:], rest],
        clock, supervise=lambda: Supervisor(by_images=True),
    )  # fmt: skip
    assert port.told[9:] == ["hand back", (1.0, False), (1.0, True), (1.0, True), "hand back"]


def test_a_controller_that_names_no_image_is_refused_where_it_should_fly_by_images():
    """Within 0.4 s; without a supervisor, or for one that flies without a camera, it passes."""
    for by_images, passed in ((True, 9), (False, 20)):
        clock, port = MovingClock(), FakePort()
        script = [clock.command(-1) for _ in range(20)]
        moved, _ = relayed(
            port, [*script, rest], clock, supervise=lambda b=by_images: Supervisor(by_images=b)
        )
        assert moved.commands == passed
