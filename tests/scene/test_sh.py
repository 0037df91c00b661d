"""Spherical harmonics of colour: SciPy's basis, and coefficients that follow a rotation."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from falconwing_kit.scene.sh import constant_sh, fill_spherical_harmonics, rotate_sh, scale_sh


def basis(directions, count=16):
    """The harmonics (n, count) in directions (n, 3)."""
    Y = np.empty((count, len(directions)))
    fill_spherical_harmonics(count, *directions.T, Y)
    return Y.T


def unit_vectors(rng, count=40):
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_is_scipy_s(rng, degree):
    """Real harmonics are sqrt(2) Re or Im of SciPy's complex ones; constants are float32."""
    directions = unit_vectors(rng)
    x, y, z = directions.T
    for order in range(-degree, degree + 1):
        value = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
        part = value.imag if order < 0 else value.real
        expected = part * (math.sqrt(2) if order else 1.0)
        got = basis(directions)[:, degree**2 + degree + order]
        np.testing.assert_allclose(got, expected, atol=3e-7)


@pytest.mark.parametrize("count", [1, 4, 9, 16])
def test_rotated_colour_is_that_of_the_direction_rotated_back(rng, count):
    """The definition rgb'(d) = rgb(R^T d); a few float32 roundings of colours around 1."""
    sh = rng.normal(size=(3, count, 3)).astype(np.float32)
    R, directions = Rotation.random(rng=rng).as_matrix(), unit_vectors(rng)
    before = np.einsum("dk,nkc->dnc", basis(directions @ R, count), sh)
    after = np.einsum("dk,nkc->dnc", basis(directions, count), rotate_sh(sh, R))
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_scaled_and_constant_colours_by_definition(rng):
    """f rgb(d) and one rgb in every direction, with rgb(d) = 1/2 + sum_k sh_k Y_k(d)."""
    sh, directions = rng.normal(size=(2, 9, 3)).astype(np.float32), unit_vectors(rng)

    def rgb(coefficients):
        return 0.5 + np.einsum("dk,nkc->dnc", basis(directions, 9), coefficients)

    factors = np.array([0.5, 2.0, 0.0])
    np.testing.assert_allclose(rgb(scale_sh(sh, factors)), factors * rgb(sh), atol=1e-5)
    plain = rgb(constant_sh(sh, (0.2, 0.4, 0.9)))
    np.testing.assert_allclose(plain, np.broadcast_to((0.2, 0.4, 0.9), plain.shape), atol=1e-6)
