"""ROS adapter: the bus of bus.py <-> ROS 1 topics of the same names, with standard messages.

    /falconwing/image     sensor_msgs/CompressedImage (JPEG) or Image
                          frame_id "camera#17": 17 is the image's sequence
    /falconwing/command   sensor_msgs/Joy: axes throttle, aileron, elevator, rudder;
                          buttons engage, saturated;
                          frame_id "image#17": the image that the command was computed from
    /falconwing/pilot     sensor_msgs/Joy: the same, engage always 0
    /falconwing/status    diagnostic_msgs/DiagnosticArray: one value for each field of the status

The sequence is in frame_id because rospy overwrites header.seq. rospy is Debian's and is loaded
when a RosBus is created.
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

DISTRO_PACKAGES = "/usr/lib/python3/dist-packages"  # rospy's folder in Debian and Ubuntu
BUFFER_BYTES = 4 * 2**20  # of a subscriber; with rospy's 64 KiB images queue up and age
# Levels of DiagnosticStatus: 0 ok, 1 warning, 2 error.
LEVELS = {"BOOT": 1, "SAFE": 0, "ACTIVE": 0, "LOST": 1, "FAULT": 2}
CHANNELS_OF_PIXEL = {"rgb8": 3, "bgr8": 3, "mono8": 1}


class RosBus:
    """The bus between programs, on one machine or several, through ROS.

    A program is one ROS node, however many buses it opens; the node ends with the program.

    Args:
        name: of the node; a number is added, so several programs may use the same name.
        raw_images: publish pixels as sensor_msgs/Image instead of JPEG; both are received.

    Raises:
        InputError: rospy is not installed, or no ROS master answers.
    """

    def __init__(self, name: str = "falconwing", *, raw_images: bool = False) -> None:
        self.refused: Counter[str] = Counter()  # unreadable messages of each topic
        self.last_refusal = ""  # reason of the last one
        self._ros = load_ros()
        self._raw_images = raw_images
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []
        os.environ.setdefault("ROS_MASTER_URI", "http://localhost:11311")
        if not self._ros.is_master_online():
            uri = os.environ["ROS_MASTER_URI"]
            raise InputError(
                f"ROS: expected a master at {uri}, got no answer; "
                "start `roscore` or set ROS_MASTER_URI"
            )
        if not self._ros.rospy.core.is_initialized():
            # Without rospy's signal handlers: Ctrl-C must hand control back.
            self._ros.rospy.init_node(name, argv=[], anonymous=True, disable_signals=True)

    def publish(self, topic: str, message: Any) -> None:
        """Send a message to all current subscribers.

        Raises:
            InputError: there is no such topic, it carries another type, or the message's time is
                before 1970.
        """
        require_message(topic, message)
        self._publisher(topic).publish(self._encode(topic, message))

    def subscribe(self, topic: str) -> Mailbox:
        """A mailbox for the messages from now on; unreadable ones are counted in `refused`.

        Raises:
            InputError: there is no such topic.
        """
        mailbox = Mailbox()

        def receive(message: Any) -> None:
            try:
                mailbox.put(self._decode(topic, message._connection_header["type"], message._buff))
            except Exception as error:  # another program's message must not end this one
                self.refused[topic] += 1
                self.last_refusal = f"{topic}: {error}"

        self._subscribers.append(
            self._ros.rospy.Subscriber(
                require_topic(topic),
                self._ros.AnyMsg,
                receive,
                queue_size=1,
                buff_size=BUFFER_BYTES,
                tcp_nodelay=True,
            )
        )
        return mailbox

    def listeners(self, topic: str) -> int:
        """Number of subscribers connected to this publisher; connecting takes about 0.1 s.

        A message published before a subscriber is connected is lost to it.
        """
        return int(self._publisher(require_topic(topic)).get_num_connections())

    def close(self) -> None:
        """Unregister all publishers and subscribers."""
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
        """The ROS message for a message of the bus."""
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
        """The bus's message for a ROS message, given its type and its bytes."""
        readers = {
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
        if (topic, kind) not in readers:
            raise InputError(
                f"expected {' or '.join(k for t, k in readers if t == topic)}, got {kind}"
            )
        wire_type, read = readers[topic, kind]
        return read(wire_type().deserialize(data))


def load_ros() -> SimpleNamespace:
    """rospy and the ROS message classes of this file, by name.

    The distribution's packages come last in the search path, so they replace none of the
    environment's own.

    Raises:
        InputError: they are not installed, or built for another Python.
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
            f"ROS: expected Debian's rospy and its messages, got none here ({error}); install "
            "them by `apt install python3-rospy python3-sensor-msgs python3-diagnostic-msgs` and "
            '`pip install "falconwing-kit[ros]"`'
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
    """A ROS time stamp [ns] of t [s]; at least 1, because in ROS zero means "no stamp".

    Raises:
        InputError: t is outside 0..2^32 - 1.
    """
    return max(round(require_range("t", t, low=0.0, high=2**32 - 1) * 1e9), 1)


def buttons(stamped: StampedCommand) -> list[int]:
    """Engage and saturated as the buttons of a Joy."""
    return [int(stamped.engage), int(stamped.command.saturated)]


def require_pixels(image: Image) -> Any:
    """The pixels (height, width, 3) of an image; InputError if it is a JPEG."""
    if image.pixels.ndim != 3:
        raise InputError(
            "raw images: expected pixels (height, width, 3), got a JPEG; publish without raw_images"
        )
    return image.pixels


def sequence_of(frame_id: str, default: int) -> int:
    """The number after the # of a frame_id, else the default."""
    digits = frame_id.partition("#")[2]
    return int(digits) if digits.isdecimal() else default


def image_from_compressed(message: Any) -> Image:
    """Image of a CompressedImage; without a sequence in frame_id that of its header is used.

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
        InputError: it has another encoding, or too few bytes for its size.
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
    """Command of a Joy; further axes and buttons are ignored.

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
    """Status of a DiagnosticArray's first entry.

    Raises:
        InputError: the values are not exactly the fields of a status.
    """
    values = {item.key: json.loads(item.value) for item in message.status[0].values}
    expected = {field.name for field in dataclasses.fields(Status)}
    if set(values) != expected:
        raise InputError(
            f"expected the values {', '.join(sorted(expected))}, got {', '.join(sorted(values))}"
        )
    values["channels_us"] = tuple(values["channels_us"])
    return StampedStatus(message.header.stamp.to_nsec() / 1e9, Status(**values))
