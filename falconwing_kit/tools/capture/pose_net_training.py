"""Pose net training: a hall's scene and its photos with poses -> a pose net and its errors.

The output folder gets pose_net.safetensors, pose_net.json with the errors, and views.png with
examples of the training views. On a GPU the views are rendered by gsplat during the training;
without one the same works in miniature. It needs PyTorch, NumPy, Pillow and safetensors, no network
connection and no OpenCV.

Photos are split by position: some are held out for evaluation, some are set aside to calibrate the
stated uncertainty, and the rest may be used for training beside the renders.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import Array, InputError, require_file, require_range, require_shape
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.learning.appearance import randomise_appearance
from falconwing_kit.learning.pose_net_figures import (
    MIN_TO_CALIBRATE,
    PoseErrors,
    calibrate_sigmas,
    error_figures,
    evaluate_poses,
)
from falconwing_kit.learning.pose_net_loop import PoseNetTrainer, TrainSchedule
from falconwing_kit.learning.pose_views import (
    SUPERSAMPLING,
    ViewSource,
    approach_box,
    make_renderer,
    sample_views,
    upscale_camera,
)
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.capture.photo_files import Reconstruction, read_reconstruction
from falconwing_kit.tools.capture.training.photos import Photos, hold_out_places, load_photos
from falconwing_kit.vision.pose_net import PoseNet, PoseNetRecord
from falconwing_kit.vision.pose_network import PATCH, STEMS, PoseNetShape, PoseNetwork, load_vit

HELD_SHARE, HELD_SEED = 0.11, 0  # of the photos without a list; the same as in scene training
ASIDE_SHARE, ASIDE_SEED = 0.1, 1  # of the others, for calibration
JUDGED_RENDERS, JUDGED_SEED = 400, 12345
BOX_SHARE = 0.005  # of the scene's Gaussians that may lie beyond each side of its box
SHEET_VIEWS, SHEET_COLUMNS = 24, 6


@dataclass(frozen=True)
class PoseNetConfig:
    """Files, network and options of a training."""

    scene: Path
    photos: Path
    out: Path
    plan: TrainSchedule = field(default_factory=TrainSchedule)
    width: int = 192  # of the network's image [px], a multiple of 16
    features: int = 160
    layers: int = 5
    heads: int = 5
    stem: str = "conv"
    vit: Path | None = None  # pretrained ViT weights for the stem "patch"
    start: Path | None = None  # a trained net of the same shape and box to go on from
    images: Path | None = None  # folder of the photos, if not as the poses' file states
    held_out: Path | None = None  # names of the photos for evaluation
    leader: Path | None = None  # a scene of the leader in its body axes
    photo_share: float = 0.15
    near_share: float = 0.35
    approach_share: float = 0.0
    box: tuple[float, ...] = ()  # lower and upper corner [m]; empty: from the scene
    backend: str = "auto"
    antialiased: bool = False


def train_pose_net(
    job: PoseNetConfig, report_line: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Train, calibrate and evaluate a net, and write net and errors.

    Args:
        job: what to train on and how.
        report_line: called with a line of progress now and then.

    Returns:
        The content of pose_net.json.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: a file is damaged, photos are not aligned, an option is out of range, or gsplat
            cannot run.
    """
    backend, device = _backend(job.backend)
    photos, scene = _aligned_photos(job), GaussianScene.load(job.scene)
    held_out, aside = _split(photos, job.held_out)
    trained = ~(held_out | aside)
    record = _record(job, photos, scene)
    fine_photos = _load(photos, trained, SUPERSAMPLING * job.width, device)
    world = _view_source(job, record, scene, fine_photos, backend, device)
    network = _initial_network(job, record, device)
    job.out.mkdir(parents=True, exist_ok=True)
    _write_sheet(job.out / "views.png", world)
    start = hashlib.sha256(job.start.read_bytes()).hexdigest()[:16] if job.start else ""
    trainer = PoseNetTrainer(network, world, job.plan, job.out, start)
    network = trainer.run(lambda losses: report_line(_progress_line(trainer, losses))).to("cpu")
    path = job.out / "pose_net.safetensors"
    PoseNet(network, record).save(path)
    # evaluate the net in half precision, as it ships
    net, trials = evaluate_net(PoseNet.load(path), photos, held_out, aside, world)
    net.save(path)
    report: dict[str, Any] = {name: error_figures(trial) for name, trial in trials.items()}
    report |= {
        "sigma_scales": list(net.record.sigma_scales),
        "training": {
            "steps": trainer.step,
            "seconds": trainer.seconds,
            "batch": job.plan.batch,
            "device": device,
        },
        "photos_learnt_from": int(trained.sum()) if job.photo_share > 0.0 else 0,
        "photos_aside": [photos.names[k] for k in np.flatnonzero(aside)],
        "photos_held_out": [photos.names[k] for k in np.flatnonzero(held_out)],
        "source": record.source,
    }
    with atomic_write(job.out / "pose_net.json", text=True) as file:
        json.dump(report, file, indent=1)
    return report


