"""Diagnosis of a flight table or a pair: kinematic laws -> the likely faults of the file (axes,
signs, units, columns swapped, two aircraft), in sentences.

A model fitted to a log with another axis, sign or unit is silently wrong, or fails with a number
that names no cause. Most faults show without any model, because the motion of an aircraft obeys
kinematics that hold for all of them [Beard & McLain, Small Unmanned Aircraft, ch. 2 and 9]:

    course    the velocity points along the nose, up to wind and sideslip: chi = yaw + crab angle
    turn      d(chi)/dt = (g / V) tan(roll), the coordinated turn [eq. 9.14]
    climb     the path climbs where the nose is raised: gamma and pitch rise together
    lift      lift over V^2 rises with the angle of attack
    upright   the belly points down most of the time

A table that obeys them has no fault of axes or units. For one that does not, every likely mistake
is undone in turn; the one (or the pair) that makes all five hold is named. Only then the commands
are compared with the angular accelerations. Velocity and angles are local straight lines through
the poses of about a second: enough for signs, whatever the noise.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import (
    MAX_GROWTH,
    POSE_COLUMNS,
    FlightTable,
    likely_command_unit,
    likely_time_unit,
)
from falconwing_kit.core.frames import GRAVITY, body_rates, rotation_world_body
from falconwing_kit.core.messages import COMMAND_NAMES
from falconwing_kit.sysid.prepare import MIN_SEGMENT_S, difference_noise

GRID_S = 0.1  # step of the grid on which the motion is estimated
HALF_SPAN_S = 0.5  # of the local straight lines, to either side: 30 cm of noise become 0.2 m/s
MIN_POSES = 10  # fewer are none
MIN_GRID_ROWS = 30  # estimates needed to compare anything: 3 s
OUTLIER_SIGMAS = 6.0
MIN_TURN = 0.05  # rms of tan(roll) below which a flight shows nothing about turns: 3 deg of bank
# The least of a sound flight. A mean angle between nose and course above 30 deg takes a wind of
# half the airspeed; the turn and the climb are correlations. Below one, mistakes are tried; one is
# named if undoing it lifts all above these, and the sum of the laws by so much.
LEAST = {"course": 0.85, "turn": 0.5, "climb": -0.15, "upright": 0.3}
CERTAIN_RISE, LIKELY_RISE = 0.8, 0.4  # of the sum of the laws where a mistake is undone
INCONSISTENT_COURSE = 0.5  # mean cosine; below it path and attitude contradict each other
MIN_STICK_S = 15.0  # of flight to judge commands by; less is a manoeuvre or two
MIN_STICK_GAIN = 0.5  # of the similarity of the responses, for each change of a column
MOVING_SHARE = 0.2  # of the usual speed; slower rows are on the ground
LARGEST_SPEED_RATIO, LARGEST_ROLL_RATIO = 1.8, 4.0  # of two flights of one aircraft
LARGEST_REPEATED_SHARE = 0.3  # of rows that repeat a pose to the last digit while flying
LARGEST_JUMP_SHARE = 0.25  # of rows that leap away from their neighbours; more than outliers
FEET, CENTIMETRES, MILLIMETRES = 1.0 / 0.3048, 100.0, 1000.0  # per metre


@dataclass(frozen=True)
class Fault:
    """A likely fault of a flight table."""

    kind: str  # such as "degrees", "roll_reversed", "z_down+roll_reversed"
    certain: bool  # True: no aircraft can have flown this; False: look here if a fit turns out poor
    sentence: str  # likely cause and what to do, starting with the table's name


@dataclass(frozen=True)
class _Motion:
    """Smoothed motion on a grid, M rows where it is known."""

    v_world: Array  # (M, 3) [m/s]
    a_world: Array  # (M, 3) [m/s^2]
    angles: Array  # (M, 3) roll, pitch, yaw [rad], unwrapped
    angle_rates: Array  # (M, 3) [rad/s]
    height: Array  # (M,) pz [m]
    t: Array  # (M,) [s] since the first row


def diagnose_table(table: FlightTable) -> tuple[Fault, ...]:
    """Find likely faults of a flight table; cost well below a second.

    Certain ones are to be refused before a fit, uncertain ones to be named when a fit is poor.

    Args:
        table: as read or made in memory.

    Returns:
        The faults, certain ones first; empty for a flight that obeys kinematics.
    """
    if len(table.t) < 2:
        return ()  # refused elsewhere: no rate, no duration
    faults = _unit_faults(table)
    if not faults:
        faults = _record_faults(table)
    if not any(fault.certain for fault in faults):
        faults += _motion_faults(table)
    named = (replace(fault, sentence=f"{table.name}: {fault.sentence}") for fault in faults)
    return tuple(sorted(named, key=lambda fault: not fault.certain))


def diagnose_pair(baseline: FlightTable, flight: FlightTable) -> tuple[Fault, ...]:
    """Signs that a baseline flight and a flight are of two aircraft; never certain.

    Compares what an effect hardly changes: the usual speed, and the roll rate of full aileron.

    Args:
        baseline: the baseline flight, without faults of its own.
        flight: the flight under test, likewise.
    """
    speeds, rolls = zip(*(_speed_and_roll_rate(table) for table in (baseline, flight)), strict=True)
    for (first, second), largest, what, unit in (
        (speeds, LARGEST_SPEED_RATIO, "usual speed", "m/s"),
        (rolls, LARGEST_ROLL_RATIO, "roll rate of full aileron", "rad/s"),
    ):
        if min(first, second) > 0.0 and max(first / second, second / first) > largest:
            return (
                Fault(
                    "two_aircraft",
                    False,
                    f"{flight.name}: {what} {second:.3g} {unit}, in {baseline.name} "
                    f"{first:.3g} {unit}: two aircraft? take both flights with the same one",
                ),
            )
    return ()


def _speed_and_roll_rate(table: FlightTable) -> tuple[float, float]:
    """Usual speed [m/s], roll rate over aileron [rad/s]; 0 where the flight does not show it."""
    motion = _estimate_motion(*_clean_poses(table))
    if motion is None:
        return 0.0, 0.0
    speed = float(np.median(np.linalg.norm(motion.v_world, axis=1)))
    rates = motion.angle_rates[:, 0] - np.sin(motion.angles[:, 1]) * motion.angle_rates[:, 2]
    aileron = np.interp(motion.t - 0.1, table.t - table.t[0], table.commands[:, 1])
    rates, aileron = rates - rates.mean(), aileron - aileron.mean()
    if _correlation(rates, aileron) < 0.5:
        return speed, 0.0
    return speed, float(rates @ rates / (rates @ aileron))


def require_sound_table(table: FlightTable) -> None:
    """Raise InputError with the sentence of the first certain fault of a table, if it has one."""
    for fault in diagnose_table(table):
        if fault.certain:
            raise InputError(fault.sentence)


# Units and records: what the columns show without any smoothing
# --------------------------------------------------------------------------------------------------


def _unit_faults(table: FlightTable) -> list[Fault]:
    """Time, commands and angles in other units than seconds, -1..1 and radians."""
    faults = []
    unit = likely_time_unit(table.t)
    if unit is not None:
        faults.append(
            Fault(
                "time_unit",
                True,
                f"time looks like {unit[0]}: expected seconds, "
                f"got rows {np.median(np.diff(table.t)):g} apart; divide the column t by "
                f"{unit[1]:g}",
            )
        )
    elif table.duration < MIN_SEGMENT_S:
        faults.append(
            Fault(
                "too_short",
                True,
                f"expected a flight of at least {MIN_SEGMENT_S:g} s, "
                f"better 60 s, got {table.duration:.3g} s in {len(table.t)} rows; record a "
                "longer one",
            )
        )
    for name, values in zip(COMMAND_NAMES, table.commands.T, strict=True):
        unit_of_command = likely_command_unit(name, values)
        if unit_of_command:
            faults.append(Fault("command_unit", True, unit_of_command))
            break
    return faults


def _record_faults(table: FlightTable) -> list[Fault]:
    """Columns that stand still, poses that are repeated, rows of two aircraft or two flights."""
    known = table.has_pose
    pose = np.column_stack([table.p_world, table.attitude])[known]
    if len(pose) < MIN_POSES:
        return [
            Fault(
                "no_poses",
                True,
                f"expected poses, found them in {len(pose)} of "
                f"{len(table.t)} rows; check the columns {', '.join(POSE_COLUMNS)}",
            )
        ]
    if len(pose) < MIN_GRID_ROWS:
        return []  # too few to judge
    faults = []
    # A measured column is never the same to the last digit; a simulated straight flight's may be.
    still = [
        name for name, values in zip(POSE_COLUMNS, pose.T, strict=True) if np.ptp(values) == 0.0
    ]
    if 0 < len(still) < len(POSE_COLUMNS) - 1 and not _flies_straight(pose):
        faults.append(
            Fault(
                "constant_column",
                True,
                f"{' and '.join(still)} {'changes' if len(still) == 1 else 'change'} never, but "
                "the aircraft turns: not recorded, or not filled in?",
            )
        )
    repeated = (np.diff(pose, axis=0) == 0.0).all(axis=1)
    share, longest = repeated.mean(), _longest_run(repeated)
    if longest > 0.1 * len(pose) and longest * np.median(np.diff(table.t)) > 1.0:
        faults.append(
            Fault(
                "frozen_poses",
                False,
                f"the pose stands still to the last digit for "
                f"{longest + 1} rows: the tracker lost the aircraft, or it stood on the ground; "
                "leave such rows nan or cut them off",
            )
        )
    elif share > LARGEST_REPEATED_SHARE:
        faults.append(
            Fault(
                "repeated_poses",
                False,
                f"{100 * share:.0f} % of the rows repeat the "
                "pose of the row before: poses are slower than rows; write nan where there is "
                "no new one",
            )
        )
    faults += _mixed_faults(table, table.t[known], pose[:, :3])
    return faults


def _flies_straight(pose: Array) -> bool:
    """Whether the path stays within a tenth of its length of a straight line."""
    path = pose[:, :3] - pose[:, :3].mean(axis=0)
    sizes = np.linalg.svd(path, compute_uv=False)
    return bool(sizes[1] < 0.1 * sizes[0])


def _longest_run(mask: Array) -> int:
    """Length of the longest run of True."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return int(np.diff(ends)[::2].max(initial=0))


