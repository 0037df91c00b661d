"""Integration: both backends against scipy's own solver, against each other and against shifted
commands.
"""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.integrate import (
    ROLL_OUTS,
    SUBSTEPS,
    advance,
    fly,
    roll_out,
    step_batch,
)
from falconwing_kit.aircraft.model import (
    FORMS,
    add_uniform_wind,
    paper_model,
    rates_model,
    state_rates,
)
from falconwing_kit.aircraft.terms import Parameter, Term, WindTerm
from falconwing_kit.core.checks import InputError


def rising_push(air, K):
    return K.rise * air.time, 0.0, 0.0, 0.0, 0.0, 0.0


def swelling_wind(px, py, height, time, K):
    return K.swell * time, 0.0, 0.0


PUSH = Term(
    "push",
    (Parameter("rise", 2.0, 0.0, 5.0, "m/s^3", "forward push that grows with time"),),
    rising_push,
)
SWELL = WindTerm(
    "swell",
    (Parameter("swell", 1.5, 0.0, 5.0, "m/s^2", "tail wind that grows with time"),),
    swelling_wind,
)
# Few variants, each used by several tests: every one costs some seconds of compiling.
MODELS = {
    "paper": add_uniform_wind(paper_model(), 0.5, -0.3).with_terms(PUSH, SWELL),
    "rates": rates_model(),
}


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def flights(model, rng, count=3, steps=40):
    start = rng.normal(0.0, 0.1, (count, model.n_states))
    start[:, 2] += 2.0
    start[:, 6] += 7.0
    return start, np.array([0.4, 0.0, 0.1, 0.0]) + rng.normal(0.0, 0.1, (count, steps, 4))


def by_scipy(model, start, mean, slope, dt):
    """The flight of one aircraft by an eighth-order method to 1e-12, its controls linear within
    each step.
    """
    rates, x, flown = state_rates(model.form, model.terms, model.winds), start, [start]
    for k, (middle, half) in enumerate(zip(mean, slope, strict=True)):

        def state_derivative(t, x, k=k, middle=middle, half=half):
            return np.array(rates(t, x, middle + half * (2.0 * (t / dt - k) - 1.0), model.K), float)

        x = solve_ivp(
            state_derivative, (k * dt, (k + 1) * dt), x, "DOP853", rtol=1e-12, atol=1e-12
        ).y[:, -1]
        flown.append(x)
    return np.array(flown)


@pytest.mark.parametrize("backend", ROLL_OUTS)
@pytest.mark.parametrize("form", FORMS)
def test_flight_is_that_of_scipys_solver(form, backend, rng):
    """scipy's DOP853 to 1e-12, swings, wind and time included; a mode of 18 rad/s leaves 40 (18
    h)^5 / 120 = 6e-8.
    """
    model = MODELS[form]
    start, mean = flights(model, rng, count=1)
    slope = rng.normal(0.0, 0.05, mean.shape)
    flown = roll_out(model, start, mean, 0.0025, backend, slope)[0]
    assert np.abs(flown - by_scipy(model, start[0], mean[0], slope[0], 0.0025)).max() < 1e-7


@pytest.mark.parametrize("backend", ROLL_OUTS)
@pytest.mark.parametrize("form", FORMS)
def test_halving_the_step_divides_the_error_by_sixteen(form, backend, rng):
    """Order four of the classical Runge-Kutta method, against 1/16 of the step; Euler would give 2,
    midpoint 4.
    """
    model = MODELS[form]
    start, _ = flights(model, rng, count=1)
    sticks = np.array([0.4, 0.05, 0.1, -0.05])

    def end(step):
        return roll_out(model, start, np.tile(sticks, (1, round(0.6 / step), 1)), step, backend)[
            0, -1
        ]

    exact = end(0.02 / 16)
    errors = [np.abs(end(step) - exact).max() for step in (0.02, 0.01, 0.005)]
    assert 12.0 < errors[0] / errors[1] < 20.0
    assert 12.0 < errors[1] / errors[2] < 20.0


@pytest.mark.parametrize("form", FORMS)
def test_one_aircraft_flies_as_in_a_batch_of_one(form, rng):
    """The same arithmetic on numbers and on arrays of one, to the bit; the input map included."""
    model = MODELS[form]
    (start,), (commands,) = flights(model, rng, count=1, steps=20)
    times = 0.05 * np.arange(20)
    one = advance(model, 0.2, 0.9, start, times, commands)
    (other,) = advance(model, 0.2, 0.9, start[:, None], times, commands).T
    assert one.shape == (model.n_states,) and np.array_equal(one, other)


