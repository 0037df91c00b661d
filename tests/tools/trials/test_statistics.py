"""Statistics of trials: intervals and pairs against tables, laws and counts."""

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.trials.statistics import (
    bootstrap_mean_interval,
    clopper_pearson_interval,
    mcnemar_p_value,
    wilson_interval,
)

# Fisher & Yates' and Geigy's tables of exact 95 % limits, in per cent; the ends follow by hand:
# all n succeed: low = (a/2)^(1/n); none: high = 1 - (a/2)^(1/n).
TABLE = [
    (10, 10, 69.15, 100.0),
    (0, 10, 0.0, 30.85),
    (8, 10, 44.39, 97.48),
    (5, 10, 18.71, 81.29),
    (27, 30, 73.47, 97.89),
    (30, 30, 88.43, 100.0),
    (100, 100, 96.38, 100.0),
]


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (10, 10, 72.25, 100.0),  # n / (n + z^2), z = 1.95996: 10 / 13.8415
        (0, 10, 0.0, 27.75),  # z^2 / (n + z^2)
        (81, 263, 25.53, 36.62),  # Newcombe 1998, Statistics in Medicine 17, table I
        (15, 148, 6.24, 16.05),
    ],
)
def test_score_interval_is_wilsons(successes, trials, low, high):
    """By hand at both ends, and the published examples."""
    assert 100.0 * np.array(wilson_interval(successes, trials)) == pytest.approx(
        [low, high], abs=0.01
    )


@pytest.mark.parametrize(("successes", "trials", "low", "high"), TABLE)
def test_exact_interval_is_the_tabulated_one(successes, trials, low, high):
    """Tables of exact binomial limits give two decimals of a per cent."""
    assert 100.0 * np.array(clopper_pearson_interval(successes, trials)) == pytest.approx(
        [low, high], abs=0.006
    )


def test_exact_interval_ends_where_the_tail_is_half_of_what_is_left():
    """The definition, with the binomial sum written out: P(X >= 8 | low) = P(X <= 8 | high) =
    0.025.
    """
    from math import comb

    low, high = clopper_pearson_interval(8, 10)
    assert sum(comb(10, k) * low**k * (1 - low) ** (10 - k) for k in range(8, 11)) == pytest.approx(
        0.025, rel=1e-6
    )
    assert sum(comb(10, k) * high**k * (1 - high) ** (10 - k) for k in range(9)) == pytest.approx(
        0.025, rel=1e-6
    )


@pytest.mark.parametrize(("successes", "trials"), [(11, 10), (-1, 10), (0, 0), (2.5, 10)])
def test_impossible_counts_are_refused(successes, trials):
    """More successes than trials, fewer than none, no trials, half a success."""
    with pytest.raises(InputError, match="expected"):
        clopper_pearson_interval(successes, trials)


def test_bootstrap_width_is_that_of_the_normal_law_for_many_values():
    """Mean of n independent values: standard error = sd / sqrt(n), and 95 % lie within 1.96 of
    them. / 10,000 resamples: about 2 % error of each end's distance; n = 400 makes the mean normal.
    """
    values = np.random.default_rng(1).exponential(2.0, 400)
    low, high = bootstrap_mean_interval(values)
    half = 1.96 * values.std() / 20.0
    assert low == pytest.approx(values.mean() - half, abs=0.06 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.06 * half)
    assert bootstrap_mean_interval(values) == (low, high)  # same seed, same bits


def test_bootstrap_of_too_few_is_nan_and_of_nan_is_refused():
    """No landings: no mean, and never zero; one landing has no spread."""
    assert np.isnan(bootstrap_mean_interval([])).all()
    assert np.isnan(bootstrap_mean_interval([0.4])).all()
    with pytest.raises(InputError, match="finite"):
        bootstrap_mean_interval([0.1, np.nan])


def test_mcnemar_counts_only_the_trials_that_differ():
    """Six of six differing trials for one pilot: 2 * (1/2)^6 = 1/32; three each: 1. Ties change
    nothing.
    """
    first = [True] * 6 + [True] * 20 + [False] * 4
    second = [False] * 6 + [True] * 20 + [False] * 4
    assert mcnemar_p_value(first, second) == pytest.approx(1.0 / 32.0)
    assert mcnemar_p_value([True, False] * 3, [False, True] * 3) == pytest.approx(1.0)
    assert mcnemar_p_value([True] * 5, [True] * 5) == 1.0
    with pytest.raises(InputError, match="as many trials"):
        mcnemar_p_value([True], [True, False])
