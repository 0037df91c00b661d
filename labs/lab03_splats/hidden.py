"""Lab 3, instructors only: what the functions are judged against.

SciPy's rotations, the kit's camera with its derivative taken by differences, and pictures laid from
the back.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from falconwing_kit.core import Array
from falconwing_kit.scene import PinholeCamera
from falconwing_kit.tools.grading import Course, Judge, Values

TO_OPENCV = np.array([1.0, -1.0, -1.0])  # right, up, backwards -> right, down, forward
STEP = 1e-4  # of the differences [m]; their error is about 1e-8 of the derivative


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise.

    Args:
        course: where its splats end, and when a surface is reached.

    Returns:
        By exercise.
    """
    cut, share = course.constants["cut_sigma"], course.constants["surface_share"]

    def alphas(pixels: Array, means_px: Array, covs_px: Array, opacities: Array) -> Array:
        """Offsets in the axes of each splat: whitened by the root of its covariance."""
        columns = []
        for mean, cov, opacity in zip(means_px, covs_px, opacities, strict=True):
            distance = np.linalg.norm(
                np.linalg.solve(np.linalg.cholesky(cov), (pixels - mean).T), axis=0
            )
            columns.append(
                np.where(
                    distance > cut, 0.0, np.clip(opacity * np.exp(-(distance**2) / 2), 0.0, 0.999)
                )
            )
        return np.stack(columns, axis=1)

    def composite(
        alphas: Array, colours: Array, depths: Array, background: Array
    ) -> tuple[Array, Array]:
        """The painter's way: from the farthest to the nearest, each over what is there."""
        rgb = np.tile(background, (len(alphas), 1))
        near_first = sorted(range(len(depths)), key=lambda i: float(depths[i]))
        for i in reversed(near_first):
            rgb = alphas[:, [i]] * colours[i] + (1.0 - alphas[:, [i]]) * rgb
        return rgb, np.array([_surface(row, depths, near_first, share) for row in alphas])

    def whole_picture(
        means_px: Array,
        covs_px: Array,
        opacities: Array,
        colours: Array,
        depths: Array,
        shape: tuple[int, int],
        background: Array,
    ) -> Array:
        """Every splat at every pixel, by the references above."""
        v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
        pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
        covered = alphas(pixels, means_px, covs_px, opacities)
        rgb = composite(covered, colours, depths, background)[0]
        return rgb.reshape(*shape, 3)

    return {
        "cov3d_from_scale_quat": (Values(_draw_shapes, _covariances),),
        "project_gaussians": (Values(_draw_gaussians, _project, rtol=1e-5, atol=1e-6),),
        "splat_alphas": (Values(_draw_splats, alphas),),
        "alpha_composite": (Values(_draw_layers, composite),),
        "render_tiles": tuple(
            Values(partial(_draw_picture, kind=kind), whole_picture, 3, rtol=0.0, atol=0.5 / 255.0)
            for kind in ("few", "large", "many")
        ),
    }


def _surface(alphas: Array, depths: Array, near_first: list[int], share: float) -> float:
    through = 1.0
    for i in near_first:
        through *= 1.0 - alphas[i]
        if through <= 1.0 - share:
            return float(depths[i])
    return float("nan")


def _draw_shapes(rng: np.random.Generator) -> tuple[Any, ...]:
    count = int(rng.integers(4, 8))
    return rng.uniform(-1.5, 0.7, (count, 3)), rng.normal(size=(count, 4)) + rng.choice(
        [-2.0, 2.0], (count, 4)
    )


def _covariances(log_scales: Array, quaternions_xyzw: Array) -> Array:
    axes = Rotation.from_quat(quaternions_xyzw).as_matrix()  # brings them to length 1
    return np.asarray(
        sum(np.exp(2.0 * log_scales[:, k, None, None]) * _outer(axes[:, :, k]) for k in range(3))
    )


def _outer(vectors: Array) -> Array:
    return vectors[:, :, None] * vectors[:, None, :]


