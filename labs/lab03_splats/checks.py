"""Lab 3, public: the exercises, what a right function does, and what a person looks for."""

import math
import time
from functools import cache
from typing import Any

import numpy as np
from given import COHORT

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

CUT, SHARE = COHORT["cut_sigma"], COHORT["surface_share"]
LENS = {"fx": 100.0, "fy": 200.0, "cx": 80.0, "cy": 60.0}
AHEAD = np.array([[0.0, 0.0, -2.0]])
BACK = np.array([0.2, 0.4, 0.6])


def _unturned(cov3d: Function) -> bool:
    """By hand: not turned (w = 1, last), standard deviations 1, 2, 3: variances 1, 4, 9."""
    return is_same_answer(
        cov3d(np.log([[1.0, 2.0, 3.0]]), np.array([[0.0, 0.0, 0.0, 1.0]])),
        np.diag([1.0, 4.0, 9.0])[None],
    )


def _turned(cov3d: Function) -> bool:
    """By hand: s = 2, 1, 1 turned by 30 deg about z: xx = 3.25, yy = 1.75, xy = 3 s c > 0."""
    half = math.radians(15.0)
    xy = 3.0 * 0.5 * math.sqrt(0.75)
    expected = np.array([[[3.25, xy, 0.0], [xy, 1.75, 0.0], [0.0, 0.0, 1.0]]])
    return is_same_answer(
        cov3d(np.log([[2.0, 1.0, 1.0]]), np.array([[0.0, 0.0, math.sin(half), math.cos(half)]])),
        expected,
    )


def _any_length(cov3d: Function) -> bool:
    """Law: q, 3 q and -q are one rotation."""
    q, log_scales = np.array([[0.1, -0.7, 0.3, 0.6]]), np.array([[0.2, -0.5, -1.0]])
    one, three, minus = (
        cov3d(log_scales, factor * q / np.linalg.norm(q)) for factor in (1.0, 3.0, -1.0)
    )
    return is_same_answer((three, minus), (one, one)) and np.asarray(one).shape == (1, 3, 3)


def _keeps_volume(cov3d: Function) -> bool:
    """Law: turning keeps the volume: det = (s1 s2 s3)^2, and a covariance is symmetric."""
    log_scales, q = (
        np.array([[0.1, 0.4, -0.3], [0.0, -1.0, 0.5]]),
        np.array([[1.0, 2.0, 3.0, 4.0], [0.5, -1.0, 2.0, 0.3]]),
    )
    cov = np.asarray(cov3d(log_scales, q))
    volume = np.exp(2.0 * log_scales.sum(axis=1))
    return is_same_answer((np.linalg.det(cov), cov), (volume, cov.transpose(0, 2, 1)))


def _straight_ahead(project: Function) -> bool:
    """By hand: at 2 m, 1 m is 50 px across and 100 px down; blur 0.5.

    Right and down is right and up turned over.
    """
    cov = np.array([[[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.5]]])
    covs_px = np.array([[[2500 * 0.04 + 0.5, -5000 * 0.01], [-5000 * 0.01, 10000 * 0.09 + 0.5]]])
    return is_same_answer(project(AHEAD, cov, LENS, 0.5), (np.array([[80.0, 60.0]]), covs_px))


def _right_and_up(project: Function) -> bool:
    """By hand: 1 m right and 0.5 m up at 2 m: 50 px right of the middle and 50 px above it."""
    means_px, _ = project(np.array([[1.0, 0.5, -2.0]]), np.eye(3)[None], LENS, 0.3)
    return is_same_answer(means_px, np.array([[130.0, 10.0]]))


def _towards_us(project: Function) -> bool:
    """By hand: depth only, 1 m^2, at (1, 0.5, -2): J's last column is (25, -25)."""
    deep = np.diag([0.0, 0.0, 1.0])[None]
    _, covs_px = project(np.array([[1.0, 0.5, -2.0]]), deep, LENS, 0.0)
    return is_same_answer(covs_px, np.array([[[625.0, -625.0], [-625.0, 625.0]]]))


def _mixed(project: Function) -> bool:
    """By hand: J = [[50, 0, 25], [0, -100, -25]].

    Xz = 0.1 adds 2 * 50 * 25 * 0.1 to uu, -50 * 25 * 0.1 to uv.
    """
    cov = np.array([[[1.0, 0.0, 0.1], [0.0, 1.0, 0.0], [0.1, 0.0, 1.0]]])
    _, covs_px = project(np.array([[1.0, 0.5, -2.0]]), cov, LENS, 0.0)
    expected = np.array([[[2500 + 250 + 625, -125 - 625], [-125 - 625, 10000 + 625]]], dtype=float)
    return is_same_answer(covs_px, expected)


