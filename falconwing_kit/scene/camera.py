"""Camera: intrinsics and a pose -> pixel rays, and points -> pixels; OpenCV axes and pixel centres.

Camera axes are x right, y down, z forward; the centre of the first pixel is at (0.5, 0.5).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import camera_pose, pose_matrix, rotation_world_body

MAX_SIDE_PX = 16384
MAX_FOCAL_PX = 1e7
MAX_SKEW = 1e-4  # of R^T R from 1: a rotation in float32, multiplied a few times, stays within


@dataclass(frozen=True)
class PinholeCamera:
    """A camera without lens distortion.

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
        """A camera with square pixels and its principal point in the middle.

        fx = fy = (width / 2) / tan(fov / 2)

        Args:
            fov_deg: horizontal field of view from edge to edge [deg], 1 to 175.
        """
        half_angle = np.deg2rad(require_range("fov_deg", fov_deg, low=1.0, high=175.0)) / 2.0
        half_width = 0.5 * require_range("width", width, low=1, high=MAX_SIDE_PX)
        focal = half_width / float(np.tan(half_angle))
        return cls(focal, focal, 0.5 * width, 0.5 * height, width, height)

    @property
    def K(self) -> Array:
        """(3, 3) matrix of the intrinsics [px], as in OpenCV and gsplat."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixel_rays(self) -> Array:
        """(height, width, 3) ray through each pixel's centre, z = 1: p_camera = depth * ray."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)

    def project(self, p_world: ArrayLike, T_world_camera: ArrayLike) -> tuple[Array, Array]:
        """Pixels of points (N, 3), which may lie outside the image.

        Returns:
            (N, 2) u, v [px], nan for a point that is not in front of the camera; and the depth (N,)
            along the camera's z axis [m].
        """
        p_world = require_shape("p_world", p_world, (None, 3))
        T_world_camera = require_shape("T_world_camera", T_world_camera, (4, 4))
        R_world_camera = T_world_camera[:3, :3]
        # Points are rows, so the product applies the transpose of R, its inverse.
        p_camera = (p_world - T_world_camera[:3, 3]) @ R_world_camera
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
    """T_world_camera (4, 4) of a camera that looks along the nose of a body.

    Args:
        p_world: (3,) the body's origin [m].
        roll: [rad], positive right wing down.
        pitch: [rad], positive nose up.
        yaw: [rad], positive nose right, zero along world x.
        p_body_camera: (3,) position of the camera in body axes [m].
    """
    named = {"roll": roll, "pitch": pitch, "yaw": yaw}
    angles = [require_range(name, angle) for name, angle in named.items()]
    p_world = require_shape("p_world", p_world, (3,))
    p_body_camera = require_shape("p_body_camera", p_body_camera, (3,))
    if not (np.isfinite(p_world).all() and np.isfinite(p_body_camera).all()):
        raise InputError(
            f"p_world, p_body_camera: expected finite numbers, got {p_world} and {p_body_camera}"
        )
    return camera_pose(pose_matrix(rotation_world_body(*angles), p_world), p_body_camera)


def require_pose(name: str, pose: ArrayLike) -> Array:
    """Return a rigid pose (4, 4) as float64: rotation, translation and the last row 0 0 0 1.

    Raises:
        InputError: the shape is wrong, a number is not finite, or it stretches, shears or mirrors.
    """
    T = require_shape(name, pose, (4, 4))
    # Plain numbers: between the images of a GPU, a dozen NumPy calls on 16 of them take 0.1 ms.
    numbers = T.ravel().tolist()
    if not all(map(math.isfinite, numbers)):
        count = np.count_nonzero(~np.isfinite(T))
        raise InputError(f"{name}: expected finite numbers, got {count} that are not")
    if numbers[12:] != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(
            f"{name}: expected the last row 0 0 0 1, got {T[3]}; is the matrix transposed?"
        )
    ax, bx, cx, _, ay, by, cy, _, az, bz, cz, _ = numbers[:12]  # the columns of R are a, b, c
    aa, bb, cc = (
        ax * ax + ay * ay + az * az,
        bx * bx + by * by + bz * bz,
        cx * cx + cy * cy + cz * cz,
    )
    ab, bc, ca = (
        ax * bx + ay * by + az * bz,
        bx * cx + by * cy + bz * cz,
        cx * ax + cy * ay + cz * az,
    )
    skew = max(abs(aa - 1.0), abs(bb - 1.0), abs(cc - 1.0), abs(ab), abs(bc), abs(ca))
    det = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    if skew > MAX_SKEW or det < 0.0:
        raise InputError(
            f"{name}: expected a rotation in the first three columns,"
            " got one that stretches or mirrors"
        )
    return T
