"""Flight smoother: noisy pose measurements with gaps -> the most probable flight, with
covariances and sigmas of every frame.

One state per frame, x = (position, roll pitch yaw, velocity, body rates), all estimated jointly:
least squares of

    sum over measurements  rho(chi2)                          robust: Student-t likelihood
  + sum over steps         |x(k+1) - f(x(k))|^2 / process     loose kinematics of an aircraft
  + sum over frames        |deviation from usual flight|^2    no sideslip, usual speed and rates

by Levenberg-Marquardt. Each state is coupled to its neighbours only, so that the normal equations
are block-tridiagonal: one sweep forward and one back solve them, which for a linear model is the
fixed-interval smoother of Rauch, Tung & Striebel (1965) in information form, and give the
covariance of every frame.

The process model holds for every aircraft (velocity along the nose, bank turns the flight path) and
contains none of the parameters that an identification estimates: the model to be identified must
not enter its own data.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.core.frames import (
    GRAVITY,
    R_BODY_CAMERA,
    euler_rates,
    pose_matrix,
    rotation_world_body,
)
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.marker import Marker, project_corners

STATES = 12  # p_world, roll pitch yaw, v_world, body rates
STUDENT_DOF = 4.0  # of the measurements' tails: one five sigmas off counts a sixth
MAX_STEPS = 60
TOLERANCE = 1e-3  # relative decrease of the cost at which the iteration ends
MAX_DAMPING = 1e8
MAX_PITCH = 1.4  # [rad]; Euler angle rates are singular at 90 degrees
MAX_SPEED = 15.0  # of the initial trajectory [m/s]
BEHIND_SIGMAS = 1e3  # residual of a corner that would be behind the camera
# central differences, by state
DIFFERENCE_STEP = np.array([1e-4] * 3 + [1e-5] * 3 + [1e-4] * 3 + [1e-4] * 3)


@dataclass(frozen=True)
class Motion:
    """Process model and prior of the smoother, as standard deviations.

    A "white" size s is the density of white noise on a rate of change: its integral over a time T
    has the standard deviation s sqrt(T).
    """

    speed: float = 7.0  # usual airspeed [m/s]: about the minimum of a 150 g aircraft
    speed_spread: float = 3.0  # [m/s]
    sideslip: float = 0.8  # velocity towards the right wing [m/s]
    plunge: float = 1.2  # velocity towards the belly [m/s]
    turn_rate: float = 2.5  # of each body rate [rad/s]
    memory_s: float = 0.5  # correlation time of the motion-model deviations
    forward_white: float = 1.5  # specific force along the nose [m/s^1.5]
    side_white: float = 1.5  # along the right wing [m/s^1.5]
    lift_white: float = 3.0  # along the belly, about that of a coordinated turn [m/s^1.5]
    turn_white: float = 3.0  # angular acceleration [rad/s^1.5]


class Measurements(Protocol):
    """Measurements of one kind, with their residuals at given poses of the body."""

    @property
    def rows(self) -> Any:
        """(M,) the frame of each."""

    def residuals(self, p_world: Array, attitude: Array) -> Array:
        """(M, k) whitened residuals at positions (M, 3) [m] and roll, pitch, yaw (M, 3) [rad]."""


@dataclass(frozen=True, eq=False)
class PoseMeasurements:
    """Camera poses with their covariances."""

    rows: Any  # (M,) frames
    T_world_camera: Array  # (M, 4, 4)
    covariance: Array  # (M, 6, 6) of position [m] and rotation vector [rad] in world axes
    p_body_camera: Array  # (3,) [m]

    def residuals(self, p_world: Array, attitude: Array) -> Array:
        """(M, 6) L^-1 (position error, rotation vector error), with L L^T the covariance."""
        from scipy.spatial.transform import Rotation

        R_world_camera, p_world_camera = camera_at(p_world, attitude, self.p_body_camera)
        moved = p_world_camera - self.T_world_camera[:, :3, 3]
        R_error = R_world_camera @ np.swapaxes(self.T_world_camera[:, :3, :3], 1, 2)
        pose_error = np.concatenate([moved, Rotation.from_matrix(R_error).as_rotvec()], axis=1)
        return _whiten(pose_error, self.covariance)


@dataclass(frozen=True, eq=False)
class CornerMeasurements:
    """The marker's corners in images."""

    rows: Any  # (M,) frames
    corners_px: Array  # (M, 4, 2)
    covariance: Array  # (M, 8, 8) of u1 v1 ... u4 v4 [px^2]
    marker: Marker
    camera: PinholeCamera
    p_body_camera: Array  # (3,) [m]

    def residuals(self, p_world: Array, attitude: Array) -> Array:
        """(M, 8) L^-1 (projected minus measured corners), with L L^T the covariance."""
        T_world_camera = pose_matrix(*camera_at(p_world, attitude, self.p_body_camera))
        projected = project_corners(self.marker, self.camera, T_world_camera)
        error = (projected - self.corners_px).reshape(-1, 8)
        return np.nan_to_num(_whiten(error, self.covariance), nan=BEHIND_SIGMAS)


