"""Inverse maps: wind triangle, commands through biases and dead bands, tilted cameras, speeds of
other aircraft; expected values by hand or from the forward map.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.effects.camera_tilt import camera_tilt
from falconwing_kit.aircraft.generic import INPUT_FILTER
from falconwing_kit.aircraft.model import rates_model, scale_model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.inverse import (
    CommandMap,
    design_model,
    ground_speed,
    similar_speed,
    true_state,
    wind_velocity,
)
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import State

EAST_WIND = np.array([0.0, 3.0, 0.0])


def with_effect(name, **values):
    """The kit's model with an effect of the catalogue at these values."""
    effect = next(
        e for e in CATALOGUE if e.name == name and set(values) <= {p.name for p in e.parameters}
    )
    return rates_model().with_effect(effect).with_values(values)


def test_wind_triangle_by_hand():
    """3-4-5: 5 m/s through the air, 3 across leave 4 along; with the wind 5 + 3, against it 2."""
    along = np.array([1.0, 0.0, 0.0])
    assert ground_speed(5.0, along, EAST_WIND) == pytest.approx(4.0, abs=1e-12)
    assert ground_speed(5.0, np.array([0.0, 1.0, 0.0]), EAST_WIND) == pytest.approx(8.0, abs=1e-12)
    assert ground_speed(5.0, np.array([0.0, -1.0, 0.0]), EAST_WIND) == pytest.approx(2.0, abs=1e-12)


def test_winds_add_up_and_fall_off_with_the_jet():
    """A uniform wind, and a jet whose speed is e^(-1/2) one radius beside its centre."""
    _, jet = (e for e in CATALOGUE if e.name == "fan_jet")  # outdoors, in a hall
    model = with_effect("wind", wind_x=0.5, wind_y=-1.0).with_effect(jet)
    model = model.with_values(
        {"jet_x": 2.0, "jet_y": 0.0, "jet_at_x": 3.0, "jet_at_y": 1.0, "jet_radius": 2.0}
    )
    there = wind_velocity(model, np.array([5.0, 1.0, 1.0]), 0.0)
    assert there == pytest.approx([0.5 + 2.0 * math.exp(-0.5), -1.0, 0.0], abs=1e-12)
    assert not wind_velocity(design_model(model), np.zeros(3), 0.0).any()


def test_delays_of_effects_become_those_of_the_design():
    """Delay 0.02 + 0.08 s, lag 0.03 + 0.05 + 0.04 s; an advance ends at zero."""
    model = with_effect("control_delay", control_delay=0.08)
    for name, value in (("actuator_lag", 0.05), ("lag_in_series", 0.04)):
        effect = next(e for e in CATALOGUE if name in {p.name for p in e.parameters})
        model = model.with_effect(effect).with_values({name: value})
    design = design_model(model)
    assert design.values["delay"] == pytest.approx(0.10, abs=1e-12)
    assert design.values["lag"] == pytest.approx(0.12, abs=1e-12)
    memory = rates_model().with_effect(INPUT_FILTER)
    memory = memory.with_values({"stick_memory_1": 0.5, "stick_memory_2": 0.25})
    # Half of a command acts one row of 50 ms late, a quarter two rows.
    assert design_model(memory).values["delay"] == pytest.approx(0.02 + 0.05, abs=1e-12)
    band = with_effect("deadband", deadband=0.1)
    assert design_model(band).values["delay"] == pytest.approx(0.02, abs=1e-12)
    early = design_model(with_effect("control_delay", control_delay=-0.05))
    assert early.values["delay"] == 0.0


def test_trim_bias_is_fed_forward_exactly():
    """Commands are positions less the bias, positions are commands plus the bias; throttle free."""
    bias = np.array([0.0, 0.07, -0.11, 0.05])
    model = with_effect("trim_bias", bias_aileron=0.07, bias_elevator=-0.11, bias_rudder=0.05)
    command_map, positions = CommandMap(model), np.array([0.42, -0.13, 0.31, 0.02])
    assert command_map.commands(positions) == pytest.approx(positions - bias, abs=1e-12)
    assert command_map.positions(positions) == pytest.approx(positions + bias, abs=1e-12)


def test_dead_band_is_passed_over():
    """A position beyond the band is commanded as it is, one inside it next to the band's edge."""
    command_map = CommandMap(with_effect("deadband", deadband=0.10))
    commands = command_map.commands(np.array([0.05, 0.30, -0.06, 0.0]))
    assert commands[:2] == pytest.approx([0.05, 0.30], abs=1e-6)
    assert -0.12 < commands[2] < -0.09
    assert commands[3] == pytest.approx(0.0, abs=1e-2)


