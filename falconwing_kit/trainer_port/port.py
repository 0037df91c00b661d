"""Trainer port: commands in, frames to the board; its status, the pilot's sticks and its time out.

There is no heartbeat: only `send` makes a COMMAND, so a loop that stops is noticed by the board
within 200 ms. Nothing is sent before the board's first STATUS, for a Mega's boot loader listens for
two seconds after a reset. On the way to the aircraft nothing raises: a lost port is a state and an
event, and `poll` opens it again.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Event
from falconwing_kit.trainer_port.clock import DeviceClock
from falconwing_kit.trainer_port.ppm import Calibration, load_calibration
from falconwing_kit.trainer_port.protocol import (
    Deframer,
    PilotFrame,
    Status,
    SyncReply,
    encode_channels,
    encode_sync,
)

SILENT_AFTER = 0.5  # s without a STATUS, which comes 20 times a second
ENGAGE_WITHIN = 1.0  # s from the edge to ACTIVE; then the edge is tried again
SYNC_PERIOD, FIRST_SYNCS = 0.5, 8  # s between round trips; the first eight go ten times as fast
BACK_OFF = (0.25, 4.0)  # s between attempts to open a lost port: the first, doubled up to the last
IDLE = 0.02  # throttle that turns no motor
HAND_BACK_FRAMES = 3  # in a burst: one is enough, two may be damaged on the way
SAFE = Command(throttle=0.0, aileron=0.0, elevator=0.0, rudder=0.0)


class Link(Protocol):
    """A line to the board: a serial port, or a simulated board."""

    def write(self, data: bytes) -> Any:
        """Send bytes; OSError where the line is gone."""

    def read(self) -> bytes:
        """What has come since the last call, at once; OSError where the line is gone."""


@dataclass
class Counters:
    """What was counted since the port was made; the board's own counters are in its STATUS."""

    sent: int = 0  # COMMAND frames written
    unsent: int = 0  # commands that could not be written: no port, or no STATUS yet
    accepted: int = 0  # of those sent, by the board's count
    dropped: int = 0  # of those sent, not accepted though a later one was
    bad: int = 0  # frames from the board that were damaged
    resets: int = 0  # of the board, seen by its boot count or its clock
    reconnects: int = 0  # openings of a lost port


