"""Frames: the axioms of rotations, the sign conventions worked by hand, and one law of flight."""

import numpy as np
import pytest

from falconwing_kit.core.frames import (
    GRAVITY,
    R_BODY_CAMERA,
    body_rates,
    camera_pose,
    euler_from_ned,
    euler_from_rotation,
    euler_rates,
    euler_rates_of_angles,
    pose_matrix,
    rotation_entries,
    rotation_world_body,
    sine_and_cosine,
    turn_to_body,
    turn_to_world,
    up_in_body,
    world_from_enu,
    wrap_angle,
)

ROUNDING = 1e-14  # a few sums and products of numbers near 1


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def angles(rng):
    """200 attitudes, pitch kept 0.1 rad from straight up and down."""
    return (
        rng.uniform(-np.pi, np.pi, 200),
        rng.uniform(-1.47, 1.47, 200),
        rng.uniform(-np.pi, np.pi, 200),
    )


def elementary(axis: str, angle: float) -> np.ndarray:
    """Rotation about one axis as every textbook prints it."""
    c, s = np.cos(angle), np.sin(angle)
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def test_rotation_is_orthonormal_and_right_handed(angles):
    """R^T R = 1 and det R = +1 for every rotation."""
    R = rotation_world_body(*angles)
    assert np.abs(R.swapaxes(-1, -2) @ R - np.eye(3)).max() < ROUNDING
    assert np.abs(np.linalg.det(R) - 1.0).max() < ROUNDING


def test_rotation_is_the_product_of_elementary_ones(angles):
    """R_world_body = diag(1, -1, -1) Rz(yaw) Ry(pitch) Rx(roll), multiplied out here."""
    for roll, pitch, yaw in zip(*angles, strict=True):
        product = (
            np.diag([1, -1, -1])
            @ elementary("z", yaw)
            @ elementary("y", pitch)
            @ elementary("x", roll)
        )
        assert np.abs(rotation_world_body(roll, pitch, yaw) - product).max() < ROUNDING
        assert np.abs(np.array(rotation_entries(roll, pitch, yaw)) - product).max() < ROUNDING


def test_turns_are_products_with_the_matrix(angles, rng):
    """R_world_body' v to the body and R_world_body v to the world, for vectors of 10 m/s."""
    R_world_body, v = rotation_world_body(*angles), rng.uniform(-10.0, 10.0, (200, 3))
    sine, cosine = sine_and_cosine(np.array(angles))
    v_body = np.einsum("nij,ni->nj", R_world_body, v)
    v_world = np.einsum("nij,nj->ni", R_world_body, v)
    assert np.abs(np.array(turn_to_body(sine, cosine, *v.T)).T - v_body).max() < 20.0 * ROUNDING
    assert np.abs(np.array(turn_to_world(sine, cosine, *v.T)).T - v_world).max() < 20.0 * ROUNDING


def test_angles_come_back(angles):
    """The inverse of the composition, away from straight up and down."""
    recovered = euler_from_rotation(rotation_world_body(*angles))
    for got, expected in zip(recovered, angles, strict=True):
        assert np.abs(wrap_angle(got - expected)).max() < 1e-12


def test_level_flight_along_the_runway():
    """By hand: nose to +x, right wing to -y (y is left), belly to -z (z is up)."""
    assert np.array_equal(rotation_world_body(0.0, 0.0, 0.0), np.diag([1.0, -1.0, -1.0]))


