"""`falconwing scene poses` and `scene align`: photos -> where they were taken -> the same in the
kit's world.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.tools.capture.align import Alignment, transform_reconstruction
from falconwing_kit.tools.capture.photo_files import (
    Reconstruction,
    read_photo,
    read_reconstruction,
    undistort,
    write_reconstruction,
)
from falconwing_kit.tools.capture.poses import (
    GOOD_REPROJECTION_PX,
    GOOD_SHARE,
    advice,
    photos_to_poses,
)
from falconwing_kit.tools.capture.survey.picture import draw_alignment
from falconwing_kit.tools.capture.survey.points import Survey, read_clicks, read_survey
from falconwing_kit.tools.capture.survey.recipe import Alignments, align_photos, check_points
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Poses:
    """Find where each photo of a place was taken. Exit code 1 where too many found no place."""

    photos: Annotated[Path, tyro.conf.Positional]
    """a folder of photos, or a COLMAP model or transforms.json made elsewhere"""
    out: Path
    """folder for transforms.json, points.ply and COLMAP's database; a run that was stopped goes on
    there
    """
    walk: bool = False
    """the photos follow each other as frames of a video do: compare only near ones"""
    focal_share: float = 0.6
    """first guess of the focal length as a share of the photo's longer side"""
    images: Path | None = None
    """where the photos of a COLMAP model are, if not in a folder called images or photos beside it
    """
    straighten: bool = False
    """also write the photos without the lens's distortion, and poses for these"""
    threads: int = 1
    """with 1 a run gives the same result again"""
    seed: int = 0
    """of the random draws in matching and mapping"""
    json: bool = False
    """print the report as JSON"""

    def run(self) -> int:
        """Find or read the poses, write them and print how good they are.

        Returns:
            0, or 1 where fewer than 95 % of the photos found their place or points miss by more
            than 0.8 px.

        Raises:
            FileNotFoundError: there is no such folder.
            InputError: the photos cannot be used, pycolmap is missing, or nothing came out.
        """
        found = self._find()
        if self.straighten:
            found = undistort(found, self.out / "straight")
        path = write_reconstruction(self.out, found)
        report = {**found.report, "advice": found.report.get("advice", [])}
        if self.json:
            print_json({**report, "file": str(path)})
        else:
            _print_poses(report, found.k1, str(path))
            next_line(
                f"falconwing scene align {self.out} --survey survey.csv --out {self.out}_aligned"
            )
        return 0 if is_good(report) else 1

    def _find(self) -> Reconstruction:
        given = self.photos
        if _holds_poses(given):
            found = read_reconstruction(given)
            found = (
                replace(found, folder=self.images.resolve()) if self.images is not None else found
            )
            if not found.path(0).is_file():
                raise InputError(
                    f"{found.path(0)}: expected the model's photos there, found none; tell --images FOLDER"
                )
            found = replace(found, folder=found.folder.resolve())
            read_photo(found.path(0))
            report = {
                "registered": len(found),
                "total": len(found),
                "focal_px": found.camera.fx,
                **found.report,
            }
            facts = {"grain": 0.0, "features_median": np.inf, **report}
            return replace(found, report={**report, "advice": advice(facts)})
        with _bar(self.json) as progress:
            return photos_to_poses(
                given,
                self.out,
                focal_share=self.focal_share,
                walk=self.walk,
                threads=self.threads,
                seed=self.seed,
                progress=progress,
            )


