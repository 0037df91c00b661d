"""Trials: a frozen seed and a spread -> start and world of one flight; the interface of a task."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.leader import LeaderPath
from falconwing_kit.control.loops import SPEED
from falconwing_kit.core.checks import Array, require_range
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.core.messages import State
from falconwing_kit.flight.judges import FlightEvaluator
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera

# Frozen seeds of evaluation: trial k of `--seed s` has seed TRIAL_SEEDS * (s + 1) + k, for every
# pilot. Seeds below TRIAL_SEEDS are for training and tuning only.
TRIAL_SEEDS = 10_000


def trial_seed(number: int, seed: int = 0) -> int:
    """The frozen seed of a trial.

    Args:
        number: of the trial, from 0.
        seed: number of the list; results are compared on list 0.

    Raises:
        InputError: a number is not 0 to 9,999.
    """
    for name, value in (("trial", number), ("seed", seed)):
        require_range(name, value, low=0, high=TRIAL_SEEDS - 1)
    return TRIAL_SEEDS * (seed + 1) + number


@dataclass(frozen=True)
class Spread:
    """Half ranges of the uniform distribution of starts around the nominal one."""

    position: float  # along each axis [m]
    angle: float  # roll, pitch and yaw [rad]
    speed: float  # [m/s]

    def start(
        self, model: Model, p_world: ArrayLike, seed: int, yaw: float = 0.0, speed: float = SPEED
    ) -> State:
        """A random true state around a trimmed flight; the velocity turns with the nose.

        Args:
            model: the aircraft.
            p_world: (3,) nominal position [m].
            seed: of the trial.
            yaw: nominal [rad].
            speed: nominal [m/s].
        """
        steady = State.from_vector(trim(model, speed).state)
        return self.start_near(steady, p_world, seed, yaw, speed)

    def start_near(
        self, steady: State, p_world: ArrayLike, seed: int, yaw: float = 0.0, speed: float = SPEED
    ) -> State:
        """The same from the trimmed flight itself: many starts need the trim only once."""
        draw = np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, 7)
        roll, d_pitch, d_yaw = self.angle * draw[3:6]
        attitude = roll, steady.pitch + d_pitch, yaw + d_yaw
        position = np.asarray(p_world, np.float64) + self.position * draw[0:3]
        return _turned(steady, position, attitude, 1.0 + self.speed * draw[6] / speed)


def state_at_pose(
    model: Model, p_world: ArrayLike, attitude: ArrayLike, speed: float = SPEED
) -> State:
    """A true state at a pose: the velocity of a trimmed flight, turned with the nose.

    Args:
        model: the aircraft.
        p_world: (3,) [m].
        attitude: (3,) roll, pitch, yaw [rad].
        speed: [m/s].

    Raises:
        InputError: the aircraft cannot fly straight at this speed.
    """
    steady = State.from_vector(trim(model, speed).state)
    roll, pitch, yaw = map(float, np.asarray(attitude, np.float64))
    return _turned(steady, np.asarray(p_world, np.float64), (roll, pitch, yaw), 1.0)


def _turned(
    steady: State, p_world: Array, attitude: tuple[float, float, float], scale: float
) -> State:
    """The trim's velocity relative to its nose, turned to an attitude and scaled."""
    roll, pitch, yaw = attitude
    R_world_body = rotation_world_body(roll, pitch, yaw)
    R_steady = rotation_world_body(0.0, steady.pitch, 0.0)
    v_world = R_world_body @ R_steady.T @ steady.v_world * scale
    return State(p_world, pitch, yaw, roll, v_world)


@dataclass(frozen=True)
class TrialSetup:
    """The world of one trial, at its start."""

    seed: int
    world: SimulatedWorld
    leader: LeaderPath | None
    duration: float  # maximum [s]


class FlightTask(Protocol):
    """A task to fly and its evaluation."""

    @property
    def name(self) -> str:
        """The task's name, with its manoeuvre."""

    @property
    def airframe(self) -> Airframe:
        """Of the aircraft that flies."""

    @property
    def start(self) -> State | None:
        """Where every trial starts; None where starts are drawn."""

    def leader(self, seed: int) -> LeaderPath | None:
        """The leader of a seed, None for a task without one; part of a study's digest."""

    def trial(self, seed: int) -> TrialSetup:
        """The world of a seed; the same for every pilot."""

    def judge(
        self, trial: TrialSetup, camera: PinholeCamera, view: RenderedView | None = None
    ) -> FlightEvaluator:
        """The evaluator of a trial, in the images of a camera."""

    def expert(self, trial: TrialSetup, model: Model | None = None) -> Pilot:
        """The state-based pilot for it, designed on a model; None for the aircraft's own."""


@dataclass(frozen=True)
class TaskEntry:
    """A task on the command line; every file of `flight/tasks/` has one as `TASK`."""

    name: str  # as `fly --task` takes it
    summary: str  # as `fly --help` shows it
    make: Callable[..., FlightTask]  # called with the manoeuvre where there is a leader
    manoeuvre: str = ""  # default of the leader; empty for a task without one
