"""The kit's own scene file: a NumPy .npz with every array of a scene, its labels and its source;
and safe unzipping.

It comes in two kinds, which one reader tells apart: of full precision, and quantised for scenes
that ship (the layout stands in `quantised.py`). Either may hold named points of what it shows, such
as wing tips.

A zip's directory may promise anything, and so may the header of an array in it. Both are checked
against the size of the file before anything is unpacked; nothing is ever unpickled.
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
from falconwing_kit.scene.quantised import VERSION, quantise, restore

MAX_COMPRESSION = (
    200  # what claims to unpack to more than this many times the file is damaged or hostile
)
FREE_BYTES = 1024 * 1024  # below this nobody asks
_FLOATS, _LABELS, _LETTERS = r"<f[48]", r"\|u1", r"<U\d{1,7}"
_BYTES, _SHORTS = r"\|u1", "<u2"
_ARRAYS = {  # name: what NumPy calls its numbers, and how many axes it has
    **{
        "means": (_FLOATS, 2),
        "quaternions": (_FLOATS, 2),
        "scales": (_FLOATS, 2),
        "opacities": (_FLOATS, 1),
    },
    "sh": (_FLOATS, 3),
}
_WORDS = {"labels": (_LABELS, 1), "label_names": (_LETTERS, 1), "source": (_LETTERS, 0)}
_QUANTISED = {
    **{
        "quantised": (_BYTES, 1),
        "means": (_SHORTS, 2),
        "means_range": (_FLOATS, 2),
        "quaternions": ("<u4", 1),
    },
    **{
        "scales": (_BYTES, 2),
        "scales_range": (_FLOATS, 1),
        "opacities": (_BYTES, 1),
        "dc": (_SHORTS, 2),
    },
    **{"dc_range": (_FLOATS, 1), "rest_range": (_FLOATS, 1)},
}
_POINTS = {"points": (_FLOATS, 2), "point_names": (_LETTERS, 1)}


def read_native(path: str | Path) -> dict[str, Any]:
    """Read a scene that the kit saved.

    Args:
        path: the .npz file.

    Returns:
        The fields of `GaussianScene`, not yet checked.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is damaged or is no scene.
    """
    path = require_file(path)
    name, members = short_name(path), zip_members(path, (".npy",))
    rest = _words_of(name, members) | {"points": _points_of(name, members)}
    if "quantised.npy" not in members:
        return _arrays(name, members, _ARRAYS) | rest
    kinds = _QUANTISED | ({"rest": (_BYTES, 3)} if "rest.npy" in members else {})
    numbers = _arrays(name, members, kinds)
    if numbers["quantised"][0] != VERSION:
        got = numbers["quantised"][0]
        raise InputError(
            f"{name}: expected a quantised scene of version {VERSION}, got {got}; use a newer kit"
        )
    fields = restore(numbers)
    if fields is None:
        raise InputError(
            f"{name}: expected arrays of a quantised scene that fit each other, got others; save it again"
        )
    return fields | rest


def read_named_points(path: str | Path) -> dict[str, NDArray[np.float32]]:
    """The named points of a scene file, such as an aircraft's nose and wing tips.

    Args:
        path: the .npz file.

    Returns:
        (3,) [m] by name, in the scene's coordinates; empty where the file holds none.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is damaged.
    """
    path = require_file(path)
    return _points_of(short_name(path), zip_members(path, (".npy",)))


def write_quantised(
    path: str | Path, scene: Any, points: Mapping[str, ArrayLike] | None = None
) -> None:
    """Write a scene in whole numbers of few bits, about a tenth of the size of a .ply; reading is
    as for any scene.

    Args:
        path: the .npz to write; it appears only once it is complete.
        scene: the `GaussianScene`.
        points: named points (3,) [m] that belong to it; None for the scene's own.

    Raises:
        InputError: the place cannot be written.
        FileNotFoundError: the folder does not exist.
    """
    numbers = quantise(scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
    if numbers["rest"].size == 0:
        del numbers["rest"]  # the reader wants no empty arrays
    numbers |= _point_arrays(scene.points if points is None else points)
    words = {"label_names": np.array(scene.label_names), "source": np.array(scene.source)}
    with atomic_write(path) as file:
        np.savez_compressed(file, labels=scene.labels, **numbers, **words)  # type: ignore[arg-type]


def write_native(
    path: str | Path,
    means: NDArray[np.float32],
    quaternions: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    sh: NDArray[np.float32],
    labels: NDArray[np.uint8],
    label_names: tuple[str, ...],
    source: str,
    points: Mapping[str, ArrayLike],
) -> None:
    """Write every field of a scene; reading gives the same bits back.

    Args:
        path: the .npz to write; it appears only once it is complete.
        means: (N, 3) [m].
        quaternions: (N, 4) w x y z.
        scales: (N, 3) [m].
        opacities: (N,) 0..1.
        sh: (N, K, 3).
        labels: (N,) numbers of label names.
        label_names: what each label is called.
        source: where the scene came from.
        points: named points (3,) [m].

    Raises:
        InputError: the place cannot be written.
        FileNotFoundError: the folder does not exist.
    """
    numbers = {
        "means": means,
        "quaternions": quaternions,
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    words = {"label_names": np.array(label_names), "source": np.array(source)} | _point_arrays(
        points
    )
    with atomic_write(path) as file:
        np.savez(file, labels=labels, **numbers, **words)  # type: ignore[arg-type]


def zip_members(path: Path, endings: tuple[str, ...]) -> dict[str, bytes]:
    """Unpack the members of a zip with the given endings, if their sizes can be true.

    Args:
        path: the zip.
        endings: ".npy", ".webp" and such.

    Returns:
        Content by name.

    Raises:
        InputError: the zip is damaged, or promises more than a file of its size can hold.
    """
    name, limit = short_name(path), MAX_COMPRESSION * path.stat().st_size + FREE_BYTES
    members = {}
    try:
        with zipfile.ZipFile(path) as archive:
            wanted = [info for info in archive.infolist() if info.filename.endswith(endings)]
            known = all(
                info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in wanted
            )
            fair = known and sum(info.file_size for info in wanted) <= limit
            for info in wanted if fair else ():
                with archive.open(info) as member:
                    members[info.filename] = member.read(info.file_size + 1)
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        struct.error,
        RuntimeError,
        ValueError,
        OverflowError,
    ):
        raise InputError(
            f"{name}: expected a whole zip, got a damaged or encrypted one; copy or save it again"
        ) from None
    if not fair or any(len(members[info.filename]) != info.file_size for info in wanted):
        raise InputError(
            f"{name}: expected stored or deflated members of the sizes it tells, got others; save it again"
        )
    return members


def _arrays(
    name: str, members: dict[str, bytes], kinds: Mapping[str, tuple[str, int]]
) -> dict[str, Any]:
    """Several arrays of a scene file, each of its kind and number of axes."""
    arrays = {}
    for key, (kind, axes) in kinds.items():
        if f"{key}.npy" not in members:
            raise InputError(
                f"{name}: expected a scene of the kit with the array {key}, which is missing; save it again"
            )
        arrays[key] = _array(members[f"{key}.npy"], kind, axes)
        if arrays[key] is None:
            raise InputError(
                f"{name}: expected {key} as the kit saves it, with {axes} axes, got other bytes; save again"
            )
    return arrays


def _words_of(name: str, members: dict[str, bytes]) -> dict[str, Any]:
    """Labels, their names and the source."""
    words = _arrays(name, members, _WORDS)
    names, source = (_decoded(name, words[key]) for key in ("label_names", "source"))
    return {"labels": words["labels"], "label_names": tuple(names), "source": source[0]}


def _points_of(name: str, members: dict[str, bytes]) -> dict[str, NDArray[np.float32]]:
    """Named points by name; empty where the file holds none."""
    if "points.npy" not in members:
        return {}
    arrays = _arrays(name, members, _POINTS)
    names, points = _decoded(name, arrays["point_names"]), arrays["points"].astype(np.float32)
    if points.shape != (len(names), 3) or not np.isfinite(points).all():
        raise InputError(
            f"{name}: expected a place for each of {len(names)} named points, got others; save it again"
        )
    return dict(zip(names, points, strict=True))


def _point_arrays(points: Mapping[str, ArrayLike]) -> dict[str, NDArray[Any]]:
    """The members that hold named points; none where there are none."""
    if not points:
        return {}
    return {
        "points": np.array(list(points.values()), np.float32),
        "point_names": np.array(list(points)),
    }


def _decoded(name: str, array: NDArray[np.str_]) -> list[str]:
    """The words of an array, if they are words."""
    try:
        return _words(array)
    except UnicodeDecodeError:
        raise InputError(
            f"{name}: expected words in label_names and source, got other bytes; save it again"
        ) from None


def _array(data: bytes, kind: str, axes: int) -> NDArray[Any] | None:
    """The array of an .npy file, None if it is another one or does not fill the file.

    The header is compared with what NumPy writes; NumPy's own reader would evaluate it as an
    expression.
    """
    wanted = (
        rf"\{{'descr': '({kind})', 'fortran_order': False, 'shape': \(([\d, ]{{0,40}})\), \}} *\n"
    )
    header = re.match(rb"\x93NUMPY\x01\x00.." + wanted.encode(), data, re.DOTALL)
    if header is None:
        return None
    dtype, shape = (
        np.dtype(header[1].decode()),
        tuple(int(length) for length in re.findall(rb"\d+", header[2])),
    )
    whole = len(shape) == axes and 0 < dtype.itemsize * math.prod(shape) == len(data) - header.end()
    return np.ndarray(shape, dtype, buffer=data, offset=header.end()).copy() if whole else None


def _words(array: NDArray[np.str_]) -> list[str]:
    """The words of an array, decoded letter by letter: NumPy lets through what no letter has."""
    size = array.dtype.itemsize
    data = array.tobytes()
    return [
        data[at : at + size].decode("utf-32-le").rstrip("\0") for at in range(0, len(data), size)
    ]
