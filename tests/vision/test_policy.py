"""Policy: its layers agree with PyTorch's; weights and cameras that do not fit are refused."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from falconwing_kit.core.checks import InputError
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.vision.layers import convolve, gated_recurrent_unit, layer_norm
from falconwing_kit.vision.leader_mask import leader_mask
from falconwing_kit.vision.mask_network import MaskNetwork
from falconwing_kit.vision.policy import (
    Policy,
    PolicyRecord,
    PolicyShape,
    policy_inputs,
    weight_shapes,
)
from falconwing_kit.vision.policy_network import ConvUnit, PolicyNetwork

SMALL = PolicyShape(
    32, 24, convolutions=((6, 5, 2), (8, 3, 1), (4, 1, 1)), features=12, memory=10, hidden=8
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def policy_of(shape, rng, task="landing"):
    """A policy with random weights, as large as those of a fresh network."""
    weights = {
        name: (rng.normal(size=size) / np.sqrt(np.prod(size[1:]) or 1.0)).astype(np.float32)
        for name, size in weight_shapes(shape).items()
    }
    return Policy(weights, PolicyRecord(asdict(shape), task, 0.62)), weights


@pytest.mark.parametrize("filters", [2, 5])  # fewer than channels, and more
@pytest.mark.parametrize(("kernel", "stride"), [(1, 1), (3, 1), (5, 1), (3, 2), (5, 2)])
def test_a_convolution_is_pytorchs(rng, kernel, stride, filters):
    """Against torch.nn.functional, on odd and even sides."""
    x = rng.normal(size=(3, 15, 22)).astype(np.float32)
    weight = rng.normal(size=(filters, 3, kernel, kernel)).astype(np.float32)
    expected = torch.nn.functional.conv2d(
        torch.tensor(x)[None], torch.tensor(weight), stride=stride, padding=kernel // 2
    )[0]
    assert convolve(x, weight, stride) == pytest.approx(expected.numpy(), abs=1e-4)


def test_the_recurrent_unit_is_pytorchs(rng):
    """Two steps against torch.nn.GRU with the same weights; the second reads the first's memory."""
    unit = torch.nn.GRU(7, 5, batch_first=True)
    W = [getattr(unit, f"{name}_l0").detach().numpy()
         for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]  # fmt: skip
    x, h = rng.normal(size=(2, 7)).astype(np.float32), np.zeros(5, np.float32)
    expected = unit(torch.tensor(x)[None])[0][0].detach().numpy()
    for k in range(2):
        h = gated_recurrent_unit(x[k], h, *W)
        assert h == pytest.approx(expected[k], abs=1e-6)


def test_a_layer_norm_is_pytorchs(rng):
    """Against torch.nn.functional."""
    x = rng.normal(3.0, 2.0, 40).astype(np.float32)
    expected = torch.nn.functional.layer_norm(torch.tensor(x), (40,)).numpy()
    assert layer_norm(x) == pytest.approx(expected, abs=1e-5)


def shaken(network):
    """A network in evaluation, its batch normalisations with running statistics of their own."""
    for unit in network.modules():
        if isinstance(unit, ConvUnit):
            torch.nn.init.normal_(unit.norm.running_mean)
            torch.nn.init.uniform_(unit.norm.running_var, 0.5, 2.0)
            torch.nn.init.normal_(unit.norm.bias)
    return network.eval()


@pytest.mark.parametrize("size", [(24, 32), (21, 30)])
def test_a_mask_is_its_networks(size, rng):
    """Against PyTorch, also where a side cannot be halved three times."""
    network = shaken(MaskNetwork())
    torch.nn.init.normal_(network.out.weight)
    torch.nn.init.zeros_(network.out.bias)
    image = rng.random((*size, 3)).astype(np.float32)
    weights = {name: w.numpy() for name, w in network.weights().items()}
    with torch.no_grad():
        expected = torch.sigmoid(network(torch.tensor(image).permute(2, 0, 1)[None]))[0]
    found = leader_mask(image, weights)
    assert found == pytest.approx(expected.numpy(), abs=1e-4)
    assert found.std() > 0.01


