"""Bus: images, commands, pilot sticks and board status by topic -> the newest message for everyone
who asks.

`LocalBus` lives inside one program, `RosBus` (ros.py) goes through ROS; whoever uses one can use
the other. Times on a bus are Unix time [s], for other programs read them too.
"""

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.trainer_port.ppm import Calibration
from falconwing_kit.trainer_port.protocol import PilotFrame, Status

IMAGE, COMMAND, PILOT, STATUS = (
    "/falconwing/image",
    "/falconwing/command",
    "/falconwing/pilot",
    "/falconwing/status",
)
MAX_AGE = 0.2  # a command older than the board's own patience is not sent [s]
POLL_PERIOD = 0.002  # the port is read at least so often [s]


@dataclass(frozen=True)
class StampedCommand:
    """Stick positions on their way: what a controller wants, or what the pilot holds."""

    t: float  # when they were given [s]
    command: Command
    engage: bool = False  # True: the aircraft shall follow; a pilot's sticks never ask


@dataclass(frozen=True)
class StampedStatus:
    """What the board said of itself."""

    t: float  # when it arrived [s]
    status: Status


MESSAGES: dict[str, type] = {
    IMAGE: Image,
    COMMAND: StampedCommand,
    PILOT: StampedCommand,
    STATUS: StampedStatus,
}


class Mailbox:
    """The newest message of one topic; a queue of one, for an old image is worth nothing."""

    def __init__(self) -> None:
        self.dropped = 0  # messages that a newer one replaced before anyone took them
        self._message: Any = None
        self._arrived = threading.Condition()

    def put(self, message: Any) -> None:
        """Leave a message; one that nobody took yet is dropped."""
        with self._arrived:
            self.dropped += self._message is not None
            self._message = message
            self._arrived.notify_all()

    def take(self, timeout: float = 0.0) -> Any:
        """Take the newest message.

        Args:
            timeout: how long to wait for one [s].

        Returns:
            An Image, Sticks or Report, each of them once; None where none came.
        """
        with self._arrived:
            self._arrived.wait_for(lambda: self._message is not None, timeout)
            message, self._message = self._message, None
        return message


class MessageBus(Protocol):
    """What `LocalBus` and `RosBus` have in common."""

    def publish(self, topic: str, message: Any) -> None:
        """Hand a message to all who listen now."""

    def subscribe(self, topic: str) -> Mailbox:
        """Listen from now on."""

    def listeners(self, topic: str) -> int:
        """How many listen; a message to none is lost."""

    def close(self) -> None:
        """Publish and hear no more."""


class LocalBus:
    """The bus inside one program; publishing is safe from any thread."""

    def __init__(self) -> None:
        self._mailboxes: dict[str, list[Mailbox]] = defaultdict(list)

    def publish(self, topic: str, message: Any) -> None:
        """Hand a message to all who listen now.

        Args:
            topic: one of MESSAGES.
            message: what that topic carries.

        Raises:
            InputError: there is no such topic, or it carries something else.
        """
        require_message(topic, message)
        for mailbox in self._mailboxes[topic]:
            mailbox.put(message)

    def subscribe(self, topic: str) -> Mailbox:
        """Listen from now on.

        Args:
            topic: one of MESSAGES.

        Returns:
            Where the topic's newest message lies.

        Raises:
            InputError: there is no such topic.
        """
        require_topic(topic)
        self._mailboxes[topic].append(mailbox := Mailbox())
        return mailbox

    def listeners(self, topic: str) -> int:
        """How many listen to a topic.

        Raises:
            InputError: there is no such topic.
        """
        require_topic(topic)
        return len(self._mailboxes[topic])

    def close(self) -> None:
        """Forget all who listen."""
        self._mailboxes.clear()


def require_topic(topic: str) -> str:
    """Return the topic if the bus has it.

    Raises:
        InputError: it does not.
    """
    if topic not in MESSAGES:
        raise InputError(f"topic: expected one of {', '.join(MESSAGES)}, got {topic!r}")
    return topic


def require_message(topic: str, message: Any) -> None:
    """Check that a topic carries such a message.

    Raises:
        InputError: there is no such topic, or it carries something else.
    """
    expected_type = MESSAGES[require_topic(topic)]
    if not isinstance(message, expected_type):
        raise InputError(
            f"{topic}: expected a message of type {expected_type.__name__}, got {type(message).__name__}"
        )


class RelayPort(Protocol):
    """What the relay needs of a TrainerPort."""

    calibration: Calibration
    now: Callable[[], float]
    status: Status | None
    pilot: PilotFrame | None

    def poll(self) -> None:
        """Read what the board sent."""

    def send(self, command: Command, engage: bool) -> bool:
        """Send one command."""

    def hand_back(self) -> None:
        """Give the sticks back to the pilot at once."""

    def to_host_time(self, device_us: int) -> float:
        """The board's time on the clock `now` [s]."""


@dataclass
class RelayCounts:
    """What a relay moved."""

    commands: int = 0  # handed to the port
    late: int = 0  # commands refused, for their stamp was too far from now
    reports: int = 0  # statuses published
    pilot: int = 0  # pilot frames published
    unreadable: int = 0  # pilot frames with fewer channels than there are sticks


def relay(
    port: RelayPort,
    bus: MessageBus,
    stop: Callable[[], bool],
    *,
    max_age: float = MAX_AGE,
    clock: Callable[[], float] = time.time,
) -> RelayCounts:
    """Move commands from a bus to a trainer port, and pilot and status back, until told to stop.

    Nothing is repeated: when commands stop coming, nothing is sent and the board goes safe by
        itself. However the
    relay ends, the sticks are handed back.

    Args:
        port: the trainer port.
        bus: where commands come from.
        stop: asked every few milliseconds; True ends the relay.
        max_age: a command with a stamp further from now is refused [s]; two machines need equal
            clocks for it.
        clock: the bus's time [s].

    Returns:
        What was moved.
    """
    inbox, counts = bus.subscribe(COMMAND), RelayCounts()
    status, pilot = port.status, port.pilot
    try:
        while not stop():
            stamped = inbox.take(POLL_PERIOD)
            if stamped is not None and abs(clock() - stamped.t) <= max_age:
                port.send(stamped.command, stamped.engage)
                counts.commands += 1
            elif stamped is not None:
                counts.late += 1
            port.poll()
            if port.status is not None and port.status is not status:
                status = port.status
                bus.publish(STATUS, StampedStatus(clock(), status))
                counts.reports += 1
            if port.pilot is not None and port.pilot is not pilot:
                pilot = port.pilot
                _publish_pilot(port, pilot, bus, clock(), counts)
    finally:
        port.hand_back()
    return counts


def _publish_pilot(
    port: RelayPort, pilot: PilotFrame, bus: MessageBus, t: float, counts: RelayCounts
) -> None:
    """Publish the pilot's sticks with the time of their last edge, as far as the board's clock is
    known.
    """
    age = port.now() - port.to_host_time(pilot.device_time_us)
    try:
        bus.publish(
            PILOT,
            StampedCommand(
                t - (0.0 if math.isnan(age) else age), port.calibration.command(pilot.channels_us)
            ),
        )
        counts.pilot += 1
    except InputError:  # a radio with few channels must not end the flight
        counts.unreadable += 1
