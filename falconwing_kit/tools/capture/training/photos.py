"""Training photos: image files, camera and poses -> torch tensors, and which are held out.

Photos are read by Pillow alone, so that training needs no OpenCV.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import short_name
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.tools.capture.photo_files import Reconstruction
from falconwing_kit.tools.capture.training.settings import FitSettings

PHOTOS_PER_CLUSTER = 4  # mean size of the clusters of places for the held-out photos
MIN_DISTORTION_PX = 0.25  # corner distortion below which photos are not resampled
KMEANS_ITERATIONS = 50


@dataclass(frozen=True, eq=False)
class Photos:
    """Images of one camera without distortion, with their poses."""

    names: tuple[str, ...]  # (P,)
    camera: PinholeCamera
    images: Tensor  # (P, H, W, 3) bytes, premultiplied by alpha
    alphas: Tensor | None  # (P, H, W) bytes, coverage by the object; None: photos without alpha
    inside: Tensor  # (H, W) bool, False where undistortion left no image content
    Ts_world_camera: Tensor  # (P, 4, 4) float32, OpenCV axes

    def __len__(self) -> int:
        return len(self.names)

    def chosen(self, numbers: Sequence[int] | NDArray[Any]) -> "Photos":
        """A subset of the photos, in the order of `numbers`."""
        rows = torch.as_tensor(np.asarray(numbers, dtype=np.int64), device=self.images.device)
        alphas = None if self.alphas is None else self.alphas[rows]
        names = tuple(self.names[int(number)] for number in numbers)
        return replace(
            self,
            names=names,
            images=self.images[rows],
            alphas=alphas,
            Ts_world_camera=self.Ts_world_camera[rows],
        )

    def targets(self, numbers: Tensor, background: Tensor) -> tuple[Tensor, Tensor | None]:
        """Target images of a render in front of a background.

        Args:
            numbers: (C,) of photos.
            background: (3,) red, green, blue.

        Returns:
            Colour (C, H, W, 3) 0..1, and alpha (C, H, W) 0..1 where the photos have one.
        """
        images = self.images[numbers].float() / 255.0
        if self.alphas is None:
            return images, None
        alphas = self.alphas[numbers].float() / 255.0
        return images + (1.0 - alphas)[..., None] * background, alphas


def load_photos(
    source: Reconstruction, width: int = 0, device: str = "cpu", with_alpha: bool = False
) -> Photos:
    """Read photos, scale them, and undistort them where the distortion is visible.

    Args:
        width: of the training images [px]; 0 keeps the photos' size.
        device: of the tensors.
        with_alpha: True for RGBA images of an object.

    Raises:
        FileNotFoundError: a photo is missing.
        InputError: a photo cannot be read, has another size, or lacks alpha where required; or
            width is too small.
    """
    small, k1 = scale_camera(source.camera, width), source.k1
    images = np.empty((len(source), small.height, small.width, 4 if with_alpha else 3), np.uint8)
    for number in range(len(source)):
        images[number] = _read(source.path(number), source.camera, small, with_alpha)
    tensor = torch.from_numpy(images)
    inside = torch.ones(small.height, small.width, dtype=torch.bool)
    corner_slope = np.hypot(0.5 * small.width / small.fx, 0.5 * small.height / small.fy)
    if abs(k1) * corner_slope**3 * small.fx > MIN_DISTORTION_PX:
        tensor, inside = _undistort(tensor, small, k1)
    return Photos(
        source.names,
        small,
        tensor[..., :3].contiguous().to(device),
        tensor[..., 3].contiguous().to(device) if with_alpha else None,
        inside.to(device),
        torch.tensor(source.T_world_camera, dtype=torch.float32, device=device),
    )


def scale_camera(camera: PinholeCamera, width: int) -> PinholeCamera:
    """The camera of the same photos at another width [px]; 0 leaves it as it is.

    Raises:
        InputError: the width is not 0 and not 16 px up to the photos' own.
    """
    if width == 0 or width == camera.width:
        return camera
    if not 16 <= width <= camera.width:
        raise InputError(
            f"width: expected 16 to {camera.width} px, the photos' own, or 0 for that, got {width}"
        )
    height = max(16, round(camera.height * width / camera.width))
    across, down = width / camera.width, height / camera.height
    return PinholeCamera(
        camera.fx * across, camera.fy * down, camera.cx * across, camera.cy * down, width, height
    )


def hold_out_places(places: Array, share: float, seed: int = 0) -> NDArray[np.bool_]:
    """Choose held-out photos as whole clusters of places, so that none has a near twin in training.

    Places are clustered by k-means; random clusters are held out until they reach the share.

    Args:
        places: (P, 3) camera positions [m].
        share: of the photos, 0 to 0.5; 0 holds none out.

    Returns:
        (P,) True for held-out photos: at least one and never all, unless the share is 0.
    """
    count, rng = len(places), np.random.default_rng(seed)
    held = np.zeros(count, bool)
    target = min(count - 1, max(1, round(share * count))) if share > 0.0 else 0
    group = _k_means(
        np.asarray(places, np.float32).astype(np.float64),
        max(2, round(count / PHOTOS_PER_CLUSTER)),
        rng,
    )
    for number in rng.permutation(group.max() + 1):
        size = np.count_nonzero(group == number)
        if held.sum() + size <= target or (not held.any() and size < count and target):
            held |= group == number
    return held


def held_out_photos(
    names: Sequence[str], places: Array, settings: FitSettings
) -> NDArray[np.bool_]:
    """The held-out photos: those named in the settings, or whole clusters of places.

    Args:
        names: (P,) of all photos.
        places: (P, 3) camera positions [m].
        settings: judge_by, or hold_out and seed.

    Returns:
        (P,) True for held-out photos.

    Raises:
        InputError: judge_by matches no photo, or leaves fewer than two to train on.
    """
    if not settings.judge_by:
        return hold_out_places(places, settings.hold_out, settings.seed)
    plain = {Path(name).name for name in settings.judge_by}
    found = np.array([Path(name).name in plain for name in names], bool)
    if not found.any() or found.sum() > len(names) - 2:
        raise InputError(
            f"names to judge by: expected some of the {len(names)} photos, "
            f"got {found.sum()} of them"
        )
    return found


def read_photo_names(path: Path) -> tuple[str, ...]:
    """Names of photos in a file: a training's figures.json, JSON with a list "held_out", or lines.

    Raises:
        FileNotFoundError: nothing is at the path.
        InputError: it is JSON of another kind.
    """
    text = require_file(path).read_text(encoding="utf-8")
    try:
        found = json.loads(text)
        found = found.get("photos", found) if isinstance(found, dict) else found
        found = found["held_out"] if isinstance(found, dict) else found
        return tuple(str(name) for name in found)
    except json.JSONDecodeError:
        return tuple(text.split())
    except (KeyError, TypeError):
        raise InputError(
            f'{short_name(path)}: expected names of photos under "held_out", got other content'
        ) from None


def _k_means(places: Array, groups: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """(P,) cluster of each place [Lloyd 1982; k-means++ of Arthur & Vassilvitskii 2007]."""
    centres = places[rng.integers(len(places))][None]
    for _ in range(min(groups, len(places)) - 1):
        far = ((places[:, None] - centres) ** 2).sum(axis=2).min(axis=1)
        if far.sum() == 0.0:
            break
        centres = np.concatenate(
            [centres, places[rng.choice(len(places), p=far / far.sum())][None]]
        )
    for _ in range(KMEANS_ITERATIONS):
        group = ((places[:, None] - centres) ** 2).sum(axis=2).argmin(axis=1)
        members = [places[group == number] for number in range(len(centres))]
        centres = np.array(
            [
                own.mean(axis=0) if len(own) else old
                for own, old in zip(members, centres, strict=True)
            ]
        )
    return np.asarray(((places[:, None] - centres) ** 2).sum(axis=2).argmin(axis=1))


def _read(
    path: Path, camera: PinholeCamera, small: PinholeCamera, with_alpha: bool
) -> NDArray[np.uint8]:
    """One photo at the small camera's size: (H, W, 3), or (H, W, 4) premultiplied by alpha."""
    from PIL import Image

    require_file(path)
    try:
        with Image.open(path) as file:
            has_alpha = "A" in file.getbands()
            # RGBa: premultiplied by alpha, so that edges keep the object's colour
            image = file.convert("RGBa" if with_alpha else "RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise InputError(
            f"{short_name(path)}: expected a photo, got a damaged or other file; "
            "replace or remove it"
        ) from None
    if with_alpha and not has_alpha:
        raise InputError(
            f"{short_name(path)}: expected an image with alpha (RGBA), got none; cut the object out"
        )
    if image.size != (camera.width, camera.height):
        expected = f"{camera.width} x {camera.height}"
        rotated = image.size == (camera.height, camera.width)
        hint = (
            "it was rotated; rotate it back"
            if rotated
            else "the poses belong to another size; reconstruct again"
        )
        raise InputError(
            f"{short_name(path)}: expected {expected} px, got {image.size[0]} x {image.size[1]}: "
            f"{hint}"
        )
    if (small.width, small.height) != image.size:
        bands = [
            band.resize((small.width, small.height), Image.Resampling.BOX) for band in image.split()
        ]
        return np.stack([np.asarray(band) for band in bands], axis=-1)
    return np.frombuffer(image.tobytes(), np.uint8).reshape(small.height, small.width, -1)


def _undistort(images: Tensor, camera: PinholeCamera, k1: float) -> tuple[Tensor, Tensor]:
    """Undistorted images (P, H, W, B), and the mask (H, W) of pixels with image content."""
    x, y = torch.from_numpy(camera.pixel_rays()[..., :2]).float().unbind(-1)
    factor = 1.0 + k1 * (x * x + y * y)
    u, v = camera.fx * x * factor + camera.cx, camera.fy * y * factor + camera.cy
    grid = torch.stack([2.0 * u / camera.width - 1.0, 2.0 * v / camera.height - 1.0], dim=-1)[None]
    straight = torch.empty_like(images)
    for number, image in enumerate(images):
        bands = image.permute(2, 0, 1)[None].float()
        drawn = torch.nn.functional.grid_sample(
            bands, grid, "bicubic", "border", align_corners=False
        )
        straight[number] = drawn[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8)
    return straight, (grid[0].abs() <= 1.0).all(dim=-1)
