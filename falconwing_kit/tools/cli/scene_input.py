"""Scenes on the command line: a name or a file, a pose and a size as text -> values; tables."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.flight.pilots import MAX_MOUNT
from falconwing_kit.scene import AnalogVideo, GaussianScene, scene_link
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.tools.cli.show import print_json, print_table


def open_scene(name: str) -> GaussianScene:
    """A scene from a file, or one that ships with the kit.

    Args:
        name: a path, or a name of `load_scene`; a file of that name has precedence.

    Raises:
        FileNotFoundError: there is no file at a path.
        InputError: the file is not a scene, or the kit has no scene of that name.
    """
    return GaussianScene.load(name) if _is_path(name) else load_scene(name)


def open_link(name: str) -> AnalogVideo | None:
    """The analog video link of a shipped scene; None without one, and for a file."""
    return None if _is_path(name) else scene_link(name)


def _is_path(name: str) -> bool:
    """Whether the text is the path of a scene file rather than a scene's name."""
    path = Path(name)
    return path.exists() or bool(path.suffix) or len(path.parts) > 1


def scene_record(scene: GaussianScene) -> dict[str, Any]:
    """A scene's count, counts by label, bounds [m], SH degree and source, as they go to JSON."""
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
    """Position (3,) [m] and roll, pitch, yaw (3,) [rad] from "x,y,z,roll,pitch,yaw" in m and deg.

    Raises:
        InputError: the text is not six finite numbers.
    """
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.full(0, np.nan)
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise InputError(
            f"{option}: expected x,y,z,roll,pitch,yaw, six numbers in metres and degrees, "
            f"got {text[:80]!r}"
        )
    return numbers[:3], np.radians(numbers[3:])


def parse_place(option: str, text: str) -> tuple[float, float, float]:
    """A point of the aircraft in body axes [m] from "x,y,z", within 2 m of the centre of gravity.

    Raises:
        InputError: the text is not three such numbers.
    """
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not max(abs(x), abs(y), abs(z)) <= MAX_MOUNT or not math.isfinite(x + y + z):
        raise InputError(
            f"{option}: expected x,y,z, three numbers in metres within {MAX_MOUNT:g} of the centre"
            f" of gravity, such as {option}=0.036,0,-0.075, got {text[:80]!r}"
        )
    return x, y, z


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


def print_scene(record: dict[str, Any], title: str, as_json: bool) -> None:
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
    print(f"\ncolours of SH degree {record['sh_degree']}; source: {record['source'] or 'unknown'}")
