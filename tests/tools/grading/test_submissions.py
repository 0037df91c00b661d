"""Submissions: students' notebooks in folders and zips; links and unsafe names are not followed."""

import io
import os
import stat
import time
import zipfile
from pathlib import PurePosixPath

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading import submissions
from falconwing_kit.tools.grading.submissions import find_submissions, student_of
from tests.tools.grading import toys

GOOD = toys.notebook_bytes(toys.STRETCH)


def zipped(entries):
    """A zip of names and contents; a name may be a ZipInfo."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return data.getvalue()


def found_in(path, lab="lab03"):
    return {each.student: each for each in find_submissions(path, lab)}


@pytest.mark.parametrize(
    ("path", "student"),
    [
        ("ada.ipynb", "ada"),
        ("lab03_ada.ipynb", "ada"),
        ("ada-lab03.ipynb", "ada"),
        ("ada/lab03.ipynb", "ada"),
        ("ada/week 3/lab03.ipynb", "ada"),
        ("Ada Lovelace_4711_assignsubmission_file_/lab03.ipynb", "Ada Lovelace_4711"),
        ("Ada Lovelace_4711_assignsubmission_file_lab03.ipynb", "Ada Lovelace_4711"),
        ("Eve_9_assignsubmission_file_Ada_4711_assignsubmission_file_.ipynb", "Eve_9"),
        ("evemallory_3_9_Ada_4711_assignsubmission_file_.ipynb", "evemallory_3"),
        ("eve/Ada Lovelace_4711_assignsubmission_file/lab03.ipynb", "eve"),
        ("eve/lovelaceada_123_456_lab03.ipynb", "eve"),
        ("lovelaceada_123_456_lab03.ipynb", "lovelaceada_123"),
        ("lovelaceada_LATE_123_456_lab03-2.ipynb", "lovelaceada_123"),
        ("lovelaceada_123_456_work/lab03.ipynb", "lovelaceada_123"),
        ("a\nda\u202e.ipynb", "ada"),
        ("\n.ipynb", "unnamed"),
    ],
)
def test_students_are_told_apart_by_their_files(path, student):
    """The names that Moodle and Canvas give, and plain ones; by hand.

    Control characters do not reach a terminal.
    """
    assert student_of(PurePosixPath(path)) == student


def test_one_notebook_is_one_student(tmp_path):
    """What is read is what is on the disk."""
    (tmp_path / "ada.ipynb").write_bytes(GOOD)
    (one,) = find_submissions(tmp_path / "ada.ipynb", "lab03")
    assert (one.student, one.problem, one.read()) == ("ada", "", GOOD)


def test_folder_of_files_folders_and_zips(tmp_path):
    """One student each; other files are passed over."""
    (tmp_path / "ada.ipynb").write_bytes(GOOD)
    (tmp_path / "bob" / ".ipynb_checkpoints").mkdir(parents=True)
    (tmp_path / "bob" / "work.ipynb").write_bytes(GOOD)
    (tmp_path / "bob" / ".ipynb_checkpoints" / "work.ipynb").write_bytes(b"old")
    (tmp_path / "eve.zip").write_bytes(
        zipped([("inner/lab03.ipynb", GOOD), ("__MACOSX/._lab03.ipynb", b"x")])
    )
    (tmp_path / "readme.txt").write_text("x")
    found = found_in(tmp_path)
    assert {name: each.read() for name, each in found.items()} == dict.fromkeys(
        ("ada", "bob", "eve"), GOOD
    )
    assert len({each.sha256 for each in found.values()}) == 1


def test_platforms_zips(tmp_path):
    """Moodle's folders, Canvas's flat names, and a student's own zip inside."""
    export = tmp_path / "export.zip"
    export.write_bytes(
        zipped(
            [
                ("Ada_1_assignsubmission_file_/lab03.ipynb", GOOD),
                ("Bob_2_assignsubmission_file_/all.zip", zipped([("deep/down/lab03.ipynb", GOOD)])),
                ("evemallory_3_9_lab03.ipynb", GOOD),
            ]
        )
    )
    assert {name: each.read() for name, each in found_in(export).items()} == dict.fromkeys(
        ("Ada_1", "Bob_2", "evemallory_3"), GOOD
    )


