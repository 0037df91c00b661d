"""Editing: a Gaussian scene and what to change of it -> a new scene; the old one stays as it was.

    choose  ->  add  translate  rotate  scale  move  duplicate  rename  relight  salt_and_pepper
    delete

What is edited is told by a mask (N,), which `select_gaussians` makes from a label or a box. What
was added under a name is found again by it. The label "leader" is kept for an aircraft in its body
axes that waits to be placed (`leader_at`).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.colours import GAMMA, constant_sh, rotate_sh, scale_sh
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import require_pose

Mask = NDArray[np.bool_]
NO_LABELS = ("scene",)  # the only name in a scene whose file kept none
MAX_DISTANCE = 1e6  # m; nothing is moved beyond
MAX_SCALE_FACTOR = 1e3  # of sizes and of light


@dataclass(frozen=True)
class Appearance:
    """How an asset may look, for the paper's randomisation of the leader."""

    scale: float = 1.0  # of its size
    brightness: float = 1.0  # of its light
    salt_pepper: float = 0.0  # share of its Gaussians that turn white or black, 0..1
    seed: int = 0  # which of them


def select_gaussians(
    scene: GaussianScene,
    label: str = "",
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
) -> Mask:
    """Gaussians by label, by box or by both.

    Args:
        scene: to choose from.
        label: their name; empty for any.
        low: (3,) the box's low corner [m]; None for no box. The means decide.
        high: (3,) its high corner [m].

    Returns:
        (N,) True where both hold.

    Raises:
        InputError: there is no such label, the corners are none, or nothing is chosen.
    """
    if label and label not in scene.label_names and scene.label_names == NO_LABELS:
        raise InputError(
            f"label: expected a scene with labels, got one without, where nothing is a {label!r}; name a box"
        )
    mask = scene.labelled(label) if label else np.ones(len(scene), bool)
    if low is not None or high is not None:
        firsts = _finite("low", np.full(3, -MAX_DISTANCE) if low is None else low)
        lasts = _finite("high", np.full(3, MAX_DISTANCE) if high is None else high)
        for x, first, last in zip(scene.means.T, firsts, lasts, strict=True):
            mask &= (x >= first) & (x <= last)
    if not mask.any():
        raise InputError(
            f"choice: expected some Gaussians, got none{f' called {label}' if label else ''} in that place"
        )
    return np.asarray(mask)


def add(scene: GaussianScene, asset: GaussianScene, name: str = "") -> GaussianScene:
    """The scene with an asset, which lies in the scene's coordinates.

    Colours of a lower degree are padded to the other's.

    Args:
        scene: N Gaussians.
        asset: M Gaussians.
        name: the label of all of the asset; empty leaves it its own labels.

    Returns:
        N + M Gaussians, the asset's last.

    Raises:
        InputError: the asset has neither labels nor a name, or the scene has Gaussians of such a
            name already.
    """
    if not name and asset.label_names == NO_LABELS:
        raise InputError(
            "asset: expected labels or a name for it, got none: its file keeps no labels; give it a name"
        )
    named = _without_unused_names(rename(asset, np.ones(len(asset), bool), name) if name else asset)
    taken = [
        own for own in named.label_names if own in scene.label_names and scene.labelled(own).any()
    ]
    if taken:
        raise InputError(
            f"name: expected one that is new to the scene, got {taken[0]!r}; delete that or take another name"
        )
    return GaussianScene.joined(scene, named)


def delete(scene: GaussianScene, mask: Mask) -> GaussianScene:
    """The scene without some Gaussians, and without the names that only they carried.

    Args:
        scene: N Gaussians.
        mask: (N,) what goes.

    Raises:
        InputError: the mask is none, or nothing would stay.
    """
    return _without_unused_names(scene.selected(~_require_mask(scene, mask)), scene)


def duplicate(
    scene: GaussianScene, mask: Mask, offset_world: ArrayLike, name: str = ""
) -> GaussianScene:
    """The scene with a copy of some of its Gaussians, shifted.

    Args:
        scene: N Gaussians.
        mask: (N,) what is copied.
        offset_world: (3,) from the original to the copy [m].
        name: a new label for the copy; empty leaves it the original's labels.

    Returns:
        The scene; the copy comes last.

    Raises:
        InputError: the mask or the offset is none, or the name is taken.
    """
    copy = scene.selected(_require_mask(scene, mask))
    copy = translate(copy, np.ones(len(copy), bool), offset_world)
    return add(scene, copy, name) if name else GaussianScene.joined(scene, copy)


def rename(scene: GaussianScene, mask: Mask, name: str) -> GaussianScene:
    """The scene with another label on some Gaussians.

    Args:
        scene: N Gaussians.
        mask: (N,) what is renamed.
        name: the label, new or known.

    Raises:
        InputError: the mask or the name is none, or there are 256 names already.
    """
    names = scene.label_names if name in scene.label_names else (*scene.label_names, name)
    labels = np.where(_require_mask(scene, mask), names.index(name), scene.labels.astype(np.int64))
    return _without_unused_names(replace(scene, labels=labels, label_names=names), scene)


