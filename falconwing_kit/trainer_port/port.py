"""Trainer port: commands -> serial frames to the board; its status, pilot frames and clock back.

There is no heartbeat: only `send` produces a COMMAND, so the board detects a stopped control loop
within 200 ms. Nothing is sent before the board's first STATUS, because a Mega's boot loader listens
for two seconds after a reset. Nothing raises in flight: a lost port is a state and an event, and
`poll` reopens it.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import COMMAND_NAMES, SAFE_COMMAND, Command, Event
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
from falconwing_kit.trainer_port.safety import SafetyConfig

SILENT_AFTER = 0.5  # s without a STATUS, which is sent at 20 Hz
NO_PULSES_US = 75_000  # board's time without a PPM frame, of which 45 are sent a second
ENGAGE_WITHIN = 1.0  # s from the edge to ACTIVE; then the edge is repeated
SYNC_PERIOD, FIRST_SYNCS = 0.5, 8  # s between round trips; the first eight are ten times as fast
BACK_OFF = (0.25, 4.0)  # s between attempts to reopen a lost port: first and, by doubling, last
IDLE = 0.02  # maximum throttle at which the motor is off
PENDING_SYNCS = 9  # newest round trips without a reply that are still waited for
HAND_BACK_FRAMES = 3  # in a burst: one is enough, two may be corrupted


class Link(Protocol):
    """A line to the board: a serial port, or a simulated board."""

    def write(self, data: bytes) -> Any:
        """Send bytes; OSError if the link is lost."""

    def read(self) -> bytes:
        """The bytes received since the last call, without waiting; OSError if the link is lost."""


@dataclass
class Counters:
    """Counts since the port was created; the board's own counters are in its STATUS."""

    sent: int = 0  # COMMAND frames written
    unsent: int = 0  # commands that could not be written: no port, or no STATUS yet
    accepted: int = 0  # of those sent, by the board's count
    dropped: int = 0  # of those sent: not accepted, although a later one was
    bad: int = 0  # corrupted frames from the board
    resets: int = 0  # of the board, detected by its boot count or its clock
    reconnects: int = 0  # of a lost port


