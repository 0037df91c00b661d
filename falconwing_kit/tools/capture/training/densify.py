"""Densification: Gaussians in training -> dead ones relocated, new ones added, noise injected.

[K] Kheradmand et al. 2024, 3D Gaussian Splatting as Markov Chain Monte Carlo: Gaussians are samples
of a distribution. Dead (transparent) ones are relocated to live ones, new ones are copies of live
ones, and faint ones explore by noise. Relocation leaves the rendered image unchanged.
"""

import math

import torch
from torch import Tensor

from falconwing_kit.scene.reference import covariances
from falconwing_kit.tools.capture.training.state import GAUSSIAN_PARAMETERS, TrainState

MIN_OPACITY = 0.005  # [K, section 3.3]
GROWTH = 1.05  # maximum growth factor per densification [K]
NOISE_SCALE = 5e5  # noise of faint Gaussians, in learning rates of the means [K]
NOISE_STEEPNESS = 100.0  # of the sigmoid between faint and solid Gaussians [K, eq. 8]
MAX_COPIES = 51  # of one Gaussian per densification
_X = torch.linspace(-4.0, 4.0, 129, dtype=torch.float64)  # exp(-x^2) is negligible beyond


@torch.no_grad()
def densify(state: TrainState, cap: int, generator: torch.Generator) -> None:
    """Relocate dead Gaussians to live ones, then add new ones up to a cap; sampled by opacity.

    Args:
        state: changed in place.
        cap: maximum number of Gaussians.
    """
    opacities = torch.sigmoid(state.values["logits"])
    dead = (opacities <= MIN_OPACITY).nonzero()[:, 0]
    live = (opacities > MIN_OPACITY).nonzero()[:, 0]
    if len(live) == 0:
        return
    if len(dead):
        _relocate(state, live[_sample(opacities[live], len(dead), generator)], dead)
    count = len(opacities)
    new = min(cap, int(GROWTH * count) + 1) - count
    if new > 0:
        chosen = _sample(torch.sigmoid(state.values["logits"]), new, generator)
        for moments in (state.values, state.first, state.second):
            for name in GAUSSIAN_PARAMETERS:
                moments[name] = torch.cat([moments[name], moments[name][chosen]])
        _relocate(state, chosen, torch.arange(count, count + new, device=chosen.device))


@torch.no_grad()
def add_noise(state: TrainState, rate: float, extent: float, generator: torch.Generator) -> None:
    """Langevin noise (SGLD): perturb Gaussians along their covariance, faint ones most  [K, eq. 8]

    mean += noise rate / extent^2 * sigmoid(-100 (opacity - 0.005)) Sigma eta,  eta standard normal

    Args:
        state: changed in place.
        rate: learning rate of the means [m].
        extent: of the scene [m]; the paper's constants are for an extent of about 1.
    """
    values = state.values
    opacities = torch.sigmoid(values["logits"])
    faint = torch.sigmoid(-NOISE_STEEPNESS * (opacities - MIN_OPACITY))
    eta = torch.randn(values["means"].shape, generator=generator, device=opacities.device)
    along = (covariances(values["quaternions"], values["log_scales"].exp()) @ eta[:, :, None])[
        :, :, 0
    ]
    values["means"] += (NOISE_SCALE * rate / extent**2) * faint[:, None] * along


def relocation(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale factor of n copies that together render like the original  [K, eq. 9].

    (1 - o_new)^n = 1 - o, and the integral of alpha along a line through the centre is conserved:
    o integral exp(-x^2) dx = factor * integral (1 - (1 - o_new exp(-x^2))^n) dx
    (the paper's sum in closed form).

    Args:
        opacities: (N,) o, of the original, 0..1.
        copies: (N,) n, the original counted.

    Returns:
        o_new (N,) and factor (N,).
    """
    old, n = opacities.double().clamp(max=1.0 - 1e-6), copies.double().clamp(max=MAX_COPIES)
    new = -torch.expm1(torch.log1p(-old) / n)
    x = _X.to(old.device)
    together = 1.0 - (1.0 - new[:, None] * torch.exp(-x * x)) ** n[:, None]
    factor = old * math.sqrt(math.pi) / torch.trapezoid(together, x, dim=1)
    return new.to(opacities.dtype), factor.to(opacities.dtype)


def _sample(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(count,) indices sampled in proportion to the weights, with replacement."""
    return torch.multinomial(weights, count, replacement=True, generator=generator)


def _relocate(state: TrainState, sources: Tensor, targets: Tensor) -> None:
    """Copy each source to its target with shared opacity, and reset Adam's moments of both."""
    values = state.values
    copies = 1 + torch.bincount(sources, minlength=len(values["means"]))
    opacities, factors = relocation(torch.sigmoid(values["logits"][sources]), copies[sources])
    values["logits"][sources] = torch.logit(opacities.clamp(MIN_OPACITY, 1.0 - 1e-6))
    values["log_scales"][sources] += factors.log()[:, None]
    for name in GAUSSIAN_PARAMETERS:
        values[name][targets] = values[name][sources]
        for moments in (state.first, state.second):
            moments[name][sources] = 0.0
            moments[name][targets] = 0.0
