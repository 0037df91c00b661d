"""Messages: frozen records that the blocks of the control loop exchange, with units and frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, require_range, require_shape
from falconwing_kit.core.frames import pose_matrix, rotation_world_body

CONTROL_PERIOD_S = 0.05  # of the control loop and of the flight table's rows: the paper's 20 Hz
# Order of the state vector: the paper's nine, then the body rates of the 12-state model.
STATE_NAMES = ("px", "py", "pz", "pitch", "yaw", "roll", "vx", "vy", "vz", "p", "q", "r")
COMMAND_NAMES = ("throttle", "aileron", "elevator", "rudder")


@dataclass(frozen=True)
class Image:
    """One camera frame."""

    sequence: int  # number of the frame since the camera started
    t: float  # time of exposure [s]
    pixels: NDArray[np.uint8]  # (height, width, 3) RGB, or its JPEG as (n,) bytes

    @property
    def jpeg(self) -> bytes:
        """The image as JPEG; pixels are encoded by OpenCV."""
        if self.pixels.ndim == 1:
            return self.pixels.tobytes()
        import cv2

        return bytes(cv2.imencode(".jpg", self.pixels[..., ::-1])[1])


@dataclass(frozen=True)
class Pose:
    """Position [m] and attitude [rad] of the aircraft in the world."""

    p_world: Array  # (3,) [m]
    roll: float  # [rad], right wing down positive
    pitch: float  # [rad], nose up positive
    yaw: float  # [rad], nose right positive

    @property
    def T_world_body(self) -> Array:
        """The pose as a homogeneous matrix (4, 4)."""
        return pose_matrix(rotation_world_body(self.roll, self.pitch, self.yaw), self.p_world)


@dataclass(frozen=True)
class State:
    """The paper's nine states, and body rates for models that have them."""

    p_world: Array  # (3,) [m]
    pitch: float  # [rad]
    yaw: float  # [rad]
    roll: float  # [rad]
    v_world: Array  # (3,) [m/s]
    rates_body: Array = field(default_factory=lambda: np.zeros(3))  # (3,) p, q, r [rad/s]

    @classmethod
    def from_vector(cls, vector: Array) -> "State":
        """State from a vector (9,) or (12,) in the order of STATE_NAMES; (9,) has zero body rates.

        Raises:
            InputError: the vector has another length.
        """
        x = require_shape("state", vector, (12 if len(vector) > 9 else 9,))
        rates = x[9:12] if len(x) == 12 else np.zeros(3)
        return cls(x[0:3], float(x[3]), float(x[4]), float(x[5]), x[6:9], rates)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "State":
        """State from a number for each of STATE_NAMES, None for nan; the inverse of `record`.

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
        """Names and numbers for JSON: None for nan."""
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
    """Control inputs: throttle 0..1, the others -1..1."""

    throttle: float
    aileron: float  # positive right wing down
    elevator: float  # positive nose up
    rudder: float  # positive nose right
    image_sequence: int = -1  # the image that the command was computed from; -1 without one
    saturated: bool = False  # True if a limit was active

    @classmethod
    def clip(
        cls,
        throttle: float,
        aileron: float,
        elevator: float,
        rudder: float,
        image_sequence: int = -1,
    ) -> "Command":
        """A command clipped to its limits; `saturated` records whether one was active.

        Raises:
            InputError: a value is not finite.
        """
        values = (throttle, aileron, elevator, rudder)
        unclipped = {
            name: require_range(name, value)
            for name, value in zip(COMMAND_NAMES, values, strict=True)
        }
        clipped = {
            name: min(max(value, 0.0 if name == "throttle" else -1.0), 1.0)
            for name, value in unclipped.items()
        }
        return cls(**clipped, image_sequence=image_sequence, saturated=clipped != unclipped)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "Command":
        """Command from COMMAND_NAMES, image_sequence and saturated; the inverse of `record`.

        Raises:
            InputError: a value is not a finite number.
            KeyError: a name is missing.
        """
        values = {name: require_range(name, record[name]) for name in COMMAND_NAMES}
        sequence = require_range("image_sequence", record["image_sequence"], low=-1, high=2**32)
        saturated = bool(record["saturated"])
        return cls(**values, image_sequence=int(sequence), saturated=saturated)

    @property
    def vector(self) -> Array:
        """(4,) in the order of COMMAND_NAMES."""
        return np.array([self.throttle, self.aileron, self.elevator, self.rudder])

    @property
    def record(self) -> dict[str, float | int | bool]:
        """Names and values for JSON."""
        values = {name: float(getattr(self, name)) for name in COMMAND_NAMES}
        return {
            **values,
            "image_sequence": int(self.image_sequence),
            "saturated": bool(self.saturated),
        }


SAFE_COMMAND = Command(throttle=0.0, aileron=0.0, elevator=0.0, rudder=0.0)  # motor off, neutral


@dataclass(frozen=True)
class Event:
    """A single occurrence: engaged, marker lost, touchdown."""

    t: float  # [s]
    name: str
    details: Mapping[str, Any]


@dataclass(frozen=True)
class Observation:
    """Input of a controller: newest image, past commands that acted, and the state if known."""

    t: float  # [s]
    image: Image | None
    past_commands: Array  # (30, 4), oldest first, zeros before the first command
    state: State | None = None
