"""Landing: a trial's seed -> a world 20 m before the pad, its evaluator and expert."""

import math
from dataclasses import dataclass, field

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe, load_airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import LandingExpert, landing_speed
from falconwing_kit.core.checks import Array
from falconwing_kit.core.messages import State
from falconwing_kit.flight.judges import FlightEvaluator, LandingEvaluator
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.trial import Spread, TaskEntry, TrialSetup
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera

DISTANCE, HEIGHT = 20.0, 1.5  # of the start, before the pad and above the floor [m]
SPREAD = Spread(position=1.0, angle=math.radians(10.0), speed=1.0)  # of its start


@dataclass(frozen=True)
class LandingTask:
    """Land on the pad from about 20 m before it and 1.5 m up, as in the paper."""

    model: Model = field(default_factory=rates_model)
    airframe: Airframe = field(default_factory=load_airframe)
    pad: LandingPad = field(default_factory=LandingPad)
    spread: Spread = SPREAD
    duration: float = 12.0  # [s]
    # Every trial starts here; None draws the starts. Not in the repr, so a study's head states it.
    start: State | None = field(default=None, repr=False)
    name = "landing"

    def leader(self, seed: int) -> None:
        """None: there is no leader."""

    @property
    def nominal(self) -> Array:
        """(3,) where drawn starts lie about [m]."""
        return np.array([self.pad.x_start - DISTANCE, self.pad.y_centre, HEIGHT])

    def trial(self, seed: int) -> TrialSetup:
        """The world of a seed."""
        speed = landing_speed(self.model)
        start = self.start or self.spread.start(self.model, self.nominal, seed, speed=speed)
        world = SimulatedWorld(self.model, self.airframe, start, seed=seed, pad=self.pad)
        return TrialSetup(seed, world, None, self.duration)

    def judge(
        self, trial: TrialSetup, camera: PinholeCamera, view: RenderedView | None = None
    ) -> FlightEvaluator:
        """The evaluator of the touchdown, without the camera."""
        return LandingEvaluator(trial.world)

    def expert(self, trial: TrialSetup, model: Model | None = None) -> Pilot:
        """The state-based pilot that lands, designed on a model; None for the aircraft's own."""
        return LandingExpert(model or self.model, self.airframe, self.pad)


TASK = TaskEntry("landing", "land on the pad", LandingTask)
