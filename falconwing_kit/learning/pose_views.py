"""Training views for poses: a scene, photos pasted into its views, a leader drawn into them ->
images, depths and camera poses.

Cameras are drawn from these distributions, in shares that the caller gives:

- aircraft: uniform in the hall's box half a metre from its sides, any heading, roll with a standard
  deviation of 25 deg, pitch of 12 deg;
- approach: low along a landing pad and before it, where a pilot that lands needs its poses most;
- near photos: 0.7 m and 10 deg (standard deviations per axis) from a photo of the training set;
- photos: at a photo's position, rotated by some degrees. What the photo shows is copied from it,
  which is exact since a rotation about the camera's centre needs no depth; the rest is rendered.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import camera_pose, pose_matrix, rotation_world_body
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import render
from falconwing_kit.vision.pose_net import TRAINING_MARGIN, Box
from falconwing_kit.vision.pose_network import CELL, cross_matrix

TURN_DEG, SHIFT = 10.0, 0.7  # of views near photos [deg, m]
MIN_COVERED = 0.85  # share of a view that the scene must cover
NEAR, NEAR_SHARE = 0.4, 0.2  # at most this share of the pixels may be nearer [m]
SOLID_ALPHA = 0.5  # of the hall; below, a pixel has no depth
OCCLUDING_ALPHA = 0.3  # of the leader; from here on it hides the hall's depth
SUPERSAMPLING = 2  # renders are averaged over so many pixels a side, like scaled photos
BATCH = 32  # views in a call of the GPU renderer
LEADER_NEAR, LEADER_FAR = 1.5, 12.0  # [m]
# Of an approach: way before the pad, half width, least and largest height above the pad [m], and
# standard deviations of roll, pitch and heading [deg].
APPROACH_LENGTH, APPROACH_ASIDE, APPROACH_HEIGHTS = 8.0, 1.5, (0.08, 1.2)
APPROACH_TURNS_DEG = (8.0, 5.0, 8.0)

# poses (C, 4, 4) -> colour (C, H, W, 3), alpha (C, H, W), depth (C, H, W) [m] on the device
RenderFunction = Callable[[Array], tuple[Tensor, Tensor, Tensor]]


class PosedImages(Protocol):
    """P images of one camera with poses, such as the photos that a scene was trained on."""

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of all images, without distortion."""

    @property
    def images(self) -> Tensor:
        """(P, H, W, 3) bytes."""

    @property
    def Ts_world_camera(self) -> Tensor:
        """(P, 4, 4) float32."""


class Views(NamedTuple):
    """N images with ground truth."""

    images: Tensor  # (N, 3, H, W) bytes
    depths: Tensor  # (N, K) of the cells' rays along the camera's z axis [m]; 0: hall occluded
    Ts_world_camera: Tensor  # (N, 4, 4) float32


@dataclass(frozen=True, eq=False)
class ViewSource:
    """Scene, photos and distributions from which views are sampled."""

    render_hall: RenderFunction  # with the supersampled camera
    camera: PinholeCamera  # the network's
    low: Array  # (3,) corners of the box in which aircraft fly [m]
    high: Array
    photos: PosedImages | None = None  # of the supersampled size or more
    render_leader: RenderFunction | None = None  # the leader alone, in its body axes
    near_share: float = 0.35  # of views near photos
    photo_share: float = 0.15  # of views copied from photos
    leader_share: float = 0.2  # of views with a leader
    pad: LandingPad | None = None  # to which aircraft approach
    approach_share: float = 0.0  # of the aircraft's views
    device: str = "cpu"


def make_renderer(
    scene: GaussianScene,
    camera: PinholeCamera,
    backend: str,
    antialiased: bool = False,
    batch: int = BATCH,
) -> RenderFunction:
    """Function that renders a scene from many poses: by gsplat in calls of `batch`, or singly."""

    def by_gsplat(Ts_world_camera: Array) -> tuple[Tensor, Tensor, Tensor]:
        """A RenderFunction: BATCH views a call, on the GPU."""
        from falconwing_kit.scene.gsplat_backend import rasterize

        parts = [Ts_world_camera[k : k + batch] for k in range(0, len(Ts_world_camera), batch)]
        with torch.no_grad():
            drawn = [rasterize(scene, camera, part, np.zeros(3), antialiased) for part in parts]
        rgbd, alphas = (torch.cat([part[k] for part in drawn]) for k in (0, 1))
        return rgbd[..., :3].clamp(0.0, 1.0), alphas[..., 0], rgbd[..., 3]

    def one_by_one(Ts_world_camera: Array) -> tuple[Tensor, Tensor, Tensor]:
        """A RenderFunction: view by view, on the CPU."""
        frames = [
            render(scene, camera, T, backend, antialiased=antialiased) for T in Ts_world_camera
        ]
        colours, alphas, depths = (
            torch.from_numpy(np.stack([getattr(frame, name) for frame in frames]))
            for name in ("rgb", "alpha", "depth")
        )
        return colours, alphas, depths

    return by_gsplat if backend == "gsplat" else one_by_one


