"""Camera offset: the camera sits at another place in the body, the aircraft flies as before."""

from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, draw_direction
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import rotation_entries


def camera_offset(pose: Array, K: Any) -> Array:
    """p_world_camera = p_world + R_world_body d, d the lever arm in body axes; attitude unchanged.

    [Titterton & Weston, Strapdown Inertial Navigation Technology, ch. 12: lever arm]
    """
    rows = rotation_entries(pose[3], pose[4], pose[5])
    place = [
        at + row[0] * K.camera_forward + row[1] * K.camera_right + row[2] * K.camera_down
        for at, row in zip(pose[:3], rows, strict=True)
    ]
    return np.stack([*place, *pose[3:]])


EFFECTS = (
    Effect(
        name="camera_offset",
        physics="The camera has been moved in the body: it swings around the aircraft in turns.",
        parameters=tuple(
            Parameter(f"camera_{side}", 0.02, -5.0, 5.0, "m", f"camera moved towards the {part}")
            for side, part in (("forward", "nose"), ("right", "right wing"), ("down", "belly"))
        ),
        equation=(
            "p_camera = p_body + R_world_body ({camera_forward}, {camera_right}, {camera_down})"
        ),
        measurement_map=camera_offset,
        acts_on=("lift", "along", "side"),  # positions, as an error of any force does
        separated_by={
            "steep turns": "a camera beside the centre of gravity swings with the body",
            "aileron doublets": "a camera below the roll axis moves sideways with the bank",
        },
        sizes=(0.05, 0.15, 0.4),
        draw=draw_direction("camera_forward", "camera_right", "camera_down"),
    ),
)
