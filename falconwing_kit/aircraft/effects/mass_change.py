"""Mass change: every force accelerates the aircraft less, gravity as before."""

from functools import cache
from typing import Any

from falconwing_kit.aircraft.effect import Effect, LoadsFunction, draw_size
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, Term, sum_loads


@cache  # one function per tuple of terms: a model with it is compiled and looked up once
def mass_change(terms: tuple[Term, ...]) -> LoadsFunction:
    """-mu / (1 + mu) times the sum of the forces of these terms, mu = mass_added [Newton]."""
    total = sum_loads([term.evaluate for term in terms])

    def change(air: Flow, K: Any) -> Loads:
        less, forces = -K.mass_added / (1.0 + K.mass_added), total(air, K)
        return less * forces[0], less * forces[1], less * forces[2], 0.0, 0.0, 0.0

    return change


EFFECTS = (
    Effect(
        name="mass_change",
        physics="The aircraft is heavier: every force accelerates it less, gravity as before.",
        parameters=(Parameter("mass_added", 0.03, -0.4, 1.0, "-", "share of the mass added"),),
        equation="F/m -> F/m / (1 + {mass_added}), F all forces but the weight",
        loads_of=mass_change,
        acts_on=("lift", "along", "side"),
        separated_by={"steep turns": "a heavier aircraft turns less at the same bank and lift"},
        sizes=(0.12, 0.2, 0.35),
        draw=draw_size("mass_added"),
        frozen_number=14,
    ),
)
