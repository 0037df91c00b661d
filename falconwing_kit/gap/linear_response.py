"""Linear response: a fit's predicted windows -> how effects change the poses, without flying again.

A small load, wind or control change drives the linearised flight [Stevens, Lewis & Johnson, ch. 3]

    dx_(k+1) = Phi_k dx_k + Gamma_k drive_k,   dx_0 = 0,

from row to row of a window, Phi = exp(A dt) and Gamma by finite differences of one integration of
all rows at once. An effect gives its drive along the predicted flight, so hundreds of effects cost
little more than one: a scan by flight simulation integrates each of them over the whole flight.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.integrate import step_batch
from falconwing_kit.aircraft.model import Model, parameter_record, state_rates
from falconwing_kit.aircraft.terms import Flow, Parameter, Term, WindTerm, air_flow
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import rotation_entries
from falconwing_kit.sysid.shooting import CHUNK, POSE_ROWS, STATE_STEPS, Windows

LOADS, WINDS, CONTROLS = 6, 3, 4  # drives: body force and moment, wind in the world, control inputs
DRIVES = LOADS + WINDS + CONTROLS
DRIVE_STEP = 1e-3  # m/s^2, rad/s^2, m/s and shares of full deflection
DIVERGED = 1e9  # sigma per unit of an amplitude, of a window whose prediction diverged
COLUMNS = 48  # amplitudes whose responses are computed together

_PROBE_NAMES = tuple(f"probe_{i}" for i in range(LOADS + WINDS))


def _probe_parameters(names: Sequence[str]) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, 0.0, -1.0, 1.0, "-", "unit drive") for name in names)


def _probe_loads(air: Flow, K: Any) -> tuple[Any, ...]:
    return K.probe_0, K.probe_1, K.probe_2, K.probe_3, K.probe_4, K.probe_5


def _probe_wind(px: Any, py: Any, height: Any, time: Any, K: Any) -> tuple[Any, Any, Any]:
    return K.probe_6, K.probe_7, K.probe_8


PROBE_LOADS = Term("probe_loads", _probe_parameters(_PROBE_NAMES[:LOADS]), _probe_loads)
PROBE_WIND = WindTerm("probe_wind", _probe_parameters(_PROBE_NAMES[LOADS:]), _probe_wind)


@dataclass(frozen=True)
class EffectVariant:
    """An effect at one scan point: a place, an angle or a delay."""

    effect: Effect
    values: dict[str, float]  # its parameters there


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives of the residuals to a variant's A amplitudes."""

    variant: EffectVariant
    derivative: Array  # (W, R, A)


