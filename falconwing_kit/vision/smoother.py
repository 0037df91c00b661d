"""Flight smoother: sights of poses, noisy and full of holes -> the likeliest flight through them,
and how sure it is.

One state per frame, x = (position, roll pitch yaw, velocity, body rates), all found at once: the
least squares of

    sum over sights   rho(chi2 of the sight)              robust: what is far off counts like a Student-t draw
  + sum over steps    |x(k+1) - f(x(k))|^2 / (process)    how an aircraft moves, loosely
  + sum over frames   |what is ordinary in flight|^2      no sideslip, air from ahead, a speed it can fly

by Gauss-Newton. Each state touches only its neighbours, so the normal equations are
block-tridiagonal: one sweep forward and one back solve them, which for a linear model is the
fixed-interval smoother of Rauch, Tung & Striebel (1965) in information form, and give the
covariance of every frame.

It knows what every aircraft does (velocity along the nose, bank turns the flight path) and nothing
of the parameters that an identification is to find, so that the model is not put into its own data.
"""

from collections.abc import Sequence
from dataclasses import dataclass
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
STUDENT_DOF = 4.0  # of the sights' tails: a sight five sigmas off counts a sixth
MAX_STEPS = 60
TOLERANCE = 1e-3  # of the cost: a step that gains less than this is the last
MAX_PITCH = 1.4  # [rad] the angles' rates are not defined straight up
MAX_BLOCKS = 1e3  # residual in sigmas of a corner that would be behind the camera
DIFFERENCE_STEP = np.array(
    [1e-4] * 3 + [1e-5] * 3 + [1e-4] * 3 + [1e-4] * 3
)  # for derivatives by differences


@dataclass(frozen=True)
class Motion:
    """How an aircraft of this kind moves, loosely. Sizes are standard deviations.

    A "white" size s lets a rate of change wander: its integral over a time T is known to s sqrt(T).
    """

    speed: float = 7.0  # of the air from ahead [m/s]: about the slowest that 150 g fly at
    speed_spread: float = 3.0  # [m/s]
    sideslip: float = 0.8  # velocity towards the right wing [m/s]
    plunge: float = 1.2  # velocity towards the belly [m/s]
    turn_rate: float = 2.5  # of each body rate [rad/s]
    # over this long one deviation from the ordinary lasts; it counts once, not in every frame
    memory_s: float = 0.5
    forward_white: float = 1.5  # specific force along the nose [m/s^1.5]
    side_white: float = 1.5  # along the right wing [m/s^1.5]
    lift_white: float = 3.0  # along the belly, about what holds height in this bank [m/s^1.5]
    turn_white: float = 3.0  # angular acceleration [rad/s^1.5]


class Measurements(Protocol):
    """Measurements of one kind: something that says how far it is off at given poses of the body."""

    @property
    def rows(self) -> Any:
        """(M,) which frame each belongs to."""

    def residuals(self, p_world: Array, attitude: Array) -> Array:
        """(M, k) residuals in sigmas at body positions (M, 3) [m] and roll, pitch, yaw (M, 3)
        [rad].
        """


@dataclass(frozen=True, eq=False)
class PoseMeasurements:
    """Camera poses with their covariances."""

    rows: Any  # (M,)
    T_world_camera: Array  # (M, 4, 4)
    covariance: Array  # (M, 6, 6) of place [m] and of a small turn [rad], both in world axes
    p_body_camera: Array  # (3,) [m]

    def residuals(self, p_world: Array, attitude: Array) -> Array:
        """(M, 6): difference of the camera's place and the turn that is missing, made white by the
        covariance.
        """
        from scipy.spatial.transform import Rotation

        R_world_camera, p_world_camera = camera_at(p_world, attitude, self.p_body_camera)
        moved = p_world_camera - self.T_world_camera[:, :3, 3]
        turn = Rotation.from_matrix(
            R_world_camera @ np.swapaxes(self.T_world_camera[:, :3, :3], 1, 2)
        ).as_rotvec()
        off = np.concatenate([moved, turn], axis=1)
        return np.asarray(
            np.linalg.solve(np.linalg.cholesky(self.covariance), off[..., None])[..., 0]
        )


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
        """(M, 8): expected minus seen corners, made white by the covariance."""
        T_world_camera = pose_matrix(*camera_at(p_world, attitude, self.p_body_camera))
        expected = project_corners(self.marker, self.camera, T_world_camera)
        off = (expected - self.corners_px).reshape(len(expected), 8, 1)
        return np.nan_to_num(
            np.linalg.solve(np.linalg.cholesky(self.covariance), off)[..., 0], nan=MAX_BLOCKS
        )


