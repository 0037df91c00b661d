"""Smear: drawn views of the marker made soft by known blurs -> these blurs, and corners that are
not drawn wide.
"""

import cv2
import numpy as np
import pytest

from falconwing_kit.vision.horizontal_blur import estimate_horizontal_blur, redetect_blurred
from falconwing_kit.vision.marker import Marker, find_marker, project_corners
from tests.vision.drawn_marker import CAMERA, pose, view

POSES = [
    pose(-6.0 - 0.5 * k, 0.4 * (k % 3 - 1), 1.3, 12.0 * (k % 5 - 2), -3.0, 3.0 * (k % 4))
    for k in range(12)
]


def soft(image, along, across):
    """The picture blurred along and across its lines by OpenCV's Gaussian, after gamma, as a link
    does.
    """
    return cv2.GaussianBlur(image, (0, 0), sigmaX=max(along, 1e-3), sigmaY=max(across, 1e-3))


def seen(along, across=0.0, lens=0.4):
    """Pictures, and sights of the marker with a print that is equally soft both ways."""
    images = [
        soft(view(T, np.random.default_rng(k), blur_px=lens), along, across)
        for k, T in enumerate(POSES)
    ]
    sights = {
        k: find_marker(im, CAMERA, None, project_corners(Marker(), CAMERA, POSES[k]))
        for k, im in enumerate(images)
    }
    return images, {k: sight for k, sight in sights.items() if sight is not None}


@pytest.mark.parametrize("smear", [0.0, 0.7, 1.2])
def test_a_smear_along_lines_is_measured(smear):
    """The blur put in, to 0.2 px: a twentieth of the smallest marker's side."""
    images, sights = seen(smear)
    assert len(sights) >= 10
    assert estimate_horizontal_blur(images.__getitem__, sights, Marker()) == pytest.approx(
        smear, abs=0.2
    )


@pytest.mark.parametrize(("along", "across"), [(0.7, 0.7), (0.0, 1.0)])
def test_what_is_as_soft_across_lines_is_no_link(along, across):
    """A moving or unfocused camera blurs across lines too."""
    images, sights = seen(along, across)
    assert estimate_horizontal_blur(images.__getitem__, sights, Marker()) < 0.35


def test_a_marker_seen_through_a_link_is_no_longer_drawn_wide():
    """Truth is the drawing's. 1.2 px of smear make sights wider than high by a quarter of a pixel
    and more; with it in the print less than half of that is left.
    """
    images, sights = seen(1.2)
    again, smear = redetect_blurred(images.__getitem__, sights, CAMERA, Marker())
    assert smear == pytest.approx(1.2, abs=0.2)
    assert len(again) >= 10

    def too_wide(found):
        """Mean of how much too wide less how much too high [px]."""
        true = {k: project_corners(Marker(), CAMERA, POSES[k]) for k in found}
        sizes = [np.ptp(found[k].corners_px, axis=0) - np.ptp(true[k], axis=0) for k in found]
        return float(np.mean([width - height for width, height in sizes]))

    assert too_wide(sights) > 0.25
    assert abs(too_wide(again)) < 0.5 * too_wide(sights)


def test_lost_pictures_and_no_sights_leave_no_smear():
    """Nothing to measure."""
    _, sights = seen(0.0)
    assert estimate_horizontal_blur(lambda k: None, {}, Marker()) == 0.0
    assert estimate_horizontal_blur(lambda k: None, sights, Marker()) == 0.0


def test_without_a_smear_sights_stay_as_they_are():
    """A print that is smeared by 0 px is the one they were found with: the same objects, in a dict
    of their own.
    """
    _, sights = seen(0.0)
    again, smear = redetect_blurred(lambda k: None, sights, CAMERA, Marker())
    assert smear == 0.0
    assert again == sights
    assert again is not sights
