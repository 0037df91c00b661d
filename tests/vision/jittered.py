"""Images with line jitter, as simulated receivers give them."""

import numpy as np

CORRELATION_LINES = 24.0  # lines over which the correlation of shifts falls to 1/e


def line_shifts(count, sigma_px, rng):
    """(count,) shifts of lines [px]: a first-order process, by its recursion."""
    keep = np.exp(-1.0 / CORRELATION_LINES)
    shift = np.empty(count)
    shift[0] = sigma_px * rng.standard_normal()
    for k in range(1, count):
        innovation = sigma_px * np.sqrt(1.0 - keep**2) * rng.standard_normal()
        shift[k] = keep * shift[k - 1] + innovation
    return shift


def jittered(image, sigma_px, rng):
    """The image (H, W, 3) with each line shifted to the right, by linear interpolation."""
    x = np.arange(image.shape[1], dtype=float)
    lines = zip(image, line_shifts(len(image), sigma_px, rng), strict=True)
    moved = [
        np.stack([np.interp(x - shift, x, colour) for colour in line.T.astype(float)], axis=1)
        for line, shift in lines
    ]
    return np.rint(moved).astype(np.uint8)
