"""The fit: windows + model -> parameters, by Gauss-Newton with the initial states eliminated.

Unknowns are the parameters K and one initial state per window. An initial state affects only its
own window, so it is solved for in closed form (QR) and drops out; a small problem in K alone
remains [Golub & Pereyra 2003, variable projection; Jategaonkar, ch. 4].
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.shooting import (
    Windows,
    jacobian,
    pose_residuals,
    residual_sets,
    select_windows,
)

HUBER = 3.0  # residuals beyond this many sigmas count linearly [Huber 1964]
DIVERGED_COST = 1e12  # of a window whose prediction overflows: fewer of them is a better fit
STANDS_OUT = 3.0  # a window whose cost is so many times the median may be in a local minimum
# A step that fails is tried with so many times more damping, and at least with the least; and with
# these fractions of the step of each window's initial state.
LEAST_DAMPING, DAMPINGS = 1e-5, np.array([1.0, 1e2, 1e4, 1e6, 1e8])
STEP_FRACTIONS = np.array([1.0, 0.3, 0.0])
# Where that gains less than this share of the predicted reduction, steps in K with so many times
# its damping are tried, for each of which the initial states are fitted.
POOR_GAIN, REFIT_DAMPINGS = 0.5, (0.0, 1.0, 1e3, 1e6)
# The part of a step by which the second derivative along it is taken, and the largest ratio of
# acceleration to step [Transtrum & Sethna 2012, whose value this is].
PROBE, MAX_ACCELERATION = 0.1, 0.75
START_FRACTIONS = np.array([1.0, 0.3, 0.1, 0.03, 0.01])  # of a first guess that diverges


@dataclass(frozen=True)
class Prior:
    """Gaussian prior on some of the parameters."""

    mean: dict[str, float]
    sigma: dict[str, float]  # standard deviation of each, in its unit
    correlation: Array | None = None  # (P, P) in the order of `sigma`; None: independent


@dataclass(frozen=True)
class FitResult:
    """The end of a fit, with the linearisation there."""

    model: Model
    initial_states: Array  # (W, n_states)
    residual: Array  # (W, R) weighted: L * 6 of poses, then n_states of the initial state's prior
    parameter_jacobian: Array  # (W, R, F) derivative to the free parameters
    initial_state_jacobian: Array  # (W, R, n_states) derivative to the initial states
    free: tuple[int, ...]  # indices of the fitted parameters
    cost: float  # sum of squared weighted residuals (and of the prior's)
    iterations: int
    converged: bool

    @property
    def linear(self) -> tuple[Array, Array, Array]:
        """Residual and derivatives to the free parameters and to the initial states."""
        return self.residual, self.parameter_jacobian, self.initial_state_jacobian

    @property
    def reduced_jacobian(self) -> Array:
        """(W, R, F) derivative to the free parameters with the initial states eliminated."""
        Q, _ = _qr(self.initial_state_jacobian)
        # Orthogonal projection: what an initial state can explain is removed.
        across = Q.transpose(0, 2, 1) @ self.parameter_jacobian
        return np.asarray(self.parameter_jacobian - Q @ across)

    def reweight(self, factor: Array) -> tuple[Array, Array, Array]:
        """Residual and derivatives with the pose weights times factor (W, L, 6)."""
        f = np.ones_like(self.residual)
        f[:, : factor[0].size] = factor.reshape(len(factor), -1)
        return (
            self.residual * f,
            self.parameter_jacobian * f[..., None],
            self.initial_state_jacobian * f[..., None],
        )


@np.errstate(all="ignore")  # a diverging flight overflows; its cost is infinite
def fit_initial_states(
    model: Model,
    windows: Windows,
    initial_states: Array,
    iterations: int = 8,
    linear: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Fit the initial state of each window with K fixed: Levenberg-Marquardt, damped per window.

    Args:
        model: the aircraft.
        windows: W windows.
        initial_states: (W, n_states) first guess.
        iterations: maximum.
        linear: residual and derivative to the initial states there, if already computed.

    Returns:
        initial_states (W, n_states) and weighted residuals (W, R).
    """
    residual, initial_state_jacobian = linear or jacobian(model, windows, initial_states, ())[::2]
    cost = _window_cost(residual)
    damping = np.full(len(windows), 1e-6)
    for _ in range(iterations):
        step, predicted_reduction = _solve_windows(initial_state_jacobian, residual, damping)
        if np.all(predicted_reduction < 1e-3 * (1.0 + cost)):
            break
        # Most steps are accepted in most windows, so derivatives come along with the trial.
        trial = initial_states - step
        new_residual, _, new_jacobian = jacobian(model, windows, trial, ())
        new_cost = _window_cost(new_residual)
        better = new_cost < cost
        damping = np.where(better, 0.1 * damping, np.maximum(100.0 * damping, 1e-3))
        initial_states = np.where(better[:, None], trial, initial_states)
        residual = np.where(better[:, None], new_residual, residual)
        initial_state_jacobian = np.where(
            better[:, None, None], new_jacobian, initial_state_jacobian
        )
        cost = np.where(better, new_cost, cost)
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
    shrink: Sequence[str] = (),
) -> FitResult:
    """Fit K and all initial states to the windows: Levenberg-Marquardt on the reduced problem.

    Args:
        model: first guess; parameters with low == high are fixed.
        windows: W windows.
        initial_states: (W, n_states) first guess.
        prior: on K, or None.
        iterations: maximum number of steps.
        tolerance: stop when a step is predicted to lower chi2 by less (0.1 moves no parameter by
            more than 0.3 of its sigma); in proportion more where chi2 is far above its expectation.
        linear: residual and derivatives at the first guess, if already computed.
        on_step: called after each Gauss-Newton step with its number and the cost per measurement.
        shrink: names of parameters that begin smaller where the first guess diverges, such as the
            size of an effect, which is nothing at zero.

    Returns:
        The fit; `converged` is False where it ran out of iterations.
    """
    problem = _Problem.of(model, windows, prior)
    here = problem.point(model.vector, initial_states, linear)
    if here.cost >= DIVERGED_COST and shrink:
        here = problem.point(_smaller_start(problem, here, shrink), initial_states)
    if here.cost >= DIVERGED_COST:  # the first guess diverges somewhere: begin with initial states
        model = model.with_vector(here.vector)
        initial_states, _ = fit_initial_states(
            model, windows, initial_states, iterations=3, linear=here.linear[::2]
        )
        here = problem.point(here.vector, initial_states)
    damping, shortened, converged, step_count = 0.0, False, False, 0
    while step_count < iterations and not converged:
        system = problem.linearise(here)
        predicted = problem.predicted_reduction(here, system)
        scale = problem.tolerance_scale(here.cost)
        if predicted < tolerance * scale:
            converged = True
            break
        there = here
        if not shortened:  # a full step is usually accepted, so derivatives come along
            k_step = problem.step(here, system, damping)
            states = here.initial_states + system.state_step + system.state_sensitivity @ k_step
            there = problem.point(problem.parameters_after(here, k_step), states)
        if not there.cost < here.cost:
            there, damping, shortened = _best_shorter_step(problem, here, system, damping)
            if here.cost - there.cost < POOR_GAIN * predicted:
                other = _step_with_fitted_states(problem, here, system, damping, there.cost)
                if other is not None:
                    there, damping = other
                    shortened = False
        if not there.cost < here.cost:
            converged = True
            break
        step_count += 1
        converged = here.cost - there.cost < 0.1 * tolerance * scale
        here, damping = there, (0.1 * damping if damping > 1e-9 else 0.0)
        if on_step:
            on_step(step_count, here.cost / max(windows.count, 1))
    model, initial_states = model.with_vector(here.vector), here.initial_states
    left = iterations - step_count - 1
    if left >= 0:
        # A step for all windows at once can leave the initial state of one where it is no minimum.
        freed, residual = _free_stuck_windows(model, windows, initial_states, here.linear[::2])
        gained = here.cost - problem.cost(residual, here.vector)
        if gained > tolerance * problem.tolerance_scale(here.cost):
            done = step_count + 1
            rest = fit(
                model, windows, freed, prior=prior, iterations=left, tolerance=tolerance,
                on_step=(lambda k, c: on_step(done + k, c)) if on_step else None,
            )  # fmt: skip
            return replace(rest, iterations=done + rest.iterations)
    return FitResult(
        model, initial_states, *here.linear, problem.free, here.cost, step_count, converged
    )


