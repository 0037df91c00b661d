"""Reference renderer: Gaussians and a camera pose as torch tensors -> images with gradients.

One function per equation, with the conventions of gsplat's "classic" mode. The equations are from
[K] Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering;
[Z] Zwicker et al. 2002, EWA Splatting;
[Y] Ye et al. 2024, gsplat: An Open-Source Library for Gaussian Splatting;
[M] Yu et al. 2023, Mip-Splatting.

Which Gaussians are drawn, their order, and where a pixel is saturated is decided without gradients;
everything else has one, with respect to every tensor of the scene, to the pose and to the
background. All tensors have one dtype, float32 or float64.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene, Images
from falconwing_kit.scene.sh import SH_CONSTANTS

NEAR, FAR = 0.01, 1e10  # depths that are drawn [m]
BLUR_VARIANCE_PX2 = 0.3  # added to both variances of a splat: about a pixel wide [px^2]
FIELD_MARGIN = 0.3  # in half fields of view: the slope of a ray is clamped there, see the Jacobian
MAX_ALPHA, MIN_ALPHA = 0.999, 1.0 / 255.0
MAX_SIGMA = 10.0  # alpha is below 1/255 from 5.6 on; exp of much more is denormal, and slow
MIN_TRANSMITTANCE = 1e-4
TILE_PX = 16
CHUNK = 256  # splats that a tile takes together: 16 x 16 x 256 numbers stay in the cache
MAX_SAVED_SPLATS = 50_000  # splats in tiles whose intermediate results are kept, 10 kB each


class GaussianTensors(NamedTuple):
    """The Gaussians of a scene, ready for gradients; the fields are those of `GaussianScene`."""

    means: Tensor  # (N, 3) world [m]
    quaternions: Tensor  # (N, 4) w x y z, of any length but 0
    scales: Tensor  # (N, 3) standard deviations [m]
    opacities: Tensor  # (N,) 0..1
    sh: Tensor  # (N, K, 3) colour coefficients

    @classmethod
    def from_scene(
        cls, scene: GaussianScene, dtype: torch.dtype = torch.float32
    ) -> "GaussianTensors":
        """Copies of a scene's arrays, in the dtype of all computation."""
        arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
        return cls(*(torch.tensor(array, dtype=dtype) for array in arrays))


class Splats(NamedTuple):
    """Gaussians projected into the image, those that touch it, nearest first."""

    means_px: Tensor  # (M, 2) u, v
    conics: Tensor  # (M, 3) inverse covariance: its entries uu, uv, vv [1/px^2]
    opacities: Tensor  # (M,)
    colours: Tensor  # (M, 3) >= 0
    depths: Tensor  # (M,) along the camera's z axis [m]
    radii_px: Tensor  # (M, 2) half the box outside of which alpha is below 1/255
    indices: Tensor  # (M,) of the Gaussian in the scene


def render_reference(
    scene: GaussianScene,
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    background: ArrayLike,
    antialiased: bool = False,
    dtype: torch.dtype = torch.float32,
) -> Images:
    """Render a scene without gradients; arguments as `render` checks them."""
    pose = torch.tensor(np.asarray(T_world_camera), dtype=dtype)
    behind = torch.tensor(np.asarray(background), dtype=dtype)
    gaussians = GaussianTensors.from_scene(scene, dtype)
    with torch.no_grad():
        images = render_tensors(gaussians, camera, pose, behind, antialiased)
    rgb, alpha, depth = (image.numpy().astype(np.float32, copy=False) for image in images)
    return rgb, alpha, depth


