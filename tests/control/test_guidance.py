"""Guidance: circles, helices and lines by geometry, the bank of a coordinated turn."""

import numpy as np
import pytest

from falconwing_kit.control.guidance import PREVIEW_S, Hall, ReferencePath, require_flyable
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import load_toml
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.scene.arena import PLAN


def helix(radius=10.0, slope=0.1, turns=0.75):
    """A climbing right turn from the origin along world x; a point about every metre."""
    u = np.linspace(0.0, 2.0 * np.pi * turns, round(2.0 * np.pi * turns * radius))
    return np.column_stack([radius * np.sin(u), radius * (np.cos(u) - 1.0), slope * radius * u])


def test_helix_has_its_length_curvature_climb_and_bank():
    """Length = level length sqrt(1 + slope^2), curvature 1/R, climb atan(slope), tan(bank) = (V cos
    climb)^2 / (g R).

    Within 0.2 %: chords of a metre on a circle of 10 m, away from the spline's ends.
    """
    path, V = ReferencePath(helix()), 7.0
    assert path.length == pytest.approx(10.0 * 1.5 * np.pi * np.hypot(1.0, 0.1), rel=2e-3)
    reference = path.at(20.0, V)
    climb = np.arctan(0.1)
    u = 20.0 * np.cos(climb) / 10.0
    assert reference.p_world == pytest.approx(
        [10.0 * np.sin(u), 10.0 * (np.cos(u) - 1.0), u], abs=0.02
    )
    assert reference.yaw == pytest.approx(u, abs=2e-3)
    assert reference.climb == pytest.approx(climb, rel=2e-3)
    assert np.tan(reference.bank) == pytest.approx(
        (V * np.cos(climb)) ** 2 / (GRAVITY * 10.0), rel=2e-3
    )


def test_bank_looks_ahead():
    """A straight line, then a turn at 10 m: the bank begins PREVIEW_S before, 1.4 m at 7 m/s."""
    line = np.column_stack([np.arange(-10.0, 0.0), np.zeros(10), np.zeros(10)])
    path = ReferencePath(np.concatenate([line, helix(slope=0.0)]))
    assert path.at(10.0 - 7.0 * PREVIEW_S - 1.5, 7.0).bank == pytest.approx(0.0, abs=0.05)
    assert path.at(10.0 - 7.0 * PREVIEW_S + 1.5, 7.0).bank == pytest.approx(
        np.arctan(49.0 / 98.0), abs=0.05
    )


def test_straight_on_beyond_both_ends():
    """Two points make a line; the course of (3, 4) with y to the left is yaw = -atan2(4, 3)."""
    path = ReferencePath(np.array([[0.0, 0.0, 1.0], [3.0, 4.0, 1.0]]))
    for s in (-2.0, 2.0, 9.0):
        reference = path.at(s, 7.0)
        assert reference.p_world == pytest.approx([0.6 * s, 0.8 * s, 1.0], abs=1e-9)
        assert reference.yaw == pytest.approx(-np.arctan2(4.0, 3.0), abs=1e-9)
        assert path.nearest(reference.p_world + np.array([0.8, -0.6, 0.5])) == pytest.approx(
            s, abs=1e-9
        )


def test_nearest_stays_on_its_branch_at_a_crossing():
    """A figure eight passes its middle twice; the last position decides which pass is meant."""
    u = np.linspace(0.0, 2.0 * np.pi, 80)
    path = ReferencePath(np.column_stack([15.0 * np.sin(u), 6.0 * np.sin(2.0 * u), np.ones(80)]))
    half = path.length / 2.0
    middle = np.array([0.05, 0.05, 1.0])
    assert path.nearest(middle, near=half - 1.0) == pytest.approx(half, abs=0.1)
    assert path.nearest(middle, near=1.0) == pytest.approx(0.0, abs=0.1)


def test_too_tight_or_steep_is_refused():
    """At 7 m/s and 30 deg a turn needs V^2 / (g tan 30) = 8.66 m; a slope of 1 in 4 is 14 deg."""
    limit = np.radians(30.0)
    require_flyable(ReferencePath(helix(radius=8.9, slope=0.0)), 7.0, limit)
    with pytest.raises(InputError, match="deg of bank"):
        require_flyable(ReferencePath(helix(radius=8.3, slope=0.0)), 7.0, limit)
    with pytest.raises(InputError, match="deg of climb"):
        require_flyable(ReferencePath(helix(radius=12.0, slope=0.25)), 7.0, limit)


@pytest.mark.parametrize(
    "points", [[[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]] * 2, [[0.0, 0.0, np.nan], [1.0, 0.0, 0.0]]]
)
def test_no_path_without_different_points(points):
    """One point, the same twice, and a nan."""
    with pytest.raises(InputError, match="path"):
        ReferencePath(np.array(points))


def test_beams_are_those_of_the_arena():
    """Underside of the beams in the plan of the rendered hall."""
    beams = [box for box in load_toml(PLAN)["box"] if box.get("colour") == "glulam"]
    assert {box["low"][2] for box in beams} == {Hall().beams}


def test_margin_by_hand():
    """From x -22.5..17.5, y -12..8, z 4.65: one point near each side, and one outside; `clamp`
    brings it back.
    """
    points = np.array(
        [[-20.0, 0.0, 2.0], [16.5, 0, 2], [0, -11.5, 2], [0, 7.0, 2], [0, 0, 4.55], [18.0, 0, 2]]
    )
    assert Hall().margin(points) == pytest.approx([2.5, 1.0, 0.5, 1.0, 0.1, -0.5])
    assert Hall().clamp(np.array([18.0, -13.0, 0.1]), 1.0) == pytest.approx([16.5, -11.0, 1.0])
