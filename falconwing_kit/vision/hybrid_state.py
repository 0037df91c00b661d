"""Hybrid state: a flight's video and commands -> a flight table with sigmas, by marker and network;
where the marker was missed, it is searched for again near the smoothed flight's prediction.

    detect   the marker in each frame (both poses), or the network's pose; implausible ones dropped
    choose   one pose per frame that fits its neighbours: Viterbi, then outliers dropped
    smooth   the most probable flight through the chosen poses, in segments without long gaps

After such a search the last two steps are repeated. With a trained scene all other frames are then
aligned with it, each from its neighbour, and the flight is smoothed again. The smoother uses the
marker's four corners directly: a far marker leaves the attitude almost undetermined, which a pose
with a covariance describes badly. Frames without a detection nearby get no pose.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import (
    HALL_HIGH,
    HALL_LOW,
    R_BODY_CAMERA,
    euler_from_rotation,
    pose_matrix,
)
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.vision.analog_lines import corner_covariance, redetect_blurred, sync_jitter_px
from falconwing_kit.vision.images import Pixels
from falconwing_kit.vision.marker import (
    Marker,
    MarkerPose,
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

MIN_CORNER_SIGMA_PX = 0.1  # the lens is not calibrated better, however well few detections agree
ROOM_SIGMAS = 3.0  # margin of the room, in a pose's own standard deviations
MAX_UP = 0.2  # of the image's downward axis along the world's up: not upside down
SEARCH_MARGIN_S = 0.25  # before and after a segment the marker is searched so long
MAX_SEARCHES = 10  # each reaches SEARCH_MARGIN_S further
SAMPLED_FRAMES = 20  # of a video without any detection, to name the markers that it shows
CHI2_GATES = {6: 27.9, 8: 31.8}  # chi2 of k coordinates, exceeded once in 10,000 times
MAX_OUTSIDE_SHARE = 0.5  # of detections outside the room; above, the print's size or pose is wrong


class PoseEstimator(Protocol):
    """Camera pose from one image: `PoseNet`, or anything with the same method."""

    def estimate(self, image: Pixels, camera: PinholeCamera) -> Any:
        """An object with .T_world_camera (4, 4), .sigma_position [m], .sigma_attitude [rad]."""


@dataclass(frozen=True, eq=False)
class Video:
    """A recorded flight: frames and the commands at their times."""

    name: str
    t: Array  # (N,) [s]
    commands: Array  # (N, 4) throttle, aileron, elevator, rudder
    image: Callable[[int], Pixels | None]  # frame 0..N-1 -> (H, W, 3) RGB; None where it was lost


@dataclass(frozen=True)
class HybridSettings:
    """Bounds of plausible poses, and the accuracy required of the table."""

    room_low: tuple[float, ...] = tuple(HALL_LOW.tolist())  # the hall [m]
    room_high: tuple[float, ...] = tuple(HALL_HIGH.tolist())
    max_gap_s: float = 1.0  # longer gaps are not bridged: half a circle takes three seconds
    max_sigma_position: float = 0.5  # [m]; above, a frame gets no pose
    max_sigma_attitude: float = 0.2  # [rad]
    # correlation time of a source's errors: similar frames have similar errors
    memory_s: Mapping[str, float] = field(default_factory=lambda: {"network": 1.0, "scene": 0.4})

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.room_low, self.room_high, strict=True)):
            raise InputError(
                "room: expected low below high on every axis, "
                f"got {self.room_low} and {self.room_high}; exchange the corners"
            )
        require_range("max_gap_s", self.max_gap_s, low=0.05, high=10.0)


@dataclass(frozen=True, eq=False)
class HybridFlight:
    """States of a flight estimated from its video."""

    table: FlightTable  # smoothed; nan where too inaccurate; label column `source`
    measured: FlightTable  # each frame's own pose, not smoothed
    counts: Mapping[str, int]  # frames by what became of them
    marker: Mapping[int, MarkerPose]  # detections by frame
    corner_sigma_px: float  # measured on this flight; nan without detections
    # first frame and smoothed states of each segment
    segments: tuple[tuple[int, SmoothedTrajectory], ...] = ()


@dataclass(frozen=True, eq=False)
class Track:
    """A flight's video with everything estimated from it so far; all mappings are by frame."""

    video: Video
    camera: PinholeCamera
    marker: Marker
    p_body_camera: Array
    settings: HybridSettings
    motion: Motion
    counts: Counter[str] = field(default_factory=Counter)
    detections: Mapping[int, MarkerPose] = field(default_factory=dict)
    horizontal_blur_px: float = 0.0  # of the video link
    pose_candidates: Mapping[int, PoseCandidate] = field(default_factory=dict)  # not the marker's
    chosen: Mapping[int, PoseCandidate] = field(default_factory=dict)
    segments: Sequence[tuple[int, SmoothedTrajectory]] = ()

    @property
    def corner_sigma_px(self) -> float:
        """Noise of a corner coordinate on this flight [px]; nan without detections."""
        if not self.detections:
            return float("nan")
        return max(corner_noise(self.detections.values()), MIN_CORNER_SIGMA_PX)


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
    """Estimate the states of a flight from its video.

    Args:
        video: frames and commands.
        camera: intrinsics at the size of the frames.
        network: for frames without a marker; None leaves them to the scene and the smoother.
        marker: what was printed and where it stands; None is the hall's.
        scene: trained on photos of the room; poses are tracked through it from frame to frame.
        p_body_camera: position of the camera in the body [m].
        settings: None takes the hall.
        motion: how the aircraft moves, loosely.
        progress: called after each frame.

    Returns:
        The flight table, and what became of every frame.

    Raises:
        InputError: no frame gives a pose, or the marker's poses do not fit the room; the text
            reports what was seen.
    """
    offset = require_shape("p_body_camera", p_body_camera, (3,))
    settings, motion = settings or HybridSettings(), motion or Motion()
    track = Track(video, camera, marker or Marker(), offset, settings, motion)
    track = detect(track, network, progress)
    track = _redetect_until_done(smooth_segments(choose(track)))
    if scene is not None:
        pose_candidates = {**track.pose_candidates, **_track_through_scene(track, scene)}
        track = smooth_segments(choose(replace(track, pose_candidates=pose_candidates)))
        track = _redetect_until_done(track)
    for frame in {*track.detections, *track.pose_candidates} - set(track.chosen):
        source = "marker" if frame in track.detections else track.pose_candidates[frame].source
        track.counts[f"{source}: does not fit its neighbours"] += 1
    return HybridFlight(
        _smoothed_table(track),
        _unsmoothed_table(track),
        dict(track.counts),
        dict(track.detections),
        track.corner_sigma_px,
        tuple(track.segments),
    )


