"""Autopilot log: ULog of PX4 or DataFlash of ArduPilot -> the flight table of a fixed-wing flight.

Poses are those of the autopilot's own estimator, in north-east-down axes. The kit's world is x
north, y west, z up, with its origin at the first pose, unless a mapping says otherwise. Commands
are what autopilot or pilot gave to the mixer, normalised: for PX4 the controls of roll, pitch, yaw
and thrust, for ArduPilot AETR, else the pulses of RCOU. A mapping file can name any other.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.tools.bridge import dataflash, ulog
from falconwing_kit.tools.bridge.autopilot_series import MAX_FILE_BYTES, NedPoses, Series
from falconwing_kit.tools.bridge.axes import LogAxes
from falconwing_kit.tools.bridge.log_mapping import Channel, CommandMapping, LogMapping
from falconwing_kit.tools.bridge.log_table import LogPoses, build_table
from falconwing_kit.tools.bridge.ros2_messages import Topic, increasing_messages, read_commands

Reader = Callable[[Path, Sequence[str]], tuple[dict[str, Series], list[str]]]
PoseReader = Callable[[str, Mapping[str, Series], list[str]], NedPoses]
KINDS: dict[bytes, tuple[Reader, PoseReader]] = {  # first bytes of a file -> its readers
    ulog.MAGIC: (ulog.read_ulog, ulog.ulog_poses),
    dataflash.MAGIC: (dataflash.read_dataflash, dataflash.dataflash_poses),
}
# Commands that are found without a mapping, the first that a log has: topic -> what it holds. The
# signs are the kit's: right wing down, nose up, nose right.
PLAIN, SURFACE, PERCENT = Channel(0.0, 1.0), Channel(0.0, 4500.0), Channel(0.0, 100.0)
COMMANDS = {
    ulog.CONTROLS: CommandMapping(
        field="control", channels=("aileron", "elevator", "rudder", "throttle"),
        throttle=PLAIN, aileron=PLAIN, elevator=PLAIN, rudder=PLAIN,
    ),
    dataflash.SURFACES: CommandMapping(
        throttle=replace(PERCENT, field="Thr"), aileron=replace(SURFACE, field="Ail"),
        elevator=replace(SURFACE, field="Elev"), rudder=replace(SURFACE, field="Rudd"),
    ),
    dataflash.OUTPUTS: CommandMapping(field="C"),
}  # fmt: skip


def is_autopilot_log(path: str | Path) -> bool:
    """Whether a file begins as a ULog or a DataFlash log does."""
    return Path(path).is_file() and _readers(Path(path)) is not None


def read_autopilot_log(
    path: str | Path, mapping: LogMapping | None = None, rate_hz: float | None = None
) -> FlightTable:
    """Read the flight of an autopilot's log.

    Args:
        path: a ULog (PX4) or a DataFlash log (ArduPilot, binary).
        mapping: commands of another topic, the runway's direction (x axis from north, to the west),
            the origin of the kit's world in north-east-down, a source; None for the defaults.
        rate_hz: rows per second, as in `ros2_log.read_ros2_log`; None for every pose.

    Returns:
        The flight, with the estimated velocities; time zero is its first row. Choices that were
        made, and what contradicts the laws of flight, are in its warnings.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the library that reads it is not installed, or the log has no such flight.
    """
    path, mapping = require_file(path), mapping or LogMapping()
    name, warnings = short_name(path), list[str]()
    readers = _readers(path)
    if readers is None or path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(
            f"{name}: expected a log of PX4 (ULog) or ArduPilot (DataFlash, binary) of at most "
            f"{MAX_FILE_BYTES >> 20} MiB, got another file"
        )
    _require_ned(name, mapping)
    read, read_poses = readers
    given = mapping.commands.topic
    series, known = read(path, [given] if given else [])
    poses = read_poses(name, series, warnings)
    t_command, commands = _read_commands(name, mapping.commands, series, known, warnings)
    every = np.column_stack([poses.p_ned, poses.v_ned, poses.R_ned_body.reshape(-1, 9)])
    t, every = increasing_messages(name, "poses", poses.t, every, warnings)
    p_ned = every[:, :3]
    measured = np.flatnonzero(np.isfinite(p_ned).all(axis=1))
    if len(measured) < 2:
        raise InputError(f"{name}: expected valid poses, got none; was the position ever known?")

    def choose_axes(t: Array, p_log: Array, R_log_body: Array) -> LogAxes:
        origin = mapping.pose.origin_m
        if not any(origin):
            x, y, z = p_log[np.isfinite(p_log).all(axis=1)][0].tolist()
            origin = (x, y, z)
            warnings.append(
                "world: x north, y west, z up, origin at the first pose"
                + (
                    f", turned by {mapping.pose.runway_deg:g} deg"
                    if mapping.pose.runway_deg
                    else ""
                )
            )
        return LogAxes("ned", "frd", mapping.pose.runway_deg, origin)

    return build_table(
        name,
        mapping.source or path.stem,
        LogPoses(t, p_ned, every[:, 6:].reshape(-1, 3, 3), every[:, 3:6]),
        t_command,
        commands,
        choose_axes,
        rate_hz,
        warnings,
    )


def _readers(path: Path) -> tuple[Reader, PoseReader] | None:
    with path.open("rb") as file:
        head = file.read(8)
    return next((readers for magic, readers in KINDS.items() if head.startswith(magic)), None)


def _require_ned(name: str, mapping: LogMapping) -> None:
    """Refuse a mapping whose poses cannot be meant for an autopilot's log."""
    pose = mapping.pose
    if pose.topic or pose.field or pose.frame:
        raise InputError(
            f"{name}: pose.topic: expected none, for the poses of an autopilot's log are those of "
            "its estimator; leave topic, field and frame out"
        )
    if (pose.world or "ned", pose.body or "frd") != ("ned", "frd"):
        raise InputError(
            f"{name}: pose.world: expected ned and body frd, which an autopilot's log always has, "
            f"got {pose.world or 'ned'} and {pose.body or 'frd'}; leave them out"
        )


