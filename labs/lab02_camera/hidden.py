"""Lab 2, instructors only: what the functions are judged against.

The kit's frames and OpenCV's projection.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from falconwing_kit.core import R_BODY_CAMERA, Array, pose_matrix, rotation_world_body
from falconwing_kit.tools.grading import Course, Judge, Values

R_MAP_WORLD = np.array(
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
)  # the kit's world: along, left, up
# slope of a ray that is neither floor nor wall to the last digit; such pixels are not drawn
SHALLOW = 0.03


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise.

    Args:
        course: the heading of its runway.

    Returns:
        By exercise.
    """
    runway = np.radians(course.constants["runway_heading_deg"])

    def attitude(roll: float, pitch: float, heading: float) -> Array:
        R_world_body = rotation_world_body(roll, pitch, heading - runway)
        return np.asarray(R_MAP_WORLD @ R_world_body)

    return {
        "rot_from_euler": (Values(_draw_angles, attitude),),
        "camera_pose": (Values(_draw_mount, _camera_pose),),
        "map_to_camera": (Values(_draw_points, _map_to_camera),),
        "project_points": (Values(_draw_in_front, _project),),
        "ground_points": (Values(_draw_pixels, _ground, rtol=1e-5),),
    }


def _draw_angles(rng: np.random.Generator) -> tuple[Any, ...]:
    return (
        float(rng.uniform(-2.5, 2.5)),
        float(rng.uniform(-1.3, 1.3)),
        float(rng.uniform(-6.0, 6.0)),
    )


def _any_rotation(rng: np.random.Generator) -> Array:
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return np.asarray(Q * np.linalg.det(Q))


def _draw_mount(rng: np.random.Generator) -> tuple[Any, ...]:
    return (
        _any_rotation(rng),
        rng.uniform(-8.0, 8.0, 3),
        rng.uniform(-0.4, 0.4, 3),
        float(rng.uniform(0.1, 0.9)),
    )


def _camera_pose(R_map_body: Array, p_map_body: Array, p_body_camera: Array, tilt: float) -> Array:
    """The tilt as a pitch down, by the kit's rotation; its flip is undone."""
    R_body_level = np.diag([1.0, -1.0, -1.0]) @ rotation_world_body(0.0, -tilt, 0.0)
    T_body_camera = pose_matrix(R_body_level @ R_BODY_CAMERA, p_body_camera)
    return np.asarray(pose_matrix(R_map_body, p_map_body) @ T_body_camera)


def _draw_points(rng: np.random.Generator) -> tuple[Any, ...]:
    count = int(rng.integers(4, 9))
    return rng.uniform(-10.0, 10.0, (count, 3)), pose_matrix(
        _any_rotation(rng), rng.uniform(-5.0, 5.0, 3)
    )


def _map_to_camera(p_map: Array, T_map_camera: Array) -> Array:
    homogeneous = np.vstack([p_map.T, np.ones(len(p_map))])
    return np.asarray(np.linalg.solve(T_map_camera, homogeneous)[:3].T)


def _draw_lens(rng: np.random.Generator) -> dict[str, float]:
    centre = rng.uniform(100.0, 200.0, 2)
    lens = {
        "fx": rng.uniform(150.0, 400.0),
        "fy": rng.uniform(150.0, 400.0),
        "cx": centre[0],
        "cy": centre[1],
    }
    return {name: float(value) for name, value in (lens | {"k1": rng.uniform(-0.2, -0.05)}).items()}


def _draw_in_front(rng: np.random.Generator) -> tuple[Any, ...]:
    """Points before the camera, with two behind it among them."""
    depth = rng.uniform(1.0, 12.0, 7) * np.array([1, 1, -1, 1, 1, -1, 1])
    return rng.uniform(-0.8, 0.8, (7, 3)) * np.abs(depth)[:, None] * (1, 1, 0) + np.outer(
        depth, (0, 0, 1)
    ), _draw_lens(rng)


def _project(p_camera: Array, lens: dict[str, float]) -> Array:
    """OpenCV's projection; its pixel coordinates are the kit's minus half a pixel."""
    import cv2

    K = np.array(
        [[lens["fx"], 0.0, lens["cx"] - 0.5], [0.0, lens["fy"], lens["cy"] - 0.5], [0.0, 0.0, 1.0]]
    )
    bend = np.array([lens["k1"], 0.0, 0.0, 0.0])
    pixels = cv2.projectPoints(p_camera[:, None, :], np.zeros(3), np.zeros(3), K, bend)[0][:, 0]
    return np.where(p_camera[:, 2:] > 0.0, pixels, np.nan)


def _draw_pixels(rng: np.random.Generator) -> tuple[Any, ...]:
    """A camera with a tilted horizon in its picture, and pixels on both sides of it."""
    lens = {name: value for name, value in _draw_lens(rng).items() if name != "k1"}
    R_world_camera = rotation_world_body(*rng.uniform(-1, 1, 3) * (0.4, 0.15, 3.0)) @ R_BODY_CAMERA
    T_map_camera = pose_matrix(
        R_MAP_WORLD @ R_world_camera, [*rng.uniform(-5.0, 5.0, 2), rng.uniform(0.5, 4.0)]
    )
    pixels = rng.uniform(0.0, 300.0, (200, 2))
    rise = _rise(pixels, T_map_camera, lens)
    floor, above = pixels[rise < -SHALLOW][:4], pixels[rise > SHALLOW][:2]
    return rng.permutation(np.concatenate([floor, above])), T_map_camera, lens


def _rays(pixels: Array, lens: dict[str, float]) -> Array:
    K = np.array(
        [[lens["fx"], 0.0, lens["cx"] - 0.5], [0.0, lens["fy"], lens["cy"] - 0.5], [0.0, 0.0, 1.0]]
    )
    return np.asarray(np.linalg.solve(K, np.vstack([pixels.T, np.ones(len(pixels))])))


def _rise(pixels: Array, T_map_camera: Array, lens: dict[str, float]) -> Array:
    return np.asarray(T_map_camera[2, :3] @ _rays(pixels, lens))


def _ground(pixels: Array, T_map_camera: Array, lens: dict[str, float]) -> Array:
    """The floor's homography: camera = [r1 r2 t] (x, y, 1) on z = 0, solved for x and y."""
    T_camera_map = np.linalg.inv(T_map_camera)
    x, y, w = np.linalg.solve(T_camera_map[:3, [0, 1, 3]], _rays(pixels, lens))
    points = np.stack([x / w, y / w, np.zeros(len(pixels))], axis=1)
    return np.where(_rise(pixels, T_map_camera, lens)[:, None] < 0.0, points, np.nan)
