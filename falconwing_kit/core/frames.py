"""Frames: attitude angles and vectors -> the same in world, body or camera axes.

world   x along the runway in the landing direction, y left, z up, origin on the floor at the marker
body    x nose, y right wing, z belly (the textbook's aircraft axes)
camera  x right, y down, z forward (OpenCV)

Textbooks write attitude against north-east-down axes. The world is that frame after half a turn
about x, hence R_world_body = diag(1, -1, -1) @ Rz(yaw) @ Ry(pitch) @ Rx(roll)   [Stevens, Lewis &
Johnson, Aircraft Control and Simulation, 3rd ed., eq. 1.3-20, with the half turn in front]. Roll is
positive right wing down, pitch nose up, yaw nose right. Rotations and Euler angles are defined here
only; level course vectors (cos yaw, -sin yaw) in `control` follow from them.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array

# The camera's axes in body axes: a camera along the nose is a plain permutation.
R_BODY_CAMERA: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
GRAVITY = 9.8  # m/s^2, the value of the paper's appendix
# Two opposite corners of the hall, 40 x 20 x 5 m, inside its walls, in the world frame [m].
HALL_LOW, HALL_HIGH = np.array([-22.5, -12.0, 0.0]), np.array([17.5, 8.0, 5.0])


def rotation_world_body(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Array:
    """Rotation from body axes to world axes: v_world = R_world_body @ v_body.

    Args:
        roll: (...) [rad], positive right wing down.
        pitch: (...) [rad], positive nose up.
        yaw: (...) [rad], positive nose right, zero along world x.

    Returns:
        R_world_body (..., 3, 3); columns are nose, right wing and belly in the world.
    """
    angles = [np.asarray(angle, np.float64) for angle in (roll, pitch, yaw)]
    R_world_body = np.empty((*np.broadcast_shapes(*(angle.shape for angle in angles)), 3, 3))
    for i, row in enumerate(rotation_entries(*angles)):
        for j, entry in enumerate(row):
            R_world_body[..., i, j] = entry
    return R_world_body


def rotation_entries(roll: Any, pitch: Any, yaw: Any) -> Any:
    """The nine entries of R_world_body, row by row, for angles (...).

    On batches this is several times faster than stacked matrices, and it is plain arithmetic that
    numba compiles.

    Returns:
        Three rows of three entries, each (...).
    """
    sin_roll, cos_roll = sine_and_cosine(roll)
    sin_pitch, cos_pitch = sine_and_cosine(pitch)
    sin_yaw, cos_yaw = sine_and_cosine(yaw)
    sin_roll_sin_pitch, cos_roll_sin_pitch = sin_roll * sin_pitch, cos_roll * sin_pitch
    return (
        (
            cos_pitch * cos_yaw,
            sin_roll_sin_pitch * cos_yaw - cos_roll * sin_yaw,
            cos_roll_sin_pitch * cos_yaw + sin_roll * sin_yaw,
        ),
        (
            -cos_pitch * sin_yaw,
            -sin_roll_sin_pitch * sin_yaw - cos_roll * cos_yaw,
            sin_roll * cos_yaw - cos_roll_sin_pitch * sin_yaw,
        ),
        (sin_pitch, -sin_roll * cos_pitch, -cos_roll * cos_pitch),
    )


def sine_and_cosine(angle: Any) -> Any:
    """Sine and cosine, each (...), by the tangent of half the angle t.

    sin = 2 t / (1 + t^2), cos = 2 / (1 + t^2) - 1. One vectorised tan is faster than sin and cos;
    the results agree to 1e-15.
    """
    half = np.tan(0.5 * angle)
    twice_cos2_half = 2.0 / (1.0 + half * half)
    return half * twice_cos2_half, twice_cos2_half - 1.0


def turn_to_body(sine: Any, cosine: Any, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
    """A vector in world axes -> in body axes: R_world_body' as three turns, one after the other.

    A turn by one angle takes four products, so this takes fewer than the matrix and its product.

    Args:
        sine: of roll, pitch and yaw, three entries (...).
        cosine: likewise.
        x: (...) along the runway.
        y: (...) left.
        z: (...) up.

    Returns:
        Along the nose, the right wing and the belly, each (...).
    """
    (sin_roll, sin_pitch, sin_yaw), (cos_roll, cos_pitch, cos_yaw) = sine, cosine
    ahead, left = cos_yaw * x - sin_yaw * y, sin_yaw * x + cos_yaw * y
    nose, below = cos_pitch * ahead + sin_pitch * z, sin_pitch * ahead - cos_pitch * z
    return nose, sin_roll * below - cos_roll * left, cos_roll * below + sin_roll * left


def turn_to_world(sine: Any, cosine: Any, nose: Any, wing: Any, belly: Any) -> tuple[Any, Any, Any]:
    """A vector in body axes -> in world axes; inverse of `turn_to_body`."""
    (sin_roll, sin_pitch, sin_yaw), (cos_roll, cos_pitch, cos_yaw) = sine, cosine
    left, below = sin_roll * belly - cos_roll * wing, cos_roll * belly + sin_roll * wing
    ahead, up = cos_pitch * nose + sin_pitch * below, sin_pitch * nose - cos_pitch * below
    return cos_yaw * ahead + sin_yaw * left, cos_yaw * left - sin_yaw * ahead, up


def euler_from_rotation(R_world_body: ArrayLike) -> tuple[Array, Array, Array]:
    """Roll, pitch and yaw of a rotation; inverse of `rotation_world_body` for |pitch| < 90 deg.

    Args:
        R_world_body: (..., 3, 3).

    Returns:
        roll in (-pi, pi], pitch in [-pi/2, pi/2], yaw in (-pi, pi], each (...) [rad].
    """
    R = np.asarray(R_world_body, dtype=np.float64)
    roll = np.arctan2(-R[..., 2, 1], -R[..., 2, 2])
    pitch = np.arcsin(np.clip(R[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(-R[..., 1, 0], R[..., 0, 0])
    return roll, pitch, yaw


def euler_rates(row_z: Any, p: Any, q: Any, r: Any) -> Any:
    """Rates of the Euler angles from body rates [Stevens, Lewis & Johnson, eq. 1.4-4].

    yaw_rate   = (q sin roll + r cos roll) / cos pitch
    pitch_rate = q cos roll - r sin roll
    roll_rate  = p + sin pitch yaw_rate

    Written with the last row of R_world_body, (sin pitch, -sin roll cos pitch, -cos roll cos
    pitch), which the caller already has: this saves four sines and cosines per evaluation.

    Args:
        row_z: last row of R_world_body, three entries of shape (...), |pitch| < 90 deg.
        p: (...) roll rate about the nose [rad/s].
        q: (...) pitch rate about the right wing [rad/s].
        r: (...) yaw rate about the belly [rad/s].

    Returns:
        roll_rate, pitch_rate, yaw_rate, each (...) [rad/s].
    """
    sin_pitch, right, down = row_z[0], -row_z[1], -row_z[2]
    cos_pitch_squared = right * right + down * down
    yaw_rate = (q * right + r * down) / cos_pitch_squared
    pitch_rate = (q * down - r * right) / np.sqrt(cos_pitch_squared)
    return p + sin_pitch * yaw_rate, pitch_rate, yaw_rate


def euler_rates_of_angles(sine: Any, cosine: Any, p: Any, q: Any, r: Any) -> Any:
    """`euler_rates` from the sines and cosines of the angles, its equation as it stands there.

    Args:
        sine: of roll, pitch and yaw, three entries (...), pitch away from +-90 deg.
        cosine: likewise.
        p: (...) roll rate about the nose [rad/s].
        q: (...) pitch rate about the right wing [rad/s].
        r: (...) yaw rate about the belly [rad/s].

    Returns:
        roll_rate, pitch_rate, yaw_rate, each (...) [rad/s].
    """
    (sin_roll, sin_pitch, _), (cos_roll, cos_pitch, _) = sine, cosine
    yaw_rate = (q * sin_roll + r * cos_roll) / cos_pitch
    return p + sin_pitch * yaw_rate, q * cos_roll - r * sin_roll, yaw_rate


def up_in_body(roll: ArrayLike, pitch: ArrayLike) -> tuple[Array, Array, Array]:
    """The world's up axis in body axes (the last row of R_world_body), three entries (...)."""
    roll, pitch = np.asarray(roll, np.float64), np.asarray(pitch, np.float64)
    return np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)


