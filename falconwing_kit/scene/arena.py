"""The arena: the plan of a hall in arena.toml and a seed -> a Gaussian scene; scenes by name, and the leader moved in it.

Everything is made of surfels, thin Gaussians that lie on surfaces. A flat panel is cut into rectangles along the edges
of what is painted on it, finer towards an edge and long beside it, so that lines stay straight and sharp while a plain
wall costs little. Light is worked out once and kept in the colours.
"""

import colorsys
import hashlib
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.core.config import from_toml
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.ply import SH_C0

PLAN = Path(__file__).with_name("arena.toml")
SCENES = ("arena", "leader")  # the names that load_scene knows
MARKER_DICTIONARY, MARKER_ID = "DICT_4X4_50", 7  # as in the path-traced hall; the paper does not name its own
OPACITY = 0.99
OVERLAP = 0.62  # standard deviation of a surfel by the side of its rectangle: neighbours leave 5 % at the corners
POSTER_COLOURS = 8
MARKER_SIDE = 0.8  # of the black square [m]
AMBIENT = 0.45  # light that comes from everywhere
HALL_LOW, HALL_HIGH = np.float32([-22.5, -12.0, 0.0]), np.float32([17.5, 8.0, 5.0])
_FACES = {  # of a box: u and v along it, u x v outward
    "+x": ((0, 1, 0), (0, 0, 1)),
    "-x": ((0, -1, 0), (0, 0, 1)),
    "+y": ((-1, 0, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, 0, 1)),
    "+z": ((1, 0, 0), (0, 1, 0)),
    "-z": ((1, 0, 0), (0, -1, 0)),
}
THICKNESS = 0.002  # standard deviation across a surface [m]

Triple = tuple[float, float, float]
Pair = tuple[float, float]


@dataclass(frozen=True)
class Finish:
    """What a surface looks like."""

    rgb: Triple  # as on a screen, 0..1
    grain: float = 0.05  # spread of the brightness from piece to piece, relative
    piece: Pair = (0.0, 0.0)  # size of a board, tile or sheet along u and v [m]; zero: every surfel is its own
    glow: float = 0.0  # radiance of a lamp or a window; a white wall in plain light has 1
    varies: bool = False  # another seed gives another hue


@dataclass(frozen=True)
class Rect:
    """Rectangles painted on a panel; a later one covers an earlier one. The colour "none" cuts a hole."""

    colour: str
    at: Pair  # lower left corner in u, v [m]
    size: Pair  # [m]
    every: Pair = (0.0, 0.0)  # distance to the next one along u and v [m]
    times: tuple[int, int] = (1, 1)  # how many there are along u and v


@dataclass(frozen=True)
class Arc:
    """A curved line painted on a panel."""

    colour: str
    centre: Pair  # in u, v [m]
    radius: float  # of its middle [m]
    width: float  # [m]
    span_deg: Pair = (0.0, 360.0)  # from where to where, from u towards v


@dataclass(frozen=True)
class Panel:
    """A flat piece of the hall; it faces along u x v."""

    label: str
    colour: str
    corner: Triple  # where u = v = 0 [m]
    u: Triple  # unit vectors along its sides
    v: Triple
    size: Pair  # along u and v [m]
    cell: Pair = (0.3, 0.3)  # the largest rectangle [m]
    edge: float = 0.025  # the width of the finest strips, beside an edge [m]
    free: bool = False  # its border is seen, so it needs fine strips too
    paint: tuple[Rect, ...] = ()
    arcs: tuple[Arc, ...] = ()
    posters: int = 0  # put up at random, another seed gives others


@dataclass(frozen=True)
class Box:
    """A block with its sides along the world's axes."""

    label: str
    colour: str
    low: Triple  # its lowest corner [m]
    high: Triple  # its highest corner [m]
    cell: float = 0.25  # [m]
    edge: float = 0.025  # [m]
    without: str = ""  # faces that nobody sees, such as "-z +y"
    every: Triple = (0.0, 0.0, 0.0)  # distance to the next one [m]
    times: int = 1


