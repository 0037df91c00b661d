"""Identification: flight tables -> a fitted model, its intervals and a held-out score."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from falconwing_kit.aircraft.model import FORMS, Form, Model
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_initial_states, sqrt_huber_weight
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.prepare import PreparedFlight, PreparedTable, prepare
from falconwing_kit.sysid.score import PredictionScore, score, select_windows, split_blocks
from falconwing_kit.sysid.shooting import Windows, cut_windows, pose_residuals, residuals
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty

WINDOW_S = 2.0
COARSE_WINDOWS = 60  # short windows of the coarse start; more would only cost time
CORRELATED_SHARE = 0.5  # largest share of the noise variance that is slow; the rest is misfit
GOOD_START_CHI2 = 1.5  # chi2 per component of short windows; above it another start is tried
MIN_IMPROVEMENT = 10.0  # chi2 by which a second local minimum must be better to be taken
MAX_REDUCED_CHI2 = 4.0  # chi2 per degree of freedom that no pose noise explains
# Channel, column of the commands, its control derivative, what a positive command does.
CONTROL_CHANNELS = (
    ("aileron", 1, "L_da", "right wing down"),
    ("elevator", 2, "M_de", "nose up"),
    ("rudder", 3, "N_dr", "nose right"),
)
MIN_EFFECTIVENESS = 0.1  # of a typical derivative; the sign of a smaller one means nothing
MISFIT_RATIO = 1.05  # a log with channels reversed is preferred up to this ratio of the misfits

Progress = Callable[[str, float], None]  # (stage, chi2 there)


@dataclass(frozen=True)
class Identification:
    """Result of `identify`: fitted model, confidence intervals, held-out score."""

    model: Model  # fitted to all windows
    train_model: Model  # fitted without the held-out windows
    uncertainty: Uncertainty
    train: PredictionScore
    held_out: PredictionScore | None  # None where the flight is too short to hold anything out
    sigma: Array  # (6,) noise used, order of CHANNELS [m, rad]
    sigma_white: Array  # (6,) its white part, from differences of poses
    prepared: tuple[PreparedTable, ...]
    windows: Windows  # all windows, weighted by the noise alone
    fitted_windows: Windows  # those of the final fit, with robust weights
    held_out_index: np.ndarray  # indices of the windows held out for scoring
    result: FitResult  # the final fit, to all windows
    names: tuple[str, ...]  # the flights
    warnings: tuple[str, ...]
    seconds: float
    reversed_channels: tuple[str, ...] = ()  # channels whose sign in the log is reversed

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter, in its unit."""
        return self.uncertainty.interval(name, self.model.values[name])


