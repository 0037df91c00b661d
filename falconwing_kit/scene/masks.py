"""Masks of an aircraft in the image: an ellipsoid around its points, or its own Gaussians, and a
camera -> pixels.

    ellipse   [the paper, UMX Mask Detection]  points -> ellipsoid -> dual quadric -> conic -> filled ellipse
    alpha     the aircraft's Gaussians rendered: how much of each pixel they cover, alone and with the hall before them

The ellipse needs no renderer, but knows neither the aircraft's outline nor what hides it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.colours import constant_sh
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.ply import Array32
from falconwing_kit.scene.render import render, require_pose

Mask = NDArray[np.bool_]
MASK_THRESHOLD = 0.5  # of a pixel, for it to belong to the mask
MIN_HALF_AXIS = 1e-3  # m, half an axis of an ellipsoid around points that lie in a plane


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
        for name in ("centre_body", "half_axes"):
            values = require_shape(name, getattr(self, name), (3,))
            if not np.isfinite(values).all() or (name == "half_axes" and not (values > 0.0).all()):
                raise InputError(
                    f"{name}: expected finite numbers{', > 0' if name == 'half_axes' else ''}, got {values}"
                )
            object.__setattr__(self, name, values)

    @classmethod
    def around(cls, points_body: ArrayLike) -> "Ellipsoid":
        """The ellipsoid whose axes are as long as the points reach: its ends are nose, tail and
        wing tips.

        Args:
            points_body: (n, 3) points of the aircraft, such as the means of its Gaussians [m].

        Raises:
            InputError: there are no points, or they are not (n, 3).
        """
        points = require_shape("points_body", points_body, (None, 3))
        if len(points) == 0:
            raise InputError("points_body: expected at least one point, got none")
        low, high = points.min(axis=0), points.max(axis=0)
        return cls(0.5 * (low + high), np.maximum(0.5 * (high - low), MIN_HALF_AXIS))

    def dual_quadric(self, T_world_body: ArrayLike) -> Array:
        """(4, 4) symmetric, in the world: all planes pi that touch the ellipsoid have pi^T Q* pi =
        0.

        Q* = T diag(a^2, b^2, c^2, -1) T^T      [Hartley & Zisserman, Multiple View Geometry, section 3.2.4]

        Raises:
            InputError: T_world_body is no pose.
        """
        T = require_pose("T_world_body", T_world_body).copy()
        T[:3, 3] += T[:3, :3] @ self.centre_body
        return np.asarray(T * np.append(self.half_axes**2, -1.0) @ T.T)


def ellipse_mask(
    ellipsoid: Ellipsoid, T_world_body: ArrayLike, camera: PinholeCamera, T_world_camera: ArrayLike
) -> Mask:
    """Pixels whose centres see the ellipsoid.

    C* = P Q* P^T, P = K [R | t]       the outline's dual conic [Hartley & Zisserman, eq. 8.5]
    x = (u, v, 1) is inside where x^T inv(C*) x <= 0, and in front where (S^-1 c)^T K^-1 x > 0

    Here c is the ellipsoid's centre in camera axes and S = R diag(a^2, b^2, c^2) R^T its shape. The
    second condition matters where the ellipsoid reaches behind the camera: the conic is then a
    hyperbola, and one of its branches is a mirage. From inside the ellipsoid every pixel sees it.

    Args:
        ellipsoid: in body axes.
        T_world_body: (4, 4) of the aircraft.
        camera: the lens.
        T_world_camera: (4, 4) of the camera.

    Returns:
        (H, W); all False where the ellipsoid is behind or beside the camera.

    Raises:
        InputError: one of the poses is none.
    """
    T_camera_world = np.linalg.inv(require_pose("T_world_camera", T_world_camera))
    quadric = (
        T_camera_world @ ellipsoid.dual_quadric(T_world_body) @ T_camera_world.T
    )  # in camera axes
    centre = -quadric[:3, 3]
    shape = quadric[:3, :3] + np.outer(centre, centre)
    polar = np.linalg.solve(shape, centre)
    if centre @ polar <= 1.0:
        return np.ones((camera.height, camera.width), bool)
    mask = np.zeros((camera.height, camera.width), bool)
    K = camera.K
    dual = K @ quadric[:3, :3] @ K.T  # K [I | 0] Q* [I | 0]^T K^T
    (left, right), (top, bottom) = _bounds(dual, centre[2] / np.sqrt(shape[2, 2]), camera)
    u, v = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
    pixels = np.stack([u, v, np.ones(u.shape)], axis=-1)
    inside = np.sum(pixels @ np.linalg.inv(dual) * pixels, axis=-1) <= 0.0
    mask[top:bottom, left:right] = inside & (pixels @ np.linalg.solve(K.T, polar) > 0.0)
    return mask


def _bounds(
    dual: Array, depths: float, camera: PinholeCamera
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns and rows, from and to, that the outline reaches: the lines u = const and v = const
    that touch it.

    Args:
        dual: (3, 3) the dual conic.
        depths: of the centre, in half extents of the ellipsoid along the camera's axis: above 1 all
            of it is in front.
        camera: the image's size.
    """
    sides = (camera.width, camera.height)
    if depths <= -1.0:
        return (0, 0), (0, 0)
    if depths <= 1.0:
        return (0, sides[0]), (0, sides[1])
    spans = []
    for axis, side in enumerate(sides):
        middle, scale = dual[axis, 2] / dual[2, 2], dual[axis, axis] / dual[2, 2]
        reach = np.sqrt(max(middle**2 - scale, 0.0))
        low, high = np.clip([middle - reach - 0.5, middle + reach + 0.5], 0, side)
        spans.append((int(np.floor(low)), int(np.ceil(high))))
    return spans[0], spans[1]


