"""Learning to land: the policy's arithmetic, its file, the curriculum; no training."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Observation
from falconwing_kit.flight.environments import FalconWingLandingVector
from falconwing_kit.flight.tasks import LandingTask
from falconwing_kit.tools.trials import fly_trial
from falconwing_kit.tools.trials.learn_landing import (
    FIRST_REACH,
    FLIGHTS,
    FULL_SHARE,
    REACH_STEP,
    Curriculum,
    LandingPolicy,
    LearntPilot,
    landed_share,
    learn,
    policy_of,
)

TASK = LandingTask()


def glider(history=1):
    """A policy that holds a glide and levels the wings by the measured roll alone."""
    observed = 12 + 4 * history
    first = np.zeros((1, observed))
    first[0, 5] = 0.1  # roll, in units of 0.35 rad; tanh is linear here
    last = np.zeros((4, 1))
    last[1, 0] = -2.0
    biases = np.zeros(1), np.zeros(1), np.array([-0.6, 0.0, 0.0, 0.0])
    return LandingPolicy((first, np.eye(1), last), biases, history)


def test_a_policy_is_two_layers_of_tanh():
    """By hand: a measured roll of one unit, tanh(tanh(0.1)) = 0.09934, aileron -0.1987."""
    seen = np.zeros(16)
    seen[5] = 1.0
    assert glider().action(seen) == pytest.approx([-0.6, -0.19868, 0.0, 0.0], abs=1e-5)
    seen[5] = 1e6
    assert glider().action(seen)[1] == -1.0  # cut at full stick


def test_a_policy_is_read_as_it_was_written(tmp_path):
    """Inverse; another file is refused in a sentence."""
    glider().save(tmp_path / "policy.npz")
    again = LandingPolicy.load(tmp_path / "policy.npz")
    seen = np.random.default_rng(0).normal(size=(5, 16))
    assert (again.action(seen) == glider().action(seen)).all()
    assert again.history == 1
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    (tmp_path / "text.npz").write_text("no arrays")
    for name in ("other.npz", "text.npz"):
        with pytest.raises(InputError, match="expected a policy"):
            LandingPolicy.load(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        LandingPolicy.load(tmp_path / "missing.npz")


def test_plain_arrays_are_the_network():
    """PyTorch's own forward pass gives the same actions."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    layers = torch.nn.Sequential(
        torch.nn.Linear(16, 8), torch.nn.Tanh(), torch.nn.Linear(8, 8), torch.nn.Tanh()
    )
    head = torch.nn.Linear(8, 4)
    net = SimpleNamespace(
        mlp_extractor=SimpleNamespace(policy_net=layers), action_net=head
    )  # as stable-baselines3 names them
    policy = policy_of(SimpleNamespace(policy=net), 1)
    seen = torch.randn(7, 16)
    expected = head(layers(seen)).clamp(-1.0, 1.0).detach().numpy()
    assert policy.action(seen.numpy()) == pytest.approx(expected, abs=1e-6)


def test_the_loop_and_the_rows_judge_a_policy_alike():
    """Three frozen trials of one policy: `fly_trial` and the vector environment end them for the
    same reason at the same step.
    """
    policy, pilots = glider(), lambda _: LearntPilot(glider(), TASK.pad)
    flights = FalconWingLandingVector(3, history=1)
    seen, _ = flights.reset(options={"trial": 0})
    ends: dict[int, tuple[str, int]] = {}
    for step in range(1, 240):
        seen, _, terminated, truncated, infos = flights.step(policy.action(seen))
        for row in np.flatnonzero(terminated | truncated).tolist():
            ends.setdefault(row, (infos["final_info"]["reason"][row], step + 1))
    records = [fly_trial(TASK, pilots, number) for number in range(3)]
    assert [ends[row] for row in range(3)] == [(r["reason"], r["steps"]) for r in records]


def test_a_pilot_without_a_state_is_safe():
    """Motor idle, sticks neutral."""
    past = np.zeros((30, 4))
    assert not LearntPilot(glider(), TASK.pad).act(Observation(0.0, None, past)).vector.any()


def test_starts_move_outward_as_flights_succeed():
    """By hand: the first reach is 15 % of 20 m; after as many landings as are counted it is one
    step larger, after failures it stays; flights from the full distance do not count.
    """
    curriculum = Curriculum(TASK)
    before = [TASK.pad.x_start - curriculum.start(seed)[0] for seed in range(200)]
    near = [seed for seed in range(200) if before[seed] < 10.0]
    full = [seed for seed in range(200) if before[seed] > 18.9]
    assert len(near) + len(full) == 200
    assert len(full) == pytest.approx(200 * FULL_SHARE, abs=25)  # four sigmas
    assert max(before[seed] for seed in near) < 20.0 * FIRST_REACH + 1.0
    for seed in full * 20:
        curriculum.record(seed, True)
    assert curriculum.reach == FIRST_REACH
    for k in range(FLIGHTS):
        curriculum.record(near[k % len(near)], k % 2 == 0)
    assert curriculum.reach == FIRST_REACH
    for k in range(FLIGHTS):
        curriculum.record(near[k % len(near)], True)
    assert curriculum.reach == pytest.approx(FIRST_REACH + REACH_STEP)


def test_a_task_with_a_pad_out_of_reach_is_not_landed():
    """A glide with level wings from the task's starts never lands on a pad of 1 cm."""
    pad = replace(TASK.pad, length=0.01, width=0.01)
    assert landed_share(glider(), range(9_000, 9_004), replace(TASK, pad=pad)) == 0.0


def test_what_is_missing_is_named(monkeypatch):
    """Without stable-baselines3, and with a time out of range."""
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(InputError, match=r"falconwing-kit\[rl\]"):
        learn(1.0)
    with pytest.raises(InputError, match="minutes"):
        learn(0.0)
