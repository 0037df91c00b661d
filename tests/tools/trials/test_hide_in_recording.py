"""Effects hidden in a recording: against the kit's model flown with the effect, and by inverses.

The model shares no line with the transforms: it flies with an effect of the catalogue from the
stated commands, and has to measure what the transform of its own flight without the effect says.
"""

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.integrate import roll_out
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import rotation_world_body, wrap_angle
from falconwing_kit.data import load_flight
from falconwing_kit.tools.trials.hide_in_recording import (
    add_wind,
    delay_commands,
    drain_battery,
    move_camera,
    move_trim,
    restate_commands,
    split_recording,
    tilt_camera,
    turn_heading,
    weaken_aileron,
    weaken_propeller,
    widen_dead_zone,
)

DT = 0.05
START = np.array([0.0, 0.0, 3.0, 0.05, 0.3, 0.1, 6.9, -1.5, 0.2, 0.1, 0.0, 0.2])


def commands() -> np.ndarray:
    """Four seconds with steps on every stick, none beyond half."""
    t = np.arange(0.0, 4.0, DT)
    steps = np.sign(np.sin(np.outer(t, [3.1, 4.3, 2.3]) + 0.4)) * [0.2, 0.15, 0.2]
    return np.column_stack([0.5 + 0.1 * np.sign(np.sin(1.7 * t + 0.1)), steps])


def fly(model: Model, stated: np.ndarray, start: np.ndarray = START) -> FlightTable:
    """The model's own flight at its rows, with the velocities and body rates it had."""
    t = DT * np.arange(len(stated))
    mean, slope = model.actuator_positions(t, stated, t[None], model.K)
    x = roll_out(model, start, mean[0], DT, slope=slope[0])
    pose = np.column_stack([x[:, :3], x[:, [5, 3, 4]]])
    for effect in model.effects:
        if effect.hidden_map:
            pose = np.stack([effect.hidden_map(row, model.K) for row in pose])
    extra = {name: x[:, 6 + i] for i, name in enumerate(("vx", "vy", "vz", "p", "q", "r"))}
    return FlightTable("flown.csv", t, pose[:, :3], pose[:, 3:], stated, extra)


@pytest.fixture(scope="module")
def recording() -> FlightTable:
    """As if recorded: the model without an effect."""
    return fly(rates_model(), commands())


def with_effect(name: str, **size: float) -> Model:
    (form,) = (e for e in CATALOGUE if e.name == name and {*size} <= {p.name for p in e.parameters})
    return rates_model().with_effect(form).with_values(size)


@pytest.mark.parametrize(
    ("name", "size", "hide"),
    [
        ("thrust_loss", {"thrust_lost": 0.3}, lambda r: weaken_propeller(r, 0.3)),
        ("battery_sag", {"sag": 0.9}, lambda r: drain_battery(r, 0.9)),
        ("aileron_loss", {"aileron_lost": 0.4}, lambda r: weaken_aileron(r, 0.4)),
        (
            "trim_bias",
            {"bias_aileron": 0.1, "bias_elevator": -0.08, "bias_rudder": 0.12},
            lambda r: move_trim(r, 0.1, -0.08, 0.12),
        ),
        ("control_delay", {"control_delay": 0.1}, lambda r: delay_commands(r, 0.1)),
        (
            "camera_tilt",
            {"tilt_pitch": 0.1, "tilt_roll": -0.07},
            lambda r: tilt_camera(r, 0.1, -0.07),
        ),
    ],
)
def test_the_model_with_the_effect_flies_the_hidden_log(recording, name, size, hide):
    """The catalogue's equation of the effect, flown from the stated commands, measures the poses of
    the transformed log; without the effect it is off by more than 4 cm or 0.5 deg.

    Commands act as before to rounding. The battery drains within a step too, but the log states it
    at the step's beginning: on average 0.9/60 * 0.025 of the thrust of 6 m/s^2, 2 cm after 4 s.
    """
    hidden = hide(recording)
    flown = fly(with_effect(name, **size), hidden.commands)
    without = fly(rates_model(), hidden.commands)
    p_limit, angle_limit = (0.02, 0.01) if name == "battery_sag" else (1e-9, 1e-9)
    assert len(hidden.t) == len(recording.t) - (2 if name == "control_delay" else 0)
    assert np.abs(flown.p_world - hidden.p_world).max() < p_limit
    assert np.abs(wrap_angle(flown.attitude - hidden.attitude)).max() < angle_limit
    p_error = np.abs(without.p_world - hidden.p_world).max()
    assert p_error > 0.04 or np.abs(without.attitude - hidden.attitude).max() > np.radians(0.5)


