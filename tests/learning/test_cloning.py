"""Cloning: several datasets as one, so many steps as asked, and the error on flights held out."""

import numpy as np
import pytest
import torch

from falconwing_kit.core.checks import InputError
from falconwing_kit.learning.cloning import Joined, clone, command_error
from falconwing_kit.learning.flights import AUXILIARY
from falconwing_kit.learning.learner import Flown, Learner, Schedule
from falconwing_kit.learning.situations import NOMINAL
from falconwing_kit.vision.policy import PolicyShape

SHAPE = PolicyShape(32, 24, convolutions=((6, 5, 2), (8, 3, 2)), features=16, memory=16, hidden=16)
MOUNT = np.array([0.2, 0.0, 0.0])


def flights(count, level=0.0, seed=0):
    """Flights of 10 steps, whose expert always answers the same."""
    rng = np.random.default_rng(seed)
    teacher = np.tile([0.5 + level, -0.2, 0.1, 0.3], (10, 1))
    return [
        Flown(
            torch.from_numpy(rng.integers(0, 256, (10, 3, 24, 32), dtype=np.uint8)), None,
            rng.random((10, 4)), teacher, np.zeros((10, AUXILIARY)), MOUNT,
        )
        for _ in range(count)
    ]  # fmt: skip


def test_datasets_are_joined_and_chosen_from_in_order():
    """Rows 0 and 1 are of the first, 2 to 4 of the second."""
    first, second = flights(2), flights(3)
    joined = Joined([first, second])
    assert [*joined] == [*first, *second]
    assert [*joined.chosen([4, 0])] == [second[2], first[0]]
    assert joined[1:3] == [first[1], second[0]]


def test_as_many_steps_as_asked_in_equal_stages():
    """Eight steps in four stages of two; two steps are two stages of one."""
    learner = Learner(SHAPE, Schedule(batch=2), "cpu")
    done = [learner.trained.steps for _ in clone([learner], flights(3), NOMINAL, steps=8)]
    assert done == [2, 4, 6, 8]
    assert len(list(clone([learner], flights(3), NOMINAL, steps=2))) == 2
    assert learner.trained.steps == 10


def test_the_error_is_the_root_mean_square_of_the_difference():
    """A network whose last layer is zero but for its bias answers that: 0.1 off in one of four
    commands is 0.05, by hand.
    """
    learner = Learner(SHAPE, Schedule(batch=2), "cpu")
    with torch.no_grad():
        learner.average.commands.weight.zero_()
        learner.average.commands.bias.copy_(torch.tensor([0.6, -0.2, 0.1, 0.3]))
    assert command_error(learner, flights(2)) == pytest.approx(0.05, rel=1e-5)


def test_the_error_on_flights_held_out_falls():
    """An answer that does not depend on the image: learned to a quarter in 60 steps."""
    learner = Learner(SHAPE, Schedule(batch=4, rate=1e-2), "cpu")
    before = command_error(learner, flights(2, seed=9))
    list(clone([learner], flights(6), NOMINAL, steps=60))
    assert command_error(learner, flights(2, seed=9)) < 0.25 * before


def test_a_loss_that_is_not_finite_is_one_sentence():
    """A label that is nan."""
    learner, bad = Learner(SHAPE, Schedule(batch=2), "cpu"), flights(1)
    bad[0].teacher[3] = np.nan
    with pytest.raises(InputError, match="expected a finite loss, got nan"):
        list(clone([learner], bad, NOMINAL, steps=1))
