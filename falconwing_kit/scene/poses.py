"""Photos to poses: a folder of photos of one place -> Reconstruction, by COLMAP's structure from motion (pycolmap).

pycolmap is the optional extra `capture`. Its database stays in the output folder, so a run that was stopped goes on
where it was: features and matches are not computed twice.
"""

import sqlite3
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.files import short_name
from falconwing_kit.scene.photo_files import Reconstruction, read_photo, read_reconstruction

ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
LEAST_PHOTOS, LEAST_SIDE_PX = 3, 160
ENOUGH_FEATURES, MAX_FEATURES = 300, 4096  # a photo with fewer finds few partners; more only cost time
GOOD_SHARE, GOOD_REPROJECTION_PX = 0.95, 0.8  # what a good set of photos reaches
NOISY = 5.0  # standard deviation of the grain [of 255] above which features are grain
DATABASE, MODEL = "colmap.db", "sparse"

Progress = Callable[[str, int, int], None]


def quiet(step: str, done: int, total: int) -> None:
    """Progress that tells nobody."""


def photos_to_poses(
    photos: str | Path,
    out: str | Path,
    *,
    focal_share: float = 0.6,
    walk: bool = False,
    threads: int = 1,
    seed: int = 0,
    progress: Progress = quiet,
) -> Reconstruction:
    """Find where each photo was taken.

    SIFT features, matches between all pairs (or neighbours only), incremental mapping with one shared camera whose
    focal length and k1 are refined [Schonberger & Frahm 2016, Structure-from-Motion Revisited].

    Args:
        photos: a folder; photos in folders inside it count too.
        out: for the database and COLMAP's model; made where it is missing. Another run with the same photos goes on.
        focal_share: first guess of the focal length, as a share of the longer side; 10 % off does no harm.
        walk: True: the photos follow each other by name as frames of a video do; only near ones are compared. False:
            each is compared with each, which takes time with the square of their number.
        threads: for all steps; with 1 a run gives the same again.
        seed: of the random draws in matching and mapping.
        progress: called with step, done and total.

    Returns:
        Poses of the photos that found their place; report has registered, total, reprojection_px, focal_px,
        focal_sigma_px, points, features_median, grain and advice.

    Raises:
        FileNotFoundError: there is no such folder.
        InputError: pycolmap is missing, the photos cannot be used together, or nothing could be reconstructed; the
            text says what to do.
    """
    colmap = _pycolmap()
    focal_share = require_range("focal_share", focal_share, low=0.2, high=5.0)
    threads = int(require_range("threads", threads, low=1, high=256))
    photos, out = Path(photos).resolve(), Path(out)
    names, width, height = check_photos(photos)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: want a folder, got a file; choose another name")
    (out / MODEL).mkdir(parents=True, exist_ok=True)
    database = out / DATABASE
    _require_same_photos(database, names)
    colmap.logging.minloglevel = int(colmap.logging.Level.FATAL)
    colmap.set_random_seed(int(require_range("seed", seed, low=0, high=2**31 - 1)))
    _extract(
        colmap,
        database,
        photos,
        names,
        f"{focal_share * max(width, height)},{width / 2},{height / 2},0",
        threads,
        progress,
    )
    _match(colmap, database, len(names), walk, threads, progress)
    models = _map(colmap, database, photos, out / MODEL, len(names), threads, progress)
    facts = {**photo_facts(database, photos, names), "total": len(names), "models": len(models)}
    number, best = max(models.items(), key=lambda item: item[1].num_reg_images(), default=(0, None))
    if best is None or best.num_reg_images() < LEAST_PHOTOS:
        raise InputError(f"{photos}: no reconstruction came out of {len(names)} photos. {' '.join(advice(facts))}")
    progress("focal uncertainty", 0, 1)
    camera = next(iter(best.cameras.values()))
    facts |= {"focal_px": float(camera.params[0]), "focal_sigma_px": focal_sigma(colmap, best)}
    found = read_reconstruction(out / MODEL / str(number))
    report = {**found.report, **facts}
    return replace(found, folder=photos, report={**report, "advice": advice(report)})


