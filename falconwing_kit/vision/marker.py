"""Marker pose: an image of the ArUco marker -> its corners and the two possible camera poses;
which other markers it shows.

A flat square seen small or straight on has two poses that look almost alike [Collins & Bartoli,
Infinitesimal plane-based pose estimation, IJCV 2014]. Both are kept with their covariances; the
motion of the aircraft decides between them (vision/hybrid_state.py). Pixel coordinates are the
kit's: the centre of the first pixel is at (0.5, 0.5).
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.images import Pixels, require_image, to_grey

DICTIONARIES = tuple(
    f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)
)
# Marker axes: x to the right as seen by a viewer, y up, z out of the print. The print faces the
# approach, -x of the world.
R_WORLD_MARKER: Array = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
CORNER_SIGMA_PX = 0.15  # measured on the hall's digital video
MIN_SIDE_PX = 8.0  # below, one bit of a 4 x 4 marker is about a pixel wide
MIN_FLATNESS = 0.15  # area / longest side^2; below, the view is too oblique
MIN_CORRELATION = 0.85  # with the template; the hall's video has 0.97, its analog link 0.9
QUIET_ZONE_CELLS = 0.5  # white border around the black square that is compared too
LENS_BLUR_PX = (0.35, 0.6, 0.9, 1.4)  # of lens and pixel area; the best fitting one is taken
MIN_SPREAD_PX = 0.3  # [px of the template] a narrower Gaussian falls between pixels
INK, PAPER = 0.04, 0.85  # reflectances
GAMMA = 2.2  # a pixel half black, half white is brighter than grey: black shapes look smaller
UPSCALE = 2.0  # for OpenCV's detector, which needs contours of some length
TEMPLATE_OVERSAMPLING = 2.0  # template pixels per image pixel; fewer shift its edges
MIN_CORNER_DEPTH = 0.1  # of a corner in front of the camera [m]; nearer ones have no pixel
SEARCH_REACH = 0.6  # around predicted corners, in sides of the marker
MIN_EDGE = 0.25  # of the median line's edge energy; below, a line's shift is undefined
Template = tuple[Pixels, Array]  # image of the printed marker, its corners in it (4, 2) [px]


@dataclass(frozen=True, eq=False)
class Marker:
    """A printed ArUco marker and its pose in the world; the default is the hall's.

    Raises:
        InputError: the dictionary is unknown, it has no such id, or the size is out of range.
    """

    dictionary: str = "DICT_4X4_50"
    id: int = 7
    size: float = 0.80  # side of the black square [m]
    T_world_marker: Array = field(
        default_factory=lambda: pose_matrix(R_WORLD_MARKER, (0.0, 0.0, 0.75))
    )  # origin in the marker's centre

    def __post_init__(self) -> None:
        if self.dictionary not in DICTIONARIES:
            raise InputError(
                f"marker: expected a dictionary such as DICT_4X4_50, got {self.dictionary!r}; "
                "use one of OpenCV's 4X4 to 7X7"
            )
        count = int(self.dictionary.rsplit("_", 1)[1])
        if not 0 <= self.id < count:
            raise InputError(
                f"marker: expected an id from 0 to {count - 1} in {self.dictionary}, "
                f"got {self.id}; give the printed id"
            )
        require_range("marker size", self.size, low=0.01, high=10.0)
        require_shape("T_world_marker", self.T_world_marker, (4, 4))

    @property
    def cells(self) -> int:
        """Cells along a side: the bits and the black frame."""
        return int(self.dictionary[5]) + 2

    @property
    def corners(self) -> Array:
        """(4, 3) in marker axes [m]: top left, top right, bottom right, bottom left to a viewer."""
        signs = [(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)]
        return 0.5 * self.size * np.array(signs)

    @property
    def p_world_corners(self) -> Array:
        """(4, 3) the same corners in the world [m]."""
        return self.corners @ self.T_world_marker[:3, :3].T + self.T_world_marker[:3, 3]


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """One detection: four corners and the two camera poses they allow, the better fitting first."""

    corners_px: Array  # (4, 2) u, v, in the order of Marker.corners
    correlation: float  # of the image with the template, 0..1
    T_camera_marker: Array  # (2, 4, 4)
    T_world_camera: Array  # (2, 4, 4)
    reprojection_px: Array  # (2,) root mean square over the eight coordinates
    covariance: Array  # (2, 6, 6) of position [m] and rotation vector [rad] in world axes
    # shifts of the image's lines to the right of the template's (H,), and of its columns down (W,)
    line_jitter_px: tuple[Array, Array] = (np.empty(0), np.empty(0))


def find_marker(
    image: Pixels,
    camera: PinholeCamera,
    marker: Marker | None = None,
    near_px: Array | None = None,
    horizontal_blur_px: float = 0.0,
) -> MarkerPose | None:
    """Detect the marker in an image and solve for both camera poses.

    OpenCV's detector reads the bits; then a template image of the marker is aligned with the frame
    by enhanced correlation [Evangelidis & Psarakis, PAMI 2008]. That uses the edges of all bits,
    which makes the corners about five times as accurate as the outline alone, and it works in noise
    where the outline breaks.

    Args:
        image: (H, W, 3) RGB or (H, W) grey, uint8.
        camera: intrinsics at the image's size.
        marker: None is the hall's.
        near_px: (4, 2) corners predicted to half a side, searched where the detector fails.
        horizontal_blur_px: of an analog link, see vision/analog_lines.py; 0 for a digital camera.

    Returns:
        The detection; None if there is no marker, or it is too small or seen too obliquely.

    Raises:
        InputError: the image is not of the camera's size, or horizontal_blur_px is out of range.
    """
    marker = Marker() if marker is None else marker
    require_range("horizontal_blur_px", horizontal_blur_px, low=0.0, high=5.0)
    grey = to_grey(require_image(image, camera))
    start = _detect(grey, marker)
    if start is None and near_px is not None:
        start = _search_near(grey, marker, require_shape("near_px", near_px, (4, 2)))
    if start is None:
        return None
    corners, correlation, best_template = _refine_corners(
        grey, marker, start, (horizontal_blur_px, 0.0)
    )
    if correlation < MIN_CORRELATION or not _is_good(corners):
        return None
    detection = _solve_poses(corners, correlation, camera, marker)
    if detection is None:
        return None
    return replace(detection, line_jitter_px=_line_jitter(grey, best_template, corners))


def template_correlation(
    image: Pixels, marker: Marker, corners_px: Array, blur_px: tuple[float, float]
) -> float:
    """Correlation of an image with the template aligned to it, 0..1; 0 where the alignment fails.

    Args:
        image: (H, W, 3) RGB or (H, W) grey, uint8.
        marker: the printed marker.
        corners_px: (4, 2) approximate corners.
        blur_px: of the template along the image's lines and across them; one of the two is 0.
    """
    return _refine_corners(to_grey(image), marker, corners_px, blur_px)[1]


def project_corners(marker: Marker, camera: PinholeCamera, T_world_camera: ArrayLike) -> Array:
    """(..., 4, 2) pixels of the marker's corners in cameras at poses (..., 4, 4).

    nan where a corner is less than MIN_CORNER_DEPTH in front of the camera.
    """
    T = np.asarray(T_world_camera, np.float64)
    p_camera = (marker.p_world_corners - T[..., None, :3, 3]) @ T[..., :3, :3]
    depth = np.where(p_camera[..., 2:] > MIN_CORNER_DEPTH, p_camera[..., 2:], np.nan)
    return np.asarray(p_camera[..., :2] / depth * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def pixel_jacobian(p_world: Array, camera: PinholeCamera, T_world_camera: Array) -> Array:
    """Derivative J of image points by the camera pose.

    For the covariance of a pose from known points: (J^T J)^-1 times the variance of a pixel
    coordinate.

    p_camera = R^T (p - c): moving the camera by dc gives -R^T dc, turning it by w gives
    R^T ((p - c) x w).

    Args:
        p_world: (K, 3) points in front of the camera [m].
        camera: intrinsics.
        T_world_camera: (4, 4).

    Returns:
        (2K, 6): u, v of each point [px] by position [m] and rotation vector [rad] in world axes.
    """
    R_world_camera, offset = T_world_camera[:3, :3], p_world - T_world_camera[:3, 3]
    x, y, z = (offset @ R_world_camera).T
    zero = np.zeros_like(z)
    # pinhole projection by p_camera: (K, 2, 3)
    d_pixel = np.array(
        [[camera.fx / z, zero, -camera.fx * x / z**2], [zero, camera.fy / z, -camera.fy * y / z**2]]
    ).transpose(2, 0, 1)
    # p - c by position (-1) and by rotation (columns (p - c) x e_i): (K, 3, 6)
    d_turn = np.cross(offset[:, :, None], np.eye(3)[None], axisa=1, axisb=1, axisc=1)
    d_world = np.concatenate([np.broadcast_to(-np.eye(3), (len(offset), 3, 3)), d_turn], axis=2)
    return np.asarray((d_pixel @ R_world_camera.T @ d_world).reshape(-1, 6))


def corner_noise(detections: Iterable[MarkerPose]) -> float:
    """Noise of one corner coordinate [px], from the reprojection errors of the better poses.

    Eight coordinates less six parameters of a pose leave two degrees of freedom: the sum of squares
    is sigma^2 chi2(2), whose median is 2 ln 2 sigma^2. The median is robust to outliers.

    Raises:
        InputError: there is no detection.
    """
    squares = np.array([8.0 * detection.reprojection_px[0] ** 2 for detection in detections])
    if len(squares) == 0:
        raise InputError(
            "marker: expected at least one detection to measure the noise of corners, got none; "
            "check that the video shows it"
        )
    return float(np.sqrt(np.median(squares) / (2.0 * np.log(2.0))))


def line_and_column_shifts(
    image: ArrayLike, expected: ArrayLike, inside: ArrayLike
) -> tuple[Array, Array]:
    """Shift of each line of an image to the right of an expected image, and of each column down.

    image(x) = a expected(x - s) + b along each line, to first order
    s = sum g (a expected + b - image) / sum g^2, with g the slope of a expected along the line
    [Lucas & Kanade, An iterative image registration technique, 1981, in one dimension].

    Args:
        image: (H, W) grey levels.
        expected: (H, W) the same up to contrast a and brightness b, which are fitted.
        inside: (H, W) bool, where to compare.

    Returns:
        (H,) and (W,) [px]; nan where there are too few edges.

    Raises:
        InputError: the three differ in shape.
    """
    image = require_shape("image", image, (None, None))
    expected = require_shape("expected", expected, image.shape)
    covered = require_shape("inside", inside, image.shape) > 0.5
    # contrast and brightness by least squares over all compared pixels
    design = np.stack([expected[covered], np.ones(int(covered.sum()))], axis=1)
    contrast, brightness = np.linalg.lstsq(design, image[covered], rcond=None)[0]
    model = contrast * expected + brightness
    residual = np.where(covered, model - image, 0.0)
    shifts = []
    for axis in (1, 0):  # along lines, then along columns
        slope = np.where(covered, np.gradient(model, axis=axis), 0.0)
        edges = (slope**2).sum(axis=axis)
        least = MIN_EDGE * np.median(edges[edges > 0.0]) if (edges > 0.0).any() else 0.0
        usable = edges > least
        shift = np.full(len(edges), np.nan)
        shift[usable] = (slope * residual).sum(axis=axis)[usable] / edges[usable]
        shifts.append(shift)
    return shifts[0], shifts[1]


def name_markers(image: Pixels) -> list[tuple[str, int]]:
    """Dictionary and id of every ArUco marker in an image, by the smallest dictionary that fits."""
    grey = to_grey(image)
    found: list[tuple[str, int]] = []
    for bits in (4, 5, 6, 7):
        ids: dict[int, str] = {}
        for name in DICTIONARIES:
            if name.startswith(f"DICT_{bits}"):
                for number, _ in _detect_all(grey, name):
                    ids.setdefault(number, name)
        found += [(name, number) for number, name in ids.items()]
    return found


def describe_other_markers(images: Iterable[Pixels | None], marker: Marker) -> str:
    """Error sentence for a video without its marker: expected, found instead, what to do.

    Args:
        images: some of its frames, None where one was lost.
        marker: the expected one.
    """
    others = Counter(name for image in images if image is not None for name in name_markers(image))
    expected = (
        f"expected frames that show the marker {marker.dictionary} {marker.id} "
        "or a pose network, got none"
    )
    if not others:
        return f"{expected}; check that it is in view and larger than {MIN_SIDE_PX:g} pixels"
    (dictionary, number), count = others.most_common(1)[0]
    return f"{expected}; {count} frames show {dictionary} {number}: name it, or print the right one"


@cache
def _detector(dictionary: str) -> Any:
    """OpenCV's detector, set for small markers, with corners refined to parts of a pixel."""
    import cv2

    settings = cv2.aruco.DetectorParameters()
    settings.minMarkerPerimeterRate = 0.02
    settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax = 3, 33
    settings.adaptiveThreshWinSizeStep = 6
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), settings
    )


