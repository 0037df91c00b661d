"""Logs of ROS 2: flights of known poses and commands, written by rosbags, against their tables."""

import json

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.data import data_path
from falconwing_kit.tools.bridge.axes import sideways_residuals
from falconwing_kit.tools.bridge.log_mapping import (
    Channel,
    CommandMapping,
    LogMapping,
    PoseMapping,
    read_mapping,
)
from falconwing_kit.tools.bridge.ros2_log import is_ros_log, read_ros2_log, read_topics
from falconwing_kit.tools.bridge.ros2_messages import POSES
from falconwing_kit.tools.cli.main import main
from tests.tools.bridge.ros2_logs import (
    SAME,
    log_poses,
    numbers_message,
    pose_message,
    turns,
    write_flight,
    write_log,
)

PULSES = "std_msgs/msg/UInt16MultiArray"
STAMPED = "geometry_msgs/msg/PoseStamped"
ROUNDING = 1e-6  # of the table's numbers, half a unit of the last of six decimals and a bit


def timed_poses(t, p, q, kind=STAMPED):
    return [(at, pose_message(kind, at, *row)) for at, *row in zip(t, p, q, strict=True)]


def radio_at_rest(t):
    return [(at, numbers_message(PULSES, at, [1500] * 4)) for at in t[::5]]


@pytest.fixture(scope="module")
def flight():
    return turns()


@pytest.fixture(scope="module")
def log(flight, tmp_path_factory):
    """Usual order, z up, aileron with the roll rate: everything can be found in it."""
    return write_flight(tmp_path_factory.mktemp("logs") / "turns.mcap", flight)


@pytest.mark.parametrize("short", POSES)
def test_every_message_with_a_pose_gives_the_same_flight(flight, tmp_path, short):
    """The poses that were written, in order; a transform among others is chosen by its frame."""
    kind = short.replace("/", "/msg/")
    path = write_flight(tmp_path / "log.mcap", flight, kind=kind)
    table = read_ros2_log(path, LogMapping(pose=PoseMapping(frame="cub" if "tf2" in kind else "")))
    assert np.abs(table.t - flight.t).max() < ROUNDING
    assert np.abs(table.p_world - flight.p_world).max() < ROUNDING
    assert np.abs(np.sin(table.attitude - flight.attitude)).max() < ROUNDING


@pytest.mark.parametrize("world", ["enu", "ned"])
@pytest.mark.parametrize("body", ["flu", "frd"])
@pytest.mark.parametrize("runway_deg", [0.0, 125.0])
def test_axes_of_the_mapping_give_the_kits_poses(flight, tmp_path, world, body, runway_deg):
    """SciPy wrote the poses in these axes by the kit's definition of attitude; the reader undoes
    it. No warning: the flight obeys the law of flight in them.
    """
    path = write_flight(tmp_path / "log.mcap", flight, axes=(world, body, runway_deg))
    mapping = LogMapping(pose=PoseMapping(world=world, body=body, runway_deg=runway_deg))
    table = read_ros2_log(path, mapping)
    assert np.abs(table.p_world - flight.p_world).max() < ROUNDING
    assert np.abs(np.sin(table.attitude - flight.attitude)).max() < ROUNDING
    assert not [text for text in table.warnings if "axes given" in text or "the nose" in text]


@pytest.mark.parametrize("axes", [("enu", "flu"), ("enu", "frd"), ("ned", "flu"), ("ned", "frd")])
def test_axes_that_are_not_given_are_found_from_the_turns(flight, tmp_path, axes):
    """Lift lies in the plane of symmetry, so gravity and the turn cancel along the wing."""
    path = write_flight(tmp_path / "log.mcap", flight, axes=(*axes, 0.0))
    table = read_ros2_log(path)
    assert np.abs(table.p_world - flight.p_world).max() < ROUNDING
    assert np.abs(np.sin(table.attitude - flight.attitude)).max() < ROUNDING
    assert any(f"world {axes[0]}, body {axes[1]}" in text for text in table.warnings)


@pytest.mark.parametrize("wrong", [("enu", "frd"), ("ned", "flu"), ("ned", "frd")])
def test_axes_against_the_law_of_flight_are_reported(log, wrong):
    """The log has z up and x nose, y left, z up; the warning names these."""
    table = read_ros2_log(log, LogMapping(pose=PoseMapping(world=wrong[0], body=wrong[1])))
    assert any("world enu, body flu would obey it" in text for text in table.warnings)


