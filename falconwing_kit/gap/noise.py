"""Pose noise: residuals of the baseline flight -> correlated noise, model discrepancy, filters.

Two things make the residuals of neighbouring rows alike. Errors of camera poses are correlated in
time: the same view gives the same error a moment later. And no model is exact: small accelerations
that it lacks (gusts, unmodelled aerodynamics) add up over a window, the model discrepancy [Kennedy
& O'Hagan 2001; Klein & Morelli, ch. 7]. Taken for white noise, both look like small forces and
raise false alarms.

Covariance of one channel over the rows t of a window, in units of its sigma^2:

    (1 - s) I + s exp(-|t - t'| / tau) + d^2 D_k(t, t')

D_k is the covariance of white noise integrated k times, scaled to a mean variance of one: k = 1 a
random walk (velocity noise), k = 2 accelerations that act on position or attitude, k = 3 rates of
change of these. Position and attitude have their own s, tau, d and k. Restricted likelihood
estimates them and accounts for what the free initial states have absorbed [Patterson & Thompson
1971; Harville 1974].
"""

from dataclasses import dataclass, field, replace

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.fit import HUBER, FitResult
from falconwing_kit.sysid.shooting import Windows, pose_residuals

# Grid of the likelihood: shares of correlated variance, correlation times.
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
TIMES_S = (0.15, 0.3, 0.5, 0.8, 1.3)
SIZES = tuple(float(d) for d in np.geomspace(0.5, 500.0, 16))  # of the discrepancy [sigma]
ORDERS = (1, 2, 3)
COMPLETE_SHARE = 0.5  # of the windows without a missing pose, above which others are left out
# Twice the log likelihood that a discrepancy must gain: "very strong" for each of size and order.
DISCREPANCY_EVIDENCE = 20.0


@dataclass(frozen=True)
class PoseNoiseModel:
    """Covariance of the residuals over a window, of position and of attitude."""

    share: tuple[float, float]  # of the noise variance that is correlated
    time: tuple[float, float]  # its correlation time [s]
    discrepancy: tuple[float, float] = (0.0, 0.0)  # root mean variance of the discrepancy [sigma]
    order: tuple[int, int] = (2, 2)  # how many times white noise is integrated
    # Of each channel, relative to the covariance above; other than 1 only with a discrepancy.
    variance: tuple[float, ...] = (1.0,) * 6

    @property
    def is_white(self) -> bool:
        """Whether there is neither correlation nor discrepancy."""
        return self.share == (0.0, 0.0) and self.discrepancy == (0.0, 0.0)

    @property
    def has_discrepancy(self) -> bool:
        """Whether accelerations that the model lacks add up over a window."""
        return self.discrepancy != (0.0, 0.0)

    def covariance(self, rows: int, interval: float) -> Array:
        """(2, L, L) covariance of position and of attitude over L rows this far apart [s].

        In units of each channel's variance.
        """
        return np.stack([self.half_covariance(half, rows, interval) for half in (0, 1)])

    def half_covariance(self, half: int, rows: int, interval: float) -> Array:
        """(L, L) covariance of position (half 0) or attitude (half 1), as `covariance`."""
        share, time = self.share[half], self.time[half]
        lag = np.abs(np.subtract.outer(np.arange(rows), np.arange(rows))) * interval
        covariance = (1.0 - share) * np.eye(rows) + share * np.exp(-lag / time)
        if (size := self.discrepancy[half]) > 0.0:
            covariance = covariance + size**2 * _integrated_noise(rows, self.order[half])
        return np.asarray(covariance)

    def deviation(self, rows: int, interval: float) -> Array:
        """(L, 6) standard deviation of each row and channel, in units of its sigma."""
        marginal = np.einsum("hll->hl", self.covariance(rows, interval))
        return np.asarray(np.sqrt(np.repeat(marginal, 3, axis=0).T * self.variance))

    def whitening(self, rows: int, interval: float) -> Array:
        """(6, L, L) lower triangular filters, one per channel, for L rows this interval apart [s].

        Each is the inverse Cholesky factor of the covariance: white noise of unit variance.
        """
        halves = np.linalg.inv(np.linalg.cholesky(self.covariance(rows, interval)))
        return np.repeat(halves, 3, axis=0) / np.sqrt(self.variance)[:, None, None]


WHITE = PoseNoiseModel((0.0, 0.0), (0.5, 0.5))


