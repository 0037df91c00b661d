"""Simulated world: delayed commands, paired noise, filtered velocities, contacts."""

import math

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.world import PoseFilter, PoseNoise, SimulatedWorld

AIRFRAME, STEADY = load_airframe(), trim(rates_model(), 7.0)
LEVEL = Command.clip(*STEADY.command)
SILENT = PoseNoise(0.0, 0.0)


def cruising(p_world, **changed):
    """The trimmed state at a position, with some numbers changed by name."""
    x = STEADY.state.copy()
    x[:3] = p_world
    for name, value in changed.items():
        x[("px", "py", "pz", "pitch", "yaw", "roll", "vx", "vy", "vz").index(name)] = value
    return State.from_vector(x)


def flown(world, command=LEVEL, seconds=1.0):
    """The world after some seconds of one command at 20 Hz, and the measured states (n, 12)."""
    measured = [world.measured().vector]
    for k in range(round(seconds / 0.05)):
        world.send(world.t, command)
        world.advance((k + 1) * 0.05)
        measured.append(world.measured().vector)
    return world, np.array(measured)


class Standing:
    """A leader at a fixed position in the air."""

    def __init__(self, p_world):
        self.p_world = np.array(p_world)

    def state_at(self, t):
        return State.from_vector(np.concatenate([self.p_world, np.zeros(6)]))


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.1])
def test_a_command_acts_after_the_delay(delay):
    """Full aileron at 0.5 s: motion only after delay + the model's own 0.02 s, and right then."""
    world = SimulatedWorld(rates_model(), AIRFRAME, cruising((0.0, -2.0, 2.0)), seed=1, delay=delay)
    flown(world, seconds=0.5)
    world.send(world.t, Command(LEVEL.throttle, 1.0, LEVEL.elevator, 0.0))
    world.advance(0.5 + delay + 0.02)
    assert abs(world.state.rates_body[0]) < 1e-3
    world.advance(0.5 + delay + 0.02 + 0.03)
    assert world.state.rates_body[0] > 0.1


def test_noise_depends_on_seed_and_frame_alone():
    """Two pilots, one seed: the same errors of the measured pose. Another seed: others."""
    errors = []
    for seed, throttle in ((7, 0.2), (7, 0.9), (8, 0.2)):
        world = SimulatedWorld(rates_model(), AIRFRAME, cruising((-10.0, -2.0, 3.0)), seed=seed)
        rows = []
        for k in range(10):
            world.send(world.t, Command(throttle, 0.1, 0.0, 0.0))
            world.advance((k + 1) * 0.05)
            rows.append(world.measured().vector[:6] - world.state.vector[:6])
        errors.append(np.array(rows))
    assert errors[0] == pytest.approx(errors[1], abs=1e-12)
    assert np.abs(errors[0] - errors[2]).max() > 1e-3


def test_measured_pose_has_the_given_noise():
    """Standard deviation of 600 numbers per kind within 10 % (three sigma of it are 9 %)."""
    noise = PoseNoise(position=0.02, attitude=math.radians(1.0))
    errors = []
    for seed in range(10):
        world = SimulatedWorld(
            rates_model(), AIRFRAME, cruising((-10.0, -2.0, 2.0)), seed=seed, noise=noise
        )
        for k in range(20):
            world.send(world.t, LEVEL)
            world.advance((k + 1) * 0.05)
            errors.append(world.measured().vector[:6] - world.state.vector[:6])
    errors = np.array(errors)
    assert errors[:, :3].std() == pytest.approx(0.02, rel=0.1)
    assert errors[:, 3:].std() == pytest.approx(math.radians(1.0), rel=0.1)


