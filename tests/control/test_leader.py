"""Leaders: inside the hall, the same again by seed, and each does what its name says."""

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.leader import MANOEUVRES, bent, leader_path
from falconwing_kit.core.checks import InputError


@pytest.fixture(scope="module")
def paths():
    return {(name, seed): leader_path(name, seed) for name in MANOEUVRES for seed in (0, 1)}


def test_leaders_stay_inside_the_hall(paths):
    """Walls and beams of the 40 x 20 x 5 m hall; a span is 0.7 m, so half a metre is wing tip and some air."""
    for path in paths.values():
        assert Hall().margin(path.states[:, :3]).min() > 0.5, path.manoeuvre
        assert path.states[:, 2].min() > 0.5, path.manoeuvre


def test_same_seed_same_bits_and_another_seed_another_path(paths):
    """Flown twice in this process."""
    for name in ("left_turn_s_descent", "random_waypoints"):
        assert np.array_equal(leader_path(name, 0).states, paths[name, 0].states)
        assert not np.array_equal(paths[name, 0].states, paths[name, 1].states[: len(paths[name, 0].states)])


@pytest.mark.parametrize("seed", [0, 1])
def test_each_manoeuvre_does_what_it_is_called(paths, seed):
    """The paper's words: which way it turns first, whether it ends on its first course, up or down."""
    for name, first_turn, course_kept, climbs in (
        ("left_turn_s_descent", -1, True, -1), ("right_turn_s_ascent", 1, True, 1),
        ("right_turn_sharp_climb", 1, False, 1),
    ):  # fmt: skip
        states = paths[name, seed].states
        yaw = states[:, 4] - states[0, 4]
        largest = yaw[np.argmax(np.abs(yaw))]
        assert first_turn * largest > np.radians(25.0), name
        assert (abs(yaw[-1]) < np.radians(6.0)) == course_kept, name
        assert climbs * (states[-1, 2] - states[0, 2]) > 1.5, name
    eight = paths["figure_eight", seed].states
    assert np.ptp(eight[:, 4]) > 1.5 * np.pi  # most of a turn to one side, and back
    assert abs(eight[-1, 4] - eight[0, 4]) < np.radians(6.0)
    assert np.ptp(eight[:, 2]) < 0.3
    assert np.linalg.norm(eight[-1, :2] - eight[0, :2]) < 1.0


def test_state_is_continuous_and_its_velocity_is_its_motion(paths):
    """Calculus: between and beyond samples, central differences of the place over 2 ms give the velocity.

    To 0.05 m/s: velocity is interpolated by straight lines, off by a dt^2 / 8 of its bend.
    """
    path = paths["right_turn_sharp_climb", 0]
    for t in (-1.0, 0.013, 0.05, 1.234, 2.5, path.duration - 0.01, path.duration + 0.7):
        moved = (path.state(t + 1e-3).p_world - path.state(t - 1e-3).p_world) / 2e-3
        assert moved == pytest.approx(path.state(t).v_world, abs=0.05)
    assert path.state(0.5).vector == pytest.approx(path.states[10], abs=1e-12)


def test_curve_from_its_curvature_is_a_circle():
    """A right quarter of 10 m radius from the origin along world x ends at (10, -10); 10 % up over 15.7 m is 1.57 m."""
    quarter = 5.0 * np.pi
    s = np.array([0.0, quarter])
    points = bent(0.0, s, np.full(2, 0.1), np.full(2, np.arctan(0.1)))
    ways = np.arange(len(points))
    expected = np.column_stack([10 * np.sin(ways / 10), 10 * (np.cos(ways / 10) - 1), 0.1 * ways])
    assert points == pytest.approx(expected, abs=1e-3)  # midpoint rule in steps of 0.1 m


def test_unknown_or_impossible_manoeuvres_are_refused():
    """A name nobody knows, and an aircraft that cannot climb."""
    with pytest.raises(InputError, match="left_turn_s_descent"):
        leader_path("loop")
    with pytest.raises(InputError, match="throttle"):
        leader_path("right_turn_sharp_climb", model=rates_model().with_values({"kT": 5.0}))
