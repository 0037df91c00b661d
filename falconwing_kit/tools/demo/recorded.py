"""The demo: recorded flights, simulated and real -> models, missing effects, page and figures."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from falconwing_kit import __version__
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.data import data_path
from falconwing_kit.gap.advice import headline
from falconwing_kit.gap.study import GapStudy, gap_record, study_gap
from falconwing_kit.sysid.forecast import Forecasts
from falconwing_kit.sysid.identify import Identification
from falconwing_kit.sysid.model_file import write_model
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.score import PredictionScore, score
from falconwing_kit.sysid.shooting import select_windows
from falconwing_kit.tools.demo.alfa import (
    FOLDS,
    WINDOW_OFFSETS,
    AlfaAnalysis,
    AlfaGap,
    analyse_alfa_flight,
    draw_alfa_figures,
    draw_hypotheses,
    study_alfa_gap,
)
from falconwing_kit.tools.demo.approach import (
    Approach,
    approach_record,
    approach_section,
    draw_approach,
)
from falconwing_kit.tools.demo.figures import draw_identification
from falconwing_kit.tools.demo.sport_cub import (
    BEGIN_S,
    END_S,
    HORIZON_S,
    LEGEND,
    SportCubAnalysis,
    analyse_sport_cub_flight,
    draw_sport_cub_figures,
    read_sport_cub_metadata,
)
from falconwing_kit.tools.reports.gap_plots import draw_gap_closure, draw_map, draw_ranking
from falconwing_kit.tools.reports.page import write_page

PAGE = Path(__file__).with_name("recorded.html.j2")
SIMULATED_FLIGHT, ANOMALOUS_FLIGHT = "case08_calm.csv", "case08_flight.csv"
TRUTH = {"wind_x": 0.0924, "wind_y": 0.4370}  # [m/s] JSBSim's setting; no fit reads it
REPORTED = ("verdict", "effects", "parameters", "since", "gap", "gap_rmse", "next_flight")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class RecordedFlights:
    """Results of the demo for the recorded flights."""

    small: Identification  # the 150 g aircraft of the independent simulator
    # the paper's loss on "raw" and on "smoothed" differences, held-out data
    small_one_step: dict[str, PredictionScore]
    small_gap: GapStudy  # its flight with a hidden effect
    cub: SportCubAnalysis  # the 65 g aircraft, a real indoor flight
    alfa: AlfaAnalysis
    alfa_gap: AlfaGap


def study_recorded_flights(progress: Progress = lambda stage: None) -> RecordedFlights:
    """Identify the three aircraft, and find the effects missing in the models of two.

    Args:
        progress: called with the name of each stage.
    """
    calm, flight = (
        read_flight_table(data_path(name)) for name in (SIMULATED_FLIGHT, ANOMALOUS_FLIGHT)
    )
    gap = study_gap(calm, flight, lambda stage: progress(f"150 g aircraft, {stage}"))
    small = gap.base.found
    flights = [flight for p in small.prepared for flight in p.flights]
    held_out = select_windows(small.windows, small.held_out_index)
    one_step = {}
    for name in ("raw", "smoothed"):
        progress(f"150 g aircraft, one-step fit on {name} differences")
        one_step[name] = score(
            fit_one_step(rates_model(), flights, smoothed=name == "smoothed"), held_out
        )
    cub = analyse_sport_cub_flight(progress)
    alfa = analyse_alfa_flight(progress)
    return RecordedFlights(small, one_step, gap, cub, alfa, study_alfa_gap(alfa, progress))


def write_recorded_flights(
    found: RecordedFlights, folder: Path, approach: Approach | None = None
) -> dict[str, Any]:
    """Write page, figures, models and figures of merit.

    Args:
        folder: it must exist.
        approach: the landing flown before, if any; its figures are drawn from its log.

    Returns:
        The record of demo.json.
    """
    record = ({"approach": approach_record(approach)} if approach else {}) | demo_record(found)
    if approach:
        draw_approach(approach, folder)
    draw_identification(found.small, folder)
    gap = found.small_gap
    draw_map(gap.flight_replay, gap.baseline_replay, folder / "gap_map.png")
    draw_ranking(gap.naming, folder / "gap_ranking.png")
    draw_gap_closure(gap.closed, folder / "gap_closed.png")
    draw_sport_cub_figures(found.cub, folder)
    draw_alfa_figures(found.alfa, folder)
    draw_hypotheses(found.alfa_gap, found.alfa.failure_time, folder / "alfa_suspects.png")
    write_model(folder / "model_150g.toml", found.small)
    write_model(folder / "model_sport_cub.toml", found.cub.found)
    write_model(folder / "model_alfa.toml", found.alfa.found)
    with atomic_write(folder / "demo.json", text=True) as handle:
        json.dump(record, handle, indent=2)
    write_page(
        folder / "index.html",
        PAGE,
        folder=folder,
        truth=TRUTH,
        version=__version__,
        approach=approach_section(approach, folder) if approach else "",
        small=_small_section(found),
        gap=_gap_section(gap, record),
        cub=_cub_section(found.cub),
        alfa=_alfa_section(found.alfa),
        lost=_alfa_gap_section(found.alfa_gap),
        loss=found.alfa_gap.thrust_loss,
    )
    return record


def demo_record(found: RecordedFlights) -> dict[str, Any]:
    """The figures of merit as numbers: by flight; two of them have a key gap."""
    small, alfa = found.small, found.alfa
    report = gap_record(found.small_gap)
    held_out = small.held_out or small.train
    return {
        "simulated_flight": {
            "flight": small.names[0],
            "made_by": "JSBSim, an independent 6-DoF simulator",
            "held_out_chi2_per_dof": held_out.chi2,
            "held_out_position_m": held_out.position_m,
            "held_out_attitude_deg": held_out.attitude_deg,
            "one_step_chi2_per_dof": {name: s.chi2 for name, s in found.small_one_step.items()},
            "seconds": small.seconds,
            "gap": {
                "flight": ANOMALOUS_FLIGHT,
                **{key: report[key] for key in REPORTED},
                "truth": {"effects": ["wind"], "parameters": TRUTH},
            },
        },
        "real_indoor_flight": _cub_record(found.cub),
        "real_flight": {
            "flight": "ALFA Carbon-Z, engine failure",
            "made_by": "a real aircraft",
            "one_second_ahead_before_failure": {
                name: _forecast_record(f) for name, f in alfa.held_out.items()
            },
            "failure_time_s": alfa.failure_time,
            "parts_from_measurement_s": alfa.detection_time,
            "largest_ordinary_error_m": alfa.nominal_error,
            "attitude_deg_after_failure": _attitude_after(alfa),
            "gap": _alfa_gap_record(found.alfa_gap),
        },
    }


def _forecast_record(f: Forecasts) -> dict[str, Any]:
    return {"position_m": f.position_m, "attitude_deg": f.attitude_deg, "forecasts": len(f.t)}


def _cub_record(cub: SportCubAnalysis) -> dict[str, Any]:
    facts, windows, turn = read_sport_cub_metadata(), *_windows_of(cub)
    return {
        "flight": facts["aircraft"]["name"],
        "made_by": "a real aircraft",
        "place": facts["place"],
        "licence": facts["source"]["licence"],
        "source": facts["source"]["repository"],
        "fitted": {"from": BEGIN_S, "to": END_S},
        "describes_flight": cub.found.describes_flight,
        # of the fitted minute, the windows that identification holds out
        "windows": {
            "model": {"position_m": windows.position_m, "attitude_deg": windows.attitude_deg},
            "constant turn": {"position_m": turn.position_m, "attitude_deg": turn.attitude_deg},
        },
        "two_seconds_ahead": {name: _forecast_record(f) for name, f in cub.held_out.items()},
        "roll_offset_deg": math.degrees(cub.roll_offset),
        "seconds": cub.found.seconds,
    }


def _windows_of(cub: SportCubAnalysis) -> tuple[PredictionScore, PredictionScore]:
    """Scores of the model and of a constant turn on windows with their initial state fitted."""
    return cub.found.held_out or cub.found.train, cub.found.turn


def _alfa_gap_record(gap: AlfaGap) -> dict[str, Any]:
    loss = gap.thrust_loss
    return {
        "verdict": gap.verdict,
        "effects": [s.effect.name for s in gap.chosen],
        "ranking": [
            {
                "effect": s.effect.name,
                "gain": s.delta_bic,
                "since": s.time,
                "low95": s.earliest,
                "high95": s.latest,
            }
            for s in gap.hypotheses
        ],
        "threshold": gap.threshold,
        "gain_of_logged_throttle": gap.logged_throttle_gain,
        "parameters": {
            "thrust_lost": {
                "value": loss.value,
                "low95": loss.low95,
                "high95": loss.high95,
                "unit": "-",
            }
        },
        "since": {"value": loss.time, "low95": loss.earliest, "high95": loss.latest},
        "gap": {"before": gap.before, "after": gap.after},
        "judged": {"from": gap.begin, "to": gap.end},
    }


def _attitude_after(alfa: AlfaAnalysis) -> float:
    """Attitude error 1 s ahead after the failure, with the logged throttle, rms [deg]."""
    return alfa.logged.subset(alfa.logged.t > alfa.failure_time + 1.0).attitude_deg


def _small_section(found: RecordedFlights) -> dict[str, Any]:
    """Values of the page on the 150 g aircraft's first flight."""
    small = found.small
    one_step = [
        (f"one step, {name} differences (the paper's loss)", *_cells(s))
        for name, s in found.small_one_step.items()
    ]
    return {
        "noise_cm": 100.0 * small.sigma[:3].mean(),
        "noise_deg": math.degrees(small.sigma[3:].mean()),
        "outliers": sum(p.outliers for p in small.prepared),
        "missing": sum(p.missing for p in small.prepared),
        "parameters": len(small.uncertainty.names),
        "seconds": small.seconds,
        "scores": [("multiple shooting", *_cells(small.held_out or small.train)), *one_step],
        "warnings": small.warnings,
    }


