"""Autopilot logs: bytes written by hand after the published formats give back the flight."""

import json
import os
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import read_flight_log, to_flight_table
from falconwing_kit.core.flight_table import FlightTable, read_flight_table, select_rows
from falconwing_kit.flight.tasks import LandingTask
from falconwing_kit.tools.bridge.autopilot_log import is_autopilot_log, read_autopilot_log
from falconwing_kit.tools.bridge.flight_file import read_flight
from falconwing_kit.tools.bridge.log_mapping import (
    Channel,
    CommandMapping,
    LogMapping,
    PoseMapping,
)
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.trials.trials import fly_trial
from tests.tools.bridge.autopilot_logs import (
    ardupilot_messages,
    dataflash_bytes,
    microseconds,
    px4_topics,
    ulog_bytes,
)
from tests.tools.bridge.ros2_logs import turns

if not all(map(find_spec, ("pyulog", "pymavlink"))):
    if os.environ.get("CI"):
        pytest.fail("expected the libraries that read the logs: `pip install '.[logs]'`")
    pytest.skip("needs `pip install '.[logs]'`", allow_module_level=True)


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> FlightTable:
    """A landing of three seconds, SIMULATED by the kit."""
    path = tmp_path_factory.mktemp("flown") / "flight.mcap"
    task = LandingTask()
    fly_trial(task, task.expert, 0, log=path)
    table = to_flight_table(read_flight_log(path))
    return select_rows(table, np.flatnonzero(table.has_pose))


