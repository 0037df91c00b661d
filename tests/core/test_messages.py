"""Messages: order of the state vector, limits that show, and the way through JSON."""

import dataclasses
import json
import math

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Image, Observation, Pose, State


def test_state_vector_has_the_order_of_the_paper():
    """px py pz | pitch yaw roll | vx vy vz, then p q r: numbered by hand."""
    state = State(
        np.array([1.0, 2.0, 3.0]),
        4.0,
        5.0,
        6.0,
        np.array([7.0, 8.0, 9.0]),
        np.array([10.0, 11.0, 12.0]),
    )
    assert state.vector.tolist() == list(range(1, 13))
    again = State.from_vector(state.vector)
    assert (again.pitch, again.yaw, again.roll) == (4.0, 5.0, 6.0)


def test_nine_states_have_no_body_rates():
    """The paper's states."""
    assert State.from_vector(np.arange(9.0)).vector.tolist() == [*range(9), 0, 0, 0]


@pytest.mark.parametrize("length", [0, 8, 10, 13])
def test_other_lengths_are_refused(length):
    """Only 9 and 12 are states."""
    with pytest.raises(InputError, match="state: expected shape"):
        State.from_vector(np.zeros(length))


def test_pose_of_a_state_moves_a_point_of_the_nose():
    """By hand: at (1, 2, 3), yawed right by 90 deg, a point 1 m ahead is at y = 2 - 1."""
    pose = Pose(np.array([1.0, 2.0, 3.0]), roll=0.0, pitch=0.0, yaw=math.pi / 2)
    assert pose.T_world_body @ [1.0, 0.0, 0.0, 1.0] == pytest.approx(
        [1.0, 1.0, 3.0, 1.0], abs=1e-15
    )


def test_a_limit_that_acts_is_said():
    """A throttle of 1.2 is clipped to 1 and marked as saturated; within limits it is not."""
    cut = Command.clip(1.2, -3.0, 0.5, 0.0, image_sequence=4)
    assert (cut.throttle, cut.aileron, cut.elevator, cut.rudder) == (1.0, -1.0, 0.5, 0.0)
    assert cut.saturated and cut.image_sequence == 4
    assert not Command.clip(0.5, 0.0, 0.0, 0.0).saturated
    assert Command.clip(-0.1, 0.0, 0.0, 0.0).throttle == 0.0


def test_a_command_that_is_no_number_is_refused():
    """nan must not reach the aircraft as some limit."""
    with pytest.raises(InputError, match="aileron"):
        Command.clip(0.5, math.nan, 0.0, 0.0)


def test_records_go_through_json_and_back():
    """JSON has no nan: it is written as null and read as nan."""
    state = State(np.array([1.0, 2.0, np.nan]), 0.1, 0.2, 0.3, np.array([4.0, 5.0, 6.0]))
    again = State.from_record(json.loads(json.dumps(state.record, allow_nan=False)))
    assert np.array_equal(again.vector, state.vector, equal_nan=True)
    command = Command.clip(2.0, 0.1, 0.2, 0.3, image_sequence=7)
    assert Command.from_record(json.loads(json.dumps(command.record))) == command


def test_messages_cannot_be_changed():
    """A frozen record: a change makes a new one."""
    command = Command.clip(0.5, 0.0, 0.0, 0.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        command.throttle = 1.0
    observation = Observation(1.0, Image(0, 1.0, np.zeros((2, 2, 3), np.uint8)), np.zeros((30, 4)))
    assert dataclasses.replace(observation, t=2.0).t == 2.0
