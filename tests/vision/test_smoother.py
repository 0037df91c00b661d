"""Smoother: against dense linear algebra, and against simulated flights of an aircraft model it
does not know.
"""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import (
    camera_pose,
    euler_from_rotation,
    pose_matrix,
    rotation_world_body,
    wrap_angle,
)
from falconwing_kit.vision.marker import Marker, project_corners
from falconwing_kit.vision.smoother import (
    CornerMeasurements,
    PoseMeasurements,
    _covariances,
    _solve,
    smooth,
)
from tests.sysid.simulated import drawn, fly_figure_eights
from tests.vision.drawn_marker import CAMERA

P_BODY_CAMERA = np.array([0.2, 0.0, 0.0])
SIGMA = (0.1, np.radians(1.5))  # of the measurements: m, rad


@pytest.fixture(scope="module")
def flown():
    """20 s of figure eights, simulated: times and true states (N, 12) as p, roll pitch yaw, v, body
    rates.
    """
    rng = np.random.default_rng(4)
    flight = fly_figure_eights([drawn(rates_model(), rng)], 20.0, rng, shake=0.7)
    return flight.t, flight.states[0][:, [0, 1, 2, 5, 3, 4, 6, 7, 8, 9, 10, 11]]


def measurements_of(true, rows, rng, outlier_share=0.0):
    """Noisy measurements of true poses, a share of them outliers, and a start by interpolation."""
    body = pose_matrix(rotation_world_body(*true[rows, 3:6].T), true[rows, :3])
    T = camera_pose(body, P_BODY_CAMERA)
    T[:, :3, :3] = (
        Rotation.from_rotvec(rng.normal(0.0, SIGMA[1], (len(rows), 3))).as_matrix() @ T[:, :3, :3]
    )
    T[:, :3, 3] += rng.normal(0.0, SIGMA[0], (len(rows), 3))
    off = rng.random(len(rows)) < outlier_share
    T[off, :3, 3] += rng.normal(0.0, 2.0, (off.sum(), 3))
    covariance = np.broadcast_to(np.diag(np.repeat(np.square(SIGMA), 3)), (len(rows), 6, 6))
    seen = T @ np.linalg.inv(camera_pose(np.eye(4), P_BODY_CAMERA))
    angles = np.stack(euler_from_rotation(seen[:, :3, :3]), axis=1)
    angles[:, 2] = np.unwrap(angles[:, 2])
    poses = np.concatenate([seen[:, :3, 3], angles], axis=1)
    start = np.stack([np.interp(np.arange(len(true)), rows, column) for column in poses.T], axis=1)
    return PoseMeasurements(rows, T, covariance, P_BODY_CAMERA), start, off


def error(smoothed, true):
    """(N, 12) smoothed minus true."""
    states = (smoothed.p_world, smoothed.attitude, smoothed.v_world, smoothed.rates)
    off = np.concatenate(states, axis=1) - true
    off[:, 3:6] = wrap_angle(off[:, 3:6])
    return off


def test_the_block_sweeps_equal_dense_algebra():
    """NumPy's dense solver and inverse on the same random, positive definite, block-tridiagonal
    matrix.
    """
    rng, count = np.random.default_rng(0), 7
    dense = np.zeros((12 * count, 12 * count))
    for k in range(count - 1):
        part = rng.normal(size=(24, 24))
        dense[12 * k : 12 * k + 24, 12 * k : 12 * k + 24] += part.T @ part
    block = [slice(12 * k, 12 * k + 12) for k in range(count)]
    diagonal = np.array([dense[b, b] for b in block])
    beside = np.array([dense[a, b] for a, b in pairwise(block)])
    right = rng.normal(size=(count, 12))
    assert _solve(diagonal, beside, right).ravel() == pytest.approx(
        np.linalg.solve(dense, right.ravel()), rel=1e-6
    )
    inverse = np.linalg.inv(dense)
    assert _covariances(diagonal, beside) == pytest.approx(
        np.array([inverse[b, b] for b in block]), rel=1e-6, abs=1e-9
    )


def test_corners_count_by_their_covariance():
    """chi2 = d^T C^-1 d by NumPy's inverse, for a full covariance drawn as A^T A; the corners are
    moved by d.
    """
    rng = np.random.default_rng(6)
    p_world, attitude = np.array([[-6.0, 0.3, 1.2]]), np.radians([[10.0, -3.0, 4.0]])
    T = camera_pose(pose_matrix(rotation_world_body(*attitude.T), p_world), P_BODY_CAMERA)
    A, d = rng.normal(size=(8, 8)), rng.normal(size=8)
    corners = project_corners(Marker(), CAMERA, T) + d.reshape(1, 4, 2)
    measurements = CornerMeasurements(
        np.array([0]), corners, (A.T @ A)[None], Marker(), CAMERA, P_BODY_CAMERA
    )
    chi2 = (measurements.residuals(p_world, attitude) ** 2).sum()
    assert chi2 == pytest.approx(d @ np.linalg.inv(A.T @ A) @ d, rel=1e-6)


