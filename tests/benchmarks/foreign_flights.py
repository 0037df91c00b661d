"""Foreign flights: an aircraft, an effect and a seed -> a baseline flight and one with the effect.

The aircraft of `foreign_aircraft` are flown by a simple autopilot that is scaled from trim, through
figure eights or random headings with shaking and doublets on every control they have, and measured
with the errors of a marker, motion capture, an inertial navigation system or plain GPS. Each case
is another aircraft (coefficients spread by 12 %), the second flight another day (1 %). Simulated,
not measured.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from scipy.interpolate import CubicSpline

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import FlightTable, write_flight_table
from falconwing_kit.core.frames import euler_from_rotation, rotation_world_body, wrap_angle
from tests import hidden_effects, hidden_flights
from tests.benchmarks.foreign_aircraft import (
    AIRPLANES,
    CALM,
    GRAVITY,
    STATES,
    VELOCITY,
    Airplane,
    Array,
    Hidden,
    Trim,
    acting,
    advance,
    derivative,
    kit_states,
    level_state,
    redrawn,
    table_of,
    trim_level,
    wind_at,
)

NOISES = {  # standard deviation per axis [m], [rad]
    "mocap": (0.001, np.radians(0.1)),
    "marker": (0.03, np.radians(0.6)),
    "ins": (0.30, np.radians(0.5)),
    "gps": (1.00, np.radians(1.0)),
}
CASE_SPREAD, DAY_SPREAD = 0.12, 0.01
CORRELATION_S, OUTLIERS, OUTLIER_SIGMA = 0.5, 0.005, 60.0
LEAD_S, MARGIN_S = 12.0, 1.0  # s flown before the table begins, of which kept for late stamps
# A size is tried six times before it is drawn anew, or large effects would get rare.
ATTEMPTS, SAME_SIZE = 30, 6
PILOT_HZ = 50.0  # the autopilot acts at most so often
INDOORS = 9.0  # m/s: slower aircraft fly low and in small steps


# Autopilot
# --------------------------------------------------------------------------------------------------


class Pilot(NamedTuple):
    """Gains and wishes of the autopilot; angles in radians, the rest in SI units and commands."""

    speed: float
    height: float
    radius: float
    bank: float
    pitch_trim: float
    throttle_trim: float
    elevator_trim: float
    lift_angle: float  # angle of attack that carries the weight once more
    k_course: float
    k_roll: float
    k_p: float
    k_pitch: float
    k_q: float
    elevator_per_alpha: float  # that balances an angle of attack, and a pitch rate
    elevator_per_q: float
    k_throttle: float
    k_height: float
    by_rudder: float  # 1: no ailerons, the rudder banks
    has_aileron: float
    has_rudder: float
    pattern: float  # 0 figure eights, 1 random headings
    swing: float  # share by which the speed varies
    swing_period: float
    shallowest: float  # height of low passes, or of the lowest wish
    pass_period: float
    pass_share: float  # of the period that a pass takes


@njit(cache=True)
def fly(
    body, hidden, tables, grid, pilot, shake, doublets, headings, gusts, start, step, per_row, rows
):
    """Fly `rows` periods of `per_row` steps; the autopilot acts once a period.

    Args:
        shake: (3, M, 4) angular frequencies, phases and amplitudes of sines on the commands.
        doublets: (D, 4) time, control, amplitude, half width.
        headings: (H, 2) time and heading for the pattern of random headings.
        gusts: (rows, 3) wind north, east, down at each period [m/s], linear between.

    Returns:
        states (rows, STATES), sticks (rows, 4) as sent at each row, airspeeds (rows,).
    """
    states, sticks, airspeeds = np.empty((rows, STATES)), np.empty((rows, 4)), np.empty(rows)
    state = start.copy()
    period = step * per_row
    side, far = 1.0, False
    sum_pitch, sum_roll, sum_speed = 0.0, 0.0, 0.0
    received = np.empty(4)
    for k in range(rows):
        time = k * period
        e0, e1, e2, e3 = state[3], state[4], state[5], state[6]
        u, v, w = state[7], state[8], state[9]
        roll = np.arctan2(2.0 * (e0 * e1 + e2 * e3), e0**2 + e3**2 - e1**2 - e2**2)
        pitch = np.arcsin(min(max(2.0 * (e0 * e2 - e1 * e3), -1.0), 1.0))
        vn = (
            (e0**2 + e1**2 - e2**2 - e3**2) * u
            + 2 * (e1 * e2 - e0 * e3) * v
            + 2 * (e1 * e3 + e0 * e2) * w
        )
        ve = (
            2 * (e1 * e2 + e0 * e3) * u
            + (e0**2 - e1**2 + e2**2 - e3**2) * v
            + 2 * (e2 * e3 - e0 * e1) * w
        )
        climb = -(
            2 * (e1 * e3 - e0 * e2) * u
            + 2 * (e2 * e3 + e0 * e1) * v
            + (e0**2 - e1**2 - e2**2 + e3**2) * w
        )
        acts = acting(hidden, time)
        jet_n, jet_e = wind_at(hidden, state[0], state[1], acts)
        an, ae, ad = vn - gusts[k, 0] - jet_n, ve - gusts[k, 1] - jet_e, -climb - gusts[k, 2]
        airspeed = np.sqrt(an * an + ae * ae + ad * ad)
        course = np.arctan2(ve, vn)
        # where to: bank
        if pilot.pattern < 0.5:
            from_n, from_e = state[0], state[1] - side * pilot.radius
            far = far or side * state[1] > 1.25 * pilot.radius
            if far and side * state[1] < 0.55 * pilot.radius:
                side, far = -side, False
                from_e = state[1] - side * pilot.radius
            outside = (np.sqrt(from_n**2 + from_e**2) - pilot.radius) / pilot.radius
            wanted = np.arctan2(from_e, from_n) + side * (
                0.5 * np.pi + min(max(1.1 * outside, -1.2), 1.2)
            )
            ahead = side * np.arctan(airspeed**2 / (GRAVITY * pilot.radius))
        else:
            wanted, ahead = headings[0, 1], 0.0
            for h in range(headings.shape[0]):
                if headings[h, 0] <= time:
                    wanted = headings[h, 1]
            if np.sqrt(state[0] ** 2 + state[1] ** 2) > 2.2 * pilot.radius:
                wanted = np.arctan2(-state[1], -state[0])
        error = (wanted - course + np.pi) % (2.0 * np.pi) - np.pi
        bank = min(max(ahead + pilot.k_course * error, -pilot.bank), pilot.bank)
        # how high and how fast
        phase = time / pilot.pass_period
        down = np.exp(-(((phase - np.floor(phase) - 0.5) / pilot.pass_share) ** 2))
        height = pilot.height - (pilot.height - pilot.shallowest) * down
        above = -state[2]
        soon = above + 0.8 * climb
        height += 2.0 * max(0.6 * pilot.shallowest - soon, 0.0)
        speed = pilot.speed * (1.0 + pilot.swing * np.sin(2.0 * np.pi * time / pilot.swing_period))
        rise = min(max(pilot.k_height * (height - above), -0.14 * pilot.speed), 0.11 * pilot.speed)
        slope = (rise - climb) / pilot.speed
        sum_pitch = min(max(sum_pitch + 0.5 * slope * period, -0.3), 0.3)
        turning = pilot.lift_angle * (1.0 / max(np.cos(roll), 0.4) - 1.0) * np.cos(roll)
        pitch_wanted = pilot.pitch_trim + rise / pilot.speed + 0.6 * slope + sum_pitch + turning
        q_turn = GRAVITY / max(airspeed, 1.0) * np.tan(min(max(roll, -1.2), 1.2)) * np.sin(roll)
        sum_speed = min(
            max(sum_speed + 0.25 * pilot.k_throttle * (speed - airspeed) * period, -0.5), 0.6
        )
        sum_roll = min(max(sum_roll + 0.3 * (bank - roll) * period, -0.25), 0.25)
        u_roll = pilot.k_roll * (bank - roll + sum_roll) - pilot.k_p * state[10]
        sticks[k, 0] = pilot.throttle_trim + pilot.k_throttle * (speed - airspeed) + sum_speed
        sticks[k, 1] = pilot.has_aileron * u_roll
        sticks[k, 2] = (
            pilot.elevator_trim
            + pilot.k_pitch * (pitch_wanted - pitch)
            + pilot.elevator_per_alpha * pilot.lift_angle * (1.0 / max(np.cos(roll), 0.5) - 1.0)
            + pilot.elevator_per_q * q_turn
            - pilot.k_q * (state[11] - q_turn)
        )
        sticks[k, 3] = pilot.by_rudder * u_roll
        for c in range(4):
            for m in range(shake.shape[1]):
                sticks[k, c] += shake[2, m, c] * np.sin(shake[0, m, c] * time + shake[1, m, c])
        for d in range(doublets.shape[0]):
            since, width = time - doublets[d, 0], doublets[d, 3]
            if 0.0 <= since < 2.0 * width:
                sticks[k, int(doublets[d, 1])] += doublets[d, 2] * (1.0 if since < width else -1.0)
        sticks[k, 0] = min(max(sticks[k, 0], 0.0), 1.0)
        for c in range(1, 4):
            sticks[k, c] = min(max(sticks[k, c], -1.0), 1.0)
        sticks[k, 1] *= pilot.has_aileron
        sticks[k, 3] *= pilot.has_rudder
        states[k] = state
        airspeeds[k] = airspeed
        if k == rows - 1:
            break
        wind = np.empty(3)
        for s in range(per_row):
            now = time + s * step
            acts = acting(hidden, now)
            late = body.delay + acts * hidden.delay_added
            sent = max(int(np.floor((now - late) / period + 1e-6)), 0)
            for c in range(4):
                received[c] = sticks[sent, c]
                if c > 0 and abs(received[c]) <= acts * hidden.deadband:
                    received[c] = 0.0
            received[1] += acts * hidden.bias_aileron
            received[2] += acts * hidden.bias_elevator
            received[3] += acts * hidden.bias_rudder
            for c in range(3):
                wind[c] = gusts[k, c] + (gusts[k + 1, c] - gusts[k, c]) * s / per_row
            state = advance(state, received, body, hidden, tables, grid, wind, now, step)
    return states, sticks, airspeeds


def new_pilot(
    airplane: Airplane, trim: Trim, rng: np.random.Generator, period: float, low: bool
) -> Pilot:
    """An autopilot for this aircraft: gains from its linear model in level flight.

    Each attitude loop gets the bandwidth that its total delay allows, 0.35 rad of phase, and as
    much damping as the aircraft lacks.

    Args:
        airplane: what flies.
        trim: level flight at its speed.
        rng: draws the pattern and how far height and speed vary.
        period: of the autopilot [s].
        low: fly low passes, a third of the span above the floor, outdoors six tenths.
    """
    A, B = linear_model(airplane, trim)
    body, V = airplane.body, airplane.speed
    late = body.delay + body.servo + 0.5 * period
    bandwidth = min(0.35 / late, 4.0)
    damping = -A[10, 10]
    if body.da_max > 0.0:
        effect = B[10, 1]
    else:  # the rudder banks through sideslip and dihedral
        slip = V * -B[12, 3] / max(A[12, 8] * V, 1e-6)  # v per command once the yaw has settled
        effect, bandwidth = A[10, 8] * slip, 0.4 * bandwidth
    k_roll = bandwidth * max(bandwidth, damping / 1.6) / effect
    k_p = min(max(0.0, 1.6 * bandwidth - damping), 0.3 / late) / effect
    stiff = np.sqrt(max(-A[11, 9] * V, 0.0))
    damping = -A[11, 11] - A[9, 9]  # a late answer to pitch takes k_pitch late off it
    added = min(max(0.0, 1.4 * np.hypot(stiff, bandwidth) - damping), 0.25 / late)
    k_q = added / B[11, 2]
    k_pitch = min(max(min(bandwidth, 3.0) ** 2, 0.8 * stiff**2), 0.4 * (damping + added) / late)
    k_pitch /= B[11, 2]
    per_throttle = B[7, 0]
    radius = turn_radius(airplane)
    span = body.span
    height = max(2.0, 1.2 * span, 0.25 * V) if V < INDOORS else max(3.0 * span, 1.2 * V)
    if low:
        height = min(height, max(2.0, 2.0 * span))
    return Pilot(
        speed=V, height=height, radius=radius, bank=1.2 * airplane.bank,
        pitch_trim=trim.alpha, throttle_trim=trim.throttle, elevator_trim=trim.elevator,
        lift_angle=trim.CL / max(body.CLa, 1e-3),
        k_course=min(1.2, bandwidth * V / (3.0 * GRAVITY)), k_roll=k_roll, k_p=k_p,
        k_pitch=k_pitch, k_q=k_q,
        elevator_per_alpha=stiff**2 / B[11, 2], elevator_per_q=-A[11, 11] / B[11, 2],
        k_throttle=0.6 / max(per_throttle, 1e-3), k_height=0.9 * min(1.0, 7.0 / V),
        by_rudder=float(body.da_max == 0.0), has_aileron=float(body.da_max > 0.0),
        has_rudder=float(body.dr_max > 0.0), pattern=float(rng.random() < 0.3),
        swing=float(rng.uniform(0.06, 0.12)),
        swing_period=float(rng.uniform(14.0, 22.0)) * max(1.0, V / 12.0),
        shallowest=(0.30 * span + 0.1 if V < INDOORS else 0.6 * span) if low else 0.75 * height,
        pass_period=float(rng.uniform(10.0, 14.0)) * max(1.0, V / 10.0),
        pass_share=0.30 if low else 0.12,  # a low pass is to last: ground effect has to be there
    )  # fmt: skip


def linear_model(airplane: Airplane, trim: Trim) -> tuple[Array, Array]:
    """Jacobians of the state's derivative by state and by surface commands in level flight."""
    commands = np.array([trim.throttle, 0.0, trim.elevator, 0.0])
    state = level_state(trim.alpha, airplane.speed, commands)
    tables = table_of(airplane)

    def rates(x: Array) -> Array:
        out: Array = derivative(
            x, commands, airplane.body, CALM, tables, airplane.grid, np.zeros(3), 0.0
        )
        return out

    columns = []
    for i in range(STATES):
        step = np.zeros(STATES)
        step[i] = 1e-4
        columns.append((rates(state + step) - rates(state - step)) / 2e-4)
    jacobian = np.array(columns).T
    return jacobian, jacobian[:, 17:21]


