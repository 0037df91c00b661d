"""Lab 12, hidden: one hidden effect per student, and the judges of the functions that find it."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from given import CANDIDATES, LEAST_GAIN, LOADS

from falconwing_kit.aircraft import CATALOGUE, air_flow, rates_model
from falconwing_kit.core import FlightTable, InputError, write_flight_table
from falconwing_kit.tools.grading import Course, Function, Judge, Trials, Values
from falconwing_kit.tools.trials import HiddenCase, hidden_case, hidden_seed

Array = np.ndarray

OPEN_SEED = 12  # of the practice case that everybody has
OPEN_TRUTH = ("ground_effect", 0.45)
CALM_S, FLIGHT_S, AIRCRAFT = 90.0, 60.0, 5  # s; s; aircraft that are tried
# What may be hidden, from clearly visible to still flown.
SIZES = {
    "wind": (0.25, 1.0),
    "extra_drag": (0.010, 0.020),
    "ground_effect": (0.35, 0.8),
    "thrust_loss": (0.28, 0.42),
    "adverse_yaw": (0.06, 0.18),
    "aileron_loss": (0.24, 0.35),
    "trim_bias": (0.10, 0.18),
    "control_delay": (0.04, 0.11),
}
NEAR, WIDEST = (
    0.25,
    0.4,
)  # share of the true size that a size may be off, and that an interval may reach to each side
# an honest 95 % interval misses one time in twenty; so much wider, three sigmas, hardly ever
PATIENCE = 1.6
SMOOTHED = 2e-3  # the kit's lift divides by sqrt(u^2 + w^2 + 0.01), 1e-4 of it at 7 m/s


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The hidden cases of each exercise for one course and one student."""
    effect, size = truth(course)
    right = (_right_name, _right_size, _right_interval)
    return {
        "residual_map": (Values(_draw_residuals, _map, cases=10),),
        "augment_model": tuple(
            Values(partial(_draw_loads, name), _loads, cases=3, rtol=SMOOTHED, atol=SMOOTHED)
            for name in LOADS
        ),
        "score_candidates": (Values(_draw_problem, _scores, cases=10, rtol=1e-5, atol=1e-6),),
        "verdict": (
            Values(_draw_gains, partial(_verdict, caution=course.constants["caution"]), cases=15),
        ),
        "estimate_wind": (Values(_draw_velocities, _wind, cases=10, rtol=1e-6, atol=1e-7),),
        "my_finding": tuple(Trials(partial(part, effect, size), trials=1) for part in right),
    }


# One hidden effect a student
# ------------------------------------------------------------------------------------------


def truth(course: Course) -> tuple[str, float]:
    """What is hidden in a student's flight: the effect's name and its size.

    The practice case's without a salt.
    """
    if not course.salt:
        return OPEN_TRUTH
    rng = np.random.default_rng([hidden_seed(course.student, course.salt), 12])
    effect = str(rng.choice(["none", "none", *SIZES]))
    if effect == "none":
        return effect, 0.0
    low, high = SIZES[effect]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return effect, size * float(rng.choice([-1.0, 1.0])) if effect == "trim_bias" else size


def handout(course: Course, folder: Path) -> None:
    """Fly and write a student's calm.csv and flight.csv, simulated by the kit.

    Args:
        course: with student and salt; without a salt the practice case is written.
        folder: that exists.
    """
    effect, size = truth(course)
    seed = hidden_seed(course.student, course.salt) if course.salt else OPEN_SEED
    toward = np.random.default_rng([seed, 13]).uniform(0.0, 2.0 * np.pi)
    parameters = {
        "none": {},
        "wind": {"wind_x": size * np.cos(toward), "wind_y": size * np.sin(toward)},
        "extra_drag": {"drag_added": size},
        "ground_effect": {"ground_lift": size, "ground_drag": size},
        "thrust_loss": {"thrust_lost": size},
        "adverse_yaw": {"adverse_yaw": size},
        "aileron_loss": {"aileron_lost": size},
        "control_delay": {"control_delay": size},
        "trim_bias": {"bias_aileron": size, "bias_elevator": 0.0, "bias_rudder": 0.0},
    }[effect]
    case = _flown(seed, effect, parameters)
    for table in (case.calm, case.flight):
        write_flight_table(folder / table.name, _rounded(table))


def _flown(seed: int, effect: str, parameters: Mapping[str, float]) -> HiddenCase:
    """The case of the first aircraft from this seed on that stays in the hall with the effect.

    Not every one can.
    """
    for number in range(seed, seed + AIRCRAFT):
        with suppress(InputError):
            return hidden_case(
                number, effect, size=parameters, calm_seconds=CALM_S, flight_seconds=FLIGHT_S
            )
    raise InputError(
        f"seed {seed}: expected a flight with {effect} in the hall, got none of {AIRCRAFT}; "
        "change the salt"
    )


