"""Differentiable rendering for training: Gaussians and poses as torch tensors -> images."""

from collections.abc import Callable

import torch
from torch import Tensor

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.reference import GaussianTensors, render_tensors

# Gaussians, camera, poses (C, 4, 4), background (3,), antialiased -> colour (C, H, W, 3) and alpha
# (C, H, W).
Draw = Callable[[GaussianTensors, PinholeCamera, Tensor, Tensor, bool], tuple[Tensor, Tensor]]


def draw_reference(
    gaussians: GaussianTensors,
    camera: PinholeCamera,
    Ts_world_camera: Tensor,
    background: Tensor,
    antialiased: bool,
) -> tuple[Tensor, Tensor]:
    """Render with the reference renderer, one pose after the other: for small scenes on a CPU.

    Args:
        Ts_world_camera: (C, 4, 4).
        background: (3,) red, green, blue.
        antialiased: scale the opacity of splats smaller than a pixel.

    Returns:
        Colour (C, H, W, 3), not clipped at 1, and alpha (C, H, W).
    """
    images = [
        render_tensors(gaussians, camera, T, background, antialiased)[:2] for T in Ts_world_camera
    ]
    colours, alphas = zip(*images, strict=True)
    return torch.stack(colours), torch.stack(alphas)


def draw_gsplat(
    gaussians: GaussianTensors,
    camera: PinholeCamera,
    Ts_world_camera: Tensor,
    background: Tensor,
    antialiased: bool,
) -> tuple[Tensor, Tensor]:
    """`draw_reference` by gsplat's CUDA kernels for a batch of poses; equal up to rounding."""
    from gsplat import rasterization

    count = len(Ts_world_camera)
    K = torch.tensor(camera.K, dtype=torch.float32, device=Ts_world_camera.device)
    colours, alphas, _ = rasterization(
        *gaussians,
        invert_poses(Ts_world_camera),
        K.expand(count, 3, 3),
        camera.width,
        camera.height,
        sh_degree=int(gaussians.sh.shape[1] ** 0.5) - 1,
        packed=False,
        backgrounds=background.expand(count, 3),
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    return colours, alphas[..., 0]


def invert_poses(Ts: Tensor) -> Tensor:
    """Inverse (C, 4, 4) of rigid poses: R^T and -R^T t."""
    R = Ts[:, :3, :3].mT
    upper = torch.cat([R, -R @ Ts[:, :3, 3:]], dim=2)
    return torch.cat([upper, Ts[:, 3:]], dim=1)


def apply_twists(Ts_world_camera: Tensor, twists: Tensor) -> Tensor:
    """Poses after small twists in camera axes: T exp([w x, v; 0, 0])  [Lynch & Park, eq. 3.88].

    Args:
        Ts_world_camera: (C, 4, 4).
        twists: (C, 6) rotation w [rad], then translation v [m].

    Returns:
        (C, 4, 4).
    """
    zero = torch.zeros_like(twists[:, 0])
    x, y, z, a, b, c = twists.unbind(1)
    rows = (zero, -z, y, a, z, zero, -x, b, -y, x, zero, c, zero, zero, zero, zero)
    return Ts_world_camera @ torch.linalg.matrix_exp(torch.stack(rows, dim=1).reshape(-1, 4, 4))


def choose_renderer(backend: str) -> tuple[Draw, str]:
    """The renderer of a backend and its device.

    Args:
        backend: "gsplat", "reference", or "auto": gsplat where there is a GPU.

    Raises:
        InputError: gsplat cannot run here, or there is no backend of that name.
    """
    if backend not in ("auto", "gsplat", "reference"):
        raise InputError(
            f"backend: expected auto, gsplat or reference for training, got {backend!r}"
        )
    if backend == "reference" or (backend == "auto" and not torch.cuda.is_available()):
        return draw_reference, "cpu"
    from falconwing_kit.scene.gsplat_backend import probe_gsplat

    probe_gsplat()
    return draw_gsplat, "cuda"
