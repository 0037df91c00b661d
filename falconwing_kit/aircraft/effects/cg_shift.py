"""Shift of the centre of gravity: lift and side force turn the aircraft about the new centre."""

from functools import cache
from typing import Any

from falconwing_kit.aircraft.effect import Effect, LoadsFunction, draw_direction
from falconwing_kit.aircraft.terms import (
    CROSS_MOMENTS,
    Flow,
    Loads,
    Parameter,
    Term,
    lift_coefficient,
    roll_of_yawing_moment,
)


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def cg_shift(terms: tuple[Term, ...]) -> LoadsFunction:
    """dq/dt = s L/m, dr/dt = s (Iyy/Izz) Y/m, s = cg_moment: lever / (radius of gyration)^2.

    Iyy/Izz = (1 - Jz) / (1 + Jy) from the inertia coupling [Beard & McLain, eq. 3.17]. With a
    product of inertia the yawing moment turns by Iyy Gamma_8 and also rolls [ibid., eq. 3.13].
    """
    roll_of_yaw = roll_of_yawing_moment(terms)

    def planar(K: Any) -> Any:
        return (1.0 - K.Jz) / (1.0 + K.Jy)

    def coupled(K: Any) -> Any:
        # In units of Ixx: x = Jxz, c = Izz, G = c - x^2; then Iyy = 1 + x^2 - Jz G and
        # Gamma_8 = 1 / G.
        x = roll_of_yaw(K)
        G = (1.0 - K.Jx) / (1.0 + K.Jz) - x * x
        return (1.0 + x * x) / G - K.Jz

    yaw_of_pitch = coupled if CROSS_MOMENTS in terms else planar

    def turn(air: Flow, K: Any) -> Loads:
        lever = air.airspeed * air.airspeed * K.cg_moment
        side = K.cY_beta * air.beta + K.cY_dr * air.rudder
        yaw = lever * yaw_of_pitch(K) * side
        return 0.0, 0.0, 0.0, roll_of_yaw(K) * yaw, lever * lift_coefficient(air, K), yaw

    return turn


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
        loads_of=cg_shift,
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
