"""Trim: a model and a wanted flight -> the sticks that hold it, and the model made linear around
it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, state_rates
from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import GRAVITY, rotation_world_body
from falconwing_kit.core.messages import COMMAND_NAMES, STATE_NAMES

COMMAND_LIMITS = (
    (0.0, 1.0),
    (-1.0, 1.0),
    (-1.0, 1.0),
    (-1.0, 1.0),
)  # in the order of COMMAND_NAMES
ANGLE_LIMITS = {
    "angle of attack": 0.6,
    "sideslip": 0.5,
}  # rad; far beyond what linear coefficients describe
TRIM_TOLERANCE = (
    1e-7  # m/s^2, rad/s^2: what a solved trim may leave of the equations, far above rounding
)


@dataclass(frozen=True)
class Trim:
    """A steady flight: straight, or a coordinated turn."""

    state: Array  # (n_states,) in the order of STATE_NAMES, nose along world x, at px = py = 0
    command: Array  # (4,) in the order of COMMAND_NAMES, as the sticks act: after delay and lag
    alpha: float  # angle of attack [rad]
    beta: float  # sideslip [rad]
    turn_rate: float  # d(yaw)/dt [rad/s], positive to the right
    residual: float  # largest entry of what is left of the equations [m/s^2, rad/s^2]


@dataclass(frozen=True)
class Mode:
    """One way in which the aircraft moves by itself: exp(eigenvalue t)."""

    name: str
    eigenvalue: complex  # [1/s]; of a pair, the one with positive imaginary part

    @property
    def natural_frequency(self) -> float:
        """Size of the eigenvalue [rad/s]."""
        return abs(self.eigenvalue)

    @property
    def damping(self) -> float:
        """Damping ratio: 0 keeps swinging, 1 no longer swings, negative grows."""
        return -self.eigenvalue.real / abs(self.eigenvalue)

    @property
    def time_constant(self) -> float:
        """Time in which it falls to 1/e [s]; negative where it grows."""
        return -1.0 / self.eigenvalue.real


def trim(
    model: Model, airspeed: float, climb_angle: float = 0.0, bank: float = 0.0, height: float = 2.0
) -> Trim:
    """Sticks, attitude and turn rate of a steady flight through the air.

    Steady: the velocity through the air only turns with the aircraft, and body rates stay.
        Coordinated: no force pushes
    sideways on the body, so the ball of a turn indicator stays in its middle [Stevens, Lewis &
    Johnson, sec. 3.6]. The level turn rate is then g tan(bank) cos(pitch) / airspeed within a few
    parts in a thousand.

    Args:
        model: the aircraft; its wind and other terms are taken at px = py = 0, at the height and at
            time 0.
        airspeed: [m/s], > 0.
        climb_angle: of the path through the air [rad], positive upward.
        bank: roll angle [rad], positive right wing down.
        height: [m].

    Returns:
        The steady flight.

    Raises:
        InputError: the aircraft cannot fly so; the text says which limit stands in the way.
    """
    from scipy.optimize import least_squares

    require_range("airspeed", airspeed, low=0.1, high=1000.0)
    require_range("climb_angle", climb_angle, low=-1.4, high=1.4)
    require_range("bank", bank, low=-1.4, high=1.4)
    require_range("height", height)
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    winds = [np.array(w.evaluate(0.0, 0.0, height, 0.0, K), np.float64) for w in model.winds]
    wind = np.sum(winds, axis=0) if winds else np.zeros(3)

    def imbalance(unknown: Array) -> Array:
        alpha, beta, turn_rate = unknown[4:]
        x, R_world_body, v_world = _steady_state(
            airspeed, climb_angle, bank, height, alpha, beta, turn_rate, wind
        )
        x_dot = np.array(rates(0.0, x[: model.n_states], unknown[:4], K), np.float64)
        sideways = x_dot[6:9] @ R_world_body[:, 1] + GRAVITY * R_world_body[2, 1]
        x_dot[4] -= turn_rate
        x_dot[6:9] -= turn_rate * np.array([v_world[1], -v_world[0], 0.0])
        return np.append(x_dot[3:], sideways)

    guess = np.array([0.5, 0.0, 0.0, 0.0, 0.05, 0.0, GRAVITY * math.tan(bank) / airspeed])
    # Sticks are free here: how far one would have to go beyond its end makes a better message than
    # standing at it.
    high = np.array([np.inf] * 4 + [*ANGLE_LIMITS.values()] + [np.inf])
    found = least_squares(
        imbalance, guess, bounds=(-high, high), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    residual = float(np.abs(found.fun).max())
    wanted = f"{airspeed:g} m/s, climb {math.degrees(climb_angle):.3g} deg, bank {math.degrees(bank):.3g} deg"
    _require_within_limits(f"trim at {wanted}", found.x, residual)
    alpha, beta, turn_rate = map(float, found.x[4:])
    x, _, _ = _steady_state(airspeed, climb_angle, bank, height, alpha, beta, turn_rate, wind)
    return Trim(x[: model.n_states], found.x[:4], alpha, beta, turn_rate, residual)


def _steady_state(
    airspeed: float, climb_angle: float, bank: float, height: float,
    alpha: float, beta: float, turn_rate: float, wind: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """State (12,), R_world_body and velocity through the air v_world of a steady flight with its
    nose along world x.
    """
    v_body = airspeed * np.array(
        [np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)]
    )
    # The pitch with which this velocity climbs as wanted: sin(climb) = a sin(pitch) - b cos(pitch).
    a, b = v_body[0] / airspeed, (np.sin(bank) * v_body[1] + np.cos(bank) * v_body[2]) / airspeed
    pitch = np.arctan2(b, a) + np.arcsin(np.clip(np.sin(climb_angle) / np.hypot(a, b), -1.0, 1.0))
    R_world_body = rotation_world_body(bank, pitch, 0.0)
    v_world = R_world_body @ v_body
    rates_body = -turn_rate * R_world_body[2]  # world z is up and a turn to the right is about down
    x = np.concatenate([[0.0, 0.0, height, pitch, 0.0, bank], v_world + wind, rates_body])
    return x, R_world_body, v_world


def _require_within_limits(what: str, solution: Array, residual: float) -> None:
    """Raise InputError unless the equations are solved with every stick within its travel."""
    way_out = "choose another speed, climb or bank, or check the model's values"
    if not residual < TRIM_TOLERANCE:
        stops = [
            name
            for (name, end), x in zip(ANGLE_LIMITS.items(), solution[4:6], strict=True)
            if abs(x) > end - 1e-3
        ]
        limit = (
            f" with the {stops[0]} at its limit of {math.degrees(ANGLE_LIMITS[stops[0]]):.0f} deg"
            if stops
            else ""
        )
        raise InputError(
            f"{what}: no balance, the nearest leaves {residual:.2g} m/s^2{limit}; {way_out}"
        )
    for name, (low, high), x in zip(COMMAND_NAMES, COMMAND_LIMITS, solution[:4], strict=True):
        if not low - 1e-9 <= x <= high + 1e-9:
            raise InputError(
                f"{what}: needs {name} {x:.4g}, which ends at {high if x > high else low:g}; {way_out}"
            )


def linearise(model: Model, trim: Trim, dt: float | None = None) -> tuple[Array, Array]:
    """Linear model of small deviations from a trim, by central differences.

    d(dx)/dt = A dx + B du, or dx[k+1] = A dx[k] + B du[k] with a step. In a turn it holds at that
    instant only, since the velocity is written in world axes.

    Args:
        model: the aircraft the trim belongs to.
        trim: where to linearise.
        dt: None for continuous time, else the step [s] of the discrete model, 0.05 at 20 Hz.

    Returns:
        A (n_states, n_states) in the order of STATE_NAMES and B (n_states, 4) in the order of
        COMMAND_NAMES.

    Raises:
        InputError: the trim is of the other model, 9-state or 12-state, or the step is not within
            0.1 ms and 1 s.
    """
    n = model.n_states
    state, command = (
        require_shape("trim.state", trim.state, (n,)),
        require_shape("trim.command", trim.command, (4,)),
    )
    h = 1e-5  # its square and 1e-16 over it are both below 1e-10
    point = np.concatenate([state, command])[:, None]
    points = np.concatenate([point + h * np.eye(n + 4), point - h * np.eye(n + 4)], axis=1)
    if dt is None:
        rates = state_rates(model.form, model.terms, model.winds)(
            0.0, points[:n], points[n:], model.K
        )
        after = np.stack(np.broadcast_arrays(*rates))
    else:
        after = discrete_step(model, dt)(0.0, points[:n], points[n:])
    derivative = (after[:, : n + 4] - after[:, n + 4 :]) / (2.0 * h)
    return derivative[:, :n], derivative[:, n:]


def modes(A: Array) -> tuple[Mode, ...]:
    """The five classical modes of straight flight: short period, phugoid, Dutch roll, roll, spiral.

    Longitudinal and lateral motion are taken apart, as they are for a symmetric aircraft [Beard &
    McLain, sec. 5.6]; a pair that does not swing gives two entries of one name.

    Args:
        A: (12, 12) of `linearise` in continuous time, straight flight along world x, the 12-state
            model.

    Returns:
        The modes, fastest first within each motion.

    Raises:
        InputError: A has another shape; the 9-state model has no body rates and so not these modes.
    """
    A = require_shape("A (straight flight, 12-state model, continuous time)", A, (12, 12))
    long = _eigenvalues(A, ("pitch", "vx", "vz", "q"))
    # The eigenvalue nearest zero is the heading, which nothing pulls back.
    side = _eigenvalues(A, ("yaw", "roll", "vy", "p", "r"))[:-1]
    pairs, reals = side[side.imag != 0.0], side[side.imag == 0.0]
    named = list(zip(("short period",) * 2 + ("phugoid",) * 2, long, strict=True))
    named += list(zip(("Dutch roll",) * 2 + ("roll-spiral",) * 2, pairs, strict=False))
    named += list(zip(("roll", *("Dutch roll",) * (len(reals) - 2), "spiral"), reals, strict=False))
    return tuple(Mode(name, complex(value)) for name, value in named if value.imag >= 0.0)


def _eigenvalues(A: Array, names: tuple[str, ...]) -> NDArray[np.complex128]:
    """Eigenvalues of the part of A that couples these states, fastest first."""
    rows = [STATE_NAMES.index(name) for name in names]
    values = np.linalg.eigvals(A[np.ix_(rows, rows)]).astype(np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]


def discrete_step(model: Model, dt: float = 0.05) -> Callable[[float, Array, Array], Array]:
    """The model's own discrete step, as `fly` takes it: positions held, Runge-Kutta substeps
    inside.

    Args:
        model: the aircraft.
        dt: step [s].

    Returns:
        The function (t, x (n_states, ...), positions (4, ...)) -> x after the step (n_states, ...).

    Raises:
        InputError: the step is not within 0.1 ms and 1 s.
    """
    require_range("dt", dt, low=1e-4, high=1.0)
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    substeps = max(1, round(SUBSTEPS[model.form] * dt / 0.05))

    def step(t: float, x: Array, positions: Array) -> Array:
        for k in range(substeps):
            x = step_batch(rates, K, t + k * dt / substeps, x, positions, dt / substeps)
        return x

    return step


def to_nlsys(model: Model, dt: float = 0.05) -> Any:
    """The model as a discrete nonlinear system of python-control, for design and analysis.

    Its update is the model's own step, so a response of it equals `roll_out`; it is about ten times
    slower than that. Inputs are positions as the sticks act: the model's delay and lag belong in
    front of it, as blocks of their own.

    Args:
        model: the aircraft.
        dt: step [s], 0.05 at 20 Hz.

    Returns:
        control.NonlinearIOSystem with inputs COMMAND_NAMES, states and outputs STATE_NAMES (9 or 12
        of them).

    Raises:
        InputError: the step is not within 0.1 ms and 1 s.
    """
    import control

    step, names = discrete_step(model, dt), list(STATE_NAMES[: model.n_states])

    def update(t: float, x: Array, u: Array, params: Any) -> Array:
        return step(t, x[:, None], u[:, None])[:, 0]

    return control.nlsys(
        update,
        None,
        inputs=list(COMMAND_NAMES),
        outputs=names,
        states=names,
        dt=dt,
        name="aircraft",
    )