def find_pose_noise(result: FitResult, windows: Windows) -> PoseNoiseModel:
    """Estimate correlated noise and model discrepancy from a fit without whitening.

    The largest restricted likelihood on a grid, position and attitude in turn: first without a
    discrepancy, then with one, which must gain DISCREPANCY_EVIDENCE.
    """
    interval = float(np.median(np.diff(windows.nodes)))
    shape = windows.weight.shape
    residual = pose_residuals(result.residual, windows)
    slopes = result.initial_state_jacobian[:, : windows.weight[0].size].reshape(*shape, -1)
    finite = np.isfinite(residual).all(axis=(1, 2)) & np.isfinite(slopes).all(axis=(1, 2, 3))
    # Windows without a missing pose share one filter, so they are enough where they are many.
    complete = finite & (windows.weight > 0.0).all(axis=(1, 2))
    used = complete if np.mean(complete) >= COMPLETE_SHARE else finite
    data = _Residuals(residual[used], slopes[used], windows.weight[used] > 0.0, interval)
    best = _search(data, WHITE, [{"share": s, "time": t} for s in SHARES for t in TIMES_S])
    sizes = [{"discrepancy": d, "order": k} for k in ORDERS for d in SIZES]
    other = _search(data, best, sizes)
    if data.deviance(best)[0] - data.deviance(other)[0] < DISCREPANCY_EVIDENCE:
        return best
    # With the discrepancy known, the correlated noise anew, then the discrepancy once more.
    other = _search(data, other, [{"share": s, "time": t} for s in SHARES for t in TIMES_S])
    other = _search(data, other, sizes)
    return replace(other, variance=data.channel_variances(other))


def whiten(windows: Windows, noise: PoseNoiseModel) -> Windows:
    """The same windows with the filters that whiten their residuals.

    One filter per channel where every row has a pose; else one per window and channel too, of the
    rows with a pose alone.
    """
    if noise.is_white:
        return windows
    rows, interval = windows.nodes.shape[1], float(np.median(np.diff(windows.nodes)))
    measured = windows.weight > 0.0
    if measured.all():
        return replace(windows, whitening=noise.whitening(rows, interval))
    halves = measured[..., [0, 3]].transpose(0, 2, 1)  # (W, 2, L)
    filters = _masked_filters(noise.covariance(rows, interval), halves)
    whitening = np.repeat(filters, 3, axis=1) / np.sqrt(noise.variance)[:, None, None]
    return replace(windows, whitening=whitening)


def robust_weights(residual: Array, windows: Windows, noise: PoseNoiseModel) -> Array:
    """Square root of Huber's weight (W, L, 6): 1 within HUBER standard deviations of each row.

    Args:
        residual: (W, R) as of `shooting.residuals`, without whitening.
        windows: W windows without whitening.
        noise: gives the standard deviation of a row.
    """
    rows, interval = windows.nodes.shape[1], float(np.median(np.diff(windows.nodes)))
    size = np.abs(pose_residuals(residual, windows)) / noise.deviation(rows, interval)
    return np.sqrt(np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))


def _integrated_noise(rows: int, order: int) -> Array:
    """(L, L) covariance of white noise integrated `order` times from rest, mean variance one."""
    once = np.tril(np.ones((rows, rows)), -1)
    integral = np.linalg.matrix_power(once, order)
    covariance = integral @ integral.T
    return np.asarray(covariance / max(np.trace(covariance) / rows, 1e-300))


def _masked_filters(covariance: Array, measured: np.ndarray) -> Array:
    """Whitening filters (..., L, L) of the measured rows (..., L); zero for the others."""
    both = measured[..., :, None] & measured[..., None, :]
    rows = np.eye(covariance.shape[-1])
    # Rows without a pose become independent of all others, so that one inverse serves all windows.
    filters = np.linalg.inv(np.linalg.cholesky(np.where(both, covariance, rows)))
    return np.where(both, filters, 0.0)


