"""The arena: the plan of a hall in arena.toml and a seed -> a Gaussian scene; scenes by name; the
leader at a pose.

All is made of surfels, thin Gaussians that lie on surfaces. A flat panel is cut into rectangles
along the edges of what is painted on it, ever finer towards an edge but long beside it: lines stay
straight and sharp while a plain wall costs little. Light is worked out once and kept in the
colours.
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
from falconwing_kit.scene.edit import move
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.sh import SH_C0
from falconwing_kit.scene.camera import require_pose

PLAN = Path(__file__).with_name("arena.toml")
SCENES = ("arena", "hall", "hall_analog", "leader")  # the names that load_scene knows
MARKER_DICTIONARY, MARKER_ID = "DICT_4X4_50", 7  # as in the path-traced hall; the paper names none
OPACITY = 0.99
# standard deviation of a surfel by the side of its rectangle: neighbours leave 3 % at the corners
OVERLAP = 0.66
THICKNESS = 0.002  # standard deviation across a surface [m]
AMBIENT = 0.30  # light that comes from everywhere; 1 shows a white wall white
BOUNCE = (0.34, 0.28, 0.21)  # what the floor throws up, on a surface that faces down
HALL_LOW, HALL_HIGH = np.array([-22.5, -12.0, 0.0]), np.array([17.5, 8.0, 5.0])  # [m]
POSTER_COLOURS = 8
FACES = {  # of a box, with u and v along them; u x v points outward
    **{"+x": ((0, 1, 0), (0, 0, 1)), "-x": ((0, -1, 0), (0, 0, 1)), "+y": ((-1, 0, 0), (0, 0, 1))},
    **{"-y": ((1, 0, 0), (0, 0, 1)), "+z": ((1, 0, 0), (0, 1, 0)), "-z": ((1, 0, 0), (0, -1, 0))},
}
Random = np.random.Generator
Names = NDArray[np.str_]
Palette = dict[str, "Finish"]


@dataclass(frozen=True)
class Finish:
    """What a surface looks like; [palette] of arena.toml."""

    rgb: tuple[float, ...]  # as on a screen, 0..1
    grain: float = 0.05  # spread of the brightness from piece to piece, relative
    piece: tuple[float, float] = (
        0.0,
        0.0,
    )  # a board, tile or sheet along u and v [m]; zero: each surfel is one
    glow: float = 0.0  # radiance of a lamp or window, in that of a white wall in light 1
    varies: bool = False  # another seed gives another hue


@dataclass(frozen=True)
class Panel:
    """A flat piece of the hall that faces along u x v; [[panel]] of arena.toml explains the keys."""

    label: str
    colour: str
    corner: Any  # where u = v = 0 [m]; lists of TOML and arrays will do
    u: Any  # unit vectors along its sides
    v: Any
    size: Any  # along u and v [m]
    cell: Any = (0.3, 0.3)  # the largest rectangle [m]
    edge: float = 0.025  # how wide the strips beside an edge are [m]
    free: bool = False  # its border is seen and needs such strips too
    paint: tuple[
        Mapping[str, Any], ...
    ] = ()  # rectangles, a later one covers an earlier one; "none" cuts a hole
    arcs: tuple[Mapping[str, Any], ...] = ()  # curved lines
    posters: int = 0  # put up at random


class Surfels(NamedTuple):
    """Pieces of surface before they have a colour."""

    label: str
    means: Array  # (N, 3) [m]
    axes: Array  # (N, 3, 3), columns: two along the surface, then the normal
    sides: Array  # (N, 2) [m] along the first two axes
    colours: Names  # (N,) of the palette
    uv: Array  # (N, 2) place on the surface [m]


def load_scene(name: str) -> GaussianScene:
    """A scene that ships with the kit, in the kit's world.

    The arena is built once and kept in the user's cache folder, if it can be; a change of builder
    or plan replaces it.

    Args:
        name: "arena", the hall as `build_arena` gives it; "hall", trained on photos of a
            path-traced hall, without a leader; "hall_analog", the same Gaussians, whose analog
            video link `scene_link` returns; "leader", trained on path-traced turntable
            photos, in its body axes, with nose, tail and wing tips in `points`.

    Raises:
        InputError: no scene of that name ships.
    """
    if name not in SCENES:
        raise InputError(
            f"scene: expected a file or a name that ships ({', '.join(SCENES)}), got {str(name)[:80]!r}"
        )
    if name != "arena":
        file = "leader.npz" if name == "leader" else "hall.npz"
        return GaussianScene.load(Path(__file__).parents[1] / "data" / file)
    version = hashlib.sha256(Path(__file__).read_bytes() + PLAN.read_bytes()).hexdigest()[:12]
    path = cache_folder() / f"arena-{version}.npz"
    try:
        scene = GaussianScene.load(path)
    except (OSError, InputError):  # not there yet, or damaged
        scene = build_arena()
        with suppress(OSError, InputError):  # what cannot be kept can still be used
            path.parent.mkdir(parents=True, exist_ok=True)
            scene.save(path)
            for older in set(path.parent.glob("arena-*.npz")) - {path}:
                older.unlink(missing_ok=True)
    return scene


def build_arena(seed: int = 0) -> GaussianScene:
    """Build the hall of arena.toml, 40 x 20 x 5 m, with its blue pad and marker, and the leader
    aircraft.

    The leader's Gaussians stand in its body axes (x nose, y right wing, z belly, origin in its
    centre of gravity) as if those were the world's. Before you look, place it or take it out with
    `leader_at`.

    Args:
        seed: draws posters, grain and, unless 0, the hues of the walls; everything stays in its
            place.

    Returns:
        About 170 000 Gaussians of SH degree 0, the same bits for the same seed. The labels are
        floor, wall, ceiling, fitting, pad, marker and leader.

    Raises:
        InputError: the seed is not a whole number >= 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"seed: expected a whole number >= 0, got {seed!r}")
    rng, plan = np.random.default_rng(seed), tomllib.loads(PLAN.read_text(encoding="utf-8"))
    palette = _palette(plan["palette"], rng, vary=seed != 0)
    flat = [Panel(**table) for table in plan["panel"]] + [
        face for box in plan["box"] for face in _faces(**box)
    ]
    panels = [
        _with_marker(panel) if panel.label == "marker" else _with_posters(panel, rng)
        for panel in flat
    ]
    hall = [_panel(panel) for panel in panels] + [
        _arc(panel, **arc) for panel in panels for arc in panel.arcs
    ]
    hall += [_loft(**table) for table in plan["loft"]]
    leader = [_loft("leader", **table) for table in plan["leader"]]
    light = [*_light(hall, _lamps(panels, palette))]
    light += [
        np.repeat(0.75 - 0.35 * piece.axes[:, 2, 2:], 3, axis=1) for piece in leader
    ]  # from above: z is down
    return _scene(
        [*hall, *leader],
        light,
        palette,
        rng,
        f"simulated hall, built from arena.toml with seed {seed}",
    )


