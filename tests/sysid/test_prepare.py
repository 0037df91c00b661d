"""Preparing: noise, outliers, gaps and turns against simulated and recorded facts."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.prepare import (
    CHANNELS,
    difference_noise,
    interpolate_slow_sticks,
    prepare,
    thin_table,
)
from tests.sysid.recorded import calm_flight

SIGMA = np.array([0.03] * 3 + [np.radians(0.6)] * 3)


@pytest.fixture
def rng():
    return np.random.default_rng(21)


def path(t):
    """(N, 6) smooth poses: circles of 5 m in 4.5 s, up and down, yaw increasing."""
    circling = 1.4 * t
    return np.column_stack([
        5.0 * np.sin(circling), 5.0 * np.cos(circling), 2.0 + 0.5 * np.sin(0.9 * t),
        0.7 + 0.2 * np.sin(2.0 * t), 0.1 + 0.1 * np.sin(3.0 * t), circling,
    ])  # fmt: skip


def table(t, pose, commands=None, **columns):
    """A flight table; yaw wrapped into -pi..pi as of every camera."""
    attitude = (pose[:, 3:] + np.pi) % (2.0 * np.pi) - np.pi
    sticks = np.tile([0.5, 0.0, 0.1, 0.0], (len(t), 1)) if commands is None else commands
    return FlightTable("made", t, pose[:, :3], attitude, sticks, columns)


def noisy(rng, seconds=60.0, sigma=SIGMA):
    t = np.arange(round(seconds * 20) + 1) * 0.05
    return t, path(t) + sigma * rng.normal(size=(len(t), 6))


# Noise


@pytest.mark.parametrize("sigma", [0.003, 0.03, 0.3])
def test_noise_on_a_smooth_curve_is_found(rng, sigma):
    """The simulated value; a median of 20,000 correlated differences scatters by 1.3 %, so 5 % is 4
    sigma.
    """
    t = np.arange(20_000) * 0.05
    found = difference_noise(path(t) + rng.normal(0.0, sigma, (len(t), 6)))
    assert found == pytest.approx(np.full(6, sigma), rel=0.05)


def test_outliers_hardly_raise_the_noise(rng):
    """By hand: one outlier in a hundred affects 5 % of the fourth differences, so the median of the
    others' sizes is taken at 0.5/0.95 = 52.6 %: 0.716 against 0.674 sigma, 6 % more. Without
    robustness it would be 30 times more.
    """
    t = np.arange(20_000) * 0.05
    samples = path(t) + rng.normal(0.0, 0.03, (len(t), 6))
    samples[50::100] += 10.0
    assert difference_noise(samples) == pytest.approx(np.full(6, 0.03 * 1.06), rel=0.05)


def test_correlated_noise_is_mostly_not_included(rng):
    """Closed form: of AR(1) with correlation a = exp(-0.1) the fourth difference keeps (70 - 112 a
    + 56 a^2 - 16 a^3 + 2 a^4) / 70 = 5.7 % of the variance, so 24 % of the sigma.
    """
    a = np.exp(-0.1)
    slow = np.zeros((40_000, 1))
    for k in range(1, len(slow)):
        slow[k] = a * slow[k - 1] + np.sqrt(1.0 - a * a) * rng.normal()
    kept = np.sqrt((70 - 112 * a + 56 * a**2 - 16 * a**3 + 2 * a**4) / 70)
    assert kept == pytest.approx(0.24, abs=0.005)
    assert difference_noise(slow)[0] == pytest.approx(kept, rel=0.05)


@pytest.mark.parametrize("case", ["case01", "case02", "case03"])
def test_noise_of_recorded_flights_is_that_of_their_readme(case):
    """JSBSim's flights: white 3 cm and 0.6 deg; 0.5 % outliers add 3 %, fast motion some more."""
    found = prepare(calm_flight(case)).sigma
    assert found[:3].mean() == pytest.approx(0.03, rel=0.1)
    assert np.degrees(found[3:].mean()) == pytest.approx(0.6, rel=0.1)


def test_given_noise_is_used_before_logged_before_estimated(rng):
    """An argument goes before the table's columns, these before the estimate."""
    t, pose = noisy(rng)
    plain = table(t, pose)
    logged = table(
        t, pose, sigma_position=np.full(len(t), 0.05), sigma_attitude=np.full(len(t), 0.02)
    )
    assert prepare(plain).sigma == pytest.approx(SIGMA, rel=0.2)
    assert prepare(logged).sigma == pytest.approx([0.05] * 3 + [0.02] * 3, rel=1e-12)
    assert prepare(logged, np.full(6, 0.07)).sigma == pytest.approx(np.full(6, 0.07), rel=1e-12)
    unknown = replace(logged, extra={**logged.extra, "sigma_attitude": np.full(len(t), np.nan)})
    assert prepare(unknown).sigma == pytest.approx(SIGMA, rel=0.2)