def _detect_all(grey: Pixels, dictionary: str) -> list[tuple[int, Array]]:
    """Id and corners (4, 2) [px] of all markers of a dictionary."""
    import cv2

    large = cv2.resize(grey, None, fx=UPSCALE, fy=UPSCALE, interpolation=cv2.INTER_CUBIC)
    corners, ids, _ = _detector(dictionary).detectMarkers(large)
    numbers = [] if ids is None else np.ravel(ids).tolist()
    return [
        (n, (c[0].astype(np.float64) + 0.5) / UPSCALE)
        for n, c in zip(numbers, corners, strict=False)
    ]


def _detect(grey: Pixels, marker: Marker) -> Array | None:
    """Corners (4, 2) by OpenCV's detector; the largest if a window mirrors the marker."""
    found = [
        corners for number, corners in _detect_all(grey, marker.dictionary) if number == marker.id
    ]
    return max(found, key=_area) if found else None


@cache
def _render_template(
    dictionary: str, number: int, cells: int, cell_px: int, blur_px: float
) -> Template:
    """Template image of the marker, cell_px pixels a cell, blurred as by a lens before gamma."""
    import cv2

    fine = 32  # pixels a cell before scaling down
    quiet = round(QUIET_ZONE_CELLS * fine)
    bits = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    template = cv2.aruco.generateImageMarker(bits, number, cells * fine)
    template = cv2.copyMakeBorder(
        template, quiet, quiet, quiet, quiet, cv2.BORDER_CONSTANT, value=255
    )
    light: Any = INK + (PAPER - INK) * template / 255.0
    side = round((cells + 2 * QUIET_ZONE_CELLS) * cell_px)
    light = cv2.resize(light, (side, side), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), blur_px)
    low, high = QUIET_ZONE_CELLS * cell_px, (QUIET_ZONE_CELLS + cells) * cell_px
    image = np.asarray(np.rint(255.0 * light ** (1.0 / GAMMA)), np.uint8)
    return image, np.array([(low, low), (high, low), (high, high), (low, high)])