class TrainerPort:
    """The board at the other end of a link.

    `state` is "waiting" (no STATUS yet), "open", "silent" (STATUS stopped; nothing is sent until it
    returns) or "lost". `engagement` is "off", "asking" (sending engage=0 until the board is SAFE
    and has received it), "engaging" (sending engage=1 until the board is ACTIVE), "engaged" or
    "dropped". After the board leaves ACTIVE for any reason, or after a hand-back, it stays dropped
    until one call of `send` with engage=False: control is never retaken by accident. A board that
    answers but no longer sends pulses to the radio is a fault too.

    Args:
        link: the line; if it has a method `read_stamped`, that gives the times of arrival.
        calibration: control inputs to microseconds; None for the shipped one.
        now: the host's clock [s]; for a simulated board its virtual time.
        reopen: creates a new link when this one is lost; None if impossible.
        what: description of the board for users and logs.
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
        self.simulation: Any = None  # simulated board, closed with the port; None for hardware
        self.clock, self.counters = DeviceClock(), Counters()
        self.status: Status | None = None
        self.pilot: PilotFrame | None = None
        # Pilot frames and events not yet consumed; the caller empties these queues.
        self.pilots: deque[PilotFrame] = deque(maxlen=1000)
        self.events: deque[Event] = deque(maxlen=1000)
        self.state, self.engagement = "waiting", "off"
        self._channels_us: tuple[int, ...] = ()  # of the newest command
        self._pulses_us = 0  # board's time of the first STATUS with the newest PPM frame
        self._reopen, self._deframer, self._bad_before = reopen, Deframer(), 0
        self._next_sequence: int | None = None  # sequence of the next COMMAND
        self._request_sequence = 0  # sequence of the first engage=0 of this request
        self._engaging_since = 0.0
        self._status_at, self._reopen_at, self._reopen_wait = math.nan, 0.0, BACK_OFF[0]
        self._syncs: dict[int, float] = {}  # tokens without a reply -> time of sending
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
        """Wait on the ground for a STATUS other than ACTIVE and a synchronised clock.

        Args:
            timeout: [s]; a Mega that restarts on opening needs two.
            sleep: waits [s]; for a simulated board it advances the simulation.
            calibrated: False omits the check that calibration and board match, for calibrating.

        Returns:
            The newest STATUS.

        Raises:
            InputError: no STATUS arrived, or calibration and board do not match (see
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
                f"{self.what or 'trainer port'}: expected a STATUS from the board, got none in "
                f"{timeout:g} s; is the kit's firmware on it (falconwing firmware build), "
                "and is it this port (falconwing find-port)?"
            )
        if calibrated:
            require_matching_calibration(self.calibration, self.status)
        return self.status

    def poll(self) -> None:
        """Read from the board, synchronise the clocks, detect silence and reopen a lost port.

        The SYNC frames sent here do not restart the board's timeout.
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
        """Send one command; call it at the loop's rate, because nothing is repeated automatically.

        Before the board is ACTIVE, engage=True first sends engage=0 until the board has received
        one in SAFE, and then the rising edge that it requires. The board engages only on commands
        near the pilot's sticks, or idle and neutral without a pilot's signal (`mismatch`).

        Args:
            command: control inputs; a value that is not finite, or no command, hands back.
            engage: True if the aircraft shall follow.

        Returns:
            True if it was written.
        """
        if not engage:
            self.engagement = "off"
        elif self.engagement == "off" and self._next_sequence is not None:
            self.engagement, self._request_sequence = "asking", self._next_sequence
        try:
            channels = self.calibration.channels_us(command)
        except (ValueError, OverflowError, TypeError, AttributeError) as error:
            self._drop_engagement("bad command", {"error": str(error)})
            channels = self.calibration.channels_us(SAFE_COMMAND)
        self._channels_us = channels
        return self._send_command(channels, self.engagement in ("engaging", "engaged"))

    def hand_back(self) -> None:
        """Return control to the pilot: a burst of frames with engage=0, of which one suffices."""
        if self.engagement in ("asking", "engaging", "engaged"):
            self._drop_engagement("handed back", {})
        for _ in range(HAND_BACK_FRAMES):
            self._send_command(self.calibration.channels_us(SAFE_COMMAND), False)

    def close(self) -> None:
        """Hand back and close the link, and the simulation if there is one."""
        self.hand_back()
        self._close_link()
        if self.simulation is not None:
            self.simulation.close()

    def to_host_time(self, device_us: int) -> float:
        """A device time [us, 32 bits] on the host's clock [s].

        Before the first round trip it is derived from the newest STATUS, late by its latency; nan
        before that.
        """
        if self.clock.is_synchronised or self.status is None:
            return self.clock.to_host(device_us)
        since_status_us = _wrapped_difference(device_us, self.status.device_time_us, 2**32)
        return self._status_at + since_status_us * 1e-6

    @property
    def status_age(self) -> float:
        """Age of the newest STATUS [s]; nan before the first."""
        return self.now() - self._status_at

    def mismatch(self) -> str:
        """Why the board does not engage on the newest command; empty if it matches.

        The rule is that of `safety.py` with the shipped limits: near the pilot's sticks, or without
        a pilot's signal idle and neutral.
        """
        status, limits, pilot = self.status, SafetyConfig(), self.pilot
        if status is None or not self._channels_us:
            return ""
        has_pilot = status.has_pilot and pilot is not None
        if status.engages_without_pilot and not has_pilot:
            return ""
        # In SAFE the board's channels are idle and neutral.
        sticks = pilot.channels_us if has_pilot and pilot else status.channels_us
        if len(sticks) < len(self._channels_us):
            return (
                f"the pilot's radio has {len(sticks)} channels, {len(self._channels_us)} are sent"
            )
        reference = "the pilot's stick" if has_pilot else "without a pilot's signal"
        problems = []
        for name, stick in zip(COMMAND_NAMES, self.calibration.sticks, strict=True):
            ours, theirs = (channels[stick.channel - 1] for channels in (self._channels_us, sticks))
            is_idle = stick is self.calibration.throttle and not has_pilot
            limit = limits.engage_idle_us if is_idle else limits.engage_near_us
            if abs(ours - theirs) > limit:
                problems.append(f"{name} {ours} us, {reference} {theirs} +- {limit} us")
        return "; ".join(problems)

    # Reading.

    def _read(self) -> list[tuple[float, bytes]]:
        """Chunks of bytes with their times of arrival."""
        if self.state == "lost":
            return []
        read_stamped = getattr(self.link, "read_stamped", None)
        return [(self.now(), self.link.read())] if read_stamped is None else read_stamped()

    def _dispatch(self, message: object, t: float) -> None:
        """Take in one message of the board that arrived at t [s]."""
        if isinstance(message, Status):
            self._handle_status(message, t)
        elif isinstance(message, PilotFrame):
            self.pilot = message
            self.pilots.append(message)
        elif isinstance(message, SyncReply) and message.token in self._syncs:
            sent = self._syncs[message.token]
            self._syncs.clear()  # replies arrive in order: those to older requests are lost
            self.clock.add(sent, message.received_us, message.sent_us, t)

    def _handle_status(self, status: Status, t: float) -> None:
        """A new STATUS: detect a reset of the board; update state, counts and engagement."""
        old, self.status, self._status_at = self.status, status, t
        reset = old is not None and (
            status.boot_count != old.boot_count
            or _wrapped_difference(status.device_time_us, old.device_time_us, 2**32) < 0
        )
        if reset:  # the board's counters and clock have started again
            self.counters.resets += 1
            self.clock.restart()
            self._syncs.clear()
            self._event(
                "board reset", {"boot_count": status.boot_count, "reset_cause": status.reset_cause}
            )
        if self.state != "open":
            self._set_state("open", f"the board answers: {status.state}")
            # Continue after the board's last sequence, unless ours is already ahead of it.
            last, upcoming = status.last_sequence, self._next_sequence
            if upcoming is None or _wrapped_difference(upcoming, last, 2**16) <= 0:
                self._next_sequence = (last + 1) % 2**16
        self._count_accepted(status, None if old is None else old.accepted, reset)
        if old is None or reset or status.ppm_frames != old.ppm_frames:
            self._pulses_us = status.device_time_us
        if old is None or (status.state, status.fault) != (old.state, old.fault):
            self._event("board", {"state": status.state, "fault": status.fault})
        self._update_engagement(status, t)

    def _count_accepted(self, status: Status, accepted_before: int | None, reset: bool) -> None:
        """Accepted frames by the board's counter; others up to its last sequence were dropped."""
        counters = self.counters
        if accepted_before is not None:
            counters.accepted += (
                status.accepted if reset else (status.accepted - accepted_before) % 2**32
            )
        if counters.sent and status.accepted and self._next_sequence is not None:
            ahead = _wrapped_difference(self._next_sequence, status.last_sequence, 2**16)
            in_transit = max(ahead - 1, 0)
            counters.dropped = max(counters.sent - in_transit - counters.accepted, counters.dropped)

    def _update_engagement(self, status: Status, t: float) -> None:
        """Transitions of the engagement on the board's state."""
        details = {"state": status.state, "fault": status.fault}
        if self.engagement == "asking":
            received = (
                status.accepted
                and _wrapped_difference(status.last_sequence, self._request_sequence, 2**16) >= 0
            )
            if received and status.state == "SAFE":
                self.engagement, self._engaging_since = "engaging", t
                self._pulses_us = status.device_time_us  # they may have been off until now
        elif self.engagement in ("engaging", "engaged") and status.pilot_took_over:
            self._drop_engagement("pilot took over", details)
        elif self.engagement == "engaging" and status.state == "ACTIVE":
            self.engagement = "engaged"
            self._event("engaged", details)
        elif self.engagement == "engaging" and status.state == "SAFE":
            if t - self._engaging_since > ENGAGE_WITHIN and self._next_sequence is not None:
                self.engagement, self._request_sequence = "asking", self._next_sequence
                self._event("not engaged", details | {"reason": self.mismatch()})
        elif self.engagement in ("engaging", "engaged") and status.state != "ACTIVE":
            self._drop_engagement("dropped", details)
        without_us = _wrapped_difference(status.device_time_us, self._pulses_us, 2**32)
        if self.engagement in ("engaging", "engaged") and without_us > NO_PULSES_US:
            self._drop_engagement("no pulses", {"ppm_frames": status.ppm_frames})

    def _drop_engagement(self, name: str, details: dict[str, Any]) -> None:
        """Stop commanding until `send` was called with engage=False; an event gives the reason."""
        self.engagement = "dropped"
        self._event(name, details)

    # Writing.

    def _send_command(self, channels_us: tuple[int, ...], engage: bool) -> bool:
        """Write one COMMAND under the next sequence number; False if it could not be written."""
        if self.state != "open" or self._next_sequence is None:
            self.counters.unsent += 1
            return False
        try:
            self.link.write(encode_channels(self._next_sequence, channels_us, engage))
        except OSError as error:
            self.counters.unsent += 1
            self._handle_loss(error)
            return False
        self._next_sequence = (self._next_sequence + 1) % 2**16
        self.counters.sent += 1
        return True

    def _send_sync(self, now: float) -> None:
        """Start a round trip of the clocks; its token is the host's time, low 32 bits of us."""
        token = round(now * 1e6) % 2**32
        pending = list(self._syncs.items())[-(PENDING_SYNCS - 1) :]
        self._syncs = {**dict(pending), token: now}
        self._syncs_sent += 1
        self._sync_at = now + SYNC_PERIOD * (0.1 if self._syncs_sent < FIRST_SYNCS else 1.0)
        self.link.write(encode_sync(token))

    # Loss and reopening.

    def _set_state(self, state: str, why: str) -> None:
        """Change the port's state, with an event that gives the reason."""
        self.state = state
        self._event(f"port {state}", {"why": why})

    def _handle_loss(self, error: OSError) -> None:
        """Close a port that failed; the first attempt to reopen it follows after BACK_OFF[0]."""
        self._close_link()
        self._set_state("lost", str(error))
        self._reopen_at, self._reopen_wait = self.now() + BACK_OFF[0], BACK_OFF[0]

    def _reopen_link(self) -> None:
        """Try to reopen a lost port when its waiting time is over, which doubles each time."""
        now = self.now()
        if self._reopen is None or now < self._reopen_at:
            return
        self._reopen_wait = min(2.0 * self._reopen_wait, BACK_OFF[1])
        self._reopen_at = now + self._reopen_wait
        with suppress(OSError, InputError):
            self.link = self._reopen()
            self._bad_before += self._deframer.bad
            self._deframer = Deframer()
            self._syncs.clear()
            self.counters.reconnects += 1
            self._set_state("waiting", "opened again")

    def _close_link(self) -> None:
        """Close the link, if it can be closed; errors of a lost one are ignored."""
        with suppress(OSError):
            getattr(self.link, "close", lambda: None)()

    def _event(self, name: str, details: dict[str, Any]) -> None:
        """Queue an event for the caller, stamped with the host's time."""
        self.events.append(Event(self.now(), name, details))


