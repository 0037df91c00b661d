"""Marker pose: an image that shows the ArUco marker -> both camera poses that explain it, and how
well each is known.

A flat square seen small or straight on has two poses that look almost alike [Collins & Bartoli,
Infinitesimal plane-based pose estimation, IJCV 2014]. Both are kept; what the aircraft can have
done decides between them (`hybrid_state`). Pixel coordinates are the kit's: the first pixel's
centre is at (0.5, 0.5).
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
from falconwing_kit.vision.line_jitter import line_and_column_shifts

DICTIONARIES = tuple(
    f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)
)
# x to the right of who looks at the marker, y up, z out of it: it faces the approach, -x of the
# world.
R_WORLD_MARKER: Array = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
CORNER_SIGMA_PX = (
    0.15  # measured: the hall's digital video, 2 px of freedom left by four corners and one pose
)
MIN_SIDE_PX = 8.0  # below, a bit of a 4 x 4 marker is hardly a pixel wide
MIN_FLATNESS = 0.15  # area over longest side squared; below, the marker is seen from too far aside
MIN_CORRELATION = (
    0.85  # correlation with the printed marker; the hall's video has 0.97, its analog link 0.9
)
QUIET_ZONE_CELLS = 0.5  # white around the black square that is compared too, in cells
PRINT_BLUR_PX = (
    0.35,
    0.6,
    0.9,
    1.4,
)  # blur of a lens and of averaging over pixels: what fits best is taken
MIN_SPREAD_PX = 0.3  # a Gaussian narrower than that falls between pixels [px of the print]
INK, PAPER = 0.04, 0.85  # shares of the light they send back
# of cameras: a pixel half black, half white is brighter than grey, which makes black shapes look
# smaller
GAMMA = 2.2
UPSCALE = 2.0  # the detector looks for contours, which small markers hardly have
# pixels of a print to one of the image: on fewer a small print's own raster moves its edges
PRINT_OVERSAMPLING = 2.0
NO_JITTER: tuple[Array, Array] = (np.empty(0), np.empty(0))
Pixels = NDArray[np.uint8]
Print = tuple[Pixels, Array]  # a drawn marker, and where its corners are in it (4, 2) [px]


@dataclass(frozen=True, eq=False)
class Marker:
    """A printed ArUco marker and its place in the world; the default is the hall's.

    Raises:
        InputError: the dictionary is unknown, it has no such id, or the size is not that of a
            print.
    """

    dictionary: str = "DICT_4X4_50"
    id: int = 7
    size: float = 0.80  # side of the black square [m]
    T_world_marker: Array = field(
        default_factory=lambda: pose_matrix(R_WORLD_MARKER, (0.0, 0.0, 0.75))
    )  # its centre

    def __post_init__(self) -> None:
        """Check what was printed."""
        if self.dictionary not in DICTIONARIES:
            raise InputError(
                f"marker: expected a dictionary such as DICT_4X4_50, got {self.dictionary!r}"
            )
        count = int(self.dictionary.rsplit("_", 1)[1])
        if not 0 <= self.id < count:
            raise InputError(
                f"marker: expected an id from 0 to {count - 1} in {self.dictionary}, got {self.id}"
            )
        require_range("marker size", self.size, low=0.01, high=10.0)
        require_shape("T_world_marker", self.T_world_marker, (4, 4))

    @property
    def corners(self) -> Array:
        """(4, 3) corners in marker axes [m]: top left, top right, bottom right, bottom left of who
        looks at it.
        """
        return (
            0.5
            * self.size
            * np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)])
        )

    @property
    def p_world_corners(self) -> Array:
        """(4, 3) the same corners in the world [m]."""
        return self.corners @ self.T_world_marker[:3, :3].T + self.T_world_marker[:3, 3]


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """One sight of the marker: four corners, and the two camera poses they allow, the likelier
    first.
    """

    corners_px: Array  # (4, 2) u, v, in the order of Marker.corners
    correlation: float  # correlation of the image with the printed marker, 0..1
    T_camera_marker: Array  # (2, 4, 4)
    T_world_camera: Array  # (2, 4, 4)
    reprojection_px: Array  # (2,) root mean square over the eight coordinates
    covariance: (
        Array  # (2, 6, 6) of the camera's place [m] and of a small turn [rad], both in world axes
    )
    line_jitter_px: tuple[Array, Array] = (
        NO_JITTER  # how far the image's lines lie right of the print's, columns below
    )

    @property
    def side_px(self) -> float:
        """Square root of the marker's area in the image."""
        return float(np.sqrt(_area(self.corners_px)))


