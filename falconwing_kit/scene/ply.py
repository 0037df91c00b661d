"""PLY: a 3DGS .ply or a PlayCanvas compressed .ply -> arrays of Gaussians; and arrays -> a 3DGS
.ply.

The plain layout is that of Inria's and nerfstudio's exports: 32-bit floats, scales as logarithms,
opacity as logit, the quaternion w first, f_rest all red, then all green, then all blue. The
compressed one packs chunks of 256 Gaussians between their least and greatest values.
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply

The header is text that may promise anything; nothing is allocated before the file proves long
enough.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name

Array32 = NDArray[np.float32]

SH_COUNTS = (1, 4, 9, 16)  # coefficients of degree 0 to 3
SH_C0 = 0.28209479177387814  # the constant harmonic, 1 / (2 sqrt(pi)); rgb = 1/2 + SH_C0 f_dc
MAX_HEADER_BYTES = 65536
MAX_LOGIT = 20.0  # opacity within 2e-9 of 0 or 1: their own logits are infinite
CHUNK = 256

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
_MEANS, _DC = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES, _QUATERNION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def read_ply(path: str | Path) -> dict[str, Any]:
    """Read the Gaussians of a .ply, plain or compressed.

    Args:
        path: a binary little-endian file.

    Returns:
        means (N, 3), quaternions (N, 4), scales (N, 3), opacities (N,), sh (N, K, 3) as
        `GaussianScene` has them, not yet checked; and source, where a comment of the file tells it.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is damaged, is no binary little-endian PLY, or holds no Gaussians.
    """
    path = require_file(path)
    name, data = short_name(path), path.read_bytes()
    promised, start, source = _read_header(data, name)
    elements = _map_elements(data, promised, start, name)
    if "vertex" not in elements:
        raise InputError(
            f"{name}: expected an element called vertex, found {', '.join(elements) or 'none'}"
        )
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused with the scene
        fields = (
            _unpack_chunks(elements, name)
            if "chunk" in elements
            else _unpack_floats(elements["vertex"], name)
        )
    return fields | ({"source": source} if source else {})


def write_ply(
    path: str | Path,
    means: Array32,
    quaternions: Array32,
    scales: Array32,
    opacities: Array32,
    sh: Array32,
    source: str = "",
) -> None:
    """Write Gaussians as a 3DGS .ply that other tools read; the source goes into its comments.

    Args:
        path: the file to write; it appears only once it is complete.
        means: (N, 3) [m].
        quaternions: (N, 4) w x y z.
        scales: (N, 3) [m], > 0.
        opacities: (N,) 0..1; exactly 0 and 1 move by 2e-9, for their logits are infinite.
        sh: (N, K, 3).
        source: where the scene came from; letters outside ASCII are escaped.

    Raises:
        InputError: the place cannot be written.
        FileNotFoundError: the folder does not exist.
    """
    count, rest = len(means), 3 * (sh.shape[1] - 1)
    with np.errstate(divide="ignore"):
        logit = np.clip(
            np.log(opacities.astype(np.float64)) - np.log1p(-opacities.astype(np.float64)),
            -MAX_LOGIT,
            MAX_LOGIT,
        )
    names = (
        *_MEANS,
        "nx",
        "ny",
        "nz",
        *_DC,
        *(f"f_rest_{k}" for k in range(rest)),
        "opacity",
        *_SCALES,
        *_QUATERNION,
    )
    channel_major = sh[:, 1:].transpose(0, 2, 1).reshape(count, rest)
    columns = (
        means,
        np.zeros((count, 3)),
        sh[:, 0],
        channel_major,
        logit[:, None],
        np.log(scales),
        quaternions,
    )
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment source {line}" for line in source.splitlines()),
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
    """Put back the component that compressed formats leave out: the largest, made positive by
    turning the sign.

    largest = sqrt(1 - a^2 - b^2 - c^2), as a unit quaternion has it

    Args:
        small: (N, 3) the other components, in their order.
        largest: (N,) place of the one left out, 0..3.

    Returns:
        (N, 4) in the order of the places.
    """
    places = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    quaternions = np.empty((len(small), 4), np.float32)
    np.put_along_axis(quaternions, places, small.astype(np.float32), axis=1)
    left_out = np.sqrt(np.maximum(0.0, 1.0 - (small**2).sum(axis=1, keepdims=True))).astype(
        np.float32
    )
    np.put_along_axis(quaternions, np.asarray(largest, np.int64)[:, None], left_out, axis=1)
    return quaternions


def _read_header(data: bytes, name: str) -> tuple[dict[str, tuple[int, dict[str, str]]], int, str]:
    """Elements with their row counts and property types, where the rows start, and the source from
    the comments.
    """
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    start = data.find(b"\n", max(end, 0), MAX_HEADER_BYTES + 16) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        what = "a PLY header without its end" if data.startswith(b"ply") else "another kind of file"
        raise InputError(
            f"{name}: expected a .ply with 3D Gaussians, got {what if data else 'an empty file'}; check the path"
        )
    elements: dict[str, tuple[int, dict[str, str]]] = {}
    source: list[str] = []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["comment", "source", *_]:
                source.append(line.strip().removeprefix("comment source").strip())
            case ["format", "binary_little_endian", "1.0"] | ["comment" | "obj_info", *_] | []:
                pass
            case ["format", kind, *_]:
                raise InputError(
                    f"{name}: expected a binary_little_endian .ply, got {kind[:40]}; save it again as binary"
                )
            case ["element", label, count] if (
                count.isdecimal() and len(count) < 16 and label not in elements
            ):
                elements[label] = (int(count), {})
            case ["property", kind, label] if kind in _TYPES and elements:
                columns = elements[next(reversed(elements))][1]
                if label in columns:
                    raise InputError(
                        f"{name}: expected every property once, got {label[:40]!r} twice"
                    )
                columns[label] = _TYPES[kind]
            case _:
                raise InputError(
                    f"{name}: expected elements of plain numbers in the header, got the line {line[:80]!r}"
                )
    return elements, start, "\n".join(source)


def _map_elements(
    data: bytes, promised: dict[str, tuple[int, dict[str, str]]], start: int, name: str
) -> dict[str, NDArray[np.void]]:
    """The rows of each element where they lie in the file; nothing is copied."""
    elements = {}
    for label, (count, columns) in promised.items():
        row = np.dtype(list(columns.items()))
        size, left = count * row.itemsize, len(data) - start
        if size > left or not columns:
            raise InputError(
                f"{name}: expected {count} rows of {row.itemsize} bytes for {label[:40]}, got {left} bytes; it was cut"
            )
        elements[label] = np.ndarray((count,), row, buffer=data, offset=start)
        start += size
    return elements


def _unpack_floats(vertices: NDArray[np.void], name: str) -> dict[str, Any]:
    """Gaussians of a plain 3DGS .ply."""
    logit = _columns(vertices, ("opacity",), name)[:, 0]
    return {
        "means": _columns(vertices, _MEANS, name),
        "quaternions": _columns(vertices, _QUATERNION, name),
        "scales": np.exp(_columns(vertices, _SCALES, name)),
        "opacities": 1.0 / (1.0 + np.exp(-logit)),
        "sh": _join_sh(
            _columns(vertices, _DC, name), _columns(vertices, _rest_names(vertices, name), name)
        ),
    }


def _unpack_chunks(elements: dict[str, NDArray[np.void]], name: str) -> dict[str, Any]:
    """Gaussians of a compressed .ply: fractions between the least and greatest value in their
    chunk.
    """
    vertices, chunks = elements["vertex"], elements["chunk"]
    kinds = {column: kind for column, kind, *_ in vertices.dtype.descr}
    if any(kinds.get(column) != "<u4" for column in _PACKED) or len(chunks) != -(
        -len(vertices) // CHUNK
    ):
        raise InputError(
            f"{name}: expected {', '.join(_PACKED)} and a chunk for each {CHUNK} Gaussians; save it again"
        )
    position, rotation, scale, color = (vertices[column] for column in _PACKED)
    chunk = np.arange(len(vertices)) // CHUNK

    def between(fractions: Array32, names: tuple[str, str, str]) -> Array32:
        low = _columns(chunks, tuple(f"min_{axis}" for axis in names), name)[chunk]
        high = _columns(chunks, tuple(f"max_{axis}" for axis in names), name)[chunk]
        return low * (1.0 - fractions) + high * fractions

    rgba = _fractions(color, (8, 8, 8, 8))
    has_range = "min_r" in (
        chunks.dtype.names or ()
    )  # older files have none, and colours from 0 to 1
    rgb = between(rgba[:, :3], ("r", "g", "b")) if has_range else rgba[:, :3]
    rest = np.zeros((len(vertices), 0), np.float32)
    if "sh" in elements:
        rest = _unpack_sh(elements["sh"], len(vertices), name)
    return {
        "means": between(_fractions(position, (11, 10, 11)), _MEANS),
        "quaternions": quaternions_from_smallest_three(
            (_fractions(rotation, (2, 10, 10, 10))[:, 1:] - 0.5) * np.float32(np.sqrt(2.0)),
            rotation >> 30,
        ),
        "scales": np.exp(
            between(_fractions(scale, (11, 10, 11)), ("scale_x", "scale_y", "scale_z"))
        ),
        "opacities": rgba[:, 3],
        "sh": _join_sh((rgb - 0.5) / np.float32(SH_C0), rest),
    }


def _fractions(words: NDArray[np.uint32], widths: tuple[int, ...]) -> Array32:
    """(N, len(widths)) bit fields of 32-bit words from the top bit down, as fractions of their
    greatest values.
    """
    shifts = 32 - np.cumsum(widths)
    greatest = [(1 << width) - 1 for width in widths]
    fields = [
        (words >> int(shift) & top) / np.float32(top)
        for shift, top in zip(shifts, greatest, strict=True)
    ]
    return np.stack(fields, axis=-1, dtype=np.float32)


def _unpack_sh(rows: NDArray[np.void], count: int, name: str) -> Array32:
    """(N, 3 (K - 1)) coefficients -4..4 from bytes: the middle of their 256 steps, and the ends
    exactly.
    """
    columns = _rest_names(rows, name)
    if len(rows) != count or any(rows.dtype[column] != np.uint8 for column in columns):
        raise InputError(
            f"{name}: expected a row of bytes in sh for each of {count} Gaussians, got others; save it again"
        )
    steps = _columns(rows, columns, name)
    middle = (steps + 0.5) / 256.0
    return (np.where(steps == 0.0, 0.0, np.where(steps == 255.0, 1.0, middle)) * 8.0 - 4.0).astype(
        np.float32
    )


def _rest_names(rows: NDArray[np.void], name: str) -> tuple[str, ...]:
    """f_rest_0, f_rest_1 and so on, as many as the rows have."""
    found = {column for column in rows.dtype.names or () if column.startswith("f_rest_")}
    names = tuple(f"f_rest_{k}" for k in range(len(found)))
    if len(found) not in (0, 9, 24, 45) or set(names) != found:
        got = f"got {len(found)}" if set(names) == found else f"got {min(found - set(names))[:40]}"
        raise InputError(
            f"{name}: expected 0, 9, 24 or 45 properties from f_rest_0 on (colour of degree 0 to 3), {got}"
        )
    return names


def _columns(rows: NDArray[np.void], names: tuple[str, ...], name: str) -> Array32:
    """(N, len(names)) of the named properties as float32."""
    missing = [column for column in names if column not in (rows.dtype.names or ())]
    if missing:
        raise InputError(
            f"{name}: expected 3D Gaussians, but the property {missing[0]} is missing; a point cloud or a mesh is no splat"
        )
    if not names:
        return np.zeros((len(rows), 0), np.float32)
    return np.stack([rows[column] for column in names], axis=-1, dtype=np.float32, casting="unsafe")


def _join_sh(dc: Array32, rest: Array32) -> Array32:
    """(N, K, 3) from the constant part (N, 3) and the channel-major rest (N, 3 (K - 1))."""
    return np.concatenate(
        [dc[:, None], rest.reshape(len(dc), 3, rest.shape[1] // 3).transpose(0, 2, 1)], axis=1
    )
