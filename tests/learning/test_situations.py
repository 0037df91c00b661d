"""Situations: what a seed draws stays in its ranges, is repeatable, and is what flies."""

import math
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.loops import SPEED
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.core.messages import State
from falconwing_kit.learning.situations import (
    KEPT,
    MOMENTS,
    NOMINAL,
    SHARED,
    SPREAD_RANGES,
    draw_delivery,
    draw_situation,
    gusty_wind,
)

MOUNT = np.array([0.2, 0.0, 0.0])


def landing(seed, ranges=SPREAD_RANGES):
    return draw_situation("landing", seed, ranges, MOUNT)


def test_the_nominal_situation_is_the_kits_aircraft_in_still_air():
    """Every value, the camera on the nose along it, and each frame at once."""
    situation, kit = landing(3, NOMINAL), rates_model()
    assert {name: situation.model.values[name] for name in kit.values} == pytest.approx(kit.values)
    assert [situation.model.values[name] for name in ("mean_wind_x", "mean_wind_y")] == [0.0, 0.0]
    assert situation.delay == 0.05
    # camera axes in body axes: right wing, belly, nose [DESIGN, conventions]
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), MOUNT
    assert situation.T_body_camera == pytest.approx(expected, abs=1e-12)
    assert np.array_equal(situation.newest, np.arange(len(situation.newest)))
    assert not situation.black.any()


def test_draws_stay_in_their_ranges_and_fill_them():
    """Over 200 flights, of which four have one aircraft; factors of moments: see below."""
    ranges = replace(SPREAD_RANGES, moments=(0.0, 0.0), derivatives=0.0)
    situations = [landing(seed, ranges) for seed in range(200)]
    kit = rates_model().values
    shares = np.array(
        [
            [
                s.model.values[name] / kit[name] - 1.0
                for name in kit
                if name not in KEPT and kit[name]
            ]
            for s in situations
        ]
    )
    assert np.abs(shares).max() <= 0.25 + 1e-9
    assert np.abs(shares).max(axis=0).min() > 0.15
    winds = [math.hypot(s.model.values["mean_wind_x"], s.model.values["mean_wind_y"])
             for s in situations]  # fmt: skip
    assert 0.8 < max(winds) <= 1.2
    delays = [s.delay for s in situations]
    assert 0.0 <= min(delays) < 0.05 and 0.15 < max(delays) <= 0.23
    mounts = np.array([s.p_body_camera for s in situations])
    assert mounts[:, 0].min() >= 0.0 and 0.2 < mounts[:, 0].max() <= 0.25
    places = np.array([s.start.p_world for s in situations])
    assert Hall().margin(places).min() > 0.5
    assert len({s.model.values["cL_alpha"] for s in situations}) == 50


def test_an_aircraft_of_half_the_inertia_has_twice_the_moments_and_the_same_trim():
    """Euler's equation: an angular acceleration is moment over inertia, for all moments about an
    axis; those that balanced still do, and no force changes.
    """
    halved = replace(NOMINAL, moments=(math.log(2.0),) * 2)
    found, kit = landing(3, halved).model.values, rates_model().values
    rolls_pitches_yaws = {name for name in kit if name[:2] in ("L_", "M_", "N_")}
    assert rolls_pitches_yaws - {"L_0", "N_0"} == {name for row in MOMENTS.values() for name in row}
    for name, value in kit.items():
        assert found[name] == pytest.approx(value * (2.0 if name in rolls_pitches_yaws else 1.0))


def test_moments_about_an_axis_share_a_factor_and_derivatives_have_one_of_their_own():
    """Over 200 aircraft: each axis in its range and over most of it, and each derivative within
    the other range of that; a moment at rest has the axis's factor alone, or trim would be lost.
    """
    ranges = replace(NOMINAL, moments=(-0.35, 1.25), derivatives=0.5)
    aircraft = [landing(SHARED * seed, ranges).model.values for seed in range(200)]
    kit = rates_model().values
    for row in MOMENTS.values():
        logs = np.log([[values[name] / kit[name] for name in row] for values in aircraft])
        assert -0.85 - 1e-9 <= logs.min() < -0.6 and 1.5 < logs.max() <= 1.75 + 1e-9
        assert 0.9 < np.ptp(logs, axis=1).max() <= 1.0 + 1e-9
    at_rest = np.log([values["M_0"] / kit["M_0"] for values in aircraft])
    assert -0.35 <= at_rest.min() < -0.25 and 1.15 < at_rest.max() <= 1.25