def _mixed_faults(table: FlightTable, t: Array, p_world: Array) -> list[Fault]:
    """Rows of two aircraft in turn, or two flights one after the other."""
    lags = (1, 2, 3, 4)
    # Distance of each row from the four before. Of rows mixed from two aircraft, the nearest is of
    # the same one, and the row before often of the other.
    distances = np.stack(
        [np.linalg.norm(p_world[4:] - p_world[4 - lag : -lag], axis=1) for lag in lags]
    )
    nearest = distances.min(axis=0)
    leaps = distances[0] > 3.0 * np.maximum(nearest, np.median(nearest))
    if leaps.mean() > LARGEST_JUMP_SHARE:
        return [
            Fault(
                "two_aircraft",
                True,
                "the position leaps back and forth in "
                f"{100 * leaps.mean():.0f} % of the rows: rows of two aircraft are mixed up; write "
                "one file for each",
            )
        ]
    jump = _lasting_jump(t, p_world)
    if jump is not None:
        return [
            Fault(
                "two_flights",
                False,
                f"the path jumps by {jump[1]:.1f} m at {jump[0]:.1f} s and "
                "goes on from there: two flights, or two aircraft, in one file? cut it there",
            )
        ]
    return []


def _lasting_jump(t: Array, p_world: Array, side: int = 5) -> tuple[float, float] | None:
    """Time [s] and size [m] of the largest jump of the path, if it lasts and no gap excuses it."""
    middles = np.median(np.lib.stride_tricks.sliding_window_view(p_world, side, axis=0), axis=-1)
    moved = np.linalg.norm(middles[side:] - middles[:-side], axis=1)
    duration = t[side : side + len(moved)] - t[: len(moved)]
    usual = float(np.median(moved / duration))  # speed
    excess = moved - 3.0 * usual * duration
    worst = int(np.argmax(excess))
    noise = float(np.linalg.norm(difference_noise(p_world)))
    if excess[worst] < max(0.5, 6.0 * noise):
        return None
    return float(t[worst + side] - t[0]), float(moved[worst])