def test_estimated_velocities_beat_differences_of_poses():
    """Differences of white noise: sqrt(2) sigma / 0.05 s = 0.28 m/s at 1 cm, 0.35 rad/s at 0.7 deg.
    In level flight the filter is better by a third, from the start on, because it ran before.
    """
    errors = []
    for seed in range(10):
        world, measured = flown(
            SimulatedWorld(rates_model(), AIRFRAME, cruising((-10.0, -2.0, 2.0)), seed=seed)
        )
        errors.append(measured[:, 6:] - STEADY.state[6:])
        assert world.state.vector[6:] == pytest.approx(STEADY.state[6:], abs=1e-6)
    rms, first = (
        np.sqrt(np.mean(np.square(errors), axis=(0, 1))),
        np.sqrt(np.mean(np.square(errors)[:, 0], axis=0)),
    )
    assert (rms[:3] < 0.19).all() and (rms[3:] < 0.23).all()
    assert (first < 2.5 * rms).all()


def test_filter_follows_a_parabola_and_a_yaw_beyond_half_a_turn():
    """A filter of white jerk has no steady error at constant acceleration; yaw passes pi at 2
    rad/s.
    """
    follow = PoseFilter(PoseNoise())
    for t in np.arange(0.0, 4.0, 0.05):
        state = follow.update(
            t, np.array([t * t, 7.0 * t, 2.0, 0.0, 0.0, (2.0 * t + np.pi) % (2.0 * np.pi) - np.pi])
        )
    assert state.v_world == pytest.approx([2.0 * t, 7.0, 0.0], abs=1e-2)
    assert state.rates_body == pytest.approx([0.0, 0.0, 2.0], abs=1e-2)


@pytest.mark.parametrize(
    ("start", "obstacle"),
    [
        (cruising((3.0, -2.0, 0.4), vz=-2.0), "pad"),
        (cruising((-9.0, -2.0, 0.4), vz=-2.0), "floor"),
        (cruising((0.5, -2.0, 0.19)), "pad edge"),
        (cruising((15.0, -2.0, 2.0)), "wall"),
        (cruising((-9.0, 7.5, 2.0), vy=4.0), "wall"),
        (cruising((-9.0, -2.0, 4.45), vz=3.0), "ceiling"),
    ],
)
def test_a_contact_ends_the_flight(start, obstacle):
    """By hand: pad 1..14 m and 0.1 m high, walls of the hall, beams at 4.65 m."""
    world, _ = flown(SimulatedWorld(rates_model(), AIRFRAME, start, seed=1, pad=LandingPad()))
    assert world.contact.obstacle == obstacle
    assert (world.contact.touchdown is None) == (obstacle in ("wall", "ceiling"))
    at_contact = world.state
    world.advance(world.t + 1.0)
    assert world.state.vector == pytest.approx(at_contact.vector) and world.contact.t <= 1.0


@pytest.mark.parametrize("sink", [-1.0, -4.0], ids=["slowly", "within a step"])
@pytest.mark.parametrize(("x", "obstacle"), [(3.0, "pad"), (-9.0, "floor")])
@pytest.mark.parametrize(
    "attitude", [{"roll": 45.0}, {"roll": -45.0}, {"pitch": -60.0}, {"pitch": 75.0}], ids=str
)
def test_a_wing_tip_nose_or_tail_that_touches_first_is_no_landing(attitude, x, obstacle, sink):
    """Depth below the centre of gravity, by hand: at 45 deg of bank a tip 0.25 m and a wheel 0.13;
    60 deg nose down the nose 0.17 and a main wheel 0.10; 75 deg nose up the tail 0.309 and its
    wheel 0.300. At 4 m/s a step is 0.2 m.
    """
    depth = {-60.0: 0.173, 75.0: 0.309}.get(attitude.get("pitch"), 0.247)
    angles = {"pitch": 0.0} | {name: math.radians(degrees) for name, degrees in attitude.items()}
    start = cruising((x, -2.0, 0.1 * (obstacle == "pad") + depth + 0.02), vx=1.0, vz=sink, **angles)
    world, _ = flown(
        SimulatedWorld(rates_model(), AIRFRAME, start, seed=1, pad=LandingPad()), seconds=0.2
    )
    assert (world.contact.obstacle, world.contact.touchdown) == (obstacle, None)


