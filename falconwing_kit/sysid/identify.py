"""Identification: flight tables -> a fitted model, its intervals and a held-out score."""

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from falconwing_kit.aircraft.model import (
    FORMS,
    Form,
    Model,
    add_scaled_terms,
    rates_model,
    scale_model_to_speed,
)
from falconwing_kit.aircraft.terms import ATTITUDE_HOLD, CROSS_MOMENTS, UNBOUNDED_GYROSCOPIC
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.diagnose import diagnose_table, require_sound_table
from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_initial_states, sqrt_huber_weight
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.prepare import PreparedFlight, PreparedTable, prepare
from falconwing_kit.sysid.score import (
    PredictionScore,
    score,
    score_constant_turn,
    score_residual,
    split_blocks,
)
from falconwing_kit.sysid.shooting import (
    Windows,
    cut_windows,
    pose_residuals,
    residuals,
    select_windows,
)
from falconwing_kit.sysid.uncertainty import Uncertainty, ordinary_size, uncertainty

WINDOW_S = 2.0
SHORT_WINDOW_S = 1.0  # of the coarse fits
GROWING_WINDOWS_S = (1.0, 1.5)  # on the way to WINDOW_S
COARSE_WINDOWS = 60  # short windows of the coarse start; more would only cost time
CORRELATED_SHARE = 0.5  # largest share of the noise variance that is slow; the rest is misfit
COARSE_TOLERANCE = 1.0  # a start need not be exact
LOST_SIGMAS = 1e4  # a residual beyond: the prediction has left the flight
HOLD_SHARE = 0.1  # of a usual attitude hold, where a fit of one starts
GOOD_START_TURN_SHARE = 0.1  # of a constant turn's errors over short windows
GOOD_START_CHI2 = 1.5  # chi2 per component of short windows; above it another start is tried
SPEED_RATIO = 1.5  # of the flight's speed to the start's; beyond, a scaled aircraft is tried first
START_SPEED = 7.0  # [m/s] of the 150 g aircraft that the starting values describe
# Least weights of a fit: the distance flown in 2 ms, and half a degree.
LEAST_SIGMA_S, LEAST_SIGMA_ANGLE = 0.002, 0.01
WEAK_PRIOR = 3.0  # of a parameter's typical size: a prior that decides where the flight does not
# A derivative and the share of another one that is typical of it [Nelson, app. B].
TYPICAL_SHARE = {"L_beta": ("N_beta", 2.0), "L_r": ("L_p", 0.25), "N_p": ("N_r", 0.5)}
MIN_IMPROVEMENT = 10.0  # chi2 by which a second local minimum must be better to be taken
MARKER_SIGMA = np.array([0.03] * 3 + [0.01] * 3)  # [m, rad] of a pose from a printed marker
PRECISE_SHARE = 0.5  # of a marker's noise: finer poses are motion capture's
MAX_TURN_SHARE = 0.5  # of a constant turn's errors: a model with more does not describe a flight
MAX_REDUCED_CHI2 = 4.0  # chi2 per degree of freedom that no pose noise explains
# Channel, column of the commands, its control derivative, what a positive command does.
CONTROL_CHANNELS = (
    ("aileron", 1, "L_da", "right wing down"),
    ("elevator", 2, "M_de", "nose up"),
    ("rudder", 3, "N_dr", "nose right"),
)
MIN_EFFECTIVENESS = 0.1  # of a typical derivative; the sign of a smaller one means nothing
MIN_STICK_RANGE = 0.05  # of a channel that was moved; less is jitter of its receiver
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
    turn: PredictionScore  # of a constant turn on the same windows: what any model must beat
    sigma: Array  # (6,) noise used, order of CHANNELS [m, rad]
    is_sigma_given: bool  # by the caller or the tables; else it is estimated
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

    @property
    def describes_flight(self) -> bool:
        """Whether the model explains the flight, or predicts far better than a constant turn."""
        return describes_flight(
            self.held_out or self.train, self.turn, self.sigma, is_given=self.is_sigma_given
        )

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
    for table in tables:
        require_sound_table(table)
    prepared = tuple(prepare(table, sigma) for table in tables)
    flights = tuple(flight for p in prepared for flight in p.flights)
    _require_motion(flights)

    candidates = [model] if model else _starting_models(FORMS[form](), flights)
    start = _coarse_start(candidates[0], flights, prior or weak_prior(candidates[0]), report)

    windows = cut_windows(flights, start, window_s)
    fit_index, score_index = split_blocks(windows)
    measured = np.median([p.sigma for p in prepared], axis=0)
    white = np.maximum(measured, _least_sigma(flights))  # weights of the fit
    fit_windows = windows.scale_weights(measured / white)
    is_sigma_given = sigma is not None or all("sigma_position" in t.extra for t in tables)
    stick_faults = {kind for table in tables for kind in _stick_faults(table)}
    others = iter(()) if stick_faults else _other_starts(candidates, flights, prior, report)
    trained = _fit_training(
        select_windows(fit_windows, fit_index), chain([start], others), white, measured, prior,
        fixed=is_sigma_given, restart=not stick_faults, report=report,
    )  # fmt: skip
    result, fitted, noise, misfit = trained.result, trained.windows, trained.noise, trained.misfit
    prior = trained.prior

    weighted = fit_windows.scale_weights(white / misfit)
    windows = windows.scale_weights(measured / noise)
    train_score, held_out = _score_held_out(result, windows, fit_index, score_index)
    report("held out", held_out.chi2 if held_out else float("nan"))

    final = result
    if held_out is not None:
        states = np.empty((len(windows), result.model.n_states))
        states[fit_index] = result.initial_states
        states[score_index] = held_out.initial_states
        final, fitted = _fit_all(result.model, weighted, states, prior)
        report("all windows", final.cost / max(windows.count, 1))

    confidence = uncertainty(final, fitted, prior)
    turn = _constant_turn(windows, final, score_index, held_out)
    is_noise_alone = (held_out or train_score).chi2 < GOOD_START_CHI2
    reversed_names = _find_reversed_channels(
        candidates[0], final, confidence, weighted, prior, stick_faults, is_noise_alone, report
    )
    warnings = [w for p in prepared for w in p.warnings] + _sign_warnings(reversed_names)
    warnings += _warnings(final, confidence, train_score, held_out, turn, noise, is_sigma_given)
    if not describes_flight(held_out or train_score, turn, noise, is_given=is_sigma_given):
        said = {f"{name}_reversed" for name in reversed_names}
        faults = (fault for table in tables for fault in diagnose_table(table))
        warnings += [fault.sentence for fault in faults if fault.kind not in said]
    final, fitted = _rescale_weights(final, fitted, misfit / noise)
    return Identification(
        model=final.model,
        train_model=result.model,
        uncertainty=confidence,
        train=train_score,
        held_out=held_out,
        turn=turn,
        sigma=noise,
        is_sigma_given=is_sigma_given,
        sigma_white=measured,
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


def describes_flight(
    score: PredictionScore, turn: PredictionScore, sigma: Array, *, is_given: bool = False
) -> bool:
    """Whether a model describes a flight: two seconds ahead its errors are those of the poses.

    Estimated noise far finer than a marker's is that of motion capture; no model follows an
    aircraft so closely. There it counts that the errors are at most half of a constant turn's.

    Args:
        score: of the model.
        turn: of a constant turn on the same windows.
        sigma: (6,) noise of the poses that weighted both [m, rad].
        is_given: the noise is known, so errors beyond it are the model's.
    """
    if score.chi2 <= MAX_REDUCED_CHI2:
        return True
    if is_given or not np.all(sigma < PRECISE_SHARE * MARKER_SIGMA):
        return False
    return bool(
        score.position_m <= MAX_TURN_SHARE * turn.position_m
        and score.attitude_deg <= MAX_TURN_SHARE * turn.attitude_deg
    )


def _require_motion(flights: Sequence[PreparedFlight]) -> None:
    """Raise InputError for commands that never change and for an aircraft at rest."""
    moved = np.sqrt(sum(np.var(f.commands, axis=0) for f in flights) / len(flights))
    if np.all(moved < 1e-6):
        raise InputError(
            "commands: expected sticks that move, got the same values in every row; "
            "nothing can be identified"
        )
    speed = _typical_speed(flights)
    if speed < 0.5:
        raise InputError(
            f"flight: expected an aircraft that flies, got a median speed of {speed:.2f} m/s; "
            "cut the table to the time in the air"
        )


def weak_prior(model: Model) -> Prior:
    """Each parameter near where the fit starts, to three times its typical size.

    A flight that excites a parameter outweighs it by far; one that does not leaves it there. The
    typical size is that of the start, or of the model's value where that is larger: an aircraft of
    other moments of inertia has all of its derivatives larger together.

    Typical of an aircraft is, too, a dihedral effect of twice its weathercock stiffness, a roll due
    to yaw rate of a quarter of its roll damping, and a yaw due to roll rate of half its yaw damping
    [Nelson, app. B]; by a product of inertia each rolling moment also yaws it [Beard & McLain, eq.
    3.13], and N_p may be as large as L_p.
    """
    size = {p.name: ordinary_size(p, model.values[p.name]) for p in model.parameters}
    for name, (other, share) in TYPICAL_SHARE.items():
        if model.form == "rates" and {name, other} <= size.keys():
            size[name] = max(size[name], share * size[other])
    if CROSS_MOMENTS in model.terms:
        size["N_p"] = max(size["N_p"], size["L_p"])
    sigma = {name: WEAK_PRIOR * typical for name, typical in size.items()}
    return Prior({p.name: p.start for p in model.parameters}, sigma)


def _typical_speed(flights: Sequence[PreparedFlight]) -> float:
    """Median speed over the floor [m/s]."""
    speeds = [np.linalg.norm(f.state_estimate[:, 6:9], axis=1) for f in flights]
    return float(np.median(np.concatenate(speeds)))


def _least_sigma(flights: Sequence[PreparedFlight]) -> Array:
    """Least standard deviation (6,) that weights a fit [m, rad], whatever the poses' own noise.

    No model follows an aircraft to a millimetre; a fit weighted so spends itself on its own errors.
    """
    position = LEAST_SIGMA_S * _typical_speed(flights)
    return np.array([position] * 3 + [LEAST_SIGMA_ANGLE] * 3)


def _starting_models(model: Model, flights: Sequence[PreparedFlight]) -> list[Model]:
    """The model and the same scaled to the speed of the flights, the likelier first."""
    speed = _typical_speed(flights)
    scaled = scale_model_to_speed(model, float(np.clip(speed, 1.0, 100.0)))
    is_near = 1.0 / SPEED_RATIO < speed / START_SPEED < SPEED_RATIO
    return [model, scaled] if is_near else [scaled, model]


def _coarse_start(
    model: Model, flights: Sequence[PreparedFlight], prior: Prior, report: Progress
) -> Model:
    """Best model of short-window fits: from the model, its one-step fit and a slower servo.

    Short windows have a wide basin of attraction: a bad model cannot diverge far within them.
    """
    windows = _thinned_windows(flights, model, SHORT_WINDOW_S)
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
        key=lambda fitted: _robust_cost(fitted[2]),  # (model, initial states, residual)
    )
    best, best_cost, good = model, np.inf, False
    for start, initial_states, residual in ranked:
        coarse = windows.scale_weights(_robust_factors(residual, windows, far=30.0))
        result = fit(
            start, coarse, initial_states, prior=prior, iterations=15, tolerance=COARSE_TOLERANCE
        )
        cost = _robust_cost(result.residual) / windows.count
        report("short windows", cost)
        if cost < best_cost:
            best, best_cost = result.model, cost
            good = cost < GOOD_START_CHI2 or _is_far_better_than_turn(result, coarse)
        if good and not (slow and best.values["lag"] <= 0.0):
            break
    return best


