"""Training on datasets from the command line: folders -> flights, and a policy cloned from them."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.learning.cloning import Joined, clone, command_error
from falconwing_kit.learning.flights import Fleet
from falconwing_kit.learning.imitation import LogFunction, evaluate
from falconwing_kit.learning.learner import Learner
from falconwing_kit.learning.policy_views import PolicyViews
from falconwing_kit.learning.situations import Ranges
from falconwing_kit.scene.camera import PinholeCamera

if TYPE_CHECKING:
    from falconwing_kit.tools.cli.train import Train

HELD_OUT = 10  # every tenth flight is not trained on
EVALUATED = 32  # most flights by the policy after each stage
LEAST_MIN = 0.01  # less time than this is none
EVALUATION_SEED = 8_000_000_000  # beyond those of training and collecting


def open_data(options: "Train", camera: PinholeCamera) -> Joined | None:
    """The flights of --data; None without.

    Raises:
        FileNotFoundError: a folder holds no dataset.
        InputError: a dataset is damaged, or of another task or camera.
    """
    if not options.data:
        return None
    from falconwing_kit.learning.datasets import Dataset  # needs the extra `datasets`

    parts = [Dataset(folder) for folder in options.data]
    for part in parts:
        record = part.record
        if record.task != options.task:
            raise InputError(
                f"--data {short_name(part.folder)}: expected flights of the task {options.task},"
                f" got {record.task}; take another dataset or --task {record.task}"
            )
        if (record.width, record.height) != (camera.width, camera.height):
            raise InputError(
                f"--data {short_name(part.folder)}: expected images of {camera.width}x"
                f"{camera.height}, got {record.width}x{record.height}; use --size"
                f" {record.width}x{record.height}"
            )
    flights = sum(len(part) for part in parts)
    if flights < 2:
        raise InputError(
            f"--data: expected at least 2 flights, one to be held out, got {flights}; collect more"
        )
    return Joined(parts)


def cloning_left(options: "Train", rounds: list[dict[str, float]]) -> tuple[float, int]:
    """Minutes or steps of training on --data that are left after the rounds before.

    By time it is all of --minutes, or half of it where the policy flies afterwards.
    """
    last = rounds[-1] if rounds else {"s": 0.0, "steps": 0.0}
    if not options.data:
        return 0.0, 0
    if options.steps:
        return 0.0, max(options.steps - int(last["steps"]), 0)
    minutes = (0.5 if options.rounds else 1.0) * options.minutes - last["s"] / 60.0
    return (minutes, 0) if minutes > LEAST_MIN else (0.0, 0)


def clone_stages(
    options: "Train", learners: Sequence[Learner], data: Joined, views: PolicyViews,
    fleets: list[Fleet], ranges: Ranges, left: tuple[float, int], log: LogFunction,
) -> None:  # fmt: skip
    """Train on datasets; after each stage the first policy flies, and the record says how."""
    begin, (minutes, steps) = time.perf_counter(), left
    held = list(range(HELD_OUT - 1, len(data), HELD_OUT)) or [len(data) - 1]
    kept = [k for k in range(len(data)) if k not in set(held)]
    flights = max(min(options.flights, EVALUATED), len(fleets))
    first = learners[0]
    losses = clone(learners, data.chosen(kept), ranges, minutes=minutes, steps=steps)
    for stage, means in enumerate(losses):
        error = command_error(first, data.chosen(held))
        outcomes = evaluate(
            first, views, fleets, options.task, ranges, seed=EVALUATION_SEED, flights=flights
        )
        log({
            "round": float(stage), "s": time.perf_counter() - begin, "flying_s": 0.0,
            "flights": float(len(kept)), "images": float(sum(len(data[k].sent) for k in kept)),
            "steps": float(first.trained.steps), **means, "mixing": 0.0, "held_out_error": error,
            "success": float(np.mean([bool(o.get("landed", o.get("success"))) for o in outcomes])),
        })  # fmt: skip
