"""Hidden flights: reproducible, every effect flown inside the hall, noise as specified."""

import json
from functools import cache

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import EFFECT_NAMES
from falconwing_kit.aircraft.integrate import roll_out
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.core.frames import wrap_angle
from falconwing_kit.tools.trials.hidden import (
    HALL,
    NOISE,
    ROW_S,
    HiddenCase,
    hidden_case,
    hidden_flights,
    hidden_seed,
    write_hidden,
)

OTHERWISE = ("battery_sag", "camera_tilt", "time_offset")  # have tests of their own
SALT = "a long secret of this term"
SIZES = {
    "wind": {"wind_x": 0.4, "wind_y": -0.6},
    "thrust_loss": {"thrust_lost": 0.3},
    "control_delay": {"control_delay": 0.06},
    "actuator_lag": {"lag_in_series": 0.06},
    "trim_bias": {"bias_aileron": 0.1, "bias_elevator": -0.08, "bias_rudder": 0.12},
    "deadband": {"deadband": 0.08},
    "battery_sag": {"sag": 0.4},
    "camera_tilt": {"tilt_pitch": 0.05, "tilt_roll": -0.03},
    "time_offset": {"control_delay": 0.06},
    "wind+adverse_yaw": {"wind_x": 0.4, "wind_y": -0.6, "adverse_yaw": 0.12},
}


@cache
def flown(effect: str, seconds: float = 15.0, sized: bool = False, **how) -> HiddenCase:
    """A flight of the same aircraft, day and pilot for every effect; 1 s of baseline flight."""
    size = SIZES[effect] if sized else None
    return hidden_case(5, effect, size=size, calm_seconds=1.0, flight_seconds=seconds, **how)


def rows(case: HiddenCase) -> np.ndarray:
    """True states (N, 12) of the flight."""
    return case.true_states[1]


# Seeds
# -----


def test_seed_is_the_keyed_hash_of_the_name():
    """Another implementation: `printf ada | openssl dgst -sha256 -hmac "a long secret of this
    term"`, its first 48 bits.
    """
    assert hidden_seed("ada", SALT) == 0x5013128709A5


def test_another_salt_or_student_gives_another_case():
    """A law of keyed hashes; spaces around a name and how an accent is typed do not count."""
    seeds = {
        hidden_seed(student, salt)
        for student in ("ada", "zoe", "zoë")
        for salt in (SALT, SALT + ".")
    }
    assert len(seeds) == 6
    assert hidden_seed(" zoe\u0308 ", SALT) == hidden_seed("zo\u00eb", SALT)
    one, two = (
        hidden_case(hidden_seed("ada", s), "none", calm_seconds=1.0, flight_seconds=2.0)
        for s in (SALT, SALT * 2)
    )
    assert not np.array_equal(one.flight.commands, two.flight.commands)


def test_the_same_arguments_give_the_same_case_to_the_last_bit():
    """A law of seeds; the first of several flights is the case itself."""
    how = {
        "calm_seconds": 3.0,
        "flight_seconds": 4.0,
        "correlated": True,
        "jitter": 0.004,
        "pose_bias": 0.02,
    }
    one, two = hidden_case(7, **how), hidden_flights(7, [None, "wind"], **how)[0]
    for a, b in ((one.calm, two.calm), (one.flight, two.flight)):
        for column in ("t", "p_world", "attitude", "commands"):
            assert np.array_equal(getattr(a, column), getattr(b, column), equal_nan=True)
    assert one.truth == two.truth
    assert one.truth["simulated"] is True


# Effects
# -------


@pytest.mark.parametrize("effect", ["none", *EFFECT_NAMES])
def test_every_effect_is_drawn_and_flown_inside_the_hall(effect):
    """The hall's own numbers, at every row; a drawn size is never zero."""
    case = flown(effect)
    x = rows(case)
    assert (
        (np.abs(x[:, :2]) < HALL[:2]).all() and (x[:, 2] > 0.05).all() and (x[:, 2] < HALL[2]).all()
    )
    assert case.truth["effect"] == effect
    assert all(abs(value) > 1e-4 for value in case.truth["size"].values())
    assert bool(case.truth["size"]) == (effect != "none")


