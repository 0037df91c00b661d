"""Effects: each entry of the catalogue against numbers worked by hand, laws, and signs that a pilot
knows.
"""

import re
from dataclasses import replace
from string import Formatter
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft import terms
from falconwing_kit.aircraft.effect import STANDING, effect_catalogue, standing_effect
from falconwing_kit.aircraft.effects import CATALOGUE, EFFECT_NAMES
from falconwing_kit.aircraft.model import rates_model, state_rates
from falconwing_kit.aircraft.terms import CROSS_MOMENTS, air_flow
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.gap.advice import DIAGNOSIS_MANOEUVRES
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import cut_windows, residuals
from tests.sysid.simulated import fly_figure_eights, measured

EFFECTS = {effect.name: effect for effect in CATALOGUE}
SERVO, LINKAGE = (
    effect for effect in CATALOGUE if effect.name == "actuator_lag"
)  # one effect in two forms
DEAD_BAND, DEAD_ZONE = (effect for effect in CATALOGUE if effect.name == "deadband")
STICKS = np.random.default_rng(5).uniform(-1.0, 1.0, (50, 4)) * [0.5, 1.0, 1.0, 1.0] + [
    0.5,
    0.0,
    0.0,
    0.0,
]
TIMES, EDGES = np.arange(50) * 0.05, np.arange(99) * 0.025  # rows of sticks, integration steps [s]
FROM_BELOW, FROM_THE_RIGHT = (
    {"u": 5.6, "w": 4.2},
    {"u": 5.6, "v": 4.2},
)  # 7 m/s, and not along the nose alone
THRUST = {"kT": 9.0, "kTV": 0.5}  # at 7 m/s (9 - 3.5) m/s^2 times throttle


def flow(
    u=7.0, v=0.0, w=0.0, height=2.0, time=4.0, throttle=0.0, aileron=0.0, elevator=0.0, rudder=0.0
):
    return air_flow(
        (u, v, w), (0.3, 0.2, 0.1), (1.0, 2.0, height), time, (throttle, aileron, elevator, rudder)
    )


def flows_at_random(count=200):
    """Ordinary and wild flight, 3 to 13 m/s, on the floor and up to 2 m above; a Flow of arrays
    (count,).
    """
    rng = np.random.default_rng(7)
    u, v, w = rng.uniform([[3.0], [-3.0], [-3.0]], [[12.0], [3.0], [4.0]], (3, count))
    sticks = rng.uniform([[0.0], [-1.0], [-1.0], [-1.0]], 1.0, (4, count))
    return air_flow(
        (u, v, w), rng.normal(size=(3, count)), rng.uniform(0.0, 2.0, (3, count)), 30.0, sticks
    )


def loads(name, air, **K):
    """(6, ...) of the effect in the model of the kit's own aircraft, with the values that matter
    given.
    """
    model = rates_model().with_effect(EFFECTS[name])
    term = EFFECTS[name].term(rates_model().terms)
    return np.stack(np.broadcast_arrays(*term.evaluate(air, model.with_values(K).K), air.u))[:-1]


def total(parts, air, **K):
    """(6, ...) sum of terms of the base model, for laws."""
    K = rates_model().with_values(K).K
    return sum(np.stack(np.broadcast_arrays(*part(air, K), air.u))[:-1] for part in parts)


def zeroed(effect):
    """The kit's aircraft with the effect in it, at amplitude zero."""
    return rates_model().with_effect(effect).with_values({p.name: 0.0 for p in effect.amplitudes})


# The catalogue
# --------------------------------------------------------------------------------------------------


def test_the_twenty_names_are_there():
    """As the command line's page names them; more may be added."""
    fixed = """wind fan_jet ground_effect extra_drag flap thrust_loss battery_sag propeller_torque
        adverse_yaw control_delay actuator_lag trim_bias deadband aileron_loss mass_change cg_shift
        camera_tilt time_offset stall wing_drag"""
    assert len(fixed.split()) == 20
    assert set(fixed.split()) <= set(EFFECT_NAMES)
    assert len(set(EFFECT_NAMES)) == len(EFFECT_NAMES)


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_an_entry_refers_to_what_exists(effect):
    """Other effects by their names, its own parameters by theirs; a sentence for the student."""
    own = {p.name for p in effect.parameters}
    assert set(effect.contains) | ({effect.same_as} - {""}) <= set(EFFECT_NAMES) - {effect.name}
    assert set(effect.shape) | set(effect.essential) <= own
    assert all(set(start) <= own for start in effect.starts)
    assert set(effect.place or ()) <= own
    assert set(effect.separated_by) <= {m.name for m in DIAGNOSIS_MANOEUVRES}
    assert effect.physics.endswith(".")


def test_every_name_can_be_hidden():
    """One entry of each name has sizes in rising order and a draw of the parameters of one form."""
    for name in EFFECT_NAMES:
        (entry,) = [e for e in CATALOGUE if e.name == name and e.sizes]
        assert 0.0 < entry.sizes[0] <= entry.sizes[1] < entry.sizes[2], name
        drawn = set(entry.draw(np.random.default_rng(1), entry.sizes[2]))
        forms = [e for e in CATALOGUE if e.name == (entry.same_as or name)]
        assert drawn in [{p.name for p in e.parameters} for e in forms], name


