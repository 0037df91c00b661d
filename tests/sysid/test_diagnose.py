"""Diagnosis: each mistake that people make, made in good flights, is named; good flights have none.

The flights are JSBSim's (an aircraft that is not ours) and two measured ones; the mistakes are
exact changes of their columns, so what must be found is known by construction.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.data import data_path, shipped_names
from falconwing_kit.sysid.diagnose import diagnose_pair, diagnose_table, require_sound_table
from tests.hidden_effects import IN_CATALOGUE, OUTSIDE
from tests.hidden_flights import make_case
from tests.sysid.recorded import FOLDER

SHIPPED = tuple(name for name in shipped_names() if name.endswith(".csv"))
PLANTED_IN = ("case02_calm.csv", "case08_calm.csv", "alfa_engine_failure.csv")


def shipped(name):
    return read_flight_table(data_path(name))


def world(table, *columns):
    """Positions with these columns, 1 to 3 for px to pz, negative for a changed sign."""
    order = np.abs(columns) - 1
    return replace(table, p_world=table.p_world[:, order] * np.sign(columns))


def attitude(table, *columns):
    """Angles with these columns, 1 to 3 for roll to yaw, negative for a changed sign."""
    order = np.abs(columns) - 1
    return replace(table, attitude=table.attitude[:, order] * np.sign(columns))


def commands(table, *columns):
    """Commands with these columns, 1 to 3 for aileron to rudder, negative for a changed sign."""
    new = table.commands[:, np.abs(columns)] * np.sign(columns)
    return replace(table, commands=np.column_stack([table.commands[:, 0], new]))


def quaternion(table, order):
    """The components of the attitude's quaternion in place of the angles."""
    q = np.full((len(table.t), 4), np.nan)
    known = table.has_pose
    q[known] = Rotation.from_euler("ZYX", table.attitude[known][:, ::-1]).as_quat()  # x, y, z, w
    return replace(table, attitude=q[:, ["xyzw".index(letter) for letter in order]])


def backwards(table):
    """The flight's rows in reverse order, at increasing times."""
    turned = {"p_world": table.p_world, "attitude": table.attitude, "commands": table.commands}
    turned = {name: values[::-1] for name, values in turned.items()}
    return replace(table, t=table.t[-1] - table.t[::-1], extra={}, labels={}, **turned)


def constant(table, column):
    """The same number in every row with a pose."""
    angles = table.attitude.copy()
    angles[table.has_pose, column] = 0.3
    return replace(table, attitude=angles)


def pulses(table):
    """Pulse widths as a receiver has them [us]."""
    c = table.commands
    return replace(table, commands=np.column_stack([1000 + 1000 * c[:, 0], 1500 + 500 * c[:, 1:]]))


def throttle(table, scale, offset):
    changed = table.commands.copy()
    changed[:, 0] = changed[:, 0] * scale + offset
    return replace(table, commands=changed)


def cut(table, rows):
    return replace(
        table, t=table.t[:rows], p_world=table.p_world[:rows], attitude=table.attitude[:rows],
        commands=table.commands[:rows], extra={}, labels={},
    )  # fmt: skip


