"""One source gives two notebooks: the student's without solutions, the solution's complete."""

import json

import nbformat
import pytest

from falconwing_kit import __version__
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import parse_notebook
from falconwing_kit.tools.grading.notebooks import (
    build,
    read_cells,
    stale_notebooks,
    write_notebooks,
)
from tests.tools.grading.small_lab import SOURCE, write_small_lab


@pytest.fixture
def folder(tmp_path):
    """The small lab."""
    return write_small_lab(tmp_path)


def sources(text):
    """The cells' texts of a notebook's file."""
    return [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"]]


def test_student_gets_the_cells_without_what_is_to_be_written(folder):
    """By hand, from the small lab's source: seven cells, the one for instructors left out."""
    student = sources(build(folder)[folder / "lab01.ipynb"])
    assert [kind for kind, _ in student] == [
        "markdown",
        "code",
        "code",
        "code",
        "code",
        "markdown",
        "markdown",
    ]
    assert student[2][1] == (
        'def weight(mass):\n    """Weight [N] of a mass [kg]."""\n    raise '
        'NotImplementedError("write weight")'
    )
    assert student[-1][1] == "*Your answer:*"
    assert not any(
        "Earth" in text or "instructors" in text or "newtons" in text for _, text in student
    )


def test_solution_has_everything_but_the_markers(folder):
    """By hand: two more cells, one for instructors and one that changes to the lab's folder."""
    solution = sources(build(folder)[folder / "solution" / "lab01.ipynb"])
    assert len(solution) == 9
    assert "chdir" in solution[1][1]
    assert solution[3][1].endswith('    newtons = COHORT["gravity"] * mass\n\n    return newtons')
    assert not any("SOLUTION" in text for _, text in solution)


def test_words_for_the_formatter_are_left_out(folder):
    """They are for who writes the source; a student would wonder."""
    (folder / "lab.py").write_text(
        SOURCE.replace("print(weight(2.0))", "print(weight(2.0))  # fmt: skip")
    )
    assert all('"print(weight(2.0))"' in text for text in build(folder).values())


def test_notebooks_are_valid_and_keep_what_cells_are_for(folder):
    """nbformat validates the file; the metadata is what grading and the rubric page need."""
    for text in build(folder).values():
        notebook = nbformat.reads(text, as_version=4)
        nbformat.validate(notebook)
        marks = [dict(cell.metadata) for cell in notebook.cells if cell.metadata]
        assert (
            {"exercise": "weight"} in marks
            and {"figure": "line"} in marks
            and {"answer": "q1"} in marks
        )
        assert all(not cell.get("outputs") for cell in notebook.cells)


def test_notebooks_carry_the_kits_version(folder):
    """In the metadata and below the title: the first two numbers of the version."""
    version = ".".join(__version__.split(".")[:2])
    for text in build(folder).values():
        assert json.loads(text)["metadata"]["falconwing_kit"] == version
        assert sources(text)[0][1].endswith(f"\n\n*Notebook of falconwing-kit {version}.*")
        stripped = json.dumps(json.loads(text) | {"metadata": {}}).encode()
        assert (
            parse_notebook(text.encode(), "a").kit == parse_notebook(stripped, "a").kit == version
        )


def test_stale_notebooks_are_told_and_mended(folder):
    """Missing, edited by hand, or with an edited source: each is stale until it is written."""
    both = {folder / "lab01.ipynb", folder / "solution" / "lab01.ipynb"}
    assert set(stale_notebooks(folder)) == both
    assert set(write_notebooks(folder)) == both and stale_notebooks(folder) == []
    (folder / "lab01.ipynb").write_text((folder / "lab01.ipynb").read_text() + " ")
    assert stale_notebooks(folder) == [folder / "lab01.ipynb"]
    write_notebooks(folder)
    (folder / "lab.py").write_text(SOURCE.replace("newtons", "force"))
    assert stale_notebooks(folder) == [
        folder / "solution" / "lab01.ipynb"
    ]  # the student's does not show it


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("    # END SOLUTION\n", "", "BEGIN SOLUTION and END SOLUTION once"),
        (
            'figure="line"\n',
            'figure="line"\n# BEGIN SOLUTION\n# END SOLUTION\n',
            "once in an exercise and nowhere else",
        ),
        ("def weight", "def heaviness", "expected the function or class weight"),
        ('figure="line"', 'exercise="weight"', "once in an exercise"),
        ('check="weight"', 'figure="line"', "got twice: figure line"),
        ('[markdown] answer="q1"', 'answer="q1"', "answers alone in markdown"),
    ],
)
def test_marks_that_cannot_be_meant_are_refused(folder, old, new, sentence):
    """Each fault is planted here, in one place of the source."""
    assert SOURCE.count(old) == 1
    (folder / "lab.py").write_text(SOURCE.replace(old, new))
    with pytest.raises(InputError, match=sentence):
        read_cells(folder / "lab.py")
