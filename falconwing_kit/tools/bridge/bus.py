"""Message bus: images, commands, pilot frames and board status by topic; relay bus <-> port.

`RosBus` (ros.py) is the bus through ROS. Times on a bus are Unix time [s], because other programs
read them.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.flight.supervisor import Supervisor
from falconwing_kit.trainer_port.ppm import Calibration
from falconwing_kit.trainer_port.protocol import PilotFrame, Status

IMAGE, COMMAND, PILOT, STATUS = (
    "/falconwing/image",
    "/falconwing/command",
    "/falconwing/pilot",
    "/falconwing/status",
)
MAX_AGE = 0.2  # an older command is not sent [s]; the board's own timeout
POLL_PERIOD = 0.002  # maximum time between two reads of the port [s]


@dataclass(frozen=True)
class StampedCommand:
    """Control inputs of a controller or of the pilot."""

    t: float  # time at which they were given [s]
    command: Command
    engage: bool = False  # True: the aircraft shall follow; always False for the pilot


@dataclass(frozen=True)
class StampedStatus:
    """Status of the board."""

    t: float  # time of arrival [s]
    status: Status


MESSAGES: dict[str, type] = {
    IMAGE: Image,
    COMMAND: StampedCommand,
    PILOT: StampedCommand,
    STATUS: StampedStatus,
}


class Mailbox:
    """The newest message of one topic: a queue of length one, because old images are useless."""

    def __init__(self) -> None:
        self.dropped = 0  # messages replaced by a newer one before they were taken
        self._message: Any = None
        self._arrived = threading.Condition()

    def put(self, message: Any) -> None:
        """Store a message; an older one that was not taken is dropped."""
        with self._arrived:
            self.dropped += self._message is not None
            self._message = message
            self._arrived.notify_all()

    def take(self, timeout: float = 0.0) -> Any:
        """The newest message, each only once; None if none arrives within the timeout [s]."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._message is not None, timeout)
            message, self._message = self._message, None
        return message


class MessageBus(Protocol):
    """What the relay needs of a bus."""

    def publish(self, topic: str, message: Any) -> None:
        """Send a message to all current subscribers."""

    def subscribe(self, topic: str) -> Mailbox:
        """A mailbox for the messages from now on."""


def require_topic(topic: str) -> str:
    """Return the topic if it is one of MESSAGES, else raise InputError."""
    if topic not in MESSAGES:
        raise InputError(f"topic: expected one of {', '.join(MESSAGES)}, got {topic!r}")
    return topic


def require_message(topic: str, message: Any) -> None:
    """Raise InputError unless the topic exists and carries messages of this type."""
    expected_type = MESSAGES[require_topic(topic)]
    if not isinstance(message, expected_type):
        raise InputError(
            f"{topic}: expected a message of type {expected_type.__name__}, "
            f"got {type(message).__name__}"
        )


class RelayPort(Protocol):
    """What the relay needs of a TrainerPort."""

    calibration: Calibration
    now: Callable[[], float]
    status: Status | None
    pilot: PilotFrame | None

    def poll(self) -> None:
        """Read from the board."""

    def send(self, command: Command, engage: bool) -> bool:
        """Send one command."""

    def hand_back(self) -> None:
        """Return control to the pilot."""

    def to_host_time(self, device_us: int) -> float:
        """A time of the board on the clock `now` [s]."""


@dataclass
class RelayCounts:
    """Messages handled by a relay."""

    commands: int = 0  # passed to the port
    late: int = 0  # commands refused because their stamp was too far from now
    reports: int = 0  # statuses published
    pilot: int = 0  # pilot frames published
    unreadable: int = 0  # pilot frames with too few channels
    refused: int = 0  # engaged commands after the supervisor handed back
    handed_back: int = 0  # times that the supervisor returned control to the pilot
    reason: str = ""  # of the last one


def relay(
    port: RelayPort,
    bus: MessageBus,
    stop: Callable[[], bool],
    *,
    max_age: float = MAX_AGE,
    clock: Callable[[], float] = time.time,
    supervise: Callable[[], Supervisor] | None = None,
    on_hand_back: Callable[[str], None] = lambda reason: None,
) -> RelayCounts:
    """Relay commands from a bus to a trainer port, and pilot frames and status back.

    Nothing is repeated: when commands stop, nothing is sent and the board goes to its safe state.
    However the relay ends, control is handed back. With a supervisor, a fault in the images or
    commands hands back too; engaged commands are then refused until one without engage.

    Args:
        port: the trainer port.
        bus: source of the commands.
        stop: called every few milliseconds; True ends the relay.
        max_age: a command with a stamp further from now is refused [s]; two machines need
            synchronised clocks.
        clock: the bus's time [s].
        supervise: makes a supervisor for each engaged flight; None: commands are not judged.
        on_hand_back: called with the supervisor's reason.
    """
    inbox, counts = bus.subscribe(COMMAND), RelayCounts()
    images = bus.subscribe(IMAGE) if supervise else None
    supervisor = supervise() if supervise else None
    status, pilot = port.status, port.pilot
    try:
        while not stop():
            stamped = inbox.take(POLL_PERIOD)
            image = images.take() if images else None
            if supervisor is not None and image is not None:
                supervisor.see(image, clock())
            if stamped is not None and abs(clock() - stamped.t) > max_age:
                counts.late += 1
            elif stamped is not None:
                if supervise is not None and supervisor is not None and not stamped.engage:
                    supervisor = supervise() if supervisor.reason else supervisor
                if _may_pass(supervisor, stamped, clock(), port, counts, on_hand_back):
                    port.send(stamped.command, stamped.engage)
                    counts.commands += 1
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


def _may_pass(
    supervisor: Supervisor | None, stamped: StampedCommand, now: float, port: RelayPort,
    counts: RelayCounts, on_hand_back: Callable[[str], None],
) -> bool:  # fmt: skip
    """Whether a command may reach the board; control is handed back at the first fault."""
    if supervisor is None or not stamped.engage:
        return True
    had_fault = bool(supervisor.reason)
    if not supervisor.check(now, stamped.command):
        return True
    if had_fault:
        counts.refused += 1
    else:
        port.hand_back()
        counts.handed_back += 1
        counts.reason = supervisor.reason
        on_hand_back(supervisor.reason)
    return False


def _publish_pilot(
    port: RelayPort, pilot: PilotFrame, bus: MessageBus, t: float, counts: RelayCounts
) -> None:
    """Publish the pilot's control inputs with the time of their last edge, or now if unknown."""
    age = port.now() - port.to_host_time(pilot.device_time_us)
    t_edge = t if math.isnan(age) else t - age
    try:
        command = port.calibration.command(pilot.channels_us)
    except InputError:  # a radio with few channels must not end the flight
        counts.unreadable += 1
        return
    bus.publish(PILOT, StampedCommand(t_edge, command))
    counts.pilot += 1