# Each: how it is made, and words of the sentence
CERTAIN = {
    "degrees": (lambda t: replace(t, attitude=np.degrees(t.attitude)), "degrees; convert to rad"),
    "milliseconds": (lambda t: replace(t, t=1e3 * t.t), "milliseconds"),
    "microseconds": (lambda t: replace(t, t=1e6 * t.t), "microseconds"),
    "z down": (lambda t: world(t, 1, 2, -3), "z seems to point down"),
    "y right": (lambda t: world(t, 1, -2, 3), "y seems to point right"),
    "north-east-down": (lambda t: world(t, 1, -2, -3), "north, east, down"),
    "x reversed": (lambda t: world(t, -1, 2, 3), "x seems reversed"),
    "x and y swapped": (lambda t: world(t, 2, 1, 3), "px and py seem swapped"),
    "y and z swapped": (lambda t: world(t, 1, 3, 2), "py and pz seem swapped"),
    "east-north-up, heading from north": (lambda t: world(t, -2, 1, 3), "differ by 90 deg"),
    "roll reversed": (lambda t: attitude(t, -1, 2, 3), "roll seems reversed"),
    "pitch down positive": (lambda t: attitude(t, 1, -2, 3), "pitch seems reversed"),
    "yaw counter-clockwise": (lambda t: attitude(t, 1, 2, -3), "yaw seems counter-clockwise"),
    "angles of ROS": (lambda t: attitude(t, 1, -2, -3), "x forward, y left, z up"),
    "roll and pitch swapped": (lambda t: attitude(t, 2, 1, 3), "roll and pitch seem swapped"),
    "roll and yaw swapped": (lambda t: attitude(t, 3, 2, 1), "roll and yaw seem swapped"),
    "pitch and yaw swapped": (lambda t: attitude(t, 1, 3, 2), "pitch and yaw seem swapped"),
    "angles in order yaw, pitch, roll, z down": (
        lambda t: attitude(world(t, 1, 2, -3), 3, 2, 1), "roll and yaw seem swapped"),
    "body z up": (
        lambda t: replace(t, attitude=t.attitude + np.array([np.pi, 0.0, 0.0])), "upside down"),
    "quaternion x y z": (lambda t: quaternion(t, "xyz"), "components x, y, z of a quaternion"),
    "quaternion w x y": (lambda t: quaternion(t, "wxy"), "components w, x, y of a quaternion"),
    "played backwards": (backwards, "backwards in time"),
    "millimetres": (lambda t: replace(t, p_world=1e3 * t.p_world), "look like millimetres"),
    "centimetres": (lambda t: replace(t, p_world=1e2 * t.p_world), "look like centimetres"),
    "constant yaw": (lambda t: constant(t, 2), "yaw changes never"),
    "constant roll": (lambda t: constant(t, 0), "roll changes never"),
    "pulse widths": (pulses, "microseconds; convert it by (us - 1000) / 1000"),
    "throttle of -1..1": (lambda t: throttle(t, 2.0, -1.0), "throttle of -1..1"),
    "throttle in percent": (lambda t: throttle(t, 100.0, 0.0), "percent"),
}  # fmt: skip
LIKELY = {
    "feet": (lambda t: replace(t, p_world=t.p_world / 0.3048), "look like feet"),
    "aileron reversed": (lambda t: commands(t, -1, 2, 3), "aileron seems reversed"),
    "elevator reversed": (lambda t: commands(t, 1, -2, 3), "elevator seems reversed"),
    "aileron and elevator swapped": (lambda t: commands(t, 2, 1, 3), "seem swapped: roll, pitch"),
}


@pytest.mark.parametrize("name", PLANTED_IN)
@pytest.mark.parametrize("mistake", CERTAIN)
def test_a_mistake_is_named_and_certain(name, mistake):
    """By construction. It is refused in one sentence that starts with the file's name."""
    make, words = CERTAIN[mistake]
    if mistake.startswith("throttle of") and "alfa" in name:
        pytest.skip("this flight's throttle is above one half until the engine fails")
    table = replace(make(shipped(name)), name="mine.csv")
    first, *others = diagnose_table(table)
    assert first.certain and words in first.sentence and not any(o.certain for o in others)
    with pytest.raises(InputError, match=r"^mine\.csv: [^\n]*$"):
        require_sound_table(table)


@pytest.mark.parametrize("name", PLANTED_IN)
@pytest.mark.parametrize("mistake", LIKELY)
def test_a_mistake_that_some_aircraft_could_fly_is_likely(name, mistake):
    """By construction; it is not refused, since a fit may show more."""
    make, words = LIKELY[mistake]
    table = make(shipped(name))
    first, *_ = diagnose_table(table)
    assert not first.certain and words in first.sentence
    require_sound_table(table)


@pytest.mark.parametrize("name", ("case02_calm.csv", "case08_calm.csv"))
@pytest.mark.parametrize(
    ("order", "words"),
    [
        ((1, 2, -3), "rudder seems reversed"),
        ((3, 2, 1), "answer to the columns rudder, elevator, aileron"),
        ((1, 3, 2), "answer to the columns aileron, rudder, elevator"),
        ((-2, 1, 3), "answer to the columns elevator, aileron, rudder"),
    ],
)
def test_a_rudder_that_moves_is_told_apart(name, order, words):
    """By construction, where the rudder is flown by itself (ALFA's is half the aileron)."""
    faults = diagnose_table(commands(shipped(name), *order))
    assert words in faults[0].sentence and not faults[0].certain


def flights():
    """Every flight that ships, and the shared ones where they are."""
    tables = {name: shipped(name) for name in SHIPPED}
    for path in sorted(FOLDER.glob("*/*.csv")):
        tables[f"{path.parent.name}/{path.name}"] = read_flight_table(path)
    return tables


def test_good_flights_have_no_fault():
    """Measured, and simulated by JSBSim, calm and with an effect: nobody made a mistake in them."""
    found = {name: diagnose_table(table) for name, table in flights().items()}
    assert len(found) >= 4 and not any(found.values()), found


@pytest.mark.parametrize("noise", ["marker", "hybrid", "net"])
def test_no_effect_looks_like_a_fault(noise):
    """Half a minute with an effect each, of and outside the catalogue, and its baseline."""
    effects = (*IN_CATALOGUE, *OUTSIDE)
    for seed, effect in enumerate(effects[("marker", "hybrid", "net").index(noise) :: 9]):
        case = make_case(
            40 + seed, effect, noise=noise, correlated=seed % 2 == 0, calm_seconds=25.0,
            flight_seconds=30.0,
        )  # fmt: skip
        for table in (case.calm, case.flight):
            assert diagnose_table(table) == (), (effect, noise)
        assert diagnose_pair(case.calm, case.flight) == (), (effect, noise)


