"""ROS bag: flight log -> ROS 1 bag, or a recording of ROS 2, without an installation of ROS.

The topics are those of the ROS adapter, so `rosbag play` presents a flight to a controller; engage
is 0 in all commands, so they control no aircraft. A recording of ROS 2 is a folder with an MCAP
file and its metadata, as `ros2 bag` writes it; `ros2_log.py` reads it back. Further topics:

    /falconwing/pose      geometry_msgs/PoseStamped   in "world", with ROS's body axes:
                                                      x nose, y left, z up
    /falconwing/twist     geometry_msgs/TwistStamped  velocity and angular rate, in "world" axes
    /tf                   tf2_msgs/TFMessage          of the aircraft that is followed, "leader"
    /falconwing/event     std_msgs/String             JSON with name and details
    /falconwing/metadata  std_msgs/String             JSON about the whole flight, at its first time
"""

import heapq
import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import require_writable_path, short_name, write_error
from falconwing_kit.core.flight_log import FlightLog
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.core.messages import Command, Event, Image, State
from falconwing_kit.tools.bridge.bus import COMMAND, IMAGE, StampedCommand
from falconwing_kit.tools.bridge.ros import buttons, stamp_ns

POSE, TWIST, EVENT, METADATA = (
    f"/falconwing/{name}" for name in ("pose", "twist", "event", "metadata")
)
TF = "/tf"
TYPES = {
    IMAGE: "sensor_msgs/msg/CompressedImage",
    COMMAND: "sensor_msgs/msg/Joy",
    POSE: "geometry_msgs/msg/PoseStamped",
    TWIST: "geometry_msgs/msg/TwistStamped",
    EVENT: "std_msgs/msg/String",
    METADATA: "std_msgs/msg/String",
    TF: "tf2_msgs/msg/TFMessage",
}
ROS2_VERSION: Literal[8, 9] = 8  # of a recording's metadata: what Humble and later read


def write_bag(path: str | Path, log: FlightLog) -> dict[str, int]:
    """Write a flight log as a ROS 1 bag, atomically.

    Times are those of the log, to a microsecond. One record gives one message, a state two: pose
    and twist; their header.seq is the image of the state. nan stays nan.

    Returns:
        Number of messages of each topic that has any.

    Raises:
        InputError: rosbags is not installed, or the file cannot be written.
        FileNotFoundError: the folder of the path does not exist.
    """
    _require_rosbags()
    from rosbags.rosbag1 import Writer

    target = require_writable_path(path)
    try:
        with TemporaryDirectory(prefix=".bag.", dir=target.parent) as folder:
            part = Path(folder) / "part.bag"
            with Writer(part) as writer:
                counts = _write_messages(writer, log, ros=1)
            with part.open("rb+") as handle:
                os.fsync(handle.fileno())
            os.replace(part, target)
    except OSError as error:
        raise write_error(target, error) from None
    return counts


