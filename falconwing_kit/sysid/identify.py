"""Identification: flight tables -> a fitted model with intervals, and a score on time it has not
seen.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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
COARSE_WINDOWS = 60  # short windows that bring a bad start near; more would only cost time
CORRELATED_SHARE = (
    0.5  # at most this share of the noise variance may be slow; what is beyond counts as misfit
)
GOOD_START_CHI2 = 1.5  # chi2 per component of short windows; above it another start is tried
MIN_IMPROVEMENT = 10.0  # chi2 by which another end of a fit must win to be taken
MAX_REDUCED_CHI2 = 4.0  # chi2 per degree of freedom that no pose noise explains
# Stick, column of the commands, the moment or rate it makes, what a positive one does.
CONTROL_CHANNELS = (
    ("aileron", 1, "L_da", "right wing down"),
    ("elevator", 2, "M_de", "nose up"),
    ("rudder", 3, "N_dr", "nose right"),
)
MIN_EFFECTIVENESS = 0.1  # of an ordinary effect: a stick that does less has no sign to speak of
# times the misfit: a log with sticks turned round that fits no worse than this is the better log
MISFIT_RATIO = 1.05

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Identification:
    """The answer of `identify`: a model, how sure it is, and how well it predicts."""

    model: Model  # fitted to everything
    train_model: Model  # fitted without the held-out time
    uncertainty: Uncertainty
    train: PredictionScore
    held_out: PredictionScore | None  # None where the flight is too short to keep anything back
    sigma: Array  # (6,) noise used, order of CHANNELS [m, rad]
    sigma_white: Array  # (6,) noise seen by differences alone
    prepared: tuple[PreparedTable, ...]
    windows: Windows  # every window, weighted by the noise alone
    fitted_windows: Windows  # those of the final fit, far residuals weighed down
    held_out_index: np.ndarray  # which of them were kept for scoring
    result: FitResult  # the final fit, to all windows
    names: tuple[str, ...]  # the flights
    warnings: tuple[str, ...]
    seconds: float
    reversed_channels: tuple[str, ...] = ()  # control inputs that fit with the opposite sign

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter, its unit."""
        return self.uncertainty.interval(name, self.model.values[name])


@np.errstate(all="ignore")  # a flight that runs away overflows; its cost is infinite
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
    """Fit f_K to one or several flights of one aircraft by multiple shooting, and score it on
    held-out time.

    About a third of the time, in blocks of 10 s, is held out; the model is fitted to the rest and
    scored; the parameters handed back are then fitted to everything.

    Args:
        tables: flights of the same aircraft, same rate.
        form: "rates" or "paper"; unused where a model is given.
        model: where to start (its terms, bounds and values), or None for the form's own.
        sigma: (6,) noise of px, py, pz, roll, pitch, yaw [m, rad], or None to use the tables' or
            estimate it.
        prior: what is known of the parameters, or None.
        window_s: length of a shooting window [s].
        progress: called with a stage's name and the chi2 there.

    Returns:
        Model, intervals, scores and warnings.

    Raises:
        InputError: no flight, too little of it, or nothing moves in it.
    """
    began = time.perf_counter()
    report = progress or (lambda stage, chi2: None)
    if not tables:
        raise InputError("flights: expected at least one flight table, got none")
    prepared = tuple(prepare(table, sigma) for table in tables)
    flights = tuple(flight for p in prepared for flight in p.flights)
    _require_motion(flights)
    ordinary = model or FORMS[form]()
    model = _starting_model(ordinary, flights, prior, report)

    windows = cut_windows(flights, model, window_s)
    fit_index, score_index = split_blocks(windows)
    white = np.median([p.sigma for p in prepared], axis=0)
    known = sigma is not None or all("sigma_position" in t.extra for t in tables)
    train = select_windows(windows, fit_index)
    initial_states, _ = fit_initial_states(
        model, train, train.initial_guess[:, : model.n_states], iterations=2
    )
    plain = train
    result, train, noise = _fit_with_noise(
        model, plain, initial_states, prior, white, fixed=known, report=report
    )
    other = _restart_from_bounds(result, train, prior)
    if other is not result:
        result, train, noise = _fit_with_noise(
            other.model, plain, other.initial_states, prior, white, fixed=known, report=report
        )
    windows = windows.scale_weights(white / noise)
    train_score = score(result.model, select_windows(windows, fit_index), result.initial_states)
    held_out = (
        score(result.model, select_windows(windows, score_index)) if len(score_index) else None
    )
    report("held out", held_out.chi2 if held_out else float("nan"))

    final = result
    if held_out is not None:
        initial_states = np.empty((len(windows), model.n_states))
        initial_states[fit_index], initial_states[score_index] = (
            result.initial_states,
            held_out.initial_states,
        )
        everything = windows.scale_weights(
            _robust_factors(residuals(result.model, windows, initial_states), windows)
        )
        final = fit(result.model, everything, initial_states, prior=prior, iterations=6)
        train = everything
        report("all windows", final.cost / max(windows.count, 1))
    confidence = uncertainty(final, train, prior)
    reversed_names = _find_reversed_channels(ordinary, final, confidence, windows, prior, report)
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
        fitted_windows=train,
        held_out_index=score_index,
        result=final,
        names=tuple(t.name for t in tables),
        warnings=tuple(warnings),
        seconds=time.perf_counter() - began,
        reversed_channels=reversed_names,
    )


