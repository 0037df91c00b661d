"""Advice: the manoeuvre that parts two effects is found by the matrix that a fit of its flight
would have.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.integrate import roll_out
from falconwing_kit.core.checks import InputError
from falconwing_kit.gap.advice import (
    COMPARISON_S,
    DIAGNOSIS_MANOEUVRES,
    Advice,
    advise,
    headline,
    manoeuvre_windows,
    next_flight,
    noncentrality,
)
from falconwing_kit.gap.baseline import NominalModel
from falconwing_kit.gap.name import Naming, name_effect
from falconwing_kit.sysid.fit import fit, fit_initial_states
from falconwing_kit.sysid.shooting import Windows, fly_windows
from tests.gap.studies import EFFECTS, own_base, own_flight

SIZES = {  # well above what 30 s show, so that nothing rests on chance
    "extra_drag": {"drag_added": 0.012}, "thrust_loss": {"thrust_lost": 0.15},
    "battery_sag": {"sag": 0.12},
    "ground_effect": {"ground_lift": 0.2}, "flap": {"flap_lift": 0.02, "flap_drag": 0.004},
    "control_delay": {"control_delay": 0.04}, "actuator_lag": {"lag_in_series": 0.04},
    "deadband": {"deadband": 0.08},
    "adverse_yaw": {"adverse_yaw": 0.05},
    "time_offset": {}, "propeller_torque": {"torque_roll": 0.3, "torque_yaw": 0.3},
    "fan_jet": {"jet_x": 1.0, "jet_y": 0.0, "jet_at_x": 5.0, "jet_at_y": 2.0, "jet_radius": 2.0},
    "wind": {"wind_x": 0.4, "wind_y": 0.1},
}  # fmt: skip


@cache
def quiet() -> Naming:
    """The answer for 30 s of the own aircraft with nothing changed."""
    return name_effect(own_base(), own_flight(None, 30.0, 43))


def sizes(effect: str) -> dict[str, float]:
    """All parameters of an effect; those without a size above are zero."""
    return {**{p.name: 0.0 for p in EFFECTS[effect].amplitudes}, **SIZES[effect]}


def answer(verdict: str, *names: str) -> Naming:
    """The same flight as if these effects had been found on it with the sizes above."""
    blank = quiet().ranking[0]
    chosen = tuple(replace(blank, effect=EFFECTS[n], values=sizes(n), result=None) for n in names)
    return replace(quiet(), verdict=verdict, chosen=chosen)


@cache
def table(verdict: str, *names: str) -> dict[str, Advice]:
    """The advice by manoeuvre, best first."""
    return {a.manoeuvre.name: a for a in advise(own_base(), answer(verdict, *names))}


def test_noncentrality_is_the_hand_computed_one():
    """Columns s = (2, 0), f = (1, sqrt 2): products 4, 2, 3. By hand 4 - 2^2 / 3, and with a prior
    of 1 4 - 2^2 / 4.
    """
    gram = np.array([[3.0, 2.0], [2.0, 4.0]])
    signal, free = np.array([0.0, 1.0]), np.array([0])
    assert noncentrality(gram, signal, free, np.array([[0.0]])) == pytest.approx(
        4.0 - 4.0 / 3.0, rel=1e-6
    )
    assert noncentrality(gram, signal, free, np.array([[1.0]])) == pytest.approx(3.0, rel=1e-6)
    twice = noncentrality(np.stack([gram, 2.0 * gram]), signal, free, np.array([[0.0]]))
    assert twice[1] == pytest.approx(2.0 * twice[0], rel=1e-6)  # two flights tell twice as much


def test_a_signal_among_the_free_columns_leaves_nothing():
    """What a free parameter can do is no evidence: 1e-6 of the signal covers the solver's guard."""
    C = np.random.default_rng(3).normal(size=(40, 5))
    signal = np.array([0.0, 2.0, -1.0, 0.0, 0.0])
    left = noncentrality(C.T @ C, signal, np.array([0, 1, 2]), np.zeros((5, 5)))
    assert left < 1e-6 * signal @ C.T @ C @ signal


def test_glides_part_drag_from_a_weak_propeller():
    """With the throttle closed a weak propeller changes nothing; at any constant throttle more drag
    looks like it.
    """
    found = table("ambiguous", "extra_drag", "thrust_loss")
    assert found["glides"].chi2 > 2.0 * max(
        found[name].chi2 for name in ("hands off", "circles", "low passes")
    )
    assert found["glides"].seconds < 0.5 * min(
        found[name].seconds for name in ("hands off", "circles", "low passes")
    )


def test_low_passes_beside_high_ones_part_the_cushion_from_a_flap():
    """The cushion fades with height [McCormick], exp(-2 / 0.5) = 0.02 of it is left at 2 m; a
    flap's lift does not.
    """
    found = table("ambiguous", "ground_effect", "flap")
    assert next(iter(found)) == "low passes"
    assert found["low passes"].chi2 > 3.0 * max(
        a.chi2 for name, a in found.items() if name != "low passes"
    )
    sentence = next_flight(own_base(), answer("ambiguous", "ground_effect", "flap"))
    assert "separate ground effect and flap" in sentence
    assert "0.4 m" in sentence


