"""Evidence: the linear score agrees with the full fit, and elimination changes nothing."""

from functools import cache

import numpy as np
import pytest

from falconwing_kit.gap.evidence import (
    EffectVariant,
    SchurComplement,
    Sensitivities,
    effect_variants,
    sensitivities,
)
from falconwing_kit.sysid.fit import FitResult, Prior, fit, fit_initial_states
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import Windows, cut_windows
from tests.gap.studies import EFFECTS, own_aircraft, own_flight
from tests.sysid.simulated import MARKER

FREE = ("cD_0", "kT", "N_0")


def prior() -> Prior:
    """A percent on the free parameters."""
    truth = own_aircraft().values
    return Prior({n: truth[n] for n in FREE}, {n: max(0.01 * abs(truth[n]), 1e-3) for n in FREE})


@cache
def base_fit(effect: str, **values: float) -> tuple[FitResult, Windows]:
    """The own aircraft with three free parameters, fitted to 20 s with an effect it lacks."""
    model = own_aircraft()
    model = model.with_fixed([name for name in model.names if name not in FREE])
    flights = prepare(own_flight(effect, 20.0, 21, **values), np.repeat(MARKER, 3)).flights
    windows = cut_windows(flights, model)
    initial_states, _ = fit_initial_states(model, windows, windows.initial_guess)
    return fit(model, windows, initial_states, prior=prior(), tolerance=1e-4), windows


def column(effect: str, result: FitResult, windows: Windows) -> Sensitivities:
    """The effect's columns at its ordinary size."""
    usual = EffectVariant(EFFECTS[effect], {p.name: p.start for p in EFFECTS[effect].parameters})
    return sensitivities(result.model, windows, result.initial_states, [usual])[0]


@pytest.mark.parametrize(
    ("effect", "values"),
    [("wind", {"wind_x": 0.05, "wind_y": -0.05}), ("adverse_yaw", {"adverse_yaw": 0.03})],
)
def test_linear_gain_is_the_chi2_a_fit_gains(effect, values):
    """A small effect acts linearly, so the score test and the refit agree; 10 % covers the
    curvature.
    """
    result, windows = base_fit(effect, **values)
    score = SchurComplement.of(result, prior(), 1.0).score(column(effect, result, windows))
    start = result.model.with_effect(EFFECTS[effect]).with_values(dict.fromkeys(values, 0.0))
    refitted = fit(start, windows, result.initial_states, prior=prior(), tolerance=1e-4)
    drop = result.cost - refitted.cost
    assert drop > 50.0
    assert score.delta_chi2 == pytest.approx(drop, rel=0.1)
    for name in values:
        assert score.values[name] == pytest.approx(
            refitted.model.values[name], abs=0.1 * max(map(abs, values.values()))
        )


def test_eliminated_problem_equals_the_dense_one():
    """numpy.linalg.lstsq on the whole problem, all start states at once, gives the same drop of
    chi2.
    """
    result, windows = base_fit("wind", wind_x=0.05, wind_y=-0.05)
    effect = column("wind", result, windows)
    count, rows, n = result.initial_state_jacobian.shape
    initial_states = np.zeros((count * rows, count * n))
    for w in range(count):
        initial_states[w * rows : (w + 1) * rows, w * n : (w + 1) * n] = (
            result.initial_state_jacobian[w]
        )
    precision = np.diag([1.0 / prior().sigma[result.model.names[i]] for i in result.free])
    K = np.vstack([result.parameter_jacobian.reshape(count * rows, -1), precision])
    E = np.vstack([effect.derivative.reshape(count * rows, -1), np.zeros((len(precision), 2))])
    initial_states = np.vstack(
        [initial_states, np.zeros((len(precision), initial_states.shape[1]))]
    )
    mean = np.array(
        [result.model.vector[i] - prior().mean[result.model.names[i]] for i in result.free]
    )
    right = -np.concatenate([result.residual.ravel(), precision @ mean])

    def chi2(A: np.ndarray) -> float:
        return float(np.sum((A @ np.linalg.lstsq(A, right, rcond=None)[0] - right) ** 2))

    drop = chi2(np.hstack([initial_states, K])) - chi2(np.hstack([initial_states, K, E]))
    assert SchurComplement.of(result, prior(), 1.0).score(effect).delta_chi2 == pytest.approx(
        drop, rel=0.01
    )  # as converged as it is