def test_a_wrong_up_doubles_gravity_along_the_wing(flight):
    """By hand: sideways force 2 g sin(roll) over lift g / cos(roll) - 2 g cos(roll) + ... is far
    from zero; in the right axes it is zero but for the pitch of 3 deg and the differences.
    """
    p, q = log_poses(flight)
    residuals = sideways_residuals(flight.t, p, (SAME.from_quat(q)).as_matrix())
    assert residuals["enu", "flu"] < 0.05
    assert residuals["ned", "frd"] > 0.5
    assert np.isinf(residuals["enu", "frd"]) and np.isinf(residuals["ned", "flu"])


def test_a_nose_across_the_path_is_reported(flight, tmp_path):
    """The same poses with a body turned a quarter: its x axis is the wing."""
    p, q = log_poses(flight)
    q = (SAME.from_quat(q) * SAME.from_euler("z", 90.0, degrees=True)).as_quat()
    poses = timed_poses(flight.t, p, q)
    radio = radio_at_rest(flight.t)
    path = write_log(tmp_path / "log.mcap", {"/p": (STAMPED, poses), "/r": (PULSES, radio)})
    given = LogMapping(pose=PoseMapping(world="enu", body="flu"))
    assert any("the nose points 9" in text for text in read_ros2_log(path, given).warnings)


def test_a_stick_against_its_rate_is_reported(flight, tmp_path):
    """Aileron pulses that fall when the right wing goes down, as many radios send them."""
    times = np.arange(0.0, flight.t[-1], 0.1)
    rate = np.interp(times, flight.t, flight.roll_rate)
    sticks = np.column_stack([1500 - 500 * rate, *[1500 + 0 * times] * 3])
    path = write_flight(tmp_path / "log.mcap", flight, sticks=sticks)
    table = read_ros2_log(path)
    assert any("aileron moves against the roll rate" in text for text in table.warnings)
    mapping = LogMapping(commands=CommandMapping(aileron=Channel(1500, 1000)))
    right = read_ros2_log(path, mapping)
    assert not any("moves against" in text for text in right.warnings)
    assert np.abs(right.commands[:, 1] + table.commands[:, 1]).max() < ROUNDING


def test_a_stick_beyond_its_end_is_clipped_and_reported(flight, tmp_path):
    """By hand: three messages of 120 have 2040 us, 1.08 of full deflection; no silent clip."""
    sticks = np.full((120, 4), 1500)
    sticks[5:8, 1] = 2040
    table = read_ros2_log(write_flight(tmp_path / "log.mcap", flight, sticks=sticks))
    assert any("elevator beyond -1..1, clipped: 3" in text for text in table.warnings)
    assert table.commands[:, 2].max() == 1.0


@pytest.mark.parametrize(
    ("kind", "numbers", "channels"),
    [
        (PULSES, (1250, 1400, 2000, 1800), {}),
        ("std_msgs/msg/Float64MultiArray", (-0.5, -0.2, 1.0, 0.6), {}),
        ("std_msgs/msg/Float32MultiArray", (-50, -20, 100, 60), {"ends": (0.0, 100.0)}),
        ("sensor_msgs/msg/Joy", (0.5, 0.2, 1.0, -0.6), {"ends": (0.0, -1.0)}),
    ],
)
def test_numbers_become_commands(flight, tmp_path, kind, numbers, channels):
    """By hand: the same four sticks, -0.5, -0.2, full throttle and 0.6, in four units."""
    sticks = np.tile(numbers, (len(np.arange(0.0, flight.t[-1], 0.1)), 1))
    path = write_flight(tmp_path / "log.mcap", flight, command_kind=kind, sticks=sticks)
    ends = Channel(*channels.get("ends", (None, None)))
    throttle = Channel(0.0, 100.0) if "Float32" in kind else Channel()
    table = read_ros2_log(
        path,
        LogMapping(
            commands=CommandMapping(
                channels=("aileron", "elevator", "throttle", "rudder"),
                throttle=throttle, aileron=ends, elevator=ends, rudder=ends,
            )
        ),
    )  # fmt: skip
    assert table.commands == pytest.approx(np.tile([1.0, -0.5, -0.2, 0.6], (len(table.t), 1)))


def test_a_field_for_each_stick(flight, tmp_path):
    """Channels of their own: the odometry's twist stands in for a message with a field each."""
    times = np.arange(0.0, flight.t[-1], 0.1)
    sticks = timed_poses(times, [[0.25, -0.5, 0.75]] * len(times), [[1.0, 0, 0, 0]] * len(times))
    poses = timed_poses(flight.t, *log_poses(flight))
    path = write_log(tmp_path / "log.mcap", {"/p": (STAMPED, poses), "/manual": (STAMPED, sticks)})
    channels = {
        stick: Channel(0.0, 1.0, f"pose.position.{axis}")
        for stick, axis in (("aileron", "x"), ("elevator", "y"), ("throttle", "z"))
    }
    mapping = LogMapping(
        pose=PoseMapping(topic="/p"), commands=CommandMapping(topic="/manual", **channels)
    )
    table = read_ros2_log(path, mapping)
    assert table.commands[0] == pytest.approx([0.75, 0.25, -0.5, 0.0])
    assert any("no channel is the rudder" in text for text in table.warnings)


