"""Pose refinement: images of the arena from known poses, brightened and noisy -> these poses again.
Simulated.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.scene.render import render
from falconwing_kit.vision.refine import refine_pose, track_scene
from tests.vision.drawn_marker import CAMERA, pose


@pytest.fixture(scope="module")
def arena():
    """The arena without the leader."""
    scene = load_scene("arena")
    return scene.selected(~scene.labelled("leader"))


def photo(arena, T_world_camera, rng, brightness=0.8):
    """What a darker, noisy camera shows from there, uint8."""
    rgb = render(arena, CAMERA, T_world_camera).rgb * brightness + rng.normal(
        0.0, 0.02, (240, 320, 3)
    )
    return (255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)


def moved(T_world_camera, metres, degrees, rng):
    """The pose with a step and a turn of these sizes in some direction."""
    step, turn = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    R = Rotation.from_rotvec(np.radians(degrees) * turn).as_matrix()
    return pose_matrix(R @ T_world_camera[:3, :3], T_world_camera[:3, 3] + metres * step)


def off_by(found, true):
    """Distance [m] and angle [deg] between two poses."""
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).as_rotvec()
    return np.linalg.norm(found[:3, 3] - true[:3, 3]), np.degrees(np.linalg.norm(turn))


@pytest.mark.parametrize(
    "true", [pose(-10.0, 2.0, 1.6, 20.0, -4.0, 15.0), pose(2.0, -2.0, 1.8, -25.0, 0.0, -60.0)]
)
def test_a_pose_half_a_metre_and_five_degrees_off_is_found_again(arena, true):
    """The image's own pose. Flow is good to 0.3 px of 198: 0.1 deg, and 1 cm at 6 m; five times
    that is allowed.
    """
    rng = np.random.default_rng(1)
    image = photo(arena, true, rng)
    for _ in range(3):
        found = refine_pose(image, arena, CAMERA, moved(true, 0.5, 5.0, rng))
        metres, degrees = off_by(found.T_world_camera, true)
        assert metres < 0.08
        assert degrees < 0.6
        assert metres < 4.0 * found.sigma_position
        assert degrees < 4.0 * np.degrees(found.sigma_attitude)


def test_an_image_of_something_else_gives_no_pose(arena):
    """The opposite end of the hall, and noise."""
    rng = np.random.default_rng(2)
    here, there = pose(-10.0, 2.0, 1.6), pose(-10.0, 2.0, 1.6, yaw_deg=180.0)
    assert refine_pose(photo(arena, there, rng), arena, CAMERA, here) is None
    assert (
        refine_pose(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8), arena, CAMERA, here)
        is None
    )


def test_a_flight_is_followed_both_ways_from_one_known_pose(arena):
    """7 m/s and 60 deg/s of yaw at 20 Hz: each frame is 0.35 m and 3 deg from the one before; frame
    4 is known.
    """
    rng, count = np.random.default_rng(3), 9
    true = [pose(-12.0 + 0.35 * k, 2.0, 1.6, 15.0, 0.0, 3.0 * k) for k in range(count)]
    images = [photo(arena, T, rng) for T in true]
    images[6] = None  # lost: the track goes over it
    t = 0.05 * np.arange(count)
    found = track_scene(lambda k: images[k], t, arena, CAMERA, known={4: true[4]}, guesses={})
    assert sorted(found) == [0, 1, 2, 3, 5, 7, 8]
    assert max(off_by(found[k].T_world_camera, true[k])[0] for k in found) < 0.1


def test_a_lost_track_is_taken_up_from_a_guess(arena):
    """Nothing is known; the guess for frame 1 is 0.4 m and 4 deg off."""
    rng = np.random.default_rng(4)
    true = [pose(-12.0 + 0.35 * k, 2.0, 1.6) for k in range(3)]
    images = [photo(arena, T, rng) for T in true]
    guess = moved(true[1], 0.4, 4.0, rng)
    found = track_scene(
        lambda k: images[k], 0.05 * np.arange(3), arena, CAMERA, known={}, guesses={1: guess}
    )
    assert sorted(found) == [0, 1, 2]


def test_images_and_poses_that_are_none_are_refused(arena):
    """Another size; a matrix that stretches."""
    with pytest.raises(InputError, match="image: expected"):
        refine_pose(np.zeros((480, 640, 3), np.uint8), arena, CAMERA, np.eye(4))
    with pytest.raises(InputError, match="T_world_camera"):
        refine_pose(np.zeros((240, 320, 3), np.uint8), arena, CAMERA, 2.0 * np.eye(4))
