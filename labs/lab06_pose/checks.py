"""Lab 6, public: the exercises, what a right function does, and what a person looks for."""

import math

import numpy as np
from given import COHORT, K, marker_square

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

GATE = COHORT["gate"]
FACING = np.diag([1.0, -1.0, -1.0])  # R_marker_camera of a camera that looks straight at the marker
UNEVEN = np.array([[400.0, 0.0, 300.0], [0.0, 300.0, 200.0], [0.0, 0.0, 1.0]])
# A box of four corners that are not in a plane, and a quarter turn about z: (x, y, z) -> (-y, x,
# z).
BOX = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 6.0]])
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _corners(
    R_marker_camera: np.ndarray, p_marker: np.ndarray, size: float, lens: np.ndarray
) -> np.ndarray:
    """(4, 2) pixels of the corners by u = fx x / z + cx, v = fy y / z + cy."""
    p_camera = (np.column_stack([marker_square(size), np.zeros(4)]) - p_marker) @ R_marker_camera
    return (p_camera @ lens.T)[:, :2] / p_camera[:, 2:]


def _straight_on(marker_pose: Function) -> bool:
    """By hand: 0.8 m at 4 m with f = 400 px is 80 px wide.

    The camera is 4 m away, y and z turned round.
    """
    corners = np.array([[260.0, 200.0], [340.0, 200.0], [340.0, 280.0], [260.0, 280.0]])
    lens = np.array([[400.0, 0.0, 300.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])
    expected = np.diag([1.0, -1.0, -1.0, 1.0])
    expected[2, 3] = 4.0
    return is_same_answer(marker_pose(corners, lens, 0.8), expected, atol=1e-6)


def _from_aside(marker_pose: Function) -> bool:
    """By hand: a camera right of the marker and above it, rotated, with unequal focal lengths."""
    c, s = math.cos(0.5), math.sin(0.5)
    R = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ FACING @ QUARTER
    p = np.array([2.0, 0.7, 3.5])
    T = marker_pose(_corners(R, p, 0.6, UNEVEN), UNEVEN, 0.6)
    return is_same_answer((T[:3, :3], T[:3, 3]), (R, p), atol=1e-6)


def _larger_marker(marker_pose: Function) -> bool:
    """The same image of a marker three times as large: three times as far, the same attitude."""
    corners = _corners(FACING, np.array([0.3, -0.2, 5.0]), 0.5, K)
    small, large = marker_pose(corners, K, 0.5), marker_pose(corners, K, 1.5)
    return is_same_answer(
        (large[:3, 3], large[:3, :3]), (3.0 * small[:3, 3], small[:3, :3]), atol=1e-6
    )


def _rotation_in_noise(marker_pose: Function) -> bool:
    """A law: whatever the corners, R^T R = 1 and det R = 1, and the last row is 0 0 0 1."""
    noise = np.array([[0.8, -0.5], [-0.6, 0.9], [0.4, 0.7], [-0.9, -0.3]])
    T = marker_pose(_corners(FACING, np.array([1.0, 0.5, 6.0]), 0.8, K) + noise, K, 0.8)
    R = T[:3, :3]
    proper = is_same_answer((R.T @ R, float(np.linalg.det(R))), (np.eye(3), 1.0))
    return proper and is_same_answer(T[3], np.array([0.0, 0.0, 0.0, 1.0])) and T[2, 3] > 5.0


def _square_that_looks_flat(marker_pose: Function) -> bool:
    """By hand: 80 px wide, 40 px high.

    The mean of both lengths makes it 60 px: 400 * 0.8 / 60 = 16/3 m.
    """
    corners = np.array([[260.0, 220.0], [340.0, 220.0], [340.0, 260.0], [260.0, 260.0]])
    lens = np.array([[400.0, 0.0, 300.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])
    expected = np.diag([1.0, -1.0, -1.0, 1.0])
    expected[2, 3] = 16.0 / 3.0
    return is_same_answer(marker_pose(corners, lens, 0.8), expected, atol=1e-6)


def _quarter_turn(fit_similarity: Function) -> bool:
    """By hand: three times as large, a quarter turn about z, moved by (1, 2, 3)."""
    expected = (3.0, QUARTER, np.array([1.0, 2.0, 3.0]))
    return is_same_answer(
        fit_similarity(BOX, 3.0 * BOX @ QUARTER.T + expected[2], np.ones(4)), expected, atol=1e-9
    )


def _weightless_points(fit_similarity: Function) -> bool:
    """A pair of weight 0 does not exist; and twice all weights is the same."""
    p_from, p_to = (
        np.vstack([BOX, [9.0, 9.0, 9.0]]),
        np.vstack([2.0 * BOX @ QUARTER.T, [-70.0, 5.0, 1.0]]),
    )
    got = fit_similarity(p_from, p_to, np.array([1.0, 2.0, 3.0, 4.0, 0.0]))
    return is_same_answer(got, (2.0, QUARTER, np.zeros(3)), atol=1e-9)


def _weights_pull(fit_similarity: Function) -> bool:
    """A law of least squares: the weighted mean of p_to - (s R p_from + t) is zero."""
    weights = np.array([5.0, 1.0, 2.0, 1.0, 3.0])
    p_from, p_to = np.vstack([BOX, [1.0, 1.0, 1.0]]), np.vstack([BOX, [1.5, 0.4, 2.0]])
    scale, R, t = fit_similarity(p_from, p_to, weights)
    return is_same_answer(weights @ (p_to - (scale * p_from @ R.T + t)), np.zeros(3), atol=1e-9)


def _stretches_right(fit_similarity: Function) -> bool:
    """By hand: of four points two stay, and two of weight 3 move by a half: (1 + 3 * 1.5) / 4."""
    cross = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    stretched = cross * np.array([[1.0], [1.0], [1.5], [1.5]])
    scale, R, _ = fit_similarity(cross, stretched, np.array([1.0, 1.0, 3.0, 3.0]))
    return is_same_answer((scale, R), (5.5 / 4.0, np.eye(3)), atol=1e-9)


def _no_mirror(fit_similarity: Function) -> bool:
    """A rotation is no mirror, even where the points ask for one: det R = 1.

    By hand: a mirrored z cannot be had.
    """
    cloud = np.array(
        [[3.0, 0, 0], [-3.0, 0, 0], [0, 2.0, 0], [0, -2.0, 0], [0, 0, 1.0], [0, 0, -1.0]]
    )
    scale, R, _ = fit_similarity(cloud, cloud * (1.0, 1.0, -1.0), np.ones(6))
    return is_same_answer((scale, R), ((18.0 + 8.0 - 2.0) / 28.0, np.eye(3)), atol=1e-9)


def _finds_the_good_candidate(reject_outliers: Function) -> bool:
    """By hand: two of five points are 100 m off.

    The first fits all a little, the second the good ones exactly.
    """
    p_from = np.vstack([BOX, [5.0, 5.0, 5.0]])
    p_to = p_from + np.array(
        [[0.0, 0, 0.01], [0, 0, 0.02], [0, 0, 0.03], [100.0, 0, 0], [0, 100.0, 0]]
    )
    wrong, right = (1.0, np.eye(3), np.array([20.0, 20.0, 0.0])), (1.0, np.eye(3), np.zeros(3))
    keep = np.array([True, True, True, False, False])
    return is_same_answer(reject_outliers(p_from, p_to, [wrong, right, wrong]), (1, keep))


def _uses_scale_turn_and_shift(reject_outliers: Function) -> bool:
    """By hand: of four candidates that differ in one part each, only the complete one fits."""
    t = np.array([1.0, -2.0, 0.5])
    p_to = (
        2.0 * BOX @ QUARTER.T
        + t
        + np.array([[0.0, 0.1, 0], [0.1, 0, 0], [0, 0, 0.1], [0, 30.0, 0]])
    )
    candidates = [
        (1.0, QUARTER, t),
        (2.0, QUARTER.T, t),
        (2.0, QUARTER, 0.0 * t),
        (2.0, QUARTER, t),
    ]
    return is_same_answer(
        reject_outliers(BOX, p_to, candidates), (3, np.array([True, True, True, False]))
    )


def _gate_is_of_the_median(reject_outliers: Function) -> bool:
    """By hand: misses 2, 2, 2, and just inside and just outside of the gate; their median is 2."""
    p_from = np.array([[float(k), 0.0, 0.0] for k in range(5)])
    misses = 2.0 * np.array([1.0, 1.0, 1.0, GATE - 0.01, GATE + 0.01])
    p_to = p_from + misses[:, None] * (0.0, 0.6, 0.8)
    keep = np.array([True, True, True, True, False])
    return is_same_answer(reject_outliers(p_from, p_to, [(1.0, np.eye(3), np.zeros(3))]), (0, keep))


def _three_rays(triangulate: Function) -> bool:
    """By hand: along each axis one ray of another length, all through (1, 2, 3)."""
    p = np.array([1.0, 2.0, 3.0])
    rays = np.diag([0.5, -4.0, 7.0])
    return is_same_answer(
        triangulate(p - 2.0 * rays, rays, np.array([1.0, 2.0, 5.0])), (p, np.zeros(3)), atol=1e-9
    )


def _between_two_rays(triangulate: Function) -> bool:
    """By hand: rays along x and along y, 3 apart in z.

    With weights 2 and 1 the point is 1 from the first.
    """
    centres, rays = (
        np.array([[-5.0, 0.0, 0.0], [0.0, 8.0, 3.0]]),
        np.array([[10.0, 0.0, 0.0], [0.0, 0.1, 0.0]]),
    )
    expected = (np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0]))
    return is_same_answer(triangulate(centres, rays, np.array([2.0, 1.0])), expected, atol=1e-9)