@dataclass(frozen=True)
class Loft:
    """A body with round sections: pipes, rings, and the parts of the aircraft."""

    label: str
    along: str  # "x", "y" or "z": the axis its sections stand on
    sections: tuple[tuple[float, float, float, float, float, str], ...]
    """place along the axis, centre on the two other axes, half width on them [m], and the colour up to the next one"""
    step: float = 0.01  # [m] along the axis
    around: int = 24  # surfels around
    square: float = 1.0  # exponent of the section: 1 is an ellipse, towards 0 a rectangle
    mirrored: bool = False  # a second one with y reversed
    every: Triple = (0.0, 0.0, 0.0)
    times: int = 1


@dataclass(frozen=True)
class Plan:
    """What arena.toml holds."""

    palette: Mapping[str, Finish]
    panel: tuple[Panel, ...]
    box: tuple[Box, ...]
    loft: tuple[Loft, ...]
    leader: tuple[Loft, ...]  # in the leader's body axes


class Surfels(NamedTuple):
    """Pieces of surface before they have a colour."""

    means: Array  # (N, 3) [m]
    axes: Array  # (N, 3, 3), columns: two along the surface and the normal
    sides: Array  # (N, 2) of the piece along the first two axes [m]
    colours: NDArray[np.str_]  # (N,) names of finishes
    label: str
    uv: Array  # (N, 2) place on the panel [m]



def load_scene(name: str) -> GaussianScene:
    """A scene that ships with the kit, in the kit's world.

    The arena is built at the first call and kept in the user's cache folder; a change of the builder or of its plan
    builds it anew. Where that folder cannot be written it is built every time.

    Args:
        name: "arena", the hall with the leader in it, as `build_arena` gives it; or "leader", the leader alone in its
            body axes.

    Raises:
        InputError: no scene of that name ships.
    """
    if name not in SCENES:
        raise InputError(f"scene: want the name of one that ships ({', '.join(SCENES)}) or a file, got {name!r}")
    path = cache_folder() / f"arena-{_version()}.npz"
    try:
        scene = GaussianScene.load(path)
    except (OSError, InputError):  # not there yet, or damaged
        scene = build_arena()
        with suppress(OSError, InputError):  # a cache that cannot be written is no reason to stop
            path.parent.mkdir(parents=True, exist_ok=True)
            scene.save(path)
    return scene if name == "arena" else scene.selected(scene.labelled("leader"))


def cache_folder() -> Path:
    """Where this system keeps what programs can make again; the folder need not exist."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "falconwing"


def build_arena(seed: int = 0) -> GaussianScene:
    """Build the hall of arena.toml: 40 x 20 x 5 m, blue pad, marker, and the leader aircraft.

    The leader stands in its own body axes (x nose, y right wing, z belly, origin in its centre of gravity) as if they
    were the world's: place it with `leader_at` or leave it out with `leader_at(scene, None)` before you look.

    Args:
        seed: grain, posters and, unless 0, the hues of the walls; pad, marker, lines and leader stay the same.

    Returns:
        About 150 000 Gaussians of SH degree 0; the same seed gives the same bits. The labels are floor, wall, ceiling,
        fitting, pad, marker and leader.

    Raises:
        InputError: the seed is not a whole number >= 0, or the plan is not in order.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"seed: want a whole number >= 0, got {seed!r}")
    rng = np.random.default_rng(seed)
    plan = from_toml(Plan, PLAN)
    palette = _palette(plan.palette, rng, seed != 0)
    panels = [_with_posters(panel, rng) for panel in (*plan.panel, *_faces(plan.box), _marker())]
    hall = [*map(_panel, panels), *(s for panel in panels for s in _arcs(panel)), *map(_loft, _copies(plan.loft))]
    leader = list(map(_loft, _copies(plan.leader)))
    light = _light(hall, _lamps(panels, palette))
    return _scene([*hall, *leader], [*light, *map(_sky, leader)], palette, rng, f"built from arena.toml, seed {seed}")


