"""falconwing scene: make scenes: the arena, from photos, edited; inspect and export them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from falconwing_kit.core.files import require_writable_path
from falconwing_kit.scene.arena import build_arena
from falconwing_kit.tools.cli.scene_edit import Edit
from falconwing_kit.tools.cli.scene_export import SceneExport
from falconwing_kit.tools.cli.scene_fit import Fit
from falconwing_kit.tools.cli.scene_input import open_scene, print_scene, scene_record
from falconwing_kit.tools.cli.scene_link import Link
from falconwing_kit.tools.cli.scene_photos import Align, Poses
from falconwing_kit.tools.cli.scene_pose_net import TrainPoseNet
from falconwing_kit.tools.cli.show import next_line


@dataclass(frozen=True)
class Build:
    """Build the arena and, with --out, write it."""

    seed: int = 0
    """selects the posters and the hues of the walls"""
    out: Path | None = None
    """the file to write (.npz or .ply), or a folder to write arena.npz into"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Build the arena, write it and print its contents.

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
        print_scene(scene_record(scene), str(path or "arena, not written: no --out"), self.json)
        if not self.json:
            next_line(
                f"falconwing render {path or 'arena'} --pose=-10,-2,1.5,0,-3,0 --out view.png"
            )
        return 0


@dataclass(frozen=True)
class Info:
    """Print what is in a scene."""

    scene: Annotated[str, tyro.conf.Positional]
    """a file, or the name of a shipped scene"""
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
        print_scene(scene_record(open_scene(self.scene)), self.scene, self.json)
        if not self.json:
            next_line(f"falconwing render {self.scene} --pose=-10,-2,1.5,0,-3,0 --out view.png")
        return 0


@dataclass(frozen=True)
class Scene:
    """Make and inspect Gaussian scenes; poses, align and fit lead from photos to a scene."""

    step: tyro.conf.OmitSubcommandPrefixes[
        Build
        | Info
        | Poses
        | Align
        | Fit
        | Edit
        | Link
        | Annotated[SceneExport, tyro.conf.subcommand("export")]
        | Annotated[TrainPoseNet, tyro.conf.subcommand("pose-net")]
    ]

    def run(self) -> int:
        """Run the chosen step."""
        return self.step.run()
