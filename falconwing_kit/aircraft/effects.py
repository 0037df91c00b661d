"""Effects a flight may show and the base model lacks: each named, with its formula, units, bounds
and source.

An effect plugs in at one of three points: the sticks before they act, a force, moment or wind, or
the measured pose. Each has the interface of a term, so that adding one to the model or to this
catalogue is one function and its entry.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from falconwing_kit.aircraft.terms import WIND_PARAMETERS, Parameter, Term, WindTerm, uniform_wind
from falconwing_kit.core.checks import Array

GROUND_EFFECT_HEIGHT_M = 0.5  # about the span: where the cushion under a 0.7 m wing fades


@dataclass(frozen=True)
class Effect:
    """One candidate: what it is called, what it does, and where it plugs in."""

    name: str
    physics: str  # one plain sentence for a student, with its source
    parameters: tuple[Parameter, ...]
    term: Term | None = None  # force or moment
    wind: WindTerm | None = None
    sticks: Callable[[Array, Array, Any], Array] | None = (
        None  # (t, commands (N, 4), K) -> commands
    )
    pose: bool = False  # acts on the measured attitude
    starts: tuple[dict[str, float], ...] = ()  # further points a fit should begin at
    shape: tuple[
        str, ...
    ] = ()  # parameters that say where or when, and mean nothing while the amplitude is zero
    contains: tuple[
        str, ...
    ] = ()  # effects that this one becomes at some of its values; no rival to them
    essential: tuple[
        str, ...
    ] = ()  # parameters without which it is one of those, or nothing with a name
    # grows by itself from the start of the flight: what sets in at once is another effect
    gradual: bool = False
    acts_on: tuple[
        str, ...
        # what its loads or its error go to: two that share one may be each other's formula error
    ] = ()
    same_as: str = ""  # another effect with the same dynamics: no flight can tell them apart

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """The parameters that are zero when the effect is absent."""
        return tuple(p for p in self.parameters if p.name not in self.shape)


def _lift_along(air: Any, force: Any) -> tuple[Any, ...]:
    along = np.sqrt(air.u * air.u + air.w * air.w + 0.01)
    return force * air.w / along, 0.0, -force * air.u / along, 0.0, 0.0, 0.0


def _drag_along(air: Any, per_speed: Any) -> tuple[Any, ...]:
    return -per_speed * air.u, -per_speed * air.v, -per_speed * air.w, 0.0, 0.0, 0.0


def _both(a: tuple[Any, ...], b: tuple[Any, ...]) -> tuple[Any, ...]:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


def _lift_coefficient(air: Any, K: Any) -> Any:
    return K.cL_0 + K.cL_alpha * air.alpha + K.cL_de * air.elevator


def fan_jet(px: Any, py: Any, height: Any, time: Any, K: Any) -> tuple[Any, Any, Any]:
    """A round stream of air: (jet_x, jet_y) exp(-d^2 / 2 R^2), d the level distance from its
    middle.

    Args:
        px: (...) [m].
        py: (...) [m].
        height: (...) [m], unused.
        time: (...) [s], unused.
        K: parameters jet_x, jet_y [m/s], jet_at_x, jet_at_y, jet_radius [m].

    Returns:
        Wind along world x, y, z [m/s].
    """
    away = (px - K.jet_at_x) ** 2 + (py - K.jet_at_y) ** 2
    share = np.exp(-0.5 * away / (K.jet_radius * K.jet_radius))
    return K.jet_x * share, K.jet_y * share, 0.0


def ground_effect(air: Any, K: Any) -> tuple[Any, ...]:
    """Lift grows and induced drag falls near the floor, both as exp(-h / 0.5 m) [McCormick,
    Aerodynamics, ch. 7].

    Args:
        air: the flow.
        K: parameters ground_lift and ground_drag, shares of lift added and of induced drag lost at
            the floor.

    Returns:
        Loads.
    """
    near = np.exp(-np.maximum(air.height, 0.0) / GROUND_EFFECT_HEIGHT_M)
    coefficient = _lift_coefficient(air, K)
    lift = _lift_along(air, air.airspeed * air.airspeed * coefficient * K.ground_lift * near)
    return _both(
        lift,
        _drag_along(
            air, -air.airspeed * K.cD_induced * coefficient * coefficient * K.ground_drag * near
        ),
    )


def extra_drag(air: Any, K: Any) -> tuple[Any, ...]:
    """Something sticks out: more drag at zero lift, D/m = V^2 drag_added.

    Args:
        air: the flow.
        K: parameter drag_added [1/m].

    Returns:
        Loads.
    """
    return _drag_along(air, air.airspeed * K.drag_added)


def flap(air: Any, K: Any) -> tuple[Any, ...]:
    """A flap is out: more lift at the same angle, the induced drag of it, and drag of its own
    [Raymer, ch. 12].

    Args:
        air: the flow.
        K: parameters flap_lift, flap_drag [1/m].

    Returns:
        Loads.
    """
    lift = _lift_along(air, air.airspeed * air.airspeed * K.flap_lift)
    induced = K.cD_induced * K.flap_lift * (2.0 * (K.cL_0 + K.cL_alpha * air.alpha) + K.flap_lift)
    return _both(lift, _drag_along(air, air.airspeed * (K.flap_drag + induced)))


def thrust_loss(air: Any, K: Any) -> tuple[Any, ...]:
    """The propeller gives less: thrust (1 - loss).

    Args:
        air: the flow.
        K: parameter thrust_lost, a share.

    Returns:
        Loads.
    """
    return -K.thrust_lost * (K.kT - K.kTV * air.airspeed) * air.throttle, 0.0, 0.0, 0.0, 0.0, 0.0


def battery_sag(air: Any, K: Any) -> tuple[Any, ...]:
    """The battery empties: thrust (1 - sag t / 60 s).

    Args:
        air: the flow.
        K: parameter sag, the share lost per minute.

    Returns:
        Loads.
    """
    return (
        -K.sag * air.time / 60.0 * (K.kT - K.kTV * air.airspeed) * air.throttle,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    )


def propeller_torque(air: Any, K: Any) -> tuple[Any, ...]:
    """The propeller turns the aircraft: rolling and yawing moment with thrust [Phillips, Mechanics
    of Flight, ch. 2].

    Args:
        air: the flow.
        K: parameters torque_roll, torque_yaw [rad/s^2 per m/s^2].

    Returns:
        Loads.
    """
    thrust = (K.kT - K.kTV * air.airspeed) * air.throttle
    return 0.0, 0.0, 0.0, K.torque_roll * thrust, 0.0, K.torque_yaw * thrust


def adverse_yaw(air: Any, K: Any) -> tuple[Any, ...]:
    """Aileron pulls the nose the other way: dr/dt = -V^2 k aileron [Etkin & Reid, Dynamics of
    Flight, ch. 3].

    Args:
        air: the flow.
        K: parameter adverse_yaw [1/m^2], positive against the turn.

    Returns:
        Loads.
    """
    return 0.0, 0.0, 0.0, 0.0, 0.0, -air.airspeed * air.airspeed * K.adverse_yaw * air.aileron


def aileron_loss(air: Any, K: Any) -> tuple[Any, ...]:
    """Part of the aileron's effect is gone: L_da (1 - loss).

    Args:
        air: the flow.
        K: parameter aileron_lost, a share.

    Returns:
        Loads.
    """
    return (
        0.0,
        0.0,
        0.0,
        -air.airspeed * air.airspeed * K.aileron_lost * K.L_da * air.aileron,
        0.0,
        0.0,
    )


def mass_change(air: Any, K: Any) -> tuple[Any, ...]:
    """Added mass: every force per mass shrinks by 1 / (1 + mu), gravity stays.

    Args:
        air: the flow.
        K: parameter mass_added, the share mu.

    Returns:
        Loads.
    """
    V, c = air.airspeed, K.cL_0 + K.cL_alpha * air.alpha
    lift = _lift_along(air, V * V * _lift_coefficient(air, K))
    drag = _drag_along(air, V * (K.cD_0 + K.cD_induced * c * c + K.cD_beta * air.beta * air.beta))
    side = V * V * (K.cY_beta * air.beta + K.cY_dr * air.rudder)
    thrust = (K.kT - K.kTV * V) * air.throttle
    less = -K.mass_added / (1.0 + K.mass_added)
    return (
        less * (lift[0] + drag[0] + thrust), less * (drag[1] + side), less * (lift[2] + drag[2]), 0.0, 0.0, 0.0,
    )  # fmt: skip


def cg_shift(air: Any, K: Any) -> tuple[Any, ...]:
    """The centre of gravity moved back, and air forces turn the aircraft about it: lift nose up,
    side force sideways.

    dq/dt = s L/m, dr/dt = s (Iyy/Izz) Y/m, with Iyy/Izz = (1 - Jz)/(1 + Jy) from the inertia
    coupling [Beard & McLain, eq. 3.17].

    Args:
        air: the flow.
        K: parameters cg_moment s [1/m], lever over squared radius of gyration in pitch, positive
            back; Jy and Jz.

    Returns:
        Loads.
    """
    lever = air.airspeed * air.airspeed * K.cg_moment
    side = K.cY_beta * air.beta + K.cY_dr * air.rudder
    return (
        0.0,
        0.0,
        0.0,
        0.0,
        lever * _lift_coefficient(air, K),
        lever * (1.0 - K.Jz) / (1.0 + K.Jy) * side,
    )


def stall(air: Any, K: Any) -> tuple[Any, ...]:
    """Beyond an angle of attack the lift grows no more and drag comes: smooth step of 2 deg [Beard
    & McLain, eq. 4.10].

    Args:
        air: the flow.
        K: parameters stall_alpha [rad], stall_loss, the share of the lift slope that is lost.

    Returns:
        Loads.
    """
    width = 0.035
    beyond = width * np.logaddexp(0.0, (air.alpha - K.stall_alpha) / width)
    lost = K.stall_loss * K.cL_alpha * beyond
    lift = _lift_along(air, -air.airspeed * air.airspeed * lost)
    return _both(
        lift,
        _drag_along(air, air.airspeed * lost * np.tan(np.minimum(np.maximum(air.alpha, 0.0), 1.0))),
    )


def trim_bias(t: Array, commands: Array, K: Any) -> Array:
    """The sticks' neutral has moved.

    Args:
        t: (N,) [s], unused.
        commands: (N, 4).
        K: parameters bias_aileron, bias_elevator, bias_rudder, shares of full stick.

    Returns:
        (N, 4).
    """
    return commands + np.array([0.0, K.bias_aileron, K.bias_elevator, K.bias_rudder])


def deadband(t: Array, commands: Array, K: Any) -> Array:
    """Small stick movements do nothing: what is within the band counts as neutral, the rest is not
    shifted.

    Args:
        t: (N,) [s], unused.
        commands: (N, 4).
        K: parameter deadband, a share of full stick.

    Returns:
        (N, 4); throttle as it was. The edge is smooth over a tenth of the band so that a fit can
        find it.
    """
    size = np.abs(commands[:, 1:])
    width = 0.1 * K.deadband + 1e-6
    passed = 1.0 / (1.0 + np.exp(np.clip((K.deadband - size) / width, -50.0, 50.0)))
    if K.deadband <= 0.0:
        return commands
    return np.concatenate([commands[:, :1], commands[:, 1:] * passed], axis=1)


def _force(name: str, physics: str, function: Any, *parameters: Parameter, **more: Any) -> Effect:
    return Effect(name, physics, parameters, term=Term(name, parameters, function), **more)


_WIND = tuple(replace(p, start=0.3) for p in WIND_PARAMETERS)
_JET = (
    Parameter("jet_x", 0.3, -8.0, 8.0, "m/s", "stream along world x at its middle"),
    Parameter("jet_y", 0.3, -8.0, 8.0, "m/s", "stream along world y at its middle"),
    Parameter("jet_at_x", 0.0, -60.0, 60.0, "m", "middle of the stream"),
    Parameter("jet_at_y", 0.0, -60.0, 60.0, "m", "middle of the stream"),
    Parameter("jet_radius", 2.5, 0.7, 8.0, "m", "how wide the stream is"),
)
_STICKS = ("sticks", "roll", "pitch", "yaw")

CATALOGUE: tuple[Effect, ...] = (
    Effect(
        "wind", "The air as a whole moves: the wings feel a velocity that is not the one over the floor.",
        _WIND, wind=WindTerm("wind", _WIND, uniform_wind), acts_on=("air",),
    ),
    Effect(
        "fan_jet", "A fan blows through one part of the hall only.", _JET,
        wind=WindTerm("fan_jet", _JET, fan_jet), shape=("jet_at_x", "jet_at_y", "jet_radius"),
        contains=("wind",), acts_on=("air",),
    ),
    _force(
        "ground_effect", "Close to the floor the air under the wing cannot get away: more lift, less induced drag.",
        ground_effect,
        Parameter("ground_lift", 0.1, 0.0, 2.0, "-", "share of lift added at the floor"),
        Parameter("ground_drag", 0.2, -4.0, 1.5, "-", "share of induced drag lost at the floor"),
        essential=("ground_lift",), acts_on=("lift", "along"),
    ),
    _force(
        "extra_drag", "Something sticks out into the air: drag grows with the square of speed at any throttle.",
        extra_drag, Parameter("drag_added", 0.003, 0.0, 0.3, "1/m", "drag added at zero lift"),
        acts_on=("along",),
    ),
    _force(
        "flap", "A flap is out: more lift at the same angle, and more drag.",
        flap,
        Parameter("flap_lift", 0.01, 0.0, 0.4, "1/m", "lift added at any angle"),
        Parameter("flap_drag", 0.001, 0.0, 0.2, "1/m", "drag that comes with it"),
        contains=("extra_drag",), essential=("flap_lift",), acts_on=("lift", "along"),
    ),
    _force(
        "thrust_loss", "The propeller gives less thrust at the same throttle.",
        thrust_loss, Parameter("thrust_lost", 0.05, 0.0, 1.5, "-", "share of the thrust that is gone"),
        acts_on=("thrust", "along"),
    ),
    _force(
        "battery_sag", "The battery's voltage falls during the flight, and thrust with it.",
        battery_sag, Parameter("sag", 0.05, 0.0, 1.0, "1/min", "share of the thrust lost per minute"),
        gradual=True, acts_on=("thrust", "along"),
    ),
    _force(
        "propeller_torque", "The propeller turns the aircraft against its own rotation, in step with thrust.",
        propeller_torque,
        Parameter("torque_roll", 0.05, -5.0, 5.0, "1/m", "rolling moment per thrust"),
        Parameter("torque_yaw", 0.05, -5.0, 5.0, "1/m", "yawing moment per thrust"),
        acts_on=("roll", "yaw"),
    ),
    _force(
        "adverse_yaw", "The wing with more lift has more drag: aileron pulls the nose out of the turn.",
        adverse_yaw, Parameter("adverse_yaw", 0.02, -2.0, 2.0, "1/m^2", "yawing moment of aileron, against the turn"),
        acts_on=("yaw",),
    ),
    Effect(
        "control_delay", "What the sticks command acts later than before.",
        (Parameter("control_delay", 0.02, -0.05, 0.4, "s", "delay added between command and servo"),),
        starts=({"control_delay": 0.1}, {"control_delay": 0.2}, {"control_delay": -0.01}),
        acts_on=_STICKS,
    ),
    Effect(
        "actuator_lag", "The servos follow more slowly than before.",
        (Parameter("actuator_lag", 0.02, 0.0, 0.6, "s", "time constant added to servo and propeller"),),
        starts=({"actuator_lag": 0.1},), acts_on=_STICKS,
    ),
    # the same effect in its other form: not the servo itself is slower, something follows it slowly
    Effect(
        "actuator_lag", "What follows the servos, a linkage or the motor, has become slow.",
        (Parameter("lag_in_series", 0.02, 0.0, 0.6, "s", "time constant of what follows the servo"),),
        starts=({"lag_in_series": 0.1},), acts_on=_STICKS,
    ),
    Effect(
        "trim_bias", "The neutral of the sticks has moved.",
        tuple(
            Parameter(f"bias_{stick}", 0.01, -0.5, 0.5, "-", f"{stick} added at neutral, share of full stick")
            for stick in ("aileron", "elevator", "rudder")
        ),
        sticks=trim_bias, acts_on=("roll", "pitch", "yaw"),
    ),
    Effect(
        "deadband", "Small stick movements no longer reach the control surfaces.",
        (Parameter("deadband", 0.03, 0.0, 0.4, "-", "share of full stick that does nothing"),),
        sticks=deadband, starts=({"deadband": 0.08}, {"deadband": 0.15}), acts_on=_STICKS,
    ),
    _force(
        "aileron_loss", "An aileron moves less, or one of the two not at all.",
        aileron_loss, Parameter("aileron_lost", 0.05, 0.0, 1.0, "-", "share of the aileron's moment that is gone"),
        acts_on=("roll",),
    ),
    _force(
        "mass_change", "The aircraft is heavier: every force bends its path less, only gravity pulls as before.",
        mass_change, Parameter("mass_added", 0.03, -0.4, 1.0, "-", "share of the mass added"),
        acts_on=("lift", "along", "side"),
    ),
    _force(
        "cg_shift", "The centre of gravity has moved along the fuselage, and lift turns the nose about it.",
        cg_shift, Parameter("cg_moment", 0.05, -5.0, 5.0, "1/m", "lever of the lift, positive with the mass behind"),
        acts_on=("pitch", "yaw"),
    ),
    Effect(
        "camera_tilt", "The camera looks in another direction than before; the aircraft flies as ever.",
        (
            Parameter("tilt_pitch", 0.01, -0.4, 0.4, "rad", "camera turned up in the body"),
            Parameter("tilt_roll", 0.01, -0.4, 0.4, "rad", "camera turned about the nose, right side down"),
        ),
        pose=True, acts_on=("camera",),
    ),
    Effect(
        "time_offset", "The images carry time stamps that are late; the flight shows the same as a control delay.",
        (), same_as="control_delay",
    ),
    _force(
        "stall", "At high angle of attack the flow leaves the wing: lift stays behind and drag comes.",
        stall,
        Parameter("stall_alpha", 0.20, 0.08, 0.5, "rad", "angle of attack where it begins"),
        Parameter("stall_loss", 0.3, 0.0, 2.0, "-", "share of the lift slope lost beyond"),
        starts=({"stall_alpha": 0.13}, {"stall_alpha": 0.17}), shape=("stall_alpha",),
        acts_on=("lift", "along", "pitch"),
    ),
)  # fmt: skip
EFFECT_NAMES = tuple(dict.fromkeys(effect.name for effect in CATALOGUE))
