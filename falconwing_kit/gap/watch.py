"""Watching: a nominal model and a stream of CSV rows, read one by one -> an alarm, and seconds
later a name; the rows so far as a flight table.

Fault detection by residual evaluation [Basseville & Nikiforov, Detection of Abrupt Changes, 1993].
The innovations of an extended Kalman filter (`innovations.py`) are white as long as the aircraft is
as modelled. Two sequential tests look at them:

    step    generalised likelihood ratio of a constant force or moment that began at an unknown time
            within the last seconds [Willsky & Jones 1976]. Its signature in the innovations, G, is
            the response of the filter's error to it; per axis the estimate is c = b / J with
            b = sum G' S^-1 nu and J = sum G' S^-1 G, and the statistic c^2 / (2 (1/J + s^2)), where
            s is what another day of the same aircraft may differ by in the manoeuvre since then.
    spread  CUSUM of the log likelihood ratio of innovations of twice the covariance [Page 1954],
            for changes that are no constant load: a delay, a dead band, noise.

Each threshold is the level that the test reaches on the baseline flight, extrapolated to the wanted
mean time between false alarms: Gumbel distribution of the maxima of short blocks [Coles, An
Introduction to Statistical Modeling of Extreme Values, ch. 3].

After the alarm the flight since the onset is collected, and `name_effect` names what is missing.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.flight_table import (
    REQUIRED_COLUMNS,
    FlightTable,
    slice_time,
)
from falconwing_kit.gap.baseline import (
    COEFFICIENT_DRIFT,
    TIMING_DRIFT_S,
    NominalModel,
    Progress,
    available_generic_effects,
    calibrate_nominal_model,
)
from falconwing_kit.gap.innovations import (
    AXES,
    ROW_MOTION_COLUMNS,
    FilterNoise,
    FilterStep,
    InnovationFilter,
    Row,
    identify_filter_noise,
    table_rows,
)
from falconwing_kit.gap.name import Naming, name_effect
from falconwing_kit.gap.noise import find_pose_noise, whiten
from falconwing_kit.sysid.fit import Prior, fit
from falconwing_kit.sysid.identify import identify
from falconwing_kit.sysid.model_file import ModelFile
from falconwing_kit.sysid.uncertainty import ordinary_size

MEAN_TIME_BETWEEN_FALSE_ALARMS_S = 3600.0
ONSET_STEP_S = 0.25  # between the onsets that the step test tries
ONSET_WINDOW_S = 6.0  # how far back it tries them
SPREAD_FACTOR = 2.0  # of the innovations' covariance, in the spread test's alternative
SETTLE_S = 2.0  # after a start of the filter, before its innovations count
BLOCK_S = 3.0  # of the maxima that the thresholds are extrapolated from
# Factor on the levels for another day of the same aircraft, whose coefficients differ. Chosen on 20
# simulated stretches of other days (bench_watch, seeds 70, 71 and 170, half an hour): the largest
# values were 0.4 to 1.0 of the level in 19 and 1.85 in one, where L_da and L_p had moved by 2 % in
# opposite directions. The statistic grows with the square of time, so the delay with about the root
# of the factor; at 1.0 it was 0.3 to 1.1 s for seven of eight effects.
DAY_MARGIN = 2.0
MIN_BLOCKS = 8  # for two parameters of a distribution
NAME_AFTER_S = (10.0, 20.0, 40.0)  # after the onset: when a name is tried
MIN_NAMED_S = 8.0  # of flight after the onset, as in close.name_with_onset

Test = Literal["step", "spread"]
EventKind = Literal["alarm", "gap", "wait", "name", "end"]


# ---- Sequential tests


def cusum(previous: float, score: float) -> float:
    """One step of Page's test: max(0, g + score); the score has a negative mean without change.

    [Page 1954; Basseville & Nikiforov, eq. 2.2.9]
    """
    return max(0.0, previous + score)


def cusum_run_length(drift: float, threshold: float) -> float:
    """Mean number of samples to a false alarm of a CUSUM of white Gaussian noise.

    Siegmund's approximation for scores of unit variance and mean -drift:
    (exp(2 d b) - 2 d b - 1) / (2 d^2) with b = threshold + 1.166
    [Siegmund, Sequential Analysis, 1985; Basseville & Nikiforov, eq. 5.2.65].

    Args:
        drift: d > 0, in standard deviations of the score.
        threshold: in the same unit.
    """
    reach = 2.0 * require_range("drift", drift, low=1e-3) * (threshold + 1.166)
    return float((np.exp(reach) - reach - 1.0) / (2.0 * drift**2))


def spread_score(chi2: float, count: int) -> float:
    """Log likelihood ratio of a covariance k S against S: chi2 (1 - 1/k) / 2 - m ln(k) / 2.

    Args:
        chi2: nu' S^-1 nu.
        count: m, components of nu.
    """
    return 0.5 * (chi2 * (1.0 - 1.0 / SPREAD_FACTOR) - count * np.log(SPREAD_FACTOR))


@dataclass(frozen=True)
class TestValues:
    """The statistics of both tests at one row."""

    t: float
    step: float  # of the axis and onset where it is largest
    axis: int  # of AXES
    onset: float  # of that axis [s]
    size: float  # estimated load there [m/s^2, rad/s^2]
    spread: float
    spread_onset: float  # when the spread test last was at zero [s]


class ChangeTests:
    """Both sequential tests; `update` takes the filter's steps one by one."""

    def __init__(self, n_states: int) -> None:
        """Start; n_states of the model."""
        self._n = n_states
        self._spread = 0.0
        self._clear(-np.inf)

    def update(self, step: FilterStep) -> TestValues | None:
        """Values after this step; None until the filter has settled after its start."""
        if step.dt == 0.0:
            self._clear(step.t)
            return None
        if step.t - self._started < SETTLE_S:
            return None
        if step.t - self._last_onset >= ONSET_STEP_S - 1e-9:
            self._add_onset(step)
        self._respond(step)
        chi2 = step.chi2 if len(step.rows) else 0.0
        self._spread = cusum(self._spread, spread_score(chi2, len(step.rows)))
        if self._spread == 0.0:
            self._spread_onset = step.t
        drift_variance = self._drift_squares / np.maximum(self._seconds, 1e-9)[:, None]
        variance = 1.0 / np.maximum(self._J, 1e-300) + drift_variance
        size = np.where(self._J > 0.0, self._b / np.maximum(self._J, 1e-300), 0.0)
        statistic = 0.5 * size**2 / variance
        at = np.unravel_index(int(np.argmax(statistic)), statistic.shape)
        return TestValues(
            step.t, float(statistic[at]), int(at[1]), self._onsets[at[0]], float(size[at]),
            self._spread, self._spread_onset,
        )  # fmt: skip

    def _clear(self, t: float) -> None:
        self._started, self._last_onset = t, -np.inf
        self._onsets: list[float] = []
        self._error: Array = np.zeros((0, 0, 6))  # (onsets, N, 6) response of the filter's error
        self._J, self._b = np.zeros((0, 6)), np.zeros((0, 6))
        self._drift_squares, self._seconds = np.zeros((0, 6)), np.zeros(0)  # integral of s^2
        self._spread, self._spread_onset = 0.0, t

    def _add_onset(self, step: FilterStep) -> None:
        """One more onset to try, a step before this row; those out of the window are dropped."""
        kept = sum(t <= step.t - ONSET_WINDOW_S for t in self._onsets)
        size = len(step.predicted)
        error = self._error if len(self._error) else np.zeros((0, size, 6))
        self._error = np.concatenate([error[kept:], np.zeros((1, size, 6))])
        self._J = np.concatenate([self._J[kept:], np.zeros((1, 6))])
        self._b = np.concatenate([self._b[kept:], np.zeros((1, 6))])
        self._drift_squares = np.concatenate([self._drift_squares[kept:], np.zeros((1, 6))])
        self._seconds = np.concatenate([self._seconds[kept:], np.zeros(1)])
        self._onsets = [*self._onsets[kept:], step.t - step.dt]
        self._last_onset = step.t

    def _respond(self, step: FilterStep) -> None:
        """Error response E <- Phi E + Gamma, signature G = H E, then E <- (I - L H) E."""
        n = self._n
        self._drift_squares = self._drift_squares + step.dt * step.drift**2
        self._seconds = self._seconds + step.dt
        error = step.transition @ self._error
        error[:, :n] += step.transition[:n, n : n + 6]
        if len(step.rows):
            G = step.H @ error
            weighted = np.linalg.solve(
                step.S,
                np.concatenate(
                    [step.innovation[:, None], G.transpose(1, 0, 2).reshape(len(step.rows), -1)],
                    axis=1,
                ),
            )
            self._b = self._b + np.einsum("omi,m->oi", G, weighted[:, 0])
            SG = weighted[:, 1:].reshape(len(step.rows), -1, 6)
            self._J = self._J + np.einsum("omi,moi->oi", G, SG)
            error = error - step.gain @ G
        self._error = error


