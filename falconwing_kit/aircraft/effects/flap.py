"""Flap: more lift at the same angle of attack, and more drag."""

from typing import Any

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, add_loads, drag_loads, lift_loads


def flap(air: Flow, K: Any) -> Loads:
    """c -> c + flap_lift in lift and induced drag, and drag of its own: V^2 flap_drag.

    [Raymer, Aircraft Design, ch. 12]
    """
    lift = lift_loads(air, air.airspeed * air.airspeed * K.flap_lift)
    induced = K.cD_induced * K.flap_lift * (2.0 * (K.cL_0 + K.cL_alpha * air.alpha) + K.flap_lift)
    return add_loads(lift, drag_loads(air, air.airspeed * (K.flap_drag + induced)))


EFFECTS = (
    Effect(
        name="flap",
        physics="A flap is out: more lift at the same angle, and more drag.",
        parameters=(
            Parameter("flap_lift", 0.01, 0.0, 0.4, "1/m", "lift added at any angle"),
            Parameter("flap_drag", 0.001, 0.0, 0.2, "1/m", "drag that comes with it"),
        ),
        equation=(
            "c -> c + {flap_lift} in L/m = V^2 c and in the induced drag V^2 cD_induced c^2, "
            "D/m -> D/m + {flap_drag} V^2"
        ),
        loads=flap,
        contains=("extra_drag",),
        essential=("flap_lift",),
        acts_on=("lift", "along"),
        same_form=("lift with airspeed squared",),
        separated_by={"speed sweep": "its lift grows with speed"},
        sizes=(0.024, 0.04, 0.08),
        draw=lambda rng, size: {"flap_lift": size, "flap_drag": 0.08 * size},
        frozen_number=4,
    ),
)