@dataclass(frozen=True)
class _Point:
    """Where the fit is: parameters, initial states and the linearisation there."""

    vector: Array  # (P,)
    initial_states: Array  # (W, n_states)
    linear: tuple[Array, Array, Array]  # residual, derivatives as in FitResult
    cost: float


@dataclass(frozen=True)
class _ReducedSystem:
    """Normal equations in K alone; dx = state_step + state_sensitivity dK for a step dK."""

    normal: Array  # (F, F)
    gradient: Array  # (F,)
    state_step: Array  # (W, n_states) of the initial states where K stays
    state_sensitivity: Array  # (W, n_states, F) derivative of the best initial states to K
    state_reduction: float  # of the cost, by state_step alone


@dataclass(frozen=True)
class _Problem:
    """The least-squares problem of a fit: windows, free parameters, their bounds and prior."""

    model: Model
    windows: Windows
    free: tuple[int, ...]
    low: Array  # (F,)
    high: Array
    prior_factor: Array  # (F, F), as of `prior_rows`
    prior_mean: Array  # (F,)

    @classmethod
    def of(cls, model: Model, windows: Windows, prior: Prior | None) -> "_Problem":
        """Parameters with low == high are fixed."""
        free = tuple(i for i, p in enumerate(model.parameters) if p.high > p.low)
        low = np.array([model.parameters[i].low for i in free])
        high = np.array([model.parameters[i].high for i in free])
        return cls(model, windows, free, low, high, *prior_rows(model, free, prior))

    def point(
        self, vector: Array, initial_states: Array,
        linear: tuple[Array, Array, Array] | None = None,
    ) -> _Point:  # fmt: skip
        """Linearise there, unless that is known."""
        linear = linear or jacobian(
            self.model.with_vector(vector), self.windows, initial_states, self.free
        )
        return _Point(vector, initial_states, linear, self.cost(linear[0], vector))

    def cost(self, residual: Array, vector: Array) -> float:
        """Cost of the windows and of the prior; a diverged window counts as DIVERGED_COST."""
        window_cost = np.minimum(_window_cost(residual), DIVERGED_COST)
        return float(np.sum(window_cost) + np.sum(self.prior_residual(vector) ** 2))

    def tolerance_scale(self, cost: float) -> float:
        """What the tolerance is multiplied by: a poor fit need not be found to the last digit.

        Relative to the cost and to its excess over one for each measured component.
        """
        finite_cost = cost % DIVERGED_COST  # of the windows that do not diverge
        return max(1.0, 1e-4 * finite_cost, 3e-3 * (finite_cost - self.windows.count))

    def prior_residual(self, vector: Array) -> Array:
        """(..., F) of parameters (..., P)."""
        return np.asarray((vector[..., list(self.free)] - self.prior_mean) @ self.prior_factor.T)

    def linearise(self, here: _Point) -> _ReducedSystem:
        """Normal equations in K alone, with the prior as further rows."""
        system = _eliminate_initial_states(*_drop_diverged_windows(*here.linear))
        return replace(
            system,
            normal=system.normal + self.prior_factor.T @ self.prior_factor,
            gradient=system.gradient + self.prior_residual(here.vector) @ self.prior_factor,
        )

    def step(self, here: _Point, system: _ReducedSystem, damping: float) -> Array:
        """(F,) Damped step in K within the bounds."""
        at = here.vector[list(self.free)]
        return _bounded_step(system.normal, system.gradient, damping, at, self.low, self.high)

    def predicted_reduction(self, here: _Point, system: _ReducedSystem) -> float:
        """Reduction of the cost by a full step in the linearised problem."""
        step = self.step(here, system, 0.0)
        of_parameters = -2.0 * system.gradient @ step - step @ system.normal @ step
        return float(of_parameters) + system.state_reduction

    def parameters_after(self, here: _Point, k_step: Array) -> Array:
        """(..., P) Parameters after steps (..., F), within the bounds."""
        free = list(self.free)
        vector = np.broadcast_to(here.vector, (*k_step.shape[:-1], len(here.vector))).copy()
        vector[..., free] = np.clip(here.vector[free] + k_step, self.low, self.high)
        return vector


