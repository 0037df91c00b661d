"""Baselines for naming: a calm base and a flight -> the effect that common practice would name, or
none.

Both recipes get the same flights, the same aircraft with the same prior, and the same catalogue as
the kit. They differ in the loss: accelerations from smoothed poses are a linear regression on what
each effect would add to them.

    stepwise  forward selection by partial F, the first column to enter is the name [Klein &
              Morelli, Aircraft System Identification, ch. 5]
    pysindy   sequentially thresholded least squares as PySINDy does it [Brunton,
              Proctor & Kutz 2016]

We made them as good as we could: outliers count little before anything is differentiated; the
model's accelerations pass the smoother's own low-pass before they are compared, which takes away
most of the smoothing bias; each channel counts by what the calm flight leaves in it; the base model
is refitted under the kit's prior, or held; of each effect only the place that explains most stands
in the library, and of columns that correlate by more than 0.9 PySINDy sees only the better.
Neighbouring rows share poses, so F is larger than chance allows, as in the common practice. To pick
a threshold in hindsight, over the flights that are judged, favours a baseline.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model, state_rates
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import euler_rates, up_in_body
from falconwing_kit.gap.baseline import NominalModel, identify_baseline
from falconwing_kit.gap.evidence import effect_variants
from falconwing_kit.sysid.fit import prior_rows
from falconwing_kit.sysid.prepare import (
    LOCAL_SPAN_S,
    MAX_SAMPLES,
    MIN_SAMPLES,
    PreparedFlight,
    prepare,
)
from falconwing_kit.sysid.shooting import FIRST_ROW, cut_windows

F_TO_ENTER = 20.0  # the book's, five times what chance needs at 95 %
F_LEVELS = (
    F_TO_ENTER,
    30.0,
    50.0,
    70.0,
    100.0,
    150.0,
    200.0,
    300.0,
    500.0,
    700.0,
    1000.0,
    1500.0,
    2000.0,
)
THRESHOLDS = (
    0.02,
    0.03,
    0.05,
    0.07,
    0.1,
    0.15,
    0.2,
    0.3,
    0.5,
    0.7,
    1.0,
)  # rms of a column's part, in calm sigmas
COLLINEAR = 0.9  # beyond it two columns are one to a regression [Klein & Morelli, ch. 5]
Treatment = Literal["refitted", "held"]  # of the base model's parameters on the flight under test
TREATMENTS: tuple[Treatment, ...] = ("refitted", "held")


@dataclass(frozen=True)
class Answer:
    """What a baseline says."""

    verdict: Literal["named", "none"]
    name: str  # "none" where nothing is named
    ranking: tuple[
        tuple[str, float], ...
    ]  # effects, best first: partial F, or share of the explained residual


@dataclass(frozen=True)
class Regression:
    """Unexplained accelerations and what would explain them, M rows and C columns."""

    residual: Array  # (M,) measured minus base model, in sigmas of the calm flight
    columns: Array  # (M, C) change by each amplitude, root mean square 1
    names: tuple[str, ...]  # (C,) the effect of each column
    degrees_of_freedom: int  # rows less the parameters refitted


def stepwise_name(
    calm: FlightTable,
    flight: FlightTable,
    enter: float = F_TO_ENTER,
    treatment: Treatment = "refitted",
) -> Answer:
    """Name an effect by stepwise regression: the first column that enters.

    Args:
        calm: a flight without surprise.
        flight: the flight under test.
        enter: least partial F.
        treatment: of the base model's parameters.

    Returns:
        The answer; the ranking holds the largest partial F of each effect.

    Raises:
        InputError: a flight cannot be used.
    """
    return first_to_enter(effect_regression(identify_baseline(calm), flight, treatment), enter)


def pysindy_name(
    calm: FlightTable, flight: FlightTable, treatment: Treatment = "refitted"
) -> dict[float, Answer]:
    """Name an effect by PySINDy's STLSQ, once for every threshold.

    Args:
        calm: a flight without surprise.
        flight: the flight under test.
        treatment: of the base model's parameters.

    Returns:
        Threshold -> answer; the ranking holds each surviving effect's share of the explained
        residual.

    Raises:
        InputError: a flight cannot be used.
    """
    regression = effect_regression(identify_baseline(calm), flight, treatment)
    return {threshold: sparse(regression, threshold) for threshold in THRESHOLDS}


def baseline_answers(
    base: NominalModel, flight: FlightTable, pysindy: bool = True
) -> dict[str, str]:
    """What every baseline names, with the calm flight known already.

    Args:
        base: the aircraft without surprise.
        flight: the flight under test.
        pysindy: ask PySINDy too, which is an extra of its own.

    Returns:
        Effect or "none" by "stepwise" (F-to-enter 20), "stepwise@<F>" and "pysindy@<threshold>";
        the same with "_held" before the @ where the base model's parameters stay as they were on
        the calm flight.

    Raises:
        InputError: the flight cannot be used.
    """
    answers: dict[str, str] = {}
    for treatment in TREATMENTS:
        regression = effect_regression(base, flight, treatment)
        mark = "_held" if treatment == "held" else ""
        answers |= {f"stepwise{mark}@{F:g}": first_to_enter(regression, F).name for F in F_LEVELS}
        if pysindy:
            answers |= {
                f"pysindy{mark}@{least:g}": sparse(regression, least).name for least in THRESHOLDS
            }
    return {"stepwise": answers[f"stepwise@{F_TO_ENTER:g}"], **answers}


# The two recipes
# --------------------------------------------------------------------------------------------------


def first_to_enter(regression: Regression, enter: float = F_TO_ENTER) -> Answer:
    """First step of forward selection: F = explained by one column / (left / freedom).

    Args:
        regression: M rows, C columns.
        enter: least partial F.

    Returns:
        The effect with the largest F if that is at least `enter`, else none.
    """
    explained = _alone(regression.columns, regression.residual)
    left = np.sum(regression.residual**2) - explained
    F = explained / np.maximum(left / max(regression.degrees_of_freedom - 1, 1), 1e-300)
    largest = {name: 0.0 for name in regression.names}
    for name, value in zip(regression.names, F.tolist(), strict=True):
        largest[name] = max(largest[name], value)
    return _answer(largest, enter)


def sparse(regression: Regression, threshold: float) -> Answer:
    """PySINDy's sequentially thresholded least squares on all columns at once.

    Least squares shares the explained sum of squares among columns: coefficient times (column .
        residual).

    Args:
        regression: M rows, C columns.
        threshold: columns with a smaller coefficient are dropped, again and again.

    Returns:
        The effect with the largest share of what the surviving columns explain, or none where none
        survives.
    """
    import warnings

    from pysindy.optimizers import STLSQ

    kept = _separable(regression.columns, regression.residual)
    X, y = regression.columns[:, kept], regression.residual
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it says so when it drops every column
        c = STLSQ(threshold=threshold).fit(X, y[:, None]).coef_[0]
    explained = max(float(y @ X @ c), 1e-300)
    shares: dict[str, float] = {}
    for k in np.flatnonzero(c):
        name = regression.names[kept[k]]
        shares[name] = shares.get(name, 0.0) + float(c[k] * (X[:, k] @ y)) / explained
    return _answer(shares, 0.0)


def _answer(score: dict[str, float], least: float) -> Answer:
    ranking = tuple(sorted(score.items(), key=lambda item: -item[1]))
    if ranking and ranking[0][1] >= least:
        return Answer("named", ranking[0][0], ranking)
    return Answer("none", "none", ranking)


def _alone(columns: Array, residual: Array) -> Array:
    """(C,) sum of squares that each column explains by itself."""
    return np.asarray((columns.T @ residual) ** 2 / np.sum(columns**2, axis=0))


def _alike(columns: Array) -> Array:
    """(C, C) size of the columns' correlations."""
    unit = columns / np.linalg.norm(columns, axis=0)
    return np.asarray(np.abs(unit.T @ unit))


