"""Ground effect: more lift and less induced drag close to the floor."""

from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.terms import (
    Flow,
    Loads,
    Parameter,
    add_loads,
    drag_loads,
    lift_coefficient,
    lift_loads,
)

HEIGHT_M = 0.5  # decay height, below the span of a 0.7 m wing


def ground_effect(air: Flow, K: Any) -> Loads:
    """Lift times (1 + ground_lift n), induced drag times (1 - ground_drag n), n = exp(-h / 0.5 m).

    [McCormick, Aerodynamics, Aeronautics and Flight Mechanics, ch. 7]
    """
    near = np.exp(-np.maximum(air.height, 0.0) / HEIGHT_M)
    c = lift_coefficient(air, K)
    lift = lift_loads(air, air.airspeed * air.airspeed * c * K.ground_lift * near)
    drag = drag_loads(air, -air.airspeed * K.cD_induced * c * c * K.ground_drag * near)
    return add_loads(lift, drag)


EFFECTS = (
    Effect(
        name="ground_effect",
        physics="The floor blocks the downwash under the wing: more lift, less induced drag.",
        parameters=(
            Parameter("ground_lift", 0.1, 0.0, 2.0, "-", "share of lift added at the floor"),
            Parameter(
                "ground_drag", 0.2, -4.0, 1.5, "-", "share of induced drag lost at the floor"
            ),
        ),
        equation=(
            "L -> L (1 + {ground_lift} n), induced drag times (1 - {ground_drag} n), "
            f"n = exp(-h / {HEIGHT_M} m)"
        ),
        loads=ground_effect,
        essential=("ground_lift",),
        acts_on=("lift", "along"),
        same_form=("lift with nearness to the ground",),
        separated_by={"low passes": "only ground effect fades with height"},
        sizes=(0.2, 0.6, 0.9),
        draw=lambda rng, size: {"ground_lift": size, "ground_drag": size},
        frozen_number=2,
    ),
)
