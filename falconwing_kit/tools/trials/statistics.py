"""Statistics of trials: counts and numbers -> intervals, and whether two pilots differ."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import InputError, require_range

RESAMPLES = 10_000


def clopper_pearson_interval(
    successes: int, trials: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Exact interval of a success rate: no true rate outside of it makes the count less likely than
    its tail allows.

    P(X >= k | low) = P(X <= k | high) = (1 - confidence) / 2   [Clopper & Pearson 1934, Biometrika 26]

    Args:
        successes: k, 0 to n.
        trials: n, at least 1.
        confidence: chance that such an interval holds the true rate, at least.

    Returns:
        Low and high end, 0..1.

    Raises:
        InputError: the counts do not fit, or the confidence is not between 0 and 1.
    """
    from scipy.stats import binomtest

    n = _require_count("trials", trials, low=1)
    k = _require_count("successes", successes, high=n)
    interval = binomtest(k, n).proportion_ci(
        require_range("confidence", confidence, low=0.01, high=0.9999), "exact"
    )
    return float(interval.low), float(interval.high)


def bootstrap_mean_interval(
    values: ArrayLike, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Interval of a mean from means of resampled values [Efron & Tibshirani 1993, An Introduction,
    ch. 13].

    Too narrow for a handful of values: ten are few.

    Args:
        values: (n,) one number per trial, finite.
        confidence: share of the resampled means that lies inside.
        seed: of the resampling; same seed, same interval.

    Returns:
        Low and high end in the unit of the values; both nan for fewer than two.

    Raises:
        InputError: a value is not finite, or the confidence is not between 0 and 1.
    """
    from scipy.stats import bootstrap

    x = np.asarray(values, np.float64).ravel()
    if not np.isfinite(x).all():
        raise InputError(
            "values: expected finite numbers, got nan or infinity; leave out trials that have none"
        )
    level = require_range("confidence", confidence, low=0.01, high=0.9999)
    if x.size < 2:
        return float("nan"), float("nan")
    found = bootstrap(
        (x,), np.mean, n_resamples=RESAMPLES, confidence_level=level, method="percentile", rng=seed
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def mcnemar_p_value(first: Sequence[bool], second: Sequence[bool]) -> float:
    """Chance of so uneven a difference between two equally good pilots, flown on the same starts.

    Only trials that one of them lost count. Among those, the number lost by the first is binomial
    with 1/2 [McNemar 1947, Psychometrika 12; the exact form].

    Args:
        first: success of one pilot in each trial.
        second: success of the other in the same trials.

    Returns:
        p-value of both sides, 0..1; 1 where they never differ.

    Raises:
        InputError: the two have not flown equally many trials.
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
    """The value if it is a whole number of things."""
    number = require_range(name, value, low=low, high=high)
    if number != int(number):
        raise InputError(f"{name}: expected a whole number, got {value}")
    return int(number)
