"""The autopilot of a class: laps inside the hall, a landing, and from where a student left it."""

import math

import numpy as np
import pytest

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import landing_path, landing_speed
from falconwing_kit.control.guidance import Hall, ReferencePath
from falconwing_kit.core.messages import Observation
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.flight.trial import state_at_pose
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.tools.classroom.autopilot import RADIUS, LapsAndLanding, circuit

TASK = LandingTask()


def fly(world, laps, seconds=60.0):
    """The path flown (n, 3) until something is touched."""
    pilot = LapsAndLanding(
        TASK.model, TASK.airframe, TASK.pad, lambda: TASK.expert(None), landing_speed(TASK.model),
        laps,
    )  # fmt: skip
    past, path = np.zeros((30, 4)), []
    for k in range(round(seconds / 0.05)):
        world.advance(0.05 * k)
        path.append(world.state.p_world)
        if world.contact is not None:
            break
        command = pilot.act(Observation(0.05 * k, None, past, world.measured()))
        past = np.vstack([past[1:], command.vector])
        world.send(0.05 * k, command)
    return np.array(path)


def test_the_circuit_is_an_oval_of_known_length_inside_the_hall():
    """Two straights and two half circles; mirrored about the centre line for the other side."""
    glide = landing_path(TASK.airframe, TASK.pad)[0]
    right, lapped = circuit(TASK.pad, glide, 1, 2)
    left, _ = circuit(TASK.pad, glide, -1, 2)
    assert lapped == pytest.approx(2 * (2 * math.pi * RADIUS + 2 * 20.8), rel=1e-6)
    assert ReferencePath(right).length > lapped
    assert left[:, 1] + right[:, 1] == pytest.approx(np.full(len(right), -4.0))
    assert Hall().margin(right).min() > 0.9 and Hall().margin(left).min() > 0.9
    # Flown to the right: from its start eastward over the north (y up) to the south.
    assert right[0, 1] > LandingPad().y_centre and right[1, 0] > right[0, 0]


def test_a_lap_and_a_landing_on_the_pad():
    """From the start of a trial; more than a lap of way, never near a wall."""
    trial = TASK.trial(trial_seed(0))
    path = fly(trial.world, 1)
    touchdown = trial.world.contact.touchdown
    assert touchdown is not None and touchdown.on_pad and touchdown.sink_rate < 1.0
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() > 90.0
    assert Hall().margin(path).min() > 0.8


@pytest.mark.parametrize(
    ("place", "roll_deg", "yaw_deg"),
    [((-5.0, -2.0, 2.0), 40.0, 0.0), ((-2.0, -4.0, 1.5), -40.0, 180.0), ((4.0, 2.0, 2.5), 0, 100)],
)
def test_it_catches_an_aircraft_that_a_student_hands_back(place, roll_deg, yaw_deg):
    """Banked, low, across the hall: it is on the pad in the end."""
    start = state_at_pose(TASK.model, np.array(place), np.radians([roll_deg, 5.0, yaw_deg]))
    world = SimulatedWorld(TASK.model, TASK.airframe, start, seed=3, pad=TASK.pad)
    fly(world, 0)
    assert world.contact is not None and world.contact.touchdown is not None
    assert world.contact.touchdown.on_pad
