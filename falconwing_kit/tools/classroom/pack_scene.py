"""A scene's name and a file -> the scene in the cache, and the page's scene in gzip in the file.

Run in a process of its own: building the arena takes long and must not slow the flight.
"""

import gzip
import sys
from pathlib import Path

from falconwing_kit.tools.classroom.scene_file import scene_bytes
from falconwing_kit.tools.cli.scene_input import open_scene


def pack_scene(name: str, file: Path) -> None:
    """Load a scene, which keeps a built one in the cache, and write it as the pages load it.

    Raises:
        InputError: there is no such scene.
        FileNotFoundError: there is no file at a path.
    """
    file.write_bytes(gzip.compress(scene_bytes(open_scene(name)), 6))


if __name__ == "__main__":
    pack_scene(sys.argv[1], Path(sys.argv[2]))
