"""Successive loop closure: gains by the textbook's formulas, signs, and landings."""

import math

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import paper_model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import linearise, trim
from falconwing_kit.control.estimate import SimulatedAircraft
from falconwing_kit.control.expert import LandingExpert
from falconwing_kit.control.loops import Reference
from falconwing_kit.control.successive_loops import SuccessiveAutopilot, successive_gains
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Observation, State
from falconwing_kit.flight.tasks import LandingTask

LEVEL = Reference(np.array([0.0, 0.0, 2.0]), 0.0, 0.0, 7.0, 0.0)


def state(**changes):
    """Level flight along the runway at 7 m/s and 2 m, with some numbers of the vector changed."""
    x = trim(rates_model(), 7.0).state.copy()
    x[2] = 2.0
    for index, value in changes.items():
        x[int(index[1:])] += value
    return State.from_vector(x)


def commanded(changed, reference=LEVEL):
    return SuccessiveAutopilot(rates_model()).command(changed, reference, np.zeros((30, 4)))


def test_the_roll_loop_has_the_poles_that_were_asked_for():
    """p' = -a1 p + a2 aileron closed with the gains: s^2 + (a1 + a2 k_rate) s + a2 k = (s + 8)^2,
    by the model's own linearisation; dihedral and yaw are other loops.
    """
    model = rates_model()
    gains = successive_gains(model)
    A, B = linearise(model, trim(model, 7.0))
    a1, a2 = -A[9, 9], B[9, 1]
    closed = np.array([[0.0, 1.0], [-a2 * gains.roll, -a1 - a2 * gains.roll_rate]])
    # 0.2 rad/s: the trim flies at 7 m/s, but not exactly along the nose
    assert np.sort(np.linalg.eigvals(closed).real) == pytest.approx([-8.0, -8.0], abs=0.8)
    assert np.prod(np.linalg.eigvals(closed)).real == pytest.approx(64.0, rel=0.02)


def test_outer_gains_by_hand():
    """At 7 m/s: course 2.0 V / g, path 0.9 / V, height 1.8 / V; throttle 1.5 / (9 - 0.5 * 7)."""
    gains = successive_gains(rates_model())
    assert gains.course == pytest.approx(2.0 * 7.0 / 9.8)
    assert gains.path == pytest.approx(0.9 / 7.0)
    assert gains.height == pytest.approx(1.8 / 7.0)
    assert gains.speed == pytest.approx(1.5 / 5.5)


@pytest.mark.parametrize(
    ("change", "channel", "sign"),
    [
        ({"x1": 0.5}, "aileron", 1),  # left of the path: roll right
        ({"x7": 1.0}, "aileron", 1),  # drifts left: roll right
        ({"x5": 0.2}, "aileron", -1),  # banked right: roll left
        ({"x2": -0.3}, "elevator", 1),  # too low: nose up
        ({"x3": -0.1}, "elevator", 1),  # nose too low: nose up
        ({"x6": -1.0}, "throttle", 1),  # too slow: more power
    ],
)
def test_each_error_is_answered_with_the_right_sign(change, channel, sign):
    """Against the command without an error; the other way round with the error the other way."""
    neutral, answered = commanded(state()), commanded(state(**change))
    assert sign * (getattr(answered, channel) - getattr(neutral, channel)) > 0.02
    mirrored = commanded(state(**{key: -value for key, value in change.items()}))
    assert sign * (getattr(mirrored, channel) - getattr(neutral, channel)) < -0.02


def test_without_an_error_it_holds_the_trim():
    """The control inputs of level flight, fed forward."""
    assert commanded(state()).vector == pytest.approx(trim(rates_model(), 7.0).command, abs=1e-6)


def test_offsets_are_flown_out():
    """0.8 m to the left, 0.4 m low and 15 deg off the course: after 8 s within 5 cm and 1 deg."""
    x = state().vector
    x[1], x[2], x[4] = 0.8, 1.6, math.radians(15.0)
    x[6:8] = 7.0 * math.cos(x[4]), -7.0 * math.sin(x[4])
    aircraft = SimulatedAircraft(rates_model(), State.from_vector(x))
    autopilot = SuccessiveAutopilot(rates_model())
    for k in range(160):
        now = State.from_vector(aircraft.x)
        reference = Reference(np.array([now.p_world[0], 0.0, 2.0]), 0.0, 0.0, 7.0, 0.0)
        aircraft.send(0.05 * k, autopilot.command(now, reference, np.zeros((30, 4))).vector)
        aircraft.advance(0.05 * (k + 1))
    end = State.from_vector(aircraft.x)
    assert abs(end.p_world[1]) < 0.05 and abs(end.p_world[2] - 2.0) < 0.05
    assert abs(math.degrees(end.yaw)) < 1.0 and abs(math.degrees(end.roll)) < 1.0


@pytest.mark.parametrize("seed", range(4))
def test_it_lands(seed):
    """The task's own starts; the bounds of the expert's test."""
    task = LandingTask()
    trial, past = task.trial(seed), np.zeros((30, 4))
    pilot = LandingExpert(
        rates_model(), load_airframe(), LandingPad(), autopilot=SuccessiveAutopilot
    )
    world = trial.world
    while world.contact is None and world.t < 8.0:
        command = pilot.act(Observation(world.t, None, past, world.measured()))
        past = np.vstack([past[1:], command.vector])
        world.send(world.t, command)
        world.advance(world.t + 0.05)
    touchdown = world.contact.touchdown
    assert world.contact.obstacle == "pad" and touchdown.absolute_lateral_deviation < 0.5
    assert touchdown.sink_rate < 0.6 and abs(math.degrees(touchdown.bank)) < 5.0


def test_a_model_without_body_rates_is_refused():
    """The 9-state model has no roll damping to place poles with."""
    with pytest.raises(InputError, match="12-state"):
        SuccessiveAutopilot(paper_model())


def test_a_model_without_ailerons_is_refused():
    """Nothing to divide by."""
    with pytest.raises(InputError, match="expected L_da above zero"):
        SuccessiveAutopilot(rates_model().with_values({"L_da": 0.0}))


def test_level_is_the_trim():
    """For use without a state."""
    level = SuccessiveAutopilot(rates_model()).level()
    assert level.vector == pytest.approx(trim(rates_model(), 7.0).command, abs=1e-6)