@pytest.mark.parametrize("form", FORMS)
def test_compiled_equals_batch_to_rounding(form, rng):
    """The same arithmetic; 40 steps of numbers near 10 leave 1e-12, twice over for a spiral that
    grows.
    """
    model = MODELS[form]
    start, mean = flights(model, rng)
    for slope in (None, rng.normal(0.0, 0.05, mean.shape)):
        one = roll_out(model, start, mean, 0.025, "batch", slope)
        other = roll_out(model, start, mean, 0.025, "compiled", slope)
        assert np.abs(one - other).max() < 1e-11


def test_every_effect_flies_compiled_as_in_batch(rng):
    """The same arithmetic, with every load and wind of the catalogue in one model, compiled once;
    each at its starting value, where it changes the flight. One wind by itself, and a load made of
    the model's own terms, are compiled apart.
    """
    plain = model = MODELS["rates"]
    effects = [effect for effect in CATALOGUE if effect.changes_flow]
    start, mean = flights(plain, rng, count=2)
    flown = roll_out(plain, start, mean, 0.025)
    for effect in effects:
        alone = roll_out(plain.with_effect(effect), start, mean, 0.025)
        assert np.abs(alone - flown).max() > 1e-6, effect.name
        model = model.with_effect(effect)
    wind = next(effect for effect in effects if effect.wind_field)
    load = next(effect for effect in effects if effect.loads_of)
    for each in (model, plain.with_effect(wind).with_effect(load)):
        one, other = (roll_out(each, start, mean, 0.025, backend) for backend in ROLL_OUTS)
        assert np.isfinite(one).all() and np.abs(one - other).max() < 1e-10


@pytest.mark.parametrize("backend", ROLL_OUTS)
def test_time_runs_with_the_steps(backend):
    """By hand: a push 2 t with nothing else gives vx = t^2, px = t^3 / 3, exact for a fourth-order
    method.
    """
    model = MODELS["paper"]
    model = model.with_vector(np.zeros(len(model.names))).with_values({"rise": 2.0})
    flown = roll_out(model, np.zeros(9), np.zeros((20, 4)), 0.05, backend)
    t = np.arange(21) * 0.05
    assert flown[:, 6] == pytest.approx(t**2, abs=1e-12)
    assert flown[:, 0] == pytest.approx(t**3 / 3.0, abs=1e-12)


@pytest.mark.parametrize("backend", ROLL_OUTS)
def test_one_start_and_many_commands_fly_as_each_alone(backend, rng):
    """Broadcasting is nothing but repetition."""
    model = MODELS["rates"]
    start, mean = flights(model, rng)
    alone = [roll_out(model, start[0], commands, 0.025, backend) for commands in mean]
    assert np.array_equal(roll_out(model, start[0], mean, 0.025, backend), alone)
    alone = [roll_out(model, one, mean[0], 0.025, backend) for one in start]
    assert np.array_equal(roll_out(model, start, mean[0], 0.025, backend), alone)
    assert alone[0].shape == (41, 12)
    assert np.array_equal(alone[1][0], start[1])


def test_parameters_may_differ_within_a_batch(rng):
    """A record of arrays flies each aircraft with its own values, as fits do."""
    heavy, light = rates_model(), rates_model().with_values({"cL_0": 0.1, "kT": 8.0})
    start, mean = flights(heavy, rng, count=2, steps=1)
    rates, both = state_rates("rates", heavy.terms, ()), np.array([heavy.vector, light.vector]).T
    K = type(heavy.K)(*both)
    after = step_batch(rates, K, 0.0, start.T, mean[:, 0].T, 0.025)
    for k, model in enumerate((heavy, light)):
        assert after[:, k] == pytest.approx(
            roll_out(model, start[k], mean[k], 0.025)[-1], abs=1e-14
        )


@pytest.mark.parametrize("backend", ROLL_OUTS)
@pytest.mark.parametrize("form", FORMS)
def test_logged_sticks_act_a_row_later_with_a_delay_of_a_row(form, backend, rng):
    """By meaning of the word: flown with the table moved by one row and no delay, it is the same
    flight.
    """
    t, sticks = np.arange(30) * 0.05, np.array([0.4, 0.0, 0.1, 0.0]) + rng.normal(0.0, 0.1, (30, 4))
    model = MODELS[form].with_values({"delay": 0.05, "lag": 0.0})
    start = flights(model, rng)[0][0]
    late = fly(model, start, t, sticks, backend)
    moved = fly(
        model.with_values({"delay": 0.0}),
        start,
        t,
        np.concatenate([sticks[:1], sticks[:-1]]),
        backend,
    )
    assert late.shape == (30, model.n_states)
    assert np.abs(late - moved).max() < 1e-10


