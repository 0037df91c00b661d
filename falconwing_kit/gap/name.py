"""Naming: nominal model and a flight under test -> which effect is missing.

Effect identification (fault isolation) by BIC model selection [Schwarz 1978; Kass & Raftery 1995]:
linear score-test scan of every effect, full fits of the best, decision. Verdicts:

    named      one effect, or up to three together
    ambiguous  several within VERY_STRONG_EVIDENCE of the best
    none       residuals as in the baseline flight
    outside    residuals too large, but no catalogue effect accounts for them, or a generic effect
               or other parameters of the aircraft do so better

Generic effect: a force or moment proportional to one flight variable, or a command filter
(`aircraft/generic.py`); the alternative hypothesis "something outside the catalogue".

Symbols:
    cost          sum of squared weighted residuals of a fit, and of its prior's
    chi2          cost per degree of freedom; 1 where measurement noise alone remains
    reduced_chi2  the baseline's chi2, at least 1: what noise and model error leave
    delta_chi2    reduction of the cost by an effect, in units of reduced_chi2
    delta_bic     delta_chi2 over the effect's variance factor, less k ln(n) of the effect's k
                  parameters and n measured components
    excess_chi2   chi2 of the flight above the baseline's, without effects
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.baseline import (
    GENERIC_EVIDENCE,
    SELECTION_PENALTY,
    VERY_STRONG_EVIDENCE,
    NominalModel,
    Progress,
    available_generic_effects,
    bic_penalty,
    degrees_of_freedom,
    drift_prior,
)
from falconwing_kit.gap.evidence import SchurComplement, effect_variants, sensitivities
from falconwing_kit.gap.noise import robust_weights, whiten
from falconwing_kit.sysid.fit import (
    FitResult,
    Prior,
    fit,
    fit_initial_states,
    has_diverged,
    prior_rows,
)
from falconwing_kit.sysid.prepare import PreparedTable, prepare
from falconwing_kit.sysid.shooting import Windows, cut_windows, select_windows
from falconwing_kit.sysid.uncertainty import uncertainty

Verdict = Literal["named", "ambiguous", "none", "outside"]

REFITS = 5  # full fits after the linear scan at least; more while another effect could still win
# No full fit of an effect whose linear evidence is below this share of the best full fit's: on
# eight labelled flights a full fit gave 0.96 to 1.03 times linear evidence over 25, or none.
HOPELESS_SHARE = 0.1
# The first round of fits stops where a step lowers the cost by less; the second continues it.
COARSE_TOLERANCE = 2.0
GENERIC_MARGIN = 0.1  # a generic effect must exceed the named ones by this share of their evidence
# Share of an effect's delta_chi2 that an error of its formula leaves: (20 %)^2 of it, where the
# formula is wrong by 20 % of the residuals that the effect causes; (30 %)^2 where the nominal model
# itself had to be completed.
FORMULA_ERROR, COMPLETED_FORMULA_ERROR = 0.04, 0.09
# The same for what the effect does not act on: (3 %)^2, or (10 %)^2 of those residuals.
UNRELATED_FORMULA_ERROR, COMPLETED_UNRELATED_ERROR = 0.001, 0.01
MAX_REMAINING_SHARE = 0.5  # of the excess: an effect that leaves more is no explanation
NO_EXCESS_SIGMAS = 3.0  # explained chi2 above this, but no excess: nothing new in this flight
EXCESS_SIGMAS = 6.0  # chi2 above the baseline level by this many standard deviations is not chance
MAX_EFFECTS = 3  # named together
MAX_SET_ASIDE = 2  # effects in both flights that may hide another one
VISIBLE_SIGMAS = 3.0  # standard deviations of the flight's chi2 that a third effect must explain
# Squared Mahalanobis distance per parameter: three standard deviations each is another aircraft.
MAX_MAHALANOBIS = 9.0
MAX_DIVERGING = 0.1  # share of windows that may be left out since the nominal model diverges there
# Incidents: windows whose chi2 exceeds the baseline's mean by so many times what any window of the
# baseline does; at most so many runs of them and such a share of the flight, and none in the last
# such share, since what begins there may go on; they hold more than this share of the excess.
INCIDENT_FACTOR, MAX_INCIDENTS, INCIDENT_SHARE, INCIDENT_EXCESS = 2.0, 2, 0.1, 0.5


@dataclass(frozen=True)
class EffectCandidate:
    """One effect and the evidence for it."""

    effect: Effect
    delta_bic: float  # evidence over the nominal model: delta_chi2 less the BIC penalty
    delta_chi2: float  # chi2 explained, in units of the reduced chi2 of the baseline
    values: dict[str, float]  # its parameters as estimated
    result: FitResult | None  # the full fit; None where only the linear scan was made
    is_identifiable: bool = True  # else what it explains does not count


@dataclass(frozen=True)
class Naming:
    """The verdict and its evidence."""

    verdict: Verdict
    chosen: tuple[EffectCandidate, ...]  # named: one to three; ambiguous: alternatives, best first
    ranking: tuple[EffectCandidate, ...]  # every effect tried, best first
    threshold: float  # evidence required, from the baseline flight
    excess_chi2: float  # chi2 per degree of freedom above the baseline level, without effects
    remaining_chi2: float  # the same with the best candidate
    generic: EffectCandidate  # the generic effect that explains most
    mahalanobis: float  # squared distance of the parameters from their prior, per parameter
    before: FitResult  # the nominal model fitted to the flight under its prior
    windows: Windows
    prepared: PreparedTable
    # Begin and end [s], by the flight's clock, of windows that the verdict is without
    incidents: tuple[tuple[float, float], ...] = ()


def name_effect(
    base: NominalModel,
    flight: FlightTable,
    catalogue: Sequence[Effect] = CATALOGUE,
    progress: Progress = lambda stage: None,
) -> Naming:
    """Find which effect of the catalogue a flight shows and the baseline flight did not.

    Linear scan of all effects, full fits of the best, then the decision by BIC against a threshold
    that comes from the baseline flight.

    Raises:
        InputError: the flight cannot be used.
    """
    prepared = prepare(flight, base.found.sigma)
    progress("flight under test")
    windows, before = fit_flight(base, prepared)
    return _name_in_windows(base, windows, before, prepared, catalogue, progress)


def _name_in_windows(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    prepared: PreparedTable,
    catalogue: Sequence[Effect],
    progress: Progress,
) -> Naming:
    """The naming by some windows of a flight, with the nominal model fitted to them."""
    ranking = _rank(base, windows, before, catalogue, progress, tolerance=COARSE_TOLERANCE)
    best = ranking[0].result
    if best is not None and ranking[0].delta_bic > 0.5 * VERY_STRONG_EVIDENCE:
        # The robust weights treated residuals that the effect explains as outliers: update them
        # with the best effect in the model, and rank again.
        windows, before = _update_weights(base, windows, before, best)
        ranking = _rank(base, windows, before, catalogue, progress, ranking)
    return _decide(base, windows, before, ranking, prepared, catalogue, progress)


def without_incidents(
    base: NominalModel,
    naming: Naming,
    catalogue: Sequence[Effect] = CATALOGUE,
    progress: Progress = lambda stage: None,
) -> Naming:
    """The naming, or "none" where but for one or two incidents a flight is like its baseline.

    An aircraft that stalls once, where its baseline flight never did, shows no unknown effect. So a
    flight whose verdict is "outside" is judged again without the windows in which the nominal model
    fails as never in the baseline flight, if these are few, over before the flight ends, and hold
    most of the excess. Any other verdict than "none" then leaves the first as it was.

    Returns:
        The same, or with the verdict "none" and the `incidents`.
    """
    windows, before = naming.windows, naming.before
    apart = _incidents(base, windows, before) if naming.verdict == "outside" else np.empty(0, int)
    if not len(apart):
        return naming
    progress("without incidents")
    kept = np.setdiff1d(np.arange(len(windows)), apart)
    rest, states = select_windows(windows, kept), before.initial_states[kept]
    nominal = fit(before.model, rest, states, prior=base.prior, tolerance=1.0)
    rest, nominal = _update_weights(base, rest, nominal, nominal)
    again = _name_in_windows(base, rest, nominal, naming.prepared, catalogue, progress)
    if again.verdict != "none":
        return naming
    clock = [naming.prepared.flights[k].t[0] for k in windows.flight[apart]]
    times = windows.nodes[apart][:, [0, -1]] + np.array(clock)[:, None]
    return replace(naming, verdict="none", incidents=tuple(map(tuple, times.tolist())))


def _incidents(base: NominalModel, windows: Windows, before: FitResult) -> np.ndarray:
    """Indices of the windows that are incidents, as of the INCIDENT constants; empty for none."""
    of_baseline = _window_chi2(base.windows, base.result)
    level = of_baseline.mean()
    excess = _window_chi2(windows, before) - level
    apart = np.flatnonzero(excess > INCIDENT_FACTOR * (of_baseline.max() - level))
    few = INCIDENT_SHARE * len(excess)
    runs = 1 + np.count_nonzero((np.diff(apart) > 1) | np.diff(windows.flight[apart]).astype(bool))
    if not 0 < len(apart) <= few or runs > MAX_INCIDENTS or apart[-1] >= len(excess) - few:
        return np.empty(0, int)
    holds = np.sum(excess[apart]) > INCIDENT_EXCESS * np.sum(excess)
    return apart if holds else np.empty(0, int)


def _window_chi2(windows: Windows, result: FitResult) -> Array:
    """(W,) Chi2 of each window per measured pose component."""
    measured = np.count_nonzero(windows.weight, axis=(1, 2))
    return np.asarray(np.sum(result.residual**2, axis=1) / np.maximum(measured, 1))


def _set_aside(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    ranking: list[EffectCandidate],
    catalogue: Sequence[Effect],
    threshold: float,
    progress: Progress,
) -> tuple[FitResult, list[EffectCandidate], EffectCandidate | None]:
    """Put effects that act in the baseline flight too into the nominal model, and rank the others.

    An effect of one size in both flights is a flaw of the nominal model: it is no answer, but it
    must not hide one either.

    Returns:
        The fit to the flight with these effects, the ranking beside them, and the one of it that is
        new in this flight, if any. Their own evidence is that over their presence in both flights.
    """
    aside: list[EffectCandidate] = []
    new = None
    while len(aside) < MAX_SET_ASIDE and ranking[0].delta_bic > threshold:
        best = ranking[0]
        change = _evidence_of_change(base, windows, best)
        if best.result is None or change >= _needed_change(base, best):
            new = best
            break
        aside.append(replace(best, delta_bic=min(best.delta_bic, change)))
        before = best.result
        names = {candidate.effect.name for candidate in aside}
        rest = [effect for effect in catalogue if effect.name not in names]
        ranking = _rank(base, windows, before, rest, progress)
    return before, sorted([*ranking, *aside], key=lambda c: -c.delta_bic), new


def chi2_difference_error(base: NominalModel, dof: int) -> float:
    """Standard deviation of a flight's chi2 per degree of freedom less the baseline's.

    chi2 sqrt(F (2 / n + 2 / n_base)): a sum of n squares has the variance 2 n [Bendat &
    Piersol, Random Data, 4.2.2]. Residuals that share an error count as fewer,
    by the variance factor F of the baseline's fit.

    Args:
        base: the baseline.
        dof: n, degrees of freedom of the flight.
    """
    n_base = degrees_of_freedom(base.windows, base.result)
    return float(base.chi2 * np.sqrt(base.prior_inflation * (2.0 / dof + 2.0 / n_base)))


def _decide(
    base: NominalModel,
    windows: Windows,
    nominal: FitResult,
    ranking: list[EffectCandidate],
    prepared: PreparedTable,
    catalogue: Sequence[Effect],
    progress: Progress,
) -> Naming:
    threshold = max(VERY_STRONG_EVIDENCE, 3.0 * base.false_alarm_level)
    before, ranking, new = _set_aside(
        base, windows, nominal, ranking, catalogue, threshold, progress
    )
    dof = degrees_of_freedom(windows, before)
    error = chi2_difference_error(base, dof)
    excess_chi2 = nominal.cost / dof - base.chi2
    chosen: tuple[EffectCandidate, ...] = ()
    verdict: Verdict = "none"
    # Named, or ambiguous where others come within "very strong" of the best.
    ranking = _lower_strained_rivals(base, windows, ranking, threshold)
    if ranking[0].delta_bic > threshold:
        best = ranking[0]
        rivals = _rivals(best, ranking[1:])
        verdict, chosen = ("ambiguous", (best, *rivals)) if rivals else ("named", (best,))
    if verdict == "named":
        chosen = _add_further_effects(
            base, windows, before, chosen[0], catalogue, threshold, progress
        )
        ranking = [chosen[0], *(c for c in ranking if c.effect.name != chosen[0].effect.name)]
        evidence = _evidence_by_birge_ratio(base, windows, chosen[0], chosen[-1])
        if evidence <= threshold:
            verdict, chosen = "none", ()
            ranking[0] = replace(ranking[0], delta_bic=evidence)
            ranking.sort(key=lambda c: -c.delta_bic)
    # No excess over the baseline, no name: the same effect may be in both flights.
    if chosen and chosen[0] is not new and not _is_new(base, windows, chosen[0]):
        verdict, chosen = "none", ()
    # Outside where the chosen effects leave most of the excess, or nothing explains it.
    adding_up = chosen if verdict == "named" else ranking[:1]
    explained_bic = sum(c.delta_bic for c in adding_up)
    explained_chi2 = sum(c.delta_chi2 for c in adding_up) * base.reduced_chi2 / dof
    if not chosen:  # what was set aside is no answer, so the flight as it is has to be judged
        before = nominal
    remaining_chi2 = before.cost / dof - base.chi2 - explained_chi2
    if chosen and excess_chi2 <= 0.0 and explained_chi2 > NO_EXCESS_SIGMAS * error:
        # So much would show as an excess over the baseline: the baseline has it too.
        verdict, chosen = "none", ()
    if chosen and remaining_chi2 > max(EXCESS_SIGMAS * error, MAX_REMAINING_SHARE * excess_chi2):
        verdict, chosen = "outside", ()
    elif not chosen and excess_chi2 > EXCESS_SIGMAS * error:
        verdict = "outside"
    generic = _best_generic(base, windows, before, adding_up, bool(chosen), progress)
    distance_squared, n_prior = _prior_distance(base, adding_up[-1].result or before)
    mahalanobis = distance_squared / n_prior
    needed = max(threshold, GENERIC_MARGIN * explained_bic)
    is_generic_better = (
        _evidence_by_birge_ratio(base, windows, generic, generic) > GENERIC_EVIDENCE
        and (not chosen or _evidence_over(base, windows, generic, adding_up) > needed)
        and _is_new(base, windows, generic)  # no excess over the baseline, no "outside"
    )
    # Parameters that moved so far may imitate any effect, unless that is little compared with what
    # the effect itself explains.
    if is_generic_better or (
        mahalanobis > MAX_MAHALANOBIS and distance_squared > FORMULA_ERROR * explained_bic
    ):
        verdict, chosen = "outside", ()
    return Naming(
        verdict,
        chosen,
        tuple(ranking),
        threshold,
        excess_chi2,
        remaining_chi2,
        generic,
        mahalanobis,
        nominal,
        windows,
        prepared,
    )


def _rivals(
    best: EffectCandidate, others: Sequence[EffectCandidate]
) -> tuple[EffectCandidate, ...]:
    """The others within very strong evidence of the best, but for those that it is part of."""
    near = (c for c in others if c.delta_bic > best.delta_bic - VERY_STRONG_EVIDENCE)
    return tuple(c for c in near if best.effect.name not in c.effect.contains)


def _lower_strained_rivals(
    base: NominalModel,
    windows: Windows,
    ranking: list[EffectCandidate],
    threshold: float,
) -> list[EffectCandidate]:
    """The ranking without ambiguity by an effect that only a changed aircraft could have.

    Of several within very strong evidence, each is judged by its own fit: those whose evidence over
    the squared Birge ratio of their parameters is below the threshold rank by that.
    """
    while ranking[0].delta_bic > threshold and (rivals := _rivals(ranking[0], ranking[1:])):
        evidence = {
            c.effect.name: _evidence_by_birge_ratio(base, windows, c, c)
            for c in (ranking[0], *rivals)
        }
        lower = {name: e for name, e in evidence.items() if e <= threshold}
        if not lower:
            break
        ranking = sorted(
            (replace(c, delta_bic=lower.get(c.effect.name, c.delta_bic)) for c in ranking),
            key=lambda c: -c.delta_bic,
        )
    return ranking


def _evidence_over(
    base: NominalModel,
    windows: Windows,
    generic: EffectCandidate,
    named: Sequence[EffectCandidate],
) -> float:
    """Evidence for a generic effect over named ones that explain the same, by the largest factor.

    Not the difference of their evidence over the nominal model, since the variance factors differ,
    which say how often each is seen by chance, not which fits better.
    """
    gained = generic.delta_chi2 - sum(c.delta_chi2 for c in named)
    penalty = bic_penalty(generic.effect, windows) + SELECTION_PENALTY
    penalty -= sum(bic_penalty(c.effect, windows) for c in named)
    factor = max(base.inflation.get(c.effect.name, 1.0) for c in (generic, *named))
    return gained / factor - penalty


def _evidence_between(
    base: NominalModel, windows: Windows, one: EffectCandidate, other: EffectCandidate
) -> float:
    """Evidence for one effect over another that explains the same, by the larger factor."""
    factor = max(base.inflation.get(c.effect.name, 1.0) for c in (one, other))
    penalty = bic_penalty(one.effect, windows) - bic_penalty(other.effect, windows)
    return (one.delta_chi2 - other.delta_chi2) / factor - penalty


def _evidence_of_change(base: NominalModel, windows: Windows, found: EffectCandidate) -> float:
    """Evidence for an effect in the flight alone over the same effect in both flights."""
    change = change_over_baseline(base, windows, found)
    return change / base.inflation.get(found.effect.name, 1.0)


def change_over_baseline(base: NominalModel, windows: Windows, found: EffectCandidate) -> float:
    """Chi2 by which an effect in the flight alone beats the same effect in both flights.

    With the effect in both, the baseline flight is fitted anew, all parameters of the aircraft free
    and the effect's own near those that the flight has, to their standard deviation; then the
    flight, with the effect as it came out, under the prior of that aircraft on another day.
    Likelihood ratio of two models of equal size [Wilks 1938].

    Args:
        base: the nominal model, with the baseline flight.
        windows: of the flight under test.
        found: the effect as fitted in full to them.

    Returns:
        In units of the reduced chi2; infinite for an effect that was only scanned.
    """
    if found.result is None:
        return float("inf")
    mine = [p.name for p in found.effect.parameters]
    amplitudes = [p.name for p in found.effect.amplitudes]
    sigma = uncertainty(found.result, windows, base.prior).sigma
    near = {name: max(sigma.get(name, 0.0), 1e-9) for name in amplitudes}
    weak = base.weak or Prior({}, {})
    both = Prior({**weak.mean, **found.values}, {**weak.sigma, **near})
    model = base.result.model.with_effect(found.effect).with_values(found.values)
    first = fit(
        model.with_fixed(found.effect.shape), base.windows, base.result.initial_states,
        prior=both, iterations=15,
    )  # fmt: skip
    values = {name: first.model.values[name] for name in model.names}
    pull = sum(((values[n] - found.values[n]) / s) ** 2 for n, s in near.items())
    # The aircraft's parameters alone, for this size of the effect.
    of_aircraft = [k for k, i in enumerate(first.free) if model.names[i] not in mine]
    conditional = replace(
        first, free=tuple(first.free[k] for k in of_aircraft),
        parameter_jacobian=first.parameter_jacobian[..., of_aircraft],
    )  # fmt: skip
    prior, *_ = drift_prior(conditional, base.windows, weak)
    second = fit(
        found.result.model.with_values(values).with_fixed(mine), windows,
        found.result.initial_states, prior=prior, iterations=15,
    )  # fmt: skip
    in_both = first.cost - pull + second.cost
    return (in_both - base.result.cost - found.result.cost) / base.reduced_chi2


def _best_generic(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    named: Sequence[EffectCandidate],
    is_chosen: bool,
    progress: Progress,
) -> EffectCandidate:
    """The generic effect that explains most, fitted in full where it could decide.

    That is where it may exceed the named ones, or is taken as real and none of them was chosen.
    """
    best = _scan(base, windows, before, available_generic_effects(before.model), progress)[0]
    may_exceed = best.delta_bic > sum(c.delta_bic for c in named) or (
        best.delta_chi2 > sum(c.delta_chi2 for c in named)
    )
    if may_exceed or (best.delta_bic > GENERIC_EVIDENCE and not is_chosen):
        best = _fit_effect(base, windows, before, best, progress)
    return replace(best, delta_bic=best.delta_bic - SELECTION_PENALTY)


def _prior_distance(base: NominalModel, result: FitResult) -> tuple[float, int]:
    """Squared Mahalanobis distance of the parameters from their prior, and their number.

    Near 1 each on another day of the same aircraft; large for another aircraft, or for an effect
    that the parameters imitate.
    """
    rows, mean = prior_rows(result.model, result.free, base.prior)
    n_prior = max(int(np.count_nonzero(rows.any(axis=1))), 1)
    distance = rows @ (result.model.vector[list(result.free)] - mean)
    return float(np.sum(distance**2)) / base.prior_inflation, n_prior


def _evidence_by_birge_ratio(
    base: NominalModel, windows: Windows, found: EffectCandidate, last: EffectCandidate
) -> float:
    """Evidence for an effect where parameters have moved further than another day explains.

    With every effect in the model they should lie within their prior. Where they do not, the
    nominal model errs by more than it says, and what the effect gains is divided by their squared
    Mahalanobis distance per parameter, the square of the Birge ratio [Birge 1932].

    Args:
        base: the nominal model.
        windows: of the flight.
        found: the effect.
        last: the one that was added last, with the fit of them all.
    """
    if last.result is None:
        return found.delta_bic
    distance_squared, n_prior = _prior_distance(base, last.result)
    penalty = bic_penalty(found.effect, windows)
    if found.effect in GENERIC_EFFECTS:
        penalty += SELECTION_PENALTY
    return (found.delta_bic + penalty) / max(1.0, distance_squared / n_prior) - penalty


def _add_further_effects(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    first: EffectCandidate,
    catalogue: Sequence[Effect],
    threshold: float,
    progress: Progress,
) -> tuple[EffectCandidate, ...]:
    """The first effect and up to two more; a second one alone where it explains both."""
    chosen: tuple[EffectCandidate, ...] = (first,)
    while len(chosen) < MAX_EFFECTS:
        further = _find_further_effect(base, windows, chosen, catalogue, threshold, progress)
        if further is None or further.result is None:
            return chosen
        if len(chosen) == 1:
            confidence = uncertainty(further.result, windows, base.prior)
            values = further.result.model.values
            sizes = [confidence.interval(p.name, values[p.name]) for p in first.effect.amplitudes]
            if not any(low * high > 0.0 for low, high in sizes):
                alone = _fit_effect(base, windows, before, further, progress)
                if _evidence_between(base, windows, alone, first) > 0.0:
                    return (alone,)
        chosen = (*chosen, further)
        if len(chosen) == 2:
            chosen = _exchange_first(base, windows, before, chosen, catalogue, progress)
    return chosen


def _exchange_first(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    pair: tuple[EffectCandidate, ...],
    catalogue: Sequence[Effect],
    progress: Progress,
) -> tuple[EffectCandidate, ...]:
    """The pair, or its second effect with the one that goes best with it.

    The first was chosen alone, and may have explained a part of both.
    """
    first, second = pair
    alone = _fit_effect(base, windows, before, second, progress)
    if alone.result is None:
        return pair
    rest = _effects_beside((alone,), alone.result, catalogue)
    best = _rank(base, windows, alone.result, rest, progress)[0]
    if best.effect.name == first.effect.name or best.result is None:
        return pair
    exchanged = replace(best, delta_chi2=best.delta_chi2 + alone.delta_chi2)
    given = replace(first, delta_chi2=first.delta_chi2 + second.delta_chi2)
    better = _evidence_between(base, windows, exchanged, given) > VERY_STRONG_EVIDENCE
    return (alone, best) if better else pair


def _find_further_effect(
    base: NominalModel,
    windows: Windows,
    chosen: tuple[EffectCandidate, ...],
    catalogue: Sequence[Effect],
    threshold: float,
    progress: Progress,
) -> EffectCandidate | None:
    """One more effect, where it explains more than an error in the formula of one that was found.

    An effect that acts on the same as one of those (a lag beside a delay) would be that error.
    """
    last = chosen[-1].result
    if last is None:
        return None
    rest = _effects_beside(chosen, last, catalogue)
    if not rest:
        return None
    if _scan(base, windows, last, rest, progress)[0].delta_bic < threshold:
        return None
    best, *others = _rank(base, windows, last, rest, progress)
    needed = max(threshold, *(_formula_error(base, c, best.effect) for c in chosen))
    if len(chosen) > 1:  # a third effect must show in the chi2 that two leave
        needed = max(needed, VISIBLE_SIGMAS * np.sqrt(2.0 * degrees_of_freedom(windows, last)))
    evidence = _evidence_by_birge_ratio(base, windows, best, best)
    if evidence <= needed or not _is_new(base, windows, best):
        return None
    return None if any(_is_new(base, windows, c) for c in _rivals(best, others)) else best


def _effects_beside(
    chosen: Sequence[EffectCandidate], result: FitResult, catalogue: Sequence[Effect]
) -> list[Effect]:
    """Effects that may act beside those of a fit: none that act on the same as one of them."""
    return [
        e
        for e in catalogue
        if all(e.acts_on != c.effect.acts_on for c in chosen)
        and not any(p.name in result.model.values for p in e.parameters)
    ]


def _is_new(base: NominalModel, windows: Windows, found: EffectCandidate) -> bool:
    """Whether an effect is in the flight alone rather than in both flights."""
    return _evidence_of_change(base, windows, found) >= _needed_change(base, found)


def _needed_change(base: NominalModel, found: EffectCandidate) -> float:
    """Evidence of a change that an effect in both flights cannot have.

    An error of its formula leaves residuals in either flight that differ, so that an aircraft which
    stalls in both seems to stall a little more in one.
    """
    evidence = found.delta_chi2 / base.inflation.get(found.effect.name, 1.0)
    return max(VERY_STRONG_EVIDENCE, FORMULA_ERROR * evidence)


def _formula_error(base: NominalModel, found: EffectCandidate, other: Effect) -> float:
    """Evidence that an error in the formula of a found effect may lend to another one."""
    # What the nominal model lacked is a load, and says nothing about wind, time or the camera.
    was_completed = (
        len(base.result.model.effects) > len(base.found.model.effects)
        and not found.effect.is_kinematic
    )
    if set(other.acts_on) & set(found.effect.acts_on):
        share = COMPLETED_FORMULA_ERROR if was_completed else FORMULA_ERROR
    else:
        share = COMPLETED_UNRELATED_ERROR if was_completed else UNRELATED_FORMULA_ERROR
    return share * found.delta_chi2


def _rank(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    catalogue: Sequence[Effect],
    progress: Progress,
    known: Sequence[EffectCandidate] = (),
    tolerance: float = 0.1,
) -> list[EffectCandidate]:
    """Linear scan of every effect, then full fits of the best, from an earlier round if known.

    Of the forms of an effect the one that scans best is fitted; the next one too, where that is not
    identifiable.
    """
    earlier = {c.effect.parameters: c for c in known if c.result is not None}
    forms = _scan_forms(base, windows, before, catalogue, progress)
    open_ = _best_forms(forms)
    other_forms = [c for c in forms if c not in open_]
    fitted: list[EffectCandidate] = []
    while open_:
        best = max((c.delta_bic for c in fitted), default=-np.inf)
        next_best = open_[0].delta_bic
        enough = len(fitted) >= REFITS or next_best < HOPELESS_SHARE * best
        hopeless = enough and next_best < best - VERY_STRONG_EVIDENCE
        if hopeless or next_best < -VERY_STRONG_EVIDENCE:
            break
        initial_guess = open_.pop(0)
        candidate = _fit_effect(
            base,
            windows,
            before,
            initial_guess,
            progress,
            earlier.get(initial_guess.effect.parameters),
            tolerance,
        )
        others = [c for c in other_forms if c.effect.name == candidate.effect.name]
        if candidate.is_identifiable or not others:
            fitted.append(candidate)
        else:
            other_forms.remove(others[0])
            open_ = sorted([*open_, others[0]], key=lambda c: -c.delta_bic)
    return _best_first(base, windows, [*fitted, *open_])


def _best_first(
    base: NominalModel, windows: Windows, candidates: Sequence[EffectCandidate]
) -> list[EffectCandidate]:
    """Candidates by their evidence; those with very strong evidence by that over each other.

    Variance factors say how often an effect is seen by chance, not which of two fits better. So the
    best is the one that no other fitted one exceeds, and the evidence of the others is at most its
    own less what it has over them.
    """
    ranking = sorted(candidates, key=lambda c: -c.delta_bic)
    strong = [c for c in ranking if c.delta_bic > VERY_STRONG_EVIDENCE]
    fitted = [c for c in strong if c.result is not None]
    if len(strong) < 2 or not fitted:
        return ranking
    best = fitted[0]
    for other in fitted[1:]:
        if _evidence_between(base, windows, other, best) > 0.0:
            best = other
    rest = [c for c in ranking if c is not best]
    for k, other in enumerate(rest):
        if other.delta_bic > VERY_STRONG_EVIDENCE:
            behind = best.delta_bic - _evidence_between(base, windows, best, other)
            rest[k] = replace(other, delta_bic=min(other.delta_bic, behind))
    return [best, *sorted(rest, key=lambda c: -c.delta_bic)]


def _scan(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    catalogue: Sequence[Effect],
    progress: Progress,
) -> list[EffectCandidate]:
    """Linear evidence of every effect at its best scan point, best first; one form per name."""
    return _best_forms(_scan_forms(base, windows, before, catalogue, progress))


def _best_forms(candidates: Sequence[EffectCandidate]) -> list[EffectCandidate]:
    """Of the forms of each effect the best; in the order given, best first."""
    best: dict[str, EffectCandidate] = {}
    for candidate in candidates:
        best.setdefault(candidate.effect.name, candidate)
    return list(best.values())


def _scan_forms(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    catalogue: Sequence[Effect],
    progress: Progress,
) -> list[EffectCandidate]:
    """Linear evidence of every form of every effect at its best scan point, best first."""
    progress("scanning effects")
    reduced = SchurComplement.of(before, base.prior, base.reduced_chi2)
    best: dict[tuple[Parameter, ...], EffectCandidate] = {}
    for tried in sensitivities(
        before.model, windows, before.initial_states, list(effect_variants(catalogue, windows))
    ):
        effect, score = tried.variant.effect, reduced.score(tried)
        evidence = score.delta_chi2 / base.inflation.get(effect.name, 1.0)
        delta_bic = evidence - bic_penalty(effect, windows)
        form = effect.parameters
        if form not in best or delta_bic > best[form].delta_bic:
            best[form] = EffectCandidate(effect, delta_bic, score.delta_chi2, score.values, None)
    return sorted(best.values(), key=lambda c: -c.delta_bic)


def _fit_effect(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    initial_guess: EffectCandidate,
    progress: Progress,
    earlier: EffectCandidate | None = None,
    tolerance: float = 0.1,
) -> EffectCandidate:
    """Fit an effect in full, from the scan's values or from an earlier fit."""
    effect = initial_guess.effect
    progress(f"fitting {effect.name}")
    bounds = {p.name: p for p in effect.parameters}
    values = {
        n: float(np.clip(v, bounds[n].low, bounds[n].high)) for n, v in initial_guess.values.items()
    }
    model, initial_states = (
        before.model.with_effect(effect).with_values(values),
        before.initial_states,
    )
    if earlier is not None and earlier.result is not None:
        model, initial_states = earlier.result.model, earlier.result.initial_states
    result = fit(
        model, windows, initial_states, prior=base.prior, iterations=15, tolerance=tolerance,
        shrink=[p.name for p in effect.amplitudes],
    )  # fmt: skip
    if result.cost > before.cost:  # the linear step was too long: start from a tenth of it
        small = model.with_values({p.name: 0.1 * values[p.name] for p in effect.amplitudes})
        result = fit(
            small,
            windows,
            before.initial_states,
            prior=base.prior,
            iterations=15,
            tolerance=tolerance,
        )
    # At size zero the effect is the model without it: a fit that ended worse has found nothing.
    gained = max(before.cost - result.cost, 0.0) / base.reduced_chi2
    found = {p.name: result.model.values[p.name] for p in effect.parameters}
    delta_bic = gained / base.inflation.get(effect.name, 1.0) - bic_penalty(effect, windows)
    is_identifiable = _is_identifiable(effect, result, windows, base)
    return EffectCandidate(
        effect,
        delta_bic if is_identifiable else min(delta_bic, 0.0),
        gained,
        found,
        result,
        is_identifiable,
    )