def test_stated_sigma_covers_the_error(flown):
    """Of a Gaussian 68 % lie within one sigma and 95 % within two; the loose motion may only
    overstate it.
    """
    t, true = flown
    measurements, start, _ = measurements_of(true, np.arange(len(t)), np.random.default_rng(1))
    smoothed = smooth(t, start, [measurements])
    z = np.abs(error(smoothed, true)) / np.sqrt(np.diagonal(smoothed.covariance, axis1=1, axis2=2))
    within_one, within_two = (z[:, :6] < 1.0).mean(), (z[:, :6] < 2.0).mean()
    assert 0.65 < within_one < 0.92
    assert within_two > 0.95
    assert (z[:, 6:] < 2.0).mean() > 0.95  # velocities and rates


def test_smoothing_halves_the_noise_and_gives_velocities(flown):
    """Some ten frames determine each pose: a third to a half of the noise is left. The derivative
    of raw poses has sqrt(2) x 0.1 m / 0.1 s = 1.4 m/s of noise; a fifth of that is required.
    """
    t, true = flown
    measurements, start, _ = measurements_of(true, np.arange(len(t)), np.random.default_rng(2))
    rms = np.sqrt(np.mean(error(smooth(t, start, [measurements]), true) ** 2, axis=0))
    assert (rms[:3] < 0.5 * SIGMA[0]).all()
    assert (rms[3:6] < 0.8 * SIGMA[1]).all()
    assert (rms[6:9] < 0.28).all()


def test_outliers_do_not_move_the_flight_and_have_large_chi2(flown):
    """One measurement in ten is 2 m off; with a square loss each would move the flight by tens of
    centimetres.
    """
    t, true = flown
    measurements, start, off = measurements_of(
        true, np.arange(len(t)), np.random.default_rng(3), outlier_share=0.1
    )
    smoothed = smooth(t, start, [measurements])
    assert np.abs(error(smoothed, true)[:, :3]).max() < 0.4
    rejected = smoothed.chi2[0] > 27.9  # of six coordinates, once in 10,000
    assert rejected[off].mean() > 0.9
    assert rejected[~off].mean() < 0.02


def test_a_gap_is_bridged_and_its_sigma_grows(flown):
    """0.8 s without a measurement: the truth stays within three sigma, which at least triples."""
    t, true = flown
    rows = np.flatnonzero(~((t > 8.0) & (t < 8.8)))
    measurements, start, _ = measurements_of(true, rows, np.random.default_rng(5))
    smoothed = smooth(t, start, [measurements])
    middle, before = int(np.searchsorted(t, 8.4)), int(np.searchsorted(t, 7.0))
    assert smoothed.sigma_position[middle] > 3.0 * smoothed.sigma_position[before]
    off = np.abs(error(smoothed, true)[middle, :6])
    assert (off < 3.0 * np.sqrt(np.diag(smoothed.covariance[middle])[:6])).all()


def test_bank_follows_from_the_turn():
    """Law: a level turn at 8 m/s on a radius of 10 m needs tan(roll) = V^2 / (g r), 33.1 deg. Only
    places are seen; sideslip and lift of the process model leave some degrees.
    """
    t = np.arange(0.0, 4.0, 0.05)
    around = 0.8 * t  # to the right: y falls
    p_world = np.stack(
        [10.0 * np.sin(around), 10.0 * np.cos(around) - 10.0, np.full_like(t, 2.0)], axis=1
    )
    covariance = np.diag([0.02**2] * 3 + [3.0**2] * 3)
    T = camera_pose(pose_matrix(rotation_world_body(0.0 * t, 0.05 + 0.0 * t, around), p_world))
    start = np.concatenate([p_world, np.stack([0.0 * t, 0.05 + 0.0 * t, around], axis=1)], axis=1)
    measurements = PoseMeasurements(
        np.arange(len(t)), T, np.broadcast_to(covariance, (len(t), 6, 6)), np.zeros(3)
    )
    smoothed = smooth(t, start, [measurements])
    assert np.degrees(smoothed.attitude[20:-20, 0]) == pytest.approx(33.1, abs=6.0)


@pytest.mark.parametrize(
    ("t", "start", "words"),
    [
        (np.array([0.0, 0.0]), np.zeros((2, 6)), "in order of time"),
        (np.array([0.0, 0.1]), np.full((2, 6), np.nan), "finite start"),
        (np.array([0.0, 0.1]), np.zeros((2, 6)), "at least one measurement"),
    ],
)
def test_what_cannot_be_smoothed_is_refused(t, start, words):
    """One sentence each."""
    with pytest.raises(InputError, match=words):
        smooth(t, start, [])
