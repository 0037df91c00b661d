"""Innovations: flight rows and a Kalman filter that integrates the model from row to row ->
normalised prediction errors, one row ahead.

An extended Kalman filter on f_K with the model's own error as part of its state:

    x_aug = (x, d, b)
    x   state of the model (9 or 12)
    d   disturbance: force per mass along the body axes [m/s^2], moment per inertia [rad/s^2]
        (9-state model: body rate [rad/s]), each a first-order Gauss-Markov process
    b   time-correlated part of the pose noise, if there is one, likewise

    predict   x <- f_K(x, u, d),  P <- Phi P Phi' + Q
    update    nu = z - h(x),  S = H P H' + R,  L = P H' S^-1,  x <- x + L nu,  P <- (I - L H) P

[Beard & McLain, sec. 8.6 to 8.7; Maybeck, Stochastic Models, vol. 1, sec. 4.11 for Gauss-Markov
processes]. Phi is a finite difference of the Runge-Kutta step, all columns integrated at once. If
model and noise are right, nu' S^-1 nu is chi2 distributed with as many degrees of freedom as nu has
components, and the innovations are white [Kailath 1968].

The standard deviations of d (process noise), and of what else was measured, maximise the likelihood
of the innovations on the baseline flight [Schweppe 1965; Mehra 1970].
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, NamedTuple

import numpy as np

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, parameter_record, state_rates
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, Term
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import GRAVITY, body_rates, rotation_entries, wrap_angle
from falconwing_kit.gap.baseline import NominalModel
from falconwing_kit.gap.noise import PoseNoiseModel
from falconwing_kit.sysid.fit import Prior

# Optional columns, observed where logged
ROW_MOTION_COLUMNS = ("vx", "vy", "vz", "p", "q", "r", "airspeed")
GROUPS = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 13))  # rejected together
POSE_OF_STATE = [0, 1, 2, 5, 3, 4]  # x y z roll pitch yaw out of the state
AXES = ("force along the nose", "force to the right", "force down", "roll moment", "pitch moment",
        "yaw moment")  # fmt: skip
MAX_RATE_HZ = 50.0  # faster rows are thinned: a change takes longer than 20 ms to show in a pose
GATE_SIGMAS = 6.0  # an observation farther off is an outlier, as in sysid.prepare
MAX_REJECTED = 2  # outliers in a row; the third is taken for what it is, a change
MAX_GAP_S = 1.0  # commands are unknown in a gap: after a longer one the filter starts again
MAX_BLIND_S = 3.0  # the same without a pose
START_S = 0.3  # span of the poses that give the first velocity
SETTLING_S = 0.6  # of the servos before a step
# Initial standard deviations of the first velocity and rates from their neglected change over
# START_S: half of g, and 10 rad/s^2.
START_ACCELERATION, START_ANGULAR_ACCELERATION = 5.0, 10.0
DIFFERENCE = 1e-4  # of the finite differences: m, rad, m/s, rad/s, m/s^2, rad/s^2

_DISTURBANCES = tuple(f"disturbance_{axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw"))


def _disturbance_loads(air: Flow, K: Any) -> Loads:
    """The disturbance itself: force per mass and moment per inertia in body axes."""
    return (
        K.disturbance_x, K.disturbance_y, K.disturbance_z,
        K.disturbance_roll, K.disturbance_pitch, K.disturbance_yaw,
    )  # fmt: skip


DISTURBANCE = Term(
    "disturbance",
    tuple(Parameter(name, 0.0, -1e4, 1e4, "", "what the model lacks") for name in _DISTURBANCES),
    _disturbance_loads,
)


class Row(NamedTuple):
    """One row of a flight table."""

    t: float  # [s]
    pose: Array  # (6,) px py pz roll pitch yaw [m, rad], nan where not measured
    commands: Array  # (4,)
    motion: Array  # (7,) in the order of ROW_MOTION_COLUMNS, nan where not measured


@dataclass(frozen=True)
class FilterNoise:
    """All standard deviations of the filter."""

    pose: Array  # (6,) of px .. yaw [m, rad]
    correlated: PoseNoiseModel  # which share of their variance is time-correlated
    motion: Array  # (7,) of ROW_MOTION_COLUMNS, nan: not used
    disturbance: Array  # (6,) of d: m/s^2, rad/s^2 (9-state model: rad/s)
    disturbance_time: float  # correlation time of d [s]

    @property
    def has_correlated(self) -> bool:
        """Whether the state has the correlated part of the pose noise."""
        return max(self.correlated.share) > 0.0


@dataclass(frozen=True)
class FilterStep:
    """One row through the filter; N augmented states, m observations taken (0 where none)."""

    t: float
    dt: float  # since the last step [s]; 0 where the filter has just started
    transition: Array  # (N, N) Phi since the last step
    predicted: Array  # (N,) before the update
    estimate: Array  # (N,) after it
    rows: np.ndarray  # (m,) which of the 13 observations were taken
    innovation: Array  # (m,) nu
    H: Array  # (m, N)
    S: Array  # (m, m)
    gain: Array  # (N, m)
    rejected: int  # observations set aside as outliers
    drift: Array  # (6,) what the loads may differ by on another day, here; zero without a prior

    @property
    def chi2(self) -> float:
        """Normalised innovation squared nu' S^-1 nu, chi2 distributed with m degrees of freedom."""
        return float(self.innovation @ np.linalg.solve(self.S, self.innovation))


