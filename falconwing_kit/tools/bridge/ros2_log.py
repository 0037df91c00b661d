"""ROS 2 log: an MCAP file of ROS 2 messages, and what its topics mean -> a flight table.

Two topics make a flight: one with poses (motion capture, odometry, a transform) and one with the
pilot's or autopilot's commands (pulse widths, axes of a joystick). A mapping file names them and
says which number is which stick; whatever it leaves out is found from the log itself where only one
answer is possible, and every such guess is in the table's warnings.

A row is one pose message as it was measured: no pose is smoothed or interpolated. Its time is the
message's own stamp; its commands lie on the lines between the messages of the sticks, which come
less often and would be late if they were held.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_log import read_mcap_records
from falconwing_kit.core.flight_table import LABEL_COLUMN, FlightTable, interpolate_readings
from falconwing_kit.tools.bridge.axes import (
    CLEARLY,
    SURE_CORRELATION,
    LogAxes,
    find_axes,
    nose_along_velocity,
    rotations,
    sideways_residuals,
    stick_correlations,
    to_kit_poses,
)
from falconwing_kit.tools.bridge.cdr import Definition, decode, parse_definition, short_type
from falconwing_kit.tools.bridge.log_mapping import LogMapping, PoseMapping, complete_mapping
from falconwing_kit.tools.bridge.ros2_messages import (
    COMMANDS,
    POSES,
    Topic,
    read_commands,
    read_poses,
)

DECIMALS = 6  # of seconds, metres and radians in the table: finer than any motion capture


def is_ros_log(path: str | Path) -> bool:
    """Whether an MCAP file, or a folder of such files, holds messages of ROS and not the kit's."""
    from mcap.records import Channel as McapChannel

    encodings = (
        record.message_encoding
        for file in _files(path)
        for record in read_mcap_records(file, [])
        if isinstance(record, McapChannel)
    )
    return next(encodings, "") in ("cdr", "ros1")


def read_topics(path: str | Path) -> tuple[Topic, ...]:
    """The topics of an MCAP file, or of a recording that is a folder of such files, by name.

    Raises:
        FileNotFoundError: there is no file.
        InputError: a file is not MCAP.
    """
    from mcap.records import Channel as McapChannel
    from mcap.records import Message, Schema

    found: dict[str, Topic] = {}
    counts: dict[str, int] = {}
    for file in _files(path):
        schemas: dict[int, Any] = {}
        channels: dict[int, str] = {}
        for record in read_mcap_records(file, []):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, McapChannel):
                schema = schemas.get(record.schema_id)
                channels[record.id] = record.topic
                found[record.topic] = Topic(
                    record.topic,
                    short_type(schema.name) if schema else "a type without definition",
                    record.message_encoding,
                    schema.encoding if schema else "",
                    schema.data.decode("utf-8", "replace") if schema else "",
                    0,
                )
            elif isinstance(record, Message) and record.channel_id in channels:
                topic = channels[record.channel_id]
                counts[topic] = counts.get(topic, 0) + 1
    return tuple(
        replace(topic, messages=counts.get(name, 0)) for name, topic in sorted(found.items())
    )


def read_ros2_log(
    path: str | Path, mapping: LogMapping | None = None, rate_hz: float | None = None
) -> FlightTable:
    """Read a flight from a log of ROS 2 messages.

    Args:
        path: an MCAP file, complete or interrupted, or the folder of a recording of several.
        mapping: which topics and channels mean what; None finds everything in the log.
        rate_hz: rows per second: the pose nearest to each time of an even grid, with its own time
            stamp, without a pose where none is within half a period. None for every pose.

    Returns:
        The flight; time zero is its first pose. Guesses, and what contradicts the laws of flight,
        are in its warnings.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the log is not of this kind, or the mapping lacks what it cannot show; the text
            lists the topics found.
    """
    mapping = LogMapping() if mapping is None else mapping
    name, warnings = short_name(path), list[str]()
    topics = read_topics(path)
    pose_topic = _choose_topic(name, topics, "pose", mapping.pose.topic, tuple(POSES))
    command_topic = _choose_topic(name, topics, "commands", mapping.commands.topic, COMMANDS)
    mapping = complete_mapping(mapping, pose_topic.name, command_topic.name)
    wanted = {topic.name: _definition(name, topic) for topic in (pose_topic, command_topic)}
    messages = _read_messages(path, wanted, warnings)

    t_pose, p_log, quaternions = read_poses(
        name, pose_topic, mapping.pose, messages[pose_topic.name], warnings
    )
    t_command, commands = read_commands(
        name, command_topic, mapping.commands, messages[command_topic.name], warnings
    )
    t, t_command = (t_pose - t_pose[0]) * 1e-9, (t_command - t_pose[0]) * 1e-9
    if rate_hz is not None:
        t, p_log, quaternions = _nearest_to_grid(name, t, p_log, quaternions, rate_hz)
    rows = t >= t_command[0]
    if not rows.any():
        raise InputError(
            f"{name}: expected poses after the first command, got none: the poses of "
            f"{pose_topic.name} end {t_command[0] - t[-1]:.1f} s before the commands of "
            f"{command_topic.name} begin"
        )
    if not rows.all():
        warnings.append(f"poses before the first command, left out: {(~rows).sum()}")
    commands = interpolate_readings(t[rows], t_command, commands)
    t, p_log = t[rows] - t[rows][0], p_log[rows]

    R_log_body = rotations(quaternions[rows])
    axes = _axes(mapping.pose, t, p_log, R_log_body, warnings)
    p_world, attitude = to_kit_poses(p_log, R_log_body, axes)
    _compare_with_laws(t, p_world, attitude, commands, warnings)
    unmeasured = ~np.isfinite(p_log).all(axis=1)
    attitude[unmeasured] = np.nan
    return FlightTable(
        name=name,
        t=np.round(t, DECIMALS),
        p_world=np.round(p_world, DECIMALS),
        attitude=np.round(attitude, DECIMALS),
        commands=np.round(commands, DECIMALS),
        labels={LABEL_COLUMN: (mapping.source or Path(path).stem.replace(",", " "),) * len(t)},
        warnings=tuple(f"{name}: {sentence}" for sentence in warnings),
    )