def test_the_model_in_wind_flies_the_moved_path(recording):
    """Galilei: a start that moves with the air, the same commands, the same attitudes."""
    wind = np.array([0.7, -0.4, 0.0])
    hidden = add_wind(recording, tuple(wind))
    start = START.copy()
    start[6:9] += wind
    flown = fly(with_effect("wind", wind_x=0.7, wind_y=-0.4), recording.commands, start)
    assert np.abs(flown.p_world - hidden.p_world).max() < 1e-9
    assert np.abs(wrap_angle(flown.attitude - hidden.attitude)).max() < 1e-9
    for name in ("vx", "vy", "vz"):
        assert hidden.extra[name] == pytest.approx(flown.extra[name], abs=1e-9)


def test_wind_adds_itself_to_every_velocity_of_the_recording():
    """Galilei on the measured flight: differences of positions over differences of times."""
    flight = load_flight("sport_cub")
    wind = (0.3, -0.2, 0.05)
    windy = add_wind(flight, wind)
    v, v_windy = (np.diff(f.p_world, axis=0) / np.diff(f.t)[:, None] for f in (flight, windy))
    change = (v_windy - v)[np.isfinite(v).all(axis=1)]
    assert np.abs(change - wind).max() < 1e-9
    assert windy.attitude is flight.attitude and windy.commands is flight.commands


@pytest.mark.parametrize(
    ("there", "back"),
    [
        (lambda r: add_wind(r, (1.0, 2.0, 0.0)), lambda r: add_wind(r, (-1.0, -2.0, 0.0))),
        (lambda r: move_trim(r, 0.1, 0.05, -0.1), lambda r: move_trim(r, -0.1, -0.05, 0.1)),
        (lambda r: tilt_camera(r, 0.2, 0.0), lambda r: tilt_camera(r, -0.2, 0.0)),
        (lambda r: tilt_camera(r, 0.0, 0.3), lambda r: tilt_camera(r, 0.0, -0.3)),
        (lambda r: turn_heading(r, 0.2), lambda r: turn_heading(r, -0.2)),
        (lambda r: move_camera(r, (0.2, 0.1, -0.05)), lambda r: move_camera(r, (-0.2, -0.1, 0.05))),
        (lambda r: weaken_propeller(r, 0.2), lambda r: restate_commands(r, (0.8, 1.0, 1.0, 1.0))),
        (lambda r: weaken_aileron(r, 0.5), lambda r: restate_commands(r, (1.0, 0.5, 1.0, 1.0))),
    ],
)
def test_each_transform_has_an_inverse_and_changes_something(recording, there, back):
    """On the measured flight where it has room, and on the simulated one."""
    cub = restate_commands(load_flight("sport_cub"), (0.6, 0.4, 0.4, 0.5))
    for flight in (recording, cub):
        moved, again = there(flight), back(there(flight))
        columns = ("p_world", "attitude", "commands")
        for column in columns:
            one, two = getattr(flight, column), getattr(again, column)
            angle = wrap_angle(one - two) if column == "attitude" else one - two
            assert np.nanmax(np.abs(angle)) < 1e-9
            assert np.array_equal(np.isnan(one), np.isnan(two))
        assert (
            max(np.nanmax(np.abs(getattr(moved, c) - getattr(flight, c))) for c in columns) > 0.01
        )


def test_the_stated_sticks_pass_the_dead_zone_as_the_given_ones(recording):
    """The textbook's dead zone, sign(u) max(|u| - size, 0), written out here; throttle as it is."""
    stated = widen_dead_zone(recording, 0.07).commands
    passed = np.sign(stated) * np.maximum(np.abs(stated) - 0.07, 0.0)
    assert np.abs(passed[:, 1:] - recording.commands[:, 1:]).max() < 1e-12
    assert np.array_equal(stated[:, 0], recording.commands[:, 0])
    assert np.abs(stated[:, 1:] - recording.commands[:, 1:]).min() > 0.069


def test_a_moved_camera_has_the_velocity_of_a_rigid_body(recording):
    """v + omega x d: central differences of the moved positions against the columns, to what the
    steps of 0.05 s leave, 2 % of the arm's own velocity and 5 mm/s.
    """
    arm = (0.25, 0.05, -0.1)
    moved = move_camera(recording, arm)
    distance = np.linalg.norm(moved.p_world - recording.p_world, axis=1)
    assert distance == pytest.approx(np.linalg.norm(arm), abs=1e-12)
    R_world_body = rotation_world_body(*recording.attitude.T)
    assert moved.p_world - recording.p_world == pytest.approx(R_world_body @ np.array(arm))
    change = (moved.p_world - recording.p_world)[2:] - (moved.p_world - recording.p_world)[:-2]
    v_arm = np.column_stack([moved.extra[k] - recording.extra[k] for k in ("vx", "vy", "vz")])
    error = change / (2.0 * DT) - v_arm[1:-1]
    assert np.sqrt((error**2).mean()) < 0.02 * np.sqrt((v_arm**2).mean()) + 0.005
    assert np.sqrt((v_arm**2).mean()) > 0.05


