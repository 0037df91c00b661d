"""Training of policies from the command line: options -> weights, record and learning curve."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.learning.flights import PAST, Fleet
from falconwing_kit.learning.imitation import imitate
from falconwing_kit.learning.learner import (
    Learner,
    MaskLearner,
    Schedule,
    load_state,
    save_policy,
    save_state,
)
from falconwing_kit.learning.policy_views import PolicyViews
from falconwing_kit.learning.situations import training_ranges
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.tools.cli.scene_input import open_scene, parse_size
from falconwing_kit.tools.cli.train import CURVE, RECORD, STATE, settings_record
from falconwing_kit.tools.trials.train_on_data import clone_stages, cloning_left, open_data
from falconwing_kit.vision.policy import Policy, PolicyShape

if TYPE_CHECKING:
    from falconwing_kit.tools.cli.train import Train

# what is to be seen of a leader is small: its place and attitude are taught beside the commands
FOLLOW_MEMORY_LOSS, FOLLOW_IMAGE_LOSS = 0.4, 0.6


def train_policy(options: "Train", device: str) -> list[dict[str, float]]:
    """Train, or go on with an interrupted training of the same options.

    Returns:
        A record of each round.

    Raises:
        InputError: the folder holds a training with other options.
    """
    camera = fpv_camera(*parse_size(options.size))
    data = open_data(options, camera)
    options.out.mkdir(parents=True, exist_ok=True)
    settings, rounds = settings_record(options), _rounds_before(options)
    used = rounds[-1]["s"] / 60.0 if rounds else 0.0
    left = max(options.minutes - used, 0.0)
    cloning = cloning_left(options, rounds)
    if rounds and not any(cloning) and (left < 0.01 or not options.rounds):
        return rounds
    schedule = Schedule(
        minutes=left, flights=options.flights, rounds=options.rounds, batch=options.batch,
        rate=options.rate, seed=options.seed + 100 * len(rounds),
    )  # fmt: skip
    if options.task == "follow":
        schedule = replace(schedule, memory_loss=FOLLOW_MEMORY_LOSS, image_loss=FOLLOW_IMAGE_LOSS)
    state = options.out / STATE
    goes_on = bool(rounds) and state.is_file()
    if goes_on or options.start:
        schedule = replace(schedule, mixing=())
    learners = make_learners(
        options.pilots, options.task, camera, schedule, device, memory=options.memory
    )
    if goes_on:
        load_state(learners, state)
        for learner in learners:
            learner.trained.steps = int(rounds[-1]["steps"])
    else:
        for learner, path in zip(learners, options.start, strict=False):
            learner.start_from(Policy.load(path))
    leader = load_scene("leader") if options.task == "follow" else None
    backend = "gsplat" if device == "cuda" else "fast"
    views = PolicyViews(open_scene(options.scene), leader, camera, backend, device)
    fleets = [Fleet(options.workers // 2) for _ in range(2)]
    bar = tqdm(total=round(60.0 * left), unit="s", desc="training")

    def log(record: dict[str, float]) -> None:
        bar.update(round(record["s"]) - bar.n)
        bar.set_postfix(loss=f"{record['loss']:.3f}", success=f"{record['success']:.0%}")
        shifted = {"round": record["round"] + number, "s": record["s"] + 60.0 * used}
        rounds.append(record | shifted)
        save_state(learners, state)
        _write(options.out / RECORD, {"settings": settings, "rounds": rounds})

    number = len(rounds)
    try:
        ranges = training_ranges(options.task, options.nominal)
        if data is not None and any(cloning):
            clone_stages(options, learners, data, views, fleets, ranges, cloning, log)
            number, used = len(rounds), rounds[-1]["s"] / 60.0
            rest = max(options.minutes - used, 0.0)
            learners[0].schedule = replace(schedule, minutes=rest, mixing=())
        if options.rounds:
            imitate(learners, views, fleets, options.task, ranges, log)
    finally:
        bar.close()
        for fleet in fleets:
            fleet.close()
    for learner in learners:
        save_policy(learner, options.out / options.weights(learner.name), options.task, camera)
    state.unlink(missing_ok=True)
    draw_curve(rounds, options.out / CURVE)
    return rounds


def make_learners(
    names: Sequence[str], task: str, camera: PinholeCamera, schedule: Schedule, device: str,
    *, memory: bool = True,
) -> list[Learner]:  # fmt: skip
    """Fresh learners of pilots by their names; those that see masks share one network for them."""
    base = PolicyShape(camera.width, camera.height)
    if not memory:  # as the paper's policies: one image and the past 30 commands
        base = replace(base, memory=0, history=PAST)
    masks = MaskLearner(schedule, device) if task == "follow" else None
    learners = []
    for name in names:
        shape = replace(base, sees="rgb" if name == "student" else name)
        finder = None if shape.sees == "rgb" else masks
        learners.append(Learner(shape, schedule, device, name, finder))
    return learners


def _rounds_before(options: "Train") -> list[dict[str, float]]:
    """Rounds of an interrupted training in the folder."""
    path = options.out / RECORD
    if not path.is_file():
        return []
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        before, rounds = record["settings"], list(record["rounds"])
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path.name}: expected the record of a training; delete it") from None
    now = json.loads(json.dumps(settings_record(options), default=str))
    changed = [k for k in now if k not in ("json", "workers") and before.get(k) != now[k]]
    if changed:
        raise InputError(
            f"--out: expected an empty folder or a training with these options, got one with"
            f" another {changed[0].replace('_', '-')}; take another folder"
        )
    return rounds


def draw_curve(rounds: list[dict[str, float]], path: Path) -> None:
    """Loss and success by the time of training."""
    import matplotlib.pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7.0, 5.0))
    minutes = [record["s"] / 60.0 for record in rounds]
    above.plot(minutes, [record["loss"] for record in rounds], "o-")
    above.set_ylabel("command error [share of full travel]")
    below.plot(minutes, [100.0 * record["success"] for record in rounds], "o-")
    below.set(xlabel="time of training [min]", ylabel="flights that succeed [%]", ylim=(0, 102))
    above.set_title("Simulated: a policy in training, on flights with noise and many aircraft")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _write(path: Path, record: dict[str, Any]) -> None:
    with atomic_write(path) as file:
        file.write(json.dumps(record, default=str).encode())
