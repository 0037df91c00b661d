"""The marker on its board as an ideal camera sees it: light averaged over each pixel, then gamma,
then noise. Drawn.

Geometry is by hand here: a plane's points go to pixels by K [r1 r2 t] [Hartley & Zisserman, eq.
8.1]. The board is 1.0 m wide, white, with the 0.80 m black square of DICT_4X4_50, id 7, in its
middle.
"""

import cv2
import numpy as np

from falconwing_kit.core.frames import camera_pose, pose_matrix, rotation_world_body
from falconwing_kit.scene.camera import PinholeCamera

CAMERA = PinholeCamera(198.4, 198.4, 160.0, 120.0, 320, 240)
FINE = 6  # rays per pixel and axis
BOARD_PX = 480  # of the drawn board, 1.0 m
WALL = 0.2  # share of light that comes from around the board


def pose(x, y, z, roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0):
    """T_world_camera of a camera on the nose of a body at a place [m] and attitude [deg]."""
    return camera_pose(
        pose_matrix(rotation_world_body(*np.radians((roll_deg, pitch_deg, yaw_deg))), (x, y, z))
    )


def view(
    T_world_camera, rng, noise=2.0, blur_px=0.0, number=7, dictionary="DICT_4X4_50", size=0.80
):
    """(240, 320, 3) uint8: the board facing -x with its centre 0.75 m above the world's origin."""
    R, c = T_world_camera[:3, :3], T_world_camera[:3, 3]
    # A board pixel (a, b) lies at y = 0.5 - a / 480, z = 1.25 - b / 480 on the plane x = 0, at
    # print size 0.80 m.
    scale = size / 0.80 / BOARD_PX
    plane = np.array(
        [[0.0, 0.0, 0.0], [-scale, 0.0, 240 * scale], [0.0, -scale, 0.75 + 240 * scale]]
    )
    plane[:, 2] -= c
    H = np.diag([FINE, FINE, 1.0]) @ CAMERA.K @ R.T @ plane
    half = np.array(
        [[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]
    )  # OpenCV counts from pixel centres
    light = cv2.warpPerspective(
        _board(number, dictionary),
        np.linalg.inv(half) @ H @ half,
        (320 * FINE, 240 * FINE),
        borderValue=WALL,
    )
    light = cv2.resize(light, (320, 240), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), blur_px) if blur_px else light
    seen = 255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / 2.2)
    return np.clip(seen[..., None] + rng.normal(0.0, noise, (240, 320, 3)), 0, 255).astype(np.uint8)


def _board(number, dictionary):
    """Shares of light (480, 480): paper sends back 80 %, ink 5 %."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    side = BOARD_PX * 8 // 10
    drawn = cv2.aruco.generateImageMarker(known, number, side).astype(np.float64) / 255.0
    margin = (BOARD_PX - side) // 2
    return 0.05 + 0.75 * cv2.copyMakeBorder(drawn, *[margin] * 4, cv2.BORDER_CONSTANT, value=1.0)
