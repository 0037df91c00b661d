"""Overview: a class's numbers and likenesses -> one page for the instructor."""

import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from falconwing_kit.tools.grading.course.gradebook import Entry
from falconwing_kit.tools.grading.course.items import Item
from falconwing_kit.tools.grading.course.similar import Likeness
from falconwing_kit.tools.grading.lab import Lab
from falconwing_kit.tools.reports.page import paragraph, table, write_page

SHOWN = 12  # pairs with both sources on the page
Sources = Mapping[tuple[str, str], str]  # by exercise, and by who or what a Pair names


def write_overview(
    path: Path,
    lab: Lab,
    entries: Sequence[Entry],
    items: Sequence[Item],
    pairs: Sequence[Likeness] | None,
    sources: Sources,
) -> None:
    """Write the page.

    Args:
        path: the HTML file.
        lab: the lab.
        entries: the students' lines.
        items: how each exercise did.
        pairs: who wrote alike; None where nobody looked, since there were no submissions.
        sources: their texts.
    """
    done = [entry for entry in entries if entry.total is not None]
    marked = [entry.machine for entry in entries if entry.machine is not None]
    mean = f", {sum(marked) / len(marked):.1f} points by the machine in the mean" if marked else ""
    lead = f"{len(entries)} students{mean}; {len(done)} with a person's points too."
    parts = [f"<h1>{html.escape(f'{lab.name}: {lab.title}')}</h1>", paragraph(lead, "lead")]
    looks = [(e.student, e.record["status"], e.record["problem"]) for e in entries if e.record["problem"]]
    if looks:
        parts.append(table("What a person should know", ("student", "status", "note"), looks))
    parts += [_items(items), paragraph(_ABOUT_ITEMS)]
    parts += ["<h2>Functions that are alike</h2>", paragraph(_ABOUT_PAIRS)]
    if pairs is None:
        parts.append(paragraph("Not looked at: give the submissions, <code>--submissions</code>."))
    elif not pairs:
        parts.append(paragraph("No two functions are alike enough to be listed."))
    else:
        parts += _pairs(pairs, sources)
    write_page(path, f"{lab.name}: report", [_STYLE, *parts])


def _items(items: Sequence[Item]) -> str:
    heads = ("function", "mean", "all points", "untouched", "discrimination", "commonest loss (students)")
    rows = [
        (
            each.name,
            *map(_percent, (each.mean, each.full, each.untouched)),
            _number(each.discrimination),
            each.commonest,
        )
        for each in items
    ]
    return table("How each exercise did", heads, rows)


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100.0 * share:.0f} %"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def _pairs(pairs: Sequence[Likeness], sources: Sources) -> list[str]:
    """A table of all, and the first ones with their texts side by side."""
    rows = [(each.left, each.right, f"{each.weight:.0f}", each.functions) for each in pairs]
    parts = [table("The rarest likeness first", ("this", "and this", "weight [bit]", "functions and share"), rows)]
    for each in pairs[:SHOWN]:
        parts.append(f"<details><summary>{html.escape(each.left)} and {html.escape(each.right)}</summary>")
        for pair in each.pairs:
            texts = [html.escape(sources.get((pair.exercise, who), "")) for who in (pair.left, pair.right)]
            parts.append(f"<div class=both>{''.join(f'<pre>{text}</pre>' for text in texts)}</div>")
        parts.append("</details>")
    return parts


_ABOUT_ITEMS = (
    "Untouched: not begun. Discrimination is the correlation of an exercise's points with those of all others: near 0 "
    "or below, look at the exercise, or at its judge, before you look at the students."
)
_ABOUT_PAIRS = (
    "For a person to read; it is no proof, and no points depend on it. Short functions that are right are alike by "
    "nature. Names, numbers and comments do not count. A piece of code that many of the class have weighs little, one "
    "that only two have weighs much; the share is that of the smaller function. Before you conclude anything, read "
    "both texts and ask the students, by the questions of the lab's notes. Functions of the kit and the published "
    "solution (both are called kit) may be read by everybody; copying one is a matter of your course's rules."
)
_STYLE = """<style>td, th { text-align: left; } .both { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem; }
.both pre { font-size: .8rem; margin: 0; }</style>"""
