"""The gap workflow on aircraft that are not ours: seeds -> one line of JSON each, and a table.

    python -m tests.benchmarks.foreign_study --seed 30000 --count 200 --workers 16 --out rows.jsonl

Runs the whole workflow as a user would (`Study(...).report()`), with an airframe file of three keys
or without, and records whatever it answers; an exception is the worst answer. All flights are
simulated (`foreign_flights`). A file that exists is gone on with, so a study can be stopped and
resumed. Nothing here may be tuned on the seeds that are reported.
"""

import argparse
import json
import os
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
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
            "ranking": [[r["effect"], round(r["gain"], 1)] for r in report["ranking"][:4]],
            "parameters": {
                name: [p["value"], p["low95"], p["high95"]]
                for name, p in report["parameters"].items()
            },
            "gap": [report["gap"][name] for name in ("before", "after", "calm")],
            "threshold": report.get("threshold"), "added_to_base": report.get("added_to_base"),
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
    """Lines of a report: counts per aircraft and per effect, then figures."""
    rows = [row for row in rows if row["answer"] != "not flown"]
    lines = [f"{len(rows)} simulated flights of {len({r['aircraft'] for r in rows})} aircraft"]
    for title, of in (("aircraft", "aircraft"), ("effect", "effect"), ("airframe", "airframe")):
        lines += ["", _counts(title, rows, of)]
    return [*lines, "", *_figures(rows), "", *_worst(rows)]


def _counts(title: str, rows: list[dict[str, Any]], of: str) -> str:
    words = [word for word in JUDGEMENTS[:-1] if any(judge(r) == word for r in rows)]
    width = max(len(str(r[of])) for r in rows) + 2
    lines = [title.ljust(width) + "".join(w.rjust(max(len(w), 5) + 2) for w in [*words, "flights"])]
    groups = sorted({str(r[of]) for r in rows})
    for group in [*groups, "all"]:
        some = [r for r in rows if group in ("all", str(r[of]))]
        counts = [sum(judge(r) == word for r in some) for word in words] + [len(some)]
        lines.append(
            group.ljust(width)
            + "".join(
                (str(c) if c else ".").rjust(max(len(w), 5) + 2)
                for c, w in zip(counts, [*words, "flights"], strict=True)
            )
        )
    return "\n".join(lines)


def _figures(rows: list[dict[str, Any]]) -> list[str]:
    calm = [r for r in rows if r["effect"] == "none"]
    single = [r for r in rows if merged(r["effect"]) in {merged(e) for e in IN_CATALOGUE}]
    beyond = [r for r in rows if r["effect"] in BEYOND]
    pairs = [r for r in rows if "+" in r["effect"]]
    lines = []
    for name, some in (
        ("one effect", single),
        ("pairs", pairs),
        ("outside", beyond),
        ("none", calm),
    ):
        if some:
            right = sum(judge(r) == "right" for r in some)
            wrong = sum(judge(r) == "wrong name" for r in some)
            lines.append(f"{name}: right {right} of {len(some)}, wrong name {wrong}")
    if calm:
        loud = sum(r["answer"] in ("named", "ambiguous", "outside") for r in calm)
        lines.append(
            f"false alarms (named, ambiguous or outside with nothing hidden): {loud} of {len(calm)}"
        )
    for name, some in (("in the catalogue", single + pairs), ("outside it", beyond)):
        closed = gap_closed(some)
        if closed:
            lines.append(
                f"gap closed, {name}: median {100.0 * np.median(closed):.0f} % of {len(closed)} "
                f"flights whose excess is over {CLEAR_GAP}"
            )
    inside = coverage(rows)
    if inside:
        lines.append(
            f"95 % intervals hold the true size: {100.0 * np.mean(inside):.0f} % of "
            f"{len(inside)} parameters"
        )
    seconds = [r["cpu_s"] for r in rows if "cpu_s" in r]
    lines.append(
        f"CPU seconds a report: median {np.median(seconds):.1f}, "
        f"95 % {np.percentile(seconds, 95):.1f}, "
        f"most {max(seconds):.1f}"
    )
    return lines


def gap_closed(rows: list[dict[str, Any]]) -> list[float]:
    """Share of the held-out excess that each answer removes; 0 for no answer is not hidden here:
    rows without an answer have no gap and are counted in the table as refused or traceback.
    """
    gaps = [r["gap"] for r in rows if "gap" in r]
    return [(b - a) / (b - c) for b, a, c in gaps if b - c > CLEAR_GAP]


def coverage(rows: list[dict[str, Any]]) -> list[bool]:
    """Whether each interval of a rightly named effect holds the true value, where it has one."""
    inside = []
    for row in rows:
        if judge(row) == "right" and row["answer"] == "named":
            for name, (_, low, high) in row["parameters"].items():
                if name in row["truth"]["kit"]:
                    inside.append(low <= row["truth"]["kit"][name] <= high)
    return inside


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
    """Run a study, or go on with it, and print its table."""
    from tqdm import tqdm

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, required=True, help="of the first case")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--aircraft", nargs="*", default=list(AIRCRAFT), choices=AIRCRAFT)
    parser.add_argument("--effect", nargs="*", default=[], help="only these, in turn")
    parser.add_argument(
        "--airframe", choices=("with", "without", "both", "alternate"), default="alternate"
    )
    parser.add_argument(
        "--stress", action="store_true", help="gusts, onsets, few poses, other rates"
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; gone on with")
    asked = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # the workers inherit it: one core each
    done = []
    if asked.out.exists():
        done = [json.loads(line) for line in asked.out.read_text(encoding="utf-8").splitlines()]
    known = {row["key"] for row in done}
    wanted = list(
        cases(
            asked.seed, asked.count, tuple(asked.aircraft), tuple(asked.effect), asked.airframe,
            asked.stress,
        )
    )  # fmt: skip
    left = [case for case in wanted if case.key not in known]
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    with asked.out.open("a", encoding="utf-8") as file:
        jobs = parallel_map(study, left, asked.workers)
        for case, row in tqdm(jobs, total=len(left), unit="flight"):
            if isinstance(row, WorkerLostError):  # left for the next run
                print(f"{case.key}: {row}", flush=True)
                continue
            done.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    print("\n".join(summary(done)))


if __name__ == "__main__":
    main()
