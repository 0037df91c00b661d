"""Multiple shooting: flights cut into short windows + a model -> residuals and their derivatives.

Each window has a free initial state and is predicted from the logged commands; only poses are
compared. No velocity is differentiated from noisy poses, which biases the one-step fit [Bock &
Plitt 1984; Jategaonkar, Flight Vehicle System Identification, ch. 4].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, parameter_record, state_rates
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.sysid.prepare import PreparedFlight

POSE_ROWS = [0, 1, 2, 5, 3, 4]  # rows of a state in the order of prepare.CHANNELS
WARMUP_ROWS = 20  # rows of commands before a window, for servo lag and delay
FIRST_ROW = 10  # first row of a flight that a window may have: earlier commands are unknown
CHUNK = 8192  # aircraft advanced together; their arrays stay in the processor's cache
# Wide prior of an initial state around its local estimate: negligible against tens of poses, it
# keeps the fit bounded where a window has few.
INITIAL_STATE_SIGMA = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0])
STATE_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])


@dataclass(frozen=True)
class Windows:
    """W windows of L rows each, from one or several flights with the same rate."""

    nodes: Array  # (W, L) time of each row, since the start of its flight [s]
    pose: Array  # (W, L, 6) measured, zero where missing [m, rad]
    weight: Array  # (W, L, 6) 1/sigma, zero where missing
    edges: Array  # (W, E + S + 1) ends of integration steps [s], E steps before the window
    warmup_steps: int  # E
    substeps: int  # integration steps per row
    flight: np.ndarray  # (W,) which flight
    flights: tuple[PreparedFlight, ...]
    initial_guess: Array  # (W, 12) initial states from local cubics
    whitening: Array | None = None  # (6, L, L) filter for time-correlated pose noise, or None

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def count(self) -> int:
        """Number of measured pose components."""
        return int(np.count_nonzero(self.weight))

    def actuator_positions(self, model: Model, vector: Array) -> Array:
        """(S, 2, 4, W) mean and slope of the control positions over each integration step."""
        K = parameter_record(model.names)(*map(float, vector))
        steps = np.empty((2, len(self), self.edges.shape[1] - 1, 4))
        for number, flight in enumerate(self.flights):
            mine = self.flight == number
            steps[:, mine] = model.actuator_positions(
                flight.t - flight.t[0], flight.commands, self.edges[mine], K
            )
        return np.ascontiguousarray(steps[:, :, self.warmup_steps :].transpose(2, 0, 3, 1))

    def scale_weights(self, factor: Array) -> "Windows":
        """The same windows with every weight multiplied by factor (W, L, 6)."""
        return replace(self, weight=self.weight * factor)


def cut_windows(flights: Sequence[PreparedFlight], model: Model, seconds: float = 2.0) -> Windows:
    """Cut flights of one rate into successive windows; those with half of their poses are kept.

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
        longest = max(f.duration for f in flights)
        raise InputError(
            f"flight: expected at least {seconds + FIRST_ROW * interval:.1f} s in one piece, got "
            f"{longest:.1f} s"
        )
    nodes, pose, weight, edges, flight_number, initial_guess = (
        np.concatenate(p) for p in zip(*parts, strict=True)
    )
    filled = np.count_nonzero(weight, axis=(1, 2)) >= 0.5 * min(
        np.max(np.count_nonzero(weight, axis=(1, 2))), rows * 6
    )
    if not filled.any():
        raise InputError("flight: expected windows with at least half of their poses, got none")
    warmup_steps = WARMUP_ROWS * substeps
    return Windows(
        nodes[filled], pose[filled], weight[filled], edges[filled], warmup_steps, substeps,
        flight_number[filled], tuple(flights), initial_guess[filled],
    )  # fmt: skip