def test_dead_zone_is_added_to_every_command():
    """Positions 0.30 and -0.06 behind a zone of 0.10: commands 0.40 and -0.16, by the inverse."""
    command_map = CommandMap(with_effect("deadband", dead_zone=0.10))
    commands = command_map.commands(np.array([0.50, 0.30, -0.06, 0.0]))
    assert commands[:3] == pytest.approx([0.50, 0.40, -0.16], abs=2e-3)
    assert abs(commands[3]) <= 0.10 + 1e-9


def test_no_effect_changes_nothing():
    """The same arrays and the same model come back."""
    command_map, values = CommandMap(rates_model()), np.array([0.4, 0.1, -0.2, 0.0])
    assert command_map.is_identity and command_map.commands(values) is values
    model = rates_model()
    assert design_model(model) is model


def test_tilted_camera_is_taken_out_of_the_attitude():
    """The inverse of the catalogue's own forward map, at a banked attitude."""
    model = with_effect("camera_tilt", tilt_pitch=0.08, tilt_roll=-0.05)
    pose = np.array([1.0, 2.0, 1.5, 0.4, 0.12, -0.7])  # x y z roll pitch yaw
    x, y, z, roll, pitch, yaw = camera_tilt(pose, model.K)
    seen = State(np.array([x, y, z]), pitch, yaw, roll, np.array([7.0, 0.0, 0.0]))
    found = true_state(model, seen)
    assert (found.roll, found.pitch, found.yaw) == pytest.approx((0.4, 0.12, -0.7), abs=1e-9)
    assert true_state(rates_model(), seen) is seen


@pytest.mark.parametrize("mass", [0.075, 0.150, 0.300])
def test_similar_aircraft_fly_at_the_square_root_of_the_wing_loading(mass):
    """Half the mass on the same wing: 7 m/s / sqrt(2); twice: 7 sqrt(2) [1/2 rho V^2 S C = m g].

    The same angle of attack, whatever the size; 7 m/s for the kit's own aircraft.
    """
    model = scale_model(rates_model(), mass, 0.076, 0.70)
    speed = similar_speed(model, rates_model())
    assert speed == pytest.approx(7.0 * math.sqrt(mass / 0.150), abs=0.006)  # rounded to 1 cm/s
    # Trim has the thrust's lift too: 0.7 of full thrust at 5 deg is some percent of the weight.
    assert trim(model, speed).alpha == pytest.approx(trim(rates_model(), 7.0).alpha, abs=0.003)


def test_a_wing_without_lift_is_refused():
    """One sentence."""
    model = rates_model().with_values({"cL_0": -0.2, "cL_alpha": 0.05})
    with pytest.raises(InputError, match="expected lift"):
        similar_speed(model, rates_model())


def test_thrust_loss_raises_the_throttle_by_hand():
    """The same thrust from a share less: throttle / (1 - 0.3); nothing else of the trim changes."""
    steady, weak = trim(rates_model(), 7.0), trim(with_effect("thrust_loss", thrust_lost=0.3), 7.0)
    expected = steady.command / np.array([0.7, 1.0, 1.0, 1.0])
    assert weak.command == pytest.approx(expected, abs=1e-9)
    assert weak.alpha == pytest.approx(steady.alpha, abs=1e-9)


def test_battery_in_use_raises_the_throttle_with_time():
    """Sag 0.4/min: after 60 s the throttle is that of level flight / (1 - 0.4)."""
    model = with_effect("battery_sag", sag=0.4)
    fresh, later = trim(model, 7.0), trim(model, 7.0, time=60.0)
    assert later.command[0] == pytest.approx(fresh.command[0] / 0.6, abs=1e-9)


def test_trim_beyond_a_limit_is_returned_on_request():
    """A third of the thrust is too little for a climb of 8 deg: refused, or above full throttle."""
    model = with_effect("thrust_loss", thrust_lost=0.67)
    climb = math.radians(8.0)
    with pytest.raises(InputError, match="needs throttle"):
        trim(model, 7.0, climb)
    assert trim(model, 7.0, climb, within_limits=False).command[0] > 1.0


def test_a_wind_of_the_model_does_not_change_its_speed():
    """Speed is through the air."""
    model = with_effect("wind", wind_x=3.0, wind_y=1.0)
    assert similar_speed(design_model(model), rates_model()) == 7.0
    assert replace(design_model(model), effects=()) == design_model(model)
