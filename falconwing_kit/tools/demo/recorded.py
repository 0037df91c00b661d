"""The demo: recorded flights of a simulated and of a real aircraft -> models, what they lack, page and figures."""

import html
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
from falconwing_kit.sysid.identify import Identification
from falconwing_kit.sysid.model_file import write_model
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.score import Score, score, select
from falconwing_kit.tools.demo.alfa_figures import draw_alfa_story, draw_suspects
from falconwing_kit.tools.demo.alfa_gap import CUTS, AlfaGap, Suspect, judge_alfa
from falconwing_kit.tools.demo.alfa_story import FOLDS, AlfaStory, tell_alfa_story
from falconwing_kit.tools.demo.approach import Approach, approach_part, approach_record, draw_flight
from falconwing_kit.tools.demo.figures import draw_identification
from falconwing_kit.tools.reports.gap_plots import draw_closed, draw_map, draw_ranking
from falconwing_kit.tools.reports.gap_report import GapStudy, gap_record, study_gap
from falconwing_kit.tools.reports.page import Picture, paragraph, picture, table, write_page

SIMULATED_FLIGHT, SURPRISING_FLIGHT = "case08_calm.csv", "case08_flight.csv"
TRUTH = {"wind_x": 0.0924, "wind_y": 0.4370}  # m/s: what JSBSim was told for the surprising flight; no fit reads it
REPORTED = ("verdict", "effects", "parameters", "since", "gap", "gap_rmse", "next_flight")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class RecordedFlights:
    """What the demo found in the recorded flights."""

    small: Identification  # the 150 g aircraft of the independent simulator
    small_one_step: dict[str, Score]  # the paper's loss on raw and on smoothed differences, held-out time
    small_gap: GapStudy  # its flight with a hidden effect
    alfa: AlfaStory
    alfa_gap: AlfaGap


def study_recorded_flights(progress: Progress = lambda stage: None) -> RecordedFlights:
    """Identify both aircraft, then look for what their models lack.

    Args:
        progress: called with the name of each stage.

    Returns:
        What was found.
    """
    calm, flight = (read_flight_table(data_path(name)) for name in (SIMULATED_FLIGHT, SURPRISING_FLIGHT))
    gap = study_gap(calm, flight, lambda stage: progress(f"150 g aircraft, {stage}"))
    small = gap.base.found
    flights = [flight for p in small.prepared for flight in p.flights]
    held_out = select(small.windows, small.held_out_index)
    one_step = {}
    for name in ("raw", "smoothed"):
        progress(f"150 g aircraft, one-step fit on {name} differences")
        one_step[name] = score(fit_one_step(rates_model(), flights, smoothed=name == "smoothed"), held_out)
    story = tell_alfa_story(progress)
    return RecordedFlights(small, one_step, gap, story, judge_alfa(story, progress))


def write_recorded_flights(found: RecordedFlights, folder: Path, approach: Approach | None = None) -> dict[str, Any]:
    """Write page, figures, models and figures of merit.

    Args:
        found: what the demo found.
        folder: where to; it must exist.
        approach: the landing that was flown before, if any; its figures are drawn from its log.

    Returns:
        The record that stands in demo.json.
    """
    record = ({"approach": approach_record(approach)} if approach else {}) | demo_record(found)
    if approach:
        draw_flight(approach.log, folder)
    draw_identification(found.small, folder)
    gap = found.small_gap
    draw_map(gap.flight_replay, gap.calm_replay, folder / "gap_map.png")
    draw_ranking(gap.naming, folder / "gap_ranking.png")
    draw_closed(gap.closed, folder / "gap_closed.png")
    draw_alfa_story(found.alfa, folder)
    draw_suspects(found.alfa_gap, found.alfa.failure_time, folder / "alfa_suspects.png")
    write_model(folder / "model_150g.toml", found.small)
    write_model(folder / "model_alfa.toml", found.alfa.found)
    with atomic_write(folder / "demo.json", text=True) as handle:
        json.dump(record, handle, indent=2)
    parts = [
        *_opening(), *(approach_part(approach, folder) if approach else ()),
        *_small_part(found, folder), *_gap_part(gap, record, folder),
        *_alfa_part(found.alfa, folder), *_alfa_gap_part(found, folder), _closing(),
    ]  # fmt: skip
    write_page(folder / "index.html", "FalconWing kit: the demo", parts)
    return record


