"""The real flight's gap: what failed is among the answers, dated, and nothing is claimed that the
poses do not tell.
"""

from functools import cache

import numpy as np
import pytest

from falconwing_kit.aircraft.model import add_uniform_wind, paper_model, rates_model
from falconwing_kit.tools.demo.alfa import AlfaGap, applicable_effects
from tests.demo_run import demo_run

ENGINE_OFF = 116.166  # s: the log's first "engine off" message, data/README.md


@cache
def gap() -> AlfaGap:
    """The shared demo's answer."""
    return demo_run().found.alfa_gap


def test_failure_shows_without_the_throttle():
    """Recorded data: the engine is off, and the loss of thrust has far more evidence than chance
    finds before it.
    """
    assert gap().verdict != "none"
    assert gap().thrust_loss.delta_bic > 3.0 * gap().threshold
    assert "thrust_loss" in [s.effect.name for s in gap().chosen]


def test_failure_is_dated_within_two_seconds():
    """The log's engine-off message, which the fit has not read, is the truth; two seconds are the
    goal of the kit.
    """
    loss = gap().thrust_loss
    assert loss.time == pytest.approx(ENGINE_OFF, abs=2.0)
    assert loss.earliest < ENGINE_OFF < loss.latest


def test_all_of_the_thrust_is_gone():
    """The engine is off, so the share lost is one; half of it gone would not do."""
    loss = gap().thrust_loss
    assert loss.low95 < 1.0 < loss.high95
    assert loss.value == pytest.approx(1.0, abs=0.3)


def test_what_the_poses_do_not_tell_is_not_told():
    """Drag and thrust slow the aircraft alike at one throttle: while both are within 10 of each
    other none is named.
    """
    gains = {s.effect.name: s.delta_bic for s in gap().hypotheses}
    rivals = [name for name, delta_bic in gains.items() if delta_bic > max(gains.values()) - 10.0]
    assert (gap().verdict == "named") == (len(rivals) == 1)
    assert [s.effect.name for s in gap().chosen] == rivals


def test_logged_throttle_explains_as_much_as_any_effect_with_nothing_fitted():
    """The throttle's servo closes with the engine; each effect had a size and a time to choose, the
    log had none.
    """
    best = gap().hypotheses[0].delta_bic
    assert gap().logged_throttle_gain == pytest.approx(best, abs=0.25 * best)
    assert gap().after < gap().before


def test_stretch_ends_where_a_stick_leaves_its_healthy_range():
    """Worked out here from the table: elevator above its largest value before the failure, 0.185,
    at 125.55 s.
    """
    table = demo_run().found.alfa.table
    healthy = table.t < ENGINE_OFF
    high = table.commands[healthy, 2].max()
    assert gap().end == table.t[~healthy & (table.commands[:, 2] > high)][0]
    assert np.all(table.commands[(table.t < gap().end), 2] <= high)


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
