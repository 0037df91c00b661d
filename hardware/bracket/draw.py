"""Figure of the brackets: both STL files -> manual/figures/bracket.png, rendered with NumPy.

.venv/bin/python hardware/bracket/draw.py
"""

import argparse
import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.files import atomic_write

FOLDER = Path(__file__).resolve().parent
FIGURES = FOLDER.parents[1] / "manual" / "figures"
SIDE, MARGIN, SMOOTH = (
    420,
    20,
    3,
)  # image size [px], margin [px], and oversampling
SUN = np.array([0.35, -0.45, 0.82])  # where the light comes from: ahead, right, above
TURN_DEG, LIFT_DEG = 40.0, 28.0  # seen from ahead and right, from above

Mesh = NDArray[np.float64]


def picture(mesh: Mesh) -> NDArray[np.uint8]:
    """A grey image of a solid in parallel projection.

    Args:
        mesh: (N, 3, 3) triangles, x ahead, y left, z up.

    Returns:
        (SIDE, SIDE) grey levels on white; faces are lighter the more they look at the light.
    """
    turn, lift = np.radians([TURN_DEG, LIFT_DEG])
    toward = np.array([np.cos(turn) * np.cos(lift), -np.sin(turn) * np.cos(lift), np.sin(lift)])
    right = np.cross([0.0, 0.0, 1.0], toward) / np.cos(lift)
    seen = (
        mesh @ np.stack([right, -np.cross(toward, right), toward]).T
    )  # to the right, down, to the eye
    low, high = seen.reshape(-1, 3).min(axis=0), seen.reshape(-1, 3).max(axis=0)
    pixels = SMOOTH * SIDE
    scale = (pixels - 2 * SMOOTH * MARGIN) / max(high[:2] - low[:2])
    seen = (seen - (low + high) / 2.0) * scale + np.array([pixels / 2.0, pixels / 2.0, 0.0])
    normal = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    grey = 110.0 + 120.0 * np.clip(normal @ SUN, 0.0, 1.0)
    image, depth = np.full((pixels, pixels), 255.0), np.full((pixels, pixels), -np.inf)
    for corners, level in zip(seen, grey, strict=True):
        _fill(image, depth, corners, level)
    return image.reshape(SIDE, SMOOTH, SIDE, SMOOTH).mean(axis=(1, 3)).round().astype(np.uint8)


def _fill(image: Mesh, depth: Mesh, corners: Mesh, level: float) -> None:
    """One triangle, where it is nearer to the eye than what is there."""
    left, top = np.maximum(np.floor(corners[:, :2].min(axis=0)).astype(int), 0)
    right, bottom = np.minimum(np.ceil(corners[:, :2].max(axis=0)).astype(int) + 1, len(image))
    x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
    twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if abs(twice) < 1e-9:
        return
    v = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / twice
    w = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / twice
    z = az + v * (bz - az) + w * (cz - az)
    window = np.s_[top:bottom, left:right]
    nearer = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (z > depth[window])
    image[window][nearer], depth[window][nearer] = level, z[nearer]


def _bracket() -> Any:
    """The module bracket.py beside this one, which reads STL files."""
    spec = importlib.util.spec_from_file_location("bracket", FOLDER / "bracket.py")
    if spec is None or spec.loader is None:
        raise ImportError("bracket.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(words: list[str] | None = None) -> int:
    """Draw both side by side, and write the description.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0.
    """
    from PIL import Image

    parser = argparse.ArgumentParser(description="Picture of the brackets.")
    parser.add_argument("--out", type=Path, default=FIGURES, help="folder to write to")
    folder, bracket = parser.parse_args(words).out, _bracket()
    folder.mkdir(parents=True, exist_ok=True)
    meshes = [bracket.read_stl(FOLDER / f"bracket_{name}.stl") for name in ("analog", "digital")]
    with atomic_write(folder / "bracket.png") as file:
        Image.fromarray(np.hstack([picture(mesh) for mesh in meshes])).save(
            file, format="PNG", optimize=True
        )
    sizes = [
        " x ".join(f"{side:.0f}" for side in np.ptp(mesh.reshape(-1, 3), axis=0)) for mesh in meshes
    ]
    masses = [f"{bracket.PLA_G_PER_MM3 * bracket.volume(mesh):.1f} g" for mesh in meshes]
    text = f"""Two printed brackets, drawn from their STL files. Left, for the analog camera,
        {sizes[0]} mm, {masses[0]} in PLA: a flat base with two slots for a strap behind, and two
        upright cheeks with a hole near the top of each, between which the camera is screwed and
        tilts. Right, for the digital camera, {sizes[1]} mm, {masses[1]}: two posts on a narrow
        base, two holes in each, a rib behind each post. The holes have a pointed roof, so nothing
        needs support."""
    with atomic_write(folder / "bracket.txt", text=True) as file:
        file.write(" ".join(text.split()) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
