"""Story: collect, train, evaluate and fly, in miniature; a mistake between two of them is noticed.

In a minute of a laptop the policy does not learn to land. It learns to answer as the expert does:
on flights that it never saw, in the loop that flies it, its commands beside the expert's are the
chain's figure.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core import Image, Observation, State
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
STEERED, CHANCE = [0, 1, 3], 0.3  # throttle, aileron, rudder; a correlation
LIE = State.from_vector(np.full(12, 0.3))


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

    def __init__(self, policy, change):
        self.expert, self.policy, self.change = load_pilot("expert"), policy, change
        self.pairs = []

    def act(self, observation):
        """The expert's command."""
        command = self.expert.act(observation)
        image = replace(observation.image, pixels=self.change(observation.image.pixels))
        asked = self.policy.act(replace(observation, image=image, state=LIE))
        self.pairs.append((command.vector, asked.vector))
        return command


def agreement(policy, small_hall, change=lambda pixels: pixels):
    """Correlation of the policy's commands with the expert's, (4,), over three flights."""
    setting = TrialSettings(scene=GaussianScene.load(small_hall), camera=CAMERA)
    pairs = []
    for number in range(3):
        policy.reset()
        beside = Beside(policy, change)
        fly_trial(LandingTask(), lambda trial, pilot=beside: pilot, number, setting=setting)
        pairs += beside.pairs
    expert, asked = np.array(pairs).transpose(1, 2, 0)
    return np.array([np.corrcoef(a, b)[0, 1] for a, b in zip(expert, asked, strict=True)])


def reads_its_state(policy, dataset):
    """Whether other states, or none, change a policy's commands on a collected flight."""
    flown, found = Dataset(dataset)[0], []
    for state in (None, LIE, State.from_vector(np.zeros(12))):
        policy.reset()
        past = np.zeros((30, 4))
        for k, image in enumerate(flown.images[:20]):
            pixels = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
            t = 0.05 * k
            command = policy.act(Observation(t, Image(k, t, pixels), past, state)).vector
            past = np.vstack([past[1:], command])
            found.append(command)
    first, *others = np.array(found).reshape(3, -1)
    return any(not np.array_equal(first, other) for other in others)


@pytest.fixture
def policy(weights):
    """The policy as `fly` loads it."""
    return load_pilot("student", camera=CAMERA, weights=weights)


def test_a_cloned_policy_answers_as_the_expert(policy, weights, small_hall):
    """Over flights of the loop that it never saw, throttle, aileron and rudder correlate with the
    expert's by more than chance would do it: 0.3 is beyond two standard errors of 40 independent
    samples, of 200. (The elevator answers the noise of the expert's own state.) The error on
    flights held out has fallen.
    """
    assert (agreement(policy, small_hall)[STEERED] > CHANCE).all()
    rounds = json.loads((weights.parent / "training.json").read_text())["rounds"]
    assert [record["steps"] for record in rounds] == [15, 30, 45, 60]
    assert rounds[-1]["held_out_error"] < rounds[0]["held_out_error"]


def test_swapped_commands_are_noticed(policy, small_hall):
    """Planted: aileron and elevator in the other's place between training and flight."""
    for name in ("commands.weight", "commands.bias"):
        policy._policy._w[name] = policy._policy._w[name][[0, 2, 1, 3]]
    assert (agreement(policy, small_hall)[STEERED] < CHANCE).any()


def test_a_flipped_image_is_noticed(policy, small_hall):
    """Planted: left and right of the image between training and flight."""
    mirror = agreement(policy, small_hall, lambda pixels: np.ascontiguousarray(pixels[:, ::-1]))
    assert (mirror[STEERED] < CHANCE).any()


def test_a_leaked_state_is_noticed(policy, dataset):
    """A policy by images gives the same commands whatever its state says; planted: one that adds a
    little of the roll.
    """

    class Leaking:
        """A policy that reads the state."""

        reset = staticmethod(policy.reset)

        def act(self, observation):
            """The policy's command and a hundredth of the roll."""
            command = policy.act(observation)
            roll = 0.0 if observation.state is None else 0.01 * observation.state.roll
            return replace(command, aileron=command.aileron + roll)

    assert not reads_its_state(policy, dataset)
    assert reads_its_state(Leaking(), dataset)


def test_it_is_evaluated_and_flown(weights, small_hall, tmp_path, monkeypatch, capsys):
    """`eval` and `fly` take the same weights, and each step is the policy's, without a fault."""
    monkeypatch.setattr(evaluation, "_scene", lambda name: GaussianScene.load(small_hall))
    words = ["--weights", str(weights), "--size", SIZE]
    code = main(["eval", "--pilots", "student", "--task", "landing", "--worlds", "landing",
                 "--trials", "1", "--out", str(tmp_path / "eval"), *words])  # fmt: skip
    assert code == 0 and "student" in capsys.readouterr().out
    lines = (tmp_path / "eval" / "trials.jsonl").read_text().splitlines()
    flown = [record for line in lines if "trial" in (record := json.loads(line))]
    assert flown and all(record.get("faults", 0) == 0 for record in flown)
    main(["fly", "--pilot", "student", "--scene", str(small_hall), "--headless", "--json", *words])
    record = json.loads(capsys.readouterr().out)
    assert record["faults"] == 0 and record["art_steps"] > 10
