"""A lab's functions in this process: solution, mutants and trivial answers, without the sandbox.

The text that is run is what the grader's collector takes from the notebook, and the arguments come
as copies, so only the sandbox itself is missing. The sandbox has tests of its own, and every
solution goes through it once.
"""

import copy
import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

from falconwing_kit.tools.grading.collect import Notebook, SubmittedCell, collect_source
from falconwing_kit.tools.grading.find import (
    importable_given,
    load_checks,
    load_judges,
    load_module,
)
from falconwing_kit.tools.grading.hints_library import ExerciseHere, candidates
from falconwing_kit.tools.grading.lab import (
    Course,
    Function,
    Judge,
    Lab,
    Trials,
    course_constants,
)
from falconwing_kit.tools.grading.notebooks import read_cells

ROOT = Path(__file__).resolve().parents[2]
INSIDE = re.compile(r"# BEGIN SOLUTION\n(.*?)[ \t]*# END SOLUTION", re.DOTALL)


class LabHere:
    """A lab whose functions run in this process.

    Attributes:
        folder, lab: where it is and what its checks.py says.
        judges: of each exercise, for the open course or that of the constants.
    """

    def __init__(self, folder: Path, constants: Mapping[str, float] | None = None) -> None:
        numbers = constants or course_constants(load_checks(folder), "")
        self.folder, self.lab = folder, load_module(folder, "checks", numbers).LAB
        self.cells = [cell for cell in read_cells(folder / "lab.py") if not cell.markdown]
        self.judges: Mapping[str, tuple[Judge, ...]] = load_judges(folder, Course(numbers))
        self.given: ModuleType = load_module(folder, "given", numbers)

    def function(self, name: str, old: str = "", new: str = "") -> Function:
        """The solution's function, or a mutant in which `old` is replaced by `new`."""
        cells = [
            SubmittedCell(
                True,
                replaced(cell.text, old, new)
                if cell.name == name and cell.kind == "exercise" and old
                else cell.for_solution(),
            )
            for cell in self.cells
        ]
        source = collect_source(Notebook(tuple(cells)), name, self.lab.packages)
        assert source.problems == (), source.problems
        namespace: dict[str, object] = {"__name__": "notebook"}
        with importable_given(self.given):
            exec(compile(source.text, f"{self.folder.name}/{name}", "exec"), namespace)
        return self.as_called(name, namespace[name])

    def as_called(self, name: str, function: Function) -> Function:
        """The function on copies of its arguments, through given.py where the exercise says so."""
        through = self.lab.exercise(name).through

        def called(*arguments):
            with importable_given(self.given):
                arguments = copy.deepcopy(arguments)
                return (
                    getattr(self.given, through)(function, *arguments)
                    if through
                    else function(*arguments)
                )

        called.__name__ = name
        return called

    def score(self, name: str, function: Function, seed: int = 0) -> float:
        """The share of hidden cases that the function gets right."""
        rng = np.random.default_rng([seed, *name.encode()])
        verdicts = [
            verdict for judge in self.judges[name] for verdict in judge.verdicts(function, rng)
        ]
        return sum(map(right, verdicts)) / len(verdicts)

    def is_right(
        self, name: str, function: Function, seed: int = 0, *, trials: bool = True
    ) -> bool:
        """Whether `score` is 1: the cases are asked until one is wrong; on wish without trials."""
        rng = np.random.default_rng([seed, *name.encode()])
        asked = [each for each in self.judges[name] if trials or not isinstance(each, Trials)]
        verdicts = (verdict for judge in asked for verdict in judge.verdicts(function, rng))
        return all(map(right, verdicts))


def right(verdict) -> bool:
    """A case, asked; what the function raises is no point."""
    try:
        return verdict()
    except Exception:
        return False


def replaced(text: str, old: str, new: str) -> str:
    """An exercise's cell with its solution made wrong; `old` must stand there exactly once."""
    inside = INSIDE.search(text)
    assert inside is not None and inside[1].count(old) == 1, (
        f"{old!r} stands {inside and inside[1].count(old)} times"
    )
    return text[: inside.start(1)] + inside[1].replace(old, new) + text[inside.end(1) :]


def mutants(lab: Lab) -> Mapping[str, tuple[tuple[str, str, str], ...]]:
    """The lab's list of wrong solutions; empty where there is none."""
    path = Path(__file__).parent / "mutants" / f"{lab.name}.py"
    if not path.is_file():
        return {}
    spec = importlib.util.spec_from_file_location(f"mutants_of_{lab.name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.MUTANTS


def library_functions(here: LabHere, name: str) -> dict[str, Function]:
    """The functions of an exercise's library of mistakes, by the name of the mistake."""
    with importable_given(here.given):
        exercise = ExerciseHere(here.folder, here.lab, here.lab.exercise(name), here.given)
        return {each.name: each.function for each in candidates(exercise, mutants(here.lab)[name])}