def test_labs_own_name_counts_then_the_newest(tmp_path):
    """By hand: of lab02, lab03 and scratch, lab03; of two without it the later one; it is said."""
    for student, names in {
        "ada": ("lab02", "lab03", "scratch"),
        "bob": ("first", "second"),
    }.items():
        (tmp_path / student).mkdir()
        for when, name in enumerate(names):
            file = tmp_path / student / f"{name}.ipynb"
            file.write_bytes(GOOD)
            os.utime(file, (1e9 + when, 1e9 + when))
    found = found_in(tmp_path)
    assert (found["ada"].name, found["bob"].name) == ("lab03.ipynb", "second.ipynb")
    assert "one of 3 notebooks" in found["ada"].problem


def test_links_are_not_followed(tmp_path):
    """A link to a file and one to a folder of the grader's, on the disk and in a zip."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "hidden.ipynb").write_bytes(GOOD)
    students = tmp_path / "students"
    students.mkdir()
    (students / "ada.ipynb").symlink_to(tmp_path / "outside" / "hidden.ipynb")
    (students / "bob").symlink_to(tmp_path / "outside")
    link = zipfile.ZipInfo("eve/lab03.ipynb")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    (students / "eve.zip").write_bytes(zipped([(link, "/etc/passwd")]))
    found = found_in(students)
    assert sorted(found) == ["ada", "bob", "eve"]
    for each in found.values():
        assert "link" in each.problem
        assert each.sha256 == ""
        with pytest.raises(InputError, match="link"):
            each.read()


@pytest.mark.parametrize(
    "name", ["../../ada.ipynb", "/etc/ada.ipynb", "C:/ada.ipynb", "..\\ada.ipynb"]
)
def test_names_that_lead_out_of_a_zip_are_refused(tmp_path, name):
    """Zip slip; nothing is unpacked in any case, so nothing appears beside the zip either."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "export.zip").write_bytes(zipped([(name, GOOD)]))
    (each,) = find_submissions(tmp_path / "in" / "export.zip", "lab03")
    assert "leads out" in each.problem
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["export.zip", "in"]


def test_zip_bombs_are_not_read(tmp_path, monkeypatch):
    """A megabyte of zeros is a kilobyte in a zip; a cap of 1000 bytes stands for the real one.

    The others are read.
    """
    monkeypatch.setattr(submissions, "MAX_FILE", 1000)
    entries = [
        ("bomb.ipynb", bytes(1 << 20)),
        ("nested.zip", zipped([("x.ipynb", bytes(1 << 22))])),
        ("ada.ipynb", b"{}"),
    ]
    (tmp_path / "export.zip").write_bytes(zipped(entries))
    found = found_in(tmp_path / "export.zip")
    assert found["ada"].read() == b"{}"
    assert "at most" in found["bomb"].problem
    assert found["bomb"].sha256 == ""


