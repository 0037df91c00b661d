"""Touchdown: a flown path and wheel positions -> first wheel contact: place, time, sink rate.

Geometry only. There is no ground reaction: the path after the first contact is meaningless. Wing
tips and propeller are not considered.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.aircraft.airframe import WHEEL_NAMES, Airframe
from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import body_rates, euler_rates, rotation_world_body, wrap_angle

Surface = Literal["pad", "pad edge", "floor"]

_CHECK_FRACTIONS = np.arange(1, 17) / 16.0  # of a step between two samples
_CONTACT_TOLERANCE = 1e-6  # a wheel within this of the pad's top stands on it [m]


@dataclass(frozen=True)
class LandingPad:
    """The raised pad, a box on the floor along the world's x axis; by default that of the hall."""

    x_start: float = 1.0  # its threshold, the near edge of an approach [m]
    y_centre: float = -2.0  # its centre line [m]; the marker is at y = 0
    length: float = 13.0  # along x [m]
    width: float = 2.0  # along y [m]
    height: float = 0.1  # of its top above the floor [m]; zero for a pad painted on the floor

    def __post_init__(self) -> None:
        for name in ("x_start", "y_centre"):
            require_range(f"pad {name}", getattr(self, name))
        for name in ("length", "width", "height"):
            require_range(f"pad {name}", getattr(self, name), low=0.0)


@dataclass(frozen=True)
class Touchdown:
    """The first contact of a wheel with the ground."""

    t: float  # [s]
    wheel: str  # one of WHEEL_NAMES
    surface: Surface  # "pad edge": the wheel hit the side of the pad
    p_world_wheel: Array  # (3,) the contact point [m]
    p_world: Array  # (3,) the centre of gravity at contact [m]
    sink_rate: float  # of that wheel, positive down [m/s]
    speed: float  # of the centre of gravity, relative to the hall [m/s]
    bank: float  # [rad], right wing down positive
    pitch: float  # [rad], nose up positive
    yaw: float  # [rad], nose right of the runway positive
    lateral_offset: float  # of the centre of gravity from the pad's centre line, positive left [m]
    past_threshold: float  # of the wheel, along the runway from the pad's threshold [m]

    @property
    def on_pad(self) -> bool:
        """Whether the wheel touched the pad's top: the paper's successful landing."""
        return self.surface == "pad"

    @property
    def absolute_lateral_deviation(self) -> float:
        """The paper's ALD [m]; to be averaged over landings only, a failure has none."""
        return abs(self.lateral_offset)


def pad_height(p_world: ArrayLike, pad: LandingPad | None) -> Array:
    """Height (...) of the ground below points (..., 3) [m]: the pad's top over the pad, else 0."""
    p = np.asarray(p_world, np.float64)
    return np.zeros(p.shape[:-1]) if pad is None else np.where(_is_over(p, pad), pad.height, 0.0)


def wheel_positions(states: ArrayLike, airframe: Airframe) -> Array:
    """Positions (..., 3, 3) of the wheels' contact points [m], rows in the order of WHEEL_NAMES.

    p_world_wheel = p_world + R_world_body p_body_wheel

    Args:
        states: (..., 9 or 12) in the order of STATE_NAMES, SI.
        airframe: with the wheels.
    """
    x = _states(states, 9, 12)
    return np.asarray(x[..., None, 0:3] + airframe.wheels.points_body @ _R_body_world(x))


def wheel_velocities(states: ArrayLike, airframe: Airframe) -> Array:
    """Velocities (..., 3, 3) of the wheels' contact points [m/s], the aircraft being rigid.

    v_world_wheel = v_world + R_world_body (omega_body x p_body_wheel)

    Args:
        states: (..., 12) in the order of STATE_NAMES, SI.
        airframe: with the wheels.
    """
    x = _states(states, 12)
    v_body_wheel = np.cross(x[..., None, 9:12], airframe.wheels.points_body)
    return np.asarray(x[..., None, 6:9] + v_body_wheel @ _R_body_world(x))


def wheel_heights(states: ArrayLike, airframe: Airframe, pad: LandingPad | None = None) -> Array:
    """Height (..., 3) of each wheel above the ground below it [m], negative below the ground.

    Args:
        states: (..., 9 or 12) in the order of STATE_NAMES, SI.
        airframe: with the wheels.
        pad: the pad; None for a bare floor.
    """
    return _heights(wheel_positions(states, airframe), pad)


