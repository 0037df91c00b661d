"""Closing: the named effect brings the model back to what calm flight leaves, from the time on at
which it set in.
"""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falconwing_kit.core.flight_table import FlightTable, slice_time
from falconwing_kit.gap import close
from falconwing_kit.gap.baseline import bic_penalty
from falconwing_kit.gap.close import (
    close_gap,
    find_course,
    find_onset,
    name_with_onset,
    with_course,
    with_onset,
)
from falconwing_kit.gap.name import EffectCandidate, name_effect
from falconwing_kit.sysid.fit import FitResult, fit, fit_initial_states
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import Windows, cut_windows
from tests.gap.studies import EFFECTS, own_aircraft, own_base, own_flight, wind_study
from tests.sysid.simulated import fly_figure_eights, measured


def test_gap_closes_with_the_wind():
    """The goal of the kit: 90 % of the held-out excess over the calm level."""
    closed = wind_study().closed
    over = closed.before.chi2 - closed.calm.chi2
    assert over > 3.0
    assert closed.after.chi2 - closed.calm.chi2 < 0.1 * over
    assert closed.after_with_fixed_parameters.chi2 - closed.calm.chi2 < 0.1 * over
    assert (
        closed.before_with_free_parameters.chi2 - closed.calm.chi2 > 0.5 * over
    )  # parameters alone do not close it
    assert closed.after.position_m < closed.before.position_m
    assert not closed.seen


def test_sizes_hold_the_truth():
    """The wind that was planted: 0.0924 m/s along x and 0.4370 along y; its 95 % interval is 0.007
    wide to a side.
    """
    sizes = wind_study().closed.parameters
    for name, truth in (("wind_x", 0.0924), ("wind_y", 0.4370)):
        assert sizes[name].low95 < truth < sizes[name].high95
        assert sizes[name].high95 - sizes[name].low95 < 0.05
        assert sizes[name].unit == "m/s"


@pytest.mark.parametrize(
    ("name", "parameter", "half"),
    [("extra_drag", "drag_added", 0.002772), ("wind", "wind_x", 0.001960)],
)
def test_intervals_of_loads_hold_an_error_of_their_formula(monkeypatch, name, parameter, half):
    """By hand: sigma 0.001 and 5 % of 0.02 as much again for a drag, 1.96 sqrt(0.001^2 + 0.001^2) =
    0.002772; wind is the air's velocity itself, 1.96 * 0.001.
    """
    model = SimpleNamespace(values=dict.fromkeys((p.name for p in EFFECTS[name].parameters), 0.02))
    known = SimpleNamespace(interval=lambda _, value: (value - 0.00196, value + 0.00196))
    monkeypatch.setattr(close, "uncertainty", lambda *_: known)
    candidate = EffectCandidate(EFFECTS[name], 0.0, 0.0, {}, SimpleNamespace(model=model))
    naming = SimpleNamespace(verdict="ambiguous", chosen=(candidate,), windows=None)
    size = close._sizes(SimpleNamespace(prior=None), naming, candidate)[parameter]
    assert size.high95 - size.value == pytest.approx(half, rel=1e-3)
    assert size.value - size.low95 == pytest.approx(half, rel=1e-3)