def check_photos(folder: str | Path) -> tuple[tuple[str, ...], int, int]:
    """Look at every photo before hours are spent on them.

    Args:
        folder: with photos.

    Returns:
        Their names relative to the folder, sorted, and the width and height they share [px].

    Raises:
        FileNotFoundError: there is no such folder.
        InputError: there are too few, one is unreadable, small, turned by its EXIF note, or of another size.
    """
    from PIL import Image, UnidentifiedImageError

    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: want a folder of photos, found {'a file' if folder.exists() else 'nothing'}"
        )
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in ENDINGS and path.is_file())
    if len(paths) < LEAST_PHOTOS:
        raise InputError(f"{folder}: want {LEAST_PHOTOS} or more photos ({', '.join(ENDINGS)}), got {len(paths)}")
    sizes = {}
    for path in paths:
        try:
            with Image.open(path) as image:
                sizes[path], turned = image.size, image.getexif().get(0x0112, 1)
                image.draft("L", (8, 8))  # JPEG: decode an eighth only, enough to see that it is whole
                image.load()
        except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
            raise InputError(
                f"{short_name(path)}: want a photo, got a file that is damaged or none; remove it"
            ) from None
        if turned not in (0, 1):
            raise InputError(
                f"{short_name(path)}: want photos as the sensor took them, got one that its EXIF note turns; hold the "
                "camera level for all photos, or remove that note from all (exiftool -Orientation= *)"
            )
    (size, count), *others = Counter(sizes.values()).most_common()
    if others:
        odd = next(path for path, other in sizes.items() if other != size)
        raise InputError(
            f"{short_name(odd)}: want all photos of one size, got {sizes[odd][0]}x{sizes[odd][1]} beside {count} of "
            f"{size[0]}x{size[1]}; leave out those that were cropped or taken with another camera or zoom"
        )
    if min(size) < LEAST_SIDE_PX:
        raise InputError(f"{folder}: want photos of {LEAST_SIDE_PX} px or more on each side, got {size[0]}x{size[1]}")
    return tuple(path.relative_to(folder).as_posix() for path in paths), *size


def photo_facts(database: Path, photos: Path, names: Sequence[str], sample: int = 20) -> dict[str, Any]:
    """What the photos are like: features in a middling photo, the share of photos with enough, and the grain.

    Args:
        database: COLMAP's, after extraction.
        photos: their folder.
        names: relative to it.
        sample: how many photos the grain is measured on.
    """
    counts = np.array([row[0] for row in _query(database, "SELECT rows FROM keypoints")] or [0])
    chosen = [names[k] for k in np.unique(np.linspace(0, len(names) - 1, sample).astype(int))]
    grains = [grain(read_photo(photos / name)) for name in chosen]
    return {
        "features_median": float(np.median(counts)),
        "features_enough": float((counts >= ENOUGH_FEATURES).mean()),
        "grain": float(np.median(grains)),
    }


def grain(image: np.ndarray[Any, Any]) -> float:
    """Standard deviation of a photo's noise, from its finest differences, which edges hardly reach.

    sigma = 1.4826 median |I * N| / 6,  N = [[1, -2, 1], [-2, 4, -2], [1, -2, 1]]      [Immerkaer 1996, with a median]

    Args:
        image: (H, W, 3) 0..255.

    Returns:
        [of 255].
    """
    grey = image.astype(np.float64).mean(axis=2)
    rows = grey[:-2] - 2.0 * grey[1:-1] + grey[2:]
    return float(1.4826 * np.median(np.abs(rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:])) / 6.0)


def advice(facts: Mapping[str, Any]) -> list[str]:
    """What to do about a reconstruction that is not good, in sentences; empty for a good one.

    Args:
        facts: the report of `photos_to_poses`.
    """
    registered, total = facts.get("registered", 0), facts["total"]
    said = []
    if registered < GOOD_SHARE * total:
        if facts["grain"] > NOISY:
            said.append(
                f"The photos are grainy ({facts['grain']:.0f} of 255), as analog video is: features are then mostly "
                "noise. Use a digital camera, more light, or the mean of several frames of a still view."
            )
        if facts["features_median"] < ENOUGH_FEATURES:
            said.append(
                f"A middling photo has {facts['features_median']:.0f} features where {ENOUGH_FEATURES} are wanted: "
                "plain walls, darkness or blur. Show more things in each photo, hold still, and hang posters if need be."
            )
        if not said:
            said.append(
                "Photos overlap too little: let each show two thirds of what the one before showed, walk in an arc "
                "rather than turn on the spot, and join the places by photos from between."
            )
        if facts.get("models", 1) > 1:
            said.append(f"The photos fell into {facts['models']} groups that share no view; the largest was kept.")
    if facts.get("reprojection_px", 0.0) > GOOD_REPROJECTION_PX:
        said.append(
            f"Points miss by {facts['reprojection_px']:.2f} px where {GOOD_REPROJECTION_PX} is good: blur, a rolling "
            "shutter, zoom that changed, or things that moved."
        )
    return said


