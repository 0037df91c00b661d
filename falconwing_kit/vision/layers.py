"""Layers of small networks in NumPy, each the same as PyTorch's; images are (C, h, w)."""

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]

SMALLEST_DEVIATION = 0.02  # an image with less contrast is not amplified


def standardise(image: Array32) -> Array32:
    """An image (h, w, C) with mean 0 and standard deviation 1 over its colours; a mask stays."""
    if image.shape[-1] < 3:
        return image
    colours = np.ascontiguousarray(image[..., :3])
    deviation = max(float(colours.std()), SMALLEST_DEVIATION)
    scaled = (colours - colours.mean()) / np.float32(deviation)
    return np.concatenate([scaled, image[..., 3:]], axis=-1)


def convolve(x: Array32, weight: Array32, stride: int) -> Array32:
    """Cross-correlation with zeros around, as in PyTorch: (C, h, w) -> (D, h / s, w / s).

    One matrix product does the work, of the image shifted by each place of a window, or, where that
    is smaller, of the image itself, and the products are shifted.

    Args:
        x: (C, h, w).
        weight: (D, C, k, k), k odd.
        stride: s.
    """
    (channels, rows, columns), (filters, _, k, _) = x.shape, weight.shape
    if k > 1:
        x = np.pad(x, ((0, 0), (k // 2, k // 2), (k // 2, k // 2)))
    rows, columns = (rows - 1) // stride + 1, (columns - 1) // stride + 1
    places = [(i, j) for i in range(k) for j in range(k)]
    kind = np.result_type(x, weight)
    if stride == 1 and filters < channels:
        flat = weight.transpose(2, 3, 0, 1).reshape(-1, channels)
        products = (flat @ x.reshape(channels, -1)).reshape(k, k, filters, *x.shape[1:])
        total = np.zeros((filters, rows, columns), kind)
        for i, j in places:
            total += products[i, j, :, i : i + rows, j : j + columns]
        return total
    matrix = np.empty((channels, k, k, rows, columns), kind)  # im2col
    for i, j in places:
        matrix[:, i, j] = x[:, i::stride, j::stride][:, :rows, :columns]
    product = weight.reshape(filters, -1) @ matrix.reshape(-1, rows * columns)
    return np.asarray(product).reshape(-1, rows, columns)


def double(x: Array32, rows: int, columns: int) -> Array32:
    """(C, h, w) with each pixel four times, cut to (C, rows, columns)."""
    doubled = np.empty((len(x), 2 * x.shape[1], 2 * x.shape[2]), x.dtype)
    doubled[:, ::2, ::2] = doubled[:, ::2, 1::2] = x
    doubled[:, 1::2] = doubled[:, ::2]
    return doubled[:, :rows, :columns]


def layer_norm(x: Array32, smallest: float = 1e-5) -> Array32:
    """x (F,) with mean 0 and variance 1 [Ba, Kiros & Hinton 2016, eq. 4, without gain]."""
    centred = x - x.mean()
    return np.asarray(centred / np.sqrt((centred**2).mean() + np.float32(smallest)))


def gated_recurrent_unit(
    x: Array32, h: Array32, W_x: Array32, W_h: Array32, b_x: Array32, b_h: Array32
) -> Array32:
    """The next memory of a gated recurrent unit [Cho et al. 2014, eq. 5 to 8].

    r = sigmoid(W_xr x + W_hr h), z = sigmoid(W_xz x + W_hz h), n = tanh(W_xn x + r (W_hn h)),
    h' = (1 - z) n + z h; each product has a bias.

    Args:
        x: (I,).
        h: (M,) memory.
        W_x, W_h: (3 M, I) and (3 M, M), the rows of r, z, n.
        b_x, b_h: (3 M,).
    """
    (xr, xz, xn), (hr, hz, hn) = np.split(W_x @ x + b_x, 3), np.split(W_h @ h + b_h, 3)
    r, z = sigmoid(xr + hr), sigmoid(xz + hz)
    return np.asarray((1.0 - z) * np.tanh(xn + r * hn) + z * h, np.float32)


def sigmoid(x: Array32) -> Array32:
    """1 / (1 + exp(-x)), without overflow."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * x))