@dataclass(frozen=True)
class _Residuals:
    """Residuals of W windows and their derivatives to the initial states, for the likelihood."""

    residual: Array  # (W, L, 6) [sigma], zero where not measured
    slopes: Array  # (W, L, 6, n)
    measured: np.ndarray  # (W, L, 6)
    interval: float  # between rows [s]
    # What `_reduce_half` has found: a search changes one half at a time and comes back to others.
    reduced: dict[tuple[float, ...], tuple[Array, float]] = field(default_factory=dict, repr=False)

    def deviance(self, noise: PoseNoiseModel) -> tuple[float, float]:
        """-2 log restricted likelihood, up to a constant, and the common variance it takes."""
        windows, n = len(self.residual), self.slopes.shape[-1]
        (position, of_position), (attitude, of_attitude) = (
            self._reduce_half(half, noise) for half in (0, 1)
        )
        # Two triangles on each other have the R of all rows: QR by blocks of rows [Golub & Van
        # Loan, Matrix Computations, ch. 5]. Its last entry is the residual outside the span of the
        # initial states; the diagonal before it is the second determinant.
        R = np.linalg.qr(np.concatenate([position, attitude], axis=1), mode="r")
        diagonal = np.abs(np.einsum("wnn->wn", R))
        squares = float(np.sum(diagonal[:, n] ** 2))
        log_starts = 2.0 * float(np.sum(np.log(diagonal[:, :n] + 1e-300)))
        dof = max(int(np.count_nonzero(self.measured)) - windows * n, 1)
        variance = max(squares / dof, 1e-300)
        return dof * float(np.log(variance)) + of_position + of_attitude + log_starts, variance

    def channel_variances(self, noise: PoseNoiseModel) -> tuple[float, ...]:
        """Variance of each channel: its squares over its degrees of freedom.

        Gusts and errors of a model turn an aircraft more about one axis than about another.
        """
        windows, rows = self.residual.shape[:2]
        white = np.concatenate([self._whiten_half(half, noise)[0] for half in (0, 1)], axis=1)
        residual, Q = white[..., -1], np.linalg.qr(white[..., :-1])[0]
        residual = residual - np.einsum("win,wn->wi", Q, np.einsum("win,wi->wn", Q, residual))
        # Rows of a window are sorted by half, row and axis.
        squares = np.sum((residual**2).reshape(windows, 2, rows, 3), axis=(0, 2)).ravel()
        absorbed = np.sum(np.sum(Q**2, axis=2).reshape(windows, 2, rows, 3), axis=(0, 2)).ravel()
        count = np.count_nonzero(self.measured, axis=(0, 1))
        return tuple((squares / np.maximum(count - absorbed, 1.0)).tolist())

    def _reduce_half(self, half: int, noise: PoseNoiseModel) -> tuple[Array, float]:
        """R (W, n + 1, n + 1) of [slopes, residual] of one half, and -2 log |its filters|."""
        share, size = noise.share[half], noise.discrepancy[half]
        # Without a share its time does not matter, nor the order without a discrepancy.
        key = (half, share, noise.time[half] * (share > 0.0), size, noise.order[half] * (size > 0))
        if key not in self.reduced:
            white, filters = self._whiten_half(half, noise)
            diagonal = np.einsum("wll->wl", filters)
            # Each filter serves three channels.
            log_filter = -2.0 * 3.0 * float(np.sum(np.log(diagonal[diagonal > 0.0])))
            self.reduced[key] = np.asarray(np.linalg.qr(white, mode="r")), log_filter
        return self.reduced[key]

    def _whiten_half(self, half: int, noise: PoseNoiseModel) -> tuple[Array, Array]:
        """Slopes and residual (W, 3 L, n + 1) of one half, whitened, and the filters (W, L, L)."""
        windows, rows = self.residual.shape[:2]
        channels = slice(3 * half, 3 * half + 3)
        # Windows that lack the same rows share a filter; most lack none.
        patterns, of_window = np.unique(self.measured[..., 3 * half], axis=0, return_inverse=True)
        covariance = noise.half_covariance(half, rows, self.interval)
        filters = _masked_filters(covariance, patterns)[of_window]
        joined = np.concatenate(
            [self.slopes[:, :, channels], self.residual[:, :, channels, None]], axis=-1
        )
        # (W, L, L) @ (W, L, 3 (n + 1)).
        white = filters @ joined.reshape(windows, rows, -1)
        return white.reshape(windows, 3 * rows, -1), filters


def _search(
    data: _Residuals, start: PoseNoiseModel, grid: list[dict[str, float | int]]
) -> PoseNoiseModel:
    """The best model with one half's fields replaced by those of a grid point, halves in turn."""
    best, least = start, data.deviance(start)[0]
    for _ in range(2):
        before = best
        for half in (0, 1):
            for point in grid:
                changed = {
                    name: _replace_half(getattr(best, name), half, value)
                    for name, value in point.items()
                }
                trial = replace(best, **changed)  # type: ignore[arg-type]
                if (deviance := data.deviance(trial)[0]) < least:
                    best, least = trial, deviance
        if best == before:
            break
    return best


def _replace_half(pair: tuple[float, float], half: int, value: float) -> tuple[float, float]:
    return (value, pair[1]) if half == 0 else (pair[0], value)
