"""Analog lines: blur and line jitter put into drawn views of the marker -> measured again."""

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.vision.analog_lines import (
    corner_covariance,
    estimate_horizontal_blur,
    redetect_blurred,
    sync_jitter_px,
)
from falconwing_kit.vision.marker import Marker, corner_noise, find_marker, project_corners
from tests.vision.drawn_marker import CAMERA, pose, view
from tests.vision.jittered import jittered, line_shifts

POSES = [
    pose(-6.0 - 0.5 * k, 0.4 * (k % 3 - 1), 1.3, 12.0 * (k % 5 - 2), -3.0, 3.0 * (k % 4))
    for k in range(12)
]


def blurred(image, along, across):
    """The image blurred along and across its lines by OpenCV's Gaussian, after gamma."""
    return cv2.GaussianBlur(image, (0, 0), sigmaX=max(along, 1e-3), sigmaY=max(across, 1e-3))


def views(along, across=0.0, lens=0.4):
    """Images, and detections of the marker with a print of equal blur both ways."""
    images = [
        blurred(view(T, np.random.default_rng(k), blur_px=lens), along, across)
        for k, T in enumerate(POSES)
    ]
    detections = {
        k: find_marker(im, CAMERA, None, project_corners(Marker(), CAMERA, POSES[k]))
        for k, im in enumerate(images)
    }
    return images, {k: detection for k, detection in detections.items() if detection is not None}


@pytest.mark.parametrize("blur_px", [0.0, 0.7, 1.2])
def test_horizontal_blur_is_measured(blur_px):
    """The blur put in, to 0.2 px: a twentieth of the smallest marker's side."""
    images, detections = views(blur_px)
    assert len(detections) >= 10
    assert estimate_horizontal_blur(images.__getitem__, detections, Marker()) == pytest.approx(
        blur_px, abs=0.2
    )


@pytest.mark.parametrize(("along", "across"), [(0.7, 0.7), (0.0, 1.0)])
def test_equal_blur_across_lines_is_no_horizontal_blur(along, across):
    """A moving or unfocused camera blurs across lines too."""
    images, detections = views(along, across)
    assert estimate_horizontal_blur(images.__getitem__, detections, Marker()) < 0.35


def test_redetected_marker_is_no_longer_too_wide():
    """Truth is the drawing's. 1.2 px of blur make detections wider than high by 0.25 px and more;
    with it in the print less than half of that remains.
    """
    images, detections = views(1.2)
    again, blur_px = redetect_blurred(images.__getitem__, detections, CAMERA, Marker())
    assert blur_px == pytest.approx(1.2, abs=0.2)
    assert len(again) >= 10

    def too_wide(found):
        """Mean of how much too wide less how much too high [px]."""
        true = {k: project_corners(Marker(), CAMERA, POSES[k]) for k in found}
        sizes = [np.ptp(found[k].corners_px, axis=0) - np.ptp(true[k], axis=0) for k in found]
        return float(np.mean([width - height for width, height in sizes]))

    assert too_wide(detections) > 0.25
    assert abs(too_wide(again)) < 0.5 * too_wide(detections)


def test_lost_images_and_no_detections_give_no_blur():
    """Nothing to measure."""
    _, detections = views(0.0)
    assert estimate_horizontal_blur(lambda k: None, {}, Marker()) == 0.0
    assert estimate_horizontal_blur(lambda k: None, detections, Marker()) == 0.0


def test_without_blur_detections_stay_as_they_are():
    """A print blurred by 0 px is the one they were found with: the same objects in another dict."""
    _, detections = views(0.0)
    again, blur_px = redetect_blurred(lambda k: None, detections, CAMERA, Marker())
    assert blur_px == 0.0
    assert again == detections
    assert again is not detections


