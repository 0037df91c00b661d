"""Multiple shooting: windows, predictions, derivatives against the truth of simulated flights."""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import FORMS, paper_model, rates_model
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import InputError
from falconwing_kit.sysid.prepare import PreparedFlight, prepare
from falconwing_kit.sysid.shooting import (
    cut_windows,
    finite_differences,
    fly_windows,
    jacobian,
    pose_residuals,
    predict,
    residual_sets,
    residuals,
)
from tests.sysid.simulated import MARKER, drawn, fly_figure_eights, measured

SIGMA = np.array([MARKER[0]] * 3 + [MARKER[1]] * 3)
# Rolling moment per V^2: a coefficient times angle of attack times aileron.
PRODUCT = Effect(
    "product",
    "The ailerons act more at large angles of attack.",
    (Parameter("product", 0.0, -10.0, 10.0, "1/(m^2 rad)", "coefficient"),),
    loads=lambda air, K: (
        0.0, 0.0, 0.0, K.product * air.airspeed * air.airspeed * air.alpha * air.aileron, 0.0, 0.0,
    ),
)  # fmt: skip


@pytest.fixture(scope="module", params=sorted(FORMS))
def perfect(request):
    """A noiseless simulated flight of 40 s: aircraft, windows, true initial states."""
    rng = np.random.default_rng(3)
    truth = drawn(FORMS[request.param](), rng)
    flown = fly_figure_eights([truth], 40.0, rng)
    windows = cut_windows(prepare(measured(flown, rng, noise=(0.0, 0.0)), SIGMA).flights, truth)
    first = np.rint(windows.nodes[:, 0] / 0.05).astype(int)
    return truth, windows, flown.states[0][first]


@pytest.fixture(scope="module")
def noisy():
    """A noisy flight of 12 s, 12-state model: aircraft, windows, perturbed initial states."""
    rng = np.random.default_rng(4)
    truth = drawn(rates_model(), rng)
    table = measured(fly_figure_eights([truth], 12.0, rng), rng, missing=0.05)
    windows = cut_windows(prepare(table, SIGMA).flights, truth)
    return (
        truth,
        windows,
        windows.initial_guess + 0.01 * rng.normal(size=windows.initial_guess.shape),
    )


def flight(seconds, begin=0.0, name="made", period=0.05):
    """Poses that equal their row number, so that each can be identified."""
    t = begin + np.arange(round(seconds / period) + 1) * period
    pose = 1000.0 * begin + np.arange(len(t))[:, None] + np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    state = np.tile(np.array([0, 0, 2, 0.1, 0, 0, 7, 0, 0, 0, 0, 0.0]), (len(t), 1))
    return PreparedFlight(name, t, pose, np.full((len(t), 4), 0.3), SIGMA, state, 0.0 * state)


# Windows
# -------


def test_windows_follow_each_other_without_overlap():
    """By hand: 20 s at 20 Hz are 401 rows; less the first ten, nine windows of 40 rows fit; each
    row is used once.
    """
    windows = cut_windows([flight(20.0)], rates_model())
    assert windows.nodes.shape == (9, 40)
    assert windows.nodes.ravel() == pytest.approx(np.arange(10, 370) * 0.05, abs=1e-12)
    assert windows.pose[..., 0].ravel() == pytest.approx(np.arange(10, 370) + 0.1, abs=1e-9)
    assert windows.weight == pytest.approx(np.broadcast_to(1.0 / SIGMA, (9, 40, 6)))
    assert windows.count == 9 * 40 * 6


@pytest.mark.parametrize(("form", "per_row"), [("paper", 1), ("rates", 2)])
def test_integration_steps_end_at_rows(form, per_row):
    """50 ms steps in the 9-state model, 25 ms in the 12-state model; the warm-up steps before a
    window integrate the actuators only.
    """
    windows = cut_windows([flight(10.0)], FORMS[form]())
    at_rows = windows.edges[:, windows.warmup_steps :: per_row]
    assert windows.substeps == per_row
    assert at_rows == pytest.approx(windows.nodes, abs=1e-12)
    assert np.diff(windows.edges, axis=1) == pytest.approx(0.05 / per_row, abs=1e-12)
    warmup = windows.nodes[0, 0] - windows.edges[0, 0]
    assert warmup == pytest.approx(1.0)  # twice the longest delay and lag


