"""Lab 8, hidden: the cases and their references, independent of the lab's solution."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from falconwing_kit.tools.grading import Course, Judge, Values


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise."""
    learn = partial(
        _descend,
        turn_weight=course.constants["turn_weight"],
        clip_norm=course.constants["clip_norm"],
    )
    return {
        "history_window": (Values(_commands, _history, cases=20),),
        "make_dataset": (Values(_frames, _dataset, cases=12, rtol=1e-5, atol=1e-6),),
        "bc_loss_step": (Values(_batches, learn, cases=10, rtol=1e-5, atol=1e-7),),
        "closed_loop_eval": (Values(_pilots, _landings, cases=10, rtol=1e-6, atol=1e-8),),
    }


def _commands(rng: np.random.Generator) -> tuple[Any, ...]:
    lengths = rng.integers(1, 12, rng.integers(2, 6))
    return (
        rng.uniform(-1.0, 1.0, lengths.sum()),
        np.concatenate([[0], np.cumsum(lengths)[:-1]]),
        int(rng.integers(2, 9)),
    )


def _history(commands: np.ndarray, starts: np.ndarray, k: int) -> np.ndarray:
    """Frame by frame and column by column."""
    rows = np.zeros((len(commands), k))
    for frame in range(len(commands)):
        first = max(start for start in starts if start <= frame)
        for column in range(k):
            if frame - 1 - column >= first:
                rows[frame, column] = commands[frame - 1 - column]
    return rows


def _frames(rng: np.random.Generator) -> tuple[Any, ...]:
    n, height, width, k = (int(rng.integers(2, 7)) for _ in range(4))
    images = rng.integers(0, 256, (n, height, width + height, 3), dtype=np.uint8)
    return (
        images,
        rng.uniform(-1.0, 1.0, (n, k)),
        rng.uniform(-1.0, 1.0, n),
        bool(rng.random() < 0.8),
    )


def _dataset(
    images: np.ndarray, history: np.ndarray, labels: np.ndarray, mirror: bool
) -> tuple[np.ndarray, ...]:
    """Channel by channel, picture by picture, by a table of grey levels."""
    levels = np.linspace(-1.0, 1.0, 256)
    pictures = [np.stack([levels[image[..., c]] for c in range(3)]) for image in images]
    if not mirror:
        return np.array(pictures), history, labels
    pictures += [np.stack([np.fliplr(plane) for plane in picture]) for picture in pictures]
    return (
        np.array(pictures),
        np.vstack([history, -1.0 * history]),
        np.hstack([labels, -1.0 * labels]),
    )


def _batches(rng: np.random.Generator) -> tuple[Any, ...]:
    """Tiny networks and batches; some gradients are longer than the clip and some are shorter."""
    steps, n, k, side, hidden = (
        3,
        int(rng.integers(2, 7)),
        int(rng.integers(1, 4)),
        2,
        int(rng.integers(2, 5)),
    )
    inputs = 3 * side * side + k
    weights = [
        rng.normal(0.0, 0.4, shape) for shape in ((hidden, inputs), (hidden,), (1, hidden), (1,))
    ]
    images, history = (
        rng.uniform(-1.0, 1.0, (steps, n, 3, side, side)),
        rng.uniform(-1.0, 1.0, (steps, n, k)),
    )
    labels = rng.uniform(-1.0, 1.0, (steps, n)) * np.array([1.0, 0.1, 1.0])[:, None]
    return weights, images, history, labels, float(rng.uniform(0.05, 0.3))


def _descend(
    weights: list[np.ndarray],
    images: np.ndarray,
    history: np.ndarray,
    labels: np.ndarray,
    rate: float,
    turn_weight: float,
    clip_norm: float,
) -> dict[str, Any]:
    """The same steps with gradients by hand: the chain rule through tanh, in NumPy."""
    A, a, B, b = (np.array(each, float) for each in weights)
    losses = []
    for x, past, label in zip(images, history, labels, strict=True):
        inputs = np.hstack([x.reshape(len(x), -1), past])
        units = np.tanh(inputs @ A.T + a)
        error = units @ B[0] + b[0] - label
        share = (1.0 + turn_weight * np.abs(label)) / len(label)
        losses.append(float(share @ error**2))
        by_answer = 2.0 * share * error
        by_units = np.outer(by_answer, B[0]) * (1.0 - units**2)
        gradients = [
            by_units.T @ inputs,
            by_units.sum(axis=0),
            (by_answer @ units)[None],
            np.array([by_answer.sum()]),
        ]
        length = np.sqrt(sum(np.sum(g**2) for g in gradients))
        # The clip of torch divides by the length plus 1e-6.
        step = rate * min(1.0, clip_norm / (length + 1e-6))
        A, a, B, b = (w - step * g for w, g in zip((A, a, B, b), gradients, strict=True))
    return {"losses": np.array(losses), "weights": [A, a, B, b]}


def _pilots(rng: np.random.Generator) -> tuple[Any, ...]:
    """Linear pilots, good and bad ones, so that some flights land, some miss and some are lost."""
    flights, k = 6, int(rng.integers(3, 7))
    gains = np.array([rng.uniform(0.2, 1.5), rng.uniform(-4.0, -0.5), rng.uniform(-0.5, 0.5)])
    memory = rng.uniform(-0.4, 0.4, k)
    reach = np.array([3.0, 0.3, 0.6])
    starts = rng.uniform(-reach, reach, (flights, 3))
    starts[0, :2] = (
        rng.uniform(-0.9, 0.9),
        rng.choice([-1.0, 1.0]) * rng.uniform(1.21, 1.4),
    )  # turned away: lost at once
    return gains, memory, np.column_stack([starts, rng.integers(0, 1000, flights)])


def _landings(gains: np.ndarray, memory: np.ndarray, starts: np.ndarray) -> dict[str, Any]:
    """All flights at once, as columns.

    The plant is written out again, and what is over stays as it is.
    """
    n, k = len(starts), len(memory)
    offset, yaw, wind = (starts[:, i].astype(float) for i in range(3))
    draws = np.array([np.random.default_rng(int(seed)).normal(size=400) for seed in starts[:, 3]])
    x, roll, gust, flown = np.full(n, -17.0), np.zeros(n), np.zeros(n), np.zeros((n, k))
    for step in range(400):
        flying = (x < 4.5) & (np.abs(offset) <= 6.0) & (np.abs(yaw) <= 1.2)
        if not flying.any():
            break
        aileron = np.clip(np.column_stack([offset, yaw, roll]) @ gains + flown @ memory, -1.0, 1.0)
        gust = np.where(flying, 0.9 * gust + np.sqrt(0.19) * 0.3 * draws[:, step], gust)
        commanded = np.deg2rad(35.0) * np.clip(aileron + gust, -1.0, 1.0)
        next_roll = roll + 0.2 * (commanded - roll)
        next_yaw = yaw + 0.05 * 9.81 / 7.0 * np.tan(next_roll)
        moved = np.stack([0.35 * np.cos(next_yaw), 0.05 * wind - 0.35 * np.sin(next_yaw)])
        roll, yaw = np.where(flying, next_roll, roll), np.where(flying, next_yaw, yaw)
        x, offset = x + moved[0] * flying, offset + moved[1] * flying
        flown = np.where(flying[:, None], np.column_stack([aileron, flown[:, :-1]]), flown)
    landed = (np.abs(offset) <= 1.0) & (np.abs(yaw) <= 1.2)
    ald = float(np.mean(np.abs(offset[landed]))) if landed.any() else float("nan")
    return {"offsets": offset, "landed": landed, "success": float(np.mean(landed)), "ald": ald}
