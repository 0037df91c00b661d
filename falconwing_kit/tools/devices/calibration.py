"""Bench calibration: a TOML file of `falconwing bench` <-> lens, delays, rate and pulses.

Each part is there only if it was measured: without a board there are no delays.
"""

from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from falconwing_kit.aircraft.model import Model
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.files import short_name
from falconwing_kit.core.messages import Image
from falconwing_kit.flight.loop import ImageSource
from falconwing_kit.tools.devices.latency import FrameTimes, LatencyFit, PpmTimes
from falconwing_kit.tools.devices.lens import Lens, LensFit


@dataclass(frozen=True)
class BenchCalibration:
    """What `falconwing bench` measured of a camera and a trainer port."""

    measured: str  # the day, such as "2026-03-01"
    simulated: bool  # of a simulated board and camera: not for an aircraft
    camera: str  # as --camera named it
    board: str = ""  # that the delays and pulses are of; empty without one
    frames: FrameTimes | None = None
    lens: LensFit | None = None
    latency: LatencyFit | None = None
    ppm: PpmTimes | None = None

    def __post_init__(self) -> None:
        try:
            date.fromisoformat(self.measured)
        except ValueError:
            raise InputError(
                f"measured: expected a day such as 2026-03-01, got {self.measured!r}"
            ) from None
        if self.latency is not None:
            for name in ("camera_s", "pulse_s", "camera_to_pulse_s"):
                require_range(f"latency.{name}", getattr(self.latency, name), low=0.0, high=1.0)

    def require_lens(self) -> Lens:
        """The lens; InputError if it was not measured."""
        if self.lens is None:
            raise InputError(
                "lens: expected one in the file of falconwing bench, got none; run falconwing bench"
                " without --skip lens"
            )
        return self.lens.lens

    def with_delay(self, model: Model) -> Model:
        """The simulated aircraft behind the measured delays.

        The kit's world delays every command by LINK_DELAY_S; the difference to what was measured
        goes into the aircraft's own delay, so that a pilot designed on it reckons with both.

        Args:
            model: with a delay.

        Raises:
            InputError: there are no delays, or they are shorter than the world's own.
        """
        if self.latency is None:
            return model
        total = self.latency.camera_to_pulse_s
        delay = model.values["delay"] + total - LINK_DELAY_S
        if delay < 0.0:
            raise InputError(
                f"latency: expected {LINK_DELAY_S - model.values['delay']:g} s or more, which the"
                f" simulator has at least, got {total:g} s; measure again"
            )
        return model.with_values({"delay": delay})


def read_bench(path: str | Path, for_aircraft: bool = False) -> BenchCalibration:
    """Read a file of `falconwing bench`.

    Args:
        path: of the TOML file.
        for_aircraft: refuse one of a simulated bench.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is no such file, a value is out of range, or it is of a simulated bench.
    """
    found = from_toml(BenchCalibration, path)
    if for_aircraft and found.simulated:
        raise InputError(
            f"{short_name(path)}: expected a camera and board that were measured, got a SIMULATED"
            " bench; run falconwing bench with your own"
        )
    return found


class StraightImages:
    """An image source whose images are undistorted.

    Args:
        source: a camera's images (H, W, 3).
        lens: that they were taken through.
    """

    def __init__(self, source: ImageSource, lens: Lens) -> None:
        self.source, self.lens = source, lens
        self._image: Image | None = None

    def next_image(self, t: float) -> Image | None:
        """The newest image at t [s], undistorted once."""
        image = self.source.next_image(t)
        if image is None:
            return None
        if self._image is None or image.sequence != self._image.sequence:
            self._image = replace(image, pixels=self.lens.undistort(image.pixels))
        return self._image
