"""Arena: the plan in arena.toml and a seed -> a hall of Gaussians, its panels cut into cells along
painted edges; scenes by name; the leader.

Everything is made of surfels, thin Gaussians that lie on surfaces. A flat panel is cut into
rectangles along the edges of what is painted on it, finer towards an edge and long beside it: lines
stay straight and sharp, and a plain wall needs few. Light is computed once and kept in the colours.
"""

import colorsys
import hashlib
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import cache_folder
from falconwing_kit.core.frames import HALL_HIGH, HALL_LOW
from falconwing_kit.scene.camera import require_pose
from falconwing_kit.scene.edit import move, require_rng
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.sh import GAMMA, SH_C0

PLAN = Path(__file__).with_name("arena.toml")
SCENES = ("arena", "hall", "hall_analog", "leader")  # names for load_scene
MARKER_DICTIONARY, MARKER_ID = "DICT_4X4_50", 7  # as in the path-traced hall; the paper names none
OPACITY = 0.99
OVERLAP = 0.66  # standard deviation of a surfel by the side of its rectangle: 3 % pass at corners
THICKNESS = 0.002  # standard deviation across a surface [m]
AMBIENT = 0.30  # light from everywhere; 1 shows a white wall white
BOUNCE = (0.34, 0.28, 0.21)  # light reflected by the floor, on a surface that faces down
CORNER_SHADE = 0.6  # distance over which the darkening beside a wall decays [m]
POSTER_COLOURS = 8
WIDTH_RATIO = 1.5  # of a rectangle to its distance from the next edge; wider ones are halved
ARC_REACH = 0.7  # of a rectangle's longer side; it is fine where an arc's border is nearer
EDGE_TOLERANCE = 1e-4  # an edge this near to a rectangle's side does not cut it [m]
FACES = {  # of a box, with u and v along them; u x v points outward
    **{"+x": ((0, 1, 0), (0, 0, 1)), "-x": ((0, -1, 0), (0, 0, 1)), "+y": ((-1, 0, 0), (0, 0, 1))},
    **{"-y": ((1, 0, 0), (0, 0, 1)), "+z": ((1, 0, 0), (0, 1, 0)), "-z": ((1, 0, 0), (0, -1, 0))},
}
Random = np.random.Generator
Names = NDArray[np.str_]
Palette = dict[str, "Finish"]
Lamp = tuple[Array, Array, float, Array]  # position (3,), normal (3,), area, radiance (3,)


@dataclass(frozen=True)
class Finish:
    """Look of a surface; [palette] of arena.toml."""

    rgb: tuple[float, ...]  # on a screen, 0..1
    grain: float = 0.05  # relative spread of the brightness from piece to piece
    # a board, tile or sheet along u and v [m]; zero: each surfel is one
    piece: tuple[float, float] = (0.0, 0.0)
    glow: float = 0.0  # radiance of a lamp or window; 1 is that of a white wall in light 1
    varies: bool = False  # another seed gives another hue


@dataclass(frozen=True)
class Panel:
    """A flat piece of the hall that faces along u x v; [[panel]] of arena.toml."""

    label: str
    colour: str
    corner: Any  # where u = v = 0 [m]; a list of TOML or an array
    u: Any  # unit vectors along its sides
    v: Any
    size: Any  # along u and v [m]
    cell: Any = (0.3, 0.3)  # the largest rectangle [m]
    finest_cell: float = 0.025  # width of the strips beside an edge [m]
    free: bool = False  # its border is visible and has such strips too
    # rectangles, a later one covers an earlier one; "none" cuts a hole
    paint: tuple[Mapping[str, Any], ...] = ()
    arcs: tuple[Mapping[str, Any], ...] = ()  # curved lines
    posters: int = 0  # number of posters at random places


class Surfels(NamedTuple):
    """Pieces of surface without their final colours."""

    label: str
    means: Array  # (N, 3) [m]
    axes: Array  # (N, 3, 3), columns: two along the surface, then the normal
    sides: Array  # (N, 2) [m] along the first two axes
    colours: Names  # (N,) of the palette
    uv: Array  # (N, 2) place on the surface [m]


