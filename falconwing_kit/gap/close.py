"""Closing the gap: named effects -> their onset, their sizes, the prediction error with them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, LoadsFunction
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array
from falconwing_kit.core.flight_table import FlightTable, slice_time
from falconwing_kit.gap.baseline import NominalModel, Progress
from falconwing_kit.gap.evidence import EffectVariant, SchurComplement, sensitivities
from falconwing_kit.gap.name import EffectCandidate, Naming, name_effect
from falconwing_kit.sysid.fit import FitResult, fit, prior_rows
from falconwing_kit.sysid.score import BLOCK_S, PredictionScore, score, select_windows, split_blocks
from falconwing_kit.sysid.shooting import Windows, finite_differences
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty

ONSET = "acts_since"  # parameter of an effect with an onset: it acts from this time on [s]
ONSET_CANDIDATES = 5  # effects that may have an onset: the best of those that act all along
MIN_AFTER_ONSET_S = 8.0  # of flight after the onset: four windows, fewer do not support a name
LIKELIHOOD_DROP = 3.84  # of twice the log likelihood at the ends of a 95 % interval [Wilks 1938]
MAX_ONSET_ITERATIONS = 4  # fits at improving onset times
DIVERGED_RESIDUAL = 1e6  # [sigma] of a prediction that diverged


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of an effect with its 95 % interval."""

    value: float
    low95: float
    high95: float
    unit: str
    meaning: str


@dataclass(frozen=True)
class Onset:
    """When an effect set in."""

    effect: Effect
    time: float  # on the flight's clock [s]
    low95: float
    high95: float
    delta_bic: float  # evidence over the nominal model, less the penalty of parameters and time
    result: FitResult  # with the effect from then on: its size is estimated from the time after


@dataclass(frozen=True)
class GapClosure:
    """Prediction errors before and after, two seconds ahead on held-out time."""

    before: PredictionScore  # the nominal model
    after: PredictionScore  # with the effect, fitted to the rest of the flight under the prior
    calm: PredictionScore  # the baseline's own held-out time: what noise and model error leave
    # Without the effect, parameters free under the prior: what another day would explain.
    before_with_free_parameters: PredictionScore
    # With the effect, the aircraft's parameters fixed at the baseline's values.
    after_with_fixed_parameters: PredictionScore
    parameters: dict[str, ParameterEstimate]  # of the effect, from the fit to the whole flight
    model: Model | None  # with the effect, fitted to the whole flight; None: nothing named
    confidence: Uncertainty | None  # of that model
    seen: bool  # True where the flight was too short to hold out any of it
    held_out: np.ndarray  # which windows were scored


def close_gap(base: NominalModel, naming: Naming) -> GapClosure:
    """Add the named effects to the model and score it on held-out time.

    About 30 % of the flight is held out, in blocks of 10 s (shorter on a short flight). Of an
    ambiguous set the first alternative is added; where nothing is named, after equals before.
    """
    calm_model = base.result.model
    plain = base.with_measurement_weights(naming.windows)
    fitted, scored = _split(plain)
    seen = len(scored) == 0
    if seen:
        fitted = scored = np.arange(len(plain))
    apart = select_windows(plain, scored)

    def refit(model: Model, whole: FitResult) -> PredictionScore:
        result = fit(
            model,
            select_windows(naming.windows, fitted),
            whole.initial_states[fitted],
            prior=base.prior,
            iterations=15,
        )
        return score(result.model, apart, whole.initial_states[scored])

    before = score(calm_model, apart, naming.before.initial_states[scored])
    before_with_free_parameters = refit(calm_model, naming.before)
    calm = _baseline_score(base)
    last = (
        naming.chosen[0 if naming.verdict == "ambiguous" else -1].result if naming.chosen else None
    )
    if last is None:
        return GapClosure(
            before, before, calm, before_with_free_parameters, before, {}, None, None, seen, scored
        )
    after = refit(last.model, last)
    fixed = last.model.with_values(calm_model.values).with_fixed(calm_model.names)
    confidence = uncertainty(last, naming.windows, base.prior)
    sizes = {
        name: size
        for candidate in naming.chosen
        for name, size in _sizes(base, naming, candidate).items()
    }
    return GapClosure(
        before,
        after,
        calm,
        before_with_free_parameters,
        refit(fixed, last),
        sizes,
        last.model,
        confidence,
        seen,
        scored,
    )


