"""Collecting from the command line: options -> a dataset, whole or gone on with."""

import hashlib
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.flight.pilots import P_BODY_CAMERA_M, load_pilot
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.learning.collect import fly_episodes
from falconwing_kit.learning.datasets import (
    Dataset,
    DatasetRecord,
    append_episodes,
    begin_dataset,
    write_stats,
)
from falconwing_kit.learning.flights import Fleet
from falconwing_kit.learning.policy_views import PolicyViews
from falconwing_kit.learning.situations import training_ranges
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.tools.cli.scene_input import open_scene, parse_size

if TYPE_CHECKING:
    from falconwing_kit.tools.cli.collect import Collect

MIN_SIDE_PX, MAX_SIDE_PX = 16, 1920
# Those of training begin at 10,000,000 and of evaluation at 10,000: no flight is in two of them.
FIRST_SEED, SEEDS = 5_000_000_000, 10_000_000
HOW = ("seed", "scene", "expert_noise", "nominal", "per_file")  # options that change the flights


def collect_dataset(options: "Collect") -> Dataset:
    """Collect, or go on with an interrupted collection of the same options.

    Raises:
        InputError: the folder holds other files, an option is wrong, or there is no GPU.
    """
    device = _device(options.device)
    camera = fpv_camera(*_size(options.size))
    scene = open_scene(options.scene)
    make_pilot = None
    if options.weights is not None:
        weights = require_file(options.weights)
        make_pilot = partial(load_pilot, "student", options.task, "hall", camera, weights=weights)
        make_pilot(P_BODY_CAMERA_M)  # refuses other weights before the folder is made
    record = DatasetRecord(
        options.task, camera.width, camera.height, camera.fx / camera.width, options.flights,
        _how(options),
    )  # fmt: skip
    done = begin_dataset(options.out, record)
    leader = load_scene("leader") if options.task == "follow" else None
    views = PolicyViews(scene, leader, camera, "gsplat" if device == "cuda" else "fast", device)
    ranges = training_ranges(options.task, options.nominal)
    bar = tqdm(
        total=options.flights, initial=done, unit="flight", desc="collecting",
        disable=True if options.json else None,
    )  # fmt: skip
    fleet = Fleet(options.workers)
    try:
        while done < options.flights:
            count = min(options.per_file, options.flights - done)
            first = FIRST_SEED + SEEDS * options.seed + done
            jobs = [
                (options.task, first + k, ranges, np.array(P_BODY_CAMERA_M)) for k in range(count)
            ]
            append_episodes(
                options.out, fly_episodes(fleet, views, jobs, options.expert_noise, make_pilot)
            )
            done += count
            bar.update(count)
    finally:
        bar.close()
        fleet.close()
    write_stats(options.out)  # of a collection that ended just before them
    return Dataset(options.out)


def _how(options: "Collect") -> dict[str, Any]:
    """The options that change the flights, and the digest of the policy."""
    found = {name: getattr(options, name) for name in HOW}
    if options.weights is not None:
        found["weights"] = hashlib.sha256(options.weights.read_bytes()).hexdigest()[:16]
    return found


def _size(text: str) -> tuple[int, int]:
    width, height = parse_size(text)
    if not MIN_SIDE_PX <= min(width, height) <= max(width, height) <= MAX_SIDE_PX:
        raise InputError(
            f"--size: expected sides of {MIN_SIDE_PX} to {MAX_SIDE_PX} pixels, got {text}"
        )
    return width, height


def _device(name: str) -> str:
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device: expected a GPU for cuda, got none; use --device cpu")
    return name
