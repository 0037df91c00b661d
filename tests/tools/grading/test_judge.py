"""Judge: correct answers count, wrong ones have a category, the judge's errors do not count."""

import json
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.tools.grading import judge
from falconwing_kit.tools.grading.find import lab_folders, load_checks
from falconwing_kit.tools.grading.judge import (
    Assignment,
    GradingTask,
    JudgeError,
    evaluate_cases,
    grade_submission,
)
from falconwing_kit.tools.grading.lab import Trials, Values
from falconwing_kit.tools.grading.salt import course_mark
from falconwing_kit.tools.grading.sandbox.host import StudentError
from falconwing_kit.tools.grading.submissions import Submission, find_submissions
from tests.tools.grading import toys
from tests.tools.grading.small_lab import write_small_lab

DOUBLE = Values(lambda rng: (rng.normal(size=3),), lambda x: 2.0 * x, cases=3)


def ways(function, *judges):
    return evaluate_cases(function, judges or (DOUBLE,), np.random.default_rng(0))


def silent(*_):
    raise StudentError("timeout")


@pytest.mark.parametrize(
    ("function", "way"),
    [
        (lambda x: 2.0 * x, "right"),
        (lambda x: x + x + 1e-12, "right"),
        (lambda x: -2.0 * x, "wrong value"),
        (lambda x: 2.0 * x + np.nan, "wrong value"),
        (lambda x: 2.0 * x[:2], "wrong shape"),
        (lambda x: (2.0 * x,), "wrong shape"),
        (lambda x: "SECRET", "wrong shape"),
        (lambda x: None, "wrong shape"),
        (silent, "timeout"),
    ],
)
def test_every_case_says_how_it_failed(function, way):
    """By hand, three cases each."""
    assert ways(function) == [way] * 3


def test_trials_pass_or_fail():
    """Two of four streams draw above a half with this seed or not.

    The answer of a text breaks our own arithmetic.
    """
    trials = Trials(lambda f, rng: bool(f(1.0) + 1.0 == 3.0), trials=2)
    assert ways(lambda x: 2.0 * x, trials) == ["right"] * 2
    assert ways(lambda x: 3.0 * x, trials) == ["trial failed"] * 2
    assert ways(lambda x: "text", trials) == ["bad answer"] * 2


def test_truth_that_is_not_true_is_not_right():
    """A plant of ours must say True; an array of ones is no verdict."""
    assert ways(lambda x: x, Trials(lambda f, rng: np.ones(3), trials=1)) == ["trial failed"]


def test_question_can_not_be_changed_by_the_answerer():
    """The right answer is found before the function gets its arguments."""

    def clears(x):
        x[:] = 0.0
        return x

    assert ways(clears) == ["wrong value"] * 3


@pytest.mark.parametrize("broken", ["draw", "reference"])
def test_judges_own_failure_is_no_students_mistake(broken):
    """A division by zero of ours must not cost anyone points."""
    with pytest.raises(JudgeError, match="ZeroDivisionError"):
        ways(lambda x: x, replace(DOUBLE, **{broken: lambda *_: 1 / 0}))


@pytest.fixture
def handed_in(tmp_path):
    """Grades a notebook of cells in plain processes."""

    def grade(*cells, seed="", secret="s", name="ada.ipynb", data=None, salt="", **more):
        content = toys.notebook_bytes(*cells, **more) if data is None else data
        (tmp_path / name).write_bytes(content)
        (submission,) = find_submissions(tmp_path / name, "lab00")
        return grade_submission(
            GradingTask(submission, seed), Assignment(toys.LAB, salt, secret, sandboxed=False)
        )

    return grade


def test_points_are_shares_of_cases(handed_in):
    """stretch is wrong for gains above 1.5, some of this seed's four cases.

    Brake is correct: 25 points.
    """
    half = "def stretch(x, gain):\n    return gain * x + COHORT['offset'] * (gain < 1.5)"
    record = handed_in(toys.HEAD, half, toys.BRAKE, seed="2")
    stretch = record["exercises"]["stretch"]
    assert 0 < stretch["right"] < stretch["cases"] == 4
    assert stretch["points"] == 50.0 * stretch["right"] / 4
    assert stretch["categories"] == {"wrong value": 4 - stretch["right"]}
    assert record["points"] == stretch["points"] + 25.0
    assert (record["of"], record["status"], record["sandboxed"]) == (75.0, "graded", False)


def test_same_seed_gives_the_same_record_and_another_other_cases(handed_in):
    """Bit-identical, as a regrade must be; 20 seeds of a threshold in the middle differ."""
    half = "def stretch(x, gain):\n    return gain * x + COHORT['offset'] * (gain < 1.5)"
    first = handed_in(toys.HEAD, half, seed="1")
    assert json.dumps(handed_in(toys.HEAD, half, seed="1")) == json.dumps(first)
    assert len({handed_in(toys.HEAD, half, seed=str(n))["points"] for n in range(6)}) > 1