@np.errstate(all="ignore")  # a diverging prediction overflows; its cost is infinite
def identify(
    tables: Sequence[FlightTable],
    form: Form = "rates",
    *,
    model: Model | None = None,
    sigma: Array | None = None,
    prior: Prior | None = None,
    window_s: float = WINDOW_S,
    progress: Progress | None = None,
) -> Identification:
    """Fit f_K to flights of one aircraft by multiple shooting, and score it on held-out time.

    1. Coarse start: short windows from several starting values.
    2. Noise: fit the training windows, estimate the pose noise and robust weights, fit again.
    3. Restart inside the bounds, where the fit ended on some.
    4. Hold out: score on about a third of the time, in blocks of 10 s, that was not fitted.
    5. Final: fit the returned parameters to all windows.

    Args:
        tables: flights of the same aircraft at the same rate.
        form: "rates" or "paper"; unused where a model is given.
        model: terms, bounds and starting values; None for the form's own.
        sigma: (6,) noise of px, py, pz, roll, pitch, yaw [m, rad]; None for the tables' or an
            estimate.
        prior: Gaussian prior on the parameters.
        window_s: length of a shooting window [s].
        progress: called with the name of a stage and the chi2 there.

    Raises:
        InputError: no flight, too short a flight, or no motion in it.
    """
    began = time.perf_counter()
    report = progress or (lambda stage, chi2: None)
    if not tables:
        raise InputError("flights: expected at least one flight table, got none")
    prepared = tuple(prepare(table, sigma) for table in tables)
    flights = tuple(flight for p in prepared for flight in p.flights)
    _require_motion(flights)

    nominal = model or FORMS[form]()
    start = _coarse_start(nominal, flights, prior, report)

    windows = cut_windows(flights, start, window_s)
    fit_index, score_index = split_blocks(windows)
    train = select_windows(windows, fit_index)
    initial_states, _ = fit_initial_states(
        start, train, train.initial_guess[:, : start.n_states], iterations=2
    )
    white = np.median([p.sigma for p in prepared], axis=0)
    fit_with_noise = partial(
        _fit_with_noise,
        train,
        white,
        fixed=sigma is not None or all("sigma_position" in t.extra for t in tables),
        prior=prior,
        report=report,
    )
    result, fitted, noise = fit_with_noise(start, initial_states)
    restarted = _restart_inside_bounds(result, fitted, prior)
    if restarted is not result:
        result, fitted, noise = fit_with_noise(restarted.model, restarted.initial_states)

    windows = windows.scale_weights(white / noise)
    train_score, held_out = _score_held_out(result, windows, fit_index, score_index)
    report("held out", held_out.chi2 if held_out else float("nan"))

    final = result
    if held_out is not None:
        states = np.empty((len(windows), start.n_states))
        states[fit_index] = result.initial_states
        states[score_index] = held_out.initial_states
        final, fitted = _fit_all(result.model, windows, states, prior)
        report("all windows", final.cost / max(windows.count, 1))

    confidence = uncertainty(final, fitted, prior)
    reversed_names = _find_reversed_channels(nominal, final, confidence, windows, prior, report)
    warnings = [w for p in prepared for w in p.warnings] + _sign_warnings(reversed_names)
    warnings += _warnings(final, confidence, train_score, held_out)
    return Identification(
        model=final.model,
        train_model=result.model,
        uncertainty=confidence,
        train=train_score,
        held_out=held_out,
        sigma=noise,
        sigma_white=white,
        prepared=prepared,
        windows=windows,
        fitted_windows=fitted,
        held_out_index=score_index,
        result=final,
        names=tuple(t.name for t in tables),
        warnings=tuple(warnings),
        seconds=time.perf_counter() - began,
        reversed_channels=reversed_names,
    )


def _require_motion(flights: Sequence[PreparedFlight]) -> None:
    """Raise InputError for commands that never change and for an aircraft at rest."""
    moved = np.sqrt(sum(np.var(f.commands, axis=0) for f in flights) / len(flights))
    if np.all(moved < 1e-6):
        raise InputError(
            "commands: expected sticks that move, got the same values in every row; "
            "nothing can be identified"
        )
    speed = np.median(
        np.concatenate([np.linalg.norm(f.state_estimate[:, 6:9], axis=1) for f in flights])
    )
    if speed < 0.5:
        raise InputError(
            f"flight: expected an aircraft that flies, got a median speed of {speed:.2f} m/s"
        )


def _coarse_start(
    model: Model, flights: Sequence[PreparedFlight], prior: Prior | None, report: Progress
) -> Model:
    """Best model of short-window fits started from the model, the one-step fit and a slower servo.

    Short windows have a wide basin of attraction: a bad model cannot diverge far within them.
    """
    # About five poses per window, at least 1 s, evenly thinned out.
    poses = sum(int(np.isfinite(f.pose[:, 0]).sum()) for f in flights)
    pose_interval = sum(f.duration for f in flights) / max(poses, 1)
    windows = cut_windows(flights, model, max(1.0, 5.0 * pose_interval))
    if len(windows) > COARSE_WINDOWS:
        windows = select_windows(
            windows, np.linspace(0, len(windows) - 1, COARSE_WINDOWS).astype(int)
        )
    # The one-step fit is biased but close. A servo lag that starts too small trades against roll
    # damping in a local minimum, hence the slower servo.
    slow = {"lag": 0.06} if model.parameters[model.names.index("lag")].high > 0.06 else {}
    candidates = [
        model,
        fit_one_step(model, flights, smoothed=True, most=1500),
        model.with_values(slow),
    ]
    # Rank by the cost with fitted initial states alone; fit parameters in that order.
    initial_guess = windows.initial_guess[:, : model.n_states]
    ranked = sorted(
        (
            (start, *fit_initial_states(start, windows, initial_guess, iterations=3))
            for start in candidates
        ),
        key=lambda fitted: _clipped_cost(fitted[2]),  # (model, initial states, residual)
    )
    best, best_cost = model, np.inf
    for start, initial_states, residual in ranked:
        coarse = windows.scale_weights(_robust_factors(residual, windows, far=30.0))
        result = fit(start, coarse, initial_states, prior=prior, iterations=15, tolerance=1.0)
        cost = _clipped_cost(result.residual)
        report("short windows", cost / windows.count)
        if cost < best_cost:
            best, best_cost = result.model, cost
        if best_cost < GOOD_START_CHI2 * windows.count and not (slow and best.values["lag"] <= 0.0):
            break
    return best


