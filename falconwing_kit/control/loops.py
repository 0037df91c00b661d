"""Loops: an aircraft model -> trims, discrete LQR gains with delay and integral action, autopilot.

Lateral and longitudinal motion are decoupled, as for a symmetric aircraft in small deviations
[Stevens, Lewis & Johnson, Aircraft Control and Simulation, 3rd ed., sec. 3.8]. Deviations are from
a steady flight, straight or turning, whose control inputs are fed forward.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.trim import Trim, linearise, trim
from falconwing_kit.control.inverse import KIT_SPEED, CommandMap, design_model, wind_velocity
from falconwing_kit.control.riccati import lqr_gain
from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import wrap_angle
from falconwing_kit.core.messages import (
    COMMAND_NAMES,
    CONTROL_PERIOD_S,
    STATE_NAMES,
    Command,
    State,
)

LINK_DELAY_S = 0.05  # from command to transmitter output: frame grabber, serial line, PPM frame
SPEED = KIT_SPEED  # [m/s] of the kit's aircraft
# Total delay up to which the sizes of the axes hold [s]; the kit's aircraft has 0.10. Beyond it the
# position error counts less, as the square: a longer delay needs a lower bandwidth.
SIZED_FOR_DELAY_S = 0.11
INTEGRAL_LIMIT = 1.5  # of an integral, in multiples of its size in the axis
POSITION_LIMITS = {"py": 1.0, "pz": 0.5}  # most position error that the loops act on [m]
TABLE_SPEEDS = (0.80, 0.90, 1.0, 1.15)  # shares of the speed
TABLE_CLIMBS = np.radians((-3.0, 0.0, 8.0))
TABLE_BANKS = np.radians((-40.0, -20.0, 0.0, 20.0, 40.0))
# Where level flight is trimmed again, for a model whose forces depend on height or time.
TABLE_HEIGHTS = (0.15, 0.3, 0.6, 1.0, 2.0)  # [m]; the last is that of all other trims
MIN_CHANGE = 1e-5  # of a trim's control inputs and angles; smaller ones are rounding
TABLE_TIMES = (0.0, 30.0, 60.0, 120.0, 240.0)  # [s]; the first is that of all other trims


@dataclass(frozen=True)
class Reference:
    """The steady flight to hold at this moment, over the floor."""

    p_world: Array  # (3,) the nearest point of the reference path [m]
    yaw: float  # course of the path [rad], positive to the right
    climb: float  # of the path [rad], positive upward
    speed: float  # over the floor, along the path [m/s]
    bank: float  # of the path's turn [rad], right wing down positive


@dataclass(frozen=True)
class Axis:
    """States, control inputs and integrals of one loop, each with the size that is acceptable.

    Weights follow from the sizes, Q = diag(1 / size^2) and R = diag(1 / travel^2) [Bryson & Ho,
    Applied Optimal Control, sec. 5.2].
    """

    states: dict[str, float]
    control_inputs: dict[str, float]
    integrals: dict[str, float]  # of these states, in their unit times seconds


LATERAL = Axis(
    states={"py": 0.25, "yaw": 0.35, "roll": 0.5, "vy": 1.5, "p": 4.0, "r": 2.0},
    control_inputs={"aileron": 0.6, "rudder": 0.5},
    integrals={"py": 0.6},
)
LONGITUDINAL = Axis(
    states={"pz": 0.15, "pitch": 0.3, "vx": 0.7, "vz": 1.0, "q": 2.0},
    control_inputs={"throttle": 0.35, "elevator": 0.5},
    integrals={"pz": 0.35, "vx": 4.0},
)


@dataclass(frozen=True)
class ClosedLoop:
    """A discrete linear model with delay and integrals, and its gain: u = -gain @ x."""

    axis: Axis
    A: Array  # (n, n): deviations, the control inputs of the last steps newest first, integrals
    B: Array  # (n, inputs)
    gain: Array  # (inputs, n)

    @property
    def poles(self) -> NDArray[np.complex128]:
        """(n,) eigenvalues of A - B gain; stable where all lie inside the unit circle."""
        return np.linalg.eigvals(self.A - self.B @ self.gain).astype(np.complex128)

    @property
    def A_returning(self) -> Array:
        """(m, m): A - B gain of deviations and delayed inputs alone, without the integrals."""
        m = len(self.A) - len(self.axis.integrals)
        return (self.A - self.B @ self.gain)[:m, :m]

    @property
    def delay_steps(self) -> int:
        """Number of past control inputs in the state."""
        delayed = len(self.A) - len(self.axis.states) - len(self.axis.integrals)
        return delayed // len(self.axis.control_inputs)


def design_loop(
    model: Model, axis: Axis, speed: float = SPEED, delay: float = LINK_DELAY_S
) -> ClosedLoop:
    """LQR of one axis around straight level flight, u = -K x, K from the discrete Riccati equation.

    The state is augmented by the delayed control inputs and by integrals of the states that must
    have no steady-state error [Astrom & Murray, Feedback Systems, sec. 7.4-7.5: integral action in
    state feedback; Astrom & Wittenmark, Computer-Controlled Systems, 3rd ed., sec. 2.3: sampling a
    system with delay].

    Args:
        model: 12-state; its own delay and lag count as delay, and those of its effects. Its wind
            does not count: the loops act on deviations from a flight through the air.
        axis: `LATERAL` or `LONGITUDINAL`.
        speed: [m/s].
        delay: from a command to its arrival at the aircraft [s].

    Raises:
        InputError: the model has no body rates, cannot be trimmed, or cannot be stabilised.
    """
    if model.form != "rates":
        raise InputError(
            "model: expected the 12-state model (rates_model), got the 9-state model, which has no"
            " body rates"
        )
    require_range("delay", delay, low=0.0, high=0.5)
    model = design_model(model)
    model_delays = (max(model.values.get(name, 0.0), 0.0) for name in ("delay", "lag"))
    total_delay = sum(model_delays, delay)
    axis = _sized_for(axis, total_delay)
    # Rows and columns of this axis, discretised with the delay.
    A, B = linearise(model, trim(model, speed))
    rows = [STATE_NAMES.index(name) for name in axis.states]
    columns = [COMMAND_NAMES.index(name) for name in axis.control_inputs]
    A, B = augment_delay(A[np.ix_(rows, rows)], B[np.ix_(rows, columns)], total_delay)
    # Integral action: z[k+1] = z[k] + dt x[k] for each integrated state.
    integral_rows = np.zeros((len(axis.integrals), len(A)))
    for row, name in enumerate(axis.integrals):
        integral_rows[row, list(axis.states).index(name)] = CONTROL_PERIOD_S
    n_delayed = len(A) - len(axis.states)
    zeros = np.zeros((len(A), len(integral_rows)))
    A = np.block([[A, zeros], [integral_rows, np.eye(len(integral_rows))]])
    B = np.concatenate([B, np.zeros((len(integral_rows), B.shape[1]))])
    # Bryson's rule; delayed control inputs carry no cost of their own (size infinite).
    sizes = np.array([*axis.states.values(), *[np.inf] * n_delayed, *axis.integrals.values()])
    travels = np.array(list(axis.control_inputs.values()))
    try:
        gain = lqr_gain(A, B, np.diag(sizes**-2.0), np.diag(travels**-2.0))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            f"model: no gain stabilises it at {speed:g} m/s ({error}); check the model's values"
        ) from None
    loop = ClosedLoop(axis, A, B, gain)
    if not np.abs(loop.poles).max() < 1.0:
        raise InputError(f"model: no gain stabilises it at {speed:g} m/s; check the model's values")
    return loop


def _sized_for(axis: Axis, delay: float) -> Axis:
    """An axis with the acceptable position error enlarged for a long total delay [s].

    A delay tau bounds the bandwidth to about 1 / tau [Astrom & Murray, Feedback Systems, sec. 12.4:
    limits of performance]; from bank or pitch to position there are two integrators, so the gain of
    the position goes with the bandwidth squared, and its size with tau^2; of its integral alike.
    """
    factor = max(delay / SIZED_FOR_DELAY_S, 1.0) ** 2

    def enlarge(sizes: dict[str, float]) -> dict[str, float]:
        return {k: size * factor if k in ("py", "pz") else size for k, size in sizes.items()}

    return replace(axis, states=enlarge(axis.states), integrals=enlarge(axis.integrals))


def augment_delay(
    A: Array, B: Array, delay: float, dt: float = CONTROL_PERIOD_S
) -> tuple[Array, Array]:
    """Discretise a linear model with zero-order-held, delayed control inputs.

    With delay = (d - 1) dt + rest, x[k+1] = Phi x[k] + G0 u[k-d+1] + G1 u[k-d]; Phi = e^(A dt),
    G0 = int_0^(dt-rest) e^(A s) ds B, G1 = e^(A (dt-rest)) int_0^rest e^(A s) ds B
    [Astrom & Wittenmark, Computer-Controlled Systems, 3rd ed., sec. 2.3].

    Args:
        A: (n, n) continuous time.
        B: (n, m).
        delay: [s], >= 0.
        dt: step [s].

    Returns:
        A (n + d m, n + d m) and B (n + d m, m) of the state (x[k], u[k-1], ..., u[k-d]).
    """
    from scipy.linalg import expm

    n, m = B.shape
    steps = math.ceil(delay / dt - 1e-9)
    rest = delay - (steps - 1) * dt if steps else 0.0

    def discretise(seconds: float) -> tuple[Array, Array]:
        """e^(A t) (n, n) and its integral from 0 to t times B (n, m)."""
        # Both are in the upper rows of e^([[A, B], [0, 0]] t).
        exponential = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * seconds)
        return exponential[:n, :n], exponential[:n, n:]

    (Phi_early, G0), (_, G_late), Phi = discretise(dt - rest), discretise(rest), discretise(dt)[0]
    size = n + steps * m
    A_delayed, B_delayed = np.zeros((size, size)), np.zeros((size, m))
    A_delayed[:n, :n] = Phi
    # Columns that u[k], u[k-1], ..., u[k-d] act through: the first is B, the others lie in A.
    inputs = [B_delayed, *(A_delayed[:, n + i * m : n + (i + 1) * m] for i in range(steps))]
    inputs[max(steps - 1, 0)][:n] = G0
    if steps:
        inputs[steps][:n] = Phi_early @ G_late
        # Shift register: u[k] enters, each stored input moves one place down.
        B_delayed[n : n + m] = np.eye(m)
        A_delayed[n + m :, n : size - m] = np.eye(size - n - m)
    return A_delayed, B_delayed


class TrimTable:
    """Steady flights around a speed, straight and turning, with linear interpolation."""

    def __init__(self, model: Model, speed: float = SPEED) -> None:
        """Solve the trims; InputError where the model cannot fly straight and level.

        A steady flight beyond a control limit keeps its control inputs, and the command is limited
        when it is sent; one without a balance takes the nearest flight that has one.
        """
        model = design_model(model)
        self._axes = np.array(TABLE_SPEEDS) * speed, TABLE_CLIMBS, TABLE_BANKS
        level = _steady_flight(trim(model, speed))
        shape = tuple(len(axis) for axis in self._axes)
        self._values = np.full((*shape, len(level)), np.nan)
        knots = list(np.ndindex(shape))
        offsets = self._offsets(speed)
        # From level flight outwards, so that a neighbour is known where there is no balance.
        for knot in sorted(knots, key=lambda index: float(offsets[index])):
            v, c, b = (axis[i] for axis, i in zip(self._axes, knot, strict=True))
            try:
                found = _steady_flight(trim(model, v, c, b, within_limits=False))
            except InputError:
                found = self._nearest(knot, level)
            self._values[knot] = found
        self._changes = (
            (np.array(TABLE_HEIGHTS), _level_changes(model, speed, "height", TABLE_HEIGHTS, 2.0)),
            (np.array(TABLE_TIMES), _level_changes(model, speed, "time", TABLE_TIMES, 0.0)),
        )

    def _offsets(self, speed: float) -> Array:
        """Distance of each knot from level flight, in intervals of the table."""
        parts = [
            np.abs(axis - centre) / np.ptp(axis)
            for axis, centre in zip(self._axes, (speed, 0.0, 0.0), strict=True)
        ]
        return np.asarray(np.add.outer(np.add.outer(parts[0], parts[1]), parts[2]))

    def _nearest(self, knot: tuple[int, ...], level: Array) -> Array:
        """The values of the nearest knot that is solved already; level flight before the first."""
        solved = np.argwhere(np.isfinite(self._values[..., 0]))
        if len(solved) == 0:
            return level
        nearest = solved[np.argmin(np.abs(solved - knot).sum(axis=1))]
        return np.asarray(self._values[tuple(nearest)])

    def at(
        self, speed: float, climb: float, bank: float, height: float = 2.0, t: float = 0.0
    ) -> tuple[Array, Array]:
        """The steady flight through the air at a speed [m/s], climb angle and bank [rad].

        Beyond the table's ends the slope of the last interval continues. Where the model's forces
        depend on height [m] or time [s], the change of level flight with them is added.

        Returns:
            Control inputs (4,) in the order of COMMAND_NAMES, and (5,): pitch, yaw minus course,
            p, q, r [rad, rad/s].
        """
        values = self._values
        for axis, x in zip(self._axes, (speed, climb, bank), strict=True):
            # interval of the table, and where in it; beyond 0..1 outside the table
            i = min(max(int(np.searchsorted(axis, x)) - 1, 0), len(axis) - 2)
            share = (x - axis[i]) / (axis[i + 1] - axis[i])
            values = (1.0 - share) * values[i] + share * values[i + 1]
        for (knots, changes), x in zip(self._changes, (height, t), strict=True):
            if changes is not None:
                values = values + [np.interp(x, knots, column) for column in changes.T]
        return values[:4], values[4:]


def _level_changes(
    model: Model, speed: float, variable: str, knots: tuple[float, ...], usual: float
) -> Array | None:
    """Change (k, 9) of level flight with height [m] or time [s]; None where there is none.

    Where there is no balance, as with an empty battery, the change at the knot before is kept.
    """
    level = _steady_flight(trim(model, speed))

    def change(x: float) -> Array | None:
        try:
            steady = trim(model, speed, within_limits=False, **{variable: x})
        except InputError:
            return None
        return _steady_flight(steady) - level

    far = change(max(knots, key=lambda x: abs(x - usual)))
    if far is not None and np.abs(far).max() < MIN_CHANGE:
        return None
    found, last = {}, np.zeros_like(level)
    for x in sorted(knots, key=lambda x: abs(x - usual)):
        last = last if (new := change(x)) is None else new
        found[x] = last
    return np.array([found[x] for x in knots])


def _steady_flight(steady: Trim) -> Array:
    """Control inputs, pitch, yaw minus course and body rates (9,) of a trim, for the table."""
    x = steady.state
    crab = math.atan2(x[7], x[6])  # the nose points along world x, the course this far to its left
    return np.array([*steady.command, x[3], crab, *x[9:12]])


def model_key(model: Model) -> tuple[Any, ...]:
    """Form, terms, winds, parameters and values of a model: hashable, for caches.

    Effects on control inputs and on measured poses are left out: they change no force.
    """
    return model.form, model.terms, model.winds, model.parameters, tuple(model.values.items())


@lru_cache(maxsize=32)
def _design(
    form: Any, terms: Any, winds: Any, parameters: Any, values: Any, speed: float, delay: float
) -> tuple[TrimTable, ClosedLoop, ClosedLoop]:
    """Trims and both loops of a model given by its `model_key`; cached, for every trial has one."""
    model = Model(form, terms, winds, parameters, dict(values))
    lateral, longitudinal = (design_loop(model, a, speed, delay) for a in (LATERAL, LONGITUDINAL))
    return TrimTable(model, speed), lateral, longitudinal


class ReferenceTracker:
    """What both autopilots share: the steady flight of a reference, deviations from it, and the
    model's command maps.

    In a wind the steady flight is that through the air whose velocity adds up with the wind to the
    reference's: the nose points into the wind by the crab angle and the track stays. Control
    positions are turned into the commands that lead to them through the model's command maps.
    """

    def __init__(self, model: Model, speed: float, trims: TrimTable) -> None:
        self.speed, self.model, self.trims = speed, model, trims
        self.command_map = CommandMap(model)

    def wind_at(self, p_world: Array, t: float) -> Array:
        """The model's wind (3,) at a place (3,) [m] and a time [s], in the world [m/s]."""
        return wind_velocity(self.model, p_world, t)

    def deviations(
        self, state: State, reference: Reference, idle: bool, t: float
    ) -> tuple[Array, dict[str, float], float]:
        """Control positions (4,) of the steady flight, deviations from it, and its speed [m/s].

        With the throttle idle that is the steady flight at the speed flown.
        """
        speed = float(np.linalg.norm(state.v_world)) if idle else reference.speed
        reference = replace(reference, speed=speed)
        wind = self.wind_at(state.p_world, t) if self.model.winds else None
        airspeed, climb, drift = air_velocity(reference, wind)
        steady, attitude = self.trims.at(
            airspeed, climb, reference.bank, float(state.p_world[2]), t
        )
        return steady, course_deviations(state, reference, attitude, drift), speed

    def to_command(self, positions: Array, idle: bool) -> Command:
        """The command that leads to control positions (4,), within its limits."""
        throttle, *surfaces = self.command_map.commands(positions)
        return Command.clip(0.0 if idle else throttle, *surfaces)

    def begin_return(self) -> None:
        """Another has flown meanwhile; without a memory of the way back there is nothing to do."""

    def level(self) -> Command:
        """The commands of straight level flight through the air, for use without a state."""
        return self.to_command(self.trims.at(self.speed, 0.0, 0.0)[0], idle=False)