def test_order_does_not_depend_on_what_is_added():
    """Frozen numbers first, as they were drawn from; a later effect comes after them, by name."""
    new = [replace(EFFECTS["wind"], name=name, frozen_number=None) for name in ("zephyr", "abeam")]
    ordered = effect_catalogue([*new, *reversed(CATALOGUE)])
    later = sorted({e.name for e in CATALOGUE if e.frozen_number is None} | {"abeam", "zephyr"})
    assert [e.name for e in ordered[-len(later) :]] == later
    known = (e.name for e in ordered if e.name not in ("abeam", "zephyr"))
    assert tuple(dict.fromkeys(known)) == EFFECT_NAMES
    frozen = """wind fan_jet ground_effect extra_drag flap thrust_loss battery_sag propeller_torque
        adverse_yaw control_delay actuator_lag trim_bias deadband aileron_loss mass_change cg_shift
        camera_tilt time_offset stall"""
    assert tuple(frozen.split()) == EFFECT_NAMES[:19]
    with pytest.raises(InputError, match="frozen_number"):
        effect_catalogue([*CATALOGUE, replace(EFFECTS["wind"], name="abeam")])


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_starts_lie_within_bounds_and_absence_too(effect):
    """A fit that begins outside its bounds is refused; one that cannot reach zero could not say
    that nothing is there; one that begins at zero would not feel parameters that say where or when.
    """
    for p in effect.parameters:
        for start in (p.start, *(s[p.name] for s in effect.starts if p.name in s)):
            assert p.low <= start <= p.high, p.name
        assert p.unit and p.meaning, p.name
    for p in effect.amplitudes:
        assert p.low <= 0.0 <= p.high and p.start != 0.0, p.name


def test_every_parameter_has_its_own_name():
    """Two of one name would be one unknown: none twice in the catalogue, none of the model's."""
    names = [p.name for effect in CATALOGUE for p in effect.parameters]
    assert len(set(names)) == len(names)
    assert not set(names) & set(rates_model().names)


@pytest.mark.parametrize(
    "effect", CATALOGUE, ids=lambda e: f"{e.name} {' '.join(p.name for p in e.parameters)}"
)
def test_every_equation_holds_every_parameter(effect):
    """Each stands in braces; only a twin without parameters has no equation."""
    held = {name for _, name, _, _ in Formatter().parse(effect.equation) if name is not None}
    assert held == {p.name for p in effect.parameters}
    assert bool(effect.equation) == bool(effect.parameters)


@pytest.mark.parametrize(
    "name",
    [
        "extra_drag",
        "adverse_yaw",
        "aileron_loss",
        "propeller_torque",
        "cg_shift",
        "thrust_loss",
        "battery_sag",
        "wing_drag",
    ],
)
def test_the_equation_on_the_page_is_the_function(name):
    """The equation's right-hand sides, worked as Python with forces and moments by the formulas of
    aircraft/terms.py, against what the function adds; a product is a space.
    """
    air = flow(**FROM_THE_RIGHT, throttle=0.6, aileron=0.4, elevator=0.3, rudder=-0.5)
    K = rates_model().with_effect(EFFECTS[name]).K
    V = air.airspeed
    symbols = {
        "V": V,
        "t": air.time / 60.0,  # a share per minute
        "T": (K.kT - K.kTV * V) * air.throttle,
        "L": V**2 * (K.cL_0 + K.cL_alpha * air.alpha + K.cL_de * air.elevator),
        "Y": V**2 * (K.cY_beta * air.beta + K.cY_dr * air.rudder),
        "D": 0.0, "dp": 0.0, "dq": 0.0, "dr": 0.0, "dt": 1.0, "m": 1.0,
        "Iyy": 1.0 - K.Jz, "Izz": 1.0 + K.Jy, "aileron": air.aileron, "L_da": K.L_da,
    }  # fmt: skip
    values = {p.name: getattr(K, p.name) for p in EFFECTS[name].parameters}
    added = {}
    for part in (
        EFFECTS[name].equation.format(**{n: f"({v})" for n, v in values.items()}).split(", ")
    ):
        left, right = part.split(" -> ")
        python = re.sub(r"(?<=[\w)]) (?=[\w(])", "*", right.replace("^", "**"))
        added[left] = eval(python, symbols) - eval(left, symbols)
    found = loads(name, air, **values)
    along = np.array([air.u, air.v, air.w]) / V
    of_force = {"D/m": -found[:3] @ along, "T": found[0]}
    of_moment = dict(zip(("dp/dt", "dq/dt", "dr/dt"), found[3:], strict=True))
    assert added == pytest.approx(
        {left: {**of_force, **of_moment}[left] for left in added}, rel=1e-3
    )  # 0.1 m/s in quadrature
    assert all(abs(value) > 1e-6 for value in added.values())


