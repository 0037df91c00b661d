"""Pose net: geometry of poses known by construction, lenses, weight files, and bad input."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import R_BODY_CAMERA, rotation_world_body
from falconwing_kit.scene import PinholeCamera
from falconwing_kit.vision.pose_net import PoseNet, PoseNetRecord, cell_rays
from falconwing_kit.vision.pose_network import (
    PoseNetOutput,
    PoseNetShape,
    PoseNetwork,
    fuse_pose,
    load_vit,
    rotations,
    so3_exp,
    so3_log_between,
)

LOW, HIGH = (-10.0, -5.0, 0.0), (10.0, 5.0, 4.0)
SMALL = PoseNetShape(width=64, height=48, features=32, layers=1, heads=2)
ANGLES = np.array([0.4, -0.2, 2.5])  # roll, pitch, yaw [rad], all signs and axes different
PLACE = np.array([1.0, -2.0, 1.5])


def small_net(shape=SMALL, seed=0):
    torch.manual_seed(seed)
    record = PoseNetRecord(asdict(shape), 0.62, LOW, HIGH)
    return PoseNet(PoseNetwork(shape, torch.tensor(LOW), torch.tensor(HIGH)), record)


@pytest.fixture
def net():
    return small_net()


def output_about(rays, token_error=0.0, outlier_share=0.0, seed=1):
    """Output of a network: right cells but for a share of outliers, and a token with an error."""
    rng = np.random.default_rng(seed)
    R_world_camera = rotation_world_body(*ANGLES) @ R_BODY_CAMERA
    points = PLACE + rng.uniform(2.0, 15.0, (len(rays), 1)) * rays @ R_world_camera.T
    outliers = rng.random(len(rays)) < outlier_share
    points[outliers] += rng.normal(0.0, 5.0, (outliers.sum(), 3))
    angles = ANGLES + 0.2 * token_error
    return PoseNetOutput(
        position=torch.tensor(PLACE + token_error)[None].float(),
        log_sigma_position=torch.full((1, 3), np.log(3.0)),
        sincos=torch.tensor(np.stack([np.sin(angles), np.cos(angles)], axis=-1))[None].float(),
        log_sigma_angle=torch.full((1,), np.log(1.0)),
        points=torch.tensor(points)[None].float(),
        log_sigma_points=torch.full((1, len(rays)), np.log(0.05)),
    ), R_world_camera


def fused_numpy(output, rays, log_trust=-3.0):
    return (
        part[0].numpy()
        for part in fuse_pose(output, torch.tensor(rays).float(), torch.tensor(log_trust), 8)
    )


def test_rotation_is_that_of_the_frames():
    """Equal to core/frames.py, which has tests of its own; sines and cosines need no length 1."""
    angles = np.random.default_rng(0).uniform(-1.4, 1.4, (20, 3)) * (2.0, 1.0, 2.0)
    sincos = 3.0 * np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    expected = rotation_world_body(*angles.T) @ R_BODY_CAMERA
    assert np.allclose(rotations(torch.tensor(sincos)).numpy(), expected, atol=1e-12)


def test_rotation_vectors_equal_scipy():
    """SciPy's rotation vectors and back, of R R_from^T up to nearly half a turn, and of none."""
    turns = Rotation.random(50, random_state=1)
    R_from = Rotation.random(50, random_state=2)
    found = so3_log_between(
        torch.tensor((turns * R_from).as_matrix()), torch.tensor(R_from.as_matrix())
    )
    assert np.allclose(found.numpy(), turns.as_rotvec(), atol=1e-6)
    w = np.concatenate([turns.as_rotvec(), np.zeros((1, 3)), np.full((1, 3), 1e-9)])
    assert np.allclose(
        so3_exp(torch.tensor(w)).numpy(), Rotation.from_rotvec(w).as_matrix(), atol=1e-12
    )


