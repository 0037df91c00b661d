"""Reference renderer: Gaussians and a camera pose as torch tensors -> images with gradients, a
function per equation.

The conventions are those of gsplat's "classic" mode, to the letter; the equations are those of
[K] Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering;
[Z] Zwicker et al. 2002, EWA Splatting;
[Y] Ye et al. 2024, gsplat: An Open-Source Library for Gaussian Splatting;
[M] Yu et al. 2023, Mip-Splatting.

Which Gaussians are drawn, in which order, and where a pixel is full is decided without gradients;
everything else has one, with respect to every tensor of the scene, to the pose and to the
background. All tensors have one dtype, float32 or float64, and that is what is computed in.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import Images

NEAR, FAR = 0.01, 1e10  # depths that are drawn [m]
BLUR_PX = 0.3  # added to both variances of a splat, which makes it about a pixel wide [px^2]
FIELD_MARGIN = (
    0.3  # the slope of a ray is cut this part of the half field of view beyond the image's edge
)
MAX_ALPHA, MIN_ALPHA = 0.999, 1.0 / 255.0
MAX_SIGMA = (
    10.0  # alpha is below 1/255 from 5.6 on; exp of more gives denormal numbers, which are slow
)
MIN_TRANSMITTANCE = 1e-4
TILE_PX = 16
CHUNK = 256  # splats that a tile takes at once: 16 x 16 x 256 numbers stay in the processor's cache
MAX_SAVED_SPLATS = (
    50_000  # splats in tiles whose numbers are kept for the gradients, about 10 kB each
)


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
        """Copies of a scene's arrays, of the dtype that is to be computed in."""
        arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
        return cls(*(torch.tensor(array, dtype=dtype) for array in arrays))


class Splats(NamedTuple):
    """Gaussians as they lie in the image, those that touch it, nearest first."""

    means_px: Tensor  # (M, 2) u, v
    conics: Tensor  # (M, 3) inverse covariance: its entries uu, uv, vv [1/px^2]
    opacities: Tensor  # (M,)
    colours: Tensor  # (M, 3) >= 0
    depths: Tensor  # (M,) along the camera's z axis [m]
    radii_px: Tensor  # (M, 2) half the box outside of which alpha is below 1/255
    indices: Tensor  # (M,) which Gaussian of the scene each one is


def render_reference(
    scene: GaussianScene,
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    background: ArrayLike,
    antialiased: bool = False,
    dtype: torch.dtype = torch.float32,
) -> Images:
    """Render a scene without gradients; `render` checks what this trusts.

    Args:
        scene: the Gaussians.
        camera: the intrinsics and the image's size.
        T_world_camera: (4, 4) the pose, "world from camera".
        background: (3,) red, green, blue, 0..1.
        antialiased: fade what is smaller than a pixel.
        dtype: what is computed in, torch.float32 or torch.float64.

    Returns:
        Colour (H, W, 3), not cut at 1, alpha (H, W) and expected depth (H, W) [m], as float32.
    """
    pose, behind = (
        torch.tensor(np.asarray(array), dtype=dtype) for array in (T_world_camera, background)
    )
    with torch.no_grad():
        images = render_tensors(
            GaussianTensors.from_scene(scene, dtype), camera, pose, behind, antialiased
        )
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
        gaussians: the scene.
        camera: the intrinsics and the image's size.
        T_world_camera: (4, 4) a rigid pose; its gradient is that of the twelve numbers of rotation
            and place.
        background: (3,) red, green, blue.
        antialiased: fade what is smaller than a pixel.

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
    """From Gaussians in the world to splats in the image.

    Args:
        gaussians: the scene.
        camera: the intrinsics and the image's size.
        T_world_camera: (4, 4) a rigid pose.
        antialiased: fade what is smaller than a pixel.

    Returns:
        The splats that touch the image, nearest first; Gaussians of one depth keep their order.
    """
    p_camera = view_transform(gaussians.means, T_world_camera)
    in_front = ((p_camera[:, 2] >= NEAR) & (p_camera[:, 2] <= FAR)).nonzero()[:, 0]
    near, p_camera = (
        GaussianTensors(*(tensor[in_front] for tensor in gaussians)),
        p_camera[in_front],
    )
    unblurred = image_covariances(
        covariances(near.quaternions, near.scales), p_camera, T_world_camera, camera
    )
    blurred = unblurred + BLUR_PX * torch.eye(2).to(unblurred)
    opacities = (
        near.opacities * compensations(unblurred, blurred) if antialiased else near.opacities
    )
    means_px = image_means(p_camera, camera)
    radii_px = radii(blurred, opacities)
    seen = intersects_image(means_px, radii_px, camera) & (determinants(blurred) > 0.0)
    drawn = seen.nonzero()[:, 0]
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
    """Points in camera axes: p_camera = R^T (p_world - t)  [K, section 4].

    Args:
        p_world: (N, 3) [m].
        T_world_camera: (4, 4).

    Returns:
        (N, 3) [m].
    """
    R_world_camera = T_world_camera[:3, :3]
    return (
        p_world - T_world_camera[:3, 3]
    ) @ R_world_camera  # rows: the transposed map, that is the inverse