def _thinned_windows(flights: Sequence[PreparedFlight], model: Model, seconds: float) -> Windows:
    """COARSE_WINDOWS windows of this length, evenly thinned out, with five poses each at least."""
    poses = sum(int(np.isfinite(f.pose[:, 0]).sum()) for f in flights)
    pose_interval = sum(f.duration for f in flights) / max(poses, 1)
    windows = cut_windows(flights, model, max(seconds, 5.0 * pose_interval))
    sigma = np.median([f.sigma for f in flights], axis=0)
    windows = windows.scale_weights(sigma / np.maximum(sigma, _least_sigma(flights)))
    if len(windows) <= COARSE_WINDOWS:
        return windows
    return select_windows(windows, np.linspace(0, len(windows) - 1, COARSE_WINDOWS).astype(int))


def _is_good_fit(result: FitResult, windows: Windows, scale: Array) -> bool:
    """Whether a fit to full windows leaves noise alone, or far less than a constant turn.

    The third argument (6,) is the noise over the standard deviation that weighted the windows.
    """
    return bool(np.all(scale**2 > 1.0 / MAX_REDUCED_CHI2)) or _is_far_better_than_turn(
        result, windows
    )


def _stick_faults(table: FlightTable) -> list[str]:
    """Sticks that seem swapped or reversed: no other start helps, the log needs correction."""
    kinds = [fault.kind for fault in diagnose_table(table)]
    return [kind for kind in kinds if kind == "sticks_swapped" or kind.endswith("_reversed")]


