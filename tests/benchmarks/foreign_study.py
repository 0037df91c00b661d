"""The gap workflow on aircraft that are not ours: seeds -> one line of JSON each, and a table.

    python -m tests.benchmarks.foreign_study --seed 30000 --count 200 --workers 16 \\
        --budget-s 450 --out rows.jsonl
    python -m tests.benchmarks.foreign_study --summary rows.jsonl

Runs the whole workflow as a user would (`Study(...).report()`), with an airframe file of three keys
or without, and records whatever it answers; an exception is the worst answer. All flights are
simulated (`foreign_flights`). The flights come in random order, so that a study that is cut short
is a fair sample; a file that exists is gone on with, flights that were lost first. Nothing here may
be tuned on the seeds that are reported.
"""

import argparse
import contextlib
import json
import os
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map
from tests.benchmarks.foreign_flights import (
    AIRCRAFT,
    BEYOND,
    IN_CATALOGUE,
    airframe_text,
    effects_of,
    make_case,
)

PAIRS = (
    "wind+battery_sag", "extra_drag+adverse_yaw", "control_delay+wind", "mass_change+camera_tilt",
    "thrust_loss+trim_bias", "flap+adverse_yaw", "aileron_loss+wind", "cg_shift+battery_sag",
)  # fmt: skip
# Of ten cases: three quiet ones, five of the catalogue, one outside it, one pair.
ROUND = ("none", "in", "in", "none", "in", "outside", "in", "none", "in", "pair")
CLEAR_GAP = 0.3  # chi2 per component above the baseline's: the gap is worth closing
PROBABILITY_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99)  # lower ends


@dataclass(frozen=True)
class Asked:
    """One flight to be named, and how."""

    aircraft: str
    effect: str
    seed: int
    with_airframe: bool
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """What a line is recognised by when a study is resumed."""
        way = "airframe" if self.with_airframe else "bare"
        return f"{self.aircraft} {self.effect} {self.seed} {way}"


def cases(
    seed: int, count: int, aircraft: tuple[str, ...] = AIRCRAFT, effects: tuple[str, ...] = (),
    airframe: str = "alternate", stress: bool = False,
) -> Iterator[Asked]:  # fmt: skip
    """The cases of a study: aircraft in turn, and for each the kinds of ROUND in turn.

    Args:
        seed: of the first case.
        count: how many.
        aircraft: in turn.
        effects: only these, in turn; empty for ROUND.
        airframe: with, without, both, or alternate.
        stress: gusts, wind in the baseline, onsets, few poses and odd rates in turn.
    """
    for k in range(count):
        plane, lap = aircraft[k % len(aircraft)], k // len(aircraft)
        able = effects_of(plane)
        rng = np.random.default_rng([seed + k, 11])
        if effects:
            effect = effects[lap % len(effects)]
            if not all(name in able for name in effect.split("+")):
                continue
        else:
            shift = aircraft.index(plane) * 3  # so that aircraft meet kinds at different times
            kind = ROUND[(lap + shift) % len(ROUND)]
            choices = {
                "none": ("none",),
                "in": tuple(e for e in IN_CATALOGUE if e in able),
                "outside": tuple(e for e in BEYOND if e in able),
                "pair": tuple(p for p in PAIRS if set(p.split("+")) <= set(able)),
            }[kind]
            effect = str(choices[int(rng.integers(len(choices)))])
        options: dict[str, Any] = {"correlated": bool(k % 3 == 2)}
        if stress:
            options |= _stress(k, effect)
        ways = {
            "with": (True,), "without": (False,), "both": (True, False),
            "alternate": (bool((lap + k) % 2),),
        }[airframe]  # fmt: skip
        for way in ways:
            yield Asked(plane, effect, seed + k, way, options)


def _stress(k: int, effect: str) -> dict[str, Any]:
    kinds: tuple[dict[str, Any], ...] = (
        {"gust": 0.05},
        {"calm_wind": 0.12},
        {"onset": 35.0} if effect != "none" else {"jitter": 0.008},
        {"missing": 0.30},
        {"rate_hz": 100.0, "noise": "mocap"},
        {"rate_hz": 10.0},
        {"outliers": 0.03},
    )
    return kinds[k % len(kinds)]


