"""Pilots: a name, a task and a camera -> the pilot that flies it; the one door to all of them.

from falconwing_kit.flight import load_pilot
pilot = load_pilot("pose", task="landing", scene="hall", camera=fpv_camera())
pilot.reset()
command = pilot.act(observation)          # and pilot.mode
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.aircraft.airframe import Airframe, load_airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import FollowExpert, LandingExpert
from falconwing_kit.control.leader import LeaderPath
from falconwing_kit.control.successive_loops import SuccessiveAutopilot
from falconwing_kit.core.checks import InputError, require_shape
from falconwing_kit.core.files import short_name
from falconwing_kit.core.messages import Command, Observation
from falconwing_kit.flight.image_pilot import ImagePilot
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.manual import ManualPilot
from falconwing_kit.flight.pose_pilot import PosePilot
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.policy import Policy
from falconwing_kit.vision.pose_net import PoseNet

P_BODY_CAMERA_M = (0.20, 0.0, 0.0)  # the camera of the hall's data: on the nose
SCENES = ("hall", "arena")
MAX_MOUNT = 2.0  # of a camera from the centre of gravity, along each axis [m]


class ReadyPilot(Protocol):
    """A pilot as `load_pilot` gives it."""

    @property
    def mode(self) -> str:
        """Phase of flight, and what is missing."""

    def reset(self) -> None:
        """Begin a new flight."""

    def act(self, observation: Observation) -> Command:
        """The command for this moment."""


@dataclass(frozen=True)
class PilotEntry:
    """A pilot of the table."""

    summary: str  # as `fly --help` shows it
    tasks: tuple[str, ...]  # that it flies
    reads_state: bool  # False: it flies by the camera alone
    scenes: tuple[str, ...] = SCENES  # that it was made for


PILOTS = {
    "expert": PilotEntry("by the state with noise, LQR loops", ("landing", "follow"), True),
    "expert_pid": PilotEntry(
        "by the state with noise, successive loop closure", ("landing",), True
    ),
    "pose": PilotEntry(
        "by the camera: pose network, filter, expert", ("landing",), False, ("hall",)
    ),
    "student": PilotEntry(
        "by the camera: one small network with a memory, trained by imitation",
        ("landing", "follow"),
        False,
        ("hall",),
    ),
    "rgb": PilotEntry(
        "by the camera: the same, named by what it sees, the image's colours",
        ("landing", "follow"),
        False,
        ("hall",),
    ),
    "mask": PilotEntry(
        "by the camera: such a network of a mask of the leader, which another network finds in the"
        " image",
        ("follow",),
        False,
        ("hall",),
    ),
    "rgb_mask": PilotEntry(
        "by the camera: such a network of colours and mask", ("follow",), False, ("hall",)
    ),
    "manual": PilotEntry("by hand, on the page of `falconwing class`", ("landing", "follow"), True),
}
BY_POLICY = ("student", "rgb", "mask", "rgb_mask")
# `student` and `rgb` are one network; the value is the name that its file has.
SAME_NETWORK = {("landing", "rgb"): "student", ("follow", "student"): "rgb"}
TASK_NAMES = ("landing", "follow")


class StatePilot:
    """An expert that can begin again: an expert has phases and integrals."""

    reads_state = True

    def __init__(self, make: Callable[[], Pilot]) -> None:
        self._make = make
        self.reset()

    def reset(self) -> None:
        """Begin a new flight."""
        self._expert = self._make()

    @property
    def mode(self) -> str:
        """The expert's phase of flight."""
        return str(getattr(self._expert, "mode", ""))

    def act(self, observation: Observation) -> Command:
        """The expert's command."""
        return self._expert.act(observation)


