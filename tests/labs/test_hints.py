"""Hints of the labs: a wrong function -> the mistake's name, expected beside got."""

import json

import numpy as np
import pytest

from falconwing_kit.tools.grading.find import lab_folders
from falconwing_kit.tools.grading.hints import Recorder, hints_text, load_hints
from falconwing_kit.tools.grading.public_checks import check_notebook, report_lines, run_checks
from falconwing_kit.tools.grading.release import release
from tests.labs.functions import ROOT, LabHere
from tests.labs.holdout.generate import frozen
from tests.labs.judged_hints import judge_lab

FOLDERS = lab_folders(ROOT / "labs")
LABS = {folder.name.split("_")[0]: folder for folder in FOLDERS}


def lines_for(lab: str, name: str, old: str, new: str) -> str:
    """What a student reads whose function is the solution with `old` replaced by `new`."""
    here, hints = LabHere(LABS[lab]), load_hints(LABS[lab])[name]
    outcomes = run_checks(here.lab.exercise(name), here.function(name, old, new), hints)
    return "\n".join(report_lines(name, outcomes))


@pytest.mark.parametrize(
    ("lab", "name", "old", "new", "cause"),
    [
        ("lab03", "alpha_composite", " + left[:, -1:] * background", "", "no background"),
        ("lab03", "project_gaussians", "J[:, 0, 0] = -lens", "J[:, 0, 0] = lens", "u by x"),
        ("lab06", "marker_pose", "U @ Vt,", "U @ Vt.T,", "V of the SVD"),
    ],
)
def test_mistake_is_named_and_the_usual_hint_is_silent(lab, name, old, new, cause):
    """A reader's own mistakes of 22 November, which the fixed hints took for others."""
    text = lines_for(lab, name, old, new)
    assert cause in text and "expected " in text
    assert "the first splat gets all light" not in text and "marker_square" not in text


def test_degrees_for_radians_are_named_without_a_list():
    """By hand: an angle in degrees is 180 / pi times the same in radians."""
    text = lines_for("lab04", "air_data", "np.arctan2(w, u)", "np.degrees(np.arctan2(w, u))")
    assert "degrees" in text


def test_right_function_and_unlike_mistake_are_called_nothing():
    """The solution has no diagnosis; random answers agree with no mistake."""
    here, hints = LabHere(LABS["lab01"]), load_hints(LABS["lab01"])["min_speed"]
    for function, silent in (
        (here.function("min_speed"), True),
        (lambda m, t: np.asarray(m) * 0.0 + 17.3 + np.sqrt(np.asarray(m)) * t, True),
    ):
        recorder = Recorder(function)
        run_checks(here.lab.exercise("min_speed"), recorder)
        assert (hints.diagnose(recorder.calls).cause == "") is silent


def test_complex_answer_is_called_complex():
    """By hand: a power 0.5 of a negative number is complex in Python."""
    here, hints = LabHere(LABS["lab01"]), load_hints(LABS["lab01"])["min_speed"]
    exercise = here.lab.exercise("min_speed")
    outcomes = run_checks(exercise, lambda m, t: (-np.asarray(m) + 0j) ** 0.5, hints)
    assert "complex" in "\n".join(report_lines("min_speed", outcomes))


def test_syntax_error_stands_under_its_function_alone(tmp_path):
    """The cell's own line, under the function that it was to define."""
    notebook = json.loads((LABS["lab01"] / "solution" / "lab01.ipynb").read_text("utf-8"))
    for cell in notebook["cells"]:
        if cell["metadata"].get("exercise") == "max_mass_for_room":
            cell["source"] = ["def max_mass_for_room(width, bank_deg, lift_per_speed2)\n", "    x"]
    path = tmp_path / "lab01.ipynb"
    path.write_text(json.dumps(notebook), encoding="utf-8")
    reports = {each.name: each for each in check_notebook(LABS["lab01"], path)}
    wrong = reports.pop("max_mass_for_room")
    assert "line 1" in wrong.outcomes[0].said and wrong.outcomes[0].state == "failed"
    assert not any("not Python" in words for each in reports.values() for words in each.problems)
    assert {each.state for report in reports.values() for each in report.outcomes} == {"passed"}


def test_stored_hints_are_what_the_lists_give():
    """Lab 1's file is written anew; its numbers agree (mend: `falconwing labs hints`)."""
    stored = json.loads((LABS["lab01"] / "hints.json").read_text("utf-8"))
    assert json.loads(hints_text(LABS["lab01"])) == stored


def test_released_hints_are_of_the_course_and_hold_no_code(tmp_path):
    """With a salt the constants differ, so do the stored answers; no solution is in it."""
    release([LABS["lab01"]], tmp_path / "out", "a salt of the course")
    released = tmp_path / "out" / "lab01_sizing"
    assert load_hints(released)["level_turn"].expected
    stored = load_hints(LABS["lab01"])["level_turn"].expected
    assert load_hints(released)["level_turn"].expected != stored
    assert "np." not in (released / "hints.json").read_text("utf-8")


def test_the_frozen_list_is_as_the_issue_asks():
    """At least 500, half of them not of a single token, three or more an exercise."""
    kinds = [row["kind"] for row in frozen()]
    single = {"sign of a term", "comparison", "axis", "constant", "other function"}
    assert len(kinds) >= 500 and sum(kind in single for kind in kinds) <= len(kinds) / 2


@pytest.mark.parametrize("lab", ["lab01", "lab04"])
def test_few_wrong_causes_in_a_sample_of_the_frozen_list(lab):
    """At most 3 % wrong, and some right; all labs are in tests/benchmarks/bench_hints.py."""
    found = judge_lab(LABS[lab])
    verdicts = [verdict for verdict, _, _ in found]
    assert verdicts.count("wrong") <= 0.03 * len(found)
    assert verdicts.count("right") >= 3