@pytest.mark.parametrize(
    ("attitude", "v_body", "v_world"),
    [
        (
            (0.3, 0.0, 0.0),
            [0, 1, 0],
            [0, -np.cos(0.3), -np.sin(0.3)],
        ),  # roll right: the right wing goes down
        ((0.0, 0.3, 0.0), [1, 0, 0], [np.cos(0.3), 0, np.sin(0.3)]),  # pitch up: the nose rises
        (
            (0.0, 0.0, 0.3),
            [1, 0, 0],
            [np.cos(0.3), -np.sin(0.3), 0],
        ),  # yaw right: the nose turns to -y
        (
            (0.0, 0.0, np.pi / 2),
            [0, 1, 0],
            [-1, 0, 0],
        ),  # nose to -y: the right wing points back along the runway
        ((np.pi, 0.0, 0.0), [0, 0, 1], [0, 0, 1]),  # on its back: the belly looks up
    ],
)
def test_signs_worked_by_hand(attitude, v_body, v_world):
    """Each case drawn on paper from the words in the header of frames.py."""
    assert np.abs(rotation_world_body(*attitude) @ v_body - v_world).max() < ROUNDING


def test_euler_rates_match_the_derivative_of_the_rotation(angles, rng):
    """Law: dR/dt = R [w]x with w = (p, q, r) in body axes; the left side by central difference,
    error O(h^2).
    """
    roll, pitch, yaw = angles
    p, q, r = rng.uniform(-1.0, 1.0, (3, 200))
    roll_rate, pitch_rate, yaw_rate = euler_rates(rotation_entries(*angles)[2], p, q, r)
    # The step is taken along the rates scaled to unit size, since yaw_rate grows as 1/cos(pitch).
    scale = 1.0 + np.abs(yaw_rate)
    h = 1e-5 / scale
    ahead = rotation_world_body(roll + h * roll_rate, pitch + h * pitch_rate, yaw + h * yaw_rate)
    behind = rotation_world_body(roll - h * roll_rate, pitch - h * pitch_rate, yaw - h * yaw_rate)
    derivative = (ahead - behind) / (2.0 * h)[:, None, None]
    zero = np.zeros(200)
    cross = np.moveaxis(np.array([[zero, -r, q], [r, zero, -p], [-q, p, zero]]), -1, 0)
    assert np.abs(derivative - rotation_world_body(*angles) @ cross).max() < 1e-8


@pytest.mark.parametrize("pitch", [-3.0, -1.2, 0.0, 1.4, 1.7])
def test_euler_rates_of_angles_match_the_derivative_too(pitch, rng):
    """The same law, also beyond 90 deg of pitch; below that `euler_rates` gives the same, to
    rounding over cos pitch.
    """
    roll, yaw, p, q, r = rng.uniform(-3.0, 3.0, (5, 200))
    pitch = np.full(200, pitch)
    rates = euler_rates_of_angles(*sine_and_cosine(np.array([roll, pitch, yaw])), p, q, r)
    h = 1e-6
    ahead = rotation_world_body(roll + h * rates[0], pitch + h * rates[1], yaw + h * rates[2])
    behind = rotation_world_body(roll - h * rates[0], pitch - h * rates[1], yaw - h * rates[2])
    zero = np.zeros(200)
    cross = np.moveaxis(np.array([[zero, -r, q], [r, zero, -p], [-q, p, zero]]), -1, 0)
    expected = rotation_world_body(roll, pitch, yaw) @ cross
    assert np.abs((ahead - behind) / (2.0 * h) - expected).max() < 1e-7
    if abs(pitch[0]) < 0.5 * np.pi:
        by_row = euler_rates(rotation_entries(roll, pitch, yaw)[2], p, q, r)
        assert np.abs(np.array(rates) - np.array(by_row)).max() < 1e-12


def test_body_rates_invert_euler_rates(angles, rng):
    """Inverse, at every attitude away from straight up."""
    rates = rng.uniform(-3.0, 3.0, (3, 200))
    back = body_rates(angles[0], angles[1], *euler_rates(rotation_entries(*angles)[2], *rates))
    assert np.abs(np.array(back) - rates).max() < 1e-12