def _separable(columns: Array, residual: Array) -> list[int]:
    """Columns, best first, without those that nearly repeat a better one."""
    alike = _alike(columns)
    kept: list[int] = []
    for k in np.argsort(-_alone(columns, residual)):
        if all(alike[k, other] <= COLLINEAR for other in kept):
            kept.append(int(k))
    return kept


# The regression
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Flown:
    """A flight as the base model sees it, and what other models would change."""

    flights: tuple[PreparedFlight, ...]
    model: Model
    sticks: tuple[Array, ...]  # (N, 4) control positions of each stretch
    at: Array  # (N, 6) accelerations of the model
    sigma: Array  # (6,) what one counts of each channel [m/s^2, rad/s^2]

    @classmethod
    def of(cls, flights: Sequence[PreparedFlight], model: Model, sigma: Array) -> "Flown":
        """Prepared stretches of one flight, with the base model evaluated."""
        sticks = control_positions(model, flights)
        return cls(tuple(flights), model, sticks, accelerations(model, flights, sticks), sigma)

    @property
    def residual(self) -> Array:
        """(M,) measured minus model, in sigmas; the six channels of a row follow each other."""
        return np.asarray(((measured_accelerations(self.flights) - self.at) / self.sigma).ravel())

    def change(self, other: Model) -> Array:
        """(M,) how far another model's accelerations are from the base model's, in sigmas."""
        same = other.actuator_parameter_names == self.model.actuator_parameter_names and all(
            other.values[name] == self.model.values[name] for name in other.actuator_parameter_names
        )
        sticks = self.sticks if same else control_positions(other, self.flights)
        return np.asarray(
            ((accelerations(other, self.flights, sticks) - self.at) / self.sigma).ravel()
        )


