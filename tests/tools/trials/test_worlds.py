"""Worlds of an evaluation: the nominal one changes nothing; every other one what its name says."""

import math

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.control.estimate import SimulatedAircraft
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import State
from falconwing_kit.flight.sources import RenderedView, fpv_camera
from falconwing_kit.flight.tasks import FollowTask, LandingTask, trial_seed
from falconwing_kit.scene import GaussianScene
from falconwing_kit.tools.trials import worlds
from falconwing_kit.tools.trials.jsbsim_aircraft import JsbsimAircraft, JsbsimFlight, set_wind
from falconwing_kit.tools.trials.trials import fly_trial
from falconwing_kit.tools.trials.worlds import (
    WORLDS,
    World,
    WorldTask,
    mount_rotation,
    select_worlds,
)

SEEDS = [trial_seed(number, 7) for number in range(30)]


def test_the_nominal_world_is_the_task_itself():
    """Landings of `fly` and of `eval`'s table from the paper's starts: the same to the bit."""
    task = LandingTask()
    in_world = WorldTask(task, WORLDS["paper"])
    for number in range(2):
        plain, evaluated = (fly_trial(t, t.expert, number) for t in (task, in_world))
        assert plain["success"] and plain["path_m"] == evaluated["path_m"]
    follow = FollowTask("left_turn_s_descent")
    starts = [t.trial(SEEDS[0]).world.state.vector
              for t in (follow, WorldTask(follow, WORLDS["left_turn_s_descent"]))]  # fmt: skip
    assert np.array_equal(*starts)


def test_a_spread_of_coefficients_is_uniform_and_scales():
    """30 aircraft: factors within 1 +- 0.2, both signs; half the spread has half of each factor's
    deviation, so levels of a sweep are pairs; delay and lag stay.
    """
    nominal = rates_model()
    found = {}
    for width in (0.1, 0.2):
        flies = [worlds._draw_aircraft(World("", "", coefficients=width), nominal, seed)[0]
                 for seed in SEEDS]  # fmt: skip
        assert all(f.values[name] == nominal.values[name] for f in flies for name in ("lag",))
        found[width] = np.array([f.values["cL_alpha"] / nominal.values["cL_alpha"] for f in flies])
    assert found[0.2] - 1.0 == pytest.approx(2.0 * (found[0.1] - 1.0))
    assert 0.8 <= found[0.2].min() < 0.87 and 1.13 < found[0.2].max() <= 1.2


def test_the_air_moves_at_the_worlds_speed_in_any_direction():
    """By hand: a wind of 0.8 m/s, up to 30 % more and less in its gusts; all quadrants occur."""
    world = WORLDS["wind speed 0.8"]
    quadrants = set()
    for seed in SEEDS:
        values = worlds._wind(world, seed)
        assert math.hypot(values["air_x"], values["air_y"]) == pytest.approx(0.8)
        quadrants.add((values["air_x"] > 0.0, values["air_y"] > 0.0))
        K = type("K", (), values)
        speeds = [np.hypot(*worlds.gusty_wind(0.0, 0.0, 1.0, t, K)[:2])
                  for t in np.arange(0.0, 10.0, 0.01)]  # fmt: skip
        assert (min(speeds), max(speeds)) == pytest.approx((0.56, 1.04), abs=0.01)
    assert len(quadrants) == 4


def test_both_simulators_have_the_same_wind():
    """The same aircraft for a second in a steady wind from ahead and the right: JSBSim and the
    kit's model, which share no code, agree to 3 cm, a tenth of what the wind moves it by.
    """
    pytest.importorskip("jsbsim")
    aircraft = JsbsimAircraft(delay=0.0)
    start = np.array([0.0, 0.0, 2.0, 0.1, 0.0, 0.0, 7.0, *[0.0] * 5])
    command = np.array([0.5, 0.0, 0.1, 0.0])
    ends = {}
    for wind in ((0.0, 0.0), (-1.0, 1.5)):
        blow = np.array([*wind, 0.0])
        other = JsbsimFlight(aircraft, start, 0.05, lambda t, fdm, v=blow: set_wind(fdm, v))
        model = aircraft.kit_model().with_terms(worlds.GUSTY_WIND)
        model = model.with_values({"air_x": wind[0], "air_y": wind[1]})
        ours = SimulatedAircraft(model, State.from_vector(start), 0.05)
        for flight in (other, ours):
            flight.send(0.0, command)
            flight.advance(1.0)
        assert other.x[:3] == pytest.approx(ours.x[:3], abs=0.03)
        ends[wind] = other.x[:3]
    moved = ends[-1.0, 1.5] - ends[0.0, 0.0]
    assert np.linalg.norm(moved) > 0.3 and moved[0] < 0.0


