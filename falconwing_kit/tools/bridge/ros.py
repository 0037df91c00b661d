"""ROS adapter: the bus of bus.py <-> ROS 1 topics of the same names, with standard messages only.

    /falconwing/image     sensor_msgs/CompressedImage (JPEG) or Image   frame_id "camera#17": 17 is the image's sequence
    /falconwing/command   sensor_msgs/Joy   axes throttle, aileron, elevator, rudder; buttons engage, saturated;
                                            frame_id "image#17": the image that the command answers
    /falconwing/pilot     sensor_msgs/Joy   the same, engage always 0
    /falconwing/status    diagnostic_msgs/DiagnosticArray   one value for each field of the status

The sequence stands in frame_id because rospy overwrites header.seq with a count of its own. rospy
is Debian's and is loaded when a RosBus is made, not before.
"""

import dataclasses
import json
import os
import sys
from collections import Counter
from importlib import import_module
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.tools.bridge.bus import (
    COMMAND,
    IMAGE,
    PILOT,
    STATUS,
    Mailbox,
    StampedCommand,
    StampedStatus,
    require_message,
    require_topic,
)
from falconwing_kit.trainer_port.protocol import Status

DISTRO_PACKAGES = "/usr/lib/python3/dist-packages"  # where Debian and Ubuntu keep rospy
BUFFER_BYTES = (
    4 * 2**20
)  # what a subscriber reads at once; rospy's 64 KiB let images queue up and age
LEVELS = {
    "BOOT": 1,
    "SAFE": 0,
    "ACTIVE": 0,
    "LOST": 1,
    "FAULT": 2,
}  # of DiagnosticStatus: 0 ok, 1 warning, 2 error
CHANNELS_OF_PIXEL = {"rgb8": 3, "bgr8": 3, "mono8": 1}


