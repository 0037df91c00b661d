"""Judges: the truth of a simulated flight -> did it do what it should, and how well, by the paper's
measures.

A judge looks at what the pilot does not see.

SR   share of trials that succeed: touchdown on the pad; or the leader locked in all frames and nothing touched
ALD  |lateral offset| from the pad's centre line at the first wheel contact, of landed trials only
ATE  mean over the frames until the lock is lost of |D(t) - D(0)|, D = p_leader - p_follower in the
     leader path's frame: ahead along its course, to the left, up. ATE_d is the same of the distance
     alone, ATE_path of the leader's lead along its own curved path and the follower's offset from
     that path
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
from falconwing_kit.core.messages import State
from falconwing_kit.flight.loop import CONTROL_PERIOD, LoopStep
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera

Depth = NDArray[np.float32]

LOCK_AREA_PX = 6  # visible pixels of the leader that a lock needs
OCCLUSION_MARGIN = (
    0.5  # m: what is so much nearer than the leader's nearest point is something else
)
MAX_PATH_STEP = 3.0  # m along the path between two frames at most
LEAD_IN = 20.0  # m by which the leader's path is led back, for who comes after


class FlightEvaluator(Protocol):
    """Watches one flight and says how it went."""

    def watch(self, step: LoopStep) -> str:
        """Look at the world after a step; a word where the task is over, else empty."""

    def result(self) -> dict[str, Any]:
        """Numbers of the flight; `success` says whether it did what it should."""


class LandingEvaluator:
    """Touchdown on the pad: where, how far from the centre line and how gently."""

    def __init__(self, world: SimulatedWorld) -> None:
        self.world, self._path = world, list[Array]()

    def watch(self, step: LoopStep) -> str:
        """What was touched first, if anything."""
        self._path.append(self.world.state.p_world)
        return _contact_reason(self.world)

    def result(self) -> dict[str, Any]:
        """Success, and of wheels that touched: ald_m (on the pad only), place, sink rate, bank and
        the like.
        """
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
    """The lock in every frame, and the distance kept along the leader's path."""

    def __init__(
        self,
        world: SimulatedWorld,
        leader: LeaderPath,
        airframe: Airframe,
        camera: PinholeCamera,
        view: RenderedView | None = None,
    ) -> None:
        self.world, self.airframe, self.camera, self.view = world, airframe, camera, view
        self.leader, self.leader_path = leader, extended_path(leader)
        self._t: list[float] = []
        self._locked: list[bool] = []
        self._leader: list[State] = []
        self._follower: list[Array] = []

    def watch(self, step: LoopStep) -> str:
        """Look for the leader; what was touched first, if anything."""
        own, leader = self.world.state, self.leader.state(self.world.t)
        T_world_camera = camera_pose(own.pose.T_world_body, self.airframe.p_body_camera)
        depth = None if self.view is None else self.view.depth
        self._t.append(step.t)
        self._locked.append(is_locked(self.camera, T_world_camera, leader, self.airframe, depth))
        self._leader.append(leader)
        self._follower.append(own.p_world)
        return _contact_reason(self.world)

    def result(self) -> dict[str, Any]:
        """Success, share of frames locked, when the lock was first lost, and the errors until then."""
        locked = np.array(self._locked)
        n_locked = len(locked) if locked.all() else int(np.argmin(locked))
        leader, follower = (
            np.array([state.vector for state in self._leader]),
            np.array(self._follower),
        )
        return {
            "success": bool(locked.all()) and self.world.contact is None,
            "locked_share": float(locked.mean()),
            "lost_at_s": None if n_locked == len(locked) else self._t[n_locked],
            **tracking_errors(
                leader[:n_locked, 0:3],
                leader[:n_locked, 6:9],
                follower[:n_locked],
                self.leader_path,
            ),
            "path_m": _round_path(follower),
            "leader_path_m": _round_path(leader[:, 0:3]),
        }


def is_locked(
    camera: PinholeCamera,
    T_world_camera: Array,
    leader: State,
    airframe: Airframe,
    depth: Depth | None = None,
) -> bool:
    """Whether the camera has the leader: its centre inside the image, in front, and at least six of
    its pixels seen.

    Args:
        camera: the lens.
        T_world_camera: (4, 4) its pose.
        leader: where the leader is; its centre of gravity counts as its centre.
        airframe: how large it is.
        depth: (H, W) of the image with the leader in it [m]; None where nothing can hide it.

    Returns:
        True where the lock holds.
    """
    (uv,), (centre_depth,) = camera.project(leader.p_world[None], T_world_camera)
    inside = centre_depth > 0.0 and 0.0 <= uv[0] < camera.width and 0.0 <= uv[1] < camera.height
    return (
        bool(inside)
        and visible_pixels(camera, T_world_camera, leader, airframe, depth) >= LOCK_AREA_PX
    )