def _cut_flight(
    flight: PreparedFlight, first_rows: np.ndarray, rows: int, substeps: int, number: int
) -> tuple[Array, ...]:
    index = first_rows[:, None] + np.arange(rows)
    t = flight.t - flight.t[0]
    interval = float(np.median(np.diff(t)))
    nodes = t[index]
    # Ends of the integration steps: `substeps` per row, and warm-up steps before the first row.
    between = np.arange(substeps) / substeps
    inner = (nodes[:, :-1, None] + np.diff(nodes)[:, :, None] * between).reshape(
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
    variant_index: np.ndarray | None = None,
) -> Array:
    """Predict every window for each of C columns of initial states and parameter values.

    Args:
        model: the aircraft.
        windows: W windows.
        initial_states: (n_states, C, W).
        values: (P, C) parameter values; the input map has been applied already.
        actuator_positions: (S, 2, 4, A, W) mean and slope per integration step, A variants.
        variant_index: (C,) variant of each column; None where there is one only.

    Returns:
        (L, 6, C, W) predicted poses at the windows' rows, order of CHANNELS.
    """
    rates = state_rates(model.form, model.terms, model.winds)
    steps = np.diff(windows.edges[:, windows.warmup_steps :], axis=1).T
    begin = windows.edges[:, windows.warmup_steps :].T
    n_columns, n_windows = initial_states.shape[1:]
    poses = np.empty((windows.nodes.shape[1], 6, n_columns, n_windows))
    # Parameters that differ between columns are arrays (C, 1), the others numbers: less to compute.
    varied = np.ptp(values, axis=1) > 0.0
    K = parameter_record(model.names)(
        *(v[:, None] if many else float(v[0]) for v, many in zip(values, varied, strict=True))
    )
    width = max(1, CHUNK // n_columns)
    for a in range(0, n_windows, width):
        part = slice(a, a + width)
        x = np.ascontiguousarray(initial_states[:, :, part])
        poses[0, :, :, part] = x[POSE_ROWS]
        for k in range(len(steps)):
            mean, slope = (
                actuator_positions[k, ..., part]
                if variant_index is None
                else actuator_positions[k, ..., part][:, :, variant_index]
            )
            x = step_batch(rates, K, begin[k, part], x, mean, steps[k, part], slope)
            if (k + 1) % windows.substeps == 0:
                poses[(k + 1) // windows.substeps, :, :, part] = x[POSE_ROWS]
    # Measurement maps take channels first: (6, L, C, W), against which K's fields (C, 1) broadcast.
    return model.measured_pose(poses.transpose(1, 0, 2, 3), K).transpose(1, 0, 2, 3)


def residuals(model: Model, windows: Windows, initial_states: Array) -> Array:
    """Weighted residuals: predicted minus measured poses, then initial states minus their guess.

    Returns:
        (W, L * 6 + n_states); zero where a pose is missing, infinite where a prediction diverged.
    """
    poses = fly_windows(model, windows, initial_states).transpose(1, 2, 0)[:, :, None]
    with np.errstate(all="ignore"):
        return np.concatenate(
            [
                _normalise_residuals(windows, poses)[0],
                _initial_state_residuals(windows, initial_states),
            ],
            axis=1,
        )


def fly_windows(model: Model, windows: Windows, initial_states: Array) -> Array:
    """(W, L, 6) predicted poses, order of CHANNELS; not finite where a prediction diverged."""
    actuator_positions = windows.actuator_positions(model, model.vector)[:, :, :, None]
    with np.errstate(all="ignore"):
        poses = predict(
            model, windows, initial_states.T[:, None, :], model.vector[:, None], actuator_positions
        )
    return np.ascontiguousarray(poses[:, :, 0].transpose(2, 0, 1))


def pose_residuals(residual: Array, windows: Windows) -> Array:
    """(W, L, 6) the pose part of `residuals`, order of CHANNELS."""
    return residual[:, : windows.weight[0].size].reshape(windows.weight.shape)


def _initial_state_residuals(windows: Windows, initial_states: Array) -> Array:
    n = initial_states.shape[1]
    deviation = (initial_states - windows.initial_guess[:, :n]) / INITIAL_STATE_SIGMA[:n]
    deviation[:, 4] -= (
        2.0
        * np.pi
        / INITIAL_STATE_SIGMA[4]
        * np.round(deviation[:, 4] * INITIAL_STATE_SIGMA[4] / (2.0 * np.pi))
    )
    return deviation


def jacobian(
    model: Model, windows: Windows, initial_states: Array, free: Sequence[int]
) -> tuple[Array, Array, Array]:
    """Residuals and their derivatives by forward differences, all columns and windows in one batch.

    Args:
        model: the aircraft.
        windows: W windows.
        initial_states: (W, n_states).
        free: which parameters move, as indices into model.names.

    Returns:
        residual (W, R) as of `residuals`; its derivatives to the free parameters (W, R, F) and to
        the initial states (W, R, n_states).
    """
    mapped = model.input_names
    steps = np.array(
        [1e-3 if model.names[i] in mapped else 1e-5 * _parameter_scale(model, i) for i in free]
    )
    # Columns: unperturbed, one per free parameter, one per initial state.
    n_states, n_free = model.n_states, len(free)
    columns = 1 + n_free + n_states
    values = np.repeat(model.vector[:, None], columns, axis=1)
    state_columns = np.repeat(initial_states.T[:, None, :], columns, axis=1)
    values[list(free), range(1, 1 + n_free)] += steps
    for i in range(n_states):
        state_columns[i, 1 + n_free + i] += STATE_STEPS[i]
    at_base, moved = _perturbed_residuals(model, windows, state_columns, values)
    moved /= np.concatenate([steps, STATE_STEPS[:n_states]])[:, None, None]
    moved = np.moveaxis(moved, 0, -1)
    of_starts = np.zeros((len(windows), n_states, n_free + n_states))
    of_starts[:, range(n_states), range(n_free, n_free + n_states)] = (
        1.0 / INITIAL_STATE_SIGMA[:n_states]
    )
    moved = np.concatenate([moved, of_starts], axis=1)
    return (
        np.concatenate([at_base, _initial_state_residuals(windows, initial_states)], axis=1),
        moved[..., :n_free],
        moved[..., n_free:],
    )


def finite_differences(
    model: Model, windows: Windows, initial_states: Array, values: Array
) -> Array:
    """Change of the residuals when parameters take other values, one set per column of (P, C).

    Returns:
        (C, W, R) as of `residuals`; infinite where a prediction diverged.
    """
    values = np.column_stack([model.vector, values])
    state_columns = np.repeat(initial_states.T[:, None, :], values.shape[1], axis=1)
    _, moved = _perturbed_residuals(model, windows, state_columns, values)
    return np.concatenate([moved, np.zeros((*moved.shape[:2], initial_states.shape[1]))], axis=2)


def _perturbed_residuals(
    model: Model, windows: Windows, state_columns: Array, values: Array
) -> tuple[Array, Array]:
    """Pose residuals of the first column (W, L * 6), and the others' difference (C - 1, W, L * 6)."""
    # Control positions once, and again for each column with other parameters of the input map.
    mapped = [model.names.index(name) for name in model.input_names]
    actuator_positions, variant_index = (
        [windows.actuator_positions(model, values[:, 0])],
        np.zeros(values.shape[1], dtype=int),
    )
    for column in np.flatnonzero((values[mapped] != values[mapped][:, :1]).any(axis=0)):
        variant_index[column] = len(actuator_positions)
        actuator_positions.append(windows.actuator_positions(model, values[:, column]))
    with np.errstate(all="ignore"):
        variants = np.stack(actuator_positions, axis=3)
        poses = predict(
            model,
            windows,
            state_columns,
            values,
            variants,
            variant_index if len(actuator_positions) > 1 else None,
        )
        weighed = _normalise_residuals(windows, poses)
        return weighed[0], weighed[1:] - weighed[0]


def _normalise_residuals(windows: Windows, poses: Array) -> Array:
    """(L, 6, C, W) predicted poses -> (C, W, L * 6) weighted residuals; angles within +-pi."""
    difference = poses.transpose(2, 3, 0, 1) - windows.pose
    angles = difference[..., 3:]
    angles -= 2.0 * np.pi * np.round(angles[:1] / (2.0 * np.pi))
    difference *= windows.weight
    if windows.whitening is not None:
        difference = np.einsum("klm,cwmk->cwlk", windows.whitening, difference, optimize=True)
    difference[~np.isfinite(difference)] = np.inf
    return difference.reshape(*difference.shape[:2], -1)


def _parameter_scale(model: Model, i: int) -> float:
    return max(abs(model.vector[i]), abs(model.parameters[i].start), 0.1)
