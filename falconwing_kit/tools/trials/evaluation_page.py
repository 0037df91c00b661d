"""Page of an evaluation: cells and their records -> tables with the paper's figures beside, curves
of the sweeps, as Markdown, HTML and PNG.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit import __version__
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure, write_page
from falconwing_kit.tools.trials.evaluation import Cell, summarise_cell, weights_digest
from falconwing_kit.tools.trials.paper_figures import DOTS, PAPER, ROBUSTNESS
from falconwing_kit.tools.trials.statistics import wilson_interval
from falconwing_kit.tools.trials.trials import Record
from falconwing_kit.tools.trials.worlds import AXES, PER_CENT, TABLES, UNSEEN, WORLDS

PAGE = Path(__file__).with_name("evaluation.html.j2")
COLOURS = (PREDICTED, ACCENT, "#38761d", "#7b3fa0", MEASURED, QUIET)
TITLES = {"landing": "Landing", "follow": "Following a leader"}
LANDING_HEADERS = (
    "pilot", "world", "landed", "95 %", "ALD mean (95 %), most [cm]", "past threshold [m]",
    "sink mean, most [m/s]", "ART [ms CPU]", "supervisor acts", "go-arounds", "paper",
)  # fmt: skip
FOLLOW_HEADERS = (
    "pilot", "leader flies, or world", "locked throughout", "95 %", "ATE mean (95 %), most [cm]",
    "ATE of successes [cm]", "ART [ms CPU]", "supervisor acts", "paper",
)  # fmt: skip
PAPER_TEXT = (
    "Curved: 2 to 4 m beside the centre line, nose towards it. Wide: within 3 m and 30 deg of it,"
    " 0.7 to 3 m up, 12 to 22.5 m out (the hall is no longer). Spread: coefficients +-20 %, delay"
    " to 150 ms, wind to 0.8 m/s. Reality: an aircraft that JSBSim flies, spread by 15 %, delay 50"
    " to 80 ms, wind to 0.4 m/s, camera off by 0.5 deg, analog link, exposure +-0.5 EV. The last"
    " column is the paper's: successes, trials, mean error, run time."
)
NOTES = (
    "Success is a landing whose first contact is a wheel on the pad, or a flight in which the"
    " leader is locked in all frames (its centre inside the image, and six pixels of which it makes"
    " up at least half) and nothing is touched. ALD is the distance from the pad's centre line at"
    " touchdown, of landings only. ATE is the mean error of the leader's relative position until"
    " the lock is lost, over all trials.",
    "ART is processor time of one step of the pilot: the median over trials of their medians, with"
    " as many trials at a time as there were workers. The paper's is wall time with an RTX 4090.",
    "A pilot by images is given no state. The supervisor of a real flight watched and did not act:"
    " the column counts the flights that it would have ended. Its limit on a step's run time is"
    " left out.",
)


@dataclass(frozen=True)
class Table:
    """A table and its words."""

    title: str
    text: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def write_evaluation(cells: Mapping[Cell, Sequence[Record]], folder: Path) -> dict[str, Path]:
    """Write the page of an evaluation.

    Args:
        cells: each with its records, at least one.
        folder: for index.html, tables.md, summary.jsonl and the PNG files of the sweeps.

    Returns:
        The files by page, tables, summary, and a PNG a task with sweeps.
    """
    summaries = {cell: summarise_cell(records) for cell, records in cells.items()}
    tables = evaluation_tables(cells)
    files = {"page": folder / "index.html", "tables": folder / "tables.md"}
    files["summary"] = folder / "summary.jsonl"
    curves = []
    for task in dict.fromkeys(cell.task for cell in cells):
        sweeps = {cell: found for cell, found in summaries.items()
                  if cell.task == task and cell.world.group in AXES}  # fmt: skip
        if sweeps:
            files[task] = folder / f"sweeps_{task}.png"
            draw_sweeps(sweeps, files[task])
            curves.append((files[task], TITLES[task]))
    lead = _lead(cells)
    with atomic_write(files["tables"], text=True) as file:
        file.write(as_markdown(lead, tables))
    with atomic_write(files["summary"], text=True) as file:
        file.writelines(_summary_line(cell, found) + "\n" for cell, found in summaries.items())
    write_page(
        files["page"], PAGE, lead=lead, tables=tables, curves=curves, notes=NOTES,
        version=__version__, weights=weights_digest(),
        sweeps_text=_robustness(cells),
    )  # fmt: skip
    return files


def _summary_line(cell: Cell, found: Record) -> str:
    head = {"pilot": cell.pilot, "task": cell.task, "world": cell.world.name,
            "group": cell.world.group, "level": cell.world.level, "size": cell.size,
            "list": cell.seed, "scene": cell.scene}  # fmt: skip
    return json.dumps(head | found, allow_nan=False)


def _robustness(cells: Mapping[Cell, Sequence[Record]]) -> str:
    """The paper's words on the sweeps that were flown, of which its text has no numbers."""
    groups = {cell.world.group for cell in cells}
    words = "; ".join(f"{group}: {text}" for group, text in ROBUSTNESS.items() if group in groups)
    return f"The paper on RGB+Mask, 10 runs a level: {words}." if words else ""


