"""Model f_K: laws of mechanics and symmetries that hold for any parameters, and an aircraft we did
not make.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falconwing_kit.aircraft.inputs import actuator_response
from falconwing_kit.aircraft.integrate import roll_out
from falconwing_kit.aircraft.model import (
    FORMS,
    add_scaled_terms,
    add_uniform_wind,
    paper_model,
    rates_model,
    scale_model,
    scale_model_to_speed,
)
from falconwing_kit.aircraft.terms import (
    ATTITUDE_HOLD,
    CROSS_MOMENTS,
    Parameter,
    Term,
    WindTerm,
)
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.core.checks import InputError
from tests.jsbsim_aircraft import JsbsimAircraft, figure_eights, fly_jsbsim

DT = 0.025
RATES = (
    ("L", ("0", "da", "beta")),
    ("M", ("0", "de", "alpha")),
    ("N", ("0", "dr", "beta")),
)  # zero, command, angle
# 80 steps of numbers up to 20, each right to 1e-16, in flights that double small errors a few times
ROUNDING = 1e-11


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def flights(model, rng, count=20, steps=80):
    """(count, n) start states and (count, steps, 4) sticks of ordinary flight: 2 s, banked up to 30
    deg.
    """
    spread = np.array([5.0, 5.0, 1.0, 0.1, 3.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])[
        : model.n_states
    ]
    start = rng.normal(0.0, 1.0, (count, model.n_states)) * spread
    start[:, 6] += 7.0 * np.cos(start[:, 4])
    start[:, 7] -= 7.0 * np.sin(start[:, 4])
    sticks = np.array([0.4, 0.0, 0.1, 0.0]) + rng.normal(0.0, 0.1, (count, steps, 4))
    return start, sticks


# What the model is made of
# ----------------------------------------------------------------------------------------


def test_the_paper_form_has_nine_states_and_sixteen_unknowns():
    """Nine states are the paper's; 16 by count: two of lift, two of drag, cY_beta, kT kTV, three a
    rate.
    """
    model = paper_model()
    free = {p.name for p in model.parameters if p.low < p.high}
    assert model.n_states == 9
    assert len(free) == 7 + 9
    assert free == {"cL_0", "cL_alpha", "cD_0", "cD_induced", "cY_beta", "kT", "kTV"} | {
        f"{k}_{n}" for k, ns in RATES for n in ns
    }


def test_the_rates_form_has_twelve_states_and_29_unknowns():
    """By count: 9 of the forces, 14 of the moments, 3 of inertia coupling, sideslip drag, delay and
    lag.
    """
    model = rates_model()
    free = {p.name for p in model.parameters if p.low < p.high}
    assert model.n_states == 12
    assert len(free) == 9 + 14 + 3 + 1 + 2
    assert {"cL_de", "cY_dr", "cD_beta", "Jx", "Jy", "Jz", "delay", "lag"} < free


@pytest.mark.parametrize("form", FORMS)
def test_vector_and_names_say_the_same(form):
    """The inverse of each other."""
    model = FORMS[form]()
    assert dict(zip(model.names, model.vector, strict=True)) == dict(model.values)
    assert model.with_vector(model.vector + 1.0).vector == pytest.approx(
        model.vector + 1.0, abs=0.0
    )
    assert [getattr(model.K, name) for name in model.names] == list(model.vector)


def test_a_change_leaves_the_old_model_alone():
    """A frozen record: a change returns a new one."""
    old = rates_model()
    new = old.with_values({"cL_0": 0.5})
    assert (old.values["cL_0"], new.values["cL_0"]) == (0.078, 0.5)
    assert new.values["cL_alpha"] == old.values["cL_alpha"]


def test_an_unknown_name_is_told_with_the_known_ones():
    """A typo must not become a parameter that nothing reads."""
    with pytest.raises(InputError, match=r"'cL_1'.*cL_0"):
        rates_model().with_values({"cL_1": 0.1})


def test_a_pinned_parameter_has_no_room():
    """Bounds that meet at the present value are what every fit leaves out."""
    model = rates_model().with_values({"L_p": -3.0}).with_fixed(["L_p"])
    bounds = {p.name: (p.low, p.high) for p in model.parameters}
    assert bounds["L_p"] == (-3.0, -3.0)
    assert bounds["L_r"] == (-4.0, 10.0)


def test_an_added_force_accelerates_by_its_size():
    """By hand: 2 m/s^2 to the right wing of a level aircraft is -2 m/s^2 along world y, which
    points left.
    """
    push = Term(
        "push",
        (Parameter("push", 2.0, 0.0, 5.0, "m/s^2", "to the right"),),
        lambda air, K: (0, K.push, 0, 0, 0, 0),
    )
    for form in FORMS:
        still = FORMS[form]()
        start, sticks = np.zeros(still.n_states), np.zeros((1, 4))
        start[6] = 7.0
        pushed = still.with_terms(push)
        gained = (
            roll_out(pushed, start, sticks, 1e-3)[-1] - roll_out(still, start, sticks, 1e-3)[-1]
        )
        assert gained[7] == pytest.approx(-2e-3, rel=2e-3)  # of which drag takes some at once
        assert pushed.names == (*still.names, "push")


def test_winds_add_up():
    """1 m/s in the model's uniform wind and 0.5 from a second one blow like 1.5."""
    gust = WindTerm(
        "gust",
        (Parameter("gust", 0.5, 0.0, 5.0, "m/s", ""),),
        lambda px, py, height, time, K: (K.gust, 0, 0),
    )
    start, sticks = np.zeros(12), np.full((40, 4), 0.1)
    start[6] = 7.0
    two = roll_out(add_uniform_wind(rates_model(), 1.0).with_terms(gust), start, sticks, DT)
    one = roll_out(add_uniform_wind(rates_model(), 1.5), start, sticks, DT)
    assert np.abs(two - one).max() < ROUNDING