def _other_starts(
    models: Sequence[Model],
    flights: Sequence[PreparedFlight],
    prior: Prior | None,
    report: Progress,
) -> Iterator[Model]:
    """Further starts where the fit from the first one is poor, the likeliest first.

    First with what a tailless or a stabilised aircraft has beyond the form: controls that turn the
    other axis too, then an attitude hold, without which such an aircraft diverges in the model.
    Then the other models. Each start is fitted to windows of growing length.
    """
    for other in [*extended_models(models[0]), *models[1:]]:
        yield _grow_windows(other, flights, prior or weak_prior(other), report)


def extended_models(model: Model) -> list[Model]:
    """The 12-state model with what a tailless or a stabilised aircraft has beyond it.

    Cross moments, then an attitude hold; none for a model with other terms.
    """
    if model.form != "rates" or {t.name for t in model.terms} != {
        t.name for t in rates_model().terms
    }:
        return []
    held = add_scaled_terms(model, ATTITUDE_HOLD)
    starts = {p.name: HOLD_SHARE * held.values[p.name] for p in ATTITUDE_HOLD.parameters}
    return [_with_cross_moments(model), held.with_values(starts)]


def _with_cross_moments(model: Model) -> Model:
    """The model with cross moments, its ratios of inertia without bounds.

    A product of inertia mixes rolling and yawing moment [Beard & McLain, eq. 3.13], so that the one
    may depend on sideslip and on either rate as much as the other, with either sign.
    """
    terms = tuple(
        UNBOUNDED_GYROSCOPIC if term.name == UNBOUNDED_GYROSCOPIC.name else term
        for term in model.terms
    )
    wide = {p.name: p for p in UNBOUNDED_GYROSCOPIC.parameters}
    bounds = {p.name: max(-p.low, p.high) for p in model.parameters}
    for roll, yaw in (("L_beta", "N_beta"), ("L_r", "N_r"), ("L_p", "N_p")):
        widest = max(bounds[roll], bounds[yaw])
        mixed = (yaw,) if roll == "L_p" else (roll, yaw)  # roll stays damped
        wide |= {
            p.name: replace(p, low=-widest, high=widest)
            for p in model.parameters
            if p.name in mixed
        }
    parameters = tuple(wide.get(p.name, p) for p in model.parameters)
    unbounded = replace(model, terms=terms, parameters=parameters)
    return add_scaled_terms(unbounded, CROSS_MOMENTS)


