"""RosBus with other programs: a node in the system's Python without the kit, and their messages."""

import json
import math
import os
import subprocess
import sys
import time
from base64 import b64decode
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.tools.bridge.bus import COMMAND, IMAGE, STATUS, StampedCommand, StampedStatus
from falconwing_kit.tools.bridge.ros import RosBus, image_from_raw, load_ros, sequence_of, stamp_ns
from falconwing_kit.trainer_port.protocol import Status
from tests.tools.bridge.test_bus import NOW, PATIENCE, STAMP, until

ROOT = Path(__file__).resolve().parents[3]
SYSTEM_PYTHON = "/usr/bin/python3"  # the distribution's, where rospy is at home
# Prints what it hears of the kit's image, and publishes it again under its own frame_id; prints a
# status as text.
FOREIGN_NODE = """
import json, time
from base64 import b64encode
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CompressedImage, Joy
def say(**what): print(json.dumps(what), flush=True)
rospy.init_node("foreign", disable_signals=True)
back = rospy.Publisher("/falconwing/command", Joy, queue_size=1)
def image(m):
    age = time.time() - m.header.stamp.to_sec()
    say(age=age, bytes=b64encode(m.data).decode(), format=m.format,
        frame=m.header.frame_id, stamp=m.header.stamp.to_nsec())
    joy = Joy(axes=[0.5, -0.25, 2.0, 0.0, 9.0], buttons=[1])
    joy.header.stamp, joy.header.frame_id = m.header.stamp, m.header.frame_id
    back.publish(joy)
def status(m):
    first = m.status[0]
    values = {v.key: v.value for v in first.values}
    say(level=first.level, message=first.message, values=values)
rospy.Subscriber("/falconwing/status", DiagnosticArray, status, queue_size=1)
while not back.get_num_connections(): time.sleep(0.01)
rospy.Subscriber(
    "/falconwing/image", CompressedImage, image, queue_size=1, buff_size=2**22, tcp_nodelay=True
)
rospy.spin()
"""


@pytest.fixture
def bus(ros_master):
    """A bus through ROS."""
    opened = RosBus()
    yield opened
    opened.close()


@pytest.fixture
def foreign_node(ros_master):
    """The node above, in a process of its own."""
    with subprocess.Popen(
        [SYSTEM_PYTHON, "-c", FOREIGN_NODE], stdout=subprocess.PIPE, text=True
    ) as node:
        yield node
        node.kill()


def test_an_image_reaches_another_program_and_its_answer_comes_back(bus, foreign_node):
    """Random bytes behind a JPEG's first two arrive in a program that knows only ROS's own
    messages; the age that it sees is printed. Its Joy is read by hand: elevator 2 is cut to 1, a
    fifth axis is passed over.
    """
    rng = np.random.default_rng(3)
    inbox = bus.subscribe(COMMAND)
    until(lambda: bus.listeners(IMAGE) == 1)  # the node listens once its answers reach us
    ages = []
    for k in range(40):
        jpeg, t = b"\xff\xd8" + rng.bytes(30_000), time.time()
        bus.publish(IMAGE, Image(k + 7, t, np.frombuffer(jpeg, np.uint8)))
        heard = json.loads(foreign_node.stdout.readline())
        assert b64decode(heard["bytes"]) == jpeg and heard["format"] == "jpeg"
        assert heard["frame"] == f"camera#{k + 7}" and heard["stamp"] == pytest.approx(
            t * 1e9, abs=STAMP * 1e9
        )
        answer = inbox.take(PATIENCE)
        assert (
            answer.command == Command(0.5, -0.25, 1.0, 0.0, k + 7, saturated=True) and answer.engage
        )
        assert answer.t == pytest.approx(t, rel=0, abs=STAMP)
        ages.append(1e3 * heard["age"])
    print(
        f"\nimage of 30 kB to another process: median {np.median(ages):.1f}, "
        f"p95 {np.percentile(ages, 95):.1f} ms"
    )


def test_a_status_is_readable_without_the_kit(bus, foreign_node):
    """Level 2 is ERROR in diagnostic_msgs; every field is a text, as `rqt` shows it."""
    until(lambda: bus.listeners(STATUS) == 1)
    status = Status(
        "FAULT", "range", 2, 8, 10, 11, 1, 2, 5, 900, False, (1000, 1500, 1500, 1500), 77
    )
    bus.publish(STATUS, StampedStatus(NOW, status))
    heard = json.loads(foreign_node.stdout.readline())
    assert heard["level"] == 2 and heard["message"] == "FAULT (range)"
    assert (
        heard["values"]["out_of_range"] == "5"
        and heard["values"]["channels_us"] == "[1000, 1500, 1500, 1500]"
    )


def test_pixels_travel_raw_where_that_is_wished(ros_master):
    """Every pixel of a random image; JPEG could not do that. A JPEG is refused there with a
    sentence.
    """
    pixels = np.random.default_rng(4).integers(0, 256, (48, 64, 3), np.uint8)
    sender, receiver = RosBus(raw_images=True), RosBus()
    inbox = receiver.subscribe(IMAGE)
    until(lambda: sender.listeners(IMAGE) == 1)
    sender.publish(IMAGE, Image(5, NOW, pixels))
    got = inbox.take(PATIENCE)
    assert (got.pixels == pixels).all() and got.sequence == 5
    with pytest.raises(InputError, match="raw images: expected pixels"):
        sender.publish(IMAGE, Image(6, NOW, np.zeros(9, np.uint8)))
    sender.close()
    receiver.close()


