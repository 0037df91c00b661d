"""Smear: sights of a marker -> how soft a video link makes lines, and the sights again with a print
that is as soft.

An analog link makes a picture soft along its lines, not across them. A print that is equally soft
both ways then fits a marker that is too wide and too low, half a pixel on a far one, and that looks
tilted by some degrees.
"""

from collections.abc import Callable, Mapping

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.marker import Marker, MarkerPose, Pixels, find_marker, print_correlation

BLUR_GRID_PX = np.array([0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8])
MAX_DETECTIONS = 20  # more change the smear by less than 0.1 px


def redetect_blurred(
    image: Callable[[int], Pixels | None],
    detections: Mapping[int, MarkerPose],
    camera: PinholeCamera,
    marker: Marker,
) -> tuple[dict[int, MarkerPose], float]:
    """Sights of a video's marker again, as the link shows it.

    Args:
        image: frame -> (H, W, 3) RGB; None where it was lost.
        sights: by frame, found with a print that is equally soft both ways.
        camera: the intrinsics.
        marker: what was printed.

    Returns:
        The sights that are found again, and the link's smear [px]; without smear the sights as they
        are.
    """
    horizontal_blur_px = estimate_horizontal_blur(image, detections, marker)
    if horizontal_blur_px == 0.0:
        return dict(detections), 0.0
    again: dict[int, MarkerPose] = {}
    for frame, detection in detections.items():
        picture = image(frame)
        found = (
            None
            if picture is None
            else find_marker(
                picture, camera, marker, detection.corners_px, horizontal_blur_px=horizontal_blur_px
            )
        )
        if found is not None:
            again[frame] = found
    return again, horizontal_blur_px


def estimate_horizontal_blur(
    image: Callable[[int], Pixels | None], detections: Mapping[int, MarkerPose], marker: Marker
) -> float:
    """By how much more a print has to be smeared along lines than across them to look most like
    what is seen.

    Squares of blurs add up: a camera that moves smears both ways alike, a link smears along its
        lines besides.

    Args:
        image: frame -> (H, W, 3) RGB; None where it was lost.
        sights: by frame.
        marker: what was printed.

    Returns:
        Standard deviation [px]; 0 where it takes no more along lines than across, or there is no
        sight.
    """
    frames = list(detections)
    some = (
        [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, MAX_DETECTIONS).astype(int))]
        if frames
        else []
    )
    pairs = [(picture, detections[k].corners_px) for k in some if (picture := image(k)) is not None]
    if not pairs:
        return 0.0
    along, across = (
        _parabola_minimum(
            [
                np.mean([_log_residual(*pair, marker, blur, across_lines) for pair in pairs])
                for blur in BLUR_GRID_PX
            ]
        )
        for across_lines in (False, True)
    )
    return float(np.sqrt(max(along**2 - across**2, 0.0)))


def _log_residual(
    picture: Pixels,
    corners_px: Array,
    marker: Marker,
    horizontal_blur_px: float,
    across_lines: bool,
) -> float:
    """Logarithm of the share of the image's contrast that a print so smeared leaves over: least
    where it is likeliest.

    [Gaussian noise: the likelihood is a power of 1 - correlation^2]
    """
    blur = (0.0, horizontal_blur_px) if across_lines else (horizontal_blur_px, 0.0)
    return float(np.log(max(1.0 - print_correlation(picture, marker, corners_px, blur) ** 2, 1e-6)))


def _parabola_minimum(residuals: list[np.floating]) -> float:
    """Where the parabola through the least of the tried and its neighbours is least [px]."""
    k = int(np.clip(np.argmin(residuals), 1, len(BLUR_GRID_PX) - 2)) if np.argmin(residuals) else 0
    if k == 0:
        return 0.0
    before, here, after = residuals[k - 1 : k + 2]
    curvature = before - 2.0 * here + after
    step = 0.5 * (before - after) / curvature if curvature > 0.0 else 0.0
    return float(BLUR_GRID_PX[k] + np.clip(step, -1.0, 1.0) * (BLUR_GRID_PX[1] - BLUR_GRID_PX[0]))