def demo_record(found: RecordedFlights) -> dict[str, Any]:
    """The figures of merit as plain numbers.

    Args:
        found: what the demo found.

    Returns:
        Keys simulated_flight and real_flight, each with a key gap.
    """
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
                "flight": SURPRISING_FLIGHT, **{key: report[key] for key in REPORTED},
                "truth": {"effects": ["wind"], "parameters": TRUTH},
            },
        },
        "real_flight": {
            "flight": "ALFA Carbon-Z, engine failure",
            "made_by": "a real aircraft",
            "one_second_ahead_before_failure": {
                name: {"position_m": f.position_m, "attitude_deg": f.attitude_deg, "forecasts": len(f.t)}
                for name, f in alfa.held_out.items()
            },
            "failure_time_s": alfa.failure_time,
            "parts_from_measurement_s": alfa.parts_at,
            "largest_ordinary_error_m": alfa.ordinary_error,
            "attitude_deg_after_failure": _attitude_after(alfa),
            "gap": _alfa_gap_record(found.alfa_gap),
        },
    }  # fmt: skip


def _alfa_gap_record(gap: AlfaGap) -> dict[str, Any]:
    loss = gap.thrust_loss
    return {
        "verdict": gap.verdict,
        "effects": [s.effect.name for s in gap.chosen],
        "ranking": [
            {"effect": s.effect.name, "gain": s.gain, "since": s.time, "low95": s.earliest, "high95": s.latest}
            for s in gap.suspects
        ],
        "threshold": gap.threshold,
        "gain_of_logged_throttle": gap.told_gain,
        "parameters": {"thrust_lost": {"value": loss.value, "low95": loss.low95, "high95": loss.high95, "unit": "-"}},
        "since": {"value": loss.time, "low95": loss.earliest, "high95": loss.latest},
        "gap": {"before": gap.before, "after": gap.after},
        "judged": {"from": gap.begin, "to": gap.end},
    }


def _attitude_after(alfa: AlfaStory) -> float:
    """How far off the told model's attitude is one second ahead after the failure, rms [deg]."""
    return alfa.told.chosen(alfa.told.t > alfa.failure_time + 1.0).attitude_deg


def _opening() -> list[str]:
    return [
        "<h1>An approach, and recorded flights</h1>",
        paragraph("A landing by the FalconWing kit, then what it learns from flights that are not its own.", "lead"),
        paragraph(
            '<span class="tag simulated">simulated</span> the first recorded aircraft comes from JSBSim, an '
            "independent flight simulator; nothing about it was told to the kit. It flies twice, the second time with "
            "a surprise. "
            '<span class="tag measured">measured</span> the second is a real aircraft that loses its engine.'
        ),
    ]


def _small_part(found: RecordedFlights, folder: Path) -> list[str]:
    small = found.small
    held_out = small.held_out or small.train
    rows = [("multiple shooting", *_cells(held_out))]
    rows += [
        (f"one step, {name} differences (the paper's loss)", *_cells(s)) for name, s in found.small_one_step.items()
    ]
    position, attitude = small.sigma[:3].mean() * 100.0, math.degrees(small.sigma[3:].mean())
    outliers, missing = (sum(getattr(p, name) for p in small.prepared) for name in ("outliers", "missing"))
    warnings = "".join(f"<li>{html.escape(w)}</li>" for w in small.warnings)
    return [
        '<h2><span class="tag simulated">simulated</span>A 150 g aircraft</h2>',
        paragraph(
            f"Two minutes of poses at 20 Hz, as a camera and a marker would give them: {position:.1f} cm and "
            f"{attitude:.1f}&deg; of noise found, {outliers} wild poses set aside, {missing} frames without a pose. "
            f"From these and the stick positions the kit found {len(small.uncertainty.names)} parameters in "
            f"{small.seconds:.1f} s. "
            "A third of the flight, in blocks of ten seconds, was kept back to judge the result."
        ),
        table(
            "Two seconds ahead, on time kept back",
            ("fit", "chi2 per degree of freedom", "position [m]", "attitude [deg]"), rows, best=0,
        ),
        paragraph(
            "A chi2 of 1 means that only the noise of the poses is left. The paper's fit compares each state with the "
            "next; the states come from differences of noisy poses, so the noise stands on both sides of the equation "
            "and bends the answer."
        ),
        picture(Picture(
            folder / "predicted.png",
            "From each rust-coloured dot the model flies two seconds on the logged sticks alone. It was not fitted to "
            "this part of the flight.",
            "Measured poses and two-second predictions of position, height, roll, pitch and yaw lie on each other.",
        )),
        picture(Picture(
            folder / "residuals.png",
            "Left: the error does not grow over the two seconds. Middle: it is distributed like noise. Right: what "
            "stays correlated from frame to frame is the slow part of the camera's pose error.",
            "Residual against time ahead, histogram of residuals, and their autocorrelation.",
        )),
        picture(Picture(
            folder / "intervals.png",
            "Not every parameter is worth believing. The half width of each 95 % interval says which.",
            "Parameters sorted by the relative width of their 95 percent interval.",
        )),
        f"<details><summary>What the kit warns about ({len(small.warnings)})</summary><ul>{warnings}</ul></details>",
    ]  # fmt: skip