def test_every_entry_has_one_place_where_it_acts():
    """Forces, wind, sticks, poses, or the model's own delay and lag; only another effect's twin has
    none.
    """
    for effect in CATALOGUE:
        model = rates_model().with_effect(effect)
        of_sticks = set(model.actuator_parameter_names) - {"delay", "lag"}
        assert bool(of_sticks) == bool(effect.command_map or effect.input_map)
        hooks = (
            effect.loads,
            effect.loads_of,
            effect.wind_field,
            effect.command_map,
            effect.input_map,
            effect.measurement_map,
        )
        assert sum(map(bool, hooks)) == (0 if effect.same_as else 1), effect.name
        assert bool(effect.parameters) == (not effect.same_as), effect.name


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_at_amplitude_zero_nothing_is_there(effect):
    """No load, no wind, sticks to the last bit: the model is the one without the effect, wherever
    the shape lies.
    """
    K, air = zeroed(effect).K, flows_at_random()
    if term := effect.term(rates_model().terms):
        assert all(np.all(load == 0.0) for load in term.evaluate(air, K))
    if effect.wind_field:
        assert all(
            np.all(part == 0.0) for part in effect.wind_field(air.px, air.py, air.height, 30.0, K)
        )
    pose = np.arange(12.0).reshape(6, 2) / 10.0
    assert np.array_equal(zeroed(effect).measured_pose(pose, K), pose)
    actuator_positions = zeroed(effect).actuator_positions(TIMES, STICKS, EDGES, K)
    assert np.array_equal(
        actuator_positions, rates_model().actuator_positions(TIMES, STICKS, EDGES, rates_model().K)
    )


@pytest.mark.parametrize(
    "effect", [e for e in CATALOGUE if e.parameters and not e.measurement_map], ids=lambda e: e.name
)
def test_every_parameter_acts(effect):
    """One that changes nothing was forgotten in the formula. Each, larger by 0.05 (a radius of tens
    of metres by a twentieth), moves a load, a wind or a stick by more than 1e-4.
    """
    model, air = rates_model().with_effect(effect), flows_at_random()

    def everything(K):
        term = effect.term(rates_model().terms)
        of_air = term.evaluate(air, K) if term else ()
        wind = effect.wind_field(air.px, air.py, air.height, 30.0, K) if effect.wind_field else ()
        return [
            np.ravel(part)
            for part in (*of_air, *wind, *model.actuator_positions(TIMES, STICKS, EDGES, K))
        ]

    for p in effect.parameters:
        more = 0.05 * (p.start if p.start > 10.0 else 1.0)  # of a stream tens of metres wide
        moved = everything(model.with_values({p.name: model.values[p.name] + more}).K)
        change = [np.abs(a - b).max() for a, b in zip(moved, everything(model.K), strict=True)]
        assert max(change) > 1e-4, p.name


def test_amplitudes_are_all_that_is_not_shape():
    """By meaning: a jet has two components and a place; a stall has a share and an angle where it
    begins.
    """
    assert [p.name for p in EFFECTS["fan_jet"].amplitudes] == ["jet_x", "jet_y"]
    assert [p.name for p in EFFECTS["stall"].amplitudes] == ["stall_loss"]
    assert EFFECTS["wind"].amplitudes == EFFECTS["wind"].parameters


def test_every_effect_says_what_it_acts_on():
    """The forces, moments, sticks, air or camera of its formula; a stamp that is late acts as the
    delay does.
    """
    assert all(effect.acts_on or effect.same_as for effect in CATALOGUE)
    assert EFFECTS["control_delay"].acts_on == EFFECTS["actuator_lag"].acts_on
    assert not set(EFFECTS["wind"].acts_on) & set(EFFECTS["control_delay"].acts_on)


def test_an_effect_that_contains_another_can_become_it():
    """A jet that is wide next to the distance is a wind, to 1 - exp(-0.5 (0.1/8)^2) < 1e-4; a flap
    that lifts nothing is extra drag, and what makes it a flap is what `essential` names.
    """
    jet = SimpleNamespace(jet_x=2.0, jet_y=-1.0, jet_at_x=0.0, jet_at_y=0.0, jet_radius=8.0)
    wind = EFFECTS["wind"].wind_field(0.1, 0.0, 1.0, 0.0, SimpleNamespace(wind_x=2.0, wind_y=-1.0))
    assert EFFECTS["fan_jet"].wind_field(0.1, 0.0, 1.0, 0.0, jet) == pytest.approx(wind, abs=2e-4)
    air = flows_at_random()
    flap = loads("flap", air, flap_lift=0.0, flap_drag=0.03)
    assert flap == pytest.approx(loads("extra_drag", air, drag_added=0.03), abs=1e-12)
    assert EFFECTS["flap"].essential == ("flap_lift",)


def test_late_images_are_the_delay_that_no_flight_tells_apart():
    """A time offset of the camera has no parameters of its own: it is found as a control delay."""
    assert EFFECTS["time_offset"].same_as == "control_delay"
    assert [e.name for e in CATALOGUE if e.same_as] == ["time_offset"]


# Air that moves
# --------------------------------------------------------------------------------------------------


