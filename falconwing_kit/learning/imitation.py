"""Imitation: an expert on the true state, a scene and a network -> a policy that sees.

Rounds: many flights at once, flown at first by the expert and then by the policy itself, while the
expert says at every step what it would do; then some training on all flights so far
[Ross, Gordon & Bagnell 2011, algorithm 3.1]. Images are rendered once; light, lens, video link,
late and lost frames are drawn anew whenever a flight is used.
"""

import json
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.flight.pilots import P_BODY_CAMERA_M
from falconwing_kit.learning.flight_appearance import FlightAppearance
from falconwing_kit.learning.flights import AUXILIARY, PAST, Fleet, Snapshot
from falconwing_kit.learning.policy_views import PolicyViews
from falconwing_kit.learning.situations import (
    SPREAD_RANGES,
    Ranges,
    Situation,
    draw_delivery,
)
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.policy import CONTROLS, PolicyRecord, PolicyShape, policy_inputs
from falconwing_kit.vision.policy_network import PolicyNetwork

WARMUP = 0.02  # share of the training over which the learning rate rises
LAST_SHARE = 0.05  # of the flights of a round, which do not fly on alone
SHORTEST = 5  # steps of a flight that is kept
MEMORY_LOSS, IMAGE_LOSS = 0.1, 0.05  # weights of the auxiliary losses
HUBER = 0.05  # command error beyond which the loss is linear
LogFunction = Callable[[dict[str, float]], None]


@dataclass(frozen=True)
class Schedule:
    """Length and hyperparameters of a training."""

    minutes: float = 8.0  # in all
    collecting: float = 0.5  # most share of the time spent on flying
    flights: int = 512  # in each round
    rounds: int = 40  # at most
    batch: int = 48  # flights in a training step
    keep: int = 8000  # flights; the oldest are dropped
    rate: float = 1.5e-3  # learning rate of AdamW
    decay: float = 0.02  # weight decay
    average: float = 0.998  # decay of the moving average of the weights
    mixing: tuple[float, ...] = (1.0, 0.6, 0.3)  # flown by the expert in the first rounds
    seed: int = 0


@dataclass(eq=False)
class Flown:
    """One flight of the data: what was seen, done and taught at its T steps."""

    images: Tensor  # (T, 3, h, w) bytes
    masks: Tensor | None  # (T, h, w) bytes
    sent: Array  # (T, 4)
    teacher: Array  # (T, 4)
    auxiliary: Array  # (T, AUXILIARY)
    p_body_camera: Array  # (3,)


Look = Callable[[Tensor, Tensor], Tensor]  # images (N, 3, h, w), their flights (N,) -> images
See = Callable[[Tensor], Tensor]  # images (N, 3, h, w) in 0..1 -> the network's (N, C, h, w)


def see_rgb(images: Tensor) -> Tensor:
    """The images themselves."""
    return images