def load_pilot(
    name: str, task: str = "landing", scene: str = "hall", camera: PinholeCamera | None = None,
    p_body_camera_m: ArrayLike | None = None, *, model: Model | None = None,
    airframe: Airframe | None = None, pad: LandingPad | None = None,
    leader: LeaderPath | None = None, weights: str | Path | None = None,
) -> ReadyPilot:  # fmt: skip
    """The pilot of a name.

    Args:
        name: one of PILOTS.
        task: "landing" or "follow".
        scene: "hall" or "arena", in which it flies.
        camera: the lens, for a pilot that flies by images.
        p_body_camera_m: (3,) the camera in body axes [m]; None for (0.20, 0, 0).
        model: that it is designed on; None for the kit's aircraft.
        airframe: wheels and span; None for the kit's aircraft.
        pad: where to land; None for that of the hall.
        weights: of a policy, such as `falconwing train` writes; None for those that ship.
        leader: the path to follow, for a pilot that follows by the leader's state.

    Returns:
        `.reset()`, `.act(Observation) -> Command` and `.mode`. A pilot by images never reads the
        observation's state. "manual" gives the safe command until its `.sticks` are put.

    Raises:
        InputError: there is no such pilot, it cannot do this, or an argument is wrong.
    """
    require_pilot(name, task, scene)
    mount = P_BODY_CAMERA_M if p_body_camera_m is None else p_body_camera_m
    p_body_camera = require_shape("p_body_camera_m", mount, (3,))
    if not (np.abs(p_body_camera) <= MAX_MOUNT).all():
        raise InputError(
            f"p_body_camera_m: expected metres from the centre of gravity within {MAX_MOUNT:g},"
            f" got {p_body_camera.tolist()}; check the unit"
        )
    model, airframe, pad = model or rates_model(), airframe or load_airframe(), pad or LandingPad()
    if weights is not None and name not in BY_POLICY:
        raise InputError(
            f"weights: expected none for pilot {name}, got {short_name(weights)}; use student"
        )
    if name == "manual":
        return ManualPilot(model, airframe, pad)
    if name in BY_POLICY:
        shipped = SAME_NETWORK.get((task, name), name)
        policy = _policy(task, shipped) if weights is None else Policy.load(weights)
        if policy.record.task != task:
            raise InputError(
                f"weights: expected a policy for the task {task}, got one for"
                f" {policy.record.task}; take its own task"
            )
        if name != "student" and name != policy.shape.sees:
            raise InputError(
                f"weights: expected a policy that sees {name}, got one that sees"
                f" {policy.shape.sees}; fly it by that name, or as student"
            )
        return ImagePilot(policy, _require_camera(camera), p_body_camera)
    if task == "follow":
        if leader is None:
            raise InputError(
                f"leader: expected the path to follow for pilot {name}, got none; pass the trial's"
                " leader"
            )
        return StatePilot(partial(FollowExpert, model, airframe, leader))
    if name == "pose":
        net = _pose_net(scene)
        return PosePilot(model, airframe, pad, _checked_camera(net, camera), p_body_camera, net)
    make = partial(LandingExpert, model, airframe, pad)
    if name == "expert_pid":
        make = partial(make, autopilot=SuccessiveAutopilot)
    return StatePilot(make)


def require_pilot(name: str, task: str, scene: str) -> PilotEntry:
    """The entry of a pilot that flies a task in a scene; InputError for any other."""
    if name not in PILOTS:
        raise InputError(
            f"pilot: expected one of {', '.join(PILOTS)}, got {name}; use one of these"
        )
    entry = PILOTS[name]
    for what, value, known in (("task", task, TASK_NAMES), ("scene", scene, SCENES)):
        if value not in known:
            raise InputError(f"{what}: expected one of {', '.join(known)}, got {value!r}")
    if task not in entry.tasks:
        others = " or ".join(other for other, each in PILOTS.items() if task in each.tasks)
        raise InputError(
            f"pilot: expected one that flies the task {task}, got {name}, which does not yet; use"
            f" {others}"
        )
    if scene not in entry.scenes:
        raise InputError(
            f"scene: expected {' or '.join(entry.scenes)} for pilot {name}, got {scene}, in which"
            " its network was not trained; use another scene or another pilot"
        )
    return entry


@lru_cache(maxsize=4)
def _pose_net(scene: str) -> PoseNet:
    """The network of a scene, loaded once for all flights."""
    return PoseNet.load(scene)


@lru_cache(maxsize=4)
def _policy(task: str, name: str) -> Policy:
    """The policy of a task, loaded once for all flights."""
    return Policy.load(
        Path(str(files("falconwing_kit.data") / f"policy_{task}_{name}.safetensors"))
    )


def _checked_camera(net: PoseNet, camera: PinholeCamera | None) -> PinholeCamera:
    """The camera, if the network can use its images; the first estimate also warms up PyTorch."""
    camera = _require_camera(camera)
    net.estimate(np.zeros((camera.height, camera.width, 3), np.uint8), camera)
    return camera


def _require_camera(camera: PinholeCamera | None) -> PinholeCamera:
    """The camera; InputError for none."""
    if not isinstance(camera, PinholeCamera):
        raise InputError(
            f"camera: expected a PinholeCamera for a pilot that flies by images, got {camera!r};"
            " pass the aircraft's own, such as fpv_camera()"
        )
    return camera
