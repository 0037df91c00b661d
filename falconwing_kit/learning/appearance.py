"""Appearance randomisation: clean renders -> other light, lenses, video links and occluders.

Everything is drawn per image, and works on a whole batch on a CPU or a GPU. The ranges are chosen
wider than one hall and camera show; they are not fitted to photos.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

KERNEL = 7  # width of a blur kernel [px]
CHROMA_BLUR = 0.7 ** torch.arange(9.0)  # a decoder's colour lag along the line, pixel by pixel
OCCLUDERS = 2  # per image, at most
OCCLUDER_CHANCE = 0.2  # of each of them
ANALOG_SHARE = 0.5  # of images with an analog link
LUMA = (0.299, 0.587, 0.114)  # of red, green, blue [ITU-R BT.601]


def randomise_appearance(images: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Other light and colours, occluders, blur, and for half of the images an analog link.

    Args:
        images: (B, 3, H, W) red, green, blue in 0..1.
        generator: on the images' device.

    Returns:
        (B, 3, H, W) in 0..1, and the mask (B, H, W) of pixels without occluder.
    """
    images = vary_lighting(images, generator)
    images, clear = add_occluders(images, generator)
    images = add_blur(images, generator)
    analog = _uniform(len(images), generator, 0.0, 1.0) < ANALOG_SHARE
    images = torch.where(analog, analog_link(images, generator), images)
    noise = _uniform(len(images), generator, 0.0, 0.03) * _normal(images.shape, generator)
    return (images + noise).clamp(0.0, 1.0), clear


def vary_lighting(images: Tensor, generator: torch.Generator) -> Tensor:
    """Other exposure, gamma, contrast, saturation, white balance, and smoothly uneven light."""
    count = len(images)
    # exposure, white balance and uneven light are factors
    patches = 0.15 * _normal((count, 1, 3, 4), generator)
    field = functional.interpolate(patches, images.shape[2:], mode="bilinear", align_corners=True)
    gain = torch.exp(
        0.25 * _normal((count, 1, 1, 1), generator)
        + 0.04 * _normal((count, 3, 1, 1), generator)
        + field
    )
    gamma = torch.exp(0.2 * _normal((count, 1, 1, 1), generator))
    images = (images * gain).clamp(1e-3, 1.0) ** gamma
    # saturation: distance from grey; contrast: distance from the image's mean
    grey = luma(images)
    images = grey + _uniform(count, generator, 0.6, 1.3) * (images - grey)
    middle = images.mean(dim=(1, 2, 3), keepdim=True)
    contrast = torch.exp(0.15 * _normal((count, 1, 1, 1), generator))
    tint = 0.02 * _normal((count, 3, 1, 1), generator)
    return (middle + contrast * (images - middle) + tint).clamp(0.0, 1.0)