def table_rows(table: FlightTable) -> Iterator[Row]:
    """The rows of a flight table."""
    pose = np.concatenate([table.p_world, table.attitude], axis=1)
    unknown = np.full(len(table.t), np.nan)
    motion = np.stack([table.extra.get(name, unknown) for name in ROW_MOTION_COLUMNS], axis=1)
    yield from map(Row, table.t.tolist(), pose, table.commands, motion)


class InnovationFilter:
    """The extended Kalman filter of one aircraft; `update` takes the rows one by one."""

    def __init__(self, model: Model, noise: FilterNoise, prior: Prior | None = None) -> None:
        """Start without a state: the first poses give it.

        Args:
            model: the aircraft.
            noise: all standard deviations.
            prior: of the parameters on another day; what it leaves open in forces and moments, in
                the present manoeuvre, adds to the disturbance. None: the parameters are exact.
        """
        self._drift = None if prior is None else LoadUncertainty(model, prior)
        self._model = model.with_terms(DISTURBANCE)
        self._noise = noise
        self._K = self._model.K
        self._n = model.n_states
        self._size = self._n + (12 if noise.has_correlated else 6)
        self._rates = state_rates(model.form, self._model.terms, self._model.winds)
        _, lag, series = model.added_input_map(self._K)
        self._memory = SETTLING_S + 4.0 * max(self._K.lag + lag, series)
        self._steps_per_s = SUBSTEPS[model.form] / 0.05
        self._t, self._last_pose = -np.inf, -np.inf
        self._forget()
        self._commands: deque[tuple[float, Array]] = deque(maxlen=2000)
        self._last_row = -np.inf

    def update(self, row: Row) -> FilterStep | None:
        """Predict to a row's time and take in what it measured.

        Returns:
            None while the filter has no state yet, for rows that measured nothing, and for rows
            that are thinned out; their commands count.

        Raises:
            InputError: the time does not increase; skip such a row.
        """
        if not row.t > self._last_row:
            raise InputError(
                f"t: expected a time after {self._last_row:g} s, got {row.t:g} s; skip the row"
            )
        gap = row.t - self._last_row
        self._last_row = row.t
        self._commands.append((row.t, row.commands))
        if self._x is not None and (gap > MAX_GAP_S or row.t - self._last_pose > MAX_BLIND_S):
            self._forget()
        if self._x is None:
            return self._start(row)
        measured = np.isfinite(np.concatenate([row.pose, row.motion * self._noise.motion]))
        if row.t - self._t < (1.0 - 1e-6) / MAX_RATE_HZ or not measured.any():
            return None
        step = self._step(row)
        if measured[:6].any():
            self._last_pose = row.t
        if step is None:  # the prediction diverged
            self._forget()
        return step

    def _forget(self) -> None:
        self._x: Array | None = None
        self._P: Array = np.zeros((self._size, self._size))
        self._t = self._last_pose = -np.inf
        self._recent: list[Row] = []
        self._rejected = [0] * len(GROUPS)

    def _start(self, row: Row) -> FilterStep | None:
        """A first state from straight lines through the first poses."""
        if np.isfinite(row.pose).all():
            self._recent = [r for r in self._recent if row.t - r.t < MAX_GAP_S] + [row]
        if len(self._recent) < 3 or self._recent[-1].t - self._recent[0].t < START_S - 1e-9:
            return None
        t = np.array([r.t for r in self._recent]) - row.t
        pose = np.stack([r.pose for r in self._recent])
        pose[:, 3:] = np.unwrap(pose[:, 3:], axis=0)
        basis = np.stack([np.ones_like(t), t], axis=1)
        (now, slope), spread = (np.linalg.pinv(basis) @ pose, np.linalg.inv(basis.T @ basis)[1, 1])
        span = -float(t[0])
        v_sigma = np.sqrt(spread * self._noise.pose[:3] ** 2 + (START_ACCELERATION * span) ** 2)
        v_world = slope[:3]
        measured = np.isfinite(row.motion) & np.isfinite(self._noise.motion)
        if measured[:3].all():
            v_world, v_sigma = row.motion[:3], 2.0 * self._noise.motion[:3]
        x, P = np.zeros(self._size), np.zeros((self._size, self._size))
        x[:6] = now[[0, 1, 2, 4, 5, 3]]
        x[6:9] = v_world
        sigma = np.zeros(self._size)
        sigma[:9] = np.concatenate([2.0 * self._noise.pose[[0, 1, 2, 4, 5, 3]], v_sigma])
        if self._n == 12:
            x[9:12] = body_rates(now[3], now[4], *slope[3:])
            sigma[9:12] = np.sqrt(
                spread * self._noise.pose[3:] ** 2 + (START_ANGULAR_ACCELERATION * span) ** 2
            )
        sigma[self._n : self._n + 6] = self._noise.disturbance
        if self._noise.has_correlated:
            share = np.repeat(self._noise.correlated.share, 3)
            sigma[self._n + 6 :] = np.sqrt(share) * self._noise.pose
        P[np.diag_indices(self._size)] = sigma**2
        self._x, self._P, self._t, self._last_pose = x, P, row.t, row.t
        none = np.zeros(0)
        return FilterStep(
            row.t, 0.0, np.eye(self._size), x, x, np.zeros(0, int), none,
            np.zeros((0, self._size)), np.zeros((0, 0)), np.zeros((self._size, 0)), 0,
            np.zeros(6),
        )  # fmt: skip

    def _step(self, row: Row) -> FilterStep | None:
        assert self._x is not None
        row_interval, n = row.t - self._t, self._n
        x, transition, position = self._predict(row.t)
        drift = np.zeros(6)
        noise = self._noise
        if self._drift is not None:
            drift = self._drift.sigma(self._x[:n, None], position[:, None])[:, 0]
            noise = replace(noise, disturbance=np.hypot(noise.disturbance, drift))
        P = transition @ self._P @ transition.T
        sigma, decay = gauss_markov(noise)[1], transition.diagonal()[n:]
        P[range(n, self._size), range(n, self._size)] += sigma**2 * (1.0 - decay**2)  # Q
        predicted, H_all = self._observe(x, row.t)
        used = np.isfinite(observation_variance(self._noise))
        if not (np.isfinite(P).all() and np.isfinite(predicted[used]).all()
                and np.isfinite(H_all[used]).all()):  # fmt: skip
            return None
        R = observation_variance(self._noise)
        z = np.concatenate([row.pose, row.motion])
        nu_all = z - predicted
        nu_all[3:6] = wrap_angle(nu_all[3:6])
        taken, rejected = self._gate(nu_all, H_all, P, R)
        nu, H = nu_all[taken], H_all[taken]
        S = H @ P @ H.T + np.diag(R[taken])
        gain = np.linalg.solve(S, H @ P).T if len(taken) else np.zeros((self._size, 0))
        after = x + gain @ nu
        P = P - gain @ S @ gain.T
        self._x, self._P, self._t = after, 0.5 * (P + P.T), row.t
        return FilterStep(
            row.t, row_interval, transition, x, after, taken, nu, H, S, gain, rejected, drift
        )

    def _gate(self, nu: Array, H: Array, P: Array, R: Array) -> tuple[np.ndarray, int]:
        """Which observations are taken, and how many are set aside as outliers."""
        taken, rejected = [], 0
        for number, group in enumerate(GROUPS):
            rows = np.arange(13)[group]
            rows = rows[np.isfinite(nu[rows]) & np.isfinite(R[rows])]
            if not len(rows):
                continue
            S = H[rows] @ P @ H[rows].T + np.diag(R[rows])
            off = float(nu[rows] @ np.linalg.solve(S, nu[rows])) > GATE_SIGMAS**2
            if off and self._rejected[number] < MAX_REJECTED:
                self._rejected[number] += 1
                rejected += len(rows)
                continue
            self._rejected[number] = 0
            taken.append(rows)
        return (np.concatenate(taken) if taken else np.zeros(0, int)), rejected

    def _predict(self, t: float) -> tuple[Array, Array, Array]:
        """Augmented state at t [s] (N,), Phi (N, N) and the controls' position on the way (4,).

        All columns of Phi come from one integration.
        """
        assert self._x is not None
        n, row_interval = self._n, t - self._t
        # Runge-Kutta steps of equal length h to the next row
        steps = max(1, ceil(row_interval * self._steps_per_s - 1e-6))
        h = row_interval / steps
        # The servos settle in steps of 25 ms or more before the step itself.
        coarse = max(h, 0.025)
        settling = self._t - coarse * np.arange(ceil(self._memory / coarse), 0, -1)
        edges = np.concatenate([settling, self._t + h * np.arange(steps + 1)])
        while len(self._commands) > 2 and self._commands[1][0] < settling[0] - 1.0:
            self._commands.popleft()
        times = np.array([when for when, _ in self._commands])
        commands = np.array([command for _, command in self._commands])
        mean, slope = self._model.actuator_positions(times, commands, edges, self._K)
        # Column 0 is the estimate, then one changed state, then one changed disturbance each.
        x = np.repeat(self._x[:n, None], n + 7, axis=1)
        d = np.repeat(self._x[n : n + 6, None], n + 7, axis=1)
        x[:, 1 : n + 1] += DIFFERENCE * np.eye(n)
        d[:, n + 1 :] += DIFFERENCE * np.eye(6)
        K = self._K._replace(**dict(zip(_DISTURBANCES, d, strict=True)))
        first = len(settling)
        with np.errstate(all="ignore"):
            for k in range(first, first + steps):
                x = step_batch(self._rates, K, edges[k], x, mean[k, :, None], h, slope[k, :, None])
            transition = np.zeros((self._size, self._size))
            transition[:n, : n + 6] = (x[:, 1:] - x[:, :1]) / DIFFERENCE
        decay = np.exp(-row_interval / gauss_markov(self._noise)[0])
        transition[range(n, self._size), range(n, self._size)] = decay
        return np.concatenate([x[:, 0], decay * self._x[n:]]), transition, mean[-1]

    def _observe(self, x: Array, t: float) -> tuple[Array, Array]:
        """All 13 predicted observations, of pose and ROW_MOTION_COLUMNS, and H (13, N)."""
        n = self._n
        columns = np.repeat(x[:n, None], n + 1, axis=1)
        columns[:, 1:] += DIFFERENCE * np.eye(n)
        v_air = columns[6:9].copy()
        for wind in self._model.winds:
            moving = wind.evaluate(columns[0], columns[1], columns[2], t, self._K)
            v_air -= np.stack([np.broadcast_to(w, columns[0].shape) for w in moving])
        pose = columns[POSE_OF_STATE]
        if any(e.measurement_map for e in self._model.effects):
            pose = self._model.measured_pose(pose, self._K)
        body = columns[9:12] if n == 12 else np.full((3, n + 1), np.nan)
        airspeed = np.sqrt(np.sum(v_air**2, axis=0))
        z = np.concatenate([pose, columns[6:9], body, airspeed[None]])
        H = np.zeros((13, self._size))
        H[:, :n] = (z[:, 1:] - z[:, :1]) / DIFFERENCE
        predicted = z[:, 0].copy()
        if self._noise.has_correlated:
            H[:6, n + 6 :] = np.eye(6)
            predicted[:6] += x[n + 6 :]
        return predicted, H


