"""The kit's own scene file: a NumPy .npz with every array of a scene, its labels and its source; and safe unzipping.

A zip's directory may promise anything, and so may the header of an array in it. Both are checked against the size of
the file before anything is unpacked; nothing is ever unpickled.
"""

import math
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name

MAX_COMPRESSION = 200  # what claims to unpack to more than this many times the file is damaged or hostile
FREE_BYTES = 1024 * 1024  # below this nobody asks
_FLOATS, _LABELS, _LETTERS = r"<f[48]", r"\|u1", r"<U\d{1,7}"
_ARRAYS = {  # name: what NumPy calls its numbers, and how many axes it has
    **{"means": (_FLOATS, 2), "quaternions": (_FLOATS, 2), "scales": (_FLOATS, 2), "opacities": (_FLOATS, 1)},
    **{"sh": (_FLOATS, 3), "labels": (_LABELS, 1), "label_names": (_LETTERS, 1), "source": (_LETTERS, 0)},
}


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
    fields: dict[str, Any] = {}
    for key, (kind, axes) in _ARRAYS.items():
        if f"{key}.npy" not in members:
            raise InputError(f"{name}: want a scene of the kit with the array {key}, which is missing; save it again")
        fields[key] = _array(members[f"{key}.npy"], kind, axes)
        if fields[key] is None:
            raise InputError(f"{name}: want {key} as the kit saves it, with {axes} axes, got other bytes; save again")
    try:
        return fields | {"label_names": tuple(_words(fields["label_names"])), "source": _words(fields["source"])[0]}
    except UnicodeDecodeError:
        raise InputError(f"{name}: want words in label_names and source, got other bytes; save it again") from None


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

    Raises:
        InputError: the place cannot be written.
        FileNotFoundError: the folder does not exist.
    """
    numbers = {"means": means, "quaternions": quaternions, "scales": scales, "opacities": opacities, "sh": sh}
    words = {"label_names": np.array(label_names), "source": np.array(source)}
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
            known = all(info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in wanted)
            fair = known and sum(info.file_size for info in wanted) <= limit
            for info in wanted if fair else ():
                with archive.open(info) as member:
                    members[info.filename] = member.read(info.file_size + 1)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, struct.error, RuntimeError, ValueError, OverflowError):
        raise InputError(f"{name}: want a whole zip, got a damaged or encrypted one; copy or save it again") from None
    if not fair or any(len(members[info.filename]) != info.file_size for info in wanted):
        raise InputError(f"{name}: want stored or deflated members of the sizes it tells, got others; save it again")
    return members


def _array(data: bytes, kind: str, axes: int) -> NDArray[Any] | None:
    """The array of an .npy file, None if it is another one or does not fill the file.

    The header is compared with what NumPy writes; NumPy's own reader would evaluate it as an expression.
    """
    wanted = rf"\{{'descr': '({kind})', 'fortran_order': False, 'shape': \(([\d, ]{{0,40}})\), \}} *\n"
    header = re.match(rb"\x93NUMPY\x01\x00.." + wanted.encode(), data, re.DOTALL)
    if header is None:
        return None
    dtype, shape = np.dtype(header[1].decode()), tuple(int(length) for length in re.findall(rb"\d+", header[2]))
    whole = len(shape) == axes and 0 < dtype.itemsize * math.prod(shape) == len(data) - header.end()
    return np.ndarray(shape, dtype, buffer=data, offset=header.end()).copy() if whole else None


def _words(array: NDArray[np.str_]) -> list[str]:
    """The words of an array, decoded letter by letter: NumPy lets through what no letter has."""
    size = array.dtype.itemsize
    data = array.tobytes()
    return [data[at : at + size].decode("utf-32-le").rstrip("\0") for at in range(0, len(data), size)]
