"""Generic effects: a force or moment in proportion to one flight variable, or a command filter.

They are first-order forms of effects outside the catalogue. Where one of them explains a flight
better than every named effect, no name is given.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, LoadsFunction
from falconwing_kit.aircraft.terms import ATTITUDE_HOLD, Parameter, Term, propeller_loads
from falconwing_kit.core.checks import Array

HEIGHT_SCALE_M = 0.5  # decay with height, about the span of a 150 g aircraft

# Flight variable -> regressor, of order one for a 150 g aircraft at 7 m/s; aerodynamic loads are
# proportional to V^2.
REGRESSORS: dict[str, Callable[[Any], Any]] = {
    "airspeed": lambda air: _dynamic_pressure(air),
    "angle of attack": lambda air: _dynamic_pressure(air) * 5.0 * air.alpha,
    "angle of attack squared": lambda air: _dynamic_pressure(air) * 25.0 * air.alpha * air.alpha,
    "sideslip": lambda air: _dynamic_pressure(air) * 10.0 * air.beta,
    "sideslip squared": lambda air: _dynamic_pressure(air) * 100.0 * air.beta * air.beta,
    "roll rate": lambda air: air.airspeed / 7.0 * air.p,
    "pitch rate": lambda air: air.airspeed / 7.0 * air.q,
    "yaw rate": lambda air: air.airspeed / 7.0 * air.r,
    "aileron": lambda air: _dynamic_pressure(air) * 3.0 * air.aileron,
    "elevator": lambda air: _dynamic_pressure(air) * 3.0 * air.elevator,
    "rudder": lambda air: _dynamic_pressure(air) * 3.0 * air.rudder,
    "throttle": lambda air: air.throttle,
    "throttle and airspeed": lambda air: air.throttle * air.airspeed / 7.0,
    "throttle and aileron": lambda air: 3.0 * air.throttle * air.aileron,
    "throttle and elevator": lambda air: 3.0 * air.throttle * air.elevator,
    "height": lambda air: (
        _dynamic_pressure(air) * np.exp(-np.maximum(air.height, 0.0) / HEIGHT_SCALE_M)
    ),
    "time": lambda air: _dynamic_pressure(air) * air.time / 60.0,
    "throttle and time": lambda air: air.throttle * air.time / 60.0,
    "place along x": lambda air: _dynamic_pressure(air) * 0.1 * air.px,
    "place along y": lambda air: _dynamic_pressure(air) * 0.1 * air.py,
}


def _dynamic_pressure(air: Any) -> Any:
    return air.airspeed * air.airspeed / 49.0


def _generic_load(variable: str, rotational: bool) -> Effect:
    """A force (or moment) with a component along each body axis, in proportion to a variable."""
    value, kind, unit = (
        REGRESSORS[variable],
        *(("moment", "rad/s^2") if rotational else ("force", "m/s^2")),
    )
    names = tuple(f"{kind}_{variable.replace(' ', '_')}_{axis}" for axis in "xyz")
    parameters = tuple(
        Parameter(
            name, 0.2, -100.0, 100.0, unit, f"{kind} about or along body {name[-1]} with {variable}"
        )
        for name in names
    )

    def evaluate(air: Any, K: Any) -> tuple[Any, ...]:
        size = value(air)
        loads = tuple(getattr(K, name) * size for name in names)
        return (0.0, 0.0, 0.0, *loads) if rotational else (*loads, 0.0, 0.0, 0.0)

    name = f"{kind} with {variable}"
    return Effect(
        name, f"A {name} that the model lacks.", parameters, loads=evaluate,
        of_propeller="throttle" in variable,
    )  # fmt: skip


_MOMENT_WITH_THRUST = tuple(
    Parameter(
        f"moment_thrust_{axis}", 0.02, -100.0, 100.0, "1/m", f"thrust turns about body {axis}"
    )
    for axis in "xyz"
)


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def _moment_with_thrust(terms: tuple[Term, ...]) -> LoadsFunction:
    """Moments in proportion to the model's own thrust: torque, thrust line, wash of a propeller."""
    propeller = propeller_loads(terms)

    def evaluate(air: Any, K: Any) -> tuple[Any, ...]:
        T = propeller(air, K)[0]
        return 0.0, 0.0, 0.0, K.moment_thrust_x * T, K.moment_thrust_y * T, K.moment_thrust_z * T

    return evaluate


def fir_input_filter(t: Array, commands: Array, K: Any) -> Array:
    """u[n] + a_1 (u[n-1] - u[n]) + a_2 (u[n-2] - u[n]): shares a_1, a_2 act one and two rows later.

    Approximates any delay or lag of the commands (N, 4); a_1 and a_2 are stick_memory_1 and _2.
    """
    once, twice = (np.concatenate([commands[:k], commands[:-k]]) - commands for k in (1, 2))
    return commands + K.stick_memory_1 * once + K.stick_memory_2 * twice


INPUT_FILTER = Effect(
    "memory of the sticks", "The commands act later or more slowly than in the model.",
    tuple(
        Parameter(f"stick_memory_{k}", 0.1, -2.0, 2.0, "-", f"share acting {k} frames later")
        for k in (1, 2)
    ),
    command_map=fir_input_filter,
)  # fmt: skip
GENERIC_LOADS: tuple[Effect, ...] = tuple(
    _generic_load(variable, rotational) for variable in REGRESSORS for rotational in (False, True)
)
MOMENT_WITH_THRUST = Effect(
    "moment with thrust", "A moment with thrust that the model lacks.", _MOMENT_WITH_THRUST,
    loads_of=_moment_with_thrust, of_propeller=True,
)  # fmt: skip
STABILISER = Effect(
    "attitude hold", "A stabiliser on board moves the control surfaces against bank and pitch.",
    ATTITUDE_HOLD.parameters, loads=ATTITUDE_HOLD.evaluate,
)  # fmt: skip
GENERIC_EFFECTS: tuple[Effect, ...] = (
    *GENERIC_LOADS, MOMENT_WITH_THRUST, STABILISER, INPUT_FILTER,
)  # fmt: skip