def _template_for(marker: Marker, corners: Array, blur_px: float = LENS_BLUR_PX[0]) -> Template:
    """The template, TEMPLATE_OVERSAMPLING times as large as in the image, with this blur there."""
    cell_image_px = np.sqrt(_area(corners)) / marker.cells
    cell_px = int(np.clip(round(TEMPLATE_OVERSAMPLING * cell_image_px), 4, 32))
    template_blur_px = max(0.1, round(blur_px * cell_px / cell_image_px, 1))  # 0 is no valid blur
    return _render_template(marker.dictionary, marker.id, marker.cells, cell_px, template_blur_px)


def _refine_corners(
    grey: Pixels, marker: Marker, corners: Array, blur_px: tuple[float, float]
) -> tuple[Array, float, Template]:
    """Corners and correlation (0 where alignment fails) of the best aligned template, and it.

    The lens blur is increased until the correlation falls.
    """
    best, highest, best_template = corners, 0.0, _template_for(marker, corners)
    for lens_blur_px in LENS_BLUR_PX:
        template, template_corners = _template_for(marker, corners, lens_blur_px)
        template = _blur_template(template, template_corners, corners, blur_px)
        moved, correlation = _align_template(grey, template, template_corners, best)
        if correlation <= highest:
            break
        best, highest, best_template = moved, correlation, (template, template_corners)
    return best, highest, best_template