def detect(track: Track, network: PoseEstimator | None, progress: Callable[[], None]) -> Track:
    """Detections of the marker, and the network's poses of the frames without one.

    Raises:
        InputError: nothing is detected, or most detections lie outside the room.
    """
    video, marker, counts = track.video, track.marker, track.counts
    detections: dict[int, MarkerPose] = {}
    pose_candidates: dict[int, PoseCandidate] = {}
    for frame in range(len(video.t)):
        image = video.image(frame)
        progress()
        if image is None:
            counts["no image"] += 1
            continue
        detection = find_marker(image, track.camera, marker)
        if detection is not None and _is_in_room(detection, track.settings):
            detections[frame] = detection
            continue
        if detection is not None:
            counts["marker: pose outside the room"] += 1
        if network is not None:
            estimated = network.estimate(image, track.camera)
            candidate, problem = _network_candidate(estimated, track.settings)
            if candidate is None:
                counts[problem] += 1
            else:
                pose_candidates[frame] = candidate
    outside = counts["marker: pose outside the room"]
    if outside > MAX_OUTSIDE_SHARE * (len(detections) + outside):
        raise InputError(
            f"{video.name}: expected poses from the marker in the room, got most of them outside; "
            f"check the printed size, now {marker.size:g} m, its place and the focal length"
        )
    if not detections and not pose_candidates:
        samples = np.unique(np.linspace(0, len(video.t) - 1, SAMPLED_FRAMES).astype(int))
        sentence = describe_other_markers([video.image(int(k)) for k in samples], marker)
        raise InputError(f"{video.name}: {sentence}")
    # an analog link blurs the lines: detect again with a print that is blurred in the same way
    again, horizontal_blur_px = redetect_blurred(video.image, detections, track.camera, marker)
    detections = {k: found for k, found in again.items() if _is_in_room(found, track.settings)}
    counts.update("marker: pose outside the room" for k in again if k not in detections)
    return replace(
        track,
        detections=detections,
        pose_candidates=pose_candidates,
        horizontal_blur_px=horizontal_blur_px,
    )


