"""Packed scenes: a GaussianScene -> a .splat, SPZ or SOG file, and what the format cannot hold.

.splat  32 bytes a Gaussian, no header                        https://github.com/antimatter15/splat
SPZ     version 3, a gzip stream of fixed-point arrays        https://github.com/nianticlabs/spz
SOG     version 2: meta.json and lossless WebP images in a zip
        https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog

All three round the numbers and keep the order of the Gaussians; none holds labels, named points or
the source. `packed` reads them.
"""

import gzip
import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.files import atomic_write, require_writable_path, short_name
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.native import SMALLER_THREE
from falconwing_kit.scene.ply import SH_C0, SH_COUNTS, Array32
from falconwing_kit.tools.capture.packed import (
    SPLAT_ROW,
    SPZ_DC,
    SPZ_HEADER,
    SPZ_TURN,
    SPZ_TURN_SH,
    Bytes,
)

SPZ_FRACTION_BITS = (
    12  # steps of 0.24 mm, up to 2 km from the origin; fewer where a scene is larger
)
SPZ_LIMIT = 2**23  # of a signed number of 24 bits
BOOK = 256  # entries of a code book of SOG
BOOK_ROUNDS = 8  # of Lloyd's algorithm
PALETTE, PALETTE_ROW = 1 << 14, 64  # entries of SOG's palette of harmonics; entries in each row
FIXED_TIME = (1980, 1, 1, 0, 0, 0)  # of the zip's members: the same scene gives the same bytes