def shaking(airplane: Airplane, trim: Trim, rng: np.random.Generator, amount: float) -> Array:
    """(3, 6, 4) frequencies, phases and amplitudes that move rates and angles visibly, no more."""
    A, B = linear_model(airplane, trim)
    V = airplane.speed
    slow = np.clip((7.0 / V) ** 0.5, 0.6, 1.3)
    frequencies = 2.0 * np.pi * slow * np.exp(rng.uniform(np.log(0.15), np.log(1.6), (6, 4)))
    phases = rng.uniform(0.0, 2.0 * np.pi, (6, 4))
    roll = 0.11 * -A[10, 10] / max(B[10, 1], 1e-6)
    pitch = 0.014 * -A[11, 9] * V / B[11, 2]
    yaw = 0.02 * A[12, 8] * V / max(B[12, 3], 1e-6)
    size = np.array(
        [0.035, np.clip(roll, 0.02, 0.10), np.clip(pitch, 0.02, 0.10), np.clip(yaw, 0.03, 0.10)]
    )
    size *= np.array(airplane.controls, dtype=float) * amount
    return np.stack([frequencies, phases, np.broadcast_to(size, (6, 4))])


def doublet_list(
    airplane: Airplane, sizes: Array, rng: np.random.Generator, seconds: float
) -> Array:
    """(D, 4) doublets on a control in turn, one every eight seconds or so."""
    controls = [c for c in range(1, 4) if airplane.controls[c]]
    scale = max(1.0, (airplane.speed / 8.0) ** 0.5)
    rows, time = [], float(rng.uniform(2.0, 6.0))
    while time < seconds:
        c = controls[len(rows) % len(controls)]
        width = float(rng.uniform(0.2, 0.4)) * scale
        rows.append([time, c, 2.5 * sizes[c] * rng.choice([-1.0, 1.0]), width])
        time += float(rng.uniform(5.0, 10.0))
    return np.array(rows)