def choose(track: Track) -> Track:
    """One pose for each frame with candidates: two of the marker, else one of network or scene.

    Raises:
        InputError: no frame has a pose in the room that fits its neighbours.
    """
    t, sigma_px = track.video.t, track.corner_sigma_px
    options = {k: [candidate] for k, candidate in track.pose_candidates.items()}
    for k, detection in track.detections.items():
        options[k] = _marker_candidates(detection, sigma_px, track.settings)
    options = {k: options[k] for k in sorted(options)}
    chosen = reject_outliers(viterbi_path(options, t), t)
    if not chosen:
        raise InputError(
            f"{track.video.name}: expected a frame whose pose lies in the room and fits its "
            f"neighbours, got {len(options)} with one in the room and none that fits; "
            "check the print's size and the frames' times"
        )
    return replace(track, chosen=chosen)


def smooth_segments(track: Track) -> Track:
    """The smoothed flight through the chosen poses, cut at gaps longer than max_gap_s."""
    t, frames = track.video.t, np.array(list(track.chosen), int)
    cuts = np.flatnonzero(np.diff(t[frames]) > track.settings.max_gap_s) + 1
    sync_jitter = sync_jitter_px(found.line_jitter_px for found in track.detections.values())
    segments = []
    for part in np.split(frames, cuts):
        first, last = int(part[0]), int(part[-1])
        if first == last:
            continue
        # initial trajectory: chosen poses of well-known attitude, interpolated linearly
        initial = select_initial_frames(part, track.chosen, t, track.settings.max_gap_s)
        poses = _body_poses(track, initial)
        times = t[first : last + 1]
        start = np.stack([np.interp(times, t[initial], column) for column in poses.T], axis=1)
        measurements = _measurements(track, part, sync_jitter)
        segments.append((first, smooth(times, start, measurements, track.motion)))
    return replace(track, segments=segments)


def _network_candidate(
    estimated: Any, settings: HybridSettings
) -> tuple[PoseCandidate | None, str]:
    """The network's estimate as a candidate, or None and the reason against it."""
    T_world_camera = np.asarray(estimated.T_world_camera, np.float64)
    sigmas = np.array([estimated.sigma_position] * 3 + [estimated.sigma_attitude] * 3, np.float64)
    finite = np.isfinite(T_world_camera).all() and np.isfinite(sigmas).all()
    if not (finite and (sigmas > 0.0).all()):
        return None, "network: no finite pose"
    stated = getattr(estimated, "covariance", None)
    covariance = np.diag(sigmas**2) if stated is None else np.asarray(stated, np.float64)
    if not _in_room(T_world_camera[None], covariance[None], settings).any():
        return None, "network: pose outside the room"
    return PoseCandidate(T_world_camera, covariance, 0.0, "network"), ""


def _marker_candidates(
    detection: MarkerPose, sigma_px: float, settings: HybridSettings
) -> list[PoseCandidate]:
    """Those of the marker's two poses that are in the room; cost: chi2 above the better one's."""
    chi2 = 8.0 * (detection.reprojection_px / sigma_px) ** 2  # eight coordinates
    inside = _in_room(detection.T_world_camera, detection.covariance, settings)
    return [
        PoseCandidate(
            detection.T_world_camera[k],
            detection.covariance[k],
            min(float(chi2[k] - chi2[0]), COST_CAP),
            "marker",
        )
        for k in np.flatnonzero(inside)
    ]


def _in_room(T_world_camera: Array, covariance: Array, settings: HybridSettings) -> Array:
    """(M,) whether cameras are inside the room within ROOM_SIGMAS, and not upside down."""
    p_world, image_down_z = T_world_camera[:, :3, 3], T_world_camera[:, 2, 1]
    margin = ROOM_SIGMAS * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :3])
    above = p_world > np.array(settings.room_low) - margin
    below = p_world < np.array(settings.room_high) + margin
    return np.asarray((above & below).all(axis=1) & (image_down_z < MAX_UP))


def _is_in_room(detection: MarkerPose, settings: HybridSettings) -> bool:
    """Whether at least one of the detection's two poses is plausible."""
    return bool(_in_room(detection.T_world_camera, detection.covariance, settings).any())


