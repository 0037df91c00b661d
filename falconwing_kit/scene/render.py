"""Renderer: a Gaussian scene and camera poses -> colour, alpha and depth, by any backend."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.scene.camera import PinholeCamera, require_pose
from falconwing_kit.scene.gaussians import GaussianScene, Images, Scenes
from falconwing_kit.scene.sh import Array32


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered image; rows run down and columns right."""

    rgb: Array32  # (H, W, 3) red, green, blue in 0..1, over the background
    alpha: Array32  # (H, W) share of the background that is covered, 0..1
    # (H, W) along the camera's z axis [m], weighted mean of the splats; 0 where alpha is 0
    depth: Array32


def render(
    scene: GaussianScene | Sequence[GaussianScene],
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    backend: str = "auto",
    background: ArrayLike = (0.0, 0.0, 0.0),
    antialiased: bool = False,
) -> Frame:
    """Render a scene, by the conventions of gsplat's "classic" mode.

    Args:
        scene: the Gaussians; or several scenes in the same coordinates, drawn as if joined, such as
            a fixed hall and a moving aircraft.
        T_world_camera: (4, 4) "world from camera", camera axes x right, y down, z forward.
        backend: "reference" (torch, readable), "fast" (numba), "gsplat" (CUDA) or "auto", which is
            "fast".
        background: (3,) red, green, blue behind the scene, 0..1.
        antialiased: dim a Gaussian smaller than a pixel instead of widening it; for scenes trained
            so.

    Returns:
        The frame. Colours above 1, which a trained scene can have, are cut to 1 as a camera would.

    Raises:
        InputError: an argument is wrong, or the backend cannot run here; the text gives the remedy.
    """
    return render_batch(scene, camera, [T_world_camera], backend, background, antialiased)[0]


def render_batch(
    scene: GaussianScene | Sequence[GaussianScene],
    camera: PinholeCamera,
    Ts_world_camera: Sequence[ArrayLike] | Array,
    backend: str = "auto",
    background: ArrayLike = (0.0, 0.0, 0.0),
    antialiased: bool = False,
) -> list[Frame]:
    """Render a scene from many poses (C, 4, 4), as `render` from one; same other arguments.

    Backend "gsplat" renders many poses by one call, several times as fast as one by one. Its frames
    share memory: a copy of one lets the others go.

    Raises:
        InputError: as `render`; there are no poses.
    """
    scenes = (scene,) if isinstance(scene, GaussianScene) else _require_scenes(scene)
    if not isinstance(camera, PinholeCamera):
        raise InputError(f"camera: expected a PinholeCamera, got {type(camera).__name__}")
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise InputError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    poses = [require_pose("T_world_camera", T) for T in _require_several(Ts_world_camera)]
    colour = _require_colour(background)
    images = BACKENDS[backend](scenes, camera, np.array(poses), colour, bool(antialiased))
    return [Frame(*image) for image in images]


def _require_scenes(scenes: Sequence[GaussianScene]) -> Scenes:
    """Raise InputError unless it is a list or tuple of one scene or more."""
    several = tuple(scenes) if isinstance(scenes, list | tuple) else ()
    if not several or not all(isinstance(scene, GaussianScene) for scene in several):
        got = type(scenes).__name__
        raise InputError(
            f"scene: expected a GaussianScene, got {got}; GaussianScene.load reads a file"
        )
    return several


def _require_several(poses: Sequence[ArrayLike] | Array) -> Sequence[ArrayLike] | Array:
    """Raise InputError unless it is an array or a list of one pose or more."""
    if isinstance(poses, np.ndarray | list | tuple) and len(poses):
        return poses
    raise InputError(
        f"Ts_world_camera: expected one pose (4, 4) or more in a list, got {str(poses)[:80]!r}"
    )


def _require_colour(background: ArrayLike) -> Array:
    """Raise InputError unless it is red, green and blue (3,) in 0..1."""
    colour = require_shape("background", background, (3,))
    if not all(0.0 <= part <= 1.0 for part in colour.tolist()):
        raise InputError(
            f"background: expected red, green and blue in 0..1, got {colour}; divide bytes by 255"
        )
    return colour


def _reference(
    scenes: Scenes, camera: PinholeCamera, poses: Array, background: Array, antialiased: bool
) -> Iterator[Images]:
    """By reference.py; InputError where torch is missing."""
    try:
        from falconwing_kit.scene.reference import render_reference
    except ModuleNotFoundError as error:
        raise _missing("reference", error) from None
    scene = _join_scenes(scenes)
    for pose in poses:
        yield _cut(render_reference(scene, camera, pose, background, antialiased))


def _fast(
    scenes: Scenes, camera: PinholeCamera, poses: Array, background: Array, antialiased: bool
) -> Iterator[Images]:
    """By fast.py, which does not join scenes; InputError where numba is missing."""
    try:
        from falconwing_kit.scene.fast import render_fast
    except ModuleNotFoundError as error:
        raise _missing("fast", error) from None
    for pose in poses:
        yield _cut(render_fast(scenes, camera, pose, background, antialiased))


def _gsplat(
    scenes: Scenes, camera: PinholeCamera, poses: Array, background: Array, antialiased: bool
) -> Iterator[Images]:
    """By gsplat_backend.py; InputError where gsplat cannot run."""
    from falconwing_kit.scene.gsplat_backend import render_gsplat

    return render_gsplat(scenes, camera, poses, background, antialiased)


def _cut(images: Images) -> Images:
    """The images with colours above 1 cut."""
    rgb, alpha, depth = images
    return np.clip(rgb, 0.0, 1.0, out=rgb), alpha, depth


def _join_scenes(scenes: Scenes) -> GaussianScene:
    """One scene of all Gaussians; a single one is not copied."""
    return scenes[0] if len(scenes) == 1 else GaussianScene.joined(*scenes)


def _missing(backend: str, error: ModuleNotFoundError) -> InputError:
    """The error for a library that is not installed."""
    library = error.name
    return InputError(
        f"backend: expected {library} for {backend!r}, which is missing; run: pip install {library}"
    )


BACKENDS: dict[str, Callable[[Scenes, PinholeCamera, Array, Array, bool], Iterator[Images]]] = {
    "auto": _fast,
    "fast": _fast,
    "reference": _reference,
    "gsplat": _gsplat,
}
