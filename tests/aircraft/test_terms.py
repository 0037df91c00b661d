"""Terms: each force and moment against numbers worked by hand, signs that a pilot knows, and the
law of energy.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft import terms
from falconwing_kit.aircraft.model import FORMS, state_rates
from falconwing_kit.aircraft.terms import air_flow
from falconwing_kit.core.frames import GRAVITY


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def flow(
    u=7.0, v=0.0, w=0.0, rates=(0.0, 0.0, 0.0), throttle=0.0, aileron=0.0, elevator=0.0, rudder=0.0
):
    return air_flow((u, v, w), rates, (1.0, 2.0, 3.0), 4.0, (throttle, aileron, elevator, rudder))


def values(**K):
    return SimpleNamespace(**K)


def states_at_random(model, rng, count=200):
    """(n, count) states, (4, count) sticks of ordinary and of wild flight, airspeed 3 to 12 m/s."""
    x = (
        rng.uniform(-1.0, 1.0, (model.n_states, count))
        * np.array([20, 10, 3, 1.2, 3, 3, 7, 7, 7, 4, 4, 4])[: model.n_states, None]
    )
    return x, np.vstack([rng.uniform(0, 1, count), rng.uniform(-1, 1, (3, count))])


def test_angles_of_the_flow_by_hand():
    """Belly and nose equally into the wind: atan(1) = 45 deg; 3 m/s from the right of 5: asin(3/5)
    = 36.87 deg.

    The 0.1 m/s kept against division by zero changes the second by less than 1e-3.
    """
    assert flow(u=5.0, w=5.0).alpha == pytest.approx(np.pi / 4, abs=1e-12)
    assert flow(u=4.0, v=3.0).beta == pytest.approx(0.6435, abs=1e-3)
    assert flow(u=4.0, v=3.0).airspeed == pytest.approx(5.0, abs=1e-2)


def test_standing_still_gives_no_nan():
    """At no airspeed the angles are 0 by choice, not 0/0."""
    assert np.isfinite(flow(u=0.0)).all()


def test_the_flow_carries_motion_place_and_sticks():
    """By reading: what goes in comes out under its own name."""
    air = air_flow((7.0, 0.5, 0.2), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 7.0, (0.1, 0.2, 0.3, 0.4))
    assert (air.u, air.v, air.w, air.p, air.q, air.r) == (7.0, 0.5, 0.2, 1.0, 2.0, 3.0)
    assert (air.px, air.py, air.height, air.time) == (4.0, 5.0, 6.0, 7.0)
    assert (air.throttle, air.aileron, air.elevator, air.rudder) == (0.1, 0.2, 0.3, 0.4)


def test_lift_by_hand():
    """49.01 (0.1 + 2 * 0.1 * 0.5) = 9.802 up, at alpha 0 that is against belly z; 1e-3 for the 0.1
    m/s.
    """
    loads = terms.lift(flow(elevator=0.5), values(cL_0=0.1, cL_alpha=2.0, cL_de=0.2))
    assert loads == pytest.approx((0.0, 0.0, -9.802, 0.0, 0.0, 0.0), abs=2e-3)


def test_lift_grows_with_alpha_and_leans_forward():
    """u = 8, w = 6: V^2 = 100.01, alpha = atan(0.75) = 0.6435; turned by it, lift has 0.6 forward
    and 0.8 up.
    """
    x, y, z, *moments = terms.lift(flow(u=8.0, w=6.0), values(cL_0=0.0, cL_alpha=1.0, cL_de=0.0))
    assert (x, y, z) == pytest.approx((0.6 * 64.356, 0.0, -0.8 * 64.356), abs=1e-2)
    assert moments == [0.0, 0.0, 0.0]


def test_drag_by_hand():
    """u = 8, w = 6 m/s: D = 100.01 (0.02 + 0.5 * 0.6435^2) = 22.71 along the wind, which is 0.8
    nose and 0.6 belly.
    """
    loads = terms.drag(
        flow(u=8.0, w=6.0), values(cD_0=0.02, cD_induced=0.5, cD_beta=9.0, cL_0=0.0, cL_alpha=1.0)
    )
    assert loads[:3] == pytest.approx((-18.17, 0.0, -13.63), abs=0.02)
    assert loads[3:] == (0.0, 0.0, 0.0)


def test_sideslip_adds_drag():
    """u = 8, v = 6 m/s: beta = 0.6435, D = 100.01 * 0.3 * 0.4141 = 12.42; 0.8 along the nose, 0.6
    along the wing.
    """
    loads = terms.drag(
        flow(u=8.0, v=6.0), values(cD_0=0.0, cD_induced=0.0, cD_beta=0.3, cL_0=0.0, cL_alpha=1.0)
    )
    assert loads[:3] == pytest.approx((-9.94, -7.45, 0.0), abs=0.01)


def test_side_force_by_hand():
    """Wind on the right cheek pushes left, right rudder pushes right: 25.01 (0.2 * 0.5 - 0.4 *
    0.6435) = -3.936.
    """
    loads = terms.side_force(flow(u=4.0, v=3.0, rudder=0.5), values(cY_beta=-0.4, cY_dr=0.2))
    assert loads == pytest.approx((0.0, -3.936, 0.0, 0.0, 0.0, 0.0), abs=3e-3)


def test_thrust_by_hand():
    """Half throttle at 7 m/s: (9 - 0.5 * 7) / 2 = 2.75 m/s^2 forward."""
    loads = terms.thrust(flow(throttle=0.5), values(kT=9.0, kTV=0.5))
    assert loads == pytest.approx((2.75, 0.0, 0.0, 0.0, 0.0, 0.0), abs=1e-3)


def test_moments_by_hand():
    """At V = 7: roll 49.01 (.1 + .5 * .2) - 7 * 2 * .3 + 7 * .4 * .5; pitch and yaw likewise; 1e-2
    for the 0.1 m/s.
    """
    air = flow(rates=(0.3, 0.4, 0.5), aileron=0.2, elevator=0.3, rudder=-0.4)
    roll = terms.roll_moment(air, values(L_0=0.1, L_da=0.5, L_beta=-1.0, L_p=-2.0, L_r=0.4))
    pitch = terms.pitch_moment(air, values(M_0=0.1, M_de=0.5, M_alpha=-2.0, M_q=-1.5))
    yaw = terms.yaw_moment(air, values(N_0=0.1, N_dr=0.5, N_beta=1.0, N_r=-0.6, N_p=-0.2))
    assert roll == pytest.approx((0, 0, 0, 9.802 - 4.2 + 1.4, 0, 0), abs=1e-2)
    assert pitch == pytest.approx((0, 0, 0, 0, 12.2525 - 4.2, 0), abs=1e-2)
    assert yaw == pytest.approx((0, 0, 0, 0, 0, -4.901 - 2.1 - 0.42), abs=1e-2)


def test_cross_moments_and_attitude_hold_by_hand():
    """At V = 7: roll 49.01 (.3 * -.4) + 2 * .3 * .4, pitch -3 (.3^2 - .5^2), yaw 49.01 (.5 * .2) -
    2 * .4 * .5; held, roll 49.01 (-.1 * .4) and pitch 49.01 (-.2 * -.3): against bank and pitch.
    """
    air = flow(rates=(0.3, 0.4, 0.5), aileron=0.2, rudder=-0.4)._replace(roll=0.4, pitch=-0.3)
    crossed = terms.cross_moments(air, values(L_dr=0.3, N_da=0.5, Gamma_1=2.0, Gamma_6=3.0))
    held = terms.attitude_hold(air, values(L_phi=-0.1, M_theta=-0.2))
    assert crossed == pytest.approx((0, 0, 0, -5.641, 0.48, 4.501), abs=1e-2)
    assert held == pytest.approx((0, 0, 0, -1.960, 2.941, 0), abs=1e-2)


def test_quasi_steady_rates_by_hand():
    """At V = 7: p = 7 (.1 + .5 * .2), q = 7 (.1 + .5 * .3), r = 7 (.1 - .5 * .4); 1e-3 for the 0.1
    m/s.
    """
    K = values(
        L_0=0.1,
        L_da=0.5,
        L_beta=-1.0,
        M_0=0.1,
        M_de=0.5,
        M_alpha=-2.0,
        N_0=0.1,
        N_dr=0.5,
        N_beta=1.0,
    )
    loads = terms.quasi_steady_rates(flow(aileron=0.2, elevator=0.3, rudder=-0.4), K)
    assert loads == pytest.approx((0, 0, 0, 1.4, 1.75, -0.7), abs=1e-3)


@pytest.mark.parametrize("form", FORMS)
def test_the_aircraft_is_stable_as_pilots_call_it(form):
    """Nose above the path: it comes down. Wind from the right: the nose turns right into it, and it
    rolls left.
    """
    model = FORMS[form]().with_values({"M_0": 0.0})
    moments = model.terms[4:] if form == "rates" else model.terms[4:5]
    nose_high = np.sum([term.evaluate(flow(w=0.7), model.K) for term in moments], axis=0)
    from_right = np.sum([term.evaluate(flow(v=0.7), model.K) for term in moments], axis=0)
    assert nose_high[4] < -0.1
    assert from_right[5] > 0.1
    assert from_right[3] < -0.1


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("stick", ["aileron", "elevator", "rudder"])
def test_a_stick_raises_its_own_angle(form, stick):
    """The kit's convention: right roll, nose up, nose right are positive for stick and rate."""
    model = FORMS[form]()
    axis = {"aileron": 3, "elevator": 4, "rudder": 5}[stick]
    moments = model.terms[4:]
    moved = np.sum([term.evaluate(flow(**{stick: 1.0}), model.K) for term in moments], axis=0)
    still = np.sum([term.evaluate(flow(), model.K) for term in moments], axis=0)
    assert moved[axis] - still[axis] > 0.1
    assert np.delete(moved - still, axis) == pytest.approx(np.zeros(5), abs=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_a_glide_loses_energy_to_drag_alone(form, rng):
    """Law of energy: d/dt (v^2 / 2 + g h) = -D V without thrust and side force; lift does no work.

    D is written out here. Rounding of sums of order 1e3 leaves 1e-11.
    """
    model = FORMS[form]().with_values({"cY_beta": 0.0, "cY_dr": 0.0, "cD_beta": 0.3, "cL_de": 0.1})
    K = model.K
    x, sticks = states_at_random(model, rng)
    sticks[0] = 0.0
    x_dot = np.stack(
        np.broadcast_arrays(*state_rates(model.form, model.terms, ())(0.0, x, sticks, K))
    )
    power = (x[6:9] * x_dot[6:9]).sum(axis=0) + GRAVITY * x_dot[2]
    v_squared = (x[6:9] ** 2).sum(axis=0)
    alpha, beta = flow_angles_from_vectors(x)
    drag_per_speed = np.sqrt(v_squared + 0.01) * (
        K.cD_0 + K.cD_induced * (K.cL_0 + K.cL_alpha * alpha) ** 2 + K.cD_beta * beta**2
    )
    assert power == pytest.approx(-drag_per_speed * v_squared, abs=1e-10)
    assert (power < 0.0).all()


def flow_angles_from_vectors(x):
    """alpha and beta from scalar products of the velocity with the axes of the aircraft, by scipy's
    rotations.
    """
    from scipy.spatial.transform import Rotation

    # The textbook's north-east-down attitude; world y and z point the other way.
    v_ned = x[6:9].T * [1.0, -1.0, -1.0]
    u, v, w = Rotation.from_euler("ZYX", x[[4, 3, 5]].T).inv().apply(v_ned).T
    return np.arctan2(w, u), np.arcsin(v / np.sqrt(u**2 + v**2 + w**2 + 0.01))


@pytest.mark.parametrize("form", FORMS)
def test_every_parameter_acts(form, rng):
    """A name in the list that changes nothing would be a term that was forgotten; delay and lag act
    on the sticks.
    """
    model = FORMS[form]()
    x, sticks = states_at_random(model, rng)
    rates = state_rates(model.form, model.terms, ())
    before = np.stack(np.broadcast_arrays(*rates(0.0, x, sticks, model.K)))
    for name in set(model.names) - {"delay", "lag"}:
        changed = model.with_values({name: model.values[name] + 0.1})
        after = np.stack(np.broadcast_arrays(*rates(0.0, x, sticks, changed.K)))
        assert np.abs(after - before).max() > 1e-3, name


@pytest.mark.parametrize("form", FORMS)
def test_starting_values_lie_within_their_bounds(form):
    """A fit that starts outside its bounds is refused by every solver."""
    model = FORMS[form]()
    for parameter in model.parameters:
        assert parameter.low <= model.values[parameter.name] <= parameter.high, parameter.name
        assert parameter.unit and parameter.meaning
