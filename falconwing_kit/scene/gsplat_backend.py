"""gsplat backend: a Gaussian scene and a camera pose -> images from gsplat's CUDA kernels."""

from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene, Images

MAX_CACHED_SCENES = 4  # on the GPU: 125,000 Gaussians of degree 2 are 19 MB
DEVICE = "cuda"
HELP = (
    "it needs an NVIDIA GPU with its CUDA toolkit, and: pip install torch gsplat==1.5.3;"
    " backend 'fast' runs anywhere"
)


def render_gsplat(
    scene: GaussianScene,
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    background: ArrayLike,
    antialiased: bool = False,
) -> Images:
    """Render a scene on the GPU, where the last few scenes stay; arguments as `render` checks them.

    Raises:
        InputError: gsplat cannot run here; the text says why and what it needs.
    """
    probe_gsplat()
    poses = np.asarray(T_world_camera)[None]
    colours, alphas = rasterize(scene, camera, poses, background, antialiased)
    image = colours[0].cpu().numpy()
    return image[..., :3], alphas[0, ..., 0].cpu().numpy(), image[..., 3]


def rasterize(
    scene: GaussianScene,
    camera: PinholeCamera,
    Ts_world_camera: ArrayLike,
    background: ArrayLike,
    antialiased: bool,
) -> tuple[Any, Any]:
    """Render C poses (C, 4, 4) in one call, which costs little more than one pose.

    Returns:
        Torch tensors on the GPU: red, green, blue, expected depth [m] (C, H, W, 4), and alpha
        (C, H, W, 1).
    """
    import torch
    from gsplat import rasterization

    Ts_camera_world = np.linalg.inv(np.asarray(Ts_world_camera))
    count = len(Ts_camera_world)
    arrays = Ts_camera_world, np.tile(camera.K, (count, 1, 1)), np.tile(background, (count, 1))
    viewmats, Ks, backgrounds = (
        torch.tensor(array, dtype=torch.float32, device=DEVICE) for array in arrays
    )
    means, quaternions, scales, opacities, sh = _tensors(scene)
    colours, alphas, _ = rasterization(
        *(means, quaternions, scales, opacities, sh, viewmats, Ks, camera.width, camera.height),
        sh_degree=int(sh.shape[1] ** 0.5) - 1,
        packed=False,  # also works where no Gaussian is in view; faster while a scene fits
        backgrounds=backgrounds,
        render_mode="RGB+ED",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    return colours, alphas


@cache
def probe_gsplat() -> None:
    """Render one Gaussian as a test; the first time, gsplat may compile for minutes.

    Raises:
        InputError: that failed.
    """
    one = GaussianScene(
        means=np.array([[0, 0, 1]], np.float32),
        quaternions=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 0.1, np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    camera = PinholeCamera(8, 8, 4, 4, 8, 8)
    try:
        _, alphas = rasterize(one, camera, np.eye(4)[None], np.zeros(3), False)
        alpha = float(alphas.max())
    # gsplat fails in many ways: missing library, compiler, driver, None instead of a module
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"backend: expected gsplat to render one Gaussian, got: {reason}; {HELP}"
        ) from None
    if not 0.5 < alpha < 1.0:
        raise InputError(
            f"backend: expected gsplat to render one Gaussian, got one of alpha {alpha:.3g}; {HELP}"
        )


@lru_cache(maxsize=MAX_CACHED_SCENES)
def _tensors(scene: GaussianScene) -> tuple[Any, ...]:
    """The scene's arrays on the GPU; scenes are frozen and hashed by identity."""
    import torch

    arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
    return tuple(torch.tensor(array, device=DEVICE) for array in arrays)