def upscale_camera(camera: PinholeCamera, times: int = SUPERSAMPLING) -> PinholeCamera:
    """The camera with `times` the pixels along each side."""
    fx, fy, cx, cy = (times * number for number in (camera.fx, camera.fy, camera.cx, camera.cy))
    return PinholeCamera(fx, fy, cx, cy, times * camera.width, times * camera.height)


def sample_views(world: ViewSource, count: int, rng: np.random.Generator) -> Views:
    """At most `count` views at random poses; those into a wall or out of the hall are rejected."""
    # poses: aircraft, some replaced by poses at or near photos
    Ts_world_camera = aircraft_poses(world.low, world.high, count, rng)
    approaches = np.zeros(count, bool)
    if world.pad is not None and world.approach_share > 0.0:
        approaches = rng.random(count) < world.approach_share
        Ts_low = approach_poses(world.pad, count, rng)
        Ts_world_camera = np.where(approaches[:, None, None], Ts_low, Ts_world_camera)
    numbers, from_photo = np.zeros(count, np.int64), np.zeros(count, bool)
    if world.photos is not None:
        draw = rng.random(count)  # decides which distribution a view is from
        Ts_photo = world.photos.Ts_world_camera.cpu().numpy().astype(np.float64)
        from_photo = draw < world.photo_share
        from_or_near_photo = draw < world.photo_share + world.near_share
        numbers = rng.integers(len(Ts_photo), size=count)
        shift = np.where(from_photo, 0.0, SHIFT)
        Ts_near = perturb_poses(Ts_photo[numbers], shift, TURN_DEG, rng)
        Ts_world_camera = np.where(from_or_near_photo[:, None, None], Ts_near, Ts_world_camera)
        approaches &= ~from_or_near_photo
    # render, and reject views that show too little of the hall or a surface too near
    colours, alphas, depths = world.render_hall(Ts_world_camera)
    depths = depths * (alphas > SOLID_ALPHA)
    covered, near_pixels = alphas.mean(dim=(1, 2)), (depths < NEAR).float().mean(dim=(1, 2))
    # in an approach the near surface is the floor or the pad
    is_free = (near_pixels < NEAR_SHARE) | torch.from_numpy(approaches).to(near_pixels.device)
    usable = (covered > MIN_COVERED) & is_free
    # photos are copied over the renders at their positions; such views are always valid
    if world.photos is not None and from_photo.any():
        rows = torch.from_numpy(np.flatnonzero(from_photo)).to(colours.device)
        renders, poses = colours[rows], Ts_world_camera[from_photo]
        colours[rows] = overlay_photos(
            renders, world.camera, poses, world.photos, numbers[from_photo]
        )
        usable[rows] = True
    if world.render_leader is not None:
        chosen = np.flatnonzero(rng.random(count) < world.leader_share)
        draw_leader(
            colours, depths, world.render_leader, world.camera, Ts_world_camera, chosen, rng
        )
    return _downsample(colours, depths, Ts_world_camera, usable)


