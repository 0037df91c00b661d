"""Integration: model, initial state and commands -> the flight, by fourth-order Runge-Kutta."""

import math
from collections.abc import Callable
from functools import cache
from types import CellType, FunctionType
from typing import Any

import numpy as np

from falconwing_kit.aircraft.model import Model, state_rates
from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.messages import CONTROL_PERIOD_S

SUBSTEPS = {"paper": 1, "rates": 2}  # per 50 ms; body rates need the shorter step
SETTLING_S = 0.6  # 20 time constants of a servo of 30 ms


def step_batch(
    rates: Any,
    K: Any,
    time: Any,
    x: Array,
    command: Array,
    duration: Any,
    slope: Array | None = None,
) -> Array:
    """One Runge-Kutta step of one aircraft, or of many at once.

    Args:
        rates: the function (time, x, command, K) -> dx/dt that `state_rates` builds.
        K: parameter record; each field a number or an array that broadcasts against the batch.
        time: (...) since the start of the flight [s].
        x: (n_states, ...) states, SI; (n_states,) of one aircraft takes a third of the time of
            (n_states, 1), as NumPy's calls cost more than their sums.
        command: (4, ...) mean control positions during the step.
        duration: (...) step length [s].
        slope: (4, ...) positions run from command - slope to command + slope; None: constant.

    Returns:
        (n_states, ...) states after the step.
    """
    half = 0.5 * duration
    first, last = (command, command) if slope is None else (command - slope, command + slope)
    k1 = _stack(rates(time, x, first, K), x)
    k2 = _stack(rates(time + half, x + half * k1, command, K), x)
    k3 = _stack(rates(time + half, x + half * k2, command, K), x)
    k4 = _stack(rates(time + duration, x + duration * k3, last, K), x)
    total = k2 + k3  # x + duration / 6 (k1 + 2 k2 + 2 k3 + k4), without further arrays
    total *= 2.0
    total += k1
    total += k4
    total *= duration / 6.0
    total += x
    return total


def _stack(rates: tuple[Any, ...], like: Array) -> Array:
    if like.ndim == 1:  # one aircraft: its rates are numbers
        return np.array(rates)
    stacked = np.empty_like(like)
    for row, rate in zip(stacked, rates, strict=True):
        row[...] = rate
    return stacked


def roll_out_batch(
    model: Model, start: Array, commands: Array, dt: float, slope: Array | None = None
) -> Array:
    """Fly many aircraft through given control positions, all advanced together in NumPy.

    Args:
        model: the aircraft.
        start: (B, n_states) initial states.
        commands: (B, T, 4) mean control positions during each step.
        dt: step length [s].
        slope: (B, T, 4) half of their change over each step; None: constant.

    Returns:
        (B, T + 1, n_states); row 0 is the start.
    """
    K, rates = model.K, state_rates(model.form, model.terms, model.winds)
    x = np.ascontiguousarray(start.T)
    flown = np.empty((commands.shape[1] + 1, *x.shape))
    flown[0] = x
    means = np.ascontiguousarray(commands.transpose(1, 2, 0))
    slopes = None if slope is None else np.ascontiguousarray(slope.transpose(1, 2, 0))
    for k, mean in enumerate(means):
        x = step_batch(rates, K, k * dt, x, mean, dt, None if slopes is None else slopes[k])
        flown[k + 1] = x
    return np.ascontiguousarray(flown.transpose(2, 0, 1))


def roll_out_compiled(
    model: Model, start: Array, commands: Array, dt: float, slope: Array | None = None
) -> Array:
    """The same as `roll_out_batch` to rounding, one aircraft after the other, compiled by numba.

    Much faster for a single flight; the first call compiles for some seconds. Without numba, as in
    a browser, it runs as plain Python.
    """
    fly, _ = _compile_flight(model.form, model.terms, model.winds)
    flown = np.empty((start.shape[0], commands.shape[1] + 1, start.shape[1]))
    slopes = np.zeros_like(commands) if slope is None else slope
    for one_start, means, half_changes, out in zip(start, commands, slopes, flown, strict=True):
        fly(
            one_start,
            np.ascontiguousarray(means),
            np.ascontiguousarray(half_changes),
            0.0,
            dt,
            model.K,
            out,
        )
    return flown


