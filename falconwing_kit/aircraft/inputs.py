"""Input map: logged commands -> control positions after radio delay and servo lag.

The input map is the dynamics of the actuators: a delay and a first-order lag.
"""

import numpy as np

from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array

INPUT_PARAMETERS = (
    Parameter("delay", 0.02, 0.0, 0.4, "s", "from the logged command to the servo"),
    Parameter("lag", 0.03, 0.0, 0.4, "s", "time constant of servo and propeller"),
)


def actuator_response(
    t: Array, commands: Array, edges: Array, delay: float, lag: float
) -> tuple[Array, Array]:
    """First-order servo response to zero-order-held commands, averaged over each integration step.

    lag dy/dt = u(t - delay) - y, u constant between commands. The position over a step is returned
    as a straight line with the same mean and first moment as y, exact while at most one command
    changes per step. The mean alone is a continuous function of the delay, which a fit needs, but
    biases it by some milliseconds, because commands change at the same phase of every step; the
    first moment removes that bias.

    Args:
        t: (N,) time of each command [s], increasing; the first command also acts before it.
        commands: (N, 4).
        edges: (..., S + 1) ends of the integration steps [s], increasing along the last axis.
        delay: from the logged command to the servo [s], >= 0.
        lag: time constant of the servo [s], >= 0.

    Returns:
        mean (..., S, 4) and slope (..., S, 4): the position runs from mean - slope to mean + slope
        over the step. The servo is in equilibrium at the first edge, so start some steps early.
    """
    # Integral of the held commands up to each edge; its difference over a step is the step's mean.
    when = edges - delay
    row = np.clip(np.searchsorted(t, when, side="right") - 1, 0, len(t) - 1)
    area = np.concatenate(
        [np.zeros((1, 4)), np.cumsum(commands[:-1] * np.diff(t)[:, None], axis=0)]
    )
    command_integral = area[row] + (when - t[row])[..., None] * commands[row]
    duration = np.diff(edges, axis=-1)[..., None]
    mean = np.diff(command_integral, axis=-2) / duration
    # First moment about the middle of the step, of the one command change in it.
    before, after = commands[row[..., :-1]], commands[row[..., 1:]]
    changed = (row[..., 1:] > row[..., :-1])[..., None]
    since = np.where(changed, (when[..., 1:] - t[row[..., 1:]])[..., None], 0.0)
    moment = 0.5 * (after - before) * since * (duration - since)
    if lag > 1e-6:
        # Servo position at the edges, from the closed-form step response.
        decay, decay_since = np.exp(-duration / lag), np.exp(-since / lag)
        forcing = before * (decay_since - decay) + after * (1.0 - decay_since)
        position = np.empty((*edges.shape, 4))
        position[..., 0, :] = mean[..., 0, :]
        for k in range(duration.shape[-2]):
            position[..., k + 1, :] = decay[..., k, :] * position[..., k, :] + forcing[..., k, :]
        begin, end = position[..., :-1, :], position[..., 1:, :]
        # Mean and first moment of y = u - lag dy/dt, integrated over the step by parts.
        mean = mean - lag / duration * (end - begin)
        moment = moment - lag * duration * (0.5 * (begin + end) - mean)
    return mean, 6.0 * moment / duration**2


def second_order_lag(
    mean: Array, slope: Array, durations: Array, lag: float
) -> tuple[Array, Array]:
    """First-order lag of positions that change linearly over each step: a second servo in series.

    Args:
        mean: (..., S, 4) mean position over each step.
        slope: (..., S, 4) half of its change over the step.
        durations: (..., S) step lengths [s].
        lag: time constant [s]; zero returns the positions unchanged.

    Returns:
        mean and slope after the lag, each (..., S, 4); in equilibrium at the first edge.
    """
    if lag < 1e-6:
        return mean, slope
    duration = durations[..., None]
    decay, behind = np.exp(-duration / lag), 2.0 * lag / duration * slope
    position = np.empty((*mean.shape[:-2], mean.shape[-2] + 1, mean.shape[-1]))
    position[..., 0, :] = mean[..., 0, :]
    for k in range(mean.shape[-2]):  # response to a ramp: it follows by `behind` in the end
        m, s, b = mean[..., k, :], slope[..., k, :], behind[..., k, :]
        position[..., k + 1, :] = m + s - b + (position[..., k, :] - (m - s - b)) * decay[..., k, :]
    begin, end = position[..., :-1, :], position[..., 1:, :]
    after = mean - lag / duration * (end - begin)
    moment = slope * duration**2 / 6.0 - lag * duration * (0.5 * (begin + end) - after)
    return after, 6.0 * moment / duration**2