def render_tensors(
    gaussians: GaussianTensors,
    camera: PinholeCamera,
    T_world_camera: Tensor,
    background: Tensor,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render with gradients: `project_gaussians`, then `composite`.

    Args:
        T_world_camera: (4, 4) a rigid pose; its gradient is that of its first twelve entries.
        background: (3,) red, green, blue.
        antialiased: dim what is smaller than a pixel.

    Returns:
        Colour (H, W, 3), alpha (H, W) and expected depth (H, W) [m], 0 where alpha is 0.
    """
    splats = project_gaussians(gaussians, camera, T_world_camera, antialiased)
    return composite(splats, camera.width, camera.height, background)


def project_gaussians(
    gaussians: GaussianTensors,
    camera: PinholeCamera,
    T_world_camera: Tensor,
    antialiased: bool = False,
) -> Splats:
    """Project Gaussians of the world into the image; those of one depth keep their order."""
    p_camera = view_transform(gaussians.means, T_world_camera)
    in_front = ((p_camera[:, 2] >= NEAR) & (p_camera[:, 2] <= FAR)).nonzero()[:, 0]
    near = GaussianTensors(*(tensor[in_front] for tensor in gaussians))
    p_camera = p_camera[in_front]
    # Ellipses in the image, at least a pixel wide
    shapes = covariances(near.quaternions, near.scales)
    unblurred = image_covariances(shapes, p_camera, T_world_camera, camera)
    blurred = unblurred + BLUR_VARIANCE_PX2 * torch.eye(2).to(unblurred)
    opacities = near.opacities
    if antialiased:
        opacities = opacities * compensations(unblurred, blurred)
    # Those that touch the image, nearest first
    means_px = image_means(p_camera, camera)
    radii_px = radii(blurred, opacities)
    visible = intersects_image(means_px, radii_px, camera) & (determinants(blurred) > 0.0)
    drawn = visible.nonzero()[:, 0]
    drawn = drawn[torch.argsort(p_camera[drawn, 2], stable=True)]
    return Splats(
        means_px[drawn],
        conics(blurred[drawn]),
        opacities[drawn],
        colours(near.sh[drawn], near.means[drawn] - T_world_camera[:3, 3]),
        p_camera[drawn, 2],
        radii_px[drawn],
        in_front[drawn],
    )


def view_transform(p_world: Tensor, T_world_camera: Tensor) -> Tensor:
    """Points (N, 3) in camera axes [m]: p_camera = R^T (p_world - t)  [K, section 4]."""
    R_world_camera = T_world_camera[:3, :3]
    # Points are rows, so the product applies the transpose of R, its inverse.
    return (p_world - T_world_camera[:3, 3]) @ R_world_camera


def covariances(quaternions: Tensor, scales: Tensor) -> Tensor:
    """Covariances (N, 3, 3) in the world [m^2]: Sigma = R S S^T R^T  [K, eq. 6].

    Args:
        quaternions: (N, 4) w x y z, normalised here.
        scales: (N, 3) standard deviations along the principal axes [m].
    """
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    entries = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    R = torch.stack(entries, dim=1).reshape(-1, 3, 3)
    RS = R * scales[:, None, :]
    return RS @ RS.mT


def image_means(p_camera: Tensor, camera: PinholeCamera) -> Tensor:
    """Projected means (N, 2) [px]: u = fx x/z + cx,  v = fy y/z + cy  [Y]."""
    x, y, z = p_camera.unbind(1)
    return torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)


def image_covariances(
    covariances_world: Tensor, p_camera: Tensor, T_world_camera: Tensor, camera: PinholeCamera
) -> Tensor:
    """Covariances (N, 2, 2) of the unblurred splats [px^2]; p_camera (N, 3) are the means [m].

    Sigma' = J R^T Sigma R J^T  [Z, eq. 31; K, eq. 5]
    """
    JR = projection_jacobians(p_camera, camera) @ T_world_camera[:3, :3].mT
    return JR @ covariances_world @ JR.mT


def projection_jacobians(p_camera: Tensor, camera: PinholeCamera) -> Tensor:
    """Jacobians (N, 2, 3) of the projection [px/m]: J = d(u, v) / d(x, y, z)  [Z, eq. 29].

    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]], where the slopes x/z and y/z are clamped 0.3
    of half the field of view beyond the image's edge: farther out, the linearised projection would
    enlarge a Gaussian over the whole image  [Y].
    """
    x, y, z = p_camera.unbind(1)
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    margin_x = FIELD_MARGIN * 0.5 * camera.width / fx
    margin_y = FIELD_MARGIN * 0.5 * camera.height / fy
    slope_x = (x / z).clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    slope_y = (y / z).clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    entries = (fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z)
    return torch.stack(entries, dim=1).reshape(-1, 2, 3)


def determinants(matrices: Tensor) -> Tensor:
    """Determinants (N,) of symmetric (N, 2, 2)."""
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2


def conics(blurred: Tensor) -> Tensor:
    """Entries uu, uv, vv (N, 3) of the inverse covariances (N, 2, 2) [1/px^2]  [Y]."""
    entries = torch.stack([blurred[:, 1, 1], -blurred[:, 0, 1], blurred[:, 0, 0]], dim=1)
    return entries / determinants(blurred)[:, None]


def compensations(unblurred: Tensor, blurred: Tensor) -> Tensor:
    """Factors (N,) 0..1 by which the blur must dim a splat to keep its light  [M].

    sqrt(det Sigma' / det(Sigma' + 0.3 I)), at least 1e-6 because the derivative of the
    square root is infinite at 0
    """
    return (determinants(unblurred) / determinants(blurred)).clamp(min=1e-12).sqrt()


@torch.no_grad()
def radii(blurred: Tensor, opacities: Tensor) -> Tensor:
    """Half the box (N, 2) that holds every pixel of alpha >= 1/255, in whole pixels.

    o exp(-sigma) >= 1/255 where sigma <= ln(255 o), an ellipse of sqrt(2 ln(255 o)) standard
    deviations. 0 where the opacity is below 1/255, nan where it is nan.
    """
    extent = torch.sqrt(2.0 * torch.log(opacities / MIN_ALPHA).clamp(min=0.0))
    return (extent[:, None] * torch.sqrt(blurred.diagonal(dim1=1, dim2=2))).ceil()


@torch.no_grad()
def intersects_image(means_px: Tensor, radii_px: Tensor, camera: PinholeCamera) -> Tensor:
    """(N,) True for boxes, not empty, that overlap the image; both arguments are (N, 2)."""
    size = means_px.new_tensor([camera.width, camera.height])
    inside = (means_px + radii_px > 0.0) & (means_px - radii_px < size)
    return (inside & (radii_px > 0.0) & radii_px.isfinite()).all(dim=1)


def colours(sh: Tensor, towards_world: Tensor) -> Tensor:
    """Colours (N, 3) seen from the camera: max(0, 1/2 + sum_k sh_k Y_k(d))  [K, section 4].

    Args:
        sh: (N, K, 3) coefficients.
        towards_world: (N, 3) from the camera to the mean, of any length.
    """
    directions = torch.nn.functional.normalize(towards_world, dim=1)
    basis = spherical_harmonics(directions, sh.shape[1])
    return (0.5 + (basis[:, :, None] * sh).sum(dim=1)).clamp(min=0.0)


def spherical_harmonics(directions: Tensor, count: int) -> Tensor:
    """Real spherical harmonics Y_k(d) (N, count) of unit directions (N, 3), as in `scene.sh`."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    c = SH_CONSTANTS
    degrees = [
        [torch.full_like(x, c[0])],
        [-c[1] * y, c[1] * z, -c[1] * x],
        [
            c[2] * x * y,
            -c[2] * y * z,
            c[3] * (2 * zz - xx - yy),
            -c[2] * x * z,
            c[4] * (xx - yy),
        ],
        [
            -c[5] * y * (3 * xx - yy),
            c[6] * x * y * z,
            -c[7] * y * (4 * zz - xx - yy),
            c[8] * z * (2 * zz - 3 * xx - 3 * yy),
            -c[7] * x * (4 * zz - xx - yy),
            c[9] * z * (xx - yy),
            -c[5] * x * (xx - 3 * yy),
        ],
    ]
    return torch.stack([Y for degree in degrees for Y in degree][:count], dim=1)


