"""falconwing scene fit: aligned photos, or turntable photos of an aircraft -> a Gaussian scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.capture.fit import CORRECTED, evaluate_scene, fit_folder
from falconwing_kit.tools.capture.photo_files import read_reconstruction
from falconwing_kit.tools.capture.training.settings import FitSettings
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

ROWS = (
    ("held_out", "held-out photos"),
    ("held_out_by_fast", "the same, rendered by fast"),
    ("held_out_after_pose_refinement", "the same after refining their poses"),
    ("trained_on", "photos trained on"),
)
HEADERS = ("photos", "PSNR [dB]", "minimum [dB]", "SSIM", "minimum SSIM")


@dataclass(frozen=True)
class Fit:
    """Train a Gaussian scene on photos and evaluate it on held-out places.

    With an NVIDIA GPU and gsplat a hall takes minutes; without, use few photos, --width 64 and
    --gaussians 2000. The same command continues an interrupted training.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """the folder that `scene align` wrote, or a folder of turntable photos with cameras.json"""
    out: Path | None = None
    """folder for scene.npz, figures.json and pairs of photos and renders"""
    survey: Path | None = None
    """CSV name,x,y,z,use: surveyed points, among them pad and marker"""
    photos: Path | None = None
    """folder of the photos, if they are not where the reconstruction's paths point"""
    hold_out: float | None = None
    """share of the photos held out for evaluation, by places; 0.11 if not given, 0: none"""
    held_out: Path | None = None
    """names of the photos to hold out instead, such as the figures.json of another training"""
    room: str | None = None
    """x,y,z of the room's lowest and highest corner in metres; from cameras and survey if not given
    """
    gaussians: int | None = None
    """maximum number; 200000 if not given, 5000 for an aircraft"""
    steps: int | None = None
    """30000 if not given, 8000 for an aircraft"""
    batch: int | None = None
    """photos a step"""
    width: int | None = None
    """of the images to train on in pixels; the photos' own if not given"""
    largest: float | None = None
    """maximum standard deviation of a Gaussian in metres; 0.5 if not given, 0: unlimited"""
    minutes: float | None = None
    """maximum time of training, the schedule fits into it; 8 if not given"""
    same_exposure: bool = False
    """the photos were taken with one exposure and white balance: learn no gain and offset for each
    """
    correct_poses: bool = False
    """optimise the photos' poses too, and write them to the folder `corrected` in --out"""
    antialiased: bool = False
    """train for `render --antialiased`"""
    backend: Literal["auto", "gsplat", "reference"] = "auto"
    """renderer of the training"""
    judge: Path | None = None
    """evaluate this scene file on the held-out photos, rendered by `fast`; no training"""
    pose_steps: int | None = None
    """steps of pose refinement of held-out photos, reported separately and used for `corrected`;
    200 if not given, 0: none
    """
    seed: int = 0
    """of all random draws"""
    json: bool = False
    """print the figures as JSON"""

    def run(self) -> int:
        """Train, or evaluate a scene file, and print the figures.

        Returns:
            0: the scene is written, or evaluated.

        Raises:
            FileNotFoundError: the source or a photo is missing.
            InputError: an option is wrong, the photos cannot be used, or the backend cannot
                run here.
        """
        if self.judge is not None:
            return self._judge(self.judge)
        if self.out is None:
            raise InputError("--out: expected a folder to write to, got none; give --out DIR")
        log = print if not self.json else (lambda _: None)
        done = fit_folder(self.source, self.out, self._changes(), self.survey, self.photos, log)
        if self.json:
            print_json(done.figures)
            return 0
        print_table(
            HEADERS, [_row(words, done.figures[key]) for key, words in ROWS if done.figures[key]]
        )
        if self.correct_poses:
            survey = f" --survey {self.survey}" if self.survey else ""
            next_line(
                f"falconwing scene fit {self.out / CORRECTED} "
                f"--held-out {self.out / 'figures.json'}{survey} --out ANOTHER"
            )
        next_line(f"look at {self.out / 'pairs'}, then: falconwing scene info {done.path}")
        return 0

    def _judge(self, path: Path) -> int:
        """Evaluate a scene file and print its figures."""
        figures = evaluate_scene(
            path,
            read_reconstruction(self.source),
            FitSettings(**self._changes()),
            folder=self.photos,
        )
        if self.json:
            print_json(figures)
            return 0
        print_table(
            HEADERS,
            [_row(row["photo"], _single_photo(row)) for row in figures["photos"]]
            + [_row("all", figures)],
        )
        next_line(f"falconwing scene info {path}")
        return 0

    def _changes(self) -> dict[str, Any]:
        """The settings given on the command line, which replace defaults of the kind of source."""
        changes: dict[str, Any] = {
            "seed": self.seed,
            "backend": self.backend,
            "antialiased": self.antialiased,
        }
        for name in (
            "gaussians",
            "steps",
            "batch",
            "width",
            "largest",
            "hold_out",
            "minutes",
            "pose_steps",
        ):
            if getattr(self, name) is not None:
                changes[name] = getattr(self, name)
        if self.same_exposure:
            changes["exposures"] = False
        if self.correct_poses:
            changes["poses"] = True
        if self.held_out is not None:
            from falconwing_kit.tools.capture.training.photos import read_photo_names

            changes["judge_by"] = read_photo_names(self.held_out)
        if self.room is not None:
            changes["room"] = _corners(self.room)
        return changes


def _corners(text: str) -> tuple[float, ...]:
    """Low and high corner, six numbers, from text."""
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InputError(
            f"--room: expected six numbers x,y,z,x,y,z in metres, got {text[:80]!r}"
        ) from None


def _single_photo(row: dict[str, Any]) -> dict[str, Any]:
    """One photo's figures with the keys of a set's figures; a single photo has no minimum."""
    return row | {"psnr_worst_db": None, "ssim_worst": None}


def _row(words: str, figures: dict[str, Any]) -> tuple[object, ...]:
    """One row of the table."""
    return (words, *(figures[key] for key in ("psnr_db", "psnr_worst_db", "ssim", "ssim_worst")))