def _gap_section(gap: GapStudy, record: dict[str, Any]) -> dict[str, Any]:
    """Values of the page on the second flight, with the truth."""
    answer, closed = record["simulated_flight"]["gap"], gap.closed
    sizes = [
        (
            s.meaning,
            f"{s.value:.3f}",
            f"{s.low95:.3f} to {s.high95:.3f}",
            f"{TRUTH[name]:.3f}" if name in TRUTH else "-",
        )
        for name, s in closed.parameters.items()
    ]
    before, after = closed.before.chi2 - closed.calm.chi2, closed.after.chi2 - closed.calm.chi2
    return {
        "headline": headline(gap.naming),
        "since": gap.since,
        "effects": len(gap.naming.ranking),
        "sizes": sizes,
        "right": answer["effects"] == answer["truth"]["effects"],
        "closed_percent": 100.0 * (1.0 - after / before),
    }


def _cub_section(cub: SportCubAnalysis) -> dict[str, Any]:
    """Values of the page on the real indoor flight."""
    facts, windows, turn = read_sport_cub_metadata(), *_windows_of(cub)
    rows = [
        (LEGEND[name], f"{f.position_m:.2f}", f"{f.attitude_deg:.1f}", str(len(f.t)))
        for name, f in cub.held_out.items()
    ]
    return {
        "source": facts["source"],
        "seconds": cub.found.seconds,
        "begin": BEGIN_S,
        "end": END_S,
        "horizon": HORIZON_S,
        "length": cub.table.t[-1] - END_S,
        "predictions": rows,
        "offset": math.degrees(cub.roll_offset),
        "describes": cub.found.describes_flight,
        "windows": windows,
        "turn": turn,
        "warnings": cub.found.warnings,
    }