def test_commands_lie_on_the_lines_between_messages(flight, tmp_path):
    """By hand: aileron pulses 1500, 1501, ... at 0, 0.1, ...: 10 us a second, held at the end."""
    times = np.arange(0.0, flight.t[-1], 0.1)
    sticks = np.column_stack([1500 + np.arange(len(times)), *[1500 + 0 * times] * 3])
    table = read_ros2_log(write_flight(tmp_path / "log.mcap", flight, sticks=sticks))
    expected = np.minimum(flight.t * 10.0, len(times) - 1) / 500.0
    assert np.abs(table.commands[:, 1] - expected).max() < ROUNDING


def test_rows_at_a_lower_rate_are_measured_poses(flight, tmp_path):
    """Poses at 50 Hz to 11.98 s, rows at 12 Hz: 144 by hand, and every row is one of the poses, at
    most half of 1/50 s from its grid time. In a gap of the tracking rows have no pose.
    """
    lost = (flight.t > 4.0) & (flight.t < 5.0)
    p, q = log_poses(flight)
    poses = timed_poses(flight.t[~lost], p[~lost], q[~lost])
    radio = radio_at_rest(flight.t)
    path = write_log(tmp_path / "log.mcap", {"/p": (STAMPED, poses), "/r": (PULSES, radio)})
    table = read_ros2_log(path, rate_hz=12.0)
    grid, seen = np.arange(144) / 12.0, table.has_pose
    assert len(table.t) == 144
    assert np.abs(table.t - grid)[(grid < 4.0) | (grid > 5.0)].max() < 0.0101
    assert list(np.flatnonzero(~seen)) == list(range(49, 60))  # 4.08 to 4.92 s
    measured = {tuple(row) for row in np.round(flight.p_world, 6)}
    assert all(tuple(row) in measured for row in table.p_world[seen])
    with pytest.raises(InputError, match="at most the poses' own 50 Hz"):
        read_ros2_log(path, rate_hz=60.0)


def test_lost_and_repeated_poses_are_no_poses(flight, tmp_path):
    """Zeros, as many trackers send when they lose sight; and the last pose sent again."""
    p, q = (each.copy() for each in log_poses(flight))
    p[100:110], q[100:110] = 0.0, 0.0
    p[200:205], q[200:205] = p[199], q[199]
    poses = timed_poses(flight.t, p, q)
    radio = radio_at_rest(flight.t)
    table = read_ros2_log(
        write_log(tmp_path / "log.mcap", {"/p": (STAMPED, poses), "/r": (PULSES, radio)})
    )
    assert list(np.flatnonzero(~table.has_pose)) == [*range(100, 110), *range(200, 205)]


def test_stamps_of_another_clock_are_not_mixed_with_arrivals(flight, tmp_path):
    """Stamps an hour ahead of the arrivals: the arrivals are used for both, and that is said."""
    p, q = log_poses(flight)
    poses = [
        (t, pose_message(STAMPED, t + 3600.0, *row)) for t, *row in zip(flight.t, p, q, strict=True)
    ]
    radio = radio_at_rest(flight.t)
    path = write_log(tmp_path / "log.mcap", {"/p": (STAMPED, poses), "/r": (PULSES, radio)})
    table = read_ros2_log(path)
    assert np.abs(table.t - flight.t).max() < ROUNDING
    assert any("another clock" in text for text in table.warnings)


def test_an_interrupted_log_and_a_recording_in_two_files(flight, log, tmp_path):
    """Cut in the middle: the first part is read. Both halves in a folder: one flight."""
    data = log.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    table = read_ros2_log(tmp_path / "cut.mcap")
    assert 100 < len(table.t) < len(flight.t)
    assert any("interrupted" in text for text in table.warnings)
    p, q = log_poses(flight)
    (tmp_path / "recording").mkdir()
    for number, half in enumerate((slice(0, 300), slice(300, None))):
        poses = timed_poses(flight.t[half], p[half], q[half])
        radio = radio_at_rest(flight.t[half])
        write_log(
            tmp_path / "recording" / f"part_{number}.mcap",
            {"/p": (STAMPED, poses), "/r": (PULSES, radio)},
        )
    table = read_ros2_log(tmp_path / "recording")
    assert np.abs(table.p_world - flight.p_world).max() < ROUNDING


