"""Camera bracket: a camera file -> STEP to edit, STL to print, mass and overhang of the STL.

    .venv/bin/python hardware/bracket/bracket.py             both cameras of the kit, to this folder
    .venv/bin/python hardware/bracket/bracket.py mine.toml   your own, a copy of camera_analog.toml

Millimetres; x forward along the optical axis, y left, z up, the print bed is z = 0. It prints in
this orientation without support: every horizontal hole has a roof of 45 degrees. Building needs the
extra `cad` (build123d); measuring the STL needs NumPy only.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.hardware.cameras import SHIPPED, CameraHardware, load_camera

FOLDER = Path(__file__).resolve().parent
BASE = 1.6  # thickness of the base plate
WALL = 2.0  # thickness of cheeks and posts
RING = 3.0  # material around a hole, from its edge
PLAY = 0.4  # camera between its cheeks, both sides together
HOLE_PLAY = 0.2  # hole over screw
FREE = 0.5  # between the tilted camera and the base
FOOT = 8.0  # half the length of a cheek where it meets the base
TONGUE, SLOT, SLOT_LENGTH = (
    16.0,
    2.6,
    12.0,
)  # the base goes on behind, with two slots for a strap of 10 mm
POST = 7.0  # width of a post of the plate mount
RIB, RIB_LENGTH, RIB_SHARE = (
    1.6,
    10.0,
    0.75,
)  # rib behind a post: thickness, length on the base, height over the post's
PLA_G_PER_MM3 = 1.24e-3  # data sheets of PLA filament
LARGEST_G = 5.0  # the paper's bracket

Mesh = NDArray[np.float64]


def build(camera: CameraHardware) -> Any:
    """The bracket of a camera.

    Args:
        camera: its box, its screw holes, and how they are reached.

    Returns:
        A build123d solid [mm], lying on z = 0 as it is printed.
    """
    return _cheeks(camera) if camera.mount.kind == "cheeks" else _plate(camera)


def axis_height(camera: CameraHardware) -> float:
    """Height of the lens axis over the print bed, at no tilt: the camera's lowest corner clears the
    base at any tilt.

    z = base + free + max over tilt of (h/2 cos(tilt) + d sin(tilt))  [height of a corner]

    Args:
        camera: its box and its tilt.

    Returns:
        [mm].
    """
    box = camera.body_mm
    reach = max(box.depth_behind, box.lens_ahead) if camera.mount.kind == "cheeks" else 0.0
    tilt = np.radians(np.linspace(0.0, camera.mount.tilt_deg, 50))
    return BASE + FREE + float(np.max(box.height / 2.0 * np.cos(tilt) + reach * np.sin(tilt)))


def _cheeks(camera: CameraHardware) -> Any:
    """Two cheeks with the camera between them; the base ends where the lens would see it."""
    from build123d import Circle, Plane, Polyline, Pos, extrude, make_hull

    mount, inner, z = camera.mount, camera.body_mm.width + PLAY, axis_height(camera)
    front = camera.body_mm.lens_ahead * math.cos(math.radians(mount.tilt_deg)) - 1.0
    outlines = list(Polyline((-FOOT, BASE / 2.0), (FOOT, BASE / 2.0)).edges())
    for ahead, up in mount.holes_mm:
        outlines += (Pos(ahead, z + up) * Circle(_hole(camera) + RING)).edges()
    outline = make_hull(outlines)
    for ahead, up in mount.holes_mm:
        outline -= Pos(ahead, z + up) * _teardrop(_hole(camera))
    cheek = extrude(Plane.XZ * outline, WALL)  # the normal of XZ is -y, the direction of extrusion
    solid = _base(-FOOT - TONGUE, front, inner + 2.0 * WALL)
    return solid + Pos(0, -inner / 2.0, 0) * cheek + Pos(0, inner / 2.0 + WALL, 0) * cheek


def _plate(camera: CameraHardware) -> Any:
    """Two posts that a circuit board is screwed to from the front; ribs on their outer edges leave
    room for nuts.
    """
    from build123d import Align, Box, Plane, Polygon, Pos, Rot, extrude

    z, holes = axis_height(camera), camera.mount.holes_mm
    columns = sorted({right for right, _ in holes})
    top = z + max(up for _, up in holes) + _hole(camera) * math.sqrt(2.0) + RING
    on_bed, depth = (Align.CENTER, Align.CENTER, Align.MIN), RIB_LENGTH + WALL
    solid = _base(-depth, 0.0, columns[-1] - columns[0] + POST, strap=False)
    slope = [(-WALL, BASE), (-depth, BASE), (-WALL, RIB_SHARE * top)]
    rib = extrude(Plane.XZ * Polygon(*slope, align=None), RIB / 2.0, both=True)
    for right in columns:
        edge = math.copysign((POST - RIB) / 2.0, right)
        solid += (
            Pos(-WALL / 2.0, -right, 0) * Box(WALL, POST, top, align=on_bed)
            + Pos(0, -right - edge, 0) * rib
        )
    drill = Rot(0, 0, 90) * extrude(Plane.XZ * _teardrop(_hole(camera)), 2.0 * WALL, both=True)
    for right, up in holes:
        solid -= Pos(0, -right, z + up) * drill
    return solid


def _base(back: float, front: float, width: float, strap: bool = True) -> Any:
    """The plate on the fuselage: foam tape below, and two slots that a strap around the fuselage
    goes through.
    """
    from build123d import Align, Box, Pos

    on_bed = (Align.CENTER, Align.CENTER, Align.MIN)
    solid = Pos((back + front) / 2.0, 0, 0) * Box(front - back, width, BASE, align=on_bed)
    if strap:
        for side in (-1.0, 1.0):
            middle = (back + TONGUE / 2.0, side * (width / 2.0 - RING - SLOT / 2.0), 0)
            solid -= Pos(*middle) * Box(SLOT_LENGTH, SLOT, 3.0 * BASE)
    return solid


def _hole(camera: CameraHardware) -> float:
    """Radius of a screw's hole."""
    return (camera.mount.screw_mm + HOLE_PLAY) / 2.0


