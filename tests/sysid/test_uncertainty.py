"""Uncertainty: covariance by dense algebra, inflation for white and correlated noise, flags."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.flight_table import slice_time
from falconwing_kit.sysid.fit import Prior, fit
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import cut_windows
from falconwing_kit.sysid.uncertainty import Uncertainty, ordinary_size, uncertainty
from tests.sysid.simulated import MARKER, drawn, fly_figure_eights, measured

SIGMA = np.array([MARKER[0]] * 3 + [MARKER[1]] * 3)


def windows_of(flown, rng, seconds=100.0, **noise):
    table = slice_time(measured(flown, rng, **noise), 0.0, seconds)
    return cut_windows(prepare(table, SIGMA).flights, rates_model())


@pytest.fixture(scope="module")
def flown():
    """A minute of ordinary flight: the aircraft and its true states."""
    rng = np.random.default_rng(31)
    truth = drawn(rates_model(), rng)
    return truth, fly_figure_eights([truth], 60.0, rng)


@pytest.fixture(scope="module")
def fitted(flown):
    """The fit of its first 20 s with white noise: windows and result."""
    truth, whole = flown
    windows = windows_of(whole, np.random.default_rng(1), seconds=20.0)
    return windows, fit(truth, windows, windows.initial_guess)


def test_covariance_is_the_inverse_of_the_whole_normal_matrix(fitted):
    """Dense NumPy: all unknowns (29 parameters, 12 initial states per window), chi2 per degree of
    freedom times the inverse, its block of the parameters, times the inflation.
    """
    windows, found = fitted
    confidence = uncertainty(found, windows)
    n_windows, n_rows, n_free = found.parameter_jacobian.shape
    J = np.zeros((n_windows * n_rows, n_free + 12 * n_windows))
    J[:, :n_free] = found.parameter_jacobian.reshape(-1, n_free)
    for w in range(n_windows):
        J[w * n_rows : (w + 1) * n_rows, n_free + 12 * w : n_free + 12 * (w + 1)] = (
            found.initial_state_jacobian[w]
        )
    scale = 1.0 / np.linalg.norm(J, axis=0)
    inverse = np.linalg.inv((J * scale).T @ (J * scale)) * np.outer(scale, scale)
    s2 = np.sum(found.residual**2) / (windows.count - n_free - 12 * n_windows)
    expected = inverse[:n_free, :n_free] * s2 * confidence.inflation
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert confidence.covariance / size == pytest.approx(expected / size, abs=1e-5)
    assert confidence.names == found.model.names


def test_a_prior_adds_its_information(fitted):
    """Gauss: information of the data plus that of the prior, here of two correlated parameters."""
    windows, found = fitted
    plain = uncertainty(found, windows)
    correlation = np.array([[1.0, 0.9], [0.9, 1.0]])
    sigma = {"kT": 0.5, "kTV": 0.05}
    prior = Prior({n: found.model.values[n] for n in sigma}, sigma, correlation)
    confidence = uncertainty(found, windows, prior)
    added = np.zeros_like(plain.covariance)
    at = [plain.names.index(n) for n in sigma]
    added[np.ix_(at, at)] = np.linalg.inv(
        correlation * np.outer(list(sigma.values()), list(sigma.values()))
    )
    expected = np.linalg.inv(np.linalg.inv(plain.covariance / plain.inflation) + added)
    assert np.diag(confidence.covariance) / confidence.inflation == pytest.approx(
        np.diag(expected), rel=1e-4
    )
    assert confidence.sigma["kT"] < 0.9 * plain.sigma["kT"]


def test_interval_is_1_96_sigma_to_either_side():
    """The normal distribution's 97.5 % point; a fixed parameter has zero width."""
    confidence = Uncertainty(("L_da",), np.array([[0.04]]), 1.0, (), (), ())
    assert confidence.sigma == pytest.approx({"L_da": 0.2})
    assert confidence.interval("L_da", 1.0) == pytest.approx((1.0 - 0.392, 1.0 + 0.392))
    assert confidence.interval("kT", 9.0) == (9.0, 9.0)


def test_inflation_is_about_one_for_white_noise(flown):
    """White residuals scatter the gradients as theory predicts: at most 1.3 with three minutes."""
    truth, whole = flown
    found = []
    for seed in range(3):
        windows = windows_of(whole, np.random.default_rng(seed))
        found.append(uncertainty(fit(truth, windows, windows.initial_guess), windows).inflation)
    assert min(found) >= 1.0
    assert np.mean(found) < 1.3


