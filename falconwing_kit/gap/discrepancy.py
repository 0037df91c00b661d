"""Model discrepancy: a flight outside the catalogue -> a sparse equation of what its model lacks.

Forward selection from a library of one-coefficient effects in named coordinates
(`aircraft/sparse.py`) and the catalogue, then backward elimination [Klein & Morelli, Aircraft
System Identification, ch. 5: stepwise regression; Brunton, Proctor & Kutz 2016]. A step scores all
candidates by the score test of `evidence.py` with linearised responses, and refits the model with
the best in full under the prior. BIC decides how many, with a penalty for the choice among so many.

Terms are selected on the time that `close_gap` fits to and scored on the time that it holds out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.sparse import SPARSE_EFFECTS, USUAL_NAMES, formula
from falconwing_kit.core.checks import Array
from falconwing_kit.gap.baseline import (
    VERY_STRONG_EVIDENCE,
    NominalModel,
    Progress,
    bic_penalty,
    degrees_of_freedom,
)
from falconwing_kit.gap.close import GapClosure, ParameterEstimate
from falconwing_kit.gap.evidence import MIN_EIGENVALUE, EffectVariant, effect_variants
from falconwing_kit.gap.linear_response import column_slices, linear_response
from falconwing_kit.gap.measure import VARIABLES, variables_of
from falconwing_kit.gap.name import UNRELATED_FORMULA_ERROR, Naming
from falconwing_kit.gap.noise import robust_weights, whiten
from falconwing_kit.sysid.fit import FitResult, fit, prior_rows
from falconwing_kit.sysid.score import PredictionScore, score
from falconwing_kit.sysid.shooting import Windows, pose_residuals, residuals, select_windows
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty

MAX_TERMS = 4  # more are no longer an explanation
# Evidence that the best of so many candidates has by chance: twice the log of their number.
SELECTION_PENALTY = 2.0 * float(np.log(len(SPARSE_EFFECTS) + len(CATALOGUE)))
REFITS = 3  # candidates of one step that are refitted in full at most
# Fits between steps stop where a step lowers chi2 by less than this, and than this share of the
# excess that is left; the last fit is finer.
COARSE_TOLERANCE, COARSE_SHARE, FINE_TOLERANCE = 2.0, 0.02, 0.5
COARSE_ITERATIONS = 6
PLACE_BINS = 6  # of each flight variable, with equal shares of the flight
CONTRAST = 1.5  # times the mean explained per row: below, a term acts throughout


@dataclass(frozen=True)
class DiscrepancyTerm:
    """One term of the discrepancy with its coefficients."""

    effect: Effect
    equation: str  # with numbers
    parameters: dict[str, ParameterEstimate]  # from the fit to the whole flight
    resembles: str | None  # usual name of a term of this form, or None
    delta_chi2: float  # chi2 lost without it, all else refitted to first order


@dataclass(frozen=True)
class Discrepancy:
    """What the model lacks on a flight, as far as a few named terms say it."""

    terms: tuple[DiscrepancyTerm, ...]  # most evidence first
    equation: str
    where: str  # the range of a flight variable in which they explain most
    resembles: str | None
    model: Model  # nominal model and terms, fitted to the whole flight under the prior
    confidence: Uncertainty
    before: PredictionScore  # the nominal model on held-out time
    after: PredictionScore  # with the terms, fitted to the rest of the flight
    gap_closed: float  # share of the held-out excess over the baseline's level that they remove


def find_discrepancy(
    base: NominalModel,
    naming: Naming,
    closed: GapClosure,
    catalogue: Sequence[Effect] = CATALOGUE,
    progress: Progress = lambda stage: None,
) -> Discrepancy | None:
    """The sparse terms that a flight needs beyond its nominal model.

    Args:
        base: the nominal model.
        naming: the flight and its verdict, usually "outside".
        closed: what `close_gap` found without a name: held-out time, scores before and of the
            baseline.
        catalogue: effects that may be among the terms.
        progress: called with the name of each stage.

    Returns:
        The discrepancy, or None where no term has the evidence.
    """
    progress("what the model lacks")
    plain = base.with_measurement_weights(naming.windows)
    held_out = closed.held_out
    fitted = np.arange(len(plain)) if closed.seen else np.setdiff1d(np.arange(len(plain)), held_out)
    selected = _select(base, naming, select_windows(plain, fitted), fitted, catalogue)
    if selected is None:
        return None
    effects, result = selected
    # Held-out time, as close_gap scores it.
    states = naming.before.initial_states.copy()
    after = score(result.model, select_windows(plain, held_out), states[held_out])
    # The whole flight, for the coefficients and the model file.
    states[held_out], states[fitted] = after.initial_states, result.initial_states
    windows = _reweigh(base, plain, result.model, states)
    final = fit(
        result.model, windows, states, prior=base.prior, iterations=15, tolerance=FINE_TOLERANCE
    )
    confidence = uncertainty(final, windows, base.prior)
    terms = sorted(
        (_term(base, effect, final, confidence) for effect in effects), key=lambda t: -t.delta_chi2
    )
    gap = closed.before.chi2 - closed.calm.chi2
    return Discrepancy(
        tuple(terms),
        "; ".join(term.equation for term in terms),
        _where(windows, naming.before, final),
        "; ".join(dict.fromkeys(t.resembles for t in terms if t.resembles)) or None,
        final.model,
        confidence,
        closed.before,
        after,
        (closed.before.chi2 - after.chi2) / gap if gap > 0.0 else 0.0,
    )


def discrepancy_record(found: Discrepancy) -> dict[str, Any]:
    """The optional key "discrepancy" of report.json."""
    return {
        "equation": found.equation,
        "where": found.where,
        "terms": [
            {"name": name, "value": p.value, "low95": p.low95, "high95": p.high95, "unit": p.unit}
            for term in found.terms
            for name, p in term.parameters.items()
        ],
        "resembles": found.resembles,
        "gap_closed": found.gap_closed,
    }


# Selection
# --------------------------------------------------------------------------------------------------


def _select(
    base: NominalModel,
    naming: Naming,
    plain: Windows,
    fitted: np.ndarray,
    catalogue: Sequence[Effect],
) -> tuple[list[Effect], FitResult] | None:
    """Effects selected on the fitted windows, and the fit with them; None without any.

    Args:
        base: the nominal model.
        naming: its fit to the whole flight.
        plain: the fitted windows, weighted by the noise alone.
        fitted: their indices.
        catalogue: effects that may be selected beside the sparse ones.
    """
    nominal, chosen = naming.before.model, list[Effect]()
    windows = select_windows(naming.windows, fitted)
    result = _linearise(base, windows, nominal, naming.before.initial_states[fitted])
    needed, pruned = VERY_STRONG_EVIDENCE, set[str]()
    while len(chosen) < MAX_TERMS:
        level = _chi2_level(base, windows, result)
        tried = [
            v
            for v in effect_variants((*SPARSE_EFFECTS, *catalogue), windows)
            if v.effect.name not in pruned
            and not {p.name for p in v.effect.parameters} & set(result.model.values)
        ]
        for variant, values in _best_candidates(base, windows, result, tried, level, needed):
            added = _fit_with(base, windows, result, variant, values)
            gained = (result.cost - added.cost) / level
            if gained - _penalty(variant.effect, windows) > needed:
                break
        else:
            break
        # As for a second effect: more than an error of the first one's formula leaves.
        needed = max(needed, UNRELATED_FORMULA_ERROR * gained)
        with_it = [*chosen, variant.effect]
        chosen, result = _prune(base, windows, nominal, with_it, added)
        if variant.effect not in chosen:  # the best one left does not earn its penalty
            break
        # What was pruned is not tried again: two terms could replace each other without end.
        pruned |= {effect.name for effect in with_it} - {effect.name for effect in chosen}
        # Rows that the new term explains had been taken for outliers.
        windows = _reweigh(base, plain, result.model, result.initial_states)
        result = _linearise(base, windows, result.model, result.initial_states)
    if not chosen:
        return None
    return chosen, fit(
        result.model, windows, result.initial_states, prior=base.prior, tolerance=FINE_TOLERANCE
    )


def _linearise(
    base: NominalModel, windows: Windows, model: Model, initial_states: Array
) -> FitResult:
    """A fit of no steps: residuals and derivatives of a model at its values."""
    return fit(model, windows, initial_states, prior=base.prior, iterations=0)


def _best_candidates(
    base: NominalModel,
    windows: Windows,
    result: FitResult,
    tried: Sequence[EffectVariant],
    level: float,
    needed: float,
) -> list[tuple[EffectVariant, dict[str, float]]]:
    """Variants with the most linear evidence and their values after one step, best first.

    Among those within very strong evidence of the best, terms with a usual name come first.
    """
    scored = [
        (delta_chi2 - _penalty(variant.effect, windows), variant, values)
        for delta_chi2, variant, values in _scan(base, windows, result, tried, level)
    ]
    scored.sort(key=lambda row: -row[0])
    best, rows, seen = scored[0][0], [], set[str]()
    for evidence, variant, values in scored:
        if evidence > needed and variant.effect.name not in seen:
            near = evidence > best - VERY_STRONG_EVIDENCE
            usual = near and _usual_name(variant.effect) is not None
            rows.append((not usual, -evidence, variant, values))
            seen.add(variant.effect.name)
    rows.sort(key=lambda row: row[:2])
    return [(variant, values) for _, _, variant, values in rows[:REFITS]]


def _scan(
    base: NominalModel,
    windows: Windows,
    result: FitResult,
    tried: Sequence[EffectVariant],
    level: float,
) -> list[tuple[float, EffectVariant, dict[str, float]]]:
    """Score test of every variant: chi2 it would explain, and its values after one step.

    The test of `evidence.SchurComplement.score`, with what all variants share computed once.
    """
    Q, _ = np.linalg.qr(np.nan_to_num(result.initial_state_jacobian, posinf=0.0, neginf=0.0))
    rows, mean = prior_rows(result.model, result.free, base.prior)
    prior_residual = rows @ (result.model.vector[list(result.free)] - mean)
    K = _flat(_project_out(Q, result.parameter_jacobian))  # (W R, F)
    r = _flat(_project_out(Q, result.residual[..., None]))[:, 0]
    A = K.T @ K + rows.T @ rows
    A += np.diag(1e-9 * np.diag(A) + 1e-30)
    toward = np.linalg.solve(A, K.T @ r + rows.T @ prior_residual)
    found = []
    response = linear_response(result.model, windows, result.initial_states)
    for variants, derivative in response.blocks(tried):
        E = _flat(_project_out(Q, derivative))  # (W R, C)
        B, D = K.T @ E, E.T @ E
        pull, schur = E.T @ r - B.T @ toward, D - B.T @ np.linalg.solve(A, B)
        for variant, columns in zip(variants, column_slices(variants), strict=True):
            # Steps in the directions that parameters and initial states do not imitate.
            size = np.sqrt(np.maximum(np.diag(D)[columns], 1e-30))
            seen, along = np.linalg.eigh(schur[columns, columns] / np.outer(size, size))
            along = along[:, seen > MIN_EIGENVALUE] / size[:, None]
            step = -along @ ((along.T @ pull[columns]) / seen[seen > MIN_EIGENVALUE])
            names = [p.name for p in variant.effect.amplitudes]
            values = {**variant.values, **dict(zip(names, step.tolist(), strict=True))}
            found.append((float(max(-pull[columns] @ step, 0.0)) / level, variant, values))
    return found


def _project_out(Q: Array, J: Array) -> Array:
    """What is outside the span of the initial states' derivatives, window by window."""
    J = np.nan_to_num(J, posinf=0.0, neginf=0.0)
    return np.asarray(J - Q @ (Q.transpose(0, 2, 1) @ J))


