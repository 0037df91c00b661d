"""Detectable sizes against flights with effects of multiples of them, which are named or not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from falconwing_kit.gap.baseline import bic_penalty, drift_prior
from falconwing_kit.gap.detectable import DetectableSize, detectable_sizes
from falconwing_kit.gap.name import Naming, name_effect
from falconwing_kit.sysid.fit import prior_rows
from tests.gap.studies import own_base, own_flight

SECONDS, SEED = 30.0, 43


@cache
def quiet(seconds: float) -> Naming:
    """The verdict for the own aircraft with nothing changed."""
    return name_effect(own_base(), own_flight(None, seconds, SEED))


@cache
def sizes(seconds: float) -> dict[str, DetectableSize]:
    return {d.parameter.name: d for d in detectable_sizes(own_base(), quiet(seconds))}


@pytest.mark.parametrize(
    ("effect", "parameter"), [("extra_drag", "drag_added"), ("aileron_loss", "aileron_lost")]
)
def test_evidence_grows_with_the_square_of_the_size(effect, parameter):
    """A third of the size is not named, three times is, by the full fits of the naming itself.

    chi2 grows with the square, so three times has nine times threshold and penalty, less the
    penalty; within 30 %, since the larger effect flies another path and noise adds its own.
    """
    size = sizes(SECONDS)[parameter].size
    found = {}
    for share in (1.0 / 3.0, 3.0):
        flight = own_flight(effect, SECONDS, SEED, **{parameter: share * size})
        found[share] = name_effect(own_base(), flight)
    assert found[1.0 / 3.0].verdict == "none"
    assert [c.effect.name for c in found[3.0].chosen] == [effect]
    best, penalty = (
        found[3.0].ranking[0],
        bic_penalty(found[3.0].ranking[0].effect, quiet(SECONDS).windows),
    )
    expected = 9.0 * (quiet(SECONDS).threshold + penalty) - penalty
    assert best.delta_bic == pytest.approx(expected, rel=0.3)


def test_twice_the_flight_shows_smaller_effects():
    """With the aircraft known, information adds: 1 / sqrt(2), within 25 % for another path and n.

    A known aircraft never needs a larger effect.
    """
    short, long = sizes(SECONDS), sizes(2.0 * SECONDS)
    for name in ("wind_x", "drag_added", "control_delay", "aileron_lost"):
        ratio = long[name].known_aircraft / short[name].known_aircraft
        assert ratio == pytest.approx(np.sqrt(0.5), rel=0.25)
    assert all(d.known_aircraft <= d.size * (1.0 + 1e-9) for d in short.values())


def test_an_uncertain_baseline_hides_what_its_parameters_imitate():
    """Thrust lost is less thrust per throttle: the worse the baseline knows that, the more must be
    lost. A wind is no parameter of the aircraft.
    """
    found = sizes(SECONDS)
    assert found["thrust_lost"].size > 1.5 * found["thrust_lost"].known_aircraft
    assert found["wind_x"].size < 1.2 * found["wind_x"].known_aircraft


def test_error_that_a_window_shares_does_not_widen_the_prior_of_evidence():
    """An offset in each window raises the variance factor, which divides the evidence; the prior
    has the covariance of white residuals, inv(J'J / s^2 + P) by NumPy, drift divided by the factor.
    """
    base, rng = own_base(), np.random.default_rng(2)
    result, windows = base.result, base.windows
    offset = 2.0 * rng.normal(size=(len(windows), 1))
    result = replace(result, residual=result.residual + offset)
    prior, drift, factor = drift_prior(result, windows, base.weak)
    J, (P, _) = result.reduced_jacobian, prior_rows(result.model, result.free, base.weak)
    dof = windows.count - J.shape[2] - J.shape[0] * result.model.n_states
    information = np.einsum("wif,wig->fg", J, J) * dof / np.sum(result.residual**2) + P.T @ P
    white = np.diag(np.linalg.inv(information))
    assert factor > 1.5
    for k, (name, sigma) in enumerate(prior.sigma.items()):
        assert sigma == pytest.approx(np.sqrt(white[k] + drift[name] ** 2 / factor), rel=1e-3)
