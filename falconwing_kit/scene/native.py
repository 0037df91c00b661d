"""The kit's scene file: an .npz <-> every field of a scene, in full precision or quantised.

Quantised files are for scenes that ship: 21 bytes a Gaussian at SH degree 0, 30 at degree 1.
Version 1 has these members, besides labels, label_names and source as in full precision:

    quantised    the version
    means        (N, 3) 16 bits, from the lowest to the highest place: 0.6 mm steps in a 40 m hall
    quaternions  (N,)   32 bits: index of the largest of w x y z (2), then the other three from
                        -sqrt(1/2) to sqrt(1/2) (10 each), with the sign that makes the largest > 0
    scales       (N, 3) 8 bits, steps of the logarithm between the smallest and the largest
    opacities    (N,)   8 bits, 0 to 1
    dc           (N, 3) 16 bits, the first colour coefficient, between its smallest and largest
    rest         (N, K - 1, 3) 8 bits, the further ones, likewise; absent at degree 0
    *_range      (2,) or (2, 3) the two ends of means, log scales, dc and rest, as float32

Both kinds may hold named points. The directory of a zip and the header of an array may claim any
size: both are compared with the size of the file before anything is unpacked, and nothing is ever
unpickled.
"""

import math
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.scene.ply import quaternions_from_smallest_three
from falconwing_kit.scene.sh import Array32

VERSION = 1
MAX_COMPRESSION = 200  # a zip that claims to unpack to more than this times its size is refused
FREE_BYTES = 1024 * 1024  # allowed whatever the size of the file
MAX_LOG_SCALE = 80.0  # exp of more overflows a float32: such a file is damaged
ROTATION_STEPS = 1023  # 10 bits
SMALLER_THREE = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # by index of the largest

# name -> NumPy's name of the type as a regular expression, number of axes
FLOATS, LETTERS = r"<f[48]", r"<U\d{1,7}"
FULL_ARRAYS = {
    "means": (FLOATS, 2), "quaternions": (FLOATS, 2), "scales": (FLOATS, 2),
    "opacities": (FLOATS, 1), "sh": (FLOATS, 3),
}  # fmt: skip
QUANTISED_ARRAYS = {
    "quantised": (r"\|u1", 1), "means": ("<u2", 2), "means_range": (FLOATS, 2),
    "quaternions": ("<u4", 1), "scales": (r"\|u1", 2), "scales_range": (FLOATS, 1),
    "opacities": (r"\|u1", 1), "dc": ("<u2", 2), "dc_range": (FLOATS, 1), "rest_range": (FLOATS, 1),
}  # fmt: skip
REST_ARRAY = {"rest": (r"\|u1", 3)}
LABEL_ARRAYS = {"labels": (r"\|u1", 1), "label_names": (LETTERS, 1), "source": (LETTERS, 0)}
POINT_ARRAYS = {"points": (FLOATS, 2), "point_names": (LETTERS, 1)}


def read_native(path: str | Path) -> dict[str, Any]:
    """Read a scene that the kit saved.

    Returns:
        The fields of `GaussianScene`, not yet checked.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is damaged or is no scene.
    """
    path = require_file(path)
    name, members = short_name(path), zip_members(path, (".npy",))
    labels_and_points = _read_labels(name, members) | {"points": _read_points(name, members)}
    if "quantised.npy" not in members:
        return _read_arrays(name, members, FULL_ARRAYS) | labels_and_points
    kinds = QUANTISED_ARRAYS | (REST_ARRAY if "rest.npy" in members else {})
    arrays = _read_arrays(name, members, kinds)
    if arrays["quantised"][0] != VERSION:
        got = arrays["quantised"][0]
        raise InputError(
            f"{name}: expected a quantised scene of version {VERSION}, got {got}; use a newer kit"
        )
    fields = restore(arrays)
    if fields is None:
        raise InputError(
            f"{name}: expected arrays of a quantised scene that fit each other, got others;"
            " save it again"
        )
    return fields | labels_and_points


def read_named_points(path: str | Path) -> dict[str, Array32]:
    """Named points (3,) [m] of a scene file, in its coordinates; empty where it holds none."""
    path = require_file(path)
    return _read_points(short_name(path), zip_members(path, (".npy",)))


def write_native(path: str | Path, fields: Mapping[str, Any]) -> None:
    """Write the fields of a `GaussianScene` in full precision: reading returns the same bits."""
    arrays = {name: fields[name] for name in ("labels", *FULL_ARRAYS)}
    with atomic_write(path) as file:
        np.savez(file, **arrays, **_word_arrays(fields), **_point_arrays(fields["points"]))


