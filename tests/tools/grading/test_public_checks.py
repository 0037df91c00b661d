"""A check says in words what holds and what to look at, and never stops the notebook."""

import io
import json
import re
import sys

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.grading.lab import Check, Exercise
from falconwing_kit.tools.grading.notebooks import write_notebooks
from falconwing_kit.tools.grading.public_checks import (
    check,
    check_notebook,
    exercise_state,
    foreign_modules,
    run_checks,
    to_printable,
)
from tests.tools.grading.small_lab import CHECKS, SOURCE, write_small_lab


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The small lab, whose notebook runs in its folder."""
    folder = write_small_lab(tmp_path)
    monkeypatch.chdir(folder)
    return folder


def said_of(function, capsys, name="weight"):
    """What check prints about a function of this name."""
    function.__name__ = name
    assert check(function) is None
    return capsys.readouterr().out


def test_right_function_passes(folder, capsys):
    """10 m/s^2 is the small lab's number."""
    said = said_of(lambda mass: 10.0 * mass, capsys)
    assert said.startswith("✓ weight: 2 of 2 public checks passed\n")
    assert said.count("✓ passed:") == 2


def test_wrong_function_is_told_what_it_gave_and_where_to_look(folder, capsys):
    """By hand: 9 instead of 10 for 1 kg, but 0 for nothing."""
    said = said_of(lambda mass: 9.0 * mass, capsys)
    assert said.startswith("✗ weight: 1 of 2 public checks passed\n")
    assert (
        "✗ failed: 1 kg weighs what your course says\n       called with (1) it gave 9\n       "
        "multiply\n" in said
    )


def test_function_that_raises_is_told_so(folder, capsys):
    """The exception's own words: the student is at home here."""
    said = said_of(lambda mass: mass["kg"], capsys)
    assert "0 of 2" in said and "it raised TypeError: 'float' object is not subscriptable" in said


def test_function_not_written_is_no_failure(folder, capsys):
    """A student has enough of those at the start."""

    def weight(mass):
        raise NotImplementedError("write weight")

    said = said_of(weight, capsys)
    assert said == "○ weight: not written yet; 2 public checks wait for it\n"


@pytest.mark.parametrize(("value", "name"), [(3, ""), (print, ""), (lambda mass: mass, "other")])
def test_anything_else_gets_a_sentence(folder, capsys, value, name):
    """Not one of the lab's functions, or none at all."""
    if name:
        value.__name__ = name
    check(value)
    assert "expected one of the functions weight" in capsys.readouterr().out


def test_notebook_elsewhere_gets_a_sentence(tmp_path, monkeypatch, capsys):
    """Opened from a download folder, without the lab around it."""
    (tmp_path / "downloads" / "new").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "downloads" / "new")
    check(len)
    assert "expected the notebook to run in its lab's folder" in capsys.readouterr().out


def test_answer_that_cannot_be_used_fails_the_check():
    """None < 3 raises in the check, not in the function; it is the answer that is wrong."""
    exercise = Exercise("f", 1.0, (Check("small", lambda f: f(1) < 3, "return a number"),))
    (outcome,) = run_checks(exercise, lambda x: None)
    assert (
        outcome.state == "failed"
        and "it gave None, which failed in the check: TypeError" in outcome.said
    )


def test_claim_about_refusing_holds_when_the_function_raises():
    """A check may want an exception: it catches it itself."""

    def refuses(function):
        try:
            function(-1.0)
        except ValueError:
            return True
        return False

    def root(x):
        if x < 0:
            raise ValueError("expected x >= 0")
        return x**0.5

    exercise = Exercise("root", 1.0, (Check("refuses", refuses, "raise ValueError"),))
    assert exercise_state(run_checks(exercise, root)) == "passed"
    assert exercise_state(run_checks(exercise, lambda x: 0.0)) == "failed"


def test_kit_and_other_libraries_are_named_wherever_they_are_used():
    """Each helper uses what its name says; NumPy and the standard library are the grader's too."""
    space = {"np": np, "__name__": "notebook"}
    exec(
        "import math, falconwing_kit.core.frames as frames\n"
        "from matplotlib.figure import Figure\n"
        "def fine(x): return np.linalg.norm(x) + math.sqrt(2.0)\n"
        "def kit(x): return frames.rotation(x)\n"
        "def deep(x): return [kit(y) for y in x]\n"
        "def draws(x): return Figure()\n"
        "def late(x):\n    import falconwing_kit.scene\n    return fine(x)\n",
        space,
    )
    named = {
        name: foreign_modules(space[name], ("numpy",))
        for name in ("fine", "kit", "deep", "draws", "late")
    }
    assert named["fine"] == set()
    assert named["kit"] == named["deep"] == {"falconwing_kit.core.frames"}
    assert named["draws"] == {"matplotlib.figure"}
    assert named["late"] == {"falconwing_kit.scene"}


