"""How well the gap workflow names: flights made from fresh seeds -> one line of JSON each, and a
table.

    python -m tests.benchmarks.gap_study independent --seed 20000 --out independent.jsonl

Kinds: independent (JSBSim aircraft, every effect in turn, named with the full catalogue and again
with the true effect withheld), calm (nothing hidden), pairs (two effects at once), outside (effects
in no catalogue), own (the kit's own aircraft, 60 s). All flights are simulated. A file that exists
is gone on with, so a study can be stopped and resumed.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.baseline import NominalModel, identify_baseline
from falconwing_kit.gap.close import close_gap, name_with_onset
from falconwing_kit.gap.name import Naming, name_effect
from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map
from falconwing_kit.tools.trials.hidden import hidden_flights
from tests.hidden_effects import IN_CATALOGUE, OUTSIDE
from tests.hidden_flights import make_case

NOISES = ("marker", "hybrid", "net", "marker", "hybrid")
BASELINED = ("independent", "calm", "own")  # kinds that the usual recipe is tried on as well
PAIRS = (
    "wind+battery_sag",
    "extra_drag+adverse_yaw",
    "control_delay+wind",
    "ground_effect+propeller_torque",
    "mass_change+camera_tilt",
    "thrust_loss+trim_bias",
    "flap+adverse_yaw",
    "aileron_loss+wind",
    "fan_jet+extra_drag",
    "cg_shift+battery_sag",
    "deadband+wind",
    "actuator_lag+propeller_torque",
)


@dataclass(frozen=True)
class Case:
    """One flight to be named."""

    kind: str
    seed: int
    effect: str
    noise: str
    correlated: bool
    withhold: bool  # name once more without the true effect in the catalogue
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """What a line is recognised by when a study is resumed."""
        return f"{self.kind} {self.seed} {self.effect} {self.noise}"


def cases(kind: str, seed: int, count: int | None, withheld: int) -> Iterator[Case]:
    """The cases of a study; every third flight with time-correlated noise, every second of the calm
    ones.
    """
    effects = {
        "independent": IN_CATALOGUE,
        "calm": ("none",),
        "pairs": PAIRS,
        "outside": OUTSIDE,
        "own": IN_CATALOGUE,
    }[kind]
    noises = {"pairs": ("marker", "hybrid"), "own": ("marker",)}.get(kind, NOISES)
    usual = {
        "independent": 5 * len(IN_CATALOGUE),
        "calm": 60,
        "pairs": 24,
        "outside": 21,
        "own": 5 * len(IN_CATALOGUE),
    }[kind]
    for k in range(count or usual):
        effect, round_ = effects[k % len(effects)], k // len(effects)
        # The noise changes from round to round, so that every effect meets every noise.
        noise = noises[(k if kind in ("calm", "outside") else round_) % len(noises)]
        correlated = k % 2 == 1 if kind == "calm" else kind != "own" and (k + round_) % 3 == 2
        options = {"pose_bias": (0.0, 0.0, 0.03)[k % 3]} if kind == "calm" else {}
        number = (
            round_ if kind == "own" else k
        )  # own: all effects of a round are flown by one aircraft
        yield Case(
            kind,
            seed + number,
            effect,
            noise,
            correlated,
            kind == "independent" and k < withheld,
            options,
        )


def study(batch: list[Case], with_baselines: bool = True) -> list[dict[str, Any]]:
    """Fly cases of one aircraft, name each, close its gap, and only then look at the answer."""
    rows: list[dict[str, Any]] = []
    base, known_seconds = None, 0.0
    for case, calm, flight, truth in _fly(batch):
        clock = [time.process_time()]
        if base is None:
            base = identify_baseline(calm)
            known_seconds = time.process_time() - clock[0]
        clock = [time.process_time()]
        naming, _ = name_with_onset(base, flight)
        clock.append(time.process_time())
        closed = close_gap(base, naming)
        clock.append(time.process_time())
        row: dict[str, Any] = {
            "key": case.key,
            "kind": case.kind,
            "seed": case.seed,
            "effect": case.effect,
            "noise": case.noise,
            "correlated": case.correlated,
            **answer(naming, case.effect),
            "gap": [closed.before.chi2, closed.after.chi2, closed.calm.chi2],
            "parameters": {
                name: [size.value, size.low95, size.high95, truth["kit"].get(name)]
                for name, size in closed.parameters.items()
            },
            "size": truth["size"],
            "seconds": {
                "calm": known_seconds,
                "name": clock[1] - clock[0],
                "close": clock[2] - clock[1],
            },
        }
        known = _merged(case.effect)
        if case.withhold:
            rest = [e for e in CATALOGUE if e.name != known]
            row["withheld"] = answer(name_with_onset(base, flight, rest)[0], case.effect)
        if case.kind == "own":
            row["detectable"] = _detectable(base, flight, known)
        if with_baselines and case.kind in BASELINED:
            row["baselines"] = _baselines(base, flight)
        rows.append(row)
    return rows


Flown = tuple[Case, FlightTable, FlightTable, dict[str, Any]]


def _fly(batch: list[Case]) -> Iterator[Flown]:
    first = batch[0]
    if first.kind == "own":
        yield from _fly_own(batch)
    else:
        case = make_case(first.seed, first.effect, first.noise, first.correlated, **first.options)
        yield first, case.calm, case.flight, case.truth


def _fly_own(batch: list[Case]) -> list[Flown]:
    """Flights of the kit's own aircraft; one whose effect leaves no flight inside the hall is left
    out and said so.
    """
    effects = [case.effect for case in batch]
    while True:
        try:
            made = hidden_flights(batch[0].seed, effects, noise="marker", flight_seconds=60.0)
        except InputError as error:  # names the effect
            number = next(
                k for k, effect in enumerate(effects) if f"a flight with {effect} " in str(error)
            )
            print(f"left out: {batch[number].key}: {error}", flush=True)
            effects[number] = "none"  # keeps the others' numbers, so their flights
        else:
            trials = zip(batch, effects, made, strict=True)
            return [
                (case, own.calm, own.flight, {**own.truth, "kit": own.truth["size"]})
                for case, effect, own in trials
                if case.effect == effect
            ]


def answer(naming: Naming, effect: str) -> dict[str, Any]:
    """What a study writes of a naming, for the judgement; `effect` is the hidden one."""
    names = [c.effect.name for c in naming.chosen]
    order = [c.effect.name for c in naming.ranking]
    true = _merged(effect)
    return {
        "verdict": naming.verdict,
        "effects": names,
        "ranking": [[c.effect.name, round(c.delta_bic, 1)] for c in naming.ranking[:4]],
        "place": order.index(true) + 1 if true in order else None,
        "threshold": naming.threshold,
        "excess": naming.excess_chi2,
        "left": naming.remaining_chi2,
        "strain": naming.mahalanobis,
        "unnamed": [naming.generic.effect.name, round(naming.generic.delta_bic, 1)],
    }


def _merged(effect: str) -> str:
    """A late time stamp is a control delay: one class."""
    return effect.replace("time_offset", "control_delay")


def _detectable(base: NominalModel, flight: FlightTable, effect: str) -> float:
    """Held-out chi2 by which the true model beats the base model, both fitted to the rest."""
    alone = name_effect(base, flight, [e for e in CATALOGUE if e.name == effect])
    closed = close_gap(base, replace(alone, verdict="named", chosen=alone.ranking[:1]))
    components = np.count_nonzero(alone.windows.weight[closed.held_out])
    return float((closed.before_with_free_parameters.chi2 - closed.after.chi2) * components)


def _baselines(base: NominalModel, flight: FlightTable) -> dict[str, str]:
    try:
        from tests.benchmarks.baselines import baseline_answers
    except ImportError:  # PySINDy comes with the extra `bench`
        return {}
    return baseline_answers(base, flight)


# Judging
# --------------------------------------------------------------------------------------------------


def points(row: dict[str, Any], effect: str) -> float:
    """1 for the right name, one half for a set of at most three that holds it, 0 otherwise."""
    true = set() if effect == "none" else set(_merged(effect).split("+"))
    found = set(row["effects"])
    if row["verdict"] == "ambiguous":
        return 0.5 if len(found) <= 3 and true & found else 0.0
    if effect == "none":
        return float(row["verdict"] == "none")
    return float(row["verdict"] == "named" and found == true)


def is_wrong(row: dict[str, Any], effect: str) -> bool:
    """Whether it says something that is not so; "none" and "outside" say nothing."""
    true = set() if effect == "none" else set(_merged(effect).split("+"))
    found = set(row["effects"])
    return bool(found) and (not found <= true if row["verdict"] == "named" else not found & true)


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of a report about finished rows of one kind."""
    lines = [f"{rows[0]['kind']}: {len(rows)} flights, seeds {min(r['seed'] for r in rows)} to "
             f"{max(r['seed'] for r in rows)}"]  # fmt: skip
    for noise in dict.fromkeys(r["noise"] for r in rows):
        some = [r for r in rows if r["noise"] == noise]
        lines.append(f"  {noise}: {_figures(some)}")
    lines.append(f"  all: {_figures(rows)}")
    held = [r for r in rows if "withheld" in r]
    if held:
        wrong = [r for r in held if is_wrong(r["withheld"], "none")]
        lines.append(
            f"  true effect withheld: {len(wrong)} of {len(held)} named as something else: "
            + ", ".join(map(_withheld_answer, wrong))
        )
    if rows[0]["kind"] in ("independent", "own"):
        lines += _accuracy(rows)
    lines += _beside_baselines(rows)
    lines += [_mistake(r) for r in rows if not right_or_outside(r)]
    seconds = {
        stage: np.median([r["seconds"][stage] for r in rows]) for stage in rows[0]["seconds"]
    }
    lines.append(
        "  CPU seconds, median: " + ", ".join(f"{stage} {s:.1f}" for stage, s in seconds.items())
    )
    return lines


