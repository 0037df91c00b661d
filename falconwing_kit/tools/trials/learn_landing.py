"""Learning to land: minutes -> a policy by reinforcement learning, judged on the frozen trials.

    python -m falconwing_kit.tools.trials.learn_landing --minutes 10 --out policy

Needs stable-baselines3 (`pip install "falconwing-kit[rl]"`). PPO [Schulman et al. 2017, Proximal
policy optimization algorithms] in many simulated landings at once, from measured states, without
images and without an expert. Two things make it quick:

    the policy begins at the trim of the glide, so it learns deviations from a steady flight
    starts move outward from the pad as it succeeds [Florensa et al. 2017, Reverse curriculum
    generation for reinforcement learning]

It trains and is selected on training seeds only. The policy is a small network of plain arrays: to
fly it needs neither PyTorch nor stable-baselines3.
"""

import json
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import GLIDE, landing_path, landing_speed
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.messages import Command, Observation, State
from falconwing_kit.flight.tasks import LandingTask
from falconwing_kit.tools.trials.statistics import clopper_pearson_interval
from falconwing_kit.tools.trials.trials import fly_trial

FLIGHTS = 512  # at once
STEPS = 32  # of each flight between two updates
HIDDEN = 64  # units of both layers
FIRST_REACH, REACH_STEP, GOOD = 0.15, 0.05, 0.8  # of the curriculum, shares of the distance
FULL_SHARE = 0.25  # of flights that begin where the task begins, at any time
CHECK_S, CHECK_FLIGHTS = 30.0, 200  # between two checks on training seeds
CHECK_SEEDS = 9_000  # training seeds from here on; the frozen trials have others


