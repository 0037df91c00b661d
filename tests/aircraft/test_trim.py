"""Trim and linear models: steady flights stay steady, laws of turning, scipy and python-control as
judges.
"""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import approx_fprime

from falconwing_kit.aircraft.integrate import SUBSTEPS, roll_out
from falconwing_kit.aircraft.model import (
    FORMS,
    add_uniform_wind,
    paper_model,
    rates_model,
    state_rates,
)
from falconwing_kit.aircraft.terms import Parameter, Term, WindTerm
from falconwing_kit.aircraft.trim import discrete_step, linearise, modes, to_nlsys, trim
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import rotation_world_body
from tests.jsbsim_aircraft import JsbsimAircraft, fly_jsbsim, playback

V = 7.0


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def lopsided(form):
    """An aircraft that needs every stick and some sideslip to fly straight."""
    model = FORMS[form]()
    return model.with_values({"L_0": 0.01, "N_0": -0.01, "cL_de": 0.05, "cY_dr": 0.1})


def held(model, steady, seconds):
    """The flight with the sticks held at the trim, 10 ms steps."""
    steps = round(seconds / 0.01)
    return np.arange(steps + 1) * 0.01, roll_out(
        model, steady.state, np.tile(steady.command, (steps, 1)), 0.01
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("make", [lambda form: FORMS[form](), lopsided])
def test_straight_flight_stays_straight(form, make):
    """Newton: in balance nothing changes but the place, by V t at constant height. A spiral grows
    1e-15 by e^1.
    """
    steady = trim(make(form), V)
    t, flown = held(make(form), steady, 5.0)
    assert np.abs(flown[:, 3:] - steady.state[3:]).max() < 1e-9
    assert np.hypot(*flown[:, :2].T) == pytest.approx(V * t, abs=1e-8)
    assert flown[:, 2] == pytest.approx(np.full(len(t), 2.0), abs=1e-8)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("bank_deg", "climb_deg"), [(30.0, 0.0), (-25.0, 5.0), (20.0, -5.0), (0.0, 9.0)]
)
def test_a_turn_is_a_helix(form, bank_deg, climb_deg):
    """Kinematics: speed, bank and pitch stay; heading turns by turn_rate t; height changes by V
    sin(climb) t.

    The level path is a circle of radius V cos(climb) / turn_rate.
    """
    model = lopsided(form)
    steady = trim(model, V, np.radians(climb_deg), np.radians(bank_deg))
    t, flown = held(model, steady, 6.0)
    assert flown[:, 5] == pytest.approx(np.full(len(t), np.radians(bank_deg)), abs=1e-6)
    assert flown[:, 4] == pytest.approx(steady.turn_rate * t, abs=1e-6)
    assert flown[:, 2] == pytest.approx(2.0 + V * np.sin(np.radians(climb_deg)) * t, abs=1e-6)
    assert np.linalg.norm(flown[:, 6:9], axis=1) == pytest.approx(np.full(len(t), V), abs=1e-6)
    if bank_deg:
        assert np.sign(steady.turn_rate) == np.sign(bank_deg)
        radius = V * np.cos(np.radians(climb_deg)) / steady.turn_rate
        # A turn to the right has its centre on the right, which is against world y.
        across = np.array([flown[0, 7], -flown[0, 6]]) / np.hypot(*flown[0, 6:8])
        assert np.hypot(*(flown[:, :2] - radius * across).T) == pytest.approx(
            np.full(len(t), abs(radius)), abs=1e-5
        )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("bank_deg", [-40.0, 10.0, 35.0])
def test_a_level_turn_goes_by_g_tan_bank(form, bank_deg):
    """Balance of forces in a plane at right angles to the nose, where nothing pushes sideways.

    Along lift: g cos(pitch) + a sin(pitch) sin(drift) = f cos(bank), across: a cos(drift) = f
        sin(bank), with
    a = V turn_rate and drift the angle from nose to path. To first order that is the g tan(bank) /
    V of every book.
    """
    model, bank = lopsided(form), np.radians(bank_deg)
    steady = trim(model, V, 0.0, bank)
    pitch, drift = steady.state[3], -np.arctan2(steady.state[7], steady.state[6])
    rate = (
        9.8
        * np.tan(bank)
        * np.cos(pitch)
        / (V * (np.cos(drift) - np.sin(drift) * np.sin(pitch) * np.tan(bank)))
    )
    assert steady.turn_rate == pytest.approx(rate, rel=1e-9)
    assert steady.turn_rate == pytest.approx(9.8 * np.tan(bank) / V, rel=0.03)


