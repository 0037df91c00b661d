"""The pose pilot: landings in the splat hall by images alone, with good and with bad video links,
and CPU time a step; the experts beside it, which read the state.

    OMP_NUM_THREADS=1 python -m pytest -m benchmark tests/benchmarks/bench_pose_pilot.py

Trials 0, 1, ... of the frozen list 0, which nothing was tuned on (tuning: seeds below 10,000). CPU
times are of this process, pilot alone. The table is Markdown.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from falconwing_kit.core.messages import Command, Image, Observation
from falconwing_kit.flight import LandingTask, fpv_camera, load_pilot
from falconwing_kit.flight.loop import ImageSource
from falconwing_kit.scene import load_scene
from falconwing_kit.scene.analog import scene_link
from falconwing_kit.tools.trials.trials import TrialSettings, fly_trial, summarise_trials
from tests.benchmarks.bench_rollouts import machine

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1200)]
Degrade = Callable[[ImageSource, int], ImageSource]
LIST = 0  # of the frozen starts


@dataclass(frozen=True)
class Late:
    """Images that arrive some steps after they were taken."""

    steps: int

    def __call__(self, source: ImageSource, seed: int) -> ImageSource:
        return Changed(source, lambda images: images[-1 - self.steps :][0], self.steps)


@dataclass(frozen=True)
class Repeated:
    """Images of which a share is the one before, drawn by the trial's seed."""

    share: float

    def __call__(self, source: ImageSource, seed: int) -> ImageSource:
        rng, shown = np.random.default_rng([seed, 2]), list[Image]()

        def pick(images: list[Image]) -> Image:
            again = bool(shown) and rng.random() < self.share
            shown.append(shown[-1] if again else images[-1])
            return shown[-1]

        return Changed(source, pick)


@dataclass(frozen=True)
class Exposed:
    """Images with another exposure: linear light times 2^stops, through the sRGB curve of 2.2."""

    stops: float

    def __call__(self, source: ImageSource, seed: int) -> ImageSource:
        table = 255.0 * ((np.arange(256) / 255.0) ** 2.2 * 2.0**self.stops) ** (1.0 / 2.2)
        table = np.clip(table + 0.5, 0.0, 255.0).astype(np.uint8)
        return Changed(source, lambda images: replace(images[-1], pixels=table[images[-1].pixels]))


class Changed:
    """A source of images and what a link makes of them."""

    def __init__(
        self, source: ImageSource, pick: Callable[[list[Image]], Image], wait: int = 0
    ) -> None:
        self.source, self.pick, self.wait, self.images = source, pick, wait, list[Image]()

    def next_image(self, t: float) -> Image | None:
        image = self.source.next_image(t)
        assert image is not None
        self.images.append(image)
        return self.pick(self.images) if len(self.images) > self.wait else None


class TimedPilot:
    """A pilot with its CPU time in every step [ms], and in how many it predicted only."""

    def __init__(self, pilot: Any) -> None:
        self.pilot, self.cpu_ms, self.predicted = pilot, list[float](), 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.pilot, name)

    def act(self, observation: Observation) -> Command:
        begin = time.process_time()
        command = self.pilot.act(observation)
        self.cpu_ms.append(1e3 * (time.process_time() - begin))
        self.predicted += "predicting" in self.pilot.mode or "lost" in self.pilot.mode
        return command


# What is flown: pilot, size of the image, what happens to images, trials
ROWS: dict[str, tuple[str, tuple[int, int], Degrade | None, str, int]] = {
    "expert, by the state": ("expert", (320, 240), None, "", 20),
    "expert_pid, by the state": ("expert_pid", (320, 240), None, "", 20),
    "pose": ("pose", (320, 240), None, "hall", 20),
    "pose, images 50 ms late": ("pose", (320, 240), Late(1), "hall", 6),
    "pose, images 100 ms late": ("pose", (320, 240), Late(2), "hall", 6),
    "pose, 30 % of frames repeated": ("pose", (320, 240), Repeated(0.3), "hall", 6),
    "pose, exposure -1 EV": ("pose", (320, 240), Exposed(-1.0), "hall", 6),
    "pose, 160 x 120": ("pose", (160, 120), None, "hall", 6),
    "pose, analog link": ("pose", (320, 240), None, "hall_analog", 6),
}


def test_landings_of_the_pose_pilot(capsys):
    """Prints the table; the bounds are the goals of the first version."""
    lines = [
        "| pilot and images | landed | ALD mean, max [cm] | past threshold [m] | sink max [m/s] |"
        " predicted only [%] | CPU median, 95 % [ms] |",
        "|---|---|---|---|---|---|---|",
    ]
    found = {}
    for name, arguments in ROWS.items():
        found[name], line = row(name, *arguments)
        lines.append(line)
        with capsys.disabled():
            print("\n" + line, end="", flush=True)
    with capsys.disabled():
        print(f"\n\n{machine()}; load {os.getloadavg()[0]:.1f}; list {LIST}\n")
        print("\n".join(lines))
    pose = found["pose"]
    assert pose["successes"] == 20 and pose["faults"] == 0
    assert pose["ald_m"]["mean"] <= 0.14 and pose["sink_rate_m_s"]["largest"] <= 0.8
    assert 1.5 <= pose["past_threshold_m"]["median"] <= 7.0


def row(
    name: str, pilot: str, size: tuple[int, int], degrade: Degrade | None, scene: str, trials: int
) -> tuple[dict[str, Any], str]:
    """Summary and line of some trials."""
    task, camera = LandingTask(), fpv_camera(*size)
    link = scene_link(scene) if scene else None
    rendered = load_scene(scene) if scene else None
    setting = TrialSettings(scene=rendered, camera=camera, link=link, degrade=degrade)
    timed = TimedPilot(
        load_pilot(pilot, camera=camera, p_body_camera_m=task.airframe.p_body_camera)
    )

    def make(trial: Any) -> TimedPilot:
        timed.reset()
        return timed

    records = [fly_trial(task, make, number, LIST, setting) for number in range(trials)]
    found = summarise_trials(records)
    landings = [record for record in records if record["success"]]
    past = [record["past_threshold_m"] for record in landings] or [np.nan]
    median, high = np.percentile(timed.cpu_ms, (50.0, 95.0))
    cells = (
        f"{found['successes']} of {trials}",
        f"{100.0 * found['ald_m']['mean']:.1f}, {100.0 * found['ald_m']['largest']:.1f}",
        f"{min(past):.1f} to {max(past):.1f}",
        f"{found['sink_rate_m_s']['largest']:.2f}",
        f"{100.0 * timed.predicted / len(timed.cpu_ms):.0f}",
        f"{median:.1f}, {high:.1f}",
    )
    return found, f"| {name} | {' | '.join(cells)} |"