# ---- Thresholds from the baseline flight


@dataclass(frozen=True)
class Monitor:
    """All that watching needs: a nominal model, its filter's noise, and the two thresholds."""

    base: NominalModel
    noise: FilterNoise
    step_threshold: float
    spread_threshold: float
    mean_time_between_false_alarms: float  # [s]


def build_monitor(
    base: NominalModel,
    tables: Sequence[FlightTable],
    mean_time_between_false_alarms: float = MEAN_TIME_BETWEEN_FALSE_ALARMS_S,
    progress: Progress = lambda stage: None,
) -> Monitor:
    """Noise of the filter and thresholds of the tests, from the baseline flights alone.

    Args:
        base: the nominal model identified on them.
        tables: the baseline flights.
        mean_time_between_false_alarms: wanted, of both tests together [s].
        progress: called with the name of each stage.

    Raises:
        InputError: too little baseline flight for a threshold.
    """
    require_range(
        "mean time between false alarms", mean_time_between_false_alarms, low=10.0, high=1e7
    )
    progress("process noise")
    noise = identify_filter_noise(base, tables)
    progress("thresholds")
    values = [v for table in tables for v in run_tests(base, noise, table_rows(table))]
    t = np.array([v.t for v in values])
    half = 2.0 * mean_time_between_false_alarms  # each test may have half of the false alarms
    step, spread = (
        DAY_MARGIN * return_level(t, np.array(statistic), half)
        for statistic in ([v.step for v in values], [v.spread for v in values])
    )
    return Monitor(base, noise, step, spread, mean_time_between_false_alarms)