def test_starts_move_with_any_share_of_the_wind():
    """A start's velocity is s R v - u w: v of the trimmed flight in the wind w, turned with the
    nose, s of its speed, u in 0 to 1: each end for a quarter of the starts, uniform for the others.
    Three equations for s and u, so one is left to check.
    """
    ranges, shares = replace(NOMINAL, mean_wind=1.2), []
    for seed in range(0, 800, SHARED):
        situation = landing(seed, ranges)
        model, start = situation.known_model, situation.start
        wind = np.array([model.values["mean_wind_x"], model.values["mean_wind_y"], 0.0])
        steady = State.from_vector(trim(model, SPEED).state)
        R_steady = rotation_world_body(0.0, steady.pitch, 0.0)
        R_start = rotation_world_body(start.roll, start.pitch, start.yaw)
        turned = R_start @ R_steady.T @ steady.v_world
        A = np.column_stack([turned, -wind])
        (speed, share), *_ = np.linalg.lstsq(A, start.v_world)
        assert A @ (speed, share) == pytest.approx(start.v_world, abs=1e-6)
        assert 0.8 < speed < 1.2 and -1e-6 < share < 1.0 + 1e-6
        shares.append(share)
    quarter = 3.0 * math.sqrt(0.25 * 0.75 / len(shares))
    assert np.mean(np.array(shares) < 1e-6) == pytest.approx(0.25, abs=quarter)
    assert np.mean(np.array(shares) > 1.0 - 1e-6) == pytest.approx(0.25, abs=quarter)
    between = [share for share in shares if 1e-6 < share < 1.0 - 1e-6]
    assert np.mean(between) == pytest.approx(0.5, abs=3.0 / math.sqrt(12 * len(between)))


def test_graded_ranges_ease_half_of_the_aircraft():
    """Of a wind uniform in 0 to s W, s = 1 for half of them and uniform in 0 to 1 for the others,
    a share of 1/4 + (1 - ln 2) / 4 = 0.327 is over W / 2; without grades it is half of them.
    """
    winds = []
    for shared in range(400):
        values = landing(SHARED * shared).known_model.values
        winds.append(math.hypot(values["mean_wind_x"], values["mean_wind_y"]))
    share = np.mean(np.array(winds) > SPREAD_RANGES.mean_wind / 2.0)
    assert share == pytest.approx(0.327, abs=3.0 * math.sqrt(0.327 * 0.673 / 400))


def test_eased_to_nothing_is_the_kits_aircraft_and_eased_by_one_is_unchanged():
    """The aircraft and its air; not the camera's place, which the pilot is told, nor its link."""
    easy = SPREAD_RANGES.eased(0.0)
    names = ("coefficients", "moments", "derivatives", "trim", "mean_wind", "gusts", "mount_angle")
    assert all(getattr(easy, name) == getattr(NOMINAL, name) for name in names)
    kept = ("mount", "delay", "long_delay")
    assert all(getattr(easy, name) == getattr(SPREAD_RANGES, name) for name in kept)
    assert SPREAD_RANGES.eased(1.0) == SPREAD_RANGES


def test_a_seed_repeats_and_another_does_not():
    """All of the numbers of a situation."""
    first, again, other = landing(7), landing(7), landing(8)
    assert np.array_equal(first.start.vector, again.start.vector)
    assert np.array_equal(first.newest, again.newest)
    assert dict(first.model.values) == dict(again.model.values)
    assert not np.array_equal(first.start.vector, other.start.vector)


def test_the_teacher_knows_the_wind_but_not_its_gusts():
    """Wind of the model that flies minus that of the teacher's, at one time: the gusts alone."""
    situation = next(s for s in map(landing, range(9)) if s.model.values["gust_x"] > 0.1)
    mean = [situation.model.values[name] for name in ("mean_wind_x", "mean_wind_y")]
    known = gusty_wind(0.0, 0.0, 1.0, 0.7, situation.known_model.K)
    assert known == pytest.approx((*mean, 0.0))
    flown = gusty_wind(0.0, 0.0, 1.0, 0.7, situation.model.K)
    assert abs(flown[0] - known[0]) <= situation.model.values["gust_x"]
    assert flown != pytest.approx(known, abs=1e-3)


def test_the_camera_turns_by_its_mount_angle():
    """Three angles of at most 3 deg: the optical axis leaves the nose by at most 4.3 deg."""
    ranges = replace(NOMINAL, mount_angle=math.radians(3.0))
    axes = np.array([landing(seed, ranges).T_body_camera[:3, 2] for seed in range(60)])
    angles = np.degrees(np.arccos(axes[:, 0]))
    assert 2.0 < angles.max() < 3.0 * math.sqrt(2.0) + 0.05
    assert np.std(axes[:, 1]) > 0.01 and np.std(axes[:, 2]) > 0.01


@pytest.mark.parametrize("seed", range(20))
def test_a_delivered_frame_is_never_from_the_future(seed):
    """Nor older than a delivered one: the newest is kept."""
    newest, black = draw_delivery(np.random.default_rng(seed), 80, SPREAD_RANGES)
    assert (newest <= np.arange(80)).all() and (np.diff(newest) >= 0).all()
    assert black.sum() <= 11


def test_a_follower_begins_behind_its_leader():
    """Between 2 and 6 m, on its course to 10 deg."""
    situation = draw_situation("follow", 5, SPREAD_RANGES, MOUNT)
    leader = situation.leader.state_at(0.0)
    apart = leader.p_world - situation.start.p_world
    assert 2.0 < np.linalg.norm(apart) < 6.5
    assert apart @ leader.v_world > 0.9 * np.linalg.norm(apart) * np.linalg.norm(leader.v_world)
    assert situation.duration == situation.leader.duration
