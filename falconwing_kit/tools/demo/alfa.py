"""ALFA flight: the ROS topics of a real flight -> flight table, model, engine failure, figures.

The aircraft is a 2 m foam T-28 [Keipour, Mousaei & Scherer, ALFA: A dataset for UAV fault and
anomaly detection, IJRR 40 (2021) 515-520]. Properties of the log, measured on it:

- New attitudes and gyro rates come 2.5 times a second (imu-data); every faster topic repeats them.
- Positions come 4.1 times a second, velocities 19 times. Their time stamps are the host's and
  jitter by 10 ms, which is 0.19 m along the track and nothing across it, so each position is
  averaged with its predecessors.
- Servo pulses come 2.9 times a second and are held constant in between. Interpolated ones would use
  the future and predict no better: the roll error one second ahead is 3.1 deg with each at its best
  delay (0.1 s held, 0.2 to 0.3 s interpolated), and 3.3 against 4.0 deg without a delay.
- The rudder pulse is half the aileron pulse to 1 us: the flight cannot separate the two.
- In the failure the autopilot closes its throttle: the throttle in the table goes to zero with it.
"""

import csv
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import (
    Model,
    add_uniform_wind,
    paper_model,
    parameter_record,
    scale_model,
)
from falconwing_kit.aircraft.terms import air_flow
from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.flight_table import FlightTable, read_flight_table, slice_time
from falconwing_kit.core.frames import euler_from_rotation, euler_rates, world_from_enu, wrap_angle
from falconwing_kit.data import data_path
from falconwing_kit.gap.baseline import VERY_STRONG_EVIDENCE, NominalModel, calibrate_nominal_model
from falconwing_kit.gap.close import Onset, find_onset
from falconwing_kit.gap.name import EffectCandidate, fit_flight
from falconwing_kit.gap.noise import PoseNoiseModel
from falconwing_kit.sysid.fit import FitResult, Prior, fit
from falconwing_kit.sysid.forecast import (
    Forecasts,
    constant_turn,
    constant_velocity,
    forecast,
    hold_throttle,
)
from falconwing_kit.sysid.identify import Identification, identify
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import Windows, pose_residuals
from falconwing_kit.sysid.uncertainty import uncertainty
from falconwing_kit.tools.demo.figures import draw_forecast_errors, draw_predictions
from falconwing_kit.tools.reports.page import ACCENT, PREDICTED, QUIET, figure

# ---- Reading the log

RATE_HZ = 20.0
AVERAGED_S = 1.0  # averaging interval of positions before a row, moved to it by the velocity
MAX_LATE_S = 2.0  # a topic that starts later or ends earlier than the attitudes is truncated
# Residual of a model fitted over 2 s: jitter of stamps, the autopilot's filter, gusts.
SIGMA_POSITION, SIGMA_ATTITUDE = 0.15, 0.026
# ROS body axes are nose, left, up; ours are nose, right, belly.
R_BODY_ROS = np.diag([1.0, -1.0, -1.0])
MIDDLE_PULSE_US = 1500.0
HALF_TRAVEL_US = 400.0  # ArduPilot's servo range is 1100..1900 us
IDLE_PULSE_US, FULL_PULSE_US = 1100.0, 1900.0  # 1 % of the logged throttle (vfr_hud) is 8 us

_TOPICS = {
    "failure": ("failure_status-engines", ("data",)),
    "imu": (
        "mavros-imu-data",
        (
            *(f"orientation.{axis}" for axis in "xyzw"),
            *(f"angular_velocity.{axis}" for axis in "xyz"),
        ),
    ),
    "position": (
        "mavros-local_position-odom",
        tuple(f"pose.pose.position.{axis}" for axis in "xyz"),
    ),
    "velocity": ("mavros-nav_info-velocity", tuple(f"meas_{axis}" for axis in "xyz")),
    "airspeed": ("mavros-nav_info-airspeed", ("measured",)),
    "servos": ("mavros-rc-out", tuple(f"channels{number}" for number in range(8))),
    "wind": ("mavros-wind_estimation", ("twist.linear.x", "twist.linear.y")),
}


@dataclass(frozen=True)
class AlfaFlight:
    """One recorded flight with an engine failure; world x = north, y = west, z = up from the
    take-off point.
    """

    # 20 Hz, with a pose in the rows of a new attitude; extra vx..vz, p..r, airspeed, sigmas
    table: FlightTable
    failure_time: float  # first "engine off" of the log, in the table's clock [s]
    wind_logged_world: Array  # (2,) the autopilot's wind estimate: north, west [m/s]
    warnings: tuple[str, ...] = ()  # repairs while reading, one sentence each