def move(scene: GaussianScene, mask: Mask, T_world_asset: ArrayLike) -> GaussianScene:
    """The scene with a part of it turned about the origin and then shifted, its colours with it.

    Args:
        scene: N Gaussians.
        mask: (N,) what moves; "asset" is the frame that it lies in as if that were the world.
        T_world_asset: (4, 4) rotation and shift [m].

    Raises:
        InputError: the mask is none, or the motion is not a rotation with a finite shift.
    """
    mask, T = _require_mask(scene, mask), require_pose("T_world_asset", T_world_asset)
    _finite("T_world_asset", T[:3, 3])
    means = scene.means[mask].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    if mask.all():  # named points are those of the whole
        scene = replace(
            scene, points={name: T[:3, :3] @ p + T[:3, 3] for name, p in scene.points.items()}
        )
    if np.array_equal(T[:3, :3], np.eye(3)):
        return _replace_rows(scene, mask, means=means)
    quaternions = scene.quaternions[mask] @ _quaternion_operator(T[:3, :3]).T.astype(np.float32)
    sh = rotate_sh(scene.sh[mask], T[:3, :3])
    return _replace_rows(scene, mask, means=means, quaternions=quaternions, sh=sh)


def translate(scene: GaussianScene, mask: Mask, offset_world: ArrayLike) -> GaussianScene:
    """The scene with a part of it shifted.

    Args:
        scene: N Gaussians.
        mask: (N,) what is shifted.
        offset_world: (3,) [m].

    Raises:
        InputError: the mask or the offset is none.
    """
    return move(scene, mask, pose_matrix(np.eye(3), _finite("offset_world", offset_world)))


def rotate(
    scene: GaussianScene, mask: Mask, R_world: ArrayLike, about_world: ArrayLike | None = None
) -> GaussianScene:
    """The scene with a part of it turned where it is.

    p' = c + R (p - c)

    Args:
        scene: N Gaussians.
        mask: (N,) what is turned.
        R_world: (3, 3) the rotation, in world axes.
        about_world: (3,) c, the place that stays [m]; None for the middle of the part's box.

    Raises:
        InputError: the mask or the place is none, or the matrix is no rotation.
    """
    R = require_shape("R_world", R_world, (3, 3))
    centre = _centre(scene, mask, about_world)
    return move(scene, mask, pose_matrix(R, centre - R @ centre))


def scale(
    scene: GaussianScene, mask: Mask, factor: float, about_world: ArrayLike | None = None
) -> GaussianScene:
    """The scene with a part of it larger or smaller.

    p' = c + s (p - c), and every standard deviation times s

    Args:
        scene: N Gaussians.
        mask: (N,) what is scaled.
        factor: s > 0.
        about_world: (3,) c, the place that stays [m]; None for the middle of the part's box.

    Raises:
        InputError: the mask or the place is none, or the factor is not within 0.001 and 1000.
    """
    factor = require_range("factor", factor, low=1.0 / MAX_SCALE_FACTOR, high=MAX_SCALE_FACTOR)
    centre = _centre(scene, mask, about_world)
    means = centre + factor * (scene.means[mask] - centre)
    if np.all(mask):
        scene = replace(
            scene, points={name: centre + factor * (p - centre) for name, p in scene.points.items()}
        )
    return _replace_rows(scene, mask, means=means, scales=factor * scene.scales[mask])


def relight(
    scene: GaussianScene, mask: Mask, brightness: float = 1.0, gain: ArrayLike = (1.0, 1.0, 1.0)
) -> GaussianScene:
    """The scene with a part of it in other light.

    The factors are those of light. What is on the screen is its 1 / 2.2th power, so twice the light
    is 1.37 times the number.  rgb' = (brightness gain)^(1 / 2.2) rgb

    Args:
        scene: N Gaussians.
        mask: (N,) what is relit.
        brightness: of the light, 0 is black.
        gain: (3,) of its red, green and blue.

    Raises:
        InputError: the mask is none, or a factor is not within 0 and 1000.
    """
    mask, gain = _require_mask(scene, mask), require_shape("gain", gain, (3,))
    light = [
        require_range("brightness, gain", brightness * g, low=0.0, high=MAX_SCALE_FACTOR)
        for g in gain
    ]
    return _replace_rows(scene, mask, sh=scale_sh(scene.sh[mask], np.power(light, 1.0 / GAMMA)))


def salt_and_pepper(scene: GaussianScene, mask: Mask, share: float, seed: int = 0) -> GaussianScene:
    """The scene with a share of a part's Gaussians white or black, by the toss of a coin [the
    paper, Robustness].

    Args:
        scene: N Gaussians.
        mask: (N,) the part.
        share: of its Gaussians, 0..1, rounded to whole ones.
        seed: which of them, and which colour.

    Raises:
        InputError: the mask or the seed is none, or the share is not within 0 and 1.
    """
    share = require_range("share", share, low=0.0, high=1.0)
    rows, rng = np.flatnonzero(_require_mask(scene, mask)), _rng(seed)
    rows = rng.permutation(rows)[: round(share * len(rows))]
    grey = np.repeat(rng.integers(0, 2, (len(rows), 1)), 3, axis=1)
    return _replace_rows(scene, rows, sh=constant_sh(scene.sh[rows], grey))


