"""Training loop: initial state, photos and a renderer -> state whose renders match the photos.

[3] Kerbl et al. 2023, 3D Gaussian Splatting; [K] Kheradmand et al. 2024, 3DGS as Markov Chain Monte
Carlo; [P] Park et al. 2025, DropGaussian.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.tools.capture.training.densify import add_noise, densify
from falconwing_kit.tools.capture.training.draw import Draw, apply_twists
from falconwing_kit.tools.capture.training.photos import Photos
from falconwing_kit.tools.capture.training.state import TrainState
from falconwing_kit.vision.ssim import C1, C2, RADIUS_PX, SIGMA_PX

# learning rates of 3D Gaussian Splatting; that of the means is in extents of the scene
RATES = {
    **{
        "means": 1.6e-4,
        "quaternions": 1e-3,
        "log_scales": 5e-3,
        "logits": 5e-2,
        "dc": 2.5e-3,
        "rest": 1.25e-4,
    },
    **{"exposures": 1e-3, "twists": 1e-5},
}
MEANS_DECAY, OTHERS_DECAY = 0.01, 0.1  # final share of the rate; others over the last third only
FULL_SH_FROM = 0.03  # progress from which colours depend on the direction
SHORT_STEPS = 3000  # steps; a shorter training has larger learning rates
# progress between which Gaussians are added and relocated [K: 500 to 25,000 of 30,000 steps]
GROW_FROM, GROW_UNTIL = 0.015, 0.83
DENSIFY_COUNT = 300  # densifications over the whole training [K: every 100 of 30,000 steps]
REGULARISATION = {"exposures": 1.0, "twists": 100.0}  # weights of the mean squares


@dataclass(frozen=True)
class TrainConfig:
    """Configuration of the training loop."""

    gaussians: int  # maximum number
    steps: int
    batch: int  # photos a step
    sh_degree: int
    antialiased: bool
    exposures: bool  # learn gains and offsets of each photo
    poses: bool  # learn small corrections of the photos' poses
    ssim_weight: float  # of 1 - SSIM against the mean absolute error [3: 0.2]
    opacity_cost: float  # [K: 0.01]
    scale_cost: float  # [K: 0.01]
    largest: float  # maximum standard deviation of a Gaussian [m]; 0: unlimited
    dropout: float  # share of the Gaussians dropped at the end [P: 0.2]
    seconds: float  # time limit; the schedule is shortened to end within it
    low: Array  # (3,) corners of the scene's bounding box [m]
    high: Array
    extent: float  # size of the space the photos were taken from [m]
    seed: int


def train(
    state: TrainState,
    photos: Photos,
    draw: Draw,
    config: TrainConfig,
    *,
    save_state: Callable[[TrainState], None] = lambda _: None,
    log: Callable[[TrainState, float], None] = lambda *_: None,
) -> TrainState:
    """Train until the steps are done or the time is up.

    The random numbers of a step depend on the seed and the step's number only, so a resumed
    training gives the same result as one without interruption.

    Args:
        state: initial or loaded; changed in place.
        draw: the renderer.
        save_state: called after each tenth of the steps, for checkpoints.
        log: called with the state and the last loss after each twentieth of the steps.

    Raises:
        InputError: the GPU's memory does not suffice.
    """
    every, spent, start = max(1, config.steps // 20), state.seconds, time.monotonic()
    try:
        while (progress := max(state.step / config.steps, state.seconds / config.seconds)) < 1.0:
            loss = train_step(state, photos, draw, config, progress)
            state.step += 1
            state.seconds = spent + time.monotonic() - start
            if state.step % every == 0:
                log(state, float(loss))
            if state.step % (2 * every) == 0:
                save_state(state)
    except torch.cuda.OutOfMemoryError:
        raise InputError(
            f"GPU memory: expected room for {len(state.values['means'])} Gaussians and "
            f"{config.batch} photos a step, got too "
            "little; give a smaller --batch, --width or --gaussians"
        ) from None
    save_state(state)
    return state


def train_step(
    state: TrainState, photos: Photos, draw: Draw, config: TrainConfig, progress: float
) -> Tensor:
    """One optimisation step: render a batch, compare with the photos, update all parameters.

    Args:
        state: changed in place.
        progress: 0..1, sets the learning rates and when Gaussians are added.

    Returns:
        The loss before the step.
    """
    device = state.values["means"].device
    generator = torch.Generator(device).manual_seed(1_000_003 * config.seed + state.step)
    numbers = torch.as_tensor(_batch(state.step, config, len(photos)), device=device)
    # gradients of the loss with respect to every parameter that is optimised
    names = [
        name for name, learns in _learnable(config).items() if learns and state.values[name].numel()
    ]
    for name in names:
        state.values[name].requires_grad_(True)
    total = loss(state, photos, draw, config, progress, numbers, generator)
    gradients = torch.autograd.grad(
        total, [state.values[name] for name in names], allow_unused=True
    )
    for name in names:
        state.values[name] = state.values[name].detach()
    # Adam, densification, noise, and the limits of position and size
    rates = _rates(config, progress)
    with torch.no_grad():
        state.adam(dict(zip(names, gradients, strict=True)), rates)
        if (
            GROW_FROM < progress < GROW_UNTIL
            and state.step % max(1, config.steps // DENSIFY_COUNT) == 0
        ):
            densify(state, config.gaussians, generator)
        add_noise(state, rates["means"], config.extent, generator)
        low, high = (
            torch.as_tensor(corner, dtype=torch.float32, device=device)
            for corner in (config.low, config.high)
        )
        state.values["means"].clamp_(low, high)
        if config.largest:
            state.values["log_scales"].clamp_(max=math.log(config.largest))
    return total.detach()


def loss(
    state: TrainState,
    photos: Photos,
    draw: Draw,
    config: TrainConfig,
    progress: float,
    numbers: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Training loss of a batch of photos.

    L = (1 - w) |render - photo| + w (1 - SSIM) [3, eq. 7] + opacity and size costs [K, eq. 10]
        + alpha error + regularisation of exposures and twists

    L = (1 - w) |render - photo| + w (1 - SSIM)  [3, eq. 7]  + costs of opacity and size  [K, eq.
    10]
        + alpha error + regularisation of exposures and twists

    The background has a random colour, so that holes in the scene cost something.

    Args:
        progress: 0..1, sets the SH degree and the dropout.
        numbers: (C,) which photos.
    """
    background = torch.rand(3, generator=generator, device=numbers.device)
    gaussians = state.gaussians(config.sh_degree if progress >= FULL_SH_FROM else 0)
    gaussians = gaussians._replace(
        opacities=drop_gaussians(gaussians.opacities, config.dropout * progress, generator)
    )
    # render with corrected poses and exposures
    exposures, twists = state.values["exposures"][numbers], state.values["twists"][numbers]
    poses = photos.Ts_world_camera[numbers]
    poses = (
        apply_twists(poses, twists * twist_scale(config.extent, twists)) if config.poses else poses
    )
    colours, alphas = draw(gaussians, photos.camera, poses, background, config.antialiased)
    if config.exposures:
        colours = colours * exposures[:, None, None, :3].exp() + exposures[:, None, None, 3:]
    # compare with the photos; outside the lens's image circle the error is 0
    targets, target_alphas = photos.targets(numbers, background)
    colours = torch.where(photos.inside[..., None], colours, targets)
    total = (1.0 - config.ssim_weight) * (colours - targets).abs().mean()
    total = total + config.ssim_weight * (1.0 - ssim_batch(colours, targets).mean())
    if target_alphas is not None:
        total = total + (alphas - target_alphas).abs().mean()
    total = (
        total
        + config.opacity_cost * gaussians.opacities.mean()
        + config.scale_cost * gaussians.scales.mean() / config.extent
    )
    return (
        total
        + REGULARISATION["exposures"] * (exposures**2).mean()
        + REGULARISATION["twists"] * (twists**2).mean()
    )


