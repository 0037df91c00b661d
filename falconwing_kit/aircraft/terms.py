"""Terms of f_K: the air flow at the aircraft -> forces and moments, one function per term.

The model is the sum of the terms in a plain tuple. Every value is per unit mass (or inertia),
because poses alone cannot separate mass from air density times wing area: a force is an
acceleration [m/s^2], a moment an angular acceleration [rad/s^2]. Each function is plain arithmetic
on numbers or arrays, so the same source runs batched in NumPy and compiled for a single flight.

Dimensional derivatives after Beard & McLain, Small Unmanned Aircraft, ch. 4: stability derivatives
keep the textbook's signs; control derivatives of elevator and rudder are reversed, because commands
are positive nose up / nose right.

    c        lower case: c = rho S C / (2 m) with the textbook's C, so that force per mass = V^2 c;
             cL_alpha in 1/(m rad) is rho S C_L_alpha / (2 m); cD_induced multiplies
             (cL_0 + cL_alpha alpha)^2, without the lift of the elevator
    L M N    rolling, pitching and yawing moment per inertia, divided by V^2, or by V where a body
             rate multiplies it, as the term's formula shows: the textbook's C_l, C_m, C_n scaled;
             L_p is C_l_p scaled by rho S b^2 / (4 Ixx), L_da is C_l_da by rho S b / (2 Ixx)
    _0       at zero angles, rates and commands; _alpha, _beta of an angle [1/rad]
    _p _q _r of a body rate; _da of full aileron, _de of full elevator, _dr of full rudder
    Jx Jy Jz (Iyy - Izz)/Ixx, (Izz - Ixx)/Iyy, (Ixx - Iyy)/Izz

An ordinary stable aircraft has L_beta, L_p, M_alpha, M_q, N_r and cY_beta below zero and N_beta
above, as in the textbook. Commands are positive for right wing down, nose up and nose right, so
L_da, M_de and N_dr are above zero. A positive elevator deflection of the textbook lowers the nose
and a positive rudder deflection turns it left: its C_m_de and C_n_dr are below zero (and C_L_de,
C_Y_dr change alike).

A term that a flight may need and the model lacks is an effect: one file in `aircraft/effects`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

# Force along body x, y, z [m/s^2], then moment about them [rad/s^2].
Loads = tuple[Any, Any, Any, Any, Any, Any]


@dataclass(frozen=True)
class Parameter:
    """One unknown of the model: where a fit starts and within which bounds it stays."""

    name: str
    start: float  # where a fit starts: a 150 g aircraft at 7 m/s
    low: float  # smallest value that makes physical sense
    high: float  # largest value that makes physical sense
    unit: str
    meaning: str


class Flow(NamedTuple):
    """The air flow and the motion at the aircraft; each field a number or an array of one shape."""

    airspeed: Any  # V, speed through the air [m/s]
    alpha: Any  # angle of attack [rad], positive nose above the flight path
    beta: Any  # sideslip [rad], positive with the wind from the right
    u: Any  # air-relative velocity along the nose [m/s]
    v: Any  # ... along the right wing
    w: Any  # ... along the belly
    p: Any  # roll rate [rad/s]
    q: Any  # pitch rate
    r: Any  # yaw rate
    px: Any  # position in the world [m]
    py: Any
    height: Any
    time: Any  # since the start of the flight [s]
    throttle: Any  # 0..1, after delay and servo
    aileron: Any  # -1..1
    elevator: Any
    rudder: Any
    roll: Any = 0.0  # attitude over the floor [rad]
    pitch: Any = 0.0


@dataclass(frozen=True)
class Term:
    """A named part of the forces and moments: loads = evaluate(air, K)."""

    name: str
    parameters: tuple[Parameter, ...]
    evaluate: Callable[[Flow, Any], Loads]
    of_propeller: bool = False  # a load that the propeller gives: thrust, its torque, its wash


@dataclass(frozen=True)
class WindTerm:
    """A named part of the wind in world axes [m/s]: evaluate(px, py, height, time, K)."""

    name: str
    parameters: tuple[Parameter, ...]
    evaluate: Callable[[Any, Any, Any, Any, Any], tuple[Any, Any, Any]]


def air_flow(velocity_body, rates, position, time, command, attitude=(0.0, 0.0)):
    """Airspeed and flow angles of an air-relative velocity [Beard & McLain, eq. 2.8].

    V = |(u, v, w)|, alpha = atan2(w, u), beta = asin(v / V); 0.1 m/s is added to V in quadrature,
    so that the angles stay defined at rest.

    Args:
        velocity_body: u, v, w through the air, body axes, each (...) [m/s].
        rates: p, q, r, each (...) [rad/s].
        position: px, py, pz in the world, each (...) [m].
        time: (...) [s].
        command: throttle, aileron, elevator, rudder, each (...).
        attitude: roll and pitch, each (...) [rad].
    """
    u, v, w = velocity_body
    airspeed = np.sqrt(u * u + v * v + w * w + 0.01)
    return Flow(
        airspeed, np.arctan2(w, u), np.arcsin(v / airspeed), u, v, w, rates[0], rates[1], rates[2],
        position[0], position[1], position[2], time, command[0], command[1], command[2], command[3],
        attitude[0], attitude[1],
    )  # fmt: skip


# Directions and sums


def lift_loads(air, force):
    """A force at right angles to the flight path, in the plane of symmetry, upward positive."""
    per_speed = force / np.sqrt(air.u * air.u + air.w * air.w + 0.01)
    return per_speed * air.w, 0.0, -per_speed * air.u, 0.0, 0.0, 0.0


def drag_loads(air, per_speed):
    """A force against the flight path, given per unit of airspeed [1/s]."""
    back = -per_speed
    return back * air.u, back * air.v, back * air.w, 0.0, 0.0, 0.0


def add_loads(a, b):
    """Sum of two loads."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


