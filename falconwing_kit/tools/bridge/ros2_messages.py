"""ROS 2 messages: decoded messages of a topic -> poses in the log's axes, or commands."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import COMMAND_NAMES
from falconwing_kit.tools.bridge.log_mapping import Channel, CommandMapping, PoseMapping

# Message types with a pose -> where it stands in the message.
POSES = {
    "geometry_msgs/PoseStamped": "pose",
    "geometry_msgs/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/Odometry": "pose.pose",
    "geometry_msgs/TransformStamped": "transform",
    "geometry_msgs/Pose": "",
    "tf2_msgs/TFMessage": "transforms",  # a list: the mapping's `frame` chooses
}
# Message types with commands that are found without a mapping; a mapping may name any other.
COMMANDS = (
    "std_msgs/UInt16MultiArray", "std_msgs/Int16MultiArray", "std_msgs/Float32MultiArray",
    "std_msgs/Float64MultiArray", "sensor_msgs/Joy", "mavros_msgs/RCIn", "mavros_msgs/RCOut",
)  # fmt: skip
USUAL_ORDER = ("aileron", "elevator", "throttle", "rudder")  # of most radios' channels
PULSE_US = (800.0, 2200.0)  # numbers in this range are pulse widths
# The number at command 0 and at command 1, where the mapping does not give them.
PULSE_ENDS = {"throttle": (1000.0, 2000.0), "other": (1500.0, 2000.0)}
ROUNDING = 1e-6  # of a command; less beyond its range is not reported
MAX_CLOCK_DIFFERENCE_S = 0.5  # between a message's stamp and its arrival; beyond, another clock
MAX_COORDINATE = 1e8  # [m]; more than once around the earth
MAX_UNIT_ERROR = 1e-2  # of a quaternion's length; a lost target often gives zeros
# Decoded messages, each with the time of its arrival [ns].
Messages = Sequence[tuple[int, Mapping[str, Any]]]
# Times since 1970 (N,) [ns]; as seconds in a float64 they would be rounded to 0.2 microseconds.
Nanoseconds = NDArray[np.int64]


@dataclass(frozen=True)
class Topic:
    """A topic of a log."""

    name: str
    type: str  # "geometry_msgs/PoseStamped"
    encoding: str  # of its messages, "cdr"
    definition_encoding: str  # "ros2msg"
    definition_text: str
    messages: int


def read_poses(
    name: str,
    topic: Topic,
    mapping: PoseMapping,
    messages: Messages,
    warnings: list[str],
) -> tuple[Nanoseconds, Array, Array]:
    """Times (N,), positions (N, 3) and unit quaternions (N, 4) in the log's axes; nan if lost."""
    place = mapping.field or POSES.get(topic.type)
    if place is None:
        raise InputError(
            f"{name}: pose.field: expected where {topic.type} has its pose, such as state.pose, "
            f"for it is none of {', '.join(POSES)}; it has {_field_list(messages[0][1])}"
        )
    if isinstance(_find(messages[0][1], place), list):
        messages = _transforms_of(name, topic, messages, place, mapping.frame)
        place = "transform"
    elif mapping.frame:
        messages = [m for m in messages if m[1].get("child_frame_id") == mapping.frame]
        if not messages:
            raise InputError(f"{name}: pose.frame: expected a frame of {topic.name}, got "
                             f"{mapping.frame!r}, which it does not have")  # fmt: skip
    rows = []
    for _, message in messages:
        pose = _find(message, place)
        vector, turn = _find(pose, "position"), _find(pose, "orientation")
        if vector is None:
            vector, turn = _find(pose, "translation"), _find(pose, "rotation")
        try:
            rows.append([vector[k] for k in "xyz"] + [turn[k] for k in "xyzw"])
        except (KeyError, TypeError):
            raise InputError(
                f"{name}: {topic.name}: expected position and orientation at {place or 'its top'}, "
                f"got {_field_list(pose if isinstance(pose, dict) else message)}"
            ) from None
    values = np.array(rows, dtype=np.float64)
    t, values = increasing_messages(
        name, topic.name, message_times(topic, messages, warnings), values, warnings
    )
    return t, *_usable_poses(name, topic.name, values, warnings)


