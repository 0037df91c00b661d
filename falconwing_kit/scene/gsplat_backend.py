"""gsplat backend: Gaussian scenes and camera poses -> images from gsplat's CUDA kernels.

A call of gsplat is launched by the processor within a millisecond, so what is done there counts:

    upload     each scene once, found again by its identity; the poses of a call in one copy
    rasterize  many poses by one call of gsplat
    download   colours cut at 1 on the GPU; colour, alpha and depth in one copy
"""

from collections.abc import Iterator
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene, Images, Scenes

MAX_CACHED_SCENES = 4  # on the GPU: 125,000 Gaussians of degree 2 are 19 MB
MAX_CALL_BYTES = 1 << 30  # of GPU memory for the poses of one call; more poses take more calls
DEVICE = "cuda"
HELP = (
    "it needs an NVIDIA GPU with its CUDA toolkit, and: pip install torch gsplat==1.5.3;"
    " backend 'fast' runs anywhere"
)


def render_gsplat(
    scenes: Scenes,
    camera: PinholeCamera,
    Ts_world_camera: Array,
    background: ArrayLike,
    antialiased: bool = False,
) -> Iterator[Images]:
    """Render scenes as one from C poses (C, 4, 4) on the GPU; arguments as `render` checks them.

    Yields:
        For each pose rgb (H, W, 3), cut at 1, alpha (H, W) and depth (H, W) [m]. The images of one
        call of gsplat share a block of memory, which is freed with the last of them.

    Raises:
        InputError: gsplat cannot run here, or its memory is full; the text says why and what it
            needs.
    """
    probe_gsplat()
    import torch

    calls = -(-len(Ts_world_camera) // poses_per_call(scenes, camera))
    for poses in np.array_split(Ts_world_camera, calls):
        try:
            images = download(*rasterize(scenes, camera, poses, background, antialiased))
        except torch.cuda.OutOfMemoryError:
            size = f"{len(poses)} images of {camera.width}x{camera.height}"
            raise InputError(
                f"backend: expected room for {size} and the scene on the GPU, got out of memory;"
                " end other programs there, or use backend 'fast'"
            ) from None
        yield from zip(*images, strict=True)


def rasterize(
    scene: GaussianScene | Scenes,
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

    scenes = (scene,) if isinstance(scene, GaussianScene) else scene
    viewmats, Ks, backgrounds = _upload_views(camera, np.asarray(Ts_world_camera), background)
    means, quaternions, scales, opacities, sh = _joined_tensors(scenes)
    with torch.no_grad():
        colours, alphas, _ = rasterization(
            *(means, quaternions, scales, opacities, sh, viewmats, Ks, camera.width, camera.height),
            sh_degree=int(sh.shape[1] ** 0.5) - 1,
            packed=False,  # also works where no Gaussian is in view; faster while a scene fits
            backgrounds=backgrounds,
            render_mode="RGB+ED",
            rasterize_mode="antialiased" if antialiased else "classic",
        )
    return colours, alphas


def download(colours: Any, alphas: Any) -> Images:
    """What `rasterize` returns, as arrays: rgb (C, H, W, 3) cut at 1, alpha and depth (C, H, W)."""
    import torch

    shape, pixels = alphas.shape[:3], alphas.numel()
    on_gpu = torch.empty(5 * pixels, device=colours.device)
    torch.clamp(colours[..., :3], 0.0, 1.0, out=on_gpu[: 3 * pixels].view(*shape, 3))
    planes = on_gpu[3 * pixels :].view(2, *shape)
    torch.stack([alphas[..., 0], colours[..., 3]], out=planes)
    image = np.empty(5 * pixels, np.float32)
    torch.from_numpy(image).copy_(on_gpu)
    alpha, depth = image[3 * pixels :].reshape(2, *shape)
    return image[: 3 * pixels].reshape(*shape, 3), alpha, depth


def poses_per_call(scenes: Scenes, camera: PinholeCamera) -> int:
    """How many poses fit in MAX_CALL_BYTES, at least one.

    gsplat expands the scene for every pose: its coefficients, their directions, and a projection of
    16 numbers; every pixel takes 5 numbers, twice.
    """
    coefficients = max(scene.sh.shape[1] for scene in scenes)
    gaussians = sum(len(scene) for scene in scenes)
    numbers = gaussians * (3 * coefficients + 3 + 16) + 10 * camera.width * camera.height
    return max(1, MAX_CALL_BYTES // (4 * numbers))


def _upload_views(camera: PinholeCamera, Ts_world_camera: Array, background: ArrayLike) -> Any:
    """On the GPU in one copy: view matrices (C, 4, 4), intrinsics (C, 3, 3), colours (C, 3)."""
    import torch

    count, Ts_camera_world = len(Ts_world_camera), np.linalg.inv(Ts_world_camera)
    arrays = Ts_camera_world, np.tile(camera.K, (count, 1)), np.tile(background, count)
    numbers = np.concatenate([array.ravel() for array in arrays]).astype(np.float32)
    viewmats, Ks, colours = (
        torch.from_numpy(numbers).to(DEVICE).split([16 * count, 9 * count, 3 * count])
    )
    return viewmats.view(count, 4, 4), Ks.view(count, 3, 3), colours.view(count, 3)


def _joined_tensors(scenes: Scenes) -> tuple[Any, ...]:
    """The tensors of several scenes as one, joined on the GPU; a single scene is not copied."""
    import torch

    parts = [_tensors(scene) for scene in scenes]
    if len(parts) == 1:
        return parts[0]
    most = max(part[4].shape[1] for part in parts)
    pad = torch.nn.functional.pad  # colours of a lower degree are those of a higher with zeros
    sh = torch.cat([pad(part[4], (0, 0, 0, most - part[4].shape[1])) for part in parts])
    return *(torch.cat([part[k] for part in parts]) for k in range(4)), sh


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
