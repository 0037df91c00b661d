"""Sources: a simulated world or a flight log -> images and states for the loop; a log's pilot."""

import math
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_log import FlightLog, read_flight_log
from falconwing_kit.core.frames import camera_pose, pose_matrix
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, Image, Observation, State
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.masks import paint_grey
from falconwing_kit.scene.render import render
from falconwing_kit.vision.images import decode_image

FOCAL_LENGTH_WIDTHS = 0.62  # of the FPV lens, in image widths: 78 deg field of view
IMAGE_SIZE = (320, 240)  # of the FPV image [px]
NEAREST = 0.1  # of a leader whose image has edges [m]
CROP_MARGIN_PX = 4  # around its Gaussians' centres
FAINT = 0.02  # share of a pixel below which nothing is said of what hides it
ROUNDING_M = 0.01  # of a depth, at most
FINER = 4  # drawn pixels a side of one whose share is measured
TIME_ROUNDING = 1e-6  # largest rounding error of a time in a log [s]


class WorldInterface(Protocol):
    """Part of a simulated world that sources use."""

    @property
    def state(self) -> State:
        """The true state."""

    @property
    def leader_state(self) -> State | None:
        """The leader's true state."""

    def advance(self, t: float) -> None:
        """Fly until time t [s]."""

    def measured(self) -> State:
        """The measured state."""


def fpv_camera(width: int = IMAGE_SIZE[0], height: int = IMAGE_SIZE[1]) -> PinholeCamera:
    """The camera on the aircraft's nose, with the same field of view at every size [px].

    Raises:
        InputError: a side is not 1 to 16384.
    """
    return PinholeCamera.from_fov_deg(
        width, height, math.degrees(2.0 * math.atan(0.5 / FOCAL_LENGTH_WIDTHS))
    )


class MeasuredStates:
    """The measured states of a simulated world."""

    def __init__(self, world: WorldInterface) -> None:
        self.world = world

    def state_at(self, t: float) -> State | None:
        """The measured state at time t [s]; advances the world."""
        self.world.advance(t)
        return self.world.measured()


class RenderedView:
    """SIMULATED images of the nose camera: a Gaussian scene from the aircraft's true pose.

    Args:
        world: the simulated world; its leader, if any, is in the image.
        scene: the hall. Gaussians labelled "leader" are the leader's; else the kit's leader flies.
        camera: the lens, `fpv_camera()` for the aircraft's.
        p_body_camera: (3,) its position in body axes [m].
        backend: of `render`.
        link: the analog video link that every image goes through, `scene_link("hall_analog")`; both
            fields of a frame show the same moment. None for a direct view.
        R_body_mount: (3, 3) a mount that is off; None for a camera along the nose.
    """

    def __init__(
        self,
        world: WorldInterface,
        scene: GaussianScene,
        camera: PinholeCamera,
        p_body_camera: ArrayLike = (0.0, 0.0, 0.0),
        backend: str = "fast",
        link: AnalogVideo | None = None,
        R_body_mount: ArrayLike | None = None,
    ) -> None:
        self.world, self.camera, self.backend, self.link = world, camera, backend, link
        R = np.eye(3) if R_body_mount is None else np.asarray(R_body_mount, np.float64)
        self._T_body_mount = pose_matrix(R, np.asarray(p_body_camera, np.float64))
        self._hall, self._leader = _hall_and_leader(scene, world.leader_state is not None)
        self._black_and_white = None
        if self._leader is not None:
            self._black_and_white = paint_grey(self._hall, 0.0), paint_grey(self._leader, 1.0)
        self._sequence = 0
        self.look()  # compiles the renderer, so the first step does not have to wait

    def next_image(self, t: float) -> Image:
        """The image at time t [s]; advances the world."""
        self.world.advance(t)
        self._sequence += 1
        return Image(self._sequence - 1, t, self.look())

    @property
    def T_world_camera(self) -> Array:
        """(4, 4) where the camera is now."""
        return camera_pose(self.world.state.pose.T_world_body @ self._T_body_mount)

    def look(self) -> NDArray[np.uint8]:
        """Render the present view, (H, W, 3) uint8 RGB."""
        scenes = [self._hall] if self._leader is None else [self._hall, self._place(self._leader)]
        frame = render(scenes, self.camera, self.T_world_camera, backend=self.backend)
        pixels = np.asarray(255.0 * frame.rgb + 0.5, np.uint8)
        return pixels if self.link is None else self.link.apply(pixels, self._sequence)

    def leader_share(self) -> NDArray[np.float32]:
        """Share (h, w) of each pixel, 0..1, that shows the leader; all of size zero without one.

        The leader alone, drawn finer and averaged around its place, because in the image itself a
        Gaussian narrower than a pixel is widened; times what the hall lets through. Of the hall
        only what is nearer than the leader's farthest point is drawn, and that as the whole image
        is: a narrow part of it would project the hall's nearest Gaussians otherwise, for the
        projection is linearised only up to the edge of what is drawn.
        """
        nothing = np.zeros((0, 0), np.float32)
        if self._black_and_white is None:
            return nothing
        leader = self._place(self._black_and_white[1])
        camera, size = self.camera, np.array([self.camera.width, self.camera.height])
        low, high = np.zeros(2, int), size
        uv, depths = camera.project(leader.means, self.T_world_camera)
        if (depths > NEAREST).all():  # else some of it is beside or behind the camera
            low = np.clip(np.floor(uv.min(axis=0)) - CROP_MARGIN_PX, 0, size).astype(int)
            high = np.clip(np.ceil(uv.max(axis=0)) + CROP_MARGIN_PX, 0, size).astype(int)
        width, height = high - low
        if width == 0 or height == 0:
            return nothing
        fine = PinholeCamera(
            FINER * camera.fx, FINER * camera.fy, FINER * (camera.cx - low[0]),
            FINER * (camera.cy - low[1]), FINER * width, FINER * height,
        )  # fmt: skip
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        draw = partial(
            render, T_world_camera=self.T_world_camera, backend=self.backend, antialiased=True
        )
        blocks = draw(leader, fine).alpha.reshape(height, FINER, width, FINER).mean(axis=(1, 3))
        scenes = [*self._hall_before(float(depths.max())), leader]
        white, unhidden = draw(scenes, camera).rgb[part][..., 0], draw(leader, camera).alpha
        passes = np.clip(white / np.maximum(unhidden[part], FAINT), 0.0, 1.0)
        return np.asarray(blocks * passes, np.float32)

    def _hall_before(self, farthest: float) -> list[GaussianScene]:
        """The black hall's Gaussians that can hide what is no farther than a depth [m]."""
        assert self._black_and_white is not None
        hall, T = self._black_and_white[0], self.T_world_camera.astype(np.float32)
        depths = hall.means @ T[:3, 2] - T[:3, 3] @ T[:3, 2]
        before = (depths > 0.0) & (depths < farthest + ROUNDING_M)
        return [hall.selected(before)] if before.any() else []

    def _place(self, leader: GaussianScene) -> GaussianScene:
        """A leader in its body axes at its present pose."""
        from falconwing_kit.scene.arena import leader_at

        state = self.world.leader_state
        return leader if state is None else leader_at(leader, state.pose.T_world_body)