def add_occluders(images: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Grainy ellipses in front of a third of the images; and the mask of pixels without them."""
    count, _, height, width = images.shape
    y = torch.linspace(0.0, 1.0, height, device=images.device)[:, None]
    x = torch.linspace(0.0, 1.0, width, device=images.device)
    hidden = torch.zeros(count, 1, height, width, dtype=torch.bool, device=images.device)
    for _ in range(OCCLUDERS):
        centre_x, centre_y, chance = (_uniform(count, generator, 0.0, 1.0) for _ in range(3))
        half_x, half_y = (_uniform(count, generator, 0.02, 0.2) for _ in range(2))
        inside = ((x - centre_x) / half_x) ** 2 + ((y - centre_y) / half_y) ** 2 < 1.0
        inside = inside & (chance < OCCLUDER_CHANCE)
        colour = torch.rand(count, 3, 1, 1, generator=generator, device=images.device)
        colour = colour + 0.1 * _normal((count, 1, height, width), generator)
        images, hidden = torch.where(inside, colour, images), hidden | inside
    return images.clamp(0.0, 1.0), ~hidden[:, 0]


def add_blur(images: Tensor, generator: torch.Generator) -> Tensor:
    """Defocus, and motion blur along a direction: one Gaussian kernel per image."""
    count = len(images)
    # coordinates of the kernel along the motion and across it
    reach = torch.arange(KERNEL, device=images.device) - KERNEL // 2
    angle = _uniform(count, generator, 0.0, math.pi)[:, 0]
    along = torch.cos(angle) * reach + torch.sin(angle) * reach[:, None]
    across = torch.cos(angle) * reach[:, None] - torch.sin(angle) * reach
    # powers of uniform numbers: most images are sharp
    defocus_px = 0.1 + 0.9 * torch.rand(count, 1, 1, generator=generator, device=images.device) ** 2
    motion_blur_px = (
        defocus_px + 1.8 * torch.rand(count, 1, 1, generator=generator, device=images.device) ** 4
    )
    kernels = torch.exp(-0.5 * ((along / motion_blur_px) ** 2 + (across / defocus_px) ** 2))
    kernels = (kernels / kernels.sum(dim=(1, 2), keepdim=True))[:, None]
    # (3, B, H, W): with groups=B each image is convolved with its own kernel
    edge = KERNEL // 2
    wide = functional.pad(images, (edge, edge, edge, edge), mode="replicate").transpose(0, 1)
    return functional.conv2d(wide, kernels, groups=count).transpose(0, 1)


def analog_link(images: Tensor, generator: torch.Generator) -> Tensor:
    """Fast approximation of scene/analog.py: line jitter, colour lag, noise, lost lines."""
    count, _, height, width = images.shape
    images = _shift_lines(images, _line_shifts(count, height, width, generator))
    # colour differences lag behind the luma
    grey = luma(images)
    kernel = (CHROMA_BLUR / CHROMA_BLUR.sum()).to(images).flip(0).expand(3, 1, 1, -1)
    chroma = functional.conv2d(
        functional.pad(images - grey, (len(CHROMA_BLUR) - 1, 0, 0, 0), mode="replicate"),
        kernel,
        groups=3,
    )
    # white noise on the luma, coarse noise on the colours
    level = torch.exp(_uniform(count, generator, math.log(0.01), math.log(0.08)))  # 40 to 22 dB
    coarse = _normal((count, 3, height, max(width // 4, 1)), generator)
    grey = grey + level * _normal(grey.shape, generator)
    chroma = chroma + 0.7 * level * functional.interpolate(coarse, (height, width), mode="nearest")
    # a band of lines without signal, in one image of eight
    rows = torch.arange(height, device=images.device)[:, None]
    first = _uniform(count, generator, 0.0, 8.0 * height)
    length = _uniform(count, generator, 1.0, 0.15 * height)
    lost = (rows >= first) & (rows < first + length)
    snow = torch.rand(grey.shape, generator=generator, device=images.device)
    return (torch.where(lost, snow, grey) + chroma).clamp(0.0, 1.0)


def _line_shifts(count: int, height: int, width: int, generator: torch.Generator) -> Tensor:
    """Shift (B, H) of each line [px]: jitter, and in one image of five a jump that decays."""
    rows = torch.arange(height, device=generator.device)
    jitter = _uniform(count, generator, 0.0, 0.5)[:, :, 0, 0]
    first = _uniform(count, generator, 0.0, 5.0 * height)[:, :, 0, 0].floor()
    jump = 0.2 * width * (_uniform(count, generator, 0.0, 1.0)[:, :, 0, 0] - 0.5)
    after = (rows - first).clamp(min=0.0)
    tear = torch.where(rows >= first, jump * 0.85**after, 0.0)
    return jitter * _normal((count, height), generator) + tear


def _shift_lines(images: Tensor, shifts: Tensor) -> Tensor:
    """Each line moved to the right by its shift (B, H) [px]; the edge is repeated."""
    height, width = images.shape[2:]
    x = torch.arange(width, device=images.device) + 0.5 - shifts[..., None]
    y = (torch.arange(height, device=images.device) + 0.5)[:, None].expand_as(x)
    grid = torch.stack([2.0 * x / width - 1.0, 2.0 * y / height - 1.0], dim=-1)
    return functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


def luma(images: Tensor) -> Tensor:
    """Brightness (B, 1, H, W)."""
    weights = torch.tensor(LUMA, device=images.device)[:, None, None]
    return (images * weights).sum(dim=1, keepdim=True)


def _uniform(count: int, generator: torch.Generator, low: float, high: float) -> Tensor:
    """One number for each image (B, 1, 1, 1)."""
    unit = torch.rand(count, 1, 1, 1, generator=generator, device=generator.device)
    return low + (high - low) * unit


def _normal(shape: tuple[int, ...] | torch.Size, generator: torch.Generator) -> Tensor:
    """Standard normal numbers of a shape, on the generator's device."""
    return torch.randn(shape, generator=generator, device=generator.device)
