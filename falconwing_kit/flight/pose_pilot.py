"""Pose pilot: images -> commands, by pose network, online filter and expert; no state is read.

    image -> pose and covariance (vision/pose_net.py) -> state now (vision/online_filter.py)
          -> command (control/expert.py)

The pilot is the landing expert with another observer: one that sees.
"""

from dataclasses import replace
from typing import Protocol

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import LandingExpert, landing_speed
from falconwing_kit.control.inverse import design_model
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.core.messages import SAFE_COMMAND, Command, Image, Observation, State
from falconwing_kit.flight.sources import decode_jpeg
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.images import Pixels
from falconwing_kit.vision.online_filter import (
    AircraftProcess,
    CameraPose,
    FilterSettings,
    OnlineFilter,
)

LOST_AFTER_S = 1.0  # without a fused pose: the position is by then uncertain by about a metre
# Distance outside the network's training at which a pose's covariance is doubled [m]. Measured on
# landings: half a metre above the floor its height is 0.05 m too large, at a quarter 0.15 m, in all
# images alike, so that no averaging removes it.
EXTRAPOLATION = 0.05
TIME_ROUNDING = 1e-6  # [s]
LANDED = "landed"


class PoseSource(Protocol):
    """Camera pose from one image: `PoseNet`, or anything with the same methods."""

    def estimate(self, image: Pixels, camera: PinholeCamera) -> CameraPose:
        """The pose and its covariance."""

    def extrapolation(self, p_world_camera: Array) -> float:
        """Distance [m] of a camera at (3,) [m] from the places that the source was made for."""


class CameraObserver:
    """Images and past commands -> state, predicted to now; `note` says what went into it."""

    def __init__(
        self, model: Model, speed: float, camera: PinholeCamera, p_body_camera: Array,
        net: PoseSource, delay: float = LINK_DELAY_S, settings: FilterSettings | None = None,
    ) -> None:  # fmt: skip
        """Wait for the first image.

        Args:
            model: that flies the prediction.
            speed: usual airspeed, of the filter's start [m/s].
            camera: the lens; images of another size are not used.
            p_body_camera: (3,) its position in body axes [m].
            net: images -> poses.
            delay: from a command to its arrival at the aircraft [s].
            settings: of the filter.
        """
        level = trim(design_model(model), speed)
        steady = State.from_vector(level.state)
        v_body = rotation_world_body(0.0, steady.pitch, steady.yaw).T @ steady.v_world
        self._camera, self._net = camera, net

        def make() -> tuple[AircraftProcess, OnlineFilter]:
            process = AircraftProcess(model, delay, level.command, speed)
            return process, OnlineFilter(process, v_body, p_body_camera, settings)

        self._make = make
        self._t = -np.inf  # time of the newest step [s]
        self._begin(0.0)

    def _begin(self, t: float) -> None:
        """Begin at t [s] without an estimate."""
        self._process, self._filter = self._make()
        self.note = "no image"  # why no pose was fused in this step; "" if one was
        self.state: State | None = None  # the newest estimate
        self.effectiveness = np.ones(4)  # of the controls, in shares of the model's
        self._fused_at = t  # time of the step that last fused a pose, or of the first [s]
        self._last: Image | None = None  # the newest image that was looked at

    def estimate(self, observation: Observation) -> State | None:
        """The state now, finite; None before the first pose and where it is lost.

        The past commands must be finite.
        """
        t = observation.t
        if not 0.0 <= t - self._t <= LOST_AFTER_S:  # the first step, or the clock was set
            self._begin(t)
        elif t > self._t:
            self._process.send(self._t, observation.past_commands[-1])
        self._t = t
        self.note = self._look(observation.image, t)
        if not self.note:
            self._fused_at = t
        estimate = self._filter.estimate(t)
        lost = self.is_lost or estimate is None
        self.state = None if lost or estimate is None else State.from_vector(estimate.x[:12])
        if estimate is not None:
            self.effectiveness[1:] = np.exp(estimate.x[12:15])
        return self.state

    @property
    def is_lost(self) -> bool:
        """Whether no pose was fused for a second, or since the start."""
        return self._t - self._fused_at > LOST_AFTER_S + TIME_ROUNDING

    def _look(self, image: Image | None, t: float) -> str:
        """Fuse the pose of an image; why not, or ""."""
        if image is None:
            return "no image"
        if self._last is not None and is_repeated(image, self._last):
            return "repeated image"
        if not np.isfinite(image.t) or image.t > t + TIME_ROUNDING:
            return "image of a wrong time"
        self._last = image
        if not isinstance(image.pixels, np.ndarray):
            return "image of another size or kind"
        try:
            pose = self._net.estimate(decode_jpeg(image), self._camera)
        except InputError:
            return "image of another size or kind"
        return self._filter.fuse(image.t, pose, self._inflation(t))

    def _inflation(self, t: float) -> float:
        """Factor of a pose's covariance by where the aircraft is, which the filter has to predict:
        the network's own pose lies inside its training.
        """
        predicted = self._filter.estimate(t)
        if predicted is None:
            return 1.0
        outside = self._net.extrapolation(predicted.x[:3])
        return 1.0 + (outside / EXTRAPOLATION) ** 2


