"""Training loop: losses are smallest at the truth, training learns, and resumes after a stop."""

import numpy as np
import pytest
import torch

from falconwing_kit.core.checks import InputError
from falconwing_kit.learning import pose_net_loop
from falconwing_kit.learning.pose_net_loop import STATE, PoseNetTrainer, TrainSchedule, losses
from falconwing_kit.learning.pose_views import sample_views
from falconwing_kit.scene import nose_camera_pose
from falconwing_kit.vision.pose_net import cell_rays
from falconwing_kit.vision.pose_network import (
    PoseNetOutput,
    PoseNetShape,
    PoseNetwork,
    fuse_pose,
    rotations,
    so3_log_between,
)
from tests.learning.halls import CAMERA, HIGH, LOW, photos_of, world

SHAPE = PoseNetShape(width=64, height=48, features=48, layers=2, heads=3)
QUICK = TrainSchedule(steps=6, minutes=10.0, batch=4, fresh=2, pool=20, first=4)
RAYS = torch.from_numpy(cell_rays(CAMERA)).float()


def network(seed=0):
    torch.manual_seed(seed)
    return PoseNetwork(SHAPE, torch.from_numpy(LOW), torch.from_numpy(HIGH))


@pytest.fixture(scope="module")
def views():
    return sample_views(world(), 6, np.random.default_rng(0))


def truth_about(views):
    """Output of a perfect network, by the views' poses and depths; angles by SciPy."""
    from scipy.spatial.transform import Rotation

    T = views.Ts_world_camera.numpy().astype(np.float64)
    R_ned_body = (
        np.diag([1.0, -1, -1]) @ T[:, :3, :3] @ np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    )
    yaw, pitch, roll = Rotation.from_matrix(R_ned_body).as_euler("ZYX").T
    angles = torch.from_numpy(np.stack([roll, pitch, yaw], axis=1)).float()
    rays = RAYS.numpy()
    reach = np.where(views.depths.numpy() > 0.0, views.depths.numpy(), 1.0)[..., None] / rays[:, 2:]
    points = T[:, None, :3, 3] + reach * np.einsum("nij,kj->nki", T[:, :3, :3], rays)
    count = len(T)
    return PoseNetOutput(
        position=views.Ts_world_camera[:, :3, 3].clone(),
        log_sigma_position=torch.full((count, 3), np.log(0.3)),
        sincos=torch.stack([angles.sin(), angles.cos()], dim=-1),
        log_sigma_angle=torch.full((count,), np.log(0.1)),
        points=torch.from_numpy(points).float(),
        log_sigma_points=torch.full(points.shape[:2], np.log(0.2)),
    )


def loss_of(answer, views):
    clear = torch.ones(len(views.images), 48, 64, dtype=torch.bool)
    return losses(answer, views, clear, RAYS, torch.tensor(-3.0))


@pytest.mark.parametrize("what", ["position", "sincos", "points"])
def test_every_loss_is_smallest_at_the_truth(views, what):
    """A likelihood of the right form peaks where the answer is right; any push of 0.1 must cost."""
    truth = truth_about(views)
    best = loss_of(truth, views)
    name = {"position": "token", "sincos": "token", "points": "points"}[what]
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        value = getattr(truth, what)
        pushed = truth._replace(
            **{what: value + 0.1 * torch.randn(value.shape, generator=generator)}
        )
        assert loss_of(pushed, views)[name] > best[name] + 1e-3
        assert loss_of(pushed, views)["fused"] > best["fused"]


def test_token_loss_is_the_gaussian_s(views):
    """By hand for one sigma of 0.3 in x: half of the squared number of sigmas, times the sigma as
    its weight.
    """
    truth = truth_about(views)
    off = truth._replace(position=truth.position + torch.tensor([0.3, 0.0, 0.0]))
    assert float(loss_of(off, views)["token"] - loss_of(truth, views)["token"]) == pytest.approx(
        0.15, abs=1e-4
    )


@pytest.mark.parametrize(("sigma", "sign"), [(0.2, -1), (0.3, 0), (0.45, 1)])
def test_best_sigma_is_the_error(views, sigma, sign):
    """By hand: for an error of 0.3 m in each axis the gradient is zero at sigma = 0.3 m, negative
    below and positive above.
    """
    truth = truth_about(views)
    log_sigma = torch.full_like(truth.position, np.log(sigma)).requires_grad_(True)
    off = truth._replace(position=truth.position + 0.3, log_sigma_position=log_sigma)
    loss_of(off, views)["token"].backward()
    slope = float(log_sigma.grad.mean())
    assert abs(slope) < 1e-6 if sign == 0 else np.sign(slope) == sign