def another_day_prior(model: Model, names: Sequence[str], covariance: Array) -> Prior:
    """Prior for another day: a fit's covariance (F, F) and a percent of drift per coefficient."""
    kinds = {p.name: p for p in model.parameters}
    drift = [
        TIMING_DRIFT_S if name in ("delay", "lag")
        else COEFFICIENT_DRIFT * ordinary_size(kinds[name], model.values[name])
        for name in names
    ]  # fmt: skip
    covariance = covariance + np.diag(np.square(drift))
    sigma = np.sqrt(np.diag(covariance))
    spread = dict(zip(names, sigma.tolist(), strict=True))
    return Prior(dict(model.values), spread, covariance / np.outer(sigma, sigma))


def nominal_model_from_file(file: ModelFile, table: FlightTable) -> NominalModel:
    """A nominal model from a model file, with noise and false-alarm level from a short flight.

    Args:
        file: the aircraft, with the covariance of its parameters; with a percent of drift from day
            to day they are the prior here.
        table: half a minute or more with nothing changed.

    Raises:
        InputError: the flight cannot be used.
    """
    model = file.model
    prior = another_day_prior(model, file.names, file.covariance)
    found = identify([table], model=model, prior=prior)
    noise = find_pose_noise(found.result, found.fitted_windows)
    windows = whiten(found.fitted_windows, noise)
    result = fit(found.model, windows, found.result.initial_states, prior=prior)
    tried = [*CATALOGUE, *available_generic_effects(result.model)]
    base = calibrate_nominal_model(found, noise, result, windows, tried)
    prior = replace(prior, mean=dict(result.model.values))
    return replace(base, prior=prior, prior_inflation=1.0)


def run_tests(base: NominalModel, noise: FilterNoise, rows: Iterable[Row]) -> Iterator[TestValues]:
    """Both tests over the rows of one flight, without thresholds."""
    model = base.result.model
    kalman, tests = (
        InnovationFilter(model, noise, base.parameter_prior),
        ChangeTests(model.n_states),
    )
    for row in rows:
        step = kalman.update(row)
        values = tests.update(step) if step is not None else None
        if values is not None:
            yield values