def test_none_and_all_effects_are_drawn_where_no_effect_is_given():
    """20 equally likely outcomes in 12 draws: fewer than 6 different ones come by chance in one of
    10 000 cases.
    """
    cases = hidden_flights(3, [None] * 12, calm_seconds=1.0, flight_seconds=1.0)
    drawn = {case.truth["effect"] for case in cases}
    assert len(drawn) >= 6
    assert drawn <= {"none", *EFFECT_NAMES}


@pytest.mark.parametrize("effect", [name for name in SIZES if name not in OTHERWISE])
def test_the_hidden_size_explains_the_flight(effect):
    """Half-second forecasts from true states by the identification's integration and input map,
    which share no line with the hidden flights' own: with the hidden effect they agree to what
    steps of 25 ms cost a fourth-order method (1e-4 deg), without it they are off by 0.3 deg and
    more.
    """
    case = flown(effect, sized=True)
    without = case.model.with_values(dict.fromkeys(SIZES[effect], 0.0))
    error, error_without = attitude_error(case.model, case), attitude_error(without, case)
    assert case.truth["size"] == SIZES[effect]
    assert error < 1e-3
    assert error_without > 0.2


def attitude_error(model, case) -> float:
    """Of half-second forecasts from the true states, after a second in which delay and servo have
    settled [deg].
    """
    x, sticks = rows(case), case.flight.commands
    t = ROW_S * np.arange(len(x))
    edges = 0.5 * ROW_S * np.arange(2 * len(x) - 1)
    mean, slope = model.actuator_positions(t, sticks, edges, model.K)
    begins = np.arange(20, len(x) - 10, 5)
    steps = 2 * begins[:, None] + np.arange(20)
    flown_again = roll_out(model, x[begins], mean[steps], 0.5 * ROW_S, slope=slope[steps])[:, -1]
    return float(np.degrees(np.sqrt(np.mean((flown_again - x[begins + 10])[:, 3:6] ** 2))))


def test_a_sagging_battery_loses_speed_as_time_goes():
    """By hand: thrust (1 - 0.4 t / 60 s) is unchanged when the table begins, so the first second of
    both flights is the same to 5 cm; after a minute more throttle flies the same speed.
    """
    fresh, sagging = flown("none", 60.0), flown("battery_sag", 60.0, sized=True)
    assert np.abs(rows(sagging)[:20, :3] - rows(fresh)[:20, :3]).max() < 0.05
    throttle = [case.flight.commands[-400:, 0].mean() for case in (fresh, sagging)]
    assert throttle[1] > 1.2 * throttle[0]


def test_a_tilted_camera_turns_attitudes_and_leaves_places():
    """By hand: wings level, 0.05 rad up is 0.05 more pitch, -0.03 about the nose is as much less
    roll.
    """
    straight, tilted = flown("none"), flown("camera_tilt", sized=True)
    assert np.array_equal(straight.flight.p_world, tilted.flight.p_world, equal_nan=True)
    change = wrap_angle(tilted.flight.attitude - straight.flight.attitude)
    level = np.abs(rows(straight)[:, 5]) < 0.15
    # A roll of 0.15 turns 0.0075 of 0.05 to yaw, and as much to either side; pitch of 0.2 adds a
    # hundredth to roll.
    assert np.nanmedian(change[level], axis=0) == pytest.approx([-0.03, 0.05, 0.0], abs=0.006)


def test_late_stamps_show_where_the_aircraft_was():
    """By hand: 60 ms late, a place is off by -v 60 ms, to second order a (60 ms)^2 / 2 = 0.02 m at
    10 m/s^2.
    """
    prompt, late = flown("none"), flown("time_offset", sized=True)
    assert np.array_equal(rows(prompt), rows(late))
    error = late.flight.p_world - prompt.flight.p_world + 0.06 * rows(prompt)[:, 6:9]
    assert np.nanmax(np.abs(error)) < 0.06
    assert np.nanmedian(np.abs(error)) < 0.02


# Measuring and flying
# --------------------