def test_windows_do_not_cross_from_one_flight_to_the_next():
    """Two flights of 5 s, each with its own clock: two windows each, none mixes poses of both."""
    windows = cut_windows([flight(5.0), flight(5.0, begin=7.0)], rates_model())
    assert windows.flight.tolist() == [0, 0, 1, 1]
    assert np.ptp(windows.pose[..., 0], axis=1) == pytest.approx(np.full(4, 39.0))
    assert (windows.pose[2:, :, 0] > 7000.0).all() and (windows.pose[:2, :, 0] < 1000.0).all()
    # Times count from the start of each flight.
    assert windows.nodes[2:] == pytest.approx(windows.nodes[:2], abs=1e-9)


def test_windows_do_not_cross_a_gap():
    """A table with 1 s missing: no step within a window is longer than a frame."""
    rng = np.random.default_rng(0)
    table = measured(fly_figure_eights([rates_model()], 20.0, rng), rng)
    kept = (table.t < 8.0) | (table.t > 9.0)
    cut = replace(
        table, t=table.t[kept], p_world=table.p_world[kept], attitude=table.attitude[kept],
        commands=table.commands[kept],
    )  # fmt: skip
    windows = cut_windows(prepare(cut).flights, rates_model())
    assert set(windows.flight) == {0, 1}
    assert np.diff(windows.nodes, axis=1).max() < 0.051


def test_a_missing_pose_has_no_weight():
    """Half a pose may be missing: its three channels have no weight, the others keep theirs."""
    one = flight(10.0)
    one.pose[60:65, :3] = np.nan
    windows = cut_windows([one], rates_model())
    gone = windows.weight == 0.0
    assert np.argwhere(gone).tolist() == [
        [1, row, axis] for row in range(10, 15) for axis in range(3)
    ]
    assert windows.count == len(windows) * 240 - 15
    assert (windows.pose[gone] == 0.0).all()


def test_a_window_with_too_few_poses_is_left_out():
    """21 of 40 poses are missing in the second window, 20 in the third: the second goes, the third
    stays.
    """
    one = flight(10.0)
    one.pose[50:71] = np.nan
    one.pose[90:110] = np.nan
    windows = cut_windows([one], rates_model())
    assert (windows.nodes[:, 0] / 0.05).round().tolist() == [10, 90, 130]


def test_too_short_a_flight_is_refused():
    """By hand: 2 s and ten rows before them are 2.5 s."""
    with pytest.raises(InputError, match=r"expected at least 2\.5 s in one piece, got 2\.0 s"):
        cut_windows([flight(2.0)], rates_model())


# Predictions
# -----------


def test_the_true_aircraft_from_the_true_state_predicts_the_true_poses(perfect):
    """Simulated with 10 ms steps; the fit's 25 (rates) or 50 ms (paper) cost less than 1 mm and 1
    mrad over 2 s.
    """
    truth, windows, states = perfect
    error = fly_windows(truth, windows, states) - windows.pose
    error[..., 3:] = (error[..., 3:] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(error).max() < 1e-3
    assert np.ptp(windows.pose[..., :3], axis=1).max() > 5.0  # not at rest


def test_residuals_are_sigmas(perfect):
    """1 m and 0.1 rad added to what was measured: residuals of -1/sigma and -0.1/sigma."""
    truth, windows, states = perfect
    moved = replace(windows, pose=windows.pose + np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.1]))
    change = pose_residuals(residuals(truth, moved, states), windows)
    change = change - pose_residuals(residuals(truth, windows, states), windows)
    expected = np.array([-1.0 / SIGMA[0], 0.0, 0.0, 0.0, 0.0, -0.1 / SIGMA[5]])
    assert change == pytest.approx(np.broadcast_to(expected, change.shape), abs=1e-6)


def test_whole_turns_of_yaw_do_not_matter(perfect):
    """The same attitude: measured with three turns more, or started with two turns less."""
    truth, windows, states = perfect
    plain = residuals(truth, windows, states)
    turned = replace(windows, pose=windows.pose + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 6.0 * np.pi]))
    back = states.copy()
    back[:, 4] -= 4.0 * np.pi
    assert residuals(truth, turned, states) == pytest.approx(plain, abs=1e-6)
    assert residuals(truth, windows, back) == pytest.approx(plain, abs=1e-6)


def test_each_flight_is_predicted_from_its_own_commands(perfect):
    """Two flights with different commands in one set of windows: each is predicted as alone."""
    truth, _, _ = perfect
    rng = np.random.default_rng(9)
    flown = fly_figure_eights([truth, truth], 10.0, rng)
    parts = [prepare(measured(flown, rng, i, (0.0, 0.0)), SIGMA).flights[0] for i in (0, 1)]
    assert np.abs(parts[0].commands - parts[1].commands).max() > 0.1
    together = cut_windows(parts, truth)
    n = truth.n_states
    alone = [
        residuals(truth, w, w.initial_guess[:, :n])
        for w in (cut_windows([p], truth) for p in parts)
    ]
    assert np.array_equal(
        residuals(truth, together, together.initial_guess[:, :n]), np.concatenate(alone)
    )