def test_cells_that_agree_determine_the_pose(net):
    """By construction the cells hold the pose; a token 0.5 m and 6 deg off moves it by far less
    than its weight.
    """
    rays = cell_rays(net.record.camera)
    output, R_truth = output_about(rays, token_error=0.5)
    R, position, _ = fused_numpy(output, rays)
    assert np.abs(position - PLACE).max() < 0.01
    assert np.degrees(Rotation.from_matrix(R @ R_truth.T).magnitude()) < 0.1


def test_outlier_cells_are_rejected(net):
    """By construction a fifth of the cells is 5 m off; least squares without a robust weight misses
    by half a metre.
    """
    rays = cell_rays(net.record.camera)
    output, _ = output_about(rays, token_error=0.5, outlier_share=0.2)
    _, position, _ = fused_numpy(output, rays)
    assert np.abs(position - PLACE).max() < 0.1


def test_cells_without_weight_leave_the_token_pose(net):
    """By hand: with no weight on the cells, pose and information are the token's own."""
    rays = cell_rays(net.record.camera)
    output, _ = output_about(rays, token_error=0.5)
    R, position, information = fused_numpy(output, rays, log_trust=-60.0)
    assert np.allclose(position, PLACE + 0.5, atol=1e-5)
    assert np.allclose(R, rotation_world_body(*(ANGLES + 0.1)) @ R_BODY_CAMERA, atol=1e-5)
    assert np.allclose(information, np.diag([1 / 9, 1 / 9, 1 / 9, 1, 1, 1]), atol=1e-5)


def test_information_is_the_curvature_of_the_cost(net):
    """The second difference of half the squared object-space errors, worked out here for each of
    the six directions.
    """
    rays = cell_rays(net.record.camera)
    output, R_truth = output_about(rays)
    points = output.points[0].numpy().astype(np.float64)
    _, _, information = fused_numpy(output, rays)
    weight = np.exp(-3.0) / 0.05**2 * (3.0 + 2.0) / 3.0  # where errors vanish

    def cost(step):
        R = Rotation.from_rotvec(step[3:]).as_matrix() @ R_truth
        toward, d = points - (PLACE + step[:3]), rays @ R.T
        return 0.5 * weight * ((toward - (toward * d).sum(1, keepdims=True) * d) ** 2).sum()

    h = 1e-4
    curvature = [(cost(h * e) - 2.0 * cost(0.0 * e) + cost(-h * e)) / h**2 for e in np.eye(6)]
    prior = [1 / 9, 1 / 9, 1 / 9, 1, 1, 1]
    assert np.allclose(np.diag(information), np.add(curvature, prior), rtol=2e-3)


