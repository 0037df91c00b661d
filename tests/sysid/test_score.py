"""Scores: chi2 and metres by hand, held-out blocks by counting."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.score import (
    score,
    score_constant_turn,
    score_residual,
    split_blocks,
)
from falconwing_kit.sysid.shooting import cut_windows, fly_windows, residuals, select_windows
from tests.sysid.simulated import MARKER, drawn, fly_figure_eights, measured

SIGMA = np.array([MARKER[0]] * 3 + [MARKER[1]] * 3)


@pytest.fixture(scope="module")
def flight():
    """Two minutes with white noise of known size: the aircraft and its windows."""
    rng = np.random.default_rng(41)
    truth = drawn(rates_model(), rng)
    table = measured(fly_figure_eights([truth], 120.0, rng), rng, missing=0.02)
    return truth, cut_windows(prepare(table, SIGMA).flights, truth)


def test_the_true_aircraft_scores_one(flight):
    """Only the known noise is left: chi2 per degree of freedom is 1 within four standard errors, in
    all and, with a sixth of the numbers, in each channel.
    """
    truth, windows = flight
    found = score(truth, windows)
    freedom = windows.count - 12 * len(windows)
    assert found.chi2 == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / freedom))
    assert found.channels == pytest.approx(np.ones(6), abs=8.0 * np.sqrt(12.0 / freedom))
    assert found.channels.mean() == pytest.approx(found.chi2, rel=0.01)
    assert found.windows == len(windows) == 59


def test_metres_and_degrees_are_those_of_the_noise(flight):
    """By hand: 3 cm per axis is a distance of sqrt(3) 3 cm, 0.6 deg per angle is 0.6 deg, slightly
    less because initial states are fitted (12 of 240 numbers a window).
    """
    truth, windows = flight
    found = score(truth, windows)
    less = np.sqrt(1.0 - 12.0 / 240.0)
    assert found.position_m == pytest.approx(np.sqrt(3.0) * 0.03 * less, rel=0.03)
    assert found.attitude_deg == pytest.approx(0.6 * less, rel=0.03)


def test_missing_poses_do_not_count(flight):
    """Half of the poses removed: the same chi2; removed poses have no residual."""
    truth, windows = flight
    factor = np.ones_like(windows.weight)
    factor[:, ::2] = 0.0
    thinned = windows.scale_weights(factor)
    found = score(truth, thinned)
    freedom = thinned.count - 12 * len(windows)
    assert found.chi2 == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / freedom))
    assert (found.residual[thinned.weight == 0.0] == 0.0).all()


def test_noise_taken_twice_as_large_scores_a_quarter(flight):
    """chi2 scales with one over sigma squared; metres do not change."""
    truth, windows = flight
    once, twice = (
        score(truth, windows),
        score(truth, windows.scale_weights(np.full_like(windows.weight, 0.5))),
    )
    assert twice.chi2 == pytest.approx(0.25 * once.chi2, rel=0.01)
    assert twice.position_m == pytest.approx(once.position_m, rel=0.01)


def test_a_wrong_aircraft_scores_worse(flight):
    """10 % less pitch stiffness, 5 % less roll control, partly hidden by the initial states."""
    truth, windows = flight
    wrong = truth.with_values(
        {"M_alpha": 0.9 * truth.values["M_alpha"], "L_da": 0.95 * truth.values["L_da"]}
    )
    assert score(wrong, windows).chi2 > 2.0 * score(truth, windows).chi2


def test_residuals_belong_to_the_fitted_initial_states(flight):
    """Flying from `initial_states` gives `residual`."""
    truth, windows = flight
    found = score(truth, windows)
    poses = fly_windows(truth, windows, found.initial_states)
    difference = poses - windows.pose
    difference[..., 5] -= 2.0 * np.pi * np.round(difference[..., 5] / (2.0 * np.pi))
    assert found.residual == pytest.approx(difference * windows.weight, abs=1e-6)
    again = score(truth, windows, found.initial_states)
    assert again.chi2 == pytest.approx(found.chi2, rel=1e-3)


# What is held out


def windows_at(initial_states, flight=None):
    """Windows of 2 s that begin at these times, otherwise empty."""
    nodes = np.asarray(initial_states, float)[:, None] + np.arange(40) * 0.05
    empty = np.zeros((len(nodes), 1))
    number = np.zeros(len(nodes), int) if flight is None else np.asarray(flight)
    from falconwing_kit.sysid.shooting import Windows

    return Windows(nodes, empty, empty, empty, 0, 2, number, (), empty)


def test_held_out_blocks_by_hand():
    """120 s from 0.5 s on: twelve blocks of five windows; the fourth, seventh and tenth are held
    out.
    """
    windows = windows_at(0.5 + 2.0 * np.arange(60))
    fitted, kept = split_blocks(windows)
    assert kept.tolist() == [*range(15, 20), *range(30, 35), *range(45, 50)]
    assert sorted([*fitted, *kept]) == list(range(60))


def test_neighbours_of_held_out_time_are_whole_blocks(flight):
    """No block of 10 s has windows on both sides: neighbouring samples are correlated."""
    _, windows = flight
    fitted, kept = split_blocks(windows)
    block = ((windows.nodes[:, 0] - windows.nodes[0, 0]) // 10.0).astype(int)
    assert not set(block[fitted]) & set(block[kept])
    assert 0.2 < len(kept) / len(windows) < 0.4


def test_a_short_flight_has_nothing_to_hold_out():
    """30 s: three blocks of which three in ten are none."""
    fitted, kept = split_blocks(windows_at(0.5 + 2.0 * np.arange(15)))
    assert (len(fitted), len(kept)) == (15, 0)


def test_select_takes_all_fields_of_a_window(flight):
    """The residuals of selected windows are the selected residuals."""
    truth, windows = flight
    index = np.array([3, 30, 7])
    chosen = select_windows(windows, index)
    assert len(chosen) == 3
    whole = residuals(truth, windows, windows.initial_guess)
    assert residuals(truth, chosen, chosen.initial_guess) == pytest.approx(whole[index], abs=1e-9)
    moved = replace(windows, nodes=windows.nodes + 100.0)
    assert select_windows(moved, index).nodes[0, 0] == pytest.approx(windows.nodes[3, 0] + 100.0)


def test_a_coordinated_turn_is_forecast_by_the_constant_turn():
    """A circle of 7 m/s at 30 deg of bank: yaw rate g tan(30 deg) / 7, to the right; left over is
    what the local cubics make of the initial states.
    """
    t, bank = np.arange(0.0, 20.0, 0.05), np.radians(30.0)
    yaw_rate = GRAVITY * np.tan(bank) / 7.0
    yaw = yaw_rate * t
    radius = 7.0 / yaw_rate
    place = np.column_stack([radius * np.sin(yaw), radius * np.cos(yaw), 2.0 + 0.0 * t])
    angles = np.column_stack([bank + 0.0 * t, 0.0 * t, (yaw + np.pi) % (2.0 * np.pi) - np.pi])
    circle = FlightTable("circle", t, place, angles, np.tile([0.5, 0.1, 0.1, 0.0], (len(t), 1)))
    windows = cut_windows(prepare(circle, SIGMA).flights, rates_model())
    found = score_constant_turn(windows, windows.initial_guess)
    assert found.position_m < 0.02 and found.attitude_deg < 0.2
    straight = windows.initial_guess.copy()
    straight[:, 5] = 0.0  # wings level: straight on, off by (2 s)^2 / 2 of 5.7 m/s^2 at the end
    assert score_constant_turn(windows, straight).position_m > 2.0


def test_a_window_that_diverges_keeps_the_score_finite(flight):
    """By hand: residuals of one, but for a window of 120 that overflows and ten that are far off:
    its 120 and these ten count as 1e4 each, as chi2 of all measured components.
    """
    truth, windows = flight
    windows = windows.scale_weights(np.ones_like(windows.weight))
    residual = np.where(windows.weight > 0.0, 1.0, np.nan)  # where nothing was measured: no number
    residual[3], residual[5].flat[:10] = np.inf, -1e7
    measured_there = np.count_nonzero(windows.weight[3])
    far = measured_there + np.count_nonzero(windows.weight[5].flat[:10])
    found = score_residual(windows, np.zeros((len(windows), 12)), residual)
    squares = windows.count - far + far * 1e8
    assert found.chi2 == pytest.approx(squares / (windows.count - 12 * len(windows)))
    assert np.isfinite([found.position_m, found.attitude_deg, *found.channels]).all()
    assert found.diverged == 2
    assert score(truth, windows).diverged == 0