def alpha_image(
    leader: GaussianScene, camera: PinholeCamera, T_world_camera: ArrayLike, backend: str = "auto"
) -> Array32:
    """How much of each pixel an aircraft alone would cover.

    Args:
        leader: the aircraft, placed in the world.
        camera: the lens.
        T_world_camera: (4, 4) of the camera.
        backend: of `render`.

    Returns:
        (H, W), 0..1. `>= COVERED` makes the mask.

    Raises:
        InputError: an argument is wrong.
    """
    return render(paint_grey(leader, 0.0), camera, T_world_camera, backend).alpha


def visible_alpha_image(
    hall: GaussianScene,
    leader: GaussianScene,
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    backend: str = "auto",
) -> Array32:
    """How much of each pixel an aircraft covers with the hall around it: what hides it takes its
    share.

    A white aircraft in a black hall: a pixel's grey is the sum of the weights by which the
        aircraft's Gaussians enter.

    Args:
        hall: Gaussians around; black already, if `paint_grey` made it so before many views.
        leader: the aircraft, placed in the world.
        camera: the lens.
        T_world_camera: (4, 4) of the camera.
        backend: of `render`.

    Returns:
        (H, W), 0..1. `>= COVERED` makes the mask; its sum by that of `alpha_image` is the visible
        share.

    Raises:
        InputError: an argument is wrong.
    """
    return render(
        [paint_grey(hall, 0.0), paint_grey(leader, 1.0)], camera, T_world_camera, backend
    ).rgb[..., 0]


def paint_grey(scene: GaussianScene, grey: float) -> GaussianScene:
    """The scene in one grey, 0..1, from every side; a scene that is so already comes back as it is."""
    sh = constant_sh(scene.sh[:, :1], np.full(3, grey))
    return scene if np.array_equal(scene.sh, sh) else replace(scene, sh=sh)


def mask_iou(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks (H, W), 0..1; nan where both are empty.

    Raises:
        InputError: they are not of one shape.
    """
    if first.shape != second.shape:
        raise InputError(f"masks: expected two of one shape, got {first.shape} and {second.shape}")
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else float("nan")
