"""A teacher's desk: a class on three platforms from release to the course's result; nobody is lost.

51 students here, each kind of hand-in on each platform; 200 in bench_desk.py.
"""

import csv
import json
import re
import zipfile
from collections import Counter
from contextlib import chdir, redirect_stdout
from io import StringIO

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli import grade as grading
from falconwing_kit.tools.cli.labs import Gradebook
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.grading.course.course_gradebook import course_results
from falconwing_kit.tools.grading.judge import STATES
from falconwing_kit.tools.grading.rules import CourseRules, LabRules
from tests.tools.grading import desk_class, toys

EXPORTS = " ".join(f"{name}.zip" for name in desk_class.PLATFORMS)
COURSE = "--course course --labs labs --json"
COMMANDS = (  # at most five a lab; the first is the whole course's
    f"labs release handed_out {COURSE}",
    f"grade lab01 {EXPORTS} worksheet.csv --out grades {COURSE}",
    f"report lab01 grades --out report {COURSE}",
    f"report lab01 grades --out report {COURSE} --rubric points.csv --to moodle canvas",
    "labs gradebook result report --course course --json",
)


def run_desk(folder, size):
    """What every command printed, and the expected state of each student."""
    folder.chmod(0o755)
    (folder / "labs").mkdir()
    desk_class.write_labs(folder / "labs")
    expected = desk_class.write_class(folder, size)
    rows = "".join(f"{who},10,5,\n" for who in expected)  # as the rubric page saves them
    (folder / "points.csv").write_text(f"student,line,q1,comment\n{rows}")
    shown = []
    with chdir(folder):
        for command in COMMANDS:
            with redirect_stdout(StringIO()) as said:
                assert main(command.split()) == 0, said.getvalue()
            shown.append(json.loads(said.getvalue()))
    return shown, expected


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """Folder, output and expected states; the sandbox's probe has tests of its own."""
    folder = tmp_path_factory.mktemp("desk")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grading, "_require_sandbox", lambda: None)
        yield folder, *run_desk(folder, 51)


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as handle:
        return list(csv.DictReader(handle))


def require_nobody_lost(folder, shown, expected):
    """Counts by hand from KINDS, in what is printed and in every table."""
    counts = Counter(expected.values())
    graded = shown[1]
    assert {state: graded[state] for state in STATES} == {state: counts[state] for state in STATES}
    assert sum(graded[state] for state in STATES) == graded["roster"] == len(expected)
    assert graded["strangers"] == 0 and list(graded["passed_over"]) == []
    totals = json.loads((folder / "report" / "totals.json").read_text())["students"]
    assert {who: each["state"] for who, each in totals.items()} == expected
    assert {row["student"] for row in rows_of(folder / "report" / "gradebook.csv")} == set(expected)
    course = {row["student"]: row for row in rows_of(folder / "result" / "course.csv")}
    assert {who: row["lab01 state"] for who, row in course.items()} == expected
    assert shown[4]["students"] == len(expected)


@toys.needs_sandbox
def test_nobody_is_lost_and_the_counts_add_up(desk):
    """Each of seventeen kinds of hand-in on each of three platforms."""
    require_nobody_lost(*desk)
    assert len(COMMANDS) <= 5


@toys.needs_sandbox
def test_points_and_lateness_are_those_of_the_kinds(desk):
    """By hand: 75 for the function, 15 by a person; 10 % off for a second day late.

    Canvas's and Moodle's late days are unknown and count as one, which is free.
    """
    folder, _, expected = desk
    course = {row["student"]: row for row in rows_of(folder / "result" / "course.csv")}
    found = {}
    for number, (who, state) in enumerate(expected.items()):
        found.setdefault((state, desk_class.PLATFORMS[number % 3]), set()).add(
            (course[who]["lab01 days late"], course[who]["lab01 [%]"])
        )
    for platform in desk_class.PLATFORMS:
        assert found["graded", platform] == {("0", "90.0")}
        assert found["missing", platform] == {("0", "0.0")}
        assert found["unreadable", platform] == found["wrong lab", platform] == {("0", "15.0")}
    assert found["late", "moodle"] == found["late", "canvas"] == {("1", "90.0")}
    assert found["late", "gradescope"] == {("2", "81.0")}


@toys.needs_sandbox
def test_what_was_handed_in_is_said(desk):
    """Each that is not graded has a sentence, and a notebook of another course too."""
    folder, _, expected = desk
    notes = {row["student"]: row["note"] for row in rows_of(folder / "report" / "gradebook.csv")}
    assert all(notes[who] for who, state in expected.items() if state not in ("graded", "late"))
    text = " ".join(notes.values())
    for said in (
        "onlinetext.html",
        "answer.docx",
        "an empty zip",
        "a zip in a zip in a zip",
        "not called .ipynb",
        "a notebook of lab02",
        "another course",
        "an empty file",
        "nothing handed in",
        "one of 2 notebooks",
    ):
        assert said in text