def _smaller_start(problem: _Problem, here: _Point, names: Sequence[str]) -> Array:
    """(P,) The first guess, with some parameters reduced until fewest windows diverge.

    To the largest such one of START_FRACTIONS, within the bounds; parameters that are fixed stay.
    """
    at = here.vector[list(problem.free)]
    smaller = np.isin([problem.model.names[i] for i in problem.free], list(names))
    fractions = np.where(smaller, START_FRACTIONS[:, None], 1.0)  # (T, F)
    trials = problem.parameters_after(here, (fractions - 1.0) * at)
    states = np.repeat(here.initial_states[None], len(trials), axis=0)
    residual = residual_sets(problem.model, problem.windows, states, trials.T)
    return np.asarray(trials[int(np.argmin(has_diverged(residual).sum(axis=1)))])


def _geodesic_accelerations(
    problem: _Problem, here: _Point, system: _ReducedSystem, k_steps: Array, dampings: Array
) -> tuple[Array, Array]:
    """Second-order corrections of steps in a curved valley: geodesic acceleration.

    The residuals' second derivative along a step, by a difference, is answered by a step of its
    own, and half of that is added [Transtrum & Sethna 2012]. One that is large against the step
    itself is refused, and zero.

    Args:
        k_steps: (T, F) steps in K; the initial states take their linearised ones.
        dampings: (T,) of these steps.

    Returns:
        What to add to the steps (T, F) and to those of the initial states (T, W, n_states).
    """
    residual, J_K, J_x = _drop_diverged_windows(*here.linear)
    Q, R, across, reduced = _split_by_initial_states(J_K, J_x)
    state_steps = system.state_step + np.einsum("wnf,tf->twn", system.state_sensitivity, k_steps)
    ahead = residual_sets(
        problem.model, problem.windows, here.initial_states + PROBE * state_steps,
        problem.parameters_after(here, PROBE * k_steps).T,
    )  # fmt: skip
    along = np.einsum("wrf,tf->twr", J_K, k_steps) + np.einsum("wrn,twn->twr", J_x, state_steps)
    bend = 2.0 / PROBE * ((ahead - residual) / PROBE - along)  # (T, W, R)
    usable = np.isfinite(bend).all(axis=2) & J_K.any(axis=(1, 2))  # not those that were dropped
    bend = np.asarray(np.where(usable[..., None], bend, 0.0))
    k_extra = np.zeros_like(k_steps)
    for t, (step, damping) in enumerate(zip(k_steps, dampings, strict=True)):
        gradient = np.einsum("wrf,wr->f", reduced, bend[t], optimize=True)
        extra = 0.5 * problem.step(here, replace(system, gradient=gradient), float(damping))
        if 2.0 * _norm(extra, system) <= MAX_ACCELERATION * _norm(step, system):
            k_extra[t] = extra
    inside = np.einsum("wrn,twr->twn", Q, bend) * 0.5 + np.einsum("wnf,tf->twn", across, k_extra)
    x_extra = -np.linalg.solve(R[None], inside[..., None]).squeeze(-1)
    x_extra[~np.asarray(k_extra.any(axis=1))] = 0.0
    return k_extra, x_extra


