"""Thrust loss and battery sag: a share of the thrust is missing, constant or growing with time."""

from functools import cache
from typing import Any

from falconwing_kit.aircraft.effect import Effect, LoadsFunction, draw_size
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, Term, propeller_share


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def thrust_loss(terms: tuple[Term, ...]) -> LoadsFunction:
    """Thrust times (1 - thrust_lost), and so all that the propeller gives among these terms."""
    share_of = propeller_share(terms)

    def lost(air: Flow, K: Any) -> Loads:
        return share_of(-K.thrust_lost, air, K)

    return lost


@cache
def battery_sag(terms: tuple[Term, ...]) -> LoadsFunction:
    """Thrust times (1 - sag t / 60 s), and so all that the propeller gives among these terms.

    t is the time since the start of the flight.
    """
    share_of = propeller_share(terms)

    def lost(air: Flow, K: Any) -> Loads:
        return share_of(-K.sag * air.time / 60.0, air, K)

    return lost


EFFECTS = (
    Effect(
        name="thrust_loss",
        physics="The propeller gives less thrust at the same throttle.",
        parameters=(Parameter("thrust_lost", 0.05, 0.0, 1.5, "-", "share of the thrust lost"),),
        equation="T -> T (1 - {thrust_lost})",
        loads_of=thrust_loss,
        acts_on=("thrust", "along"),
        same_form=("thrust with throttle", "gain of the throttle"),
        separated_by={"glides": "a weak propeller does not slow a glide"},
        sizes=(0.2, 0.3, 0.45),
        draw=draw_size("thrust_lost"),
        frozen_number=5,
    ),
    Effect(
        name="battery_sag",
        physics="The battery's voltage falls during the flight, and thrust with it.",
        parameters=(
            Parameter("sag", 0.05, 0.0, 1.0, "1/min", "share of the thrust lost per minute"),
        ),
        equation="T -> T (1 - {sag} t)",
        loads_of=battery_sag,
        gradual=True,
        acts_on=("thrust", "along"),
        same_form=("thrust with throttle and time",),
        separated_by={
            "glides": "an empty battery does not slow a glide",
            "early and late": "only a battery loses thrust with time",
        },
        sizes=(0.15, 0.25, 0.4),
        draw=draw_size("sag"),
        frozen_number=6,
    ),
)
