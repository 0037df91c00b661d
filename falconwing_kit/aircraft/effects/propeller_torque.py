"""Propeller torque: rolling and yawing moment in proportion to thrust."""

from functools import cache
from typing import Any

from falconwing_kit.aircraft.effect import Effect, LoadsFunction, draw_direction
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, Term, propeller_loads


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def propeller_torque(terms: tuple[Term, ...]) -> LoadsFunction:
    """dp/dt = torque_roll T/m, dr/dt = torque_yaw T/m [Phillips, Mechanics of Flight, ch. 2]."""
    loads = propeller_loads(terms)

    def torque(air: Flow, K: Any) -> Loads:
        T = loads(air, K)[0]
        return 0.0, 0.0, 0.0, K.torque_roll * T, 0.0, K.torque_yaw * T

    return torque


EFFECTS = (
    Effect(
        name="propeller_torque",
        physics="The propeller turns the aircraft against its rotation, in proportion to thrust.",
        parameters=(
            Parameter("torque_roll", 0.05, -50.0, 50.0, "1/m", "rolling moment per thrust"),
            Parameter("torque_yaw", 0.05, -50.0, 50.0, "1/m", "yawing moment per thrust"),
        ),
        equation="dp/dt -> dp/dt + {torque_roll} T/m, dr/dt -> dr/dt + {torque_yaw} T/m",
        loads_of=propeller_torque,
        of_propeller=True,
        acts_on=("roll", "yaw"),
        same_form=("roll moment with throttle", "yaw moment with throttle"),
        separated_by={"throttle steps": "only thrust rolls and yaws the aircraft then"},
        sizes=(0.15, 0.5, 1.0),
        draw=draw_direction("torque_roll", "torque_yaw"),
        frozen_number=7,
    ),
)
