"""Hybrid state: drawn video of a simulated approach -> the states that were flown, sigmas that
cover, and refusals.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import camera_pose, pose_matrix, rotation_world_body, wrap_angle
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.scene.render import render
from falconwing_kit.vision.hybrid_state import HybridSettings, Video, estimate_flight
from falconwing_kit.vision.marker import Marker
from tests.vision.drawn_marker import CAMERA, pose, view
from tests.vision.jittered import jittered

COUNT = 36
P_BODY_CAMERA = np.array([0.2, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Approach:
    """1.8 s of a banked approach, by formula: 7.5 m/s from 15 m out and 4 m left of the marker,
    then a turn away.
    """

    t: np.ndarray
    p_world: np.ndarray
    attitude: np.ndarray
    images: list

    def video(self, images=None):
        """What `estimate_flight` takes."""
        images = self.images if images is None else images
        return Video("approach", self.t, np.zeros((len(self.t), 4)), lambda frame: images[frame])


def path():
    """The approach as times, positions, attitudes and camera poses."""
    t = 0.05 * np.arange(COUNT)
    yaw = 0.2 + 0.6 * np.maximum(t - 0.6, 0.0) ** 2  # turns to the right: y falls
    v_world = 7.5 * np.stack([np.cos(yaw), -np.sin(yaw), 0.04 * np.sin(2.0 * t)], axis=1)
    p_world = np.array([-14.0, 4.0, 1.6]) + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.05 * v_world[:-1], axis=0)]
    )
    roll = np.arctan(7.5 * np.gradient(yaw, t) / 9.8)  # the coordinated turn
    attitude = np.stack([roll, 0.04 + 0.0 * t, yaw], axis=1)
    return (
        t,
        p_world,
        attitude,
        camera_pose(pose_matrix(rotation_world_body(*attitude.T), p_world), P_BODY_CAMERA),
    )


@pytest.fixture(scope="module")
def approach():
    """The approach, drawn with some noise; the marker leaves the image in its last third."""
    t, p_world, attitude, T = path()
    rng = np.random.default_rng(8)
    return Approach(t, p_world, attitude, [view(pose, rng, noise=3.0) for pose in T])


@dataclass
class Network:
    """Stand-in for a pose network: the truth with noise, and outliers in some frames."""

    approach: Approach
    outliers: tuple = ()
    sigma: tuple = (0.3, 0.04)

    def estimate(self, image, camera):
        """The truth of the frame with this image, and noise."""
        frame = next(k for k, known in enumerate(self.approach.images) if known is image)
        rng = np.random.default_rng(100 + frame)
        body = pose_matrix(
            rotation_world_body(*self.approach.attitude[frame]), self.approach.p_world[frame]
        )
        T = camera_pose(body, P_BODY_CAMERA)
        T[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, self.sigma[1], 3)).as_matrix() @ T[:3, :3]
        T[:3, 3] += rng.normal(0.0, self.sigma[0], 3) + (frame in self.outliers) * np.array(
            [4.0, -5.0, 0.5]
        )
        return SimpleNamespace(
            T_world_camera=T, sigma_position=self.sigma[0], sigma_attitude=self.sigma[1]
        )


def errors(flight, approach):
    """(N, 3) position and (N, 3) attitude of the table minus the truth."""
    return flight.table.p_world - approach.p_world, wrap_angle(
        flight.table.attitude - approach.attitude
    )


def test_the_marker_alone_gives_the_flight_while_it_is_seen(approach):
    """The truth is the drawing's. Three of four of 95 % within two sigma: a sigma that is too small
    by half fails.
    """
    flight = estimate_flight(approach.video(), CAMERA)
    seen = flight.table.has_pose
    assert 10 <= seen.sum() < COUNT
    position, attitude = errors(flight, approach)
    sigma = [
        flight.table.extra[name][seen][:, None] for name in ("sigma_position", "sigma_attitude")
    ]
    assert (np.abs(position[seen]) < 2.0 * sigma[0]).mean() > 0.85
    assert (np.abs(attitude[seen]) < 2.0 * sigma[1]).mean() > 0.85
    assert np.median(np.linalg.norm(position[seen], axis=1)) < 0.3
    assert set(np.array(flight.table.labels["source"])[~seen]) == {"none"}
    assert flight.counts["pose: marker"] == sum(
        word == "marker" for word in flight.table.labels["source"]
    )


def test_line_jitter_gives_larger_sigmas_that_cover(approach):
    """The same frames with line jitter of 0.6 px. At 18 px a marker's top goes against its
    bottom by about 0.6 sqrt(2 - 2 exp(-18 / 24)) = 0.6 px, four times what its corners' noise makes
    of it: sigmas grow by half at least, and as many as without lie within two of them.
    """
    rng = np.random.default_rng(12)
    clean = estimate_flight(approach.video(), CAMERA)
    flight = estimate_flight(
        approach.video([jittered(image, 0.6, rng) for image in approach.images]), CAMERA
    )
    seen = flight.table.has_pose
    assert seen.sum() >= 10
    _, attitude = errors(flight, approach)
    sigma = flight.table.extra["sigma_attitude"][seen][:, None]
    assert (np.abs(attitude[seen]) < 2.0 * sigma).mean() > 0.85
    marked = np.array(clean.table.labels["source"]) == "marker"
    assert np.median(sigma) > 1.5 * np.median(clean.table.extra["sigma_attitude"][marked])


def test_the_side_is_right_though_the_mirrored_pose_fits_almost_as_well(approach):
    """The truth is left of the marker, y > 0 far away; the other solution mirrors it to y < 0."""
    flight = estimate_flight(approach.video(), CAMERA)
    far = flight.measured.has_pose & (approach.p_world[:, 0] < -8.0)
    assert far.sum() >= 3
    assert (flight.measured.p_world[far, 1] > 0.0).all()


def test_a_near_marker_gives_the_body_not_the_camera(approach):
    """Less than 6 m away a pose is good to centimetres; the camera is 20 cm ahead of the body."""
    flight = estimate_flight(approach.video(), CAMERA)
    near = flight.measured.has_pose & (approach.p_world[:, 0] > -6.0)
    assert near.sum() >= 3
    assert np.linalg.norm((flight.measured.p_world - approach.p_world)[near], axis=1).max() < 0.1


def test_a_room_without_the_true_side_leaves_the_mirrored_pose(approach):
    """The room ends at the marker's centre line: only the mirrored solution is left of it."""
    settings = HybridSettings(room_high=(17.5, 0.0, 5.0))
    flight = estimate_flight(approach.video(), CAMERA, settings=settings)
    far = flight.measured.has_pose & (approach.p_world[:, 0] < -9.0)
    assert far.any()
    assert (flight.measured.p_world[far, 1] < 0.0).all()


