"""Forecasts: exact on analytic flights and on the model's own flight; refusals."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.integrate import fly
from falconwing_kit.aircraft.model import FORMS
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.sysid.forecast import (
    Forecasts,
    constant_turn,
    constant_velocity,
    forecast,
    hold_throttle,
)
from tests.sysid.simulated import drawn, fly_figure_eights

T = np.arange(201) * 0.05


def table(t, p_world, attitude, velocity, rates=None, commands=None):
    """A flight table with logged velocities (N, 3) and, if given, body rates (N, 3)."""
    extra = dict(zip(("vx", "vy", "vz"), velocity.T, strict=True))
    if rates is not None:
        extra |= dict(zip("pqr", rates.T, strict=True))
    wrapped = (attitude + np.pi) % (2.0 * np.pi) - np.pi
    commands = np.zeros((len(t), 4)) if commands is None else commands
    return FlightTable("made", t, p_world, wrapped, commands, extra)


def straight():
    """7 m/s along x, 1 m/s to the right, climbing at 0.5 m/s, constant bank of 0.3 rad."""
    velocity = np.tile([7.0, -1.0, 0.5], (len(T), 1))
    return table(T, velocity * T[:, None], np.tile([0.3, 0.1, 0.0], (len(T), 1)), velocity)


def circle(bank=0.5, speed=7.0, climb=0.4):
    """A climbing turn to the right: yaw rate g tan(bank)

    V, radius V^2 / (g tan(bank)).
    """
    rate = GRAVITY * np.tan(bank) / speed
    yaw = 2.5 + rate * T  # to the right, so the course in the world, counted to the left, falls
    radius = speed / rate
    p_world = np.column_stack([radius * np.sin(yaw), radius * np.cos(yaw), 2.0 + climb * T])
    velocity = np.column_stack([speed * np.cos(yaw), -speed * np.sin(yaw), 0.0 * T + climb])
    return table(T, p_world, np.column_stack([0.0 * T + bank, 0.0 * T + 0.1, yaw]), velocity)


# Simple guesses


def test_constant_velocity_is_exact_on_a_straight_line():
    """By hand: no turn, no acceleration. 181 rows have one a second later, the next five one within
    the tolerance of 0.25 s.
    """
    found = constant_velocity(straight())
    assert len(found.start) == 186
    assert found.position_m < 1e-9 and found.attitude_deg < 1e-6


def test_constant_velocity_leaves_a_circle_on_its_tangent():
    """By hand: on a circle with radius R, after the angle a = V t / R, the tangent is off by
    R sqrt((a - sin a)^2 + (1 - cos a)^2), and yaw by a."""
    rate = GRAVITY * np.tan(0.5) / 7.0
    radius = 7.0 / rate
    found = constant_velocity(circle()).subset(np.arange(181))
    assert found.position_m == pytest.approx(
        radius * np.hypot(rate - np.sin(rate), 1.0 - np.cos(rate)), rel=1e-6
    )
    assert found.attitude_deg == pytest.approx(np.degrees(rate), rel=1e-6)


@pytest.mark.parametrize("bank", [0.5, -0.7, 0.01, 1e-4])
@pytest.mark.parametrize("horizon", [0.5, 1.0, 2.0])
def test_constant_turn_is_exact_on_a_circle(bank, horizon):
    """Coordinated turns left and right, more than half a circle; nearly straight at small bank."""
    found = constant_turn(circle(bank), horizon)
    assert found.position_m < 1e-6 and found.attitude_deg < 1e-5


def test_constant_turn_takes_a_bank_for_a_turn():
    """On a straight line with one wing low it predicts a turn: yaw is off by g tan(0.3) t

    V.
    """
    found = constant_turn(straight())
    rate = GRAVITY * np.tan(0.3) / np.hypot(7.0, 1.0)
    assert found.error_attitude[:181, 2] == pytest.approx(np.full(181, rate), rel=1e-9)
    assert (found.error_position[:181, 1] < -1.0).all()  # to the right


# The model


@pytest.fixture(scope="module", params=sorted(FORMS))
def own(request):
    """A noiseless log of the model's own flight with velocities and rates: model and log."""
    model = drawn(FORMS[request.param](), np.random.default_rng(61))
    flown = fly_figure_eights([model], 20.0, np.random.default_rng(62))
    states, commands = flown.states[0], flown.sticks[0]
    again = fly(
        model, states[0], flown.t, commands
    )  # with the kit's own steps, so that nothing is left over
    rates = again[:, 9:] if model.form == "rates" else None
    return model, table(flown.t, again[:, :3], again[:, [5, 3, 4]], again[:, 6:9], rates, commands)


def test_the_model_forecasts_its_own_flight(own):
    """Inverse of a simulation: 1 mm and 0.01 deg over a second; earlier commands count through the
    lag.
    """
    model, log = own
    found = forecast(model, log)
    assert found.position_m < 1e-3 and found.attitude_deg < 0.01
    guesses = [constant_velocity(log).position_m, constant_turn(log).position_m]
    assert min(guesses) > 100.0 * found.position_m


