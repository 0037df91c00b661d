"""Write the data of lab 6: poses of the photos by structure from motion, and marker corners.

    python labs/lab06_pose/make_data.py HALL [POSES]

HALL holds `photos/` and `survey.csv`, as tests/data/hall24 does; what ships was made from the 240
photos of which those 24 are a part. POSES is what `falconwing scene poses` made of them, not
aligned; left out, it is made now, which needs pycolmap and some minutes.
"""

import csv
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from falconwing_kit.core import atomic_write
from falconwing_kit.tools.capture import (
    MARKER_CORNERS,
    align_photos,
    observe_marker,
    photos_to_poses,
    read_photo,
    read_reconstruction,
    read_survey,
)

DATA = Path(__file__).parent / "data"
CROP = (80, 60)  # half width and half height of the two pictures [px]


def main(hall: Path, poses: Path | None) -> None:
    """Write cameras.csv, sightings.csv and crops.npz, and say how sure the reference is."""
    with tempfile.TemporaryDirectory() as folder:
        made = (
            photos_to_poses(hall / "photos", Path(folder))
            if poses is None
            else read_reconstruction(poses)
        )
    photos = replace(made, folder=hall / "photos")
    survey = read_survey(hall / "survey.csv")
    reference = align_photos(photos, survey).best
    places = photos.T_world_camera[:, :3, 3]
    p_world = reference.points(places)
    print(
        f"lens: {photos.camera.K.tolist()}, k1 = {photos.k1:.4f}, {reference.scale:.4f} m per unit"
    )
    sigma = reference.sigma(p_world)
    print(f"reference: sigma {np.median(sigma):.3f} m (median), {sigma.max():.3f} m (maximum)")
    rows = [
        [name, *np.round(place, 6), *np.round(T[:3, :3].ravel(), 6), *np.round(p, 3)]
        for name, place, T, p in zip(
            photos.names, places, photos.T_world_camera, p_world, strict=True
        )
    ]
    axes = [f"r{i}{j}" for i in "xyz" for j in "xyz"]
    write("cameras.csv", ["photo", "x_sfm", "y_sfm", "z_sfm", *axes, "x", "y", "z"], rows)

    observations = observe_marker(photos)
    corners = [
        dict(zip(*(values.tolist() for values in observations.of(name)), strict=True))
        for name in MARKER_CORNERS
    ]
    shown = sorted(set.intersection(*(set(each) for each in corners)))
    rows = [[photos.names[k], *np.round(np.ravel([each[k] for each in corners]), 3)] for k in shown]
    write("sightings.csv", ["photo", *(f"{axis}{n}" for n in range(1, 5) for axis in "uv")], rows)

    by_distance = sorted(
        shown,
        key=lambda k: float(
            np.linalg.norm(p_world[k] - survey.places(MARKER_CORNERS).mean(axis=0))
        ),
    )
    crops = {}
    for name, k in (("near", by_distance[0]), ("far", by_distance[-1])):
        u, v = np.mean([each[k] for each in corners], axis=0).astype(int)
        u, v = np.clip(u, CROP[0], 640 - CROP[0]), np.clip(v, CROP[1], 480 - CROP[1])
        crops[name] = read_photo(photos.path(k))[
            v - CROP[1] : v + CROP[1], u - CROP[0] : u + CROP[0]
        ]
    with atomic_write(DATA / "crops.npz") as file:
        np.savez_compressed(file, **crops)


def write(name: str, header: list[str], rows: list[list[object]]) -> None:
    """Write a table whole or not at all."""
    with atomic_write(DATA / name, text=True) as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(header)
        table.writerows(rows)


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 3:
        sys.exit(
            "usage: python labs/lab06_pose/make_data.py HALL [POSES]; "
            "HALL holds photos/ and survey.csv"
        )
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) == 3 else None)
