"""Uncertainty: a finished fit -> 95 % intervals, correlations, and which parameters this flight did
not excite.
"""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.fit import FitResult, Prior, prior_rows
from falconwing_kit.sysid.shooting import Windows

HIGH_CORRELATION = 0.95
WEAK_SHARE = (
    0.5  # an interval wider than this share of the value (or of an ordinary value) says little
)


@dataclass(frozen=True)
class Uncertainty:
    """What the data say about each fitted parameter."""

    names: tuple[str, ...]
    covariance: Array  # (F, F), in the parameters' units
    inflation: float  # variance factor for time-correlated residuals, >= 1
    correlated: tuple[tuple[str, str, float], ...]  # pairs that the flight hardly separates
    not_excited: tuple[str, ...]
    at_bound: tuple[str, ...]

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each fitted parameter, its unit."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def interval(self, name: str, value: float) -> tuple[float, float]:
        """95 % interval around a value; the value alone where the parameter was held."""
        half = 1.96 * self.sigma.get(name, 0.0)
        return value - half, value + half


def uncertainty(result: FitResult, windows: Windows, prior: Prior | None = None) -> Uncertainty:
    """Covariance of the fitted parameters from the curvature of the cost.

    cov = f s^2 (J'J)^-1 with s^2 = chi2 per degree of freedom [Jategaonkar, eq. 4.44]. The factor f
    compares the scatter of the windows' gradients with what white residuals would give;
    time-correlated pose noise raises it [White 1980; Liang & Zeger 1986, clustered by window].

    Args:
        result: the finished fit.
        windows: the windows it was fitted to.
        prior: the prior used, if any.

    Returns:
        The uncertainty of the parameters that were free.
    """
    model, J = result.model, result.reduced_jacobian
    names = tuple(model.names[i] for i in result.free)
    degrees_of_freedom = max(windows.count - len(names) - J.shape[0] * model.n_states, 1)
    s2 = float(np.sum(result.residual**2)) / degrees_of_freedom
    normal = np.einsum("wif,wig->fg", J, J, optimize=True)
    prior_factor, _ = prior_rows(model, result.free, prior)
    inverse = _inverse(normal / max(s2, 1e-12) + prior_factor.T @ prior_factor)
    inflation = _inflation(J, result.residual, inverse / max(s2, 1e-12), s2)
    covariance = inverse * inflation
    values = {n: model.values[n] for n in names}
    sigma = np.sqrt(np.diag(covariance))
    parameter_of = {p.name: p for p in model.parameters}
    at_bound = tuple(n for n in names if _at_bound(parameter_of[n], values[n]))
    half = dict(zip(names, 1.96 * sigma, strict=True))
    weak = tuple(
        n for n in names if half[n] > WEAK_SHARE * ordinary_size(parameter_of[n], values[n])
    )
    correlation = covariance / np.outer(sigma, sigma)
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > HIGH_CORRELATION
    ]
    return Uncertainty(
        names, covariance, inflation, tuple(sorted(pairs, key=lambda p: -abs(p[2]))), weak, at_bound
    )


def ordinary_size(parameter: Parameter, value: float) -> float:
    """What counts as a full-sized value of a parameter, its unit: the found, the usual, or a part
    of its range.
    """
    return max(abs(value), abs(parameter.start) or 0.05 * (parameter.high - parameter.low))


def _at_bound(parameter: Parameter, value: float) -> bool:
    return min(value - parameter.low, parameter.high - value) < 1e-6 * (
        parameter.high - parameter.low
    )


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive matrix whose rows differ by orders of magnitude; flat
    directions stay finite.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(inverse * np.outer(scale, scale))


def _inflation(J: Array, residual: Array, inverse: Array, s2: float) -> float:
    """Mean over parameters of clustered variance over white variance, at least 1."""
    gradients = np.einsum("wif,wi->wf", J, residual, optimize=True)
    clusters = len(gradients)
    if clusters < 8:
        return 1.0
    gradient_scatter = gradients.T @ gradients * clusters / max(clusters - 1, 1)
    clustered = np.diag(inverse @ gradient_scatter @ inverse)
    white = np.diag(inverse) * s2
    return max(1.0, float(np.mean(clustered / np.maximum(white, 1e-30))))
