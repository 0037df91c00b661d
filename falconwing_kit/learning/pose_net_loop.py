"""Training loop of a pose net: a network, a source of views and the losses of pose and points ->
the trained network.

Views are rendered during the training: a pool holds the newest ones, each step draws a batch from
it and randomises the appearance, so that no image is repeated exactly. An interrupted training is
resumed from its saved state.
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
SHARES = ("photo_share", "near_share", "leader_share", "approach_share")  # of the training views
WARMUP = 0.03  # share of the training over which the learning rate rises
COOLDOWN = 0.01  # share of the learning rate at the end
POINTS_WEIGHT, FUSED_WEIGHT = 1.0, 0.5  # of the losses, relative to the pose token's
FUSED_FROM = 0.1  # share of the training before the fused pose is trained: it is random at first
MIN_CLEAR_SHARE = 0.7  # of a cell's pixels without occluder; below, its point is not trained
LOG_PERIOD_STEPS = 100
EMA_DECAY = 0.999  # of the exponential moving average of the weights
MAX_GRADIENT_NORM = 1.0
SAVE_PERIOD_S = 60.0
LogFunction = Callable[[dict[str, float]], None]


@dataclass(frozen=True)
class TrainSchedule:
    """Length and hyperparameters of a training, which ends after steps or minutes."""

    steps: int = 1_000_000
    minutes: float = 8.0
    batch: int = 256
    fresh: int = 64  # new views tried in each step
    pool: int = 40_000  # views kept; the oldest are replaced
    first: int = 4096  # views before the first step
    rate: float = 1e-3  # learning rate of AdamW
    decay: float = 0.05  # weight decay
    seed: int = 0


class ViewPool:
    """Ring buffer of views on the device: new ones replace the oldest."""

    def __init__(self, world: ViewSource, size: int, rng: np.random.Generator) -> None:
        self.world, self.size, self.rng, self.count, self._next = world, size, rng, 0, 0
        self._views: Views | None = None

    def grow(self, count: int) -> None:
        """Sample `count` new views, of which some may be rejected.

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
        added = torch.arange(len(views.images), device=views.images.device)
        slots = (self._next + added) % self.size
        for part, new in zip(self._views, views, strict=True):
            part[slots] = new
        self._next = (self._next + len(slots)) % self.size
        self.count = min(self.count + len(slots), self.size)

    def draw(self, count: int, generator: torch.Generator) -> Views:
        """Random views of the pool, drawn with replacement."""
        if self._views is None:
            raise InputError("pool: expected views before a draw, got none; call grow first")
        rows = torch.randint(self.count, (count,), generator=generator, device=generator.device)
        return Views(*(part[rows] for part in self._views))


def losses(
    output: PoseNetOutput, views: Views, clear: Tensor, rays: Tensor, log_trust: Tensor
) -> dict[str, Tensor]:
    """Training losses: negative log likelihoods up to constants.

    token   Gaussian in position and in sine and cosine, each with its stated sigma
    points  Student's t in each cell's point: p(e) ~ sigma^-3 (1 + e^2 / (nu sigma^2))^-(nu + 3)/2
    fused   Student's t in the six parameters of the fused pose, with its own information matrix

    Token and points are weighted by their stated sigma [Seitzer et al. 2022, beta-NLL with beta =
    1/2]. That does not change the optimum; without it the position, which is uncertain at first,
    hardly trains.

    Args:
        output: of the network for B images.
        views: the truth about them.
        clear: (B, H, W) mask of pixels without occluder.
        rays: (K, 3) unit directions of the cells in camera axes.
        log_trust: the network's.

    Returns:
        token, points, fused; position and rotation: the token's mean errors [m, rad].
    """
    R, position = views.Ts_world_camera[:, :3, :3], views.Ts_world_camera[:, :3, 3]
    # token: position
    error = output.position - position
    nll_position = (
        0.5 * (error * torch.exp(-output.log_sigma_position)) ** 2 + output.log_sigma_position
    )
    nll_position = nll_position * torch.exp(output.log_sigma_position.detach())
    # token: angles, from the columns of R (right wing, belly, nose)
    nose, wing_z, belly_z = R[:, :, 2], R[:, 2, 0], R[:, 2, 1]
    angles = torch.stack(
        [
            torch.atan2(-wing_z, -belly_z),
            torch.asin(nose[:, 2].clamp(-1, 1)),
            torch.atan2(-nose[:, 1], nose[:, 0]),
        ],
        dim=1,
    )
    expected = torch.stack([angles.sin(), angles.cos()], dim=-1)
    squares = ((output.sincos - expected) ** 2).sum(dim=(1, 2))
    chi2 = squares * torch.exp(-2.0 * output.log_sigma_angle)
    nll_turn = 0.5 * chi2 + 3.0 * output.log_sigma_angle
    nll_turn = nll_turn * torch.exp(output.log_sigma_angle.detach())
    loss = {
        "token": (nll_position.sum(dim=1) + nll_turn).mean(),
        "points": _points_loss(output, views, clear, rays),
    }
    # fused pose: Mahalanobis distance and log determinant of its information
    R_fused, position_fused, information = fuse_pose(output, rays, log_trust)
    error_fused = torch.cat([position_fused - position, so3_log_between(R_fused, R)], dim=1)
    square = torch.einsum("bi,bij,bj->b", error_fused, information, error_fused)
    logdet = 2.0 * torch.linalg.cholesky_ex(information).L.diagonal(dim1=1, dim2=2).log().sum(-1)
    tail = 0.5 * (STUDENT_T_DOF + 6.0) * torch.log1p(square / STUDENT_T_DOF)
    loss["fused"] = (tail - 0.5 * logdet).mean()
    loss["position"] = error.detach().norm(dim=1).mean()
    loss["rotation"] = so3_log_between(rotations(output.sincos.detach()), R).norm(dim=1).mean()
    return loss


