"""Input map: delay and servo lag against scipy's linear simulation on a grid five hundred times
finer.
"""

import numpy as np
import pytest
from scipy.signal import lsim

from falconwing_kit.aircraft.inputs import actuator_response, second_order_lag

ROW, STEP, FINE = 0.05, 0.025, 5e-5  # rows of commands, integration steps, the reference's grid [s]
EDGES = np.arange(41) * STEP


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def jittered_commands(rng, count=22):
    """Times that jitter by 10 ms, as logs do, on the fine grid; the first rows alike, so that
    servos begin settled.
    """
    t = np.round((np.arange(count) * ROW + rng.uniform(0.0, 0.01, count)) / FINE) * FINE
    commands = rng.uniform(-1.0, 1.0, (count, 4))
    commands[:2] = commands[0]
    return t, commands


def fine_response(t, commands, delay, lag):
    """Servo positions (M, 4) on the fine grid: the commands held, delayed, through 1 / (lag s + 1)
    by scipy.
    """
    grid = np.arange(round(EDGES[-1] / FINE) + 1) * FINE
    held = commands[
        np.clip(np.searchsorted(t + delay, grid + 1e-9, side="right") - 1, 0, len(t) - 1)
    ]
    if lag == 0.0:
        return grid, held
    settled = [lsim((1.0, [lag, 1.0]), u - u[0], grid, interp=False)[1] + u[0] for u in held.T]
    return grid, np.stack(settled, axis=1)


def mean_and_swing(position, smooth, step=STEP):
    """Mean and 6 / T^2 times the first moment of each step, by the trapezoidal rule, or by sums
    where it jumps.
    """
    per_step = round(step / FINE)
    of_step = np.stack(
        [position[k : k + per_step + 1] for k in range(0, len(position) - 1, per_step)]
    )
    middle = of_step[:, :-1] if not smooth else 0.5 * (of_step[:, :-1] + of_step[:, 1:])
    at = ((np.arange(per_step) + 0.5) * FINE - 0.5 * step)[:, None]
    return middle.mean(axis=1), 6.0 / step**2 * (middle * at).sum(axis=1) * FINE


@pytest.mark.parametrize("lag", [0.0, 0.004, 0.03, 0.2])
@pytest.mark.parametrize("delay", [0.0, 0.0123, 0.05, 0.11])
def test_mean_and_moment_are_those_of_a_fine_simulation(rng, delay, lag):
    """scipy's lsim at 0.05 ms; its own trapezoids leave (0.05 ms / lag)^2 of a jump, and jumps fall
    on its grid.
    """
    t, commands = jittered_commands(rng)
    delay = round(delay / FINE) * FINE
    mean, slope = actuator_response(t, commands, EDGES, delay, lag)
    _, position = fine_response(t, commands, delay, lag)
    fine_mean, fine_swing = mean_and_swing(position, smooth=lag > 0.0)
    assert np.abs(mean - fine_mean).max() < 2e-4
    assert np.abs(slope - fine_swing).max() < 1e-3
    assert np.abs(slope).max() > 0.05


def test_by_hand_a_step_in_the_middle():
    """0 becomes 1 at 20 ms; delayed by 5 ms it acts for half of the step 0..50 ms: mean 1/2, swing
    6/T^2 * T^2/8.
    """
    t, commands = np.array([0.0, 0.02]), np.array([[0.0] * 4, [1.0] * 4])
    mean, slope = actuator_response(t, commands, np.array([-0.05, 0.0, 0.05, 0.1]), 0.005, 0.0)
    assert mean[:, 0] == pytest.approx([0.0, 0.5, 1.0], abs=1e-12)
    assert slope[:, 0] == pytest.approx([0.0, 0.75, 0.0], abs=1e-12)