def _flat(J: Array) -> Array:
    return J.reshape(-1, J.shape[-1])


def _fit_with(
    base: NominalModel,
    windows: Windows,
    result: FitResult,
    variant: EffectVariant,
    values: dict[str, float],
) -> FitResult:
    """The fit with one more effect.

    From a size of zero, so that parameters and initial states move along with it in the first
    Gauss-Newton step; where that gains nothing, from its values after the linear step alone.
    """
    bounds = {p.name: p for p in variant.effect.parameters}
    inside = {n: float(np.clip(v, bounds[n].low, bounds[n].high)) for n, v in values.items()}
    model, added = result.model.with_effect(variant.effect), result
    tolerance = COARSE_TOLERANCE + COARSE_SHARE * _excess_chi2(base, windows, result)
    for share in (0.0, 1.0):
        shrunk = {p.name: share * inside[p.name] for p in variant.effect.amplitudes}
        added = fit(
            model.with_values({**inside, **shrunk}), windows, result.initial_states,
            prior=base.prior, iterations=COARSE_ITERATIONS, tolerance=tolerance,
        )  # fmt: skip
        if result.cost - added.cost > bic_penalty(variant.effect, windows):
            break
    return added


def _prune(
    base: NominalModel,
    windows: Windows,
    nominal: Model,
    chosen: list[Effect],
    result: FitResult,
) -> tuple[list[Effect], FitResult]:
    """Remove, one after the other, terms that no longer earn their penalty."""
    while len(chosen) > 1:
        level = _chi2_level(base, windows, result)
        lost = [
            _chi2_without(base, result, effect) / level - _penalty(effect, windows)
            for effect in chosen
        ]
        weakest = int(np.argmin(lost))
        if lost[weakest] > 0.0:
            break
        chosen = [effect for i, effect in enumerate(chosen) if i != weakest]
        model = nominal
        for effect in chosen:
            model = model.with_effect(effect)
        values = {name: result.model.values[name] for name in model.names}
        result = fit(
            model.with_values(values), windows, result.initial_states, prior=base.prior,
            iterations=COARSE_ITERATIONS, tolerance=COARSE_TOLERANCE,
        )  # fmt: skip
    return chosen, result