def gauss_markov(noise: FilterNoise) -> tuple[Array, Array]:
    """Time constants tau [s] and standard deviations: (6,) of d, or (12,) of d and b."""
    tau, sigma = np.full(6, noise.disturbance_time), noise.disturbance
    if noise.has_correlated:
        share = np.repeat(noise.correlated.share, 3)
        tau = np.concatenate([tau, np.repeat(noise.correlated.time, 3)])
        sigma = np.concatenate([sigma, np.sqrt(share) * noise.pose])
    return tau, sigma


def observation_variance(noise: FilterNoise) -> Array:
    """(13,) diagonal of R: white pose noise, and that of ROW_MOTION_COLUMNS; nan: not used."""
    share = np.repeat(noise.correlated.share, 3) if noise.has_correlated else np.zeros(6)
    return np.concatenate([(1.0 - share) * noise.pose**2, noise.motion**2])


def filter_rows(
    model: Model, noise: FilterNoise, rows: Iterable[Row], prior: Prior | None = None
) -> list[FilterStep]:
    """All rows through a new filter."""
    kalman = InnovationFilter(model, noise, prior)
    return [step for step in map(kalman.update, rows) if step is not None]


# ---- Noise of the filter, identified on the baseline flight

# The likelihood is that of one minute at 20 Hz; more rows would only cost time.
IDENTIFIED_ROWS = 1200
FIRST_SHARE = 0.05  # first guess of d: this share of the model's own loads
BOUNDS = (0.002, 2.0)  # of d, as shares of the model's own loads
TIME_BOUNDS_S = (0.2, 3.0)  # of the correlation time: shorter is white, longer a bias
FIRST_TIME_S = 0.7
FIRST_MOTION = np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05, 0.5])  # [m/s], [rad/s], [m/s]
LOG_SIGMA = 2.0  # weak prior on the log of each unknown, so that none runs away
MAX_ITERATIONS = 12


