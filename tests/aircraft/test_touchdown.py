"""Touchdown against hand calculation, laws and an independent root finder."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from falconwing_kit.aircraft.airframe import Wheels, load_airframe
from falconwing_kit.aircraft.touchdown import (
    LandingPad,
    find_touchdown,
    is_out_of_reach,
    pad_height,
    wheel_heights,
    wheel_velocities,
)
from falconwing_kit.core.checks import InputError

# Wheel places of our own, so the hand calculations hold whatever the shipped file says.
WHEELS = Wheels(
    main_left=(0.05, -0.08, 0.11), main_right=(0.05, 0.08, 0.11), tail=(-0.30, 0.0, 0.04)
)
AIRFRAME = replace(load_airframe(), wheels=WHEELS)
PAD = LandingPad()  # x 1 to 14, y -3 to -1, top at 0.1 m
T = np.arange(0.0, 2.0, 0.05)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def flight(t=T, columns=9, **channels):
    """States (n, columns), zero but for the given channels, each a number or an array like t."""
    names = ("px", "py", "pz", "pitch", "yaw", "roll", "vx", "vy", "vz", "p", "q", "r")
    states = np.zeros((len(t), columns))
    for name, values in channels.items():
        states[:, names.index(name)] = values
    return states


def fall(t, height):
    """A level drop from rest: pz and vz at g = 9.8 m/s^2, the main wheels starting `height` up."""
    return {"pz": height + 0.11 - 4.9 * t**2, "vz": -9.8 * t}


def test_dropped_wheels_meet_the_floor_when_the_parabola_says():
    """By hand: 4.9 t^2 = 1 m gives t = 0.451754 s and sink 9.8 t = 4.427189 m/s; a cubic holds a
    parabola exactly.
    """
    touch = find_touchdown(T, flight(px=-10.0, **fall(T, 1.0)), AIRFRAME, PAD)
    assert (touch.wheel, touch.surface, touch.on_pad) == ("main_left", "floor", False)
    assert (touch.t, touch.sink_rate) == pytest.approx((0.4517540, 4.4271887), abs=1e-7)
    assert touch.p_world_wheel == pytest.approx([-9.95, 0.08, 0.0], abs=1e-9)


def test_over_the_pad_the_same_drop_ends_a_tenth_of_a_metre_higher():
    """By hand: 4.9 t^2 = 0.9 gives t = 0.428571 s and sink 4.2 m/s on top of the pad."""
    touch = find_touchdown(T, flight(px=3.0, py=-2.4, **fall(T, 1.0)), AIRFRAME, PAD)
    assert touch.on_pad
    assert (touch.t, touch.sink_rate) == pytest.approx((0.4285714, 4.2), abs=1e-7)


def test_place_is_relative_to_centre_line_and_threshold():
    """By hand: y = -2.4 is 0.4 m right of the centre line -2.0; x = 3.05 is 2.05 m past the
    threshold 1.0.
    """
    touch = find_touchdown(T, flight(px=3.0, py=-2.4, **fall(T, 1.0)), AIRFRAME, PAD)
    assert touch.lateral_offset == pytest.approx(-0.4, abs=1e-12)
    assert touch.absolute_lateral_deviation == pytest.approx(0.4, abs=1e-12)
    assert touch.past_threshold == pytest.approx(2.05, abs=1e-12)


def test_speed_is_that_of_the_aircraft_at_contact():
    """By hand: 7 m/s ahead and 4.2 m/s down make sqrt(49 + 17.64) = 8.163333 m/s."""
    touch = find_touchdown(
        T, flight(px=2.0 + 7.0 * T, py=-2.0, vx=7.0, **fall(T, 1.0)), AIRFRAME, PAD
    )
    assert touch.speed == pytest.approx(8.163333, abs=1e-6)
    assert touch.past_threshold == pytest.approx(1.0 + 7.0 * 0.4285714 + 0.05, abs=1e-6)


@pytest.mark.parametrize(("bank_deg", "wheel"), [(10.0, "main_right"), (-10.0, "main_left")])
def test_the_low_wheel_touches_first(bank_deg, wheel):
    """By hand: at 10 deg the low wheel is 0.08 sin + 0.11 cos = 0.122221 m below the CG, sinking
    0.5 m/s.
    """
    states = flight(px=-10.0, roll=np.radians(bank_deg), pz=0.6222207 - 0.5 * T, vz=-0.5)
    touch = find_touchdown(T, states, AIRFRAME, PAD)
    assert touch.wheel == wheel
    assert (touch.t, touch.sink_rate) == pytest.approx((1.0, 0.5), abs=1e-6)
    assert np.degrees(touch.bank) == pytest.approx(bank_deg, abs=1e-9)


@pytest.mark.parametrize("columns", [9, 12])
def test_a_roll_towards_the_low_wheel_adds_to_its_sink_rate(columns):
    """By hand: v + omega x r with p = 10 deg/s at 10 deg: 0.5 + p (0.08 cos - 0.11 sin) = 0.510417
    m/s, six digits.

    Rows of nine take p from differences of a roll that grows evenly, which is exact.
    """
    p = np.radians(10.0)
    rate = {"p": p} if columns == 12 else {}
    states = flight(columns=columns, px=-10.0, roll=p * T, pz=0.6222207 - 0.5 * T, vz=-0.5, **rate)
    touch = find_touchdown(T, states, AIRFRAME, PAD)
    assert touch.wheel == "main_right"
    assert (touch.t, touch.sink_rate) == pytest.approx((1.0, 0.510417), abs=1e-6)


def test_nose_high_the_tail_wheel_touches_first():
    """By hand at 15 deg: tail 0.30 sin + 0.04 cos = 0.116283 m below the CG, main 0.11 cos - 0.05
    sin = 0.093310 m.
    """
    states = flight(px=-10.0, pitch=np.radians(15.0), pz=0.616283 - 0.5 * T, vz=-0.5)
    touch = find_touchdown(T, states, AIRFRAME, PAD)
    assert touch.wheel == "tail"
    assert touch.t == pytest.approx(1.0, abs=2e-6)
    assert np.degrees(touch.pitch) == pytest.approx(15.0, abs=1e-9)


def test_wheel_velocity_of_a_pitching_aircraft():
    """By hand: q = 1 rad/s nose up lifts the main wheels 0.05 m ahead at 0.05 m/s and sinks the
    tail at 0.30 m/s.
    """
    state = flight(np.zeros(1), columns=12, q=1.0)[0]
    np.testing.assert_allclose(
        wheel_velocities(state, AIRFRAME)[:, 2], [0.05, 0.05, -0.30], atol=1e-15
    )


def test_a_wheel_below_the_pads_top_hits_its_edge():
    """By hand: wheels 0.05 m up at 5 m/s reach the edge after (1.0 + 1.0 - 0.05) / 5 = 0.39 s."""
    touch = find_touchdown(T, flight(px=-1.0 + 5.0 * T, py=-2.0, pz=0.16, vx=5.0), AIRFRAME, PAD)
    assert (touch.surface, touch.on_pad) == ("pad edge", False)
    assert (touch.t, touch.past_threshold, touch.sink_rate) == pytest.approx(
        (0.39, 0.0, 0.0), abs=1e-9
    )


@pytest.mark.parametrize(
    ("py", "wheel", "surface"),
    [
        (-1.05, "main_right", "pad"),
        (-0.90, "main_left", "floor"),
        (-2.95, "main_left", "pad"),
        (-3.10, "main_left", "floor"),
    ],
)
def test_beside_the_pad_only_the_wheel_over_it_counts(py, wheel, surface):
    """By hand: left wheel at y + 0.08, right wheel at y - 0.08, pad from -3 to -1, both equally
    low.
    """
    touch = find_touchdown(T, flight(px=5.0, py=py, **fall(T, 1.0)), AIRFRAME, PAD)
    assert (touch.wheel, touch.surface) == (wheel, surface)


def test_border_belongs_to_the_pad():
    """Definition: the edge belongs to the pad; a micrometre outside is the floor."""
    points = np.array(
        [[1.0, -1.0, 0.0], [14.0, -3.0, 0.0], [1.0 - 1e-6, -2.0, 0.0], [5.0, -1.0 + 1e-6, 0.0]]
    )
    np.testing.assert_array_equal(pad_height(points, PAD), [0.1, 0.1, 0.0, 0.0])
    np.testing.assert_array_equal(pad_height(points, None), np.zeros(4))


def test_flying_on_is_no_touchdown():
    """Level flight at 1.5 m, and a dip to 1 cm above the floor."""
    assert find_touchdown(T, flight(px=-10.0 + 7.0 * T, pz=1.5, vx=7.0), AIRFRAME, PAD) is None
    dip = flight(px=-10.0, pz=0.12 + (T - 1.0) ** 2, vz=2.0 * (T - 1.0))
    assert find_touchdown(T, dip, AIRFRAME, PAD) is None


def test_touch_and_go_between_two_samples_is_found():
    """By hand: 20 (t - 0.025)^2 - 0.005 above the pad is positive at 0 and 0.05 s, first zero at
    0.025 - 0.015811 s.
    """
    t = np.array([0.0, 0.05])
    states = flight(
        t, px=5.0, py=-2.0, pz=0.21 + 20.0 * (t - 0.025) ** 2 - 0.005, vz=40.0 * (t - 0.025)
    )
    assert find_touchdown(t, states, AIRFRAME, PAD).t == pytest.approx(0.0091886, abs=1e-7)


def test_standing_on_the_ground_is_no_touchdown_but_the_landing_after_take_off_is():
    """By hand: wheels 0.5 - |t - 1| high leave the floor at 0.5 s and are back on it at 1.5 s."""
    standing = flight(px=-10.0, pz=0.11)
    assert find_touchdown(T, standing, AIRFRAME, PAD) is None
    hop = flight(px=-10.0, pz=0.11 + 0.5 - np.abs(T - 1.0), vz=-np.sign(T - 1.0))
    assert find_touchdown(T, hop, AIRFRAME, PAD).t == pytest.approx(1.5, abs=1e-9)


def test_answer_does_not_depend_on_how_the_path_is_sampled(rng):
    """A parabola is one curve at any sampling; rounding only."""
    t = np.sort(rng.uniform(0.0, 1.0, 30))
    touch = find_touchdown(t, flight(t, px=-10.0, **fall(t, 1.0)), AIRFRAME, PAD)
    assert (touch.t, touch.sink_rate) == pytest.approx(
        (1.0 / np.sqrt(4.9), np.sqrt(19.6)), rel=1e-9
    )


def test_yaw_across_half_a_turn_makes_no_spin():
    """Symmetry: a slow turn through yaw = pi equals one through zero, half a turn later."""
    turn, touches = 0.5 * (T - 1.0), []
    for start in (0.0, np.pi):
        yaw = (start + turn + np.pi) % (2.0 * np.pi) - np.pi
        states = flight(px=-10.0, yaw=yaw, roll=0.2, pz=0.6 - 0.5 * T, vz=-0.5)
        touches.append(find_touchdown(T, states, AIRFRAME, PAD))
    zero, half = touches
    assert 0.95 < zero.t < 1.0  # the step in which the yaw jumps from pi to -pi
    assert (half.t, half.sink_rate) == pytest.approx((zero.t, zero.sink_rate), rel=1e-9)
    assert half.yaw == pytest.approx(zero.yaw + np.pi, abs=1e-9)


def test_oscillating_approach_agrees_with_an_independent_root_finder():
    """SciPy's rotations and brentq on the exact path, sampled at 20 Hz for the kit.

    The cubic is within 5 micrometres (dt^4 / 384 of the fourth derivative at 0.1 rad, 10 rad/s), so
    at 0.6 m/s within 10 microseconds; the bound is three times that, and 1 mm/s in the sink rate.
    """
    points = np.array([WHEELS.main_left, WHEELS.main_right, WHEELS.tail])

    def pose(t):
        angles = [
            0.3 + 0.2 * t,
            0.08 + 0.1 * np.sin(10.0 * t),
            0.1 * np.cos(7.0 * t),
        ]  # yaw, pitch, roll
        turn = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("ZYX", angles).as_matrix()
        return np.array([-10.0 + 7.0 * t, 0.5 * t, 0.9 - 0.6 * t]), angles, turn

    def wheel_z(t):
        p, _, turn = pose(t)
        return (p + points @ turn.T)[:, 2]

    states = []
    for t in T:
        p, (yaw, pitch, roll), turn = pose(t)
        spin = (
            turn.T @ (pose(t + 1e-6)[2] - pose(t - 1e-6)[2]) / 2e-6
        )  # skew matrix of the body rates
        states.append([*p, pitch, yaw, roll, 7.0, 0.5, -0.6, spin[2, 1], spin[0, 2], spin[1, 0]])
    dense = np.arange(0.0, 2.0, 1e-4)
    first = next(t for t in dense if wheel_z(t).min() <= 0.0)
    exact = brentq(lambda t: wheel_z(t).min(), first - 1e-4, first, xtol=1e-12)
    wheel = int(np.argmin(wheel_z(exact)))
    sink = (wheel_z(exact - 1e-6) - wheel_z(exact + 1e-6))[wheel] / 2e-6

    touch = find_touchdown(T, states, AIRFRAME, PAD)
    assert touch.wheel == ("main_left", "main_right", "tail")[wheel]
    assert touch.t == pytest.approx(exact, abs=3e-5)
    assert touch.sink_rate == pytest.approx(sink, abs=1e-3)


def test_out_of_reach_is_a_step_above_the_longest_arm():
    """By hand: the tail wheel is 0.302655 m from the centre of gravity and the pad's top at 0.1 m;
    a step of 50 ms at 2 m/s takes 0.1 m, and a turn at 4 rad/s 0.060531 m at the tail wheel.
    """
    for channels, height in (({}, 0.402655), ({"vz": -2.0}, 0.502655), ({"r": 4.0}, 0.463186)):
        for above, expected in ((1e-6, True), (-1e-6, False)):
            step = flight(T[:2], 12, pz=[height + above, 9.0], **channels)
            assert is_out_of_reach(0.05, step, AIRFRAME, PAD) == expected
            assert is_out_of_reach(0.05, step[::-1], AIRFRAME, PAD) == expected


def test_nothing_out_of_reach_touches_the_ground(rng):
    """Steps of any speeds and turns over the pad, among them many that touch it: `find_touchdown`
    finds none in those that are out of reach, and refuses what is not finite.
    """
    outcomes = set()
    for _ in range(400):
        low, high = np.array([3.0, -2.2, 0.1, *[-0.5] * 3]), np.array([4.0, -1.8, 1.5, *[0.5] * 3])
        rates = rng.normal(0.0, 1.0, (2, 6)) * (8.0, 8.0, 5.0, 6.0, 6.0, 6.0)
        step = np.concatenate([rng.uniform(low, high, (2, 6)), rates], axis=1)
        touches = find_touchdown(T[:2], step, AIRFRAME, PAD) is not None
        outcomes.add((is_out_of_reach(0.05, step, AIRFRAME, PAD), touches))
    assert outcomes == {(True, False), (False, False), (False, True)}
    high = flight(T[:2], 12, pz=9.0)
    assert is_out_of_reach(0.05, high, AIRFRAME, PAD)
    assert not any(is_out_of_reach(dt, high, AIRFRAME, PAD) for dt in (0.0, -0.05, np.nan))
    for column, bad in ((0, np.nan), (2, np.inf), (7, np.nan), (11, np.inf)):
        step = flight(T[:2], 12, pz=9.0)
        step[1, column] = bad
        assert not is_out_of_reach(0.05, step, AIRFRAME, PAD)


def test_heights_of_a_batch():
    """By hand: at 1 m, level, the wheels are 0.89, 0.89, 0.96 m up, 0.1 m less over the pad."""
    states = np.zeros((2, 4, 9))
    states[..., 2] = 1.0
    states[1, :, 0:2] = [5.0, -2.0]
    heights = wheel_heights(states, AIRFRAME, PAD)
    np.testing.assert_allclose(heights[0], np.tile([0.89, 0.89, 0.96], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(heights[1], np.tile([0.79, 0.79, 0.86], (4, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("t", "states", "words"),
    [
        (T, np.zeros((len(T), 10)), "9 or 12"),
        (T[:-1], flight(pz=1.0), "t: expected shape"),
        (T, flight(pz=np.nan), "finite"),
        (T[::-1], flight(pz=1.0), "increasing"),
        (T[:1], flight(T[:1], pz=1.0), "two or more"),
        (T, 3.0, "9 or 12"),
    ],
)
def test_bad_flights_are_refused(t, states, words):
    """The message names the fault of the table."""
    with pytest.raises(InputError, match=words):
        find_touchdown(t, states, AIRFRAME, PAD)


def test_a_pad_of_negative_size_is_refused():
    """A negative width has no meaning."""
    with pytest.raises(InputError, match="pad width"):
        LandingPad(width=-1.0)
