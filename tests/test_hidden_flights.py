"""Hidden flights: every effect acts as its formula says, and nothing else does. Simulated, not
measured.
"""

import json
from functools import cache

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.core.frames import wrap_angle
from falconwing_kit.sysid.forecast import forecast
from tests.hidden_effects import EFFECTS, IN_CATALOGUE, OUTSIDE
from tests.hidden_flights import NOISE, make_case, write_cases
from tests.jsbsim_aircraft import FOOT, ROW, JsbsimAircraft, fly_jsbsim, playback

SIZES = {  # of each effect one that is plain to see; north is +x, east is -y
    "wind": {"wind": [0.3, 0.5]},
    "fan_jet": {"jet": [1.5, -1.0], "at": [4.0, 3.0], "radius": 2.5},
    "ground_effect": {"ge": 0.6, "less_drag": 1.0},
    "extra_drag": {"dcd": 0.04},
    "flap": {"dcl": 0.15, "dcd": 0.012},
    "thrust_loss": {"loss": 0.3},
    "battery_sag": {"sag": 0.4},
    "propeller_torque": {"arm_roll": 0.008, "arm_yaw": -0.01},
    "adverse_yaw": {"ady": 0.008},
    "control_delay": {"delay": 0.05},
    "actuator_lag": {"lag": 0.06, "in_series": False},
    "trim_bias": {"bias": [0.06, -0.05, 0.08]},
    "deadband": {"band": 0.1},
    "aileron_loss": {"loss": 0.35},
    "mass_change": {"mass": 0.2},
    "cg_shift": {"back": 0.004},
    "stall": {"loss": 0.6, "alpha": 0.13},
    "camera_tilt": {"tilt": [0.05, -0.03]},
    "time_offset": {"offset": 0.06},
    "gust_field": {"gust": 0.8, "wavelength": 6.0, "phase": 1.0},
    "thrust_line": {"arm": 0.01},
    "elevator_play": {"play": 0.15},
}
OF_THE_CAMERA = ("camera_tilt", "time_offset")  # the aircraft flies as ever
# Where our form of an effect is not the kit's, the share of the error that may stay: a flap's lift
# has induced drag, a stall has a corner, a deadband's edge is sharp, about a shifted centre of
# gravity side force and elevator turn too.
SHARE_LEFT = {"flap": 0.3, "stall": 0.5, "deadband": 0.5, "cg_shift": 0.2}


@cache
def flown(effect, seconds=30.0, **how):
    """A case with the plain size and hardly any calm flight."""
    return make_case(
        3, effect, size=SIZES.get(effect), calm_seconds=0.1, flight_seconds=seconds, **how
    )


def attitude_error(model, case):
    """Of half-second forecasts from the true states [deg]."""
    x = case.true_states[1]
    rates = dict(zip(("vx", "vy", "vz", "p", "q", "r"), x[:, 6:].T, strict=True))
    t = np.arange(len(x)) * ROW
    truth = FlightTable(
        "true", t, x[:, :3], wrap_angle(x[:, [5, 3, 4]]), case.flight.commands, rates
    )
    return forecast(model, truth, 0.5).attitude_deg


@pytest.mark.parametrize("effect", [name for name in IN_CATALOGUE if name not in OF_THE_CAMERA])
def test_the_kits_formula_at_the_true_size_explains_the_flight(effect):
    """Two implementations without a line in common agree, and only with the right sign: the error
    of the base model is well above what a flight without effect leaves (0.1 deg), falls at the true
    size and grows at its negative.
    """
    case = flown(effect)
    base = case.aircraft.kit_model()
    forms = (e for e in CATALOGUE if e.name == effect)
    model = base.with_effect(
        next(e for e in forms if set(case.truth["kit"]) <= {p.name for p in e.parameters})
    )
    without, with_it = (
        attitude_error(base, case),
        attitude_error(model.with_values(case.truth["kit"]), case),
    )
    assert without > 0.5
    assert with_it < SHARE_LEFT.get(effect, 0.12) * without + 0.1
    if effect not in (
        "control_delay",
        "actuator_lag",
        "deadband",
        "stall",
        "fan_jet",
    ):  # have no negative, or no mirror
        mirrored = model.with_values({name: -value for name, value in case.truth["kit"].items()})
        assert attitude_error(mirrored, case) > 1.3 * without


@pytest.mark.parametrize("effect", OUTSIDE)
def test_what_no_catalogue_holds_is_there_all_the_same(effect):
    """The base model that leaves 0.1 deg without an effect leaves at least five times as much."""
    case = flown(effect)
    assert attitude_error(case.aircraft.kit_model(), case) > 0.5
    assert case.truth["outside"] and case.truth["kit"] == {}