def _njit(function: Any) -> Any:
    """numba's compiler; the function itself where there is no numba."""
    try:
        from numba import njit
    except ModuleNotFoundError:
        return function
    return njit(function)


@cache
def _compile(function: Any) -> Any:
    """A function compiled by numba, with the functions of its module and closure that it calls."""
    if not isinstance(function, FunctionType):
        return function  # compiled already
    scope = function.__globals__
    called = {
        name: _compile(scope[name])
        for name in function.__code__.co_names
        if isinstance(scope.get(name), FunctionType) and scope[name] is not function
    }
    cells = tuple(
        CellType(_compile(cell.cell_contents))
        if isinstance(cell.cell_contents, FunctionType)
        else cell
        for cell in function.__closure__ or ()
    )
    return _njit(
        FunctionType(function.__code__, {**scope, **called}, function.__name__, None, cells)
    )


@cache
def _compile_flight(form: Any, terms: Any, winds: Any) -> Any:
    f = state_rates(form, terms, winds, _compile)
    n = 9 if form == "paper" else 12

    @_njit
    def fly(start, means, slopes, time, dt, K, out):  # type: ignore[no-untyped-def]
        x, shifted, total = start.copy(), np.empty(n), np.empty(n)
        out[0] = x
        for step in range(means.shape[0]):
            total[:] = 0.0
            shifted[:] = x
            for stage in range(4):
                part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                command = means[step] + (2.0 * part - 1.0) * slopes[step]
                rates = f(time + (step + part) * dt, shifted, command, K)
                weight = 1.0 if stage in (0, 3) else 2.0
                next_ahead = dt if stage == 2 else 0.5 * dt
                for i in range(n):
                    total[i] += weight * rates[i]
                    shifted[i] = x[i] + next_ahead * rates[i]
            for i in range(n):
                x[i] += dt / 6.0 * total[i]
            out[step + 1] = x

    @_njit
    def fly_all(starts, means, slopes, times, dt, K, out):  # type: ignore[no-untyped-def]
        flown = np.empty((means.shape[1] + 1, n))
        for row in range(starts.shape[0]):
            fly(starts[row], means[row], slopes[row], times[row], dt, K, flown)
            out[row] = flown[-1]

    return fly, fly_all


def advance_compiled(
    model: Model, times: Array, x: Array, mean: Array, slope: Array, dt: float
) -> Array:
    """Fly many aircraft, each at a time of its own, through some steps, compiled by numba.

    The same as `step_batch` step by step, to rounding; the first call compiles for some seconds.

    Args:
        model: the aircraft.
        times: (B,) now [s].
        x: (B, n_states) states, SI.
        mean: (B, S, 4) mean control positions during each step.
        slope: (B, S, 4) half of their change over each step.
        dt: step length [s].

    Returns:
        (B, n_states) states S steps later.
    """
    _, fly_all = _compile_flight(model.form, model.terms, model.winds)
    flown = np.empty_like(x)
    fly_all(x, mean, slope, times, dt, model.K, flown)
    return flown


ROLL_OUTS: dict[str, Callable[[Model, Array, Array, float, Array | None], Array]] = {
    "batch": roll_out_batch,
    "compiled": roll_out_compiled,
}


def roll_out(
    model: Model,
    start: Array,
    commands: Array,
    dt: float,
    backend: str = "batch",
    slope: Array | None = None,
) -> Array:
    """Fly one or many aircraft through control positions, without delay and lag.

    Args:
        model: the aircraft.
        start: (n_states,) or (B, n_states) initial states in the order of STATE_NAMES, SI.
        commands: (T, 4) or (B, T, 4) in the order of COMMAND_NAMES, constant over each step.
        dt: step length [s], > 0.
        backend: "batch" (NumPy) or "compiled" (numba).
        slope: shape of commands; positions run from commands - slope to commands + slope.

    Returns:
        (T + 1, n_states) or (B, T + 1, n_states); row 0 is the start.

    Raises:
        InputError: a shape does not fit, the step is not positive, or the backend is unknown.
    """
    if backend not in ROLL_OUTS:
        raise InputError(f"backend: expected one of {', '.join(ROLL_OUTS)}, got {backend!r}")
    require_range("dt", dt, low=1e-6, high=1.0)
    starts = require_shape("start", np.atleast_2d(start), (None, model.n_states))
    steps = np.asarray(commands, np.float64)
    steps = require_shape("commands", steps if steps.ndim == 3 else steps[None], (None, None, 4))
    count = max(len(starts), len(steps))
    if {len(starts), len(steps)} - {1, count}:
        raise InputError(
            f"start and commands: expected equal batches, got {len(starts)} and {len(steps)}"
        )
    starts = np.broadcast_to(starts, (count, model.n_states))
    full = (count, *steps.shape[1:])
    half_changes = None
    if slope is not None:
        half_changes = np.asarray(slope, np.float64)
        half_changes = require_shape(
            "slope", half_changes if half_changes.ndim == 3 else half_changes[None], steps.shape
        )
        half_changes = np.broadcast_to(half_changes, full)
    flown = ROLL_OUTS[backend](model, starts, np.broadcast_to(steps, full), dt, half_changes)
    return flown if np.ndim(start) == 2 or np.ndim(commands) == 3 else flown[0]