@dataclass(frozen=True)
class LandingPolicy:
    """A network of two layers of tanh units: observation -> action, both of Landing-v0."""

    weights: tuple[Array, ...]  # three matrices (outputs, inputs)
    biases: tuple[Array, ...]
    history: int  # past commands in its observation

    def action(self, observation: NDArray[Any]) -> Array:
        """Actions (..., 4) of observations (..., 12 + 4 history), each number cut to -1..1."""
        x = np.asarray(observation, np.float64)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.tanh(x @ weight.T + bias)
        return np.clip(x @ self.weights[-1].T + self.biases[-1], -1.0, 1.0)

    def save(self, path: Path) -> None:
        """Write plain arrays (.npz)."""
        arrays: dict[str, Any] = {f"weight_{k}": w for k, w in enumerate(self.weights)}
        arrays |= {f"bias_{k}": b for k, b in enumerate(self.biases)}
        with atomic_write(path) as file:
            np.savez(file, history=self.history, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "LandingPolicy":
        """Read a file of `save`; FileNotFoundError or InputError where it is none."""
        try:
            with np.load(path, allow_pickle=False) as arrays:
                layers = range(sum(name.startswith("weight") for name in arrays))
                weights = tuple(arrays[f"weight_{k}"] for k in layers)
                biases = tuple(arrays[f"bias_{k}"] for k in layers)
                return cls(weights, biases, int(arrays["history"]))
        except (ValueError, KeyError, OSError) as fault:
            if isinstance(fault, FileNotFoundError):
                raise
            raise InputError(
                f"{path}: expected a policy that learn_landing wrote, got another file"
            ) from fault


class LearntPilot:
    """A policy as a pilot of the loop, for `fly_trial`."""

    mode = "learnt"

    def __init__(self, policy: LandingPolicy, pad: LandingPad) -> None:
        self._policy, self._pad = policy, pad

    def act(self, observation: Observation) -> Command:
        """The command for the measured state and the past commands; safe without a state."""
        from falconwing_kit.flight.environments import command_from_action, landing_observation

        if observation.state is None:
            return Command(0.0, 0.0, 0.0, 0.0)
        past = observation.past_commands[len(observation.past_commands) - self._policy.history :]
        seen, _ = landing_observation(observation.state.vector, past, self._pad)
        return command_from_action(self._policy.action(seen))


class Curriculum:
    """Starts of training: from near the pad outward, as flights succeed."""

    def __init__(self, task: LandingTask) -> None:
        self._task, self._speed = task, landing_speed(task.model)
        self._path, _ = landing_path(task.airframe, task.pad, self._speed)
        self._steady = State.from_vector(trim(task.model, self._speed, -GLIDE).state)
        self._level = State.from_vector(trim(task.model, self._speed).state)
        self._recent: deque[bool] = deque(maxlen=FLIGHTS)
        self.reach = FIRST_REACH  # share of the distance to the task's start

    def start(self, seed: int) -> Array:
        """A true state (12,); the same spread as the task's, smaller the nearer it is."""
        task = self._task
        share, is_full = self._draw(seed)
        share = 1.0 if is_full or self.reach >= 1.0 else self.reach * share
        if share == 1.0:
            start = task.spread.start_near(self._level, task.nominal, seed, speed=self._speed)
            return start.vector
        x = task.pad.x_start + share * (task.nominal[0] - task.pad.x_start)
        z = float(np.interp(x, self._path.p_world[:, 0], self._path.p_world[:, 2]))
        nominal = np.array([x, task.pad.y_centre, z + 0.2])
        spread = task.spread
        smaller = replace(
            spread, position=spread.position * share, angle=spread.angle * share,
            speed=spread.speed * share,
        )  # fmt: skip
        return smaller.start_near(self._steady, nominal, seed, speed=self._speed).vector

    def _draw(self, seed: int) -> tuple[float, bool]:
        """Share of the reach at which a seed begins, and whether it begins where the task does."""
        share, full = np.random.default_rng([seed, 3]).uniform(size=2)
        return float(share), bool(full < FULL_SHARE)

    def record(self, seed: int, landed: bool) -> None:
        """A flight has ended; reach further where most of those within the reach have landed."""
        if self._draw(seed)[1]:
            return
        self._recent.append(landed)
        if len(self._recent) == FLIGHTS and np.mean(self._recent) >= GOOD:
            self.reach = min(1.0, self.reach + REACH_STEP)
            self._recent.clear()


def landed_share(policy: LandingPolicy, seeds: range, task: LandingTask | None = None) -> float:
    """Share of flights that a policy lands, one from each training seed."""
    from falconwing_kit.flight.environments import FalconWingLandingVector

    flights = FalconWingLandingVector(len(seeds), task=task, history=policy.history)
    observations = flights.begin(list(seeds))
    ended, landed = np.zeros(len(seeds), bool), np.zeros(len(seeds), bool)
    while not ended.all():
        observations, _, terminated, truncated, infos = flights.step(policy.action(observations))
        now = (terminated | truncated) & ~ended
        if now.any():
            landed[now] = infos["final_info"]["success"][now]
            ended |= now
    return float(landed.mean())


def learn(
    minutes: float, seed: int = 0, progress: Callable[[str], None] = print,
    task: LandingTask | None = None,
) -> tuple[LandingPolicy, dict[str, Any]]:  # fmt: skip
    """Train a policy; the best of its checks on training seeds.

    Args:
        minutes: of training, by the wall's clock, 0.01 to 600.
        seed: of the first weights, of exploration and of the training seeds' order.
        progress: gets a line of text at every check.
        task: the landing; None for that of `fly`.

    Returns:
        The policy, and what was done: steps, minutes, share landed in its check.

    Raises:
        InputError: the minutes are out of range, or stable-baselines3 is not installed.
    """
    require_range("minutes", minutes, low=0.01, high=600.0)
    try:
        from stable_baselines3 import PPO
    except ImportError as missing:
        raise InputError(
            "stable-baselines3: expected it for learning, got none; run"
            ' pip install "falconwing-kit[rl]"'
        ) from missing
    import torch

    from falconwing_kit.flight.environments import PAST, FalconWingLandingVector
    from falconwing_kit.flight.rewards import DISCOUNT

    begin, task = time.monotonic(), task or LandingTask()
    curriculum = Curriculum(task)
    flights = FalconWingLandingVector(FLIGHTS, task=task, starts=curriculum.start)
    venv = _for_baselines(flights, curriculum, seed)
    model = PPO(
        "MlpPolicy", venv, n_steps=STEPS, batch_size=2048, n_epochs=5, gamma=DISCOUNT,
        gae_lambda=0.95, learning_rate=lambda left: 1e-3 * max(left, 0.05), ent_coef=0.0,
        seed=seed, device="cpu", verbose=0,
        policy_kwargs={"net_arch": [HIDDEN, HIDDEN], "log_std_init": -1.6},
    )  # fmt: skip
    glide = trim(task.model, landing_speed(task.model), -GLIDE).command.copy()
    glide[0] = 2.0 * glide[0] - 1.0
    with torch.no_grad():
        model.policy.action_net.bias.copy_(torch.as_tensor(glide))
        model.policy.action_net.weight.mul_(0.1)
    best, best_share, checked, steps = policy_of(model, PAST), -1.0, begin, 0
    state: dict[str, Any] = {}
    while (elapsed := time.monotonic() - begin) < 60.0 * minutes:
        # The rate of learning falls with the time left.
        model._current_progress_remaining = 1.0 - elapsed / (60.0 * minutes)
        if steps == 0:
            _, callback = model._setup_learn(10**12)
            callback.on_training_start({}, {})
        model.collect_rollouts(model.env, callback, model.rollout_buffer, STEPS)
        model.train()
        steps += FLIGHTS * STEPS
        if time.monotonic() - checked > CHECK_S:
            checked, policy = time.monotonic(), policy_of(model, PAST)
            share = landed_share(policy, range(CHECK_SEEDS, CHECK_SEEDS + CHECK_FLIGHTS), task)
            progress(
                f"{elapsed / 60.0:5.1f} min {steps / 1e6:6.2f} M steps  starts to"
                f" {100.0 * curriculum.reach:3.0f} %  landed {100.0 * share:5.1f} % of"
                f" {CHECK_FLIGHTS} training flights"
            )
            if share >= best_share:
                best, best_share = policy, share
    state = {"steps": steps, "minutes": (time.monotonic() - begin) / 60.0, "check": best_share}
    return best, state


def policy_of(model: Any, history: int) -> LandingPolicy:
    """The mean action of a stable-baselines3 model as plain arrays."""
    layers = [model.policy.mlp_extractor.policy_net[k] for k in (0, 2)]
    layers.append(model.policy.action_net)
    arrays = [
        (layer.weight.detach().numpy().astype(float), layer.bias.detach().numpy().astype(float))
        for layer in layers
    ]
    weights, biases = zip(*((w.copy(), b.copy()) for w, b in arrays), strict=True)
    return LandingPolicy(tuple(weights), tuple(biases), history)


def _for_baselines(flights: Any, curriculum: Curriculum, seed: int) -> Any:
    """The vector environment as stable-baselines3 has them."""
    from stable_baselines3.common.vec_env import VecEnv

    class Flights(VecEnv):
        def __init__(self) -> None:
            super().__init__(
                flights.num_envs, flights.single_observation_space, flights.single_action_space
            )
            self._actions: Any = None

        def reset(self) -> Any:
            return flights.reset(seed=seed)[0]

        def step_async(self, actions: Any) -> None:
            self._actions = actions

        def step_wait(self) -> Any:
            seen, rewards, terminated, truncated, found = flights.step(self._actions)
            done = terminated | truncated
            infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
            for row in np.flatnonzero(done).tolist():
                infos[row] = {
                    "terminal_observation": found["final_obs"][row],
                    "TimeLimit.truncated": bool(truncated[row]),
                }
                last = found["final_info"]
                curriculum.record(int(last["seed"][row]), bool(last["success"][row]))
            return seen, rewards.astype(np.float32), done, infos

        def close(self) -> None:
            flights.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(flights, attr_name, None)] * self.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            setattr(flights, attr_name, value)

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kw: Any) -> Any:
            return [getattr(flights, method_name)(*args, **kw)]

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * self.num_envs

    return Flights()


