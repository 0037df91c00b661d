"""Turntable photos of an aircraft: RGBA images and cameras.json -> photos and points in body axes.

The photos' frame "aircraft" is x nose, y left, z up with its origin at the wing root; the kit's
body frame is x nose, y right wing, z belly with its origin in the centre of gravity:

    p_body = diag(1, -1, -1) (p_aircraft - centre of gravity)
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from falconwing_kit.core.checks import Array, InputError, require_file, require_shape
from falconwing_kit.core.files import short_name
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.reference import GaussianTensors, covariances
from falconwing_kit.scene.render import require_pose
from falconwing_kit.tools.capture.photo_files import Reconstruction
from falconwing_kit.tools.capture.training.photos import Photos, load_photos
from falconwing_kit.tools.capture.training.settings import CAMERAS

R_BODY_AIRCRAFT = np.diag([1.0, -1.0, -1.0])
COVERED, AGREE = 127, 0.97  # alpha of the aircraft's pixels; share of photos that must show it
TRIES = 400_000  # random places per round
SOLID, NEAR_END = 0.5, 0.006  # least opacity of the aircraft; depth of a tip's end [m]


def load_turntable(
    folder: Path, centre_of_gravity: Sequence[float], width: int = 0, device: str = "cpu"
) -> Photos:
    """Read turntable photos with their poses in body axes.

    Args:
        folder: holds cameras.json (fx, fy, cx, cy, width, height; frames: file ->
            T_aircraft_camera) and the photos.
        centre_of_gravity: (3,) in the photos' aircraft frame [m].
        width: of the training images [px]; 0 keeps the photos' size.
        device: of the tensors.

    Raises:
        FileNotFoundError: cameras.json or a photo is missing.
        InputError: one of them is damaged, or a photo has no alpha.
    """
    path = require_file(folder / CAMERAS)
    try:
        record = json.loads(path.read_bytes())
        sides = (record[key] for key in ("fx", "fy", "cx", "cy", "width", "height"))
        camera = PinholeCamera(*sides)
        frames = {
            name: frame["T_aircraft_camera"] for name, frame in sorted(record["frames"].items())
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{short_name(path)}: expected the turntable's camera and frames, got others ({error})"
        ) from None
    if not frames:
        raise InputError(
            f"{short_name(path)}: expected at least one frame, got none; "
            "list the photos with their poses"
        )
    centre = require_shape("centre_of_gravity", centre_of_gravity, (3,))
    T_body_aircraft = pose_matrix(R_BODY_AIRCRAFT, -R_BODY_AIRCRAFT @ centre)
    poses = np.array([_rigid(name, T) for name, T in frames.items()])
    source = Reconstruction(camera, tuple(frames), folder, T_body_aircraft @ poses)
    return load_photos(source, width, device, with_alpha=True)


def _rigid(name: str, pose: Any) -> Array:
    """A pose of cameras.json as an exact rotation; the file's six digits round it."""
    T = require_pose(f"{CAMERAS}: {name}", pose)
    left, _, right = np.linalg.svd(T[:3, :3])
    return pose_matrix(left @ right, T[:3, 3])


def hull_points(photos: Photos, count: int, seed: int = 0) -> Array:
    """Points of the visual hull: points whose pixel is covered in nearly all photos.

    Args:
        photos: with alpha.
        count: maximum number of points.

    Returns:
        (count or fewer, 3) [m].

    Raises:
        InputError: no place is covered in all photos: poses and photos do not match.
    """
    rng, centres = (
        np.random.default_rng(seed),
        photos.Ts_world_camera[:, :3, 3].cpu().numpy().astype(np.float64),
    )
    low, high = centres.min(axis=0), centres.max(axis=0)
    inside = np.zeros((0, 3))
    for _ in range(3):  # between all cameras first, then in the bounding box of the last round
        places = rng.uniform(low, high, (TRIES, 3))
        inside = places[_covered(places, photos)]
        if len(inside) == 0:
            raise InputError(
                "turntable: expected one object in all photos, found none; "
                "do the poses belong to the photos?"
            )
        margin = 0.02 + 0.1 * (inside.max(axis=0) - inside.min(axis=0))
        low, high = (
            np.maximum(low, inside.min(axis=0) - margin),
            np.minimum(high, inside.max(axis=0) + margin),
        )
    return np.asarray(inside[:count])


def _covered(places: Array, photos: Photos) -> Array:
    """(N,) True for places that at least AGREE of the photos show as covered."""
    assert photos.alphas is not None
    camera, votes = photos.camera, torch.zeros(len(places), device=photos.images.device)
    p_world = torch.tensor(places, dtype=torch.float32, device=votes.device)
    for alpha, T in zip(photos.alphas, photos.Ts_world_camera, strict=True):
        x, y, z = ((p_world - T[:3, 3]) @ T[:3, :3]).unbind(1)
        column, row = (
            (camera.fx * x / z + camera.cx).floor().long(),
            (camera.fy * y / z + camera.cy).floor().long(),
        )
        seen = (
            (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        )
        votes += seen & (
            alpha[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)] > COVERED
        )
    return (votes >= AGREE * len(photos)).cpu().numpy()


def aircraft_points(scene: GaussianScene) -> dict[str, Array]:
    """End points of an aircraft in body axes: nose, tail and both wing tips.

    Along its axis each point lies one standard deviation beyond the mean of the furthest solid
    Gaussian; across, at the mean of the Gaussians that reach within NEAR_END of it.

    Args:
        scene: the aircraft, x nose, y right wing, z belly.

    Returns:
        (3,) [m] by name.
    """
    solid = scene.selected(scene.opacities > SOLID) if (scene.opacities > SOLID).any() else scene
    gaussians = GaussianTensors.from_scene(solid, torch.float64)
    sides = (
        covariances(gaussians.quaternions, gaussians.scales).diagonal(dim1=1, dim2=2).sqrt().numpy()
    )
    ends = {
        "nose": (0, 1.0),
        "tail": (0, -1.0),
        "right_wing_tip": (1, 1.0),
        "left_wing_tip": (1, -1.0),
    }
    points = {}
    for name, (axis, sign) in ends.items():
        reach = sign * solid.means[:, axis] + sides[:, axis]
        points[name] = solid.means[reach >= reach.max() - NEAR_END].mean(axis=0, dtype=np.float64)
        points[name][axis] = sign * reach.max()
    return points