def _usable_poses(name: str, topic: str, values: Array, warnings: list[str]) -> tuple[Array, Array]:
    """Positions and normalised quaternions; nan where the tracking was lost."""
    # A damaged or invalid number would overflow below: nan, like a lost target.
    values = np.where((np.abs(values) < MAX_COORDINATE).all(axis=1, keepdims=True), values, np.nan)
    p_log, quaternions = values[:, :3].copy(), values[:, 3:].copy()
    lost = ~(np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < MAX_UNIT_ERROR)
    repeated = np.concatenate([[False], (np.diff(values, axis=0) == 0.0).all(axis=1)])
    if lost.any():
        warnings.append(f"poses without a unit quaternion, taken as no pose: {lost.sum()}")
    if (repeated & ~lost).any():
        warnings.append(
            "poses equal to the one before to the last bit, which no measurement is, taken as no "
            f"pose: {(repeated & ~lost).sum()}"
        )
    if (lost | repeated).all():
        raise InputError(f"{name}: {topic}: expected poses that change, got none")
    p_log[lost | repeated] = np.nan
    quaternions[lost] = [0.0, 0.0, 0.0, 1.0]
    return p_log, quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def _transforms_of(name: str, topic: Topic, messages: Messages, place: str, frame: str) -> Messages:
    """The transforms of one frame, out of messages with lists of transforms."""
    every = [(t, each) for t, message in messages for each in _find(message, place)]
    frames = sorted({str(_find(each, "child_frame_id")) for _, each in every})
    if not frame and len(frames) == 1:
        frame = frames[0]
    chosen = [(t, each) for t, each in every if _find(each, "child_frame_id") == frame]
    if not chosen:
        raise InputError(
            f"{name}: pose.frame: expected one of the frames of {topic.name}, "
            f"{', '.join(frames[:12]) or 'which has none'}, got {frame or 'none'!r}"
        )
    return chosen