def write_ros2_bag(path: str | Path, log: FlightLog) -> dict[str, int]:
    """Write a flight log as a recording of ROS 2 (MCAP): a folder, there whole or not at all.

    Times and messages are as in `write_bag`; a header of ROS 2 has no number, so the image of a
    state is lost, those of images and commands are in their frame_id.

    Args:
        path: of the folder, which must not exist, as for `ros2 bag record`.
        log: the flight.

    Returns:
        Number of messages of each topic that has any.

    Raises:
        InputError: rosbags is not installed, the folder is there already, or the log has no record.
        FileNotFoundError: the folder in which it is to be does not exist.
    """
    _require_rosbags()
    from rosbags.rosbag2 import StoragePlugin, Writer

    target = Path(path)
    if target.exists():
        raise InputError(
            f"{target}: expected a new folder, for a recording is never overwritten; choose another"
            " name"
        )
    require_writable_path(target)
    if not any(True for _ in _sorted_records(log)):
        raise InputError(f"{short_name(log.path)}: expected a log with records, got none")
    try:
        with TemporaryDirectory(prefix=".bag.", dir=target.parent) as folder:
            part = Path(folder) / target.name
            with Writer(part, version=ROS2_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
                counts = _write_messages(writer, log, ros=2)
            for file in part.iterdir():
                with file.open("rb+") as handle:
                    os.fsync(handle.fileno())
            os.rename(part, target)
    except OSError as error:
        raise write_error(target, error) from None
    return counts


def _require_rosbags() -> None:
    try:
        import rosbags  # noqa: F401
    except ImportError:
        raise InputError(
            "bag: expected the library rosbags, which is not installed; "
            '`pip install "falconwing-kit[ros]"`'
        ) from None


def _write_messages(writer: Any, log: FlightLog, ros: int) -> dict[str, int]:
    """Write all messages in order of time; a topic is created with its first message."""
    messages = _Messages(ros)
    topics: dict[str, Any] = {}
    counts: Counter[str] = Counter()
    for t, record in _sorted_records(log):
        for topic, message in messages.of(t, record):
            kind = TYPES[topic]
            if topic not in topics:
                # For later subscribers.
                latching = {"latching": 1} if topic == METADATA and ros == 1 else {}
                topics[topic] = writer.add_connection(
                    topic, kind, typestore=messages.store, **latching
                )
            writer.write(topics[topic], stamp_ns(t), messages.serialize(message, kind))
            counts[topic] += 1
    return dict(counts)


def _sorted_records(log: FlightLog) -> Iterator[tuple[float, Any]]:
    """All records of a log with their times [s], sorted; an image precedes others of its time."""
    states = zip(log.states, log.state_sequences.tolist(), strict=True)
    records = [
        *zip(log.state_times.tolist(), states, strict=True),
        *zip(log.command_times.tolist(), log.commands, strict=True),
        *zip(log.leader_times.tolist(), log.leaders, strict=True),
        *((event.t, event) for event in log.events),
    ]
    records.sort(key=_time)
    if log.metadata:
        first = min([t for t, _ in records[:1]] + log.image_times.tolist(), default=0.0)
        records.insert(0, (first, log.metadata))
    return heapq.merge(((image.t, image) for image in log.images()), records, key=_time)


def _time(timed: tuple[float, Any]) -> float:
    return timed[0]


class _Messages:
    """Records of a log -> messages of ROS 1 or 2 with their topics."""

    def __init__(self, ros: int) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store: Any = get_typestore({1: Stores.ROS1_NOETIC, 2: Stores.ROS2_HUMBLE}[ros])
        self._ros = ros
        self.serialize: Any = {1: self.store.serialize_ros1, 2: self.store.serialize_cdr}[ros]

    def of(self, t: float, record: Any) -> list[tuple[str, Any]]:
        """The messages of an image, command, state with its image, leader, event or metadata."""
        if isinstance(record, Image):
            header = self._header(t, f"camera#{record.sequence}", record.sequence)
            data = np.frombuffer(record.jpeg, np.uint8)
            return [(IMAGE, self._make(TYPES[IMAGE], header=header, format="jpeg", data=data))]
        if isinstance(record, Command):
            header = self._header(t, f"image#{record.image_sequence}")
            axes, pressed = (
                record.vector.astype(np.float32),
                np.array(buttons(StampedCommand(t, record)), np.int32),
            )
            return [
                (COMMAND, self._make(TYPES[COMMAND], header=header, axes=axes, buttons=pressed))
            ]
        if isinstance(record, Event):
            text = {"name": record.name, "details": dict(record.details)}
            return [(EVENT, self._make(TYPES[EVENT], data=json.dumps(text)))]
        if isinstance(record, tuple):
            return self._motion(t, *record)
        if isinstance(record, State):
            return [(TF, self._transform(t, "leader", record))]
        return [(METADATA, self._make(TYPES[METADATA], data=json.dumps(dict(record))))]

    def _motion(self, t: float, state: State, sequence: int) -> list[tuple[str, Any]]:
        header = self._header(t, "world", sequence)
        pose = self._make(
            "geometry_msgs/msg/Pose",
            position=self._vector("Point", state.p_world),
            orientation=self._orientation(state),
        )
        rates_world = rotation_world_body(state.roll, state.pitch, state.yaw) @ state.rates_body
        linear, angular = (
            self._vector("Vector3", state.v_world),
            self._vector("Vector3", rates_world),
        )
        twist = self._make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
        return [
            (POSE, self._make(TYPES[POSE], header=header, pose=pose)),
            (TWIST, self._make(TYPES[TWIST], header=header, twist=twist)),
        ]

    def _transform(self, t: float, child: str, state: State) -> Any:
        """A TFMessage with the one transform from the world to an aircraft."""
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector("Vector3", state.p_world),
            rotation=self._orientation(state),
        )
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(t, "world"),
            child_frame_id=child,
            transform=transform,
        )
        return self._make(TYPES[TF], transforms=[stamped])

    def _orientation(self, state: State) -> Any:
        x, y, z, w = _quaternion(state.roll, state.pitch, state.yaw)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _vector(self, kind: str, xyz: Array) -> Any:
        x, y, z = xyz.tolist()
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _header(self, t: float, frame_id: str, sequence: int = 0) -> Any:
        sec, nanosec = divmod(stamp_ns(t), 10**9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        number = {"seq": max(sequence, 0)} if self._ros == 1 else {}
        return self._make("std_msgs/msg/Header", **number, stamp=stamp, frame_id=frame_id)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w from ROS's body axes (nose, left, up) to the world's [REP 103].

    Half a turn about the nose on both sides changes Rz(yaw) Ry(pitch) Rx(roll) into Rz(-yaw)
    Ry(-pitch) Rx(roll); the product of the three half-angle quaternions is eq. 1.8-16 of Stevens,
    Lewis & Johnson with those angles.
    """
    (sr, sp, sy), (cr, cp, cy) = (
        np.sin([roll / 2, -pitch / 2, -yaw / 2]),
        np.cos([roll / 2, -pitch / 2, -yaw / 2]),
    )
    return (
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
        float(cr * cp * cy + sr * sp * sy),
    )
