"""Hybrid state: a flight's video and commands -> a flight table with sigmas. Marker where it is seen, else network.

    images -> marker (both poses) or network -> implausible ones out -> one choice per frame that fits its neighbours
           -> smoother over the flight -> marker looked for again where the flight says it must be
           -> with a trained scene: every other frame refined against it, from the one before -> smoother again

The smoother takes the marker's four corners as they are, not a pose made of them: a far marker leaves its own turn
almost free, which a pose with a covariance says badly. Frames that no sight is near to get no pose.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import R_BODY_CAMERA, euler_from_rotation, pose_matrix
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.vision.horizontal_blur import through_link
from falconwing_kit.vision.line_jitter import corner_covariance, wander_px
from falconwing_kit.vision.marker import (
    Marker,
    MarkerPose,
    Pixels,
    corner_noise,
    find_marker,
    project_corners,
    seen_instead,
)
from falconwing_kit.vision.refine import track_scene
from falconwing_kit.vision.smoother import CornerSights, Motion, PoseSights, Sights, Smoothed, camera_at, smooth
from falconwing_kit.vision.viterbi import MOST_DOUBT, Candidate, among_neighbours, likeliest_path, well_known

LEAST_CORNER_SIGMA_PX = 0.1  # however well a few sights agree: the lens is not known better
ROOM_SIGMAS = 3.0  # a pose may be outside the room by so many of its own
REACH_S = 0.25  # the marker is looked for again so long before and after it was seen
REJECTED = {4: 23.5, 6: 27.9, 8: 31.8}  # chi2 of k coordinates that noise exceeds once in 10,000 times
WRONG_SHARE = 0.5  # of marker sights that are nowhere in the room: then the print's size or place is wrong

CornerNoise = Callable[[Array], Array]  # (M, 4, 2) [px] -> (M, 8, 8) [px^2]


class PoseEstimator(Protocol):
    """What gives a camera pose for one image: `PoseNet`, or anything alike."""

    def estimate(self, image: Pixels, camera: PinholeCamera) -> Any:
        """Return something with .T_world_camera (4, 4), .sigma_position [m], .sigma_attitude [rad]."""


@dataclass(frozen=True, eq=False)
class Video:
    """A recorded flight: frames, and the commands given on them."""

    name: str
    t: Array  # (N,) [s]
    commands: Array  # (N, 4) throttle, aileron, elevator, rudder
    image: Callable[[int], Pixels | None]  # frame 0..N-1 -> (H, W, 3) RGB; None where it was lost


@dataclass(frozen=True)
class HybridSettings:
    """What is plausible, and what is good enough to be written."""

    room_low: tuple[float, float, float] = (-22.5, -12.0, 0.0)  # the hall [m]
    room_high: tuple[float, float, float] = (17.5, 8.0, 5.0)
    longest_gap_s: float = 1.0  # the smoother bridges no longer one: an aircraft turns by half a circle in three
    most_sigma_position: float = 0.5  # [m]; a frame known worse gets no pose
    most_sigma_attitude: float = 0.2  # [rad]
    # Neighbouring frames look alike and mislead alike: over so long the errors of a source count as one.
    memory_s: Mapping[str, float] = field(default_factory=lambda: {"network": 1.0, "scene": 0.4})

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not all(low < high for low, high in zip(self.room_low, self.room_high, strict=True)):
            raise InputError(f"room: want low below high on every axis, got {self.room_low} and {self.room_high}")
        require_range("longest_gap_s", self.longest_gap_s, low=0.05, high=10.0)


@dataclass(frozen=True, eq=False)
class HybridFlight:
    """A flight read off its video."""

    table: FlightTable  # smoothed; nan where too little is known; label column `source`
    measured: FlightTable  # each frame's own pose, marker or network, not smoothed
    counts: Mapping[str, int]  # frames by what became of them, in words
    marker: Mapping[int, MarkerPose]  # sights by frame
    corner_sigma_px: float  # as measured on this flight; nan without sights
    pieces: tuple[tuple[int, Smoothed], ...] = field(default=())  # first frame and smoothed states of each stretch


def estimate_flight(
    video: Video,
    camera: PinholeCamera,
    network: PoseEstimator | None = None,
    *,
    marker: Marker | None = None,
    scene: GaussianScene | None = None,
    p_body_camera: Sequence[float] = (0.20, 0.0, 0.0),
    settings: HybridSettings | None = None,
    motion: Motion | None = None,
    progress: Callable[[], None] = lambda: None,
) -> HybridFlight:
    """Read the states of a flight off its video.

    Args:
        video: frames and commands.
        camera: intrinsics at the size of the frames.
        network: asked where the marker is not seen; None leaves such frames to the smoother, or without a pose.
        marker: what was printed and where it stands; None is the hall's.
        scene: as trained on photos of the room; poses are then followed through it from frame to frame.
        p_body_camera: where the camera sits [m].
        settings: what is plausible; None takes the hall.
        motion: how the aircraft moves, loosely.
        progress: called after each frame.

    Returns:
        The flight table, and what became of every frame.

    Raises:
        InputError: no frame gives a pose, or the marker's poses do not fit the room; the text says what was seen.
    """
    marker, settings = marker or Marker(), settings or HybridSettings()
    offset = require_shape("p_body_camera", p_body_camera, (3,))
    counts: Counter[str] = Counter()
    sights: dict[int, MarkerPose] = {}
    asked: dict[int, Candidate] = {}
    for frame in range(len(video.t)):
        image = video.image(frame)
        progress()
        if image is None:
            counts["no image"] += 1
            continue
        sight = find_marker(image, camera, marker)
        if sight is not None and _sees_from_room(sight, settings):
            sights[frame] = sight
        elif sight is not None:
            counts["marker: pose outside the room"] += 1
        if frame not in sights and network is not None:
            _ask(network, image, camera, frame, settings, asked, counts)
    outside = counts["marker: pose outside the room"]
    if outside > WRONG_SHARE * (len(sights) + outside):
        raise InputError(
            f"{video.name}: most poses from the marker lie outside the room; check the printed "
            f"size, now {marker.size:g} m, its place and the focal length"
        )
    if not sights and not asked:
        some = np.unique(np.linspace(0, len(video.t) - 1, 20).astype(int))
        raise InputError(f"{video.name}: {seen_instead([video.image(int(k)) for k in some], marker)}")
    again, smear_px = through_link(video.image, sights, camera, marker)
    sights = {k: sight for k, sight in again.items() if _sees_from_room(sight, settings)}
    counts.update("marker: pose outside the room" for k in again if k not in sights)
    estimate = _Estimate(video, camera, marker, offset, settings, motion or Motion(), asked, smear_px)
    return estimate.run(sights, counts, scene)


def _ask(
    network: PoseEstimator,
    image: Pixels,
    camera: PinholeCamera,
    frame: int,
    settings: HybridSettings,
    asked: dict[int, Candidate],
    counts: Counter[str],
) -> None:
    """Ask the network about a frame, and keep what it says if it can be true."""
    said = network.estimate(image, camera)
    T = np.asarray(said.T_world_camera, np.float64)
    sizes = np.array([said.sigma_position] * 3 + [said.sigma_attitude] * 3, np.float64)
    if not (np.isfinite(T).all() and np.isfinite(sizes).all() and (sizes > 0.0).all()):
        counts["network: no finite pose"] += 1
        return
    covariance = getattr(said, "covariance", None)
    full = np.diag(sizes**2) if covariance is None else np.asarray(covariance, np.float64)
    if _in_room(T[None], full[None], settings).any():
        asked[frame] = Candidate(T, full, 0.0, "network")
    else:
        counts["network: pose outside the room"] += 1


def _in_room(T_world_camera: Array, covariance: Array, settings: HybridSettings) -> Array:
    """(M,) whether cameras are inside the room, as far as their places are known, and not upside down."""
    p, down = T_world_camera[:, :3, 3], T_world_camera[:, 2, 1]  # the world's up along the camera's y axis
    margin = ROOM_SIGMAS * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :3])
    inside = (p > np.array(settings.room_low) - margin) & (p < np.array(settings.room_high) + margin)
    return np.asarray(inside.all(axis=1) & (down < 0.2))


def _sees_from_room(sight: MarkerPose, settings: HybridSettings) -> bool:
    """Whether one of a sight's two poses can be true."""
    return bool(_in_room(sight.T_world_camera, sight.covariance, settings).any())