def test_without_effect_the_base_model_is_right():
    """The same aircraft in two simulators: 0.1 deg half a second ahead is the two tiny differences
    in their physics.
    """
    case = flown("none")
    assert attitude_error(case.aircraft.kit_model(), case) < 0.2


def test_wind_is_the_ground_speed_less_the_air_speed():
    """JSBSim's own airspeed against |v - w| of velocities over the ground, w along +x by north and
    -y by east.
    """
    acting = EFFECTS["wind"].act(JsbsimAircraft(), SIZES["wind"])
    speeds = []

    def before_step(t, fdm):
        acting.before_step(t, fdm)
        speeds.append(fdm["velocities/vt-fps"] * FOOT)

    sticks = np.tile([0.4, 0.0, 0.15, 0.0], (21, 1))
    _, states, _ = fly_jsbsim(acting.aircraft, playback(sticks), 1.0, before_step=before_step)
    through_air = np.linalg.norm(states[1:-1, 6:9] - [0.3, -0.5, 0.0], axis=1)
    assert np.array(speeds)[10::10] == pytest.approx(
        through_air, abs=0.02
    )  # 1 ms off: the wind alone is 0.3 m/s


def test_a_later_minute_of_a_sagging_battery_has_less_thrust():
    """By hand: 40 % a minute leaves 0.8 of the thrust 30 s after the table begins, and all of it
    before.
    """
    properties = {}
    acting = EFFECTS["battery_sag"].act(JsbsimAircraft(), SIZES["battery_sag"])
    shares = []
    for t in (0.0, 10.0, 40.0):
        acting.before_step(t, properties)
        shares.append(properties["falcon/thrust"] / JsbsimAircraft().thrust)
    assert shares == pytest.approx([1.0, 1.0, 0.8])


def test_the_same_seed_gives_the_same_flight():
    """A law of seeds, to the last bit; another seed is another flight."""
    one, two, other = (
        make_case(s, "none", calm_seconds=5.0, flight_seconds=5.0) for s in (5, 5, 6)
    )
    assert np.array_equal(one.flight.p_world, two.flight.p_world, equal_nan=True)
    assert np.array_equal(one.calm.attitude, two.calm.attitude, equal_nan=True)
    assert one.truth == two.truth
    assert np.abs(one.true_states[1][:, :3] - other.true_states[1][:, :3]).max() > 1.0


# What the camera does: the same seed flies the same flight, so that two cases differ by that alone
# -------------------


def test_a_tilted_camera_turns_attitudes_and_leaves_places():
    """By hand: wings level, 0.05 rad up is 0.05 more pitch, -0.03 about the nose is as much less
    roll.
    """
    straight, tilted = flown("none"), flown("camera_tilt")
    assert np.array_equal(straight.flight.p_world, tilted.flight.p_world, equal_nan=True)
    change = wrap_angle(tilted.flight.attitude - straight.flight.attitude)
    level = np.abs(straight.true_states[1][:, 5]) < 0.05
    # Of 0.05 rad, a roll of 0.05 takes 0.0001 and turns 0.0025 to yaw; pitch of 0.2 adds a
    # hundredth of it to roll.
    assert np.nanmedian(change[level], axis=0) == pytest.approx([-0.03, 0.05, 0.0], abs=0.003)


def test_late_stamps_show_where_the_aircraft_was():
    """By hand: 60 ms late, a place is off by -v 60 ms, to second order a (60 ms)^2 / 2 = 0.02 m at
    10 m/s^2.
    """
    prompt, late = flown("none"), flown("time_offset")
    want = -0.06 * prompt.true_states[1][:, 6:9]
    error = late.flight.p_world - prompt.flight.p_world - want
    assert np.nanmax(np.abs(error)) < 0.06  # banked hard, 20 m/s^2 and more
    assert np.nanmedian(np.abs(error)) < 0.02


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("correlated", [False, True])
def test_noise_is_of_the_size_and_length_it_claims(noise, correlated):
    """Of 2400 poses the deviation is known to 1.5 % (white) or 4 %; half of AR(1) over 0.5 s leaves
    0.5/e after 0.5 s, known to 0.05; half a percent of outliers, one percent missing, to three
    deviations of a count.
    """
    case = make_case(11, "none", noise, correlated, calm_seconds=120.0, flight_seconds=0.1)
    x = case.true_states[0]
    error = np.hstack(
        [case.calm.p_world - x[:, :3], wrap_angle(case.calm.attitude - x[:, [5, 3, 4]])]
    )
    error /= np.repeat(NOISE[noise], 3)
    missing, wild = np.isnan(error[:, 0]), np.abs(error[:, :3]).max(axis=1) > 6.0
    good = np.where((missing | wild)[:, None], np.nan, error)
    assert np.nanstd(good, axis=0) == pytest.approx(np.ones(6), abs=0.12)
    after = np.nanmean(good[10:] * good[:-10]) / np.nanmean(good**2)
    assert after == pytest.approx(0.5 / np.e if correlated else 0.0, abs=0.05)
    assert 9 <= missing.sum() <= 39
    assert 1 <= wild.sum() <= 23