def _withheld_answer(row: dict[str, Any]) -> str:
    return f"{row['effect']} as {'+'.join(row['withheld']['effects'])}"


def _mistake(row: dict[str, Any]) -> str:
    noise = f"{row['noise']}{'~' if row['correlated'] else ''}"
    return (
        f"  not right: {row['seed']} {row['effect']} {noise} -> {row['verdict']} "
        f"{'+'.join(row['effects'])} {row['ranking'][:2]} unnamed {row['unnamed']} "
        f"left {row['left']:.3f} of {row['excess']:.3f}"
    )


def right_or_outside(row: dict[str, Any]) -> bool:
    """Right; for an effect in no catalogue, not named."""
    return not row["effects"] if row["kind"] == "outside" else points(row, row["effect"]) == 1.0


def _figures(rows: list[dict[str, Any]]) -> str:
    outside = rows[0]["kind"] == "outside"  # right is what has no name
    right = sum(float(right_or_outside(r)) if outside else points(r, r["effect"]) for r in rows)
    wrong = sum(is_wrong(r, r["effect"]) for r in rows)
    text = f"{len(rows)} flights, right {right:g} ({right / len(rows):.3f}), wrong name {wrong}"
    if rows[0]["kind"] == "pairs":
        both = sum(set(r["effect"].split("+")) <= set(r["effects"]) for r in rows)
        return f"{text}, both reported {both}"
    places = [r["place"] for r in rows if r["place"]]
    return f"{text}, truth among the first three {sum(p <= 3 for p in places)}" if places else text


