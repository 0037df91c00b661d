"""Lab 6, hidden: references by polar decomposition, Horn's quaternion and stacked rays."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.linalg import null_space, polar
from scipy.spatial.transform import Rotation

from falconwing_kit.core import pose_matrix
from falconwing_kit.scene import PinholeCamera
from falconwing_kit.tools.grading import Course, Judge, Values


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise.

    Args:
        course: its gate.

    Returns:
        By exercise.
    """
    gate = course.constants["gate"]

    def chosen(p_from: Any, p_to: Any, candidates: Any) -> tuple[int, Any]:
        misses = [_misses(one, p_from, p_to) for one in candidates]
        middle = [float(np.quantile(each, 0.5)) for each in misses]
        best = middle.index(min(middle))
        return best, ~(misses[best] > gate * middle[best])

    return {
        "marker_pose": (Values(_draw_corners, _pose, rtol=1e-5, atol=1e-5),),
        "fit_similarity": (Values(_draw_clouds, _horn, rtol=1e-6, atol=1e-7),),
        "reject_outliers": (Values(_draw_candidates, chosen),),
        "triangulate": (Values(_draw_rays, _meeting, rtol=1e-6, atol=1e-7),),
    }


def _draw_corners(rng: np.random.Generator) -> tuple[Any, ...]:
    """A camera in front of the marker and directed at it, with pixel noise."""
    size, way = float(rng.uniform(0.3, 1.2)), rng.uniform(4.0, 9.0)
    aside = np.radians(rng.uniform(15.0, 50.0) * rng.choice([-1.0, 1.0], 2))
    turn = Rotation.from_euler("yx", aside) * Rotation.from_euler("z", rng.uniform(-0.5, 0.5))
    R_marker_camera = turn.as_matrix() @ np.diag([1.0, -1.0, -1.0])
    p_marker = -R_marker_camera[:, 2] * size * way + size * rng.uniform(-0.5, 0.5, 3)
    focal = rng.uniform(300.0, 900.0)
    lens = PinholeCamera(
        focal, 1.2 * focal, rng.uniform(250.0, 400.0), rng.uniform(150.0, 300.0), 640, 480
    )
    corners = lens.project(_square(size), pose_matrix(R_marker_camera, p_marker))[0]
    return corners + rng.normal(0.0, 0.3, (4, 2)), lens.K, size


def _square(size: float) -> Any:
    return size * np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


def _pose(corners_px: Any, K: Any, size: float) -> Any:
    """From the null space of the equations ray x H point = 0, and the polar decomposition."""
    rays = np.column_stack([corners_px, np.ones(4)]) @ np.linalg.inv(K).T
    plane = np.add(_square(size), (0.0, 0.0, 1.0))
    rows = [
        np.kron(np.cross(np.eye(3), ray)[:2], point) for ray, point in zip(rays, plane, strict=True)
    ]
    A = null_space(np.concatenate(rows))[:, 0].reshape(3, 3)
    A *= 2.0 * np.sign(A[2, 2]) / np.linalg.norm(A[:, :2], axis=0).sum()
    R_camera_marker = polar(np.column_stack([A[:, :2], np.cross(A[:, 0], A[:, 1])]))[0]
    return np.linalg.inv(pose_matrix(R_camera_marker, A[:, 2]))


def _draw_clouds(rng: np.random.Generator) -> tuple[Any, ...]:
    """Points with noise, weights of which one is zero.

    Some clouds are mirrored, some flat as a marker.
    """
    count = int(rng.integers(6, 20))
    p_from = rng.normal(0.0, 1.0, (count, 3)) * (3.0, 2.0, 1.0) + rng.uniform(-5.0, 5.0, 3)
    kind = rng.choice(["plain", "mirrored", "flat"])
    if kind == "flat":
        p_from[:, 2] = 1.0
    seen = p_from * (1.0, 1.0, -1.0) if kind == "mirrored" else p_from
    turned = Rotation.random(rng=rng).apply(seen)
    p_to = (
        rng.uniform(0.3, 4.0) * turned
        + rng.uniform(-5.0, 5.0, 3)
        + rng.normal(0.0, 0.03, (count, 3))
    )
    weights = rng.uniform(0.2, 3.0, count)
    weights[0] = 0.0
    return p_from, p_to, weights