def return_level(t: Array, values: Array, period: float) -> float:
    """Level that a statistic exceeds once in a period, by a Gumbel fit to its block maxima.

    z = mu + beta ln(period / block); beta = sqrt(6) s / pi and mu = mean - 0.5772 beta of the block
    maxima (method of moments). Log likelihood ratios of white innovations have beta = 1; a smaller
    estimate is chance, and a baseline flight's own maximum is never above the level.

    Args:
        t: (N,) [s].
        values: (N,) of the statistic, a log likelihood ratio.
        period: [s].

    Raises:
        InputError: fewer than MIN_BLOCKS blocks of BLOCK_S.
    """
    block = np.floor(t / BLOCK_S).astype(int) if len(t) else np.zeros(0, int)
    maxima = np.array([values[block == number].max() for number in np.unique(block)])
    if len(maxima) < MIN_BLOCKS:
        raise InputError(
            f"baseline flight: expected at least {MIN_BLOCKS * BLOCK_S + SETTLE_S:.0f} s with poses"
            f" for a threshold, got {len(maxima) * BLOCK_S:.0f} s; use a longer one"
        )
    beta = max(float(np.std(maxima, ddof=1)) * np.sqrt(6.0) / np.pi, 1.0)
    mu = float(np.mean(maxima)) - 0.5772 * beta
    return max(mu + beta * float(np.log(max(period / BLOCK_S, 1.0))), float(maxima.max()))


# ---- Watching a flight


@dataclass(frozen=True)
class WatchEvent:
    """What happened, and when."""

    t: float  # on the flight's clock [s]
    kind: EventKind
    text: str
    details: dict[str, Any] = field(default_factory=dict)


