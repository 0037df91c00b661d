"""The fit against known truth, SciPy's optimiser on the same problem, and dense linear algebra."""

import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import FORMS, paper_model, rates_model
from falconwing_kit.sysid.fit import Prior, fit, fit_initial_states, sqrt_huber_weight
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import (
    cut_windows,
    fly_windows,
    jacobian,
    pose_residuals,
    residuals,
)
from tests.sysid.simulated import MARKER, drawn, fly_figure_eights, measured

fit_module = sys.modules["falconwing_kit.sysid.fit"]  # the package's `fit` is the function
SIGMA = np.array([MARKER[0]] * 3 + [MARKER[1]] * 3)
SMALL = ("L_da", "M_de", "M_alpha", "N_dr")  # free in the small problems


def simulated(form, seconds, seed, noise=MARKER):
    """An aircraft and the windows of a flight of it."""
    rng = np.random.default_rng(seed)
    truth = drawn(FORMS[form](), rng)
    table = measured(fly_figure_eights([truth], seconds, rng), rng, noise=noise)
    return truth, cut_windows(prepare(table, SIGMA).flights, truth)


def with_free(model, names):
    return model.with_fixed([name for name in model.names if name not in names])


@pytest.fixture(scope="module")
def small():
    """8 s of noisy flight, three windows, four free parameters 10 % off: model, windows, initial
    states.
    """
    truth, windows = simulated("paper", 8.0, seed=12)
    start = with_free(truth.with_values({name: 1.1 * truth.values[name] for name in SMALL}), SMALL)
    return start, windows, windows.initial_guess[:, :9]


def scipy_fit(model, windows, initial_states, prior=None):
    """The same sum of squares by SciPy: trust region, dense differences, nothing eliminated."""
    free = [i for i, p in enumerate(model.parameters) if p.low < p.high]
    shape = initial_states.shape

    def everything(z):
        vector = model.vector
        vector[free] = z[: len(free)]
        rows = [
            residuals(model.with_vector(vector), windows, z[len(free) :].reshape(shape)).ravel()
        ]
        if prior is not None:
            names = [model.names[i] for i in free]
            away = np.array([vector[model.names.index(n)] - prior.mean[n] for n in names])
            sigma = np.array([prior.sigma[n] for n in names])
            correlation = np.eye(len(names)) if prior.correlation is None else prior.correlation
            rows.append(
                np.linalg.cholesky(np.linalg.inv(correlation * np.outer(sigma, sigma))).T @ away
            )
        return np.concatenate(rows)

    wide = np.full(initial_states.size, np.inf)
    low, high = (
        np.array([getattr(model.parameters[i], side) for i in free]) for side in ("low", "high")
    )
    bounds = (np.concatenate([low, -wide]), np.concatenate([high, wide]))
    begin = np.concatenate([np.clip(model.vector[free], low, high), initial_states.ravel()])
    found = least_squares(
        everything, begin, "2-point", bounds, x_scale="jac", xtol=1e-9, ftol=1e-10, gtol=1e-9
    )
    return dict(zip([model.names[i] for i in free], found.x, strict=False)), 2.0 * found.cost


# Known truth


@pytest.mark.parametrize("form", FORMS)
def test_parameters_of_a_noiseless_flight_come_back(form):
    """The inverse of a prediction, to 1e-4, from a start 15 % off in each (standard deviation).
    Where the true value is zero: 1e-4 of a twentieth of the range.
    """
    truth, windows = simulated(form, 30.0, seed=10)
    windows = replace(
        windows, pose=fly_windows(truth, windows, windows.initial_guess[:, : truth.n_states])
    )
    start = FORMS[form]()
    initial_states, _ = fit_initial_states(
        start, windows, windows.initial_guess[:, : truth.n_states]
    )
    found = fit(start, windows, initial_states, tolerance=1e-9)
    size = np.array([abs(p.start) or max(0.05 * (p.high - p.low), 1e-9) for p in truth.parameters])
    assert found.converged and found.cost < 1e-6
    off = np.abs(found.model.vector - truth.vector) / size
    assert dict(zip(truth.names, off < 1e-4, strict=True)) == dict.fromkeys(truth.names, True)