class Learner:
    """A network and its moving average, trained on flights."""

    def __init__(
        self, shape: PolicyShape, schedule: Schedule, device: str, see: See = see_rgb
    ) -> None:
        torch.manual_seed(schedule.seed)
        self.network = PolicyNetwork(shape, AUXILIARY).to(device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = deepcopy(self.network).eval().requires_grad_(False)
        self.shape, self.schedule, self.device, self.see = shape, schedule, device, see
        self.generator = torch.Generator(device).manual_seed(schedule.seed)
        self.rng = np.random.default_rng([schedule.seed, 19])
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=schedule.rate, weight_decay=schedule.decay
        )
        self.steps = 0

    def train_step(self, flights: Sequence[Flown], share: float, ranges: Ranges) -> Tensor:
        """One step on a batch of flights; share of the training that is over. Returns the loss."""
        rows = self.rng.integers(len(flights), size=self.schedule.batch)
        batch = [flights[row] for row in rows]
        lengths = [len(flown.sent) for flown in batch]
        B, T, H = len(batch), max(lengths), self.shape.history
        index = torch.from_numpy(np.repeat(np.arange(B), lengths)).to(self.device)
        # images of all flights in a row, with the appearance of each flight
        images = torch.cat([flown.images for flown in batch]).float() / 255.0
        looks = FlightAppearance(B, self.generator)
        images = looks.apply(images, index)
        inputs = np.zeros((B, T, self.shape.inputs), np.float32)
        seen = np.zeros((B, T), np.int64)  # row of the newest image in the list, plus one
        teacher, auxiliary = np.zeros((B, T, CONTROLS)), np.zeros((B, T, AUXILIARY))
        valid, blacks, first = np.zeros((B, T)), [], 0
        for b, (flown, n) in enumerate(zip(batch, lengths, strict=True)):
            newest, black = draw_delivery(self.rng, n, ranges)
            blacks.append(black)
            seen[b, :n] = np.where(newest >= 0, first + newest + 1, 0)
            before = np.concatenate([np.zeros((H, CONTROLS)), flown.sent])[:-1]
            past = np.lib.stride_tricks.sliding_window_view(before, H, axis=0).transpose(0, 2, 1)
            age = np.where(newest >= 0, (np.arange(n) - newest) * CONTROL_PERIOD_S, np.nan)
            inputs[b, :n] = policy_inputs(past, age, flown.p_body_camera, H)
            teacher[b, :n], auxiliary[b, :n], valid[b, :n] = flown.teacher, flown.auxiliary, 1.0
            first += n
        is_black = torch.from_numpy(np.concatenate(blacks)).to(self.device)
        images = images * ~is_black[:, None, None, None]
        tensors = (self._tensor(a) for a in (inputs, teacher, auxiliary, valid))
        x, target, state, weight = tensors
        with torch.autocast(self.device, torch.bfloat16, enabled=self.device == "cuda"):
            features = self.network.encode(
                self.see(images).contiguous(memory_format=torch.channels_last)
            )
        none = torch.zeros_like(features[:1])
        delivered = torch.cat([none, features])[torch.from_numpy(seen).to(self.device)]
        commands, of_memory, of_image, _ = self.network(delivered, x)
        total = weight.sum()
        loss = (functional.huber_loss(commands, target, reduction="none", delta=HUBER).mean(-1)
                * weight).sum() / total / HUBER  # fmt: skip
        off_memory = functional.smooth_l1_loss(of_memory, state, reduction="none").mean(-1)
        off_image = functional.smooth_l1_loss(of_image, state, reduction="none").mean(-1)
        extra = MEMORY_LOSS * off_memory + IMAGE_LOSS * off_image
        total_loss = loss + (extra * weight).sum() / total
        self._update(total_loss, share)
        return loss.detach()

    def save_state(self, path: Path) -> None:
        """Write both networks, for an interrupted training."""
        from safetensors.torch import save

        parts = {"network": self.network, "average": self.average}
        tensors = {
            f"{name}.{key}": tensor.contiguous().cpu()
            for name, network in parts.items()
            for key, tensor in network.state_dict().items()
        }
        with atomic_write(path) as file:
            file.write(save(tensors, {"shape": json.dumps(asdict(self.shape))}))

    def load_state(self, path: Path) -> None:
        """Go on with the networks of an interrupted training.

        Raises:
            InputError: the file is damaged, or of a network of another shape.
        """
        from safetensors.torch import load

        try:
            tensors = load(path.read_bytes())
            for name, network in (("network", self.network), ("average", self.average)):
                own = {k.removeprefix(f"{name}."): w for k, w in tensors.items() if name in k[:8]}
                network.load_state_dict(own)
        except Exception:  # a damaged file can fail anywhere
            raise InputError(
                f"{short_name(path)}: expected an interrupted training of this network, got a"
                " damaged file or another network; delete it to begin anew"
            ) from None

    def _tensor(self, values: Any) -> Tensor:
        return torch.from_numpy(np.asarray(values, np.float32)).to(self.device)

    def _update(self, loss: Tensor, share: float) -> None:
        warm = min(share / WARMUP, 1.0) if share > 0.0 else 0.05
        cool = 0.5 * (1.0 + np.cos(np.pi * min(share, 1.0)))
        for group in self.optimizer.param_groups:
            group["lr"] = self.schedule.rate * max(warm * cool, 0.01)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.steps += 1
        decay = min(self.schedule.average, (1.0 + self.steps) / (10.0 + self.steps))
        with torch.no_grad():
            for mine, theirs in zip(
                self.average.state_dict().values(), self.network.state_dict().values(), strict=True
            ):
                if mine.dtype.is_floating_point:
                    mine.lerp_(theirs, 1.0 - decay)
                else:
                    mine.copy_(theirs)


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
    learner: Learner, views: PolicyViews, fleets: Sequence[Fleet], task: str,
    ranges: Ranges = SPREAD_RANGES, log: LogFunction = lambda record: None,
) -> list[Flown]:  # fmt: skip
    """Train a policy.

    Args:
        learner: changed in place; its `average` is the result.
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
    schedule, begin, collecting = learner.schedule, time.perf_counter(), 0.0
    seconds, data = 60.0 * schedule.minutes, list[Flown]()
    seed, share = 10_000_000 * (schedule.seed + 1), schedule.flights // len(fleets)
    _prepare(fleets, task, seed, schedule.flights, ranges)
    for number in range(schedule.rounds):
        mixing = schedule.mixing[number] if number < len(schedule.mixing) else 0.0
        t = time.perf_counter()
        rollouts = [
            Rollout(fleet, learner, views, fleet.begin(), mixing=mixing, noise=True, keeps=True,
                    look=FlightAppearance(share, learner.generator).apply,
                    fine=bool((number + k) % 2))
            for k, fleet in enumerate(fleets)
        ]  # fmt: skip
        fly_all(rollouts)
        outcomes = [outcome for fleet in fleets for outcome in fleet.outcomes()]
        seed += schedule.flights
        _prepare(fleets, task, seed, schedule.flights, ranges)
        data = [*data, *(flown for rollout in rollouts for flown in rollout.flown())]
        data = data[-schedule.keep :]
        flown_s = time.perf_counter() - t
        collecting += flown_s
        used = time.perf_counter() - begin
        # train as long as flying took, more in the last rounds
        left = seconds - used
        is_last = number == schedule.rounds - 1 or left < 2.5 * flown_s
        budget = left if is_last else flown_s * (1.0 - schedule.collecting) / schedule.collecting
        loss = _train_for(learner, data, ranges, budget, begin, seconds)
        record = {
            "round": float(number), "s": time.perf_counter() - begin, "flying_s": flown_s,
            "flights": float(len(data)), "images": float(sum(len(f.sent) for f in data)),
            "steps": float(learner.steps), "loss": loss, "mixing": mixing,
            "success": float(np.mean([bool(o.get("landed", o.get("success"))) for o in outcomes])),
        }  # fmt: skip
        log(record)
        if not np.isfinite(loss):
            raise InputError("training: expected a finite loss, got nan; use a lower rate")
        if is_last:
            break
    for fleet in fleets:
        fleet.begin()  # the flights that were prepared are not flown
    return data


def _prepare(fleets: Sequence[Fleet], task: str, seed: int, flights: int, ranges: Ranges) -> None:
    share = flights // len(fleets)
    for k, fleet in enumerate(fleets):
        first = seed + k * share
        fleet.prepare([(task, first + i, ranges, np.array(P_BODY_CAMERA_M)) for i in range(share)])


def _train_for(
    learner: Learner, data: list[Flown], ranges: Ranges, budget: float, begin: float, seconds: float
) -> float:
    """Train for some seconds; the mean loss of it."""
    learner.network.train()
    end, losses = time.perf_counter() + max(budget, 0.0), list[Tensor]()
    while not losses or time.perf_counter() < end:
        share = (time.perf_counter() - begin) / seconds
        losses.append(learner.train_step(data, share, ranges))
        if learner.device == "cuda" and len(losses) % 8 == 0:
            torch.cuda.synchronize()  # or the clock would run ahead of the GPU
    return float(torch.stack(losses).mean())


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


def save_policy(learner: Learner, path: str | Path, task: str, camera: PinholeCamera) -> None:
    """Write the averaged network's weights in half precision, with what it was trained for."""
    from safetensors.torch import save

    source = json.dumps({"schedule": asdict(learner.schedule), "steps": learner.steps})
    record = PolicyRecord(asdict(learner.shape), task, camera.fx / camera.width, source)
    tensors = {name: w.half() for name, w in learner.average.weights().items()}
    with atomic_write(path) as file:
        file.write(save(tensors, {"policy": json.dumps(asdict(record))}))
