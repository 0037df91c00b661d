"""Mask of the leader: an image -> how much of each pixel the leader makes up, by a small U-Net in
NumPy alone.

    image -> halved three times -> doubled three times, each time beside the map of that size

The contracting half finds what is there, the maps beside hold where it is [Ronneberger, Fischer &
Brox 2015, fig. 1]. The layers are those of mask_network.py, which trains them.
"""

from collections.abc import Mapping

import numpy as np

from falconwing_kit.vision.layers import Array32, convolve, double, sigmoid, standardise

# of each convolution on the way down: output channels, width of the kernel, stride
DOWN = ((16, 5, 2), (24, 3, 2), (32, 3, 2), (32, 3, 1))
UP = (24, 16, 8)  # output channels on the way up, beside the maps of 24, 16 and 3 channels
PREFIX = "mask."  # of its arrays among a policy's weights


def mask_weight_shapes() -> dict[str, tuple[int, ...]]:
    """Name and shape of each array of the network's weights."""
    shapes: dict[str, tuple[int, ...]] = {}
    channels, beside = 3, [3]
    for k, (out, kernel, _) in enumerate(DOWN):
        shapes |= {f"down{k}.weight": (out, channels, kernel, kernel), f"down{k}.bias": (out,)}
        channels = out
        beside.append(out)
    for k, out in enumerate(UP):
        before = channels + beside[len(UP) - 1 - k]
        shapes |= {f"up{k}.weight": (out, before, 3, 3), f"up{k}.bias": (out,)}
        channels = out
    return shapes | {"out.weight": (1, channels, 1, 1), "out.bias": (1,)}


def leader_mask(image: Array32, weights: Mapping[str, Array32]) -> Array32:
    """The leader's share (h, w) of each pixel, 0..1, of an image (h, w, 3) in 0..1.

    Args:
        image: red, green, blue.
        weights: of `mask_weight_shapes`, with PREFIX before each name.
    """

    def unit(name: str, x: Array32, stride: int = 1) -> Array32:
        weight, bias = weights[f"{PREFIX}{name}.weight"], weights[f"{PREFIX}{name}.bias"]
        return np.asarray(convolve(x, weight, stride) + bias[:, None, None])

    x = np.ascontiguousarray(standardise(image).transpose(2, 0, 1))
    maps = [x]
    for k, (_, _, stride) in enumerate(DOWN):
        x = np.maximum(unit(f"down{k}", x, stride), 0.0)
        maps.append(x)
    for k in range(len(UP)):
        beside = maps[len(UP) - 1 - k]
        x = np.concatenate([double(x, *beside.shape[1:]), beside])
        x = np.maximum(unit(f"up{k}", x), 0.0)
    return sigmoid(unit("out", x)[0])
