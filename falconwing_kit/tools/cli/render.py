"""falconwing render: render an image of a Gaussian scene."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, require_writable_path
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render
from falconwing_kit.scene.arena import leader_at, with_leader
from falconwing_kit.tools.cli.scene_input import open_link, open_scene, parse_pose, parse_size
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

MAX_DEPTH = 65.535  # [m], the maximum of a PNG of 16-bit millimetres


@dataclass(frozen=True)
class Render:
    """Render the view of a camera that looks along the nose."""

    scene: Annotated[str, tyro.conf.Positional]
    """a file, or the name of a shipped scene"""
    pose: str
    """the camera's x,y,z,roll,pitch,yaw in metres and degrees: positive right wing down, nose up,
    nose right
    """
    out: Path
    """the PNG to write"""
    size: str = "640x480"
    """width x height in pixels"""
    fov_deg: float = 77.8
    """horizontal field of view; 77.8 is that of the hall's flights"""
    backend: Literal["auto", "fast", "reference", "gsplat"] = "auto"
    """renderer"""
    leader: str | None = None
    """x,y,z,roll,pitch,yaw of the leader aircraft, the scene's own or the kit's; without it none is
    drawn
    """
    depth: Path | None = None
    """a second PNG: depth in millimetres, 16 bits, 0 for empty"""
    alpha: Path | None = None
    """a third PNG: opacity, white is 1"""
    antialiased: bool = False
    """fade Gaussians smaller than a pixel instead of widening them"""
    seed: int = 0
    """of the analog video link's noise, for a scene that has one (hall_analog)"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Render and write the images.

        Returns:
            0: the images are written.

        Raises:
            FileNotFoundError: there is no scene file, or no folder for an image.
            InputError: an option is wrong, the backend cannot run here, or an image cannot be
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
                "--out, --depth, --alpha: expected three different files, got one name twice"
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
        self._print(len(scene), float(frame.alpha.mean()), seconds)
        return 0

    def _print(self, count: int, covered: float, seconds: float) -> None:
        """Print what was rendered."""
        record = {"file": str(self.out), "gaussians": count, "covered": covered, "seconds": seconds}
        if self.json:
            print_json(record)
            return
        rows = [
            ("Gaussians", count),
            ("mean opacity of the image", covered),
            ("time, with compilation [s]", seconds),
        ]
        print_table(("what", "value"), rows, title=str(self.out))
        next_line(f"open {self.out}")


def _with_leader(scene: GaussianScene, pose: str | None) -> GaussianScene:
    """The scene with its leader at a pose; without a pose the leader is left out, unless the scene
    is an aircraft alone.
    """
    if pose is not None:
        p_world, angles = parse_pose("--leader", pose)
        return leader_at(with_leader(scene), pose_matrix(rotation_world_body(*angles), p_world))
    has_both = "leader" in scene.label_names and not scene.labelled("leader").all()
    return leader_at(scene, None) if has_both else scene


def _write_png(path: Path, image: np.ndarray[Any, Any]) -> None:
    """Write an image, BGR or grey, atomically."""
    import cv2

    data = cv2.imencode(".png", image)[1]
    with atomic_write(path) as file:
        file.write(data.tobytes())
