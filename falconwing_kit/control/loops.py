"""Loops: an aircraft model -> trims and LQR gains for 20 Hz with its delay, and the autopilot that
holds a reference.

Lateral and longitudinal motion are taken apart, as they are for a symmetric aircraft in small
deviations [Stevens, Lewis & Johnson, Aircraft Control and Simulation, 3rd ed., sec. 3.8]. Each
deviates from a steady flight, straight or turning, whose sticks are fed forward.
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
from falconwing_kit.core.messages import COMMAND_NAMES, STATE_NAMES, Command, State

STEP_S = 0.05  # 20 Hz
LINK_DELAY_S = 0.05  # from command to transmitter output: frame grabber, serial line, PPM frame
SPEED = 7.0  # m/s, the paper's minimum speed of this aircraft, and what it flies indoors
INTEGRAL_LIMIT = 1.5  # of an integral, in the sizes of its axis
TABLE_SPEEDS = (0.80, 0.90, 1.0, 1.15)  # shares of the speed
TABLE_CLIMBS, TABLE_BANKS = (
    np.radians((-3.0, 0.0, 8.0)),
    np.radians((-40.0, -20.0, 0.0, 20.0, 40.0)),
)


@dataclass(frozen=True)
class Reference:
    """The steady flight wanted at this moment."""

    p_world: Array  # (3,) the nearest point of the wanted path [m]
    yaw: float  # course of the path [rad], positive to the right
    climb: float  # [rad], positive upward
    speed: float  # [m/s]
    bank: float  # of the turn the path asks for [rad], right wing down positive


@dataclass(frozen=True)
class Axis:
    """What one loop is about: deviations it sees and how large each may be, sticks it has and how
    far each may move.

    Weights follow from the sizes, Q = diag(1 / size^2) and R = diag(1 / travel^2) [Bryson & Ho,
    Applied Optimal Control, sec. 5.2].
    """

    states: dict[str, float]
    control_inputs: dict[str, float]
    integrals: dict[str, float]  # of these states, in their unit times seconds


LATERAL = Axis(
    {"py": 0.25, "yaw": 0.35, "roll": 0.5, "vy": 1.5, "p": 4.0, "r": 2.0},
    {"aileron": 0.6, "rudder": 0.5},
    {"py": 0.6},
)
LONGITUDINAL = Axis(
    {"pz": 0.15, "pitch": 0.3, "vx": 0.7, "vz": 1.0, "q": 2.0},
    {"throttle": 0.35, "elevator": 0.5}, {"pz": 0.35, "vx": 4.0},
)  # fmt: skip


@dataclass(frozen=True)
class ClosedLoop:
    """A discrete linear model with its delay and integrals, and the gain that closes it: sticks =
    -gain @ state.
    """

    axis: Axis
    A: Array  # (n, n): deviations, the sticks of the last steps newest first, integrals
    B: Array  # (n, sticks)
    gain: Array  # (sticks, n)

    @property
    def poles(self) -> NDArray[np.complex128]:
        """(n,) eigenvalues of A - B gain; all inside the unit circle where the loop is stable."""
        return np.linalg.eigvals(self.A - self.B @ self.gain).astype(np.complex128)

    @property
    def delay_steps(self) -> int:
        """How many past sticks the state holds."""
        return (len(self.A) - len(self.axis.states) - len(self.axis.integrals)) // len(
            self.axis.control_inputs
        )


def design_loop(
    model: Model, axis: Axis, speed: float = SPEED, delay: float = LINK_DELAY_S
) -> ClosedLoop:
    """LQR of one axis around straight level flight, u = -K x with K from the discrete Riccati
    equation.

    The state is augmented by the sticks on their way and by integrals of what must have no steady
    error [Astrom & Murray, Feedback Systems, sec. 7.4-7.5: integral action in state feedback;
    Astrom & Wittenmark, Computer-Controlled Systems, 3rd ed., sec. 2.3: sampling a system with
    delay].

    Args:
        model: the aircraft's 12-state model; its own delay and lag count as delay.
        axis: `LATERAL` or `LONGITUDINAL`.
        speed: [m/s].
        delay: from a command to its arrival at the aircraft [s].

    Returns:
        The loop.

    Raises:
        InputError: the model has no body rates, cannot fly so, or no gain holds it.
    """
    import control

    if model.form != "rates":
        raise InputError(
            "model: expected the 12-state model (rates_model), got the 9-state model, which has no body rates"
        )
    require_range("delay", delay, low=0.0, high=0.5)
    total = (
        delay + max(model.values.get("delay", 0.0), 0.0) + max(model.values.get("lag", 0.0), 0.0)
    )
    A, B = linearise(model, trim(model, speed))
    rows = [STATE_NAMES.index(name) for name in axis.states]
    columns = [COMMAND_NAMES.index(name) for name in axis.control_inputs]
    A, B = augment_delay(A[np.ix_(rows, rows)], B[np.ix_(rows, columns)], total)
    integral_rows = np.zeros((len(axis.integrals), len(A)))
    for row, name in enumerate(axis.integrals):
        integral_rows[row, list(axis.states).index(name)] = STEP_S
    zeros = np.zeros((len(A), len(integral_rows)))
    A = np.block([[A, zeros], [integral_rows, np.eye(len(integral_rows))]])
    B = np.concatenate([B, np.zeros((len(integral_rows), B.shape[1]))])
    delayed_inputs = [np.inf] * (len(A) - len(axis.states) - len(axis.integrals))
    sizes = np.array([*axis.states.values(), *delayed_inputs, *axis.integrals.values()])
    try:
        gain = control.dlqr(
            A,
            B,
            np.diag(sizes**-2.0),
            np.diag(np.array(list(axis.control_inputs.values())) ** -2.0),
        )[0]
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            f"model: no gain holds it at {speed:g} m/s ({error}); check the model's values"
        ) from None
    loop = ClosedLoop(axis, A, B, np.asarray(gain, np.float64))
    if not np.abs(loop.poles).max() < 1.0:
        raise InputError(f"model: no gain holds it at {speed:g} m/s; check the model's values")
    return loop


def augment_delay(A: Array, B: Array, delay: float, dt: float = STEP_S) -> tuple[Array, Array]:
    """A continuous linear model, sampled, whose sticks act late.

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
        both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * seconds)
        return both[:n, :n], both[:n, n:]

    (Phi_early, G0), (_, G_late), Phi = discretise(dt - rest), discretise(rest), discretise(dt)[0]
    size = n + steps * m
    A_late, B_late = np.zeros((size, size)), np.zeros((size, m))
    A_late[:n, :n] = Phi
    inputs = [
        B_late[:, :],
        *(A_late[:, n + i * m : n + (i + 1) * m] for i in range(steps)),
    ]  # u[k], u[k-1], ...
    inputs[max(steps - 1, 0)][:n] = G0
    if steps:
        inputs[steps][:n] = Phi_early @ G_late
        B_late[n : n + m] = np.eye(m)
        A_late[n + m :, n : size - m] = np.eye(size - n - m)
    return A_late, B_late


