"""Wing drag: a part on one wing drags, and turns the nose towards that wing."""

from functools import cache
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, LoadsFunction
from falconwing_kit.aircraft.terms import (
    Flow,
    Loads,
    Parameter,
    Term,
    add_loads,
    drag_loads,
    roll_of_yawing_moment,
)

# Yawing moment per drag of a part at half the semispan of the 150 g aircraft: lever 0.175 m over
# its radius of gyration squared, 0.030 m^2.
YAW_PER_DRAG = 5.8


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def wing_drag(terms: tuple[Term, ...]) -> LoadsFunction:
    """D/m = V^2 wing_drag, dr/dt = V^2 wing_drag_yaw, a drag times its lever [Newton].

    With a product of inertia the same moment also rolls the aircraft.
    """
    roll_of_yaw = roll_of_yawing_moment(terms)

    def one_sided(air: Flow, K: Any) -> Loads:
        yaw = air.airspeed * air.airspeed * K.wing_drag_yaw
        turn = 0.0, 0.0, 0.0, roll_of_yaw(K) * yaw, 0.0, yaw
        return add_loads(drag_loads(air, air.airspeed * K.wing_drag), turn)

    return one_sided


def _draw(rng: np.random.Generator, size: float) -> dict[str, float]:
    side = float(rng.choice([-1.0, 1.0]))
    return {"wing_drag": size, "wing_drag_yaw": side * YAW_PER_DRAG * size}


EFFECTS = (
    Effect(
        name="wing_drag",
        physics="A part on one wing has drag, which slows the aircraft and turns it to that side.",
        parameters=(
            Parameter("wing_drag", 0.003, 0.0, 0.3, "1/m", "drag added at zero lift"),
            Parameter(
                "wing_drag_yaw", 0.01, -2.0, 2.0, "1/m^2", "yawing moment of it, right positive"
            ),
        ),
        equation="D/m -> D/m + {wing_drag} V^2, dr/dt -> dr/dt + {wing_drag_yaw} V^2",
        loads_of=wing_drag,
        contains=("extra_drag",),
        essential=("wing_drag", "wing_drag_yaw"),
        acts_on=("along", "yaw"),
        separated_by={"glides": "its drag slows a glide too, the trim of a rudder does not"},
        sizes=(0.004, 0.006, 0.012),
        draw=_draw,
    ),
)
