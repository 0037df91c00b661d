"""Evaluation: known errors are reported, and calibration gives the stated shares."""

from dataclasses import asdict

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.learning.pose_net_figures import (
    PoseErrors,
    calibrate_sigmas,
    error_figures,
    evaluate_poses,
)
from falconwing_kit.vision.pose_net import PoseNet, PoseNetRecord
from falconwing_kit.vision.pose_network import PoseNetOutput, PoseNetShape, PoseNetwork, rotations
from tests.learning.halls import CAMERA, HIGH, LOW

SHAPE = PoseNetShape(width=64, height=48, features=16, layers=1, heads=1)
ANGLES = np.array([0.2, -0.1, 0.7])


@pytest.fixture
def net():
    """A net without weight on its cells and with a constant token, sigmas 0.5 m and 0.1 rad."""
    network = PoseNetwork(SHAPE, torch.from_numpy(LOW), torch.from_numpy(HIGH))
    network.log_trust.data.fill_(-60.0)
    answer = PoseNetOutput(
        torch.tensor([[1.0, 2.0, 1.5]]),
        torch.full((1, 3), np.log(0.5)),
        torch.tensor(np.stack([np.sin(ANGLES), np.cos(ANGLES)], axis=-1)).float()[None],
        torch.full((1,), np.log(0.1)),
        torch.zeros(1, 48, 3),
        torch.zeros(1, 48),
    )
    network.forward = lambda images: answer
    return PoseNet(network, PoseNetRecord(asdict(SHAPE), 0.62, tuple(LOW), tuple(HIGH)))


def truth(places, turns):
    """Poses that the net's answer misses by places [m] and turns [rad] in world axes."""
    R_said = rotations(torch.tensor(np.stack([np.sin(ANGLES), np.cos(ANGLES)], axis=-1))[None])[
        0
    ].numpy()
    T = np.tile(np.eye(4), (len(places), 1, 1))
    T[:, :3, 3] = np.array([1.0, 2.0, 1.5]) - places
    T[:, :3, :3] = Rotation.from_rotvec(turns).inv().as_matrix() @ R_said
    return T


def black(count):
    return np.zeros((count, 48, 64, 3), np.uint8)


def test_errors_put_in_come_out(net):
    """By hand: 3, 4 and 0 m off is 5 m; 10 deg about the world's up axis is 10 deg less yaw, and no
    tilt.
    """
    Ts = truth(np.tile([3.0, 4.0, 0.0], (3, 1)), np.tile([0.0, 0.0, np.radians(10.0)], (3, 1)))
    trial = evaluate_poses(net, black(3), CAMERA, Ts)
    assert np.allclose(trial.position, 5.0, atol=1e-5)
    assert np.allclose(np.degrees(trial.angles), [0.0, 0.0, -10.0], atol=1e-3)
    assert np.allclose(np.degrees(trial.rotation), 10.0, atol=1e-3)
    assert np.allclose(trial.squares, [[25.0 / 0.25, np.radians(10.0) ** 2 / 0.01]] * 3, rtol=1e-4)
    record = error_figures(trial)
    assert record["position_m"]["median"] == pytest.approx(5.0, abs=1e-5)
    assert record["yaw_deg"]["mean"] == pytest.approx(10.0, abs=1e-3)
    assert record["token_alone"]["yaw_deg"] == pytest.approx(10.0, abs=1e-3)


@pytest.mark.parametrize("understated", [1.0, 2.5])
def test_calibration_makes_the_stated_shares_hold(net, understated):
    """Normal errors with sigmas larger than stated by a known factor: the scales must be that
    factor, and the 68 and 95 % shares then hold on new errors; 4000 of them scatter by 0.7 %.
    """
    rng = np.random.default_rng(0)

    def errors():
        return rng.normal(0.0, 0.5 * understated, (4000, 3)), rng.normal(
            0.0, 0.1 * understated, (4000, 3)
        )

    def squares(places, turns):
        scale = np.array(now.record.sigma_scales)
        return np.stack([(places**2).sum(1) / 0.25, (turns**2).sum(1) / 0.01], axis=1) / scale**2

    now = net
    many = np.zeros(4000)
    now = calibrate_sigmas(
        net, PoseErrors(many, np.zeros((4000, 3)), many, squares(*errors()), many, many)
    )
    assert now.record.sigma_scales == pytest.approx((understated, understated), rel=0.03)
    record = error_figures(
        PoseErrors(many, np.zeros((4000, 3)), many, squares(*errors()), many, many)
    )
    for name in ("position_in_stated", "attitude_in_stated"):
        assert record[name]["68%"] == pytest.approx(0.6827, abs=0.03)
        assert record[name]["95%"] == pytest.approx(0.95, abs=0.015)


def test_half_a_turn_is_no_error_in_the_program(net):
    """Upside down and backwards must give 180 deg, not a division by nothing."""
    trial = evaluate_poses(
        net, black(1), CAMERA, truth(np.zeros((1, 3)), np.array([[0.0, 0.0, np.pi]]))
    )
    assert np.degrees(trial.rotation) == pytest.approx(180.0, abs=0.1)


def test_too_few_to_judge_or_calibrate_are_refused(net):
    """None at all, and nine where ten are wanted."""
    with pytest.raises(InputError, match="at least one"):
        evaluate_poses(net, black(0), CAMERA, np.zeros((0, 4, 4)))
    nine = np.ones(9)
    with pytest.raises(InputError, match="at least 10"):
        calibrate_sigmas(net, PoseErrors(nine, np.ones((9, 3)), nine, np.ones((9, 2)), nine, nine))
