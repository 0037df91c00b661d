"""The report: a calm flight and a flight that surprises -> report.json, figures and a page read in
three minutes.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import FlightTable, nominal_rate_hz
from falconwing_kit.gap.advice import headline, next_flight
from falconwing_kit.gap.baseline import (
    GENERIC_EVIDENCE,
    VERY_STRONG_EVIDENCE,
    NominalModel,
    identify_baseline,
)
from falconwing_kit.gap.close import GapClosure, Onset, close_gap, name_with_onset
from falconwing_kit.gap.measure import (
    VARIABLES,
    FlightReplay,
    ResidualBin,
    replay_baseline,
    replay_flight,
    residual_map,
)
from falconwing_kit.gap.name import MAX_MAHALANOBIS, Naming
from falconwing_kit.sysid.model_file import write_fitted_model, write_model
from falconwing_kit.sysid.score import PredictionScore
from falconwing_kit.tools.reports.gap_plots import CHANNEL_WORDS, IN_PLOTS, draw_gap
from falconwing_kit.tools.reports.page import write_page

PAGE = Path(__file__).with_name("gap_report.html.j2")
SHORTEST_S = 20.0
SAME_RATE = 0.1  # relative: cameras of one kind differ by less
LEAST_PROBABILITY, MOST_PROBABILITY = (
    0.001,
    0.999,
)  # 45 cases of independent aircraft say no more than that

Progress = Callable[[str], None]


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


def gap_report(
    calm: FlightTable,
    flight: FlightTable,
    out: str | Path | None = None,
    progress: Progress = lambda stage: None,
) -> dict[str, Any]:
    """Find where a flight disagrees with the calm aircraft, name what is missing and close the gap.

    Args:
        calm: a flight without surprise.
        flight: a flight of the same aircraft that surprises.
        out: folder for report.json, report.html, figures and models; made where it is missing. None
            writes nothing.
        progress: called with the name of each stage.

    Returns:
        The record that stands in report.json.

    Raises:
        InputError: a flight cannot be used.
    """
    study = study_gap(calm, flight, progress)
    return gap_record(study) if out is None else write_gap(study, Path(out), progress)


def study_gap(
    calm: FlightTable, flight: FlightTable, progress: Progress = lambda stage: None
) -> GapStudy:
    """Do all the work of a report, write nothing.

    Args:
        calm: a flight without surprise.
        flight: the flight under test.
        progress: called with the name of each stage.

    Returns:
        What was found.

    Raises:
        InputError: a flight cannot be used.
    """
    require_pair(calm, flight)
    clock = [time.perf_counter()]
    base = identify_baseline(calm, progress)
    clock.append(time.perf_counter())
    naming, since = name_with_onset(base, flight, progress=progress)
    clock.append(time.perf_counter())
    progress("closing the gap")
    closed = close_gap(base, naming)
    clock.append(time.perf_counter())
    progress("where it disagrees")
    replays = replay_baseline(base), replay_flight(base, naming)
    residual_bins = residual_map(replays[1], replays[0])
    clock.append(time.perf_counter())
    seconds = dict(zip(("calm", "name", "close", "measure"), np.diff(clock).tolist(), strict=True))
    return GapStudy(
        base, naming, closed, *replays, residual_bins, (calm.name, flight.name), since, seconds
    )


def require_pair(calm: FlightTable, flight: FlightTable) -> None:
    """Refuse flights that cannot give an answer.

    Args:
        calm: a flight without surprise.
        flight: the flight under test.

    Raises:
        InputError: too short, no poses, sticks that never move, or different rates.
    """
    for what, one in (("calm flight", calm), ("flight", flight)):
        if len(one.t) < 2 or one.duration < SHORTEST_S:
            raise InputError(
                f"{what} {one.name}: expected at least {SHORTEST_S:.0f} s, got {one.duration:.1f} s; fly longer, a minute "
                "or two is good"
            )
        if not one.has_pose.any():
            raise InputError(
                f"{what} {one.name}: expected poses, got none in {len(one.t)} rows; was the marker in view?"
            )
        if np.all(np.ptp(one.commands, axis=0) < 1e-6):
            raise InputError(
                f"{what} {one.name}: expected sticks that move, got the same values in every row; log the commands too"
            )
    rates = nominal_rate_hz(calm), nominal_rate_hz(flight)
    if abs(rates[0] - rates[1]) > SAME_RATE * min(rates):
        raise InputError(
            f"rates: expected both flights at one rate, since the noise learned on one judges the other; got "
            f"{rates[0]:.3g} Hz ({calm.name}) and {rates[1]:.3g} Hz ({flight.name}); record both with the same camera "
            "or resample the faster one"
        )


def gap_record(study: GapStudy) -> dict[str, Any]:
    """What was found as plain numbers: the fixed keys of report.json, then details.

    Args:
        study: what was found.

    Returns:
        The record; SI units, angles in radians except where a key says deg.
    """
    base, naming, closed = study.base, study.naming, study.closed
    scores = {"before": closed.before, "after": closed.after, "calm": closed.calm}
    found = base.found
    return {
        "verdict": naming.verdict,
        "effects": [c.effect.name for c in naming.chosen],
        "ranking": _ranking(naming),
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
        "added_to_base": list(_added_effects(base)),
        "noise": {
            "position_m": float(found.sigma[:3].mean()),
            "attitude_deg": float(np.degrees(found.sigma[3:].mean())),
            "slow_share": list(base.noise.share),
            "slow_time_s": list(base.noise.time),
        },
        "warnings": _warnings(study),
        "seconds": study.seconds,
    }


def _onset_record(study: GapStudy) -> dict[str, float] | None:
    since = study.since
    return {"value": since.time, "low95": since.low95, "high95": since.high95} if since else None


def _ranking(naming: Naming) -> list[dict[str, Any]]:
    """Every effect of the catalogue with its evidence and probability, best first.

    Evidence is minus twice a log likelihood, so exp(gain / 2) weighs the models [Kass & Raftery
    1995], "nothing" with a gain of 0 among them, and where the verdict is outside what has no name.
    Where chance on the calm flight finds more than it should, gains are scaled down by as much.
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
        equivalents = [e.name for e in CATALOGUE if e.same_as == candidate.effect.name]
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
    if added := _added_effects(study.base):
        said.append(
            f"the calm flight showed loads that the model's terms lack; added to the base: {', '.join(added)}"
        )
    if study.closed.seen:
        said.append(
            "the flight is too short to hold anything back; before and after are on the fitted time"
        )
    if study.naming.mahalanobis > MAX_MAHALANOBIS:
        said.append(_mismatch_text(study))
    return said


