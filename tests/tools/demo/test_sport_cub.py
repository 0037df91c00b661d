"""The real indoor flight of the demo: velocities of the past only, forecasts of time kept back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.flight_table import FlightTable, slice_time
from falconwing_kit.sysid.forecast import constant_velocity
from falconwing_kit.tools.demo import sport_cub
from falconwing_kit.tools.demo.sport_cub import (
    BEGIN_S,
    END_S,
    HORIZON_S,
    analyse_sport_cub_flight,
    coordinated_roll_offset,
    draw_sport_cub_figures,
    measured_poses,
    read_sport_cub_metadata,
    trace,
    with_past_velocity,
)

GRAVITY = 9.8  # [m/s^2] as in the kit's core/frames.py


@pytest.fixture(scope="module")
def analysed():
    """The analysis and the tables that its fit was given; about ten seconds, once."""
    fitted_to, identify = [], sport_cub.identify

    def noted(tables, **options):
        fitted_to.extend(tables)
        return identify(tables, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sport_cub, "identify", noted)
        return analyse_sport_cub_flight(), fitted_to


def table_of(t, p_world, roll=0.0, yaw=0.0) -> FlightTable:
    """A flight of these poses, level, with sticks in the middle."""
    attitude = np.stack(np.broadcast_arrays(roll, 0.0 * t, yaw), axis=1)
    return FlightTable("by hand", t, p_world, attitude, np.zeros((len(t), 4)))


def circle(radius, speed, tracked_roll, side):
    """A level circle to the right (side 1) or left (-1), 8 s at 20 Hz: by hand, y to the left."""
    t = np.arange(160) / 20.0
    angle = side * speed / radius * t  # yaw, positive nose right
    across = radius * side * (np.cos(angle) - 1.0)
    p_world = np.stack([radius * np.sin(side * angle), across, 0.0 * t], axis=1)
    table = table_of(t, p_world, tracked_roll, angle)
    return replace(table, extra={"vx": speed * np.cos(angle), "vy": -speed * np.sin(angle)})


def test_velocity_of_a_parabola_is_exact_at_uneven_times():
    """v = b + 2 c t of p = a + b t + c t^2, without noise; the first three rows have no past."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.03, 0.06, 60))
    a, b, c = rng.normal(size=(3, 3))
    table = with_past_velocity(table_of(t, a + b * t[:, None] + c * t[:, None] ** 2))
    v_world = np.stack([table.extra[name] for name in ("vx", "vy", "vz")], axis=1)
    assert np.isnan(v_world[:3]).all()
    assert v_world[10:] == pytest.approx(b + 2.0 * c * t[10:, None], abs=1e-8)


def test_velocity_uses_nothing_of_the_future():
    """Poses after row 30 change; up to it the velocities stay to the last bit, after it they move.

    A row without a pose has no velocity.
    """
    t = np.arange(60) / 20.0
    p_world = np.stack([np.sin(t), np.cos(2.0 * t), 0.1 * t], axis=1)
    p_world[20] = np.nan
    other = p_world.copy()
    other[31:] += 1.0
    before, after = (with_past_velocity(table_of(t, p)).extra["vx"] for p in (p_world, other))
    assert np.array_equal(before[:31], after[:31], equal_nan=True)
    assert abs(after[31] - before[31]) > 1.0
    assert np.isnan(before[20]) and np.isfinite(before[21:]).all()


@pytest.mark.parametrize("side", [1, -1])
def test_roll_offset_of_a_coordinated_turn(side):
    """Radius 4 m at 4 m/s: tan(roll) = V^2 / (g R) = 16 / 39.2, 22.2 deg to the turn's side.

    The tracked roll reads 0.1 rad too much, so 0.1 rad is to be taken away, on either side.
    """
    roll = side * np.arctan(16.0 / (GRAVITY * 4.0))
    table = circle(4.0, 4.0, roll + 0.1, side)
    assert coordinated_roll_offset(table) == pytest.approx(-0.1, abs=1e-6)


