"""Feedback: a student's record and public check results -> one HTML page for that student.

Of hidden cases it shows how many were right and how the others failed, never questions or answers:
a student's function could put the question into its answer. Outputs of functions are shown for
public checks only, which run in separate sandboxes that never see a hidden case.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from falconwing_kit.tools.grading.course.gradebook import GradebookEntry
from falconwing_kit.tools.grading.public_checks import SYMBOLS
from falconwing_kit.tools.grading.quiz_answers import SYMBOLS as QUIZ_SYMBOLS
from falconwing_kit.tools.reports.page import write_page

PAGE = Path(__file__).with_name("feedback.html.j2")
MEANING = {  # of a category in a record
    "wrong value": "returned an answer of the right form with wrong numbers",
    "wrong shape": "returned an answer of another shape or type than specified",
    "trial failed": "did not reach the goal of the trial",
    "bad answer": "returned an unsupported type: expected numbers, texts, arrays, "
    "or tuples, lists and dicts of them",
    "not written": "is not written yet",
    "missing": "was not found in the notebook",
    "timeout": "took too long",
    "memory": "took too much memory",
    "died": "ended Python",
    "exception": "raised an error",
}


def result_text(result: Mapping[str, Any]) -> str:
    """Result of an exercise's hidden cases, in a sentence.

    Args:
        result: the exercise's, of a record.
    """
    right = f"{result['right']} of {result['cases']} hidden cases right"
    lost = [f"{_meaning(category)} ({count})" for category, count in result["categories"].items()]
    return f"{right}; it " + ", it ".join(lost) if lost else right


def _meaning(category: str) -> str:
    if category.startswith("exception:"):
        return f"raised {category.removeprefix('exception:')}"
    return MEANING.get(category, "failed")


def write_feedback(
    path: Path, entry: GradebookEntry, checks: Mapping[str, Sequence[Sequence[str]]] | None
) -> None:
    """Write a student's page.

    Args:
        path: of the HTML file.
        checks: for each exercise that lost points the outcomes of its public checks (claim, state,
            lines that are said below it); None where they were not run.
    """
    lab, record = entry.lab, entry.record
    done = record["exercises"]
    functions = [
        (
            each.name,
            f"{done[each.name]['points']:g}",
            f"{each.points:g}",
            result_text(done[each.name]),
        )
        for each in lab.exercises
        if each.name in done
    ]
    lost = [
        {
            "name": each.name,
            "problems": done[each.name]["problems"],
            "outcomes": None if checks is None else checks.get(each.name),
            "claims": [check.claim for check in each.checks],
        }
        for each in lab.exercises
        if each.name in done and done[each.name]["right"] < done[each.name]["cases"]
    ]
    quiz = record.get("quiz", {"questions": {}, "problem": ""})
    given = entry.person.points
    by_person = [
        (each.name, f"{given[each.name]:g}", f"{each.points:g}")
        for each in lab.rubric
        if each.name in given
    ]
    write_page(
        path,
        PAGE,
        lab=lab,
        student=entry.student,
        summary=_summary(entry),
        problem=record["problem"],
        functions=functions,
        lost=lost,
        symbols=SYMBOLS,
        quiz=[(number, *marked) for number, marked in quiz["questions"].items()],
        quiz_problem=quiz["problem"],
        quiz_summary=_quiz_summary(entry),
        quiz_symbols=QUIZ_SYMBOLS,
        by_person=by_person,
        comment=entry.person.comment,
        items=[
            (item.criterion, item.text, f"{item.points:+g}")
            for item in entry.person.items
            if item.criterion in given
        ],
    )


def _quiz_summary(entry: GradebookEntry) -> str:
    marked = entry.record.get("quiz")
    if marked is None:
        return ""
    worth = f"{entry.quiz:g} of {entry.quiz_points:g} points" if entry.quiz_points else "no points"
    return f"Quiz: {marked['right']} of {marked['of']} right, {worth}"


def _summary(entry: GradebookEntry) -> str:
    if entry.machine is None:
        return f"{entry.student}: not graded yet because of an error; ask your instructor."
    if entry.total is None:
        quiz = f" and {entry.quiz:g} for the quiz" if entry.quiz_points and entry.quiz else ""
        return (
            f"{entry.student}: {entry.machine:g} points for the functions{quiz}; "
            "a person's points are still to come."
        )
    return f"{entry.student}: {entry.total:g} of {entry.of:g} points."
