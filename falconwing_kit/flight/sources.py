"""Sources: a simulated world or a recorded log -> images and states for the loop, and the pilot
that a log holds.
"""

import math
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_log import FlightLog, read_flight_log
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import Command, Image, Observation, State
from falconwing_kit.flight.loop import CONTROL_PERIOD
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import render

# focal length of the FPV lens in image widths, as in the hall's flights: 78 deg from edge to edge
FOCAL_LENGTH_WIDTHS = 0.62
IMAGE_SIZE = (320, 240)  # of the FPV image [px]
TIME_ROUNDING = 1e-6  # s: what times may lose in a log


class WorldInterface(Protocol):
    """What a source needs of a simulated world."""

    @property
    def state(self) -> State:
        """The truth."""

    @property
    def leader_state(self) -> State | None:
        """Where the leader is."""

    def advance(self, t: float) -> None:
        """Fly on to time t [s]; nothing where it is there already."""

    def measured(self) -> State:
        """What an estimator would say."""


def fpv_camera(width: int = IMAGE_SIZE[0], height: int = IMAGE_SIZE[1]) -> PinholeCamera:
    """The lens on the aircraft's nose, looking along it.

    Args:
        width: of the image [px].
        height: of the image [px].

    Returns:
        A camera with square pixels and its principal point in the middle; the lens stays the same
        in every size.

    Raises:
        InputError: a side is not 1 to 16384.
    """
    return PinholeCamera.from_fov_deg(
        width, height, math.degrees(2.0 * math.atan(0.5 / FOCAL_LENGTH_WIDTHS))
    )


class MeasuredStates:
    """The states of a simulated world as an estimator would measure them."""

    def __init__(self, world: WorldInterface) -> None:
        self.world = world

    def state(self, t: float) -> State | None:
        """The measured state at time t [s]; the world is flown there first."""
        self.world.advance(t)
        return self.world.measured()


class RenderedView:
    """SIMULATED images from the aircraft's nose: a Gaussian scene, seen from where the world's
    aircraft really is.

    Args:
        world: the simulated world; where it has a leader, the leader is in the image.
        scene: the hall. Its Gaussians labelled "leader" are the leader's; a hall without gets the
            kit's leader.
        camera: the lens, `fpv_camera()` for the aircraft's.
        p_body_camera: (3,) where it sits on the aircraft, in body axes [m].
        backend: of `render`.
        link: the analog video link that every image goes through, `scene_link("hall_analog")`; both
            fields of a frame show the same moment. None for a direct view.
    """

    def __init__(
        self,
        world: WorldInterface,
        scene: GaussianScene,
        camera: PinholeCamera,
        p_body_camera: ArrayLike = (0.0, 0.0, 0.0),
        backend: str = "fast",
        link: AnalogVideo | None = None,
    ) -> None:
        self.world, self.camera, self.backend, self.link = world, camera, backend, link
        self.p_body_camera = np.asarray(p_body_camera, np.float64)
        self.depth: NDArray[np.float32] | None = (
            None  # (H, W) of the newest image [m], for judging what hides the leader
        )
        self._hall, self._leader = _hall_and_leader(scene, world.leader_state is not None)
        self._sequence = 0
        self.look()  # the first image compiles; that must not cost the first step

    def next(self, t: float) -> Image:
        """The view at time t [s]; the world is flown there first."""
        self.world.advance(t)
        self._sequence += 1
        return Image(self._sequence - 1, t, self.look())

    def look(self) -> NDArray[np.uint8]:
        """The view at this moment.

        Returns:
            (H, W, 3) uint8 RGB.
        """
        leader, scenes = self.world.leader_state, [self._hall]
        if leader is not None and self._leader is not None:
            from falconwing_kit.scene.arena import leader_at

            scenes.append(leader_at(self._leader, leader.pose.T_world_body))
        T_world_camera = camera_pose(self.world.state.pose.T_world_body, self.p_body_camera)
        frame = render(scenes, self.camera, T_world_camera, backend=self.backend)
        self.depth = frame.depth
        picture = np.asarray(255.0 * frame.rgb + 0.5, np.uint8)
        return picture if self.link is None else self.link.apply(picture, self._sequence)