def test_wind_is_the_same_everywhere():
    """By meaning of the word."""
    K = SimpleNamespace(wind_x=1.5, wind_y=-0.5)
    for place in ((0.0, 0.0, 0.0, 0.0), (20.0, -9.0, 3.0, 60.0)):
        assert EFFECTS["wind"].wind_field(*place, K) == (1.5, -0.5, 0.0)


@pytest.mark.parametrize(
    ("name", "wind"), [("wind", {"wind_x": 7.0}), ("fan_jet", {"jet_x": 7.0, "jet_y": 0.0})]
)
def test_a_tail_wind_as_fast_as_the_aircraft_leaves_gravity_alone(name, wind):
    """No air past the wings, no lift: free fall. The airspeed is kept at 0.1 m/s, which leaves 0.01
    m/s^2 of lift.
    """
    model = (
        rates_model()
        .with_effect(EFFECTS[name])
        .with_values({p: 0.0 for p in ("wind_y",) if name == "wind"} | wind)
    )
    x = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    change = state_rates("rates", model.terms, model.winds)(0.0, x, np.zeros(4), model.K)
    assert change[6:9] == pytest.approx((0.0, 0.0, -GRAVITY), abs=0.01)


def test_a_fan_jet_fades_as_a_bell():
    """Full in its middle; exp(-1/2) = 0.60653 at one radius, here 0.7 and 2.4 m away of 2.5;
    nothing ten metres off.
    """
    K = SimpleNamespace(jet_x=2.0, jet_y=-1.0, jet_at_x=3.0, jet_at_y=4.0, jet_radius=2.5)
    jet = EFFECTS["fan_jet"].wind_field
    assert jet(3.0, 4.0, 1.0, 0.0, K) == (2.0, -1.0, 0.0)
    assert jet(3.7, 6.4, 0.2, 9.0, K) == pytest.approx((1.21306, -0.60653, 0.0), abs=1e-5)
    assert jet(13.0, 4.0, 1.0, 0.0, K) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


# Forces; 1e-3 to 2e-2 of the numbers is the 0.1 m/s that keeps the flow angles defined
# -----------------------------


def test_ground_effect_by_hand():
    """At 0.5 ln 2 = 0.34657 m half of what is on the floor is left: lift more by 49.01 * 0.2 * 0.4
    / 2 = 1.960, induced drag less by 49 * 0.5 * 0.2^2 * 0.3 / 2 = 0.147. Below the floor is as on
    it, and ten metres up nothing is left.
    """
    K = {"cL_0": 0.2, "cD_induced": 0.5, "ground_lift": 0.4, "ground_drag": 0.3}
    near = loads("ground_effect", flow(height=0.5 * np.log(2.0)), **K)
    assert near == pytest.approx((0.147, 0.0, -1.960, 0.0, 0.0, 0.0), abs=1e-3)
    on_floor, below, above = (
        loads("ground_effect", flow(height=height), **K) for height in (0.0, -0.3, 10.0)
    )
    assert on_floor == pytest.approx(2.0 * near, abs=1e-9) and np.array_equal(on_floor, below)
    assert above == pytest.approx(np.zeros(6), abs=1e-6)


def test_on_the_floor_lift_may_double_and_induced_drag_may_vanish():
    """What shares of one mean, at any angle of attack: the model's own lift once more, and its
    drag taken back."""
    air = flows_at_random()._replace(height=0.0)
    found = loads("ground_effect", air, cD_0=0.0, cD_beta=0.0, ground_lift=1.0, ground_drag=1.0)
    assert found == pytest.approx(
        total([terms.lift], air) - total([terms.drag], air, cD_0=0.0, cD_beta=0.0), abs=1e-10
    )


def test_extra_drag_by_hand():
    """u = 8, w = 6 m/s: 100.01 * 0.03 = 3.0 along the wind, of which 0.8 on the nose and 0.6 on the
    belly.
    """
    found = loads("extra_drag", flow(u=8.0, w=6.0), drag_added=0.03)
    assert found == pytest.approx((-2.4, 0.0, -1.8, 0.0, 0.0, 0.0), abs=1e-3)


def test_flap_by_hand():
    """Lift 49 * 0.1 = 4.90; drag 49 (0.05 + 2 (0.3^2 - 0.2^2)) = 49 * 0.15 = 7.35."""
    found = loads("flap", flow(), cL_0=0.2, cD_induced=2.0, flap_lift=0.1, flap_drag=0.05)
    assert found == pytest.approx((-7.35, 0.0, -4.90, 0.0, 0.0, 0.0), abs=2e-3)


def test_a_flap_moves_the_aircraft_along_its_polar():
    """The law: lift and drag with the flap are those of a wing whose cL_0 and cD_0 are larger, at
    any angle.
    """
    air = flows_at_random()
    out, clean = {"cL_0": 0.078 + 0.12, "cD_0": 0.0155 + 0.01}, {"cL_0": 0.078, "cD_0": 0.0155}
    parts = [terms.lift, terms.drag]
    want = total(parts, air, **out) - total(parts, air, **clean)
    assert loads("flap", air, **clean, flap_lift=0.12, flap_drag=0.01) == pytest.approx(
        want, abs=1e-10
    )


