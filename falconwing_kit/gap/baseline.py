"""The calm flight: what it tells of the aircraft, of its pose noise, and of what chance finds where nothing is hidden.

Names need a base that is the aircraft: identified, completed with the loads that this very aircraft has and the
model's terms lack, and a prior wide enough for another day.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE, Effect
from falconwing_kit.aircraft.generic import UNNAMED
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.evidence import Reduced, columns, variants
from falconwing_kit.gap.noise import PoseNoise, find_pose_noise, whitened
from falconwing_kit.sysid.fit import FitResult, Prior, fit
from falconwing_kit.sysid.identify import Identification, identify
from falconwing_kit.sysid.shooting import Windows
from falconwing_kit.sysid.uncertainty import ordinary_size, uncertainty

Progress = Callable[[str], None]

DAY_TO_DAY = 0.01  # coefficients of one aircraft differ by about this much from one day to the next
DAY_TO_DAY_S = 0.002  # so do delay and lag: radio and servo stay the same
LEAST_GAIN = 10.0  # "very strong" on the scale of Kass & Raftery 1995
CHOICE = 2.0 * float(np.log(len(UNNAMED)))  # evidence that choosing among so many loads buys by chance
LACKING = 50.0  # evidence from which on a load without a name counts: the base needs it, or a flight shows something
MOST_ADDED = 6  # loads without a name that a base model may need
BASE_FITS = 4.0  # calm chi2 beyond this: the base model is not a model of this aircraft


@dataclass(frozen=True)
class CalmBase:
    """The aircraft without surprise: its model, what is known of it, and its pose noise."""

    found: Identification
    noise: PoseNoise
    result: FitResult  # fitted with the noise made white
    windows: Windows
    chi2: float  # per degree of freedom, with the noise made white
    prior: Prior  # for another flight of the same aircraft
    false_gain: float  # the largest evidence that any effect finds on a third of this flight
    false_unnamed: float  # the same of loads without a name

    @property
    def scatter(self) -> float:
        """Variance of what noise and base model leave, at least that of the noise."""
        return max(1.0, self.chi2)

    @property
    def window_s(self) -> float:
        """Length of its windows [s]."""
        return float(np.median(np.diff(self.windows.nodes)) * self.windows.nodes.shape[1])

    def as_measured(self, windows: Windows) -> Windows:
        """The same windows weighted by the pose noise alone: no far pose weighed down, nothing filtered."""
        return replace(windows, whitening=None, weight=np.where(windows.weight > 0.0, 1.0 / self.found.sigma, 0.0))


def know_calm(calm: FlightTable, progress: Progress = lambda stage: None) -> CalmBase:
    """Identify the calm flight, find its pose noise, and see what evidence effects find where there is none.

    Args:
        calm: a flight without surprise.
        progress: called with the name of each stage.

    Returns:
        What naming needs to know about the aircraft.

    Raises:
        InputError: the flight cannot be used, or the base model does not describe it.
    """
    progress("calm flight")
    return learn_base(identify([calm]), CATALOGUE, progress)


def learn_base(
    found: Identification, catalogue: Sequence[Effect] = CATALOGUE, progress: Progress = lambda stage: None
) -> CalmBase:
    """The same from an identification made already, of any form of model.

    Args:
        found: the calm flight, identified.
        catalogue: the effects that will be tried.
        progress: called with the name of each stage.

    Returns:
        What naming needs to know about the aircraft.

    Raises:
        InputError: the base model does not describe the flight, or a stick's sign in the log is the other way round.
    """
    if found.reversed_sticks:
        raise InputError(next(w for w in found.warnings if w.startswith(found.reversed_sticks[0])))
    noise = find_pose_noise(found.result, found.fitted_windows)
    windows = whitened(found.fitted_windows, noise)
    result = fit(found.model, windows, found.result.starts)
    complete = _completed(result, windows, progress)
    chi2 = found.held_out.chi2 if found.held_out else found.train.chi2
    if complete is not result:  # what the base lacked was taken for slow noise
        again = fit(complete.model, found.fitted_windows, complete.starts)
        chi2 = again.cost / freedom(found.fitted_windows, again)
        noise = find_pose_noise(again, found.fitted_windows)
        windows = whitened(found.fitted_windows, noise)
        result = _completed(fit(complete.model, windows, complete.starts), windows, progress)
    if chi2 > BASE_FITS:
        raise InputError(
            f"{found.names[0]}: the base model does not describe this calm flight (chi2 per degree of freedom "
            f"{chi2:.1f}, noise alone gives 1); use a calm flight of the same aircraft without wind or other surprise"
        )
    progress("what chance finds")
    return judged_base(found, noise, result, windows, [*catalogue, *unnamed_for(result.model)])


def judged_base(
    found: Identification, noise: PoseNoise, result: FitResult, windows: Windows, tried: Sequence[Effect]
) -> CalmBase:
    """The base of a fit that needs no more: its level, what it says of another day, and what chance finds in it.

    Args:
        found: the calm flight, identified.
        noise: its pose noise.
        result: the base model, fitted with the noise made white.
        windows: what it was fitted to.
        tried: the effects that will be tried, with or without a name.

    Returns:
        What naming needs to know about the aircraft.
    """
    level = result.cost / freedom(windows, result)
    reduced = Reduced.of(result, None, max(1.0, level))
    places = columns(result.model, windows, result.starts, list(variants(tried, windows)))
    price = np.array([price_of(c.variant.effect, windows) for c in places])
    false = (reduced.block_gains(places) - price[:, None]).max(axis=1)
    named = np.array([c.variant.effect not in UNNAMED for c in places])
    gains = float(false[named].max(initial=0.0)), float(false[~named].max(initial=0.0))
    return CalmBase(found, noise, result, windows, level, _day_to_day(result, windows), *gains)


def _completed(result: FitResult, windows: Windows, progress: Progress) -> FitResult:
    """The base model with what the calm flight shows it to lack: the best load without a name, and again.

    No model has everything: a propeller's wash over the elevator, a thrust that is not linear in the stick. Without
    them in the base, every other flight would seem to have an effect.
    """
    progress("what the base lacks")
    while len(UNNAMED) - len(unnamed_for(result.model)) < MOST_ADDED:
        reduced = Reduced.of(result, None, max(1.0, result.cost / freedom(windows, result)))
        places = list(variants(unnamed_for(result.model), windows))
        scores = [reduced.score(c) for c in columns(result.model, windows, result.starts, places)]
        best = max(scores, key=lambda score: score.gain)
        if best.gain < price_of(best.variant.effect, windows) + CHOICE + LACKING:
            break
        model = result.model.with_effect(best.variant.effect)
        added = fit(model.with_values(best.values), windows, result.starts)
        if added.cost > result.cost - LEAST_GAIN:
            break
        result = added
    return result


def unnamed_for(model: Model) -> tuple[Effect, ...]:
    """The loads without a name that a model does not have yet."""
    return tuple(effect for effect in UNNAMED if effect.parameters[0].name not in model.values)


def _day_to_day(result: FitResult, windows: Windows) -> Prior:
    """What the calm flight says about another day: its covariance, and a percent of drift on every coefficient."""
    sure = uncertainty(result, windows)
    parameters = {p.name: p for p in result.model.parameters}
    drift = np.array([DAY_TO_DAY * ordinary_size(parameters[n], result.model.values[n]) for n in sure.names])
    timing = np.array([n in ("delay", "lag") for n in sure.names])
    drift[timing] = DAY_TO_DAY_S
    covariance = sure.covariance + np.diag(drift**2)
    sigma = np.sqrt(np.diag(covariance))
    spread = dict(zip(sure.names, sigma.tolist(), strict=True))
    return Prior(dict(result.model.values), spread, covariance / np.outer(sigma, sigma))


def price_of(effect: Effect, windows: Windows) -> float:
    """Evidence that an effect's free parameters buy by chance on some windows [Schwarz 1978]."""
    return float(len(effect.parameters) * np.log(max(windows.count, 2)))


def freedom(windows: Windows, result: FitResult) -> int:
    """Degrees of freedom of a fit to some windows."""
    return max(windows.count - len(windows) * result.model.n_states - len(result.free), 1)
