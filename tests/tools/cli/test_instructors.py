"""The instructor's guide is true: its commands have the verbs and options that they name, and its
files are there.
"""

import re
import shlex
from pathlib import Path

import pytest

from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.grading.collect import read_notebook
from falconwing_kit.tools.grading.course.looks import rubric_parts
from falconwing_kit.tools.grading.find import lab_folders, load_checks, notebook_path

LABS = Path(__file__).parents[3] / "labs"
GUIDE, PLANS, ROUTE = (
    (LABS / name).read_text("utf-8") for name in ("instructors.md", "course_plans.md", "README.md")
)
FENCED = "\n".join(re.findall(r"^```sh\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL))
COMMANDS = [line for line in FENCED.splitlines() if line.startswith("falconwing ")]


@pytest.mark.parametrize("line", COMMANDS)
def test_command_has_the_options_that_it_names(line, capsys):
    """Against the verb's own help."""
    words = shlex.split(line)[1:]
    step = words[:2] if words[0] == "labs" else words[:1]
    with pytest.raises(SystemExit) as end:
        main([*step, "--help"])
    assert end.value.code == 0
    known = set(re.findall(r"--[a-z][a-z-]+", capsys.readouterr().out))
    assert {word for word in words if word.startswith("--")} <= known


def test_every_step_is_told():
    """From the probe to the exports, and what no box stops."""
    assert {line.split()[1] for line in COMMANDS} == {
        "doctor",
        "sandbox",
        "labs",
        "grade",
        "report",
    }
    for word in (
        "--regrade",
        "--resume",
        "--cluster",
        "--before",
        "--figures stored",
        "rubric.html",
        "Privacy",
    ):
        assert word in GUIDE
    links = re.findall(r"\]\(([^)#]+)\)", GUIDE + PLANS)
    assert [
        link for link in links if not link.startswith("http") and not (LABS / link).exists()
    ] == []


def test_plans_add_up_to_the_labs_own_hours():
    """Each plan's hours against those that the labs say: all of them, and the route's core."""
    hours = {int(folder.name[3:5]): load_checks(folder).hours for folder in lab_folders(LABS)}
    core = {int(n) for n in re.findall(r"^\| (\d+) `.*\| yes \|$", ROUTE, re.MULTILINE)}
    for title, wanted in (("## Twelve", set(hours)), ("## Six", core)):
        rows = re.findall(
            r"^\| \d+ \| (.*?) \| ([\d.]+) \|",
            PLANS.split(title)[1].split("\n## ")[0],
            re.MULTILINE,
        )
        told = [[int(n) for n in re.findall(r"(\d+) [A-Z]", labs)] for labs, _ in rows]
        assert {n for labs in told for n in labs} == wanted
        for labs, said in zip(told, (float(said) for _, said in rows), strict=True):
            assert said == pytest.approx(sum(hours[n] for n in labs), abs=0.01), labs


@pytest.mark.parametrize("folder", lab_folders(LABS), ids=lambda folder: folder.name)
def test_whatever_a_person_grades_is_a_cell_of_the_notebook(folder):
    """Otherwise the rubric page would show nothing beside its field; an answer's question stands
    before it.
    """
    marked = {
        cell.name
        for cell in read_notebook(notebook_path(folder)).cells
        if cell.role in ("figure", "answer")
    }
    parts = rubric_parts(folder)
    assert {part.name for part in parts} <= marked
    assert all(part.is_figure or part.question for part in parts) and any(
        part.is_figure for part in parts
    )
