"""Projection of triangles to a shaded image with outlines: parts and a view -> colours, seen parts.

Parallel projection by NumPy and numba; no window and no graphics card.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

SMOOTH = 2  # oversampling
SUN = np.array([0.42, -0.30, 0.86])  # where the light comes from: ahead, right, above
NEW, OLD = np.array([240.0, 140.0, 40.0]), np.array([226.0, 228.0, 230.0])
INK = np.array([45.0, 45.0, 45.0])  # of what is printed black
PRINTED = ("black cells",)
PAPER, WHITE = ("marker",), 246.0  # white paper, whatever light falls on it
DARK, MIDDLE = (25, 25, 25), (120, 120, 120)  # outlines, creases
SEE_THROUGH = 0.28  # share of a ghost in the image
STEP_PX = 14.0  # jump of depth that is an outline, oversampled
CREASE = 0.93  # cosine between neighbouring faces below which an edge is drawn

Mesh = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """Parallel projection: image axes in the drawing's."""

    axes: Mesh  # (3, 3) rows: to the right, up, to the eye
    scale: float  # [px/mm], oversampled
    middle: Mesh  # (2,) of the image, right and up [mm]
    size: tuple[int, int]  # [px], oversampled

    def pixels(self, points: Mesh) -> Mesh:
        """(..., 3) points [mm] -> column, row, nearness [px]."""
        seen = points @ self.axes.T
        column = (seen[..., 0] - self.middle[0]) * self.scale + self.size[0] / 2.0
        row = self.size[1] / 2.0 - (seen[..., 1] - self.middle[1]) * self.scale
        return np.stack([column, row, seen[..., 2] * self.scale], axis=-1)


@dataclass(frozen=True)
class Part:
    """What is drawn of a shape."""

    name: str
    label: str  # "1b wing"
    mesh: Mesh  # (N, 3, 3) triangles where they are drawn [mm]
    new: bool
    ghost: bool
    moved: Mesh  # (3,) from its place [mm]


def axes_of(turn_deg: float, lift_deg: float) -> Mesh:
    """Image axes of an eye that is turned to the left of straight ahead and lifted.

    Args:
        turn_deg: 0 sees the aircraft from ahead, -90 from its right side, 180 from behind.
        lift_deg: 0 from its own height, 90 from above; 89 at most.

    Returns:
        (3, 3) rows: to the right, up, to the eye.
    """
    turn, lift = math.radians(turn_deg), math.radians(lift_deg)
    toward = np.array(
        [math.cos(turn) * math.cos(lift), math.sin(turn) * math.cos(lift), math.sin(lift)]
    )
    right = np.array([-math.sin(turn), math.cos(turn), 0.0])
    return np.stack([right, np.cross(toward, right), toward])


def triangles(solid: Any, tolerance: float = 0.25) -> Mesh:
    """(N, 3, 3) triangles of a build123d solid or compound [mm]."""
    corners, faces = solid.tessellate(tolerance, 0.2)
    points = np.array([tuple(corner) for corner in corners])
    return points[np.array(faces, dtype=int)]