class TrimTable:
    """Steady flights around a speed, straight and turning, between which is interpolated."""

    def __init__(self, model: Model, speed: float = SPEED) -> None:
        """Solve the trims; InputError where the model cannot fly one of them."""
        speeds, climbs, banks = self._axes = (
            np.array(TABLE_SPEEDS) * speed,
            TABLE_CLIMBS,
            TABLE_BANKS,
        )
        self._values = np.array(
            [[[_steady_flight(model, v, c, b) for b in banks] for c in climbs] for v in speeds]
        )

    def at(self, speed: float, climb: float, bank: float) -> tuple[Array, Array]:
        """The steady flight at a speed, climb angle and bank, by linear interpolation; the table's
        ends hold beyond.

        Args:
            speed: [m/s].
            climb: [rad]; beyond the table's ends the slope continues.
            bank: [rad].

        Returns:
            Sticks (4,) in the order of COMMAND_NAMES, and (5,): pitch, yaw minus course, p, q, r
            [rad, rad/s].
        """
        values = self._values
        for axis, x in zip(self._axes, (speed, climb, bank), strict=True):
            i = min(max(int(np.searchsorted(axis, x)) - 1, 0), len(axis) - 2)
            share = (x - axis[i]) / (axis[i + 1] - axis[i])
            values = (1.0 - share) * values[i] + share * values[i + 1]
        return values[:4], values[4:]


def _steady_flight(model: Model, speed: float, climb: float, bank: float) -> Array:
    found = trim(model, speed, climb, bank)
    x = found.state
    crab = math.atan2(
        x[7], x[6]
    )  # the nose is along world x, and the course is to its left by this
    return np.array([*found.command, x[3], crab, *x[9:12]])


