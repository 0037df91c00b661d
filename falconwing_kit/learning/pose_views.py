"""Views to learn poses from: a scene, photos with poses and chance -> images, depths and the
cameras' poses.

Where cameras are drawn, in shares that the caller gives:
    aircraft       anywhere in the hall's box half a metre from its walls; heading anywhere; roll with a standard
                   deviation of 25 deg, pitch of 12 deg
    photographers  beside a photo of the training set, 0.7 m and 10 deg away from it (standard
    deviations per axis)
    photos         where a photo was taken, turned by a few degrees: what the photo saw is taken from it, exactly, since
                   a turn about the camera's centre needs no depth; the rest is rendered
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import camera_pose, pose_matrix, rotation_world_body
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import render
from falconwing_kit.vision.pose_network import CELL

WALL = 0.5  # m, how near to the box's sides an aircraft flies
TURN_DEG, SHIFT = 10.0, 0.7  # of photographers
MIN_COVERED, NEAR, NEAR_SHARE = (
    0.85,
    0.4,
    0.2,
)  # a view counts if it is covered so far and few of its pixels are so near [m]
# renders are made with so many times the pixels, and averaged, as a photo's are when it is made
# smaller
SUPERSAMPLING = 2
BATCH = 32  # views a call of the GPU renderer
LEADER_NEAR, LEADER_FAR = 1.5, 12.0  # m

# Poses (C, 4, 4) -> colour (C, H, W, 3), alpha (C, H, W) and depth (C, H, W) [m] as tensors on the
# device.
RenderFunction = Callable[[Array], tuple[Tensor, Tensor, Tensor]]


class PosedImages(Protocol):
    """P images of one camera and where each was taken, such as the photos that a scene was trained
    on.
    """

    @property
    def camera(self) -> PinholeCamera:
        """Of all images, without distortion."""

    @property
    def images(self) -> Tensor:
        """(P, H, W, 3) bytes."""

    @property
    def Ts_world_camera(self) -> Tensor:
        """(P, 4, 4) float32."""


class Views(NamedTuple):
    """N images and the truth about them."""

    images: Tensor  # (N, 3, H, W) bytes
    # (N, K) along the camera's z axis where each cell's ray goes [m]; 0 where something hides the
    # hall
    depths: Tensor
    Ts_world_camera: Tensor  # (N, 4, 4) float32


@dataclass(frozen=True, eq=False)
class ViewSource:
    """What views are made of."""

    render_hall: RenderFunction  # renders the hall by the fine camera
    camera: PinholeCamera  # the network's
    low: Array  # (3,) the box in which aircraft fly [m]
    high: Array
    photos: PosedImages | None = None  # to learn from, of the fine camera's size or more
    render_leader: RenderFunction | None = None  # renders the leader alone, in its body axes
    near_share: float = 0.35  # of views beside photos
    photo_share: float = 0.15  # of views taken from photos
    leader_share: float = 0.2  # of views with a leader in them
    device: str = "cpu"


def make_renderer(
    scene: GaussianScene, camera: PinholeCamera, backend: str, antialiased: bool = False
) -> RenderFunction:
    """A function that renders a scene from many poses, by gsplat in large calls, else one by one.

    Args:
        scene: the Gaussians.
        camera: the intrinsics and the image's size.
        backend: of `render`.
        antialiased: as the scene was trained.
    """

    def by_gsplat(Ts_world_camera: Array) -> tuple[Tensor, Tensor, Tensor]:
        from falconwing_kit.scene.gsplat_backend import rasterize

        parts = [Ts_world_camera[k : k + BATCH] for k in range(0, len(Ts_world_camera), BATCH)]
        with torch.no_grad():
            drawn = [rasterize(scene, camera, part, np.zeros(3), antialiased) for part in parts]
        colours = torch.cat([part[0] for part in drawn])
        return (
            colours[..., :3].clamp(0.0, 1.0),
            torch.cat([part[1] for part in drawn])[..., 0],
            colours[..., 3],
        )

    def one_by_one(Ts_world_camera: Array) -> tuple[Tensor, Tensor, Tensor]:
        frames = [
            render(scene, camera, T, backend, antialiased=antialiased) for T in Ts_world_camera
        ]
        parts = (
            [frame.rgb for frame in frames],
            [frame.alpha for frame in frames],
            [frame.depth for frame in frames],
        )
        colours, alphas, depths = (torch.from_numpy(np.stack(part)) for part in parts)
        return colours, alphas, depths

    return by_gsplat if backend == "gsplat" else one_by_one


def upscale_camera(camera: PinholeCamera, times: int = SUPERSAMPLING) -> PinholeCamera:
    """The camera with so many times the pixels along each side."""
    fx, fy, cx, cy = (times * number for number in (camera.fx, camera.fy, camera.cx, camera.cy))
    return PinholeCamera(fx, fy, cx, cy, times * camera.width, times * camera.height)


def sample_views(world: ViewSource, count: int, rng: np.random.Generator) -> Views:
    """Draw poses and take views; those into a wall or out of the hall are left out, so that fewer
    may come.

    Args:
        world: what to look at.
        count: of poses to try.
        rng: draws.
    """
    Ts_world_camera = aircraft_poses(world.low, world.high, count, rng)
    numbers, from_photo = np.zeros(count, np.int64), np.zeros(count, bool)
    if world.photos is not None:
        share, own = (
            rng.random(count),
            world.photos.Ts_world_camera.cpu().numpy().astype(np.float64),
        )
        from_photo, beside = share < world.photo_share, share < world.photo_share + world.near_share
        numbers = rng.integers(len(own), size=count)
        near = perturb_poses(own[numbers], np.where(from_photo, 0.0, SHIFT), TURN_DEG, rng)
        Ts_world_camera = np.where(beside[:, None, None], near, Ts_world_camera)
    colours, alphas, depths = world.render_hall(Ts_world_camera)
    depths = depths * (alphas > 0.5)
    covered, near_pixels = alphas.mean(dim=(1, 2)), (depths < NEAR).float().mean(dim=(1, 2))
    good = (covered > MIN_COVERED) & (near_pixels < NEAR_SHARE)
    if world.photos is not None and from_photo.any():
        rows = torch.from_numpy(np.flatnonzero(from_photo)).to(colours.device)
        renders, poses = colours[rows], Ts_world_camera[from_photo]
        colours[rows] = overlay_photos(
            renders, world.camera, poses, world.photos, numbers[from_photo]
        )
        good[rows] = True
    if world.render_leader is not None:
        chosen = np.flatnonzero(rng.random(count) < world.leader_share)
        draw_leader(
            colours, depths, world.render_leader, world.camera, Ts_world_camera, chosen, rng
        )
    return _downsample(colours, depths, Ts_world_camera, good)


def _downsample(colours: Tensor, depths: Tensor, Ts_world_camera: Array, good: Tensor) -> Views:
    """The good ones of fine renders in the network's size."""
    images = functional.avg_pool2d(colours.permute(0, 3, 1, 2), SUPERSAMPLING)
    known = -functional.max_pool2d(-(depths > 0.0).float(), SUPERSAMPLING)
    cells = (functional.avg_pool2d(depths, SUPERSAMPLING) * known)[
        :, CELL // 2 :: CELL, CELL // 2 :: CELL
    ].flatten(1)
    poses = torch.from_numpy(Ts_world_camera).float().to(images.device)
    return Views((images[good] * 255.0).round().to(torch.uint8), cells[good], poses[good])


