"""Editing: a Gaussian scene and a mask of what to change -> a new scene; the old one is unchanged.

    select_gaussians -> add  delete  duplicate  rename  move  translate  rotate  scale
                        relight  salt_and_pepper  apply_appearance

A mask (N,) selects what is edited. What was added under a name is selected by that label again.
The label "leader" is reserved for an aircraft in its body axes that `leader_at` places.

Every function raises InputError where the mask is not (N,) of bool or selects nothing, and where a
number or a name is out of its range.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.camera import require_pose
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.sh import GAMMA, constant_sh, rotate_sh, scale_sh

Mask = NDArray[np.bool_]
NO_LABELS = ("scene",)  # the only name in a scene whose file kept none
MAX_DISTANCE = 1e6  # of any place or shift from the origin [m]
MAX_SCALE_FACTOR = 1e3  # of sizes and of light


@dataclass(frozen=True)
class Appearance:
    """Appearance changes of an asset, for the paper's randomisation of the leader."""

    scale: float = 1.0  # factor of its size
    brightness: float = 1.0  # factor of its light
    salt_pepper: float = 0.0  # share of its Gaussians that turn white or black, 0..1
    seed: int = 0  # draws these Gaussians


def select_gaussians(
    scene: GaussianScene,
    label: str = "",
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
) -> Mask:
    """Mask (N,) of the Gaussians with a label and with their means in a box.

    Args:
        label: empty for any.
        low: (3,) lower corner of the box [m]; None for no bound.
        high: (3,) upper corner [m]; None for no bound.
    """
    if label and label not in scene.label_names and scene.label_names == NO_LABELS:
        raise InputError(
            f"label: expected a scene with labels, got one without, where nothing is a {label!r};"
            " name a box"
        )
    mask = scene.labelled(label) if label else np.ones(len(scene), bool)
    if low is not None or high is not None:
        lows = _require_finite("low", np.full(3, -MAX_DISTANCE) if low is None else low)
        highs = _require_finite("high", np.full(3, MAX_DISTANCE) if high is None else high)
        for x, x_low, x_high in zip(scene.means.T, lows, highs, strict=True):
            mask &= (x >= x_low) & (x <= x_high)
    if not mask.any():
        called = f" called {label}" if label else ""
        raise InputError(f"choice: expected some Gaussians, got none{called} in that place")
    return np.asarray(mask)


def add(scene: GaussianScene, asset: GaussianScene, name: str = "") -> GaussianScene:
    """The scene followed by an asset in the same coordinates.

    Args:
        name: a label new to the scene, for all of the asset; empty keeps the asset's own labels.
    """
    if not name and asset.label_names == NO_LABELS:
        raise InputError(
            "asset: expected labels or a name for it, got none: its file keeps no labels;"
            " give it a name"
        )
    named = _without_unused_names(rename(asset, np.ones(len(asset), bool), name) if name else asset)
    names = (name for name in named.label_names if name in scene.label_names)
    taken = next((name for name in names if scene.labelled(name).any()), None)
    if taken is not None:
        raise InputError(
            f"name: expected one that is new to the scene, got {taken!r};"
            " delete that or take another name"
        )
    return GaussianScene.joined(scene, named)


def delete(scene: GaussianScene, mask: Mask) -> GaussianScene:
    """The scene without some Gaussians, and without the label names that only they had."""
    return _without_unused_names(scene.selected(~_require_mask(scene, mask)), scene)


def duplicate(
    scene: GaussianScene, mask: Mask, offset_world: ArrayLike, name: str = ""
) -> GaussianScene:
    """The scene followed by a copy of some of its Gaussians, shifted by (3,) [m].

    Args:
        name: a new label for the copy; empty keeps the original's labels.
    """
    copy = scene.selected(_require_mask(scene, mask))
    copy = translate(copy, np.ones(len(copy), bool), offset_world)
    return add(scene, copy, name) if name else GaussianScene.joined(scene, copy)


def rename(scene: GaussianScene, mask: Mask, name: str) -> GaussianScene:
    """The scene with another label, new or known, on some Gaussians."""
    names = scene.label_names if name in scene.label_names else (*scene.label_names, name)
    labels = np.where(_require_mask(scene, mask), names.index(name), scene.labels.astype(np.int64))
    return _without_unused_names(replace(scene, labels=labels, label_names=names), scene)