def write_packed(path: str | Path, scene: GaussianScene) -> list[str]:
    """Write a scene as .splat, .spz or .sog, completely or not at all.

    Args:
        path: its ending selects the format.

    Returns:
        One sentence for each thing that the file does not hold or holds changed, beyond rounding.

    Raises:
        InputError: another ending, a scene that the format cannot hold, or no right to write.
        FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    pack = WRITERS.get(path.suffix.lower())
    if pack is None:
        raise InputError(
            f"{short_name(path)}: expected a name ending in {', '.join(WRITERS)}, got another"
            " ending; GaussianScene.save writes .npz and .ply"
        )
    require_writable_path(path)
    data, changes = pack(scene)
    with atomic_write(path) as file:
        file.write(data)
    return [*_lost_words(scene), *changes]


def _lost_words(scene: GaussianScene) -> list[str]:
    """What none of the formats holds, where the scene has it."""
    lost = []
    if len(scene.label_names) > 1:
        lost.append(f"labels are not kept: {', '.join(scene.label_names)} become one scene")
    if scene.points:
        lost.append(f"named points are not kept: {', '.join(scene.points)}")
    if scene.source:
        lost.append(f"the source is not kept; give it beside the file: {scene.source}")
    return lost


def splat_bytes(scene: GaussianScene) -> tuple[bytes, list[str]]:
    """A .splat: position, scale, colour with opacity, and rotation bytes 128 + 128 q, w first.

    Returns:
        The file, and sentences on colours that were cut and harmonics that were dropped.
    """
    rgb = SH_C0 * scene.sh[:, 0] + 0.5
    rows = np.empty(len(scene), SPLAT_ROW)
    rows["means"], rows["scales"] = scene.means, scene.scales
    rows["rgba"] = _to_bytes(255.0 * np.column_stack([rgb, scene.opacities]))
    rows["rotation"] = _to_bytes(128.0 + 128.0 * scene.quaternions)
    changes = _cut("colours", (rgb < 0.0) | (rgb > 1.0), "0..1")
    if scene.sh.shape[1] > 1:
        degree = math.isqrt(scene.sh.shape[1]) - 1
        changes.append(
            f"colours no longer change with the direction (SH degree 0 instead of {degree});"
            " .spz and .sog keep that"
        )
    return rows.tobytes(), changes


def spz_bytes(scene: GaussianScene) -> tuple[bytes, list[str]]:
    """An SPZ of version 3: `spz_payload` as a gzip file.

    Raises:
        InputError: a Gaussian lies more than 8000 km from the origin.
    """
    payload, changes = spz_payload(scene)
    return gzip.compress(payload, 9, mtime=0), changes


def spz_payload(
    scene: GaussianScene, fraction_bits: int = SPZ_FRACTION_BITS, sh_bits: int = 8
) -> tuple[bytes, list[str]]:
    """The inside of an SPZ of version 3, before gzip; its axes are x right, y up, z back.

    position  24-bit fixed point, three numbers            opacity   255 o
    colour    255 (0.15 dc + 1/2), dc the coefficient      scale     16 (ln s + 10)
    rotation  index of the largest component, then sign and 9 bits of the three others
    harmonic  128 + 128 c

    Args:
        fraction_bits: of the positions, 0 to 24; less are used where the scene is too large.
        sh_bits: of each harmonic, 1 to 8; rounder numbers pack smaller.

    Returns:
        The bytes, and sentences on values that were cut.

    Raises:
        InputError: a number is out of its range, or a Gaussian too far from the origin.
    """
    require_range("sh_bits", sh_bits, low=1, high=8)
    require_range("fraction_bits", fraction_bits, low=0, high=24)
    far, largest = float(np.abs(scene.means).max()), SPZ_LIMIT - 1
    if far > largest:
        raise InputError(
            f"scene: expected Gaussians within {largest} m of the origin for an SPZ, got one at"
            f" {far:.3g} m; write .splat"
        )
    if far > 0.0:
        fraction_bits = min(fraction_bits, math.floor(math.log2(largest / far)))
    fixed = np.rint(scene.means.astype(np.float64) * SPZ_TURN * 2.0**fraction_bits)
    positions = fixed.astype("<i4")[..., None].view(np.uint8)[..., :3]
    quaternions = scene.quaternions * np.append(np.float32(1.0), SPZ_TURN)
    sh = scene.sh * SPZ_TURN_SH[: scene.sh.shape[1], None]
    colours = 255.0 * (SPZ_DC * sh[:, 0] + 0.5)
    scales = 16.0 * (np.log(scene.scales) + 10.0)
    step = 2 ** (8 - sh_bits)
    harmonics = np.rint(sh[:, 1:] * (128.0 / step)) * step + 128.0
    changes = [
        *_cut("colours", (colours < -0.5) | (colours > 255.5), "-0.44..1.44"),
        *_cut("standard deviations", (scales < -0.5) | (scales > 255.5), "45 um..377 m"),
        *_cut("harmonics", (harmonics < -0.5) | (harmonics >= 256.5), "-1..1"),
    ]
    count, degree = len(scene), math.isqrt(sh.shape[1]) - 1
    parts: tuple[NDArray[Any], ...] = (
        positions,
        _to_bytes(255.0 * scene.opacities),
        _to_bytes(colours),
        _to_bytes(scales),
        _spz_rotations(quaternions),
        _to_bytes(harmonics),
    )
    header = SPZ_HEADER.pack(b"NGSP", 3, count, degree, fraction_bits, 0)
    return header + b"".join(part.tobytes() for part in parts), changes


def _spz_rotations(quaternions: Array32) -> NDArray[np.uint32]:
    """(N,) words of 2 bits for the largest of x y z w, then sign and 9 bits of the others."""
    largest, small = _smallest_three(np.roll(quaternions, -1, axis=1))
    size = np.rint(np.abs(small) / np.sqrt(0.5) * 0x1FF).clip(0, 0x1FF).astype(np.uint32)
    a, b, c = (size | np.where(small < 0.0, 0x200, 0).astype(np.uint32)).T
    return np.asarray(largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c, "<u4")


def sog_bytes(scene: GaussianScene) -> tuple[bytes, list[str]]:
    """A SOG of version 2 in one zip: one pixel a Gaussian in each of its images.

    means   16-bit fractions of sign(x) ln(1 + |x|), low and high byte in two images
    scales, sh0  indices into code books of 256 logarithms and coefficients
    quats   the smallest three as bytes, 252 + index of the largest of w x y z
    shN     index of a palette of at most 16,384 sets of harmonics

    Raises:
        InputError: OpenCV, which encodes the images, is not installed.
    """
    count = len(scene)
    width = 4 * math.ceil(math.sqrt(count) / 4.0)
    height = math.ceil(count / width)

    def image(*columns: NDArray[Any]) -> bytes:
        """The columns as red, green, blue and, where there are four, alpha of an image."""
        pixels = np.full((height * width, 4), 255, np.uint8)
        table = np.column_stack(columns)
        pixels[:count, : table.shape[1]] = table
        return _webp(pixels.reshape(height, width, 4))

    logs = np.sign(scene.means) * np.log1p(np.abs(scene.means.astype(np.float64)))
    mins, maxs = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint((logs - mins) / np.maximum(maxs - mins, 1e-12) * 65535.0).astype(np.int64)
    scale_book, scale_codes = _code_book(np.log(scene.scales))
    colour_book, colour_codes = _code_book(scene.sh[:, 0])
    largest, small = _smallest_three(scene.quaternions)
    quats = np.rint((small / np.sqrt(0.5) * 0.5 + 0.5) * 255.0)
    meta: dict[str, Any] = {
        "version": 2,
        "count": count,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist()},
        "scales": {"codebook": scale_book.tolist()},
        "quats": {},
        "sh0": {"codebook": colour_book.tolist()},
    }
    images = {
        "means": {"means_l.webp": image(steps & 255), "means_u.webp": image(steps >> 8)},
        "scales": {"scales.webp": image(scale_codes)},
        "quats": {"quats.webp": image(quats, 252 + largest)},
        "sh0": {"sh0.webp": image(colour_codes, _to_bytes(255.0 * scene.opacities))},
    }
    changes = []
    if scene.sh.shape[1] > 1:
        rest = scene.sh[:, 1:].reshape(count, -1)
        palette, labels = _palette(rest)
        rest_book, codes = _code_book(palette)
        per_row = scene.sh.shape[1] - 1
        # The palette's image: 64 entries in a row, each of one pixel a coefficient
        rows = math.ceil(len(palette) / PALETTE_ROW)
        pixels = np.full((rows * PALETTE_ROW, per_row, 4), 255, np.uint8)
        pixels[..., :3] = 0
        pixels[: len(palette), :, :3] = codes.reshape(len(palette), per_row, 3)
        meta["shN"] = {
            "count": len(palette),
            "bands": SH_COUNTS.index(scene.sh.shape[1]),
            "codebook": rest_book.tolist(),
        }
        images["shN"] = {
            "shN_centroids.webp": _webp(pixels.reshape(rows, PALETTE_ROW * per_row, 4)),
            "shN_labels.webp": image(labels & 255, labels >> 8, np.zeros(count)),
        }
        if len(palette) < len(np.unique(rest, axis=0)):
            changes.append(
                f"harmonics of degree 1 and more become the nearest of {len(palette)} sets"
            )
    for name, files in images.items():
        meta[name]["files"] = list(files)
    members = {"meta.json": json.dumps(meta).encode()}
    return _zip(members | {k: v for files in images.values() for k, v in files.items()}), changes


def _webp(rgba: Bytes) -> bytes:
    """(height, width, 4) as a lossless WebP; where alpha is 0 the encoder may change the colour."""
    try:
        import cv2
    except ImportError:
        raise InputError(
            "scene: expected OpenCV to encode SOG's images; run:"
            " pip install opencv-python-headless, or write .spz"
        ) from None
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101]  # above 100 is lossless
    done, data = cv2.imencode(".webp", np.ascontiguousarray(rgba[..., [2, 1, 0, 3]]), quality)
    if not done:
        raise InputError("scene: expected OpenCV with WebP for SOG's images; write .spz instead")
    return bytes(data.tobytes())


def _zip(members: dict[str, bytes]) -> bytes:
    """A zip with stored members; the images are compressed already."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name, FIXED_TIME), data)
    return stream.getvalue()


