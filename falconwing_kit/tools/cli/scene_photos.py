"""falconwing scene poses, align: photos -> camera poses -> the same in the kit's world frame."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write
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
    check_photos,
    photos_to_poses,
)
from falconwing_kit.tools.capture.survey.picture import draw_alignment
from falconwing_kit.tools.capture.survey.points import Survey, read_clicks, read_survey
from falconwing_kit.tools.capture.survey.recipe import Alignments, align_photos, check_points
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.tools.devices.lens import Lens

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Poses:
    """Estimate the camera pose of each photo of a place. Exit code 1 if too many are missing."""

    photos: Annotated[Path, tyro.conf.Positional]
    """a folder of photos, or a COLMAP model or transforms.json made elsewhere"""
    out: Path
    """folder for transforms.json, points.ply and COLMAP's database; the same folder continues an
    interrupted run
    """
    walk: bool = False
    """the photos are in sequence like frames of a video: match only near ones"""
    focal_share: float = 0.6
    """initial focal length as a share of the photo's longer side"""
    bench: Path | None = None
    """file of falconwing bench, of the same camera and size: the photos are undistorted first"""
    images: Path | None = None
    """folder of a COLMAP model's photos, if not `images` or `photos` beside it"""
    straighten: bool = False
    """also write undistorted photos, and poses for these"""
    threads: int = 1
    """number of threads; 1 is reproducible"""
    seed: int = 0
    """of the random draws in matching and mapping"""
    json: bool = False
    """print the report as JSON"""

    def run(self) -> int:
        """Estimate or read the poses, write them and print their quality.

        Returns:
            0, or 1 if fewer than 95 % of the photos have a pose or the reprojection error exceeds
            0.8 px.

        Raises:
            FileNotFoundError: there is no such folder.
            InputError: the photos cannot be used, pycolmap is missing, or no pose was found.
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
            if self.bench is not None:
                raise InputError(
                    "--bench: expected a folder of photos with it, got poses made elsewhere, which"
                    " have a lens of their own; leave it out"
                )
            found = read_reconstruction(given)
            found = (
                replace(found, folder=self.images.resolve()) if self.images is not None else found
            )
            if not found.path(0).is_file():
                raise InputError(
                    f"{found.path(0)}: expected the model's photos there, found none; "
                    "give --images FOLDER"
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
        focal_share = self.focal_share
        if self.bench is not None:
            from falconwing_kit.tools.devices.calibration import read_bench

            lens = read_bench(self.bench).require_lens()
            given = undistort_photos(given, lens, self.out / "straight")
            focal_share = lens.fx_px / max(lens.width_px, lens.height_px)
        with _bar(self.json) as progress:
            return photos_to_poses(
                given,
                self.out,
                focal_share=focal_share,
                walk=self.walk,
                threads=self.threads,
                seed=self.seed,
                progress=progress,
            )


def undistort_photos(photos: Path, lens: "Lens", folder: Path) -> Path:
    """Write the photos of a folder without lens distortion, as PNG under their own names.

    Args:
        photos: the folder; subfolders are included.
        lens: of their camera.
        folder: to write to, created if missing; photos that are there already are kept.

    Returns:
        The folder.

    Raises:
        FileNotFoundError: there is no such folder.
        InputError: the photos cannot be used together, or are not of the lens's shape.
    """
    import cv2

    names, width, height = check_photos(photos)
    lens.camera(width, height)
    for name in names:
        path = (folder / name).with_suffix(".png")
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            straight = lens.undistort(read_photo(photos / name))
            with atomic_write(path) as file:
                file.write(cv2.imencode(".png", straight[..., ::-1])[1].tobytes())
    return folder


@dataclass(frozen=True)
class Align:
    """Align poses with the kit's world frame by a marker in the photos and a tape survey."""

    poses: Annotated[Path, tyro.conf.Positional]
    """the folder that `scene poses` wrote, a transforms.json, or a COLMAP model"""
    survey: Path
    """CSV name,x,y,z,use in metres; marker_corner_top_left ... are the marker's corners, four
    points are a flat quad
    """
    out: Path
    """folder for the aligned transforms.json, points.ply and alignment.png"""
    clicks: Path | None = None
    """CSV name,photo,u,v of clicked surveyed points in pixels; used with the detected ones"""
    marker_id: int = 7
    """the marker's id"""
    dictionary: str = "DICT_4X4_50"
    """the marker's dictionary, OpenCV's name"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Align, write and print the uncertainty of positions in the hall.

        Returns:
            0: it is aligned.

        Raises:
            FileNotFoundError: poses, survey, clicks or a photo are missing.
            InputError: no marker was detected and too few points were clicked, a file is invalid,
                or the poses are aligned already.
        """
        reconstruction, survey = read_reconstruction(self.poses), read_survey(self.survey)
        if (
            self.out.resolve()
            == (self.poses if self.poses.is_dir() else self.poses.parent).resolve()
        ):
            raise InputError(
                f"--out {self.out}: expected another folder than that of the poses, which are kept"
            )
        clicks = (
            read_clicks(self.clicks, reconstruction, survey) if self.clicks is not None else None
        )
        with _bar(self.json) as progress:
            found = align_photos(
                reconstruction, survey, self.marker_id, self.dictionary, clicks, progress
            )
        path = write_reconstruction(self.out, transform_reconstruction(found.best, reconstruction))
        draw_alignment(self.out / "alignment.png", reconstruction, survey, recipes(found))
        record = alignment_record(found, reconstruction, survey)
        record["check"] = check_record(
            found, check_points(found.best, reconstruction, survey, clicks), survey
        )
        if self.json:
            print_json({**record, "file": str(path)})
        else:
            _print_alignment(record)
            print(f"poses: {path}, figure: {self.out / 'alignment.png'}")
            next_line(f"falconwing scene fit {self.out} --survey {self.survey} --out FOLDER")
        return 0