# Motion
# --------------------------------------------------------------------------------------------------


def _estimate_motion(t: Array, pose: Array) -> _Motion | None:
    """Smoothed motion of clean poses (K, 6) at times t (K,); None where too few, or all at rest."""
    if len(t) < MIN_GRID_ROWS // 2:
        return None
    half = max(HALF_SPAN_S, 2.5 * float(np.median(np.diff(t))))
    step = min(GRID_S * half / HALF_SPAN_S, t[-1] / MIN_GRID_ROWS)
    if t[-1] / step > MAX_GROWTH * (1000 + len(t)):
        return None  # a wrong time stamp
    value, slope = _local_lines(t, pose, step, half)
    # Once more on the grid: accelerations as slopes of velocities, and everything else as smooth.
    grid = np.arange(len(value)) * step
    both = np.concatenate([slope, value[:, 3:], value[:, 2:3]], axis=1)
    known_rows = np.isfinite(both).all(axis=1)
    if known_rows.sum() < MIN_GRID_ROWS:
        return None
    smooth, change = _local_lines(grid[known_rows], both[known_rows], step, half, len(grid))
    rows = np.isfinite(smooth).all(axis=1) & known_rows
    if rows.sum() < MIN_GRID_ROWS:
        return None
    speed = np.linalg.norm(np.where(rows[:, None], smooth[:, :3], 0.0), axis=1)
    rows &= speed > MOVING_SHARE * np.percentile(speed[rows], 75.0)
    if not rows.any():
        return None  # an aircraft at rest
    smooth, change = smooth[rows], change[rows]
    return _Motion(
        v_world=smooth[:, :3],
        a_world=change[:, :3],
        angles=smooth[:, 6:9],
        angle_rates=smooth[:, 3:6],
        height=smooth[:, 9],
        t=grid[rows],
    )