def test_by_hand_a_servo_after_a_jump():
    """From 0 to 1 at the start of a step T = lag: the mean of 1 - exp(-s) over 0..1 is exp(-1) =
    0.367879.
    """
    t, commands = np.array([0.0, 0.05]), np.array([[0.0] * 4, [1.0] * 4])
    mean, slope = actuator_response(t, commands, np.array([0.0, 0.05, 0.1]), 0.0, 0.05)
    assert mean[1, 0] == pytest.approx(np.exp(-1.0), abs=1e-12)
    # 6 times the moment of 1 - exp(-s) about s = 1/2: integral of -(s - 1/2) exp(-s) is 1.5/e -
    # 0.5.
    assert slope[1, 0] == pytest.approx(6.0 * (1.5 * np.exp(-1.0) - 0.5), abs=1e-12)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_steady_sticks_act_as_they_are(lag):
    """Nothing changes, so nothing is delayed; before the first row the first acted."""
    mean, slope = actuator_response(
        np.arange(20) * ROW, np.full((20, 4), 0.3), EDGES - 0.2, 0.07, lag
    )
    assert mean == pytest.approx(np.full((40, 4), 0.3), abs=1e-12)
    assert slope == pytest.approx(np.zeros((40, 4)), abs=1e-12)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_a_delay_of_one_row_is_the_table_moved_by_one_row(rng, lag):
    """By meaning of the word."""
    t, commands = np.arange(22) * ROW, rng.uniform(-1.0, 1.0, (22, 4))
    commands[:2] = commands[0]
    delayed = actuator_response(t, commands, EDGES, ROW, lag)
    moved = actuator_response(t, np.concatenate([commands[:1], commands[:-1]]), EDGES, 0.0, lag)
    assert np.abs(np.stack(delayed) - np.stack(moved)).max() < 1e-12


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_the_mean_is_continuous_in_the_delay(rng, lag):
    """A fit moves the delay in tiny steps: 1 us moves no mean by more than the largest jump (2)
    times 1 us / 25 ms.
    """
    t, commands = jittered_commands(rng)
    delays = np.concatenate(
        [
            d + np.array([-1e-6, 0.0, 1e-6])
            for d in (0.02, 0.025, 0.05, 0.075, 0.1, *rng.uniform(0, 0.2, 20))
        ]
    )
    means = np.stack([actuator_response(t, commands, EDGES, d, lag)[0] for d in delays]).reshape(
        -1, 3, 40, 4
    )
    assert np.abs(np.diff(means, axis=1)).max() < 2.0 * 1e-6 / STEP + 1e-12
    assert np.abs(np.diff(means, axis=1)).max() > 1e-6


def test_a_vanishing_lag_is_no_lag(rng):
    """Where the formula for the servo is left (1 us), what it leaves is below 1 us / 25 ms of a
    jump.
    """
    t, commands = jittered_commands(rng)
    none, tiny = (
        np.stack(actuator_response(t, commands, EDGES, 0.013, lag)) for lag in (0.0, 2e-6)
    )
    assert np.abs(tiny - none).max() < 1e-3


def test_windows_are_mapped_as_each_alone(rng):
    """A stack of windows is the same arithmetic, row by row."""
    t, commands = jittered_commands(rng)
    windows = np.array([0.1, 0.32, 0.55])[:, None] + np.arange(9) * STEP
    together = actuator_response(t, commands, windows, 0.02, 0.03)
    for k, window in enumerate(windows):
        alone = actuator_response(t, commands, window, 0.02, 0.03)
        assert np.array_equal(together[0][k], alone[0])
        assert np.array_equal(together[1][k], alone[1])


# A second lag in series
# -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [0.004, 0.03, 0.2])
def test_a_second_lag_is_exact_where_positions_move_straight(rng, lag):
    """Corners at the ends of steps only, so that a mean and a swing say all: scipy's lsim, exact
    for straight pieces.

    The trapezoids of the means and moments leave (0.05 ms / lag)^2 / 12 of the largest swing,
    1.3e-5 of one.
    """
    corners = rng.uniform(-1.0, 1.0, (len(EDGES), 4))
    corners[:2] = corners[0]
    mean, slope = 0.5 * (corners[1:] + corners[:-1]), 0.5 * np.diff(corners, axis=0)
    grid = np.arange(round(EDGES[-1] / FINE) + 1) * FINE
    straight = [np.interp(grid, EDGES, c - c[0]) for c in corners.T]
    position = (
        np.stack([lsim((1.0, [lag, 1.0]), y, grid)[1] for y in straight], axis=1) + corners[0]
    )
    after = second_order_lag(mean, slope, np.diff(EDGES), lag)
    want = mean_and_swing(position, smooth=True)
    assert np.abs(np.stack(after) - np.stack(want)).max() < 1e-4
    assert np.abs(after[0] - mean).max() > 0.05