def test_two_and_a_half_seconds_are_too_short():
    """By construction: 51 rows at 20 Hz."""
    table = replace(cut(shipped("case02_calm.csv"), 51), name="short.csv")
    (fault,) = diagnose_table(table)
    assert fault.kind == "too_short" and "got 2.5 s in 51 rows" in fault.sentence


def test_poses_that_freeze_are_named():
    """The tracker repeats its last pose for the second half; a fifth to a third of rows is not."""
    table = shipped("case02_calm.csv")
    half = np.flatnonzero(table.has_pose)[len(table.t) // 2]
    p_world, angles = table.p_world.copy(), table.attitude.copy()
    p_world[half:], angles[half:] = p_world[half], angles[half]
    kinds = {
        fault.kind for fault in diagnose_table(replace(table, p_world=p_world, attitude=angles))
    }
    assert kinds == {"frozen_poses"}


def test_poses_repeated_from_row_to_row_are_named():
    """A tracker at 10 Hz in a table at 20 Hz, each pose written twice."""
    table = shipped("case02_calm.csv")
    rows = np.arange(len(table.t)) // 2 * 2
    held = replace(table, p_world=table.p_world[rows], attitude=table.attitude[rows])
    assert [fault.kind for fault in diagnose_table(held)] == ["repeated_poses"]


@pytest.mark.parametrize("draw", [lambda n: np.arange(n) % 2 == 0, lambda n: rng_rows(n)])
def test_rows_of_two_aircraft_in_one_file_are_certain(draw):
    """Two flights in one file, in turn or by chance, ten metres apart."""
    first, second = shipped("case02_calm.csv"), shipped("case08_calm.csv")
    n = min(len(first.t), len(second.t))
    of_first, away = draw(n)[:, None], np.array([10.0, 0.0, 0.0])
    mixed = replace(
        cut(first, n),
        p_world=np.where(of_first, first.p_world[:n], second.p_world[:n] + away),
        attitude=np.where(of_first, first.attitude[:n], second.attitude[:n]),
    )
    assert diagnose_table(mixed)[0].kind == "two_aircraft"


def rng_rows(n):
    return np.random.default_rng(5).random(n) < 0.5


def test_a_path_that_jumps_is_two_flights():
    """The second half starts 12 m further on; by hand the jump is at the 40th second."""
    table = shipped("case02_calm.csv")
    later = table.t - table.t[0] >= 40.0
    jumped = replace(table, p_world=table.p_world + np.where(later, 12.0, 0.0)[:, None] * [0, 1, 0])
    fault = next(f for f in diagnose_table(jumped) if f.kind == "two_flights")
    at = float(fault.sentence.split(" m at ")[1].split(" s")[0])
    assert at == pytest.approx(40.0, abs=0.3) and not fault.certain


def test_baseline_and_flight_of_two_aircraft_are_noticed():
    """A 0.15 kg and a T-28 of 2 m: 8 and 18 m/s, a factor of 2.3."""
    faults = diagnose_pair(shipped("case02_calm.csv"), shipped("alfa_engine_failure.csv"))
    assert [fault.kind for fault in faults] == ["two_aircraft"] and "two aircraft?" in faults[
        0
    ].sentence
    assert diagnose_pair(shipped("case08_calm.csv"), shipped("case08_flight.csv")) == ()


@pytest.mark.parametrize(
    ("column", "factor", "words"),
    [("vz", -1.0, "vz has the opposite sign"), ("vx", -1.0, "vx has"), ("p", 57.2958, "p is")],
)
def test_logged_motion_that_contradicts_the_poses_is_named(column, factor, words):
    """ALFA's log has the autopilot's velocity and rates; one column changed."""
    table = shipped("alfa_engine_failure.csv")
    extra = {**table.extra, column: factor * table.extra[column]}
    (fault,) = diagnose_table(replace(table, extra=extra))
    assert fault.certain and words in fault.sentence


@pytest.mark.parametrize("rows", [1, 2, 5, 20, 61, 70])
def test_any_number_of_rows_gives_sentences_and_no_traceback(rows):
    """Short tables, with and without poses: a tuple of faults whatever comes."""
    table = cut(shipped("case02_calm.csv"), rows)
    empty = replace(table, p_world=np.full((rows, 3), np.nan), attitude=np.full((rows, 3), np.nan))
    for one in (table, empty, replace(table, p_world=0.0 * table.p_world)):
        assert isinstance(diagnose_table(one), tuple)
