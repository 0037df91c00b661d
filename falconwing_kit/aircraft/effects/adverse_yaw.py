"""Adverse yaw: aileron yaws the nose out of the turn."""

from functools import cache
from typing import Any

from falconwing_kit.aircraft.effect import Effect, LoadsFunction, draw_size
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, Term, roll_of_yawing_moment


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def adverse_yaw(terms: tuple[Term, ...]) -> LoadsFunction:
    """dr/dt = -V^2 adverse_yaw aileron [Etkin & Reid, Dynamics of Flight, ch. 3].

    With a product of inertia the same moment also rolls the aircraft.
    """
    roll_of_yaw = roll_of_yawing_moment(terms)

    def yaw_of_aileron(air: Flow, K: Any) -> Loads:
        yaw = -air.airspeed * air.airspeed * K.adverse_yaw * air.aileron
        return 0.0, 0.0, 0.0, roll_of_yaw(K) * yaw, 0.0, yaw

    return yaw_of_aileron


EFFECTS = (
    Effect(
        name="adverse_yaw",
        physics="The wing with more lift has more drag: aileron yaws the nose out of the turn.",
        parameters=(
            Parameter(
                "adverse_yaw",
                0.02,
                -2.0,
                2.0,
                "1/m^2",
                "yawing moment of aileron, against the turn",
            ),
        ),
        equation="dr/dt -> dr/dt - {adverse_yaw} V^2 aileron",
        loads_of=adverse_yaw,
        acts_on=("yaw",),
        same_form=("yaw moment with aileron",),
        separated_by={"aileron doublets": "aileron alone yaws the nose"},
        sizes=(0.02, 0.1, 0.2),
        draw=draw_size("adverse_yaw"),
        frozen_number=8,
    ),
)
