"""Flights: the teacher lands, also beside another pilot; workers fly as this process does."""

import numpy as np
import pytest

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.learning.flights import AUXILIARY, Fleet, TaughtFlight, auxiliary_state
from falconwing_kit.learning.situations import NOMINAL, SPREAD_RANGES, draw_situation

MOUNT = np.array([0.2, 0.0, 0.0])


def taught(seed, ranges=NOMINAL, task="landing"):
    return TaughtFlight(draw_situation(task, seed, ranges, MOUNT))


def test_the_teacher_lands_on_the_centre_line():
    """Told the truth, without noise: within 2 cm, where noise of 1 cm and 0.7 deg costs it 6 cm."""
    flight = taught(1)
    while flight.flies:
        flight.advance(flight.teach())
    outcome = flight.outcome()
    assert outcome["landed"] and outcome["ald_m"] < 0.02
    assert 1.5 < outcome["past_threshold_m"] < 7.0 and outcome["sink_rate_m_s"] < 0.5


def test_a_teacher_beside_another_pilot_does_not_wind_up():
    """A second of level flight by hand beside the path, then its answer at the same place is the
    same whether it watched or not.
    """
    watching, fresh = taught(2), taught(2)
    level = watching.teach()
    for _ in range(20):
        watching.teach()
        for flight in (watching, fresh):
            flight.advance(level)
    assert watching.teach() == pytest.approx(fresh.teach(), abs=1e-9)


def test_the_teacher_follows():
    """Behind a leader on random waypoints, without losing it."""
    flight = taught(9, task="follow")
    while flight.flies:
        flight.advance(flight.teach())
    outcome = flight.outcome()
    assert outcome["success"] and outcome["ate_m"] < 0.8


def test_the_auxiliary_state_is_that_of_the_aircraft():
    """Distance left to the threshold over 10 m, then offset and height in metres."""
    flight, pad = taught(4), LandingPad()
    state = flight.world.state
    found = auxiliary_state(flight.situation, state, 0.0)
    assert found.shape == (AUXILIARY,)
    assert found[0] == pytest.approx((pad.x_start - state.p_world[0]) / 10.0)
    assert found[1] == pytest.approx(state.p_world[1] - pad.y_centre)
    assert found[2] == pytest.approx(state.p_world[2])


def test_workers_fly_the_same_flights_in_the_same_order():
    """Five flights in two processes and in this one, ten steps by the teacher: the same numbers to
    the rounding of linear algebra in other numbers of threads.
    """
    jobs, found = [("landing", 40 + k, SPREAD_RANGES, MOUNT) for k in range(5)], []
    for workers in (0, 2):
        fleet = Fleet(workers)
        try:
            fleet.prepare(jobs)
            situations = fleet.begin()
            fleet.send(None)
            for _ in range(10):
                snapshot = fleet.snapshot()
                fleet.send(snapshot.teacher)
            snapshot, outcomes = fleet.snapshot(), fleet.outcomes()
        finally:
            fleet.close()
        assert [outcome["seed"] for outcome in outcomes] == [s.seed for s in situations]
        found.append(snapshot)
    assert found[0].Ts_world_camera == pytest.approx(found[1].Ts_world_camera, abs=1e-6)
    assert found[0].teacher == pytest.approx(found[1].teacher, abs=1e-5)
    assert found[0].flies.all()
