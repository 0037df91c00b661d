"""Identification: flight tables -> a fitted model with intervals, and a score on time it has not seen."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.model import FORMS, Form, Model
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_starts, robust_factor
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.prepare import Flight, Prepared, prepare
from falconwing_kit.sysid.score import Score, hold_out, score, select
from falconwing_kit.sysid.shooting import Windows, cut_windows, pose_residuals, residuals
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty

WINDOW_S = 2.0
COARSE_WINDOWS = 60  # short windows that bring a bad start near; more would only cost time
CORRELATED_SHARE = 0.5  # at most this share of the noise variance may be slow; what is beyond counts as misfit
GOOD_START = 1.5  # chi2 per component of short windows; above it another start is tried
BETTER = 10.0  # chi2 by which another end of a fit must win to be taken
BAD_FIT = 4.0  # chi2 per degree of freedom that no pose noise explains
# Stick, column of the commands, the moment or rate it makes, what a positive one does.
STICKS = (
    ("aileron", 1, "L_da", "right wing down"),
    ("elevator", 2, "M_de", "nose up"),
    ("rudder", 3, "N_dr", "nose right"),
)
SLIGHT = 0.1  # of an ordinary effect: a stick that does less has no sign to speak of
AS_GOOD = 1.05  # times the misfit: a log with sticks turned round that fits no worse than this is the better log

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Identification:
    """The answer of `identify`: a model, how sure it is, and how well it predicts."""

    model: Model  # fitted to everything
    train_model: Model  # fitted without the held-out time
    uncertainty: Uncertainty
    train: Score
    held_out: Score | None  # None where the flight is too short to keep anything back
    sigma: Array  # (6,) noise used, order of CHANNELS [m, rad]
    sigma_white: Array  # (6,) noise seen by differences alone
    prepared: tuple[Prepared, ...]
    windows: Windows  # every window, weighted by the noise alone
    fitted_windows: Windows  # those of the final fit, far residuals weighed down
    held_out_index: np.ndarray  # which of them were kept for scoring
    result: FitResult  # the final fit, to all windows
    names: tuple[str, ...]  # the flights
    warnings: tuple[str, ...]
    seconds: float
    reversed_sticks: tuple[str, ...] = ()  # sticks whose sign in the log the fit wants the other way

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
    """Fit f_K to one or several flights of one aircraft by multiple shooting, and score it on held-out time.

    About a third of the time, in blocks of 10 s, is held out; the model is fitted to the rest and scored; the
    parameters handed back are then fitted to everything.

    Args:
        tables: flights of the same aircraft, same rate.
        form: "rates" or "paper"; unused where a model is given.
        model: where to start (its terms, bounds and values), or None for the form's own.
        sigma: (6,) noise of px, py, pz, roll, pitch, yaw [m, rad], or None to use the tables' or estimate it.
        prior: what is known of the parameters, or None.
        window_s: length of a shooting window [s].
        progress: called with a stage's name and the chi2 there.

    Returns:
        Model, intervals, scores and warnings.

    Raises:
        InputError: no flight, too little of it, or nothing moves in it.
    """
    began = time.perf_counter()
    tell = progress or (lambda stage, chi2: None)
    if not tables:
        raise InputError("flights: want at least one flight table, got none")
    prepared = tuple(prepare(table, sigma) for table in tables)
    flights = tuple(flight for p in prepared for flight in p.flights)
    _require_motion(flights)
    ordinary = model or FORMS[form]()
    model = _starting_model(ordinary, flights, prior, tell)

    windows = cut_windows(flights, model, window_s)
    fit_index, score_index = hold_out(windows)
    white = np.median([p.sigma for p in prepared], axis=0)
    known = sigma is not None or all("sigma_position" in t.extra for t in tables)
    train = select(windows, fit_index)
    starts, _ = fit_starts(model, train, train.guess[:, : model.n_states], iterations=2)
    plain = train
    result, train, noise = _fit_with_noise(model, plain, starts, prior, white, fixed=known, tell=tell)
    other = _off_its_bounds(result, train, prior)
    if other is not result:
        result, train, noise = _fit_with_noise(other.model, plain, other.starts, prior, white, fixed=known, tell=tell)
    windows = windows.weighted(white / noise)
    train_score = score(result.model, select(windows, fit_index), result.starts)
    held_out = score(result.model, select(windows, score_index)) if len(score_index) else None
    tell("held out", held_out.chi2 if held_out else float("nan"))

    final = result
    if held_out is not None:
        starts = np.empty((len(windows), model.n_states))
        starts[fit_index], starts[score_index] = result.starts, held_out.starts
        everything = windows.weighted(_robust(residuals(result.model, windows, starts), windows))
        final = fit(result.model, everything, starts, prior=prior, iterations=6)
        train = everything
        tell("all windows", final.cost / max(windows.count, 1))
    sure = uncertainty(final, train, prior)
    backward = _reversed_sticks(ordinary, final, sure, windows, prior, tell)
    warnings = [w for p in prepared for w in p.warnings] + _signs(backward)
    warnings += _warnings(final, sure, train_score, held_out)
    return Identification(
        model=final.model,
        train_model=result.model,
        uncertainty=sure,
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
        reversed_sticks=backward,
    )


def _require_motion(flights: Sequence[Flight]) -> None:
    moved = np.sqrt(sum(np.var(f.commands, axis=0) for f in flights) / len(flights))
    if np.all(moved < 1e-6):
        raise InputError("commands: want sticks that move, got the same values in every row; nothing can be identified")
    speed = np.median(np.concatenate([np.linalg.norm(f.smooth[:, 6:9], axis=1) for f in flights]))
    if speed < 0.5:
        raise InputError(f"flight: want an aircraft that flies, got a median speed of {speed:.2f} m/s")


def _starting_model(model: Model, flights: Sequence[Flight], prior: Prior | None, tell: Progress) -> Model:
    """Short windows from several starts: the smoothed one-step fit, the model's own values, and a slower servo."""
    poses = sum(int(np.isfinite(f.pose[:, 0]).sum()) for f in flights)
    between = sum(f.duration for f in flights) / max(poses, 1)
    windows = cut_windows(flights, model, max(1.0, 5.0 * between))
    if len(windows) > COARSE_WINDOWS:
        windows = select(windows, np.linspace(0, len(windows) - 1, COARSE_WINDOWS).astype(int))
    guess = windows.guess[:, : model.n_states]
    slow = {"lag": 0.06} if model.parameters[model.names.index("lag")].high > 0.06 else {}
    # The one-step fit is biased and yet near; a servo taken for too fast hides in half the roll damping.
    candidates = [model, fit_one_step(model, flights, smoothed=True, most=1500), model.with_values(slow)]
    tried = [(start, *fit_starts(start, windows, guess, iterations=3)) for start in candidates]
    best, best_cost = model, np.inf
    for start, starts, residual in sorted(tried, key=lambda t: _clipped(t[2])):
        coarse = windows.weighted(_robust(residual, windows, far=30.0))
        result = fit(start, coarse, starts, prior=prior, iterations=15, tolerance=1.0)
        cost = _clipped(result.residual)
        tell("short windows", cost / windows.count)
        if cost < best_cost:
            best, best_cost = result.model, cost
        if best_cost < GOOD_START * windows.count and not (slow and best.values["lag"] <= 0.0):
            break
    return best


