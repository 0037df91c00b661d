"""Multiple shooting: flights in short windows + a model -> predicted poses and derivatives.

    min over K and all x0_w of  sum_w |(y_w - y(x0_w, K)) / sigma|^2 + |x0_w - local estimate|^2_P

w counts windows; windows are independent: no continuity constraint joins the end of one to the
initial state of the next.
Each window starts from its own free initial state and is integrated on the logged commands alone;
only measured poses are compared. Noisy poses are never differentiated, which is what biases the
one-step fit [Bock & Plitt 1984; Jategaonkar, Flight Vehicle System Identification, ch. 4].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, parameter_record, state_rates
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.sysid.prepare import PreparedFlight

# Rows of a state that are measured, in the order of sysid.prepare.CHANNELS: x y z roll pitch yaw.
POSE_ROWS = [0, 1, 2, 5, 3, 4]
WARMUP_ROWS = 20  # rows of commands before a window that servo lag and delay can reach back to
FIRST_ROW = 10  # of a flight: the commands before its first row are unknown
CHUNK = 8192  # aircraft integrated together: their arrays fit the processor's cache
# Gaussian prior on each initial state around its local estimate: metres, tens of degrees. It is
# negligible against tens of poses and regularises a window that has only a few.
INITIAL_STATE_SIGMA = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0])
STATE_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])


@dataclass(frozen=True)
class Windows:
    """W windows of L rows each, from one or several flights of the same rate."""

    nodes: Array  # (W, L) time of each row, since the start of its flight [s]
    pose: Array  # (W, L, 6) measured, zero where missing [m, rad]
    weight: Array  # (W, L, 6) 1/sigma, zero where missing
    # (W, E + S + 1) ends of the integration steps since the start of the flight [s]; the first E
    # steps lie before the window and drive the actuators only.
    edges: Array
    warmup_steps: int  # E
    substeps: int  # integration steps per row
    flight: np.ndarray  # (W,) index into flights
    flights: tuple[PreparedFlight, ...]
    initial_guess: Array  # (W, 12) initial states from the local cubics
    # (6, L, L), or (W, 6, L, L) where rows lack a pose: whitens correlated residuals; None: white
    whitening: Array | None = None

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def count(self) -> int:
        """Number of measured pose components."""
        return int(np.count_nonzero(self.weight))

    def actuator_positions(self, model: Model, vector: Array) -> Array:
        """Actuator response to the logged commands in each integration step, warm-up left out.

        Args:
            model: defines delay, lag and command maps.
            vector: (P,) its parameter values.

        Returns:
            (S, 2, 4, W) mean and slope over each step.
        """
        K = parameter_record(model.names)(*map(float, vector))
        steps = np.empty((2, len(self), self.edges.shape[1] - 1, 4))
        for number, flight in enumerate(self.flights):
            of_flight = self.flight == number
            steps[:, of_flight] = model.actuator_positions(
                flight.t - flight.t[0], flight.commands, self.edges[of_flight], K
            )
        # (2, W, E + S, 4) -> (S, 2, 4, W): steps first, windows last, as `predict` integrates.
        return np.ascontiguousarray(steps[:, :, self.warmup_steps :].transpose(2, 0, 3, 1))

    def scale_weights(self, factor: Array) -> "Windows":
        """The same windows with every weight multiplied by factor (W, L, 6)."""
        return replace(self, weight=self.weight * factor)


def select_windows(windows: Windows, index: np.ndarray) -> Windows:
    """The windows at these indices."""
    whitening = windows.whitening
    return replace(
        windows,
        nodes=windows.nodes[index],
        pose=windows.pose[index],
        weight=windows.weight[index],
        edges=windows.edges[index],
        flight=windows.flight[index],
        initial_guess=windows.initial_guess[index],
        whitening=whitening[index] if whitening is not None and whitening.ndim == 4 else whitening,
    )


def cut_windows(flights: Sequence[PreparedFlight], model: Model, seconds: float = 2.0) -> Windows:
    """Cut flights of one rate into consecutive windows without overlap.

    Args:
        flights: prepared flights.
        model: its form sets the integration steps per row.
        seconds: length of a window [s].

    Returns:
        The windows that have at least half as many poses as the fullest one.

    Raises:
        InputError: no flight is long enough for one window.
    """
    interval = float(np.median(np.concatenate([np.diff(f.t) for f in flights])))
    rows = max(4, round(seconds / interval))
    substeps = max(1, round(SUBSTEPS[model.form] * interval / 0.05))
    parts: list[tuple[Array, ...]] = []
    for number, flight in enumerate(flights):
        first_rows = np.arange(FIRST_ROW, len(flight.t) - rows + 1, rows)
        if len(first_rows):
            parts.append(_cut_flight(flight, first_rows, rows, substeps, number))
    if not parts:
        longest, least = max(f.duration for f in flights), seconds + FIRST_ROW * interval
        raise InputError(
            f"flight: expected at least {least:.1f} s in one piece, got {longest:.1f} s"
        )
    nodes, pose, weight, edges, flight_number, initial_guess = (
        np.concatenate(p) for p in zip(*parts, strict=True)
    )
    # Against the fullest window, as a camera slower than the log leaves rows without a pose.
    measured = np.count_nonzero(weight, axis=(1, 2))
    filled = measured >= 0.5 * np.max(measured)
    if not filled.any():
        raise InputError("flight: expected windows with at least half of their poses, got none")
    return Windows(
        nodes[filled], pose[filled], weight[filled], edges[filled], WARMUP_ROWS * substeps,
        substeps, flight_number[filled], tuple(flights), initial_guess[filled],
    )  # fmt: skip


def _cut_flight(
    flight: PreparedFlight, first_rows: np.ndarray, rows: int, substeps: int, number: int
) -> tuple[Array, ...]:
    """Nodes, pose, weight, edges, flight number and initial guess of one flight's windows."""
    index = first_rows[:, None] + np.arange(rows)  # (W, L)
    t = flight.t - flight.t[0]
    interval = float(np.median(np.diff(t)))
    nodes = t[index]
    # Edges: E warm-up steps of the median interval, then `substeps` equal steps from row to row
    # (W, L - 1, substeps), flattened, then the last row.
    fractions = np.arange(substeps) / substeps
    inner = (nodes[:, :-1, None] + np.diff(nodes)[:, :, None] * fractions).reshape(
        len(first_rows), -1
    )
    before = nodes[:, :1] - interval / substeps * np.arange(WARMUP_ROWS * substeps, 0, -1)
    edges = np.concatenate([before, inner, nodes[:, -1:]], axis=1)
    pose = flight.pose[index]
    weight = np.where(np.isfinite(pose), 1.0 / flight.sigma, 0.0)
    return (
        nodes,
        np.nan_to_num(pose),
        weight,
        edges,
        np.full(len(first_rows), number),
        flight.state_estimate[first_rows],
    )