def _one_sigma(alphas: Function) -> bool:
    """By hand: variances 4 and 9: at 2 px across or 3 px down q = 1, at both q = 2."""
    pixels = np.array([[5.0, 5.0], [7.0, 5.0], [5.0, 2.0], [7.0, 8.0]])
    got = alphas(pixels, np.array([[5.0, 5.0]]), np.diag([4.0, 9.0])[None], np.array([0.8]))
    return is_same_answer(got, 0.8 * np.exp([[0.0], [-0.5], [-0.5], [-1.0]]))


def _slanted(alphas: Function) -> bool:
    """By hand: the inverse of [[2, 1], [1, 2]] gives q = 2/3 along (1, 1) and 2 along (1, -1)."""
    pixels = np.array([[1.0, 1.0], [1.0, -1.0]])
    got = alphas(
        pixels,
        np.zeros((2, 2)),
        np.array([[[2.0, 1.0], [1.0, 2.0]], np.eye(2)]),
        np.array([0.5, 0.9]),
    )
    return is_same_answer(
        got, np.array([[0.5, 0.9], [0.5, 0.9]]) * np.exp([[-1.0 / 3.0, -1.0], [-1.0, -1.0]])
    )


def _ends(alphas: Function) -> bool:
    """By hand: just inside the cut there is something, just outside nothing.

    Standard deviation 2 px.
    """
    inside, outside = 2.0 * CUT - 0.01, 2.0 * CUT + 0.01
    got = alphas(
        np.array([[inside, 0.0], [0.0, outside]]),
        np.zeros((1, 2)),
        4.0 * np.eye(2)[None],
        np.array([0.9]),
    )
    return is_same_answer(got, np.array([[0.9 * math.exp(-0.125 * inside**2)], [0.0]]))


def _never_full(alphas: Function) -> bool:
    """By hand: a solid splat covers 0.999 at its mean, and 0.9 at q = -2 ln 0.9."""
    pixels = np.array([[3.0, 4.0], [3.0, 4.0 + math.sqrt(-2.0 * math.log(0.9))]])
    return is_same_answer(
        alphas(pixels, np.array([[3.0, 4.0]]), np.eye(2)[None], np.ones(1)),
        np.array([[0.999], [0.9]]),
    )


def _two_layers(composite: Function) -> bool:
    """By hand: half red before half green before the background: 1/2, 1/4 and 1/4."""
    rgb, _ = composite(np.array([[0.5, 0.5]]), np.eye(3)[:2], np.array([1.0, 2.0]), BACK)
    return is_same_answer(rgb, np.array([[0.5, 0.25, 0.0]]) + 0.25 * BACK)


def _order_of_the_file(composite: Function) -> bool:
    """By hand: the nearest comes last in the file: 0.8 green before 0.5 red."""
    rgb, depth = composite(np.array([[0.5, 0.8]]), np.eye(3)[:2], np.array([7.0, 3.0]), np.zeros(3))
    return is_same_answer((rgb, depth), (np.array([[0.1, 0.8, 0.0]]), np.array([3.0])))


def _surface_depth(composite: Function) -> bool:
    """By hand: the share is reached by the first splat, by the first two, or never (nan)."""
    much, little = SHARE + 0.05, SHARE - 0.1
    alphas = np.array([[much, 0.1, 0.1], [little, 0.4, 0.9], [0.1, 0.1, 0.1]])
    rgb, depth = composite(alphas, np.ones((3, 3)), np.array([2.0, 4.0, 6.0]), np.ones(3))
    return is_same_answer((rgb, depth), (np.ones((3, 3)), np.array([2.0, 4.0, float("nan")])))


GREY = 0.5 / 255.0  # half a grey level


def _every_splat_everywhere(
    means_px: Any, covs_px: Any, opacities: Any, colours: Any, depths: Any, shape: Any, back: Any
) -> np.ndarray:
    """The slow way, from the farthest splat to the nearest, each over the whole picture."""
    height, width = shape
    v, u = np.mgrid[:height, :width] + 0.5
    image = np.tile(np.asarray(back, float), (height, width, 1))
    for i in np.argsort(-np.asarray(depths)):
        d = np.stack([u - means_px[i, 0], v - means_px[i, 1]], axis=-1)
        square = np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(covs_px[i]), d)
        alpha = np.minimum(0.999, opacities[i] * np.exp(-0.5 * square))
        alpha = np.where(square <= CUT**2, alpha, 0.0)[..., None]
        image = alpha * colours[i] + (1.0 - alpha) * image
    return image


