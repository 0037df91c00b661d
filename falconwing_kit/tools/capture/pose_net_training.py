"""Training iGSplat: a hall's scene and its photos with poses -> a pose net that knows the hall, and
how well it does.

    python -m falconwing_kit.tools.capture.pose_net_training SCENE PHOTOS --out DIR

DIR gets pose_net.safetensors, pose_net.json with the figures, and views.png, which shows what it
learnt from. On a GPU it renders by gsplat while it learns; without one it does the same in
miniature. It needs PyTorch, NumPy, Pillow and safetensors, no network and no OpenCV.

Photos serve three purposes, by place: some are held out and judge; some are kept aside and
calibrate the stated uncertainty; the rest may be learnt from beside the renders (--photo-share 0
learns from renders alone).
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file

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
    make_renderer,
    sample_views,
    upscale_camera,
)
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.capture.photo_files import Reconstruction, read_reconstruction
from falconwing_kit.tools.capture.training.photos import Photos, hold_out_places, load_photos
from falconwing_kit.vision.pose_net import PoseNet, PoseNetRecord
from falconwing_kit.vision.pose_network import PATCH, STEMS, PoseNetShape, PoseNetwork, load_vit

HELD_SHARE, HELD_SEED = (
    0.11,
    0,
)  # of the photos, where no list says which; scene training draws the same
ASIDE_SHARE, ASIDE_SEED = 0.1, 1  # of the others, to calibrate with
JUDGED_RENDERS, JUDGED_SEED = 400, 12345
JOB_NUMBERS = (
    "width",
    "features",
    "layers",
    "heads",
    "photo_share",
    "near_share",
)  # options of the command line
PLAN_NUMBERS = ("steps", "minutes", "batch", "fresh", "pool", "first", "rate", "seed")
BOX_SHARE = 0.005  # of the scene's Gaussians that may lie beyond each side of its box


@dataclass(frozen=True)
class PoseNetConfig:
    """What to train on and how."""

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
    images: Path | None = (
        None  # folder of the photos, where they are not where the poses' file says
    )
    held_out: Path | None = None  # names of photos to judge by
    leader: Path | None = None  # a scene of the leader in its body axes
    photo_share: float = 0.15
    near_share: float = 0.35
    box: tuple[
        float, ...
    ] = ()  # x, y, z of the lower corner and of the upper one [m]; empty: from the scene
    backend: str = "auto"
    antialiased: bool = False


def train_pose_net(job: PoseNetConfig) -> dict[str, Any]:
    """Train, calibrate, judge, and write net and figures.

    Args:
        job: what to do.

    Returns:
        The figures, as in pose_net.json.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: a file is damaged, photos are not aligned, an option makes no sense, or gsplat
            cannot run.
    """
    backend, device = _backend(job.backend)
    photos, scene = _aligned_photos(job), GaussianScene.load(job.scene)
    held, aside = _split(photos, job.held_out)
    learnt = ~(held | aside)
    record = _record(job, photos, scene)
    world = _world(
        job,
        record,
        scene,
        _load(photos, learnt, SUPERSAMPLING * job.width, device),
        backend,
        device,
    )
    network = _network(job, record, device)
    job.out.mkdir(parents=True, exist_ok=True)
    _write_sheet(job.out / "views.png", world)
    trainer = PoseNetTrainer(network, world, job.plan, job.out)
    path = job.out / "pose_net.safetensors"
    PoseNet(trainer.run(lambda losses: _log(trainer, losses)).to("cpu"), record).save(path)
    net, trials = evaluate_net(
        PoseNet.load(path), photos, held, aside, world
    )  # in half precision, as it ships
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
        "photos_learnt_from": int(learnt.sum()) if job.photo_share > 0.0 else 0,
        "photos_aside": [photos.names[k] for k in np.flatnonzero(aside)],
        "photos_held_out": [photos.names[k] for k in np.flatnonzero(held)],
        "source": record.source,
    }
    with atomic_write(job.out / "pose_net.json", text=True) as file:
        json.dump(report, file, indent=1)
    return report


def evaluate_net(
    net: PoseNet,
    photos: Reconstruction,
    held: NDArray[np.bool_],
    aside: NDArray[np.bool_],
    world: ViewSource,
) -> tuple[PoseNet, dict[str, PoseErrors]]:
    """Calibrate a net on renders of another appearance and on photos kept aside, if there are
    enough, then try it.

    Args:
        net: as it will ship.
        photos: all, with their reconstructed poses as the truth.
        held: (N,) True for photos to judge by.
        aside: (N,) True for photos to calibrate with.
        world: for renders that were never trained on.

    Returns:
        The calibrated net; and its trials on plain renders by aircraft, the same with another
        appearance, and photos.
    """
    plain = sample_views(
        replace(world, photos=None), JUDGED_RENDERS, np.random.default_rng(JUDGED_SEED)
    )
    generator = torch.Generator(world.device).manual_seed(JUDGED_SEED)
    worse = (
        (randomise_appearance(plain.images.float() / 255.0, generator)[0] * 255.0)
        .round()
        .to(torch.uint8)
    )
    Ts_render = plain.Ts_world_camera.cpu().numpy().astype(np.float64)
    renders, others = (images.permute(0, 2, 3, 1).cpu().numpy() for images in (plain.images, worse))
    known = [evaluate_poses(net, others, world.camera, Ts_render)]
    if aside.sum() >= MIN_TO_CALIBRATE:
        known.append(_on_photos(net, photos, aside))
    net = calibrate_sigmas(net, *known)
    trials = {
        name: evaluate_poses(net, i, world.camera, Ts_render)
        for name, i in (("renders", renders), ("worse", others))
    }
    return net, trials | {"photos": _on_photos(net, photos, held)}


def _on_photos(net: PoseNet, photos: Reconstruction, chosen: NDArray[np.bool_]) -> PoseErrors:
    """A trial on photos in their own size."""
    loaded = _load(photos, chosen, 0, "cpu")
    return evaluate_poses(net, loaded.images.numpy(), loaded.camera, photos.T_world_camera[chosen])


def _backend(name: str) -> tuple[str, str]:
    """What renders, and the device to train on."""
    if name in ("fast", "reference") or (name == "auto" and not torch.cuda.is_available()):
        return name, "cpu"
    if name not in ("auto", "gsplat"):
        raise InputError(f"backend: expected auto, gsplat, fast or reference, got {name!r}")
    from falconwing_kit.scene.gsplat_backend import probe_gsplat

    probe_gsplat()
    return "gsplat", "cuda"


def _aligned_photos(job: PoseNetConfig) -> Reconstruction:
    """The photos, if their poses are in the kit's world."""
    photos = read_reconstruction(job.photos)
    if not photos.aligned:
        raise InputError(
            f"{short_name(job.photos)}: expected photos aligned with the world; run falconwing scene align"
        )
    return photos if job.images is None else replace(photos, folder=job.images)


