"""Bags: what a flight log becomes, as ROS's own `rosbag` reads it, in a Python that does not know
the kit.
"""

import json
import os
import shutil
import signal
import subprocess
import time
from base64 import b64encode
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.tools.bridge.bag import write_bag, write_ros2_bag
from falconwing_kit.tools.bridge.bus import COMMAND, IMAGE
from falconwing_kit.tools.bridge.ros import RosBus
from falconwing_kit.tools.bridge.ros2_log import is_ros_log, read_ros2_log

SYSTEM_PYTHON = "/usr/bin/python3"  # the distribution's, where its rosbag is installed
START = 1.7e9  # a time of today: seconds since 1970
READ = """
import json, sys
from base64 import b64encode
import rosbag
def plain(x):
    if isinstance(x, bytes): return b64encode(x).decode()
    if hasattr(x, "to_nsec"): return x.to_nsec()
    if hasattr(x, "__slots__"): return {name: plain(getattr(x, name)) for name in x.__slots__}
    return list(x) if isinstance(x, (list, tuple)) else x
with rosbag.Bag(sys.argv[1]) as bag:
    messages = bag.read_messages()
    print(json.dumps([[topic, t.to_nsec(), m._type, plain(m)] for topic, m, t in messages]))
"""


@pytest.fixture(scope="module")
def rosbag():
    """Reader by ROS's own rosbag: list of [topic, time in ns, type, message as a dict]."""
    if not Path(SYSTEM_PYTHON).exists() or subprocess.call([SYSTEM_PYTHON, "-c", "import rosbag"]):
        refuse = pytest.fail if os.environ.get("CI") else pytest.skip
        refuse("expected ROS's rosbag to read back what was written: `apt install python3-rosbag`")

    def read(path: Path) -> list:
        done = subprocess.run(
            [SYSTEM_PYTHON, "-c", READ, str(path)], capture_output=True, text=True, check=True
        )
        return json.loads(done.stdout)

    return read


@pytest.fixture
def log(tmp_path):
    """Twenty frames of a turning climb, each command 30 ms after its image, two events; one state
    is not known.
    """
    with FlightLogWriter(tmp_path / "flight.mcap") as writer:
        writer.metadata({"simulated": "yes"})
        for k in range(20):
            t = START + 0.05 * k
            rates = np.array([0.1, 0.2, 0.3])
            state = State(
                np.array([0.3 * k, -2.0, 1.0]),
                0.2,
                0.01 * k,
                -0.3,
                np.array([6.0, 0.5, 1.0]),
                rates,
            )
            lost = State.from_vector(np.full(12, np.nan))
            writer.state(t, lost if k == 7 else state, image_sequence=k + 100)
            jpeg = np.frombuffer(b"\xff\xd8" + bytes([k]) * 50, np.uint8)
            writer.command(
                t + 0.03,
                Command(0.05 * k, 0.1, -0.2, 0.3, k + 100, k == 3),
                Image(k + 100, t, jpeg),
            )
        writer.event(START, "engaged", {"by": "pilot"})
        writer.event(START + 0.95, "touchdown", {"speed": 6.5})
    return read_flight_log(tmp_path / "flight.mcap")


def test_rosbag_reads_every_record_with_its_time(log, tmp_path, rosbag):
    """20 frames by hand; times as logged, to the microsecond that 64 bits of seconds since 1970
    keep; in order.
    """
    counts = write_bag(tmp_path / "flight.bag", log)
    assert counts == {
        "/falconwing/image": 20, "/falconwing/command": 20, "/falconwing/pose": 20,
        "/falconwing/twist": 20, "/falconwing/event": 2, "/falconwing/metadata": 1,
    }  # fmt: skip
    records = rosbag(tmp_path / "flight.bag")
    assert {topic: sum(r[0] == topic for r in records) for topic in counts} == counts
    times = [t / 1e9 for _, t, _, _ in records]
    assert times == sorted(times)
    for topic, delay in (
        ("/falconwing/image", 0.0),
        ("/falconwing/command", 0.03),
        ("/falconwing/pose", 0.0),
    ):
        got = np.array(
            [(t / 1e9, m["header"]["stamp"] / 1e9) for name, t, _, m in records if name == topic]
        )
        assert got == pytest.approx(
            np.column_stack([START + 0.05 * np.arange(20) + delay] * 2), rel=0, abs=1e-6
        )


