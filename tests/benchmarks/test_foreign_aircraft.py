"""The foreign simulator against laws and hand calculations: gravity, momentum, energy, mirrors."""

import numpy as np
import pytest

from falconwing_kit.core.frames import rotation_world_body
from tests.benchmarks.foreign_aircraft import (
    AEROSONDE,
    AIRPLANES,
    CALM,
    GRAVITY,
    LINKAGE,
    NAVION,
    POSITION,
    RATES,
    SERVO,
    VELOCITY,
    X8,
    Airplane,
    Array,
    Hidden,
    advance,
    derivative,
    interpolate,
    kit_states,
    level_state,
    redrawn,
    table_of,
    trim_level,
)

STILL = np.zeros(3)


def fly(
    airplane: Airplane, start: Array, commands: Array, seconds: float, hidden: Hidden = CALM,
    wind: Array = STILL, step: float = 0.005,
) -> Array:  # fmt: skip
    """(N, STATES) with commands (4,) held, or (N - 1, 4) one for each step."""
    tables, state, states = table_of(airplane), start.copy(), [start]
    steps = round(seconds / step)
    held = np.broadcast_to(commands, (steps, 4))
    for k in range(steps):
        state = advance(
            state,
            held[k].copy(),
            airplane.body,
            hidden,
            tables,
            airplane.grid,
            wind,
            k * step,
            step,
        )
        states.append(state)
    return np.array(states)


def weightless_air(airplane: Airplane) -> Airplane:
    """The same body where there is no air."""
    return Airplane(airplane.body._replace(rho=1e-12), airplane.speed, airplane.bank, "no air")


def trimmed(airplane: Airplane) -> tuple[Array, Array]:
    """Start state and commands of level flight 100 m up."""
    trim = trim_level(airplane, airplane.speed)
    commands = np.array([trim.throttle, 0.0, trim.elevator, 0.0])
    start = level_state(trim.alpha, airplane.speed, commands)
    start[2] = -100.0
    return start, commands


def acceleration(airplane: Airplane, state: Array, hidden: Hidden = CALM) -> Array:
    """Rates of the state with the servos at rest."""
    out: Array = derivative(
        state,
        state[SERVO].copy(),
        airplane.body,
        hidden,
        table_of(airplane),
        airplane.grid,
        STILL,
        0.0,
    )
    return out


def test_without_air_it_falls_like_a_stone():
    """p = p0 + v t + g t^2 / 2, for 2 s."""
    start, commands = trimmed(AEROSONDE)
    start[RATES] = 0.3, -0.4, 0.5
    states = fly(weightless_air(AEROSONDE), start, commands, 2.0)
    _, angles = kit_states(start[None])
    v_ned = np.diag([1, -1, -1]) @ rotation_world_body(*angles[0]) @ start[VELOCITY]
    fallen = start[POSITION] + 2.0 * v_ned + [0.0, 0.0, 0.5 * GRAVITY * 4.0]
    np.testing.assert_allclose(states[-1][POSITION], fallen, atol=1e-6)


@pytest.mark.parametrize("airplane", [AEROSONDE, X8], ids=["aerosonde", "x8"])
def test_free_rotation_keeps_angular_momentum(airplane):
    """Euler: without moments R J omega is constant; products of inertia included."""
    start, commands = trimmed(airplane)
    start[RATES] = 1.0, -0.7, 1.4
    states = fly(weightless_air(airplane), start, commands, 3.0, step=0.002)
    body = airplane.body
    J = np.array([[body.Jx, 0, -body.Jxz], [0, body.Jy, 0], [-body.Jxz, 0, body.Jz]])
    _, angles = kit_states(states)
    R_world_body = rotation_world_body(*angles.T)
    momentum = np.einsum("nij,jk,nk->ni", R_world_body, J, states[:, RATES])
    assert np.ptp(states[:, RATES], axis=0).min() > 0.3  # it does tumble
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=2e-5)


