"""Lab 9, hidden: the cases and their references, independent of the lab's solution."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from falconwing_kit.scene import Ellipsoid, PinholeCamera, ellipse_mask
from falconwing_kit.tools.grading import Course, Function, Judge, Trials, Values, is_same_answer


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise."""
    loss = partial(_loss, w=course.constants["pos_weight"], share=course.constants["dice_weight"])
    return {
        "ellipsoid_mask": (Trials(_before_and_behind, trials=16),),
        "iou": (Values(_marks, _by_sets, cases=16),),
        "mask_loss": (Values(_logits, loss, cases=12, rtol=1e-6, atol=1e-9),),
        "randomize": (Values(_changes, _pixel_by_pixel, cases=12, rtol=0.0, atol=0.0),),
    }


def _ellipsoids(rng: np.random.Generator) -> tuple[Any, ...]:
    """A body in the picture, partly hidden in most cases."""
    height, width, focal = (
        int(rng.integers(20, 40)),
        int(rng.integers(30, 60)),
        float(rng.uniform(30.0, 60.0)),
    )
    T, z = np.eye(4), float(rng.uniform(3.0, 8.0))
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    half_axes, centre = rng.uniform(0.2, 1.0, 3), rng.uniform(-0.5, 0.5, 3)
    at = np.array(
        [rng.uniform(-0.3, 0.3) * width / focal * z, rng.uniform(-0.3, 0.3) * height / focal * z, z]
    )
    T[:3, 3] = at - T[:3, :3] @ centre
    depth = np.full((height, width), np.inf)
    if rng.random() < 0.7:
        depth[:, : int(rng.integers(width // 3, width))] = z + rng.uniform(-1.2, 0.2)
    return T, centre, half_axes, focal, depth


def _before_and_behind(student: Function, rng: np.random.Generator) -> bool:
    """Correct for a body before the camera, and for its mirror image behind the camera."""
    T, *others = _ellipsoids(rng)
    behind = T.copy()
    behind[2, 3] -= 2.0 * (T[2, 3] + T[2, :3] @ others[0])
    return all(
        is_same_answer(student(pose, *others), _by_conic(pose, *others)) for pose in (T, behind)
    )


def _by_conic(
    T_camera_body: np.ndarray,
    centre_body: np.ndarray,
    half_axes: np.ndarray,
    focal_px: float,
    hall_depth: np.ndarray,
) -> np.ndarray:
    """The outline by the kit's dual conic.

    The depth by the quadric (s d, 1)^T Q (s d, 1) = 0 and numpy.roots.
    """
    height, width = hall_depth.shape
    camera = PinholeCamera(focal_px, focal_px, width / 2, height / 2, width, height)
    mask = ellipse_mask(Ellipsoid(centre_body, half_axes), T_camera_body, camera, np.eye(4))
    move = np.array(T_camera_body, float)
    move[:3, 3] += move[:3, :3] @ centre_body
    inverse = np.linalg.inv(move)
    Q = inverse.T @ np.diag([*(1.0 / np.square(half_axes)), -1.0]) @ inverse
    for i, j in np.argwhere(mask & np.isfinite(hall_depth)):
        d = np.array([(j + 0.5 - width / 2) / focal_px, (i + 0.5 - height / 2) / focal_px, 1.0])
        roots = np.roots([d @ Q[:3, :3] @ d, 2.0 * d @ Q[:3, 3], Q[3, 3]])
        mask[i, j] = roots.real.min() < hall_depth[i, j]
    return mask


def _marks(rng: np.random.Generator) -> tuple[Any, ...]:
    """Pictures with and without a leader, marked well, badly, by a few pixels or not at all."""
    n, height, width = 8, int(rng.integers(8, 14)), int(rng.integers(8, 14))
    truth, threshold = np.zeros((n, height, width), bool), float(rng.uniform(0.2, 0.8))
    probability = rng.uniform(0.0, 0.95 * threshold, truth.shape)
    for number, (picture, mask) in enumerate(zip(probability, truth, strict=True)):
        top, left = rng.integers(0, 5, 2)
        mask[top : top + 3, left : left + 4] = number % 2 == 0
        spots = rng.permutation(height * width)[: int(rng.choice([0, 5, 6, 7, 20]))]
        picture.ravel()[spots] = rng.uniform(1.02 * threshold, 1.0, len(spots))
        if rng.random() < 0.6 and number % 2 == 0:
            picture[top : top + 3, left + 1 : left + 5] = 0.5 * (1.0 + threshold)
        picture[-1, :2] = threshold  # not above it
    return probability, truth, threshold


def _by_sets(
    probability: np.ndarray, truth: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """With sets of pixels."""
    overlaps, alarms = [], []
    for said, is_leader in zip(probability, truth, strict=True):
        marked, leader = (set(np.flatnonzero(pixels)) for pixels in (said > threshold, is_leader))
        overlaps.append(len(marked & leader) / len(marked | leader) if marked | leader else 1.0)
        alarms.append(not leader and len(marked) >= 6)
    return np.array(overlaps), np.array(alarms)


def _logits(rng: np.random.Generator) -> tuple[Any, ...]:
    n, height, width = (int(rng.integers(2, 6)) for _ in range(3))
    logits = rng.normal(0.0, float(rng.choice([1.0, 3.0, 300.0])), (n, height, width))
    return logits, (rng.random((n, height, width)) < rng.uniform(0.05, 0.5)).astype(float)


def _loss(logits: np.ndarray, truth: np.ndarray, w: float, share: float) -> dict[str, Any]:
    """Loss and gradient by hand: ln p by logaddexp, p' = p (1 - p), quotient rule for Dice."""
    p = np.exp(-np.logaddexp(0.0, -logits))
    each = w * truth * np.logaddexp(0.0, -logits) + (1.0 - truth) * np.logaddexp(0.0, logits)
    top = np.array([2.0 * np.vdot(a, m) + 1.0 for a, m in zip(p, truth, strict=True)])
    bottom = np.array([a.sum() + m.sum() + 1.0 for a, m in zip(p, truth, strict=True)])
    by_entropy = (-w * truth * (1.0 - p) + (1.0 - truth) * p) / p.size
    by_p = (
        -(2.0 * truth * bottom[:, None, None] - top[:, None, None])
        / bottom[:, None, None] ** 2
        / len(p)
    )
    loss = float(np.mean(each) + share * np.mean(1.0 - top / bottom))
    return {"loss": loss, "gradient": by_entropy + share * by_p * p * (1.0 - p)}


def _changes(rng: np.random.Generator) -> tuple[Any, ...]:
    height, width = int(rng.integers(8, 14)), int(rng.integers(10, 18))
    image, mask = (
        rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        np.zeros((height, width), bool),
    )
    top, left = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    mask[top : top + 4, left : left + 5] = True
    patch = rng.uniform(0.0, 255.0, (*rng.integers(2, 9, 2), 3))
    corner = (int(rng.integers(0, height)), int(rng.integers(0, width)))
    if rng.random() < 0.5:
        corner = (top - 1, left - 1)
    tint, brightness = rng.uniform(0.6, 1.2, 3), float(rng.uniform(0.5, 2.0))
    return (
        image,
        mask,
        tint,
        brightness,
        float(rng.uniform(0.1, 0.6)),
        rng.random((height, width)),
        patch,
        corner,
    )


def _pixel_by_pixel(
    image: np.ndarray,
    mask: np.ndarray,
    tint: np.ndarray,
    brightness: float,
    salt: float,
    draws: np.ndarray,
    patch: np.ndarray,
    corner: tuple[int, int],
) -> np.ndarray:
    """One pixel after the other, as the text says it."""
    made = np.zeros_like(image)
    for i, j in np.ndindex(*mask.shape):
        row, column = i - corner[0], j - corner[1]
        colour = [float(level) for level in image[i, j]]
        if mask[i, j]:
            colour = [level * factor for level, factor in zip(colour, tint, strict=True)]
            if draws[i, j] < salt / 2 or draws[i, j] > 1.0 - salt / 2:
                colour = [0.0 if draws[i, j] < salt / 2 else 255.0] * 3
        elif 0 <= row < patch.shape[0] and 0 <= column < patch.shape[1]:
            colour = list(patch[row, column])
        made[i, j] = [
            round(min(max(level * brightness ** (1.0 / 2.2), 0.0), 255.0)) for level in colour
        ]
    return made
