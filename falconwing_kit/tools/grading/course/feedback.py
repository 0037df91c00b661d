"""Feedback: a student's record and public checks -> one page for that student, without a network and without colour.

Of hidden cases it says how many were right and in which way the others failed, never what was asked or answered: a
student's function could have hidden the question in its answer. What a function said is shown for public checks only,
which run in boxes of their own that never see a hidden case.
"""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from falconwing_kit.tools.grading.course.gradebook import Entry
from falconwing_kit.tools.grading.lab import Exercise
from falconwing_kit.tools.grading.public_checks import SYMBOLS
from falconwing_kit.tools.reports.page import paragraph, table, write_page

MEANING = {  # of a category in a record
    "wrong value": "gave an answer of the right form with wrong numbers",
    "wrong shape": "gave an answer of another shape or kind than asked for",
    "trial failed": "did not reach what the trial asks for",
    "bad answer": "gave what is no answer: want numbers, texts, arrays, or tuples, lists and dicts of them",
    "not written": "is not written yet",
    "missing": "was not found in the notebook",
    "timeout": "took too long",
    "memory": "took too much memory",
    "died": "ended Python",
    "exception": "raised an error",
}


def in_words(result: Mapping[str, Any]) -> str:
    """What became of an exercise's hidden cases, in a sentence.

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


def write_feedback(path: Path, entry: Entry, checks: Mapping[str, Sequence[Sequence[str]]] | None) -> None:
    """Write a student's page.

    Args:
        path: the HTML file.
        entry: the student's line of the gradebook.
        checks: for each exercise that lost points the outcomes of its public checks (claim, state, hint, what the
            function said); None where they were not run.
    """
    lab, record = entry.lab, entry.record
    parts = [f"<h1>{html.escape(f'{lab.name}: {lab.title}')}</h1>", paragraph(html.escape(_summary(entry)), "lead")]
    if record["problem"]:
        parts.append(paragraph(f"Note: {html.escape(record['problem'])}"))
    done = record["exercises"]
    rows = [
        (each.name, f"{done[each.name]['points']:g}", f"{each.points:g}", in_words(done[each.name]))
        for each in lab.exercises
        if each.name in done
    ]
    if rows:
        parts.append(table("Functions, graded by the machine", ("function", "points", "of", "what happened"), rows))
    for exercise in lab.exercises:
        if exercise.name in done and done[exercise.name]["right"] < done[exercise.name]["cases"]:
            found = None if checks is None else checks.get(exercise.name)
            parts += _exercise(exercise, done[exercise.name], found)
    parts += _by_person(entry)
    parts.append(_FOOT.format(lab=lab.name))
    write_page(path, f"{lab.name}: {entry.student}", [_STYLE, *parts])


def _summary(entry: Entry) -> str:
    if entry.machine is None:
        return f"{entry.student}: this could not be graded yet; ask your instructor."
    if entry.total is None:
        return f"{entry.student}: {entry.machine:g} points for the functions; a person's points are still to come."
    return f"{entry.student}: {entry.total:g} of {entry.of:g} points."


def _exercise(exercise: Exercise, result: Mapping[str, Any], outcomes: Sequence[Sequence[str]] | None) -> list[str]:
    """What to look at in a function that lost points."""
    parts = [f"<h2>{html.escape(exercise.name)}</h2>"]
    parts += [paragraph(f"! {html.escape(problem)}") for problem in result["problems"]]
    if outcomes is None:
        claims = "".join(f"<li>{html.escape(check.claim)}</li>" for check in exercise.checks)
        return [*parts, paragraph("A right function does all of this:"), f'<ul class="checks">{claims}</ul>']
    lines = []
    for claim, state, hint, said in outcomes:
        more = "".join(f"<br>{html.escape(words)}" for words in (said, hint) if words)
        lines.append(f"<li><b>{SYMBOLS[state]} {state}:</b> {html.escape(claim)}{more}</li>")
    parts.append(f'<ul class="checks">{"".join(lines)}</ul>')
    if all(state == "passed" for _, state, *_ in outcomes):
        parts.append(
            paragraph("All public checks passed, and hidden cases did not: think of limits, signs and shapes.")
        )
    return parts


def _by_person(entry: Entry) -> list[str]:
    """Figures and answers, as far as they are graded."""
    given = entry.person.points
    rows = [(each.name, f"{given[each.name]:g}", f"{each.points:g}") for each in entry.lab.rubric if each.name in given]
    if not rows:
        return []
    parts = [table("Figures and answers, graded by a person", ("part", "points", "of"), rows)]
    if entry.person.comment:
        parts.append(f"<blockquote>{html.escape(entry.person.comment)}</blockquote>")
    return parts


_STYLE = """<style>td:last-child, th:last-child { text-align: left; }
ul.checks { list-style: none; padding-left: 0; max-width: 46rem; } ul.checks li { margin: .5rem 0; }
blockquote { white-space: pre-wrap; border-left: 3px solid #999; margin: 1rem 0; padding-left: 1rem; }</style>"""
_FOOT = """<footer>Hidden cases are drawn afresh, so there is no list of them; a function that is right, and not only
right for the examples, gets them all. <code>falconwing check {lab}</code> runs the public checks at home. If you think
that the grading is wrong, ask: every submission can be graded again on the very same cases.</footer>"""