def _splats(count: int, shape: tuple[int, int], size: float, seed: int = 3) -> tuple[Any, ...]:
    """Drawn splats in and around a picture."""
    rng = np.random.default_rng(seed)
    roots = size * (rng.normal(0.0, 0.5, (count, 2, 2)) + np.eye(2))
    return (
        rng.uniform(-0.2, 1.2, (count, 2)) * np.array(shape[::-1], float),
        roots @ roots.transpose(0, 2, 1) + 0.3 * np.eye(2),
        rng.uniform(0.2, 1.0, count),
        rng.uniform(0.0, 1.0, (count, 3)),
        rng.permutation(count) + 2.0,
    )


def _one_splat(u: float, v: float, var_u: float, var_v: float) -> tuple[Any, ...]:
    cov = np.array([[[var_u, 0.0], [0.0, var_v]]])
    return np.array([[u, v]]), cov, np.array([0.8]), np.array([[1.0, 0.5, 0.0]]), np.array([3.0])


def _draws(render: Function, splats: tuple[Any, ...], shape: tuple[int, int]) -> bool:
    expected = _every_splat_everywhere(*splats, shape, BACK)
    return is_same_answer(render(*splats, shape, BACK), expected, rtol=0.0, atol=GREY)


def _at_the_mean(render: Function) -> bool:
    """By hand: at its mean, the centre of pixel (7, 20), a splat of 0.8 leaves a fifth of BACK."""
    image = np.asarray(render(*_one_splat(20.5, 7.5, 2.0, 2.0), (24, 40), BACK))
    expected = 0.8 * np.array([1.0, 0.5, 0.0]) + 0.2 * BACK
    return is_same_answer(image[7, 20], expected, atol=1e-6) and is_same_answer(
        image[0, 0], BACK, atol=1e-6
    )


def _behind_a_wall(render: Function) -> bool:
    """Forty solid splats before a hundred others: what is behind them does not show, by law."""
    wall = [np.repeat(each, 40, axis=0) for each in _one_splat(20.0, 12.0, 900.0, 900.0)]
    others = _splats(100, (24, 40), 3.0)
    mixed = [np.concatenate([a, b]) for a, b in zip(others, wall, strict=True)]
    mixed[4] = np.concatenate([others[4] + 50.0, np.linspace(1.0, 2.0, 40)])
    return _draws(render, tuple(mixed), (24, 40))


def _light_that_is_left(render: Function) -> bool:
    """Large splats: light is used up in some pixels of a tile and not in others."""
    shape = (30, 44)
    half = [each.copy() for each in _splats(120, shape, 6.0, seed=8)]
    half[2] = np.where(half[0][:, 0] < 20.0, 0.97, 0.04)
    return _draws(render, tuple(half), shape) and _draws(render, _splats(80, shape, 9.0), shape)


def _is_faster(render: Function) -> bool:
    """At most half of the slow way's time on 300 small splats, each the best of three."""
    seconds = _best_of_three(render)
    if seconds >= 0.5 * _slow_seconds():
        _slow_seconds.cache_clear()  # the machine may be busier than it was
    return seconds < 0.5 * _slow_seconds()


def _best_of_three(render: Function) -> float:
    shape, times = (96, 128), []
    for _ in range(3):
        splats = _splats(300, shape, 1.5)
        begin = time.perf_counter()
        render(*splats, shape, BACK)
        times.append(time.perf_counter() - begin)
    return min(times)


@cache
def _slow_seconds() -> float:
    return _best_of_three(_every_splat_everywhere)  # once: it is the longest part of all checks


TILES = (
    Check(
        "nothing to draw: the background everywhere, for any shape",
        lambda f: all(
            is_same_answer(
                f(*(each[:0] for each in _one_splat(1.0, 1.0, 1.0, 1.0)), shape, BACK),
                np.tile(BACK, (*shape, 1)),
            )
            for shape in ((1, 1), (5, 37), (33, 16))
        ),
        "a tile without splats is background; H is the first number of shape",
    ),
    Check(
        "a splat is where its mean is, with 0.8 of its colour there",
        _at_the_mean,
        "the centre of a pixel is at column + 0.5, row + 0.5; u belongs to columns",
    ),
    Check(
        "a splat over the corner of four tiles is whole",
        lambda f: (
            _draws(f, _one_splat(16.0, 16.0, 30.0, 3.0), (40, 40))
            and _draws(f, _one_splat(8.0, 24.0, 2.0, 40.0), (40, 40))
        ),
        "compare boxes: a splat whose mean lies in another tile may reach into this one; u and v "
        "have their own reach",
    ),
    Check(
        "a splat from outside of the picture reaches into it",
        lambda f: (
            _draws(f, _one_splat(-6.0, 10.0, 25.0, 9.0), (20, 30))
            and _draws(f, _one_splat(12.0, 25.0, 4.0, 25.0), (20, 30))
        ),
        "do not drop splats by their means",
    ),
    Check(
        "60 splats in a picture that no tile fits, in the order of their depths",
        lambda f: _draws(f, _splats(60, (29, 43), 3.0), (29, 43)),
        "the tiles at the edges are smaller; opacities, colours and covariances are sorted, too",
    ),
    Check(
        "what is behind a wall of solid splats does not show",
        _behind_a_wall,
        "stop only where light is used up in the whole tile, and never before it is",
    ),
    Check(
        "many large splats: where light is left, those far behind still show",
        _light_that_is_left,
        "go on with the light that is left, and only stop when no pixel of the tile has any",
    ),
    Check(
        "300 small splats take at most half of the slow way's time",
        _is_faster,
        "only the splats whose box touches the tile; whole tiles as arrays, no loop over pixels",
    ),
)