def test_seed_follows_from_secret_student_and_notebook(handed_in):
    """A student who hands in the same file under another name gets other cases.

    Nobody can know them beforehand.
    """
    seeds = {
        handed_in(toys.BRAKE)["seed"],
        handed_in(toys.BRAKE, secret="t")["seed"],
        handed_in(toys.BRAKE, name="bob.ipynb")["seed"],
        handed_in(toys.BRAKE, "1")["seed"],
    }
    assert len(seeds) == 4
    assert handed_in(toys.BRAKE)["seed"] in seeds


def test_untouched_and_missing_functions_have_no_points(handed_in):
    """The stub says so itself; a missing function too, for every case."""
    record = handed_in(
        toys.HEAD, "def stretch(x, gain):\n    raise NotImplementedError('write stretch')"
    )
    assert record["points"] == 0.0
    assert record["exercises"]["stretch"]["categories"] == {"not written": 4}
    assert record["exercises"]["brake"]["categories"] == {"missing": 3}
    assert record["exercises"]["brake"]["problems"] == ["no code cell defines brake"]


def test_unreadable_notebook_is_recorded(handed_in):
    """No points, the reason, and the file's fingerprint."""
    record = handed_in(data=b"{")
    assert (record["status"], record["points"], len(record["sha256"])) == ("unreadable", 0.0, 64)
    assert "expected a Jupyter notebook" in record["problem"]


def test_notebook_of_an_older_kit_is_recorded_in_one_sentence(tmp_path):
    """Lab 4's own solution has all points.

    As 0.1 built it, without a version, it has none and the reason is said.
    """
    folder = Path(__file__).parents[3] / "labs" / "lab04_aircraft"
    new = (folder / "solution" / "lab04.ipynb").read_text()
    old = json.loads(re.sub(r"\*Notebook of falconwing-kit [0-9.]+\*", "", new)) | {"metadata": {}}
    records = []
    for text in (new, json.dumps(old)):
        (tmp_path / "lab04.ipynb").write_text(text)
        (submission,) = find_submissions(tmp_path / "lab04.ipynb", "lab04")
        records.append(
            grade_submission(
                GradingTask(submission, "1"), Assignment(folder, "", "s", sandboxed=False)
            )
        )
    assert [(each["status"], each["points"]) for each in records] == [
        ("graded", 75.0),
        ("unreadable", 0.0),
    ]
    assert records[1]["problem"] == (
        "lab04.ipynb: expected a notebook of falconwing-kit 0.2, got one of 0.1: "
        "download the new notebook and copy your answers over"
    )


def test_work_and_assignment_can_be_sent():
    """What a cluster needs: all of it can be pickled, and comes back equal."""
    work = (
        GradingTask(Submission("ada", toys.LAB / "x.ipynb", ("a.ipynb",), (1.0,))),
        Assignment(toys.LAB, "s", "t"),
    )
    assert pickle.loads(pickle.dumps(work)) == work
    assert pickle.loads(pickle.dumps(grade_submission)) is grade_submission


def test_toy_lab_sums_to_its_points():
    """75 for the machine, as in every lab."""
    assert sum(exercise.points for exercise in load_checks(toys.LAB).exercises) == 75.0


def test_notebook_of_another_lab_is_said(handed_in, monkeypatch, tmp_path):
    """By its functions: lab01's small lab beside the toy lab; without any, only that they are not
    there. One whose functions were deleted is this lab's still, by the marks of its cells.
    """
    write_small_lab(tmp_path)
    monkeypatch.setattr(judge, "lab_folders", lambda _: lab_folders(tmp_path))
    other = handed_in("def weight(mass): return mass")
    assert (other["status"], other["points"]) == ("wrong lab", 0.0)
    assert other["problem"] == "a notebook of lab01, not of lab00; ask for the notebook of lab00"
    assert "none of its functions" in handed_in("x = 1")["problem"]
    assert handed_in(toys.cell("1", figure="figure"))["status"] == "graded"


def test_notebook_of_another_course_is_said(handed_in):
    """The mark comes with what is handed out; the open course has none."""
    ours = course_mark("key of ours")
    for mark, salt, said in ((ours, "key of ours", ""), (ours, "another", "another course")):
        metadata = {"falconwing_course": mark}
        record = handed_in(toys.STRETCH, salt=salt, metadata=metadata)
        assert record["status"] == "graded" and said in record["problem"]
        assert bool(record["problem"]) == bool(said)
