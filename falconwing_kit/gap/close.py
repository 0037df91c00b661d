"""Closing the gap: named effects -> their onset and course in the flight, their sizes, the
prediction error with them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from falconwing_kit.aircraft.effect import Effect, LoadsFunction
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array
from falconwing_kit.core.flight_table import FlightTable, slice_time
from falconwing_kit.gap.baseline import (
    VERY_STRONG_EVIDENCE,
    NominalModel,
    Progress,
    bic_penalty,
)
from falconwing_kit.gap.evidence import (
    MIN_EIGENVALUE,
    EffectVariant,
    SchurComplement,
    sensitivities,
)
from falconwing_kit.gap.linear_response import linear_response
from falconwing_kit.gap.name import EffectCandidate, Naming, name_effect, without_incidents
from falconwing_kit.sysid.fit import FitResult, fit, prior_rows
from falconwing_kit.sysid.score import BLOCK_S, PredictionScore, score, split_blocks
from falconwing_kit.sysid.shooting import Windows, finite_differences, select_windows
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty

ONSET = "acts_since"  # parameter of an effect with an onset: it acts from this time on [s]
# Parameter of an effect with a second time: it stops then, or has grown to its full size [s].
END = {"on-off": "acts_until", "ramp": "acts_fully_from"}
ONSET_CANDIDATES = 5  # effects that may have an onset: the best of those that act all along
MIN_AFTER_ONSET_S = 8.0  # of flight after the onset: four windows, fewer do not support a name
# Standard deviation, as a share of the size, by which a load or command in another aircraft differs
# from its formula here. On 15 sizes of development flights of foreign aircraft (seeds 43000, 44000)
# the intervals hold 12 at 0, 14 at 3 %, 15 at 5 %; wind, delay and camera are kinematics and exact.
FORMULA_DEVIATION = 0.05
LIKELIHOOD_DROP = 3.84  # of twice the log likelihood at the ends of a 95 % interval [Wilks 1938]
MAX_BOUNDARIES = 60  # begins and ends of a course that a scan tries
MAX_ONSET_ITERATIONS = 4  # fits at improving onset times
ONSET_TOLERANCE = 0.1  # chi2 gained by another onset time; below, the search has converged
DIVERGED_RESIDUAL = 1e6  # [sigma] of a prediction that diverged

Course = Literal["step", "on-off", "ramp"]  # of an effect's size over the time


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
    course: Course = "step"  # "on-off": it stopped at `end`; "ramp": it grew until `end`
    end: float | None = None  # on the flight's clock [s]; None for a step, which has no end
    end_low95: float | None = None
    end_high95: float | None = None


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
        for named_effect in naming.chosen
        for name, size in _sizes(base, naming, named_effect).items()
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
    effect = candidate.effect
    sizes = {}
    for p in effect.parameters:
        value = last.model.values[p.name]
        low, high = confidence.interval(p.name, value)
        if not effect.is_kinematic and p.name not in effect.shape:
            half = float(np.hypot(high - value, 1.96 * FORMULA_DEVIATION * value))
            low, high = value - half, value + half
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
    the flight after that time is named again, with all effects. Where there is none, incidents such
    as one stall are no unknown effect (`without_incidents`).

    Returns:
        The verdict, and the onset; None where the effect acts all along or that is not clear.

    Raises:
        InputError: the flight cannot be used.
    """
    naming = name_effect(base, flight, catalogue, progress)
    if naming.verdict == "none":
        return naming, None
    since = _name_since_onset(base, flight, naming, catalogue, progress)
    return since or (without_incidents(base, naming, catalogue, progress), None)


def _name_since_onset(
    base: NominalModel,
    flight: FlightTable,
    naming: Naming,
    catalogue: Sequence[Effect],
    progress: Progress,
) -> tuple[Naming, Onset | None] | None:
    """The naming of the time since an effect's onset, and that; None where none is clear."""
    progress("since when")
    tried = _onset_candidates(base, naming)
    onset = find_onset(base, naming.windows, naming.before, tried)
    if onset is not None:
        onset = find_course(base, naming.windows, naming.before, tried, onset)
    # As find_onset counts, without the factors for error that windows share.
    evidence = [c.delta_chi2 - bic_penalty(c.effect, naming.windows) for c in naming.chosen]
    first, generic = naming.ranking[0], naming.generic
    explained = max(
        first.delta_chi2 - bic_penalty(first.effect, naming.windows),
        sum(evidence) if naming.verdict == "named" else 0.0,
        generic.delta_chi2 - bic_penalty(generic.effect, naming.windows),
    )
    if onset is None or onset.delta_bic < explained + naming.threshold:
        return None
    later = _time_in_effect(flight, onset)
    if later.duration < MIN_AFTER_ONSET_S:
        return None
    again = name_effect(base, later, catalogue, progress)
    if again.verdict not in ("named", "ambiguous"):
        return None
    if again.chosen[0].effect.name != onset.effect.name:
        onset = find_onset(base, naming.windows, naming.before, again.chosen[:1])
        if onset is not None:
            onset = find_course(base, naming.windows, naming.before, again.chosen[:1], onset)
    return again, onset