class TrainerPort:
    """The board at the other end of a link.

    `state` is "waiting" (no STATUS yet), "open", "silent" (STATUS stopped; nothing is sent until it
    is back) or "lost". `engagement` is "off", "asking" (engage=0 goes out until the board is SAFE
    and heard it), "engaging" (engage=1 goes out until the board is ACTIVE), "engaged" or "dropped".
    When the board stops following, for whatever reason, or the sticks were handed back, it stays
    dropped until `send` was called with engage=False once: nobody takes the aircraft back by
    accident.

    Args:
        link: the line; its method `read_stamped`, where it has one, gives the times at which bytes
            came.
        calibration: sticks to microseconds; None takes the kit's own.
        now: the host's clock [s]; for a simulated board its virtual time.
        reopen: makes a new link when this one is lost; None where there is no way.
        what: the board in words, for people and logs.
    """

    def __init__(
        self,
        link: Link,
        calibration: Calibration | None = None,
        now: Callable[[], float] = time.perf_counter,
        reopen: Callable[[], Link] | None = None,
        what: str = "",
    ) -> None:
        self.calibration = load_calibration() if calibration is None else calibration
        self.link, self.now, self.what = link, now, what
        self.simulation: Any = (
            None  # the simulated board, or None for hardware; closed with the port
        )
        self.clock, self.counters = DeviceClock(), Counters()
        self.status: Status | None = None
        self.pilot: PilotFrame | None = None
        self.pilots: deque[PilotFrame] = deque(
            maxlen=1000
        )  # those not yet taken; empty it as you like
        self.events: deque[Event] = deque(maxlen=1000)  # the same
        self.state, self.engagement = "waiting", "off"
        self._reopen, self._deframer, self._bad_before = reopen, Deframer(), 0
        self._next: int | None = None  # sequence of the next COMMAND
        self._asked_from = 0  # sequence of the first engage=0 of this asking
        self._engaging_since = 0.0
        self._status_at, self._began, self._wait, self._try_at = math.nan, now(), BACK_OFF[0], 0.0
        self._syncs: dict[int, float] = {}  # tokens on their way and when they were sent
        self._sync_at, self._syncs_sent = 0.0, 0

    def __enter__(self) -> "TrainerPort":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait_ready(
        self,
        timeout: float = 6.0,
        sleep: Callable[[float], Any] = time.sleep,
        calibrated: bool = True,
    ) -> Status:
        """Wait on the ground until the board answers, its clock is known and it has given up a host
        that is gone.

        Args:
            timeout: at most so long [s]; a Mega that was restarted by the opening needs two.
            sleep: lets time pass [s]; for a simulated board it runs the board.
            calibrated: False does without the check that calibration and board fit, in order to
                calibrate.

        Returns:
            The newest STATUS.

        Raises:
            InputError: no STATUS came, or calibration and board do not fit (see
                `require_matching_calibration`).
        """
        end = self.now() + timeout
        while self.now() < end:
            sleep(0.005)
            self.poll()
            if (
                self.status is not None
                and self.clock.is_synchronised
                and self.status.state != "ACTIVE"
            ):
                break
        if self.status is None:
            raise InputError(
                f"{self.what or 'trainer port'}: expected a STATUS from the board, got none in {timeout:g} s; "
                "is the kit's firmware on it (falconwing firmware build), and is it this port (falconwing find-port)?"
            )
        if calibrated:
            require_matching_calibration(self.calibration, self.status)
        return self.status

    def poll(self) -> None:
        """Read what the board sent, keep the clocks together, notice silence and open a lost port
        again.

        The SYNC frames that it sends do not renew the board's countdown.
        """
        if self.state == "lost":
            self._reopen_link()
        try:
            for t, data in self._read():
                for message in self._deframer.feed(data):
                    self._dispatch(message, t)
            now = self.now()
            self.counters.bad = self._bad_before + self._deframer.bad
            if self.state == "open" and now - self._status_at > SILENT_AFTER:
                self._set_state("silent", "no STATUS from the board")
            if self.state == "open" and now >= self._sync_at:
                self._send_sync(now)
        except OSError as error:
            self._handle_loss(error)

    def send(self, command: Command, engage: bool) -> bool:
        """Send one command; call it at the loop's rate, for nothing is repeated by itself.

        While the board does not follow yet, engage=True first sends engage=0 until the board has
        seen one in SAFE, and then the edge that it waits for.

        Args:
            command: sticks; what is not finite, or no command at all, hands the sticks back.
            engage: True where the aircraft shall follow.

        Returns:
            True if it was written.
        """
        if not engage:
            self.engagement = "off"
        elif self.engagement == "off" and self._next is not None:
            self.engagement, self._asked_from = "asking", self._next
        try:
            channels = self.calibration.channels_us(command)
        except (ValueError, OverflowError, TypeError, AttributeError) as error:
            self._drop_engagement("bad command", {"error": str(error)})
            channels = self.calibration.channels_us(SAFE)
        return self._send_command(channels, self.engagement in ("engaging", "engaged"))

    def hand_back(self) -> None:
        """Give the sticks back to the pilot at once: a burst of frames with engage=0, of which one
        suffices.
        """
        if self.engagement in ("asking", "engaging", "engaged"):
            self._drop_engagement("handed back", {})
        for _ in range(HAND_BACK_FRAMES):
            self._send_command(self.calibration.channels_us(SAFE), False)

    def close(self) -> None:
        """Hand back and close the link, and the simulation where it is one."""
        self.hand_back()
        self._close_link()
        if self.simulation is not None:
            self.simulation.close()

    def to_host_time(self, device_us: int) -> float:
        """A device time [us, 32 bits] on the host's clock [s].

        Before the first round trip it is told by the newest STATUS, late by the time that one was
        on its way; nan before that.
        """
        if self.clock.is_synchronised or self.status is None:
            return self.clock.to_host(device_us)
        return (
            self._status_at
            + _wrapped_difference(device_us, self.status.device_time_us, 2**32) * 1e-6
        )

    @property
    def status_age(self) -> float:
        """Since the newest STATUS [s]; nan before the first."""
        return self.now() - self._status_at

    # Reading.

    def _read(self) -> list[tuple[float, bytes]]:
        """Bytes with the time they came."""
        if self.state == "lost":
            return []
        stamped = getattr(self.link, "read_stamped", None)
        return stamped() if stamped is not None else [(self.now(), self.link.read())]

    def _dispatch(self, message: object, t: float) -> None:
        if isinstance(message, Status):
            self._handle_status(message, t)
        elif isinstance(message, PilotFrame):
            self.pilot = message
            self.pilots.append(message)
        elif (
            isinstance(message, SyncReply)
            and (sent := self._syncs.pop(message.token, None)) is not None
        ):
            self._syncs.clear()  # answers come in order: older ones are lost
            self.clock.add(sent, message.received_us, message.sent_us, t)

    def _handle_status(self, status: Status, t: float) -> None:
        old, self.status, self._status_at = self.status, status, t
        reset = old is not None and (
            status.boot_count != old.boot_count
            or _wrapped_difference(status.device_time_us, old.device_time_us, 2**32) < 0
        )
        if reset:
            self.counters.resets += 1
            self.clock.restart()
            self._syncs.clear()
            self._event(
                "board reset", {"boot_count": status.boot_count, "reset_cause": status.reset_cause}
            )
        if self.state != "open":
            self._set_state("open", f"the board answers: {status.state}")
            if (
                self._next is None
                or _wrapped_difference(self._next, status.last_sequence, 2**16) <= 0
            ):
                self._next = (status.last_sequence + 1) % 2**16
        self._count_accepted(status, None if old is None else old.accepted, reset)
        if old is None or (status.state, status.fault) != (old.state, old.fault):
            self._event("board", {"state": status.state, "fault": status.fault})
        self._update_engagement(status, t)

    def _count_accepted(self, status: Status, accepted_before: int | None, reset: bool) -> None:
        """Frames accepted, from the board's own counter; those missing below its last sequence were
        dropped.
        """
        counters = self.counters
        if accepted_before is not None:
            counters.accepted += (
                status.accepted if reset else (status.accepted - accepted_before) % 2**32
            )
        if counters.sent and status.accepted and self._next is not None:
            on_the_way = max(_wrapped_difference(self._next, status.last_sequence, 2**16) - 1, 0)
            counters.dropped = max(counters.sent - on_the_way - counters.accepted, counters.dropped)

    def _update_engagement(self, status: Status, t: float) -> None:
        """From the board's state to ours: the edge may go out, the board follows, or it does no
        longer.
        """
        seen = {"state": status.state, "fault": status.fault}
        if self.engagement == "asking":
            heard = (
                status.accepted
                and _wrapped_difference(status.last_sequence, self._asked_from, 2**16) >= 0
            )
            if heard and status.state == "SAFE":
                self.engagement, self._engaging_since = "engaging", t
        elif self.engagement == "engaging" and status.state == "ACTIVE":
            self.engagement = "engaged"
            self._event("engaged", seen)
        elif self.engagement == "engaging" and status.state == "SAFE":
            if t - self._engaging_since > ENGAGE_WITHIN and self._next is not None:
                self.engagement, self._asked_from = "asking", self._next
        elif self.engagement in ("engaging", "engaged") and status.state != "ACTIVE":
            self._drop_engagement("dropped", seen)

    def _drop_engagement(self, name: str, details: dict[str, Any]) -> None:
        self.engagement = "dropped"
        self._event(name, details)

    # Writing.

    def _send_command(self, channels_us: tuple[int, ...], engage: bool) -> bool:
        if self.state != "open" or self._next is None:
            self.counters.unsent += 1
            return False
        try:
            self.link.write(encode_channels(self._next, channels_us, engage))
        except OSError as error:
            self.counters.unsent += 1
            self._handle_loss(error)
            return False
        self._next = (self._next + 1) % 2**16
        self.counters.sent += 1
        return True

    def _send_sync(self, now: float) -> None:
        token = round(now * 1e6) % 2**32
        self._syncs = {**dict(list(self._syncs.items())[-8:]), token: now}
        self._syncs_sent += 1
        self._sync_at = now + SYNC_PERIOD * (0.1 if self._syncs_sent < FIRST_SYNCS else 1.0)
        self.link.write(encode_sync(token))

    # A port that comes and goes.

    def _set_state(self, state: str, why: str) -> None:
        self.state = state
        self._event(f"port {state}", {"why": why})

    def _handle_loss(self, error: OSError) -> None:
        self._close_link()
        self._set_state("lost", str(error))
        self._try_at, self._wait = self.now() + BACK_OFF[0], BACK_OFF[0]

    def _reopen_link(self) -> None:
        now = self.now()
        if self._reopen is None or now < self._try_at:
            return
        self._wait = min(2.0 * self._wait, BACK_OFF[1])
        self._try_at = now + self._wait
        with suppress(OSError, InputError):
            self.link = self._reopen()
            self._bad_before += self._deframer.bad
            self._deframer = Deframer()
            self._syncs.clear()
            self.counters.reconnects += 1
            self._set_state("waiting", "opened again")

    def _close_link(self) -> None:
        with suppress(OSError):
            getattr(self.link, "close", lambda: None)()

    def _event(self, name: str, details: dict[str, Any]) -> None:
        self.events.append(Event(self.now(), name, details))


