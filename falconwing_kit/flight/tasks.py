"""Tasks: landing and following -> a trial's world by its frozen seed, who judges it, and the expert that does it."""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.aircraft.airframe import Airframe, load_airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import FollowExpert, LandingExpert
from falconwing_kit.control.leader import MANOEUVRES, LeaderPath, leader_path
from falconwing_kit.control.loops import SPEED
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.core.messages import State
from falconwing_kit.flight.judges import FollowJudge, Judge, LandingJudge
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera

# The frozen seeds of trials: number k of `--seed s` is TRIAL_SEEDS * (s + 1) + k, for every pilot the same. Seeds below
# TRIAL_SEEDS are for training and tuning and never judge.
TRIAL_SEEDS = 10_000
OUT, HEIGHT = 20.0, 1.5  # m: where a landing begins, before the pad and above the floor
BEHIND = 4.0  # m: where a follower begins


def trial_seed(number: int, seed: int = 0) -> int:
    """The frozen seed of a trial.

    Args:
        number: of the trial, from 0.
        seed: which list, 0 for the one that results are compared on.

    Raises:
        InputError: a number is negative, or beyond the list of ten thousand.
    """
    for name, value in (("trial", number), ("seed", seed)):
        require_range(name, value, low=0, high=TRIAL_SEEDS - 1)
    return TRIAL_SEEDS * (seed + 1) + number


@dataclass(frozen=True)
class Spread:
    """How far starts differ from the nominal one, evenly between minus and plus."""

    position: float  # along each axis [m]
    angle: float  # roll, pitch and yaw [rad]
    speed: float  # [m/s]

    def start(self, model: Model, p_world: ArrayLike, seed: int, yaw: float = 0.0, speed: float = SPEED) -> State:
        """A start around a trimmed flight; the velocity turns with the nose.

        Args:
            model: the aircraft.
            p_world: (3,) nominal place [m].
            seed: of the trial.
            yaw: nominal [rad].
            speed: nominal [m/s].

        Returns:
            The true state at the start.
        """
        draw = np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, 7)
        steady = State.from_vector(trim(model, speed).state)
        roll, pitch, turned = self.angle * draw[3:6]
        R_world_body, R_steady = (
            rotation_world_body(*angles)
            for angles in ((roll, steady.pitch + pitch, yaw + turned), (0.0, steady.pitch, 0.0))
        )
        v_world = R_world_body @ R_steady.T @ steady.v_world * (1.0 + self.speed * draw[6] / speed)
        place = np.asarray(p_world, np.float64) + self.position * draw[0:3]
        return State(place, steady.pitch + pitch, yaw + turned, roll, v_world)


@dataclass(frozen=True)
class Trial:
    """The world of one trial, at its start."""

    seed: int
    world: SimulatedWorld
    leader: LeaderPath | None
    duration: float  # [s], at most


class Task(Protocol):
    """What can be flown and judged."""

    @property
    def name(self) -> str:
        """In a word."""

    @property
    def airframe(self) -> Airframe:
        """Of the aircraft that flies."""

    def trial(self, seed: int) -> Trial:
        """The world of a seed; the same for every pilot."""

    def judge(self, trial: Trial, camera: PinholeCamera, view: RenderedView | None = None) -> Judge:
        """Who judges it, in the images of a camera."""

    def expert(self, trial: Trial) -> Pilot:
        """The pilot that does it by state."""


@dataclass(frozen=True)
class LandingTask:
    """Land on the pad from about 20 m before it and 1.5 m up, as in the paper."""

    model: Model = field(default_factory=rates_model)
    airframe: Airframe = field(default_factory=load_airframe)
    pad: LandingPad = field(default_factory=LandingPad)
    spread: Spread = Spread(position=1.0, angle=math.radians(10.0), speed=1.0)
    duration: float = 12.0  # [s]
    name = "landing"

    def trial(self, seed: int) -> Trial:
        """The world of a seed."""
        nominal = np.array([self.pad.x_start - OUT, self.pad.y_centre, HEIGHT])
        start = self.spread.start(self.model, nominal, seed)
        world = SimulatedWorld(self.model, self.airframe, start, seed=seed, pad=self.pad)
        return Trial(seed, world, None, self.duration)

    def judge(self, trial: Trial, camera: PinholeCamera, view: RenderedView | None = None) -> Judge:
        """The judge of a landing; the camera does not matter to it."""
        return LandingJudge(trial.world)

    def expert(self, trial: Trial) -> Pilot:
        """The pilot that lands by state."""
        return LandingExpert(self.model, self.airframe, self.pad)


@dataclass(frozen=True)
class FollowTask:
    """Keep a leader in view through one manoeuvre, beginning about 4 m behind it."""

    manoeuvre: str
    model: Model = field(default_factory=rates_model)
    airframe: Airframe = field(default_factory=load_airframe)
    spread: Spread = Spread(position=0.5, angle=math.radians(5.0), speed=0.5)

    def __post_init__(self) -> None:
        if self.manoeuvre not in MANOEUVRES:
            raise InputError(f"manoeuvre: want one of {', '.join(MANOEUVRES)}, got {self.manoeuvre!r}")

    @property
    def name(self) -> str:
        """The task with its manoeuvre."""
        return f"follow {self.manoeuvre}"

    def trial(self, seed: int) -> Trial:
        """The world of a seed."""
        leader = leader_path(self.manoeuvre, seed=seed, model=self.model)
        first = leader.state(0.0)
        forward = first.v_world / np.linalg.norm(first.v_world)
        yaw = math.atan2(-forward[1], forward[0])
        start = self.spread.start(self.model, first.p_world - BEHIND * forward, seed, yaw)
        world = SimulatedWorld(self.model, self.airframe, start, seed=seed, leader=leader)
        return Trial(seed, world, leader, leader.duration)

    def judge(self, trial: Trial, camera: PinholeCamera, view: RenderedView | None = None) -> Judge:
        """The judge of a chase, in the images of a camera; a view also shows what hides the leader."""
        return FollowJudge(trial.world, _leader(trial), self.airframe, camera, view)

    def expert(self, trial: Trial) -> Pilot:
        """The pilot that follows by both states."""
        return FollowExpert(self.model, self.airframe, _leader(trial))


def _leader(trial: Trial) -> LeaderPath:
    if trial.leader is None:
        raise InputError("trial: want one with a leader to follow, got one without; make it by the task's own `trial`")
    return trial.leader
