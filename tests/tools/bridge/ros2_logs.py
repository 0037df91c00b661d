"""ROS 2 logs for tests: a flight -> an MCAP file; rosbags, independent of the kit, encodes it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
START_S = 1_700_000_000  # of the log's clock, as ROS stamps are: seconds since 1970
SPEED, HEIGHT, GRAVITY = 5.0, 2.0, 9.8  # [m/s], [m], [m/s^2]
# Axes of a log as rotations of the kit's: half a turn about x, or none.
HALF_TURN = Rotation.from_euler("x", 180.0, degrees=True)
SAME = Rotation.identity()
WORLDS = {"enu": SAME, "ned": HALF_TURN}
BODIES = {"flu": HALF_TURN, "frd": SAME}


@dataclass(frozen=True)
class Turns:
    """A flight at constant speed and height through turns without sideslip."""

    t: np.ndarray  # (N,) [s]
    p_world: np.ndarray  # (N, 3) [m]
    attitude: np.ndarray  # (N, 3) roll, pitch, yaw [rad]
    roll_rate: np.ndarray  # (N,) [rad/s]


def turns(seconds: float = 12.0, rate_hz: float = 50.0) -> Turns:
    """Bank swings between left and right; yaw rate g tan(roll) / V is the law of the level turn."""
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    roll = 0.5 * np.sin(1.3 * t) + 0.1
    yaw_rate = GRAVITY / SPEED * np.tan(roll)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (yaw_rate[1:] + yaw_rate[:-1]) / rate_hz)])
    v = SPEED * np.column_stack(
        [np.cos(yaw), -np.sin(yaw), 0.0 * t]
    )  # yaw is positive to the right
    p = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (v[1:] + v[:-1]) / rate_hz, axis=0)])
    yaw = (yaw + np.pi) % (2.0 * np.pi) - np.pi
    attitude = np.column_stack([roll, 0.05 + 0.02 * np.sin(2.0 * t), yaw])
    return Turns(t, p + np.array([1.0, -2.0, HEIGHT]), attitude, 0.5 * 1.3 * np.cos(1.3 * t))


def log_poses(
    flight: Turns, world: str = "enu", body: str = "flu", runway_deg: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and quaternions (N, 4) x, y, z, w of a flight in a log's axes.

    The definition of the kit's attitude, `diag(1, -1, -1) Rz(yaw) Ry(pitch) Rx(roll)`, by SciPy.
    """
    angles = flight.attitude[:, ::-1]
    world_body = HALF_TURN * Rotation.from_euler("ZYX", angles)
    # A vector of the kit's world in axes with z up whose x axis lies `runway_deg` to its right.
    turned = Rotation.from_euler("z", runway_deg, degrees=True)
    log_world = WORLDS[world].inv() * turned
    return log_world.apply(flight.p_world), (log_world * world_body * BODIES[body]).as_quat()


def stamp(t: float) -> Any:
    """builtin_interfaces/Time of a flight's time [s]."""
    nanoseconds = round(t * 1e9)
    return TYPES["builtin_interfaces/msg/Time"](
        sec=START_S + nanoseconds // 10**9, nanosec=nanoseconds % 10**9
    )


def header(t: float, frame: str = "map") -> Any:
    """std_msgs/Header."""
    return TYPES["std_msgs/msg/Header"](stamp=stamp(t), frame_id=frame)