LAB = Lab(
    name="lab03",
    title="Splat renderer",
    hours=5.0,
    exercises=(
        Exercise(
            "cov3d_from_scale_quat",
            12.0,
            (
                Check(
                    "not turned, the variances are 1, 4 and 9 for standard deviations 1, 2 and 3",
                    _unturned,
                    "the scales come as logarithms; the covariance holds their squares; "
                    "w is the last of the four",
                ),
                Check(
                    "turned by 30 deg about z, the longest axis leans from x to y",
                    _turned,
                    "R S S^T R^T: a transposed R turns the other way",
                ),
                Check(
                    "q, 3 q and -q give the same",
                    _any_length,
                    "bring each quaternion to length 1, each by its own",
                ),
                Check(
                    "turning keeps the volume, and the result is symmetric",
                    _keeps_volume,
                    "is your R a rotation?",
                ),
            ),
        ),
        Exercise(
            "project_gaussians",
            15.0,
            (
                Check(
                    "at 2 m straight ahead, f / 2 pixels are a metre, and v counts down",
                    _straight_ahead,
                    "fx for u, fy for v; the blur is added to both variances; "
                    "what leans up right in space is uv < 0",
                ),
                Check(
                    "right and up of the axis is right and up in the picture",
                    _right_and_up,
                    "ahead is -z, and z < 0",
                ),
                Check(
                    "a cloud that is only deep is drawn out from the middle",
                    _towards_us,
                    "the third column of J: derive x / -z by z, with its sign",
                ),
                Check(
                    "a cloud that leans in depth, by hand",
                    _mixed,
                    "J Sigma J^T with all entries of J in place",
                ),
            ),
        ),
        Exercise(
            "splat_alphas",
            14.0,
            (
                Check(
                    "one standard deviation away it is exp(-1/2) of the opacity",
                    _one_sigma,
                    "q / 2, with q squared",
                ),
                Check(
                    "a slanted splat reaches further along its slant; "
                    "each splat has its own column",
                    _slanted,
                    "d^T Sigma^-1 d with the whole inverse, for each pixel and each splat",
                ),
                Check(
                    "it ends at the course's number of standard deviations",
                    _ends,
                    "compare sqrt(q) with cut_sigma",
                ),
                Check(
                    "even a solid splat covers 0.999 at most", _never_full, "the smaller of the two"
                ),
            ),
        ),
        Exercise(
            "alpha_composite",
            14.0,
            (
                Check(
                    "half red before half green leaves a quarter",
                    _two_layers,
                    "T_1 = 1; the first splat gets all light",
                ),
                Check(
                    "the nearest covers the others, wherever it stands in the file",
                    _order_of_the_file,
                    "sort by depth; alphas, colours and depths must all follow",
                ),
                Check(
                    "the surface is where the share is reached for the first time, else nan",
                    _surface_depth,
                    "1 - T behind the splat, at least COHORT['surface_share']; "
                    "argmax finds the first True",
                ),
            ),
        ),
        Exercise("render_tiles", 20.0, TILES, seconds=30.0, nearby=False, free=True),
    ),
    rubric=(
        Criterion(
            "render",
            11.0,
            "own picture like the kit's; the difference is shown with its scale and stays within a "
            "few 1/255",
        ),
        Criterion(
            "render_reading",
            4.0,
            "thin curves where splats are cut, as they end at another alpha; "
            "a wrong order lights up whole objects, "
            "half a pixel doubles outlines",
        ),
        Criterion(
            "q1", 5.0, "o exp(-k^2 / 2), about 3.7/255 at 2.9; a test: another cut, look again"
        ),
        Criterion(
            "q2",
            5.0,
            "own time scaled by 6.1e10 alphas; about 1 % not zero; tiles or boxes, stop when full",
        ),
    ),
    constants={"cut_sigma": (2.6, 3.2, 1), "surface_share": (0.4, 0.6, 2)},
)
