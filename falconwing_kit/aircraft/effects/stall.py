"""Stall: above an angle of attack lift is lost and drag is added."""

from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, add_loads, drag_loads, lift_loads

WIDTH = 0.035  # rad, of the smooth step: 2 deg


def stall(air: Flow, K: Any) -> Loads:
    """Above stall_alpha, c loses d = stall_loss cL_alpha (alpha - stall_alpha); drag d tan alpha.

    A smooth step of 2 deg [Beard & McLain, eq. 4.10].
    """
    beyond = WIDTH * np.logaddexp(0.0, (air.alpha - K.stall_alpha) / WIDTH)
    lost = K.stall_loss * K.cL_alpha * beyond
    lift = lift_loads(air, -air.airspeed * air.airspeed * lost)
    drag = air.airspeed * lost * np.tan(np.minimum(np.maximum(air.alpha, 0.0), 1.0))
    return add_loads(lift, drag_loads(air, drag))


EFFECTS = (
    Effect(
        name="stall",
        physics="At high angle of attack the flow separates from the wing: less lift, more drag.",
        parameters=(
            Parameter("stall_alpha", 0.20, 0.08, 0.5, "rad", "angle of attack where it begins"),
            Parameter("stall_loss", 0.3, 0.0, 2.0, "-", "share of the lift slope lost beyond"),
        ),
        equation=(
            "for alpha > {stall_alpha}: c -> c - d, d = {stall_loss} cL_alpha "
            "(alpha - {stall_alpha}), D/m -> D/m + V^2 d tan(alpha)"
        ),
        loads=stall,
        starts=({"stall_alpha": 0.13}, {"stall_alpha": 0.17}),
        shape=("stall_alpha",),
        acts_on=("lift", "along", "pitch"),
        separated_by={"slow flight": "it begins at high angles of attack only"},
        sizes=(0.3, 0.4, 0.6),  # reached in each steep turn
        draw=lambda rng, size: {
            "stall_alpha": float(rng.uniform(0.13, 0.17)),
            "stall_loss": size,
        },
        frozen_number=18,
    ),
)
