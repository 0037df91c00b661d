"""Photos with poses: nerfstudio's transforms.json or a COLMAP model <-> Reconstruction.

transforms.json stores poses with OpenGL camera axes (x right, y up, z back); the kit's are OpenCV's
(x right, y down, z forward). The conversion is in this file only:

    T_world_camera(OpenGL) = T_world_camera(OpenCV) diag(1, -1, -1, 1)
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_file, require_range, require_shape
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.tools.capture.colmap import is_colmap, read_colmap
from falconwing_kit.tools.capture.points import read_points, write_points
from falconwing_kit.vision.images import read_image

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
MAX_JSON_BYTES = 64 * 1024**2
TRANSFORMS, POINTS = "transforms.json", "points.ply"
# parameters of COLMAP's camera models; coefficients beyond k1 must be negligible
_COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
_FURTHER = ("k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Photos of one camera, their poses, and the triangulated points.

    With x = X/Z and y = Y/Z in camera axes and r^2 = x^2 + y^2:

    u = fx x (1 + k1 r^2) + cx,  v = fy y (1 + k1 r^2) + cy    [COLMAP's SIMPLE_RADIAL; Brown 1966]

    Before the alignment, "world" has an arbitrary origin, orientation and unit of length.

    Raises:
        InputError: there are no photos, a name occurs twice, shapes differ, or a pose is not rigid.
    """

    camera: PinholeCamera  # one for all photos
    names: tuple[str, ...]  # (N,) file names, relative to the folder
    folder: Path  # where the photos are
    T_world_camera: Array  # (N, 4, 4), "world from camera", OpenCV axes
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (M, 3) world
    # (M, 3) red, green, blue
    colours: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    k1: float = 0.0  # radial distortion
    aligned: bool = False  # True: world is the kit's, in metres
    # registered, total, reprojection_px, focal_px ...
    report: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check every field."""
        count = len(self.names)
        if count == 0 or len(set(self.names)) < count:
            raise InputError(
                "names: expected at least one photo and every name once, got none or a name twice"
            )
        poses = require_shape("T_world_camera", self.T_world_camera, (count, 4, 4))
        R = poses[:, :3, :3]
        proper = np.isfinite(poses).all() and np.allclose(
            R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-4
        )
        if not (proper and (np.linalg.det(R) > 0).all() and np.allclose(poses[:, 3], (0, 0, 0, 1))):
            raise InputError(
                "T_world_camera: expected rotations with places, got other matrices; "
                "check axes and units"
            )
        points = require_shape("points", self.points, (None, 3))
        colours = np.asarray(self.colours)
        if (
            colours.shape != points.shape
            or colours.dtype != np.uint8
            or not np.isfinite(points).all()
        ):
            raise InputError(
                "points, colours: expected (M, 3) finite points and (M, 3) bytes, got others"
            )
        object.__setattr__(self, "folder", Path(self.folder))
        object.__setattr__(self, "T_world_camera", poses)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "k1", require_range("k1", self.k1, low=-2.0, high=2.0))

    def __len__(self) -> int:
        return len(self.names)

    def path(self, number: int) -> Path:
        """Path of a photo."""
        return self.folder / self.names[number]

    def project(self, p_world: Array, number: int) -> Array:
        """Project points into a photo, lens distortion included.

        Args:
            p_world: (K, 3).
            number: of the photo, 0..N-1.

        Returns:
            Pixels (K, 2) as u, v [px]; nan for a point that is not in front of the camera.
        """
        pixels, _ = self.camera.project(p_world, self.T_world_camera[number])
        principal, focal = (self.camera.cx, self.camera.cy), (self.camera.fx, self.camera.fy)
        radius_squared = (((pixels - principal) / focal) ** 2).sum(axis=-1, keepdims=True)
        return (pixels - principal) * (1.0 + self.k1 * radius_squared) + principal

    def pixel_directions(self, pixels: Array) -> Array:
        """Directions of pixels in camera axes, by fixed-point iteration of the distortion.

        Args:
            pixels: (K, 2) as u, v [px].

        Returns:
            (K, 3) in camera axes, z = 1.
        """
        distorted = (np.asarray(pixels) - (self.camera.cx, self.camera.cy)) / (
            self.camera.fx,
            self.camera.fy,
        )
        straight = distorted.copy()
        # |k1| r^2 < 0.1 for every lens of this model: each iteration reduces the error tenfold
        for _ in range(20):
            straight = distorted / (1.0 + self.k1 * (straight**2).sum(axis=-1, keepdims=True))
        return np.concatenate([straight, np.ones((len(straight), 1))], axis=1)


def read_reconstruction(path: str | Path) -> Reconstruction:
    """Read photos with poses.

    Args:
        path: a transforms.json, or a folder with one; or the folder of a COLMAP model (text or
            binary), or a folder with that model in sparse/0 or sparse. The photos of a COLMAP model
            are searched in a folder `images` or `photos` nearby; set another by
            `dataclasses.replace(..., folder=...)`.

    Raises:
        FileNotFoundError: there is no such file or folder.
        InputError: it is neither, is damaged, or has several cameras or an unsupported lens.
    """
    path = Path(path)
    if path.is_dir() and not (path / TRANSFORMS).is_file():
        for folder in (path, path / "sparse" / "0", path / "sparse"):
            if is_colmap(folder):
                return _from_colmap(folder, path)
        raise InputError(
            f"{path}: expected {TRANSFORMS} or a COLMAP model (cameras, images, points3D), "
            "found neither"
        )
    return _from_transforms(require_file(path / TRANSFORMS if path.is_dir() else path))


def write_reconstruction(folder: str | Path, reconstruction: Reconstruction) -> Path:
    """Write transforms.json and points.ply as nerfstudio reads them, with the kit's report.

    Photos below the folder's parent have relative paths, so that both can be moved together; others
    have absolute ones.

    Returns:
        The path of transforms.json.

    Raises:
        InputError: the folder is a file or cannot be written.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder, got a file; choose another name")
    folder.mkdir(parents=True, exist_ok=True)
    write_points(folder / POINTS, reconstruction.points, reconstruction.colours)
    camera = reconstruction.camera
    record = {
        "camera_model": "OPENCV",
        **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy},
        **{
            "cx": camera.cx,
            "cy": camera.cy,
            "k1": reconstruction.k1,
            "k2": 0.0,
            "p1": 0.0,
            "p2": 0.0,
        },
        "ply_file_path": POINTS,
        "falconwing_kit": {
            "aligned": reconstruction.aligned,
            "report": dict(reconstruction.report),
        },
        "frames": [
            {
                "file_path": _photo_path(folder, reconstruction.path(number)),
                "transform_matrix": (T @ FLIP).tolist(),
            }
            for number, T in enumerate(reconstruction.T_world_camera)
        ],
    }
    with atomic_write(folder / TRANSFORMS, text=True) as file:
        json.dump(record, file, indent=1)
    return folder / TRANSFORMS