@pytest.mark.parametrize(
    ("name", "K", "expected"),
    [
        ("thrust_loss", {"thrust_lost": 0.2}, -0.55),  # a fifth of 5.5 * 0.5
        ("thrust_loss", {"thrust_lost": 1.0}, -2.75),  # all of it
        ("battery_sag", {"sag": 0.2}, -0.275),  # a tenth after half a minute
    ],
)
def test_lost_thrust_by_hand(name, K, expected):
    """Thrust is (9 - 0.5 * 7) / 2 = 2.75 m/s^2 at half throttle and 7 m/s."""
    found = loads(name, flow(**FROM_BELOW, throttle=0.5, time=30.0), **THRUST, **K)
    assert found == pytest.approx((expected, 0.0, 0.0, 0.0, 0.0, 0.0), abs=1e-3)
    assert loads(name, flow(throttle=0.0, time=30.0), **THRUST, **K) == pytest.approx(
        np.zeros(6), abs=1e-12
    )


@pytest.mark.parametrize(
    ("name", "K"), [("thrust_loss", {"thrust_lost": 0.2}), ("battery_sag", {"sag": 0.4})]
)
def test_a_weak_propeller_gives_less_of_all_its_loads(name, K):
    """By hand at 7 m/s and half throttle: T/m = (9 - 3.5) 0.5 + 8 0.25 = 4.75 with the curve, and
    0.4 T = 1.9 of torque; a fifth of both is lost, of the battery's after half a minute.
    """
    model = rates_model().with_terms(terms.THRUST_CURVE)
    model = model.with_effect(EFFECTS["propeller_torque"]).with_effect(EFFECTS[name])
    values = {**THRUST, "kTT": 8.0, "torque_roll": 0.4, "torque_yaw": 0.0, **K}
    lost = model.terms[-1].evaluate(flow(7.0, throttle=0.5, time=30.0), model.with_values(values).K)
    assert lost == pytest.approx((-0.95, 0.0, 0.0, -0.38, 0.0, 0.0), abs=1e-3)
    assert not model.terms[-1].of_propeller


def test_a_full_battery_sags_not():
    """At the start of the flight nothing is lost yet."""
    assert loads("battery_sag", flow(throttle=0.5, time=0.0), sag=0.5) == pytest.approx(
        np.zeros(6), abs=1e-12
    )


def test_mass_change_by_hand():
    """A quarter more mass takes a fifth of each force: of lift 9.80, drag 49 (0.02 + 0.5 * 0.2^2) =
    1.96, thrust 2.75; the rest of the nose's forces is -0.2 (2.75 - 1.96) = -0.158, lift loses
    1.96.
    """
    K = {"cL_0": 0.2, "cD_0": 0.02, "cD_induced": 0.5, "mass_added": 0.25}
    found = loads("mass_change", flow(throttle=0.5), **THRUST, **K)
    assert found == pytest.approx((-0.158, 0.0, 1.960, 0.0, 0.0, 0.0), abs=2e-3)


@pytest.mark.parametrize("added", [-0.2, 0.5])
def test_newton_with_another_mass(added):
    """The law: force over mass. All forces of the model together shrink by 1 / (1 + mu), moments
    are left alone.
    """
    air, parts = flows_at_random(), [term.evaluate for term in terms.FORCES]
    K = {"cL_de": 0.1, "cY_dr": 0.2}
    whole = total(parts, air, **K)
    found = whole + loads("mass_change", air, **K, mass_added=added)
    assert found == pytest.approx(whole / (1.0 + added), abs=1e-10)


def test_stall_by_hand():
    """u = 8, w = 6: alpha = 0.6435, far beyond 0.2: 0.5 * 1.4 * 0.4435 = 0.31045 is lost, times
    100.01 31.05 m/s^2. Lift leans 0.6 forward and 0.8 up, so nose -18.63, belly +24.84; drag 31.05
    * 0.75 takes 18.63 and 13.97 more.
    """
    found = loads("stall", flow(u=8.0, w=6.0), cL_alpha=1.4, stall_alpha=0.2, stall_loss=0.5)
    assert found == pytest.approx((-37.26, 0.0, 10.87, 0.0, 0.0, 0.0), abs=0.02)


def test_a_stall_begins_smoothly():
    """At the angle itself the step of 2 deg has passed ln 2: 0.035 ln 2 * 1.4 * 0.5 * 49 = 0.832; 8
    deg below (four steps) exp(-4) of a step is left.
    """
    K = {"cL_alpha": 1.4, "stall_loss": 0.5}
    at = flow(u=7.0 * np.cos(0.2), w=7.0 * np.sin(0.2))
    found = loads("stall", at, **K, stall_alpha=0.2)
    assert np.hypot(found[0], found[2]) == pytest.approx(
        0.832 / np.cos(0.2), rel=2e-3
    )  # lift and drag tan(alpha)
    below = loads("stall", at, **K, stall_alpha=0.34)
    assert np.hypot(below[0], below[2]) < 0.03 * np.hypot(found[0], found[2])