def _norm(step: Array, system: _ReducedSystem) -> float:
    """Length of a step (F,) with Marquardt's scaling."""
    return float(np.sqrt(np.sum(np.diag(system.normal) * step**2)))


def _best_shorter_step(
    problem: _Problem, here: _Point, system: _ReducedSystem, damping: float
) -> tuple[_Point, float, bool]:
    """The best of the damped step and of some with more damping, all integrated together.

    Each is tried straight and with geodesic acceleration, which follows a curved valley. An initial
    state acts on its own window only, so each takes that fraction of its own step with which its
    window fits best.

    Returns:
        Where it leads (`here` where none is better), its damping, and whether the damped step in
        full does not lower the cost.
    """
    dampings = [damping, *(max(30.0 * damping, LEAST_DAMPING) * DAMPINGS)]
    k_steps = np.stack([problem.step(here, system, d) for d in dampings])  # (T, F)
    k_extra, x_extra = _geodesic_accelerations(problem, here, system, k_steps, np.array(dampings))
    optimal = here.initial_states + np.einsum("wnf,tf->twn", system.state_sensitivity, k_steps)
    bent = np.flatnonzero(k_extra.any(axis=1))  # steps whose acceleration is taken
    optimal = np.concatenate([optimal, (optimal + x_extra)[bent]])
    trials = problem.parameters_after(here, np.concatenate([k_steps, (k_steps + k_extra)[bent]]))
    dampings = [*dampings, *(dampings[t] for t in bent)]
    states = optimal[:, None] + STEP_FRACTIONS[:, None, None] * system.state_step  # (T, S, W, n)
    residual = residual_sets(
        problem.model, problem.windows, states.reshape(-1, *here.initial_states.shape),
        np.repeat(trials, len(STEP_FRACTIONS), axis=0).T,
    )  # fmt: skip
    cost = np.minimum(_window_cost(residual), DIVERGED_COST).reshape(states.shape[:3])  # (T, S, W)
    prior_cost = np.sum(problem.prior_residual(trials) ** 2, axis=1)
    total = cost.min(axis=1).sum(axis=1) + prior_cost
    best = int(np.argmin(total))
    full_fails = not cost[0, 0].sum() + prior_cost[0] < here.cost
    if not total[best] < here.cost:
        return here, float(dampings[best]), full_fails
    fraction = cost[best].argmin(axis=0)  # (W,)
    there = problem.point(trials[best], states[best, fraction, np.arange(len(fraction))])
    return there, float(dampings[best]), full_fails