def covariances(quaternions: Tensor, scales: Tensor) -> Tensor:
    """Shape of each Gaussian in the world: Sigma = R S S^T R^T  [K, eq. 6].

    Args:
        quaternions: (N, 4) w x y z, brought to length 1 here.
        scales: (N, 3) standard deviations along the Gaussian's axes [m].

    Returns:
        (N, 3, 3) [m^2].
    """
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    entries = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    rotations = torch.stack(entries, dim=1).reshape(-1, 3, 3)
    stretched = rotations * scales[:, None, :]
    return stretched @ stretched.mT


def image_means(p_camera: Tensor, camera: PinholeCamera) -> Tensor:
    """Where the means appear: u = fx x/z + cx,  v = fy y/z + cy; the first pixel's centre is (0.5,
    0.5)  [Y].

    Args:
        p_camera: (N, 3) in front of the camera [m].
        camera: the intrinsics.

    Returns:
        (N, 2) [px].
    """
    x, y, z = p_camera.unbind(1)
    return torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)


def image_covariances(
    covariances_world: Tensor, p_camera: Tensor, T_world_camera: Tensor, camera: PinholeCamera
) -> Tensor:
    """Shape of each splat: Sigma' = J R^T Sigma R J^T  [Z, eq. 31; K, eq. 5].

    Args:
        covariances_world: (N, 3, 3) [m^2].
        p_camera: (N, 3) the means in front of the camera [m].
        T_world_camera: (4, 4).
        camera: the intrinsics and the image's size.

    Returns:
        (N, 2, 2) [px^2], not yet blurred.
    """
    from_world = projection_jacobians(p_camera, camera) @ T_world_camera[:3, :3].mT
    return from_world @ covariances_world @ from_world.mT


def projection_jacobians(p_camera: Tensor, camera: PinholeCamera) -> Tensor:
    """How the image moves with the point: J = d(u, v) / d(x, y, z)  [Z, eq. 29].

    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]], where the slopes x/z and y/z are cut 0.3 of
    half the field of view beyond the image's edge: far out, the linearised projection would blow a
    Gaussian up over the whole image  [Y].

    Args:
        p_camera: (N, 3) in front of the camera [m].
        camera: the intrinsics and the image's size.

    Returns:
        (N, 2, 3) [px/m].
    """
    x, y, z = p_camera.unbind(1)
    margin_x = FIELD_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FIELD_MARGIN * 0.5 * camera.height / camera.fy
    slope_x = (x / z).clamp(
        -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x
    )
    slope_y = (y / z).clamp(
        -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y
    )
    zero = torch.zeros_like(z)
    rows = (
        camera.fx / z,
        zero,
        -camera.fx * slope_x / z,
        zero,
        camera.fy / z,
        -camera.fy * slope_y / z,
    )
    return torch.stack(rows, dim=1).reshape(-1, 2, 3)


def determinants(matrices: Tensor) -> Tensor:
    """Determinants (N,) of symmetric (N, 2, 2)."""
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2


def conics(blurred: Tensor) -> Tensor:
    """Inverse of each splat's covariance  [Y].

    Args:
        blurred: (N, 2, 2) [px^2], of positive determinant.

    Returns:
        (N, 3) its entries uu, uv, vv [1/px^2].
    """
    entries = torch.stack([blurred[:, 1, 1], -blurred[:, 0, 1], blurred[:, 0, 0]], dim=1)
    return entries / determinants(blurred)[:, None]