@dataclass(frozen=True)
class _Topic:
    t: Array  # (N,) header stamp where there is one, else arrival [s], strictly increasing
    values: Array  # (N, columns)


def read_alfa(folder: str | Path) -> AlfaFlight:
    """Read one flight of the ALFA dataset.

    Args:
        folder: holds the topics as CSV, named as in the dataset without the flight's prefix:
            "mavros-imu-data.csv".

    Returns:
        The flight; time zero is its first attitude.

    Raises:
        FileNotFoundError: the folder or one of the topics is missing.
        InputError: a file is not the topic of its name, or the files end before the failure.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: expected the folder of an ALFA flight's CSV files, got none; check the path"
        )
    warnings = list[str]()
    topics = {
        key: _read_topic(folder, name, columns, warnings)
        for key, (name, columns) in _TOPICS.items()
    }
    start, end = topics["imu"].t[0], topics["imu"].t[-1]
    for key, topic in topics.items():
        if key != "failure" and (topic.t[0] > start + MAX_LATE_S or topic.t[-1] < end - MAX_LATE_S):
            raise InputError(
                f"{folder.name}: {_TOPICS[key][0]} covers {topic.t[0] - start:.1f} to "
                f"{topic.t[-1] - start:.1f} s of the attitudes' {end - start:.1f} s; "
                "the file is cut, copy it again"
            )
    failure_time = topics["failure"].t[0] - start
    if not 0.0 < failure_time < end - start:
        raise InputError(
            f"{folder.name}: the engine failure at {failure_time:.1f} s is outside the flight of "
            f"{end - start:.1f} s; the files are cut or of different flights, copy them again"
        )
    wind = topics["wind"]
    return AlfaFlight(
        table=_flight_table(folder.name, topics, start, tuple(warnings)),
        failure_time=round(float(failure_time), 3),
        wind_logged_world=_wind_world(wind.values[wind.t < topics["failure"].t[0]]),
        warnings=tuple(warnings),
    )


def _read_topic(folder: Path, name: str, columns: tuple[str, ...], warnings: list[str]) -> _Topic:
    """The named columns of one topic; a truncated last line is dropped with a warning."""
    path = require_file(folder / f"{name}.csv")
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = list(csv.reader(file))
    header = [column.removeprefix("field.") for column in lines[0]] if lines else []
    missing = [column for column in ("%time", *columns) if column not in header]
    if missing:
        raise InputError(
            f"{path.name}: expected the columns {', '.join(missing)}, got none of that name; "
            "check the file"
        )
    if len(lines) > 1 and len(lines[-1]) != len(header):
        warnings.append(f"{path.name}: the last line is cut off and was dropped")
        lines.pop()
    stamp = "header.stamp" if "header.stamp" in header else "%time"
    places = [header.index(column) for column in (stamp, *columns)]
    try:
        cells = np.array([[float(line[place]) for place in places] for line in lines[1:]])
    except (ValueError, IndexError):
        raise InputError(
            f"{path.name}: a cell is not a number or a line is short; copy the file again"
        ) from None
    if len(cells) < 2 or not np.isfinite(cells).all():
        raise InputError(
            f"{path.name}: expected two or more lines of finite numbers, got {len(cells)} lines; "
            "copy it again"
        )
    increasing = cells[:, 0] > np.maximum.accumulate(np.concatenate([[-np.inf], cells[:-1, 0]]))
    if not increasing.all():
        warnings.append(
            f"{path.name}: {(~increasing).sum()} lines whose time does not increase were dropped"
        )
    return _Topic(cells[increasing, 0] * 1e-9, cells[increasing, 1:])


def _flight_table(
    name: str, topics: dict[str, _Topic], start: float, warnings: tuple[str, ...]
) -> FlightTable:
    """All topics on one 20 Hz grid; attitudes and positions only in the rows of a measurement."""
    imu, velocity, airspeed = topics["imu"], topics["velocity"], topics["airspeed"]
    t = np.arange(int((imu.t[-1] - start) * RATE_HZ + 0.5) + 1) / RATE_HZ
    row = np.rint((imu.t - start) * RATE_HZ).astype(np.int64)
    attitude, rates_body = _attitude(imu, start + t[row] - imu.t)
    # logged as north, east, down
    v_world = world_from_enu(velocity.values[:, [1, 0, 2]] * [1.0, 1.0, -1.0])
    # the airspeed repeats its last value until the next measurement
    fresh = np.flatnonzero(np.diff(airspeed.values[:, 0], prepend=np.nan) != 0.0)
    extra = {
        key: _at(start + t, velocity.t, v_world[:, axis], 3)
        for axis, key in enumerate(("vx", "vy", "vz"))
    }
    extra |= {key: _in_rows(rates_body[:, axis], row, len(t)) for axis, key in enumerate("pqr")}
    extra["airspeed"] = _at(start + t, airspeed.t[fresh], airspeed.values[fresh, 0], 2)
    extra["sigma_position"] = np.full(len(t), SIGMA_POSITION)
    extra["sigma_attitude"] = np.full(len(t), SIGMA_ATTITUDE)
    p_world = _positions(topics["position"], velocity.t, v_world, start + t[row])
    return FlightTable(
        name=name,
        t=np.round(t, 3),
        p_world=np.column_stack([_in_rows(values, row, len(t), 3) for values in p_world.T]),
        attitude=np.column_stack([_in_rows(values, row, len(t)) for values in attitude.T]),
        commands=_commands(topics["servos"], start + t),
        extra=extra,
        warnings=warnings,
    )


def _attitude(imu: _Topic, late: Array) -> tuple[Array, Array]:
    """Attitude (N, 3) extrapolated by `late` [s] with the gyro rates, and p, q, r (N, 3) [rad/s].

    The logged quaternion rotates nose-left-up into east-north-up. Extrapolating by at most 25 ms
    has an error below 0.2 deg at 10 rad/s^2.
    """
    from scipy.spatial.transform import Rotation

    quaternions = imu.values[:, :4]  # x, y, z, w
    if not quaternions.any(axis=1).all():
        raise InputError(
            f"{_TOPICS['imu'][0]}: expected attitudes as quaternions, got one of length 0; "
            "copy the file again"
        )
    # rows are the body axes in east-north-up: world_from_enu takes vectors in the last axis
    axes_enu = Rotation.from_quat(quaternions).as_matrix().transpose(0, 2, 1)
    R_world_body = world_from_enu(axes_enu).transpose(0, 2, 1) @ R_BODY_ROS
    attitude = np.column_stack(euler_from_rotation(R_world_body))
    rates_body = imu.values[:, 4:] @ R_BODY_ROS
    rates = np.column_stack(euler_rates(R_world_body[:, 2].T, *rates_body.T))
    return wrap_angle(attitude + late[:, None] * rates), rates_body


def _positions(position: _Topic, t_velocity: Array, v_world: Array, t: Array) -> Array:
    """Positions (N, 3) [m] at times t: mean over the last second, moved to t by the velocity.

    Only data up to t enters, so a prediction from a row uses nothing of its future.
    """
    p_logged = world_from_enu(position.values)
    # path = integral of the logged velocity, by the trapezoidal rule
    steps = 0.5 * (v_world[1:] + v_world[:-1]) * np.diff(t_velocity)[:, None]
    path = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])

    def along(query: Array) -> Array:
        return np.column_stack([np.interp(query, t_velocity, axis) for axis in path.T])

    # offset of the path that each logged position implies; averaged over (t - 1 s, t]
    start_of_path = p_logged - along(position.t)
    last = np.maximum(np.searchsorted(position.t, t, side="right"), 1)
    first = np.minimum(np.searchsorted(position.t, t - AVERAGED_S, side="right"), last - 1)
    return along(t) + [start_of_path[a:b].mean(axis=0) for a, b in zip(first, last, strict=True)]


def _commands(servos: _Topic, t: Array) -> Array:
    """Commands (N, 4) from servo pulses, zero-order hold: throttle 0..1, the others -1..1.

    Channels, counted from zero, found from the motion: 1 elevator (a longer pulse lowers the nose),
    2 throttle, 3 rudder, 4 and 5 the ailerons (a longer pulse lowers the right wing; both always
    agree). Trims are not removed.
    """
    elevator, throttle, rudder, aileron = servos.values[:, 1:5].T
    deflection = [
        (pulse - MIDDLE_PULSE_US) / HALF_TRAVEL_US for pulse in (aileron, elevator, rudder)
    ]
    power = (throttle - IDLE_PULSE_US) / (FULL_PULSE_US - IDLE_PULSE_US)
    channels = np.column_stack([power, deflection[0], -deflection[1], deflection[2]])
    latest = np.maximum(np.searchsorted(servos.t, t, side="right") - 1, 0)
    return np.round(channels[latest], 4)


def _wind_world(wind_enu: Array) -> Array:
    """Median wind (2,) north, west [m/s], positive in the direction of the air's motion.

    The log's vector has the opposite sign: it points to where the wind comes from.
    """
    east, north = np.median(wind_enu, axis=0)
    return np.round(world_from_enu([-east, -north, 0.0])[:2], 2)


def _at(query: Array, t: Array, values: Array, digits: int) -> Array:
    return np.round(np.interp(query, t, values), digits)


def _in_rows(values: Array, rows: np.ndarray, length: int, digits: int = 5) -> Array:
    column = np.full(length, np.nan)
    column[rows] = np.round(values, digits)
    return column


# ---- Model of the nominal aircraft and its predictions through the failure

BLOCK_S, FOLDS = 10.0, 4  # cross-validation: every fourth block of ten seconds is held out
DELAY_S = 0.1  # fixed: servo pulses come 2.9 times a second, so the delay is not identifiable
# before, the autopilot's position and velocity differ by up to 1.6 m/s (data/README.md)
SETTLING_S = 12.0
AVERAGE_S = 2.0  # moving average of the along-track error


@dataclass(frozen=True)
class AlfaAnalysis:
    """Model of the real flight before the failure, and its predictions of the whole flight."""

    table: FlightTable
    failure_time: float  # [s]
    found: Identification  # fitted to all data before the failure
    held_out: dict[str, Forecasts]  # before the failure: model, constant turn, constant velocity
    logged: Forecasts  # whole flight, final model with the logged throttle
    nominal: Forecasts  # the same with the throttle fixed at its value before the failure
    fixed_throttle: float  # 0..1
    # of "held out", "nominal", "logged": time [s], moving average of the along-track error [m],
    # positive for a prediction ahead of the aircraft
    along_track: dict[str, tuple[Array, Array]]
    nominal_error: float  # maximum of it in the held-out predictions before the failure [m]
    detection_time: float | None  # when it first exceeds that after the failure [s]


def analyse_alfa_flight(progress: Callable[[str], None] = lambda stage: None) -> AlfaAnalysis:
    """Fit the 9-state model in a uniform wind to the data before the failure; predict the flight.

    Args:
        progress: called with the name of each stage.
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
    progress("real flight, all before the failure")
    found = identify([before], model=model, prior=prior)
    for fold in range(FOLDS):
        progress(f"real flight, fold {fold + 1} of {FOLDS}")
        # It begins where the fit to all ended: with a quarter less to go by, a fit from the scaled
        # model can end in a far worse minimum, on some processors and not on others.
        segments = _training_segments(before, fold)
        fitted = identify(segments, model=found.model, prior=prior).model
        predictions = (forecast(fitted, before), constant_turn(before), constant_velocity(before))
        for name, forecasts in zip(held_out, predictions, strict=True):
            held_out[name].append(_fold_forecasts(forecasts, before.t, fold))
    fixed_throttle_table = hold_throttle(table, failure)
    logged, nominal = forecast(found.model, table), forecast(found.model, fixed_throttle_table)
    joined = {name: _join_forecasts(parts) for name, parts in held_out.items()}
    along_track = {
        name: _moving_along_track_error(forecasts, table)
        for name, forecasts in (
            ("held out", joined["model"]),
            ("nominal", nominal),
            ("logged", logged),
        )
    }
    # detection: the first error after the failure above the maximum of held-out nominal flight
    t, error = along_track["held out"]
    nominal_error = float(np.abs(error[t > SETTLING_S + AVERAGE_S]).max())
    t, error = along_track["nominal"]
    beyond = t[(t > failure) & (np.abs(error) > nominal_error)]
    throttle = float(fixed_throttle_table.commands[-1, 0])
    return AlfaAnalysis(
        table,
        failure,
        found,
        joined,
        logged,
        nominal,
        throttle,
        along_track,
        nominal_error,
        float(beyond[0]) if len(beyond) else None,
    )


