"""The real flight's analysis: held-out predictions beat simple ones; the failure is detected."""

from typing import NamedTuple

import numpy as np
import pytest

from falconwing_kit.core.flight_table import FlightTable, slice_time
from falconwing_kit.sysid.forecast import Forecasts
from falconwing_kit.tools.demo import alfa
from falconwing_kit.tools.demo.alfa import FOLDS, AlfaAnalysis, analyse_alfa_flight

BLOCK_S = 10.0  # from the page's words: blocks of ten seconds


class TracedAnalysis(NamedTuple):
    """The analysis, and what its fits and forecasts were given and gave."""

    analysis: AlfaAnalysis
    fitted_to: dict[
        int, tuple[FlightTable, ...]
    ]  # id of a fitted model -> the stretches it was fitted to
    made: dict[tuple[int, int], Forecasts]  # id of a fitted model, running number -> its forecasts


@pytest.fixture(scope="module")
def traced():
    """The analysis with all of its fits and forecasts recorded; about ten seconds, once."""
    fitted_to, made, alive = {}, {}, []
    identify, forecast = alfa.identify, alfa.forecast

    def noted_identify(tables, **options):
        found = identify(tables, **options)
        alive.append(found.model)  # keeps the id from being used again
        fitted_to[id(found.model)] = tuple(tables)
        return found

    def noted_forecast(model, table):
        return made.setdefault((id(model), len(made)), forecast(model, table))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alfa, "identify", noted_identify)
        patch.setattr(alfa, "forecast", noted_forecast)
        yield TracedAnalysis(analyse_alfa_flight(), fitted_to, made)


def seen_before(traced: TracedAnalysis) -> list[float]:
    """End times [s] of held-out forecasts of which some row was in the fit of the model that made
    them.

    Which model made a forecast is found by its errors, to the last bit, not by the analysis's own
    bookkeeping.
    """
    held_out, table, seen = traced.analysis.held_out["model"], traced.analysis.table, []
    for k in range(len(held_out.t)):
        makers = [
            model
            for (model, _), all_of_it in traced.made.items()
            for row in np.flatnonzero(all_of_it.start == held_out.start[k])
            if np.array_equal(all_of_it.error_position[row], held_out.error_position[k])
        ]
        assert len(makers) == 1, (
            f"the forecast that ends at {held_out.t[k]} s was made by {len(makers)} models"
        )
        fitted = np.concatenate([stretch.t for stretch in traced.fitted_to[makers[0]]])
        first, last = table.t[held_out.start[k]], table.t[held_out.end[k]]
        if np.any((fitted >= first) & (fitted <= last)):
            seen.append(float(held_out.t[k]))
    return seen


def test_no_forecast_covers_time_that_its_model_was_fitted_to(traced):
    """Each of the four folds has its own model; start, end and all in between must be missing from
    its fit.
    """
    assert len(traced.fitted_to) == FOLDS + 1  # and one on everything before the failure
    assert seen_before(traced) == []


def test_planted_leak_is_seen(traced):
    """One fit gets a pose more at the end of a stretch, another the whole flight: forecasts from
    there are named.
    """
    first, second = list(traced.fitted_to)[1:3]  # after the fit to all before the failure
    table, stretches = traced.analysis.table, traced.fitted_to[second]
    edge = stretches[0].t[-1]  # a block that was kept back begins after it
    next_pose = table.t[table.has_pose & (table.t > edge)][0]
    spilled = (slice_time(table, 0.0, next_pose + 0.01), *stretches[1:])
    seen = seen_before(traced._replace(fitted_to={**traced.fitted_to, second: spilled}))
    assert seen == [pytest.approx(next_pose + 1.0, abs=0.25)]
    leaky = traced._replace(fitted_to={**traced.fitted_to, first: (table,)})
    assert len(seen_before(leaky)) == pytest.approx(
        len(traced.analysis.held_out["model"].t) / FOLDS, rel=0.1
    )


def test_held_out_forecasts_cover_the_flight_before_the_failure(traced):
    """A pose every 0.4 s for 116 s gives 290; a block of ten seconds loses one second of them:
    about 261.
    """
    held_out = traced.analysis.held_out["model"]
    assert len(held_out.t) == pytest.approx(116.0 / 0.4 * 0.9, rel=0.05)
    assert set(np.floor(held_out.t / BLOCK_S)) == set(range(12))
    assert held_out.t.max() < traced.analysis.failure_time


@pytest.mark.parametrize("guess", ["constant turn", "constant velocity"])
def test_model_beats_the_simple_guesses_on_time_it_has_not_seen(traced, guess):
    """Recorded data; the same forecasts are compared, and in ten of twelve blocks, which a coin
    does once in fifty.
    """
    model, other = traced.analysis.held_out["model"], traced.analysis.held_out[guess]
    assert np.array_equal(model.start, other.start) and np.array_equal(model.end, other.end)
    assert model.position_m < other.position_m
    assert model.attitude_deg < other.attitude_deg
    for name in ("error_position", "error_attitude"):
        ours, theirs = (np.sum(getattr(f, name) ** 2, axis=1) for f in (model, other))
        blocks = np.floor(model.t / BLOCK_S)
        assert sum(ours[blocks == b].mean() < theirs[blocks == b].mean() for b in range(12)) >= 10


