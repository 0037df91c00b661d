"""Loops: stability by an independent model, delay by brute force, Riccati by SciPy, coordinated
turns.
"""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from falconwing_kit.aircraft.model import paper_model, rates_model
from falconwing_kit.aircraft.trim import linearise, trim
from falconwing_kit.control.loops import (
    LATERAL,
    LONGITUDINAL,
    TABLE_BANKS,
    Autopilot,
    Reference,
    TrimTable,
    augment_delay,
    course_axes,
    design_loop,
)
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.core.messages import COMMAND_NAMES, CONTROL_PERIOD_S, STATE_NAMES, State

AXES = {"lateral": LATERAL, "longitudinal": LONGITUDINAL}
NOTHING_SENT = np.zeros((30, 4))


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_closed_loop_poles_lie_inside_the_unit_circle(axis):
    """Discrete stability; the slowest pole, the integral's, falls to 1/e within eight seconds."""
    loop = design_loop(rates_model(), axis)
    assert np.abs(loop.poles).max() < np.exp(-CONTROL_PERIOD_S / 8.0)


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
@pytest.mark.parametrize("delay", [0.0, 0.05, 0.15, 0.5])
def test_the_way_back_without_the_integrals_ends(axis, delay):
    """It is what landings leave out of their integrals: stable, though only the whole loop has to
    be [Astrom & Murray, sec. 7.4].
    """
    A = design_loop(rates_model(), axis, delay=delay).A_returning
    assert np.abs(np.linalg.eigvals(A)).max() < 0.99


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
@pytest.mark.parametrize("delay", [0.03, 0.05, 0.1])
def test_loop_is_stable_with_a_real_servo_and_link(axis, delay):
    """Independent model: 10 ms steps, the link's delay as a queue, a first-order servo.

    Designed for 50 ms and flown with 30, 50 and 100 ms.
    """
    model, fine = rates_model(), 0.01
    loop = design_loop(model, axis)
    A, B = linearise(model, trim(model, 7.0))
    rows = [STATE_NAMES.index(name) for name in axis.states]
    columns = [COMMAND_NAMES.index(name) for name in axis.control_inputs]
    A, B = A[np.ix_(rows, rows)], B[np.ix_(rows, columns)]
    n, m, lag = len(A), 2, model.values["lag"]
    servo = np.block(
        [[A, B, np.zeros((n, m))], [np.zeros((m, n)), -np.eye(m) / lag, np.eye(m) / lag]]
    )
    step = expm(np.vstack([servo, np.zeros((m, n + 2 * m))]) * fine)[: n + m]
    wait = round((delay + model.values["delay"]) / fine)
    picked = [list(axis.states).index(name) for name in axis.integrals]

    rng = np.random.default_rng(1)
    x, sent, total = (
        np.concatenate([0.1 * rng.normal(size=n), np.zeros(m)]),
        [np.zeros(m)] * 20,
        np.zeros(len(picked)),
    )
    start = np.linalg.norm(x)
    for k in range(round(20.0 / fine)):
        if k % round(CONTROL_PERIOD_S / fine) == 0:
            past = [sent[-1 - j * round(CONTROL_PERIOD_S / fine)] for j in range(loop.delay_steps)]
            u = -loop.gain @ np.concatenate([x[:n], *past, total])
            total = total + CONTROL_PERIOD_S * x[picked]
        sent.append(u)
        x = step @ np.concatenate([x, sent[-1 - wait]])
    assert np.linalg.norm(x) < 0.1 * start  # an unstable loop is out of all bounds after 20 s


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_gain_solves_the_riccati_equation(axis):
    """K = (R + B'PB)^-1 B'PA with P of SciPy's solver."""
    loop = design_loop(rates_model(), axis)
    late = loop.delay_steps * len(axis.control_inputs)
    Q = np.diag(
        [s**-2 for s in axis.states.values()]
        + [0.0] * late
        + [s**-2 for s in axis.integrals.values()]
    )
    R = np.diag([s**-2 for s in axis.control_inputs.values()])
    P = solve_discrete_are(loop.A, loop.B, Q, R)
    expected = np.linalg.solve(R + loop.B.T @ P @ loop.B, loop.B.T @ P @ loop.A)
    assert loop.gain == pytest.approx(expected, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.05, 0.07, 0.1, 0.13])
