"""Every lab is complete: its files, points, notebooks that match the source, no leaked solution."""

import ast
import json
import re
import sys
from pathlib import Path

import pytest
from PIL import Image

from falconwing_kit.tools.grading.find import lab_folders, load_checks, load_judges, notebook_path
from falconwing_kit.tools.grading.lab import Course, course_constants
from falconwing_kit.tools.grading.notebooks import read_cells, stale_notebooks
from falconwing_kit.tools.grading.release import release

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = lab_folders(ROOT / "labs")
FILES = ("lab.py", "given.py", "checks.py", "hidden.py", "cohort.json", "notes.md")

pytestmark = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)


@pytest.fixture
def lab(folder):
    """What the lab's checks.py says."""
    return load_checks(folder)


def test_files_are_there_and_small(folder, lab):
    """A lab's files by name; a megabyte of data is what a clone may carry for one lab."""
    assert [name for name in FILES if not (folder / name).is_file()] == []
    assert folder.name.split("_")[0] == lab.name
    data = [path.stat().st_size for path in (folder / "data").rglob("*") if path.is_file()]
    assert sum(data) < 1.5e6
    assert not data or (folder / "make_data.py").is_file()


def test_notebooks_are_what_the_source_says(folder):
    """Both are built, never edited: `falconwing labs build` mends it."""
    assert stale_notebooks(folder) == []


def test_points_are_75_and_25(lab):
    """75 of the machine and 25 of a person, three to seven exercises.

    Facts of the course, from its plan.
    """
    assert sum(exercise.points for exercise in lab.exercises) == 75.0
    assert sum(criterion.points for criterion in lab.rubric) == 25.0
    assert 3 <= len(lab.exercises) <= 7
    assert 0.5 <= lab.hours <= 6.0


def test_notebook_asks_for_what_the_checks_know(folder, lab):
    """Each exercise has its check, each criterion its figure or answer, under the same names."""
    cells = read_cells(folder / "lab.py")
    named = {
        kind: [cell.name for cell in cells if cell.kind == kind]
        for kind in ("exercise", "check", "figure", "answer")
    }
    assert named["exercise"] == named["check"] == [exercise.name for exercise in lab.exercises]
    assert sorted(named["figure"] + named["answer"]) == sorted(
        criterion.name for criterion in lab.rubric
    )


def test_solutions_are_short(folder, lab):
    """Up to 25 lines are a student's to write, 30 to 80 where the structure is free.

    Blank lines and comments do not count.
    """
    for cell in read_cells(folder / "lab.py"):
        if cell.kind == "exercise":
            inside = cell.text.split("# BEGIN SOLUTION")[1].split("# END SOLUTION")[0]
            lines = [
                line
                for line in inside.splitlines()
                if line.strip() and not line.strip().startswith("#")
            ]
            low, high = (30, 80) if lab.exercise(cell.name).free else (1, 25)
            assert low <= len(lines) <= high, (cell.name, len(lines))


def test_first_cell_says_what_when_and_how_long(folder):
    """A student knows before the start: what is learnt, the time, what is needed before."""
    title = read_cells(folder / "lab.py")[0]
    assert title.markdown and title.text.startswith("# ")
    assert all(
        re.search(word, title.text, re.IGNORECASE) for word in ("time", "before", "able to|goals")
    )


def test_route_names_the_lab_and_its_hours(folder, lab):
    """One row of labs/README.md: number, folder, and the hours that its checks.py says."""
    rows = [
        line.split("|")
        for line in (ROOT / "labs" / "README.md").read_text(encoding="utf-8").splitlines()
    ]
    (row,) = [row for row in rows if len(row) > 4 and f"`{folder.name}`" in row[1]]
    assert row[1].split()[0] == str(int(lab.name[3:]))
    assert float(row[3]) == lab.hours


def test_every_check_has_a_claim_and_a_hint(lab):
    """At least two per function, with distinct claims and a hint each."""
    for exercise in lab.exercises:
        claims = [check.claim for check in exercise.checks]
        assert len(set(claims)) == len(claims) >= 2, exercise.name
        assert all(len(check.hint) > 10 for check in exercise.checks), exercise.name