# Laws
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_without_air_it_flies_a_parabola(form, rng):
    """Newton: v0 t - g t^2 / 2 with g = 9.8, momentum changed by gravity alone. Exact for
    Runge-Kutta.
    """
    model = FORMS[form]()
    model = model.with_vector(np.zeros(len(model.names)))
    start, sticks = flights(model, rng)
    flown = roll_out(model, start, sticks, DT)
    t = np.arange(81)[:, None] * DT
    fall = np.array([0.0, 0.0, -9.8])
    assert flown[..., 6:9] == pytest.approx(start[:, None, 6:9] + fall * t, abs=ROUNDING)
    want = start[:, None, :3] + start[:, None, 6:9] * t + 0.5 * fall * t**2
    assert flown[..., :3] == pytest.approx(want, abs=ROUNDING)


def test_without_air_the_paper_form_does_not_turn(rng):
    """Its rates come from the air alone."""
    model = paper_model()
    model = model.with_vector(np.zeros(len(model.names)))
    start, sticks = flights(model, rng)
    flown = roll_out(model, start, sticks, DT)
    assert np.abs(flown[..., 3:6] - start[:, None, 3:6]).max() == 0.0


def test_free_spin_keeps_energy_and_angular_momentum(rng):
    """Euler: without torque, the energy and the angular momentum as a vector in the world stay as
    they are.

    Inertias are those of a real body; attitude is turned into a matrix by scipy. 1 ms steps at 2
    rad/s leave (2e-3)^4 of the start after 1 s.
    """
    inertia = np.array([1.15, 1.46, 2.12])
    Ix, Iy, Iz = inertia
    model = rates_model()
    model = model.with_vector(np.zeros(len(model.names)))
    model = model.with_values({"Jx": (Iy - Iz) / Ix, "Jy": (Iz - Ix) / Iy, "Jz": (Ix - Iy) / Iz})
    start = np.zeros((20, 12))
    start[:, 3:6], start[:, 9:] = rng.uniform(-0.3, 0.3, (20, 3)), rng.uniform(-1.0, 1.0, (20, 3))
    flown = roll_out(model, start, np.zeros((1000, 4)), 1e-3)
    spin = inertia * flown[..., 9:]
    energy = (spin * flown[..., 9:]).sum(axis=-1)
    turned = Rotation.from_euler("ZYX", flown[..., [4, 3, 5]].reshape(-1, 3)).apply(
        spin.reshape(-1, 3)
    )
    turned = turned.reshape(spin.shape)
    assert energy == pytest.approx(np.repeat(energy[:, :1], 1001, axis=1), rel=1e-10)
    assert np.abs(turned - turned[:, :1]).max() < 1e-9
    assert np.abs(flown[..., 9:] - start[:, None, 9:]).max() > 0.1  # it does tumble


# Symmetries
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_a_uniform_wind_carries_the_flight_along(form, rng):
    """Galileo: a flight in wind is the flight in still air plus wind times time."""
    wind = np.array([0.8, -1.3, 0.0])
    model = FORMS[form]()
    start, sticks = flights(model, rng)
    still = roll_out(model, start, sticks, DT)
    carried = start.copy()
    carried[:, 6:9] += wind
    windy = roll_out(add_uniform_wind(model, wind[0], wind[1]), carried, sticks, DT)
    t = np.arange(81)[:, None] * DT
    assert windy[..., :3] == pytest.approx(still[..., :3] + wind * t, abs=1e-9)
    assert windy[..., 6:9] == pytest.approx(still[..., 6:9] + wind, abs=1e-9)
    assert np.abs(np.delete(windy - still, [0, 1, 2, 6, 7, 8], axis=2)).max() < 1e-9