def load_scene(name: str) -> GaussianScene:
    """A scene that ships with the kit, in the kit's world.

    The arena is built once and kept in the user's cache folder if possible; a change of builder or
    plan replaces it.

    Args:
        name: "arena", the hall of `build_arena`; "hall", trained on photos of a path-traced hall,
            without a leader; "hall_analog", the same Gaussians, whose analog video link
            `scene_link` returns; "leader", trained on path-traced turntable photos, in its body
            axes, with nose, tail and wing tips in `points`.

    Raises:
        InputError: no scene of that name ships.
    """
    if name not in SCENES:
        raise InputError(
            f"scene: expected a file or a name that ships ({', '.join(SCENES)}),"
            f" got {str(name)[:80]!r}"
        )
    if name != "arena":
        file = "leader.npz" if name == "leader" else "hall.npz"
        return GaussianScene.load(Path(__file__).parents[1] / "data" / file)
    version = hashlib.sha256(Path(__file__).read_bytes() + PLAN.read_bytes()).hexdigest()[:12]
    cached_arena = cache_folder() / f"arena-{version}.npz"
    try:
        scene = GaussianScene.load(cached_arena)
    except (OSError, InputError):  # not there yet, or damaged
        scene = build_arena()
        with suppress(OSError, InputError):  # a scene that cannot be cached is still usable
            cached_arena.parent.mkdir(parents=True, exist_ok=True)
            scene.save(cached_arena)
            for older in set(cached_arena.parent.glob("arena-*.npz")) - {cached_arena}:
                older.unlink(missing_ok=True)
    return scene


def build_arena(seed: int = 0) -> GaussianScene:
    """Build the hall of arena.toml, 40 x 20 x 5 m, with its blue pad and marker, and the leader.

    The leader's Gaussians lie in its body axes (x nose, y right wing, z belly, origin in its centre
    of gravity) as if those were the world's; `leader_at` places it or takes it out.

    Args:
        seed: draws posters, grain and, unless 0, the hues of the walls; all geometry is fixed.

    Returns:
        About 170 000 Gaussians of SH degree 0, the same bits for the same seed, labelled floor,
        wall, ceiling, fitting, pad, marker and leader.
    """
    rng, plan = require_rng(seed), tomllib.loads(PLAN.read_text(encoding="utf-8"))
    palette = _palette(plan["palette"], rng, vary=seed != 0)
    flat = [Panel(**table) for table in plan["panel"]]
    flat += [face for box in plan["box"] for face in _faces(**box)]
    panels = [
        _with_marker(panel) if panel.label == "marker" else _with_posters(panel, rng)
        for panel in flat
    ]
    hall = [_panel(panel) for panel in panels]
    hall += [_arc(panel, **arc) for panel in panels for arc in panel.arcs]
    hall += [_loft(**table) for table in plan["loft"]]
    leader = [_loft("leader", **table) for table in plan["leader"]]
    light = [*_light(hall, _lamps(panels, palette))]
    # The leader is lit from above; its body's z points down.
    light += [np.repeat(0.75 - 0.35 * piece.axes[:, 2, 2:], 3, axis=1) for piece in leader]
    source = f"simulated hall, built from arena.toml with seed {seed}"
    return _scene([*hall, *leader], light, palette, rng, source)


def leader_at(scene: GaussianScene, T_world_body: ArrayLike | None) -> GaussianScene:
    """The scene with its leader at a pose (4, 4), or without it where the pose is None.

    Colours that depend on the direction rotate with the aircraft. In a loop, move the small
    `load_scene("leader")` and render it together with the hall.

    Args:
        scene: holds Gaussians labelled "leader" in the leader's body axes, as the arena does;
            `with_leader` adds one to a hall.

    Raises:
        InputError: the scene has no leader or nothing else, or the pose is not rigid.
    """
    mask = scene.labelled("leader")
    if T_world_body is None:
        return scene.selected(~mask)
    return move(scene, mask, require_pose("T_world_body", T_world_body))


def with_leader(scene: GaussianScene) -> GaussianScene:
    """The scene with a leader in its body axes: its own, or else the one that ships."""
    has_leader = "leader" in scene.label_names and scene.labelled("leader").any()
    return scene if has_leader else GaussianScene.joined(scene, load_scene("leader"))