def compensations(unblurred: Tensor, blurred: Tensor) -> Tensor:
    """How much fainter a splat must be for the blur to keep its light: sqrt(det Sigma' / det(Sigma'
    + 0.3 I))  [M].

    Args:
        sharp: (N, 2, 2) covariances before the blur [px^2].
        blurred: (N, 2, 2) after it.

    Returns:
        (N,) 0..1; at least 1e-6, invisible, because the root has no slope at 0.
    """
    return (determinants(unblurred) / determinants(blurred)).clamp(min=1e-12).sqrt()


@torch.no_grad()
def radii(blurred: Tensor, opacities: Tensor) -> Tensor:
    """Half the box that holds every pixel of alpha >= 1/255, in whole pixels.

    o exp(-sigma) >= 1/255 where sigma <= ln(255 o), an ellipse that reaches sqrt(2 ln(255 o))
    standard deviations far.

    Args:
        blurred: (N, 2, 2) [px^2].
        opacities: (N,).

    Returns:
        (N, 2) [px]; 0 where the opacity is below 1/255, nan where it is nan.
    """
    reach = torch.sqrt(2.0 * torch.log(opacities / MIN_ALPHA).clamp(min=0.0))
    return (reach[:, None] * torch.sqrt(blurred.diagonal(dim1=1, dim2=2))).ceil()


@torch.no_grad()
def intersects_image(means_px: Tensor, radii_px: Tensor, camera: PinholeCamera) -> Tensor:
    """Which boxes, not empty, reach into the image.

    Args:
        means_px: (N, 2) their middles.
        radii_px: (N, 2) half their sides.
        camera: the image's size.

    Returns:
        (N,) of bool.
    """
    size = means_px.new_tensor([camera.width, camera.height])
    inside = (means_px + radii_px > 0.0) & (means_px - radii_px < size)
    return (inside & (radii_px > 0.0) & radii_px.isfinite()).all(dim=1)


def colours(sh: Tensor, towards_world: Tensor) -> Tensor:
    """Colour of each Gaussian as seen from the camera: max(0, 1/2 + sum_k sh_k Y_k(d))  [K, section
    4].

    Args:
        sh: (N, K, 3) coefficients.
        towards_world: (N, 3) from the camera to the mean, of any length.

    Returns:
        (N, 3) >= 0.
    """
    directions = torch.nn.functional.normalize(towards_world, dim=1)
    basis = spherical_harmonics(directions, sh.shape[1])
    return (0.5 + (basis[:, :, None] * sh).sum(dim=1)).clamp(min=0.0)


def spherical_harmonics(directions: Tensor, count: int) -> Tensor:
    """Real spherical harmonics Y_k(d), degree by degree, from order -degree to degree.

    The sign is that of 3D Gaussian Splatting's files: odd orders carry a minus (Condon and
    Shortley's phase).

    Args:
        directions: (N, 3) of length 1, world.
        count: 1, 4, 9 or 16, all of degree 0, 1, 2 or 3.

    Returns:
        (N, count).
    """
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    degrees = [
        [torch.full_like(x, 0.5)],
        [-math.sqrt(3 / 4) * y, math.sqrt(3 / 4) * z, -math.sqrt(3 / 4) * x],
        [
            math.sqrt(15 / 4) * x * y,
            -math.sqrt(15 / 4) * y * z,
            math.sqrt(5 / 16) * (2 * zz - xx - yy),
            -math.sqrt(15 / 4) * x * z,
            math.sqrt(15 / 16) * (xx - yy),
        ],
        [
            -math.sqrt(35 / 32) * y * (3 * xx - yy),
            math.sqrt(105 / 4) * x * y * z,
            -math.sqrt(21 / 32) * y * (4 * zz - xx - yy),
            math.sqrt(7 / 16) * z * (2 * zz - 3 * xx - 3 * yy),
            -math.sqrt(21 / 32) * x * (4 * zz - xx - yy),
            math.sqrt(105 / 16) * z * (xx - yy),
            -math.sqrt(35 / 32) * x * (xx - 3 * yy),
        ],
    ]
    return torch.stack(
        [basis for degree in degrees for basis in degree][:count], dim=1
    ) / math.sqrt(math.pi)