# ---- The file: topics and messages


def _files(path: str | Path) -> list[Path]:
    """The MCAP files of a recording: the path itself, or those of a folder in order of name."""
    path = Path(path)
    if not path.is_dir():
        return [path]
    files = sorted(path.glob("*.mcap"))
    if not files:
        raise FileNotFoundError(
            f"{path}: expected a log (MCAP) or a folder with one, got a folder without; "
            "`ros2 bag convert` makes MCAP from a recording in SQLite"
        )
    return files


def _choose_topic(
    name: str, topics: Sequence[Topic], table: str, given: str, types: Sequence[str]
) -> Topic:
    """The topic that the mapping names, or the only one of these types."""
    listed = ", ".join(f"{t.name} ({t.type}, {t.messages} messages)" for t in topics) or "no topic"
    if given:
        for topic in topics:
            if topic.name == given:
                return topic
        raise InputError(f"{name}: {table}.topic: expected a topic of the log, got {given!r}; "
                         f"it has {listed}")  # fmt: skip
    # A topic of transforms is used only where nothing else has poses.
    for group in ([k for k in types if k != "tf2_msgs/TFMessage"], ["tf2_msgs/TFMessage"]):
        candidates = [t for t in topics if t.type in group and t.messages]
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            break
    what = "several topics" if candidates else "no topic"
    raise InputError(
        f"{name}: {table}.topic: expected the name of a topic, for {what} of this log could be "
        f"it; it has {listed}; write it into a mapping file (TOML) and give --mapping"
    )


def _definition(name: str, topic: Topic) -> Definition:
    if topic.encoding != "cdr" or topic.definition_encoding != "ros2msg":
        raise InputError(
            f"{name}: {topic.name}: expected messages of ROS 2 (cdr, defined as ros2msg), got "
            f"{topic.encoding or 'none'} defined as {topic.definition_encoding or 'nothing'}"
        )
    return parse_definition(topic.type, topic.definition_text)


def _read_messages(
    path: str | Path, wanted: Mapping[str, Definition], warnings: list[str]
) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """The messages of the wanted topics, each with the time of its arrival [ns]."""
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {topic: [] for topic in wanted}
    unreadable = 0
    for topic, message in _raw_messages(path, warnings):
        if topic in wanted:
            try:
                decoded = decode(wanted[topic], message.data)
            except InputError:
                unreadable += 1
                continue
            found[topic].append((message.log_time, decoded))
    for topic, messages in found.items():
        if not messages:
            raise InputError(
                f"{short_name(path)}: {topic}: expected messages of {wanted[topic].name}, got none "
                f"that can be read and {unreadable} that cannot"
            )
    if unreadable:
        warnings.append(f"messages that do not fit their definition, left out: {unreadable}")
    return found


def _raw_messages(path: str | Path, warnings: list[str]) -> Iterator[tuple[str, Any]]:
    from mcap.records import Channel as McapChannel
    from mcap.records import Message

    for file in _files(path):
        channels: dict[int, str] = {}
        for record in read_mcap_records(file, warnings):
            if isinstance(record, McapChannel):
                channels[record.id] = record.topic
            elif isinstance(record, Message) and record.channel_id in channels:
                yield channels[record.channel_id], record


def _nearest_to_grid(
    name: str, t: Array, p_log: Array, quaternions: Array, rate_hz: float
) -> tuple[Array, Array, Array]:
    """The pose nearest to each time of an even grid; a row without a pose where none is near."""
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
    empty = row < 0
    times = np.where(empty, t[0] + np.arange(cells) / rate_hz, t[row])
    positions = np.where(empty[:, None], np.nan, p_log[row])
    return times, positions, quaternions[row]


def _axes(
    mapping: PoseMapping, t: Array, p_log: Array, R_log_body: Array, warnings: list[str]
) -> LogAxes:
    """The axes of the mapping; what it leaves out is found from the flight."""
    world, body = mapping.world, mapping.body
    if not (world and body):
        (world, body), clear = find_axes(t, p_log, R_log_body, world, body)
        how = "the one pair that obeys the law of flight" if clear else "by the convention of ROS"
        warnings.append(
            f"axes not given, taken as world {world}, body {body}, {how}; "
            "write pose.world and pose.body into the mapping"
        )
    else:
        residuals = sideways_residuals(t, p_log, R_log_body)
        if residuals:
            best = min(residuals, key=lambda pair: residuals[pair])
            if residuals[world, body] > CLEARLY * residuals[best]:
                warnings.append(
                    f"axes given as world {world}, body {body} contradict the law of flight (lift "
                    f"in the plane of symmetry); world {best[0]}, body {best[1]} would obey it"
                )
    return LogAxes(world, body, mapping.runway_deg, mapping.origin_m)


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
