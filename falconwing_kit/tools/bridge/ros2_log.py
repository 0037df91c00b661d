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

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_log import read_mcap_records
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.tools.bridge.axes import (
    CLEARLY,
    LogAxes,
    find_axes,
    rotations,
    sideways_residuals,
)
from falconwing_kit.tools.bridge.cdr import Definition, decode, parse_definition, short_type
from falconwing_kit.tools.bridge.log_mapping import LogMapping, PoseMapping, complete_mapping
from falconwing_kit.tools.bridge.log_table import LogPoses, build_table
from falconwing_kit.tools.bridge.ros2_messages import (
    COMMANDS,
    POSES,
    Topic,
    read_commands,
    read_poses,
)


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
    poses = LogPoses(t_pose, p_log, rotations(quaternions))

    def choose_axes(t: Array, p_log: Array, R_log_body: Array) -> LogAxes:
        return _axes(mapping.pose, t, p_log, R_log_body, warnings)

    source = mapping.source or Path(path).stem
    return build_table(name, source, poses, t_command, commands, choose_axes, rate_hz, warnings)


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
