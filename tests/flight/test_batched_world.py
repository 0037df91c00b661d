"""Batched world: row by row the single world, for states, measurements and contacts."""

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import paper_model
from falconwing_kit.control.expert import landing_path
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, State
from falconwing_kit.flight.batched_world import BatchedWorld
from falconwing_kit.flight.tasks import LandingTask
from falconwing_kit.flight.world import SimulatedWorld

TASK = LandingTask()
HOLD = np.array([0.2, 0.0, 0.0, 0.0])  # close to level flight


def single(start, seed):
    state = State.from_vector(start)
    return SimulatedWorld(TASK.model, TASK.airframe, state, seed=seed, pad=TASK.pad)


def starts(count):
    return np.array([TASK.spread.start(TASK.model, TASK.nominal, k).vector for k in range(count)])


def near_the_pad():
    """Level over the pad, a hand above its top, slowly down; and beside it."""
    path, _ = landing_path(TASK.airframe, TASK.pad)
    low = starts(2)
    low[:, :2], low[:, 2] = path.p_world[-60, :2], path.p_world[-60, 2] + 0.1
    low[:, 3:6], low[:, 6:9] = (0.05, 0.0, 0.0), (7.0, 0.0, -0.3)
    low[1, 1] += 3.0
    return low


def test_rows_are_the_single_world():
    """Four flights by random sticks and two that touch at once, until all have ended: states and
    measurements within 1e-7 of `SimulatedWorld`, which goes through one servo window of 0.6 s every
    step; the same contacts. A lost command, delay or noise is a thousand times larger.
    """
    x = np.concatenate([starts(4), near_the_pad()])
    worlds = [single(start, seed) for seed, start in enumerate(x)]
    batch = BatchedWorld(TASK.model, TASK.airframe, len(x), pad=TASK.pad)
    batch.begin(range(len(x)), x, range(len(x)))
    rng = np.random.default_rng(0)
    for k in range(100):
        for row, world in enumerate(worlds):
            assert batch.x[row] == pytest.approx(world.state.vector, abs=1e-7)
            assert batch.measured[row] == pytest.approx(world.measured().vector, abs=1e-7)
        sticks = HOLD + 0.2 * rng.normal(size=(len(x), 4))
        commands = np.clip(sticks, (0.0, -1.0, -1.0, -1.0), 1.0)
        for world, command in zip(worlds, commands, strict=True):
            world.send(k * CONTROL_PERIOD_S, Command(*command))
            world.advance((k + 1) * CONTROL_PERIOD_S)
        batch.advance(commands)
    contacts = [(world.contact, found) for world, found in zip(worlds, batch.contacts, strict=True)]
    for alone, found in contacts:
        assert (alone is None) == (found is None)
        if alone is not None:
            assert found.obstacle == alone.obstacle
            assert found.t == pytest.approx(alone.t, abs=1e-6)
    kinds = {found.obstacle for _, found in contacts if found}
    assert {"pad", "floor"} <= kinds  # the comparison saw a landing and a failure


def test_a_row_may_begin_while_another_flies():
    """Its first command also acts before its time, as in a world of its own; the clocks differ."""
    x = starts(2)
    batch = BatchedWorld(TASK.model, TASK.airframe, 2, pad=TASK.pad)
    batch.begin([0], x[:1], [0])
    for _ in range(7):
        batch.advance(np.tile(HOLD, (2, 1)))
    batch.begin([1], x[1:], [1])
    world = single(x[1], 1)
    for k in range(20):
        command = HOLD + np.array([0.0, 0.1 * ((k + 1) % 3), 0.0, 0.0])
        batch.advance(np.stack([HOLD, command]))
        world.send(k * CONTROL_PERIOD_S, Command(*command))
        world.advance((k + 1) * CONTROL_PERIOD_S)
    assert batch.x[1] == pytest.approx(world.state.vector, abs=1e-7)
    assert batch.frames.tolist() == [27, 20]


def test_what_it_cannot_fly_is_refused():
    """The 9-state model, an effect on commands, a start that is not finite."""
    with pytest.raises(InputError, match="12-state model"):
        BatchedWorld(paper_model(), TASK.airframe, 1)
    deadband = next(effect for effect in CATALOGUE if effect.command_map is not None)
    with pytest.raises(InputError, match="SimulatedWorld"):
        BatchedWorld(TASK.model.with_effect(deadband), TASK.airframe, 1)
    batch = BatchedWorld(TASK.model, TASK.airframe, 1)
    with pytest.raises(InputError, match="finite"):
        batch.begin([0], np.full((1, 12), np.nan), [0])
