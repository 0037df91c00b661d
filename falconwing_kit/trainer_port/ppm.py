"""PPM calibration: control inputs <-> microseconds of the channels of a PPM frame.

Channel order, reversal and limits live here. A PPM frame is a train of short gap pulses; the time
from one pulse to the next is a channel, and a long pause (the sync gap) ends it:

    _   _____   _______   ____   _______   _____________________   _____
     |_|  ch1 |_|  ch2  |_| ch3|_|  ch4  |_|       pause         |_|

This is polarity 1: the line is idle high, the pulses are low.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from functools import cache
from pathlib import Path

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.files import shipped_path
from falconwing_kit.core.messages import COMMAND_NAMES, Command
from falconwing_kit.trainer_port.protocol import encode_channels

# Limits of firmware/trainer_bridge/config.h: a command outside VALID_US is refused (VALID_MIN_US,
# VALID_MAX_US), the output is clipped to SENT_US (CHANNEL_MIN_US, CHANNEL_MAX_US).
VALID_US = (900, 2100)
SENT_US = (1000, 2000)
SYNC_GAP_US = (4000, 19000)  # pauses that radios with EdgeTX accept as the end of a frame
UNUSED_CHANNEL_US = 1500


@dataclass(frozen=True)
class Stick:
    """One control: its PPM channel and the pulse widths at its end points and its centre."""

    channel: int  # in the PPM frame, counted from 1
    low_us: int  # [us] at the end point with the shorter pulse
    centre_us: int  # [us] in the middle; of the throttle, at half throttle
    high_us: int  # [us] at the end point with the longer pulse
    reversed: bool = False  # True: full throttle, right or nose up gives the shorter pulse

    def __post_init__(self) -> None:
        low, high = VALID_US
        if not low <= self.low_us < self.centre_us < self.high_us <= high:
            raise InputError(
                f"expected low_us < centre_us < high_us within {low}..{high} us, got "
                f"{self.low_us}, {self.centre_us}, {self.high_us}; "
                "measure again or correct the file"
            )

    def to_us(self, position: float) -> int:
        """Pulse width [us] of a position -1..1, linear from the centre to both end points."""
        deflection = -position if self.reversed else position
        return round(self.centre_us + deflection * self._travel_us(deflection))

    def to_position(self, us: float) -> float:
        """Position of a pulse width, beyond -1..1 outside the end points; inverse of `to_us`."""
        offset = us - self.centre_us
        deflection = offset / self._travel_us(offset)
        return -deflection if self.reversed else deflection

    def _travel_us(self, deflection: float) -> int:
        """Pulse width from the centre to the end point on the side of a deflection [us], > 0."""
        return self.high_us - self.centre_us if deflection >= 0.0 else self.centre_us - self.low_us


@dataclass(frozen=True)
class Calibration:
    """PPM frame of one radio's trainer port. The fields are the keys of the TOML file."""

    radio: str  # measured on this radio; "" for the shipped values
    measured: str  # date of the measurement, such as "2026-03-01"; "" = never
    channels: int  # in a frame, 4..8
    frame_us: int  # [us] from the first edge of a frame to the first edge of the next
    gap_us: int  # [us] width of the gap pulse that starts every channel
    polarity: int  # 1: idle high, pulses low; 0: idle low, pulses high
    throttle: Stick
    aileron: Stick
    elevator: Stick
    rudder: Stick

    def __post_init__(self) -> None:
        _require_date(self.measured)
        require_range("channels", self.channels, low=4, high=8)
        require_range("gap_us", self.gap_us, low=100, high=VALID_US[0] - 100)
        if self.polarity not in (0, 1):
            raise InputError(
                f"polarity: expected 1 (idle high) or 0 (idle low), got {self.polarity}"
            )
        shortest, longest = (self.frame_us - self.channels * us for us in reversed(SENT_US))
        if shortest < SYNC_GAP_US[0] or longest > SYNC_GAP_US[1]:
            raise InputError(
                f"frame_us: expected a pause of {SYNC_GAP_US[0]}..{SYNC_GAP_US[1]} us behind "
                f"{self.channels} channels, got {shortest}..{longest} us; "
                "change frame_us or channels"
            )
        slots = [stick.channel for stick in self.sticks]
        if len(set(slots)) < len(slots) or not 1 <= min(slots) <= max(slots) <= self.channels:
            raise InputError(
                f"channel: expected four different slots of 1..{self.channels}, got {slots}; "
                "correct the file"
            )

    @property
    def sticks(self) -> tuple[Stick, Stick, Stick, Stick]:
        """The four controls in the order of COMMAND_NAMES."""
        return (self.throttle, self.aileron, self.elevator, self.rudder)

    def channels_us(self, command: Command) -> tuple[int, ...]:
        """Pulse widths (channels,) [us] of a clipped command; UNUSED_CHANNEL_US in free channels.

        Raises:
            InputError: a control input is not finite.
        """
        clipped = Command.clip(*(getattr(command, name) for name in COMMAND_NAMES))
        throttle, *others = clipped.vector.tolist()
        channels_us = [UNUSED_CHANNEL_US] * self.channels
        for stick, position in zip(self.sticks, (2.0 * throttle - 1.0, *others), strict=True):
            channels_us[stick.channel - 1] = stick.to_us(position)
        return tuple(channels_us)

    def command(self, channels_us: Sequence[float]) -> Command:
        """The command of a frame, clipped to its limits; the inverse of `channels_us`.

        Raises:
            InputError: there are too few channels, or one is not finite.
        """
        needed = max(stick.channel for stick in self.sticks)
        if len(channels_us) < needed:
            raise InputError(
                f"channels: expected at least {needed}, got {len(channels_us)}; "
                "does the radio send PPM of four?"
            )
        throttle, aileron, elevator, rudder = (
            stick.to_position(channels_us[stick.channel - 1]) for stick in self.sticks
        )
        return Command.clip(0.5 * (throttle + 1.0), aileron, elevator, rudder)