def test_given_imports_what_the_box_has(folder, lab):
    """The standard library, NumPy and what the lab asks for.

    Functions that draw for the notebook may load more.
    """
    tree = ast.parse((folder / "given.py").read_text(encoding="utf-8"))
    assert imported(tree.body) <= {"numpy", *lab.packages}
    assert imported(ast.walk(tree)) <= {
        "numpy",
        *lab.packages,
        "scipy",
        "matplotlib",
        "PIL",  # comes with matplotlib
        "falconwing_kit",
    }


def imported(nodes):
    """Names of the libraries that statements import, the standard one left out."""
    names = []
    for node in nodes:
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
    return {name.split(".")[0] for name in names} - sys.stdlib_module_names


def test_numbers_of_the_course_are_the_open_ones_and_change_with_a_salt(folder, lab):
    """cohort.json holds the middle of each range; another salt gives other numbers within it."""
    ours = json.loads((folder / "cohort.json").read_text(encoding="utf-8"))
    assert ours == course_constants(lab, "") and ours
    salted = course_constants(lab, "a secret")
    assert salted != ours
    assert all(low <= salted[name] <= high for name, (low, high, _) in lab.constants.items())


def test_every_exercise_has_its_judges(folder, lab):
    """Three hidden cases or more each, so that a lucky one is worth little."""
    judges = load_judges(folder, Course(course_constants(lab, "")))
    for name, several in judges.items():
        assert (
            sum(getattr(judge, "cases", 0) + getattr(judge, "trials", 0) for judge in several) >= 3
        ), name


def test_goal_picture_stands_at_the_top_and_goes_along(folder, tmp_path):
    """At most 60 kB, with words; found from both notebooks, and in the students' folder."""
    names = re.findall(r"!\[[^\]]{30,}\]\(([^)]+)\)", read_cells(folder / "lab.py")[0].text)
    if not names and not (folder / "goal.webp").exists():  # begun from the template
        return
    (name,) = names
    assert 4_000 < (folder / name).stat().st_size <= 60_000
    with Image.open(folder / name) as picture:
        assert picture.format == "WEBP" and 300 <= picture.width <= 900
    for solution in (False, True):
        path = notebook_path(folder, solution=solution)
        title = "".join(json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"])
        (shown,) = re.findall(r"\]\(([^)]*goal[^)]*)\)", title)
        assert (path.parent / shown).resolve() == (folder / name).resolve()
    release([folder], tmp_path / "out")
    copied = tmp_path / "out" / folder.name / name
    assert copied.read_bytes() == (folder / name).read_bytes()


def test_release_holds_no_solution_no_hidden_case_and_no_notes(folder, tmp_path):
    """No line that occurs only between solution markers may occur in a released file."""
    files = release([folder], tmp_path / "out")
    names = {
        path.relative_to(tmp_path / "out" / folder.name).parts[0]
        for path in files
        if folder.name in path.parts
    }
    plain = {"given.py", "checks.py", "cohort.json", "hints.json", "quiz.json", "data", "goal.webp"}
    assert names <= {notebook_path(folder).name, *plain}
    secret, shown = set(), set()
    for cell in read_cells(folder / "lab.py"):
        hidden = cell.text if cell.solution_only or cell.kind == "answer" else ""
        if cell.kind == "exercise":
            before, rest = cell.text.split("# BEGIN SOLUTION")
            hidden, after = rest.split("# END SOLUTION")
            shown |= set(map(str.strip, (before + after).splitlines()))
        elif not hidden:
            shown |= set(map(str.strip, cell.text.splitlines()))
        secret |= {line.strip() for line in hidden.splitlines() if len(line.strip()) >= 24}
    assert len(secret - shown) >= 4
    for path in files:
        text = path.read_bytes().decode("utf-8", "replace").replace('\\"', '"')
        assert [line for line in secret - shown if line in text] == [], path.name