def aircraft_poses(low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    """(N, 4, 4) cameras of aircraft anywhere in a box."""
    p_world = rng.uniform(low + WALL, high - WALL, (count, 3))
    roll, pitch = np.radians(rng.normal(0.0, (25.0, 12.0), (count, 2))).T
    return camera_pose(
        pose_matrix(rotation_world_body(roll, pitch, rng.uniform(-np.pi, np.pi, count)), p_world)
    )


def perturb_poses(
    Ts_world_camera: Array, shift: Array | float, turn_deg: float, rng: np.random.Generator
) -> Array:
    """Poses (N, 4, 4) moved in the world by `shift` (N,) [m] and turned about their own axes,
    normally distributed.
    """
    turns = torch.from_numpy(np.radians(turn_deg) * rng.standard_normal((len(Ts_world_camera), 3)))
    x, y, z = turns.unbind(-1)
    zero = torch.zeros_like(x)
    turned = torch.linalg.matrix_exp(
        torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
    )
    moved = Ts_world_camera.copy()
    moved[:, :3, :3] = Ts_world_camera[:, :3, :3] @ turned.numpy()
    moved[:, :3, 3] += np.reshape(shift, (-1, 1)) * rng.standard_normal((len(moved), 3))
    return moved


def overlay_photos(
    renders: Tensor,
    camera: PinholeCamera,
    Ts_world_camera: Array,
    photos: PosedImages,
    numbers: NDArray[np.int64],
) -> Tensor:
    """Renders (C, H, W, 3) with what photos taken from the same places saw put over them.

    u = K_photo R_photo_world R_world_camera ray, the homography of a turning camera  [Hartley &
    Zisserman, 8.4.2]

    Args:
        renders: by the fine camera.
        camera: the network's.
        Ts_world_camera: (C, 4, 4) of the renders, at the places of the photos.
        photos: all of them.
        numbers: (C,) of those that were taken there.
    """
    rows = torch.from_numpy(numbers).to(renders.device)
    R_photo_world = photos.Ts_world_camera[rows, :3, :3].mT
    R_world_camera = torch.from_numpy(Ts_world_camera[:, :3, :3]).float().to(renders.device)
    rays = torch.from_numpy(upscale_camera(camera).pixel_rays()).float().to(renders.device)
    v = torch.einsum("cij,hwj->chwi", R_photo_world @ R_world_camera, rays)
    lens, z = photos.camera, v[..., 2].clamp(min=1e-3)
    x = 2.0 * (lens.fx * v[..., 0] / z + lens.cx) / lens.width - 1.0
    y = 2.0 * (lens.fy * v[..., 1] / z + lens.cy) / lens.height - 1.0
    seen = (x.abs() < 1.0) & (y.abs() < 1.0) & (v[..., 2] > 0.0)
    pictures = photos.images[rows].permute(0, 3, 1, 2).float() / 255.0
    drawn = functional.grid_sample(
        pictures, torch.stack([x, y], dim=-1), padding_mode="border", align_corners=False
    )
    return torch.where(seen[..., None], drawn.permute(0, 2, 3, 1), renders)


def draw_leader(
    colours: Tensor,
    depths: Tensor,
    render_leader: RenderFunction,
    camera: PinholeCamera,
    Ts_world_camera: Array,
    chosen: NDArray[np.int64],
    rng: np.random.Generator,
) -> None:
    """Draw a leader aircraft somewhere before some cameras, unless the hall hides it; in place.

    Where it is seen the depth becomes 0, since the hall is not seen there.

    Args:
        colours: (C, H, W, 3).
        depths: (C, H, W) [m].
        look_leader: renders the leader in its body axes, before black.
        camera: the network's.
        Ts_world_camera: (C, 4, 4).
        chosen: (L,) numbers of the images that get one.
        rng: draws.
    """
    count = len(chosen)
    if count == 0:
        return
    distance = LEADER_NEAR * (LEADER_FAR / LEADER_NEAR) ** rng.random((count, 1))
    sides = rng.uniform(-0.5, 0.5, (count, 2)) * (
        camera.width / camera.fx,
        camera.height / camera.fy,
    )
    p_camera = distance * np.concatenate([sides, np.ones((count, 1))], axis=1)
    R_world_camera, origins = Ts_world_camera[chosen, :3, :3], Ts_world_camera[chosen, :3, 3]
    p_world = origins + np.einsum("cij,cj->ci", R_world_camera, p_camera)
    roll, pitch = np.radians(rng.normal(0.0, (30.0, 10.0), (count, 2))).T
    T_world_leader = pose_matrix(
        rotation_world_body(roll, pitch, rng.uniform(-np.pi, np.pi, count)), p_world
    )
    drawn, alphas, leader_depths = render_leader(
        np.linalg.inv(T_world_leader) @ Ts_world_camera[chosen]
    )
    rows = torch.from_numpy(chosen).to(colours.device)
    before = (alphas > 0.0) & (leader_depths < depths[rows])
    cover = (alphas * before)[..., None]
    colours[rows] = drawn * before[..., None] + (1.0 - cover) * colours[rows]
    depths[rows] = depths[rows] * (cover[..., 0] < 0.3)
