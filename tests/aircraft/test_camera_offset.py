"""Camera offset and turned mount: measured poses by hand and against exact rotations."""

from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.frames import euler_from_rotation, rotation_world_body

OFFSET = next(e for e in CATALOGUE if e.name == "camera_offset")
MOUNT = next(e for e in CATALOGUE if "mount_yaw" in {p.name for p in e.parameters})


def test_a_camera_on_the_nose_by_hand():
    """Level along x: forward is +x, right is -y (the world's y is left), down is -z; banked by 90
    deg to the right, the camera under the belly stands to the left.
    """
    K = SimpleNamespace(camera_forward=0.3, camera_right=0.2, camera_down=0.1)
    level = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])[:, None]
    assert OFFSET.measurement_map(level, K)[:, 0] == pytest.approx([1.3, 1.8, 2.9, 0.0, 0.0, 0.0])
    below = SimpleNamespace(camera_forward=0.0, camera_right=0.0, camera_down=0.1)
    banked = np.array([1.0, 2.0, 3.0, 0.5 * np.pi, 0.0, 0.0])[:, None]
    assert OFFSET.measurement_map(banked, below)[:3, 0] == pytest.approx([1.0, 2.1, 3.0])


def test_lever_arm_is_turned_with_the_body():
    """The law: p + R d, for a hundred attitudes at once, attitudes themselves unchanged."""
    rng = np.random.default_rng(5)
    pose = rng.uniform(-1.2, 1.2, (6, 100))
    arm = np.array([0.1, -0.2, 0.3])
    K = SimpleNamespace(camera_forward=0.1, camera_right=-0.2, camera_down=0.3)
    moved = OFFSET.measurement_map(pose, K)
    R_world_body = rotation_world_body(pose[3], pose[4], pose[5])
    assert moved[:3] == pytest.approx(pose[:3] + (R_world_body @ arm).T, abs=1e-12)
    assert np.array_equal(moved[3:], pose[3:])


def test_a_turned_mount_is_the_exact_rotation_to_second_order():
    """R_world_body R_z R_y R_x of 0.02 rad each: 4e-4 times some ones; sideways turns the yaw of
    level flight by itself.
    """
    K = SimpleNamespace(mount_roll=-0.015, mount_pitch=0.02, mount_yaw=0.018)
    pose = np.array([1.0, 2.0, 3.0, 0.2, -0.15, 1.0])[:, None]
    R_body_camera = rotation_world_body(0.0, 0.0, 0.0).T @ rotation_world_body(-0.015, 0.02, 0.018)
    exact = euler_from_rotation(rotation_world_body(0.2, -0.15, 1.0) @ R_body_camera)
    found = MOUNT.measurement_map(pose, K)
    assert np.array_equal(found[:3], pose[:3])
    assert found[3:, 0] == pytest.approx(exact, abs=6e-4)
    assert np.abs(found - pose)[3:].min() > 5e-3
    level = np.zeros((6, 1))
    turned = SimpleNamespace(mount_roll=0.0, mount_pitch=0.0, mount_yaw=0.05)
    assert MOUNT.measurement_map(level, turned)[:, 0] == pytest.approx([0, 0, 0, 0, 0, 0.05])
