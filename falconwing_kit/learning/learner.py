"""Learner: flights -> a network that acts in them as the teacher would.

flights -> batch: images with light, lens and link drawn anew, what had arrived, the teacher
batch   -> a step of each network in training; those that are trained together share it
"""

import json
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.learning.flight_appearance import FlightAppearance
from falconwing_kit.learning.flights import AUXILIARY, PAST
from falconwing_kit.learning.situations import Ranges, draw_delivery
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.layers import Array32
from falconwing_kit.vision.mask_network import MaskNetwork, mask_loss
from falconwing_kit.vision.policy import (
    CHANNELS,
    CONTROLS,
    Policy,
    PolicyRecord,
    PolicyShape,
    policy_inputs,
)
from falconwing_kit.vision.policy_network import PolicyNetwork, calibrate

WARMUP = 0.02  # share of the training over which the learning rate rises
HUBER = 0.05  # error of a command or a state beyond which the loss is linear
FINDER = "leader_mask"  # in the file of an interrupted training; no pilot has this name
MASK_EVERY = 4  # one image of so many trains the masks
# channels of colours and mask that a policy sees of these
ALONE = {"rgb": slice(CHANNELS["rgb"]), "mask": slice(CHANNELS["rgb"], CHANNELS["rgb_mask"])}


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
    memory_loss: float = 0.3  # weights of the losses of the state, estimated from the memory
    image_loss: float = 0.15  # and from an image alone
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


@dataclass(frozen=True, eq=False)
class Batch:
    """B flights of up to T steps, with N images in all, as networks are given them."""

    images: Tensor  # (N, 3, h, w) in 0..1
    masks: Tensor | None  # (N, h, w) share of the leader that is to be seen
    seen: Tensor  # (B, T) number of the image that had arrived, from 1; 0: none
    inputs: Tensor  # (B, T, I) of `policy_inputs` with all PAST commands
    teacher: Tensor  # (B, T, 4)
    auxiliary: Tensor  # (B, T, AUXILIARY)
    weight: Tensor  # (B, T) 1 where a flight has a step
    found: Tensor | None  # (N, 1, h, w) masks that are found in the images now


def draw_batch(
    flights: Sequence[Flown], size: int, ranges: Ranges, rng: np.random.Generator,
    generator: torch.Generator, finder: "MaskLearner | None" = None,
) -> Batch:  # fmt: skip
    """Flights drawn at random, each with an appearance and a delivery of images of its own.

    Args:
        flights: the data.
        size: B, flights in the batch.
        ranges: of late, lost and black images.
        rng: draws flights and deliveries.
        generator: draws appearances; the batch is on its device.
        finder: of masks in the images.
    """
    batch = [flights[row] for row in rng.integers(len(flights), size=size)]
    device, lengths = generator.device, [len(flown.sent) for flown in batch]
    B, T = len(batch), max(lengths)
    index = torch.from_numpy(np.repeat(np.arange(B), lengths)).to(device)
    looks = FlightAppearance(B, generator)
    images = torch.cat([flown.images for flown in batch]).float() / 255.0
    images = looks.apply(images, index)
    seen = np.zeros((B, T), np.int64)
    is_lit = np.ones(len(images), np.float32)
    inputs = np.zeros((B, T, PolicyShape(history=PAST).inputs), np.float32)
    teacher, auxiliary = np.zeros((B, T, CONTROLS)), np.zeros((B, T, AUXILIARY))
    valid, first = np.zeros((B, T)), 0
    for b, (flown, n) in enumerate(zip(batch, lengths, strict=True)):
        newest, black = draw_delivery(rng, n, ranges)
        is_lit[first : first + n] = 1.0 - black
        seen[b, :n] = np.where(newest >= 0, first + newest + 1, 0)
        before = np.concatenate([np.zeros((PAST, CONTROLS)), flown.sent])[:-1]
        past = np.lib.stride_tricks.sliding_window_view(before, PAST, axis=0).transpose(0, 2, 1)
        age = np.where(newest >= 0, (np.arange(n) - newest) * CONTROL_PERIOD_S, np.nan)
        inputs[b, :n] = policy_inputs(past, age, flown.p_body_camera, PAST)
        teacher[b, :n], auxiliary[b, :n], valid[b, :n] = flown.teacher, flown.auxiliary, 1.0
        first += n
    lit = torch.from_numpy(is_lit).to(device)
    masks = None
    if all(flown.masks is not None for flown in batch):
        masks = torch.cat([flown.masks for flown in batch if flown.masks is not None])
        covered = looks.covers((images.shape[2], images.shape[3]), index)
        masks = masks.float() / 255.0 * ~covered * lit[:, None, None]
    arrays = (inputs, teacher, auxiliary, valid)
    x, target, state, weight = (
        torch.from_numpy(np.asarray(a, np.float32)).to(device) for a in arrays
    )
    images = images * lit[:, None, None, None]
    found = None if finder is None else finder.find(images)
    arrived = torch.from_numpy(seen).to(device)
    return Batch(images, masks, arrived, x, target, state, weight, found)


