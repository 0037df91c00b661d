"""Renderer: a Gaussian scene and a camera pose -> colour, alpha and depth, by any backend."""

from collections.abc import Callable, Sequence
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
    scenes = (scene,) if isinstance(scene, GaussianScene) else _require_scenes(scene)
    if not isinstance(camera, PinholeCamera):
        raise InputError(f"camera: expected a PinholeCamera, got {type(camera).__name__}")
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise InputError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    pose, colour = require_pose("T_world_camera", T_world_camera), _require_colour(background)
    rgb, alpha, depth = BACKENDS[backend](scenes, camera, pose, colour, bool(antialiased))
    return Frame(np.clip(rgb, 0.0, 1.0, out=rgb), alpha, depth)


def _require_scenes(scenes: Sequence[GaussianScene]) -> Scenes:
    """Raise InputError unless it is a list or tuple of one scene or more."""
    several = tuple(scenes) if isinstance(scenes, list | tuple) else ()
    if not several or not all(isinstance(scene, GaussianScene) for scene in several):
        got = type(scenes).__name__
        raise InputError(
            f"scene: expected a GaussianScene, got {got}; GaussianScene.load reads a file"
        )
    return several


def _require_colour(background: ArrayLike) -> Array:
    """Raise InputError unless it is red, green and blue (3,) in 0..1."""
    colour = require_shape("background", background, (3,))
    if not ((colour >= 0.0) & (colour <= 1.0)).all():
        raise InputError(
            f"background: expected red, green and blue in 0..1, got {colour}; divide bytes by 255"
        )
    return colour


def _reference(
    scenes: Scenes, camera: PinholeCamera, pose: Array, background: Array, antialiased: bool
) -> Images:
    """By reference.py; InputError where torch is missing."""
    try:
        from falconwing_kit.scene.reference import render_reference
    except ModuleNotFoundError as error:
        raise _missing("reference", error) from None
    return render_reference(_join_scenes(scenes), camera, pose, background, antialiased)


def _fast(
    scenes: Scenes, camera: PinholeCamera, pose: Array, background: Array, antialiased: bool
) -> Images:
    """By fast.py, which does not join scenes; InputError where numba is missing."""
    try:
        from falconwing_kit.scene.fast import render_fast
    except ModuleNotFoundError as error:
        raise _missing("fast", error) from None
    return render_fast(scenes, camera, pose, background, antialiased)


def _gsplat(
    scenes: Scenes, camera: PinholeCamera, pose: Array, background: Array, antialiased: bool
) -> Images:
    """By gsplat_backend.py; InputError where gsplat cannot run."""
    from falconwing_kit.scene.gsplat_backend import render_gsplat

    return render_gsplat(_join_scenes(scenes), camera, pose, background, antialiased)


def _join_scenes(scenes: Scenes) -> GaussianScene:
    """One scene of all Gaussians; a single one is not copied."""
    return scenes[0] if len(scenes) == 1 else GaussianScene.joined(*scenes)


def _missing(backend: str, error: ModuleNotFoundError) -> InputError:
    """The error for a library that is not installed."""
    library = error.name
    return InputError(
        f"backend: expected {library} for {backend!r}, which is missing; run: pip install {library}"
    )


BACKENDS: dict[str, Callable[[Scenes, PinholeCamera, Array, Array, bool], Images]] = {
    "auto": _fast,
    "fast": _fast,
    "reference": _reference,
    "gsplat": _gsplat,
}