def test_a_window_that_begins_in_a_local_minimum_is_freed():
    """One window's first guess is off as one of a lost aircraft's fit was (6 rad/s in pitch rate,
    2 to 3 m/s): the same cost as from good guesses. A step for all windows at once left it there.
    """
    truth, windows = simulated("rates", 30.0, seed=12)
    states, _ = fit_initial_states(truth, windows, windows.initial_guess)
    good = fit(truth, windows, states)
    begun = good.initial_states.copy()
    begun[0] += [0.117, 0.133, -0.108, 0.026, -0.032, -0.111, -2.31, -2.85, 2.14, 2.06, -6.14, -0.1]
    steps = []
    found = fit(truth, windows, begun, on_step=lambda number, cost: steps.append(number))
    assert found.cost == pytest.approx(good.cost, abs=1.0)
    assert steps == sorted(set(steps)) and found.iterations >= steps[-1]


def test_a_finer_simulation_gives_nearly_the_same():
    """Simulated with 10 ms steps and another servo: the error of 25 ms steps is below 1e-3 of a
    parameter, below 0.1 ms of delay and lag.
    """
    truth, windows = simulated("rates", 60.0, seed=11, noise=(0.0, 0.0))
    initial_states, _ = fit_initial_states(truth, windows, windows.initial_guess)
    found = fit(rates_model(), windows, initial_states, tolerance=1e-6).model
    off = {n: found.values[n] - truth.values[n] for n in truth.names}
    assert max(abs(off["delay"]), abs(off["lag"])) < 1e-4
    ordinary = [p.name for p in truth.parameters if p.start and p.name not in ("delay", "lag")]
    assert {n: abs(off[n]) < 1e-3 * abs(truth.values[n]) for n in ordinary} == dict.fromkeys(
        ordinary, True
    )


# An independent optimiser


def test_the_minimum_is_scipys(small):
    """SciPy's least_squares on the same residuals: cost to 1e-6, parameters to 1e-4."""
    start, windows, initial_states = small
    expected, cost = scipy_fit(start, windows, initial_states)
    found = fit(start, windows, initial_states, tolerance=1e-9)
    assert found.cost == pytest.approx(cost, rel=1e-6)
    assert {n: found.model.values[n] for n in SMALL} == pytest.approx(expected, rel=1e-4)
    assert abs(found.model.values["L_da"] / start.values["L_da"] - 1.0) > 0.02  # it did move


def test_bounds_hold_and_the_rest_settles_as_in_scipy(small):
    """The true M_alpha is above its bound: it ends on the bound, the others as in SciPy."""
    start, windows, initial_states = small
    high = start.values["M_alpha"]
    parameters = tuple(
        replace(p, low=3.0 * high, high=high) if p.name == "M_alpha" else p
        for p in start.parameters
    )
    bounded = replace(start, parameters=parameters).with_values({"M_alpha": 1.2 * high})
    expected, cost = scipy_fit(bounded, windows, initial_states)
    found = fit(bounded, windows, initial_states, tolerance=1e-9)
    assert found.model.values["M_alpha"] == high
    assert found.cost == pytest.approx(cost, rel=1e-5)
    assert {n: found.model.values[n] for n in SMALL} == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_a_bounded_step_is_the_minimum_over_the_box(seed):
    """Convex quadratics in boxes that hold the start: as L-BFGS-B has them, and never worse than no
    step at all, from which a fit would conclude that it has ended.
    """
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(9, 6)) * np.geomspace(1.0, 100.0, 6)
    normal, gradient = root.T @ root, root.T @ rng.normal(size=9)
    at = rng.normal(size=6)
    low, high = at - rng.uniform(0.0, 0.02, 6), at + rng.uniform(0.0, 0.02, 6)
    step = fit_module._bounded_step(normal, gradient, 0.0, at, low, high)

    def reduction(s):
        return -2.0 * gradient @ s - s @ normal @ s

    peer = minimize(
        lambda s: -reduction(s), np.zeros(6), jac=lambda s: 2.0 * (gradient + normal @ s),
        bounds=list(zip(low - at, high - at, strict=True)), method="L-BFGS-B",
        options={"ftol": 1e-15, "gtol": 1e-10},
    )  # fmt: skip
    assert np.all((at + step >= low - 1e-9) & (at + step <= high + 1e-9))
    assert reduction(step) > 0.0
    assert reduction(step) == pytest.approx(-peer.fun, rel=1e-6)


def test_derivatives_that_overflowed_give_no_step():
    """Not an exception of the linear algebra."""
    normal = np.diag([1.0, np.nan])
    step = fit_module._bounded_step(normal, np.ones(2), 0.0, np.zeros(2), -np.ones(2), np.ones(2))
    assert np.array_equal(step, [0.0, 0.0])


