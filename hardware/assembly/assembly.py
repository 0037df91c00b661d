"""Assembly: parts list, airframe, camera and envelope -> solids in place, their clearances, a STEP.

    .venv/bin/python hardware/assembly/assembly.py --out out     assembly.step and a table of places
    .venv/bin/python hardware/assembly/assembly.py --parts mine.csv --out out

Millimetres; x forward, y left, z up from the airframe file's origin, the maker's balance mark on
the propeller's axis. Along the fuselage every part is where the parts list has it. Building needs
the extra `cad`. It is build123d, as for the bracket: cadquery would be a second interface to the
same kernel, and no other part of the kit uses it.
"""

import argparse
import importlib.util
import math
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from falconwing_kit.aircraft.airframe import (
    WHEEL_NAMES,
    Airframe,
    builder_airframe_path,
    load_airframe,
)
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.hardware.cameras import CameraHardware, load_camera
from falconwing_kit.tools.hardware.parts import Item, load_parts
from falconwing_kit.tools.hardware.parts_check import PROPELLER_CLEARANCE

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER))  # this folder is not a package

from solids import box, rod, strap, tube  # noqa: E402
from surroundings import ground, hall  # noqa: E402

HARDWARE = FOLDER.parent
TAPE = 1.0  # foam tape below the bracket [mm]
SCENES = ("aircraft", "ground", "hall")
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Shape:
    """One solid of the drawing."""

    name: str
    part: str  # id of the parts list
    scene: str  # one of SCENES
    number: str  # of the callout: row of the parts list, with a letter where a part has more shapes
    apart: Point  # where it stands in the exploded view, from its place [mm]
    solid: Any  # of build123d, in place [mm]


@dataclass(frozen=True)
class Sources:
    """The files that the assembly is drawn from."""

    items: tuple[Item, ...]
    airframe: Airframe
    camera: CameraHardware
    envelope: dict[str, Any]

    @property
    def leading_edge(self) -> float:
        """Leading edge of the wing's root, ahead of the origin [mm]."""
        if self.airframe.x_leading_edge is None or self.airframe.propeller is None:
            raise InputError(
                f"{self.airframe.name}: expected leading_edge_x_m and propeller, got none;"
                " use a copy of airframe_builder.toml"
            )
        return 1000.0 * self.airframe.x_leading_edge

    def ahead(self, part: str) -> float:
        """Place of a part of the list, ahead of the origin [mm].

        Raises:
            InputError: the list has no such part, or no place for it.
        """
        item = next((item for item in self.items if item.id == part), None)
        if item is None or item.x is None:
            raise InputError(
                f"parts: expected {part} with x_mm to draw it, got "
                f"{'no such row' if item is None else 'none'}; add it to the list"
            )
        return self.leading_edge - 1000.0 * item.x

    @property
    def lens(self) -> Point:
        """Front of the lens by the airframe file, in the drawing's axes [mm]."""
        x, y, z = self.airframe.p_body_camera
        return 1000.0 * x, -1000.0 * y, -1000.0 * z

    @property
    def wing_top(self) -> float:
        """Upper side of the wing [mm]: below the lens axis by bracket and foam tape."""
        return self.lens[2] - script("bracket").axis_height(self.camera) - TAPE


def script(name: str) -> Any:
    """A program of hardware/ as a module: "bracket" or "jig"."""
    spec = importlib.util.spec_from_file_location(name, HARDWARE / name / f"{name}.py")
    if spec is None or spec.loader is None:
        raise ImportError(f"hardware/{name}/{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def load_sources(
    parts: str | Path | None = None,
    airframe: str | Path | None = None,
    camera: str | Path = "analog",
) -> Sources:
    """Read all files; None takes the kit's own.

    Raises:
        InputError: a file is wrong, or envelope.toml names a part that the list does not have.
    """
    envelope = tomllib.loads((FOLDER / "envelope.toml").read_text(encoding="utf-8"))
    items = load_parts(parts)
    rows = {item.id for item in items}
    missing = sorted({shape["part"] for shape in envelope["shape"]} - rows)
    if missing:
        raise InputError(f"envelope.toml: expected parts of the list, got {', '.join(missing)}")
    frame = load_airframe(builder_airframe_path() if airframe is None else airframe)
    return Sources(items, frame, load_camera(camera), envelope)