def _onset_candidates(base: NominalModel, naming: Naming) -> list[EffectCandidate]:
    """The effects that explain most with one onset, by linear evidence.

    Not those that explain most all along: the parameters may take up half of an effect there.
    """
    windows, before = _join_segments(base, naming.windows, naming.before)
    if len(windows) < 4:
        return list(naming.ranking[:ONSET_CANDIDATES])
    steps = _scan_courses(base, windows, before, naming.ranking, ("step",)).get("step", [])
    best = sorted(steps, key=lambda c: -c.delta_bic)[:ONSET_CANDIDATES]
    by_name = {c.effect.name: c for c in naming.ranking}
    return [by_name[c.effect.name] for c in best]


def _time_in_effect(flight: FlightTable, onset: Onset) -> FlightTable:
    """The part of a flight in which an effect acts, after a ramp if enough of it is left."""
    if onset.course == "on-off" and onset.end is not None:
        return slice_time(flight, onset.time, onset.end)
    if onset.course == "ramp" and onset.end is not None:
        after = slice_time(flight, onset.end, np.inf)
        if after.duration >= MIN_AFTER_ONSET_S:
            return after
    return slice_time(flight, onset.time, np.inf)


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
        The onset, or None where no effect can have one (delay, lag and camera cannot), or where the
        flight diverges with it.
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
        result = fit(
            model, windows, initial_states, prior=base.prior, iterations=15,
            shrink=[p.name for p in gated.amplitudes],
        )  # fmt: skip
        onset_times, cost_at_onset = _profile_likelihood(base, windows, result)
        if not np.isfinite(cost_at_onset).any():  # the flight diverges with it at any time
            return None
        time, initial_states = float(onset_times[np.argmin(cost_at_onset)]), result.initial_states
        if cost_at_onset.min() > result.cost - ONSET_TOLERANCE * base.reduced_chi2:
            break
        model = (
            before.model.with_effect(gated)
            .with_values({**result.model.values, ONSET: time})
            .with_fixed([ONSET])
        )
    # 95 % interval from the profile likelihood, one row wider on each side.
    inside = np.flatnonzero(
        cost_at_onset < cost_at_onset.min() + LIKELIHOOD_DROP * base.reduced_chi2
    )
    low = onset_times[max(inside[0] - 1, 0)]
    high = onset_times[min(inside[-1] + 1, len(onset_times) - 1)]
    clock, price = float(windows.flights[0].t[0]), float(np.log(windows.count))
    delta_bic = (before.cost - result.cost) / base.reduced_chi2 - price * len(gated.parameters)
    effect = next(c.effect for c in found if c.effect.name == gated.name)
    return Onset(effect, clock + time, clock + float(low), clock + float(high), delta_bic, result)