def test_a_prior_acts_as_in_scipy(small):
    """Mean 20 % above, 1 % wide, L_da and M_de correlated: as rows of SciPy's sum of squares."""
    start, windows, initial_states = small
    correlation = np.eye(4)
    correlation[0, 1] = correlation[1, 0] = 0.8
    mean = {n: 1.2 * start.values[n] for n in SMALL}
    prior = Prior(mean, {n: 0.01 * abs(mean[n]) for n in SMALL}, correlation)
    expected, cost = scipy_fit(start, windows, initial_states, prior)
    found = fit(start, windows, initial_states, prior=prior, tolerance=1e-9)
    free = fit(start, windows, initial_states, tolerance=1e-9)
    assert found.cost == pytest.approx(cost, rel=1e-6)
    assert {n: found.model.values[n] for n in SMALL} == pytest.approx(expected, rel=1e-4)
    assert found.model.values["M_de"] > 1.01 * free.model.values["M_de"]


def test_a_prior_acts_as_in_gaussian_theory(small):
    """Linear near the minimum: K + (N + P)^-1 P (mean - K), N of the data and P of the prior."""
    start, windows, initial_states = small
    free = fit(start, windows, initial_states, tolerance=1e-9)
    N = np.einsum("wif,wig->fg", free.reduced_jacobian, free.reduced_jacobian)
    K = np.array([free.model.values[n] for n in SMALL])
    sigma = 1.0 / np.sqrt(np.diag(N))
    mean = K + 0.5 * sigma
    prior = Prior(dict(zip(SMALL, mean, strict=True)), dict(zip(SMALL, sigma, strict=True)))
    P = np.diag(sigma**-2.0)
    expected = K + np.linalg.solve(N + P, P @ (mean - K))
    found = fit(start, windows, initial_states, prior=prior, tolerance=1e-9)
    moved = np.array([found.model.values[n] for n in SMALL]) - K
    assert moved == pytest.approx(expected - K, abs=0.02 * np.abs(expected - K).max())


def test_a_sharp_prior_wins(small):
    """The limit is the prior's mean."""
    start, windows, initial_states = small
    prior = Prior({"M_de": 0.5}, {"M_de": 1e-9})
    assert fit(start, windows, initial_states, prior=prior).model.values["M_de"] == pytest.approx(
        0.5, abs=1e-7
    )


def test_initial_states_alone_are_scipys_too(small):
    """K fixed: nine unknowns per window, from states up to 1 m, 0.2 rad and 1 m/s off. It stops at
    a thousandth of the cost.
    """
    start, windows, initial_guess = small
    truth = start.with_fixed(start.names)
    rng = np.random.default_rng(1)
    initial_states = initial_guess + rng.uniform(-1.0, 1.0, initial_guess.shape) * np.repeat(
        [1.0, 0.2, 1.0], 3
    )
    found, residual = fit_initial_states(truth, windows, initial_states)
    _, cost = scipy_fit(truth, windows, initial_guess)
    assert np.sum(residual**2) == pytest.approx(cost, rel=1e-3)
    assert residual == pytest.approx(residuals(truth, windows, found), abs=1e-9)


def test_initial_states_from_known_derivatives_are_the_same(small):
    """Residual and derivative computed before: the same states and residuals, and one linearisation
    less, none at all where the states are a minimum already.
    """
    start, windows, initial_states = small
    calls = []

    def counted(*arguments):
        calls.append(1)
        return jacobian(*arguments)

    residual, _, derivative = jacobian(start, windows, initial_states, ())
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(fit_initial_states.__wrapped__.__globals__, "jacobian", counted)
        plain = fit_initial_states(start, windows, initial_states)
        all_calls = len(calls)
        known = fit_initial_states(start, windows, initial_states, linear=(residual, derivative))
        assert len(calls) == 2 * all_calls - 1
        residual, _, derivative = jacobian(start, windows, known[0], ())
        calls.clear()
        again = fit_initial_states(start, windows, known[0], linear=(residual, derivative))
    assert not calls
    assert again[0] is known[0]
    for got, expected in zip(known, plain, strict=True):
        np.testing.assert_array_equal(got, expected)


# Linear algebra


