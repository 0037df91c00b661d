"""Statistics of trials: outcomes -> confidence intervals and a test of two pilots."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import InputError, require_range

RESAMPLES = 10_000


def clopper_pearson_interval(
    successes: int, trials: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Exact confidence interval of a success rate, 0..1.

    P(X >= k | low) = P(X <= k | high) = (1 - confidence) / 2   [Clopper & Pearson 1934]

    Args:
        successes: k, 0 to n.
        trials: n, at least 1.
        confidence: least probability that such an interval contains the true rate.

    Raises:
        InputError: the counts do not fit, or the confidence is not between 0 and 1.
    """
    return _rate_interval(successes, trials, confidence, "exact")


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Score interval of a success rate, 0..1; narrower than the exact one, right on average.

    (p + z^2/2n +- z sqrt(p (1 - p)/n + z^2/4n^2)) / (1 + z^2/n)   [Wilson 1927]

    Args:
        successes: k, 0 to n; p = k / n.
        trials: n, at least 1.
        confidence: mean probability that such an interval contains the true rate.

    Raises:
        InputError: the counts do not fit, or the confidence is not between 0 and 1.
    """
    return _rate_interval(successes, trials, confidence, "wilson")


def _rate_interval(
    successes: int, trials: int, confidence: float, method: Literal["exact", "wilson"]
) -> tuple[float, float]:
    from scipy.stats import binomtest

    n = _require_count("trials", trials, low=1)
    k = _require_count("successes", successes, high=n)
    level = require_range("confidence", confidence, low=0.01, high=0.9999)
    interval = binomtest(k, n).proportion_ci(level, method)
    return float(interval.low), float(interval.high)


def bootstrap_mean_interval(
    values: ArrayLike, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of a mean; both ends nan for fewer than two values.

    It is too narrow for ten values or fewer [Efron & Tibshirani 1993, An Introduction, ch. 13].

    Args:
        values: (n,) one number per trial, finite.
        confidence: share of the resampled means inside the interval.
        seed: of the resampling.

    Raises:
        InputError: a value is not finite, or the confidence is not between 0 and 1.
    """
    from scipy.stats import bootstrap

    x = np.asarray(values, np.float64).ravel()
    if not np.isfinite(x).all():
        raise InputError(
            "values: expected finite numbers, got nan or infinity; leave out trials without a value"
        )
    level = require_range("confidence", confidence, low=0.01, high=0.9999)
    if x.size < 2:
        return float("nan"), float("nan")
    found = bootstrap(
        (x,), np.mean, n_resamples=RESAMPLES, confidence_level=level, method="percentile", rng=seed
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def mcnemar_p_value(first: Sequence[bool], second: Sequence[bool]) -> float:
    """Two-sided p-value of the exact McNemar test of two pilots on the same starts.

    Null hypothesis: both are equally good. Among the trials that only one of them won, the number
    won by the first is then binomial with 1/2 [McNemar 1947, Psychometrika 12].

    Args:
        first: success of one pilot in each trial.
        second: success of the other in the same trials.

    Raises:
        InputError: the numbers of trials differ.
    """
    from scipy.stats import binomtest

    if len(first) != len(second):
        raise InputError(
            f"pairs: expected as many trials of both pilots, got {len(first)} and {len(second)}"
        )
    only_first = sum(bool(a) and not b for a, b in zip(first, second, strict=True))
    only_second = sum(bool(b) and not a for a, b in zip(first, second, strict=True))
    differing = only_first + only_second
    return float(binomtest(only_first, differing, 0.5).pvalue) if differing else 1.0


def _require_count(name: str, value: int, *, low: int = 0, high: float = 1e9) -> int:
    """The value as an integer, InputError where it is none."""
    number = require_range(name, value, low=low, high=high)
    if number != int(number):
        raise InputError(f"{name}: expected a whole number, got {value}")
    return int(number)