@dataclass(frozen=True, eq=False)
class SmoothedTrajectory:
    """The likeliest flight, N frames."""

    p_world: Array  # (N, 3) [m]
    attitude: Array  # (N, 3) roll, pitch, yaw [rad], unwrapped
    v_world: Array  # (N, 3) [m/s]
    rates: Array  # (N, 3) p, q, r [rad/s]
    covariance: Array  # (N, 12, 12) of these, in this order
    chi2: tuple[Array, ...]  # for each kind of sights (M,): squared residuals, in sigmas
    steps: int

    @property
    def sigma_position(self) -> Array:
        """(N,) standard deviation of each coordinate of the place, their root mean square [m]."""
        return np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2) / 3.0)

    @property
    def sigma_attitude(self) -> Array:
        """(N,) the same of the angles [rad]."""
        return np.sqrt(np.trace(self.covariance[:, 3:6, 3:6], axis1=1, axis2=2) / 3.0)


def camera_at(p_world: Array, attitude: Array, p_body_camera: Array) -> tuple[Array, Array]:
    """Where a camera is that looks along the nose: R_world_camera (M, 3, 3) and its place (M, 3)
    [m].

    Args:
        p_world: (M, 3) the body's origin [m].
        attitude: (M, 3) roll, pitch, yaw [rad].
        p_body_camera: (3,) [m].
    """
    R_world_body = rotation_world_body(*np.asarray(attitude).T)
    return R_world_body @ R_BODY_CAMERA, p_world + R_world_body @ np.asarray(p_body_camera)


def smooth(
    t: Array, start: Array, measurements: Sequence[Measurements], motion: Motion | None = None
) -> SmoothedTrajectory:
    """Find the likeliest flight through sights.

    Args:
        t: (N,) [s], increasing.
        start: (N, 6) where to begin: p_world [m] and roll, pitch, yaw [rad], angles unwrapped;
            better than 2 m and 30 degrees where there are sights.
        sights: of one or several kinds.
        motion: how the aircraft moves; None takes the ordinary one.

    Returns:
        The flight and its covariance.

    Raises:
        InputError: fewer than two frames, no sights, or numbers that are not finite.
    """
    t = require_shape("t", t, (None,))
    start = require_shape("start", start, (len(t), 6))
    if len(t) < 2 or not (np.diff(t) > 0.0).all() or not np.isfinite(start).all():
        raise InputError(
            "smoother: expected two or more frames in order of time with a finite start, got others"
        )
    if sum(len(kind.rows) for kind in measurements) == 0:
        raise InputError("smoother: expected at least one sight of a pose, got none")
    motion = motion or Motion()
    x = _first_states(t, start)
    cost, damping = _cost(x, t, measurements, motion), 1e-3
    steps = 0
    while steps < MAX_STEPS and damping < 1e8:
        steps += 1
        diagonal, beside, gradient = _normal_equations(x, t, measurements, motion)
        damped = diagonal + damping * diagonal * np.eye(STATES)
        moved = _clamp_pitch(x + _solve(damped, beside, -gradient))
        new = _cost(moved, t, measurements, motion)
        if new < cost:
            gain, x, cost, damping = cost - new, moved, new, damping / 5.0
            if gain < TOLERANCE * max(1.0, cost):
                break
        else:
            damping *= 8.0
    diagonal, beside, _ = _normal_equations(x, t, measurements, motion)
    chi2 = tuple(_chi2(kind, x) for kind in measurements)
    return SmoothedTrajectory(
        x[:, :3], x[:, 3:6], x[:, 6:9], x[:, 9:], _covariances(diagonal, beside), chi2, steps
    )