@pytest.mark.parametrize("form", FORMS)
def test_left_and_right_are_mirror_images(form, rng):
    """A symmetric aircraft in a mirror flies the mirrored flight: y, yaw, roll, p, r, aileron,
    rudder change sign.
    """
    model = FORMS[form]()
    mirror = np.array([1, -1, 1, 1, -1, -1, 1, -1, 1, -1, 1, -1])[: model.n_states]
    start, sticks = flights(model, rng)
    flown = roll_out(model, start, sticks, DT)
    mirrored = roll_out(model, start * mirror, sticks * [1, -1, 1, -1], DT)
    assert np.abs(mirrored - flown * mirror).max() < ROUNDING


@pytest.mark.parametrize("form", FORMS)
def test_place_and_heading_do_not_matter(form, rng):
    """The world has no preferred heading: started elsewhere and turned by 1 rad, the flight is
    moved and turned.
    """
    model = FORMS[form]()
    start, sticks = flights(model, rng)
    turn = np.array(
        [[np.cos(1.0), np.sin(1.0)], [-np.sin(1.0), np.cos(1.0)]]
    )  # to the right, as yaw counts

    def moved(x):
        y = x.copy()
        y[..., :2] = x[..., :2] @ turn.T + [3.0, -2.0]
        y[..., 2], y[..., 4] = x[..., 2] + 5.0, x[..., 4] + 1.0
        y[..., 6:8] = x[..., 6:8] @ turn.T
        return y

    flown = roll_out(model, start, sticks, DT)
    assert np.abs(roll_out(model, moved(start), sticks, DT) - moved(flown)).max() < ROUNDING


# An independent aircraft
# ------------------------------------------------------------------------------------------


def side_force_in_wind_axes(air, K):
    """As JSBSim has it: at right angles to the wind, where the kit's lies along the right wing."""
    force = air.airspeed**2 * (K.cY_beta * air.beta + K.cY_dr * air.rudder)
    forward, right = -np.sin(air.beta), np.cos(air.beta)
    return (
        force * forward * np.cos(air.alpha),
        force * right,
        force * forward * np.sin(air.alpha),
        0.0,
        0.0,
        0.0,
    )


def errors_against_jsbsim(seed, step, wind_axes):
    """How far the kit's model is from JSBSim's flight: position to 2 s and 5 s [m], attitude to 2 s
    and 5 s [rad].
    """
    rng = np.random.default_rng(seed)
    aircraft = JsbsimAircraft().redrawn(rng, 0.15)
    t, flown, sticks = fly_jsbsim(aircraft, figure_eights(rng), 5.0, step=step)
    model = aircraft.kit_model(step)
    if wind_axes:
        terms = tuple(
            replace(x, evaluate=side_force_in_wind_axes) if x.name == "side_force" else x
            for x in model.terms
        )
        model = replace(model, terms=terms).with_values(
            {"cD_beta": model.values["cD_beta"] - model.values["cY_beta"]}
        )
    substeps = 10  # of 5 ms, so that what is left is not the kit's integration
    edges = np.arange(100 * substeps + 1) * 0.05 / substeps
    mean, slope = actuator_response(t, sticks, edges, model.values["delay"], model.values["lag"])
    error = roll_out(model, flown[0], mean, 0.05 / substeps, slope=slope)[::substeps] - flown
    position, attitude = np.linalg.norm(error[:, :3], axis=1), np.abs(error[:, 3:6]).max(axis=1)
    return position[:41].max(), position.max(), attitude[:41].max(), attitude.max()


@pytest.mark.parametrize("seed", range(4))
def test_equations_are_those_of_jsbsim(seed):
    """JSBSim flies the same aircraft (coefficients drawn with 15 % spread) within 1 cm over 5 s of
    figure eights.

    JSBSim at 0.5 ms; the side force in its axes. What is left: 0.1 m/s in the kit's airspeed and
    the density of the air at 2 m, each 2e-4 of all forces, and the integration: 5 mm and 0.5 mrad
    seen, on a path of 35 m.
    """
    _, position, _, attitude = errors_against_jsbsim(seed, 0.0005, wind_axes=True)
    assert position < 0.01
    assert attitude < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_the_kit_form_follows_jsbsim_at_its_usual_step(seed):
    """As labs use it: 5 ms steps, side force along the right wing, which differs by
    the square of sideslip and its product with rudder. Within 4 cm, 0.7 deg over 2 s: 3.3 cm, 0.6
    deg in 12 flights.
    """
    position, _, attitude, _ = errors_against_jsbsim(seed, 0.005, wind_axes=False)
    assert position < 0.04
    assert attitude < np.radians(0.7)


