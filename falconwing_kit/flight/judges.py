"""Evaluators: the truth of a simulated flight -> success, whether the leader is in view or hidden
behind the scene, and the paper's performance measures.

SR   success rate: touchdown on the pad; or leader locked in all frames without a collision
ALD  |lateral offset| from the pad's centre line at the first wheel contact, of landings only
ATE  mean of |D(t) - D(0)| over the frames until the lock is lost, D = p_leader - p_follower in the
     leader path's frame: ahead along its course, left, up. ATE_d is the same of the distance alone,
     ATE_path of the leader's lead along its own curved path and the follower's offset from it
"""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.control.leader import LeaderPath
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import CONTROL_PERIOD_S, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.masks import MASK_THRESHOLD

LOCK_AREA_PX = 6  # visible pixels of the leader that a lock requires
MAX_PATH_STEP = 3.0  # along the path between two frames, at most [m]
LEAD_IN = 20.0  # straight extension of the leader's path before its start, for the follower [m]


class FlightEvaluator(Protocol):
    """Evaluates one flight."""

    def watch(self, step: LoopStep) -> str:
        """Record the world after a step; the reason where the task is over, else empty."""

    def result(self) -> dict[str, Any]:
        """Measures of the flight; `success` is the outcome."""


class LandingEvaluator:
    """Touchdown: place, offset from the centre line, sink rate and attitude."""

    def __init__(self, world: SimulatedWorld) -> None:
        self.world, self._path = world, list[Array]()

    def watch(self, step: LoopStep) -> str:
        """Record the position; the reason is the first contact."""
        self._path.append(self.world.state.p_world)
        return _contact_reason(self.world)

    def result(self) -> dict[str, Any]:
        """Success; after a wheel contact also ald_m (on the pad only), sink rate and the like."""
        touchdown = self.world.contact.touchdown if self.world.contact else None
        record: dict[str, Any] = {"success": touchdown is not None and touchdown.on_pad}
        if touchdown is not None:
            record |= {
                "ald_m": touchdown.absolute_lateral_deviation if touchdown.on_pad else None,
                "lateral_offset_m": touchdown.lateral_offset,
                "past_threshold_m": touchdown.past_threshold,
                "sink_rate_m_s": touchdown.sink_rate,
                "speed_m_s": touchdown.speed,
                "bank_deg": math.degrees(touchdown.bank),
                "pitch_deg": math.degrees(touchdown.pitch),
                "wheel": touchdown.wheel,
            }
        return record | {"path_m": _round_path(self._path)}


class FollowEvaluator:
    """The lock in every frame, and the tracking errors along the leader's path."""

    def __init__(
        self, world: SimulatedWorld, leader: LeaderPath, airframe: Airframe, camera: PinholeCamera,
        view: RenderedView | None = None,
    ) -> None:  # fmt: skip
        self.world, self.airframe, self.camera, self.view = world, airframe, camera, view
        self.leader, self.leader_path = leader, extended_path(leader)
        self._t: list[float] = []
        self._locked: list[bool] = []
        self._leader: list[State] = []
        self._follower: list[Array] = []

    @property
    def is_locked(self) -> bool:
        """Whether the leader was in view in the newest frame."""
        return bool(self._locked) and self._locked[-1]

    def watch(self, step: LoopStep) -> str:
        """Record positions and lock; the reason is the first contact."""
        follower, leader = self.world.state, self.leader.state_at(self.world.t)
        self._t.append(step.t)
        self._locked.append(self._sees(follower, leader))
        self._leader.append(leader)
        self._follower.append(follower.p_world)
        return _contact_reason(self.world)

    def _sees(self, follower: State, leader: State) -> bool:
        """Whether the leader is locked now: by its image, or where there is none by its outline."""
        if self.view is None:
            T_world_camera = camera_pose(follower.pose.T_world_body, self.airframe.p_body_camera)
            return is_locked(self.camera, T_world_camera, leader, self.airframe)
        T_world_camera, share = self.view.T_world_camera, self.view.leader_share()
        return is_locked(self.camera, T_world_camera, leader, self.airframe, share)

    @property
    def locked(self) -> NDArray[np.bool_]:
        """(n,) whether the leader was locked, frame by frame."""
        return np.array(self._locked, bool)

    def result(self) -> dict[str, Any]:
        """Success, share of frames locked, time of the first loss, and the errors until then."""
        locked = np.array(self._locked)
        n = len(locked) if locked.all() else int(np.argmin(locked))  # frames before the first loss
        leader = np.array([state.vector for state in self._leader])
        follower = np.array(self._follower)
        errors = tracking_errors(leader[:n, 0:3], leader[:n, 6:9], follower[:n], self.leader_path)
        return {
            "success": bool(locked.all()) and self.world.contact is None,
            "locked_share": float(locked.mean()),
            "lost_at_s": None if n == len(locked) else self._t[n],
            **errors,
            "path_m": _round_path(follower),
            "leader_path_m": _round_path(leader[:, 0:3]),
        }


