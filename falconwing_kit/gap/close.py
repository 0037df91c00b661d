"""Closing the gap: a named effect -> how much better the model predicts time it has not seen, and the effect's size."""

from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.gap.name import CalmBase, Candidate, Naming
from falconwing_kit.sysid.fit import FitResult, fit
from falconwing_kit.sysid.score import BLOCK_S, Score, hold_out, score, select
from falconwing_kit.sysid.shooting import Windows
from falconwing_kit.sysid.uncertainty import Uncertainty, uncertainty


@dataclass(frozen=True)
class Size:
    """One parameter of an effect with its 95 % interval."""

    value: float
    low95: float
    high95: float
    unit: str
    meaning: str


@dataclass(frozen=True)
class Closed:
    """The gap before and after, two seconds ahead on time that no fit has seen."""

    before: Score  # the calm flight's model
    after: Score  # with the effect, fitted to the rest of the flight under the calm flight's prior
    calm: Score  # the calm flight's own held-out time: what noise and base model leave
    before_free: Score  # without the effect, parameters free under the prior: what another day would explain
    after_pinned: Score  # with the effect, the aircraft's parameters held at the calm flight's values
    parameters: dict[str, Size]  # of the effect, from the fit to all of the flight
    model: Model | None  # the calm model with the effect, fitted to all of the flight; None where nothing is named
    sure: Uncertainty | None  # of that model
    seen: bool  # True where the flight was too short to hold anything back
    held_out: np.ndarray  # which windows were scored


def close_gap(base: CalmBase, naming: Naming) -> Closed:
    """Add what was named to the model and score it on time it was not fitted to.

    About 30 % of the flight in blocks of 10 s (shorter ones on a short flight) is held out. Of an ambiguous set the
    first alternative is added.

    Args:
        base: the aircraft without surprise.
        naming: the answer for the flight.

    Returns:
        The gap before and after; where nothing is named after equals before.
    """
    calm_model = base.result.model
    plain = replace(naming.windows, whitening=None, weight=_noise_weights(naming.windows, base))
    fitted, scored = _split(plain)
    seen = len(scored) == 0
    if seen:
        fitted = scored = np.arange(len(plain))
    apart = select(plain, scored)

    def refit(model: Model, whole: FitResult) -> Score:
        result = fit(model, select(naming.windows, fitted), whole.starts[fitted], prior=base.prior, iterations=15)
        return score(result.model, apart, whole.starts[scored])

    before = score(calm_model, apart, naming.before.starts[scored])
    before_free = refit(calm_model, naming.before)
    calm = base.found.held_out or base.found.train
    last = naming.chosen[0 if naming.verdict == "ambiguous" else -1].result if naming.chosen else None
    if last is None:
        return Closed(before, before, calm, before_free, before, {}, None, None, seen, scored)
    after = refit(last.model, last)
    pinned = last.model.with_values(calm_model.values).pinned(calm_model.names)
    sure = uncertainty(last, naming.windows, base.prior)
    sizes = {name: size for candidate in naming.chosen for name, size in _sizes(base, naming, candidate).items()}
    return Closed(before, after, calm, before_free, refit(pinned, last), sizes, last.model, sure, seen, scored)


def _sizes(base: CalmBase, naming: Naming, candidate: Candidate) -> dict[str, Size]:
    """An effect's parameters from the last fit that has them: that of all effects where several were named."""
    last = naming.chosen[-1].result if naming.verdict == "named" else candidate.result
    if last is None:
        return {}
    sure = uncertainty(last, naming.windows, base.prior)
    sizes = {}
    for p in candidate.effect.parameters:
        value = last.model.values[p.name]
        low, high = sure.interval(p.name, value)
        sizes[p.name] = Size(value, low, high, p.unit, p.meaning)
    return sizes


def _split(windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Whole blocks for fitting and for scoring; blocks are shorter than usual where there would be fewer than four."""
    begins = windows.nodes[:, 0]
    return hold_out(windows, block_s=min(BLOCK_S, max(float(np.ptp(begins)) / 3.01, 1.0)))


def _noise_weights(windows: Windows, base: CalmBase) -> Array:
    return np.where(windows.weight > 0.0, 1.0 / base.found.sigma, 0.0)
