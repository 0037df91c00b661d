"""Judging a scene: renders and photos -> PSNR and SSIM of each photo, as they are and after honest
corrections.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from falconwing_kit.scene.reference import GaussianTensors
from falconwing_kit.tools.capture.training.draw import Draw, apply_twists
from falconwing_kit.tools.capture.training.photos import Photos
from falconwing_kit.vision.ssim import ssim

POSE_RATE = 1e-3  # of a photo's pose against the finished scene; [m], and what turns that far
RenderPoses = Callable[[Tensor], Tensor]  # poses (C, 4, 4) -> colours (C, H, W, 3)


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
                **{"psnr_db": float(psnr(drawn, target)), "ssim": _mean_ssim(drawn, target)},
                **{
                    "psnr_exposed_db": float(psnr(fitted, target)),
                    "ssim_exposed": _mean_ssim(fitted, target),
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


def _mean_ssim(first: Tensor, second: Tensor) -> float:
    """Structural similarity of two images (1, H, W, 3) of colours 0..1, mean over the colours."""
    planes = [(255.0 * image[0].movedim(-1, 0)).cpu().numpy() for image in (first, second)]
    return sum(ssim(x, y) for x, y in zip(*planes, strict=True)) / 3.0


def _match_exposure(drawn: Tensor, target: Tensor) -> Tensor:
    """The render with the gain and offset of each colour that fit the photo best, by least squares."""
    mean_drawn, mean_target = (
        drawn.mean(dim=(1, 2), keepdim=True),
        target.mean(dim=(1, 2), keepdim=True),
    )
    spread = ((drawn - mean_drawn) ** 2).mean(dim=(1, 2), keepdim=True).clamp(min=1e-8)
    gain = ((drawn - mean_drawn) * (target - mean_target)).mean(dim=(1, 2), keepdim=True) / spread
    return gain * (drawn - mean_drawn) + mean_target
