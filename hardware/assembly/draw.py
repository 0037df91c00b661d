"""Pictures of the assembly: manual/assembly.toml and its solids -> PNG files with descriptions.

    .venv/bin/python hardware/assembly/draw.py                 all of them, in half a minute
    .venv/bin/python hardware/assembly/draw.py wing exploded   these
    .venv/bin/python hardware/assembly/draw.py --parts mine.csv --out out

Parallel projection by NumPy and numba, no window and no graphics card: the step's parts in colour,
parts of earlier steps grey, outlines dark, a number of the parts list at each named part, an arrow
where a part moves. Needs the extra `cad` (build123d) for the solids.
"""

import argparse
import importlib.util
import io
import math
import sys
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.vision.marker import Marker

FOLDER = Path(__file__).resolve().parent
MANUAL = FOLDER.parents[1] / "manual"
FIGURES = MANUAL / "figures" / "steps"
SIZE, WIDE = (900, 600), (1500, 1050)  # of a step's picture and of the exploded view [px]
SMOOTH = 2  # oversampling
SUN = np.array([0.42, -0.30, 0.86])  # where the light comes from: ahead, right, above
NEW, OLD = np.array([240.0, 140.0, 40.0]), np.array([226.0, 228.0, 230.0])
DARK, MIDDLE, ARROW = (25, 25, 25), (120, 120, 120), (20, 70, 150)
SEE_THROUGH = 0.28  # share of a ghost in the image
INK = np.array([45.0, 45.0, 45.0])  # of what is printed black
CREASE = 0.93  # cosine between neighbouring faces below which an edge is drawn
TEXT_PX = 25

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
    seen = owner >= 0
    image[seen] = np.clip(colour[owner[seen]] * light[facet[seen], None] * 1.06, 0.0, 255.0)
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
        here, there = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        both = (owner[here] >= 0) & (owner[there] >= 0)
        # A plane seen at a grazing angle has steps too: only a jump that no neighbour continues.
        with np.errstate(invalid="ignore"):
            jump = both & (np.abs(np.where(both, depth[here] - depth[there], 0.0)) > 14.0)
        cosine = (normal[facet[here]] * normal[facet[there]]).sum(axis=-1)
        jump &= cosine > -2.0
        edge = (owner[here] != owner[there]) | (jump & (facet[here] != facet[there]))
        bent = both & ~edge & (cosine < CREASE)
        for mask, found in ((outline, edge), (crease, bent)):
            mask[here] |= found
            mask[there] |= found
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