def _diverges(residual: Array) -> bool:
    """Whether the prediction of any window (W, R) left the flight altogether."""
    return bool(np.any(~np.isfinite(residual) | (np.abs(residual) > LOST_SIGMAS)))


def _grow_windows(
    model: Model, flights: Sequence[PreparedFlight], prior: Prior | None, report: Progress
) -> Model:
    """A model, or its one-step fit if better, fitted to windows of growing length.

    In short windows it cannot diverge far.
    """
    windows = _thinned_windows(flights, model, GROWING_WINDOWS_S[0])
    guess = windows.initial_guess[:, : model.n_states]
    model = min(
        (model, fit_one_step(model, flights, smoothed=True, most=1500)),
        key=lambda start: _robust_cost(fit_initial_states(start, windows, guess, iterations=3)[1]),
    )
    for seconds in GROWING_WINDOWS_S:
        windows = _thinned_windows(flights, model, seconds)
        states, _ = fit_initial_states(model, windows, windows.initial_guess[:, : model.n_states])
        result = fit(model, windows, states, prior=prior, iterations=15, tolerance=COARSE_TOLERANCE)
        report(f"windows of {seconds:g} s", result.cost / windows.count)
        model = result.model
        if _diverges(result.residual):
            break
    return model


def _robust_cost_at(result: FitResult, windows: Windows) -> float:
    """Robust cost of a fit's model with the weights of these windows."""
    return _robust_cost(residuals(result.model, windows, result.initial_states))


