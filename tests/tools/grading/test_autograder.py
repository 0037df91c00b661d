"""Autograder: the zip for Gradescope grades a hand-in in folders like its container's."""

import json
import subprocess
import sys
import zipfile

import pytest

from falconwing_kit.tools.cli.labs import Autograder
from falconwing_kit.tools.grading.salt import stretch
from tests.tools.grading import toys
from tests.tools.grading.small_lab import write_small_lab

SALT = "a secret of ours, long enough"
DONE = ("from given import COHORT", "def weight(mass):\n    return COHORT['gravity'] * mass")


@pytest.fixture
def container(tmp_path):
    """Gradescope's folders with the unpacked zip; the sandbox has tests of its own."""
    write_small_lab(tmp_path)
    verb = Autograder(tmp_path / "a.zip", "lab01", salt=SALT, unsafe_no_sandbox=True, labs=tmp_path)
    assert verb.run() == 0
    root = tmp_path / "autograder"
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        archive.extractall(root / "source")
        assert archive.getinfo("run_autograder").external_attr >> 16 == 0o755
    (root / "submission").mkdir()
    metadata = {"users": [{"email": "ada@uni.edu", "name": "Ada", "sid": "1"}]}
    (root / "submission_metadata.json").write_text(json.dumps(metadata))
    return root


def run(root):
    """As `run_autograder` does: with the zip's kit only."""
    return subprocess.run(
        [sys.executable, "-m", "falconwing_kit.tools.grading.course.autograder", str(root)],
        env={"PYTHONPATH": str(root / "source"), "PATH": "/usr/bin:/bin", "HOME": str(root)},
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_zip_grades_by_itself(container):
    """By hand: 75 points in the course's numbers, none for another lab's notebook, with a word.

    The secret itself is not in the zip, only what is stretched from it.
    """
    file = container / "submission" / "work.ipynb"
    for cells, score, said in ((DONE, 75.0, ""), (["x = 1"], 0.0, "none of its functions")):
        file.write_bytes(toys.notebook_bytes(*cells))
        done = run(container)
        assert done.returncode == 0, done.stderr
        results = json.loads((container / "results" / "results.json").read_text())
        assert results["score"] == score and said in results["output"]
    assert (container / "source" / "key.txt").read_text() == stretch(SALT)


def test_what_cannot_be_graded_has_no_result(container):
    """Two notebooks are one student's there; a broken judge fails, and Gradescope shows that."""
    (container / "submission" / "work.ipynb").write_bytes(toys.notebook_bytes(*DONE))
    (container / "submission" / "plan.pdf").write_bytes(b"%PDF")
    hidden = container / "source" / "labs" / "lab01_small" / "hidden.py"
    hidden.write_text(hidden.read_text().replace('COHORT["gravity"] * mass', "1 / 0"))
    done = run(container)
    assert done.returncode == 1 and "the judge's reference failed" in done.stderr
    assert not (container / "results" / "results.json").exists()
