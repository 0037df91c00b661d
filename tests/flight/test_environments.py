"""Environments: Gymnasium's own checker is silent; flights are those of `fly`, one or many."""

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.environments import (
    FalconWingLandingVector,
    action_from_command,
    command_from_action,
    follow_environment,
    landing_environment,
    landing_observation,
)
from falconwing_kit.flight.rewards import LandingReward
from falconwing_kit.flight.tasks import LandingTask
from falconwing_kit.tools.trials import fly_trial

SMALL = {"images": True, "image_size": (32, 24)}
GLIDE = np.array([-0.6, 0.0, 0.0, 0.0], np.float32)  # an action close to a glide


@pytest.fixture(scope="module")
def expert_flights():
    """Trials 0 and 1 by the state-based expert through the environment: actions, states, last
    step.
    """
    env, flights = landing_environment(discount=1.0), []
    for number in (0, 1):
        first, _ = env.reset(options={"trial": number})
        pilot, actions, rewards, seen = env.task.expert(env.trial), [], [], [first]
        potential = LandingReward(env.task.airframe, env.task.pad).potential(
            env.trial.world.state.vector
        )
        ended = False
        while not ended:
            actions.append(action_from_command(pilot.act(env.pilot_observation())))
            observation, reward, terminated, truncated, info = env.step(actions[-1])
            rewards.append(reward)
            seen.append(observation)
            ended = terminated or truncated
        flights.append((actions, seen, rewards, info, float(potential)))
    return flights


