"""falconwing labs: builds, hands out and tries labs, and says by its exit code whether they are as
they should be.
"""

import json

import pytest

from falconwing_kit.tools.cli.main import main
from tests.labs.tools import require_sandbox
from tests.tools.grading.small_lab import SOURCE, write_small_lab


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The small lab, below the folder that the command is typed in."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "labs").mkdir()
    return write_small_lab(tmp_path / "labs")


def test_build_writes_what_check_missed(folder, capsys):
    """Stale is 1; built is 0, and then nothing is stale."""
    assert main(["labs", "build", "--check"]) == 1
    assert "2 stale notebooks" in capsys.readouterr().out and not (folder / "lab01.ipynb").exists()
    assert main(["labs", "build", "lab01"]) == 0
    assert (folder / "lab01.ipynb").is_file() and (folder / "solution" / "lab01.ipynb").is_file()
    capsys.readouterr()
    assert main(["labs", "build", "--check", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"lab01_small": []}


def test_release_says_what_to_keep(folder, tmp_path, capsys):
    """With a salt and a roster: the lab, and a file of each student's own."""
    (tmp_path / "roster.csv").write_text("student\nann\nbo\n")
    assert (
        main(["labs", "release", "out", "--salt", "long enough to keep", "--roster", "roster.csv"])
        == 0
    )
    said = capsys.readouterr().out
    assert "2 students" in said and "keep the salt" in said
    assert (tmp_path / "out" / "handouts" / "bo" / "lab01_small" / "mine.txt").is_file()
    assert main(["labs", "release", "out"]) == 2
    assert "expected a new or an empty folder" in capsys.readouterr().err


def test_selftest_finds_a_wrong_solution(folder, capsys):
    """The small lab is fine; with another factor its solution loses every case."""
    require_sandbox()
    main(["labs", "build"])
    capsys.readouterr()
    assert main(["labs", "selftest"]) == 0
    assert "100.0 %" in capsys.readouterr().out
    (folder / "lab.py").write_text(SOURCE.replace("* mass\n", "* mass / 2\n"))
    main(["labs", "build"])
    capsys.readouterr()
    assert main(["labs", "selftest", "lab01", "--json"]) == 1
    (lab,) = json.loads(capsys.readouterr().out)["labs"]
    assert lab["solution"] == {"weight": 0.0}
    assert lab["problems"] == ["weight fails: wrong value in 10 of 10 cases"]


def test_unknown_lab_and_missing_labs_are_wrong_use(folder, tmp_path, capsys):
    """2 and a sentence, as for every verb."""
    assert main(["labs", "build", "lab09"]) == 2
    assert main(["labs", "build", "--labs", str(tmp_path)]) == 2
    assert "expected one of lab01_small" in capsys.readouterr().err
