"""Aileron loss: part of the rolling moment of aileron is lost."""

from typing import Any

from falconwing_kit.aircraft.effect import Effect, draw_size
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter


def aileron_loss(air: Flow, K: Any) -> Loads:
    """L_da -> L_da (1 - aileron_lost)."""
    lost = air.airspeed * air.airspeed * K.aileron_lost * K.L_da * air.aileron
    return 0.0, 0.0, 0.0, -lost, 0.0, 0.0


EFFECTS = (
    Effect(
        name="aileron_loss",
        physics="An aileron deflects less, or one of the two not at all.",
        parameters=(
            Parameter("aileron_lost", 0.05, 0.0, 1.0, "-", "share of the rolling moment lost"),
        ),
        equation="dp/dt -> dp/dt - {aileron_lost} L_da V^2 aileron",
        loads=aileron_loss,
        acts_on=("roll",),
        same_form=("roll moment with aileron", "gain of the aileron"),
        sizes=(0.18, 0.22, 0.35),
        draw=draw_size("aileron_lost"),
        frozen_number=13,
    ),
)