def test_only_time_parts_a_battery_from_a_propeller():
    """A weak propeller is the same two minutes later; early in a flight an empty battery is a weak
    propeller.
    """
    found = table("ambiguous", "thrust_loss", "battery_sag")
    assert next(iter(found)) == "early and late"


def test_sharp_edges_part_a_delay_from_a_slow_servo():
    """exp(-s tau) and 1 / (1 + s tau) differ only where s tau is not small: not while the sticks
    are still.

    What still sticks tell of the aircraft sharpens the flight flown already a little, therefore a
    factor of 3 only.
    """
    found = table("ambiguous", "control_delay", "actuator_lag")
    assert next(iter(found)) in (
        "aileron doublets",
        "elevator doublets",
        "rudder doublets",
        "shaking",
    )
    still = max(found[n].chi2 for n in ("circles", "hands off", "fast flight"))
    assert found["aileron doublets"].chi2 > 3.0 * still


def test_a_dead_band_shows_in_small_movements():
    """What is commanded far beyond the band does not depend on its width; only the way there and
    back does.
    """
    found = table("named", "deadband")
    assert found["small movements"].shrinkage > 3.0 * found["aileron doublets"].shrinkage
    assert found["small movements"].shrinkage > 3.0 * found["rudder doublets"].shrinkage


def test_adverse_yaw_is_known_best_from_aileron_alone():
    """Its moment is proportional to aileron; the share by which an interval shrinks is within 0 and
    1.
    """
    found = table("named", "adverse_yaw")
    assert next(iter(found)) == "aileron doublets"
    assert all(-1e-9 < a.shrinkage < 1.0 for a in found.values())
    assert {a.widest for a in found.values()} == {"adverse_yaw"}


