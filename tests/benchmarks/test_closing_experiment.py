"""The closing experiment's own arithmetic and its stand-in for the kit's simulator, both by hand;
the experiment itself is a benchmark.
"""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.gap.advice import DIAGNOSIS_MANOEUVRES
from tests.benchmarks.closing_experiment import (
    JsbsimFlight,
    JsbsimLanding,
    Pair,
    draw_pairs,
    land,
    summarise,
    truth_model,
)
from tests.diagnosis_pilot import LEG_S, diagnosis_pilot
from tests.hidden_effects import EFFECTS, IN_CATALOGUE, LEAD, Acting
from tests.hidden_flights import fly_on, make_case
from tests.jsbsim_aircraft import ROW, JsbsimAircraft, figure_eights, fly_jsbsim, playback


def landing(success: bool, ald: float | None = None) -> dict:
    return {"success": success, "ald_m": ald, "sink_rate_m_s": None if ald is None else 0.2}


def row(effect: str, named: list[str], nominal: list, improved: list, truth: list) -> dict:
    landings = {"nominal": nominal, "improved": improved, "truth": truth}
    verdict = "named" if named else "none"
    return {
        "effect": effect, "first_verdict": "none", "verdict": verdict, "named": named,
        "landings": landings,
    }  # fmt: skip


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
    assert (found["named_first"], found["named"], found["named_rightly"]) == (0, 2, 1)


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


def flown_manoeuvre(name: str) -> tuple[np.ndarray, np.ndarray]:
    """States and sticks of a minute of a manoeuvre."""
    (manoeuvre,) = (m for m in DIAGNOSIS_MANOEUVRES if m.name == name)
    _, states, sticks = fly_jsbsim(JsbsimAircraft(), diagnosis_pilot(manoeuvre), 60.0)
    return states, sticks


def test_glides_are_flown_with_the_throttle_closed_for_two_seconds():
    """The library's glides: throttle 0 for LEG_S at a time, losing height; powered legs between."""
    states, sticks = flown_manoeuvre("glides")
    closed = np.flatnonzero(np.diff(np.r_[0, sticks[:, 0] == 0.0, 0]))
    begins, ends = closed[::2], closed[1::2]
    long = ends - begins >= round(LEG_S / ROW)
    assert long.sum() >= 3
    assert np.all(states[ends[long] - 1, 2] < states[begins[long], 2])


def test_low_passes_are_flown_at_the_heights_of_their_legs():
    """0.4 m and 2 m, as the manoeuvre says, within 0.3 m; never on the floor."""
    height = flown_manoeuvre("low passes")[0][:, 2]
    assert height.min() > 0.05
    shares = [np.mean(np.abs(height - of_leg) < 0.3) for of_leg in (0.5, 2.0)]  # 0.4 and 0.6 m
    assert min(shares) > 0.1


def test_the_battery_goes_on_in_the_diagnosis_flight(monkeypatch):
    """The effect's clock: 5 s after the first table ends, then LEAD and 20 s, by adding up."""
    case = make_case(5, "none", flight_seconds=20.0)
    clock: list[float] = []
    watched = Acting(case.aircraft, lambda t, fdm: clock.append(t))
    monkeypatch.setitem(EFFECTS, "none", replace(EFFECTS["none"], act=lambda a, s: watched))
    rng = np.random.default_rng(1)
    both = fly_on(case, figure_eights(rng), 20.0, rng)
    assert both is not None
    first = case.flight.t[-1]
    assert clock[0] == pytest.approx(first + 5.0)
    assert clock[-1] == pytest.approx(first + 5.0 + LEAD + 20.0, abs=0.01)
    assert np.diff(both.t).max() == pytest.approx(5.0)
    assert len(both.t) == 2 * len(case.flight.t)
