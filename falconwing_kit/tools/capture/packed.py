"""Packed scenes: .splat, SPZ and SOG files -> arrays of Gaussians.

.splat  32 bytes a Gaussian, no header                        https://github.com/antimatter15/splat
SPZ     a gzip stream of fixed-point arrays, version 1 to 3   https://github.com/nianticlabs/spz
SOG     version 2: meta.json and lossless WebP images, in a folder or a zip
        https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog

All three are lossy. Declared sizes are checked before a file is decompressed.
"""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import short_name
from falconwing_kit.scene.native import FREE_BYTES, MAX_COMPRESSION, zip_members
from falconwing_kit.scene.ply import SH_C0, SH_COUNTS, Array32, quaternions_from_smallest_three

Bytes = NDArray[np.uint8]

SPLAT_ROW = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)

SPZ_HEADER = struct.Struct("<4sIIBBBx")
SPZ_DC = 0.15  # scale of the base colours, which span -2.8 to 3.8
_SPZ_EXTENSIONS = 0x2
# SPZ has x right, y up, z back; a .ply of the same scene has y down, z forward: half a turn about x
SPZ_TURN = np.array([1, -1, -1], np.float32)
SPZ_TURN_SH = np.array(
    [1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32
)  # sign of each harmonic

_SOG_META_BYTES = 1024 * 1024
_WEBP_HEADER = struct.Struct("<4sI4s4sIBI")


def read_splat(path: str | Path) -> dict[str, Any]:
    """Read a .splat: position, scale, colour with opacity, and rotation of each Gaussian.

    Returns:
        Fields of `GaussianScene` with SH degree 0, not yet checked.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the size is not a multiple of 32 bytes.
    """
    path = require_file(path)
    data = path.read_bytes()
    if len(data) % SPLAT_ROW.itemsize:
        raise InputError(
            f"{short_name(path)}: expected 32 bytes for each Gaussian, got {len(data)} bytes; "
            "the file was cut"
        )
    rows = np.frombuffer(data, SPLAT_ROW)
    rgba = rows["rgba"] / np.float32(255.0)
    return {
        "means": rows["means"],
        "quaternions": (rows["rotation"].astype(np.float32) - 128.0) / 128.0,
        "scales": rows["scales"],
        "opacities": rgba[:, 3],
        "sh": ((rgba[:, :3] - 0.5) / np.float32(SH_C0))[:, None],
    }


def read_spz(path: str | Path) -> dict[str, Any]:
    """Read an SPZ of version 1, 2 or 3, in the axes of a .ply of the same scene.

    Its flag of antialiased training is ignored; render such a scene with the antialiased option.

    Returns:
        Fields of `GaussianScene`, not yet checked.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is damaged, of another version, or declares an impossible size.
    """
    path = require_file(path)
    name, data = short_name(path), path.read_bytes()
    if data[:4] == b"NGSP":
        raise InputError(
            f"{name}: expected SPZ version 1 to 3, got version 4 or later; "
            "save it as version 3 or as .ply"
        )
    unpacker = zlib.decompressobj(wbits=31)  # gzip
    try:
        header = unpacker.decompress(data, SPZ_HEADER.size)
        version, count, degree, fraction_bits = _spz_header(header, name)
        position_bytes, rotation_bytes = (6 if version == 1 else 9), (4 if version == 3 else 3)
        widths = (position_bytes, 1, 3, 3, rotation_bytes, 3 * (SH_COUNTS[degree] - 1))
        size = count * sum(widths)
        if size > MAX_COMPRESSION * len(data) + FREE_BYTES:
            raise InputError(
                f"{name}: expected a declared size of at most {MAX_COMPRESSION} times its own, "
                f"got one of {count} Gaussians"
            )
        body = unpacker.decompress(unpacker.unconsumed_tail, size)
        more = unpacker.decompress(unpacker.unconsumed_tail, 1)
    except zlib.error:
        raise InputError(
            f"{name}: expected an SPZ (a gzip file), got other or damaged bytes; copy it again"
        ) from None
    if len(body) != size or more or not unpacker.eof:
        raise InputError(
            f"{name}: expected {size} bytes for {count} Gaussians, got fewer or more; "
            "the file is damaged"
        )
    parts = np.split(np.frombuffer(body, np.uint8), np.cumsum(widths)[:-1] * count)
    return _spz_fields(version, fraction_bits, [part.reshape(count, -1) for part in parts])


def _spz_header(header: bytes, name: str) -> tuple[int, int, int, int]:
    """Version, number of Gaussians, SH degree and fractional bits."""
    if len(header) < SPZ_HEADER.size or header[:4] != b"NGSP":
        raise InputError(f"{name}: expected an SPZ, got another gzip file; check the path")
    _, version, count, degree, fraction_bits, flags = SPZ_HEADER.unpack(header)
    if version not in (1, 2, 3):
        raise InputError(
            f"{name}: expected SPZ version 1 to 3, got {version}; save it as version 3 or as .ply"
        )
    if count == 0 or degree >= len(SH_COUNTS) or fraction_bits > 24:
        got = f"{count} of degree {degree} with {fraction_bits} bits"
        raise InputError(
            f"{name}: expected Gaussians of SH degree 0 to 3 with at most 24 fractional bits, "
            f"got {got}"
        )
    if flags & _SPZ_EXTENSIONS:
        raise InputError(
            f"{name}: expected an SPZ without vendor extensions, which may turn its axes; "
            "save it as .ply"
        )
    return version, count, degree, fraction_bits


def _spz_fields(version: int, fraction_bits: int, parts: list[Bytes]) -> dict[str, Any]:
    """Gaussians from positions, opacities, colours, scales, rotations and harmonics of an SPZ."""
    positions, opacities, colors, scales, rotations, harmonics = parts
    count = len(positions)
    if version == 1:
        means = positions.view("<f2").astype(np.float32)
    else:  # signed 24-bit numbers, the lowest byte first
        low, middle, high = np.moveaxis(positions.reshape(count, 3, 3).astype(np.int32), 2, 0)
        means = (((high ^ 0x80) - 0x80) * 65536 + middle * 256 + low).astype(
            np.float32
        ) / np.float32(2**fraction_bits)
    dc = (colors / np.float32(255.0) - 0.5) / np.float32(SPZ_DC)
    rest = (harmonics.reshape(count, -1, 3).astype(np.float32) - 128.0) / 128.0
    sh = np.concatenate([dc[:, None], rest], axis=1)
    quaternions = _spz_smallest_three(rotations) if version == 3 else _spz_first_three(rotations)
    quaternions[:, 1:] *= SPZ_TURN
    return {
        "means": means * SPZ_TURN,
        "quaternions": quaternions,
        "scales": np.exp(scales / np.float32(16.0) - 10.0),
        "opacities": opacities[:, 0] / np.float32(255.0),
        "sh": sh * SPZ_TURN_SH[: sh.shape[1], None],
    }


def _spz_first_three(rotations: Bytes) -> Array32:
    """(N, 4) w x y z from x, y, z in one byte each; w is positive."""
    xyz = rotations / np.float32(127.5) - 1.0
    return quaternions_from_smallest_three(xyz, np.zeros(len(xyz), np.int64))


def _spz_smallest_three(rotations: Bytes) -> Array32:
    """(N, 4) w x y z from 32-bit words: index of the largest, sign and 9 bits of the others."""
    words = rotations.view("<u4")[:, 0]
    fields = np.stack([words >> 20, words >> 10, words], axis=1) & 0x3FF
    size = (fields & 0x1FF) * np.float32(np.sqrt(0.5) / 0x1FF)
    xyzw = quaternions_from_smallest_three(np.where(fields & 0x200, -size, size), words >> 30)
    return np.roll(xyzw, 1, axis=1)


def read_sog(path: str | Path) -> dict[str, Any]:
    """Read a SOG of version 2.

    Args:
        path: the zip (.sog), the folder with meta.json, or that meta.json.

    Returns:
        Fields of `GaussianScene`, not yet checked.

    Raises:
        FileNotFoundError: there is no file, or one that meta.json names is missing.
        InputError: a file is damaged or of another version, or OpenCV, which decodes its images, is
            not installed.
    """
    path = Path(path)
    folder = path.parent if path.name == "meta.json" else path
    fetch = _fetch_from_folder(folder) if folder.is_dir() else _fetch_from_zip(require_file(path))
    name = short_name(path)
    meta = _sog_meta(fetch("meta.json"), name)
    count = meta["count"]
    means_files, mins_maxs = _section(meta, "means", 2, ("mins", "maxs"), name)
    scale_files, (scale_book,) = _section(meta, "scales", 1, ("codebook",), name)
    quat_files, _ = _section(meta, "quats", 1, (), name)
    color_files, (color_book,) = _section(meta, "sh0", 1, ("codebook",), name)
    has_rest = meta.get("shN") is not None
    rest_files, rest_books = _section(meta, "shN", 2, ("codebook",), name) if has_rest else ([], [])
    files = [*means_files, *scale_files, *quat_files, *color_files, *rest_files]
    images = _decode({file: fetch(file) for file in files}, name)

    low, high, scales, quats, color = (
        _texels(images[file], count, f"{name}: {file}") for file in files[:5]
    )
    sh = _look_up(color_book, color[:, :3], name)[:, None]
    if has_rest:
        labels = _texels(images[rest_files[1]], count, f"{name}: {rest_files[1]}")
        sh = np.concatenate(
            [sh, _sog_rest(meta["shN"], images[rest_files[0]], labels, rest_books[0], name)], axis=1
        )
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused with the scene
        return {
            "means": _sog_means(low, high, mins_maxs, name),
            "quaternions": _sog_quaternions(quats, name),
            "scales": np.exp(_look_up(scale_book, scales[:, :3], name)),
            "opacities": color[:, 3] / np.float32(255.0),
            "sh": sh,
        }


def _fetch_from_folder(folder: Path) -> Callable[[str], bytes]:
    return lambda name: require_file(folder / name).read_bytes()


def _fetch_from_zip(path: Path) -> Callable[[str], bytes]:
    members = zip_members(path, (".json", ".webp"))

    def fetch(name: str) -> bytes:
        if name not in members:
            raise InputError(
                f"{short_name(path)}: expected {name[:80]} in the zip, which is missing; "
                "pack the scene again"
            )
        return members[name]

    return fetch


def _sog_meta(data: bytes, name: str) -> dict[str, Any]:
    """The content of meta.json, with a positive integer count."""
    try:
        meta = json.loads(data) if len(data) <= _SOG_META_BYTES else None
    except (ValueError, RecursionError):
        meta = None
    if not isinstance(meta, dict) or meta.get("version") != 2:
        raise InputError(
            f"{name}: expected the meta.json of SOG version 2, got other text; "
            "convert the scene again"
        )
    count = meta.get("count")
    if type(count) is not int or not 0 < count < 2**31:
        raise InputError(
            f"{name}: expected a positive count of Gaussians in meta.json, got {str(count)[:40]}"
        )
    return meta


def _section(
    meta: dict[str, Any], key: str, files: int, numbers: tuple[str, ...], name: str
) -> tuple[list[str], list[Array32]]:
    """File names and lists of numbers of one part of meta.json."""
    part = meta.get(key)
    part = part if isinstance(part, dict) else {}
    listed = part.get("files")
    if (
        not isinstance(listed, list)
        or len(listed) != files
        or not all(_is_plain(file) for file in listed)
    ):
        raise InputError(
            f"{name}: expected {files} plain file names for {key} in meta.json, got others; "
            "convert it again"
        )
    arrays = []
    for number in numbers:
        values = part.get(number)
        if (
            not isinstance(values, list)
            or not 0 < len(values) <= 256
            or not all(_is_number(v) for v in values)
        ):
            raise InputError(
                f"{name}: expected 1 to 256 finite numbers for {key} {number} in meta.json, "
                "got others"
            )
        arrays.append(np.array(values, np.float32))
    return listed, arrays


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e30


def _is_plain(file: Any) -> bool:
    """Whether a file name has no path separators."""
    return isinstance(file, str) and 0 < len(file) < 256 and not set(file) & set("/\\:\0")


def _decode(files: dict[str, bytes], name: str) -> dict[str, Bytes]:
    """The images as (height, width, 4) RGBA, after a check of the sizes in their headers."""
    try:
        import cv2
    except ImportError:
        raise InputError(
            f"{name}: expected OpenCV to decode SOG's images; run: "
            "pip install opencv-python-headless"
        ) from None
    sizes = {file: _webp_size(data, f"{name}: {file}") for file, data in files.items()}
    pixels, packed = (
        sum(width * height for width, height in sizes.values()),
        sum(map(len, files.values())),
    )
    if 4 * pixels > MAX_COMPRESSION * packed + FREE_BYTES:
        raise InputError(
            f"{name}: expected images of at most {MAX_COMPRESSION} times their files, "
            f"got {pixels} pixels"
        )
    images = {}
    for file, data in files.items():
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
        if (
            image is None
            or image.dtype != np.uint8
            or image.shape[1::-1] != sizes[file]
            or image.shape[2:] not in ((3,), (4,))
        ):
            raise InputError(
                f"{name}: {file}: expected a whole WebP image, got a damaged one; "
                "copy or convert it again"
            )
        opaque = np.full_like(image[..., :1], 255)
        images[file] = np.concatenate(
            [image[..., 2::-1], image[..., 3:] if image.shape[2] == 4 else opaque], axis=2
        )
    return images


def _webp_size(data: bytes, what: str) -> tuple[int, int]:
    """Width and height of a lossless WebP  [WebP Lossless Bitstream Specification, section 3]."""
    if len(data) >= _WEBP_HEADER.size:
        riff, _, webp, kind, _, signature, bits = _WEBP_HEADER.unpack_from(data)
        if (riff, webp, kind, signature) == (b"RIFF", b"WEBP", b"VP8L", 0x2F):
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    raise InputError(
        f"{what}: expected a lossless WebP image, got other bytes; lossy images spoil every value"
    )


def _texels(image: Bytes, count: int, what: str) -> Bytes:
    """(count, 4) the first pixels in row order."""
    texels = image.reshape(-1, 4)
    if len(texels) < count:
        raise InputError(
            f"{what}: expected a pixel for each of {count} Gaussians, got {len(texels)}; "
            "convert it again"
        )
    return texels[:count]


def _look_up(book: Array32, codes: Bytes, name: str) -> Array32:
    """Code book entries for an array of codes, in its shape."""
    if codes.max() >= len(book):
        raise InputError(
            f"{name}: expected codes below {len(book)}, the length of the code book, "
            f"got {codes.max()}"
        )
    return book[codes]


def _sog_means(low: Bytes, high: Bytes, mins_maxs: list[Array32], name: str) -> Array32:
    """(N, 3) from 16-bit fractions between mins and maxs, stored as sign(x) ln(1 + |x|)."""
    mins, maxs = mins_maxs
    if len(mins) != 3 or len(maxs) != 3:
        raise InputError(
            f"{name}: expected three mins and three maxs for means in meta.json, "
            "got other numbers of them"
        )
    fractions = (low[:, :3] + 256.0 * high[:, :3]) / 65535.0
    logs = mins + (maxs - mins) * fractions
    return (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)


def _sog_quaternions(texels: Bytes, name: str) -> Array32:
    """(N, 4) w x y z from three bytes for the smallest three, and 252 + index of the largest."""
    if texels[:, 3].min() < 252:
        raise InputError(
            f"{name}: expected 252 to 255 in the alpha of the quaternions, got {texels[:, 3].min()}"
        )
    small = (texels[:, :3] / np.float32(255.0) * 2.0 - 1.0) * np.float32(np.sqrt(0.5))
    return quaternions_from_smallest_three(small, texels[:, 3] - 252)


def _sog_rest(
    part: dict[str, Any], palette: Bytes, labels: Bytes, book: Array32, name: str
) -> Array32:
    """(N, K - 1, 3) higher harmonics by palette index; the palette has 64 entries per row."""
    bands = part.get("bands")
    per_row = SH_COUNTS[bands] - 1 if type(bands) is int and 1 <= bands <= 3 else 0
    if per_row == 0 or palette.shape[1] != 64 * per_row:
        got = f"{str(bands)[:20]} bands, {palette.shape[1]} pixels"
        raise InputError(
            f"{name}: expected 1 to 3 bands of shN and a palette of 64 entries in each row, "
            f"got {got}"
        )
    rows = palette.reshape(-1, per_row, 4)[..., :3]
    numbers = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
    if numbers.max() >= len(rows):
        raise InputError(
            f"{name}: expected labels below {len(rows)}, the length of the palette, "
            f"got {numbers.max()}"
        )
    return _look_up(book, rows, name)[numbers]