def test_the_network_fills_in_where_the_marker_is_not_seen(approach):
    """With it every frame has a pose; single ones are 0.3 m off per axis, the smoothed ones half of
    that at most.
    """
    flight = estimate_flight(approach.video(), CAMERA, Network(approach))
    source = np.array(flight.table.labels["source"])
    assert set(source) == {"marker", "network"} or set(source) == {"marker", "network", "bridged"}
    assert flight.table.has_pose.all()
    position, attitude = errors(flight, approach)
    assert np.sqrt(np.mean(position[source == "network"] ** 2)) < 0.2
    assert np.degrees(np.sqrt(np.mean(attitude**2))) < 2.5
    speed = np.linalg.norm([flight.table.extra[name] for name in ("vx", "vy", "vz")], axis=0)
    assert np.median(speed) == pytest.approx(7.5, abs=0.6)


def test_a_scene_carries_the_flight_on_from_the_marker():
    """The same approach through the arena, rendered; after a second the marker is out of view and
    there is no network. Simulated. A pose against the scene is good to some centimetres; ten are
    allowed.
    """
    arena = load_scene("arena")
    arena, rng = arena.selected(~arena.labelled("leader")), np.random.default_rng(9)
    t, p_world, attitude, T = path()
    frames = [
        np.clip(render(arena, CAMERA, pose).rgb + rng.normal(0.0, 0.01, (240, 320, 3)), 0.0, 1.0)
        for pose in T
    ]
    flown = Approach(t, p_world, attitude, [(255.0 * rgb).astype(np.uint8) for rgb in frames])
    flight = estimate_flight(flown.video(), CAMERA, scene=arena)
    source = np.array(flight.table.labels["source"])
    assert (source[-6:] == "scene").sum() >= 5
    assert (source == "marker").sum() >= 5
    position, attitude_error = errors(flight, flown)
    assert np.linalg.norm(position[source == "scene"], axis=1).max() < 0.1
    assert np.degrees(np.abs(attitude_error[source == "scene"])).max() < 1.5


