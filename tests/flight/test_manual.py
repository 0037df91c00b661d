"""Manual pilot: sticks pass through, silence is safe; what the beginner's assist holds and limits,
in simulated flights.
"""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import paper_model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import SAFE_COMMAND, Observation
from falconwing_kit.flight import load_pilot
from falconwing_kit.flight.manual import (
    CLEARANCE,
    MAX_BANK,
    ManualPilot,
    Sticks,
    StickSource,
)
from falconwing_kit.flight.trial import state_at_pose
from falconwing_kit.flight.world import SimulatedWorld

MODEL, AIRFRAME, PAD = rates_model(), load_airframe(), LandingPad()
NEUTRAL = (0.5, 0.0, 0.0, 0.0)


def look(t, state=None):
    """An observation without a picture."""
    return Observation(t, None, np.zeros((30, 4)), state)


def put(pilot, t, sticks=NEUTRAL, hold=True):
    """Whether the pilot's source took these sticks."""
    return pilot.sticks.put(Sticks(*sticks, hold=hold, stamp=t))


def fly(sticks_at, seconds, start, attitude=(0.0, 0.085, 0.0)):
    """True states (n, 12) and the commands of an assisted flight at 7 m/s, and its contact."""
    world = SimulatedWorld(MODEL, AIRFRAME, state_at_pose(MODEL, start, attitude), seed=5, pad=PAD)
    pilot, past, states, sent = (
        ManualPilot(MODEL, AIRFRAME, PAD, assist=True),
        np.zeros((30, 4)),
        [],
        [],
    )
    for k in range(round(seconds / 0.05)):
        t = 0.05 * k
        world.advance(t)
        if world.contact:
            break
        put(pilot, t, sticks_at(t))
        command = pilot.act(Observation(t, None, past, world.measured()))
        assert pilot.mode == "manual, assist"
        world.send(t, command)
        past = np.vstack([past[1:], command.vector])
        states.append(world.state.vector)
        sent.append(command.vector)
    return np.array(states), np.array(sent), world.contact


def course_deg(states):
    """Course over the floor (n,) [deg], positive to the right."""
    return np.degrees(np.arctan2(-states[:, 7], states[:, 6]))


@pytest.mark.parametrize("task", ["landing", "follow"])
def test_through_the_door_it_is_safe_until_there_are_sticks(task):
    """By name, without a leader, a camera or a state; then the sticks are the command."""
    pilot = load_pilot("manual", task=task)
    assert pilot.act(look(0.0)) == SAFE_COMMAND and pilot.mode == "no sticks"
    assert put(pilot, 0.05, (0.6, 0.1, -0.2, 0.3))
    assert pilot.act(look(0.05)).vector.tolist() == [0.6, 0.1, -0.2, 0.3]
    assert pilot.mode == "manual"
    pilot.reset()
    assert pilot.act(look(0.05)) == SAFE_COMMAND and pilot.mode == "no sticks"


def test_silence_longer_than_200_ms_is_safe():
    """0.2 s after the stamp they still count, 0.21 s after it no more; new ones count at once."""
    pilot = load_pilot("manual")
    put(pilot, 1.0)
    assert pilot.act(look(1.2)).throttle == 0.5
    assert pilot.act(look(1.21)) == SAFE_COMMAND and pilot.mode == "sticks silent"
    put(pilot, 1.25)
    assert pilot.act(look(1.25)).throttle == 0.5
    put(pilot, 1.3, hold=False)
    assert pilot.act(look(1.3)) == SAFE_COMMAND and pilot.mode == "sticks released"


