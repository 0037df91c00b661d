"""The fit: windows + model -> parameters. Gauss-Newton with the start states of each window eliminated.

The unknowns are K and one start state per window. A window's start state touches only that window, so it is solved
for in closed form (QR) and drops out; what is left is a small problem in K alone
[Golub & Pereyra 2003, variable projection; Jategaonkar, ch. 4].
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.shooting import Windows, jacobian, pose_residuals, residuals

HUBER = 3.0  # residuals beyond this many sigmas count linearly, not squared


@dataclass(frozen=True)
class Prior:
    """What is known of K before the fit: a Gaussian over some parameters."""

    mean: dict[str, float]
    sigma: dict[str, float]  # standard deviation of each, its unit
    correlation: Array | None = None  # (P, P) in the order of `sigma`; None where they are independent


@dataclass(frozen=True)
class FitResult:
    """Where a fit ended, with the linearisation there."""

    model: Model
    starts: Array  # (W, n_states) start state of each window
    residual: Array  # (W, R) weighted: L * 6 of poses, then n_states of the start
    to_free: Array  # (W, R, F) derivative to the free parameters
    to_start: Array  # (W, R, n_states) derivative to the start states
    free: tuple[int, ...]  # indices of the fitted parameters
    cost: float  # sum of squared weighted residuals (and of the prior's)
    iterations: int
    converged: bool

    @property
    def reduced(self) -> Array:
        """(W, R, F) derivative to the free parameters with the start states eliminated."""
        return _project_out(self.to_start, self.to_free)

    def reweighted(self, factor: Array) -> tuple[Array, Array, Array]:
        """Residual and derivatives after the weights change by factor (W, L, 6); nothing is flown again."""
        f = np.ones_like(self.residual)
        f[:, : factor[0].size] = factor.reshape(len(factor), -1)
        return self.residual * f, self.to_free * f[..., None], self.to_start * f[..., None]


@np.errstate(all="ignore")  # a flight that runs away overflows; its cost is infinite
def fit_starts(model: Model, windows: Windows, starts: Array, iterations: int = 8) -> tuple[Array, Array]:
    """Fit the start state of each window, K held: Levenberg-Marquardt side by side, each window with its own damping.

    Args:
        model: the aircraft.
        windows: W windows.
        starts: (W, n_states) first guess.
        iterations: at most this many.

    Returns:
        starts (W, n_states) and weighted residuals (W, R).
    """
    residual, _, to_start = jacobian(model, windows, starts, ())
    cost = _window_cost(residual)
    damping = np.full(len(windows), 1e-6)
    for _ in range(iterations):
        step, promised = _solve_windows(to_start, residual, damping)
        if np.all(promised < 1e-3 * (1.0 + cost)):
            break
        trial = _window_cost(residuals(model, windows, starts - step))
        better = trial < cost
        damping = np.where(better, 0.1 * damping, np.maximum(100.0 * damping, 1e-3))
        if not better.any():
            continue
        starts = np.where(better[:, None], starts - step, starts)
        residual, _, to_start = jacobian(model, windows, starts, ())
        cost = _window_cost(residual)
    return starts, residual


@np.errstate(all="ignore")
def fit(
    model: Model,
    windows: Windows,
    starts: Array,
    *,
    prior: Prior | None = None,
    iterations: int = 30,
    tolerance: float = 0.1,
    linear: tuple[Array, Array, Array] | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> FitResult:
    """Fit K and all start states to the windows: Levenberg-Marquardt on the reduced problem.

    Args:
        model: where to start; parameters with low == high are held.
        windows: W windows.
        starts: (W, n_states) first guess of the start states.
        prior: what is known of K, or None.
        iterations: at most this many steps.
        tolerance: stop when a step lowers chi2 by less (0.1 moves no parameter by more than 0.3 of its sigma).
        linear: residual and derivatives at the start, where they are known already.
        on_step: called with (iteration, chi2 per measured component) after each.

    Returns:
        The fit; `converged` is False where it ran out of iterations.
    """
    free = tuple(i for i, p in enumerate(model.parameters) if p.high > p.low)
    low = np.array([model.parameters[i].low for i in free])
    high = np.array([model.parameters[i].high for i in free])
    known, prior_mean = prior_rows(model, free, prior)
    here = list(free)
    vector, damping, converged, refound, step_count = model.vector, 0.0, False, False, 0
    linear = linear or jacobian(model, windows, starts, free)
    cost = _cost(linear[0], known, prior_mean, vector[here])
    while step_count < iterations and not converged:
        normal, gradient, back, start_gain = _reduce(*linear)
        normal += known.T @ known
        gradient += known.T @ (known @ (vector[here] - prior_mean))
        new_cost = np.inf
        promised = _promised(normal, gradient, vector[here], low, high)
        # Once start states had to be found one by one, what they alone still promise is not to be had.
        if promised + (0.0 if refound else start_gain) < tolerance * max(1.0, 1e-4 * cost):
            converged = True
            break
        for attempt in range(8):
            k_step = _bounded_step(normal, gradient, damping, vector[here], low, high)
            trial = vector.copy()
            trial[here] = np.clip(vector[here] + k_step, low, high)
            trial_model = model.with_vector(trial)
            if attempt == 0:  # mostly works, and then its derivatives are needed anyway
                trial_starts = starts + back(k_step)
                ahead = jacobian(trial_model, windows, trial_starts, free)
                residual = ahead[0]
            else:  # judge the same step, then ever shorter ones, by the best start states that go with it
                trial_starts, residual = fit_starts(trial_model, windows, starts, iterations=3)
                ahead = None
            new_cost = _cost(residual, known, prior_mean, trial[here])
            if new_cost < cost:
                break
            damping = max(30.0 * damping, 1e-6) if attempt else damping
        if not new_cost < cost:
            converged = True
            break
        step_count, refound = step_count + 1, attempt > 0
        converged = cost - new_cost < 0.1 * tolerance
        model, vector, starts, cost = trial_model, trial, trial_starts, new_cost
        linear = ahead or jacobian(model, windows, starts, free)
        damping = 0.1 * damping if damping > 1e-9 else 0.0
        if on_step:
            on_step(step_count, cost / max(windows.count, 1))
    return FitResult(model, starts, *linear, free, cost, step_count, converged)


def robust_factor(residual: Array, windows: Windows) -> Array:
    """Factors on the weights that make far residuals count linearly [Huber 1964].

    Args:
        residual: (W, R) weighted residuals.
        windows: W windows.

    Returns:
        (W, L, 6), 1 within HUBER sigmas.
    """
    size = np.abs(pose_residuals(residual, windows))
    return np.sqrt(np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))


def _window_cost(residual: Array) -> Array:
    with np.errstate(all="ignore"):
        return np.nan_to_num(np.einsum("wi,wi->w", residual, residual), nan=np.inf, posinf=np.inf)


def _cost(residual: Array, known: Array, prior_mean: Array, free_values: Array) -> float:
    with np.errstate(all="ignore"):
        total = float(np.sum(residual * residual) + np.sum((known @ (free_values - prior_mean)) ** 2))
    return total if np.isfinite(total) else np.inf


def prior_rows(model: Model, free: tuple[int, ...], prior: Prior | None) -> tuple[Array, Array]:
    """A prior as further rows of the least-squares problem: rows @ (values - mean) has unit covariance.

    Args:
        model: names the parameters.
        free: which of them are fitted.
        prior: what is known, or None.

    Returns:
        rows (F, F) and mean (F,).
    """
    names = [model.names[i] for i in free]
    rows, mean = np.zeros((len(free), len(free))), np.zeros(len(free))
    if prior is None:
        return rows, mean
    known = [name for name in prior.sigma if name in names]
    at = [names.index(name) for name in known]
    sigma = np.array([prior.sigma[name] for name in known])
    mean[at] = [prior.mean[name] for name in known]
    correlation = np.eye(len(known))
    if prior.correlation is not None:
        order = [list(prior.sigma).index(name) for name in known]
        correlation = prior.correlation[np.ix_(order, order)]
    values, vectors = np.linalg.eigh(correlation)
    rows[np.ix_(at, at)] = (vectors / np.sqrt(np.maximum(values, 1e-9))).T / sigma
    return rows, mean


def _qr(to_start: Array) -> tuple[Array, Array]:
    """QR of each window's derivative to its start state."""
    return np.linalg.qr(np.nan_to_num(to_start, posinf=0.0, neginf=0.0))