def read_alfa_metadata() -> dict[str, Any]:
    """The flight's metadata: failure time, aircraft size, logged wind, source."""
    return tomllib.loads(data_path("alfa_engine_failure.toml").read_text(encoding="utf-8"))


def alfa_initial_model(facts: dict[str, Any]) -> Model:
    """Initial model: the 150 g aircraft scaled to this one, in the autopilot's logged wind.

    Delay, lag and the thrust's loss with speed are fixed, since this log does not identify them.
    """
    aircraft = facts["aircraft"]
    model = scale_model(paper_model(), aircraft["mass"], aircraft["wing_area"], aircraft["span"])
    model = add_uniform_wind(model, *facts["wind_logged_world"]).with_values(
        {"delay": DELAY_S, "lag": 0.0}
    )
    return model.with_fixed(("delay", "lag", "kTV"))


def nominal_prior(model: Model) -> Prior:
    """Independent Gaussians around the model's values: sigma half of each, 3 m/s for the wind."""
    sigma = {p.name: 0.5 * (abs(p.start) or 0.02) for p in model.parameters if p.high > p.low}
    return Prior(dict(model.values), sigma | {"wind_x": 3.0, "wind_y": 3.0})


def _training_segments(table: FlightTable, fold: int) -> list[FlightTable]:
    """The flight's contiguous segments outside the fold."""
    blocks = np.arange(int(np.ceil(table.t[-1] / BLOCK_S)))
    kept = [int(b) for b in blocks if b % FOLDS != fold]
    runs = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
    return [slice_time(table, run[0] * BLOCK_S, (run[-1] + 1) * BLOCK_S) for run in runs]