@toys.needs_sandbox
def test_platforms_get_back_what_they_gave(desk):
    """Moodle's folders have the names of its export, its worksheet the numbers; Canvas's rows its
    own numbers and the assignment's column.
    """
    folder, _, expected = desk
    with zipfile.ZipFile(folder / "moodle.zip") as given:
        names = {name.split("/")[0] for name in given.namelist()}
    with zipfile.ZipFile(folder / "report" / "moodle_feedback.zip") as back:
        assert {name.split("/")[0] for name in back.namelist()} == names
        assert all(b"<html" in back.read(name) for name in back.namelist())
    numbers = {re.search(r"_(\d+)_assign", name)[1] for name in names}
    sheet = rows_of(folder / "report" / "moodle.csv")
    assert {row["Identifier"] for row in sheet} == {f"Participant {each}" for each in numbers}
    canvas = rows_of(folder / "report" / "canvas.csv")
    roster = {row["canvas"]: row["student"] for row in rows_of(folder / "course" / "roster.csv")}
    assert {roster[row["ID"]] for row in canvas} == set(expected)
    points = {roster[row["ID"]]: float(row["Lab 1 (17)"]) for row in canvas}
    assert {points[who] for who, state in expected.items() if state == "graded"} == {90.0}


@toys.needs_sandbox
def test_a_later_export_adds_and_loses_nobody(desk, monkeypatch):
    """Two without a hand-in send one later, a notebook and a print: --resume; the others stay."""
    folder, _, expected = desk
    monkeypatch.setattr(grading, "_require_sandbox", lambda: None)
    missing = [who for who, state in expected.items() if state == "missing"]
    late = folder / "late"
    late.mkdir()
    (late / f"{missing[0]}.ipynb").write_bytes(desk_class.NOTEBOOK)
    (late / f"{missing[1]}.pdf").write_bytes(b"%PDF-1.7")
    (late / "readme.txt").write_text("from the mail")
    with chdir(folder), redirect_stdout(StringIO()) as said:
        assert main(f"grade lab01 late --out grades {COURSE} --resume".split()) == 0
    shown = json.loads(said.getvalue())
    counts = Counter(expected.values())
    assert shown["missing"] == counts["missing"] - 2
    assert shown["graded"] == counts["graded"] + 1
    assert shown["unreadable"] == counts["unreadable"] + 1
    assert sum(shown[state] for state in STATES) == len(expected)
    assert shown["passed_over"] == ["readme.txt"]


def totals(percent, late=0, state="graded"):
    """A student's totals in a lab."""
    return {"state": state, "total": percent, "of": 100.0, "late": late > 0, "late_days": late}


def test_the_course_counts_the_best_labs_by_weight():
    """By hand. Free days go to the earliest: lab01 uses two of three, lab02 one of its two, so
    lab02 loses 10 % of 80: 72. Dropped is the lab without which the mean is best:
    without lab01 (2 x 72 + 100) / 3 = 81.3, lab02 (60 + 100) / 2 = 80, lab03 (60 + 144) / 3 = 68.
    """
    labs = {
        "lab01": {"ada": totals(60.0, 2)},
        "lab02": {"ada": totals(80.0, 2)},
        "lab03": {"ada": totals(100.0)},
    }
    rules = CourseRules(3, 10.0, 1, {"lab02": LabRules(weight=2.0)})
    (ada,) = course_results(labs, rules, ["ada"])
    assert ada.labs["lab02"].counted == pytest.approx(72.0, rel=1e-12)
    assert [name for name, each in ada.labs.items() if each.dropped] == ["lab01"]
    assert ada.percent == pytest.approx(244.0 / 3.0, rel=1e-12)


def test_no_result_before_every_lab_is_final():
    """A lab that a person must grade, or without a record: nothing is dropped, nothing is 0."""
    labs = {"lab01": {"ada": totals(60.0)}, "lab02": {"ada": totals(None), "bob": totals(5.0)}}
    for each in course_results(labs, CourseRules(drop_lowest=1), ["ada", "bob"]):
        assert each.percent is None and not any(lab.dropped for lab in each.labs.values())
    assert course_results(labs, CourseRules(), ["bob"])[0].labs["lab01"].state == "no record"


def test_gradebook_without_reports_is_refused(tmp_path):
    """A folder of another kind, and none."""
    with pytest.raises(InputError, match=r"found no totals\.json"):
        Gradebook(tmp_path / "out", (tmp_path,)).run()
    (tmp_path / "totals.json").write_text('{"lab": "lab01", "students": {"ada": 5}}')
    with pytest.raises(InputError, match=r"found no totals\.json"):
        Gradebook(tmp_path / "out", (tmp_path,)).run()
    with pytest.raises(InputError, match="expected one of each lab, got none"):
        Gradebook(tmp_path / "out", ()).run()
