"""Lines of an analog picture: a known print in it -> how far they stray sideways, and what that
makes of its corners.

An analog receiver follows noisy sync pulses with a flywheel, so that lines begin early or late,
neighbours alike. A small square on such lines is sheared, and a sheared square looks like one that
is turned: its corners still fit a pose, and what that pose leaves over tells nothing. The print
tells: line by line its edges stand left or right of where the homography that fits it best wants
them, and by more than column by column they stand high or low. A picture that came without such a
link has nothing to tell the two apart, and no wander.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array, require_range, require_shape

# over so many lines shifts are alike to 1/e: measured against the trained hall on its analog photos
CORRELATION_LINES = 24.0
MIN_EDGE = 0.25  # of a middling line's edges; where there are less the shift is a guess
MIN_LINES = (
    6  # that a print must cover: two numbers are fitted to them, and two more read off the rest
)


def line_correlation(rows: Array) -> Array:
    """Correlation of the shifts of lines, exp(-|difference| / LINES_ALIKE) [first-order lock of a
    line oscillator].

    Args:
        rows: (..., K) which lines.

    Returns:
        (..., K, K).
    """
    return np.asarray(np.exp(-np.abs(rows[..., :, None] - rows[..., None, :]) / CORRELATION_LINES))


def line_and_column_shifts(
    seen: ArrayLike, expected: ArrayLike, inside: ArrayLike
) -> tuple[Array, Array]:
    """How far each line of a picture lies to the right of what is expected, and each column below
    it.

    seen(x) = a expected(x - s) + b for each line: s = sum g (a expected + b - seen) / sum g^2, g
    the slope of the first along the line [Lucas & Kanade, An iterative image registration
    technique, 1981, in one dimension].

    Args:
        seen: (H, W) grey levels.
        expected: (H, W) the same up to contrast and brightness, which are fitted.
        inside: (H, W) bool, where to compare.

    Returns:
        (H,) and (W,) [px]; nan where there are too few edges.

    Raises:
        InputError: the three differ in shape.
    """
    seen = require_shape("seen", seen, (None, None))
    expected = require_shape("expected", expected, seen.shape)
    covered = require_shape("inside", inside, seen.shape) > 0.5
    known = np.stack([expected[covered], np.ones(int(covered.sum()))], axis=1)
    contrast, brightness = np.linalg.lstsq(known, seen[covered], rcond=None)[0]
    drawn = contrast * expected + brightness
    missing = np.where(covered, drawn - seen, 0.0)
    both = []
    for along in (1, 0):
        slope = np.where(covered, np.gradient(drawn, axis=along), 0.0)
        edges = (slope**2).sum(axis=along)
        clear = (
            edges > MIN_EDGE * np.median(edges[edges > 0.0]) if (edges > 0.0).any() else edges > 0.0
        )
        shift = np.full(len(edges), np.nan)
        shift[clear] = (slope * missing).sum(axis=along)[clear] / edges[clear]
        both.append(shift)
    return both[0], both[1]


def sync_jitter_px(detections: Iterable[tuple[Array, Array]]) -> float:
    """Wander of a video's lines: what lines stray that neighbours share, less what columns do.

    A print's own misfit and the picture's noise move lines and columns; a link moves lines.

    Args:
        sights: shifts of lines and of columns (see `line_and_column_shifts`) of each sight of a
            print.

    Returns:
        Standard deviation of a line's shift [px]; 0 where lines stray no more than columns, or too
        few are seen.
    """
    pairs = list(detections)
    lines, columns = (_shared_variance([pair[which] for pair in pairs]) for which in (0, 1))
    return float(np.sqrt(max(lines - columns, 0.0)))


def corner_covariance(corners_px: Array, sigma_px: float, sync_jitter: float) -> Array:
    """Covariance of the corners u1 v1 ... u4 v4 of squares: noise of each, and what their lines
    share sideways.

    Args:
        corners_px: (M, 4, 2).
        sigma_px: noise of one coordinate [px], > 0.
        wander: of the lines [px], >= 0.

    Returns:
        (M, 8, 8) [px^2].

    Raises:
        InputError: a size is out of range, or the corners are not of this shape.
    """
    corners_px = require_shape("corners_px", corners_px, (None, 4, 2))
    require_range("sigma_px", sigma_px, low=1e-6)
    require_range("sync_jitter", sync_jitter, low=0.0)
    covariance = np.broadcast_to(sigma_px**2 * np.eye(8), (len(corners_px), 8, 8)).copy()
    covariance[:, ::2, ::2] += sync_jitter**2 * line_correlation(corners_px[..., 1])
    return covariance


def _shared_variance(shifts: list[Array]) -> float:
    """Variance of the shift that neighbours share [px^2], from lines whose mean and slope the
    homography took out.

    e = P (white noise of variance r + shared shift of variance s), P the projection that takes out
    mean and slope. Two sums of squares are set equal to what they are on average [method of
    moments; Searle, Variance components]:

        |e|^2      = r tr P     + s tr(P C)          C = line_likeness
        |D e|^2    = r tr(D P D^T) + s tr(D P C P D^T)     D: differences of neighbours
    """
    found, expected = np.zeros(2), np.zeros((2, 2))
    for shift in shifts:
        rows = np.flatnonzero(np.isfinite(shift))
        if len(rows) < MIN_LINES:
            continue
        line = np.linalg.qr(np.stack([np.ones(len(rows)), rows - rows.mean()], axis=1))[0]
        P = np.eye(len(rows)) - line @ line.T
        PCP = P @ line_correlation(rows.astype(float)) @ P
        D = np.diff(np.eye(len(rows)), axis=0)[np.diff(rows) == 1]
        e = P @ shift[rows]
        found += e @ e, (D @ e) @ (D @ e)
        expected += [[np.trace(P), np.trace(PCP)], [np.trace(D @ P @ D.T), np.trace(D @ PCP @ D.T)]]
    if not expected[1].any():  # no print, or none with two lines side by side
        return 0.0
    return float(np.linalg.solve(expected, found)[1])
