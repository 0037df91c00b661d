"""The shipped hall and its pose network on the 25 photos that neither has learnt from.

    python -m pytest -m benchmark -s tests/benchmarks/bench_hall_photos.py

Wants the path-traced hall's photos in ../shared/data/hall/photos. Their poses are in
tests/data/hall_poses: found by structure from motion, aligned by tape, and then corrected by a
training on the 205 others; those of the 25 are where its finished scene looks most like them.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.learning.pose_net_figures import error_figures, evaluate_poses
from falconwing_kit.tools.capture.fit import FitSettings, evaluate_scene
from falconwing_kit.tools.capture.photo_files import read_reconstruction
from falconwing_kit.tools.capture.training.photos import (
    held_out_photos,
    load_photos,
    read_photo_names,
)
from falconwing_kit.vision import PoseNet

ROOT = Path(__file__).resolve().parents[2]
POSES, PHOTOS = (
    ROOT / "tests" / "data" / "hall_poses",
    ROOT.parent / "shared" / "data" / "hall" / "photos",
)
pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.timeout(1200),
    pytest.mark.skipif(not PHOTOS.is_dir(), reason=f"the hall's photos are not at {PHOTOS}"),
]


def test_the_hall_looks_like_photos_of_places_it_has_not_seen() -> None:
    """Wanted: 28 dB in the mean, 24 dB for the worst, SSIM 0.84."""
    settings = FitSettings(judge_by=read_photo_names(POSES / "held_out.txt"))
    found = evaluate_scene(
        ROOT / "falconwing_kit" / "data" / "hall.npz",
        read_reconstruction(POSES),
        settings,
        folder=PHOTOS,
    )
    print("\n\n| photo | PSNR dB | SSIM |\n|---|---|---|")
    for row in sorted(found["photos"], key=lambda row: row["psnr_db"]):
        print(f"| {row['photo']} | {row['psnr_db']:.2f} | {row['ssim']:.3f} |")
    print(f"| mean | {found['psnr_db']:.2f} | {found['ssim']:.3f} |")
    assert len(found["photos"]) == 25
    assert found["psnr_db"] >= 28.0 and found["psnr_worst_db"] >= 24.0 and found["ssim"] >= 0.84


def test_the_pose_net_places_them() -> None:
    """Wanted: the paper's mean figures, 0.42 m and 2.4 deg of yaw, as medians."""
    source = replace(read_reconstruction(POSES), folder=PHOTOS)
    settings = FitSettings(judge_by=read_photo_names(POSES / "held_out.txt"))
    rows = np.flatnonzero(held_out_photos(source.names, source.T_world_camera[:, :3, 3], settings))
    photos = load_photos(source).chosen(rows)
    found = error_figures(
        evaluate_poses(
            PoseNet.load("hall"), photos.images.numpy(), photos.camera, source.T_world_camera[rows]
        )
    )
    for name, value in found.items():
        print(f"\n{name}: {value}", end="")
    assert found["position_m"]["median"] <= 0.42 and found["yaw_deg"]["median"] <= 2.4