def composite(
    splats: Splats, width: int, height: int, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Lay the splats over each other, tile by tile, so that memory stays small  [K, section 6].

    Args:
        splats: nearest first.
        width: [px].
        height: [px].
        background: (3,) red, green, blue.

    Returns:
        Colour (H, W, 3) = sum_i w_i c_i + (1 - alpha) background, alpha (H, W) = sum_i w_i, and the
        expected depth (H, W) = sum_i w_i z_i / alpha [m], 0 where alpha is 0; gsplat calls it "ED".
    """
    low, high = (
        (splats.means_px - splats.radii_px).detach(),
        (splats.means_px + splats.radii_px).detach(),
    )
    columns = torch.cat(
        [
            *(
                splats.means_px,
                splats.conics,
                splats.opacities[:, None],
                splats.colours,
                splats.depths[:, None],
            ),
            torch.ones_like(splats.depths)[:, None],
        ],
        dim=1,
    )
    rows, composited = [], 0
    for top in range(0, height, TILE_PX):
        v = torch.arange(top, min(top + TILE_PX, height)).to(columns) + 0.5
        in_row = ((high[:, 1] > v[0]) & (low[:, 1] < v[-1])).nonzero()[:, 0]
        row, row_low, row_high = columns[in_row], low[in_row, 0], high[in_row, 0]
        tiles = []
        for left in range(0, width, TILE_PX):
            u = torch.arange(left, min(left + TILE_PX, width)).to(columns) + 0.5
            in_tile = ((row_high > u[0]) & (row_low < u[-1])).nonzero()[:, 0]
            composited += len(in_tile)
            tile = row.index_select(0, in_tile)
            tiles.append(
                blend_tile(tile, u, v)
                if composited <= MAX_SAVED_SPLATS
                else blend_checkpointed(tile, u, v)
            )
        rows.append(torch.cat(tiles, dim=1))
    sums = torch.cat(rows, dim=0)
    alpha = sums[:, :, 4]
    rgb = sums[:, :, :3] + (1.0 - alpha)[:, :, None] * background
    return rgb, alpha, sums[:, :, 3] / alpha.clamp(min=1e-10)


def blend_checkpointed(columns: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """`blend_tile`, whose numbers are not kept for the gradients but worked out again on the way
    back.
    """
    return checkpoint(blend_tile, columns, u, v, use_reentrant=False, preserve_rng_state=False)


def blend_tile(columns: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """One tile: sum_i w_i (r, g, b, z, 1),  w_i = alpha_i T_i,  T_i = prod_{j<i} (1 - alpha_j)  [K,
    eq. 2 and 3].

    A splat that would leave T <= 1e-4 behind it is not laid any more, nor any behind it.

    Args:
        columns: (M, 11) mean u, v; conic uu, uv, vv; opacity; red, green, blue, depth, 1; nearest
            first.
        u: (w,) centres of the tile's pixels [px].
        v: (h,) [px].

    Returns:
        (h, w, 5).
    """
    transmittance = columns.new_ones(1, len(v), len(u))
    sums = columns.new_zeros(len(v), len(u), 5)
    for chunk in columns.split(CHUNK):
        alpha = alphas(chunk, u, v)
        passed = torch.cat([transmittance, transmittance * torch.cumprod(1.0 - alpha, dim=0)])
        weights = torch.where(passed[1:] > MIN_TRANSMITTANCE, alpha * passed[:-1], 0.0)
        sums = sums + torch.einsum("mvu,mc->vuc", weights, chunk[:, 6:])
        transmittance = passed[-1:]
        if bool((transmittance <= MIN_TRANSMITTANCE).all()):
            break
    return sums


def alphas(columns: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """How much each splat covers of each pixel: alpha = min(0.999, o exp(-sigma)), 0 below 1/255
    [K; Y].

    sigma = 1/2 (uu du^2 + vv dv^2) + uv du dv, du and dv from the mean to the pixel's centre

    Args:
        columns: (M, 11) as in `blend_tile`.
        u: (w,) [px].
        v: (h,) [px].

    Returns:
        (M, h, w).
    """
    mean_u, mean_v, uu, uv, vv, opacity = (
        column[:, None, None] for column in columns[:, :6].unbind(1)
    )
    du, dv = u - mean_u, v[:, None] - mean_v
    sigma = 0.5 * uu * du * du + 0.5 * vv * dv * dv + uv * du * dv
    alpha = (opacity * torch.exp(-sigma.clamp(max=MAX_SIGMA))).clamp(max=MAX_ALPHA)
    return torch.where((sigma >= 0.0) & (alpha >= MIN_ALPHA), alpha, 0.0)