def numbers(sources: Sources) -> dict[str, str]:
    """Callout of every part and shape: "4" for the list's fourth row; of several shapes "4a", "4b".

    Returns:
        By id of the list, and by "id.shape" for each shape.
    """
    found = {item.id: str(row) for row, item in enumerate(sources.items, 1)}
    for part in list(found):
        names = [s["name"] for s in sources.envelope["shape"] if s["part"] == part]
        for letter, name in zip("abcdefghijklmnopqrstuvwxyz", names, strict=False):
            found[f"{part}.{name}"] = found[part] + (letter if len(names) > 1 else "")
    return found


def build(sources: Sources) -> dict[str, Shape]:
    """Every shape of envelope.toml in its place.

    Args:
        sources: of `load_sources`.

    Returns:
        By name, in the file's order.

    Raises:
        InputError: a shape of the file has no drawing here, or a part no place in the list.
    """
    size = sources.envelope
    solids = {
        **aircraft(sources),
        **ground(size["ground"]),
        **hall(size["hall"]["board_thickness"]),
    }
    known, shapes = numbers(sources), {}
    for row in sources.envelope["shape"]:
        name, part = row["name"], row["part"]
        if name not in solids or row["scene"] not in SCENES:
            raise InputError(
                f"envelope.toml: expected one of {', '.join(solids)} in a scene of "
                f"{', '.join(SCENES)}, got {name!r} in {row['scene']!r}"
            )
        number = known[f"{part}.{name}"]
        apart = tuple(float(value) for value in row["apart"])
        shapes[name] = Shape(name, part, row["scene"], number, apart, solids[name])
    return shapes


def aircraft(sources: Sources) -> dict[str, Any]:
    """Solids of the aircraft and of the jig below its wing."""
    return {
        **_body(sources),
        **_wing(sources),
        **_tail(sources),
        **_running(sources),
        **_added(sources),
    }


def _body(sources: Sources) -> dict[str, Any]:
    """Fuselage with its cabin up to the wing."""
    from build123d import Plane, Pos, RectangleRounded, loft

    size, edge = sources.envelope["aircraft"], sources.leading_edge
    sections = [
        Plane.YZ.offset(x)
        * Pos(0.0, (up - down) / 2.0)
        * RectangleRounded(2.0 * half, up + down, 0.45 * min(2.0 * half, up + down))
        for x, half, up, down in size["fuselage"]
    ]
    body = loft(sections, ruled=True)
    chord = 1000.0 * sources.airframe.mean_chord
    top = sources.wing_top - size["wing_thickness"] / 2.0
    wide, long = 2.0 * size["cabin_half_width"], chord + 10.0
    cabin = box((edge - chord - 5.0, 0.0, 0.0), (long, wide, top), corner="low")
    front = loft(
        [
            Plane.YZ.offset(edge + 5.0) * Pos(0.0, top / 2.0) * RectangleRounded(wide, top, 2.0),
            Plane.YZ.offset(edge + 32.0) * Pos(0.0, 13.0) * RectangleRounded(wide, 26.0, 2.0),
        ],
        ruled=True,
    )
    return {"fuselage": body + cabin + front}