def test_images_and_commands_are_what_was_logged(log, tmp_path, rosbag):
    """Each JPEG byte by byte, each control input to 32 bits; the command has its image's number."""
    write_bag(tmp_path / "flight.bag", log)
    records = rosbag(tmp_path / "flight.bag")
    images = [m for topic, _, _, m in records if topic == "/falconwing/image"]
    commands = [m for topic, _, _, m in records if topic == "/falconwing/command"]
    for k, (image, command) in enumerate(zip(images, commands, strict=True)):
        assert (
            image["data"] == b64encode(b"\xff\xd8" + bytes([k]) * 50).decode()
            and image["format"] == "jpeg"
        )
        assert (image["header"]["seq"], image["header"]["frame_id"]) == (
            k + 100,
            f"camera#{k + 100}",
        )
        assert command["axes"] == pytest.approx([0.05 * k, 0.1, -0.2, 0.3], abs=1e-7)
        assert (
            command["buttons"] == [0, int(k == 3)]
            and command["header"]["frame_id"] == f"image#{k + 100}"
        )


def test_a_played_bag_looks_like_a_flight_to_a_controller(log, tmp_path, ros_master, rosbag):
    """ROS's own player sends images and commands, and they arrive with the sequences and bytes of
    the log, in order.

    The newest wins, so a busy machine may miss some of the twenty; half of them and the last must
    come.
    """
    write_bag(tmp_path / "flight.bag", log)
    play = [
        "rosbag",
        "play",
        "-q",
        "--wait-for-subscribers",
        str(tmp_path / "flight.bag"),
        "--topics",
        IMAGE,
        COMMAND,
    ]
    seen, answered, end = [], [], time.monotonic() + 60.0
    with closing(RosBus()) as bus:
        images, commands = bus.subscribe(IMAGE), bus.subscribe(COMMAND)
        with subprocess.Popen(play, start_new_session=True) as played:
            while played.poll() is None and time.monotonic() < end:
                seen += [image for image in [images.take(0.01)] if image is not None]
                answered += [sticks for sticks in [commands.take()] if sticks is not None]
            if played.poll() is None:
                os.killpg(played.pid, signal.SIGKILL)
    assert played.returncode == 0
    for sequences in ([x.sequence for x in seen], [x.command.image_sequence for x in answered]):
        assert sequences == sorted(set(sequences)) and len(sequences) >= 10
        assert sequences[0] >= 100 and sequences[-1] == 119
    assert all(
        image.pixels.tobytes() == b"\xff\xd8" + bytes([image.sequence - 100]) * 50 for image in seen
    )
    assert not any(
        sticks.engage for sticks in answered
    )  # a log does not know it; a played bag flies nothing


def test_pose_and_twist_are_those_of_ros_axes(log, tmp_path, rosbag):
    """scipy turns the quaternion into a matrix: its columns are nose, left wing and up. A turn rate
    is a vector.
    """
    write_bag(tmp_path / "flight.bag", log)
    records = rosbag(tmp_path / "flight.bag")
    poses = [m["pose"] for topic, _, _, m in records if topic == "/falconwing/pose"]
    twists = [m["twist"] for topic, _, _, m in records if topic == "/falconwing/twist"]
    for k, (pose, twist) in enumerate(zip(poses, twists, strict=True)):
        if k == 7:
            assert all(
                np.isnan(list(part.values())).all() for part in (*pose.values(), *twist.values())
            )
            continue
        R_world_body = rotation_world_body(-0.3, 0.2, 0.01 * k)
        R_world_ros = Rotation.from_quat([pose["orientation"][name] for name in "xyzw"]).as_matrix()
        assert R_world_ros == pytest.approx(
            R_world_body * [1.0, -1.0, -1.0], abs=1e-12
        )  # left and up: turned over
        assert list(pose["position"].values()) == pytest.approx([0.3 * k, -2.0, 1.0])
        assert list(twist["linear"].values()) == pytest.approx([6.0, 0.5, 1.0])
        assert list(twist["angular"].values()) == pytest.approx(
            R_world_body @ [0.1, 0.2, 0.3], abs=1e-12
        )


