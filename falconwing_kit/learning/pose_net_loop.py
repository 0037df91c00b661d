"""The training loop of a pose net: a network and a world to look at -> the trained network.

It renders while it learns: a pool holds the newest views, each step draws a batch from it and gives
every image another appearance, so that no image is seen twice as it was. An interrupted training
goes on where it was.
"""

import json
import math
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save
from torch import Tensor
from torch.nn import functional

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.learning.appearance import randomise_appearance
from falconwing_kit.learning.pose_views import Views, ViewSource, sample_views
from falconwing_kit.vision.pose_net import cell_rays
from falconwing_kit.vision.pose_network import (
    CELL,
    STUDENT_T_DOF,
    PoseNetOutput,
    PoseNetwork,
    fuse_pose,
    rotations,
    so3_log_between,
)

STATE = "training.safetensors"
WARMUP, COOLDOWN = (
    0.03,
    0.01,
)  # share of the way over which the rate rises; what is left of it at the end
POINTS_WEIGHT, FUSED_WEIGHT = 1.0, 0.5  # of the losses against the pose token's
# share of the way after which the fused pose is trained too: before, cells and token disagree
# wildly
FUSED_FROM = 0.1
EMA_DECAY = 0.999  # how long the average over the weights looks back, once it can
MAX_GRADIENT_NORM = 1.0  # of the gradient's length
SAVE_PERIOD_S = 60.0  # between two saved states
LogFunction = Callable[[dict[str, float]], None]


@dataclass(frozen=True)
class TrainSchedule:
    """How long and how to train."""

    steps: int = (
        1_000_000  # at most; the rate falls towards whichever comes first, steps or minutes
    )
    minutes: float = 8.0
    batch: int = 256
    fresh: int = 64  # new views tried a step
    pool: int = 40_000  # views kept to learn from; the oldest go first
    first: int = 4096  # views before the first step
    rate: float = 1e-3  # of AdamW
    decay: float = 0.05
    seed: int = 0


class ViewPool:
    """Views on the device, a ring in which new ones take the place of the oldest."""

    def __init__(self, world: ViewSource, size: int, rng: np.random.Generator) -> None:
        self.world, self.size, self.rng, self.count, self._next = world, size, rng, 0, 0
        self._views: Views | None = None

    def grow(self, count: int) -> None:
        """Try so many new views.

        Raises:
            InputError: no view shows the hall.
        """
        views = sample_views(self.world, count, self.rng)
        if self._views is None:
            if len(views.images) == 0:
                raise InputError(
                    "scene: expected views that show a hall, got none; check its box and units"
                )
            self._views = Views(*(part.new_empty(self.size, *part.shape[1:]) for part in views))
        slots = (
            self._next + torch.arange(len(views.images), device=views.images.device)
        ) % self.size
        for part, new in zip(self._views, views, strict=True):
            part[slots] = new
        self._next = (self._next + len(slots)) % self.size
        self.count = min(self.count + len(slots), self.size)

    def draw(self, count: int, generator: torch.Generator) -> Views:
        """So many of the views, some perhaps twice."""
        if self._views is None:
            raise InputError(
                "pool: expected views in it before any are drawn, got none; let it grow first"
            )
        rows = torch.randint(self.count, (count,), generator=generator, device=generator.device)
        return Views(*(part[rows] for part in self._views))


