"""Discrepancy: terms that no catalogue names are found with their numbers, written and read."""

from functools import cache

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.sparse import SPARSE_EFFECTS
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap import discrepancy as discrepancy_module
from falconwing_kit.gap.close import GapClosure, close_gap
from falconwing_kit.gap.discrepancy import Discrepancy, discrepancy_record, find_discrepancy
from falconwing_kit.gap.name import EffectCandidate, Naming, fit_flight
from falconwing_kit.sysid.model_file import read_model, write_fitted_model
from falconwing_kit.sysid.prepare import prepare
from tests.gap.studies import own_aircraft, own_base, own_flight
from tests.sysid.simulated import fly_figure_eights, measured

SPARSE = {effect.name: effect for effect in SPARSE_EFFECTS}
# A thrust line beside the centre of gravity, and a rudder above the roll axis.
PLANTED = {"pitch_moment_throttle": 4.0, "roll_moment_rudder": -0.06}


def outside(flight: FlightTable) -> tuple[Naming, GapClosure]:
    """A flight that got no name: the nominal model fitted to it, and its gap as it is."""
    prepared = prepare(flight, own_base().found.sigma)
    windows, before = fit_flight(own_base(), prepared)
    nothing = EffectCandidate(GENERIC_EFFECTS[0], 0.0, 0.0, {}, None)
    naming = Naming("outside", (), (), 10.0, 0.0, 0.0, nothing, 0.0, before, windows, prepared)
    return naming, close_gap(own_base(), naming)


def flight_with_both() -> FlightTable:
    """A minute of the own aircraft with both terms planted."""
    rng, model = np.random.default_rng(61), own_aircraft()
    for name in ("pitch moment with throttle", "roll moment with rudder"):
        model = model.with_effect(SPARSE[name])
    return measured(fly_figure_eights([model.with_values(PLANTED)], 60.0, rng), rng)


@cache
def found() -> tuple[Discrepancy, GapClosure]:
    """What is found in that minute."""
    naming, closed = outside(flight_with_both())
    discrepancy = find_discrepancy(own_base(), naming, closed)
    assert discrepancy is not None
    return discrepancy, closed


@pytest.mark.timeout(120)
def test_a_term_that_is_always_removed_again_ends_the_search(monkeypatch):
    """Evidence for a second term, but not enough to keep it: the first alone is the answer."""
    first = []

    def keep_the_first(base, windows, nominal, chosen, result):
        if len(chosen) == 1:
            first[:] = [(chosen, result)]
        return first[0]

    monkeypatch.setattr(discrepancy_module, "_prune", keep_the_first)
    found_with_one = find_discrepancy(own_base(), *outside(flight_with_both()))
    assert found_with_one is not None and len(found_with_one.terms) == 1


def test_planted_terms_are_found_with_their_numbers():
    """Own aircraft, 60 s: both terms and no other, each within its 95 % interval, doubled."""
    discrepancy, _ = found()
    parameters = {n: p for term in discrepancy.terms for n, p in term.parameters.items()}
    assert set(parameters) == set(PLANTED)
    for name, value in PLANTED.items():
        p = parameters[name]
        assert p.value == pytest.approx(value, abs=p.high95 - p.low95)
        assert p.high95 - p.low95 < 0.5 * abs(value)
    assert "dq/dt = ... + k throttle, k = " in discrepancy.equation
    assert "dp/dt = ... + k V^2 rudder, k = -0.0" in discrepancy.equation
    assert "thrust line" in discrepancy.resembles and "C_l_dr" in discrepancy.resembles


def test_the_gap_closes_on_held_out_time():
    """Nine tenths of the excess over the baseline's level, on time that selected no term; the share
    is that of its definition.
    """
    discrepancy, closed = found()
    over = closed.before.chi2 - closed.calm.chi2
    assert over > 0.5
    assert discrepancy.gap_closed > 0.9
    assert discrepancy.gap_closed == pytest.approx(
        (closed.before.chi2 - discrepancy.after.chi2) / over
    )
    assert discrepancy.after.windows == closed.before.windows


def test_model_file_keeps_the_terms(tmp_path):
    """Written and read: the same form, terms, effects, values and covariance."""
    discrepancy, _ = found()
    path = tmp_path / "improved.toml"
    write_fitted_model(
        path, discrepancy.model, discrepancy.confidence, flights=("flight.csv",), train_chi2=1.0,
        held_out_chi2=discrepancy.after.chi2, sigma=own_base().found.sigma,
    )  # fmt: skip
    read = read_model(path, catalogue=(*CATALOGUE, *GENERIC_EFFECTS, *SPARSE_EFFECTS))
    assert read.model.names == discrepancy.model.names
    assert read.model.effects == discrepancy.model.effects
    assert read.model.vector == pytest.approx(discrepancy.model.vector, rel=1e-9)
    assert read.covariance == pytest.approx(discrepancy.confidence.covariance, rel=1e-4)


def test_record_has_the_keys_of_the_report():
    """As report.json's key "discrepancy" is fixed; each number in its own interval."""
    record = discrepancy_record(found()[0])
    assert set(record) == {"equation", "where", "terms", "resembles", "gap_closed"}
    assert {t["name"]: t["unit"] for t in record["terms"]} == {
        "pitch_moment_throttle": "1/s^2",
        "roll_moment_rudder": "1/m^2",
    }
    assert all(t["low95"] < t["value"] < t["high95"] for t in record["terms"])
    assert record["where"] == "throughout the flight" or record["where"].startswith("most at ")


def test_calm_flight_gets_no_term():
    """Nothing is missing: no term has the evidence that a choice among so many asks for."""
    assert find_discrepancy(own_base(), *outside(own_flight(None, 24.0, 31))) is None