@pytest.mark.parametrize("second", [0.05, 0.2])
@pytest.mark.parametrize("first", [0.01, 0.03])
def test_two_lags_in_series_are_those_of_a_fine_simulation(rng, first, second):
    """scipy's lsim of 1 / ((first s + 1) (second s + 1)) on the fine grid, here with steps of T =
    2.5 ms.

    Of the first servo's path within a step only mean and moment are handed on. A jump of two makes
    a kink, which leaves at most 0.4 T / first beside its straight line; the second servo passes 1/8
    (T / second)^2 of that into a mean, since its memory is straight but for so much, and 3/4 T /
    second into a swing.
    """
    step, delay = 0.0025, round(0.0123 / FINE) * FINE
    t, commands = jittered_commands(rng)
    edges = np.arange(round(EDGES[-1] / step) + 1) * step
    after = second_order_lag(
        *actuator_response(t, commands, edges, delay, first), np.diff(edges), second
    )
    grid, held = fine_response(t, commands, delay, 0.0)
    both = (1.0, np.polymul([first, 1.0], [second, 1.0]))
    position = np.stack(
        [lsim(both, u - u[0], grid, interp=False)[1] + u[0] for u in held.T], axis=1
    )
    mean, slope = mean_and_swing(position, smooth=True, step=step)
    kink = 0.4 * step / first
    assert (
        np.abs(after[0] - mean).max() < kink * (step / second) ** 2 / 8.0 + 1e-5
    )  # of the reference's trapezoids
    assert np.abs(after[1] - slope).max() < kink * 0.75 * step / second
    assert np.abs(slope).max() > 3.0 * kink * step / second


@pytest.mark.parametrize("lag", [0.0, 1e-7])
def test_no_second_lag_passes_everything(rng, lag):
    """To the last bit, so that the base model is as it was."""
    mean, slope = rng.normal(size=(2, 3, 40, 4))
    after = second_order_lag(mean, slope, np.full((3, 40), STEP), lag)
    assert np.array_equal(after[0], mean) and np.array_equal(after[1], slope)


def test_by_hand_a_second_lag_after_a_jump():
    """From 0 to 1 between two steps of T = lag: the mean of 1 - exp(-s) over 0..1 is exp(-1), then
    1 - exp(-1) (1 - exp(-1)) over 1..2; 6 times the first moment as for the servo above.
    """
    mean = np.array([0.0, 1.0, 1.0])[:, None] * np.ones(4)
    after, slope = second_order_lag(mean, 0.0 * mean, np.full(3, 0.05), 0.05)
    e = np.exp(-1.0)
    assert after[:, 0] == pytest.approx([0.0, e, 1.0 - e * (1.0 - e)], abs=1e-12)
    assert slope[1, 0] == pytest.approx(6.0 * (1.5 * e - 0.5), abs=1e-12)


def test_steps_of_unequal_length_keep_their_own_time(rng):
    """A step cut in two: the same path, so the mean of the halves' means is the mean of the whole;
    and windows in a stack are lagged as each alone.
    """
    mean, slope = rng.normal(size=(2, 40, 4))
    mean[:2] = mean[0]
    whole, _ = second_order_lag(mean, 0.0 * slope, np.full(40, STEP), 0.03)
    halves, _ = second_order_lag(
        np.repeat(mean, 2, axis=0), np.zeros((80, 4)), np.full(80, STEP / 2), 0.03
    )
    uneven = np.tile([0.2 * STEP, 0.8 * STEP], 40)
    parts, _ = second_order_lag(np.repeat(mean, 2, axis=0), np.zeros((80, 4)), uneven, 0.03)
    assert 0.5 * (halves[::2] + halves[1::2]) == pytest.approx(whole, abs=1e-12)
    assert 0.2 * parts[::2] + 0.8 * parts[1::2] == pytest.approx(whole, abs=1e-12)
    stacked, _ = second_order_lag(
        np.stack([-mean, mean, mean]), np.zeros((3, 40, 4)), np.full((3, 40), STEP), 0.03
    )
    assert np.array_equal(stacked, np.stack([-whole, whole, whole]))
