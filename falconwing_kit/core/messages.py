"""Messages: what one block of the loop hands to the next. Frozen records with units and frames,
nothing else.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, require_range, require_shape
from falconwing_kit.core.frames import pose_matrix, rotation_world_body

# Order of the state vector: the paper's nine, then the body rates of the 12-state model.
STATE_NAMES = ("px", "py", "pz", "pitch", "yaw", "roll", "vx", "vy", "vz", "p", "q", "r")
COMMAND_NAMES = ("throttle", "aileron", "elevator", "rudder")


@dataclass(frozen=True)
class Image:
    """One camera frame."""

    sequence: int  # counts frames since the camera started
    t: float  # when it was taken [s]
    pixels: NDArray[np.uint8]  # (height, width, 3) RGB, or its JPEG as (n,) bytes

    @property
    def jpeg(self) -> bytes:
        """The image as JPEG; pixels are packed by OpenCV."""
        if self.pixels.ndim == 1:
            return self.pixels.tobytes()
        import cv2

        return bytes(cv2.imencode(".jpg", self.pixels[..., ::-1])[1])


@dataclass(frozen=True)
class Pose:
    """Where the aircraft is and how it is turned: position [m] and attitude [rad] in the world."""

    p_world: Array  # (3,) [m]
    roll: float  # [rad], right wing down positive
    pitch: float  # [rad], nose up positive
    yaw: float  # [rad], nose right positive

    @property
    def T_world_body(self) -> Array:
        """The same pose as a matrix (4, 4)."""
        return pose_matrix(rotation_world_body(self.roll, self.pitch, self.yaw), self.p_world)


@dataclass(frozen=True)
class State:
    """The paper's nine states, and body rates where a model has them."""

    p_world: Array  # (3,) [m]
    pitch: float  # [rad]
    yaw: float  # [rad]
    roll: float  # [rad]
    v_world: Array  # (3,) [m/s]
    rates_body: Array = field(default_factory=lambda: np.zeros(3))  # (3,) p, q, r [rad/s]

    @classmethod
    def from_vector(cls, vector: Array) -> "State":
        """State from its vector.

        Args:
            vector: (9,) or (12,) in the order of STATE_NAMES, SI.

        Returns:
            The state; body rates are zero where the vector has none.

        Raises:
            InputError: the vector has another length.
        """
        x = require_shape("state", vector, (12 if len(vector) > 9 else 9,))
        rates = x[9:12] if len(x) == 12 else np.zeros(3)
        return cls(x[0:3], float(x[3]), float(x[4]), float(x[5]), x[6:9], rates)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "State":
        """State from names and numbers, the inverse of `record`.

        Args:
            record: a number for each of STATE_NAMES, None where it is not known.

        Raises:
            InputError: a value is not a finite number.
            KeyError: a name is missing.
        """
        values = [record[name] for name in STATE_NAMES]
        numbers = [
            np.nan if x is None else require_range(name, x)
            for name, x in zip(STATE_NAMES, values, strict=True)
        ]
        return cls.from_vector(np.array(numbers))

    @property
    def vector(self) -> Array:
        """(12,) in the order of STATE_NAMES, SI."""
        return np.concatenate(
            [self.p_world, [self.pitch, self.yaw, self.roll], self.v_world, self.rates_body]
        )

    @property
    def record(self) -> dict[str, float | None]:
        """Names and numbers, as JSON holds them: None for nan."""
        return {
            name: x if np.isfinite(x) else None
            for name, x in zip(STATE_NAMES, self.vector.tolist(), strict=True)
        }

    @property
    def pose(self) -> Pose:
        """Position and attitude alone."""
        return Pose(self.p_world, self.roll, self.pitch, self.yaw)


@dataclass(frozen=True)
class Command:
    """Stick positions: throttle 0..1, the others -1..1; positive is right wing down, nose up, nose
    right.
    """

    throttle: float
    aileron: float
    elevator: float
    rudder: float
    image_sequence: int = -1  # the image this command answers; -1 where there was none
    saturated: bool = False  # True where a limit acted

    @classmethod
    def clip(
        cls,
        throttle: float,
        aileron: float,
        elevator: float,
        rudder: float,
        image_sequence: int = -1,
    ) -> "Command":
        """A command within its limits; `saturated` says whether a limit acted.

        Args:
            throttle: wanted throttle, cut to 0..1.
            aileron: wanted aileron, cut to -1..1.
            elevator: wanted elevator, cut to -1..1.
            rudder: wanted rudder, cut to -1..1.
            image_sequence: the image this command answers.

        Returns:
            The command.

        Raises:
            InputError: a value is not finite.
        """
        values = (throttle, aileron, elevator, rudder)
        wanted = [
            require_range(name, value) for name, value in zip(COMMAND_NAMES, values, strict=True)
        ]
        clipped = [
            min(max(value, low), 1.0)
            for value, low in zip(wanted, (0.0, -1.0, -1.0, -1.0), strict=True)
        ]
        return cls(
            clipped[0],
            clipped[1],
            clipped[2],
            clipped[3],
            image_sequence,
            saturated=clipped != wanted,
        )

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "Command":
        """Command from names and values, the inverse of `record`.

        Args:
            record: a number for each of COMMAND_NAMES, image_sequence and saturated.

        Raises:
            InputError: a value is not a finite number.
            KeyError: a name is missing.
        """
        values = [require_range(name, record[name]) for name in COMMAND_NAMES]
        sequence = int(
            require_range("image_sequence", record["image_sequence"], low=-1, high=2**32)
        )
        return cls(values[0], values[1], values[2], values[3], sequence, bool(record["saturated"]))

    @property
    def vector(self) -> Array:
        """(4,) in the order of COMMAND_NAMES."""
        return np.array([self.throttle, self.aileron, self.elevator, self.rudder])

    @property
    def record(self) -> dict[str, float | int | bool]:
        """Names and values, as JSON holds them."""
        values = {name: float(getattr(self, name)) for name in COMMAND_NAMES}
        return {
            **values,
            "image_sequence": int(self.image_sequence),
            "saturated": bool(self.saturated),
        }


@dataclass(frozen=True)
class Event:
    """Something that happened once: engaged, marker lost, touchdown."""

    t: float  # [s]
    name: str
    details: Mapping[str, Any]


@dataclass(frozen=True)
class Observation:
    """What a controller gets: the newest image, the commands it gave, and the state where one is
    known.
    """

    t: float  # [s]
    image: Image | None
    past_commands: Array  # (30, 4), oldest first, zero where there was none
    state: State | None = None
