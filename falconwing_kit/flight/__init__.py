"""flight: pilots, the simulated world, image sources, the 20 Hz loop, its tasks and evaluators."""

from falconwing_kit.flight.loop import Loop, LoopResult, LoopStep, SimulatedClock, WallClock
from falconwing_kit.flight.pilots import load_pilot
from falconwing_kit.flight.sources import MeasuredStates, RecordedImages, RenderedView, fpv_camera
from falconwing_kit.flight.tasks import FollowTask, LandingTask
from falconwing_kit.flight.trial import Spread, trial_seed
from falconwing_kit.flight.world import Contact, PoseFilter, PoseNoise, SimulatedWorld

__all__ = [
    "Contact",
    "FollowTask",
    "LandingTask",
    "Loop",
    "LoopResult",
    "LoopStep",
    "MeasuredStates",
    "PoseFilter",
    "PoseNoise",
    "RecordedImages",
    "RenderedView",
    "SimulatedClock",
    "SimulatedWorld",
    "Spread",
    "WallClock",
    "fpv_camera",
    "load_pilot",
    "trial_seed",
]
