"""Sizing reproduces the paper's appendix and the textbook's level turn."""

import math
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft import sizing
from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.core.checks import InputError

UMX = load_airframe()
MASS = np.array([0.150, 0.300, 0.324])


def test_minimum_speed_is_the_papers():
    """Paper, appendix, recomputed by hand: 7.04, 9.96 and 10.35 m/s for 150, 300 and 324 g; half
    the last digit.
    """
    np.testing.assert_allclose(sizing.minimum_speed(MASS, UMX), [7.04, 9.96, 10.35], atol=0.005)


def test_paper_turn_radius_is_the_papers():
    """Paper, appendix, recomputed by hand: 8.77 m (150 g), 17.53 m (300 g) and 18.93 m (324 g);
    half the last digit.
    """
    np.testing.assert_allclose(
        sizing.paper_turn_radius(MASS, UMX), [8.77, 17.53, 18.93], atol=0.005
    )


def test_lift_at_minimum_speed_carries_the_weight():
    """Law: 1/2 rho V^2 S C = m g with the appendix's 1.3, 0.076, 0.6 and 9.8 written out; rounding
    only.
    """
    speed = sizing.minimum_speed(MASS, UMX)
    np.testing.assert_allclose(0.5 * 1.3 * speed**2 * 0.076 * 0.6, MASS * 9.8, rtol=1e-12)


def test_speed_grows_with_the_root_of_mass_and_radius_with_mass():
    """Law: V ~ sqrt(m) and R ~ m, so four times the mass is twice the speed and four times the
    radius.
    """
    four = np.array([0.1, 0.4])
    speed, paper, level = (
        law(four, UMX)
        for law in (sizing.minimum_speed, sizing.paper_turn_radius, sizing.level_turn_radius)
    )
    np.testing.assert_allclose(
        [speed[1] / speed[0], paper[1] / paper[0], level[1] / level[0]], [2.0, 4.0, 4.0], rtol=1e-12
    )


def test_turn_radius_at_45_degrees():
    """By hand: tan(45 deg) = 1, so 9.8 m/s turns in 9.8^2 / 9.8 = 9.8 m."""
    assert sizing.turn_radius(9.8, math.pi / 4) == pytest.approx(9.8, rel=1e-12)


def test_load_factor_at_60_degrees_is_two():
    """Textbook: 1 / cos(60 deg) = 2."""
    assert sizing.load_factor(math.pi / 3) == pytest.approx(2.0, rel=1e-12)


def test_level_turn_balances_weight_and_centripetal_force():
    """Newton: at the level turn's own speed and full lift, L cos(phi) = m g and L sin(phi) = m V^2
    / R.
    """
    bank = np.radians([10.0, 30.0, 60.0])
    speed = sizing.level_turn_speed(0.15, UMX, bank)
    lift = 0.5 * 1.3 * speed**2 * 0.076 * 0.6
    np.testing.assert_allclose(lift * np.cos(bank), 0.15 * 9.8, rtol=1e-12)
    np.testing.assert_allclose(
        lift * np.sin(bank), 0.15 * speed**2 / sizing.level_turn_radius(0.15, UMX, bank)
    )


def test_holding_height_widens_the_papers_turn_by_the_load_factor():
    """By hand at 30 deg and 150 g: 8.765 m * 1.1547 = 10.12 m, so the full circle no longer fits 20
    m.
    """
    assert sizing.level_turn_radius(0.150, UMX) == pytest.approx(10.12, abs=0.005)


def test_bank_for_a_radius_is_the_inverse_of_the_level_turn():
    """Inverse; 5.05 m is below V_min^2 / g = 7.0424^2 / 9.8 = 5.061 m, which no bank reaches."""
    bank = np.radians([15.0, 30.0, 75.0])
    radius = sizing.level_turn_radius(0.150, UMX, bank)
    np.testing.assert_allclose(sizing.level_turn_bank(0.150, UMX, radius), bank, rtol=1e-9)
    assert np.isnan(sizing.level_turn_bank(0.150, UMX, 5.05))


def test_largest_mass_for_the_papers_hall():
    """By hand, 20 m and 30 deg: 1/2 * 1.3 * 0.076 * 0.6 * 10 * tan = 171.1 g, with sin 148.2 g."""
    assert sizing.largest_mass(20.0, UMX) == pytest.approx(0.1711, abs=5e-5)
    assert sizing.largest_mass(20.0, UMX, hold_height=True) == pytest.approx(0.1482, abs=5e-5)


@pytest.mark.parametrize(
    ("hold_height", "radius"), [(False, sizing.paper_turn_radius), (True, sizing.level_turn_radius)]
)
def test_largest_mass_turns_exactly_in_what_the_margin_leaves(hold_height, radius):
    """Inverse: 2 R of the largest mass plus the margin is the width again."""
    width = np.array([12.0, 20.0, 40.0])
    mass = sizing.largest_mass(width, UMX, math.radians(40.0), margin=1.5, hold_height=hold_height)
    np.testing.assert_allclose(2.0 * radius(mass, UMX, math.radians(40.0)) + 1.5, width, rtol=1e-12)


def test_wing_loading_of_the_umx():
    """By hand: 0.150 kg * 9.8 m/s^2 / 0.076 m^2 = 19.34 N/m^2."""
    assert sizing.wing_loading(0.150, UMX) == pytest.approx(19.34, abs=0.005)


def test_papers_masses_do_not_close_by_one_gram():
    """By hand: 150 - (137 + 9 + 5) = -1 g; with 174 g more on board and not listed it is +173 g."""
    assert sizing.unlisted_mass(UMX) == pytest.approx(-0.001, abs=1e-9)
    assert sizing.unlisted_mass(replace(UMX, mass=0.324)) == pytest.approx(0.173, abs=1e-9)


def test_arrays_broadcast():
    """Masses (3, 1) with banks (2,) give (3, 2), each as computed alone."""
    bank = np.radians([20.0, 40.0])
    radius = sizing.level_turn_radius(MASS[:, None], UMX, bank)
    assert radius.shape == (3, 2)
    assert radius[2, 1] == pytest.approx(
        float(sizing.level_turn_radius(0.324, UMX, bank[1])), rel=1e-12
    )


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sizing.minimum_speed(0.0, UMX), "mass"),
        (lambda: sizing.minimum_speed([0.1, math.nan], UMX), "mass"),
        (lambda: sizing.turn_radius(-1.0, 0.5), "speed"),
        (lambda: sizing.load_factor(math.pi / 2), "90 deg"),
        (lambda: sizing.paper_turn_radius(0.15, UMX, -0.1), "bank"),
        (lambda: sizing.largest_mass(20.0, UMX, margin=20.0), "margin"),
        (lambda: sizing.largest_mass(20.0, UMX, margin=-1.0), "margin"),
        (lambda: sizing.level_turn_bank(0.15, UMX, 0.0), "radius"),
    ],
)
def test_bad_numbers_are_refused_by_name(call, words):
    """Values without a physical meaning; the message has the name."""
    with pytest.raises(InputError, match=words):
        call()
