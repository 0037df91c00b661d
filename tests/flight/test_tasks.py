"""Tasks: starts are drawn as documented, from frozen seeds, the same for every pilot."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.control.leader import leader_path
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import rotation_world_body
from falconwing_kit.flight import tasks
from falconwing_kit.flight.tasks import TASKS, FollowTask, LandingTask, trial_seed
from falconwing_kit.flight.tasks.follow import BEHIND

TRAINING = range(200)  # seeds that never judge


def starts(task, seeds=TRAINING):
    """States at the start, without building the worlds."""
    nominal = np.array([task.pad.x_start - 20.0, task.pad.y_centre, 1.5])
    return [task.spread.start(task.model, nominal, seed) for seed in seeds], nominal


def test_the_list_of_seeds_is_frozen():
    """Results are compared on it: 10,000 + k, the next list 20,000 + k; seeds below 10,000 are not
    used.
    """
    assert [trial_seed(k) for k in (0, 1, 99)] == [10_000, 10_001, 10_099]
    assert trial_seed(3, seed=1) == 20_003
    for number, seed in ((-1, 0), (10_000, 0), (0, -1)):
        with pytest.raises(InputError, match="expected a finite number"):
            trial_seed(number, seed)


def test_landings_begin_20_m_out_and_within_their_spread():
    """+-1 m per axis, +-10 deg per angle, +-1 m/s: 200 uniform draws come near both ends, none
    beyond.
    """
    states, nominal = starts(LandingTask())
    off = np.array([state.p_world - nominal for state in states])
    angles = np.array([(state.roll, state.yaw) for state in states])
    pitch = np.array([state.pitch for state in states])
    speed = np.array([np.linalg.norm(state.v_world) for state in states])
    for values, size in ((off, 1.0), (angles, math.radians(10.0)), (speed - 7.0, 1.0)):
        assert np.abs(values).max() <= size + 1e-12
        assert values.min(axis=0).max() < -0.9 * size
        assert values.max(axis=0).min() > 0.9 * size
    assert np.ptp(pitch) == pytest.approx(math.radians(20.0), rel=0.1)


def test_the_velocity_turns_with_the_nose():
    """Angle of attack and sideslip are those of the trimmed flight at every start."""
    states, _ = starts(LandingTask(), range(20))
    flow = []
    for state in states:
        v_body = rotation_world_body(state.roll, state.pitch, state.yaw).T @ state.v_world
        flow.append(v_body / np.linalg.norm(v_body))
    assert np.ptp(flow, axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert abs(flow[0][1]) < 1e-6


def test_same_seed_same_start_and_noise_for_every_pilot():
    """Two worlds of one seed have the same measurements to the last bit; another seed does not."""
    task = LandingTask()
    first, again, other = (task.trial(seed).world for seed in (5, 5, 6))
    assert (first.measured().vector == again.measured().vector).all()
    assert (first.state.vector == again.state.vector).all()
    assert (first.state.vector != other.state.vector).any()


def test_a_follower_begins_behind_its_leader_with_its_speed():
    """BEHIND metres back along the leader's course, +-0.5 m per axis, nose within 5 deg of it."""
    trial = FollowTask("left_turn_s_descent").trial(7)
    leader, own = trial.leader.state_at(0.0), trial.world.state
    course = leader.v_world / np.linalg.norm(leader.v_world)
    assert own.p_world == pytest.approx(leader.p_world - BEHIND * course, abs=0.5)
    assert own.yaw == pytest.approx(math.atan2(-course[1], course[0]), abs=math.radians(5.0))
    assert np.linalg.norm(own.v_world) == pytest.approx(7.0, abs=0.5)
    assert trial.duration == trial.leader.duration


@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
def test_a_leader_and_its_follower_draw_independently(manoeuvre, monkeypatch):
    """Over 50 seeds no number of the start is one of the leader's first seven, and the three
    positions are uncorrelated (|r| < 4 / sqrt(150) = 0.33; the same draws give 1).
    """
    task, shifts, leads = FollowTask(manoeuvre), [], []

    def only_draw(rng):
        leads.append(rng.uniform(-1.0, 1.0, 7))
        raise InputError("drawn")

    monkeypatch.setitem(MANOEUVRES, manoeuvre, replace(MANOEUVRES[manoeuvre], waypoints=only_draw))
    for seed in range(50):
        with pytest.raises(InputError, match="drawn"):
            leader_path(manoeuvre, seed)
        shifts.append(
            task.spread.start(task.model, np.zeros(3), seed).p_world / task.spread.position
        )
    shift, lead = np.array(shifts), np.array(leads)
    assert np.abs(shift[:, :, None] - lead[:, None, :]).min() > 1e-9
    assert abs(np.corrcoef(shift.ravel(), lead[:, :3].ravel())[0, 1]) < 0.33


def test_what_cannot_be_flown_is_refused():
    """An unknown manoeuvre; following without a leader."""
    with pytest.raises(InputError, match="manoeuvre: expected one of"):
        FollowTask("loop")
    landing = LandingTask().trial(1)
    with pytest.raises(InputError, match="with a leader"):
        FollowTask("figure_eight").expert(landing)


def test_every_file_of_the_folder_is_a_task_under_its_own_name():
    """By hand: the folder's files. The task's name begins with that of the command line."""
    folder = Path(tasks.__file__).parent
    assert set(TASKS) == {path.stem for path in folder.glob("*.py")} - {"__init__"}
    for name, entry in TASKS.items():
        task = entry.make(entry.manoeuvre) if entry.manoeuvre else entry.make()
        assert entry.name == name == task.name.split()[0]
        assert (task.leader(0) is None) == (entry.manoeuvre == "")