def is_locked(
    camera: PinholeCamera, T_world_camera: Array, leader: State, airframe: Airframe,
    share: NDArray[np.float32] | None = None,
) -> bool:  # fmt: skip
    """Whether the leader's centre of gravity is inside the image and six of its pixels are visible.

    Visible are pixels of which the leader makes up at least half. A wing seen edge-on is thinner
    than a pixel and makes up half of none, although the outline from its tips to the wheels has an
    area. Without an image the pixels of that outline count, and nothing hides it.

    Args:
        camera: the lens.
        T_world_camera: (4, 4) its pose.
        leader: the leader's state.
        airframe: the leader's dimensions.
        share: of each pixel that shows the leader, as of `RenderedView.leader_share`; None without
            an image.
    """
    (uv,), (centre_depth,) = camera.project(leader.p_world[None], T_world_camera)
    if not (centre_depth > 0.0 and 0.0 <= uv[0] < camera.width and 0.0 <= uv[1] < camera.height):
        return False
    if share is not None:
        return int((share >= MASK_THRESHOLD).sum()) >= LOCK_AREA_PX
    return outline_pixels(camera, T_world_camera, leader, airframe) >= LOCK_AREA_PX


def outline_pixels(
    camera: PinholeCamera, T_world_camera: Array, leader: State, airframe: Airframe
) -> int:
    """Number of pixels whose centre lies inside the outline of the leader.

    Arguments as for `is_locked`. 0 where a corner of the outline is behind the camera.
    """
    corners = leader.p_world + outline_body(airframe) @ leader.pose.T_world_body[:3, :3].T
    uv, leader_corner_depth = camera.project(corners, T_world_camera)
    if not (leader_corner_depth > 0.0).all():
        return 0
    # Pixel centres of the outline's bounding box, clipped to the image.
    size = np.array([camera.width, camera.height])
    low, high = np.clip([np.floor(uv.min(axis=0)), np.ceil(uv.max(axis=0))], 0, size).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    return int(is_in_hull(np.stack([columns, rows], axis=-1) + 0.5, uv).sum())


def outline_body(airframe: Airframe) -> Array:
    """Nose, tail, wing tips and wheels (7, 3) in body axes [m]."""
    return np.concatenate([airframe.corners_body, airframe.wheels.points_body])


def is_in_hull(points: Array, corners: Array) -> NDArray[np.bool_]:
    """Mask (...) of the points (..., 2) inside the convex hull of corners (m, 2).

    The hull is the union of all triangles of three corners.
    """
    inside = np.zeros(points.shape[:-1], bool)
    for triangle in combinations(corners, 3):
        sides = [_doubled_signed_area(points, triangle[i], triangle[(i + 1) % 3]) for i in range(3)]
        orientation = _doubled_signed_area(triangle[0], triangle[1], triangle[2])
        if orientation != 0.0:
            inside |= np.logical_and.reduce([side * orientation >= 0.0 for side in sides])
    return inside


def _doubled_signed_area(points: Array, a: Array, b: Array) -> Array:
    """Twice the signed area of the triangles (point, a, b)."""
    to_a, to_b = a - points, b - points
    return np.asarray(to_a[..., 0] * to_b[..., 1] - to_a[..., 1] * to_b[..., 0])


