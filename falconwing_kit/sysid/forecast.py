"""Forecasts: a model + a log with velocities -> predictions one second ahead, and two baselines."""

from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, state_rates
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import GRAVITY, wrap_angle
from falconwing_kit.sysid.prepare import interpolate_slow_sticks

TOLERANCE_S = 0.25  # a pose this close to the horizon is used; the forecast is for its own time


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
        """Root mean square distance between forecast and measurement."""
        return float(np.sqrt(np.mean(np.sum(self.error_position**2, axis=1))))

    @property
    def attitude_deg(self) -> float:
        """Root mean square of the three angle errors together."""
        return float(np.degrees(np.sqrt(np.mean(np.sum(self.error_attitude**2, axis=1)))))

    def within(self, t0: float, t1: float) -> "Forecasts":
        """Those that end at t0 <= t < t1 [s]; the first ones start up to a horizon before t0."""
        return self.subset((self.t >= t0) & (self.t < t1))

    def subset(self, index: np.ndarray) -> "Forecasts":
        """Those at these indices or where this mask is true."""
        columns = (self.start, self.end, self.t, self.error_position, self.error_attitude)
        return Forecasts(*(column[index] for column in columns))


def forecast(model: Model, table: FlightTable, horizon: float = 1.0) -> Forecasts:
    """Fly the model from every measured state over the horizon with the logged commands.

    The initial state is the logged one: pose, velocity and, in the 12-state model, body rates.

    Args:
        model: the aircraft.
        table: a log with columns vx, vy, vz (and p, q, r for the 12-state model).
        horizon: prediction horizon [s].

    Returns:
        One forecast per usable row.

    Raises:
        InputError: the log lacks these columns, or no two poses are a horizon apart.
    """
    start, end, x, span = _starts(table, horizon, model.n_states)
    begin = table.t[start]
    # Actuator positions (steps, 4, F) over the horizon; half a horizon before it settles the servo.
    steps = max(1, round(horizon / 0.05) * SUBSTEPS[model.form])
    edges = begin[:, None] + span[:, None] * np.arange(-steps // 2, steps + 1) / steps
    commands = interpolate_slow_sticks(table).commands  # as every fit takes them
    mean, slope = (
        part[:, -steps:].transpose(1, 2, 0)
        for part in model.actuator_positions(table.t, commands, edges, model.K)
    )
    rates, K, x = state_rates(model.form, model.terms, model.winds), model.K, x.T
    with np.errstate(all="ignore"):
        for k in range(steps):
            x = step_batch(rates, K, begin + k * span / steps, x, mean[k], span / steps, slope[k])
    return _forecast_errors(table, start, end, x[:3].T, x[[5, 3, 4]].T)


def constant_velocity(table: FlightTable, horizon: float = 1.0) -> Forecasts:
    """Baseline: straight on with constant velocity and attitude; arguments as for `forecast`."""
    start, end, x, span = _starts(table, horizon, 9)
    p_world = x[:, :3] + span[:, None] * x[:, 6:9]
    return _forecast_errors(table, start, end, p_world, table.attitude[start])


def constant_turn(table: FlightTable, horizon: float = 1.0) -> Forecasts:
    """Baseline: constant speed and climb on the circle of the bank, yaw rate g tan(roll) / V.

    Arguments as for `forecast`.
    """
    start, end, x, span = _starts(table, horizon, 9)
    speed = np.maximum(np.hypot(x[:, 6], x[:, 7]), 0.1)
    yaw_rate = GRAVITY * np.tan(np.clip(table.attitude[start, 0], -1.4, 1.4)) / speed
    turn = -yaw_rate * span  # of the course, positive to the left as world y
    # The chord of the arc: its length over speed, and its course halfway through the turn.
    half = np.sinc(turn / (2.0 * np.pi)) * span
    course = np.arctan2(x[:, 7], x[:, 6]) + 0.5 * turn
    displacement = np.stack(
        [speed * half * np.cos(course), speed * half * np.sin(course), x[:, 8] * span], axis=1
    )
    attitude = table.attitude[start].copy()
    attitude[:, 2] += yaw_rate * span
    return _forecast_errors(table, start, end, x[:, :3] + displacement, attitude)


def hold_throttle(table: FlightTable, since: float, over: float = 20.0) -> FlightTable:
    """The log with the throttle from `since` on replaced by its mean over the time before.

    Args:
        table: a log.
        since: [s].
        over: length of the mean [s].
    """
    before = (table.t >= since - over) & (table.t < since)
    commands = table.commands.copy()
    commands[table.t >= since, 0] = commands[before, 0].mean()
    return replace(table, commands=commands)


def _starts(
    table: FlightTable, horizon: float, n_states: int
) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """Rows of starts and ends (F,), logged states at the starts (F, n_states), times between."""
    rows = np.flatnonzero(table.has_pose)
    if len(rows) < 2:
        raise InputError(f"{table.name}: expected poses to forecast from, got {len(rows)}")
    # The row with a pose nearest to a horizon after each row with a pose.
    target = table.t[rows] + horizon
    after = np.clip(np.searchsorted(table.t[rows], target), 1, len(rows) - 1)
    nearer = np.abs(table.t[rows[after - 1]] - target) < np.abs(table.t[rows[after]] - target)
    end = rows[np.where(nearer, after - 1, after)]
    usable = np.abs(table.t[end] - target) <= min(TOLERANCE_S, 0.5 * horizon)
    if not usable.any():
        raise InputError(f"{table.name}: expected poses {horizon:g} s apart, got none")
    start, end = rows[usable], end[usable]
    return start, end, logged_states(table, n_states)[start], table.t[end] - table.t[start]


def logged_states(table: FlightTable, n_states: int) -> Array:
    """The flight's states (n, n_states) in the order of STATE_NAMES, nan where one is missing.

    Raises:
        InputError: the table has no velocities, or no rates for a model that has them.
    """
    names = ("vx", "vy", "vz", "p", "q", "r")[: n_states - 6]
    missing = [name for name in names if name not in table.extra]
    if missing:
        raise InputError(
            f"{table.name}: expected logged columns {', '.join(names)} to forecast from, got none"
            f" for {missing[0]}"
        )
    motion = np.stack([table.extra[name] for name in names], axis=1)
    return np.concatenate([table.p_world, table.attitude[:, [1, 2, 0]], motion], axis=1)


def _forecast_errors(
    table: FlightTable, start: np.ndarray, end: np.ndarray, p_world: Array, attitude: Array
) -> Forecasts:
    position_error = p_world - table.p_world[end]
    attitude_error = wrap_angle(attitude - table.attitude[end])
    finite = np.isfinite(position_error).all(axis=1) & np.isfinite(attitude_error).all(axis=1)
    return Forecasts(start, end, table.t[end], position_error, attitude_error).subset(finite)
