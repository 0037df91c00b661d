"""SSIM: equal to scikit-image, and to the equation worked by hand."""

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.vision.ssim import C1, C2, ssim, ssim_map


def scene(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A picture with soft and hard edges: a ramp, boxes and grain."""
    picture = np.linspace(30.0, 200.0, width)[None, :].repeat(height, axis=0)
    for _ in range(12):
        row, column = rng.integers(0, height - 8), rng.integers(0, width - 8)
        picture[row : row + height // 5, column : column + width // 5] = rng.uniform(0.0, 255.0)
    return np.clip(picture + rng.normal(0.0, 2.0, picture.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 3.0, 25.0, 80.0])
@pytest.mark.parametrize("size", [(11, 11), (120, 160), (480, 640), (101, 37)])
def test_equals_scikit_image(size, noise):
    """An independent library, in float64; float32 sums of squares of 255 keep 1e-6, required
    are 1e-5.
    """
    from skimage.metrics import structural_similarity

    rng = np.random.default_rng([*size, int(noise)])
    first = scene(rng, *size)
    second = np.clip(first + rng.normal(0.0, noise, size), 0, 255).astype(np.uint8)
    theirs = structural_similarity(
        first, second, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
    )
    assert ssim(first, second) == pytest.approx(theirs, abs=1e-5)


def test_flat_pictures_by_hand():
    """No structure in 100 and in 150: (2 mu_x mu_y + C1) / (mu_x^2 + mu_y^2 + C1), and the second
    factor is one.
    """
    first, second = np.full((20, 30), 100, np.uint8), np.full((20, 30), 150, np.uint8)
    by_hand = (2 * 100 * 150 + 6.5025) / (100**2 + 150**2 + 6.5025)
    assert ssim(first, second) == pytest.approx(
        by_hand, abs=1e-3
    )  # 150^2 in float32 leaves 2e-3 of C2 = 58.5


def test_picture_and_its_negative_around_the_mean():
    """Equal means, sigma_xy = -sigma^2: the mean of (C2 - 2 sigma^2) / (C2 + 2 sigma^2), -0.99 for
    +-100 checks.
    """
    checks = 100 * (2 * (np.indices((40, 40)).sum(axis=0) % 2) - 1)
    value = ssim((127 + checks).astype(np.uint8), (127 - checks).astype(np.uint8))
    assert value == pytest.approx(
        (C2 - 2e4) / (C2 + 2e4), abs=5e-3
    )  # window weights of one colour sum to 0.5 + 3e-4
    assert pytest.approx((6.5025, 58.5225)) == (C1, C2)


def test_same_picture_is_one_and_order_does_not_matter():
    """The equation is symmetric, and one where x is y."""
    rng = np.random.default_rng(0)
    first, second = scene(rng, 60, 80), scene(rng, 60, 80)
    assert ssim(first, first) == pytest.approx(1.0, abs=1e-6)
    assert ssim(first, second) == pytest.approx(ssim(second, first), abs=1e-6)
    assert ssim_map(first, second).shape == (50, 70)


@pytest.mark.parametrize(
    "shapes", [((20, 20), (20, 21)), ((10, 40), (10, 40)), ((20, 20, 3), (20, 20, 3))]
)
def test_other_pictures_are_refused(shapes):
    """Sizes that differ, fewer pixels than the window, colour."""
    with pytest.raises(InputError, match="expected two grey images"):
        ssim(*(np.zeros(shape, np.uint8) for shape in shapes))