def _join_segments(
    base: NominalModel, windows: Windows, before: FitResult
) -> tuple[Windows, FitResult]:
    """The segments of a flight that was cut where frames were missing, joined to one flight again.

    Times of all windows then count from the start of the flight, as an onset's time does.

    Returns:
        The windows of the joined flight, and the model fitted to them again; both unchanged where
        nothing was cut.
    """
    if len(windows.flights) == 1:
        return windows, before
    segments = windows.flights
    joined_t, joined_pose, joined_commands, joined_states, joined_derivatives = (
        np.concatenate([getattr(segment, name) for segment in segments])
        for name in ("t", "pose", "commands", "state_estimate", "state_derivatives")
    )
    joined_flight = replace(
        segments[0],
        t=joined_t,
        pose=joined_pose,
        commands=joined_commands,
        state_estimate=joined_states,
        state_derivatives=joined_derivatives,
    )
    segment_starts = np.array([segment.t[0] - segments[0].t[0] for segment in segments])
    window_offsets = segment_starts[windows.flight][:, None]
    joined_windows = replace(
        windows, nodes=windows.nodes + window_offsets, edges=windows.edges + window_offsets,
        flight=np.zeros_like(windows.flight), flights=(joined_flight,),
    )  # fmt: skip
    joined_fit = fit(before.model, joined_windows, before.initial_states, prior=base.prior)
    return joined_windows, joined_fit


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
    tried = []
    for known in found:
        if known.effect.has_onset:
            gated = with_onset(known.effect, float(first), float(last))
            shape = {name: known.values[name] for name in known.effect.shape}
            usual = {p.name: p.start for p in known.effect.parameters} | shape
            tried += [
                EffectVariant(gated, {**usual, ONSET: float(t)}) for t in windows.nodes[1:, 0]
            ]
    best: EffectCandidate | None = None
    price = float(np.log(windows.count))
    response = linear_response(before.model, windows, before.initial_states)
    for seen in response.sensitivities(tried):  # one after the other, since they are many
        scored, gated = reduced.score(seen), seen.variant.effect
        delta_bic = scored.delta_chi2 - len(gated.parameters) * price
        if best is None or delta_bic > best.delta_bic:
            best = EffectCandidate(gated, delta_bic, scored.delta_chi2, scored.values, None)
    return best


def find_course(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    found: Sequence[EffectCandidate],
    onset: Onset,
) -> Onset:
    """The onset, or an effect that stops again or grows as a ramp, where that explains more.

    The score test for every pair of a begin and an end, as sums over windows; a course of two times
    replaces the onset where its full fit, less the penalty of the second time, beats that of the
    onset by very strong evidence.

    Args:
        base: the nominal model.
        windows: W windows of the flight.
        before: the nominal model fitted to them under its prior.
        found: the effects, as they explain the flight when they act all along.
        onset: what `find_onset` found for them.
    """
    windows, before = _join_segments(base, windows, before)
    if len(windows) < 4:
        return onset
    scanned = {
        course: max(of_effects, key=lambda c: c.delta_bic)
        for course, of_effects in _scan_courses(base, windows, before, found).items()
    }
    step = scanned.pop("step", None)
    if step is None or not scanned:
        return onset
    course, guess = max(scanned.items(), key=lambda item: item[1].delta_bic)
    if guess.delta_bic < step.delta_bic + VERY_STRONG_EVIDENCE:
        return onset
    fitted = _fit_course(base, windows, before, course, guess)
    if fitted is None or fitted.delta_bic <= onset.delta_bic + VERY_STRONG_EVIDENCE:
        return onset
    return fitted