def test_perfect_poses_still_have_some_noise():
    """Weights must be finite: at least 1 mm and 1 mrad."""
    t = np.arange(400) * 0.05
    assert prepare(
        table(t, np.tile([1.0, 2.0, 3.0, 0.1, 0.2, 0.3], (400, 1)))
    ).sigma == pytest.approx(np.full(6, 1e-3))


# Outliers


def test_poses_off_by_metres_are_removed_and_good_ones_kept(rng):
    """Simulated: 1 % of the positions 1 to 5 m off, another 1 % of the attitudes 30 to 90 deg off,
    three of them in a row. All must go, and at most 1 % of the good halves.
    """
    t, pose = noisy(rng, 120.0)
    rows = rng.permutation(len(t))[:48]
    off_position, off_attitude = np.append(rows[:24], [700, 701, 702]), rows[24:]
    away = rng.normal(size=(27, 3))
    pose[off_position, :3] += (
        away / np.linalg.norm(away, axis=1, keepdims=True) * rng.uniform(1.0, 5.0, (27, 1))
    )
    turned = np.zeros((24, 3))
    turned[np.arange(24), rng.integers(0, 3, 24)] = rng.choice([-1, 1], 24) * np.radians(
        rng.uniform(30.0, 90.0, 24)
    )
    pose[off_attitude, 3:] += turned
    done = prepare(table(t, pose))
    kept = np.isfinite(done.flights[0].pose)
    assert not kept[off_position, :3].any() and not kept[off_attitude, 3:].any()
    good = np.ones((len(t), 2), bool)
    good[off_position, 0] = good[off_attitude, 1] = False
    lost = good & ~kept[:, [0, 3]]
    assert lost.sum() <= 0.01 * good.sum()
    assert done.outliers == (~kept[:, 0] | ~kept[:, 3]).sum() and done.warnings == ()


def test_a_clean_flight_loses_nothing(rng):
    """Six sigmas: of 14,400 Gaussian numbers 3e-5 are expected beyond; two rows for the cubics'
    misfit.
    """
    assert prepare(table(*noisy(rng, 120.0))).outliers <= 2


