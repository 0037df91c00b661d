"""Imitation: an expert on the true state, a scene and networks -> policies that see.

Rounds: many flights at once, flown at first by the expert and then by the policies themselves,
while the expert says at every step what it would do; then some training on all flights so far
[Ross, Gordon & Bagnell 2011, algorithm 3.1]. Images are rendered once; light, lens, video link,
late and lost frames are drawn anew whenever a flight is used. Policies that are trained together
take turns in flying and learn from all flights.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.flight.pilots import P_BODY_CAMERA_M
from falconwing_kit.learning.flight_appearance import FlightAppearance
from falconwing_kit.learning.flights import PAST, Fleet, Snapshot
from falconwing_kit.learning.learner import Flown, Learner, train_together
from falconwing_kit.learning.policy_views import PolicyViews
from falconwing_kit.learning.situations import SPREAD_RANGES, Ranges, Situation
from falconwing_kit.vision.policy import CONTROLS, policy_inputs

LAST_SHARE = 0.05  # of the flights of a round, which do not fly on alone
MEMORY_SHARE = 0.5  # of a GPU's memory that the flights may fill
SHORTEST = 5  # steps of a flight that is kept
LogFunction = Callable[[dict[str, float]], None]
Look = Callable[[Tensor, Tensor], Tensor]  # images (N, 3, h, w), their flights (N,) -> images


class Rollout:
    """Flies the flights of a fleet by a network and its teacher, and keeps the data."""

    def __init__(
        self, fleet: Fleet, learner: Learner, views: PolicyViews, situations: list[Situation],
        *, look: Look | None = None, mixing: float = 0.0, noise: bool = False, keeps: bool = False,
        fine: bool = True,
    ) -> None:  # fmt: skip
        """Begin.

        Args:
            look: changes the images; None leaves them.
            mixing: share of the flights that the teacher flies, block by block.
            noise: whether noise is added to the commands of half of the flights.
            keeps: whether the data are kept.
            fine: whether images are rendered at twice the size.
        """
        self.fleet, self.learner, self.views, self.situations = fleet, learner, views, situations
        self._fine, self._keeps, self._mixing, self._noise = fine, keeps, mixing, noise
        self._last_share = LAST_SHARE if keeps else 0.0
        B, device = len(situations), learner.device
        self._look = look
        steps = max(len(situation.newest) for situation in situations)
        self._newest = np.full((B, steps + 1), -1)
        self._black = np.zeros((B, steps + 1), bool)
        for b, situation in enumerate(situations):
            n = len(situation.newest)
            self._newest[b, :n], self._black[b, :n] = situation.newest, situation.black
            self._newest[b, n:] = situation.newest[-1]
        self._mounts = np.array([situation.p_body_camera for situation in situations])
        shape = learner.shape
        self._features = torch.zeros(steps + 2, B, shape.features, device=device)
        self._memory = torch.zeros(1, B, shape.memory, device=device) if shape.memory else None
        self._past = np.zeros((B, PAST, CONTROLS))
        self._drift, self._sigma = np.zeros((B, CONTROLS)), np.zeros((B, 1))
        if noise:
            self._sigma = learner.rng.uniform(0.0, 0.15, (B, 1)) * (
                learner.rng.random((B, 1)) < 0.5
            )
        self._teaches = np.zeros(B, bool)
        self._k = 0
        self._data: list[tuple[Any, ...]] = []
        self.over = False
        fleet.send(None)

    def step(self) -> None:
        """Take the newest snapshot, look, act, and send the commands."""
        now = self.fleet.snapshot()
        self.over = now.flies.mean() <= self._last_share
        if self.over:
            return
        commands = self._act(now)
        if self._k % 10 == 0:
            self._teaches = self.learner.rng.random(len(commands)) < self._mixing
        commands = np.where(self._teaches[:, None], now.teacher, commands)
        if self._noise:
            white = self.learner.rng.normal(size=commands.shape)
            self._drift = 0.8 * self._drift + 0.6 * white * self._sigma
            commands = commands + self._drift
        commands = np.clip(commands, (0.0, -1.0, -1.0, -1.0), 1.0)
        if self._keeps:
            self._data[-1] = (*self._data[-1], commands)
        self._past = np.concatenate([self._past[:, 1:], commands[:, None]], axis=1)
        self._k += 1
        self.fleet.send(commands)

    @torch.no_grad()
    def _act(self, now: Snapshot) -> Array:
        rows = np.flatnonzero(now.flies)
        images, masks = self.views.render(
            now.Ts_world_camera[rows], now.Ts_world_leader[rows], self._fine
        )
        if self._keeps:
            self._data.append((rows, images, masks, now.teacher, now.auxiliary))
        learner, device, k = self.learner, self.learner.device, self._k
        flights = torch.from_numpy(rows).to(device)
        seen = images.float() / 255.0
        if self._look is not None:
            seen = self._look(seen, flights)
        black = torch.from_numpy(self._black[rows, k]).to(device)
        seen = seen * ~black[:, None, None, None]
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            features = learner.average.encode(learner.see(seen))
        self._features[k + 1].index_copy_(0, flights, features)  # row 0 is that of no image
        newest = self._newest[:, k]
        picked = torch.from_numpy(newest + 1).to(device)
        delivered = self._features[picked, torch.arange(len(newest), device=device)]
        age = np.where(newest >= 0, (k - newest) * CONTROL_PERIOD_S, np.nan)
        inputs = policy_inputs(self._past, age, self._mounts, learner.shape.history)
        x = torch.from_numpy(inputs).to(device)
        commands, _, _, self._memory = learner.average(delivered[:, None], x[:, None], self._memory)
        return commands[:, 0].float().cpu().numpy().astype(np.float64)

    def flown(self) -> list[Flown]:
        """The data of the flights, each as long as it flew."""
        steps = [step for step in self._data if len(step) == 6]  # those that were acted on
        place = np.full((len(steps), len(self.situations)), -1)  # row of a flight in each step
        for k, (rows, *_) in enumerate(steps):
            place[k, rows] = np.arange(len(rows))
        found = []
        for b in range(len(self.situations)):
            used = np.flatnonzero(place[:, b] >= 0)
            if len(used) < SHORTEST:
                continue
            images = torch.stack([steps[k][1][place[k, b]] for k in used])
            masks = None
            if steps[0][2] is not None:
                masks = torch.stack([steps[k][2][place[k, b]] for k in used])
            teacher, auxiliary, sent = (
                np.array([steps[k][part][b] for k in used]) for part in (3, 4, 5)
            )
            found.append(Flown(images, masks, sent, teacher, auxiliary, self._mounts[b]))
        return found


def fly_all(rollouts: Sequence[Rollout]) -> None:
    """Fly rollouts to their ends in turns: while one is rendered, the workers of another fly."""
    flying = list(rollouts)
    while flying:
        for rollout in flying:
            rollout.step()
        flying = [rollout for rollout in flying if not rollout.over]


def imitate(
    learners: Sequence[Learner], views: PolicyViews, fleets: Sequence[Fleet], task: str,
    ranges: Ranges = SPREAD_RANGES, log: LogFunction = lambda record: None,
) -> list[Flown]:  # fmt: skip
    """Train policies.

    Args:
        learners: changed in place; the `average` of each is the result. They take turns in flying
            and learn from the same flights, by the schedule of the first.
        views: what the cameras see.
        fleets: two fly while the other is rendered.
        task: "landing" or "follow".
        ranges: of the flights.
        log: gets a record after each round.

    Returns:
        The flights that were kept.

    Raises:
        InputError: a loss is not finite.
    """
    schedule, begin = learners[0].schedule, time.perf_counter()
    seconds, data = 60.0 * schedule.minutes, list[Flown]()
    seed, share = 10_000_000 * (schedule.seed + 1), schedule.flights // len(fleets)
    _prepare(fleets, task, seed, schedule.flights, ranges)
    _warm_up(views)
    ready = [fleet.begin() for fleet in fleets]
    for number in range(schedule.rounds):
        mixing = schedule.mixing[number] if number < len(schedule.mixing) else 0.0
        t = time.perf_counter()
        situations = ready if number == 0 else [fleet.begin() for fleet in fleets]
        turns = [learners[(number * len(fleets) + k) % len(learners)] for k in range(len(fleets))]
        rollouts = [
            Rollout(fleet, learner, views, drawn, mixing=mixing, noise=True, keeps=True,
                    look=FlightAppearance(share, learner.generator).apply,
                    fine=bool((number + k) % 2))
            for k, (fleet, learner, drawn) in enumerate(zip(fleets, turns, situations, strict=True))
        ]  # fmt: skip
        fly_all(rollouts)
        outcomes = [fleet.outcomes() for fleet in fleets]
        seed += schedule.flights
        _prepare(fleets, task, seed, schedule.flights, ranges)
        data = [*data, *(flown for rollout in rollouts for flown in rollout.flown())]
        data = _newest(data, schedule.keep, learners[0].device)
        flown_s = time.perf_counter() - t
        used = time.perf_counter() - begin
        # train as long as flying took, more in the last rounds
        left = seconds - used
        is_last = number == schedule.rounds - 1 or left < 2.5 * flown_s
        budget = left if is_last else flown_s * (1.0 - schedule.collecting) / schedule.collecting
        losses = _train_for(learners, data, ranges, budget, begin, seconds)
        record = {
            "round": float(number), "s": time.perf_counter() - begin, "flying_s": flown_s,
            "flights": float(len(data)), "images": float(sum(len(f.sent) for f in data)),
            "steps": float(learners[0].trained.steps), "mixing": mixing, "loss": losses["loss"],
            "success": float(np.mean([_success(each) for each in outcomes])),
        }  # fmt: skip
        if len(learners) > 1:
            record |= {f"success_{each.name}": _success(outcome)
                       for each, outcome in zip(turns, outcomes, strict=True)}  # fmt: skip
        log(record | losses)
        if not np.isfinite(list(losses.values())).all():
            raise InputError("training: expected a finite loss, got nan; use a lower rate")
        if is_last:
            break
    for fleet in fleets:
        fleet.begin()  # the flights that were prepared are not flown
    return data


def _warm_up(views: PolicyViews) -> None:
    """Render once in both sizes: a renderer may compile its kernels at its first image.

    That takes longer than a round of flights, and a round's time sets how long is trained after it.
    """
    for fine in (False, True):
        views.render(np.eye(4)[None], np.eye(4)[None], fine)


def _newest(data: list[Flown], most: int, device: str) -> list[Flown]:
    """The newest flights, at most so many and, on a GPU, so many as half of its memory holds."""
    data = data[-most:]
    if device != "cuda":
        return data
    sizes = [f.images.nbytes + (f.masks.nbytes if f.masks is not None else 0) for f in data]
    total = np.cumsum(sizes[::-1])
    room = MEMORY_SHARE * torch.cuda.get_device_properties(device).total_memory
    return data[len(data) - int(np.searchsorted(total, room)) :]


def _prepare(fleets: Sequence[Fleet], task: str, seed: int, flights: int, ranges: Ranges) -> None:
    share = flights // len(fleets)
    for k, fleet in enumerate(fleets):
        first = seed + k * share
        fleet.prepare([(task, first + i, ranges, np.array(P_BODY_CAMERA_M)) for i in range(share)])


def _success(outcomes: Sequence[dict[str, Any]]) -> float:
    """Share of flights that landed, or followed to the end."""
    return float(np.mean([bool(o.get("landed", o.get("success"))) for o in outcomes]))


def _train_for(
    learners: Sequence[Learner], data: list[Flown], ranges: Ranges, budget: float, begin: float,
    seconds: float,
) -> dict[str, float]:  # fmt: skip
    """Train for some seconds; the mean losses of it: over the policies, of each, and of masks."""
    end, losses = time.perf_counter() + max(budget, 0.0), list[Tensor]()
    while not losses or time.perf_counter() < end:
        # of no seconds at all, the whole schedule has passed
        share = (time.perf_counter() - begin) / seconds if seconds > 0.0 else 1.0
        losses.append(train_together(learners, data, ranges, share))
        if learners[0].device == "cuda" and len(losses) % 8 == 0:
            torch.cuda.synchronize()  # or the clock would run ahead of the GPU
    return name_losses(learners, losses)


def name_losses(learners: Sequence[Learner], losses: Sequence[Tensor]) -> dict[str, float]:
    """The mean losses of some steps of `train_together`, as they go to records."""
    means = torch.stack(list(losses)).mean(0).tolist()
    count = len(learners)
    found = {"loss": float(np.mean(means[:count]))}
    if count > 1:
        found |= {f"loss_{each.name}": mean for each, mean in zip(learners, means, strict=False)}
    return found | ({"loss_of_masks": means[count]} if len(means) > count else {})


def evaluate(
    learner: Learner, views: PolicyViews, fleets: Sequence[Fleet], task: str, ranges: Ranges,
    *, seed: int, flights: int, fine: bool = True, look: Look | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Outcomes of flights by the policy alone; arguments as `imitate`."""
    _prepare(fleets, task, seed, flights, ranges)
    rollouts = [
        Rollout(fleet, learner, views, fleet.begin(), look=look, fine=fine)
        for fleet in fleets
    ]  # fmt: skip
    fly_all(rollouts)
    return [outcome for fleet in fleets for outcome in fleet.outcomes()]