def _measurements(track: Track, frames: Array, sync_jitter: float) -> list[Measurements]:
    """A segment's corners of the marker, and the poses of its other frames, for the smoother."""
    marked = [k for k in frames if track.chosen[k].source == "marker"]
    others = [k for k in frames if track.chosen[k].source != "marker"]
    measurements: list[Measurements] = []
    if marked:
        corners = np.array([track.detections[k].corners_px for k in marked])
        covariance = corner_covariance(corners, track.corner_sigma_px, sync_jitter)
        rows = np.array(marked) - frames[0]
        measurements.append(
            CornerMeasurements(
                rows, corners, covariance, track.marker, track.camera, track.p_body_camera
            )
        )
    if others:
        poses = [track.chosen[k] for k in others]
        # errors of memory_s / period frames count as one: the covariance is inflated by as much
        period = float(np.median(np.diff(track.video.t)))
        inflation = [max(1.0, track.settings.memory_s[pose.source] / period) for pose in poses]
        covariance = np.array([pose.covariance for pose in poses])
        measurements.append(
            PoseMeasurements(
                np.array(others) - frames[0],
                np.array([pose.T_world_camera for pose in poses]),
                covariance * np.array(inflation)[:, None, None],
                track.p_body_camera,
            )
        )
    return measurements


def _redetect_until_done(track: Track) -> Track:
    """The track after repeated searches for the marker near the predictions of its own flight."""
    tried: set[int] = set()
    for _ in range(MAX_SEARCHES):
        new = _redetect(track, tried)
        if not new:
            break
        track.counts["marker: found where the flight predicts it"] += len(new)
        detections = dict(sorted({**track.detections, **new}.items()))
        track = smooth_segments(choose(replace(track, detections=detections)))
    return track


def _redetect(track: Track, tried: set[int]) -> dict[int, MarkerPose]:
    """New detections near predicted corners; frames searched in vain are added to `tried`."""
    found = {}
    for first, segment in track.segments:
        for frame, p_world, attitude in _predicted_poses(track.video.t, first, segment):
            if frame in track.detections or frame in tried:
                continue
            is_extrapolated = not first <= frame < first + len(segment.p_world)
            T_world_camera = pose_matrix(
                *camera_at(p_world[None], attitude[None], track.p_body_camera)
            )
            near_px = project_corners(track.marker, track.camera, T_world_camera)[0]
            image = track.video.image(frame) if np.isfinite(near_px).all() else None
            detection = None
            if image is not None:
                detection = find_marker(
                    image, track.camera, track.marker, near_px, track.horizontal_blur_px
                )
            if detection is not None and _is_in_room(detection, track.settings):
                found[frame] = detection
            elif not is_extrapolated:  # a later, longer segment predicts those better
                tried.add(frame)  # searched in vain: not searched again
    return found


def _predicted_poses(
    t: Array, first: int, segment: SmoothedTrajectory
) -> list[tuple[int, Array, Array]]:
    """Frame, position, attitude in a segment, extrapolated by SEARCH_MARGIN_S at both ends."""
    last = first + len(segment.p_world) - 1
    rows = range(len(segment.p_world))
    poses = [(first + k, segment.p_world[k], segment.attitude[k]) for k in rows]
    for end, row in ((first, 0), (last, -1)):
        attitude_rate = np.diff(segment.attitude, axis=0)[row] / (t[first + 1] - t[first])
        for frame in np.flatnonzero(np.abs(t - t[end]) < SEARCH_MARGIN_S):
            if not first <= frame <= last:
                ahead = t[frame] - t[end]
                p_world = segment.p_world[row] + ahead * segment.v_world[row]
                poses.append((int(frame), p_world, segment.attitude[row] + ahead * attitude_rate))
    return poses


def _track_through_scene(track: Track, scene: GaussianScene) -> dict[int, PoseCandidate]:
    """Poses by the scene, tracked from the smoothed poses at the marker and from the network's."""
    marker_poses: dict[int, Array] = {}
    for first, segment in track.segments:
        cameras = camera_at(segment.p_world, segment.attitude, track.p_body_camera)
        for k, T_world_camera in enumerate(pose_matrix(*cameras), start=first):
            if k in track.chosen and track.chosen[k].source == "marker":
                marker_poses[k] = T_world_camera
    rough_poses = {k: pose.T_world_camera for k, pose in track.pose_candidates.items()}
    video = track.video
    found = track_scene(video.image, video.t, scene, track.camera, marker_poses, rough_poses)
    return {
        k: PoseCandidate(pose.T_world_camera, pose.covariance, 0.0, "scene")
        for k, pose in found.items()
    }