def test_a_forecast_ends_a_horizon_later(own):
    """Rows a horizon apart (shorter only in the last 0.25 s); errors belong to the last row."""
    model, log = own
    found = forecast(model, log, 0.5)
    assert len(found.start) == 396
    found = found.subset(np.arange(391))
    assert log.t[found.end] - log.t[found.start] == pytest.approx(np.full(len(found.start), 0.5))
    assert found.t == pytest.approx(log.t[found.end])
    moved = replace(
        log, p_world=np.where(np.arange(len(log.t))[:, None] == 300, log.p_world + 1.0, log.p_world)
    )
    hit = forecast(model, moved, 0.5)
    assert hit.error_position[hit.end == 300] == pytest.approx(-np.ones((1, 3)), abs=1e-3)
    assert hit.error_position[hit.start == 300] == pytest.approx(np.ones((1, 3)), abs=1e-3)


def test_sparse_poses_are_matched_to_the_nearest(own):
    """A pose every fourth row: a horizon of 0.9 s ends at the pose after 0.8 or 1.0 s."""
    model, log = own
    measured = np.arange(len(log.t)) % 4 == 0
    sparse = replace(log, p_world=np.where(measured[:, None], log.p_world, np.nan))
    found = forecast(model, sparse, 0.9)
    assert set(np.round(log.t[found.end] - log.t[found.start], 3)) <= {0.8, 1.0}
    assert len(found.start) > 90 and found.position_m < 1e-3


def test_commands_after_the_start_count(own):
    """With the throttle at its mean, the forecast of the same flight is off."""
    model, log = own
    mean_throttle = hold_throttle(log, since=10.0, over=5.0)
    mean = log.commands[(log.t >= 5.0) & (log.t < 10.0), 0].mean()
    assert (mean_throttle.commands[log.t >= 10.0, 0] == mean).all()
    assert np.array_equal(mean_throttle.commands[log.t < 10.0], log.commands[log.t < 10.0])
    assert np.array_equal(mean_throttle.commands[:, 1:], log.commands[:, 1:])
    before, after = (
        forecast(model, mean_throttle).within(*span).position_m
        for span in ((0.0, 9.9), (10.0, 20.0))
    )
    assert before < 1e-3 < 0.005 < after


# Numbers and refusals


def test_root_mean_squares_by_hand():
    """Distances of 5, 2, 1 from three errors: sqrt((25 + 4 + 1) / 3); angles in degrees."""
    errors = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0], [1.0, 0.0, 0.0]])
    rows = np.arange(3)
    found = Forecasts(rows, rows + 1, np.array([1.0, 2.0, 3.0]), errors, np.radians(errors))
    assert found.position_m == pytest.approx(np.sqrt(10.0))
    assert found.attitude_deg == pytest.approx(np.sqrt(10.0))
    assert found.subset(rows > 0).position_m == pytest.approx(np.sqrt(2.5))
    assert found.within(1.5, 3.0).t.tolist() == [2.0]


@pytest.mark.parametrize("missing", ["vx", "vz", "q"])
def test_a_log_without_velocities_is_refused(own, missing):
    """The sentence names the column; body rates are required by the 12-state form only."""
    model, log = own
    short = replace(log, extra={k: v for k, v in log.extra.items() if k != missing})
    if missing == "q" and model.form == "paper":
        assert len(forecast(model, short).start) > 0
        return
    with pytest.raises(InputError, match=f"expected logged columns .*, got none for {missing}"):
        forecast(model, short)


@pytest.mark.parametrize("guess", [constant_velocity, constant_turn])
def test_baselines_require_velocities_too(guess):
    """The same sentence."""
    with pytest.raises(InputError, match="got none for vx"):
        guess(replace(straight(), extra={}))


def test_poses_too_close_or_too_few_are_refused():
    """No row is 60 s ahead in a flight of 10 s; a single pose has none ahead."""
    with pytest.raises(InputError, match="expected poses 60 s apart, got none"):
        constant_velocity(straight(), 60.0)
    lonely = straight()
    p_world = np.full_like(lonely.p_world, np.nan)
    p_world[7] = 1.0
    with pytest.raises(InputError, match="expected poses to forecast from, got 1"):
        constant_velocity(replace(lonely, p_world=p_world))


def test_rows_without_velocity_are_left_out():
    """A gap in the velocity is a gap in the forecasts, not a nan in their mean."""
    log = straight()
    vx = log.extra["vx"].copy()
    vx[50:60] = np.nan
    found = constant_velocity(replace(log, extra={**log.extra, "vx": vx}))
    assert len(found.start) == 176 and not set(range(50, 60)) & set(found.start)
    assert found.position_m < 1e-9