def body_rates(
    roll: ArrayLike,
    pitch: ArrayLike,
    roll_rate: ArrayLike,
    pitch_rate: ArrayLike,
    yaw_rate: ArrayLike,
) -> tuple[Array, Array, Array]:
    """Body rates p, q, r from the rates of the Euler angles; inverse of `euler_rates`."""
    roll, pitch = np.asarray(roll, np.float64), np.asarray(pitch, np.float64)
    roll_rate, pitch_rate, yaw_rate = (
        np.asarray(x, np.float64) for x in (roll_rate, pitch_rate, yaw_rate)
    )
    p = roll_rate - np.sin(pitch) * yaw_rate
    q = np.cos(roll) * pitch_rate + np.sin(roll) * np.cos(pitch) * yaw_rate
    r = np.cos(roll) * np.cos(pitch) * yaw_rate - np.sin(roll) * pitch_rate
    return p, q, r


def wrap_angle(angle: ArrayLike) -> Array:
    """The same angle in [-pi, pi), any shape [rad]."""
    return (np.asarray(angle, np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def pose_matrix(R_a_b: ArrayLike, p_a: ArrayLike) -> Array:
    """Homogeneous matrix of any two frames a and b, such as world and body.

    Args:
        R_a_b: (..., 3, 3) rotation from axes b to axes a.
        p_a: (..., 3) origin of b in a [m].

    Returns:
        T_a_b (..., 4, 4), "a from b".
    """
    R, p = np.asarray(R_a_b, np.float64), np.asarray(p_a, np.float64)
    T = np.zeros((*p.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1.0
    return T


def camera_pose(T_world_body: ArrayLike, p_body_camera: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """T_world_camera of a camera along the nose.

    Args:
        T_world_body: (..., 4, 4).
        p_body_camera: (3,) position of the camera in body axes [m].

    Returns:
        T_world_camera (..., 4, 4), "world from camera".
    """
    T_body_camera = pose_matrix(R_BODY_CAMERA, np.asarray(p_body_camera, np.float64))
    return np.asarray(np.asarray(T_world_body, np.float64) @ T_body_camera)


def euler_from_ned(
    roll_ned: ArrayLike, pitch_ned: ArrayLike, heading_ned: ArrayLike
) -> tuple[Array, Array, Array]:
    """Roll, pitch, yaw with world x = north from an autopilot's angles against north-east-down.

    The two frames differ by half a turn about x, which leaves all three angles unchanged.
    """
    return (
        np.asarray(roll_ned, np.float64),
        np.asarray(pitch_ned, np.float64),
        np.asarray(heading_ned, np.float64),
    )


def world_from_enu(v_enu: ArrayLike) -> Array:
    """East-north-up vectors (..., 3) -> world vectors (..., 3) with x = north, y = west, z = up."""
    v = np.asarray(v_enu, np.float64)
    return np.stack([v[..., 1], -v[..., 0], v[..., 2]], axis=-1)
