"""Lens: drawn checkerboards of a known lens -> that lens; undistorted images are a pinhole's."""

import json

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Image
from falconwing_kit.tools.devices.calibration import StraightImages
from falconwing_kit.tools.devices.lens import Lens, find_corners, fit_lens
from falconwing_kit.tools.devices.simulated_bench import LENS, PATTERN, draw_checkerboard

SIZE = (LENS.width_px, LENS.height_px)


@pytest.fixture(scope="module")
def views():
    """Corners of fifteen views."""
    found = [find_corners(draw_checkerboard(LENS, k), PATTERN) for k in range(15)]
    return [corners for corners in found if corners is not None]


def directions(lens, pixels):
    """X/Z, Y/Z of pixels (N, 2) by OpenCV's own inverse of the lens."""
    K = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    bend = np.array([lens.k1, lens.k2, lens.p1, lens.p2])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    return cv2.undistortPoints(pixels[:, None], K, bend, criteria=criteria)[:, 0]


def test_the_distortion_is_opencvs():
    """cv2.projectPoints, an independent implementation of the same equation, to rounding."""
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.5, 0.5, 7))
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    bend = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), bend)
    ours = np.stack(LENS.distort(x.ravel(), y.ravel()), axis=1)
    assert ours == pytest.approx(pixels[:, 0], abs=1e-12)


def test_the_lens_behind_drawn_checkerboards_is_found(views):
    """Truth: LENS. Tolerances: focal lengths 0.5 %, centre 1.5 px; any direction within the image's
    inner 90 % to 1.5 px, which a pinhole (26 px off in the corner) or a k1 of wrong sign misses.
    """
    fit = fit_lens(views, PATTERN, SIZE)
    assert fit.lens.fx_px == pytest.approx(LENS.fx_px, rel=0.005)
    assert fit.lens.fy_px == pytest.approx(LENS.fy_px, rel=0.005)
    assert (fit.lens.cx_px, fit.lens.cy_px) == pytest.approx((LENS.cx_px, LENS.cy_px), abs=1.5)
    assert fit.reprojection_px < 0.3 and fit.focal_error < 0.005
    u, v = np.meshgrid(np.linspace(16.0, 304.0, 13), np.linspace(12.0, 228.0, 9))
    x, y = directions(LENS, np.stack([u.ravel(), v.ravel()], axis=1)).T
    bent_x, bent_y = fit.lens.distort(x, y)
    back_u = fit.lens.fx_px * bent_x + fit.lens.cx_px
    back_v = fit.lens.fy_px * bent_y + fit.lens.cy_px
    assert np.hypot(back_u - u.ravel(), back_v - v.ravel()).max() < 1.5


def test_an_undistorted_checkerboard_has_straight_lines():
    """Collinear points stay so for a pinhole camera: each row of nine corners fits a line to 0.5 px
    after undistortion (three times the corner finder's scatter), and by more than 1 px not before.
    """

    def bow(pixels):
        rows = find_corners(pixels, PATTERN).reshape(PATTERN[1], PATTERN[0], 2)
        bows = []
        for row in rows:
            centred = row - row.mean(axis=0)
            bows.append(np.abs(centred @ np.linalg.svd(centred)[2][1]).max())
        return max(bows)

    pixels = draw_checkerboard(LENS, 2)
    assert bow(pixels) > 1.0 and bow(LENS.undistort(pixels)) < 0.5


def test_an_undistorted_pixel_is_where_the_pinhole_camera_sees_it():
    """A dot drawn where the lens bends a direction to; undistorted it is where `camera` projects
    that direction, to half a pixel.
    """
    direction = np.array([0.55, -0.35, 1.0])
    x, y = LENS.distort(direction[0], direction[1])
    u, v = LENS.fx_px * x + LENS.cx_px - 0.5, LENS.fy_px * y + LENS.cy_px - 0.5
    columns, rows = np.meshgrid(np.arange(320.0), np.arange(240.0))
    dot = 255.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18.0)
    straight = LENS.undistort(dot.astype(np.uint8)).astype(float)
    seen = np.array([(straight * columns).sum(), (straight * rows).sum()]) / straight.sum() + 0.5
    wanted, _ = LENS.camera().project(direction[None], np.eye(4))
    assert seen == pytest.approx(wanted[0], abs=0.5)
    assert np.hypot(*(seen - 0.5 - (u, v))) > 5.0


def test_a_smaller_image_has_the_same_lens():
    """Half the size: half the focal lengths and centre; another shape is refused."""
    camera = LENS.camera(160, 120)
    assert (camera.fx, camera.cy) == pytest.approx((LENS.fx_px / 2, LENS.cy_px / 2))
    with pytest.raises(InputError, match="of the shape of 320 x 240"):
        LENS.camera(320, 180)


def flat(view):
    """An untilted board, corners 24 px apart, with some tenths of a pixel of unevenness."""
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    corner = np.array([20.0 + 27.0 * (view % 4), 20.0 + 20.0 * (view % 5)])
    return 24.0 * grid + corner + 0.3 * np.sin(grid * (view + 1))


def test_views_that_do_not_determine_the_lens_are_refused(views):
    """Too few; in the middle only; all flat on, for which focal length and distance are one."""
    with pytest.raises(InputError, match="8 views of the checkerboard or more, got 7"):
        fit_lens(views[:7], PATTERN, SIZE)
    with pytest.raises(InputError, match="into every corner"):
        fit_lens([0.3 * corners for corners in views], PATTERN, SIZE)
    with pytest.raises(InputError, match="tilt the"):
        fit_lens([flat(view) for view in range(12)], PATTERN, SIZE)


class Source:
    """Always the same image under its number."""

    def __init__(self):
        self.number, self.pixels = 0, draw_checkerboard(LENS, 1)

    def next_image(self, t):
        return None if t < 0.0 else Image(self.number, t, self.pixels)


def test_a_source_gives_undistorted_images():
    """The pixels of `undistort`, time and number as they were; None stays None."""
    images, source = StraightImages(source := Source(), LENS), source
    assert images.next_image(-1.0) is None
    first = images.next_image(1.0)
    assert (first.sequence, first.t) == (0, 1.0)
    assert np.array_equal(first.pixels, LENS.undistort(source.pixels))
    assert images.next_image(2.0) is first
    source.number = 1
    assert images.next_image(3.0).sequence == 1


@pytest.mark.parametrize("wrong", [{"fx_px": 0.0}, {"k1": 9.0}, {"cx_px": -1.0}, {"width_px": 3}])
def test_numbers_out_of_range_are_refused(wrong):
    """One sentence each."""
    given = {**json.loads(json.dumps(vars(LENS))), **wrong}
    with pytest.raises(InputError, match=f"{next(iter(wrong))}: expected"):
        Lens(**given)