# Effects
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Around:
    """What sizes are relative to: an aircraft in level flight and how it will be flown."""

    airplane: Airplane
    trim: Trim
    radius: float

    @property
    def force(self) -> float:
        """1/2 rho V^2 S [N]."""
        body = self.airplane.body
        return 0.5 * body.rho * self.airplane.speed**2 * body.wing_area

    @property
    def per_speed2(self) -> float:
        """rho S / 2 m [1/m]: a coefficient in the kit's units."""
        body = self.airplane.body
        return 0.5 * body.rho * body.wing_area / body.mass


Size = dict[str, float]
Kit = dict[str, float]


@dataclass(frozen=True)
class Effect:
    """How strong an effect is drawn, what it is in the simulator, and in the kit's parameters.

    `draw` gives fields of Hidden, or those of MEASURED for what changes the measured poses; `kit`
    the parameters of the kit where the two mean the same, else nothing.
    """

    draw: Callable[[np.random.Generator, float, Around], Size]
    low: float
    high: float
    kit: Callable[[Size, Around], Kit] = lambda size, a: {}
    needs: str = ""  # a control that it acts on


def _direction(rng: np.random.Generator, size: float, *names: str) -> Size:
    drawn = rng.normal(size=len(names))
    return dict(zip(names, (size * drawn / np.linalg.norm(drawn)).tolist(), strict=True))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _jet(rng: np.random.Generator, size: float, a: Around) -> Size:
    around = rng.uniform(0.0, 2.0 * np.pi)
    return {
        **_direction(rng, size * a.airplane.speed, "jet_north", "jet_east"),
        "jet_at_north": a.radius * np.sin(around),
        "jet_at_east": a.radius * (_sign(rng) + np.cos(around)),
        "jet_half_width": float(rng.uniform(0.35, 0.7)) * a.radius,
    }