def identify_filter_noise(base: NominalModel, tables: Sequence[FlightTable]) -> FilterNoise:
    """Noise of the filter that maximises the likelihood of the baseline's innovations.

    -2 log L = sum of log det S + nu' S^-1 nu [Schweppe 1965]. The filter runs once with a first
    guess; its linearisation then serves every further value of the noise.

    Args:
        base: the nominal model, with the pose noise.
        tables: the baseline flights.
    """
    from scipy.optimize import minimize

    model = base.result.model
    loads = load_scatter(model, base)
    used = np.array(
        [
            any(np.isfinite(t.extra.get(name, np.nan)).any() for t in tables)
            for name in ROW_MOTION_COLUMNS
        ]
    )
    used[3:6] &= model.n_states == 12
    guess = FilterNoise(
        base.found.sigma, base.noise, np.where(used, FIRST_MOTION, np.nan),
        np.maximum(FIRST_SHARE * loads, 1e-4), FIRST_TIME_S,
    )  # fmt: skip
    steps: list[FilterStep] = []
    for table in tables:
        rows = list(table_rows(table))
        steps += filter_rows(model, guess, rows[: IDENTIFIED_ROWS - len(steps)])
        if len(steps) >= IDENTIFIED_ROWS:
            break
    # Unknowns: logs of d's six sigmas, of its time, of velocity, rates and airspeed.
    motion_groups = [g for g in ([0, 1, 2], [3, 4, 5], [6]) if used[g].any()]
    start = np.log([*guess.disturbance, guess.disturbance_time,
                    *(FIRST_MOTION[g[0]] for g in motion_groups)])  # fmt: skip
    low, high = (np.log(np.maximum(b * loads, 1e-5)) for b in BOUNDS)
    bounds = [*zip(low, high, strict=True), tuple(np.log(TIME_BOUNDS_S))]
    bounds += [(s - 3.0, s + 3.0) for s in start[7:]]

    def noise_at(unknowns: Array) -> FilterNoise:
        values, motion = np.exp(unknowns), guess.motion.copy()
        for group, value in zip(motion_groups, values[7:], strict=True):
            motion[group] = value
        return replace(guess, disturbance=values[:6], disturbance_time=float(values[6]),
                       motion=motion)  # fmt: skip

    def cost_and_gradient(unknowns: Array) -> tuple[float, Array]:
        trials = np.concatenate([unknowns[None], unknowns + 0.01 * np.eye(len(unknowns))])
        costs = innovation_cost(steps, model.n_states, [noise_at(trial) for trial in trials])
        costs += np.sum(((trials - start) / LOG_SIGMA) ** 2, axis=1)
        return float(costs[0]), (costs[1:] - costs[0]) / 0.01

    best = minimize(
        cost_and_gradient, start, jac=True, method="L-BFGS-B", bounds=bounds,
        options={"maxiter": MAX_ITERATIONS, "ftol": 1e-5},
    )  # fmt: skip
    return noise_at(best.x)