def test_level_flight_of_the_aerosonde_carries_its_weight_by_hand():
    """L + T sin(alpha) = m g, and D = T cos(alpha), with the coefficients of the printed table."""
    trim, body = trim_level(AEROSONDE, 25.0), AEROSONDE.body
    pressure_area = 0.5 * 1.2682 * 25.0**2 * 0.55
    de = -body.de_max * trim.elevator
    CL = 0.23 + 5.61 * trim.alpha + 0.13 * de
    CD = 0.043 + (0.23 + 5.61 * trim.alpha) ** 2 / (np.pi * 0.9 * 2.8956**2 / 0.55)
    CD += 0.03 * trim.alpha + 0.0135 * abs(de)
    lift, drag = pressure_area * CL, pressure_area * CD
    assert lift + trim.thrust * np.sin(trim.alpha) == pytest.approx(11.0 * 9.81, rel=1e-4)
    assert drag == pytest.approx(trim.thrust * np.cos(trim.alpha), rel=1e-4)
    assert 0.0135 - 2.74 * trim.alpha - 0.99 * de == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("name", AIRPLANES)
def test_trimmed_flight_stays_level_for_a_while(name):
    """Newton: without a net load nothing changes; propeller torque is switched off."""
    airplane = AIRPLANES[name]
    body = airplane.body._replace(torque_arm=0.0, CQ0=1e-9, CQ1=0.0, CQ2=0.0)
    if body.thrust_form == 1.0:
        body = airplane.body  # its thrust needs the torque; a second is short
    airplane = Airplane(body, airplane.speed, airplane.bank, "", airplane.tables, airplane.grid)
    start, commands = trimmed(airplane)
    states = fly(airplane, start, commands, 1.0)
    assert abs(states[-1, 2] + 100.0) < 1e-3 * airplane.speed
    assert np.linalg.norm(states[-1, VELOCITY]) == pytest.approx(airplane.speed, rel=1e-3)


def test_gliding_loses_energy_as_drag_power():
    """d(m g h + m V^2 / 2)/dt = -D V; drag by hand from the Navion's coefficients, rates small."""
    start, commands = trimmed(NAVION)
    commands[0] = start[SERVO][0] = start[LINKAGE][0] = 0.0
    start[LINKAGE.start] = start[SERVO.start] = 0.0
    states = fly(NAVION, start, commands, 4.0)
    body, V = NAVION.body, np.linalg.norm(states[:, VELOCITY], axis=1)
    alpha = np.arctan2(states[:, 9], states[:, 7])
    CD = body.CD0 + body.k * (0.41 + 4.44 * alpha) ** 2
    power = 0.5 * 1.225 * V**3 * body.wing_area * CD
    energy = body.mass * (GRAVITY * -states[:, 2] + 0.5 * V**2)
    lost = energy[0] - energy[-1]
    assert lost > 500.0
    assert lost == pytest.approx(np.trapezoid(power, dx=0.005), rel=0.01)


@pytest.mark.parametrize("name", ["zagi", "cub", "x8", "slow_flyer", "tabulated"])
def test_mirrored_sticks_fly_the_mirrored_path(name):
    """Symmetry: without propeller torque left and right are the same but for a sign."""
    airplane = AIRPLANES[name]
    airplane = Airplane(
        airplane.body._replace(torque_arm=0.0), airplane.speed, airplane.bank, "", airplane.tables,
        airplane.grid,
    )  # fmt: skip
    start, commands = trimmed(airplane)
    moved = np.tile(commands, (300, 1))
    moved[20:60, 1], moved[80:140, 3] = 0.3, 0.3
    one = fly(airplane, start, moved, 1.5)
    two = fly(airplane, start, moved * [1.0, -1.0, 1.0, -1.0], 1.5)
    assert np.abs(one[:, 1]).max() > 0.01
    p_one, angles_one = kit_states(one)
    p_two, angles_two = kit_states(two)
    # The tables are symmetric to five digits as they are kept.
    np.testing.assert_allclose(p_two, p_one * [1.0, -1.0, 1.0], atol=2e-3)
    np.testing.assert_allclose(angles_two, angles_one * [-1.0, 1.0, -1.0], atol=5e-3)


def test_steady_wind_only_carries_the_aircraft_along():
    """Galilei: in a uniform wind the flight is the one in still air plus w t."""
    wind = np.array([3.0, -2.0, 0.5])
    start, commands = trimmed(AEROSONDE)
    commands += np.array([0.0, 0.05, 0.0, 0.05])
    still = fly(AEROSONDE, start, commands, 3.0)
    carried = start.copy()
    _, angles = kit_states(start[None])
    carried[VELOCITY] += (np.diag([1, -1, -1]) @ rotation_world_body(*angles[0])).T @ wind
    blown = fly(AEROSONDE, carried, commands, 3.0, wind=wind)
    np.testing.assert_allclose(blown[-1, POSITION], still[-1, POSITION] + 3.0 * wind, atol=1e-6)