# Moments
# --------------------------------------------------------------------------------------------------


def test_propeller_torque_goes_with_thrust():
    """2.75 m/s^2 of thrust times -0.4 and 0.2 1/m."""
    found = loads(
        "propeller_torque",
        flow(**FROM_BELOW, throttle=0.5),
        **THRUST,
        torque_roll=-0.4,
        torque_yaw=0.2,
    )
    assert found == pytest.approx((0.0, 0.0, 0.0, -1.10, 0.0, 0.55), abs=1e-3)


def test_adverse_yaw_by_hand():
    """Stick to the right, nose to the left: -49.01 * 0.02 * 0.5."""
    found = loads("adverse_yaw", flow(**FROM_BELOW, aileron=0.5), adverse_yaw=0.02)
    assert found == pytest.approx((0.0, 0.0, 0.0, 0.0, 0.0, -0.490), abs=1e-3)


def test_aileron_loss_by_hand():
    """Two fifths of 49.01 * 0.75 * 0.5 = 18.38 are gone; at a loss of one nothing is left."""
    found = loads("aileron_loss", flow(aileron=0.5), L_da=0.75, aileron_lost=0.4)
    assert found == pytest.approx((0.0, 0.0, 0.0, -7.352, 0.0, 0.0), abs=1e-3)
    alone = {"L_0": 0.0, "L_beta": 0.0, "L_p": 0.0, "L_r": 0.0, "L_da": 0.75}
    rest = total([terms.roll_moment], flow(aileron=0.5), **alone) + loads(
        "aileron_loss", flow(aileron=0.5), L_da=0.75, aileron_lost=1.0
    )
    assert rest == pytest.approx(np.zeros(6), abs=1e-12)


def test_cg_shift_is_a_lever_over_two_inertias():
    """0.15 kg, Ixx, Iyy, Izz = 2, 3, 4.5 g m^2, mass 2 cm behind: lift turns with 0.15 * 0.02 /
    0.003 = 1 of L/m, side force with 0.003 / 0.0045 = 2/3 of Y/m. L/m = 49.01 (0.2 + 0.1 * 0.5),
    Y/m = 49.01 (0.4 * 0.4) [m/s^2].
    """
    Ixx, Iyy, Izz = 2e-3, 3e-3, 4.5e-3
    K = {
        "Jy": (Izz - Ixx) / Iyy,
        "Jz": (Ixx - Iyy) / Izz,
        "cL_0": 0.2,
        "cL_de": 0.1,
        "cY_beta": 0.0,
        "cY_dr": 0.4,
    }
    found = loads(
        "cg_shift",
        flow(**FROM_THE_RIGHT, elevator=0.5, rudder=0.4),
        **K,
        cg_moment=0.15 * 0.02 / Iyy,
    )
    assert found == pytest.approx((0.0, 0.0, 0.0, 0.0, 12.25, 5.228), abs=5e-3)


def coupled(name, air, **K):
    """(6,) of the effect in a model with cross moments, at one flow."""
    model = rates_model().with_terms(CROSS_MOMENTS).with_effect(EFFECTS[name]).with_values(K)
    return np.array(EFFECTS[name].term(model.terms[:-1]).evaluate(air, model.K), dtype=float)


def test_a_product_of_inertia_turns_yawing_moments_into_roll():
    """The rigid body itself: moments (0, m, n) of drag on a wing, of aileron and of a shifted mass
    give (dp/dt, dq/dt, dr/dt) = J^-1 (0, m, n), J of the Skywalker X8 [Gryte et al. 2018]. The
    model has J by its Gammas alone [Beard & McLain, eq. 3.13].
    """
    Jx, Jy, Jz, Jxz = 1.229, 0.1702, 0.8808, 0.9343
    inertia = np.array([[Jx, 0.0, -Jxz], [0.0, Jy, 0.0], [-Jxz, 0.0, Jz]])
    det = Jx * Jz - Jxz**2
    K = {
        "Jx": -(Jz * (Jz - Jy) + Jxz**2) / det,
        "Jy": (Jz - Jx) / Jy,
        "Jz": ((Jx - Jy) * Jx + Jxz**2) / det,
        "Gamma_1": Jxz * (Jx - Jy + Jz) / det,
        "Gamma_6": Jxz / Jy,
    }
    air = flow(u=18.0, v=2.0, w=1.0, aileron=0.3)
    for name, own, moment in (
        ("wing_drag", {"wing_drag": 0.0, "wing_drag_yaw": 0.01}, [0.0, 0.0, 1.0]),
        ("adverse_yaw", {"adverse_yaw": 0.02}, [0.0, 0.0, -1.0]),
    ):
        found, turned = coupled(name, air, **K, **own)[3:], np.linalg.solve(inertia, moment)
        assert found / found[2] == pytest.approx(turned / turned[2], abs=1e-9)
        assert found[2] * turned[2] > 0.0
    # A mass behind by d: lift and side force, per mass, at that lever.
    lever = 0.05 / Jy
    found = coupled("cg_shift", air, **K, cg_moment=lever)[3:]
    model = rates_model().with_values({k: v for k, v in K.items() if not k.startswith("Gamma")})
    lift = air.airspeed**2 * terms.lift_coefficient(air, model.K)
    side = air.airspeed**2 * (model.K.cY_beta * air.beta + model.K.cY_dr * air.rudder)
    expected = np.linalg.solve(inertia, [0.0, 0.05 * lift, 0.05 * side])
    assert found == pytest.approx(expected, rel=1e-9)


