"""Autograder: a lab and a course -> the zip that Gradescope runs on each hand-in, and that run.

The zip holds the kit, the lab with its hidden cases, the course's key and roster; Gradescope keeps
it from students. In its container the zip's files lie in ROOT/source, a hand-in in ROOT/submission,
and the result is expected in ROOT/results/results.json.
"""

import io
import json
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import falconwing_kit
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, read_text, shipped_path
from falconwing_kit.tools.grading.course.feedback import result_text
from falconwing_kit.tools.grading.course.gradebook import (
    GradebookEntry,
    ManualGrade,
    gradescope_results,
)
from falconwing_kit.tools.grading.find import load_checks
from falconwing_kit.tools.grading.judge import Assignment, GradingTask, grade_submission
from falconwing_kit.tools.grading.quiz import SOURCE
from falconwing_kit.tools.grading.roster import ROSTER_FILE, Matcher, read_roster
from falconwing_kit.tools.grading.rules import read_rules
from falconwing_kit.tools.grading.sandbox.probe import open_holes, probe_sandbox
from falconwing_kit.tools.grading.submissions import find_one

SETTINGS, KEY = "settings.json", "key.txt"
_LAB_FILES = ("given.py", "checks.py", "hidden.py", "cohort.json", "quiz.toml")
_SETUP = """#!/usr/bin/env bash
set -euo pipefail
apt-get update -qq
apt-get install -y -qq --no-install-recommends bubblewrap python3 python3-venv
python3 -m venv /autograder/environment
/autograder/environment/bin/pip install -q -r /autograder/source/requirements.txt
"""
_RUN = """#!/usr/bin/env bash
set -euo pipefail
export PYTHONPATH=/autograder/source
module=falconwing_kit.tools.grading.course.autograder
exec /autograder/environment/bin/python -m "$module" /autograder
"""
# what grading imports; hidden cases use the kit's own models
_REQUIREMENTS = ("numpy>=2.0", "scipy>=1.15", "numba>=0.61", "control>=0.10.1", "jinja2>=3.1")


def write_autograder(
    path: Path, folder: Path, key: str, course: Path | None, *, sandboxed: bool
) -> None:
    """Write the zip.

    Args:
        path: of the zip.
        folder: of the lab.
        key: of the course; empty for the open course.
        course: its folder, for the roster; None for none.
        sandboxed: refuse to grade where the container allows no sandbox.
    """
    settings = {
        "lab": folder.name,
        "sandboxed": sandboxed,
        "quiz_points": read_rules(course).quiz_points if (folder / SOURCE).is_file() else 0.0,
    }
    texts = {
        "setup.sh": _SETUP,
        "run_autograder": _RUN,
        "requirements.txt": "\n".join([*_REQUIREMENTS, *_torch(folder)]) + "\n",
        SETTINGS: json.dumps(settings) + "\n",
        KEY: key,
    }
    if course is not None and (course / ROSTER_FILE).exists():
        texts[ROSTER_FILE] = read_text(course / ROSTER_FILE)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            info.external_attr = (0o755 if "." not in name or name.endswith(".sh") else 0o644) << 16
            archive.writestr(info, text)
        for file, name in (*_kit_files(), *_lab_files(folder)):
            archive.write(file, name)
    with atomic_write(path) as handle:
        handle.write(content.getvalue())


def _torch(folder: Path) -> list[str]:
    return ["torch"] if "torch" in load_checks(folder).packages else []


def _kit_files() -> Iterator[tuple[Path, str]]:
    kit = Path(falconwing_kit.__file__).resolve().parent
    hardware = shipped_path("hardware/airframe_umx.toml", "install the kit again").parent
    for root, files in ((kit, kit.rglob("*")), (hardware, hardware.glob("*.toml"))):
        for file in sorted(files):
            if file.is_file() and "__pycache__" not in file.parts:
                yield file, f"{root.name}/{file.relative_to(root).as_posix()}"


def _lab_files(folder: Path) -> Iterator[tuple[Path, str]]:
    files = [folder / name for name in _LAB_FILES]
    files += sorted((folder / "data").rglob("*"))
    for file in files:
        if file.is_file() and "__pycache__" not in file.parts:
            yield file, f"labs/{folder.name}/{file.relative_to(folder).as_posix()}"


def grade_in_container(root: Path) -> int:
    """Grade the hand-in of a container and write `results.json`.

    Returns:
        0; 1 if it could not be graded, which Gradescope then shows: no result, no points.

    Raises:
        InputError: the zip is incomplete, or a sandbox is required and there is none.
    """
    source = root / "source"
    settings = json.loads(read_text(source / SETTINGS))
    folder, key = source / "labs" / settings["lab"], read_text(source / KEY).strip()
    if settings["sandboxed"] and (holes := open_holes(probe_sandbox())):
        raise InputError(
            f"sandbox: expected it closed, got {'; '.join(holes)}; grade on your own machine, or "
            "make the zip with --unsafe-no-sandbox and accept that points can be forged"
        )
    lab = load_checks(folder)
    student = _student(root, source / ROSTER_FILE)
    submission = find_one(root / "submission", lab.name, student)
    assignment = Assignment(folder, key, key, settings["sandboxed"])
    record = grade_submission(GradingTask(submission), assignment)
    if record["status"] == "error":
        print(f"{student}: {record['problem']}", file=sys.stderr)
        return 1
    entry = GradebookEntry(lab, student, record, ManualGrade(), settings["quiz_points"])
    said = {name: result_text(each) for name, each in record["exercises"].items()}
    (root / "results").mkdir(exist_ok=True)
    with atomic_write(root / "results" / "results.json", text=True) as handle:
        handle.write(json.dumps(gradescope_results(entry, said), indent=1) + "\n")
    return 0


def _student(root: Path, roster: Path) -> str:
    """The roster's id of who handed in, by Gradescope's metadata; else the email address."""
    users: list[dict[str, Any]] = []
    file = root / "submission_metadata.json"
    if file.exists():
        users = json.loads(read_text(file)).get("users") or []
    user = {name: str(value or "") for name, value in (users[0] if users else {}).items()}
    who = user.get("email") or user.get("name") or "student"
    if not roster.exists():
        return who
    found = Matcher(read_roster(roster)).find(
        [user.get("name", "")], [user.get("email", ""), user.get("sid", "")]
    )
    return found.pop() if len(found) == 1 else who


if __name__ == "__main__":
    try:
        sys.exit(grade_in_container(Path(sys.argv[1])))
    except (InputError, FileNotFoundError) as error:
        sys.exit(str(error))
