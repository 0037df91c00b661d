"""The renderer's door: a Gaussian scene and a camera pose -> colour, alpha and depth per pixel, by
any backend.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.ply import Array32

Scenes = tuple[GaussianScene, ...]
Images = tuple[
    Array32, Array32, Array32
]  # colour, alpha and depth, before the colours are cut to 0..1
MAX_SKEW = 1e-4  # a rotation kept in float32 and multiplied a few times is this close to a true one


@dataclass(frozen=True, eq=False)
class Frame:
    """What a camera sees, pixel by pixel; rows run down and columns right."""

    rgb: Array32  # (H, W, 3) red, green, blue in 0..1, over the background
    alpha: Array32  # (H, W) how much of the background is covered, 0..1
    # (H, W) along the camera's z axis, the mean over what covers the pixel [m]; 0 where nothing
    # does
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
        scene: the Gaussians; or several scenes, drawn as if joined: a hall that rests and an
            aircraft that moves.
        camera: the intrinsics and the image's size.
        T_world_camera: (4, 4) the pose, "world from camera", camera axes x right, y down, z
            forward.
        backend: "reference" (torch, the readable one), "fast" (numba), "gsplat" (CUDA) or "auto",
            which is "fast".
        background: (3,) red, green, blue behind the scene, 0..1.
        antialiased: fade a Gaussian that is smaller than a pixel instead of widening it; for scenes
            trained so.

    Returns:
        The frame. Colours above 1, which a trained scene can have, are cut to 1 as a camera would.

    Raises:
        InputError: an argument is wrong, or the backend cannot run here; the text says what would
            help.
    """
    scenes = (scene,) if isinstance(scene, GaussianScene) else _require_scenes(scene)
    if not isinstance(camera, PinholeCamera):
        raise InputError(f"camera: expected a PinholeCamera, got {type(camera).__name__}")
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise InputError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    T_world_camera, background = (
        require_pose("T_world_camera", T_world_camera),
        _require_colour(background),
    )
    rgb, alpha, depth = BACKENDS[backend](
        scenes, camera, T_world_camera, background, bool(antialiased)
    )
    return Frame(np.clip(rgb, 0.0, 1.0, out=rgb), alpha, depth)


def _require_scenes(scenes: Sequence[GaussianScene]) -> Scenes:
    """Several scenes as a tuple."""
    several = tuple(scenes) if isinstance(scenes, list | tuple) else ()
    if not several or not all(isinstance(scene, GaussianScene) for scene in several):
        raise InputError(
            f"scene: expected a GaussianScene, got {type(scenes).__name__}; GaussianScene.load reads a file"
        )
    return several


def _joined(scenes: Scenes) -> GaussianScene:
    return scenes[0] if len(scenes) == 1 else GaussianScene.joined(*scenes)


def require_pose(name: str, pose: ArrayLike) -> Array:
    """Return a pose as float64 if it is one: finite, a rotation and a place, with the last row 0 0
    0 1.

    Args:
        name: what the pose is called in the message.
        pose: (4, 4).

    Raises:
        InputError: the shape is wrong, a number is not finite, or it stretches, shears or mirrors.
    """
    T = require_shape(name, pose, (4, 4))
    if not np.isfinite(T).all():
        raise InputError(
            f"{name}: expected finite numbers, got {np.count_nonzero(~np.isfinite(T))} that are not"
        )
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(
            f"{name}: expected the last row 0 0 0 1, got {T[3]}; is the matrix transposed?"
        )
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > MAX_SKEW or np.linalg.det(R) < 0.0:
        raise InputError(
            f"{name}: expected a rotation in the first three columns, got one that stretches or mirrors"
        )
    return T


def _require_colour(background: ArrayLike) -> Array:
    """The background as three numbers in 0..1."""
    colour = require_shape("background", background, (3,))
    if not ((colour >= 0.0) & (colour <= 1.0)).all():
        raise InputError(
            f"background: expected red, green and blue in 0..1, got {colour}; divide bytes by 255"
        )
    return colour


def _reference(
    scenes: Scenes,
    camera: PinholeCamera,
    T_world_camera: Array,
    background: Array,
    antialiased: bool,
) -> Images:
    try:
        from falconwing_kit.scene.reference import render_reference
    except ModuleNotFoundError as error:
        raise _missing("reference", error) from None
    return render_reference(_joined(scenes), camera, T_world_camera, background, antialiased)


def _fast(
    scenes: Scenes,
    camera: PinholeCamera,
    T_world_camera: Array,
    background: Array,
    antialiased: bool,
) -> Images:
    try:
        from falconwing_kit.scene.fast import render_fast
    except ModuleNotFoundError as error:
        raise _missing("fast", error) from None
    return render_fast(scenes, camera, T_world_camera, background, antialiased)


def _gsplat(
    scenes: Scenes,
    camera: PinholeCamera,
    T_world_camera: Array,
    background: Array,
    antialiased: bool,
) -> Images:
    from falconwing_kit.scene.gsplat_backend import render_gsplat

    return render_gsplat(_joined(scenes), camera, T_world_camera, background, antialiased)


def _missing(backend: str, error: ModuleNotFoundError) -> InputError:
    """The sentence for a library that is not installed."""
    return InputError(
        f"backend: expected {error.name} for {backend!r}, which is missing; run: pip install {error.name}"
    )


BACKENDS: dict[str, Callable[[Scenes, PinholeCamera, Array, Array, bool], Images]] = {
    "auto": _fast,
    "fast": _fast,
    "reference": _reference,
    "gsplat": _gsplat,
}