def leader_at(scene: GaussianScene, T_world_body: ArrayLike | None) -> GaussianScene:
    """The scene with its leader at a pose, or without it.

    Means turn and shift, quaternions turn, and colours that depend on the direction turn with their
    aircraft. In a loop move `load_scene("leader")`, which is small, and join it with the hall.

    Args:
        scene: holds Gaussians labelled "leader" in the leader's body axes, as the arena does;
            `with_leader` gives a hall without one.
        T_world_body: (4, 4) of the leader, "world from body"; None takes the leader out.

    Raises:
        InputError: the scene has no leader or nothing else, or the pose is not a rotation with a
            finite place.
    """
    mask = scene.labelled("leader")
    return (
        scene.selected(~mask)
        if T_world_body is None
        else move(scene, mask, require_pose("T_world_body", T_world_body))
    )


def with_leader(scene: GaussianScene) -> GaussianScene:
    """The scene with a leader in its body axes, for `leader_at`: its own, or else the one that
    ships.
    """
    own = "leader" in scene.label_names and scene.labelled("leader").any()
    return scene if own else GaussianScene.joined(scene, load_scene("leader"))


def _palette(tables: Mapping[str, Any], rng: Random, vary: bool) -> Palette:
    """The finishes by name, some of them in another hue, and the posters' colours."""
    palette, turn = (
        {name: Finish(**table) for name, table in tables.items()},
        rng.uniform(0.15, 0.85),
    )
    for name, finish in palette.items():
        if vary and finish.varies:
            hue, saturation, value = colorsys.rgb_to_hsv(*finish.rgb)
            palette[name] = replace(
                finish, rgb=colorsys.hsv_to_rgb((hue + turn) % 1.0, saturation, value)
            )
    for number in range(POSTER_COLOURS):
        palette[f"poster {number}"] = Finish(
            colorsys.hsv_to_rgb(*rng.uniform((0.0, 0.3, 0.3), (1.0, 0.8, 0.9))), 0.02
        )
    return palette