def visible_pixels(
    camera: PinholeCamera,
    T_world_camera: Array,
    leader: State,
    airframe: Airframe,
    depth: Depth | None = None,
) -> int:
    """How many pixels show the leader: centres inside the outline of nose, tail, wing tips and
    wheels.

    Args:
        camera: the lens.
        T_world_camera: (4, 4) its pose.
        leader: where the leader is.
        airframe: how large it is.
        depth: (H, W) of the image with the leader in it [m]; what is half a metre nearer than the
            leader hides it.

    Returns:
        The number; 0 where the outline is not wholly in front.
    """
    corners = leader.p_world + outline_body(airframe) @ leader.pose.T_world_body[:3, :3].T
    uv, corner_depth = camera.project(corners, T_world_camera)
    if not (corner_depth > 0.0).all():
        return 0
    size = np.array([camera.width, camera.height])
    low, high = np.clip([np.floor(uv.min(axis=0)), np.ceil(uv.max(axis=0))], 0, size).astype(int)
    centres = (
        np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), axis=-1) + 0.5
    )
    seen = is_in_hull(centres, uv)
    if depth is not None:
        depth_patch = depth[low[1] : high[1], low[0] : high[0]]
        seen &= (depth_patch <= 0.0) | (depth_patch > corner_depth.min() - OCCLUSION_MARGIN)
    return int(seen.sum())


def outline_body(airframe: Airframe) -> Array:
    """Nose, tail, wing tips and wheels (7, 3) in body axes [m]: the points by which it touches
    things, too.
    """
    return np.concatenate([airframe.corners_body, airframe.wheels.points_body])


def is_in_hull(points: Array, corners: Array) -> NDArray[np.bool_]:
    """Which points of the plane lie in the convex hull of some corners: in one of the triangles
    that they form.

    Args:
        points: (..., 2).
        corners: (m, 2), not all on one line.

    Returns:
        (...) True inside.
    """
    inside = np.zeros(points.shape[:-1], bool)
    for triangle in combinations(corners, 3):
        sides = [_signed_area(points, triangle[i], triangle[(i + 1) % 3]) for i in range(3)]
        turn = _signed_area(triangle[0], triangle[1], triangle[2])
        if turn != 0.0:
            inside |= np.logical_and.reduce([side * turn >= 0.0 for side in sides])
    return inside


def _signed_area(points: Array, a: Array, b: Array) -> Array:
    """Twice the signed area of the triangles (point, a, b)."""
    to_a, to_b = a - points, b - points
    return np.asarray(to_a[..., 0] * to_b[..., 1] - to_a[..., 1] * to_b[..., 0])


def extended_path(leader: LeaderPath) -> Array:
    """The leader's way as a chain of points (m, 3) [m], led back straight from where it begins, for
    who comes after.
    """
    leader_positions = np.array(
        [
            leader.state(t).p_world
            for t in np.arange(0.0, leader.duration + CONTROL_PERIOD, CONTROL_PERIOD)
        ]
    )
    first = leader.state(0.0)
    back = np.arange(-LEAD_IN, 0.0, 0.25)[:, None] * first.v_world / np.linalg.norm(first.v_world)
    return np.concatenate([first.p_world + back, leader_positions])


def tracking_errors(
    leader: Array, v_leader: Array, follower: Array, path: Array
) -> dict[str, float | None]:
    """ATE, ATE_d and ATE_path: how far the follower left the place that it had relative to the
    leader.

    ATE      = mean |D(t) - D(0)|, D = R_path_world (p_leader - p_follower), rows of R: ahead, left, up
    ATE_d    = mean |d(t) - d(0)|, d = |p_leader - p_follower|
    ATE_path = mean |C(t) - C(0)|, C = (along, left, up) of the leader minus that of the follower
    along the curved path

    Where a turn begins, a follower that keeps its distance on the same path has an ATE, for it is
    seen under another angle, and no ATE_path.

    Args:
        leader: (n, 3) positions in the frames that count [m].
        v_leader: (n, 3) its velocities [m/s], level speed above zero.
        follower: (n, 3) [m].
        path: (m, 3) the leader's way [m], longer than the distance between the two.

    Returns:
        ate_m, ate_d_m and ate_path_m [m]; None where no frame counts.
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
    """R_path_world (n, 3, 3) of directions (n, 3) of a path: rows are ahead, level left, and up."""
    ahead = along / np.linalg.norm(along, axis=1, keepdims=True)
    left = np.cross((0.0, 0.0, 1.0), ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([ahead, left, np.cross(ahead, left)], axis=1)


def path_coordinates(p_world: Array, path: Array, near: float | None = None) -> Array:
    """Where positions are relative to a path: the nearest point of the chain, sought near the last
    one.

    Args:
        p_world: (n, 3) one after the other [m].
        path: (m, 3) [m].
        near: about where along the path the first one is [m]; None looks everywhere.

    Returns:
        (n, 3): along the path from its first point, to the left of it and above it [m].
    """
    segments = np.diff(path, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    begins, axes = np.concatenate([[0.0], np.cumsum(lengths)])[:-1], path_axes(segments)
    found = np.empty((len(p_world), 3))
    for row, p in enumerate(np.asarray(p_world, np.float64)):
        along = np.clip(np.einsum("ij,ij->i", p - path[:-1], axes[:, 0]), 0.0, lengths)
        off = p - path[:-1] - along[:, None] * axes[:, 0]
        far = (
            np.zeros(len(segments))
            if near is None
            else np.where(np.abs(begins + along - near) > MAX_PATH_STEP, np.inf, 0.0)
        )
        i = int(np.argmin(np.einsum("ij,ij->i", off, off) + far))
        near = float(begins[i] + along[i])
        found[row] = near, *(axes[i, 1:] @ off[i])
    return found


def _contact_reason(world: SimulatedWorld) -> str:
    return f"touched {world.contact.obstacle}" if world.contact else ""


def _round_path(path: Sequence[Array] | Array) -> list[list[float]]:
    """A path for a record, to the millimetre."""
    return np.round(np.asarray(path, np.float64).reshape(-1, 3), 3).tolist()
