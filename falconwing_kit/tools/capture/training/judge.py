"""Judging a scene: renders and photos -> PSNR and SSIM of each photo, as they are and after honest
corrections.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from falconwing_kit.scene.reference import GaussianTensors
from falconwing_kit.tools.capture.training.draw import Draw, apply_twists
from falconwing_kit.tools.capture.training.photos import Photos

SSIM_WINDOW_PX, SSIM_SIGMA_PX = 11, 1.5  # [px] of SSIM's window [Wang et al. 2004]
C1, C2 = 0.01**2, 0.03**2
POSE_RATE = 1e-3  # of a photo's pose against the finished scene; [m], and what turns that far
RenderPoses = Callable[[Tensor], Tensor]  # poses (C, 4, 4) -> colours (C, H, W, 3)


def ssim_batch(first: Tensor, second: Tensor) -> Tensor:
    """Structural similarity, over a Gaussian window that lies wholly in the image  [Wang et al.
    2004, eq. 13].

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
    alike = (2 * mean_x * mean_y + C1) * (2 * (xy - mean_x * mean_y) + C2)
    return (alike / ((mean_x**2 + mean_y**2 + C1) * (xx - mean_x**2 + yy - mean_y**2 + C2))).mean(
        dim=(1, 2, 3)
    )


def psnr(first: Tensor, second: Tensor) -> Tensor:
    """-10 log10 of the mean square error of colours 0..1, for each of (C, H, W, 3) [dB]; 100 where
    they are equal.
    """
    return -10.0 * torch.log10(((first - second) ** 2).mean(dim=(1, 2, 3)).clamp(min=1e-10))


@torch.no_grad()
def evaluate(look: RenderPoses, photos: Photos, poses: Tensor | None = None) -> dict[str, Any]:
    """Compare renders with photos, in bytes as a screen shows them.

    Args:
        look: draws poses.
        photos: the truth.
        poses: (P, 4, 4) to draw instead of the photos' own.

    Returns:
        psnr_db (mean), psnr_worst_db, ssim (mean); the same after gain and offset of each colour
        were fitted to each photo, under "after_exposure"; and "photos", a list with the figures of
        each.
    """
    rows = []
    poses = photos.Ts_world_camera if poses is None else poses
    for number, name in enumerate(photos.names):
        drawn = quantise_8bit(look(poses[number : number + 1]))
        target = photos.targets(torch.tensor([number], device=poses.device), poses.new_zeros(3))[0]
        drawn = torch.where(photos.inside[..., None], drawn, target)
        fitted = quantise_8bit(_match_exposure(drawn, target))
        rows.append(
            {
                "photo": name,
                **{"psnr_db": float(psnr(drawn, target)), "ssim": float(ssim_batch(drawn, target))},
                **{
                    "psnr_exposed_db": float(psnr(fitted, target)),
                    "ssim_exposed": float(ssim_batch(fitted, target)),
                },
            }
        )
    exposed = summarise_photos(rows, "psnr_exposed_db", "ssim_exposed")
    return summarise_photos(rows, "psnr_db", "ssim") | {"after_exposure": exposed, "photos": rows}


def summarise_photos(
    rows: Sequence[dict[str, Any]], psnr_name: str, ssim_name: str
) -> dict[str, float]:
    """Mean and worst of the figures of photos."""
    values = [row[psnr_name] for row in rows]
    structure = [row[ssim_name] for row in rows]
    mean = {"psnr_db": sum(values) / len(rows), "ssim": sum(structure) / len(rows)}
    return mean | {"psnr_worst_db": min(values), "ssim_worst": min(structure)}


def quantise_8bit(colours: Tensor) -> Tensor:
    """Colours as a screen shows them: cut to 0..1 and in 255 steps."""
    return (colours.clamp(0.0, 1.0) * 255.0).round() / 255.0


def refine_photo_poses(
    gaussians: GaussianTensors,
    photos: Photos,
    draw: Draw,
    antialiased: bool,
    extent: float,
    steps: int,
) -> Tensor:
    """The poses from which a finished scene looks most like the photos, searched for near the
    photos' own.

    What this improves is the fault of the poses, not of the scene; report it beside the plain
    figures, never instead.

    Args:
        gaussians: the scene, which stays as it is.
        photos: whose poses to refine.
        draw: the renderer.
        antialiased: as the scene was trained.
        extent: of the scene [m].
        steps: of Adam.

    Returns:
        (P, 4, 4).
    """
    still = GaussianTensors(*(tensor.detach() for tensor in gaussians))
    unit = (
        torch.tensor([1.0, 1.0, 1.0, extent, extent, extent], device=photos.images.device) / extent
    )
    found = []
    for number in range(len(photos)):
        pose, twist = (
            photos.Ts_world_camera[number : number + 1],
            torch.zeros(1, 6, device=unit.device),
        )
        target = photos.targets(torch.tensor([number], device=unit.device), unit.new_zeros(3))[0]
        twist.requires_grad_(True)
        adam = torch.optim.Adam([twist], lr=POSE_RATE)
        for turn in range(steps):
            adam.param_groups[0]["lr"] = POSE_RATE * (1.0 - turn / steps)
            colours = draw(
                still,
                photos.camera,
                apply_twists(pose, twist * unit),
                unit.new_zeros(3),
                antialiased,
            )[0]
            (gradient,) = torch.autograd.grad(
                (colours - target).abs()[:, photos.inside].mean(), [twist]
            )
            twist.grad = gradient
            adam.step()
        found.append(apply_twists(pose, twist.detach() * unit))
    return torch.cat(found)


@lru_cache(maxsize=4)
def _window(length: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """(length, length - 10) the weighted means along a line as a matrix.

    A convolution would be shorter, but GPUs round its products to ten bits unless told otherwise.
    """
    offsets = (
        torch.arange(length)[:, None]
        - torch.arange(length - SSIM_WINDOW_PX + 1)
        - SSIM_WINDOW_PX // 2
    )
    weights = torch.where(
        offsets.abs() <= SSIM_WINDOW_PX // 2, torch.exp(-0.5 * (offsets / SSIM_SIGMA_PX) ** 2), 0.0
    )
    return (weights / weights.sum(dim=0)).to(device, dtype)


def _match_exposure(drawn: Tensor, target: Tensor) -> Tensor:
    """The render with the gain and offset of each colour that fit the photo best, by least squares."""
    mean_drawn, mean_target = (
        drawn.mean(dim=(1, 2), keepdim=True),
        target.mean(dim=(1, 2), keepdim=True),
    )
    spread = ((drawn - mean_drawn) ** 2).mean(dim=(1, 2), keepdim=True).clamp(min=1e-8)
    gain = ((drawn - mean_drawn) * (target - mean_target)).mean(dim=(1, 2), keepdim=True) / spread
    return gain * (drawn - mean_drawn) + mean_target
