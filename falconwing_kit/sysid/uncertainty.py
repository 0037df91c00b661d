"""Uncertainty: a fit -> covariance, 95 % intervals, correlations, parameters it did not excite."""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.fit import FitResult, Prior, prior_rows
from falconwing_kit.sysid.shooting import Windows

HIGH_CORRELATION = 0.95
# A parameter is not excited if its interval's half width exceeds this share of its typical size.
WEAK_SHARE = 0.5
MIN_CLUSTERS = 8  # windows for an estimate of the inflation


@dataclass(frozen=True)
class Uncertainty:
    """Covariance and diagnostics of the fitted parameters."""

    names: tuple[str, ...]
    covariance: Array  # (F, F), in the parameters' units
    inflation: float  # variance factor for time-correlated residuals, >= 1
    correlated: tuple[tuple[str, str, float], ...]  # pairs that the flight hardly separates
    not_excited: tuple[str, ...]
    at_bound: tuple[str, ...]

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each fitted parameter, in its unit."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def interval(self, name: str, value: float) -> tuple[float, float]:
        """95 % interval around a value; of zero width for a fixed parameter."""
        half = 1.96 * self.sigma.get(name, 0.0)
        return value - half, value + half


def uncertainty(result: FitResult, windows: Windows, prior: Prior | None = None) -> Uncertainty:
    """Covariance of the fitted parameters from the curvature of the cost.

    cov = f s^2 (J'J)^-1 with s^2 = chi2 per degree of freedom [Jategaonkar, eq. 4.44]. The factor f
    compares the scatter of the windows' gradients with that of white residuals; time-correlated
    pose noise raises it [White 1980; Liang & Zeger 1986, clustered by window].

    Args:
        result: the finished fit.
        windows: the windows it was fitted to.
        prior: the prior used, if any.
    """
    model, J = result.model, result.reduced_jacobian
    names = tuple(model.names[i] for i in result.free)
    degrees_of_freedom = max(windows.count - len(names) - J.shape[0] * model.n_states, 1)
    s2 = float(np.sum(result.residual**2)) / degrees_of_freedom
    # Information matrix (F, F): that of the data over s^2, plus the prior's.
    information = np.einsum("wif,wig->fg", J, J, optimize=True) / max(s2, 1e-12)
    prior_factor, _ = prior_rows(model, result.free, prior)
    inverse = _inverse(information + prior_factor.T @ prior_factor)
    inflation = _inflation(J, result.residual, inverse / max(s2, 1e-12), s2)
    covariance = inverse * inflation
    # Diagnostics: wide intervals, values on a bound, pairs of high correlation.
    sigma = np.sqrt(np.diag(covariance))
    parameters = [model.parameters[i] for i in result.free]
    sizes = [ordinary_size(p, model.values[p.name]) for p in parameters]
    weak = 1.96 * sigma > WEAK_SHARE * np.array(sizes)
    correlation = covariance / np.outer(sigma, sigma)
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > HIGH_CORRELATION
    ]
    return Uncertainty(
        names,
        covariance,
        inflation,
        correlated=tuple(sorted(pairs, key=lambda pair: -abs(pair[2]))),
        not_excited=tuple(name for name, is_weak in zip(names, weak, strict=True) if is_weak),
        at_bound=tuple(p.name for p in parameters if _at_bound(p, model.values[p.name])),
    )


def ordinary_size(parameter: Parameter, value: float) -> float:
    """Typical size of a parameter: its value or start value, else 5 % of its range."""
    return max(abs(value), abs(parameter.start) or 0.05 * (parameter.high - parameter.low))


def _at_bound(parameter: Parameter, value: float) -> bool:
    width = parameter.high - parameter.low
    return min(value - parameter.low, parameter.high - value) < 1e-6 * width


def _inverse(matrix: Array) -> Array:
    """Inverse of a positive semidefinite matrix; directions without information stay finite.

    Rows differ by orders of magnitude, so the matrix is first scaled to a unit diagonal.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(inverse * np.outer(scale, scale))


def _inflation(J: Array, residual: Array, inverse: Array, s2: float) -> float:
    """Mean over the parameters of clustered over white variance, at least 1.

    White residuals: var = s^2 (J'J)^-1. Clustered (sandwich): (J'J)^-1 (sum g g') (J'J)^-1 with g
    (F,) the gradient of each window, which may be correlated in itself.
    """
    gradients = np.einsum("wif,wi->wf", J, residual, optimize=True)
    clusters = len(gradients)
    if clusters < MIN_CLUSTERS:
        return 1.0
    gradient_scatter = gradients.T @ gradients * clusters / max(clusters - 1, 1)
    clustered = np.diag(inverse @ gradient_scatter @ inverse)
    white = np.diag(inverse) * s2
    return max(1.0, float(np.mean(clustered / np.maximum(white, 1e-30))))
