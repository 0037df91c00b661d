"""Occlusion sensitivity: a policy, an image -> how far hiding each part of it moves the command.

A patch of the image is painted over with the image's mean colour, the policy acts again, and the
change of its command is drawn where the patch was [Zeiler and Fergus, "Visualizing and
Understanding Convolutional Networks", ECCV 2014, section on occlusion sensitivity].
"""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.vision.layers import Array32
from falconwing_kit.vision.policy import Memory, Policy

PATCH_PX, STRIDE_PX = 24, 12  # in an image of 160x120; the pad 10 m away is about 15 wide


@dataclass(frozen=True, eq=False)
class Seen:
    """What a policy made one command of."""

    image: Array32  # (h, w, 3) in 0..1, as the policy's camera takes it
    inputs: Array32  # of `policy_inputs`
    memory: Memory  # before the step


def occlusion_sensitivity(
    policy: Policy, seen: Seen, patch: int = PATCH_PX, stride: int = STRIDE_PX
) -> Array:
    """How far hiding each part of the image changes the command.

    Args:
        policy: that flew.
        seen: image, inputs and memory of one step.
        patch: side of the square that is painted over [px].
        stride: from one square to the next [px].

    Returns:
        (rows, columns) Euclidean change of the four commands [-], each held to its limits; element
        (i, j) is the square whose upper left corner is at row i stride, column j stride.
    """
    mean = seen.image.mean(axis=(0, 1))

    def command(image: Array32) -> Array:
        commands, _ = policy.step(policy.encode(image), seen.inputs, seen.memory)
        return np.asarray(np.clip(commands, (0.0, -1.0, -1.0, -1.0), 1.0), float)

    def hidden(row: int, column: int) -> Array32:
        image = seen.image.copy()
        image[row : row + patch, column : column + patch] = mean
        return image

    whole = command(seen.image)
    height, width, _ = seen.image.shape
    rows = range(0, height - patch + 1, stride)
    columns = range(0, width - patch + 1, stride)
    return np.array(
        [[np.linalg.norm(command(hidden(i, j)) - whole) for j in columns] for i in rows]
    )