def require_matching_calibration(calibration: Calibration, status: Status) -> None:
    """Refuse a calibration that does not match the board's firmware.

    The failsafe outputs are compiled into the firmware. With another channel order its idle
    throttle could be half throttle.

    Args:
        calibration: of the radio.
        status: of the board; in any state but ACTIVE its safe channels are checked.

    Raises:
        InputError: the numbers of channels differ, or the board's safe channels leave the motor on.
    """
    expected, got = len(status.channels_us), calibration.channels
    if expected != got:
        raise InputError(
            f"calibration: expected {expected} channels as the board's firmware has, got {got}; "
            "calibrate again, or set CHANNELS in firmware/trainer_bridge/config.h and flash the "
            "board"
        )
    throttle = calibration.command(status.channels_us).throttle
    if status.state != "ACTIVE" and throttle > IDLE:
        channel = calibration.throttle.channel
        idle_us = calibration.channels_us(SAFE_COMMAND)[channel - 1]
        raise InputError(
            f"calibration: expected the board's safe slots {status.channels_us} us to stop the "
            f"motor, got throttle {throttle:.0%}, for the radio has it in channel {channel} and "
            f"idles at {idle_us} us; change the radio's order of channels or travel, or set "
            "THROTTLE_CHANNEL and SAFE_SLOTS_US in firmware/trainer_bridge/config.h and flash the "
            "board"
        )


def _wrapped_difference(later: int, earlier: int, wrap: int) -> int:
    """Difference of two counts modulo wrap, between -wrap/2 and wrap/2."""
    return (later - earlier + wrap // 2) % wrap - wrap // 2
