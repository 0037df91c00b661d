"""A scene's name and a file -> the scene in the cache, and a gzipped .splat in the file.

Run in a process of its own: building the arena takes long and must not slow the flight.
"""

import gzip
import sys
from pathlib import Path

from falconwing_kit.tools.classroom.after_flight import part
from falconwing_kit.tools.cli.scene_input import open_scene


def pack_scene(name: str, file: Path) -> bool:
    """Load a scene, which keeps a built one in the cache; write it if this version can.

    Returns:
        Whether the file was written.

    Raises:
        InputError: there is no such scene.
        FileNotFoundError: there is no file at a path.
    """
    scene = open_scene(name)
    writer = part("falconwing_kit.tools.capture.packed_write")
    if writer is None:
        return False
    plain = file.with_suffix("")  # scene.splat
    writer.write_packed(plain, scene)
    file.write_bytes(gzip.compress(plain.read_bytes(), 6))
    plain.unlink()
    return True


if __name__ == "__main__":
    pack_scene(sys.argv[1], Path(sys.argv[2]))
