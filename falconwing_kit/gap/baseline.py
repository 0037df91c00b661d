"""Baseline flight -> nominal model: the aircraft, its pose noise, and the false-alarm level.

The nominal model is identified on the baseline flight and completed with generic effects that this
aircraft has and the terms lack; its prior is wide enough for another day.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from falconwing_kit.aircraft.effect import STANDING, Effect, standing_effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS, GENERIC_LOADS
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.terms import THRUST_CURVE
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.evidence import (
    SchurComplement,
    ScoreTest,
    Sensitivities,
    effect_variants,
    sensitivities,
)
from falconwing_kit.gap.noise import PoseNoiseModel, find_pose_noise, robust_weights, whiten
from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_initial_states, prior_rows
from falconwing_kit.sysid.identify import (
    MAX_REDUCED_CHI2,
    MAX_TURN_SHARE,
    Identification,
    extended_models,
    identify,
    weak_prior,
)
from falconwing_kit.sysid.score import score, score_constant_turn
from falconwing_kit.sysid.shooting import Windows, jacobian
from falconwing_kit.sysid.uncertainty import ordinary_size, uncertainty

Progress = Callable[[str], None]

COEFFICIENT_DRIFT = 0.01  # relative change of an aircraft's coefficients from day to day
TIMING_DRIFT_S = 0.002  # the same for delay and lag, since radio and servo stay the same
VERY_STRONG_EVIDENCE = 10.0  # "very strong" on the scale of Kass & Raftery 1995
# Evidence that the best of so many generic effects has by chance.
SELECTION_PENALTY = 2.0 * float(np.log(len(GENERIC_EFFECTS)))
GENERIC_EVIDENCE = 50.0  # evidence above which a generic effect is taken as real
MAX_ADDED_EFFECTS = 6  # effects that a nominal model may need
# Evidence above which an effect of the baseline flight becomes part of the model: little, since
# what is missing there would be named on the next flight.
ADDITION_EVIDENCE = 15.0
ADDITION_TRIALS = 4  # effects fitted in full before the completion ends
FORM_STEPS = 6  # of a fit with more terms, from the one without them
START_TOLERANCE = 1.0  # chi2; of the fits from several starts, the best of which goes on
ADDITION_TOLERANCE = 2.0  # chi2; the completed model is fitted once more


@dataclass(frozen=True)
class NominalModel:
    """What the baseline flight shows: model, prior, pose noise and false-alarm levels."""

    found: Identification
    noise: PoseNoiseModel
    result: FitResult  # fitted with whitened noise
    windows: Windows
    chi2: float  # per degree of freedom, with whitened noise
    prior: Prior  # for another flight of the same aircraft
    false_alarm_level: float  # largest evidence of any effect on a third of this flight
    generic_false_alarm_level: float  # the same for generic effects
    # Effect -> variance factor of its evidence, at least 1: error that the rows of a window share.
    inflation: Mapping[str, float] = field(default_factory=dict)
    drift: Mapping[str, float] = field(default_factory=dict)  # standard deviation, day to day
    weak: Prior | None = None  # the prior of its own fit
    # Variance factor of its parameters, as `inflation`: the prior is given without it.
    prior_inflation: float = 1.0

    @property
    def reduced_chi2(self) -> float:
        """Chi2 per degree of freedom that noise and model error leave, at least 1."""
        return max(1.0, self.chi2)

    @property
    def window_s(self) -> float:
        """Length of its windows [s]."""
        return float(np.median(np.diff(self.windows.nodes)) * self.windows.nodes.shape[1])

    @property
    def parameter_prior(self) -> Prior:
        """The prior with its variance factor, for evidence that is not divided by one."""
        wider = float(np.sqrt(self.prior_inflation))
        return replace(
            self.prior, sigma={name: wider * size for name, size in self.prior.sigma.items()}
        )

    def with_measurement_weights(self, windows: Windows) -> Windows:
        """The same windows weighted by the pose noise alone: no robust weights, no whitening."""
        return replace(
            windows,
            whitening=None,
            weight=np.where(windows.weight > 0.0, 1.0 / self.found.sigma, 0.0),
        )


def identify_baseline(
    calm: FlightTable | Sequence[FlightTable],
    progress: Progress = lambda stage: None,
    catalogue: Sequence[Effect] = CATALOGUE,
    start: Model | None = None,
    sigma: Array | None = None,
) -> NominalModel:
    """Identify the baseline flight, its pose noise, and the evidence that effects have by chance.

    Args:
        calm: a flight with nothing changed, or several of one aircraft.
        progress: called with the name of each stage.
        catalogue: the effects that will be tried.
        start: the model that the fit starts from; None scales one to the flight's speed.
        sigma: (6,) noise of the poses [m, rad] if known.

    Raises:
        InputError: the flight cannot be used, or the model does not describe it.
    """
    progress("calm flight")
    tables = [calm] if isinstance(calm, FlightTable) else list(calm)
    return build_nominal_model(identify(tables, model=start, sigma=sigma), catalogue, progress)


def build_nominal_model(
    found: Identification,
    catalogue: Sequence[Effect] = CATALOGUE,
    progress: Progress = lambda stage: None,
) -> NominalModel:
    """The same from a finished identification of the baseline flight, of any form of model.

    Raises:
        InputError: the model does not describe the flight, or a control input of the log is
            reversed.
    """
    if found.reversed_channels:
        raise InputError(
            next(w for w in found.warnings if w.startswith(found.reversed_channels[0]))
        )
    start = with_thrust_curve(found.model)
    weak = weak_prior(start)
    noise = find_pose_noise(found.result, found.fitted_windows)
    windows = whiten(found.fitted_windows, noise)
    result = fit(start, windows, found.result.initial_states, prior=weak)
    # With whitened noise an aircraft may turn out far quicker than identification found it.
    weak = weak_prior(result.model)
    result, weak = _extend_form(found.model, result, windows, weak)
    if noise.has_discrepancy and (found.held_out or found.train).chi2 > MAX_REDUCED_CHI2:
        progress("other starts")
        noise, windows, result, weak = _fit_from_other_starts(found, noise, result, weak)
    completed_fit, tried = _complete_model(result, windows, catalogue, weak, progress)
    if completed_fit is not result:  # what the model lacked had been taken for noise
        noise, windows = _update_noise(found, noise, completed_fit, windows, weak)
        result, tried = _complete_model(
            fit(completed_fit.model, windows, completed_fit.initial_states, prior=weak),
            windows, catalogue, weak, progress,
        )  # fmt: skip
    _require_description(found, result)
    progress("what chance finds")
    return calibrate_nominal_model(found, noise, result, windows, tried, weak)


def with_thrust_curve(model: Model) -> Model:
    """The model with thrust that also grows with throttle squared, free from zero on.

    Thrust falls with speed, and grows with throttle in proportion or faster [Beard & McLain, eq.
    4.13; Phillips, Mechanics of Flight, ch. 2]: kTV and kTT are not below zero. A flight at one
    throttle hardly separates thrust and drag, and would put them where no propeller can be.

    The model as it is where it has that already, or where a part of its thrust is fixed.
    """
    fixed = {p.name for p in model.parameters if p.high <= p.low}
    present = {term.name for term in model.terms}
    if THRUST_CURVE.name in present or fixed & {"kT", "kTV"}:
        return model
    curved = model.with_terms(THRUST_CURVE)
    parameters = tuple(
        replace(p, low=0.0) if p.name in ("kTV", "kTT") else p for p in curved.parameters
    )
    return replace(curved, parameters=parameters).with_values(
        {"kTV": max(curved.values["kTV"], 0.0)}
    )


def _extend_form(
    identified: Model, result: FitResult, windows: Windows, weak: Prior
) -> tuple[FitResult, Prior]:
    """The fit with cross moments or an attitude hold, where the flight shows these; and its prior.

    Terms that every aircraft of a kind has come before effects: what they leave out in a calm
    flight would look like an effect in a livelier one. Terms smaller than the drift from day to day
    only fit the error of the integration, and are left out.

    Args:
        identified: the model that identification found.
        result: the fit of that with the thrust curve.
        windows: what it was fitted to.
        weak: its prior.
    """
    best = result
    for form in extended_models(identified):
        model = with_thrust_curve(form)
        model = model.with_values({**model.values, **result.model.values})
        added = len(model.names) - len(result.model.names)
        extended = fit(
            model, windows, result.initial_states, prior=weak_prior(model), iterations=FORM_STEPS,
            tolerance=START_TOLERANCE,
        )  # fmt: skip
        level = max(1.0, result.cost / degrees_of_freedom(windows, result))
        price = ADDITION_EVIDENCE + added * np.log(max(windows.count, 2))
        if extended.cost + level * price < best.cost and _exceeds_drift(extended.model, result):
            best = extended
    if best is result:
        return result, weak
    prior = weak_prior(best.model)
    return fit(best.model, windows, best.initial_states, prior=prior), prior


def _exceeds_drift(model: Model, without: FitResult) -> bool:
    """Whether any coefficient that the model has more is larger than its drift from day to day."""
    added = [p for p in model.parameters if p.name not in without.model.names]
    return any(abs(model.values[p.name]) > COEFFICIENT_DRIFT * ordinary_size(p, 0.0) for p in added)


def _fit_from_other_starts(
    found: Identification, noise: PoseNoiseModel, result: FitResult, weak: Prior
) -> tuple[PoseNoiseModel, Windows, FitResult, Prior]:
    """The best fit from several starts under the model discrepancy; noise, windows, fit, prior.

    Where gusts and unmodelled dynamics leave far more than the pose noise, a fit without a
    discrepancy lets the initial state of each window explain them and ends with hardly any damping.
    Under the discrepancy each start is fitted anew: what identification found, the values that it
    began with, and those with an extended model. The least cost with the BIC penalty wins.
    """
    begun = found.model.with_values({p.name: p.start for p in found.model.parameters})
    rows, interval = found.windows.nodes.shape[1], float(np.median(np.diff(found.windows.nodes)))
    marginal = found.windows.scale_weights(1.0 / noise.deviation(rows, interval))
    white = whiten(found.windows, noise)
    best, best_prior, least = result, weak, np.inf
    for start in (found.model, begun, *extended_models(begun)):
        start = with_thrust_curve(start)
        prior = weak_prior(start)
        guess = found.windows.initial_guess[:, : start.n_states]
        states, _ = fit_initial_states(start, marginal, guess)
        first = fit(start, marginal, states, prior=prior, iterations=10, tolerance=START_TOLERANCE)
        again = fit(
            first.model, white, first.initial_states, prior=prior, tolerance=START_TOLERANCE
        )
        cost = again.cost + len(again.free) * np.log(max(white.count, 2))
        if cost < least:
            best, best_prior, least = again, prior, cost
    noise, windows = _update_noise(found, noise, best, white, best_prior)
    final = fit(best.model, windows, best.initial_states, prior=best_prior)
    return noise, windows, final, best_prior


def _update_noise(
    found: Identification, noise: PoseNoiseModel, result: FitResult, windows: Windows, weak: Prior
) -> tuple[PoseNoiseModel, Windows]:
    """Pose noise anew from the residuals of a better model, and the windows whitened by it.

    Args:
        found: the baseline flight, identified.
        noise: as it was.
        result: the better model's fit.
        windows: what it was fitted to.
        weak: its prior.
    """
    if not noise.has_discrepancy:
        again = fit(result.model, found.fitted_windows, result.initial_states, prior=weak)
        noise = find_pose_noise(again, found.fitted_windows)
        return noise, whiten(found.fitted_windows, noise)
    # Under a discrepancy a fit without whitening would be another model: take this one as it is.
    residual, *_ = jacobian(result.model, found.windows, result.initial_states, ())
    weighted = found.windows.scale_weights(robust_weights(residual, found.windows, noise))
    residual, of_parameters, of_states = jacobian(
        result.model, weighted, result.initial_states, result.free
    )
    here = replace(
        result, residual=residual, parameter_jacobian=of_parameters,
        initial_state_jacobian=of_states,
    )  # fmt: skip
    noise = find_pose_noise(here, weighted)
    return noise, whiten(weighted, noise)


def _require_description(found: Identification, result: FitResult) -> None:
    """Raise InputError where the completed model does not describe the baseline flight either.

    What it leaves is model discrepancy, which costs evidence and no more, so that chi2 need not be
    one; but two seconds ahead it must err at most half as much as a constant turn.
    """
    if found.describes_flight:
        return
    completed = score(result.model, found.windows, result.initial_states)
    turn = score_constant_turn(found.windows, completed.initial_states)
    if (
        completed.position_m <= MAX_TURN_SHARE * turn.position_m
        and completed.attitude_deg <= MAX_TURN_SHARE * turn.attitude_deg
    ):
        return
    raise InputError(
        f"{found.names[0]}: expected a calm flight that the base model describes, got chi2 per "
        f"degree of freedom {completed.chi2:.1f}, noise alone gives 1, and errors 2 s ahead of "
        f"{completed.position_m:.2f} m and {completed.attitude_deg:.1f} deg where a constant turn "
        f"has {turn.position_m:.2f} m and {turn.attitude_deg:.1f} deg; use a calm flight of the "
        "same aircraft without wind or other effects"
    )


def calibrate_nominal_model(
    found: Identification,
    noise: PoseNoiseModel,
    result: FitResult,
    windows: Windows,
    tried: Sequence[Sensitivities] | Sequence[Effect],
    weak: Prior | None = None,
) -> NominalModel:
    """The nominal model from its final fit: level, prior for another day, false-alarm levels.

    Args:
        found: the baseline flight, identified.
        noise: its pose noise.
        result: the model, fitted with whitened noise.
        windows: what it was fitted to.
        tried: the effects that will be tried, named and generic, or their sensitivities at the fit.
        weak: the prior of that fit, if any.
    """
    baseline_chi2 = result.cost / degrees_of_freedom(windows, result)
    reduced = SchurComplement.of(result, weak, max(1.0, baseline_chi2))
    tried_sensitivities = [t for t in tried if isinstance(t, Sensitivities)]
    if not tried_sensitivities:
        effects = [t for t in tried if isinstance(t, Effect)]
        tried_sensitivities = sensitivities(
            result.model, windows, result.initial_states, list(effect_variants(effects, windows))
        )
    prior, drift, factor = drift_prior(result, windows, weak)
    rows, _ = prior_rows(result.model, result.free, prior)
    factors: dict[str, list[float]] = {}
    for c in tried_sensitivities:
        factors.setdefault(c.variant.effect.name, []).append(
            reduced.inflation(c, rows.T @ rows, factor)
        )
    inflation = {name: max(1.0, float(np.median(several))) for name, several in factors.items()}
    divisor = np.array([inflation[c.variant.effect.name] for c in tried_sensitivities])
    penalty = np.array([bic_penalty(c.variant.effect, windows) for c in tried_sensitivities])
    evidence = reduced.block_delta_chi2(tried_sensitivities) / divisor[:, None]
    false_alarms = (evidence - penalty[:, None]).max(axis=1)
    named = np.array([c.variant.effect not in GENERIC_EFFECTS for c in tried_sensitivities])
    gains = (
        float(false_alarms[named].max(initial=0.0)),
        float(false_alarms[~named].max(initial=0.0)),
    )
    return NominalModel(
        found, noise, result, windows, baseline_chi2, prior, *gains, inflation, drift, weak, factor
    )


def _complete_model(
    result: FitResult,
    windows: Windows,
    catalogue: Sequence[Effect],
    weak: Prior,
    progress: Progress,
) -> tuple[FitResult, list[Sensitivities]]:
    """Add to the model what the baseline flight shows to be missing, the best effect first.

    No model is complete: a propeller has torque, a wing stalls, propeller wash acts on the
    elevator. What is missing would look like an effect on every other flight. Catalogue effects
    are added as standing ones, so that a change of them can still be named.

    Returns:
        The fit, and the sensitivities of all effects at it.
    """
    progress("what the base lacks")
    present = len(result.model.effects)
    while True:
        effects = [*catalogue, *available_generic_effects(result.model)]
        tried = sensitivities(
            result.model, windows, result.initial_states, list(effect_variants(effects, windows))
        )
        if len(result.model.effects) - present >= MAX_ADDED_EFFECTS:
            return result, tried
        reduced = SchurComplement.of(
            result, weak, max(1.0, result.cost / degrees_of_freedom(windows, result))
        )
        needed = SELECTION_PENALTY + ADDITION_EVIDENCE
        enough: dict[str, tuple[float, Sensitivities]] = {}  # the best variant of each effect
        for effect in tried:
            chi2 = reduced.score(effect).delta_chi2
            penalty = bic_penalty(effect.variant.effect, windows)
            if chi2 - penalty < needed:
                continue
            # Within very strong evidence a form from physics comes before one in proportion to a
            # variable, which at another mean of that variable would be another load.
            handicap = VERY_STRONG_EVIDENCE * (effect.variant.effect in GENERIC_LOADS)
            gain = chi2 / max(1.0, reduced.inflation(effect)) - penalty - handicap
            name = effect.variant.effect.name
            if name not in enough or gain > enough[name][0]:
                enough[name] = (gain, effect)
        for _, effect in sorted(enough.values(), key=lambda pair: -pair[0])[:ADDITION_TRIALS]:
            added = _add_to_base(result, windows, reduced.score(effect), weak)
            if added is not None and _evidence_of_addition(result, added, windows, weak) > needed:
                result = added
                break
        else:
            return result, tried


def _evidence_of_addition(
    without: FitResult, added: FitResult, windows: Windows, weak: Prior
) -> float:
    """Chi2 that a baseline flight's fit gains by an effect, over its variance factor.

    The factor is that of the full fit's residuals: the scan's, from one linear step, is far too
    large where that step does not reach what the effect explains.
    """
    level = max(1.0, added.cost / degrees_of_freedom(windows, added))
    new = [k for k, i in enumerate(added.free) if added.model.names[i] not in without.model.names]
    factor = SchurComplement.of(added, weak, level).own_inflation(new)
    return (without.cost - added.cost) / level / max(1.0, factor)


def _add_to_base(
    result: FitResult, windows: Windows, found: ScoreTest, weak: Prior
) -> FitResult | None:
    """The fit with one more effect; None where the model has it already."""
    effect, values = found.variant.effect, found.values
    if effect not in GENERIC_EFFECTS:
        effect = standing_effect(effect)
        values = {STANDING + name: value for name, value in values.items()}
    if effect.parameters[0].name in result.model.values:
        return None
    bounds = {p.name: p for p in effect.parameters}
    values = {n: float(np.clip(v, bounds[n].low, bounds[n].high)) for n, v in values.items()}
    model = result.model.with_effect(effect).with_values(values)
    return fit(
        model,
        windows,
        result.initial_states,
        prior=weak,
        iterations=10,
        tolerance=ADDITION_TOLERANCE,
        shrink=[p.name for p in effect.amplitudes],
    )


def available_generic_effects(model: Model) -> tuple[Effect, ...]:
    """The generic effects that a model does not have yet."""
    return tuple(
        effect for effect in GENERIC_EFFECTS if effect.parameters[0].name not in model.values
    )


def drift_prior(
    result: FitResult, windows: Windows, weak: Prior | None
) -> tuple[Prior, dict[str, float], float]:
    """Prior for another day: the baseline's covariance, and a percent of drift per coefficient.

    Where residuals are alike all through a window, variances are larger than white residuals make
    them. All evidence under this prior is divided by such a factor, which widens the prior as much;
    so it is given without one, lest it be counted twice.

    Returns:
        The prior, the drift alone (standard deviation of each parameter), and the variance factor.
    """
    confidence = uncertainty(result, windows, weak)
    parameters = {p.name: p for p in result.model.parameters}
    drift = np.array(
        [
            COEFFICIENT_DRIFT * ordinary_size(parameters[n], result.model.values[n])
            for n in confidence.names
        ]
    )
    timing = np.array([n in ("delay", "lag") for n in confidence.names])
    drift[timing] = TIMING_DRIFT_S
    covariance = (confidence.covariance + np.diag(drift**2)) / confidence.inflation
    sigma = np.sqrt(np.diag(covariance))
    spread = dict(zip(confidence.names, sigma.tolist(), strict=True))
    prior = Prior(dict(result.model.values), spread, covariance / np.outer(sigma, sigma))
    return prior, dict(zip(confidence.names, drift.tolist(), strict=True)), confidence.inflation


def bic_penalty(effect: Effect, windows: Windows) -> float:
    """BIC penalty of an effect's parameters: k ln(n), n measured components [Schwarz 1978]."""
    return float(len(effect.parameters) * np.log(max(windows.count, 2)))


def degrees_of_freedom(windows: Windows, result: FitResult) -> int:
    """Degrees of freedom of a fit to some windows."""
    return max(windows.count - len(windows) * result.model.n_states - len(result.free), 1)