def test_damaged_and_locked_files_are_reported(tmp_path):
    """A cut zip, a zip that is none, one in one in one, a pipe; a good one among them is found."""
    good = zipped([("lab03.ipynb", GOOD)])
    (tmp_path / "cut.zip").write_bytes(good[: len(good) // 2])
    (tmp_path / "none.zip").write_bytes(b"PK")
    (tmp_path / "nest.zip").write_bytes(zipped([("a.zip", zipped([("b.zip", good)]))]))
    flipped = bytearray(good)
    flipped[60] ^= 0xFF  # in the compressed bytes: the zip's own sum no longer fits
    (tmp_path / "flipped.zip").write_bytes(bytes(flipped))
    os.mkfifo(tmp_path / "pipe.ipynb")
    (tmp_path / "ada.ipynb").write_bytes(GOOD)
    found = found_in(tmp_path)
    assert sorted(found) == ["ada", "cut", "flipped", "nest", "none", "pipe"]
    assert [name for name, each in found.items() if not each.problem] == ["ada"]


ADA, EVE = toys.notebook_bytes(toys.STRETCH), toys.notebook_bytes(toys.BRAKE)
FUTURE = (2107, 12, 31, 23, 59, 58)  # the last date of a zip
ADAS_NAMES = (  # what Eve calls her files inside of what is hers
    "Ada_1_assignsubmission_file_/lab03.ipynb",
    "lovelaceada_1_2_lab03.ipynb",
    "lovelaceada_1_2_lab03/lab03.ipynb",
    "ada/lab03.ipynb",
    "lab03_ada.ipynb",
    "ada.ipynb",
    "../ada/lab03.ipynb",
    "/ada.ipynb",
)


@pytest.mark.parametrize("name", ADAS_NAMES)
@pytest.mark.parametrize("layout", ["moodle", "canvas", "folders", "zips"])
def test_nobody_replaces_a_classmate_by_names_in_their_own_archive(tmp_path, layout, name):
    """Ada's notebook stays hers, and Eve stays Eve, whatever Eve's zip says, dated 2107.

    By hand: each of Ada's entries comes from the platform, each name of ADAS_NAMES from Eve.
    """
    inner = zipped([(zipfile.ZipInfo(name, FUTURE), EVE)])
    if layout in ("moodle", "canvas"):
        ada, eve = {
            "moodle": ("Ada_1_assignsubmission_file_/lab03.ipynb", "Eve_2_assignsubmission_file_/"),
            "canvas": ("lovelaceada_1_2_lab03.ipynb", "evemallory_3_9_"),
        }[layout]
        place = tmp_path / "export.zip"
        place.write_bytes(zipped([(ada, ADA), (f"{eve}all.zip", inner)]))
    else:
        place = tmp_path / "class"
        (place / "ada").mkdir(parents=True)
        (place / "ada" / "lab03.ipynb").write_bytes(ADA)
        os.utime(place / "ada" / "lab03.ipynb", (1e9, 1e9))
        mine = place / "eve" / "all.zip" if layout == "folders" else place / "eve.zip"
        mine.parent.mkdir(exist_ok=True)
        mine.write_bytes(inner)
    found = {each.student: each for each in find_submissions(place, "lab03")}
    adas, eves = sorted(found)
    assert (adas[:3].lower(), eves[:3].lower()) in (("ada", "eve"), ("eve", "lov"))
    mine = next(each for student, each in found.items() if "eve" in student.lower())
    hers = next(each for student, each in found.items() if "ada" in student.lower())
    assert hers.read() == ADA
    assert not hers.problem
    assert not mine.sha256 or mine.read() == EVE


@pytest.mark.parametrize(
    "other", ["lab03_ada.ipynb", "ada-lab03.ipynb", "a\u200bda.ipynb", "ada.zip", "ada"]
)
def test_a_name_that_several_claim_is_left_to_a_person(tmp_path, other):
    """Next to ada.ipynb: a second name for the same student may be somebody else's."""
    (tmp_path / "ada.ipynb").write_bytes(ADA)
    if other == "ada":
        (tmp_path / other).mkdir()
        (tmp_path / other / "lab03.ipynb").write_bytes(EVE)
    else:
        content = zipped([("lab03.ipynb", EVE)]) if other.endswith(".zip") else EVE
        (tmp_path / other).write_bytes(content)
    (each,) = find_submissions(tmp_path, "lab03")
    assert (each.student, each.disputed, each.sha256) == ("ada", True, "")
    assert "several have this name" in each.problem


@pytest.mark.parametrize("kind", ["folder", "zip"])
def test_names_in_a_single_folder_are_not_taken_for_the_platforms(tmp_path, kind):
    """A late student's own folder and an export in a folder look the same: refused, with advice."""
    name = "Ada_1_assignsubmission_file_/lab03.ipynb"
    if kind == "zip":
        place = tmp_path / "late.zip"
        place.write_bytes(zipped([(f"eve/{name}", EVE)]))
    else:
        place = tmp_path
        (tmp_path / "eve" / name).parent.mkdir(parents=True)
        (tmp_path / "eve" / name).write_bytes(EVE)
    with pytest.raises(InputError, match="got one folder, eve, with a platform's names"):
        find_submissions(place, "lab03")


def test_a_folder_of_too_many_files_is_its_owners_problem(tmp_path, monkeypatch):
    """Five files stand for 20,000: Eve's are not searched, Ada's are found."""
    monkeypatch.setattr(submissions, "MAX_ENTRIES", 4)
    for student, count in {"ada": 1, "eve": 5}.items():
        (tmp_path / student).mkdir()
        for number in range(count):
            (tmp_path / student / f"{number}.ipynb").write_bytes(GOOD)
    found = found_in(tmp_path)
    assert found["ada"].read() == GOOD
    assert "more than 4 files" in found["eve"].problem


@pytest.mark.parametrize(
    "make",
    [
        lambda: [(f"{n}.txt", b"x" + bytes(1 << 10)) for n in range(20_000)],
        lambda: [(f"{n}.zip", zipped([("x.txt", bytes(24 << 20))])) for n in range(50)],
    ],
    ids=["twenty thousand texts", "fifty zips of zeros"],
)
def test_an_archive_of_many_files_takes_seconds(tmp_path, make):
    """Each of Eve's zips in Moodle's, and as a file: 10 s of processor time, and Ada is found."""
    inner = zipped(make())
    first = "Ada_1_assignsubmission_file_/lab03.ipynb"
    (tmp_path / "class").mkdir()
    (tmp_path / "class" / "ada.ipynb").write_bytes(ADA)
    (tmp_path / "class" / "eve.zip").write_bytes(inner)
    export = tmp_path / "export.zip"
    export.write_bytes(zipped([(first, ADA), ("Eve_2_assignsubmission_file_/a.zip", inner)]))
    begin = time.process_time()
    for place in (export, tmp_path / "class"):
        hers, eves = find_submissions(place, "lab03")
        assert hers.student.lower().startswith("ada") and hers.read() == ADA
        assert not eves.sha256
    if inner.count(b".zip") >= 50:  # of one student's many zips none is opened
        assert "not a zip that can be read" in eves.problem
    assert time.process_time() - begin < 10.0


def test_gradescopes_list_counts_in_its_own_export_only(tmp_path):
    """Beside students' own folders the list is a file like others; in one more folder it is
    refused, since a student may have named it so.
    """
    listed = b"eve:\n  :submitters:\n  - {':name': 'ada'}\n"
    for name in ("ada", "eve"):
        (tmp_path / "class" / name).mkdir(parents=True)
        (tmp_path / "class" / name / "lab03.ipynb").write_bytes(ADA if name == "ada" else EVE)
    (tmp_path / "class" / "submission_metadata.yml").write_bytes(listed)
    assert {
        each.student: each.read() for each in find_submissions(tmp_path / "class", "lab03")
    } == {
        "ada": ADA,
        "eve": EVE,
    }
    (tmp_path / "late" / "assignment_1_export" / "submission_1").mkdir(parents=True)
    (tmp_path / "late" / "assignment_1_export" / "submission_1" / "a.ipynb").write_bytes(EVE)
    with pytest.raises(InputError, match="got one in a folder"):
        find_submissions(tmp_path / "late", "lab03")


def test_of_versions_with_the_same_time_the_last_number_counts(tmp_path):
    """Canvas numbers what is handed in again (lab03-2), browsers what is downloaded again."""
    for first, second in (("lab03.ipynb", "lab03-2.ipynb"), ("lab03-9.ipynb", "lab03-10.ipynb")):
        place = tmp_path / first
        place.mkdir()
        entries = [(f"lovelaceada_1_{n}_{name}", GOOD) for n, name in enumerate((second, first))]
        (place / "export.zip").write_bytes(zipped(entries))
        (each,) = find_submissions(place / "export.zip", "lab03")
        assert each.name.endswith(second)


@pytest.mark.parametrize("make", ["nothing", "empty"])
def test_nothing_to_grade_is_said(tmp_path, make):
    """Wrong use, in one sentence."""
    place = tmp_path / make
    if make == "empty":
        place.mkdir()
    with pytest.raises(InputError, match="expected"):
        find_submissions(place, "lab03")