def sum_loads(functions: Sequence[Callable[[Flow, Any], Loads]]) -> Callable[[Flow, Any], Loads]:
    """One function that adds the loads of several, pairwise, so that it also compiles."""
    first, *others = functions
    if not others:
        return first
    rest = sum_loads(others)

    def total(air, K):
        return add_loads(first(air, K), rest(air, K))

    return total


def propeller_loads(terms: Sequence[Term]) -> Callable[[Flow, Any], Loads]:
    """What the propeller gives among these terms; its force along the nose is the thrust T/m."""
    return sum_loads([term.evaluate for term in terms if term.of_propeller])


def propeller_share(terms: Sequence[Term]) -> Callable[[Any, Flow, Any], Loads]:
    """The same times a share, as (share, air, K) -> loads; thrust alone has no other components."""
    loads = propeller_loads(terms)

    def of_thrust(share, air, K):
        return share * loads(air, K)[0], 0.0, 0.0, 0.0, 0.0, 0.0

    def of_all(share, air, K):
        a = loads(air, K)
        return share * a[0], share * a[1], share * a[2], share * a[3], share * a[4], share * a[5]

    names = {term.name for term in terms if term.of_propeller}
    return of_thrust if names <= {"thrust", THRUST_CURVE.name} else of_all


# Forces


def lift_coefficient(air, K):
    """cL_0 + cL_alpha alpha + cL_de elevator: lift per V^2, linear below stall."""
    return K.cL_0 + K.cL_alpha * air.alpha + K.cL_de * air.elevator


def lift(air, K):
    """L/m = V^2 (cL_0 + cL_alpha alpha + cL_de elevator) [Beard & McLain, eq. 4.6].

    Linear below stall, at right angles to the flight path in the plane of symmetry.
    """
    return lift_loads(air, air.airspeed * air.airspeed * lift_coefficient(air, K))


def drag(air, K):
    """D/m = V^2 (cD_0 + cD_induced c^2 + cD_beta beta^2), c = cL_0 + cL_alpha alpha.

    A parabolic polar, and the fuselage's drag in a sideslip [Beard & McLain, eq. 4.11].
    """
    c = K.cL_0 + K.cL_alpha * air.alpha
    return drag_loads(
        air, air.airspeed * (K.cD_0 + K.cD_induced * c * c + K.cD_beta * air.beta * air.beta)
    )


def side_force(air, K):
    """Along the right wing: Y/m = V^2 (cY_beta beta + cY_dr rudder) [Beard & McLain, eq. 4.14]."""
    force = air.airspeed * air.airspeed * (K.cY_beta * air.beta + K.cY_dr * air.rudder)
    return 0.0, force, 0.0, 0.0, 0.0, 0.0