def _step_with_fitted_states(
    problem: _Problem, here: _Point, system: _ReducedSystem, damping: float, least: float
) -> tuple[_Point, float] | None:
    """The longest step in K that lowers the cost below `least` once initial states are fitted anew.

    For a start so far away that the linearised steps of the initial states do not help.
    """
    for factor in REFIT_DAMPINGS:
        damped = max(30.0 * damping, LEAST_DAMPING) * factor if factor > 0.0 else damping
        vector = problem.parameters_after(here, problem.step(here, system, damped))
        states, residual = fit_initial_states(
            problem.model.with_vector(vector), problem.windows, here.initial_states, iterations=3
        )
        if problem.cost(residual, vector) < least:
            return problem.point(vector, states), damped
    return None


def _free_stuck_windows(
    model: Model, windows: Windows, initial_states: Array, linear: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Initial states (W, n_states) fitted once more, and residuals (W, R).

    Those of windows that stand out are also fitted from the first guess, which the poses give.
    `linear`: residual and derivative to the initial states, as the fit left them.
    """
    states, residual = fit_initial_states(model, windows, initial_states, linear=linear)
    cost = _window_cost(residual)
    apart = np.flatnonzero(cost > STANDS_OUT * np.median(cost))
    if len(apart):
        guess = windows.initial_guess[apart, : model.n_states]
        anew, residual_anew = fit_initial_states(model, select_windows(windows, apart), guess)
        better = _window_cost(residual_anew) < cost[apart]
        states, residual = states.copy(), residual.copy()
        states[apart[better]], residual[apart[better]] = anew[better], residual_anew[better]
    return states, residual


def sqrt_huber_weight(residual: Array, windows: Windows) -> Array:
    """Square root of Huber's IRLS weight (W, L, 6) of residuals (W, R): 1 within HUBER sigmas."""
    size = np.abs(pose_residuals(residual, windows))
    return np.sqrt(np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))


