"""PLY: a 3DGS .ply or a PlayCanvas compressed .ply -> fields of a scene; and fields -> a 3DGS .ply.

The plain layout is that of Inria's and nerfstudio's exports: 32-bit floats, scales as logarithms,
opacity as logit, the quaternion w first, f_rest all red, then all green, then all blue. The
compressed one packs chunks of 256 Gaussians between their least and greatest values.
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply

The header is text that may claim any size; nothing is allocated before the file proves long enough.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.scene.sh import SH_C0, SH_COUNTS, Array32

MAX_HEADER_BYTES = 65536
MAX_LOGIT = 20.0  # opacity within 2e-9 of 0 or 1: their own logits are infinite
CHUNK = 256

TYPES = {  # of a PLY header -> NumPy's
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
MEANS, DC = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES, QUATERNION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

Columns = dict[str, str]  # property -> NumPy's type
Rows = NDArray[np.void]


def read_ply(path: str | Path) -> dict[str, Any]:
    """Read the Gaussians of a binary little-endian .ply, plain or compressed.

    Returns:
        The fields of `GaussianScene` that the file holds, not yet checked; source, where a comment
        of the file gives it.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is damaged, is no binary little-endian PLY, or holds no Gaussians.
    """
    path = require_file(path)
    name, data = short_name(path), path.read_bytes()
    header, start, source = _read_header(data, name)
    elements = _map_elements(data, header, start, name)
    if "vertex" not in elements:
        found = ", ".join(elements) or "none"
        raise InputError(f"{name}: expected an element called vertex, found {found}")
    unpack = _unpack_chunks if "chunk" in elements else _unpack_floats
    with np.errstate(over="ignore", invalid="ignore"):  # GaussianScene refuses what overflows
        fields = unpack(elements, name)
    return fields | ({"source": source} if source else {})


def write_ply(path: str | Path, fields: Mapping[str, Any]) -> None:
    """Write the fields of a `GaussianScene` as a 3DGS .ply; the source goes into its comments.

    Opacities of exactly 0 and 1 move by 2e-9, for their logits are infinite; letters of the source
    outside ASCII are escaped.
    """
    means, sh = fields["means"], fields["sh"]
    opacities = fields["opacities"].astype(np.float64)
    count, rest = len(means), 3 * (sh.shape[1] - 1)
    with np.errstate(divide="ignore"):
        logit = np.clip(np.log(opacities) - np.log1p(-opacities), -MAX_LOGIT, MAX_LOGIT)
    rest_names = [f"f_rest_{k}" for k in range(rest)]
    names = [*MEANS, "nx", "ny", "nz", *DC, *rest_names, "opacity", *SCALES, *QUATERNION]
    columns = (
        means,
        np.zeros((count, 3)),  # normals
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(count, rest),  # (N, 3, K - 1): channel by channel
        logit[:, None],
        np.log(fields["scales"]),
        fields["quaternions"],
    )
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment source {line}" for line in fields["source"].splitlines()),
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    with atomic_write(path) as file:
        file.write("\n".join(header).encode("ascii", "backslashreplace"))
        file.write(np.concatenate(columns, axis=1).astype("<f4").tobytes())


def quaternions_from_smallest_three(
    small: NDArray[np.floating[Any]], largest: NDArray[np.integer[Any]]
) -> Array32:
    """Unit quaternions (N, 4) from all components but the largest, which is positive.

    largest = sqrt(1 - a^2 - b^2 - c^2)

    Args:
        small: (N, 3) the other components, in their order.
        largest: (N,) index of the component left out, 0..3.
    """
    indices = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    quaternions = np.empty((len(small), 4), np.float32)
    np.put_along_axis(quaternions, indices, small.astype(np.float32), axis=1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - (small**2).sum(axis=1, keepdims=True)))
    column = np.asarray(largest, np.int64)[:, None]
    np.put_along_axis(quaternions, column, rest.astype(np.float32), axis=1)
    return quaternions


def _read_header(data: bytes, name: str) -> tuple[dict[str, tuple[int, Columns]], int, str]:
    """Row count and columns of each element, start of the rows, and source in the comments."""
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    start = data.find(b"\n", max(end, 0), MAX_HEADER_BYTES + 16) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        got = "a PLY header without its end" if data.startswith(b"ply") else "another kind of file"
        raise InputError(
            f"{name}: expected a .ply with 3D Gaussians, got {got if data else 'an empty file'};"
            " check the path"
        )
    elements: dict[str, tuple[int, Columns]] = {}
    source: list[str] = []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["comment", "source", *_]:
                source.append(line.strip().removeprefix("comment source").strip())
            case ["format", "binary_little_endian", "1.0"] | ["comment" | "obj_info", *_] | []:
                pass
            case ["format", kind, *_]:
                raise InputError(
                    f"{name}: expected a binary_little_endian .ply, got {kind[:40]};"
                    " save it again as binary"
                )
            case ["element", label, count] if (
                count.isdecimal() and len(count) < 16 and label not in elements
            ):
                elements[label] = (int(count), {})
            case ["property", kind, label] if kind in TYPES and elements:
                columns = elements[next(reversed(elements))][1]
                if label in columns:
                    raise InputError(
                        f"{name}: expected every property once, got {label[:40]!r} twice"
                    )
                columns[label] = TYPES[kind]
            case _:
                raise InputError(
                    f"{name}: expected elements of plain numbers in the header,"
                    f" got the line {line[:80]!r}"
                )
    return elements, start, "\n".join(source)


def _map_elements(
    data: bytes, header: dict[str, tuple[int, Columns]], start: int, name: str
) -> dict[str, Rows]:
    """The rows of each element as views into the file's bytes."""
    elements = {}
    for label, (count, columns) in header.items():
        row = np.dtype(list(columns.items()))
        size, left = count * row.itemsize, len(data) - start
        if size > left or not columns:
            raise InputError(
                f"{name}: expected {count} rows of {row.itemsize} bytes for {label[:40]},"
                f" got {left} bytes; the file was cut"
            )
        elements[label] = np.ndarray((count,), row, buffer=data, offset=start)
        start += size
    return elements