def _rounded(table: FlightTable) -> FlightTable:
    """Four decimals: far below the noise, and a third of the size."""
    parts = {
        name: np.round(getattr(table, name), 4) for name in ("p_world", "attitude", "commands")
    }
    return replace(table, **parts)


def _right_name(effect: str, size: float, student: Function, rng: np.random.Generator) -> bool:
    found = _finding(student)
    return found is not None and found[0] == effect


def _right_size(effect: str, size: float, student: Function, rng: np.random.Generator) -> bool:
    found = _finding(student)
    return found is not None and found[0] == effect and abs(found[1] - size) <= NEAR * abs(size)


def _right_interval(effect: str, size: float, student: Function, rng: np.random.Generator) -> bool:
    """Whether the interval is in order, not too wide, and holds the truth within its tolerance."""
    if (found := _finding(student)) is None or found[0] != effect:
        return False
    _, best, low, high = found
    half = 0.5 * (high - low)
    near = abs(size - 0.5 * (low + high)) <= PATIENCE * half
    return low <= best <= high and near and half <= WIDEST * abs(size)


def _finding(student: Function) -> tuple[str, float, float, float] | None:
    """What a student found; None where the answer has another form."""
    answer = student()
    if not isinstance(answer, dict) or not isinstance(answer.get("effect"), str):
        return None
    came = [answer.get(name) for name in ("size", "low", "high")]
    if not all(
        isinstance(x, int | float | np.number | np.ndarray) and np.shape(x) == () for x in came
    ):
        return None
    size, low, high = (
        float(np.asarray(x)) if np.asarray(x).dtype.kind in "iuf" else np.nan for x in came
    )
    return answer["effect"], size, low, high


# The functions
# ------------------------------------------------------------------------------------------


def _draw_residuals(rng: np.random.Generator) -> tuple[Any, ...]:
    edges = np.sort(rng.uniform(0.0, 3.0, 5))
    variable, calm_variable = rng.uniform(-0.3, 3.3, 90), rng.uniform(-0.3, 3.3, 120)
    variable[:2] = edges[[0, 2]]  # on an edge
    residual, calm = rng.normal(size=(90, 6)) * (1.0 + variable[:, None]), rng.normal(size=(120, 6))
    for table in (residual, calm):
        table[rng.random(table.shape) < 0.1] = np.nan
    return residual, variable, calm, calm_variable, edges, int(rng.integers(4, 12))


def _map(
    residual: Array, variable: Array, calm: Array, calm_variable: Array, edges: Array, fewest: int
) -> Array:
    """scipy's binned means of the squares, channel by channel."""
    from scipy.stats import binned_statistic

    excess = np.full((residual.shape[1], len(edges) - 1), np.nan)
    for channel in range(residual.shape[1]):
        means, counts = [], []
        for table, at in ((residual, variable), (calm, calm_variable)):
            seen = np.isfinite(table[:, channel])
            squares = table[seen, channel] ** 2
            means.append(binned_statistic(at[seen], squares, "mean", edges).statistic)
            counts.append(binned_statistic(at[seen], squares, "count", edges).statistic)
        enough = np.minimum(*counts) >= fewest
        excess[channel, enough] = (means[0] - means[1])[enough]
    return excess


def _draw_loads(name: str, rng: np.random.Generator) -> tuple[Any, ...]:
    spans = {
        "V": (6.0, 9.0),
        "alpha": (-0.05, 0.2),
        "beta": (-0.2, 0.2),
        "height": (0.1, 2.5),
        "c": (0.1, 0.35),
        "thrust": (1.0, 5.0),
        "aileron": (-0.9, 0.9),
    }
    flow = {key: rng.uniform(*span, size=6) for key, span in spans.items()}
    K = {"cD_induced": rng.uniform(0.1, 0.4), "L_da": rng.uniform(0.5, 1.0)}
    return 3.0 * rng.normal(size=(6, 6)), flow, K, name, rng.uniform(0.2, 0.6)


_IN_KIT = {  # the kit's parameters that take the size
    "extra_drag": ("drag_added",),
    "thrust_loss": ("thrust_lost",),
    "ground_effect": ("ground_lift", "ground_drag"),
    "aileron_loss": ("aileron_lost",),
    "adverse_yaw": ("adverse_yaw",),
}


def _loads(
    loads: Array, flow: Mapping[str, Array], K: Mapping[str, float], effect: str, size: float
) -> Array:
    """The kit's own term of the effect, at coefficients that give this lift and this thrust."""
    V, alpha, beta = flow["V"], flow["alpha"], flow["beta"]
    velocity = V * np.array(
        [np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)]
    )
    nothing = np.zeros_like(V)
    air = air_flow(
        velocity,
        (nothing,) * 3,
        (nothing, nothing, flow["height"]),
        nothing,
        (1.0, flow["aileron"], 0.0, 0.0),
    )
    air = air._replace(airspeed=V)
    numbers = {
        "cL_0": flow["c"],
        "cL_alpha": 0.0,
        "cL_de": 0.0,
        "kT": flow["thrust"],
        "kTV": 0.0,
        **K,
    }
    thrust = tuple(term for term in rates_model().terms if term.name == "thrust")
    term = next(entry.term(thrust) for entry in CATALOGUE if entry.name == effect)
    added = term.evaluate(air, SimpleNamespace(**numbers, **dict.fromkeys(_IN_KIT[effect], size)))
    return loads + np.stack([part + nothing for part in added])


