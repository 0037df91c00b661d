"""Appearance: clean renders -> what other light, other lenses, a video link and things in the way
may make of them.

All of it is drawn per image, works on a whole batch at once on a CPU or a GPU, and is simulated.
How far it reaches was chosen to cover more than one hall and camera show, not fitted to any photo.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

KERNEL = 7  # px of a blur
CHROMA_BLUR = 0.7 ** torch.arange(9.0)  # how a decoder drags colours to the right, pixel by pixel
OCCLUDERS = 2  # most things in the way at once
LUMA = (0.299, 0.587, 0.114)  # of red, green, blue [ITU-R BT.601]


def randomise_appearance(images: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Other light and colours, occluders, blur, and for half of the images an analog link.

    Args:
        images: (B, 3, H, W) red, green, blue in 0..1.
        generator: draws, on the images' device.

    Returns:
        (B, 3, H, W) in 0..1, and where (B, H, W) the hall is still seen.
    """
    images = vary_lighting(images, generator)
    images, clear = add_occluders(images, generator)
    images = add_blur(images, generator)
    analog = _uniform(len(images), generator, 0.0, 1.0) < 0.5
    images = torch.where(analog, analog_link(images, generator), images)
    noise = _uniform(len(images), generator, 0.0, 0.03) * _normal(images.shape, generator)
    return (images + noise).clamp(0.0, 1.0), clear


def vary_lighting(images: Tensor, generator: torch.Generator) -> Tensor:
    """Exposure, gamma, contrast, saturation, white balance, and light that varies smoothly over the
    image.
    """
    count = len(images)
    patches = 0.15 * _normal((count, 1, 3, 4), generator)
    field = functional.interpolate(patches, images.shape[2:], mode="bilinear", align_corners=True)
    gain = torch.exp(
        0.25 * _normal((count, 1, 1, 1), generator)
        + 0.04 * _normal((count, 3, 1, 1), generator)
        + field
    )
    images = (images * gain).clamp(1e-3, 1.0) ** torch.exp(
        0.2 * _normal((count, 1, 1, 1), generator)
    )
    grey = _luma(images)
    images = grey + _uniform(count, generator, 0.6, 1.3) * (images - grey)
    middle = images.mean(dim=(1, 2, 3), keepdim=True)
    contrast = torch.exp(0.15 * _normal((count, 1, 1, 1), generator))
    return (
        middle + contrast * (images - middle) + 0.02 * _normal((count, 3, 1, 1), generator)
    ).clamp(0.0, 1.0)