class Trained:
    """A network in training, and the moving average of its weights."""

    def __init__(self, network: nn.Module, schedule: Schedule, device: str) -> None:
        self.network = network.to(device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = deepcopy(self.network).eval().requires_grad_(False)
        self.schedule, self.device, self.steps = schedule, device, 0
        self._is_restored = False
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=schedule.rate, weight_decay=schedule.decay
        )

    def restore(self, weights: Mapping[str, Array32]) -> None:
        """Begin from the weights of a file; auxiliary heads begin anew."""
        tensors = {name: torch.from_numpy(w).to(self.device) for name, w in weights.items()}
        for network in (self.network, self.average):
            network.restore(tensors)  # type: ignore[operator]
        self._is_restored = True

    def calibrate(self, run: Callable[[], object]) -> None:
        """Before the first step from a file, take the statistics of a batch that `run` runs on."""
        if self._is_restored:
            calibrate(self.network, run)
            self.average.load_state_dict(self.network.state_dict())
            self._is_restored = False

    def update(self, loss: Tensor, share: float) -> None:
        """A step down the gradient of a loss; share of the training that is over."""
        warm = min(share / WARMUP, 1.0) if share > 0.0 else 0.05
        cool = 0.5 * (1.0 + np.cos(np.pi * min(share, 1.0)))
        for group in self._optimizer.param_groups:
            group["lr"] = self.schedule.rate * max(warm * cool, 0.01)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
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


class MaskLearner:
    """The network that finds the leader in an image, trained on the masks of its Gaussians."""

    def __init__(self, schedule: Schedule, device: str) -> None:
        torch.manual_seed(schedule.seed)
        self.trained = Trained(MaskNetwork(), schedule, device)
        self._device = device

    def train_step(self, batch: Batch, share: float) -> Tensor:
        """One step on some images of a batch that has masks. Returns the loss."""
        if batch.masks is None:
            raise InputError("masks: expected flights behind a leader, got others")
        begin = self.trained.steps % MASK_EVERY
        images = batch.images[begin::MASK_EVERY].contiguous(memory_format=torch.channels_last)
        self.trained.calibrate(lambda: self.trained.network(images))
        with torch.autocast(self._device, torch.bfloat16, enabled=self._device == "cuda"):
            logits = self.trained.network(images)
        loss = mask_loss(logits.float(), batch.masks[begin::MASK_EVERY])
        self.trained.update(loss, share)
        return loss.detach()

    @torch.no_grad()
    def find(self, images: Tensor) -> Tensor:
        """Masks (N, 1, h, w) in 0..1 of images (N, 3, h, w), by the averaged network."""
        with torch.autocast(self._device, torch.bfloat16, enabled=self._device == "cuda"):
            return torch.sigmoid(self.trained.average(images).float())[:, None]


