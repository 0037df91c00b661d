"""COLMAP models: cameras, images and points3D, text or binary -> poses and points.

Format: https://colmap.github.io/format.html. Poses are "camera from world"; the first pixel's
centre is at (0.5, 0.5) and camera axes are OpenCV's, both as in the kit. Every count in a file is
checked against the file's remaining size before memory is allocated.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import short_name

MODELS = {  # by number in binary files: name, parameters
    **{
        0: ("SIMPLE_PINHOLE", 3),
        1: ("PINHOLE", 4),
        2: ("SIMPLE_RADIAL", 4),
        3: ("RADIAL", 5),
        4: ("OPENCV", 8),
    },
    **{
        5: ("OPENCV_FISHEYE", 8),
        6: ("FULL_OPENCV", 12),
        7: ("FOV", 5),
        8: ("SIMPLE_RADIAL_FISHEYE", 4),
    },
    **{9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12)},
}
PARTS = ("cameras", "images", "points3D")


def is_colmap(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model."""
    return any(
        all((folder / f"{part}{ending}").is_file() for part in PARTS) for ending in (".bin", ".txt")
    )


def read_colmap(folder: str | Path) -> dict[str, Any]:
    """Read a model; binary files are preferred where both kinds are present.

    Args:
        folder: holds cameras, images and points3D, all .bin or all .txt.

    Returns:
        cameras: list of (model name, width, height, parameters) of the cameras in use;
        names: of the images; Ts_world_camera (N, 4, 4);
        points (M, 3); colours (M, 3) uint8; errors_px (M,) mean reprojection error of each point;
        track_lengths (M,) number of images that see each point.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: a file is damaged, or the camera model is not known.
    """
    folder = Path(folder)
    if not is_colmap(folder):
        raise FileNotFoundError(
            f"{folder}: expected a COLMAP model (cameras, images and points3D), found none; "
            "check it"
        )
    ending = ".bin" if all((folder / f"{part}.bin").is_file() for part in PARTS) else ".txt"
    paths = [require_file(folder / f"{part}{ending}") for part in PARTS]
    parts: list[Any] = []
    for path, (read_binary, read_text) in zip(paths, _READERS, strict=True):
        try:
            content = path.read_bytes()
            parts.append(
                read_binary(_Bytes(content)) if ending == ".bin" else read_text(_lines(content))
            )
        except (struct.error, ValueError, IndexError, KeyError, OverflowError):
            raise InputError(
                f"{short_name(path)}: expected COLMAP's {path.stem}, got damaged bytes; "
                "copy it again"
            ) from None
    cameras, images, (points, colours, errors, lengths) = parts
    missing = {image[1] for image in images} - set(cameras)
    poses = _poses([image[0] for image in images])
    if missing or not (np.isfinite(poses).all() and np.isfinite(points).all()):
        raise InputError(
            f"{short_name(folder)}: expected images with known cameras and finite poses, got others"
        )
    return {
        "cameras": [cameras[key] for key in sorted({image[1] for image in images})],
        "names": tuple(image[2] for image in images),
        "Ts_world_camera": poses,
        **{"points": points, "colours": colours, "errors_px": errors, "track_lengths": lengths},
    }


def _poses(rows: list[tuple[float, ...]]) -> Array:
    """Ts_world_camera (N, 4, 4) from qw qx qy qz tx ty tz (camera from world); NaN for q = 0."""
    from scipy.spatial.transform import Rotation

    values = np.array(rows, np.float64).reshape(-1, 7)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(values[:, :4], axis=1)
    usable = np.isfinite(lengths) & (lengths > 0.0)
    Ts_world_camera = np.full((len(values), 4, 4), np.nan)
    Rs_world_camera = Rotation.from_quat(values[usable, :4], scalar_first=True).inv()
    Ts_world_camera[usable, :3, :3] = Rs_world_camera.as_matrix()
    Ts_world_camera[usable, :3, 3] = -Rs_world_camera.apply(values[usable, 4:])
    Ts_world_camera[usable, 3] = 0.0, 0.0, 0.0, 1.0
    return Ts_world_camera


class _Bytes:
    """A reading position in a binary file; reading past its end raises struct.error."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next numbers, little-endian."""
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def count(self, least_bytes: int) -> int:
        """The number of rows that follow, each of at least `least_bytes`."""
        (number,) = self.take("Q")
        if number * least_bytes > len(self.data) - self.at:
            raise ValueError(number)
        return int(number)

    def skip(self, row_bytes: int) -> int:
        """Skip rows of `row_bytes` each and return their number."""
        number = self.count(row_bytes)
        self.at += number * row_bytes
        return number

    def word(self) -> str:
        """Text up to its terminating zero."""
        end = self.data.index(b"\0", self.at)
        text, self.at = self.data[self.at : end].decode(), end + 1
        return text


def _binary_cameras(file: _Bytes) -> dict[int, tuple[Any, ...]]:
    cameras = {}
    for _ in range(file.count(24)):
        number, model, width, height = file.take("iiQQ")
        name, parameters = MODELS[model]
        cameras[number] = (name, width, height, file.take(f"{parameters}d"))
    return cameras


def _binary_images(file: _Bytes) -> list[tuple[Any, ...]]:
    images = []
    for _ in range(file.count(73)):
        _, *pose, camera = file.take("i7di")
        name = file.word()
        file.skip(24)  # where the image sees points: not needed
        images.append((tuple(pose), camera, name))
    return images


def _binary_points(file: _Bytes) -> tuple[Any, ...]:
    rows = []
    for _ in range(file.count(51)):
        _, *row = file.take("Q3d3Bd")
        rows.append((*row, file.skip(8)))
    return _points(rows)


def _lines(content: bytes) -> list[str]:
    """Lines of a text file without comments; empty lines stay, since an image may see no points."""
    return [line for line in content.decode().splitlines() if not line.startswith("#")]


def _text_cameras(lines: list[str]) -> dict[int, tuple[Any, ...]]:
    known = dict(MODELS.values())
    cameras = {}
    for number, model, width, height, *parameters in _words(lines):
        if len(parameters) != known[model]:
            raise ValueError(model)
        cameras[int(number)] = (
            model,
            int(width),
            int(height),
            tuple(float(word) for word in parameters),
        )
    return cameras


def _text_images(lines: list[str]) -> list[tuple[Any, ...]]:
    images = []
    for line in lines[::2]:  # every second line lists where the image sees points
        if line.strip():
            _, *pose, camera, name = line.split(maxsplit=9)
            if len(pose) != 7:
                raise ValueError(line)
            images.append((tuple(float(word) for word in pose), int(camera), name.strip()))
    return images


def _text_points(lines: list[str]) -> tuple[Any, ...]:
    rows = []
    for _, x, y, z, red, green, blue, error, *track in _words(lines):
        rows.append(
            (
                float(x),
                float(y),
                float(z),
                int(red),
                int(green),
                int(blue),
                float(error),
                len(track) // 2,
            )
        )
    return _points(rows)


def _words(lines: list[str]) -> Iterator[list[str]]:
    return (line.split() for line in lines if line.strip())


def _points(rows: list[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Points, colours, errors and track lengths as arrays."""
    table = np.array(rows, np.float64).reshape(-1, 8)
    return table[:, :3], table[:, 3:6].astype(np.uint8), table[:, 6], table[:, 7].astype(np.int64)


_READERS = (
    (_binary_cameras, _text_cameras),
    (_binary_images, _text_images),
    (_binary_points, _text_points),
)
