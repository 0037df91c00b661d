"""Evaluation of a pose net: images with known poses -> errors and calibration of its sigmas."""

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
MIN_TO_CALIBRATE = 10  # images
SMALL_SINE = 1e-9  # below, the angle is 0 or pi and the axis cannot be divided out


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of a net on N images."""

    position: Array  # (N,) [m]
    angles: Array  # (N, 3) roll, pitch, yaw [rad], signed
    rotation: Array  # (N,) angle of the rotation between estimate and truth [rad]
    squares: Array  # (N, 2) Mahalanobis distances squared of position and rotation
    token_position: Array  # (N,) [m] of the pose token alone, as in the paper
    token_yaw: Array  # (N,) [rad]


def evaluate_poses(
    net: PoseNet, images: Iterable[NDArray[np.uint8]], camera: PinholeCamera, Ts_world_camera: Array
) -> PoseErrors:
    """Errors of a net's estimates.

    Args:
        net: to evaluate.
        images: N of (H, W, 3) RGB bytes.
        camera: intrinsics at the images' size.
        Ts_world_camera: (N, 4, 4) the true poses.

    Raises:
        InputError: there are no images.
    """
    rows = []
    for image, T_true in zip(images, Ts_world_camera, strict=True):
        output = net.predict(image, camera)
        estimate = net.pose_estimates(output)[0]
        T = estimate.T_world_camera
        position = T[:3, 3] - T_true[:3, 3]
        rotation = _rotation_vector(T[:3, :3], T_true[:3, :3])
        angles, true_angles = (
            np.array(euler_from_rotation(R @ R_BODY_CAMERA.T)) for R in (T[:3, :3], T_true[:3, :3])
        )
        C = estimate.covariance
        token_position = np.linalg.norm(output.position[0].numpy() - T_true[:3, 3])
        token_yaw = np.arctan2(*output.sincos[0, 2].numpy()) - true_angles[2]
        rows.append(
            [
                np.linalg.norm(position),
                *wrap_angle(angles - true_angles),
                np.linalg.norm(rotation),
                position @ np.linalg.solve(C[:3, :3], position),
                rotation @ np.linalg.solve(C[3:, 3:], rotation),
                token_position,
                wrap_angle(token_yaw),
            ]
        )
    if not rows:
        raise InputError("images: expected at least one to evaluate, got none; give more photos")
    table = np.array(rows)
    return PoseErrors(
        table[:, 0], table[:, 1:4], table[:, 4], table[:, 5:7], table[:, 7], table[:, 8]
    )


def error_figures(errors: PoseErrors) -> dict[str, Any]:
    """Errors in metres and degrees, and shares of images in the stated 68 and 95 % ellipsoids."""
    absolute_deg = np.degrees(np.abs(errors.angles))
    values_by_name = {
        "position_m": errors.position,
        "yaw_deg": absolute_deg[:, 2],
        "tilt_deg": absolute_deg[:, :2].max(axis=1),
        "turn_deg": np.degrees(errors.rotation),
    }
    record: dict[str, Any] = {"images": len(errors.position)}
    for name, values in values_by_name.items():
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
    """The net with sigmas scaled so that at least 68 % of each trial lie in their ellipsoids.

    Args:
        net: with the scales that gave the trials.
        trials: of ten or more images each, used neither for training nor for evaluation.

    Raises:
        InputError: a trial is too small.
    """
    smallest = min(len(errors.position) for errors in trials)
    if smallest < MIN_TO_CALIBRATE:
        raise InputError(
            f"calibration: expected at least {MIN_TO_CALIBRATE} images set aside, "
            f"got {smallest}; give more photos"
        )
    share, quantile = next(iter(CHI2_3.items()))
    # factor for each trial that moves the 68 % quantile to that of chi squared; the largest counts
    factors = np.max(
        [np.sqrt(np.quantile(errors.squares, share, axis=0) / quantile) for errors in trials],
        axis=0,
    )
    position, rotation = (
        float(old * new) for old, new in zip(net.record.sigma_scales, factors, strict=True)
    )
    return PoseNet(net.network, replace(net.record, sigma_scales=(position, rotation)))


def _rotation_vector(R: Array, R_from: Array) -> Array:
    """(3,) rotation vector w in world axes [rad], R = exp([w]x) R_from; arbitrary axis at pi."""
    M = R @ R_from.T
    w = 0.5 * np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    sin, cos = np.linalg.norm(w), 0.5 * (np.trace(M) - 1.0)
    angle = np.arctan2(sin, cos)
    if sin > SMALL_SINE:
        return np.asarray(w * angle / sin)
    return np.asarray(w if cos > 0.0 else np.array([np.pi, 0.0, 0.0]))
