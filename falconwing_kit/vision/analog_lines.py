"""Analog video lines: detections of the marker -> the link's horizontal blur and its line jitter.

An analog link changes the marker in two ways that a digital camera does not:

- Its bandwidth is small, so that images are soft along the lines but not across them. A reference
  print with equal blur both ways then fits a marker that is half a pixel too wide and appears
  tilted by some degrees (`estimate_horizontal_blur`, `redetect_blurred`).
- The receiver follows noisy sync pulses with a flywheel, so that lines start early or late, and
  neighbouring lines together. A small square on such lines is sheared, which looks like a rotated
  square: its corners still fit a pose exactly, and the reprojection error does not show the shift
  (`sync_jitter_px`, `corner_covariance`).
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from falconwing_kit.core.checks import Array, require_range, require_shape
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.images import Pixels
from falconwing_kit.vision.marker import Marker, MarkerPose, find_marker, template_correlation

BLUR_GRID_PX = np.array([0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8])
MAX_DETECTIONS = 20  # more of them change the blur by less than 0.1 px
CORRELATION_LINES = 24.0  # correlation length; measured: the trained hall and its analog photos
MIN_LINES = 6  # of a print: two numbers are fitted to them, and two variances to the rest


def redetect_blurred(
    image: Callable[[int], Pixels | None],
    detections: Mapping[int, MarkerPose],
    camera: PinholeCamera,
    marker: Marker,
) -> tuple[dict[int, MarkerPose], float]:
    """Estimate the link's horizontal blur and repeat the detections with a print blurred equally.

    Args:
        image: frame -> (H, W, 3) RGB; None where it was lost.
        detections: by frame, found with a print of equal blur both ways.
        camera: at the size of the images.
        marker: the printed marker.

    Returns:
        The detections that succeed again, and the blur [px]; the same detections if it is 0.
    """
    horizontal_blur_px = estimate_horizontal_blur(image, detections, marker)
    if horizontal_blur_px == 0.0:
        return dict(detections), 0.0
    redetected: dict[int, MarkerPose] = {}
    for frame, detection in detections.items():
        pixels = image(frame)
        if pixels is None:
            continue
        found = find_marker(
            pixels, camera, marker, detection.corners_px, horizontal_blur_px=horizontal_blur_px
        )
        if found is not None:
            redetected[frame] = found
    return redetected, horizontal_blur_px


def estimate_horizontal_blur(
    image: Callable[[int], Pixels | None], detections: Mapping[int, MarkerPose], marker: Marker
) -> float:
    """Blur along the lines in excess of the blur across them, by the best correlation of the print.

    Variances of independent blurs add, and camera motion blurs both directions equally:

        link^2 = along^2 - across^2

    Args:
        image: frame -> (H, W, 3) RGB; None where it was lost.
        detections: by frame.
        marker: the printed marker.

    Returns:
        Standard deviation [px]; 0 without detections, or if the blur across is as large.
    """
    frames = np.array(list(detections), int)
    if len(frames) > MAX_DETECTIONS:
        frames = frames[np.linspace(0, len(frames) - 1, MAX_DETECTIONS).astype(int)]
    views = [
        (pixels, detections[k].corners_px) for k in frames if (pixels := image(int(k))) is not None
    ]
    if not views:
        return 0.0

    def best_blur(direction: tuple[float, float]) -> float:
        """The blur along a direction [px] whose print correlates best, over all views."""
        residuals = [
            np.mean(
                [
                    _log_residual(pixels, corners_px, marker, blur * np.array(direction))
                    for pixels, corners_px in views
                ]
            )
            for blur in BLUR_GRID_PX
        ]
        return _parabola_minimum(residuals)

    along, across = best_blur((1.0, 0.0)), best_blur((0.0, 1.0))
    return float(np.sqrt(max(along**2 - across**2, 0.0)))


def _log_residual(pixels: Pixels, corners_px: Array, marker: Marker, blur_px: Array) -> float:
    """log(1 - correlation^2) of a print blurred by (along, across) [px].

    The residual's share of the image contrast; for Gaussian noise the negative log likelihood is
    proportional to its logarithm.
    """
    blur = (float(blur_px[0]), float(blur_px[1]))
    correlation = template_correlation(pixels, marker, corners_px, blur)
    return float(np.log(max(1.0 - correlation**2, 1e-6)))


def _parabola_minimum(residuals: list[np.floating]) -> float:
    """Minimum [px] of the parabola through the smallest residual of the grid and its neighbours."""
    smallest = int(np.argmin(residuals))
    if smallest == 0:
        return 0.0
    k = min(smallest, len(BLUR_GRID_PX) - 2)
    before, here, after = residuals[k - 1 : k + 2]
    curvature = before - 2.0 * here + after
    step = 0.5 * (before - after) / curvature if curvature > 0.0 else 0.0
    return float(BLUR_GRID_PX[k] + np.clip(step, -1.0, 1.0) * (BLUR_GRID_PX[1] - BLUR_GRID_PX[0]))


def line_correlation(rows: Array) -> Array:
    """Correlation (..., K, K) of the shifts of lines (..., K).

    exp(-|difference| / CORRELATION_LINES)  [first-order lock of a line oscillator]
    """
    return np.asarray(np.exp(-np.abs(rows[..., :, None] - rows[..., None, :]) / CORRELATION_LINES))


def sync_jitter_px(shifts: Iterable[tuple[Array, Array]]) -> float:
    """Line jitter of a video: standard deviation of the shift that neighbouring lines share.

    Misfit of the print and image noise shift lines and columns equally; the link shifts lines only.
    Therefore the shared variance of the columns is subtracted.

    Args:
        shifts: of lines and of columns, for each detection: `MarkerPose.line_jitter_px`.

    Returns:
        [px]; 0 if columns shift as much as lines, or too few lines are covered.
    """
    pairs = list(shifts)
    lines, columns = (_shared_variance([pair[axis] for pair in pairs]) for axis in (0, 1))
    return float(np.sqrt(max(lines - columns, 0.0)))


def corner_covariance(corners_px: Array, sigma_px: float, sync_jitter: float) -> Array:
    """Covariance of marker corners: independent noise, and the line jitter that corners share.

    Args:
        corners_px: (M, 4, 2).
        sigma_px: noise of one coordinate [px], > 0.
        sync_jitter: standard deviation of a line's shift [px], >= 0.

    Returns:
        (M, 8, 8) of u1 v1 ... u4 v4 [px^2].

    Raises:
        InputError: a size is out of range, or the corners have another shape.
    """
    corners_px = require_shape("corners_px", corners_px, (None, 4, 2))
    require_range("sigma_px", sigma_px, low=1e-6)
    require_range("sync_jitter", sync_jitter, low=0.0)
    covariance = np.broadcast_to(sigma_px**2 * np.eye(8), (len(corners_px), 8, 8)).copy()
    # only the u coordinates (even rows and columns) shift with their lines
    covariance[:, ::2, ::2] += sync_jitter**2 * line_correlation(corners_px[..., 1])
    return covariance


def _shared_variance(shifts: list[Array]) -> float:
    """Variance s of the shift that neighbours share [px^2], by the method of moments.

    The homography of each print has removed mean and slope, which is the projection P:
    e = P (white noise of variance r + shared shift of variance s). Two sums of squares are equated
    with their expectations [Searle, Variance components]:

        |e|^2   = r tr(P)       + s tr(P C)          C = line_correlation
        |D e|^2 = r tr(D P D^T) + s tr(D P C P D^T)  D: differences of neighbours
    """
    found, expected = np.zeros(2), np.zeros((2, 2))
    for shift in shifts:
        rows = np.flatnonzero(np.isfinite(shift))
        if len(rows) < MIN_LINES:
            continue
        # P = 1 - Q Q^T, Q an orthonormal basis of constant and linear shifts
        Q = np.linalg.qr(np.stack([np.ones(len(rows)), rows - rows.mean()], axis=1))[0]
        P = np.eye(len(rows)) - Q @ Q.T
        PCP = P @ line_correlation(rows.astype(float)) @ P
        D = np.diff(np.eye(len(rows)), axis=0)[np.diff(rows) == 1]
        e = P @ shift[rows]
        found += e @ e, (D @ e) @ (D @ e)
        expected += [[np.trace(P), np.trace(PCP)], [np.trace(D @ P @ D.T), np.trace(D @ PCP @ D.T)]]
    if not expected[1].any():  # no print covers two neighbouring lines
        return 0.0
    return float(np.linalg.solve(expected, found)[1])
