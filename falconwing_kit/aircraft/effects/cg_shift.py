"""Shift of the centre of gravity: lift and side force turn the aircraft about the new centre."""

from typing import Any

from falconwing_kit.aircraft.effect import Effect, draw_direction
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, lift_coefficient


def cg_shift(air: Flow, K: Any) -> Loads:
    """dq/dt = s L/m, dr/dt = s (Iyy/Izz) Y/m, s = cg_moment: lever / (radius of gyration)^2.

    Iyy/Izz = (1 - Jz) / (1 + Jy) from the inertia coupling [Beard & McLain, eq. 3.17].
    """
    lever = air.airspeed * air.airspeed * K.cg_moment
    side = K.cY_beta * air.beta + K.cY_dr * air.rudder
    yaw = lever * (1.0 - K.Jz) / (1.0 + K.Jy) * side
    return 0.0, 0.0, 0.0, 0.0, lever * lift_coefficient(air, K), yaw


EFFECTS = (
    Effect(
        name="cg_shift",
        physics="The centre of gravity has moved along the fuselage, so lift adds a moment.",
        parameters=(
            Parameter(
                "cg_moment",
                0.05,
                -5.0,
                5.0,
                "1/m",
                "lever of the lift, positive with the mass moved back",
            ),
        ),
        equation="dq/dt -> dq/dt + {cg_moment} L/m, dr/dt -> dr/dt + {cg_moment} (Iyy/Izz) Y/m",
        loads=cg_shift,
        acts_on=("pitch", "yaw"),
        same_form=("pitch moment with angle of attack",),
        separated_by={
            "elevator doublets": "its moment follows the lift, the elevator's does not",
            "speed sweep": "each speed needs another elevator",
        },
        sizes=(0.1, 0.3, 0.6),
        draw=draw_direction("cg_moment"),
        frozen_number=15,
    ),
)