def _draw_problem(rng: np.random.Generator) -> tuple[Any, ...]:
    M, F = 90, 4
    candidates = {
        name: rng.normal(size=(M, width)) for name, width in (("drag", 1), ("wind", 2), ("lag", 1))
    }
    r = rng.normal(size=M) + candidates["wind"] @ rng.normal(size=2)
    root = np.diag(rng.uniform(2.0, 8.0, F)) + rng.normal(size=(F, F))
    return (
        r,
        rng.normal(size=(M, F)),
        rng.normal(size=F),
        root.T @ root,
        candidates,
        float(rng.uniform(1, 2)),
    )


def _scores(
    r: Array,
    J: Array,
    away: Array,
    precision: Array,
    candidates: Mapping[str, Array],
    scatter: float,
) -> dict[str, Array]:
    """Dense least squares with the prior as further rows, with and without each candidate."""

    root = np.linalg.cholesky(precision).T  # precision = root' root

    def solve(columns: Array) -> tuple[float, Array]:
        known = np.hstack([root, np.zeros((len(away), columns.shape[1] - len(away)))])
        rows, right = np.vstack([columns, known]), np.concatenate([r, root @ away])
        step = np.linalg.lstsq(rows, -right, rcond=None)[0]
        return float(np.sum((right + rows @ step) ** 2)), step

    cost, _ = solve(J)
    answer = {}
    for name, columns in candidates.items():
        with_it, step = solve(np.hstack([J, columns]))
        gain = (cost - with_it) / scatter - columns.shape[1] * np.log(len(r))
        answer[name] = np.concatenate([[gain], step[J.shape[1] :]])
    return answer


def _draw_gains(rng: np.random.Generator) -> tuple[Any, ...]:
    """One of three kinds: nothing above the threshold, one alone, or some too close to call."""
    calm = rng.uniform(-8.0, 12.0, 3)
    names = [str(name) for name in rng.permutation(list(CANDIDATES))[:6]]
    kind = rng.integers(3)
    top = [rng.uniform(-5.0, 9.0), rng.uniform(80.0, 900.0), rng.uniform(80.0, 900.0)][kind]
    gains = {name: float(top - rng.uniform(15.0, 60.0)) for name in names}
    gains[names[2]] = float(top)
    if kind == 2:
        gains[names[0]], gains[names[4]] = (
            float(top - rng.uniform(0.5, 4.0)),
            float(top - rng.uniform(5.0, 9.0)),
        )
    return gains, calm


def _verdict(
    gains: Mapping[str, float], calm_gains: Array, caution: float
) -> tuple[float, str, tuple[str, ...]]:
    threshold = max([LEAST_GAIN, *(caution * gain for gain in calm_gains.tolist())])
    ranked = sorted(gains.items(), key=lambda pair: -pair[1])
    if ranked[0][1] <= threshold:
        return threshold, "none", ()
    near = tuple(name for name, gain in ranked if ranked[0][1] - gain < LEAST_GAIN)
    return threshold, "named" if len(near) == 1 else "ambiguous", near


def _draw_velocities(rng: np.random.Generator) -> tuple[Any, ...]:
    yaw = rng.uniform(-7.0, 7.0) + np.sort(rng.uniform(0.0, rng.uniform(2.0, 9.0), 40))
    a, b, wind = rng.uniform(3.0, 8.0), rng.normal(), rng.normal(size=2)
    v = wind + np.stack([a * np.cos(yaw) - b * np.sin(yaw), -a * np.sin(yaw) - b * np.cos(yaw)], 1)
    v += 0.3 * rng.normal(size=v.shape)
    v[rng.choice(40, 4, replace=False), rng.integers(2, size=4)] = np.nan
    return v, yaw


def _wind(v: Array, yaw: Array) -> Array:
    """The same as complex numbers: vx - i vy = (a + i b) exp(i yaw) + wx - i wy, normal equations.

    The nose is at exp(i yaw) there and the right wing at i exp(i yaw).
    """
    known = np.isfinite(v[:, 0] + v[:, 1])
    u, e = v[known, 0] - 1j * v[known, 1], np.exp(1j * yaw[known])
    n, mean = len(u), e.conj().sum()
    own, wind = np.linalg.solve(
        np.array([[n, mean], [mean.conj(), n]]), np.array([(e.conj() * u).sum(), u.sum()])
    )
    return np.array([own.real, own.imag, wind.real, -wind.imag])