def increasing_messages(
    name: str, topic: str, t: Nanoseconds, values: Array, warnings: list[str]
) -> tuple[Nanoseconds, Array]:
    """The messages whose time is later than that of every one before."""
    latest = np.maximum.accumulate(t)
    later = np.concatenate([[True], t[1:] > latest[:-1]])
    if (~later).sum() > max(3, len(t) // 100):
        raise InputError(
            f"{name}: {topic}: expected time to increase from message to message, got "
            f"{(~later).sum()} of {len(t)} that stand still or go back; are several robots or "
            "recordings in one topic?"
        )
    if not later.all():
        warnings.append(f"{topic}: messages whose time does not increase: {(~later).sum()}")
    return t[later], values[later]


def read_commands(
    name: str,
    topic: Topic,
    mapping: CommandMapping,
    messages: Messages,
    warnings: list[str],
) -> tuple[Nanoseconds, Array]:
    """Times (M,) and commands (M, 4), clipped to their ranges."""
    numbers = _stick_numbers(name, topic, mapping, messages, warnings)
    t = message_times(topic, messages, warnings)
    table = np.column_stack([numbers.get(stick, np.zeros(len(t))) for stick in COMMAND_NAMES])
    finite = np.isfinite(table).all(axis=1)
    if not finite.any():
        raise InputError(f"{name}: {topic.name}: expected finite numbers, got none")
    if not finite.all():
        warnings.append(f"{topic.name}: messages with a number that is not finite, left out: "
                        f"{(~finite).sum()}")  # fmt: skip
    t, table = increasing_messages(name, topic.name, t[finite], table[finite], warnings)
    commands = np.zeros_like(table)
    for column, stick in enumerate(COMMAND_NAMES):
        if stick not in numbers:
            warnings.append(f"no channel is the {stick}; taken as 0")
            continue
        zero, full = _ends(stick, getattr(mapping, stick), table[:, column], warnings)
        values = (table[:, column] - zero) / (full - zero)
        low = 0.0 if stick == "throttle" else -1.0
        beyond = (values < low - 0.1) | (values > 1.1)
        if beyond.mean() > 0.05:
            raise InputError(
                f"{name}: commands.{stick}: expected numbers from {zero:g} (0) to {full:g} (1), "
                f"got {table[:, column].min():g} to {table[:, column].max():g} in {topic.name}; "
                "correct zero and full, or the order in channels"
            )
        commands[:, column] = np.clip(values, low, 1.0)
        clipped = np.abs(commands[:, column] - values) > ROUNDING
        if clipped.any():
            warnings.append(f"messages with {stick} beyond {low:g}..1, clipped: {clipped.sum()}")
    return t, commands


def _stick_numbers(
    name: str,
    topic: Topic,
    mapping: CommandMapping,
    messages: Messages,
    warnings: list[str],
) -> dict[str, Array]:
    """The numbers of each stick in the message's own unit, (M,) each."""
    own_field = {s: getattr(mapping, s).field for s in COMMAND_NAMES if getattr(mapping, s).field}
    if own_field:
        return {
            stick: _column(name, topic, [_find(message, place) for _, message in messages], place)
            for stick, place in own_field.items()
        }
    place = mapping.field or _array_field(name, topic, messages[0][1])
    arrays = [_find(message, place) for _, message in messages]
    if not all(isinstance(array, np.ndarray) for array in arrays):
        raise InputError(f"{name}: commands.field: expected an array of numbers, got {place!r} in "
                         f"{topic.type}, which has {_field_list(messages[0][1])}")  # fmt: skip
    count = min(len(array) for array in arrays)
    values = np.array([array[:count] for array in arrays], dtype=np.float64)
    channels = mapping.channels or _usual_channels(name, topic, values, warnings)
    if len(channels) > count:
        raise InputError(
            f"{name}: commands.channels: expected at most {count} names, one for each number of a "
            f"message of {topic.name}, got {len(channels)}"
        )
    for stick in COMMAND_NAMES:
        near = difflib.get_close_matches(stick, set(channels) - set(COMMAND_NAMES), n=1, cutoff=0.8)
        if stick not in channels and near:
            raise InputError(
                f"{name}: commands.channels: expected {stick}, got {near[0]!r}; correct the name"
            )
        if channels.count(stick) > 1:
            raise InputError(f"{name}: commands.channels: expected {stick} once, got it "
                             f"{channels.count(stick)} times")  # fmt: skip
    if not set(channels) & set(COMMAND_NAMES):
        raise InputError(
            f"{name}: commands.channels: expected some of {', '.join(COMMAND_NAMES)}, got "
            f"{', '.join(channels)}"
        )
    return {s: values[:, channels.index(s)] for s in COMMAND_NAMES if s in channels}


def _array_field(name: str, topic: Topic, message: Mapping[str, Any]) -> str:
    """The only array of numbers in a message, such as "data" or "axes"."""
    arrays = [
        key
        for key, value in message.items()
        if isinstance(value, np.ndarray) and not (topic.type == "sensor_msgs/Joy" and key != "axes")
    ]
    if len(arrays) != 1:
        raise InputError(
            f"{name}: commands.field: expected which field of {topic.type} holds the numbers, or "
            f"commands.throttle.field and so on for a field each; it has {_field_list(message)}"
        )
    return arrays[0]


def _usual_channels(name: str, topic: Topic, values: Array, warnings: list[str]) -> tuple[str, ...]:
    """The usual order of a radio, for pulses of four channels or more."""
    count = values.shape[1]
    pulses = ((values > PULSE_US[0]) & (values < PULSE_US[1])).mean(axis=0) > 0.95
    if count < 4 or not pulses[:4].all():
        first = ", ".join(f"{number:g}" for number in values[0, :8])
        raise InputError(
            f"{name}: commands.channels: expected what the {count} numbers of {topic.name} are, in "
            f"order ({', '.join(COMMAND_NAMES)}, or another word); the first message has {first}; "
            "write it into a mapping file (TOML) and give --mapping"
        )
    warnings.append(
        f"channels not given, taken in the usual order {', '.join(USUAL_ORDER)}; "
        "write commands.channels into the mapping"
    )
    return USUAL_ORDER


def _ends(stick: str, channel: Channel, values: Array, warnings: list[str]) -> tuple[float, float]:
    """The numbers at command 0 and at command 1."""
    median = float(np.median(values))
    if PULSE_US[0] < median < PULSE_US[1]:
        zero, full = PULSE_ENDS.get(stick, PULSE_ENDS["other"])
    else:  # a joystick's axis is -1..1; a throttle that is never negative is 0..1
        zero, full = (-1.0 if stick == "throttle" and values.min() < -0.05 else 0.0), 1.0
    if channel.zero is None or channel.full is None:
        zero = zero if channel.zero is None else channel.zero
        full = full if channel.full is None else channel.full
        warnings.append(
            f"{stick}: zero and full not both given, taken as {zero:g} and {full:g}; "
            f"write them into [commands.{stick}]"
        )
        return zero, full
    return channel.zero, channel.full


def _column(name: str, topic: Topic, values: Sequence[Any], place: str) -> Array:
    if not all(isinstance(value, (int, float)) for value in values):
        raise InputError(f"{name}: expected a number at {place} in {topic.type}, got none")
    return np.array(values, dtype=np.float64)


def _field_list(message: Mapping[str, Any]) -> str:
    return "the fields " + ", ".join(list(message)[:20])


def message_times(topic: Topic, messages: Messages, warnings: list[str]) -> Nanoseconds:
    """The messages' own stamps (N,); their arrival without any or if they are of another clock."""
    arrival = np.array([t for t, _ in messages], dtype=np.int64)
    stamps = [_find(message, "header.stamp") for _, message in messages]
    if not all(isinstance(stamp, dict) and {"sec", "nanosec"} <= stamp.keys() for stamp in stamps):
        return arrival
    own = np.array([stamp["sec"] * 10**9 + stamp["nanosec"] for stamp in stamps], dtype=np.int64)
    late = abs(float(np.median(arrival - own))) * 1e-9
    if late > MAX_CLOCK_DIFFERENCE_S:
        warnings.append(
            f"{topic.name}: stamps are {late:.3g} s from the arrival of their messages, so of "
            "another clock; the arrival is used"
        )
        return arrival
    return own


def _find(message: Any, path: str) -> Any:
    """What stands at "pose.pose" in a message; None where nothing does."""
    for key in path.split(".") if path else ():
        message = message.get(key) if isinstance(message, dict) else None
    return message