class Sheet:
    """An image being labelled; coordinates are oversampled pixels."""

    def __init__(self, image: Mesh) -> None:
        from matplotlib import get_data_path
        from PIL import Image, ImageDraw, ImageFont

        self.image = Image.fromarray(np.clip(image, 0.0, 255.0).round().astype(np.uint8))
        self.pen = ImageDraw.Draw(self.image)
        path = Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
        self.font = ImageFont.truetype(str(path), SMOOTH * TEXT_PX)

    def text_box(self, middle: Sequence[float], text: str, colour: tuple[int, ...] = DARK) -> Any:
        """Words on white, centred; the box that they cover."""
        wide = self.pen.textlength(text, font=self.font)
        half = (wide / 2.0 + 5 * SMOOTH, 0.68 * SMOOTH * TEXT_PX)
        box = (
            middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1]
        )  # fmt: skip
        self.pen.rounded_rectangle(
            box, 6 * SMOOTH, fill=(255, 255, 255), outline=colour, width=SMOOTH
        )
        self.pen.text(tuple(middle), text, fill=colour, font=self.font, anchor="mm")
        return box

    def arrow(self, begin: Mesh, end: Mesh, both: bool = False) -> None:
        """A thick arrow, white around it; with two heads for a length."""
        along = end - begin
        length = float(np.hypot(*along))
        if length < 8 * SMOOTH:
            return
        along = along / length
        across = np.array([-along[1], along[0]])
        head = min((16 if not both else 11) * SMOOTH, 0.45 * length)
        heads = [(end, along)] + ([(begin, -along)] if both else [])
        first = begin + along * head * 0.8 if both else begin
        width = 6 if not both else 2
        for extra, colour in ((4, (255, 255, 255)), (0, ARROW)):
            line = [tuple(first), tuple(end - along * head * 0.8)]
            self.pen.line(line, fill=colour, width=(width + extra) * SMOOTH)
            for tip, way in heads:
                grow = extra * 0.7 * SMOOTH
                base = tip - way * head
                wing = across * (0.55 * head + grow)
                corners = [tip + way * grow, base + wing - way * grow, base - wing - way * grow]
                self.pen.polygon([tuple(corner) for corner in corners], fill=colour)

    def callouts(
        self, anchors: Iterable[tuple[str, Mesh]], left_side: dict[str, bool] | None = None
    ) -> None:
        """Labels in two columns beside the drawing, with lines to their parts.

        Args:
            anchors: label and seen pixel of each part.
            left_side: whether a label belongs into the left column; None shares them out.
        """
        wide, high = self.image.size
        placed = list(anchors)
        if left_side is None:
            sides = _sides(placed, wide)
        else:
            ordered = sorted(placed, key=lambda each: float(each[1][1]))
            sides = {
                left: [each for each in ordered if left_side[each[0]] == left]
                for left in (True, False)
            }
        step = 1.62 * SMOOTH * TEXT_PX
        for left, column in sides.items():
            group = _uncrossed(column, 0.0 if left else float(wide), step)
            rows = _spread([at[1] for _, at in group], step, 0.8 * step, high - 0.8 * step)
            for (text, at), row in zip(group, rows, strict=True):
                half = self.pen.textlength(text, font=self.font) / 2.0 + 9 * SMOOTH
                x = half if left else wide - half
                edge = 2.0 * half - 4 * SMOOTH if left else wide - 2.0 * half + 4 * SMOOTH
                self.pen.line([(edge, row), tuple(at)], fill=(255, 255, 255), width=4 * SMOOTH)
                self.pen.line([(edge, row), tuple(at)], fill=DARK, width=SMOOTH)
                dot = 4 * SMOOTH
                self.pen.ellipse((at[0] - dot, at[1] - dot, at[0] + dot, at[1] + dot), fill=DARK)
                self.text_box((x, row), text)

    def png(self) -> bytes:
        """The image at its final size, with a palette."""
        from PIL import Image

        size = (self.image.width // SMOOTH, self.image.height // SMOOTH)
        small = self.image.resize(size, Image.Resampling.BOX)
        small = small.quantize(palette=_palette(), dither=Image.Dither.NONE)
        content = io.BytesIO()
        small.save(content, format="PNG", optimize=True)
        return content.getvalue()


def _palette() -> Any:
    """Greys, and the two colours from dark over full to white, the same for every picture."""
    from PIL import Image

    shares = np.linspace(0.0, 1.0, 15)[1:-1]
    ends = np.array([0.0, 255.0])
    colours = [np.full(3, grey) for grey in np.linspace(0.0, 255.0, 38)]
    for full in (NEW, np.array(ARROW, dtype=float)):
        colours += [full, *(full + share * (end - full) for end in ends for share in shares)]
    veil = 255.0 + SEE_THROUGH * (NEW - 255.0)  # a coloured ghost
    colours += [veil + share * (240.0 - veil) for share in shares]
    image = Image.new("P", (1, 1))
    image.putpalette([round(value) for colour in colours for value in colour])
    return image


def _sides(placed: list[tuple[str, Mesh]], wide: int) -> dict[bool, list[tuple[str, Mesh]]]:
    """Labels of the left (True) and the right column, each from top to bottom, halves at most."""
    ordered = sorted(placed, key=lambda each: float(each[1][0]))
    count = sum(1 for _, at in ordered if at[0] < wide / 2.0)
    most = max(4, math.ceil(0.6 * len(ordered)))
    count = min(max(count, len(ordered) - most), most)
    groups = {True: ordered[:count], False: ordered[count:]}
    return {
        left: sorted(group, key=lambda each: float(each[1][1])) for left, group in groups.items()
    }


def _uncrossed(group: list[tuple[str, Mesh]], x: float, step: float) -> list[tuple[str, Mesh]]:
    """A column's labels in the order in which their lines to the column at x do not cross."""
    group = list(group)
    for _ in range(len(group)):
        for k in range(len(group) - 1):
            (_, a), (_, b) = group[k], group[k + 1]
            rows = [(a[1] + b[1]) / 2.0 - step / 2.0, (a[1] + b[1]) / 2.0 + step / 2.0]
            far = a if abs(a[0] - x) > abs(b[0] - x) else b
            near = b if far is a else a
            row = rows[0] if far is a else rows[1]
            share = (near[0] - x) / (far[0] - x) if far[0] != x else 0.0
            passes = row + share * (far[1] - row)  # of the longer line, above or below the nearer
            if (passes > near[1]) if far is a else (passes < near[1]):
                group[k], group[k + 1] = group[k + 1], group[k]
    return group


def _spread(rows: list[float], step: float, low: float, high: float) -> list[float]:
    """Rising rows at least a step apart, as near to the given ones as going down and up gives."""
    found = []
    for row in rows:
        found.append(max(row, low, found[-1] + step if found else low))
    for k in range(len(found) - 1, -1, -1):
        found[k] = min(found[k], found[k + 1] - step if k + 1 < len(found) else high)
    return found


def anchor(owner: NDArray[np.int64], part: int) -> Mesh | None:
    """The seen pixel of a part that is nearest to the middle of its seen pixels; None if hidden."""
    rows, columns = np.nonzero(owner == part)
    if not len(rows):
        return None
    offset = np.hypot(rows - np.median(rows), columns - np.median(columns))
    best = int(np.argmin(offset))
    return np.array([columns[best], rows[best]], dtype=np.float64)


class Book:
    """All pictures of the steps.

    Args:
        shapes: of assembly.build.
        sources: of assembly.load_sources.
        steps: of manual/assembly.toml.
    """

    def __init__(self, shapes: dict[str, Any], sources: Any, steps: list[dict[str, Any]]) -> None:
        self.shapes, self.sources, self.steps = shapes, sources, steps
        self.meshes: dict[str, Mesh] = {}
        names = {**shapes, **EXTRAS}
        for step in steps:
            picture = step["picture"]
            for key in ("adds", "marks", "takes", "show", "hide", "focus", "ghost", "apart"):
                for name in picture.get(key, []):
                    if name not in names:
                        raise InputError(
                            f"assembly.toml: {step['id']}: {key}: expected one of "
                            f"{', '.join(names)}, got {name!r}"
                        )

    def mesh(self, name: str) -> Mesh:
        """Triangles of a shape or extra in its place."""
        if name not in self.meshes:
            solid = EXTRAS[name](self) if name in EXTRAS else self.shapes[name].solid
            self.meshes[name] = solid if isinstance(solid, np.ndarray) else triangles(solid)
        return self.meshes[name]

    def built(self, step: dict[str, Any]) -> list[str]:
        """Shapes that stand in a step's scene before it, in the order in which they came."""
        names: list[str] = []
        for earlier in self.steps:
            if earlier["id"] == step["id"]:
                break
            picture = earlier["picture"]
            if picture["scene"] == step["picture"]["scene"]:
                names += [name for name in picture.get("adds", []) if name not in names]
                names = [name for name in names if name not in picture.get("takes", [])]
        return names

    def parts(self, step: dict[str, Any]) -> list[Part]:
        """What a step's picture shows."""
        picture = step["picture"]
        new = [
            *picture.get("adds", []), *picture.get("marks", []), *picture.get("takes", [])
        ]  # fmt: skip
        names = picture.get("show", [*self.built(step), *new])
        names = [
            name for name in dict.fromkeys([*names, *new]) if name not in picture.get("hide", [])
        ]
        aside = picture.get("apart", [*picture.get("adds", []), *picture.get("takes", [])])
        share = float(picture.get("share", 0.6))
        found = []
        for name in names:
            moved = np.zeros(3)
            if name in aside and name in self.shapes:
                moved = share * np.array(self.shapes[name].apart)
            label = name
            if PART_OF.get(name, name) in self.shapes:
                label = f"{self.shapes[PART_OF.get(name, name)].number} {name}"
            ghost = name in picture.get("ghost", [])
            found.append(Part(name, label, self.mesh(name) + moved, name in new, ghost, moved))
        return found

    def step_picture(self, step: dict[str, Any]) -> tuple[bytes, str]:
        """PNG and description of a step."""
        picture, parts = step["picture"], self.parts(step)
        points = [part.mesh for part in parts if part.name in picture.get("focus", [])]
        points = points or [part.mesh for part in parts]
        axes = axes_of(*picture.get("view", (35.0, 26.0)))
        grow = float(picture.get("room", 1.0))
        named = picture.get("names", [part.name for part in parts if part.new])
        lengths = [MEASURES[name](self.sources) for name in picture.get("measures", [])]
        points += [np.array([begin, end, end]) for begin, end, _ in lengths]
        cloud = np.concatenate([each.reshape(-1, 3) for each in points])
        across = np.array([float(np.ptp(cloud @ axes[0])), float((cloud @ axes[0]).min())])
        longest = {True: 0, False: 0}  # of the labels left and right
        left = {}
        for part in parts:
            if part.name in named:
                place = float(np.median(part.mesh.reshape(-1, 3) @ axes[0]))
                left[part.label] = place < across[1] + across[0] / 2.0
                side = left[part.label]
                longest[side] = max(longest[side], len(part.label))
        sides = [int(0.62 * TEXT_PX * longest[side]) + 50 for side in (True, False)]
        view = fit(cloud, axes, SIZE, (sides[0], sides[1], int(48 * grow)))
        image, owner = compose(parts, view)
        sheet = Sheet(image)
        self._arrows(sheet, step, parts, view)
        for begin, end, text in lengths:
            first, last = (view.pixels(np.array(point))[:2] for point in (begin, end))
            sheet.arrow(first, last, both=True)
            away = np.array(picture.get("text", [0, -30])) * SMOOTH
            sheet.text_box((first + last) / 2.0 + away, text, ARROW)
        anchors = [
            (part.label, at)
            for k, part in enumerate(parts)
            if part.name in named and (at := anchor(owner, k)) is not None
        ]
        sheet.callouts(anchors, left)
        return sheet.png(), self.describe(step, parts, [text for text, _ in anchors])

    def _arrows(self, sheet: Sheet, step: dict[str, Any], parts: list[Part], view: View) -> None:
        """One arrow for each motion; shapes that move alike share the largest one's."""
        taken = set(step["picture"].get("takes", []))
        groups: dict[tuple[float, ...], Part] = {}
        for part in parts:
            key = tuple(part.moved.tolist())
            if part.moved.any() and (
                key not in groups or np.ptp(part.mesh) > np.ptp(groups[key].mesh)
            ):
                groups[key] = part
        for part in groups.values():
            corners = part.mesh.reshape(-1, 3)
            away = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
            there = away - part.moved
            begin, end = away + 0.22 * (there - away), away + 0.92 * (there - away)
            if part.name in taken:
                begin, end = end, begin
            sheet.arrow(view.pixels(begin)[:2], view.pixels(end)[:2])
        for name, vector in step["picture"].get("arrows", []):
            whole, _, side = name.partition(" ")
            name = name if name in self.meshes or not side else whole
            corners = self.mesh(name).reshape(-1, 3)
            if name == whole and side:  # one half of a pair
                corners = corners[corners[:, 1] > 0.0 if side == "left" else corners[:, 1] < 0.0]
            middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
            ends = np.array([middle, middle + np.array(vector)])
            sheet.arrow(*view.pixels(ends)[:, :2])

    def describe(self, step: dict[str, Any], parts: list[Part], labels: list[str]) -> str:
        """The picture in words, for those who do not see it."""
        taken = step["picture"].get("takes", [])
        new = [part.name for part in parts if part.new and part.name not in taken]
        old = [part.name for part in parts if not part.new]
        moving = [part.name for part in parts if part.moved.any() and part.name not in taken]
        text = f"Drawn, step {step['title']}."
        if new:
            text += f" In colour: {', '.join(new)}."
        if taken:
            text += f" In colour, with an arrow away from its place: {', '.join(taken)}."
        if moving:
            text += f" Arrows lead to the places of {', '.join(moving)}."
        for name in step["picture"].get("measures", []):
            text += f" Marked length: {MEASURES[name](self.sources)[2]}."
        if old:
            text += f" Grey, from earlier steps: {', '.join(old)}."
        return text + (f" Numbers of the parts list: {', '.join(labels)}." if labels else "")

    def exploded(self) -> tuple[bytes, str]:
        """PNG and description of the aircraft with its parts apart."""
        parts = []
        for shape in self.shapes.values():
            if shape.scene == "aircraft" and shape.name != "balance jig":
                moved = np.array(shape.apart)
                added = not any(
                    item.id == shape.part and (item.inside or item.id == "airframe")
                    for item in self.sources.items
                )
                mesh = self.mesh(shape.name) + moved
                label = f"{shape.number} {shape.name}"
                parts.append(Part(shape.name, label, mesh, added, False, moved))
        view = fit(
            np.concatenate([part.mesh for part in parts]), axes_of(52.0, 24.0), WIDE, (165, 165, 30)
        )
        image, owner = shaded(parts, view)
        sheet = Sheet(image)
        anchors = [
            (part.label, at) for k, part in enumerate(parts) if (at := anchor(owner, k)) is not None
        ]
        sheet.callouts(anchors)
        bought = [part.label for part in parts if not part.new]
        added_names = [part.label for part in parts if part.new]
        text = f"""Drawn, exploded view of the aircraft with the numbers of the parts list. Grey,
            of the airframe as bought: {", ".join(bought)}. In colour, added:
            {", ".join(added_names)}."""
        return sheet.png(), " ".join(text.split())


def _aircraft_at(book: Book, x: float, y: float, z: float) -> Mesh:
    """The aircraft without its propeller in the hall, nose along the runway, on its wheels [mm]."""
    names = [
        shape.name
        for shape in book.shapes.values()
        if shape.scene == "aircraft" and shape.name not in ("balance jig", "propeller")
    ]
    mesh = np.concatenate([book.mesh(name) for name in names])
    return mesh + np.array([x, y, z - mesh[..., 2].min()])


def _person_at(book: Book, x: float, y: float) -> Mesh:
    """A person as a cylinder with a head."""
    from build123d import Compound, Plane, Solid

    wide, tall = book.sources.envelope["hall"]["person"]
    head = 0.065 * tall
    solids = [
        Solid.make_cone(0.28 * wide, 0.5 * wide, tall - 2.2 * head, Plane((x, y, 0.0))),
        Solid.make_sphere(head, Plane((x, y, tall - head))),
    ]
    return triangles(Compound(children=solids), 2.0)


def _jig_as_printed(sources: Any) -> Any:
    """Stand and spacer as they lie on the print bed."""
    jig = assembly_script().script("jig")
    return jig.build(jig.load_wing(sources.items, sources.airframe, sources.envelope))


def _battery_at(sources: Any, x: float, y: float) -> Any:
    """The flight battery lying on the bench, 3 mm of bag below it."""
    from build123d import Align, Box, Pos

    low = (Align.CENTER, Align.CENTER, Align.MIN)
    return Pos(x, y, 3.0) * Box(*sources.envelope["aircraft"]["battery"], align=low)


PAD = LandingPad()
PRINTED = ("black cells",)
PART_OF = {"jig as printed": "balance jig", "aircraft": "", "battery in its bag": "battery"}
EXTRAS = {  # drawn to show scale and use; no parts of the list
    "aircraft": lambda book: _aircraft_at(
        book, 1000.0 * PAD.x_start + 1200.0, 1000.0 * PAD.y_centre, 1000.0 * PAD.height
    ),
    "safety pilot": lambda book: _person_at(book, -2500.0, 1000.0 * PAD.y_centre + 1800.0),
    "helper": lambda book: _person_at(
        book, 1000.0 * PAD.x_start + 1500.0, 1000.0 * PAD.y_centre + 700.0
    ),
    "black cells": lambda book: triangles(surroundings().marker_cells()),
    "cable": lambda book: triangles(surroundings().usb_cable()),
    "jig as printed": lambda book: triangles(_jig_as_printed(book.sources)),
    "battery in its bag": lambda book: triangles(_battery_at(book.sources, 240.0, 130.0)),
}


def _measure_lens(sources: Any) -> tuple[Any, Any, str]:
    x, _, z = sources.lens
    return (x, 0.0, 0.0), (x, 0.0, z), f"{z:.0f} mm over the axis"


def _measure_disc(sources: Any) -> tuple[Any, Any, str]:
    x, _, z = sources.lens
    disc = 1000.0 * sources.airframe.propeller.x
    return (x, 0.0, z), (disc, 0.0, z), f"{disc - x:.0f} mm to the disc"


def _measure_mark(sources: Any) -> tuple[Any, Any, str]:
    x = sources.leading_edge
    bottom = sources.wing_top - sources.envelope["aircraft"]["wing_thickness"] - 22.0
    mark = next(1000.0 * item.x for item in sources.items if item.id == "airframe")
    return (x, -90.0, bottom), (x - mark, -90.0, bottom), f"{mark:.1f} mm"


def _measure_pad(sources: Any) -> tuple[Any, Any, str]:
    x, y = 1000.0 * PAD.x_start, 1000.0 * (PAD.y_centre - 0.5 * PAD.width) - 350.0
    return (x, y, 0.0), (x + 1000.0 * PAD.length, y, 0.0), f"{PAD.length:g} x {PAD.width:g} m"


def _measure_marker(sources: Any) -> tuple[Any, Any, str]:
    marker = Marker()
    x, y, z = (1000.0 * float(value) for value in marker.T_world_marker[:3, 3])
    half = 500.0 * marker.size
    return (
        (x, y + half, z - 1.75 * half),
        (x, y - half, z - 1.75 * half),
        (f"black square {1000.0 * marker.size:.0f} mm"),
    )


def _measure_height(sources: Any) -> tuple[Any, Any, str]:
    marker = Marker()
    x, y, z = (1000.0 * float(value) for value in marker.T_world_marker[:3, 3])
    y -= 900.0 * marker.size
    return (x, y, 0.0), (x, y, z), f"{z:.0f} mm up"


MEASURES = {
    "lens_height": _measure_lens,
    "disc_gap": _measure_disc,
    "mark": _measure_mark,
    "pad": _measure_pad,
    "marker": _measure_marker,
    "marker_height": _measure_height,
}


def load_steps(path: Path | None = None) -> list[dict[str, Any]]:
    """The steps of manual/assembly.toml, or of another file."""
    text = (path or MANUAL / "assembly.toml").read_text(encoding="utf-8")
    steps: list[dict[str, Any]] = tomllib.loads(text)["steps"]
    return steps


def assembly_script() -> Any:
    """The module assembly.py beside this one."""
    spec = importlib.util.spec_from_file_location("assembly", FOLDER / "assembly.py")
    if spec is None or spec.loader is None:
        raise ImportError("assembly.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def surroundings() -> Any:
    """The module surroundings.py beside this one."""
    assembly_script()  # which puts this folder on the path
    return importlib.import_module("surroundings")


def main(words: list[str] | None = None) -> int:
    """Draw the named pictures, or all.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0; 1 where a file is wrong, with one sentence.
    """
    parser = argparse.ArgumentParser(description="Pictures of the assembly's steps.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="ids of steps, or exploded")
    parser.add_argument("--parts", help="parts list; the kit's own if not given")
    parser.add_argument("--airframe", help="airframe file; airframe_builder.toml if not given")
    parser.add_argument("--out", type=Path, default=FIGURES, help="folder to write to")
    options = parser.parse_args(words)
    assembly = assembly_script()
    try:
        steps = load_steps()
        sources = assembly.load_sources(options.parts, options.airframe)
        book = Book(assembly.build(sources), sources, steps)
    except (InputError, FileNotFoundError) as mistake:
        print(mistake, file=sys.stderr)
        return 1
    known = [step["id"] for step in steps]
    if set(options.names) - {*known, "exploded"}:
        parser.error(f"expected names of {', '.join(known)}, exploded, got {options.names}")
    options.out.mkdir(parents=True, exist_ok=True)
    drawings = {step["id"]: lambda step=step: book.step_picture(step) for step in steps}
    drawings["exploded"] = book.exploded
    for name, draw in drawings.items():
        if not options.names or name in options.names:
            content, description = draw()
            with atomic_write(options.out / f"{name}.png") as file:
                file.write(content)
            with atomic_write(options.out / f"{name}.txt", text=True) as file:
                file.write(description + "\n")
            print(f"{name}.png: {len(content) / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
