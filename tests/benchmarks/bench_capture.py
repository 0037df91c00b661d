"""The path-traced hall, all 240 photos: from files to an aligned reconstruction, judged by the
tape.

`pytest -m benchmark -s tests/benchmarks/bench_capture.py` reads the hall's data from
../shared/data/hall. The first run takes about eight minutes of one core; features and matches then
stay in pytest's cache folder.
"""

import time
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.tools.capture.poses import photos_to_poses
from falconwing_kit.tools.capture.survey.points import read_survey
from falconwing_kit.tools.capture.survey.recipe import align_photos, check_points

HALL = Path(__file__).resolve().parents[3] / "shared" / "data" / "hall"
pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]


def test_hall_is_reconstructed_and_aligned(pytestconfig):
    """The plan's figures: 95 %, 0.8 px; marker alone within 0.3 m of the tape, with the pad within
    0.1 m.

    Check corners are those of posters and windows, up to 24 m from the marker. They are
    triangulated from where the finder sees them, which has its own error: some 2 cm on posters, and
    5 cm on windows, whose bright panes lie deeper in the wall than the frames that were measured.
    """
    start = time.process_time()
    found = photos_to_poses(HALL / "photos", pytestconfig.cache.mkdir("hall_poses"))
    mapped = time.process_time()
    survey = read_survey(HALL / "survey.csv")
    made = align_photos(found, survey)
    aligned = time.process_time()
    check, seen = survey.select("check"), check_points(made.best, found, survey)
    corners, tape = np.array(list(seen.values())), check.places(seen)
    miss = {}
    for recipe, alignment in (
        ("baseline", made.baseline),
        ("marker", made.marker),
        ("with pad", made.best),
    ):
        miss[recipe] = np.linalg.norm(alignment.points(corners) - tape, axis=1)
        sigma = np.median(alignment.sigma(tape))
        mean, worst = miss[recipe].mean(), miss[recipe].max()
        print(f"\n{recipe}: mean {mean:.3f} m, worst {worst:.3f} m, stated {sigma:.3f} m", end="")
    print(f"\n{len(seen)} of {len(check.names)} check corners; {dict(found.report)}")
    print(f"poses {mapped - start:.0f} s, alignment {aligned - mapped:.0f} s of one core")
    assert (
        found.report["registered"] >= 0.95 * found.report["total"]
        and found.report["reprojection_px"] <= 0.8
    )
    assert len(seen) >= 0.75 * len(check.names)
    assert miss["marker"].max() <= 0.3 and miss["with pad"].max() <= 0.1
    assert miss["baseline"].mean() > 1.0  # the recipe that fails, shown beside the others
