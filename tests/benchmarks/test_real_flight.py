"""The gap workflow on a measured flight: the Sport Cub's recording, and wind hidden in it exactly.

The aircraft is not the kit's: 65 g, stabilised on board, its sticks read eight times a second, its
poses from motion capture. Nothing here is simulated. Takes four minutes of one core:

    python -m pytest -m benchmark tests/benchmarks/test_real_flight.py
"""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import rates_model, scale_model
from falconwing_kit.core.flight_table import slice_time
from falconwing_kit.data import data_path, load_flight
from falconwing_kit.gap.baseline import NominalModel, identify_baseline
from falconwing_kit.gap.name import name_effect

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1200)]
WIND = np.array([0.3, -0.4, 0.0])  # hidden [m/s]


@pytest.fixture(scope="module")
def base() -> NominalModel:
    """Identified from the second minute of the flight."""
    airframe = load_airframe(data_path("sport_cub_airframe.toml"))
    start = scale_model(rates_model(), airframe.mass, airframe.wing_area, airframe.span)
    return identify_baseline(slice_time(load_flight("sport_cub"), 65.0, 125.0), start=start)


def test_a_stabiliser_and_the_delay_of_its_sticks_are_found(base):
    """The file's name says stabilised. The peaks of roll rate stand 0.1 to 0.25 s behind full
    aileron, read off the recording, of which the airframe's own lag is a part.
    """
    values = base.result.model.values
    assert values["L_phi"] < -0.3
    assert 0.08 < values["delay"] + values["lag"] < 0.25


def test_nothing_hidden_nothing_named(base):
    """The third minute as it was recorded."""
    naming = name_effect(base, slice_time(load_flight("sport_cub"), 125.0, 195.0))
    assert naming.verdict == "none" and naming.chosen == ()


def test_a_hidden_wind_is_named(base):
    """Galilei: in air that moves over the floor the same sticks fly the path p + w t."""
    table = slice_time(load_flight("sport_cub"), 125.0, 195.0)
    moved = table.p_world + (table.t - table.t[0])[:, None] * WIND
    naming = name_effect(base, replace(table, p_world=moved))
    assert naming.verdict == "named"
    assert [found.effect.name for found in naming.chosen] == ["wind"]
    found = naming.chosen[0].values
    assert np.hypot(found["wind_x"] - WIND[0], found["wind_y"] - WIND[1]) < 0.15