def test_sampled_delay_equals_brute_force(delay):
    """A damped double integrator, random inputs, exact 10 ms steps, the delay as a queue."""
    A, B = np.array([[0.0, 1.0], [0.0, -2.0]]), np.array([[0.0], [3.0]])
    sampled_A, sampled_B = augment_delay(A, B, delay)
    step = expm(np.block([[A, B], [np.zeros((1, 3))]]) * 0.01)
    control_inputs = np.random.default_rng(2).normal(size=40)
    acting = np.concatenate([np.zeros(round(delay / 0.01)), np.repeat(control_inputs, 5)])
    x, z = np.zeros(2), np.zeros(len(sampled_A))
    for k, u in enumerate(control_inputs):
        z = sampled_A @ z + sampled_B @ [u]
        for j in range(5):
            x = (step @ np.append(x, acting[5 * k + j]))[:2]
        assert z[:2] == pytest.approx(x, abs=1e-9)  # rounding of 40 products


def test_a_long_delay_lowers_the_position_gain_and_stays_stable():
    """Twice the delay that the sizes are for: the position's size four times as large, by hand.

    The cost weights size^-2; a loop with 0.3 s of delay is still stable. The kit's is unchanged.
    """
    slow = rates_model().with_values({"delay": 0.14})  # with lag and link 0.03 + 0.05 s
    loop = design_loop(slow, LATERAL)
    assert loop.axis.states["py"] == pytest.approx(4.0 * LATERAL.states["py"])
    assert loop.axis.integrals["py"] == pytest.approx(4.0 * LATERAL.integrals["py"])
    assert loop.axis.states["roll"] == LATERAL.states["roll"]
    for axis in AXES.values():
        assert design_loop(rates_model(), axis).axis == axis
        slowest = design_loop(rates_model().with_values({"delay": 0.22}), axis)
        assert np.abs(slowest.poles).max() < 1.0


def test_feedforward_turns_are_coordinated():
    """d(yaw)/dt = g tan(bank)

    V; body rates p = -w sin(pitch), q and r by the bank.

    Within 1 %: the law neglects cos(pitch), 0.996 at 5 deg.
    """
    table = TrimTable(rates_model())
    for bank in TABLE_BANKS[TABLE_BANKS != 0.0]:
        _, (pitch, _, p, q, r) = table.at(7.0, 0.0, bank)
        turn = (q * np.sin(bank) + r * np.cos(bank)) / np.cos(pitch)
        assert turn == pytest.approx(GRAVITY * np.tan(bank) / 7.0, rel=0.01)
        assert p == pytest.approx(-turn * np.sin(pitch), abs=1e-6)


def test_table_gives_the_trim_itself_at_its_knots():
    """Interpolation is exact at the knots."""
    steady = trim(rates_model(), 7.0, 0.0, float(TABLE_BANKS[-1]))
    control_inputs, attitude = TrimTable(rates_model()).at(7.0, 0.0, float(TABLE_BANKS[-1]))
    assert control_inputs == pytest.approx(steady.command, abs=1e-9)
    assert attitude[0] == pytest.approx(steady.state[3], abs=1e-9)


@pytest.mark.parametrize(
    ("moved", "stick", "sign"),
    [
        (("py", 0.5), "aileron", 1), (("roll", 0.2), "aileron", -1), (("p", 1.0), "aileron", -1),
        (("pz", 0.3), "elevator", -1), (("pitch", 0.1), "elevator", -1),
        (("vx", 1.0), "throttle", -1),
    ],
)  # fmt: skip
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_control_inputs_oppose_a_deviation(moved, stick, sign, yaw):
    """By hand: left of the path roll right, right of it roll left, too high nose down, too fast
    less power.
    """
    pilot = Autopilot(rates_model())
    steady = trim(rates_model(), 7.0)
    ahead, left = course_axes(yaw)
    x = steady.state.copy()
    x[4], x[6:9] = yaw, x[6] * ahead
    before = pilot.command(
        State.from_vector(x), Reference(x[:3].copy(), yaw, 0.0, 7.0, 0.0), NOTHING_SENT
    )
    assert before.vector == pytest.approx(steady.command, abs=1e-6)
    reference = Reference(x[:3].copy(), yaw, 0.0, 7.0, 0.0)
    name, size = moved
    if name in ("py", "vx"):
        first, axis = (0, left) if name == "py" else (6, ahead)
        x[first : first + 3] += size * axis
    else:
        x[STATE_NAMES.index(name)] += size
    after = Autopilot(rates_model()).command(State.from_vector(x), reference, NOTHING_SENT)
    assert sign * (getattr(after, stick) - getattr(before, stick)) > 0.02


def test_what_cannot_be_stabilised_is_refused():
    """No body rates, no thrust, no elevator: each message names the reason."""
    with pytest.raises(InputError, match="12-state model"):
        Autopilot(paper_model())
    with pytest.raises(InputError, match="throttle"):
        Autopilot(rates_model().with_values({"kT": 0.5}))
    with pytest.raises(InputError, match="trim"):
        Autopilot(rates_model().with_values({"M_de": 0.0, "M_0": 0.9}))
    with pytest.raises(InputError, match="delay"):
        Autopilot(rates_model(), delay=-1.0)
