"""The effects that suit a flight of which only the poses are known: forces, by their formulas."""

import pytest

from falconwing_kit.aircraft.model import add_uniform_wind, paper_model, rates_model
from falconwing_kit.tools.demo.alfa import applicable_effects


@pytest.mark.parametrize("model", [add_uniform_wind(paper_model(), 1.0, 0.0), paper_model()])
def test_only_forces_suit_quasi_steady_rates(model):
    """By their formulas: torque, adverse yaw, a lost aileron and a moved centre of gravity are
    angular accelerations; delay, lag, neutral, dead band and camera are no forces; wind and jet are
    no terms.
    """
    names = [effect.name for effect in applicable_effects(model)]
    assert names == [
        "ground_effect",
        "extra_drag",
        "flap",
        "thrust_loss",
        "battery_sag",
        "mass_change",
        "stall",
    ]


def test_rates_form_keeps_its_forces_only_too():
    """The rule depends on the formula, not the form: the same forces in the 12-state form."""
    assert applicable_effects(rates_model())[1].name == "extra_drag"
