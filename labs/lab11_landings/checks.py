"""Lab 11, public: the exercises, what a right function does, and what a person looks for."""

import math

import numpy as np
from given import COHORT

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

CLOSE = COHORT["close_cm"]
NAN = math.nan


def _eight_of_ten(success_interval: Function) -> bool:
    """By hand: z^2 = 3.8415; (0.8 + 0.19207 -+ 1.95996 sqrt(0.016 + 0.0096037)) / 1.38415."""
    return is_same_answer(success_interval(8, 10, 0.95), (0.490163, 0.943318), rtol=0.0, atol=1e-5)


def _ten_of_ten(success_interval: Function) -> bool:
    """By hand: the share is 1, so the ends are n / (n + z^2) and 1.

    Of none, their mirror images.
    """
    z2 = 1.644854**2
    all_good, none_good = success_interval(10, 10, 0.90), success_interval(0, 10, 0.90)
    low = 10.0 / (10.0 + z2)
    return is_same_answer((all_good, none_good), ((low, 1.0), (0.0, 1.0 - low)), atol=1e-6)


def _solves_the_score_equation(success_interval: Function) -> bool:
    """Its definition: at both ends the observed share is z standard deviations of that rate off."""
    ends = np.array(success_interval(13, 37, 0.99))
    distance = (13 / 37 - ends) / np.sqrt(ends * (1.0 - ends) / 37)
    return is_same_answer(distance, np.array([2.575829, -2.575829]), rtol=1e-5)


def _misses_are_no_zeros(ald_summary: Function) -> bool:
    """By hand: (20 + 40 + 90) / 3 = 50, and 150 / 5 = 30; the middle one is 40."""
    got = ald_summary(
        np.array([True, False, True, True, False]), np.array([20.0, NAN, 40.0, 90.0, NAN])
    )
    keys = ("landed", "mean_cm", "mean_with_zeros_cm", "median_cm")
    return is_same_answer(tuple(got[key] for key in keys), (3, 50.0, 30.0, 40.0))


def _a_mark_beside_the_pad(ald_summary: Function) -> bool:
    """By hand: the second run missed the pad and left a mark at 130 cm; only 10 and 30 cm count."""
    got = ald_summary(np.array([True, False, True]), np.array([10.0, 130.0, 30.0]))
    keys = ("landed", "mean_cm", "mean_with_zeros_cm", "median_cm")
    return is_same_answer(tuple(got[key] for key in keys), (2, 20.0, 40.0 / 3.0, 20.0))


def _close_share_counts_all_runs(ald_summary: Function) -> bool:
    """By hand: of four runs one is close, one at the limit, one too far, one missed the pad."""
    ald_cm = np.array([CLOSE - 5.0, CLOSE, CLOSE + 5.0, 1.0])
    return is_same_answer(
        ald_summary(np.array([True, True, True, False]), ald_cm)["close_share"], 0.5
    )


def _nobody_landed(ald_summary: Function) -> bool:
    """No landing, no deviation: nan, not 0; and the answer has the five names, no more."""
    with np.errstate(all="ignore"):
        got = ald_summary(np.array([False, False]), np.array([NAN, 120.0]))
    expected = {
        "landed": 0,
        "mean_cm": NAN,
        "mean_with_zeros_cm": 0.0,
        "median_cm": NAN,
        "close_share": 0.0,
    }
    return is_same_answer(got, expected)


def _three_pairs(compare_sim_real: Function) -> bool:
    """By hand: differences 1, 2, 3.

    Of the 8 sign patterns only + + + and - - - reach 2 in size: p = 2 / 8.
    """
    return is_same_answer(
        compare_sim_real(np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 6.0])), (3, 2.0, 0.25)
    )


def _only_pairs(compare_sim_real: Function) -> bool:
    """By hand: runs 2 and 3 have no partner; differences -4 and 1 leave mean -1.5, p = 4 / 4."""
    sim, real = np.array([5.0, NAN, 3.0, 2.0]), np.array([1.0, 9.0, NAN, 3.0])
    return is_same_answer(compare_sim_real(sim, real), (2, -1.5, 1.0))


def _papers_pairs(compare_sim_real: Function) -> bool:
    """Counted by hand from the table: eight pairs that sum to 100 cm.

    46 of the 256 sign patterns reach that size.
    """
    sim = np.array([54.0, 4.0, 38.0, 12.0, 32.0, 74.0, 21.0, 79.0, 32.0, 23.0])
    real = np.array([35.0, 45.0, NAN, 40.0, 40.0, 70.0, 20.0, 80.0, 78.0, NAN])
    forth, back = compare_sim_real(sim, real), compare_sim_real(real, sim)
    return is_same_answer((forth, back), ((8, 12.5, 46.0 / 256.0), (8, -12.5, 46.0 / 256.0)))


def _arguments_stay(compare_sim_real: Function) -> bool:
    """What a function is given belongs to the caller."""
    sim, real = np.array([5.0, NAN, 3.0]), np.array([1.0, 9.0, 8.0])
    before = sim.copy(), real.copy()
    compare_sim_real(sim, real)
    return is_same_answer((sim, real), before)