def _gap_part(gap: GapStudy, record: dict[str, Any], folder: Path) -> list[str]:
    answer = record["simulated_flight"]["gap"]
    sizes = [
        (
            s.meaning,
            f"{s.value:.3f}",
            f"{s.low95:.3f} to {s.high95:.3f}",
            f"{TRUTH[name]:.3f}" if name in TRUTH else "-",
        )
        for name, s in gap.closed.parameters.items()
    ]
    over = [gap.closed.before.chi2 - gap.closed.calm.chi2, gap.closed.after.chi2 - gap.closed.calm.chi2]
    since = f"It set in at {gap.since.time:.1f} s. " if gap.since else "Nothing says that it began in midflight. "
    right = answer["effects"] == answer["truth"]["effects"]
    return [
        '<h2><span class="tag simulated">simulated</span>The same aircraft surprises</h2>',
        paragraph(
            "It flies again, and something is different that the kit is not told. Flown on the logged sticks, the "
            "model of the first flight is now wrong, and the map shows where."
        ),
        picture(Picture(
            folder / "gap_map.png", "The hall from above. Colour says how far the first flight's model is off within "
            "two seconds; 1 is the noise of the poses.", "Map of residuals over the hall for both flights.",
        )),
        paragraph(
            f"<strong>{html.escape(headline(gap.naming))}.</strong> {since}Each of {len(gap.naming.ranking)} effects "
            "was added to the model in turn; the bars say how much it explains beyond what the aircraft's own "
            "parameters can on another day."
        ),
        picture(Picture(folder / "gap_ranking.png", "A difference of 10 is very strong.", "Evidence for each effect.")),
        table("How large it is [m/s], and what the simulator was told", ("what", "found", "95 % interval", "truth"),
              sizes) if sizes else "",
        paragraph(
            f"The truth, which no fit has read: a steady wind of {TRUTH['wind_x']:.3f} m/s along the runway and "
            f"{TRUTH['wind_y']:.3f} m/s across it. The answer is {'right' if right else 'wrong'}."
        ),
        picture(Picture(
            folder / "gap_closed.png",
            f"Two seconds ahead on time kept back: with the effect {100.0 * (1.0 - over[1] / over[0]):.0f} % of the "
            "excess over the first flight is gone.",
            "Bars of the prediction error before, after, and of the first flight.",
        )),
    ]  # fmt: skip


def _alfa_part(alfa: AlfaStory, folder: Path) -> list[str]:
    names = {
        "model": "fitted model",
        "constant turn": "constant turn for its bank",
        "constant velocity": "constant velocity",
    }
    rows = [(names[n], f"{f.position_m:.2f}", f"{f.attitude_deg:.1f}", str(len(f.t))) for n, f in alfa.held_out.items()]
    if alfa.parts_at is None:
        verdict = "The forecasts of the healthy aircraft never leave what is ordinary."
    else:
        verdict = (
            f"At {alfa.parts_at:.1f} s, <strong>{alfa.parts_at - alfa.failure_time:.1f} s after the failure</strong>, "
            f"the forecasts run further ahead than in any healthy moment ({alfa.ordinary_error:.2f} m)."
        )
    wind = [alfa.found.model.values[name] for name in ("wind_x", "wind_y")]
    return [
        '<h2><span class="tag measured">measured</span>A real aircraft loses its engine</h2>',
        paragraph(
            "A 2 m foam Carbon-Z T-28 under an autopilot, 132 s from the ALFA dataset. Its log mixes rates (attitude "
            "2.5 a second, servo pulses 2.9, velocity 19), it weighs thirty times as much as ours, and there is wind: "
            f"the fit finds {math.hypot(*wind):.1f} m/s. The kit's 9-state model starts from our aircraft, scaled to "
            "this size."
        ),
        picture(Picture(
            folder / "alfa_track.png",
            "The engine goes off at the dotted line; speed and height go with it.",
            "Track from above, height and speed over time; after the engine stops both fall.",
        )),
        picture(Picture(
            folder / "alfa_predicted.png",
            "The fitted model against what was measured, two seconds ahead from each rust-coloured dot, ten seconds "
            "kept back from the first fit. Poses come 2.5 times a second.",
            "Measured poses and two-second predictions of the real flight, and its track from above.",
        )),
        table(
            f"Before the failure, one second ahead, forecast by models that had not seen that time ({FOLDS} folds)",
            ("forecast", "position, rms [m]", "attitude, rms [deg]", "forecasts"), rows, best=0,
        ),
        picture(Picture(
            folder / "alfa_forecasts.png",
            "Each dot is one forecast. The simple guesses fail when a turn begins or ends; the model knows the sticks.",
            "Forecast errors over time and their cumulative distribution for three predictors.",
        )),
        paragraph(
            "After the failure we fly the model of the healthy aircraft on the throttle of the 20 s before, because "
            "the log's own throttle falls to zero with the engine: a model that is given it has been told. " + verdict
        ),
        picture(Picture(
            folder / "alfa_failure.png",
            "Positive: the model expects the aircraft further along than it is, for the thrust it counts on is gone. "
            "The grey band is what healthy flight showed.",
            "The forecast error along the track leaves the grey band a few seconds after the engine stops.",
        )),
        paragraph(
            "Also the model that was told stays no good model: in the slow flight after the failure its attitude is "
            f"off by {_attitude_after(alfa):.0f}&deg; rms one second ahead. It never saw such flight."
        ),
    ]  # fmt: skip