# Aircraft of another size
# ----------------------------------------------------------------------------------------

# Published coefficients, per radian: Aerosonde as in the errata of Beard & McLain's appendix E
# (mavsim), Zagi of the same appendix, Skywalker X8 of PyFly. Two elevons act as elevator and
# aileron; C_m_q of PyFly is per q b / 2V, here per q c / 2V.
PUBLISHED = {
    "aerosonde": {
        "m": 11.0, "S": 0.55, "b": 2.8956, "c": 0.18994, "rho": 1.2682, "e": 0.9,
        "J": (0.8244, 1.135, 1.759), "V": 25.0,
        "C_L": (0.23, 5.61, 0.13), "C_D_0": 0.043, "C_Y": (-0.98, 0.19),
        "C_l": (0.0, 0.17, -0.13, -0.51, 0.25), "C_m": (0.0135, -0.99, -2.74, -38.21),
        "C_n": (0.0, -0.069, 0.073, -0.095, 0.069),
    },
    "zagi": {
        "m": 1.56, "S": 0.2589, "b": 1.4224, "c": 0.3302, "rho": 1.2682, "e": 0.9,
        "J": (0.1147, 0.0576, 0.1712), "V": 17.0,
        "C_L": (0.09167, 3.5016, 0.2724), "C_D_0": 0.01631 + 0.0254, "C_Y": (-0.07359, 0.0),
        "C_l": (0.0, 0.1682, -0.02854, -0.3209, 0.03066),
        "C_m": (-0.02338, -0.3254, -0.5675, -1.399),
        "C_n": (0.0, 0.0, -0.0004, -0.00434, -0.01297),
    },
    "x8": {
        "m": 3.364, "S": 0.75, "b": 2.1, "c": 0.35714, "rho": 1.225, "e": 0.9935,
        "J": (1.229, 0.1702, 0.8808), "V": 18.0,
        "C_L": (0.08674, 4.0203, 0.27807), "C_D_0": 0.0197, "C_Y": (-0.22387, 0.0),
        "C_l": (0.0, 0.12019, -0.084896, -0.404198, 0.0555206),
        "C_m": (0.018, -0.2292, -0.2524, -1.301237 * 2.1 / 0.35714),
        "C_n": (0.0, 0.0, 0.0283, -0.072, 0.0043655),
    },
}  # fmt: skip
FULL_DEFLECTION = np.radians(30.0)  # of a control surface at full command


def dimensional_derivatives(a):
    """The kit's parameters of published coefficients, by the formulas at the head of terms.py."""
    force = a["rho"] * a["S"] / (2.0 * a["m"])  # V^2 times it is force per mass
    roll, pitch, yaw = (
        a["rho"] * a["S"] * arm / (2.0 * J)
        for arm, J in zip((a["b"], a["c"], a["b"]), a["J"], strict=True)
    )
    half_span, half_chord, full = a["b"] / 2.0, a["c"] / 2.0, FULL_DEFLECTION
    found = {
        "cL_0": force * a["C_L"][0], "cL_alpha": force * a["C_L"][1],
        "cL_de": -force * a["C_L"][2] * full, "cD_0": force * a["C_D_0"],
        "cD_induced": 1.0 / (np.pi * a["e"] * a["b"] ** 2 / a["S"] * force),
        "cY_beta": force * a["C_Y"][0], "cY_dr": -force * a["C_Y"][1] * full,
    }  # fmt: skip
    for letter, C, of_moment, arm, command, angle, rates in (
        ("L", a["C_l"], roll, half_span, "da", "beta", ("p", "r")),
        ("M", a["C_m"], pitch, half_chord, "de", "alpha", ("q",)),
        ("N", a["C_n"], yaw, half_span, "dr", "beta", ("r", "p")),
    ):
        sign = 1.0 if letter == "L" else -1.0  # the kit's elevator and rudder are nose up and right
        found |= {
            f"{letter}_0": of_moment * C[0],
            f"{letter}_{command}": sign * of_moment * C[1] * full,
        }
        found[f"{letter}_{angle}"] = of_moment * C[2]
        found |= {f"{letter}_{r}": of_moment * arm * C[3 + i] for i, r in enumerate(rates)}
    return found


