"""A lab is found by number, name or folder, and its files do not mix with another lab's."""

import sys

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.find import (
    lab_folder,
    labs_folder,
    load_checks,
    load_judges,
    load_module,
)
from falconwing_kit.tools.grading.lab import Course
from tests.tools.grading.small_lab import write_small_lab


@pytest.fixture
def folder(tmp_path):
    """The small lab, the only one in its folder."""
    return write_small_lab(tmp_path)


@pytest.mark.parametrize("name", ["lab01", "lab01_small"])
def test_lab_is_found_by_number_and_name(folder, name):
    """Both are what a person types."""
    assert lab_folder(name, folder.parent) == folder
    assert lab_folder(folder) == folder


@pytest.mark.parametrize("below", [".", "lab01_small"])
def test_labs_are_found_from_where_a_student_stands(folder, monkeypatch, below):
    """In the handed-out folder, and in a lab's own, where JupyterLab starts the notebook."""
    monkeypatch.chdir(folder.parent / below)
    assert lab_folder("lab01").resolve() == folder.resolve()


def test_unknown_lab_is_refused_with_the_list(folder):
    """One sentence that names what there is."""
    with pytest.raises(InputError, match=r"lab07: expected one of lab01_small"):
        lab_folder("lab07", folder.parent)
    with pytest.raises(InputError, match="expected a folder with labs"):
        labs_folder(folder)


def test_files_of_a_lab_leave_nothing_behind(folder, monkeypatch):
    """`given` is a name of every lab: another lab's module and the path are restored."""
    other = object()
    monkeypatch.setitem(sys.modules, "given", other)
    before = list(sys.path)
    assert load_checks(folder).title == "Small"
    assert sys.modules["given"] is other and "checks" not in sys.modules and sys.path == before


def test_judges_see_the_numbers_of_their_course(folder):
    """By hand: 3 kg times 7 m/s^2 are 21 N, not the 30 N of the open course.

    What given.py computes follows.
    """
    (values,) = load_judges(folder, Course({"gravity": 7.0}))["weight"]
    assert values.reference(3.0) == 21.0
    assert load_module(folder, "given").COHORT == {"gravity": 10.0}
    with (folder / "given.py").open("a") as file:
        file.write('TWICE = 2.0 * COHORT["gravity"]\n')
    given = load_module(folder, "given", {"gravity": 7.0})
    assert given.COHORT == {"gravity": 7.0} and given.TWICE == 14.0


@pytest.mark.parametrize(
    ("file", "text", "sentence"),
    [
        ("checks.py", "LAB = 3", "expected LAB"),
        ("checks.py", "import given\n1 / 0", "checks.py: running it failed with ZeroDivisionError"),
        ("given.py", "COHORT = {", "given.py: running it failed with SyntaxError"),
        (
            "hidden.py",
            "def judges(course):\n    return {}",
            r"expected judges of \['weight'\], got \[\]",
        ),
        ("hidden.py", None, "expected this file of the lab, found none"),
    ],
)
def test_spoilt_lab_is_refused_in_one_sentence(folder, file, text, sentence):
    """Each fault is planted here; the sentence names the file."""
    if text is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(text)
    with pytest.raises(InputError, match=sentence):
        load_judges(folder, Course({"gravity": 10.0}))
