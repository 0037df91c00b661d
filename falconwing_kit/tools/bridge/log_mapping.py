"""Log mapping: a TOML file -> which topics of a log hold poses and commands, and what they mean."""

from dataclasses import dataclass, replace
from pathlib import Path

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.files import short_name
from falconwing_kit.core.messages import COMMAND_NAMES
from falconwing_kit.tools.bridge.axes import BODIES, WORLDS


@dataclass(frozen=True)
class PoseMapping:
    """Table [pose] of a mapping file."""

    topic: str = ""
    field: str = ""  # where the pose stands in a message of another type: "state.pose"
    frame: str = ""  # child_frame_id of a transform among others
    world: str = ""  # "enu" (z up) or "ned" (z down)
    body: str = ""  # "flu" (x nose, y left, z up) or "frd" (x nose, y right, z belly)
    runway_deg: float = 0.0  # the kit's x axis from the log's, counter-clockwise seen from above
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the kit's world, in the log's


@dataclass(frozen=True)
class Channel:
    """Table [commands.NAME] of a mapping file: one stick in the message's own unit."""

    zero: float | None = None  # the number at command 0, 1500 for most pulses in us
    full: float | None = None  # at command 1: full throttle, right wing down, nose up, nose right
    field: str = ""  # where the number stands, if the message has a field for each stick: "roll"


@dataclass(frozen=True)
class CommandMapping:
    """Table [commands] of a mapping file."""

    topic: str = ""
    field: str = ""  # the array of numbers, if the message has several: "axes"
    channels: tuple[str, ...] = ()  # what each number is, in order; other names are left out
    throttle: Channel = Channel()
    aileron: Channel = Channel()
    elevator: Channel = Channel()
    rudder: Channel = Channel()


@dataclass(frozen=True)
class LogMapping:
    """What the topics of a log mean; the fields are the keys of the TOML file, all optional."""

    source: str = ""  # text in the table's column `source`
    pose: PoseMapping = PoseMapping()
    commands: CommandMapping = CommandMapping()


# Topics of the bags that the kit writes (bag.py), whose meaning is known without a file.
OWN_POSE, OWN_COMMAND = "/falconwing/pose", "/falconwing/command"


def complete_mapping(mapping: LogMapping, pose_topic: str, command_topic: str) -> LogMapping:
    """The mapping with what is known of the kit's own topics, where it leaves that open.

    Args:
        mapping: as given.
        pose_topic: the topic with the poses.
        command_topic: the topic with the commands.
    """
    pose, commands = mapping.pose, mapping.commands
    if pose_topic == OWN_POSE:
        pose = replace(pose, world=pose.world or "enu", body=pose.body or "flu")
    if command_topic == OWN_COMMAND and commands == CommandMapping(topic=commands.topic):
        full = Channel(0.0, 1.0)
        commands = CommandMapping(commands.topic, "axes", COMMAND_NAMES, full, full, full, full)
    return replace(mapping, pose=pose, commands=commands)


def read_mapping(path: str | Path) -> LogMapping:
    """Read a mapping file (TOML) and check its words.

    Raises:
        FileNotFoundError: there is no file.
        InputError: a key is unknown, or a value is of another type or no choice.
    """
    mapping = from_toml(LogMapping, path)
    name = short_name(path)
    for key, value, choices in (
        ("pose.world", mapping.pose.world, WORLDS),
        ("pose.body", mapping.pose.body, BODIES),
    ):
        if value and value not in choices:
            raise InputError(f"{name}: {key}: expected one of {', '.join(choices)}, got {value!r}")
    if "," in mapping.source or not mapping.source.isprintable():
        raise InputError(f"{name}: source: expected one line without commas, it is a table's cell")
    for stick in COMMAND_NAMES:
        channel = getattr(mapping.commands, stick)
        if channel.zero is not None and channel.zero == channel.full:
            raise InputError(
                f"{name}: commands.{stick}: expected different numbers for zero and full, got "
                f"{channel.zero:g} for both"
            )
    return mapping
