"""The closing experiment: hidden aircraft and effects -> landings by the expert before and after.

    python -m tests.benchmarks.closing_experiment --seed S --workers 2 --out pairs.jsonl
    python -m tests.benchmarks.closing_experiment --seed S --out pairs.jsonl --summary

Every pair is an aircraft that JSBSim flies and an effect hidden in it; the kit's own simulator
flies nothing here. Half of the effects have a size between just visible and plain to see, as in all
hidden flights, the others one that is plain to see. Of each pair:

1. a baseline flight without the effect gives the nominal model, model.toml;
2. with the effect, a minute after the start, the aircraft is landed by the expert designed on it;
3. a minute of the usual excited figure eights with the effect is studied as by `gap`; the report
   proposes a manoeuvre, which a simulated pilot flies for 45 s (the first proposed one that stays
   in the hall; the figure eights again where it proposes none);
4. both flights together are studied as by `gap --improve`, which names the effect and writes
   model_improved.toml;
5. landed again by the expert designed on that, and by the one designed on the truth: the
   aircraft's own coefficients and the effect's own size in the kit's units. All have the same
   starts and noise.

Success, absolute lateral deviation (ALD) and sink rate are those of the landing task. Pairs come in
a random order, and the file keeps one line of JSON for each, so a study that was stopped is a fair
sample and can be gone on with. The summary stands beside it: .csv, .json and .png. All flights are
simulated.
"""

import argparse
import csv
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe, load_airframe
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import LandingExpert
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import euler_from_rotation, rotation_world_body, wrap_angle
from falconwing_kit.core.messages import Command, Observation, State
from falconwing_kit.flight.judges import LandingEvaluator
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.tasks.landing import DISTANCE, HEIGHT, SPREAD
from falconwing_kit.flight.trial import TrialSetup, trial_seed
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.gap.advice import advise
from falconwing_kit.gap.study import GapStudy, gap_record, study_gap
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.sysid.model_file import read_model, write_model
from falconwing_kit.tools.jobs.pool import WorkerLostError
from falconwing_kit.tools.jobs.run import parallel_map
from falconwing_kit.tools.reports.gap_report import write_best_model
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, figure
from falconwing_kit.tools.trials.trials import fly_trial
from tests.diagnosis_pilot import diagnosis_pilot
from tests.hidden_effects import EFFECTS, IN_CATALOGUE, LEAD, Acting
from tests.hidden_flights import HiddenCase, fly_on, make_case
from tests.jsbsim_aircraft import (
    STEP,
    STICKS,
    JsbsimAircraft,
    figure_eights,
    kit_state,
    new_fdm,
)

EXPERTS = ("nominal", "improved", "truth")
NOISES = ("marker", "hybrid")  # of the flights that are identified, in turn
PLAIN = (0.6, 1.0)  # of the size that is plain to see
USUAL_S, DIAGNOSIS_S = 60.0, 45.0  # of the flight before the report's proposal, and of that
PROPOSED = 3  # manoeuvres tried, the best first
PAIR_S = 90.0  # a pair begins only where so much of the budget is left
LANDINGS = 5  # of each expert and pair
FLOWN_S = 60.0  # of the flight before the landing begins: a battery has sagged for a minute
FLIGHT_S = 12.0  # of a landing, at most
RESAMPLES = 10_000
Array = np.ndarray


# The aircraft that another simulator flies
# -----------------------------------------


