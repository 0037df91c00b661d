"""Collecting: a flight's images, commands and labels belong together, and can be flown again."""

import numpy as np
import pytest
import torch

from falconwing_kit.core.messages import Command
from falconwing_kit.learning.collect import fly_episodes
from falconwing_kit.learning.flights import Fleet, TaughtFlight
from falconwing_kit.learning.situations import NOMINAL, SPREAD_RANGES, draw_situation

MOUNT = np.array([0.2, 0.0, 0.0])
SEED = 5_000_000_010


class NumberedViews:
    """Images whose first pixel is the number of the call plus one."""

    calls = 0

    def render(self, Ts_world_camera, Ts_world_leader, fine):
        """A RenderFunction of PolicyViews."""
        self.calls += 1
        images = torch.zeros(len(Ts_world_camera), 3, 4, 5, dtype=torch.uint8)
        images[:, 0, 0, 0] = self.calls
        return images, None


def collect(count=1, noise=0.0, ranges=NOMINAL, make_pilot=None, seed=SEED):
    jobs = [("landing", seed + 2 * k, ranges, MOUNT) for k in range(count)]
    return fly_episodes(Fleet(0), NumberedViews(), jobs, noise, make_pilot)


def fly_again(episode, commands):
    """Camera poses (T, 4, 4) of the flight's seed, flown by commands (T, 4)."""
    situation = draw_situation("landing", episode.seed, NOMINAL, MOUNT)
    flight, poses = TaughtFlight(situation), []
    for command in commands:
        poses.append(flight.world.state.pose.T_world_body @ situation.T_body_camera)
        flight.advance(command)
    return np.array(poses)


def test_without_noise_the_expert_lands_and_is_its_own_label():
    """What was sent is the label within the limits of a command, and images are in order."""
    (episode,) = collect()
    flown = episode.flown
    assert episode.outcome["landed"] and episode.seed == SEED
    limits = np.clip(flown.teacher, (0.0, -1.0, -1.0, -1.0), 1.0)
    assert np.array_equal(flown.sent, limits)
    assert flown.images[:, 0, 0, 0].tolist() == list(range(1, len(flown.sent) + 1))


def test_the_commands_of_a_flight_fly_it_again():
    """The world's law: the same start and commands give the same poses. With two commands swapped
    they do not, so a dataset whose commands are in a wrong order is noticed.
    """
    (episode,) = collect(noise=0.2)
    sent = episode.flown.sent
    assert fly_again(episode, sent) == pytest.approx(episode.Ts_world_camera, abs=1e-9)
    swapped = fly_again(episode, sent[:40, [0, 2, 1, 3]])
    assert np.abs(swapped - episode.Ts_world_camera[:40]).max() > 0.2


def test_noise_is_on_what_is_sent_and_not_on_the_label():
    """Eight flights: the flights' standard deviations are spread over none to the largest, 0.2,
    and the mean over flights is zero within three standard errors of correlated noise.
    """
    flights = [episode.flown for episode in collect(8, noise=0.2)]
    off = [(flown.sent - flown.teacher)[:, 3] for flown in flights]  # the rudder: never at a limit
    deviations = np.array([each.std() for each in off])
    assert deviations.max() < 0.25 and deviations.min() < 0.08 < deviations.max()
    assert abs(np.mean(np.concatenate(off))) < 0.05
    steps = np.concatenate([each[1:] * each[:-1] for each in off]).mean()
    assert steps / np.concatenate(off).var() == pytest.approx(0.8, abs=0.12)


class Watching:
    """A pilot that keeps what it is given and always flies the same."""

    mode = ""

    def __init__(self, p_body_camera):
        self.p_body_camera, self.seen = p_body_camera, []

    def reset(self):
        """Begin a new flight."""
        self.seen = []

    def act(self, observation):
        """The same command."""
        self.seen.append(observation)
        return Command(0.5, 0.05, 0.1, 0.0)


def test_a_policy_is_given_no_state_and_the_images_that_arrive():
    """Late, lost and black images are those of the situation; the label is still the expert's."""
    pilots = []

    def make_pilot(p_body_camera):
        pilots.append(Watching(p_body_camera))
        return pilots[-1]

    seed = next(
        seed for seed in range(SEED, SEED + 400)
        if (situation := draw_situation("landing", seed, SPREAD_RANGES, MOUNT)).black[:20].any()
        and (situation.newest[:20] < np.arange(20)).any()
    )  # fmt: skip
    (episode,) = collect(ranges=SPREAD_RANGES, make_pilot=make_pilot, seed=seed)
    situation, (pilot,) = draw_situation("landing", seed, SPREAD_RANGES, MOUNT), pilots
    assert pilot.p_body_camera == pytest.approx(situation.p_body_camera)
    assert len(pilot.seen) == len(episode.flown.sent) > 5
    for k, observation in enumerate(pilot.seen):
        newest = situation.newest[k]
        assert observation.state is None and observation.t == pytest.approx(0.05 * k)
        assert (observation.image is None) == (newest < 0)
        if newest >= 0:
            expected = 0 if situation.black[newest] else newest + 1
            assert observation.image.pixels[0, 0, 0] == expected
            assert observation.image.t == pytest.approx(0.05 * newest)
        assert observation.past_commands[-1] == pytest.approx(
            episode.flown.sent[k - 1] if k else np.zeros(4)
        )
    assert np.abs(episode.flown.sent - (0.5, 0.05, 0.1, 0.0)).max() < 1e-12
    assert np.abs(episode.flown.teacher - episode.flown.sent).max() > 0.05
