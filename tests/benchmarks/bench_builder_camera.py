"""The builder's camera above the wing: landings of both pilots by images, with the simulator's
camera at the nose, with the builder's, and with the propeller's blades drawn into its image.

    OMP_NUM_THREADS=1 python -m pytest -m benchmark -s tests/benchmarks/bench_builder_camera.py

Trials 0 to 9 of the frozen list 0. Blades: two, black, sharp, at an angle drawn for each frame; a
rolling shutter's bends and motion blur are not modelled, neither are wing and cowl. The table is
Markdown.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import Airframe, builder_airframe_path, load_airframe
from falconwing_kit.core.messages import Image
from falconwing_kit.flight import LandingTask, fpv_camera, load_pilot
from falconwing_kit.flight.loop import ImageSource
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.trials.trials import TrialSettings, fly_trial, summarise_trials
from tests.benchmarks.bench_pose_pilot import Changed

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]
CHORD = 0.014  # of a blade [m], estimate
TRIALS = 10


@dataclass(frozen=True)
class Blades:
    """Two black blades of an airframe's propeller before its camera, at a new angle every frame."""

    airframe: Airframe

    def __call__(self, source: ImageSource, seed: int) -> ImageSource:
        rng = np.random.default_rng([seed, 3])

        def pick(images: list[Image]) -> Image:
            pixels = images[-1].pixels.copy()
            pixels[self.mask(pixels.shape[1], pixels.shape[0], rng.uniform(0.0, math.pi))] = 0
            return replace(images[-1], pixels=pixels)

        return Changed(source, pick)

    def mask(self, width: int, height: int, angle: float) -> Any:
        """(height, width) where a blade is: rays of the pixels through the plane of the disc."""
        camera, propeller = fpv_camera(width, height), self.airframe.propeller
        x, y, z = self.airframe.p_body_camera
        assert propeller is not None
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        right = y + (propeller.x - x) * (u - camera.cx) / camera.fx
        down = z + (propeller.x - x) * (v - camera.cy) / camera.fy
        across = np.abs(right * math.sin(angle) - down * math.cos(angle))
        return (np.hypot(right, down) < 0.5 * propeller.diameter) & (across < 0.5 * CHORD)


def test_landings_with_the_builders_camera(capsys):
    """Prints the table; without blades every trial lands from both places."""
    built, scene, camera = load_airframe(builder_airframe_path()), load_scene("hall"), fpv_camera()
    lines = [
        "| pilot | camera | landed | ALD mean, max [cm] | sink max [m/s] |",
        "|---|---|---|---|---|",
    ]
    for name in ("student", "pose"):
        for place, p_body_camera, degrade in (
            ("at the nose", LandingTask().airframe.p_body_camera, None),
            ("above the wing", built.p_body_camera, None),
            ("above the wing, blades", built.p_body_camera, Blades(built)),
        ):
            task = LandingTask()
            task = replace(task, airframe=replace(task.airframe, p_body_camera=p_body_camera))
            setting = TrialSettings(scene=scene, camera=camera, degrade=degrade)
            pilot = load_pilot(name, camera=camera, p_body_camera_m=p_body_camera)

            def make(trial: Any, pilot: Any = pilot) -> Any:
                pilot.reset()
                return pilot

            found = summarise_trials([fly_trial(task, make, k, 0, setting) for k in range(TRIALS)])
            ald = found.get("ald_m") or {"mean": math.nan, "largest": math.nan}
            sink = found.get("sink_rate_m_s") or {"largest": math.nan}
            lines.append(
                f"| {name} | {place} | {found['successes']} of {TRIALS} |"
                f" {100.0 * ald['mean']:.1f}, {100.0 * ald['largest']:.1f} |"
                f" {sink['largest']:.2f} |"
            )
            with capsys.disabled():
                print("\n" + lines[-1], end="", flush=True)
            assert degrade is not None or found["successes"] == TRIALS
    with capsys.disabled():
        print("\n\n" + "\n".join(lines))