def test_commands_move_the_aircraft_the_way_the_kit_says():
    """Kit: aileron right wing down, elevator nose up, rudder nose right; textbook by hand:
    dp/dt = q S b C_l_da da Jz / (Jx Jz - Jxz^2) + ...
    """
    start, _ = trimmed(AEROSONDE)
    base = acceleration(AEROSONDE, start)
    for stick, rate in ((1, 10), (2, 11), (3, 12)):
        moved = start.copy()
        moved[LINKAGE.start + stick] += 0.1
        change = acceleration(AEROSONDE, moved)[rate] - base[rate]
        assert change > 0.1
    moved = start.copy()
    moved[LINKAGE.start + 1] += 0.1
    roll, yaw = 0.17 * 0.035, -0.011 * 0.035
    by_hand = (1.759 * roll + 0.1204 * yaw) / (0.8244 * 1.759 - 0.1204**2)
    by_hand *= 0.5 * 1.2682 * 25.0**2 * 0.55 * 2.8956
    assert acceleration(AEROSONDE, moved)[10] - base[10] == pytest.approx(by_hand, rel=1e-6)


def test_halving_the_step_changes_little():
    """Fourth order: at the flights' step of 8 ms the Aerosonde's place is right to a millimetre."""
    start, commands = trimmed(AEROSONDE)
    commands += np.array([0.0, 0.1, 0.05, 0.1])
    coarse, fine = (fly(AEROSONDE, start, commands, 2.0, step=step) for step in (0.008, 0.004))
    np.testing.assert_allclose(coarse[-1, POSITION], fine[-1, POSITION], atol=1e-3)


def test_a_servo_and_a_linkage_answer_as_two_lags():
    """x = 1 - (a e^(-t/a) - b e^(-t/b)) / (a - b) for time constants a, b."""
    start, commands = trimmed(AEROSONDE)
    start[LINKAGE.start + 1] = start[SERVO.start + 1] = 0.0
    commands[1] = 0.2
    t, a, b = 0.1, AEROSONDE.body.servo, 0.12
    states = fly(AEROSONDE, start, commands, t, CALM._replace(linkage=b))
    two = 1.0 - (a * np.exp(-t / a) - b * np.exp(-t / b)) / (a - b)
    assert states[-1, LINKAGE.start + 1] == pytest.approx(0.2 * two, rel=1e-4)
    assert states[-1, SERVO.start + 1] == pytest.approx(0.2 * (1.0 - np.exp(-t / a)), rel=1e-4)


def test_tables_give_their_nodes_and_means_between():
    """Bilinear by definition."""
    airplane = AIRPLANES["tabulated"]
    tables, grid = table_of(airplane), airplane.grid
    at = grid[0] + 4 * grid[1], grid[2] + 3 * grid[3]
    np.testing.assert_allclose(interpolate(tables, grid, *at), tables[4, 3], atol=1e-12)
    between = interpolate(tables, grid, at[0] + 0.5 * grid[1], at[1])
    np.testing.assert_allclose(between, 0.5 * (tables[4, 3] + tables[5, 3]), atol=1e-12)


# What is hidden
# --------------------------------------------------------------------------------------------------