def share_of_the_way(p, value):
    """Where a value lies between the start (0) and the bound on its side (1)."""
    bound = p.high if value > p.start else p.low
    return (value - p.start) / (bound - p.start)


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_aircraft_lie_well_inside_the_bounds_of_the_scaled_model(name):
    """Three aircraft of 1.6 to 11 kg that are not ours, two of them flying wings: no derivative
    lies farther than two thirds of the way from the start to a bound.
    """
    a = PUBLISHED[name]
    scaled = scale_model(rates_model(), a["m"], a["S"], a["b"])
    parameters = {p.name: p for p in scaled.parameters}
    shares = {
        key: share_of_the_way(parameters[key], value)
        for key, value in dimensional_derivatives(a).items()
    }
    assert len(shares) == 21 and max(shares.values()) < 2.0 / 3.0, shares


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_usual_speed_alone_gives_bounds_that_hold_published_aircraft(name):
    """The same aircraft with their speeds alone (V: of the books' examples, X8 of Gryte et al.);
    nothing is known of size or mass, so a derivative may come closer to a bound: 90 % of the way.
    """
    a = PUBLISHED[name]
    parameters = {p.name: p for p in scale_model_to_speed(rates_model(), a["V"]).parameters}
    shares = {
        key: share_of_the_way(parameters[key], value)
        for key, value in dimensional_derivatives(a).items()
    }
    assert max(shares.values()) < 0.9, shares


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("ratio", [0.5, 4.0])
def test_a_similar_aircraft_flies_the_similar_path(form, ratio, rng):
    """Froude's law: lengths times k and masses times k^3 make speeds sqrt(k), times sqrt(k) and
    rates 1 / sqrt(k). 0.3 s of flight; 1e-3 is the 0.1 m/s that keeps flow angles defined at rest.
    """
    small = FORMS[form]().with_values({"cL_de": 0.05, "cY_dr": -0.02})
    large = scale_model(small, 0.150 * ratio**3, 0.076 * ratio**2, 0.70 * ratio)
    start, sticks = flights(small, rng, count=5, steps=12)
    root = np.sqrt(ratio)
    scale = np.array([ratio] * 3 + [1.0] * 3 + [root] * 3 + [1.0 / root] * 3)[: small.n_states]
    path = roll_out(small, start, sticks, DT)
    assert roll_out(large, start * scale, sticks, DT * root) == pytest.approx(
        path * scale, rel=1e-3, abs=1e-3
    )
    assert np.abs(roll_out(small, start * scale, sticks, DT * root) - path * scale).max() > 0.1


@pytest.mark.parametrize("airspeed", [3.0, 7.0, 18.0, 40.0])
def test_an_aircraft_scaled_to_a_speed_trims_at_it(airspeed):
    """Lift equals weight: the 150 g aircraft's angle of attack at 7 m/s, at any speed; 2e-4 rad is
    the 0.1 m/s that keeps flow angles defined at rest.
    """
    alpha = trim(scale_model_to_speed(rates_model(), airspeed), airspeed).state[3]
    assert alpha == pytest.approx(trim(rates_model(), 7.0).state[3], abs=5e-4)


@pytest.mark.parametrize("airspeed", [0.0, -7.0, np.nan, 300.0])
def test_an_impossible_speed_is_refused(airspeed):
    """No aircraft of this kind flies at it."""
    with pytest.raises(InputError, match="airspeed"):
        scale_model_to_speed(rates_model(), airspeed)


def test_terms_added_to_a_scaled_model_have_its_size():
    """By similarity angular accelerations per V^2 go with 1/span^2: of a 10 m aircraft 0.0049 of
    those of 0.70 m. What it had before stays as it was.
    """
    large = scale_model(rates_model(), 1200.0, 17.0, 10.0).with_values({"L_da": 0.002})
    model = add_scaled_terms(large, CROSS_MOMENTS, ATTITUDE_HOLD)
    known = {p.name: p for p in (*CROSS_MOMENTS.parameters, *ATTITUDE_HOLD.parameters)}
    for p in model.parameters:
        if p.name in ("Gamma_1", "Gamma_6"):  # ratios
            assert p == known[p.name]
        elif p.name in known:
            expected = [0.0049 * x for x in (known[p.name].low, known[p.name].high)]
            assert [p.low, p.high] == pytest.approx(expected)
            assert model.values[p.name] == pytest.approx(0.0049 * known[p.name].start)
        else:
            assert p in large.parameters and model.values[p.name] == large.values[p.name]