def _clean_poses(table: FlightTable) -> tuple[Array, Array]:
    """Times (K,) since the first row and poses (K, 6), unwrapped, without rows off their median."""
    known = table.has_pose
    t = table.t[known] - table.t[0]
    pose = np.column_stack([table.p_world, table.attitude])[known]
    pose[:, 3:] = np.unwrap(pose[:, 3:], axis=0)
    if len(t) < MIN_GRID_ROWS // 2:
        return t, pose
    # The middle of seven neighbours each, by sorting.
    padded = np.concatenate([pose[:3], pose, pose[-3:]])
    neighbours = np.stack([padded[i : len(padded) - 6 + i] for i in range(7)])
    neighbours.partition(3, axis=0)
    deviation = np.abs(pose - neighbours[3])
    usual = np.maximum(1.4826 * np.median(deviation, axis=0), difference_noise(pose))
    usual = np.maximum(usual, np.percentile(deviation, 75.0, axis=0))  # a fast, clean flight
    good = (deviation <= OUTLIER_SIGMAS * usual + 1e-9).all(axis=1)
    return t[good], pose[good]


def _local_lines(
    t: Array, y: Array, step: float, half: float, rows: int | None = None
) -> tuple[Array, Array]:
    """Weighted straight lines through the samples within `half` of each grid time.

    Args:
        t: (N,) [s], increasing from about zero, jittering and with gaps.
        y: (N, C).
        step: of the grid [s].
        half: half the span of a line [s]; weights fall to zero at its ends.
        rows: of the grid; None takes as many as t fills.

    Returns:
        value and slope (M, C) at the grid times, nan where the samples do not surround them.
    """
    rows = int(t[-1] / step + 1e-9) + 1 if rows is None else rows
    bin_of = np.minimum(np.rint(t / step).astype(np.int64), rows - 1)
    inside = t - bin_of * step  # time in the bin
    reach = round(half / step)
    offset = np.arange(-reach, reach + 1) * step
    weight = 1.0 - (offset / (half + step)) ** 2

    def bins(values: Array) -> Array:
        return np.bincount(bin_of, values, rows).astype(np.float64)

    def around(values: Array, power: int) -> Array:  # sum over bins of weight offset^power values
        kernel = (weight * offset**power)[::-1]
        return np.convolve(values, kernel, "full")[reach : reach + rows]

    ones = np.ones_like(t)
    count, first, second = bins(ones), bins(inside), bins(inside**2)
    s0 = around(count, 0)
    s1 = around(count, 1) + around(first, 0)
    s2 = around(count, 2) + 2.0 * around(first, 1) + around(second, 0)
    spread = s0 * s2 - s1 * s1
    usual = np.median(s0[s0 > 0.0])
    surrounded = (s0 > 0.3 * usual) & (np.abs(s1) < 0.3 * half * s0) & (spread > 1e-9 * s0**2)
    s0, s1, s2, spread = (np.where(surrounded, s, np.nan) for s in (s0, s1, s2, spread))
    value, slope = np.empty((rows, y.shape[1])), np.empty((rows, y.shape[1]))
    for column, samples in enumerate(y.T):
        total = bins(samples)
        sy, sty = around(total, 0), around(total, 1) + around(bins(inside * samples), 0)
        slope[:, column] = (s0 * sty - s1 * sy) / spread
        value[:, column] = (s2 * sy - s1 * sty) / spread
    return value, slope


# Kinematics
# --------------------------------------------------------------------------------------------------


def _consistency(motion: _Motion) -> dict[str, float]:
    """The five laws of the head of this file, each near 1 where it holds; nan: nothing to see."""
    v, a = motion.v_world, motion.a_world
    roll, pitch, yaw = motion.angles.T
    speed = np.linalg.norm(v, axis=1)
    level_squared = np.maximum(v[:, 0] ** 2 + v[:, 1] ** 2, 1e-6)
    course = np.arctan2(-v[:, 1], v[:, 0])
    course_rate = (v[:, 1] * a[:, 0] - v[:, 0] * a[:, 1]) / level_squared
    climb_angle = np.arcsin(np.clip(v[:, 2] / np.maximum(speed, 1e-6), -1.0, 1.0))
    turn, bank = speed * course_rate / GRAVITY, np.sin(roll) / np.maximum(np.cos(roll), 0.3)
    turns = max(np.sqrt(np.mean(turn**2)), np.sqrt(np.mean(bank**2))) > MIN_TURN
    # In body axes: lift is the specific force against the belly, alpha the angle of the air there.
    R_body_world = np.swapaxes(rotation_world_body(roll, pitch, yaw), 1, 2)
    u, _, w = np.einsum("nij,nj->in", R_body_world, v)
    force = np.einsum("nij,nj->in", R_body_world, a + np.array([0.0, 0.0, GRAVITY]))
    alpha = np.arctan2(w, np.maximum(u, 1e-6))
    lift = -force[2] / np.maximum(speed, 0.1) ** 2
    slow = np.column_stack([np.ones_like(speed), bank**2, speed])  # alpha that is not of the climb
    return {
        "course": float(np.cos(course - yaw).mean()),
        "turn": _correlation(turn, bank) if turns else np.nan,
        "climb": _correlation(_without(climb_angle, slow), _without(pitch, slow)),
        "lift": _correlation(lift - lift.mean(), alpha - alpha.mean()),
        "upright": float((np.cos(roll) * np.cos(pitch)).mean()),
        "turn_factor": float((turn @ bank) / max(bank @ bank, 1e-9)),
    }