@pytest.mark.parametrize("form", FORMS)
def test_the_ball_stays_in_the_middle(form):
    """Coordinated: a pendulum in the aircraft, moved by velocity's change and gravity, hangs along
    its belly.
    """
    model = lopsided(form)
    steady = trim(model, V, 0.05, 0.5)
    _, flown = held(model, steady, 0.02)
    acceleration = (flown[1, 6:9] - flown[0, 6:9]) / 0.01
    felt = rotation_world_body(flown[0, 5], flown[0, 3], flown[0, 4]).T @ (
        acceleration + np.array([0.0, 0.0, 9.8])
    )
    assert abs(felt[1]) < 0.05  # of 11 m/s^2; 10 ms of turning
    assert felt[2] < -9.0


@pytest.mark.parametrize("climb", [-0.08, 0.0, 0.3])
def test_thrust_pays_for_drag_and_climb(climb):
    """Law of energy: thrust along the path = drag + g sin(climb); lift does no work. Drag written
    out here.
    """
    steady, K = trim(rates_model(), V, climb), rates_model().K
    lift, airspeed = K.cL_0 + K.cL_alpha * steady.alpha, np.sqrt(V**2 + 0.01)
    drag = airspeed * V * (K.cD_0 + K.cD_induced * lift**2)
    thrust = (K.kT - K.kTV * airspeed) * steady.command[0]
    assert thrust * np.cos(steady.alpha) == pytest.approx(drag + 9.8 * np.sin(climb), abs=1e-7)


@pytest.mark.parametrize("form", FORMS)
def test_left_and_right_trims_are_mirror_images(form):
    """A symmetric aircraft in a mirror."""
    right, left = (trim(FORMS[form](), V, 0.05, bank) for bank in (0.4, -0.4))
    assert left.command == pytest.approx(right.command * [1, -1, 1, -1], abs=1e-9)
    assert (left.turn_rate, left.alpha, left.beta) == pytest.approx(
        (-right.turn_rate, right.alpha, -right.beta), abs=1e-9
    )


@pytest.mark.parametrize("form", FORMS)
def test_wind_shifts_the_velocity_and_nothing_else(form):
    """Galilean invariance: a turn in a uniform wind is still a steady turn in the air."""
    still, model = trim(FORMS[form](), V, 0.0, 0.4), add_uniform_wind(FORMS[form](), 1.0, -0.5)
    windy = trim(model, V, 0.0, 0.4)
    assert windy.command == pytest.approx(still.command, abs=1e-9)
    assert windy.state[6:9] - still.state[6:9] == pytest.approx([1.0, -0.5, 0.0], abs=1e-9)
    _, flown = held(model, windy, 3.0)
    assert np.linalg.norm(flown[:, 6:9] - [1.0, -0.5, 0.0], axis=1) == pytest.approx(
        np.full(301, V), abs=1e-6
    )


def test_terms_are_taken_at_the_height():
    """A lift that grows with height needs less angle of attack: 0.01 of 0.2 per metre."""
    buoyant = Term(
        "buoyant",
        (Parameter("rise", 1.0, 0.0, 5.0, "1/s^2", ""),),
        lambda air, K: (0, 0, -K.rise * air.height, 0, 0, 0),
    )
    model = rates_model().with_terms(buoyant)
    assert trim(model, V, height=1.0).alpha > trim(model, V, height=2.0).alpha + 0.01


@pytest.mark.parametrize("bank_deg", [0.0, 30.0])
def test_the_trim_holds_in_jsbsim(bank_deg):
    """An independent aircraft started at the kit's trim flies on for 2 s: height within 2 cm, bank
    within 1 deg.
    """
    aircraft = JsbsimAircraft()
    steady = trim(aircraft.kit_model(), V, 0.0, np.radians(bank_deg), height=2.2)
    t, flown, _ = fly_jsbsim(aircraft, playback(steady.command[None]), 2.0, start=steady.state)
    assert np.abs(flown[:, 2] - 2.2).max() < 0.02
    assert np.abs(flown[:, 5] - np.radians(bank_deg)).max() < np.radians(1.0)
    assert flown[:, 4] == pytest.approx(steady.turn_rate * t, abs=np.radians(1.0))


# Saying no
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"airspeed": 15.0}, r"15 m/s.*needs throttle 2\.\d+, which ends at 1"),
        (
            {"airspeed": V, "climb_angle": 0.8},
            r"climb 45\.8 deg.*needs throttle 1\.\d+, which ends at 1",
        ),
        ({"airspeed": V, "climb_angle": -0.2}, r"needs throttle -0\.\d+, which ends at 0"),
        ({"airspeed": V, "bank": 1.25}, r"bank 71\.6 deg.*needs elevator \d.*which ends at 1"),
        ({"airspeed": 2.5}, "angle of attack at its limit of 34 deg"),
        ({"airspeed": 0.0}, "airspeed: expected a finite number"),
        ({"airspeed": float("nan")}, "airspeed: expected a finite number"),
        ({"airspeed": V, "bank": 1.6}, "bank: expected a finite number"),
        ({"airspeed": V, "climb_angle": 1.6}, "climb_angle: expected a finite number"),
    ],
)
def test_what_cannot_be_flown_is_said_with_the_limit(form, wanted, words):
    """Throttle has 0..1, the other sticks -1..1, wings no lift beyond all angles."""
    with pytest.raises(InputError, match=words):
        trim(FORMS[form](), **wanted)


