"""Sparse terms: each load, wind, input and pose error against numbers worked by hand, and units."""

from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.integrate import _compile as compile_function
from falconwing_kit.aircraft.model import FORMS, parameter_record, rates_model
from falconwing_kit.aircraft.sparse import (
    SPARSE_EFFECTS,
    USUAL_NAMES,
    backlash,
    dead_band,
    delayed,
    formula,
)
from falconwing_kit.aircraft.terms import (
    Flow,
    air_flow,
    lift,
    pitch_moment,
    roll_moment,
    side_force,
    thrust,
    yaw_moment,
)

EFFECTS = {effect.name: effect for effect in SPARSE_EFFECTS}
AIR = air_flow((13.0, -2.0, 1.5), (0.4, -0.3, 0.2), (4.0, -5.0, 0.8), 12.0, (0.6, 0.3, -0.2, 0.5))


def loads(name, **values):
    """The six loads of one sparse term in AIR, zero but for these values."""
    model = rates_model().with_effect(EFFECTS[name])
    return np.array(EFFECTS[name].loads(AIR, model.with_values(values).K))


def change(term, **values):
    """Change of a textbook term when its coefficients grow by these values."""
    model = rates_model()
    more = {name: model.values[name] + value for name, value in values.items()}
    after, before = term(AIR, model.with_values(more).K), term(AIR, model.K)
    return np.array(after, float) - np.array(before, float)


@pytest.mark.parametrize(
    ("name", "parameter", "term", "derivative"),
    [
        ("lift with angle of attack", "lift_angle_of_attack", lift, "cL_alpha"),
        ("lift with elevator", "lift_elevator", lift, "cL_de"),
        ("side force with sideslip", "side_force_sideslip", side_force, "cY_beta"),
        ("thrust with throttle", "thrust_throttle", thrust, "kT"),
        ("roll moment with aileron", "roll_moment_aileron", roll_moment, "L_da"),
        ("roll moment with sideslip", "roll_moment_sideslip", roll_moment, "L_beta"),
        ("roll moment with roll rate", "roll_moment_roll_rate", roll_moment, "L_p"),
        ("pitch moment with pitch rate", "pitch_moment_pitch_rate", pitch_moment, "M_q"),
        (
            "pitch moment with airspeed squared",
            "pitch_moment_airspeed_squared",
            pitch_moment,
            "M_0",
        ),
        ("yaw moment with rudder", "yaw_moment_rudder", yaw_moment, "N_dr"),
        ("yaw moment with roll rate", "yaw_moment_roll_rate", yaw_moment, "N_p"),
    ],
)
def test_a_term_in_textbook_coordinates_is_that_derivative(name, parameter, term, derivative):
    """The law: a coefficient k of the term is k more of the model's own, of the same unit."""
    assert loads(name, **{parameter: 0.7}) == pytest.approx(change(term, **{derivative: 0.7}))
    unit = next(p.unit for p in rates_model().parameters if p.name == derivative)
    assert EFFECTS[name].parameters[0].unit == unit
    assert USUAL_NAMES[name].startswith(derivative)


@pytest.mark.parametrize(
    ("name", "parameter", "row", "by_hand", "unit"),
    [
        # rudder 0.5, V^2 = 169 + 4 + 2.25 + 0.01 = 175.26
        ("roll moment with rudder", "roll_moment_rudder", 3, 175.26 * 0.5, "1/m^2"),
        ("roll moment with rudder times airspeed", "roll_moment_rudder_times_airspeed", 3,
         np.sqrt(175.26) * 0.5, "1/(m s)"),
        ("pitch moment with throttle", "pitch_moment_throttle", 4, 0.6, "1/s^2"),
        ("yaw moment with throttle and pitch rate", "yaw_moment_throttle_and_pitch_rate", 5,
         0.6 * -0.3, "1/s"),
        ("side force with elevator squared", "side_force_elevator_squared", 1,
         175.26 * -0.2 * 0.2, "1/m"),
        ("pitch moment with time", "pitch_moment_time", 4, 175.26 * 12.0, "1/(m^2 s)"),
        ("constant roll moment", "constant_roll_moment", 3, 1.0, "1/s^2"),
        ("thrust with throttle and time", "thrust_throttle_and_time", 0, 0.6 * 12.0, "m/s^3"),
    ],
)  # fmt: skip
def test_terms_by_hand(name, parameter, row, by_hand, unit):
    """One load of six, by hand; the unit is that of the load over that of the regressor."""
    found = loads(name, **{parameter: 1.0})
    assert found[row] == pytest.approx(by_hand, rel=1e-12)
    assert np.count_nonzero(found) == 1
    assert EFFECTS[name].parameters[0].unit == unit


def test_drag_is_along_the_flight_path():
    """The law: it opposes the air-relative velocity and has the size of its equation."""
    found = loads("drag with size of aileron", drag_size_of_aileron=0.02)
    velocity = np.array([13.0, -2.0, 1.5])
    assert np.cross(found[:3], velocity) == pytest.approx(np.zeros(3), abs=1e-12)
    # |u| over V differs by the 0.1 m/s that keeps angles defined: 3e-5 of it.
    assert np.linalg.norm(found[:3]) == pytest.approx(0.02 * 175.26 * 0.3, rel=1e-4)
    assert found[:3] @ velocity < 0.0