def evaluate_net(
    net: PoseNet,
    photos: Reconstruction,
    held_out: NDArray[np.bool_],
    aside: NDArray[np.bool_],
    world: ViewSource,
) -> tuple[PoseNet, dict[str, PoseErrors]]:
    """Calibrate a net on randomised renders, and photos if there are enough, and evaluate it.

    Args:
        net: as it will ship.
        photos: all, with their reconstructed poses as ground truth.
        held_out: (N,) True for photos held out for evaluation.
        aside: (N,) True for photos to calibrate with.
        world: source of new renders.

    Returns:
        The calibrated net, and its errors on plain renders, on the same with randomised appearance,
        and on photos.
    """
    rng = np.random.default_rng(JUDGED_SEED)
    plain = sample_views(replace(world, photos=None), JUDGED_RENDERS, rng)
    generator = torch.Generator(world.device).manual_seed(JUDGED_SEED)
    Ts_render = plain.Ts_world_camera.cpu().numpy().astype(np.float64)
    renders, randomised = (
        images.permute(0, 2, 3, 1).cpu().numpy()
        for images in (plain.images, _randomised_bytes(plain.images, generator))
    )
    trials = [evaluate_poses(net, randomised, world.camera, Ts_render)]
    if aside.sum() >= MIN_TO_CALIBRATE:
        trials.append(_errors_on_photos(net, photos, aside))
    net = calibrate_sigmas(net, *trials)
    return net, {
        "renders": evaluate_poses(net, renders, world.camera, Ts_render),
        "worse": evaluate_poses(net, randomised, world.camera, Ts_render),
        "photos": _errors_on_photos(net, photos, held_out),
    }


