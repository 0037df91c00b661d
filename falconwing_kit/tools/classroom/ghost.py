"""Ghost: a flight and a model -> the model's aircraft on the same sticks, and how far it is away.

The ghost starts at a state of the flight and flies on by the logged commands alone: every two
seconds from the flight's state again, or once from the start. Its distance after a horizon is the
error of `sysid.forecast` for the same model. The model is the one that was identified, never the
simulated aircraft with its effects: what it lacks is what parts the two.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, rates_model, state_rates
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.sysid.forecast import forecast, logged_states
from falconwing_kit.sysid.prepare import interpolate_slow_sticks

if TYPE_CHECKING:
    from falconwing_kit.tools.classroom.results import Reflight

HORIZON_S = 2.0  # of a forecast; then the ghost starts from the flight again
GONE_M = 30.0  # a ghost from the start that is farther away is not shown any more [m]
NOMINAL_NAME = "the kit's nominal model"


@dataclass(frozen=True)
class Ghost:
    """A model's flight beside a real one, row by row."""

    states: Array  # (n, n_states) in the order of STATE_NAMES, nan where it is gone
    distance: Array  # (n,) to the flight [m], nan where it is gone


def nominal_model() -> Model:
    """The kit's model behind the radio link: its delay counts from the logged command."""
    model = rates_model()
    return model.with_values({"delay": model.values["delay"] + LINK_DELAY_S})


def fly_ghost(model: Model, table: FlightTable, horizon: float | None = HORIZON_S) -> Ghost:
    """Fly a model on the commands of a flight.

    Args:
        model: with the delay from the logged command on.
        table: a flight with poses, vx, vy, vz (and p, q, r for a model with rates).
        horizon: the ghost starts again from the flight's state so often [s]; None: from the first
            row only. The row at which it starts again still shows the ghost that flew there.

    Returns:
        One row for each of the table; row 0 is the flight's own state.

    Raises:
        InputError: the table lacks columns, or has fewer than two rows.
    """
    n = len(table.t)
    if n < 2:
        raise InputError(f"{table.name}: expected two rows or more for a ghost, got {n}")
    x = logged_states(table, model.n_states)
    every = n - 1
    if horizon is not None:
        require_range("horizon", horizon, low=CONTROL_PERIOD_S, high=600.0)
        step = float(np.median(np.diff(table.t)))
        every = max(1, min(round(horizon / step), n - 1))
    table = interpolate_slow_sticks(table)  # as forecasts take the sticks
    states = np.full_like(x, np.nan)
    states[0] = x[0]
    for first in range(0, n - 1, every):
        last = min(first + every, n - 1)
        if np.isfinite(x[first]).all():
            states[first + 1 : last + 1] = _fly_rows(model, table, x[first], first, last)
    distance = np.linalg.norm(states[:, :3] - table.p_world, axis=1)
    gone = ~np.isfinite(states).all(axis=1) | ~(distance < GONE_M)
    if horizon is None and gone.any():
        gone[int(np.argmax(gone)) :] = True  # it does not come back
    return Ghost(np.where(gone[:, None], np.nan, states), np.where(gone, np.nan, distance))


def ghost_data(flight: "Reflight", model: Model | None = None, name: str = "") -> Any:
    """The ghost of a flight as the player reads it; None where there is none to show.

    Args:
        flight: of `results.refly`.
        model: None for the kit's nominal model.
        name: of the model.
    """
    from falconwing_kit.tools.classroom.results import pose_rows

    table, used = flight.table, model or nominal_model()
    name = name or ("a model file" if model is not None else NOMINAL_NAME)
    try:
        again, once = fly_ghost(used, table), fly_ghost(used, table, None)
    except InputError:
        return None  # too short, or states without velocities
    if not np.isfinite(again.distance[1:]).any():
        return None
    return {
        "model": name,
        "horizon": HORIZON_S,
        "pose": pose_rows(again.states),
        "distance": _rounded(again.distance),
        "note": ghost_sentence(used, table, name),
        "from_start": {"pose": pose_rows(once.states), "distance": _rounded(once.distance)},
    }


def ghost_sentence(model: Model, table: FlightTable, name: str) -> str:
    """How far the ghost is away after its horizon, as `sysid.forecast` has it, in one sentence."""
    horizon = min(HORIZON_S, 0.5 * table.duration)
    try:
        error = forecast(model, table, horizon).position_m
    except InputError:
        return f"{name}, flown on the same sticks"
    text = f"{100.0 * error:.0f} cm" if error < 1.0 else f"{error:.1f} m"
    return (
        f"{name}, flown on the same sticks from the flight's own state every {HORIZON_S:g} s:"
        f" {text} away after {horizon:.2g} s (root mean square of all forecasts)"
    )


def _fly_rows(model: Model, table: FlightTable, x: Array, first: int, last: int) -> Array:
    """States (last - first, n_states) of the rows after `first`, from its state x (n_states,).

    The actuators settle over half the time before the first row, as in `sysid.forecast`.
    """
    t = table.t[first : last + 1]
    steps = np.maximum(np.round(np.diff(t) / CONTROL_PERIOD_S), 1.0).astype(int)
    steps *= SUBSTEPS[model.form]
    edges = [np.linspace(a, b, k, endpoint=False) for a, b, k in zip(t, t[1:], steps, strict=False)]
    ahead = np.concatenate([*edges, t[-1:]])
    dt, before = ahead[1] - ahead[0], min(len(ahead) - 1, 240) // 2
    settling = ahead[0] + dt * np.arange(-before, 0)
    edges_all = np.concatenate([settling, ahead])
    mean, slope = model.actuator_positions(table.t, table.commands, edges_all, model.K)
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    rows, column = [], x[:, None]
    marks = set(np.cumsum(steps).tolist())
    with np.errstate(all="ignore"):
        for k, (start, end) in enumerate(pairwise(ahead)):
            j = before + k
            column = step_batch(
                rates, K, start, column, mean[j][:, None], end - start, slope[j][:, None]
            )
            if k + 1 in marks:
                rows.append(column[:, 0])
    return np.array(rows)


def _rounded(values: Array) -> list[float | None]:
    return [round(v, 4) + 0.0 if math.isfinite(v) else None for v in values.tolist()]