@pytest.fixture
def ulog(flight, tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(ulog_bytes(px4_topics(flight)))
    return path


@pytest.fixture
def dataflash(flight, tmp_path):
    path = tmp_path / "flight.bin"
    path.write_bytes(dataflash_bytes(ardupilot_messages(flight)))
    return path


def test_a_ulog_gives_back_the_flight(flight, ulog):
    """The poses that were written, from the first one on: 32-bit floats of 100 m have 8 um, unit
    quaternions 1e-7; commands as given; the velocity is the positions' difference.
    """
    table = read_autopilot_log(ulog)
    assert table.t == pytest.approx(flight.t - flight.t[0], abs=2e-6)
    assert table.p_world == pytest.approx(flight.p_world - flight.p_world[0], abs=2e-5)
    assert table.attitude == pytest.approx(flight.attitude, abs=2e-6)
    assert table.commands == pytest.approx(flight.commands, abs=2e-6)
    v_world = np.gradient(flight.p_world, flight.t, axis=0)
    assert np.column_stack([table.extra[k] for k in ("vx", "vy", "vz")]) == pytest.approx(
        v_world, abs=1e-5
    )
    assert [sentence.partition(": ")[2] for sentence in table.warnings] == [
        "commands of actuator_controls, as given to the mixer",
        "world: x north, y west, z up, origin at the first pose",
    ]


def test_a_dataflash_log_gives_back_the_flight(flight, dataflash):
    """Angles are logged as hundredths of a degree, so within half of one; of the two filters the
    second, 50 m further north, is not mixed in.
    """
    table = read_autopilot_log(dataflash)
    assert table.p_world == pytest.approx(flight.p_world - flight.p_world[0], abs=2e-5)
    turn = (table.attitude - flight.attitude + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(turn).max() < np.radians(0.0051)
    assert table.commands == pytest.approx(flight.commands, abs=2e-6)
    assert len(table.t) == len(flight.t) and table.has_pose.all()


def test_north_is_x_and_west_is_y(flight, tmp_path):
    """By hand: 10 m north, 2 m east and 3 m up is (10, -2, 3); a runway that leads 90 deg to the
    left of north, to the west, makes it (-2, -10, 3).
    """
    line = np.linspace(0.0, 1.0, len(flight.t))[:, None] * [10.0, -2.0, 3.0]
    straight = replace(flight, p_world=line, attitude=0.0 * flight.attitude)
    topics = px4_topics(straight)
    ends = np.array([topics["vehicle_local_position"][1][k][-1] for k in "xyz"])
    assert ends == pytest.approx([13.0, -3.0, -103.0])  # 10 north, 2 east, 3 up of the offset
    path = tmp_path / "line.ulg"
    path.write_bytes(ulog_bytes(topics))
    assert read_autopilot_log(path).p_world[-1] == pytest.approx([10.0, -2.0, 3.0], abs=1e-4)
    west = LogMapping(pose=PoseMapping(runway_deg=90.0))
    table = read_autopilot_log(path, west)
    assert table.p_world[-1] == pytest.approx([-2.0, -10.0, 3.0], abs=1e-4)
    assert table.attitude[:, 2] == pytest.approx(np.pi / 2, abs=1e-6)  # nose 90 deg to its right
    placed = LogMapping(pose=PoseMapping(origin_m=(3.0, -5.0, -99.0)))
    assert read_autopilot_log(path, placed).p_world[0] == pytest.approx([0, 0, 1.0], abs=1e-4)


def test_attitudes_of_other_times_lie_on_the_arcs_between(tmp_path):
    """Positions at 10 Hz, attitudes at 50 Hz and 7 ms later: those of the turn itself at the time
    of each position; none after a pause of the attitudes.
    """
    fine = turns(seconds=8.0, rate_hz=1000.0)
    table = FlightTable("turns", fine.t, fine.p_world, fine.attitude, np.zeros((len(fine.t), 4)))
    slow, fast = np.arange(20, 7900, 100), np.arange(7, 8000, 20)
    fast = fast[(fast < 4000) | (fast > 4500)]
    topics = px4_topics(select_rows(table, slow))
    attitudes = px4_topics(select_rows(table, fast))
    path = tmp_path / "turns.ulg"
    path.write_bytes(ulog_bytes({**topics, "vehicle_attitude": attitudes["vehicle_attitude"]}))
    found = read_autopilot_log(path)
    known = found.has_pose
    assert (~known).sum() == 5  # at 4.02, 4.12 and so on to 4.42 s
    assert np.flatnonzero(~known) == pytest.approx(np.flatnonzero((slow > 4000) & (slow < 4500)))
    assert found.attitude[known] == pytest.approx(fine.attitude[slow][known], abs=2e-4)


def test_torque_and_thrust_of_newer_versions_are_the_commands(flight, tmp_path):
    """PX4 1.14 logs torque and thrust in place of the controls; surfaces that were not commanded
    are nan, which is left out.
    """
    topics = dict(px4_topics(flight))
    _, columns = topics.pop("actuator_controls_0")
    t, control = columns["timestamp"], columns["control"]
    torque, thrust = control[:, :3].copy(), np.zeros((len(t), 3))
    thrust[:, 0] = control[:, 3]
    torque[0] = np.nan
    form = ["uint64_t timestamp", "float[3] xyz"]
    topics["vehicle_torque_setpoint"] = form, {"timestamp": t, "xyz": torque}
    topics["vehicle_thrust_setpoint"] = form, {"timestamp": t, "xyz": thrust}
    path = tmp_path / "new.ulg"
    path.write_bytes(ulog_bytes(topics))
    table = read_autopilot_log(path)
    assert table.commands == pytest.approx(flight.commands[1:], abs=2e-6)
    assert any("not finite, left out: 1" in sentence for sentence in table.warnings)


def test_a_mapping_names_other_channels(flight, tmp_path):
    """Pulses of a second output with elevator reversed; and ArduPilot's, in the usual order."""
    topics = dict(px4_topics(flight))
    throttle, aileron, elevator, rudder = flight.commands.T
    pulses = np.column_stack(
        [1000 + 1000 * throttle, 1500 - 400 * elevator, 1500 + 400 * aileron, 1500 + 500 * rudder]
    )
    form = ["uint64_t timestamp", "float[4] output"]
    columns = {"timestamp": microseconds(flight.t), "output": pulses}
    topics["actuator_outputs:1"] = form, columns
    topics["actuator_outputs"] = form, {**columns, "output": 0.0 * pulses}
    path = tmp_path / "pulses.ulg"
    path.write_bytes(ulog_bytes(topics, {"actuator_outputs:1": 1}))
    mapping = CommandMapping(
        topic="actuator_outputs:1", channels=("throttle", "elevator", "aileron", "rudder"),
        throttle=Channel(1000, 2000), elevator=Channel(1500, 1100), aileron=Channel(1500, 1900),
        rudder=Channel(1500, 2000),
    )  # fmt: skip
    table = read_autopilot_log(path, LogMapping("own", commands=mapping))
    assert table.commands == pytest.approx(flight.commands, abs=2e-6)
    assert set(table.labels["source"]) == {"own"}

    path = tmp_path / "outputs.bin"
    messages = ardupilot_messages(flight)
    path.write_bytes(dataflash_bytes({k: m for k, m in messages.items() if k != "AETR"}))
    table = read_autopilot_log(path)
    assert table.commands == pytest.approx(flight.commands, abs=0.0021)  # whole microseconds
    assert any("usual order aileron, elevator, throttle, rudder" in s for s in table.warnings)


def test_invalid_positions_are_no_poses_and_jumps_are_counted(flight, tmp_path):
    """Three positions that the estimator itself calls invalid, and one reset."""
    topics = dict(px4_topics(flight))
    fields, columns = topics["vehicle_local_position"]
    valid, resets = np.ones(len(flight.t), bool), np.zeros(len(flight.t), int)
    valid[10:13], resets[20:] = False, 1
    columns = {**columns, "xy_valid": valid, "xy_reset_counter": resets}
    path = tmp_path / "lost.ulg"
    path.write_bytes(ulog_bytes({**topics, "vehicle_local_position": (fields, columns)}))
    table = read_autopilot_log(path)
    assert np.flatnonzero(~table.has_pose).tolist() == [10, 11, 12]
    assert any("jumps of the estimated position: 1" in s for s in table.warnings)


def test_verbs_take_autopilot_logs(flight, ulog, dataflash, tmp_path, capsys):
    """`export` writes the table that the reader gives, cut by time where asked; `identify` and
    `gap` read the same file.
    """
    words = ["export", str(ulog), "--out", str(tmp_path), "--json"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["rows with a pose"] == len(flight.t)
    table = read_flight_table(tmp_path / "flight.csv")
    assert np.array_equal(table.p_world, read_flight(ulog).p_world)
    words = ["export", str(dataflash), "--out", str(tmp_path / "cut.csv")]
    assert main([*words, "--begin", "1", "--end", "2.02"]) == 0
    assert main([*words, "--begin", "1", "--to", "bag"]) == 2
    assert "--begin: expected --to csv" in capsys.readouterr().err
    times = read_flight_table(tmp_path / "cut.csv").t
    assert times == pytest.approx(1.0 + 0.05 * np.arange(21), abs=1e-5)
    slow = read_flight(ulog, rate_hz=10.0)
    assert np.diff(slow.t) == pytest.approx(0.1, abs=1e-5)


@pytest.mark.parametrize(
    ("left_out", "sentence"),
    [
        ("vehicle_attitude", "got no vehicle_attitude"),
        ("vehicle_local_position", "got no vehicle_local_position"),
        ("actuator_controls_0", "commands.topic: expected commands, got none of"),
    ],
)
def test_a_log_without_a_part_is_one_sentence(flight, tmp_path, left_out, sentence):
    """Which topic is missing, and what the log has."""
    topics = {name: topic for name, topic in px4_topics(flight).items() if name != left_out}
    path = tmp_path / "part.ulg"
    path.write_bytes(ulog_bytes(topics))
    with pytest.raises(InputError, match=sentence):
        read_autopilot_log(path)


@pytest.mark.parametrize(
    ("mapping", "sentence"),
    [
        (LogMapping(pose=PoseMapping(topic="x")), "pose.topic: expected none"),
        (LogMapping(pose=PoseMapping(world="enu")), "pose.world: expected ned"),
        (LogMapping(commands=CommandMapping(topic="x")), "got no message of x"),
    ],
)
def test_a_mapping_that_cannot_be_meant_is_refused(ulog, dataflash, mapping, sentence):
    """The same sentence for both kinds."""
    for path in (ulog, dataflash):
        with pytest.raises(InputError, match=sentence):
            read_autopilot_log(path, mapping)


@pytest.mark.parametrize("kind", ["ulog", "dataflash"])
def test_damaged_logs_are_read_or_refused(ulog, dataflash, tmp_path, kind, capfd):
    """150 files with flipped bytes, cut ends and missing blocks: a table or one sentence, nothing
    printed.
    """
    rng = np.random.default_rng(5)
    data = (ulog if kind == "ulog" else dataflash).read_bytes()
    path, read = tmp_path / "damaged", 0
    for _ in range(150):
        damaged = bytearray(data)
        a = int(rng.integers(8, len(data)))
        match rng.integers(3):
            case 0:
                for at in rng.integers(8, len(data), 5):
                    damaged[at] = int(rng.integers(256))
            case 1:
                del damaged[a:]
            case 2:
                del damaged[a : a + int(rng.integers(1, 200))]
        path.write_bytes(damaged)
        try:
            table = read_autopilot_log(path)
        except InputError as error:
            assert "damaged: " in str(error) and "\n" not in str(error)
            continue
        read += 1
        assert np.isfinite(table.commands).all() and (np.diff(table.t) > 0).all()
    assert read > 50
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("library", ["pyulog", "pymavlink"])
def test_a_missing_library_is_one_sentence(ulog, dataflash, monkeypatch, capsys, library):
    """With the command that installs the extra."""
    for module in [m for m in sys.modules if m.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    path = ulog if library == "pyulog" else dataflash
    assert main(["identify", str(path)]) == 2
    error = capsys.readouterr().err
    assert f"expected the library {library}" in error and error.count("\n") == 1
    assert 'pip install "falconwing-kit[logs]"' in error


def test_other_files_are_none(tmp_path):
    """By the first bytes, not by the name."""
    for name, content in (("a.ulg", b""), ("a.bin", b"\xa3\x95"), ("a.csv", b"t,px\n")):
        (tmp_path / name).write_bytes(content)
        assert not is_autopilot_log(tmp_path / name)
    with pytest.raises(InputError, match="expected a log of PX4"):
        read_autopilot_log(tmp_path / "a.ulg")
    with pytest.raises(FileNotFoundError):
        read_flight(tmp_path / "absent.ulg")
    (tmp_path / "flight.csv").write_text("t\n")
    with pytest.raises(InputError, match="--rate-hz: expected a log of ROS 2"):
        read_flight(tmp_path / "flight.csv", rate_hz=20.0)