@dataclass(frozen=True, eq=False)
class SmoothedTrajectory:
    """The most probable flight, N frames."""

    p_world: Array  # (N, 3) [m]
    attitude: Array  # (N, 3) roll, pitch, yaw [rad], unwrapped
    v_world: Array  # (N, 3) [m/s]
    rates: Array  # (N, 3) p, q, r [rad/s]
    covariance: Array  # (N, 12, 12) of these, in this order
    chi2: tuple[Array, ...]  # (M,) of each measurement, one array for each kind
    steps: int

    @property
    def sigma_position(self) -> Array:
        """(N,) standard deviation of the position, root mean square of the three axes [m]."""
        return np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2) / 3.0)

    @property
    def sigma_attitude(self) -> Array:
        """(N,) the same of the angles [rad]."""
        return np.sqrt(np.trace(self.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3.0)


def camera_at(p_world: Array, attitude: Array, p_body_camera: Array) -> tuple[Array, Array]:
    """Pose of a camera that looks along the nose: R_world_camera (M, 3, 3), position (M, 3) [m].

    Args:
        p_world: (M, 3) of the body [m].
        attitude: (M, 3) roll, pitch, yaw [rad].
        p_body_camera: (3,) [m].
    """
    R_world_body = rotation_world_body(*np.asarray(attitude).T)
    return R_world_body @ R_BODY_CAMERA, p_world + R_world_body @ np.asarray(p_body_camera)


def smooth(
    t: Array, start: Array, measurements: Sequence[Measurements], motion: Motion | None = None
) -> SmoothedTrajectory:
    """Most probable flight through measurements.

    Args:
        t: (N,) [s], increasing.
        start: (N, 6) initial p_world [m] and roll, pitch, yaw [rad], unwrapped; within about 2 m
            and 30 degrees where there are measurements.
        measurements: of one or several kinds.
        motion: None takes the default process model.

    Raises:
        InputError: fewer than two frames, no measurements, or numbers that are not finite.
    """
    t = require_shape("t", t, (None,))
    start = require_shape("start", start, (len(t), 6))
    if len(t) < 2 or not (np.diff(t) > 0.0).all() or not np.isfinite(start).all():
        raise InputError(
            "smoother: expected two or more frames in order of time with a finite start, "
            "got others; sort the frames and drop those without a pose"
        )
    if sum(len(kind.rows) for kind in measurements) == 0:
        raise InputError(
            "smoother: expected at least one measurement of a pose, got none; "
            "give a marker or a network"
        )
    motion = motion or Motion()
    x = _initial_states(t, start)
    cost, damping, steps = _cost(x, t, measurements, motion), 1e-3, 0
    while steps < MAX_STEPS and damping < MAX_DAMPING:
        steps += 1
        # Levenberg-Marquardt: a step that lowers the cost reduces the damping, others increase it
        diagonal, upper, gradient = _normal_equations(x, t, measurements, motion)
        damped = diagonal + damping * diagonal * np.eye(STATES)
        moved = _clamp_pitch(x + _solve(damped, upper, -gradient))
        new_cost = _cost(moved, t, measurements, motion)
        if new_cost < cost:
            decrease, x, cost, damping = cost - new_cost, moved, new_cost, damping / 5.0
            if decrease < TOLERANCE * max(1.0, cost):
                break
        else:
            damping *= 8.0
    diagonal, upper, _ = _normal_equations(x, t, measurements, motion)
    chi2 = tuple((_residuals(kind, x[kind.rows]) ** 2).sum(axis=1) for kind in measurements)
    covariance = _covariances(diagonal, upper)
    return SmoothedTrajectory(x[:, :3], x[:, 3:6], x[:, 6:9], x[:, 9:], covariance, chi2, steps)


def _initial_states(t: Array, start: Array) -> Array:
    """(N, 12) states with velocities by differences, at most MAX_SPEED, and no body rates."""
    v_world = np.gradient(start[:, :3], t, axis=0)
    speed = np.linalg.norm(v_world, axis=1, keepdims=True)
    v_world *= np.minimum(1.0, MAX_SPEED / np.maximum(speed, 1e-6))
    return _clamp_pitch(np.concatenate([start, v_world, np.zeros((len(t), 3))], axis=1))


def _clamp_pitch(x: Array) -> Array:
    """The states, changed in place, with the pitch within MAX_PITCH."""
    x[:, 4] = np.clip(x[:, 4], -MAX_PITCH, MAX_PITCH)
    return x


def _whiten(error: Array, covariance: Array) -> Array:
    """(M, k) L^-1 e of errors (M, k) with covariances L L^T (M, k, k): independent, sigma 1."""
    factor = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.solve(factor, error[..., None])[..., 0])