def test_a_camera_off_its_mount_is_turned_by_the_angle():
    """The trace of a rotation is 1 + 2 cos(angle) [Euler]; the axis differs from trial to trial. A
    point straight ahead then moves by at most f tan(angle).
    """
    world = WORLDS["mount 3"]
    R = [mount_rotation(world, seed) for seed in SEEDS]
    assert [math.degrees(math.acos((np.trace(r) - 1.0) / 2.0)) for r in R] == pytest.approx(
        [3] * 30
    )
    assert len({tuple(np.round(r[0], 3)) for r in R}) == 30
    assert np.array_equal(mount_rotation(WORLDS["paper"], 1), np.eye(3))
    trial, camera = LandingTask().trial(SEEDS[0]), fpv_camera()
    yaw = math.radians(3.0)  # about the belly axis, to the right: what is ahead moves to the left
    turned = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0],
                       [0.0, 0.0, 1.0]])  # fmt: skip
    view = RenderedView(trial.world, one_gaussian(), camera, R_body_mount=turned)
    ahead = trial.world.state.pose.T_world_body @ np.array([10.0, 0.0, 0.0, 1.0])
    (uv,), _ = camera.project(ahead[None, :3], view.T_world_camera)
    assert uv == pytest.approx([160.0 - 198.4 * math.tan(yaw), 120.0], abs=0.1)


def one_gaussian() -> GaussianScene:
    return GaussianScene(
        np.array([[50.0, 0.0, 1.0]], np.float32), np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        np.full((1, 3), 0.1, np.float32), np.ones(1, np.float32), np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip


def test_starts_lie_where_they_are_said_to():
    """Curved: 2 to 4 m beside the centre line (y = -2), nose towards it. Wide: within 3 m of it and
    12 m out to a metre before the wall, 0.7 to 3 m up, nose within 30 + 5 deg. Yaw is positive to
    the right, which is -y.
    """
    curved, wide = (
        [WorldTask(LandingTask(), WORLDS[name]).trial(seed).world.state for seed in SEEDS]
        for name in ("curved", "wide")
    )
    for state in curved:
        aside = state.p_world[1] + 2.0
        assert 2.0 <= abs(aside) <= 4.0 and state.yaw * aside > 0.0
        assert 16.0 <= 1.0 - state.p_world[0] <= 20.0
    assert {state.p_world[1] > -2.0 for state in curved} == {True, False}
    out, aside, height = np.array([s.p_world for s in wide]).T * [[-1.0], [1.0], [1.0]]
    assert 12.0 <= (out + 1.0).min() < 14.0 and 20.0 < (out + 1.0).max() <= 1.0 - Hall().x[0] - 1.0
    assert np.abs(aside + 2.0).max() <= 3.0 and height.min() >= 0.7 and height.max() <= 3.0
    assert 20.0 < max(abs(math.degrees(s.yaw)) for s in wide) <= 35.0


def test_worlds_are_chosen_by_name_group_and_all(monkeypatch):
    """Names with commas of their own; a task has only its worlds; JSBSim may be missing."""
    chosen = select_worlds("late 1, -1 EV, 26 dB,landing,late 1", "landing")
    assert [w.name for w in chosen] == ["late 1", "-1 EV, 26 dB", "paper", "curved", "wide"]
    assert not any(world.group == "landing" for world in select_worlds("all", "follow"))
    for wrong in ("later", "", "manoeuvres"):
        with pytest.raises(InputError, match="--worlds"):
            select_worlds(wrong, "landing")
    monkeypatch.setattr(worlds, "has_jsbsim", lambda: False)
    assert "reality" not in [world.name for world in select_worlds("all", "landing")]
    with pytest.raises(InputError, match="pip install jsbsim"):
        select_worlds("paper,reality", "landing")


def test_the_reality_world_flies_another_simulator_through_an_analog_link():
    """What its definition says, and that the aircraft of two trials differ."""
    pytest.importorskip("jsbsim")
    world = WORLDS["reality"]
    assert world.is_analog and world.mount_deg == 0.5 and world.delay_s == (0.05, 0.08)
    task = WorldTask(LandingTask(), world)
    flights = [task.trial(seed).world._aircraft for seed in SEEDS[:2]]
    assert all(isinstance(flight, JsbsimFlight) for flight in flights)
    assert flights[0]._aircraft.CLa != flights[1]._aircraft.CLa
    assert all(0.05 <= flight._delay <= 0.08 for flight in flights)