def ssim_batch(first: Tensor, second: Tensor) -> Tensor:
    """Differentiable structural similarity of colours 0..1  [Wang et al. 2004, eq. 13].

    Equals the mean of `vision.ssim` over the colours to 1e-5; the evaluation of a scene uses that.

    Args:
        first: (C, H, W, 3), sides of at least 11 px.
        second: likewise.

    Returns:
        (C,) mean over pixels and colours, 1 where the images are equal.
    """
    x, y = first.movedim(-1, 1), second.movedim(-1, 1)
    maps = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    down, across = (_window(length, first.device, first.dtype) for length in maps.shape[2:])
    maps = down.mT @ (maps @ across)
    mean_x, mean_y, xx, yy, xy = maps.chunk(5, dim=1)
    c1, c2 = C1 / 255.0**2, C2 / 255.0**2
    numerator = (2 * mean_x * mean_y + c1) * (2 * (xy - mean_x * mean_y) + c2)
    return (
        numerator / ((mean_x**2 + mean_y**2 + c1) * (xx - mean_x**2 + yy - mean_y**2 + c2))
    ).mean(dim=(1, 2, 3))


@lru_cache(maxsize=4)
def _window(length: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """(length, length - 10) matrix of the weighted means along a line.

    Not a convolution, since GPUs by default round a convolution's products to ten bits (TF32).
    """
    offsets = torch.arange(length)[:, None] - torch.arange(length - 2 * RADIUS_PX) - RADIUS_PX
    weights = torch.where(
        offsets.abs() <= RADIUS_PX, torch.exp(-0.5 * (offsets / SIGMA_PX) ** 2), 0.0
    )
    return (weights / weights.sum(dim=0)).to(device, dtype)


def drop_gaussians(opacities: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Dropout: opacities with a random share set to 0 and the others scaled up to compensate  [P].

    Without dropout, floaters that fit a single photo can hide behind other Gaussians.

    Args:
        opacities: (N,) 0..1.
        share: to drop, below 1.

    Returns:
        (N,) with the same expected value.
    """
    if share == 0.0:
        return opacities
    stay = torch.rand(opacities.shape, generator=generator, device=opacities.device) >= share
    return opacities * stay / (1.0 - share)


def twist_scale(extent: float, like: Tensor) -> Tensor:
    """(6,) units of the state's twists: rotations in rad, translations in scene extents [m]."""
    return like.new_tensor([1.0, 1.0, 1.0, extent, extent, extent])


def _learnable(config: TrainConfig) -> dict[str, bool]:
    """Which parameters are optimised."""
    return {name: True for name in RATES} | {"exposures": config.exposures, "twists": config.poses}


def _rates(config: TrainConfig, progress: float) -> dict[str, float]:
    """Learning rates, scaled with the root of the batch size [Malladi et al. 2022, for Adam]."""
    pace = (config.batch * max(1.0, SHORT_STEPS / config.steps)) ** 0.5
    decay = pace * OTHERS_DECAY ** max(0.0, 3.0 * progress - 2.0)
    rates = {name: rate * decay for name, rate in RATES.items()}
    return rates | {"means": RATES["means"] * config.extent * pace * MEANS_DECAY**progress}


def _batch(number: int, config: TrainConfig, photos: int) -> list[int]:
    """Photo numbers of a step: every photo once per epoch, in a random order."""
    places = range(number * config.batch, (number + 1) * config.batch)
    orders = {
        turn: np.random.default_rng([config.seed, turn]).permutation(photos)
        for turn in {p // photos for p in places}
    }
    return [int(orders[place // photos][place % photos]) for place in places]