def _palette(tables: Mapping[str, Any], rng: Random, vary: bool) -> Palette:
    """The finishes by name, where asked in another hue, and random colours for posters."""
    palette = {name: Finish(**table) for name, table in tables.items()}
    hue_shift = rng.uniform(0.15, 0.85)
    for name, finish in palette.items():
        if vary and finish.varies:
            hue, saturation, value = colorsys.rgb_to_hsv(*finish.rgb)
            rgb = colorsys.hsv_to_rgb((hue + hue_shift) % 1.0, saturation, value)
            palette[name] = replace(finish, rgb=rgb)
    for number in range(POSTER_COLOURS):
        hsv = rng.uniform((0.0, 0.3, 0.3), (1.0, 0.8, 0.9))
        palette[f"poster {number}"] = Finish(colorsys.hsv_to_rgb(*hsv), 0.02)
    return palette


def _with_posters(panel: Panel, rng: Random) -> Panel:
    """The panel with its posters side by side under all other paint: a sheet and five patches."""
    sheets, share = [], np.max(panel.size) / max(1, panel.posters)
    for number in range(panel.posters):
        size = rng.uniform((1.2, 0.8), (2.0, 1.1))
        corner = np.array([share * number + rng.uniform(0.2, share - 2.2), rng.uniform(2.5, 2.9)])
        for part in range(6):
            low, high = np.zeros(2), size
            if part > 0:
                low, high = np.sort(rng.uniform(0.08, 0.92, (2, 2)), axis=0) * size
            colour = f"poster {rng.integers(POSTER_COLOURS)}"
            sheets.append({"colour": colour, "at": corner + low, "size": high - low + 0.02})
    return replace(panel, paint=(*sheets, *panel.paint))


