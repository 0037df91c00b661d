"""Trim bias: the neutral positions of the control surfaces have moved."""

from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, draw_direction
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array


def trim_bias(t: Array, commands: Array, K: Any) -> Array:
    """u + (0, bias_aileron, bias_elevator, bias_rudder), in shares of full deflection."""
    return commands + np.array([0.0, K.bias_aileron, K.bias_elevator, K.bias_rudder])


EFFECTS = (
    Effect(
        name="trim_bias",
        physics="The neutral positions of the control surfaces have moved.",
        parameters=tuple(
            Parameter(
                f"bias_{stick}",
                0.01,
                -0.5,
                0.5,
                "-",
                f"{stick} added, share of full deflection",
            )
            for stick in ("aileron", "elevator", "rudder")
        ),
        equation=(
            "aileron -> aileron + {bias_aileron}, elevator -> elevator + {bias_elevator}, "
            "rudder -> rudder + {bias_rudder}"
        ),
        command_map=trim_bias,
        acts_on=("roll", "pitch", "yaw"),
        same_form=("bias of the aileron", "bias of the elevator", "bias of the rudder"),
        separated_by={"hands off": "a trim bias turns the aircraft faster with speed"},
        sizes=(0.08, 0.1, 0.2),
        draw=draw_direction("bias_aileron", "bias_elevator", "bias_rudder"),
        frozen_number=11,
    ),
)
