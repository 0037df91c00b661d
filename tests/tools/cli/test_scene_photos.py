"""`scene poses` and `scene align`: what they write, print and refuse, on 24 photos of the
path-traced hall.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.capture.align import Alignment
from falconwing_kit.tools.capture.photo_files import read_reconstruction, write_reconstruction
from falconwing_kit.tools.capture.survey.points import PointObservations, Survey
from falconwing_kit.tools.capture.survey.recipe import Alignments
from falconwing_kit.tools.cli.scene_photos import Align, Poses, check_record, is_good
from tests.scene import hall24


@pytest.fixture
def raw(tmp_path):
    """A folder with poses that are not aligned."""
    write_reconstruction(tmp_path / "raw", hall24.reconstruction())
    return tmp_path / "raw"


def test_poses_made_elsewhere_are_taken_and_straightened(raw, tmp_path, capsys):
    """The same poses, with undistorted photos and no k1; 0 since all photos have a pose."""
    assert Poses(raw, tmp_path / "out", straighten=True, json=True).run() == 0
    record = json.loads(capsys.readouterr().out)
    found = read_reconstruction(tmp_path / "out")
    assert record["registered"] == len(found) == 24 and found.k1 == 0.0
    assert found.path(0).is_file() and found.folder == tmp_path / "out" / "straight"
    assert np.allclose(found.T_world_camera, hall24.reconstruction().T_world_camera)


def test_missing_photos_are_said(raw, tmp_path):
    """Poses without photos are of no use."""
    write_reconstruction(raw, replace(hall24.reconstruction(), folder=tmp_path / "gone"))
    with pytest.raises(InputError, match="--images FOLDER"):
        Poses(raw, tmp_path / "out").run()
    assert not (tmp_path / "out").exists()


def test_aligned_poses_are_written_with_picture_and_figures(raw, tmp_path, capsys):
    """Recipes from bad to good: the one with all points is the surest, the baseline's uncertainty
    is not known.
    """
    out = tmp_path / "aligned"
    assert Align(raw, hall24.FOLDER / "survey.csv", out, json=True).run() == 0
    record = json.loads(capsys.readouterr().out)
    baseline, marker, best = record["recipes"].values()
    assert baseline["sigma_max_m"] is None and best["sigma_max_m"] < 0.5 * marker["sigma_max_m"]
    assert best["from_best_max_m"] == 0.0 < marker["from_best_max_m"]
    assert record["not_seen"] == [] and (out / "alignment.png").stat().st_size > 10000
    by_baseline, _, by_best = record["check"]["recipes"].values()
    assert (
        by_best["mean_m"] < 0.2 < 0.5 < by_baseline["mean_m"]
    )  # by the tape: nothing was fitted to these corners
    assert len(record["check"]["points_m"]) + len(record["check"]["not_seen"]) == 28
    assert read_reconstruction(out).aligned
    with pytest.raises(InputError, match="not aligned yet"):
        Align(out, hall24.FOLDER / "survey.csv", tmp_path / "again").run()
    with pytest.raises(InputError, match="another folder"):
        Align(raw, hall24.FOLDER / "survey.csv", raw).run()


def test_check_points_are_held_against_the_tape():
    """By hand: twice the size and 1 m along x bring (1, 1, 1) to (3, 2, 2), 0.5 m above where the
    tape had it.
    """
    best = Alignment(2.0, np.eye(3), np.array([1.0, 0.0, 0.0]), "by hand", np.zeros((7, 7)))
    names = ("poster_top_left", "poster_top_right")
    survey = Survey(names, np.array([[3.0, 2.0, 1.5], [0.0, 0.0, 0.0]]), ("check", "check"))
    found = Alignments(None, None, best, PointObservations.join([]))
    record = check_record(found, {"poster_top_left": np.array([1.0, 1.0, 1.0])}, survey)
    assert record["recipes"] == {"all surveyed points": {"mean_m": 0.5, "worst_m": 0.5}}
    assert record["points_m"] == {"poster_top_left": 0.5} and record["not_seen"] == [
        "poster_top_right"
    ]
    assert check_record(found, {}, survey)["recipes"] == {}


def test_tables_tell_the_same(raw, tmp_path, capsys):
    """Words for people: a table and what to type next."""
    assert Poses(raw, tmp_path / "out").run() == 0
    assert Align(tmp_path / "out", hall24.FOLDER / "survey.csv", tmp_path / "aligned").run() == 0
    printed = capsys.readouterr().out
    assert "photos with a pose" in printed and "next: falconwing scene align" in printed
    assert "check points, distance from the survey" in printed
    assert "pad_far_left_top" in printed and "next: falconwing scene fit" in printed


def test_answer_is_no_for_bad_poses():
    """By hand: 22 of 24 is 92 %, and 0.9 px is above 0.8."""
    good = {"registered": 23, "total": 24, "reprojection_px": 0.6}
    assert (
        is_good(good)
        and not is_good(good | {"registered": 22})
        and not is_good(good | {"reprojection_px": 0.9})
    )
