"""Effects hidden in a recording: a measured flight -> the measurement that an effect would give.

No simulator is needed: each function here is an exact transform of a recorded flight. Two ideas
carry all of them. What is measured can be moved (Galilei: in air that drifts over the floor, the
same sticks fly the same path through the air, so every position moves by w t; a camera that was
turned measures turned attitudes). And a recording of an aircraft that was given the command c is a
recording of a weaker one that was given more: where an effect makes u act as D(u), the log that
states u with D(u) = c shows that effect, and the poses stay as they were measured.

The stated commands can lie beyond a stick's end. What number a stick's full deflection has is a
choice, though, so `restate_commands` first gives both the baseline part and the part under test a
unit with room; a fit absorbs it in its control derivatives.
"""

from dataclasses import replace

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.flight_table import FlightTable, nominal_rate_hz, select_rows
from falconwing_kit.core.frames import euler_from_rotation, rotation_world_body
from falconwing_kit.core.messages import COMMAND_NAMES

THROTTLE, AILERON = COMMAND_NAMES.index("throttle"), COMMAND_NAMES.index("aileron")
LOWEST = np.array([0.0, -1.0, -1.0, -1.0])  # of each command; the highest is 1
VELOCITY, RATES = ("vx", "vy", "vz"), ("p", "q", "r")


# ---- The recording, before anything is hidden in it


def split_recording(
    table: FlightTable, begin: float = 0.0, block_s: float | None = None
) -> tuple[FlightTable, FlightTable]:
    """A baseline part and a part under test, both of them measured; always the same two.

    Args:
        table: the recording.
        begin: time before which nothing is used, such as a launch [s].
        block_s: None for the first half and the second; else the length of blocks that go to the
            one and the other in turn [s], so that a slow change is in both.

    Raises:
        InputError: a part would be empty, `begin` is behind the end, or a length is not positive.
    """
    end = float(table.t[-1])
    require_range("begin", begin, high=end)
    if block_s is None:
        block_s = 0.5 * (end - begin) + 1e-9
    require_range("block_s", block_s, low=1e-3)
    block = np.floor((table.t - begin) / block_s).astype(np.int64)
    parts = [np.flatnonzero((block >= 0) & (block % 2 == which)) for which in (0, 1)]
    if min(map(len, parts)) < 2:
        raise InputError(
            f"{table.name}: expected rows for two parts behind {begin:g} s in blocks of "
            f"{block_s:g} s, got {len(parts[0])} and {len(parts[1])} of {len(table.t)}"
        )
    first, second = (select_rows(table, rows) for rows in parts)
    return first, second