def innovation_cost(steps: Sequence[FilterStep], n: int, noises: Sequence[FilterNoise]) -> Array:
    """-2 log likelihood (C,) of the innovations for C noises, up to a constant.

    The filter is linear around a run of it: a candidate's estimate differs from that run's by e,
    and e <- Phi e, nu = nu_run - H e, with the candidate's own P, S and gain.

    Args:
        steps: the run.
        n: states of the model.
        noises: the candidates.
    """
    count, size = len(noises), len(steps[0].predicted)
    R_all = np.stack([observation_variance(noise) for noise in noises])
    tau, sigma = (np.stack(part) for part in zip(*map(gauss_markov, noises), strict=True))
    e, P, cost = np.zeros((count, size)), np.zeros((count, size, size)), np.zeros(count)
    diagonal, tail = np.arange(size), np.arange(n, size)
    before = steps[0].estimate
    for step in steps:
        if step.dt == 0.0:  # the filter started here
            e, P = np.zeros((count, size)), np.zeros((count, size, size))
            P[:, diagonal, diagonal] = _start_variance(noises, n, size)
            before = step.estimate
            continue
        decay = np.exp(-step.dt / tau)
        Phi = np.repeat(step.transition[None], count, axis=0)
        Phi[:, tail, tail] = decay
        e = (Phi @ e[..., None])[..., 0]
        e[:, n:] += decay * before[n:] - step.predicted[n:]
        P = Phi @ P @ Phi.transpose(0, 2, 1)
        P[:, tail, tail] += sigma**2 * (1.0 - decay**2)  # Q
        if len(step.rows):
            H = step.H
            nu = step.innovation - e @ H.T
            HP = H @ P
            S = HP @ H.T
            at = np.arange(len(H))
            S[:, at, at] += R_all[:, step.rows]
            solved = np.linalg.solve(S, np.concatenate([HP, nu[..., None]], axis=2))
            cost += np.linalg.slogdet(S)[1] + np.sum(nu * solved[..., -1], axis=1)
            e = e + (HP.transpose(0, 2, 1) @ solved[..., -1:])[..., 0]
            P = P - HP.transpose(0, 2, 1) @ solved[..., :-1]
            P = 0.5 * (P + P.transpose(0, 2, 1))
        e = e + step.predicted - step.estimate
        before = step.estimate
    return cost


