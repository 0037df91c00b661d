"""How-tos of manual/extend.md: their files, written into a copy of the kit, pass their tests."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "manual" / "extend.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (A new \w+)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
FILES = {
    title: re.findall(r"^`([\w/.]+\.py)`\n\n```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    for title, text in SECTIONS.items()
}


def test_the_page_has_four_how_tos():
    """Effect, manoeuvre and verb with a file and its test each; the lab has a story of its own."""
    assert list(SECTIONS) == ["A new effect", "A new manoeuvre", "A new verb", "A new lab"]
    assert [len(files) for files in FILES.values()] == [2, 2, 2, 0]
    assert (ROOT / "tests" / "stories" / "test_new_lab.py").is_file()


@pytest.mark.parametrize("title", [title for title, files in FILES.items() if files])
def test_a_how_to_works_as_written(title, tmp_path):
    """Two files beside an untouched kit; without the first of them the test of the second fails."""
    for folder in ("falconwing_kit", "hardware"):  # the airframe's file lies in hardware
        skipped = shutil.ignore_patterns("__pycache__", "*.step", "*.stl", "*.png")
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=skipped)
    (addition, code), (test, checks) = FILES[title]
    assert not (ROOT / addition).exists()
    for name, text in ((addition, code), (test, checks)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert run_test(tmp_path, test) == 0
    (tmp_path / addition).unlink()
    assert run_test(tmp_path, test) != 0


def run_test(folder: Path, test: str) -> int:
    """The exit code of pytest on one file, with the kit of that folder."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--import-mode=importlib",
        test,
    ]
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, timeout=250, check=False
    ).returncode