def _added_effects(base: NominalModel) -> tuple[str, ...]:
    """The loads without a name that the base model was completed with."""
    had = {term.name for term in base.found.model.terms}
    return tuple(term.name for term in base.result.model.terms if term.name not in had)


def _mismatch_text(study: GapStudy) -> str:
    return (
        f"the calm flight's model does not fit the aircraft of this flight: its parameters would have to move by "
        f"{math.sqrt(study.naming.mahalanobis):.0f} times what another day explains; are both flights of the same aircraft?"
    )


def write_gap(
    study: GapStudy, folder: Path, progress: Progress = lambda stage: None
) -> dict[str, Any]:
    """Write report.json, report.html, figures, model.toml and, where something is named,
    model_with_effect.toml.

    Args:
        study: what was found.
        folder: where to; made where it is missing.
        progress: called with the name of each stage.

    Returns:
        The record that stands in report.json.
    """
    progress("page and figures")
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    figures = draw_gap(
        study.naming,
        study.closed,
        study.flight_replay,
        study.baseline_replay,
        study.residual_bins,
        folder,
    )
    write_model(folder / "model.toml", study.base.found)
    closed, base = study.closed, study.base
    if (
        study.naming.verdict == "named"
        and closed.model is not None
        and closed.confidence is not None
    ):
        write_fitted_model(
            folder / "model_with_effect.toml", closed.model, closed.confidence, flights=study.names,
            train_chi2=study.naming.remaining_chi2 + base.chi2, held_out_chi2=closed.after.chi2, sigma=base.found.sigma,
        )  # fmt: skip
    study.seconds["write"] = time.perf_counter() - began
    record = gap_record(study)
    write_page(folder / "report.html", PAGE, figures=figures, **_page(study, record))
    with atomic_write(folder / "report.json", text=True) as handle:
        json.dump(record, handle, indent=2, allow_nan=False)
    return record


def _page(study: GapStudy, record: dict[str, Any]) -> dict[str, Any]:
    """Values for the page's template, besides the figures."""
    naming = study.naming
    sizes = [
        (
            size.meaning,
            f"{size.value:.3g}",
            f"{size.low95:.3g} to {size.high95:.3g}",
            "" if size.unit == "-" else size.unit,
        )
        for size in study.closed.parameters.values()
    ]
    return {
        "record": record,
        "verdict": naming.verdict,
        "chosen": naming.chosen,
        "load": naming.generic if _has_a_load(naming) else None,
        "strained": _sentence(_mismatch_text(study))
        if naming.mahalanobis > MAX_MAHALANOBIS
        else "",
        "since": study.since,
        "sizes": sizes,
        "where": _where(study),
        "contest": _ranking_text(study, record),
        "before_after": _before_after(study),
        "next_flight": _sentence(record["next_flight"]),
        "slow": _slow(record["noise"]),
    }


