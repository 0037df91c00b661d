"""Behaviour cloning: flights of a dataset and a network -> the network trained to answer as the
expert, without flying itself.
"""

import time
from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
import torch

from falconwing_kit.core.checks import InputError
from falconwing_kit.learning.imitation import name_losses
from falconwing_kit.learning.learner import Flown, Learner, train_together
from falconwing_kit.learning.situations import Ranges
from falconwing_kit.vision.policy import policy_inputs


class Joined(Sequence[Flown]):
    """The flights of several datasets in a row, or some of them; read as they are used."""

    def __init__(
        self, parts: Sequence[Sequence[Flown]], chosen: Sequence[int] | None = None
    ) -> None:
        places = [(part, k) for part in parts for k in range(len(part))]
        self._places = places if chosen is None else [places[k] for k in chosen]
        self._parts = parts

    def __len__(self) -> int:
        """Number of flights."""
        return len(self._places)

    @overload
    def __getitem__(self, k: int) -> Flown: ...
    @overload
    def __getitem__(self, k: slice) -> list[Flown]: ...
    def __getitem__(self, k: int | slice) -> Flown | list[Flown]:
        """A flight, or some."""
        if isinstance(k, slice):
            return [part[row] for part, row in self._places[k]]
        part, row = self._places[k]
        return part[row]

    def chosen(self, rows: Sequence[int]) -> "Joined":
        """Some of the flights."""
        return Joined(self._parts, rows)


def clone(
    learners: Sequence[Learner], flights: Sequence[Flown], ranges: Ranges, *,
    minutes: float = 0.0, steps: int = 0, stages: int = 4,
) -> Iterator[dict[str, float]]:  # fmt: skip
    """Train on flights, with the learning rate of one training.

    Args:
        learners: changed in place.
        flights: of a dataset.
        ranges: of late and lost images.
        minutes: of training, without what is done between the stages.
        steps: of training, in place of a time: the same on every machine, to rounding.
        stages: parts of equal length; no more than steps.

    Yields:
        The mean losses of each stage, as `name_losses` names them.

    Raises:
        InputError: a loss is not finite.
    """
    used, total = 0.0, float(steps or 60.0 * minutes)
    stages = min(stages, steps) if steps else stages
    for stage in range(stages):
        losses: list[torch.Tensor] = []
        while not losses or used < total * (stage + 1) / stages:
            t = time.perf_counter()
            losses.append(train_together(learners, flights, ranges, used / total))
            if learners[0].device == "cuda" and len(losses) % 8 == 0:
                torch.cuda.synchronize()  # or the clock would run ahead of the GPU
            used += 1.0 if steps else time.perf_counter() - t
        means = name_losses(learners, losses)
        if not np.isfinite(list(means.values())).all():
            raise InputError("training: expected a finite loss, got nan; use a lower rate")
        yield means


@torch.no_grad()
def command_error(learner: Learner, flights: Sequence[Flown]) -> float:
    """Root mean square difference of the averaged network's commands from the expert's.

    Every image is delivered at once and unchanged; commands in shares of full travel.
    """
    squares = []
    for flown in flights:
        T, history = len(flown.sent), learner.shape.history
        before = np.concatenate([np.zeros((history, flown.sent.shape[1])), flown.sent])[:-1]
        past = np.lib.stride_tricks.sliding_window_view(before, history, axis=0)
        inputs = policy_inputs(past.transpose(0, 2, 1), np.zeros(T), flown.p_body_camera, history)
        images = flown.images.to(learner.device).float() / 255.0
        features = learner.average.encode(learner.see(images))
        x = torch.from_numpy(inputs).to(learner.device)
        commands = learner.average(features[None], x[None])[0][0].cpu().numpy()
        squares.append(((commands - flown.teacher) ** 2).ravel())
    return float(np.sqrt(np.mean(np.concatenate(squares))))