def undistort(reconstruction: Reconstruction, folder: str | Path) -> Reconstruction:
    """Write the photos without lens distortion.

    Args:
        reconstruction: with its k1.
        folder: for the new photos, .png; created if missing.

    Returns:
        The same poses and points with k1 = 0 and the new photos; unchanged if k1 is 0 already.

    Raises:
        InputError: a photo cannot be read or written.
    """
    if reconstruction.k1 == 0.0:
        return reconstruction
    import cv2

    folder, camera = Path(folder), reconstruction.camera
    folder.mkdir(parents=True, exist_ok=True)
    x, y = np.moveaxis(camera.pixel_rays()[..., :2], -1, 0)
    factor = 1.0 + reconstruction.k1 * (x * x + y * y)
    columns, rows = (
        camera.fx * x * factor + camera.cx - 0.5,
        camera.fy * y * factor + camera.cy - 0.5,
    )
    names = tuple(Path(name).with_suffix(".png").as_posix() for name in reconstruction.names)
    for number, name in enumerate(names):
        image = cv2.remap(
            read_photo(reconstruction.path(number))[..., ::-1],
            columns.astype(np.float32),
            rows.astype(np.float32),
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / name) as file:
            file.write(cv2.imencode(".png", image)[1].tobytes())
    return replace(reconstruction, names=names, folder=folder, k1=0.0)


def read_photo(path: str | Path) -> NDArray[np.uint8]:
    """Read a photo as stored; its EXIF orientation is ignored, as in the poses.

    Returns:
        (H, W, 3) red, green, blue.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is no image.
    """
    image = read_image(Path(path), as_stored=True)
    if image is None:
        raise InputError(
            f"{short_name(path)}: expected a photo, got a file in an unknown format; "
            "remove or replace it"
        )
    return image


def _photo_path(folder: Path, photo: Path) -> str:
    """A photo's path in transforms.json: relative if it lies below the folder's parent."""
    folder, photo = folder.resolve(), photo.resolve()
    near = photo.is_relative_to(folder.parent)
    return Path(os.path.relpath(photo, folder)).as_posix() if near else photo.as_posix()


