"""Overview: statistics and similarities of a class -> one page for the instructor."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from falconwing_kit.tools.grading.course.gradebook import GradebookEntry
from falconwing_kit.tools.grading.course.items import ItemStatistics
from falconwing_kit.tools.grading.course.similar import Similarity
from falconwing_kit.tools.grading.judge import STATES, record_state
from falconwing_kit.tools.grading.lab import Lab
from falconwing_kit.tools.grading.quiz_answers import OPEN, RIGHT, UNUSABLE, WRONG
from falconwing_kit.tools.reports.page import write_page

PAGE = Path(__file__).with_name("overview.html.j2")
SHOWN = 12  # pairs with both sources on the page
Sources = Mapping[tuple[str, str], str]  # by exercise, and by who or what a Pair names


def write_overview(
    path: Path,
    lab: Lab,
    entries: Sequence[GradebookEntry],
    items: Sequence[ItemStatistics],
    pairs: Sequence[Similarity] | None,
    sources: Sources,
) -> None:
    """Write the page.

    Args:
        path: of the HTML file.
        pairs: similarities; None without submissions.
        sources: texts of the pairs.
    """
    done = [entry for entry in entries if entry.total is not None]
    marked = [entry.machine for entry in entries if entry.machine is not None]
    mean = f", {sum(marked) / len(marked):.1f} automatic points on average" if marked else ""
    states = Counter(record_state(entry.record) for entry in entries)
    counts = " + ".join(f"{states[state]} {state}" for state in STATES if states[state])
    lead = f"{len(entries)} students = {counts}{mean}; {len(done)} with manual points too."
    quizzes = [entry.record["quiz"]["questions"] for entry in entries if "quiz" in entry.record]
    write_page(
        path,
        PAGE,
        lab=lab,
        lead=lead,
        items=[_row(each) for each in items],
        quiz=_quiz_rows(quizzes),
        pairs=pairs,
        sources=sources,
        shown=SHOWN,
        looks=[
            (e.student, e.record["status"], e.record["problem"])
            for e in entries
            if e.record["problem"]
        ],
        alike=[
            (each.left, each.right, f"{each.weight:.0f}", each.functions) for each in pairs or ()
        ],
    )


def _row(each: ItemStatistics) -> tuple[str, ...]:
    shares = map(_percent, (each.mean, each.full, each.untouched))
    return each.name, *shares, _number(each.discrimination), each.commonest


def _quiz_rows(quizzes: Sequence[Mapping[str, Sequence[str]]]) -> list[tuple[str, ...]]:
    """For each question the shares of right, wrong and open answers, and the commonest mistake."""
    rows = []
    for number in quizzes[0] if quizzes else ():
        marks = [each[number] for each in quizzes if number in each]
        states = Counter(state for state, _ in marks)
        wrong = Counter(said for state, said in marks if state in (WRONG, UNUSABLE) and said)
        shares = [states[RIGHT], states[WRONG] + states[UNUSABLE], states[OPEN]]
        commonest = f"{wrong.most_common(1)[0][0]} ({wrong.most_common(1)[0][1]})" if wrong else ""
        rows.append((number, *(_percent(share / len(marks)) for share in shares), commonest))
    return rows


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100.0 * share:.0f} %"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"
