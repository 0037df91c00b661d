"""Trials: a frozen seed and a spread -> the start and world of one flight; what makes a task, and
its table entry.
"""

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
from falconwing_kit.core.checks import require_range
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.core.messages import State
from falconwing_kit.flight.judges import FlightEvaluator
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera

# The frozen seeds of trials: number k of `--seed s` is TRIAL_SEEDS * (s + 1) + k, for every pilot
# the same. Seeds below TRIAL_SEEDS are for training and tuning and never judge.
TRIAL_SEEDS = 10_000


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

    def start(
        self, model: Model, p_world: ArrayLike, seed: int, yaw: float = 0.0, speed: float = SPEED
    ) -> State:
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
class TrialSetup:
    """The world of one trial, at its start."""

    seed: int
    world: SimulatedWorld
    leader: LeaderPath | None
    duration: float  # [s], at most


class FlightTask(Protocol):
    """What can be flown and judged."""

    @property
    def name(self) -> str:
        """In a word."""

    @property
    def airframe(self) -> Airframe:
        """Of the aircraft that flies."""

    def leader(self, seed: int) -> LeaderPath | None:
        """The leader of a seed; None for a task without one. A study's digest is taken of it."""

    def trial(self, seed: int) -> TrialSetup:
        """The world of a seed; the same for every pilot."""

    def judge(
        self, trial: TrialSetup, camera: PinholeCamera, view: RenderedView | None = None
    ) -> FlightEvaluator:
        """Who judges it, in the images of a camera."""

    def expert(self, trial: TrialSetup) -> Pilot:
        """The pilot that does it by state."""


@dataclass(frozen=True)
class TaskEntry:
    """What the command line needs to offer a task; a file of `flight/tasks/` has one as `TASK`."""

    name: str  # as `fly --task` takes it
    summary: str  # as `fly --help` shows it
    make: Callable[
        ..., FlightTask
    ]  # with the leader's manoeuvre where there is one, else with nothing
    manoeuvre: str = (
        ""  # what the leader flies where none is given; empty for a task without a leader
    )