def _start_variance(noises: Sequence[FilterNoise], n: int, size: int) -> Array:
    """(C, N) variances at the start: the same generous ones for x in all."""
    variance = np.ones((len(noises), size))
    for row, noise in zip(variance, noises, strict=True):
        row[n : n + 6] = noise.disturbance**2
        if noise.has_correlated:
            row[n + 6 :] = np.repeat(noise.correlated.share, 3) * noise.pose**2
    return variance


def load_scatter(model: Model, base: NominalModel) -> Array:
    """(6,) root mean square of the model's forces and moments about their mean in the baseline."""
    flights = [f for prepared in base.found.prepared for f in prepared.flights]
    x = np.concatenate([f.state_estimate for f in flights])[:, : model.n_states]
    commands = np.concatenate([f.commands for f in flights])
    loads = body_loads(model, x.T, commands.T, model.K)
    return np.maximum(np.std(loads, axis=1), 0.05 * np.sqrt(np.mean(loads**2, axis=1)))


class LoadUncertainty:
    """What a prior on the parameters leaves open in forces and moments: sqrt(diag(J C J'))."""

    def __init__(self, model: Model, prior: Prior) -> None:
        """Steps of a tenth of a standard deviation along the principal axes of the prior."""
        names = [n for n in prior.sigma if n in model.values and prior.sigma[n] > 0.0]
        places = [list(prior.sigma).index(name) for name in names]
        sigma = np.array([prior.sigma[name] for name in names])
        correlation = np.eye(len(prior.sigma)) if prior.correlation is None else prior.correlation
        C = correlation[np.ix_(places, places)] * np.outer(sigma, sigma)
        values, vectors = np.linalg.eigh(C / np.outer(sigma, sigma))
        root = sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))  # C = root root'
        trials = np.repeat(model.vector[:, None], 1 + len(names), axis=1)
        for row, name in zip(root, names, strict=True):
            trials[model.names.index(name), 1:] += 0.1 * row
        self._model, self._K = model, parameter_record(model.names)(*trials)

    def sigma(self, x: Array, positions: Array) -> Array:
        """Standard deviations (6, R) at states (n, R) and control positions (4, R)."""
        loads = body_loads(self._model, x[..., None], positions[..., None], self._K)
        J = (loads[..., 1:] - loads[..., :1]) / 0.1
        return np.asarray(np.sqrt(np.sum(J**2, axis=-1)))


def body_loads(model: Model, x: Array, positions: Array, K: Any) -> Array:
    """Forces per mass and moments per inertia (9-state model: rates) in body axes, (6, ...).

    Args:
        model: the aircraft.
        x: (n, ...) states.
        positions: (4, ...) of the controls.
        K: parameters, numbers or arrays that broadcast against the states.
    """
    rates = state_rates(model.form, model.terms, model.winds)(0.0, list(x), list(positions), K)
    rates = np.broadcast_arrays(*(np.asarray(rate, np.float64) for rate in rates))
    pitch, roll = x[3], x[5]
    rows = rotation_entries(roll, pitch, x[4])
    force_world = (rates[6], rates[7], rates[8] + GRAVITY)
    force_body = [
        sum(row[axis] * force for row, force in zip(rows, force_world, strict=True))
        for axis in range(3)
    ]
    moments = rates[9:12]
    if model.n_states == 9:
        moments = body_rates(roll, pitch, rates[5], rates[3], rates[4])
    return np.stack([*force_body, *moments])