def _lead(cells: Mapping[Cell, Sequence[Record]]) -> str:
    """What was flown, in a sentence."""
    counts = sorted({len(records) for records in cells.values()})
    sizes = sorted({f"{cell.size[0]}x{cell.size[1]}" for cell in cells})
    seeds = sorted({cell.seed for cell in cells})
    trials = "trial" if counts == [1] else "trials"
    scenes = " and ".join(sorted({cell.scene for cell in cells}))
    between = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    files = sorted({f"{Path(c.weights).name} ({c.weights_digest})" for c in cells if c.weights})
    weights = f" Pilots by images fly by {', '.join(files)}." if files else ""
    return (
        f"{between} {trials} of frozen list {', '.join(map(str, seeds))} in each world, in the"
        f" scene {scenes}, images of {', '.join(sizes)}.{weights}"
    )


def evaluation_tables(cells: Mapping[Cell, Sequence[Record]]) -> list[Table]:
    """Two tables of each task: the paper's worlds with the spread and reality, and all others.

    Rows are sorted by world and pilot; a row has the three unseen manoeuvres together.
    """
    found = []
    for task, title in TITLES.items():
        of_task = {cell: records for cell, records in cells.items() if cell.task == task}
        paper = {c: records for c, records in of_task.items() if c.world.group in TABLES}
        other = {c: records for c, records in of_task.items() if c.world.group not in TABLES}
        headers = LANDING_HEADERS if task == "landing" else FOLLOW_HEADERS
        if paper:
            found.append(Table(title, PAPER_TEXT, headers, _rows(task, paper)))
        if other:
            more = f"{title}, other influences"
            found.append(Table(more, "The numbers of the curves.", headers, _rows(task, other)))
    return found


def _rows(task: str, cells: Mapping[Cell, Sequence[Record]]) -> tuple[tuple[str, ...], ...]:
    """Rows in the order of the worlds."""
    rows = []
    for world in WORLDS:
        rows += [
            _row(task, cell.pilot, world, records)
            for cell, records in cells.items() if cell.world.name == world
        ]  # fmt: skip
        if world == UNSEEN[-1]:
            rows += _unseen_rows(cells)
    return tuple(rows)


def _unseen_rows(cells: Mapping[Cell, Sequence[Record]]) -> list[tuple[str, ...]]:
    """The three unseen manoeuvres together, for each pilot that flew them all."""
    rows = []
    for pilot in dict.fromkeys(cell.pilot for cell in cells):
        parts = [r for c, r in cells.items() if c.pilot == pilot and c.world.name in UNSEEN]
        if len(parts) == len(UNSEEN):
            rows.append(_row("follow", pilot, "unseen", [r for part in parts for r in part]))
    return rows


def _row(task: str, pilot: str, world: str, records: Sequence[Record]) -> tuple[str, ...]:
    found = summarise_cell(records)
    rate = found["success"]
    name = world.replace("_", " ")
    first = (
        pilot, "three unseen together" if world == "unseen" else name,
        f"{found['successes']} of {found['trials']}",
        f"{100.0 * rate['low95']:.0f} to {100.0 * rate['high95']:.0f} %",
    )  # fmt: skip
    supervised = found["supervised"]["rate"]
    timing = (f"{found['cpu_ms_median']:.1f}", f"{100.0 * supervised:.0f} %")
    paper = _paper(task, pilot, world)
    if task == "landing":
        past, sink = found["past_threshold_m"], found["sink_rate_m_s"]
        return (
            *first, _with_interval(found["ald_m"]),
            "-" if past is None else f"{past['smallest']:.1f} to {past['largest']:.1f}",
            "-" if sink is None else f"{sink['mean']:.2f}, {sink['largest']:.2f}",
            *timing, str(found["go_arounds"]), paper,
        )  # fmt: skip
    of_successes = found["ate_m_of_successes"]
    return (
        *first, _with_interval(found["ate_m"]),
        "-" if of_successes is None else f"{100.0 * of_successes['mean']:.0f}", *timing, paper,
    )  # fmt: skip


