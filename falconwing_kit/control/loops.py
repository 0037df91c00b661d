"""Loops: an aircraft model -> trims, discrete LQR gains with delay and integral action, autopilot.

Lateral and longitudinal motion are decoupled, as for a symmetric aircraft in small deviations
[Stevens, Lewis & Johnson, Aircraft Control and Simulation, 3rd ed., sec. 3.8]. Deviations are from
a steady flight, straight or turning, whose control inputs are fed forward.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.trim import linearise, trim
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
SPEED = 7.0  # [m/s], the paper's minimum speed of this aircraft, and its speed indoors
INTEGRAL_LIMIT = 1.5  # of an integral, in multiples of its size in the axis
POSITION_LIMITS = 1.0, 0.5  # lateral and vertical position error that the loops act on [m]
TABLE_SPEEDS = (0.80, 0.90, 1.0, 1.15)  # shares of the speed
TABLE_CLIMBS = np.radians((-3.0, 0.0, 8.0))
TABLE_BANKS = np.radians((-40.0, -20.0, 0.0, 20.0, 40.0))


@dataclass(frozen=True)
class Reference:
    """The steady flight to hold at this moment."""

    p_world: Array  # (3,) the nearest point of the reference path [m]
    yaw: float  # course of the path [rad], positive to the right
    climb: float  # [rad], positive upward
    speed: float  # [m/s]
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
        model: 12-state; its own delay and lag count as delay.
        axis: `LATERAL` or `LONGITUDINAL`.
        speed: [m/s].
        delay: from a command to its arrival at the aircraft [s].

    Raises:
        InputError: the model has no body rates, cannot be trimmed, or cannot be stabilised.
    """
    import control

    if model.form != "rates":
        raise InputError(
            "model: expected the 12-state model (rates_model), got the 9-state model, which has no"
            " body rates"
        )
    require_range("delay", delay, low=0.0, high=0.5)
    own = (max(model.values.get(name, 0.0), 0.0) for name in ("delay", "lag"))
    total_delay = sum(own, delay)
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
        gain = control.dlqr(A, B, np.diag(sizes**-2.0), np.diag(travels**-2.0))[0]
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            f"model: no gain stabilises it at {speed:g} m/s ({error}); check the model's values"
        ) from None
    loop = ClosedLoop(axis, A, B, np.asarray(gain, np.float64))
    if not np.abs(loop.poles).max() < 1.0:
        raise InputError(f"model: no gain stabilises it at {speed:g} m/s; check the model's values")
    return loop


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
        # e^([[A, B], [0, 0]] t) holds e^(A t) and its integral times B in its upper rows.
        both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * seconds)
        return both[:n, :n], both[:n, n:]

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
        """Solve the trims; InputError where the model cannot fly one of them."""
        self._axes = np.array(TABLE_SPEEDS) * speed, TABLE_CLIMBS, TABLE_BANKS
        speeds, climbs, banks = self._axes
        self._values = np.array(
            [[[_steady_flight(model, v, c, b) for b in banks] for c in climbs] for v in speeds]
        )

    def at(self, speed: float, climb: float, bank: float) -> tuple[Array, Array]:
        """The steady flight at a speed [m/s], climb angle and bank [rad].

        Beyond the table's ends the slope of the last interval continues.

        Returns:
            Control inputs (4,) in the order of COMMAND_NAMES, and (5,): pitch, yaw minus course,
            p, q, r [rad, rad/s].
        """
        values = self._values
        for axis, x in zip(self._axes, (speed, climb, bank), strict=True):
            i = min(max(int(np.searchsorted(axis, x)) - 1, 0), len(axis) - 2)
            share = (x - axis[i]) / (axis[i + 1] - axis[i])
            values = (1.0 - share) * values[i] + share * values[i + 1]
        return values[:4], values[4:]


def _steady_flight(model: Model, speed: float, climb: float, bank: float) -> Array:
    steady = trim(model, speed, climb, bank)
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


