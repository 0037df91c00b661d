"""Records: added at once, never changed, read again after a kill in the middle of a line."""

import csv

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.records import (
    append_record,
    last_records,
    open_run,
    read_grade_records,
    spreadsheet_cell,
    write_points_table,
)


def record(student, points, **more):
    done = {"f": {"points": points, "right": 1, "cases": 1}}
    base = {
        "points": points,
        "of": 75.0,
        "status": "graded",
        "problem": "",
        "sandboxed": True,
        "exercises": done,
    }
    return {"student": student, **base, **more}


def test_last_record_of_a_student_counts(tmp_path):
    """Three lines, two students, by name."""
    for each in (record("bob", 1.0), record("ada", 2.0), record("bob", 3.0)):
        append_record(tmp_path, each)
    assert len(read_grade_records(tmp_path)) == 3
    assert [
        (name, each["points"]) for name, each in last_records(read_grade_records(tmp_path)).items()
    ] == [
        ("ada", 2.0),
        ("bob", 3.0),
    ]


def test_line_cut_by_a_kill_is_passed_over_and_stays_alone(tmp_path):
    """An incomplete line at the end: the next record begins a new line, no byte is changed."""
    append_record(tmp_path, record("ada", 1.0))
    whole = (tmp_path / "records.jsonl").read_bytes()
    (tmp_path / "records.jsonl").write_bytes(whole + whole[:40])
    append_record(tmp_path, record("bob", 2.0))
    assert [each["student"] for each in read_grade_records(tmp_path)] == ["ada", "bob"]
    assert (tmp_path / "records.jsonl").read_bytes().startswith(whole + whole[:40] + b"\n")


def test_run_remembers_its_secret_and_refuses_another_course(tmp_path):
    """The salt itself is not written down; a secret is only drawn once."""
    secret = open_run(tmp_path / "out", "lab03", "pepper", sandboxed=True, go_on=False)
    assert open_run(tmp_path / "out", "lab03", "pepper", sandboxed=True, go_on=True) == secret
    assert "pepper" not in (tmp_path / "out" / "run.json").read_text()
    assert (tmp_path / "out" / "run.json").stat().st_mode & 0o077 == 0
    for change in ({"lab": "lab04"}, {"salt": "salt"}, {"sandboxed": False}):
        with pytest.raises(InputError, match="earlier run"):
            open_run(
                tmp_path / "out",
                **{"lab": "lab03", "salt": "pepper", "sandboxed": True, "go_on": True, **change},
            )


def test_records_are_not_overwritten_unasked(tmp_path):
    """A second run into the same folder says what to do."""
    open_run(tmp_path, "lab03", "", sandboxed=True, go_on=False)
    append_record(tmp_path, record("ada", 1.0))
    with pytest.raises(InputError, match="--resume"):
        open_run(tmp_path, "lab03", "", sandboxed=True, go_on=False)


def test_damaged_run_file_is_said(tmp_path):
    """Someone edited it."""
    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(InputError, match="earlier run"):
        open_run(tmp_path, "lab03", "", sandboxed=True, go_on=False)


def test_gradebook_is_a_table_that_runs_no_formula(tmp_path):
    """A student called =1+1 stays a text; commas and quotes too.

    No points where a person must look.
    """
    odd = record('=1+"1",', None, status="error", problem="the box, it failed", exercises={})
    path = write_points_table(tmp_path, ["f", "g"], [odd, record("ada", 2.5)])
    with path.open(newline="") as handle:
        rows = list(csv.reader(handle))
    assert rows[0] == ["student", "f", "g", "points", "of", "status", "note", "sandboxed"]
    assert rows[1] == ['\'=1+"1",', "", "", "", "75.0", "error", "the box, it failed", "True"]
    assert rows[2] == ["ada", "2.5", "", "2.5", "75.0", "graded", "", "True"]


@pytest.mark.parametrize(
    "text",
    [
        *("=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", " =1", "\u200b=1", "\ufeff=1"),
        *("\uff1d1+1", "\uff0b1", "\uff0d1", "\uff20x", "\ufe66" + "1", "\u207c1", "\u22121"),
    ],
)
def test_every_form_of_a_formulas_sign_is_quoted(text):
    """Full-width, small, raised, behind blanks or unseen characters; by Unicode's tables.

    A ' at the front makes a spreadsheet show it as a text; alone in its cell or behind a semicolon.
    """
    assert str(spreadsheet_cell(text)).startswith("'")
    assert str(spreadsheet_cell(f"Ada;{text}")).startswith("Ada;'")


@pytest.mark.parametrize("value", ["Ada-Lou M\u00fcller", "a=b", "", 3, 2.5, -1.0, True, "3;4"])
def test_other_cells_stay(value):
    """Names, texts and numbers; a negative number is no formula."""
    assert spreadsheet_cell(value) == value