def test_cells_come_row_by_row():
    """By hand for 3 x 4 patches of 2 x 2 cells: the cell in row r, column c is 2 (r mod 2) + c mod
    2 in its patch.
    """
    network = PoseNetwork(SMALL, -torch.ones(3), torch.ones(3))

    class Counting(torch.nn.Module):
        def forward(self, tokens):
            numbers = torch.arange(12.0)[:, None] + 100.0 * torch.arange(4.0).repeat_interleave(4)
            return numbers[None]

    network.point_head = Counting()
    points = network(torch.zeros(1, 3, 48, 64)).points[0, :, 0].reshape(6, 8)
    r, c = torch.meshgrid(torch.arange(6), torch.arange(8), indexing="ij")
    assert torch.equal(points, (r // 2) * 4 + c // 2 + 100.0 * (2 * (r % 2) + c % 2))


def slopes(camera):
    """Image (H, W, 3) that encodes the ray of each pixel: 100 + 60 x/z, 100 + 60 y/z."""
    rays = camera.pixel_rays()
    return np.round(100.0 + 60.0 * rays).clip(0, 255).astype(np.uint8)


LENSES = {
    "same view, ten times the pixels": PinholeCamera(396.8, 396.8, 320, 240, 640, 480),
    "wider": PinholeCamera(300.0, 300.0, 320, 240, 640, 480),
    "off centre": PinholeCamera(300.0, 300.0, 290, 260, 640, 480),
    "another aspect": PinholeCamera(396.8, 396.8, 320, 300, 640, 600),
    "flat pixels": PinholeCamera(300.0, 250.0, 320, 240, 640, 480),
}


@pytest.mark.parametrize("lens", LENSES)
def test_any_lens_is_brought_to_the_view_trained_for(net, lens):
    """Each pixel must look where the net's own camera looks; a rounded edge is 0.2 levels, a byte
    half one.
    """
    seen = (
        net.resample(torch.from_numpy(slopes(LENSES[lens]))[None], LENSES[lens])[0]
        .permute(1, 2, 0)
        .numpy()
    )
    expected = 100.0 + 60.0 * net.record.camera.pixel_rays()
    inner = slice(1, -1)  # at the edge of the picture a filter has nothing to weigh against
    assert np.abs(255.0 * seen - expected)[inner, inner, :2].max() < 1.2


def test_a_slightly_narrower_lens_keeps_its_scale(net):
    """Two per cent more focal length: what it sees must still lie where it was; its rim repeats the
    edge.
    """
    lens = PinholeCamera(405.0, 405.0, 320, 240, 640, 480)
    seen = net.resample(torch.from_numpy(slopes(lens))[None], lens)[0].permute(1, 2, 0).numpy()
    expected = 100.0 + 60.0 * net.record.camera.pixel_rays()
    assert np.abs(255.0 * seen - expected)[2:-2, 2:-2, :2].max() < 1.2


def test_a_tele_lens_is_refused_with_both_angles(net):
    """By hand: 2 atan(0.5 / 0.62) = 78 deg were trained for, 2 atan(320 / 800) = 44 deg came."""
    with pytest.raises(InputError, match=r"78 deg.*44 deg"):
        net.estimate(np.zeros((480, 640, 3), np.uint8), PinholeCamera(800, 800, 320, 240, 640, 480))


@pytest.mark.parametrize(
    "image", [np.zeros((48, 64), np.uint8), np.zeros((48, 64, 3)), np.zeros((48, 63, 3), np.uint8)]
)
def test_images_of_another_kind_or_size_are_refused(net, image):
    """Grey, floats, and another size."""
    with pytest.raises(InputError, match="image: expected"):
        net.estimate(image, net.record.camera)


def test_estimate_of_a_blank_image_is_a_pose_with_covariance(net):
    """A grey image contains no pose, yet the estimate is a rigid pose with a covariance (6, 6)."""
    estimate = net.estimate(np.full((48, 64, 3), 128, np.uint8), net.record.camera)
    R = estimate.T_world_camera[:3, :3]
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0.0
    assert estimate.T_world_camera[3].tolist() == [0, 0, 0, 1]
    variances = np.diag(estimate.covariance)
    assert (np.linalg.eigvalsh(estimate.covariance) > 0.0).all()
    assert estimate.sigma_position == pytest.approx(np.sqrt(variances[:3].mean()))
    assert estimate.sigma_attitude == pytest.approx(np.sqrt(variances[3:].mean()))


def test_sigma_scales_multiply_what_is_stated(net):
    """By hand: position times two, rotation times three, their covariance times six."""
    record = PoseNetRecord(asdict(SMALL), 0.62, LOW, HIGH, sigma_scales=(2.0, 3.0))
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    plain = net.estimate(image, net.record.camera).covariance
    scaled = PoseNet(net.network, record).estimate(image, record.camera).covariance
    factors = np.kron([[4.0, 6.0], [6.0, 9.0]], np.ones((3, 3)))
    assert np.allclose(scaled, factors * plain)


def test_a_saved_net_estimates_the_same(net, tmp_path):
    """Half precision keeps three digits; an untrained network's answers are of the size of its box,
    10 m.
    """
    net.save(tmp_path / "net.safetensors")
    again = PoseNet.load(tmp_path / "net.safetensors")
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    first, second = (
        each.estimate(image, net.record.camera).T_world_camera for each in (net, again)
    )
    assert np.allclose(first, second, atol=0.02)
    assert (again.record.shape, again.record.low, again.record.high) == (
        asdict(SMALL),
        [*LOW],
        [*HIGH],
    )


def test_distance_outside_the_training_is_that_to_the_nearer_box(net, tmp_path):
    """By hand: cameras in training were half a metre inside the hall's box and, if there were
    approaches, in their box, which a saved net remembers.
    """
    (x, y, z), below = LOW, np.array([0.0, 0.0, -0.3])
    corner = np.array([x, y, z]) + 0.5
    assert net.extrapolation(corner) == 0.0
    assert net.extrapolation(corner + below) == pytest.approx(0.3)
    lower = tuple((corner + 2.0 * below).tolist()), tuple((corner + below / 3.0).tolist())
    PoseNet(net.network, replace(net.record, approach=lower)).save(tmp_path / "net.safetensors")
    with_approach = PoseNet.load(tmp_path / "net.safetensors")
    assert with_approach.extrapolation(corner + below) == 0.0
    assert with_approach.extrapolation(corner + 3.0 * below) == pytest.approx(0.3)
    assert with_approach.extrapolation(corner + below / 6.0) == pytest.approx(0.05)


def test_default_network_ships_below_8_mb(tmp_path):
    """The bar of the project for weights in half precision."""
    small_net(PoseNetShape()).save(tmp_path / "net.safetensors")
    assert (tmp_path / "net.safetensors").stat().st_size < 8e6


def test_damaged_and_other_files_are_refused(net, tmp_path):
    """Cut short, emptied, of another kind, and not there."""
    net.save(tmp_path / "net.safetensors")
    data = (tmp_path / "net.safetensors").read_bytes()
    for damage in (data[: len(data) // 2], b"", b"\xff" * 100, data[:8] + b"x" + data[9:]):
        (tmp_path / "bad.safetensors").write_bytes(damage)
        with pytest.raises(InputError, match="damaged or other"):
            PoseNet.load(tmp_path / "bad.safetensors")
    with pytest.raises(InputError, match="a name that ships"):
        PoseNet.load("gym")
    with pytest.raises(FileNotFoundError):
        PoseNet.load(tmp_path / "none.safetensors")


def test_pretrained_vit_is_loaded_by_its_usual_names():
    """A hand-made file of one layer, a grid of 2 x 2: eleven tensors fit, its head does not; a flat
    grid stays flat.
    """
    shape = PoseNetShape(width=64, height=48, features=32, layers=1, heads=2, stem="patch")
    network = PoseNetwork(shape, torch.tensor(LOW), torch.tensor(HIGH))
    block = {"norm1": (32,), "attn.qkv": (96, 32), "attn.proj": (32, 32), "norm2": (32,)}
    block |= {"mlp.fc1": (128, 32), "mlp.fc2": (32, 128)}
    tensors = {f"blocks.0.{name}.weight": torch.full(size, 0.5) for name, size in block.items()}
    tensors |= {
        "patch_embed.proj.weight": torch.ones(32, 3, 16, 16),
        "patch_embed.proj.bias": torch.ones(32),
    }
    tensors |= {"norm.weight": torch.ones(32), "head.weight": torch.ones(1000, 32)}
    tensors |= {"cls_token": torch.ones(1, 1, 32), "pos_embed": torch.full((1, 5, 32), 0.25)}
    assert load_vit(network, tensors) == 11
    assert network.blocks[0].attn.qkv.weight.detach().unique().tolist() == [0.5]
    assert torch.allclose(network.pos_embed, torch.tensor(0.25))
    assert network.pos_embed.shape == (1, 1 + 3 * 4, 32)


def test_batch_normalisation_folded_for_flying_changes_no_output():
    net = small_net()
    torch.manual_seed(1)
    for module in net.network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            for value in (module.running_mean, module.bias.data):
                value.normal_()
            for value in (module.running_var, module.weight.data):
                value.uniform_(0.5, 2.0)
    net = PoseNet(net.network, net.record)
    camera = net.record.camera
    image = np.random.default_rng(2).integers(0, 256, (camera.height, camera.width, 3), np.uint8)
    flown = net.predict(image, camera)
    with torch.no_grad():
        trained = net.network(net.resample(torch.from_numpy(image)[None], camera))
    for got, expected in zip(flown, trained, strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)