def focal_sigma(colmap: Any, model: Any) -> float:
    """Standard deviation of the focal length from the bundle adjustment's covariance [px]; nan where it has none.

    Args:
        colmap: the module pycolmap.
        model: its reconstruction.
    """
    config = colmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = colmap.create_default_ceres_bundle_adjuster(colmap.BundleAdjustmentOptions(), config, model)
    options = colmap.BACovarianceOptions(params=colmap.BACovarianceOptionsParams.ALL)
    covariance = colmap.estimate_ba_covariance(options, model, adjuster)
    found = None if covariance is None else covariance.get_other_params_cov(next(iter(model.cameras.values())).params)
    if found is None:
        return float("nan")
    return float(np.sqrt(found[0, 0]) * model.compute_mean_reprojection_error())


def _extract(
    colmap: Any, database: Path, photos: Path, names: Sequence[str], camera: str, threads: int, progress: Progress
) -> None:
    """Features of every photo, into the database."""
    reader = colmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", camera_params=camera)
    options = colmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    options.sift.max_num_features = MAX_FEATURES
    ids = [row[0] for row in _query(database, "SELECT camera_id FROM cameras")]
    if ids:
        reader.existing_camera_id = ids[0]

    def work(token: Any) -> None:
        colmap.extract_features(
            database,
            photos,
            image_names=list(names),
            camera_mode=colmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=colmap.Device.cpu,
            cancellation_token=token,
        )

    _watched(colmap, work, lambda: progress("features", _count(database, "descriptors"), len(names)))


def _match(colmap: Any, database: Path, photos: int, walk: bool, threads: int, progress: Progress) -> None:
    """Matches between photos that pass the epipolar check, into the database."""
    options = colmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    near = colmap.SequentialPairingOptions(overlap=20, quadratic_overlap=True)

    def work(token: Any) -> None:
        given = {"matching_options": options, "device": colmap.Device.cpu, "cancellation_token": token}
        if walk:
            colmap.match_sequential(database, pairing_options=near, **given)
        else:
            colmap.match_exhaustive(database, **given)

    total = photos * (photos - 1) // 2
    _watched(colmap, work, lambda: progress("matches", _count(database, "two_view_geometries"), 0 if walk else total))


def _map(
    colmap: Any, database: Path, photos: Path, out: Path, total: int, threads: int, progress: Progress
) -> Mapping[int, Any]:
    """Every group of photos that could be put together."""
    options = colmap.IncrementalPipelineOptions(num_threads=threads)
    done, models = [0], {}

    def one_more() -> None:
        done[0] += 1

    def work(token: Any) -> None:
        models.update(
            colmap.incremental_mapping(
                database, photos, out, options=options, next_image_callback=one_more, cancellation_token=token
            )
        )

    _watched(colmap, work, lambda: progress("poses", min(done[0] + 2, total), total))
    return models


def _watched(colmap: Any, work: Callable[[Any], None], tell: Callable[[], None]) -> None:
    """Run a long native step in a thread, tell how far it is twice a second, and stop it on Ctrl-C."""
    token, failures = colmap.CancellationToken(), []

    def run() -> None:
        try:
            work(token)
        except Exception as error:
            failures.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.5)
            tell()
    except BaseException:
        token.cancel()
        thread.join()
        raise
    if failures:
        raise InputError(f"pycolmap stopped: {str(failures[0]).strip().splitlines()[-1][:200]}") from failures[0]


def _require_same_photos(database: Path, names: Sequence[str]) -> None:
    """Refuse to go on with the database of other photos."""
    known = {row[0] for row in _query(database, "SELECT name FROM images")}
    gone = sorted(known - set(names))
    if gone:
        raise InputError(
            f"{short_name(database)}: it knows photos that are not there any more, such as {gone[0][:60]}; write to "
            "another folder, or remove this file to begin again"
        )


def _count(database: Path, table: str) -> int:
    return int((_query(database, f"SELECT count(*) FROM {table}") or [(0,)])[0][0])


def _query(database: Path, question: str) -> list[tuple[Any, ...]]:
    """Rows of a read-only query; none where the database does not exist yet or is being made."""
    if not database.is_file():
        return []
    try:
        with closing(
            sqlite3.connect(f"file:{database.resolve().as_posix()}?mode=ro", uri=True, timeout=2.0)
        ) as connection:
            return connection.execute(question).fetchall()
    except sqlite3.OperationalError:
        return []
    except sqlite3.DatabaseError:
        raise InputError(f"{short_name(database)}: want COLMAP's database, got a damaged file; remove it") from None


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError:
        raise InputError(
            "pycolmap: want this library for poses from photos, it is not installed; "
            "pip install 'falconwing-kit[capture]', or make a COLMAP model or a transforms.json elsewhere and give that"
        ) from None
    return pycolmap
