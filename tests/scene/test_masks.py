"""Masks: the ellipse covers the ellipsoid's points; the mask of Gaussians has occlusion."""

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render
from falconwing_kit.scene.masks import (
    Ellipsoid,
    alpha_image,
    ellipse_mask,
    mask_iou,
    paint_grey,
    visible_alpha_image,
)

CAMERA = PinholeCamera(100.0, 110.0, 70.0, 55.0, 160, 120)
ORIGIN = nose_camera_pose((0.0, 0.0, 0.0), 0.0, 0.0, 0.0)  # looks along world x
AIRCRAFT = Ellipsoid(np.array([0.03, 0.0, -0.02]), np.array([0.26, 0.35, 0.12]))


def rays_that_hit(ellipsoid, T_world_body, camera, T_world_camera):
    """Every pixel's ray against the ellipsoid, transformed into a unit ball."""
    T_ball_world = np.linalg.inv(T_world_body)
    start = (
        T_ball_world[:3, :3] @ T_world_camera[:3, 3] + T_ball_world[:3, 3] - ellipsoid.centre_body
    )
    start = start / ellipsoid.half_axes
    ways = (
        camera.pixel_rays()
        @ (T_ball_world[:3, :3] @ T_world_camera[:3, :3]).T
        / ellipsoid.half_axes
    )
    nearest = np.maximum(
        0.0, -(ways @ start) / np.sum(ways * ways, axis=2)
    )  # only what is ahead counts
    return np.linalg.norm(start + nearest[..., None] * ways, axis=2) <= 1.0


@pytest.mark.parametrize(
    "place",
    [
        (3.0, 0.2, 0.1),
        (12.0, -4.0, 2.0),
        (0.5, 0.2, -0.1),  # near, over the edges of the image
        (0.1, 0.45, 0.0),  # beside the camera and reaching behind it
        (-0.05, 0.2, 0.25),  # mostly behind
        (0.05, 0.0, 0.0),  # the camera is inside
        (-0.3, 0.1, 0.0),  # behind, but reaching before it
        (-3.0, 0.2, 0.1),  # behind
        (1.0, 9.0, 0.0),  # beside the image
    ],
)
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.6, 0.3, 2.5), (-1.2, 0.8, 0.4)])
def test_ellipse_is_where_rays_hit(place, angles):
    """Brute force: each pixel's ray against a unit ball. One pixel in 1000 of the outline may round
    otherwise.
    """
    T_world_body = pose_matrix(rotation_world_body(*angles), np.array(place))
    expected = rays_that_hit(AIRCRAFT, T_world_body, CAMERA, ORIGIN)
    mask = ellipse_mask(AIRCRAFT, T_world_body, CAMERA, ORIGIN)
    assert np.count_nonzero(mask != expected) <= 0.001 * expected.sum()


def test_ellipse_is_where_its_points_project():
    """Points on the surface, projected one by one: they fill the mask, and none lies farther out
    than one pixel.
    """
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    T_world_body = pose_matrix(rotation_world_body(0.5, -0.2, 0.7), np.array([2.0, 0.3, -0.1]))
    T_world_camera = nose_camera_pose((-0.5, 0.1, 0.2), 0.3, 0.1, -0.1)
    p_body = AIRCRAFT.centre_body + directions * AIRCRAFT.half_axes
    pixels, _ = CAMERA.project(
        p_body @ T_world_body[:3, :3].T + T_world_body[:3, 3], T_world_camera
    )
    mask = ellipse_mask(AIRCRAFT, T_world_body, CAMERA, T_world_camera)
    rows, columns = np.nonzero(mask)
    np.testing.assert_allclose([columns.min(), rows.min()], pixels.min(axis=0), atol=1.0)
    np.testing.assert_allclose([columns.max() + 1, rows.max() + 1], pixels.max(axis=0), atol=1.0)
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], (CAMERA.height, CAMERA.width), ((0, 120), (0, 160))
    )
    hit = counts > 0
    wider = (
        mask
        | np.roll(mask, 1, 0)
        | np.roll(mask, -1, 0)
        | np.roll(mask, 1, 1)
        | np.roll(mask, -1, 1)
    )
    assert mask.sum() > 200 and not (mask & ~hit).any() and not (hit & ~wider).any()


def test_a_ball_ahead_is_a_disc():
    """By hand: a ball of 0.5 m at 5 m is seen under asin(0.1): radius f tan = 100 * 0.1 /
    sqrt(0.99) = 10.05 px.
    """
    camera = PinholeCamera(100.0, 100.0, 60.0, 60.0, 120, 120)
    ball = Ellipsoid(np.zeros(3), np.full(3, 0.5))
    mask = ellipse_mask(ball, pose_matrix(np.eye(3), np.array([5.0, 0.0, 0.0])), camera, ORIGIN)
    v, u = np.mgrid[:120, :120] + 0.5
    assert np.array_equal(mask, np.hypot(u - 60.0, v - 60.0) <= 10.0504)