def _correlation(a: Array, b: Array) -> float:
    """Correlation about zero, -1 to 1."""
    return float(a @ b) / math.sqrt(max(float(a @ a) * float(b @ b), 1e-30))


def _without(y: Array, regressors: Array) -> Array:
    """What linear regression on (N, C) regressors leaves of y (N,).

    By the normal equations of unit columns: ten times faster than by singular values of all rows.
    """
    unit = regressors / np.maximum(np.linalg.norm(regressors, axis=0), 1e-300)
    return np.asarray(y - unit @ np.linalg.lstsq(unit.T @ unit, unit.T @ y, rcond=1e-12)[0])


def _is_below(found: dict[str, float], limits: dict[str, float]) -> bool:
    """Whether one of the laws with a limit falls below it; one with nothing to see does not."""
    return any(found[law] < limit for law, limit in limits.items())


# Likely mistakes, each undone by a change of the motion
# --------------------------------------------------------------------------------------------------

Change = Callable[[_Motion], _Motion]


@dataclass(frozen=True)
class _Mistake:
    """A mistake in the axes, what undoes it, and its words."""

    kind: str
    undo: Change
    cause: str
    remedy: str


def _world(x: tuple[int, int, int], y: tuple[int, int, int], z: tuple[int, int, int]) -> Change:
    """Positions in new axes, rows of a matrix of 0 and 1."""
    R_new_old = np.array([x, y, z], np.float64)
    up = float(R_new_old[2, 2])  # zero where the height is in another column
    return lambda m: replace(
        m, v_world=m.v_world @ R_new_old.T, a_world=m.a_world @ R_new_old.T, height=up * m.height
    )


def _angles(order: tuple[int, int, int], signs: tuple[int, int, int], roll: float = 0.0) -> Change:
    """Angles in another order, then with other signs, then with a constant added to the roll."""
    columns, factor = list(order), np.array(signs, np.float64)
    return lambda m: replace(
        m,
        angles=m.angles[:, columns] * factor + np.array([roll, 0.0, 0.0]),
        angle_rates=m.angle_rates[:, columns] * factor,
    )


def _reverse_time(m: _Motion) -> _Motion:
    return replace(m, v_world=-m.v_world, angle_rates=-m.angle_rates)


_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_BACK, _RIGHT, _DOWN = (-1, 0, 0), (0, -1, 0), (0, 0, -1)
_TURNED = "positions and yaw do not start from the same axis, they differ by {} deg"
_TURN_BACK = (
    "yaw is zero along x and y is left of x: for a heading from north give x = north, y = -east"
)
_WORLD_MISTAKES = (
    _Mistake(
        "y_right",
        _world(_X, _RIGHT, _Z),
        "y seems to point right",
        "the kit's y is left: negate py",
    ),
    _Mistake(
        "z_down", _world(_X, _Y, _DOWN), "z seems to point down", "the kit's z is up: negate pz"
    ),
    _Mistake(
        "north_east_down",
        _world(_X, _RIGHT, _DOWN),
        "positions seem to be north, east, down",
        "the kit's y is left and z is up: negate py and pz",
    ),
    _Mistake("x_reversed", _world(_BACK, _Y, _Z), "x seems reversed", "negate px"),
    _Mistake("x_y_swapped", _world(_Y, _X, _Z), "px and py seem swapped", "swap the two columns"),
    _Mistake("x_z_swapped", _world(_Z, _Y, _X), "px and pz seem swapped", "swap the two columns"),
    _Mistake("y_z_swapped", _world(_X, _Z, _Y), "py and pz seem swapped", "swap the two columns"),
    _Mistake("turned_90", _world(_Y, _BACK, _Z), _TURNED.format(90), _TURN_BACK),
    _Mistake("turned_270", _world(_RIGHT, _X, _Z), _TURNED.format(-90), _TURN_BACK),
    _Mistake("turned_180", _world(_BACK, _RIGHT, _Z), _TURNED.format(180), _TURN_BACK),
)
_ATTITUDE_MISTAKES = (
    _Mistake(
        "roll_reversed",
        _angles((0, 1, 2), (-1, 1, 1)),
        "roll seems reversed",
        "it is positive right wing down: negate roll",
    ),
    _Mistake(
        "pitch_reversed",
        _angles((0, 1, 2), (1, -1, 1)),
        "pitch seems reversed",
        "it is positive nose up: negate pitch",
    ),
    _Mistake(
        "yaw_reversed",
        _angles((0, 1, 2), (1, 1, -1)),
        "yaw seems counter-clockwise",
        "it is positive nose right, clockwise from above: negate yaw",
    ),
    _Mistake(
        "forward_left_up",
        _angles((0, 1, 2), (1, -1, -1)),
        "pitch and yaw seem to be of body axes x forward, y left, z up (ROS)",
        "pitch is positive nose up and yaw nose right: negate both",
    ),
    _Mistake(
        "upside_down",
        _angles((0, 1, 2), (1, 1, 1), np.pi),
        "the aircraft seems to fly upside down",
        "roll is zero with the belly down: add or subtract pi",
    ),
    _Mistake(
        "roll_pitch_swapped",
        _angles((1, 0, 2), (1, 1, 1)),
        "roll and pitch seem swapped",
        "swap the two columns",
    ),
    _Mistake(
        "roll_yaw_swapped",
        _angles((2, 1, 0), (1, 1, 1)),
        "roll and yaw seem swapped",
        "swap the two columns",
    ),
    _Mistake(
        "pitch_yaw_swapped",
        _angles((0, 2, 1), (1, 1, 1)),
        "pitch and yaw seem swapped",
        "swap the two columns",
    ),
    _Mistake(
        "angles_rotated",
        _angles((2, 0, 1), (1, 1, 1)),
        "the angles seem to stand in the order pitch, yaw, roll",
        "the order is roll, pitch, yaw",
    ),
    _Mistake(
        "angles_backwards",
        _angles((1, 2, 0), (1, 1, 1)),
        "the angles seem to stand in the order yaw, roll, pitch",
        "the order is roll, pitch, yaw",
    ),
)
_TIME_MISTAKE = _Mistake(
    "time_reversed",
    _reverse_time,
    "the flight seems to run backwards in time",
    "reverse the order of the rows",
)
_MOST_ROWS = 800  # of the motion, evenly spread, to try mistakes on