def _turned(a: Around, roll: float, yaw: float) -> tuple[float, float]:
    """Accelerations in roll and yaw of these moments per mass [Beard & McLain, eq. 3.13]."""
    body = a.airplane.body
    per_mass = body.mass / (body.Jx * body.Jz - body.Jxz**2)
    return (
        per_mass * (body.Jz * roll + body.Jxz * yaw),
        per_mass * (body.Jxz * roll + body.Jx * yaw),
    )


def _wing_drag(size: Size, a: Around) -> dict[str, float]:
    """Drag of the right wing alone, which acts at a quarter of the span."""
    drag = 0.5 * a.per_speed2 * size["wing_drag"]
    return {
        "wing_drag": drag,
        "wing_drag_yaw": _turned(a, 0.0, 0.25 * a.airplane.body.span * drag)[1],
    }


def _torque(rng: np.random.Generator, size: float, a: Around) -> Size:
    """Moments at trim as `size` of full aileron and as a sideslip of 0.25 `size` rad."""
    body = a.airplane.body
    parts = _direction(rng, size, "roll", "yaw")
    per_thrust = a.force * body.span / a.trim.thrust
    aileron = body.Clda * body.da_max if body.da_max > 0.0 else 0.06
    return {
        "torque_roll": parts["roll"] * aileron * per_thrust,
        "torque_yaw": parts["yaw"] * 0.25 * abs(body.Cnb) * per_thrust,
    }


def _bias(rng: np.random.Generator, size: float, a: Around) -> Size:
    names = [
        f"bias_{name}"
        for name, there in zip(
            ("aileron", "elevator", "rudder"), a.airplane.controls[1:], strict=True
        )
        if there
    ]
    return _direction(rng, size, *names)


def _lag(rng: np.random.Generator, size: float, a: Around) -> Size:
    return {"linkage" if rng.random() < 0.5 else "servo_added": size}


def _stall(rng: np.random.Generator, size: float, a: Around) -> Size:
    above = float(rng.uniform(0.03, 0.07))
    return {"separation_alpha": a.trim.alpha + above, "separation": size}


def _cg(rng: np.random.Generator, size: float, a: Around) -> Size:
    body = a.airplane.body
    margin = -body.Cma / body.CLa * body.chord
    return {"cg_back": _sign(rng) * size * min(margin, 0.15 * body.chord)}