def losses(
    output: PoseNetOutput, views: Views, clear: Tensor, rays: Tensor, log_trust: Tensor
) -> dict[str, Tensor]:
    """What the network is trained to make small; all are negative log likelihoods but for
    constants.

    token   Gaussian in place and in sine and cosine, each with its stated sigma
    points  Student's t in each cell's point: p(e) ~ sigma^-3 (1 + e^2 / (nu sigma^2))^-(nu + 3)/2
    fused   Student's t in the six numbers of the fused pose, with its own information matrix

    Token and points are weighted by their stated sigma [Seitzer et al. 2022, beta-NLL with beta =
    1/2], which leaves the best answers and sigmas where they are; without it what is uncertain at
    first, the place, hardly learns.

    Args:
        answer: about B images.
        views: what they are.
        clear: (B, H, W) where nothing was put before the hall.
        rays: (K, 3) unit, in camera axes.
        log_trust: the network's.

    Returns:
        token, points, fused, and turn and place, the token's mean errors [rad, m].
    """
    R, place = views.Ts_world_camera[:, :3, :3], views.Ts_world_camera[:, :3, 3]
    off = output.place - place
    nll_place = 0.5 * (off * torch.exp(-output.log_sigma_place)) ** 2 + output.log_sigma_place
    nll_place = nll_place * torch.exp(output.log_sigma_place.detach())
    nose, wing_z, belly_z = R[:, :, 2], R[:, 2, 0], R[:, 2, 1]
    angles = torch.stack(
        [
            torch.atan2(-wing_z, -belly_z),
            torch.asin(nose[:, 2].clamp(-1, 1)),
            torch.atan2(-nose[:, 1], nose[:, 0]),
        ],
        dim=1,
    )
    wanted = torch.stack([angles.sin(), angles.cos()], dim=-1)
    squares = ((output.sincos - wanted) ** 2).sum(dim=(1, 2))
    nll_turn = (
        0.5 * squares * torch.exp(-2.0 * output.log_sigma_angle) + 3.0 * output.log_sigma_angle
    )
    nll_turn = nll_turn * torch.exp(output.log_sigma_angle.detach())
    loss = {
        "token": (nll_place.sum(dim=1) + nll_turn).mean(),
        "points": _points_loss(output, views, clear, rays),
    }
    R_fused, place_fused, information = fuse_pose(output, rays, log_trust)
    error = torch.cat([place_fused - place, so3_log_between(R_fused, R)], dim=1)
    square = torch.einsum("bi,bij,bj->b", error, information, error)
    logdet = 2.0 * torch.linalg.cholesky_ex(information).L.diagonal(dim1=1, dim2=2).log().sum(-1)
    loss["fused"] = (
        0.5 * (STUDENT_T_DOF + 6.0) * torch.log1p(square / STUDENT_T_DOF) - 0.5 * logdet
    ).mean()
    loss["place"] = off.detach().norm(dim=1).mean()
    loss["turn"] = so3_log_between(rotations(output.sincos.detach()), R).norm(dim=1).mean()
    return loss


def _points_loss(output: PoseNetOutput, views: Views, clear: Tensor, rays: Tensor) -> Tensor:
    """The cells' part of the loss, over the cells that show the hall."""
    share = functional.avg_pool2d(clear.float(), CELL).flatten(1)
    counts = ((views.depths > 0.0) & (share > 0.7)).float()
    reach = views.depths[..., None] / rays[:, 2:]
    points = views.Ts_world_camera[:, None, :3, 3] + reach * (
        rays @ views.Ts_world_camera[:, :3, :3].mT
    )
    squares = ((output.points - points) ** 2).sum(-1) * torch.exp(-2.0 * output.log_sigma_points)
    nll = (
        0.5 * (STUDENT_T_DOF + 3.0) * torch.log1p(squares / STUDENT_T_DOF)
        + 3.0 * output.log_sigma_points
    )
    nll = nll * torch.exp(output.log_sigma_points.detach())
    return (nll * counts).sum() / counts.sum().clamp(min=1.0)


