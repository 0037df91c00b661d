"""Point clouds: a .ply with x, y, z and colours <-> arrays; the points of a transforms.json."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name

MAX_HEADER_BYTES = 65536
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"},
    **{
        "int8": "i1",
        "uint8": "u1",
        "int16": "<i2",
        "uint16": "<u2",
        "int32": "<i4",
        "uint32": "<u4",
    },
    **{"float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8"},
}
_ROW = np.dtype(
    [(axis, "<f4") for axis in "xyz"] + [(colour, "u1") for colour in ("red", "green", "blue")]
)


def write_points(path: str | Path, points: Array, colours: NDArray[np.uint8]) -> None:
    """Write a binary .ply that nerfstudio, MeshLab and Open3D read.

    Args:
        path: the file; written complete or not at all.
        points: (M, 3) [m], or in the units of a reconstruction.
        colours: (M, 3) red, green, blue, 0..255.

    Raises:
        InputError: the place cannot be written.
        FileNotFoundError: the folder does not exist.
    """
    rows = np.zeros(len(points), _ROW)
    for column, values in zip(_ROW.names or (), (*points.T, *colours.T), strict=True):
        rows[column] = values
    names = {"<f4": "float", "|u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {names[kind]} {column}" for column, kind, *_ in _ROW.descr),
        "end_header\n",
    ]
    with atomic_write(path) as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(rows.tobytes())


def read_points(path: str | Path) -> tuple[Array, NDArray[np.uint8]]:
    """Read the vertices of a .ply, text or binary little-endian.

    Args:
        path: a file with x, y, z; red, green, blue where it has them, else the points are grey.

    Returns:
        Points (M, 3) and colours (M, 3).

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is no such .ply, was cut, or holds numbers that are not finite.
    """
    path = require_file(path)
    name, data = short_name(path), path.read_bytes()
    binary, count, row, start = _header(data, name)
    if binary:
        if count * row.itemsize > len(data) - start:
            raise InputError(
                f"{name}: expected {count} points of {row.itemsize} bytes, got fewer bytes; "
                "the file was cut"
            )
        vertices = np.ndarray((count,), row, buffer=data, offset=start)
    else:
        vertices = _text_rows(data[start:], count, row, name)
    columns = set(row.names or ())
    if not columns.issuperset("xyz"):
        raise InputError(
            f"{name}: expected points with x, y and z, got {', '.join(sorted(columns)) or 'none'}"
        )
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    if not np.isfinite(points).all():
        raise InputError(
            f"{name}: expected finite coordinates, got nan or infinity; write the points again"
        )
    if not columns.issuperset(("red", "green", "blue")):
        return points, np.full((count, 3), 128, np.uint8)
    rgb = np.stack(
        [vertices[colour].astype(np.float64) for colour in ("red", "green", "blue")], axis=-1
    )
    return points, np.clip(rgb, 0, 255).astype(np.uint8)


def _header(data: bytes, name: str) -> tuple[bool, int, np.dtype[Any], int]:
    """Whether the file is binary, the vertex count, the row layout, and the offset of the rows."""
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    start = data.find(b"\n", max(end, 0), MAX_HEADER_BYTES + 16) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise InputError(
            f"{name}: expected a .ply with points, got another kind of file; check the path"
        )
    kind, count, element = "", 0, ""
    columns: list[tuple[str, str]] = []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, "1.0"]:
                pass
            case ["element", element, number] if number.isdecimal() and len(number) < 12:
                if element == "vertex":
                    count = int(number)
                elif not columns:
                    raise InputError(
                        f"{name}: expected the points first in the file, got {element[:40]}; "
                        "save it again"
                    )
            case ["property", type_name, label] if element == "vertex" and type_name in _TYPES:
                columns.append((label, _TYPES[type_name]))
            case ["property", *_] if element == "vertex":
                raise InputError(
                    f"{name}: expected plain numbers for each point, got the line {line[:60]!r}"
                )
    if kind not in ("binary_little_endian", "ascii") or len({label for label, _ in columns}) < len(
        columns
    ):
        raise InputError(
            f"{name}: expected a binary_little_endian or ascii .ply, got {kind[:40] or 'none'}; "
            "save it again"
        )
    return kind != "ascii", count, np.dtype(columns), start


def _text_rows(data: bytes, count: int, row: np.dtype[Any], name: str) -> NDArray[np.void]:
    """The rows of a text file."""
    lines = data.decode("ascii", "replace").splitlines()[:count]
    try:
        return np.array(
            [tuple(float(word) for word in line.split()) for line in lines], row
        ).reshape(count)
    except ValueError:
        columns = len(row.names or ())
        raise InputError(
            f"{name}: expected {count} lines of {columns} numbers, got others; the file was cut"
        ) from None