def _first_states(t: Array, start: Array) -> Array:
    """(N, 12) states with the velocity that the places show, and no rates."""
    v_world = np.gradient(start[:, :3], t, axis=0)
    speed = np.linalg.norm(v_world, axis=1, keepdims=True)
    v_world *= np.minimum(1.0, 15.0 / np.maximum(speed, 1e-6))
    return _clamp_pitch(np.concatenate([start, v_world, np.zeros((len(t), 3))], axis=1))


def _clamp_pitch(x: Array) -> Array:
    """States with the pitch kept off straight up."""
    x[:, 4] = np.clip(x[:, 4], -MAX_PITCH, MAX_PITCH)
    return x


def _process_residuals(before: Array, after: Array, dt: Array, motion: Motion) -> Array:
    """(S, 12) how far steps are from how an aircraft moves, in sigmas.

    Place and attitude follow the mean of both ends' rates but for white accelerations s: their
    integrals stray by s sqrt(dt), their double integrals by s sqrt(dt^3 / 12) about that mean
    [Bar-Shalom, Li & Kirubarajan, 6.2.2]. Velocity follows gravity and a specific force; in the
    mean that force holds the height in this bank, (0, 0, -g / cos(roll)) in body axes, which is the
    coordinated turn.
    """
    step, root = dt[:, None], np.sqrt(dt)[:, None]
    middle = 0.5 * (before + after)
    roll, pitch = middle[:, 3], middle[:, 4]
    R_world_body = rotation_world_body(roll, pitch, middle[:, 5])
    angle_rates = np.stack(euler_rates(R_world_body[:, 2].T, *middle[:, 9:].T), axis=1)
    moved = (after[:, :3] - before[:, :3] - step * middle[:, 6:9]) * np.sqrt(12.0) / (step * root)
    moved_body = np.einsum("sji,sj->si", R_world_body, moved)
    turned = (after[:, 3:6] - before[:, 3:6] - step * angle_rates) * np.sqrt(12.0) / (step * root)
    force = (after[:, 6:9] - before[:, 6:9]) / step + (0.0, 0.0, GRAVITY)
    force_body = np.einsum("sji,sj->si", R_world_body, force)
    force_body[:, 2] += GRAVITY / np.maximum(np.cos(roll), 0.25)
    spun = (after[:, 9:] - before[:, 9:]) / root
    loose = np.array([motion.forward_white, motion.side_white, motion.lift_white])
    return np.concatenate(
        [
            moved_body / loose,
            turned / motion.turn_white,
            force_body * root / loose,
            spun / motion.turn_white,
        ],
        axis=1,
    )


def _prior_residuals(x: Array, dt: float, motion: Motion) -> Array:
    """(N, 6) how far frames are from ordinary flight, in sigmas that count once per memory_s."""
    R_world_body = rotation_world_body(*x[:, 3:6].T)
    v_body = np.einsum("nji,nj->ni", R_world_body, x[:, 6:9])
    size = np.array([motion.speed_spread, motion.sideslip, motion.plunge, *[motion.turn_rate] * 3])
    off = np.concatenate([v_body - (motion.speed, 0.0, 0.0), x[:, 9:]], axis=1)
    return np.asarray(off / size * np.sqrt(min(1.0, dt / motion.memory_s)))


def _chi2(kind: Measurements, x: Array) -> Array:
    """(M,) chi2 of each sight."""
    return np.asarray((kind.residuals(x[kind.rows, :3], x[kind.rows, 3:6]) ** 2).sum(axis=1))


def _cost(x: Array, t: Array, measurements: Sequence[Measurements], motion: Motion) -> float:
    dt = np.diff(t)
    total = (_process_residuals(x[:-1], x[1:], dt, motion) ** 2).sum() + (
        _prior_residuals(x, float(np.median(dt)), motion) ** 2
    ).sum()
    for kind in measurements:
        residual = kind.residuals(x[kind.rows, :3], x[kind.rows, 3:6])
        chi2, k = (residual**2).sum(axis=1), residual.shape[1]
        far = k + (STUDENT_DOF + k) * np.log((STUDENT_DOF + chi2) / (STUDENT_DOF + k))
        total += np.where(chi2 > k, far, chi2).sum()
    return float(total) if np.isfinite(total) else np.inf


