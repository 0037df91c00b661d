"""Report of a gap: baseline flight and flight under test -> report.json, figures and a page."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.baseline import GENERIC_EVIDENCE
from falconwing_kit.gap.measure import VARIABLES
from falconwing_kit.gap.name import MAX_MAHALANOBIS, Naming
from falconwing_kit.gap.study import GapStudy, Progress, gap_record, mismatch_text, study_gap
from falconwing_kit.sysid.model_file import write_fitted_model, write_model
from falconwing_kit.sysid.score import PredictionScore
from falconwing_kit.tools.reports.gap_plots import CHANNEL_WORDS, IN_PLOTS, draw_gap
from falconwing_kit.tools.reports.page import write_page

PAGE = Path(__file__).with_name("gap_report.html.j2")


def gap_report(
    calm: FlightTable,
    flight: FlightTable,
    out: str | Path | None = None,
    progress: Progress = lambda stage: None,
    effects: tuple[Effect, ...] = (),
) -> dict[str, Any]:
    """Find where a flight disagrees with the calm aircraft, name what is missing and close the gap.

    Args:
        calm: the baseline flight.
        flight: the flight under test, of the same aircraft.
        out: folder for report.json, report.html, figures and models; made where it is missing. None
            writes nothing.
        progress: called with the name of each stage.
        effects: tried beside the catalogue.

    Returns:
        The record that stands in report.json.

    Raises:
        InputError: a flight cannot be used.
    """
    study = study_gap(calm, flight, progress, effects)
    return gap_record(study) if out is None else write_gap(study, Path(out), progress)


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
            folder / "model_with_effect.toml",
            closed.model,
            closed.confidence,
            flights=study.names,
            train_chi2=study.naming.remaining_chi2 + base.chi2,
            held_out_chi2=closed.after.chi2,
            sigma=base.found.sigma,
        )
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
        "strained": _sentence(mismatch_text(study)) if naming.mahalanobis > MAX_MAHALANOBIS else "",
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
            low, high = residual_bin.low * scale, residual_bin.high * scale
            at = f"with {residual_bin.variable} from {low:.2g} to {high:.2g}{unit}"
        else:
            at = "all the time alike"
        channel = CHANNEL_WORDS[residual_bin.channel].lower()
        texts.append(f"{channel} {at} (excess {residual_bin.excess_chi2:.2g})")
    return (
        f"Over the whole flight the mean square residual is {level:.2g} squared sigmas of the pose "
        f"noise, on the calm flight {calm_level:.2g}. Most of it is in {'; '.join(texts)}; "
        "excess is what is over the calm flight's."
    )


def _ranking_text(study: GapStudy, record: dict[str, Any]) -> str:
    first, *others = record["ranking"]
    second = next((r for r in others if "same_as" not in r), None)
    text = (
        f"{len(record['ranking'])} effects were tried; {record['threshold']:.0f} of evidence are "
        f"needed so that it is not chance. {_display_name(first['effect'])} has most: "
        f"{first['gain']:.0f}, probability {_percent(first['probability'])}. "
    )
    if second is not None:
        text += f"Next comes {_display_name(second['effect']).lower()} with {second['gain']:.0f}. "
    if len(study.naming.chosen) == 2 and study.naming.verdict == "named":
        added = study.naming.chosen[1]
        name = _display_name(added.effect.name).lower()
        text += f"On top of the first, {name} explains another {added.delta_bic:.0f}. "
    return (
        text
        + "A difference of 10 between two effects is very strong; less leaves both in the race."
    )


def _before_after(study: GapStudy) -> str:
    closed = study.closed
    if study.naming.verdict in ("none", "outside"):
        return (
            f"Nothing was added, so nothing changes: {_error(closed.before)} before and after, "
            f"{_error(closed.calm)} on the calm flight."
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
        f"Without the effect the model is off by {_error(closed.before)}; {which} by "
        f"{_error(closed.after)}; the calm flight leaves {_error(closed.calm)}.{share} Holding the "
        "aircraft's own parameters as on the calm flight gives a chi2 of "
        f"{closed.after_with_fixed_parameters.chi2:.2f}; letting them move without any effect, "
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
