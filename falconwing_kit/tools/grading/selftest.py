"""Self-test of a lab: its solution must get all points, its untouched notebook none."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from falconwing_kit.tools.grading.find import load_checks, notebook_path
from falconwing_kit.tools.grading.judge import Assignment, GradingTask, grade_submission
from falconwing_kit.tools.grading.submissions import Submission


@dataclass(frozen=True)
class SelfTest:
    """Grading results of a lab's own notebooks.

    Attributes:
        lab: its folder's name.
        solution, untouched: points of each exercise, by name.
        of: maximum points of each exercise.
        problems: messages of the grader.
    """

    lab: str
    solution: Mapping[str, float]
    untouched: Mapping[str, float]
    of: Mapping[str, float]
    problems: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether every exercise gave all points for the solution and none untouched."""
        nothing = dict.fromkeys(self.of, 0.0)
        return self.solution == self.of and self.untouched == nothing and not self.problems


def selftest(folder: Path, *, sandboxed: bool = True) -> SelfTest:
    """Grade a lab's solution and its untouched notebook.

    Args:
        folder: the lab's, with both notebooks built.
        sandboxed: run each function in a sandbox, as students' are.

    Raises:
        InputError: the lab cannot be used, or no sandbox is available.
    """
    assignment = Assignment(folder, sandboxed=sandboxed)
    solution, untouched = (
        grade_submission(
            GradingTask(Submission("", notebook_path(folder, solution=done)), seed="selftest"),
            assignment,
        )
        for done in (True, False)
    )
    problems = [record["problem"] for record in (solution, untouched)]
    problems += [
        problem for result in solution["exercises"].values() for problem in result["problems"]
    ]
    quizzes = [record.get("quiz", {"right": 0, "of": 0}) for record in (solution, untouched)]
    if quizzes[0]["right"] != quizzes[0]["of"] or quizzes[1]["right"]:
        problems.append(f"quiz: {quizzes[0]['right']} of {quizzes[0]['of']} right in the solution")
    problems += [
        f"{name} fails: {what} in {count} of {result['cases']} cases"
        for name, result in solution["exercises"].items()
        for what, count in result["categories"].items()
    ]
    return SelfTest(
        lab=folder.name,
        solution={name: result["points"] for name, result in solution["exercises"].items()},
        untouched={name: result["points"] for name, result in untouched["exercises"].items()},
        of={exercise.name: exercise.points for exercise in load_checks(folder).exercises},
        problems=tuple(filter(None, problems)),
    )