def _motion_faults(table: FlightTable) -> list[Fault]:
    """Faults that need the motion: axes, angles, lengths, logged velocities, control inputs."""
    t, pose = _clean_poses(table)
    motion = _estimate_motion(t, pose)
    if motion is None:
        return []
    found = _consistency(motion)
    if not _is_below(found, LEAST):
        return [
            *_length_faults(table, found),
            *_logged_faults(table, motion),
            *_stick_faults(table, t, pose),
        ]
    for fault in (_degrees_fault(table), _quaternion_fault(table, motion)):
        if fault is not None:
            return [fault]
    mistakes, gain = _explain(motion, found)
    if gain > LIKELY_RISE:
        cause = " and ".join(mistake.cause for mistake in mistakes)
        remedy = "; ".join(dict.fromkeys(mistake.remedy for mistake in mistakes))
        kind = "+".join(mistake.kind for mistake in mistakes)
        return [
            Fault(
                kind,
                gain > CERTAIN_RISE,
                f"{cause}, since only then does the path follow from the attitude; {remedy}",
            )
        ]
    if found["course"] < INCONSISTENT_COURSE:
        return [
            Fault(
                "inconsistent",
                False,
                "path and attitude contradict each other: expected the velocity along the nose "
                "and turns to the side of the lower wing; check axes, signs and the order of "
                "the columns",
            )
        ]
    return _stick_faults(table, t, pose)


def _explain(motion: _Motion, found: dict[str, float]) -> tuple[tuple[_Mistake, ...], float]:
    """The mistake, or else the pair, whose undoing makes the motion obey the laws best, and by how
    much their sum rises; none and 0 if no mistake makes it good.
    """
    some = np.unique(np.linspace(0, len(motion.t) - 1, _MOST_ROWS).astype(int))
    motion = _Motion(*(values[some] for values in vars(motion).values()))
    before = _score(found, motion)
    singles = [(m,) for m in (*_WORLD_MISTAKES, *_ATTITUDE_MISTAKES, _TIME_MISTAKE)]
    pairs = list(itertools.product(_WORLD_MISTAKES, _ATTITUDE_MISTAKES))
    for choice in (singles, pairs):
        best: tuple[_Mistake, ...] = ()
        best_score = -np.inf
        for mistakes in choice:
            changed = motion
            for mistake in mistakes:
                changed = mistake.undo(changed)
            laws = _consistency(changed)
            if not _is_below(laws, LEAST) and (score := _score(laws, changed)) > best_score:
                best, best_score = mistakes, score
        if best:
            return best, float(best_score - before)
    return (), 0.0


def _score(found: dict[str, float], motion: _Motion) -> float:
    """How well the laws hold; the lift, then the height, separate a reversed pitch from z down."""
    laws = found["course"] + np.nan_to_num(found["turn"]) + found["upright"]
    return float(laws + found["climb"] + found["lift"] + 0.1 * np.sign(np.median(motion.height)))