def test_aileron_lost_takes_its_yawing_moment_along():
    """Two fifths of 324 * (0.1, 0.15) * 0.3, and as much of full deflection: nothing is left."""
    K = {"L_da": 0.10, "N_da": 0.15}
    found = coupled("aileron_loss", flow(u=18.0, aileron=0.3), **K, aileron_lost=0.4)
    assert found == pytest.approx((0.0, 0.0, 0.0, -3.888, 0.0, -5.832), abs=1e-3)


def test_wing_drag_by_hand():
    """49.01 * 0.01 against the flight, and 49.01 * 0.06 to the right."""
    found = loads("wing_drag", flow(), wing_drag=0.01, wing_drag_yaw=0.06)
    assert found == pytest.approx((-0.490, 0.0, 0.0, 0.0, 0.0, 2.941), abs=2e-3)


def test_mass_behind_makes_less_stable():
    """A pilot knows: tail-heavy, more angle of attack raises the nose, and wind from the right
    turns it left, away.
    """
    K = {"cg_moment": 0.5}
    raised = loads("cg_shift", flow(w=1.0), **K)[4] - loads("cg_shift", flow(), **K)[4]
    turned = loads("cg_shift", flow(v=1.0), **K)[5] - loads("cg_shift", flow(), **K)[5]
    assert raised > 0.5 and turned < -0.5


# Sticks, servos and camera
# ----------------------------------------------------------------------------------------


def test_trim_bias_moves_each_stick_by_its_own():
    """By adding; the throttle has no neutral."""
    K = SimpleNamespace(bias_aileron=0.1, bias_elevator=-0.2, bias_rudder=0.05)
    found = EFFECTS["trim_bias"].command_map(TIMES[:1], np.array([[0.4, 0.2, 0.2, 0.2]]), K)
    assert found == pytest.approx(np.array([[0.4, 0.3, 0.0, 0.25]]), abs=1e-12)


def test_a_deadband_swallows_small_sticks_only():
    """Within half of the band less than 1 % passes, beyond one and a half all but 1 %, unshifted,
    to either side; at its edge a half by definition. The throttle has no band.
    """
    K = SimpleNamespace(deadband=0.1)
    pass_of = DEAD_BAND.command_map
    small, large = np.array([[0.03, 0.05, -0.05, 0.02]]), np.array([[0.03, 0.15, -0.4, 1.0]])
    assert pass_of(TIMES[:1], small, K) == pytest.approx(
        np.array([[0.03, 0.0, 0.0, 0.0]]), abs=0.01 * 0.05
    )
    assert pass_of(TIMES[:1], large, K) == pytest.approx(large, rel=0.01)
    assert pass_of(TIMES[:1], np.full((1, 4), 0.1), K)[0, 1:] == pytest.approx(
        np.full(3, 0.05), abs=1e-6
    )


def test_a_dead_zone_takes_its_size_from_every_stick():
    """By hand: 0.3 - 0.1, -(0.4 - 0.1), nothing of 0.05; the throttle has none, and without a size
    everything passes.
    """
    sticks = np.array([[0.03, 0.3, -0.4, 0.05]])
    pass_of = DEAD_ZONE.command_map
    assert pass_of(TIMES[:1], sticks, SimpleNamespace(dead_zone=0.1)) == pytest.approx(
        np.array([[0.03, 0.2, -0.3, 0.0]]), abs=1e-12
    )
    assert pass_of(TIMES[:1], sticks, SimpleNamespace(dead_zone=0.0)) == pytest.approx(sticks)


@pytest.mark.parametrize(
    ("effect", "K", "plain"),
    [
        (EFFECTS["control_delay"], {"delay": 0.02, "control_delay": 0.05}, {"delay": 0.07}),
        (EFFECTS["control_delay"], {"delay": 0.07, "control_delay": -0.05}, {"delay": 0.02}),
        (
            EFFECTS["control_delay"],
            {"delay": 0.02, "control_delay": -0.05},
            {"delay": 0.0},
        ),  # not before it was commanded
        (SERVO, {"lag": 0.03, "actuator_lag": 0.1}, {"lag": 0.13}),
    ],
)
def test_delay_and_lag_add_to_those_of_the_model(effect, K, plain):
    """By meaning of the words: the same sticks as of an aircraft with the sum, to rounding of the
    sum.
    """
    model, base = rates_model().with_effect(effect), rates_model()
    found = np.stack(model.actuator_positions(TIMES, STICKS, EDGES, model.with_values(K).K))
    assert found == pytest.approx(
        np.stack(base.actuator_positions(TIMES, STICKS, EDGES, base.with_values(plain).K)), abs=1e-9
    )