def _normal_equations(
    x: Array, t: Array, measurements: Sequence[Measurements], motion: Motion
) -> tuple[Array, Array, Array]:
    """J^T W J as blocks on the diagonal (N, 12, 12) and beside it (N - 1, 12, 12), and J^T W r (N,
    12).
    """
    dt = np.diff(t)
    diagonal, beside = np.zeros((len(x), STATES, STATES)), np.zeros((len(x) - 1, STATES, STATES))
    gradient = np.zeros((len(x), STATES))
    residual = _process_residuals(x[:-1], x[1:], dt, motion)
    J_before = _derivative(lambda moved: _process_residuals(moved, x[1:], dt, motion), x[:-1])
    J_after = _derivative(lambda moved: _process_residuals(x[:-1], moved, dt, motion), x[1:])
    diagonal[:-1] += _product(J_before, J_before)
    diagonal[1:] += _product(J_after, J_after)
    beside += _product(J_before, J_after)
    gradient[:-1] += np.einsum("nri,nr->ni", J_before, residual)
    gradient[1:] += np.einsum("nri,nr->ni", J_after, residual)
    usual = float(np.median(dt))
    residual, J = (
        _prior_residuals(x, usual, motion),
        _derivative(lambda moved: _prior_residuals(moved, usual, motion), x),
    )
    diagonal += _product(J, J)
    gradient += np.einsum("nri,nr->ni", J, residual)
    for kind in measurements:
        seen = x[kind.rows]
        residual = kind.residuals(seen[:, :3], seen[:, 3:6])
        J = _derivative(
            lambda moved, kind=kind: kind.residuals(moved[:, :3], moved[:, 3:]), seen[:, :6]
        )
        k = residual.shape[1]
        weight = np.minimum(1.0, (STUDENT_DOF + k) / (STUDENT_DOF + (residual**2).sum(axis=1)))
        np.add.at(diagonal[:, :6, :6], kind.rows, weight[:, None, None] * _product(J, J))
        np.add.at(
            gradient[:, :6], kind.rows, weight[:, None] * np.einsum("nri,nr->ni", J, residual)
        )
    return diagonal, beside, gradient


def _derivative(function: Any, x: Array) -> Array:
    """(M, k, n) derivative of a function of (M, n) states, by central differences."""
    columns = []
    for j in range(x.shape[1]):
        ahead, behind = x.copy(), x.copy()
        ahead[:, j] += DIFFERENCE_STEP[j]
        behind[:, j] -= DIFFERENCE_STEP[j]
        columns.append((function(ahead) - function(behind)) / (2.0 * DIFFERENCE_STEP[j]))
    return np.stack(columns, axis=-1)


def _product(A: Array, B: Array) -> Array:
    """A^T B of each."""
    return np.asarray(np.swapaxes(A, 1, 2) @ B)


def _eliminate(diagonal: Array, beside: Array) -> Array:
    """(N, 12, 12) inverses of the blocks left by the sweep forward: D(k) = A(k) - B^T D(k-1)^-1 B."""
    inverse = np.empty_like(diagonal)
    inverse[0] = np.linalg.inv(diagonal[0])
    for k in range(1, len(diagonal)):
        inverse[k] = np.linalg.inv(diagonal[k] - beside[k - 1].T @ inverse[k - 1] @ beside[k - 1])
    return inverse


def _solve(diagonal: Array, beside: Array, right: Array) -> Array:
    """Solution (N, 12) of the block-tridiagonal equations: forward elimination, back substitution."""
    inverse, solved = _eliminate(diagonal, beside), right.copy()
    for k in range(1, len(right)):
        solved[k] -= beside[k - 1].T @ inverse[k - 1] @ solved[k - 1]
    solved[-1] = inverse[-1] @ solved[-1]
    for k in range(len(right) - 2, -1, -1):
        solved[k] = inverse[k] @ (solved[k] - beside[k] @ solved[k + 1])
    return solved


def _covariances(diagonal: Array, beside: Array) -> Array:
    """Diagonal blocks (N, 12, 12) of the inverse: S(k) = D(k)^-1 + D(k)^-1 B S(k+1) B^T D(k)^-1,
    from the last back.
    """
    covariance = _eliminate(diagonal, beside)
    for k in range(len(covariance) - 2, -1, -1):
        through = covariance[k] @ beside[k]
        covariance[k] += through @ covariance[k + 1] @ through.T
    return covariance