def _off_its_bounds(result: FitResult, windows: Windows, prior: Prior | None) -> FitResult:
    """A fit that ended on bounds may have lost its way: begin once more with those parameters at ordinary values."""
    free = [result.model.parameters[i] for i in result.free]
    stuck = {p.name: p.start for p in free if not p.low < result.model.values[p.name] < p.high}
    if not stuck:
        return result
    model = result.model.with_values(stuck)
    starts, _ = fit_starts(model, windows, result.starts, iterations=3)
    again = fit(model, windows, starts, prior=prior, tolerance=1.0)
    return again if again.cost < result.cost - BETTER else result


def _clipped(residual: Array) -> float:
    """Sum of squares in which no single residual counts for more than five sigmas."""
    return float(np.sum(np.minimum(np.nan_to_num(residual, posinf=5.0) ** 2, 25.0)))


def _fit_with_noise(
    model: Model, windows: Windows, starts: Array, prior: Prior | None, white: Array, *, fixed: bool, tell: Progress
) -> tuple[FitResult, Windows, Array]:
    """Fit, weigh down what is far off, let the noise grow to what slow pose errors may explain, fit again."""
    noise, plain = white, windows
    result = fit(model, windows, starts, prior=prior, tolerance=1.0)
    tell("full windows", result.cost / windows.count)
    for _ in range(2):
        before = noise
        if not fixed:
            noise = _noise(result, plain, white)
        old, scaled = windows, plain.weighted(white / noise)
        windows = scaled.weighted(_robust(residuals(result.model, scaled, result.starts), scaled))
        factor = np.divide(windows.weight, old.weight, out=np.ones_like(old.weight), where=old.weight > 0)
        linear = result.reweighted(factor)
        result = fit(result.model, windows, result.starts, prior=prior, iterations=10, linear=linear)
        tell("weights updated", result.cost / windows.count)
        if np.allclose(noise, before, rtol=0.03):
            break
    return result, windows, noise


