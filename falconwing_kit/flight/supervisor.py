"""Supervisor: each image, command and state of a flight -> go on, or hand back, and why.

A pilot by camera can fail silently: its image froze, came late or is noise, its computation hung,
or the aircraft left the attitudes that it was made for. The supervisor stands between any pilot and
the aircraft, in the loop (`Loop(supervisor=...)`) and in the relay from ROS, and decides by plain
limits. Once it has found a fault, it stays with it: control returns to the person with the sticks,
or to the safe command, and only a new flight begins again.

The paper has a monitor that raises a flag in autonomous mode; this is where the flag acts.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.flight.sources import decode_jpeg
from falconwing_kit.vision.monitor import FrameMonitor

IMAGES_KEPT = 64  # newest images whose times are known
COMPARED_STEP = 4  # every fourth pixel of every fourth row is compared with the image before


@dataclass(frozen=True)
class SupervisorSettings:
    """Limits of autonomous flight; a limit of infinity is switched off.

    Raises:
        InputError: a limit is out of its range.
    """

    max_image_age_s: float = 0.4  # of the image behind a command
    identical_images: int = 5  # in a row; a live camera's images differ by their noise
    max_pilot_s: float = 0.2  # of one step's computation: the board's own timeout
    max_bank: float = math.radians(80.0)  # [rad], of either wing
    max_pitch: float = math.radians(60.0)  # [rad], of nose up or down
    max_height: float = 4.65  # [m]: the beams of the arena
    max_active_s: float = math.inf  # of autonomous flight
    battery_s: float = math.inf  # from the first command of the flight to an empty battery

    def __post_init__(self) -> None:
        limits = {
            "max_image_age_s": 10.0, "identical_images": 1000, "max_pilot_s": 10.0,
            "max_bank": math.pi, "max_pitch": math.pi / 2.0, "max_height": 1000.0,
            "max_active_s": math.inf, "battery_s": math.inf,
        }  # fmt: skip
        for name, high in limits.items():
            value = getattr(self, name)
            if value != math.inf:
                require_range(name, value, low=1e-3, high=high)
        if self.identical_images < 2:
            raise InputError(
                f"identical_images: expected 2 or more, got {self.identical_images}; every image is"
                " identical to itself"
            )


class Supervisor:
    """The judge of one flight: `see` every image, `check` every command before it is sent.

    Args:
        settings: limits; None for the defaults.
        by_images: the pilot flies by images, so that a command without one is a fault. Without it
            only commands that name an image are judged by its age.
        monitor: the frame monitor whose alert hands back; None for none.
    """

    def __init__(
        self,
        settings: SupervisorSettings | None = None,
        *,
        by_images: bool = False,
        monitor: FrameMonitor | None = None,
    ) -> None:
        self.settings = settings or SupervisorSettings()
        self.reason = ""  # why control was handed back; empty while all is well
        self.largest_age_s = 0.0  # of the images behind the commands so far
        self._by_images, self._monitor = by_images, monitor
        self._taken: dict[int, float] = {}  # sequence of an image -> time it was taken [s]
        self._last: NDArray[np.uint8] | None = None  # part of the newest image
        self._identical = 1  # images in a row that look like the newest
        self._image_fault = ""
        self._began: float | None = None  # time of the first command [s]

    @property
    def margin_s(self) -> float:
        """How much older the image behind a command could have been in this flight [s]."""
        return self.settings.max_image_age_s - self.largest_age_s

    @property
    def record(self) -> dict[str, float | str]:
        """What a log keeps of it."""
        return {
            "reason": self.reason,
            "largest_image_age_s": round(self.largest_age_s, 4),
            "max_image_age_s": self.settings.max_image_age_s,
        }

    def see(self, image: Image, t: float) -> None:
        """Take note of a new image; it never raises.

        Args:
            image: pixels or JPEG; its time counts, but not later than now.
            t: now [s], on the clock of `check`.
        """
        taken = min(image.t, t) if math.isfinite(image.t) else -math.inf
        if self._taken.get(image.sequence) == taken:
            return  # the same image again
        self._keep(image.sequence, taken)
        part = _part(image.pixels)
        same = self._last is not None and np.array_equal(part, self._last)
        self._identical = self._identical + 1 if same else 1
        self._last = part
        if self._monitor is not None:
            self._image_fault = self._watch(self._monitor, image, t)

    def check(
        self, t: float, command: Command | None, state: State | None = None, pilot_s: float = 0.0
    ) -> str:
        """Judge a command before it is sent.

        Args:
            t: now [s], running forward.
            command: of the pilot, naming the image it was computed from; None where it failed.
            state: of the aircraft, where it is known.
            pilot_s: that the pilot took for it [s].

        Returns:
            Why control must be handed back; empty to go on. A reason stays for the whole flight.
        """
        self._began = t if self._began is None else self._began
        if not self.reason:
            self.reason = (
                self._command_fault(command, pilot_s)
                or self._age_fault(t, command)
                or self._image_fault
                or self._frozen_fault()
                or self._envelope_fault(state)
                or self._time_fault(t - self._began)
            )
        return self.reason

    def _command_fault(self, command: Command | None, pilot_s: float) -> str:
        """A pilot that failed, or took too long."""
        if command is None or not np.isfinite(command.vector).all():
            return "the pilot gave no finite command"
        if not pilot_s <= self.settings.max_pilot_s:
            return f"the pilot took {pilot_s:.2f} s, at most {self.settings.max_pilot_s:g} allowed"
        return ""

    def _age_fault(self, t: float, command: Command | None) -> str:
        """An image behind the command that is too old, or none at all.

        An image that was never seen here counts from the first command that names it.
        """
        sequence = -1 if command is None else command.image_sequence
        if sequence < 0:
            if not self._by_images:
                return ""
            age = t - (t if self._began is None else self._began)
            what = "no image for"
        else:
            if sequence not in self._taken:
                self._keep(sequence, t)
            age = t - self._taken[sequence]
            what = "the command answers an image of"
        self.largest_age_s = max(self.largest_age_s, age)
        if age <= self.settings.max_image_age_s + 1e-9:
            return ""
        return f"{what} {age:.2f} s, at most {self.settings.max_image_age_s:g} allowed"

    def _keep(self, sequence: int, taken: float) -> None:
        """Remember the time of an image, and forget the oldest."""
        self._taken[sequence] = taken
        while len(self._taken) > IMAGES_KEPT:
            del self._taken[next(iter(self._taken))]

    def _frozen_fault(self) -> str:
        """Images that are new by their numbers and equal by their pixels."""
        if self._identical < self.settings.identical_images:
            return ""
        return f"{self._identical} identical images in a row"

    def _envelope_fault(self, state: State | None) -> str:
        """An attitude or height outside the limits; what is not known is not judged."""
        limits = self.settings
        if state is None:
            return ""
        for name, angle, limit in (
            ("bank", state.roll, limits.max_bank),
            ("pitch", state.pitch, limits.max_pitch),
        ):
            if abs(math.remainder(angle, 2.0 * math.pi)) > limit:  # nan compares false
                return (
                    f"{name} of {math.degrees(angle):.0f} deg, at most {math.degrees(limit):.0f}"
                    " allowed"
                )
        if state.p_world[2] > limits.max_height:
            return f"height of {state.p_world[2]:.1f} m, at most {limits.max_height:g} allowed"
        return ""

    def _time_fault(self, active_s: float) -> str:
        """The limits of time."""
        if active_s > self.settings.battery_s:
            return f"battery: {active_s:.0f} s since the first command"
        if active_s > self.settings.max_active_s:
            return (
                f"{active_s:.0f} s of autonomous flight, at most {self.settings.max_active_s:g}"
                " allowed"
            )
        return ""

    def _watch(self, monitor: FrameMonitor, image: Image, t: float) -> str:
        """The frame monitor's alert; a picture that it cannot read is one."""
        try:
            pixels = decode_jpeg(image) if image.pixels.ndim == 1 else image.pixels
            verdict = monitor.update(pixels, t)
        except (ValueError, TypeError, OSError) as error:
            return f"frame monitor: {error}"
        return f"frame monitor: {verdict.reason}" if verdict.alert else ""


def _part(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What of an image is compared: its JPEG, or some of its pixels."""
    if pixels.ndim == 1:
        return pixels
    return np.ascontiguousarray(pixels[::COMPARED_STEP, ::COMPARED_STEP])