def _residuals(kind: Measurements, poses: Array) -> Array:
    """(M, k) whitened residuals of M measurements at their frames' states, of which 6 are used."""
    return kind.residuals(poses[:, :3], poses[:, 3:6])


def _process_residuals(before: Array, after: Array, dt: Array, motion: Motion) -> Array:
    """(S, 12) whitened deviation of steps from the process model.

    Position and attitude follow the mean of both ends' rates but for white accelerations s: their
    integrals have the standard deviation s sqrt(dt), their double integrals s sqrt(dt^3 / 12) about
    that mean [Bar-Shalom, Li & Kirubarajan, 6.2.2]. Velocity follows gravity and a specific force,
    whose mean balances the weight in this bank, (0, 0, -g / cos(roll)) in body axes: the
    coordinated turn.
    """
    step, root = dt[:, None], np.sqrt(dt)[:, None]
    root_12, step_root = np.sqrt(12.0), step * root
    middle = 0.5 * (before + after)
    roll, pitch, yaw = middle[:, 3:6].T
    R_world_body = rotation_world_body(roll, pitch, yaw)
    white_force = np.array([motion.forward_white, motion.side_white, motion.lift_white])
    # position: trapezoidal rule, in body axes
    moved = (after[:, :3] - before[:, :3] - step * middle[:, 6:9]) * root_12 / step_root
    moved_body = np.einsum("sji,sj->si", R_world_body, moved)
    # attitude: Euler rates of the mean body rates; the third row of R_world_body gives their axes
    angle_rates = np.stack(euler_rates(R_world_body[:, 2].T, *middle[:, 9:].T), axis=1)
    rotated = (after[:, 3:6] - before[:, 3:6] - step * angle_rates) * root_12 / step_root
    # velocity: specific force (acceleration less gravity) less that of the coordinated turn
    force = (after[:, 6:9] - before[:, 6:9]) / step + (0.0, 0.0, GRAVITY)
    force_body = np.einsum("sji,sj->si", R_world_body, force)
    force_body[:, 2] += GRAVITY / np.maximum(np.cos(roll), 0.25)
    rate_change = (after[:, 9:] - before[:, 9:]) / root
    return np.concatenate(
        [
            moved_body / white_force,
            rotated / motion.turn_white,
            force_body * root / white_force,
            rate_change / motion.turn_white,
        ],
        axis=1,
    )


def _prior_residuals(x: Array, dt: float, motion: Motion) -> Array:
    """(N, 6) whitened deviation from usual flight; frames within memory_s count as one."""
    R_world_body = rotation_world_body(*x[:, 3:6].T)
    v_body = np.einsum("nji,nj->ni", R_world_body, x[:, 6:9])
    sigma = np.array([motion.speed_spread, motion.sideslip, motion.plunge, *[motion.turn_rate] * 3])
    deviation = np.concatenate([v_body - (motion.speed, 0.0, 0.0), x[:, 9:]], axis=1)
    return np.asarray(deviation / sigma * np.sqrt(min(1.0, dt / motion.memory_s)))


def _cost(x: Array, t: Array, measurements: Sequence[Measurements], motion: Motion) -> float:
    """The least-squares sum of the file's docstring; infinite where it is not defined.

    rho is quadratic up to chi2 = k, the number of coordinates, and continues as the Student-t log
    likelihood with the same value and slope.
    """
    dt = np.diff(t)
    process = _process_residuals(x[:-1], x[1:], dt, motion)
    total = (process**2).sum() + (_prior_residuals(x, float(np.median(dt)), motion) ** 2).sum()
    for kind in measurements:
        residual = _residuals(kind, x[kind.rows])
        chi2, k = (residual**2).sum(axis=1), residual.shape[1]
        tail = k + (STUDENT_DOF + k) * np.log((STUDENT_DOF + chi2) / (STUDENT_DOF + k))
        total += np.where(chi2 > k, tail, chi2).sum()
    return float(total) if np.isfinite(total) else np.inf