def _lengths_do_not_matter(triangulate: Function) -> bool:
    """A ray is a direction: ten times as long, or turned round, it is the same line."""
    centres = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 3.0, 1.0]])
    rays = np.array([[1.0, 1.1, 2.0], [-1.0, 0.9, 2.1], [1.2, -0.8, 1.5]])
    one, other = (
        triangulate(centres, f * rays, np.ones(3)) for f in (1.0, np.array([[10.0], [0.2], [-3.0]]))
    )
    return is_same_answer(one, other, atol=1e-9) and float(np.max(one[1])) > 0.01


LAB = Lab(
    name="lab06",
    title="Pose from images",
    hours=3.0,
    exercises=(
        Exercise(
            "marker_pose",
            25.0,
            (
                Check(
                    "0.8 m that look 80 px wide at f = 400 px: the camera is 4 m out of the marker",
                    _straight_on,
                    "divide A by the mean length of its first two columns; return the inverse pose",
                ),
                Check(
                    "from aside and turned, through a lens with fx other than fy",
                    _from_aside,
                    "the inverse of (R, t) is (R^T, -R^T t); K^-1 stands left of H",
                ),
                Check(
                    "a marker three times as large is three times as far",
                    _larger_marker,
                    "pass size to marker_square",
                ),
                Check(
                    "noisy corners still give a rotation",
                    _rotation_in_noise,
                    "put U V^T from the singular value decomposition in place of the three columns",
                ),
                Check(
                    "corners that are no square's, 80 x 40 px: the mean of both lengths counts",
                    _square_that_looks_flat,
                    "divide by the mean of |a1| and |a2|; then take the nearest rotation",
                ),
            ),
        ),
        Exercise(
            "fit_similarity",
            20.0,
            (
                Check(
                    "three times as large, a quarter turn, a shift",
                    _quarter_turn,
                    "M = sum w b a^T, in this order; the scale needs |a|^2; "
                    "t = mean_to - scale R mean_from",
                ),
                Check(
                    "a pair of weight 0 does not count",
                    _weightless_points,
                    "weights go into the means, into M and into the sum of |a|^2",
                ),
                Check(
                    "the weighted mean of what is left over is zero",
                    _weights_pull,
                    "means are weighted too, and weights need not sum to 1",
                ),
                Check(
                    "half of a cross stretched, with three times the weight: scale 1.375",
                    _stretches_right,
                    "the scale is trace(S D) over the weighted sum of |a|^2, that of p_from alone",
                ),
                Check(
                    "no mirror, even where the points ask for one",
                    _no_mirror,
                    "D has det(U V^T) in its last place; it goes into R and into the scale",
                ),
            ),
        ),
        Exercise(
            "reject_outliers",
            15.0,
            (
                Check(
                    "two points that are 100 m off do not change the choice",
                    _finds_the_good_candidate,
                    "compare medians of misses, not means; misses are lengths, one for each point",
                ),
                Check(
                    "scale, rotation and shift of each candidate are used",
                    _uses_scale_turn_and_shift,
                    "points are rows: scale * p_from @ R.T + t",
                ),
                Check(
                    "the gate is a multiple of the best candidate's median",
                    _gate_is_of_the_median,
                    'keep misses up to COHORT["gate"] times the median',
                ),
            ),
        ),
        Exercise(
            "triangulate",
            15.0,
            (
                Check(
                    "three rays that meet: the point, and no misses",
                    _three_rays,
                    "make the directions unit vectors before anything else",
                ),
                Check(
                    "between two rays that do not meet, nearer to the heavier one",
                    _between_two_rays,
                    "weights stand on both sides of the equation, once; misses have none",
                ),
                Check(
                    "a ray's length and sense do not matter",
                    _lengths_do_not_matter,
                    "divide each direction by its own length (keepdims)",
                ),
            ),
        ),
    ),
    rubric=(
        Criterion(
            "distance",
            5.0,
            "both kinds of points and both lines on logarithmic axes",
        ),
        Criterion(
            "distance_reading",
            3.0,
            "a single photo is not to be trusted beyond 6 to 10 m, with a reason (slope, jumps)",
        ),
        Criterion(
            "hall",
            4.0,
            "the hall from above with the first and the last recipe, the errors of all recipes",
        ),
        Criterion(
            "hall_reading",
            3.0,
            "weights use what is known about errors, the median needs no knowledge but a majority "
            "of good photos",
        ),
        Criterion(
            "q1",
            5.0,
            "0.38 m and 9.4 m (or: no longer valid); a half and a quarter; a half of both",
        ),
        Criterion(
            "q2",
            5.0,
            "SfM has no metre, so a scale is needed; leverage of 80 cm over 40 m; "
            "points far from the marker, such as "
            "the pad's corners",
        ),
    ),
    constants={"gate": (2.0, 3.0, 1)},
)