@dataclass(frozen=True, eq=False)
class _Estimate:
    """What one flight's estimate needs throughout."""

    video: Video
    camera: PinholeCamera
    marker: Marker
    p_body_camera: Array
    settings: HybridSettings
    motion: Motion
    asked: Mapping[int, Candidate]
    smear_px: float  # of the link, along lines

    def run(self, sights: dict[int, MarkerPose], counts: Counter[str], scene: GaussianScene | None) -> HybridFlight:
        """Choose, smooth, look again, follow through the scene, smooth again."""
        chosen, pieces = self._flight(sights)
        tried: set[int] = set()
        for _ in range(10):  # each look reaches REACH_S further
            new = self._look_again(sights, pieces, tried)
            if not new:
                break
            counts["marker found where the flight said it must be"] += len(new)
            sights = dict(sorted({**sights, **new}.items()))
            chosen, pieces = self._flight(sights)
        if scene is not None:
            return replace(self, asked={**self.asked, **self._followed(scene, chosen, pieces)}).run(
                sights, counts, None
            )
        for frame in {*sights, *self.asked} - set(chosen):
            counts[f"{'marker' if frame in sights else self.asked[frame].source}: does not fit its neighbours"] += 1
        noise = self._corner_sigma(sights)
        return HybridFlight(
            self._table(chosen, pieces, counts), self._measured(chosen), dict(counts), sights, noise, tuple(pieces)
        )

    def _followed(
        self, scene: GaussianScene, chosen: Mapping[int, Candidate], pieces: Sequence[tuple[int, Smoothed]]
    ) -> dict[int, Candidate]:
        """Poses that the scene gives, from the smoothed ones at the marker on, and from the network's."""
        known: dict[int, Array] = {}
        for first, piece in pieces:
            T_world_camera = pose_matrix(*camera_at(piece.p_world, piece.attitude, self.p_body_camera))
            rows = [k for k, one in chosen.items() if one.source == "marker" and 0 <= k - first < len(T_world_camera)]
            known |= {k: T_world_camera[k - first] for k in rows}
        guesses = {k: one.T_world_camera for k, one in self.asked.items()}
        found = track_scene(self.video.image, self.video.t, scene, self.camera, known, guesses)
        return {k: Candidate(one.T_world_camera, one.covariance, 0.0, "scene") for k, one in found.items()}

    def _corner_sigma(self, sights: Mapping[int, MarkerPose]) -> float:
        return max(corner_noise(sights.values()), LEAST_CORNER_SIGMA_PX) if sights else float("nan")

    def _flight(self, sights: Mapping[int, MarkerPose]) -> tuple[dict[int, Candidate], list[tuple[int, Smoothed]]]:
        """One pose per frame, and the smoothed stretches between gaps that are too long."""
        sigma_px = self._corner_sigma(sights)
        options = {k: self._options(sight, sigma_px) for k, sight in sights.items()}
        options.update({k: [one] for k, one in self.asked.items() if k not in options})
        t = self.video.t
        chosen = among_neighbours(likeliest_path({k: options[k] for k in sorted(options)}, t), t)
        if not chosen:
            raise InputError(
                f"{self.video.name}: want a frame whose pose lies in the room and fits its neighbours, got "
                f"{len(options)} with one in the room and none that fits; check the print's size and the frames' times"
            )
        frames = np.array(list(chosen), int)
        cuts = np.flatnonzero(np.diff(t[frames]) > self.settings.longest_gap_s) + 1
        stretches = [part for part in np.split(frames, cuts) if part[-1] > part[0]]
        wander = wander_px(sight.strays_px for sight in sights.values())
        noise = partial(corner_covariance, sigma_px=sigma_px, wander=wander)
        return chosen, [(int(part[0]), self._smooth(part, chosen, sights, noise)) for part in stretches]

    def _options(self, sight: MarkerPose, sigma_px: float) -> list[Candidate]:
        """Both poses of a marker, as far as they are in the room."""
        misfit = 8.0 * (sight.reprojection_px / sigma_px) ** 2
        ok = _in_room(sight.T_world_camera, sight.covariance, self.settings)
        both = [
            Candidate(T, C, min(float(chi2), MOST_DOUBT), "marker")
            for T, C, chi2 in zip(sight.T_world_camera, sight.covariance, misfit - misfit[0], strict=True)
        ]
        return [one for one, good in zip(both, ok, strict=True) if good]

    def _smooth(
        self, frames: Array, chosen: Mapping[int, Candidate], sights: Mapping[int, MarkerPose], noise: CornerNoise
    ) -> Smoothed:
        """The likeliest flight through the sights of one stretch."""
        first, last = int(frames[0]), int(frames[-1])
        t = self.video.t[first : last + 1]
        known = well_known(frames, chosen, self.video.t, self.settings.longest_gap_s)
        poses = _body_poses(np.array([chosen[k].T_world_camera for k in known]), self.p_body_camera)
        start = np.stack([np.interp(t, self.video.t[known], column) for column in poses.T], axis=1)
        return smooth(t, start, self._kinds(frames, first, chosen, sights, noise), self.motion)

    def _kinds(
        self,
        frames: Array,
        first: int,
        chosen: Mapping[int, Candidate],
        sights: Mapping[int, MarkerPose],
        noise: CornerNoise,
    ) -> list[Sights]:
        seen = [k for k in frames if chosen[k].source == "marker"]
        said = [k for k in frames if chosen[k].source != "marker"]
        kinds: list[Sights] = []
        if seen:
            corners = np.array([sights[k].corners_px for k in seen])
            rows = np.array(seen) - first
            kinds.append(CornerSights(rows, corners, noise(corners), self.marker, self.camera, self.p_body_camera))
        if said:
            period = float(np.median(np.diff(self.video.t)))
            alike = [max(1.0, self.settings.memory_s[chosen[k].source] / period) for k in said]
            T, C = (np.array([getattr(chosen[k], name) for k in said]) for name in ("T_world_camera", "covariance"))
            C = C * np.array(alike)[:, None, None]
            kinds.append(PoseSights(np.array(said) - first, T, C, self.p_body_camera))
        return kinds

    def _look_again(
        self, sights: Mapping[int, MarkerPose], pieces: Sequence[tuple[int, Smoothed]], tried: set[int]
    ) -> dict[int, MarkerPose]:
        """Look for the marker in frames where the flight says it must be and the detector saw nothing."""
        found, look = {}, partial(find_marker, camera=self.camera, marker=self.marker, smear_px=self.smear_px)
        for first, piece in pieces:
            for frame, p_world, attitude in self._reached(first, piece):
                if frame in sights or frame in tried:
                    continue
                T_world_camera = pose_matrix(*camera_at(p_world[None], attitude[None], self.p_body_camera))
                near = project_corners(self.marker, self.camera, T_world_camera)[0]
                image = self.video.image(frame) if np.isfinite(near).all() else None
                sight = None if image is None else look(image, near_px=near)
                if sight is not None and _sees_from_room(sight, self.settings):
                    found[frame] = sight
                elif first <= frame < first + len(piece.p_world):
                    tried.add(frame)
        return found

    def _reached(self, first: int, piece: Smoothed) -> list[tuple[int, Array, Array]]:
        """Frames of a stretch and shortly before and after it: number, position, attitude."""
        t, last = self.video.t, first + len(piece.p_world) - 1
        reached = [(first + k, piece.p_world[k], piece.attitude[k]) for k in range(len(piece.p_world))]
        for end, row in ((first, 0), (last, -1)):
            rate = np.diff(piece.attitude, axis=0)[row] / (t[first + 1] - t[first])
            for frame in np.flatnonzero(np.abs(t - t[end]) < REACH_S):
                if not first <= frame <= last:
                    ahead = t[frame] - t[end]
                    place = piece.p_world[row] + ahead * piece.v_world[row]
                    reached.append((int(frame), place, piece.attitude[row] + ahead * rate))
        return reached

    def _table(
        self, chosen: Mapping[int, Candidate], pieces: Sequence[tuple[int, Smoothed]], counts: Counter[str]
    ) -> FlightTable:
        """The smoothed flight as a table, with what became of every frame."""
        rows = len(self.video.t)
        state, sigma, source = np.full((rows, 12), np.nan), np.full((rows, 2), np.nan), ["none"] * rows
        for first, piece in pieces:
            part = slice(first, first + len(piece.p_world))
            state[part] = np.concatenate([piece.p_world, piece.attitude, piece.v_world, piece.rates], axis=1)
            sigma[part] = np.stack([piece.sigma_position, piece.sigma_attitude], axis=1)
            source[part] = ["bridged"] * len(piece.p_world)
            kept, rejected = self._judged(chosen, first, piece)
            for frame in kept:
                source[frame] = chosen[frame].source
            for frame in rejected:
                counts[f"{chosen[frame].source}: does not fit the flight"] += 1
        poor = ~((sigma[:, 0] < self.settings.most_sigma_position) & (sigma[:, 1] < self.settings.most_sigma_attitude))
        state[poor] = np.nan
        counts.update("no pose" if bad else f"pose: {word}" for bad, word in zip(poor, source, strict=True))
        source = ["none" if bad else word for bad, word in zip(poor, source, strict=True)]
        extra = {name: state[:, 6 + j] for j, name in enumerate(("vx", "vy", "vz", "p", "q", "r"))}
        sigma[poor] = np.nan
        extra |= {"sigma_position": sigma[:, 0], "sigma_attitude": sigma[:, 1]}
        table = FlightTable(self.video.name, self.video.t, state[:, :3], state[:, 3:6], self.video.commands, extra)
        return replace(table, labels={"source": tuple(source)})

    def _judged(self, chosen: Mapping[int, Candidate], first: int, piece: Smoothed) -> tuple[list[int], list[int]]:
        """Frames of a stretch whose sight fits the flight, and those whose sight does not."""
        inside = [k for k in chosen if first <= k < first + len(piece.p_world)]
        by_kind = [[k for k in inside if (chosen[k].source == "marker") == seen] for seen in (True, False)]
        kept, rejected = list[int](), list[int]()
        for frames, chi2 in zip([frames for frames in by_kind if frames], piece.chi2, strict=True):
            limit = REJECTED[8 if chosen[frames[0]].source == "marker" else 6]
            for frame, value in zip(frames, chi2, strict=True):
                (rejected if value > limit else kept).append(frame)
        return kept, rejected

    def _measured(self, chosen: Mapping[int, Candidate]) -> FlightTable:
        """Each frame's own pose."""
        rows, frames = len(self.video.t), list(chosen)
        pose, sigma, source = np.full((rows, 6), np.nan), np.full((rows, 2), np.nan), ["none"] * rows
        pose[frames] = _body_poses(np.array([chosen[k].T_world_camera for k in frames]), self.p_body_camera)
        for k in frames:
            variance = np.diag(chosen[k].covariance)
            sigma[k] = np.sqrt(variance[:3].mean()), np.sqrt(variance[3:].mean())
            source[k] = chosen[k].source
        extra = {"sigma_position": sigma[:, 0], "sigma_attitude": sigma[:, 1]}
        table = FlightTable(self.video.name, self.video.t, pose[:, :3], pose[:, 3:], self.video.commands, extra)
        return replace(table, labels={"source": tuple(source)})


def _body_poses(T_world_camera: Array, p_body_camera: Array) -> Array:
    """(M, 6) position and unwrapped roll, pitch, yaw of the body from camera poses (M, 4, 4)."""
    T_world_body = T_world_camera @ np.linalg.inv(pose_matrix(R_BODY_CAMERA, p_body_camera))
    roll, pitch, yaw = euler_from_rotation(T_world_body[:, :3, :3])
    return np.column_stack([T_world_body[:, :3, 3], roll, pitch, np.unwrap(yaw)])
