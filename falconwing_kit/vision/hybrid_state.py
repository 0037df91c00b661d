"""Hybrid state: a flight's video and commands -> a flight table with sigmas. Marker where it is
seen, else network.

    images -> marker (both poses) or network -> implausible ones out -> one choice per frame that
    fits its neighbours
           -> smoother over the flight -> marker looked for again where the flight says it must be
           -> with a trained scene: every other frame refined against it, from the one before -> smoother again

The smoother takes the marker's four corners as they are, not a pose made of them: a far marker
leaves its own turn almost free, which a pose with a covariance says badly. Frames that no sight is
near to get no pose.
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
from falconwing_kit.vision.horizontal_blur import redetect_blurred
from falconwing_kit.vision.line_jitter import corner_covariance, sync_jitter_px
from falconwing_kit.vision.marker import (
    Marker,
    MarkerPose,
    Pixels,
    corner_noise,
    describe_other_markers,
    find_marker,
    project_corners,
)
from falconwing_kit.vision.refine import track_scene
from falconwing_kit.vision.smoother import (
    CornerMeasurements,
    Measurements,
    Motion,
    PoseMeasurements,
    SmoothedTrajectory,
    camera_at,
    smooth,
)
from falconwing_kit.vision.viterbi import (
    COST_CAP,
    PoseCandidate,
    reject_outliers,
    select_initial_frames,
    viterbi_path,
)

MIN_CORNER_SIGMA_PX = 0.1  # however well a few sights agree: the lens is not known better
ROOM_SIGMAS = 3.0  # a pose may be outside the room by so many of its own
SEARCH_MARGIN_S = 0.25  # the marker is looked for again so long before and after it was seen
CHI2_GATES = {
    4: 23.5,
    6: 27.9,
    8: 31.8,
}  # chi2 of k coordinates that noise exceeds once in 10,000 times
MAX_OUTSIDE_SHARE = (
    0.5  # of marker sights that are nowhere in the room: then the print's size or place is wrong
)

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
    max_gap_s: float = (
        1.0  # the smoother bridges no longer one: an aircraft turns by half a circle in three
    )
    max_sigma_position: float = 0.5  # [m]; a frame known worse gets no pose
    max_sigma_attitude: float = 0.2  # [rad]
    # Neighbouring frames look alike and mislead alike: over so long the errors of a source count as
    # one.
    memory_s: Mapping[str, float] = field(default_factory=lambda: {"network": 1.0, "scene": 0.4})

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not all(low < high for low, high in zip(self.room_low, self.room_high, strict=True)):
            raise InputError(
                f"room: expected low below high on every axis, got {self.room_low} and {self.room_high}"
            )
        require_range("max_gap_s", self.max_gap_s, low=0.05, high=10.0)


@dataclass(frozen=True, eq=False)
class HybridFlight:
    """A flight read off its video."""

    table: FlightTable  # smoothed; nan where too little is known; label column `source`
    measured: FlightTable  # each frame's own pose, marker or network, not smoothed
    counts: Mapping[str, int]  # frames by what became of them, in words
    marker: Mapping[int, MarkerPose]  # sights by frame
    corner_sigma_px: float  # as measured on this flight; nan without sights
    segments: tuple[tuple[int, SmoothedTrajectory], ...] = field(
        default=()
    )  # first frame and smoothed states of each stretch


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
        network: asked where the marker is not seen; None leaves such frames to the smoother, or
            without a pose.
        marker: what was printed and where it stands; None is the hall's.
        scene: as trained on photos of the room; poses are then followed through it from frame to
            frame.
        p_body_camera: where the camera sits [m].
        settings: what is plausible; None takes the hall.
        motion: how the aircraft moves, loosely.
        progress: called after each frame.

    Returns:
        The flight table, and what became of every frame.

    Raises:
        InputError: no frame gives a pose, or the marker's poses do not fit the room; the text says
            what was seen.
    """
    marker, settings = marker or Marker(), settings or HybridSettings()
    offset = require_shape("p_body_camera", p_body_camera, (3,))
    counts: Counter[str] = Counter()
    detections: dict[int, MarkerPose] = {}
    pose_candidates: dict[int, PoseCandidate] = {}
    for frame in range(len(video.t)):
        image = video.image(frame)
        progress()
        if image is None:
            counts["no image"] += 1
            continue
        detection = find_marker(image, camera, marker)
        if detection is not None and _is_in_room(detection, settings):
            detections[frame] = detection
        elif detection is not None:
            counts["marker: pose outside the room"] += 1
        if frame not in detections and network is not None:
            _query_network(network, image, camera, frame, settings, pose_candidates, counts)
    outside = counts["marker: pose outside the room"]
    if outside > MAX_OUTSIDE_SHARE * (len(detections) + outside):
        raise InputError(
            f"{video.name}: most poses from the marker lie outside the room; check the printed "
            f"size, now {marker.size:g} m, its place and the focal length"
        )
    if not detections and not pose_candidates:
        some = np.unique(np.linspace(0, len(video.t) - 1, 20).astype(int))
        raise InputError(
            f"{video.name}: {describe_other_markers([video.image(int(k)) for k in some], marker)}"
        )
    again, horizontal_blur_px = redetect_blurred(video.image, detections, camera, marker)
    detections = {
        k: detection for k, detection in again.items() if _is_in_room(detection, settings)
    }
    counts.update("marker: pose outside the room" for k in again if k not in detections)
    estimate = _FlightEstimator(
        video,
        camera,
        marker,
        offset,
        settings,
        motion or Motion(),
        pose_candidates,
        horizontal_blur_px,
    )
    return estimate.run(detections, counts, scene)


