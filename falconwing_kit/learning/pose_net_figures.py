"""Judging a pose net: views with known poses -> errors and whether its stated uncertainty holds;
and calibrating it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import R_BODY_CAMERA, euler_from_rotation, wrap_angle
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.pose_net import PoseNet

CHI2_3 = {0.6827: 3.5267, 0.95: 7.8147}  # quantiles of chi squared with three degrees of freedom
MIN_TO_CALIBRATE = 10


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of a net on N images."""

    position: Array  # (N,) [m]
    angles: Array  # (N, 3) roll, pitch, yaw [rad], with their sign
    rotation: Array  # (N,) the whole turn [rad]
    squares: Array  # (N, 2) squared errors of place and turn, in their stated covariances
    token_position: Array  # (N,) [m] of the pose token alone, the paper's way
    token_yaw: Array  # (N,) [rad]


def evaluate_poses(
    net: PoseNet, images: Iterable[NDArray[np.uint8]], camera: PinholeCamera, Ts_world_camera: Array
) -> PoseErrors:
    """Let a net estimate poses that are known.

    Args:
        net: to judge.
        images: N of (H, W, 3) bytes.
        camera: which took them.
        Ts_world_camera: (N, 4, 4) the truth.

    Raises:
        InputError: there are no images.
    """
    rows = []
    for image, T_world_camera in zip(images, Ts_world_camera, strict=True):
        answer = net.answer(image, camera)
        estimate = net.pose_estimates(answer)[0]
        R = estimate.T_world_camera[:3, :3]
        place, turn = (
            estimate.T_world_camera[:3, 3] - T_world_camera[:3, 3],
            _rotation_vector(R, T_world_camera[:3, :3]),
        )
        ours, truth = (
            np.array(euler_from_rotation(M @ R_BODY_CAMERA.T)) for M in (R, T_world_camera[:3, :3])
        )
        C = estimate.covariance
        squares = [
            e @ np.linalg.solve(part, e) for e, part in ((place, C[:3, :3]), (turn, C[3:, 3:]))
        ]
        token_off = np.linalg.norm(answer.place[0].numpy() - T_world_camera[:3, 3])
        token_yaw = wrap_angle(np.arctan2(*answer.sincos[0, 2].numpy()) - truth[2])
        own = [np.linalg.norm(place), *wrap_angle(ours - truth), np.linalg.norm(turn), *squares]
        rows.append([*own, token_off, token_yaw])
    if not rows:
        raise InputError("images: expected at least one to judge by, got none")
    table = np.array(rows)
    return PoseErrors(
        table[:, 0], table[:, 1:4], table[:, 4], table[:, 5:7], table[:, 7], table[:, 8]
    )


def error_figures(errors: PoseErrors) -> dict[str, Any]:
    """Errors in metres and degrees, and the shares of images that lie in the stated 68 and 95 %
    ellipsoids.
    """
    yaw = np.degrees(np.abs(errors.angles[:, 2]))
    rotation, tilt = (
        np.degrees(errors.rotation),
        np.degrees(np.abs(errors.angles[:, :2]).max(axis=1)),
    )
    record: dict[str, Any] = {"images": len(yaw)}
    for name, values in (
        ("position_m", errors.position),
        ("yaw_deg", yaw),
        ("tilt_deg", tilt),
        ("turn_deg", rotation),
    ):
        record[name] = {"median": float(np.median(values)), "mean": float(values.mean())}
        record[name]["p90"] = float(np.quantile(values, 0.9))
    record["token_alone"] = {
        "position_m": float(np.median(errors.token_position)),
        "yaw_deg": float(np.degrees(np.median(np.abs(errors.token_yaw)))),
    }
    for column, name in enumerate(("position", "attitude")):
        inside = {
            f"{share:.0%}": float((errors.squares[:, column] < q).mean())
            for share, q in CHI2_3.items()
        }
        record[f"{name}_in_stated"] = inside
    return record


def calibrate_sigmas(net: PoseNet, *trials: PoseErrors) -> PoseNet:
    """The net with standard deviations scaled so that at least 68 % of each trial lie in their
    ellipsoids.

    Args:
        net: whose present scales gave the trials.
        trials: on images that it was neither trained on nor will be judged by, ten or more in each.

    Raises:
        InputError: a trial is too small.
    """
    smallest = min(len(errors.position) for errors in trials)
    if smallest < MIN_TO_CALIBRATE:
        raise InputError(
            f"calibration: expected at least {MIN_TO_CALIBRATE} images that were kept aside, got {smallest}"
        )
    share, quantile = next(iter(CHI2_3.items()))
    factors = np.max(
        [np.sqrt(np.quantile(errors.squares, share, axis=0) / quantile) for errors in trials],
        axis=0,
    )
    place, turn = (
        float(old * new) for old, new in zip(net.record.sigma_scales, factors, strict=True)
    )
    return PoseNet(net.network, replace(net.record, sigma_scales=(place, turn)))


def _rotation_vector(R: Array, R_from: Array) -> Array:
    """(3,) the turn in world axes from one rotation to the other [rad]; at half a turn its axis is
    arbitrary.
    """
    M = R @ R_from.T
    w = 0.5 * np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    sin, cos = np.linalg.norm(w), 0.5 * (np.trace(M) - 1.0)
    angle = np.arctan2(sin, cos)
    if sin > 1e-9:
        return np.asarray(w * angle / sin)
    return np.asarray(w if cos > 0.0 else np.array([np.pi, 0.0, 0.0]))
