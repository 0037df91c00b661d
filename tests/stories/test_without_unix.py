"""What students run needs no module that Windows lacks: fcntl, resource, pty, termios.

This is no Windows: asyncio and pyserial, which have other code there, are loaded before the modules
are blocked, and paths stay POSIX.
"""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
UNIX = ("fcntl", "grp", "pty", "pwd", "resource", "termios")
BLOCKED = f"""
import asyncio, json, subprocess, sys
for name in {UNIX}:
    sys.modules[name] = None  # importing it raises ModuleNotFoundError, as on Windows
"""
VERBS = (
    BLOCKED
    + """
from falconwing_kit.tools.cli.main import main

if __name__ == "__main__":
    codes = []
    for words in json.loads(sys.argv[1]):
        try:
            codes.append(main(words))
        except SystemExit as end:
            codes.append(end.code)
    print("codes", codes)
"""
)
LABS = (
    BLOCKED
    + """
from pathlib import Path
import falconwing_kit.control, falconwing_kit.flight, falconwing_kit.gap, falconwing_kit.scene
import falconwing_kit.sysid, falconwing_kit.trainer_port, falconwing_kit.vision
from falconwing_kit.tools.grading.find import lab_folders, load_checks, notebook_path
import falconwing_kit.tools.grading.course.figures  # of reports; it runs on Linux only

folders = lab_folders(Path(sys.argv[1]))
print("labs", [load_checks(folder).name for folder in folders])
"""
)


def run(code: str, folder: Path, argument: object) -> str:
    """What a program prints on standard output."""
    (folder / "program.py").write_text(code)
    argument = argument if isinstance(argument, str) else json.dumps(argument)
    done = subprocess.run(
        [sys.executable, "program.py", argument], cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_students_verbs_run_without_unix(tmp_path):
    """One process for all: each ends with 0, and the flight lands."""
    solution = str(ROOT / "labs" / "lab01_sizing" / "solution" / "lab01.ipynb")
    verbs = [
        ["size"],
        ["fly", "--headless", "--no-render"],
        ["identify", "--help"],
        ["gap", "--help"],
        ["demo", "--help"],
        ["scene", "info", "hall"],
        ["bridge", "--port", "sim-python", "--seconds", "0.2"],
        ["check", "lab01", "--labs", str(ROOT / "labs"), "--notebook", solution],
    ]
    printed = run(VERBS, tmp_path, verbs)
    assert f"codes {[0] * len(verbs)}" in printed
    assert "success: 1 of 1" in printed and "4 of 4 exercises" in printed


def test_labs_load_without_unix(tmp_path):
    """The rooms that labs import, and the checks of all."""
    assert f"labs {[f'lab{n:02}' for n in range(1, 14)]}" in run(LABS, tmp_path, str(ROOT / "labs"))


@pytest.mark.parametrize("folder", ["falconwing_kit", "labs"])
def test_no_file_imports_them_at_its_top(folder):
    """The syntax tree of every file: such an import stands in the function that is Linux's."""
    found = []
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            found += [f"{path.name}: {name}" for name in names if name in UNIX]
    assert found == []