EFFECTS: dict[str, Effect] = {
    "none": Effect(lambda rng, size, a: {}, 1.0, 1.0),
    "wind": Effect(
        lambda rng, size, a: _direction(rng, size * a.airplane.speed, "wind_north", "wind_east"),
        0.10, 0.22, lambda s, a: {"wind_x": s["wind_north"], "wind_y": -s["wind_east"]},
    ),
    "fan_jet": Effect(_jet, 0.18, 0.35),
    "ground_effect": Effect(lambda rng, size, a: {"image_vortex": size}, 1.5, 3.0),
    "extra_drag": Effect(
        lambda rng, size, a: {"CD_added": size * a.trim.CD}, 0.25, 0.70,
        lambda s, a: {"drag_added": a.per_speed2 * s["CD_added"]},
    ),
    "flap": Effect(
        lambda rng, size, a: {"CL_added": size * a.trim.CL, "CD_added": 0.08 * size * a.trim.CL},
        0.12, 0.35,
        lambda s, a: {
            "flap_lift": a.per_speed2 * s["CL_added"], "flap_drag": a.per_speed2 * s["CD_added"],
        },
    ),
    "thrust_loss": Effect(
        lambda rng, size, a: {"thrust_lost": size}, 0.15, 0.40,
        lambda s, a: {"thrust_lost": s["thrust_lost"]},
    ),
    "battery_sag": Effect(lambda rng, size, a: {"sag_per_s": size / 60.0}, 0.05, 0.14),
    "propeller_torque": Effect(
        _torque, 0.06, 0.16,
        lambda s, a: dict(
            zip(
                ("torque_roll", "torque_yaw"), _turned(a, s["torque_roll"], s["torque_yaw"]),
                strict=True,
            )
        ),
    ),
    "adverse_yaw": Effect(
        lambda rng, size, a: {"Cnda_added": -size * a.airplane.body.Clda}, 0.10, 0.30,
        lambda s, a: {
            "adverse_yaw": -_turned(
                a, 0.0, a.per_speed2 * a.airplane.body.span * a.airplane.body.da_max
                * s["Cnda_added"],
            )[1],
        }, "aileron",
    ),
    "control_delay": Effect(
        lambda rng, size, a: {"delay_added": size}, 0.04, 0.12,
        lambda s, a: {"control_delay": s["delay_added"]},
    ),
    "actuator_lag": Effect(
        _lag, 0.05, 0.15,
        lambda s, a: (
            {"lag_in_series": s["linkage"]} if "linkage" in s
            else {"actuator_lag": s["servo_added"]}
        ),
    ),
    "trim_bias": Effect(
        _bias, 0.06, 0.20,
        lambda s, a: dict(s),
    ),
    "deadband": Effect(
        lambda rng, size, a: {"deadband": size}, 0.05, 0.13, lambda s, a: dict(s),
    ),
    "aileron_loss": Effect(
        lambda rng, size, a: {"aileron_lost": size}, 0.20, 0.55, lambda s, a: dict(s), "aileron",
    ),
    "mass_change": Effect(
        lambda rng, size, a: {"mass_added": size}, 0.12, 0.35, lambda s, a: dict(s),
    ),
    "cg_shift": Effect(
        _cg, 0.2, 0.6,
        lambda s, a: {"cg_moment": a.airplane.body.mass * s["cg_back"] / a.airplane.body.Jy},
    ),
    "camera_tilt": Effect(
        lambda rng, size, a: _direction(rng, size, "tilt_pitch", "tilt_roll"), 0.025, 0.10,
        lambda s, a: dict(s),
    ),
    "camera_offset": Effect(
        lambda rng, size, a: _direction(
            rng, size * a.airplane.body.span, "camera_forward", "camera_right", "camera_down"
        ), 0.10, 0.40, lambda s, a: dict(s),
    ),
    "time_offset": Effect(
        lambda rng, size, a: {"late": size}, 0.04, 0.12, lambda s, a: {"control_delay": s["late"]},
    ),
    "stall": Effect(_stall, 0.35, 0.7),
    "wing_drag": Effect(
        lambda rng, size, a: {"wing_drag": size * a.trim.CD}, 0.5, 1.0, _wing_drag
    ),
    # in no catalogue
    "rudder_roll": Effect(
        lambda rng, size, a: {"rudder_roll": size * abs(a.airplane.body.Clda) + 0.03 * size},
        0.3, 0.8, needs="rudder",
    ),
    "prop_wash": Effect(lambda rng, size, a: {"prop_wash": size / a.trim.throttle}, 0.6, 1.5),
    "sideslip_pitch": Effect(
        lambda rng, size, a: {"Cmb": _sign(rng) * size * abs(a.airplane.body.Cma)}, 0.3, 0.8,
    ),
    "aeroelastic_roll": Effect(
        lambda rng, size, a: {
            "aeroelastic_roll": _sign(rng) * size
            * (a.airplane.body.Clda * a.airplane.body.da_max or 0.04),
        }, 0.15, 0.4,
    ),
    "thrust_line": Effect(
        lambda rng, size, a: {
            "thrust_line": _sign(rng) * size * a.airplane.body.chord
        }, 0.10, 0.25,
    ),
}  # fmt: skip
OUTSIDE = (
    "rudder_roll", "prop_wash", "sideslip_pitch", "aeroelastic_roll", "thrust_line",
)  # fmt: skip
IN_CATALOGUE = tuple(name for name in EFFECTS if name not in (*OUTSIDE, "none"))
MEASURED = ("tilt_pitch", "tilt_roll", "camera_forward", "camera_right", "camera_down", "late")
JSBSIM = "jsbsim"  # the aircraft of tests/hidden_flights.py, with effects of its own
AIRCRAFT = (*AIRPLANES, JSBSIM)
BEYOND = (*OUTSIDE, *(name for name in hidden_effects.OUTSIDE if name not in OUTSIDE))


def effects_of(aircraft: str) -> tuple[str, ...]:
    """The names of effects that can act on this aircraft: no aileron, no aileron loss."""
    if aircraft == JSBSIM:
        return tuple(hidden_effects.EFFECTS)
    _, aileron, _, rudder = AIRPLANES[aircraft].controls
    there = {"": True, "aileron": aileron, "rudder": rudder}
    return tuple(name for name, effect in EFFECTS.items() if there[effect.needs])


# Cases
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ForeignCase:
    """One case; the answer is in truth."""

    calm: FlightTable
    flight: FlightTable
    truth: dict[str, Any]  # see make_case
    true_states: tuple[Array, Array] = field(repr=False)  # (N, STATES) of the rows of both tables


@dataclass(frozen=True)
class Conditions:
    """What a case is flown and measured under."""

    noise: str | None = None  # a name of NOISES; None is "marker" below 1 kg and "ins" above
    rate_hz: float = 20.0  # rows per second of both tables, 5 to 200
    seconds: tuple[float, float] = (120.0, 90.0)  # of the baseline and of the flight under test
    missing: float = 0.01  # share of the rows without a pose
    correlated: bool = False  # half of the noise's variance is AR(1) with CORRELATION_S
    outliers: float = OUTLIERS  # share of the poses that are off by OUTLIER_SIGMA or so
    jitter: float = 0.0  # stamps are off by up to this much [s]
    size: Mapping[str, float] | None = None  # fields of Hidden or MEASURED instead of drawn ones
    strength: float | None = None  # 0 just visible to 1 plain; None draws it
    onset: float | None = None  # the effect sets in here [s]; None is from before the start
    ramp: float = 0.0  # seconds in which it grows from nothing to its size
    until: float | None = None  # the effect ends here [s]; None is never
    gust: float = 0.0  # root mean square of gusts in both flights, as a share of the airspeed
    calm_wind: float = 0.0  # steady wind in both flights, as a share of the airspeed
    excitation: float = 1.0  # how much the sticks are shaken


