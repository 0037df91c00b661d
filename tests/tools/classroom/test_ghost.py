"""The ghost's distance is the prediction error of `sysid`, and grows with what the model lacks."""

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.integrate import fly
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.forecast import forecast, logged_states
from falconwing_kit.tools.classroom.ghost import (
    HORIZON_S,
    fly_ghost,
    ghost_data,
    nominal_model,
)
from falconwing_kit.tools.classroom.results import refly
from tests.tools.classroom.flights import fly_log

WIND = {"wind_x": 0.0, "wind_y": 1.0}


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """The same seed in still air, and with wind from the right from the first step on."""
    folder = tmp_path_factory.mktemp("flights")
    calm, _ = fly_log(folder / "calm.mcap")
    windy, _ = fly_log(folder / "windy.mcap", effects=[(0.0, "wind", True, WIND)])
    return refly(calm), refly(windy)


@pytest.mark.parametrize("horizon", [0.5, 1.0])
def test_distance_after_a_horizon_is_the_forecasts_error(flights, horizon):
    """`sysid.forecast` flies the same model from the same rows; only rounding separates them."""
    table, model = flights[1].table, nominal_model()
    found = forecast(model, table, horizon)
    ghost = fly_ghost(model, table, horizon)
    every = round(horizon / 0.05)
    anchors = [k for k in range(0, len(table.t), every) if k + every < len(table.t)]
    errors = [found.error_position[found.start == k][0] for k in anchors]
    ends = np.array(anchors) + every
    assert len(anchors) >= 2
    assert ghost.distance[ends] == pytest.approx(np.linalg.norm(errors, axis=1), rel=1e-9)
    rms = found.subset(np.isin(found.start, anchors)).position_m
    assert np.sqrt(np.mean(ghost.distance[ends] ** 2)) == pytest.approx(rms, rel=1e-9)
    moved = ghost.states[ends, :3] - table.p_world[ends]
    assert moved == pytest.approx(np.array(errors), abs=1e-9)


def test_ghost_from_the_start_is_the_model_flown_once(flights):
    """`aircraft.integrate.fly`, which settles its servos at the first command in the same way."""
    table, model = flights[1].table, nominal_model()
    ghost = fly_ghost(model, table, None)
    start = logged_states(table, 12)[0]
    flown = fly(model, start, table.t, table.commands)
    assert ghost.states[:, :3] == pytest.approx(flown[:, :3], abs=5e-3)


def test_in_still_air_the_ghost_stays_on_the_aircraft(flights):
    """The simulated aircraft is the nominal model behind the link: 1 cm for the rows in which its
    world holds the last state after the touchdown and for the switch of the servos' start.
    """
    calm = flights[0]
    ghost = fly_ghost(nominal_model(), calm.table)
    assert ghost.distance[0] == 0.0
    assert np.nanmax(ghost.distance[:-1]) < 0.01


def test_wind_carries_the_aircraft_away_from_its_ghost(flights):
    """Wind of 1 m/s to the left: a model without it stays right of the aircraft, by less than the
    1 m/s * t that a leaf would drift.
    """
    table = flights[1].table
    ghost = fly_ghost(nominal_model(), table, None)
    k = 30  # 1.5 s
    assert 0.05 < ghost.distance[k] < 1.5
    assert table.p_world[k, 1] > ghost.states[k, 1] + 0.05


def test_ghost_with_the_effect_in_its_model_stays(flights):
    """The model that `gap` would write, wind in it, flies where the aircraft flew."""
    (wind,) = [effect for effect in CATALOGUE if effect.name == "wind"]
    model = nominal_model().with_effect(wind).with_values(WIND)
    ghost = fly_ghost(model, flights[1].table)
    assert np.nanmax(ghost.distance[:-1]) < 0.06  # the wind begins one step after the start


def test_data_name_the_model_and_its_error(flights):
    """The sentence's number is that of `sysid.forecast`."""
    data = ghost_data(flights[1])
    table = flights[1].table
    horizon = min(HORIZON_S, 0.5 * table.duration)
    error = forecast(nominal_model(), table, horizon).position_m
    text = f"{100 * error:.0f} cm" if error < 1.0 else f"{error:.1f} m"
    assert text in data["note"] and data["model"] in data["note"]
    assert len(data["from_start"]["distance"]) == len(table.t)


def test_flights_too_short_or_without_velocities_are_one_sentence():
    """Two rows and velocities are needed."""
    t = np.array([0.0, 0.05])
    bare = FlightTable("bare", t, np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 4)))
    with pytest.raises(InputError, match="vx"):
        fly_ghost(nominal_model(), bare)