def _degrees_fault(table: FlightTable) -> Fault | None:
    """Angles in degrees: the laws hold once they are converted."""
    for columns, words in (
        ([0, 1, 2], "roll, pitch and yaw"),
        ([0, 1], "roll and pitch"),
        ([2], "yaw"),
    ):
        largest = np.nanmax(np.abs(table.attitude[:, columns]))
        if largest <= 2.0 * np.pi:
            continue
        attitude = table.attitude.copy()
        attitude[:, columns] = np.radians(attitude[:, columns])
        motion = _estimate_motion(*_clean_poses(replace(table, attitude=attitude)))
        if motion is not None and not _is_below(_consistency(motion), LEAST):
            return Fault(
                "degrees",
                True,
                f"{words} reach {largest:.3g} and look like degrees; convert to radians",
            )
    return None


def _quaternion_fault(table: FlightTable, motion: _Motion) -> Fault | None:
    """Three numbers of a quaternion in place of angles: the nose they give follows the course.

    With q = (w, x, y, z), the nose's component along the first axis is 1 - 2 (y^2 + z^2) [Beard &
    McLain, appendix B]; it follows the cosine of the course from any level axis.
    """
    known = table.has_pose
    t, columns = table.t[known] - table.t[0], table.attitude[known]
    inside = (t >= motion.t[0]) & (t <= motion.t[-1])
    t, columns = t[inside], columns[inside]
    if np.percentile((columns**2).sum(axis=1), 95.0) > 1.02 or np.ptp(columns, axis=0).max() < 0.5:
        return None
    course = np.arctan2(-motion.v_world[:, 1], motion.v_world[:, 0])
    axes = np.column_stack(
        [np.ones_like(t), *(np.interp(t, motion.t, f(course)) for f in (np.cos, np.sin))]
    )
    first, second, third = columns.T
    for nose, order in (
        (1.0 - 2.0 * (second**2 + third**2), "x, y, z"),
        (2.0 * (first**2 + second**2) - 1.0, "w, x, y"),
    ):
        if np.var(nose) > 0.05 and np.var(_without(nose, axes)) < 0.2 * np.var(nose):
            return Fault(
                "quaternion",
                True,
                f"roll, pitch and yaw look like the components "
                f"{order} of a quaternion; convert it to angles in radians",
            )
    return None


def _length_faults(table: FlightTable, found: dict[str, float]) -> list[Fault]:
    """Positions in another unit: the coordinated turn gives the length of a metre."""
    if not found["turn"] > LEAST["turn"]:
        return []
    factor = found["turn_factor"]
    for unit, per_metre, certain in (
        ("millimetres", MILLIMETRES, True),
        ("centimetres", CENTIMETRES, True),
        ("feet", FEET, False),
    ):
        if per_metre / 1.7 < factor < 1.7 * per_metre:
            return [
                Fault(
                    "length_unit",
                    certain,
                    f"the path turns {factor:.3g} times too fast for its "
                    f"bank: positions look like {unit}; divide px, py and pz by {per_metre:.4g}",
                )
            ]
    if factor > 5.0 or factor < 0.2:
        return [
            Fault(
                "scale",
                False,
                f"the path turns at {factor:.3g} times the rate that goes with its "
                "bank; check the units of position and time",
            )
        ]
    return []


def _logged_faults(table: FlightTable, motion: _Motion) -> list[Fault]:
    """Logged velocities and body rates that contradict the poses."""
    rates = np.stack(
        body_rates(motion.angles[:, 0], motion.angles[:, 1], *motion.angle_rates.T), axis=1
    )
    faults = []
    for names, estimates, enough in (
        (("vx", "vy", "vz"), motion.v_world, 0.3),
        (("p", "q", "r"), rates, 0.1),
    ):
        for name, estimate in zip(names, estimates.T, strict=True):
            logged = table.extra.get(name)
            if logged is None or np.isfinite(logged).sum() < MIN_GRID_ROWS:
                continue
            known = np.isfinite(logged)
            values = np.interp(motion.t, table.t[known] - table.t[0], logged[known])
            estimate, values = estimate - estimate.mean(), values - values.mean()
            if min(np.std(estimate), np.std(values)) < enough:
                continue
            factor, fit = (
                (estimate @ values) / (estimate @ estimate),
                _correlation(estimate, values),
            )
            if fit < -0.7:
                faults.append(
                    Fault(
                        "logged_motion",
                        True,
                        f"{name} has the opposite sign of the motion "
                        f"of the poses; negate it, or leave the column out",
                    )
                )
            elif fit > 0.7 and 40.0 < factor < 80.0:
                faults.append(
                    Fault(
                        "logged_motion",
                        True,
                        f"{name} is {factor:.0f} times the motion of the "
                        "poses and looks like degrees; convert to radians",
                    )
                )
    return faults


# Control inputs
# --------------------------------------------------------------------------------------------------

_STICK_HALF_SPAN_S = 0.3  # shorter: control inputs change faster than paths turn
_DAMPING_S = 0.08  # M_q / (M_alpha V): 0.55 m at 7 m/s, and lengths go with speeds
_DELAYS_S = (0.0, 0.1, 0.2, 0.3)  # of the motion behind the command: radio, servo, inertia