class RosBus:
    """The bus through ROS: what one program publishes, others hear, on this machine or the next.

    A program is one ROS node, however many buses it opens; the node ends with the program.

    Args:
        name: of the node; a number is added, so that two programs may choose the same.
        raw_images: publish pixels as sensor_msgs/Image instead of JPEG; both are understood.

    Raises:
        InputError: rospy is not installed, or no ROS master answers.
    """

    def __init__(self, name: str = "falconwing", *, raw_images: bool = False) -> None:
        self.refused: Counter[str] = Counter()  # messages heard and not understood, of each topic
        self.last_refusal = ""  # why
        self._ros = load_ros()
        self._raw_images = raw_images
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []
        os.environ.setdefault("ROS_MASTER_URI", "http://localhost:11311")
        if not self._ros.is_master_online():
            uri = os.environ["ROS_MASTER_URI"]
            raise InputError(
                f"ROS: expected a master at {uri}, got no answer; start `roscore` or set ROS_MASTER_URI"
            )
        if (
            not self._ros.rospy.core.is_initialized()
        ):  # signals stay ours: Ctrl-C must hand the sticks back
            self._ros.rospy.init_node(name, argv=[], anonymous=True, disable_signals=True)

    def publish(self, topic: str, message: Any) -> None:
        """Hand a message to all who listen now.

        Args:
            topic: one of bus.MESSAGES.
            message: what that topic carries.

        Raises:
            InputError: there is no such topic, it carries something else, or the message has a time
                before 1970.
        """
        require_message(topic, message)
        self._publisher(topic).publish(self._encode(topic, message))

    def subscribe(self, topic: str) -> Mailbox:
        """Listen from now on; what cannot be understood is counted in `refused` and dropped.

        Args:
            topic: one of bus.MESSAGES.

        Returns:
            Where the topic's newest message lies.

        Raises:
            InputError: there is no such topic.
        """
        mailbox = Mailbox()

        def hear(heard: Any) -> None:
            try:
                mailbox.put(self._decode(topic, heard._connection_header["type"], heard._buff))
            except (
                Exception
            ) as error:  # other programs send what they like; it must not end this one
                self.refused[topic] += 1
                self.last_refusal = f"{topic}: {error}"

        self._subscribers.append(
            self._ros.rospy.Subscriber(
                require_topic(topic),
                self._ros.AnyMsg,
                hear,
                queue_size=1,
                buff_size=BUFFER_BYTES,
                tcp_nodelay=True,
            )
        )
        return mailbox

    def listeners(self, topic: str) -> int:
        """How many are connected to this bus's side of a topic; ROS needs some 0.1 s to connect a
        new one.

        Raises:
            InputError: there is no such topic.
        """
        return int(self._publisher(require_topic(topic)).get_num_connections())

    def close(self) -> None:
        """Publish and hear no more."""
        for end in (*self._subscribers, *self._publishers.values()):
            end.unregister()
        self._subscribers.clear()
        self._publishers.clear()

    def _publisher(self, topic: str) -> Any:
        if topic not in self._publishers:
            kinds = {
                IMAGE: "RawImage" if self._raw_images else "CompressedImage",
                STATUS: "DiagnosticArray",
            }
            kind = getattr(self._ros, kinds.get(topic, "Joy"))
            self._publishers[topic] = self._ros.rospy.Publisher(
                topic, kind, queue_size=1, tcp_nodelay=True
            )
        return self._publishers[topic]

    def _encode(self, topic: str, message: Any) -> Any:
        """The ROS message that stands for one of ours."""
        ros = self._ros
        if topic == IMAGE:
            header = self._header(message.t, f"camera#{message.sequence}")
            if not self._raw_images:
                return ros.CompressedImage(header=header, format="jpeg", data=message.jpeg)
            height, width, channels = require_pixels(message).shape
            return ros.RawImage(
                header, height, width, "rgb8", 0, channels * width, message.pixels.tobytes()
            )
        if topic == STATUS:
            return self._diagnostics(message)
        header = self._header(message.t, f"image#{message.command.image_sequence}")
        return ros.Joy(
            header=header, axes=message.command.vector.tolist(), buttons=buttons(message)
        )

    def _diagnostics(self, report: StampedStatus) -> Any:
        ros, status = self._ros, report.status
        values = [
            ros.KeyValue(key, json.dumps(value))
            for key, value in dataclasses.asdict(status).items()
        ]
        text = status.state + (f" ({status.fault})" if status.state == "FAULT" else "")
        line = ros.DiagnosticStatus(
            LEVELS[status.state], "falconwing trainer port", text, "", values
        )
        return ros.DiagnosticArray(header=self._header(report.t, "board"), status=[line])

    def _header(self, t: float, frame_id: str) -> Any:
        return self._ros.Header(
            stamp=self._ros.rospy.Time(*divmod(stamp_ns(t), 10**9)), frame_id=frame_id
        )

    def _decode(self, topic: str, kind: str, data: bytes) -> Any:
        """Our message for a ROS one, given its type and its bytes."""
        understood = {
            (IMAGE, "sensor_msgs/CompressedImage"): (
                self._ros.CompressedImage,
                image_from_compressed,
            ),
            (IMAGE, "sensor_msgs/Image"): (self._ros.RawImage, image_from_raw),
            (COMMAND, "sensor_msgs/Joy"): (self._ros.Joy, command_from_joy),
            (PILOT, "sensor_msgs/Joy"): (self._ros.Joy, command_from_joy),
            (STATUS, "diagnostic_msgs/DiagnosticArray"): (
                self._ros.DiagnosticArray,
                status_from_diagnostics,
            ),
        }
        if (topic, kind) not in understood:
            raise InputError(
                f"expected {' or '.join(k for t, k in understood if t == topic)}, got {kind}"
            )
        wire_type, read = understood[topic, kind]
        return read(wire_type().deserialize(data))


def load_ros() -> SimpleNamespace:
    """rospy and the messages of this file by their names.

    The distribution's packages are looked up last, so that they replace none of the environment's
    own.

    Raises:
        InputError: they are not installed, or made for another Python.
    """
    if find_spec("rospy") is None and DISTRO_PACKAGES not in sys.path:
        sys.path.append(DISTRO_PACKAGES)
    try:
        rospy, rosgraph = import_module("rospy"), import_module("rosgraph")
        std, sensor, diagnostic = (
            import_module(f"{kind}_msgs.msg") for kind in ("std", "sensor", "diagnostic")
        )
    except ImportError as error:
        raise InputError(
            f"ROS: expected Debian's rospy and its messages, got none here ({error}); install them by `apt install "
            'python3-rospy python3-sensor-msgs python3-diagnostic-msgs` and `pip install "falconwing-kit[ros]"`'
        ) from None
    return SimpleNamespace(
        rospy=rospy,
        is_master_online=rosgraph.is_master_online,
        AnyMsg=rospy.AnyMsg,
        Header=std.Header,
        CompressedImage=sensor.CompressedImage,
        RawImage=sensor.Image,
        Joy=sensor.Joy,
        DiagnosticArray=diagnostic.DiagnosticArray,
        DiagnosticStatus=diagnostic.DiagnosticStatus,
        KeyValue=diagnostic.KeyValue,
    )