def _randomised_bytes(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Images (B, 3, H, W) of bytes with randomised appearance."""
    randomised, _ = randomise_appearance(images.float() / 255.0, generator)
    return (randomised * 255.0).round().to(torch.uint8)


def _errors_on_photos(
    net: PoseNet, photos: Reconstruction, chosen: NDArray[np.bool_]
) -> PoseErrors:
    """Errors on photos in their own size."""
    loaded = _load(photos, chosen, 0, "cpu")
    return evaluate_poses(net, loaded.images.numpy(), loaded.camera, photos.T_world_camera[chosen])


def _backend(name: str) -> tuple[str, str]:
    """The renderer, and the device to train on."""
    if name in ("fast", "reference") or (name == "auto" and not torch.cuda.is_available()):
        return name, "cpu"
    if name not in ("auto", "gsplat"):
        raise InputError(f"backend: expected auto, gsplat, fast or reference, got {name!r}")
    from falconwing_kit.scene.gsplat_backend import probe_gsplat

    probe_gsplat()
    return "gsplat", "cuda"


def _aligned_photos(job: PoseNetConfig) -> Reconstruction:
    """The photos, after checking that their poses are in the kit's world."""
    photos = read_reconstruction(job.photos)
    if not photos.aligned:
        raise InputError(
            f"{short_name(job.photos)}: expected photos aligned with the world, got others; "
            "run falconwing scene align"
        )
    return photos if job.images is None else replace(photos, folder=job.images)


def _split(
    photos: Reconstruction, listed: Path | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) True for photos held out for evaluation, and for those set aside for calibration."""
    places = photos.T_world_camera[:, :3, 3]
    if listed is None:
        held_out = hold_out_places(places, HELD_SHARE, HELD_SEED)
    else:
        held_out = _select_named(photos, listed)
    aside, rest = np.zeros(len(photos), bool), np.flatnonzero(~held_out)
    aside[rest] = hold_out_places(places[rest], ASIDE_SHARE, ASIDE_SEED)
    return held_out, aside


def _select_named(photos: Reconstruction, path: Path) -> NDArray[np.bool_]:
    """(N,) True for photos named in a file: figures.json, JSON with a list "held_out", or lines."""
    text = require_file(path).read_text(encoding="utf-8")
    try:
        found = json.loads(text)
        names = found["held_out"] if isinstance(found, dict) else found
        names = names["photos"] if isinstance(names, dict) else names
        names = [entry["photo"] if isinstance(entry, dict) else entry for entry in names]
    except json.JSONDecodeError:
        names = text.split()
    except (KeyError, TypeError):
        raise InputError(
            f'{short_name(path)}: expected names of photos under "held_out", got other content; '
            "give the figures.json of falconwing scene fit"
        ) from None
    expected = {Path(str(name)).name for name in names}
    held_out = np.array([Path(name).name in expected for name in photos.names])
    if not held_out.any() or held_out.sum() > len(photos) - 2:
        raise InputError(
            f"{short_name(path)}: expected names of some of the {len(photos)} photos, "
            f"got {held_out.sum()} of them; leave at least two for the training"
        )
    return held_out


def _load(photos: Reconstruction, chosen: NDArray[np.bool_], width: int, device: str) -> Photos:
    """Some of the photos as tensors, no wider than they are."""
    names = tuple(photos.names[k] for k in np.flatnonzero(chosen))
    some = replace(photos, names=names, T_world_camera=photos.T_world_camera[chosen])
    return load_photos(some, min(width, photos.camera.width), device)


def _record(job: PoseNetConfig, photos: Reconstruction, scene: GaussianScene) -> PoseNetRecord:
    """Shape, camera and box of the net to train."""
    camera = photos.camera
    require_range("width", job.width, low=2 * PATCH, high=1024)
    if job.width % PATCH or job.stem not in STEMS or job.features % job.heads:
        raise InputError(
            f"width, stem, heads: expected a multiple of {PATCH}, one of {STEMS}, a divisor of "
            f"the features, got {job.width}, {job.stem!r}, {job.heads} for {job.features}"
        )
    height = PATCH * max(2, round(job.width * camera.height / camera.width / PATCH))
    shape = {"width": job.width, "height": height, "features": job.features, "layers": job.layers}
    low, high = _box(job, scene)
    return PoseNetRecord(
        shape | {"heads": job.heads, "stem": job.stem},
        camera.fx / camera.width,
        (float(low[0]), float(low[1]), float(low[2])),
        (float(high[0]), float(high[1]), float(high[2])),
        source=f"renders of {scene.source}; photos: {job.photo_share:.0%}",
        approach=approach_box(LandingPad()) if job.approach_share > 0.0 else None,
    )


def _box(job: PoseNetConfig, scene: GaussianScene) -> tuple[Array, Array]:
    """Corners of the box of the flights: as given, or quantiles of the scene's Gaussians."""
    if job.box:
        low, high = require_shape("box", job.box, (6,)).reshape(2, 3)
    else:
        solid = scene.means[scene.opacities > 0.5].astype(np.float64)
        low, high = np.quantile(
            solid if len(solid) else scene.means, (BOX_SHARE, 1.0 - BOX_SHARE), axis=0
        )
    if not (high - low > 2.0).all():
        raise InputError(
            f"box: expected a hall of more than 2 m along each axis, got {low} to {high}; "
            "give --box"
        )
    return low, high


def _view_source(
    job: PoseNetConfig,
    record: PoseNetRecord,
    scene: GaussianScene,
    photos: Photos,
    backend: str,
    device: str,
) -> ViewSource:
    """Renderers and photos for the training views."""
    for name in ("photo_share", "near_share", "approach_share"):
        require_range(name, getattr(job, name), low=0.0, high=1.0)
    fine_camera, render_leader = upscale_camera(record.camera), None
    if job.leader is not None:
        render_leader = make_renderer(GaussianScene.load(job.leader), fine_camera, backend)
    return ViewSource(
        make_renderer(scene, fine_camera, backend, job.antialiased),
        record.camera,
        np.array(record.low),
        np.array(record.high),
        photos if job.photo_share + job.near_share > 0.0 else None,
        render_leader,
        near_share=job.near_share,
        photo_share=job.photo_share,
        device=device,
        pad=LandingPad(),
        approach_share=job.approach_share,
    )


def _initial_network(job: PoseNetConfig, record: PoseNetRecord, device: str) -> PoseNetwork:
    """An untrained network, with pretrained ViT weights if given, or the one to go on from."""
    torch.manual_seed(job.plan.seed)
    if job.start is not None:
        return _trained_network(job.start, record).to(device)
    shape = PoseNetShape(**record.shape)
    network = PoseNetwork(shape, torch.tensor(record.low), torch.tensor(record.high)).to(device)
    if job.vit is not None and load_vit(network, load_file(require_file(job.vit))) == 0:
        raise InputError(
            f"{short_name(job.vit)}: expected ViT weights of {shape.features} features, "
            "got none that fit; set --features, --heads and --stem patch as in the file"
        )
    return network


def _trained_network(path: Path, record: PoseNetRecord) -> PoseNetwork:
    """The network of a file, after checking that it is of the record's shape, camera and box."""
    net = PoseNet.load(path)
    for name in ("shape", "focal", "low", "high"):
        wanted, found = getattr(record, name), getattr(net.record, name)
        same = wanted == found if name == "shape" else np.allclose(wanted, found, rtol=1e-3)
        if not same:
            raise InputError(
                f"{short_name(path)}: expected a net of {name} {wanted}, got {found}; "
                "give the options of its training"
            )
    return net.network


def _write_sheet(path: Path, world: ViewSource) -> None:
    """Picture of training views, each above the same with randomised appearance."""
    from PIL import Image

    views = sample_views(world, SHEET_VIEWS, np.random.default_rng(JUDGED_SEED))
    generator = torch.Generator(world.device).manual_seed(0)
    pairs = torch.cat([views.images, _randomised_bytes(views.images, generator)], dim=2)
    columns = pairs.permute(0, 2, 3, 1).cpu().numpy()
    rows = [
        np.concatenate(list(columns[k : k + SHEET_COLUMNS]), axis=1)
        for k in range(0, len(columns) - SHEET_COLUMNS + 1, SHEET_COLUMNS)
    ]
    if rows:
        with atomic_write(path) as file:
            Image.fromarray(np.concatenate(rows)).save(file, "PNG")


def _progress_line(trainer: PoseNetTrainer, losses: dict[str, float]) -> str:
    figures = "  ".join(f"{name} {value:.3g}" for name, value in losses.items())
    return f"{trainer.progress:6.1%}  step {trainer.step}  {trainer.seconds:.0f} s  {figures}"
