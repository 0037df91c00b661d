"""Random waypoints: a generator's draws -> waypoints of a way that turns and climbs at random
inside the hall.
"""

import math

import numpy as np

from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.loops import course_axes
from falconwing_kit.control.plan import MARGIN, MIN_HEIGHT, Manoeuvre, curve_points
from falconwing_kit.core.checks import Array, InputError

TRIES, KNOTS = 500, 8


def random_waypoints(rng: np.random.Generator) -> Array:
    """Waypoints every metre of a way that turns and climbs at random, with room on all sides.

    Knot by knot: what would leave the hall is drawn again, and where that does not help, all of it.

    Args:
        rng: draws start and course, then curvature and climb at knots 5 m apart.

    Returns:
        (n, 3) [m].

    Raises:
        InputError: the hall is too small for any.
    """
    for _ in range(TRIES):
        start, yaw = (
            rng.uniform((-21.5, -11.0, 1.2), (16.5, 7.0, 3.8)),
            rng.uniform(-math.pi, math.pi),
        )
        behind = start - 6.0 * course_axes(yaw)[0]  # where a follower may begin
        bends = [np.zeros(2)]
        for _ in range(10 * KNOTS):
            bend = rng.uniform(-1.0, 1.0, 2) * (0.105, 0.12)
            tried = [*bends, bend, bend * (1.0, 0.0), bend * (1.0, 0.0)]  # there must be a way on
            curvature, climb = np.array(tried).T
            s = np.linspace(0.0, 5.0 * (len(tried) - 1), len(tried))
            points = np.vstack([behind, start + curve_points(yaw, s, curvature, climb)])
            if np.all(Hall().margin(points) > MARGIN) and np.all(points[:, 2] > MIN_HEIGHT):
                bends = tried[:-2]
            if len(bends) == KNOTS:
                return np.asarray(points[1:-10])
    raise InputError(
        f"random waypoints: none of {TRIES} draws stayed inside the hall; take another seed"
    )


MANOEUVRE = Manoeuvre(
    "random_waypoints", "turns and climbs drawn from the seed", random_waypoints, 4
)