def test_inflation_grows_with_slow_noise(flown):
    """Half of the variance correlated over 0.5 s: ten neighbouring poses act as one, so by hand the
    variance of a slow parameter grows up to tenfold on that half.
    """
    truth, whole = flown
    windows = windows_of(whole, np.random.default_rng(0), slow=0.5)
    assert 2.0 < uncertainty(fit(truth, windows, windows.initial_guess), windows).inflation < 12.0


def test_few_windows_give_no_inflation(fitted):
    """Below eight windows the scatter of gradients is itself unknown."""
    windows, found = fitted
    few = replace(
        found,
        residual=found.residual[:7],
        parameter_jacobian=found.parameter_jacobian[:7],
        initial_state_jacobian=found.initial_state_jacobian[:7],
    )
    assert uncertainty(few, windows).inflation == 1.0


def test_a_constant_control_input_is_not_excited(flown):
    """Rudder at zero for a minute: its N_dr and cY_dr have no effect. These two are named, the
    others about as certain as with it (N_beta and others lose some excitation), all finite.
    """
    truth, whole = flown
    held = fly_figure_eights([truth], 60.0, np.random.default_rng(6), held=(3,))
    confidence = []
    for flight in (whole, held):
        windows = windows_of(flight, np.random.default_rng(7))
        confidence.append(uncertainty(fit(truth, windows, windows.initial_guess), windows))
    moving, still = confidence
    assert not {"N_dr", "cY_dr"} & set(moving.not_excited)
    assert {"N_dr", "cY_dr"} <= set(still.not_excited) <= {"N_dr", "cY_dr", "cD_beta"}
    others = [n for n in truth.names if n not in ("N_dr", "cY_dr")]
    ratio = [still.sigma[n] / moving.sigma[n] for n in others]
    assert np.isfinite(still.covariance).all()
    assert 0.5 < np.median(ratio) < 2.0


def test_a_parameter_on_its_bound_is_reported(flown):
    """Drag is bounded above twice its true value: it ends there, and its interval is not valid."""
    truth, whole = flown
    low = 2.0 * truth.values["cD_0"]
    parameters = tuple(replace(p, low=low) if p.name == "cD_0" else p for p in truth.parameters)
    windows = windows_of(whole, np.random.default_rng(2))
    found = fit(
        replace(truth, parameters=parameters).with_values({"cD_0": 1.2 * low}),
        windows,
        windows.initial_guess,
    )
    confidence = uncertainty(found, windows)
    assert found.model.values["cD_0"] == low
    assert "cD_0" in confidence.at_bound and "L_da" not in confidence.at_bound


def test_correlated_parameters_are_reported(fitted):
    """Roll is fast: within a frame its rate settles at -L_da

    L_p, so the two are correlated. The number is that of the covariance.
    """
    windows, found = fitted
    confidence = uncertainty(found, windows)
    pairs = {frozenset(pair[:2]): pair[2] for pair in confidence.correlated}
    i, j = confidence.names.index("L_da"), confidence.names.index("L_p")
    expected = confidence.covariance[i, j] / np.sqrt(
        confidence.covariance[i, i] * confidence.covariance[j, j]
    )
    assert pairs[frozenset(("L_da", "L_p"))] == pytest.approx(expected)
    assert expected < -0.95 and min(abs(r) for r in pairs.values()) > 0.95
    assert [abs(r) for *_, r in confidence.correlated] == sorted(
        (abs(r) for *_, r in confidence.correlated), reverse=True
    )


@pytest.mark.parametrize(
    ("start", "low", "high", "value", "expected"),
    [
        (2.0, 0.0, 10.0, 3.0, 3.0),
        (2.0, 0.0, 10.0, -0.5, 2.0),
        (0.0, -1.0, 1.0, 0.01, 0.1),
        (0.0, -1.0, 1.0, 0.3, 0.3),
    ],
)
def test_ordinary_size_by_hand(start, low, high, value, expected):
    """The larger of value and start value; where the start is zero, a twentieth of the range."""
    assert ordinary_size(Parameter("x", start, low, high, "-", ""), value) == pytest.approx(
        expected
    )