def _smoothed_table(track: Track) -> FlightTable:
    """The smoothed flight; frames of larger sigma than allowed have no pose. Counts every frame."""
    count = len(track.video.t)
    state, sigma = np.full((count, 12), np.nan), np.full((count, 2), np.nan)
    source = ["none"] * count
    for first, segment in track.segments:
        rows = slice(first, first + len(segment.p_world))
        state[rows] = np.concatenate(
            [segment.p_world, segment.attitude, segment.v_world, segment.rates], axis=1
        )
        sigma[rows] = np.stack([segment.sigma_position, segment.sigma_attitude], axis=1)
        source[rows] = ["bridged"] * len(segment.p_world)
        accepted, rejected = _gate_by_chi2(track.chosen, first, segment)
        for frame in accepted:
            source[frame] = track.chosen[frame].source
        for frame in rejected:
            track.counts[f"{track.chosen[frame].source}: does not fit the flight"] += 1
    settings = track.settings
    limits = (settings.max_sigma_position, settings.max_sigma_attitude)
    accurate = np.all(sigma < limits, axis=1)  # False where sigma is nan
    state[~accurate] = sigma[~accurate] = np.nan
    source = [origin if ok else "none" for ok, origin in zip(accurate, source, strict=True)]
    track.counts.update(
        f"pose: {origin}" if ok else "no pose" for ok, origin in zip(accurate, source, strict=True)
    )
    rates = {name: state[:, 6 + j] for j, name in enumerate(("vx", "vy", "vz", "p", "q", "r"))}
    return _table(track.video, state[:, :6], sigma, source, rates)


def _gate_by_chi2(
    chosen: Mapping[int, PoseCandidate], first: int, segment: SmoothedTrajectory
) -> tuple[list[int], list[int]]:
    """Frames of a segment whose measurement fits the flight, and those whose does not."""
    inside = [k for k in chosen if first <= k < first + len(segment.p_world)]
    marked = [k for k in inside if chosen[k].source == "marker"]
    others = [k for k in inside if chosen[k].source != "marker"]
    # in the order of `_measurements`: corners have 8 coordinates, poses 6
    kinds = [(frames, CHI2_GATES[k]) for frames, k in ((marked, 8), (others, 6)) if frames]
    accepted, rejected = list[int](), list[int]()
    for (frames, limit), chi2 in zip(kinds, segment.chi2, strict=True):
        for frame, value in zip(frames, chi2, strict=True):
            (rejected if value > limit else accepted).append(frame)
    return accepted, rejected


def _unsmoothed_table(track: Track) -> FlightTable:
    """Each frame's own pose."""
    count, frames = len(track.video.t), np.array(list(track.chosen), int)
    pose, sigma = np.full((count, 6), np.nan), np.full((count, 2), np.nan)
    source = ["none"] * count
    pose[frames] = _body_poses(track, frames)
    for k in frames:
        variance = np.diag(track.chosen[k].covariance)
        sigma[k] = np.sqrt(variance[:3].mean()), np.sqrt(variance[3:].mean())
        source[k] = track.chosen[k].source
    return _table(track.video, pose, sigma, source, {})


def _table(
    video: Video, pose: Array, sigma: Array, source: list[str], rates: dict[str, Array]
) -> FlightTable:
    """A flight table of poses (N, 6), their sigmas (N, 2) and sources."""
    extra = rates | {"sigma_position": sigma[:, 0], "sigma_attitude": sigma[:, 1]}
    table = FlightTable(video.name, video.t, pose[:, :3], pose[:, 3:], video.commands, extra)
    return replace(table, labels={"source": tuple(source)})


def _body_poses(track: Track, frames: Array) -> Array:
    """(M, 6) position and unwrapped roll, pitch, yaw of the body, from the chosen poses."""
    T_world_camera = np.array([track.chosen[k].T_world_camera for k in frames])
    T_body_camera = pose_matrix(R_BODY_CAMERA, track.p_body_camera)
    T_world_body = T_world_camera @ np.linalg.inv(T_body_camera)
    roll, pitch, yaw = euler_from_rotation(T_world_body[:, :3, :3])
    return np.column_stack([T_world_body[:, :3, 3], roll, pitch, np.unwrap(yaw)])
