"""Leaders: inside the hall, reproducible by seed, and each as its name states."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.control import manoeuvres
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.leader import leader_path
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.control.plan import Manoeuvre, Plan, curve_points, manoeuvre_table
from falconwing_kit.core.checks import InputError

# SHA-256 of the states at seed 3, rounded to 1e-6 (the same on other processors): recorded data,
# from the code before the number of a manoeuvre stood in its own file.
RECORDED = {
    "left_turn_s_descent": "31ffeddb107415da",
    "right_turn_s_ascent": "0d2833599842c39a",
    "right_turn_sharp_climb": "1876d7ad7292bc63",
    "figure_eight": "1e9d68e22cecd8fe",
    "random_waypoints": "2a0c97b6e9558ee6",
}
# The climb was moved where no box of the hall hides the leader, and flies the same there.
MOVED = {"right_turn_sharp_climb": (14.0, 0.5, 0.2)}
SLALOM = Plan((-16.0, 0.0, 2.0), 0.0, (0.0, 5.0, 10.0, 20.0), (0.0, 0.05, -0.05, 0.0), (0.0,) * 4)


def states_digest(name):
    """Digest of the states of seed 3 at the recorded place; + 0.0 turns minus zero into zero."""
    states = leader_path(name, 3).states.copy()
    states[:, :3] -= MOVED.get(name, (0.0, 0.0, 0.0))
    return hashlib.sha256((np.round(states, 6) + 0.0).tobytes()).hexdigest()[:16]


@pytest.fixture(scope="module")
def paths():
    return {(name, seed): leader_path(name, seed) for name in MANOEUVRES for seed in (0, 1)}


def test_leaders_stay_inside_the_hall(paths):
    """Walls and beams of the 40 x 20 x 5 m hall; half the span is 0.35 m."""
    for path in paths.values():
        assert Hall().margin(path.states[:, :3]).min() > 0.5, path.manoeuvre
        assert path.states[:, 2].min() > 0.5, path.manoeuvre


def test_same_seed_same_bits_and_another_seed_another_path(paths):
    """Flown twice in this process."""
    for name in ("left_turn_s_descent", "random_waypoints"):
        assert np.array_equal(leader_path(name, 0).states, paths[name, 0].states)
        assert not np.array_equal(
            paths[name, 0].states, paths[name, 1].states[: len(paths[name, 0].states)]
        )


@pytest.mark.parametrize("seed", [0, 1])
def test_each_manoeuvre_matches_its_name(paths, seed):
    """As in the paper: first turn, last course, climb or descent."""
    for name, first_turn, course_kept, climbs in (
        ("left_turn_s_descent", -1, True, -1), ("right_turn_s_ascent", 1, True, 1),
        ("right_turn_sharp_climb", 1, False, 1),
    ):  # fmt: skip
        states = paths[name, seed].states
        yaw = states[:, 4] - states[0, 4]
        largest = yaw[np.argmax(np.abs(yaw))]
        assert first_turn * largest > np.radians(25.0), name
        assert (abs(yaw[-1]) < np.radians(6.0)) == course_kept, name
        assert climbs * (states[-1, 2] - states[0, 2]) > 1.5, name
    eight = paths["figure_eight", seed].states
    assert np.ptp(eight[:, 4]) > 1.5 * np.pi  # most of a turn to one side, and back
    assert abs(eight[-1, 4] - eight[0, 4]) < np.radians(6.0)
    assert np.ptp(eight[:, 2]) < 0.3
    assert np.linalg.norm(eight[-1, :2] - eight[0, :2]) < 1.0


def test_state_is_continuous_and_its_velocity_is_its_motion(paths):
    """Central differences of the position over 2 ms equal the velocity, between and beyond samples.

    To 0.05 m/s: linear interpolation of the velocity is off by dt^2 / 8 of its second derivative.
    """
    path = paths["right_turn_sharp_climb", 0]
    for t in (-1.0, 0.013, 0.05, 1.234, 2.5, path.duration - 0.01, path.duration + 0.7):
        moved = (path.state_at(t + 1e-3).p_world - path.state_at(t - 1e-3).p_world) / 2e-3
        assert moved == pytest.approx(path.state_at(t).v_world, abs=0.05)
    assert path.state_at(0.5).vector == pytest.approx(path.states[10], abs=1e-12)


def test_curve_from_its_curvature_is_a_circle():
    """A right quarter of 10 m radius from the origin along world x ends at (10, -10); 10 % up over
    15.7 m is 1.57 m.
    """
    quarter = 5.0 * np.pi
    s = np.array([0.0, quarter])
    points = curve_points(0.0, s, np.full(2, 0.1), np.full(2, np.arctan(0.1)))
    ways = np.arange(len(points))
    expected = np.column_stack([10 * np.sin(ways / 10), 10 * (np.cos(ways / 10) - 1), 0.1 * ways])
    assert points == pytest.approx(expected, abs=1e-3)  # midpoint rule in steps of 0.1 m


def test_unknown_or_impossible_manoeuvres_are_refused():
    """An unknown name, and an aircraft that cannot climb."""
    with pytest.raises(InputError, match="left_turn_s_descent"):
        leader_path("loop")
    with pytest.raises(InputError, match="throttle"):
        leader_path("right_turn_sharp_climb", model=rates_model().with_values({"kT": 5.0}))


@pytest.mark.parametrize("place", [None, 0, 2, 5], ids=["as it is", "front", "middle", "end"])
def test_a_new_manoeuvre_changes_no_other_leader(place, monkeypatch):
    """The recorded flights with no slalom, and with one before, among and after the five."""
    table = list(MANOEUVRES.items())
    if place is not None:
        table.insert(place, ("slalom", Manoeuvre("slalom", "to and fro", SLALOM.waypoints)))
    monkeypatch.setattr("falconwing_kit.control.leader.MANOEUVRES", dict(table))
    assert {name: states_digest(name) for name in RECORDED} == RECORDED
    if place is not None:
        assert states_digest("slalom") not in RECORDED.values()


def test_the_number_of_a_manoeuvre_is_its_own():
    """The first five keep theirs; a later one has the CRC-32 of its name: 0xCBF43926 of "123456789"
    [ITU V.42].
    """
    frozen = [
        manoeuvre.name for manoeuvre in MANOEUVRES.values() if manoeuvre.frozen_number is not None
    ]
    assert frozen == list(RECORDED)
    assert [MANOEUVRES[name].number for name in frozen] == [0, 1, 2, 3, 4]
    assert Manoeuvre("123456789", "", SLALOM.waypoints).number == 0xCBF43926


@pytest.mark.parametrize(
    "taken", [{"frozen_number": 3}, {"name": "figure_eight"}], ids=lambda taken: next(iter(taken))
)
def test_a_name_or_number_that_is_taken_is_refused(taken):
    """One sentence with both names and the way out."""
    slalom = replace(Manoeuvre("slalom", "", SLALOM.waypoints), **taken)
    with pytest.raises(InputError, match=r"figure_eight.*choose another name"):
        manoeuvre_table([*MANOEUVRES.values(), slalom])


def test_every_file_of_the_folder_is_a_manoeuvre_under_its_own_name():
    """By hand: the folder's files."""
    files = Path(manoeuvres.__file__).parent.glob("*.py")
    assert set(MANOEUVRES) == {path.stem for path in files} - {"__init__"}
    assert all(manoeuvre.summary for manoeuvre in MANOEUVRES.values())


def test_the_digest_covers_name_waypoints_and_states(paths):
    """Each changed by 2 mm, beyond the rounding; a nanometre, as between processors, changes
    nothing.
    """
    path = paths["figure_eight", 0]
    for changed in (
        {"manoeuvre": "other"},
        {"waypoints": path.waypoints + 2e-3},
        {"states": path.states + 2e-3},
    ):
        assert replace(path, **changed).digest != path.digest
    middle = np.round(path.states, 3)  # away from the edges of rounding
    assert replace(path, states=middle + 1e-9).digest == replace(path, states=middle).digest
