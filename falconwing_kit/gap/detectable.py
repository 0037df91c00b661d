"""Detectable sizes: nominal model and a flight -> how large each effect must be to be named on it.

The minimum detectable effect of fault diagnosis: the size whose expected evidence reaches the
threshold. It falls with the flight's length and excitation, and with how well the baseline flight
determines the aircraft, whose parameters imitate an effect within their prior.
"""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.gap.baseline import NominalModel, bic_penalty
from falconwing_kit.gap.evidence import (
    EffectVariant,
    SchurComplement,
    sensitivities,
)
from falconwing_kit.gap.name import Naming


@dataclass(frozen=True)
class DetectableSize:
    """One amplitude of an effect: from which size on a flight would show it."""

    effect: str
    parameter: Parameter
    size: float  # in the parameter's unit; inf: beyond the parameter's range
    known_aircraft: float  # the same if the baseline had determined the aircraft exactly


def detectable_sizes(base: NominalModel, naming: Naming) -> tuple[DetectableSize, ...]:
    """The smallest size of every effect that the flight would show, one amplitude at a time.

    An effect of amplitude a explains a^2 S of chi2 on average, S from `SchurComplement.information`
    at the flight's fit. It is named where that, in units of the reduced chi2 and divided by the
    scatter of its score between windows, exceeds threshold and BIC penalty:

        a^2 = (threshold + k ln n) inflation reduced_chi2 / S

    Linear in a: for a dead band or a stall it is an order of magnitude. That the effect is not in
    the baseline flight too is a second question, which this does not ask.

    Args:
        base: the nominal model.
        naming: of the flight; an effect's place, angle or delay is that of its ranking.

    Returns:
        In the order of the catalogue's evidence, best first.
    """
    result = naming.before
    reduced = SchurComplement.of(result, base.prior, base.reduced_chi2)
    variants = []
    for found in naming.ranking:
        start = {p.name: p.start for p in found.effect.parameters}
        shape = {name: found.values[name] for name in found.effect.shape}
        variants.append(EffectVariant(found.effect, {**start, **shape}))
    tried = sensitivities(result.model, naming.windows, result.initial_states, variants)
    sizes = []
    for column in tried:
        effect = column.variant.effect
        needed = naming.threshold + bic_penalty(effect, naming.windows)
        needed *= base.inflation.get(effect.name, 1.0) * base.reduced_chi2
        information = reduced.information(column)
        for k, parameter in enumerate(effect.amplitudes):
            largest = max(abs(parameter.low), abs(parameter.high))
            size, least = (float(np.sqrt(needed / max(one[k], 1e-30))) for one in information)
            sizes.append(
                DetectableSize(
                    effect.name,
                    parameter,
                    size if size <= largest else np.inf,
                    least if least <= largest else np.inf,
                )
            )
    return tuple(sizes)
