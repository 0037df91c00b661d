"""Pose noise: residuals of the baseline flight -> share of correlated noise, and whitening filters.

Errors of camera poses are correlated in time: the same view gives the same error a moment later.
Taken for white, such noise looks like small forces and raises false alarms. Each half of the pose
(position, attitude) is white noise plus a correlated part, cov(lag) = s exp(-|lag| / tau).
Restricted likelihood estimates s and tau and accounts for what the free initial states have
absorbed [Patterson & Thompson 1971; Harville 1974].
"""

from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.fit import FitResult
from falconwing_kit.sysid.shooting import Windows, pose_residuals

# Grid of the likelihood: shares of correlated variance, correlation times.
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
MIN_MEASURED_SHARE = 0.8  # share of rows with a pose that a filter over rows needs
TIMES_S = (0.15, 0.3, 0.5, 0.8, 1.3)


@dataclass(frozen=True)
class PoseNoiseModel:
    """Time correlation of the pose noise, of position and of attitude."""

    share: tuple[float, float]  # of the variance that is correlated
    time: tuple[float, float]  # its correlation time [s]

    def whitening(self, rows: int, interval: float) -> Array:
        """(6, L, L) lower triangular filters, one per channel, for L rows this interval apart [s].

        Each is the inverse Cholesky factor of the correlation matrix: white noise, same variance.
        """
        lag = np.abs(np.subtract.outer(np.arange(rows), np.arange(rows))) * interval
        filters = []
        for share, time in zip(self.share, self.time, strict=True):
            covariance = (1.0 - share) * np.eye(rows) + share * np.exp(-lag / time)
            filters += [np.linalg.inv(np.linalg.cholesky(covariance))] * 3
        return np.stack(filters)


def find_pose_noise(result: FitResult, windows: Windows) -> PoseNoiseModel:
    """Estimate share and time of the correlated noise from a fit without whitening.

    The largest restricted likelihood on a grid, position and attitude in turn. White where many
    rows have no pose, since the filter needs neighbouring rows.
    """
    if np.mean(windows.weight > 0.0) < MIN_MEASURED_SHARE:
        return PoseNoiseModel((0.0, 0.0), (0.5, 0.5))
    interval = float(np.median(np.diff(windows.nodes)))
    shape = windows.weight.shape
    residual = pose_residuals(result.residual, windows)
    slopes = result.initial_state_jacobian[:, : windows.weight[0].size].reshape(*shape, -1)
    best = PoseNoiseModel((0.0, 0.0), (0.5, 0.5))
    best_cost = _restricted_cost(best, residual, slopes, windows, interval)
    for _ in range(2):
        for half in (0, 1):
            for share in SHARES:
                for time in TIMES_S if share else TIMES_S[:1]:
                    trial = replace(
                        best,
                        share=_replace_half(best.share, half, share),
                        time=_replace_half(best.time, half, time),
                    )
                    cost = _restricted_cost(trial, residual, slopes, windows, interval)
                    if cost < best_cost:
                        best, best_cost = trial, cost
    return best


def whiten(windows: Windows, noise: PoseNoiseModel) -> Windows:
    """The same windows with the filter that whitens their residuals."""
    if noise.share == (0.0, 0.0):
        return windows
    return replace(
        windows,
        whitening=noise.whitening(windows.nodes.shape[1], float(np.median(np.diff(windows.nodes)))),
    )


def _replace_half(pair: tuple[float, float], half: int, value: float) -> tuple[float, float]:
    return (value, pair[1]) if half == 0 else (pair[0], value)


def _restricted_cost(
    noise: PoseNoiseModel, residual: Array, slopes: Array, windows: Windows, interval: float
) -> float:
    """-2 log restricted likelihood, up to a constant, with a common free variance."""
    filters = noise.whitening(residual.shape[1], interval)
    count = len(residual)
    white = np.einsum("klm,wmk->wlk", filters, residual, optimize=True).reshape(count, -1)
    J = np.einsum("klm,wmkn->wlkn", filters, slopes, optimize=True).reshape(
        count, white.shape[1], -1
    )
    # Residual outside the span of the initial states, and the two determinants of the likelihood.
    Q, R = np.linalg.qr(J)
    residual_squares = np.sum(white**2) - np.sum(np.einsum("win,wi->wn", Q, white) ** 2)
    log_filter = -2.0 * sum(float(np.sum(np.log(np.diag(f)))) for f in filters) * count
    log_starts = 2.0 * float(np.sum(np.log(np.abs(np.einsum("wnn->wn", R)) + 1e-300)))
    degrees_of_freedom = windows.count - count * J.shape[2]
    return float(
        degrees_of_freedom * np.log(residual_squares / degrees_of_freedom) + log_filter + log_starts
    )
