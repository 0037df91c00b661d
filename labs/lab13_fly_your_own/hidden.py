"""Lab 13, instructors only: the judges, on random cases and against references."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from given import FLOOR_Z, IMAGE_EVERY, PAD

from falconwing_kit.tools.grading import Course, Judge, Values


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise, for the constants of this course."""
    worth, soft = course.constants["worth_m"], course.constants["soft_sink"]

    def score(states: np.ndarray) -> tuple[float, float, float, float]:
        """From the law of the straight line between the last two rows."""
        if states[-1, 2] > FLOOR_Z:
            return 0.0, 0.0, 0.0, 0.0
        heights = states[[-1, -2], 2]
        x, y, vz = (np.interp(FLOOR_Z, heights, states[[-1, -2], column]) for column in (0, 1, 8))
        off = abs(y + 2.0)
        points = 100.0 * np.exp(-(off**2) / worth**2) * min(1.0, soft / max(-vz, soft))
        inside = 1.0 <= x <= 14.0 and off <= 1.0
        return float(x), float(off), float(-vz), float(points if inside else 0.0)

    return {
        "merge_gaussians": (Values(_draw_merge, _merge, cases=8),),
        "sticks_from_slots": (Values(_draw_slots, _sticks, cases=8),),
        "fly": (Values(_draw_flight, _flight, cases=8),),
        "landing_score": (Values(_draw_landing, score, cases=20),),
    }


def _draw_merge(rng: np.random.Generator) -> tuple[Any, ...]:
    count, groups = int(rng.integers(8, 40)), int(rng.integers(1, 6))
    number = rng.permutation(np.concatenate([np.arange(groups), rng.integers(0, groups, count)]))
    total = len(number)
    roots = rng.normal(size=(total, 3, 3))
    covs = roots @ roots.transpose(0, 2, 1)
    return (
        rng.normal(0.0, 3.0, (total, 3)),
        covs,
        rng.uniform(0.1, 4.0, total),
        rng.random((total, 3)),
        number,
    )


def _merge(means: Any, covs: Any, weights: Any, colours: Any, groups: Any) -> tuple[Any, ...]:
    """By second moments about the origin: E[x x^T] - E[x] E[x]^T."""
    answers = []
    for number in range(groups.max() + 1):
        mine = groups == number
        share = weights[mine] / weights[mine].sum()
        mean = share @ means[mine]
        second = sum(
            w * (C + np.outer(m, m)) for w, C, m in zip(share, covs[mine], means[mine], strict=True)
        )
        answers.append((mean, second - np.outer(mean, mean), share @ colours[mine]))
    return tuple(np.array(part) for part in zip(*answers, strict=True))


def _draw_slots(rng: np.random.Generator) -> tuple[Any, ...]:
    order = "".join(rng.permutation(list("TAER")))
    return rng.uniform(850.0, 2200.0, 4), order, float(rng.uniform(1480, 1540)), 480.0


def _sticks(slots_us: Any, order: str, centre_us: float, reach_us: float) -> np.ndarray:
    ends = np.array([[0.0, -1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
    slots = [slots_us[order.index(letter)] for letter in "TAER"]
    low, high = centre_us - reach_us, centre_us + reach_us
    return np.array(
        [np.interp(us, (low, high), ends[:, channel]) for channel, us in enumerate(slots)]
    )


def _draw_flight(rng: np.random.Generator) -> tuple[Any, ...]:
    steps = int(rng.integers(5, 30))
    lost = np.flatnonzero(rng.random(steps) < 0.3).astype(float)
    start = rng.uniform(0.2, 1.0, 9)
    floor = float(rng.choice([-9.0, 0.75 * start[2]]))
    return start, rng.uniform(-0.4, 0.4, (4, 18)), lost, float(steps), floor


def _flight(start: Any, gains: Any, lost: Any, steps: float, floor: float) -> dict[str, Any]:
    """The small world of `given.run_fly`, written out."""
    states, commands, frames = [start], [], []
    servos = before = np.zeros(4)
    for k in range(int(steps)):
        x = states[-1]
        if k % IMAGE_EVERY == 0:
            frames.append(x + 0.5)
        if k not in lost:
            servos = 0.5 * (gains[:, :9] @ x + gains[:, 9:] @ frames[-1])
        push = np.concatenate([[0.0, 0.0, -0.1], 0.3 * before[:3], 0.2 * servos[:3]])
        commands.append(servos)
        states.append(0.97 * x + 0.1 * push)
        before = servos
        if states[-1][2] <= floor:
            break
    return {
        "states": np.array(states),
        "commands": np.array(commands),
        "frames": np.array(frames),
    }


def _draw_landing(rng: np.random.Generator) -> tuple[Any, ...]:
    states = rng.normal(0.0, 0.1, (int(rng.integers(2, 6)), 9))
    states[:, 0] += rng.uniform(PAD[0] - 2.5, PAD[1] + 2.5)
    states[:, 1] += rng.choice([-2.0, -2.0, -2.0, -3.6, 0.4]) + rng.uniform(-0.7, 0.7)
    states[:, 2] = FLOOR_Z + np.linspace(0.02 * len(states), 0.0, len(states))
    states[-1, 2] -= rng.choice([0.01, 0.015, -0.005], p=[0.45, 0.4, 0.15])
    states[:, 8] = -rng.uniform(0.3, 2.5) + 0.1 * rng.normal(size=len(states))
    return (states,)