def has_diverged(residual: Array) -> Array:
    """(..., W) Whether the prediction of a window has diverged, from residuals (..., W, R)."""
    return np.asarray(_window_cost(residual) >= DIVERGED_COST)


def _window_cost(residual: Array) -> Array:
    """Cost (..., W) of each window from residuals (..., W, R); infinite where it diverged."""
    cost = np.einsum("...i,...i->...", residual, residual)
    return np.nan_to_num(cost, nan=np.inf, posinf=np.inf)


def prior_rows(model: Model, free: tuple[int, ...], prior: Prior | None) -> tuple[Array, Array]:
    """A prior as further rows of the least-squares problem: rows @ (K - mean) has unit covariance.

    Returns:
        rows (F, F) and mean (F,) of the free parameters; rows of zeros without a prior.
    """
    names = [model.names[i] for i in free]
    rows, mean = np.zeros((len(free), len(free))), np.zeros(len(free))
    if prior is None:
        return rows, mean
    known = [name for name in prior.sigma if name in names]
    columns = [names.index(name) for name in known]
    mean[columns] = [prior.mean[name] for name in known]
    sigma = np.array([prior.sigma[name] for name in known])
    correlation = np.eye(len(known))
    if prior.correlation is not None:
        order = [list(prior.sigma).index(name) for name in known]
        correlation = prior.correlation[np.ix_(order, order)]
    # Whitening: covariance = S C S with S = diag(sigma), C = V diag(v) V', so the rows are
    # diag(v)^-1/2 V' S^-1; eigenvalues are bounded from below, C may be singular.
    values, vectors = np.linalg.eigh(correlation)
    rows[np.ix_(columns, columns)] = (vectors / np.sqrt(np.maximum(values, 1e-9))).T / sigma
    return rows, mean


def _qr(initial_state_jacobian: Array) -> tuple[Array, Array]:
    """QR of each window's derivative to its initial state; zeros where it diverged."""
    return np.linalg.qr(np.nan_to_num(initial_state_jacobian, posinf=0.0, neginf=0.0))


def _solve_windows(
    initial_state_jacobian: Array, residual: Array, damping: Array
) -> tuple[Array, Array]:
    """Damped steps (W, n) of the initial states, to be subtracted, and predicted gains (W,)."""
    J = np.nan_to_num(initial_state_jacobian, posinf=0.0, neginf=0.0)
    r = np.nan_to_num(residual, posinf=0.0, neginf=0.0)
    transposed = J.transpose(0, 2, 1)
    right = (transposed @ r[..., None])[..., 0]
    normal = transposed @ J
    # Marquardt's scaling of the damping, with a floor for states that hardly act; the einsum is a
    # view, so the diagonal of `normal` changes in place.
    diagonal = np.einsum("wii->wi", normal)
    floor = 1e-3 * diagonal.max(axis=1, keepdims=True)
    diagonal += damping[:, None] * np.maximum(diagonal, floor) + 1e-9
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(step), np.asarray(np.sum(step * right, axis=1))