def find_marker(
    image: Pixels,
    camera: PinholeCamera,
    marker: Marker | None = None,
    near_px: Array | None = None,
    corner_sigma_px: float = CORNER_SIGMA_PX,
    horizontal_blur_px: float = 0.0,
) -> MarkerPose | None:
    """Look for the marker in an image.

    OpenCV's detector reads the bits; then the printed marker is laid over the image so that the two
    correlate best [enhanced correlation, Evangelidis & Psarakis, PAMI 2008]. All edges of all bits
    have their say, which makes the corners about five times as sharp as those of the outline alone,
    and finds them in noise where the outline breaks.

    Args:
        image: (H, W, 3) RGB or (H, W) grey, uint8.
        camera: its intrinsics, of the same size.
        marker: what to look for; None is the hall's.
        near_px: (4, 2) where its corners are expected to half a side; looked at where the detector
            finds nothing.
        corner_sigma_px: noise of a corner, for the covariance.
        smear_px: how soft an analog link makes the lines, see `link.smear`; 0 for a digital camera.

    Returns:
        The sight; None where the marker is not seen, is too small or seen from too far aside.

    Raises:
        InputError: the image is no picture or not of the camera's size, or smear_px is out of
            range.
    """
    marker = Marker() if marker is None else marker
    require_range("horizontal_blur_px", horizontal_blur_px, low=0.0, high=5.0)
    grey = _grey(image, camera)
    start = _detect(grey, marker)
    if start is None and near_px is not None:
        start = _search_near(grey, marker, require_shape("near_px", near_px, (4, 2)))
    if start is None:
        return None
    corners, correlation, drawn = _refine_corners(grey, marker, start, (horizontal_blur_px, 0.0))
    if correlation < MIN_CORRELATION or not _is_good(corners):
        return None
    detection = _solve_poses(corners, correlation, camera, marker, corner_sigma_px)
    return (
        None
        if detection is None
        else replace(detection, line_jitter_px=_line_jitter(grey, drawn, corners))
    )


def print_correlation(
    image: Pixels, marker: Marker, corners_px: Array, horizontal_blur_px: tuple[float, float]
) -> float:
    """Correlation of an image with the print laid over it.

    Args:
        image: (H, W, 3) RGB or (H, W) grey, uint8.
        marker: what was printed.
        corners_px: (4, 2) about where its corners are.
        smear_px: how soft the print is made along the image's lines, and across them; one of them
            is 0.

    Returns:
        0..1; 0 where the print gets lost.
    """
    return _refine_corners(_grey(image, None), marker, corners_px, horizontal_blur_px)[1]


