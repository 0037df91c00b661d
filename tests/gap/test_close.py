"""Closing: on time no fit has seen, the named effect brings the model back to what calm flight leaves."""

import numpy as np
import pytest

from falconwing_kit.gap.close import close_gap
from falconwing_kit.gap.name import name_effect
from tests.gap.studies import own_base, own_flight, wind_study


def test_gap_closes_with_the_wind():
    """The goal of the kit: 90 % of the held-out excess over the calm level."""
    closed = wind_study().closed
    over = closed.before.chi2 - closed.calm.chi2
    assert over > 3.0
    assert closed.after.chi2 - closed.calm.chi2 < 0.1 * over
    assert closed.after_pinned.chi2 - closed.calm.chi2 < 0.1 * over
    assert closed.before_free.chi2 - closed.calm.chi2 > 0.5 * over  # parameters alone do not close it
    assert closed.after.position_m < closed.before.position_m
    assert not closed.seen


def test_sizes_hold_the_truth():
    """The wind that was planted: 0.0924 m/s along x and 0.4370 along y; its 95 % interval is 0.007 wide to a side."""
    sizes = wind_study().closed.parameters
    for name, truth in (("wind_x", 0.0924), ("wind_y", 0.4370)):
        assert sizes[name].low95 < truth < sizes[name].high95
        assert sizes[name].high95 - sizes[name].low95 < 0.05
        assert sizes[name].unit == "m/s"


def test_scored_windows_are_whole_blocks_of_time():
    """About 30 % in blocks of 10 s: of nine blocks of a 90 s flight two are scored, ten windows."""
    study = wind_study()
    begins = study.naming.windows.nodes[study.closed.held_out, 0]
    assert 0.2 < len(begins) / len(study.naming.windows) < 0.4
    assert len(np.unique((begins - study.naming.windows.nodes[0, 0]) // 10.0)) <= 3


def test_short_calm_flight_changes_nothing():
    """Nothing is missing in 24 s of calm flight, so after is before; shorter blocks still leave time to score."""
    naming = name_effect(own_base(), own_flight(None, 24.0, 31))
    closed = close_gap(own_base(), naming)
    assert naming.verdict == "none"
    assert closed.after is closed.before
    assert closed.parameters == {}
    assert 0 < len(closed.held_out) < len(naming.windows)
    assert closed.before.chi2 == pytest.approx(1.0, abs=0.5)