@pytest.mark.parametrize("roll", [-0.5, 0.2, 0.7])
def test_coordinated_turn_needs_g_over_v_tan_roll(roll):
    """Force balance: lift along minus belly holds the weight and bends the path; no other force,
    flight level.

    m g = L cos(roll) and the horizontal part of the lift is m V d(heading)/dt; all vectors from
    R_world_body alone.
    """
    speed = 7.0
    lift_direction = rotation_world_body(roll, 0.0, 0.4) @ np.array([0.0, 0.0, -1.0])
    lift_per_mass = GRAVITY / lift_direction[2]
    acceleration = lift_per_mass * lift_direction - np.array([0.0, 0.0, GRAVITY])
    v_world = speed * rotation_world_body(roll, 0.0, 0.4) @ np.array([1.0, 0.0, 0.0])
    turn_about_world_z = (v_world[0] * acceleration[1] - v_world[1] * acceleration[0]) / speed**2
    yaw_rate = -turn_about_world_z  # yaw is positive to the right, world z points up
    assert yaw_rate == pytest.approx(GRAVITY / speed * np.tan(roll), rel=1e-12)


def test_turning_level_shows_in_the_body_rates():
    """By hand: level turn with yaw rate w gives p = 0, q = w sin(roll), r = w cos(roll)."""
    p, q, r = body_rates(0.5, 0.0, 0.0, 0.0, 1.2)
    assert [float(p), float(q), float(r)] == pytest.approx(
        [0.0, 1.2 * np.sin(0.5), 1.2 * np.cos(0.5)], abs=1e-15
    )


def test_camera_looks_along_the_nose():
    """By hand: camera z is the nose, x the right wing, y the belly; 2 m ahead is 2 m ahead."""
    T_world_body = pose_matrix(rotation_world_body(0.0, 0.0, 0.0), [1.0, 2.0, 3.0])
    T_world_camera = camera_pose(T_world_body, [0.1, 0.0, 0.0])
    assert T_world_camera @ [0.0, 0.0, 2.0, 1.0] == pytest.approx(
        [3.1, 2.0, 3.0, 1.0], abs=ROUNDING
    )
    assert T_world_camera @ [1.0, 0.0, 0.0, 1.0] == pytest.approx(
        [1.1, 1.0, 3.0, 1.0], abs=ROUNDING
    )
    assert T_world_camera @ [0.0, 1.0, 0.0, 1.0] == pytest.approx(
        [1.1, 2.0, 2.0, 1.0], abs=ROUNDING
    )
    assert np.linalg.det(R_BODY_CAMERA) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("angle", "expected"), [(np.pi, -np.pi), (-np.pi, -np.pi), (7.0, 7.0 - 2 * np.pi), (0.5, 0.5)]
)
def test_wrap_keeps_the_angle_in_one_turn(angle, expected):
    """By hand, on the half-open interval [-pi, pi)."""
    assert float(wrap_angle(angle)) == pytest.approx(expected, abs=1e-15)


def test_world_from_north_east_down_keeps_the_angles():
    """With x = north, a nose to the east is 90 deg clockwise from north and turned right: the same
    yaw, nose to -y.
    """
    roll, pitch, yaw = euler_from_ned(0.1, 0.2, np.pi / 2)
    assert (float(roll), float(pitch), float(yaw)) == (0.1, 0.2, np.pi / 2)
    nose_world = rotation_world_body(0.0, 0.0, yaw)[:, 0]
    east_world = world_from_enu([1.0, 0.0, 0.0])
    assert nose_world == pytest.approx(east_world, abs=ROUNDING)


def test_world_from_east_north_up():
    """By hand: east is -y, north is x, up is z."""
    assert world_from_enu([1.0, 2.0, 3.0]).tolist() == [2.0, -1.0, 3.0]


def test_up_in_body_is_the_last_row_of_the_rotation(rng):
    """By definition: up is the world's third axis, and R_world_body turns body vectors into world
    ones.
    """
    roll, pitch, yaw = rng.uniform(-1.2, 1.2, (3, 50))
    R = rotation_world_body(roll, pitch, yaw)
    assert np.allclose(np.stack(up_in_body(roll, pitch), axis=-1), R[:, 2], atol=1e-14)