def leader_at(scene: GaussianScene, T_world_body: ArrayLike | None) -> GaussianScene:
    """The scene with its leader at a pose, or without it.

    Means turn and move, quaternions turn, colours of degree 1 to 3 turn with their aircraft. In a loop at 20 Hz, move
    `load_scene("leader")`, which has few Gaussians, and join it with the hall.

    Args:
        scene: holds Gaussians labelled "leader" in the leader's body axes.
        T_world_body: (4, 4) of the leader, "world from body"; None takes the leader out.

    Raises:
        InputError: the scene has no leader, or the pose is not a rotation and a place.
    """
    mask = scene.labelled("leader")
    if T_world_body is None:
        return scene.selected(~mask)
    T_world_body = require_shape("T_world_body", T_world_body, (4, 4))
    R_world_body, p_world = T_world_body[:3, :3], T_world_body[:3, 3]
    rigid = np.isfinite(T_world_body).all() and np.allclose(R_world_body @ R_world_body.T, np.eye(3), atol=1e-4)
    if not rigid or np.linalg.det(R_world_body) < 0.0:
        raise InputError("T_world_body: want a pose, rotation and finite place; build it with core.frames.pose_matrix")
    means, quaternions, sh = scene.means.copy(), scene.quaternions.copy(), scene.sh.copy()
    means[mask] = scene.means[mask] @ R_world_body.T + p_world
    quaternions[mask] = _multiplied(_quaternions(R_world_body[None]), scene.quaternions[mask])
    sh[mask] = _turned(scene.sh[mask], R_world_body)
    return replace(scene, means=means, quaternions=quaternions, sh=sh)


def _turned(sh: NDArray[np.float32], R_world_body: Array) -> NDArray[np.float32]:
    """Colours whose carrier turned: a direction d of the world sees what R^T d saw before.

    Each degree turns in itself. Its matrix follows from Y(R^T d) = Y(d) D on more directions than it has harmonics.
    """
    if sh.shape[1] == 1:
        return sh
    turned, rng = sh.copy(), np.random.default_rng(0)
    directions = rng.normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = _harmonics(directions @ R_world_body), _harmonics(directions)
    for degree in range(1, int(np.sqrt(sh.shape[1]))):
        own = slice(degree**2, (degree + 1) ** 2)
        D = np.linalg.lstsq(after[:, own], before[:, own], rcond=None)[0]
        turned[:, own] = np.einsum("kj,njc->nkc", D, sh[:, own])
    return turned


def _version() -> str:
    """A word that changes with the builder and its plan."""
    return hashlib.sha256(Path(__file__).read_bytes() + PLAN.read_bytes()).hexdigest()[:12]


def _palette(finishes: Mapping[str, Finish], rng: np.random.Generator, vary: bool) -> dict[str, Finish]:
    """The finishes by name, those that vary in a new hue, and eight colours for posters."""
    turn, palette = rng.uniform(0.15, 0.85), dict(finishes)
    for name, finish in finishes.items():
        if finish.varies and vary:
            palette[name] = replace(finish, rgb=_hue_turned(finish.rgb, turn))
    for number in range(POSTER_COLOURS):
        palette[f"poster {number}"] = Finish(_from_hue(rng.random(), rng.uniform(0.5, 0.95), rng.uniform(0.3, 0.9)))
    return palette


def _from_hue(hue: float, saturation: float, value: float) -> Triple:
    red, green, blue = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return red, green, blue


def _hue_turned(rgb: Triple, turn: float) -> Triple:
    hue, saturation, value = colorsys.rgb_to_hsv(*rgb)
    return _from_hue(hue + turn, saturation, value)