def _with_interval(value: Record | None) -> str:
    """Mean, interval and largest of a length, in cm."""
    if value is None:
        return "-"
    between = ""
    if value["low95"] is not None:
        between = f" ({100.0 * value['low95']:.1f} to {100.0 * value['high95']:.1f})"
    return f"{100.0 * value['mean']:.1f}{between}, {100.0 * value['largest']:.1f}"


def _paper(task: str, pilot: str, world: str) -> str:
    """The paper's figure, or "-"."""
    found = PAPER.get((task, world, pilot))
    if found is None:
        return "-"
    parts = [f"{100.0 * found.successes:.0f} %" + (f" of {found.trials}" if found.trials else "")]
    parts.append(f"{found.error_cm:.0f} cm")
    parts += [] if found.runtime_ms is None else [f"{found.runtime_ms:.0f} ms"]
    return ", ".join([*parts, *([found.note] if found.note else [])])


def as_markdown(lead: str, tables: Sequence[Table]) -> str:
    """The tables in Markdown."""
    lines = ["# How well the pilots fly", "", f"SIMULATED. {lead}", ""]
    for part in tables:
        lines += [f"## {part.title}", "", part.text, "", f"| {' | '.join(part.headers)} |"]
        lines.append("|" + "---|" * len(part.headers))
        lines += [f"| {' | '.join(row)} |" for row in part.rows] + [""]
    return "\n".join([*lines, *(f"{note}\n" for note in NOTES)])


def draw_sweeps(found: Mapping[Cell, Record], path: Path) -> None:
    """Draw success rate and error against the level of every sweep into a PNG.

    Args:
        found: cells of one task with their summaries.
        path: the PNG.
    """
    groups = [group for group in AXES if any(cell.world.group == group for cell in found)]
    pilots = list(dict.fromkeys(cell.pilot for cell in found))
    task = next(iter(found)).task
    key, label = ("ald_m", "ALD [cm]") if task == "landing" else ("ate_m", "ATE [cm]")
    columns = min(4, len(groups))
    rows = math.ceil(len(groups) / columns)
    with figure(path, 2 * rows, columns, (3.1 * columns, 4.4 * rows)) as axes:
        for ax in axes.flat[:]:
            ax.set_visible(False)
        for k, group in enumerate(groups):
            rates, errors = (axes[2 * (k // columns) + i, k % columns] for i in range(2))
            for pilot, colour in zip(pilots, _colours(len(pilots)), strict=True):
                of_pilot = [(c, s) for c, s in found.items()
                            if c.pilot == pilot and c.world.group == group]  # fmt: skip
                _draw_curve(rates, of_pilot, lambda s: s["success"], "rate", colour, pilot)
                _draw_curve(errors, of_pilot, lambda s: s[key], "mean", colour, pilot)
                _draw_dot(rates, (group, task, pilot), colour)
            rates.set(ylim=(-3.0, 108.0), ylabel="success [%]")
            errors.set(xlabel=AXES[group], ylabel=label)
            errors.set_ylim(bottom=0.0)
            for ax in (rates, errors):
                ax.set_visible(True)
            if group == "snr":
                rates.invert_xaxis()
                errors.invert_xaxis()
        axes[0, 0].legend(loc="lower left")
        axes[0, 0].set_title(f"SIMULATED: {TITLES[task].lower()}")


def _colours(count: int) -> tuple[str, ...]:
    return tuple(COLOURS[k % len(COLOURS)] for k in range(count))


def _draw_curve(
    ax: Any, cells: Sequence[tuple[Cell, Record]], pick: Any, middle: str, colour: str, label: str
) -> None:
    """A line of per cent or centimetres against the level, with its band."""
    points = []
    for cell, summary in cells:
        value, level = pick(summary), cell.world.level
        if value is not None and level is not None:
            x = 100.0 * level if cell.world.group in PER_CENT else level
            ends = (value["low95"], value["high95"])
            low, high = ends if ends[0] is not None else (value[middle],) * 2
            points.append((x, 100.0 * value[middle], 100.0 * low, 100.0 * high))
    if points:
        x, y, low, high = np.array(sorted(points)).T
        ax.plot(x, y, "o-", color=colour, markersize=3.0, linewidth=1.2, label=label)
        ax.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0.0)


def _draw_dot(ax: Any, key: tuple[str, str, str], colour: str) -> None:
    """The paper's success rate as an open circle with its Wilson interval, where it has one."""
    if key not in DOTS:
        return
    level, share, trials = DOTS[key]
    x = 100.0 * level if key[0] in PER_CENT else level
    low, high = (100.0 * end for end in wilson_interval(round(share * trials), trials))
    y = 100.0 * share
    ax.errorbar([x], [y], [[y - low], [high - y]], fmt="o", mfc="none", color=colour, ms=8.0)
