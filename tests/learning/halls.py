"""Halls for the learning tests: a corner of the arena in miniature, and photos rendered in it."""

from functools import cache

import numpy as np
import torch
from PIL import Image

from falconwing_kit.learning.pose_views import ViewSource, make_renderer, upscale_camera
from falconwing_kit.scene import PinholeCamera, load_scene, render
from falconwing_kit.scene.arena import leader_at
from falconwing_kit.tools.capture.photo_files import Reconstruction, write_reconstruction
from falconwing_kit.tools.capture.training.photos import Photos

CAMERA = PinholeCamera(39.68, 39.68, 32.0, 24.0, 64, 48)
LOW, HIGH = np.array([-6.0, -5.0, 0.5]), np.array([2.0, 3.0, 3.5])


@cache
def hall():
    """The arena without its leader."""
    return leader_at(load_scene("arena"), None)


def world(**changes):
    """The corner around the marker, by the CPU's renderer."""
    given = {
        "render_hall": make_renderer(hall(), upscale_camera(CAMERA), "fast"),
        "camera": CAMERA,
        "low": LOW,
        "high": HIGH,
    }
    return ViewSource(**(given | changes))


def photos_of(Ts_world_camera):
    """Renders as if they were photos, of the fine camera's size."""
    camera = upscale_camera(CAMERA)
    images = np.stack(
        [np.round(255.0 * render(hall(), camera, T).rgb).astype(np.uint8) for T in Ts_world_camera]
    )
    names = tuple(f"{k:03}.png" for k in range(len(images)))
    poses = torch.from_numpy(np.asarray(Ts_world_camera)).float()
    return Photos(
        names, camera, torch.from_numpy(images), None, torch.ones(96, 128, dtype=torch.bool), poses
    )


def write_photos(folder, Ts_world_camera, aligned=True):
    """The same as files with their transforms.json."""
    photos = photos_of(Ts_world_camera)
    (folder / "photos").mkdir(parents=True)
    for name, image in zip(photos.names, photos.images.numpy(), strict=True):
        Image.fromarray(image).save(folder / "photos" / name)
    found = Reconstruction(
        photos.camera, photos.names, folder / "photos", np.asarray(Ts_world_camera), aligned=aligned
    )
    return write_reconstruction(folder, found)


def thinned_hall(count):
    """The trained hall's Gaussians that cover most, so that an image takes a millisecond."""
    hall = load_scene("hall")
    sides = np.sort(hall.scales, axis=1)
    covers = hall.opacities * sides[:, 1] * sides[:, 2]
    return hall.selected(covers >= np.sort(covers)[-count])