def _with_posters(panel: Panel, rng: np.random.Generator) -> Panel:
    """The panel with its posters, each a sheet with five coloured patches."""
    paint = list(panel.paint)
    for _ in range(panel.posters):
        size = rng.uniform((1.2, 0.9), (2.2, 1.4))
        at = rng.uniform((0.5, 1.2), (panel.size[0] - 0.5 - size[0], 1.5))
        for part in range(6):
            low, high = (np.zeros(2), size) if part == 0 else np.sort(rng.uniform(0.08, 0.92, (2, 2)), axis=0) * size
            colour = f"poster {rng.integers(POSTER_COLOURS)}"
            paint.append(Rect(colour, tuple(np.round(at + low, 2)), tuple(np.round(high - low, 2) + 0.02)))
    return replace(panel, paint=tuple(paint))


def _marker() -> Panel:
    """The 80 cm marker on its white board, upright, facing the approach, its centre 0.75 m above the floor."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARY))
    bits = cv2.aruco.generateImageMarker(dictionary, MARKER_ID, 6) > 127
    bit, margin = MARKER_SIDE / 6, 0.5 - MARKER_SIDE / 2
    white = [
        Rect("marker white", (margin + column * bit, margin + (5 - row) * bit), (bit, bit))
        for row, column in np.argwhere(bits)
    ]
    black = Rect("marker black", (margin, margin), (MARKER_SIDE, MARKER_SIDE))
    corner, u, v = (0.0, 0.5, 0.25), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)
    return Panel("marker", "marker white", corner, u, v, (1.0, 1.0), (0.07, 0.07), 0.008, True, (black, *white))


def _faces(boxes: tuple[Box, ...]) -> list[Panel]:
    """The sides of the boxes."""
    panels = []
    for box in boxes:
        for number in range(box.times):
            low, high = (np.array(point) + number * np.array(box.every) for point in (box.low, box.high))
            for name, (u, v) in _FACES.items():
                if name not in box.without.split():
                    far = np.minimum(u, v) < 0.0
                    far["xyz".index(name[1])] = name[0] == "+"
                    corner, size = np.where(far, high, low), (abs(np.dot(u, high - low)), abs(np.dot(v, high - low)))
                    cell = (box.cell, box.cell)
                    panels.append(Panel(box.label, box.colour, tuple(corner), u, v, size, cell, box.edge, True))
    return panels


def _rects(panel: Panel) -> tuple[Array, Array, list[str]]:
    """Low and high corners (R, 2) and colours of everything painted on a panel, the panel itself first."""
    low, high, colours = [(0.0, 0.0)], [panel.size], [panel.colour]
    for rect in panel.paint:
        for i, j in np.ndindex(rect.times):
            at = np.array(rect.at) + (i, j) * np.array(rect.every)
            low, high, colours = [*low, at], [*high, at + rect.size], [*colours, rect.colour]
    return np.clip(low, 0.0, panel.size), np.clip(high, 0.0, panel.size), colours


def _panel(panel: Panel) -> Surfels:
    """A panel cut into rectangles of one colour each."""
    rect_low, rect_high, names = _rects(panel)
    low, high = _cells(panel, rect_low, rect_high)
    middle = 0.5 * (low + high)
    inside = np.all((middle[:, None] > rect_low) & (middle[:, None] < rect_high), axis=2)
    top = len(names) - 1 - np.argmax(inside[:, ::-1], axis=1)
    keep = (np.array(names)[top] != "none") & ~np.any([_on_arc(arc, middle) for arc in panel.arcs], axis=0)
    return _on_panel(panel, middle[keep], (high - low)[keep], np.array(names)[top[keep]])


def _on_panel(panel: Panel, uv: Array, sides: Array, colours: NDArray[np.str_], turn: ArrayLike = 0.0) -> Surfels:
    """Surfels at places (N, 2) of a panel, turned within it by an angle (N,) [rad]."""
    u, v = np.array(panel.u), np.array(panel.v)
    cos, sin = np.cos(turn), np.sin(turn)
    along = np.broadcast_to(np.multiply.outer(cos, u) + np.multiply.outer(sin, v), (len(uv), 3))
    across = np.broadcast_to(np.multiply.outer(cos, v) - np.multiply.outer(sin, u), (len(uv), 3))
    axes = np.stack([along, across, np.broadcast_to(np.cross(u, v), (len(uv), 3))], axis=2)
    return Surfels(np.array(panel.corner) + uv @ np.stack([u, v]), axes, sides, colours, panel.label, uv)


def _cells(panel: Panel, rect_low: Array, rect_high: Array) -> tuple[Array, Array]:
    """Low and high corners (N, 2) of rectangles that fill a panel and that no painted edge crosses.

    A rectangle is cut at an edge that crosses it, or halved while it is wider than its distance to the next edge.
    """
    count = np.maximum(1, np.ceil(np.array(panel.size) / panel.cell - 1e-9)).astype(int)
    grid = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 2)
    step = np.array(panel.size) / count
    low, high, done = grid * step, (grid + 1) * step, []
    while len(low):
        cut = np.stack([_cut(panel, low, high, rect_low, rect_high, axis) for axis in (0, 1)], axis=1)
        whole = np.isnan(cut).all(axis=1)
        done.append(np.stack([low[whole], high[whole]]))
        low, high, cut = low[~whole], high[~whole], cut[~whole]
        axis = np.where(np.isnan(cut[:, 0]), 1, 0)
        rows = np.arange(len(low))
        left_high, right_low = high.copy(), low.copy()
        left_high[rows, axis] = right_low[rows, axis] = cut[rows, axis]
        low, high = np.concatenate([low, right_low]), np.concatenate([left_high, high])
    low, high = np.concatenate(done, axis=1)
    return low, high


def _cut(panel: Panel, low: Array, high: Array, rect_low: Array, rect_high: Array, axis: int) -> Array:
    """Where to cut each rectangle across an axis; nan where it may stay whole."""
    first = 0 if panel.free else 1  # the first painted rectangle is the panel itself
    edges = np.concatenate([rect_low[first:, axis], rect_high[first:, axis]])
    other, reach = 1 - axis, panel.edge
    starts, ends = (np.tile(side[first:, other], 2) for side in (rect_low, rect_high))
    beside = (starts < high[:, None, other] + reach) & (ends > low[:, None, other] - reach)
    left, right = low[:, None, axis], high[:, None, axis]
    middle = 0.5 * (low + high)[:, axis]
    inside = beside & (edges > left + 1e-4) & (edges < right - 1e-4)
    off = np.where(inside, np.abs(edges - middle[:, None]), np.inf)
    gap = np.where(beside, np.maximum(0.0, np.maximum(left - edges, edges - right)), np.inf)
    nearest = np.min(gap, axis=1, initial=np.inf)
    wide = np.clip(0.8 * nearest, panel.edge, panel.cell[axis])
    wide = np.minimum(wide, _arc_limit(panel, 0.5 * (low + high), np.max(high - low, axis=1)))
    cut = np.where(high[:, axis] - low[:, axis] > 1.5 * wide, middle, np.nan)
    return np.where(inside.any(axis=1), edges[np.argmin(off, axis=1)], cut) if len(edges) else cut


def _arc_limit(panel: Panel, middle: Array, side: Array) -> Array:
    """How wide a rectangle may be beside the curved lines [m]."""
    limit = np.full(len(middle), np.inf)
    for arc in panel.arcs:
        gap = np.abs(np.hypot(*(middle - arc.centre).T) - arc.radius) - 0.5 * arc.width - 0.7 * side
        limit = np.minimum(limit, np.where(gap < 0.0, 2.0 * panel.edge, np.inf))
    return limit


def _on_arc(arc: Arc, uv: Array) -> NDArray[np.bool_]:
    """Whether places (N, 2) lie on a curved line."""
    across, along = uv.T[1] - arc.centre[1], uv.T[0] - arc.centre[0]
    start, end = arc.span_deg
    within = (np.degrees(np.arctan2(across, along)) - start) % 360.0 <= end - start
    return np.asarray(within & (np.abs(np.hypot(along, across) - arc.radius) < 0.5 * arc.width))


def _arcs(panel: Panel) -> Iterator[Surfels]:
    """The curved lines of a panel, two surfels wide."""
    low, high, names = _rects(panel)
    for arc in panel.arcs:
        start, end = np.radians(arc.span_deg)
        angles = np.linspace(start, end, int(arc.radius * (end - start) / 0.12) + 1)
        angles = np.tile(0.5 * (angles[1:] + angles[:-1]), 2)
        radii = arc.radius + np.repeat([-0.25, 0.25], len(angles) // 2) * arc.width
        uv = np.array(arc.centre) + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        hole = np.any(
            [np.all((uv > a) & (uv < b), axis=1) for a, b, name in zip(low, high, names, strict=True) if name == "none"],
            axis=0,
        )
        keep = ~hole & np.all((uv > 0.0) & (uv < panel.size), axis=1)
        sides = np.tile((0.12, 0.5 * arc.width), (keep.sum(), 1))
        yield _on_panel(panel, uv[keep], sides, np.full(keep.sum(), arc.colour), angles[keep] + 0.5 * np.pi)


def _copies(lofts: tuple[Loft, ...]) -> Iterator[Loft]:
    """Every loft as often as the plan wants it."""
    for loft in lofts:
        for number in range(loft.times):
            yield replace(loft, every=tuple(number * step for step in loft.every))


def _loft(loft: Loft) -> Surfels:
    """Surfels all around a body with round sections; `every` is where this copy stands."""
    rows = np.array([row[:5] for row in loft.sections])
    pieces = []
    for start, end, section in zip(rows[:-1], rows[1:], loft.sections[:-1], strict=True):
        steps = max(1, int(np.ceil(np.linalg.norm(end - start) / loft.step)))
        s, t = np.meshgrid((np.arange(steps) + 0.5) / steps, (np.arange(loft.around) + 0.5) / loft.around)
        s, t, ds, dt = s.ravel(), t.ravel(), 0.5 / steps, 0.5 / loft.around
        along = _on_loft(loft, start, end, s + ds, t) - _on_loft(loft, start, end, s - ds, t)
        around = _on_loft(loft, start, end, s, t + dt) - _on_loft(loft, start, end, s, t - dt)
        pieces.append((_on_loft(loft, start, end, s, t), along, around, np.full(len(s), section[5])))
    means, along, around = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
    normal = np.cross(around, along)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = along / np.linalg.norm(along, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], axis=2)
    sides = np.abs(np.stack([np.sum(along * axes[:, :, 0], axis=1), np.sum(around * axes[:, :, 1], axis=1)], axis=1))
    colours = np.concatenate([piece[3] for piece in pieces])
    return Surfels(means + loft.every, axes, np.maximum(sides, 1e-3), colours, loft.label, means[:, :2])


def _on_loft(loft: Loft, start: Array, end: Array, s: Array, t: Array) -> Array:
    """Points (N, 3) at fractions s from one section to the next and t around."""
    place, centre_a, centre_b, half_a, half_b = (start[:, None] * (1.0 - s) + end[:, None] * s)
    cos, sin = np.cos(2.0 * np.pi * t), np.sin(2.0 * np.pi * t)
    a = centre_a + half_a * np.sign(cos) * np.abs(cos) ** loft.square
    b = centre_b + half_b * np.sign(sin) * np.abs(sin) ** loft.square
    order = {"x": (place, a, b), "y": (a, place, b), "z": (a, b, place)}[loft.along]
    return np.stack(order, axis=1)


def _lamps(panels: list[Panel], palette: Mapping[str, Finish]) -> tuple[Array, Array, Array]:
    """Whatever glows, in patches of at most 1.2 m: places (L, 3), normals (L, 3) and radiance times area (L, 3)."""
    places, normals, powers = [], [], []
    for panel in panels:
        u, v = np.array(panel.u), np.array(panel.v)
        for low, high, name in zip(*_rects(panel), strict=True):
            if name != "none" and palette[name].glow > 0.0:
                count = np.ceil((high - low) / 1.2).astype(int)
                for cell in np.ndindex(*count):
                    uv = low + (np.array(cell) + 0.5) / count * (high - low)
                    places.append(np.array(panel.corner) + uv[0] * u + uv[1] * v)
                    normals.append(np.cross(u, v))
                    area = np.prod((high - low) / count)
                    powers.append(palette[name].glow * area * _linear(palette[name].rgb))
    return np.array(places), np.array(normals), np.array(powers)


def _light(hall: list[Surfels], lamps: tuple[Array, Array, Array]) -> Iterator[Array]:
    """Light that falls on the surfels of each piece, (N, 3), 1 where a white wall shows white.

    E = ambient * openness + sum_l  L A cos(a) cos(b) / (pi r^2 + A)    [form factor of a small disc, without shadows]
    openness = prod_walls  1 - 1/2 (1 - |n . m|) exp(-d / 0.6 m)         [corners are darker; m the wall's normal]
    """
    places, normals, powers = (array.astype(np.float32) for array in lamps)
    for piece in hall:
        points, normal = piece.means.astype(np.float32), piece.axes[:, :, 2].astype(np.float32)
        light = AMBIENT * _openness(points, normal)[:, None] * np.ones(3, np.float32)
        for place, facing, power in zip(places, normals, powers, strict=True):
            ray = place - points
            square = np.einsum("ni,ni->n", ray, ray)
            cosines = np.maximum(0.0, np.einsum("ni,ni->n", ray, normal)) * np.maximum(0.0, -ray @ facing)
            light += (cosines / (square * (np.pi * square + 1.0) + 1e-6))[:, None] * power
        yield light


def _openness(points: NDArray[np.float32], normal: NDArray[np.float32]) -> NDArray[np.float32]:
    """How much of the hall's plain light reaches the surfels (N,), 0..1."""
    gaps = np.stack([points - HALL_LOW, HALL_HIGH - points])  # (2, N, 3)
    darker = 0.5 * (1.0 - np.abs(normal)) * np.exp(-np.maximum(gaps, 0.0) / 0.6)
    return np.asarray(np.prod(1.0 - darker, axis=(0, 2)), np.float32)


def _sky(piece: Surfels) -> Array:
    """Light on the leader in its body axes: more from above."""
    return np.repeat(0.75 - 0.35 * piece.axes[:, 2:, 2], 3, axis=1)


def _scene(
    pieces: list[Surfels], light: list[Array], palette: Mapping[str, Finish], rng: np.random.Generator, source: str
) -> GaussianScene:
    """All surfels with their colours as one scene."""
    labels = tuple(dict.fromkeys(piece.label for piece in pieces))
    rgb = [_colours(piece, E, palette, rng) for piece, E in zip(pieces, light, strict=True)]
    sides = np.concatenate([piece.sides for piece in pieces])
    scales = np.column_stack([OVERLAP * sides, np.full(len(sides), THICKNESS)])
    return GaussianScene(
        means=np.concatenate([piece.means for piece in pieces]),
        quaternions=_quaternions(np.concatenate([piece.axes for piece in pieces])),
        scales=scales,
        opacities=np.full(len(sides), OPACITY),
        sh=(np.concatenate(rgb)[:, None] - 0.5) / SH_C0,
        labels=np.repeat([labels.index(piece.label) for piece in pieces], [len(piece.means) for piece in pieces]),
        label_names=labels,
        source=source,
    )


def _colours(piece: Surfels, light: Array, palette: Mapping[str, Finish], rng: np.random.Generator) -> Array:
    """Colours (N, 3) as on a screen, 0..1: finish, grain and light."""
    rgb = np.empty((len(piece.means), 3))
    for name in np.unique(piece.colours):
        if name not in palette:
            raise InputError(f"arena.toml: want the name of a finish in [palette], got {name!r}; add it there")
        finish, mask = palette[name], piece.colours == name
        if finish.glow > 0.0:
            rgb[mask] = finish.rgb
            continue
        grain = finish.grain * (_piece_noise(piece.uv[mask], finish.piece, rng) + 0.3 * rng.normal(size=mask.sum()))
        rgb[mask] = _linear(finish.rgb) * np.exp(grain)[:, None] * light[mask]
    return np.where(
        np.isin(piece.colours, [n for n, f in palette.items() if f.glow > 0.0])[:, None], rgb, _screen(rgb)
    )


def _piece_noise(uv: Array, size: Pair, rng: np.random.Generator) -> Array:
    """A number (N,) for the board, tile or sheet that each place lies on; rows are shifted against each other."""
    if 0.0 in size:
        return rng.normal(size=len(uv))
    row = np.floor(uv[:, 1] / size[1]).astype(int)
    row -= row.min()
    column = np.floor(uv[:, 0] / size[0] + rng.random(row.max() + 1)[row]).astype(int)
    _, piece = np.unique(row * 100_000 + column, return_inverse=True)
    return np.asarray(rng.normal(size=piece.max() + 1)[piece])


def _linear(rgb: ArrayLike) -> Array:
    return np.asarray(np.power(rgb, 2.2))


def _screen(light: Array) -> Array:
    """Light as a screen shows it, bright parts bent softly below white."""
    return np.asarray((light / (1.0 + 0.25 * light) * 1.0) ** (1 / 2.2)).clip(0.0, 1.0)


def _quaternions(axes: Array) -> Array:
    """Quaternions (N, 4), w first, of rotations (N, 3, 3) [Bar-Itzhack 2000: 4 q q^T holds every product of entries].

    The row with the largest diagonal is q up to its length, whatever the rotation.
    """
    (a, b, c), (d, e, f), (g, h, i) = axes.transpose(1, 2, 0)
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    outer = np.array(rows).transpose(2, 0, 1)
    best = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    q = outer[np.arange(len(outer)), best]
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def _multiplied(p: Array, q: ArrayLike) -> Array:
    """Hamilton's product of quaternions (1 or N, 4) and (N, 4): first q turns, then p."""
    (pw, px, py, pz), (qw, qx, qy, qz) = np.asarray(p).T, np.asarray(q).T
    w = pw * qw - px * qx - py * qy - pz * qz
    x = pw * qx + px * qw + py * qz - pz * qy
    y = pw * qy - px * qz + py * qw + pz * qx
    z = pw * qz + px * qy - py * qx + pz * qw
    return np.stack([w, x, y, z], axis=1)


def _harmonics(d: Array) -> Array:
    """Real spherical harmonics (M, 16) of unit vectors (M, 3), in the order and with the signs of 3DGS, unnormed.

    Within a degree only their ratios matter for turning colours.
    """
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    one = [np.ones_like(x), -y, z, -x]
    two = [1.0925484 * x * y, -1.0925484 * y * z, 0.3153916 * (2 * zz - xx - yy), -1.0925484 * x * z]
    two += [0.5462742 * (xx - yy)]
    three = [-0.5900436 * y * (3 * xx - yy), 2.8906114 * x * y * z, -0.4570458 * y * (4 * zz - xx - yy)]
    three += [0.3731763 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570458 * x * (4 * zz - xx - yy)]
    three += [1.4453057 * z * (xx - yy), -0.5900436 * x * (xx - 3 * yy)]
    return np.stack([*one, *two, *three], axis=1)