class Autopilot:
    """Tracks a reference: feedforward of the steady flight, LQR on the deviations from it."""

    def __init__(self, model: Model, speed: float = SPEED, delay: float = LINK_DELAY_S) -> None:
        """Design both loops; InputError where the model cannot be trimmed or stabilised."""
        self.speed, (self.trims, *self.loops) = speed, _design(*model_key(model), speed, delay)
        self._integrals = [np.zeros(len(loop.axis.integrals)) for loop in self.loops]

    def command(
        self, state: State, reference: Reference, past_commands: Array, idle: bool = False
    ) -> Command:
        """The command that returns the aircraft to the reference, within its limits.

        Args:
            state: the measured state, finite.
            reference: the steady flight to hold.
            past_commands: (n, 4) sent before, oldest first; rows of zeros where there was none.
            idle: True sets the throttle to zero and lets the speed fall.

        Raises:
            InputError: past_commands has another shape.
        """
        speed = float(np.linalg.norm(state.v_world)) if idle else reference.speed
        steady, attitude = self.trims.at(speed, reference.climb, reference.bank)
        deviations = _deviations(state, reference, speed, attitude)
        past = require_shape("past_commands", past_commands, (None, 4))[::-1]
        control_inputs = steady.copy()
        for loop, integral in zip(self.loops, self._integrals, strict=True):
            columns = [COMMAND_NAMES.index(name) for name in loop.axis.control_inputs]
            # State of the augmented model: deviations, delayed inputs newest first, integrals. An
            # input that was never sent counts as the steady flight's.
            delayed = [
                (row if row.any() else steady)[columns] - steady[columns]
                for row in past[: loop.delay_steps]
            ]
            delayed += [np.zeros(len(columns))] * (loop.delay_steps - len(delayed))
            x = [deviations[name] for name in loop.axis.states]
            control_inputs[columns] -= loop.gain @ np.concatenate([x, *delayed, integral])
            # Anti-windup: the integrals are bounded [Astrom & Murray, sec. 11.4: windup].
            error = np.array([deviations[name] for name in loop.axis.integrals])
            limit = INTEGRAL_LIMIT * np.array(list(loop.axis.integrals.values()))
            integral[:] = np.clip(integral + CONTROL_PERIOD_S * error, -limit, limit)
        return Command.clip(0.0 if idle else control_inputs[0], *control_inputs[1:])

    def level(self) -> Command:
        """The control inputs of straight level flight, for use without a state."""
        return Command.clip(*self.trims.at(self.speed, 0.0, 0.0)[0])


def _deviations(
    state: State, reference: Reference, speed: float, attitude: Array
) -> dict[str, float]:
    """Deviations from the reference in axes along its course: x ahead, y left, z up."""
    pitch, crab, p, q, r = attitude
    ahead, left = course_axes(reference.yaw)
    offset, v = state.p_world - reference.p_world, state.v_world
    lateral, vertical = (
        min(max(float(d), -limit), limit)
        for d, limit in zip((offset @ left, offset[2]), POSITION_LIMITS, strict=True)
    )
    return {
        "py": lateral,
        "pz": vertical,
        "pitch": state.pitch - pitch,
        "yaw": float(wrap_angle(state.yaw - reference.yaw - crab)),
        "roll": state.roll - reference.bank,
        "vx": float(v @ ahead) - speed * math.cos(reference.climb),
        "vy": float(v @ left),
        "vz": float(v[2]) - speed * math.sin(reference.climb),
        "p": state.rates_body[0] - p,
        "q": state.rates_body[1] - q,
        "r": state.rates_body[2] - r,
    }


def course_axes(yaw: float) -> tuple[Array, Array]:
    """Level unit vectors ahead (3,) and left (3,) of a course [rad], in the world."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c, -s, 0.0]), np.array([s, c, 0.0])
