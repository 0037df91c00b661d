"""Successive loop closure: an aircraft model -> nested proportional and integral loops, the
textbook's autopilot beside the LQR of loops.py.

    aileron   <- roll <- course <- place beside the path
    elevator  <- pitch <- height
    throttle  <- airspeed

Each inner loop is closed first, and the next one around it with a lower bandwidth, so that it may
treat the inner one as settled [Beard & McLain, Small Unmanned Aircraft, ch. 6: successive loop
closure; sec. 10.1: straight-line following]. Deviations are from a steady flight, whose control
inputs are fed forward, as in loops.py. Nothing here compensates the delay: the bandwidths leave
room for it.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.control.inverse import design_model
from falconwing_kit.control.loops import (
    LINK_DELAY_S,
    SPEED,
    Reference,
    ReferenceTracker,
    TrimTable,
    model_key,
)
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, State

# Natural frequency and damping of each loop at 7 m/s and 0.10 s of delay in all [rad/s, -].
ROLL = 8.0, 1.0
PITCH_GAIN = 0.8  # stiffness that the elevator adds, in shares of the aircraft's own
COURSE_BANDWIDTH = 2.0  # [rad/s]
PATH_BANDWIDTH = 0.9  # [rad/s] at which an offset beside the path is steered out
HEIGHT_BANDWIDTH = 1.8  # [rad/s]
HEIGHT_INTEGRAL = 0.5  # [rad/s] at which a lasting error of the height is removed
SPEED_BANDWIDTH = 1.5  # [rad/s]
MAX_ROLL = math.radians(30.0)  # that the course loop may command
MAX_INTERCEPT = math.radians(40.0)  # course towards the path
MAX_PITCH_CHANGE = math.radians(12.0)  # that the height loop may command
INTEGRAL_LIMIT = 0.3  # of the height error [m s]


@dataclass(frozen=True)
class SuccessiveGains:
    """Gains of the loops, from inside to outside."""

    roll: float  # aileron per roll error [1/rad]
    roll_rate: float  # aileron per roll rate [s/rad]
    course: float  # roll per course error [-]
    path: float  # course per place beside the path [rad/m]
    pitch: float  # elevator per pitch error [1/rad]
    height: float  # pitch per height error [rad/m]
    height_integral: float  # pitch per integral of it [rad/(m s)]
    speed: float  # throttle per airspeed error [s/m]


def successive_gains(model: Model, speed: float = SPEED) -> SuccessiveGains:
    """Gains by pole placement, one loop after the other [Beard & McLain, sec. 6.3-6.4].

        roll      p' = -a1 p + a2 aileron,  a1 = -V L_p,  a2 = V^2 L_da
                  k = w^2 / a2,  k_rate = (2 zeta w - a1) / a2, not below zero
        course    course' = (g / V) roll:  k = w V / g
        path      offset' = V sin(course):  k = w / V
        pitch     q' = -a1 q - a2 alpha + a3 elevator,  a2 = -V^2 M_alpha,  a3 = V^2 M_de
                  k = gain a2 / a3: the elevator adds that share of the stiffness
        height    h' = V pitch:  k = w / V
        airspeed  V' = b throttle,  b = kT - kTV V:  k = w / b

    Args:
        model: 12-state, without effects on commands and poses.
        speed: V [m/s].

    Raises:
        InputError: the model has no body rates, or a control surface has no effect.
    """
    if model.form != "rates":
        raise InputError(
            "model: expected the 12-state model (rates_model), got the 9-state model, which has no"
            " body rates"
        )
    K: Any = model.K
    thrust = K.kT - K.kTV * speed
    effects = {"L_da": K.L_da, "M_de": K.M_de, "thrust at this speed": thrust}
    for name, effect in effects.items():
        if not effect > 0.0:
            raise InputError(
                f"model: expected {name} above zero for these loops, got {effect:g}; use the pilot"
                " expert, or check the model's values"
            )
    frequency, damping = ROLL
    a1, a2 = -speed * K.L_p, speed**2 * K.L_da
    stiffness, elevator = max(-(speed**2) * K.M_alpha, 1.0), speed**2 * K.M_de
    return SuccessiveGains(
        roll=frequency**2 / a2,
        roll_rate=max((2.0 * damping * frequency - a1) / a2, 0.0),
        course=COURSE_BANDWIDTH * speed / GRAVITY,
        path=PATH_BANDWIDTH / speed,
        pitch=PITCH_GAIN * stiffness / elevator,
        height=HEIGHT_BANDWIDTH / speed,
        height_integral=HEIGHT_BANDWIDTH * HEIGHT_INTEGRAL / speed,
        speed=SPEED_BANDWIDTH / thrust,
    )


@lru_cache(maxsize=32)
def _design(
    form: Any, terms: Any, winds: Any, parameters: Any, values: Any, speed: float
) -> tuple[TrimTable, SuccessiveGains]:
    """Trims and gains of a model given by its `model_key`; cached, for every trial has one."""
    model = Model(form, terms, winds, parameters, dict(values))
    gains = successive_gains(model, speed)
    return TrimTable(model, speed), gains


class SuccessiveAutopilot(ReferenceTracker):
    """Tracks a reference as `loops.Autopilot` does, by successive loop closure."""

    def __init__(self, model: Model, speed: float = SPEED, delay: float = LINK_DELAY_S) -> None:
        """Design the loops; InputError where the model cannot be trimmed or controlled.

        The delay changes nothing here; it is an argument as of `loops.Autopilot`.
        """
        trims, self.gains = _design(*model_key(design_model(model)), speed)
        super().__init__(model, speed, trims)
        self._height_integral = 0.0  # [m s]

    def command(
        self,
        state: State,
        reference: Reference,
        past_commands: Array,
        idle: bool = False,
        t: float = 0.0,
    ) -> Command:
        """The command that returns the aircraft to the reference; arguments as `loops.Autopilot`.

        Past commands are not used: these loops have no model of the delay.
        """
        gains = self.gains
        steady, error, speed = self.deviations(state, reference, idle, t)
        # Beside the path: y left, so an offset to the left asks for a course to the right.
        intercept = _limit(gains.path * error["py"], MAX_INTERCEPT)
        course_error = intercept + error["vy"] / speed  # the course is to the left by vy / V
        roll_error = _limit(gains.course * course_error, MAX_ROLL) - error["roll"]
        self._height_integral = _limit(
            self._height_integral + CONTROL_PERIOD_S * error["pz"], INTEGRAL_LIMIT
        )
        pitch_change = -gains.height * error["pz"] - gains.height_integral * self._height_integral
        pitch_error = _limit(pitch_change, MAX_PITCH_CHANGE) - error["pitch"]
        throttle, aileron, elevator, rudder = steady
        positions = np.array(
            [
                throttle - gains.speed * error["vx"],
                aileron + gains.roll * roll_error - gains.roll_rate * error["p"],
                elevator + gains.pitch * pitch_error,
                rudder,
            ]
        )
        return self.to_command(positions, idle)


def _limit(value: float, largest: float) -> float:
    """The value within +-largest."""
    return min(max(value, -largest), largest)
