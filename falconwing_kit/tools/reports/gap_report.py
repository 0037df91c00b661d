"""Report of a gap: baseline flight and flight under test -> report.json, figures and a page."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.baseline import GENERIC_EVIDENCE
from falconwing_kit.gap.name import MAX_MAHALANOBIS, Naming
from falconwing_kit.gap.study import GapStudy, Progress, gap_record, mismatch_text, study_gap
from falconwing_kit.sysid.model_file import write_fitted_model, write_model
from falconwing_kit.sysid.uncertainty import uncertainty
from falconwing_kit.tools.reports.gap_plots import draw_gap, noise_floor
from falconwing_kit.tools.reports.gap_text import (
    addition_rows,
    before_after_text,
    contest_text,
    detectable_rows,
    effect_equations,
    equation,
    gap_rows,
    noise_text,
    quantity,
    runner_up_text,
    second_effect_text,
    sentence,
    size_rows,
    trace_caption,
    verdict_sentence,
    where_text,
)
from falconwing_kit.tools.reports.gap_traces import draw_traces, example_windows
from falconwing_kit.tools.reports.page import write_page

PAGE = Path(__file__).with_name("gap_report.html.j2")


def gap_report(
    calm: FlightTable | Sequence[FlightTable],
    flight: FlightTable,
    out: str | Path | None = None,
    progress: Progress = lambda stage: None,
    effects: tuple[Effect, ...] = (),
    *,
    airframe: Airframe | None = None,
    model: Model | None = None,
    sigma: Array | None = None,
    improve: bool = False,
) -> dict[str, Any]:
    """Find where a flight disagrees with the calm aircraft, name what is missing and close the gap.

    Args:
        calm: the baseline flight, or several.
        flight: the flight under test, of the same aircraft.
        out: folder for report.json, report.html, figures and models; made where it is missing. None
            writes nothing.
        progress: called with the name of each stage.
        effects: tried beside the catalogue.
        airframe: scales the model that the baseline's fit starts from.
        model: the fit starts from it instead.
        sigma: (6,) noise of the poses [m, rad] if known.
        improve: write model_improved.toml too, as `write_gap`.

    Returns:
        The record that stands in report.json.

    Raises:
        InputError: a flight cannot be used.
    """
    study = study_gap(calm, flight, progress, effects, airframe, model, sigma)
    return gap_record(study) if out is None else write_gap(study, out, progress, improve=improve)


def write_gap(
    study: GapStudy,
    folder: str | Path,
    progress: Progress = lambda stage: None,
    *,
    improve: bool = False,
) -> dict[str, Any]:
    """Write report.json, report.html, figures, model.toml and, where something is named,
    model_with_effect.toml.

    Args:
        study: what was found.
        folder: where to; made where it is missing.
        progress: called with the name of each stage.
        improve: write model_improved.toml too, the best model of this aircraft now: with the named
            effect, with the terms found outside the catalogue, or the completed nominal model.

    Returns:
        The record that stands in report.json.
    """
    progress("page and figures")
    folder = Path(folder)
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    figures, traces = draw_gap(study, folder), {}
    for name, window in example_windows(study).items():
        figures[name] = folder / f"gap_{name}.png"
        traces[name] = trace_caption(name, window)
        draw_traces(window, figures[name])
    write_model(folder / "model.toml", study.base.found)
    if study.naming.verdict == "named":
        write_best_model(study, folder / "model_with_effect.toml")
    if improve:
        write_best_model(study, folder / "model_improved.toml")
    study.seconds["write"] = time.perf_counter() - began
    record = gap_record(study)
    write_page(folder / "report.html", PAGE, figures=figures, traces=traces, **_page(study, record))
    with atomic_write(folder / "report.json", text=True) as handle:
        json.dump(record, handle, indent=2, allow_nan=False)
    return record


def write_best_model(study: GapStudy, path: Path) -> None:
    """Write the model with what was found, or the completed nominal model where nothing was.

    Args:
        study: what was found.
        path: the TOML file; it is replaced atomically.
    """
    closed, base = study.closed, study.base
    model, confidence, after = closed.model, closed.confidence, closed.after.chi2
    flights: tuple[str, ...] = study.names
    if model is None or confidence is None:
        model, confidence = base.result.model, uncertainty(base.result, base.windows)
        flights, after = base.found.names, closed.calm.chi2
    write_fitted_model(
        path, model, confidence, flights=flights,
        train_chi2=study.naming.remaining_chi2 + base.chi2, held_out_chi2=after,
        sigma=base.found.sigma,
    )  # fmt: skip


def _page(study: GapStudy, record: dict[str, Any]) -> dict[str, Any]:
    """Values for the page's template, besides the figures."""
    naming, sizes = study.naming, study.closed.parameters
    floor = noise_floor(study)
    return {
        "record": record,
        "verdict": naming.verdict,
        "sentence": verdict_sentence(study),
        "chosen": [(c.effect, effect_equations(c.effect, sizes)) for c in naming.chosen],
        "load": naming.generic if _has_a_load(naming) else None,
        "discrepancy": _discrepancy(record),
        "strained": sentence(mismatch_text(study)) if naming.mahalanobis > MAX_MAHALANOBIS else "",
        "since": study.since,
        "sizes": size_rows(sizes),
        "gap": gap_rows(study, floor),
        "before_after": before_after_text(study, floor),
        "contest": contest_text(study, record),
        "second_effect": second_effect_text(study),
        "runner_up": runner_up_text(study),
        "where": where_text(study),
        "next_flight": sentence(record["next_flight"]),
        "additions": addition_rows(study),
        "detectable": detectable_rows(study),
        "noise": noise_text(record["noise"]),
    }


def _has_a_load(naming: Naming) -> bool:
    """Whether a load without a name explains more than every effect does."""
    return naming.generic.delta_bic > max(GENERIC_EVIDENCE, naming.ranking[0].delta_bic)


def _discrepancy(record: dict[str, Any]) -> dict[str, Any] | None:
    """The record's term outside the catalogue, its equation and rows ready for the page."""
    found = record.get("discrepancy")
    if not found:
        return None
    rows = [
        (
            term["name"],
            quantity(term["value"], term["unit"]),
            f"{quantity(term['low95'], '')} to {quantity(term['high95'], '')}",
        )
        for term in found["terms"]
    ]
    return {**found, "equation": equation(found["equation"]), "rows": rows}
