"""Story: collect, train, evaluate and fly, in miniature; a mistake between two of them is noticed.

In a minute of a laptop the policy does not learn to land. It learns to answer as the expert does:
on flights that it never saw, in the loop that flies it, its commands beside the expert's are the
chain's figure.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core import Observation, State
from falconwing_kit.flight import load_pilot
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.flight.tasks.landing import LandingTask
from falconwing_kit.learning.datasets import Dataset
from falconwing_kit.scene import GaussianScene, load_scene
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.trials import evaluation
from falconwing_kit.tools.trials.trials import TrialSettings, fly_trial

SIZE, CAMERA = "64x48", fpv_camera(64, 48)
GAUSSIANS = 1500  # of the hall's, those that cover most
AILERON, ELEVATOR = 1, 2


@pytest.fixture(scope="module")
def small_hall(tmp_path_factory):
    """The hall thinned, so that an image takes a millisecond."""
    hall = load_scene("hall")
    sides = np.sort(hall.scales, axis=1)
    covers = hall.opacities * sides[:, 1] * sides[:, 2]
    path = tmp_path_factory.mktemp("hall") / "small.npz"
    hall.selected(covers >= np.sort(covers)[-GAUSSIANS]).save(path)
    return path


@pytest.fixture(scope="module")
def dataset(small_hall, tmp_path_factory):
    """Flights of the expert."""
    out = tmp_path_factory.mktemp("collected") / "flights"
    words = ["collect", "--out", str(out), "--flights", "32", "--per-file", "12", "--size", SIZE,
             "--scene", str(small_hall), "--nominal", "--device", "cpu"]  # fmt: skip
    assert main(words) == 0
    return out


@pytest.fixture(scope="module")
def weights(dataset, small_hall, tmp_path_factory):
    """A policy cloned from them, in steps and not in seconds: the same on a slow machine."""
    out = tmp_path_factory.mktemp("trained")
    words = ["train", "--out", str(out), "--data", str(dataset), "--rounds", "0", "--steps", "60",
             "--size", SIZE, "--scene", str(small_hall), "--nominal", "--batch", "4",
             "--flights", "2", "--device", "cpu"]  # fmt: skip
    assert main(words) == 0
    return out / "policy.safetensors"


class Beside:
    """The expert flies; the policy is asked at every step, with a state that lies."""

    reads_state, mode = True, ""

    def __init__(self, expert, policy, change):
        self.expert, self.policy, self.change = expert, policy, change
        self.pairs = []

    def act(self, observation):
        """The expert's command."""
        command = self.expert.act(observation)
        image = replace(observation.image, pixels=self.change(observation.image.pixels))
        lie = State.from_vector(np.full(12, 0.1)) if hasattr(State, "from_vector") else None
        asked = self.policy.act(replace(observation, image=image, state=lie))
        self.pairs.append((command.vector, asked.vector))
        return command


def agreement(policy, small_hall, change=lambda pixels: pixels, flights=3):
    """Correlation of the policy's commands with the expert's, (4,), over flights of the loop."""
    setting = TrialSettings(scene=GaussianScene.load(small_hall), camera=CAMERA)
    pairs = []
    for number in range(flights):
        task = LandingTask()
        policy.reset()
        beside = Beside(load_pilot("expert", camera=CAMERA), policy, change)
        fly_trial(task, lambda trial, pilot=beside: pilot, number, setting=setting)
        pairs += beside.pairs
    expert, asked = np.array(pairs).transpose(1, 2, 0)
    return np.array([np.corrcoef(a, b)[0, 1] for a, b in zip(expert, asked, strict=True)])


def test_x(weights, small_hall):
    policy = load_pilot("student", camera=CAMERA, weights=weights)
    a = agreement(policy, small_hall)
    b = agreement(policy, small_hall, lambda x: np.ascontiguousarray(x[:, ::-1]))
    print(a, b)
    policy._policy._w["commands.weight"] = policy._policy._w["commands.weight"][[0,2,1,3]]
    policy._policy._w["commands.bias"] = policy._policy._w["commands.bias"][[0,2,1,3]]
    print(agreement(policy, small_hall))
    print(json.loads((weights.parent / "training.json").read_text())["rounds"])
    assert 0