def restate_commands(
    table: FlightTable,
    scale: tuple[float, float, float, float] = (0.6, 0.5, 0.5, 0.5),
    centre: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> FlightTable:
    """The same flight with its sticks in another unit: u = scale (c - centre).

    Scale and centre of aileron, elevator and rudder are absorbed by a model's control derivatives
    and trim moments; the throttle has no centre, since thrust is in proportion to it.

    Args:
        table: the recording.
        scale: of throttle, aileron, elevator, rudder, above zero.
        centre: stick position that becomes zero, of the same; zero for the throttle.

    Raises:
        InputError: a scale is not positive, the throttle has a centre, or a stick leaves its range.
    """
    scales, centres = require_shape("scale", scale, (4,)), require_shape("centre", centre, (4,))
    if not (scales > 0.0).all():
        raise InputError(f"scale: expected four numbers above zero, got {scale}")
    if centres[THROTTLE] != 0.0:
        raise InputError(f"centre: expected 0 for the throttle, got {centres[THROTTLE]:g}")
    return _with_commands(table, scales * (table.commands - centres))


# ---- Effects of the air: the path moves


def add_wind(table: FlightTable, wind_world: tuple[float, float, float]) -> FlightTable:
    """The flight in air that moves over the floor: p + w t and v + w, attitudes as measured.

    Exact in a hall whose air was at rest, away from floor and walls (Galilei).

    Args:
        table: the recording.
        wind_world: w, where the air moves to [m/s].
    """
    wind = require_shape("wind_world", wind_world, (3,))
    moved = {
        name: table.extra[name] + wind[axis]
        for axis, name in enumerate(VELOCITY)
        if name in table.extra
    }
    time = table.t - table.t[0]
    return replace(
        table,
        p_world=table.p_world + time[:, None] * wind,
        extra={**table.extra, **moved},
    )


# ---- Effects of propeller and surfaces: the log states another command than acted


def weaken_propeller(table: FlightTable, share: float) -> FlightTable:
    """A propeller that lost a share of its thrust: the log states throttle / (1 - share).

    Args:
        table: the recording.
        share: of the thrust, 0 to below 1.

    Raises:
        InputError: the share is out of range, or the stated throttle would exceed 1.
    """
    return _scale_command(table, THROTTLE, 1.0 - require_range("share", share, low=0.0, high=0.95))


def drain_battery(table: FlightTable, share_per_minute: float) -> FlightTable:
    """Thrust falling with time: the log states throttle / (1 - share t / 60 s), t since its start.

    Args:
        table: the recording.
        share_per_minute: of the thrust [1/min].

    Raises:
        InputError: nothing of the thrust would be left, or the stated throttle would exceed 1.
    """
    time = table.t - table.t[0]
    left = 1.0 - share_per_minute * time / 60.0
    require_range("share of the thrust left at the end", float(left.min()), low=0.05)
    return _scale_command(table, THROTTLE, left)


def weaken_aileron(table: FlightTable, share: float) -> FlightTable:
    """Ailerons that lost a share of their rolling moment: the log states aileron / (1 - share).

    Args:
        table: the recording.
        share: of the moment, 0 to below 1.

    Raises:
        InputError: the share is out of range, or the stated aileron would leave -1..1.
    """
    return _scale_command(table, AILERON, 1.0 - require_range("share", share, low=0.0, high=0.95))


def move_trim(
    table: FlightTable, aileron: float = 0.0, elevator: float = 0.0, rudder: float = 0.0
) -> FlightTable:
    """Neutral positions that moved by these shares of full deflection: the log states u = c - b.

    Raises:
        InputError: a stated stick would leave -1..1.
    """
    return _with_commands(table, table.commands - np.array([0.0, aileron, elevator, rudder]))


def widen_dead_zone(table: FlightTable, size: float) -> FlightTable:
    """A dead zone between stick and surface: the log states u = c + size sign(c), throttle as is.

    The surface moves by D(u) = sign(u) max(|u| - size, 0), the textbook's dead zone (play in a
    linkage). Where c is zero, so is u. A recording cannot hide the other kind, whose small commands
    vanish and whose large ones arrive in full: no stick there gives a small deflection.

    Args:
        table: the recording; a stick that rests far from zero hardly shows the zone, so restate it
            about its own mean first.
        size: half the width, share of full deflection, at least 0.

    Raises:
        InputError: the size is negative, or a stated stick would leave -1..1.
    """
    require_range("size", size, low=0.0, high=1.0)
    commands = table.commands + size * np.sign(table.commands) * [0.0, 1.0, 1.0, 1.0]
    return _with_commands(table, commands)


def delay_commands(table: FlightTable, seconds: float) -> FlightTable:
    """Commands that act later than the log states: at t it states what acted at t + delay.

    Each row takes the command held at that later time, so commands change at rows only; a delay of
    whole periods shifts them exactly. The rows at the end, for which the later command is not
    recorded, are left out. Late time stamps of the poses make the same log.

    Args:
        table: the recording.
        seconds: the delay, at least 0 [s].

    Raises:
        InputError: the delay is negative or longer than the flight.
    """
    require_range("seconds", seconds, low=0.0, high=table.duration)
    # A command that changes at a row whose stamp jitters by less than a tenth of a period counts.
    rounding = 0.1 / nominal_rate_hz(table) if len(table.t) > 1 else 0.0
    kept = np.flatnonzero(table.t + seconds <= table.t[-1] + rounding)
    later = np.searchsorted(table.t, table.t[kept] + seconds + rounding, side="right") - 1
    return replace(select_rows(table, kept), commands=table.commands[later])


# ---- Effects of the measurement: poses move, the aircraft flies as before


def tilt_camera(table: FlightTable, pitch: float = 0.0, roll: float = 0.0) -> FlightTable:
    """A camera turned in the body: R_world_camera = R_world_body R_y(pitch) R_x(roll).

    Args:
        table: the recording.
        pitch: camera turned up [rad].
        roll: camera turned about the nose, right side down [rad].
    """
    R_body_camera = rotation_world_body(0.0, 0.0, 0.0).T @ rotation_world_body(roll, pitch, 0.0)
    R_world_camera = rotation_world_body(*table.attitude.T) @ R_body_camera
    return replace(table, attitude=np.column_stack(euler_from_rotation(R_world_camera)))


def turn_heading(table: FlightTable, yaw: float) -> FlightTable:
    """Headings measured with an error, positions without: yaw + error [rad]."""
    return replace(table, attitude=table.attitude + np.array([0.0, 0.0, yaw]))


def move_camera(table: FlightTable, p_body: tuple[float, float, float]) -> FlightTable:
    """A camera that stands elsewhere in the body: p + R_world_body d, the lever arm.

    Logged velocities get the arm's own, R (omega x d), where body rates are logged.

    Args:
        table: the recording.
        p_body: d, from the old place to the new one: to the nose, right wing, belly [m].

    Raises:
        InputError: velocities are logged without body rates.
    """
    arm_body = require_shape("p_body", p_body, (3,))
    R_world_body = rotation_world_body(*table.attitude.T)
    extra = dict(table.extra)
    if any(name in extra for name in VELOCITY):
        if not all(name in extra for name in (*VELOCITY, *RATES)):
            raise InputError(
                f"{table.name}: expected columns {', '.join((*VELOCITY, *RATES))} or none of "
                "vx, vy, vz; remove the velocities"
            )
        rates_body = np.column_stack([extra[name] for name in RATES])
        v_body = np.cross(rates_body, arm_body)
        v_world = np.einsum("nij,nj->ni", R_world_body, v_body)
        extra |= {name: extra[name] + v_world[:, axis] for axis, name in enumerate(VELOCITY)}
    return replace(table, p_world=table.p_world + R_world_body @ arm_body, extra=extra)


# ---- Tables


def _scale_command(table: FlightTable, column: int, left: float | Array) -> FlightTable:
    """The log of an aircraft of which this share of one command's action is left."""
    commands = table.commands.copy()
    commands[:, column] /= left
    return _with_commands(table, commands)


def _with_commands(table: FlightTable, commands: Array) -> FlightTable:
    """The flight with other commands, none of them beyond its stick."""
    excess = np.maximum(commands - 1.0, LOWEST - commands)
    row, column = np.unravel_index(np.argmax(excess), excess.shape)
    if excess[row, column] > 1e-9:
        raise InputError(
            f"{table.name}: expected {COMMAND_NAMES[column]} in {LOWEST[column]:g}..1, got "
            f"{commands[row, column]:.3f} at {table.t[row]:.2f} s; restate_commands gives room"
        )
    return replace(table, commands=commands)