def _query_network(
    network: PoseEstimator,
    image: Pixels,
    camera: PinholeCamera,
    frame: int,
    settings: HybridSettings,
    pose_candidates: dict[int, PoseCandidate],
    counts: Counter[str],
) -> None:
    """Ask the network about a frame, and keep what it says if it can be true."""
    estimated = network.estimate(image, camera)
    T = np.asarray(estimated.T_world_camera, np.float64)
    sizes = np.array([estimated.sigma_position] * 3 + [estimated.sigma_attitude] * 3, np.float64)
    if not (np.isfinite(T).all() and np.isfinite(sizes).all() and (sizes > 0.0).all()):
        counts["network: no finite pose"] += 1
        return
    covariance = getattr(estimated, "covariance", None)
    full = np.diag(sizes**2) if covariance is None else np.asarray(covariance, np.float64)
    if _in_room(T[None], full[None], settings).any():
        pose_candidates[frame] = PoseCandidate(T, full, 0.0, "network")
    else:
        counts["network: pose outside the room"] += 1


def _in_room(T_world_camera: Array, covariance: Array, settings: HybridSettings) -> Array:
    """(M,) whether cameras are inside the room, as far as their places are known, and not upside
    down.
    """
    p, down = (
        T_world_camera[:, :3, 3],
        T_world_camera[:, 2, 1],
    )  # the world's up along the camera's y axis
    margin = ROOM_SIGMAS * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :3])
    inside = (p > np.array(settings.room_low) - margin) & (
        p < np.array(settings.room_high) + margin
    )
    return np.asarray(inside.all(axis=1) & (down < 0.2))


def _is_in_room(detection: MarkerPose, settings: HybridSettings) -> bool:
    """Whether one of a sight's two poses can be true."""
    return bool(_in_room(detection.T_world_camera, detection.covariance, settings).any())


