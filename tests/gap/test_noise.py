"""Pose noise: its slow share, found in residuals of simulated flights where it was planted."""

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.gap.noise import PoseNoiseModel, find_pose_noise, whiten
from falconwing_kit.sysid.fit import FitResult, fit_initial_states
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import cut_windows, jacobian
from tests.sysid.simulated import MARKER, fly_figure_eights, measured


def found_in(slow: float, seed: int) -> PoseNoiseModel:
    """The noise found in 60 s of flight whose model is known."""
    rng, model = np.random.default_rng(seed), rates_model()
    table = measured(fly_figure_eights([model], 60.0, rng), rng, slow=slow)
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
