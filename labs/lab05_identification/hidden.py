"""Lab 5, hidden: random problems, solved by design matrices, dense least squares, loops, SVD
and quadrature; a shooting fit is asked for what one more Newton step would gain.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from given import GUESS, PRIOR_SIGMA, predict, step
from given import SIGMA as POSE_SIGMA

from falconwing_kit.tools.grading import Course, Function, Judge, Trials, Values

Array = np.ndarray
SIGMA = np.array([0.03, 0.05, 0.012])
GRAVITY = 9.8  # m/s^2
SHOTS = {  # passes, rows, steps between nodes, scale of the links
    "linked": (2, 13, 4, 1.0),
    "one step": (1, 13, 1, 1.0),
    "one segment": (1, 21, 20, 10.0),
    "tight": (2, 16, 5, 0.02),
}
GAIN = 0.02  # of the sum of squares that an answer may have left; a standard deviation is 1


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The hidden cases of each exercise for one course."""
    far, level = course.constants["far_sigmas"], course.constants["level_percent"] / 100.0
    return {
        "local_slope": (Values(_draw_log, _slope, cases=10, rtol=1e-6, atol=1e-8),),
        "residuals": (
            Values(partial(_draw_frames, far=far), partial(_residuals, far=far), cases=10),
        ),
        "gauss_newton_step": (Values(_draw_problem, _dense_step, cases=10, rtol=1e-5, atol=1e-7),),
        "intervals": (
            Values(_draw_fit, partial(_intervals, level=level), cases=10, rtol=1e-5, atol=1e-8),
        ),
        "holdout_score": (Values(_draw_windows, _score, cases=10),),
        "multiple_shooting": tuple(Trials(partial(_shoots, kind=kind), trials=1) for kind in SHOTS),
        "forecast_turn": (Values(_draw_turns, _turns, cases=10, rtol=1e-6, atol=1e-6),),
    }


def _draw_log(rng: np.random.Generator) -> tuple[Any, ...]:
    t = np.cumsum(rng.uniform(0.03, 0.08, 25))
    x = rng.normal(size=25)
    x[rng.choice(25, 8, replace=False)] = np.nan
    return t, x, int(rng.integers(1, 5))


def _slope(t: Array, x: Array, half: int) -> tuple[Array, Array]:
    """Each row's design matrix [t, 1] and the inverse of its square."""
    slope, noise = np.full(len(t), np.nan), np.full(len(t), np.nan)
    for k in range(len(t)):
        rows = [i for i in range(k - half, k + half + 1) if 0 <= i < len(t) and np.isfinite(x[i])]
        if len(rows) > 1:
            design = np.column_stack([t[rows] - t[k], np.ones(len(rows))])
            slope[k] = np.linalg.lstsq(design, x[rows], rcond=None)[0][0]
            noise[k] = np.sqrt(np.linalg.inv(design.T @ design)[0, 0])
    return slope, noise


def _draw_frames(rng: np.random.Generator, far: float) -> tuple[Any, ...]:
    measured = rng.normal(size=(4, 6, 3))
    e = rng.uniform(0.0, 0.9 * far, measured.shape) * rng.choice([-1.0, 1.0], measured.shape)
    off = rng.random(measured.shape) < 0.15
    e[off] *= 6.0
    predicted = measured + e * SIGMA
    measured[0, 1, rng.integers(3)] = measured[2, 3, rng.integers(3)] = np.nan
    return predicted, measured, SIGMA


def _residuals(predicted: Array, measured: Array, sigma: Array, far: float) -> tuple[Array, Array]:
    """Frame by frame; a frame's factor is that of its largest residual."""
    r, weight = np.zeros(predicted.shape), np.zeros(predicted.shape)
    for at in np.ndindex(predicted.shape[:2]):
        if not np.isnan(measured[at]).any():
            worst = max(abs(predicted[at] - measured[at]) / sigma)
            weight[at] = min(1.0, far / worst) ** 0.5 / sigma
            r[at] = weight[at] * (predicted[at] - measured[at])
    return r, weight


def _draw_problem(rng: np.random.Generator) -> tuple[Any, ...]:
    W, R, P, n = 5, 14, 3, 4
    away, sigma = rng.normal(size=P), rng.uniform(0.1, 1.0, P)
    return (
        rng.normal(size=(W, R)),
        rng.normal(size=(W, R, P)),
        rng.normal(size=(W, R, n)),
        away,
        sigma,
    )


def _dense_step(
    r: Array, J_K: Array, J_start: Array, away: Array, sigma_prior: Array
) -> tuple[Array, Array]:
    """All unknowns in one dense least-squares problem."""
    from scipy.linalg import block_diag, lstsq

    W, R, P = J_K.shape
    rows = np.hstack([J_K.reshape(W * R, P), block_diag(*J_start)])
    known = np.hstack([np.diag(1.0 / sigma_prior), np.zeros((P, rows.shape[1] - P))])
    step = lstsq(np.vstack([rows, known]), -np.concatenate([r.ravel(), away / sigma_prior]))[0]
    return step[:P], step[P:].reshape(W, -1)


def _draw_fit(rng: np.random.Generator) -> tuple[Any, ...]:
    K, J = (
        rng.normal(size=4),
        rng.normal(size=(80, 4)) @ rng.normal(size=(4, 4)) + 0.5 * rng.normal(size=(80, 4)),
    )
    r = rng.uniform(0.5, 2.0) * rng.normal(size=80)
    missing = rng.choice(80, 12, replace=False)
    r[missing], J[missing] = 0.0, 0.0
    return K, r, J, 68, int(rng.integers(5, 20))


