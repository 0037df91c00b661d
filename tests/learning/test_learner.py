"""Learner: several networks and the one that finds the leader learn from the same flights."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from falconwing_kit.core.checks import InputError
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.learning.flight_appearance import FlightAppearance
from falconwing_kit.learning.flights import AUXILIARY, PAST
from falconwing_kit.learning.imitation import name_losses
from falconwing_kit.learning.learner import (
    Flown,
    Learner,
    MaskLearner,
    Schedule,
    draw_batch,
    load_state,
    save_policy,
    save_state,
    train_together,
)
from falconwing_kit.learning.situations import NOMINAL
from falconwing_kit.vision.policy import Policy, PolicyShape, policy_inputs

SHAPE = PolicyShape(32, 24, convolutions=((6, 5, 2), (8, 3, 2)), features=16, memory=16, hidden=16)
PAPER = replace(SHAPE, memory=0, history=PAST)
MOUNT = np.array([0.2, 0.0, 0.0])


@pytest.fixture(autouse=True)
def plain_light(monkeypatch):
    """Images as they are, with nothing covered."""
    monkeypatch.setattr(FlightAppearance, "apply", lambda self, images, flights: images)
    nothing = lambda self, size, flights: torch.zeros(len(flights), *size, dtype=torch.bool)  # noqa: E731
    monkeypatch.setattr(FlightAppearance, "covers", nothing)


def flights(count, with_masks=True):
    """A white block of 6 x 4 px somewhere on noise; the aileron is its place."""
    rng, found = np.random.default_rng(5), []
    for _ in range(count):
        images = torch.from_numpy(rng.integers(0, 120, (6, 3, 24, 32), dtype=np.uint8))
        masks, teacher = torch.zeros(6, 24, 32, dtype=torch.uint8), np.zeros((6, 4))
        for k in range(6):
            row, column = rng.integers(0, 20), rng.integers(0, 26)
            images[k, :, row : row + 4, column : column + 6] = 255
            masks[k, row : row + 4, column : column + 6] = 255
            teacher[k, 1] = column / 13.0 - 1.0
        sent = rng.uniform(-1.0, 1.0, (6, 4))
        found.append(
            Flown(images, masks if with_masks else None, sent, teacher, np.zeros((6, AUXILIARY)),
                  MOUNT)
        )  # fmt: skip
    return found


def learners(rate=5e-3):
    """One by colours with a memory and one by masks without, as two pilots of the kit."""
    schedule = Schedule(batch=6, rate=rate, average=0.9)
    masks = MaskLearner(schedule, "cpu")
    return [
        Learner(SHAPE, schedule, "cpu", "student"),
        Learner(replace(PAPER, sees="mask"), schedule, "cpu", "mask", masks),
    ]


def overlap(finder):
    """2 |A and B| / (|A| + |B|) of the masks that are found in other flights."""
    held = flights(8)[-2:]
    images = torch.cat([each.images for each in held]).float() / 255.0
    truth = torch.cat([each.masks for each in held]) > 0
    found = finder.find(images)[:, 0] > 0.5
    return 2.0 * float((found & truth).sum()) / float(found.sum() + truth.sum())


def test_the_masks_network_finds_the_block():
    """On flights that it was not trained on: nearly nothing before, most of it after 60 steps."""
    both = learners()
    finder = both[1].masks
    before = overlap(finder)
    losses = [train_together(both, flights(6), NOMINAL, 0.3) for _ in range(60)]
    assert before < 0.3 and overlap(finder) > 0.8
    named = name_losses(both, losses)
    assert set(named) == {"loss", "loss_student", "loss_mask", "loss_of_masks"}
    assert named["loss"] == pytest.approx(0.5 * (named["loss_student"] + named["loss_mask"]))


def test_a_batch_holds_what_each_network_reads():
    """The newest commands are the last columns before image, age and mount; an image of a step is
    that of its flight, and steps beyond the end of a flight have no weight.
    """
    data = flights(3)
    data[1] = replace_length(data[1], 4)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    batch = draw_batch(data, 8, NOMINAL, rng, generator)
    lengths = batch.weight.sum(1).int().tolist()
    assert set(lengths) <= {4, 6} and batch.images.shape[0] == sum(lengths)
    rows = np.random.default_rng(0).integers(3, size=8)
    for b, row in enumerate(rows):
        flown = data[row]
        n = len(flown.sent)
        own = batch.images[batch.seen[b, :n] - 1]
        assert torch.equal((255.0 * own).round().to(torch.uint8), flown.images)
        assert torch.equal(batch.masks[batch.seen[b, :n] - 1] > 0.5, flown.masks > 0)
        expected = policy_inputs(flown.sent[:3], 0.0, MOUNT, 3)
        short = batch.inputs[b, 3, 4 * (PAST - 3) :]
        assert short.numpy() == pytest.approx(expected)


def replace_length(flown, n):
    """The first n steps of a flight."""
    parts = (flown.images, flown.masks, flown.sent, flown.teacher, flown.auxiliary)
    return Flown(*(part[:n] for part in parts), MOUNT)


def test_an_interrupted_training_goes_on_with_all_networks(tmp_path):
    """Policies and the masks' network come back; a file of others, or a damaged one, is refused."""
    first, second = learners(), learners()
    for _ in range(3):
        train_together(first, flights(3), NOMINAL, 0.3)
    path = tmp_path / "state.safetensors"
    save_state(first, path)
    load_state(second, path)
    images = torch.rand(2, 3, 24, 32)
    assert torch.equal(first[1].masks.find(images), second[1].masks.find(images))
    for one, other in zip(first, second, strict=True):
        one_seen, other_seen = (each.average.encode(each.see(images)) for each in (one, other))
        assert torch.equal(one_seen, other_seen)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(InputError, match="expected an interrupted training of this network"):
        load_state(second, path)
    save_state(first[:1], path)
    with pytest.raises(InputError, match="got a damaged file or another network"):
        load_state(second, path)


def test_a_saved_pilot_finds_the_leader_by_itself(tmp_path):
    """The file holds both networks: what it computes is what both do, to half precision."""
    both = learners()
    for _ in range(20):
        train_together(both, flights(6), NOMINAL, 0.3)
    save_policy(both[1], tmp_path / "policy.safetensors", "follow", fpv_camera(32, 24))
    policy = Policy.load(tmp_path / "policy.safetensors")
    assert policy.shape.sees == "mask" and policy.record.task == "follow"
    image = flights(1)[0].images[0].float() / 255.0
    seen = both[1].see(image[None])
    found = policy.see(image.permute(1, 2, 0).numpy())
    assert found[..., 0] == pytest.approx(seen[0, 0].numpy(), abs=0.02)
    assert policy.encode(image.permute(1, 2, 0).numpy()) == pytest.approx(
        both[1].average.encode(seen)[0].detach().numpy(), abs=0.05
    )


def test_who_sees_masks_needs_them_found():
    """A learner without, and flights without: one sentence each."""
    with pytest.raises(InputError, match="expected a learner of masks for rgb_mask, got none"):
        Learner(replace(SHAPE, sees="rgb_mask"), Schedule(), "cpu")
    with pytest.raises(InputError, match="expected flights behind a leader, got others"):
        train_together(learners(), flights(2, with_masks=False), NOMINAL, 0.3)