class Watch:
    """One flight watched; `update` takes its rows one by one, `finish` ends it."""

    def __init__(
        self,
        monitor: Monitor,
        catalogue: Sequence[Effect] = CATALOGUE,
        name: Callable[..., Naming] = name_effect,
    ) -> None:
        """Start before the first row.

        Args:
            monitor: from `build_monitor`.
            catalogue: the effects that are tried after an alarm.
            name: (base, table, catalogue) -> the verdict.
        """
        model = monitor.base.result.model
        self._monitor, self._catalogue, self._name = monitor, tuple(catalogue), name
        self._filter = InnovationFilter(model, monitor.noise, monitor.base.parameter_prior)
        self._tests = ChangeTests(model.n_states)
        self._rows: list[Row] = []
        self._tries = list(NAME_AFTER_S)
        self._blind = False
        self.skipped = 0  # rows whose time does not increase
        self.alarm: WatchEvent | None = None
        self.naming: Naming | None = None  # the last verdict
        self.named = False

    @property
    def rows(self) -> int:
        """Rows taken."""
        return len(self._rows)

    @property
    def last_time(self) -> float:
        """Time of the last row [s]."""
        return self._rows[-1].t if self._rows else 0.0

    @property
    def seconds(self) -> float:
        """Time from the first row to the last [s]."""
        return self._rows[-1].t - self._rows[0].t if self._rows else 0.0

    def update(self, row: Row) -> tuple[WatchEvent, ...]:
        """Take one row; events of it, mostly none. Rows whose time stands still are skipped."""
        last = self._rows[-1].t if self._rows else -np.inf
        if not np.isfinite(row.t) or row.t <= last:
            self.skipped += 1
            return ()
        row = self._with_commands(row)
        self._rows.append(row)
        if self.alarm is not None:
            return self._try_name(row.t)
        events = []
        step = self._filter.update(row)
        if step is not None and step.dt == 0.0 and self._blind:
            text = "poses are back; the filter has started again"
            events.append(WatchEvent(row.t, "gap", text))
        self._blind = step.dt > 0.0 or self._blind if step is not None else self._blind
        values = self._tests.update(step) if step is not None else None
        if values is not None and (alarm := self._alarm(values)) is not None:
            self.alarm = alarm
            events.append(alarm)
        return tuple(events)

    def finish(self) -> tuple[WatchEvent, ...]:
        """The end of the stream: a last try at a name, and the summary."""
        t = self._rows[-1].t if self._rows else 0.0
        events: list[WatchEvent] = []
        if self.alarm is not None and not self.named:
            after = t - self.alarm.details["onset"]
            if after < MIN_NAMED_S:
                text = (
                    f"not enough flight for a name: {after:.1f} s since the onset, "
                    f"{MIN_NAMED_S:.0f} s needed"
                )
                events.append(WatchEvent(t, "wait", text, {"seconds": after}))
            elif self._tries and after > self._last_try() + 2.0:
                events += self._name_now(t, last=True)
        return tuple(events)

    def _last_try(self) -> float:
        done = NAME_AFTER_S[: len(NAME_AFTER_S) - len(self._tries)]
        return done[-1] if done else 0.0

    def _with_commands(self, row: Row) -> Row:
        """Commands that are not numbers are held from the row before, zero at the start."""
        known = np.isfinite(row.commands)
        if known.all():
            return row
        held = self._rows[-1].commands if self._rows else np.zeros(4)
        return row._replace(commands=np.where(known, row.commands, held))

    def _alarm(self, values: TestValues) -> WatchEvent | None:
        step = values.step / self._monitor.step_threshold
        spread = values.spread / self._monitor.spread_threshold
        if max(step, spread) <= 1.0:
            return None
        test: Test = "step" if step >= spread else "spread"
        onset = values.onset if test == "step" else values.spread_onset
        unit = "m/s^2" if values.axis < 3 else "rad/s^2"
        if self._monitor.base.result.model.n_states == 9 and values.axis >= 3:
            unit = "rad/s"
        if test == "step":
            what = f"{AXES[values.axis]} {values.size:+.2g} {unit}"
            statistic, threshold = values.step, self._monitor.step_threshold
        else:
            what = "innovations larger than in the baseline flight"
            statistic, threshold = values.spread, self._monitor.spread_threshold
        text = (
            f"no longer as modelled since about {onset:.1f} s: {what} "
            f"(statistic {statistic:.0f}, threshold {threshold:.0f})"
        )
        return WatchEvent(
            values.t, "alarm", text,
            {
                "onset": onset, "test": test, "statistic": statistic, "threshold": threshold,
                "axis": AXES[values.axis], "size": values.size, "unit": unit,
            },
        )  # fmt: skip

    def _try_name(self, t: float) -> tuple[WatchEvent, ...]:
        assert self.alarm is not None
        if self.named or not self._tries or t - self.alarm.details["onset"] < self._tries[0]:
            return ()
        self._tries.pop(0)
        return tuple(self._name_now(t, last=not self._tries))

    def _name_now(self, t: float, last: bool) -> list[WatchEvent]:
        """Name the flight since the onset, and say so; or when it will be tried again."""
        assert self.alarm is not None
        onset = self.alarm.details["onset"]
        after = t - onset
        try:
            flight = slice_time(self.flight, onset, np.inf)
            naming = self._name(self._monitor.base, flight, self._catalogue)
        except InputError as error:
            return [WatchEvent(t, "wait", f"no name yet: {error}", {"seconds": after})]
        self.naming = naming
        found = [c.effect.name for c in naming.chosen]
        details = {
            "seconds": after, "verdict": naming.verdict, "effects": found,
            "ranking": [
                {"effect": c.effect.name, "gain": c.delta_bic} for c in naming.ranking[:4]
            ],
        }  # fmt: skip
        if naming.verdict == "named" or (naming.verdict == "outside" and last):
            self.named = True
            what = " and ".join(found) if found else "no effect of the catalogue explains it"
            return [WatchEvent(t, "name", f"{what} (from {after:.0f} s since the onset)", details)]
        so_far = f"{naming.verdict}: {', '.join(found)}" if found else naming.verdict
        again = (
            "not enough flight yet" if last
            else f"not enough flight yet; tried again {self._tries[0]:.0f} s after the onset"
        )  # fmt: skip
        return [
            WatchEvent(t, "wait", f"{so_far} from {after:.0f} s since the onset; {again}", details)
        ]

    @property
    def flight(self) -> FlightTable:
        """The rows so far as a flight table."""
        return rows_table(self._rows, "stream")


