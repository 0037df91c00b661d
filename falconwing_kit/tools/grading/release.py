"""Release: labs and a roster -> a folder for students, without solutions or hidden cases.

OUT/README.md                       the route
OUT/lab01_sizing/                   notebook, given.py, checks.py, cohort.json, hints.json,
                                    quiz.json, goal.webp, data/
OUT/handouts/STUDENT/lab12_gap/     individual files of each student, for labs that have them
"""

import ast
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.collect import COURSE_KEY
from falconwing_kit.tools.grading.find import load_checks, load_module, notebook_path
from falconwing_kit.tools.grading.hints import FILE as HINTS
from falconwing_kit.tools.grading.hints_library import hints_texts, workers_for
from falconwing_kit.tools.grading.lab import Course, course_constants
from falconwing_kit.tools.grading.notebooks import GOAL, build
from falconwing_kit.tools.grading.quiz import FORM, form_text, read_quiz
from falconwing_kit.tools.grading.records import safe_file_name
from falconwing_kit.tools.grading.salt import MIN_SALT, course_mark
from falconwing_kit.tools.jobs.pool import WorkerLostError
from falconwing_kit.tools.jobs.run import parallel_map

FOLDER = "data"  # of a lab, copied to students
INSTRUCTORS = "\n## For instructors"  # the route ends here for students


def release(
    folders: Sequence[Path], out: Path, salt: str = "", students: Sequence[str] = ()
) -> list[Path]:
    """Write the students' files, complete or not at all.

    Args:
        folders: of the labs.
        out: a new or empty folder.
        salt: the course's key, which determines its constants, see `course_key`; empty for the
            open course.
        students: who get individual files.

    Returns:
        Every file that was written.

    Raises:
        InputError: `out` is not empty, the salt is short, there are students but no salt, or a lab
            cannot be used.
    """
    if out == Path():
        raise InputError("out: expected a new folder's name, got none; name one")
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise InputError(
            f"{out}: expected a new or an empty folder, so that nothing else is handed out; "
            "choose another"
        )
    if salt and len(salt) < MIN_SALT:
        raise InputError(
            f"--salt: expected at least {MIN_SALT} characters that cannot be guessed, "
            f"got {len(salt)}"
        )
    if students and not salt:
        raise InputError(
            "--roster: expected --course or --salt with it; without one every student could draw "
            "the others' files"
        )
    part = out.with_name(f".{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        hints = hints_texts(folders, salt) if salt else [_shipped_hints(each) for each in folders]
        for folder, text in zip(folders, hints, strict=True):
            _release_lab(folder, part / folder.name, salt, text)
            _release_handouts(folder, part / "handouts", salt, students)
        _write(part / "README.md", route_for_students(folders[0].parent / "README.md"))
        if out.is_dir():
            out.rmdir()
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return sorted(path for path in out.rglob("*") if path.is_file())


def route_for_students(readme: Path) -> str:
    """README.md without its part for instructors; a title where there is no README."""
    text = (
        readme.read_text(encoding="utf-8") if readme.is_file() else "# Labs of the FalconWing kit\n"
    )
    return text.split(INSTRUCTORS)[0].rstrip() + "\n"


def _shipped_hints(folder: Path) -> str:
    path = folder / HINTS
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _release_lab(folder: Path, target: Path, salt: str, hints: str) -> None:
    """Notebook, files, data and constants of one lab."""
    target.mkdir(parents=True)
    notebook = json.loads(build(folder, salt)[notebook_path(folder)])
    notebook["metadata"] |= {COURSE_KEY: course_mark(salt)} if salt else {}
    text = json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"
    _write(target / notebook_path(folder).name, text)
    shutil.copyfile(require_file(folder / "given.py"), target / "given.py")
    _write(
        target / "checks.py",
        without_answers(require_file(folder / "checks.py").read_text(encoding="utf-8")),
    )
    if (folder / GOAL).is_file():
        shutil.copyfile(folder / GOAL, target / GOAL)
    if (folder / FOLDER).is_dir():
        shutil.copytree(
            folder / FOLDER, target / FOLDER, ignore=shutil.ignore_patterns("__pycache__", ".*")
        )
    _write(target / "cohort.json", cohort_text(folder, salt))
    questions = read_quiz(folder, salt, course_constants(load_checks(folder), salt))
    if questions:
        _write(target / FORM, form_text(questions))
    if hints:
        _write(target / HINTS, hints)


def without_answers(checks: str) -> str:
    """A lab's `checks.py` with the grading criteria (third argument of `Criterion`) blanked.

    Args:
        checks: the file's text.
    """
    lines = checks.encode().splitlines(keepends=True)  # ast counts columns in bytes
    starts = [sum(map(len, lines[:number])) for number in range(len(lines))]
    spans = []
    for call in ast.walk(ast.parse(checks)):
        if (
            isinstance(call, ast.Call)
            and isinstance(call.func, ast.Name)
            and call.func.id == "Criterion"
        ):
            criteria = [
                *call.args[2:3],
                *(each.value for each in call.keywords if each.arg == "look_for"),
            ]
            for each in criteria:
                end = starts[(each.end_lineno or each.lineno) - 1] + (each.end_col_offset or 0)
                spans.append((starts[each.lineno - 1] + each.col_offset, end))
    text = checks.encode()
    for start, end in sorted(spans, reverse=True):
        text = text[:start] + b'""' + text[end:]
    return text.decode()


def cohort_text(folder: Path, salt: str = "") -> str:
    """Content of a lab's `cohort.json` for a course."""
    return json.dumps(course_constants(load_checks(folder), salt), indent=1) + "\n"


def release_lab(folder: Path, target: Path, salt: str = "") -> None:
    """Write one lab's notebook, files, data and constants, as `release` does.

    Args:
        folder: the lab's.
        target: a new folder.
        salt: the course's key; empty for the open course.
    """
    hints = hints_texts([folder], salt)[0] if salt else _shipped_hints(folder)
    _release_lab(folder, target, salt, hints)


def _release_handouts(folder: Path, target: Path, salt: str, students: Sequence[str]) -> None:
    """Individual files of each student, where the lab's `hidden.py` defines `handout`."""
    if not students:
        return
    constants = course_constants(load_checks(folder), salt)
    if not hasattr(load_module(folder, "hidden", constants), "handout"):
        return
    jobs = [(folder, target, salt, student) for student in students]
    for _, lost in parallel_map(_write_handout, jobs, workers_for(jobs)):
        if isinstance(lost, WorkerLostError):
            raise lost


def _write_handout(job: tuple[Path, Path, str, str]) -> None:
    folder, target, salt, student = job
    constants = course_constants(load_checks(folder), salt)
    place = target / safe_file_name(student) / folder.name
    shutil.rmtree(place, ignore_errors=True)  # of a process that ended
    place.mkdir(parents=True)
    handout = load_module(folder, "hidden", constants).handout
    handout(Course(constants, student, salt), place)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, text=True) as handle:
        handle.write(text)