def _draw_gaussians(rng: np.random.Generator) -> tuple[Any, ...]:
    count = int(rng.integers(3, 7))
    z = -rng.uniform(1.5, 9.0, count)
    means = np.stack([*(rng.uniform(-0.8, 0.8, (2, count)) * z), z], axis=1)
    roots = rng.normal(scale=0.3, size=(count, 3, 3))
    lens = {
        "fx": rng.uniform(80.0, 300.0),
        "fy": rng.uniform(80.0, 300.0),
        "cx": rng.uniform(50.0, 99.0),
    }
    lens = {name: float(value) for name, value in (lens | {"cy": rng.uniform(30.0, 80.0)}).items()}
    return means, roots @ roots.transpose(0, 2, 1), lens, float(rng.uniform(0.1, 2.0))


def _project(
    means_camera: Array, covs_camera: Array, lens: dict[str, float], blur_px2: float
) -> tuple[Array, Array]:
    camera = PinholeCamera(**lens, width=160, height=120)

    def pixels(points: Array) -> Array:
        return camera.project(points * TO_OPENCV, np.eye(4))[0]

    steps = STEP * np.eye(3)
    J = np.stack(
        [(pixels(means_camera + s) - pixels(means_camera - s)) / (2.0 * STEP) for s in steps],
        axis=2,
    )
    return pixels(means_camera), np.einsum(
        "nai,nij,nbj->nab", J, covs_camera, J
    ) + blur_px2 * np.eye(2)


def _draw_picture(rng: np.random.Generator, kind: str) -> tuple[Any, ...]:
    """Splats in and around a picture of any shape.

    Few slender ones; large solid ones, behind which others hide; many small ones.
    """
    height, width = (int(each) for each in rng.integers(9, 45, 2))
    count = int(rng.integers(4, 9)) if kind == "few" else int(rng.integers(40, 90))
    size = {"few": 4.0, "large": 9.0, "many": 1.5}[kind]
    roots = size * (rng.normal(scale=0.4, size=(count, 2, 2)) + np.diag([1.0, 0.5]))
    opacities = rng.uniform(0.9, 1.0, count) if kind == "large" else rng.uniform(0.1, 1.0, count)
    return (
        rng.uniform(-0.25, 1.25, (count, 2)) * [width, height],
        roots @ roots.transpose(0, 2, 1) + 0.3 * np.eye(2),
        opacities,
        rng.uniform(0.0, 1.0, (count, 3)),
        2.0 + 0.1 * rng.permutation(count),
        (height, width),
        rng.uniform(0.0, 1.0, 3),
    )


def _draw_splats(rng: np.random.Generator) -> tuple[Any, ...]:
    """Pixels on, near and far from every splat.

    One splat is solid, so that the largest alpha shows.
    """
    count = int(rng.integers(3, 6))
    roots = rng.normal(scale=4.0, size=(count, 2, 2)) + np.diag([3.0, 1.0])
    means = rng.uniform(0.0, 20.0, (count, 2))
    away = rng.uniform(0.3, 4.5, (6, 1)) * _unit(rng.normal(size=(6, 2)))
    near = (means[:, None] + np.einsum("nij,pj->npi", roots, away)).reshape(-1, 2)
    opacities = np.append(1.0, rng.uniform(0.3, 1.0, count - 1))
    return np.concatenate([means, near]), means, roots @ roots.transpose(0, 2, 1), opacities


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _draw_layers(rng: np.random.Generator) -> tuple[Any, ...]:
    """Pixels that are hardly covered, half covered and full; depths in no order."""
    count = int(rng.integers(4, 8))
    alphas = rng.uniform(0.0, 1.0, (6, count)) * np.array(
        [[0.02], [0.5], [0.5], [0.8], [0.999], [0.05]]
    )
    return (
        alphas,
        rng.uniform(0.0, 1.0, (count, 3)),
        rng.uniform(1.0, 20.0, count),
        rng.uniform(0.0, 1.0, 3),
    )