def _scan_courses(
    base: NominalModel,
    windows: Windows,
    before: FitResult,
    found: Sequence[EffectCandidate],
    courses: Sequence[Course] = ("step", "on-off", "ramp"),
) -> dict[Course, list[EffectCandidate]]:
    """The best step, on-off and ramp of each effect by linear evidence; those that fit in.

    An effect that is on in some windows alone, or in each by a share g_w, has the sensitivity
    g_w E_w, so all sums of the score test are weighted sums over the windows.
    """
    reduced = SchurComplement.of(before, base.prior, base.reduced_chi2)
    K, starts, ends = reduced.K, windows.nodes[:, 0], windows.nodes[:, -1]
    A = np.einsum("wif,wig->fg", K, K, optimize=True) + reduced.prior
    A += np.diag(1e-9 * np.diag(A) + 1e-30)
    price, count = float(np.log(windows.count)), len(windows)
    # Shorter, an on-off does not support a name, and a ramp is a step inside a window.
    shortest = max(2, int(np.ceil(MIN_AFTER_ONSET_S / max(np.median(np.diff(starts)), 1e-3))))
    # Begins and ends at the starts of windows, of a long flight not of all.
    at = np.unique(np.linspace(0, count - 1, min(count, MAX_BOUNDARIES)).astype(int))
    pairs: dict[Course, list[tuple[int, int]]] = {
        "step": [(i, count) for i in at],
        "on-off": [(i, j) for i in at for j in at if j >= i + shortest],
        "ramp": [(i, j) for i in at for j in at if j >= i + shortest],
    }
    middle = 0.5 * (starts + ends)
    shares: dict[Course, list[Array]] = {
        "step": [(starts >= starts[i]) * 1.0 for i, _ in pairs["step"]],
        "on-off": [
            ((starts >= starts[i]) & (starts < starts[j])) * 1.0 for i, j in pairs["on-off"]
        ],
        "ramp": [
            np.clip((middle - starts[i]) / (starts[j] - starts[i]), 0.0, 1.0)
            for i, j in pairs["ramp"]
        ],
    }
    best: dict[Course, list[EffectCandidate]] = {}
    tried = []
    for known in found:
        shape = {name: known.values[name] for name in known.effect.shape}
        usual = {p.name: p.start for p in known.effect.parameters} | shape
        if known.effect.has_onset:
            tried.append(EffectVariant(known.effect, usual))
    for whole in sensitivities(before.model, windows, before.initial_states, tried):
        effect, usual = whole.variant.effect, whole.variant.values
        E = whole.derivative - reduced.Q @ (reduced.Q.transpose(0, 2, 1) @ whole.derivative)
        B = np.einsum("wif,wik->wfk", K, E, optimize=True)
        D = np.einsum("wik,wil->wkl", E, E, optimize=True)
        pull = np.einsum("wik,wi->wk", E, reduced.residual, optimize=True)
        for course in courses:
            if not shares[course]:
                continue
            share = np.stack(shares[course])  # (P, W)
            B_g, D_g = np.tensordot(share, B, 1), np.tensordot(share**2, D, 1)
            pull_g = share @ pull
            S = D_g - np.einsum("pfk,pfl->pkl", B_g, np.linalg.solve(A, B_g), optimize=True)
            one = np.eye(D_g.shape[1])  # what the parameters imitate gets no evidence
            S += MIN_EIGENVALUE * np.einsum("pkk,kl->pkl", D_g, one) + 1e-12 * one
            step = -np.linalg.solve(S, pull_g[..., None])[..., 0]
            delta_chi2 = -np.sum(pull_g * step, axis=1) / base.reduced_chi2
            top = int(np.argmax(delta_chi2))
            times = 1 if course == "step" else 2
            delta_bic = float(delta_chi2[top]) - (len(effect.parameters) + times) * price
            i, j = pairs[course][top]
            names = [p.name for p in effect.amplitudes]
            values = {**usual, **dict(zip(names, step[top].tolist(), strict=True))}
            values[ONSET] = float(starts[i])
            if course in END:
                values[END[course]] = float(starts[j])
            found_chi2 = float(delta_chi2[top])
            candidate = EffectCandidate(effect, delta_bic, found_chi2, values, None)
            best.setdefault(course, []).append(candidate)
    return best


def _fit_course(
    base: NominalModel, windows: Windows, before: FitResult, course: Course, guess: EffectCandidate
) -> Onset | None:
    """Fit an on-off or a ramp in full; of its two times the one moves that gains more.

    None where the flight diverges with it at any time.
    """
    first, last = float(windows.nodes[0, 0]), float(windows.nodes[-1, -1])
    gated = with_course(guess.effect, course, first, last)
    bounds = {p.name: p for p in gated.parameters}
    values = {n: float(np.clip(v, bounds[n].low, bounds[n].high)) for n, v in guess.values.items()}
    names, states = (ONSET, END[course]), before.initial_states
    intervals: dict[str, tuple[float, float]] = {}
    for _ in range(2 * MAX_ONSET_ITERATIONS):
        model = before.model.with_effect(gated).with_values(values).with_fixed(names)
        result = fit(
            model, windows, states, prior=base.prior, iterations=15,
            shrink=[p.name for p in gated.amplitudes],
        )  # fmt: skip
        values = {p.name: result.model.values[p.name] for p in gated.parameters}
        states = result.initial_states
        better: dict[str, tuple[float, float]] = {}  # time -> cost and value where it is least
        for name in names:
            times, cost = _profile_likelihood(base, windows, result, name)
            if not np.isfinite(cost).any():
                return None
            inside = np.flatnonzero(cost < cost.min() + LIKELIHOOD_DROP * base.reduced_chi2)
            intervals[name] = (
                float(times[max(inside[0] - 1, 0)]),
                float(times[min(inside[-1] + 1, len(times) - 1)]),
            )
            if cost.min() < result.cost - 0.1 * base.reduced_chi2:
                better[name] = float(cost.min()), float(times[np.argmin(cost)])
        if not better:
            break
        moved = min(better, key=lambda name: better[name])  # the other one after a refit
        values[moved] = better[moved][1]
    clock, price = float(windows.flights[0].t[0]), float(np.log(windows.count))
    delta_bic = (before.cost - result.cost) / base.reduced_chi2 - price * len(gated.parameters)
    fitted, (since, end) = result.model.values, (ONSET, END[course])
    low, high = (
        {name: clock + intervals.get(name, (fitted[name],) * 2)[k] for name in (since, end)}
        for k in (0, 1)
    )
    return Onset(
        guess.effect, clock + fitted[since], low[since], high[since], delta_bic, result,
        course, clock + fitted[end], low[end], high[end],
    )  # fmt: skip


