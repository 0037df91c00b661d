"""Safety state machine: commands, the pilot's sticks and ticks -> channels of the next PPM frame.

                          first tick
                   BOOT -------------> SAFE <------------ engage = 0 ------------+
                                       |  ^                                      |
         5 consecutive engage frames   |  | engage = 0: hand-back, or            |
         in 500 ms, no gap of 200 ms,  |  | the pilot moved a stick by 12 %      |
         all of them matching          v  |                                      |
                                       ACTIVE -- 200 ms without valid frame --> LOST

    any state -- 5 commands out of range within 1 s --> FAULT (range)
    any state -- watchdog reset --> FAULT (stall)
    any state -- a disturbed memory --> FAULT (memory), on the board only
    FAULT -- engage = 0, fault hold-off over --> SAFE

An engage frame is a valid COMMAND with engage = 1. The first of the five is the rising edge of
engage, from 0 to 1. The fault hold-off lasts 1 s from boot and from every violation.

An engage frame matches if taking over moves nothing. Where the pilot's signal is fresh (a frame of
the pilot's radio in the last 100 ms), every channel is within 100 us of the pilot's. Without such a
signal the throttle is within 20 us of idle and the others within 100 us of neutral, unless the
firmware was compiled with ENGAGE_WITHOUT_PILOT, which STATUS shows. An engage frame that does not
match ends the count: a new rising edge is required.

The pilot moved a stick if a channel is more than 120 us, 12 % of its travel of 1000 us, from where
it was at the engagement, or in the first frame measured after it: no computer flies against the
pilot. A signal that stops does not end ACTIVE, because the radio's trainer switch still does.

Only ACTIVE passes the host's channels on; every other state outputs throttle idle and the other
channels neutral. This is the reference model: the firmware holds the same machine in C++
(firmware/trainer_bridge/safety.cpp), written independently from the same rules, and tests compare
the two. Details that the rules leave open:

- The range is checked before the sequence: a command out of range is always a violation.
- The 5 consecutive engage frames, the rising edge included, count in SAFE only; commands in BOOT
  are accepted without effect. A rejected command between them neither counts nor restarts them.
- A limit is reached when its time has passed in full: 200 ms after a frame is a loss, 199.999 ms is
  not.
- Times are the board's microseconds in 32 bits and wrap after 71 minutes. Timers are cleared when
  they expire, so that a wrapped clock cannot restart them.
- Silent means PPM output off. It begins `silent_after_ms` after the last valid frame, in SAFE and
  LOST only, and lasts until the next valid frame, in FAULT too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from falconwing_kit.core.checks import InputError

SECOND_US = 1_000_000
CLOCK = 2**32  # the board's microseconds wrap here
SEQUENCES = 2**16  # sequence numbers wrap here
MAX_ADVANCE = 2**15 - 1  # a sequence further ahead than half of the numbers is an old one


class SafetyDecision(IntEnum):
    """Verdict on a command; the numbers are those of the firmware's host library."""

    ACCEPTED = 0
    SEQUENCE = 1  # its sequence did not advance
    RANGE = 2  # a channel was outside 900..2100 us
    FORM = 3  # wrong number of channels for the board


@dataclass(frozen=True)
class SafetyConfig:
    """The settings of firmware/trainer_bridge/config.h under the same names, in lower case."""

    channels: int = 4
    channel_min_us: int = 1000
    channel_max_us: int = 2000
    valid_min_us: int = 900
    valid_max_us: int = 2100
    safe_us: tuple[int, ...] = (1000, 1500, 1500, 1500, 1500, 1500, 1500, 1500)
    throttle_channel: int = 0  # counted from 0
    throttle_ceiling_us: int = 2000
    slew_us: int = 250  # maximum change of a channel from one frame to the next
    host_timeout_ms: int = 200
    engage_frames: int = 5
    engage_window_ms: int = 500
    engage_near_us: int = 100  # of a command that engages to the pilot's channels, or to neutral
    engage_idle_us: int = 20  # of its throttle to idle where no pilot's signal is fresh
    engage_without_pilot: int = 0  # 1: without a pilot's signal any command engages
    pilot_moved_us: int = 120  # of a pilot's channel since the engagement: SAFE
    pilot_fresh_ms: int = 100  # age of a pilot's frame that is still a measurement
    silent_after_ms: int = 0  # after the last valid frame: PPM output off; 0: never
    range_fault_frames: int = 5

    def __post_init__(self) -> None:
        if (
            not 4 <= self.channels <= len(self.safe_us)
            or not 0 <= self.throttle_channel < self.channels
        ):
            raise InputError(
                f"board: expected 4 to {len(self.safe_us)} channels, the throttle's among them "
                f"counted from 0, got {self.channels} and {self.throttle_channel}"
            )


