"""Naming: what was planted is named, what was not is not, and what cannot be named is not given another name."""

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.flight_table import slice_time
from falconwing_kit.gap.name import know_calm, name_effect, named_model
from tests.gap.studies import own_base, own_flight, shipped, wind_study


def test_wind_of_an_independent_aircraft_is_named_with_its_size():
    """JSBSim flew this case in a wind of 0.0924 and 0.4370 m/s; 0.05 m/s is the goal of the kit."""
    naming = wind_study().naming
    assert naming.verdict == "named"
    assert [c.effect.name for c in naming.chosen] == ["wind"]
    assert naming.chosen[0].values["wind_x"] == pytest.approx(0.0924, abs=0.05)
    assert naming.chosen[0].values["wind_y"] == pytest.approx(0.4370, abs=0.05)
    assert naming.ranking[0].gain > 10.0 * naming.threshold
    assert named_model(naming) is not None


def test_second_half_of_a_calm_flight_shows_nothing():
    """One flight of one aircraft with nothing changed, cut in two at a minute: there is nothing to name."""
    calm = shipped("case02_calm")
    half = calm.t[0] + 0.5 * calm.duration
    naming = name_effect(know_calm(slice_time(calm, -np.inf, half)), slice_time(calm, half, np.inf))
    assert naming.verdict == "none"
    assert naming.chosen == ()
    assert named_model(naming) is None


@pytest.mark.parametrize(
    ("effect", "values"),
    [("adverse_yaw", {"adverse_yaw": 0.08}), ("propeller_torque", {"torque_roll": 0.6, "torque_yaw": -0.4})],
)
def test_planted_effect_is_named_with_its_size(effect, values):
    """Own aircraft, 45 s, an effect well above its limit: named, with its size within 20 %."""
    naming = name_effect(own_base(), own_flight(effect, 45.0, 41, **values))
    assert [c.effect.name for c in naming.chosen] == [effect]
    for name, value in values.items():
        assert naming.chosen[0].values[name] == pytest.approx(value, rel=0.2)


def test_withheld_effect_gets_no_other_name():
    """Adverse yaw without its entry in the catalogue stays unnamed."""
    catalogue = [e for e in CATALOGUE if e.name != "adverse_yaw"]
    naming = name_effect(own_base(), own_flight("adverse_yaw", 45.0, 41, adverse_yaw=0.08), catalogue)
    assert naming.verdict in ("none", "outside")