def _downsample(colours: Tensor, depths: Tensor, Ts_world_camera: Array, usable: Tensor) -> Views:
    """The usable ones of supersampled renders, in the network's size."""
    images = functional.avg_pool2d(colours.permute(0, 3, 1, 2), SUPERSAMPLING)
    # a cell's depth is valid if all of its pixel's supersamples are: minimum pooling
    valid = -functional.max_pool2d(-(depths > 0.0).float(), SUPERSAMPLING)
    depths = functional.avg_pool2d(depths, SUPERSAMPLING) * valid
    cells = depths[:, CELL // 2 :: CELL, CELL // 2 :: CELL].flatten(1)
    poses = torch.from_numpy(Ts_world_camera).float().to(images.device)
    return Views((images[usable] * 255.0).round().to(torch.uint8), cells[usable], poses[usable])


def aircraft_poses(low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    """(N, 4, 4) camera poses of aircraft, uniform in a box."""
    p_world = rng.uniform(low + TRAINING_MARGIN, high - TRAINING_MARGIN, (count, 3))
    roll, pitch = np.radians(rng.normal(0.0, (25.0, 12.0), (count, 2))).T
    R_world_body = rotation_world_body(roll, pitch, rng.uniform(-np.pi, np.pi, count))
    return camera_pose(pose_matrix(R_world_body, p_world))


def approach_box(pad: LandingPad) -> Box:
    """Lower and upper corner [m] of the cameras of `approach_poses`."""
    lowest, highest = (pad.height + height for height in APPROACH_HEIGHTS)
    before, end = pad.x_start - APPROACH_LENGTH, pad.x_start + pad.length
    right, left = pad.y_centre - APPROACH_ASIDE, pad.y_centre + APPROACH_ASIDE
    return (before, right, lowest), (end, left, highest)


def approach_poses(pad: LandingPad, count: int, rng: np.random.Generator) -> Array:
    """(N, 4, 4) camera poses along a pad and low before it, uniform in the `approach_box`."""
    low, high = (np.array(corner) for corner in approach_box(pad))
    roll, pitch, yaw = np.radians(rng.normal(0.0, APPROACH_TURNS_DEG, (count, 3))).T
    p_world = rng.uniform(low, high, (count, 3))
    return camera_pose(pose_matrix(rotation_world_body(roll, pitch, yaw), p_world))


def perturb_poses(
    Ts_world_camera: Array, shift: Array | float, turn_deg: float, rng: np.random.Generator
) -> Array:
    """Poses (N, 4, 4) with normally distributed translations and rotations.

    Args:
        Ts_world_camera: (N, 4, 4).
        shift: (N,) standard deviation of each coordinate in the world [m].
        turn_deg: standard deviation about each axis of the camera [deg].
        rng: random numbers.
    """
    turns = torch.from_numpy(np.radians(turn_deg) * rng.standard_normal((len(Ts_world_camera), 3)))
    rotations = torch.linalg.matrix_exp(cross_matrix(turns))
    moved = Ts_world_camera.copy()
    moved[:, :3, :3] = Ts_world_camera[:, :3, :3] @ rotations.numpy()
    moved[:, :3, 3] += np.reshape(shift, (-1, 1)) * rng.standard_normal((len(moved), 3))
    return moved


def overlay_photos(
    renders: Tensor,
    camera: PinholeCamera,
    Ts_world_camera: Array,
    photos: PosedImages,
    numbers: NDArray[np.int64],
) -> Tensor:
    """Put real photos into a training batch: over renders (C, H, W, 3) from the same positions.

    u = K_photo R_photo_world R_world_camera ray, the homography of a rotating camera
    [Hartley & Zisserman, 8.4.2]

    Args:
        renders: by the supersampled camera.
        camera: the network's.
        Ts_world_camera: (C, 4, 4) of the renders.
        photos: all of them.
        numbers: (C,) the photo of each render.
    """
    # rays of the renders' pixels in the photos' axes: (C, H, W, 3)
    rows = torch.from_numpy(numbers).to(renders.device)
    R_photo_world = photos.Ts_world_camera[rows, :3, :3].mT
    R_world_camera = torch.from_numpy(Ts_world_camera[:, :3, :3]).float().to(renders.device)
    rays = torch.from_numpy(upscale_camera(camera).pixel_rays()).float().to(renders.device)
    v = torch.einsum("cij,hwj->chwi", R_photo_world @ R_world_camera, rays)
    # pixels of the photos, scaled to -1..1 as grid_sample requires
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
    """Draw a leader aircraft in front of some cameras, in place.

    The hall occludes it where it is nearer; where the leader is visible the depth becomes 0.

    Args:
        colours: (C, H, W, 3).
        depths: (C, H, W) [m].
        render_leader: renders the leader in its body axes, on black.
        camera: the network's.
        Ts_world_camera: (C, 4, 4).
        chosen: (L,) images that get a leader.
        rng: random numbers.
    """
    count = len(chosen)
    if count == 0:
        return
    # position: log-uniform distance, uniform in the image
    distance = LEADER_NEAR * (LEADER_FAR / LEADER_NEAR) ** rng.random((count, 1))
    image_size = (camera.width / camera.fx, camera.height / camera.fy)
    sides = rng.uniform(-0.5, 0.5, (count, 2)) * image_size
    p_camera = distance * np.concatenate([sides, np.ones((count, 1))], axis=1)
    R_world_camera, origins = Ts_world_camera[chosen, :3, :3], Ts_world_camera[chosen, :3, 3]
    p_world = origins + np.einsum("cij,cj->ci", R_world_camera, p_camera)
    roll, pitch = np.radians(rng.normal(0.0, (30.0, 10.0), (count, 2))).T
    R_world_leader = rotation_world_body(roll, pitch, rng.uniform(-np.pi, np.pi, count))
    T_world_leader = pose_matrix(R_world_leader, p_world)
    Ts_leader_camera = np.linalg.inv(T_world_leader) @ Ts_world_camera[chosen]
    drawn, alphas, leader_depths = render_leader(Ts_leader_camera)
    # composite over the hall where the leader is nearer
    rows = torch.from_numpy(chosen).to(colours.device)
    nearer = (alphas > 0.0) & (leader_depths < depths[rows])
    alphas = alphas * nearer
    colours[rows] = drawn * nearer[..., None] + (1.0 - alphas[..., None]) * colours[rows]
    depths[rows] = depths[rows] * (alphas < OCCLUDING_ALPHA)