def _require_motion(flights: Sequence[PreparedFlight]) -> None:
    moved = np.sqrt(sum(np.var(f.commands, axis=0) for f in flights) / len(flights))
    if np.all(moved < 1e-6):
        raise InputError(
            "commands: expected sticks that move, got the same values in every row; nothing can be identified"
        )
    speed = np.median(
        np.concatenate([np.linalg.norm(f.state_estimate[:, 6:9], axis=1) for f in flights])
    )
    if speed < 0.5:
        raise InputError(
            f"flight: expected an aircraft that flies, got a median speed of {speed:.2f} m/s"
        )


def _starting_model(
    model: Model, flights: Sequence[PreparedFlight], prior: Prior | None, report: Progress
) -> Model:
    """Short windows from several starts: the smoothed one-step fit, the model's own values, and a
    slower servo.
    """
    poses = sum(int(np.isfinite(f.pose[:, 0]).sum()) for f in flights)
    between = sum(f.duration for f in flights) / max(poses, 1)
    windows = cut_windows(flights, model, max(1.0, 5.0 * between))
    if len(windows) > COARSE_WINDOWS:
        windows = select_windows(
            windows, np.linspace(0, len(windows) - 1, COARSE_WINDOWS).astype(int)
        )
    initial_guess = windows.initial_guess[:, : model.n_states]
    slow = {"lag": 0.06} if model.parameters[model.names.index("lag")].high > 0.06 else {}
    # The one-step fit is biased and yet near; a servo taken for too fast hides in half the roll
    # damping.
    candidates = [
        model,
        fit_one_step(model, flights, smoothed=True, most=1500),
        model.with_values(slow),
    ]
    tried = [
        (start, *fit_initial_states(start, windows, initial_guess, iterations=3))
        for start in candidates
    ]
    best, best_cost = model, np.inf
    for start, initial_states, residual in sorted(tried, key=lambda t: _clipped_cost(t[2])):
        coarse = windows.scale_weights(_robust_factors(residual, windows, far=30.0))
        result = fit(start, coarse, initial_states, prior=prior, iterations=15, tolerance=1.0)
        cost = _clipped_cost(result.residual)
        report("short windows", cost / windows.count)
        if cost < best_cost:
            best, best_cost = result.model, cost
        if best_cost < GOOD_START_CHI2 * windows.count and not (slow and best.values["lag"] <= 0.0):
            break
    return best


def _restart_from_bounds(result: FitResult, windows: Windows, prior: Prior | None) -> FitResult:
    """A fit that ended on bounds may have lost its way: begin once more with those parameters at
    ordinary values.
    """
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


def _clipped_cost(residual: Array) -> float:
    """Sum of squares in which no single residual counts for more than five sigmas."""
    return float(np.sum(np.minimum(np.nan_to_num(residual, posinf=5.0) ** 2, 25.0)))


def _fit_with_noise(
    model: Model,
    windows: Windows,
    initial_states: Array,
    prior: Prior | None,
    white: Array,
    *,
    fixed: bool,
    report: Progress,
) -> tuple[FitResult, Windows, Array]:
    """Fit, weigh down what is far off, let the noise grow to what slow pose errors may explain, fit
    again.
    """
    noise, plain = white, windows
    result = fit(model, windows, initial_states, prior=prior, tolerance=1.0)
    report("full windows", result.cost / windows.count)
    for _ in range(2):
        before = noise
        if not fixed:
            noise = _estimate_noise(result, plain, white)
        old, scaled = windows, plain.scale_weights(white / noise)
        windows = scaled.scale_weights(
            _robust_factors(residuals(result.model, scaled, result.initial_states), scaled)
        )
        factor = np.divide(
            windows.weight, old.weight, out=np.ones_like(old.weight), where=old.weight > 0
        )
        linear = result.reweight(factor)
        result = fit(
            result.model, windows, result.initial_states, prior=prior, iterations=10, linear=linear
        )
        report("weights updated", result.cost / windows.count)
        if np.allclose(noise, before, rtol=0.03):
            break
    return result, windows, noise