def model_key(model: Model) -> tuple[Any, ...]:
    """What a model is made of, in a form that can be looked up: form, terms, winds, parameters,
    values.

    Effects on sticks and on measured poses are left out: they change no force.
    """
    return model.form, model.terms, model.winds, model.parameters, tuple(model.values.items())


@lru_cache(maxsize=32)
def _design(form, terms, winds, parameters, values, speed, delay):  # type: ignore[no-untyped-def]
    """Trims and both loops of a model in its parts; every trial needs them again."""
    model = Model(form, terms, winds, parameters, dict(values))
    loops = (design_loop(model, axis, speed, delay) for axis in (LATERAL, LONGITUDINAL))
    return TrimTable(model, speed), *loops


class Autopilot:
    """Holds a reference: feedforward of the steady flight, LQR on the deviations from it."""

    def __init__(self, model: Model, speed: float = SPEED, delay: float = LINK_DELAY_S) -> None:
        """Design both loops; InputError where the model cannot be trimmed or held."""
        self.speed, (self.trims, *self.loops) = speed, _design(*model_key(model), speed, delay)
        self._integrals = [np.zeros(len(loop.axis.integrals)) for loop in self.loops]

    def command(
        self, state: State, wanted: Reference, past_commands: Array, idle: bool = False
    ) -> Command:
        """Sticks that bring the aircraft to the reference.

        Args:
            state: the measured state, finite.
            wanted: the reference.
            past_commands: (n, 4) what was sent before, oldest first; rows of zeros where there was
                none.
            idle: True leaves the throttle at zero and lets the speed fall.

        Returns:
            The command within its limits.

        Raises:
            InputError: past_commands has another shape.
        """
        speed = float(np.linalg.norm(state.v_world)) if idle else wanted.speed
        steady, attitude = self.trims.at(speed, wanted.climb, wanted.bank)
        deviations = self._deviations(state, wanted, speed, attitude)
        past = require_shape("past_commands", past_commands, (None, 4))[::-1]
        control_inputs = steady.copy()
        for loop, total in zip(self.loops, self._integrals, strict=True):
            columns = [COMMAND_NAMES.index(name) for name in loop.axis.control_inputs]
            late = [
                (row if row.any() else steady)[columns] - steady[columns]
                for row in past[: loop.delay_steps]
            ]
            late += [np.zeros(len(columns))] * (loop.delay_steps - len(late))
            x = [deviations[name] for name in loop.axis.states]
            control_inputs[columns] -= loop.gain @ np.concatenate([x, *late, total])
            # Bounded, so that a start far off the path does not wind it up [Astrom & Murray, sec.
            # 11.4: windup].
            error = np.array([deviations[name] for name in loop.axis.integrals])
            limit = INTEGRAL_LIMIT * np.array(list(loop.axis.integrals.values()))
            total[:] = np.clip(total + STEP_S * error, -limit, limit)
        return Command.clip(0.0 if idle else control_inputs[0], *control_inputs[1:])

    def level(self) -> Command:
        """The sticks of straight level flight: what is left where no state is known."""
        return Command.clip(*self.trims.at(self.speed, 0.0, 0.0)[0])

    def _deviations(
        self, state: State, wanted: Reference, speed: float, attitude: Array
    ) -> dict[str, float]:
        """Deviations from the reference in axes along its course: x ahead, y left, z up."""
        pitch, crab, p, q, r = attitude
        ahead, left = course_axes(wanted.yaw)
        off, v = state.p_world - wanted.p_world, state.v_world
        v_ahead, v_left, off_left = float(v @ ahead), float(v @ left), float(off @ left)
        return {
            "py": _clip(off_left, 1.0), "yaw": float(wrap_angle(state.yaw - wanted.yaw - crab)),
            "roll": state.roll - wanted.bank, "vy": v_left,
            "p": state.rates_body[0] - p, "r": state.rates_body[2] - r,
            "pz": _clip(off[2], 0.5), "pitch": state.pitch - pitch,
            "vx": v_ahead - speed * math.cos(wanted.climb), "vz": float(v[2]) - speed * math.sin(wanted.climb),
            "q": state.rates_body[1] - q,
        }  # fmt: skip


def course_axes(yaw: float) -> tuple[Array, Array]:
    """Level unit vectors along a course and to its left.

    Args:
        yaw: course [rad], positive to the right of world x.

    Returns:
        ahead (3,) and left (3,) in the world.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c, -s, 0.0]), np.array([s, c, 0.0])


def _clip(x: float, limit: float) -> float:
    return float(min(max(x, -limit), limit))