def _blur_template(
    template: Pixels, template_corners: Array, corners: Array, blur_px: tuple[float, float]
) -> Pixels:
    """The template blurred along the image's lines, or across them, as by a link: after gamma.

    A link's blur is a segment in the image; the homography takes it to a direction in the
    template, along which the kernel is an elongated Gaussian.
    """
    import cv2

    to_template = cv2.getPerspectiveTransform(
        corners.astype(np.float32), template_corners.astype(np.float32)
    )
    ends = corners.mean(axis=0) + np.outer((-0.5, 0.5), blur_px)
    left, right = cv2.perspectiveTransform(ends[None], to_template)[0]
    reach = int(np.ceil(3.0 * np.linalg.norm(right - left)))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    offsets = np.stack([u, v])
    covariance = np.outer(right - left, right - left) + MIN_SPREAD_PX**2 * np.eye(2)
    chi2 = np.einsum("iuv,ij,juv->uv", offsets, np.linalg.inv(covariance), offsets)
    kernel = np.exp(-0.5 * chi2)
    blurred = cv2.filter2D(template, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.uint8)


def _homography(template_corners: Array, corners: Array) -> Any:
    """Template to image, in OpenCV's coordinates: the first pixel's centre at (0, 0)."""
    import cv2

    return cv2.getPerspectiveTransform(
        (template_corners - 0.5).astype(np.float32), (corners - 0.5).astype(np.float32)
    )


