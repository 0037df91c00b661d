"""One-step identification as in the paper: flights + a model -> the model, least squares fitted.

K* = argmin sum |f_K(x_t, u_t) - x_{t+1}|^2   [paper, Section IV-B]

f_K is the paper's step map here: the dx/dt of aircraft/model.py integrated over one step. This is
the method to compare with. Velocities are differences of measured poses, so their noise is
sqrt(2) sigma / dt: 0.85 m/s for 3 cm at 20 Hz. It enters the regressors as well as the target,
which biases every parameter (errors in variables). Smoothing the poses first reduces this bias and
adds another.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, parameter_record, state_rates
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import body_rates
from falconwing_kit.sysid.prepare import PreparedFlight
from falconwing_kit.sysid.shooting import CHUNK

DIVERGED_RESIDUAL = 1e3  # residual of a diverged step; its square is finite [m, m/s, rad, rad/s]


def differentiated_states(flight: PreparedFlight) -> Array:
    """States (N - 1, 12) from differences of N poses, as in the paper; nan where one is missing."""
    slope = np.diff(flight.pose, axis=0) / np.diff(flight.t)[:, None]
    here = flight.pose[:-1]  # x y z roll pitch yaw; a state has pitch yaw roll
    rates = np.stack(body_rates(here[:, 3], here[:, 4], *slope[:, 3:].T), axis=1)
    return np.concatenate([here[:, :3], here[:, [4, 5, 3]], slope[:, :3], rates], axis=1)


@np.errstate(all="ignore")
def fit_one_step(
    model: Model,
    flights: Sequence[PreparedFlight],
    *,
    smoothed: bool = False,
    most: int | None = None,
) -> Model:
    """Fit K by the paper's loss: predict each next state from the one before.

    Args:
        model: where to start; delay and lag stay fixed, since one step does not identify them.
        flights: prepared flights.
        smoothed: use states from local cubics instead of raw differences.
        most: use at most this many steps, evenly spread; None uses all.

    Raises:
        InputError: fewer usable steps than parameters.
    """
    from scipy.optimize import least_squares

    fixed_model = model.with_fixed(model.actuator_parameter_names)
    free = [i for i, p in enumerate(fixed_model.parameters) if p.high > p.low]
    # All steps of all flights side by side: before and after (n_states, N), actuators (4, N).
    steps = [_steps(fixed_model, flight, smoothed) for flight in flights]
    before, after, actuator_positions, duration = (
        np.concatenate(p, axis=-1) for p in zip(*steps, strict=True)
    )
    if most is not None and before.shape[1] > most:
        some = np.linspace(0, before.shape[1] - 1, most).astype(int)
        before, after, actuator_positions, duration = (
            before[:, some],
            after[:, some],
            actuator_positions[:, some],
            duration[some],
        )
    if before.shape[1] < 3 * len(free):
        raise InputError(
            f"flight: expected at least {3 * len(free)} pairs of neighbouring poses, "
            f"got {before.shape[1]}"
        )
    low, high = (
        np.array([getattr(fixed_model.parameters[i], side) for i in free])
        for side in ("low", "high")
    )
    start = np.clip(fixed_model.vector[free], low, high)

    def residual_sets(sets: Array) -> Array:
        """(C, R) of C sets of values (C, F), some of them integrated together."""
        vectors = np.repeat(fixed_model.vector[None], len(sets), axis=0)
        vectors[:, free] = sets
        together = max(1, CHUNK // before.shape[1])
        parts = [
            _advance(fixed_model, vectors[c : c + together], before, actuator_positions, duration)
            for c in range(0, len(sets), together)
        ]
        off = np.concatenate(parts, axis=1).swapaxes(0, 1) - after  # (C, n_states, N)
        off = np.nan_to_num(off, nan=DIVERGED_RESIDUAL)
        return np.clip(off, -DIVERGED_RESIDUAL, DIVERGED_RESIDUAL).reshape(len(sets), -1)

    def derivative(values: Array) -> Array:
        """(R, F) by differences with SciPy's steps, which lead away from a bound."""
        size = np.sqrt(np.finfo(np.float64).eps) * np.maximum(np.abs(values), 1.0)
        step = np.where(values < 0.0, -size, size)
        step[(values + step < low) | (values + step > high)] *= -1.0
        sets = values + np.diag(step)
        change = residual_sets(np.concatenate([values[None], sets]))
        return np.asarray((change[1:] - change[0]).T / (np.diag(sets) - values))

    scale = np.array([max(abs(fixed_model.parameters[i].start), 0.1) for i in free])
    loss = "soft_l1" if smoothed else "linear"
    found = least_squares(
        lambda values: residual_sets(values[None])[0], start, derivative, bounds=(low, high),
        x_scale=scale, loss=loss, max_nfev=30,
    )  # fmt: skip
    vector = fixed_model.vector
    vector[free] = found.x
    return replace(model, values=dict(zip(model.names, map(float, vector), strict=True)))


def _steps(
    model: Model, flight: PreparedFlight, smoothed: bool
) -> tuple[Array, Array, Array, Array]:
    """States before and after each step, actuator positions in it, and its duration [s]."""
    states = flight.state_estimate if smoothed else differentiated_states(flight)
    states = states[:, : model.n_states]
    t = flight.t[: len(states)] - flight.t[0]
    known = np.asarray(np.isfinite(states).all(axis=1))
    pairs = np.flatnonzero(known[:-1] & known[1:])  # steps with a state at both ends
    actuator_positions, _ = model.actuator_positions(t, flight.commands[: len(t)], t, model.K)
    return states[pairs].T, states[pairs + 1].T, actuator_positions[pairs].T, np.diff(t)[pairs]


def _advance(
    model: Model, vectors: Array, before: Array, actuator_positions: Array, duration: Array
) -> Array:
    """States (n_states, C, N) one step later, for C parameter vectors (C, P)."""
    K = parameter_record(model.names)(*vectors.T[..., None])  # each (C, 1)
    substeps, rates = SUBSTEPS[model.form], state_rates(model.form, model.terms, model.winds)
    x = np.repeat(before[:, None], len(vectors), axis=1)
    for _ in range(substeps):
        x = step_batch(rates, K, 0.0, x, actuator_positions, duration / substeps)
    return x
