"""Scene files packed by hand, byte by byte from each format's specification; no line is shared with
the readers.
"""

import gzip
import io
import json
import struct
import zipfile

import numpy as np

ROW = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def ply_bytes(elements, body, format_line="format binary_little_endian 1.0", comments=()):
    """A PLY from (name, count, [(type, property), ...]) of its elements and the rows as bytes."""
    lines = ["ply", format_line, *comments]
    for name, count, properties in elements:
        lines += [
            f"element {name} {count}",
            *(f"property {kind} {label}" for kind, label in properties),
        ]
    return "\n".join([*lines, "end_header", ""]).encode() + body


def plain_ply(rows, rest=0, **how):
    """A 3DGS .ply from rows of floats in the order of ROW, with f_rest after the colour."""
    names = ROW[:9] + [f"f_rest_{k}" for k in range(rest)] + ROW[9:]
    body = b"".join(struct.pack(f"<{len(names)}f", *row) for row in rows)
    return ply_bytes([("vertex", len(rows), [("float", name) for name in names])], body, **how)


def compressed_ply(chunks, words, sh=None, colors=True):
    """A PlayCanvas .ply from rows of 18 (or 12) floats per chunk, four words per Gaussian, and rows
    of SH bytes.
    """
    axes = [
        f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"
    ]
    axes += [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"] if colors else []
    packed = [("uint", f"packed_{what}") for what in ("position", "rotation", "scale", "color")]
    elements = [
        ("chunk", len(chunks), [("float", axis) for axis in axes]),
        ("vertex", len(words), packed),
    ]
    body = b"".join(struct.pack(f"<{len(axes)}f", *row) for row in chunks)
    body += b"".join(struct.pack("<4I", *row) for row in words)
    if sh is not None:
        elements.append(("sh", len(sh), [("uchar", f"f_rest_{k}") for k in range(len(sh[0]))]))
        body += b"".join(bytes(row) for row in sh)
    return ply_bytes(elements, body)


def spz_payload(
    version,
    positions,
    opacities,
    colors,
    scales,
    rotations,
    sh=b"",
    *,
    count=1,
    degree=0,
    bits=12,
    flags=0,
):
    """The inside of an SPZ: its header of 16 bytes and its six arrays."""
    header = b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, flags, 0)
    return b"".join(map(bytes, (header, positions, opacities, colors, scales, rotations, sh)))


def gzipped(payload):
    """The payload as a gzip file, quickly."""
    return gzip.compress(payload, 1, mtime=0)


def fixed24(*numbers):
    """Signed numbers in three bytes each, the lowest first."""
    return b"".join(struct.pack("<i", number)[:3] for number in numbers)


def webp(pixels):
    """(height, width, 4) red, green, blue, alpha as a lossless WebP."""
    import cv2

    bgra = np.asarray(pixels, np.uint8)[..., [2, 1, 0, 3]]
    done, data = cv2.imencode(
        ".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, 101]
    )  # above 100 is lossless
    assert done
    return data.tobytes()


def sog_files(rng=None):
    """The files of a SOG: one known Gaussian with SH degree 1, then seven of noise if there is an
    `rng`.
    """

    def image(first, low=0):
        pixels = (
            np.full((2, 4, 4), 255, np.uint8)
            if rng is None
            else rng.integers(low, 256, (2, 4, 4), dtype=np.uint8)
        )
        pixels[..., 3] |= 252  # alpha 0 would let the encoder change the colours
        pixels[0, 0] = first
        return webp(pixels)

    palette = np.full((6, 192, 4), 255, np.uint8)
    palette[..., :3] = 1
    palette[5, 3:6, :3] = [[0, 1, 1], [1, 2, 1], [1, 1, 3]]  # entry 5 * 64 + 1 = 65 + 256
    labels = np.full((2, 4, 4), 255, np.uint8)
    labels[..., :2] = 65, 1
    scales = np.full((2, 4, 4), 255, np.uint8)
    scales[..., :3] = 0, 1, 2
    colors = scales.copy()
    colors[..., :3], colors[..., 3] = (2, 0, 1), 51
    meta = {
        "version": 2,
        "count": 1 if rng is None else 8,
        "means": {
            "mins": [0, -np.log(2), -1],
            "maxs": [np.log(4), 0, 1],
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": [-2, 0, 1], "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": [-1, 0, 2], "files": ["sh0.webp"]},
        "shN": {
            "count": 384,
            "bands": 1,
            "codebook": [-0.5, 0, 0.25, 0.75],
            "files": ["centroids.webp", "labels.webp"],
        },
    }
    return {
        "meta.json": json.dumps(meta).encode(),
        "means_l.webp": image((255, 0, 0, 255)),
        "means_u.webp": image((255, 0, 128, 255)),
        "scales.webp": webp(scales),
        "quats.webp": image((255, 127, 128, 252)),
        "sh0.webp": webp(colors),
        "centroids.webp": webp(palette),
        "labels.webp": webp(labels),
    }


def zipped(files, method=zipfile.ZIP_STORED):
    """Files by name as a zip."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return stream.getvalue()
