"""Baseline flight -> nominal model: the aircraft, its pose noise, and the false-alarm level.

The nominal model is identified on the baseline flight and completed with generic effects that this
aircraft has and the terms lack; its prior is wide enough for another day.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.evidence import SchurComplement, effect_variants, sensitivities
from falconwing_kit.gap.noise import PoseNoiseModel, find_pose_noise, whiten
from falconwing_kit.sysid.fit import FitResult, Prior, fit
from falconwing_kit.sysid.identify import Identification, identify
from falconwing_kit.sysid.shooting import Windows
from falconwing_kit.sysid.uncertainty import ordinary_size, uncertainty

Progress = Callable[[str], None]

COEFFICIENT_DRIFT = 0.01  # relative change of an aircraft's coefficients from day to day
TIMING_DRIFT_S = 0.002  # the same for delay and lag, since radio and servo stay the same
VERY_STRONG_EVIDENCE = 10.0  # "very strong" on the scale of Kass & Raftery 1995
# Evidence that the best of so many generic effects has by chance.
SELECTION_PENALTY = 2.0 * float(np.log(len(GENERIC_EFFECTS)))
GENERIC_EVIDENCE = 50.0  # evidence above which a generic effect is taken as real
MAX_GENERIC_TERMS = 6  # generic effects that a nominal model may need
MAX_BASELINE_CHI2 = 4.0  # baseline chi2 above this: not a model of this aircraft


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

    @property
    def reduced_chi2(self) -> float:
        """Chi2 per degree of freedom that noise and model error leave, at least 1."""
        return max(1.0, self.chi2)

    @property
    def window_s(self) -> float:
        """Length of its windows [s]."""
        return float(np.median(np.diff(self.windows.nodes)) * self.windows.nodes.shape[1])

    def with_measurement_weights(self, windows: Windows) -> Windows:
        """The same windows weighted by the pose noise alone: no robust weights, no whitening."""
        return replace(
            windows,
            whitening=None,
            weight=np.where(windows.weight > 0.0, 1.0 / self.found.sigma, 0.0),
        )


def identify_baseline(
    calm: FlightTable,
    progress: Progress = lambda stage: None,
    catalogue: Sequence[Effect] = CATALOGUE,
    start: Model | None = None,
) -> NominalModel:
    """Identify the baseline flight, its pose noise, and the evidence that effects have by chance.

    Args:
        calm: a flight with nothing changed.
        progress: called with the name of each stage.
        catalogue: the effects that will be tried.
        start: the model that the fit starts from; None for a 150 g aircraft.

    Raises:
        InputError: the flight cannot be used, or the model does not describe it.
    """
    progress("calm flight")
    return build_nominal_model(identify([calm], model=start), catalogue, progress)


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
    noise = find_pose_noise(found.result, found.fitted_windows)
    windows = whiten(found.fitted_windows, noise)
    result = fit(found.model, windows, found.result.initial_states)
    completed_fit = _add_generic_effects(result, windows, progress)
    chi2 = found.held_out.chi2 if found.held_out else found.train.chi2
    if completed_fit is not result:  # what the model lacked had been taken for correlated noise
        again = fit(completed_fit.model, found.fitted_windows, completed_fit.initial_states)
        chi2 = again.cost / degrees_of_freedom(found.fitted_windows, again)
        noise = find_pose_noise(again, found.fitted_windows)
        windows = whiten(found.fitted_windows, noise)
        result = _add_generic_effects(
            fit(completed_fit.model, windows, completed_fit.initial_states), windows, progress
        )
    if chi2 > MAX_BASELINE_CHI2:
        raise InputError(
            f"{found.names[0]}: expected a calm flight that the base model describes, got chi2 per "
            f"degree of freedom {chi2:.1f}, noise alone gives 1; use a calm flight of the same "
            "aircraft without wind or other effects"
        )
    progress("what chance finds")
    return calibrate_nominal_model(
        found, noise, result, windows, [*catalogue, *available_generic_effects(result.model)]
    )


def calibrate_nominal_model(
    found: Identification,
    noise: PoseNoiseModel,
    result: FitResult,
    windows: Windows,
    tried: Sequence[Effect],
) -> NominalModel:
    """The nominal model from its final fit: level, prior for another day, false-alarm levels.

    Args:
        found: the baseline flight, identified.
        noise: its pose noise.
        result: the model, fitted with whitened noise.
        windows: what it was fitted to.
        tried: the effects that will be tried, named and generic.
    """
    baseline_chi2 = result.cost / degrees_of_freedom(windows, result)
    reduced = SchurComplement.of(result, None, max(1.0, baseline_chi2))
    tried_sensitivities = sensitivities(
        result.model, windows, result.initial_states, list(effect_variants(tried, windows))
    )
    penalty = np.array([bic_penalty(c.variant.effect, windows) for c in tried_sensitivities])
    false_alarms = (reduced.block_delta_chi2(tried_sensitivities) - penalty[:, None]).max(axis=1)
    named = np.array([c.variant.effect not in GENERIC_EFFECTS for c in tried_sensitivities])
    gains = (
        float(false_alarms[named].max(initial=0.0)),
        float(false_alarms[~named].max(initial=0.0)),
    )
    return NominalModel(
        found, noise, result, windows, baseline_chi2, _drift_prior(result, windows), *gains
    )


def _add_generic_effects(result: FitResult, windows: Windows, progress: Progress) -> FitResult:
    """Add to the model the best generic effect of the baseline flight, as long as one is needed.

    No model is complete (propeller wash over the elevator, thrust not linear in throttle); what is
    missing would look like an effect on every other flight.
    """
    progress("what the base lacks")
    while len(GENERIC_EFFECTS) - len(available_generic_effects(result.model)) < MAX_GENERIC_TERMS:
        reduced = SchurComplement.of(
            result, None, max(1.0, result.cost / degrees_of_freedom(windows, result))
        )
        tried_sensitivities = list(
            effect_variants(available_generic_effects(result.model), windows)
        )
        scores = [
            reduced.score(c)
            for c in sensitivities(
                result.model, windows, result.initial_states, tried_sensitivities
            )
        ]
        best = max(scores, key=lambda score: score.delta_chi2)
        if (
            best.delta_chi2
            < bic_penalty(best.variant.effect, windows) + SELECTION_PENALTY + GENERIC_EVIDENCE
        ):
            break
        model = result.model.with_effect(best.variant.effect)
        added = fit(model.with_values(best.values), windows, result.initial_states)
        if added.cost > result.cost - VERY_STRONG_EVIDENCE:
            break
        result = added
    return result


def available_generic_effects(model: Model) -> tuple[Effect, ...]:
    """The generic effects that a model does not have yet."""
    return tuple(
        effect for effect in GENERIC_EFFECTS if effect.parameters[0].name not in model.values
    )


def _drift_prior(result: FitResult, windows: Windows) -> Prior:
    """Prior for another day: the baseline's covariance, and a percent of drift per coefficient."""
    confidence = uncertainty(result, windows)
    parameters = {p.name: p for p in result.model.parameters}
    drift = np.array(
        [
            COEFFICIENT_DRIFT * ordinary_size(parameters[n], result.model.values[n])
            for n in confidence.names
        ]
    )
    timing = np.array([n in ("delay", "lag") for n in confidence.names])
    drift[timing] = TIMING_DRIFT_S
    covariance = confidence.covariance + np.diag(drift**2)
    sigma = np.sqrt(np.diag(covariance))
    spread = dict(zip(confidence.names, sigma.tolist(), strict=True))
    return Prior(dict(result.model.values), spread, covariance / np.outer(sigma, sigma))


def bic_penalty(effect: Effect, windows: Windows) -> float:
    """BIC penalty of an effect's parameters: k ln(n), n measured components [Schwarz 1978]."""
    return float(len(effect.parameters) * np.log(max(windows.count, 2)))


def degrees_of_freedom(windows: Windows, result: FitResult) -> int:
    """Degrees of freedom of a fit to some windows."""
    return max(windows.count - len(windows) * result.model.n_states - len(result.free), 1)