def find_touchdown(
    t: ArrayLike, states: ArrayLike, airframe: Airframe, pad: LandingPad
) -> Touchdown | None:
    """The first contact of a wheel after all wheels were off the ground; None without one.

    Between two samples all quantities follow Hermite's cubic. On a smooth path its error is at most
    dt^4 / 384 times the fourth derivative: at 20 Hz and a fast pitch oscillation (0.1 rad at
    10 rad/s, wheel at 0.3 m) 5 micrometres in height. A contact shorter than a sixteenth of a step
    can be missed.

    Args:
        t: (n,) time of the samples [s], increasing.
        states: (n, 9 or 12) in the order of STATE_NAMES, SI. Rows of nine get their body rates from
            differences of the attitude, so attitude noise reaches the sink rate.
        airframe: with the wheels.
        pad: the pad, `LandingPad()` for the hall's.

    Raises:
        InputError: the shapes do not match, a number is not finite or time does not increase.
    """
    times, values, rates = _paths(t, states, airframe)
    off_ground = np.flatnonzero(np.all(_heights(values[:, :3], pad) > 0.0, axis=-1))
    for i in range(off_ground[0] if off_ground.size else len(times), len(times) - 1):
        step = values[i : i + 2], rates[i : i + 2], float(times[i + 1] - times[i])
        contact = _contact_within(*step, pad)
        if contact is not None:
            fraction, wheel = contact
            return _touchdown(times[i] + fraction * step[2], wheel, *_cubic(fraction, *step), pad)
    return None


def is_out_of_reach(dt: float, states: Array, airframe: Airframe, pad: LandingPad) -> bool:
    """Whether an aircraft is so high that `find_touchdown` would find no contact.

    A wheel is at most its distance from the centre of gravity below that, and its path, a cubic,
    falls in a step by at most dt times the wheel's largest vertical speed at an end of the step.

    Args:
        dt: between both samples [s]; one that is not above 0 is left to `find_touchdown`.
        states: (2, 12) in the order of STATE_NAMES, SI; those with a number that is not finite are
            left to `find_touchdown`.
        airframe: with the wheels.
        pad: the pad.
    """
    wheels = airframe.wheels
    arm = max(math.hypot(*wheel) for wheel in (wheels.main_left, wheels.main_right, wheels.tail))
    lowest = float(states[:, 2].min()) - arm
    speed = max(abs(x[8]) + arm * math.hypot(*x[9:12]) for x in states.tolist())
    return dt > 0.0 and bool(np.isfinite(states).all()) and lowest - dt * speed > pad.height


def _paths(t: ArrayLike, states: ArrayLike, airframe: Airframe) -> tuple[Array, Array, Array]:
    """Times (n,), values and rates (n, 5, 3): three wheels, centre of gravity, pitch-yaw-roll."""
    x = _states(states, 9, 12)
    x = require_shape("states", x, (None, x.shape[-1]))
    times = require_shape("t", t, (len(x),))
    if not (np.isfinite(times).all() and np.isfinite(x).all()):
        raise InputError(
            "states: expected finite numbers, got nan or infinity; cut the flight at its gaps first"
        )
    if len(times) < 2 or np.any(np.diff(times) <= 0.0):
        raise InputError(
            "t: expected two or more samples with increasing times; sort the rows and drop repeated"
            " ones"
        )
    angles = np.unwrap(x[:, 3:6], axis=0)
    pitch, yaw, roll = angles.T
    if x.shape[1] == 9:
        pitch_rate, yaw_rate, roll_rate = np.gradient(angles, times, axis=0).T
        x = np.column_stack([x, *body_rates(roll, pitch, roll_rate, pitch_rate, yaw_rate)])
    # Rates of the angles from the body rates, for the cubic of the attitude.
    row_z = rotation_world_body(roll, pitch, yaw)[:, 2].T
    roll_rate, pitch_rate, yaw_rate = euler_rates(row_z, *x[:, 9:12].T)
    angle_rates = np.stack([pitch_rate, yaw_rate, roll_rate], axis=-1)
    positions, velocities = wheel_positions(x, airframe), wheel_velocities(x, airframe)
    values = np.concatenate([positions, x[:, None, 0:3], angles[:, None]], axis=1)
    rates = np.concatenate([velocities, x[:, None, 6:9], angle_rates[:, None]], axis=1)
    return times, values, rates