def _is_far_better_than_turn(result: FitResult, windows: Windows) -> bool:
    """Whether a fit's errors are at most a tenth of a constant turn's: a start, if no more."""
    fitted = score_residual(windows, result.initial_states, result.residual)
    turn = score_constant_turn(windows, result.initial_states)
    return (
        fitted.position_m < GOOD_START_TURN_SHARE * turn.position_m
        and fitted.attitude_deg < GOOD_START_TURN_SHARE * turn.attitude_deg
    )


@dataclass(frozen=True)
class _Trained:
    """A fit to the training windows."""

    prior: Prior
    result: FitResult
    windows: Windows  # reweighted
    noise: Array  # (6,) [m, rad]
    misfit: Array  # (6,) standard deviation that weights the fit [m, rad]


def _fit_training(
    train: Windows,
    starts: Iterator[Model],
    white: Array,
    measured: Array,
    prior: Prior | None,
    *,
    fixed: bool,
    restart: bool,
    report: Progress,
) -> _Trained:
    """The fit from the first start; where it is poor, the best of those from the others too.

    A start whose prediction diverges in a full window is used only where all do.

    Args:
        train: weighted by `white`.
        starts: the likeliest first; further ones are made only where they are needed.
        white: (6,) weights of the first fit [m, rad].
        measured: (6,) white part of the pose noise [m, rad].
        prior: on the parameters; None for a weak one around each start.
        fixed: the noise is known and stays `measured`.
        restart: refit with parameters that ended on a bound inside of it.
        report: called after each fit.
    """

    def fit_from(model: Model, states: Array, its_prior: Prior) -> _Trained:
        found = _fit_with_noise(
            train, white, measured, model, states, fixed=fixed, prior=its_prior, report=report
        )
        return _Trained(its_prior, *found)

    best: _Trained | None = None
    diverging: tuple[Model, Array] | None = None
    for start in starts:
        states, residual = fit_initial_states(
            start, train, train.initial_guess[:, : start.n_states]
        )
        if _diverges(residual):
            diverging = diverging or (start, states)
            continue
        again = fit_from(start, states, prior or weak_prior(start))
        if best is None or (
            _robust_cost_at(again.result, train)
            < _robust_cost_at(best.result, train) - MIN_IMPROVEMENT
        ):
            best = again
        if _is_good_fit(best.result, best.windows, best.noise / best.misfit):
            break
    if best is None:
        assert diverging is not None  # there is one start at least
        best = fit_from(*diverging, prior or weak_prior(diverging[0]))
    restarted = (
        _restart_inside_bounds(best.result, best.windows, best.prior) if restart else best.result
    )
    if restarted is not best.result:
        best = fit_from(restarted.model, restarted.initial_states, best.prior)
    return best