@dataclass(frozen=True)
class LinearResponse:
    """The linearised flight of a model through W windows of L rows."""

    model: Model
    windows: Windows
    states: Array  # (L, n_states, W) predicted at the rows
    controls: Array  # (L - 1, 4, W) mean control positions between rows
    transition: Array  # (L - 1, W, n_states, n_states)
    drive_gain: Array  # (L - 1, W, n_states, DRIVES)

    def sensitivities(self, tried: Sequence[EffectVariant]) -> Iterator[Sensitivities]:
        """Derivatives of the residuals to the amplitudes of each variant, in the order given."""
        for variants, derivative in self.blocks(tried):
            for variant, columns in zip(variants, column_slices(variants), strict=True):
                yield Sensitivities(variant, derivative[..., columns])

    def blocks(self, tried: Sequence[EffectVariant]) -> Iterator[tuple[list[EffectVariant], Array]]:
        """The same in blocks: some variants, and derivatives (W, R, C) to all their amplitudes.

        Memory does not grow with the number of variants.
        """
        block: list[EffectVariant] = []
        for variant in tried:
            block.append(variant)
            if sum(len(v.effect.amplitudes) for v in block) >= COLUMNS:
                yield block, self._derivatives(block)
                block = []
        if block:
            yield block, self._derivatives(block)

    def _derivatives(self, tried: Sequence[EffectVariant]) -> Array:
        """(W, R, C) for a few variants, their C amplitudes side by side."""
        rows, n_windows = self.states.shape[0], self.states.shape[2]
        columns = sum(len(v.effect.amplitudes) for v in tried)
        drive = np.zeros((rows - 1, n_windows, DRIVES, columns))
        measured = np.zeros((rows, n_windows, 6, columns))
        flow, at = self.flow, 0
        for variant in tried:
            bare = self.model.with_effect(variant.effect)
            for p in variant.effect.amplitudes:
                size = variant.values[p.name]
                zero = {q.name: 0.0 for q in variant.effect.amplitudes}
                model = bare.with_values({**variant.values, **zero, p.name: size})
                self._drive(variant.effect, model, flow, drive[..., at])
                drive[..., at] /= size
                if variant.effect.measurement_map is not None:
                    poses = self.states[:, POSE_ROWS].transpose(1, 0, 2)
                    moved = model.measured_pose(poses, model.K)
                    still = self.model.measured_pose(poses, self.model.K)
                    measured[..., at] = (moved - still).transpose(1, 2, 0) / size
                at += 1
        return self._residuals(measured + self._poses(drive))

    @property
    def flow(self) -> Flow:
        """The air flow half-way between rows, each field (L - 1, W)."""
        x = 0.5 * (self.states[:-1] + self.states[1:]).transpose(1, 0, 2)  # (n_states, L - 1, W)
        nodes = self.windows.nodes
        return flow_along(
            self.model, x, self.controls.transpose(1, 0, 2), 0.5 * (nodes[:, :-1] + nodes[:, 1:]).T
        )

    def _drive(self, effect: Effect, model: Model, flow: Flow, out: Array) -> None:
        """Add what an effect drives, at its values in the model, to out (L - 1, W, DRIVES)."""
        K = model.K
        term = effect.term(self.model.terms)
        if term is not None:
            for i, load in enumerate(term.evaluate(flow, K)):
                out[..., i] = load
        if effect.wind_field is not None:
            for i, part in enumerate(
                effect.wind_field(flow.px, flow.py, flow.height, flow.time, K)
            ):
                out[..., LOADS + i] = part
        if effect.command_map is not None or effect.input_map is not None:
            changed = mean_controls(self.windows, model) - self.controls
            out[..., LOADS + WINDS :] = changed.transpose(0, 2, 1)

    def _poses(self, drive: Array) -> Array:
        """Response (L, W, 6, C) of the measured poses to drives (L - 1, W, DRIVES, C)."""
        rows, n_windows, _, columns = (drive.shape[0] + 1, *drive.shape[1:])
        change = np.zeros((n_windows, self.model.n_states, columns))
        poses = np.zeros((rows, n_windows, 6, columns))
        forced = self.drive_gain @ drive
        for k in range(rows - 1):
            change = self.transition[k] @ change + forced[k]
            poses[k + 1] = change[:, POSE_ROWS]
        if not any(effect.measurement_map for effect in self.model.effects):
            return poses
        # Through the measurement maps of the model's own effects, by a small step.
        K, small = self.model.K, 1e-4
        at = self.states[:, POSE_ROWS].transpose(1, 0, 2)[..., None]  # (6, L, W, 1)
        moved = self.model.measured_pose(at + small * poses.transpose(2, 0, 1, 3), K)
        return np.asarray((moved - self.model.measured_pose(at, K)) / small).transpose(1, 2, 0, 3)

    def _residuals(self, poses: Array) -> Array:
        """Weighted, whitened derivatives (W, R, C) of pose changes (L, W, 6, C)."""
        windows, columns = self.windows, poses.shape[-1]
        change = poses.transpose(1, 0, 2, 3) * windows.weight[..., None]
        if windows.whitening is not None:
            filters = windows.whitening  # (6, L, L) or (W, 6, L, L)
            change = np.stack([filters[..., k, :, :] @ change[:, :, k] for k in range(6)], axis=2)
        change = np.where(np.abs(change) < DIVERGED, change, 0.0).reshape(len(windows), -1, columns)
        of_states = np.zeros((len(windows), self.model.n_states, columns))
        return np.concatenate([change, of_states], axis=1)


