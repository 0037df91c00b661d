"""Scene for a page: a GaussianScene -> the bytes that the page's renderer loads, an SPZ unpacked.

The server sends them with Content-Encoding: gzip; a page in one file may hold them packed by gzip,
which the renderer notices by itself.
"""

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, require_range
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.sh import SH_C0, SH_COUNTS
from falconwing_kit.tools.capture.packed_write import spz_payload

FRACTION_BITS = 10  # of the positions: steps of 1 mm
SH_BITS = 5  # of each harmonic: less to send; the hall loses 1.5 dB from 49
DRAWN_COUNT = SH_COUNTS[1]  # harmonics that the page draws: up to degree 1
LEADER = "leader"  # label of Gaussians in their body axes; the page draws the leader as boxes
MORTON_BITS = 16  # cells along each axis: 2^16
COLOUR_COST = 4.0  # of merging black with white, in units of the area of both


def scene_bytes(scene: GaussianScene, max_gaussians: int | None = None) -> bytes:
    """The inside of an SPZ of version 3: the hall without its leader, colours up to degree 1.

    Args:
        max_gaussians: at most so many, by `thinned`, for a weak phone; None for all.

    Raises:
        InputError: max_gaussians is below 1, or a Gaussian lies too far from the origin.
    """
    keep = np.ones(len(scene), np.bool_)
    if LEADER in scene.label_names and not scene.labelled(LEADER).all():
        keep = ~scene.labelled(LEADER)
    hall = GaussianScene(
        scene.means[keep],
        scene.quaternions[keep],
        scene.scales[keep],
        scene.opacities[keep],
        scene.sh[keep, :DRAWN_COUNT],
    )
    if max_gaussians is not None:
        hall = thinned(hall, max_gaussians)
    return spz_payload(hall, FRACTION_BITS, SH_BITS)[0]


def thinned(scene: GaussianScene, max_gaussians: int) -> GaussianScene:
    """A scene of at most so many Gaussians: pairs of neighbours of similar colour become one.

    The one has the weight w = opacity * area, the mean, the covariance (moments about the new mean)
    and the mean colour of both; area is the product of the two larger standard deviations, for
    most Gaussians lie on surfaces. Where its opacity would exceed that of both, it grows instead.
    Neighbours are consecutive along the Z-order curve (Morton 1966).

    Returns:
        The scene itself if it is small enough; else one without labels.

    Raises:
        InputError: max_gaussians is below 1.
    """
    limit = int(require_range("max_gaussians", max_gaussians, low=1))
    if len(scene) <= limit:
        return scene
    means, scales = scene.means.astype(np.float64), scene.scales.astype(np.float64)
    axes = _rotations(scene.quaternions.astype(np.float64)) * scales[:, None, :]
    covariances = axes @ axes.transpose(0, 2, 1)
    opacities, sh = scene.opacities.astype(np.float64), scene.sh.astype(np.float64)
    while len(means) > limit:
        order = np.argsort(_morton(means), kind="stable")
        a, b = order[0 : len(order) // 2 * 2 : 2], order[1::2]
        areas = _areas(covariances)
        w_a, w_b = opacities[a] * areas[a], opacities[b] * areas[b]
        weight = np.maximum(w_a + w_b, 1e-30)
        share = (w_a / weight)[:, None]
        mean = share * means[a] + (1.0 - share) * means[b]
        covariance = np.zeros((len(a), 3, 3))
        for part, rows in ((share, a), (1.0 - share, b)):
            d = means[rows] - mean
            spread = covariances[rows] + d[:, :, None] * d[:, None, :]
            covariance += part[:, :, None] * spread
        area = np.maximum(_areas(covariance), 1e-30)
        contrast = np.abs(sh[a, 0] - sh[b, 0]).mean(axis=1) * SH_C0
        both = areas[a] + areas[b]
        cost = np.maximum(area - both, 0.0) + COLOUR_COST * contrast * both
        cheapest = np.argsort(cost, kind="stable")[: len(means) - limit]
        a, b, weight, share = a[cheapest], b[cheapest], weight[cheapest], share[cheapest]
        area = area[cheapest]
        opacity = np.minimum(weight / area, np.maximum(opacities[a], opacities[b]))
        growth = np.maximum(weight / np.maximum(area * opacity, 1e-30), 1.0)
        kept = np.ones(len(means), np.bool_)
        kept[b] = False
        means[a], opacities[a] = mean[cheapest], opacity
        covariances[a] = covariance[cheapest] * growth[:, None, None]
        sh[a] = share[:, :, None] * sh[a] + (1.0 - share[:, :, None]) * sh[b]
        means, covariances = means[kept], covariances[kept]
        opacities, sh = opacities[kept], sh[kept]
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a mirror image
    deviations = np.sqrt(np.maximum(variances, 1e-12))
    return GaussianScene(
        means.astype(np.float32),
        _quaternions(axes).astype(np.float32),
        deviations.astype(np.float32),
        opacities.clip(0.0, 1.0).astype(np.float32),
        sh.astype(np.float32),
    )


def _areas(covariances: Array) -> Array:
    """(N,) product of the two larger standard deviations of each (N, 3, 3).

    The sum of the principal minors is s1^2 s2^2 + s2^2 s3^2 + s3^2 s1^2, whose first term is most
    of it for a flat Gaussian: no eigenvalues are needed.
    """
    c = covariances
    minors = (
        c[:, 0, 0] * c[:, 1, 1] - c[:, 0, 1] ** 2
        + c[:, 1, 1] * c[:, 2, 2] - c[:, 1, 2] ** 2
        + c[:, 2, 2] * c[:, 0, 0] - c[:, 2, 0] ** 2
    )  # fmt: skip
    return np.asarray(np.sqrt(np.maximum(minors, 0.0)))


def _morton(means: Array) -> NDArray[np.uint64]:
    """(N,) the bits of the three coordinates in turn, so that near numbers are near places."""
    low, span = means.min(axis=0), max(float(np.ptp(means, axis=0).max()), 1e-9)
    cells = ((means - low) / span * (2**MORTON_BITS - 1)).astype(np.uint64)
    codes = np.zeros(len(means), np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            taken = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            codes |= taken << np.uint64(3 * bit + axis)
    return codes


def _rotations(quaternions: Array) -> Array:
    """(N, 3, 3) rotation matrices of quaternions w x y z of length 1."""
    w, x, y, z = quaternions.T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _quaternions(rotations: Array) -> Array:
    """(N, 4) w x y z of rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1))
