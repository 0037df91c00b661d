"""Viterbi: costs of each frame's candidates and of the steps between them -> the cheapest path,
one camera pose per frame.

Here the candidates are camera poses, and a step costs what no aircraft can fly: `transition_cost`
is the chi2 of the excess over the largest speed and turn rate. All costs are capped at COST_CAP
(truncated quadratic), so that one wrong candidate cannot outvote several right ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from falconwing_kit.core.checks import Array

MAX_SPEED, MAX_TURN_RATE = 12.0, 5.0  # [m/s], [rad/s] reachable between frames at no cost
# standard deviations of the excess, added to the covariances of both poses
POSITION_TOLERANCE_M, ATTITUDE_TOLERANCE_RAD = 0.5, 0.3
MAX_TRANSITION_COST = 4.0  # median chi2 to its neighbours above which a pose is an outlier
COST_CAP = 25.0
NEIGHBOUR_TIME_S = 1.0  # a step between frames further apart costs nothing


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """One possible camera pose of a frame."""

    T_world_camera: Array  # (4, 4)
    covariance: Array  # (6, 6) of position and rotation vector in world axes
    unary_cost: float  # chi2 against it, 0..COST_CAP
    source: str


def viterbi(unary: Sequence[Array], transition: Sequence[Array]) -> list[int]:
    """Cheapest path through a sequence of candidates.

    total(k, j) = unary(k, j) + min over i of [total(k - 1, i) + transition(i, j)]  [Viterbi 1967]

    Args:
        unary: N arrays (n_k,): cost of each candidate of step k.
        transition: N - 1 arrays (n_k, n_k+1): cost from candidate i of step k to j of step k + 1.

    Returns:
        N indices, one candidate for each step.
    """
    if not unary:
        return []
    # forward: cheapest cost of a path that ends in each candidate, and its predecessor
    total, predecessors = unary[0], list[Array]()
    for cost, step in zip(unary[1:], transition, strict=True):
        paths = total[:, None] + step
        predecessors.append(paths.argmin(axis=0))
        total = paths.min(axis=0) + cost
    # backward: follow the predecessors from the cheapest end
    path = [int(np.argmin(total))]
    for predecessor in reversed(predecessors):
        path.append(int(predecessor[path[-1]]))
    return path[::-1]


def viterbi_path(options: Mapping[int, list[PoseCandidate]], t: Array) -> dict[int, PoseCandidate]:
    """One pose for each frame, such that an aircraft can have flown them all.

    Args:
        options: candidates by frame, in order; at least one each.
        t: (N,) times of all frames of the video [s].
    """
    unary = [np.array([pose.unary_cost for pose in poses]) for poses in options.values()]
    transition = [
        np.array([[transition_cost(a, b, t[k] - t[j]) for b in options[k]] for a in options[j]])
        for j, k in pairwise(options)
    ]
    path = viterbi(unary, transition)
    return {k: poses[j] for (k, poses), j in zip(options.items(), path, strict=True)}


def transition_cost(a: PoseCandidate, b: PoseCandidate, dt: float) -> float:
    """chi2 of the part of a step that exceeds MAX_SPEED and MAX_TURN_RATE, 0..COST_CAP.

    Args:
        a: pose of one frame.
        b: pose of a later one.
        dt: time between them [s], >= 0.
    """
    if dt > NEIGHBOUR_TIME_S:
        return 0.0
    A, B = a.T_world_camera, b.T_world_camera
    distance = float(np.linalg.norm(B[:3, 3] - A[:3, 3]))
    cos_angle = 0.5 * (np.trace(A[:3, :3].T @ B[:3, :3]) - 1.0)
    angle = float(np.arccos(np.clip(cos_angle, -1.0, 1.0)))
    variance = np.diag(a.covariance) + np.diag(b.covariance)
    position_variance = POSITION_TOLERANCE_M**2 + variance[:3].sum()
    attitude_variance = ATTITUDE_TOLERANCE_RAD**2 + variance[3:].sum()
    chi2 = max(distance - MAX_SPEED * dt, 0.0) ** 2 / position_variance
    chi2 += max(angle - MAX_TURN_RATE * dt, 0.0) ** 2 / attitude_variance
    return float(min(chi2, COST_CAP))


def reject_outliers(chosen: Mapping[int, PoseCandidate], t: Array) -> dict[int, PoseCandidate]:
    """Poses without those that most neighbours within half a second contradict.

    Args:
        chosen: one pose by frame, in order.
        t: (N,) times of all frames of the video [s].

    Returns:
        The rest; none where two frames are all there are and contradict each other.
    """
    frames = np.array(list(chosen), int)
    kept = {}
    for frame, pose in chosen.items():
        near = frames[(np.abs(t[frames] - t[frame]) < 0.5 * NEIGHBOUR_TIME_S) & (frames != frame)]
        costs = [transition_cost(pose, chosen[other], abs(t[other] - t[frame])) for other in near]
        if not costs or np.median(costs) < MAX_TRANSITION_COST:
            kept[frame] = pose
    return kept


def select_initial_frames(
    frames: Array, chosen: Mapping[int, PoseCandidate], t: Array, gap_s: float
) -> Array:
    """Frames to initialise the smoother from: those of well-known attitude.

    A wrong attitude between two good ones would wrap the initial yaw by a full turn.

    Args:
        frames: (M,) of one segment, in order.
        chosen: one pose by frame.
        t: (N,) times of all frames of the video [s].
        gap_s: poor frames stay where the good ones around them are further apart [s].

    Returns:
        (K,) of the frames.
    """
    largest_trace = 3.0 * ATTITUDE_TOLERANCE_RAD**2  # sum over three axes
    has_good_attitude = np.array(
        [np.trace(chosen[k].covariance[3:, 3:]) < largest_trace for k in frames]
    )
    # time of the last good frame before each frame, and of the first good one after it
    before = np.maximum.accumulate(np.where(has_good_attitude, t[frames], -np.inf))
    after = np.minimum.accumulate(np.where(has_good_attitude, t[frames], np.inf)[::-1])[::-1]
    return frames[has_good_attitude | (after - before > gap_s)]