def _wing(sources: Sources) -> dict[str, Any]:
    """Wing of the airframe's span and chord, with its surfaces cut out behind."""
    from build123d import Compound, Plane, Polygon, Pos, extrude

    size, edge = sources.envelope["aircraft"], sources.leading_edge
    chord, half = 1000.0 * sources.airframe.mean_chord, 500.0 * sources.airframe.span
    thick, gap = size["wing_thickness"], size["surface_gap"]
    middle = sources.wing_top - thick / 2.0
    steps = [(1.0 - math.cos(math.pi * k / 12.0)) / 2.0 for k in range(13)]
    upper = [(edge - chord * s, middle + thick * _naca(s)) for s in steps]
    lower = [(edge - chord * s, middle - thick * _naca(s)) for s in reversed(steps[:-1])]
    outline = Plane.XZ * Polygon(*upper, *lower, align=None)
    wing = extrude(outline, half, both=True)
    found = {"ailerons": [], "flaps": []}
    for name, (inner, outer, depth) in (("ailerons", size["aileron"]), ("flaps", size["flap"])):
        for side in (-1.0, 1.0):
            place = (edge - chord + depth / 2.0, side * (inner + outer) / 2.0, middle)
            cut = box(place, (depth + 0.2, outer - inner, 3.0 * thick))
            keep = box(
                (place[0] - gap / 2.0, place[1], middle),
                (depth - gap, outer - inner - gap, 3.0 * thick),
            )
            found[name].append(wing & keep)
            wing -= Pos(0.0, 0.0, 0.0) * cut
    return {"wing": wing, **{name: Compound(children=each) for name, each in found.items()}}


def _naca(s: float) -> float:
    """Half thickness of a four-digit section, of its whole thickness, at a share s of the chord.

    y = 5 (0.2969 sqrt(s) - 0.126 s - 0.3516 s^2 + 0.2843 s^3 - 0.1036 s^4)  [Jacobs 1933, closed]
    """
    return 5.0 * (0.2969 * math.sqrt(s) + s * (-0.126 + s * (-0.3516 + s * (0.2843 - 0.1036 * s))))


def _tail(sources: Sources) -> dict[str, Any]:
    """Stabiliser, fin, their surfaces, and the links to them."""
    from build123d import Compound

    size, frame = sources.envelope["aircraft"], sources.airframe
    end = 1000.0 * (frame.p_body_nose[0] - frame.length)  # the airframe's length from its nose
    chord, depth, thick = size["tail_chord"], size["tail_surface"], size["tail_thickness"]
    gap, half, top = size["surface_gap"], size["tail_half_span"], size["fin_top"]
    base = size["fuselage"][-1][2] - thick
    hinge = end + depth
    found = {
        "stabiliser": box((hinge, -half, base), (chord - depth, 2.0 * half, thick), corner="low"),
        "elevator": box((end, -half, base), (depth - gap, 2.0 * half, thick), corner="low"),
        "fin": box(
            (hinge, -thick / 2.0, base + thick),
            (chord - depth, thick, top - base - thick),
            corner="low",
        ),
        "rudder": box(
            (end, -thick / 2.0, base + thick + 3.0),
            (depth - gap, thick, top - base - thick - 3.0),
            corner="low",
        ),
    }
    rods = [
        tube([(-60.0, side * 32.0, 8.0), (hinge - 6.0, side * 11.0, base + up)], 1.6)
        for side, up in ((-1.0, -3.0), (1.0, thick + 8.0))
    ]
    return {**found, "links": Compound(children=rods)}


def _running(sources: Sources) -> dict[str, Any]:
    """Gear by the airframe's wheels, motor and propeller."""
    from build123d import Compound

    size, frame = sources.envelope["aircraft"], sources.airframe
    wheel, wide = size["wheel"]
    legs, places = [], {key: _drawn(getattr(frame.wheels, key)) for key in WHEEL_NAMES}
    for key in ("main_left", "main_right"):
        x, y, z = places[key]
        hub = (x, y, z + wheel / 2.0)
        legs += [
            rod((x, y - wide / 2.0, hub[2]), (x, y + wide / 2.0, hub[2]), wheel),
            tube([(x - 8.0, 0.4 * y / abs(y) * 40.0, -32.0), hub], 3.0),
        ]
    x, y, z = places["tail"]
    small = wheel / 2.0
    tail = [
        rod((x, -wide / 4.0, z + small / 2.0), (x, wide / 4.0, z + small / 2.0), small),
        tube([(x + 6.0, 0.0, 4.0), (x, 0.0, z + small / 2.0)], 2.0),
    ]
    disc, diameter = _disc(sources), 1000.0 * _propeller(sources).diameter
    shaft, long = size["motor"]
    blade, thick = size["blade"]
    face = size["fuselage"][0][0]
    blades = [
        box((disc - thick / 2.0, 0.0, 0.0), (thick, blade, diameter)),
        rod((face + 2.0, 0.0, 0.0), (disc, 0.0, 0.0), 18.0, 8.0),
    ]
    return {
        "main gear": Compound(children=legs),
        "tail wheel": Compound(children=tail),
        "motor": rod((face - long, 0.0, 0.0), (face + 1.0, 0.0, 0.0), shaft),
        "propeller": Compound(children=blades),
    }