def _unpack_floats(elements: dict[str, Rows], name: str) -> dict[str, Any]:
    """Gaussians of a plain 3DGS .ply."""
    vertices = elements["vertex"]
    logit = _columns(vertices, ("opacity",), name)[:, 0]
    rest = _columns(vertices, _rest_names(vertices, name), name)
    return {
        "means": _columns(vertices, MEANS, name),
        "quaternions": _columns(vertices, QUATERNION, name),
        "scales": np.exp(_columns(vertices, SCALES, name)),
        "opacities": 1.0 / (1.0 + np.exp(-logit)),
        "sh": _join_sh(_columns(vertices, DC, name), rest),
    }


def _unpack_chunks(elements: dict[str, Rows], name: str) -> dict[str, Any]:
    """Gaussians of a compressed .ply: fractions between the bounds of their chunk."""
    vertices, chunks = elements["vertex"], elements["chunk"]
    types = {column: kind for column, kind, *_ in vertices.dtype.descr}
    chunk_count = -(-len(vertices) // CHUNK)
    if any(types.get(column) != "<u4" for column in PACKED) or len(chunks) != chunk_count:
        raise InputError(
            f"{name}: expected {', '.join(PACKED)} and a chunk for each {CHUNK} Gaussians;"
            " save it again"
        )
    position, rotation, scale, color = (vertices[column] for column in PACKED)
    chunk = np.arange(len(vertices)) // CHUNK

    def interpolate(fractions: Array32, names: tuple[str, str, str]) -> Array32:
        """Fractions (N, 3) between the bounds of each Gaussian's chunk -> values."""
        low = _columns(chunks, tuple(f"min_{axis}" for axis in names), name)[chunk]
        high = _columns(chunks, tuple(f"max_{axis}" for axis in names), name)[chunk]
        return low * (1.0 - fractions) + high * fractions

    rgba = _fractions(color, (8, 8, 8, 8))
    has_range = "min_r" in (chunks.dtype.names or ())  # older files: colours from 0 to 1
    rgb = interpolate(rgba[:, :3], ("r", "g", "b")) if has_range else rgba[:, :3]
    rest = np.zeros((len(vertices), 0), np.float32)
    if "sh" in elements:
        rest = _unpack_sh(elements["sh"], len(vertices), name)
    small = (_fractions(rotation, (2, 10, 10, 10))[:, 1:] - 0.5) * np.float32(np.sqrt(2.0))
    log_scales = interpolate(_fractions(scale, (11, 10, 11)), ("scale_x", "scale_y", "scale_z"))
    return {
        "means": interpolate(_fractions(position, (11, 10, 11)), MEANS),
        "quaternions": quaternions_from_smallest_three(small, rotation >> 30),
        "scales": np.exp(log_scales),
        "opacities": rgba[:, 3],
        "sh": _join_sh((rgb - 0.5) / np.float32(SH_C0), rest),
    }


def _fractions(words: NDArray[np.uint32], widths: tuple[int, ...]) -> Array32:
    """(N, len(widths)) bit fields from the top bit down, as fractions of their greatest values."""
    fields = []
    for width, shift in zip(widths, 32 - np.cumsum(widths), strict=True):
        greatest = (1 << width) - 1
        fields.append((words >> int(shift) & greatest) / np.float32(greatest))
    return np.stack(fields, axis=-1, dtype=np.float32)


def _unpack_sh(rows: Rows, count: int, name: str) -> Array32:
    """(N, 3 (K - 1)) coefficients -4..4 from bytes: the middle of 256 steps, the ends exactly."""
    columns = _rest_names(rows, name)
    if len(rows) != count or any(rows.dtype[column] != np.uint8 for column in columns):
        raise InputError(
            f"{name}: expected a row of bytes in sh for each of {count} Gaussians, got others;"
            " save it again"
        )
    steps = _columns(rows, columns, name)
    share = np.select([steps == 0.0, steps == 255.0], [0.0, 1.0], (steps + 0.5) / 256.0)
    return (share * 8.0 - 4.0).astype(np.float32)


def _rest_names(rows: Rows, name: str) -> tuple[str, ...]:
    """The names f_rest_0, f_rest_1 ... that the rows have, all of a degree."""
    found = {column for column in rows.dtype.names or () if column.startswith("f_rest_")}
    names = tuple(f"f_rest_{k}" for k in range(len(found)))
    counts = [3 * (count - 1) for count in SH_COUNTS]
    if len(found) not in counts or set(names) != found:
        got = len(found) if set(names) == found else min(found - set(names))[:40]
        raise InputError(
            f"{name}: expected 0, 9, 24 or 45 properties from f_rest_0 on"
            f" (colour of degree 0 to 3), got {got}"
        )
    return names


def _columns(rows: Rows, names: tuple[str, ...], name: str) -> Array32:
    """(N, len(names)) of the named properties as float32."""
    missing = [column for column in names if column not in (rows.dtype.names or ())]
    if missing:
        raise InputError(
            f"{name}: expected 3D Gaussians, but the property {missing[0]} is missing;"
            " a point cloud or a mesh is no splat"
        )
    if not names:
        return np.zeros((len(rows), 0), np.float32)
    return np.stack([rows[column] for column in names], axis=-1, dtype=np.float32, casting="unsafe")


def _join_sh(dc: Array32, rest: Array32) -> Array32:
    """(N, K, 3) from the constant part (N, 3) and the channel-major rest (N, 3 (K - 1))."""
    rest = rest.reshape(len(dc), 3, rest.shape[1] // 3).transpose(0, 2, 1)
    return np.concatenate([dc[:, None], rest], axis=1)
