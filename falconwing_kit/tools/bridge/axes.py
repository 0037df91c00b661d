"""Axes: poses in a log's own axes -> poses in the kit's, and which axes obey the law of flight.

Which axes a log uses is rarely written in it. Flight itself shows them: lift and drag lie in the
aircraft's plane of symmetry, so without sideslip the specific force f = a + g z_up has no component
along the wing, and points to the aircraft's back, not to its belly. A wrong choice of "up" adds
gravity where it should cancel: in a turn of bank phi, f then has 2 g sin(phi) along the wing.
"""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import (
    GRAVITY,
    body_rates,
    euler_from_rotation,
    rotation_world_body,
    wrap_angle,
)

# A log's world or body axes -> the kit's, as a rotation of the kit's axes by half a turn or none.
HALF_TURN = np.diag([1.0, -1.0, -1.0])
WORLDS = {"enu": np.eye(3), "ned": HALF_TURN}  # z up as the kit's world; z down
BODIES = {"flu": HALF_TURN, "frd": np.eye(3)}  # x nose, y left, z up; x nose, y right, z belly
STEP_S = 0.15  # between the positions of a second difference: 1 cm of noise becomes 1.1 m/s^2
CLEARLY = 1.5  # ratio of two residuals that separates right from wrong; a turn gives 3 and more
LAGS_S = np.arange(0.0, 0.45, 0.05)  # between a stick and the rate that follows
SURE_CORRELATION = 0.3  # of a stick and its rate: below it, the flight shows no sign


@dataclass(frozen=True)
class LogAxes:
    """Axes of a log's poses and where the kit's world lies in them."""

    world: str = "enu"  # a key of WORLDS
    body: str = "flu"  # a key of BODIES
    runway_deg: float = 0.0  # the kit's x axis from the log's, counter-clockwise seen from above
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the kit's world, in the log's [m]


def to_kit_poses(p_log: Array, R_log_body: Array, axes: LogAxes) -> tuple[Array, Array]:
    """Poses in the kit's axes.

    Args:
        p_log: (N, 3) positions in the log's world [m].
        R_log_body: (N, 3, 3) from the log's body axes to its world axes.
        axes: which these are.

    Returns:
        p_world (N, 3) [m]; attitude (N, 3): roll, pitch, yaw [rad].
    """
    angle = np.radians(axes.runway_deg)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    R_world_log = turn @ WORLDS[axes.world]
    R_world_body = R_world_log @ R_log_body @ BODIES[axes.body]
    p_world = (p_log - np.array(axes.origin)) @ R_world_log.T
    return p_world, np.column_stack(euler_from_rotation(R_world_body))


def rotations(quaternions: Array) -> Array:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4) in the order x, y, z, w."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def sideways_residuals(t: Array, p_log: Array, R_log_body: Array) -> dict[tuple[str, str], float]:
    """How far each pair of world and body axes is from flight without sideslip.

    Args:
        t: (N,) [s].
        p_log: (N, 3) [m], nan where no pose.
        R_log_body: (N, 3, 3).

    Returns:
        For each pair of WORLDS and BODIES the root mean square of the specific force along the
        wing over its mean along the back; infinity where lift points to the belly. Empty for less
        than ten measured times.
    """
    grid = np.arange(t[0], t[-1], STEP_S)
    rows = np.unique(np.searchsorted(t, grid))
    rows = rows[np.isfinite(p_log[rows]).all(axis=1)]
    if len(rows) < 10:
        return {}
    t, p, R = t[rows], p_log[rows], R_log_body[rows]
    before, after = np.diff(t)[:-1], np.diff(t)[1:]
    even = (before < 2.0 * STEP_S) & (after < 2.0 * STEP_S)
    v = np.diff(p, axis=0) / np.diff(t)[:, None]
    a_log = ((v[1:] - v[:-1]) / (0.5 * (before + after))[:, None])[even]
    R = R[1:-1][even]
    residuals = {}
    for world, R_kit_log in WORLDS.items():
        for body, R_body_kit in BODIES.items():
            force = a_log @ R_kit_log.T + [0.0, 0.0, GRAVITY]
            R_kit_body = R_kit_log @ R @ R_body_kit
            along_body = np.einsum("nij,ni->nj", R_kit_body, force)
            lift = -float(np.median(along_body[:, 2]))
            # Robust against the odd jump of a pose: 1.4826 medians are one standard deviation.
            sideways = 1.4826 * float(np.median(np.abs(along_body[:, 1])))
            residuals[world, body] = sideways / lift if lift > 0.0 else np.inf
    return residuals