def add_occluders(images: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Ellipses of one colour with grain before a third of the images: people and things that were
    not there.
    """
    count, _, height, width = images.shape
    y = torch.linspace(0.0, 1.0, height, device=images.device)[:, None]
    x = torch.linspace(0.0, 1.0, width, device=images.device)
    hidden = torch.zeros(count, 1, height, width, dtype=torch.bool, device=images.device)
    for _ in range(OCCLUDERS):
        centre_x, centre_y, there = (_uniform(count, generator, 0.0, 1.0) for _ in range(3))
        half_x, half_y = (_uniform(count, generator, 0.02, 0.2) for _ in range(2))
        inside = ((x - centre_x) / half_x) ** 2 + ((y - centre_y) / half_y) ** 2 < 1.0
        inside = inside & (there < 0.2)
        colour = torch.rand(count, 3, 1, 1, generator=generator, device=images.device)
        colour = colour + 0.1 * _normal((count, 1, height, width), generator)
        images, hidden = torch.where(inside, colour, images), hidden | inside
    return images.clamp(0.0, 1.0), ~hidden[:, 0]


def add_blur(images: Tensor, generator: torch.Generator) -> Tensor:
    """Out of focus, and drawn out along some direction as by a turning camera: one Gaussian kernel
    per image.
    """
    count = len(images)
    reach = torch.arange(KERNEL, device=images.device) - KERNEL // 2
    angle = _uniform(count, generator, 0.0, math.pi)[:, 0]
    along = torch.cos(angle) * reach + torch.sin(angle) * reach[:, None]
    across = torch.cos(angle) * reach[:, None] - torch.sin(angle) * reach
    focus = (
        0.1 + 0.9 * torch.rand(count, 1, 1, generator=generator, device=images.device) ** 2
    )  # mostly sharp
    motion = focus + 1.8 * torch.rand(count, 1, 1, generator=generator, device=images.device) ** 4
    kernels = torch.exp(-0.5 * ((along / motion) ** 2 + (across / focus) ** 2))
    kernels = (kernels / kernels.sum(dim=(1, 2), keepdim=True))[:, None]
    edge = KERNEL // 2
    wide = functional.pad(images, (edge, edge, edge, edge), mode="replicate").transpose(0, 1)
    return functional.conv2d(wide, kernels, groups=count).transpose(0, 1)


def analog_link(images: Tensor, generator: torch.Generator) -> Tensor:
    """A cheap likeness of scene/analog.py: jitter and tears of lines, smeared colours, noise, lines
    lost in a fade.
    """
    count, _, height, width = images.shape
    images = _shift_lines(images, _line_shifts(count, height, width, generator))
    grey = _luma(images)
    kernel = (CHROMA_BLUR / CHROMA_BLUR.sum()).to(images).flip(0).expand(3, 1, 1, -1)
    chroma = functional.conv2d(
        functional.pad(images - grey, (len(CHROMA_BLUR) - 1, 0, 0, 0), mode="replicate"),
        kernel,
        groups=3,
    )
    level = torch.exp(_uniform(count, generator, math.log(0.01), math.log(0.08)))  # 40 to 22 dB
    coarse = _normal((count, 3, height, max(width // 4, 1)), generator)
    grey = grey + level * _normal(grey.shape, generator)
    chroma = chroma + 0.7 * level * functional.interpolate(coarse, (height, width), mode="nearest")
    rows = torch.arange(height, device=images.device)[:, None]
    first, length = (
        _uniform(count, generator, 0.0, 8.0 * height),
        _uniform(count, generator, 1.0, 0.15 * height),
    )
    lost = (rows >= first) & (rows < first + length)  # one image in eight
    snow = torch.rand(grey.shape, generator=generator, device=images.device)
    return (torch.where(lost, snow, grey) + chroma).clamp(0.0, 1.0)


def _line_shifts(count: int, height: int, width: int, generator: torch.Generator) -> Tensor:
    """How far each line (B, H) begins to the right [px]: jitter, and in one image of five a jump
    that decays.
    """
    rows = torch.arange(height, device=generator.device)
    jitter = 0.5 * torch.rand(count, 1, generator=generator, device=generator.device)
    first = (
        5.0 * height * torch.rand(count, 1, generator=generator, device=generator.device)
    ).floor()
    jump = 0.2 * width * (torch.rand(count, 1, generator=generator, device=generator.device) - 0.5)
    after = (rows - first).clamp(min=0.0)
    return jitter * _normal((count, height), generator) + torch.where(
        rows >= first, jump * 0.85**after, 0.0
    )


def _shift_lines(images: Tensor, shifts: Tensor) -> Tensor:
    """Each line moved to the right by its shift (B, H) [px]; what is moved in repeats the edge."""
    height, width = images.shape[2:]
    x = torch.arange(width, device=images.device) + 0.5 - shifts[..., None]
    y = (torch.arange(height, device=images.device) + 0.5)[:, None].expand_as(x)
    grid = torch.stack([2.0 * x / width - 1.0, 2.0 * y / height - 1.0], dim=-1)
    return functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


def _luma(images: Tensor) -> Tensor:
    """Brightness (B, 1, H, W)."""
    return (images * torch.tensor(LUMA, device=images.device)[:, None, None]).sum(
        dim=1, keepdim=True
    )


def _uniform(count: int, generator: torch.Generator, low: float, high: float) -> Tensor:
    """One number for each image (B, 1, 1, 1)."""
    return low + (high - low) * torch.rand(
        count, 1, 1, 1, generator=generator, device=generator.device
    )


def _normal(shape: tuple[int, ...] | torch.Size, generator: torch.Generator) -> Tensor:
    return torch.randn(shape, generator=generator, device=generator.device)
