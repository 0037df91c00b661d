"""Camera: intrinsics and a pose -> pixel rays, and points -> pixels. OpenCV axes, pixel centres at
+0.5.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import camera_pose, pose_matrix, rotation_world_body

MAX_SIDE_PX = 16384
MAX_FOCAL_PX = 1e7


@dataclass(frozen=True)
class PinholeCamera:
    """A camera without distortion: x right, y down, z forward; the first pixel's centre is at (0.5,
    0.5).

    u = fx x/z + cx,  v = fy y/z + cy      [Hartley & Zisserman, Multiple View Geometry, eq. 6.3]

    Raises:
        InputError: a focal length is not positive, the principal point is not finite, or the size
            is not a whole number of pixels from 1 to 16384.
    """

    fx: float  # focal length in pixel widths
    fy: float  # focal length in pixel heights
    cx: float  # principal point [px] from the left edge
    cy: float  # principal point [px] from the upper edge
    width: int  # [px]
    height: int  # [px]

    def __post_init__(self) -> None:
        """Check every number."""
        for name in ("fx", "fy"):
            require_range(name, getattr(self, name), low=1e-3, high=MAX_FOCAL_PX)
        for name in ("cx", "cy"):
            require_range(name, getattr(self, name), low=-MAX_FOCAL_PX, high=MAX_FOCAL_PX)
        for name in ("width", "height"):
            side = require_range(name, getattr(self, name), low=1, high=MAX_SIDE_PX)
            if side != int(side):
                raise InputError(f"{name}: expected a whole number of pixels, got {side:g}")
            object.__setattr__(self, name, int(side))

    @classmethod
    def from_fov_deg(cls, width: int, height: int, fov_deg: float) -> "PinholeCamera":
        """A camera with square pixels that looks through the middle of its image.

        fx = fy = (width / 2) / tan(fov / 2)

        Args:
            width: [px].
            height: [px].
            fov_deg: horizontal field of view, from the left edge to the right one [deg], 1 to 175.

        Raises:
            InputError: a number is out of its range.
        """
        half_angle = np.deg2rad(require_range("fov_deg", fov_deg, low=1.0, high=175.0)) / 2.0
        focal = (
            0.5 * require_range("width", width, low=1, high=MAX_SIDE_PX) / float(np.tan(half_angle))
        )
        return cls(focal, focal, 0.5 * width, 0.5 * height, width, height)

    @property
    def K(self) -> Array:
        """(3, 3) matrix of the intrinsics [px], as OpenCV and gsplat want it."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixel_rays(self) -> Array:
        """The point at depth 1 m that each pixel's centre looks at; p_camera = depth * ray.

        Returns:
            (height, width, 3) in camera axes, z = 1.
        """
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)

    def project(self, p_world: ArrayLike, T_world_camera: ArrayLike) -> tuple[Array, Array]:
        """Where points appear in the image; they may lie outside of it.

        Args:
            p_world: (N, 3) [m].
            T_world_camera: (4, 4), "world from camera".

        Returns:
            Pixels (N, 2) as u, v [px], nan for a point that is not in front of the camera; and the
            depth (N,) along the camera's z axis [m].

        Raises:
            InputError: a shape is wrong.
        """
        p_world = require_shape("p_world", p_world, (None, 3))
        T_world_camera = require_shape("T_world_camera", T_world_camera, (4, 4))
        R_world_camera = T_world_camera[:3, :3]
        p_camera = (
            p_world - T_world_camera[:3, 3]
        ) @ R_world_camera  # rows: the transposed map, that is the inverse
        depth = p_camera[:, 2]
        in_front = np.where(depth > 0.0, depth, np.nan)[:, None]
        return p_camera[:, :2] / in_front * (self.fx, self.fy) + (self.cx, self.cy), depth


def nose_camera_pose(
    p_world: ArrayLike,
    roll: float,
    pitch: float,
    yaw: float,
    p_body_camera: ArrayLike = (0.0, 0.0, 0.0),
) -> Array:
    """T_world_camera of a camera that looks along the nose of a body.

    Args:
        p_world: (3,) the body's origin [m].
        roll: [rad], positive right wing down.
        pitch: [rad], positive nose up.
        yaw: [rad], positive nose right, zero along world x.
        p_body_camera: (3,) where the camera sits, in body axes [m].

    Returns:
        T_world_camera (4, 4), "world from camera".

    Raises:
        InputError: a shape is wrong or a number is not finite.
    """
    angles = [
        require_range(name, value)
        for name, value in (("roll", roll), ("pitch", pitch), ("yaw", yaw))
    ]
    p_world, p_body_camera = (
        require_shape("p_world", p_world, (3,)),
        require_shape("p_body_camera", p_body_camera, (3,)),
    )
    if not (np.isfinite(p_world).all() and np.isfinite(p_body_camera).all()):
        raise InputError(
            f"p_world, p_body_camera: expected finite numbers, got {p_world} and {p_body_camera}"
        )
    return camera_pose(pose_matrix(rotation_world_body(*angles), p_world), p_body_camera)
