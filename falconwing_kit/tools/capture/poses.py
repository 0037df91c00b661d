"""Photos to poses: a folder of photos of one place -> Reconstruction, by COLMAP (pycolmap).

pycolmap is the optional extra `capture`. Its database stays in the output folder, so that an
interrupted run resumes without computing features and matches again.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.tools.capture.photo_files import Reconstruction, read_photo, read_reconstruction

ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
MIN_PHOTOS, MIN_PHOTO_SIDE_PX = 3, 160
ENOUGH_FEATURES, MAX_FEATURES = 300, 4096  # per photo: few matches below; only slower above
GOOD_SHARE, GOOD_REPROJECTION_PX = 0.95, 0.8  # registered share and error of a good set of photos
NOISY = 3.0  # [of 255] row noise; digital photos have less, analog video more
WALK_OVERLAP = 20  # previous photos that each photo of a sequence is matched with
DATABASE, MODEL = "colmap.db", "sparse"

Progress = Callable[[str, int, int], None]


def no_progress(step: str, done: int, total: int) -> None:
    """Progress callback that does nothing."""


def photos_to_poses(
    photos: str | Path,
    out: str | Path,
    *,
    focal_share: float = 0.6,
    walk: bool = False,
    threads: int = 1,
    seed: int = 0,
    progress: Progress = no_progress,
) -> Reconstruction:
    """Estimate the camera pose of each photo by structure from motion.

    SIFT features, matches between all pairs (or neighbours only), incremental mapping with one
    shared camera whose focal length and k1 are refined [Schonberger & Frahm 2016,
    Structure-from-Motion Revisited].

    Args:
        photos: a folder; subfolders are included.
        out: for the database and COLMAP's model; created if missing. A further run with the same
            photos resumes.
        focal_share: initial focal length, as a share of the longer side; 10 % accuracy suffices.
        walk: True: the photos are a sequence by name, as frames of a video; only near ones are
            matched. False: all pairs are matched, in quadratic time.
        threads: for all steps; 1 makes a run reproducible.
        progress: called with step, done and total.

    Returns:
        Poses of the registered photos; report has registered, total, reprojection_px, focal_px,
        focal_sigma_px, points, features_median, grain and advice.

    Raises:
        FileNotFoundError: there is no such folder.
        InputError: pycolmap is missing, the photos cannot be used together, or nothing could be
            reconstructed.
    """
    colmap = _pycolmap()
    focal_share = require_range("focal_share", focal_share, low=0.2, high=5.0)
    threads = int(require_range("threads", threads, low=1, high=256))
    photos, out = Path(photos).resolve(), Path(out)
    names, width, height = check_photos(photos)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder, got a file; choose another name")
    (out / MODEL).mkdir(parents=True, exist_ok=True)
    database = out / DATABASE
    colmap.logging.minloglevel = int(colmap.logging.Level.FATAL)
    colmap.set_random_seed(int(require_range("seed", seed, low=0, high=2**31 - 1)))
    _require_same_photos(colmap, database, names)
    guess = f"{focal_share * max(width, height)},{width / 2},{height / 2},0"
    try:
        _extract(colmap, database, photos, names, guess, threads, progress)
        _match(colmap, database, names, walk, threads, progress)
        models = _map(colmap, database, photos, out / MODEL, len(names), threads, progress)
        features = _features(colmap, database)
    except (
        RuntimeError
    ) as error:  # of the native library: a full disk, or a database that another run is using
        raise InputError(
            f"{out}: COLMAP stopped: {str(error).strip().splitlines()[-1][-200:]}"
        ) from error
    facts = {
        **photo_statistics(features, photos, names),
        "total": len(names),
        "models": len(models),
    }
    number, best = max(models.items(), key=lambda item: item[1].num_reg_images(), default=(0, None))
    if best is None or best.num_reg_images() < MIN_PHOTOS:
        raise InputError(
            f"{photos}: no reconstruction came out of {len(names)} photos. "
            f"{' '.join(advice(facts))}"
        )
    progress("focal uncertainty", 0, 1)
    camera = next(iter(best.cameras.values()))
    facts |= {"focal_px": float(camera.params[0]), "focal_sigma_px": focal_sigma(colmap, best)}
    found = read_reconstruction(out / MODEL / str(number))
    report = {**found.report, **facts}
    return replace(found, folder=photos, report={**report, "advice": advice(report)})


def check_photos(folder: str | Path) -> tuple[tuple[str, ...], int, int]:
    """Check every photo before the reconstruction, which takes hours.

    Args:
        folder: with photos.

    Returns:
        Their names relative to the folder, sorted, and their common width and height [px].

    Raises:
        FileNotFoundError: there is no such folder.
        InputError: there are too few, or one is unreadable, small, rotated by its EXIF orientation,
            or of another size.
    """
    from PIL import Image, UnidentifiedImageError

    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: expected a folder of photos, found "
            f"{'a file' if folder.exists() else 'nothing'}"
        )
    paths = sorted(
        path for path in folder.rglob("*") if path.suffix.lower() in ENDINGS and path.is_file()
    )
    if len(paths) < MIN_PHOTOS:
        raise InputError(
            f"{folder}: expected {MIN_PHOTOS} or more photos ({', '.join(ENDINGS)}), "
            f"got {len(paths)}"
        )
    sizes = {}
    for path in paths:
        if any(letter.isspace() for letter in path.relative_to(folder).as_posix()):
            raise InputError(
                f"{short_name(path)}: expected names without blanks, for COLMAP's lists; "
                "rename the photos"
            )
        try:
            with Image.open(path) as image:
                sizes[path], orientation = image.size, image.getexif().get(0x0112, 1)
                image.draft("L", (8, 8))  # JPEG: decode at an eighth, which detects damage
                image.load()
        except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
            raise InputError(
                f"{short_name(path)}: expected a photo, got a file that is damaged or none; "
                "remove it"
            ) from None
        if orientation not in (0, 1):
            raise InputError(
                f"{short_name(path)}: expected photos as the sensor took them, "
                "got one that its EXIF note turns; hold the "
                "camera level for all photos, or remove that note from all (exiftool -Orientation= "
                "*)"
            )
    (size, count), *others = Counter(sizes.values()).most_common()
    if others:
        odd = next(path for path, other in sizes.items() if other != size)
        raise InputError(
            f"{short_name(odd)}: expected all photos of one size, "
            f"got {sizes[odd][0]}x{sizes[odd][1]} beside {count} of "
            f"{size[0]}x{size[1]}; leave out those that were cropped or taken with another camera "
            "or zoom"
        )
    if min(size) < MIN_PHOTO_SIDE_PX:
        raise InputError(
            f"{folder}: expected photos of {MIN_PHOTO_SIDE_PX} px or more on each side, "
            f"got {size[0]}x{size[1]}"
        )
    return tuple(path.relative_to(folder).as_posix() for path in paths), *size


def photo_statistics(
    features: Sequence[int], photos: Path, names: Sequence[str], sample: int = 20
) -> dict[str, Any]:
    """Median feature count, share of photos with enough features, and image noise.

    Args:
        features: of each photo.
        photos: their folder.
        names: relative to it.
        sample: number of photos on which the noise is measured.
    """
    chosen = [names[k] for k in np.unique(np.linspace(0, len(names) - 1, sample).astype(int))]
    grains = [row_noise(read_photo(photos / name)) for name in chosen]
    return {
        "features_median": float(np.median(features)),
        "features_enough": float((np.array(features) >= ENOUGH_FEATURES).mean()),
        "grain": float(np.median(grains)),
    }


def row_noise(image: np.ndarray[Any, Any]) -> float:
    """Standard deviation of the noise between rows, which is large for analog video.

    sigma = 1.4826 median |row above - 2 row + row below| / sqrt(6)

    Edges and gradients hardly affect the median.

    Args:
        image: (H, W, 3) 0..255.
    """
    grey = image.astype(np.float64).mean(axis=2)
    return float(1.4826 * np.median(np.abs(grey[:-2] - 2.0 * grey[1:-1] + grey[2:])) / np.sqrt(6.0))


def advice(facts: Mapping[str, Any]) -> list[str]:
    """Suggestions for a poor reconstruction, in sentences; empty for a good one.

    Args:
        facts: the report of `photos_to_poses`.
    """
    registered, total = facts.get("registered", 0), facts["total"]
    sentences = []
    if registered < GOOD_SHARE * total:
        if facts["grain"] > NOISY:
            sentences.append(
                f"The photos are grainy ({facts['grain']:.0f} of 255), as analog video is: "
                "features are then mostly "
                "noise. Use a digital camera, more light, or the mean of several frames of a still "
                "view."
            )
        if facts["features_median"] < ENOUGH_FEATURES:
            sentences.append(
                f"A middling photo has {facts['features_median']:.0f} features where "
                f"{ENOUGH_FEATURES} are wanted: "
                "plain walls, darkness or blur. Show more things in each photo, hold still, "
                "hang posters if need be."
            )
        if not sentences:
            sentences.append(
                "Photos overlap too little: let each show two thirds of what the one before "
                "showed, walk in an arc "
                "rather than turn on the spot, and join the places by photos from between."
            )
        if facts.get("models", 1) > 1:
            sentences.append(
                f"The photos fell into {facts['models']} groups that share no view; "
                "the largest was kept."
            )
    if facts.get("reprojection_px", 0.0) > GOOD_REPROJECTION_PX:
        sentences.append(
            f"Points miss by {facts['reprojection_px']:.2f} px where {GOOD_REPROJECTION_PX} is "
            "good: blur, a rolling "
            "shutter, zoom that changed, or things that moved."
        )
    return sentences


def focal_sigma(colmap: Any, model: Any) -> float:
    """Standard deviation of the focal length from bundle adjustment [px]; NaN if undetermined.

    Args:
        colmap: the module pycolmap.
        model: its reconstruction.
    """
    config = colmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = colmap.create_default_ceres_bundle_adjuster(
        colmap.BundleAdjustmentOptions(), config, model
    )
    options = colmap.BACovarianceOptions(params=colmap.BACovarianceOptionsParams.ALL)
    covariance = colmap.estimate_ba_covariance(options, model, adjuster)
    found = (
        None
        if covariance is None
        else covariance.get_other_params_cov(next(iter(model.cameras.values())).params)
    )
    if found is None:
        return float("nan")
    return float(np.sqrt(found[0, 0]) * model.compute_mean_reprojection_error())


def _extract(
    colmap: Any,
    database: Path,
    photos: Path,
    names: Sequence[str],
    camera: str,
    threads: int,
    progress: Progress,
) -> None:
    """Extract the features of all photos into the database, in chunks so that Ctrl-C works."""
    reader = colmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", camera_params=camera)
    options = colmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    options.sift.max_num_features = MAX_FEATURES
    chunk = 4 * threads
    for start in range(0, len(names), chunk):
        progress("features", start, len(names))
        with closing(colmap.Database.open(database)) as opened:
            cameras = opened.read_all_cameras()
        if cameras:
            reader.existing_camera_id = cameras[0].camera_id
        colmap.extract_features(
            database,
            photos,
            image_names=list(names[start : start + chunk]),
            camera_mode=colmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=colmap.Device.cpu,
        )


def _match(
    colmap: Any, database: Path, names: Sequence[str], walk: bool, threads: int, progress: Progress
) -> None:
    """Match photo pairs and verify them geometrically, one photo with its partners per call."""
    options = colmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    listed = database.with_name("pairs.txt")
    partners = [earlier_photos(number, walk) for number in range(len(names))]
    done, total = 0, sum(map(len, partners))
    try:
        for number, others in enumerate(partners[1:], start=1):
            with atomic_write(listed, text=True) as file:
                file.writelines(f"{names[other]} {names[number]}\n" for other in others)
            colmap.match_image_pairs(
                database,
                matching_options=options,
                pairing_options=colmap.ImportedPairingOptions(match_list_path=listed),
                device=colmap.Device.cpu,
            )
            done += len(others)
            progress("matches", done, total)
    finally:
        listed.unlink(missing_ok=True)


def earlier_photos(number: int, walk: bool) -> list[int]:
    """Numbers of the earlier photos that a photo is matched with, ascending.

    Args:
        number: of the photo, in the order of names.
        walk: False: all of them. True: the WALK_OVERLAP before it, and those 32, 64, 128 ... before
            it, since a walk may return to a place.
    """
    if not walk:
        return list(range(number))
    steps = {*range(1, WALK_OVERLAP + 1), *(2**power for power in range(5, 20))}
    return sorted(number - step for step in steps if step <= number)


def _map(
    colmap: Any,
    database: Path,
    photos: Path,
    out: Path,
    total: int,
    threads: int,
    progress: Progress,
) -> Mapping[int, Any]:
    """Every connected group of photos that could be reconstructed."""
    options = colmap.IncrementalPipelineOptions(num_threads=threads)
    done = count(3)  # the first two come together
    return dict(
        colmap.incremental_mapping(
            database,
            photos,
            out,
            options=options,
            next_image_callback=lambda: progress("poses", min(next(done), total), total),
        )
    )


def _require_same_photos(colmap: Any, database: Path, names: Sequence[str]) -> None:
    """Raise InputError if the database is damaged or holds other photos."""
    if not database.exists():
        return
    try:
        with closing(colmap.Database.open(database)) as opened:
            known = {image.name for image in opened.read_all_images()}
    except RuntimeError:
        raise InputError(
            f"{short_name(database)}: expected COLMAP's database, got a damaged file; remove it"
        ) from None
    gone = sorted(known - set(names))
    if gone:
        raise InputError(
            f"{short_name(database)}: it holds photos that no longer exist, "
            f"such as {gone[0][:60]}; write to "
            "another folder, or remove this file to begin again"
        )


def _features(colmap: Any, database: Path) -> list[int]:
    """Number of features of each photo.

    By pycolmap, not sqlite3: a second SQLite library in one process would drop the file's locks.
    """
    with closing(colmap.Database.open(database)) as opened:
        return [
            opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()
        ]


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError:
        raise InputError(
            "pycolmap: expected this library for poses from photos, it is not installed; "
            "pip install 'falconwing-kit[capture]', or make a COLMAP model or a transforms.json "
            "elsewhere and give that"
        ) from None
    return pycolmap