def test_hidden_loads_are_what_their_names_say_by_hand():
    """Each by hand at trim: -q S dCD / m along the path, x F for the centre of gravity, ..."""
    start, _ = trimmed(NAVION)
    body, V = NAVION.body, NAVION.speed
    trim = trim_level(NAVION, V)
    area = 0.5 * 1.225 * V**2 * body.wing_area
    base = acceleration(NAVION, start)
    along = np.array([np.cos(trim.alpha), 0.0, np.sin(trim.alpha)])

    def change(**hidden: float) -> Array:
        return acceleration(NAVION, start, CALM._replace(V_trim=V, **hidden)) - base

    assert change(CD_added=0.02)[VELOCITY] @ along == pytest.approx(-area * 0.02 / 25.0, rel=1e-6)
    across = np.array([np.sin(trim.alpha), 0.0, -np.cos(trim.alpha)])
    assert change(CL_added=0.1)[VELOCITY] @ across == pytest.approx(area * 0.1 / 25.0, rel=1e-6)
    assert change(thrust_lost=0.3)[7] == pytest.approx(-0.3 * trim.thrust / 25.0, rel=1e-6)
    # 25 % more mass: forces of 1 g in sum accelerate by a fifth less, so it sinks with g / 5
    assert change(mass_added=0.25)[VELOCITY] @ -across == pytest.approx(GRAVITY / 5.0, rel=2e-2)
    lift = area * trim.CL * np.cos(trim.alpha) + area * trim.CD * np.sin(trim.alpha)
    assert change(cg_back=0.01)[11] == pytest.approx(0.01 * lift / body.Jy, rel=1e-3)
    assert change(torque_roll=0.05)[10] == pytest.approx(0.05 * trim.thrust / body.Jx, rel=1e-6)
    assert change(torque_yaw=-0.05)[12] == pytest.approx(-0.05 * trim.thrust / body.Jz, rel=1e-6)
    assert change(thrust_line=0.02)[11] == pytest.approx(0.02 * trim.thrust / body.Jy, rel=1e-6)
    right = change(wing_drag=0.04)
    assert right[VELOCITY] @ along == pytest.approx(-area * 0.02 / 25.0, rel=1e-6)
    assert right[12] == pytest.approx(area * 0.02 * 0.25 * body.span / body.Jz, rel=1e-6)


def test_a_lost_aileron_does_not_roll():
    """All of it lost: full stick and none give the same rates of turning."""
    start, _ = trimmed(NAVION)
    moved = start.copy()
    moved[LINKAGE.start + 1] = 1.0
    gone = CALM._replace(aileron_lost=1.0)
    with_stick, without = acceleration(NAVION, moved, gone), acceleration(NAVION, start, gone)
    np.testing.assert_allclose(with_stick[RATES], without[RATES], atol=1e-9)


def test_an_onset_changes_nothing_before_it():
    """Causality: identical until the onset, different after."""
    start, commands = trimmed(NAVION)
    with_it = fly(NAVION, start, commands, 1.0, CALM._replace(CD_added=0.05, onset=0.5))
    without = fly(NAVION, start, commands, 1.0)
    np.testing.assert_array_equal(with_it[:100], without[:100])
    assert with_it[-1, 7] < without[-1, 7] - 0.01


def test_the_ground_carries_and_the_height_of_a_span_does_not():
    """Wieselsberger: at h/b = 0.2 a share exp(-2.48 0.4^0.768) = 0.29 of the induced drag is gone,
    at h/b = 1.5 two hundredths of one.
    """
    start, _ = trimmed(NAVION)
    body, trim = NAVION.body, trim_level(NAVION, NAVION.speed)
    area = 0.5 * 1.225 * NAVION.speed**2 * body.wing_area
    low, high = start.copy(), start.copy()
    low[2], high[2] = -0.2 * body.span, -1.5 * body.span
    ground = CALM._replace(image_vortex=1.0)
    along = np.array([np.cos(trim.alpha), 0.0, np.sin(trim.alpha)])
    gained = [
        (acceleration(NAVION, s, ground) - acceleration(NAVION, s))[VELOCITY] @ along
        for s in (low, high)
    ]
    attached = 0.41 + 4.44 * trim.alpha
    expected = 0.293 * body.k * attached**2 * area / body.mass
    assert gained[0] == pytest.approx(expected, rel=0.01)
    assert 0.0 < gained[1] < 0.02 * gained[0]


def test_redrawn_aircraft_differ_by_the_spread_and_keep_their_sizes():
    """The logarithms of 200 drawn coefficients have the asked standard deviation."""
    rng = np.random.default_rng(5)
    drawn = [redrawn(AEROSONDE, rng, 0.12).body for _ in range(200)]
    spread = np.std([np.log(b.Cma / AEROSONDE.body.Cma) for b in drawn])
    assert spread == pytest.approx(0.12, rel=0.2)
    assert {b.span for b in drawn} == {AEROSONDE.body.span}
    assert all(b.Jx * b.Jz > b.Jxz**2 for b in drawn)