class PoseNetTrainer:
    """A network in training; `run` takes it to the end of the plan.

    Args:
        network: to train, on the world's device.
        world: what to look at.
        rays: (K, 3) of the network's cells, see `cell_rays`.
        plan: how long.
        folder: where the state is kept between runs; None keeps none.
    """

    def __init__(
        self,
        network: PoseNetwork,
        world: ViewSource,
        plan: TrainSchedule,
        folder: Path | None = None,
    ) -> None:
        self.network, self.world, self.plan, self.folder = network, world, plan, folder
        self.average = deepcopy(network)
        self.rays = torch.from_numpy(cell_rays(world.camera)).float().to(world.device)
        self.adam = torch.optim.AdamW(
            network.parameters(), lr=plan.rate, weight_decay=plan.decay, betas=(0.9, 0.98)
        )
        self.step, self.seconds = 0, 0.0
        self.settings = json.dumps([asdict(plan), asdict(network.shape)])

    @property
    def progress(self) -> float:
        """0 at the start, 1 at the end."""
        return min(1.0, max(self.step / self.plan.steps, self.seconds / (60.0 * self.plan.minutes)))

    def run(self, log: LogFunction = lambda _: None) -> PoseNetwork:
        """Train to the end, from a kept state where there is one.

        Returns:
            The network with the average of its last weights.

        Raises:
            InputError: the kept state belongs to another training, or the scene shows nothing.
        """
        self._resume()
        device, before, kept = self.world.device, self.seconds, self.seconds
        start = time.monotonic()
        generator = torch.Generator(device).manual_seed(self.plan.seed + self.step)
        pool = ViewPool(
            self.world, self.plan.pool, np.random.default_rng([self.plan.seed, self.step])
        )
        for _ in range(-(-self.plan.first // self.plan.fresh) if self.progress < 1.0 else 0):
            pool.grow(self.plan.fresh)
        while self.progress < 1.0:
            pool.grow(self.plan.fresh)
            figures = self._train_step(pool.draw(self.plan.batch, generator), generator)
            self.seconds = before + time.monotonic() - start
            if self.step % 100 == 0:
                log({name: float(value) for name, value in figures.items()} | {"views": pool.count})
            if self.folder is not None and (
                self.seconds > kept + SAVE_PERIOD_S or self.progress >= 1.0
            ):
                self._save_state(self.folder)
                kept = self.seconds
        return self.average.eval()

    def _train_step(self, views: Views, generator: torch.Generator) -> dict[str, Tensor]:
        """One step."""
        progress, device = self.progress, self.world.device
        rise, fall = (
            min(1.0, (progress + 1e-4) / WARMUP),
            0.5 * (1.0 + math.cos(math.pi * progress)),
        )
        for group in self.adam.param_groups:
            group["lr"] = self.plan.rate * rise * (COOLDOWN + (1.0 - COOLDOWN) * fall)
        images, clear = randomise_appearance(views.images.float() / 255.0, generator)
        self.network.train()
        with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=device != "cpu"):
            output = self.network(images.to(memory_format=torch.channels_last))
        loss = losses(output, views, clear, self.rays, self.network.log_trust)
        total = loss["token"] + POINTS_WEIGHT * loss["points"]
        if progress > FUSED_FROM:
            total = total + FUSED_WEIGHT * loss["fused"]
        self.adam.zero_grad(set_to_none=True)
        total.backward()
        length = torch.nn.utils.clip_grad_norm_(self.network.parameters(), MAX_GRADIENT_NORM)
        if torch.isfinite(length):  # a step into nowhere would spoil all that was learnt
            self.adam.step()
        self.step += 1
        self._average()
        return {name: value.detach() for name, value in loss.items()}

    @torch.no_grad()
    def _average(self) -> None:
        """Take the new weights into the average; the first ones do not linger in it."""
        ema_decay = min(EMA_DECAY, (1.0 + self.step) / (10.0 + self.step))
        own, average = self.network.state_dict(), self.average.state_dict()
        for name, tensor in average.items():
            if tensor.is_floating_point():
                tensor.lerp_(own[name], 1.0 - ema_decay)
            else:
                tensor.copy_(own[name])

    def _save_state(self, folder: Path) -> None:
        """Write the state, whole or not at all."""
        tensors = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        tensors |= {f"average.{name}": tensor for name, tensor in self.average.state_dict().items()}
        for number, moments in self.adam.state_dict()["state"].items():
            tensors |= {f"adam.{number}.{name}": tensor for name, tensor in moments.items()}
        metadata = {"settings": self.settings, "step": str(self.step), "seconds": str(self.seconds)}
        with atomic_write(folder / STATE) as file:
            file.write(
                save(
                    {name: tensor.contiguous().cpu() for name, tensor in tensors.items()}, metadata
                )
            )

    def _resume(self) -> None:
        """Take up the kept state, if there is one."""
        path = None if self.folder is None else self.folder / STATE
        if path is None or not path.is_file():
            return
        name = short_name(path)
        try:
            metadata, tensors = _metadata(path), load_file(path)
        except Exception:  # a damaged file can fail anywhere
            raise InputError(
                f"{name}: expected an interrupted training, got a damaged file; delete it"
            ) from None
        if metadata.get("settings") != self.settings:
            raise InputError(
                f"{name}: expected the settings of the interrupted training, got others; delete it"
            )
        for kind, module in (("network.", self.network), ("average.", self.average)):
            module.load_state_dict(
                {k.removeprefix(kind): t for k, t in tensors.items() if k.startswith(kind)}
            )
        adam = self.adam.state_dict()
        for key in filter(lambda key: key.startswith("adam."), tensors):
            _, number, moment = key.split(".")
            adam["state"].setdefault(int(number), {})[moment] = tensors[key]
        self.adam.load_state_dict(adam)
        self.step, self.seconds = int(metadata["step"]), float(metadata["seconds"])


def _metadata(path: Path) -> dict[str, str]:
    """What a safetensors file says about itself."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        return dict(json.loads(file.read(length))["__metadata__"])