def test_a_camera_turned_up_reads_a_higher_pitch_in_level_flight():
    """By hand: wings level, 3 deg up and 2 deg right side down add to pitch and roll."""
    level = FlightTable(
        "level.csv", np.arange(3.0), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 4))
    )
    for pitch, roll in ((np.radians(3.0), 0.0), (0.0, np.radians(2.0))):
        tilted = tilt_camera(level, pitch, roll)
        assert tilted.attitude == pytest.approx(np.tile([roll, pitch, 0.0], (3, 1)), abs=1e-12)
    headed = turn_heading(level, 0.1)
    assert headed.attitude[:, 2] == pytest.approx(0.1) and (headed.p_world == 0.0).all()


def test_a_delay_takes_the_command_that_was_held_later(recording):
    """By hand at 20 Hz: 0.1 s are two rows, 0.12 s too (held until the next row)."""
    for seconds in (0.1, 0.12):
        hidden = delay_commands(recording, seconds)
        kept = len(hidden.t)
        assert kept == len(recording.t) - (2 if seconds == 0.1 else 3)
        assert np.array_equal(hidden.commands, recording.commands[2 : 2 + kept])
        assert np.array_equal(hidden.p_world, recording.p_world[:kept])


def test_restated_sticks_fly_the_same_with_other_derivatives(recording):
    """A linear map of the sticks is absorbed: control derivatives over the scale, and the moments
    at zero stick.
    """
    scale, centre = (0.8, 0.5, 0.4, 0.9), (0.0, 0.1, -0.05, 0.02)
    stated = restate_commands(recording, scale, centre)
    model = rates_model()
    K = model.values
    values = {name: K[name] / scale[0] for name in ("kT", "kTV")}
    for column, names, zero in (
        (1, ("L_da",), "L_0"), (2, ("M_de", "cL_de"), None), (3, ("N_dr", "cY_dr"), "N_0"),
    ):  # fmt: skip
        values |= {name: K[name] / scale[column] for name in names}
        if zero:
            values[zero] = K[zero] + K[names[0]] * centre[column]
    values |= {"M_0": K["M_0"] + K["M_de"] * centre[2], "cL_0": K["cL_0"] + K["cL_de"] * centre[2]}
    flown = fly(model.with_values(values), stated.commands)
    # The side force of the rudder has no term at zero stick: 0.02 of full rudder is left.
    assert np.abs(flown.attitude - recording.attitude).max() < np.radians(0.3)
    assert np.abs(flown.p_world - recording.p_world).max() < 0.02
    moved = fly(model, stated.commands)
    assert np.abs(moved.attitude - recording.attitude).max() > np.radians(5.0)


def test_both_parts_of_a_recording_are_measured_and_apart():
    """Every row behind the beginning is in one part, unchanged; a second call gives the same."""
    flight = load_flight("sport_cub")
    for block_s in (None, 20.0):
        parts = split_recording(flight, 5.0, block_s)
        t = np.concatenate([part.t for part in parts])
        assert np.array_equal(np.sort(t), flight.t[flight.t >= 5.0])
        for part, again in zip(parts, split_recording(flight, 5.0, block_s), strict=True):
            rows = np.searchsorted(flight.t, part.t)
            assert np.array_equal(part.p_world, flight.p_world[rows], equal_nan=True)
            assert np.array_equal(part.commands, flight.commands[rows])
            assert np.array_equal(part.t, again.t) and len(part.labels["source"]) == len(part.t)
    first, second = split_recording(flight, 5.0)
    assert first.t[-1] < second.t[0] and abs(first.duration - second.duration) < 0.2
    first, second = split_recording(flight, 5.0, 20.0)
    assert 24.9 < second.t[0] < 25.1 and first.t[-1] > second.t[0]


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda r: weaken_propeller(r, 0.9), "expected throttle in 0..1"),
        (lambda r: weaken_aileron(r, 0.9), "expected aileron in -1..1"),
        (lambda r: weaken_aileron(r, 1.0), "share: expected a finite number"),
        (lambda r: move_trim(r, elevator=1.0), "expected elevator in -1..1"),
        (lambda r: delay_commands(r, -0.1), "seconds: expected a finite number"),
        (lambda r: drain_battery(r, 30.0), "share of the thrust left"),
        (lambda r: restate_commands(r, (1.0, 0.0, 1.0, 1.0)), "scale: expected"),
        (lambda r: restate_commands(r, centre=(0.1, 0.0, 0.0, 0.0)), "centre: expected 0"),
        (lambda r: split_recording(r, 100.0), "begin: expected a finite number"),
        (lambda r: split_recording(r, 3.0, 2.0), "expected rows for two parts"),
        (lambda r: add_wind(r, (1.0, 2.0)), "wind_world: expected shape"),
    ],
)
def test_what_cannot_be_hidden_is_refused(recording, wrong, sentence):
    """A stick beyond its end would be clipped by any reader of the table."""
    with pytest.raises(InputError, match=sentence.replace(".", r"\.")):
        wrong(recording)
