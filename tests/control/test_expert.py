"""Experts in the simulated world: landing, following, waypoints, level flight without a state."""

import math

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import paper_model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import (
    NO_STATE,
    FollowExpert,
    LandingExpert,
    WaypointExpert,
    landing_path,
)
from falconwing_kit.control.leader import leader_path
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Observation, State
from falconwing_kit.flight.world import SimulatedWorld

AIRFRAME, PAD = load_airframe(), LandingPad()


def cruising(p_world, yaw_deg=0.0, speed=7.0):
    """A trimmed state at a position and course; another speed keeps the attitude."""
    x, yaw = trim(rates_model(), 7.0).state.copy(), math.radians(yaw_deg)
    x[:3], x[4], x[6:9] = p_world, yaw, (speed * math.cos(yaw), -speed * math.sin(yaw), 0.0)
    return State.from_vector(x)


def fly(world, pilot, seconds):
    """States (n, 12) at 20 Hz until a contact, and the modes."""
    past, states, modes = np.zeros((30, 4)), [world.state.vector], []
    for k in range(round(seconds / 0.05)):
        command = pilot.act(Observation(world.t, None, past, world.measured()))
        past = np.concatenate([past[1:], command.vector[None]])
        modes.append(pilot.mode)
        world.send(world.t, command)
        world.advance((k + 1) * 0.05)
        states.append(world.state.vector)
        if world.contact:
            break
    return np.array(states), modes


@pytest.mark.parametrize("seed", range(10))
def test_expert_lands_softly_on_the_pad(seed):
    """From 20 m before the pad and 1.5 m up, +-1 m, 10 deg and 1 m/s drawn by the seed.

    Within half a metre of the centre line of a pad with 1 m on each side; below 0.6 m/s, a drop
    from 2 cm (v^2 / 2g); below 5 deg of bank.
    """
    draw = np.random.default_rng(seed).uniform(-1.0, 1.0, 5)
    start = cruising(np.array([-19.0, -2.0, 1.5]) + draw[:3], 10.0 * draw[3], 7.0 + draw[4])
    world = SimulatedWorld(rates_model(), AIRFRAME, start, seed=seed, pad=PAD)
    _, modes = fly(world, LandingExpert(rates_model(), AIRFRAME, PAD), 8.0)
    assert world.contact.obstacle == "pad"
    touchdown = world.contact.touchdown
    assert touchdown.absolute_lateral_deviation < 0.5
    assert touchdown.sink_rate < 0.6 and abs(math.degrees(touchdown.bank)) < 5.0
    assert modes[0] == "approach" and "flare" in modes


def test_landing_path_touches_where_it_aims():
    """Geometry: above the pad over the threshold; the wheels reach its top 3.5 m past the threshold
    at a slope of 0.035; the glide descends at 4 deg.
    """
    path, flare = landing_path(AIRFRAME, PAD)
    standing = PAD.height + AIRFRAME.wheels.main_left[2]
    touch = path.at(path.nearest(np.array([PAD.x_start + 3.5, PAD.y_centre, 0.0])), 7.0)
    assert touch.p_world[2] == pytest.approx(standing, abs=1e-3)
    assert math.tan(touch.climb) == pytest.approx(
        -0.035, abs=0.01
    )  # the climb is that of 1.4 m ahead
    assert math.degrees(path.at(flare - 10.0, 7.0).climb) == pytest.approx(-4.0, abs=0.05)
    assert (
        path.at(path.nearest(np.array([PAD.x_start, PAD.y_centre, 0.0])), 7.0).p_world[2]
        > standing + 0.15
    )


def test_landed_means_idle_and_neutral():
    """With the wheels in the pad's top it stays idle: higher up, without a state, with nan."""
    expert = LandingExpert(rates_model(), AIRFRAME, PAD)
    down, higher, half_seen = (
        cruising((6.0, -2.0, height)) for height in (PAD.height, 0.5, np.nan)
    )
    for k, state in enumerate((down, higher, None, half_seen, higher)):
        command = expert.act(Observation(0.05 * k, None, np.zeros((30, 4)), state))
        assert expert.mode == "landed" and not command.vector.any()