def test_constant_velocity_is_what_it_says(traced):
    """Straight on from the logged pose with the logged velocity, worked out here from the table's
    columns.
    """
    table, guess = traced.analysis.table, traced.analysis.held_out["constant velocity"]
    v_world = np.stack([table.extra[name] for name in ("vx", "vy", "vz")], axis=1)
    span = (table.t[guess.end] - table.t[guess.start])[:, None]
    expected = table.p_world[guess.start] + span * v_world[guess.start] - table.p_world[guess.end]
    assert guess.error_position == pytest.approx(expected, abs=1e-9)  # rounding of metres
    assert span == pytest.approx(
        1.0, abs=0.25
    )  # poses come every 0.4 s, so a second is met to half of that


def test_constant_turn_is_no_straw_man(traced):
    """In a bank of more than 30 deg it must be far better than going straight: half the error,
    recorded data.
    """
    held_out, table = traced.analysis.held_out, traced.analysis.table
    turning = np.abs(table.attitude[held_out["model"].start, 0]) > np.radians(30.0)
    assert turning.sum() > 40
    turn, straight = (
        held_out[name].subset(turning).position_m for name in ("constant turn", "constant velocity")
    )
    assert turn < 0.5 * straight


def test_failure_time_is_when_the_logged_throttle_closes(traced):
    """The failure status and the throttle's servo are two topics of the log, the second sampled
    every 0.35 s.
    """
    table, failure = traced.analysis.table, traced.analysis.failure_time
    closed = table.t[np.flatnonzero(table.commands[:, 0] > 0.2)[-1]]
    assert closed == pytest.approx(failure, abs=0.5)
    assert np.all(table.commands[table.t > failure + 0.7, 0] == 0.0)


def test_healthy_forecasts_part_from_the_measurement_after_the_failure(traced):
    """They leave what 104 healthy seconds showed; recorded: the aircraft slows from 18 to 10 m/s in
    the last 16 s.
    """
    analysis = traced.analysis
    assert analysis.detection_time is not None
    assert analysis.failure_time < analysis.detection_time < analysis.table.t[-1]
    t, along = analysis.along_track["nominal"]
    assert (
        along[t == analysis.detection_time].max() > analysis.nominal_error
    )  # ahead, for the real one has lost its thrust
    held_out_t, ordinary = analysis.along_track["held out"]
    assert np.abs(ordinary[held_out_t > 14.0]).max() == analysis.nominal_error
    assert np.all(
        np.abs(along[(t > analysis.failure_time) & (t < analysis.detection_time)])
        <= analysis.nominal_error
    )


def test_model_that_is_told_the_throttle_is_nearer_than_the_one_that_is_not(traced):
    """The only difference is the throttle after the failure: where it is known, the thrust is known
    to be gone.
    """
    analysis = traced.analysis
    after = (
        analysis.logged.t > analysis.failure_time + 1.5
    )  # the whole second ahead lies after the failure
    logged_error, nominal_error = (
        f.subset(after).position_m for f in (analysis.logged, analysis.nominal)
    )
    assert logged_error < 0.75 * nominal_error  # 1.0 against 1.7 m measured
    before = analysis.logged.t < analysis.failure_time
    assert np.array_equal(
        analysis.logged.error_position[before], analysis.nominal.error_position[before]
    )


def test_held_throttle_is_the_mean_of_twenty_seconds(traced):
    """Worked out here from the table: cruise throttle, between a third and a half of full."""
    table, failure = traced.analysis.table, traced.analysis.failure_time
    expected = table.commands[(table.t >= failure - 20.0) & (table.t < failure), 0].mean()
    assert traced.analysis.fixed_throttle == pytest.approx(expected, abs=1e-12)
    assert 0.3 < traced.analysis.fixed_throttle < 0.5


def test_final_model_does_not_know_the_failure(traced):
    """What the first of the five fits was given ends before the engine does."""
    (everything,) = next(iter(traced.fitted_to.values()))
    assert everything.t[-1] < traced.analysis.failure_time
    assert np.array_equal(
        everything.p_world,
        slice_time(traced.analysis.table, 0.0, everything.t[-1] + 0.01).p_world,
        True,
    )


def test_model_that_is_told_stays_within_what_is_ordinary(traced):
    """So it is the engine that parts the other one from the measurement, and not the slow flight
    after it.
    """
    analysis = traced.analysis
    t, along = analysis.along_track["logged"]
    assert np.all(np.abs(along[t > analysis.failure_time]) < analysis.nominal_error)
