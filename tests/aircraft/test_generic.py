"""Loads without a name: each goes with its one variable, along three axes, forces and moments
apart.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import (
    GENERIC_EFFECTS,
    GENERIC_LOADS,
    INPUT_FILTER,
    MOMENT_WITH_THRUST,
    REGRESSORS,
    STABILISER,
    fir_input_filter,
)
from falconwing_kit.aircraft.model import FORMS, rates_model
from falconwing_kit.aircraft.terms import THRUST_CURVE, Flow

# Twice the ordinary speed, so that V^2 counts four and V two; every field a number of its own.
AIR = Flow(
    airspeed=14.0,
    alpha=0.1,
    beta=-0.2,
    u=13.0,
    v=-2.8,
    w=1.4,
    p=1.5,
    q=2.0,
    r=3.0,
    px=4.0,
    py=5.0,
    height=0.5,
    time=30.0,
    throttle=0.5,
    aileron=0.1,
    elevator=0.2,
    rudder=0.3,
)
# Variable -> (its value in AIR by hand, the fields of the flow that it may depend on).
BY_HAND = {
    "airspeed": (4.0, {"airspeed"}),
    "angle of attack": (4 * 5 * 0.1, {"airspeed", "alpha"}),
    "angle of attack squared": (4 * 25 * 0.01, {"airspeed", "alpha"}),
    "sideslip": (4 * 10 * -0.2, {"airspeed", "beta"}),
    "sideslip squared": (4 * 100 * 0.04, {"airspeed", "beta"}),
    "roll rate": (2 * 1.5, {"airspeed", "p"}),
    "pitch rate": (2 * 2.0, {"airspeed", "q"}),
    "yaw rate": (2 * 3.0, {"airspeed", "r"}),
    "aileron": (4 * 3 * 0.1, {"airspeed", "aileron"}),
    "elevator": (4 * 3 * 0.2, {"airspeed", "elevator"}),
    "rudder": (4 * 3 * 0.3, {"airspeed", "rudder"}),
    "throttle": (0.5, {"throttle"}),
    "throttle and airspeed": (0.5 * 2, {"throttle", "airspeed"}),
    "throttle and aileron": (3 * 0.5 * 0.1, {"throttle", "aileron"}),
    "throttle and elevator": (3 * 0.5 * 0.2, {"throttle", "elevator"}),
    "height": (
        4 * np.exp(-1.0),
        {"airspeed", "height"},
    ),  # at half a metre, where the cushion has faded to 1/e
    "time": (4 * 0.5, {"airspeed", "time"}),
    "throttle and time": (0.5 * 0.5, {"throttle", "time"}),
    "place along x": (4 * 0.1 * 4, {"airspeed", "px"}),
    "place along y": (4 * 0.1 * 5, {"airspeed", "py"}),
}


def loads(effect, sizes, air=AIR):
    """(6, ...) at these values of the effect's three parameters."""
    K = SimpleNamespace(**dict(zip([p.name for p in effect.parameters], sizes, strict=True)))
    return np.stack(np.broadcast_arrays(*effect.loads(air, K), air.airspeed))[:-1]


def test_every_variable_has_a_force_and_a_moment():
    """By count: two for each, and each says in its name which it is and with what it goes."""
    assert set(REGRESSORS) == set(BY_HAND)
    assert [e.name for e in GENERIC_LOADS] == [
        f"{kind} with {v}" for v in REGRESSORS for kind in ("force", "moment")
    ]


@pytest.mark.parametrize("variable", REGRESSORS)
def test_a_variable_is_worth_what_its_name_says(variable):
    """By hand at twice the ordinary speed, AIR above."""
    assert REGRESSORS[variable](AIR) == pytest.approx(BY_HAND[variable][0], rel=1e-12)


@pytest.mark.parametrize("variable", REGRESSORS)
def test_a_load_goes_with_its_own_variable_and_no_other(variable):
    """Each field of the flow is moved alone: only those in the name, and the air's pressure, may
    change the load.
    """
    force, moment = (e for e in GENERIC_LOADS if e.name.split(" with ")[1] == variable)
    for field in Flow._fields:
        moved = AIR._replace(**{field: 1.3 * getattr(AIR, field)})
        for effect in (force, moment):
            same = np.array_equal(
                loads(effect, (1.0, 2.0, 3.0), moved), loads(effect, (1.0, 2.0, 3.0))
            )
            assert same == (field not in BY_HAND[variable][1]), (effect.name, field)


