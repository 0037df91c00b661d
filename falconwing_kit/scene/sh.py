"""Colour by spherical harmonics: constants and basis, and coefficients rotated, scaled or set.

A Gaussian seen along the direction d has the colour rgb(d) = 1/2 + sum_k sh_k Y_k(d). The real
harmonics Y_k come degree by degree, each from order -degree to degree, with the signs of 3D
Gaussian Splatting's files: odd orders carry a minus (Condon and Shortley's phase).
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array

Array32 = NDArray[np.float32]

SH_COUNTS = (1, 4, 9, 16)  # coefficients of degree 0 to 3
# Each distinct constant of degrees 0 to 3 once: degree 0, 1, then three of degree 2, five of 3.
SH_CONSTANTS = tuple(
    math.sqrt(square / math.pi)
    for square in (
        1 / 4,
        3 / 4,
        15 / 4,
        5 / 16,
        15 / 16,
        35 / 32,
        105 / 4,
        21 / 32,
        7 / 16,
        105 / 16,
    )
)
SH_C0 = SH_CONSTANTS[0]  # Y_0 = 1 / (2 sqrt(pi))
GAMMA = 2.2  # light on a screen is the 2.2th power of the pixel value
BASIS_DIRECTIONS = (
    64  # at least the 16 harmonics, so that the least squares of `rotate_sh` is exact
)

C = tuple(np.float32(constant) for constant in SH_CONSTANTS)


def fill_spherical_harmonics(count: int, x: Any, y: Any, z: Any, Y: Any) -> None:
    """Write `count` harmonics of the unit direction x, y, z into Y; numba compiles it too."""
    xx, yy, zz = x * x, y * y, z * z
    Y[0] = C[0]
    if count > 1:
        Y[1], Y[2], Y[3] = -C[1] * y, C[1] * z, -C[1] * x
    if count > 4:
        Y[4], Y[5], Y[7] = C[2] * x * y, -C[2] * y * z, -C[2] * x * z
        Y[6], Y[8] = C[3] * (zz + zz - xx - yy), C[4] * (xx - yy)
    if count > 9:
        Y[9], Y[15] = -C[5] * y * (xx + xx + xx - yy), -C[5] * x * (xx - yy - yy - yy)
        Y[10], Y[14] = C[6] * x * y * z, C[9] * z * (xx - yy)
        five = zz + zz + zz + zz - xx - yy  # 5 z^2 - 1 on the unit sphere
        Y[11], Y[13] = -C[7] * y * five, -C[7] * x * five
        Y[12] = C[8] * z * (five - (zz + zz) - (xx + xx) - (yy + yy))


def rotate_sh(sh: Array32, R: Array) -> Array32:
    """Coefficients (N, K, 3) after a rotation of the Gaussians: rgb'(d) = rgb(R^T d).

    sh'_j = sum_k D_jk sh_k,  Y_k(R^T d) = sum_j Y_j(d) D_jk

    Each degree has its own block D [Ivanic & Ruedenberg 1996, Rotation Matrices for Real Spherical
    Harmonics], which solves the second equation in BASIS_DIRECTIONS directions.
    """
    rotated = sh.copy()
    if sh.shape[1] == 1:
        return rotated
    directions, basis = _directions(), _basis(_directions())
    basis_before = _basis(directions @ R)  # rows are R^T d
    for degree in range(1, SH_COUNTS.index(sh.shape[1]) + 1):
        block = slice(degree**2, (degree + 1) ** 2)
        D = np.linalg.lstsq(basis[:, block], basis_before[:, block])[0]
        rotated[:, block] = D.astype(np.float32) @ sh[:, block]
    return rotated


def scale_sh(sh: Array32, factors: ArrayLike) -> Array32:
    """Coefficients (N, K, 3) of the colour times (3,) factors of red, green and blue.

    f rgb = 1/2 + sum_k sh'_k Y_k  with  sh'_k = f sh_k, and sh'_0 += (f - 1) / (2 Y_0)
    """
    factors = np.asarray(factors, np.float32)
    scaled = sh * factors
    scaled[:, 0] += (factors - 1.0) * np.float32(0.5 / SH_C0)
    return scaled


def constant_sh(sh: Array32, rgb: ArrayLike) -> Array32:
    """Coefficients like sh (N, K, 3) of one colour (3,) or (N, 3), 0..1, from every side."""
    plain = np.zeros_like(sh)
    plain[:, 0] = (np.asarray(rgb, np.float32) - 0.5) / np.float32(SH_C0)
    return plain


@cache
def _directions() -> Array:
    """Unit vectors (BASIS_DIRECTIONS, 3) all over the sphere."""
    directions = np.random.default_rng(0).normal(size=(BASIS_DIRECTIONS, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _basis(directions: Array) -> Array:
    """All 16 harmonics (n, 16) in directions (n, 3)."""
    basis = np.empty((len(directions), SH_COUNTS[-1]))
    x, y, z = directions.T
    fill_spherical_harmonics(SH_COUNTS[-1], x, y, z, basis.T)
    return basis
