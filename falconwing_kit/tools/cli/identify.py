"""falconwing identify: fit the aircraft model to recorded flights."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from falconwing_kit.aircraft.airframe import load_airframe, scaling_sentence
from falconwing_kit.aircraft.model import FORMS, Model, scale_model
from falconwing_kit.aircraft.terms import Term, WindTerm
from falconwing_kit.aircraft.user_file import CODE_NOTICE, load_terms
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.files import require_writable_path
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.forecast import constant_turn, constant_velocity, forecast
from falconwing_kit.sysid.identify import MAX_REDUCED_CHI2, Identification, identify
from falconwing_kit.sysid.model_file import KNOWN_TERMS, read_model, write_model
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.prepare import CHANNELS
from falconwing_kit.sysid.score import score
from falconwing_kit.sysid.shooting import select_windows
from falconwing_kit.tools.bridge.flight_file import read_flight
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

GOOD_CHI2 = 2.0  # held out, per degree of freedom; above it the exit code is 1


@dataclass(frozen=True)
class Identify:
    """Fit the aircraft model to recorded flights and score its predictions on held-out time.

    Exit code 1 when the model does not describe the flight (held-out chi2 per degree of freedom
    above 2; for motion capture, errors above half of a constant turn's), when a channel of the log
    seems reversed, or when the start model predicts another flight (--judge) equally well or
    better.
    """

    flights: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """flights of one aircraft: flight tables (CSV) or flight logs (MCAP), or logs of ROS 2 (MCAP),
    PX4 (.ulg) and ArduPilot (.bin) as export reads them
    """
    out: Path | None = None
    """the model file to write, such as model.toml"""
    figures: Path | None = None
    """folder for three figures: predicted against measured, residuals, intervals"""
    form: Literal["rates", "paper"] = "rates"
    """rates: the 12-state model, body rates have their own dynamics; paper: the paper's 9-state
    model
    """
    start: Path | None = None
    """a model file to start from, instead of a 150 g aircraft"""
    airframe: Path | None = None
    """an airframe file: start from the 150 g aircraft scaled to its mass, wing area and span"""
    terms: Path | None = None
    """Python file with TERMS = [...], added to the model; it is code that runs with your rights"""
    sigma_position_m: float | None = None
    """noise of each position coordinate; estimated if not given"""
    sigma_attitude_deg: float | None = None
    """noise of each attitude angle; estimated if not given"""
    judge: Path | None = None
    """another flight of the aircraft, with velocities as `falconwing poses` writes them: predicted
    one second ahead
    """
    one_step: bool = False
    """show the paper's one-step fit beside the result"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Fit, print and write the requested files; the exit code is that of the class.

        Raises:
            FileNotFoundError: a flight, a model file or the folder to write into is missing.
            InputError: a flight cannot be used, or a file cannot be written.
        """
        if not self.flights:
            raise InputError(
                "identify: expected at least one flight table, got none; "
                "try falconwing identify flight.csv"
            )
        self._require_writable()
        tables = [read_flight(path) for path in self.flights]
        other = None if self.judge is None else read_flight(self.judge)
        model = self._model()
        if other is not None:
            constant_turn(other)  # raises before the fit where the flight has no velocities
        found = identify(
            tables, model=model, sigma=self._sigma(), progress=None if self.json else _progress()
        )
        baseline = self._baseline(found) if self.one_step else None
        if self.out is not None:
            write_model(self.out, found)
        if self.figures is not None:
            from falconwing_kit.tools.demo.figures import draw_identification

            self.figures.mkdir(parents=True, exist_ok=True)
            draw_identification(found, self.figures)
        record = identification_record(found, baseline)
        if other is not None:
            record["one_second_ahead"] = one_second_ahead(found.model, model, other)
        if self.json:
            print_json(record)
        else:
            _print_record(record, found)
            next_line(self._next())
        chi2 = found.held_out.chi2 if found.held_out else found.train.chi2
        is_described = chi2 <= GOOD_CHI2 or (chi2 > MAX_REDUCED_CHI2 and found.describes_flight)
        if GOOD_CHI2 < chi2 <= MAX_REDUCED_CHI2:  # above that, identify itself warns
            print(
                f"the model does not describe the flight: chi2 per degree of freedom {chi2:.1f}, "
                f"expected at most {GOOD_CHI2:g}; run falconwing gap, with a calm flight, "
                "to name what is missing",
                file=sys.stderr,
            )
        ahead = record.get("one_second_ahead")
        is_better = ahead is None or ahead["fitted"]["position_m"] < ahead["start"]["position_m"]
        return 0 if is_described and not found.reversed_channels and is_better else 1

    def _require_writable(self) -> None:
        """Raise InputError before the fit for files that could not be written after it."""
        if self.out is not None:
            require_writable_path(self.out)
        if self.figures is not None:
            there = next(place for place in (self.figures, *self.figures.parents) if place.exists())
            if not there.is_dir():
                raise InputError(
                    f"--figures {self.figures}: expected a folder, but {there} is a file; "
                    "choose another name"
                )

    def _model(self) -> Model:
        """The start model, with those terms of the user's file that it does not have yet."""
        terms: tuple[Term | WindTerm, ...] = ()
        if self.terms is not None:
            print(CODE_NOTICE.format(file=self.terms), file=sys.stderr)
            terms = load_terms(self.terms, self.form)
        model = self._start(terms)
        present = {term.name for term in model.terms} | {wind.name for wind in model.winds}
        return model.with_terms(*(term for term in terms if term.name not in present))

    def _start(self, terms: tuple[Term | WindTerm, ...]) -> Model:
        if self.start is not None:
            if self.airframe is not None:
                raise InputError("identify: expected --start or --airframe, got both")
            return read_model(self.start, (*KNOWN_TERMS, *terms)).model
        model = FORMS[self.form]()
        if self.airframe is None:
            return model
        airframe = load_airframe(self.airframe)
        if sentence := scaling_sentence(airframe):
            print(sentence, file=sys.stderr)
        return scale_model(model, airframe.mass, airframe.wing_area, airframe.span)

    def _sigma(self) -> Any:
        given = (self.sigma_position_m, self.sigma_attitude_deg)
        if given == (None, None):
            return None
        if None in given:
            raise InputError(
                "noise: expected both --sigma-position-m and --sigma-attitude-deg, got one of them"
            )
        position = require_range("--sigma-position-m", given[0] or 0.0, low=1e-4, high=10.0)
        attitude = require_range("--sigma-attitude-deg", given[1] or 0.0, low=1e-3, high=60.0)
        return np.array([position] * 3 + [np.radians(attitude)] * 3)

    def _baseline(self, found: Identification) -> dict[str, Any]:
        """The paper's loss on the same flights, raw and smoothed, and its held-out score."""
        flights = [flight for p in found.prepared for flight in p.flights]
        start = FORMS[found.model.form]()
        windows = (
            select_windows(found.windows, found.held_out_index) if found.held_out else found.windows
        )
        fitted = {
            name: fit_one_step(start, flights, smoothed=name == "smoothed")
            for name in ("raw", "smoothed")
        }
        return {
            name: {
                "held_out_chi2_per_dof": score(model, windows).chi2,
                "values": dict(model.values),
            }
            for name, model in fitted.items()
        }

    def _next(self) -> str:
        if self.out is None:
            return "--out model.toml keeps the model, --figures DIR shows it"
        return (
            f"look at {self.figures}"
            if self.figures
            else "--figures DIR shows predicted against measured"
        )


def identification_record(
    found: Identification, baseline: dict[str, Any] | None = None
) -> dict[str, Any]:
    """JSON record of an identification, with the one-step fits as "one_step" where given."""
    confidence, held_out = found.uncertainty, found.held_out
    units = {p.name: p for p in found.model.parameters}
    parameters = {}
    for name in confidence.names:
        low, high = found.interval(name)
        parameters[name] = {
            "value": found.model.values[name],
            "low95": low,
            "high95": high,
            "unit": units[name].unit,
            "meaning": units[name].meaning,
            "excited": name not in confidence.not_excited,
        }
    record: dict[str, Any] = {
        "flights": list(found.names),
        "form": found.model.form,
        "held_out": {
            "chi2_per_dof": held_out.chi2 if held_out else None,
            "position_m": held_out.position_m if held_out else None,
            "attitude_deg": held_out.attitude_deg if held_out else None,
            "windows": held_out.windows if held_out else 0,
            "seconds_ahead": 2.0,
            "describes_flight": found.describes_flight,
            "constant_turn": {
                "position_m": found.turn.position_m,
                "attitude_deg": found.turn.attitude_deg,
            },
        },
        "train": {"chi2_per_dof": found.train.chi2, "windows": found.train.windows},
        "noise": {
            name: {"used": used * scale, "white": white * scale, "unit": unit}
            for name, used, white, scale, unit in zip(
                CHANNELS,
                found.sigma,
                found.sigma_white,
                (1.0, 1.0, 1.0, *[180.0 / np.pi] * 3),
                ("m", "m", "m", "deg", "deg", "deg"),
                strict=True,
            )
        },
        "outliers": sum(p.outliers for p in found.prepared),
        "rows_without_pose": sum(p.missing for p in found.prepared),
        "parameters": parameters,
        "warnings": list(found.warnings),
        "seconds": found.seconds,
    }
    return record if baseline is None else {**record, "one_step": baseline}


def one_second_ahead(fitted: Model, start: Model, other: FlightTable) -> dict[str, Any]:
    """Errors of one-second predictions of a flight that was not fitted, from its commands alone.

    Args:
        fitted: the model to validate.
        start: the model from which its fit started.
        other: the flight, with velocities (and rates for the 12-state model).

    Returns:
        For fitted, start, constant_turn and constant_velocity the RMS of the distance, position_m,
        and of the three angles together, attitude_deg; the flight's name and the number of
        forecasts.

    Raises:
        InputError: the flight has no velocities, or no two poses a second apart.
    """
    forecasts = {"fitted": forecast(fitted, other), "start": forecast(start, other)}
    forecasts |= {
        "constant_turn": constant_turn(other),
        "constant_velocity": constant_velocity(other),
    }
    errors = {
        name: {"position_m": f.position_m, "attitude_deg": f.attitude_deg}
        for name, f in forecasts.items()
    }
    return {**errors, "flight": other.name, "forecasts": len(forecasts["fitted"].t)}


def _print_record(record: dict[str, Any], found: Identification) -> None:
    flags = dict.fromkeys(found.uncertainty.not_excited, "NOT EXCITED")
    flags |= dict.fromkeys(found.uncertainty.at_bound, "ON ITS BOUND")
    rows = [
        (name, p["value"], p["low95"], p["high95"], p["unit"], flags.get(name, p["meaning"]))
        for name, p in record["parameters"].items()
    ]
    print_table(
        ("parameter", "value", "low 95 %", "high 95 %", "unit", "meaning"),
        rows,
        title=", ".join(found.names),
    )
    held, train, noise = record["held_out"], record["train"], record["noise"]
    print()
    print_table(
        ("2 s ahead", "chi2 per dof", "position [m]", "attitude [deg]", "windows"),
        [
            (
                "held-out time",
                held["chi2_per_dof"],
                held["position_m"],
                held["attitude_deg"],
                held["windows"],
            ),
            (
                "fitted time",
                train["chi2_per_dof"],
                found.train.position_m,
                found.train.attitude_deg,
                train["windows"],
            ),
            ("constant turn", found.turn.chi2, found.turn.position_m, found.turn.attitude_deg, ""),
        ],
    )
    if "one_second_ahead" in record:
        _print_judged(record["one_second_ahead"])
    for name, fitted in record.get("one_step", {}).items():
        chi2 = fitted["held_out_chi2_per_dof"]
        print(f"the paper's one-step fit, {name} differences: chi2 per dof {chi2:.3g} held out")
    position = np.mean([noise[c]["used"] for c in CHANNELS[:3]])
    attitude = np.mean([noise[c]["used"] for c in CHANNELS[3:]])
    print(
        f"pose noise {100 * position:.1f} cm and {attitude:.2f} deg; "
        f"{record['outliers']} outliers set aside, "
        f"{record['rows_without_pose']} rows without a pose; fitted in {record['seconds']:.1f} s"
    )
    for sentence in record["warnings"]:
        print(f"warning: {sentence}")


def _print_judged(ahead: dict[str, Any]) -> None:
    """Print the one-second errors on the other flight as a table."""
    names = ("fitted", "start", "constant_turn", "constant_velocity")
    rows = [
        (name.replace("_", " "), ahead[name]["position_m"], ahead[name]["attitude_deg"])
        for name in names
    ]
    title = (
        f"\n{ahead['flight']}, not fitted to: {ahead['forecasts']} forecasts one second ahead, rms"
    )
    print_table(("forecast", "position [m]", "attitude [deg]"), rows, title=title)
    print()


def _progress() -> Any:
    """A progress line on standard error that names the stage."""
    from tqdm import tqdm

    bar = tqdm(bar_format="{desc}: {elapsed}", leave=False, disable=None)

    def show_stage(stage: str, chi2: float) -> None:
        bar.set_description_str(f"{stage}, chi2 per dof {chi2:.2f}" if np.isfinite(chi2) else stage)

    return show_stage