def _split(
    photos: Reconstruction, listed: Path | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) True for photos held out, and for those kept aside."""
    places = photos.T_world_camera[:, :3, 3]
    held = (
        hold_out_places(places, HELD_SHARE, HELD_SEED)
        if listed is None
        else _select_named(photos, listed)
    )
    aside, rest = np.zeros(len(photos), bool), np.flatnonzero(~held)
    aside[rest] = hold_out_places(places[rest], ASIDE_SHARE, ASIDE_SEED)
    return held, aside


def _select_named(photos: Reconstruction, path: Path) -> NDArray[np.bool_]:
    """(N,) True for photos named in a file: scene training's figures.json, JSON with a list
    "held_out", or lines.
    """
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
            f'{short_name(path)}: expected names of photos under "held_out", got other content'
        ) from None
    wanted = {Path(str(name)).name for name in names}
    held = np.array([Path(name).name in wanted for name in photos.names])
    if not held.any() or held.sum() > len(photos) - 2:
        raise InputError(
            f"{short_name(path)}: expected names of some of the {len(photos)} photos, got {held.sum()} of them"
        )
    return held


def _load(photos: Reconstruction, chosen: NDArray[np.bool_], width: int, device: str) -> Photos:
    """Some of the photos as tensors, no wider than they are."""
    names = tuple(photos.names[k] for k in np.flatnonzero(chosen))
    some = replace(photos, names=names, T_world_camera=photos.T_world_camera[chosen])
    return load_photos(some, min(width, photos.camera.width), device)


def _record(job: PoseNetConfig, photos: Reconstruction, scene: GaussianScene) -> PoseNetRecord:
    """What the net will know about itself."""
    camera = photos.camera
    require_range("width", job.width, low=2 * PATCH, high=1024)
    if job.width % PATCH or job.stem not in STEMS or job.features % job.heads:
        raise InputError(
            f"width, stem, heads: expected a multiple of {PATCH}, one of {STEMS}, a divisor of the features"
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
    )


def _box(job: PoseNetConfig, scene: GaussianScene) -> tuple[Array, Array]:
    """The box that aircraft fly in: as told, or without the scene's few outermost Gaussians."""
    if job.box:
        low, high = require_shape("box", job.box, (6,)).reshape(2, 3)
    else:
        solid = scene.means[scene.opacities > 0.5].astype(np.float64)
        low, high = np.quantile(
            solid if len(solid) else scene.means, (BOX_SHARE, 1.0 - BOX_SHARE), axis=0
        )
    if not (high - low > 2.0).all():
        raise InputError(
            f"box: expected a hall of more than 2 m along each axis, got {low} to {high}; give --box"
        )
    return low, high


