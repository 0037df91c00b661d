"""The fit: windows + model -> parameters. Gauss-Newton with the start states of each window
eliminated.

The unknowns are K and one start state per window. A window's start state touches only that window,
so it is solved for in closed form (QR) and drops out; what is left is a small problem in K alone
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
    correlation: Array | None = (
        None  # (P, P) in the order of `sigma`; None where they are independent
    )


@dataclass(frozen=True)
class FitResult:
    """Where a fit ended, with the linearisation there."""

    model: Model
    initial_states: Array  # (W, n_states) start state of each window
    residual: Array  # (W, R) weighted: L * 6 of poses, then n_states of the start
    parameter_jacobian: Array  # (W, R, F) derivative to the free parameters
    initial_state_jacobian: Array  # (W, R, n_states) derivative to the start states
    free: tuple[int, ...]  # indices of the fitted parameters
    cost: float  # sum of squared weighted residuals (and of the prior's)
    iterations: int
    converged: bool

    @property
    def reduced_jacobian(self) -> Array:
        """(W, R, F) derivative to the free parameters with the start states eliminated."""
        return _project_out(self.initial_state_jacobian, self.parameter_jacobian)

    def reweight(self, factor: Array) -> tuple[Array, Array, Array]:
        """Residual and derivatives after the weights change by factor (W, L, 6); nothing is flown
        again.
        """
        f = np.ones_like(self.residual)
        f[:, : factor[0].size] = factor.reshape(len(factor), -1)
        return (
            self.residual * f,
            self.parameter_jacobian * f[..., None],
            self.initial_state_jacobian * f[..., None],
        )


@np.errstate(all="ignore")  # a flight that runs away overflows; its cost is infinite
def fit_initial_states(
    model: Model, windows: Windows, initial_states: Array, iterations: int = 8
) -> tuple[Array, Array]:
    """Fit the start state of each window, K held: Levenberg-Marquardt side by side, each window
    with its own damping.

    Args:
        model: the aircraft.
        windows: W windows.
        starts: (W, n_states) first guess.
        iterations: at most this many.

    Returns:
        starts (W, n_states) and weighted residuals (W, R).
    """
    residual, _, initial_state_jacobian = jacobian(model, windows, initial_states, ())
    cost = _window_cost(residual)
    damping = np.full(len(windows), 1e-6)
    for _ in range(iterations):
        step, predicted_reduction = _solve_windows(initial_state_jacobian, residual, damping)
        if np.all(predicted_reduction < 1e-3 * (1.0 + cost)):
            break
        trial = _window_cost(residuals(model, windows, initial_states - step))
        better = trial < cost
        damping = np.where(better, 0.1 * damping, np.maximum(100.0 * damping, 1e-3))
        if not better.any():
            continue
        initial_states = np.where(better[:, None], initial_states - step, initial_states)
        residual, _, initial_state_jacobian = jacobian(model, windows, initial_states, ())
        cost = _window_cost(residual)
    return initial_states, residual


@np.errstate(all="ignore")
def fit(
    model: Model,
    windows: Windows,
    initial_states: Array,
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
        tolerance: stop when a step lowers chi2 by less (0.1 moves no parameter by more than 0.3 of
            its sigma).
        linear: residual and derivatives at the start, where they are known already.
        on_step: called with (iteration, chi2 per measured component) after each.

    Returns:
        The fit; `converged` is False where it ran out of iterations.
    """
    free = tuple(i for i, p in enumerate(model.parameters) if p.high > p.low)
    low = np.array([model.parameters[i].low for i in free])
    high = np.array([model.parameters[i].high for i in free])
    prior_factor, prior_mean = prior_rows(model, free, prior)
    here = list(free)
    vector, damping, converged, refound, step_count = model.vector, 0.0, False, False, 0
    linear = linear or jacobian(model, windows, initial_states, free)
    cost = _cost(linear[0], prior_factor, prior_mean, vector[here])
    while step_count < iterations and not converged:
        normal, gradient, back_substitute, state_reduction = _eliminate_initial_states(*linear)
        normal += prior_factor.T @ prior_factor
        gradient += prior_factor.T @ (prior_factor @ (vector[here] - prior_mean))
        new_cost = np.inf
        predicted_reduction = _predicted_reduction(normal, gradient, vector[here], low, high)
        # Once start states had to be found one by one, what they alone still promise is not to be
        # had.
        if predicted_reduction + (0.0 if refound else state_reduction) < tolerance * max(
            1.0, 1e-4 * cost
        ):
            converged = True
            break
        for attempt in range(8):
            k_step = _bounded_step(normal, gradient, damping, vector[here], low, high)
            trial = vector.copy()
            trial[here] = np.clip(vector[here] + k_step, low, high)
            trial_model = model.with_vector(trial)
            if attempt == 0:  # mostly works, and then its derivatives are needed anyway
                trial_starts = initial_states + back_substitute(k_step)
                ahead = jacobian(trial_model, windows, trial_starts, free)
                residual = ahead[0]
            # judge the same step, then ever shorter ones, by the best start states that go with it
            else:
                trial_starts, residual = fit_initial_states(
                    trial_model, windows, initial_states, iterations=3
                )
                ahead = None
            new_cost = _cost(residual, prior_factor, prior_mean, trial[here])
            if new_cost < cost:
                break
            damping = max(30.0 * damping, 1e-6) if attempt else damping
        if not new_cost < cost:
            converged = True
            break
        step_count, refound = step_count + 1, attempt > 0
        converged = cost - new_cost < 0.1 * tolerance
        model, vector, initial_states, cost = trial_model, trial, trial_starts, new_cost
        linear = ahead or jacobian(model, windows, initial_states, free)
        damping = 0.1 * damping if damping > 1e-9 else 0.0
        if on_step:
            on_step(step_count, cost / max(windows.count, 1))
    return FitResult(model, initial_states, *linear, free, cost, step_count, converged)


