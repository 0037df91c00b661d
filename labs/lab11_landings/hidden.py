"""Lab 11, hidden: the same numbers by roots of a quadratic, masked arrays and sums over pairs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.stats import norm

from falconwing_kit.tools.grading import Course, Judge, Values

NAN = float("nan")


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise.

    Args:
        course: its limit of a close landing.

    Returns:
        By exercise.
    """
    close_cm = course.constants["close_cm"]

    def runs(rng: np.random.Generator) -> tuple[Any, ...]:
        """Runs of which some failed, half of those with a mark beside the pad.

        One landed exactly on the limit.
        """
        count = int(rng.integers(8, 16))
        success = np.ones(count, bool)
        success[rng.permutation(count)[: int(rng.integers(2, 5))]] = False
        ald_cm = np.where(success, rng.uniform(1.0, 100.0, count), rng.uniform(101.0, 250.0, count))
        ald_cm[np.flatnonzero(~success)[::2]] = NAN
        ald_cm[rng.choice(np.flatnonzero(success))] = close_cm
        return success, ald_cm

    def summary(success: Any, ald_cm: Any) -> dict[str, Any]:
        landed = np.ma.masked_array(ald_cm, ~success).compressed()
        runs, count = len(success), len(landed)
        ordered = np.sort(landed)
        return {
            "landed": count,
            "mean_cm": float(landed.sum()) / count if count else NAN,
            "mean_with_zeros_cm": float(landed.sum()) / runs,
            "median_cm": 0.5 * float(ordered[(count - 1) // 2] + ordered[count // 2])
            if count
            else NAN,
            "close_share": sum(bool(value <= close_cm) for value in landed) / runs,
        }

    none_landed = (np.array([False, False, False]), np.array([NAN, 140.0, NAN]))
    return {
        "success_interval": (Values(_draw_counts, _interval, fixed=((20, 20, 0.99), (0, 8, 0.8))),),
        "ald_summary": (Values(runs, summary, fixed=(none_landed,)),),
        "compare_sim_real": (Values(_draw_pairs, _compared),),
        "landings_to_show": (Values(_draw_target, _needed),),
    }


def _draw_counts(rng: np.random.Generator) -> tuple[Any, ...]:
    trials = int(rng.integers(8, 200))
    return int(rng.integers(1, trials)), trials, float(rng.choice([0.7, 0.8, 0.9, 0.99, 0.999]))


def _interval(successes: int, trials: int, confidence: float) -> tuple[float, float]:
    """Wilson: the rates p that satisfy (share - p)^2 = z^2 p (1 - p) / n."""
    share, z2 = successes / trials, norm.isf(0.5 * (1.0 - confidence)) ** 2
    ends = np.roots([1.0 + z2 / trials, -2.0 * share - z2 / trials, share**2])
    low, high = np.sort(ends.real)
    return float(low), float(high)


def _draw_pairs(rng: np.random.Generator) -> tuple[Any, ...]:
    """Whole centimetres, so that sums are exact and equal ones are equal.

    Two runs have no partner.
    """
    count = int(rng.integers(7, 12))
    sim = np.rint(rng.uniform(1.0, 90.0, count))
    real = np.rint(sim + rng.normal(rng.choice([-12.0, 12.0]), 20.0, count))
    alone = rng.permutation(count)[:2]
    sim[alone[0]] = real[alone[1]] = NAN
    return sim, real


def _compared(sim_cm: Any, real_cm: Any) -> tuple[int, float, float]:
    """Sums of all sign patterns, built up pair by pair."""
    pairs = [float(b - a) for a, b in zip(sim_cm, real_cm, strict=True) if a == a and b == b]
    sums = [0.0]
    for difference in pairs:
        sums = [total + difference for total in sums] + [total - difference for total in sums]
    extreme = sum(abs(total) >= abs(sum(pairs)) - 1e-9 for total in sums)
    return len(pairs), sum(pairs) / len(pairs), extreme / len(sums)


def _draw_target(rng: np.random.Generator) -> tuple[Any, ...]:
    """Away from cases where the last landing only just suffices."""
    while True:
        case = (
            float(rng.uniform(0.6, 0.97)),
            int(rng.integers(0, 6)),
            float(rng.choice([0.8, 0.9, 0.95, 0.99])),
        )
        exact = _needed_exact(*case)
        if 1e-4 < exact % 1.0 < 1.0 - 1e-4:
            return case


def _needed(rate: float, failures: int, confidence: float) -> int:
    return int(np.ceil(_needed_exact(rate, failures, confidence)))


def _needed_exact(rate: float, failures: int, confidence: float) -> float:
    """Trials from a quadratic in s = sqrt(n): (1 - p) s^2 - z sqrt(p (1 - p)) s - f = 0."""
    b = norm.isf(0.5 * (1.0 - confidence)) * np.sqrt(rate * (1.0 - rate))
    return float(((b + np.sqrt(b**2 + 4.0 * (1.0 - rate) * failures)) / (2.0 * (1.0 - rate))) ** 2)