def test_topics_and_kind_of_a_log(log):
    """By hand: 600 poses at 50 Hz over 12 s, 120 commands at 10 Hz."""
    topics = {topic.name: (topic.type, topic.messages) for topic in read_topics(log)}
    assert topics == {
        "/drone/where": ("geometry_msgs/PoseStamped", 600),
        "/radio": ("std_msgs/UInt16MultiArray", 120),
    }
    assert is_ros_log(log)


@pytest.mark.parametrize(
    ("mapping", "sentence"),
    [
        ('[pose]\ntopic = "/cub/pose"', "/drone/where (geometry_msgs/PoseStamped, 600 messages)"),
        ('[commands]\ntopic = "/rc"', "/radio (std_msgs/UInt16MultiArray, 120 messages)"),
        ('[commands]\nchannels = ["ailerons", "elevator"]', "expected aileron, got 'ailerons'"),
        ('[commands]\nchannels = ["a", "b"]', "expected some of throttle, aileron"),
        ('[commands]\nchannels = ["aileron", "aileron"]', "expected aileron once"),
        ('[commands]\nfield = "layout"', "expected an array of numbers, got 'layout'"),
        ("[commands.throttle]\nzero = 1500\nfull = 1500", "expected different numbers"),
        ("[commands.throttle]\nzero = 100\nfull = 200", "correct zero and full"),
        ("[commands.throttle]\nidle = 1000", "unknown key 'commands.throttle.idle'"),
        ('[pose]\nworld = "up"', "expected one of enu, ned, got 'up'"),
        ('[pose]\nframe = "x"', "expected a frame of /drone/where"),
        ('source = "a,b"', "without commas"),
        ("[pose", "this is not TOML"),
    ],
)
def test_a_wrong_mapping_is_one_sentence_and_exit_2(log, tmp_path, capsys, mapping, sentence):
    """What was expected, what the log has, no traceback and no file."""
    (tmp_path / "map.toml").write_text(mapping)
    words = ["export", str(log), "--mapping", str(tmp_path / "map.toml"), "--out"]
    assert main([*words, str(tmp_path / "out.csv")]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("topics", "sentence"),
    [
        ({"/p": STAMPED}, "commands.topic: expected the name of a topic, for no topic"),
        ({"/p": STAMPED, "/q": STAMPED, "/r": PULSES}, "several topics of this log could be it"),
        ({"/r": PULSES}, "it has /r (std_msgs/UInt16MultiArray, 120 messages)"),
        ({"/p": STAMPED, "/r": "sensor_msgs/msg/Joy"}, "what the 4 numbers of /r are"),
    ],
)
def test_a_log_that_leaves_a_choice_lists_its_topics(flight, tmp_path, topics, sentence):
    """Nothing is guessed where two answers are possible, or where no order is usual."""
    p, q = log_poses(flight)
    messages = {
        kind: [(t, pose_message(kind, t, *row)) for t, *row in zip(flight.t, p, q, strict=True)]
        if kind == STAMPED
        else [(t, numbers_message(kind, t, [0, 0, 0, 0])) for t in flight.t[::5]]
        for kind in topics.values()
    }
    path = write_log(tmp_path / "log.mcap", {n: (k, messages[k]) for n, k in topics.items()})
    with pytest.raises(InputError) as caught:
        read_ros2_log(path)
    assert sentence in str(caught.value)


def test_the_verb_makes_a_table_that_the_kit_reads(flight, log, tmp_path, capsys):
    """Without a mapping: every guess is a warning; the source names the log in every row."""
    assert main(["export", str(log), "--out", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    table = read_flight_table(tmp_path / "turns.csv")
    assert report["rows"] == report["rows with a pose"] == len(table.t) == len(flight.t)
    assert len(report["warnings"]) == 6  # order, four ends, axes
    assert set(table.labels["source"]) == {"turns"}
    assert np.abs(table.p_world - flight.p_world).max() < ROUNDING


def test_other_options_are_refused_together(log, capsys):
    """A mapping is for a table of a log of ROS 2."""
    assert main(["export", str(log), "--mapping", "m.toml", "--to", "bag", "--out", "a.bag"]) == 2
    assert (
        "--mapping: expected a log of ROS 2, PX4 or ArduPilot and --to csv"
        in capsys.readouterr().err
    )


def test_the_shipped_mapping_is_read():
    """Its pulses of aileron fall when the right wing goes down, as its notes say."""
    mapping = read_mapping(data_path("sport_cub_mapping.toml"))
    assert mapping.commands.aileron == Channel(1500.0, 1000.0)
    assert (mapping.pose.world, mapping.pose.body) == ("enu", "flu")
