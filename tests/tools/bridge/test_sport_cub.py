"""The recorded Sport Cub flight: the shipped table against the log, and against laws of flight."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.core.frames import rotation_world_body, wrap_angle
from falconwing_kit.data import data_path, load_flight
from falconwing_kit.tools.bridge.axes import stick_correlations
from falconwing_kit.tools.cli.main import main

LOG = (
    Path(__file__).resolve().parents[4] / "shared/data/sportcub_mocap/cub_stabilize_2025_11_13.mcap"
)


@pytest.fixture(scope="module")
def flight() -> FlightTable:
    return load_flight("sport_cub")


@pytest.fixture(scope="module")
def log() -> Path:
    if not LOG.is_file():
        pytest.skip(f"the Sport Cub's log is not beside this checkout: {LOG} is missing")
    return LOG


def test_the_shipped_table_is_the_log(log: Path, tmp_path: Path) -> None:
    """The command of the data's README, typed on the published file: the same bytes."""
    shutil.copyfile(data_path("sport_cub_mapping.toml"), tmp_path / "mapping.toml")
    words = ["export", str(log), "--mapping", str(tmp_path / "mapping.toml"), "--rate-hz", "20"]
    assert main([*words, "--out", str(tmp_path / "again.csv")]) == 0
    assert (tmp_path / "again.csv").read_bytes() == data_path("sport_cub.csv").read_bytes()


def test_a_pose_and_a_command_are_those_of_the_file(log: Path, flight: FlightTable) -> None:
    """The mcap library's reader and struct, none of the kit's code: the last 56 bytes of a
    PoseStamped are seven doubles, the last ten bytes of five uint16 the pulses. Sticks lie between
    their messages.
    """
    poses, pulses = set(), []
    with log.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic == "/cub1/pose":
                poses.add(struct.unpack("<7d", message.data[-56:])[:3])
            else:
                sticks = np.frombuffer(message.data[:-2], np.uint16)[-5:]
                pulses.append(sticks[:4])
    assert len(poses) == 19_703
    rounded = {tuple(p) for p in np.round(list(poses), 6).tolist()}
    seen = flight.p_world[flight.has_pose]
    assert all(tuple(row) in rounded for row in seen.tolist())
    throttle, aileron, elevator, rudder = flight.commands.T
    us = np.column_stack([1500 - 500 * aileron, 1500 - 500 * elevator, 1000 + 1000 * throttle,
                          1500 + 500 * rudder])  # fmt: skip
    # Each row lies between two messages that follow one another, and they follow in time.
    ends = np.stack([np.array(pulses[:-1], float), np.array(pulses[1:], float)])
    low, high = ends.min(axis=0) - 0.01, ends.max(axis=0) + 0.01
    first = 0
    for row in us:
        between = np.all((low[first:] <= row) & (row <= high[first:]), axis=1)
        assert between.any()
        first += int(np.argmax(between))
    assert first > 0.99 * len(pulses) - 2


def test_the_table_says_what_it_is(flight: FlightTable) -> None:
    """From the log: 198 s at 20 Hz, no warnings, its source in every row, the sizes in SOURCE."""
    assert flight.warnings == () and flight.duration == pytest.approx(198.0, abs=0.2)
    assert set(flight.labels["source"]) == {"CogniPilot cubs2 motion capture"}
    assert flight.has_pose.mean() > 0.995
    assert data_path("sport_cub.csv").stat().st_size < 700_000
    height = flight.p_world[flight.has_pose, 2]
    assert height.min() > 1.1 and height.max() < 3.6


def motion(flight: FlightTable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, velocity and attitude in the middle of 0.2 s between two poses."""
    rows = np.flatnonzero(flight.has_pose)[::4]
    t, p, attitude = flight.t[rows], flight.p_world[rows], flight.attitude[rows]
    v = np.diff(p, axis=0) / np.diff(t)[:, None]
    good = np.diff(t) < 0.3  # beside the rows without a pose, the mean is of a longer time
    middle = attitude[:-1] + 0.5 * wrap_angle(np.diff(attitude, axis=0))
    return (0.5 * (t[1:] + t[:-1]))[good], v[good], middle[good]


def test_nose_points_along_the_velocity(flight: FlightTable) -> None:
    """An aircraft flies nose first; angle of attack and sideslip stay below 20 deg on average."""
    _, v, attitude = motion(flight)
    nose = rotation_world_body(*attitude.T)[:, :, 0]
    cosine = (nose * v).sum(axis=1) / np.linalg.norm(v, axis=1)
    assert np.median(cosine) > np.cos(np.radians(20.0))


def test_bank_turns_the_course_as_a_level_turn_does(flight: FlightTable) -> None:
    """Law of the coordinated level turn, d(course)/dt = (g/V) tan(roll), to 15 % for its slip."""
    t, v, attitude = motion(flight)
    course = np.unwrap(-np.arctan2(v[:, 1], v[:, 0]))  # positive to the right, as yaw
    rate = np.diff(course) / np.diff(t)
    speed = np.hypot(v[:, 0], v[:, 1])
    law = 9.81 / speed * np.tan(attitude[:, 0])
    law = 0.5 * (law[1:] + law[:-1])
    near = (np.abs(rate) < 5.0) & (np.diff(t) < 0.3)
    slope, _ = np.polyfit(law[near], rate[near], 1)
    assert np.corrcoef(law[near], rate[near])[0, 1] > 0.9
    assert slope == pytest.approx(1.0, abs=0.15)


def test_sticks_move_the_aircraft_to_their_own_side(flight: FlightTable) -> None:
    """Sign of the commands: aileron lowers the right wing, elevator raises the nose."""
    aileron, elevator = stick_correlations(flight.t, flight.attitude, flight.commands)
    assert aileron > 0.3 and elevator > 0.5


def test_an_unknown_flight_lists_those_that_ship() -> None:
    """A name with its ending is none either."""
    with pytest.raises(InputError, match="expected one of alfa_engine_failure, case02_calm"):
        load_flight("sport_cub.csv")
    assert read_flight_table(data_path("sport_cub.csv")).name == "data/sport_cub.csv"