def study(asked: Asked) -> dict[str, Any]:
    """Fly one case, ask the workflow, and only then look at the answer."""
    row: dict[str, Any] = {
        "key": asked.key, "aircraft": asked.aircraft, "effect": asked.effect, "seed": asked.seed,
        "airframe": asked.with_airframe, "options": asked.options,
    }  # fmt: skip
    try:
        case = make_case(asked.aircraft, asked.effect, asked.seed, **asked.options)
    except InputError as error:  # this aircraft cannot fly with so much of it
        return {**row, "answer": "not flown", "message": str(error)}
    row |= {"truth": {k: case.truth[k] for k in ("size", "kit", "noise", "outside", "onset")}}
    begun, wall = time.process_time(), time.perf_counter()
    try:
        report = _report(case, asked.with_airframe)
        row |= {
            "answer": report["verdict"], "effects": report["effects"],
            "ranking": [
                [r["effect"], round(r["gain"], 1), r["probability"]] for r in report["ranking"][:6]
            ],
            "parameters": {
                name: [p["value"], p["low95"], p["high95"]]
                for name, p in report["parameters"].items()
            },
            "gap": [report["gap"][name] for name in ("before", "after", "calm")],
            "threshold": report["threshold"], "added_to_base": report["added_to_base"],
            "unnamed": report["unnamed"], "strain": report["strain"], "seconds": report["seconds"],
            "warnings": report.get("warnings", [])[:6],
        }  # fmt: skip
    except InputError as error:
        row |= {"answer": "refused", "message": str(error)}
    except Exception as error:  # a traceback in front of the user is the worst answer
        last = traceback.extract_tb(error.__traceback__)[-1]
        row |= {
            "answer": "traceback", "message": f"{type(error).__name__}: {error}",
            "where": f"{Path(last.filename).name}:{last.lineno}",
        }  # fmt: skip
    row |= {"cpu_s": time.process_time() - begun, "wall_s": time.perf_counter() - wall}
    row["judged"] = judge(row)
    return row


def study_before(deadline: float, asked: Asked) -> dict[str, Any] | None:
    """The same, or None for a flight that would begin after the deadline (of `time.time`)."""
    return study(asked) if time.time() < deadline else None


def _report(case: Any, with_airframe: bool) -> dict[str, Any]:
    from falconwing_kit.aircraft.airframe import load_airframe
    from falconwing_kit.gap import Study

    airframe = None
    if with_airframe:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "airframe.toml"
            file.write_text(airframe_text(case), encoding="utf-8")
            airframe = load_airframe(file)
    report: dict[str, Any] = Study(
        baseline=case.calm, flight=case.flight, airframe=airframe
    ).report()
    json.dumps(report, allow_nan=False)  # as `falconwing gap` writes it
    return report


# Judging
# --------------------------------------------------------------------------------------------------

JUDGEMENTS = (
    "right", "ambiguous with it", "part", "quiet", "outside", "wrong name", "refused", "traceback",
    "not flown",
)  # fmt: skip


def merged(effect: str) -> str:
    """A late time stamp is a control delay: one class, as in gap_study."""
    return effect.replace("time_offset", "control_delay")