def _with_posters(panel: Panel, rng: Random) -> Panel:
    """The panel with its posters side by side under everything else, each a sheet with patches."""
    sheets, share = [], np.max(panel.size) / max(1, panel.posters)
    for number in range(panel.posters):
        size = rng.uniform((1.2, 0.8), (2.0, 1.1))
        at = np.array([share * number + rng.uniform(0.2, share - 2.2), rng.uniform(2.5, 2.9)])
        for part in range(6):
            low, high = (
                (np.zeros(2), size)
                if part == 0
                else np.sort(rng.uniform(0.08, 0.92, (2, 2)), axis=0) * size
            )
            colour = f"poster {rng.integers(POSTER_COLOURS)}"
            sheets.append({"colour": colour, "at": at + low, "size": high - low + 0.02})
    return replace(panel, paint=(*sheets, *panel.paint))


def _with_marker(panel: Panel) -> Panel:
    """The marker's board with the white bits on its black square."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARY))
    bits = np.argwhere(
        cv2.aruco.generateImageMarker(dictionary, MARKER_ID, 6)[::-1] > 127
    )  # row from below, column
    square, side = panel.paint[0], panel.paint[0]["size"][0] / 6
    places = np.add(square["at"], side * bits[:, ::-1])
    white = [{"colour": panel.colour, "at": at, "size": (side, side)} for at in places]
    return replace(panel, paint=(square, *white))


def _faces(
    label: str, colour: str, low: ArrayLike, high: ArrayLike, without: str = "", **how: Any
) -> Iterator[Panel]:
    """The sides of a box, but for those that nobody sees."""
    low, high = np.array(low), np.array(high)
    for name, (u, v) in FACES.items():
        if name not in without:
            far = np.minimum(u, v) < 0
            far["xyz".index(name[1])] = name[0] == "+"
            size = np.abs([np.dot(u, high - low), np.dot(v, high - low)])
            yield Panel(label, colour, np.where(far, high, low), u, v, size, free=True, **how)


def _rects(panel: Panel) -> tuple[Array, Array, Names]:
    """Low and high corners (R, 2) and colours of everything painted on a panel, first the panel
    itself.
    """
    low, high, colours = [np.zeros(2)], [np.array(panel.size)], [panel.colour]
    for rect in panel.paint:
        for number in np.ndindex(*rect.get("times", (1, 1))):
            low.append(np.add(rect["at"], np.multiply(number, rect.get("every", 0.0))))
            high.append(low[-1] + rect["size"])
            colours.append(rect["colour"])
    return np.clip(low, 0.0, panel.size), np.clip(high, 0.0, panel.size), np.array(colours)


def _panel_colours(panel: Panel, uv: Array) -> Names:
    """The colour (N,) at places (N, 2) of a panel."""
    low, high, colours = _rects(panel)
    inside = np.all((uv[:, None] > low) & (uv[:, None] < high), axis=2)
    return np.asarray(colours[len(colours) - 1 - np.argmax(inside[:, ::-1], axis=1)])


def _panel(panel: Panel) -> Surfels:
    """A panel cut into rectangles of one colour each."""
    low, high = _cells(panel)
    middle = 0.5 * (low + high)
    colours = _panel_colours(panel, middle)
    keep = (colours != "none") & (_arc_gap(panel, middle) > 0.0)
    return _on_panel(panel, middle[keep], (high - low)[keep], colours[keep], np.zeros(keep.sum()))


def _on_panel(panel: Panel, uv: Array, sides: Array, colours: Names, turn: Array) -> Surfels:
    """Surfels at places (N, 2) of a panel, each turned in it by an angle (N,) [rad]."""
    sides_world, cos, sin = np.array([panel.u, panel.v], np.float64), np.cos(turn), np.sin(turn)
    along = np.stack([cos, sin], axis=1) @ sides_world
    across = np.stack([-sin, cos], axis=1) @ sides_world
    axes = np.stack([along, across, np.cross(along, across)], axis=2)
    return Surfels(panel.label, panel.corner + uv @ sides_world, axes, sides, colours, uv)


def _cells(panel: Panel) -> tuple[Array, Array]:
    """Low and high corners (N, 2) of rectangles that fill a panel and that no painted edge crosses."""
    count = np.maximum(1, np.ceil(np.divide(panel.size, panel.cell) - 1e-9)).astype(int)
    low = np.array(list(np.ndindex(*count))) / count * panel.size
    high, done = low + panel.size / count, []
    rect_low, rect_high, _ = _rects(panel)
    while len(low):
        cuts = np.stack(
            [_cut(panel, low, high, rect_low, rect_high, axis) for axis in (0, 1)], axis=1
        )
        whole = np.isnan(cuts).all(axis=1)
        done.append((low[whole], high[whole]))
        low, high, cuts = low[~whole], high[~whole], cuts[~whole]
        rows, axis = np.arange(len(low)), np.where(np.isnan(cuts[:, 0]), 1, 0)
        upper_low, lower_high = low.copy(), high.copy()
        upper_low[rows, axis] = lower_high[rows, axis] = cuts[rows, axis]
        low, high = np.concatenate([low, upper_low]), np.concatenate([lower_high, high])
    lows, highs = zip(*done, strict=True)
    return np.concatenate(lows), np.concatenate(highs)


def _cut(
    panel: Panel, low: Array, high: Array, rect_low: Array, rect_high: Array, axis: int
) -> Array:
    """Where to cut rectangles (N,) across an axis, nan where they stay whole.

    They are cut at an edge that crosses them, and halved while they are wider than their distance
    to the next edge.
    """
    first, other = 0 if panel.free else 1, 1 - axis  # what is painted first is the panel itself
    edges = np.concatenate([rect_low[first:, axis], rect_high[first:, axis]])
    starts, ends = (np.tile(side[first:, other], 2) for side in (rect_low, rect_high))
    beside = (starts < high[:, None, other] + panel.edge) & (
        ends > low[:, None, other] - panel.edge
    )
    left, right, middle = low[:, None, axis], high[:, None, axis], 0.5 * (low + high)
    gaps = np.where(beside, np.maximum(0.0, np.maximum(left - edges, edges - right)), np.inf)
    limit = np.clip(np.min(gaps, axis=1, initial=np.inf), panel.edge, np.array(panel.cell)[axis])
    near_arc = _arc_gap(panel, middle) < 0.7 * np.max(high - low, axis=1)
    limit = np.where(near_arc, np.minimum(limit, 2.0 * panel.edge), limit)
    cut = np.where((right - left)[:, 0] > 1.5 * limit, middle[:, axis], np.nan)
    crossing = beside & (edges > left + 1e-4) & (edges < right - 1e-4)
    off = np.where(crossing, np.abs(edges - middle[:, axis, None]), np.inf)
    return (
        np.where(np.isfinite(off).any(axis=1), edges[np.argmin(off, axis=1)], cut)
        if len(edges)
        else cut
    )


def _arc_gap(panel: Panel, uv: Array) -> Array:
    """How far places (N, 2) are from the border of the nearest curved line [m], negative on it."""
    gap = np.full(len(uv), np.inf)
    for arc in panel.arcs:
        along, across = (uv - arc["centre"]).T
        start, end = arc.get("span_deg", (0.0, 360.0))
        within = (np.degrees(np.arctan2(across, along)) - start) % 360.0 <= end - start
        off = np.abs(np.hypot(along, across) - arc["radius"]) - 0.5 * arc["width"]
        gap = np.where(within, np.minimum(gap, off), gap)
    return gap


def _arc(
    panel: Panel, colour: str, centre: Any, radius: float, width: float, span_deg: Any = (0, 360)
) -> Surfels:
    """A curved line, two surfels wide, from an angle to another, counted from u to v."""
    start, end = np.radians(span_deg)
    count = int(radius * (end - start) / 0.12)
    angles = np.tile(start + (np.arange(count) + 0.5) / count * (end - start), 2)
    radii = radius + np.repeat([-0.25, 0.25], count) * width
    uv = centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    seen = _panel_colours(panel, uv) != "none"
    uv, angles = uv[seen], angles[seen]
    sides = np.tile((0.12, 0.5 * width), (len(uv), 1))
    return _on_panel(panel, uv, sides, np.full(len(uv), colour), angles + 0.5 * np.pi)


def _loft(
    label: str, along: str, sections: Any, step: float = 0.01, around: int = 24, square: float = 1.0
) -> Surfels:
    """Surfels all around a body with round sections along an axis; square: 1 makes ellipses,
    towards 0 rectangles.
    """
    rows, pieces = np.array([section[:5] for section in sections]), []
    for start, end, section in zip(rows[:-1], rows[1:], sections, strict=False):
        steps = int(np.ceil(np.linalg.norm(end - start) / step))
        s, t = (grid.ravel() for grid in np.mgrid[0.5:steps, 0.5:around])
        s, t, ds, dt = s / steps, t / around, 0.5 / steps, 0.5 / around
        centre, ahead, behind, left, right = (
            _on_loft(along, square, np.outer(1.0 - place, start) + np.outer(place, end), turn)
            for place, turn in ((s, t), (s + ds, t), (s - ds, t), (s, t + dt), (s, t - dt))
        )
        pieces.append((centre, ahead - behind, left - right, np.full(len(s), section[5], "U32")))
    means, length, girth, colours = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    normal = np.cross(girth, length) * (
        -1.0 if along == "y" else 1.0
    )  # outward; y, x, z is a left-handed order
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = length / np.linalg.norm(length, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], axis=2)
    sides = np.abs([np.sum(length * axes[..., 0], axis=1), np.sum(girth * axes[..., 1], axis=1)]).T
    return Surfels(label, means, axes, np.maximum(sides, 1e-3), colours, means[:, :2])


def _on_loft(along: str, square: float, sections: Array, turn: Array) -> Array:
    """Points (N, 3) on sections (N, 5) at turns (N,), 0..1, around them."""
    place, centre_a, centre_b, half_a, half_b = sections.T
    cos, sin = np.cos(2.0 * np.pi * turn), np.sin(2.0 * np.pi * turn)
    a = centre_a + half_a * np.sign(cos) * np.abs(cos) ** square
    b = centre_b + half_b * np.sign(sin) * np.abs(sin) ** square
    return np.stack({"x": (place, a, b), "y": (a, place, b), "z": (a, b, place)}[along], axis=1)


def _lamps(panels: list[Panel], palette: Palette) -> list[tuple[Array, Array, float, Array]]:
    """Whatever glows: its place (3,), normal (3,), area and radiance (3,)."""
    lamps = []
    for panel in panels:
        sides_world = np.array([panel.u, panel.v], np.float64)
        for low, high, name in zip(*_rects(panel), strict=True):
            if name != "none" and palette[name].glow:
                place = panel.corner + 0.5 * (low + high) @ sides_world
                radiance = palette[name].glow * np.power(palette[name].rgb, 2.2)
                lamps.append((place, np.cross(*sides_world), float(np.prod(high - low)), radiance))
    return lamps


def _light(hall: list[Surfels], lamps: list[tuple[Array, Array, float, Array]]) -> Iterator[Array]:
    """Light (N, 3) that falls on each piece of the hall, without shadows.

    E = (ambient + bounce) prod_walls (1 - 1/2 (1 - |n . m|) exp(-d / 0.6 m)) + sum_lamps L A cos a
    cos b / (pi r^2 + A) d is the distance to a wall with normal m, which makes corners darker; the
    sum has the form factor of a small disc [Cohen & Wallace 1993, Radiosity and Realistic Image
    Synthesis, ch. 4].
    """
    for piece in hall:
        points, normal = piece.means, piece.axes[..., 2]
        gaps = np.maximum(0.0, np.stack([points - HALL_LOW, HALL_HIGH - points]))
        openness = np.prod(1.0 - 0.5 * (1.0 - np.abs(normal)) * np.exp(-gaps / 0.6), axis=(0, 2))
        light = openness[:, None] * (AMBIENT + np.outer(0.5 - 0.5 * normal[:, 2], BOUNCE))
        for place, facing, area, radiance in lamps:
            ray = place - points
            square = np.sum(ray * ray, axis=1) + 1e-6
            cosines = (
                np.maximum(0.0, np.sum(ray * normal, axis=1))
                * np.maximum(0.0, -ray @ facing)
                / square
            )
            light += np.outer(cosines * area / (np.pi * square + area), radiance)
        yield light


def _scene(
    pieces: list[Surfels], light: list[Array], palette: Palette, rng: Random, source: str
) -> GaussianScene:
    """All surfels with their colours as one scene."""
    from scipy.spatial.transform import Rotation

    labels = tuple(dict.fromkeys(piece.label for piece in pieces))
    rgb = np.concatenate(
        [_colours(piece, E, palette, rng) for piece, E in zip(pieces, light, strict=True)]
    )
    sides = np.concatenate([piece.sides for piece in pieces])
    quaternions = Rotation.from_matrix(np.concatenate([piece.axes for piece in pieces])).as_quat()
    return GaussianScene(
        means=np.concatenate([piece.means for piece in pieces]),
        quaternions=np.roll(quaternions, 1, axis=1),  # SciPy's have w last
        scales=np.column_stack([OVERLAP * sides, np.full(len(sides), THICKNESS)]),
        opacities=np.full(len(sides), OPACITY),
        sh=((rgb[:, None] - 0.5) / SH_C0).astype(np.float32),
        labels=np.concatenate(
            [np.full(len(piece.means), labels.index(piece.label)) for piece in pieces]
        ),
        label_names=labels,
        source=source,
    )


def _colours(piece: Surfels, light: Array, palette: Palette, rng: Random) -> Array:
    """Colours (N, 3) as on a screen: finish times grain times light, the bright end bent below
    white.
    """
    rgb = np.empty((len(piece.means), 3))
    for name in np.unique(piece.colours):
        finish, own = palette[name], piece.colours == name
        noise = _piece_noise(piece.uv[own], finish.piece, rng) + 0.5 * rng.normal(size=own.sum())
        shown = np.power(finish.rgb, 2.2) * np.exp(finish.grain * noise)[:, None] * light[own]
        rgb[own] = (
            finish.rgb if finish.glow else (1.25 * shown / (1.0 + 0.25 * shown)) ** (1.0 / 2.2)
        )
    return np.clip(rgb, 0.0, 1.0)


def _piece_noise(uv: Array, size: tuple[float, float], rng: Random) -> Array:
    """A number (N,) for the board, tile or sheet that each place (N, 2) lies on; rows are shifted
    by chance.
    """
    if 0.0 in size:
        return rng.normal(size=len(uv))
    row = np.floor(uv[:, 1] / size[1]).astype(int)
    shift = rng.random(np.ptp(row) + 1)[row - row.min()]
    column = np.floor(uv[:, 0] / size[0] + shift).astype(int)
    _, piece = np.unique([row, column], axis=1, return_inverse=True)
    return np.asarray(rng.normal(size=piece.max() + 1)[piece.ravel()])
