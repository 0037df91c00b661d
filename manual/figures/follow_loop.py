"""A film of a follower: the pilot `mask` behind a leader in the trained hall, seen from its nose,
and the mask that it flies by -> follow.webp.

    .venv/bin/python manual/figures/follow_loop.py
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, Observation
from falconwing_kit.flight import load_pilot
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.flight.tasks.follow import FollowTask
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.trials.trials import TrialSettings, fly_trial
from falconwing_kit.vision.policy import Policy

OUT = Path(__file__).with_name("follow.webp")
TEXT = (
    "Simulated view from the nose of a following aircraft in a trained hall, and beside it, white"
    " on black, the mask of the leader that a network finds in each image and by which the pilot"
    " flies: the leader turns to the left and back, and stays in view."
)
MANOEUVRE, TRIAL, SIZE = "left_turn_s_descent", 8, (320, 240)
EVERY, QUALITY = 2, 60  # frames of the loop, and of WebP
POLICY = "policy_follow_mask.safetensors"

Pixels = NDArray[np.uint8]


class Watched:
    """A pilot whose images are kept."""

    reads_state, mode = False, ""

    def __init__(self) -> None:
        self.pilot, self.images = load_pilot("mask", "follow", "hall", fpv_camera(*SIZE)), []

    def act(self, observation: Observation) -> Command:
        """The pilot's command."""
        if observation.image is not None:
            self.images.append(observation.image.pixels.copy())
        return self.pilot.act(observation)


def main() -> None:
    """Fly, and write the film and its description."""
    camera, watched = fpv_camera(*SIZE), Watched()
    setting = TrialSettings(scene=load_scene("hall"), camera=camera)
    record = fly_trial(FollowTask(MANOEUVRE), lambda _: watched, TRIAL, setting=setting)
    assert record["success"], "the film is of a flight that keeps its leader"
    policy = Policy.load(Path(__file__).parents[2] / "falconwing_kit" / "data" / POLICY)
    frames = []
    for image in watched.images[::EVERY]:
        mask = policy.see(policy.resample(image, camera))[..., 0]
        grey = Image.fromarray(np.asarray(255.0 * mask, np.uint8)).resize(SIZE)
        frames.append(Image.fromarray(np.hstack([image, np.asarray(grey.convert("RGB"))])))
    duration = round(1000.0 * EVERY * CONTROL_PERIOD_S)
    with atomic_write(OUT) as file:
        frames[0].save(
            file, "WEBP", save_all=True, append_images=frames[1:], duration=duration, loop=0,
            quality=QUALITY,
        )  # fmt: skip
    with atomic_write(OUT.with_suffix(".txt")) as file:
        file.write(f"{TEXT}\n".encode())
    print(f"{OUT.name}: {len(frames)} frames, {OUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