def test_nose_up_is_a_turn_from_x_to_z(tmp_path, rosbag):
    """By hand: nose up by 90 deg turns x into z, a turn about -y, so the quaternion is (0, -sin 45,
    0, cos 45).
    """
    with FlightLogWriter(tmp_path / "up.mcap") as writer:
        writer.state(0.0, State(np.zeros(3), np.pi / 2, 0.0, 0.0, np.zeros(3)))
    write_bag(tmp_path / "up.bag", read_flight_log(tmp_path / "up.mcap"))
    (_, t, _, pose), _ = rosbag(tmp_path / "up.bag")
    assert list(pose["pose"]["orientation"].values()) == pytest.approx(
        [0.0, -(0.5**0.5), 0.0, 0.5**0.5]
    )
    assert t == 1  # the log's zero: a stamp of 0 ns would mean "no time" in ROS


def test_events_and_metadata_are_json(log, tmp_path, rosbag):
    """A bag says for itself that its flight was simulated."""
    write_bag(tmp_path / "flight.bag", log)
    texts = [
        (topic, json.loads(m["data"]))
        for topic, _, kind, m in rosbag(tmp_path / "flight.bag")
        if kind == "std_msgs/String"
    ]
    assert texts == [
        ("/falconwing/metadata", {"simulated": "yes"}),
        ("/falconwing/event", {"name": "engaged", "details": {"by": "pilot"}}),
        ("/falconwing/event", {"name": "touchdown", "details": {"speed": 6.5}}),
    ]


def test_a_bag_is_there_whole_or_not_at_all(log, tmp_path, monkeypatch):
    """The log's file is taken away while its images are read: the older bag stays and nothing lies
    beside it.
    """
    (tmp_path / "flight.bag").write_text("an older bag")
    shutil.move(log.path, tmp_path / "away.mcap")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError):
        write_bag(tmp_path / "flight.bag", log)
    assert (
        sorted(tmp_path.iterdir()) == before
        and (tmp_path / "flight.bag").read_text() == "an older bag"
    )


def test_a_place_that_is_no_file_is_refused(log, tmp_path):
    """One sentence, before anything is read."""
    with pytest.raises(InputError, match="expected the name of a file to write, got a folder"):
        write_bag(tmp_path, log)
    with pytest.raises(FileNotFoundError, match="expected a folder"):
        write_bag(tmp_path / "none" / "flight.bag", log)


# A recording of ROS 2.