class JsbsimFlight:
    """A JSBSim aircraft with its effect, step by step, with the interface of the kit's own.

    Commands arrive after the link's delay and the aircraft's; the first one also acts before its
    time, its servos settled there.
    """

    def __init__(self, acting: Acting, start: Array) -> None:
        self.t, self.x = 0.0, start.copy()
        self.acting, self._start = acting, start
        self._fdm: Any = None
        self._sent: list[tuple[int, Array]] = []  # step at which a command acts, command
        self._steps = 0
        self.history = [start.copy()]  # a state each STEP

    def send(self, t: float, commands: Array) -> None:
        """Send commands (4,) at a time [s]."""
        delay = LINK_DELAY_S + self.acting.aircraft.delay
        self._sent.append((round((t + delay) / STEP), np.asarray(commands, np.float64)))

    def advance(self, t: float) -> None:
        """Fly until t [s], in whole steps of JSBSim."""
        for _ in range(round((t - self.t) / STEP)):
            self._step()
        self.t = t

    def _step(self) -> None:
        if self._fdm is None:
            first = self._sent[0][1] if self._sent else np.zeros(4)
            self._fdm = new_fdm(self.acting.aircraft, self._start, first)
        acting_now = [command for step, command in self._sent if step <= self._steps]
        sticks = acting_now[-1] if acting_now else self._sent[0][1]
        for name, value in zip(STICKS, sticks, strict=True):
            self._fdm[f"falcon/{name}-stick"] = float(value)
        if self.acting.before_step is not None:
            self.acting.before_step(LEAD + FLOWN_S + self._steps * STEP, self._fdm)
        self._fdm.run()
        self._steps += 1
        self.x = kit_state(self._fdm)
        self.x[4] = wrap_angle(self.x[4])  # JSBSim's heading is 0 to 360 deg
        self.history.append(self.x)

    def camera(self, state: State) -> State:
        """What the camera measures: late by the effect's time, turned by its tilt."""
        late = round(self.acting.late / STEP)
        if late and self._steps:
            state = State.from_vector(self.history[max(len(self.history) - 1 - late, 0)])
        if not any(self.acting.tilt):
            return state
        turned = rotation_world_body(self.acting.tilt[1], self.acting.tilt[0], 0.0)
        R_body_camera = rotation_world_body(0.0, 0.0, 0.0).T @ turned
        R_world_camera = rotation_world_body(state.roll, state.pitch, state.yaw) @ R_body_camera
        roll, pitch, yaw = map(float, euler_from_rotation(R_world_camera))
        return replace(state, roll=roll, pitch=pitch, yaw=yaw)


@dataclass(frozen=True)
class JsbsimLanding:
    """The landing task of the kit, flown by a JSBSim aircraft with a hidden effect."""

    aircraft: JsbsimAircraft
    effect: str
    size: dict[str, Any]
    truth: Model  # of the start's trim
    airframe: Airframe = field(default_factory=load_airframe)
    pad: LandingPad = field(default_factory=LandingPad)
    name: str = "landing in another simulator"
    start: State | None = None

    def leader(self, seed: int) -> None:
        """None: there is no leader."""

    def trial(self, seed: int) -> TrialSetup:
        """The world of a seed: start and noise do not depend on the pilot."""
        nominal = np.array([self.pad.x_start - DISTANCE, self.pad.y_centre, HEIGHT])
        start = SPREAD.start(self.truth, nominal, seed)
        flight = JsbsimFlight(EFFECTS[self.effect].act(self.aircraft, self.size), start.vector)
        world = SimulatedWorld(
            flight, self.airframe, start, seed=seed, pad=self.pad, camera=flight.camera
        )
        return TrialSetup(seed, world, None, FLIGHT_S)

    def judge(
        self, trial: TrialSetup, camera: PinholeCamera, view: object = None
    ) -> LandingEvaluator:
        """The kit's own evaluator."""
        return LandingEvaluator(trial.world)

    def expert(self, trial: TrialSetup, model: Model | None = None) -> Pilot:
        """The kit's landing expert, designed on a model, on the clock of the whole flight."""
        return _Later(LandingExpert(model or self.truth, self.airframe, self.pad))


class _Later:
    """A pilot whose clock started FLOWN_S before the loop's."""

    def __init__(self, pilot: LandingExpert) -> None:
        self.pilot = pilot

    @property
    def mode(self) -> str:
        return self.pilot.mode

    def act(self, observation: Observation) -> Command:
        return self.pilot.act(replace(observation, t=observation.t + FLOWN_S))