def _points_loss(output: PoseNetOutput, views: Views, clear: Tensor, rays: Tensor) -> Tensor:
    """Loss of the scene coordinates, averaged over the cells that show the hall."""
    clear_share = functional.avg_pool2d(clear.float(), CELL).flatten(1)
    valid = ((views.depths > 0.0) & (clear_share > MIN_CLEAR_SHARE)).float()
    # true points (B, K, 3): the rays in world axes, as long as the depths require
    length = views.depths[..., None] / rays[:, 2:]
    rays_world = rays @ views.Ts_world_camera[:, :3, :3].mT
    true_points = views.Ts_world_camera[:, None, :3, 3] + length * rays_world
    chi2 = ((output.points - true_points) ** 2).sum(-1) * torch.exp(-2.0 * output.log_sigma_points)
    tail = 0.5 * (STUDENT_T_DOF + 3.0) * torch.log1p(chi2 / STUDENT_T_DOF)
    nll = (tail + 3.0 * output.log_sigma_points) * torch.exp(output.log_sigma_points.detach())
    return (nll * valid).sum() / valid.sum().clamp(min=1.0)


class PoseNetTrainer:
    """A network in training; `run` trains it to the end of the plan.

    Args:
        network: on the device of `world`.
        world: source of views.
        plan: length and hyperparameters.
        folder: for the state of an interrupted training; None saves none.
        start: names the weights the network begins from; a state of others is refused.
    """

    def __init__(
        self,
        network: PoseNetwork,
        world: ViewSource,
        plan: TrainSchedule,
        folder: Path | None = None,
        start: str = "",
    ) -> None:
        self.network, self.world, self.plan, self.folder = network, world, plan, folder
        self.average = deepcopy(network)
        self.rays = torch.from_numpy(cell_rays(world.camera)).float().to(world.device)
        self.adam = torch.optim.AdamW(
            network.parameters(), lr=plan.rate, weight_decay=plan.decay, betas=(0.9, 0.98)
        )
        self.step, self.seconds = 0, 0.0
        views = {name: getattr(world, name) for name in SHARES}
        views |= {"box": np.array([world.low, world.high]).tolist()}
        self.settings = json.dumps([asdict(plan), asdict(network.shape), views, start])

    @property
    def progress(self) -> float:
        """0 at the start, 1 at the end."""
        return min(1.0, max(self.step / self.plan.steps, self.seconds / (60.0 * self.plan.minutes)))

    def run(self, log: LogFunction = lambda _: None) -> PoseNetwork:
        """Train to the end, from a saved state if there is one.

        Returns:
            The network with the moving average of its weights.

        Raises:
            InputError: the saved state belongs to another training, or no view shows the hall.
        """
        self._resume()
        device, before, saved = self.world.device, self.seconds, self.seconds
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
            if self.step % LOG_PERIOD_STEPS == 0:
                log({name: float(value) for name, value in figures.items()} | {"views": pool.count})
            is_due = self.seconds > saved + SAVE_PERIOD_S or self.progress >= 1.0
            if self.folder is not None and is_due:
                self._save_state(self.folder)
                saved = self.seconds
        return self.average.eval()

    def _train_step(self, views: Views, generator: torch.Generator) -> dict[str, Tensor]:
        """One step of AdamW: warm-up, cosine decay, clipped gradient."""
        progress, device = self.progress, self.world.device
        rise = min(1.0, (progress + 1e-4) / WARMUP)
        fall = 0.5 * (1.0 + math.cos(math.pi * progress))
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
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), MAX_GRADIENT_NORM)
        if torch.isfinite(norm):  # a nan would destroy the network
            self.adam.step()
        self.step += 1
        self._average()
        return {name: value.detach() for name, value in loss.items()}

    @torch.no_grad()
    def _average(self) -> None:
        """Update the moving average; its decay is smaller in the first steps."""
        ema_decay = min(EMA_DECAY, (1.0 + self.step) / (10.0 + self.step))
        weights = self.network.state_dict()
        for name, tensor in self.average.state_dict().items():
            if tensor.is_floating_point():
                tensor.lerp_(weights[name], 1.0 - ema_decay)
            else:
                tensor.copy_(weights[name])  # counters of batch normalisation

    def _save_state(self, folder: Path) -> None:
        """Write networks, moments of Adam, and progress to the folder."""
        tensors = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        tensors |= {f"average.{name}": tensor for name, tensor in self.average.state_dict().items()}
        for number, moments in self.adam.state_dict()["state"].items():
            tensors |= {f"adam.{number}.{name}": tensor for name, tensor in moments.items()}
        tensors = {name: tensor.contiguous().cpu() for name, tensor in tensors.items()}
        metadata = {"settings": self.settings, "step": str(self.step), "seconds": str(self.seconds)}
        with atomic_write(folder / STATE) as file:
            file.write(save(tensors, metadata))

    def _resume(self) -> None:
        """Load the saved state, if there is one."""
        saved_state = None if self.folder is None else self.folder / STATE
        if saved_state is None or not saved_state.is_file():
            return
        name = short_name(saved_state)
        try:
            metadata, tensors = _metadata(saved_state), load_file(saved_state)
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
    """Metadata of a safetensors file: 8 bytes of length, then a JSON header."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        return dict(json.loads(file.read(length))["__metadata__"])