def _added(sources: Sources) -> dict[str, Any]:
    """What the builder adds: each along the fuselage where the list has it."""
    from build123d import Compound, Pos

    size, camera = sources.envelope["aircraft"], sources.camera.body_mm
    lens, up = sources.lens, sources.lens[2]
    screw_line = sources.ahead("camera_analog")
    back = screw_line - camera.depth_behind
    body = box(
        (back, lens[1] - camera.width / 2.0, up - camera.height / 2.0),
        (camera.depth_behind + 0.4 * camera.lens_ahead, camera.width, camera.height),
        corner="low",
    )
    tip = screw_line + camera.lens_ahead
    optic = rod(
        (tip - 0.7 * camera.lens_ahead, lens[1], up), (tip, lens[1], up), 0.6 * camera.height
    )
    wide, high = size["antenna"]
    bracket = Pos(_bracket_at(sources), 0.0, sources.wing_top + TAPE) * script("bracket").build(
        sources.camera
    )
    low, far = bracket.bounding_box().min, bracket.bounding_box().max
    screws = []
    for side in (-1.0, 1.0):
        y = side * (camera.width / 2.0 + 2.4)
        screws += [
            rod((screw_line, y - side * 4.0, up), (screw_line, y, up), 2.0),
            rod((screw_line, y, up), (screw_line, y + side * 1.5, up), 3.8),
        ]
    across, thin, reach = size["band"]
    behind = low.X + 8.0
    band = [
        box((behind, 0.0, sources.wing_top + TAPE + 2.2), (across, 2.0 * 9.0, thin)),
        *(
            strap(
                [(behind, side * 9.0, sources.wing_top + TAPE + 2.2),
                 (behind, side * 14.0, sources.wing_top + 0.5),
                 (behind, side * reach, sources.wing_top + 0.3)],
                across, thin,
            )
            for side in (-1.0, 1.0)
        ),
    ]  # fmt: skip
    found = {
        "camera": body + optic,
        "antenna": rod((back + 2.0, 4.0, up + camera.height / 2.0),
                        (back - 4.0, 4.0, up + camera.height / 2.0 + high), wide),
        "bracket": bracket,
        "screws": Compound(children=screws),
        "foam tape": box((low.X, low.Y, sources.wing_top),
                          (far.X - low.X - 2.0, far.Y - low.Y, TAPE), corner="low"),
        "band": Compound(children=band),
        "battery": box((sources.ahead("battery"), 0.0, size["battery_up"]), size["battery"]),
        "receiver": box((sources.leading_edge - size["receiver_x"], 0.0, size["receiver_up"]),
                         size["receiver"]),
        "balance jig": _jig_in_place(sources),
    }  # fmt: skip
    for name in ("inductor", "capacitor", "resistor"):
        thick, long, left, height = size[name]
        x = sources.ahead(f"filter_{name}")
        found[name] = rod((x - long / 2.0, left, height), (x + long / 2.0, left, height), thick)
    return {**found, "wires": Compound(children=_wires(sources, back))}


