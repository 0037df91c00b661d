"""Random waypoints: random draws -> waypoints of a path of random turns and climbs in the hall."""

import math

import numpy as np

from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.loops import course_axes
from falconwing_kit.control.plan import MARGIN, MIN_HEIGHT, Manoeuvre, curve_points
from falconwing_kit.core.checks import Array, InputError

TRIES, KNOTS = 500, 8
KNOT_SPACING = 5.0  # [m]


def random_waypoints(rng: np.random.Generator) -> Array:
    """Waypoints (n, 3) every metre [m] of a path with random curvature and climb at its knots.

    Rejection sampling knot by knot: a knot that would lead out of the hall is drawn again, and
    after too many rejections the whole path.

    Raises:
        InputError: the hall is too small for any path.
    """
    for _ in range(TRIES):
        start = rng.uniform((-21.5, -11.0, 1.2), (16.5, 7.0, 3.8))
        yaw = rng.uniform(-math.pi, math.pi)
        behind = start - 6.0 * course_axes(yaw)[0]  # a follower may begin here
        if Hall().margin(behind) <= MARGIN:  # whatever the knots: skip their draws
            rng.uniform(-1.0, 1.0, (10 * KNOTS, 2))
            continue
        knots = [np.zeros(2)]  # curvature [1/m] and climb [rad]
        for _ in range(10 * KNOTS):
            knot = rng.uniform(-1.0, 1.0, 2) * (0.105, 0.12)
            # Two more level knots of the same turn: the path must be able to continue.
            candidate = [*knots, knot, knot * (1.0, 0.0), knot * (1.0, 0.0)]
            curvature, climb = np.array(candidate).T
            s = KNOT_SPACING * np.arange(len(candidate), dtype=np.float64)
            points = np.vstack([behind, start + curve_points(yaw, s, curvature, climb)])
            if np.all(Hall().margin(points) > MARGIN) and np.all(points[:, 2] > MIN_HEIGHT):
                knots = candidate[:-2]
            if len(knots) == KNOTS:
                return np.asarray(points[1:-10])  # without the last two knots
    raise InputError(
        f"random waypoints: expected a path inside the hall, {TRIES} draws left it; take another"
        " seed"
    )


MANOEUVRE = Manoeuvre(
    "random_waypoints", "turns and climbs drawn from the seed", random_waypoints, 4
)
