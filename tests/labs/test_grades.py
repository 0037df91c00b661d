"""Grades are fair: solutions get all points with any seed, wrong or trivial answers do not."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from falconwing_kit.tools.grading.find import lab_folders, load_checks
from falconwing_kit.tools.grading.lab import course_constants
from falconwing_kit.tools.grading.public_checks import exercise_state, run_checks
from falconwing_kit.tools.grading.selftest import selftest
from tests.labs.functions import ROOT, LabHere, mutants
from tests.labs.tools import require_sandbox

FOLDERS = lab_folders(ROOT / "labs")
SEEDS = range(1, 21)
FEW_SEEDS = range(1, 7)  # of trials, which are whole flights, and of exercises of free structure
TRIVIAL = {
    "nothing": lambda *arguments: None,
    "zero": lambda *arguments: 0.0,
    "one": lambda *arguments: 1.0,
    "yes": lambda *arguments: True,
    "no": lambda *arguments: False,
    "a word": lambda *arguments: "none",
    "what came": lambda *arguments: arguments[0],
    "zeros": lambda *arguments: np.zeros_like(arguments[0]),
    "ones": lambda *arguments: np.ones_like(arguments[0]),
}

every_lab = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
pytestmark = [
    pytest.mark.timeout(600),
    pytest.mark.filterwarnings(
        "ignore::RuntimeWarning"
    ),  # wrong solutions divide by zero as they like
]


@dataclass(frozen=True)
class Mutant:
    """A wrong solution and what became of it."""

    lab: str
    exercise: str
    what: str
    right: bool  # in all hidden cases
    passed: bool  # every public check

    @property
    def expected(self) -> bool:
        """Whether a student who saw the public checks expects the grade."""
        return self.passed == self.right


@cache
def here(folder):
    """The lab, loaded once for all tests."""
    return LabHere(folder)


@cache
def judged_mutants(folder):
    """Every wrong solution of a lab, judged and checked."""
    lab, results = here(folder), []
    for name, wrong in mutants(lab.lab).items():
        for what, old, new in wrong:
            function = lab.function(name, old, new)
            passed = exercise_state(run_checks(lab.lab.exercise(name), function)) == "passed"
            results.append(Mutant(folder.name, name, what, lab.is_right(name, function), passed))
    return tuple(results)


@every_lab
def test_grader_gives_the_solution_all_points_and_the_untouched_notebook_none(folder):
    """As students' notebooks are graded, in the real sandbox.

    On every exercise, not only in the sum.
    """
    require_sandbox()
    graded = selftest(folder)
    assert graded.problems == ()
    assert graded.solution == {
        exercise.name: exercise.points for exercise in here(folder).lab.exercises
    }
    assert graded.untouched == dict.fromkeys(graded.solution, 0.0)
    assert graded.passed


@every_lab
def test_solution_gets_everything_with_twenty_other_seeds(folder):
    """Each seed draws other hidden cases; a right function is right in all of them.

    Trials, and exercises whose structure is free, have six of these seeds.
    """
    lab = here(folder)
    for exercise in lab.lab.exercises:
        function = lab.function(exercise.name)
        seeds = FEW_SEEDS if exercise.free else SEEDS
        wrong = [
            seed
            for seed in seeds
            if not lab.is_right(exercise.name, function, seed, trials=seed in FEW_SEEDS)
        ]
        assert wrong == [], exercise.name


@every_lab
def test_solution_passes_every_public_check(folder):
    """A check that the model solution fails would be wrong itself."""
    lab = here(folder)
    for exercise in lab.lab.exercises:
        outcomes = run_checks(exercise, lab.function(exercise.name))
        assert [outcome for outcome in outcomes if outcome.state != "passed"] == [], exercise.name


@every_lab
@pytest.mark.parametrize("answer", TRIVIAL)
def test_trivial_answer_gets_nothing(folder, answer):
    """Who always answers the same, or gives back what came, is right in no case."""
    lab = here(folder)
    scores = {
        e.name: lab.score(e.name, lab.as_called(e.name, TRIVIAL[answer])) for e in lab.lab.exercises
    }
    assert {name: score for name, score in scores.items() if score} == {}


@every_lab
def test_solution_gets_everything_in_a_salted_course(folder):
    """Other constants, drawn by a secret: neither judges nor checks may hold the open course's."""
    lab = LabHere(folder, course_constants(load_checks(folder), "a secret"))
    for exercise in lab.lab.exercises:
        function = lab.function(exercise.name)
        assert lab.score(exercise.name, function) == 1.0, exercise.name
        assert exercise_state(run_checks(exercise, function)) == "passed", exercise.name


@every_lab
def test_solution_of_the_open_course_fails_somewhere_in_a_salted_one(folder):
    """Last year's answers with last year's numbers: at least one exercise must notice."""
    ours, lab = here(folder), LabHere(folder, course_constants(load_checks(folder), "a secret"))
    scores = {e.name: lab.score(e.name, ours.function(e.name)) for e in lab.lab.exercises}
    assert min(scores.values()) < 1.0, scores


@every_lab
def test_there_are_three_mutants_or_more_for_every_exercise(folder):
    """Each is another mistake; each can be made in the solution exactly once."""
    lab = here(folder).lab
    listed = mutants(lab)
    assert set(listed) == {exercise.name for exercise in lab.exercises}
    for name, wrong in listed.items():
        assert (
            len({what for what, *_ in wrong})
            == len({tuple(change) for _, *change in wrong})
            == len(wrong)
            >= 3
        ), name


@every_lab
def test_mutants_of_the_lab_lose_points_and_expect_it(folder):
    """Of one lab, one of twenty may slip through; of all together see below."""
    found = judged_mutants(folder)
    unpunished = [mutant for mutant in found if mutant.right]
    surprised = [mutant for mutant in found if not mutant.expected]
    assert len(unpunished) <= max(1, len(found) // 20), unpunished
    assert len(surprised) <= max(1, len(found) // 20), surprised


def test_mutants_of_all_labs_lose_points_and_expect_it():
    """The course's promise: 95 % of wrong solutions lose points, and 95 % fail a public check."""
    found = [mutant for folder in FOLDERS for mutant in judged_mutants(folder)]
    assert sum(not mutant.right for mutant in found) >= 0.95 * len(found)
    assert sum(mutant.expected for mutant in found) >= 0.95 * len(found)
