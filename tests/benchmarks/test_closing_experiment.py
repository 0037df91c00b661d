"""The closing experiment's own arithmetic and its stand-in for the kit's simulator, both by hand;
the experiment itself is a benchmark.
"""

import numpy as np
import pytest

from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.loops import LINK_DELAY_S
from tests.benchmarks.closing_experiment import (
    JsbsimFlight,
    JsbsimLanding,
    Pair,
    draw_pairs,
    land,
    summarise,
    truth_model,
)
from tests.hidden_effects import EFFECTS, IN_CATALOGUE
from tests.jsbsim_aircraft import JsbsimAircraft, fly_jsbsim, playback


def landing(success: bool, ald: float | None = None) -> dict:
    return {"success": success, "ald_m": ald, "sink_rate_m_s": None if ald is None else 0.2}


def row(effect: str, named: list[str], nominal: list, improved: list, truth: list) -> dict:
    landings = {"nominal": nominal, "improved": improved, "truth": truth}
    verdict = "named" if named else "none"
    return {"effect": effect, "verdict": verdict, "named": named, "landings": landings}


def test_summary_by_hand():
    """Two pairs of two rounds: improved loses one landing of round 1, and is 2 cm off in each pair.

    Pair 1: only the first round counts, 0.05 - 0.03; pair 2: (0.05 + 0.09) / 2 - (0.04 + 0.06) / 2.
    All pairs have the same difference, so its interval has no width. Late stamps count as a delay.
    """
    good = [landing(True, 0.03), landing(True, 0.04)]
    rows = [
        row("time_offset", ["control_delay"], [landing(False)] * 2,
            [landing(True, 0.05), landing(False)], good),
        row("wind", ["flap"], good, [landing(True, 0.05), landing(True, 0.09)],
            [landing(True, 0.04), landing(True, 0.06)]),
    ]  # fmt: skip
    found = summarise(rows)
    improved = found["experts"]["improved"]
    assert (improved["successes"], improved["landings"]) == (3, 4)
    assert improved["landings_lost_by_round"] == [0, 1]
    assert found["experts"]["nominal"]["landings_lost_by_round"] == [1, 1]
    difference = improved["ald_difference_m"]
    assert difference["mean"] == pytest.approx(0.02)
    assert (difference["low95"], difference["high95"]) == pytest.approx((0.02, 0.02))
    assert (found["named"], found["named_rightly"]) == (2, 1)


def test_pairs_meet_every_effect():
    """38 pairs: every effect of the catalogue twice; seeds of their own; half of them plain."""
    pairs = draw_pairs(38, 100)
    assert sorted(pair.effect for pair in pairs) == sorted(2 * IN_CATALOGUE)
    assert len({pair.seed for pair in pairs}) == 38
    assert sum(pair.plain for pair in pairs) == 19
    assert Pair(1, "wind", "marker", False).size is None
    assert np.hypot(*Pair(1, "wind", "marker", True).size["wind"]) > 0.6 * EFFECTS["wind"].plain


def test_stepwise_flight_is_that_of_the_whole_flight():
    """Commands 50 ms early reach JSBSim as in `fly_jsbsim`, which has no link; to rounding."""
    aircraft = JsbsimAircraft()
    steady = trim(aircraft.kit_model(), 7.0)
    rng = np.random.default_rng(3)
    sticks = steady.command + 0.1 * rng.normal(size=(21, 4))
    _, states, _ = fly_jsbsim(aircraft, playback(sticks), 1.0, start=steady.state)
    flight = JsbsimFlight(EFFECTS["none"].act(aircraft, {}), steady.state)
    for k in range(20):
        flight.send(0.05 * k - LINK_DELAY_S, sticks[k])
        flight.advance(0.05 * (k + 1))
    assert np.abs(states[-1] - steady.state).max() > 0.5
    assert flight.x == pytest.approx(states[-1], abs=1e-9)


def test_truth_has_the_hidden_size_in_the_kits_terms():
    """Sizes by hand: late stamps are a delay, a slow linkage a lag in series, lift and drag shares
    of a ground effect multiply.
    """
    aircraft = JsbsimAircraft()
    late = truth_model(aircraft, "time_offset", {"offset": 0.06}, {"control_delay": 0.06})
    assert late.values["control_delay"] == 0.06
    slow = truth_model(
        aircraft, "actuator_lag", {"lag": 0.1, "in_series": True}, {"actuator_lag": 0.1}
    )
    assert slow.values["lag_in_series"] == 0.1
    low = truth_model(
        aircraft, "ground_effect", {"ge": 0.5, "less_drag": 0.4}, {"ground_lift": 0.5}
    )
    assert (low.values["ground_lift"], low.values["ground_drag"]) == (0.5, pytest.approx(0.2))


def test_expert_of_the_truth_lands_where_that_of_the_nominal_model_crashes():
    """A delay of 80 ms in JSBSim: known, it is landed on the pad; unknown, the loops oscillate."""
    aircraft, size = JsbsimAircraft(), {"delay": 0.08}
    truth = truth_model(aircraft, "control_delay", size, {"control_delay": 0.08})
    task = JsbsimLanding(aircraft, "control_delay", size, truth)
    (known,) = land(task, truth, 1)
    (unknown,) = land(task, aircraft.kit_model(), 1)
    assert known["success"] and known["ald_m"] < 0.5
    assert not unknown["success"]
