"""flight: the simulated world, image sources, the 20 Hz loop, its tasks and their trials."""

from falconwing_kit.flight.judging.statistics import bootstrap_mean, clopper_pearson, mcnemar
from falconwing_kit.flight.loop import Flight, Loop, SimulatedClock, Step, WallClock
from falconwing_kit.flight.sources import MeasuredStates, RecordedImages, RenderedView, fpv_camera
from falconwing_kit.flight.tasks import FollowTask, LandingTask, trial_seed
from falconwing_kit.flight.trials import fly_trial, fly_trials, read_trials
from falconwing_kit.flight.world import Contact, PoseFilter, PoseNoise, SimulatedWorld

__all__ = [
    "Contact",
    "Flight",
    "FollowTask",
    "LandingTask",
    "Loop",
    "MeasuredStates",
    "PoseFilter",
    "PoseNoise",
    "RecordedImages",
    "RenderedView",
    "SimulatedClock",
    "SimulatedWorld",
    "Step",
    "WallClock",
    "bootstrap_mean",
    "clopper_pearson",
    "fly_trial",
    "fly_trials",
    "fpv_camera",
    "mcnemar",
    "read_trials",
    "trial_seed",
]