@pytest.mark.parametrize("settings", [{}, SMALL], ids=["states", "images"])
@pytest.mark.parametrize("name", ["Landing-v0", "Follow-v0"])
def test_gymnasiums_checker_is_silent(name, settings):
    """Gymnasium's own check of spaces, seeds, steps and pictures, every warning an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(f"falconwing_kit.flight.environments:FalconWing/{name}", **settings)
        check_env(env.unwrapped)
        env.close()


def test_the_expert_lands_through_the_environment_as_in_fly(expert_flights):
    """The same verdict, steps and path (to the millimetre, as the judge rounds it) as `fly_trial`,
    which goes through the loop; actions are single precision, the path differs by less than 1e-6 m.
    """
    task = LandingTask()
    for number, (actions, _, _, info, _) in enumerate(expert_flights):
        record = fly_trial(task, task.expert, number)
        result = info["result"]
        assert info["reason"] == record["reason"] == "touched pad"
        assert result["success"] and record["success"]
        assert len(actions) == record["steps"] - 1  # the last command of `fly` no longer acts
        assert result["sink_rate_m_s"] == pytest.approx(record["sink_rate_m_s"], abs=1e-6)
        assert np.abs(np.array(result["path_m"]) - record["path_m"]).max() <= 1e-3 + 1e-9


def test_rows_of_the_vector_environment_are_single_flights(expert_flights):
    """The expert's actions fly the same in rows: every observation within 1e-6, the same end, the
    judge's record; then the row begins again by itself with the seed that it draws.
    """
    flights = gymnasium.make_vec("FalconWing/Landing-v0", num_envs=2, discount=1.0)
    assert isinstance(flights, FalconWingLandingVector)
    assert flights.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    seen, _ = flights.reset(options={"trial": 0})
    for row, (_, alone, _, _, _) in enumerate(expert_flights):
        assert seen[row] == pytest.approx(alone[0], abs=1e-6)
    ended: set[int] = set()
    for k in range(max(len(actions) for actions, *_ in expert_flights)):
        sent = [f[0][k] if k < len(f[0]) else GLIDE for f in expert_flights]
        seen, rewards, terminated, truncated, infos = flights.step(np.array(sent))
        for row, (actions, alone, expected, info, _) in enumerate(expert_flights):
            if row in ended:
                continue
            last = k == len(actions) - 1
            assert terminated[row] == last and not truncated[row]
            after = infos["final_obs"][row] if last else seen[row]
            assert after == pytest.approx(alone[k + 1], abs=1e-6)
            assert rewards[row] == pytest.approx(expected[k], abs=1e-6)
            if last:
                ended.add(row)
                found = infos["final_info"]["result"][row]
                assert found["success"] and infos["final_info"]["success"][row]
                assert found.keys() == info["result"].keys()
                assert found["sink_rate_m_s"] == pytest.approx(
                    info["result"]["sink_rate_m_s"], abs=1e-6
                )
                assert seen[row][0] * 10.0 == pytest.approx(-20.0, abs=1.1)  # a new start
    assert ended == {0, 1}


def test_random_flights_and_their_successors_have_the_same_seeds():
    """By random sticks: the vector environment's rows and single environments from the same seed
    draw the same flights one after the other and end them for the same reason.
    """
    flights, rng = FalconWingLandingVector(2), np.random.default_rng(1)
    alone = [landing_environment() for _ in range(2)]
    seen, _ = flights.reset(seed=3)
    firsts = [env.reset(seed=3 + row)[0] for row, env in enumerate(alone)]
    assert seen == pytest.approx(np.array(firsts), abs=1e-6)
    ends = 0
    for _ in range(120):
        actions = np.clip(GLIDE + 0.25 * rng.normal(size=(2, 4)), -1.0, 1.0).astype(np.float32)
        seen, rewards, terminated, truncated, infos = flights.step(actions)
        for row, env in enumerate(alone):
            observation, reward, stopped, late, info = env.step(actions[row])
            assert (stopped, late) == (terminated[row], truncated[row])
            assert reward == pytest.approx(rewards[row], abs=1e-6)
            if stopped or late:
                ends += 1
                assert infos["final_info"]["reason"][row] == info["reason"]
                observation, info = env.reset()
                assert info["seed"] == infos["seed"][row]
            assert observation == pytest.approx(seen[row], abs=1e-5)
    assert ends >= 2


def test_a_flight_is_truncated_where_fly_ends_it():
    """By hand: half a second has the steps 0 to 9 of 50 ms; the tenth command no longer acts."""
    task = replace(LandingTask(), duration=0.5)
    assert fly_trial(task, task.expert, 0)["steps"] == 10
    env, flights = landing_environment(task), FalconWingLandingVector(1, task=task)
    env.reset(seed=0)
    flights.reset(seed=0)
    for step in range(1, 10):
        _, _, terminated, truncated, info = env.step(GLIDE)
        _, _, stopped, late, infos = flights.step(GLIDE[None])
        assert not terminated and not stopped[0]
        assert truncated == late[0] == (step == 9)
    assert info["reason"] == infos["final_info"]["reason"][0] == "duration"
    assert not info["result"]["success"]


def test_a_seed_is_a_flight_and_a_trial_is_the_one_of_fly():
    """Law: the same seed gives the same bits, another one does not. Trial 7 has seed 10,007."""
    env = landing_environment(history=0)
    first, again, other = (env.reset(seed=seed)[0] for seed in (5, 5, 6))
    assert (first == again).all()
    assert (first != other).any()
    seen, info = env.reset(options={"trial": 7})
    measured = LandingTask().trial(10_007).world.measured()
    pad = LandingPad()
    place = seen[:3] * (10.0, 2.0, 1.0) + (pad.x_start, pad.y_centre, pad.height)
    assert info["seed"] == 10_007
    assert place == pytest.approx(measured.p_world, abs=1e-5)


def test_each_stick_moves_its_own_axis():
    """From level flight half a second of each stick, beside the same flight without: aileron rolls
    right, elevator raises the nose, rudder turns it right, throttle accelerates. Swapped channels
    fail each line.
    """
    task = LandingTask()
    level = trim(task.model, 7.0)
    x = level.state.copy()
    x[:3] = task.nominal
    held = action_from_command(Command(*level.command))

    def flown(channel: int) -> np.ndarray:
        env = landing_environment(replace(task, start=State.from_vector(x)))
        env.reset(seed=0)
        action = held.copy()
        if channel >= 0:
            action[channel] += 0.3
        for _ in range(10):
            env.step(action)
        return env.trial.world.state.vector

    alone = flown(-1)
    change = [flown(channel) - alone for channel in range(4)]
    speed, roll, pitch, yaw = (
        [each[column] for each in change] for column in (6, 5, 3, 4)
    )  # of each channel
    assert int(np.argmax(roll)) == 1 and roll[1] > 0.1
    assert int(np.argmax(pitch)) == 2 and pitch[2] > 0.05
    assert int(np.argmax(yaw)) == 3 and yaw[3] > 0.05
    assert int(np.argmax(speed)) == 0 and speed[0] > 0.1


def test_actions_are_commands_with_the_throttle_moved():
    """By hand: -1 is idle, 0 half and 1 full throttle; the rest is unchanged."""
    assert command_from_action([0.0, 0.1, -0.2, 0.3]).vector == pytest.approx([0.5, 0.1, -0.2, 0.3])
    assert command_from_action([-1, 0, 0, 0]).throttle == 0.0
    command = Command(0.25, 0.5, -0.5, 1.0)
    assert command_from_action(action_from_command(command)).vector == pytest.approx(command.vector)


def test_an_observation_is_in_its_units_and_says_what_it_cuts():
    """By hand: one unit of every number is 1; a kilometre is cut at 10 and reported."""
    pad = LandingPad()
    place, angles = [pad.x_start + 10.0, pad.y_centre + 2.0, pad.height + 1.0], [0.35] * 3
    angles[1] += 2.0 * np.pi  # a yaw after a full turn is the same yaw
    measured = np.array([*place, *angles, 7.0, *[2.0] * 5])
    past = np.array([[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8]])
    seen, clipped = landing_observation(measured, past, pad)
    expected = [*np.ones(12), 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]
    assert seen == pytest.approx(np.array(expected), abs=1e-6)
    assert not clipped
    measured[0] = 1000.0
    seen, clipped = landing_observation(measured, past, pad)
    assert seen[0] == 10.0 and clipped


def test_shaping_adds_up_to_the_start(expert_flights):
    """Law of Ng, Harada and Russell with discount 1: the rewards of a flight add up to its outcome
    less the potential of its start. Outcome by hand from the judge's numbers.
    """
    for _, _, rewards, info, potential in expert_flights:
        result = info["result"]
        outcome = 3.0 - abs(result["lateral_offset_m"]) / 1.0 - result["sink_rate_m_s"] / 1.0
        assert sum(rewards) == pytest.approx(outcome - potential, abs=1e-9)
    assert LandingReward(LandingTask().airframe, LandingPad()).outcome({"success": False}) == 0.0


def test_a_follower_sees_its_leader_ahead():
    """At the start the leader is 4 m ahead within the spread of 0.5 m per axis: one unit."""
    env = follow_environment("figure_eight")
    seen, _ = env.reset(seed=1, options={"manoeuvre": "right_turn_s_ascent"})
    assert env.trial.leader.manoeuvre == "right_turn_s_ascent"
    ahead, left, up = 4.0 * seen[12:15]
    assert ahead == pytest.approx(4.0, abs=0.6)
    assert abs(left) < 1.0 and abs(up) < 0.6
    _, reward, terminated, _, _ = env.step(GLIDE)
    assert not terminated and np.isfinite(reward)


def test_a_picture_of_the_moment():
    """The nose's picture is the observed image; without a render mode there is none."""
    env = landing_environment(**SMALL, render_mode="rgb_array", view="nose")
    seen, _ = env.reset(seed=2)
    assert (env.render() == seen["image"]).all()
    assert seen["image"].std() > 5.0
    assert landing_environment().render() is None


def test_wrong_use_is_a_sentence():
    """No flight yet, an action that is no number, unknown options and modes."""
    env = landing_environment()
    with pytest.raises(InputError, match="call reset"):
        env.step(GLIDE)
    env.reset(seed=0)
    with pytest.raises(InputError, match="finite"):
        env.step([np.nan, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="expected some of"):
        env.reset(options={"trail": 1})
    with pytest.raises(InputError, match="render_mode"):
        landing_environment(render_mode="human")
    flights = FalconWingLandingVector(2)
    with pytest.raises(InputError, match="call reset"):
        flights.step(np.zeros((2, 4)))
    with pytest.raises(InputError, match="one for each"):
        flights.reset(options={"trial": [1, 2, 3]})
