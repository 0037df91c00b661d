"""The real flight: the ALFA log -> a model of the healthy aircraft, and when the failed one leaves
its forecasts.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.aircraft.model import Model, add_uniform_wind, paper_model, scale_model
from falconwing_kit.core.checks import Array
from falconwing_kit.core.flight_table import FlightTable, read_flight_table, slice_time
from falconwing_kit.data import data_path
from falconwing_kit.sysid.fit import Prior
from falconwing_kit.sysid.forecast import (
    Forecasts,
    constant_turn,
    constant_velocity,
    forecast,
    hold_throttle,
)
from falconwing_kit.sysid.identify import Identification, identify

BLOCK_S, FOLDS = (
    10.0,
    4,
)  # every fourth block of ten seconds is forecast by a model that has not seen it
DELAY_S = 0.1  # the log's servo pulses come 2.9 times a second, which hides the delay: it is held
SETTLING_S = (
    12.0  # until then the autopilot's filter contradicts itself by up to 1.6 m/s (data/README.md)
)
RUNNING_S = 2.0  # errors are averaged over this long before they are compared with healthy flight


@dataclass(frozen=True)
class AlfaAnalysis:
    """What the real flight showed."""

    table: FlightTable
    failure_time: float  # [s]
    found: Identification  # fitted to everything before the failure
    held_out: dict[str, Forecasts]  # before the failure: model, constant turn, constant velocity
    told: Forecasts  # the whole flight by the final model on the logged throttle
    healthy: Forecasts  # the same as if the throttle had stayed where it was
    fixed_throttle: float  # 0..1
    running: dict[
        str, tuple[Array, Array]
    ]  # time [s] and running mean of the error along the track [m], forecast ahead
    nominal_error: float  # the largest of it in the held-out forecasts before the failure [m]
    detection_time: float | None  # when it first exceeds that after the failure [s]


def analyse_alfa_flight(progress: Callable[[str], None] = lambda stage: None) -> AlfaAnalysis:
    """Fit the paper's 9-state model in a uniform wind to the healthy part and forecast all of the
    flight.

    Args:
        progress: called with the name of each stage.

    Returns:
        The story.
    """
    table = read_flight_table(data_path("alfa_engine_failure.csv"))
    facts = read_alfa_metadata()
    failure = float(facts["failure_time"])
    before = slice_time(table, 0.0, failure)
    model = alfa_initial_model(facts)
    prior = nominal_prior(model)
    held_out: dict[str, list[Forecasts]] = {
        "model": [],
        "constant turn": [],
        "constant velocity": [],
    }
    for fold in range(FOLDS):
        progress(f"real flight, fold {fold + 1} of {FOLDS}")
        fitted = identify(_training_segments(before, fold), model=model, prior=prior).model
        made = (forecast(fitted, before), constant_turn(before), constant_velocity(before))
        for name, forecasts in zip(held_out, made, strict=True):
            held_out[name].append(_fold_forecasts(forecasts, before.t, fold))
    progress("real flight, all before the failure")
    found = identify([before], model=model, prior=prior)
    fixed_throttle_table = hold_throttle(table, failure)
    told, healthy = forecast(found.model, table), forecast(found.model, fixed_throttle_table)
    joined = {name: _join_forecasts(parts) for name, parts in held_out.items()}
    running = {
        name: _moving_along_track_error(f, table)
        for name, f in (("held out", joined["model"]), ("healthy", healthy), ("told", told))
    }
    t, error = running["held out"]
    ordinary = float(np.abs(error[t > SETTLING_S + RUNNING_S]).max())
    t, error = running["healthy"]
    beyond = t[(t > failure) & (np.abs(error) > ordinary)]
    throttle = float(fixed_throttle_table.commands[-1, 0])
    return AlfaAnalysis(
        table,
        failure,
        found,
        joined,
        told,
        healthy,
        throttle,
        running,
        ordinary,
        float(beyond[0]) if len(beyond) else None,
    )


def read_alfa_metadata() -> dict[str, Any]:
    """What is known of the flight beside its table: failure time, aircraft size, logged wind,
    source.
    """
    return tomllib.loads(data_path("alfa_engine_failure.toml").read_text(encoding="utf-8"))


def alfa_initial_model(facts: dict[str, Any]) -> Model:
    """Where the fit begins: the 150 g aircraft scaled to this one, in the wind that the autopilot
    logged.

    Args:
        facts: the table beside the flight: aircraft size and logged wind.

    Returns:
        The 9-state model; delay, lag and the thrust's loss with speed are held, since this log
        cannot tell them.
    """
    aircraft = facts["aircraft"]
    model = scale_model(paper_model(), aircraft["mass"], aircraft["wing_area"], aircraft["span"])
    model = add_uniform_wind(model, *facts["wind_logged_world"]).with_values(
        {"delay": DELAY_S, "lag": 0.0}
    )
    return model.with_fixed(("delay", "lag", "kTV"))


def nominal_prior(model: Model) -> Prior:
    """An ordinary aircraft of this size, to half of each value; the wind to 3 m/s.

    Args:
        model: from `alfa_initial_model`.

    Returns:
        Independent Gaussians around its values.
    """
    sigma = {p.name: 0.5 * (abs(p.start) or 0.02) for p in model.parameters if p.high > p.low}
    return Prior(dict(model.values), sigma | {"wind_x": 3.0, "wind_y": 3.0})


def _training_segments(table: FlightTable, fold: int) -> list[FlightTable]:
    """The flight's stretches that are not in the fold."""
    blocks = np.arange(int(np.ceil(table.t[-1] / BLOCK_S)))
    kept = [int(b) for b in blocks if b % FOLDS != fold]
    runs = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
    return [slice_time(table, run[0] * BLOCK_S, (run[-1] + 1) * BLOCK_S) for run in runs]


def _fold_forecasts(forecasts: Forecasts, t: Array, fold: int) -> Forecasts:
    """Forecasts that start and end in one block of the fold."""
    first, last = (np.floor(when / BLOCK_S) for when in (t[forecasts.start], forecasts.t))
    return forecasts.subset((first == last) & (first % FOLDS == fold))


def _join_forecasts(parts: list[Forecasts]) -> Forecasts:
    fields = [
        np.concatenate([getattr(p, name) for p in parts])
        for name in ("start", "end", "t", "error_position", "error_attitude")
    ]
    order = np.argsort(fields[2])
    return Forecasts(*(f[order] for f in fields))


def _moving_along_track_error(forecasts: Forecasts, table: FlightTable) -> tuple[Array, Array]:
    """Mean error along the track [m] of the forecasts that ended in the last RUNNING_S, at the end
    of each.
    """
    ahead = np.stack([table.extra[name][forecasts.end] for name in ("vx", "vy")], axis=1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    along = np.sum(forecasts.error_position[:, :2] * ahead, axis=1)
    within = (forecasts.t[None] <= forecasts.t[:, None]) & (
        forecasts.t[None] > forecasts.t[:, None] - RUNNING_S
    )
    return forecasts.t, np.asarray((within * along).sum(axis=1) / within.sum(axis=1))
