"""Flights whose gap is known, studied once for all tests of this room: shipped ones and own
aircraft.
"""

from functools import cache

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.data import data_path
from falconwing_kit.gap.baseline import NominalModel, identify_baseline
from falconwing_kit.gap.study import GapStudy, study_gap
from tests.sysid.simulated import drawn, fly_figure_eights, measured

EFFECTS = {effect.name: effect for effect in (*CATALOGUE, *GENERIC_EFFECTS)}
EFFECTS["deadband"] = next(e for e in CATALOGUE if e.name == "deadband")  # the first of its forms


@cache
def shipped(name: str) -> FlightTable:
    """A flight that ships with the kit, by JSBSim: case02_calm, case08_calm or case08_flight."""
    return read_flight_table(data_path(f"{name}.csv"))


@cache
def wind_study() -> GapStudy:
    """The shipped case with a wind of 0.0924 m/s along x, 0.4370 m/s along y (its truth.json)."""
    return study_gap(shipped("case08_calm"), shipped("case08_flight"))


@cache
def own_aircraft() -> Model:
    """A model drawn 15 % off the kit's starting values."""
    return drawn(rates_model(), np.random.default_rng(5))


@cache
def own_base() -> NominalModel:
    """What 90 s of calm flight tell of it."""
    return identify_baseline(own_flight(None, 90.0, 11))


@cache
def own_flight(effect: str | None, seconds: float, seed: int, **values: float) -> FlightTable:
    """A flight of that aircraft with marker noise, with or without an effect."""
    rng = np.random.default_rng(seed)
    model = own_aircraft()
    if effect is not None:
        model = model.with_effect(EFFECTS[effect]).with_values(values)
    return measured(fly_figure_eights([model], seconds, rng), rng)