def test_what_follows_the_servo_is_slow_after_it():
    """Sticks jump by one at 1 s; servo 50 ms and linkage 50 ms in series: after 2 lags 1 - 3
    exp(-2) = 0.594 is reached, where a single lag of 100 ms reached 1 - exp(-1) = 0.632. Steps of 5
    ms end within 0.01 of that.
    """
    model = rates_model().with_effect(LINKAGE)
    t, commands, edges = (
        np.array([0.0, 1.0]),
        np.array([[0.0] * 4, [1.0] * 4]),
        np.arange(0.0, 1.5, 0.005),
    )
    K = model.with_values({"delay": 0.0, "lag": 0.05, "lag_in_series": 0.05}).K
    mean, slope = model.actuator_positions(t, commands, edges, K)
    assert (mean + slope)[np.searchsorted(edges, 1.0999) - 1, 1] == pytest.approx(
        1.0 - 3.0 * np.exp(-2.0), abs=0.01
    )


def test_a_camera_tilt_turns_the_picture_alone():
    """It acts on measured poses, so that no load, wind or stick knows of it; up and about the nose,
    to either side.
    """
    tilt = next(e for e in CATALOGUE if e.name == "camera_tilt")
    assert tilt.measurement_map and [p.name for p in tilt.parameters] == ["tilt_pitch", "tilt_roll"]
    assert all(p.low == -p.high and p.unit == "rad" for p in tilt.parameters)
    measured = {e.name for e in CATALOGUE if e.measurement_map}
    assert measured == {"camera_tilt", "camera_offset"}
    assert rates_model().with_effect(tilt).terms == rates_model().terms


def test_a_small_camera_tilt_is_the_exact_rotation():
    """To second order of 0.02 rad, banked and pitched by a fifth: 4e-4 times some ones."""
    K = SimpleNamespace(tilt_pitch=0.02, tilt_roll=-0.015)
    pose = np.array([1.0, 2.0, 3.0, 0.2, -0.15, 1.0])[:, None]
    tilt = next(e for e in CATALOGUE if e.name == "camera_tilt")
    linear, exact = tilt.measurement_map(pose, K), tilt.hidden_map(pose, K)
    assert np.array_equal(linear[:3], exact[:3])
    assert linear == pytest.approx(exact, abs=4e-4)
    assert np.abs(linear - pose)[3:].max() > 0.01


@pytest.fixture(scope="module")
def three_windows():
    """6 s of a simulated flight of the 12-state model."""
    rng, model = np.random.default_rng(8), rates_model()
    table = measured(fly_figure_eights([model], 6.5, rng), rng)
    return cut_windows(prepare(table).flights, model)


@pytest.mark.parametrize(
    "effect",
    [e for e in CATALOGUE if not e.same_as],  # a late stamp changes no model
    ids=lambda e: f"{e.name}-{e.parameters[0].name}",
)
def test_a_standing_effect_is_the_effect_under_other_names(effect, three_windows):
    """The same flight with the effect and with the standing one of the same size, another one than
    without; with both, no name is used twice.
    """
    standing, start = standing_effect(effect), three_windows.initial_guess
    values = {p.name: p.start for p in effect.parameters}
    with_effect = rates_model().with_effect(effect).with_values(values)
    with_standing = rates_model().with_effect(standing)
    with_standing = with_standing.with_values({STANDING + n: v for n, v in values.items()})
    flown = [residuals(m, three_windows, start) for m in (with_effect, with_standing)]
    np.testing.assert_allclose(flown[0], flown[1], rtol=1e-9, atol=1e-9)
    assert not np.allclose(flown[0], residuals(rates_model(), three_windows, start), atol=1e-6)
    both = with_effect.with_effect(standing)
    assert len(set(both.names)) == len(both.names)


def test_a_stream_outdoors_is_looked_for_at_the_size_of_the_area_flown():
    """By hand: over 240 x 120 m a grid of 7 x 4 centres, 240 / 6 = 40 m apart and as wide; in a
    hall none. At one radius from its centre exp(-1/2) of it blows.
    """
    wide, _ = (effect for effect in CATALOGUE if effect.name == "fan_jet")
    points = wide.scan(np.array([-100.0, 0.0]), np.array([140.0, 120.0]))
    assert len(points) == 28 and {p["stream_radius"] for p in points} == {40.0}
    assert {p["stream_at_x"] for p in points} == {-100.0, -60.0, -20.0, 20.0, 60.0, 100.0, 140.0}
    assert {p["stream_at_y"] for p in points} == {0.0, 40.0, 80.0, 120.0}
    assert wide.scan(np.array([-16.0, -8.0]), np.array([16.0, 8.0])) == []
    K = SimpleNamespace(
        stream_x=4.0, stream_y=-2.0, stream_at_x=10.0, stream_at_y=20.0, stream_radius=40.0
    )
    x, y, z = wide.wind_field(10.0, 60.0, 0.0, 0.0, K)
    assert (x, y, z) == pytest.approx((4.0 * np.exp(-0.5), -2.0 * np.exp(-0.5), 0.0))
