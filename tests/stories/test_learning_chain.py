"""Story: collect, train, evaluate and fly, in miniature; a mistake between two of them is noticed.

In a minute of a laptop the policy does not learn to land. It learns to answer as the expert does:
on flights that it never saw, in the loop that flies it, its commands beside the expert's are the
chain's figure.
"""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import LandingExpert
from falconwing_kit.control.loops import SPEED, Autopilot
from falconwing_kit.core import Image, Observation, State
from falconwing_kit.flight import load_pilot
from falconwing_kit.flight.pilots import P_BODY_CAMERA_M
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.flight.tasks.landing import LandingTask
from falconwing_kit.learning.datasets import Dataset
from falconwing_kit.learning.flight_appearance import FlightAppearance
from falconwing_kit.learning.flights import TaughtFlight, TrueState
from falconwing_kit.learning.situations import NOMINAL, draw_situation
from falconwing_kit.scene import GaussianScene, render
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.trials import evaluation
from falconwing_kit.tools.trials.trials import TrialSettings, fly_trial
from tests.learning.halls import thinned_hall

SIZE, CAMERA = "64x48", fpv_camera(64, 48)
GAUSSIANS = 1500  # of the hall's, those that cover most
LEARNED = [0, 1, 3]  # throttle, aileron, rudder
BLIND = 1.0  # share left unexplained by the teacher's mean command
LIE = State.from_vector(np.full(12, 0.3))


@pytest.fixture(scope="module")
def small_hall(tmp_path_factory):
    """The hall thinned, so that an image takes a millisecond."""
    path = tmp_path_factory.mktemp("hall") / "small.npz"
    thinned_hall(GAUSSIANS).save(path)
    return path


@pytest.fixture(scope="module")
def dataset(small_hall, tmp_path_factory):
    """Flights of the expert."""
    out = tmp_path_factory.mktemp("collected") / "flights"
    words = ["collect", "--out", str(out), "--flights", "96", "--per-file", "48", "--size", SIZE,
             "--scene", str(small_hall), "--nominal", "--expert-noise", "0.1",
             "--device", "cpu"]  # fmt: skip
    assert main(words) == 0
    return out


@pytest.fixture(scope="module")
def weights(dataset, small_hall, tmp_path_factory):
    """A policy cloned from them, in steps and not in seconds: the same on a slow machine. Of the
    randomisation, light and lens are left out, which would take longer to learn.
    """
    out = tmp_path_factory.mktemp("trained")
    words = ["train", "--out", str(out), "--data", str(dataset), "--rounds", "0", "--steps", "120",
             "--size", SIZE, "--scene", str(small_hall), "--nominal", "--batch", "2",
             "--rate", "2e-3", "--flights", "2", "--device", "cpu"]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FlightAppearance, "apply", lambda self, images, flights: images)
        assert main(words) == 0
    return out / "policy.safetensors"


class Beside:
    """The teacher flies by the true state; the policy is asked at every step."""

    reads_state, mode = True, ""

    def __init__(self, trial, policy, change):
        autopilot = partial(Autopilot, integrates=False)
        self.teacher = LandingExpert(
            rates_model(),
            load_airframe(),
            LandingPad(),
            SPEED,
            observer=TrueState(),
            autopilot=autopilot,
        )
        self.world, self.policy, self.change = trial.world, policy, change
        self.pairs = []

    def act(self, observation):
        """The teacher's command."""
        command = self.teacher.act(replace(observation, state=self.world.state))
        image = replace(observation.image, pixels=self.change(observation.image.pixels))
        asked = self.policy.act(replace(observation, image=image, state=LIE))
        self.pairs.append((command.vector, asked.vector))
        return command


def unexplained(policy, small_hall, change=lambda pixels: pixels):
    """Mean squares (4,) of the policy's commands less the teacher's, over the variances of the
    teacher's, in three flights: 0 for the teacher, 1 for its mean command without looking.
    """
    setting, flown = TrialSettings(scene=GaussianScene.load(small_hall), camera=CAMERA), []
    for number in range(3):
        policy.reset()

        def make_pilot(trial):
            flown.append(Beside(trial, policy, change))
            return flown[-1]

        fly_trial(LandingTask(), make_pilot, number, setting=setting)
    teacher, asked = np.concatenate([each.pairs for each in flown]).transpose(1, 0, 2)
    return ((asked - teacher) ** 2).mean(0) / teacher.var(0)


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


def test_the_images_are_what_the_camera_saw(dataset, small_hall):
    """The first flight's images, rendered again at their poses: the same to a rounding of a byte,
    and mirrored they are other pictures.
    """
    scene, episode = GaussianScene.load(small_hall), next(Dataset(dataset).read_episodes())
    for k in range(0, len(episode.flown.images), 20):
        again = 255.0 * render(scene, CAMERA, episode.Ts_world_camera[k]).rgb
        kept = episode.flown.images[k].permute(1, 2, 0).numpy().astype(float)
        assert np.abs(kept - again).max() < 1.5
        assert np.abs(kept[:, ::-1] - again).mean() > 10.0


def test_the_commands_in_the_file_are_in_their_order(dataset):
    """What was sent is the label and a little noise: of the four labels each command is nearest to
    its own. Planted: two labels in the other's place. And what was sent flies the flight again.
    """
    episodes = list(Dataset(dataset).read_episodes())
    sent = np.concatenate([episode.flown.sent for episode in episodes])
    teacher = np.concatenate([episode.flown.teacher for episode in episodes])
    assert nearest(sent, teacher) == [0, 1, 2, 3]
    assert nearest(sent, teacher[:, [0, 2, 1, 3]]) == [0, 2, 1, 3]
    mount = np.array(P_BODY_CAMERA_M)
    situation = draw_situation("landing", episodes[0].seed, NOMINAL, mount)
    flight = TaughtFlight(situation)
    for T_world_camera, command in zip(
        episodes[0].Ts_world_camera[:40], episodes[0].flown.sent, strict=False
    ):
        T_world_body = flight.world.state.pose.T_world_body
        assert T_world_body @ situation.T_body_camera == pytest.approx(T_world_camera, abs=1e-4)
        flight.advance(command)


def nearest(sent, teacher):
    """The number of the label that is nearest to each command, in mean square."""
    return ((sent[:, :, None] - teacher[:, None]) ** 2).mean(0).argmin(1).tolist()


def test_a_cloned_policy_answers_as_the_teacher(policy, weights, small_hall):
    """In flights of the loop that it never saw, throttle, aileron and rudder are nearer to the
    teacher's than a constant is. (The elevator takes longer to learn.) The error on flights held
    out has fallen.
    """
    assert unexplained(policy, small_hall)[LEARNED].max() < BLIND
    rounds = json.loads((weights.parent / "training.json").read_text())["rounds"]
    assert [record["steps"] for record in rounds] == [30, 60, 90, 120]
    assert rounds[-1]["held_out_error"] < rounds[0]["held_out_error"]


def test_swapped_commands_are_noticed(policy, small_hall):
    """Planted: aileron and elevator in the other's place between training and flight."""
    for name in ("commands.weight", "commands.bias"):
        policy.policy._w[name] = policy.policy._w[name][[0, 2, 1, 3]]
    assert unexplained(policy, small_hall)[LEARNED].max() > BLIND


def test_a_flipped_image_is_noticed(policy, small_hall):
    """Planted: left and right of the image between training and flight."""
    mirrored = unexplained(policy, small_hall, lambda pixels: np.ascontiguousarray(pixels[:, ::-1]))
    assert mirrored[LEARNED].max() > BLIND


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
