"""Environments: steps a second on one core of the landing, single and vector, beside Gymnasium's
own CartPole and Pendulum in the same run.

    python -m pytest -m benchmark tests/benchmarks/bench_gym.py

Steps of 50 ms a CPU second of this process over all its threads, the best of three: other work on
the machine counts little. A step holds aircraft, delay, noise, contact, judge, reward and the
resets of flights that end. CartPole-v1's vector environment is four numbers in NumPy, Pendulum-v1
one Python object a row. The table is Markdown.
"""

import os
import time

import gymnasium
import numpy as np
import pytest

from falconwing_kit.flight.environments import FalconWingLandingVector, landing_environment
from tests.benchmarks.bench_rollouts import machine

pytestmark = pytest.mark.benchmark
GLIDE = np.array([-0.6, 0.0, 0.0, 0.0], np.float32)
COUNTS = (1, 8, 64, 256, 1024)
ROUNDS = 3


def test_steps_per_second(capsys):
    """Prints the table; asserts only that what was timed ended flights."""
    lines = ["| environment | flights at once | steps / CPU s |", "|---|---|---|"]
    lines.append(f"| FalconWing/Landing-v0, single | 1 | {single():,.0f} |")
    for count in COUNTS:
        flights = FalconWingLandingVector(count)
        speed, ended = vector(
            flights, np.tile(GLIDE, (count, 1)), min(max(30, 15_000 // count), 500)
        )
        assert ended > 0
        lines.append(f"| FalconWing/Landing-v0, vector | {count} | {speed:,.0f} |")
    for name, mode in (("CartPole-v1", "vector_entry_point"), ("Pendulum-v1", "sync")):
        peer = gymnasium.make_vec(name, num_envs=256, vectorization_mode=mode)
        speed, _ = vector(peer, peer.action_space.sample(), 100)
        lines.append(f"| {name}, Gymnasium's, {mode} | 256 | {speed:,.0f} |")
    with capsys.disabled():
        load = os.getloadavg()[0]
        print(f"\n\n{machine()}; Gymnasium {gymnasium.__version__}; load {load:.1f}\n")
        print("\n".join(lines))


def vector(flights, actions, steps: int) -> tuple[float, int]:
    """Rows times steps a CPU second, and how many rows ended."""
    flights.reset(seed=0)
    flights.step(actions)  # compiles
    best, ended = 0.0, 0
    for _ in range(ROUNDS):
        begin = time.process_time()
        for _ in range(steps):
            _, _, terminated, truncated, _ = flights.step(actions)
            ended += int(np.sum(terminated) + np.sum(truncated))
        best = max(best, flights.num_envs * steps / (time.process_time() - begin))
    return best, ended


def single() -> float:
    """Steps a CPU second of one flight at a time, resets included."""
    env = landing_environment()
    env.reset(seed=0)
    best = 0.0
    for _ in range(ROUNDS):
        begin, steps = time.process_time(), 200
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(GLIDE)
            if terminated or truncated:
                env.reset()
        best = max(best, steps / (time.process_time() - begin))
    return best
