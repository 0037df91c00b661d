"""Make data/video.npz: SIMULATED video at 20 Hz with a turn, a lost signal and a frozen picture.

python labs/lab10_bridge/make_data.py
"""

import math
from pathlib import Path

import cv2
import numpy as np

from falconwing_kit.core import camera_pose, pose_matrix, rotation_world_body
from falconwing_kit.flight import fpv_camera
from falconwing_kit.scene import AnalogVideo, load_scene, render

PARTS = (
    ("straight", 20),
    ("turn", 16),
    ("straight", 14),
    ("signal lost", 16),
    ("good again", 14),
    ("frozen", 20),
)
SPEED, STEP_S, TURN = 7.0, 0.05, math.radians(60.0)  # m/s, s, rad/s
RENDERED, KEPT = (320, 240), (64, 48)  # px


def main() -> None:
    """Fly, render, send through the simulated link, reduce and write."""
    scene, camera = load_scene("arena"), fpv_camera(*RENDERED)
    good, lost = AnalogVideo(34.0, dropouts=0.0), AnalogVideo(2.0)
    p_world, yaw = np.array([-19.0, 2.5, 1.6]), 0.0
    pictures: list[np.ndarray] = []
    for part, frames in PARTS:
        for _ in range(frames):
            if part == "frozen":
                pictures.append(pictures[-1])
                continue
            yaw += STEP_S * TURN * (part == "turn")
            p_world = p_world + 0.5 * STEP_S * SPEED * np.array(
                [math.cos(yaw), -math.sin(yaw), 0.0]
            )
            pose = camera_pose(
                pose_matrix(rotation_world_body(0.0, 0.0, yaw), p_world), np.zeros(3)
            )
            clean = np.asarray(255.0 * render(scene, camera, pose).rgb + 0.5, np.uint8)
            seen = (lost if part == "signal lost" else good).apply(clean, len(pictures))
            pictures.append(
                cv2.resize(
                    cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), KEPT, interpolation=cv2.INTER_AREA
                )
            )
    firsts = np.cumsum([0, *(frames for _, frames in PARTS[:-1])])
    names = np.array([part for part, _ in PARTS])
    file = Path(__file__).parent / "data" / "video.npz"
    np.savez_compressed(file, images=np.array(pictures), firsts=firsts, names=names)


if __name__ == "__main__":
    main()