class Autopilot(ReferenceTracker):
    """Tracks a reference: feedforward of the steady flight, LQR on the deviations from it."""

    def __init__(
        self, model: Model, speed: float = SPEED, delay: float = LINK_DELAY_S,
        integrates: bool = True, begins_beside: bool = False,
    ) -> None:  # fmt: skip
        """Design both loops; InputError where the model cannot be trimmed or stabilised.

        Args:
            model: the aircraft.
            speed: that the loops are designed for [m/s].
            delay: from a command to its arrival at the aircraft [s].
            integrates: without integral action it is right only for the very model that flies, but
                then also while another pilot flies: there is nothing in it that winds up.
            begins_beside: whether the flight begins beside its reference. Then the way back to it
                is not integrated, from where its own commands act.
        """
        trims, *self.loops = _design(*model_key(design_model(model)), speed, delay)
        super().__init__(model, speed, trims)
        self._integrates, self._begins_beside = integrates, begins_beside
        self._integrals = [np.zeros(len(loop.axis.integrals)) for loop in self.loops]
        self._expected: list[Array | None]
        self._is_inside: list[bool]
        self.begin_return()

    def command(
        self,
        state: State,
        reference: Reference,
        past_commands: Array,
        idle: bool = False,
        t: float = 0.0,
    ) -> Command:
        """The command that returns the aircraft to the reference, within its limits.

        Args:
            state: the state, finite.
            reference: the steady flight to hold.
            past_commands: (n, 4) sent before, oldest first; rows of zeros where there was none.
            idle: True sets the throttle to zero and lets the speed fall.
            t: time since the start of the flight [s].

        Raises:
            InputError: past_commands has another shape.
        """
        steady, deviations, _ = self.deviations(state, reference, idle, t)
        past = require_shape("past_commands", past_commands, (None, 4))[::-1]
        control_inputs = steady.copy()
        for k, loop in enumerate(self.loops):
            columns = [COMMAND_NAMES.index(name) for name in loop.axis.control_inputs]
            # State of the augmented model: deviations, delayed inputs newest first, integrals. An
            # input that was never sent counts as the steady flight's.
            delayed = [
                (self.command_map.positions(row) if row.any() else steady)[columns]
                - steady[columns]
                for row in past[: loop.delay_steps]
            ]
            delayed += [np.zeros(len(columns))] * (loop.delay_steps - len(delayed))
            x = np.concatenate([[deviations[name] for name in loop.axis.states], *delayed])
            control_inputs[columns] -= loop.gain @ np.concatenate([x, self._integrals[k]])
            if self._integrates:
                self._integrate(k, x)
        return self.to_command(control_inputs, idle)

    def begin_return(self) -> None:
        """Expect a new way back, from the next deviation on: another has flown meanwhile."""
        self._expected = [None for loop in self.loops]
        self._is_inside = [False for loop in self.loops]

    def _integrate(self, k: int, x: Array) -> None:
        """Add the deviations x to the integrals of a loop, without those of the way back.

        The way back is the design's own, x[i+1] = (A - B K) x[i] without the integrals and without
        limits of the commands, from the first deviation within the limit of the position error.
        Were it integrated too, the aircraft would fly past its reference: an integral returns to
        zero only where the areas on both sides are equal. Deviations before it are left out, what
        differs from it is integrated, and so is everything once it is over.
        """
        loop, states = self.loops[k], list(self.loops[k].axis.states)
        if self._begins_beside:
            name = next(name for name in states if name in POSITION_LIMITS)
            expected = self._expected[k]
            is_inside = abs(x[states.index(name)]) < POSITION_LIMITS[name]
            if expected is None or not (is_inside or self._is_inside[k]):
                expected = x
            self._is_inside[k] |= is_inside
            x, self._expected[k] = x - expected, loop.A_returning @ expected
        error = x[[states.index(name) for name in loop.axis.integrals]]
        # Anti-windup: the integrals are bounded [Astrom & Murray, sec. 11.4: windup].
        limit = INTEGRAL_LIMIT * np.array(list(loop.axis.integrals.values()))
        self._integrals[k] = np.clip(self._integrals[k] + CONTROL_PERIOD_S * error, -limit, limit)


