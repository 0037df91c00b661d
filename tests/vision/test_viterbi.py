"""Viterbi: costs and poses by hand -> the cheapest path, outliers and initial frames."""

from itertools import pairwise, product

import numpy as np
import pytest

from falconwing_kit.vision.viterbi import (
    PoseCandidate,
    reject_outliers,
    select_initial_frames,
    transition_cost,
    viterbi,
    viterbi_path,
)


def candidate(x, unary_cost=0.0):
    """A pose at x on a line, known to a millimetre."""
    T = np.eye(4)
    T[0, 3] = x
    return PoseCandidate(T, 1e-6 * np.eye(6), unary_cost, "network")


@pytest.mark.parametrize("seed", range(20))
def test_viterbi_finds_the_cheapest_of_all_paths(seed):
    """Against the enumeration of all paths through 2 to 4 random candidates in six steps."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(2, 5, 6)
    unary = [rng.random(count) for count in counts]
    transition = [rng.random((a, b)) for a, b in pairwise(counts)]

    def cost(path):
        steps = zip(transition, pairwise(path), strict=True)
        candidates = zip(unary, path, strict=True)
        return sum(u[i] for u, i in candidates) + sum(c[i, j] for c, (i, j) in steps)

    best = min(product(*(range(count) for count in counts)), key=cost)
    assert viterbi(unary, transition) == list(best)
    assert viterbi([], []) == []


def test_the_cheapest_poses_are_chosen():
    """By hand: at 12 m/s at most, 0.6 m a frame, the far poses cost (7 - 0.6)^2 / 0.25 and more,
    cut to 25 a step; the near ones cost their cost of 4 each.
    """
    options = {
        0: [candidate(0.0)],
        1: [candidate(7.0), candidate(0.5, unary_cost=4.0)],
        2: [candidate(1.0)],
    }
    chosen = viterbi_path(options, np.array([0.0, 0.05, 0.1]))
    assert [chosen[frame].T_world_camera[0, 3] for frame in (0, 1, 2)] == [0.0, 0.5, 1.0]


def test_early_cost_is_carried_along_the_path():
    """By hand: the path that stays at 20 m begins with a cost of 9, the one at 0 m ends with 5; a
    change costs 25.
    """
    options = {
        0: [candidate(20.0, unary_cost=9.0), candidate(0.0)],
        1: [candidate(20.0), candidate(0.0, unary_cost=5.0)],
    }
    chosen = viterbi_path(options, np.array([0.0, 0.05]))
    assert [chosen[frame].T_world_camera[0, 3] for frame in (0, 1)] == [0.0, 0.0]


def test_poorly_known_attitudes_do_not_initialise_the_smoother():
    """Frames 1 and 2 know their turn to 40 deg and stand between good ones 0.15 s apart: left out.
    The last has no good one behind it, and where good ones are further apart than the gap allowed
    nothing is left out.
    """
    vague = np.diag([0.01] * 3 + [np.radians(40.0) ** 2] * 3)
    chosen = {k: candidate(0.3 * k) for k in range(5)}
    chosen |= {k: PoseCandidate(chosen[k].T_world_camera, vague, 0.0, "network") for k in (1, 2, 4)}
    frames, t = np.arange(5), 0.05 * np.arange(5)
    assert select_initial_frames(frames, chosen, t, 1.0).tolist() == [0, 3, 4]
    assert select_initial_frames(frames, chosen, t, 0.1).tolist() == [0, 1, 2, 3, 4]


def test_a_pose_that_fits_no_neighbour_is_dropped():
    """Five frames 0.3 m apart and one of them 10 m aside."""
    chosen = {k: candidate(0.3 * k + (10.0 if k == 2 else 0.0)) for k in range(5)}
    assert list(reject_outliers(chosen, 0.05 * np.arange(5))) == [0, 1, 3, 4]


def test_two_poses_that_contradict_each_other_both_go():
    """It is undetermined which of the two is wrong."""
    assert reject_outliers({0: candidate(0.0), 1: candidate(10.0)}, np.array([0.0, 0.05])) == {}


@pytest.mark.parametrize(
    ("x", "dt", "chi2"), [(0.6, 0.05, 0.0), (1.1, 0.05, 1.0), (9.0, 0.05, 25.0), (99.0, 1.1, 0.0)]
)
def test_transition_cost_is_chi2_above_top_speed(x, dt, chi2):
    """By hand: 12 m/s is 0.6 m a frame; 0.5 m more is one sigma; no step costs more than 25, and
    none after a second.
    """
    assert transition_cost(candidate(0.0), candidate(x), dt) == pytest.approx(chi2, abs=1e-4)