def test_delay_is_a_shift_of_the_commands(noisy):
    """By definition: commands logged one row later and 50 ms less delay are the same flight."""
    truth, windows, initial_states = noisy
    first = windows.flights[0]
    commands = np.concatenate([first.commands[:1], first.commands[:-1]])
    late = replace(first, commands=commands)
    slow = truth.with_values({"delay": 0.07})
    quick = truth.with_values({"delay": 0.02})
    shifted = replace(windows, flights=(late,))
    assert residuals(quick, shifted, initial_states) == pytest.approx(
        residuals(slow, windows, initial_states), abs=1e-6
    )
    assert (
        np.abs(
            residuals(quick, windows, initial_states) - residuals(slow, windows, initial_states)
        ).max()
        > 0.5
    )


def test_a_noise_filter_mixes_rows_of_one_channel(perfect):
    """By definition: each channel's residuals times its matrix; here differences of neighbouring
    rows of the height.
    """
    truth, windows, states = perfect
    filters = np.tile(np.eye(40), (6, 1, 1))
    filters[2, 1:, :-1] -= np.eye(39)
    plain = pose_residuals(residuals(truth, windows, states + 0.01), windows)
    filtered = pose_residuals(
        residuals(truth, replace(windows, whitening=filters), states + 0.01), windows
    )
    expected = plain.copy()
    expected[:, 1:, 2] = np.diff(plain[..., 2], axis=1)
    assert filtered == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert np.abs(filtered - plain).max() > 0.05


def test_a_diverging_flight_has_infinite_residuals():
    """Overflow gives an infinite cost, never nan, so that a fit rejects the step."""
    windows = cut_windows([flight(10.0)], paper_model())
    wild = paper_model().with_values({"cD_0": -1e6})
    residual = pose_residuals(residuals(wild, windows, windows.initial_guess[:, :9]), windows)
    assert np.isinf(residual).any() and not np.isnan(residual).any()


def test_initial_states_have_a_weak_prior(noisy):
    """The last residuals are the distance from the local estimate: 1 m, 0.3 rad, 3 m/s and 3 rad/s
    are one sigma.
    """
    truth, windows, _ = noisy
    away = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0])
    assert residuals(truth, windows, windows.initial_guess)[:, 240:] == pytest.approx(
        np.zeros((len(windows), 12)), abs=1e-12
    )
    assert residuals(truth, windows, windows.initial_guess + away)[:, 240:] == pytest.approx(
        np.ones((len(windows), 12))
    )


# Derivatives
# -----------