def write_quantised(
    path: str | Path, scene: Any, points: Mapping[str, ArrayLike] | None = None
) -> None:
    """Write a `GaussianScene` quantised, about a tenth of the size of a .ply.

    Args:
        points: named points (3,) [m] that belong to it; None for the scene's own.

    Raises:
        InputError: the file cannot be written.
        FileNotFoundError: the folder does not exist.
    """
    arrays = quantise(vars(scene))
    if arrays["rest"].size == 0:
        del arrays["rest"]  # the reader refuses empty arrays
    arrays |= _point_arrays(scene.points if points is None else points)
    with atomic_write(path) as file:
        np.savez_compressed(file, labels=scene.labels, **arrays, **_word_arrays(vars(scene)))


def quantise(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a scene as integer arrays, by the member names in the module's docstring."""
    arrays: dict[str, Any] = {"quantised": np.array([VERSION], np.uint8)}
    means, logs, opacities = fields["means"], np.log(fields["scales"]), fields["opacities"]
    arrays["means"], arrays["means_range"] = _steps(means, means.min(0), means.max(0), np.uint16)
    arrays["quaternions"] = _pack_rotations(fields["quaternions"])
    arrays["scales"], arrays["scales_range"] = _steps(logs, logs.min(), logs.max(), np.uint8)
    arrays["opacities"], _ = _steps(opacities, np.float32(0.0), np.float32(1.0), np.uint8)
    dc, rest = fields["sh"][:, 0], fields["sh"][:, 1:]
    arrays["dc"], arrays["dc_range"] = _steps(dc, dc.min(), dc.max(), np.uint16)
    low, high = (rest.min(), rest.max()) if rest.size else (np.float32(0.0), np.float32(0.0))
    arrays["rest"], arrays["rest_range"] = _steps(rest, low, high, np.uint8)
    return arrays


def restore(arrays: dict[str, Any]) -> dict[str, Any] | None:
    """Undo `quantise` to within half a step; None if the arrays do not fit each other.

    Args:
        arrays: of the right types and numbers of axes; `rest` may be missing.
    """
    count = len(arrays["means"])
    rest = arrays.get("rest", np.zeros((count, 0, 3), np.uint8))
    row_shapes = {"means": (3,), "quaternions": (), "scales": (3,), "opacities": (), "dc": (3,)}
    # quantised arrays, one row per Gaussian
    shapes_match = all(arrays[name].shape == (count, *shape) for name, shape in row_shapes.items())
    shapes_match &= rest.shape[0] == count and rest.shape[2] == 3
    # their ranges, lowest and highest value
    ends = [arrays[f"{name}_range"] for name in ("means", "scales", "dc", "rest")]
    shapes_match &= ends[0].shape == (2, 3) and all(len(pair) == 2 for pair in ends)
    ranges_finite = all(bool(np.isfinite(pair).all()) for pair in ends)
    if not (shapes_match and ranges_finite and np.abs(ends[1]).max() < MAX_LOG_SCALE):
        return None
    dc = _values(arrays["dc"], ends[2])[:, None]
    return {
        "means": _values(arrays["means"], ends[0]),
        "quaternions": _unpack_rotations(arrays["quaternions"]),
        "scales": np.exp(_values(arrays["scales"], ends[1])),
        "opacities": arrays["opacities"] / np.float32(255.0),
        "sh": np.concatenate([dc, _values(rest, ends[3])], axis=1),
    }


def zip_members(path: Path, endings: tuple[str, ...]) -> dict[str, bytes]:
    """Unpack the members of a zip whose names have an ending such as ".npy", by name.

    Raises:
        InputError: the zip is damaged, or claims more content than a file of its size can hold.
    """
    name, limit = short_name(path), MAX_COMPRESSION * path.stat().st_size + FREE_BYTES
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    members = {}
    try:
        with zipfile.ZipFile(path) as archive:
            infos = [info for info in archive.infolist() if info.filename.endswith(endings)]
            allowed = all(info.compress_type in methods for info in infos)
            allowed &= sum(info.file_size for info in infos) <= limit
            for info in infos if allowed else ():
                with archive.open(info) as member:
                    members[info.filename] = member.read(info.file_size + 1)
    except (
        zipfile.BadZipFile, zlib.error, EOFError, OSError, struct.error, RuntimeError, ValueError,
        OverflowError,
    ):  # fmt: skip
        raise InputError(
            f"{name}: expected a whole zip, got a damaged or encrypted one; copy or save it again"
        ) from None
    if not allowed or any(len(members[info.filename]) != info.file_size for info in infos):
        raise InputError(
            f"{name}: expected stored or deflated members of the sizes in its directory,"
            " got others; save it again"
        )
    return members


def _steps(values: Array32, low: Any, high: Any, kind: type) -> tuple[NDArray[Any], Array32]:
    """Values as the nearest of evenly spaced steps from low to high, and these two ends."""
    top, span = np.iinfo(kind).max, np.maximum(high - low, 1e-12).astype(np.float64)
    ends = np.stack([low, low + span]).astype(np.float32)
    return np.round((values - low) / span * top).clip(0, top).astype(kind), ends


def _values(steps: NDArray[np.integer[Any]], ends: Array32) -> Array32:
    """Float values of integer steps."""
    share = steps / np.float64(np.iinfo(steps.dtype).max)
    return (ends[0] + share * (ends[1].astype(np.float64) - ends[0])).astype(np.float32)


def _pack_rotations(quaternions: Array32) -> NDArray[np.uint32]:
    """(N,) words: 2 bits for the index of the largest component, 10 for each of the other three."""
    largest = np.abs(quaternions).argmax(axis=1)
    # q and -q are the same rotation: the sign that makes the largest component positive
    sign = np.sign(np.take_along_axis(quaternions, largest[:, None], axis=1))
    small = np.take_along_axis(quaternions * sign, SMALLER_THREE[largest], axis=1)
    steps = np.round((small * np.sqrt(0.5) + 0.5) * ROTATION_STEPS).clip(0, ROTATION_STEPS)
    a, b, c = steps.astype(np.uint32).T
    return np.asarray((largest.astype(np.uint32) << 30) | (a << 20) | (b << 10) | c, np.uint32)


def _unpack_rotations(packed: NDArray[np.uint32]) -> Array32:
    """Quaternions (N, 4) of length 1."""
    steps = np.stack([(packed >> shift) & ROTATION_STEPS for shift in (20, 10, 0)], axis=1)
    small = ((steps / ROTATION_STEPS - 0.5) * np.sqrt(2.0)).astype(np.float32)
    quaternions = quaternions_from_smallest_three(small, packed >> 30)
    return (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32)


def _word_arrays(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The members that hold text: names of labels, and source."""
    return {name: np.array(fields[name]) for name in ("label_names", "source")}


def _point_arrays(points: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """The members that hold named points; none where there are none."""
    if not points:
        return {}
    positions = np.array(list(points.values()), np.float32)
    return {"points": positions, "point_names": np.array(list(points))}


def _read_arrays(
    name: str, members: dict[str, bytes], kinds: Mapping[str, tuple[str, int]]
) -> dict[str, Any]:
    """Several arrays of a scene file, each of its type and number of axes."""
    arrays = {}
    for key, (kind, axes) in kinds.items():
        if f"{key}.npy" not in members:
            raise InputError(
                f"{name}: expected a scene of the kit with the array {key}, which is missing;"
                " save it again"
            )
        arrays[key] = _parse_array(members[f"{key}.npy"], kind, axes)
        if arrays[key] is None:
            raise InputError(
                f"{name}: expected {key} as the kit saves it, with {axes} axes, got other bytes;"
                " save again"
            )
    return arrays


def _parse_array(data: bytes, kind: str, axes: int) -> NDArray[Any] | None:
    """The array of an .npy file; None if its type or axes differ or it does not fill the file.

    The header is matched as text, since NumPy's own reader evaluates it as an expression.
    """
    pattern = (
        rf"\{{'descr': '({kind})', 'fortran_order': False, 'shape': \(([\d, ]{{0,40}})\), \}} *\n"
    )
    header = re.match(rb"\x93NUMPY\x01\x00.." + pattern.encode(), data, re.DOTALL)
    if header is None:
        return None
    dtype = np.dtype(header[1].decode())
    shape = tuple(int(length) for length in re.findall(rb"\d+", header[2]))
    size = dtype.itemsize * math.prod(shape)
    if len(shape) != axes or not 0 < size == len(data) - header.end():
        return None
    return np.ndarray(shape, dtype, buffer=data, offset=header.end()).copy()


def _read_labels(name: str, members: dict[str, bytes]) -> dict[str, Any]:
    """Labels, their names and the source."""
    arrays = _read_arrays(name, members, LABEL_ARRAYS)
    names, (source,) = _words(name, arrays["label_names"]), _words(name, arrays["source"])
    return {"labels": arrays["labels"], "label_names": tuple(names), "source": source}


def _read_points(name: str, members: dict[str, bytes]) -> dict[str, Array32]:
    """Named points by name; empty where the file holds none."""
    if "points.npy" not in members:
        return {}
    arrays = _read_arrays(name, members, POINT_ARRAYS)
    names, points = _words(name, arrays["point_names"]), arrays["points"].astype(np.float32)
    if points.shape != (len(names), 3) or not np.isfinite(points).all():
        raise InputError(
            f"{name}: expected a place for each of {len(names)} named points, got others;"
            " save it again"
        )
    return dict(zip(names, points, strict=True))


def _words(name: str, array: NDArray[np.str_]) -> list[str]:
    """The words of an array, decoded strictly: NumPy accepts code points that do not exist."""
    size, data = array.dtype.itemsize, array.tobytes()
    try:
        return [
            data[start : start + size].decode("utf-32-le").rstrip("\0")
            for start in range(0, len(data), size)
        ]
    except UnicodeDecodeError:
        raise InputError(
            f"{name}: expected words in label_names and source, got other bytes; save it again"
        ) from None