def test_scored_windows_are_whole_blocks_of_time():
    """About 30 % in blocks of 10 s: of nine blocks of a 90 s flight two are scored, ten windows."""
    study = wind_study()
    begins = study.naming.windows.nodes[study.closed.held_out, 0]
    assert 0.2 < len(begins) / len(study.naming.windows) < 0.4
    assert len(np.unique((begins - study.naming.windows.nodes[0, 0]) // 10.0)) <= 3


def test_short_calm_flight_changes_nothing():
    """Nothing is missing in 24 s of calm flight, so after is before; shorter blocks still leave
    time to score.
    """
    naming = name_effect(own_base(), own_flight(None, 24.0, 31))
    closed = close_gap(own_base(), naming)
    assert naming.verdict == "none"
    assert closed.after is closed.before
    assert closed.parameters == {}
    assert 0 < len(closed.held_out) < len(naming.windows)
    assert closed.before.chi2 == pytest.approx(1.0, abs=0.5)


def failing(name: str, since: float, seconds: float, seed: int, **values: float) -> FlightTable:
    """A flight of the own aircraft in which an effect sets in."""
    return changing(name, lambda time: time >= since, seconds, seed, **values)


def changing(
    name: str, share: Callable[[Any], Any], seconds: float, seed: int, **values: float
) -> FlightTable:
    """A flight of the own aircraft in which an effect acts by a share of the time: its loads times
    that, by a formula of the test's own on 10 ms steps.
    """
    effect, rng = EFFECTS[name], np.random.default_rng(seed)
    loads = effect.loads_of(own_aircraft().terms) if effect.loads_of else effect.loads
    hook, part = ("loads", loads) if loads else ("wind_field", effect.wind_field)
    clock = (lambda air, K: air.time) if loads else (lambda px, py, height, time, K: time)

    def late(*flow):
        return tuple(share(clock(*flow)) * load for load in part(*flow))

    cut = replace(effect, **{"loads_of": None, hook: late})
    model = own_aircraft().with_effect(cut).with_values(values)
    return measured(fly_figure_eights([model], seconds, rng), rng)


def fitted(flight: FlightTable) -> tuple[Windows, FitResult]:
    """The base model under its prior, fitted to a flight."""
    model = own_base().result.model
    windows = cut_windows(prepare(flight, own_base().found.sigma).flights, model)
    return windows, fit(
        model,
        windows,
        fit_initial_states(model, windows, windows.initial_guess)[0],
        prior=own_base().prior,
    )


def possible(*names: str) -> list[EffectCandidate]:
    """Effects of which nothing is known yet."""
    return [
        EffectCandidate(
            EFFECTS[n], 0.0, 0.0, {p.name: p.start for p in EFFECTS[n].parameters}, None
        )
        for n in names
    ]


def test_failure_in_midflight_is_named_dated_and_sized():
    """40 % of the thrust goes at 22.4 s of 45 s: over all of the flight that looks like no effect
    of the catalogue, or like a battery; on the time after it, it has its name, and its size within
    its 95 % interval, doubled.
    """
    naming, since = name_with_onset(
        own_base(), failing("thrust_loss", 22.4, 45.0, 43, thrust_lost=0.4)
    )
    assert (naming.verdict, [c.effect.name for c in naming.chosen]) == ("named", ["thrust_loss"])
    assert since is not None and since.effect.name == "thrust_loss"
    assert since.low95 <= since.time <= since.high95
    assert since.time == pytest.approx(22.4, abs=1.0)  # two windows of 2 s would be a guess
    assert naming.prepared.flights[0].t[0] == pytest.approx(since.time, abs=0.06)  # a row
    size = close_gap(own_base(), naming).parameters["thrust_lost"]
    assert size.value == pytest.approx(0.4, abs=size.high95 - size.low95)
    assert size.high95 - size.low95 < 0.2


@pytest.mark.parametrize(
    ("name", "since", "seed", "values"),
    [
        ("wind", 26.15, 42, {"wind_x": 0.5, "wind_y": -0.3}),
        ("adverse_yaw", 17.3, 41, {"adverse_yaw": 0.08}),
    ],
)
def test_onset_is_found_to_a_fraction_of_a_window(name, since, seed, values):
    """Planted inside a window of 2 s; 0.3 s is three of its standard deviations at most. Of three
    effects it is this one, its size rests on the time after, and both beat the effect all along by
    more than any name needs.
    """
    windows, before = fitted(failing(name, since, 45.0, seed, **values))
    onset = find_onset(
        own_base(), windows, before, possible("extra_drag", name, "propeller_torque")
    )
    assert onset is not None and onset.effect.name == name
    assert onset.time == pytest.approx(since, abs=0.3)
    assert find_course(own_base(), windows, before, possible(name), onset) is onset
    assert onset.low95 <= onset.time <= onset.high95 and onset.high95 - onset.low95 < 1.0
    for parameter, value in values.items():
        assert onset.result.model.values[parameter] == pytest.approx(value, rel=0.2)
    all_along = before.model.with_effect(EFFECTS[name])
    whole = fit(all_along, windows, before.initial_states, prior=own_base().prior)
    assert onset.delta_bic > (before.cost - whole.cost) / own_base().reduced_chi2 + 100.0


def test_an_effect_with_which_the_flight_diverges_has_no_onset(monkeypatch):
    """Its likelihood is finite at no time: no onset, and no error."""
    windows, before = fitted(failing("thrust_loss", 20.0, 45.0, 7, thrust_lost=0.4))
    monkeypatch.setattr(
        close, "_profile_likelihood", lambda *_: (np.array([1.0, 2.0]), np.array([np.inf, np.inf]))
    )
    assert find_onset(own_base(), windows, before, possible("thrust_loss")) is None


def test_an_effect_with_which_the_flight_diverges_has_no_end(monkeypatch):
    """A wind that blows for 17 s, but no finite likelihood at any begin or end: the onset stays."""
    blowing = changing(
        "wind", lambda t: (t >= 14.3) & (t < 31.7), 45.0, 51, wind_x=0.5, wind_y=-0.3
    )
    windows, before = fitted(blowing)
    onset = find_onset(own_base(), windows, before, possible("wind"))
    monkeypatch.setattr(
        close, "_profile_likelihood", lambda *_: (np.array([1.0, 2.0]), np.array([np.inf, np.inf]))
    )
    assert find_course(own_base(), windows, before, possible("wind"), onset) is onset


@pytest.mark.parametrize(
    ("name", "course", "begin", "end", "tolerance", "values"),
    [
        ("wind", "on-off", 14.3, 31.7, 0.4, {"wind_x": 0.5, "wind_y": -0.3}),
        ("extra_drag", "ramp", 12.0, 32.0, 3.0, {"drag_added": 0.01}),
    ],
)
def test_effect_that_stops_or_grows_has_two_times(name, course, begin, end, tolerance, values):
    """Planted in 45 s: a wind that blows for 17 s, and drag that grows over 20 s. Both times, to
    three standard deviations, and the full size; both beat an onset alone by more than a name asks.
    """
    planted = {
        "on-off": lambda t: (t >= begin) & (t < end),
        "ramp": lambda t: np.clip((t - begin) / (end - begin), 0.0, 1.0),
    }
    windows, before = fitted(changing(name, planted[course], 45.0, 51, **values))
    tried = possible(name, "propeller_torque")
    onset = find_onset(own_base(), windows, before, tried)
    found = find_course(own_base(), windows, before, tried, onset)
    assert (found.effect.name, found.course) == (name, course)
    assert found.time == pytest.approx(begin, abs=tolerance)
    assert found.end == pytest.approx(end, abs=tolerance)
    assert found.low95 <= found.time <= found.high95
    assert found.end_low95 <= found.end <= found.end_high95
    assert found.delta_bic > onset.delta_bic + 50.0
    for parameter, value in values.items():
        assert found.result.model.values[parameter] == pytest.approx(value, rel=0.1)


def test_share_of_a_course_by_hand():
    """Neutral moved by 0.2, on from 1 to 3 s, or growing from 1 to 3 s: at 0, 1, 2, 3 and 4 s."""
    t, sticks = np.arange(5.0), np.zeros((5, 4))
    on_off, ramp = (with_course(EFFECTS["trim_bias"], c, 0.0, 4.0) for c in ("on-off", "ramp"))
    times = {"acts_since": 1.0, "bias_aileron": 0.2}
    K = own_aircraft().with_effect(on_off).with_values({**times, "acts_until": 3.0}).K
    assert on_off.command_map(t, sticks, K)[:, 1] == pytest.approx([0.0, 0.2, 0.2, 0.0, 0.0])
    K = own_aircraft().with_effect(ramp).with_values({**times, "acts_fully_from": 3.0}).K
    assert ramp.command_map(t, sticks, K)[:, 1] == pytest.approx([0.0, 0.0, 0.1, 0.2, 0.2])


def test_effect_of_the_whole_flight_gets_no_onset():
    """The shipped case's wind blows from the first second on (its truth.json): a later start
    explains less.
    """
    study = wind_study()
    base, naming, (wind,) = study.base, study.naming, study.naming.chosen
    onset = find_onset(base, naming.windows, naming.before, naming.chosen)
    all_along = wind.delta_chi2 - bic_penalty(wind.effect, naming.windows)
    assert onset is not None and onset.delta_bic < all_along + naming.threshold
    assert study.since is None


def test_onset_keeps_the_flights_clock_over_a_pause():
    """The same flight without its rows from 9 to 13 s, so that it falls in two stretches, and with
    a clock that begins at 100 s: the wind still sets in at 126.15 s.
    """
    flight = failing("wind", 26.15, 45.0, 42, wind_x=0.5, wind_y=-0.3)
    torn = slice_time(flight, 0.0, 9.0), slice_time(flight, 13.0, np.inf)
    rows = {
        n: np.concatenate([getattr(f, n) for f in torn])
        for n in ("p_world", "attitude", "commands")
    }
    torn_flight = replace(flight, t=100.0 + np.concatenate([f.t for f in torn]), extra={}, **rows)
    windows, before = fitted(torn_flight)
    assert len(windows.flights) == 2
    onset = find_onset(own_base(), windows, before, possible("wind"))
    assert onset is not None and onset.time == pytest.approx(126.15, abs=0.3)


def test_what_cannot_be_switched_on_has_no_onset():
    """A delay, a lag and the camera act on more than the present moment's sticks and loads."""
    windows, before = fitted(own_flight(None, 24.0, 31))
    assert (
        find_onset(
            own_base(), windows, before, possible("control_delay", "actuator_lag", "camera_tilt")
        )
        is None
    )


def test_sticks_move_from_the_onset_on_only():
    """By hand: neutral moved by 0.2 from 1 s on, at 0, 1 and 2 s."""
    late = with_onset(EFFECTS["trim_bias"], 0.0, 2.0)
    model = own_aircraft().with_effect(late).with_values({"acts_since": 1.0, "bias_aileron": 0.2})
    moved = late.command_map(np.array([0.0, 1.0, 2.0]), np.zeros((3, 4)), model.K)
    assert moved[:, 1] == pytest.approx([0.0, 0.2, 0.2])