@pytest.mark.parametrize(
    "shape",
    [SMALL, replace(SMALL, memory=0, history=30), replace(SMALL, sees="rgb_mask"),
     replace(SMALL, sees="mask")],
)  # fmt: skip
def test_a_policy_flies_as_its_network_does(shape, rng):
    """Three steps of the network in evaluation, which is given the image, its mask, or both."""
    network, finder = shaken(PolicyNetwork(shape, auxiliary=3)), shaken(MaskNetwork())
    weights = {name: w.numpy() for name, w in network.weights().items()}
    if shape.sees != "rgb":
        weights |= {name: w.numpy() for name, w in finder.weights().items()}
    policy = Policy(weights, PolicyRecord(asdict(shape), "landing", 0.62))
    images = rng.random((3, 24, 32, 3)).astype(np.float32)
    past = rng.normal(size=(3, 30, 4))
    inputs = policy_inputs(past, np.array([0.0, 0.05, np.nan]), (0.2, 0.0, 0.0), shape.history)
    with torch.no_grad():
        seen = torch.tensor(images).permute(0, 3, 1, 2)
        masks = torch.sigmoid(finder(seen))[:, None]
        seen = {"rgb": seen, "mask": masks, "rgb_mask": torch.cat([seen, masks], 1)}[shape.sees]
        features = network.encode(seen)
        expected, *_ = network(features[None], torch.tensor(inputs)[None])
    memory = policy.start_memory()
    for k in range(3):
        commands, memory = policy.step(policy.encode(images[k]), inputs[k], memory)
        assert commands == pytest.approx(expected[0, k].numpy(), abs=1e-4)


def test_the_inputs_are_the_newest_commands_the_age_and_the_mount():
    """By hand: two of three commands, an image of 50 ms, a camera 25 cm ahead."""
    past = np.arange(12.0).reshape(3, 4)
    found = policy_inputs(past, 0.05, (0.25, 0.0, -0.05), history=2)
    assert found == pytest.approx([4, 5, 6, 7, 8, 9, 10, 11, 1, 0.5, 1.0, 0.0, -0.2])
    none = policy_inputs(past, np.nan, (0.25, 0.0, 0.0), history=2)
    assert none[8:10] == pytest.approx([0.0, 0.0])  # no image, so no age


def test_light_and_contrast_do_not_change_the_features(rng):
    """An image times 0.5 plus 0.2 is the same after its mean and deviation are taken out."""
    policy, _ = policy_of(SMALL, rng)
    image = rng.random((24, 32, 3)).astype(np.float32)
    dimmed = (0.5 * image + 0.2).astype(np.float32)
    assert policy.encode(dimmed) == pytest.approx(policy.encode(image), abs=1e-4)


def test_a_larger_image_is_averaged_and_a_wider_one_is_cropped(rng):
    """Blocks of 2 x 2 equal pixels give the small image; of a lens with half the focal length, the
    middle quarter is the trained view.
    """
    policy, _ = policy_of(SMALL, rng)
    small = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    double = small.repeat(2, axis=0).repeat(2, axis=1)
    expected = small / np.float32(255.0)
    assert policy.resample(double, fpv_camera(64, 48)) == pytest.approx(expected, abs=1e-6)
    wide = np.zeros((48, 64, 3), np.uint8)
    wide[12:36, 16:48] = small
    lens = replace(fpv_camera(64, 48), fx=0.62 * 32, fy=0.62 * 32)
    assert policy.resample(wide, lens) == pytest.approx(expected, abs=1e-6)


def test_a_narrow_lens_is_refused(rng):
    """It shows a ninth of the trained view."""
    policy, _ = policy_of(SMALL, rng)
    lens = replace(fpv_camera(64, 48), fx=3 * 0.62 * 64, fy=3 * 0.62 * 64)
    with pytest.raises(InputError, match="three quarters of the trained field of view"):
        policy.resample(np.zeros((48, 64, 3), np.uint8), lens)


def save_file(path, weights, record):
    path.write_bytes(save(weights, {"policy": json.dumps(asdict(record))}))
    return path


def test_weights_are_read_back(tmp_path, rng):
    """Half precision has eleven bits: the commands differ by less than a per mille of one."""
    policy, weights = policy_of(SMALL, rng)
    half = {name: w.astype(np.float16) for name, w in weights.items()}
    read = Policy.load(save_file(tmp_path / "a.safetensors", half, policy.record))
    image = rng.random((24, 32, 3)).astype(np.float32)
    inputs = policy_inputs(np.zeros((30, 4)), 0.0, (0.0, 0.0, 0.0), SMALL.history)
    first, second = (p.step(p.encode(image), inputs, p.start_memory())[0] for p in (policy, read))
    assert second == pytest.approx(first, abs=2e-3)


@pytest.mark.parametrize("damage", ["nan", "missing", "shape", "version", "cut", "other"])
def test_damaged_weights_are_one_sentence(tmp_path, rng, damage):
    """Never a traceback, and never a flight."""
    policy, weights = policy_of(SMALL, rng)
    record, path = policy.record, tmp_path / "a.safetensors"
    if damage == "nan":
        weights["head.bias"][0] = np.nan
    if damage == "missing":
        del weights["head.bias"]
    if damage == "shape":
        weights["head.bias"] = np.zeros(3, np.float32)
    if damage == "version":
        record = replace(record, version=99)
    save_file(path, weights, record)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    if damage == "other":
        path.write_bytes(b"no weights")
    with pytest.raises(InputError, match=r"weights: expected|expected weights of a policy"):
        Policy.load(path)
