"""Propeller torque: rolling and yawing moment in proportion to thrust."""

from typing import Any

from falconwing_kit.aircraft.effect import Effect, draw_direction
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter


def propeller_torque(air: Flow, K: Any) -> Loads:
    """dp/dt = torque_roll T/m, dr/dt = torque_yaw T/m [Phillips, Mechanics of Flight, ch. 2]."""
    thrust = (K.kT - K.kTV * air.airspeed) * air.throttle
    return 0.0, 0.0, 0.0, K.torque_roll * thrust, 0.0, K.torque_yaw * thrust


EFFECTS = (
    Effect(
        name="propeller_torque",
        physics="The propeller turns the aircraft against its rotation, in proportion to thrust.",
        parameters=(
            Parameter("torque_roll", 0.05, -5.0, 5.0, "1/m", "rolling moment per thrust"),
            Parameter("torque_yaw", 0.05, -5.0, 5.0, "1/m", "yawing moment per thrust"),
        ),
        equation="dp/dt -> dp/dt + {torque_roll} T/m, dr/dt -> dr/dt + {torque_yaw} T/m",
        loads=propeller_torque,
        acts_on=("roll", "yaw"),
        same_form=("roll moment with throttle", "yaw moment with throttle"),
        separated_by={"throttle steps": "only thrust rolls and yaws the aircraft then"},
        sizes=(0.15, 0.5, 1.0),
        draw=draw_direction("torque_roll", "torque_yaw"),
        frozen_number=7,
    ),
)