def test_an_aircraft_without_ailerons_is_said():
    """No stick balances a rolling moment, so some acceleration stays."""
    with pytest.raises(InputError, match=r"needs rudder|no balance"):
        trim(rates_model().with_values({"L_da": 0.0, "L_0": 0.2}), V)


def test_modes_are_those_of_the_form_with_rates():
    """Nine states have no rates to swing with."""
    model = paper_model()
    with pytest.raises(InputError, match=r"12-state model.*\(12, 12\), got \(9, 9\)"):
        modes(linearise(model, trim(model, V))[0])


def test_a_trim_of_the_other_form_is_refused():
    """Nine states are not twelve."""
    with pytest.raises(InputError, match=r"trim.state: expected shape \(12\), got \(9\)"):
        linearise(rates_model(), trim(paper_model(), V))


def test_a_step_of_zero_is_refused():
    """It would divide by it."""
    with pytest.raises(InputError, match="dt: expected a finite number"):
        to_nlsys(rates_model(), 0.0)


# Linear models
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("bank", [0.0, 0.4])
def test_slopes_are_those_of_scipy(form, bank):
    """scipy's approx_fprime, one-sided with 1.5e-8: right to 1e-6 of slopes up to 100."""
    model = lopsided(form)
    steady = trim(model, V, 0.0, bank)
    A, B = linearise(model, steady)
    rates = state_rates(model.form, model.terms, ())
    by_state = approx_fprime(
        steady.state, lambda x: np.array(rates(0.0, x, steady.command, model.K), float)
    )
    by_stick = approx_fprime(
        steady.command, lambda u: np.array(rates(0.0, steady.state, u, model.K), float)
    )
    assert np.abs(A - by_state).max() < 2e-5
    assert np.abs(B - by_stick).max() < 2e-5
    assert np.abs(A).max() > 1.0


@pytest.mark.parametrize("form", FORMS)
def test_the_discrete_model_is_the_exponential_of_the_continuous_one(form):
    """Theory of linear systems: expm([[A, B], [0, 0]] dt). Runge-Kutta leaves (18 * 0.05)^5 / 120
    of e^-0.9: 1 %.
    """
    model = lopsided(form)
    steady = trim(model, V)
    A, B = linearise(model, steady)
    n = model.n_states
    block = expm(0.05 * np.block([[A, B], [np.zeros((4, n + 4))]]))
    A_discrete, B_discrete = linearise(model, steady, dt=0.05)
    assert np.abs(A_discrete - block[:n, :n]).max() < 1e-2 * np.abs(block[:n, :n]).max()
    assert np.abs(B_discrete - block[:n, n:]).max() < 1e-2 * np.abs(block[:n, n:]).max()


@pytest.mark.parametrize("form", FORMS)
def test_small_deviations_follow_the_eigenvalues(form):
    """Theory: from the trim plus 1e-5 times an eigenvector v, the flight deviates by Re(1e-5 v
    exp(lambda t)).

    Second-order terms are 1e-5 of that, Runge-Kutta at 10 ms less.
    """
    model = FORMS[form]()
    steady = trim(model, V)
    values, vectors = np.linalg.eig(linearise(model, steady)[0])
    still = held(model, steady, 0.5)[1]
    for value, vector in zip(values, vectors.T, strict=True):
        t, flown = held(
            model, type(steady)(**{**vars(steady), "state": steady.state + 1e-5 * vector.real}), 0.5
        )
        want = 1e-5 * (vector * np.exp(value * t[:, None])).real
        assert np.abs(flown - still - want).max() < 2e-3 * 1e-5


def test_the_modes_have_the_frequencies_of_textbook_formulas():
    """Roll: -1 / (V L_p). Short period: V sqrt(-M_alpha - M_q cL_alpha). Both within 3 %: weak
    couplings are left out.

    [Beard & McLain, sec. 5.6; lift and pitch damping per unit mass and inertia]
    """
    model = rates_model()
    found = {mode.name: mode for mode in modes(linearise(model, trim(model, V))[0])}
    K = model.K
    assert set(found) == {"short period", "phugoid", "Dutch roll", "roll", "spiral"}
    assert found["roll"].time_constant == pytest.approx(-1.0 / (V * K.L_p), rel=0.03)
    assert found["short period"].natural_frequency == pytest.approx(
        V * np.sqrt(-K.M_alpha - K.M_q * K.cL_alpha), rel=0.03
    )
    assert found["Dutch roll"].natural_frequency == pytest.approx(
        V * np.sqrt(K.N_beta + K.N_r * K.cY_beta), rel=0.2
    )