class PosePilot:
    """Lands by the camera alone."""

    reads_state = False  # the loop of a trial gives it none

    def __init__(
        self, model: Model, airframe: Airframe, pad: LandingPad, camera: PinholeCamera,
        p_body_camera: Array, net: PoseSource, delay: float = LINK_DELAY_S,
        settings: FilterSettings | None = None,
    ) -> None:  # fmt: skip
        """Design the expert; InputError where the model cannot be landed in this hall.

        Arguments as of `LandingExpert` and `CameraObserver`.
        """
        speed = landing_speed(model)

        def make() -> tuple[CameraObserver, LandingExpert]:
            observer = CameraObserver(model, speed, camera, p_body_camera, net, delay, settings)
            return observer, LandingExpert(model, airframe, pad, speed, delay, observer)

        self._make = make
        self.reset()

    def reset(self) -> None:
        """Begin a new flight."""
        self._observer, self._expert = self._make()
        self.mode = "approach"

    @property
    def state(self) -> State | None:
        """The estimated state; None without one."""
        return self._observer.state

    @property
    def effectiveness(self) -> Array:
        """(4,) Estimated, of the aircraft's controls in shares of the model's."""
        return self._observer.effectiveness

    def act(self, observation: Observation) -> Command:
        """The expert's command on the estimate; the safe command where the aircraft is lost."""
        past_commands = finite_commands(observation.past_commands)
        observation = replace(observation, state=None, past_commands=past_commands)
        if self._expert.mode == LANDED:  # the expert no longer asks, but the log still does
            self._observer.estimate(observation)
        command = self._expert.act(observation)
        if self._expert.mode == LANDED:
            self.mode = LANDED
        elif self._observer.is_lost:
            self.mode = f"lost: {self._observer.note or 'no pose'}"
            return SAFE_COMMAND
        elif self._observer.note:
            self.mode = f"{self._expert.mode}, predicting: {self._observer.note}"
        else:
            self.mode = self._expert.mode
        return command


def is_repeated(image: Image, last: Image) -> bool:
    """Whether an image is the last one again, by its number, its time or its pixels."""
    return (
        image is last
        or image.sequence == last.sequence
        or image.t == last.t
        or np.array_equal(image.pixels, last.pixels)
    )


def finite_commands(past_commands: Array) -> Array:
    """Commands (n, 4) that were sent, rows that are not finite replaced by the safe command."""
    commands = np.array(past_commands, np.float64)
    commands[~np.isfinite(commands).all(axis=1)] = SAFE_COMMAND.vector
    return commands
