"""falconwing check: run a lab's public checks on your notebook."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.tools.grading.collect import read_notebook
from falconwing_kit.tools.grading.find import lab_folder, load_checks, notebook_path
from falconwing_kit.tools.grading.public_checks import (
    STEPS,
    SYMBOLS,
    ExerciseReport,
    check_notebook,
    exercise_state,
    outcome_lines,
    to_printable,
)
from falconwing_kit.tools.grading.quiz import FORM, SOURCE
from falconwing_kit.tools.grading.quiz_answers import (
    mark_answers,
    quiz_here,
    quiz_lines,
    read_answers,
)


@dataclass(frozen=True)
class Check:
    """Run a lab's public checks on your notebook as last saved.

    Exit code 0 if every exercise passes, else 1. The grading has further, hidden cases.
    """

    lab: Annotated[str, tyro.conf.Positional]
    """such as lab03, or the lab's folder"""
    notebook: Path | None = None
    """your notebook; the one in the lab's folder if not given"""
    labs: Path | None = None
    """the folder with the labs; the current folder's, or the checkout's own, if not given"""
    step: Literal[1, 2, 3] = 1
    """how much a hint says: 1 where to look, 2 also the mistake, 3 also what to change"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Run the checks and print the results.

        Returns:
            0 if all public checks passed, else 1.

        Raises:
            FileNotFoundError: there is no notebook.
            InputError: there is no such lab, or the notebook cannot be read.
        """
        folder = lab_folder(self.lab, self.labs)
        reports = check_notebook(folder, self.notebook or notebook_path(folder))
        states = [exercise_state(report.outcomes) for report in reports]
        if self.json:
            print_json({"lab": folder.name, "exercises": [_record(report) for report in reports]})
        else:
            quiz = _quiz_lines(folder, self.notebook or notebook_path(folder))
            _print_reports(folder, reports, states, self.step, quiz)
        return int(set(states) != {"passed"})


def _quiz_lines(folder: Path, notebook: Path) -> list[str]:
    """What the quiz cell of a notebook holds; nothing where the lab has no quiz."""
    if not any((folder / name).is_file() for name in (SOURCE, FORM)):
        return []
    questions, known = quiz_here(folder)
    answers, problem = read_answers(read_notebook(notebook))
    marks = mark_answers(questions, answers, known=known)
    return quiz_lines(questions, marks, known) + ([f"   ! {problem}"] if problem else [])


def _record(report: ExerciseReport) -> dict[str, object]:
    """A report as it goes to JSON."""
    return asdict(report) | {"state": exercise_state(report.outcomes)}


def _print_reports(
    folder: Path,
    reports: list[ExerciseReport],
    states: list[str],
    step: int,
    quiz: list[str],
) -> None:
    lab = load_checks(folder)
    rows = []
    for report, state in zip(reports, states, strict=True):
        passed = sum(outcome.state == "passed" for outcome in report.outcomes)
        rows.append(
            (
                to_printable(f"{SYMBOLS[state]} {state}"),
                report.name,
                f"{passed} of {len(report.outcomes)}",
            )
        )
    print_table(("", "exercise", "public checks passed"), rows, title=f"{folder.name}: {lab.title}")
    for report, state in zip(reports, states, strict=True):
        failed = [outcome for outcome in report.outcomes if outcome.state == "failed"]
        for outcome in failed:
            print(to_printable(f"{SYMBOLS['failed']} {report.name}: {outcome.claim}"))
            print(*(f"    {words}" for words in outcome_lines(outcome, step)), sep="\n")
        for problem in report.problems if state != "not written" else ():
            print(f"! {problem}")
    for line in quiz:
        print(to_printable(line))
    counts = f"{states.count('passed')} of {len(states)} exercises pass their public checks"
    print(f"{counts}, {states.count('not written')} not started")
    if set(states) == {"passed"}:
        next_line("answer the questions and submit the notebook; the grading has hidden cases too")
    else:
        if step < STEPS and any(each.steps for report in reports for each in report.outcomes):
            print(f"--step {step + 1} says more about what is wrong")
        first = next(i for i, state in enumerate(states) if state != "passed")
        next_line(f"{'write' if states[first] == 'not written' else 'fix'} {reports[first].name}")
