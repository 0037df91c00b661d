"""Masks of an aircraft: ellipsoid or Gaussians, and a camera -> its pixels and visible share.

    ellipse   points -> ellipsoid -> dual quadric -> conic -> filled ellipse
              [paper, UMX Mask Detection]
    alpha     the aircraft's Gaussians rendered: their share of each pixel, alone or behind the hall

The ellipse needs no renderer, but has neither the aircraft's outline nor any occlusion.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.scene.camera import PinholeCamera, require_pose
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import render
from falconwing_kit.scene.sh import Array32, constant_sh

Mask = NDArray[np.bool_]
MASK_THRESHOLD = 0.5  # alpha from which on a pixel belongs to the mask
MIN_HALF_AXIS = 1e-3  # of an ellipsoid around points in a plane [m]


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An ellipsoid along the axes of a body: sum_i ((x_i - centre_i) / half_axes_i)^2 = 1.

    Raises:
        InputError: a shape is wrong, a number is not finite, or an axis is not positive.
    """

    centre_body: Array  # (3,) [m]
    half_axes: Array  # (3,) [m], > 0

    def __post_init__(self) -> None:
        """Check both."""
        for name, low, bound in (("centre_body", -np.inf, ""), ("half_axes", 0.0, ", > 0")):
            values = require_shape(name, getattr(self, name), (3,))
            if not (np.isfinite(values) & (values > low)).all():
                raise InputError(f"{name}: expected finite numbers{bound}, got {values}")
            object.__setattr__(self, name, values)

    @classmethod
    def around(cls, points_body: ArrayLike) -> "Ellipsoid":
        """The ellipsoid with the extents of points (n, 3) [m], such as the means of an aircraft."""
        points = require_shape("points_body", points_body, (None, 3))
        if len(points) == 0:
            raise InputError("points_body: expected at least one point, got none")
        low, high = points.min(axis=0), points.max(axis=0)
        return cls(0.5 * (low + high), np.maximum(0.5 * (high - low), MIN_HALF_AXIS))

    def dual_quadric(self, T_world_body: ArrayLike) -> Array:
        """(4, 4) Q* in the world: every plane pi that touches the ellipsoid has pi^T Q* pi = 0.

        Q* = T diag(a^2, b^2, c^2, -1) T^T   [Hartley & Zisserman, Multiple View Geometry, 3.2.4]
        """
        T = require_pose("T_world_body", T_world_body).copy()
        T[:3, 3] += T[:3, :3] @ self.centre_body
        return np.asarray(T * np.append(self.half_axes**2, -1.0) @ T.T)


def ellipse_mask(
    ellipsoid: Ellipsoid, T_world_body: ArrayLike, camera: PinholeCamera, T_world_camera: ArrayLike
) -> Mask:
    """(H, W) pixels whose rays meet the ellipsoid.

    C* = P Q* P^T, P = K [R | t]       dual conic of the outline [Hartley & Zisserman, eq. 8.5]
    x = (u, v, 1) is inside where x^T inv(C*) x <= 0, and in front where (S^-1 c)^T K^-1 x > 0

    Here c is the ellipsoid's centre in camera axes and S = R diag(a^2, b^2, c^2) R^T its shape. The
    second condition matters where the ellipsoid extends behind the camera: the conic is then a
    hyperbola, and only one of its branches is real. From inside the ellipsoid the mask is full.
    """
    T_camera_world = np.linalg.inv(require_pose("T_world_camera", T_world_camera))
    # Q* in camera axes has the blocks [[S - c c^T, -c], [-c^T, -1]].
    quadric = T_camera_world @ ellipsoid.dual_quadric(T_world_body) @ T_camera_world.T
    centre = -quadric[:3, 3]
    shape = quadric[:3, :3] + np.outer(centre, centre)
    polar = np.linalg.solve(shape, centre)
    if centre @ polar <= 1.0:  # the camera is inside
        return np.ones((camera.height, camera.width), bool)
    mask = np.zeros((camera.height, camera.width), bool)
    K = camera.K
    conic = K @ quadric[:3, :3] @ K.T  # dual conic: K [I | 0] Q* [I | 0]^T K^T
    (left, right), (top, bottom) = _bounds(conic, centre[2] / np.sqrt(shape[2, 2]), camera)
    # Both conditions for the pixel centres (h, w, 3) within the bounds
    u, v = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
    pixels = np.stack([u, v, np.ones(u.shape)], axis=-1)
    inside = np.sum(pixels @ np.linalg.inv(conic) * pixels, axis=-1) <= 0.0
    mask[top:bottom, left:right] = inside & (pixels @ np.linalg.solve(K.T, polar) > 0.0)
    return mask


def _bounds(
    conic: Array, depth_ratio: float, camera: PinholeCamera
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Column and row ranges of the outline, from the lines u = const and v = const that touch it.

    Args:
        conic: (3, 3) the dual conic.
        depth_ratio: depth of the centre in half extents of the ellipsoid along the camera's axis;
            above 1 all of it is in front.
    """
    sides = (camera.width, camera.height)
    if depth_ratio <= -1.0:
        return (0, 0), (0, 0)
    if depth_ratio <= 1.0:
        return (0, sides[0]), (0, sides[1])
    ranges = []
    for axis, side in enumerate(sides):
        # The line u = s touches where C*_22 s^2 - 2 C*_02 s + C*_00 = 0.
        middle, product = conic[axis, 2] / conic[2, 2], conic[axis, axis] / conic[2, 2]
        half_width = np.sqrt(max(middle**2 - product, 0.0))
        low, high = np.clip([middle - half_width - 0.5, middle + half_width + 0.5], 0, side)
        ranges.append((int(np.floor(low)), int(np.ceil(high))))
    return ranges[0], ranges[1]


def alpha_image(
    leader: GaussianScene, camera: PinholeCamera, T_world_camera: ArrayLike, backend: str = "auto"
) -> Array32:
    """(H, W) share of each pixel, 0..1, that an aircraft placed in the world covers alone.

    The mask is where it is at least MASK_THRESHOLD.
    """
    return render(paint_grey(leader, 0.0), camera, T_world_camera, backend).alpha


def visible_alpha_image(
    hall: GaussianScene,
    leader: GaussianScene,
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    backend: str = "auto",
) -> Array32:
    """(H, W) share of each pixel, 0..1, that an aircraft covers with the hall's occlusion.

    A white aircraft in a black hall: the grey value is the sum of the aircraft's blending weights.
    Divided by `alpha_image`, the sums over the image give the visible share.

    Args:
        hall: Gaussians around; painted black by `paint_grey` once, it serves for many views.
        leader: the aircraft, placed in the world.
    """
    scenes = [paint_grey(hall, 0.0), paint_grey(leader, 1.0)]
    return render(scenes, camera, T_world_camera, backend).rgb[..., 0]


def paint_grey(scene: GaussianScene, grey: float) -> GaussianScene:
    """The scene in one grey, 0..1, from every side; unchanged where it has that already."""
    sh = constant_sh(scene.sh[:, :1], np.full(3, grey))
    return scene if np.array_equal(scene.sh, sh) else replace(scene, sh=sh)


def mask_iou(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks (H, W), 0..1; nan where both are empty."""
    if first.shape != second.shape:
        raise InputError(f"masks: expected two of one shape, got {first.shape} and {second.shape}")
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else float("nan")