@dataclass(frozen=True, eq=False)
class _FlightEstimator:
    """What one flight's estimate needs throughout."""

    video: Video
    camera: PinholeCamera
    marker: Marker
    p_body_camera: Array
    settings: HybridSettings
    motion: Motion
    pose_candidates: Mapping[int, PoseCandidate]
    horizontal_blur_px: float  # of the link, along lines

    def run(
        self, detections: dict[int, MarkerPose], counts: Counter[str], scene: GaussianScene | None
    ) -> HybridFlight:
        """Choose, smooth, look again, follow through the scene, smooth again."""
        chosen, segments = self._choose_and_smooth(detections)
        tried: set[int] = set()
        for _ in range(10):  # each look reaches REACH_S further
            new = self._redetect(detections, segments, tried)
            if not new:
                break
            counts["marker found where the flight said it must be"] += len(new)
            detections = dict(sorted({**detections, **new}.items()))
            chosen, segments = self._choose_and_smooth(detections)
        if scene is not None:
            return replace(
                self,
                pose_candidates={
                    **self.pose_candidates,
                    **self._track_through_scene(scene, chosen, segments),
                },
            ).run(detections, counts, None)
        for frame in {*detections, *self.pose_candidates} - set(chosen):
            counts[
                f"{'marker' if frame in detections else self.pose_candidates[frame].source}: does not fit its neighbours"
            ] += 1
        noise = self._corner_sigma(detections)
        return HybridFlight(
            self._table(chosen, segments, counts),
            self._unsmoothed_table(chosen),
            dict(counts),
            detections,
            noise,
            tuple(segments),
        )

    def _track_through_scene(
        self,
        scene: GaussianScene,
        chosen: Mapping[int, PoseCandidate],
        segments: Sequence[tuple[int, SmoothedTrajectory]],
    ) -> dict[int, PoseCandidate]:
        """Poses that the scene gives, from the smoothed ones at the marker on, and from the
        network's.
        """
        known: dict[int, Array] = {}
        for first, segment in segments:
            T_world_camera = pose_matrix(
                *camera_at(segment.p_world, segment.attitude, self.p_body_camera)
            )
            rows = [
                k
                for k, one in chosen.items()
                if one.source == "marker" and 0 <= k - first < len(T_world_camera)
            ]
            known |= {k: T_world_camera[k - first] for k in rows}
        guesses = {k: one.T_world_camera for k, one in self.pose_candidates.items()}
        found = track_scene(self.video.image, self.video.t, scene, self.camera, known, guesses)
        return {
            k: PoseCandidate(one.T_world_camera, one.covariance, 0.0, "scene")
            for k, one in found.items()
        }

    def _corner_sigma(self, detections: Mapping[int, MarkerPose]) -> float:
        return (
            max(corner_noise(detections.values()), MIN_CORNER_SIGMA_PX)
            if detections
            else float("nan")
        )

    def _choose_and_smooth(
        self, detections: Mapping[int, MarkerPose]
    ) -> tuple[dict[int, PoseCandidate], list[tuple[int, SmoothedTrajectory]]]:
        """One pose per frame, and the smoothed stretches between gaps that are too long."""
        sigma_px = self._corner_sigma(detections)
        options = {
            k: self._marker_candidates(detection, sigma_px) for k, detection in detections.items()
        }
        options.update({k: [one] for k, one in self.pose_candidates.items() if k not in options})
        t = self.video.t
        chosen = reject_outliers(viterbi_path({k: options[k] for k in sorted(options)}, t), t)
        if not chosen:
            raise InputError(
                f"{self.video.name}: expected a frame whose pose lies in the room and fits its neighbours, got "
                f"{len(options)} with one in the room and none that fits; check the print's size and the frames' times"
            )
        frames = np.array(list(chosen), int)
        cuts = np.flatnonzero(np.diff(t[frames]) > self.settings.max_gap_s) + 1
        segment_frames = [part for part in np.split(frames, cuts) if part[-1] > part[0]]
        sync_jitter = sync_jitter_px(detection.line_jitter_px for detection in detections.values())
        noise = partial(corner_covariance, sigma_px=sigma_px, sync_jitter=sync_jitter)
        return chosen, [
            (int(part[0]), self._smooth(part, chosen, detections, noise)) for part in segment_frames
        ]

    def _marker_candidates(self, detection: MarkerPose, sigma_px: float) -> list[PoseCandidate]:
        """Both poses of a marker, as far as they are in the room."""
        misfit = 8.0 * (detection.reprojection_px / sigma_px) ** 2
        ok = _in_room(detection.T_world_camera, detection.covariance, self.settings)
        both = [
            PoseCandidate(T, C, min(float(chi2), COST_CAP), "marker")
            for T, C, chi2 in zip(
                detection.T_world_camera, detection.covariance, misfit - misfit[0], strict=True
            )
        ]
        return [one for one, good in zip(both, ok, strict=True) if good]

    def _smooth(
        self,
        frames: Array,
        chosen: Mapping[int, PoseCandidate],
        detections: Mapping[int, MarkerPose],
        noise: CornerNoise,
    ) -> SmoothedTrajectory:
        """The likeliest flight through the sights of one stretch."""
        first, last = int(frames[0]), int(frames[-1])
        t = self.video.t[first : last + 1]
        known = select_initial_frames(frames, chosen, self.video.t, self.settings.max_gap_s)
        poses = _body_poses(np.array([chosen[k].T_world_camera for k in known]), self.p_body_camera)
        start = np.stack([np.interp(t, self.video.t[known], column) for column in poses.T], axis=1)
        return smooth(
            t, start, self._measurements(frames, first, chosen, detections, noise), self.motion
        )

    def _measurements(
        self,
        frames: Array,
        first: int,
        chosen: Mapping[int, PoseCandidate],
        detections: Mapping[int, MarkerPose],
        noise: CornerNoise,
    ) -> list[Measurements]:
        seen = [k for k in frames if chosen[k].source == "marker"]
        estimated = [k for k in frames if chosen[k].source != "marker"]
        measurements: list[Measurements] = []
        if seen:
            corners = np.array([detections[k].corners_px for k in seen])
            rows = np.array(seen) - first
            measurements.append(
                CornerMeasurements(
                    rows, corners, noise(corners), self.marker, self.camera, self.p_body_camera
                )
            )
        if estimated:
            period = float(np.median(np.diff(self.video.t)))
            alike = [max(1.0, self.settings.memory_s[chosen[k].source] / period) for k in estimated]
            T, C = (
                np.array([getattr(chosen[k], name) for k in estimated])
                for name in ("T_world_camera", "covariance")
            )
            C = C * np.array(alike)[:, None, None]
            measurements.append(
                PoseMeasurements(np.array(estimated) - first, T, C, self.p_body_camera)
            )
        return measurements

    def _redetect(
        self,
        detections: Mapping[int, MarkerPose],
        segments: Sequence[tuple[int, SmoothedTrajectory]],
        tried: set[int],
    ) -> dict[int, MarkerPose]:
        """Look for the marker in frames where the flight says it must be and the detector saw
        nothing.
        """
        found, detect = (
            {},
            partial(
                find_marker,
                camera=self.camera,
                marker=self.marker,
                horizontal_blur_px=self.horizontal_blur_px,
            ),
        )
        for first, segment in segments:
            for frame, p_world, attitude in self._search_poses(first, segment):
                if frame in detections or frame in tried:
                    continue
                T_world_camera = pose_matrix(
                    *camera_at(p_world[None], attitude[None], self.p_body_camera)
                )
                near = project_corners(self.marker, self.camera, T_world_camera)[0]
                image = self.video.image(frame) if np.isfinite(near).all() else None
                detection = None if image is None else detect(image, near_px=near)
                if detection is not None and _is_in_room(detection, self.settings):
                    found[frame] = detection
                elif first <= frame < first + len(segment.p_world):
                    tried.add(frame)
        return found

    def _search_poses(
        self, first: int, segment: SmoothedTrajectory
    ) -> list[tuple[int, Array, Array]]:
        """Frames of a stretch and shortly before and after it: number, position, attitude."""
        t, last = self.video.t, first + len(segment.p_world) - 1
        search_poses = [
            (first + k, segment.p_world[k], segment.attitude[k])
            for k in range(len(segment.p_world))
        ]
        for end, row in ((first, 0), (last, -1)):
            rate = np.diff(segment.attitude, axis=0)[row] / (t[first + 1] - t[first])
            for frame in np.flatnonzero(np.abs(t - t[end]) < SEARCH_MARGIN_S):
                if not first <= frame <= last:
                    ahead = t[frame] - t[end]
                    place = segment.p_world[row] + ahead * segment.v_world[row]
                    search_poses.append((int(frame), place, segment.attitude[row] + ahead * rate))
        return search_poses

    def _table(
        self,
        chosen: Mapping[int, PoseCandidate],
        segments: Sequence[tuple[int, SmoothedTrajectory]],
        counts: Counter[str],
    ) -> FlightTable:
        """The smoothed flight as a table, with what became of every frame."""
        rows = len(self.video.t)
        state, sigma, source = (
            np.full((rows, 12), np.nan),
            np.full((rows, 2), np.nan),
            ["none"] * rows,
        )
        for first, segment in segments:
            part = slice(first, first + len(segment.p_world))
            state[part] = np.concatenate(
                [segment.p_world, segment.attitude, segment.v_world, segment.rates], axis=1
            )
            sigma[part] = np.stack([segment.sigma_position, segment.sigma_attitude], axis=1)
            source[part] = ["bridged"] * len(segment.p_world)
            accepted, rejected = self._gate_by_chi2(chosen, first, segment)
            for frame in accepted:
                source[frame] = chosen[frame].source
            for frame in rejected:
                counts[f"{chosen[frame].source}: does not fit the flight"] += 1
        poor = ~(
            (sigma[:, 0] < self.settings.max_sigma_position)
            & (sigma[:, 1] < self.settings.max_sigma_attitude)
        )
        state[poor] = np.nan
        counts.update(
            "no pose" if bad else f"pose: {word}" for bad, word in zip(poor, source, strict=True)
        )
        source = ["none" if bad else word for bad, word in zip(poor, source, strict=True)]
        extra = {name: state[:, 6 + j] for j, name in enumerate(("vx", "vy", "vz", "p", "q", "r"))}
        sigma[poor] = np.nan
        extra |= {"sigma_position": sigma[:, 0], "sigma_attitude": sigma[:, 1]}
        table = FlightTable(
            self.video.name, self.video.t, state[:, :3], state[:, 3:6], self.video.commands, extra
        )
        return replace(table, labels={"source": tuple(source)})

    def _gate_by_chi2(
        self, chosen: Mapping[int, PoseCandidate], first: int, segment: SmoothedTrajectory
    ) -> tuple[list[int], list[int]]:
        """Frames of a stretch whose sight fits the flight, and those whose sight does not."""
        inside = [k for k in chosen if first <= k < first + len(segment.p_world)]
        by_kind = [
            [k for k in inside if (chosen[k].source == "marker") == seen] for seen in (True, False)
        ]
        accepted, rejected = list[int](), list[int]()
        for frames, chi2 in zip(
            [frames for frames in by_kind if frames], segment.chi2, strict=True
        ):
            limit = CHI2_GATES[8 if chosen[frames[0]].source == "marker" else 6]
            for frame, value in zip(frames, chi2, strict=True):
                (rejected if value > limit else accepted).append(frame)
        return accepted, rejected

    def _unsmoothed_table(self, chosen: Mapping[int, PoseCandidate]) -> FlightTable:
        """Each frame's own pose."""
        rows, frames = len(self.video.t), list(chosen)
        pose, sigma, source = (
            np.full((rows, 6), np.nan),
            np.full((rows, 2), np.nan),
            ["none"] * rows,
        )
        pose[frames] = _body_poses(
            np.array([chosen[k].T_world_camera for k in frames]), self.p_body_camera
        )
        for k in frames:
            variance = np.diag(chosen[k].covariance)
            sigma[k] = np.sqrt(variance[:3].mean()), np.sqrt(variance[3:].mean())
            source[k] = chosen[k].source
        extra = {"sigma_position": sigma[:, 0], "sigma_attitude": sigma[:, 1]}
        table = FlightTable(
            self.video.name, self.video.t, pose[:, :3], pose[:, 3:], self.video.commands, extra
        )
        return replace(table, labels={"source": tuple(source)})


def _body_poses(T_world_camera: Array, p_body_camera: Array) -> Array:
    """(M, 6) position and unwrapped roll, pitch, yaw of the body from camera poses (M, 4, 4)."""
    T_world_body = T_world_camera @ np.linalg.inv(pose_matrix(R_BODY_CAMERA, p_body_camera))
    roll, pitch, yaw = euler_from_rotation(T_world_body[:, :3, :3])
    return np.column_stack([T_world_body[:, :3, 3], roll, pitch, np.unwrap(yaw)])
