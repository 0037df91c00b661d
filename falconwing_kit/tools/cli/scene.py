"""`falconwing scene` and `falconwing render`: a scene by name or file -> what is in it, a file of
it, or an image.
"""

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write, require_writable_path
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import (
    AnalogVideo,
    GaussianScene,
    PinholeCamera,
    nose_camera_pose,
    render,
    scene_link,
)
from falconwing_kit.scene.arena import build_arena, leader_at, load_scene, with_leader
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

MAX_DEPTH = 65.535  # [m], the largest in a PNG of 16-bit millimetres


@dataclass(frozen=True)
class Build:
    """Build the arena and write it, if told where."""

    seed: int = 0
    """another seed gives other posters and other hues of the walls"""
    out: Path | None = None
    """the file to write (.npz or .ply), or a folder to write arena.npz into"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Build, write and say what was built.

        Returns:
            0: it is built.

        Raises:
            InputError: the seed is negative, or the file cannot be written.
            FileNotFoundError: the folder of the file does not exist.
        """
        path = self.out / "arena.npz" if self.out is not None and self.out.is_dir() else self.out
        if path is not None:
            require_writable_path(path)
        scene = build_arena(self.seed)
        if path is not None:
            scene.save(path)
        _print_scene(scene_record(scene), str(path or "arena, not written: no --out"), self.json)
        if not self.json:
            next_line(
                f"falconwing render {path or 'arena'} --pose=-10,-2,1.5,0,-3,0 --out view.png"
            )
        return 0


@dataclass(frozen=True)
class Info:
    """Say what is in a scene."""

    scene: Annotated[str, tyro.conf.Positional]
    """a file, or the name of a scene that ships"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Print count, labels, bounds, colours' degree and source.

        Returns:
            0: the scene could be read.

        Raises:
            FileNotFoundError: there is no file.
            InputError: the file is no scene, or there is no scene of that name.
        """
        _print_scene(scene_record(open_scene(self.scene)), self.scene, self.json)
        if not self.json:
            next_line(f"falconwing render {self.scene} --pose=-10,-2,1.5,0,-3,0 --out view.png")
        return 0


@dataclass(frozen=True)
class Render:
    """Render an image of a scene, as a camera that looks along the nose sees it."""

    scene: Annotated[str, tyro.conf.Positional]
    """a file, or the name of a scene that ships"""
    pose: str
    """the camera's x,y,z,roll,pitch,yaw, in metres and degrees: right wing down, nose up, nose
    right
    """
    out: Path
    """the PNG to write"""
    size: str = "640x480"
    """width x height in pixels"""
    fov_deg: float = 77.8
    """field of view from the left to the right edge; 77.8 is that of the hall's flights"""
    backend: Literal["auto", "fast", "reference", "gsplat"] = "auto"
    """which renderer"""
    leader: str | None = None
    """x,y,z,roll,pitch,yaw of the leader aircraft, the scene's own or the one that ships; without
    it there is none
    """
    depth: Path | None = None
    """a second PNG: depth in millimetres, 16 bits, 0 where nothing is"""
    alpha: Path | None = None
    """a third PNG: how much is covered, white is all"""
    antialiased: bool = False
    """fade Gaussians smaller than a pixel instead of widening them"""
    seed: int = 0
    """of the noise of an analog link, for a scene that is seen through one (hall_analog)"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Render and write the images.

        Returns:
            0: the images are written.

        Raises:
            FileNotFoundError: there is no scene file, or no folder for an image.
            InputError: an option makes no sense, the backend cannot run here, or an image cannot be
                written.
        """
        paths = [path for path in (self.out, self.depth, self.alpha) if path is not None]
        for path in paths:
            if require_writable_path(path).suffix.lower() != ".png":
                raise InputError(
                    f"{path}: expected a name ending in .png for an image, got another ending"
                )
        if len(set(map(Path.absolute, paths))) < len(paths):
            raise InputError(
                "--out, --depth, --alpha: expected a file of its own for each, got the same twice"
            )
        p_world, angles = parse_pose("--pose", self.pose)
        camera = PinholeCamera.from_fov_deg(*parse_size(self.size), self.fov_deg)
        scene = _with_leader(open_scene(self.scene), self.leader)
        start = time.perf_counter()
        frame = render(
            scene,
            camera,
            nose_camera_pose(p_world, *angles),
            self.backend,
            antialiased=self.antialiased,
        )
        seconds = time.perf_counter() - start
        picture = np.round(255.0 * frame.rgb).astype(np.uint8)
        link = open_link(self.scene)
        if link is not None:
            picture = replace(link, seed=self.seed).apply(picture, 0)
        _write_png(self.out, picture[..., ::-1])
        if self.depth is not None:
            _write_png(
                self.depth,
                np.round(1000.0 * np.clip(frame.depth, 0.0, MAX_DEPTH)).astype(np.uint16),
            )
        if self.alpha is not None:
            _write_png(
                self.alpha, np.round(255.0 * np.clip(frame.alpha, 0.0, 1.0)).astype(np.uint8)
            )
        self._say(len(scene), float(frame.alpha.mean()), seconds)
        return 0

    def _say(self, count: int, covered: float, seconds: float) -> None:
        """Print what was rendered and where it lies."""
        record = {"file": str(self.out), "gaussians": count, "covered": covered, "seconds": seconds}
        if self.json:
            print_json(record)
            return
        rows = [
            ("Gaussians", count),
            ("covered part of the image", covered),
            ("time, with any compiling [s]", seconds),
        ]
        print_table(("what", "value"), rows, title=str(self.out))
        next_line(f"open {self.out}")