def _wires(sources: Sources, back: float) -> list[Any]:
    """The plus wire: battery, resistor, inductor, the capacitor's joint, camera; it passes the wing
    where the list has the wires.

    Args:
        sources: of `load_sources`.
        back: of the camera's body [mm].
    """
    size, up = sources.envelope["aircraft"], sources.lens[2]
    ends = {}  # front and back of each part of the filter
    for name in ("resistor", "inductor", "capacitor"):
        _, long, left, height = size[name]
        x = sources.ahead(f"filter_{name}")
        ends[name] = [(x + side * long / 2.0, left, height) for side in (1.0, -1.0)]
    (front, rear), (coil, coil_rear), joint = (
        ends["resistor"], ends["inductor"], ends["capacitor"][0]
    )  # fmt: skip
    start = sources.ahead("battery") - size["battery"][0] / 2.0
    ahead, behind = max(coil[0], joint[0]) + 3.0, min(rear[0], coil_rear[0]) - 3.0
    x, out = sources.ahead("wires"), front[1]
    paths = [
        [(start, out, size["battery_up"]), (ahead, out, front[2]), front],
        [rear, (behind, *rear[1:]), (behind, *coil_rear[1:]), coil_rear],
        [coil, (ahead, *coil[1:]), (ahead, *joint[1:]), joint],
        [
            (ahead, *joint[1:]),
            (ahead, out / 2.0, joint[2] + 12.0),
            (x + 4.0, out + 4.0, 40.0),
            (x, out + 6.0, up - 4.0),
            (back - 3.0, out + 6.0, up - 4.0),
            (back, 4.0, up - 2.0),
        ],
    ]
    return [tube(path, size["wire"]) for path in paths]


def _bracket_at(sources: Sources) -> float:
    """Screw line of the bracket, where its centre of mass is at the list's place [mm]."""
    solid = script("bracket").build(sources.camera)
    return sources.ahead("bracket") - float(solid.center().X)


def _jig_in_place(sources: Sources) -> Any:
    """Both stands below the wing, the ridge at the mark."""
    from build123d import Compound, Pos

    jig = script("jig")
    wing = jig.load_wing(sources.items, sources.airframe, sources.envelope)
    bottom = sources.wing_top - sources.envelope["aircraft"]["wing_thickness"]
    x = sources.leading_edge - wing.mark
    places = [Pos(x, side * 90.0, bottom - jig.RIDGE_HEIGHT) for side in (-1.0, 1.0)]
    return Compound(children=[place * jig.stand(wing) for place in places])


def _disc(sources: Sources) -> float:
    """Plane of the propeller's disc [mm]."""
    return 1000.0 * _propeller(sources).x


def _propeller(sources: Sources) -> Any:
    _ = sources.leading_edge  # says what is missing
    return sources.airframe.propeller


def clearances(shapes: dict[str, Shape], sources: Sources) -> dict[str, float]:
    """Distances that the build depends on, computed from the solids [mm].

    Returns:
        disc_gap: from the propeller's disc back to the nearest of camera, antenna, bracket, screws,
            foam tape, band and wires.
        battery_outside: the battery's share outside the fuselage, 0 to 1.
        lens_height: from the propeller's axis up to the lens axis.
        lens_edge: from the leading edge forward to the front of the lens.
        bracket_in_wing: volume shared by bracket and wing [mm^3].
        holes_off: from the bracket's screw line forward to the camera's.
    """
    added = ("camera", "antenna", "bracket", "screws", "foam tape", "band", "wires")
    front = {name: float(shapes[name].solid.bounding_box().max.X) for name in added}
    battery, camera = shapes["battery"].solid, shapes["camera"].solid
    inside = _volume(battery & shapes["fuselage"].solid)
    screw_line = sources.ahead("camera_analog")
    return {
        "disc_gap": _disc(sources) - max(front.values()),
        "battery_outside": 1.0 - inside / _volume(battery),
        "lens_height": sources.lens[2],
        "lens_edge": float(camera.bounding_box().max.X) - sources.leading_edge,
        "bracket_in_wing": _volume(shapes["bracket"].solid & shapes["wing"].solid),
        "holes_off": screw_line - _bracket_at(sources),
    }