@np.errstate(all="ignore")
def linear_response(model: Model, windows: Windows, initial_states: Array) -> LinearResponse:
    """Linearise a model's flight through windows from their initial states (W, n_states)."""
    n, count = model.n_states, len(windows)
    probed = model.with_terms(PROBE_LOADS, PROBE_WIND)
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    positions = windows.actuator_positions(model, model.vector)  # (S, 2, 4, W)
    sub, steps = windows.substeps, np.diff(windows.edges[:, windows.warmup_steps :], axis=1).T
    begin = windows.edges[:, windows.warmup_steps : -1].T  # (S, W)
    rows = windows.nodes.shape[1]
    # The flight itself.
    states = np.empty((rows, n, count))
    states[0] = x = np.ascontiguousarray(initial_states.T)
    for k in range(len(steps)):
        x = step_batch(rates, K, begin[k], x, positions[k, 0], steps[k], positions[k, 1])
        if (k + 1) % sub == 0:
            states[(k + 1) // sub] = x
    # One column each: unchanged, one state changed (n), one drive changed (DRIVES).
    columns = 1 + n + DRIVES
    values = np.repeat(probed.vector[:, None], columns, axis=1)
    for i, name in enumerate(_PROBE_NAMES):
        values[probed.names.index(name), 1 + n + i] = DRIVE_STEP
    varied = np.ptp(values, axis=1) > 0.0
    K = parameter_record(probed.names)(
        *(v[:, None] if many else float(v[0]) for v, many in zip(values, varied, strict=True))
    )
    rates = state_rates(probed.form, probed.terms, probed.winds)
    change = np.zeros((4, columns, 1))
    for i in range(CONTROLS):
        change[i, 1 + n + LOADS + WINDS + i] = DRIVE_STEP
    # All rows of all windows as aircraft of their own: (rows - 1) W of them.
    starts = states[:-1].transpose(1, 0, 2).reshape(n, -1)
    by_row = positions.reshape(rows - 1, sub, 2, 4, count).transpose(1, 2, 3, 0, 4)
    by_row = by_row.reshape(sub, 2, 4, -1)
    durations, times = (
        a.reshape(rows - 1, sub, count).transpose(1, 0, 2).reshape(sub, -1) for a in (steps, begin)
    )
    ends = np.empty((n, columns, starts.shape[1]))
    width = max(1, CHUNK // columns)
    for a in range(0, starts.shape[1], width):
        part = slice(a, a + width)
        x = np.repeat(starts[:, None, part], columns, axis=1)
        for i in range(n):
            x[i, 1 + i] += STATE_STEPS[i]
        for s in range(sub):
            mean, slope = by_row[s, 0][:, None, part] + change, by_row[s, 1][:, None, part]
            x = step_batch(
                rates,
                K,
                times[s, part],
                x,
                mean,
                durations[s, part],
                np.broadcast_to(slope, mean.shape),
            )
        ends[:, :, part] = x
    step = np.concatenate([STATE_STEPS[:n], np.full(DRIVES, DRIVE_STEP)])
    slopes = (ends[:, 1:] - ends[:, :1]) / step[:, None]
    slopes = np.nan_to_num(slopes, posinf=0.0, neginf=0.0)
    slopes = slopes.reshape(n, n + DRIVES, rows - 1, count).transpose(2, 3, 0, 1)
    return LinearResponse(
        model,
        windows,
        states,
        by_row[:, 0].mean(axis=0).reshape(4, rows - 1, count).transpose(1, 0, 2),
        np.ascontiguousarray(slopes[..., :n]),
        np.ascontiguousarray(slopes[..., n:]),
    )


def column_slices(tried: Sequence[EffectVariant]) -> list[slice]:
    """Where the amplitudes of each variant stand among those of all, side by side."""
    ends = np.cumsum([0, *(len(v.effect.amplitudes) for v in tried)]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]


def mean_controls(windows: Windows, model: Model) -> Array:
    """Mean control positions between rows (L - 1, 4, W), through a model's input maps."""
    mean = windows.actuator_positions(model, model.vector)[:, 0]
    return np.asarray(mean.reshape(-1, windows.substeps, *mean.shape[1:]).mean(axis=1))


def flow_along(model: Model, x: Array, command: Array, time: Array) -> Flow:
    """The air flow at states (n_states, ...) with control positions (4, ...), as in f_K."""
    row_x, row_y, row_z = rotation_entries(x[5], x[3], x[4])
    wind = np.zeros((3, *x.shape[1:]))
    for part in model.winds:
        for i, along in enumerate(part.evaluate(x[0], x[1], x[2], time, model.K)):
            wind[i] += along
    v_world = x[6:9] - wind
    v_body = tuple(
        row_x[i] * v_world[0] + row_y[i] * v_world[1] + row_z[i] * v_world[2] for i in range(3)
    )
    zero = np.zeros(x.shape[1:])
    rates = (x[9], x[10], x[11]) if len(x) > 9 else (zero, zero, zero)
    flow: Flow = air_flow(v_body, rates, (x[0], x[1], x[2]), time, command, (x[5], x[3]))
    return flow
