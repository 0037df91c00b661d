"""The paper's one-step fit: exact on perfect states, biased by differentiated noise."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.inputs import actuator_response
from falconwing_kit.aircraft.integrate import roll_out
from falconwing_kit.aircraft.model import FORMS, paper_model, rates_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import body_rates
from falconwing_kit.sysid.one_step import differentiated_states, fit_one_step
from falconwing_kit.sysid.prepare import PreparedFlight
from tests.sysid.simulated import drawn, example_flight, example_found

SIGMA = np.full(6, 0.01)


def flight_of(t, states, commands):
    """A prepared flight whose smooth states are the true ones."""
    full = np.zeros((len(t), 12))
    full[:, : states.shape[1]] = states
    return PreparedFlight(
        "true", t, states[:, [0, 1, 2, 5, 3, 4]], commands, SIGMA, full, 0.0 * full
    )


@pytest.fixture(scope="module", params=sorted(FORMS))
def perfect(request):
    """20 s of random commands in the fit's own steps: aircraft, flight with the true states."""
    rng = np.random.default_rng(8)
    truth = drawn(FORMS[request.param](), rng)
    t = np.arange(401) * 0.05
    sticks = np.repeat(np.array([0.4, 0.0, 0.1, 0.0]) + rng.normal(0.0, 0.08, (101, 4)), 4, axis=0)[
        :401
    ]
    edges = t
    mean, _ = actuator_response(t, sticks, edges, truth.values["delay"], truth.values["lag"])
    substeps = 2 if request.param == "rates" else 1
    start = np.zeros(truth.n_states)
    start[[2, 3, 6]] = 30.0, 0.1, 7.0
    states = roll_out(truth, start, np.repeat(mean, substeps, axis=0), 0.05 / substeps)[::substeps]
    return truth, flight_of(t, states, sticks)


def test_perfect_states_give_the_aircraft_back(perfect):
    """The inverse of a prediction: states without noise, delay and lag known. 1e-3 because SciPy
    stops at 1e-8.
    """
    truth, flight = perfect
    start = FORMS[truth.form]().with_values({n: truth.values[n] for n in ("delay", "lag")})
    found = fit_one_step(start, [flight], smoothed=True)
    size = np.array([abs(p.start) or max(0.05 * (p.high - p.low), 1e-9) for p in truth.parameters])
    off = np.abs(found.vector - truth.vector) / size
    assert dict(zip(truth.names, off < 1e-3, strict=True)) == dict.fromkeys(truth.names, True)


def test_differences_of_a_straight_line_are_its_velocity():
    """By hand: 3 m/s forward, 1 m/s up, and a turn of 0.5 rad/s wings level, which is r = 0.5
    alone.
    """
    t = np.arange(60) * 0.05
    states = np.zeros((60, 9))
    states[:, 0], states[:, 2], states[:, 4] = 3.0 * t, 2.0 + t, 0.5 * t
    found = differentiated_states(flight_of(t, states, np.zeros((60, 4))))
    assert found.shape == (59, 12)
    assert found[:, 6:] == pytest.approx(np.tile([3.0, 0.0, 1.0, 0.0, 0.0, 0.5], (59, 1)), abs=1e-9)
    assert found[:, :6] == pytest.approx(states[:59, :6])


def test_differences_turn_centimetres_into_metres_a_second():
    """Errors propagate: the difference of two poses with 3 cm each over 50 ms has sqrt(2) 0.03 /
    0.05 = 0.85 m/s.
    """
    rng = np.random.default_rng(0)
    t = np.arange(20_001) * 0.05
    states = np.zeros((len(t), 9))
    states[:, :3] = rng.normal(0.0, 0.03, (len(t), 3))
    found = differentiated_states(flight_of(t, states, np.zeros((len(t), 4))))
    assert found[:, 6:9].std(axis=0) == pytest.approx(np.full(3, 0.849), rel=0.03)


def test_differences_convert_angle_rates_to_body_rates(perfect):
    """A banked turn by hand: yaw rate w, pitch 0, roll 0.6 gives q = w sin(0.6), r = w cos(0.6)."""
    t = np.arange(20) * 0.05
    states = np.zeros((20, 9))
    states[:, 4], states[:, 5] = 1.5 * t, 0.6
    found = differentiated_states(flight_of(t, states, np.zeros((20, 4))))[:, 9:]
    assert found == pytest.approx(
        np.tile([0.0, 1.5 * np.sin(0.6), 1.5 * np.cos(0.6)], (19, 1)), abs=1e-9
    )
    assert body_rates(0.6, 0.0, 0.0, 0.0, 1.5) == pytest.approx(found[0])