def thrust(air, K):
    """Along the nose: T/m = (kT - kTV V) throttle [Beard & McLain, eq. 4.18, linearised]."""
    return (K.kT - K.kTV * air.airspeed) * air.throttle, 0.0, 0.0, 0.0, 0.0, 0.0


def thrust_curve(air, K):
    """Along the nose: T/m grows by kTT throttle^2 beyond its linear part [Beard & McLain, 4.13].

    Without it a fit takes the slope at the usual throttle for thrust per throttle: thrust and drag
    come out too large together, by a factor of up to two, and a share of the thrust too small.
    """
    return K.kTT * air.throttle * air.throttle, 0.0, 0.0, 0.0, 0.0, 0.0


# Moments of the 12-state model


def roll_moment(air, K):
    """dp/dt = V^2 (L_0 + L_da aileron + L_beta beta) + V L_p p + V L_r r.

    [Beard & McLain, eq. 5.10]
    """
    V = air.airspeed
    static = K.L_0 + K.L_da * air.aileron + K.L_beta * air.beta
    return 0.0, 0.0, 0.0, V * (V * static + K.L_p * air.p + K.L_r * air.r), 0.0, 0.0


def pitch_moment(air, K):
    """dq/dt = V^2 (M_0 + M_de elevator + M_alpha alpha) + V M_q q [Beard & McLain, eq. 5.11]."""
    V = air.airspeed
    static = K.M_0 + K.M_de * air.elevator + K.M_alpha * air.alpha
    return 0.0, 0.0, 0.0, 0.0, V * (V * static + K.M_q * air.q), 0.0


def yaw_moment(air, K):
    """dr/dt = V^2 (N_0 + N_dr rudder + N_beta beta) + V N_r r + V N_p p.

    [Beard & McLain, eq. 5.12]
    """
    V = air.airspeed
    static = K.N_0 + K.N_dr * air.rudder + K.N_beta * air.beta
    return 0.0, 0.0, 0.0, 0.0, 0.0, V * (V * static + K.N_r * air.r + K.N_p * air.p)


def gyroscopic_moment(air, K):
    """Inertia coupling of the three rates: (Jx q r, Jy p r, Jz p q) [Beard & McLain, eq. 3.17]."""
    return 0.0, 0.0, 0.0, K.Jx * air.q * air.r, K.Jy * air.p * air.r, K.Jz * air.p * air.q


def cross_moments(air, K):
    """dp/dt = V^2 L_dr rudder + Gamma_1 p q, dq/dt = -Gamma_6 (p^2 - r^2),
    dr/dt = V^2 N_da aileron - Gamma_1 q r: what controls and rates do across the axes.

    Adverse yaw, and a product of inertia, by which the rolling moment also turns the nose [Beard &
    McLain, eq. 3.13 and 5.23 to 5.28]. Large for flying wings.
    """
    pressure = air.airspeed * air.airspeed
    return (
        0.0, 0.0, 0.0,
        pressure * K.L_dr * air.rudder + K.Gamma_1 * air.p * air.q,
        -K.Gamma_6 * (air.p * air.p - air.r * air.r),
        pressure * K.N_da * air.aileron - K.Gamma_1 * air.q * air.r,
    )  # fmt: skip


def roll_of_yawing_moment(terms: Sequence[Term]) -> Callable[[Any], Any]:
    """How much a yawing moment rolls the aircraft, K -> (dp/dt) / (dr/dt).

    Jxz / Ixx = Gamma_1 / (1 + Jz) where the model has cross moments, else zero: both follow from
    Gamma_1 and Gamma_7 of Beard & McLain, eq. 3.13, whose Gamma_7 is Jz here.
    """

    def coupled(K):
        return K.Gamma_1 / (1.0 + K.Jz)

    def apart(K):
        return 0.0

    return coupled if CROSS_MOMENTS in terms else apart


def attitude_hold(air, K):
    """dp/dt = V^2 L_phi roll, dq/dt = V^2 M_theta pitch: a stabiliser on board.

    It moves aileron and elevator against bank and pitch, in proportion, so that the sticks command
    angles; its damping of rates adds to L_p and M_q [Beard & McLain, ch. 6: attitude loops].
    """
    pressure = air.airspeed * air.airspeed
    return 0.0, 0.0, 0.0, pressure * K.L_phi * air.roll, pressure * K.M_theta * air.pitch, 0.0


# Rates of the 9-state model