def test_silence_is_measured_on_the_clock_of_the_stamps():
    """In slow motion the flight's time nearly stands still, and the clock goes on."""
    now = [100.0]
    pilot = ManualPilot(MODEL, AIRFRAME, PAD, clock=lambda: now[0])
    put(pilot, 100.0)
    assert pilot.act(look(3.0)).throttle == 0.5
    now[0] = 100.3
    assert pilot.act(look(3.01)) == SAFE_COMMAND
    put(pilot, 200.0)  # of another clock
    assert pilot.act(look(3.02)) == SAFE_COMMAND


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, "1", None])
@pytest.mark.parametrize("place", range(4))
def test_sticks_that_are_no_numbers_are_ignored(bad, place):
    """The ones before stay until they are silent."""
    pilot = load_pilot("manual")
    put(pilot, 0.0, (0.4, 0.1, 0.1, 0.1))
    assert not put(pilot, 0.05, (*NEUTRAL[:place], bad, *NEUTRAL[place + 1 :]))
    assert pilot.act(look(0.05)).throttle == 0.4
    assert not pilot.sticks.put(Sticks(*NEUTRAL, hold=True, stamp=math.nan))


def test_sticks_beyond_their_travel_are_limited_and_said_to_be():
    """-1..1 and 0..1."""
    pilot = load_pilot("manual")
    put(pilot, 0.0, (1.5, -3.0, 2.0, 0.5))
    command = pilot.act(look(0.0))
    assert command.vector.tolist() == [1.0, -1.0, 1.0, 0.5] and command.saturated


def test_the_newest_sticks_count_whatever_the_order_of_threads():
    """Four threads put 500 stamps each in a random order; an older one never replaces a newer."""
    source = StickSource()
    stamps = np.random.default_rng(3).permutation(2000).reshape(4, 500)

    def send(row):
        for stamp in row:
            source.put(Sticks(*NEUTRAL, hold=True, stamp=float(stamp)))

    threads = [threading.Thread(target=send, args=(row,)) for row in stamps]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert source.newest.stamp == 1999.0
    assert not source.put(Sticks(*NEUTRAL, hold=True, stamp=1998.0))


def test_without_a_state_the_assist_says_so_and_passes_the_sticks():
    """None, and a state with a nan; a damaged history of commands is no error."""
    pilot = load_pilot("manual")
    pilot.assist = True
    state = state_at_pose(MODEL, (-18.0, -2.0, 1.5), (0.0, 0.085, 0.0))
    for t, broken in ((0.0, None), (0.05, replace(state, pitch=math.nan))):
        put(pilot, t, (0.3, 0.1, 0.2, 0.0))
        assert pilot.act(look(t, broken)).vector.tolist() == [0.3, 0.1, 0.2, 0.0]
        assert pilot.mode == "manual, no state for the assist"
    put(pilot, 0.1)
    command = pilot.act(Observation(0.1, None, np.full((30, 4), np.nan), state))
    assert pilot.mode == "manual, assist" and np.isfinite(command.vector).all()
    put(pilot, 0.15)
    wild = replace(state, v_world=np.array([1e200, 0.0, 0.0]), p_world=np.full(3, 1e200))
    assert np.isfinite(pilot.act(look(0.15, wild)).vector).all()


def test_an_assist_that_cannot_be_designed_is_refused_and_the_sticks_still_fly():
    """The nine-state model has no body rates for the loops."""
    pilot = ManualPilot(paper_model(), AIRFRAME, PAD)
    with pytest.raises(InputError, match="expected the 12-state model"):
        pilot.assist = True
    put(pilot, 0.0)
    assert pilot.act(look(0.0)).throttle == 0.5 and not pilot.assist