def _alfa_gap_part(found: RecordedFlights, folder: Path) -> list[str]:
    gap, failure = found.alfa_gap, found.alfa.failure_time
    loss, told = gap.thrust_loss, gap.told_gain
    return [
        '<h2><span class="tag measured">measured</span>What failed, and when?</h2>',
        paragraph(
            f"Now nothing is told of the engine. The kit gets the poses from {gap.begin:.0f} to {gap.end:.1f} s with "
            "the throttle held, and asks of each force in its catalogue from when on it explains them best. At "
            f"{gap.end:.1f} s a stick leaves the range it had in healthy flight; of what comes after, the model knows "
            "nothing."
        ),
        paragraph(f"{_alfa_verdict(gap, failure)} {_loss_in_words(loss, failure)}"),
        picture(Picture(
            folder / "alfa_suspects.png",
            f"Dots: the middle of {CUTS} ways to cut the flight into windows; lines: all their 95 % intervals. Blue "
            "bars cannot be told apart.",
            "Evidence for each effect, and the time at which it would have set in.",
        )),
        paragraph(
            "The log has another witness, its own throttle, which closes with the engine. Flown on that, the healthy "
            f"model has {told:.0f} of evidence with nothing added and nothing fitted: it is the thrust. With the "
            f"thrust loss the mean square residual around the failure falls from {gap.before:.1f} to {gap.after:.1f} "
            "times that of the healthy flight (on the time it was fitted to: there is too little to keep any back)."
        ),
    ]  # fmt: skip


def _alfa_verdict(gap: AlfaGap, failure: float) -> str:
    names = [s.effect.name.replace("_", " ") for s in gap.chosen]
    if gap.verdict == "named":
        return f"<strong>Missing: {names[0]}.</strong>"
    if gap.verdict == "none":
        return "<strong>No effect explains more than chance would.</strong>"
    listed = f"{', '.join(names[:-1])} or {names[-1]}"
    return (
        f"<strong>Missing: {listed}; these poses do not tell which.</strong> Each slows the aircraft, and in the "
        f"{gap.end - failure:.0f} s that can be judged they do it alike. A step of the throttle would have parted "
        "them: drag does not answer to it."
    )


def _loss_in_words(loss: Suspect, failure: float) -> str:
    return (
        f"If it is the thrust, <strong>{100.0 * loss.value:.0f} %</strong> of it is gone (95 %: "
        f"{100.0 * loss.low95:.0f} to {100.0 * loss.high95:.0f} %), since <strong>{loss.time:.1f} s</strong> "
        f"({loss.earliest:.1f} to {loss.latest:.1f} s); the log says that the engine went off at {failure:.1f} s."
    )


def _closing() -> str:
    return (
        "<footer><p>Made by <code>falconwing demo</code> of the FalconWing kit "
        f"{__version__}. The same on your own flights:</p><pre>falconwing identify calm.csv --out model.toml "
        "--figures figures\nfalconwing gap --calm calm.csv --flight flight.csv --out report</pre>"
        "<p>ALFA: Keipour, Mousaei, Scherer, <em>ALFA: A dataset for UAV fault and anomaly detection</em>, IJRR 40 "
        "(2021), BSD-3-Clause, &copy; 2019 Carnegie Mellon University. No aircraft of ours has been measured on this "
        "page.</p></footer>"
    )


def _cells(s: Score) -> tuple[str, str, str]:
    return f"{s.chi2:.3g}", f"{s.position_m:.3g}", f"{s.attitude_deg:.3g}"
