"""Imitation: what a flight keeps is what was seen, done and taught; training lowers the loss."""

import numpy as np
import pytest
import torch

from falconwing_kit.learning import imitation
from falconwing_kit.learning.flights import AUXILIARY, Fleet
from falconwing_kit.learning.imitation import Rollout, fly_all, imitate
from falconwing_kit.learning.learner import Flown, Learner, Schedule, draw_batch
from falconwing_kit.learning.situations import NOMINAL, draw_situation
from falconwing_kit.vision.policy import PolicyShape

SHAPE = PolicyShape(32, 24, convolutions=((6, 5, 2), (8, 3, 2)), features=16, memory=16, hidden=16)
MOUNT = np.array([0.2, 0.0, 0.0])


class NumberedViews:
    """Images whose first pixel is the number of the call and the second the flight's."""

    def __init__(self, places):
        self.calls, self.places = 0, places

    def render(self, Ts_world_camera, Ts_world_leader, fine):
        images = torch.zeros(len(Ts_world_camera), 3, 24, 32, dtype=torch.uint8)
        images[:, 0, 0, 0] = self.calls
        for row, T in enumerate(Ts_world_camera):
            apart = [abs(T[1, 3] - place) for place in self.places]
            images[row, 0, 0, 1] = int(np.argmin(apart))
        self.calls += 1
        return images, None


def rollout(mixing):
    jobs = [("landing", 60 + k, NOMINAL, MOUNT) for k in range(3)]
    fleet = Fleet(0)
    fleet.prepare(jobs)
    situations = fleet.begin()
    views = NumberedViews([situation.start.p_world[1] for situation in situations])
    learner = Learner(SHAPE, Schedule(batch=2), "cpu")
    flying = Rollout(fleet, learner, views, situations, mixing=mixing, keeps=True)
    fly_all([flying])
    return flying, fleet


def test_a_flown_flight_holds_its_own_images_and_commands():
    """Three flights by the teacher: images in order, the command sent is the teacher's, and the
    fleet's outcome is a landing.
    """
    flying, fleet = rollout(mixing=1.0)
    assert all(outcome["landed"] for outcome in fleet.outcomes())
    flown = flying.flown()
    assert len(flown) == 3
    for flight in flown:
        assert flight.images[:, 0, 0, 0].tolist() == list(range(len(flight.sent)))
        limits = np.clip(flight.teacher, (0.0, -1.0, -1.0, -1.0), 1.0)
        assert flight.sent == pytest.approx(limits)
        assert flight.auxiliary.shape == (len(flight.sent), AUXILIARY)
    assert [int(flight.images[0, 0, 0, 1]) for flight in flown] == [0, 1, 2]


def test_a_flight_by_the_network_is_still_taught():
    """Without mixing the commands are the network's, and those of the teacher are kept beside."""
    flying, _ = rollout(mixing=0.0)
    flight = flying.flown()[0]
    assert np.abs(flight.sent - flight.teacher).max() > 0.05


def train(learner, flights, share):
    """One step on a batch of flights: the loss."""
    size = learner.schedule.batch
    batch = draw_batch(flights, size, NOMINAL, learner.rng, learner.generator)
    return float(learner.train_step(batch, share))


def test_training_lowers_the_loss():
    """Commands that are read off the image's brightness: learned in 150 steps to a third."""
    rng = np.random.default_rng(0)
    flights = []
    for _ in range(16):
        level = rng.random(20)
        images = torch.from_numpy((255 * level).astype(np.uint8))[:, None, None, None]
        ramp = torch.linspace(0.0, 1.0, 32)[None, None, None]
        images = (images * ramp).to(torch.uint8).expand(-1, 3, 24, -1).contiguous()
        images[:, :, 12:] = 128
        teacher = np.repeat(level[:, None], 4, axis=1) - (0.0, 0.5, 0.5, 0.5)
        flights.append(
            Flown(images, None, np.zeros((20, 4)), teacher, np.zeros((20, AUXILIARY)), MOUNT)
        )
    learner = Learner(SHAPE, Schedule(batch=8, rate=3e-3), "cpu")
    losses = [train(learner, flights, 0.1) for _ in range(150)]
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:5])
    assert learner.trained.steps == 150


def test_the_average_lags_behind_the_network():
    """After some steps they differ, and both are finite."""
    learner = Learner(SHAPE, Schedule(batch=2), "cpu")
    images = torch.randint(0, 255, (8, 3, 24, 32), dtype=torch.uint8)
    sent, auxiliary = np.zeros((8, 4)), np.zeros((8, AUXILIARY))
    flights = [Flown(images, None, sent, sent + 1.0, auxiliary, MOUNT)]
    for _ in range(5):
        train(learner, flights, 0.5)
    pairs = zip(learner.trained.network.parameters(), learner.average.parameters(), strict=True)
    assert any(not torch.equal(a, b) for a, b in pairs)
    assert all(torch.isfinite(w).all() for w in learner.average.parameters())


def test_a_situation_of_the_rollout_is_the_fleets():
    """The same seed drawn here: the same start."""
    situation = draw_situation("landing", 60, NOMINAL, MOUNT)
    fleet = Fleet(0)
    fleet.prepare([("landing", 60, NOMINAL, MOUNT)])
    assert np.array_equal(fleet.begin()[0].start.vector, situation.start.vector)


class CompilingViews(NumberedViews):
    """Images whose first in each size takes 100 s of a clock that nothing else advances."""

    def __init__(self):
        super().__init__([0.0])
        self.compiled, self.now = set(), 0.0

    def render(self, Ts_world_camera, Ts_world_leader, fine):
        if fine not in self.compiled:
            self.compiled.add(fine)
            self.now += 100.0
        return super().render(Ts_world_camera, Ts_world_leader, fine)


def test_a_renderer_that_compiles_does_not_lengthen_the_first_round(monkeypatch):
    """Training lasts as long as the round's flying before it, so that would be too long."""
    views = CompilingViews()
    monkeypatch.setattr(imitation.time, "perf_counter", lambda: views.now)
    learner = Learner(SHAPE, Schedule(flights=2, rounds=1, minutes=0.0, batch=2), "cpu")
    records = []
    imitate([learner], views, [Fleet(0)], "landing", NOMINAL, records.append)
    assert records[0]["flying_s"] == 0.0
