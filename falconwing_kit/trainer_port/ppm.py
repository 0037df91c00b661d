"""PPM calibration: stick positions <-> microseconds in the slots of a PPM frame. Order, reversal
and limits live here.

A PPM frame is a train of short gap pulses; the time from one pulse to the next is a channel, and a
long pause ends it:

    _   _____   _______   ____   _______   _____________________   _____
     |_|  ch1 |_|  ch2  |_| ch3|_|  ch4  |_|       pause         |_|      (polarity 1: idle high, pulses low)
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

VALID_US = (
    900,
    2100,
)  # outside of this the firmware refuses a command (VALID_MIN_US, VALID_MAX_US of config.h)
SENT_US = (1000, 2000)  # to this it cuts what it sends (CHANNEL_MIN_US, CHANNEL_MAX_US)
SYNC_GAP_US = (4000, 19000)  # pauses that radios with EdgeTX take for the end of a frame
UNUSED_CHANNEL_US = 1500  # slots that no stick uses


@dataclass(frozen=True)
class Stick:
    """One stick: its slot and the microseconds at its ends and its centre."""

    channel: int  # slot in the PPM frame, counted from 1
    low_us: int  # [us] at the end that gives fewer
    centre_us: int  # [us] in the middle; of the throttle, at half throttle
    high_us: int  # [us] at the end that gives more
    reversed: bool = (
        False  # True: the positive end (full throttle, right, nose up) is the one that gives fewer
    )

    def __post_init__(self) -> None:
        low, high = VALID_US
        if not low <= self.low_us < self.centre_us < self.high_us <= high:
            raise InputError(
                f"expected low_us < centre_us < high_us within {low}..{high} us, "
                f"got {self.low_us}, {self.centre_us}, {self.high_us}; measure again or correct the file"
            )

    def to_us(self, position: float) -> int:
        """Microseconds, to the nearest whole one, of a stick at -1..1: straight lines from the
        centre to both ends.
        """
        side = -position if self.reversed else position
        reach = self.high_us - self.centre_us if side >= 0.0 else self.centre_us - self.low_us
        return round(self.centre_us + side * reach)

    def to_position(self, us: float) -> float:
        """Where the stick is, -1..1 and beyond where the microseconds are beyond its ends: the
        inverse of `to_us`.
        """
        offset = us - self.centre_us
        side = offset / (
            self.high_us - self.centre_us if offset >= 0.0 else self.centre_us - self.low_us
        )
        return -side if self.reversed else side


@dataclass(frozen=True)
class Calibration:
    """What one radio's trainer port wants and gives. The fields are the keys of the TOML file."""

    radio: str  # what it was measured on; "" for the values that ship
    measured: str  # the day it was measured, such as "2026-03-01"; "" = never
    channels: int  # slots in a frame, 4..8
    frame_us: int  # [us] from the first edge of a frame to the first edge of the next
    gap_us: int  # [us] width of the gap pulse that starts every slot
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
                f"frame_us: expected a pause of {SYNC_GAP_US[0]}..{SYNC_GAP_US[1]} us behind {self.channels} channels, "
                f"got {shortest}..{longest} us; change frame_us or channels"
            )
        slots = [stick.channel for stick in self.sticks]
        if len(set(slots)) < len(slots) or not 1 <= min(slots) <= max(slots) <= self.channels:
            raise InputError(
                f"channel: expected four different slots of 1..{self.channels}, got {slots}; correct the file"
            )

    @property
    def sticks(self) -> tuple[Stick, Stick, Stick, Stick]:
        """The four sticks in the order of COMMAND_NAMES."""
        return (self.throttle, self.aileron, self.elevator, self.rudder)

    def channels_us(self, command: Command) -> tuple[int, ...]:
        """The slots of a command.

        Args:
            command: throttle 0..1, the others -1..1; cut to these limits.

        Returns:
            (channels,) [us] in the order of the slots; SPARE_US where no stick is.

        Raises:
            InputError: a stick is not finite.
        """
        clipped = Command.clip(*(getattr(command, name) for name in COMMAND_NAMES))
        positions = (
            2.0 * clipped.throttle - 1.0,
            clipped.aileron,
            clipped.elevator,
            clipped.rudder,
        )
        slots = [UNUSED_CHANNEL_US] * self.channels
        for stick, position in zip(self.sticks, positions, strict=True):
            slots[stick.channel - 1] = stick.to_us(position)
        return tuple(slots)

    def command(self, channels_us: Sequence[float]) -> Command:
        """The sticks of a frame, the inverse of `channels_us`.

        Args:
            channels_us: (n,) [us] in the order of the slots; more than the sticks need may come.

        Returns:
            The command, cut to its limits; `saturated` says whether a slot was beyond an end.

        Raises:
            InputError: there are too few slots, or one is not finite.
        """
        needed = max(stick.channel for stick in self.sticks)
        if len(channels_us) < needed:
            raise InputError(
                f"channels: expected at least {needed}, got {len(channels_us)}; does the radio send PPM of four?"
            )
        at = [stick.to_position(channels_us[stick.channel - 1]) for stick in self.sticks]
        return Command.clip(0.5 * (at[0] + 1.0), at[1], at[2], at[3])


def load_calibration(path: str | Path | None = None) -> Calibration:
    """Read a calibration file.

    Args:
        path: the TOML file; None takes the one that ships, which was not measured on any radio.

    Raises:
        FileNotFoundError: there is no file at the path.
        InputError: the file is not TOML, a key is missing or unknown, or the values make no PPM
            frame.
    """
    return from_toml(Calibration, default_calibration_path() if path is None else path)


@cache
def shipped_calibration() -> Calibration:
    """The calibration that ships, read once."""
    return load_calibration()


def default_calibration_path() -> Path:
    """Where the calibration that ships is: in a checkout beside the package, else where the install
    put it.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    return shipped_path("hardware/trainer_port.toml", "name one")


def _require_date(text: str) -> None:
    try:
        if text:
            date.fromisoformat(text)
    except ValueError:
        raise InputError(
            f'measured: expected a day such as "2026-03-01", or "" for never, got {text!r}'
        ) from None
