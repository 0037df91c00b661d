"""falconwing scene export: a scene -> a .splat, SPZ or SOG file, and what that format loses."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import require_writable_path
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.capture.packed_write import write_packed
from falconwing_kit.tools.cli.scene_input import open_scene
from falconwing_kit.tools.cli.show import next_line, print_json, print_table


@dataclass(frozen=True)
class SceneExport:
    """Write a scene for other viewers: .splat, SPZ or SOG, smaller than a .ply.

    These files hold neither labels nor named points nor the source: what is lost is printed.
    """

    scene: Annotated[str, tyro.conf.Positional]
    """a file, or the name of a shipped scene"""
    out: Path
    """the file to write, or a folder to write it into"""
    to: Literal["splat", "spz", "sog"] = "spz"
    """splat: most viewers, colours that do not change with the direction; spz: small, all colours;
    sog: smallest, as images in a zip
    """
    without: str = ""
    """labels to leave out, such as leader, which the arena keeps in body axes at the origin"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Write the file; print its size and what it does not hold.

        Returns:
            0: the file is written.

        Raises:
            FileNotFoundError: there is no scene, or no folder for the file.
            InputError: the scene cannot be read or held by the format, there is no such label, or
                the file cannot be written or is the scene itself.
        """
        stem = Path(self.scene).stem
        target = self.out / f"{stem}.{self.to}" if self.out.is_dir() else self.out
        if target.suffix.lower() != f".{self.to}":
            raise InputError(
                f"--out: expected a name ending in .{self.to} or a folder, got {target.name};"
                " --to selects the format"
            )
        if Path(self.scene).exists() and target.resolve() == Path(self.scene).resolve():
            raise InputError(f"{target}: expected another name than the scene's own; it is kept")
        require_writable_path(target)
        scene = self._part(open_scene(self.scene))
        lost = write_packed(target, scene)
        size = target.stat().st_size
        if self.json:
            print_json({"file": str(target), "gaussians": len(scene), "bytes": size, "lost": lost})
            return 0
        rows = [("Gaussians", len(scene)), ("size [kB]", round(size / 1000))]
        print_table(["what", "count"], rows, title=str(target))
        for sentence in lost:
            print(f"lost: {sentence}")
        next_line(f"falconwing scene info {target}")
        return 0

    def _part(self, scene: GaussianScene) -> GaussianScene:
        """The scene without the labels of --without."""
        names = [name.strip() for name in self.without.split(",") if name.strip()]
        return scene.selected(~scene.labelled(*names)) if names else scene