def composite(
    splats: Splats, width: int, height: int, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend the splats front to back, tile by tile, so that memory stays small  [K, section 6].

    Returns:
        Colour (H, W, 3) = sum_i w_i c_i + (1 - alpha) background, alpha (H, W) = sum_i w_i, and the
        expected depth (H, W) = sum_i w_i z_i / alpha [m], 0 where alpha is 0; gsplat calls it "ED".
    """
    low = (splats.means_px - splats.radii_px).detach()
    high = (splats.means_px + splats.radii_px).detach()
    opacities, depths = splats.opacities[:, None], splats.depths[:, None]
    ones = torch.ones_like(depths)  # their weighted sum is alpha
    parts = [splats.means_px, splats.conics, opacities, splats.colours, depths, ones]
    columns = torch.cat(parts, dim=1)  # (M, 11)
    rows, composited = [], 0
    for top in range(0, height, TILE_PX):
        # Splats whose box overlaps the row of tiles, then those that overlap the tile
        v = torch.arange(top, min(top + TILE_PX, height)).to(columns) + 0.5
        in_row = ((high[:, 1] > v[0]) & (low[:, 1] < v[-1])).nonzero()[:, 0]
        row, row_low, row_high = columns[in_row], low[in_row, 0], high[in_row, 0]
        tiles = []
        for left in range(0, width, TILE_PX):
            u = torch.arange(left, min(left + TILE_PX, width)).to(columns) + 0.5
            in_tile = ((row_high > u[0]) & (row_low < u[-1])).nonzero()[:, 0]
            composited += len(in_tile)
            blend = blend_tile if composited <= MAX_SAVED_SPLATS else blend_checkpointed
            tiles.append(blend(row.index_select(0, in_tile), u, v))
        rows.append(torch.cat(tiles, dim=1))
    sums = torch.cat(rows, dim=0)  # (H, W, 5): red, green, blue, depth, alpha
    alpha = sums[:, :, 4]
    rgb = sums[:, :, :3] + (1.0 - alpha)[:, :, None] * background
    return rgb, alpha, sums[:, :, 3] / alpha.clamp(min=1e-10)


def blend_checkpointed(columns: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """`blend_tile`, recomputed in the backward pass instead of keeping intermediate results."""
    return checkpoint(blend_tile, columns, u, v, use_reentrant=False, preserve_rng_state=False)


def blend_tile(columns: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """One tile (h, w, 5): sum_i w_i (r, g, b, z, 1),  w_i = alpha_i T_i  [K, eq. 2 and 3].

    T_i = prod_{j<i} (1 - alpha_j). Compositing stops at the first splat that would leave a
    transmittance T <= 1e-4 behind it.

    Args:
        columns: (M, 11) mean u, v; conic uu, uv, vv; opacity; red, green, blue, depth, 1; nearest
            first.
        u: (w,) centres of the tile's pixels [px].
        v: (h,) [px].
    """
    transmittance = columns.new_ones(1, len(v), len(u))
    sums = columns.new_zeros(len(v), len(u), 5)
    for chunk in columns.split(CHUNK):
        alpha = alphas(chunk, u, v)
        # (M + 1, h, w): T before each splat of the chunk and, shifted by one, behind it
        passed = torch.cat([transmittance, transmittance * torch.cumprod(1.0 - alpha, dim=0)])
        weights = torch.where(passed[1:] > MIN_TRANSMITTANCE, alpha * passed[:-1], 0.0)
        sums = sums + torch.einsum("mvu,mc->vuc", weights, chunk[:, 6:])
        transmittance = passed[-1:]
        if bool((transmittance <= MIN_TRANSMITTANCE).all()):
            break
    return sums


def alphas(columns: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Alpha (M, h, w) of each splat in each pixel, 0 below 1/255  [K; Y].

    alpha = min(0.999, o exp(-sigma))
    sigma = 1/2 (uu du^2 + vv dv^2) + uv du dv, du and dv from the mean to the pixel's centre
    """
    mean_u, mean_v, uu, uv, vv, opacity = (
        column[:, None, None] for column in columns[:, :6].unbind(1)
    )
    du, dv = u - mean_u, v[:, None] - mean_v
    sigma = 0.5 * uu * du * du + 0.5 * vv * dv * dv + uv * du * dv
    alpha = (opacity * torch.exp(-sigma.clamp(max=MAX_SIGMA))).clamp(max=MAX_ALPHA)
    return torch.where((sigma >= 0.0) & (alpha >= MIN_ALPHA), alpha, 0.0)