def predict(
    model: Model,
    windows: Windows,
    initial_states: Array,
    values: Array,
    actuator_positions: Array,
    variant_index: np.ndarray,
) -> Array:
    """Integrate every window once for each of C columns of initial states and parameter values.

    Args:
        model: its terms and form; its values are not used.
        windows: W windows.
        initial_states: (n_states, C, W).
        values: (P, C) parameter values; delay and lag act through actuator_positions.
        actuator_positions: (S, 2, 4, A, W) mean and slope in each integration step, A variants.
        variant_index: (C,) the variant of each column.

    Returns:
        (L, 6, C, W) predicted poses at the windows' rows, order of CHANNELS.
    """
    rates = state_rates(model.form, model.terms, model.winds)
    steps = np.diff(windows.edges[:, windows.warmup_steps :], axis=1).T  # (S, W)
    begin = windows.edges[:, windows.warmup_steps :].T  # (S + 1, W)
    n_columns, n_windows = initial_states.shape[1:]
    poses = np.empty((windows.nodes.shape[1], 6, n_columns, n_windows))
    # For the measured poses, which few models correct, a parameter equal in all columns stays a
    # number and a varied one is (C, 1), beside states (C, W).
    varied = np.ptp(values, axis=1) > 0.0
    K = parameter_record(model.names)(
        *(v[:, None] if many else float(v[0]) for v, many in zip(values, varied, strict=True))
    )
    # Chunks of windows, all columns together: arrays of about CHUNK aircraft.
    width = max(1, CHUNK // n_columns)
    for a in range(0, n_windows, width):
        part = slice(a, a + width)
        x = np.ascontiguousarray(initial_states[:, :, part])  # (n_states, C, chunk)
        # NumPy multiplies arrays of one shape in less time than it broadcasts (C, 1) or a number.
        full = K._make(np.broadcast_to(v, x.shape[1:]).copy() for v in K)
        poses[0, :, :, part] = x[POSE_ROWS]
        for k in range(len(steps)):
            # The variant of each column: (2, 4, A, chunk) -> (2, 4, C, chunk).
            mean, slope = actuator_positions[k, ..., part].take(variant_index, axis=2)
            x = step_batch(rates, full, begin[k, part], x, mean, steps[k, part], slope)
            if (k + 1) % windows.substeps == 0:
                poses[(k + 1) // windows.substeps, :, :, part] = x[POSE_ROWS]
    # Measurement maps take channels first: (6, L, C, W), against which K's fields (C, 1) broadcast.
    return model.measured_pose(poses.transpose(1, 0, 2, 3), K).transpose(1, 0, 2, 3)


def residuals(model: Model, windows: Windows, initial_states: Array) -> Array:
    """Normalised residuals of the poses and of the prior on the initial states (W, n_states).

    Returns:
        (W, L * 6 + n_states): poses, zero where one is missing and infinite where the prediction
        diverged; then the initial states less their local estimates, in sigmas.
    """
    return np.asarray(residual_sets(model, windows, initial_states[None], model.vector[:, None])[0])


def fly_windows(model: Model, windows: Windows, initial_states: Array) -> Array:
    """Predicted poses of every window at all rows, measured or not, from states (W, n_states).

    Returns:
        (W, L, 6) in the order of CHANNELS; not finite where the prediction diverged.
    """
    poses = _predict_columns(model, windows, initial_states.T[:, None, :], model.vector[:, None])
    return np.ascontiguousarray(poses[:, :, 0].transpose(2, 0, 1))


def pose_residuals(residual: Array, windows: Windows) -> Array:
    """The pose part (W, L, 6) of `residuals` (W, L * 6 + n_states), order of CHANNELS."""
    return residual[:, : windows.weight[0].size].reshape(windows.weight.shape)


def _initial_state_residuals(windows: Windows, initial_states: Array) -> Array:
    """(..., W, n_states) initial states less their local estimates, in sigmas of the prior."""
    n = initial_states.shape[-1]
    deviation = (initial_states - windows.initial_guess[:, :n]) / INITIAL_STATE_SIGMA[:n]
    # Whole turns of yaw (row 4) are the same attitude.
    turn = 2.0 * np.pi
    turns = np.round(deviation[..., 4] * INITIAL_STATE_SIGMA[4] / turn)
    deviation[..., 4] -= turn / INITIAL_STATE_SIGMA[4] * turns
    return deviation


def jacobian(
    model: Model, windows: Windows, initial_states: Array, free: Sequence[int]
) -> tuple[Array, Array, Array]:
    """Residuals and their derivatives by forward differences, all columns integrated together.

    Args:
        model: the aircraft at its present values.
        windows: W windows.
        initial_states: (W, n_states).
        free: the F parameters to differentiate by, as indices into model.names.

    Returns:
        residual (W, R) as of `residuals`; derivative by the free parameters (W, R, F), per unit of
        each, zero in windows where a flight with a changed parameter diverges: they show nothing
        about the parameters; derivative by the window's own initial state (W, R, n_states).
    """
    mapped = model.actuator_parameter_names
    steps = np.array(
        [1e-3 if model.names[i] in mapped else 1e-5 * _parameter_scale(model, i) for i in free]
    )
    n_states, n_free = model.n_states, len(free)
    # Columns: the present values, then one perturbed parameter each (F), then one perturbed
    # initial state each (n_states). Windows share parameters but not states, so one column
    # perturbs the same state of every window.
    columns = 1 + n_free + n_states
    values = np.repeat(model.vector[:, None], columns, axis=1)  # (P, C)
    state_columns = np.repeat(initial_states.T[:, None, :], columns, axis=1)  # (n_states, C, W)
    values[list(free), range(1, 1 + n_free)] += steps
    for i in range(n_states):
        state_columns[i, 1 + n_free + i] += STATE_STEPS[i]
    # Differences to the first column over the step: (C - 1, W, L * 6) -> (W, L * 6, C - 1).
    at_base, change = _perturbed_residuals(model, windows, state_columns, values)
    change /= np.concatenate([steps, STATE_STEPS[:n_states]])[:, None, None]
    derivative = np.moveaxis(change, 0, -1)
    # The prior's rows are linear: zero by the parameters, 1/sigma by the states.
    of_prior = np.zeros((len(windows), n_states, n_free + n_states))
    of_prior[:, range(n_states), range(n_free, n_free + n_states)] = (
        1.0 / INITIAL_STATE_SIGMA[:n_states]
    )
    derivative = np.concatenate([derivative, of_prior], axis=1)  # (W, R, F + n_states)
    of_parameters = derivative[..., :n_free]
    of_parameters[~np.isfinite(of_parameters).all(axis=(1, 2))] = 0.0
    return (
        np.concatenate([at_base, _initial_state_residuals(windows, initial_states)], axis=1),
        of_parameters,
        derivative[..., n_free:],
    )


def residual_sets(model: Model, windows: Windows, initial_states: Array, values: Array) -> Array:
    """`residuals` for several sets of initial states and parameters, all integrated together.

    Args:
        model: the aircraft; its values are not used.
        windows: W windows.
        initial_states: (C, W, n_states).
        values: (P, C) parameter values, one set per column.

    Returns:
        (C, W, R) as of `residuals`.
    """
    poses = _predict_columns(model, windows, initial_states.transpose(2, 0, 1), values)
    with np.errstate(all="ignore"):
        return np.concatenate(
            [
                _normalise_residuals(windows, poses, same_turns=False),
                _initial_state_residuals(windows, initial_states),
            ],
            axis=2,
        )


def finite_differences(
    model: Model, windows: Windows, initial_states: Array, values: Array
) -> Array:
    """Change of the residuals for other parameter values, all sets integrated together.

    Args:
        model: the aircraft at its present values.
        windows: W windows.
        initial_states: (W, n_states), the same for all sets.
        values: (P, C) parameter values, one set per column.

    Returns:
        (C, W, R) as of `residuals`: those at the other values less those at the present ones,
        infinite where a prediction diverged.
    """
    values = np.column_stack([model.vector, values])
    state_columns = np.repeat(initial_states.T[:, None, :], values.shape[1], axis=1)
    _, change = _perturbed_residuals(model, windows, state_columns, values)
    # The initial states are unchanged, and so is their prior: zero rows.
    return np.concatenate([change, np.zeros((*change.shape[:2], initial_states.shape[1]))], axis=2)


def _perturbed_residuals(
    model: Model, windows: Windows, state_columns: Array, values: Array
) -> tuple[Array, Array]:
    """Pose residuals of the first column (W, L * 6); the others' less those (C - 1, W, L * 6)."""
    poses = _predict_columns(model, windows, state_columns, values)
    with np.errstate(all="ignore"):
        residual = _normalise_residuals(windows, poses)
        return residual[0], residual[1:] - residual[0]


def _predict_columns(model: Model, windows: Windows, state_columns: Array, values: Array) -> Array:
    """Poses (L, 6, C, W) for columns of states (n_states, C, W) and parameter values (P, C)."""
    # Actuator responses are costly: one variant for each set of values of the input map's
    # parameters (delay, lag), not one for each column.
    mapped = [model.names.index(name) for name in model.actuator_parameter_names]
    keys = [tuple(column) for column in values[mapped].T]
    distinct = list(dict.fromkeys(keys))
    variants = [windows.actuator_positions(model, values[:, keys.index(key)]) for key in distinct]
    variant_index = np.array([distinct.index(key) for key in keys])
    with np.errstate(all="ignore"):
        return predict(
            model,
            windows,
            state_columns,
            values,
            np.stack(variants, axis=3),  # (S, 2, 4, A, W)
            variant_index,
        )


def _normalise_residuals(windows: Windows, poses: Array, same_turns: bool = True) -> Array:
    """(L, 6, C, W) predicted poses -> (C, W, L * 6) residuals in sigmas, whitened.

    Angles are modulo 2 pi; with `same_turns` all columns take the turns of the first, since a turn
    of its own in a perturbed column would be a jump in the finite difference.
    """
    difference = poses.transpose(2, 3, 0, 1) - windows.pose  # (C, W, L, 6)
    angles = difference[..., 3:]
    turns = np.round((angles[:1] if same_turns else angles) / (2.0 * np.pi))
    angles -= 2.0 * np.pi * turns
    difference *= windows.weight
    if windows.whitening is not None:
        # (W, 6, L, L) @ (W, 6, L, C): all columns of a window in one product.
        filtered = windows.whitening @ difference.transpose(1, 3, 2, 0)
        difference = filtered.transpose(3, 0, 2, 1)
    difference[~np.isfinite(difference)] = np.inf
    return difference.reshape(*difference.shape[:2], -1)


def _parameter_scale(model: Model, i: int) -> float:
    """Magnitude of a parameter, at least 0.1, for the size of its finite difference."""
    return max(abs(model.vector[i]), abs(model.parameters[i].start), 0.1)
