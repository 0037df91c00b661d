"""Foreign aircraft: published parameter sets -> rigid bodies that fly by the textbook, for tests.

None of this is the kit's model. The equations are those of Beard and McLain, Small Unmanned
Aircraft (2012), ch. 3 and 4: north-east-down axes, a quaternion, body velocities, the full inertia
with Jxz, coefficients on wing area, span and chord, lift and drag blended into a flat plate's by a
sigmoid, thrust quadratic in throttle and speed or from a motor's equations. One aircraft has tables
instead of coefficients. Everything here is simulated, nothing is measured.

Frames: inside this file north, east, down [m] and quaternions; `kit_states` gives what the kit
calls world (x north, y west, z up) and roll, pitch, yaw. Surface deflections carry the textbook's
signs (elevator trailing edge down and rudder trailing edge left positive); commands carry the kit's
(right wing down, nose up, nose right), so elevator and rudder turn round between the two.

`python -m tests.benchmarks.foreign_aircraft --aircraft zagi --effect wind --out DIR` writes pairs.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
GRAVITY = 9.81  # m/s^2, north-east-down axes: along +z
RHO = 1.225  # kg/m^3
# State of the integration: position, quaternion, body velocity, body rates, servo positions and a
# second lag behind each servo, both in commands (throttle, aileron, elevator, rudder).
POSITION, QUATERNION, VELOCITY, RATES = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
SERVO, LINKAGE, STATES = slice(13, 17), slice(17, 21), 21
QUADRATIC, MOTOR, INCOMING = 0.0, 1.0, 2.0  # forms of thrust, see `propeller`


class Body(NamedTuple):
    """One aircraft; coefficients as in Beard and McLain, table E.2, all plain numbers in SI units.

    Names: C_m_q is Cmq; `da`, `de`, `dr` are aileron, elevator and rudder [rad].
    """

    mass: float
    Jx: float
    Jy: float
    Jz: float
    Jxz: float
    wing_area: float
    span: float
    chord: float
    rho: float
    # longitudinal
    CL0: float
    CLa: float
    CLq: float
    CLde: float
    CD0: float  # parasitic
    k: float  # induced: times (CL0 + CLa alpha)^2
    CDa: float
    CDa2: float
    CDb2: float
    CDde: float  # times |de|
    Cm0: float
    Cma: float
    Cmq: float
    Cmde: float
    stall_alpha: float  # the sigmoid's middle
    stall_M: float  # and its steepness
    # lateral
    CYb: float
    CYp: float
    CYr: float
    CYda: float
    CYdr: float
    Cl0: float
    Clb: float
    Clp: float
    Clr: float
    Clda: float
    Cldr: float
    Cn0: float
    Cnb: float
    Cnp: float
    Cnr: float
    Cnda: float
    Cndr: float
    # propeller, see `propeller`
    thrust_form: float
    disc: float  # area of the propeller's disc [m^2]
    C_prop: float
    k_motor: float  # speed of the outgoing air at full throttle [m/s]
    torque_arm: float  # torque of the propeller per thrust [m], rolls the aircraft to the left
    # what moves the surfaces
    da_max: float  # deflection at full command [rad]
    de_max: float
    dr_max: float
    servo: float  # time constant [s]
    motor: float  # of the motor [s]
    delay: float  # from command to servo [s]
    tabulated: float = 0.0  # 1: static coefficients from tables
    # a motor by its equations, Beard and McLain, 2nd edition, eq. 4.15 to 4.20
    diameter: float = 0.0
    motor_constant: float = 0.0  # K_V = K_Q [V s]
    resistance: float = 0.0
    no_load: float = 0.0  # current [A]
    voltage: float = 0.0
    CT0: float = 0.0
    CT1: float = 0.0
    CT2: float = 0.0
    CQ0: float = 0.0
    CQ1: float = 0.0
    CQ2: float = 0.0


class Hidden(NamedTuple):
    """Strengths of everything that can be hidden; all zero is an ordinary flight."""

    onset: float = -1.0  # s; what is hidden acts from here on
    ramp: float = 0.0  # s in which it grows to its full strength
    until: float = 1e9  # s; and to here
    wind_north: float = 0.0
    wind_east: float = 0.0
    jet_north: float = 0.0
    jet_east: float = 0.0
    jet_at_north: float = 0.0
    jet_at_east: float = 0.0
    jet_half_width: float = 1.0
    image_vortex: float = 0.0  # ground effect: 1 as theory has it
    CD_added: float = 0.0
    CL_added: float = 0.0
    thrust_lost: float = 0.0
    sag_per_s: float = 0.0  # share of the supply voltage lost per second
    sag_from: float = 0.0  # s
    torque_roll: float = 0.0  # rolling moment per thrust [m]
    torque_yaw: float = 0.0
    Cnda_added: float = 0.0
    aileron_lost: float = 0.0
    mass_added: float = 0.0
    cg_back: float = 0.0  # m
    separation_alpha: float = 0.0  # stall: where the flow has separated from half the chord
    separation: float = 0.0  # share of the wing that stalls
    servo_added: float = 0.0  # s
    linkage: float = 0.0  # s
    delay_added: float = 0.0  # s
    bias_aileron: float = 0.0  # commands
    bias_elevator: float = 0.0
    bias_rudder: float = 0.0
    deadband: float = 0.0
    # in no catalogue
    rudder_roll: float = 0.0  # Cl per rad of rudder and per V / V_trim
    prop_wash: float = 0.0  # elevator effectiveness added per throttle above trim
    Cmb: float = 0.0  # pitching moment of sideslip
    wing_drag: float = 0.0  # CD of the right wing alone, at half its semispan
    aeroelastic_roll: float = 0.0  # Cl times (V / V_trim)^2 - 1
    thrust_line: float = 0.0  # thrust passes below the centre of gravity by this [m]
    V_trim: float = 1.0
    throttle_trim: float = 0.0


CALM = Hidden()


@njit(cache=True)
def acting(hidden, time):
    """Share 0 to 1 of what is hidden that acts at a time [s]."""
    if time < hidden.onset or time >= hidden.until:
        return 0.0
    return 1.0 if hidden.ramp <= 0.0 else min((time - hidden.onset) / hidden.ramp, 1.0)


# Equations of motion
# --------------------------------------------------------------------------------------------------


@njit(cache=True)
def propeller(body, throttle, airspeed, sag):
    """Thrust [N] and torque [N m] of the propeller; `sag` is the share of the voltage lost.

    QUADRATIC  T = 1/2 rho S C ((k throttle)^2 - V^2)             [Beard & McLain 2012, eq. 4.13]
    INCOMING   T = 1/2 rho S C U (U - V), U = V + throttle (k - V)  [Fitzpatrick; used by PyFly]
    MOTOR      the speed of rotation where the motor's torque is the propeller's, then
               T = rho n^2 D^4 C_T(J)                              [Beard & McLain, 2nd ed., 4.3]
    """
    if body.thrust_form == 1.0:
        D, K = body.diameter, body.motor_constant
        volts = throttle * body.voltage * (1.0 - sag)
        a = body.CQ0 * body.rho * D**5 / (2.0 * np.pi) ** 2
        b = body.CQ1 * body.rho * D**4 / (2.0 * np.pi) * airspeed + K * K / body.resistance
        c = (
            body.CQ2 * body.rho * D**3 * airspeed**2
            - K * volts / body.resistance
            + K * body.no_load
        )
        Omega = (-b + np.sqrt(max(b * b - 4.0 * a * c, 0.0))) / (2.0 * a)
        n = max(Omega, 1e-3) / (2.0 * np.pi)
        J = airspeed / (n * D)
        J = min(J, 2.0)
        thrust = body.rho * n**2 * D**4 * (body.CT0 + body.CT1 * J + body.CT2 * J * J)
        return thrust, body.rho * n**2 * D**5 * (body.CQ0 + body.CQ1 * J + body.CQ2 * J * J)
    k = body.k_motor * (1.0 - sag)
    if body.thrust_form == 0.0:
        thrust = 0.5 * body.rho * body.disc * body.C_prop * ((k * throttle) ** 2 - airspeed**2)
    else:
        U = airspeed + throttle * (k - airspeed)
        thrust = 0.5 * body.rho * body.disc * body.C_prop * U * (U - airspeed)
    return thrust, body.torque_arm * thrust


@njit(cache=True)
def wind_at(hidden, north, east, acts):
    """Horizontal wind [m/s]: uniform, and a round jet with the profile of Schlichting, which falls
    as 1 / (1 + 0.414 (d / half width)^2)^2.
    """
    d2 = (north - hidden.jet_at_north) ** 2 + (east - hidden.jet_at_east) ** 2
    jet = 1.0 / (1.0 + 0.41421356 * d2 / hidden.jet_half_width**2) ** 2
    return (
        acts * (hidden.wind_north + jet * hidden.jet_north),
        acts * (hidden.wind_east + jet * hidden.jet_east),
    )


@njit(cache=True)
def interpolate(tables, grid, alpha, beta):
    """Six coefficients (CL, CD, CY, Cl, Cm, Cn) between the nodes of a table, linear in both.

    grid: first alpha, its step, first beta, its step; beyond the table its edge is continued.
    """
    i = (alpha - grid[0]) / grid[1]
    j = (beta - grid[2]) / grid[3]
    i0 = min(max(int(np.floor(i)), 0), tables.shape[0] - 2)
    j0 = min(max(int(np.floor(j)), 0), tables.shape[1] - 2)
    x = min(max(i - i0, -2.0), 3.0)
    y = min(max(j - j0, -2.0), 3.0)
    return (1.0 - x) * ((1.0 - y) * tables[i0, j0] + y * tables[i0, j0 + 1]) + x * (
        (1.0 - y) * tables[i0 + 1, j0] + y * tables[i0 + 1, j0 + 1]
    )


@njit(cache=True)
def loads(state, body, hidden, tables, grid, wind, acts, time):
    """Forces [N] and moments [N m] about the body axes without gravity.

    F_lift = 1/2 rho V^2 S (C_L(alpha) + C_L_q c q / 2V + C_L_de de)      [Beard & McLain, ch. 4]
    and so on; C_L(alpha) = (1 - sigma) (C_L_0 + C_L_alpha alpha) + sigma 2 sign sin^2 cos.
    """
    e0, e1, e2, e3 = state[3], state[4], state[5], state[6]
    p, q, r = state[10], state[11], state[12]
    jet_n, jet_e = wind_at(hidden, state[0], state[1], acts)
    wn, we, wd = wind[0] + jet_n, wind[1] + jet_e, wind[2]
    # air-relative velocity in body axes: rotate the wind by the transpose of R_ned_body
    ur = state[7] - (
        (e0 * e0 + e1 * e1 - e2 * e2 - e3 * e3) * wn
        + 2.0 * (e1 * e2 + e0 * e3) * we
        + 2.0 * (e1 * e3 - e0 * e2) * wd
    )
    vr = state[8] - (
        2.0 * (e1 * e2 - e0 * e3) * wn
        + (e0 * e0 - e1 * e1 + e2 * e2 - e3 * e3) * we
        + 2.0 * (e2 * e3 + e0 * e1) * wd
    )
    wr = state[9] - (
        2.0 * (e1 * e3 + e0 * e2) * wn
        + 2.0 * (e2 * e3 - e0 * e1) * we
        + (e0 * e0 - e1 * e1 - e2 * e2 + e3 * e3) * wd
    )
    V = max(np.sqrt(ur * ur + vr * vr + wr * wr), 1e-3)
    alpha = np.arctan2(wr, ur)
    beta = np.arcsin(min(max(vr / V, -1.0), 1.0))
    throttle = min(max(state[17], 0.0), 1.0)
    da = body.da_max * state[18]
    de = -body.de_max * state[19]
    dr = -body.dr_max * state[20]
    de_effective = de * (1.0 + acts * hidden.prop_wash * (throttle - hidden.throttle_trim))
    QS = 0.5 * body.rho * V * V * body.wing_area
    hq, hp, hr = (
        body.chord * q / (2.0 * V),
        body.span * p / (2.0 * V),
        body.span * r / (2.0 * V),
    )
    # static part
    if body.tabulated > 0.5:
        static = interpolate(tables, grid, alpha, beta)
        CL, CD, CY, Cl, Cm, Cn = static[0], static[1], static[2], static[3], static[4], static[5]
        attached = CL
    else:
        M, a0 = body.stall_M, body.stall_alpha
        low = np.exp(min(-M * (alpha - a0), 500.0))
        high = np.exp(min(M * (alpha + a0), 500.0))
        sigma = (1.0 + low + high) / ((1.0 + low) * (1.0 + high))
        sin, cos = np.sin(alpha), np.cos(alpha)
        side = 1.0 if alpha >= 0.0 else -1.0
        attached = body.CL0 + body.CLa * alpha
        CL = (1.0 - sigma) * attached + sigma * 2.0 * side * sin * sin * cos
        CD = (
            body.CD0
            + (1.0 - sigma) * (body.k * attached**2 + body.CDa * alpha + body.CDa2 * alpha**2)
            + sigma * 2.0 * abs(sin) ** 3
            + body.CDb2 * beta * beta
        )
        CY, Cl, Cn = body.CYb * beta, body.Clb * beta, body.Cnb * beta
        Cm = body.Cm0 + body.Cma * alpha
    # what is hidden in the air flow
    if hidden.image_vortex != 0.0:  # Wieselsberger's factor, theory has image_vortex = 1
        near = (
            acts
            * hidden.image_vortex
            * np.exp(-2.48 * (2.0 * max(-state[2], 0.0) / body.span) ** 0.768)
        )
        upwash = near * body.k * attached  # the induced angle C_L / (pi e A) is that much smaller
        CL = CL + body.CLa * upwash
        CD = CD - min(near, 1.0) * body.k * attached**2
    if hidden.separation != 0.0:  # Kirchhoff: lift times ((1 + sqrt X) / 2)^2
        X = 0.5 * (1.0 - np.tanh(12.0 * (alpha - hidden.separation_alpha)))
        lost = acts * hidden.separation * CL * (1.0 - 0.25 * (1.0 + np.sqrt(X)) ** 2)
        CL, CD = CL - lost, CD + lost * np.tan(min(max(alpha, 0.0), 1.0))
    CL = CL + body.CLq * hq + body.CLde * de_effective + acts * hidden.CL_added
    CD = CD + body.CDde * abs(de) + acts * (hidden.CD_added + 0.5 * hidden.wing_drag)
    CY = CY + body.CYp * hp + body.CYr * hr + body.CYda * da + body.CYdr * dr
    left = 1.0 - acts * hidden.aileron_lost
    fast = (V / hidden.V_trim) ** 2 - 1.0
    Cl = Cl + (
        body.Cl0 + body.Clp * hp + body.Clr * hr + left * body.Clda * da + body.Cldr * dr
        + acts * (hidden.rudder_roll * dr * V / hidden.V_trim + hidden.aeroelastic_roll * fast)
    )  # fmt: skip
    Cm = Cm + body.Cmq * hq + body.Cmde * de_effective + acts * hidden.Cmb * beta
    Cn = Cn + (
        body.Cn0 + body.Cnp * hp + body.Cnr * hr + body.Cndr * dr
        + (left * body.Cnda + acts * hidden.Cnda_added) * da
        + acts * 0.5 * hidden.wing_drag * 0.25  # its drag acts at a quarter of the span
    )  # fmt: skip
    sin, cos = np.sin(alpha), np.cos(alpha)
    fx = QS * (CL * sin - CD * cos)
    fy = QS * CY
    fz = -QS * (CL * cos + CD * sin)
    mx = QS * body.span * Cl
    my = QS * body.chord * Cm
    mz = QS * body.span * Cn
    back = acts * hidden.cg_back  # r x F about the centre of gravity moved back
    my += back * -fz
    mz += back * fy
    thrust, torque = propeller(
        body, throttle, V, acts * hidden.sag_per_s * max(time - hidden.sag_from, 0.0)
    )
    kept = 1.0 - acts * hidden.thrust_lost
    thrust, torque = thrust * kept, torque * kept
    mx += -torque + acts * hidden.torque_roll * thrust
    my += acts * hidden.thrust_line * thrust
    mz += acts * hidden.torque_yaw * thrust
    return fx + thrust, fy, fz, mx, my, mz


@njit(cache=True)
def derivative(state, commands, body, hidden, tables, grid, wind, time):
    """Time derivative of the state [Beard & McLain, eq. 3.14 to 3.17], Gamma terms written out."""
    out = np.empty(STATES)
    acts = acting(hidden, time)
    fx, fy, fz, mx, my, mz = loads(state, body, hidden, tables, grid, wind, acts, time)
    e0, e1, e2, e3 = state[3], state[4], state[5], state[6]
    u, v, w = state[7], state[8], state[9]
    p, q, r = state[10], state[11], state[12]
    out[0] = (
        (e0 * e0 + e1 * e1 - e2 * e2 - e3 * e3) * u
        + 2.0 * (e1 * e2 - e0 * e3) * v
        + 2.0 * (e1 * e3 + e0 * e2) * w
    )
    out[1] = (
        2.0 * (e1 * e2 + e0 * e3) * u
        + (e0 * e0 - e1 * e1 + e2 * e2 - e3 * e3) * v
        + 2.0 * (e2 * e3 - e0 * e1) * w
    )
    out[2] = (
        2.0 * (e1 * e3 - e0 * e2) * u
        + 2.0 * (e2 * e3 + e0 * e1) * v
        + (e0 * e0 - e1 * e1 - e2 * e2 + e3 * e3) * w
    )
    pull = 1.0 - (e0 * e0 + e1 * e1 + e2 * e2 + e3 * e3)  # keeps the quaternion of unit length
    out[3] = 0.5 * (-p * e1 - q * e2 - r * e3) + pull * e0
    out[4] = 0.5 * (p * e0 + r * e2 - q * e3) + pull * e1
    out[5] = 0.5 * (q * e0 - r * e1 + p * e3) + pull * e2
    out[6] = 0.5 * (r * e0 + q * e1 - p * e2) + pull * e3
    mass = body.mass * (1.0 + acts * hidden.mass_added)
    out[7] = r * v - q * w + fx / mass + GRAVITY * 2.0 * (e1 * e3 - e0 * e2)
    out[8] = p * w - r * u + fy / mass + GRAVITY * 2.0 * (e2 * e3 + e0 * e1)
    out[9] = q * u - p * v + fz / mass + GRAVITY * (e0 * e0 - e1 * e1 - e2 * e2 + e3 * e3)
    # J domega/dt = m - omega x (J omega), J symmetric about the x-z plane
    hx, hy, hz = body.Jx * p - body.Jxz * r, body.Jy * q, body.Jz * r - body.Jxz * p
    rx, ry, rz = mx - (q * hz - r * hy), my - (r * hx - p * hz), mz - (p * hy - q * hx)
    Gamma = body.Jx * body.Jz - body.Jxz**2
    out[10] = (body.Jz * rx + body.Jxz * rz) / Gamma
    out[11] = ry / body.Jy
    out[12] = (body.Jxz * rx + body.Jx * rz) / Gamma
    for i in range(4):
        tau = (body.motor if i == 0 else body.servo) + acts * hidden.servo_added
        out[13 + i] = (commands[i] - state[13 + i]) / max(tau, 1e-4)
        slow = acts * hidden.linkage  # without it the surface moves as its servo does
        out[17 + i] = (state[13 + i] - state[17 + i]) / slow if slow > 0.0 else out[13 + i]
    return out


@njit(cache=True)
def advance(state, commands, body, hidden, tables, grid, wind, time, step):
    """The state one step later by the classical Runge-Kutta method, commands and wind held."""
    half = 0.5 * step
    k1 = derivative(state, commands, body, hidden, tables, grid, wind, time)
    k2 = derivative(state + half * k1, commands, body, hidden, tables, grid, wind, time + half)
    k3 = derivative(state + half * k2, commands, body, hidden, tables, grid, wind, time + half)
    k4 = derivative(state + step * k3, commands, body, hidden, tables, grid, wind, time + step)
    return state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


# Aircraft
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Airplane:
    """A body, how it is flown, and where its numbers come from."""

    body: Body
    speed: float  # that it is flown at [m/s]
    bank: float  # of its turns [rad]
    source: str
    tables: Array | None = None  # (alphas, betas, 6) CL CD CY Cl Cm Cn
    grid: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 1.0)

    @property
    def controls(self) -> tuple[bool, bool, bool, bool]:
        """Which of throttle, aileron, elevator, rudder it has."""
        return True, self.body.da_max > 0.0, self.body.de_max > 0.0, self.body.dr_max > 0.0


def induced(oswald: float, span: float, wing_area: float) -> float:
    """1 / (pi e A)."""
    return wing_area / (np.pi * oswald * span**2)


def _body(**numbers: float) -> Body:
    """A body whose missing coefficients are zero."""
    absent = {name: 0.0 for name in Body._fields}
    usual = {"rho": RHO, "stall_alpha": 0.35, "stall_M": 50.0, "thrust_form": INCOMING}
    return Body(**{**absent, **usual, **numbers})


AEROSONDE = Airplane(
    _body(
        mass=11.0, Jx=0.8244, Jy=1.135, Jz=1.759, Jxz=0.1204, wing_area=0.55, span=2.8956,
        chord=0.18994, rho=1.2682, CL0=0.23, CLa=5.61, CLq=7.95, CLde=0.13, CD0=0.043,
        k=induced(0.9, 2.8956, 0.55), CDa=0.03, CDde=0.0135, Cm0=0.0135, Cma=-2.74, Cmq=-38.21,
        Cmde=-0.99, stall_alpha=0.47, CYb=-0.98, CYda=0.075, CYdr=0.19, Clb=-0.13, Clp=-0.51,
        Clr=0.25, Clda=0.17, Cldr=0.0024, Cnb=0.073, Cnp=-0.069, Cnr=-0.095, Cnda=-0.011,
        Cndr=-0.069, thrust_form=MOTOR, da_max=0.35, de_max=0.35, dr_max=0.35, servo=0.05,
        motor=0.15, delay=0.04, diameter=0.508, motor_constant=60.0 / (2.0 * np.pi * 145.0),
        resistance=0.042, no_load=1.5, voltage=44.4, CT0=0.09357, CT1=-0.06044, CT2=-0.1079,
        CQ0=0.005230, CQ1=0.004970, CQ2=-0.01664,
    ),
    25.0, 0.5,
    "Aerosonde, Beard and McLain, Small Unmanned Aircraft, 2nd edition, table E.2; servos, motor "
    "lag and full deflections chosen",
)  # fmt: skip

ZAGI = Airplane(
    _body(
        mass=1.56, Jx=0.1147, Jy=0.0576, Jz=0.1712, Jxz=0.0015, wing_area=0.2589, span=1.4224,
        chord=0.3302, rho=1.2682, CL0=0.09167, CLa=3.5016, CLq=2.8932, CLde=0.2724, CD0=0.01631,
        CDa=0.2108, CDde=0.0304, Cm0=-0.02338, Cma=-0.5675, Cmq=-1.3990, Cmde=-0.3254,
        stall_alpha=0.4712, CYb=-0.07359, Clb=-0.02854, Clp=-0.3209, Clr=0.03066, Clda=0.1682,
        Cnb=0.02, Cnp=-0.01297, Cnr=-0.0434, Cnda=-0.00328, thrust_form=QUADRATIC, disc=0.0314,
        C_prop=1.0, k_motor=20.0, torque_arm=0.004, da_max=0.3, de_max=0.4, servo=0.04,
        motor=0.10, delay=0.03,
    ),
    13.5, 0.5,
    "Zagi flying wing, Beard and McLain, Small Unmanned Aircraft (2012), table E.1. Changed: "
    "C_n_beta -0.0004 and C_n_r -0.00434 leave the yaw undamped, so winglets are assumed (0.02, "
    "-0.0434), and C_D_de 0.3042 would double the drag at trim (a tenth taken)",
)  # fmt: skip

CUB = Airplane(
    _body(
        mass=0.065, Jx=3.9e-4, Jy=4.1e-4, Jz=6.6e-4, Jxz=1.5e-5, wing_area=0.055, span=0.617,
        chord=0.09, CL0=0.45, CLa=4.3, CLq=4.5, CLde=0.25, CD0=0.06, k=induced(0.75, 0.617, 0.055),
        CDb2=0.25, Cm0=0.02, Cma=-0.60, Cmq=-8.0, Cmde=-0.80, stall_alpha=0.36, stall_M=35.0,
        CYb=-0.35, CYr=0.15, CYdr=0.17, Clb=-0.09, Clp=-0.45, Clr=0.20, Clda=0.20, Cldr=0.008,
        Cnb=0.07, Cnp=-0.08, Cnr=-0.12, Cnda=-0.010, Cndr=-0.06, thrust_form=INCOMING,
        disc=0.0133, C_prop=0.305, k_motor=11.0, torque_arm=0.010, da_max=0.30, de_max=0.35,
        dr_max=0.40, servo=0.04, motor=0.06, delay=0.03,
    ),
    5.2, 0.42,
    "HobbyZone Sport Cub S 2: mass, area, span, chord and largest thrust as stated by "
    "github.com/CogniPilot/cubs2; coefficients and inertia are textbook estimates (tail volume, "
    "aspect ratio, radii of gyration after Raymer), not measured",
)  # fmt: skip


X8 = Airplane(
    _body(
        mass=3.364, Jx=1.229, Jy=0.1702, Jz=0.8808, Jxz=0.9343, wing_area=0.75, span=2.1,
        chord=0.3571, CL0=0.0867, CLa=4.0203, CLq=3.87, CLde=0.2781, CD0=0.0197, CDa=0.0791,
        CDa2=1.0555, CDb2=0.1478, CDde=0.0633, Cm0=0.018, Cma=-0.2524, Cmq=-1.3012, Cmde=-0.2292,
        stall_alpha=0.267, CYb=-0.2239, CYp=-0.1374, CYr=0.0839, CYda=0.0433, Clb=-0.0849,
        Clp=-0.4042, Clr=0.0555, Clda=0.1202, Cnb=0.0283, Cnp=0.00437, Cnr=-0.0720, Cnda=-0.00339,
        thrust_form=INCOMING, disc=0.1018, C_prop=0.248, k_motor=37.42, torque_arm=0.01,
        da_max=0.35, de_max=0.35, servo=0.05, motor=0.2, delay=0.04,
    ),
    18.0, 0.5,
    "Skywalker X8 flying wing, Gryte et al., Aerodynamic modeling of the Skywalker X8, ICUAS 2018, "
    "numbers as in x8_param.mat of github.com/eivindeb/pyfly (MIT), inertia as printed (its "
    "Jxz is larger than a body of these moments can have); C_D by its polynomial; servos chosen",
)  # fmt: skip

NAVION = Airplane(
    _body(
        # Froude scale 0.2717: length by s, mass by s^3, inertia by s^5, speed by sqrt(s)
        mass=25.0, Jx=2.10, Jy=6.02, Jz=7.08, Jxz=0.0, wing_area=1.262, span=2.766, chord=0.472,
        CL0=0.41, CLa=4.44, CLq=3.8, CLde=0.355, CD0=0.0378, k=0.0723, CDb2=0.2, Cm0=0.0,
        Cma=-0.683, Cmq=-14.32, Cmde=-0.923, stall_alpha=0.28, CYb=-0.564, CYdr=0.157, Clb=-0.074,
        Clp=-0.410, Clr=0.107, Clda=0.134, Cldr=0.0107, Cnb=0.071, Cnp=-0.0575, Cnr=-0.125,
        Cnda=-0.0035, Cndr=-0.072, thrust_form=INCOMING, disc=0.255, C_prop=0.55, k_motor=48.0,
        torque_arm=0.03, da_max=0.3, de_max=0.3, dr_max=0.35, servo=0.06, motor=0.25, delay=0.05,
    ),
    27.0, 0.5,
    "Navion, Nelson, Flight Stability and Automatic Control, table B.1, as a 25 kg model by "
    "Froude's scale 0.2717; C_m_alpha_dot added to C_m_q, C_L at trim taken for C_L_0, C_l_dr a "
    "tenth of the 0.107 printed; propeller and servos chosen",
)  # fmt: skip

SLOW_FLYER = Airplane(
    _body(
        mass=0.030, Jx=1.5e-4, Jy=1.9e-4, Jz=2.8e-4, Jxz=5e-6, wing_area=0.072, span=0.55,
        chord=0.13, CL0=0.45, CLa=3.7, CLq=4.0, CLde=0.25, CD0=0.08, k=induced(0.75, 0.55, 0.072),
        CDb2=0.3, Cm0=0.015, Cma=-0.65, Cmq=-8.0, Cmde=-0.75, stall_alpha=0.36, stall_M=35.0,
        CYb=-0.45, CYr=0.2, CYdr=0.22, Clb=-0.17, Clp=-0.42, Clr=0.19, Cldr=0.005, Cnb=0.08,
        Cnp=-0.07, Cnr=-0.16, Cndr=-0.10, thrust_form=INCOMING, disc=0.0133, C_prop=0.42,
        k_motor=6.5, torque_arm=0.008, de_max=0.35, dr_max=0.45, servo=0.05, motor=0.06,
        delay=0.03,
    ),
    3.3, 0.35,
    "30 g indoor slow flyer with rudder, elevator and dihedral, no ailerons: drawn for these "
    "tests, coefficients by textbook estimates (aspect ratio, tail volume, dihedral)",
)  # fmt: skip


def tabulated_airplane() -> Airplane:
    """The 150 g aircraft of foreign_tables.json."""
    kept = json.loads(Path(__file__).with_name("foreign_tables.json").read_text(encoding="utf-8"))
    by = {
        name: dict(zip(kept["columns"], v, strict=True)) for name, v in kept["derivatives"].items()
    }
    roll, pitch, yaw = by["p"], by["q"], by["r"]
    aileron, elevator, rudder = by["aileron"], by["elevator"], by["rudder"]
    table, alphas, betas = (
        np.asarray(kept["table"]),
        np.radians(kept["alpha_deg"]),
        np.radians(kept["beta_deg"]),
    )
    induced_k = induced(0.85, kept["span"], kept["wing_area"])
    body = _body(
        mass=0.150, Jx=1.5e-3, Jy=1.7e-3, Jz=2.6e-3, Jxz=6e-5, wing_area=kept["wing_area"],
        span=kept["span"], chord=kept["chord"], CLa=4.6, k=induced_k, CLq=pitch["CL"],
        CLde=elevator["CL"], Cmq=pitch["Cm"], Cmde=elevator["Cm"], CYp=roll["CY"], Clp=roll["Cl"],
        Cnp=roll["Cn"], CYr=yaw["CY"], Clr=yaw["Cl"], Cnr=yaw["Cn"],
        # a positive aileron of AeroSandbox rolls left, a positive rudder yaws right
        Clda=-aileron["Cl"], Cnda=-aileron["Cn"], CYda=-aileron["CY"], CYdr=-rudder["CY"],
        Cldr=-rudder["Cl"], Cndr=-rudder["Cn"], Cma=-0.9, Cnb=0.08, Clb=-0.13,  # for the pilot
        thrust_form=INCOMING, disc=0.0201, C_prop=0.55, k_motor=14.0, torque_arm=0.008,
        da_max=0.20, de_max=0.25, dr_max=0.35, servo=0.035, motor=0.06, delay=0.03,
        tabulated=1.0,
    )  # fmt: skip
    grid = (alphas[0], alphas[1] - alphas[0], betas[0], betas[1] - betas[0])
    return Airplane(
        body, 6.5, 0.5,
        "150 g high wing of 0.80 m span drawn for these tests, tables by AeroSandbox 4.2.10 "
        "(foreign_tables.py); inertia by Raymer's radii of gyration",
        table, tuple(float(v) for v in grid),
    )  # fmt: skip


AIRPLANES: dict[str, Airplane] = {
    "aerosonde": AEROSONDE,
    "zagi": ZAGI,
    "cub": CUB,
    "tabulated": tabulated_airplane(),
    "x8": X8,
    "navion": NAVION,
    "slow_flyer": SLOW_FLYER,
}
KEPT = {  # not redrawn: sizes, forms, and what a table or a motor's data sheet says
    "wing_area", "span", "chord", "rho", "mass", "thrust_form", "tabulated", "stall_M", "k",
    "diameter", "motor_constant", "resistance", "no_load", "voltage", "CT0", "CT1", "CT2", "CQ0",
    "CQ1", "CQ2", "delay", "disc", "Jxz",
}  # fmt: skip


def redrawn(airplane: Airplane, rng: np.random.Generator, spread: float) -> Airplane:
    """Another aircraft of the same kind: inertia and coefficients times exp(spread * normal).

    Jxz is drawn through its share of sqrt(Jx Jz), so that the inertia stays that of a body; tables
    are scaled by one factor for each of their six columns.
    """
    body, numbers = airplane.body, airplane.body._asdict()
    drawn = {
        name: value if name in KEPT else float(value * np.exp(spread * rng.normal()))
        for name, value in numbers.items()
    }
    drawn["k_motor"] = body.k_motor * np.exp(0.4 * spread * rng.normal())
    share = body.Jxz / np.sqrt(body.Jx * body.Jz)
    drawn["Jxz"] = float(share * np.sqrt(drawn["Jx"] * drawn["Jz"]))
    tables = airplane.tables
    if tables is not None:
        tables = tables * np.exp(spread * rng.normal(size=6))
    return Airplane(
        Body(**drawn), airplane.speed, airplane.bank, airplane.source, tables, airplane.grid
    )


NO_TABLE = np.zeros((2, 2, 6))


def table_of(airplane: Airplane) -> Array:
    """The tables, or zeros of the same rank."""
    return NO_TABLE if airplane.tables is None else np.ascontiguousarray(airplane.tables)


# Trim and frames
# --------------------------------------------------------------------------------------------------


def level_state(alpha: float, speed: float, commands: Array, heading: float = 0.0) -> Array:
    """State in level flight north at angle of attack alpha, wings level, at height zero."""
    state = np.zeros(STATES)
    half, turn = 0.5 * alpha, 0.5 * heading
    state[QUATERNION] = [
        np.cos(half) * np.cos(turn),
        -np.sin(half) * np.sin(turn),
        np.sin(half) * np.cos(turn),
        np.cos(half) * np.sin(turn),
    ]
    state[VELOCITY] = speed * np.cos(alpha), 0.0, speed * np.sin(alpha)
    state[SERVO] = state[LINKAGE] = commands
    return state


@dataclass(frozen=True)
class Trim:
    """Level flight: angle of attack, commands, and the derivatives an autopilot is scaled by."""

    alpha: float
    throttle: float
    elevator: float
    thrust: float
    CL: float
    CD: float


def trim_level(airplane: Airplane, speed: float) -> Trim:
    """Level, unaccelerated flight in the plane of symmetry.

    Raises:
        ValueError: there is none at this speed.
    """
    from scipy.optimize import least_squares

    body, tables = airplane.body, table_of(airplane)
    still = np.zeros(3)

    def rates(x: Array) -> Array:
        commands = np.array([x[1], 0.0, x[2], 0.0])
        state = level_state(x[0], speed, commands)
        out = derivative(state, commands, body, CALM, tables, airplane.grid, still, 0.0)
        return np.array([out[7] / GRAVITY, out[9] / GRAVITY, out[11] / 10.0])

    found = least_squares(
        rates,
        [0.08, 0.4, 0.0],
        bounds=([-0.2, 0.0, -1.0], [0.4, 1.0, 1.0]),
        x_scale=[0.1, 0.3, 0.2],
    )
    if np.abs(found.fun).max() > 1e-5:
        raise ValueError(f"speed: expected one that can be flown level, got {speed} m/s")
    alpha, throttle, elevator = found.x
    thrust, _ = propeller(body, throttle, speed, 0.0)
    area = 0.5 * body.rho * speed**2 * body.wing_area
    weight = body.mass * GRAVITY
    return Trim(
        alpha, throttle, elevator, thrust,
        (weight - thrust * np.sin(alpha)) / area, thrust * np.cos(alpha) / area,
    )  # fmt: skip


def kit_states(states: Array) -> tuple[Array, Array]:
    """Positions (N, 3) in the kit's world and roll, pitch, yaw (N, 3) [rad]."""
    e0, e1, e2, e3 = states[:, QUATERNION].T
    roll = np.arctan2(2.0 * (e0 * e1 + e2 * e3), e0**2 + e3**2 - e1**2 - e2**2)
    pitch = np.arcsin(np.clip(2.0 * (e0 * e2 - e1 * e3), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (e0 * e3 + e1 * e2), e0**2 + e1**2 - e2**2 - e3**2)
    return states[:, POSITION] * [1.0, -1.0, -1.0], np.stack([roll, pitch, yaw], axis=1)


# Command line
# --------------------------------------------------------------------------------------------------


def main() -> None:
    """Write pairs of flights, airframe files and truth.json."""
    import argparse
    from itertools import cycle

    from tests.benchmarks import foreign_flights

    parser = argparse.ArgumentParser(description=main.__doc__)
    every = foreign_flights.AIRCRAFT
    parser.add_argument("--aircraft", nargs="*", default=list(every), choices=every)
    parser.add_argument("--effect", nargs="*", default=["none"], help="in turn; two at once as a+b")
    parser.add_argument(
        "--cases", type=int, default=None, help="of each aircraft; all effects once"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--noise", choices=list(foreign_flights.NOISES), default=None)
    parser.add_argument("--rate-hz", type=float, default=20.0)
    parser.add_argument("--calm-s", type=float, default=120.0)
    parser.add_argument("--flight-s", type=float, default=90.0)
    parser.add_argument("--missing", type=float, default=0.01, help="share of the poses")
    parser.add_argument("--correlated", action="store_true")
    parser.add_argument("--jitter", type=float, default=0.0, help="[s]")
    parser.add_argument("--onset", type=float, default=None, help="[s] into the flight")
    parser.add_argument("--gust", type=float, default=0.0, help="share of the airspeed")
    parser.add_argument("--ramp", type=float, default=0.0, help="[s] from onset to full size")
    parser.add_argument("--until", type=float, default=None, help="[s] into the flight")
    parser.add_argument("--calm-wind", type=float, default=0.0, help="share of the airspeed")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    cases: dict[str, Any] = {}
    for aircraft in asked.aircraft:
        count = asked.cases or len(asked.effect)
        for k, effect in zip(range(count), cycle(asked.effect), strict=False):
            name = f"{aircraft}_{asked.seed + k}_{effect.replace('+', '_and_')}"
            cases[name] = foreign_flights.make_case(
                aircraft, effect, asked.seed + k, noise=asked.noise, rate_hz=asked.rate_hz,
                seconds=(asked.calm_s, asked.flight_s), missing=asked.missing,
                correlated=asked.correlated, jitter=asked.jitter, onset=asked.onset,
                gust=asked.gust, calm_wind=asked.calm_wind, ramp=asked.ramp, until=asked.until,
            )  # fmt: skip
    foreign_flights.write_cases(asked.out, cases)
    print(f"wrote {len(cases)} pairs to {asked.out}")


if __name__ == "__main__":
    main()