def _is_identifiable(
    effect: Effect, result: FitResult, windows: Windows, base: NominalModel
) -> bool:
    """Whether no shape parameter of the fit is on a bound and no essential one may be zero."""
    values = result.model.values
    shape = (p for p in effect.parameters if p.name in effect.shape)
    if any(not p.low + 1e-6 < values[p.name] < p.high - 1e-6 for p in shape):
        return False
    if not effect.essential:
        return True
    confidence = uncertainty(result, windows, base.prior)
    return all(
        low * high > 0.0
        for low, high in (confidence.interval(name, values[name]) for name in effect.essential)
    )


def fit_flight(base: NominalModel, prepared: PreparedTable) -> tuple[Windows, FitResult]:
    """Fit the nominal model under its prior to a flight, with robust weights.

    Windows in which the model diverges, from the first guess as from where the fit ends, are left
    out if they are at most MAX_DIVERGING of all: terms that the baseline flight showed within its
    own angles may be far off beyond them.

    Returns:
        The flight in windows as long as the baseline's, and the fit.
    """
    model = base.result.model
    unweighted = cut_windows(prepared.flights, model, base.window_s)
    rows, interval = unweighted.nodes.shape[1], float(np.median(np.diff(unweighted.nodes)))
    initial_states, residual = fit_initial_states(
        model, unweighted, unweighted.initial_guess[:, : model.n_states]
    )
    robust = robust_weights(residual, unweighted, base.noise)
    weighted = unweighted.scale_weights(robust / base.noise.deviation(rows, interval))
    first = fit(model, weighted, initial_states, prior=base.prior, tolerance=1.0)
    kept = np.flatnonzero(np.logical_not(has_diverged(first.residual)))
    if (1.0 - MAX_DIVERGING) * len(unweighted) <= len(kept) < len(unweighted):
        unweighted, weighted = select_windows(unweighted, kept), select_windows(weighted, kept)
        states = first.initial_states[kept]
        first = fit(first.model, weighted, states, prior=base.prior, tolerance=1.0)
    return _update_weights(base, unweighted, first, first)


def _update_weights(
    base: NominalModel, windows: Windows, before: FitResult, best: FitResult
) -> tuple[Windows, FitResult]:
    """Robust weights from the best model's residuals, and the nominal model fitted with them.

    The nominal model's fit begins from both, and the better end counts: what a fit with an effect
    finds in the other parameters is no evidence for that effect.
    """
    unweighted = base.with_measurement_weights(windows)
    _, residual = fit_initial_states(best.model, unweighted, best.initial_states)
    robust = robust_weights(residual, unweighted, base.noise)
    weighted = whiten(unweighted.scale_weights(robust), base.noise)
    again = fit(before.model, weighted, before.initial_states, prior=base.prior)
    if best is before:
        return weighted, again
    shared = {name: best.model.values[name] for name in before.model.names}
    other = fit(before.model.with_values(shared), weighted, best.initial_states, prior=base.prior)
    return weighted, min(again, other, key=lambda result: result.cost)
