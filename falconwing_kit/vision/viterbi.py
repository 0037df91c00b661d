"""Choice: poses that each frame of a video allows -> one per frame, such that an aircraft can have
flown them all.

What counts is whether an aircraft gets from one pose to the next in time: `transition_cost` is the
chi2 of a step that none can make. A frame's own doubt and the strain to its neighbours add up; both
end at MOST_DOUBT, so that no single pose, how wrong it may be, outvotes the others.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from falconwing_kit.core.checks import Array

MAX_SPEED, MAX_TURN_RATE = 12.0, 5.0  # [m/s], [rad/s]: neighbours that need more are not both right
POSITION_TOLERANCE_M, ATTITUDE_TOLERANCE_RAD = (
    0.5,
    0.3,
)  # beyond that, one sigma, with what the poses themselves leave open
MAX_TRANSITION_COST = 4.0  # chi2 of a step that is still believed
COST_CAP = 25.0  # chi2 at which one frame's word against another ends
NEIGHBOUR_TIME_S = 1.0  # frames further apart say nothing about each other


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """One pose that a frame allows."""

    T_world_camera: Array  # (4, 4)
    covariance: Array  # (6, 6) place and turn in world axes
    unary_cost: float  # chi2 that speaks against it
    source: str


def viterbi_path(options: Mapping[int, list[PoseCandidate]], t: Array) -> dict[int, PoseCandidate]:
    """One pose per frame: the path with the least doubt in itself and between neighbours.

    least(k, j) = doubt(k, j) + min over i of [least(k - 1, i) + strain(i, j)]      [Viterbi 1967]

    Args:
        options: by frame, in order; at least one pose each.
        t: (N,) times of all frames of the video [s].

    Returns:
        The chosen pose by frame, in order.
    """
    frames = list(options)
    total = [np.array([one.unary_cost for one in options[frames[0]]])] if frames else []
    back: list[Array] = []
    for before, frame in pairwise(frames):
        step = np.array(
            [
                [transition_cost(a, b, t[frame] - t[before]) for a in options[before]]
                for b in options[frame]
            ]
        )
        paths = step + total[-1]
        back.append(np.argmin(paths, axis=1))
        total.append(paths.min(axis=1) + [one.unary_cost for one in options[frame]])
    choice = [int(np.argmin(total[-1]))] if frames else []
    for pointers in reversed(back):
        choice.append(int(pointers[choice[-1]]))
    return {frame: options[frame][j] for frame, j in zip(frames, reversed(choice), strict=True)}


def reject_outliers(chosen: Mapping[int, PoseCandidate], t: Array) -> dict[int, PoseCandidate]:
    """Without poses that an aircraft cannot get to from most of those within half a second; they
    lead astray.

    Args:
        chosen: one pose by frame, in order.
        t: (N,) times of all frames of the video [s].

    Returns:
        Those that are left; none where two frames are all there is and contradict each other.
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
    """Frames to begin from, without those between better ones whose turn is hardly known: they wind
    the yaw around.

    Args:
        frames: (M,) of one stretch, in order.
        chosen: one pose by frame.
        t: (N,) times of all frames of the video [s].
        gap_s: where good frames are further apart than that the others stay [s].

    Returns:
        (K,) of the frames.
    """
    good = np.array(
        [np.trace(chosen[k].covariance[3:, 3:]) < 3.0 * ATTITUDE_TOLERANCE_RAD**2 for k in frames]
    )
    before = np.maximum.accumulate(np.where(good, t[frames], -np.inf))
    after = np.minimum.accumulate(np.where(good, t[frames], np.inf)[::-1])[::-1]
    return frames[good | (after - before > gap_s)]


def transition_cost(a: PoseCandidate, b: PoseCandidate, dt: float) -> float:
    """chi2 of a step that no aircraft can make; 0 for one it can.

    Args:
        a: pose of one frame.
        b: pose of a later one.
        dt: time between them [s], >= 0.

    Returns:
        0..MOST_DOUBT.
    """
    if dt > NEIGHBOUR_TIME_S:
        return 0.0
    A, B = a.T_world_camera, b.T_world_camera
    moved = float(np.linalg.norm(B[:3, 3] - A[:3, 3])) - MAX_SPEED * dt
    turned = (
        float(np.arccos(np.clip(0.5 * (np.trace(A[:3, :3].T @ B[:3, :3]) - 1.0), -1.0, 1.0)))
        - MAX_TURN_RATE * dt
    )
    variance = np.diag(a.covariance) + np.diag(b.covariance)
    chi2 = max(moved, 0.0) ** 2 / (POSITION_TOLERANCE_M**2 + variance[:3].sum())
    chi2 += max(turned, 0.0) ** 2 / (ATTITUDE_TOLERANCE_RAD**2 + variance[3:].sum())
    return float(min(chi2, COST_CAP))
