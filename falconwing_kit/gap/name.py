"""Naming: a calm flight and a flight that surprises -> which effect is missing, how sure, or that none can be named."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE, Effect
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.baseline import CHOICE, LACKING, LEAST_GAIN, CalmBase, Progress, freedom, price_of, unnamed_for
from falconwing_kit.gap.evidence import Reduced, columns, variants
from falconwing_kit.gap.noise import whitened
from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_starts, prior_rows, robust_factor
from falconwing_kit.sysid.prepare import Prepared, prepare
from falconwing_kit.sysid.shooting import Windows, cut_windows
from falconwing_kit.sysid.uncertainty import uncertainty

Verdict = Literal["named", "ambiguous", "none", "outside"]

REFITS = 5  # effects that are fitted in full after the linear scan, and more while one not fitted could still win
ROUGH = 2.0  # chi2 to which the first round of fits is carried; the second goes on from there
CLEARLY = 0.1  # a load without a name must beat the named effects by this share of their evidence
FORMULA_ERROR = 0.04  # share of what a strong effect explains that its formula, 20 % off nature's, leaves unexplained
ELSEWHERE = 0.001  # the same of what it does not act on: 3 % off
SHARE_LEFT = 0.5  # of the excess: a name that leaves more behind is no explanation
EXCESS_SIGMAS = 6.0  # a flight's chi2 above the calm level by this much is not chance
STRAINED = 9.0  # parameters that moved by three of their sigmas on average: the base is no model of this aircraft


@dataclass(frozen=True)
class Candidate:
    """One effect and the evidence for it."""

    effect: Effect
    gain: float  # evidence over the base model: chi2 in units of the scatter, less the price of its parameters
    chi2_gain: float  # without the price
    values: dict[str, float]  # its parameters as found
    result: FitResult | None  # the full fit; None where the linear scan was enough


@dataclass(frozen=True)
class Naming:
    """The answer: a verdict and what it rests on."""

    verdict: Verdict
    chosen: tuple[Candidate, ...]  # named: one or two; ambiguous: the alternatives, best first
    ranking: tuple[Candidate, ...]  # every effect tried, best first
    threshold: float  # evidence needed, from the calm flight
    excess: float  # chi2 per degree of freedom of the flight over the calm level, before
    left: float  # the same after the best candidate
    unnamed: Candidate  # the load without a name that explains most
    strain: float  # chi2 per parameter by which the aircraft must differ from the calm one, even with the effects
    before: FitResult  # the base model fitted to the flight under its prior
    windows: Windows
    prepared: Prepared


def name_effect(
    base: CalmBase,
    flight: FlightTable,
    catalogue: Sequence[Effect] = CATALOGUE,
    progress: Progress = lambda stage: None,
) -> Naming:
    """Say which effect of the catalogue a flight shows that the calm one did not.

    Args:
        base: the aircraft without surprise.
        flight: the flight under test.
        catalogue: the effects to try.
        progress: called with the name of each stage.

    Returns:
        The verdict with its evidence.

    Raises:
        InputError: the flight cannot be used.
    """
    prepared = prepare(flight, base.found.sigma)
    progress("flight under test")
    windows, before = fit_flight(base, prepared)
    ranking = _rank(base, windows, before, catalogue, progress, tolerance=ROUGH)
    best = ranking[0].result
    if best is not None and ranking[0].gain > 0.5 * LEAST_GAIN:
        # Residuals that the effect explains were weighed down as if they were outliers: weigh again under the best.
        windows, before = _weigh_again(base, windows, before, best)
        ranking = _rank(base, windows, before, catalogue, progress, ranking)
    return _decide(base, windows, before, ranking, prepared, catalogue, progress)


def _decide(
    base: CalmBase,
    windows: Windows,
    before: FitResult,
    ranking: list[Candidate],
    prepared: Prepared,
    catalogue: Sequence[Effect],
    progress: Progress,
) -> Naming:
    threshold = max(LEAST_GAIN, 3.0 * base.false_gain)
    dof = freedom(windows, before)
    error = base.chi2 * np.sqrt(2.0 / dof + 2.0 / freedom(base.windows, base.result))
    excess = before.cost / dof - base.chi2
    chosen: tuple[Candidate, ...] = ()
    verdict: Verdict = "none"
    if ranking[0].gain > threshold:
        best = ranking[0]
        near = (c for c in ranking[1:] if c.gain > best.gain - LEAST_GAIN)
        rivals = tuple(c for c in near if best.effect.name not in c.effect.contains)
        verdict, chosen = ("ambiguous", (best, *rivals)) if rivals else ("named", (best,))
        if verdict == "named":
            chosen = _with_second(base, windows, before, best, catalogue, threshold, progress)
            ranking = [chosen[0], *(c for c in ranking if c.effect.name != chosen[0].effect.name)]
    adding_up = chosen if verdict == "named" else ranking[:1]
    explained = sum(c.gain for c in adding_up)
    left = excess - sum(c.chi2_gain for c in adding_up) * base.scatter / dof
    if chosen and left > max(EXCESS_SIGMAS * error, SHARE_LEFT * excess):
        verdict, chosen = "outside", ()
    elif not chosen and excess > EXCESS_SIGMAS * error:
        verdict = "outside"
    unnamed = _best_unnamed(base, windows, before, explained, progress)
    moved, known = _strain(adding_up[-1].result or before, base.prior)
    strain = moved / known
    clear = explained + max(threshold, CLEARLY * explained) if chosen else LACKING
    # Parameters that moved so far may imitate anything, unless it is little beside what the effect explains by itself.
    if unnamed.gain > clear or (strain > STRAINED and moved > FORMULA_ERROR * explained):
        verdict, chosen = "outside", ()
    return Naming(verdict, chosen, tuple(ranking), threshold, excess, left, unnamed, strain, before, windows, prepared)


def _best_unnamed(
    base: CalmBase, windows: Windows, before: FitResult, explained: float, progress: Progress
) -> Candidate:
    """The load without a name that explains most, fitted in full where it might beat the named ones."""
    best = _scan(base, windows, before, unnamed_for(before.model), progress)[0]
    if best.gain > explained:
        best = _fit_effect(base, windows, before, best, progress)
    return replace(best, gain=best.gain - CHOICE)


def _strain(result: FitResult, prior: Prior) -> tuple[float, int]:
    """How far parameters had to move from the calm flight's: chi2, and how many they are.

    Near 1 each for another day of the same aircraft; large for another aircraft, or for an effect that parameters
    imitate.
    """
    rows, mean = prior_rows(result.model, result.free, prior)
    known = max(int(np.count_nonzero(rows.any(axis=1))), 1)
    return float(np.sum((rows @ (result.model.vector[list(result.free)] - mean)) ** 2)), known


def _with_second(
    base: CalmBase,
    windows: Windows,
    before: FitResult,
    first: Candidate,
    catalogue: Sequence[Effect],
    threshold: float,
    progress: Progress,
) -> tuple[Candidate, ...]:
    """The first effect and a second one if there is; that one alone where nothing of the first is left beside it."""
    second = _second(base, windows, first, catalogue, threshold, progress)
    if second is None or second.result is None:
        return (first,)
    sure, values = uncertainty(second.result, windows, base.prior), second.result.model.values
    sizes = [sure.interval(p.name, values[p.name]) for p in first.effect.amplitudes]
    if any(low * high > 0.0 for low, high in sizes):
        return first, second
    alone = _fit_effect(base, windows, before, second, progress)
    return (alone,) if alone.gain > first.gain else (first, second)


def _second(
    base: CalmBase,
    windows: Windows,
    first: Candidate,
    catalogue: Sequence[Effect],
    threshold: float,
    progress: Progress,
) -> Candidate | None:
    """A second effect on top of the first: by the same rule, and more than an error of the first one's formula.

    What acts on the same things as the first (a lag beside a delay) is no second effect but that error.
    """
    rest = [e for e in catalogue if e.acts_on != first.effect.acts_on]
    if first.result is None or not rest:
        return None
    if _scan(base, windows, first.result, rest, progress)[0].gain < threshold:
        return None
    best, *others = _rank(base, windows, first.result, rest, progress)
    shared = set(best.effect.acts_on) & set(first.effect.acts_on)
    needed = max(threshold, (FORMULA_ERROR if shared else ELSEWHERE) * first.chi2_gain)
    rivals = [c for c in others if c.gain > best.gain - LEAST_GAIN and best.effect.name not in c.effect.contains]
    return best if best.gain > needed and not rivals else None


def _rank(
    base: CalmBase,
    windows: Windows,
    before: FitResult,
    catalogue: Sequence[Effect],
    progress: Progress,
    known: Sequence[Candidate] = (),
    tolerance: float = 0.1,
) -> list[Candidate]:
    """Linear scan of every effect, then full fits of the best, which begin where an earlier round ended."""
    earlier = {c.effect.parameters: c for c in known if c.result is not None}
    open_ = _scan(base, windows, before, catalogue, progress)
    fitted: list[Candidate] = []
    while open_:
        best = max((c.gain for c in fitted), default=-np.inf)
        hopeless = len(fitted) >= REFITS and open_[0].gain < best - LEAST_GAIN
        if hopeless or open_[0].gain < -LEAST_GAIN:
            break
        guess = open_.pop(0)
        fitted.append(
            _fit_effect(base, windows, before, guess, progress, earlier.get(guess.effect.parameters), tolerance)
        )
    return sorted([*fitted, *open_], key=lambda c: -c.gain)


def _scan(
    base: CalmBase, windows: Windows, before: FitResult, catalogue: Sequence[Effect], progress: Progress
) -> list[Candidate]:
    """Linear evidence of every effect at its best place, best first; of two forms of one effect the better one."""
    progress("scanning effects")
    reduced = Reduced.of(before, base.prior, base.scatter)
    best: dict[str, Candidate] = {}
    for tried in columns(before.model, windows, before.starts, list(variants(catalogue, windows))):
        effect, score = tried.variant.effect, reduced.score(tried)
        gain = score.gain - price_of(effect, windows)
        if effect.name not in best or gain > best[effect.name].gain:
            best[effect.name] = Candidate(effect, gain, score.gain, score.values, None)
    return sorted(best.values(), key=lambda c: -c.gain)


def _fit_effect(
    base: CalmBase,
    windows: Windows,
    before: FitResult,
    guess: Candidate,
    progress: Progress,
    earlier: Candidate | None = None,
    tolerance: float = 0.1,
) -> Candidate:
    """Fit an effect in full, from what the scan found or from an earlier fit."""
    effect = guess.effect
    progress(f"fitting {effect.name}")
    bounds = {p.name: p for p in effect.parameters}
    values = {n: float(np.clip(v, bounds[n].low, bounds[n].high)) for n, v in guess.values.items()}
    model, starts = before.model.with_effect(effect).with_values(values), before.starts
    if earlier is not None and earlier.result is not None:
        model, starts = earlier.result.model, earlier.result.starts
    result = fit(model, windows, starts, prior=base.prior, iterations=15, tolerance=tolerance)
    if result.cost > before.cost:  # the scan promised too much: begin with a tenth of it
        small = model.with_values({p.name: 0.1 * values[p.name] for p in effect.amplitudes})
        result = fit(small, windows, before.starts, prior=base.prior, iterations=15, tolerance=tolerance)
    gained = (before.cost - result.cost) / base.scatter
    found = {p.name: result.model.values[p.name] for p in effect.parameters}
    gain = gained - price_of(effect, windows)
    return Candidate(
        effect, gain if _is_itself(effect, result, windows, base) else min(gain, 0.0), gained, found, result
    )


def _is_itself(effect: Effect, result: FitResult, windows: Windows, base: CalmBase) -> bool:
    """Whether a fit ended where the effect is what its name says: no place on its bound, nothing essential at zero."""
    values = result.model.values
    shape = (p for p in effect.parameters if p.name in effect.shape)
    if any(not p.low + 1e-6 < values[p.name] < p.high - 1e-6 for p in shape):
        return False
    if not effect.essential:
        return True
    sure = uncertainty(result, windows, base.prior)
    return all(low * high > 0.0 for low, high in (sure.interval(name, values[name]) for name in effect.essential))


def fit_flight(base: CalmBase, prepared: Prepared) -> tuple[Windows, FitResult]:
    """The base model under its prior, fitted to a flight, far residuals weighed down.

    Args:
        base: the aircraft without surprise.
        prepared: the flight.

    Returns:
        The flight in windows as long as the base's, and the fit.
    """
    model = base.result.model
    plain = cut_windows(prepared.flights, model, base.window_s)
    starts, residual = fit_starts(model, plain, plain.guess[:, : model.n_states])
    first = fit(model, plain.weighted(robust_factor(residual, plain)), starts, prior=base.prior, tolerance=1.0)
    return _weigh_again(base, plain, first, first)


def _weigh_again(base: CalmBase, windows: Windows, before: FitResult, best: FitResult) -> tuple[Windows, FitResult]:
    """Weights by the residuals of the best model so far, and the base model fitted with them."""
    plain = base.as_measured(windows)
    _, residual = fit_starts(best.model, plain, best.starts)
    weighted = whitened(plain.weighted(robust_factor(residual, plain)), base.noise)
    return weighted, fit(before.model, weighted, before.starts, prior=base.prior)
