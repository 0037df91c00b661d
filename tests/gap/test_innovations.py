"""The filter against closed forms: stationary gain, chi2 and likelihood of its innovations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.gap.innovations import (
    FilterStep,
    InnovationFilter,
    LoadUncertainty,
    Row,
    filter_rows,
    innovation_cost,
)
from falconwing_kit.gap.noise import PoseNoiseModel
from falconwing_kit.sysid.fit import Prior
from tests.gap.free_body import DT, FREE_BODY, falling_rows, noise

NAN6, NAN7 = np.full(6, np.nan), np.full(7, np.nan)


def settled(steps: list[FilterStep]) -> list[FilterStep]:
    """The steps after two seconds."""
    return [step for step in steps if step.t > 2.0]


def test_gain_of_a_falling_body_is_that_of_the_riccati_equation():
    """Height, its rate and a Gauss-Markov force are linear: SciPy's solution of the discrete
    algebraic Riccati equation gives the stationary gain.
    """
    model = noise()
    decay = np.exp(-DT / model.disturbance_time)
    Phi = np.array([[1.0, DT, -0.5 * DT**2], [0.0, 1.0, -DT], [0.0, 0.0, decay]])  # force down
    Q = np.diag([0.0, 0.0, model.disturbance[2] ** 2 * (1.0 - decay**2)])
    H, R = np.array([[1.0, 0.0, 0.0]]), np.array([[model.pose[2] ** 2]])
    P = solve_discrete_are(Phi.T, H.T, Q, R)
    expected = (P @ H.T / (H @ P @ H.T + R))[:, 0]
    last = filter_rows(FREE_BODY, model, falling_rows(240, None))[-1]
    found = last.gain[[2, 8, 14], 2]
    assert found == pytest.approx(expected, rel=1e-3)


def test_chi2_of_the_innovations_is_their_number():
    """By law: nu' S^-1 nu has mean m. 2280 components: standard error 0.03; a noise of 20 % more
    would give 1 / 1.44 at most.
    """
    rows = falling_rows(420, np.random.default_rng(1))
    steps = settled(filter_rows(FREE_BODY, noise(), rows))
    assert all(len(step.rows) == 6 for step in steps)
    mean = np.mean([step.chi2 for step in steps]) / 6.0
    assert mean == pytest.approx(1.0, abs=0.08)


def test_innovations_are_white():
    """By law [Kailath 1968]: correlation of successive ones is zero, within 3 / sqrt(2280)."""
    steps = settled(filter_rows(FREE_BODY, noise(), falling_rows(420, np.random.default_rng(2))))
    white = np.array([np.linalg.solve(np.linalg.cholesky(s.S), s.innovation) for s in steps])
    assert abs(np.mean(white[1:] * white[:-1])) < 0.063


def test_likelihood_is_largest_at_the_noise_that_flew():
    """Maximum likelihood: a third or three times the disturbances, or the pose noise, cost more.

    The run itself is at a wrong noise, as it is when the noise is identified.
    """
    rows = falling_rows(300, np.random.default_rng(3))
    true = noise()
    trials = [
        true,
        *(replace(true, disturbance=f * true.disturbance) for f in (1 / 3, 3.0)),
        *(replace(true, pose=f * true.pose) for f in (0.7, 1.4)),
    ]
    run = filter_rows(FREE_BODY, replace(true, disturbance=2.0 * true.disturbance), rows)
    costs = innovation_cost(run, 12, trials)
    assert (costs[1:] > costs[0] + 20.0).all()


def test_cost_is_that_of_a_run_with_the_same_noise():
    """The linearised cost of two noises differs by as much as two runs of the filter do."""
    rows, near = falling_rows(300, np.random.default_rng(4)), noise()
    other = replace(near, disturbance=1.3 * near.disturbance, pose=1.1 * near.pose)

    def run_cost(steps: list[FilterStep]) -> float:
        return sum(np.linalg.slogdet(s.S)[1] + s.chi2 for s in steps if s.dt > 0.0)

    steps = filter_rows(FREE_BODY, near, rows)
    expected = run_cost(filter_rows(FREE_BODY, other, rows)) - run_cost(steps)
    found = np.diff(innovation_cost(steps, 12, [near, other]))[0]
    assert found == pytest.approx(expected, abs=2.0)  # the start differs a little
    assert abs(expected) > 20.0


def test_correlated_pose_noise_does_not_pass_for_force():
    """Taken for white it leaves the innovations correlated; as a Gauss-Markov state it does not."""
    rng, share = np.random.default_rng(5), 0.6
    rows, slow, decay = [], np.zeros(6), np.exp(-DT / 0.5)
    slow = rng.normal(size=6)
    for row in falling_rows(420, None):
        error = np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.normal(size=6)
        rows.append(row._replace(pose=row.pose + noise().pose * error))
        slow = decay * slow + np.sqrt(1.0 - decay**2) * rng.normal(size=6)
    quiet = replace(noise(), disturbance=np.full(6, 1e-3))
    knows = replace(quiet, correlated=PoseNoiseModel((share, share), (0.5, 0.5)))
    successive = []
    for one in (quiet, knows):
        steps = settled(filter_rows(FREE_BODY, one, rows))
        white = np.array([np.linalg.solve(np.linalg.cholesky(s.S), s.innovation) for s in steps])
        successive.append(np.mean(white[1:] * white[:-1]))
    assert successive[0] > 0.3
    assert abs(successive[1]) < 0.07


def test_one_wild_pose_changes_nothing_and_three_are_believed():
    """A pose 3 m off (100 sigma) is set aside; a camera that has moved is not for ever."""
    rows = falling_rows(200, None)
    one, moved = list(rows), list(rows)
    one[100] = rows[100]._replace(pose=rows[100].pose + np.array([3.0, 0, 0, 0, 0, 0]))
    for k in range(100, 200):
        moved[k] = rows[k]._replace(pose=rows[k].pose + np.array([3.0, 0, 0, 0, 0, 0]))
    usual, wild, other = (
        {round(s.t / DT): s for s in filter_rows(FREE_BODY, noise(), each)}
        for each in (rows, one, moved)
    )
    assert wild[100].rejected == 3 and list(wild[100].rows) == [3, 4, 5]
    assert wild[110].estimate[0] == pytest.approx(usual[110].estimate[0], abs=1e-6)
    assert [other[k].rejected for k in (99, 100, 101, 102)] == [0, 3, 3, 0]


def test_rows_without_poses_faster_rows_and_gaps():
    """Nothing is measured: no step; 200 Hz: at most 50 steps a second; 2 s of nothing: a start."""
    rows = falling_rows(100, None)
    lost = [r._replace(pose=NAN6) if k % 3 == 1 else r for k, r in enumerate(rows)]
    assert len(filter_rows(FREE_BODY, noise(), lost)) < 70
    fast = [Row(k / 200.0, np.zeros(6), np.zeros(4), NAN7) for k in range(400)]
    steps = filter_rows(FREE_BODY, noise(), fast)
    assert min(step.dt for step in steps[1:]) >= 0.02 - 1e-9
    later = [r._replace(t=r.t + 7.0) for r in rows]
    restarts = [s.t for s in filter_rows(FREE_BODY, noise(), [*rows, *later]) if s.dt == 0.0]
    assert len(restarts) == 2 and 7.0 < restarts[1] < 7.5
    kalman = InnovationFilter(FREE_BODY, noise())
    kalman.update(rows[1])
    with pytest.raises(InputError, match="t: expected a time after"):
        kalman.update(rows[0])


def test_velocity_rates_and_airspeed_are_observed_where_logged():
    """A steady flight that logs its motion: all 13 observations are taken, at 4 Hz too."""
    model = rates_model()
    logged = replace(noise(), motion=np.array([0.2, 0.2, 0.2, 0.05, 0.05, 0.05, 0.3]))
    motion = np.array([7.0, 0.0, 0.0, 0.0, 0.0, 0.0, 7.0])
    rows = [
        Row(k * 0.25, np.array([7.0 * k * 0.25, 0, 2.0, 0, 0.05, 0]), np.array([0.4, 0, 0, 0]),
            motion)
        for k in range(12)
    ]  # fmt: skip
    steps = filter_rows(model, logged, rows)
    assert set(np.concatenate([s.rows for s in steps]).tolist()) == set(range(13))
    assert np.isfinite(steps[-1].estimate).all()


def test_uncertainty_of_the_loads_is_that_of_the_coefficients():
    """By hand: rolling moment V^2 (L_0 + L_da da + ...), so 2 % of L_da at full aileron and 7 m/s
    are 49.01 * 0.02 L_da (V^2 has 0.01 added); 3 % of kT at full throttle are 0.03 kT along the
    nose; and fully correlated errors that cancel leave nothing.
    """
    model = rates_model()
    K, x = model.values, np.zeros((12, 1))
    x[6], u = 7.0, np.array([[1.0], [1.0], [0.0], [0.0]])
    sigma = {"L_da": 0.02 * K["L_da"], "kT": 0.03 * K["kT"]}
    found = LoadUncertainty(model, Prior(dict(K), sigma)).sigma(x, u)[:, 0]
    expected = [0.03 * K["kT"], 0.0, 0.0, 49.01 * 0.02 * K["L_da"], 0.0, 0.0]
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-9)
    both = Prior(dict(K), {"L_da": 0.02, "L_0": 0.02}, np.array([[1.0, -1.0], [-1.0, 1.0]]))
    assert LoadUncertainty(model, both).sigma(x, u)[3, 0] == pytest.approx(0.0, abs=1e-6)


def test_uncertain_parameters_widen_the_innovations():
    """By law: S grows with what the prior leaves open, so the same errors are less surprising."""
    model = rates_model()
    rows = [
        Row(k * DT, np.array([7.0 * k * DT, 0, 2.0, 0, 0.05, 0]), np.array([0.4, 0, 0, 0]), NAN7)
        for k in range(30)
    ]
    prior = Prior(dict(model.values), {"cL_alpha": 0.1 * model.values["cL_alpha"]})
    known, open_ = (filter_rows(model, noise(), rows, each)[-1] for each in (None, prior))
    assert known.drift == pytest.approx(np.zeros(6))
    assert open_.drift[2] > 0.1
    assert open_.S[2, 2] > known.S[2, 2]