def find_axes(
    t: Array, p_log: Array, R_log_body: Array, world: str = "", body: str = ""
) -> tuple[tuple[str, str], bool]:
    """The pair of world and body axes that fits best, and whether no other comes near.

    A flight without turns cannot separate z up from z down; of two pairs that fit as well, the one
    with the world of ROS, enu [REP 103], is returned.

    Args:
        t: (N,) [s].
        p_log: (N, 3) [m], nan where no pose.
        R_log_body: (N, 3, 3).
        world: the world axes if known, a key of WORLDS.
        body: the body axes if known, a key of BODIES.
    """
    residuals = {
        pair: residual
        for pair, residual in sideways_residuals(t, p_log, R_log_body).items()
        if world in ("", pair[0]) and body in ("", pair[1])
    }
    if not residuals or not np.isfinite(min(residuals.values())):
        return (world or "enu", body or "flu"), False
    best, second = sorted(residuals, key=lambda pair: residuals[pair])[:2]
    if residuals[second] > CLEARLY * residuals[best]:
        return best, True
    return min(best, second, key=lambda pair: pair[0] != "enu"), False


def nose_along_velocity(t: Array, p_world: Array, attitude: Array) -> float:
    """Mean cosine between the nose and the velocity; 1 for an aircraft that flies nose first."""
    rows = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], STEP_S)))
    rows = rows[np.isfinite(p_world[rows]).all(axis=1)]
    if len(rows) < 2:
        return float("nan")
    step = np.diff(p_world[rows], axis=0)
    nose = rotation_world_body(*attitude[rows].T)[:-1, :, 0]
    length = np.linalg.norm(step, axis=1)
    moving = length > 0.2 * np.median(length)
    return float(np.mean((step * nose).sum(axis=1)[moving] / np.maximum(length[moving], 1e-9)))


def stick_correlations(t: Array, attitude: Array, commands: Array) -> tuple[float, float]:
    """Correlation of aileron with the roll rate and of elevator with the pitch rate that follow.

    Args:
        t: (N,) [s].
        attitude: (N, 3) roll, pitch, yaw [rad], nan where no pose.
        commands: (N, 4) throttle, aileron, elevator, rudder.

    Returns:
        Each at the lag of LAGS_S where it is largest in size; 0 where a stick did not move.
    """
    measured = np.flatnonzero(np.isfinite(attitude).all(axis=1))
    grid = np.unique(np.searchsorted(t[measured], np.arange(t[0], t[-1], STEP_S)))
    rows = measured[grid[grid < len(measured)][:-1]]
    if len(rows) < 20:
        return 0.0, 0.0
    dt = np.diff(t[rows])
    rates = wrap_angle(np.diff(attitude[rows], axis=0)) / dt[:, None]
    middle = 0.5 * (t[rows][1:] + t[rows][:-1])
    angles = attitude[rows][:-1]
    p, q, _ = body_rates(angles[:, 0], angles[:, 1], *rates.T)
    near = dt < 2.0 * STEP_S
    found = []
    for stick, rate in ((commands[:, 1], p), (commands[:, 2], q)):
        values = []
        for lag in LAGS_S:
            row = np.searchsorted(t, middle - lag, side="right") - 1
            known = near & (row >= 0)
            moved = stick[row[known]]
            if len(moved) < 3 or moved.std() < 1e-6:
                values.append(0.0)
                continue
            # A jump of a pose must not decide the correlation.
            limit = 4.0 * np.median(np.abs(rate[known])) + 1e-9
            turned = np.clip(rate[known], -limit, limit)
            still = turned.std() < 1e-9
            values.append(0.0 if still else float(np.corrcoef(moved, turned)[0, 1]))
        found.append(max(values, key=abs))
    return found[0], found[1]