@pytest.mark.parametrize(
    ("noise", "correlated"), [("marker", False), ("hybrid", True), ("net", False)]
)
def test_noise_has_the_specified_size_and_correlation(noise, correlated):
    """Of 1200 poses the deviation is known to 2 % (white) or 6 %; half of AR(1) over 0.5 s leaves
    0.5/e after 0.5 s, known to 0.06; half a percent of outliers, one percent missing, to three
    deviations of a count.
    """
    case = flown("none", 60.0, noise=noise, correlated=correlated)
    x = rows(case)
    error = np.hstack(
        [case.flight.p_world - x[:, :3], wrap_angle(case.flight.attitude - x[:, [5, 3, 4]])]
    )
    error /= np.repeat(NOISE[noise], 3)
    missing, wild = np.isnan(error[:, 0]), np.abs(error).max(axis=1) > 5.0
    good = np.where((missing | wild)[:, None], np.nan, error)
    assert np.nanstd(good, axis=0) == pytest.approx(np.ones(6), abs=0.18 if correlated else 0.08)
    after = np.nanmean(good[10:] * good[:-10]) / np.nanmean(good**2)
    assert after == pytest.approx(0.5 / np.e if correlated else 0.0, abs=0.06)
    assert 2 <= missing.sum() <= 23
    assert 1 <= wild.sum() <= 14


def test_bias_is_smooth_in_position_and_jitter_affects_stamps_only():
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
    assert np.nanstd(bias) == pytest.approx(0.04 / np.sqrt(2.0), rel=0.4)  # of a few waves a flight
    off = jittered.flight.t - plain.flight.t
    assert 0.003 < np.abs(off).max() <= 0.00501
    assert np.array_equal(rows(jittered), rows(plain))


def test_passes_are_low_and_turns_go_both_ways_unless_asked():
    """What ground effect, wind and a student need: a height below 1 m now and then, slow and fast,
    both turns.
    """
    both, left, calm_hand = (
        flown("none", 60.0),
        flown("none", 30.0, one_way=True),
        flown("none", 30.0, excitation=0.0),
    )
    height, roll, speed = (
        rows(both)[:, 2],
        rows(both)[:, 5],
        np.linalg.norm(rows(both)[:, 6:9], axis=1),
    )
    assert height.min() < 1.0 and height.max() > 2.0
    assert speed.min() < 6.4 and speed.max() > 7.2
    assert 0.2 < (roll > 0.0).mean() < 0.8
    assert rows(left)[-1, 4] - rows(left)[0, 4] < -6.0 * np.pi  # a circle takes some five seconds
    moved = [np.abs(np.diff(case.flight.commands, axis=0)).mean() for case in (both, calm_hand)]
    assert moved[0] > 1.3 * moved[1]


# Files and refusals
# ------------------


def test_flights_are_handed_out_without_the_answer(tmp_path):
    """No effect, parameter or seed in any file of the folder; the answers lie only in the
    requested file.
    """
    case = flown("wind", sized=True)
    write_hidden(tmp_path / "out", {"ada": case})
    files = sorted(path for path in (tmp_path / "out").rglob("*") if path.is_file())
    assert [path.name for path in files] == ["calm.csv", "flight.csv"]
    assert all(
        word not in path.read_text() for path in files for word in ("wind", "seed", "effect")
    )
    assert "simulated" in files[1].read_text()
    read = read_flight_table(files[1])
    assert np.array_equal(read.p_world, case.flight.p_world, equal_nan=True)
    write_hidden(tmp_path / "out", {"ada": case}, tmp_path / "answers.json")
    answers = json.loads((tmp_path / "answers.json").read_text())
    assert answers["ada"]["effect"] == "wind" and answers["ada"]["size"] == SIZES["wind"]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: hidden_seed("  ", SALT), "expected a name"),
        (lambda: hidden_seed("ada", "short"), "16 characters"),
        (lambda: hidden_case(-1), "seed"),
        (lambda: hidden_case(1, "gremlins"), "gremlins"),
        (lambda: hidden_case(1, "time_offset+control_delay"), "differ"),
        (lambda: hidden_case(1, "wind", size={"wind_x": 1.0}), "wind_x, wind_y"),
        (lambda: hidden_case(1, size={"wind_x": 1.0, "wind_y": 0.0}), "of no effect"),
        (lambda: hidden_case(1, noise="fog"), "marker, hybrid, net"),
        (lambda: hidden_case(1, flight_seconds=0.0), "flight_seconds"),
        (lambda: hidden_flights(1, []), "at least one"),
        (
            lambda: hidden_case(1, "thrust_loss", size={"thrust_lost": 1.0}, calm_seconds=1.0),
            "smaller size",
        ),
        (lambda: write_hidden(".", {"../ada": None}), "plain folder name"),
    ],
)
def test_what_cannot_be_flown_is_refused_in_one_sentence(call, words):
    """An aircraft without thrust comes down; the rest is wrong use."""
    with pytest.raises(InputError, match=words):
        call()
