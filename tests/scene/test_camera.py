"""The camera: pixels and rays worked out by hand, and by OpenCV."""

import math

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import PinholeCamera, nose_camera_pose

CAMERA = PinholeCamera.from_fov_deg(640, 480, 90.0)


def test_field_of_view_reaches_from_edge_to_edge():
    """By hand: half of 640 pixels over tan 45 deg is 320; the axis goes through the middle."""
    expected = [[320.0, 0.0, 320.0], [0.0, 320.0, 240.0], [0.0, 0.0, 1.0]]
    assert np.allclose(CAMERA.K, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("p_world", "attitude", "pixel"),
    [
        ((10, 0, 1), (0, 0, 0), (320, 240)),  # straight ahead
        ((10, 1, 1), (0, 0, 0), (288, 240)),  # world y is left: 320 / 10 pixels
        (
            (10, 0, 2),
            (0, 0, 0),
            (320, 208),
        ),  # up in the world is up in the image, where v is smaller
        ((10, 0, 2), (math.pi / 2, 0, 0), (288, 240)),  # right wing down: up is at the left wing
        (
            (0, -10, 1),
            (0, 0, math.pi / 2),
            (320, 240),
        ),  # yaw to the right: the nose points to world -y
        (
            (10, 0, 1),
            (0, math.atan(0.5), 0),
            (320, 400),
        ),  # nose up: what was ahead sinks by 320 / 2
    ],
)
def test_nose_camera_sees_where_the_body_points(p_world, attitude, pixel):
    """By hand from the frames of the design; tolerance is rounding."""
    pixels, depth = CAMERA.project([p_world], nose_camera_pose((0, 0, 1), *attitude))
    assert np.allclose(pixels, [pixel], atol=1e-9)
    assert depth[0] > 0


def test_mount_moves_the_camera_along_the_body():
    """By hand: a camera 0.1 m ahead and 0.2 m towards the belly of a level body at 1 m sits at
    (0.1, 0, 0.8).
    """
    T_world_camera = nose_camera_pose((0, 0, 1), 0, 0, 0, p_body_camera=(0.1, 0, 0.2))
    assert np.allclose(T_world_camera[:3, 3], [0.1, 0.0, 0.8], atol=1e-12)


def test_rays_and_projection_are_inverse():
    """A point along the ray of a pixel's centre appears there, at its depth; the first centre is at
    (0.5, 0.5).
    """
    camera = PinholeCamera(50.0, 60.0, 3.0, 2.5, 7, 5)
    rays = camera.pixel_rays()
    assert rays.shape == (5, 7, 3)
    pixels, depth = camera.project(4.0 * rays.reshape(-1, 3), np.eye(4))
    u, v = np.meshgrid(np.arange(7) + 0.5, np.arange(5) + 0.5)
    assert np.allclose(pixels, np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-9)
    assert np.allclose(depth, 4.0, rtol=1e-12)


def test_projection_is_opencv_s():
    """OpenCV projects the same points with its own code; tolerance is its float64 rounding."""
    import cv2

    rng = np.random.default_rng(0)
    T_world_camera = nose_camera_pose((1.0, 2.0, 3.0), 0.3, -0.2, 0.7)
    p_camera = rng.uniform((-2, -2, 1), (2, 2, 9), (50, 3))
    p_world = p_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    R_camera_world = T_world_camera[:3, :3].T
    rotation, _ = cv2.Rodrigues(R_camera_world)
    translation = -R_camera_world @ T_world_camera[:3, 3]
    expected, _ = cv2.projectPoints(p_world, rotation, translation, CAMERA.K, None)
    pixels, depth = CAMERA.project(p_world, T_world_camera)
    assert np.allclose(pixels, expected[:, 0], atol=1e-6)
    assert np.allclose(depth, p_camera[:, 2], rtol=1e-12)


def test_what_is_not_in_front_has_no_pixel():
    """A point behind and one in the camera's own plane have a depth and no image."""
    pixels, depth = CAMERA.project([[0, 0, -1], [1, 0, 0]], np.eye(4))
    assert np.isnan(pixels).all()
    assert depth.tolist() == [-1.0, 0.0]


@pytest.mark.parametrize(
    ("numbers", "name"),
    [
        ((0.0, 1, 1, 1, 4, 4), "fx"),
        ((1, -1, 1, 1, 4, 4), "fy"),
        ((1, 1, math.nan, 1, 4, 4), "cx"),
        ((1, 1, 1, math.inf, 4, 4), "cy"),
        ((1, 1, 1, 1, 0, 4), "width"),
        ((1, 1, 1, 1, 4, 2.5), "height"),
        ((1, 1, 1, 1, 10**9, 4), "width"),
        ((1, 1, 1, 1, "wide", 4), "width"),
    ],
)
def test_impossible_cameras_are_refused_by_name(numbers, name):
    """Each is the user's mistake and gets a sentence that names it."""
    with pytest.raises(InputError, match=f"^{name}: expected"):
        PinholeCamera(*numbers)


def test_impossible_views_and_poses_are_refused():
    """A view of 180 deg has no flat image; nan in a pose and wrong shapes are mistakes."""
    with pytest.raises(InputError, match="fov_deg"):
        PinholeCamera.from_fov_deg(640, 480, 180.0)
    with pytest.raises(InputError, match="roll"):
        nose_camera_pose((0, 0, 1), math.nan, 0, 0)
    with pytest.raises(InputError, match="p_world"):
        nose_camera_pose((0, 0, math.inf), 0, 0, 0)
    with pytest.raises(InputError, match="T_world_camera"):
        CAMERA.project([[0, 0, 1]], np.eye(3))