@pytest.mark.parametrize("effect", GENERIC_LOADS, ids=lambda e: e.name)
def test_each_parameter_acts_along_its_own_axis(effect):
    """1, 2 and 3 along x, y and z times the variable; a force turns nothing, a moment pushes
    nothing.
    """
    value = BY_HAND[effect.name.split(" with ")[1]][0] * np.array([1.0, 2.0, 3.0])
    want = [*value, 0.0, 0.0, 0.0] if effect.name.startswith("force") else [0.0, 0.0, 0.0, *value]
    assert loads(effect, (1.0, 2.0, 3.0)) == pytest.approx(np.array(want), rel=1e-12)
    assert [p.name[-2:] for p in effect.parameters] == ["_x", "_y", "_z"]
    assert {p.unit for p in effect.parameters} == {
        "m/s^2" if effect.name.startswith("force") else "rad/s^2"
    }


@pytest.mark.parametrize("effect", GENERIC_LOADS, ids=lambda e: e.name)
def test_loads_are_linear_in_their_parameters(effect):
    """Sums and multiples, as linear is defined, for a hundred flows at once; nothing at zero."""
    rng = np.random.default_rng(7)
    air = Flow(*rng.uniform(0.1, 2.0, (len(Flow._fields), 100)))
    a, b = rng.normal(size=(2, 3))
    together = loads(effect, 2.0 * a - 3.0 * b, air)
    assert together == pytest.approx(
        2.0 * loads(effect, a, air) - 3.0 * loads(effect, b, air), abs=1e-9
    )
    assert (
        np.all(loads(effect, (0.0, 0.0, 0.0), air) == 0.0)
        and np.abs(together).max(axis=1).min() == 0.0
    )
    assert np.ptp(together, axis=1).max() > 1e-3  # and it does act


def test_no_name_is_taken_twice():
    """Neither an effect's nor a parameter's, here, in the catalogue or in a model: two of one name
    would be one.
    """
    effects = [e.name for e in GENERIC_LOADS]
    parameters = [p.name for e in GENERIC_LOADS for p in e.parameters]
    terms = {term.name for form in FORMS.values() for term in form().terms}
    assert len(set(effects)) == len(effects) and not set(effects) & (
        {e.name for e in CATALOGUE} | terms
    )
    known = {p.name for e in CATALOGUE for p in e.parameters} | {
        n for form in FORMS.values() for n in form().names
    }
    assert len(set(parameters)) == len(parameters) and not set(parameters) & known


@pytest.mark.parametrize("effect", GENERIC_LOADS, ids=lambda e: e.name)
def test_a_fit_may_begin_and_may_say_nothing(effect):
    """Starts within bounds and off zero, zero within bounds, room to both sides; the model takes
    all three.
    """
    for p in effect.parameters:
        assert p.low < 0.0 < p.start < p.high and p.low == -p.high and p.name.isidentifier()
    model = rates_model().with_effect(effect)
    assert (
        model.names[-3:] == tuple(p.name for p in effect.parameters)
        and model.terms[-1] == effect.term()
    )


def test_a_moment_with_thrust_takes_the_model_s_own():
    """By hand at 10 m/s and half throttle: (9 - 0.5 10) 0.5 + 8 0.25 = 4 m/s^2, times 1, 2, 3."""
    model = rates_model().with_terms(THRUST_CURVE).with_effect(MOMENT_WITH_THRUST)
    values = {f"moment_thrust_{axis}": k for k, axis in enumerate("xyz", start=1)}
    K = model.with_values({**values, "kT": 9.0, "kTV": 0.5, "kTT": 8.0}).K
    air = AIR._replace(airspeed=10.0, throttle=0.5)
    assert model.terms[-1].evaluate(air, K) == pytest.approx((0.0, 0.0, 0.0, 4.0, 8.0, 12.0))
    assert model.terms[-1].of_propeller


def test_sticks_that_linger_by_hand():
    """A step from 0 to 1 of which a quarter comes one frame later and an eighth two: 0, 5/8, 7/8,
    1.
    """
    step = np.repeat([[0.0], [0.0], [1.0], [1.0], [1.0]], 4, axis=1)
    K = SimpleNamespace(stick_memory_1=0.25, stick_memory_2=0.125)
    moved = fir_input_filter(np.arange(5) * 0.05, step, K)
    assert moved == pytest.approx(
        np.repeat([[0.0], [0.0], [0.625], [0.875], [1.0]], 4, axis=1), abs=1e-12
    )
    assert (*GENERIC_LOADS, MOMENT_WITH_THRUST, STABILISER, INPUT_FILTER) == GENERIC_EFFECTS
