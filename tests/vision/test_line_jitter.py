"""Lines that stray: shifts put into drawn pictures, and read off again. Drawn and simulated."""

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.vision.line_jitter import (
    corner_covariance,
    line_and_column_shifts,
    sync_jitter_px,
)
from falconwing_kit.vision.marker import Marker, corner_noise, find_marker, project_corners
from tests.vision.drawn_marker import CAMERA, pose, view
from tests.vision.strayed import strayed, wandering


def waves(x, y):
    """A smooth pattern with edges both ways, grey levels, as a formula."""
    return 120.0 + 50.0 * np.sin(0.4 * x + 0.5 * np.sin(0.2 * y)) + 40.0 * np.cos(0.35 * y)


@pytest.mark.parametrize("along", ["lines", "columns"])
def test_each_line_and_column_tells_its_own_shift(along):
    """The pattern is a formula, so that it can be moved by any fraction of a pixel; contrast and
    brightness differ. Differences of neighbours see waves of 0.4 rad a pixel as 1 - sin(0.4) / 0.4
    = 3 % too flat: 0.02 px of the largest shift, twice. What is moved one way is still the other
    way.
    """
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:30, :40].astype(float)
    shift = rng.normal(0.0, 0.1, 30 if along == "lines" else 40)
    seen = waves(x - shift[:, None], y) if along == "lines" else waves(x, y - shift)
    found = line_and_column_shifts(0.6 * seen + 20.0, waves(x, y), np.ones((30, 40), bool))
    moved, still = found if along == "lines" else found[::-1]
    assert moved[1:-1] == pytest.approx(shift[1:-1], abs=0.02)
    assert np.abs(np.nanmean(still)) < 0.03


def test_lines_without_edges_say_nothing():
    """Upper half striped, lower half blank."""
    y, x = np.mgrid[:20, :40].astype(float)
    drawn = np.where(y < 10, 120.0 + 50.0 * np.sin(0.9 * x), 120.0)
    lines, _ = line_and_column_shifts(drawn, drawn, np.ones((20, 40), bool))
    assert np.isfinite(lines[:10]).all()
    assert np.isnan(lines[10:]).all()


@pytest.mark.parametrize(
    ("of_lines", "of_columns", "more"),
    [(0.25, 0.0, 0.25), (0.5, 0.0, 0.5), (0.5, 0.3, 0.4), (0.4, 0.4, 0.0)],
)
def test_wander_is_what_neighbours_share_and_columns_lack(of_lines, of_columns, more):
    """Shifts by recursion, x(k+1) = a x(k) + sqrt(1 - a^2) n with a = exp(-1/24), and noise of 0.15
    px on lines and columns. A homography has taken out mean and slope: here a straight line fitted
    by NumPy. Variances subtract, by hand 0.5^2 - 0.3^2 = 0.4^2. 400 prints, to 10 %. Where nothing
    is left, to 0.12 px: with two free numbers a print each 0.4^2 is known to sqrt(2 / 800) = 5 %,
    so their difference to 0.011 px^2, whose root is 0.11 px.
    """
    rng = np.random.default_rng(2)

    def left(shift):
        k = np.arange(len(shift))
        return shift - np.polyval(np.polyfit(k, shift, 1), k)

    pairs = []
    for _ in range(400):
        noise = rng.normal(0.0, 0.15, (2, int(rng.integers(12, 30))))
        both = [
            one + wandering(len(one), size, rng)
            for one, size in zip(noise, (of_lines, of_columns), strict=True)
        ]
        pairs.append((left(both[0]), left(both[1])))
    tolerance = (
        {"rel": 0.1, "abs": 0.0} if more else {"abs": 0.12}
    )  # the larger of the two would count
    assert sync_jitter_px(pairs) == pytest.approx(more, **tolerance)


def test_too_few_lines_show_no_wander():
    """No print at all, one that covers four lines, and one whose every other line alone has edges."""
    gappy = np.where(np.arange(16) % 2, 0.5, np.nan)
    assert sync_jitter_px([(gappy, gappy)]) == 0.0
    assert sync_jitter_px([]) == 0.0
    assert sync_jitter_px([(np.array([0.5, -0.5, 0.5, -0.5]), np.zeros(4))]) == 0.0


def test_corners_on_one_line_go_together_and_only_sideways():
    """By hand: 0.1 px of noise, 0.5 px of wander; the upper corners on one line share 0.25 px^2,
    the lower ones, 24 lines further down, 0.25 / e of it with them; nothing goes up or down.
    """
    square = np.array([[[10.0, 50.0], [34.0, 50.0], [34.0, 74.0], [10.0, 74.0]]])
    C = corner_covariance(square, 0.1, 0.5)[0]
    assert C[0, 0] == pytest.approx(0.26)
    assert C[0, 2] == pytest.approx(0.25)
    assert C[0, 4] == pytest.approx(0.25 / np.e)
    assert C[1::2, 1::2] == pytest.approx(0.01 * np.eye(4))
    assert not C[::2, 1::2].any()
    with pytest.raises(InputError, match="corners_px"):
        corner_covariance(square[0], 0.1, 0.5)


def test_a_marker_on_straying_lines_lies_within_its_covariance():
    """Truth is the drawing's geometry; lines stray by 0.5 px. Noise and wander are those of the
    sights.

    chi2 of eight coordinates has mean 8: within a factor of two. What poses leave over, without
        wander, says more than
    twice too little. And the prints tell the 0.5 px, to 0.15.
    """
    sights, true = [], []
    for k in range(30):
        rng = np.random.default_rng(k)
        T = pose(-6.0 - 0.2 * k, rng.uniform(-1.0, 1.0), 1.4, rng.uniform(-40.0, 40.0))
        corners = project_corners(Marker(), CAMERA, T)
        seen = find_marker(strayed(view(T, rng, blur_px=0.5), 0.5, rng), CAMERA, near_px=corners)
        if seen is not None:
            sights.append(seen)
            true.append(corners)
    assert len(sights) >= 20
    noise, sync_jitter = (
        corner_noise(sights),
        sync_jitter_px(sight.line_jitter_px for sight in sights),
    )
    off = np.array([sight.corners_px for sight in sights]) - true
    mean = {
        stated: np.mean(
            [
                d.ravel() @ np.linalg.solve(C, d.ravel())
                for d, C in zip(off, covariance, strict=True)
            ]
        )
        for stated in (0.0, sync_jitter)
        for covariance in [corner_covariance(np.array(true), noise, stated)]
    }
    assert 4.0 < mean[sync_jitter] < 16.0
    assert mean[0.0] > 2.0 * 8.0
    assert sync_jitter == pytest.approx(0.5, abs=0.15)
