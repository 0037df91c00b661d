"""Scene fitting: photos with aligned poses, or turntable photos -> trained Gaussian scene, figures.

    falconwing scene fit RECONSTRUCTION --survey survey.csv --out DIR

trains without network: on an NVIDIA GPU by gsplat, or on a CPU by the reference renderer, for small
scenes. Requires torch, numpy and pillow, and gsplat for the GPU. See the folder `training`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.capture.align import umeyama
from falconwing_kit.tools.capture.photo_files import (
    Reconstruction,
    read_reconstruction,
    write_reconstruction,
)
from falconwing_kit.tools.capture.survey.points import Survey, read_survey
from falconwing_kit.tools.capture.training.settings import CAMERAS, LEADER_SETTINGS, FitSettings

if TYPE_CHECKING:
    from falconwing_kit.tools.capture.training.task import TrainingResult

ON_FACES = 0.9  # share of the random points on the room's floor, walls and ceiling
ROOM_MARGIN = 0.5  # [m] beyond the outermost camera and surveyed point
# the scene's box exceeds the room by this share of its size, and its depth below the floor is the
# room's height
BEYOND = 0.25
# of the leader, in its photos' frame [m]: 0.20 m behind its nose at x = 0.236
CENTRE_OF_GRAVITY = (0.036, 0.0, 0.0)
CORRECTED = "corrected"  # folder of the reconstruction with corrected poses
AIRCRAFT_SIZE = 0.5  # [m] extent of a turntable scene


def fit_scene(
    reconstruction: Reconstruction,
    out: Path,
    settings: FitSettings | None = None,
    survey: Survey | None = None,
    say: Callable[[str], None] = print,
) -> "TrainingResult":
    """Train a scene on photos, evaluate it on held-out places, and write it.

    Writes scene.npz (quantised, labels rest, floor, pad and marker), figures.json, pairs of
    held-out photos and renders, and, if poses are optimised, the corrected reconstruction for
    another training. Keeps a checkpoint, training.npz, from which the same call resumes.

    Args:
        reconstruction: photos with poses in the kit's world.
        out: the folder; created if missing.
        survey: places of pad and marker.
        say: called with lines of progress.

    Raises:
        FileNotFoundError: a photo is missing.
        InputError: the reconstruction is not aligned, a photo is damaged or of another size, there
            are too few photos, the backend cannot run here, GPU memory does not suffice, or the
            folder cannot be written.
    """
    from falconwing_kit.tools.capture.training.draw import choose_renderer
    from falconwing_kit.tools.capture.training.photos import load_photos
    from falconwing_kit.tools.capture.training.task import SceneTrainer

    settings = settings or FitSettings()
    if not reconstruction.aligned:
        raise InputError(
            "reconstruction: expected one in the kit's world, got one not aligned; run: "
            "falconwing scene align"
        )
    draw, device = choose_renderer(settings.backend)
    source = reconstruction
    say(f"reading {len(source)} photos of {short_name(source.folder)} to train on {device}")
    photos = load_photos(source, settings.width, device)
    room = _room(settings, source.T_world_camera[:, :3, 3], survey)
    points, colours = initial_points(
        source.points, source.colours, room, settings.gaussians // 2, settings.seed
    )
    deep = np.array([BEYOND, BEYOND, 1.0]) * (room[1] - room[0])
    box = np.stack([room[0] - deep, room[1] + BEYOND * (room[1] - room[0])])
    task = SceneTrainer(
        photos,
        draw,
        points,
        colours,
        box,
        _extent(source.T_world_camera[:, :3, 3]),
        settings,
        out,
        say,
    )
    state = task.train()
    if settings.poses:
        write_reconstruction(
            out / CORRECTED, apply_pose_corrections(source, task.corrected_poses(state))
        )
    return task.ship(
        state, survey, f"Gaussian splats trained on photos of {short_name(source.folder)}"
    )


def apply_pose_corrections(source: Reconstruction, Ts_world_camera: Array) -> Reconstruction:
    """The reconstruction with corrected poses, aligned as a whole to its original camera places.

    Args:
        Ts_world_camera: (n, 4, 4) corrected poses of all photos.

    Returns:
        The same photos and points with the corrected poses, transformed by the similarity that
        brings the camera places nearest to the original ones.
    """
    scale, R, t = umeyama(Ts_world_camera[:, :3, 3], source.T_world_camera[:, :3, 3])
    poses = Ts_world_camera.copy()
    poses[:, :3, :3] = R @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ R.T + t
    return replace(source, T_world_camera=poses)


def fit_leader(
    folder: Path,
    out: Path,
    settings: FitSettings = LEADER_SETTINGS,
    centre_of_gravity: Sequence[float] = CENTRE_OF_GRAVITY,
    say: Callable[[str], None] = print,
) -> "TrainingResult":
    """Train an aircraft on turntable photos whose alpha separates it from the background.

    Writes scene.npz (body axes, label leader, named points nose, tail, left_wing_tip and
    right_wing_tip) and figures.json; see `fit_scene`.

    Args:
        folder: holds cameras.json and RGBA photos.
        out: the folder to write; created if missing.
        centre_of_gravity: (3,) in the frame of the photos' poses (x nose, y left, z up) [m]: the
            asset's centre of rotation; an estimate suffices.
        say: called with lines of progress.

    Raises:
        FileNotFoundError: cameras.json or a photo is missing.
        InputError: one of them is damaged, has no alpha, or they do not belong together; or see
            `fit_scene`.
    """
    from falconwing_kit.tools.capture.training.draw import choose_renderer
    from falconwing_kit.tools.capture.training.task import SceneTrainer
    from falconwing_kit.tools.capture.training.turntable import hull_points, load_turntable

    draw, device = choose_renderer(settings.backend)
    photos = load_turntable(folder, centre_of_gravity, settings.width, device)
    say(f"read {len(photos)} turntable photos of {short_name(folder)} to train on {device}")
    points = hull_points(photos, settings.gaussians, settings.seed)
    colours = np.full(points.shape, 128, np.uint8)
    margin = 0.05 * (points.max(axis=0) - points.min(axis=0)) + 0.02
    box = np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])
    task = SceneTrainer(photos, draw, points, colours, box, AIRCRAFT_SIZE, settings, out, say)
    return task.ship(
        task.train(),
        None,
        f"Gaussian splats trained on turntable photos of {short_name(folder)}",
        "leader",
    )


def initial_points(
    points: Array, colours: NDArray[np.uint8], room: Array, count: int, seed: int
) -> tuple[Array, NDArray[np.uint8]]:
    """Initial points: those of the reconstruction, and random ones, mostly on the room's faces.

    Args:
        points: (M, 3) of the reconstruction [m].
        colours: (M, 3) bytes.
        room: (2, 3) lowest and highest corner [m].
        count: total number.

    Returns:
        Points (count, 3), at most half of them from the reconstruction, and colours (count, 3):
        random points have the colour of the nearest reconstructed one, or grey.
    """
    import torch

    # a random half of the count from the reconstructed points in the room
    rng, size = np.random.default_rng(seed), room[1] - room[0]
    own = np.flatnonzero(
        ((points > room[0] - 0.1 * size) & (points < room[1] + 0.1 * size)).all(axis=1)
    )
    own = rng.permutation(own)[: max(count // 2, 4)]
    # the others uniform in the room, most of them projected onto a random face
    added = rng.uniform(room[0], room[1], (max(0, count - len(own)), 3))
    areas = np.prod(size) / size  # of the faces across x, y and z
    flat = np.flatnonzero(rng.uniform(size=len(added)) < ON_FACES)
    axis = rng.choice(3, len(flat), p=areas / areas.sum())
    added[flat, axis] = room[rng.integers(0, 2, len(flat)), axis]
    if len(own) == 0:
        return added, np.full(added.shape, 128, np.uint8)
    # colour of the nearest reconstructed point, in chunks to limit memory
    known = torch.tensor(points[own], dtype=torch.float32)
    parts = torch.tensor(added, dtype=torch.float32).split(1024)
    nearest = [torch.cdist(part, known).argmin(dim=1).numpy() for part in parts if len(part)]
    taken = colours[own][np.concatenate(nearest)] if nearest else colours[:0]
    return np.concatenate([points[own], added]), np.concatenate([colours[own], taken])


def evaluate_scene(
    path: Path,
    reconstruction: Reconstruction,
    settings: FitSettings,
    backend: str = "fast",
    folder: Path | None = None,
) -> dict[str, Any]:
    """Figures of a scene file on the held-out photos, by one of the kit's renderers.

    Args:
        path: of the scene.
        reconstruction: of the training.
        settings: of the training; they determine the held-out photos.
        backend: of `render`.
        folder: of the photos, if not the reconstruction's.

    Returns:
        See `training.judge.evaluate`.

    Raises:
        InputError: a file is damaged or the backend cannot run here.
    """
    from falconwing_kit.tools.capture.training.judge import evaluate
    from falconwing_kit.tools.capture.training.photos import held_out_photos, load_photos
    from falconwing_kit.tools.capture.training.task import kit_renderer

    scene, source = GaussianScene.load(path), reconstruction
    held = np.flatnonzero(held_out_photos(source.names, source.T_world_camera[:, :3, 3], settings))
    names, poses = tuple(source.names[number] for number in held), source.T_world_camera[held]
    chosen = replace(source, names=names, T_world_camera=poses, folder=folder or source.folder)
    photos = load_photos(chosen, settings.width)
    return evaluate(kit_renderer(scene, photos, settings.antialiased, backend), photos)


def _room(settings: FitSettings, places: Array, survey: Survey | None) -> Array:
    """(2, 3) lowest and highest corner of the room [m]."""
    if settings.room:
        return np.reshape(np.asarray(settings.room, np.float64), (2, 3))
    known = places if survey is None else np.concatenate([places, survey.p_world])
    low, high = known.min(axis=0) - ROOM_MARGIN, known.max(axis=0) + ROOM_MARGIN
    low[2] = min(0.0, low[2] + ROOM_MARGIN)  # the floor
    return np.stack([low, high])


def _extent(places: Array) -> float:
    """Scene extent: 1.1 times the largest distance of a camera from their mean [m], as in 3DGS."""
    return max(0.1, 1.1 * float(np.linalg.norm(places - places.mean(axis=0), axis=1).max()))


def fit_folder(
    source: Path,
    out: Path,
    changes: Mapping[str, Any],
    survey: Path | None = None,
    photos: Path | None = None,
    say: Callable[[str], None] = print,
) -> "TrainingResult":
    """Fit a folder: an aligned reconstruction, or turntable photos (with cameras.json).

    Args:
        source: the folder, or a transforms.json.
        out: the folder to write.
        changes: settings that differ from `FitSettings()`, or from `LEADER_SETTINGS` for turntable
            photos.
        survey: CSV of measured points.
        photos: folder of the photos, if not the reconstruction's.
        say: called with lines of progress.

    Raises:
        FileNotFoundError: the source or a photo is missing.
        InputError: see `fit_scene` and `fit_leader`.
    """
    if (source / CAMERAS).is_file():
        return fit_leader(source, out, replace(LEADER_SETTINGS, **changes), say=say)
    reconstruction = read_reconstruction(source)
    if photos is not None:
        reconstruction = replace(reconstruction, folder=photos)
    points = read_survey(survey) if survey is not None else None
    return fit_scene(reconstruction, out, FitSettings(**changes), points, say)