def pose_message(kind: str, t: float, p: np.ndarray, q: np.ndarray, child: str = "cub") -> Any:
    """A pose in a message of this type: "nav_msgs/msg/Odometry"."""
    point = TYPES["geometry_msgs/msg/Point"](*map(float, p))
    vector = TYPES["geometry_msgs/msg/Vector3"](*map(float, p))
    turn = TYPES["geometry_msgs/msg/Quaternion"](*map(float, q))
    pose = TYPES["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    covariance = np.zeros(36)
    with_covariance = TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, covariance)
    transform = TYPES["geometry_msgs/msg/Transform"](translation=vector, rotation=turn)
    zero = TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = TYPES["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, covariance)
    stamped = TYPES["geometry_msgs/msg/TransformStamped"](header(t), child, transform)
    other = TYPES["geometry_msgs/msg/TransformStamped"](header(t), "table", transform)
    return {
        "geometry_msgs/msg/Pose": pose,
        "geometry_msgs/msg/PoseStamped": TYPES["geometry_msgs/msg/PoseStamped"](header(t), pose),
        "geometry_msgs/msg/PoseWithCovarianceStamped": TYPES[
            "geometry_msgs/msg/PoseWithCovarianceStamped"
        ](header(t), with_covariance),
        "nav_msgs/msg/Odometry": TYPES["nav_msgs/msg/Odometry"](
            header(t), child, with_covariance, twist
        ),
        "geometry_msgs/msg/TransformStamped": stamped,
        "tf2_msgs/msg/TFMessage": TYPES["tf2_msgs/msg/TFMessage"]([other, stamped]),
    }[kind]


def numbers_message(kind: str, t: float, numbers: Sequence[float]) -> Any:
    """Numbers in a message of this type: "std_msgs/msg/UInt16MultiArray"."""
    if kind == "sensor_msgs/msg/Joy":
        axes = np.array(numbers, np.float32)
        return TYPES[kind](header(t), axes, np.zeros(3, np.int32))
    dtype = {"UInt16": np.uint16, "Float32": np.float32, "Float64": np.float64}
    layout = TYPES["std_msgs/msg/MultiArrayLayout"](
        dim=[TYPES["std_msgs/msg/MultiArrayDimension"]("channel", len(numbers), len(numbers))],
        data_offset=0,
    )
    return TYPES[kind](layout, np.array(numbers, dtype[kind.split("/")[-1][:-10]]))


def write_log(path: Path, topics: dict[str, tuple[str, Sequence[tuple[float, Any]]]]) -> Path:
    """Write topics, each a type and its messages with their times of arrival, as an MCAP file."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8192)
        writer.start(profile="ros2")
        channels, messages = {}, []
        for topic, (kind, timed) in topics.items():
            text, _ = STORE.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
            messages += [(t, topic, kind, message) for t, message in timed]
        for t, topic, kind, message in sorted(messages, key=lambda each: each[:2]):
            at = START_S * 10**9 + round(t * 1e9)
            data = bytes(STORE.serialize_cdr(message, kind))
            writer.add_message(channels[topic], at, data, at)
        writer.finish()
    return path


def write_flight(
    path: Path,
    flight: Turns,
    *,
    kind: str = "geometry_msgs/msg/PoseStamped",
    command_kind: str = "std_msgs/msg/UInt16MultiArray",
    axes: tuple[str, str, float] = ("enu", "flu", 0.0),
    sticks: np.ndarray | None = None,
) -> Path:
    """A log with a pose topic at the flight's rate and a command topic at 10 Hz.

    Args:
        sticks: (M, n) numbers of the commands, at 0, 0.1, ... s; None for pulses in the usual order
            whose aileron goes with the roll rate.
    """
    p, q = log_poses(flight, *axes)
    times = np.arange(0.0, flight.t[-1], 0.1)
    if sticks is None:
        rate = np.interp(times, flight.t, flight.roll_rate)
        sticks = np.column_stack([1500 + 500 * rate, 1500 + 0 * times, 1600 + 0 * times,
                                  1500 + 0 * times])  # fmt: skip
    poses = [(t, pose_message(kind, t, *pose)) for t, *pose in zip(flight.t, p, q, strict=True)]
    commands = [
        (t, numbers_message(command_kind, t, numbers))
        for t, numbers in zip(times, sticks, strict=False)
    ]
    return write_log(path, {"/drone/where": (kind, poses), "/radio": (command_kind, commands)})