@pytest.mark.parametrize("lost", [None, "nan"])
def test_without_a_state_it_flies_level_and_shows_the_mode(lost):
    """The control inputs of a level trim, solved here again; with a state it resumes."""
    steady = trim(rates_model(), 7.0)
    unknown = (
        None
        if lost is None
        else State.from_vector(np.where(np.arange(12) == 4, np.nan, steady.state))
    )
    leader = leader_path("left_turn_s_descent")
    line = np.array([[-19.0, -2.0, 2.0], [0.0, -2.0, 2.0]])
    for expert in (
        LandingExpert(rates_model(), AIRFRAME, PAD),
        FollowExpert(rates_model(), AIRFRAME, leader),
        WaypointExpert(rates_model(), AIRFRAME, line),
    ):
        command = expert.act(Observation(0.0, None, np.zeros((30, 4)), unknown))
        assert command.vector == pytest.approx(steady.command, abs=1e-9)
        assert expert.mode == NO_STATE
        expert.act(Observation(0.05, None, np.zeros((30, 4)), cruising((-20.0, -2.0, 2.0))))
        assert expert.mode != NO_STATE


@pytest.mark.parametrize(
    "manoeuvre", ["left_turn_s_descent", "right_turn_s_ascent", "right_turn_sharp_climb"]
)
def test_follower_keeps_its_place_on_the_leaders_path(manoeuvre):
    """From 4 m behind: each position is that of the leader about 4 m of path before.

    Mean error below half the paper's 0.72 m (of its expert on its training task); no collision.
    """
    leader = leader_path(manoeuvre, seed=3)
    start = leader.state_at(0.0)
    follower = State.from_vector(
        start.vector - np.concatenate([4.0 * start.v_world / 7.0, np.zeros(9)])
    )
    world = SimulatedWorld(rates_model(), AIRFRAME, follower, seed=3, leader=leader)
    states, modes = fly(world, FollowExpert(rates_model(), AIRFRAME, leader), leader.duration)
    assert world.contact is None and set(modes) == {"follow"}
    ways = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(leader.states[:, :3], axis=0), axis=1))]
    )
    n = min(len(states), len(ways))
    due = ways[:n] - 4.0
    places = np.column_stack([np.interp(due, ways, leader.states[:, i]) for i in range(3)])
    places += np.minimum(due, 0.0)[:, None] * start.v_world / 7.0
    assert np.linalg.norm(states[:n, :3] - places, axis=1).mean() < 0.36


def test_waypoints_are_passed():
    """A gentle S through four points from noisy poses: each within 0.4 m, then straight on."""
    points = np.array([[-18.0, -2.0, 1.5], [-10.0, -1.0, 2.0], [-2.0, -3.5, 2.5], [7.0, -3.0, 2.0]])
    world = SimulatedWorld(rates_model(), AIRFRAME, cruising(points[0]), seed=1)
    states, modes = fly(world, WaypointExpert(rates_model(), AIRFRAME, points), 4.5)
    for point in points:
        assert np.linalg.norm(states[:, :3] - point, axis=1).min() < 0.4
    assert modes[0] == "waypoints" and modes[-1] == "past the end"


def test_steady_circle_turns_by_the_law():
    """d(yaw)/dt = g tan(roll)

    V of the true flight on a circle, once steady, within 2 %.

    The law neglects cos(pitch) (0.4 %) and takes bank and speed as constant.
    """
    u = np.linspace(0.0, 2.0 * np.pi, 64)
    circle = np.column_stack(
        [-2.5 + 9.0 * np.sin(u), 7.0 + 9.0 * (np.cos(u) - 1.0), np.full(64, 2.0)]
    )
    world = SimulatedWorld(rates_model(), AIRFRAME, cruising(circle[0]), seed=2)
    states, _ = fly(world, WaypointExpert(rates_model(), AIRFRAME, circle), 6.0)
    steady = states[40:]
    turn = (np.unwrap(steady[:, 4])[-1] - steady[0, 4]) / (0.05 * (len(steady) - 1))
    law = np.mean(9.8 * np.tan(steady[:, 5]) / np.linalg.norm(steady[:, 6:9], axis=1))
    assert turn == pytest.approx(law, rel=0.02)
    assert turn == pytest.approx(7.0 / 9.0, rel=0.03)


def test_what_no_expert_can_fly_is_refused():
    """A model without body rates or thrust, and a hairpin of waypoints."""
    hairpin = np.array([[-18.0, -2.0, 1.5], [0.0, -2.0, 1.5], [-18.0, 0.0, 1.5]])
    with pytest.raises(InputError, match="12-state model"):
        LandingExpert(paper_model(), AIRFRAME, PAD)
    with pytest.raises(InputError, match="throttle"):
        LandingExpert(rates_model().with_values({"kT": 0.1}), AIRFRAME, PAD)
    with pytest.raises(InputError, match="deg of bank"):
        WaypointExpert(rates_model(), AIRFRAME, hairpin)