def _chi2_without(base: NominalModel, result: FitResult, effect: Effect) -> float:
    """Chi2 lost if an effect's amplitudes were zero, all else refitted to first order [Wald 1943].

    theta' (Cov_theta)^-1 theta, with the inverse of the information matrix as covariance.
    """
    J = result.reduced_jacobian
    rows, _ = prior_rows(result.model, result.free, base.prior)
    information = np.einsum("wif,wig->fg", J, J, optimize=True) + rows.T @ rows
    names = [result.model.names[i] for i in result.free]
    mine = [names.index(p.name) for p in effect.amplitudes]
    rest = [i for i in range(len(names)) if i not in mine]
    theta = np.array([result.model.values[p.name] for p in effect.amplitudes])
    inner = information[np.ix_(rest, rest)]
    inner = inner + np.diag(1e-9 * np.diag(inner) + 1e-30)
    across = information[np.ix_(mine, rest)]
    schur = information[np.ix_(mine, mine)] - across @ np.linalg.solve(inner, across.T)
    return float(theta @ schur @ theta)


def _penalty(effect: Effect, windows: Windows) -> float:
    """BIC penalty of an effect's parameters, and that of its choice among so many."""
    return bic_penalty(effect, windows) + SELECTION_PENALTY


def _chi2_level(base: NominalModel, windows: Windows, result: FitResult) -> float:
    """Chi2 per degree of freedom that evidence is counted in.

    At least the baseline's; more while the flight leaves more, which also a missing term causes, so
    evidence is then a lower bound.
    """
    return max(base.reduced_chi2, result.cost / degrees_of_freedom(windows, result))


