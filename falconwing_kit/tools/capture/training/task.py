"""Scene training: photos, initial points and settings -> scene file, figures and pictures."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write, short_name, write_error
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.native import read_named_points, write_quantised
from falconwing_kit.scene.reference import GaussianTensors
from falconwing_kit.scene.render import render
from falconwing_kit.tools.capture.survey.points import Survey
from falconwing_kit.tools.capture.training.draw import Draw, apply_twists
from falconwing_kit.tools.capture.training.judge import RenderPoses, evaluate, refine_photo_poses
from falconwing_kit.tools.capture.training.loop import TrainConfig, train, twist_scale
from falconwing_kit.tools.capture.training.photos import Photos, held_out_photos
from falconwing_kit.tools.capture.training.settings import FitSettings
from falconwing_kit.tools.capture.training.ship import (
    contributions,
    label_scene,
    prune,
    write_pairs,
)
from falconwing_kit.tools.capture.training.state import TrainState, initialise, to_scene
from falconwing_kit.tools.capture.training.turntable import aircraft_points

MAX_PAIRS = 6  # photo and render pairs that are written, from the worst to the best


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """A finished training."""

    scene: GaussianScene  # as it reads back from the file
    figures: dict[str, Any]  # as in figures.json
    path: Path  # of the scene


@dataclass(frozen=True, eq=False)
class SceneTrainer:
    """One training, from initial points to files."""

    photos: Photos
    draw: Draw
    points: Array
    colours: NDArray[np.uint8]
    box: Array  # (2, 3) the scene stays in [m]
    extent: float
    settings: FitSettings
    out: Path
    say: Callable[[str], None]

    @cached_property
    def split(self) -> tuple[Photos, Photos]:
        """Training photos and held-out photos; both are all photos where none are held out."""
        places = self.photos.Ts_world_camera[:, :3, 3].cpu().numpy()
        held = held_out_photos(self.photos.names, places, self.settings)
        if len(self.photos) - held.sum() < 2:
            raise InputError(
                f"photos: expected at least 3, one of them held out, got {len(self.photos)}; "
                "take more"
            )
        learn = self.photos.chosen(np.flatnonzero(~held))
        return learn, (self.photos.chosen(np.flatnonzero(held)) if held.any() else learn)

    @property
    def config(self) -> TrainConfig:
        """Configuration of the training loop."""
        shared = {field.name for field in fields(TrainConfig)}
        values = {name: value for name, value in asdict(self.settings).items() if name in shared}
        return TrainConfig(
            **values,
            low=self.box[0],
            high=self.box[1],
            seconds=60.0 * self.settings.minutes,
            extent=self.extent,
        )

    def train(self) -> TrainState:
        """Train, or resume from the checkpoint of an interrupted training."""
        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"{short_name(self.out)}: expected a folder to write to, got a file; "
                "choose another name"
            )
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(self.out, error) from None
        learn, _ = self.split
        checkpoint = self.out / "training.npz"
        settings_text = json.dumps([asdict(self.settings), self.photos.names])
        device = str(self.photos.images.device)
        if checkpoint.is_file():
            state = TrainState.load(checkpoint, settings_text, device)
            self.say(f"going on at step {state.step} of the training in {short_name(checkpoint)}")
        else:
            state = initialise(
                self.points, self.colours, len(learn), self.settings.sh_degree, device
            )

        def log(state: TrainState, loss: float) -> None:
            count = len(state.values["means"])
            self.say(
                f"step {state.step}/{self.settings.steps}: loss {loss:.4f}, {count} Gaussians, "
                f"{state.seconds:.0f} s"
            )

        return train(
            state,
            learn,
            self.draw,
            self.config,
            save_state=lambda now: now.save(checkpoint, settings_text),
            log=log,
        )

    def corrected_poses(self, state: TrainState) -> Array:
        """(P, 4, 4) of all photos, in their order.

        Poses of training photos as the training corrected them; poses of held-out photos refined
        against the finished scene, which was not trained on them (unless `pose_steps` is 0).
        """
        learn, held = self.split
        poses = dict(zip(self.photos.names, self.photos.Ts_world_camera.double(), strict=True))
        if held is not learn and self.settings.pose_steps:
            gaussians = state.gaussians(self.settings.sh_degree)
            poses |= dict(
                zip(held.names, self._refine_poses(gaussians, held).double(), strict=True)
            )
        twists = state.values["twists"].double() * twist_scale(
            self.extent, poses[self.photos.names[0]]
        )
        poses |= dict(
            zip(learn.names, apply_twists(learn.Ts_world_camera.double(), twists), strict=True)
        )
        return torch.stack([poses[name] for name in self.photos.names]).cpu().numpy()

    def ship(
        self, state: TrainState, survey: Survey | None, source: str, label: str = ""
    ) -> TrainingResult:
        """Prune and label the scene, write it, evaluate the written file, and write the figures."""
        start, settings = time.monotonic(), self.settings
        learn, held = self.split
        gaussians = state.gaussians(settings.sh_degree)
        kept = prune(gaussians, contributions(gaussians, learn, self.draw, settings.antialiased))
        scene = to_scene(kept, source)
        scene = replace(scene, label_names=(label,)) if label else label_scene(scene, survey)
        path = self.out / "scene.npz"
        write_quantised(path, scene, aircraft_points(scene) if label == "leader" else None)
        shipped, render_poses = GaussianScene.load(path), self._renderer(gaussians)
        figures = self._figures(state, shipped, render_poses, learn, held)
        figures |= {
            "bytes": path.stat().st_size,
            "points": {k: p.tolist() for k, p in read_named_points(path).items()},
        }
        figures["seconds_after_training"] = time.monotonic() - start
        rows = sorted(figures["held_out"]["photos"], key=lambda row: row["psnr_db"])
        some = {rows[k]["photo"] for k in np.linspace(0, len(rows) - 1, MAX_PAIRS).astype(int)}
        write_pairs(self.out / "pairs", self._renderer(_tensors(shipped, held)), held, sorted(some))
        with atomic_write(self.out / "figures.json", text=True) as file:
            json.dump(figures, file, indent=1)
        (self.out / "training.npz").unlink(missing_ok=True)
        for line in summary_lines(figures):
            self.say(line)
        return TrainingResult(shipped, figures, path)

    def _figures(
        self,
        state: TrainState,
        shipped: GaussianScene,
        render_poses: RenderPoses,
        learn: Photos,
        held: Photos,
    ) -> dict[str, Any]:
        """All figures; those fitted to held-out photos have names that state it."""
        settings, tensors = self.settings, _tensors(shipped, held)
        drawn = self._renderer(tensors)
        sample = learn.chosen(np.arange(0, len(learn), max(1, len(learn) // 20)))
        images = state.step * settings.batch
        return {
            "settings": asdict(settings),
            "photos": {"trained": len(learn), "held_out": list(held.names)},
            "gaussians": {"trained": len(state.values["means"]), "shipped": len(shipped)},
            "held_out": evaluate(drawn, held),
            "held_out_after_pose_refinement": self._evaluate_refined(tensors, held),
            "held_out_before_shipping": evaluate(render_poses, held),
            "held_out_by_fast": self._evaluate_fast(shipped, held),
            "trained_on": evaluate(drawn, sample),
            "training": {
                **{
                    "seconds": state.seconds,
                    "steps": state.step,
                    "photos_per_second": images / state.seconds,
                },
                "gaussians_drawn_per_second": images * len(state.values["means"]) / state.seconds,
                "device": _device(self.photos),
            },
        }

    def _renderer(self, gaussians: Any) -> RenderPoses:
        """Renders a scene's poses with the training's renderer, on black."""
        black = torch.zeros(3, device=gaussians.means.device)
        camera, antialiased = self.photos.camera, self.settings.antialiased
        return lambda poses: self.draw(gaussians, camera, poses, black, antialiased)[0]

    def _evaluate_refined(self, tensors: GaussianTensors, held: Photos) -> dict[str, Any] | None:
        """Figures after refining each held-out photo's pose; None without `pose_steps`."""
        if self.settings.pose_steps == 0:
            return None
        return evaluate(self._renderer(tensors), held, self._refine_poses(tensors, held))

    def _refine_poses(self, gaussians: GaussianTensors, photos: Photos) -> Tensor:
        """(P, 4, 4) refined poses of photos against a scene."""
        settings = self.settings
        return refine_photo_poses(
            gaussians, photos, self.draw, settings.antialiased, self.extent, settings.pose_steps
        )

    def _evaluate_fast(self, shipped: GaussianScene, held: Photos) -> dict[str, Any] | None:
        """Figures of the kit's fast renderer; None where numba is missing."""
        if find_spec("numba") is None:
            return None
        return evaluate(kit_renderer(shipped, held, self.settings.antialiased, "fast"), held)