def test_bias_is_smooth_in_place_and_jitter_in_the_stamps_alone():
    """By hand: the bias is at most its amplitude and a sine's mean square is half; stamps are off
    by 5 ms at most.
    """
    plain, biased, jittered = (
        flown("none"),
        flown("none", pose_bias=0.04),
        flown("none", jitter=0.005),
    )
    bias = biased.flight.p_world - plain.flight.p_world
    assert np.nanmax(np.abs(bias)) <= 0.04 + 1e-9
    assert np.nanstd(bias) == pytest.approx(
        0.04 / np.sqrt(2.0), rel=0.35
    )  # of a few waves a flight
    step = np.abs(np.diff(bias, axis=0))
    assert (
        np.nanmax(step) < 0.04 * 2.0 * np.pi / 5.0 * 0.6
    )  # 12 m/s for 50 ms over the shortest wave
    off = jittered.flight.t - plain.flight.t
    assert 0.003 < np.abs(off).max() <= 0.00501
    assert np.array_equal(jittered.true_states[1], plain.true_states[1])


# How it is flown
# --------------------------------------------------------------------------------------------------


def test_passes_are_low_and_turns_go_both_ways_unless_asked():
    """What ground effect, wind and a student need: heights below 1 m at times, and both turns."""
    both, left, calm_hand = (
        flown("none", 60.0),
        flown("none", 60.0, one_way=True),
        flown("none", 60.0, excitation=0.0),
    )
    height, roll = both.true_states[1][:, 2], both.true_states[1][:, 5]
    assert 0.05 < height.min() < 1.0 and height.max() > 2.0
    assert 0.2 < (roll > 0.0).mean() < 0.8
    assert (left.true_states[1][:, 5] < 0.0).mean() > 0.9
    moved = [np.abs(np.diff(case.flight.commands, axis=0)).mean() for case in (both, calm_hand)]
    assert moved[0] > 1.3 * moved[1]


@pytest.mark.parametrize("effect", [*IN_CATALOGUE, *OUTSIDE])
def test_every_effect_at_its_plainest_can_be_flown(effect):
    """A size that no attempt keeps in the hall would be drawn away; the plain one is tried in full
    here.
    """
    drawn = EFFECTS[effect]
    size = drawn.draw(np.random.default_rng(1), drawn.plain, JsbsimAircraft())
    case = make_case(17, effect, size=size, calm_seconds=0.1, flight_seconds=10.0)
    assert case.truth["size"] == size


def test_two_effects_act_together():
    """The truth names both, and the base model misses more than with either alone."""
    sizes = {**SIZES["wind"], **SIZES["aileron_loss"]}
    both = make_case(3, "wind+aileron_loss", size=sizes, calm_seconds=0.1, flight_seconds=30.0)
    assert both.truth["size"] == sizes
    each = [
        attitude_error(c.aircraft.kit_model(), c)
        for c in (both, flown("wind"), flown("aileron_loss"))
    ]
    assert each[0] > max(each[1:])


def test_files_have_the_layout_of_the_labelled_cases(tmp_path):
    """Written, read again by the kit's reader: the same numbers, and the truth beside them."""
    case = make_case(1, "wind", size=SIZES["wind"], calm_seconds=5.0, flight_seconds=5.0)
    write_cases(tmp_path, {"case00": case})
    read = read_flight_table(tmp_path / "case00" / "flight.csv")
    assert np.array_equal(read.p_world, case.flight.p_world, equal_nan=True)
    truth = json.loads((tmp_path / "truth.json").read_text())["case00"]
    assert truth["effect"] == "wind" and truth["size"] == {"wind": [0.3, 0.5]}
    assert truth["kit"] == {"wind_x": 0.3, "wind_y": -0.5}
