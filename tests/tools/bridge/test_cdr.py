"""CDR: messages written by rosbags, an independent library, and by hand."""

import struct

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.bridge.cdr import decode, parse_definition
from tests.tools.bridge.ros2_logs import STORE, numbers_message, pose_message

HEADER = b"\0\1\0\0"  # little-endian plain CDR


def definition_of(kind):
    return parse_definition(kind, STORE.generate_msgdef(kind, ros_version=2)[0])


def test_a_pose_has_the_numbers_that_rosbags_wrote():
    """Seven different numbers behind a text whose length shifts them: alignment to 8 bytes."""
    kind = "geometry_msgs/msg/PoseStamped"
    message = pose_message(kind, 12.25, np.array([1.5, -2.5, 3.5]), np.array([0.1, 0.2, 0.3, 0.9]))
    for name in ("", "a", "map", "qualisys", "a longer name"):
        message.header.frame_id = name
        found = decode(definition_of(kind), bytes(STORE.serialize_cdr(message, kind)))
        assert found["header"] == {
            "stamp": {"sec": 1_700_000_012, "nanosec": 250_000_000}, "frame_id": name,
        }  # fmt: skip
        assert found["pose"]["position"] == {"x": 1.5, "y": -2.5, "z": 3.5}
        assert found["pose"]["orientation"] == {"x": 0.1, "y": 0.2, "z": 0.3, "w": 0.9}


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(
    "kind",
    ["std_msgs/msg/UInt16MultiArray", "std_msgs/msg/Float64MultiArray", "sensor_msgs/msg/Joy"],
)
def test_arrays_of_numbers_in_both_byte_orders(kind, big_endian):
    """rosbags writes either order."""
    numbers = [1500.0, 1000.0, 2000.0, 3.0, 7.0]
    message = numbers_message(kind, 0.0, numbers)
    data = bytes(STORE.serialize_cdr(message, kind, little_endian=not big_endian))
    found = decode(definition_of(kind), data)
    assert list(found["axes" if "Joy" in kind else "data"]) == numbers


def test_lists_of_messages_and_fixed_arrays():
    """A list of transforms, and the covariance's 36 numbers."""
    kind = "tf2_msgs/msg/TFMessage"
    message = pose_message(kind, 0.0, np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    found = decode(definition_of(kind), bytes(STORE.serialize_cdr(message, kind)))
    assert [each["child_frame_id"] for each in found["transforms"]] == ["table", "cub"]
    kind = "nav_msgs/msg/Odometry"
    message = pose_message(kind, 0.0, np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    message.pose.covariance[:] = np.arange(36.0)
    found = decode(definition_of(kind), bytes(STORE.serialize_cdr(message, kind)))
    assert list(found["pose"]["covariance"]) == list(range(36))


def test_a_type_that_nobody_installed():
    """Constants are not in the bytes, defaults change nothing, bounds and comments are read over;
    the bytes are rosbags'.
    """
    text = (
        "# a note\nuint8 MODE_AUTO=2\nstring NAME='a # b'\nbool armed true # the switch\n"
        "string<=10 short\nint8[3] trims\nfloat32[<=4] sticks\nstring[] words\n"
        "lab/Inner inner\nuint64 last 5\n"
        + "=" * 80 + "\nMSG: lab/Inner\nuint8 small\nfloat64 large\n"
    )  # fmt: skip
    plain = text.replace("'a # b'", "a")
    STORE.register(
        {k: v for k, v in get_types_from_msg(plain, "lab/msg/Outer").items() if "lab" in k}
    )
    inner = STORE.types["lab/msg/Inner"](small=3, large=0.125)
    message = STORE.types["lab/msg/Outer"](
        armed=True, short="cub", trims=np.array([-1, 0, 5], np.int8),
        sticks=np.array([0.5, -0.25], np.float32),
        words=["up", "", "down"], inner=inner, last=2**40,
    )  # fmt: skip
    data = bytes(STORE.serialize_cdr(message, "lab/msg/Outer"))
    found = decode(parse_definition("lab/msg/Outer", text), data)
    assert found["armed"] is True and found["short"] == "cub"
    assert found["words"] == ["up", "", "down"]
    assert list(found["trims"]) == [-1, 0, 5] and list(found["sticks"]) == [0.5, -0.25]
    assert found["inner"] == {"small": 3, "large": 0.125} and found["last"] == 2**40


def test_numbers_of_eight_bytes_align_to_four_in_the_newer_encoding():
    """By hand [DDS-XTypes 1.3, table 7.4.3]: a byte, three of padding, then the double at 4."""
    found = decode(
        parse_definition("lab/msg/A", "uint8 a\nfloat64 b\n"),
        b"\0\7\0\0" + struct.pack("<B3xd", 7, 2.5),
    )
    assert found == {"a": 7, "b": 2.5}


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "plain CDR"),
        (b"\0\3\0\0" + bytes(60), "plain CDR"),
        (HEADER + bytes(3), "end too soon"),
        (HEADER + struct.pack("<II", 0, 4_000_000_000), "end too soon"),
    ],
)
def test_damaged_bytes_are_refused(data, text):
    """Empty, another encoding, cut, and a length of four billion: no crash, no such allocation."""
    kind = "std_msgs/msg/UInt16MultiArray"
    with pytest.raises(InputError, match=text):
        decode(definition_of(kind), data)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("float64\n", "field of a ROS message"),
        ("other/Type a\n", "definition of the type other/Type"),
        ("lab/A a\n", "finite depth"),
    ],
)
def test_damaged_definitions_are_refused(text, complaint):
    """A line that is no field, an unknown type, and a type that contains itself."""
    with pytest.raises(InputError, match=complaint):
        parse_definition("lab/msg/A", text)