def _code_book(values: NDArray[Any]) -> tuple[Array32, Bytes]:
    """At most 256 numbers for many, and each number's index (its shape).

    Lloyd's algorithm on a line: from even steps of the values' quantiles and range, each entry
    moves to the mean of the numbers nearest to it.
    """
    flat = values.astype(np.float64).ravel()
    book = np.unique(flat.astype(np.float32)).astype(np.float64)
    if len(book) > BOOK:
        half = np.linspace(0.0, 1.0, BOOK // 2)
        book = np.sort(np.concatenate([np.quantile(flat, half), flat.min() + np.ptp(flat) * half]))
        for _ in range(BOOK_ROUNDS):
            nearest = np.searchsorted(0.5 * (book[1:] + book[:-1]), flat)
            sums = np.bincount(nearest, flat, BOOK), np.bincount(nearest, minlength=BOOK)
            book = np.sort(np.where(sums[1] > 0, sums[0] / np.maximum(sums[1], 1), book))
    codes = np.searchsorted(0.5 * (book[1:] + book[:-1]), flat)
    return book.astype(np.float32), codes.astype(np.uint8).reshape(values.shape)


def _palette(rest: Array32) -> tuple[Array32, NDArray[np.int64]]:
    """Sets of harmonics (P, 3 (K - 1)), and the index of each Gaussian's nearest one.

    Where there are more than PALETTE different ones, evenly spaced Gaussians give the first
    sets, and one round of Lloyd's algorithm moves each to the mean of those nearest to it.
    """
    from scipy.spatial import cKDTree

    sets, labels = np.unique(rest, axis=0, return_inverse=True)
    if len(sets) <= PALETTE:
        return sets, labels.ravel().astype(np.int64)
    sets = sets[np.linspace(0, len(sets) - 1, PALETTE).astype(np.int64)].astype(np.float64)
    labels = cKDTree(sets).query(rest)[1]
    counts = np.bincount(labels, minlength=PALETTE)
    for column, values in enumerate(rest.T):
        means = np.bincount(labels, values, PALETTE) / np.maximum(counts, 1)
        sets[:, column] = np.where(counts > 0, means, sets[:, column])
    return sets.astype(np.float32), cKDTree(sets).query(rest)[1].astype(np.int64)


def _smallest_three(quaternions: Array32) -> tuple[NDArray[np.int64], Array32]:
    """(N,) index of the largest component; (N, 3) the others, with the sign that makes it > 0."""
    largest = np.abs(quaternions).argmax(axis=1)
    sign = np.sign(np.take_along_axis(quaternions, largest[:, None], axis=1))
    return largest, np.take_along_axis(quaternions * sign, SMALLER_THREE[largest], axis=1)


def _to_bytes(values: NDArray[Any]) -> Bytes:
    """The nearest of 0 to 255."""
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _cut(what: str, outside: NDArray[np.bool_], allowed: str) -> list[str]:
    """A sentence on Gaussians with a value outside the range of the format, if there are any."""
    count = int(outside.reshape(len(outside), -1).any(axis=1).sum())
    return [f"{what} of {count} Gaussians are cut to {allowed}"] if count else []


WRITERS: dict[str, Callable[[GaussianScene], tuple[bytes, list[str]]]] = {
    ".splat": splat_bytes,
    ".spz": spz_bytes,
    ".sog": sog_bytes,
}
