"""An exercise may be a class: it is collected, checked and run in the sandbox as a function is."""

import numpy as np
import pytest

from falconwing_kit.tools.grading.collect import collect_source, parse_notebook
from falconwing_kit.tools.grading.find import importable_given
from falconwing_kit.tools.grading.hints_library import ExerciseHere, candidates
from falconwing_kit.tools.grading.lab import Check, Exercise
from falconwing_kit.tools.grading.public_checks import exercise_state, foreign_modules, run_checks
from falconwing_kit.tools.grading.sandbox.host import (
    SandboxJob,
    StudentError,
    process_worker,
    sandbox_worker,
)
from tests.labs.functions import ROOT, LabHere
from tests.tools.grading import toys

UNWRITTEN = '''class Counter:
    """Counts.

    .add(n) adds and returns the sum.
    """

    def __init__(self):
        raise NotImplementedError("write Counter")
'''
WRITTEN = """class Counter:
    step = STEP

    def __init__(self):
        self.sum = 0

    def add(self, n):
        self.sum += _scaled(n)
        return self.sum
"""
HELPERS = ("STEP = 2", "def _scaled(n):\n    return Counter.step * n", "def other(): pass")


def collected(*cells):
    return collect_source(parse_notebook(toys.notebook_bytes(*cells), "a.ipynb"), "Counter")


@pytest.mark.parametrize("order", [(UNWRITTEN, WRITTEN), (WRITTEN, UNWRITTEN)])
def test_the_written_class_counts_wherever_it_stands(order):
    """As of functions: the handed-out stub is no second definition. By hand 2 * 3 + 2 * 4 = 14."""
    source = collected(*HELPERS, *order)
    assert source.problems == () and "other" not in source.text
    space = {}
    exec(source.text, space)
    counter = space["Counter"]()
    assert (counter.add(3), counter.add(4)) == (6, 14)


def test_a_class_with_one_written_method_is_no_stub():
    """Half a class is the student's: it must not vanish behind an older one."""
    half = UNWRITTEN + "\n    def add(self, n):\n        return n\n"
    assert "return n" in collected(UNWRITTEN, half).text


def test_an_unwritten_class_is_reported_as_not_written():
    """Its first object raises NotImplementedError; a wrong class fails."""
    check = Check("3 gives 6", lambda add: add(3) == 6, "add up what comes in")
    exercise = Exercise("Counter", 1.0, (check,), through="run", free=True)
    states = []
    for text in (UNWRITTEN, WRITTEN.replace("STEP", "2"), WRITTEN.replace("STEP", "3")):
        space = {"_scaled": lambda n: 2 * n}
        exec(text, space)
        outcomes = run_checks(exercise, lambda n, space=space: space["Counter"]().add(n))
        states.append(exercise_state(outcomes))
    assert states == ["not written", "passed", "passed"]


def test_libraries_of_methods_properties_and_bases_are_named():
    """Each class uses what its name says; the grader has NumPy alone."""
    space = {"np": np, "__name__": "notebook"}
    exec(
        "from matplotlib.figure import Figure\n"
        "import falconwing_kit.core.frames as frames\n"
        "class Fine:\n    def a(self): return np.ones(3)\n"
        "class Draws(Fine):\n    def b(self): return Figure()\n"
        "class Kit(Fine):\n    @property\n    def c(self): return frames\n"
        "class Child(Draws):\n    pass\n"
        "class Has:\n    @staticmethod\n    def d(): return Child()\n",
        space,
    )
    named = {name: foreign_modules(space[name], ("numpy",)) for name in ("Fine", "Draws", "Kit")}
    assert named == {
        "Fine": set(),
        "Draws": {"matplotlib.figure"},
        "Kit": {"falconwing_kit.core.frames"},
    }
    for name in ("Child", "Has"):
        assert foreign_modules(space[name], ("numpy",)) == {"matplotlib.figure"}


BOXES = [process_worker, pytest.param(sandbox_worker, marks=toys.needs_sandbox)]


@pytest.mark.parametrize("box", BOXES)
def test_a_class_answers_through_its_wrapper_and_only_numbers_leave(box):
    """`twice` of given.py calls f(f(x)): 3 (3 x) = 9 x; an object itself is no answer."""
    text = "class f(float):\n    def __new__(cls, x):\n        return float.__new__(cls, 3 * x)\n"
    with box(SandboxJob(text, "f", toys.LAB, through="twice", seconds=1.0)) as worker:
        assert worker.call(2.0) == 18.0
    with (
        box(SandboxJob("class f:\n    def __init__(self, x): pass", "f", toys.LAB)) as worker,
        pytest.raises(StudentError) as failed,
    ):
        worker.call(1.0)
    assert failed.value.category == "bad answer"


@pytest.mark.parametrize("box", BOXES)
def test_a_long_source_is_read_and_a_long_text_is_still_no_answer(box):
    """An answer's texts have 10,000 characters at most; a class with its helpers may have more."""
    lines = "\n".join(f"    x = x + {k}.0 * 0.0  # {'-' * 20}" for k in range(1000))
    text = f"def f(x):\n{lines}\n    return x if x else 'a' * 10001\n"
    assert len(text) > 40_000
    with box(SandboxJob(text, "f", toys.LAB)) as worker:
        assert worker.call(2.0) == 2.0
        with pytest.raises(StudentError) as failed:
            worker.call(0.0)
    assert failed.value.category == "bad answer"


def test_hints_of_a_free_exercise_are_its_listed_mistakes_alone():
    """Nothing is known of another structure's lines, so none of them is named."""
    here = LabHere(ROOT / "labs" / "lab10_bridge")
    free = here.lab.exercise("TrainerBridge")
    listed = [("checksum not compared", "crc16(payload) != int", "0 != int")]
    with importable_given(here.given):
        exercise = ExerciseHere(here.folder, here.lab, free, here.given)
        assert [each.name for each in candidates(exercise, listed)] == ["checksum not compared"]