def test_a_scan_leaves_out_what_another_effect_stands_for():
    """A late time stamp is a control delay: one class, tried once. A stream of air is looked for in
    many places.
    """
    _, windows = base_fit("wind", wind_x=0.05, wind_y=-0.05)
    names = [v.effect.name for v in effect_variants(tuple(EFFECTS.values()), windows)]
    assert "time_offset" not in names
    assert names.count("fan_jet") == 28  # 7 by 4
    assert set(names) == set(EFFECTS) - {"time_offset"}


def test_error_that_a_window_shares_inflates_the_variance():
    """White residuals: one, within four standard errors. One error for all 20 rows of a window and
    an effect that is alike in them: the sum has 20 times the variance of white residuals. The
    effect itself, of one size in all windows, is no scatter.
    """
    rng, windows, rows = np.random.default_rng(3), 400, 20
    white = rng.normal(size=(windows, rows))
    shared = np.repeat(rng.normal(size=(windows, 1)), rows, axis=1)
    for residual, expected in ((white, 1.0), (shared, 20.0), (white + 0.5, 1.0)):
        fitted = SchurComplement(
            Q=np.zeros((windows, rows, 1)), K=np.zeros((windows, rows, 1)), residual=residual,
            prior=np.eye(1), reduced_chi2=1.0,
        )  # fmt: skip
        effect = Sensitivities(
            EffectVariant(EFFECTS["extra_drag"], {}), np.ones((windows, rows, 1))
        )
        tolerance = 4.0 * np.sqrt(2.0 / windows)
        assert fitted.inflation(effect) == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize("factor", [1.0, 3.0])
@pytest.mark.parametrize("residual_factor", [1.0, 20.0])
def test_error_of_the_parameters_counts_in_another_flight(factor, residual_factor):
    """By hand: an effect equal to the only parameter's derivative, one in each of n rows, with a
    prior as precise as n rows. Half of the effect is then left, so the score's variance n / 2 is in
    equal parts that of residuals and that of the parameter, each with its own factor.
    """
    rng, windows, rows = np.random.default_rng(5), 400, 20
    residual = rng.normal(size=(windows, rows))
    if residual_factor > 1.0:
        residual = np.repeat(residual[:, :1], rows, axis=1)
    ones = np.ones((windows, rows, 1))
    fitted = SchurComplement(
        Q=np.zeros_like(ones), K=ones, residual=residual, prior=np.zeros((1, 1)), reduced_chi2=1.0
    )
    effect = Sensitivities(EffectVariant(EFFECTS["extra_drag"], {"drag_added": 0.0}), ones)
    found = fitted.inflation(effect, np.array([[float(windows * rows)]]), factor)
    assert found == pytest.approx(
        (residual_factor + factor) / 2.0, abs=2.0 * residual_factor * np.sqrt(2.0 / windows)
    )


def test_variance_of_an_effect_in_the_fit_is_beside_the_other_parameters():
    """Two fitted columns of 20 rows: a + b and a, where a is 1 in every row and b alternates, 1 and
    -1. Beside the other the first is b, the second (a - b) / 2: 1 in ten rows, else 0. With one
    error for all rows of a window the scores are 0, and 10 errors where ten independent ones have
    the variance 10: factors 0 and 100 / 10; with white residuals both are 1. Residuals of 3 sigma.
    """
    rng, windows, rows = np.random.default_rng(7), 400, 20
    a = np.ones((windows, rows))
    K = np.stack([a + np.tile([1.0, -1.0], rows // 2), a], axis=2)
    white = 3.0 * rng.normal(size=(windows, rows))
    shared = np.repeat(3.0 * rng.normal(size=(windows, 1)), rows, axis=1)
    tolerance = 4.0 * np.sqrt(2.0 / windows)
    for residual, expected in ((white, (1.0, 1.0)), (shared, (0.0, 10.0))):
        fitted = SchurComplement(
            Q=np.zeros((windows, rows, 1)), K=K, residual=residual, prior=np.zeros((2, 2)),
            reduced_chi2=9.0,
        )  # fmt: skip
        for column in (0, 1):
            factor = fitted.own_inflation([column])
            assert factor == pytest.approx(expected[column], rel=tolerance, abs=1e-9)