class Learner:
    """A policy in training."""

    def __init__(
        self, shape: PolicyShape, schedule: Schedule, device: str, name: str = "policy",
        masks: MaskLearner | None = None,
    ) -> None:  # fmt: skip
        """Begin with random weights.

        Args:
            shape: of its network.
            schedule: length, hyperparameters and seed.
            device: "cpu" or "cuda".
            name: in records, and of its file where several are trained.
            masks: finds the leader; of a policy that sees masks.

        Raises:
            InputError: a policy that sees masks has no network that finds them.
        """
        if shape.sees != "rgb" and masks is None:
            raise InputError(f"masks: expected a learner of masks for {shape.sees}, got none")
        torch.manual_seed(schedule.seed)
        self.trained = Trained(PolicyNetwork(shape, AUXILIARY), schedule, device)
        self.shape, self.schedule, self.device = shape, schedule, device
        self.name, self.masks = name, masks
        self.generator = torch.Generator(device).manual_seed(schedule.seed)
        self.rng = np.random.default_rng([schedule.seed, 19])

    @property
    def average(self) -> PolicyNetwork:
        """The network that flies and is saved."""
        average = self.trained.average
        assert isinstance(average, PolicyNetwork)
        return average

    def start_from(self, policy: Policy) -> None:
        """Begin from a trained policy's weights, those of its masks too.

        A policy that sees colours or masks alone may begin from one that sees both.

        Raises:
            InputError: it is of another shape.
        """
        weights, sees = dict(policy.weights), policy.shape.sees
        if sees == "rgb_mask" and self.shape.sees in ALONE:
            weights["conv0.weight"] = weights["conv0.weight"][:, ALONE[self.shape.sees]]
            sees = self.shape.sees
        if replace(policy.shape, sees=sees) != self.shape:
            raise InputError(
                f"{self.name}: expected weights of a network of this shape, got another (image,"
                " memory or kind of input); take the file of the same pilot and --size"
            )
        self.trained.restore(weights)
        if self.masks is not None:
            self.masks.trained.restore(policy.weights)

    def see(self, images: Tensor, found: Tensor | None = None) -> Tensor:
        """What the network is given of images (N, 3, h, w): them, their masks, or both.

        Args:
            images: of colours.
            found: (N, 1, h, w) their masks; None finds them.
        """
        if self.masks is None:
            return images
        masks = self.masks.find(images) if found is None else found
        return masks if self.shape.sees == "mask" else torch.cat([images, masks], dim=1)

    def train_step(self, batch: Batch, share: float) -> Tensor:
        """One step on a batch; share of the training that is over. Returns the loss."""
        network, device = self.trained.network, self.device
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            seen = self.see(batch.images, batch.found).contiguous(memory_format=torch.channels_last)
        self.trained.calibrate(lambda: network.encode(seen.float()))  # type: ignore[operator]
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            features = network.encode(seen)  # type: ignore[operator]
        none = torch.zeros_like(features[:1])
        delivered = torch.cat([none, features])[batch.seen]
        inputs = batch.inputs[..., CONTROLS * (PAST - self.shape.history) :]  # the newest commands
        commands, of_memory, of_image, _ = network(delivered, inputs)
        weight, total = batch.weight, batch.weight.sum()
        off = functional.huber_loss(commands, batch.teacher, reduction="none", delta=HUBER)
        loss = (off.mean(-1) * weight).sum() / total / HUBER
        off_memory, off_image = (
            functional.huber_loss(x, batch.auxiliary, reduction="none", delta=HUBER).mean(-1)
            for x in (of_memory, of_image)
        )
        extra = self.schedule.memory_loss * off_memory + self.schedule.image_loss * off_image
        extra = extra / HUBER  # so that centimetres count, too
        self.trained.update(loss + (extra * weight).sum() / total, share)
        return loss.detach()


def train_together(
    learners: Sequence[Learner], flights: Sequence[Flown], ranges: Ranges, share: float
) -> Tensor:
    """One step of each learner on the same batch, and of the masks; share of the training over.

    Returns:
        The losses of the learners, and of the masks if one sees them.
    """
    first, finder = learners[0], next((each.masks for each in learners if each.masks), None)
    for trained in [each.trained for each in learners] + ([finder.trained] if finder else []):
        trained.network.train()
    batch = draw_batch(flights, first.schedule.batch, ranges, first.rng, first.generator, finder)
    losses = [learner.train_step(batch, share) for learner in learners]
    if finder is not None:
        losses.append(finder.train_step(batch, share))
    return torch.stack(losses)


def save_state(learners: Sequence[Learner], path: Path) -> None:
    """Write all networks, for an interrupted training."""
    from safetensors.torch import save

    tensors = {
        f"{name}.{key}": tensor.contiguous().cpu()
        for name, network in _parts(learners).items()
        for key, tensor in network.state_dict().items()
    }
    with atomic_write(path) as file:
        file.write(save(tensors))


def load_state(learners: Sequence[Learner], path: Path) -> None:
    """Go on with the networks of an interrupted training.

    Raises:
        InputError: the file is damaged, or of networks of other shapes.
    """
    from safetensors.torch import load

    try:
        tensors = load(path.read_bytes())
        for name, network in _parts(learners).items():
            prefix = f"{name}."
            own = {k.removeprefix(prefix): w for k, w in tensors.items() if k.startswith(prefix)}
            network.load_state_dict(own)
    except Exception:  # a damaged file can fail anywhere
        raise InputError(
            f"{short_name(path)}: expected an interrupted training of this network, got a"
            " damaged file or another network; delete it to begin anew"
        ) from None


def save_policy(learner: Learner, path: str | Path, task: str, camera: PinholeCamera) -> None:
    """Write the averaged network's weights in half precision, with what it was trained for."""
    from safetensors.torch import save

    source = json.dumps({"schedule": asdict(learner.schedule), "steps": learner.trained.steps})
    record = PolicyRecord(asdict(learner.shape), task, camera.fx / camera.width, source)
    weights = learner.average.weights()
    if learner.masks is not None:
        average = learner.masks.trained.average
        assert isinstance(average, MaskNetwork)
        weights |= average.weights()
    tensors = {name: w.half() for name, w in weights.items()}
    with atomic_write(path) as file:
        file.write(save(tensors, {"policy": json.dumps(asdict(record))}))


def _parts(learners: Sequence[Learner]) -> dict[str, Any]:
    """The networks of learners, by the names of their files' parts."""
    trained = {learner.name: learner.trained for learner in learners}
    trained.update((FINDER, each.masks.trained) for each in learners if each.masks is not None)
    each = ("network", "average")
    return {f"{name}.{part}": getattr(t, part) for name, t in trained.items() for part in each}