def _cubic(fraction: ArrayLike, values: Array, rates: Array, dt: float) -> tuple[Array, Array]:
    """Hermite's cubic: values and rates (..., 5, 3) at fractions (...) of a step (2, 5, 3)."""
    s = np.asarray(fraction, np.float64)[..., None, None]
    mean_rate = (values[1] - values[0]) / dt
    quadratic = 3.0 * mean_rate - 2.0 * rates[0] - rates[1]
    cubic = rates[0] + rates[1] - 2.0 * mean_rate
    value = values[0] + dt * s * (rates[0] + s * (quadratic + s * cubic))
    return value, rates[0] + s * (2.0 * quadratic + 3.0 * s * cubic)


def _contact_within(
    values: Array, rates: Array, dt: float, pad: LandingPad
) -> tuple[float, int] | None:
    """Fraction of the step at the first contact, and the wheel; None without one."""
    if np.min(values[:, :3, 2]) - dt * np.max(np.abs(rates[:, :3, 2])) > pad.height:
        return None  # too high to reach the ground within this step

    def heights(fraction: ArrayLike) -> Array:
        return _heights(_cubic(fraction, values, rates, dt)[0][..., :3, :], pad)

    touches = np.any(heights(_CHECK_FRACTIONS) <= 0.0, axis=-1)
    if not touches.any():
        return None
    late = float(_CHECK_FRACTIONS[np.argmax(touches)])
    early = late - float(_CHECK_FRACTIONS[0])
    # Sixteen parts at a time down to rounding; it also works where heights jump at the pad's edge.
    for _ in range(13):
        fractions = early + (late - early) * _CHECK_FRACTIONS
        fractions[-1] = late
        first = int(np.argmax(np.any(heights(fractions) <= 0.0, axis=-1)))
        early, late = (fractions[first - 1] if first else early), float(fractions[first])
    return late, int(np.argmin(heights(late)))


def _touchdown(t: float, wheel: int, values: Array, rates: Array, pad: LandingPad) -> Touchdown:
    """The record of a contact from values and rates (5, 3) at its moment."""
    p_world_wheel, p_world, (pitch, yaw, roll) = values[wheel], values[3], values[4]
    surface: Surface = "floor"
    if _is_over(p_world_wheel, pad):
        surface = "pad" if p_world_wheel[2] > pad.height - _CONTACT_TOLERANCE else "pad edge"
    return Touchdown(
        t=float(t),
        wheel=WHEEL_NAMES[wheel],
        surface=surface,
        p_world_wheel=p_world_wheel,
        p_world=p_world,
        sink_rate=float(-rates[wheel, 2]),
        speed=float(np.linalg.norm(rates[3])),
        bank=float(wrap_angle(roll)),
        pitch=float(pitch),
        yaw=float(wrap_angle(yaw)),
        lateral_offset=float(p_world[1] - pad.y_centre),
        past_threshold=float(p_world_wheel[0] - pad.x_start),
    )


def _heights(p_world: Array, pad: LandingPad | None) -> Array:
    return np.asarray(p_world[..., 2] - pad_height(p_world, pad))


def _is_over(p_world: Array, pad: LandingPad) -> Array:
    along, across = p_world[..., 0] - pad.x_start, np.abs(p_world[..., 1] - pad.y_centre)
    return np.asarray((along >= 0.0) & (along <= pad.length) & (across <= pad.width / 2.0))


def _R_body_world(x: Array) -> Array:
    """(..., 3, 3); rows of body vectors times this are rows of world vectors."""
    return np.swapaxes(rotation_world_body(roll=x[..., 5], pitch=x[..., 3], yaw=x[..., 4]), -1, -2)


def _states(states: ArrayLike, *lengths: int) -> Array:
    """The states as float64; InputError unless the last axis has one of the lengths."""
    x = np.asarray(states, np.float64)
    if x.ndim == 0 or x.shape[-1] not in lengths:
        raise InputError(
            f"states: expected {' or '.join(map(str, lengths))} numbers a row, got shape {x.shape}"
        )
    return x