def project_corners(marker: Marker, camera: PinholeCamera, T_world_camera: ArrayLike) -> Array:
    """Where the marker's corners appear to cameras.

    Args:
        marker: with its place.
        camera: the intrinsics.
        T_world_camera: (..., 4, 4).

    Returns:
        (..., 4, 2) pixels; nan where a corner is less than 0.1 m in front of the camera.
    """
    T = np.asarray(T_world_camera, np.float64)
    p_camera = (marker.p_world_corners - T[..., None, :3, 3]) @ T[..., :3, :3]
    depth = np.where(p_camera[..., 2:] > 0.1, p_camera[..., 2:], np.nan)
    return np.asarray(p_camera[..., :2] / depth * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def corner_noise(detections: Iterable[MarkerPose]) -> float:
    """Noise of one corner coordinate, from what the better pose leaves over.

    Eight coordinates less six numbers of a pose leave two: E[sum of squares] = 2 sigma^2, so the
        mean square over the
    eight is sigma^2 / 4. The median of chi-squared with two degrees of freedom is 2 ln 2, which
    outliers do not move.

    Args:
        sights: of one camera, at least one.

    Returns:
        Standard deviation [px].

    Raises:
        InputError: there is no sight.
    """
    left = np.array([8.0 * detection.reprojection_px[0] ** 2 for detection in detections])
    if len(left) == 0:
        raise InputError(
            "marker: expected at least one sight of it to measure the noise of corners, got none"
        )
    return float(np.sqrt(np.median(left) / (2.0 * np.log(2.0))))


def name_markers(image: Pixels) -> list[tuple[str, int]]:
    """Which ArUco markers of the usual dictionaries an image shows, for telling what was printed
    instead.

    Args:
        image: (H, W, 3) RGB or (H, W) grey, uint8.

    Returns:
        Dictionary and id of each; the smallest dictionary that knows it.
    """
    grey = _grey(image, None)
    seen: list[tuple[str, int]] = []
    for bits in (4, 5, 6, 7):
        for name in (name for name in DICTIONARIES if name.startswith(f"DICT_{bits}")):
            new = [(name, number) for number, _ in _detect_all(grey, name)]
            seen += [
                one
                for one in new
                if one[1] not in [n for d, n in seen if d.startswith(f"DICT_{bits}")]
            ]
    return seen


def describe_other_markers(images: Iterable[Pixels | None], marker: Marker) -> str:
    """A sentence for a video that does not show its marker.

    Args:
        images: some of its frames, None where one was lost.
        marker: what was looked for.

    Returns:
        What was wanted, what the frames show instead, and what to do.
    """
    others = Counter(name for image in images if image is not None for name in name_markers(image))
    want = f"expected frames that show the marker {marker.dictionary} {marker.id} or a pose network, got none"
    if not others:
        return f"{want}; check that it is in view and larger than {MIN_SIDE_PX:g} pixels"
    (dictionary, number), count = others.most_common(1)[0]
    return f"{want}; {count} frames show {dictionary} {number}: name it, or print the right one"


def _grey(image: Pixels, camera: PinholeCamera | None) -> Pixels:
    """The image as grey, if it is a picture of the camera's size."""
    import cv2

    got = f"{getattr(image, 'shape', '')} {getattr(image, 'dtype', type(image).__name__)}".strip()
    if (
        not isinstance(image, np.ndarray)
        or image.dtype != np.uint8
        or image.ndim not in (2, 3)
        or not image.size
    ):
        raise InputError(
            f"image: expected (H, W, 3) or (H, W) uint8, got {got}; decode a JPEG first"
        )
    if camera is not None and image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"image: expected the camera's {camera.width} x {camera.height} pixels, got {got}; scale the camera"
        )
    return np.asarray(
        image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8
    )


@cache
def _detector(dictionary: str) -> Any:
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
    """Corners of the marker by OpenCV's detector; the largest where it is seen twice (a mirror in a
    window).
    """
    found = [
        corners for number, corners in _detect_all(grey, marker.dictionary) if number == marker.id
    ]
    return max(found, key=_area) if found else None


@cache
def _print(dictionary: str, number: int, cell_px: int, print_blur_px: float) -> Print:
    """The marker as printed, cell_px pixels a cell."""
    import cv2

    cells = int(dictionary[5]) + 2  # bits and the black frame
    fine = 32
    quiet = round(QUIET_ZONE_CELLS * fine)
    bits = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    drawn = cv2.aruco.generateImageMarker(bits, number, cells * fine)
    drawn = cv2.copyMakeBorder(drawn, quiet, quiet, quiet, quiet, cv2.BORDER_CONSTANT, value=255)
    light: Any = INK + (PAPER - INK) * drawn / 255.0
    side = round((cells + 2 * QUIET_ZONE_CELLS) * cell_px)
    light = cv2.GaussianBlur(
        cv2.resize(light, (side, side), interpolation=cv2.INTER_AREA), (0, 0), print_blur_px
    )
    low, high = QUIET_ZONE_CELLS * cell_px, (QUIET_ZONE_CELLS + cells) * cell_px
    seen = np.asarray(np.rint(255.0 * light ** (1.0 / GAMMA)), np.uint8)
    return seen, np.array([(low, low), (high, low), (high, high), (low, high)])


