"""Input map: stick positions as logged -> control positions as they act, after radio delay and servo lag."""

import numpy as np

from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array

INPUT_PARAMETERS = (
    Parameter("delay", 0.02, 0.0, 0.4, "s", "from the logged command to the servo"),
    Parameter("lag", 0.03, 0.0, 0.4, "s", "time constant of servo and propeller"),
)


def delayed_hold(t: Array, commands: Array, edges: Array, delay: float) -> Array:
    """Mean of the held and delayed commands over each integration step.

    A command acts from its own time stamp plus the delay until the next one. The mean over a step, rather than the
    value at its start, makes the result a continuous function of the delay, which a fit needs.

    Args:
        t: (N,) time of each command [s], increasing.
        commands: (N, 4).
        edges: (..., S + 1) ends of the integration steps [s], increasing along the last axis.
        delay: [s], >= 0.

    Returns:
        (..., S, 4) mean command of each step; before the first command, the first command.
    """
    area = np.concatenate([np.zeros((1, 4)), np.cumsum(commands[:-1] * np.diff(t)[:, None], axis=0)])
    when = np.maximum(edges - delay, t[0])
    row = np.clip(np.searchsorted(t, when, side="right") - 1, 0, len(t) - 1)
    reached = area[row] + (when - t[row])[..., None] * commands[row]
    span = np.diff(when, axis=-1)
    mean = np.diff(reached, axis=-2) / np.maximum(span, 1e-12)[..., None]
    return np.where(span[..., None] > 1e-12, mean, commands[row[..., 1:]])


def first_order_lag(steps: Array, durations: Array, lag: float) -> Array:
    """Mean over each step of a first-order lag driven by stepwise constant commands: lag dy/dt = u - y.

    Args:
        steps: (..., S, 4) commands; the lag starts settled on the first.
        durations: (..., S) step lengths [s], > 0.
        lag: time constant [s], >= 0.

    Returns:
        (..., S, 4).
    """
    if lag < 1e-6:
        return steps
    kept = np.exp(-durations / lag)[..., None]
    ratio = (lag / durations)[..., None]
    mean = np.empty_like(steps)
    reached = steps[..., 0, :]
    for k in range(steps.shape[-2]):
        target = steps[..., k, :]
        after = target + (reached - target) * kept[..., k, :]
        mean[..., k, :] = target - ratio[..., k, :] * (after - reached)
        reached = after
    return mean


def acting_commands(t: Array, commands: Array, edges: Array, delay: float, lag: float) -> Array:
    """Logged commands -> mean control position over each integration step.

    Args:
        t: (N,) time of each command [s].
        commands: (N, 4).
        edges: (..., S + 1) ends of the integration steps [s].
        delay: from the logged command to the servo [s].
        lag: time constant of the servo [s].

    Returns:
        (..., S, 4). The lag is settled at the first step, so begin some steps early where it matters.
    """
    return first_order_lag(delayed_hold(t, commands, edges, delay), np.diff(edges, axis=-1), lag)
