"""Roster: every platform's list of a class is read, and everyone's hand-in is found by it."""

from pathlib import Path

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.roster import (
    Student,
    collect_hand_ins,
    hand_in_facts,
    read_roster,
)
from falconwing_kit.tools.grading.rules import read_rules
from falconwing_kit.tools.grading.submissions import Submission
from tests.tools.grading import toys
from tests.tools.grading.test_submissions import zipped

GOOD = toys.notebook_bytes(toys.STRETCH)
NAMES = ("Ada Lovelace", "José Pérez García", "Iván Петров", "山田 太郎", "O'Neil-Smith Zoë")


def roster_of(tmp_path, text):
    (tmp_path / "roster.csv").write_bytes(text.encode())
    return read_roster(tmp_path / "roster.csv")


@pytest.mark.parametrize(
    ("text", "student"),
    [
        ("student\nada\n", Student("ada", others=("ada",))),
        ("\ufeffname;extension_days\r\nJosé; 2\r\n", Student("José", "José", extension_days=2)),
        (
            "First name,Last name,ID number,Email address,Groups\nAda,Lovelace,0123,a@b.c,A\n",
            Student("0123", "Ada Lovelace", "a@b.c", ("0123",), group="A"),
        ),
        (
            "Student,ID,SIS User ID,SIS Login ID,Section,Lab 1 (4711)\n"
            "    Points Possible,,,,,100\n"
            '"Lovelace, Ada",17,0123,al1,A,\n"Student, Test",99,,x,A,\n',
            Student("al1", "Ada Lovelace", "", ("al1", "0123"), "17", "A"),
        ),
        (
            "Full Name\tSID\tEmail\nAda Lovelace\t0123\ta@b.c\n",
            Student("0123", "Ada Lovelace", "a@b.c", ("0123",)),
        ),
        (
            "student\nAda Lovelace_4711\n",
            Student("Ada Lovelace_4711", "Ada Lovelace", "", ("Ada Lovelace_4711",)),
        ),
    ],
    ids=["plain", "semicolons", "moodle", "canvas", "gradescope", "moodle's folder names"],
)
def test_platforms_lists_are_read_as_they_are(tmp_path, text, student):
    """Their columns by hand; Canvas adds a row of points and a test student."""
    assert roster_of(tmp_path, text) == [student]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("points\n3\n", "expected a column that says who"),
        ("", "got nothing"),
        ("student\nann\nann\n", "expected every student once, got ann"),
        ("student\na\x07nn\n", "printable letters"),
        ("student,extension_days\nann,soon\n", "expected whole extension days, got 'soon'"),
        ("student\n" + "x" * 200_000, "expected a table in CSV"),
        ('student\n"ann\n' + "bob\n" * 50_000, "expected a table in CSV"),
    ],
)
def test_bad_roster_is_refused(tmp_path, text, sentence):
    """In one sentence."""
    with pytest.raises(InputError, match=sentence):
        roster_of(tmp_path, text)


def test_one_roster_finds_everyone_on_three_platforms(tmp_path):
    """Names with accents and in other scripts; Moodle's number changes from lab to lab.

    Canvas joins the letters of "Lovelace, Ada" and adds its number, Gradescope lists email
    addresses; a hand-in of nobody's is kept and said.
    """
    rows = [f"{name},{n}@x.y,{100 + n}\n" for n, name in enumerate(NAMES)]
    roster = roster_of(tmp_path, "name,email,canvas\n" + "".join(rows))
    ids = [f"{n}@x.y" for n in range(len(NAMES))]
    moodle = [
        (f"{name}_{4700 + n}_assignsubmission_file_/lab03.ipynb", GOOD)
        for n, name in enumerate(NAMES)
    ]
    canvas = [(f"lovelaceada_LATE_{100 + n}_9_lab03.ipynb", GOOD) for n in range(len(NAMES))]
    listed = "".join(
        f"submission_{n}:\n  :submitters:\n  - :name: X\n    :email: {n}@x.y\n"
        "  :created_at: 2027-10-08 21:00:00 Z\n"
        for n in range(len(NAMES))
    )
    scope = [("assignment_7_export/submission_metadata.yml", listed)]
    scope += [(f"assignment_7_export/submission_{n}/lab03.ipynb", GOOD) for n in range(len(NAMES))]
    for name, entries in {"moodle": moodle, "canvas": canvas, "gradescope": scope}.items():
        place = tmp_path / f"{name}.zip"
        place.write_bytes(
            zipped(
                [*entries, ("Eve_1_assignsubmission_file_/lab03.ipynb", GOOD)]
                if name == "moodle"
                else entries
            )
        )
        found = collect_hand_ins([place], "lab03", roster)
        assert sorted(each.student for each in found.submissions if each.known) == ids
        assert found.missing == ()
        assert [each.student for each in found.submissions if not each.known] == (
            ["Eve_1"] if name == "moodle" else []
        )
        assert all(each.late == (name == "canvas") for each in found.submissions)


def test_students_of_one_name_need_moodles_worksheet(tmp_path):
    """Without it a person must decide; with it each has their own, and who was late is said."""
    roster = roster_of(tmp_path, "student,name,email\na,Kim Lee,a@x.y\nb,Kim Lee,b@x.y\n")
    names = [f"Kim Lee_{n}_assignsubmission_file_/lab03.ipynb" for n in (1, 2)]
    (tmp_path / "moodle.zip").write_bytes(zipped([(name, GOOD) for name in names]))
    before = collect_hand_ins([tmp_path / "moodle.zip"], "lab03", roster)
    assert all(each.disputed for each in before.submissions) and before.missing == ("a", "b")
    (tmp_path / "sheet.csv").write_text(
        "Identifier,Full name,Email address,Status\n"
        "Participant 1,Kim Lee,b@x.y,Submitted for grading - 2 days late\n"
        "Participant 2,Kim Lee,a@x.y,Submitted for grading\n"
    )
    after = collect_hand_ins([tmp_path / "moodle.zip", tmp_path / "sheet.csv"], "lab03", roster)
    assert [(each.student, each.entry, each.late) for each in after.submissions] == [
        ("a", "Kim Lee_2", False),
        ("b", "Kim Lee_1", True),
    ]


