"""Image metrics: renders and photos -> PSNR and SSIM, also after pose or exposure correction."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from falconwing_kit.scene.reference import GaussianTensors
from falconwing_kit.tools.capture.training.draw import Draw, apply_twists
from falconwing_kit.tools.capture.training.photos import Photos
from falconwing_kit.vision.ssim import ssim

POSE_RATE = 1e-3  # learning rate of a photo's pose [m, and the rotation of that displacement]
RenderPoses = Callable[[Tensor], Tensor]  # poses (C, 4, 4) -> colours (C, H, W, 3)


def psnr(first: Tensor, second: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of (C, H, W, 3) colours 0..1: -10 log10 MSE [dB], at most 100."""
    return -10.0 * torch.log10(((first - second) ** 2).mean(dim=(1, 2, 3)).clamp(min=1e-10))


@torch.no_grad()
def evaluate(
    render_poses: RenderPoses, photos: Photos, poses: Tensor | None = None
) -> dict[str, Any]:
    """Compare renders with photos, both quantised to 8 bits.

    Args:
        photos: the reference images.
        poses: (P, 4, 4) to render instead of the photos' own.

    Returns:
        psnr_db (mean), psnr_worst_db, ssim (mean); the same after fitting gain and offset of each
        colour to each photo, under "after_exposure"; and "photos", the figures of each.
    """
    rows = []
    poses = photos.Ts_world_camera if poses is None else poses
    for number, name in enumerate(photos.names):
        drawn = quantise_8bit(render_poses(poses[number : number + 1]))
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
    """Mean and worst figures over the photos."""
    values = [row[psnr_name] for row in rows]
    structure = [row[ssim_name] for row in rows]
    mean = {"psnr_db": sum(values) / len(rows), "ssim": sum(structure) / len(rows)}
    return mean | {"psnr_worst_db": min(values), "ssim_worst": min(structure)}


def quantise_8bit(colours: Tensor) -> Tensor:
    """Colours clipped to 0..1 and rounded to 8 bits."""
    return (colours.clamp(0.0, 1.0) * 255.0).round() / 255.0


def refine_photo_poses(
    gaussians: GaussianTensors,
    photos: Photos,
    draw: Draw,
    antialiased: bool,
    extent: float,
    steps: int,
) -> Tensor:
    """Poses that best match a fixed scene, optimised from the photos' own.

    The improvement measures errors of the poses, not of the scene: report it beside the plain
    figures, never instead.

    Args:
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
    """The render after the gain and offset of each colour that fit the photo, by least squares."""
    mean_drawn, mean_target = (
        drawn.mean(dim=(1, 2), keepdim=True),
        target.mean(dim=(1, 2), keepdim=True),
    )
    spread = ((drawn - mean_drawn) ** 2).mean(dim=(1, 2), keepdim=True).clamp(min=1e-8)
    gain = ((drawn - mean_drawn) * (target - mean_target)).mean(dim=(1, 2), keepdim=True) / spread
    return gain * (drawn - mean_drawn) + mean_target
