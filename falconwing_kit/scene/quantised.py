"""A scene's arrays <-> whole numbers of few bits, for scenes that ship: 21 bytes a Gaussian at SH
degree 0, 30 at 1.

Version 1, the members of the .npz:

    quantised    the version
    means        (N, 3) 16 bits, from the lowest to the highest place: 0.6 mm apart in a hall of 40 m
    quaternions  (N,)   32 bits: which of w x y z is the largest (2), then the three others from -sqrt(1/2) to sqrt(1/2)
                        (10 each), lengthened to 1 and turned so that the largest is positive
    scales       (N, 3) 8 bits, steps of the logarithm between the smallest and the largest
    opacities    (N,)   8 bits, 0 to 1
    dc           (N, 3) 16 bits, the first colour coefficient, between its smallest and largest
    rest         (N, K - 1, 3) 8 bits, the further ones, likewise
    *_range      (2,) or (2, 3) the two ends of means, log scales, dc and rest, as float32

and the labels, label names and source as in the native file of full precision.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.scene.ply import Array32, quaternions_from_smallest_three

VERSION = 1
MAX_LOG_SCALE = (
    80.0  # a float32 has no larger exponential that is finite; a file that asks for more is damaged
)
_BITS_LARGEST, _STEPS_ROTATION = 30, 1023
Numbers = NDArray[np.integer[Any]]


def quantise(
    means: Array32, quaternions: Array32, scales: Array32, opacities: Array32, sh: Array32
) -> dict[str, Any]:
    """Round every array of a scene to whole numbers.

    Args:
        means: (N, 3) [m].
        quaternions: (N, 4) w x y z, of length 1.
        scales: (N, 3) [m], > 0.
        opacities: (N,) 0..1.
        sh: (N, K, 3).

    Returns:
        The members of the file by name, without labels and source.
    """
    members: dict[str, Any] = {"quantised": np.array([VERSION], np.uint8)}
    members["means"], members["means_range"] = _steps(
        means, means.min(axis=0), means.max(axis=0), np.uint16
    )
    members["quaternions"] = _pack_rotations(quaternions)
    logs = np.log(scales)
    members["scales"], members["scales_range"] = _steps(logs, logs.min(), logs.max(), np.uint8)
    members["opacities"], _ = _steps(opacities, np.float32(0.0), np.float32(1.0), np.uint8)
    dc, rest = sh[:, 0], sh[:, 1:]
    members["dc"], members["dc_range"] = _steps(dc, dc.min(), dc.max(), np.uint16)
    low, high = (rest.min(), rest.max()) if rest.size else (np.float32(0.0), np.float32(0.0))
    members["rest"], members["rest_range"] = _steps(rest, low, high, np.uint8)
    return members


def restore(members: dict[str, Any]) -> dict[str, Any] | None:
    """Undo `quantise`, to within half a step.

    Args:
        members: as `quantise` gives them, of the right types and numbers of axes; `rest` may be
            missing.

    Returns:
        means, quaternions, scales, opacities and sh as float32, None if the members do not fit each
        other.
    """
    count = len(members["means"])
    shapes = {"means": (3,), "quaternions": (), "scales": (3,), "opacities": (), "dc": (3,)}
    rest = members.get("rest", np.zeros((count, 0, 3), np.uint8))
    fits = all(members[name].shape == (count, *shape) for name, shape in shapes.items())
    ends = [members[f"{name}_range"] for name in ("means", "scales", "dc", "rest")]
    finite = (
        all(len(pair) == 2 and np.isfinite(pair).all() for pair in ends)
        and np.abs(ends[1]).max() < MAX_LOG_SCALE
    )
    if not (
        fits
        and finite
        and ends[0].shape == (2, 3)
        and rest.shape[0] == count
        and rest.shape[2] == 3
    ):
        return None
    dc = _values(members["dc"], ends[2])[:, None]
    return {
        "means": _values(members["means"], ends[0]),
        "quaternions": _unpack_rotations(members["quaternions"]),
        "scales": np.exp(_values(members["scales"], ends[1])),
        "opacities": members["opacities"] / np.float32(255.0),
        "sh": np.concatenate([dc, _values(rest, ends[3])], axis=1),
    }


def _steps(values: Array32, low: Any, high: Any, kind: type) -> tuple[Numbers, Array32]:
    """Values as the nearest of evenly spaced steps from low to high, and these two ends."""
    top, span = np.iinfo(kind).max, np.maximum(high - low, 1e-12).astype(np.float64)
    ends = np.stack([low, low + span]).astype(np.float32)
    return np.round((values - low) / span * top).clip(0, top).astype(kind), ends


def _values(steps: Numbers, ends: Array32) -> Array32:
    """What the steps stand for."""
    part = steps / np.float64(np.iinfo(steps.dtype).max)
    return (ends[0] + part * (ends[1].astype(np.float64) - ends[0])).astype(np.float32)


def _pack_rotations(quaternions: Array32) -> NDArray[np.uint32]:
    """The three smaller components in 10 bits each, and which one was left out in 2."""
    largest = np.abs(quaternions).argmax(axis=1)
    sign = np.sign(np.take_along_axis(quaternions, largest[:, None], axis=1))
    places = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    small = np.take_along_axis(quaternions * sign, places, axis=1)
    steps = (
        np.round((small * np.sqrt(0.5) + 0.5) * _STEPS_ROTATION)
        .clip(0, _STEPS_ROTATION)
        .astype(np.uint32)
    )
    packed = (
        (largest.astype(np.uint32) << _BITS_LARGEST)
        | (steps[:, 0] << 20)
        | (steps[:, 1] << 10)
        | steps[:, 2]
    )
    return np.asarray(packed, np.uint32)


def _unpack_rotations(packed: NDArray[np.uint32]) -> Array32:
    """Quaternions of length 1."""
    steps = np.stack([(packed >> shift) & _STEPS_ROTATION for shift in (20, 10, 0)], axis=1)
    small = ((steps / _STEPS_ROTATION - 0.5) * np.sqrt(2.0)).astype(np.float32)
    quaternions = quaternions_from_smallest_three(small, packed >> _BITS_LARGEST)
    return (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32)
