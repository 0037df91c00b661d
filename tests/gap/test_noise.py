"""Pose noise: its slow share, found in residuals of simulated flights where it was planted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.gap.noise import PoseNoiseModel, _Residuals, find_pose_noise, whiten
from falconwing_kit.sysid.fit import FitResult, fit_initial_states
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import cut_windows, jacobian
from tests.sysid.simulated import MARKER, fly_figure_eights, measured


def found_in(slow: float, seed: int) -> PoseNoiseModel:
    """The noise found in 60 s of flight whose model is known."""
    rng, model = np.random.default_rng(seed), rates_model()
    table = measured(fly_figure_eights([model], 60.0, rng), rng, slow=slow)
    return found_in_table(model, table)


def found_in_table(model: Model, table: FlightTable) -> PoseNoiseModel:
    """The noise found in a flight of a model."""
    windows = cut_windows(prepare(table, np.repeat(MARKER, 3)).flights, model)
    initial_states, _ = fit_initial_states(model, windows, windows.initial_guess)
    linear = jacobian(model, windows, initial_states, ())
    return find_pose_noise(
        FitResult(model, initial_states, *linear, (), float(np.sum(linear[0] ** 2)), 0, True),
        windows,
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_slow_noise_is_found_with_its_share_and_time(seed):
    """Planted: half of the variance is AR(1) with 0.5 s. 30 windows of 2 s tell a share to about
    0.1 (two steps of the grid are 0.2) and a time to a factor of about 1.6, one step.
    """
    noise = found_in(0.5, seed)
    for share, time in zip(noise.share, noise.time, strict=True):
        assert 0.3 <= share <= 0.7
        assert 0.3 <= time <= 0.8


@pytest.mark.parametrize("seed", [3, 4])
def test_white_noise_stays_white(seed):
    """Nothing slow was planted; a share of 0.2 is two steps of the grid, its scatter at this
    length.
    """
    assert max(found_in(0.0, seed).share) <= 0.2


def test_filter_makes_its_own_noise_white():
    """F C F' = 1 where C is the covariance the noise stands for: the law that defines a whitening
    filter.
    """
    noise = PoseNoiseModel((0.5, 0.0), (0.4, 0.5))
    position, attitude = noise.whitening(40, 0.05)[[0, 5]]
    lag = 0.05 * np.abs(np.subtract.outer(np.arange(40), np.arange(40)))
    covariance = 0.5 * np.eye(40) + 0.5 * np.exp(-lag / 0.4)
    np.testing.assert_allclose(position @ covariance @ position.T, np.eye(40), atol=1e-10)
    np.testing.assert_allclose(attitude, np.eye(40), atol=1e-12)


def test_white_noise_needs_no_filter():
    """A filter that does nothing would only cost time."""
    rng, model = np.random.default_rng(1), rates_model()
    windows = cut_windows(
        prepare(measured(fly_figure_eights([model], 10.0, rng), rng)).flights, model
    )
    assert whiten(windows, PoseNoiseModel((0.0, 0.0), (0.5, 0.5))) is windows


def test_discrepancy_by_hand():
    """White noise summed once from rest, three rows: variances 0, 1, 2 with a mean of one, and
    covariance 1 of the last two; times 2^2, and the pose noise itself.
    """
    noise = PoseNoiseModel((0.0, 0.0), (0.5, 0.5), discrepancy=(2.0, 0.0), order=(1, 2))
    position, attitude = noise.covariance(3, 0.05)
    np.testing.assert_allclose(position, [[1, 0, 0], [0, 5, 4], [0, 4, 9]])
    np.testing.assert_allclose(attitude, np.eye(3))
    np.testing.assert_allclose(noise.deviation(3, 0.05)[:, 0] ** 2, [1, 5, 9])


def test_a_path_that_wanders_is_a_discrepancy():
    """Planted: the path takes a random step of 2 cm in each row, noise summed once. Over 40 rows
    its mean variance is 20 of those of a step, so 9 cm or 3 sigma; the attitude has none.
    """
    rng, model = np.random.default_rng(5), rates_model()
    table = measured(fly_figure_eights([model], 60.0, rng), rng)
    steps = np.cumsum(rng.normal(0.0, 0.02, table.p_world.shape), axis=0)
    noise = found_in_table(model, replace(table, p_world=table.p_world + steps))
    expected = 0.02 * np.sqrt(40.0 / 2.0) / MARKER[0]
    assert noise.order[0] == 1
    assert 0.6 * expected < noise.discrepancy[0] * np.sqrt(noise.variance[0]) < 1.6 * expected
    assert noise.discrepancy[1] < 0.3 * noise.discrepancy[0]


def test_an_axis_that_wanders_more_has_more_variance():
    """Planted: steps of 20 cm along x, of 10 cm along y and z: a variance four times as large."""
    rng, model = np.random.default_rng(5), rates_model()
    table = measured(fly_figure_eights([model], 90.0, rng), rng)
    steps = np.cumsum(rng.normal(0.0, [0.2, 0.1, 0.1], table.p_world.shape), axis=0)
    noise = found_in_table(model, replace(table, p_world=table.p_world + steps))
    x, y, z = noise.variance[:3]
    assert 2.5 < x / y < 6.5 and 2.5 < x / z < 6.5
    filters = noise.whitening(10, 0.05)
    np.testing.assert_allclose(filters[1], filters[0] * np.sqrt(x / y))


def test_filters_leave_rows_without_a_pose_out():
    """F C F' = 1 over the measured rows of a window, zero for the others, each window by itself."""
    rng, model = np.random.default_rng(1), rates_model()
    windows = cut_windows(
        prepare(measured(fly_figure_eights([model], 10.0, rng), rng)).flights, model
    )
    missing = np.ones_like(windows.weight)
    missing[1, 5:9] = 0.0
    noise = PoseNoiseModel((0.5, 0.0), (0.4, 0.5), discrepancy=(3.0, 0.0))
    filtered = whiten(windows.scale_weights(missing), noise)
    rows = windows.nodes.shape[1]
    covariance = noise.covariance(rows, 0.05)[0]
    for window in (0, 1):
        seen = np.diag(missing[window, :, 0] * (windows.weight[window, :, 0] > 0.0))
        F = filtered.whitening[window, 0]
        np.testing.assert_allclose(F @ seen @ covariance @ seen @ F.T, seen, atol=1e-9)


