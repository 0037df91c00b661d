"""Pictures whose lines stray sideways, as simulated receivers give them."""

import numpy as np

LINES_ALIKE = 24.0  # lines over which shifts are alike to 1/e


def wandering(count, size, rng):
    """(count,) shifts of lines [px] of a first-order process, by its recursion."""
    keep = np.exp(-1.0 / LINES_ALIKE)
    shift = np.empty(count)
    shift[0] = size * rng.standard_normal()
    for k in range(1, count):
        shift[k] = keep * shift[k - 1] + size * np.sqrt(1.0 - keep**2) * rng.standard_normal()
    return shift


def strayed(image, size, rng):
    """The picture (H, W, 3) with each line moved to the right by its own shift, by linear
    interpolation.
    """
    x = np.arange(image.shape[1], dtype=float)
    lines = zip(image, wandering(len(image), size, rng), strict=True)
    moved = [
        np.stack([np.interp(x - shift, x, colour) for colour in line.T.astype(float)], axis=1)
        for line, shift in lines
    ]
    return np.rint(moved).astype(np.uint8)