def _read_commands(
    name: str,
    mapping: CommandMapping,
    series: Mapping[str, Series],
    known: Sequence[str],
    warnings: list[str],
) -> tuple[Any, Array]:
    """Times (M,) [ns] and commands (M, 4) of the mapping's topic, or of the first of COMMANDS."""
    topic = mapping.topic or next((t for t in COMMANDS if t in series and len(series[t].t)), "")
    if topic not in series or not len(series[topic].t):
        what = f"no message of {topic}" if topic else f"none of {', '.join(COMMANDS)}"
        raise InputError(
            f"{name}: commands.topic: expected commands, got {what}; the log defines "
            f"{', '.join(known[:60])}; write the topic into a mapping file (TOML) and give "
            "--mapping"
        )
    if topic in COMMANDS and mapping == CommandMapping(topic=mapping.topic):
        mapping = replace(COMMANDS[topic], topic=topic)
        warnings.append(f"commands of {topic}, as given to the mixer")
    messages = _messages(series[topic])
    described = Topic(topic, topic, "", "", "", len(messages))
    return read_commands(name, described, mapping, messages, warnings)


def _messages(series: Series) -> list[tuple[int, dict[str, Any]]]:
    """Messages with their times [ns]: single fields as numbers, "control[0]" and on as arrays."""
    arrays: dict[str, dict[int, Any]] = {}
    for key, values in series.columns.items():
        if indexed := re.fullmatch(r"(.+)\[(\d+)\]", key):
            arrays.setdefault(indexed[1], {})[int(indexed[2])] = values
    stacked = {
        key: np.column_stack([columns[i] for i in sorted(columns)]).astype(np.float64)
        for key, columns in arrays.items()
    }
    numbers = {
        key: np.asarray(values, np.float64)
        for key, values in series.columns.items()
        if np.asarray(values).dtype.kind in "iufb"
    }
    return [
        (
            int(t),
            {key: float(values[row]) for key, values in numbers.items()}
            | {key: values[row] for key, values in stacked.items()},
        )
        for row, t in enumerate(series.t)
    ]