def test_many_outliers_give_a_warning(rng):
    """Above 5 % the poses themselves are the problem."""
    t, pose = noisy(rng, 60.0)
    rows = rng.permutation(len(t))[: len(t) // 10]
    pose[rows, :3] += rng.normal(0.0, 3.0, (len(rows), 3))
    done = prepare(table(t, pose))
    assert done.outliers > 0.08 * len(t)
    assert any("outliers" in sentence for sentence in done.warnings)


def test_half_a_turn_more_is_not_an_outlier(rng):
    """Yaw crosses pi every few seconds; wrapped or not it is the same pose."""
    t, pose = noisy(rng)
    assert np.abs(np.diff(table(t, pose).attitude[:, 2])).max() > 6.0
    assert prepare(table(t, pose)).outliers <= 2


# Turns


def test_yaw_is_unwrapped_past_outliers(rng):
    """The path turns by 84 rad; yaw follows up to whole turns, also past three reversed poses."""
    t, pose = noisy(rng)
    truth = path(t)[:, 5]
    pose[[300, 301, 700], 5] += np.pi - 0.2
    flight = prepare(table(t, pose)).flights[0]
    turns = (flight.pose[:, 5] - truth) / (2.0 * np.pi)
    measured = np.isfinite(turns)
    assert np.abs(turns[measured] - np.round(turns[0])).max() < 0.02  # six sigmas of noise
    assert not measured[[300, 301, 700]].any() and measured.sum() >= len(t) - 5
    assert (
        np.abs(flight.state_estimate[:, 4] - truth - 2.0 * np.pi * np.round(turns[0])).max() < 0.1
    )


# Rows


def test_single_missing_frames_become_empty_rows(rng):
    """20 Hz without rows 100, 200, 201: they are inserted without a pose, with the previous
    command.
    """
    t, pose = noisy(rng, 30.0)
    commands = np.column_stack([np.arange(len(t)) / len(t)] * 4)
    kept = np.delete(np.arange(len(t)), [100, 200, 201])
    done = prepare(table(t[kept], pose[kept], commands[kept]))
    flight = done.flights[0]
    assert flight.t == pytest.approx(t, abs=1e-9)
    assert np.flatnonzero(np.isnan(flight.pose).any(axis=1)).tolist() == [100, 200, 201]
    assert flight.commands[[100, 200, 201]] == pytest.approx(commands[[99, 199, 199]])
    assert (done.missing, done.outliers) == (3, 0)


@pytest.mark.parametrize(("removed", "pieces"), [(4, 1), (5, 2)])
def test_a_long_gap_cuts_the_flight(rng, removed, pieces):
    """Four lost frames are a step of 0.25 s, still one flight; five are 0.3 s with unknown
    commands.
    """
    t, pose = noisy(rng, 30.0)
    kept = np.delete(np.arange(len(t)), np.arange(300, 300 + removed))
    done = prepare(table(t[kept], pose[kept]))
    assert [f.name for f in done.flights] == (["made"] if pieces == 1 else ["made#0", "made#1"])
    assert max(np.diff(f.t).max() for f in done.flights) < 0.0501
    assert sum(len(f.t) for f in done.flights) == (len(t) if pieces == 1 else len(kept))


def test_a_segment_shorter_than_three_seconds_is_dropped(rng):
    """2 s between two gaps are too short for a window with known commands."""
    t, pose = noisy(rng, 30.0)
    kept = (t < 12.0) | ((t > 13.0) & (t < 15.0)) | (t > 16.0)
    done = prepare(table(t[kept], pose[kept]))
    assert [(round(f.t[0], 2), round(f.t[-1], 2)) for f in done.flights] == [
        (0.0, 11.95),
        (16.05, 30.0),
    ]


@pytest.mark.parametrize(
    "case", ["two seconds", "no pose at all", "no pose in most rows", "gaps everywhere"]
)
def test_a_flight_that_cannot_be_used_is_refused_in_a_sentence(rng, case):
    """The sentence has the flight's name, expected and got."""
    t, pose = noisy(rng, 2.0 if case == "two seconds" else 20.0)
    if case == "no pose at all":
        pose[:] = np.nan
    elif case == "no pose in most rows":
        pose[9:] = np.nan
    elif case == "gaps everywhere":
        kept = np.arange(len(t)) % 40 < 30
        t, pose = t[kept], pose[kept]
    with pytest.raises(
        InputError, match=r"^made: expected at least 3 s of poses .*; \d+ of \d+ rows have no pose$"
    ):
        prepare(table(t, pose))


# The local estimate of the state


def test_local_slope_is_as_sharp_as_theory_allows(rng):
    """Least squares by NumPy's pseudo-inverse: the slope of a cubic through 13 samples has sigma
    0.19 sigma/dt, 0.114 m/s for 3 cm (raw differences 0.85). Robust weights and curvature may add a
    quarter.
    """
    t, pose = noisy(rng, 120.0)
    s = np.arange(-6, 7) * 0.05
    theory = np.linalg.norm(np.linalg.pinv(np.vander(s, 4, increasing=True))[1]) * 0.03
    assert theory == pytest.approx(0.114, rel=0.01)
    found = prepare(table(t, pose)).flights[0].state_estimate[20:-20, 6:9]
    truth = (path(t + 1e-6) - path(t - 1e-6))[20:-20, :3] / 2e-6
    assert (found - truth).std(axis=0) == pytest.approx(np.full(3, theory), rel=0.25)


def test_local_state_of_a_banked_turn():
    """Kinematics of a level turn by hand: p = 0, q = yaw' sin(roll), r = yaw' cos(roll),
    centripetal acceleration v^2 / radius. Noiseless, so only the cubic's misfit is left: 1e-3.
    """
    t = np.arange(400) * 0.05
    roll, turn = 0.6, 1.2
    pose = np.column_stack([
        5.0 * np.sin(turn * t), 5.0 * np.cos(turn * t), 0 * t + 2.0, 0 * t + roll, 0 * t, turn * t
    ])  # fmt: skip
    flight = prepare(table(t, pose)).flights[0]
    middle = flight.state_estimate[20:-20]
    expected = [0.0, turn * np.sin(roll), turn * np.cos(roll)]
    assert np.abs(middle[:, 9:] - expected).max() < 1e-3
    assert np.linalg.norm(middle[:, 6:9], axis=1) == pytest.approx(
        np.full(len(middle), 6.0), rel=1e-3
    )
    inward = -flight.state_derivatives[20:-20, 6:8] / (5.0 * turn**2)
    assert inward == pytest.approx(pose[20:-20, :2] / 5.0, abs=0.02)


def test_logged_velocities_are_taken_where_there_are_some(rng):
    """The log's own numbers, and derivatives in rows without them."""
    t, pose = noisy(rng)
    logged = {
        name: np.full(len(t), 10.0 + i) for i, name in enumerate(("vx", "vy", "vz", "p", "q", "r"))
    }
    logged["vy"][50:60] = np.nan
    plain = prepare(table(t, pose)).flights[0].state_estimate
    found = prepare(table(t, pose, **logged)).flights[0].state_estimate
    expected = np.tile(np.arange(10.0, 16.0), (len(t), 1))
    expected[50:60, 1] = plain[50:60, 7]
    assert np.array_equal(found[:, 6:], expected)
    assert np.array_equal(found[:, :6], plain[:, :6])


def test_velocities_differentiated_from_noisy_poses_are_not_taken(rng):
    """Differences of poses with 3 cm of noise err by 0.03 sqrt(2) / 0.05 = 0.85 m/s, local cubics
    by 0.11: the state is the one without these columns, where velocities err by 0.1 m/s they stay.
    """
    t, pose = noisy(rng)
    slope = np.diff(pose, axis=0, append=pose[-1:]) / 0.05
    names = ("vx", "vy", "vz")
    plain = prepare(table(t, pose)).flights[0].state_estimate
    noisier = table(t, pose, **dict(zip(names, slope[:, :3].T, strict=True)))
    np.testing.assert_array_equal(prepare(noisier).flights[0].state_estimate, plain)
    measured = plain[:, 6:9] + 0.1 * rng.normal(size=(len(t), 3))
    usable = table(t, pose, **dict(zip(names, measured.T, strict=True)))
    np.testing.assert_array_equal(prepare(usable).flights[0].state_estimate[:, 6:9], measured)


def test_channels_are_positions_then_roll_pitch_yaw(rng):
    """The order of all pose arrays; the state has pitch, yaw, roll."""
    t, pose = noisy(rng, 10.0, SIGMA * 1e-3)
    flight = prepare(table(t, pose)).flights[0]
    assert CHANNELS == ("px", "py", "pz", "roll", "pitch", "yaw")
    assert flight.pose == pytest.approx(pose, abs=1e-9)
    assert flight.state_estimate[20:-20, :6] == pytest.approx(
        pose[20:-20][:, [0, 1, 2, 4, 5, 3]], abs=2e-3
    )


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_other_frame_rates(rng, rate_hz):
    """Noise and poses are the same at 10 and 50 frames a second."""
    t = np.arange(round(60 * rate_hz)) / rate_hz
    done = prepare(table(t, path(t) + SIGMA * rng.normal(size=(len(t), 6))))
    assert done.sigma == pytest.approx(SIGMA, rel=0.2)
    assert done.outliers <= 2


# Fast logs


def test_a_fast_log_is_thinned_with_its_mean_commands(rng):
    """60 Hz to 30: every second pose as it is; of each pair of commands the mean, as long as both
    acted. 20 Hz stays.
    """
    t = np.arange(600) / 60.0
    sticks = rng.uniform(-1.0, 1.0, (600, 4))
    fast = table(t, path(t), sticks, marker=np.arange(600.0))
    thin = thin_table(fast)
    assert thin.t == pytest.approx(t[::2])
    np.testing.assert_array_equal(thin.p_world, fast.p_world[::2])
    np.testing.assert_allclose(thin.commands, 0.5 * (sticks[::2] + sticks[1::2]))
    np.testing.assert_array_equal(thin.extra["marker"], np.arange(0.0, 600.0, 2.0))
    slow = table(np.arange(200) / 20.0, path(np.arange(200) / 20.0))
    assert thin_table(slow) is slow


@pytest.mark.parametrize("rate_hz", [20.0, 100.0])
def test_sticks_read_less_often_than_poses_lie_on_lines(rate_hz):
    """A sine of 0.5 Hz read every 0.1 s and held: late by 0.05 s on average, so wrong by up to
    2 pi 0.5 0.05 = 0.16. Lines between the readings err by at most (2 pi 0.5 0.1)^2 / 8 = 0.012.
    """
    t = np.arange(0.0, 30.0, 1.0 / rate_hz)
    held = np.floor(t * 10.0 + 1e-6) / 10.0
    flight = table(t, path(t), np.sin(np.pi * held)[:, None] * [0.0, 1.0, 1.0, 0.0])
    read = interpolate_slow_sticks(flight)
    inside = t < 29.8
    assert np.abs(flight.commands[:, 1] - np.sin(np.pi * t))[inside].max() > 0.12
    assert np.abs(read.commands[:, 1] - np.sin(np.pi * t))[inside].max() < 0.013
    assert np.all(read.commands[:, [0, 3]] == 0.0)


def test_steps_that_are_held_on_purpose_stay(rng):
    """3-2-1-1 steps of 0.3 s, and a command that a computer gives anew in every row."""
    t = np.arange(0.0, 60.0, 0.05)
    pattern = np.repeat([1.0, -1.0, 1.0, -1.0], [18, 12, 6, 6])
    steps = np.tile(pattern, 1 + len(t) // len(pattern))[: len(t)]
    for stick in (steps, rng.uniform(-1.0, 1.0, len(t))):
        flight = table(t, path(t), stick[:, None] * [0.0, 1.0, 0.0, 0.0])
        assert interpolate_slow_sticks(flight) is flight