def make_case(aircraft: str, effect: str = "none", seed: int = 0, **conditions: Any) -> ForeignCase:
    """Fly a case; the same arguments give the same case.

    Args:
        aircraft: a name of AIRCRAFT.
        effect: a name of EFFECTS that this aircraft can have, or several joined by "+".
        seed: of everything that is drawn.
        conditions: fields of Conditions.

    Returns:
        The case. truth: effect, aircraft, seed, noise, sigma_position, sigma_attitude, size (fields
        of Hidden), kit (the kit's parameters where the two mean the same), outside, onset,
        airframe (mass_g, wing_area_m2, span_m), trim, source and the conditions.

    Raises:
        InputError: a name is unknown, or no flight in ATTEMPTS stayed in the air.
    """
    if aircraft not in AIRCRAFT:
        raise InputError(f"aircraft: expected one of {', '.join(AIRCRAFT)}, got {aircraft!r}")
    names = effect.split("+")
    able = effects_of(aircraft)
    if unknown := [name for name in names if name not in able]:
        raise InputError(
            f"effect: expected names that {aircraft} can have, {', '.join(able)}, "
            f"got {unknown[0]!r}"
        )
    under = Conditions(**conditions)
    if aircraft == JSBSIM:
        return _jsbsim_case(effect, seed, under)
    kind = AIRPLANES[aircraft]
    if under.noise is None:
        under = replace(under, noise="marker" if kind.body.mass < 1.0 else "ins")
    if under.noise not in NOISES:
        raise InputError(f"noise: expected one of {', '.join(NOISES)}, got {under.noise!r}")
    for attempt in range(ATTEMPTS):
        flown = _attempt(aircraft, names, seed, attempt, under)
        if flown is not None:
            return _case(aircraft, effect, seed, attempt, under, flown)
    raise InputError(
        f"seed {seed}: expected a flight of {aircraft} with {effect} that stays in the air, got "
        f"none in {ATTEMPTS}; take a smaller size"
    )


def _jsbsim_case(effect: str, seed: int, under: Conditions) -> ForeignCase:
    """A case of tests/hidden_flights.py: another simulator, its aircraft, noise and effects."""
    able = ("noise", "seconds", "correlated", "jitter", "excitation")
    changed = [
        name
        for name, value in asdict(under).items()
        if name not in able and value != getattr(Conditions(), name)
    ]
    if changed or under.noise not in (None, "marker"):
        raise InputError(
            f"{(changed or ['noise'])[0]}: expected only {', '.join(able)} to be set for {JSBSIM}, "
            "noise to marker; leave it out"
        )
    case = hidden_flights.make_case(
        seed, effect, "marker", under.correlated, calm_seconds=under.seconds[0],
        flight_seconds=under.seconds[1], excitation=under.excitation, jitter=under.jitter,
    )  # fmt: skip
    body, sigma = case.aircraft, NOISES["marker"]
    truth = {
        "effect": effect, "aircraft": JSBSIM, "seed": seed, "noise": "marker",
        "sigma_position": sigma[0], "sigma_attitude": sigma[1], "size": case.truth["size"],
        "kit": case.truth["kit"], "outside": case.truth["outside"], "onset": None,
        "airframe": {
            "mass_g": 1000.0 * body.mass, "wing_area_m2": body.wing_area, "span_m": body.span,
        },
        "trim": {}, "source": "tests/jsbsim_aircraft.py, flown by JSBSim",
        "conditions": asdict(under), "attempts": 1,
    }  # fmt: skip
    return ForeignCase(case.calm, case.flight, truth, case.true_states)


@dataclass(frozen=True)
class _Pair:
    """Both flights of a case and what was drawn for them."""

    around: Around
    sizes: tuple[Size, ...]  # one for each effect
    drawn: Size  # their sum
    hidden: Hidden
    calm: "_Flown"
    flight: "_Flown"