def effect_regression(
    base: NominalModel, flight: FlightTable, treatment: Treatment = "refitted"
) -> Regression:
    """Accelerations that the base model does not explain, and the columns of all effects.

    Args:
        base: the aircraft without surprise.
        flight: the flight under test.
        treatment: "refitted" lets the base model's parameters move under the prior the kit has;
            "held" does not.

    Returns:
        The regression, linear and angular accelerations together.

    Raises:
        InputError: the flight cannot be used, or the base model has no body rates.
    """
    model = base.result.model
    if model.form != "rates":
        raise InputError(
            f"base model: expected the form with body rates, got {model.form!r}; "
            "identify with form='rates'"
        )
    calm = Flown.of(
        [f for prepared in base.found.prepared for f in prepared.flights], model, np.ones(6)
    )
    sigma = 1.4826 * np.median(np.abs(calm.residual.reshape(-1, 6)), axis=0)
    flown = Flown.of(prepare(flight, base.found.sigma).flights, model, sigma)
    y, (names, places, X) = flown.residual, _effect_columns(flown)
    degrees_of_freedom = len(y)
    if treatment == "refitted":
        free = tuple(i for i, p in enumerate(model.parameters) if p.high > p.low)
        known, _ = prior_rows(
            model, free, base.prior
        )  # as further measurements: mixed estimation [Theil 1963]
        K = np.concatenate([_parameter_columns(flown, free), known])
        Q, _ = np.linalg.qr(K / np.linalg.norm(K, axis=0))
        beyond = np.concatenate([np.column_stack([X, y]), np.zeros((len(known), len(names) + 1))])
        beyond -= Q @ (Q.T @ beyond)
        X, y = beyond[:, :-1], beyond[:, -1]
        degrees_of_freedom -= len(free)
    best = _best_places(names, places, X, y)
    X = X[:, best] / np.sqrt(np.mean(X[:, best] ** 2, axis=0))
    return Regression(y, X, tuple(names[k] for k in best), degrees_of_freedom)


def _effect_columns(flown: Flown) -> tuple[list[str], list[int], Array]:
    """Name, number of the place tried, and column (M, C) of each amplitude: a secant to the
    variant's own size.
    """
    names, places, columns = [], [], []
    windows = cut_windows(flown.flights, flown.model)
    tried = [e for e in CATALOGUE if not e.measurement_map or e.amplitudes[-1].name == "tilt_roll"]
    for place, variant in enumerate(effect_variants(tried, windows)):
        absent = {p.name: 0.0 for p in variant.effect.amplitudes}
        without = flown.model.with_effect(variant.effect).with_values({**variant.values, **absent})
        for p in variant.effect.amplitudes:
            size = variant.values[p.name]
            names.append(variant.effect.name)
            places.append(place)
            columns.append(flown.change(without.with_values({p.name: size})) / size)
    return names, places, np.stack(columns, axis=1)


def _parameter_columns(flown: Flown, free: Sequence[int]) -> Array:
    """(M, F) change of the accelerations by each free parameter of the base model."""
    model, columns = flown.model, []
    for i in free:
        name, value = model.names[i], model.values[model.names[i]]
        step = (
            1e-3
            if name in model.actuator_parameter_names
            else 1e-4 * max(abs(value), abs(model.parameters[i].start), 0.1)
        )
        columns.append(flown.change(model.with_values({name: value + step})) / step)
    return np.stack(columns, axis=1)


def _best_places(
    names: Sequence[str], places: Sequence[int], columns: Array, residual: Array
) -> list[int]:
    """Of each effect the columns of the place that explains most by itself; what two effects share
    is the simpler's.
    """
    best: dict[str, tuple[float, list[int]]] = {}
    for place in dict.fromkeys(places):
        mine = [
            k for k, p in enumerate(places) if p == place and np.any(np.abs(columns[:, k]) > 1e-9)
        ]
        if not mine:
            continue
        Q, _ = np.linalg.qr(columns[:, mine])
        explained = float(np.sum((Q.T @ residual) ** 2))
        if explained > best.get(names[mine[0]], (-1.0, []))[0]:
            best[names[mine[0]]] = (explained, mine)
    chosen = [k for _, mine in sorted(best.values(), key=lambda found: len(found[1])) for k in mine]
    alike = _alike(columns[:, chosen])
    return [k for i, k in enumerate(chosen) if not np.any(alike[i, :i] > 1.0 - 1e-9)]