def _print_for(marker: Marker, corners: Array, print_blur_px: float = PRINT_BLUR_PX[0]) -> Print:
    """The print at FINE times the size it has in the image, where it is as soft as given."""
    cells = int(marker.dictionary[5]) + 2
    cell_seen_px = np.sqrt(_area(corners)) / cells
    cell_px = int(np.clip(round(PRINT_OVERSAMPLING * cell_seen_px), 4, 32))
    drawn_px = max(
        0.1, round(print_blur_px * cell_px / cell_seen_px, 1)
    )  # a huge marker's blur must not become 0
    return _print(marker.dictionary, marker.id, cell_px, drawn_px)


def _refine_corners(
    grey: Pixels, marker: Marker, corners: Array, horizontal_blur_px: tuple[float, float]
) -> tuple[Array, float, Print]:
    """Corners where a print correlates best with the image, that correlation (0 where lost), and
    which print.
    """
    best, most, fits = corners, 0.0, _print_for(marker, corners)
    for print_blur_px in PRINT_BLUR_PX:
        drawn, places = _print_for(marker, corners, print_blur_px)
        drawn = _blur_print(drawn, places, corners, horizontal_blur_px)
        moved, correlation = _align_print(grey, drawn, places, best)
        if correlation <= most:
            break
        best, most, fits = moved, correlation, (drawn, places)
    return best, most, fits


def _blur_print(
    drawn: Pixels, places: Array, corners: Array, horizontal_blur_px: tuple[float, float]
) -> Pixels:
    """A print as a link of little bandwidth shows it: soft along the image's lines, and after
    gamma, not before.

    The sizes are along the image's lines and across them, one of which is 0.
    """
    import cv2

    to_print = cv2.getPerspectiveTransform(corners.astype(np.float32), places.astype(np.float32))
    ends = corners.mean(axis=0) + np.outer((-0.5, 0.5), horizontal_blur_px)
    left, right = cv2.perspectiveTransform(ends[None], to_print)[0]
    reach = int(np.ceil(3.0 * np.linalg.norm(right - left)))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    spread = np.outer(right - left, right - left) + MIN_SPREAD_PX**2 * np.eye(2)
    weight = np.exp(
        -0.5
        * np.einsum("iuv,ij,juv->uv", np.stack([u, v]), np.linalg.inv(spread), np.stack([u, v]))
    )
    return np.asarray(
        cv2.filter2D(drawn, -1, weight / weight.sum(), borderType=cv2.BORDER_REPLICATE), np.uint8
    )


def _align_print(grey: Pixels, drawn: Pixels, places: Array, corners: Array) -> tuple[Array, float]:
    """One print moved from expected corners to where it correlates best."""
    import cv2

    start = cv2.getPerspectiveTransform(
        (places - 0.5).astype(np.float32), (corners - 0.5).astype(np.float32)
    )
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-5)
    try:
        correlation, H = (
            cv2.findTransformECC(  # 1: no further blur, which would make the marker seem smaller
                drawn,
                grey,
                start.astype(np.float32),
                cv2.MOTION_HOMOGRAPHY,
                stop,
                np.full_like(grey, 255),
                1,
            )
        )
    except cv2.error:  # "images may be uncorrelated": there is no marker here
        return corners, 0.0
    places = cv2.perspectiveTransform((places - 0.5)[None], np.asarray(H, np.float64))[0] + 0.5
    return np.asarray(places, np.float64), float(correlation)


def _line_jitter(grey: Pixels, drawn: Print, corners: Array) -> tuple[Array, Array]:
    """How far the image's lines and columns stray from the print laid over it."""
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
    seen = grey[low[1] : int(corners[:, 1].max()) + 4, low[0] : int(corners[:, 0].max()) + 4]
    expected, inside = _warp_print(*drawn, corners - low, seen.shape[::-1])
    return line_and_column_shifts(seen, expected, inside)


def _warp_print(
    drawn: Pixels, places: Array, corners: Array, size: Sequence[int]
) -> tuple[Pixels, NDArray[np.bool_]]:
    """A print as seen with its corners there, in an image of this size (width, height), and where
    it covers it.
    """
    import cv2

    H = cv2.getPerspectiveTransform(
        (places - 0.5).astype(np.float32), (corners - 0.5).astype(np.float32)
    )
    seen = cv2.warpPerspective(drawn, H, size, borderMode=cv2.BORDER_REPLICATE)
    covered = cv2.warpPerspective(np.full_like(drawn, 255), H, size)
    return np.asarray(seen, np.uint8), np.asarray(covered) == 255