def test_dual_quadric_is_touched_by_its_planes():
    """By hand: the plane x = 3 m touches a ball of 1 m at x = 2 m, so (1, 0, 0, -3) Q* (1, 0, 0,
    -3)^T = 0.
    """
    Q = Ellipsoid(np.zeros(3), np.ones(3)).dual_quadric(
        pose_matrix(np.eye(3), np.array([2.0, 0.0, 0.0]))
    )
    for x, value in ((3.0, 0.0), (1.0, 0.0), (2.5, 0.75)):
        plane = np.array([1.0, 0.0, 0.0, -x])
        assert plane @ Q @ plane == pytest.approx(value, abs=1e-12)


def test_ellipsoid_ends_at_the_ends_of_the_points():
    """By hand: nose, tail and wing tips; points in a plane make a thin one."""
    found = Ellipsoid.around(
        [[0.2, 0.0, 0.0], [-0.4, 0.0, 0.0], [0.0, 0.35, 0.0], [0.0, -0.35, 0.0]]
    )
    np.testing.assert_allclose(found.centre_body, [-0.1, 0.0, 0.0])
    np.testing.assert_allclose(found.half_axes, [0.3, 0.35, 0.001])


def wall(x, y, grey, opacity=0.99):
    """A tight sheet of surfels, 1 m wide and high, across world x."""
    grid = np.stack(
        np.meshgrid(np.arange(-0.5, 0.5, 0.02), np.arange(-0.5, 0.5, 0.02)), axis=-1
    ).reshape(-1, 2)
    means = np.column_stack([np.full(len(grid), x), grid + np.array([y, 0.0])])
    count = len(means)
    sh = np.full((count, 1, 3), (grey - 0.5) / 0.28209479)
    return GaussianScene(
        means, [[1, 0, 0, 0]] * count, [[0.001, 0.015, 0.015]] * count, [opacity] * count, sh
    )


def test_what_stands_before_the_leader_hides_it():
    """By hand: a wall half as far covers the leader's left half; a wall behind hides nothing.

    The wall's border is a Gaussian: it hides another pixel or so of the leader's 25, which are 4 %
    of it.
    """
    leader = wall(4.0, 0.0, 0.7)
    alone = alpha_image(leader, CAMERA, ORIGIN)
    before, behind = wall(2.0, 0.5, 0.2), wall(5.0, 0.0, 0.2)
    assert alone.max() > 0.98
    seen = visible_alpha_image(before, leader, CAMERA, ORIGIN)
    assert seen.sum() / alone.sum() == pytest.approx(0.5, abs=0.06)
    assert seen[55, 75] > 0.95 and seen[55, 62] < 0.05
    np.testing.assert_allclose(
        visible_alpha_image(behind, leader, CAMERA, ORIGIN), alone, atol=1e-3
    )


def test_colours_do_not_enter_a_mask():
    """A law: black, white or blue, it covers the same pixels; alpha is that of the plain image."""
    leader = wall(4.0, 0.1, 0.0)
    alone = alpha_image(leader, CAMERA, ORIGIN)
    np.testing.assert_allclose(alone, render(leader, CAMERA, ORIGIN).alpha, atol=1e-6)
    hall = wall(3.0, 0.6, 1.0)
    seen = [
        visible_alpha_image(hall, paint_grey(leader, grey), CAMERA, ORIGIN) for grey in (0.0, 1.0)
    ]
    np.testing.assert_array_equal(*seen)


def test_overlap_by_hand():
    """2 of 4 pixels in one mask, 2 in the other, 1 in both: a third. Of two empty masks there is
    nothing to say.
    """
    first, second = (
        np.array([[True, True], [False, False]]),
        np.array([[True, False], [True, False]]),
    )
    assert mask_iou(first, second) == pytest.approx(1 / 3)
    assert np.isnan(mask_iou(~first & first, second & ~second))
    with pytest.raises(InputError, match="one shape"):
        mask_iou(first, second[:1])


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Ellipsoid(np.zeros(3), np.array([1.0, 0.0, 1.0])), "half_axes"),
        (lambda: Ellipsoid(np.array([np.nan, 0.0, 0.0]), np.ones(3)), "centre_body"),
        (lambda: Ellipsoid.around(np.zeros((0, 3))), "at least one point"),
        (lambda: Ellipsoid.around(np.zeros((4, 2))), "points_body"),
        (lambda: ellipse_mask(AIRCRAFT, 2.0 * np.eye(4), CAMERA, ORIGIN), "T_world_body"),
        (lambda: ellipse_mask(AIRCRAFT, np.eye(4), CAMERA, np.eye(3)), "T_world_camera"),
    ],
)
def test_bad_input_is_refused(make, text):
    """The sentence names what was wrong."""
    with pytest.raises(InputError, match=text):
        make()
