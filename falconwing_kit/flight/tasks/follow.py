"""Following: a manoeuvre and a seed -> a world 4 m behind the leader, its evaluator and expert."""

import math
from dataclasses import dataclass, field

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe, load_airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.control.expert import FollowExpert
from falconwing_kit.control.leader import LeaderPath, leader_path
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import State
from falconwing_kit.flight.judges import FlightEvaluator, FollowEvaluator
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.trial import Spread, TaskEntry, TrialSetup
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera

BEHIND = 4.0  # distance of the start behind the leader [m]
SPREAD = Spread(position=0.5, angle=math.radians(5.0), speed=0.5)  # of its start


@dataclass(frozen=True)
class FollowTask:
    """Keep a leader in view through one manoeuvre, from about 4 m behind it."""

    manoeuvre: str
    model: Model = field(default_factory=rates_model)
    airframe: Airframe = field(default_factory=load_airframe)
    spread: Spread = SPREAD
    # Every trial starts here; None draws the starts. Not in the repr, so a study's head states it.
    start: State | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.manoeuvre not in MANOEUVRES:
            raise InputError(
                f"manoeuvre: expected one of {', '.join(MANOEUVRES)}, got {self.manoeuvre!r}"
            )

    @property
    def name(self) -> str:
        """Task and manoeuvre."""
        return f"follow {self.manoeuvre}"

    def leader(self, seed: int) -> LeaderPath:
        """The path to follow."""
        return leader_path(self.manoeuvre, seed=seed, model=self.model)

    def trial(self, seed: int) -> TrialSetup:
        """The world of a seed."""
        leader = self.leader(seed)
        first = leader.state_at(0.0)
        forward = first.v_world / np.linalg.norm(first.v_world)
        yaw = math.atan2(-forward[1], forward[0])
        behind = first.p_world - BEHIND * forward
        start = self.start or self.spread.start(self.model, behind, seed, yaw)
        world = SimulatedWorld(self.model, self.airframe, start, seed=seed, leader=leader)
        return TrialSetup(seed, world, leader, leader.duration)

    def judge(
        self, trial: TrialSetup, camera: PinholeCamera, view: RenderedView | None = None
    ) -> FlightEvaluator:
        """The evaluator in the images of a camera; with a view it also finds occlusions."""
        return FollowEvaluator(trial.world, _leader(trial), self.airframe, camera, view)

    def expert(self, trial: TrialSetup, model: Model | None = None) -> Pilot:
        """The pilot that follows by its own and the leader's state, designed on a model.

        None for the aircraft's own; the leader flies that in any case.
        """
        return FollowExpert(model or self.model, self.airframe, _leader(trial))


def _leader(trial: TrialSetup) -> LeaderPath:
    if trial.leader is None:
        raise InputError(
            "trial: expected one with a leader to follow, got one without; make it by the task's"
            " own `trial`"
        )
    return trial.leader


TASK = TaskEntry("follow", "keep a leader in view", FollowTask, manoeuvre="left_turn_s_descent")
