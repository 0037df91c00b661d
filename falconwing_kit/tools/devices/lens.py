"""Lens: photos of a checkerboard -> focal lengths, centre and distortion; an image -> undistorted.

The kit's cameras have no distortion (`PinholeCamera`). A real lens has, so its images are
undistorted once, where they come in, and everything behind sees a pinhole camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.images import Pixels, to_grey

MIN_VIEWS = 8
MIN_COVERAGE = 0.6  # share of width and of height that the corners of all views span
MAX_REPROJECTION_PX = 1.0  # root mean square
MAX_FOCAL_ERROR = 0.01  # standard error of a focal length, relative


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion of a camera at one image size.

    With x = X/Z, y = Y/Z in camera axes, r^2 = x^2 + y^2 and c = 1 + k1 r^2 + k2 r^4:

    u = fx (c x + 2 p1 x y + p2 (r^2 + 2 x^2)) + cx
    v = fy (c y + p1 (r^2 + 2 y^2) + 2 p2 x y) + cy      [Brown 1966; OpenCV's k1, k2, p1, p2]

    Raises:
        InputError: a number is out of its range.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float  # from the left edge: the centre of the first pixel is at 0.5
    cy_px: float  # from the upper edge
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px"):
            require_range(name, getattr(self, name), low=16, high=16384)
        for name in ("fx_px", "fy_px"):
            require_range(name, getattr(self, name), low=1.0, high=1e6)
        for name, size in (("cx_px", self.width_px), ("cy_px", self.height_px)):
            require_range(name, getattr(self, name), low=0.0, high=size)
        for name in ("k1", "k2", "p1", "p2"):
            require_range(name, getattr(self, name), low=-5.0, high=5.0)

    def camera(self, width: int | None = None, height: int | None = None) -> PinholeCamera:
        """The camera of its undistorted images, at this size [px] or at its own.

        Raises:
            InputError: the size has another aspect ratio, hence another field of view.
        """
        width, height = width or self.width_px, height or self.height_px
        x, y = width / self.width_px, height / self.height_px
        if abs(height - x * self.height_px) > 1.0:
            raise InputError(
                f"lens: expected images of the shape of {self.width_px} x {self.height_px}, as"
                f" measured, got {width} x {height}; run falconwing bench at this size"
            )
        return PinholeCamera(
            x * self.fx_px, y * self.fy_px, x * self.cx_px, y * self.cy_px, width, height
        )

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Directions X/Z, Y/Z of any shape -> the same, bent by the lens."""
        r2 = x * x + y * y
        c = 1.0 + self.k1 * r2 + self.k2 * r2 * r2
        return (
            c * x + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            c * y + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )

    def undistort(self, pixels: Pixels) -> Pixels:
        """The image that `camera` of its size would have taken.

        Args:
            pixels: (H, W, 3) or (H, W) uint8.

        Raises:
            InputError: its shape is not that of the images measured.
        """
        import cv2

        height, width = pixels.shape[:2]
        columns, rows = _sources(self, width, height)
        straight = cv2.remap(
            pixels, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(straight, np.uint8)


@lru_cache(maxsize=4)
def _sources(
    lens: Lens, width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where in the distorted image each pixel of the undistorted one is: columns, rows (H, W)."""
    camera = lens.camera(width, height)
    x, y = np.moveaxis(camera.pixel_rays()[..., :2], -1, 0)
    x, y = lens.distort(x, y)
    columns, rows = camera.fx * x + camera.cx - 0.5, camera.fy * y + camera.cy - 0.5
    return columns.astype(np.float32), rows.astype(np.float32)


@dataclass(frozen=True)
class LensFit:
    """A lens, and how well it is known."""

    lens: Lens
    views: int
    reprojection_px: float  # root mean square over all corners
    focal_error: float  # standard error of the focal lengths, the larger one, relative


def find_corners(pixels: Pixels, pattern: tuple[int, int]) -> Array | None:
    """Inner corners of a checkerboard.

    Args:
        pixels: (H, W, 3) or (H, W) uint8.
        pattern: inner corners in a row, and rows.

    Returns:
        (N, 2) u, v [px], the first pixel's centre at (0.5, 0.5); None where it is not seen whole.
    """
    import cv2

    grey = to_grey(pixels)
    found, corners = cv2.findChessboardCornersSB(grey, pattern)
    if not found:
        return None
    # It finds more boards than the older method, but places their corners less well.
    rows = np.asarray(corners).reshape(pattern[1], pattern[0], 2)
    spacing_px = float(np.linalg.norm(np.diff(rows, axis=1), axis=2).min())
    half = int(np.clip(spacing_px / 4.0, 2.0, 11.0))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    refined = cv2.cornerSubPix(grey, np.asarray(corners), (half, half), (-1, -1), criteria)
    return np.asarray(refined, np.float64).reshape(-1, 2) + 0.5


def fit_lens(views: Sequence[Array], pattern: tuple[int, int], size: tuple[int, int]) -> LensFit:
    """Intrinsics and distortion from views of one checkerboard, by OpenCV's calibration.

    The side of its squares does not matter.  [Zhang, A flexible new technique for camera
    calibration, 2000]

    Args:
        views: (N, 2) corners of `find_corners`, of different views.
        pattern: inner corners in a row, and rows.
        size: width and height of the images [px].

    Raises:
        InputError: too few views, or views that do not determine the lens.
    """
    import cv2

    if len(views) < MIN_VIEWS:
        raise InputError(
            f"lens: expected {MIN_VIEWS} views of the checkerboard or more, got {len(views)}; hold"
            " it nearer and flatter, and check the number of its inner corners (--checkerboard)"
        )
    coverage = np.ptp(np.concatenate(views), axis=0) / size
    if coverage.min() < MIN_COVERAGE:
        raise InputError(
            f"lens: expected corners over {MIN_COVERAGE:.0%} of the image's width and height or"
            f" more, got {coverage[0]:.0%} and {coverage[1]:.0%}; hold the checkerboard into every"
            " corner of the image too"
        )
    columns, rows = pattern
    plane = np.zeros((columns * rows, 3), np.float32)
    plane[:, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    error_px, K, bend, _, _, errors, _, _ = cv2.calibrateCameraExtended(
        [plane] * len(views), [(view - 0.5).astype(np.float32) for view in views], size,
        np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3,
    )  # fmt: skip
    focal_error = float(max(errors[0, 0] / K[0, 0], errors[1, 0] / K[1, 1]))
    if not (error_px < MAX_REPROJECTION_PX and focal_error < MAX_FOCAL_ERROR):
        raise InputError(
            f"lens: expected views that fit to {MAX_REPROJECTION_PX:g} px and give the focal length"
            f" to {MAX_FOCAL_ERROR:.0%}, got {error_px:.2f} px and {focal_error:.1%}; tilt the"
            " checkerboard by 20 to 40 deg to all sides, hold it still, mount it on something flat"
        )
    k1, k2, p1, p2 = bend.ravel()[:4].tolist()
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
    lens = Lens(size[0], size[1], fx, fy, cx, cy, k1, k2, p1, p2)
    return LensFit(lens, len(views), float(error_px), focal_error)