def _excess_chi2(base: NominalModel, windows: Windows, result: FitResult) -> float:
    """Chi2 of a fit above what the baseline's noise and model error leave, at least 0."""
    return max(result.cost - base.reduced_chi2 * degrees_of_freedom(windows, result), 0.0)


def _reweigh(base: NominalModel, plain: Windows, model: Model, states: Array) -> Windows:
    """Robust weights from a model's residuals, and the whitening of the baseline's noise."""
    residual = residuals(model, plain, states)
    return whiten(plain.scale_weights(robust_weights(residual, plain, base.noise)), base.noise)


# Words
# --------------------------------------------------------------------------------------------------


def _usual_name(effect: Effect) -> str | None:
    """What the textbooks and the catalogue call a term of this form; None for no name."""
    if effect not in SPARSE_EFFECTS:
        return effect.name
    same = dict.fromkeys(e.name for e in CATALOGUE if effect.name in e.same_form)
    return ", ".join(filter(None, (USUAL_NAMES.get(effect.name), *same))) or None


def _term(
    base: NominalModel, effect: Effect, result: FitResult, confidence: Uncertainty
) -> DiscrepancyTerm:
    values = result.model.values
    parameters = {
        p.name: ParameterEstimate(
            values[p.name], *confidence.interval(p.name, values[p.name]), p.unit, p.meaning
        )
        for p in effect.parameters
    }
    return DiscrepancyTerm(
        effect,
        _equation(effect, parameters),
        parameters,
        _usual_name(effect),
        _chi2_without(base, result, effect),
    )


def _equation(effect: Effect, parameters: dict[str, ParameterEstimate]) -> str:
    """Name, formula and numbers with their 95 % intervals."""
    symbols = [p.name for p in effect.parameters]
    text = effect.physics.removesuffix(".")
    if effect in SPARSE_EFFECTS:
        symbols = ["k"] if len(symbols) == 1 else ["k", "d"] if len(symbols) == 2 else list("abl")
        text = formula(effect)
    numbers = ", ".join(
        f"{symbol} = {p.value:.3g} {p.unit} ({p.low95:.3g} to {p.high95:.3g})".replace(" - ", " ")
        for symbol, p in zip(symbols, parameters.values(), strict=True)
    )
    return f"{effect.name}: {text}, {numbers}"


def _where(windows: Windows, before: FitResult, after: FitResult) -> str:
    """The range of the flight variable in which the terms explain most of the residuals."""
    squares = [np.sum(pose_residuals(f.residual, windows) ** 2, axis=2) for f in (before, after)]
    gain = squares[0] - squares[1]  # (W, L)
    mean = float(gain.mean())
    best, words = CONTRAST, "throughout the flight"
    if mean <= 0.0:
        return words
    for name, values in variables_of(windows).items():
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, PLACE_BINS + 1)))
        if len(edges) < 3:
            continue
        inside = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        share = [float(gain[inside == b].mean()) / mean for b in range(len(edges) - 1)]
        top = int(np.argmax(share))
        if share[top] > best:
            unit = "" if VARIABLES[name] == "-" else f" {VARIABLES[name]}"
            best, words = (
                share[top],
                f"most at {name} {edges[top]:.2g} to {edges[top + 1]:.2g}{unit}: "
                f"{share[top]:.1f} times the mean",
            )
    return words
