"""Log table: poses in a log's own axes, and its commands -> a flight table in the kit's.

A row is one pose as it was measured: none is smoothed or interpolated. Its commands lie on the
lines between the messages of the sticks, which come less often and would be late if they were held.
What contradicts the laws of flight is a warning of the table.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.flight_table import LABEL_COLUMN, FlightTable, interpolate_readings
from falconwing_kit.tools.bridge.axes import (
    SURE_CORRELATION,
    LogAxes,
    nose_along_velocity,
    stick_correlations,
    to_kit_poses,
)

DECIMALS = 6  # of seconds, metres and radians in the table: finer than any motion capture
MAX_DURATION_S = 86_400.0  # of a flight; a longer one comes from a damaged time stamp
Nanoseconds = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LogPoses:
    """Poses in a log's own axes."""

    t: Nanoseconds  # (N,) [ns], increasing
    p_log: Array  # (N, 3) [m], nan where there is none
    R_log_body: Array  # (N, 3, 3), from the log's body axes to its world
    v_log: Array | None = None  # (N, 3) [m/s], where the log has it


def build_table(
    name: str,
    source: str,
    poses: LogPoses,
    t_command: Nanoseconds,
    commands: Array,
    choose_axes: Callable[[Array, Array, Array], LogAxes],
    rate_hz: float | None,
    warnings: list[str],
) -> FlightTable:
    """A flight table of poses and commands; time zero is its first row.

    Args:
        name: of the log, for the table and for messages.
        source: text of the column `source`.
        poses: of the aircraft.
        t_command: (M,) times of the commands [ns], increasing.
        commands: (M, 4).
        choose_axes: t (N,) [s], p_log and R_log_body of the rows -> the axes of the log.
        rate_hz: rows per second: the pose nearest to each time of an even grid, with its own time
            stamp, without a pose where none is within half a period. None for every pose.
        warnings: sentences for the table, in which those about the flight are put here.

    Raises:
        InputError: no pose comes after the first command, the log lasts longer than a day, or the
            rate is above the poses' own.
    """
    zero = poses.t[0]
    t, t_commands = (poses.t - zero) * 1e-9, (t_command - zero) * 1e-9
    if t[-1] > MAX_DURATION_S:
        raise InputError(f"{name}: expected one flight, got {t[-1]:.3g} s; a time stamp is wrong")
    row = np.arange(len(t))
    if rate_hz is not None:
        row, t = _nearest_to_grid(name, t, poses.p_log, rate_hz)
    kept = t >= t_commands[0]
    if not kept.any():
        raise InputError(
            f"{name}: expected poses after the first command, got none: the poses end "
            f"{t_commands[0] - t[-1]:.1f} s before the commands begin"
        )
    if not kept.all():
        warnings.append(f"poses before the first command, left out: {(~kept).sum()}")
    row, t = row[kept], t[kept]
    commands = interpolate_readings(t, t_commands, commands)
    t = t - t[0]
    p_log = np.where(row[:, None] < 0, np.nan, poses.p_log[row])
    R_log_body = poses.R_log_body[row]
    axes = choose_axes(t, p_log, R_log_body)
    p_world, attitude = to_kit_poses(p_log, R_log_body, axes)
    _compare_with_laws(t, p_world, attitude, commands, warnings)
    unmeasured = np.asarray(~np.isfinite(p_log).all(axis=1))
    attitude[unmeasured] = np.nan
    extra = {}
    if poses.v_log is not None:
        v_log = np.where(unmeasured[:, None], np.nan, poses.v_log[row])
        v_world, _ = to_kit_poses(v_log, R_log_body, replace(axes, origin=(0.0, 0.0, 0.0)))
        v_world = np.round(v_world, DECIMALS)
        extra = {f"v{axis}": v_world[:, i] for i, axis in enumerate("xyz")}
    return FlightTable(
        name=name,
        t=np.round(t, DECIMALS),
        p_world=np.round(p_world, DECIMALS),
        attitude=np.round(attitude, DECIMALS),
        commands=np.round(commands, DECIMALS),
        extra=extra,
        labels={LABEL_COLUMN: (source.replace(",", " "),) * len(t)},
        warnings=tuple(f"{name}: {sentence}" for sentence in warnings),
    )


def _nearest_to_grid(
    name: str, t: Array, p_log: Array, rate_hz: float
) -> tuple[NDArray[np.int64], Array]:
    """The row of the pose nearest to each time of an even grid, -1 where none is near; its time."""
    require_range("rate_hz", rate_hz, low=0.1, high=1000.0)
    own_rate = 1.0 / float(np.median(np.diff(t))) if len(t) > 1 else rate_hz
    if rate_hz > 1.01 * own_rate:
        raise InputError(
            f"{name}: rate_hz: expected at most the poses' own {own_rate:.4g} Hz, got {rate_hz:g}; "
            "poses are not interpolated"
        )
    measured = np.flatnonzero(np.isfinite(p_log).all(axis=1))
    cells = int((t[-1] - t[0]) * rate_hz + 1e-6) + 1
    if cells > 100 * (1000 + len(t)):
        raise InputError(f"{name}: expected one flight, got {t[-1] - t[0]:.3g} s; a stamp is wrong")
    cell = np.rint((t[measured] - t[0]) * rate_hz).astype(np.int64)
    measured, cell = measured[cell < cells], cell[cell < cells]
    # Of several poses in a cell the nearest to its centre: the last one written below.
    distance = np.abs(t[measured] - t[0] - cell / rate_hz)
    order = np.argsort(-distance, kind="stable")
    row = np.full(cells, -1, dtype=np.int64)
    row[cell[order]] = measured[order]
    return row, np.where(row < 0, t[0] + np.arange(cells) / rate_hz, t[row])


def _compare_with_laws(
    t: Array, p_world: Array, attitude: Array, commands: Array, warnings: list[str]
) -> None:
    """Warn where the nose does not point along the path, or a stick moves against its rate."""
    cosine = nose_along_velocity(t, p_world, attitude)
    if cosine < 0.7:
        warnings.append(
            f"the nose points {np.degrees(np.arccos(np.clip(cosine, -1, 1))):.0f} deg from the "
            "velocity; the body's x axis is not the nose, or the world's axes are swapped"
        )
    measured = np.where(np.isfinite(p_world[:, :1]), attitude, np.nan)
    for stick, rate, correlation in zip(
        ("aileron", "elevator"), ("roll", "pitch"),
        stick_correlations(t, measured, commands), strict=True,
    ):  # fmt: skip
        if correlation < -SURE_CORRELATION:
            warnings.append(
                f"{stick} moves against the {rate} rate (correlation {correlation:.2f}), so it is "
                f"probably reversed: put commands.{stick}.full on the other side of zero"
            )
