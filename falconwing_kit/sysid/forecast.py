"""Forecasts: a model + a log with velocities -> where the aircraft is one second later, beside two
simple guesses.
"""

from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, state_rates
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import GRAVITY, wrap_angle

TOLERANCE_S = (
    0.25  # a pose this close to the wanted horizon will do; the forecast is made for its own time
)


@dataclass(frozen=True)
class Forecasts:
    """F forecasts: each starts at a row of the log and ends at another."""

    start: np.ndarray  # (F,) rows
    end: np.ndarray  # (F,) rows
    t: Array  # (F,) time of the end [s]
    error_position: Array  # (F, 3) predicted minus measured, world [m]
    error_attitude: Array  # (F, 3) roll, pitch, yaw [rad]

    @property
    def position_m(self) -> float:
        """Root mean square of the distance between forecast and measurement."""
        return float(np.sqrt(np.mean(np.sum(self.error_position**2, axis=1))))

    @property
    def attitude_deg(self) -> float:
        """Root mean square of the three angle errors together."""
        return float(np.degrees(np.sqrt(np.mean(np.sum(self.error_attitude**2, axis=1)))))

    def within(self, t0: float, t1: float) -> "Forecasts":
        """Those whose end has t0 <= t < t1 [s]; the first of them start up to a horizon before t0."""
        return self.subset((self.t >= t0) & (self.t < t1))

    def subset(self, index: np.ndarray) -> "Forecasts":
        """Those at these indices or where this mask is true."""
        return Forecasts(
            self.start[index],
            self.end[index],
            self.t[index],
            self.error_position[index],
            self.error_attitude[index],
        )


def forecast(model: Model, table: FlightTable, horizon: float = 1.0) -> Forecasts:
    """Fly the model from every measured state over the horizon on the logged commands.

    The start state is what the log says at that moment (pose, velocity and, in the 12-state model,
    body rates); the commands over the horizon are known inputs.

    Args:
        model: the aircraft.
        table: a log with columns vx, vy, vz (and p, q, r for the 12-state model).
        horizon: how far ahead [s].

    Returns:
        One forecast per usable row.

    Raises:
        InputError: the log has no velocities, or no two poses are a horizon apart.
    """
    start, end = _pairs(table, horizon)
    x = _logged_states(table, model.n_states)[start].T
    span = table.t[end] - table.t[start]
    steps = max(1, round(horizon / 0.05) * SUBSTEPS[model.form])
    begin = table.t[start]
    edges = begin[:, None] + span[:, None] * np.arange(-steps // 2, steps + 1) / steps
    mean, slope = model.actuator_positions(table.t, table.commands, edges, model.K)
    mean, slope = (part[:, -steps:].transpose(1, 2, 0) for part in (mean, slope))
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    with np.errstate(all="ignore"):
        for k in range(steps):
            x = step_batch(rates, K, begin + k * span / steps, x, mean[k], span / steps, slope[k])
    return _forecast_errors(table, start, end, x[:3].T, x[[5, 3, 4]].T)


def constant_velocity(table: FlightTable, horizon: float = 1.0) -> Forecasts:
    """The simplest guess: it goes on straight ahead and keeps its attitude.

    Args:
        table: a log with columns vx, vy, vz.
        horizon: how far ahead [s].

    Returns:
        Forecasts from the same rows as `forecast`.

    Raises:
        InputError: the log has no velocities, or no two poses are a horizon apart.
    """
    start, end = _pairs(table, horizon)
    x = _logged_states(table, 9)[start]
    span = (table.t[end] - table.t[start])[:, None]
    return _forecast_errors(table, start, end, x[:, :3] + span * x[:, 6:9], table.attitude[start])


def constant_turn(table: FlightTable, horizon: float = 1.0) -> Forecasts:
    """The better guess: constant speed and climb on the circle that belongs to the bank, yaw rate g
    tan(roll) / V.

    Args:
        table: a log with columns vx, vy, vz.
        horizon: how far ahead [s].

    Returns:
        Forecasts from the same rows as `forecast`.

    Raises:
        InputError: the log has no velocities, or no two poses are a horizon apart.
    """
    start, end = _pairs(table, horizon)
    x = _logged_states(table, 9)[start]
    span = table.t[end] - table.t[start]
    speed = np.maximum(np.hypot(x[:, 6], x[:, 7]), 0.1)
    yaw_rate = GRAVITY * np.tan(np.clip(table.attitude[start, 0], -1.4, 1.4)) / speed
    turn = -yaw_rate * span  # of the course, counted to the left as world y is
    half = np.sinc(turn / (2.0 * np.pi)) * span  # chord of the arc over speed
    course = np.arctan2(x[:, 7], x[:, 6]) + 0.5 * turn
    displacement = np.stack(
        [speed * half * np.cos(course), speed * half * np.sin(course), x[:, 8] * span], axis=1
    )
    attitude = table.attitude[start] + np.stack([0.0 * span, 0.0 * span, yaw_rate * span], axis=1)
    return _forecast_errors(table, start, end, x[:, :3] + displacement, attitude)


def hold_throttle(table: FlightTable, since: float, over: float = 20.0) -> FlightTable:
    """The log as if the throttle had stayed where it was: its mean over the seconds before.

    Args:
        table: a log.
        since: from this time on [s].
        over: mean over this long before [s].

    Returns:
        The log with another throttle column.
    """
    before = (table.t >= since - over) & (table.t < since)
    commands = table.commands.copy()
    commands[table.t >= since, 0] = commands[before, 0].mean()
    return replace(table, commands=commands)


def _pairs(table: FlightTable, horizon: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows with a pose and rows with a pose about a horizon later."""
    rows = np.flatnonzero(table.has_pose)
    if len(rows) < 2:
        raise InputError(f"{table.name}: expected poses to forecast from, got {len(rows)}")
    wanted = table.t[rows] + horizon
    after = np.clip(np.searchsorted(table.t[rows], wanted), 1, len(rows) - 1)
    nearer = np.abs(table.t[rows[after - 1]] - wanted) < np.abs(table.t[rows[after]] - wanted)
    end = rows[np.where(nearer, after - 1, after)]
    good = np.abs(table.t[end] - wanted) <= min(TOLERANCE_S, 0.5 * horizon)
    if not good.any():
        raise InputError(f"{table.name}: expected poses {horizon:g} s apart, got none")
    return rows[good], end[good]


def _logged_states(table: FlightTable, n_states: int) -> Array:
    names = ("vx", "vy", "vz", "p", "q", "r")[: n_states - 6]
    missing = [name for name in names if name not in table.extra]
    if missing:
        raise InputError(
            f"{table.name}: expected logged columns {', '.join(names)} to forecast from, got none for {missing[0]}"
        )
    motion = np.stack([table.extra[name] for name in names], axis=1)
    return np.concatenate([table.p_world, table.attitude[:, [1, 2, 0]], motion], axis=1)


def _forecast_errors(
    table: FlightTable, start: np.ndarray, end: np.ndarray, p_world: Array, attitude: Array
) -> Forecasts:
    position_error = p_world - table.p_world[end]
    attitude_error = wrap_angle(attitude - table.attitude[end])
    good = np.isfinite(position_error).all(axis=1) & np.isfinite(attitude_error).all(axis=1)
    return Forecasts(start, end, table.t[end], position_error, attitude_error).subset(good)