# Accelerations
# --------------------------------------------------------------------------------------------------


def measured_accelerations(flights: Sequence[PreparedFlight]) -> Array:
    """Second derivatives of the local cubics.

    Args:
        flights: prepared stretches.

    Returns:
        (N, 6) of the velocity in the world [m/s^2] and of the body rates [rad/s^2], away from the
        stretches' ends.
    """
    return np.concatenate([flight.state_derivatives[_inner(flight), 6:] for flight in flights])


def accelerations(
    model: Model, flights: Sequence[PreparedFlight], sticks: Sequence[Array]
) -> Array:
    """The same of a model at the smoothed states, as the smoother would show them.

    Args:
        model: the form with body rates, at its present values.
        flights: prepared stretches.
        sticks: (N, 4) control positions of each.

    Returns:
        (N, 6) [m/s^2, rad/s^2].
    """
    parts = []
    for flight, positions in zip(flights, sticks, strict=True):
        full = _at_smoothed_states(model, flight, flight.t - flights[0].t[0], positions)
        low_pass = smoother_low_pass(_half(flight))
        shown = np.stack([np.convolve(channel, low_pass, "same") for channel in full], axis=1)
        parts.append(shown[_inner(flight)])
    return np.concatenate(parts)


def control_positions(model: Model, flights: Sequence[PreparedFlight]) -> tuple[Array, ...]:
    """Mean control positions over the time that each row stands for.

    Args:
        model: says how sticks become control positions.
        flights: prepared stretches.

    Returns:
        (N, 4) for each stretch.
    """
    positions = []
    for flight in flights:
        t = flight.t - flight.t[0]
        between = 0.5 * (t[1:] + t[:-1])
        edges = np.concatenate([[2.0 * t[0] - between[0]], between, [2.0 * t[-1] - between[-1]]])
        positions.append(model.actuator_positions(t, flight.commands, edges, model.K)[0])
    return tuple(positions)


def smoother_low_pass(half: int) -> Array:
    """What a local cubic's second derivative does to the true acceleration.

    The derivative is a weighted sum of 2 h + 1 poses [Savitzky & Golay 1964]. Summed twice, its
    weights are those with which it averages second differences, that is accelerations.

    Args:
        half: h, samples on each side.

    Returns:
        (2 h - 1,) weights, sum 1.
    """
    s = np.arange(-half, half + 1)
    second_derivative = 2.0 * np.linalg.pinv(np.stack([s**0, s, s**2, s**3], axis=1))[2]
    return np.asarray(np.cumsum(np.cumsum(second_derivative))[:-2])


def _half(flight: PreparedFlight) -> int:
    """Samples on each side of a local cubic, as `prepare` takes them."""
    interval = float(np.median(np.diff(flight.t)))
    return int(np.clip(round(LOCAL_SPAN_S / interval), MIN_SAMPLES - 1, MAX_SAMPLES - 1)) // 2


def _inner(flight: PreparedFlight) -> slice:
    """Rows whose cubics are centred and whose early commands are known."""
    return slice(FIRST_ROW + _half(flight), len(flight.t) - _half(flight))


def _at_smoothed_states(model: Model, flight: PreparedFlight, time: Array, sticks: Array) -> Array:
    """(6, N) accelerations; a tilted camera measures attitude, rates and their derivatives in its
    own axes.
    """
    K, x = model.K, flight.state_estimate.T.copy()
    tilt = np.array([K.tilt_roll, K.tilt_pitch, 0.0]) if "tilt_roll" in model.names else None
    if tilt is not None:
        roll, pitch, yaw = euler_rates(
            up_in_body(x[5], x[3]), *(0.0 * x[0] + angle for angle in tilt)
        )
        x[3:6] -= np.stack([pitch, yaw, roll])
        x[9:] += np.cross(tilt, x[9:].T).T
    rates: tuple[Any, ...] = state_rates(model.form, model.terms, model.winds)(time, x, sticks.T, K)
    full = np.stack([np.broadcast_to(rate, time.shape) for rate in rates[6:]])
    if tilt is not None:
        full[3:] -= np.cross(tilt, full[3:].T).T
    return full