def truth_model(aircraft: JsbsimAircraft, effect: str, size: dict[str, Any], kit: Any) -> Model:
    """The kit's model of a JSBSim aircraft with an effect, from its own coefficients and size.

    Args:
        aircraft: without the effect.
        effect: a name of tests.hidden_effects.EFFECTS.
        size: in JSBSim's units.
        kit: the effect's size in the kit's parameters, as far as they have a counterpart.
    """
    model, values = aircraft.kit_model(), dict(kit)
    if effect == "none":
        return model
    if effect == "actuator_lag" and size["in_series"]:
        values = {"lag_in_series": values["actuator_lag"]}
    if effect == "ground_effect":  # its share of the induced drag is that of the lift gained
        values["ground_drag"] = size["ge"] * size["less_drag"]
    name = "control_delay" if effect == "time_offset" else effect
    entry = next(
        e for e in CATALOGUE if e.name == name and set(values) <= {p.name for p in e.parameters}
    )
    return model.with_effect(entry).with_values(values)


# One pair
# --------


@dataclass(frozen=True)
class Pair:
    """One hidden aircraft and effect."""

    seed: int
    effect: str
    noise: str
    plain: bool  # size plain to see; else drawn between just visible and that
    landings: int = LANDINGS

    @property
    def size(self) -> dict[str, Any] | None:
        """A plain size of the effect, for the kit's 150 g aircraft; None where it is drawn."""
        if not self.plain:
            return None
        rng, effect = np.random.default_rng([self.seed, 42]), EFFECTS[self.effect]
        return effect.draw(rng, effect.plain * rng.uniform(*PLAIN), JsbsimAircraft())