def elapsed_us(now_us: int, since_us: int) -> int:
    """Time between two readings of the board's clock [us], across at most one wrap."""
    return (now_us - since_us) % CLOCK


class Safety:
    """The state machine: `frame` for each COMMAND with a valid CRC, `tick` once per PPM frame."""

    def __init__(
        self, config: SafetyConfig | None = None, now_us: int = 0, *, watchdog_reset: bool = False
    ) -> None:
        """Boot.

        Args:
            config: the board's settings; None for the shipped ones.
            now_us: the board's clock at boot [us], 0..2^32 - 1, as every time below.
            watchdog_reset: True if the watchdog reset the board because its program hung.
        """
        self.config = config or SafetyConfig()
        self.state = "FAULT" if watchdog_reset else "BOOT"
        self.fault = "stall" if watchdog_reset else "none"
        self.last_sequence: int | None = None  # of the last valid frame
        self.silent = False  # True: PPM output off
        self.slots_us = self.config.safe_us[: self.config.channels]  # of the last PPM frame
        self._target_us = self.slots_us
        self.has_pilot = False  # True: the pilot's signal is fresh
        # True: a stick of the pilot ended the engagement, and engage = 0 has not come since.
        self.pilot_took_over = False
        self._pilot_us: tuple[int, ...] = ()  # newest frame of the pilot, at its time
        self._pilot_at_us = 0
        # The pilot's channels that movement is judged by; None until there are any.
        self._reference_us: tuple[int, ...] | None = None
        self._engage: bool | None = None  # flag of the last valid frame
        self._valid_us: int | None = None  # time of the last valid frame
        self._edge_us: int | None = None  # time of the rising edge, while it counts
        self._engaged_frames = 0  # since the rising edge, itself included
        self._violations, self._first_violation_us = 0, 0  # within one second
        # Fault hold-off: less than a second since boot or the last violation.
        self._is_holding_off, self._hold_off_us = True, now_us

    def frame(
        self, now_us: int, sequence: int, engage: bool, channels_us: Sequence[int]
    ) -> SafetyDecision:
        """Process a command; only ACCEPTED advances the sequence and restarts the timeout.

        Args:
            now_us: the board's clock [us].
            sequence: 0..65535, must be 1..32767 ahead of the last one, modulo 65536.
            engage: True if the host requests control.
            channels_us: (channels,) [us], in the order of the PPM frame.
        """
        self._expire_timers(now_us)
        if len(channels_us) != self.config.channels:
            return SafetyDecision.FORM
        if not all(
            self.config.valid_min_us <= us <= self.config.valid_max_us for us in channels_us
        ):
            self._count_violation(now_us)
            return SafetyDecision.RANGE
        if (
            self.last_sequence is not None
            and not 1 <= (sequence - self.last_sequence) % SEQUENCES <= MAX_ADVANCE
        ):
            return SafetyDecision.SEQUENCE
        is_edge = engage and self._engage is not None and not self._engage
        self.last_sequence, self._engage, self._valid_us = sequence, engage, now_us
        self._target_us = tuple(channels_us)
        self.silent = False
        if engage:
            self._process_engage(now_us, is_edge)
        else:
            self._process_hand_back()
        return SafetyDecision.ACCEPTED

    def tick(self, now_us: int, pilot_us: Sequence[int] | None = None) -> tuple[int, ...] | None:
        """Begin a PPM frame.

        Args:
            now_us: the board's clock [us].
            pilot_us: (channels or more,) [us], the pilot's frame measured since the last tick; None
                for none. One with fewer channels counts as none.

        Returns:
            The frame's channels (channels,) [us], or None for no pulses.
        """
        self._expire_timers(now_us)
        if self.state == "BOOT":
            self.state = "SAFE"
        if pilot_us is not None and len(pilot_us) >= self.config.channels:
            self._judge_pilot(now_us, tuple(pilot_us[: self.config.channels]))
        elif self.has_pilot:
            age_us = elapsed_us(now_us, self._pilot_at_us)
            self.has_pilot = age_us < self.config.pilot_fresh_ms * 1000
        if self.state == "ACTIVE" and self._is_timed_out(now_us, self.config.host_timeout_ms):
            self.state = "LOST"
        if self.config.silent_after_ms and self.state in ("SAFE", "LOST"):
            self.silent = self.silent or self._is_timed_out(now_us, self.config.silent_after_ms)
        self.slots_us = (
            self._limit_slots()
            if self.state == "ACTIVE"
            else self.config.safe_us[: self.config.channels]
        )
        return None if self.silent else self.slots_us

    def _process_engage(self, now_us: int, is_edge: bool) -> None:
        """An engage frame: in SAFE 5 consecutive ones, the rising edge included, lead to ACTIVE."""
        if self.state != "SAFE":
            return
        if is_edge:
            self._edge_us, self._engaged_frames = now_us, 0
        if self._edge_us is not None:
            self._engaged_frames += 1
            if not self._matches():
                self._edge_us = None
            elif self._engaged_frames >= self.config.engage_frames:
                self.state, self._edge_us = "ACTIVE", None
                self._reference_us = self._pilot_us if self.has_pilot else None

    def _matches(self) -> bool:
        """Whether the command may engage: near the pilot's sticks, or idle and neutral."""
        c = self.config
        if not self.has_pilot and c.engage_without_pilot:
            return True
        limits = [c.engage_near_us] * c.channels
        if not self.has_pilot:
            limits[c.throttle_channel] = c.engage_idle_us
        sticks = self._pilot_us if self.has_pilot else c.safe_us
        return all(
            abs(ours - theirs) <= limit
            for ours, theirs, limit in zip(self._target_us, sticks, limits, strict=False)
        )

    def _judge_pilot(self, now_us: int, pilot_us: tuple[int, ...]) -> None:
        """A frame of the pilot's radio: in ACTIVE a stick that moved leads to SAFE."""
        self.has_pilot, self._pilot_us, self._pilot_at_us = True, pilot_us, now_us
        if self.state != "ACTIVE":
            return
        if self._reference_us is None:
            self._reference_us = pilot_us
        moved_us = max(abs(a - b) for a, b in zip(pilot_us, self._reference_us, strict=True))
        if moved_us > self.config.pilot_moved_us:
            self.state, self.pilot_took_over = "SAFE", True

    def _process_hand_back(self) -> None:
        """A valid frame with engage = 0 leads to SAFE, from FAULT only after the hold-off."""
        self._edge_us, self.pilot_took_over = None, False
        if self.state in ("ACTIVE", "LOST") or (self.state == "FAULT" and not self._is_holding_off):
            self.state, self.fault = "SAFE", "none"

    def _count_violation(self, now_us: int) -> None:
        """A command out of range: the fifth within a second is a fault."""
        if self._violations == 0:
            self._first_violation_us = now_us
        self._violations += 1
        self._is_holding_off, self._hold_off_us = True, now_us
        if self._violations >= self.config.range_fault_frames:
            self.state, self.fault, self._edge_us = "FAULT", "range", None

    def _expire_timers(self, now_us: int) -> None:
        """Clear the edge, the violations and the fault hold-off when their time is over."""
        if self._edge_us is not None and (
            elapsed_us(now_us, self._edge_us) >= self.config.engage_window_ms * 1000
            or self._is_timed_out(now_us, self.config.host_timeout_ms)
        ):
            self._edge_us = None
        if self._violations and elapsed_us(now_us, self._first_violation_us) >= SECOND_US:
            self._violations = 0
        if self._is_holding_off and elapsed_us(now_us, self._hold_off_us) >= SECOND_US:
            self._is_holding_off = False

    def _is_timed_out(self, now_us: int, limit_ms: int) -> bool:
        """Whether the last valid frame is at least limit_ms old."""
        return self._valid_us is not None and elapsed_us(now_us, self._valid_us) >= limit_ms * 1000

    def _limit_slots(self) -> tuple[int, ...]:
        """The host's channels within the limits of each channel and of the slew rate."""
        c = self.config
        slots = []
        for channel, (sent, target) in enumerate(zip(self.slots_us, self._target_us, strict=True)):
            ceiling = c.throttle_ceiling_us if channel == c.throttle_channel else c.channel_max_us
            clipped = min(max(target, c.channel_min_us), c.channel_max_us, ceiling)
            slots.append(min(max(clipped, sent - c.slew_us), sent + c.slew_us))
        return tuple(slots)