def _from_transforms(path: Path) -> Reconstruction:
    """Read a transforms.json and its points."""
    name = short_name(path)
    if path.stat().st_size > MAX_JSON_BYTES:
        raise InputError(
            f"{name}: expected a JSON file of at most {MAX_JSON_BYTES >> 20} MiB, got a larger one"
        )
    try:
        record = json.loads(path.read_bytes())
        frames = record["frames"]
        photos = [Path(os.path.abspath(path.parent / frame["file_path"])) for frame in frames]
        folder = Path(os.path.commonpath([photo.parent for photo in photos]))
        poses = np.array([frame["transform_matrix"] for frame in frames], np.float64).reshape(
            -1, 4, 4
        )
        shared = {**(frames[0] if "fl_x" not in record else {}), **record}
        numbers = {key: float(shared[key]) for key in ("fl_x", "cx", "cy", "w", "h")}
        numbers["fl_y"] = float(shared.get("fl_y", numbers["fl_x"]))
        lens = {key: float(shared.get(key, 0.0)) for key in ("k1", *_FURTHER)}
    except RecursionError:
        raise InputError(
            f"{name}: expected nerfstudio's {TRANSFORMS}, got brackets nested too deep to read"
        ) from None
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        what = f"without {error}" if isinstance(error, KeyError) else "with other content"
        raise InputError(
            f"{name}: expected nerfstudio's {TRANSFORMS}, got a file {what}; write it again"
        ) from None
    if any(frame.get(key, numbers[key]) != numbers[key] for frame in frames for key in numbers):
        raise InputError(
            f"{name}: expected one camera for all photos, got several; "
            "take all photos with one zoom and size"
        )
    if shared.get("camera_model", "OPENCV") not in (
        "OPENCV",
        "PINHOLE",
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
    ):
        raise InputError(
            f"{name}: expected a pinhole camera, got {shared['camera_model']!r}; "
            "undistort the photos first"
        )
    focal, principal = (numbers["fl_x"], numbers["fl_y"]), (numbers["cx"], numbers["cy"])
    camera = PinholeCamera(*focal, *principal, width=int(numbers["w"]), height=int(numbers["h"]))
    _require_simple_lens(name, lens, camera)
    points_name = record.get("ply_file_path")
    clouded = isinstance(points_name, str)
    points, colours = (
        read_points(path.parent / points_name)
        if clouded
        else (np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    )
    own = record.get("falconwing_kit")
    own = own if isinstance(own, dict) else {}
    names = tuple(photo.relative_to(folder).as_posix() for photo in photos)
    aligned, report = own.get("aligned") is True, own.get("report", {})
    return Reconstruction(
        camera, names, folder, poses @ FLIP, points, colours, lens["k1"], aligned, report
    )


def _from_colmap(folder: Path, given: Path) -> Reconstruction:
    """Read a COLMAP model; `given` is the folder that the user named."""
    model = read_colmap(folder)
    name, cameras = short_name(folder), model["cameras"]
    if len(cameras) == 0:
        raise InputError(
            f"{name}: expected a model with images, got an empty one; run the reconstruction again"
        )
    kind, width, height, parameters = cameras[0]
    if any(other != cameras[0] for other in cameras):
        raise InputError(
            f"{name}: expected one camera for all photos, got {len(cameras)}; "
            "reconstruct with a single camera"
        )
    if kind not in _COLMAP_PARAMETERS:
        raise InputError(
            f"{name}: expected a lens with at most k1, got COLMAP's {kind}; "
            "undistort the photos first"
        )
    numbers = dict(zip(_COLMAP_PARAMETERS[kind], parameters, strict=True))
    fx, fy = numbers.get("fx", numbers.get("f", 0.0)), numbers.get("fy", numbers.get("f", 0.0))
    camera = PinholeCamera(fx, fy, numbers["cx"], numbers["cy"], width, height)
    _require_simple_lens(name, numbers, camera)
    places = [
        near / sub
        for near in (given, given.parent, given.parent.parent)
        for sub in ("images", "photos")
    ]
    photos = next((place for place in places if (place / model["names"][0]).is_file()), given)
    errors, lengths = model["errors_px"], model["track_lengths"]
    report = {"registered": len(model["names"]), "points": len(errors), "focal_px": fx}
    if lengths.sum() > 0 and np.isfinite(errors).all() and (errors >= 0).all():
        report["reprojection_px"] = float((errors * lengths).sum() / lengths.sum())
    order = np.argsort(model["names"])
    names = tuple(model["names"][k] for k in order)
    return Reconstruction(
        camera,
        names,
        photos,
        model["Ts_world_camera"][order],
        model["points"],
        model["colours"],
        k1=numbers.get("k1", 0.0),
        report=report,
    )


def _require_simple_lens(name: str, lens: Mapping[str, float], camera: PinholeCamera) -> None:
    """Raise InputError if higher distortion terms move the image's corner by over half a pixel."""
    radius = np.hypot(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
    powers = {"k2": 5, "k3": 7, "k4": 9, "p1": 2, "p2": 2}
    moved = (
        sum(abs(lens.get(key, 0.0)) * radius**power for key, power in powers.items()) * camera.fx
    )
    if not moved < 0.5:
        raise InputError(
            f"{name}: expected a lens with at most k1, but its further terms move the corner by "
            f"{moved:.1f} px; undistort "
            "the photos first (COLMAP: image_undistorter)"
        )