def _normal_equations(
    x: Array, t: Array, measurements: Sequence[Measurements], motion: Motion
) -> tuple[Array, Array, Array]:
    """Blocks of J^T W J and J^T W r at states (N, 12).

    Returns:
        Diagonal blocks (N, 12, 12), the blocks right of them (N - 1, 12, 12), gradient (N, 12).
    """
    dt = np.diff(t)
    diagonal, upper = np.zeros((len(x), STATES, STATES)), np.zeros((len(x) - 1, STATES, STATES))
    gradient = np.zeros((len(x), STATES))
    # steps: each couples frame k (J_before) with frame k + 1 (J_after)
    residual = _process_residuals(x[:-1], x[1:], dt, motion)
    J_before = _derivative(lambda moved: _process_residuals(moved, x[1:], dt, motion), x[:-1])
    J_after = _derivative(lambda moved: _process_residuals(x[:-1], moved, dt, motion), x[1:])
    diagonal[:-1] += _transposed_product(J_before, J_before)
    diagonal[1:] += _transposed_product(J_after, J_after)
    upper += _transposed_product(J_before, J_after)
    gradient[:-1] += np.einsum("nri,nr->ni", J_before, residual)
    gradient[1:] += np.einsum("nri,nr->ni", J_after, residual)
    # prior: each frame by itself
    period = float(np.median(dt))
    residual = _prior_residuals(x, period, motion)
    J = _derivative(lambda moved: _prior_residuals(moved, period, motion), x)
    diagonal += _transposed_product(J, J)
    gradient += np.einsum("nri,nr->ni", J, residual)
    # measurements: position and attitude only, with the weights of the robust loss (IRLS)
    for kind in measurements:
        poses = x[kind.rows, :6]
        residual = _residuals(kind, poses)
        J = _derivative(partial(_residuals, kind), poses)
        k = residual.shape[1]
        weight = np.minimum(1.0, (STUDENT_DOF + k) / (STUDENT_DOF + (residual**2).sum(axis=1)))
        information = weight[:, None, None] * _transposed_product(J, J)
        np.add.at(diagonal[:, :6, :6], kind.rows, information)
        weighted = weight[:, None] * np.einsum("nri,nr->ni", J, residual)
        np.add.at(gradient[:, :6], kind.rows, weighted)
    return diagonal, upper, gradient


def _derivative(function: Callable[[Array], Array], x: Array) -> Array:
    """(M, k, n) derivative of a function of (M, n) states, by central differences."""
    columns = []
    for j in range(x.shape[1]):
        ahead, behind = x.copy(), x.copy()
        ahead[:, j] += DIFFERENCE_STEP[j]
        behind[:, j] -= DIFFERENCE_STEP[j]
        columns.append((function(ahead) - function(behind)) / (2.0 * DIFFERENCE_STEP[j]))
    return np.stack(columns, axis=-1)


def _transposed_product(A: Array, B: Array) -> Array:
    """A^T B of stacked matrices."""
    return np.asarray(np.swapaxes(A, 1, 2) @ B)


def _eliminate(diagonal: Array, upper: Array) -> Array:
    """(N, 12, 12) inverse pivots of block elimination: D(k) = A(k) - B^T D(k-1)^-1 B."""
    inverse = np.empty_like(diagonal)
    inverse[0] = np.linalg.inv(diagonal[0])
    for k in range(1, len(diagonal)):
        B = upper[k - 1]  # couples frame k - 1, which is eliminated, with frame k
        inverse[k] = np.linalg.inv(diagonal[k] - B.T @ inverse[k - 1] @ B)
    return inverse


def _solve(diagonal: Array, upper: Array, right: Array) -> Array:
    """Solution (N, 12) of the block-tridiagonal equations with right side (N, 12)."""
    inverse, solution = _eliminate(diagonal, upper), right.copy()
    for k in range(1, len(right)):  # forward: eliminate frame k - 1
        solution[k] -= upper[k - 1].T @ inverse[k - 1] @ solution[k - 1]
    solution[-1] = inverse[-1] @ solution[-1]
    for k in range(len(right) - 2, -1, -1):  # back substitution
        solution[k] = inverse[k] @ (solution[k] - upper[k] @ solution[k + 1])
    return solution


def _covariances(diagonal: Array, upper: Array) -> Array:
    """Diagonal blocks (N, 12, 12) of the inverse, from the last frame back.

    S(k) = D(k)^-1 + D(k)^-1 B S(k+1) B^T D(k)^-1
    """
    covariance = _eliminate(diagonal, upper)
    for k in range(len(covariance) - 2, -1, -1):
        gain = covariance[k] @ upper[k]
        covariance[k] += gain @ covariance[k + 1] @ gain.T
    return covariance