def fly(model: Model, start: Array, t: Array, commands: Array, backend: str = "batch") -> Array:
    """Fly one aircraft through logged commands, with the model's input map (delay, servo lag).

    Args:
        model: the aircraft.
        start: (n_states,) state at t[0].
        t: (N,) uniformly spaced times [s].
        commands: (N, 4) control inputs, each held until the next.
        backend: "batch" or "compiled".

    Returns:
        (N, n_states) the state at each time.

    Raises:
        InputError: times are not uniform, or a shape does not fit.
    """
    t = require_shape("t", t, (None,))
    control_inputs = require_shape("commands", commands, (len(t), 4))
    dt = float(np.mean(np.diff(t))) if len(t) > 1 else 0.05
    if len(t) > 2 and np.ptp(np.diff(t)) > 1e-3 * dt:
        raise InputError(
            "t: expected evenly spaced times, got uneven ones; resample the flight table first"
        )
    substeps = max(1, round(SUBSTEPS[model.form] * dt / 0.05))
    edges = t[0] + dt / substeps * np.arange((len(t) - 1) * substeps + 1)
    if len(t) == 1:
        # A single time: the initial state is the whole flight.
        return require_shape("start", start, (model.n_states,))[None]
    mean, slope = model.actuator_positions(t, control_inputs, edges, model.K)
    return roll_out(model, start, mean, dt / substeps, backend, slope)[::substeps]


def advance(
    model: Model, t: float, t_end: float, x: Array, times: Array, commands: Array,
    effectiveness: Array | None = None, level: Array | None = None,
) -> Array:  # fmt: skip
    """Fly one or many aircraft from t to t_end through one list of commands, with the input map.

    Args:
        model: the aircraft.
        t: now [s].
        t_end: [s]; not after t returns x unchanged.
        x: (n_states, ...) states at t, SI.
        times: (N,) when each command arrives at the aircraft, before delay and lag of the model
            itself [s], not decreasing; the first command also acts before its time.
        commands: (N, 4) in the order of COMMAND_NAMES.
        effectiveness: (4, ...) e of each aircraft's controls: a position u acts as level +
            e (u - level); None for one.
        level: (4,) the positions at which e changes nothing; None for zeros.

    Returns:
        (n_states, ...) states at t_end.
    """
    steps = math.ceil((t_end - t) / CONTROL_PERIOD_S * SUBSTEPS[model.form] - 1e-9)
    if steps <= 0:
        return x
    K, rates = model.K, state_rates(model.form, model.terms, model.winds)
    _, lag, series = model.added_input_map(K)
    dt = (t_end - t) / steps
    # The servos start in equilibrium so many steps before t that they have settled by then.
    before = math.ceil((SETTLING_S + 12.0 * max(lag, series)) / dt)
    edges = t + dt * np.arange(-before, steps + 1, dtype=np.float64)
    recent = max(int(np.searchsorted(times, edges[0] - 1.0, side="right")) - 1, 0)
    mean, slope = model.actuator_positions(times[recent:], commands[recent:], edges, K)
    columns = (4, *(1,) * (x.ndim - 1))
    for k in range(before, before + steps):
        position, half_change = mean[k].reshape(columns), slope[k].reshape(columns)
        if effectiveness is not None:
            still = np.zeros(columns) if level is None else level.reshape(columns)
            position = still + effectiveness * (position - still)
            half_change = effectiveness * half_change
        x = step_batch(rates, K, edges[k], x, position, dt, half_change)
    return x
