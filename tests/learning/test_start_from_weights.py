"""A training that begins from the weights of a file."""

import numpy as np
import pytest
import torch

from falconwing_kit.core.checks import InputError
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.learning.learner import Learner, MaskLearner, Schedule, save_policy
from falconwing_kit.tools.trials.train_policy import make_learners
from falconwing_kit.vision.leader_mask import leader_mask
from falconwing_kit.vision.policy import Policy, PolicyShape

CAMERA = fpv_camera(32, 24)


def learner(seed, memory=8, sees="rgb_mask"):
    """A small one with random weights and statistics, and its masks."""
    schedule = Schedule(seed=seed)
    shape = PolicyShape(
        32, 24, sees, ((4, 3, 2), (6, 3, 2), (5, 1, 1)), 10, memory=memory, history=3, hidden=7
    )
    masks = MaskLearner(schedule, "cpu") if sees != "rgb" else None
    made = Learner(shape, schedule, "cpu", "policy", masks)
    generator = torch.Generator().manual_seed(seed)
    for trained in [made.trained] + ([masks.trained] if masks else []):
        for name, value in trained.network.state_dict().items():
            if value.dtype.is_floating_point:
                offset = 0.5 if name.endswith("running_var") else 0.0
                value.copy_(torch.rand(value.shape, generator=generator) * 0.3 + offset)
        trained.average.load_state_dict(trained.network.state_dict())
    return made


@pytest.fixture
def saved(tmp_path):
    """A policy in a file."""
    save_policy(learner(3), tmp_path / "policy.safetensors", "follow", CAMERA)
    return Policy.load(tmp_path / "policy.safetensors")


@pytest.mark.parametrize("calibrated", [False, True])
def test_a_network_restored_computes_what_the_file_does(saved, calibrated):
    """NumPy from the file, PyTorch from the same: one function, before and after its statistics
    are those of a batch; then also in training mode, where the batch is normalised by itself.
    """
    made = learner(4)
    made.start_from(saved)
    generator = np.random.default_rng(0)
    images = generator.random((5, 24, 32, 3), np.float32)
    batch = torch.from_numpy(images.transpose(0, 3, 1, 2).copy())
    masks = np.stack([leader_mask(image, saved.weights) for image in images])
    found = made.masks.find(batch)
    np.testing.assert_allclose(found[:, 0].numpy(), masks, atol=2e-5)
    seen = torch.cat([batch, found], dim=1)
    network = made.trained.network
    before = made.average.encode(seen).detach().numpy()
    if calibrated:
        made.trained.calibrate(lambda: network.encode(seen))
        np.testing.assert_allclose(made.average.encode(seen).detach(), before, atol=2e-4)
        network.train()
        np.testing.assert_allclose(network.encode(seen).detach(), before, atol=2e-3)
        running = [u.norm.running_mean.abs().max().item() for u in network.units]
        assert min(running) > 1e-3  # or nothing was calibrated
    direct = np.stack([saved.encode(image) for image in images])
    np.testing.assert_allclose(before, direct, atol=2e-4)


def test_weights_of_another_shape_are_refused(saved):
    """A policy without a memory cannot begin from one with a memory."""
    with pytest.raises(InputError, match="expected weights of a network of this shape"):
        learner(4, memory=0).start_from(saved)


@pytest.mark.parametrize("sees", ["rgb", "mask"])
def test_colours_or_masks_alone_begin_from_the_weights_of_both(saved, sees):
    """Where the other part says nothing, a mask of zeros or a grey image, both compute the same."""
    made, both = learner(4, sees=sees), learner(4)
    made.start_from(saved)
    both.start_from(saved)
    rng = np.random.default_rng(1)
    images = torch.from_numpy(rng.random((3, 3, 24, 32), np.float32))
    masks = torch.from_numpy(rng.random((3, 1, 24, 32), np.float32))
    if sees == "rgb":
        own, seen = images, torch.cat([images, torch.zeros_like(masks)], dim=1)
    else:
        own, seen = masks, torch.cat([torch.full_like(images, 0.5), masks], dim=1)
        assert torch.equal(made.masks.find(images), both.masks.find(images))
    np.testing.assert_allclose(
        made.average.encode(own).detach(), both.average.encode(seen).detach(), atol=1e-5
    )


@pytest.mark.parametrize("name", ["student", "rgb", "mask", "rgb_mask"])
def test_learners_without_a_memory_read_the_past_30_commands(name):
    """As the paper's policies do; with a memory, the last three."""
    for memory, commands in ((False, 30), (True, 3)):
        (made,) = make_learners([name], "follow", CAMERA, Schedule(), "cpu", memory=memory)
        assert bool(made.shape.memory) is memory and made.shape.history == commands
        assert made.shape.sees == ("rgb" if name == "student" else name)