def move(scene: GaussianScene, mask: Mask, T_world_asset: ArrayLike) -> GaussianScene:
    """The scene with a part of it rotated about the origin, its colours too, and then shifted.

    Args:
        T_world_asset: (4, 4); "asset" is the frame in which the part's numbers are given.
    """
    mask, T = _require_mask(scene, mask), require_pose("T_world_asset", T_world_asset)
    R, p = T[:3, :3], _require_finite("T_world_asset", T[:3, 3])
    means = scene.means[mask].astype(np.float64) @ R.T + p
    if mask.all():  # named points belong to the whole
        points = {name: R @ point + p for name, point in scene.points.items()}
        scene = replace(scene, points=points)
    if np.array_equal(R, np.eye(3)):
        return _replace_rows(scene, mask, means=means)
    quaternions = scene.quaternions[mask] @ _quaternion_operator(R).T.astype(np.float32)
    sh = rotate_sh(scene.sh[mask], R)
    return _replace_rows(scene, mask, means=means, quaternions=quaternions, sh=sh)


def translate(scene: GaussianScene, mask: Mask, offset_world: ArrayLike) -> GaussianScene:
    """The scene with a part of it shifted by (3,) [m]."""
    return move(scene, mask, pose_matrix(np.eye(3), _require_finite("offset_world", offset_world)))


def rotate(
    scene: GaussianScene, mask: Mask, R_world: ArrayLike, about_world: ArrayLike | None = None
) -> GaussianScene:
    """The scene with a part of it rotated: p' = c + R (p - c).

    Args:
        R_world: (3, 3) the rotation, in world axes.
        about_world: (3,) c [m]; None for the middle of the part's bounding box.
    """
    R = require_shape("R_world", R_world, (3, 3))
    centre = _centre(scene, mask, about_world)
    return move(scene, mask, pose_matrix(R, centre - R @ centre))


def scale(
    scene: GaussianScene, mask: Mask, factor: float, about_world: ArrayLike | None = None
) -> GaussianScene:
    """The scene with a part of it resized: p' = c + s (p - c), and scales times s.

    Args:
        factor: s, 0.001 to 1000.
        about_world: (3,) c [m]; None for the middle of the part's bounding box.
    """
    factor = require_range("factor", factor, low=1.0 / MAX_SCALE_FACTOR, high=MAX_SCALE_FACTOR)
    centre = _centre(scene, mask, about_world)
    means = centre + factor * (scene.means[mask] - centre)
    if np.all(mask):
        points = {name: centre + factor * (p - centre) for name, p in scene.points.items()}
        scene = replace(scene, points=points)
    return _replace_rows(scene, mask, means=means, scales=factor * scene.scales[mask])


def relight(
    scene: GaussianScene, mask: Mask, brightness: float = 1.0, gain: ArrayLike = (1.0, 1.0, 1.0)
) -> GaussianScene:
    """The scene with a part of it in other light: rgb' = (brightness gain)^(1 / 2.2) rgb.

    The factors are those of light, 0 to 1000. Pixel values are its 1 / 2.2th power: twice the light
    is 1.37 times the pixel value.

    Args:
        gain: (3,) further factors of red, green and blue.
    """
    mask, gain = _require_mask(scene, mask), require_shape("gain", gain, (3,))
    light = [
        require_range("brightness, gain", brightness * g, low=0.0, high=MAX_SCALE_FACTOR)
        for g in gain
    ]
    return _replace_rows(scene, mask, sh=scale_sh(scene.sh[mask], np.power(light, 1.0 / GAMMA)))


def salt_and_pepper(scene: GaussianScene, mask: Mask, share: float, seed: int = 0) -> GaussianScene:
    """The scene with a share, 0..1, of a part's Gaussians white or black [paper, Robustness]."""
    share = require_range("share", share, low=0.0, high=1.0)
    rows, rng = np.flatnonzero(_require_mask(scene, mask)), require_rng(seed)
    rows = rng.permutation(rows)[: round(share * len(rows))]
    grey = np.repeat(rng.integers(0, 2, (len(rows), 1)), 3, axis=1)
    return _replace_rows(scene, rows, sh=constant_sh(scene.sh[rows], grey))


