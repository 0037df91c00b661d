"""Trim: model and steady flight -> control inputs that hold it, and the linear model around it."""

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

# In the order of COMMAND_NAMES.
COMMAND_LIMITS = ((0.0, 1.0), (-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))
# rad; far beyond the range of linear coefficients.
ANGLE_LIMITS = {"angle of attack": 0.6, "sideslip": 0.5}
TRIM_TOLERANCE = 1e-7  # largest residual of a solved trim [m/s^2, rad/s^2], far above rounding


@dataclass(frozen=True)
class Trim:
    """A steady flight: straight, or a coordinated turn."""

    state: Array  # (n_states,) in the order of STATE_NAMES, nose along world x, at px = py = 0
    command: Array  # (4,) control positions, after delay and lag, in the order of COMMAND_NAMES
    alpha: float  # angle of attack [rad]
    beta: float  # sideslip [rad]
    turn_rate: float  # d(yaw)/dt [rad/s], positive to the right
    residual: float  # largest residual of the equations [m/s^2, rad/s^2]


@dataclass(frozen=True)
class Mode:
    """A natural mode of the linear model, exp(eigenvalue t)."""

    name: str
    eigenvalue: complex  # [1/s]; of a pair, the one with positive imaginary part

    @property
    def natural_frequency(self) -> float:
        """Magnitude of the eigenvalue [rad/s]."""
        return abs(self.eigenvalue)

    @property
    def damping(self) -> float:
        """Damping ratio: 0 undamped, 1 no oscillation, negative unstable."""
        return -self.eigenvalue.real / abs(self.eigenvalue)

    @property
    def time_constant(self) -> float:
        """Time in which the amplitude falls to 1/e [s]; negative where it grows."""
        return -1.0 / self.eigenvalue.real