def read_ros2(folder: Path) -> list:
    """A recording as rosbags reads it: list of [topic, time in ns, type, message]."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(folder) as reader:
        return [
            [
                connection.topic,
                t,
                connection.msgtype,
                store.deserialize_cdr(raw, connection.msgtype),
            ]
            for connection, t, raw in reader.messages()
        ]


@pytest.fixture
def followed(tmp_path):
    """Sixty steps of a turn behind a leader, with images, each command at the time of its state."""
    t = 0.05 * np.arange(60)
    roll, yaw = 0.4 * np.sin(t), 0.8 * t - 1.0
    with FlightLogWriter(tmp_path / "followed.mcap") as writer:
        writer.metadata({"simulated": "yes", "scene": "hall"})
        for k in range(60):
            p = np.array([6.0 * t[k], -np.cos(t[k]), 1.0 + 0.1 * t[k]])
            state = State(p, 0.1 * np.cos(t[k]), yaw[k], roll[k], np.array([6.0, 0.5, 0.1]))
            writer.state(t[k], state, image_sequence=k)
            writer.leader(t[k], State(p + np.array([4.0, 0.0, 0.0]), 0.0, yaw[k], 0.0, np.zeros(3)))
            jpeg = np.frombuffer(b"\xff\xd8" + bytes([k]) * 50, np.uint8)
            command = Command(0.5 + 0.5 * np.sin(t[k]), roll[k], -0.2, 0.3 * np.cos(t[k]), k)
            writer.command(t[k], command, Image(k, t[k], jpeg))
        writer.event(1.0, "mode", {"mode": "turn"})
    return read_flight_log(tmp_path / "followed.mcap")


def test_rosbags_reads_the_recording_of_ros2(followed, tmp_path):
    """Sixty of each by hand; JPEG byte by byte, sticks to 32 bits, SciPy's attitude of the
    quaternions of aircraft and leader.
    """
    counts = write_ros2_bag(tmp_path / "flight.ros2", followed)
    assert counts == {
        **{f"/falconwing/{name}": 60 for name in ("image", "command", "pose", "twist")},
        "/tf": 60, "/falconwing/event": 1, "/falconwing/metadata": 1,
    }  # fmt: skip
    records = read_ros2(tmp_path / "flight.ros2")
    assert len(records) == sum(counts.values())
    times = [t for _, t, _, _ in records]
    assert times == sorted(times) and times[-1] == 2_950_000_000
    found = {topic: [m for name, _, _, m in records if name == topic] for topic in counts}
    for k in range(60):
        image, sticks = found["/falconwing/image"][k], found["/falconwing/command"][k]
        assert bytes(image.data) == b"\xff\xd8" + bytes([k]) * 50 and image.format == "jpeg"
        assert sticks.axes == pytest.approx(followed.commands[k].vector, abs=1e-7)
        (transform,) = found["/tf"][k].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("world", "leader")
        pose = found["/falconwing/pose"][k].pose
        for turn, place, state in (
            (pose.orientation, pose.position, followed.states[k]),
            (transform.transform.rotation, transform.transform.translation, followed.leaders[k]),
        ):
            R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
            R_world_body = rotation_world_body(state.roll, state.pitch, state.yaw)
            assert R_world_body * [1.0, -1.0, -1.0] == pytest.approx(R, abs=1e-12)
            assert [place.x, place.y, place.z] == state.p_world.tolist()
    (text,) = found["/falconwing/metadata"]
    assert json.loads(text.data) == {"simulated": "yes", "scene": "hall"}


def test_a_recording_of_ros2_comes_back_as_the_same_flight(followed, tmp_path):
    """The kit's own reader needs no mapping: times, poses and commands are those of the log, to
    the reader's millionths and the 32 bits of a Joy; nothing is guessed.
    """
    write_ros2_bag(tmp_path / "flight.ros2", followed)
    assert is_ros_log(tmp_path / "flight.ros2")
    table = read_ros2_log(tmp_path / "flight.ros2")
    assert table.warnings == () and table.has_pose.all()
    assert table.t == pytest.approx(followed.state_times, abs=1e-6)
    states = np.array([state.vector for state in followed.states])
    assert table.p_world == pytest.approx(states[:, :3], abs=1e-6)
    assert table.attitude == pytest.approx(states[:, [5, 3, 4]], abs=1e-6)
    commands = np.array([command.vector for command in followed.commands])
    assert table.commands == pytest.approx(commands, abs=2e-6)


def test_a_recording_of_ros2_is_there_whole_or_not_at_all(followed, tmp_path):
    """A folder that is there is kept, a log that vanishes leaves nothing, an empty one is refused:
    each time nothing else is written.
    """
    write_ros2_bag(tmp_path / "flight.ros2", followed)
    with pytest.raises(InputError, match="expected a new folder"):
        write_ros2_bag(tmp_path / "flight.ros2", followed)
    with pytest.raises(FileNotFoundError, match="expected a folder"):
        write_ros2_bag(tmp_path / "none" / "flight.ros2", followed)
    with FlightLogWriter(tmp_path / "empty.mcap"):
        pass
    shutil.move(followed.path, tmp_path / "away.mcap")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError):
        write_ros2_bag(tmp_path / "other.ros2", followed)
    with pytest.raises(InputError, match="expected a log with records"):
        write_ros2_bag(tmp_path / "other.ros2", read_flight_log(tmp_path / "empty.mcap"))
    assert sorted(tmp_path.iterdir()) == before
