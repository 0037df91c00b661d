"""`falconwing scene fit`: photos with aligned poses, or turntable photos of an aircraft -> a
Gaussian scene, judged.
"""

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
    ("held_out_by_fast", "the same, drawn by fast"),
    ("held_out_after_pose_refinement", "the same after refining their poses"),
    ("trained_on", "photos trained on"),
)
HEADERS = ("photos", "PSNR [dB]", "worst [dB]", "SSIM", "worst SSIM")


@dataclass(frozen=True)
class Fit:
    """Train a Gaussian scene on photos and judge it on places it has not seen.

    With an NVIDIA GPU and gsplat a hall takes minutes; without, give few photos, --width 64 and
    --gaussians 2000. A training that was interrupted goes on when the same words are typed again.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """the folder that `scene align` wrote, or a folder of turntable photos with cameras.json"""
    out: Path | None = None
    """folder for scene.npz, figures.json and pairs of photos and renders"""
    survey: Path | None = None
    """CSV name,x,y,z,use: where pad and marker are"""
    photos: Path | None = None
    """folder of the photos, if they are not where the reconstruction says"""
    hold_out: float | None = None
    """part of the photos to judge by, whole places of them; 0.11 if not given, 0: none"""
    held_out: Path | None = None
    """names of the photos to judge by instead, such as the figures.json of another training"""
    room: str | None = None
    """x,y,z of the room's lowest and highest corner in metres; from cameras and survey if not given
    """
    gaussians: int | None = None
    """the largest number; 200000 if not given, 5000 for an aircraft"""
    steps: int | None = None
    """30000 if not given, 8000 for an aircraft"""
    batch: int | None = None
    """photos a step"""
    width: int | None = None
    """of the images to train on in pixels; the photos' own if not given"""
    largest: float | None = None
    """standard deviation that a Gaussian may have in metres; 0.5 if not given, 0: any"""
    minutes: float | None = None
    """of training at most; it ends smoothly before; 8 if not given"""
    same_exposure: bool = False
    """the photos were taken with one exposure and white balance: learn no gain and offset for each
    """
    correct_poses: bool = False
    """let the photos' poses move a little while training, and write them to the folder `corrected`
    in --out
    """
    antialiased: bool = False
    """train for `render --antialiased`"""
    backend: Literal["auto", "gsplat", "reference"] = "auto"
    """what draws"""
    judge: Path | None = None
    """a scene file to judge on the held-out photos, drawn by `fast`, instead of training one"""
    pose_steps: int | None = None
    """of moving held-out photos to where they fit best, for figures of their own and for
    `corrected`; 200 if not given, 0: none
    """
    seed: int = 0
    """of everything that is drawn at random"""
    json: bool = False
    """print the figures as JSON"""

    def run(self) -> int:
        """Train, or judge, and print the figures.

        Returns:
            0: the scene is written, or judged.

        Raises:
            FileNotFoundError: the source or a photo is missing.
            InputError: an option makes no sense, the photos cannot be used, or the backend cannot
                run here.
        """
        if self.judge is not None:
            return self._judge(self.judge)
        if self.out is None:
            raise InputError("--out: expected a folder to write to, got none; give --out DIR")
        say = print if not self.json else (lambda _: None)
        done = fit_folder(self.source, self.out, self._changes(), self.survey, self.photos, say)
        if self.json:
            print_json(done.figures)
            return 0
        print_table(
            HEADERS, [_row(words, done.figures[key]) for key, words in ROWS if done.figures[key]]
        )
        if self.correct_poses:
            again = f"falconwing scene fit {self.out / CORRECTED} --held-out {self.out / 'figures.json'}"
            next_line(f"{again}{f' --survey {self.survey}' if self.survey else ''} --out ANOTHER")
        next_line(f"look at {self.out / 'pairs'}, then: falconwing scene info {done.path}")
        return 0

    def _judge(self, path: Path) -> int:
        """Print the figures of a scene file."""
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
            [_row(row["photo"], _own(row)) for row in figures["photos"]] + [_row("all", figures)],
        )
        next_line(f"falconwing scene info {path}")
        return 0

    def _changes(self) -> dict[str, Any]:
        """What differs from the settings that a source of this kind has by itself."""
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
    """Six numbers from text."""
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InputError(
            f"--room: expected six numbers x,y,z,x,y,z in metres, got {text[:80]!r}"
        ) from None


def _own(row: dict[str, Any]) -> dict[str, Any]:
    """One photo's figures under the names of many photos' figures."""
    return row | {"psnr_worst_db": None, "ssim_worst": None}


def _row(words: str, figures: dict[str, Any]) -> tuple[object, ...]:
    """A line of the table."""
    return (words, *(figures[key] for key in ("psnr_db", "psnr_worst_db", "ssim", "ssim_worst")))