def test_a_missing_pose_spoils_its_two_differences_only():
    """By hand: without pose 10, the differences from 9 to 10 and from 10 to 11 are unknown."""
    t = np.arange(30) * 0.05
    states = np.cumsum(np.ones((30, 9)), axis=0) * 0.01
    states[10] = np.nan
    found = differentiated_states(flight_of(t, states, np.zeros((30, 4))))
    assert np.flatnonzero(np.isnan(found).any(axis=1)).tolist() == [9, 10]


def test_marker_noise_biases_it_far_more_than_shooting():
    """Recorded in a prototype on 10 minutes: 157 % median error for raw differences, 8.5 %
    smoothed, 0.33 % shooting. On a flight of one minute, raw differences are at least 20 times
    worse than shooting.
    """
    truth, _, _ = example_flight()
    found = example_found()
    flights = [flight for p in found.prepared for flight in p.flights]
    expected = np.array([truth.values[n] for n in truth.names if n not in ("delay", "lag")])

    def median_error(model):
        values = np.array([model.values[n] for n in truth.names if n not in ("delay", "lag")])
        return float(np.median(np.abs(values / expected - 1.0)))

    raw, smoothed = (
        median_error(fit_one_step(rates_model(), flights, smoothed=s)) for s in (False, True)
    )
    shooting = median_error(found.model)
    assert raw > 20.0 * shooting
    assert raw > smoothed > 2.0 * shooting


def test_delay_and_lag_stay_as_they_are(perfect):
    """One step of poses does not identify them; bounds stay as the caller gave them."""
    truth, flight = perfect
    start = FORMS[truth.form]().with_values({"delay": 0.07, "lag": 0.05})
    found = fit_one_step(start, [flight], smoothed=True)
    assert (found.values["delay"], found.values["lag"]) == (0.07, 0.05)
    assert found.parameters == start.parameters
    assert found.values["L_da"] != start.values["L_da"]


def test_bounds_hold(perfect):
    """A lower bound above the truth: the value ends there or above."""
    truth, flight = perfect
    bound = 1.3 * truth.values["L_da"]
    parameters = tuple(replace(p, low=bound) if p.name == "L_da" else p for p in truth.parameters)
    assert (
        fit_one_step(replace(truth, parameters=parameters), [flight], smoothed=True).values["L_da"]
        >= bound
    )


def test_fewer_steps_give_nearly_the_same(perfect):
    """`most` thins out the steps; without noise any subset gives the same values."""
    truth, flight = perfect
    start = FORMS[truth.form]().with_values({n: truth.values[n] for n in ("delay", "lag")})
    some = fit_one_step(start, [flight], smoothed=True, most=150)
    assert some.values["cL_alpha"] == pytest.approx(truth.values["cL_alpha"], rel=1e-3)
    assert some.values["M_de"] == pytest.approx(truth.values["M_de"], rel=1e-3)


def test_diverging_states_do_not_end_the_fit(perfect):
    """Poses that jump by 100 m between two frames are 2 km/s; the prediction overflows, and the
    result is still a model within its bounds.
    """
    truth, flight = perfect
    states = flight.state_estimate.copy()
    states[100:110, 6:] = 2000.0 * np.array([1.0, -1.0, 1.0, 0.5, -0.5, 0.5])
    found = fit_one_step(
        FORMS[truth.form](), [replace(flight, state_estimate=states)], smoothed=True
    )
    assert all(p.low <= found.values[p.name] <= p.high for p in found.parameters)


def test_too_few_poses_are_refused():
    """16 unknowns require 48 pairs of neighbouring poses; 20 rows have 18 pairs of raw states."""
    t = np.arange(20) * 0.05
    states = np.zeros((20, 9))
    states[:, 0], states[:, 6] = 7.0 * t, 7.0
    with pytest.raises(
        InputError, match="expected at least 48 pairs of neighbouring poses, got 18"
    ):
        fit_one_step(paper_model(), [flight_of(t, states, np.zeros((20, 4)))])