def _attempt(
    aircraft: str, names: list[str], seed: int, attempt: int, under: Conditions
) -> _Pair | None:
    """Draw an aircraft, a day and sizes, fly both flights; None where one does not stay up."""
    kind, identity = AIRPLANES[aircraft], [seed, AIRCRAFT.index(aircraft)]
    rng = np.random.default_rng([*identity, 1, attempt])
    first = redrawn(kind, rng, CASE_SPREAD)
    second = redrawn(first, rng, DAY_SPREAD)
    try:
        trims = trim_level(first, first.speed), trim_level(second, second.speed)
    except ValueError:  # drawn too heavy for its thrust
        return None
    around = Around(second, trims[1], turn_radius(kind))
    sizes = []
    for k, name in enumerate(names):
        of_size = np.random.default_rng([*identity, 2, attempt // SAME_SIZE, k])
        one = _drawn_size(EFFECTS[name], of_size, around, under.strength)
        sizes.append({key: (under.size or {}).get(key, value) for key, value in one.items()})
    drawn: Size = {}
    for one in sizes:
        for key, value in one.items():
            drawn[key] = drawn.get(key, 0.0) + value
    hidden = _hidden(drawn, trims[1], second, under)
    low = "ground_effect" in names or (
        kind.speed < INDOORS and np.random.default_rng([*identity, 7]).random() < 0.3
    )
    weather = _weather(rng, second.speed, under)
    calm = _fly(first, trims[0], CALM, rng, under.seconds[0], under, bool(low), weather)
    if calm is None:
        return None
    flight = _fly(second, trims[1], hidden, rng, under.seconds[1], under, bool(low), weather)
    return None if flight is None else _Pair(around, tuple(sizes), drawn, hidden, calm, flight)


def _case(
    aircraft: str, effect: str, seed: int, attempt: int, under: Conditions, pair: _Pair
) -> ForeignCase:
    """Both flights as they are measured, and the answer."""
    rng = np.random.default_rng([seed, AIRCRAFT.index(aircraft), 3])
    drawn, names = pair.drawn, effect.split("+")
    calm = _measure("calm.csv", pair.calm, rng, under, {}, CALM)
    flight = _measure("flight.csv", pair.flight, rng, under, drawn, pair.hidden)
    kit: Kit = {}
    for name, size in zip(names, pair.sizes, strict=True):
        kit |= EFFECTS[name].kit(size, pair.around)
    airplane, trim = pair.around.airplane, pair.around.trim
    sigma = NOISES[str(under.noise)]
    truth = {
        "effect": effect, "aircraft": aircraft, "seed": seed, "noise": under.noise,
        "sigma_position": sigma[0], "sigma_attitude": sigma[1], "size": drawn, "kit": kit,
        "outside": any(name in OUTSIDE for name in names), "onset": under.onset,
        "airframe": {
            "mass_g": 1000.0 * airplane.body.mass, "wing_area_m2": airplane.body.wing_area,
            "span_m": airplane.body.span,
        },
        "trim": {"speed": airplane.speed, **{k: float(v) for k, v in asdict(trim).items()}},
        "source": airplane.source, "conditions": asdict(under), "attempts": attempt + 1,
    }  # fmt: skip
    return ForeignCase(calm, flight, truth, (pair.calm.after_margin, pair.flight.after_margin))


def turn_radius(airplane: Airplane) -> float:
    """Of the circles it flies, at four fifths of its bank [m]."""
    return float(airplane.speed**2 / (GRAVITY * np.tan(0.8 * airplane.bank)))


def _drawn_size(
    effect: Effect, rng: np.random.Generator, around: Around, strength: float | None
) -> Size:
    share = float(rng.uniform()) if strength is None else strength
    size = effect.draw(rng, float(effect.low * (effect.high / effect.low) ** share), around)
    return {name: float(value) for name, value in size.items()}


def _hidden(drawn: Size, trim: Trim, airplane: Airplane, under: Conditions) -> Hidden:
    """What acts in flight; LEAD_S passes before the table's time is zero."""
    return CALM._replace(
        **{name: value for name, value in drawn.items() if name not in MEASURED},
        V_trim=airplane.speed, throttle_trim=trim.throttle,
        onset=-1e6 if under.onset is None else LEAD_S + under.onset, ramp=under.ramp,
        until=1e9 if under.until is None else LEAD_S + under.until,
        sag_from=LEAD_S + (under.onset or 0.0),
    )  # fmt: skip


class _Weather(NamedTuple):
    steady: tuple[float, float]
    rms: float


def _weather(rng: np.random.Generator, speed: float, under: Conditions) -> _Weather:
    toward, wind = rng.uniform(0.0, 2.0 * np.pi), under.calm_wind * speed
    return _Weather((wind * np.cos(toward), wind * np.sin(toward)), under.gust * speed)


@dataclass(frozen=True)
class _Flown:
    """A flight at the table's rate, from MARGIN_S before the table on."""

    states: Array  # (N, STATES)
    sticks: Array  # (N, 4)
    rate_hz: float

    @property
    def after_margin(self) -> Array:
        return self.states[round(MARGIN_S * self.rate_hz) :]


def _fly(
    airplane: Airplane, trim: Trim, hidden: Hidden, rng: np.random.Generator, seconds: float,
    under: Conditions, low: bool, weather: _Weather,
) -> _Flown | None:  # fmt: skip
    """The flight after LEAD_S, or None where it does not stay in the air.

    The autopilot acts once a row, at most PILOT_HZ times a second; the commands it holds in between
    are what the table has.
    """
    rows_per_action = max(1, round(under.rate_hz / PILOT_HZ))
    period = rows_per_action / under.rate_hz
    per_row = int(np.ceil(period / (0.004 if airplane.speed < INDOORS else 0.008)))
    rows = int(np.ceil((seconds + LEAD_S) / period)) + 2
    pilot = new_pilot(airplane, trim, rng, period, low)
    shake = shaking(airplane, trim, rng, under.excitation)
    doublets = doublet_list(airplane, shake[2, 0], rng, seconds + LEAD_S)
    turns = np.arange(0.0, seconds + LEAD_S, 1.2 * pilot.radius / pilot.speed + 2.0)
    headings = np.column_stack([turns, rng.uniform(-np.pi, np.pi, len(turns))])
    gusts = _gusts(rng, rows, period, weather)
    commands = np.array([trim.throttle, 0.0, trim.elevator, 0.0])
    start = level_state(trim.alpha, airplane.speed, commands)
    start[2] = -pilot.height
    start[VELOCITY] += _in_body(start, gusts[0])
    states, sticks, airspeed = fly(
        airplane.body, hidden, table_of(airplane), airplane.grid, pilot, shake, doublets, headings,
        gusts, start, period / per_row, per_row, rows,
    )  # fmt: skip
    if not np.isfinite(states).all():
        return None
    heights = -states[:, 2]
    stays_up = (
        np.abs(states[:, :2]).max() < 8.0 * pilot.radius + 20.0
        and heights.min() > 0.1 * airplane.body.span + 0.03
        and heights.max() < 4.0 * pilot.height + 10.0
        and airspeed.min() > 0.45 * pilot.speed
        and np.mean(sticks[:, 0] >= 1.0) < 0.3  # a throttle that is always full teaches nothing
    )
    if not stays_up:
        return None
    return _Flown(*_at_rows(states, sticks, period, under.rate_hz, seconds), under.rate_hz)


def _in_body(state: Array, wind: Array) -> Array:
    _, angles = kit_states(state[None])
    roll, pitch, yaw = angles[0]
    R_ned_body = np.diag([1.0, -1.0, -1.0]) @ rotation_world_body(roll, pitch, yaw)
    return R_ned_body.T @ wind


def _gusts(rng: np.random.Generator, rows: int, period: float, weather: _Weather) -> Array:
    """(rows, 3) steady wind and gusts: first-order Gauss-Markov, correlated over four seconds and
    half as strong downward.
    """
    out = np.zeros((rows, 3))
    out[:, :2] = weather.steady
    if weather.rms > 0.0:
        kept = np.exp(-period / 4.0)
        drawn = rng.normal(size=(rows, 3)) * weather.rms * np.array([1.0, 1.0, 0.5])
        for k in range(1, rows):
            drawn[k] = kept * drawn[k - 1] + np.sqrt(1.0 - kept**2) * drawn[k]
        out += drawn
    return out


def _at_rows(
    states: Array, sticks: Array, period: float, rate_hz: float, seconds: float
) -> tuple[Array, Array]:
    """States and sticks at the table's rows and MARGIN_S before, for stamps that are late."""
    t = np.arange(len(states)) * period
    rows = round((seconds + MARGIN_S) * rate_hz) + 1
    when = LEAD_S - MARGIN_S + np.arange(rows) / rate_hz
    last = np.clip(np.floor(when / period + 1e-6).astype(int), 0, len(sticks) - 1)
    return CubicSpline(t, states)(when), sticks[last]


def _measure(
    name: str, flown: _Flown, rng: np.random.Generator, under: Conditions,
    drawn: Size, hidden: Hidden,
) -> FlightTable:  # fmt: skip
    """The table of a flight: poses with errors, stamps from zero on."""
    pitch, roll, *lever, late = (drawn.get(name, 0.0) for name in MEASURED)
    margin = round(MARGIN_S * under.rate_hz)
    count = len(flown.states) - margin
    t = np.arange(-margin, count) / under.rate_hz
    acts = np.array([acting(hidden, LEAD_S + time) for time in t[margin:]])
    poses = CubicSpline(t, flown.states)(t[margin:] - late * acts)
    p_world, angles = kit_states(poses)
    R_world_body = rotation_world_body(angles[:, 0], angles[:, 1], angles[:, 2])
    p_world = p_world + acts[:, None] * (R_world_body @ np.array(lever))
    R_body_camera = rotation_world_body(0.0, 0.0, 0.0).T @ rotation_world_body(
        roll * acts, pitch * acts, 0.0 * acts
    )
    angles = np.stack(euler_from_rotation(R_world_body @ R_body_camera), axis=1)
    error = _pose_error(rng, count, under)
    stamps = t[margin:] + rng.uniform(-under.jitter, under.jitter, count)
    return FlightTable(
        name, np.round(stamps - min(stamps[0], 0.0), 5), p_world + error[:, :3],
        wrap_angle(angles + error[:, 3:]), flown.sticks[margin:],
    )  # fmt: skip


def _pose_error(rng: np.random.Generator, count: int, under: Conditions) -> Array:
    """(count, 6) of positions and of roll, pitch, yaw; nan where no pose is measured."""
    sigma = NOISES[str(under.noise)]
    error = rng.normal(size=(count, 6))
    if under.correlated:
        kept = np.exp(-1.0 / (under.rate_hz * CORRELATION_S))
        slow = rng.normal(size=(count, 6))
        for k in range(1, count):
            slow[k] = kept * slow[k - 1] + np.sqrt(1.0 - kept**2) * slow[k]
        error = np.sqrt(0.5) * (error + slow)
    error *= np.repeat(sigma, 3)
    off, lost = rng.random(count) < under.outliers, rng.random(count) < under.missing
    error[off, :3] += rng.normal(0.0, OUTLIER_SIGMA * sigma[0], (int(off.sum()), 3))
    error[lost] = np.nan
    return error


# Writing
# --------------------------------------------------------------------------------------------------


def airframe_text(case: ForeignCase) -> str:
    """The smallest airframe file: mass_g, wing_area_m2, span_m."""
    return "".join(f"{key} = {value:.6g}\n" for key, value in case.truth["airframe"].items())


def write_cases(out: Path, cases: dict[str, ForeignCase]) -> None:
    """OUT/<name>/calm.csv, flight.csv and airframe.toml of each case, and OUT/truth.json."""
    for name, case in cases.items():
        (out / name).mkdir(parents=True, exist_ok=True)
        write_flight_table(out / name / "calm.csv", case.calm)
        write_flight_table(out / name / "flight.csv", case.flight)
        with atomic_write(out / name / "airframe.toml", text=True) as file:
            file.write(airframe_text(case))
    with atomic_write(out / "truth.json", text=True) as file:
        json.dump({name: case.truth for name, case in cases.items()}, file, indent=1)