def judge_policy(policy: LandingPolicy, trials: int = 100) -> dict[str, Any]:
    """Fly the frozen trials as `fly` does and count what its judge calls a landing.

    Returns:
        trials, landed, low95 and high95 of the rate, misses {trial: reason}, median offset and sink
        rate of the landings [m, m/s].
    """
    task = LandingTask()
    records = [
        fly_trial(task, lambda _: LearntPilot(policy, task.pad), number) for number in range(trials)
    ]
    landed = [record for record in records if record["success"]]
    low, high = clopper_pearson_interval(len(landed), trials)

    def median(key: str) -> float:
        return float(np.median([record[key] for record in landed])) if landed else math.nan

    return {
        "trials": trials, "landed": len(landed), "low95": low, "high95": high,
        "misses": {r["trial"]: r["reason"] for r in records if not r["success"]},
        "ald_m": median("ald_m"), "sink_rate_m_s": median("sink_rate_m_s"),
    }  # fmt: skip


def main(minutes: float = 10.0, out: Path = Path("policy"), seed: int = 0) -> int:
    """Learn to land from states, then fly the 100 frozen trials.

    Args:
        minutes: of training.
        out: folder for policy.npz and policy.json.
        seed: of the training.
    """
    out.mkdir(parents=True, exist_ok=True)
    print(f"SIMULATION: learning to land for {minutes:g} min, {FLIGHTS} flights at once")
    policy, training = learn(minutes, seed, lambda text: print(text, flush=True))
    policy.save(out / "policy.npz")
    print("flying the 100 frozen trials", flush=True)
    found = judge_policy(policy)
    with atomic_write(out / "policy.json", text=True) as file:
        json.dump({"simulated": True, "seed": seed, "training": training, **found}, file, indent=1)
    low, high = 100.0 * found["low95"], 100.0 * found["high95"]
    of = f"of {found['trials']} (95 % between {low:.1f} and {high:.1f} %)"
    print(f"landed {found['landed']} {of}")
    print(f"off the centre line {found['ald_m']:.2f} m, sink rate {found['sink_rate_m_s']:.2f} m/s")
    for trial, reason in found["misses"].items():
        print(f"trial {trial}: {reason}")
    print(f"next: LandingPolicy.load({str(out / 'policy.npz')!r}) flies it in your own script")
    return 0 if found["landed"] >= 0.95 * found["trials"] else 1


if __name__ == "__main__":
    import sys

    import tyro

    sys.exit(tyro.cli(main))