@pytest.mark.parametrize("missing", [False, True])
def test_likelihood_is_that_of_the_whole_covariance(missing):
    """The textbook's formula [Harville 1974] with dense matrices over all rows and channels of a
    window, V the covariance of the measured ones and J their derivatives to the initial states:
    log|V| + log|J' V^-1 J| summed, and d log((r' V^-1 r - r' V^-1 J (J' V^-1 J)^-1 J' V^-1 r) / d),
    d measurements less initial states. Differences between noise models are compared.
    """
    rng = np.random.default_rng(8)
    windows, rows, n = 5, 12, 12
    measured_rows = np.ones((windows, rows, 6), dtype=bool)
    if missing:
        measured_rows[1, 3:5] = False
        measured_rows[2, 7, 3:] = False  # an attitude alone
        measured_rows[3, 3:5] = False  # the same as window 1
    residual = np.where(measured_rows, rng.normal(size=(windows, rows, 6)).cumsum(axis=1), 0.0)
    slopes = np.where(measured_rows[..., None], rng.normal(size=(windows, rows, 6, n)), 0.0)
    data = _Residuals(residual, slopes, measured_rows, 0.05)

    def by_hand(noise):
        logs, squares, dof = 0.0, 0.0, -windows * n
        for seen, r, J in zip(measured_rows, residual, slopes, strict=True):
            position, attitude = noise.covariance(rows, 0.05)
            V = block_diag(*[position] * 3, *[attitude] * 3)  # sorted by channel, then row
            index = np.flatnonzero(seen.T.ravel())
            V, r, J = V[np.ix_(index, index)], r.T.ravel()[index], J.transpose(1, 0, 2)
            J = J.reshape(-1, n)[index]
            inverse = np.linalg.inv(V)
            information = J.T @ inverse @ J
            logs += np.linalg.slogdet(V)[1] + np.linalg.slogdet(information)[1]
            along = J.T @ inverse @ r
            squares += r @ inverse @ r - along @ np.linalg.solve(information, along)
            dof += len(index)
        return dof * np.log(squares / dof) + logs, squares / dof

    models = (
        PoseNoiseModel((0.0, 0.0), (0.5, 0.5)),
        PoseNoiseModel((0.5, 0.0), (0.3, 0.5)),
        PoseNoiseModel((0.5, 0.2), (0.3, 0.8)),
        PoseNoiseModel((0.5, 0.2), (0.3, 0.8), (4.0, 0.0), (1, 2)),
        PoseNoiseModel((0.0, 0.2), (0.3, 0.8), (4.0, 2.0), (3, 2)),
        PoseNoiseModel((0.5, 0.0), (0.3, 0.5)),  # once more
    )
    found = np.array([data.deviance(noise) for noise in models])
    expected = np.array([by_hand(noise) for noise in models])
    np.testing.assert_allclose(found[:, 1], expected[:, 1], rtol=1e-8)
    np.testing.assert_allclose(
        found[:, 0] - found[0, 0], expected[:, 0] - expected[0, 0], rtol=1e-8, atol=1e-6
    )
    assert np.ptp(expected[:, 0]) > 10.0