def _baseline_score(base: NominalModel) -> PredictionScore:
    """Score of the completed nominal model on the baseline flight's own held-out time."""
    found = base.found
    known = found.held_out or found.train
    if found.held_out is None or base.result.model.names == found.model.names:
        return known
    kept = found.held_out_index
    rest = np.setdiff1d(np.arange(len(found.windows)), kept)
    trained = fit(
        base.result.model, select_windows(base.windows, rest), base.result.initial_states[rest]
    )
    return score(
        trained.model, select_windows(found.windows, kept), base.result.initial_states[kept]
    )


def _sizes(
    base: NominalModel, naming: Naming, candidate: EffectCandidate
) -> dict[str, ParameterEstimate]:
    """An effect's parameters from the last fit that has them (with all effects that were named)."""
    last = naming.chosen[-1].result if naming.verdict == "named" else candidate.result
    if last is None:
        return {}
    confidence = uncertainty(last, naming.windows, base.prior)
    sizes = {}
    for p in candidate.effect.parameters:
        value = last.model.values[p.name]
        low, high = confidence.interval(p.name, value)
        sizes[p.name] = ParameterEstimate(value, low, high, p.unit, p.meaning)
    return sizes


def _split(windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Windows for fitting and for scoring, in blocks so short that there are four at least."""
    begins = windows.nodes[:, 0]
    return split_blocks(windows, block_s=min(BLOCK_S, max(float(np.ptp(begins)) / 3.01, 1.0)))


def name_with_onset(
    base: NominalModel,
    flight: FlightTable,
    catalogue: Sequence[Effect] = CATALOGUE,
    progress: Progress = lambda stage: None,
) -> tuple[Naming, Onset | None]:
    """Name the effect of a flight; where it has a clear onset, name it on the time after that.

    An effect in part of a flight is diluted over the whole, and the parameters absorb some of it.
    So where an effect with an onset explains the flight far better than any effect does all along,
    the flight after that time is named again, with all effects.

    Returns:
        The verdict, and the onset; None where the effect acts all along or that is not clear.

    Raises:
        InputError: the flight cannot be used.
    """
    naming = name_effect(base, flight, catalogue, progress)
    if naming.verdict == "none":
        return naming, None
    progress("since when")
    onset = find_onset(base, naming.windows, naming.before, naming.ranking[:ONSET_CANDIDATES])
    named = sum(c.delta_bic for c in naming.chosen if naming.verdict == "named")
    explained = max(naming.ranking[0].delta_bic, named, naming.generic.delta_bic)
    if onset is None or onset.delta_bic < explained + naming.threshold:
        return naming, None
    later = slice_time(flight, onset.time, np.inf)
    if later.duration < MIN_AFTER_ONSET_S:
        return naming, None
    again = name_effect(base, later, catalogue, progress)
    if again.verdict not in ("named", "ambiguous"):
        return naming, None
    if again.chosen[0].effect.name != onset.effect.name:
        onset = find_onset(base, naming.windows, naming.before, again.chosen[:1])
    return again, onset


def find_onset(
    base: NominalModel, windows: Windows, before: FitResult, found: Sequence[EffectCandidate]
) -> Onset | None:
    """The effect with an onset that explains a flight best, and the time of its onset.

    Likelihood over effect and time: the score test at the start of every window, with parameters
    and initial states eliminated; then, around the best, at every row from a full fit, repeated
    until the time no longer changes. Only one onset is considered, and no end.

    Args:
        base: the nominal model.
        windows: W windows of the flight.
        before: the nominal model fitted to them under its prior.
        found: the effects, as they explain the flight when they act all along.

    Returns:
        The onset, or None where no effect can have one (delay, lag and camera cannot).
    """
    windows, before = _join_segments(base, windows, before)
    initial_guess = _scan_onsets(base, windows, before, found)
    if initial_guess is None:
        return None
    gated, bounds = initial_guess.effect, {p.name: p for p in initial_guess.effect.parameters}
    values = {
        n: float(np.clip(v, bounds[n].low, bounds[n].high)) for n, v in initial_guess.values.items()
    }
    model, initial_states = (
        before.model.with_effect(gated).with_values(values).with_fixed([ONSET]),
        before.initial_states,
    )
    for _ in range(MAX_ONSET_ITERATIONS):
        result = fit(model, windows, initial_states, prior=base.prior, iterations=15)
        times, cost = _profile_likelihood(base, windows, result)
        time, initial_states = float(times[np.argmin(cost)]), result.initial_states
        if cost.min() > result.cost - 0.1 * base.reduced_chi2:
            break
        model = (
            before.model.with_effect(gated)
            .with_values({**result.model.values, ONSET: time})
            .with_fixed([ONSET])
        )
    # 95 % interval from the profile likelihood, one row wider on each side.
    inside = np.flatnonzero(cost < cost.min() + LIKELIHOOD_DROP * base.reduced_chi2)
    low, high = times[max(inside[0] - 1, 0)], times[min(inside[-1] + 1, len(times) - 1)]
    clock, price = float(windows.flights[0].t[0]), float(np.log(windows.count))
    delta_bic = (before.cost - result.cost) / base.reduced_chi2 - price * len(gated.parameters)
    effect = next(c.effect for c in found if c.effect.name == gated.name)
    return Onset(effect, clock + time, clock + float(low), clock + float(high), delta_bic, result)


def _join_segments(
    base: NominalModel, windows: Windows, before: FitResult
) -> tuple[Windows, FitResult]:
    """The segments of a flight that was cut where frames were missing, as one flight again."""
    if len(windows.flights) == 1:
        return windows, before
    flights = windows.flights
    t, pose, commands, state_estimate, rates = (
        np.concatenate([getattr(f, name) for f in flights])
        for name in ("t", "pose", "commands", "state_estimate", "state_derivatives")
    )
    whole = replace(
        flights[0],
        t=t,
        pose=pose,
        commands=commands,
        state_estimate=state_estimate,
        state_derivatives=rates,
    )
    later = np.array([f.t[0] - flights[0].t[0] for f in flights])[windows.flight][:, None]
    joined = replace(
        windows, nodes=windows.nodes + later, edges=windows.edges + later,
        flight=np.zeros_like(windows.flight), flights=(whole,),
    )  # fmt: skip
    return joined, fit(before.model, joined, before.initial_states, prior=base.prior)


def _scan_onsets(
    base: NominalModel, windows: Windows, before: FitResult, found: Sequence[EffectCandidate]
) -> EffectCandidate | None:
    """The best effect and the best window to start it at, by linear evidence."""
    if len(windows) < 3:
        return None
    reduced, first, last = (
        SchurComplement.of(before, base.prior, base.reduced_chi2),
        windows.nodes[0, 0],
        windows.nodes[-1, -1],
    )
    best: EffectCandidate | None = None
    for known in found:
        effect = known.effect
        if not effect.has_onset:
            continue
        gated = with_onset(effect, float(first), float(last))
        usual = {
            p.name: known.values[p.name] if p.name in effect.shape else p.start
            for p in effect.parameters
        }
        tried = [EffectVariant(gated, {**usual, ONSET: float(t)}) for t in windows.nodes[1:, 0]]
        for score_ in map(
            reduced.score, sensitivities(before.model, windows, before.initial_states, tried)
        ):
            delta_bic = score_.delta_chi2 - len(gated.parameters) * float(np.log(windows.count))
            if best is None or delta_bic > best.delta_bic:
                best = EffectCandidate(gated, delta_bic, score_.delta_chi2, score_.values, None)
    return best


def with_onset(effect: Effect, first: float, last: float) -> Effect:
    """The same effect with an onset in [first, last] [s], its parameter `acts_since`."""
    since = Parameter(ONSET, 0.5 * (first + last), first, last, "s", "time of onset")
    loads, loads_of, wind, command_map = (
        effect.loads,
        effect.loads_of,
        effect.wind_field,
        effect.command_map,
    )

    def gated_wind(px: Any, py: Any, height: Any, time: Any, K: Any) -> Any:
        return _gate(wind(px, py, height, time, K), time >= K.acts_since) if wind else ()

    def gated_map(t: Array, commands: Array, K: Any) -> Array:
        acting = (t >= K.acts_since)[:, None]
        return np.where(acting, command_map(t, commands, K), commands) if command_map else commands

    return replace(
        effect,
        parameters=(*effect.parameters, since),
        loads=_gate_loads(loads) if loads else None,
        loads_of=(lambda terms: _gate_loads(loads_of(terms))) if loads_of else None,
        wind_field=gated_wind if wind else None,
        command_map=gated_map if command_map else None,
        shape=(*effect.shape, ONSET),
    )


def _gate_loads(loads: LoadsFunction) -> LoadsFunction:
    return lambda air, K: _gate(loads(air, K), air.time >= K.acts_since)


def _gate(parts: tuple[Any, ...], on: Any) -> Any:
    return tuple(part if type(part) is float and part == 0.0 else on * part for part in parts)


def _profile_likelihood(
    base: NominalModel, windows: Windows, result: FitResult
) -> tuple[Array, Array]:
    """Cost over the onset time at every row within two windows, all else free to first order.

    Returns:
        times (C,) [s] and the cost of each (C,).
    """
    here, at = result.model.values[ONSET], result.model.names.index(ONSET)
    rows = np.unique(windows.nodes[1:-1])
    reach = 2.0 * float(windows.nodes[0, -1] - windows.nodes[0, 0])
    times = np.unique(np.append(rows[np.abs(rows - here) < reach], here))
    near = np.flatnonzero((windows.nodes[:, -1] > times[0]) & (windows.nodes[:, 0] < times[-1]))
    # Residuals at each onset time, all other values as fitted, in the windows where they differ.
    values = np.repeat(result.model.vector[:, None], len(times), axis=1)
    values[at] = times
    differences = finite_differences(
        result.model, select_windows(windows, near), result.initial_states[near], values
    )
    differences = np.nan_to_num(differences, posinf=DIVERGED_RESIDUAL, neginf=-DIVERGED_RESIDUAL)
    # Eliminate the initial states: keep what is outside the span of their derivatives Q.
    reduced = SchurComplement.of(result, base.prior, base.reduced_chi2)
    Q, K, rest = reduced.Q[near], reduced.K, reduced.residual
    after = (
        rest[near]
        + differences
        - np.einsum("win,cwn->cwi", Q, np.einsum("win,cwi->cwn", Q, differences))
    )
    # Then the parameters, by one Gauss-Newton step under the prior: cost - g' N^-1 g.
    known, mean = prior_rows(result.model, result.free, base.prior)
    pull = known @ (result.model.vector[list(result.free)] - mean)
    shift = np.einsum("wif,cwi->cf", K[near], after - rest[near], optimize=True)
    gradient = shift + np.einsum("wif,wi->f", K, rest, optimize=True) + known.T @ pull
    normal = np.einsum("wif,wig->fg", K, K, optimize=True) + reduced.prior
    # A column may be zero: ground effect at a height of 50 m.
    normal += np.diag(1e-9 * np.diag(normal) + 1e-30)
    cost = (
        np.sum(after**2, axis=(1, 2)) - np.sum(rest[near] ** 2) + np.sum(rest**2) + np.sum(pull**2)
    )
    return times, np.asarray(
        cost - np.sum(gradient.T * np.linalg.solve(normal, gradient.T), axis=0)
    )