def _has_a_load(naming: Naming) -> bool:
    """Whether a load without a name explains more than every effect does."""
    return naming.generic.delta_bic > max(GENERIC_EVIDENCE, naming.ranking[0].delta_bic)


def _where(study: GapStudy) -> str:
    if not study.residual_bins:
        return "Nowhere: no channel stands out over any variable by more than chance."
    level, calm_level = (
        float(np.nanmean(r.residual**2)) for r in (study.flight_replay, study.baseline_replay)
    )
    texts = []
    for residual_bin in study.residual_bins[:3]:
        if residual_bin.contrast > 0.0:
            scale, unit = IN_PLOTS.get(
                residual_bin.variable, (1.0, VARIABLES[residual_bin.variable])
            )
            unit = "" if unit == "-" else f" {unit}"
            at = f"with {residual_bin.variable} from {residual_bin.low * scale:.2g} to {residual_bin.high * scale:.2g}{unit}"
        else:
            at = "all the time alike"
        texts.append(
            f"{CHANNEL_WORDS[residual_bin.channel].lower()} {at} (excess {residual_bin.excess_chi2:.2g})"
        )
    return (
        f"Over the whole flight the mean square residual is {level:.2g} squared sigmas of the pose noise, on the calm "
        f"flight {calm_level:.2g}. Most of it is in {'; '.join(texts)}; excess is what is over the calm flight's."
    )


def _ranking_text(study: GapStudy, record: dict[str, Any]) -> str:
    first, *others = record["ranking"]
    second = next((r for r in others if "same_as" not in r), None)
    text = (
        f"{len(record['ranking'])} effects were tried; {record['threshold']:.0f} of evidence are needed so that it is "
        f"not chance. {_display_name(first['effect'])} has most: {first['gain']:.0f}, probability "
        f"{_percent(first['probability'])}. "
    )
    if second is not None:
        text += f"Next comes {_display_name(second['effect']).lower()} with {second['gain']:.0f}. "
    if len(study.naming.chosen) == 2 and study.naming.verdict == "named":
        added = study.naming.chosen[1]
        text += f"On top of the first, {_display_name(added.effect.name).lower()} explains another {added.delta_bic:.0f}. "
    return (
        text
        + "A difference of 10 between two effects is very strong; less leaves both in the race."
    )


def _before_after(study: GapStudy) -> str:
    closed = study.closed
    if study.naming.verdict in ("none", "outside"):
        return (
            f"Nothing was added, so nothing changes: {_error(closed.before)} before and after, {_error(closed.calm)} "
            "on the calm flight."
        )
    over_before, over_after = (
        closed.before.chi2 - closed.calm.chi2,
        closed.after.chi2 - closed.calm.chi2,
    )
    share = (
        f" That is {100.0 * (1.0 - over_after / over_before):.0f} % of the gap."
        if over_before > 0.05
        else ""
    )
    which = (
        "with the first alternative" if study.naming.verdict == "ambiguous" else "with the effect"
    )
    return (
        f"Without the effect the model is off by {_error(closed.before)}; {which} by {_error(closed.after)}; "
        f"the calm flight leaves {_error(closed.calm)}.{share} Holding the aircraft's own parameters as on the "
        f"calm flight gives a chi2 of {closed.after_with_fixed_parameters.chi2:.2f}; letting them move without any effect, "
        f"{closed.before_with_free_parameters.chi2:.2f}."
    )


def _slow(noise: dict[str, Any]) -> str:
    """Share of the pose noise that changes slowly, in words."""
    halves = zip(noise["slow_share"], noise["slow_time_s"], ("position", "attitude"), strict=True)
    return "; ".join(
        f"{100 * share:.0f} % of it slow over {seconds:.1f} s in {half}"
        if share
        else f"none of it slow in {half}"
        for share, seconds, half in halves
    )


def _error(score: PredictionScore) -> str:
    return f"chi2 {score.chi2:.2f} ({100 * score.position_m:.1f} cm, {score.attitude_deg:.2f}°)"


def _display_name(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _percent(probability: float) -> str:
    return "over 99 %" if probability > 0.99 else f"{100 * probability:.0f} %"


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + ("" if text.endswith((".", "?")) else ".")