@dataclass(frozen=True)
class Align:
    """Bring poses into the kit's world by a marker in the photos and what a tape measured."""

    poses: Annotated[Path, tyro.conf.Positional]
    """the folder that `scene poses` wrote, a transforms.json, or a COLMAP model"""
    survey: Path
    """CSV name,x,y,z,use in metres; marker_corner_top_left ... are the marker's corners, four
    points a flat face
    """
    out: Path
    """folder for the aligned transforms.json, points.ply and alignment.png"""
    clicks: Path | None = None
    """CSV name,photo,u,v of surveyed points that somebody clicked, in pixels; used beside what is
    found
    """
    marker_id: int = 7
    """the marker's number"""
    dictionary: str = "DICT_4X4_50"
    """the marker's dictionary, as OpenCV calls it"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Align, write and say how well places in the hall are known.

        Returns:
            0: it is aligned.

        Raises:
            FileNotFoundError: poses, survey, clicks or a photo are not there.
            InputError: no marker is seen and too little was clicked, a file is wrong, or it is
                aligned already.
        """
        reconstruction, survey = read_reconstruction(self.poses), read_survey(self.survey)
        if (
            self.out.resolve()
            == (self.poses if self.poses.is_dir() else self.poses.parent).resolve()
        ):
            raise InputError(
                f"--out {self.out}: expected another folder than that of the poses; they stay as they are"
            )
        clicks = (
            read_clicks(self.clicks, reconstruction, survey) if self.clicks is not None else None
        )
        with _bar(self.json) as progress:
            found = align_photos(
                reconstruction, survey, self.marker_id, self.dictionary, clicks, progress
            )
        path = write_reconstruction(self.out, transform_reconstruction(found.best, reconstruction))
        shown = recipes(found)
        draw_alignment(self.out / "alignment.png", reconstruction, survey, shown)
        record = alignment_record(found, reconstruction, survey)
        record["check"] = check_record(
            found, check_points(found.best, reconstruction, survey, clicks), survey
        )
        if self.json:
            print_json({**record, "file": str(path)})
        else:
            _print_alignment(record)
            print(f"poses: {path}, picture: {self.out / 'alignment.png'}")
            next_line(f"falconwing scene fit {self.out} --survey {self.survey} --out FOLDER")
        return 0


def is_good(report: dict[str, Any]) -> bool:
    """Whether enough photos found their place and points fit them.

    Args:
        report: of a reconstruction; without a reprojection error only the count is judged.
    """
    share = report["registered"] / report["total"]
    return bool(share >= GOOD_SHARE and report.get("reprojection_px", 0.0) <= GOOD_REPROJECTION_PX)


def recipes(found: Alignments) -> list[tuple[str, Alignment]]:
    """The alignments that were made, with a title each, the best one last."""
    named = [("marker pose of each photo", found.baseline), ("marker's corners", found.marker)]
    return [(title, a) for title, a in named if a is not None] + [
        ("all surveyed points", found.best)
    ]


def alignment_record(
    found: Alignments, reconstruction: Reconstruction, survey: Survey
) -> dict[str, Any]:
    """What an alignment is like, as it goes to JSON.

    Args:
        found: the alignments.
        reconstruction: what they were found on.
        survey: with the points.

    Returns:
        By recipe the scale, the uncertainty over the cameras' places [m], and how far its cameras
        are from those of the best; and the points that the best one used.
    """
    cameras = reconstruction.T_world_camera[:, :3, 3]
    best = found.best.points(cameras)

    def one(alignment: Alignment) -> dict[str, Any]:
        sigma: Array = alignment.sigma(best)
        apart = np.linalg.norm(alignment.points(cameras) - best, axis=1)
        return {
            "metres_per_unit": alignment.scale,
            "sigma_median_m": float(np.median(sigma)),
            "sigma_max_m": float(sigma.max()),
            "from_best_mean_m": float(apart.mean()),
            "from_best_max_m": float(apart.max()),
        }

    return {
        "method": found.best.method,
        "recipes": {title: one(alignment) for title, alignment in recipes(found)},
        "points": dict(found.best.residuals),
        "not_seen": [
            name for name in survey.select("align").names if name not in found.best.residuals
        ],
    }