def with_onset(effect: Effect, first: float, last: float) -> Effect:
    """The same effect with an onset in [first, last] [s], its parameter `acts_since`."""
    since = Parameter(ONSET, 0.5 * (first + last), first, last, "s", "time of onset")
    return _with_gate(effect, (since,), lambda time, K: time >= K.acts_since)


def with_course(effect: Effect, course: Course, first: float, last: float) -> Effect:
    """The same effect with a course over the time, its times in [first, last] [s].

    A step has `acts_since`; an on-off acts from `acts_since` to `acts_until`; a ramp grows evenly
    from nothing at `acts_since` to its full size at `acts_fully_from`, and keeps it.
    """
    if course == "step":
        return with_onset(effect, first, last)
    since = Parameter(ONSET, first, first, last, "s", "time of onset")
    end = Parameter(END[course], last, first, last, "s", "time of its end or of its full size")

    def on_off(time: Any, K: Any) -> Any:
        return (time >= K.acts_since) & (time < K.acts_until)

    def ramp(time: Any, K: Any) -> Any:
        length = np.maximum(K.acts_fully_from - K.acts_since, 1e-3)
        return np.clip((time - K.acts_since) / length, 0.0, 1.0)

    return _with_gate(effect, (since, end), on_off if course == "on-off" else ramp)


def _with_gate(
    effect: Effect, times: tuple[Parameter, ...], gate: Callable[[Any, Any], Any]
) -> Effect:
    """The same effect times gate(time, K), 0 to 1; its times are shape parameters."""
    loads, loads_of, wind, command_map = (
        effect.loads,
        effect.loads_of,
        effect.wind_field,
        effect.command_map,
    )

    def gate_loads(function: LoadsFunction) -> LoadsFunction:
        return lambda air, K: _scale(function(air, K), gate(air.time, K))

    def gated_wind(px: Any, py: Any, height: Any, time: Any, K: Any) -> Any:
        return _scale(wind(px, py, height, time, K), gate(time, K)) if wind else ()

    def gated_map(t: Array, commands: Array, K: Any) -> Array:
        if command_map is None:
            return commands
        share = np.asarray(gate(t, K), dtype=np.float64)[:, None]
        return commands + share * (command_map(t, commands, K) - commands)

    return replace(
        effect,
        parameters=(*effect.parameters, *times),
        loads=gate_loads(loads) if loads else None,
        loads_of=(lambda terms: gate_loads(loads_of(terms))) if loads_of else None,
        wind_field=gated_wind if wind else None,
        command_map=gated_map if command_map else None,
        shape=(*effect.shape, *(p.name for p in times)),
    )


def _scale(parts: tuple[Any, ...], share: Any) -> Any:
    return tuple(part if type(part) is float and part == 0.0 else share * part for part in parts)


def _profile_likelihood(
    base: NominalModel, windows: Windows, result: FitResult, name: str = ONSET
) -> tuple[Array, Array]:
    """Cost over a time of the effect at every row within two windows, all else free to first order.

    Returns:
        times (C,) [s] and the cost of each (C,).
    """
    here, at = result.model.values[name], result.model.names.index(name)
    rows = np.unique(windows.nodes[1:-1])
    reach = 2.0 * float(windows.nodes[0, -1] - windows.nodes[0, 0])
    times = np.unique(np.append(rows[np.abs(rows - here) < reach], here))
    # A ramp differs between its two times as well.
    ramp = [
        result.model.values[n] for n in (ONSET, END["ramp"]) if END["ramp"] in result.model.values
    ]
    low, high = min([times[0], *ramp]), max([times[-1], *ramp])
    near = np.flatnonzero((windows.nodes[:, -1] > low) & (windows.nodes[:, 0] < high))
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
    cost = cost - np.sum(gradient.T * np.linalg.solve(normal, gradient.T), axis=0)
    return times, np.nan_to_num(cost, nan=np.inf)  # a time at which the flight diverges