def _world(
    job: PoseNetConfig,
    record: PoseNetRecord,
    scene: GaussianScene,
    photos: Photos,
    backend: str,
    device: str,
) -> ViewSource:
    """What the views are made of."""
    for name in ("photo_share", "near_share"):
        require_range(name, getattr(job, name), low=0.0, high=1.0)
    fine = upscale_camera(record.camera)
    leader = (
        None if job.leader is None else make_renderer(GaussianScene.load(job.leader), fine, backend)
    )
    return ViewSource(
        make_renderer(scene, fine, backend, job.antialiased),
        record.camera,
        np.array(record.low),
        np.array(record.high),
        photos if job.photo_share + job.near_share > 0.0 else None,
        leader,
        near_share=job.near_share,
        photo_share=job.photo_share,
        device=device,
    )


def _network(job: PoseNetConfig, record: PoseNetRecord, device: str) -> PoseNetwork:
    """A network to begin with, pretrained if there is something to begin with."""
    torch.manual_seed(job.plan.seed)
    shape = PoseNetShape(**record.shape)
    network = PoseNetwork(shape, torch.tensor(record.low), torch.tensor(record.high)).to(device)
    if job.vit is not None and load_vit(network, load_file(require_file(job.vit))) == 0:
        raise InputError(
            f"{short_name(job.vit)}: expected ViT weights of {shape.features} features, got none that fit"
        )
    return network


def _write_sheet(path: Path, world: ViewSource) -> None:
    """A picture of views as they come, and below each the same with another appearance."""
    from PIL import Image

    views = sample_views(world, 24, np.random.default_rng(JUDGED_SEED))
    other = (
        randomise_appearance(
            views.images.float() / 255.0, torch.Generator(world.device).manual_seed(0)
        )[0]
        * 255.0
    )
    pairs = (
        torch.cat([views.images, other.round().to(torch.uint8)], dim=2)
        .permute(0, 2, 3, 1)
        .cpu()
        .numpy()
    )
    rows = [
        np.concatenate(list(pairs[k : k + 6]), axis=1) for k in range(0, len(pairs) // 6 * 6, 6)
    ]
    if rows:
        with atomic_write(path) as file:
            Image.fromarray(np.concatenate(rows)).save(file, "PNG")


def _log(trainer: PoseNetTrainer, losses: dict[str, float]) -> None:
    """One line of progress."""
    words = "  ".join(f"{name} {value:.3g}" for name, value in losses.items())
    print(
        f"{trainer.progress:6.1%}  step {trainer.step}  {trainer.seconds:.0f} s  {words}",
        flush=True,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; see the top of this file.

    Returns:
        0 done, 2 wrong use.
    """
    parser = argparse.ArgumentParser(
        prog="pose_net_training", description="Train a pose net for a hall."
    )
    for name in ("scene", "photos"):
        parser.add_argument(name, type=Path)
    for name in ("out", "images", "held-out", "leader", "vit"):
        parser.add_argument(f"--{name}", type=Path, required=name == "out")
    parser.add_argument("--box", type=float, nargs=6, default=())
    parser.add_argument("--antialiased", action="store_true")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--stem", default="conv")
    for owner, names in ((PoseNetConfig, JOB_NUMBERS), (TrainSchedule, PLAN_NUMBERS)):
        for name in names:
            default = getattr(owner, name)
            parser.add_argument(f"--{name.replace('_', '-')}", type=type(default), default=default)
    told = vars(parser.parse_args(arguments))
    plan = TrainSchedule(**{name: told.pop(name) for name in PLAN_NUMBERS})
    try:
        report = train_pose_net(PoseNetConfig(plan=plan, **(told | {"box": tuple(told["box"])})))
    except (InputError, FileNotFoundError) as error:
        print(error, file=sys.stderr)
        return 2
    for name in ("renders", "worse", "photos"):
        print(name, json.dumps(report[name]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