@njit
def _rasterise(corners, owners, owner, depth, facet):  # type: ignore[no-untyped-def]
    """Nearest triangle at each pixel: (N, 3, 3) corners in pixels, (N,) owners -> three images."""
    high, wide = depth.shape
    for k in range(len(corners)):
        ax, ay, az = corners[k, 0]
        bx, by, bz = corners[k, 1]
        cx, cy, cz = corners[k, 2]
        twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(twice) < 1e-9:
            continue
        left, right = max(0, int(min(ax, bx, cx))), min(wide - 1, int(max(ax, bx, cx)) + 1)
        top, bottom = max(0, int(min(ay, by, cy))), min(high - 1, int(max(ay, by, cy)) + 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5, row + 0.5
                v = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / twice
                w = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / twice
                if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
                    z = az + v * (bz - az) + w * (cz - az)
                    if z > depth[row, column]:
                        depth[row, column] = z
                        owner[row, column] = owners[k]
                        facet[row, column] = k


def shaded(parts: Sequence[Part], view: View) -> tuple[Mesh, NDArray[np.int64]]:
    """Parts as a shaded image with outlines.

    Returns:
        (H, W, 3) colours 0..255 on white, and (H, W) which part is seen, -1 for none.
    """
    wide, high = view.size
    image = np.full((high, wide, 3), 255.0)
    owner = np.full((high, wide), -1, dtype=np.int64)
    facet, depth = owner.copy(), np.full((high, wide), -np.inf)
    if not parts:
        return image, owner
    mesh = np.concatenate([part.mesh for part in parts])
    owners = np.repeat(np.arange(len(parts)), [len(part.mesh) for part in parts])
    _rasterise(view.pixels(mesh), owners, owner, depth, facet)
    normal = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = 0.66 + 0.34 * np.clip(normal @ (SUN / np.linalg.norm(SUN)), -0.4, 1.0)
    colour = np.array([INK if part.name in PRINTED else NEW if part.new else OLD for part in parts])
    shades = np.clip(colour[owners] * light[:, None] * 1.06, 0.0, 255.0)  # of each triangle
    shades[np.isin(owners, [k for k, part in enumerate(parts) if part.name in PAPER])] = WHITE
    seen = owner >= 0
    image[seen] = shades[facet[seen]]
    outline, crease = _edges(owner, depth, facet, normal)
    image[crease] = 0.45 * image[crease] + 0.55 * np.array(MIDDLE)
    image[outline] = DARK
    return image, owner


def _edges(
    owner: NDArray[np.int64], depth: Mesh, facet: NDArray[np.int64], normal: Mesh
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels on outlines (another part or a step in depth) and on creases (another direction)."""
    outline, crease = (np.zeros(owner.shape, dtype=bool) for _ in range(2))
    for axis in (0, 1):
        # Within one triangle is no edge, and a plane seen at a grazing angle has steps there.
        places = np.nonzero(np.diff(facet, axis=axis))
        here, there = places, (places[0] + (axis == 0), places[1] + (axis == 1))
        both = (owner[here] >= 0) & (owner[there] >= 0)
        with np.errstate(invalid="ignore"):
            jump = both & (np.abs(np.where(both, depth[here] - depth[there], 0.0)) > STEP_PX)
        cosine = (normal[facet[here]] * normal[facet[there]]).sum(axis=-1)
        edge = (owner[here] != owner[there]) | jump
        bent = both & ~edge & (cosine < CREASE)
        for mask, found in ((outline, edge), (crease, bent)):
            for side in (here, there):
                mask[side] |= found
    return outline, crease & ~outline


def compose(parts: Sequence[Part], view: View) -> tuple[Mesh, NDArray[np.int64]]:
    """As `shaded`, with ghosts as a veil over what is behind them."""
    image, owner = shaded(parts, view)
    if not any(part.ghost for part in parts):
        return image, owner
    order = [k for k, part in enumerate(parts) if not part.ghost]
    solid, behind = shaded([parts[k] for k in order], view)
    places = np.array([*order, -1])[behind]
    return SEE_THROUGH * image + (1.0 - SEE_THROUGH) * solid, np.where(places >= 0, places, owner)


def fit(points: Mesh, axes: Mesh, size: tuple[int, int], margin: tuple[int, int, int]) -> View:
    """The view that shows all points.

    Args:
        points: (..., 3) [mm].
        axes: of `axes_of`.
        size: of the final image [px].
        margin: left, right, and above as well as below [px].
    """
    seen = points.reshape(-1, 3) @ axes.T
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    left, right, above = margin
    room = np.array([size[0] - left - right, size[1] - 2.0 * above])
    scale = float(np.min(room / np.maximum(high - low, 1e-6)))
    middle = (low + high) / 2.0 + np.array([(right - left) / 2.0 / scale, 0.0])
    return View(axes, SMOOTH * scale, middle, (SMOOTH * size[0], SMOOTH * size[1]))


def anchor(owner: NDArray[np.int64], part: int) -> Mesh | None:
    """The seen pixel of a part that is nearest to the middle of its seen pixels; None if hidden."""
    rows, columns = np.nonzero(owner == part)
    if not len(rows):
        return None
    offset = np.hypot(rows - np.median(rows), columns - np.median(columns))
    best = int(np.argmin(offset))
    return np.array([columns[best], rows[best]], dtype=np.float64)