def extended_path(leader: LeaderPath) -> Array:
    """The leader's path as points (m, 3) [m], extended straight back from its start."""
    times = np.arange(0.0, leader.duration + CONTROL_PERIOD_S, CONTROL_PERIOD_S)
    leader_positions = np.array([leader.state_at(t).p_world for t in times])
    first = leader.state_at(0.0)
    back = np.arange(-LEAD_IN, 0.0, 0.25)[:, None] * first.v_world / np.linalg.norm(first.v_world)
    return np.concatenate([first.p_world + back, leader_positions])


def tracking_errors(
    leader: Array, v_leader: Array, follower: Array, path: Array
) -> dict[str, float | None]:
    """ATE, ATE_d and ATE_path: deviation of the follower from its first place behind the leader.

    ATE      = mean |D(t) - D(0)|, D = R_path_world (p_leader - p_follower), R: ahead, left, up
    ATE_d    = mean |d(t) - d(0)|, d = |p_leader - p_follower|
    ATE_path = mean |C(t) - C(0)|, C = (along, left, up) of the leader minus that of the follower
    along the curved path

    At the start of a turn a follower that keeps its distance on the same path has an ATE, for its
    bearing from the leader changes, but no ATE_path.

    Args:
        leader: (n, 3) positions in the evaluated frames [m].
        v_leader: (n, 3) its velocities [m/s], level speed above zero.
        follower: (n, 3) [m].
        path: (m, 3) the leader's path [m], longer than the distance between the two.

    Returns:
        ate_m, ate_d_m and ate_path_m [m]; None without frames.
    """
    if len(leader) == 0:
        return {"ate_m": None, "ate_d_m": None, "ate_path_m": None}
    between = leader - follower
    distance = np.linalg.norm(between, axis=1)
    D = np.einsum("nij,nj->ni", path_axes(v_leader), between)
    ahead = path_coordinates(leader, path)
    C = ahead - path_coordinates(follower, path, near=ahead[0, 0] - distance[0])
    return {
        "ate_m": float(np.linalg.norm(D - D[0], axis=1).mean()),
        "ate_d_m": float(np.abs(distance - distance[0]).mean()),
        "ate_path_m": float(np.linalg.norm(C - C[0], axis=1).mean()),
    }


def path_axes(along: Array) -> Array:
    """R_path_world (n, 3, 3) of directions (n, 3) along a path: rows ahead, level left, up."""
    ahead = along / np.linalg.norm(along, axis=1, keepdims=True)
    left = np.cross((0.0, 0.0, 1.0), ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([ahead, left, np.cross(ahead, left)], axis=1)


def path_coordinates(p_world: Array, path: Array, near: float | None = None) -> Array:
    """Positions relative to a polyline, by its nearest point.

    Args:
        p_world: (n, 3) positions in the order of time [m].
        path: (m, 3) [m].
        near: approximate arc length of the first position [m]; None searches the whole path.

    Returns:
        (n, 3): arc length from the first point, offset to the left and offset above [m].
    """
    segments = np.diff(path, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    begins, axes = np.concatenate([[0.0], np.cumsum(lengths)])[:-1], path_axes(segments)
    found = np.empty((len(p_world), 3))
    for row, p in enumerate(np.asarray(p_world, np.float64)):
        # Nearest point of every segment; segments far along the path from the last one are out.
        along = np.clip(np.einsum("ij,ij->i", p - path[:-1], axes[:, 0]), 0.0, lengths)
        offset = p - path[:-1] - along[:, None] * axes[:, 0]
        squared = np.einsum("ij,ij->i", offset, offset)
        if near is not None:
            squared[np.abs(begins + along - near) > MAX_PATH_STEP] = np.inf
        i = int(np.argmin(squared))
        near = float(begins[i] + along[i])
        found[row] = near, *(axes[i, 1:] @ offset[i])
    return found


def _contact_reason(world: SimulatedWorld) -> str:
    return f"touched {world.contact.obstacle}" if world.contact else ""


def _round_path(path: Sequence[Array] | Array) -> list[list[float]]:
    """A path for a record, to the millimetre."""
    return np.round(np.asarray(path, np.float64).reshape(-1, 3), 3).tolist()