def draw_pairs(count: int, seed: int, landings: int = LANDINGS) -> list[Pair]:
    """Pairs in which every effect of the catalogue comes up equally often, in a random order."""
    rng, effects = np.random.default_rng([seed, 41]), list[str]()
    while len(effects) < count:
        effects += [str(name) for name in rng.permutation(IN_CATALOGUE)]
    return [
        Pair(seed + k, effects[k], NOISES[k // 2 % len(NOISES)], k % 2 == 1, landings)
        for k in range(count)
    ]


def fly_pair(pair: Pair) -> dict[str, Any]:
    """Land, diagnose, improve and land one pair.

    Returns:
        Verdicts, and per expert the landings or the sentence why it was refused.
    """
    begun = time.process_time()
    try:
        case = make_case(pair.seed, pair.effect, pair.noise, size=pair.size, flight_seconds=USUAL_S)
    except InputError:  # no flight with so large an effect stays in the hall
        case = make_case(pair.seed, pair.effect, pair.noise, flight_seconds=USUAL_S)
    size, kit = case.truth["size"], case.truth["kit"]
    truth = truth_model(case.aircraft, pair.effect, size, kit)
    first = study_gap(case.calm, case.flight)
    flown, both = fly_proposed(case, first)
    study = first if both is None else study_gap(case.calm, both)
    record = gap_record(study)
    with tempfile.TemporaryDirectory() as name:
        nominal, improved = Path(name) / "model.toml", Path(name) / "model_improved.toml"
        write_model(nominal, first.base.found)
        write_best_model(study, improved)
        by_expert = {
            "nominal": read_model(nominal).model,
            "improved": read_model(improved).model,
            "truth": truth,
        }
    task = JsbsimLanding(case.aircraft, pair.effect, size, truth)
    landings = {name: land(task, model, pair.landings) for name, model in by_expert.items()}
    return {
        "seed": pair.seed,
        "effect": pair.effect,
        "noise": pair.noise,
        "plain": pair.plain,
        "size": json.loads(json.dumps(size)),
        "first_verdict": first.naming.verdict,
        "first_named": [c.effect.name for c in first.naming.chosen],
        "diagnosis_flight": flown,
        "verdict": record["verdict"],
        "named": record["effects"],
        "parameters": {key: p["value"] for key, p in record["parameters"].items()},
        "kit_size": json.loads(json.dumps(kit)),
        "landings": landings,
        "cpu_s": time.process_time() - begun,
    }


def fly_proposed(case: HiddenCase, study: GapStudy) -> tuple[str, FlightTable | None]:
    """Fly the manoeuvre that a report proposes for the next flight.

    Returns:
        Its name, and the flight of the case followed by it; None where none stayed in the hall.
    """
    found, seed = study.naming.chosen, [case.truth["seed"], 43]
    places = [np.array([c.values[n] for n in c.effect.place]) for c in found if c.effect.place]
    for advice in advise(study.base, study.naming)[:PROPOSED]:
        pilot = diagnosis_pilot(advice.manoeuvre, places[0] if places else None)
        both = fly_on(case, pilot, DIAGNOSIS_S, np.random.default_rng(seed))
        if both is not None:
            return advice.manoeuvre.name, both
    rng = np.random.default_rng(seed)
    return "figure eights", fly_on(case, figure_eights(rng), DIAGNOSIS_S, rng)


def land(task: JsbsimLanding, model: Model, count: int) -> list[dict[str, Any]]:
    """Land `count` times by the expert of a model; a refusal counts as failures, with its words."""
    flown = []
    for number in range(count):
        try:
            record = fly_trial(task, partial(task.expert, model=model), number)
        except InputError as error:
            flown.append({"seed": trial_seed(number), "success": False, "reason": str(error)})
            continue
        kept = ("seed", "success", "reason", "ald_m", "sink_rate_m_s", "past_threshold_m", "faults")
        flown.append({key: record.get(key) for key in kept})
    return flown


# Results
# -------


def summarise(rows: Sequence[dict[str, Any]], seed: int = 0) -> dict[str, Any]:
    """Success, ALD and sink rate by expert, and the paired differences to the truth's expert.

    A landing round is the same start number over all pairs; the difference in ALD of a pair is the
    mean over the starts on which both experts landed. Intervals are percentile bootstraps over
    pairs [SciPy's `bootstrap`].

    Args:
        rows: of `fly_pair`.
        seed: of the resampling.
    """
    found: dict[str, Any] = {"simulated": True, "pairs": len(rows), "experts": {}}
    rounds = min(len(row["landings"]["truth"]) for row in rows)
    for name in EXPERTS:
        flown = [landing for row in rows for landing in row["landings"][name]]
        landed = [landing for landing in flown if landing["success"]]
        found["experts"][name] = {
            "landings": len(flown),
            "successes": len(landed),
            "successes_by_round": [
                sum(row["landings"][name][k]["success"] for row in rows) for k in range(rounds)
            ],
            "ald_m": _mean(landed, "ald_m"),
            "sink_rate_m_s": _mean(landed, "sink_rate_m_s"),
        }
    truth = found["experts"]["truth"]["successes_by_round"]
    for name in EXPERTS[:2]:
        own = found["experts"][name]["successes_by_round"]
        found["experts"][name]["landings_lost_by_round"] = [
            t - o for t, o in zip(truth, own, strict=True)
        ]
        found["experts"][name]["ald_difference_m"] = _difference(rows, name, "ald_m", seed)
        found["experts"][name]["sink_difference_m_s"] = _difference(
            rows, name, "sink_rate_m_s", seed
        )
    right = [row for row in rows if row["verdict"] == "named"]
    found["named"] = len(right)
    found["named_first"] = sum(row["first_verdict"] == "named" for row in rows)
    found["named_rightly"] = sum(row["named"] == [_class(row["effect"])] for row in right)
    return found


def _class(effect: str) -> str:
    """The name under which an effect is found: late stamps show the same as a control delay."""
    return "control_delay" if effect == "time_offset" else effect


def _mean(landed: Sequence[dict[str, Any]], key: str) -> float | None:
    return float(np.mean([landing[key] for landing in landed])) if landed else None


def _difference(
    rows: Sequence[dict[str, Any]], name: str, key: str, seed: int
) -> dict[str, float | int | None]:
    """Mean paired difference to the truth's expert with its 95 % bootstrap interval."""
    from scipy.stats import bootstrap

    of_pairs = []
    for row in rows:
        both = [
            (own, best)
            for own, best in zip(row["landings"][name], row["landings"]["truth"], strict=True)
            if own["success"] and best["success"]
        ]
        if both:
            of_pairs.append(
                [float(np.mean([own[key] for own, _ in both])),
                 float(np.mean([best[key] for _, best in both]))]
            )  # fmt: skip
    own, best = np.array(of_pairs).reshape(-1, 2).T
    if len(own) < 2:
        return {"mean": None, "low95": None, "high95": None, "pairs": len(own)}
    interval = bootstrap(
        (own, best),
        lambda a, b, axis=-1: np.mean(a - b, axis=axis),
        paired=True,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=seed,
    ).confidence_interval
    return {
        "mean": float(np.mean(own - best)),
        "low95": float(interval.low),
        "high95": float(interval.high),
        "pairs": len(own),
    }


def draw(rows: Sequence[dict[str, Any]], found: dict[str, Any], path: Path) -> None:
    """One figure: success by effect and expert, ALD and sink rate of every pair."""
    colours = dict(zip(EXPERTS, (ACCENT, PREDICTED, MEASURED), strict=True))
    ordered = sorted(rows, key=lambda row: row["effect"])
    with figure(path, 3, 1, (9.0, 10.0)) as ((success,), (ald,), (sink,)):
        x = np.arange(len(ordered))
        for k, name in enumerate(EXPERTS):
            label = (
                f"designed on the {name} model: "
                f"{found['experts'][name]['successes']} of {found['experts'][name]['landings']}"
            )
            flown = [row["landings"][name] for row in ordered]
            shares = [np.mean([landing["success"] for landing in one]) for one in flown]
            success.bar(x + 0.27 * (k - 1), shares, 0.25, color=colours[name], label=label)
            for axis, key, factor in ((ald, "ald_m", 100.0), (sink, "sink_rate_m_s", 1.0)):
                points = [
                    (at + 0.2 * (k - 1), factor * landing[key])
                    for at, one in zip(x, flown, strict=True)
                    for landing in one
                    if landing["success"]
                ]
                if points:
                    axis.plot(*np.array(points).T, "o", ms=3.0, color=colours[name], alpha=0.8)
        success.set(
            title=f"SIMULATED by JSBSim: {len(rows)} hidden aircraft and effects, each landed by"
            " three experts",
            ylabel="share of landings on the pad",
            ylim=(0.0, 1.35),
        )
        success.legend(loc="upper left", ncols=1, fontsize=8)
        difference = found["experts"]["improved"]["ald_difference_m"]
        text = ""
        if difference["mean"] is not None:
            mean, low, high = (100.0 * difference[key] for key in ("mean", "low95", "high95"))
            text = (
                f"improved minus truth, in pairs: {mean:+.1f} cm (95 % between {low:+.1f} and"
                f" {high:+.1f} cm)"
            )
        ald.set(title=text, ylabel="ALD of landings [cm]")
        sink.set(ylabel="sink rate at touchdown [m/s]")
        sink.set_xticks(x, [row["effect"] for row in ordered], rotation=75, fontsize=8)
        sink.set_xlabel(
            "hidden effect of the pair; a bar or point in each colour for each expert, all from the"
            " same starts; a point is a landing on the pad"
        )
        for axis in (success, ald):
            axis.set_xticks(x, [])
        for axis in (success, ald, sink):
            axis.set_xlim(-0.6, len(ordered) - 0.4)


def write_results(rows: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Write the table, the summary and the figure beside the file of pairs; returns the summary."""
    found = summarise(rows)
    draw(rows, found, out.with_suffix(".png"))
    with atomic_write(out.with_suffix(".csv"), text=True) as file:
        writer = csv.writer(file, lineterminator="\n")
        head = ["seed", "effect", "noise", "diagnosis_flight", "verdict", "named"]
        for name in EXPERTS:
            head += [f"{name}_successes", f"{name}_ald_m", f"{name}_sink_rate_m_s"]
        writer.writerow(head)
        for row in rows:
            line = [row[key] for key in head[:5]] + ["+".join(row["named"])]
            for name in EXPERTS:
                landed = [one for one in row["landings"][name] if one["success"]]
                line += [len(landed), _mean(landed, "ald_m"), _mean(landed, "sink_rate_m_s")]
            writer.writerow(line)
    with atomic_write(out.with_suffix(".json"), text=True) as file:
        json.dump(found, file, indent=1)
    return found


def print_results(found: dict[str, Any]) -> None:
    """The summary in lines."""
    print(
        f"SIMULATED by JSBSim: {found['pairs']} pairs; named {found['named_first']} after the first"
        f" flight, {found['named']} after the diagnosis flight, rightly {found['named_rightly']}"
    )
    for name in EXPERTS:
        one = found["experts"][name]
        print(
            f"{name:9s} {one['successes']:4d} of {one['landings']}  by round "
            f"{one['successes_by_round']}  ALD {100.0 * (one['ald_m'] or np.nan):.1f} cm  sink "
            f"{one['sink_rate_m_s'] or np.nan:.2f} m/s"
        )
        if name == "truth" or one["ald_difference_m"]["mean"] is None:
            continue
        d, s = one["ald_difference_m"], one["sink_difference_m_s"]
        print(
            f"          lost to the truth's expert by round {one['landings_lost_by_round']}; in "
            f"pairs ALD {100.0 * d['mean']:+.1f} cm (95 %: {100.0 * d['low95']:+.1f} to "
            f"{100.0 * d['high95']:+.1f}), sink {s['mean']:+.3f} m/s (95 %: {s['low95']:+.3f} to "
            f"{s['high95']:+.3f})"
        )


def _fly_until(pair: Pair, begin_by: float) -> dict[str, Any] | None:
    """The pair's row; None where its turn comes after a time [s of time.time()]."""
    return fly_pair(pair) if time.time() < begin_by else None


def main() -> None:
    """Fly the experiment, or go on with it, and write and print its results."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, required=True, help="of the first pair")
    parser.add_argument("--pairs", type=int, default=30)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--landings", type=int, default=LANDINGS, help="of each expert and pair")
    parser.add_argument("--budget-s", type=float, default=np.inf, help="no longer than about this")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines; gone on with")
    parser.add_argument("--summary", action="store_true", help="of the pairs flown so far, no more")
    asked = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # the workers inherit it: one core each
    begin_by = time.time() + asked.budget_s - PAIR_S
    rows = []
    if asked.out.exists():
        rows = [json.loads(line) for line in asked.out.read_text(encoding="utf-8").splitlines()]
    known = {row["seed"] for row in rows}
    pairs = [p for p in draw_pairs(asked.pairs, asked.seed, asked.landings) if p.seed not in known]
    if not asked.summary:
        asked.out.parent.mkdir(parents=True, exist_ok=True)
        with asked.out.open("a", encoding="utf-8") as file:
            work = partial(_fly_until, begin_by=begin_by)
            for pair, row in parallel_map(work, pairs, asked.workers):
                if isinstance(row, WorkerLostError):  # left for the next run
                    print(f"{pair.seed} {pair.effect}: {row}", flush=True)
                elif row is not None:
                    rows.append(row)
                    file.write(json.dumps(row) + "\n")
                    file.flush()
                    print(f"{pair.seed} {pair.effect}: {row['cpu_s']:.0f} CPU s", flush=True)
    if not rows:
        raise SystemExit(f"{asked.out}: no pair is finished yet")
    rows.sort(key=lambda row: row["seed"])
    print_results(write_results(rows, asked.out))
    print(f"figure: {asked.out.with_suffix('.png')}")


if __name__ == "__main__":
    main()
