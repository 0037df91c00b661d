"""Inspection: one submission, with the student's own files, and without the cells' metadata."""

import pytest

from falconwing_kit.tools.grading.course import looks
from falconwing_kit.tools.grading.course.figures import missing_for_running
from falconwing_kit.tools.grading.course.looks import (
    InspectionTask,
    ReportContext,
    RubricPart,
    inspect_submission,
    rubric_parts,
)
from falconwing_kit.tools.grading.submissions import find_submissions
from tests.tools.grading import small_lab, toys
from tests.tools.grading.test_figures import DRAW, b64, png

SALT = "a secret of the tests"
MINE = """from pathlib import Path
assert Path('data/mine/mine.txt').read_text() == 'ada a secret of the tests'
"""


@pytest.fixture
def lab(tmp_path):
    """The small lab, with both notebooks."""
    from falconwing_kit.tools.grading.notebooks import write_notebooks

    pytest.importorskip("jupytext")
    folder = small_lab.write_small_lab(tmp_path / "labs")
    write_notebooks(folder)
    return folder


def seen(tmp_path, context, *cells, failed=()):
    (tmp_path / "ada.ipynb").write_bytes(toys.notebook_bytes(*cells))
    (submission,) = find_submissions(tmp_path / "ada.ipynb", "lab01")
    return inspect_submission(InspectionTask(submission, failed), context)


def test_parts_and_questions_are_those_of_the_notebook(lab):
    """As the small lab's source has them: the question stands in the cell before the answer."""
    assert rubric_parts(lab) == [RubricPart("line", True, ""), RubricPart("q1", False, "Why?")]


@toys.needs_sandbox
@pytest.mark.skipif(bool(missing_for_running()), reason='pip install -e ".[labs]"')
def test_own_files_lie_where_the_student_put_them(lab, tmp_path):
    """What `labs release --roster` gave this student in this course.

    The cell draws only if it reads just that.
    """
    found = seen(tmp_path, ReportContext(lab, SALT), toys.cell(MINE + DRAW, figure="line"))
    assert (
        found["figures"]["line"]["from"] == "run" and len(found["figures"]["line"]["images"]) == 1
    )


def test_without_marks_all_figures_are_shown(lab, tmp_path):
    """Some programs drop a cell's metadata: then all stored figures are shown, with a note."""
    stored = toys.cell("1") | {"outputs": [{"data": {"image/png": b64(png())}}]}
    found = seen(tmp_path, ReportContext(lab, run=False, sandboxed=False), stored)
    assert found["figures"]["line"] == {"images": [b64(png())], "from": "not run, all"}
    assert found["answers"] == {"q1": ""} and found["checks"] == {}


def test_answer_as_handed_out_is_none(lab, tmp_path):
    """What stood there before the student wrote is no answer; what was added below it is."""
    context = ReportContext(lab, run=False, sandboxed=False)
    text = toys.cell("*Your answer:*", "markdown", answer="q1")
    assert seen(tmp_path, context, text)["answers"] == {"q1": ""}
    text = toys.cell("*Your answer:* the Earth\n", "markdown", answer="q1")
    assert seen(tmp_path, context, text)["answers"] == {"q1": "the Earth"}


@toys.needs_sandbox
def test_checks_are_those_of_the_course(lab, tmp_path):
    """In a salted course the function that multiplies by its gravity passes.

    One with the open number fails.
    """
    right = 'from given import COHORT\ndef weight(mass):\n    return COHORT["gravity"] * mass'
    states = {}
    for name, text in (
        ("right", right),
        ("open", "def weight(mass):\n    return 10.0 * mass"),
        ("none", "x = 1"),
    ):
        found = seen(tmp_path, ReportContext(lab, SALT, run=False), text, failed=("weight",))
        states[name] = [state for _, state, *_ in found["checks"]["weight"]]
    assert states["right"] == ["passed", "passed"]
    assert states["open"] == ["failed", "passed"]
    assert states["none"] == ["not written"] * 2


def test_what_cannot_be_read_is_said(lab, tmp_path):
    """A damaged notebook stops nothing."""
    (tmp_path / "ada.ipynb").write_bytes(b"{")
    (submission,) = find_submissions(tmp_path / "ada.ipynb", "lab01")
    found = inspect_submission(InspectionTask(submission), ReportContext(lab))
    assert "expected a Jupyter notebook" in found["problem"] and found == looks.empty_inspection(
        found["problem"]
    )


def test_mended_lab_is_looked_at_again(lab):
    """Another hint in checks.py is another lab to whoever keeps results.

    The instructor's own notes are not.
    """
    before = looks.lab_fingerprint(lab)
    (lab / "notes.md").write_text("new notes")
    assert looks.lab_fingerprint(lab) == before
    (lab / "checks.py").write_text(
        (lab / "checks.py").read_text().replace("multiply", "multiply by it")
    )
    assert looks.lab_fingerprint(lab) != before