def test_the_phugoid_trades_height_for_speed():
    """Lanchester: sqrt(2) g / V when it is slow beside the short period; an aircraft with stiff
    pitch and no drag.
    """
    model = rates_model().with_values(
        {
            "M_alpha": -15.0,
            "M_q": -0.3,
            "M_0": 0.0,
            "cL_0": 9.8 / 25.0**2,
            "cD_0": 0.002,
            "kTV": 0.0,
        }
    )
    fast = 25.0  # held by cL_0 alone, so that pitch and angle of attack are small
    found = {mode.name: mode for mode in modes(linearise(model, trim(model, fast))[0])}
    assert found["phugoid"].natural_frequency == pytest.approx(np.sqrt(2.0) * 9.8 / fast, rel=0.05)
    assert abs(found["phugoid"].damping) < 0.1


def test_a_mode_is_told_in_frequency_damping_and_time():
    """By hand: -3 +- 4i has frequency 5, damping 0.6, time constant 1/3; growing modes have
    negative ones.
    """
    A = np.zeros((12, 12))
    # pitch, q swing with -3 +- 4i; vx, vz with -1 +- 1i; roll, vy with 2 and -5; p, r with -7 +-
    # 1i; yaw stays.
    for rows, block in (
        ((3, 10), [[-3, 4], [-4, -3]]),
        ((6, 8), [[-1, 1], [-1, -1]]),
        ((9, 11), [[-7, 1], [-1, -7]]),
    ):
        A[np.ix_(rows, rows)] = block
    A[5, 5], A[7, 7] = 2.0, -5.0
    found = {mode.name: mode for mode in modes(A)}
    period = found["short period"]
    assert (period.natural_frequency, period.damping, period.time_constant) == pytest.approx(
        (5.0, 0.6, 1.0 / 3.0)
    )
    assert found["phugoid"].eigenvalue == pytest.approx(-1 + 1j)
    assert found["Dutch roll"].eigenvalue == pytest.approx(-7 + 1j)
    assert (found["roll"].time_constant, found["spiral"].time_constant) == pytest.approx(
        (0.2, -0.5)
    )


# python-control
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_python_control_flies_the_same_flight(form, rng):
    """Its own loop over our step equals our loop to rounding, time and wind included."""
    import control

    push = Term(
        "push",
        (Parameter("rise", 0.3, 0.0, 5.0, "m/s^3", ""),),
        lambda air, K: (K.rise * air.time, 0, 0, 0, 0, 0),
    )
    swell = WindTerm(
        "swell",
        (Parameter("swell", 0.2, 0.0, 5.0, "m/s^2", ""),),
        lambda px, py, h, t, K: (0, K.swell * t, 0),
    )
    model = lopsided(form).with_terms(push, swell)
    start = trim(model, V).state
    sticks = np.array([0.3, 0.0, 0.05, 0.0]) + rng.normal(0.0, 0.05, (60, 4))
    response = control.input_output_response(
        to_nlsys(model, 0.05), np.arange(60) * 0.05, sticks.T, start
    )
    substeps = SUBSTEPS[form]
    flown = roll_out(model, start, np.repeat(sticks[:-1], substeps, axis=0), 0.05 / substeps)[
        ::substeps
    ]
    assert np.abs(response.outputs.T - flown).max() < 1e-12
    assert np.abs(response.states.T - flown).max() < 1e-12


@pytest.mark.parametrize("form", FORMS)
def test_python_control_linearises_to_the_same_matrices(form):
    """control.linearize, one-sided differences of 1e-6: right to 1e-4."""
    import control

    model = lopsided(form)
    steady = trim(model, V)
    system = to_nlsys(model)
    theirs = control.linearize(system, steady.state, steady.command)
    A, B = linearise(model, steady, dt=0.05)
    assert np.abs(A - theirs.A).max() < 1e-4
    assert np.abs(B - theirs.B).max() < 1e-4
    assert (system.dt, system.input_labels[2], system.state_labels[5], system.output_labels[8]) == (
        0.05,
        "elevator",
        "roll",
        "vz",
    )


def test_the_stepper_moves_many_aircraft_at_once(rng):
    """The same arithmetic, column by column."""
    model = rates_model()
    x, sticks = (
        trim(model, V).state[:, None] + rng.normal(0.0, 0.1, (12, 5)),
        rng.uniform(0.0, 0.5, (4, 5)),
    )
    together = discrete_step(model)(0.0, x, sticks)
    for k in range(5):
        assert together[:, k] == pytest.approx(
            discrete_step(model)(0.0, x[:, k : k + 1], sticks[:, k : k + 1])[:, 0], abs=1e-14
        )