def check_record(found: Alignments, places: Mapping[str, Array], survey: Survey) -> dict[str, Any]:
    """How far alignments put points kept for checking from where the tape had them, as it goes to
    JSON.

    Args:
        found: the alignments.
        places: by name: (3,) where photos show the points, in the reconstruction's frame.
        survey: with the points.

    Returns:
        By recipe mean and worst distance [m]; by point that of the best recipe; and the points that
        were not seen.
    """
    seen = np.array(list(places.values())).reshape(-1, 3)
    tape = survey.places(places).reshape(-1, 3)
    miss = (
        {title: np.linalg.norm(a.points(seen) - tape, axis=1) for title, a in recipes(found)}
        if places
        else {}
    )
    return {
        "recipes": {
            title: {"mean_m": float(m.mean()), "worst_m": float(m.max())}
            for title, m in miss.items()
        },
        "points_m": dict(zip(places, list(miss.values())[-1].tolist(), strict=True))
        if miss
        else {},
        "not_seen": [name for name in survey.select("check").names if name not in places],
    }


def _print_poses(report: dict[str, Any], k1: float, title: str) -> None:
    """The report of poses as a table."""
    rows = [
        ("photos with a pose", report["registered"]),
        ("photos", report["total"]),
        ("points", report.get("points")),
        ("reprojection error [px]", report.get("reprojection_px")),
        ("focal length [px]", report["focal_px"]),
        ("its standard deviation [px]", report.get("focal_sigma_px")),
        ("distortion k1", k1),
        ("features in a middling photo", report.get("features_median")),
        ("grain, of 255", report.get("grain")),
    ]
    print_table(("what", "value"), rows, title=title)
    for sentence in report["advice"]:
        print(f"advice: {sentence}")


def _print_alignment(record: dict[str, Any]) -> None:
    """The record of an alignment as tables."""
    cm = 100.0
    rows = [
        (
            name,
            r["metres_per_unit"],
            cm * r["sigma_median_m"],
            cm * r["sigma_max_m"],
            cm * r["from_best_mean_m"],
        )
        for name, r in record["recipes"].items()
    ]
    headers = (
        "recipe",
        "metres per unit",
        "sigma, median [cm]",
        "sigma, greatest [cm]",
        "from the best [cm]",
    )
    print_table(headers, rows, title="how well the cameras' places are known in the hall")
    print()
    points = [(name, p["photos"], p["rms_px"]) for name, p in record["points"].items()]
    print_table(("surveyed point", "photos", "rms [px]"), points)
    for name in record["not_seen"]:
        print(f"not seen in two photos: {name}; click it (--clicks) to use it")
    check = record["check"]
    if check["recipes"]:
        count = len(check["points_m"])
        print()
        checked = [
            (name, cm * r["mean_m"], cm * r["worst_m"]) for name, r in check["recipes"].items()
        ]
        title = (
            f"{count} of {count + len(check['not_seen'])} points kept for checking, off the tape by"
        )
        print_table(("recipe", "mean [cm]", "worst [cm]"), checked, title=title)
        worst = max(check["points_m"], key=lambda name: check["points_m"][name])
        print(f"worst by all surveyed points: {worst}")


def _holds_poses(path: Path) -> bool:
    """Whether a path is to be taken for poses made elsewhere rather than for a folder of photos."""
    names = ("transforms.json", "cameras.bin", "cameras.txt", "sparse")
    return path.suffix == ".json" or any((path / name).exists() for name in names)


@contextmanager
def _bar(is_quiet: bool) -> Iterator[Progress]:
    """A progress bar that begins again with each step."""
    from tqdm import tqdm

    now: dict[str, Any] = {"step": "", "done": 0}
    with tqdm(leave=False, disable=True if is_quiet else None) as bar:

        def progress(step: str, done: int, total: int) -> None:
            if step != now["step"]:
                bar.reset(total or None)
                bar.set_description(step, refresh=False)
                now.update(step=step, done=0)
            bar.update(done - now["done"])
            now["done"] = done

        yield progress