def _fold_forecasts(forecasts: Forecasts, t: Array, fold: int) -> Forecasts:
    """Predictions that start and end in one block of the fold."""
    first, last = (np.floor(when / BLOCK_S) for when in (t[forecasts.start], forecasts.t))
    return forecasts.subset((first == last) & (first % FOLDS == fold))


def _join_forecasts(parts: list[Forecasts]) -> Forecasts:
    fields = [
        np.concatenate([getattr(p, name) for p in parts])
        for name in ("start", "end", "t", "error_position", "error_attitude")
    ]
    order = np.lexsort((fields[0], fields[2]))  # by their ends, then by their starts
    return Forecasts(*(f[order] for f in fields))


def _moving_along_track_error(forecasts: Forecasts, table: FlightTable) -> tuple[Array, Array]:
    """Time of each prediction and along-track error [m], averaged over the last AVERAGE_S."""
    # unit vector of the horizontal velocity at the end of each prediction: (N, 2)
    ahead = np.stack([table.extra[name][forecasts.end] for name in ("vx", "vy")], axis=1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    along = np.sum(forecasts.error_position[:, :2] * ahead, axis=1)
    # (N, N): which predictions enter the average at each time
    within = (forecasts.t[None] <= forecasts.t[:, None]) & (
        forecasts.t[None] > forecasts.t[:, None] - AVERAGE_S
    )
    return forecasts.t, np.asarray((within * along).sum(axis=1) / within.sum(axis=1))


# ---- Which effect explains the failure, and its onset

WINDOW_S = 4.0  # ten poses of this log, as half a second of a camera's
WINDOW_OFFSETS = 4  # ways to cut the interval into windows, a second apart
NOMINAL_S = 50.0  # analysed before the failure too, so that the interval does not reveal its time
WHITE_NOISE = PoseNoiseModel((0.0, 0.0), (0.5, 0.5))  # poses 0.4 s apart are uncorrelated


@dataclass(frozen=True)
class OnsetHypothesis:
    """An effect with its onset; medians over several ways to cut the interval into windows."""

    effect: Effect
    # against the nominal model: chi2 over the reduced chi2, less the BIC penalty of parameters
    # and onset
    delta_bic: float
    time: float  # onset [s]
    earliest: float  # union of all cuts' 95 % intervals [s]
    latest: float
    value: float  # of its first parameter, with the median of the 95 % intervals
    low95: float
    high95: float


@dataclass(frozen=True)
class AlfaGap:
    """The effects that explain the failure, found without the logged throttle."""

    verdict: Literal["named", "ambiguous", "none"]
    hypotheses: tuple[OnsetHypothesis, ...]  # best first
    threshold: float  # of delta_bic, from the flight before the failure
    logged_throttle_gain: float  # of the logged throttle alone, with no parameter added
    begin: float  # of the analysed interval [s]
    end: float  # when a command first leaves the range it had before the failure [s]
    # mean square residual of the windows after the failure over that before it: nominal model
    before: float
    after: float  # with the thrust loss

    @property
    def chosen(self) -> tuple[OnsetHypothesis, ...]:
        """Hypotheses that the poses cannot separate from the best; none if not significant."""
        near = tuple(
            s
            for s in self.hypotheses
            if s.delta_bic > self.hypotheses[0].delta_bic - VERY_STRONG_EVIDENCE
        )
        return near if self.verdict != "none" else ()

    @property
    def thrust_loss(self) -> OnsetHypothesis:
        """The true effect."""
        return next(s for s in self.hypotheses if s.effect.name == "thrust_loss")


def study_alfa_gap(
    analysis: AlfaAnalysis, progress: Callable[[str], None] = lambda stage: None
) -> AlfaGap:
    """Find the onset at which each force of the catalogue explains the last minute best.

    The throttle is fixed at its value before the failure. The interval ends when a command leaves
    the range it had before the failure: the slow flight beyond, with the elevator far up, is
    outside the model's training data. With a dozen windows the result depends on where they are
    cut, so they are cut in several ways and the median result is taken.

    Args:
        analysis: the flight and its failure.
        progress: called with the name of each stage.
    """
    progress("real flight, longer windows")
    failure, start = analysis.failure_time, alfa_initial_model(read_alfa_metadata())
    nominal = [slice_time(analysis.table, 0.0, failure)]
    found = identify(nominal, model=start, prior=nominal_prior(start), window_s=WINDOW_S)
    catalogue = applicable_effects(found.model)
    windows = found.fitted_windows
    base = calibrate_nominal_model(
        found,
        WHITE_NOISE,
        fit(found.model, windows, found.result.initial_states),
        windows,
        catalogue,
    )
    end = _input_range_exit(analysis.table, failure)
    threshold = max(VERY_STRONG_EVIDENCE, 3.0 * base.false_alarm_level)
    answers: dict[str, list[OnsetHypothesis]] = {}
    others = []  # delta_bic of the logged throttle, residual ratios before and after
    for cut in range(WINDOW_OFFSETS):
        progress(f"real flight, effects and onsets, cut {cut + 1} of {WINDOW_OFFSETS}")
        begin = failure - NOMINAL_S - cut * WINDOW_S / WINDOW_OFFSETS
        onsets, *rest = _analyse_offset(base, catalogue, analysis.table, begin, end, failure)
        others.append(rest)
        for onset, hypothesis in onsets:
            answers.setdefault(onset.effect.name, []).append(hypothesis)
        catalogue = tuple(
            o.effect for o, _ in onsets if o.delta_bic > threshold or o.effect.name == "thrust_loss"
        )
    hypotheses = sorted(
        (_median_hypothesis(a) for a in answers.values() if len(a) == WINDOW_OFFSETS),
        key=lambda s: -s.delta_bic,
    )
    near = sum(s.delta_bic > hypotheses[0].delta_bic - VERY_STRONG_EVIDENCE for s in hypotheses)
    verdict: Literal["named", "ambiguous", "none"] = "ambiguous" if near > 1 else "named"
    logged_fit, before, after = np.median(others, axis=0).tolist()
    if hypotheses[0].delta_bic <= threshold:
        verdict = "none"
    begin = failure - NOMINAL_S
    return AlfaGap(verdict, tuple(hypotheses), threshold, logged_fit, begin, end, before, after)


def _analyse_offset(
    base: NominalModel,
    catalogue: Sequence[Effect],
    table: FlightTable,
    begin: float,
    end: float,
    failure: float,
) -> tuple[list[tuple[Onset, OnsetHypothesis]], float, float, float]:
    """One cut: every effect's onset, delta_bic of the logged throttle, residual ratios."""
    fixed_throttle_table = slice_time(hold_throttle(table, failure), begin, end)
    windows, before = fit_flight(base, prepare(fixed_throttle_table, base.found.sigma))
    logged_table = prepare(slice_time(table, begin, end), base.found.sigma)
    logged = replace(windows, flights=logged_table.flights)  # other commands, the same poses
    logged_fit = fit(before.model, logged, before.initial_states, prior=base.prior)
    late = windows.nodes[:, -1] + begin > failure
    onsets, after = [], before
    for effect in catalogue:
        unknown = EffectCandidate(
            effect, 0.0, 0.0, {p.name: p.start for p in effect.parameters}, None
        )
        onset = find_onset(base, windows, before, [unknown])
        if onset is not None:
            onsets.append((onset, _build_hypothesis(base, windows, onset)))
            after = onset.result if effect.name == "thrust_loss" else after
    ratios = [
        _mean_square(r, windows, late) / _mean_square(r, windows, ~late) for r in (before, after)
    ]
    return onsets, (before.cost - logged_fit.cost) / base.reduced_chi2, ratios[0], ratios[1]


def _build_hypothesis(base: NominalModel, windows: Windows, onset: Onset) -> OnsetHypothesis:
    name = onset.effect.parameters[0].name
    value = onset.result.model.values[name]
    low, high = uncertainty(onset.result, windows, base.prior).interval(name, value)
    return OnsetHypothesis(
        onset.effect, onset.delta_bic, onset.time, onset.low95, onset.high95, value, low, high
    )


def _median_hypothesis(cuts: Sequence[OnsetHypothesis]) -> OnsetHypothesis:
    """Medians over the cuts; a flap whose lift may be zero equals drag and gets no evidence."""
    effect = cuts[0].effect
    delta_bic, time, value, low, high = (
        float(np.median([getattr(s, name) for s in cuts]))
        for name in ("delta_bic", "time", "value", "low95", "high95")
    )
    if effect.parameters[0].name in effect.essential and low < 0.0 < high:
        delta_bic = min(delta_bic, 0.0)
    earliest, latest = min(s.earliest for s in cuts), max(s.latest for s in cuts)
    return OnsetHypothesis(effect, delta_bic, time, earliest, latest, value, low, high)


def applicable_effects(model: Model, catalogue: Sequence[Effect] = CATALOGUE) -> tuple[Effect, ...]:
    """Effects that are identifiable in a model with quasi-steady rates: forces without a moment.

    Its rates follow commands and flow without delay, so a moment, an angular acceleration, has no
    place in it, and a trim bias is the same as other L_0, M_0, N_0. A component that an effect does
    not have is the float 0.0 in its formula.
    """
    one = np.ones(1)
    flow = air_flow((one, one, one), (one, one, one), (one, one, one), one, (one, one, one, one))
    chosen = []
    for effect in catalogue:
        full, term = model.with_effect(effect), effect.term(model.terms)
        if term is None:
            continue
        try:
            loads = term.evaluate(flow, parameter_record(full.names)(*full.vector))
        except AttributeError:  # the effect uses a parameter that this model does not have
            continue
        if all(type(moment) is float and moment == 0.0 for moment in loads[3:]):
            chosen.append(effect)
    return tuple(chosen)


def _input_range_exit(table: FlightTable, failure: float) -> float:
    """When a command, the throttle excepted, first leaves its range before the failure [s]."""
    inputs, nominal = table.commands[:, 1:], table.t < failure
    low, high = inputs[nominal].min(axis=0), inputs[nominal].max(axis=0)
    beyond = ~nominal & ((inputs < low) | (inputs > high)).any(axis=1)
    return float(table.t[beyond][0]) if beyond.any() else float(table.t[-1])


def _mean_square(result: FitResult, windows: Windows, which: np.ndarray) -> float:
    squares = pose_residuals(result.residual, windows)[which] ** 2
    return float(squares.sum() / np.count_nonzero(windows.weight[which]))


# ---- Figures


def draw_alfa_figures(analysis: AlfaAnalysis, folder: Path) -> tuple[Path, ...]:
    """Write alfa_track.png, _predicted.png, _forecasts.png and _failure.png to a folder."""
    paths = tuple(
        folder / f"alfa_{name}.png" for name in ("track", "predicted", "forecasts", "failure")
    )
    draw_track(analysis, paths[0])
    draw_predictions(analysis.found, paths[1])
    draw_forecasts(analysis, paths[2])
    draw_failure(analysis, paths[3])
    return paths


def draw_track(analysis: AlfaAnalysis, path: Path) -> None:
    """The flight from above, its height and speed over time, with the engine failure marked."""
    table = analysis.table
    seen = table.has_pose
    t, p = table.t[seen], table.p_world[seen]
    after = t >= analysis.failure_time
    speed = np.sqrt(sum(table.extra[k] ** 2 for k in ("vx", "vy", "vz")))
    with figure(path, 2, 2, (11.0, 4.6), width_ratios=[1.15, 1.0]) as axes:
        grid = axes[0, 0].get_gridspec()
        for ax in axes[:, 0]:
            ax.remove()
        above = axes[0, 1].figure.add_subplot(grid[:, 0])
        above.plot(-p[~after, 1], p[~after, 0], "-", color=PREDICTED, lw=1.3, label="engine on")
        above.plot(-p[after, 1], p[after, 0], "-", color=ACCENT, lw=3.0, label="engine off")
        above.plot(-p[0, 1], p[0, 0], "o", color=QUIET, ms=5, label="start of the log")
        above.set_aspect("equal", adjustable="datalim")
        above.set_xlabel("east [m]")
        above.set_ylabel("north [m]")
        above.set_title("Measured track")
        above.legend(loc="center right")
        _over_time(axes[0, 1], t, p[:, 2], analysis, "height [m]")
        _over_time(axes[1, 1], table.t, speed, analysis, "speed over ground [m/s]")
        axes[1, 1].set_xlabel("time [s]")


def draw_forecasts(analysis: AlfaAnalysis, path: Path) -> None:
    """Errors of held-out predictions before the failure: the model and two simple predictors."""
    labels = {
        "model": "fitted model",
        "constant turn": "constant turn for its bank",
        "constant velocity": "constant velocity",
    }
    forecasts = {label: analysis.held_out[name] for name, label in labels.items()}
    draw_forecast_errors(forecasts, path, title="Prediction 1 s ahead, held-out data", highest=8.0)


def draw_failure(analysis: AlfaAnalysis, path: Path) -> None:
    """The last minute: along-track error of the nominal predictions, and the logged throttle."""
    begin = analysis.failure_time - 50.0
    with figure(path, 2, 1, (11.0, 5.2), sharex=True, height_ratios=[2.0, 1.0]) as axes:
        ax, below = axes[:, 0]
        styles = (
            (
                "nominal",
                "-",
                ACCENT,
                2.2,
                f"throttle fixed at {analysis.fixed_throttle:.2f}, its mean of the 20 s before",
            ),
            ("logged", "--", PREDICTED, 1.6, "logged throttle, which falls to zero"),
        )
        for name, line, colour, width, label in styles:
            t, error = analysis.along_track[name]
            shown = t > begin
            ax.plot(t[shown], error[shown], line, color=colour, lw=width, label=label)
        ax.axhspan(-analysis.nominal_error, analysis.nominal_error, color="#eeeeee", zorder=0)
        note = f"maximum error of held-out predictions before the failure, after {SETTLING_S:.0f} s"
        ax.annotate(
            note,
            (begin, -analysis.nominal_error),
            (6, 5),
            textcoords="offset points",
            fontsize=8,
            color=QUIET,
        )
        _mark_failure(ax, analysis)
        if analysis.detection_time is not None:
            ax.axvline(analysis.detection_time, color=QUIET, lw=1.0, ls="-.")
            late = analysis.detection_time - analysis.failure_time
            ax.annotate(
                f"deviates from the measurement\n{late:.1f} s after the failure",
                (analysis.detection_time, 0.0), (8, -48), textcoords="offset points", fontsize=8.5,
            )  # fmt: skip
        ax.set_ylabel("prediction ahead of the aircraft [m]\n(1 s horizon, 2 s moving average)")
        ax.set_title("After the engine fails, the nominal model over-predicts speed")
        ax.legend(loc="upper left")
        shown = analysis.table.t > begin
        below.plot(
            analysis.table.t[shown],
            analysis.table.commands[shown, 0] * 100.0,
            "-",
            color=QUIET,
            lw=1.3,
        )
        below.set_ylabel("logged throttle [%]")
        below.set_xlabel("time [s]")
        _mark_failure(below, analysis)


def draw_hypotheses(gap: AlfaGap, failure: float, path: Path) -> None:
    """Delta BIC and onset of each effect; `failure` is the time of the logged engine-off [s]."""
    shown = gap.hypotheses[::-1]
    with figure(path, 1, 2, (11.0, 0.36 * len(shown) + 1.5), sharey=True) as axes:
        evidence, times = axes[0]
        for row, s in enumerate(shown):
            evidence.barh(
                row,
                max(s.delta_bic, 0.0),
                height=0.6,
                color=PREDICTED if s in gap.chosen else "#c9d4df",
            )
            times.plot([s.earliest, s.latest], [row, row], "-", color=QUIET, lw=2.0)
            times.plot(s.time, row, "o", color=PREDICTED, ms=6)
        evidence.axvline(
            gap.logged_throttle_gain,
            color=QUIET,
            lw=1.2,
            ls=":",
            label="logged throttle alone, no parameter added",
        )
        evidence.axvline(gap.threshold, color=ACCENT, lw=1.2, ls="--", label="threshold")
        evidence.set_yticks(range(len(shown)), [s.effect.name.replace("_", " ") for s in shown])
        evidence.set_xlabel("delta BIC at the best onset")
        evidence.set_title("Candidate effects")
        evidence.legend(loc="lower right", frameon=True, fontsize=8)
        times.axvline(failure, color=ACCENT, lw=1.4, ls=":")
        times.annotate(
            "engine off", (failure, 1.0), (4, -12), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8.5, color=ACCENT,
        )  # fmt: skip
        times.set_xlim(gap.end - 25.0, gap.end)
        times.set_xlabel("time [s]")
        times.set_title("Onset, 95 % interval")


def _over_time(ax: Any, t: Any, values: Any, analysis: AlfaAnalysis, label: str) -> None:
    after = t >= analysis.failure_time
    ax.plot(t, values, "-", color=PREDICTED, lw=1.3)
    ax.plot(t[after], values[after], "-", color=ACCENT, lw=2.6)
    ax.set_ylabel(label)
    _mark_failure(ax, analysis)


def _mark_failure(ax: Any, analysis: AlfaAnalysis) -> None:
    ax.axvline(analysis.failure_time, color=ACCENT, lw=1.2, ls=":")
    ax.annotate(
        "engine off", (analysis.failure_time, 0.02), (-4, 2), xycoords=("data", "axes fraction"),
        textcoords="offset points", ha="right", fontsize=8.5, color=ACCENT,
    )  # fmt: skip