def encode_command(
    sequence: int,
    throttle: float,
    aileron: float,
    elevator: float,
    rudder: float,
    engage: bool,
    calibration: Calibration | None = None,
) -> bytes:
    """One COMMAND as a serial frame with its zero byte, from control inputs.

    Args:
        sequence: a whole number from 0; its low 16 bits are sent.
        throttle: 0..1, clipped.
        aileron: -1..1, positive right wing down, clipped.
        elevator: -1..1, positive nose up, clipped.
        rudder: -1..1, positive nose right, clipped.
        engage: True to request control, False to hand back.
        calibration: control inputs to microseconds; None for the shipped one,
            hardware/trainer_port.toml.

    Raises:
        InputError: a control input is not finite, the sequence is not a whole number from 0, or
            engage is not a bool.
    """
    calibration = calibration or _shipped_calibration()
    command = Command(throttle, aileron, elevator, rudder)
    return encode_channels(sequence, calibration.channels_us(command), engage)


def load_calibration(path: str | Path | None = None) -> Calibration:
    """Read a calibration file; None for the shipped one, which was not measured on any radio.

    Raises:
        FileNotFoundError: there is no file at the path.
        InputError: the file is not TOML, a key is missing or unknown, or the values make no PPM
            frame.
    """
    return from_toml(Calibration, default_calibration_path() if path is None else path)


def default_calibration_path() -> Path:
    """Path of the shipped calibration.

    Raises:
        FileNotFoundError: it is neither in the checkout nor in the installation.
    """
    return shipped_path("hardware/trainer_port.toml", "name one")


@cache
def _shipped_calibration() -> Calibration:
    """The calibration that ships, read once."""
    return load_calibration()


def _require_date(text: str) -> None:
    """Raise InputError unless the text is a day in ISO format or empty."""
    try:
        if text:
            date.fromisoformat(text)
    except ValueError:
        raise InputError(
            f'measured: expected a day such as "2026-03-01", or "" for never, got {text!r}'
        ) from None
