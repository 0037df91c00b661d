"""Study: a baseline flight and a flight under test -> the missing effect, as report.json has it."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model, rates_model, scale_model
from falconwing_kit.aircraft.user_file import require_effects
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable, nominal_rate_hz
from falconwing_kit.gap.advice import headline, next_flight
from falconwing_kit.gap.baseline import VERY_STRONG_EVIDENCE, NominalModel, identify_baseline
from falconwing_kit.gap.close import GapClosure, Onset, close_gap, name_with_onset
from falconwing_kit.gap.detectable import DetectableSize, detectable_sizes
from falconwing_kit.gap.discrepancy import Discrepancy, discrepancy_record, find_discrepancy
from falconwing_kit.gap.measure import (
    FlightReplay,
    ResidualBin,
    replay_baseline,
    replay_flight,
    residual_map,
)
from falconwing_kit.gap.name import MAX_MAHALANOBIS, Naming
from falconwing_kit.sysid.diagnose import diagnose_pair, require_sound_table
from falconwing_kit.sysid.shooting import cut_windows

SHORTEST_S = 20.0
SAME_RATE = 0.1  # relative: cameras of one kind differ by less
# Bounds of a shown probability: 45 cases of independent aircraft support no more.
LEAST_PROBABILITY, MOST_PROBABILITY = 0.001, 0.999

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Study:
    """Two flights of one aircraft, and what may be missing in its model.

    The baseline may be several flights. `effects` are tried beside the catalogue. The baseline's
    fit starts from `model`, or from one scaled to the airframe or to the speed flown; `sigma` (6,)
    is the noise of the poses [m, rad] where it is known.
    """

    baseline: FlightTable | Sequence[FlightTable]
    flight: FlightTable
    airframe: Airframe | None = None
    effects: Sequence[Effect] = ()
    model: Model | None = None
    sigma: Array | None = None

    @cached_property
    def result(self) -> "GapStudy":
        """Everything that was found; computed once.

        Raises:
            InputError: a flight cannot be used, or an effect clashes with the catalogue.
        """
        return study_gap(
            self.baseline, self.flight, effects=tuple(self.effects), airframe=self.airframe,
            model=self.model, sigma=self.sigma,
        )  # fmt: skip

    def report(self) -> dict[str, Any]:
        """The record that report.json holds."""
        return gap_record(self.result)


@dataclass(frozen=True)
class GapStudy:
    """All that was found about a gap."""

    base: NominalModel
    naming: Naming
    closed: GapClosure
    baseline_replay: FlightReplay
    flight_replay: FlightReplay
    residual_bins: tuple[ResidualBin, ...]
    names: tuple[str, str]  # the calm flight, the flight under test
    since: Onset | None = None  # when it set in; naming and closing are then of the time after it
    seconds: dict[str, float] = field(default_factory=dict)  # per stage
    catalogue: tuple[Effect, ...] = CATALOGUE  # the effects that were tried
    faults: tuple[str, ...] = ()  # likely mistakes in the tables, one sentence each
    discrepancy: Discrepancy | None = None  # terms without a name, where the verdict is outside
    detectable: tuple[DetectableSize, ...] = ()  # how large each effect must be to show here


def study_gap(
    calm: FlightTable | Sequence[FlightTable],
    flight: FlightTable,
    progress: Progress = lambda stage: None,
    effects: tuple[Effect, ...] = (),
    airframe: Airframe | None = None,
    model: Model | None = None,
    sigma: Array | None = None,
) -> GapStudy:
    """Do all the work of a report, write nothing.

    Args:
        calm: the baseline flight, or several.
        flight: the flight under test.
        progress: called with the name of each stage.
        effects: tried beside the catalogue.
        airframe: scales the model that the baseline's fit starts from; None: by the speed flown.
        model: the fit starts from it instead.
        sigma: (6,) noise of the poses [m, rad] if known.

    Raises:
        InputError: a flight cannot be used, or an effect clashes with the catalogue.
    """
    calms = (calm,) if isinstance(calm, FlightTable) else tuple(calm)
    if not calms:
        raise InputError("calm flights: expected at least one flight table, got none")
    for one in calms:
        require_pair(one, flight)
    for table in (*calms, flight):
        require_sound_table(table)
    require_effects(effects)
    catalogue = (*CATALOGUE, *effects)
    start = model
    if airframe is not None and model is None:
        start = scale_model(rates_model(), airframe.mass, airframe.wing_area, airframe.span)
    faults = [fault.sentence for one in calms for fault in diagnose_pair(one, flight)]
    clock = [time.perf_counter()]
    base = identify_baseline(calms, progress, catalogue, start, sigma)
    clock.append(time.perf_counter())
    naming, since = name_with_onset(base, flight, catalogue, progress)
    clock.append(time.perf_counter())
    progress("closing the gap")
    closed = close_gap(base, naming)
    clock.append(time.perf_counter())
    discrepancy = None
    if naming.verdict == "outside":
        discrepancy = find_discrepancy(base, naming, closed, catalogue, progress)
    if discrepancy is not None:
        closed = replace(
            closed, after=discrepancy.after, model=discrepancy.model,
            confidence=discrepancy.confidence,
        )  # fmt: skip
    progress("where it disagrees")
    replays = replay_baseline(base), replay_flight(base, naming)
    residual_bins = residual_map(replays[1], replays[0])
    detectable = detectable_sizes(base, naming)
    clock.append(time.perf_counter())
    seconds = dict(zip(("calm", "name", "close", "measure"), np.diff(clock).tolist(), strict=True))
    names = ", ".join(one.name for one in calms), flight.name
    return GapStudy(
        base,
        naming,
        closed,
        *replays,
        residual_bins,
        names,
        since,
        seconds,
        catalogue,
        tuple(faults),
        discrepancy,
        detectable,
    )


def require_pair(calm: FlightTable, flight: FlightTable) -> None:
    """Raise InputError for flights too short, without poses, with constant inputs or two rates."""
    for what, one in (("calm flight", calm), ("flight", flight)):
        if len(one.t) < 2 or one.duration < SHORTEST_S:
            raise InputError(
                f"{what} {one.name}: expected at least {SHORTEST_S:.0f} s, got "
                f"{one.duration:.1f} s; fly longer, a minute or two is good"
            )
        if not one.has_pose.any():
            raise InputError(
                f"{what} {one.name}: expected poses, got none in {len(one.t)} rows; was the marker "
                "in view?"
            )
        if np.all(np.ptp(one.commands, axis=0) < 1e-6):
            raise InputError(
                f"{what} {one.name}: expected sticks that move, got the same values in every row; "
                "log the commands too"
            )
    rates = nominal_rate_hz(calm), nominal_rate_hz(flight)
    if abs(rates[0] - rates[1]) > SAME_RATE * min(rates):
        raise InputError(
            f"rates: expected both flights at one rate, since the noise of one weights the other; "
            f"got {rates[0]:.3g} Hz ({calm.name}) and {rates[1]:.3g} Hz ({flight.name}); record "
            "both with the same camera or resample the faster one"
        )


def gap_record(study: GapStudy) -> dict[str, Any]:
    """The fixed keys of report.json, then details; SI units, degrees where a key says deg."""
    base, naming, closed = study.base, study.naming, study.closed
    scores = {"before": closed.before, "after": closed.after, "calm": closed.calm}
    found = base.found
    return {
        "verdict": naming.verdict,
        "effects": [c.effect.name for c in naming.chosen],
        "ranking": _ranking(naming, study.catalogue),
        "parameters": {
            name: {"value": s.value, "low95": s.low95, "high95": s.high95, "unit": s.unit}
            for name, s in closed.parameters.items()
        },
        "where": [
            {
                "channel": s.channel,
                "variable": s.variable,
                "from": s.low,
                "to": s.high,
                "excess": s.excess_chi2,
            }
            for s in study.residual_bins
        ],
        "gap": {name: s.chi2 for name, s in scores.items()},
        "gap_rmse": {
            "position_m": {name: s.position_m for name, s in scores.items()},
            "attitude_deg": {name: s.attitude_deg for name, s in scores.items()},
        },
        "next_flight": next_flight(base, naming),
        "detectable": [
            {
                "effect": d.effect,
                "parameter": d.parameter.name,
                "size": d.size if math.isfinite(d.size) else None,
                "known_aircraft": d.known_aircraft if math.isfinite(d.known_aircraft) else None,
                "unit": d.parameter.unit,
            }
            for d in study.detectable
        ],
        "since": _onset_record(study),
        "headline": headline(naming),
        "flights": {"calm": study.names[0], "flight": study.names[1]},
        "threshold": naming.threshold,
        "gap_details": {
            "before_with_parameters_free": closed.before_with_free_parameters.chi2,
            "after_with_parameters_held": closed.after_with_fixed_parameters.chi2,
            "windows": closed.before.windows,
            "held_out": not closed.seen,
        },
        "strain": naming.mahalanobis,
        "unnamed": {"load": naming.generic.effect.name, "gain": float(naming.generic.delta_bic)},
        "added_to_base": list(added_effects(base)),
        "noise": {
            "position_m": float(found.sigma[:3].mean()),
            "attitude_deg": float(np.degrees(found.sigma[3:].mean())),
            "slow_share": list(base.noise.share),
            "slow_time_s": list(base.noise.time),
        },
        "warnings": _warnings(study),
        "seconds": study.seconds,
        **({"discrepancy": discrepancy_record(study.discrepancy)} if study.discrepancy else {}),
    }


def _onset_record(study: GapStudy) -> dict[str, float] | None:
    since = study.since
    return {"value": since.time, "low95": since.low95, "high95": since.high95} if since else None


def _ranking(naming: Naming, catalogue: Sequence[Effect]) -> list[dict[str, Any]]:
    """Every effect of the catalogue with its evidence and probability, best first.

    Evidence is twice a log Bayes factor, so exp(gain / 2) weights the models [Kass & Raftery 1995],
    among them "nothing" with a gain of 0 and, where the verdict is outside, an unknown effect. A
    threshold above "very strong", from the baseline's false alarms, scales all gains down.
    """
    tempered = 0.5 * VERY_STRONG_EVIDENCE / naming.threshold
    nameless = max(naming.generic.delta_bic, naming.ranking[0].delta_bic + naming.threshold)
    others = 0.0, nameless if naming.verdict == "outside" else -np.inf
    logs = np.array([*others, *(c.delta_bic for c in naming.ranking)]) * tempered
    weights = np.exp(logs - logs.max())
    shares = np.clip(weights / weights.sum(), LEAST_PROBABILITY, MOST_PROBABILITY)[2:]
    rows = []
    for candidate, share in zip(naming.ranking, shares, strict=True):
        row = {
            "effect": candidate.effect.name,
            "gain": float(candidate.delta_bic),
            "probability": float(share),
        }
        equivalents = [e.name for e in catalogue if e.same_as == candidate.effect.name]
        rows += [
            row,
            *(
                {**row, "effect": equivalent, "same_as": candidate.effect.name}
                for equivalent in equivalents
            ),
        ]
    return rows


def _warnings(study: GapStudy) -> list[str]:
    said = [f"calm flight: {w}" for w in study.base.found.warnings]
    said += [f"flight: {w}" for w in study.naming.prepared.warnings]
    said += study.faults
    if lost := _windows_left_out(study.base, study.naming):
        times = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in lost)
        said.append(
            f"in {len(lost)} of {len(lost) + len(study.naming.windows)} windows the calm flight's "
            f"model diverges; they are left out: {times}"
        )
    if incidents := study.naming.incidents:
        times = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in incidents)
        said.append(
            "the calm flight's model fails as never in the calm flight, in few seconds that are "
            f"over, and well in all others: an incident such as a stall at {times}"
        )
    if added := added_effects(study.base):
        said.append(
            "the calm flight showed loads that the model's terms lack; added to the base: "
            f"{', '.join(added)}"
        )
    if study.closed.seen:
        said.append(
            "the flight is too short to hold anything back; before and after are on the fitted time"
        )
    if study.naming.mahalanobis > MAX_MAHALANOBIS:
        said.append(mismatch_text(study))
    return said


def _windows_left_out(base: NominalModel, naming: Naming) -> list[tuple[float, float]]:
    """Windows left out since the nominal model diverges: begin and end by the flight's clock."""
    whole = cut_windows(naming.prepared.flights, base.result.model, base.window_s)
    kept = set(zip(naming.windows.flight, naming.windows.nodes[:, 0], strict=True))
    return [
        (
            float(whole.flights[flight].t[0] + nodes[0]),
            float(whole.flights[flight].t[0] + nodes[-1]),
        )
        for flight, nodes in zip(whole.flight, whole.nodes, strict=True)
        if (flight, nodes[0]) not in kept
    ]


def added_effects(base: NominalModel) -> tuple[str, ...]:
    """The effects that the nominal model was completed with."""
    before = len(base.found.model.effects)
    return tuple(effect.name for effect in base.result.model.effects[before:])


def mismatch_text(study: GapStudy) -> str:
    """The warning that both flights are not of one aircraft."""
    return (
        "the calm flight's model does not fit the aircraft of this flight: its parameters would "
        f"have to move by {math.sqrt(study.naming.mahalanobis):.0f} times what another day "
        "explains; are both flights of the same aircraft?"
    )