@pytest.mark.parametrize(
    ("of_lines", "of_columns", "expected"),
    [(0.25, 0.0, 0.25), (0.5, 0.0, 0.5), (0.5, 0.3, 0.4), (0.4, 0.4, 0.0)],
)
def test_jitter_is_shared_by_neighbouring_lines_but_not_by_columns(of_lines, of_columns, expected):
    """Shifts by recursion, x(k+1) = a x(k) + sqrt(1 - a^2) n with a = exp(-1/24), and noise of 0.15
    px on lines and columns. A homography has removed mean and slope: here a straight line fitted by
    NumPy. Variances subtract, by hand 0.5^2 - 0.3^2 = 0.4^2. 400 prints, to 10 %. Where nothing
    is left, to 0.12 px: with two free numbers a print each 0.4^2 is known to sqrt(2 / 800) = 5 %,
    so their difference to 0.011 px^2, whose root is 0.11 px.
    """
    rng = np.random.default_rng(2)

    def without_mean_and_slope(shift):
        k = np.arange(len(shift))
        return shift - np.polyval(np.polyfit(k, shift, 1), k)

    pairs = []
    for _ in range(400):
        noise = rng.normal(0.0, 0.15, (2, int(rng.integers(12, 30))))
        both = [
            one + line_shifts(len(one), size, rng)
            for one, size in zip(noise, (of_lines, of_columns), strict=True)
        ]
        pairs.append((without_mean_and_slope(both[0]), without_mean_and_slope(both[1])))
    tolerance = (
        {"rel": 0.1, "abs": 0.0} if expected else {"abs": 0.12}
    )  # the larger of the two would count
    assert sync_jitter_px(pairs) == pytest.approx(expected, **tolerance)


def test_too_few_lines_give_no_jitter():
    """No print at all, one of four lines, and one with edges in every other line only."""
    gappy = np.where(np.arange(16) % 2, 0.5, np.nan)
    assert sync_jitter_px([(gappy, gappy)]) == 0.0
    assert sync_jitter_px([]) == 0.0
    assert sync_jitter_px([(np.array([0.5, -0.5, 0.5, -0.5]), np.zeros(4))]) == 0.0


def test_corners_on_one_line_are_correlated_sideways_only():
    """By hand: 0.1 px of noise, 0.5 px of jitter; the upper corners on one line share 0.25 px^2,
    the lower ones, 24 lines further down, 0.25 / e of it with them; nothing goes up or down.
    """
    square = np.array([[[10.0, 50.0], [34.0, 50.0], [34.0, 74.0], [10.0, 74.0]]])
    C = corner_covariance(square, 0.1, 0.5)[0]
    assert C[0, 0] == pytest.approx(0.26)
    assert C[0, 2] == pytest.approx(0.25)
    assert C[0, 4] == pytest.approx(0.25 / np.e)
    assert C[1::2, 1::2] == pytest.approx(0.01 * np.eye(4))
    assert not C[::2, 1::2].any()
    with pytest.raises(InputError, match="corners_px"):
        corner_covariance(square[0], 0.1, 0.5)


def test_a_marker_with_line_jitter_lies_within_its_covariance():
    """Truth is the drawing's geometry; line jitter of 0.5 px. Noise and jitter are those measured.

    chi2 of eight coordinates has mean 8: within a factor of two. Without the jitter the covariance
    is too small by more than that; the measured jitter is 0.5 px to 0.15.
    """
    detections, true = [], []
    for k in range(30):
        rng = np.random.default_rng(k)
        T = pose(-6.0 - 0.2 * k, rng.uniform(-1.0, 1.0), 1.4, rng.uniform(-40.0, 40.0))
        corners = project_corners(Marker(), CAMERA, T)
        seen = find_marker(jittered(view(T, rng, blur_px=0.5), 0.5, rng), CAMERA, near_px=corners)
        if seen is not None:
            detections.append(seen)
            true.append(corners)
    assert len(detections) >= 20
    noise = corner_noise(detections)
    sync_jitter = sync_jitter_px(detection.line_jitter_px for detection in detections)
    errors = np.array([detection.corners_px for detection in detections]) - true
    mean = {
        stated: np.mean(
            [
                d.ravel() @ np.linalg.solve(C, d.ravel())
                for d, C in zip(errors, covariance, strict=True)
            ]
        )
        for stated in (0.0, sync_jitter)
        for covariance in [corner_covariance(np.array(true), noise, stated)]
    }
    assert 4.0 < mean[sync_jitter] < 16.0
    assert mean[0.0] > 2.0 * 8.0
    assert sync_jitter == pytest.approx(0.5, abs=0.15)