def test_terminal_without_the_symbols_gets_plain_ones(monkeypatch):
    """Windows' old code page has no check mark; a print must not fail for it."""
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="cp1252"))
    assert to_printable("✓ ✗ ○") == "+ x o"


def notebook_of(folder, weight):
    """The small lab's notebook with this body of its function; without one, as it is handed out."""
    source = (
        SOURCE
        if weight is None
        else SOURCE.replace('newtons = COHORT["gravity"] * mass\n\n', weight + "\n")
    )
    (folder / "lab.py").write_text(source)
    write_notebooks(folder)
    return folder / "solution" / "lab01.ipynb" if weight is not None else folder / "lab01.ipynb"


@pytest.mark.parametrize(
    ("body", "state", "said"),
    [
        ('newtons = COHORT["gravity"] * mass', "passed", ""),
        ("newtons = 9.0 * mass", "failed", "called with (1) it gave 9"),
        ('newtons = mass["kg"]', "failed", "called with (1) it raised TypeError"),
        ("import os; os._exit(0)", "failed", "called with (1) it ended Python"),
        ("newtons = object()", "failed", "called with (1) it returned an unsupported type"),
        (
            "from falconwing_kit.core import frames; newtons = 10.0 * mass",
            "failed",
            "raised ModuleNotFoundError",
        ),
        (None, "not written", ""),
    ],
)
def test_notebook_file_is_checked_without_being_run(folder, body, state, said):
    """By hand, as above; the kit is not there, as with the grader, and the problem says so."""
    (report,) = check_notebook(folder, notebook_of(folder, body))
    assert exercise_state(report.outcomes) == state
    assert said in report.outcomes[0].said
    assert any("falconwing_kit" in problem for problem in report.problems) == (
        "falconwing_kit" in (body or "")
    )


def test_notebook_of_an_older_kit_is_refused(folder):
    """A lab whose names changed in 0.2, and a notebook as 0.1 built it: without a version."""
    (folder / "checks.py").write_text(
        CHECKS.replace("    constants=", '    notebook_since="0.2",\n    constants=', 1)
    )
    file = notebook_of(folder, 'newtons = COHORT["gravity"] * mass')
    assert [exercise_state(report.outcomes) for report in check_notebook(folder, file)] == [
        "passed"
    ]
    text = re.sub(r"(\\n)*\*Notebook of falconwing-kit [0-9.]+\*", "", file.read_text())
    file.write_text(json.dumps(json.loads(text) | {"metadata": {}}))
    with pytest.raises(
        InputError,
        match=r"^lab01\.ipynb: expected a notebook of falconwing-kit 0\.2, got one of 0\.1",
    ):
        check_notebook(folder, file)


def test_function_that_ends_the_process_costs_the_others_nothing(folder):
    """Two functions, the first of which ends Python: the second still passes, in a new process."""
    block = CHECKS[CHECKS.index("        Exercise(") : CHECKS.index("    ),\n    (Criterion")]
    (folder / "checks.py").write_text(
        CHECKS.replace(block, block + block.replace("weight", "lift"))
    )
    cells = SOURCE[SOURCE.index('# %% exercise="weight"') : SOURCE.index("# %% figure")]
    ends = cells.replace('COHORT["gravity"] * mass', "__import__('os')._exit(1)")
    (folder / "lab.py").write_text(SOURCE.replace(cells, ends + cells.replace("weight", "lift")))
    write_notebooks(folder)
    weight, lift = check_notebook(folder, folder / "solution" / "lab01.ipynb")
    assert [outcome.said for outcome in weight.outcomes] == [
        "called with (1) it ended Python",
        "called with (0) it ended Python",
    ]
    assert exercise_state(lift.outcomes) == "passed"


def test_verb_says_progress_in_words_and_by_its_exit_code(folder, capsys):
    """0 where every exercise passes, else 1; the small lab has one."""
    assert (
        main(
            [
                "check",
                "lab01",
                "--notebook",
                str(notebook_of(folder, 'newtons = COHORT["gravity"] * mass')),
            ]
        )
        == 0
    )
    assert "1 of 1 exercises pass their public checks, 0 not started" in capsys.readouterr().out
    notebook_of(folder, None)
    assert main(["check", "lab01"]) == 1
    said = capsys.readouterr().out
    assert (
        "○ not written  weight" in said
        and "0 of 1 exercises pass their public checks, 1 not started" in said
    )
    assert main(["check", "lab01", "--notebook", "nowhere.ipynb"]) == 2
    assert main(["check", "lab02"]) == 2