def _fit_with_noise(
    windows: Windows,
    white: Array,
    measured: Array,
    model: Model,
    initial_states: Array,
    *,
    fixed: bool,
    prior: Prior | None,
    report: Progress,
) -> tuple[FitResult, Windows, Array, Array]:
    """Iteratively reweighted fit: parameters, then noise per channel and robust weights, twice.

    Args:
        windows: weighted by `white`.
        white: (6,) weights of the first fit, at least the white part of the noise [m, rad].
        measured: (6,) white part of the pose noise [m, rad].
        model: where to start.
        initial_states: (W, n_states) where to start.
        fixed: the noise is known and stays `measured`.
        prior: Gaussian prior on the parameters.
        report: called after each fit.

    Returns:
        The fit, its reweighted windows, the noise (6,), and the standard deviation (6,) that
        weights the fit: the noise, or where more is left the size of the residuals, as the
        output-error method estimates it [Jategaonkar, eq. 4.15].
    """
    noise, misfit, weighted = measured, white, windows
    result = fit(model, windows, initial_states, prior=prior, tolerance=COARSE_TOLERANCE)
    report("full windows", result.cost / windows.count)
    for _ in range(2):
        before = misfit
        largest, misfit = _estimate_noise(result, windows, white, measured)
        noise = measured if fixed else largest
        misfit = np.where(misfit > largest, misfit, noise)
        previous, scaled = weighted, windows.scale_weights(white / misfit)
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
        if np.allclose(misfit, before, rtol=0.03):
            break
    return result, weighted, noise, misfit


def _estimate_noise(
    result: FitResult, windows: Windows, white: Array, measured: Array
) -> tuple[Array, Array]:
    """Noise (6,) of each channel, between its white part and the upper limit, and misfit (6,).

    The misfit is the size of the residuals: beyond that limit no noise explains it.
    """
    residual = pose_residuals(residuals(result.model, windows, result.initial_states), windows)
    # Degrees of freedom per residual: fitted states and parameters shrink the residuals.
    share = 1.0 - (len(windows) * result.model.n_states + len(result.free)) / windows.count
    seen = windows.weight > 0
    # Robust variance in units of the white one: sigma = 1.4826 median |r| for a Gaussian.
    size = white * [1.4826 * np.median(np.abs(residual[..., c][seen[..., c]])) for c in range(6)]
    ratio = np.maximum((size / measured) ** 2 / max(share, 0.1), 1.0)
    limited = np.minimum(ratio, 1.0 / (1.0 - CORRELATED_SHARE))
    return np.asarray(measured * np.sqrt(limited)), np.asarray(measured * np.sqrt(ratio))


def _robust_factors(residual: Array, windows: Windows, far: float | None = None) -> Array:
    """Huber factors (W, L, 6) of the weights; with `far`, only for residuals beyond it."""
    factor = sqrt_huber_weight(residual, windows)
    if far is None:
        return factor
    return np.asarray(np.where(np.abs(pose_residuals(residual, windows)) < far, 1.0, factor))