def _align_template(
    grey: Pixels, template: Pixels, template_corners: Array, corners: Array
) -> tuple[Array, float]:
    """Corners at which a template correlates best with the image, from approximate ones."""
    import cv2

    start = _homography(template_corners, corners).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-5)
    everywhere, no_blur = np.full_like(grey, 255), 1  # a blur would make the marker look smaller
    try:
        correlation, H = cv2.findTransformECC(
            template, grey, start, cv2.MOTION_HOMOGRAPHY, stop, everywhere, no_blur
        )
    except cv2.error:  # "images may be uncorrelated": there is no marker here
        return corners, 0.0
    H = np.asarray(H, np.float64)
    aligned = cv2.perspectiveTransform((template_corners - 0.5)[None], H)[0] + 0.5
    return np.asarray(aligned, np.float64), float(correlation)


def _line_jitter(grey: Pixels, best_template: Template, corners: Array) -> tuple[Array, Array]:
    """Shifts of the image's lines and columns against the aligned template."""
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
    cut = grey[low[1] : int(corners[:, 1].max()) + 4, low[0] : int(corners[:, 0].max()) + 4]
    expected, inside = _warp_template(*best_template, corners - low, cut.shape[::-1])
    return line_and_column_shifts(cut, expected, inside)


def _warp_template(
    template: Pixels, template_corners: Array, corners: Array, size: Sequence[int]
) -> tuple[Pixels, NDArray[np.bool_]]:
    """A template warped into an image of (width, height), and the mask of pixels it covers."""
    import cv2

    H = _homography(template_corners, corners)
    warped = cv2.warpPerspective(template, H, size, borderMode=cv2.BORDER_REPLICATE)
    covered = cv2.warpPerspective(np.full_like(template, 255), H, size)
    return np.asarray(warped, np.uint8), np.asarray(covered) == 255


def _search_near(grey: Pixels, marker: Marker, near: Array) -> Array | None:
    """Predicted corners, shifted to where the template correlates best around them."""
    import cv2

    height, width = grey.shape
    reach = SEARCH_REACH * np.sqrt(_area(near))
    low = np.floor(near.min(axis=0) - reach).astype(int)
    high = np.ceil(near.max(axis=0) + reach).astype(int)
    if not _is_good(near) or (low < 0).any() or (high > (width, height)).any():
        return None
    # the template, tilted as predicted, in the smallest box around the corners
    corner = np.floor(near.min(axis=0)).astype(int)
    size = np.ceil(near.max(axis=0)).astype(int) - corner
    tilted, _ = _warp_template(*_template_for(marker, near), near - corner, size.tolist())
    area = grey[low[1] : high[1], low[0] : high[0]]
    correlation = cv2.matchTemplate(area, tilted, cv2.TM_CCOEFF_NORMED)
    _, _, _, best = cv2.minMaxLoc(correlation)
    return np.asarray(near + (low + best - corner))


def _area(corners: Array) -> float:
    """Area of a quadrangle [px^2], by the shoelace formula."""
    x, y = np.asarray(corners).T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def _is_good(corners: Array) -> bool:
    """Whether a quadrangle is finite, large enough and not too oblique for a pose."""
    if not np.isfinite(corners).all():
        return False
    area = _area(corners)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max()
    return area >= MIN_SIDE_PX**2 and area >= MIN_FLATNESS * longest**2


def _solve_poses(
    corners: Array, correlation: float, camera: PinholeCamera, marker: Marker
) -> MarkerPose | None:
    """Both poses of four corners, with covariances sigma^2 (J^T J)^-1, J = d(corners)/d(pose)."""
    import cv2

    found, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        marker.corners, corners, camera.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if found < 2 or not (np.isfinite(rvecs).all() and np.isfinite(tvecs).all()):
        return None
    R = np.array([cv2.Rodrigues(rvec)[0] for rvec in rvecs[:2]])
    T_camera_marker = pose_matrix(R, np.array(tvecs[:2])[..., 0])
    T_world_camera = marker.T_world_marker @ np.linalg.inv(T_camera_marker)
    projected = project_corners(marker, camera, T_world_camera)
    if not np.isfinite(projected).all():
        return None
    # the better fitting pose first
    reprojection_px = np.sqrt(((projected - corners) ** 2).mean(axis=(1, 2)))
    order = np.argsort(reprojection_px)
    T_camera_marker, T_world_camera = T_camera_marker[order], T_world_camera[order]
    J = [pixel_jacobian(marker.p_world_corners, camera, T) for T in T_world_camera]
    covariance = np.array([CORNER_SIGMA_PX**2 * np.linalg.pinv(j.T @ j) for j in J])
    return MarkerPose(
        corners, correlation, T_camera_marker, T_world_camera, reprojection_px[order], covariance
    )
