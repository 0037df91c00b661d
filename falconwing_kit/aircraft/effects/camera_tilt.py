"""Camera tilt: the measured attitude is turned in the body, the aircraft flies as before.

One effect in two forms: tilted up and to the side, or its mount also turned about the vertical.
"""

from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, draw_direction
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import (
    euler_from_rotation,
    euler_rates,
    rotation_world_body,
    up_in_body,
)

SEPARATED_BY = {
    "speed sweep": "a tilted camera shows the same angle at any speed",
    "steep turns": "a tilted camera turns with the body",
}


def camera_tilt(pose: Array, K: Any) -> Array:
    """Attitude turned by the small body rotation (tilt_roll, tilt_pitch, 0)."""
    roll, pitch = pose[3], pose[4]
    change = euler_rates(up_in_body(roll, pitch), K.tilt_roll, K.tilt_pitch, 0.0 * roll)
    return np.concatenate([pose[:3], pose[3:] + np.stack(change)])


def camera_mount(pose: Array, K: Any) -> Array:
    """Attitude turned by the small body rotation (mount_roll, mount_pitch, mount_yaw)."""
    roll, pitch = pose[3], pose[4]
    change = euler_rates(up_in_body(roll, pitch), K.mount_roll, K.mount_pitch, K.mount_yaw)
    return np.concatenate([pose[:3], pose[3:] + np.stack(change)])


def camera_tilt_exact(pose: Array, K: Any) -> Array:
    """R_world_camera = R_world_body R_y(tilt_pitch) R_x(tilt_roll), without the small angle."""
    flip = rotation_world_body(0.0, 0.0, 0.0)
    R_body_camera = flip.T @ rotation_world_body(K.tilt_roll, K.tilt_pitch, 0.0)
    R_world_camera = rotation_world_body(pose[3], pose[4], pose[5]) @ R_body_camera
    return np.stack([*pose[:3], *euler_from_rotation(R_world_camera)])


EFFECTS = (
    Effect(
        name="camera_tilt",
        physics="The camera points in another direction than before; the aircraft is unchanged.",
        parameters=(
            Parameter("tilt_pitch", 0.01, -0.4, 0.4, "rad", "camera turned up in the body"),
            Parameter(
                "tilt_roll", 0.01, -0.4, 0.4, "rad", "camera turned about the nose, right side down"
            ),
        ),
        equation="R_world_camera = R_world_body Ry({tilt_pitch}) Rx({tilt_roll})",
        measurement_map=camera_tilt,
        acts_on=("camera",),
        same_form=("offset of the measured roll", "offset of the measured pitch"),
        separated_by=SEPARATED_BY,
        sizes=(0.014, 0.05, 0.12),
        draw=draw_direction("tilt_pitch", "tilt_roll"),
        hidden_map=camera_tilt_exact,
        frozen_number=16,
    ),
    Effect(
        name="camera_tilt",
        physics="The camera's mount is turned, sideways too; the aircraft is unchanged.",
        parameters=(
            Parameter("mount_pitch", 0.01, -0.4, 0.4, "rad", "camera turned up in the body"),
            Parameter(
                "mount_roll",
                0.01,
                -0.4,
                0.4,
                "rad",
                "camera turned about the nose, right side down",
            ),
            Parameter("mount_yaw", 0.01, -0.4, 0.4, "rad", "camera turned to the right"),
        ),
        equation="R_world_camera = R_world_body Rz({mount_yaw}) Ry({mount_pitch}) Rx({mount_roll})",
        measurement_map=camera_mount,
        acts_on=("camera",),
        same_form=("offset of the measured yaw",),
        essential=("mount_yaw",),
        separated_by=SEPARATED_BY,
        frozen_number=16,
    ),
)