def test_outliers_of_the_network_are_counted_and_rejected(approach):
    """Three of its poses are 6 m off: they neither reach the table nor move it by a metre."""
    flight = estimate_flight(approach.video(), CAMERA, Network(approach, outliers=(29, 31, 34)))
    position, _ = errors(flight, approach)
    seen = flight.table.has_pose
    assert seen.sum() >= COUNT - 3
    assert np.linalg.norm(position[seen], axis=1).max() < 1.0
    problem = "network: does not fit"
    assert sum(n for name, n in flight.counts.items() if name.startswith(problem)) == 3


def test_lost_frames_are_counted_and_bridged(approach):
    """Two frames among the marker's detections are lost: they keep a row and get a pose."""
    images = [None if k in (5, 6) else image for k, image in enumerate(approach.images)]
    flight = estimate_flight(approach.video(images), CAMERA)
    assert flight.counts["no image"] == 2
    assert [flight.table.labels["source"][k] for k in (5, 6)] == ["bridged", "bridged"]
    position, _ = errors(flight, approach)
    assert (np.abs(position[[5, 6]]) < 0.5).all()


def test_a_missing_id_is_reported_with_the_one_shown(approach):
    """The frames show id 7; expected is 3."""
    with pytest.raises(InputError, match="show DICT_4X4_50 7"):
        estimate_flight(approach.video(), CAMERA, marker=Marker(id=3))


def test_a_wrong_print_size_is_reported(approach):
    """Taken for three times its size the marker seems three times as far, 30 m and more: outside
    the hall.
    """
    with pytest.raises(InputError, match="check the printed"):
        estimate_flight(approach.video(), CAMERA, marker=Marker(size=2.4))


def blurred(xs):
    """A video that flies along x straight at the marker, blurred by 1.2 px along its lines as a
    link does.
    """
    Ts = [pose(x, 0.4 * (k % 3 - 1), 1.3, 0.0, -3.0, 3.0 * (k % 4)) for k, x in enumerate(xs)]
    drawn = [view(T, np.random.default_rng(k), blur_px=0.4) for k, T in enumerate(Ts)]
    images = [cv2.GaussianBlur(image, (0, 0), sigmaX=1.2, sigmaY=1e-3) for image in drawn]
    return Video("blurred", 0.05 * np.arange(len(xs)), np.zeros((len(xs), 4)), images.__getitem__)


X_BLURRED = -12.0 + 0.35 * np.arange(8)
BEHIND = HybridSettings(
    room_low=(-9.65, -12.0, 0.0)
)  # between both readings of the frame at -10.6 m, and 3 sigma


def test_a_detection_that_leaves_the_room_with_the_blur_is_counted():
    """A blurred marker is drawn wide and seems near; read again with the blur, the one at -10.6 m
    is 0.15 m further away and no longer in a room that ends there. Those nearer to the marker stay.
    """
    flight = estimate_flight(blurred(X_BLURRED), CAMERA, settings=BEHIND)
    assert flight.counts["marker: pose outside the room"] == 1
    assert len(flight.marker) >= 3
    assert 4 not in flight.marker


def test_no_detection_left_after_the_blur_is_refused():
    """Nothing but that frame, three times."""
    video = blurred(X_BLURRED)
    again = Video("blurred", video.t[:3], video.commands[:3], lambda frame: video.image(4))
    with pytest.raises(
        InputError, match=r"blurred: expected a frame whose pose lies in the room .* got 0 with"
    ):
        estimate_flight(again, CAMERA, settings=BEHIND)


def test_two_contradicting_detections_are_refused():
    """6 m and 12 m away 0.05 s apart: 120 m/s."""
    images = [view(pose(x, 0.0, 0.75), np.random.default_rng(0)) for x in (-6.0, -12.0)]
    video = Video("a leap", np.array([0.0, 0.05]), np.zeros((2, 4)), images.__getitem__)
    with pytest.raises(
        InputError, match=r"a leap: expected a frame .* got 2 with one .* none that fits; check"
    ):
        estimate_flight(video, CAMERA)


def test_no_marker_and_no_network_is_refused(approach):
    """Grey frames."""
    grey = [np.full((240, 320, 3), 128, np.uint8)] * COUNT
    with pytest.raises(InputError, match="check that it is in view"):
        estimate_flight(approach.video(grey), CAMERA)


def test_a_room_without_inside_is_refused():
    """Low above high."""
    with pytest.raises(InputError, match="room: expected low below high"):
        HybridSettings(room_low=(1.0, 0.0, 0.0), room_high=(0.0, 1.0, 1.0))