def dense(found):
    """The whole Jacobian as a matrix: free parameters, then initial states window by window."""
    n_windows, n_rows, n_free = found.parameter_jacobian.shape
    n = found.initial_state_jacobian.shape[2]
    J = np.zeros((n_windows * n_rows, n_free + n_windows * n))
    for w in range(n_windows):
        rows = slice(w * n_rows, (w + 1) * n_rows)
        J[rows, :n_free] = found.parameter_jacobian[w]
        J[rows, n_free + w * n : n_free + (w + 1) * n] = found.initial_state_jacobian[w]
    return J


def test_eliminating_initial_states_equals_the_whole_problem(small):
    """Schur complement by dense NumPy: the inverse's block of K inverts the reduced matrix."""
    start, windows, initial_states = small
    found = fit(start, windows, initial_states)
    J = dense(found)
    scale = 1.0 / np.linalg.norm(J, axis=0)
    inverse = np.linalg.inv((J * scale).T @ (J * scale)) * np.outer(scale, scale)
    reduced_jacobian = np.einsum("wif,wig->fg", found.reduced_jacobian, found.reduced_jacobian)
    assert np.linalg.inv(reduced_jacobian) == pytest.approx(inverse[:4, :4], rel=1e-6)


def test_one_step_is_the_gauss_newton_step_of_the_whole_problem(small):
    """One iteration: the dense least-squares solution in K and in the initial states."""
    start, windows, initial_states = small
    before = fit(start, windows, initial_states, iterations=0)
    step = np.linalg.lstsq(dense(before), -before.residual.ravel(), rcond=None)[0]
    after = fit(start, windows, initial_states, iterations=1)
    free = list(after.free)
    assert after.model.vector[free] - start.vector[free] == pytest.approx(step[:4], rel=1e-5)
    assert after.initial_states - initial_states == pytest.approx(
        step[4:].reshape(initial_states.shape), rel=1e-4, abs=1e-6
    )
    assert (before.iterations, before.converged, after.iterations) == (0, False, 1)


# Ways and means


def test_fixed_parameters_do_not_change(small):
    """Equal bounds: no digit changes, even with a prior on the parameter."""
    start, windows, initial_states = small
    found = fit(start, windows, initial_states, prior=Prior({"kT": 1.0}, {"kT": 0.1}))
    assert {n: v for n, v in found.model.values.items() if n not in SMALL} == {
        n: v for n, v in start.values.items() if n not in SMALL
    }
    assert tuple(start.names[i] for i in found.free) == tuple(n for n in start.names if n in SMALL)


def test_a_bad_start_gets_to_the_same_minimum(small):
    """Two parameters off by a factor of two, a cost a thousand times higher: the same end."""
    start, windows, initial_states = small
    near = fit(start, windows, initial_states, tolerance=1e-6)
    far = start.with_values(
        {"L_da": 2.0 * start.values["L_da"], "M_alpha": 0.5 * start.values["M_alpha"]}
    )
    found = fit(far, windows, initial_states, tolerance=1e-6)
    assert np.sum(residuals(far, windows, initial_states) ** 2) > 1e3 * near.cost
    assert found.converged and found.cost == pytest.approx(near.cost, rel=1e-6)


def test_a_size_with_which_the_flight_diverges_begins_smaller(small):
    """Thrust that grows with the square of speed: dv/dt = k v^2 is infinite after 1 / (k v), here
    0.1 s. Its true size is zero, so the end is that of a fit that begins there.
    """
    start, windows, initial_states = small
    effect = next(e for e in CATALOGUE if e.name == "extra_drag")
    pushed = start.with_effect(replace(
        effect, parameters=(replace(effect.parameters[0], low=-100.0, high=100.0),)
    ))  # fmt: skip
    name = effect.parameters[0].name
    near = fit(pushed.with_values({name: 0.0}), windows, initial_states, tolerance=1e-6)
    far = pushed.with_values({name: -2.0})
    assert not np.isfinite(residuals(far, windows, initial_states)).all()
    found = fit(far, windows, initial_states, tolerance=1e-6, shrink=[name])
    assert found.cost == pytest.approx(near.cost, rel=1e-6)


