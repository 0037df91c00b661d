"""What is handed out holds what a student needs, in the course's numbers, and nothing else."""

import json

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.release import release, without_answers
from tests.tools.grading.small_lab import write_small_lab

SALT = "a secret of ours, long enough"


@pytest.fixture
def folder(tmp_path):
    """The small lab, with a route beside it."""
    (tmp_path / "labs").mkdir()
    (tmp_path / "labs" / "README.md").write_text(
        "# Route\nfirst this\n\n## For instructors\nsecret\n"
    )
    return write_small_lab(tmp_path / "labs")


def handed_out(out):
    """Every file below a folder, by its path in it."""
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}


def test_only_what_students_need_is_handed_out(folder, tmp_path):
    """By hand: notebook, given, checks, constants, data, route.

    No notes, judges, solution or source.
    """
    files = release([folder], tmp_path / "out")
    lab = {
        f"lab01_small/{name}"
        for name in ("lab01.ipynb", "given.py", "checks.py", "cohort.json", "data/points.csv")
    }
    assert handed_out(tmp_path / "out") == {"README.md", *lab}
    assert len(files) == 6
    assert (tmp_path / "out" / "README.md").read_text() == "# Route\nfirst this\n"


def test_what_a_person_looks_for_is_not_handed_out():
    """By hand: both criteria are blanked, by position or keyword, and nothing else."""
    text = """# no \u00fc lost
LAB = Lab(rubric=(Criterion("\u00fc", 4.0, "a " "b"), Criterion("q1", 6.0, look_for="7")), hours=2)
"""
    wanted = """# no \u00fc lost
LAB = Lab(rubric=(Criterion("\u00fc", 4.0, ""), Criterion("q1", 6.0, look_for="")), hours=2)
"""
    assert without_answers(text) == wanted


def test_salt_draws_other_numbers_and_the_same_again(folder, tmp_path):
    """The open course has the middle of 9 to 11.

    Two salts differ from it and from each other, one gives the same.
    """
    numbers = []
    for number, salt in enumerate(["", SALT, SALT[::-1], SALT]):
        release([folder], tmp_path / str(number), salt)
        numbers.append(
            json.loads((tmp_path / str(number) / "lab01_small" / "cohort.json").read_text())[
                "gravity"
            ]
        )
    assert numbers[0] == 10.0 and numbers[1] == numbers[3]
    assert len(set(numbers)) == 3 and all(9.0 <= number <= 11.0 for number in numbers)


def test_every_student_gets_files_of_their_own(folder, tmp_path):
    """The small lab writes down for whom it was asked."""
    release([folder], tmp_path / "out", SALT, ["ann", "bo@uni"])
    mine = tmp_path / "out" / "handouts"
    assert handed_out(mine) == {"ann/lab01_small/mine.txt", "bo@uni/lab01_small/mine.txt"}
    assert (mine / "bo@uni" / "lab01_small" / "mine.txt").read_text() == f"bo@uni {SALT}"


def test_used_folder_weak_salt_and_roster_without_salt_are_refused(folder, tmp_path):
    """What already lies there could be a solution.

    Without a salt all files could be drawn by anyone.
    """
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "solution.txt").write_text("all of it")
    with pytest.raises(InputError, match="expected a new or an empty folder"):
        release([folder], tmp_path / "out")
    with pytest.raises(InputError, match="expected --course or --salt"):
        release([folder], tmp_path / "new", students=["ann"])
    with pytest.raises(InputError, match="expected at least 16 characters"):
        release([folder], tmp_path / "new", "2027")
    assert handed_out(tmp_path / "out") == {"solution.txt"} and not (tmp_path / "new").exists()


def test_failure_leaves_nothing(folder, tmp_path):
    """A lab without given.py cannot be handed out; whole or not at all."""
    (folder / "given.py").unlink()
    with pytest.raises((FileNotFoundError, InputError)):
        release([folder], tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["labs"]