def _no_failure(landings_to_show: Function) -> bool:
    """By hand: without a failure n >= z^2 rate / (1 - rate): 3.8415 * 9 = 34.6 gives 35.

    3.8415 * 1 gives 4.
    """
    return is_same_answer((landings_to_show(0.9, 0, 0.95), landings_to_show(0.5, 0, 0.95)), (35, 4))


def _two_failures(landings_to_show: Function) -> bool:
    """By hand at 80 %: z = 1.28155, z sqrt(0.8 * 0.2) = 0.51262.

    n = 20 leaves 0.1 < 0.11463, n = 21 0.10476 < 0.11186, n = 22 0.10909 < 0.10929, n = 23 0.11304
    > 0.10689.
    """
    return is_same_answer(landings_to_show(0.8, 2, 0.80), 23)


def _costs_of_failures(landings_to_show: Function) -> bool:
    """Each failure, each nine of the rate and each nine of the confidence costs landings."""
    counts = [
        landings_to_show(*case)
        for case in ((0.7, 0, 0.9), (0.7, 1, 0.9), (0.85, 1, 0.9), (0.85, 1, 0.99))
    ]
    return all(isinstance(n, int | np.integer) for n in counts) and counts == sorted(set(counts))


LAB = Lab(
    name="lab11",
    title="Landing trials",
    hours=1.5,
    exercises=(
        Exercise(
            "success_interval",
            20.0,
            (
                Check(
                    "8 of 10 landings, at 95 %: 0.490 to 0.943",
                    _eight_of_ten,
                    "z is that of the confidence; z^2 / n and z^2 / (4 n^2) are different terms; "
                    "divide all of it",
                ),
                Check(
                    "10 of 10 ends at 1 and does not begin there; 0 of 10 is its mirror image",
                    _ten_of_ten,
                    "the interval is not centred on the share k / n; z must follow the confidence",
                ),
                Check(
                    "at both ends the observed share is z standard deviations away",
                    _solves_the_score_equation,
                    "look at the root: share (1 - share) / n + z^2 / (4 n^2)",
                ),
            ),
        ),
        Exercise(
            "ald_summary",
            20.0,
            (
                Check(
                    "a failed run has no deviation; as 0 cm it would make the mean smaller",
                    _misses_are_no_zeros,
                    "mean_cm is the sum over landings by the number of landings; "
                    "mean_with_zeros_cm by that of runs",
                ),
                Check(
                    "a mark beside the pad is no landing",
                    _a_mark_beside_the_pad,
                    "choose by `success`, not by where `ald_cm` has a number",
                ),
                Check(
                    "close_share counts landings up to the limit, among all runs",
                    _close_share_counts_all_runs,
                    'landed and at most COHORT["close_cm"], divided by the number of runs',
                ),
                Check(
                    "where no run landed, mean and median are nan, and the names are the five",
                    _nobody_landed,
                    "the mean of no numbers is nan in NumPy; a sum of none is 0",
                ),
            ),
        ),
        Exercise(
            "compare_sim_real",
            20.0,
            (
                Check(
                    "three pairs that all grew: p = 2 / 8",
                    _three_pairs,
                    "real minus sim; both signs count, so take the size of each pattern's mean",
                ),
                Check(
                    "a run without a partner does not count",
                    _only_pairs,
                    "keep runs where both have a number",
                ),
                Check(
                    "the paper's table: 8 pairs, +12.5 cm, p = 46 / 256",
                    _papers_pairs,
                    "there are 2^n patterns for n pairs; count those at least as large, "
                    "equal ones too",
                ),
                Check(
                    "the arguments are left as they were",
                    _arguments_stay,
                    "make new arrays instead of changing those you were given",
                ),
            ),
        ),
        Exercise(
            "landings_to_show",
            15.0,
            (
                Check(
                    "90 % at 95 % confidence takes 35 landings without a failure",
                    _no_failure,
                    "count n up from the failures + 1; the rate inside the root is the one to be "
                    "shown",
                ),
                Check(
                    "two failures, 80 %, at 80 % confidence: 23",
                    _two_failures,
                    "the share of successes is (n - failures) / n; "
                    "stop as soon as it is far enough above the rate",
                ),
                Check(
                    "each failure, a higher rate, more confidence: all cost landings; "
                    "whole numbers",
                    _costs_of_failures,
                    "z comes from z_value(confidence); return an int",
                ),
            ),
            nearby=False,
        ),
    ),
    rubric=(
        Criterion(
            "landings",
            8.0,
            "both panels with units, failures shown as failures",
        ),
        Criterion(
            "landings_reading",
            7.0,
            "51 cm is the mean of the landings, 41 cm counts failures as 0; "
            "10 of 10 and 8 of 10 overlap widely",
        ),
        Criterion(
            "q1",
            5.0,
            "51 cm with 8 of 10 beside it; a failure is not a perfect landing; "
            "or a measure over all "
            "runs such as the close share",
        ),
        Criterion(
            "q2",
            5.0,
            "neither difference is shown (p 0.18; intervals overlap), which is not 'no gap'; "
            "the two "
            "failures are missing from the pairs, which flatters the real flights",
        ),
    ),
    constants={"close_cm": (40.0, 60.0, 0)},
)