def _drop_diverged_windows(
    residual: Array, parameter_jacobian: Array, initial_state_jacobian: Array
) -> tuple[Array, Array, Array]:
    """The same with zero residuals and derivatives to K in every window that has diverged.

    Its cost stays infinite, so a step is judged by whether it flies again; the direction of the
    step comes from the others.
    """
    rows = np.concatenate([residual[..., None], parameter_jacobian], axis=2)
    finite = np.asarray(np.isfinite(rows).all(axis=(1, 2)))
    if finite.all():
        return residual, parameter_jacobian, initial_state_jacobian
    return (
        np.where(finite[:, None], residual, 0.0),
        np.where(finite[:, None, None], parameter_jacobian, 0.0),
        initial_state_jacobian,
    )


def _split_by_initial_states(
    parameter_jacobian: Array, initial_state_jacobian: Array
) -> tuple[Array, Array, Array, Array]:
    """Q and R of each window's derivative to its initial state, Q'J_K, and the rest of J_K.

    The prior on the initial states keeps R regular; a state that overflowed leaves a zero there.
    """
    Q, R = _qr(initial_state_jacobian)
    across = Q.transpose(0, 2, 1) @ parameter_jacobian  # (W, n, F)
    R = R + 1e-12 * np.abs(R).max(axis=(1, 2), keepdims=True) * np.eye(R.shape[-1])
    return Q, R, across, parameter_jacobian - Q @ across


def _eliminate_initial_states(
    residual: Array, parameter_jacobian: Array, initial_state_jacobian: Array
) -> _ReducedSystem:
    """Minimise |r + J_K dK + J_x dx|^2 per window, J_x = Q R.

    The part orthogonal to Q gives the Schur complement in K, the part along Q gives
    dx = -R^-1 (Q'r + Q'J_K dK).
    """
    Q, R, across, reduced_jacobian = _split_by_initial_states(
        parameter_jacobian, initial_state_jacobian
    )
    normal = np.einsum("wif,wig->fg", reduced_jacobian, reduced_jacobian, optimize=True)
    gradient = np.einsum("wif,wi->f", reduced_jacobian, residual, optimize=True)
    inside = np.einsum("win,wi->wn", Q, residual)  # its square is the reduction by dx alone
    steps = -np.linalg.solve(R, np.concatenate([inside[..., None], across], axis=2))
    return _ReducedSystem(normal, gradient, steps[..., 0], steps[..., 1:], float(np.sum(inside**2)))


def _bounded_step(
    normal: Array, gradient: Array, damping: float, at: Array, low: Array, high: Array
) -> Array:
    """Damped step within the bounds: the minimum over the box, by bounded-variable least squares.

    Parameters that cross are not simply set on their bounds: with the others solved for there, the
    cost may rise [Stark & Parker 1995].
    """
    from scipy.optimize import lsq_linear

    diagonal = np.diag(normal)
    regularisation = np.full(len(at), 1e-12 * diagonal.sum() / max(len(at), 1) + 1e-30)
    # A parameter whose input never moved has no information and takes no step.
    regularisation[diagonal < 1e-12 * max(diagonal.max(initial=0.0), 1e-30)] += 1.0
    A = normal + np.diag(damping * diagonal + regularisation)
    if not (np.isfinite(A).all() and np.isfinite(gradient).all()):
        return np.zeros(len(at))  # derivatives that overflowed give no direction
    step = np.asarray(-np.linalg.solve(A, gradient))
    if np.all((at + step >= low - 1e-12) & (at + step <= high + 1e-12)):
        return step
    # |B x - b|^2 = x'A x + 2 g'x and a constant, each unknown in the size that its own term gives.
    size = 1.0 / np.sqrt(np.diag(A))
    value, vector = np.linalg.eigh(A * np.outer(size, size))
    root = np.sqrt(np.maximum(value, 1e-12))
    B, b = root[:, None] * vector.T, -(vector.T @ (size * gradient)) / root
    box = (low - at) / size, (high - at) / size
    return np.asarray(size * lsq_linear(B, b, box, method="bvls", max_iter=10 * len(at)).x)