def _fit_with_noise(
    windows: Windows,
    white: Array,
    model: Model,
    initial_states: Array,
    *,
    fixed: bool,
    prior: Prior | None,
    report: Progress,
) -> tuple[FitResult, Windows, Array]:
    """Iteratively reweighted fit: parameters, then noise per channel and robust weights, twice.

    Args:
        windows: weighted by the white noise.
        white: (6,) white part of the pose noise [m, rad].
        model: where to start.
        initial_states: (W, n_states) where to start.
        fixed: the noise is known and stays `white`.
        prior: Gaussian prior on the parameters.
        report: called after each fit.

    Returns:
        The fit, its reweighted windows, and the noise (6,).
    """
    noise, weighted = white, windows
    result = fit(model, windows, initial_states, prior=prior, tolerance=1.0)
    report("full windows", result.cost / windows.count)
    for _ in range(2):
        before = noise
        if not fixed:
            noise = _estimate_noise(result, windows, white)
        previous, scaled = weighted, windows.scale_weights(white / noise)
        weighted = scaled.scale_weights(
            _robust_factors(residuals(result.model, scaled, result.initial_states), scaled)
        )
        # The linearisation of the last fit is reused: its rows times new weight over old weight.
        factor = np.divide(
            weighted.weight,
            previous.weight,
            out=np.ones_like(previous.weight),
            where=previous.weight > 0,
        )
        linear = result.reweight(factor)
        result = fit(
            result.model, weighted, result.initial_states, prior=prior, iterations=10, linear=linear
        )
        report("weights updated", result.cost / windows.count)
        if np.allclose(noise, before, rtol=0.03):
            break
    return result, weighted, noise


def _estimate_noise(result: FitResult, windows: Windows, white: Array) -> Array:
    """Noise (6,) of each channel from the residuals, between the white part and its upper limit."""
    residual = pose_residuals(residuals(result.model, windows, result.initial_states), windows)
    # Degrees of freedom per residual: fitted states and parameters shrink the residuals.
    share = 1.0 - (len(windows) * result.model.n_states + len(result.free)) / windows.count
    measured = windows.weight > 0
    # Robust variance in units of the white one: sigma = 1.4826 median |r| for a Gaussian.
    sigma = np.array(
        [1.4826 * np.median(np.abs(residual[..., c][measured[..., c]])) for c in range(6)]
    )
    ratio = np.clip(sigma**2 / share, 1.0, 1.0 / (1.0 - CORRELATED_SHARE))
    return np.asarray(white * np.sqrt(ratio))


def _robust_factors(residual: Array, windows: Windows, far: float | None = None) -> Array:
    """Huber factors (W, L, 6) of the weights; with `far`, only for residuals beyond it."""
    factor = sqrt_huber_weight(residual, windows)
    if far is None:
        return factor
    return np.asarray(np.where(np.abs(pose_residuals(residual, windows)) < far, 1.0, factor))


def _clipped_cost(residual: Array) -> float:
    """Sum of squares with each residual limited to five sigmas."""
    return float(np.sum(np.minimum(np.nan_to_num(residual, posinf=5.0) ** 2, 25.0)))


def _restart_inside_bounds(result: FitResult, windows: Windows, prior: Prior | None) -> FitResult:
    """Refit with the parameters on a bound reset to typical values; the better of both fits."""
    free = [result.model.parameters[i] for i in result.free]
    reset_values = {
        p.name: p.start for p in free if not p.low < result.model.values[p.name] < p.high
    }
    if not reset_values:
        return result
    model = result.model.with_values(reset_values)
    initial_states, _ = fit_initial_states(model, windows, result.initial_states, iterations=3)
    again = fit(model, windows, initial_states, prior=prior, tolerance=1.0)
    return again if again.cost < result.cost - MIN_IMPROVEMENT else result


def _score_held_out(
    result: FitResult, windows: Windows, fit_index: np.ndarray, score_index: np.ndarray
) -> tuple[PredictionScore, PredictionScore | None]:
    """Scores of the trained model on the fitted and on the held-out windows (None: no such)."""
    train = score(result.model, select_windows(windows, fit_index), result.initial_states)
    if not len(score_index):
        return train, None
    return train, score(result.model, select_windows(windows, score_index))