def draw_appearance(
    seed: int,
    scale: tuple[float, float] = (0.5, 2.0),
    brightness: tuple[float, float] = (0.4, 1.6),
    salt_pepper: tuple[float, float] = (0.0, 0.3),
) -> Appearance:
    """A random appearance, by the paper's three perturbations for training its mask network.

    Args:
        scale: range, sampled on a logarithmic scale: half is as likely as double.
        brightness: range of the light's factor.
        salt_pepper: range of the share of Gaussians.
    """
    rng = require_rng(seed)
    for name, (low, high), smallest, largest in (
        ("scale", scale, 1.0 / MAX_SCALE_FACTOR, MAX_SCALE_FACTOR),
        ("brightness", brightness, 0.0, MAX_SCALE_FACTOR),
        ("salt_pepper", salt_pepper, 0.0, 1.0),
    ):
        require_range(name, high, low=require_range(name, low, low=smallest), high=largest)
    return Appearance(
        scale=float(np.exp(rng.uniform(*np.log(scale)))),
        brightness=float(rng.uniform(*brightness)),
        salt_pepper=float(rng.uniform(*salt_pepper)),
        seed=seed,
    )


def apply_appearance(
    scene: GaussianScene, mask: Mask, look: Appearance, about_world: ArrayLike | None = None
) -> GaussianScene:
    """The scene with a part of it in another appearance, resized about (3,) [m] as by `scale`."""
    scene = relight(scale(scene, mask, look.scale, about_world), mask, look.brightness)
    return salt_and_pepper(scene, mask, look.salt_pepper, look.seed)


def centre_of(scene: GaussianScene, mask: Mask) -> Array:
    """(3,) the middle of the bounding box of a part's means [m]."""
    means = scene.means[_require_mask(scene, mask)]
    return 0.5 * (means.min(axis=0) + means.max(axis=0)).astype(np.float64)


def require_rng(seed: int) -> np.random.Generator:
    """A random generator, or InputError where the seed is not a whole number >= 0."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"seed: expected a whole number >= 0, got {seed!r}")
    return np.random.default_rng(seed)


def _replace_rows(scene: GaussianScene, rows: Any, **parts: Any) -> GaussianScene:
    """The scene with new values in some rows, given by a mask or by indices."""
    arrays = {name: getattr(scene, name).copy() for name in parts}
    for name, part in parts.items():
        arrays[name][rows] = part
    return replace(scene, **arrays)


def _quaternion_operator(R: Array) -> Array:
    """(4, 4) matrix of the product with R's quaternion from the left, for quaternions w x y z."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _centre(scene: GaussianScene, mask: Mask, about_world: ArrayLike | None) -> Array:
    """The fixed point: the one given, or the middle of the part."""
    middle = centre_of(scene, mask)
    return middle if about_world is None else _require_finite("about_world", about_world)


def _without_unused_names(
    scene: GaussianScene, before: GaussianScene | None = None
) -> GaussianScene:
    """The scene without unused label names; given a scene before, only those used in it."""
    count = len(scene.label_names)
    unused = np.bincount(scene.labels, minlength=count) == 0
    if before is not None:
        unused &= np.bincount(before.labels, minlength=count) > 0
    if not unused.any():
        return scene
    names = tuple(np.array(scene.label_names, object)[~unused])
    new_labels = (np.cumsum(~unused) - 1).astype(np.uint8)  # old index -> new index
    return replace(scene, labels=new_labels[scene.labels], label_names=names)


def _require_mask(scene: GaussianScene, mask: Mask) -> Mask:
    """The mask, if it selects some of the scene's Gaussians."""
    chosen = np.asarray(mask)
    if chosen.dtype != np.bool_ or chosen.shape != (len(scene),):
        got = f"{chosen.shape} of {chosen.dtype}"
        raise InputError(f"mask: expected ({len(scene)},) of True and False, got {got}")
    if not chosen.any():
        raise InputError(
            "mask: expected at least one Gaussian to edit, got none; choose by another label or box"
        )
    return chosen


def _require_finite(name: str, place: ArrayLike) -> Array:
    """A place or shift (3,) [m] of finite numbers."""
    values = require_shape(name, place, (3,))
    if not (np.abs(values) <= MAX_DISTANCE).all():  # also False for nan
        raise InputError(f"{name}: expected finite numbers within {MAX_DISTANCE:g} m, got {values}")
    return values