def judge(row: dict[str, Any]) -> str:
    """One word for an answer, from JUDGEMENTS.

    right: the name, all of several names; "none" where nothing is hidden; "outside" where it is in
    no catalogue. ambiguous with it: at most three names that hold the truth. part: some of several
    true names and no false one. quiet: "none" although something is hidden. outside: "outside"
    although the catalogue has it, or nothing is hidden. wrong name: says something that is not so.
    """
    answer = row["answer"]
    if answer in ("refused", "traceback", "not flown"):
        return str(answer)
    names = set(merged(row["effect"]).split("+"))
    true = names & {merged(name) for name in IN_CATALOGUE}
    found = {merged(name) for name in row["effects"]}
    if answer == "named":
        if found == true and names == true:
            return "right"
        return "part" if found and found <= true else "wrong name"
    if answer == "ambiguous":
        return "ambiguous with it" if true & found and len(found) <= 3 else "wrong name"
    if answer == "none":
        return "right" if names == {"none"} else "quiet"
    return "right" if names & set(BEYOND) else "outside"


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of a report: figures with 95 % intervals, counts per aircraft and effect, worst."""
    rows = [row for row in rows if row["answer"] != "not flown"]
    if not rows:
        return ["no flights yet"]
    lines = [
        f"{len(rows)} simulated flights of {len({r['aircraft'] for r in rows})} aircraft; "
        "in brackets: 95 % intervals (Wilson for shares, order statistics for medians)",
        "",
        *_figures(rows),
    ]
    for title, of in (("aircraft", "aircraft"), ("effect", "effect"), ("airframe", "airframe")):
        lines += ["", _counts(title, rows, of)]
    return [*lines, "", *_worst(rows)]


def _counts(title: str, rows: list[dict[str, Any]], of: str) -> str:
    words = [word for word in JUDGEMENTS[:-1] if any(judge(r) == word for r in rows)]
    width = max(len(str(r[of])) for r in rows) + 2
    heads = [w.rjust(max(len(w), 5) + 2) for w in words]
    lines = [title.ljust(width) + "".join(heads) + "  right of flights"]
    groups = sorted({str(r[of]) for r in rows})
    for group in [*groups, "all"]:
        some = [judge(r) for r in rows if group in ("all", str(r[of]))]
        counts = [some.count(word) for word in words]
        cells = [(str(c) if c else ".").rjust(len(h)) for c, h in zip(counts, heads, strict=True)]
        lines.append(group.ljust(width) + "".join(cells) + f"  {share(some.count('right'), some)}")
    return "\n".join(lines)


def _figures(rows: list[dict[str, Any]]) -> list[str]:
    calm = [r for r in rows if r["effect"] == "none"]
    single = [r for r in rows if merged(r["effect"]) in {merged(e) for e in IN_CATALOGUE}]
    beyond = [r for r in rows if r["effect"] in BEYOND]
    pairs = [r for r in rows if "+" in r["effect"]]
    lines = []
    for name, some in (
        ("one effect, named right", single),
        ("pairs, both named", pairs),
        ("one effect or two, named right", single + pairs),
        ("outside, said so", beyond),
        ("nothing hidden, quiet", calm),
        ("all, right", rows),
    ):
        lines.append(f"{name}: {share(sum(judge(r) == 'right' for r in some), some)}")
    wrong = sum(judge(r) == "wrong name" for r in rows)
    loud = sum(r["answer"] in ("named", "ambiguous", "outside") for r in calm)
    failed = sum(judge(r) in ("refused", "traceback") for r in rows)
    lines += [
        f"wrong names: {share(wrong, rows)}",
        f"false alarms (named, ambiguous or outside with nothing hidden): {share(loud, calm)}",
        f"refused or traceback: {share(failed, rows)}",
    ]
    for name, some in (("in the catalogue", single + pairs), ("outside it", beyond)):
        closed = gap_closed(some)
        lines.append(
            f"gap closed, {name}: {median(closed, 100.0, ' %')} of {len(closed)} "
            f"flights whose excess is over {CLEAR_GAP}"
        )
    inside = coverage(rows)
    lines.append(f"95 % intervals that hold the true size: {share(sum(inside), inside)} parameters")
    error, bins = reliability(rows)
    lines.append(f"reliability error of the first name's probability: {error:.3f}")
    lines += [f"  {b}" for b in bins]
    seconds = [r["cpu_s"] for r in rows if "cpu_s" in r]
    late = sum(s > 15.0 for s in seconds)
    if seconds:
        lines.append(
            f"CPU seconds a report: {median(seconds)}, 95 % {np.percentile(seconds, 95):.1f}, "
            f"most {max(seconds):.1f}; over 15 s: {share(late, seconds)}"
        )
    return lines


def share(count: int, of: list[Any]) -> str:
    """A count of so many, with the share and its Wilson interval [Wilson 1927]."""
    from scipy.stats import binomtest

    if not of:
        return "0 of 0"
    low, high = binomtest(count, len(of)).proportion_ci(0.95, "wilson")
    return f"{count} of {len(of)} = {count / len(of):.3f} [{low:.3f}, {high:.3f}]"


def median(values: list[float], scale: float = 1.0, unit: str = "") -> str:
    """The median and the order statistics that hold the true one in 95 % of samples."""
    from scipy.stats import binom

    if not values:
        return "none"
    n, ordered = len(values), scale * np.sort(values)
    low = int(max(binom.ppf(0.025, n, 0.5) - 1, 0))
    ends = f"{ordered[low]:.1f}, {ordered[n - 1 - low]:.1f}"
    return f"median {np.median(ordered):.1f}{unit} [{ends}]"


def gap_closed(rows: list[dict[str, Any]]) -> list[float]:
    """Share of the held-out excess that each answer removes; 0 for no answer is not hidden here:
    rows without an answer have no gap and are counted in the table as refused or traceback.
    """
    gaps = [r["gap"] for r in rows if "gap" in r]
    return [
        # Infinite where a prediction diverges: all is closed or nothing.
        (b - a) / (b - c) if np.isfinite([a, b]).all() else float(np.isfinite(a))
        for b, a, c in gaps
        if b - c > CLEAR_GAP
    ]


def coverage(rows: list[dict[str, Any]]) -> list[bool]:
    """Whether each interval of a rightly named effect holds the true value, where it has one."""
    inside = []
    for row in rows:
        if judge(row) in ("right", "part") and row["answer"] == "named":
            for name, (_, low, high) in row["parameters"].items():
                if name in row["truth"]["kit"]:
                    inside.append(low <= row["truth"]["kit"][name] <= high)
    return inside


def reliability(rows: list[dict[str, Any]]) -> tuple[float, list[str]]:
    """How far the first name's probability is from how often that name is right.

    Mean over flights of |mean probability - share of right names| of their bin [Guo et al. 2017].
    A first name that is one of several hidden ones is right; with nothing hidden, or something
    outside the catalogue, it is not.

    Returns:
        The error, and a line for each bin.
    """
    said, right = [], []
    for row in rows:
        if row.get("ranking"):
            name, _, probability = row["ranking"][0]
            said.append(probability)
            right.append(merged(name) in merged(row["effect"]).split("+"))
    if not said:
        return float("nan"), []
    p, hit = np.array(said), np.array(right)
    number = np.clip(np.searchsorted(PROBABILITY_BINS, p, side="right") - 1, 0, None)
    error, lines = 0.0, []
    for k in np.unique(number):
        some = hit[number == k]
        error += abs(float(p[number == k].sum() - some.sum())) / len(p)
        lines.append(
            f"said {p[number == k].mean():.3f}: right {share(int(some.sum()), some.tolist())}"
        )
    return error, lines


def _worst(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    for row in rows:
        if judge(row) in ("traceback", "refused"):
            where = f" at {row['where']}" if "where" in row else ""
            lines.append(f"{judge(row)}: {row['key']}: {row['message'][:150]}{where}")
        elif judge(row) in ("wrong name", "outside"):
            lines.append(
                f"{judge(row)}: {row['key']} -> {row['answer']} {'+'.join(row['effects'])} "
                f"{row['ranking'][:2]}"
            )
    return lines


# Command line
# --------------------------------------------------------------------------------------------------


def main() -> None:
    """Run a study, or go on with it, and print its table; --summary prints that of finished rows.

    --budget-s: no flight begins later than this many seconds after the start; those begun are
    finished and written.
    """
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--summary", type=Path, nargs="+", help="files of rows: print their table")
    parser.add_argument("--seed", type=int, help="of the first case")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2, help="processes of one thread each")
    parser.add_argument("--budget-s", type=float, default=float("inf"), help="wall seconds")
    parser.add_argument("--aircraft", nargs="*", default=list(AIRCRAFT), choices=AIRCRAFT)
    parser.add_argument("--effect", nargs="*", default=[], help="only these, in turn")
    parser.add_argument(
        "--airframe", choices=("with", "without", "both", "alternate"), default="alternate"
    )
    parser.add_argument(
        "--stress", action="store_true", help="gusts, onsets, few poses, other rates"
    )
    parser.add_argument("--out", type=Path, help="JSON lines; gone on with")
    asked = parser.parse_args()
    if asked.summary:
        print("\n".join(summary([row for file in asked.summary for row in read_rows(file)])))
        return
    if asked.seed is None or asked.out is None:
        parser.error("expected --seed and --out to run a study, or --summary FILE")
    run(asked, time.time() + asked.budget_s)
    print("\n".join(summary(read_rows(asked.out))))


def run(asked: argparse.Namespace, deadline: float) -> None:
    """Fly what is not yet in asked.out, in random order, and write a line as each flight ends."""
    from tqdm import tqdm

    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # the workers inherit it: one core each
    known = {row["key"] for row in read_rows(asked.out)}
    wanted = list(
        cases(
            asked.seed, asked.count, tuple(asked.aircraft), tuple(asked.effect), asked.airframe,
            asked.stress,
        )
    )  # fmt: skip
    order = np.random.default_rng(asked.seed).permutation(len(wanted))
    left = [wanted[k] for k in order if wanted[k].key not in known]
    make_case("cub", seed=0, seconds=(2.0, 2.0))  # compiled once, read by all workers
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    with asked.out.open("a+", encoding="utf-8") as file:
        if file.tell() and not asked.out.read_bytes().endswith(b"\n"):
            file.write("\n")  # after a line that was cut short
        jobs = parallel_map(partial(study_before, deadline), left, asked.workers)
        for case, row in tqdm(jobs, total=len(left), unit="flight"):
            if isinstance(row, WorkerLostError):  # left for the next run
                print(f"{case.key}: {row}", flush=True)
            elif row is not None:
                file.write(json.dumps(row) + "\n")
                file.flush()


def read_rows(file: Path) -> list[dict[str, Any]]:
    """The finished rows of a study; none where there is no file, nor of a line cut short."""
    rows = []
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        with contextlib.suppress(json.JSONDecodeError):
            rows.append(json.loads(line))
    return rows


if __name__ == "__main__":
    main()