def test_a_wing_tip_hits_the_side_of_the_pad():
    """Left tip 15 deg down at 0.08 m near the edge at y = -3: pad 0.1 m high, wheels 4 cm up."""
    start = cruising((3.0, -3.44, 0.17), roll=math.radians(-15.0), vy=4.0, vz=0.0)
    world, _ = flown(
        SimulatedWorld(rates_model(), AIRFRAME, start, seed=1, pad=LandingPad()), seconds=0.2
    )
    assert (world.contact.obstacle, world.contact.touchdown) == ("pad edge", None)


def test_no_pad_is_bare_floor():
    """The same descent at the pad's place ends lower."""
    world, _ = flown(
        SimulatedWorld(rates_model(), AIRFRAME, cruising((3.0, -2.0, 0.4), vz=-2.0), seed=1)
    )
    assert world.contact.obstacle == "floor"
    assert world.contact.touchdown.p_world_wheel[2] == pytest.approx(0.0, abs=1e-6)


def test_a_leader_nearer_than_a_metre_is_a_collision():
    """Passing at 0.9 m is a contact, at 1.1 m not; `leader_state` is its state."""
    for beside, touched in ((0.9, True), (1.1, False)):
        leader = Standing((0.0, -2.0 + beside, 2.0))
        world = SimulatedWorld(
            rates_model(), AIRFRAME, cruising((-4.0, -2.0, 2.0)), seed=1, leader=leader
        )
        flown(world)
        assert (world.contact is not None and world.contact.obstacle == "leader") == touched
        assert np.array_equal(world.leader_state.p_world, leader.p_world)
    assert (
        SimulatedWorld(rates_model(), AIRFRAME, cruising((0.0, 0.0, 2.0)), seed=1).leader_state
        is None
    )


def test_effects_of_the_catalogue_fly():
    """Wind to the left pushes a trimmed aircraft there; a trim bias turns it."""
    still = flown(SimulatedWorld(rates_model(), AIRFRAME, cruising((-10.0, -2.0, 2.0)), seed=1))[
        0
    ].state
    moved = {}
    for name, values in (
        ("wind", {"wind_x": 0.0, "wind_y": 1.0}),
        ("trim_bias", {"bias_aileron": 0.1}),
    ):
        effect = next(e for e in CATALOGUE if e.name == name)
        model = rates_model().with_effect(effect).with_values(values)
        world = SimulatedWorld(model, AIRFRAME, cruising((-10.0, -2.0, 2.0)), seed=1)
        moved[name] = flown(world)[0].state
    assert moved["wind"].p_world[1] - still.p_world[1] > 0.1
    assert moved["trim_bias"].roll - still.roll > math.radians(5.0)


def test_without_noise_the_pose_is_the_truth():
    """Noise of zero."""
    world, _ = flown(
        SimulatedWorld(rates_model(), AIRFRAME, cruising((-10.0, -2.0, 2.0)), seed=1, noise=SILENT)
    )
    assert world.measured().vector[:6] == pytest.approx(world.state.vector[:6], abs=1e-12)


def test_bad_input_is_refused():
    """A start with nan, decreasing time, negative noise, seed and delay."""
    good = cruising((0.0, -2.0, 2.0))
    with pytest.raises(InputError, match="start"):
        SimulatedWorld(rates_model(), AIRFRAME, cruising((0.0, np.nan, 2.0)), seed=1)
    with pytest.raises(InputError, match="seed"):
        SimulatedWorld(rates_model(), AIRFRAME, good, seed=-1)
    with pytest.raises(InputError, match="delay"):
        SimulatedWorld(rates_model(), AIRFRAME, good, seed=1, delay=-0.1)
    with pytest.raises(InputError, match="noise"):
        PoseNoise(position=-0.01)
    world = flown(SimulatedWorld(rates_model(), AIRFRAME, good, seed=1))[0]
    with pytest.raises(InputError, match="t:"):
        world.advance(0.5)