def _fit_all(
    model: Model, windows: Windows, initial_states: Array, prior: Prior | None
) -> tuple[FitResult, Windows]:
    """Final fit to all windows with robust weights, and these windows."""
    weighted = windows.scale_weights(
        _robust_factors(residuals(model, windows, initial_states), windows)
    )
    return fit(model, weighted, initial_states, prior=prior, iterations=6), weighted


def _find_reversed_channels(
    nominal: Model,
    found: FitResult,
    confidence: Uncertainty,
    windows: Windows,
    prior: Prior | None,
    report: Progress,
) -> tuple[str, ...]:
    """Channels whose sign in the log is reversed.

    A channel that was moved is suspected where its control derivative ends below a tenth of a
    typical one. Only then the flights are fitted once more, from the nominal model, with the
    suspects' commands negated. A suspect is confirmed where this fit is as good and the 95 %
    interval of the derivative lies above that tenth.
    """
    least = {p.name: MIN_EFFECTIVENESS * abs(p.start) for p in nominal.parameters}
    moved = np.max([np.ptp(flight.commands, axis=0) for flight in windows.flights], axis=0) > 0.0
    suspects = [
        (name, column, derivative)
        for name, column, derivative, _ in CONTROL_CHANNELS
        if moved[column]
        and derivative in confidence.names
        and found.model.values[derivative] < least[derivative]
    ]
    if not suspects:
        return ()
    signs = np.ones(4)
    signs[[column for _, column, _ in suspects]] = -1.0
    flights = tuple(replace(flight, commands=flight.commands * signs) for flight in windows.flights)
    reversed_windows = replace(windows, flights=flights)
    model = _coarse_start(nominal, flights, prior, report)
    initial_states, _ = fit_initial_states(
        model, reversed_windows, reversed_windows.initial_guess[:, : model.n_states], iterations=2
    )
    other = fit(model, reversed_windows, initial_states, prior=prior, tolerance=1.0)
    report("channels reversed", other.cost / windows.count)
    misfit = _clipped_cost(residuals(found.model, windows, found.initial_states))
    if _clipped_cost(other.residual) > MISFIT_RATIO * misfit:
        return ()
    intervals = uncertainty(other, reversed_windows, prior)
    lowest = {d: intervals.interval(d, other.model.values[d])[0] for _, _, d in suspects}
    return tuple(name for name, _, d in suspects if lowest[d] > least[d])


def _sign_warnings(reversed_names: tuple[str, ...]) -> list[str]:
    return [
        f"{name} seems reversed: expected positive {name} = {does} (the kit's conventions), "
        "the fit gives the opposite sign; check the sign in your log"
        for name, _, _, does in CONTROL_CHANNELS
        if name in reversed_names
    ]


def _warnings(
    result: FitResult,
    confidence: Uncertainty,
    train: PredictionScore,
    held_out: PredictionScore | None,
) -> list[str]:
    messages = []
    if not result.converged:
        messages.append(
            "the fit did not converge within its iterations; its values may still change"
        )
    chi2 = held_out.chi2 if held_out else train.chi2
    if chi2 > MAX_REDUCED_CHI2:
        messages.append(
            f"this model does not describe this flight: chi2 per degree of freedom is {chi2:.1f}, "
            "noise alone gives 1; check the log for axes, signs or units that are not the kit's, "
            "for another aircraft, and for wind"
        )
    if held_out is None:
        messages.append(
            "the flight is too short to hold anything back; the score is on the fitted data"
        )
    for name in (name for name in confidence.not_excited if name not in confidence.at_bound):
        messages.append(
            f"{name} was not excited in this flight: "
            "its interval is wider than half a typical value"
        )
    for name in confidence.at_bound:
        why = " and was hardly excited" if name in confidence.not_excited else ""
        messages.append(
            f"{name} ended on its bound {result.model.values[name]:g}{why}; "
            "its interval is not valid"
        )
    for a, b, r in confidence.correlated[:5]:
        messages.append(f"{a} and {b} are hardly separated by this flight (correlation {r:+.2f})")
    return messages


def refit_model(
    identification: Identification, model: Model, prior: Prior | None = None
) -> FitResult:
    """Fit another model of the same form to all windows, from the found initial states."""
    initial_states = identification.result.initial_states
    windows = identification.windows
    windows = windows.scale_weights(
        _robust_factors(residuals(model, windows, initial_states), windows)
    )
    return fit(model, windows, initial_states, prior=prior)
