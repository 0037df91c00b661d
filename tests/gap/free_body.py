"""A body without aerodynamics, for which the filter is linear and closed forms exist; simulated."""

import numpy as np

from falconwing_kit.aircraft.inputs import INPUT_PARAMETERS
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.gap.innovations import FilterNoise, Row
from falconwing_kit.gap.noise import PoseNoiseModel

DT = 0.05
WHITE = PoseNoiseModel((0.0, 0.0), (0.5, 0.5))
FREE_BODY = Model("rates", (), (), INPUT_PARAMETERS, {p.name: p.start for p in INPUT_PARAMETERS})


def noise(correlated: PoseNoiseModel = WHITE) -> FilterNoise:
    """Pose noise of the marker, disturbances of 0.3 m/s^2 and 0.002 rad/s^2 over 0.5 s."""
    return FilterNoise(
        np.repeat([0.03, 0.01], 3), correlated, np.full(7, np.nan),
        np.repeat([0.3, 0.002], 3), 0.5,
    )  # fmt: skip


def falling_rows(
    count: int, rng: np.random.Generator | None, force_down: float = 0.0, onset: float = np.inf
) -> list[Row]:
    """Poses of a body that falls level, exactly as the filter's model has it.

    x, y, z follow p' = v, v' = -g z + d with Gauss-Markov d; roll, pitch and yaw stay so small that
    they are three more such integrators, the moments their disturbances.

    Args:
        count: rows, DT apart.
        rng: of disturbances and pose noise; None: neither.
        force_down: a constant force per mass along body z since the onset [m/s^2].
        onset: [s].
    """
    scale, model = 0.0 if rng is None else 1.0, noise()
    rng = rng or np.random.default_rng(0)
    decay = np.exp(-DT / model.disturbance_time)
    d = scale * model.disturbance * rng.normal(size=6)
    p, v, rows = np.zeros(6), np.zeros(6), []
    # Forces right and down point along world -y and -z.
    sign = np.array([1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    for k in range(count):
        error = scale * model.pose * rng.normal(size=6)
        rows.append(Row(k * DT, p + error, np.zeros(4), np.full(7, np.nan)))
        a = sign * d
        a[2] -= GRAVITY + (force_down if k * DT >= onset - 1e-9 else 0.0)
        p, v = p + DT * v + 0.5 * DT**2 * a, v + DT * a
        d = decay * d + scale * np.sqrt(1 - decay**2) * model.disturbance * rng.normal(size=6)
    return rows