def _stick_response(table: FlightTable, t: Array, pose: Array) -> Array:
    """Partial correlations (3, 3) of roll rate, angle of attack and sideslip with the commands.

    Slower than its rotational modes, in some tenths of a second, an aircraft is in balance
    [Beard & McLain, eqs. 5.10-5.12, without angular acceleration]: its roll rate follows the
    aileron, its angle of attack the elevator, its sideslip (to the left, positive here) the rudder.
    Each command, as late as fits it best, on the three responses, the other rates and the airspeed.
    Accelerations would say less: a damped roll has nearly none, and a delay changes their sign. All
    is smoothed alike: the commands are slopes of their integral as the rates are slopes of angles.

    Returns:
        A row for each response, a column for aileron, elevator, rudder; nan where a command hardly
        moved.
    """
    response = np.full((3, 3), np.nan)
    delayed = [_delayed_integral(table, t, delay) for delay in _DELAYS_S]
    half = max(_STICK_HALF_SPAN_S, 2.5 * float(np.median(np.diff(t))))
    step = GRID_S * half / HALF_SPAN_S
    value, slope = _local_lines(t, np.concatenate([pose, *delayed], axis=1), step, half)
    rows = np.asarray(np.isfinite(value).all(axis=1))
    speed = np.linalg.norm(np.where(rows[:, None], slope[:, :3], 0.0), axis=1)
    rows = rows & (speed > MOVING_SHARE * np.percentile(speed, 75.0))
    if rows.sum() * step < MIN_STICK_S:
        return response
    v_world, angle_rates, late = slope[rows, :3], slope[rows, 3:6], slope[rows, 6:]
    roll, pitch, yaw = value[rows, 3:6].T
    p, q, r = body_rates(roll, pitch, *angle_rates.T)
    R_body_world = np.swapaxes(rotation_world_body(roll, pitch, yaw), 1, 2)
    u, v, w = np.einsum("nij,nj->in", R_body_world, v_world)
    V = np.sqrt(u * u + v * v + w * w)
    damping = _DAMPING_S * q  # M_q q / V over M_alpha
    responses = np.column_stack([p / V, np.arctan2(w, u) + damping, -v / V])
    others = np.column_stack([np.ones_like(V), 1.0 / V**2, r / V])
    everything = np.concatenate([others, responses], axis=1)
    for stick in range(3):
        candidates = late[:, stick::3].T
        if np.std(candidates[0]) < 0.01:
            continue
        left = [np.var(_without(command, everything)) for command in candidates]
        command = candidates[int(np.argmin(left))]
        for axis in range(3):
            rivals = np.delete(everything, others.shape[1] + axis, axis=1)
            response[axis, stick] = _correlation(
                _without(command, rivals), _without(responses[:, axis], rivals)
            )
    return response


def _delayed_integral(table: FlightTable, t: Array, delay: float) -> Array:
    """Integral of aileron, elevator and rudder, held from row to row and so late, at times t."""
    when = table.t - table.t[0] + delay
    held = table.commands[:-1, 1:] * np.diff(when)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(held, axis=0)])
    return np.column_stack([np.interp(t, when, column) for column in integral.T])


def _stick_faults(table: FlightTable, t: Array, pose: Array) -> list[Fault]:
    """Commands that act on another axis, or to the other side, than their names say."""
    response = np.nan_to_num(_stick_response(table, t, pose))
    names = COMMAND_NAMES[1:]
    same = (0, 1, 2)
    gains = {}
    for order in itertools.permutations(same):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            changes = (order != same) + signs.count(-1.0)  # fewer are likelier
            undone = response[:, order] * np.array(signs)
            gains[order, signs] = _likeness(undone) - _likeness(response) - MIN_STICK_GAIN * changes
    order, signs = max(gains, key=lambda key: gains[key])
    if gains[order, signs] <= 0.0:
        return []
    faults = []
    if order != same:
        found = ", ".join(names[i] for i in order)
        faults.append(
            Fault(
                "sticks_swapped",
                False,
                "the commands seem swapped: roll, pitch and yaw "
                f"answer to the columns {found}; expected {', '.join(names)}",
            )
        )
    for i, does in enumerate(("right wing down", "nose up", "nose right")):
        if signs[i] < 0.0:
            name = names[order[i]]
            faults.append(
                Fault(
                    f"{name}_reversed",
                    False,
                    f"{name} seems reversed: expected positive "
                    f"{names[i]} = {does}, the motion shows the opposite; negate the column",
                )
            )
    return faults


def _likeness(response: Array) -> float:
    """How much a response matrix is an aircraft's: large on its diagonal, and the signs beside it.

    At a given roll rate the aileron also works against the dihedral effect (L_beta < 0), the rudder
    against the yaw due to roll (N_p < 0); half a weight, since not every aircraft has both.
    """
    return float(np.trace(response) + 0.5 * response[0, 2] - 0.5 * response[2, 0])