def _horn(p_from: Any, p_to: Any, weights: Any) -> tuple[float, Any, Any]:
    """Horn 1987: the unit quaternion is the dominant eigenvector of a symmetric 4 x 4 matrix."""
    means = [np.average(p, axis=0, weights=weights) for p in (p_from, p_to)]
    a, b = p_from - means[0], p_to - means[1]
    M = np.einsum("n,ni,nj->ij", weights, a, b)
    skew = np.array([M[1, 2] - M[2, 1], M[2, 0] - M[0, 2], M[0, 1] - M[1, 0]])
    N = np.block([[np.trace(M), skew], [skew[:, None], M + M.T - np.trace(M) * np.eye(3)]])
    w, x, y, z = np.linalg.eigh(N)[1][:, -1]
    turn = Rotation.from_quat([x, y, z, w])
    scale = float((weights[:, None] * b * turn.apply(a)).sum() / (weights[:, None] * a * a).sum())
    return scale, turn.as_matrix(), means[1] - scale * turn.apply(means[0])


def _draw_candidates(rng: np.random.Generator) -> tuple[Any, ...]:
    """Good and wrong candidates.

    a third of the points are off, by amounts from below the gate to far beyond it.
    """
    count = int(rng.integers(24, 40))
    truth = (
        float(rng.uniform(0.5, 3.0)),
        Rotation.random(rng=rng).as_matrix(),
        rng.uniform(-5.0, 5.0, 3),
    )
    p_from = rng.uniform(-5.0, 5.0, (count, 3))
    p_to = truth[0] * p_from @ truth[1].T + truth[2] + rng.normal(0.0, 0.1, (count, 3))
    off = 10.0 ** rng.uniform(-0.6, 1.8, (count // 3, 1))
    p_to[: count // 3] += off * _unit(rng.normal(size=(count // 3, 3)))
    candidates = []
    for _ in range(int(rng.integers(5, 9))):
        turn = Rotation.from_rotvec(rng.normal(0.0, 0.03, 3)).as_matrix()
        candidates.append(
            (
                truth[0] * rng.uniform(0.95, 1.05),
                turn @ truth[1],
                truth[2] + rng.normal(0.0, 0.2, 3),
            )
        )
    # One that is drawn towards the outliers: the mean of its misses is smaller than that of the
    # better ones.
    pull = np.mean(p_to - (truth[0] * p_from @ truth[1].T + truth[2]), axis=0)
    candidates.insert(int(rng.integers(0, 5)), (truth[0], truth[1], truth[2] + pull))
    return p_from, p_to, candidates


def _misses(candidate: Any, p_from: Any, p_to: Any) -> Any:
    scale, R, t = candidate
    return np.sqrt(((scale * np.einsum("ij,nj->ni", R, p_from) + t - p_to) ** 2).sum(axis=1))


def _unit(vectors: Any) -> Any:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _draw_rays(rng: np.random.Generator) -> tuple[Any, ...]:
    """Cameras around a point that look at it, not quite; directions of any length."""
    count = int(rng.integers(4, 12))
    point = rng.uniform(-3.0, 3.0, 3)
    ways = _unit(rng.normal(size=(count, 3)))
    centres = point - ways * rng.uniform(3.0, 12.0, (count, 1))
    rays = (ways + rng.normal(0.0, 0.02, (count, 3))) * rng.uniform(0.2, 5.0, (count, 1))
    return centres, rays, rng.uniform(0.1, 4.0, count)


def _meeting(centres: Any, rays: Any, weights: Any) -> tuple[Any, Any]:
    """Least squares of |d x (p - c)|, the distance of p from each ray, which is linear in p."""
    d = _unit(rays)
    crosses = np.array([np.cross(one, np.eye(3)).T for one in d])  # crosses @ v = d x v
    right = np.cross(d, centres)
    root = np.sqrt(weights)
    p = np.linalg.lstsq(
        (crosses * root[:, None, None]).reshape(-1, 3), (right * root[:, None]).ravel(), rcond=None
    )[0]
    return p, np.linalg.norm(np.cross(d, p - centres), axis=1)