def _accuracy(rows: list[dict[str, Any]]) -> list[str]:
    named = [r for r in rows if points(r, r["effect"]) == 1.0]
    clear = [r for r in rows if r.get("detectable", 0.0) > 20.0]
    falls = [(b - a) / (b - c) for b, a, c in (r["gap"] for r in named) if b - c > 0.05]
    sizes = [p for r in named for p in r["parameters"].values() if p[3] is not None]
    errors = [abs(value / true - 1.0) for value, _, _, true in sizes if abs(true) > 1e-9]
    inside = [low <= true <= high for _, low, high, true in sizes]
    lines = [
        f"  the true model wins by more than 20 chi2 held out: {len(clear)} flights, right "
        f"{sum(points(r, r['effect']) for r in clear) / len(clear):.3f}"
    ] if clear else []  # fmt: skip
    return [
        *lines,
        f"  named right: the held-out excess falls by {100 * np.median(falls):.0f} % "
        f"(median of {len(falls)} whose excess was over 0.05); parameters off by "
        f"{100 * np.median(errors):.1f} % (median of {len(errors)}), "
        f"intervals hold {100 * np.mean(inside):.0f} %",
    ]


def _beside_baselines(rows: list[dict[str, Any]]) -> list[str]:
    """Top-1 of each baseline on the same flights; whoever picks a threshold from this table picks
    it in hindsight.
    """
    lines = []
    for name in sorted({name for r in rows for name in r.get("baselines", ())}):
        right = sum(
            r["baselines"].get(name) in (r["effect"], _merged(r["effect"])) for r in rows
        ) / len(rows)
        lines.append(f"  baseline {name}: right {right:.3f}")
    return lines


def main() -> None:
    """Run a study, or go on with it, and print its table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("kind", choices=("independent", "calm", "pairs", "outside", "own"))
    parser.add_argument("--seed", type=int, required=True, help="of the first flight")
    parser.add_argument("--cases", type=int, default=None)
    parser.add_argument(
        "--withheld", type=int, default=38, help="this many of the independent ones again without"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--without-baselines", action="store_true", help="no comparison with PySINDy and regression"
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="JSON lines; gone on with where it exists"
    )
    asked = parser.parse_args()
    if not asked.without_baselines and asked.kind in BASELINED and find_spec("pysindy") is None:
        parser.error(
            "expected pysindy to compare with; "
            "run: pip install -c constraints.txt -e '.[dev,bench]', or add --without-baselines"
        )
    done = (
        [json.loads(line) for line in asked.out.read_text().splitlines()]
        if asked.out.exists()
        else []
    )
    known = {row["key"] for row in done}
    left = [
        c for c in cases(asked.kind, asked.seed, asked.cases, asked.withheld) if c.key not in known
    ]
    with asked.out.open("a") as file:
        batches = [list(cases) for _, cases in groupby(left, key=lambda c: c.seed)]
        fly = partial(study, with_baselines=not asked.without_baselines)
        for batch, rows in parallel_map(fly, batches, asked.workers):
            if isinstance(rows, WorkerLostError):  # left for the next run
                print(f"{batch[0].key}: {rows}", flush=True)
                continue
            for row in rows:
                done.append(row)
                file.write(json.dumps(row) + "\n")
                print(
                    f"{len(done)} {row['key']}: {row['verdict']} {'+'.join(row['effects'])}",
                    flush=True,
                )
            file.flush()
    print("\n".join(summary([r for r in done if r["kind"] == asked.kind])))


if __name__ == "__main__":
    main()