def is_good(report: dict[str, Any]) -> bool:
    """Whether enough photos have a pose and, if reported, the reprojection error is small."""
    share = report["registered"] / report["total"]
    return bool(share >= GOOD_SHARE and report.get("reprojection_px", 0.0) <= GOOD_REPROJECTION_PX)


def recipes(found: Alignments) -> list[tuple[str, Alignment]]:
    """The alignments with their titles, the best one last."""
    named = [("marker pose of each photo", found.baseline), ("marker's corners", found.marker)]
    return [(title, a) for title, a in named if a is not None] + [
        ("all surveyed points", found.best)
    ]


def alignment_record(
    found: Alignments, reconstruction: Reconstruction, survey: Survey
) -> dict[str, Any]:
    """Quality of the alignments, as it goes to JSON.

    Returns:
        By recipe the scale, the uncertainty at the cameras' positions [m] and the distance of its
        cameras from those of the best; and the points that the best one used.
    """
    cameras = reconstruction.T_world_camera[:, :3, 3]
    best = found.best.points(cameras)

    def quality(alignment: Alignment) -> dict[str, Any]:
        sigma: Array = alignment.sigma(best)
        distance = np.linalg.norm(alignment.points(cameras) - best, axis=1)
        return {
            "metres_per_unit": alignment.scale,
            "sigma_median_m": float(np.median(sigma)),
            "sigma_max_m": float(sigma.max()),
            "from_best_mean_m": float(distance.mean()),
            "from_best_max_m": float(distance.max()),
        }

    return {
        "method": found.best.method,
        "recipes": {title: quality(alignment) for title, alignment in recipes(found)},
        "points": dict(found.best.residuals),
        "not_seen": [
            name for name in survey.select("align").names if name not in found.best.residuals
        ],
    }


def check_record(found: Alignments, places: Mapping[str, Array], survey: Survey) -> dict[str, Any]:
    """Distances of the check points from their surveyed positions, as they go to JSON.

    Args:
        places: by name: (3,) position from the photos, in the reconstruction's frame.

    Returns:
        By recipe mean and maximum distance [m]; by point that of the best recipe; and the points
        that were not observed.
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
        ("features per photo, median", report.get("features_median")),
        ("image noise, of 255", report.get("grain")),
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
        "sigma, maximum [cm]",
        "from the best [cm]",
    )
    print_table(headers, rows, title="uncertainty of the cameras' positions in the hall")
    print()
    points = [(name, p["photos"], p["rms_px"]) for name, p in record["points"].items()]
    print_table(("surveyed point", "photos", "rms [px]"), points)
    for name in record["not_seen"]:
        print(f"not observed in two photos: {name}; click it (--clicks) to use it")
    check = record["check"]
    if check["recipes"]:
        count = len(check["points_m"])
        print()
        checked = [
            (name, cm * r["mean_m"], cm * r["worst_m"]) for name, r in check["recipes"].items()
        ]
        title = (
            f"{count} of {count + len(check['not_seen'])} check points, distance from the survey"
        )
        print_table(("recipe", "mean [cm]", "maximum [cm]"), checked, title=title)
        worst = max(check["points_m"], key=lambda name: check["points_m"][name])
        print(f"maximum with all surveyed points: {worst}")


def _holds_poses(path: Path) -> bool:
    """Whether a path holds poses made elsewhere rather than photos."""
    names = ("transforms.json", "cameras.bin", "cameras.txt", "sparse")
    return path.suffix == ".json" or any((path / name).exists() for name in names)


@contextmanager
def _bar(is_quiet: bool) -> Iterator[Progress]:
    """A progress bar that restarts with each step."""
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