def collisions(shapes: dict[str, Shape]) -> list[tuple[str, str, float]]:
    """Pairs of hard parts that share space, with the volume that they share [mm^3].

    Wires, tape and band are soft and lie on others; the camera's screws stand in it.
    """
    hard = ("battery", "receiver", "motor", "inductor", "capacitor", "resistor")
    found = []
    for one, other in combinations((*hard, "bracket", "antenna", "wing"), 2):
        shared = _volume(shapes[one].solid & shapes[other].solid)
        if shared > 1.0:
            found.append((one, other, shared))
    return found


def find_problems(shapes: dict[str, Shape], sources: Sources) -> list[str]:
    """What of the assembly does not fit, a sentence each with number and part; empty if it does."""
    found, sentences = clearances(shapes, sources), []
    least = 1000.0 * PROPELLER_CLEARANCE
    if found["disc_gap"] < least:
        sentences.append(
            f"propeller: expected at least {least:.0f} mm from the disc to camera, bracket and"
            f" wires, got {found['disc_gap']:.1f} mm; move them back"
        )
    if found["battery_outside"] > 1e-3:
        sentences.append(
            "battery: expected it inside the fuselage, got "
            f"{100.0 * found['battery_outside']:.0f} % of it outside; correct its x_mm in the list"
        )
    if abs(found["lens_edge"] - (sources.lens[0] - sources.leading_edge)) > 2.0:
        sentences.append(
            f"camera: expected the lens at {sources.lens[0]:.0f} mm by the airframe file, got"
            f" {found['lens_edge'] + sources.leading_edge:.0f} mm by the parts list"
        )
    if abs(found["holes_off"]) > 1.0:
        sentences.append(
            "bracket: expected its holes at the camera's screws, got them"
            f" {found['holes_off']:+.1f} mm off; correct x_mm of bracket or camera_analog"
        )
    sentences += [
        f"{one}: expected it clear of {other}, got {shared:.0f} mm3 shared; correct x_mm of one"
        for one, other, shared in collisions(shapes)
    ]
    return sentences


def _volume(solid: Any) -> float:
    """Volume of what an operation leaves: a shape, several, or nothing [mm^3]."""
    if solid is None:
        return 0.0
    if isinstance(solid, list | tuple):
        return math.fsum(_volume(each) for each in solid)
    return float(solid.volume)


def _drawn(point: Sequence[float]) -> Point:
    """Body axes [m] -> the drawing's [mm]: y and z change sign."""
    x, y, z = (1000.0 * float(value) for value in point)
    return x, -y, -z


def main(words: list[str] | None = None) -> int:
    """Write the aircraft as STEP, print each shape's place, and check the clearances.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0 where everything fits, else 1.
    """
    from build123d import Compound, export_step

    parser = argparse.ArgumentParser(description="The assembly as STEP, with its clearances.")
    parser.add_argument("--parts", help="parts list; the kit's own if not given")
    parser.add_argument("--airframe", help="airframe file; airframe_builder.toml if not given")
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    options = parser.parse_args(words)
    try:
        sources = load_sources(options.parts, options.airframe)
        shapes = build(sources)
    except (InputError, FileNotFoundError) as mistake:
        print(mistake, file=sys.stderr)
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    flying = [shape for shape in shapes.values() if shape.scene == "aircraft"]
    for shape in flying:
        shape.solid.label = f"{shape.number} {shape.name}"
    with atomic_write(options.out / "assembly.step") as file:
        export_step(Compound(children=[shape.solid for shape in flying]), Path(file.name))
    print("no.  shape            part             x behind leading edge [mm]")
    for shape in flying:
        bounds = shape.solid.bounding_box()
        edge = sources.leading_edge
        print(
            f"{shape.number:4} {shape.name:16} {shape.part:16} {edge - bounds.max.X:6.1f} to "
            f"{edge - bounds.min.X:6.1f}"
        )
    problems = find_problems(shapes, sources)
    for sentence in problems:
        print(sentence)
    print(", ".join(f"{key} {value:.2f}" for key, value in clearances(shapes, sources).items()))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