def _solve_windows(to_start: Array, residual: Array, damping: Array) -> tuple[Array, Array]:
    """Damped step of each window's start state (W, n), to be subtracted, and the chi2 it promises to gain (W,)."""
    J, r = (np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in (to_start, residual))
    transposed = J.transpose(0, 2, 1)
    right = (transposed @ r[..., None])[..., 0]
    normal = transposed @ J
    diagonal = np.einsum("wii->wi", normal)
    diagonal += damping[:, None] * np.maximum(diagonal, 1e-3 * diagonal.max(axis=1, keepdims=True)) + 1e-9
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(step), np.asarray(np.sum(step * right, axis=1))


def _project_out(to_start: Array, to_free: Array) -> Array:
    Q, _ = _qr(to_start)
    return np.asarray(to_free - Q @ (Q.transpose(0, 2, 1) @ to_free))


def _reduce(residual: Array, to_free: Array, to_start: Array) -> tuple[Array, Array, Callable[[Array], Array], float]:
    """Normal equations in K alone, the start states that go with a step in K, and the chi2 these alone would gain."""
    Q, R = _qr(to_start)
    across = Q.transpose(0, 2, 1) @ to_free
    reduced = to_free - Q @ across
    normal = np.einsum("wif,wig->fg", reduced, reduced, optimize=True)
    gradient = np.einsum("wif,wi->f", reduced, residual, optimize=True)
    inside = np.einsum("win,wi->wn", Q, residual)

    def back(k_step: Array) -> Array:
        return -np.linalg.solve(R, (inside + across @ k_step)[..., None])[..., 0]

    return normal, gradient, back, float(np.sum(inside**2))


def _promised(normal: Array, gradient: Array, at: Array, low: Array, high: Array) -> float:
    """The chi2 that a full step in K promises to gain, were the problem linear."""
    step = _bounded_step(normal, gradient, 0.0, at, low, high)
    return float(-2.0 * gradient @ step - step @ normal @ step)


def _bounded_step(normal: Array, gradient: Array, damping: float, at: Array, low: Array, high: Array) -> Array:
    """A damped step that stays within the bounds: what would cross is put on its bound, the rest solved again."""
    n = len(at)
    step, held = np.zeros(n), np.zeros(n, dtype=bool)
    for _ in range(n):
        move = ~held
        A = normal[np.ix_(move, move)]
        A = A + damping * np.diag(np.diag(A)) + 1e-12 * np.trace(A) / max(len(A), 1) * np.eye(len(A))
        step[move] = -np.linalg.solve(A, gradient[move] + normal[np.ix_(move, held)] @ step[held])
        crossing = move & ((at + step < low - 1e-12) | (at + step > high + 1e-12))
        if not crossing.any():
            break
        step[crossing] = np.clip(at + step, low, high)[crossing] - at[crossing]
        held |= crossing
    return step