def _intervals(
    K: Array, r: Array, J: Array, measured_count: int, start_count: int, level: float
) -> Array:
    """Variances from the singular values, the quantile from scipy."""
    from scipy.stats import norm

    _, size, along = np.linalg.svd(J, full_matrices=False)
    variance = (
        np.sum((along.T / size) ** 2, axis=1) * (r @ r) / (measured_count - K.size - start_count)
    )
    half = norm.ppf(0.5 * (1.0 + level)) * np.sqrt(variance)
    return np.column_stack([K - half, K + half])


def _draw_windows(rng: np.random.Generator) -> tuple[Any, ...]:
    measured = rng.normal(size=(8, 10, 3))
    predicted = measured + rng.normal(size=measured.shape) * np.array([0.3, 0.2, 0.05])
    measured[rng.random(measured.shape) < 0.05] = np.nan
    return predicted, measured, np.repeat(rng.permutation(4), 2), rng.choice(4, 2, replace=False)


def _score(predicted: Array, measured: Array, of_pass: Array, held_passes: Array) -> Array:
    """Sums over frames one by one."""
    squares = [
        (np.hypot(*(p[:2] - m[:2])) ** 2, (180.0 / np.pi * (p[2] - m[2])) ** 2)
        for ps, ms, number in zip(predicted, measured, of_pass, strict=True)
        for p, m in zip(ps, ms, strict=True)
        if number in held_passes.tolist() and not np.isnan(m).any()
    ]
    return np.sqrt(np.array(squares).sum(axis=0) / len(squares))


def _draw_turns(rng: np.random.Generator) -> tuple[Any, ...]:
    v = rng.normal(size=(6, 3)) + np.array([[4.0], [-4.0]] * 3) * rng.normal(size=(1, 3))
    v[:, :2] += 2.0 * np.sign(v[:, :2])
    roll = rng.uniform(-0.9, 0.9, 6)
    roll[rng.integers(6)] = 0.0
    return 5.0 * rng.normal(size=(6, 3)), v, roll, rng.uniform(0.2, 3.0, 6)


def _turns(p: Array, v: Array, roll: Array, horizon: Array) -> tuple[Array, Array]:
    """The velocity turned step by step and summed by Simpson's rule; no chord."""
    from scipy.integrate import simpson

    rate = GRAVITY * np.tan(roll) / np.sqrt(v[:, 0] ** 2 + v[:, 1] ** 2)
    t = np.linspace(0.0, 1.0, 401)[:, None] * horizon
    # y is to the left: a turn to the right multiplies vx + i vy by exp(-i rate t)
    path = simpson((v[:, 0] + 1j * v[:, 1]) * np.exp(-1j * rate * t), x=t, axis=0)
    return p + np.stack([path.real, path.imag, v[:, 2] * horizon], axis=1), rate * horizon


def _shoots(student: Function, rng: np.random.Generator, kind: str) -> bool:
    """Whether an answer is where the sum of squares ends to fall, and below that of the truth."""
    passes, rows, steps, scale = SHOTS[kind]
    link = scale * rng.uniform(0.5, 1.5, 5) * np.array([0.02, 0.02, 0.01, 0.05, 0.05])
    K = GUESS + PRIOR_SIGMA * rng.uniform(-0.4, 0.4, 8)
    commands = np.array([0.6, 0.1]) + rng.uniform(-0.3, 0.3, (passes, rows, 2))
    middle, spread = np.array([-8.0, 2.0, 0.13, 7.0, 0.0]), np.array([1.0, 0.3, 0.03, 0.4, 0.2])
    starts = middle + spread * rng.normal(size=(passes, 5))
    poses = predict(K, starts, commands) + POSE_SIGMA * rng.normal(size=(passes, rows, 3))
    for one in poses:  # one value is missing, the others of the frame are far off
        for row in rng.choice(rows, 2, replace=False):
            one[row] += np.array([3.0, -1.0, 0.5])
            one[row, rng.integers(3)] = np.nan
    flown = [starts]
    for k in range(rows - 1):
        flown.append(step(flown[-1].T, commands[:, k].T, K).T)
    truth = np.concatenate([K, np.stack(flown[::steps], axis=1).ravel()])
    answer = student(poses.copy(), commands.copy(), steps, link.copy())
    if not isinstance(answer, tuple | list) or len(answer) != 2:
        return False
    found, nodes = (np.asarray(part, dtype=float) for part in answer)
    if found.shape != (8,) or nodes.shape != (passes, (rows - 1) // steps + 1, 5):
        return False
    z = np.concatenate([found, nodes.ravel()])
    moves = np.vstack([np.zeros(len(z)), 1e-6 * np.eye(len(z)), truth - z])
    r = _shooting(z + moves, poses, commands, steps, link)
    if not np.isfinite(r).all():
        return False
    slopes = (r[1:-1] - r[0]).T / 1e-6
    left = r[0] - slopes @ np.linalg.lstsq(slopes, r[0])[0]
    return bool(r[0] @ r[0] - left @ left < GAIN and r[0] @ r[0] < r[-1] @ r[-1])


def _shooting(z: Array, poses: Array, commands: Array, steps: int, link: Array) -> Array:
    """All terms of the sum, of many unknowns (n, ...) at once, pass by pass."""
    K = z[:, :8]
    nodes = z[:, 8:].reshape(len(z), len(poses), -1, 5)
    terms = [(K - GUESS) / PRIOR_SIGMA]
    for p, rows in enumerate(poses):
        x = nodes[:, p, 0]
        for k, row in enumerate(rows):
            if k:
                x = step(x.T, commands[p, k - 1], K.T).T
            if k and k % steps == 0:
                terms.append((x - nodes[:, p, k // steps]) / link)
                x = nodes[:, p, k // steps]
            if np.isfinite(row).all():
                terms.append((x[:, :3] - row) / POSE_SIGMA)
    return np.concatenate(terms, axis=1)