def sqrt_huber_weight(residual: Array, windows: Windows) -> Array:
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


def _cost(residual: Array, prior_factor: Array, prior_mean: Array, free_values: Array) -> float:
    with np.errstate(all="ignore"):
        total = float(
            np.sum(residual * residual) + np.sum((prior_factor @ (free_values - prior_mean)) ** 2)
        )
    return total if np.isfinite(total) else np.inf


def prior_rows(model: Model, free: tuple[int, ...], prior: Prior | None) -> tuple[Array, Array]:
    """A prior as further rows of the least-squares problem: rows @ (values - mean) has unit
    covariance.

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
    prior_factor = [name for name in prior.sigma if name in names]
    at = [names.index(name) for name in prior_factor]
    sigma = np.array([prior.sigma[name] for name in prior_factor])
    mean[at] = [prior.mean[name] for name in prior_factor]
    correlation = np.eye(len(prior_factor))
    if prior.correlation is not None:
        order = [list(prior.sigma).index(name) for name in prior_factor]
        correlation = prior.correlation[np.ix_(order, order)]
    values, vectors = np.linalg.eigh(correlation)
    rows[np.ix_(at, at)] = (vectors / np.sqrt(np.maximum(values, 1e-9))).T / sigma
    return rows, mean


def _qr(initial_state_jacobian: Array) -> tuple[Array, Array]:
    """QR of each window's derivative to its start state."""
    return np.linalg.qr(np.nan_to_num(initial_state_jacobian, posinf=0.0, neginf=0.0))


def _solve_windows(
    initial_state_jacobian: Array, residual: Array, damping: Array
) -> tuple[Array, Array]:
    """Damped step of each window's start state (W, n), to be subtracted, and the chi2 it promises
    to gain (W,).
    """
    J, r = (
        np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in (initial_state_jacobian, residual)
    )
    transposed = J.transpose(0, 2, 1)
    right = (transposed @ r[..., None])[..., 0]
    normal = transposed @ J
    diagonal = np.einsum("wii->wi", normal)
    diagonal += (
        damping[:, None] * np.maximum(diagonal, 1e-3 * diagonal.max(axis=1, keepdims=True)) + 1e-9
    )
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(step), np.asarray(np.sum(step * right, axis=1))


def _project_out(initial_state_jacobian: Array, parameter_jacobian: Array) -> Array:
    Q, _ = _qr(initial_state_jacobian)
    return np.asarray(parameter_jacobian - Q @ (Q.transpose(0, 2, 1) @ parameter_jacobian))


def _eliminate_initial_states(
    residual: Array, parameter_jacobian: Array, initial_state_jacobian: Array
) -> tuple[Array, Array, Callable[[Array], Array], float]:
    """Normal equations in K alone, the start states that go with a step in K, and the chi2 these
    alone would gain.
    """
    Q, R = _qr(initial_state_jacobian)
    across = Q.transpose(0, 2, 1) @ parameter_jacobian
    reduced_jacobian = parameter_jacobian - Q @ across
    normal = np.einsum("wif,wig->fg", reduced_jacobian, reduced_jacobian, optimize=True)
    gradient = np.einsum("wif,wi->f", reduced_jacobian, residual, optimize=True)
    inside = np.einsum("win,wi->wn", Q, residual)

    def back_substitute(k_step: Array) -> Array:
        return -np.linalg.solve(R, (inside + across @ k_step)[..., None])[..., 0]

    return normal, gradient, back_substitute, float(np.sum(inside**2))


def _predicted_reduction(
    normal: Array, gradient: Array, at: Array, low: Array, high: Array
) -> float:
    """The chi2 that a full step in K promises to gain, were the problem linear."""
    step = _bounded_step(normal, gradient, 0.0, at, low, high)
    return float(-2.0 * gradient @ step - step @ normal @ step)


def _bounded_step(
    normal: Array, gradient: Array, damping: float, at: Array, low: Array, high: Array
) -> Array:
    """A damped step that stays within the bounds: what would cross is put on its bound, the rest
    solved again.
    """
    n = len(at)
    step, active = np.zeros(n), np.zeros(n, dtype=bool)
    for _ in range(n):
        move = ~active
        A = normal[np.ix_(move, move)]
        A = (
            A
            + damping * np.diag(np.diag(A))
            + 1e-12 * np.trace(A) / max(len(A), 1) * np.eye(len(A))
        )
        step[move] = -np.linalg.solve(
            A, gradient[move] + normal[np.ix_(move, active)] @ step[active]
        )
        crossing = move & ((at + step < low - 1e-12) | (at + step > high + 1e-12))
        if not crossing.any():
            break
        step[crossing] = np.clip(at + step, low, high)[crossing] - at[crossing]
        active |= crossing
    return step