def _hall_and_leader(
    scene: GaussianScene, with_leader: bool
) -> tuple[GaussianScene, GaussianScene | None]:
    """The hall without a leader, and the leader alone if required."""
    from falconwing_kit.scene.arena import leader_at, load_scene

    has_leader = "leader" in scene.label_names
    hall = leader_at(scene, None) if has_leader else scene
    if not with_leader:
        return hall, None
    leader = scene.selected(scene.labelled("leader")) if has_leader else load_scene("leader")
    return hall, leader


class RecordedImages:
    """The images of a flight log at their times since its start, read one by one."""

    def __init__(self, path: str | Path) -> None:
        """Open a log; FileNotFoundError where there is none, InputError where it is damaged."""
        log = read_flight_log(path)
        start = log_start_time(log)
        self._images = (
            Image(image.sequence, image.t - start, image.pixels) for image in log.images()
        )
        self._newest: Image | None = None
        self._ahead = next(self._images, None)

    def next_image(self, t: float) -> Image | None:
        """The newest image (H, W, 3) at t [s] since the log's start; t must not decrease."""
        while self._ahead is not None and self._ahead.t <= t + TIME_ROUNDING:
            self._newest, self._ahead = self._ahead, next(self._images, None)
        if self._newest is not None and self._newest.pixels.ndim == 1:
            self._newest = Image(self._newest.sequence, self._newest.t, decode_jpeg(self._newest))
        return self._newest


class RecordedStates:
    """The states of a flight log at their times since its start."""

    def __init__(self, path: str | Path) -> None:
        """Read a log; FileNotFoundError or InputError where there is none."""
        log = read_flight_log(path)
        self._times, self._states = log.state_times - log_start_time(log), log.states

    def state_at(self, t: float) -> State | None:
        """The newest state at time t [s] since the log's start; None before the first."""
        row = _newest_row(self._times, t)
        return self._states[row] if row >= 0 else None


class RecordedLeader:
    """The leader's states in a flight log at their times since its start; None without one."""

    def __init__(self, path: str | Path) -> None:
        """Read a log; FileNotFoundError or InputError where there is none."""
        log = read_flight_log(path)
        self._times, self._states = log.leader_times - log_start_time(log), log.leaders

    def state_at(self, t: float) -> State | None:
        """The leader's newest state at time t [s] since the log's start."""
        row = _newest_row(self._times, t)
        return self._states[row] if row >= 0 else None


class RecordedPilot:
    """The commands of a flight log at their times since its start."""

    mode = "replay"

    def __init__(self, path: str | Path) -> None:
        """Read a log; FileNotFoundError: there is none, InputError: it has no commands."""
        log = read_flight_log(path)
        if not log.commands:
            raise InputError(
                f"{short_name(path)}: expected a log with commands to replay, got none"
            )
        self._times, self._commands = log.command_times - log_start_time(log), log.commands

    @property
    def duration(self) -> float:
        """From the log's start to its last command [s]."""
        return float(self._times[-1])

    def act(self, observation: Observation) -> Command:
        """The command of this step, or the newest one before it."""
        # A command is logged after its pilot's run time, so up to half a period late.
        row = _newest_row(self._times, observation.t + 0.5 * CONTROL_PERIOD_S)
        return self._commands[max(row, 0)]


def log_start_time(log: FlightLog) -> float:
    """Time of a log's first image, state or command [s]; 0 where it has none."""
    times = np.concatenate([log.image_times, log.state_times, log.command_times])
    return float(times.min()) if len(times) else 0.0


def decode_jpeg(image: Image) -> NDArray[np.uint8]:
    """The pixels (H, W, 3) uint8 RGB of an image that may hold JPEG bytes.

    Raises:
        InputError: the bytes are no image, or one of too many pixels.
    """
    if image.pixels.ndim != 1:
        return image.pixels
    pixels = decode_image(image.pixels.tobytes())
    if pixels is None:
        raise InputError(
            f"image {image.sequence}: expected a JPEG, got {image.pixels.size} other bytes; the log"
            " is damaged"
        )
    return pixels


def _newest_row(times: Array, t: float) -> int:
    """Row of the last of increasing times that is not after t; -1 where there is none."""
    return int(np.searchsorted(times, t + TIME_ROUNDING, side="right")) - 1