def quasi_steady_rates(air, K):
    """Body rates that follow the commands immediately; the moment slots hold p, q, r [rad/s].

        p = V (L_0 + L_da aileron + L_beta beta)
        q = V (M_0 + M_de elevator + M_alpha alpha)
        r = V (N_0 + N_dr rudder + N_beta beta)

    The moments above with their angular accelerations set to zero [paper, Section IV-B: nine
    states, no rates]. In the 9-state model the same names are therefore rate coefficients, in 1/m
    instead of 1/m^2: with cross terms neglected, L_da here is -L_da / L_p of the 12-state model.
    """
    V = air.airspeed
    p = V * (K.L_0 + K.L_da * air.aileron + K.L_beta * air.beta)
    q = V * (K.M_0 + K.M_de * air.elevator + K.M_alpha * air.alpha)
    r = V * (K.N_0 + K.N_dr * air.rudder + K.N_beta * air.beta)
    return 0.0, 0.0, 0.0, p, q, r


def uniform_wind(px, py, height, time, K):
    """The same level wind everywhere: (wind_x, wind_y, 0), where the air moves to."""
    return K.wind_x, K.wind_y, 0.0


# Each parameter: name, start, low, high, unit, meaning. Starts are a 150 g aircraft at 7 m/s;
# bounds are wide enough for aircraft from 50 g to 10 kg. Stability derivatives keep the textbook's
# signs, control derivatives of elevator and rudder are reversed: see the head of this file.

_LIFT = (
    Parameter("cL_0", 0.078, -0.2, 0.6, "1/m", "lift at zero angle of attack"),
    Parameter("cL_alpha", 1.40, 0.05, 6.0, "1/(m rad)", "lift slope"),
    Parameter("cL_de", 0.0, -1.0, 1.0, "1/m", "lift of full elevator"),
)
_DRAG = (
    Parameter("cD_0", 0.0155, 0.0, 0.3, "1/m", "drag at zero lift"),
    Parameter("cD_induced", 0.2, 0.0, 10.0, "m", "induced drag per lift squared"),
)
_SIDESLIP_DRAG = (Parameter("cD_beta", 0.05, -3.0, 5.0, "1/(m rad^2)", "drag in a sideslip"),)
_SIDE = (
    Parameter("cY_beta", -0.25, -4.0, 0.5, "1/(m rad)", "side force of sideslip"),
    Parameter("cY_dr", 0.0, -1.0, 1.0, "1/m", "side force of full rudder"),
)
_THRUST = (
    Parameter("kT", 9.0, 0.0, 60.0, "m/s^2", "thrust at full throttle, standing"),
    Parameter("kTV", 0.5, -2.0, 8.0, "1/s", "thrust lost with speed"),
)
_THRUST_CURVE = (
    Parameter("kTT", 0.0, -60.0, 60.0, "m/s^2", "thrust that grows with throttle squared"),
)
# L_p and M_q stay where steps of 25 ms follow them: below -10 at 7 m/s a rate decays in 14 ms.
_ROLL = (
    Parameter("L_0", 0.0, -1.0, 1.0, "1/m^2", "rolling moment at zero angles"),
    Parameter("L_da", 0.75, 0.0, 10.0, "1/m^2", "rolling moment of full aileron"),
    Parameter("L_beta", -0.30, -20.0, 3.0, "1/(m^2 rad)", "dihedral effect, stable below zero"),
    Parameter("L_p", -2.0, -10.0, -0.05, "1/m", "roll damping, stable below zero"),
    Parameter("L_r", 0.3, -4.0, 10.0, "1/m", "roll due to yaw rate"),
)
_PITCH = (
    Parameter("M_0", 0.17, -1.0, 2.0, "1/m^2", "pitching moment at zero angles"),
    Parameter("M_de", 0.6, 0.0, 6.0, "1/m^2", "pitching moment of full elevator"),
    Parameter("M_alpha", -2.0, -20.0, 1.0, "1/(m^2 rad)", "pitch stiffness, stable below zero"),
    Parameter("M_q", -1.1, -10.0, 0.0, "1/m", "pitch damping, stable below zero"),
)
_YAW = (
    Parameter("N_0", 0.0, -1.0, 1.0, "1/m^2", "yawing moment at zero angles"),
    Parameter("N_dr", 0.23, -0.5, 4.0, "1/m^2", "yawing moment of full rudder"),
    Parameter(
        "N_beta", 0.73, -1.0, 10.0, "1/(m^2 rad)", "weathercock stiffness, stable above zero"
    ),
    Parameter("N_r", -0.4, -8.0, 0.5, "1/m", "yaw damping, stable below zero"),
    Parameter("N_p", -0.05, -3.0, 3.0, "1/m", "yaw due to roll rate"),
)
_GYROSCOPIC = (
    Parameter("Jx", -0.5, -1.5, 0.5, "-", "(Iyy - Izz)/Ixx"),
    Parameter("Jy", 0.7, -0.5, 1.5, "-", "(Izz - Ixx)/Iyy"),
    Parameter("Jz", -0.4, -1.5, 0.8, "-", "(Ixx - Iyy)/Izz"),
)
_CROSS_MOMENTS = (
    Parameter("L_dr", 0.0, -5.0, 5.0, "1/m^2", "roll acceleration of full rudder"),
    Parameter("N_da", 0.0, -5.0, 5.0, "1/m^2", "yaw acceleration of full aileron"),
    Parameter("Gamma_1", 0.0, -20.0, 20.0, "-", "product of inertia: roll with p q, yaw with q r"),
    Parameter("Gamma_6", 0.0, -20.0, 20.0, "-", "product of inertia: pitch with p^2 and r^2"),
)
_ATTITUDE_HOLD = (
    Parameter("L_phi", -0.5, -10.0, 0.0, "1/(m^2 rad)", "rolling moment of a stabiliser with bank"),
    Parameter("M_theta", -0.5, -10.0, 0.0, "1/(m^2 rad)", "pitching moment of a stabiliser"),
)
_QUASI_STEADY = (
    Parameter("L_0", 0.0, -1.0, 1.0, "1/m", "roll rate at zero angles"),
    Parameter("L_da", 0.37, 0.0, 4.0, "1/m", "roll rate of full aileron"),
    Parameter("L_beta", -0.15, -4.0, 2.0, "1/(m rad)", "roll rate of sideslip"),
    Parameter("M_0", 0.106, -1.0, 1.0, "1/m", "pitch rate at zero angles"),
    Parameter("M_de", 0.35, 0.0, 4.0, "1/m", "pitch rate of full elevator"),
    Parameter("M_alpha", -1.2, -8.0, 0.5, "1/(m rad)", "pitch rate of angle of attack"),
    Parameter("N_0", 0.0, -1.0, 1.0, "1/m", "yaw rate at zero angles"),
    Parameter("N_dr", 0.25, -0.5, 2.0, "1/m", "yaw rate of full rudder"),
    Parameter("N_beta", 0.8, -0.5, 6.0, "1/(m rad)", "yaw rate of sideslip"),
)
WIND_PARAMETERS = (
    Parameter("wind_x", 0.0, -15.0, 15.0, "m/s", "wind along world x"),
    Parameter("wind_y", 0.0, -15.0, 15.0, "m/s", "wind along world y"),
)

