"""ULog: a log of PX4 -> its series, and the poses of its estimator.

The library pyulog (BSD-3-Clause) of the extra `logs` reads the file [format:
https://docs.px4.io/main/en/dev_log/ulog_file_format]. Positions are those of
vehicle_local_position, attitudes those of vehicle_attitude at the same times.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.tools.bridge.autopilot_series import (
    MAX_TIME_US,
    NedPoses,
    Series,
    import_reader,
    increasing,
    quiet,
    stack,
)
from falconwing_kit.tools.bridge.axes import rotations

MAGIC = b"ULog\x01\x12\x35"
POSITION, ATTITUDE = "vehicle_local_position", "vehicle_attitude"
TORQUE, THRUST, CONTROLS = "vehicle_torque_setpoint", "vehicle_thrust_setpoint", "actuator_controls"
OLD_CONTROLS = "actuator_controls_0"  # until PX4 1.13
TOPICS = (POSITION, ATTITUDE, TORQUE, THRUST, OLD_CONTROLS)
Nanoseconds = NDArray[np.int64]
MAX_GAP = 2.5  # usual steps between two attitudes; no pose in a longer one


def read_ulog(path: Path, wanted: Sequence[str]) -> tuple[dict[str, Series], list[str]]:
    """The series of TOPICS and of the wanted topics, and the names of all topics in the log.

    A second instance of a topic is named "TOPIC:1". The controls of all axes are also given as
    CONTROLS, in the order roll, pitch, yaw, thrust, in whichever form the log has them.

    Raises:
        InputError: pyulog is not installed, or the file is damaged in a way it cannot read.
    """
    reader = import_reader("pyulog.core", "ULog")
    names = [*TOPICS, *(name.partition(":")[0] for name in wanted)]
    try:
        with quiet():
            log = reader.ULog(str(path), names)
            known = sorted(log.message_formats)
            found = {_name(data): _series(data.data) for data in log.data_list}
    except Exception as error:  # whatever its parser meets in a damaged file
        raise InputError(
            f"{short_name(path)}: expected a ULog that pyulog can read, got "
            f"{type(error).__name__}: {str(error)[:80]}; the log is damaged"
        ) from None
    if controls := _controls(found):
        found[CONTROLS] = controls
    return found, known


def ulog_poses(name: str, series: Mapping[str, Series], warnings: list[str]) -> NedPoses:
    """The poses of the estimator: one for each local position, with the attitude at its time.

    Raises:
        InputError: the log has no position or no attitude.
    """
    for topic in (POSITION, ATTITUDE):
        if topic not in series or len(series[topic].t) < 2:
            raise InputError(
                f"{name}: expected the poses of a flight in {POSITION} and {ATTITUDE}, got no "
                f"{topic}; log it (SDLOG_PROFILE)"
            )
    position, attitude = series[POSITION], series[ATTITUDE]
    p_ned = stack(name, POSITION, position, ("x", "y", "z"))
    v_ned = stack(name, POSITION, position, ("vx", "vy", "vz"))
    valid = [position.columns[f] for f in ("xy_valid", "z_valid") if f in position.columns]
    for flag in valid:
        p_ned = np.where(np.asarray(flag)[:, None] > 0, p_ned, np.nan)
    resets = sum(
        int(np.count_nonzero(np.diff(position.columns[f].astype(np.int64))))
        for f in ("xy_reset_counter", "z_reset_counter")
        if f in position.columns
    )
    if resets:
        warnings.append(
            f"jumps of the estimated position: {resets}; cut the flight there with --begin, --end"
        )
    quaternions = stack(name, ATTITUDE, attitude, ("q[1]", "q[2]", "q[3]", "q[0]"))
    t, t_attitude = _times(position), _times(attitude)
    quaternions, known = _interpolate(t, t_attitude, quaternions)
    p_ned[~known] = np.nan
    return NedPoses(t, p_ned, rotations(quaternions), v_ned)


def _interpolate(
    t: Nanoseconds, t_attitude: Nanoseconds, quaternions: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Unit quaternions x, y, z, w at other times, on the great arcs between; which are known."""
    from scipy.spatial.transform import Rotation, Slerp

    length = np.linalg.norm(quaternions, axis=1)
    good = np.isfinite(length) & (np.abs(length - 1.0) < 0.01)
    good &= np.diff(t_attitude, prepend=t_attitude[0] - 1) > 0
    t_attitude, quaternions = t_attitude[good], quaternions[good]
    if len(t_attitude) < 2 or (np.diff(t_attitude) <= 0).any():
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1)), np.zeros(len(t), bool)
    inside = (t >= t_attitude[0]) & (t <= t_attitude[-1])
    after = np.clip(np.searchsorted(t_attitude, t), 1, len(t_attitude) - 1)
    step = t_attitude[after] - t_attitude[after - 1]
    known = inside & (step <= MAX_GAP * np.median(np.diff(t_attitude)))
    # Times in a float64: relative to the first, so that nothing is rounded.
    zero = t_attitude[0]
    slerp = Slerp((t_attitude - zero).astype(np.float64), Rotation.from_quat(quaternions))
    clipped = np.clip(t, t_attitude[0], t_attitude[-1]) - zero
    return slerp(clipped.astype(np.float64)).as_quat(), known


def _times(series: Series) -> Nanoseconds:
    """Times at which the data were sampled, or else published [ns]."""
    sampled = series.columns.get("timestamp_sample")
    if sampled is not None and (sampled > 0).all() and (sampled < MAX_TIME_US).all():
        return np.asarray(sampled, np.int64) * 1000
    return series.t


def _controls(found: Mapping[str, Series]) -> Series | None:
    """Roll, pitch, yaw and thrust as one array of four, from the log's form of them."""
    if TORQUE in found and THRUST in found and len(found[THRUST].t):
        torque, thrust = found[TORQUE], found[THRUST]
        row = np.clip(np.searchsorted(thrust.t, torque.t, side="right") - 1, 0, None)
        axes = [f"xyz[{i}]" for i in range(3)]
        if "xyz[0]" not in thrust.columns or not set(axes) <= torque.columns.keys():
            return None
        columns = [*(torque.columns[axis] for axis in axes), thrust.columns["xyz[0]"][row]]
        return Series(torque.t, {f"control[{i}]": column for i, column in enumerate(columns)})
    return found.get(OLD_CONTROLS)


def _name(data: Any) -> str:
    return f"{data.name}:{data.multi_id}" if data.multi_id else str(data.name)


def _series(data: Mapping[str, np.ndarray]) -> Series:
    return increasing(data["timestamp"], data)