def _teardrop(radius: float) -> Any:
    """A circle with a 45 degree roof on top (+y of the sketch), printable without support."""
    from build123d import Circle, Polygon

    touch = radius / math.sqrt(
        2.0
    )  # where tangents of 45 degrees leave the circle; they meet at twice that height
    return Circle(radius) + Polygon((-touch, touch), (touch, touch), (0.0, 2.0 * touch), align=None)


def write(solid: Any, step: Path, stl: Path) -> None:
    """Write both files.

    Args:
        solid: of `build`.
        step: the exact shape, for other CAD programs.
        stl: triangles in binary form, to a hundredth of a millimetre, for the printer.
    """
    from build123d import export_step, export_stl

    export_step(solid, step)
    export_stl(solid, stl, tolerance=0.01, angular_tolerance=0.2)


def read_stl(path: str | Path) -> Mesh:
    """Triangles of a binary STL: 80 bytes, their number, and for each a normal, three corners and
    two bytes.

    Args:
        path: the file.

    Returns:
        (N, 3, 3) corners [mm], counter-clockwise seen from outside.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is no binary STL, or it was cut short.
    """
    content = require_file(path).read_bytes()
    count = int.from_bytes(content[80:84], "little")
    if len(content) < 84 or len(content) != 84 + 50 * count or count == 0:
        raise InputError(
            f"{Path(path).name}: expected a binary STL, got {len(content)} bytes, {count} triangles"
        )
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    return np.frombuffer(content, facet, offset=84)["corners"].astype(np.float64)


def volume(mesh: Mesh) -> float:
    """Volume [mm^3] inside triangles (N, 3, 3): the sum of their tetrahedra with the origin, a . (b
    x c) / 6.
    """
    a, b, c = mesh[:, 0], mesh[:, 1], mesh[:, 2]
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def overhang_deg(mesh: Mesh) -> float:
    """Steepest overhang [deg] of triangles (N, 3, 3): 0 a wall, 90 a ceiling; what lies on the bed
    does not count.
    """
    normal = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    area = np.linalg.norm(normal, axis=1)
    on_bed = np.all(mesh[:, :, 2] < mesh[..., 2].min() + 1e-3, axis=1)
    counted = ~on_bed & (area > 1e-6)
    down = -normal[counted, 2] / area[counted]
    return math.degrees(math.asin(min(1.0, max(0.0, float(down.max())))))


def crossings(mesh: Mesh, axis: int, first: float, second: float) -> Mesh:
    """Where a line along an axis goes in and out of triangles.

    Args:
        mesh: (N, 3, 3) [mm].
        axis: 0 for x, 1 for y, 2 for z.
        first: the lower of the two other coordinates' values, in the order x, y, z [mm].
        second: the higher one's [mm].

    Returns:
        (K,) places along the axis [mm], rising; an even number where the mesh is closed.
    """
    others = [k for k in range(3) if k != axis]
    flat = mesh[:, :, others] - np.array([first, second])
    turned = np.roll(flat, -1, axis=1)
    side = (
        flat[..., 0] * turned[..., 1] - flat[..., 1] * turned[..., 0]
    )  # of each edge; weight of the corner opposite
    total = side.sum(axis=1)
    hit = (np.abs(total) > 1e-12) & (np.all(side > 0.0, axis=1) | np.all(side < 0.0, axis=1))
    weight = np.roll(side[hit], -1, axis=1) / total[hit, None]
    return np.sort((weight * mesh[hit, :, axis]).sum(axis=1))


def main(words: list[str] | None = None) -> int:
    """Build, write and measure.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0 where every bracket weighs at most LARGEST_G and prints without support, else 1.
    """
    parser = argparse.ArgumentParser(description="Camera bracket as STEP and STL.")
    parser.add_argument("camera", nargs="*", help="camera files; the kit's two if none")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to")
    options = parser.parse_args(words)
    options.out.mkdir(parents=True, exist_ok=True)
    fine = True
    for name in options.camera or SHIPPED:
        target = options.out / f"bracket_{Path(name).stem}"
        step, stl = target.with_suffix(".step"), target.with_suffix(".stl")
        with atomic_write(step) as first, atomic_write(stl) as second:
            write(build(load_camera(name)), Path(first.name), Path(second.name))
        mesh = read_stl(stl)
        size, mass_g = np.ptp(mesh.reshape(-1, 3), axis=0), PLA_G_PER_MM3 * volume(mesh)
        fine = fine and mass_g <= LARGEST_G and overhang_deg(mesh) <= 45.5
        print(
            f"{stl.name}: {' x '.join(f'{s:.1f}' for s in size)} mm, {volume(mesh):.0f} mm3, "
            f"{mass_g:.2f} g in PLA, maximum overhang {overhang_deg(mesh):.1f} deg"
        )
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