def _robust_cost(residual: Array) -> float:
    """Sum of squares in which residuals beyond five sigmas count logarithmically [Cauchy].

    It still ranks models where every residual is large, as with poses of a millimetre.
    """
    size = np.nan_to_num(residual, posinf=1e6, neginf=-1e6) / 5.0
    return float(25.0 * np.sum(np.log1p(size**2)))


def _rescale_weights(
    result: FitResult, windows: Windows, factor: Array
) -> tuple[FitResult, Windows]:
    """A fit and its windows with the weights of each channel times factor (6,)."""
    if np.all(factor == 1.0):
        return result, windows
    residual, of_parameters, of_states = result.reweight(
        np.broadcast_to(factor, windows.weight.shape)
    )
    cost = result.cost - float(np.sum(result.residual**2)) + float(np.sum(residual**2))
    result = replace(
        result, residual=residual, parameter_jacobian=of_parameters,
        initial_state_jacobian=of_states, cost=cost,
    )  # fmt: skip
    return result, windows.scale_weights(factor)


def _constant_turn(
    windows: Windows, final: FitResult, score_index: np.ndarray, held_out: PredictionScore | None
) -> PredictionScore:
    """Score of a constant turn on the held-out windows, or on all where none is held out."""
    if held_out is None:
        return score_constant_turn(windows, final.initial_states)
    return score_constant_turn(select_windows(windows, score_index), held_out.initial_states)


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
    again = fit(
        model, windows, initial_states, prior=prior, iterations=15, tolerance=COARSE_TOLERANCE
    )
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
    stick_faults: Collection[str],
    is_noise_alone: bool,
    report: Progress,
) -> tuple[str, ...]:
    """Channels whose sign in the log is reversed.

    A channel that was moved is suspected where the motion itself contradicts it, or where its
    control derivative ends below a tenth of a typical one and may be zero, unless noise alone is
    left (no stick is reversed that the model does without). Only then the flights
    are fitted once more, from the nominal model, with the suspects' commands negated. A suspect is
    confirmed where this fit is as good and the 95 % interval of the derivative lies above that
    tenth.
    """
    least = {p.name: MIN_EFFECTIVENESS * abs(p.start) for p in nominal.parameters}
    ranges = [np.ptp(flight.commands, axis=0) for flight in windows.flights]
    moved = np.max(ranges, axis=0) > MIN_STICK_RANGE
    suspects = [
        (name, column, derivative)
        for name, column, derivative, _ in CONTROL_CHANNELS
        if moved[column]
        and derivative in confidence.names
        and (
            f"{name}_reversed" in stick_faults
            or (
                not is_noise_alone
                and found.model.values[derivative] < least[derivative]
                and confidence.interval(derivative, found.model.values[derivative])[0] <= 0.0
            )
        )
    ]
    if not suspects:
        return ()
    signs = np.ones(4)
    signs[[column for _, column, _ in suspects]] = -1.0
    flights = tuple(replace(flight, commands=flight.commands * signs) for flight in windows.flights)
    reversed_windows = replace(windows, flights=flights)
    model = _coarse_start(nominal, flights, prior or weak_prior(nominal), report)
    initial_states, _ = fit_initial_states(
        model, reversed_windows, reversed_windows.initial_guess[:, : model.n_states], iterations=2
    )
    other = fit(model, reversed_windows, initial_states, prior=prior, tolerance=1.0)
    report("channels reversed", other.cost / windows.count)
    misfit = _robust_cost(residuals(found.model, windows, found.initial_states))
    if _robust_cost(other.residual) > MISFIT_RATIO * misfit:
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
    turn: PredictionScore,
    sigma: Array,
    is_sigma_given: bool,
) -> list[str]:
    messages = []
    if not result.converged:
        messages.append(
            "the fit did not converge within its iterations; its values may still change"
        )
    judged = held_out or train
    chi2 = judged.chi2
    if not describes_flight(judged, turn, sigma, is_given=is_sigma_given):
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