FORCES = (
    Term("lift", _LIFT, lift),
    Term("drag", _DRAG + _SIDESLIP_DRAG, drag),
    Term("side_force", _SIDE, side_force),
    Term("thrust", _THRUST, thrust, of_propeller=True),
)
MOMENTS = (
    Term("roll_moment", _ROLL, roll_moment),
    Term("pitch_moment", _PITCH, pitch_moment),
    Term("yaw_moment", _YAW, yaw_moment),
    Term("gyroscopic_moment", _GYROSCOPIC, gyroscopic_moment),
)
QUASI_STEADY_RATES = (Term("quasi_steady_rates", _QUASI_STEADY, quasi_steady_rates),)
# With a product of inertia the three ratios of inertia have no bounds of their own.
UNBOUNDED_GYROSCOPIC = Term(
    "gyroscopic_moment",
    tuple(replace(p, start=0.0, low=-20.0, high=20.0) for p in _GYROSCOPIC),
    gyroscopic_moment,
)
THRUST_CURVE = Term("thrust_curve", _THRUST_CURVE, thrust_curve, of_propeller=True)
CROSS_MOMENTS = Term("cross_moments", _CROSS_MOMENTS, cross_moments)
ATTITUDE_HOLD = Term("attitude_hold", _ATTITUDE_HOLD, attitude_hold)
UNIFORM_WIND = WindTerm("uniform_wind", WIND_PARAMETERS, uniform_wind)