def air_velocity(reference: Reference, wind: Array | None) -> tuple[float, float, float]:
    """The flight through the air that gives a reference over the floor: v_air = v_ground - w.

    [Beard & McLain, Small Unmanned Aircraft, sec. 2.4: wind triangle]

    Args:
        reference: over the floor.
        wind: (3,) in the world [m/s]; None for still air.

    Returns:
        Airspeed [m/s], climb angle through the air [rad], and the crab angle: course through the
        air minus that over the floor [rad], positive to the right, so with a wind to the left.
    """
    if wind is None:
        return reference.speed, reference.climb, 0.0
    ahead, left = course_axes(reference.yaw)
    level = reference.speed * math.cos(reference.climb) - float(wind @ ahead)
    up = reference.speed * math.sin(reference.climb) - float(wind[2])
    across = float(wind @ left)
    return (
        math.hypot(level, across, up),
        math.atan2(up, math.hypot(level, across)),
        math.atan2(across, level),
    )


def course_deviations(
    state: State, reference: Reference, attitude: Array, drift: float
) -> dict[str, float]:
    """Deviations from the reference in axes along its course: x ahead, y left, z up.

    attitude (5,) is that of the steady flight through the air, drift its crab angle [rad].
    """
    pitch, crab, p, q, r = attitude
    ahead, left = course_axes(reference.yaw)
    offset, v = state.p_world - reference.p_world, state.v_world
    lateral, vertical = (
        min(max(float(d), -limit), limit)
        for d, limit in zip((offset @ left, offset[2]), POSITION_LIMITS.values(), strict=True)
    )
    return {
        "py": lateral,
        "pz": vertical,
        "pitch": state.pitch - pitch,
        "yaw": float(wrap_angle(state.yaw - reference.yaw - drift - crab)),
        "roll": state.roll - reference.bank,
        "vx": float(v @ ahead) - reference.speed * math.cos(reference.climb),
        "vy": float(v @ left),
        "vz": float(v[2]) - reference.speed * math.sin(reference.climb),
        "p": state.rates_body[0] - p,
        "q": state.rates_body[1] - q,
        "r": state.rates_body[2] - r,
    }


def course_axes(yaw: float) -> tuple[Array, Array]:
    """Level unit vectors ahead (3,) and left (3,) of a course [rad], in the world."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c, -s, 0.0]), np.array([s, c, 0.0])
