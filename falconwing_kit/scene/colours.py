"""Colours of Gaussians: spherical harmonics, a rotation or another light -> the harmonics after it."""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array
from falconwing_kit.scene.ply import SH_C0, SH_COUNTS, Array32

GAMMA = 2.2  # a screen's light is the 2.2th power of its numbers
DIRECTIONS = 64  # more than the 16 harmonics of degree 0 to 3, so that they settle a rotation


def rotate_sh(sh: Array32, R: Array) -> Array32:
    """Colours of what has turned: along d one sees now what was to be seen along R^T d.

    sh'_j = sum_k D_jk sh_k,  Y_k(R^T d) = sum_j Y_j(d) D_jk

    Each degree turns in itself [Ivanic & Ruedenberg 1996, Rotation Matrices for Real Spherical
    Harmonics]; its D is exact, as it solves the second equation in more directions than there are
    harmonics.

    Args:
        sh: (N, K, 3), K = 1, 4, 9 or 16.
        R: (3, 3) the rotation, from the axes before to those after.

    Returns:
        (N, K, 3).
    """
    turned = sh.copy()
    if sh.shape[1] == 1:
        return turned
    directions, basis = _directions(), _basis(_directions())
    before = _basis(directions @ R)
    for degree in range(1, SH_COUNTS.index(sh.shape[1]) + 1):
        own = slice(degree**2, (degree + 1) ** 2)
        D = np.linalg.lstsq(basis[:, own], before[:, own])[0]
        turned[:, own] = D.astype(np.float32) @ sh[:, own]
    return turned


def scale_sh(sh: Array32, factors: ArrayLike) -> Array32:
    """Colours times a factor, from every side.

    rgb = 1/2 + sum_k sh_k Y_k,  so  f rgb = 1/2 + sum_k sh'_k Y_k  with  sh'_k = f sh_k, and sh'_0
    += (f - 1) / (2 Y_0)

    Args:
        sh: (N, K, 3).
        factors: (3,) of red, green and blue as on a screen.

    Returns:
        (N, K, 3).
    """
    factors = np.asarray(factors, np.float32)
    scaled = sh * factors
    scaled[:, 0] += (factors - 1.0) * np.float32(0.5 / SH_C0)
    return scaled


def constant_sh(sh: Array32, rgb: ArrayLike) -> Array32:
    """One colour from every side.

    Args:
        sh: (N, K, 3) of which only the shape counts.
        rgb: (3,) or (N, 3) as on a screen, 0..1.

    Returns:
        (N, K, 3).
    """
    plain = np.zeros_like(sh)
    plain[:, 0] = (np.asarray(rgb, np.float32) - 0.5) / np.float32(SH_C0)
    return plain


@cache
def _directions() -> Array:
    """Directions all over the sphere (DIRECTIONS, 3), of length 1."""
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _basis(directions: Array) -> Array:
    """The harmonics that the renderer uses (n, 16) in directions (n, 3)."""
    from falconwing_kit.scene.fast import fill_spherical_harmonics

    basis = np.empty((len(directions), SH_COUNTS[-1]))
    for direction, row in zip(directions, basis, strict=True):
        fill_spherical_harmonics(SH_COUNTS[-1], *direction, row)
    return basis