def open_scene(name: str) -> GaussianScene:
    """A scene from a file, or one that ships.

    Args:
        name: a path, or a name that `load_scene` knows; a file of that name goes first.

    Raises:
        FileNotFoundError: there is no file at a path.
        InputError: the file is no scene, or no scene of that name ships.
    """
    return GaussianScene.load(name) if _names_file(name) else load_scene(name)


def open_link(name: str) -> AnalogVideo | None:
    """The analog link of a scene that ships; None where it has none, and for a file."""
    return None if _names_file(name) else scene_link(name)


def _names_file(name: str) -> bool:
    path = Path(name)
    return path.exists() or bool(path.suffix) or len(path.parts) > 1


def scene_record(scene: GaussianScene) -> dict[str, Any]:
    """What is in a scene, as it goes to JSON: count, labels with their counts, bounds [m], SH
    degree and source.
    """
    return {
        "gaussians": len(scene),
        "labels": {
            name: int(count) for name in scene.label_names if (count := scene.labelled(name).sum())
        },
        "low_m": scene.means.min(axis=0).tolist(),
        "high_m": scene.means.max(axis=0).tolist(),
        "sh_degree": math.isqrt(scene.sh.shape[1]) - 1,
        "source": scene.source,
    }


def parse_pose(option: str, text: str) -> tuple[Array, Array]:
    """Place (3,) [m] and roll, pitch, yaw (3,) [rad] from "x,y,z,roll,pitch,yaw" in metres and
    degrees.

    Raises:
        InputError: these are not six finite numbers.
    """
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.full(0, np.nan)
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise InputError(
            f"{option}: expected x,y,z,roll,pitch,yaw, six numbers in metres and degrees, got {text[:80]!r}"
        )
    return numbers[:3], np.radians(numbers[3:])


def parse_size(text: str) -> tuple[int, int]:
    """Width and height [px] from text such as "640x480".

    Raises:
        InputError: the text is not of that form.
    """
    width, by, height = text.lower().partition("x")
    if not (by and width.isdecimal() and height.isdecimal()) or len(text) > 20:
        raise InputError(
            f"--size: expected WIDTHxHEIGHT in pixels, such as 640x480, got {text[:80]!r}"
        )
    return int(width), int(height)


def _with_leader(scene: GaussianScene, pose: str | None) -> GaussianScene:
    """The scene with its leader at a pose; without one the leader is left out, unless the scene is
    nothing else.
    """
    if pose is not None:
        p_world, angles = parse_pose("--leader", pose)
        return leader_at(with_leader(scene), pose_matrix(rotation_world_body(*angles), p_world))
    has_both = "leader" in scene.label_names and not scene.labelled("leader").all()
    return leader_at(scene, None) if has_both else scene


def _print_scene(record: dict[str, Any], title: str, as_json: bool) -> None:
    """The record of a scene as JSON or as two tables."""
    if as_json:
        print_json(record)
        return
    print_table(
        ("label", "Gaussians"),
        [*record["labels"].items(), ("all", record["gaussians"])],
        title=title,
    )
    print()
    rows = [
        (axis, *bounds)
        for axis, *bounds in zip("xyz", record["low_m"], record["high_m"], strict=True)
    ]
    print_table(("axis", "from [m]", "to [m]"), rows)
    print(f"\ncolours of SH degree {record['sh_degree']}; source: {record['source'] or 'not told'}")


def _write_png(path: Path, image: np.ndarray[Any, Any]) -> None:
    """Write an image, blue green red or grey, whole or not at all."""
    import cv2

    data = cv2.imencode(".png", image)[1]
    with atomic_write(path) as file:
        file.write(data.tobytes())