@pytest.mark.parametrize("form", FORMS)
def test_flying_takes_the_stated_substeps(form, rng):
    """Commands held over a row without delay or lag: `fly` is `roll_out` with each row repeated."""
    model = MODELS[form].with_values({"delay": 0.0, "lag": 0.0})
    start, mean = flights(model, rng, count=1)
    t, n = np.arange(41) * 0.05, SUBSTEPS[form]
    sticks = np.concatenate([mean[0], mean[0, -1:]])
    by_hand = roll_out(model, start[0], np.repeat(mean[0], n, axis=0), 0.05 / n)[::n]
    assert np.abs(fly(model, start[0], t, sticks) - by_hand).max() < 1e-10


def test_a_servo_lag_shows_in_the_flight(rng):
    """scipy's solver with the servo as four more states, 50 ms lag and 20 ms delay; both models
    hold sticks by rows.

    The kit replaces the servo's curve within 25 ms by mean and slope: that leaves 2e-6 m; one step
    a row leaves 3e-5.
    """
    model = rates_model().with_values({"delay": 0.02, "lag": 0.05})
    t, sticks = np.arange(31) * 0.05, np.array([0.4, 0.0, 0.1, 0.0]) + rng.normal(0.0, 0.1, (31, 4))
    start = flights(model, rng)[0][0]
    rates, y = state_rates("rates", model.terms, ()), np.concatenate([start, sticks[0]])
    flown, edges = [start], np.sort(np.concatenate([t, t[1:-1] + 0.02]))

    for begin, end in pairwise(edges):
        held = sticks[max(0, int(np.searchsorted(t + 0.02, begin + 1e-9, side="right")) - 1)]

        def slope(time, y, held=held):
            return np.concatenate([rates(time, y[:12], y[12:], model.K), (held - y[12:]) / 0.05])

        y = solve_ivp(slope, (begin, end), y, "DOP853", rtol=1e-10, atol=1e-10).y[:, -1]
        if np.abs(t - end).min() < 1e-9:
            flown.append(y[:12])
    error = fly(model, start, t, sticks) - flown
    assert np.abs(error[:, :3]).max() < 1e-5
    assert np.abs(error[:, 3:6]).max() < 1e-5


# Saying no
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"start": np.zeros(9)}, r"start: expected shape \(any, 12\), got \(1, 9\)"),
        (
            {"start": np.zeros((2, 12)), "commands": np.zeros((3, 5, 4))},
            "equal batches, got 2 and 3",
        ),
        ({"commands": np.zeros((5, 3))}, r"commands: expected shape .*4.*got \(1, 5, 3\)"),
        ({"commands": np.zeros(4)}, "commands: expected shape"),
        ({"dt": 0.0}, "dt: expected a finite number"),
        ({"dt": float("nan")}, "dt: expected a finite number"),
        ({"backend": "fast"}, "backend: expected one of batch, compiled, got 'fast'"),
        ({"slope": np.zeros((4, 4))}, "slope: expected shape"),
    ],
)
def test_a_wrong_shape_is_told_in_one_sentence(change, words):
    """What was wanted and what came."""
    right = {
        "start": np.zeros(12),
        "commands": np.zeros((5, 4)),
        "dt": 0.025,
        "backend": "batch",
        "slope": None,
    }
    with pytest.raises(InputError, match=words):
        roll_out(rates_model(), **{**right, **change})


def test_uneven_times_are_refused():
    """The step of `fly` is one number."""
    t = np.arange(10) * 0.05
    t[4] += 0.01
    with pytest.raises(InputError, match="evenly spaced"):
        fly(rates_model(), np.zeros(12), t, np.zeros((10, 4)))


def test_times_and_commands_must_have_one_row_each():
    """A row of sticks for each time."""
    with pytest.raises(InputError, match=r"commands: expected shape \(10, 4\), got \(9, 4\)"):
        fly(rates_model(), np.zeros(12), np.arange(10) * 0.05, np.zeros((9, 4)))


def test_a_single_row_is_a_flight_of_one_state():
    """Nothing to fly: the start comes back."""
    start = np.array([0, 0, 2.0, 0, 0, 0, 7.0, 0, 0, 0, 0, 0])
    assert np.array_equal(fly(rates_model(), start, np.array([3.0]), np.zeros((1, 4))), start[None])