def test_hidden_cells_do_not_count(views):
    """Points of cells under an occluder, or of depth 0, do not enter the loss."""
    truth = truth_about(views)
    hidden = views._replace(depths=torch.where(torch.arange(len(RAYS)) < 10, 0.0, views.depths))
    astray = truth.points.clone()
    astray[:, :10] += 3.0
    clear = torch.ones(len(views.images), 48, 64, dtype=torch.bool)
    first, second = (
        losses(truth._replace(points=p), hidden, clear, RAYS, torch.tensor(-3.0))
        for p in (truth.points, astray)
    )
    assert torch.equal(first["points"], second["points"])
    clear[:, :8] = False  # the upper row of cells
    astray = truth.points.clone()
    astray[:, :8] += 3.0
    first, second = (
        losses(truth._replace(points=p), views, clear, RAYS, torch.tensor(-3.0))
        for p in (truth.points, astray)
    )
    assert torch.equal(first["points"], second["points"])


def test_training_in_miniature_learns():
    """Near one photo, 0.7 m and 10 deg per axis around it: fresh views are placed and turned better
    than by the photo's own pose, which is the best guess without looking; a flipped sign or axis
    anywhere makes it worse than that.
    """
    ahead = nose_camera_pose((-5.0, -1.0, 1.5), 0.1, -0.1, 0.2)
    near = world(photos=photos_of([ahead]), photo_share=0.1, near_share=0.9)
    plan, lines = (
        TrainSchedule(steps=200, minutes=10.0, batch=24, fresh=2, pool=2000, first=150, rate=2e-3),
        [],
    )
    trained = PoseNetTrainer(network(), near, plan).run(lines.append)
    views = sample_views(
        world(photos=photos_of([ahead]), photo_share=0.0, near_share=1.0),
        80,
        np.random.default_rng(99),
    )
    with torch.no_grad():
        answer = trained(views.images.float() / 255.0)
        R, position, _ = fuse_pose(answer, RAYS, trained.log_trust)
    guess = torch.from_numpy(ahead).float()
    R_truth, truth = views.Ts_world_camera[:, :3, :3], views.Ts_world_camera[:, :3, 3]
    for R_estimate, estimate in ((rotations(answer.sincos), answer.position), (R, position)):
        turn, blind = (
            so3_log_between(R_truth, each).norm(dim=1).median()
            for each in (R_estimate, guess[:3, :3].expand_as(R))
        )
        assert turn < 0.6 * blind
        assert (estimate - truth).norm(dim=1).median() < 0.9 * (guess[:3, 3] - truth).norm(
            dim=1
        ).median()
    assert len(lines) == 2


def test_an_interrupted_training_goes_on(tmp_path, monkeypatch):
    """Stopped in its fourth step, it does the remaining three, not six, and keeps what it had
    learnt.
    """
    monkeypatch.setattr(pose_net_loop, "SAVE_PERIOD_S", -1.0)  # keep every step
    whole, calls = world(), []

    def stopping(Ts_world_camera):
        calls.append(len(Ts_world_camera))
        if len(calls) == 2 + 4:  # two for the first views, then one a step
            raise KeyboardInterrupt
        return whole.render_hall(Ts_world_camera)

    with pytest.raises(KeyboardInterrupt):
        PoseNetTrainer(network(), world(render_hall=stopping), QUICK, tmp_path).run()
    second = PoseNetTrainer(network(seed=1), world(), QUICK, tmp_path)
    second.run()
    assert second.step == QUICK.steps
    third = PoseNetTrainer(network(seed=2), world(), QUICK, tmp_path)
    done = third.run()
    assert third.step == QUICK.steps
    assert all(
        torch.equal(a, b)
        for a, b in zip(
            done.state_dict().values(), second.average.state_dict().values(), strict=True
        )
    )


def test_another_training_and_a_damaged_state_are_refused(tmp_path):
    """A kept state is of one plan, one kind of views and the weights that it began from."""
    PoseNetTrainer(network(), world(), QUICK, tmp_path).run()
    for views, plan, start in (
        (world(), TrainSchedule(steps=7, batch=4, fresh=2, pool=20, first=4), ""),
        (world(near_share=0.2), QUICK, ""),
        (world(high=HIGH + 1.0), QUICK, ""),
        (world(), QUICK, "other weights"),
    ):
        with pytest.raises(InputError, match="expected the settings"):
            PoseNetTrainer(network(), views, plan, tmp_path, start).run()
    (tmp_path / STATE).write_bytes((tmp_path / STATE).read_bytes()[:1000])
    with pytest.raises(InputError, match="damaged"):
        PoseNetTrainer(network(), world(), QUICK, tmp_path).run()


def test_minutes_end_a_training():
    """With no minutes to go, one step is enough to see that; the pool must not be waited for."""
    trainer = PoseNetTrainer(
        network(),
        world(),
        TrainSchedule(steps=1000, minutes=1e-4, batch=4, fresh=2, pool=20, first=4),
    )
    trainer.run()
    assert trainer.step < 10


def test_a_scene_without_a_hall_is_refused():
    """A renderer that sees nothing."""

    def nothing(Ts_world_camera):
        empty = torch.zeros(len(Ts_world_camera), 96, 128)
        return torch.zeros(*empty.shape, 3), empty, empty

    with pytest.raises(InputError, match="expected views that show a hall"):
        PoseNetTrainer(network(), world(render_hall=nothing), QUICK).run()