def test_a_stream_of_air_is_flown_through():
    """Passes lead through the place where it was found: their middles, on average, lie there within
    half a metre.
    """
    windows, (passes,) = manoeuvre_windows(
        own_base(),
        quiet().windows,
        np.array([5.0, 2.0]),
        [m for m in DIAGNOSIS_MANOEUVRES if m.name == "passes"],
    )
    assert len(windows) == len(passes.legs)
    middles = windows.pose[:, windows.pose.shape[1] // 2, :2]
    assert np.mean(middles, axis=0) == pytest.approx([5.0, 2.0], abs=0.5)
    assert "both directions" in next_flight(own_base(), answer("ambiguous", "wind", "fan_jet"))


@pytest.mark.parametrize(
    ("one", "other", "best"),
    [("extra_drag", "thrust_loss", "glides"), ("adverse_yaw", "propeller_torque", "glides")],
)
def test_a_flight_of_the_manoeuvre_shows_the_promised_difference(one, other, best):
    """Simulated without noise in one effect, fitted in full with the other: chi2 grows by the
    promise.

    A quarter covers what a linear forecast misses of sizes this large.
    """
    promised = table("ambiguous", one, other)[best]
    fought = min(difference(one, other, best), difference(other, one, best))
    assert fought == pytest.approx(promised.chi2, rel=0.25)


def difference(true: str, fitted: str, manoeuvre: str) -> float:
    """chi2 by which the wrong effect fits worse once TRIED_S of a manoeuvre are added to the flight
    flown already.
    """
    base, model = own_base(), own_base().result.model
    flown, initial_states = quiet().windows, quiet().before.initial_states
    ahead, (known,) = manoeuvre_windows(
        base, flown, None, [m for m in DIAGNOSIS_MANOEUVRES if m.name == manoeuvre]
    )
    longer = ahead.scale_weights(
        np.full(ahead.weight.shape, np.sqrt(COMPARISON_S / (2.0 * len(known.legs))))
    )
    both = joined(flown, longer)
    all_starts = np.concatenate([initial_states, ahead.initial_guess[:, : model.n_states]])
    truth = model.with_effect(EFFECTS[true]).with_values(sizes(true))
    wrong = model.with_effect(EFFECTS[fitted]).with_values(sizes(fitted))
    costs = []
    for windows, first in ((flown, initial_states), (both, all_starts)):
        poses = fly_windows(truth, windows, first)
        windows = replace(
            windows, pose=np.where(windows.weight > 0.0, poses, 0.0), initial_guess=padded(first)
        )
        costs.append(fit(wrong, windows, first, prior=base.prior, tolerance=0.01).cost)
    return (costs[1] - costs[0]) / base.reduced_chi2


def joined(a: Windows, b: Windows) -> Windows:
    """Windows of two flights in one."""
    parts = {
        n: np.concatenate([getattr(a, n), getattr(b, n)])
        for n in ("nodes", "pose", "weight", "edges", "initial_guess")
    }
    flight = np.concatenate([a.flight, b.flight + len(a.flights)])
    return replace(a, **parts, flight=flight, flights=(*a.flights, *b.flights))


def padded(initial_states: np.ndarray) -> np.ndarray:
    """(W, 12) start states."""
    return np.pad(initial_states, ((0, 0), (0, 12 - initial_states.shape[1])))


@pytest.mark.parametrize("manoeuvre", ["aileron doublets", "elevator doublets", "shaking"])
def test_no_manoeuvre_parts_a_delay_from_late_time_stamps(manoeuvre):
    """A stamp that is late shows x(t - tau), which flies on u(t - tau): the same as a control
    delay, wherever flown.

    Each leg is flown on 5 ms steps from 0.1 s before it, and seen 20 ms late. Of the chi2 that
    the delay explains a thousandth may be left by the fit's ten times longer steps.
    """
    base, late = own_base(), 4
    model = base.result.model
    windows, _ = manoeuvre_windows(
        base, quiet().windows, None, [m for m in DIAGNOSIS_MANOEUVRES if m.name == manoeuvre]
    )
    seen, initial_states = late_poses(base, windows, late)
    windows = replace(windows, pose=seen, initial_guess=padded(initial_states))
    known = model.with_fixed(model.names)
    _, left = fit_initial_states(known, windows, initial_states)
    without = float(np.sum(left**2))
    found = fit(
        known.with_effect(EFFECTS["control_delay"]), windows, initial_states, tolerance=1e-3
    )
    assert found.model.values["control_delay"] == pytest.approx(0.020, abs=5e-4)
    assert without > 100.0
    assert found.cost < 1e-3 * without
    assert advise(base, answer("ambiguous", "control_delay", "time_offset")) == ()
    assert "no flight separates" in next_flight(
        base, answer("ambiguous", "control_delay", "time_offset")
    )


def late_poses(base: NominalModel, windows: Windows, late: int) -> tuple[np.ndarray, np.ndarray]:
    """(W, L, 6) poses of every leg, `late` steps of 5 ms old, and (W, n) the first states."""
    fine, model = 10, base.result.model
    order = [0, 1, 2, 5, 3, 4]
    flight = windows.flights[0]
    t = flight.t - flight.t[0]
    poses, initial_states = np.empty(windows.pose.shape), np.empty((len(windows), model.n_states))
    for k, nodes in enumerate(windows.nodes):
        edges = nodes[0] + np.diff(nodes).mean() / fine * np.arange(
            -2 * fine, (len(nodes) - 1) * fine + 1
        )
        mean, slope = model.actuator_positions(t, flight.commands, edges, model.K)
        start = windows.initial_guess[k, : model.n_states]
        states = roll_out(model, start, mean, float(np.diff(edges).mean()), slope=slope)
        at = 2 * fine + fine * np.arange(len(nodes)) - late
        poses[k], initial_states[k] = states[at][:, order], states[at[0]]
    return poses, initial_states


@pytest.mark.parametrize("verdict", ["none", "outside"])
def test_every_other_verdict_has_its_sentence(verdict):
    """One sentence, no figure that is not a number."""
    sentence = next_flight(own_base(), answer(verdict))
    assert sentence
    assert "nan" not in sentence
    assert "inf" not in sentence


def test_an_aircraft_without_thrust_gets_no_manoeuvre_but_a_sentence():
    """No trim exists for it: nothing is computed, and that is no error."""
    base = own_base()
    weak = replace(
        base, result=replace(base.result, model=base.result.model.with_values({"kT": 0.01}))
    )
    with pytest.raises(InputError, match="trimmed"):
        manoeuvre_windows(weak, quiet().windows)
    assert advise(weak, answer("named", "flap")) == ()
    assert "longer" in next_flight(weak, answer("named", "flap"))


def test_the_library_can_be_flown_by_the_own_aircraft():
    """Every manoeuvre, within 75 deg of bank and pitch, above the floor, below a ceiling of 5 m."""
    windows, flown = manoeuvre_windows(own_base(), quiet().windows)
    assert flown == DIAGNOSIS_MANOEUVRES
    assert len(windows) == sum(len(m.legs) for m in flown)
    assert np.abs(windows.pose[..., 3:5]).max() < np.radians(75.0)
    assert windows.pose[..., 2].min() > 0.0
    assert windows.pose[..., 2].max() < 5.0


def test_a_value_beyond_its_bounds_is_brought_back():
    """A linear scan may find a stream of 99 m radius; the catalogue ends at 8 m, and both get the
    same advice.
    """
    named = answer("named", "fan_jet")
    sentences = [
        next_flight(own_base(), replace(named, chosen=(replace(named.chosen[0], values=values),)))
        for values in (
            {**sizes("fan_jet"), "jet_radius": 99.0},
            {**sizes("fan_jet"), "jet_radius": 8.0},
        )
    ]
    assert sentences[0] == sentences[1]
    assert "30 s narrow" in sentences[0]


def test_the_headline_says_when_incidents_were():
    """Nothing missing, but for what a stall did twice."""
    naming = SimpleNamespace(verdict="none", chosen=(), incidents=((4.5, 6.5), (20.9, 22.9)))
    assert headline(naming) == (
        "Nothing is missing that this flight could show, but for incidents (such as a stall) at "
        "4.5 to 6.5 s and 20.9 to 22.9 s"
    )
    assert headline(SimpleNamespace(verdict="none", chosen=(), incidents=())) == (
        "Nothing is missing that this flight could show"
    )
