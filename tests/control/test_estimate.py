"""Estimate: stepwise simulation equals the whole one; the observer's error is below the
measurement's.
"""

import warnings

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.integrate import fly
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.estimate import Observer, SimulatedAircraft
from falconwing_kit.core.messages import State


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def shaken(rng, steady, n):
    """Control inputs around a trim, changed at random every fifth of a second."""
    return steady.command + np.repeat(0.15 * rng.normal(size=(n // 4 + 1, 4)), 4, axis=0)[:n]


@pytest.mark.parametrize("effect", [None, "deadband", "actuator_lag", "battery_sag"])
def test_stepwise_flight_equals_the_whole_flight(rng, effect):
    """Reference: `fly` with all commands, the link's 50 ms added to the delay of its model.

    To 1e-6: the stepwise flight neglects servo motion more than 0.6 s (e^-20) ago.
    """
    model = rates_model()
    if effect:
        model = model.with_effect(next(e for e in CATALOGUE if e.name == effect))
    steady = trim(rates_model(), 7.0)
    t = 0.05 * np.arange(61)
    commands = shaken(rng, steady, len(t))
    whole = fly(
        model.with_values({"delay": model.values["delay"] + 0.05}), steady.state, t, commands
    )
    aircraft = SimulatedAircraft(model, State.from_vector(steady.state), delay=0.05)
    for now, next_t, u in zip(t[:-1], t[1:], commands, strict=False):
        aircraft.send(now, u)
        aircraft.advance(next_t)
    assert np.abs(whole[-1] - steady.state).max() > 1.0  # the commands did something
    assert aircraft.x == pytest.approx(whole[-1], abs=1e-6)


def test_uneven_steps_fly_the_same(rng):
    """Late frames change the steps, not the times of the commands. To 1e-3: other Runge-Kutta
    steps.
    """
    steady = trim(rates_model(), 7.0)
    ends = []
    for times in (
        np.arange(0.05, 1.01, 0.05),
        np.array([0.05, 0.12, 0.2, 0.31, 0.5, 0.55, 0.7, 0.93, 1.0]),
    ):
        aircraft = SimulatedAircraft(rates_model(), State.from_vector(steady.state))
        aircraft.send(0.0, steady.command)
        aircraft.send(0.05, steady.command + np.array([0.1, 0.05, -0.05, 0.05]))
        for t in times:
            aircraft.advance(float(t))
        ends.append(aircraft.x)
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


def observed(rng, noise, truth_model, seconds=4.0):
    """Errors (n, 12) of the observer on a perturbed flight, from poses with noise [m], [rad]."""
    steady = trim(rates_model(), 7.0)
    aircraft, observer = (
        SimulatedAircraft(truth_model, State.from_vector(steady.state)),
        Observer(rates_model()),
    )
    commands, errors = shaken(rng, steady, round(seconds / 0.05)), []
    sent = np.zeros(4)
    for k, u in enumerate(commands):
        pose_noise = np.append(rng.normal(size=6) * np.repeat(noise, 3), np.zeros(6))
        estimate = observer.update(k * 0.05, State.from_vector(aircraft.x + pose_noise), sent)
        errors.append(estimate.vector - aircraft.x)
        aircraft.send(k * 0.05, sent := u)
        aircraft.advance((k + 1) * 0.05)
    return np.array(errors)


def test_observer_without_noise_and_model_error_has_no_error(rng):
    """No noise and the same model: nothing to correct."""
    assert np.abs(observed(rng, (0.0, 0.0), rates_model())).max() < 1e-9


def test_observer_beats_the_measurement(rng):
    """Below the measured 1 cm and 0.7 deg; velocities below half of those by differences, 0.01
    sqrt(2) / 0.05 s = 0.28 m/s; rates likewise, 0.0122 sqrt(2) / 0.05 = 0.35 rad/s.
    """
    rms = np.sqrt(np.mean(observed(rng, (0.01, np.radians(0.7)), rates_model())[10:] ** 2, axis=0))
    assert (rms[:3] < 0.009).all() and (rms[3:6] < np.radians(0.6)).all()
    assert (rms[6:9] < 0.14).all() and (rms[9:] < 0.17).all()


def test_observer_is_robust_to_model_errors(rng):
    """20 % less aileron, 10 % less thrust: errors below 10 cm and 3 deg."""
    values = rates_model().values
    other = rates_model().with_values({"L_da": 0.8 * values["L_da"], "kT": 0.9 * values["kT"]})
    errors = np.abs(observed(rng, (0.01, np.radians(0.7)), other)[10:])
    assert errors[:, :3].max() < 0.1 and np.degrees(errors[:, 3:6].max()) < 3.0


def test_observer_restarts_after_a_gap():
    """The measurement is taken as it is at the start, after a second without one, and after a
    reset.
    """
    observer, first = Observer(rates_model()), State.from_vector(trim(rates_model(), 7.0).state)
    moved = State.from_vector(first.vector + np.r_[5.0, np.zeros(11)])
    assert observer.update(0.0, first, np.zeros(4)) is first
    assert observer.update(1.0, moved, np.zeros(4)) is moved
    observer.reset()
    assert observer.update(1.05, first, np.zeros(4)) is first


def test_wild_poses_never_give_nan(rng):
    """Poses anywhere in the hall at any attitude, as a network gives them on bad images: the model
    that the observer simulates leaves all flight. The estimate stays finite, without a warning.
    """
    observer = Observer(rates_model())
    steady = trim(rates_model(), 7.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in range(400):
            x = steady.state.copy()
            x[:3] = rng.uniform((-22.0, -12.0, 0.0), (17.0, 8.0, 5.0))
            x[3:6] = rng.uniform(-np.pi, np.pi, 3) * (0.5, 1.0, 1.0)
            state = observer.update(0.05 * k, State.from_vector(x), rng.uniform(-1.0, 1.0, 4))
            assert np.isfinite(state.vector).all()