def _estimate_noise(result: FitResult, windows: Windows, white: Array) -> Array:
    """Noise of each channel from the residuals, between the white part and twice its variance."""
    residual = pose_residuals(residuals(result.model, windows, result.initial_states), windows)
    share = 1.0 - (len(windows) * result.model.n_states + len(result.free)) / windows.count
    seen = windows.weight > 0
    ratio = (
        np.array(
            [(1.4826 * np.median(np.abs(residual[..., c][seen[..., c]]))) ** 2 for c in range(6)]
        )
        / share
    )
    return np.asarray(white * np.sqrt(np.clip(ratio, 1.0, 1.0 / (1.0 - CORRELATED_SHARE))))


def _robust_factors(residual: Array, windows: Windows, far: float | None = None) -> Array:
    factor = sqrt_huber_weight(residual, windows)
    if far is None:
        return factor
    return np.asarray(np.where(np.abs(pose_residuals(residual, windows)) < far, 1.0, factor))


def _find_reversed_channels(
    ordinary: Model,
    found: FitResult,
    confidence: Uncertainty,
    windows: Windows,
    prior: Prior | None,
    report: Progress,
) -> tuple[str, ...]:
    """Sticks that do the opposite of what they should, and in a log with them turned round do what
    they should.

    A stick that was moved is suspected where its effect ends below a tenth of an ordinary one. Only
    then the flights are fitted once more, from the ordinary aircraft and with the suspects turned
    round.
    """
    least = {p.name: MIN_EFFECTIVENESS * abs(p.start) for p in ordinary.parameters}
    moved = np.max([np.ptp(flight.commands, axis=0) for flight in windows.flights], axis=0) > 0.0
    suspects = [
        (name, column, effect)
        for name, column, effect, _ in CONTROL_CHANNELS
        if moved[column]
        and effect in confidence.names
        and found.model.values[effect] < least[effect]
    ]
    if not suspects:
        return ()
    signs = np.ones(4)
    signs[[column for _, column, _ in suspects]] = -1.0
    flights = tuple(replace(flight, commands=flight.commands * signs) for flight in windows.flights)
    reversed_windows = replace(windows, flights=flights)
    model = _starting_model(ordinary, flights, prior, report)
    initial_states, _ = fit_initial_states(
        model, reversed_windows, reversed_windows.initial_guess[:, : model.n_states], iterations=2
    )
    other = fit(model, reversed_windows, initial_states, prior=prior, tolerance=1.0)
    report("sticks turned round", other.cost / windows.count)
    if _clipped_cost(other.residual) > MISFIT_RATIO * _clipped_cost(
        residuals(found.model, windows, found.initial_states)
    ):
        return ()
    intervals = uncertainty(other, reversed_windows, prior)
    lowest = {
        effect: intervals.interval(effect, other.model.values[effect])[0]
        for _, _, effect in suspects
    }
    return tuple(name for name, _, effect in suspects if lowest[effect] > least[effect])


def _sign_warnings(reversed_names: tuple[str, ...]) -> list[str]:
    return [
        f"{name} seems reversed: expected positive {name} = {does} (the kit's conventions), the fit "
        "has the other sign; check the sign in your log"
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
        messages.append("the fit ran out of steps; its values may still move")
    chi2 = held_out.chi2 if held_out else train.chi2
    if chi2 > MAX_REDUCED_CHI2:
        messages.append(
            f"this model does not describe this flight: chi2 per degree of freedom is {chi2:.1f}, noise alone gives 1; "
            "look for axes, signs or units of the log that are not the kit's, for another aircraft, and for wind"
        )
    if held_out is None:
        messages.append(
            "the flight is too short to hold anything back; the score is on the fitted data"
        )
    for name in (name for name in confidence.not_excited if name not in confidence.at_bound):
        messages.append(
            f"{name} was not excited in this flight: its interval is wider than half an ordinary value"
        )
    for name in confidence.at_bound:
        why = " and was hardly excited" if name in confidence.not_excited else ""
        messages.append(
            f"{name} ended on its bound {result.model.values[name]:g}{why}; its interval does not hold"
        )
    for a, b, r in confidence.correlated[:5]:
        messages.append(f"{a} and {b} are hardly separated by this flight (correlation {r:+.2f})")
    return messages


def refit_model(
    identification: Identification, model: Model, prior: Prior | None = None
) -> FitResult:
    """Fit another model to the same windows with the same weights, starting from the found start
    states.

    Args:
        identification: a finished identification.
        model: the model to fit, same form.
        prior: what is known of its parameters.

    Returns:
        The fit to all windows.
    """
    initial_states = identification.result.initial_states
    windows = identification.windows
    windows = windows.scale_weights(
        _robust_factors(residuals(model, windows, initial_states), windows)
    )
    return fit(model, windows, initial_states, prior=prior)