def draw_appearance(
    seed: int,
    scale: tuple[float, float] = (0.5, 2.0),
    brightness: tuple[float, float] = (0.4, 1.6),
    salt_pepper: tuple[float, float] = (0.0, 0.3),
) -> Appearance:
    """A random look: the three perturbations by which the paper trains its mask network.

    Args:
        seed: of the draw.
        scale: from, to; as likely half as double.
        brightness: from, to, of the light.
        salt_pepper: from, to, share of the Gaussians.

    Returns:
        The look; its seed draws the Gaussians that turn white or black.

    Raises:
        InputError: the seed is not a whole number >= 0, or a range is none.
    """
    rng = _rng(seed)
    for name, (first, last), least, most in (
        ("scale", scale, 1.0 / MAX_SCALE_FACTOR, MAX_SCALE_FACTOR),
        ("brightness", brightness, 0.0, MAX_SCALE_FACTOR),
        ("salt_pepper", salt_pepper, 0.0, 1.0),
    ):
        require_range(name, last, low=require_range(name, first, low=least), high=most)
    return Appearance(
        scale=float(np.exp(rng.uniform(*np.log(scale)))),
        brightness=float(rng.uniform(*brightness)),
        salt_pepper=float(rng.uniform(*salt_pepper)),
        seed=seed,
    )


def apply_appearance(
    scene: GaussianScene, mask: Mask, look: Appearance, about_world: ArrayLike | None = None
) -> GaussianScene:
    """The scene with a part of it in another look.

    Args:
        scene: N Gaussians.
        mask: (N,) the part.
        look: size, light and noise.
        about_world: (3,) the place that stays when the size changes [m]; None for the middle of the
            part's box.

    Raises:
        InputError: the mask, the place or a number of the look is none.
    """
    scene = relight(scale(scene, mask, look.scale, about_world), mask, look.brightness)
    return salt_and_pepper(scene, mask, look.salt_pepper, look.seed)


def centre_of(scene: GaussianScene, mask: Mask) -> Array:
    """(3,) the middle of the box around the means of a part [m]; InputError where the mask is none."""
    means = scene.means[_require_mask(scene, mask)]
    return 0.5 * (means.min(axis=0) + means.max(axis=0)).astype(np.float64)


def _replace_rows(scene: GaussianScene, rows: Any, **parts: Any) -> GaussianScene:
    """The scene with other numbers for some Gaussians: those of a mask, or of row numbers."""
    arrays = {name: getattr(scene, name).copy() for name in parts}
    for name, part in parts.items():
        arrays[name][rows] = part
    return replace(scene, **arrays)


def _quaternion_operator(R: Array) -> Array:
    """(4, 4) that turns quaternions w x y z by a rotation: the product with its quaternion, from
    the left.
    """
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _centre(scene: GaussianScene, mask: Mask, about_world: ArrayLike | None) -> Array:
    """The place that stays: the one asked for, or the middle of the part."""
    middle = centre_of(scene, mask)
    return middle if about_world is None else _finite("about_world", about_world)


def _without_unused_names(
    scene: GaussianScene, before: GaussianScene | None = None
) -> GaussianScene:
    """The scene without names that nothing carries; where there is a scene before, only those that
    were in use in it.

    The numbers of the other labels close up.
    """
    kinds = len(scene.label_names)
    used = np.bincount(scene.labels, minlength=kinds) > 0
    lost = ~used if before is None else ~used & (np.bincount(before.labels, minlength=kinds) > 0)
    if not lost.any():
        return scene
    names = tuple(name for name, gone in zip(scene.label_names, lost, strict=True) if not gone)
    return replace(
        scene, labels=(np.cumsum(~lost) - 1).astype(np.uint8)[scene.labels], label_names=names
    )


def _require_mask(scene: GaussianScene, mask: Mask) -> Mask:
    """The mask, if it chooses some of the scene's Gaussians."""
    chosen = np.asarray(mask)
    if chosen.dtype != np.bool_ or chosen.shape != (len(scene),):
        raise InputError(
            f"mask: expected ({len(scene)},) of True and False, got {chosen.shape} of {chosen.dtype}"
        )
    if not chosen.any():
        raise InputError(
            "mask: expected at least one Gaussian to edit, got none; choose by another label or box"
        )
    return chosen


def _finite(name: str, place: ArrayLike) -> Array:
    """A place or shift (3,) [m] of finite numbers."""
    values = require_shape(name, place, (3,))
    if not (np.abs(values) <= MAX_DISTANCE).all():  # which nan is not either
        raise InputError(f"{name}: expected finite numbers within {MAX_DISTANCE:g} m, got {values}")
    return values


def _rng(seed: int) -> np.random.Generator:
    """Random numbers from a seed."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"seed: expected a whole number >= 0, got {seed!r}")
    return np.random.default_rng(seed)