def _noise(result: FitResult, windows: Windows, white: Array) -> Array:
    """Noise of each channel from the residuals, between the white part and twice its variance."""
    residual = pose_residuals(residuals(result.model, windows, result.starts), windows)
    share = 1.0 - (len(windows) * result.model.n_states + len(result.free)) / windows.count
    seen = windows.weight > 0
    ratio = np.array([(1.4826 * np.median(np.abs(residual[..., c][seen[..., c]]))) ** 2 for c in range(6)]) / share
    return np.asarray(white * np.sqrt(np.clip(ratio, 1.0, 1.0 / (1.0 - CORRELATED_SHARE))))


def _robust(residual: Array, windows: Windows, far: float | None = None) -> Array:
    factor = robust_factor(residual, windows)
    if far is None:
        return factor
    return np.asarray(np.where(np.abs(pose_residuals(residual, windows)) < far, 1.0, factor))


def _reversed_sticks(
    ordinary: Model, found: FitResult, sure: Uncertainty, windows: Windows, prior: Prior | None, tell: Progress
) -> tuple[str, ...]:
    """Sticks that do the opposite of what they should, and in a log with them turned round do what they should.

    A stick that was moved is suspected where its effect ends below a tenth of an ordinary one. Only then the flights
    are fitted once more, from the ordinary aircraft and with the suspects turned round.
    """
    least = {p.name: SLIGHT * abs(p.start) for p in ordinary.parameters}
    moved = np.max([np.ptp(flight.commands, axis=0) for flight in windows.flights], axis=0) > 0.0
    suspects = [
        (name, column, effect)
        for name, column, effect, _ in STICKS
        if moved[column] and effect in sure.names and found.model.values[effect] < least[effect]
    ]
    if not suspects:
        return ()
    signs = np.ones(4)
    signs[[column for _, column, _ in suspects]] = -1.0
    flights = tuple(replace(flight, commands=flight.commands * signs) for flight in windows.flights)
    turned = replace(windows, flights=flights)
    model = _starting_model(ordinary, flights, prior, tell)
    starts, _ = fit_starts(model, turned, turned.guess[:, : model.n_states], iterations=2)
    other = fit(model, turned, starts, prior=prior, tolerance=1.0)
    tell("sticks turned round", other.cost / windows.count)
    if _clipped(other.residual) > AS_GOOD * _clipped(residuals(found.model, windows, found.starts)):
        return ()
    intervals = uncertainty(other, turned, prior)
    lowest = {effect: intervals.interval(effect, other.model.values[effect])[0] for _, _, effect in suspects}
    return tuple(name for name, _, effect in suspects if lowest[effect] > least[effect])


def _signs(backward: tuple[str, ...]) -> list[str]:
    return [
        f"{name} seems reversed: want positive {name} = {does} (the kit's conventions), the fit wants the other sign; "
        "check the sign in your log"
        for name, _, _, does in STICKS
        if name in backward
    ]


def _warnings(result: FitResult, sure: Uncertainty, train: Score, held_out: Score | None) -> list[str]:
    said = []
    if not result.converged:
        said.append("the fit ran out of steps; its values may still move")
    chi2 = held_out.chi2 if held_out else train.chi2
    if chi2 > BAD_FIT:
        said.append(
            f"this model does not describe this flight: chi2 per degree of freedom is {chi2:.1f}, noise alone gives 1; "
            "look for axes, signs or units of the log that are not the kit's, for another aircraft, and for wind"
        )
    if held_out is None:
        said.append("the flight is too short to hold anything back; the score is on the fitted data")
    for name in (name for name in sure.not_excited if name not in sure.at_bound):
        said.append(f"{name} was not excited in this flight: its interval is wider than half an ordinary value")
    for name in sure.at_bound:
        why = " and was hardly excited" if name in sure.not_excited else ""
        said.append(f"{name} ended on its bound {result.model.values[name]:g}{why}; its interval does not hold")
    for a, b, r in sure.correlated[:5]:
        said.append(f"{a} and {b} are hardly separated by this flight (correlation {r:+.2f})")
    return said


def refit(identification: Identification, model: Model, prior: Prior | None = None) -> FitResult:
    """Fit another model to the same windows with the same weights, starting from the found start states.

    Args:
        identification: a finished identification.
        model: the model to fit, same form.
        prior: what is known of its parameters.

    Returns:
        The fit to all windows.
    """
    starts = identification.result.starts
    windows = identification.windows
    windows = windows.weighted(_robust(residuals(model, windows, starts), windows))
    return fit(model, windows, starts, prior=prior)