def stamp_ns(t: float) -> int:
    """A time as ROS has it.

    Args:
        t: seconds from 0 to what 32 bits hold.

    Returns:
        Nanoseconds, at least one: to ROS a stamp of zero means that there is none.

    Raises:
        InputError: the time is out of this range.
    """
    return max(round(require_range("t", t, low=0.0, high=2**32 - 1) * 1e9), 1)


def buttons(sticks: StampedCommand) -> list[int]:
    """Engage and saturated as the buttons of a Joy."""
    return [int(sticks.engage), int(sticks.command.saturated)]


def require_pixels(image: Image) -> Any:
    """The pixels (height, width, 3) of an image.

    Raises:
        InputError: the image is a JPEG.
    """
    if image.pixels.ndim != 3:
        raise InputError(
            "raw images: expected pixels (height, width, 3), got a JPEG; publish without raw_images"
        )
    return image.pixels


def sequence_of(frame_id: str, default: int) -> int:
    """The number behind the # of a frame_id; the default where there is none."""
    digits = frame_id.partition("#")[2]
    return int(digits) if digits.isdecimal() else default


def image_from_compressed(message: Any) -> Image:
    """Image of a CompressedImage; one without our frame_id keeps the count of its header.

    Raises:
        InputError: it is not a JPEG.
    """
    if not message.data.startswith(b"\xff\xd8"):
        raise InputError(f"expected an image compressed as JPEG, got {message.format!r}")
    header = message.header
    sequence = sequence_of(header.frame_id, header.seq)
    return Image(sequence, header.stamp.to_nsec() / 1e9, np.frombuffer(message.data, np.uint8))


def image_from_raw(message: Any) -> Image:
    """Image of a sensor_msgs/Image in RGB, BGR or grey.

    Raises:
        InputError: it has another encoding, or fewer bytes than its size says.
    """
    channels = CHANNELS_OF_PIXEL.get(message.encoding)
    if channels is None:
        raise InputError(
            f"expected an image in {', '.join(CHANNELS_OF_PIXEL)}, got {message.encoding!r}"
        )
    rows, row_bytes = message.height, message.width * channels
    if message.step < row_bytes or len(message.data) < message.step * rows:
        raise InputError(
            f"expected {message.step * rows} bytes in rows of {row_bytes}, got {len(message.data)}"
        )
    padded = np.frombuffer(message.data, np.uint8, message.step * rows).reshape(rows, message.step)
    pixels = padded[:, :row_bytes].reshape(rows, message.width, channels)
    pixels = (
        pixels[..., ::-1]
        if message.encoding == "bgr8"
        else np.repeat(pixels, 3 // channels, axis=2)
    )
    header = message.header
    return Image(sequence_of(header.frame_id, header.seq), header.stamp.to_nsec() / 1e9, pixels)


def command_from_joy(message: Any) -> StampedCommand:
    """Sticks of a Joy; more axes and buttons than ours are passed over.

    Raises:
        InputError: an axis is missing or not finite, or there is no engage button.
    """
    if len(message.axes) < 4 or not message.buttons:
        raise InputError(
            f"expected 4 axes and 1 button, got {len(message.axes)} and {len(message.buttons)}"
        )
    throttle, aileron, elevator, rudder = message.axes[:4]
    command = Command.clip(
        throttle, aileron, elevator, rudder, sequence_of(message.header.frame_id, -1)
    )
    if any(message.buttons[1:2]):
        command = dataclasses.replace(command, saturated=True)
    return StampedCommand(
        message.header.stamp.to_nsec() / 1e9, command, engage=bool(message.buttons[0])
    )


def status_from_diagnostics(message: Any) -> StampedStatus:
    """Report of a DiagnosticArray whose first entry is ours.

    Raises:
        InputError: a field is missing or more than ours are there.
    """
    values = {item.key: json.loads(item.value) for item in message.status[0].values}
    want = {field.name for field in dataclasses.fields(Status)}
    if set(values) != want:
        raise InputError(
            f"expected the values {', '.join(sorted(want))}, got {', '.join(sorted(values))}"
        )
    values["channels_us"] = tuple(values["channels_us"])
    return StampedStatus(message.header.stamp.to_nsec() / 1e9, Status(**values))