def summary_lines(figures: dict[str, Any]) -> list[str]:
    """The main figures as lines of text."""
    lines = [f"{figures['gaussians']['shipped']} Gaussians, {figures['bytes'] / 1e6:.2f} MB"]
    names = {
        **{"held_out": "held-out photos", "held_out_by_fast": "the same, drawn by fast"},
        **{
            "held_out_after_pose_refinement": "the same after refining their poses",
            "trained_on": "photos trained on",
        },
    }
    for name, words in names.items():
        if figures[name] is not None:
            own = figures[name]
            worst = f"worst {own['psnr_worst_db']:.2f}"
            lines.append(f"{words}: PSNR {own['psnr_db']:.2f} dB ({worst}), SSIM {own['ssim']:.3f}")
    return lines


def _tensors(scene: GaussianScene, photos: Photos) -> Any:
    """A scene as tensors on the photos' device."""
    return GaussianTensors(
        *(tensor.to(photos.images.device) for tensor in GaussianTensors.from_scene(scene))
    )


def kit_renderer(
    scene: GaussianScene, photos: Photos, antialiased: bool, backend: str
) -> RenderPoses:
    """Renders poses with one of the kit's renderers."""

    def render_poses(poses: Any) -> Any:
        frames = []
        for pose in poses.cpu().numpy().astype(np.float64):
            # nearest rotation: `render` requires more digits than float32 has
            left, _, right = np.linalg.svd(pose[:3, :3])
            pose[:3, :3] = left @ right
            frames.append(render(scene, photos.camera, pose, backend, antialiased=antialiased).rgb)
        return torch.from_numpy(np.stack(frames)).to(photos.images.device)

    return render_poses


def _device(photos: Photos) -> str:
    """Name of the training device."""
    return torch.cuda.get_device_name() if photos.images.is_cuda else "CPU"