OTHERS = {  # what a student handed in -> whether it is gradable, and what is said
    "page.html": (b"<html>", False, "not a notebook: page.html"),
    "lab03.py": (b"def stretch(x): pass", False, "not a notebook: lab03.py"),
    "scan.pdf": (b"%PDF-1.7", False, "not a notebook: scan.pdf"),
    "answer.docx": (b"PK\3\4", False, "not a notebook: answer.docx"),
    "notes.txt": (b"I did it", False, "not a notebook: notes.txt"),
    "lab03.7z": (b"7z", False, "not a notebook: lab03.7z"),
    "empty.zip": (zipped([]), False, "an empty zip"),
    "deep.zip": (zipped([("a.zip", zipped([("lab03.ipynb", GOOD)]))]), False, "a zip in a zip"),
    "lab03.ipynb.txt": (GOOD, True, "not called .ipynb: lab03.ipynb.txt"),
    "lab03": (GOOD, True, "not called .ipynb: lab03"),
    "lab03.json": (GOOD, True, "not called .ipynb: lab03.json"),
    "all.zip": (zipped([("x/lab03.ipynb", GOOD), ("x/scan.pdf", b"%PDF")]), True, ""),
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("layout", ["moodle", "canvas", "folder"])
def test_every_kind_of_hand_in_is_somebodys_and_said(tmp_path, layout, name):
    """A notebook by another name is found, anything else is named; nobody is missing."""
    content, readable, said = OTHERS[name]
    roster = roster_of(tmp_path, "student,name\nada,Ada Lovelace\n")
    place = tmp_path / "class"
    if layout == "folder":
        (place / "ada").mkdir(parents=True)
        (place / "ada" / name).write_bytes(content)
    else:
        first = {"moodle": "Ada Lovelace_1_assignsubmission_file_/", "canvas": "lovelaceada_1_2_"}
        place = tmp_path / "export.zip"
        place.write_bytes(zipped([(first[layout] + name, content)]))
    found = collect_hand_ins([place], "lab03", roster)
    (each,) = found.submissions
    assert (each.student, each.known, found.missing) == ("ada", True, ())
    if (layout, name) == ("folder", "deep.zip"):  # one zip less than on a platform
        readable, said = True, ""
    kind, _, ends = said.partition(": ")
    assert bool(each.sha256) == readable
    assert each.problem.startswith(kind) and each.problem.endswith(ends)


def test_empty_folders_and_two_exports_are_said(tmp_path):
    """Moodle's folder with nothing in it; the same student on two platforms: a person decides."""
    roster = roster_of(tmp_path, "student,name\nada,Ada Lovelace\nbob,Bob Ray\ncy,Cy Orr\n")
    (tmp_path / "moodle.zip").write_bytes(
        zipped(
            [
                ("Bob Ray_7_assignsubmission_file_/", b""),
                ("Ada Lovelace_8_assignsubmission_file_/lab03.ipynb", GOOD),
            ]
        )
    )
    (tmp_path / "canvas.zip").write_bytes(zipped([("lovelaceada_1_2_lab03.ipynb", GOOD)]))
    places = [tmp_path / "moodle.zip", tmp_path / "canvas.zip"]
    found = {each.student: each for each in collect_hand_ins(places, "lab03", roster).submissions}
    assert sorted(found) == ["ada", "bob"]
    assert found["bob"].problem == "an empty folder"
    assert found["ada"].disputed and "handed in 2 times" in found["ada"].problem


@pytest.mark.parametrize(
    ("handed_in", "extension", "late", "days"),
    [
        ("2027-10-08T21:58:59+00:00", 0, False, 0),
        ("2027-10-08T22:00:00+00:00", 0, True, 1),
        ("2027-10-10T12:00:00+00:00", 0, True, 2),
        ("2027-10-10T12:00:00+00:00", 1, True, 1),
        ("2027-10-10T12:00:00+00:00", 2, False, 0),
    ],
)
def test_days_late_are_begun_days_after_the_students_own_deadline(
    tmp_path, handed_in, extension, late, days
):
    """By hand, from 23:59 in a zone two hours before UTC: 21:59 UTC."""
    (tmp_path / "course.toml").write_text("[labs.lab03]\ndeadline = 2027-10-08T23:59:00+02:00\n")
    deadline = read_rules(tmp_path).lab("lab03").deadline
    roster = roster_of(tmp_path, f"student,extension_days\nada,{extension}\n")
    facts = hand_in_facts(Submission("ada", Path(), handed_in=handed_in), roster, deadline)
    assert (facts["late"], facts["late_days"]) == (late, days)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("late_days = ", "expected TOML"),
        ("late_dais = 3", "got late_dais"),
        ("late_days = 'x'", "expected a number for late_days"),
        ("drop_lowest = -1", "expected"),
        ("[labs.lab03]\ndeadline = 'soon'", "expected a deadline such as"),
        ("[labs.lab03]\nwait = 1", "got wait"),
        ("labs = 3", "expected sections"),
    ],
)
def test_bad_rules_are_refused(tmp_path, text, sentence):
    """In one sentence, with the file's name."""
    (tmp_path / "course.toml").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_rules(tmp_path)