def trim(
    model: Model, airspeed: float, climb_angle: float = 0.0, bank: float = 0.0,
    height: float = 2.0, time: float = 0.0, within_limits: bool = True,
) -> Trim:  # fmt: skip
    """Control inputs, attitude and turn rate of a steady flight through the air.

    Steady: the velocity through the air turns with the aircraft, and body rates are constant.
    Coordinated: no side force on the body [Stevens, Lewis & Johnson, sec. 3.6]; the turn rate in
    level flight is then g tan(bank) cos(pitch) / airspeed within a few parts in a thousand.

    Args:
        model: the aircraft; its terms are evaluated at px = py = 0.
        airspeed: [m/s], > 0.
        climb_angle: of the path through the air [rad], positive upward.
        bank: roll angle [rad], positive right wing down.
        height: [m].
        time: since the start of the flight [s].
        within_limits: False also returns a balance with control inputs beyond their limits.

    Raises:
        InputError: the aircraft has no such trim; the text names the limit.
    """
    from scipy.optimize import least_squares

    require_range("airspeed", airspeed, low=0.1, high=1000.0)
    require_range("climb_angle", climb_angle, low=-1.4, high=1.4)
    require_range("bank", bank, low=-1.4, high=1.4)
    require_range("height", height)
    require_range("time", time)
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    winds = [np.array(w.evaluate(0.0, 0.0, height, time, K), np.float64) for w in model.winds]
    wind = np.sum(winds, axis=0) if winds else np.zeros(3)

    # Unknowns: four control inputs, alpha, beta, turn rate; the equations are the derivatives of
    # attitude, velocity and rates, less the turn, and the side force.
    def imbalance(unknown: Array) -> Array:
        alpha, beta, turn_rate = unknown[4:]
        x, R_world_body, v_world = _steady_state(
            airspeed, climb_angle, bank, height, alpha, beta, turn_rate, wind
        )
        x_dot = np.array(rates(time, x[: model.n_states], unknown[:4], K), np.float64)
        sideways = x_dot[6:9] @ R_world_body[:, 1] + GRAVITY * R_world_body[2, 1]
        x_dot[4] -= turn_rate
        x_dot[6:9] -= turn_rate * np.array([v_world[1], -v_world[0], 0.0])
        return np.append(x_dot[3:], sideways)

    guess = np.array([0.5, 0.0, 0.0, 0.0, 0.05, 0.0, GRAVITY * math.tan(bank) / airspeed])
    # Control inputs are not bounded here, so that a message can say by how much one is exceeded.
    high = np.array([np.inf] * 4 + [*ANGLE_LIMITS.values()] + [np.inf])
    found = least_squares(
        imbalance, guess, bounds=(-high, high), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    residual = float(np.abs(found.fun).max())
    climb_deg, bank_deg = math.degrees(climb_angle), math.degrees(bank)
    what = f"trim at {airspeed:g} m/s, climb {climb_deg:.3g} deg, bank {bank_deg:.3g} deg"
    _require_within_limits(what, found.x, residual, COMMAND_LIMITS if within_limits else ())
    alpha, beta, turn_rate = map(float, found.x[4:])
    x, _, _ = _steady_state(airspeed, climb_angle, bank, height, alpha, beta, turn_rate, wind)
    return Trim(x[: model.n_states], found.x[:4], alpha, beta, turn_rate, residual)


def _steady_state(
    airspeed: float, climb_angle: float, bank: float, height: float,
    alpha: float, beta: float, turn_rate: float, wind: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """State (12,), R_world_body and air-relative v_world of a steady flight, nose along world x."""
    v_body = airspeed * np.array(
        [np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)]
    )
    # Pitch for this climb angle: sin(climb) = a sin(pitch) - b cos(pitch).
    a, b = v_body[0] / airspeed, (np.sin(bank) * v_body[1] + np.cos(bank) * v_body[2]) / airspeed
    pitch = np.arctan2(b, a) + np.arcsin(np.clip(np.sin(climb_angle) / np.hypot(a, b), -1.0, 1.0))
    R_world_body = rotation_world_body(bank, pitch, 0.0)
    v_world = R_world_body @ v_body
    rates_body = -turn_rate * R_world_body[2]  # world z is up and a turn to the right is about down
    x = np.concatenate([[0.0, 0.0, height, pitch, 0.0, bank], v_world + wind, rates_body])
    return x, R_world_body, v_world


def _require_within_limits(
    what: str, solution: Array, residual: float, limits: tuple[tuple[float, float], ...]
) -> None:
    """Raise InputError unless the equations are solved with the control inputs within limits."""
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
    for name, (low, high), x in zip(COMMAND_NAMES, limits, solution, strict=False):
        if not low - 1e-9 <= x <= high + 1e-9:
            raise InputError(
                f"{what}: needs {name} {x:.4g}, which ends at {high if x > high else low:g}; "
                f"{way_out}"
            )


def linearise(model: Model, trim: Trim, dt: float | None = None) -> tuple[Array, Array]:
    """Linear model of small deviations from a trim, by central differences.

    d(dx)/dt = A dx + B du, or dx[k+1] = A dx[k] + B du[k] with a step dt [s]. In a turn it holds
    at that instant only, since the velocity is written in world axes.

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

    Longitudinal and lateral motion are decoupled, as for a symmetric aircraft [Beard & McLain, sec.
    5.6]; a pair without oscillation gives two entries of one name.

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
    # The eigenvalue nearest zero is the heading, which has no restoring moment.
    side = _eigenvalues(A, ("yaw", "roll", "vy", "p", "r"))[:-1]
    pairs, reals = side[side.imag != 0.0], side[side.imag == 0.0]
    named = list(zip(("short period",) * 2 + ("phugoid",) * 2, long, strict=True))
    named += list(zip(("Dutch roll",) * 2 + ("roll-spiral",) * 2, pairs, strict=False))
    named += list(zip(("roll", *("Dutch roll",) * (len(reals) - 2), "spiral"), reals, strict=False))
    return tuple(Mode(name, complex(value)) for name, value in named if value.imag >= 0.0)


def _eigenvalues(A: Array, names: tuple[str, ...]) -> NDArray[np.complex128]:
    """Eigenvalues of the block of A of these states, fastest first."""
    rows = [STATE_NAMES.index(name) for name in names]
    values = np.linalg.eigvals(A[np.ix_(rows, rows)]).astype(np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]


def discrete_step(model: Model, dt: float = 0.05) -> Callable[[float, Array, Array], Array]:
    """The model's discrete step of dt [s] as in `fly`: constant positions, Runge-Kutta substeps.

    Returns:
        The function (t, x (n_states, ...), positions (4, ...)) -> x after the step (n_states, ...).
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

    Its update is the model's own step, so its response equals `roll_out`, about ten times slower.
    Inputs are control positions: delay and lag belong in front of it, as blocks of their own.

    Returns:
        control.NonlinearIOSystem with inputs COMMAND_NAMES, states and outputs STATE_NAMES (9 or
        12 of them).
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