def _search_near(grey: Pixels, marker: Marker, near: Array) -> Array | None:
    """Corners near expected ones: the print, tilted as expected, shifted to where it correlates
    best.
    """
    import cv2

    height, width = grey.shape
    reach = 0.6 * np.sqrt(_area(near))
    low = np.floor(near.min(axis=0) - reach).astype(int)
    high = np.ceil(near.max(axis=0) + reach).astype(int)
    if not _is_good(near) or (low < 0).any() or (high > (width, height)).any():
        return None
    drawn, places = _print_for(marker, near)
    corner = np.floor(near.min(axis=0)).astype(int)
    size = np.ceil(near.max(axis=0)).astype(int) - corner
    expected, _ = _warp_print(drawn, places, near - corner, size.tolist())
    correlation = cv2.matchTemplate(
        grey[low[1] : high[1], low[0] : high[0]], expected, cv2.TM_CCOEFF_NORMED
    )
    _, _, _, best = cv2.minMaxLoc(correlation)
    return np.asarray(near + (low + best - corner))


def _area(corners: Array) -> float:
    """Area of a quadrangle [px^2], by the shoelace formula."""
    x, y = np.asarray(corners).T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def _is_good(corners: Array) -> bool:
    """Large and flat-on enough for a pose to be read off."""
    if not np.isfinite(corners).all():
        return False
    area, longest = (
        _area(corners),
        np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max(),
    )
    return area >= MIN_SIDE_PX**2 and area >= MIN_FLATNESS * longest**2


def _solve_poses(
    corners: Array, correlation: float, camera: PinholeCamera, marker: Marker, sigma_px: float
) -> MarkerPose | None:
    """The two poses of four corners, and their covariances sigma^2 (J^T J)^-1 with J =
    d(corners)/d(pose).
    """
    import cv2

    found, turns, places, _ = cv2.solvePnPGeneric(
        marker.corners, corners, camera.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if found < 2 or not (np.isfinite(turns).all() and np.isfinite(places).all()):
        return None
    R = np.array([cv2.Rodrigues(turn)[0] for turn in turns[:2]])
    T_camera_marker = pose_matrix(R, np.array(places[:2])[..., 0])
    T_world_camera = marker.T_world_marker @ np.linalg.inv(T_camera_marker)
    seen = project_corners(marker, camera, T_world_camera)
    if not np.isfinite(seen).all():
        return None
    misfit = np.sqrt(((seen - corners) ** 2).mean(axis=(1, 2)))
    order = np.argsort(misfit)
    T_camera_marker, T_world_camera = T_camera_marker[order], T_world_camera[order]
    J = [pixel_jacobian(marker.p_world_corners, camera, T) for T in T_world_camera]
    covariance = np.array([sigma_px**2 * np.linalg.pinv(j.T @ j) for j in J])
    return MarkerPose(
        corners, correlation, T_camera_marker, T_world_camera, misfit[order], covariance
    )


def pixel_jacobian(p_world: Array, camera: PinholeCamera, T_world_camera: Array) -> Array:
    """How points move in the image when the camera moves.

    p_camera = R^T (p - c): moving the camera by dc gives -R^T dc, turning it by w gives R^T ((p -
    c) x w).

    Args:
        p_world: (K, 3) points in front of the camera [m].
        camera: the intrinsics.
        T_world_camera: (4, 4).

    Returns:
        (2K, 6): u, v of each point [px] by the camera's place [m] and a small turn [rad], both in
        world axes.
    """
    R_world_camera, away = T_world_camera[:3, :3], p_world - T_world_camera[:3, 3]
    x, y, z = (away @ R_world_camera).T
    zero = np.zeros_like(z)
    d_pixel = np.array(
        [[camera.fx / z, zero, -camera.fx * x / z**2], [zero, camera.fy / z, -camera.fy * y / z**2]]
    ).transpose(2, 0, 1)  # (K, 2, 3) by p_camera
    d_turn = np.cross(away[:, :, None], np.eye(3)[None], axisa=1, axisb=1, axisc=1)
    d_world = np.concatenate([np.broadcast_to(-np.eye(3), (len(away), 3, 3)), d_turn], axis=2)
    return np.asarray((d_pixel @ R_world_camera.T @ d_world).reshape(-1, 6))
