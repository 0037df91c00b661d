"""Gradebook: sums, manual points merged, totals only when final, no cell read as a formula."""

import csv

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.course.gradebook import (
    ManualGrade,
    gradescope_results,
    make_entries,
    read_rubric,
    write_gradebook,
    write_platform_csv,
)
from tests.tools.grading.classes import HALF, LAB, RIGHT, record

RECORDS = {
    "ada": record("ada", *RIGHT),
    "=bob": record("=bob", *HALF),
    "cleo": record("cleo"),
    "dan": record("dan", status="unreadable", points=0.0, problem="not a notebook"),
}


def rows(path):
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


def write(path, *lines):
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_total_is_machine_and_person(tmp_path):
    """By hand: 75 + 20, 50 + 7.5.

    Nothing for who could not be graded, or has no person's points yet.
    """
    points = {
        "ada": ManualGrade({"figure": 20.0}, "good"),
        "=bob": ManualGrade({"figure": 7.5}),
        "cleo": ManualGrade({"figure": 1}),
    }
    entries = make_entries(LAB, RECORDS, points)
    write_gradebook(tmp_path / "book.csv", LAB, entries)
    found = {
        row["student"]: (row["machine"], row["figure"], row["total"])
        for row in rows(tmp_path / "book.csv")
    }
    assert found == {
        "'=bob": ("50.0", "7.5", "57.5"),
        "ada": ("75.0", "20.0", "95.0"),
        "cleo": ("", "1", ""),
        "dan": ("0.0", "", ""),
    }
    assert rows(tmp_path / "book.csv")[1]["of"] == "100.0"


def test_platform_gets_only_what_is_final(tmp_path):
    """A blank that a platform took for a zero would cost a student points."""
    entries = make_entries(LAB, RECORDS, {"ada": ManualGrade({"figure": 20.0}, "good")})
    write_platform_csv(tmp_path / "out.csv", LAB, entries)
    assert rows(tmp_path / "out.csv") == [
        {"student": "ada", "lab00 [of 100]": "95.0", "comment": "good"}
    ]


def test_points_of_the_page_come_back(tmp_path):
    """As the page saves them: formula marks stay before names, empty cells are not graded yet."""
    file = write(
        tmp_path / "p.csv",
        "student,figure,comment",
        'ada,"12,5","well, done"',
        "'=bob,,'=1+1",
        "dan,0,",
    )
    found = read_rubric(file, LAB, RECORDS)
    assert found["ada"] == ManualGrade({"figure": 12.5}, "well, done")
    assert found["=bob"] == ManualGrade({}, "=1+1")
    assert found["dan"].points == {"figure": 0.0}


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (["student,figure", "ada,26"], "expected 0 to 25 points for figure, got '26'"),
        (["student,figure", "ada,-1"], "expected 0 to 25"),
        (["student,figure", "ada,nan"], "expected 0 to 25"),
        (["student,figure", "ada,many"], "expected 0 to 25"),
        (["student,figure", "eve,3"], "got 'eve' without a record"),
        (["student,figure", "ada,3", "ada,4"], "got 'ada' twice"),
        (
            ["student,figur", "ada,3"],
            "expected the columns student, figure, comment, got student, figur",
        ),
        (["figure", "3"], "expected the columns"),
    ],
)
def test_points_that_cannot_be_meant_are_refused(tmp_path, lines, why):
    """Each sentence says what was wanted and what came."""
    with pytest.raises(InputError, match=why):
        read_rubric(write(tmp_path / "p.csv", *lines), LAB, RECORDS)


def test_gradescope_adds_up():
    """Gradescope shows the score beside its tests: their sum, by hand 25 + 25 + 10."""
    (entry,) = make_entries(
        LAB, {"=bob": RECORDS["=bob"]}, {"=bob": ManualGrade({"figure": 10.0}, "see me")}
    )
    found = gradescope_results(entry, {"stretch": "2 of 4"})
    assert (found["score"], found["output"]) == (60.0, "see me")
    shown = [
        (test["name"], test["score"], test["max_score"], test["status"]) for test in found["tests"]
    ]
    assert shown == [
        ("stretch", 25.0, 50.0, "failed"),
        ("brake", 25.0, 25.0, "passed"),
        ("figure", 10.0, 25.0, "failed"),
    ]
    assert found["tests"][0]["output"] == "2 of 4"


def test_files_of_students_never_meet():
    """Names that differ only in characters invalid in file names have different files."""
    names = ["a b", "a_b", "a/b", "..", ".", "a\\b", "A b", "=1"]
    files = [
        entry.file_name for entry in make_entries(LAB, {name: record(name) for name in names}, {})
    ]
    assert len(set(files)) == len(names)
    assert all(not set(file) & set("/\\. ") for file in files)