@pytest.mark.parametrize(("times", "offset", "is_bent"), [(3.0, 0.3, False), (1.3, 0.0, True)])
def test_a_shorter_step_is_the_best_of_all_that_are_tried(small, times, offset, is_bent):
    """Every damping, straight and accelerated, with every fraction of each window's own step,
    predicted one by one: the least cost of one is the sum of each window's least. Far away the
    acceleration is refused; nearer, in the valley, an accelerated step is the best.
    """
    start, windows, initial_states = small
    far = start.with_values({name: times * start.values[name] for name in SMALL})
    problem = fit_module._Problem.of(far, windows, None)
    here = problem.point(far.vector, initial_states + offset)
    system = problem.linearise(here)
    dampings = np.array([0.0, *(fit_module.LEAST_DAMPING * fit_module.DAMPINGS)])
    straight = np.stack([problem.step(here, system, damping) for damping in dampings])
    k_extra, x_extra = fit_module._geodesic_accelerations(problem, here, system, straight, dampings)
    costs = []
    for accelerated in (False, True):
        for k_step, k_more, x_more in zip(straight, k_extra, x_extra, strict=True):
            moved = far.with_vector(problem.parameters_after(here, k_step + accelerated * k_more))
            each = []
            for fraction in fit_module.STEP_FRACTIONS:
                step = fraction * system.state_step + system.state_sensitivity @ k_step
                states = here.initial_states + step + accelerated * x_more
                with np.errstate(all="ignore"):
                    each.append(np.sum(residuals(moved, windows, states) ** 2, axis=1))
            costs.append(np.sum(np.nanmin(np.minimum(each, fit_module.DIVERGED_COST), axis=0)))
    there, _, full_fails = fit_module._best_shorter_step(problem, here, system, 0.0)
    assert there.cost == pytest.approx(min(costs), rel=1e-9) and there.cost < here.cost
    assert np.argmin(costs) > 0 and full_fails != is_bent
    assert (np.argmin(costs) >= len(dampings)) == is_bent == k_extra.any()


def test_acceleration_is_the_second_order_step(small):
    """By dense algebra over parameters and all initial states at once: half of what answers the
    second derivative of the residuals along the step, here by central differences
    [Transtrum & Sethna 2012].
    """
    start, windows, initial_states = small
    far = start.with_values({name: 1.05 * start.values[name] for name in SMALL})
    problem = fit_module._Problem.of(far, windows, None)
    here = problem.point(far.vector, initial_states + 0.01)
    system = problem.linearise(here)
    damping, n = 0.01, initial_states.shape[1]
    k_step = problem.step(here, system, damping)
    k_extra, x_extra = fit_module._geodesic_accelerations(
        problem, here, system, k_step[None], np.array([damping])
    )

    _, J_K, J_x = here.linear
    W, R, F = J_K.shape
    J = np.zeros((W * R, F + W * n))
    J[:, :F] = J_K.reshape(-1, F)
    for w in range(W):
        J[w * R : (w + 1) * R, F + w * n : F + (w + 1) * n] = J_x[w]
    states = system.state_step + system.state_sensitivity @ k_step

    def at(h):
        moved = far.with_vector(problem.parameters_after(here, h * k_step))
        return residuals(moved, windows, here.initial_states + h * states).ravel()

    h = 0.02
    bend = (at(h) - 2.0 * at(0.0) + at(-h)) / h**2
    normal = J.T @ J
    normal[range(F), range(F)] += damping * np.diag(system.normal)
    half = -0.5 * np.linalg.solve(normal, J.T @ bend)
    assert 0.005 < np.linalg.norm(half[:F]) / np.linalg.norm(k_step) < 0.3  # not refused
    assert k_extra[0] == pytest.approx(half[:F], rel=0.05, abs=0.02 * np.abs(half[:F]).max())
    assert x_extra[0].ravel() == pytest.approx(half[F:], abs=0.05 * np.abs(half[F:]).max())


def test_a_step_with_fitted_states_is_the_longest_that_helps(small):
    """Steps with more and more damping, each with the initial states fitted to it: the first whose
    cost is below the least so far; none where nothing is.
    """
    start, windows, initial_states = small
    far = start.with_values({name: 3.0 * start.values[name] for name in SMALL})
    problem = fit_module._Problem.of(far, windows, None)
    here = problem.point(far.vector, initial_states + 0.3)
    system = problem.linearise(here)
    dampings, costs = [], []
    for factor in fit_module.REFIT_DAMPINGS:
        dampings.append(30.0 * 0.01 * factor if factor else 0.01)
        step = problem.step(here, system, dampings[-1])
        vector = problem.parameters_after(here, step)
        _, residual = fit_module.fit_initial_states(
            far.with_vector(vector), windows, here.initial_states, iterations=3
        )
        costs.append(problem.cost(residual, vector))
    for limit in (1.1 * max(costs), 1.001 * sorted(costs)[1], 1.001 * min(costs)):
        there, damping = fit_module._step_with_fitted_states(problem, here, system, 0.01, limit)
        first = next(k for k, cost in enumerate(costs) if cost < limit)
        assert (there.cost, damping) == pytest.approx((costs[first], dampings[first]), rel=1e-6)
    least = min(costs)
    assert fit_module._step_with_fitted_states(problem, here, system, 0.01, least) is None