def test_neutral_sticks_hold_height_course_and_speed():
    """4 s from a trimmed flight with the measured state's noise: 0.15 m, 3 deg and 0.3 m/s, a tenth
    of the pad's start height, half of a tap's turn, and what the approach is wide.
    """
    states, _, contact = fly(lambda t: NEUTRAL, 4.0, (-18.0, -2.0, 1.5))
    assert contact is None
    assert np.abs(states[:, 2] - 1.5).max() < 0.15
    assert np.abs(course_deg(states)).max() < 3.0
    assert np.abs(np.linalg.norm(states[:, 6:9], axis=1) - 7.0).max() < 0.3


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_full_aileron_banks_to_its_limit_and_turns_to_its_side(side):
    """35 deg +- 4, and the coordinated turn's rate g tan(bank) / V = 56 deg/s +- 10 %; let go, it
    flies straight on: after 0.7 s the course changes by less than 4 deg.
    """
    states, _, contact = fly(
        lambda t: (0.5, side if t < 1.0 else 0.0, 0.0, 0.0), 2.2, (-18.0, -2.0, 2.0)
    )
    assert contact is None
    roll = side * np.degrees(states[:, 5])
    assert 31.0 < roll.max() < math.degrees(MAX_BANK) + 4.0
    assert roll.min() > -8.0
    course = side * course_deg(states)
    rate = math.degrees(9.81 * math.tan(MAX_BANK) / 7.0)
    assert (course[21] - course[13]) / 0.4 == pytest.approx(rate, rel=0.1)
    assert np.ptp(course[34:]) < 4.0
    assert np.abs(states[:, 2] - 2.0).max() < 0.3  # level in the turn


def test_elevator_climbs_and_descends_and_throttle_sets_the_speed():
    """8 deg at 7 m/s are 0.97 m/s; a second of it and no more, then level. Full throttle is
    8.5 m/s, fully back stops the motor.
    """
    for stick in (1.0, -1.0):
        elevator = stick
        states, _, _ = fly(
            lambda t, elevator=elevator: (0.5, 0.0, elevator if t < 1.0 else 0.0, 0.0),
            2.5,
            (-18.0, -2.0, 2.5),
        )
        assert stick * (states[-1, 2] - 2.5) == pytest.approx(1.0, abs=0.35)
        assert abs(states[-1, 8]) < 0.3
    states, _, _ = fly(lambda t: (1.0, 0.0, 0.0, 0.0), 2.5, (-18.0, -2.0, 1.5))
    assert np.linalg.norm(states[-1, 6:9]) == pytest.approx(8.5, abs=0.4)
    _, sent, _ = fly(lambda t: (0.0, 0.0, 0.0, 0.0), 0.5, (-18.0, -2.0, 1.5))
    assert (sent[:, 0] == 0.0).all()


def test_full_forward_beside_the_pad_levels_off_above_the_floor():
    """3 s from 1 m: nothing is touched, and the wheels, 0.12 m below the centre of gravity at
    most, stay more than half of the clearance up.
    """
    states, _, contact = fly(lambda t: (0.5, 0.0, -1.0, 0.0), 3.0, (-18.0, -6.0, 1.0))
    assert contact is None and len(states) == 60
    assert states[:, 2].min() > 0.5 * CLEARANCE + 0.12
    assert states[:, 2].min() < 0.6  # it did come down


def test_full_forward_over_the_pad_is_a_landing():
    """From 1 m, 10 m before the threshold: a wheel on the pad, wings level, below 1 m/s, the speed
    of a fall from 5 cm: firm, and softer only by hand.
    """
    _, _, contact = fly(lambda t: (0.5, 0.0, -1.0, 0.0), 6.0, (-9.0, -2.0, 1.0))
    assert contact is not None and contact.touchdown is not None and contact.touchdown.on_pad
    assert contact.touchdown.sink_rate < 1.0
    assert abs(math.degrees(contact.touchdown.bank)) < 5.0


def test_full_back_stays_below_the_beams():
    """Ten degrees of climb for 4.5 s would be 4.4 m more."""
    states, _, contact = fly(lambda t: (0.5, 0.0, 1.0, 0.0), 4.5, (-18.0, -2.0, 2.0))
    assert contact is None and 3.5 < states[:, 2].max() < 4.5


def test_near_the_floor_the_bank_is_limited():
    """Full aileron for 0.8 s with the wheels a quarter of a metre up, half of where all of the bank
    is free: 8 deg and half of 27 deg, +-5 deg; no wing tip touches the floor.
    """
    states, _, contact = fly(lambda t: (0.5, 1.0, 0.0, 0.0), 0.8, (-18.0, -3.0, 0.36))
    assert contact is None
    assert np.degrees(states[:, 5]).max() == pytest.approx(21.5, abs=6.5)
