"""Simple solids for envelope drawings: points and sizes in millimetres -> build123d solids."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any


def box(place: Sequence[float], size: Sequence[float], corner: str = "") -> Any:
    """A box by its middle, or with corner "low" by its lowest corner."""
    from build123d import Align, Box, Pos

    align = (Align.MIN if corner else Align.CENTER,) * 3
    return Pos(*place) * Box(*size, align=align)


def rod(begin: Sequence[float], end: Sequence[float], *diameters: float) -> Any:
    """A cylinder from point to point, or a cone with two diameters."""
    from build123d import Plane, Solid, Vector

    along = Vector(*end) - Vector(*begin)
    plane = Plane(origin=tuple(begin), z_dir=tuple(along))
    first, last = diameters[0] / 2.0, diameters[-1] / 2.0
    if len(diameters) == 1 or first == last:
        return Solid.make_cylinder(first, along.length, plane)
    return Solid.make_cone(first, last, along.length, plane)


def tube(path: Sequence[Sequence[float]], diameter: float) -> Any:
    """Cylinders along a path, with balls at its corners."""
    from build123d import Compound, Plane, Solid

    rods = [rod(a, b, diameter) for a, b in pairwise(path)]
    balls = [Solid.make_sphere(diameter / 2.0, Plane(tuple(point))) for point in path[1:-1]]
    return Compound(children=[*rods, *balls])


def strap(path: Sequence[Sequence[float]], wide: float, thick: float) -> Any:
    """A strap along a path across the aircraft, `wide` along x."""
    from build123d import Compound, Plane, Polygon, Pos, extrude

    parts = []
    for (x, y, z), (_, v, w) in pairwise(path):
        flat = Polygon((y, z), (v, w), (v, w + thick), (y, z + thick), align=None)
        parts.append(Pos(x, 0.0, 0.0) * extrude(Plane.YZ * flat, wide / 2.0, both=True))
    return Compound(children=parts)