def _alfa_section(alfa: AlfaAnalysis) -> dict[str, Any]:
    """Values of the page on the real flight."""
    names = {
        "model": "fitted model",
        "constant turn": "constant turn for its bank",
        "constant velocity": "constant velocity",
    }
    rows = [
        (names[n], f"{f.position_m:.2f}", f"{f.attitude_deg:.1f}", str(len(f.t)))
        for n, f in alfa.held_out.items()
    ]
    return {
        "wind": math.hypot(*(alfa.found.model.values[name] for name in ("wind_x", "wind_y"))),
        "folds": FOLDS,
        "predictions": rows,
        "failure_time": alfa.failure_time,
        "detected_at": alfa.detection_time,
        "nominal_error": alfa.nominal_error,
        "attitude_after": _attitude_after(alfa),
    }


def _alfa_gap_section(gap: AlfaGap) -> dict[str, Any]:
    """Values of the page on the engine failure."""
    return {
        "verdict": gap.verdict,
        "names": [s.effect.name.replace("_", " ") for s in gap.chosen],
        "begin": gap.begin,
        "end": gap.end,
        "cuts": WINDOW_OFFSETS,
        "logged_gain": gap.logged_throttle_gain,
        "before": gap.before,
        "after": gap.after,
    }


def _cells(s: PredictionScore) -> tuple[str, str, str]:
    return f"{s.chi2:.3g}", f"{s.position_m:.3g}", f"{s.attitude_deg:.3g}"