@pytest.mark.parametrize(
    ("encoding", "step", "data", "rgb"),
    [
        (
            "rgb8",
            6,
            [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12],
            [[[1, 2, 3], [4, 5, 6]], [[7, 8, 9], [10, 11, 12]]],
        ),
        (
            "bgr8",
            6,
            [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12],
            [[[3, 2, 1], [6, 5, 4]], [[9, 8, 7], [12, 11, 10]]],
        ),
        ("mono8", 2, [1, 2, 3, 4], [[[1, 1, 1], [2, 2, 2]], [[3, 3, 3], [4, 4, 4]]]),
        ("mono8", 4, [1, 2, 0, 0, 3, 4, 0, 0], [[[1, 1, 1], [2, 2, 2]], [[3, 3, 3], [4, 4, 4]]]),
    ],
)
def test_camera_drivers_encodings_become_rgb(encoding, step, data, rgb):
    """Two by two pixels, worked by hand; rows may be padded. The count of the header stands in for
    our frame_id.
    """
    image = image_from_raw(raw_message(encoding, step, bytes(data)))
    assert image.pixels.tolist() == rgb and image.sequence == 4


def raw_message(encoding, step, data):
    """What rospy makes of a sensor_msgs/Image of two by two pixels from a foreign driver."""
    stamp = SimpleNamespace(to_nsec=lambda: int(NOW * 1e9))
    header = SimpleNamespace(seq=4, stamp=stamp, frame_id="usb_cam")
    return SimpleNamespace(
        header=header, height=2, width=2, encoding=encoding, step=step, data=data
    )


@pytest.mark.parametrize(
    ("encoding", "step", "data"),
    [("bayer_rggb8", 2, b"1234"), ("rgb8", 6, b"12345678901"), ("rgb8", 3, b"123456")],
)
def test_pixels_that_are_not_there_are_refused(encoding, step, data):
    """Another encoding, one byte too few, rows shorter than their pixels: one sentence each."""
    with pytest.raises(InputError, match="expected"):
        image_from_raw(raw_message(encoding, step, data))


def test_what_cannot_be_understood_is_counted_and_never_sent_on(bus):
    """A controller gone mad: no number, too few axes, no button; a PNG; another program's
    diagnostics. The good command after them arrives.
    """
    ros = load_ros()
    inboxes = {topic: bus.subscribe(topic) for topic in (COMMAND, IMAGE, STATUS)}
    bad = {
        COMMAND: [ros.Joy(axes=[math.nan, 0, 0, 0], buttons=[1]),
                  ros.Joy(axes=[0, 0, 0], buttons=[1]), ros.Joy(axes=[0, 0, 0, 0]),
                  ros.Joy(axes=[math.inf, 0, 0, 0], buttons=[1])],
        IMAGE: [ros.CompressedImage(format="png", data=b"\x89PNG")],
        STATUS: [ros.DiagnosticArray(),
                 ros.DiagnosticArray(status=[ros.DiagnosticStatus(name="battery")])],
    }  # fmt: skip
    for topic, messages in bad.items():
        until(lambda topic=topic: bus.listeners(topic) == 1)
        for number, message in enumerate(messages, 1):
            bus._publisher(topic).publish(message)
            until(lambda topic=topic, number=number: bus.refused[topic] == number)
    assert all(inbox.take() is None for inbox in inboxes.values())
    assert bus.last_refusal.startswith(
        "/falconwing/status: expected the values accepted, bad_frames"
    )
    bus.publish(COMMAND, StampedCommand(NOW, Command(0.5, 0.0, 0.0, 0.0), engage=True))
    assert inboxes[COMMAND].take(PATIENCE).command.throttle == 0.5


def test_without_a_master_or_rospy_one_sentence_says_what_to_do(ros_master, monkeypatch):
    """rospy itself would wait for a master for ever; port 9 is nobody's."""
    with monkeypatch.context() as patch:
        patch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9")
        with pytest.raises(
            InputError,
            match=r"expected a master at http://127.0.0.1:9, got no answer; start `roscore`",
        ):
            RosBus()
    monkeypatch.setitem(sys.modules, "rospy", None)
    with pytest.raises(InputError, match=r"expected Debian's rospy .* `apt install python3-rospy"):
        RosBus()


def test_the_distributions_packages_come_last(ros_master):
    """A fresh Python: with rospy loaded, NumPy is still the environment's; importing the adapter
    alone loads no ROS.
    """
    code = (
        "import sys, falconwing_kit.tools.bridge.ros as ros; assert 'rospy' not in sys.modules;"
        "path = list(sys.path); ros.load_ros(); import numpy;"
        "print(sys.path[:len(path)] == path, sys.path[len(path):], numpy.__file__)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    same, rest = done.stdout.split(" ", 1)
    assert same == "True" and rest.startswith(("[]", "['/usr/lib/python3/dist-packages']"))
    assert "/usr/lib/python3/dist-packages/numpy" not in rest


def test_a_stamp_is_never_none_and_a_sequence_may_be():
    """ROS takes zero for "no stamp"; 32 bits of seconds end in 2106. By hand: 1.5 s are
    1,500,000,000 ns.
    """
    assert [stamp_ns(0.0), stamp_ns(1.5)] == [1, 1_500_000_000]
    for t in (-1.0, math.nan, 2.0**32):
        with pytest.raises(InputError, match="t: expected a finite number"):
            stamp_ns(t)
    assert [
        sequence_of(text, -1) for text in ("camera#17", "camera", "camera#", "camera#x", "#-3")
    ] == [
        17,
        -1,
        -1,
        -1,
        -1,
    ]