def test_trace_of_a_straight_flight_is_its_line():
    """Constant velocity on a straight line has no error; a trace starts every two seconds, and its
    last point lies 2 s after its first.
    """
    t = np.arange(130) / 20.0
    v_world = np.array([3.0, -1.0, 0.2])
    table = with_past_velocity(table_of(t, v_world * t[:, None]))
    poses, times = trace(constant_velocity, slice_time(table, 0.3, 6.45))
    assert times[:, 0] == pytest.approx([0.3, 2.3, 4.3])
    assert times[:, -1] - times[:, 0] == pytest.approx(HORIZON_S)
    assert poses[..., :3] == pytest.approx(v_world * times[..., None], abs=1e-9)


def test_angles_are_unwrapped_across_a_missing_pose():
    """Three turns to the right in even steps of a tenth of a turn: the yaw grows evenly."""
    t = np.arange(31) / 20.0
    yaw = 0.2 * np.pi * np.arange(31)
    table = table_of(t, np.zeros((31, 3)), yaw=(yaw + np.pi) % (2.0 * np.pi) - np.pi)
    p_world = table.p_world.copy()
    p_world[7] = np.nan
    attitude = table.attitude.copy()
    attitude[7] = np.nan
    seen = np.arange(31) != 7
    unwrapped = measured_poses(replace(table, p_world=p_world, attitude=attitude))[:, 5]
    assert unwrapped[seen] == pytest.approx(yaw[seen]) and np.isnan(unwrapped[7])


def test_the_fit_never_reads_the_time_kept_back(analysed):
    """Rows of the tables that `identify` was given, and starts of the forecasts."""
    analysis, fitted_to = analysed
    (table,) = fitted_to
    assert table.t[0] >= BEGIN_S and table.t[-1] < END_S
    for made in analysis.held_out.values():
        assert analysis.table.t[made.start].min() >= END_S
    kept_back = analysis.table.t[-1] - END_S
    assert kept_back > 130.0  # two thirds of the flight
    assert len(analysis.held_out["model"].t) == pytest.approx(20 * (kept_back - 2.0), rel=0.01)


def test_model_forecasts_twice_as_well_as_any_simple_forecast(analysed):
    """Recorded data, the kit's own limit of half; and in every block of twenty seconds the model
    is the best of the four, position and attitude.
    """
    analysis, _ = analysed
    model, *others = analysis.held_out.values()
    block = np.floor((model.t - END_S) / 20.0)
    for other in others:
        assert np.array_equal(model.start, other.start)
        assert model.position_m < 0.5 * other.position_m
        assert model.attitude_deg < 0.5 * other.attitude_deg
        for number in np.unique(block):
            ours, theirs = model.subset(block == number), other.subset(block == number)
            assert ours.position_m < theirs.position_m
            assert ours.attitude_deg < theirs.attitude_deg
    assert analysis.found.describes_flight


def test_traces_end_where_the_forecasts_do(analysed):
    """The last point of a trace, less the measured pose there, is the error of the forecast."""
    analysis, _ = analysed
    for name, (poses, times) in analysis.traces.items():
        made = analysis.held_out[name]
        assert poses.shape == (10, 21, 6) and times[0, 0] == pytest.approx(END_S, abs=0.06)
        measured = measured_poses(analysis.table)
        for trace_poses, trace_times in zip(poses, times, strict=True):
            (k,) = np.flatnonzero(analysis.table.t[made.start] == trace_times[0])
            error = trace_poses[-1, :3] - measured[made.end[k], :3]
            assert error == pytest.approx(made.error_position[k], abs=1e-9)


def test_figures_are_whole_and_no_others(analysed, tmp_path):
    """First and last chunk of the PNG standard; as small as a page may hold."""
    paths = draw_sport_cub_figures(analysed[0], tmp_path)
    assert sorted(paths) == sorted(tmp_path.iterdir())
    assert [path.name for path in paths] == ["sport_cub_traces.png", "sport_cub_errors.png"]
    for path in paths:
        content = Path(path).read_bytes()
        assert content.startswith(b"\x89PNG\r\n\x1a\n") and content[-8:-4] == b"IEND"
        assert 10_000 < len(content) < 500_000


def test_source_and_licence_are_in_the_data():
    """As LICENSES.md and data/README.md name them; the page prints them from here."""
    source = read_sport_cub_metadata()["source"]
    assert source["repository"] == "https://github.com/CogniPilot/cubs2"
    assert source["licence"] == "Apache-2.0"
