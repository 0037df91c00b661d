"""Tasks: the `TASK` of every file of this folder -> the table of tasks.

To add one, add a file: a class with the interface `flight.trial.FlightTask`, and its `TASK`.
"""

from importlib import import_module
from pkgutil import iter_modules

from falconwing_kit.flight.tasks.follow import FollowTask
from falconwing_kit.flight.tasks.landing import LandingTask
from falconwing_kit.flight.trial import (
    TRIAL_SEEDS,
    FlightTask,
    Spread,
    TaskEntry,
    TrialSetup,
    trial_seed,
)

_ENTRIES: tuple[TaskEntry, ...] = tuple(
    import_module(f"{__name__}.{file.name}").TASK for file in iter_modules(__path__)
)
TASKS = {entry.name: entry for entry in _ENTRIES}

__all__ = [
    "TASKS",
    "TRIAL_SEEDS",
    "FlightTask",
    "FollowTask",
    "LandingTask",
    "Spread",
    "TaskEntry",
    "TrialSetup",
    "trial_seed",
]