def test_nearness_to_the_ground_decays_over_its_own_height():
    """By hand: 0.8 m up, with a decay of 0.4 m, exp(-2) of the moment on the ground."""
    name = "pitch moment with nearness to the ground"
    size, decay = (p.name for p in EFFECTS[name].parameters)
    assert loads(name, **{size: 1.0, decay: 0.4})[4] == pytest.approx(175.26 * np.exp(-2.0))
    assert EFFECTS[name].shape == (decay,)


def test_air_moves_as_its_name_says():
    """By hand at x = 4, y = -5, 0.8 m up and 12 s into the flight."""
    at = (4.0, -5.0, 0.8, 12.0)
    shear = EFFECTS["wind along y growing with height"].wind_field
    assert shear(*at, SimpleNamespace(air_along_y_growing_with_height=0.5)) == (0.0, 0.4, 0.0)
    wave = EFFECTS["updraught in waves over y"].wind_field
    K = SimpleNamespace(wave_z_over_y_sin=0.3, wave_z_over_y_cos=0.2, wave_z_over_y_length=20.0)
    # A quarter wave back: sin -1, cos 0.
    assert wave(*at, K) == pytest.approx((0.0, 0.0, -0.3), abs=1e-12)


def test_every_wavelength_over_the_area_is_near_one_tried():
    """A sine of unknown length over an extent: its phase at both ends is off by an eighth of a
    turn at most from one that is scanned, so it is not missed.
    """
    wave = EFFECTS["wind along x in waves over y"]
    tried = [v["wave_x_over_y_length"] for v in wave.scan(np.zeros(2), np.array([30.0, 12.0]))]
    waves = 12.0 / np.array(tried)
    for count in np.linspace(0.5, 6.0, 50):
        assert np.abs(waves - count).min() / 2.0 <= 0.125 + 1e-12


def test_play_of_a_linkage_by_hand():
    """Play of 0.2: the surface waits until the stick has crossed it, either way."""
    command = np.array([0.0, 0.05, 0.3, 0.25, 0.15, -0.2, 0.0])
    want = [0.0, 0.0, 0.2, 0.2, 0.2, -0.1, -0.1]
    assert backlash(np.arange(7.0), command, 0.2) == pytest.approx(want)
    assert np.array_equal(backlash(np.arange(7.0), command, 0.0), command)


def test_dead_band_and_delay_by_hand():
    """A band of 0.1 takes 0.1 from larger sticks and all of smaller ones; half a row late is
    half-way between rows.
    """
    command = np.array([0.05, 0.3, -0.4])
    assert dead_band(np.arange(3.0), command, 0.1) == pytest.approx([0.0, 0.2, -0.3])
    assert delayed(np.arange(3.0), command, 0.5) == pytest.approx([0.05, 0.175, -0.05])


@pytest.mark.parametrize(
    "effect", [e for e in SPARSE_EFFECTS if e.command_map], ids=lambda e: e.name
)
def test_an_input_change_moves_its_own_stick_only(effect):
    """By its name; nothing at zero, bit by bit."""
    sticks = np.random.default_rng(3).uniform(-0.9, 0.9, (40, 4))
    model, t = rates_model().with_effect(effect), 0.05 * np.arange(40)
    (p,) = effect.parameters
    moved = effect.command_map(t, sticks, model.K) - sticks
    column = ("throttle", "aileron", "elevator", "rudder").index(effect.name.split(" of the ")[1])
    assert np.abs(moved[:, column]).max() > 1e-3
    assert not np.delete(moved, column, axis=1).any()
    assert effect.command_map(t, sticks, model.with_values({p.name: 0.0}).K) is sticks


def test_names_are_taken_once_and_usual_names_are_of_terms():
    """An effect or parameter of one name elsewhere would be another one in a model file."""
    names = [e.name for e in SPARSE_EFFECTS]
    parameters = [p.name for e in SPARSE_EFFECTS for p in e.parameters]
    others = (*CATALOGUE, *GENERIC_EFFECTS)
    known = {p.name for e in others for p in e.parameters}
    known |= {n for form in FORMS.values() for n in form().names}
    terms = {term.name for form in FORMS.values() for term in form().terms}
    assert len(set(names)) == len(names) and len(set(parameters)) == len(parameters)
    assert not set(names) & ({e.name for e in others} | terms)
    assert not set(parameters) & known
    assert set(USUAL_NAMES) <= set(names)
    assert {form for e in CATALOGUE for form in e.same_form} <= set(names)
    assert all(p.name.isidentifier() for e in SPARSE_EFFECTS for p in e.parameters)
    assert all(p.low < 0.0 < p.start < p.high for e in SPARSE_EFFECTS for p in e.amplitudes)


def test_formula_is_the_equation_of_the_sentence():
    """As a reader sees it."""
    assert formula(EFFECTS["roll moment with rudder"]) == "dp/dt = ... + k V^2 rudder"
    assert formula(EFFECTS["play of the elevator"]) == "elevator = u with a play of k"


@pytest.mark.parametrize("name", ["roll moment with rudder", "lift with nearness to the ground"])
def test_sparse_terms_compile(name):
    """Compiled by numba, as flying does, they are the same loads."""
    effect = EFFECTS[name]
    names = tuple(p.name for p in effect.parameters)
    K = parameter_record(names)(*(0.3, 0.5)[: len(names)])
    air = Flow(*map(float, AIR))
    assert compile_function(effect.loads)(air, K) == pytest.approx(effect.loads(air, K), rel=1e-12)
