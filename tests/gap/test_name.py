"""Naming: what was planted is named, what was not is not, and what cannot be named is not given
another name.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.flight_table import slice_time
from falconwing_kit.gap import baseline as baseline_module
from falconwing_kit.gap import name as name_module
from falconwing_kit.gap.baseline import (
    VERY_STRONG_EVIDENCE,
    identify_baseline,
    with_thrust_curve,
)
from falconwing_kit.gap.name import (
    EffectCandidate,
    change_over_baseline,
    chi2_difference_error,
    name_effect,
)
from falconwing_kit.sysid.fit import Prior, fit
from falconwing_kit.sysid.prepare import prepare
from tests.gap.studies import EFFECTS, own_aircraft, own_base, own_flight, shipped, wind_study
from tests.sysid.simulated import fly_figure_eights, measured


def test_wind_of_an_independent_aircraft_is_named_with_its_size():
    """JSBSim flew this case in a wind of 0.0924 and 0.4370 m/s; 0.05 m/s is the goal of the kit."""
    naming = wind_study().naming
    assert naming.verdict == "named"
    assert [c.effect.name for c in naming.chosen] == ["wind"]
    assert naming.chosen[0].values["wind_x"] == pytest.approx(0.0924, abs=0.05)
    assert naming.chosen[0].values["wind_y"] == pytest.approx(0.4370, abs=0.05)
    assert naming.ranking[0].delta_bic > 10.0 * naming.threshold


def test_second_half_of_a_calm_flight_shows_nothing():
    """One flight of one aircraft with nothing changed, cut in two at a minute: there is nothing to
    name.
    """
    calm = shipped("case02_calm")
    half = calm.t[0] + 0.5 * calm.duration
    naming = name_effect(
        identify_baseline(slice_time(calm, -np.inf, half)), slice_time(calm, half, np.inf)
    )
    assert naming.verdict == "none"
    assert naming.chosen == ()


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("adverse_yaw", {"adverse_yaw": 0.08}),
        ("propeller_torque", {"torque_roll": 0.6, "torque_yaw": -0.4}),
    ],
)
def test_planted_effect_is_named_with_its_size(effect, values):
    """Own aircraft, 45 s, an effect well above its limit: named, with its size within 20 %."""
    naming = name_effect(own_base(), own_flight(effect, 45.0, 41, **values))
    assert [c.effect.name for c in naming.chosen] == [effect]
    for name, value in values.items():
        assert naming.chosen[0].values[name] == pytest.approx(value, rel=0.2)


def test_weak_effect_beside_a_strong_one_is_named_too():
    """Own aircraft, 45 s, half a metre per second of wind and an aileron that moves 15 % less: two
    names, each with its size, though the wind explains three hundred times more.
    """
    rng = np.random.default_rng(46)
    model = own_aircraft().with_effect(EFFECTS["wind"]).with_effect(EFFECTS["aileron_loss"])
    model = model.with_values({"wind_x": -0.3, "wind_y": 0.4, "aileron_lost": 0.15})
    naming = name_effect(own_base(), measured(fly_figure_eights([model], 45.0, rng), rng))
    assert [c.effect.name for c in naming.chosen] == ["wind", "aileron_loss"]
    assert naming.chosen[0].delta_bic > 300.0 * naming.chosen[1].delta_bic
    assert naming.chosen[1].values["aileron_lost"] == pytest.approx(0.15, rel=0.2)


def test_error_of_the_first_formula_is_no_second_effect():
    """Servos that have become slow in a way no entry describes, two lags one after the other: one
    name for it, not a delay beside a lag.
    """
    rng = np.random.default_rng(47)
    first, second = (e for e in CATALOGUE if e.name == "actuator_lag")
    model = own_aircraft().with_effect(first).with_effect(second)
    model = model.with_values({"actuator_lag": 0.08, "lag_in_series": 0.1})
    naming = name_effect(own_base(), measured(fly_figure_eights([model], 45.0, rng), rng))
    assert {c.effect.name for c in naming.chosen} in ({"actuator_lag"}, {"control_delay"}, set())


def test_withheld_effect_gets_no_other_name():
    """Adverse yaw without its entry in the catalogue stays unnamed."""
    catalogue = [e for e in CATALOGUE if e.name != "adverse_yaw"]
    naming = name_effect(
        own_base(), own_flight("adverse_yaw", 45.0, 41, adverse_yaw=0.08), catalogue
    )
    assert naming.verdict in ("none", "outside")


def test_drag_without_its_entry_is_no_flap():
    """A flap that lifts nothing is drag by another name: withheld drag stays unnamed, and looks
    like a force that goes with airspeed.
    """
    catalogue = [e for e in CATALOGUE if e.name != "extra_drag"]
    naming = name_effect(own_base(), own_flight("extra_drag", 45.0, 42, drag_added=0.02), catalogue)
    assert (naming.verdict, naming.chosen) == ("outside", ())
    assert naming.generic.effect.name == "force with airspeed"


def test_load_that_no_entry_makes_is_outside():
    """A thrust line off the centre of gravity: a pitching moment with throttle, which trim alone
    would half explain.
    """
    planted = {
        f"moment_throttle_{axis}": value for axis, value in zip("xyz", (0.0, 3.0, 0.0), strict=True)
    }
    naming = name_effect(own_base(), own_flight("moment with throttle", 45.0, 43, **planted))
    assert (naming.verdict, naming.chosen) == ("outside", ())
    assert naming.generic.effect.name.startswith("moment with throttle")
    assert naming.generic.delta_bic > 2.0 * naming.ranking[0].delta_bic


def test_base_takes_in_what_the_calm_flight_shows_it_to_lack():
    """An aircraft whose propeller blows over its elevator, on both days: the wash goes into the
    base, not into a name.

    The wash planted adds 5 rad/s^2 at full throttle and a third of full elevator, a fifth of the
    elevator's own moment.
    """
    wash = {
        f"moment_throttle_and_elevator_{axis}": value
        for axis, value in zip("xyz", (0.0, 5.0, 0.0), strict=True)
    }
    base = identify_baseline(own_flight("moment with throttle and elevator", 90.0, 44, **wash))
    added = [term.name for term in base.result.model.terms if term.name in EFFECTS]
    assert added == ["moment with throttle and elevator"]
    assert base.result.model.values["moment_throttle_and_elevator_y"] == pytest.approx(5.0, rel=0.2)
    naming = name_effect(base, own_flight("moment with throttle and elevator", 45.0, 45, **wash))
    assert naming.verdict == "none"


def test_the_same_effect_in_both_flights_is_no_change():
    """By definition: a flight compared with itself has changed in nothing, whatever its residuals
    resemble; a wind that the second flight alone has is a change by most of what it explains.
    """
    study = wind_study()
    base, naming = study.base, study.naming
    wind = naming.chosen[0]
    with_wind = base.result.model.with_effect(wind.effect).with_values(wind.values)
    again = fit(with_wind, base.windows, base.result.initial_states, prior=base.prior)
    values = {name: again.model.values[name] for name in wind.values}
    found_in_base = replace(wind, values=values, result=again)
    assert change_over_baseline(base, base.windows, found_in_base) < VERY_STRONG_EVIDENCE
    assert change_over_baseline(base, naming.windows, wind) > 0.5 * wind.delta_chi2


def test_a_loss_that_the_parameters_take_up_is_still_a_change():
    """40 % of the thrust gone: thrust of 60 % would explain the second flight alone, but then the
    thrust has changed from the first, by forty times a day's drift.
    """
    base = own_base()
    naming = name_effect(base, own_flight("thrust_loss", 30.0, 43, thrust_lost=0.4))
    assert [c.effect.name for c in naming.chosen] == ["thrust_loss"]
    assert change_over_baseline(base, naming.windows, naming.chosen[0]) > VERY_STRONG_EVIDENCE


def test_an_effect_in_both_flights_hides_no_other(monkeypatch):
    """By the rule: the first in the ranking is in both flights (change 2 of the 10 needed), so it
    joins the model, keeps 2 as its evidence, and the next one, ranked beside it, is the new one.
    """
    fits = [wind_study().naming.before, replace(wind_study().naming.before, cost=1.0)]
    wind, flap = (
        EffectCandidate(EFFECTS[name], evidence, evidence, {}, fitted)
        for name, evidence, fitted in (("wind", 60.0, fits[1]), ("flap", 30.0, fits[0]))
    )
    changes = {"wind": 2.0, "flap": 40.0}
    monkeypatch.setattr(name_module, "_evidence_of_change", lambda b, w, c: changes[c.effect.name])
    asked = []

    def rank(base, windows, before, rest, progress):
        asked.append((before, {effect.name for effect in rest}))
        return [flap]

    monkeypatch.setattr(name_module, "_rank", rank)
    before, ranking, new = name_module._set_aside(
        own_base(), None, fits[0], [wind, flap], (EFFECTS["wind"], EFFECTS["flap"]), 10.0, print
    )
    assert asked == [(fits[1], {"flap"})] and before is fits[1]
    assert [(c.effect.name, c.delta_bic) for c in ranking] == [("flap", 30.0), ("wind", 2.0)]
    assert new is flap


@pytest.mark.parametrize(("change", "is_new"), [(95.0, False), (97.0, True)])
def test_a_change_within_the_error_of_a_formula_is_none(monkeypatch, change, is_new):
    """By hand: a formula wrong by 20 % leaves 0.2^2 of 2,400, which is 96, in either flight."""
    stall = EffectCandidate(EFFECTS["stall"], 2390.0, 2400.0, {}, wind_study().naming.before)
    monkeypatch.setattr(name_module, "_evidence_of_change", lambda *_: change)
    base = replace(own_base(), inflation={"stall": 1.0})
    assert name_module._is_new(base, None, stall) is is_new


@pytest.mark.parametrize(("change", "verdict"), [(2.0, "none"), (40.0, "outside")])
def test_a_load_in_both_flights_is_not_outside(monkeypatch, change, verdict):
    """By the rule: in a flight without excess a generic load counts where it is a change of more
    than 10 over the same load in both flights.
    """
    base, best = own_base(), name_module._best_generic

    def strong(*args):
        return replace(best(*args), delta_bic=1000.0)

    monkeypatch.setattr(name_module, "_best_generic", strong)
    monkeypatch.setattr(name_module, "_evidence_of_change", lambda *_: change)
    assert name_effect(base, own_flight(None, 20.0, 47)).verdict == verdict


@pytest.mark.parametrize(
    ("strength", "is_new", "verdict"),
    [(1e6, True, "outside"), (1e6, False, "named"), (40.0, True, "named")],
)
def test_a_generic_load_overrules_a_name_where_it_is_strong_and_new(
    monkeypatch, strength, is_new, verdict
):
    """By the rule: one that fits far better is "outside", unless the baseline flight has it too or
    its own evidence is below the 50 above which it is taken as real.
    """
    best = name_module._best_generic
    monkeypatch.setattr(
        name_module, "_best_generic",
        lambda *args: replace(best(*args), delta_bic=strength, delta_chi2=1e6),
    )  # fmt: skip
    monkeypatch.setattr(name_module, "_is_new", lambda *_: is_new)
    flight = own_flight("adverse_yaw", 20.0, 41, adverse_yaw=0.08)
    assert name_effect(own_base(), flight).verdict == verdict


@pytest.mark.parametrize(
    ("found", "other", "plain", "completed"),
    [
        ("flap", "extra_drag", 0.20, 0.30),  # both act along the flight path
        ("flap", "aileron_loss", math.sqrt(0.001), 0.10),
        ("wind", "control_delay", math.sqrt(0.001), math.sqrt(0.001)),
        ("control_delay", "aileron_loss", 0.20, 0.20),
        ("fan_jet", "aileron_loss", math.sqrt(0.001), 0.10),  # its profile is assumed
    ],
)
def test_a_completed_base_makes_no_error_of_wind_or_time(found, other, plain, completed):
    """Share of the residuals of a found effect that its formula may miss, squared, of chi2 1000:
    more where the nominal model had to be completed, but for what is kinematics alone.
    """
    candidate = EffectCandidate(EFFECTS[found], 1000.0, 1000.0, {}, None)
    for effects, share in (((), plain), (("a load",), completed)):
        base = SimpleNamespace(
            result=SimpleNamespace(model=SimpleNamespace(effects=effects)),
            found=SimpleNamespace(model=SimpleNamespace(effects=())),
        )
        error = name_module._formula_error(base, candidate, EFFECTS[other])
        assert error == pytest.approx(1000.0 * share**2)


def test_rivals_are_those_within_very_strong_evidence():
    """By hand: of 100, 91 and 89 the second is within 10 of the first; a drag that is part of a
    flap is no rival of the flap, whatever its evidence.
    """
    first, second, third = (
        EffectCandidate(EFFECTS[name], evidence, evidence, {}, None)
        for name, evidence in (("wind", 100.0), ("flap", 91.0), ("stall", 89.0))
    )
    assert name_module._rivals(first, [second, third]) == (second,)
    larger = replace(second, effect=replace(second.effect, contains=("wind",)))
    assert name_module._rivals(first, [larger]) == ()


def test_effects_that_explain_the_same_are_compared_with_each_other():
    """By hand, 1,000 measured components: a delay explains 504 with a variance factor of 1.19, a
    lag 479 with 1: alone 416.6 against 472.1, but of the two the delay explains 25 more, 21 by the
    larger factor. Wind, with little evidence of its own, is no part of the comparison.
    """
    penalty = math.log(1000.0)
    base = SimpleNamespace(inflation={"control_delay": 1.19, "wind": 20.0})
    windows = SimpleNamespace(count=1000)
    delay, lag, wind = (
        EffectCandidate(EFFECTS[name], alone, explained, {}, "a fit")
        for name, alone, explained in (
            ("control_delay", 504.0 / 1.19 - penalty, 504.0),
            ("actuator_lag", 479.0 - penalty, 479.0),
            ("wind", 4.0, 600.0),
        )
    )
    best, second, third = name_module._best_first(base, windows, [wind, lag, delay])
    assert (best, third) == (delay, wind)
    assert second.effect.name == "actuator_lag"
    assert second.delta_bic == pytest.approx(best.delta_bic - 25.0 / 1.19)
    assert name_module._best_first(base, windows, [wind, lag]) == [lag, wind]


def test_the_first_of_two_effects_is_chosen_anew_beside_the_second(monkeypatch):
    """By hand: trim explains most alone, and 100 with a tilt; beside the tilt a mass explains 900
    instead of 650, and takes its place. A mass that explains 5 more does not.
    """
    result = SimpleNamespace(model=SimpleNamespace(values={}))
    trim, tilt = (
        EffectCandidate(EFFECTS[name], chi2, chi2, {}, result)
        for name, chi2 in (("trim_bias", 700.0), ("camera_tilt", 100.0))
    )
    alone = replace(tilt, delta_chi2=150.0)
    base, windows = SimpleNamespace(inflation={}), SimpleNamespace(count=1000)
    monkeypatch.setattr(name_module, "_fit_effect", lambda *_: alone)

    def pair_where_a_mass_explains(chi2):
        mass = EffectCandidate(EFFECTS["mass_change"], chi2, chi2, {}, result)
        monkeypatch.setattr(name_module, "_rank", lambda *_: [mass])
        return name_module._exchange_first(
            base, windows, None, (trim, tilt), tuple(CATALOGUE), print
        )

    exchanged = pair_where_a_mass_explains(900.0)
    assert [c.effect.name for c in exchanged] == ["camera_tilt", "mass_change"]
    assert exchanged[0] is alone
    assert pair_where_a_mass_explains(640.0) == (trim, tilt)


def test_a_generic_effect_and_a_named_one_have_one_variance_factor():
    """By hand, 1,000 measured components and three parameters against one: 300 against 100 over a
    factor of 4 is 50, less twice ln(1000) and the price of the best of so many generic effects.
    """
    base = SimpleNamespace(inflation={"aileron_loss": 4.0, GENERIC_EFFECTS[0].name: 2.0})
    named = EffectCandidate(EFFECTS["aileron_loss"], 10.0, 100.0, {}, None)
    generic = EffectCandidate(GENERIC_EFFECTS[0], 100.0, 300.0, {}, None)
    over = name_module._evidence_over(base, SimpleNamespace(count=1000), generic, [named])
    chance = 2.0 * math.log(len(GENERIC_EFFECTS))
    assert over == pytest.approx(50.0 - 2.0 * math.log(1000.0) - chance)


def test_thrust_of_the_nominal_model_is_that_of_a_propeller():
    """It falls with speed and grows at least as throttle: neither coefficient may be negative, and
    a start that is goes to zero; the linear part keeps its bounds.
    """
    model = rates_model().with_values({"kTV": -0.2})
    curved = with_thrust_curve(model)
    low = {p.name: p.low for p in curved.parameters}
    assert (low["kTV"], low["kTT"], curved.values["kTV"]) == (0.0, 0.0, 0.0)
    before = {p.name: (p.low, p.high) for p in model.parameters if p.name != "kTV"}
    after = {p.name: (p.low, p.high) for p in curved.parameters}
    assert before.items() <= after.items()
    assert with_thrust_curve(curved) is curved


def test_the_completion_tries_four_effects_each_in_its_best_form(monkeypatch):
    """By the rule: two forms of a delay are one trial, the better one; the fifth is not tried."""
    base = own_base()
    names = ("wind", "control_delay", "control_delay", "flap", "stall", "mass_change", "cg_shift")
    gains = dict(enumerate((900.0, 700.0, 800.0, 600.0, 500.0, 400.0, 1.0)))
    tried = [
        SimpleNamespace(variant=SimpleNamespace(effect=EFFECTS[name]), number=k)
        for k, name in enumerate(names)
    ]
    scores = SimpleNamespace(
        score=lambda effect: SimpleNamespace(delta_chi2=gains[effect.number], effect=effect),
        inflation=lambda effect: 1.0,
    )
    monkeypatch.setattr(baseline_module, "sensitivities", lambda *_: tried)
    monkeypatch.setattr(baseline_module, "SchurComplement", SimpleNamespace(of=lambda *_: scores))
    fitted = []
    monkeypatch.setattr(
        baseline_module, "_add_to_base",
        lambda result, windows, score, weak: fitted.append(score.effect.number),
    )  # fmt: skip
    result, _ = baseline_module._complete_model(base.result, base.windows, (), base.weak, print)
    assert result is base.result
    assert fitted == [0, 2, 3, 4]


def test_no_full_fit_far_below_the_best(monkeypatch):
    """By hand: 0.1 of 1,000 is 100, so of linear evidence 1,000, 150, 99 and 98 two are fitted in
    full; where the best has 60, all but the last, which is below -10.
    """
    fitted = []

    def fit_effect(base, windows, before, guess, *_):
        fitted.append(guess.delta_bic)
        return replace(guess, result="a fit")

    def count(*evidence):
        fitted.clear()
        open_ = [
            EffectCandidate(effect, gain, gain, {}, None)
            for effect, gain in zip(EFFECTS.values(), evidence, strict=False)
        ]
        monkeypatch.setattr(name_module, "_scan_forms", lambda *_: open_)
        monkeypatch.setattr(name_module, "_best_first", lambda base, windows, ranking: ranking)
        ranking = name_module._rank(None, None, None, (), print)
        assert [c.delta_bic for c in ranking] == list(evidence)
        return tuple(fitted)

    monkeypatch.setattr(name_module, "_fit_effect", fit_effect)
    assert count(1000.0, 150.0, 99.0, 98.0) == (1000.0, 150.0)
    assert count(60.0, 50.0, 20.0, 7.0, -11.0) == (60.0, 50.0, 20.0, 7.0)


@pytest.mark.parametrize(("is_identifiable", "left"), [(True, "mount"), (False, "tilt")])
def test_a_form_that_is_not_identifiable_gives_way_to_the_next(monkeypatch, is_identifiable, left):
    """A camera turned in pitch and roll alone: the form with yaw scans a little better, by chance,
    but its yaw may be zero. The one without yaw then stands for the effect, or nothing would.
    """
    tilt, mount = (e for e in CATALOGUE if e.name == "camera_tilt")
    scanned = [
        EffectCandidate(mount, 1010.0, 1030.0, {}, None),
        EffectCandidate(tilt, 1000.0, 1010.0, {}, None),
        EffectCandidate(EFFECTS["trim_bias"], 500.0, 520.0, {}, None),
    ]

    def fit_effect(base, windows, before, guess, *_):
        if guess.effect is mount and not is_identifiable:
            return replace(guess, result="a fit", delta_bic=0.0, is_identifiable=False)
        return replace(guess, result="a fit")

    monkeypatch.setattr(name_module, "_scan_forms", lambda *_: scanned)
    monkeypatch.setattr(name_module, "_fit_effect", fit_effect)
    monkeypatch.setattr(name_module, "_best_first", lambda base, windows, ranking: ranking)
    ranking = name_module._rank(None, None, None, (), print)
    assert [c.effect.name for c in ranking] == ["camera_tilt", "trim_bias"]
    assert ranking[0].effect is {"mount": mount, "tilt": tilt}[left]


class Rows:
    """Windows as far as degrees of freedom are counted."""

    def __init__(self, count, windows):
        self.count, self._windows = count, windows

    def __len__(self):
        return self._windows


def test_residuals_that_share_an_error_count_as_fewer():
    """By hand: chi2 1.2, 800 and 3,200 degrees of freedom: 1.2 sqrt(2/800 + 2/3200) = 0.0671; with
    each error shared by four residuals twice that, as for 200 and 800.
    """
    result = SimpleNamespace(model=SimpleNamespace(n_states=9), free=("a",) * 10)
    base = SimpleNamespace(chi2=1.2, windows=Rows(3_300, 10), result=result, prior_inflation=1.0)
    assert chi2_difference_error(base, 800) == pytest.approx(0.06708, abs=1e-5)
    base.prior_inflation = 4.0
    assert chi2_difference_error(base, 800) == pytest.approx(0.13416, abs=1e-5)


@pytest.mark.parametrize(("sigmas", "divisor"), [(0.5, 1.0), (1.0, 1.0), (2.0, 4.0)])
def test_parameters_far_from_their_prior_divide_the_evidence(sigmas, divisor):
    """By hand, Birge's ratio squared: every parameter two standard deviations away divides what an
    effect gains by four; within one, by nothing. With a variance factor of four of the prior
    itself, two are one.
    """
    model = rates_model()
    sigma = {name: 0.1 * (1.0 + k) for k, name in enumerate(model.names)}
    moved = model.with_values({n: model.values[n] + sigmas * s for n, s in sigma.items()})
    last = EffectCandidate(
        EFFECTS["wind"], 0.0, 0.0, {},
        SimpleNamespace(model=moved, free=tuple(range(len(model.names)))),
    )  # fmt: skip
    windows = SimpleNamespace(count=1000)
    penalty = len(EFFECTS["flap"].parameters) * math.log(1000.0)
    flap = EffectCandidate(EFFECTS["flap"], 300.0, 0.0, {}, None)
    base = SimpleNamespace(prior=Prior(dict(model.values), sigma), prior_inflation=1.0)
    found = name_module._evidence_by_birge_ratio(base, windows, flap, last)
    assert found == pytest.approx((300.0 + penalty) / divisor - penalty)
    base.prior_inflation = 4.0
    assert name_module._evidence_by_birge_ratio(base, windows, flap, last) == pytest.approx(300.0)


def test_the_best_of_many_generic_effects_pays_for_the_choice_before_the_division(monkeypatch):
    """By hand, divided by four: what it gains over chance and over its own parameters."""
    monkeypatch.setattr(name_module, "_prior_distance", lambda *_: (40.0, 10))
    windows, chance = SimpleNamespace(count=1000), 2.0 * math.log(len(GENERIC_EFFECTS))
    penalty = len(GENERIC_EFFECTS[0].parameters) * math.log(1000.0)
    strong = EffectCandidate(GENERIC_EFFECTS[0], 400.0 - penalty - chance, 400.0, {}, "a fit")
    found = name_module._evidence_by_birge_ratio(None, windows, strong, strong)
    assert found == pytest.approx(100.0 - penalty - chance)


def test_a_rival_that_needs_another_aircraft_makes_no_name_ambiguous(monkeypatch):
    """By hand: of 100, 95 and 92 the first leaves 3 once divided, so that it ranks last, and the
    others remain as they are. Where all leave 3, none is above the threshold of 10; where a rival
    alone leaves 3, the first is alone.
    """
    ranking = [
        EffectCandidate(EFFECTS[name], evidence, evidence, {}, "a fit")
        for name, evidence in (("wind", 100.0), ("flap", 95.0), ("stall", 92.0))
    ]

    def lowered(*weak):
        monkeypatch.setattr(
            name_module, "_evidence_by_birge_ratio",
            lambda base, windows, c, last: 3.0 if last.effect.name in weak else c.delta_bic,
        )  # fmt: skip
        found = name_module._lower_strained_rivals(None, None, ranking, 10.0)
        return [(c.effect.name, c.delta_bic) for c in found]

    assert lowered("wind") == [("flap", 95.0), ("stall", 92.0), ("wind", 3.0)]
    assert [evidence for _, evidence in lowered("wind", "flap", "stall")] == [3.0] * 3
    assert lowered("flap", "stall") == [("wind", 100.0), ("flap", 3.0), ("stall", 3.0)]
    assert lowered() == [(c.effect.name, c.delta_bic) for c in ranking]


@pytest.mark.parametrize(("divided", "is_named"), [(9.0, False), (11.0, True)])
def test_a_name_needs_the_threshold_after_the_division(monkeypatch, divided, is_named):
    """By the rule, at a threshold of 10."""
    base = replace(own_base(), false_alarm_level=0.0)
    monkeypatch.setattr(name_module, "_evidence_by_birge_ratio", lambda *_: divided)
    naming = name_effect(base, own_flight("adverse_yaw", 20.0, 41, adverse_yaw=0.08))
    assert (naming.verdict == "named") == is_named
    assert naming.threshold == VERY_STRONG_EVIDENCE
    shown = {c.effect.name: c.delta_bic for c in naming.ranking}["adverse_yaw"]
    assert (shown == divided) == (not is_named)


@pytest.mark.parametrize(("divided", "is_found"), [(9.0, False), (11.0, True)])
def test_a_further_effect_needs_the_threshold_after_the_division(monkeypatch, divided, is_found):
    """By the rule, at a threshold of 10, whatever it gains before."""
    result = SimpleNamespace(model=SimpleNamespace(values={}, effects=()))
    wind, lag = (
        EffectCandidate(EFFECTS[name], 100.0, 100.0, {}, result)
        for name in ("wind", "actuator_lag")
    )
    base = SimpleNamespace(result=result, found=result)
    for name, answer in (
        ("_scan", [lag]),
        ("_rank", [lag]),
        ("_is_new", True),
        ("_evidence_by_birge_ratio", divided),
    ):
        monkeypatch.setattr(name_module, name, lambda *_, answer=answer: answer)
    found = name_module._find_further_effect(base, None, (wind,), CATALOGUE, 10.0, print)
    assert found is (lag if is_found else None)


@pytest.mark.parametrize("is_chosen", [False, True])
def test_a_generic_effect_that_could_decide_alone_is_fitted_in_full(is_chosen):
    """Beside a name that explains more than any generic effect the scan is enough, unless that
    name was not chosen: evidence of a scan is not divided and has no change over the baseline.
    """
    base, flight = own_base(), own_flight("adverse_yaw", 20.0, 41, adverse_yaw=0.08)
    windows, before = name_module.fit_flight(base, prepare(flight, base.found.sigma))
    named = EffectCandidate(EFFECTS["adverse_yaw"], 1e9, 1e9, {}, None)
    found = name_module._best_generic(base, windows, before, [named], is_chosen, lambda _: None)
    assert found.delta_bic > name_module.GENERIC_EVIDENCE
    assert (found.result is None) == is_chosen


@pytest.mark.parametrize(("lost", "left_out"), [(1, 1), (3, 0)])
def test_a_few_windows_in_which_the_model_diverges_are_left_out(lost, left_out):
    """Of 14 windows one begins at a million m/s, where drag by the square of speed diverges; three
    of 14 are no exception, and stay.
    """
    base = own_base()
    prepared = prepare(own_flight(None, 30.0, 47), base.found.sigma)
    flight = prepared.flights[0]
    whole, _ = name_module.fit_flight(base, prepared)
    states = flight.state_estimate.copy()
    begins = whole.nodes[2 : 2 + lost, 0]
    states[np.searchsorted(flight.t - flight.t[0], begins - 1e-6), 6:9] = 1e6
    spoilt = replace(prepared, flights=(replace(flight, state_estimate=states),))
    windows, result = name_module.fit_flight(base, spoilt)
    assert len(whole) - len(windows) == left_out
    assert np.isfinite(result.residual).all() == (left_out > 0)


@pytest.mark.parametrize(("begins", "verdict"), [(20.0, "none"), (42.0, "outside")])
def test_an_incident_is_no_unknown_effect(begins, verdict):
    """Own aircraft as on the calm day, 45 s, which once sinks by 1.5 m and comes back within 2 s:
    nothing is hidden; but what begins as the flight ends may go on.
    """
    flight = own_flight(None, 45.0, 48)
    phase = np.clip((flight.t - flight.t[0] - begins) / 2.0, 0.0, 1.0)
    p_world = flight.p_world.copy()
    p_world[:, 2] -= 0.75 * (1.0 - np.cos(2.0 * np.pi * phase))
    naming = name_effect(own_base(), replace(flight, p_world=p_world))
    assert naming.verdict == "outside"
    judged = name_module.without_incidents(own_base(), naming)
    assert (judged.verdict, judged.chosen) == (verdict, ())
    assert bool(judged.incidents) == (verdict == "none")
    for begin, end in judged.incidents:
        assert begin < begins + 2.0 + flight.t[0] and end > begins + flight.t[0]


@pytest.mark.parametrize(
    ("apart", "others", "are_incidents"),
    [
        ([], 1.0, False),
        ([5], 1.0, True),
        ([5, 6, 9], 1.0, True),
        ([5, 7, 9], 1.0, False),  # three runs
        ([5, 6, 7, 8], 1.0, False),  # more than a tenth
        ([27], 1.0, False),  # in the last tenth
        ([5], 1.15, False),  # 2 of 2 + 29 * 0.15: less than half of the excess
    ],
)
def test_incidents_are_few_soon_over_and_most_of_the_excess(apart, others, are_incidents):
    """30 windows of one number each, with a chi2 of 3 in some; a baseline of 1, and 1.1 once."""

    def flight(chi2):
        windows = SimpleNamespace(weight=np.ones((len(chi2), 1, 1)), flight=np.zeros(len(chi2)))
        return windows, SimpleNamespace(residual=np.sqrt(chi2)[:, None])

    calm = np.ones(30)
    calm[3] = 1.1
    chi2 = np.full(30, others)
    chi2[apart] = 3.0
    windows, result = flight(calm)
    base = SimpleNamespace(windows=windows, result=result)
    found = name_module._incidents(base, *flight(chi2))
    assert found.tolist() == (apart if are_incidents else [])