def require_matching_calibration(calibration: Calibration, status: Status) -> None:
    """Refuse a calibration that the board's firmware was not set for.

    What the board sends by itself, for one after a loss, is set when it is flashed. With the sticks
    in another order its idle throttle would be half of it.

    Args:
        calibration: of the radio.
        status: of the board, any but ACTIVE for the check of its safe slots.

    Raises:
        InputError: the numbers of channels differ, or the board's safe slots would leave the motor
            on.
    """
    wanted, got = len(status.channels_us), calibration.channels
    if wanted != got:
        raise InputError(
            f"calibration: expected {wanted} channels as the board's firmware has, got {got}; "
            "calibrate again, or set CHANNELS in firmware/trainer_bridge/config.h and flash the board"
        )
    throttle = calibration.command(status.channels_us).throttle
    if status.state != "ACTIVE" and throttle > IDLE:
        raise InputError(
            f"calibration: expected the board's safe slots {status.channels_us} us to stop the motor, got throttle "
            f"{throttle:.0%}, for the radio has it in channel {calibration.throttle.channel} and idles at "
            f"{_idle_us(calibration)} us; change the radio's order of channels or travel, or set THROTTLE_CHANNEL and "
            "SAFE_SLOTS_US in firmware/trainer_bridge/config.h and flash the board"
        )


def _idle_us(calibration: Calibration) -> int:
    """The throttle's slot of a stopped motor [us]."""
    return calibration.channels_us(SAFE)[calibration.throttle.channel - 1]


def _wrapped_difference(later: int, earlier: int, wrap: int) -> int:
    """How far a wrapped count is ahead of another, between -wrap/2 and wrap/2."""
    return (later - earlier + wrap // 2) % wrap - wrap // 2