def test_every_step_lowers_the_cost_and_is_reported(small):
    """Steps that raise it are undone; `on_step` gets the others with their number."""
    start, windows, initial_states = small
    reported = []
    found = fit(
        start,
        windows,
        initial_states,
        tolerance=1e-6,
        on_step=lambda i, chi2: reported.append((i, chi2)),
    )
    assert [i for i, _ in reported] == list(range(1, found.iterations + 1))
    chi2 = [c for _, c in reported]
    assert all(b < a for a, b in pairwise(chi2))
    assert chi2[-1] == pytest.approx(found.cost / windows.count)


def test_a_known_linearisation_saves_only_time(small):
    """Weights times a factor: residual and derivatives follow by multiplication."""
    start, windows, initial_states = small
    factor = np.random.default_rng(0).uniform(0.3, 1.0, windows.weight.shape)
    first = fit(start, windows, initial_states)
    linear = first.reweight(factor)
    quick = fit(first.model, windows.scale_weights(factor), first.initial_states, linear=linear)
    plain = fit(first.model, windows.scale_weights(factor), first.initial_states)
    assert quick.cost == pytest.approx(plain.cost, rel=1e-9)
    assert linear[0] == pytest.approx(
        residuals(first.model, windows.scale_weights(factor), first.initial_states), abs=1e-9
    )


def test_far_residuals_count_linearly(small):
    """Huber by hand: 1 within 3 sigma; at 12 sigma sqrt(3 / 12) = 1/2, so the square is 36."""
    _, windows, _ = small
    residual = np.zeros((len(windows), 240 + 9))
    residual[0, :4] = [0.5, -3.0, 12.0, -12.0]
    residual[1, 240:] = 50.0  # start states are not poses
    factor = sqrt_huber_weight(residual, windows)
    assert factor.ravel()[:4] == pytest.approx([1.0, 1.0, 0.5, 0.5])
    assert (factor.ravel()[4:] == 1.0).all()
    assert pose_residuals(residual, windows)[0, 0, 2] == 12.0


def test_a_downweighted_outlier_has_little_influence(small):
    """One pose 3 m off moves M_de by several sigmas, with Huber weights by less than one."""
    start, windows, initial_states = small
    clean = fit(start, windows, initial_states)
    sigma = 1.0 / np.sqrt(np.einsum("wif,wif->f", clean.reduced_jacobian, clean.reduced_jacobian))
    poses = windows.pose.copy()
    poses[1, 20, 2] += 3.0
    spoiled = replace(windows, pose=poses)
    plain = fit(clean.model, spoiled, clean.initial_states)
    weighed = spoiled.scale_weights(
        sqrt_huber_weight(residuals(clean.model, spoiled, clean.initial_states), spoiled)
    )
    robust = fit(clean.model, weighed, clean.initial_states)
    i = [start.names[k] for k in clean.free].index("M_de")
    pulled = [
        abs(f.model.values["M_de"] - clean.model.values["M_de"]) / sigma[i] for f in (plain, robust)
    ]
    assert pulled[0] > 2.0 > 1.0 > pulled[1]


def test_the_paper_form_fits_its_own_flights():
    """Noise of 3 cm and 0.6 deg over 60 s: control gains within 5 %, cost 1 per component."""
    truth, windows = simulated("paper", 60.0, seed=14)
    initial_states, _ = fit_initial_states(paper_model(), windows, windows.initial_guess[:, :9])
    found = fit(paper_model(), windows, initial_states)
    freedom = windows.count - 16 - 9 * len(windows)
    assert found.cost / freedom == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / freedom))
    for name in ("L_da", "M_de", "N_dr", "cL_alpha"):
        assert found.model.values[name] == pytest.approx(truth.values[name], rel=0.05)
