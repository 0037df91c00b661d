"""The demo on recorded flights: identify one made by an independent simulator, then a real one -> page and figures."""

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
from falconwing_kit.demo.alfa_figures import draw_alfa_story
from falconwing_kit.demo.alfa_story import FOLDS, AlfaStory, tell_alfa_story
from falconwing_kit.demo.figures import draw_identification
from falconwing_kit.gap.page import Picture, paragraph, picture, table, write_page
from falconwing_kit.sysid.identify import Identification, identify
from falconwing_kit.sysid.model_file import write_model
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.score import Score, score, select

SIMULATED_FLIGHT = "case08_calm.csv"
Progress = Callable[[str], None]


@dataclass(frozen=True)
class RecordedFlights:
    """What the demo found in the two recorded flights."""

    small: Identification  # the 150 g aircraft of the independent simulator
    small_one_step: dict[str, Score]  # the paper's loss on raw and on smoothed differences, held-out time
    alfa: AlfaStory


def study_recorded_flights(progress: Progress = lambda stage: None) -> RecordedFlights:
    """Identify both flights.

    Args:
        progress: called with the name of each stage.

    Returns:
        What was found.
    """
    progress("150 g aircraft, multiple shooting")
    small = identify([read_flight_table(data_path(SIMULATED_FLIGHT))])
    flights = [flight for p in small.prepared for flight in p.flights]
    held_out = select(small.windows, small.held_out_index)
    one_step = {}
    for name in ("raw", "smoothed"):
        progress(f"150 g aircraft, one-step fit on {name} differences")
        one_step[name] = score(fit_one_step(rates_model(), flights, smoothed=name == "smoothed"), held_out)
    return RecordedFlights(small, one_step, tell_alfa_story(progress))


def write_recorded_flights(found: RecordedFlights, folder: Path) -> dict[str, Any]:
    """Write page, figures, models and figures of merit.

    Args:
        found: what the demo found.
        folder: where to; it must exist.

    Returns:
        The record that stands in demo.json.
    """
    record = demo_record(found)
    draw_identification(found.small, folder)
    draw_alfa_story(found.alfa, folder)
    write_model(folder / "model_150g.toml", found.small)
    write_model(folder / "model_alfa.toml", found.alfa.found)
    with atomic_write(folder / "demo.json", text=True) as handle:
        json.dump(record, handle, indent=2)
    parts = [*_opening(), *_small_part(found, folder), *_alfa_part(found.alfa, folder), _closing()]
    write_page(folder / "index.html", "FalconWing kit: two recorded flights", parts)
    return record


def demo_record(found: RecordedFlights) -> dict[str, Any]:
    """The figures of merit as plain numbers.

    Args:
        found: what the demo found.

    Returns:
        Keys simulated_flight and real_flight.
    """
    small, alfa = found.small, found.alfa
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
        },
    }


def _opening() -> list[str]:
    return [
        "<h1>Two recorded flights, neither of them ours</h1>",
        paragraph("What the FalconWing kit learns from a log of poses and sticks, and how far to trust it.", "lead"),
        paragraph(
            '<span class="tag simulated">simulated</span> the first flight comes from JSBSim, an independent flight '
            "simulator, with an aircraft that was not told to the kit. "
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
    warnings = "".join(f"<li>{w}</li>" for w in small.warnings)
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
            f"the fit finds {math.hypot(*wind):.1f} m/s. The kit's nine-state form starts from our aircraft, scaled to "
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
    ]  # fmt: skip


def _closing() -> str:
    return (
        "<footer><p>Made by <code>falconwing demo</code> of the FalconWing kit "
        f"{__version__}. The same on your own flight:</p><pre>falconwing identify flight.csv --out model.toml "
        "--figures figures</pre><p>ALFA: Keipour, Mousaei, Scherer, <em>ALFA: A dataset for UAV fault and anomaly "
        "detection</em>, IJRR 40 (2021), BSD-3-Clause, &copy; 2019 Carnegie Mellon University. No aircraft of ours has "
        "been measured on this page.</p></footer>"
    )


def _cells(s: Score) -> tuple[str, str, str]:
    return f"{s.chi2:.3g}", f"{s.position_m:.3g}", f"{s.attitude_deg:.3g}"