def rows_table(rows: Sequence[Row], name: str) -> FlightTable:
    """Rows as a flight table; a row with an incomplete pose becomes one without a pose."""
    pose = np.stack([row.pose for row in rows])
    pose[~np.isfinite(pose).all(axis=1)] = np.nan
    motion = np.stack([row.motion for row in rows])
    measured = np.flatnonzero(np.isfinite(motion).any(axis=0))
    extra = {ROW_MOTION_COLUMNS[column]: motion[:, column] for column in measured}
    commands = np.stack([row.commands for row in rows])
    return FlightTable(
        name, np.array([row.t for row in rows]), pose[:, :3], pose[:, 3:], commands, extra
    )


def watch_rows(watch: Watch, rows: Iterable[Row]) -> Iterator[WatchEvent]:
    """All events of a stream, as they happen."""
    for row in rows:
        yield from watch.update(row)
    yield from watch.finish()


# ---- Reading a stream

CHECKED_ROWS = 20  # rows from which wrong units are recognised
MAX_BAD_LINES = 20  # in a row: this is no flight table


def stream_rows(
    lines: Iterable[bytes], warn: Callable[[str], None] = lambda text: None
) -> Iterator[Row]:
    """Rows of a flight table from CSV lines as they arrive.

    Lines that are no row (damaged, or cut off by the end of the stream) are skipped with a warning.

    Args:
        lines: with their line ends; the first is the header.
        warn: called with one sentence.

    Raises:
        InputError: the header lacks a column, the units are wrong, or many lines in a row are no
            rows.
    """
    lines = iter(lines)
    columns = _header(next(lines, b""))
    places = {name: place for place, name in enumerate(columns)}
    wanted = [places.get(name) for name in (*REQUIRED_COLUMNS, *ROW_MOTION_COLUMNS)]
    first: list[Array] = []
    bad = 0
    for number, line in enumerate(lines, start=2):
        if not line.strip():
            continue
        values = _numbers(line, columns, wanted)
        if values is None or not line.endswith(b"\n"):
            bad += 1
            warn(f"line {number} is no row of {len(columns)} numbers and was skipped")
            if bad > MAX_BAD_LINES:
                raise InputError(
                    f"stream: expected rows of a flight table, got {bad} lines in a row that are "
                    "none; send CSV with the header t,px,py,..."
                )
            continue
        bad = 0
        if len(first) < CHECKED_ROWS:
            first.append(values)
            _check_units(np.stack(first))
        yield Row(
            float(values[0]),
            values[1:7],
            np.clip(values[7:11], [0.0, -1.0, -1.0, -1.0], 1.0),
            values[11:],
        )


def _header(line: bytes) -> list[str]:
    text = line.decode("utf-8-sig", errors="replace").strip()
    columns = [column.strip().strip('"') for column in text.split(",")]
    missing = [name for name in REQUIRED_COLUMNS if name not in columns]
    if missing:
        got = ", ".join(c[:40] for c in columns[:12]) or "an empty line"
        raise InputError(
            f"stream: expected a header with the columns {', '.join(missing)}, got {got}; "
            "send the flight table's header first"
        )
    return columns


def _numbers(line: bytes, columns: list[str], wanted: list[int | None]) -> Array | None:
    """The wanted cells as numbers, nan where empty or no column; None for a damaged line."""
    cells = line.decode("utf-8", errors="replace").strip("\r\n").split(",")
    if len(cells) != len(columns):
        return None
    try:
        values = np.array(
            [np.nan if p is None or not cells[p].strip() else float(cells[p]) for p in wanted]
        )
    except ValueError:
        return None
    return np.where(np.isinf(values), np.nan, values)


def _check_units(rows: Array) -> None:
    """Refuse milliseconds, degrees and pulse widths, as soon as the first rows show them."""
    step = float(np.median(np.diff(rows[:, 0]))) if len(rows) == CHECKED_ROWS else 0.0
    if step > 2.0:
        raise InputError(
            f"stream: expected t in seconds, got rows {step:g} apart; divide the column t by 1000"
        )
    if np.nanmax(np.abs(rows[:, 4:6]), initial=0.0) > 2.0 * np.pi:
        raise InputError(
            "stream: expected roll and pitch in radians, got values beyond 2 pi, which look like "
            "degrees; convert them"
        )
    excess = np.nanmax(np.abs(rows[:, 7:11]), initial=0.0)
    if excess > 1.1:
        raise InputError(
            f"stream: expected commands in -1..1, got {excess:g}, which looks like microseconds or "
            "percent; convert them"
        )
