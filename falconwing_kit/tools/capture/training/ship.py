"""Post-processing: trained Gaussians and a survey -> pruned and labelled scene."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from falconwing_kit.core.checks import Array
from falconwing_kit.core.files import atomic_write
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.ply import SH_C0
from falconwing_kit.scene.reference import GaussianTensors
from falconwing_kit.tools.capture.survey.points import Survey
from falconwing_kit.tools.capture.training.draw import Draw
from falconwing_kit.tools.capture.training.judge import RenderPoses, quantise_8bit
from falconwing_kit.tools.capture.training.photos import Photos

LABELS = ("rest", "floor", "pad", "marker")
MIN_PIXELS = 1.0  # Gaussians that contribute less than this over all photos are removed
FLOOR_HEIGHT = 0.05  # [m] Gaussians below are floor, or its reflection
MARGIN = 0.05  # [m] around the pad
BORDER = 0.15  # [m] white border of the marker, and maximum depth of its board


def contributions(
    gaussians: GaussianTensors, photos: Photos, draw: Draw, antialiased: bool
) -> Tensor:
    """Sum of each Gaussian's compositing weights over all photos, in pixels.

    A render is sum_i w_i c_i, so the gradient of its sum with respect to a Gaussian's colour is the
    sum of its weights.

    Returns:
        (N,) [px].
    """
    grey = torch.zeros(
        len(gaussians.means), 1, 3, device=gaussians.means.device, requires_grad=True
    )
    plain = GaussianTensors(*(tensor.detach() for tensor in gaussians))._replace(sh=grey)
    total = torch.zeros(len(gaussians.means), device=grey.device)
    for pose in photos.Ts_world_camera:
        colours, _ = draw(plain, photos.camera, pose[None], pose.new_zeros(3), antialiased)
        (gradient,) = torch.autograd.grad(colours[..., 0].sum(), [grey])
        total += gradient[:, 0, 0] / SH_C0
    return total


def prune(gaussians: GaussianTensors, pixels: Tensor) -> GaussianTensors:
    """The Gaussians that contribute at least MIN_PIXELS; all of them if none does."""
    keep = pixels >= MIN_PIXELS
    keep = keep if bool(keep.any()) else torch.ones_like(keep)
    return GaussianTensors(*(tensor.detach()[keep] for tensor in gaussians))


def label_scene(scene: GaussianScene, survey: Survey | None) -> GaussianScene:
    """The scene with the labels rest, floor, pad and marker, by the surveyed places.

    Args:
        scene: in the kit's world, floor at z = 0.
        survey: its points marker_corner_... and pad_... span marker and pad; None labels the floor
            alone.
    """
    numbers = np.zeros(len(scene), np.uint8)
    numbers[scene.means[:, 2] < FLOOR_HEIGHT] = LABELS.index("floor")
    for name, prefix, margin in (("pad", "pad_", MARGIN), ("marker", "marker_corner_", BORDER)):
        corners = [n for n in survey.names if n.startswith(prefix)] if survey is not None else []
        if survey is not None and corners:
            numbers[_in_box(scene.means, survey.places(corners), margin)] = LABELS.index(name)
    return replace(scene, labels=numbers, label_names=LABELS)


def _in_box(means: NDArray[np.float32], corners: Array, margin: float) -> NDArray[np.bool_]:
    """(N,) True inside the box around corners; a flat box on the floor extends below it."""
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    low[2] = min(low[2], -margin) if np.ptp(corners[:, 2]) < 1e-6 else low[2]
    return np.asarray(((means >= low) & (means <= high)).all(axis=1))


@torch.no_grad()
def write_pairs(
    folder: Path, render_poses: RenderPoses, photos: Photos, names: Sequence[str]
) -> None:
    """Write photo and render side by side, for visual inspection.

    Args:
        folder: created if missing; one PNG per photo.
        photos: the reference images.
        names: of the photos to write.

    Raises:
        InputError: a file cannot be written.
    """
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(photos.names):
        if name not in names:
            continue
        drawn = quantise_8bit(render_poses(photos.Ts_world_camera[number : number + 1]))[0]
        target = photos.targets(torch.tensor([number], device=drawn.device), drawn.new_zeros(3))[0][
            0
        ]
        pair = (torch.cat([target, drawn], dim=1) * 255.0).round().to(torch.uint8).cpu().numpy()
        with atomic_write(folder / f"{Path(name).stem}.png") as file:
            Image.fromarray(pair).save(file, format="PNG")
