"""Dead band: small commands no longer reach the control surfaces; one effect in two forms."""

from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, draw_size
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array


def deadband(t: Array, commands: Array, K: Any) -> Array:
    """u where |u| > deadband, else 0; throttle as it is. The rest is not shifted.

    The edge is a smooth step of a tenth of the band, so that a fit has a derivative.
    """
    size = np.abs(commands[:, 1:])
    width = 0.1 * K.deadband + 1e-6
    passed = 1.0 / (1.0 + np.exp(np.clip((K.deadband - size) / width, -50.0, 50.0)))
    if K.deadband <= 0.0:
        return commands
    return np.concatenate([commands[:, :1], commands[:, 1:] * passed], axis=1)


def dead_zone(t: Array, commands: Array, K: Any) -> Array:
    """sign(u) max(|u| - dead_zone, 0): the rest is shifted too; throttle as it is.

    The textbook's dead zone [Slotine & Li, Applied Nonlinear Control, ch. 5.2].
    """
    surfaces = commands[:, 1:]
    passed = np.sign(surfaces) * np.maximum(np.abs(surfaces) - K.dead_zone, 0.0)
    return np.concatenate([commands[:, :1], passed], axis=1)


ACTS_ON = ("sticks", "roll", "pitch", "yaw")
SAME_FORM = (
    "dead band of the aileron",
    "dead band of the elevator",
    "dead band of the rudder",
)

EFFECTS = (
    Effect(
        name="deadband",
        physics="Small commands no longer reach the control surfaces.",
        parameters=(
            Parameter("deadband", 0.03, 0.0, 0.4, "-", "share of full deflection without effect"),
        ),
        equation="u -> u where |u| > {deadband}, else 0; u: aileron, elevator, rudder",
        command_map=deadband,
        starts=({"deadband": 0.08}, {"deadband": 0.15}),
        acts_on=ACTS_ON,
        same_form=SAME_FORM,
        separated_by={"small movements": "a dead band removes the small ones only"},
        sizes=(0.02, 0.04, 0.15),
        draw=draw_size("deadband"),
        frozen_number=12,
    ),
    Effect(
        name="deadband",
        physics="The surfaces stop short by a constant: play in the linkage.",
        parameters=(
            Parameter("dead_zone", 0.03, 0.0, 0.4, "-", "share of full deflection that is lost"),
        ),
        equation="u -> sign(u) max(|u| - {dead_zone}, 0); u: aileron, elevator, rudder",
        command_map=dead_zone,
        starts=({"dead_zone": 0.08},),
        acts_on=ACTS_ON,
        same_form=SAME_FORM,
        separated_by={"small movements": "it takes as much from small ones as from large ones"},
        frozen_number=12,
    ),
)
