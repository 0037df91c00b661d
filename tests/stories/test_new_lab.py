"""CONTRIBUTING.md, section "A new lab", executed in a temporary copy of labs/_template."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from falconwing_kit.tools.grading.find import lab_folders
from tests.labs.tools import require_sandbox

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "CONTRIBUTING.md"
DEMANDS = "not points_are_75 and not route_names"  # three exercises, a row in labs/README.md

pytestmark = pytest.mark.timeout(600)


def commands() -> list[str]:
    """The shell lines of the section, in its order."""
    section = PAGE.read_text(encoding="utf-8").split("\n## A new lab\n")[1].split("\n## ")[0]
    return re.search(r"```sh\n(.*?)```", section, re.DOTALL)[1].splitlines()


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A folder with what the section uses of a checkout: the template and the labs' tests."""
    folder = tmp_path_factory.mktemp("checkout")
    ignore = shutil.ignore_patterns("__pycache__", "*.ipynb", "solution")
    shutil.copytree(ROOT / "labs" / "_template", folder / "labs" / "_template", ignore=ignore)
    shutil.copytree(ROOT / "tests" / "labs", folder / "tests" / "labs", ignore=ignore)
    shutil.copyfile(ROOT / "pyproject.toml", folder / "pyproject.toml")
    return folder


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A line of the section, run with this Python's programs and the kit of this checkout."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    return subprocess.run(
        line, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_template_is_no_lab_of_the_course():
    """`labs build`, `selftest` and `release` without a name work on numbered folders only."""
    assert ROOT / "labs" / "_template" not in lab_folders(ROOT / "labs")
    assert (ROOT / "labs" / "_template" / "checks.py").is_file()


def test_copied_template_builds_checks_and_grades_as_the_page_says(tree):
    """Every line but the last exits with 0; the last one's tests pass but for its two demands."""
    require_sandbox()
    *lines, last = commands()
    assert len(lines) >= 6 and "pytest" in last
    for line in lines:
        done = shell(line, tree)
        assert done.returncode == 0, (line, done.stdout, done.stderr)
        if "labs selftest" in line:
            assert re.search(r"lab14_gliding +100\.0 % +0\.0 %", done.stdout), done.stdout
    assert sorted(path.name for path in (tree / "labs").iterdir()) == ["_template", "lab14_gliding"]
    assert not list(tree.rglob("*.old"))
    # the temporary tests, not those of this checkout
    done = shell(
        f"PYTHONPATH=.:$PYTHONPATH {last} and {DEMANDS}".replace("-k lab14 and", "-k 'lab14 and")
        + "' -q",
        tree,
    )
    assert done.returncode == 0, done.stdout[-3000:]
    assert re.search(r"[2-9]\d passed", done.stdout), done.stdout[-500:]