def central(function, x, steps):
    """(..., n) derivative of a function of (n,) by central differences."""
    columns = []
    for i, step in enumerate(steps):
        up, down = x.copy(), x.copy()
        up[i] += step
        down[i] -= step
        columns.append((function(up) - function(down)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def test_derivatives_to_all_parameters_equal_central_differences(noisy):
    """Central differences of `residuals`, one parameter at a time. Forward differences of 1e-5 are
    right to 1e-3 of a column's length; delay and lag, whose step of 1 ms leaves the curvature,
    to 2 %.
    """
    truth, windows, initial_states = noisy
    free = range(len(truth.names))
    _, found, _ = jacobian(truth, windows, initial_states, free)
    expected = central(
        lambda v: residuals(truth.with_vector(v), windows, initial_states),
        truth.vector,
        np.full(29, 1e-4),
    )
    size = np.linalg.norm(expected, axis=(0, 1))
    off = np.linalg.norm(found - expected, axis=(0, 1)) / size
    allowed = [0.02 if name in ("delay", "lag") else 1e-3 for name in truth.names]
    assert dict(zip(truth.names, off < allowed, strict=True)) == dict.fromkeys(truth.names, True)
    assert size.min() > 1.0  # none is zero


def test_derivatives_to_start_states_equal_central_differences(noisy):
    """The same for the twelve initial states; each affects only its own window."""
    truth, windows, initial_states = noisy
    _, _, found = jacobian(truth, windows, initial_states, ())
    expected = central(
        lambda move: residuals(truth, windows, initial_states + move),
        np.zeros(12),
        np.full(12, 1e-5),
    )
    off = np.linalg.norm(found - expected, axis=(0, 1)) / np.linalg.norm(expected, axis=(0, 1))
    assert off.max() < 1e-3


@pytest.mark.parametrize(
    ("form", "effects"),
    [
        ("rates", ("wind", "control_delay")),
        ("rates", ("fan_jet", "camera_tilt")),
        ("rates", ("ground_effect", "roll moment with angle of attack times aileron")),
        ("paper", ("wind", "trim_bias")),
    ],
)
def test_derivatives_equal_central_differences_with_effects(form, effects):
    """Central differences of `residuals`, as above, to 1e-3 of a column's length (what changes the
    commands, whose step is 1e-3, to 2 %): uniform wind and a jet that depends on the place, a delay
    added to the model's, a turned camera, a product of flow and stick as of a sparse term; every
    amplitude away from zero.
    """
    rng = np.random.default_rng(6)
    model = drawn(FORMS[form](), rng)
    for effect in CATALOGUE:
        if effect.name in effects and effect.amplitudes[0].name not in model.values:
            model = model.with_effect(effect)
            model = model.with_values({p.name: 0.3 * p.start for p in effect.amplitudes})
    if effects[1].startswith("roll moment"):
        model = model.with_effect(PRODUCT).with_values({"product": 0.4})
    table = measured(fly_figure_eights([model], 6.0, rng), rng)
    windows = cut_windows(prepare(table, SIGMA).flights, model)
    initial_states = windows.initial_guess[:, : model.n_states]
    free = [i for i, p in enumerate(model.parameters) if p.high > p.low]
    _, found, of_states = jacobian(model, windows, initial_states, free)

    def moved(change):
        vector = model.vector
        vector[free] += change[: len(free)]
        states = initial_states + change[len(free) :]
        return residuals(model.with_vector(vector), windows, states)

    count = len(free) + model.n_states
    expected = central(moved, np.zeros(count), np.full(count, 2e-5))
    size = np.linalg.norm(expected, axis=(0, 1))
    off = np.linalg.norm(np.concatenate([found, of_states], axis=2) - expected, axis=(0, 1)) / size
    names = [model.names[i] for i in free] + [f"state {i}" for i in range(model.n_states)]
    mapped = model.actuator_parameter_names
    allowed = [0.02 if name in mapped else 1e-3 for name in names]
    assert dict(zip(names, off < allowed, strict=True)) == dict.fromkeys(names, True)
    assert size.min() > 0.1  # none is zero


def test_a_subset_of_parameters_gives_the_same_columns(noisy):
    """Which parameters move is a choice of columns, nothing else; the residual is that of
    `residuals`.
    """
    truth, windows, initial_states = noisy
    residual, everything, initial_state_jacobian = jacobian(
        truth, windows, initial_states, range(29)
    )
    some = [3, 28, 0]  # with lag, whose column has actuator positions of its own
    _, columns, same = jacobian(truth, windows, initial_states, some)
    assert columns == pytest.approx(everything[..., some], rel=1e-9, abs=1e-6)
    assert same == pytest.approx(initial_state_jacobian, rel=1e-9, abs=1e-6)
    assert residual == pytest.approx(residuals(truth, windows, initial_states), rel=1e-9, abs=1e-9)


def test_changes_are_differences_of_residuals(noisy):
    """`residuals` of each set of values one at a time, less those of the present ones: forces,
    moments and both actuator parameters, alone and together. Initial states stay, so their prior
    does not change.
    """
    truth, windows, initial_states = noisy
    sets = (
        {"cL_alpha": 1.6, "N_dr": 0.3},
        {"delay": 0.06},
        {},
        {"lag": 0.08, "delay": 0.05, "kT": 8.0},
        {"delay": 0.06},
    )
    moved = [truth.with_values(values) for values in sets]
    found = finite_differences(
        truth, windows, initial_states, np.column_stack([model.vector for model in moved])
    )
    expected = [
        residuals(model, windows, initial_states) - residuals(truth, windows, initial_states)
        for model in moved
    ]
    assert found.shape == (5, len(windows), 240 + 12)
    assert found == pytest.approx(np.stack(expected), rel=1e-9, abs=1e-9)
    assert np.abs(found).max(axis=(1, 2))[[0, 1, 3, 4]].min() > 1.0 and not found[2].any()
    assert np.array_equal(found[1], found[4])


def test_sets_have_the_residuals_of_each_alone(noisy):
    """Parameters and initial states of their own, one with another delay, one a whole turn of yaw
    on, one whose flight diverges.
    """
    truth, windows, initial_states = noisy
    rng = np.random.default_rng(4)
    moved = [
        truth.with_values(values)
        for values in ({"cL_alpha": 1.6}, {"delay": 0.06}, {}, {"cD_0": -1e6})
    ]
    states = initial_states + 0.1 * rng.normal(size=(len(moved), *initial_states.shape))
    states[2, :, 4] += 2.0 * np.pi
    found = residual_sets(
        truth, windows, states, np.column_stack([model.vector for model in moved])
    )
    expected = [residuals(m, windows, s) for m, s in zip(moved, states, strict=True)]
    assert found[:3] == pytest.approx(np.stack(expected[:3]), rel=1e-9, abs=1e-9)
    assert np.isposinf(found[3]).any() and not np.isnan(found[3]).any()


def test_a_diverging_change_is_infinite_for_itself_alone():
    """Infinite cost, never nan; the set beside it equals its own result alone."""
    windows = cut_windows([flight(10.0)], paper_model())
    base, initial_states = paper_model(), windows.initial_guess[:, :9]
    sets = [base.with_values(values).vector for values in ({"cD_0": -1e6}, {"cL_alpha": 1.6})]
    found = finite_differences(base, windows, initial_states, np.column_stack(sets))
    assert np.isposinf(found[0]).any() and not np.isnan(found[0]).any()
    assert np.array_equal(
        found[1:], finite_differences(base, windows, initial_states, sets[1][:, None])
    )


def test_a_window_that_a_change_makes_diverge_shows_nothing(monkeypatch):
    """Zero derivatives to all parameters there, though the flight itself is finite; those of the
    other windows and all others are unchanged. The change of the first parameter diverges in window
    1: predicted poses are replaced by infinities.
    """
    windows, model = cut_windows([flight(10.0)], paper_model()), paper_model()
    initial_states, free = windows.initial_guess[:, :9], (0, 1)
    plain = jacobian(model, windows, initial_states, free)

    def diverging(*arguments):
        poses = predict(*arguments)
        poses[-1, 0, 1, 1] = np.inf  # last row, x, column of the first parameter, window
        return poses

    monkeypatch.setattr("falconwing_kit.sysid.shooting.predict", diverging)
    residual, of_parameters, of_states = jacobian(model, windows, initial_states, free)
    others = np.arange(len(windows)) != 1
    assert np.array_equal(residual, plain[0]) and np.array_equal(of_states, plain[2])
    assert np.abs(plain[1][1]).max() > 0.0 and not of_parameters[1].any()
    assert np.array_equal(of_parameters[others], plain[1][others])


def test_a_tilted_camera_sees_other_angles(noisy):
    """By hand, banked by 60 deg with the nose level: a camera turned up by 0.02 rad adds 0.02 cos
    60 of pitch and 0.02 sin 60 of yaw; one turned about the nose adds roll.
    """
    truth, windows, _ = noisy
    tilt = next(effect for effect in CATALOGUE if effect.measurement_map)
    plain = truth.with_effect(tilt).with_values({"tilt_pitch": 0.0, "tilt_roll": 0.0})
    initial_states = windows.initial_guess.copy()
    initial_states[:, 3], initial_states[:, 5] = 0.0, np.pi / 3.0
    straight = fly_windows(plain, windows, initial_states)

    def seen(values):
        return (fly_windows(plain.with_values(values), windows, initial_states) - straight)[:, 0]

    up, over = (
        seen({"tilt_pitch": 0.02, "tilt_roll": 0.0}),
        seen({"tilt_pitch": 0.0, "tilt_roll": 0.03}),
    )
    expected = np.array([0.0, 0.0, 0.0, 0.0, 0.01, 0.02 * np.sin(np.pi / 3.0)])
    assert up == pytest.approx(np.broadcast_to(expected, up.shape), abs=1e-12)
    assert over == pytest.approx(
        np.broadcast_to([0.0, 0.0, 0.0, 0.03, 0.0, 0.0], over.shape), abs=1e-12
    )
    assert np.array_equal(straight, fly_windows(truth, windows, initial_states))


def test_the_paper_form_has_derivatives_too():
    """Nine start states, and a quasi-steady parameter that its flight excites."""
    rng = np.random.default_rng(6)
    truth = drawn(paper_model(), rng)
    windows = cut_windows(
        prepare(measured(fly_figure_eights([truth], 10.0, rng), rng), SIGMA).flights, truth
    )
    initial_states = windows.initial_guess[:, :9]
    column = truth.names.index("L_da")
    _, found, initial_state_jacobian = jacobian(truth, windows, initial_states, [column])
    step = np.zeros(len(truth.names))
    step[column] = 1e-4
    up, down = (
        residuals(truth.with_vector(truth.vector + s * step), windows, initial_states)
        for s in (1, -1)
    )
    assert found[..., 0] == pytest.approx((up - down) / 2e-4, abs=1e-3 * np.abs(found).max())
    assert initial_state_jacobian.shape == (len(windows), 240 + 9, 9)