def _with_marker(panel: Panel) -> Panel:
    """The marker's board with the white bits on its black square."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARY))
    marker = cv2.aruco.generateImageMarker(dictionary, MARKER_ID, 6)
    white_bits = np.argwhere(marker[::-1] > 127)  # of bytes 0 or 255; row from below, column
    square, side = panel.paint[0], panel.paint[0]["size"][0] / 6
    places = np.add(square["at"], side * white_bits[:, ::-1])
    white = [{"colour": panel.colour, "at": at, "size": (side, side)} for at in places]
    return replace(panel, paint=(square, *white))


def _faces(
    label: str, colour: str, low: ArrayLike, high: ArrayLike, without: str = "", **how: Any
) -> Iterator[Panel]:
    """The faces of a box from low to high, except those listed in `without`."""
    low, high = np.array(low), np.array(high)
    for name, (u, v) in FACES.items():
        if name not in without:
            # u and v start at the high corner along an axis where they point backwards.
            at_high = np.minimum(u, v) < 0
            at_high["xyz".index(name[1])] = name[0] == "+"
            size = np.abs([np.dot(u, high - low), np.dot(v, high - low)])
            yield Panel(label, colour, np.where(at_high, high, low), u, v, size, free=True, **how)


def _rects(panel: Panel) -> tuple[Array, Array, Names]:
    """Low and high corners (R, 2) and colours of all rectangles, first the panel itself."""
    low, high, colours = [np.zeros(2)], [np.array(panel.size)], [panel.colour]
    for rect in panel.paint:
        for number in np.ndindex(*rect.get("times", (1, 1))):
            low.append(np.add(rect["at"], np.multiply(number, rect.get("every", 0.0))))
            high.append(low[-1] + rect["size"])
            colours.append(rect["colour"])
    return np.clip(low, 0.0, panel.size), np.clip(high, 0.0, panel.size), np.array(colours)


def _panel_colours(panel: Panel, uv: Array) -> Names:
    """The colour (N,) at places (N, 2) of a panel: that of the last rectangle around each."""
    low, high, colours = _rects(panel)
    inside = np.all((uv[:, None] > low) & (uv[:, None] < high), axis=2)  # (N, R)
    return np.asarray(colours[len(colours) - 1 - np.argmax(inside[:, ::-1], axis=1)])


def _panel(panel: Panel) -> Surfels:
    """A panel cut into rectangles of one colour each."""
    low, high = _cells(panel)
    middle = 0.5 * (low + high)
    colours = _panel_colours(panel, middle)
    keep = (colours != "none") & (_arc_gap(panel, middle) > 0.0)
    return _on_panel(panel, middle[keep], (high - low)[keep], colours[keep], np.zeros(keep.sum()))


def _on_panel(panel: Panel, uv: Array, sides: Array, colours: Names, angle: Array) -> Surfels:
    """Surfels at places (N, 2) of a panel, each rotated in its plane by an angle (N,) [rad]."""
    uv_world, cos, sin = np.array([panel.u, panel.v], np.float64), np.cos(angle), np.sin(angle)
    along = np.stack([cos, sin], axis=1) @ uv_world
    across = np.stack([-sin, cos], axis=1) @ uv_world
    axes = np.stack([along, across, np.cross(along, across)], axis=2)
    return Surfels(panel.label, panel.corner + uv @ uv_world, axes, sides, colours, uv)


def _cells(panel: Panel) -> tuple[Array, Array]:
    """Low and high corners (N, 2) of rectangles that fill a panel and are crossed by no edge."""
    count = np.maximum(1, np.ceil(np.divide(panel.size, panel.cell) - 1e-9)).astype(int)
    low = np.array(list(np.ndindex(*count))) / count * panel.size
    high, done = low + panel.size / count, []
    rect_low, rect_high, _ = _rects(panel)
    while len(low):
        cuts = np.stack(  # (N, 2): across u and across v
            [_cut(panel, low, high, rect_low, rect_high, axis) for axis in (0, 1)], axis=1
        )
        whole = np.isnan(cuts).all(axis=1)
        done.append((low[whole], high[whole]))
        low, high, cuts = low[~whole], high[~whole], cuts[~whole]
        # Cut each of the others in two, along u if it has a cut there, else along v
        rows, axis = np.arange(len(low)), np.where(np.isnan(cuts[:, 0]), 1, 0)
        upper_low, lower_high = low.copy(), high.copy()
        upper_low[rows, axis] = lower_high[rows, axis] = cuts[rows, axis]
        low, high = np.concatenate([low, upper_low]), np.concatenate([lower_high, high])
    lows, highs = zip(*done, strict=True)
    return np.concatenate(lows), np.concatenate(highs)


def _cut(
    panel: Panel, low: Array, high: Array, rect_low: Array, rect_high: Array, axis: int
) -> Array:
    """Where to cut a panel's cells (N,) across an axis, nan where they stay whole.

    They are cut at the most central painted edge that passes through them, and halved while they
    are wider than their distance to the next edge that passes beside them.

    Args:
        panel: the panel.
        low: (N, 2) low corners of the cells, rectangles in u and v [m].
        high: (N, 2) [m].
        rect_low: (R, 2) low corners of the painted rectangles, whose sides are the edges [m].
        rect_high: (R, 2) [m].
        axis: 0 for u, 1 for v.
    """
    first, other = 0 if panel.free else 1, 1 - axis  # what is painted first is the panel itself
    edges = np.concatenate([rect_low[first:, axis], rect_high[first:, axis]])
    edge_starts, edge_ends = (np.tile(side[first:, other], 2) for side in (rect_low, rect_high))
    # (N, edges) whether an edge passes beside or through a cell, and how far away
    passes_cell = edge_starts < high[:, None, other] + panel.finest_cell
    passes_cell &= edge_ends > low[:, None, other] - panel.finest_cell
    cell_low, cell_high, middle = low[:, None, axis], high[:, None, axis], 0.5 * (low + high)
    gaps = np.maximum(0.0, np.maximum(cell_low - edges, edges - cell_high))
    gaps = np.where(passes_cell, gaps, np.inf)
    # Halve what is too wide for its distance, within the panel's finest and largest cells
    nearest = np.min(gaps, axis=1, initial=np.inf)
    limit = np.clip(nearest, panel.finest_cell, np.array(panel.cell)[axis])
    near_arc = _arc_gap(panel, middle) < ARC_REACH * np.max(high - low, axis=1)
    limit = np.where(near_arc, np.minimum(limit, 2.0 * panel.finest_cell), limit)
    cut = np.where((cell_high - cell_low)[:, 0] > WIDTH_RATIO * limit, middle[:, axis], np.nan)
    crossing = passes_cell & (edges > cell_low + EDGE_TOLERANCE)
    crossing &= edges < cell_high - EDGE_TOLERANCE
    offset = np.where(crossing, np.abs(edges - middle[:, axis, None]), np.inf)
    if len(edges) == 0:
        return cut
    return np.where(np.isfinite(offset).any(axis=1), edges[np.argmin(offset, axis=1)], cut)


def _arc_gap(panel: Panel, uv: Array) -> Array:
    """Distance (N,) of places (N, 2) to the border of the nearest arc [m], negative on it."""
    gap = np.full(len(uv), np.inf)
    for arc in panel.arcs:
        along, across = (uv - arc["centre"]).T
        start, end = arc.get("span_deg", (0.0, 360.0))
        within = (np.degrees(np.arctan2(across, along)) - start) % 360.0 <= end - start
        distance = np.abs(np.hypot(along, across) - arc["radius"]) - 0.5 * arc["width"]
        gap = np.where(within, np.minimum(gap, distance), gap)
    return gap


def _arc(
    panel: Panel, colour: str, centre: Any, radius: float, width: float, span_deg: Any = (0, 360)
) -> Surfels:
    """A curved line, two surfels wide, between two angles counted from u to v."""
    start, end = np.radians(span_deg)
    count = int(radius * (end - start) / 0.12)
    angles = np.tile(start + (np.arange(count) + 0.5) / count * (end - start), 2)
    radii = radius + np.repeat([-0.25, 0.25], count) * width
    uv = centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    keep = _panel_colours(panel, uv) != "none"
    uv, angles = uv[keep], angles[keep]
    sides = np.tile((0.12, 0.5 * width), (len(uv), 1))
    return _on_panel(panel, uv, sides, np.full(len(uv), colour), angles + 0.5 * np.pi)


def _loft(
    label: str, along: str, sections: Any, step: float = 0.01, around: int = 24, square: float = 1.0
) -> Surfels:
    """Surfels around a body with sections along an axis; square: 1 ellipses, 0 rectangles."""
    rows, pieces = np.array([section[:5] for section in sections]), []
    for start, end, section in zip(rows[:-1], rows[1:], sections, strict=False):
        steps = int(np.ceil(np.linalg.norm(end - start) / step))
        s, t = (grid.ravel() for grid in np.mgrid[0.5:steps, 0.5:around])
        s, t, ds, dt = s / steps, t / around, 0.5 / steps, 0.5 / around
        # Centres of the cells and the middles of their sides; s runs along the body, t around it
        centre, ahead, behind, left, right = (
            _on_loft(along, square, np.outer(1.0 - place, start) + np.outer(place, end), turn)
            for place, turn in ((s, t), (s + ds, t), (s - ds, t), (s, t + dt), (s, t - dt))
        )
        pieces.append((centre, ahead - behind, left - right, np.full(len(s), section[5], "U32")))
    means, length, girth, colours = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    # Outward: `_on_loft` orders the axes as y, x, z where the body lies along y, left-handed.
    normal = np.cross(girth, length) * (-1.0 if along == "y" else 1.0)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = length / np.linalg.norm(length, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], axis=2)
    spans = [np.sum(length * axes[..., 0], axis=1), np.sum(girth * axes[..., 1], axis=1)]
    sides = np.abs(spans).T
    return Surfels(label, means, axes, np.maximum(sides, 1e-3), colours, means[:, :2])


def _on_loft(along: str, square: float, sections: Array, turn: Array) -> Array:
    """Points (N, 3) on sections (N, 5), at shares (N,) 0..1 of the way around."""
    place, centre_a, centre_b, half_a, half_b = sections.T
    cos, sin = np.cos(2.0 * np.pi * turn), np.sin(2.0 * np.pi * turn)
    a = centre_a + half_a * np.sign(cos) * np.abs(cos) ** square
    b = centre_b + half_b * np.sign(sin) * np.abs(sin) ** square
    return np.stack({"x": (place, a, b), "y": (a, place, b), "z": (a, b, place)}[along], axis=1)


def _lamps(panels: list[Panel], palette: Palette) -> list[Lamp]:
    """Every rectangle that glows."""
    lamps = []
    for panel in panels:
        uv_world = np.array([panel.u, panel.v], np.float64)
        for low, high, name in zip(*_rects(panel), strict=True):
            if name != "none" and palette[name].glow:
                place = panel.corner + 0.5 * (low + high) @ uv_world
                radiance = palette[name].glow * np.power(palette[name].rgb, GAMMA)
                lamps.append((place, np.cross(*uv_world), float(np.prod(high - low)), radiance))
    return lamps


def _light(hall: list[Surfels], lamps: list[Lamp]) -> Iterator[Array]:
    """Irradiance (N, 3) of each piece of the hall, without shadows.

    E = (ambient + bounce) prod_walls (1 - 1/2 (1 - |n . m|) exp(-d / 0.6 m))
        + sum_lamps L A cos a cos b / (pi r^2 + A)

    d is the distance to a wall with normal m, which makes corners darker; the sum has the form
    factor of a small disc [Cohen & Wallace 1993, Radiosity and Realistic Image Synthesis, ch. 4].
    """
    for piece in hall:
        points, normal = piece.means, piece.axes[..., 2]
        gaps = np.maximum(0.0, np.stack([points - HALL_LOW, HALL_HIGH - points]))
        shade = 0.5 * (1.0 - np.abs(normal)) * np.exp(-gaps / CORNER_SHADE)  # (2, N, 3): six walls
        openness = np.prod(1.0 - shade, axis=(0, 2))
        light = openness[:, None] * (AMBIENT + np.outer(0.5 - 0.5 * normal[:, 2], BOUNCE))
        for place, facing, area, radiance in lamps:
            ray = place - points
            square = np.sum(ray * ray, axis=1) + 1e-6
            towards, facing_back = np.sum(ray * normal, axis=1), -ray @ facing
            cosines = np.maximum(0.0, towards) * np.maximum(0.0, facing_back) / square
            light += np.outer(cosines * area / (np.pi * square + area), radiance)
        yield light


def _scene(
    pieces: list[Surfels], light: list[Array], palette: Palette, rng: Random, source: str
) -> GaussianScene:
    """All surfels with their colours as one scene."""
    from scipy.spatial.transform import Rotation

    names = tuple(dict.fromkeys(piece.label for piece in pieces))
    labels = [np.full(len(piece.means), names.index(piece.label)) for piece in pieces]
    lit = zip(pieces, light, strict=True)
    rgb = np.concatenate([_colours(piece, E, palette, rng) for piece, E in lit])
    sides = np.concatenate([piece.sides for piece in pieces])
    quaternions = Rotation.from_matrix(np.concatenate([piece.axes for piece in pieces])).as_quat()
    return GaussianScene(
        means=np.concatenate([piece.means for piece in pieces]),
        quaternions=np.roll(quaternions, 1, axis=1),  # SciPy's have w last
        scales=np.column_stack([OVERLAP * sides, np.full(len(sides), THICKNESS)]),
        opacities=np.full(len(sides), OPACITY),
        sh=((rgb[:, None] - 0.5) / SH_C0).astype(np.float32),
        labels=np.concatenate(labels),
        label_names=names,
        source=source,
    )


def _colours(piece: Surfels, light: Array, palette: Palette, rng: Random) -> Array:
    """Colours (N, 3) on a screen: finish times grain times light, highlights compressed."""
    rgb = np.empty((len(piece.means), 3))
    for name in np.unique(piece.colours):
        finish, rows = palette[name], piece.colours == name
        noise = _piece_noise(piece.uv[rows], finish.piece, rng) + 0.5 * rng.normal(size=rows.sum())
        shown = np.power(finish.rgb, GAMMA) * np.exp(finish.grain * noise)[:, None] * light[rows]
        compressed = (1.25 * shown / (1.0 + 0.25 * shown)) ** (1.0 / GAMMA)
        rgb[rows] = finish.rgb if finish.glow else compressed
    return np.clip(rgb, 0.0, 1.0)


def _piece_noise(uv: Array, size: tuple[float, float], rng: Random) -> Array:
    """A random number (N,) for the board, tile or sheet at each place (N, 2), in shifted rows."""
    if 0.0 in size:
        return rng.normal(size=len(uv))
    row = np.floor(uv[:, 1] / size[1]).astype(int)
    shift = rng.random(np.ptp(row) + 1)[row - row.min()]
    column = np.floor(uv[:, 0] / size[0] + shift).astype(int)
    _, piece = np.unique([row, column], axis=1, return_inverse=True)
    return np.asarray(rng.normal(size=piece.max() + 1)[piece.ravel()])
