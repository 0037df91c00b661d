"""Aileron loss: part of the rolling moment of aileron is lost."""

from functools import cache
from typing import Any

from falconwing_kit.aircraft.effect import Effect, LoadsFunction, draw_size
from falconwing_kit.aircraft.terms import CROSS_MOMENTS, Flow, Loads, Parameter, Term


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def aileron_loss(terms: tuple[Term, ...]) -> LoadsFunction:
    """L_da -> L_da (1 - aileron_lost), and N_da likewise where the model has cross moments."""

    def roll_alone(air: Flow, K: Any) -> Loads:
        lost = air.airspeed * air.airspeed * K.aileron_lost * K.L_da * air.aileron
        return 0.0, 0.0, 0.0, -lost, 0.0, 0.0

    def roll_and_yaw(air: Flow, K: Any) -> Loads:
        lost = air.airspeed * air.airspeed * K.aileron_lost * air.aileron
        return 0.0, 0.0, 0.0, -lost * K.L_da, 0.0, -lost * K.N_da

    return roll_and_yaw if CROSS_MOMENTS in terms else roll_alone


EFFECTS = (
    Effect(
        name="aileron_loss",
        physics="An aileron deflects less, or one of the two not at all.",
        parameters=(
            Parameter("aileron_lost", 0.05, 0.0, 1.0, "-", "share of the rolling moment lost"),
        ),
        equation="dp/dt -> dp/dt - {aileron_lost} L_da V^2 aileron",
        loads_of=aileron_loss,
        acts_on=("roll",),
        same_form=("roll moment with aileron", "gain of the aileron"),
        sizes=(0.18, 0.22, 0.35),
        draw=draw_size("aileron_lost"),
        frozen_number=13,
    ),
)