def _hall_and_leader(
    scene: GaussianScene, with_leader: bool
) -> tuple[GaussianScene, GaussianScene | None]:
    """The hall without a leader, and the leader alone if it is wanted."""
    from falconwing_kit.scene.arena import leader_at, load_scene

    own = "leader" in scene.label_names
    hall = leader_at(scene, None) if own else scene
    if not with_leader:
        return hall, None
    return hall, scene.selected(scene.labelled("leader")) if own else load_scene("leader")


class RecordedImages:
    """The images of a flight log at the times they were taken since its start, read one by one."""

    def __init__(self, path: str | Path) -> None:
        """Open a log; FileNotFoundError or InputError where there is none or it is damaged at its
        beginning.
        """
        log = read_flight_log(path)
        start = log_start_time(log)
        self._images = (
            Image(image.sequence, image.t - start, image.pixels) for image in log.images()
        )
        self._newest: Image | None = None
        self._ahead = next(self._images, None)

    def next(self, t: float) -> Image | None:
        """The newest image, its pixels (H, W, 3) RGB; None before the first. Time runs forward
        only.

        Args:
            t: time since the log's start [s], as the image has it too.
        """
        while self._ahead is not None and self._ahead.t <= t + TIME_ROUNDING:
            self._newest, self._ahead = self._ahead, next(self._images, None)
        if self._newest is not None and self._newest.pixels.ndim == 1:
            self._newest = Image(self._newest.sequence, self._newest.t, decode_jpeg(self._newest))
        return self._newest


class RecordedStates:
    """The states of a flight log at the times they are valid for, since its start."""

    def __init__(self, path: str | Path) -> None:
        """Read a log; FileNotFoundError or InputError where there is none."""
        log = read_flight_log(path)
        self._times, self._states = log.state_times - log_start_time(log), log.states

    def state(self, t: float) -> State | None:
        """The newest state at time t [s] since the log's start; None before the first."""
        row = _newest_row(self._times, t)
        return self._states[row] if row >= 0 else None


class RecordedPilot:
    """The pilot of a flight log: gives its commands at the times they were given, since the log's
    start. What was simulated stays so.
    """

    mode = "replay"

    def __init__(self, path: str | Path) -> None:
        """Read a log; FileNotFoundError where there is none, InputError where it holds no commands."""
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
        """The command of this step, which was logged a little later when its pilot took time; else
        the newest.
        """
        return self._commands[
            max(_newest_row(self._times, observation.t + 0.5 * CONTROL_PERIOD), 0)
        ]


def log_start_time(log: FlightLog) -> float:
    """Time of a log's first image, state or command [s]; 0 where it has none. Few clocks start with
    the flight.
    """
    times = np.concatenate([log.image_times, log.state_times, log.command_times])
    return float(times.min()) if len(times) else 0.0


def decode_jpeg(image: Image) -> NDArray[np.uint8]:
    """The pixels of an image that holds its JPEG.

    Args:
        image: with pixels (n,) of JPEG bytes, or already (H, W, 3).

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InputError: the bytes are no image.
    """
    if image.pixels.ndim == 3:
        return image.pixels
    import cv2

    pixels = cv2.imdecode(image.pixels, cv2.IMREAD_COLOR)
    if pixels is None:
        raise InputError(
            f"image {image.sequence}: expected a JPEG, got {image.pixels.size} other bytes; the log is damaged"
        )
    return np.ascontiguousarray(pixels[..., ::-1])


def _newest_row(times: Array, t: float) -> int:
    """The row of the newest of increasing times that is not after t, -1 where there is none."""
    return int(np.searchsorted(times, t + TIME_ROUNDING, side="right")) - 1
