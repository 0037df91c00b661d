"""Pictures of the assembly: manual/assembly.toml and its solids -> PNG files with descriptions.

    .venv/bin/python hardware/assembly/draw.py                 all of them, in half a minute
    .venv/bin/python hardware/assembly/draw.py wing exploded   these
    .venv/bin/python hardware/assembly/draw.py --parts mine.csv --out out

The step's parts in colour, parts of earlier steps grey, outlines dark, a number of the parts list
at each named part, an arrow where a part moves. Needs the extra `cad` (build123d) for the solids.
"""

import argparse
import importlib.util
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.vision.marker import Marker

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER))  # this folder is not a package

from projection import (  # noqa: E402
    SMOOTH,
    Mesh,
    Part,
    View,
    anchor,
    axes_of,
    compose,
    fit,
    shaded,
    triangles,
)
from sheet import ARROW, Sheet, label_width  # noqa: E402
from solids import box, rod, tube  # noqa: E402

MANUAL = FOLDER.parents[1] / "manual"
FIGURES = MANUAL / "figures" / "steps"
SIZE, WIDE = (900, 600), (1500, 900)  # of a step's picture and of the exploded view [px]


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
            label = name.removeprefix("flat ")
            if PART_OF.get(name, name) in self.shapes:
                label = f"{self.shapes[PART_OF.get(name, name)].number} {label}"
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
        sides = {True: 50, False: 50}  # room for the labels left and right
        left = {}
        for part in parts:
            if part.name in named:
                place = float(np.median(part.mesh.reshape(-1, 3) @ axes[0]))
                left[part.label] = place < across[1] + across[0] / 2.0
                side = left[part.label]
                sides[side] = max(sides[side], label_width(part.label))
        view = fit(cloud, axes, SIZE, (sides[True], sides[False], int(48 * grow)))
        image, owner = compose(parts, view)
        sheet = Sheet(image)
        self._arrows(sheet, step, parts, view)
        aside = picture.get("text_of", {})
        for name, (begin, end, text) in zip(picture.get("measures", []), lengths, strict=True):
            first, last = (view.pixels(np.array(point))[:2] for point in (begin, end))
            sheet.arrow(first, last, both=True)
            away = np.array(aside.get(name, picture.get("text", [0, -30]))) * SMOOTH
            sheet.text_box((first + last) / 2.0 + away, text, ARROW)
        anchors = [
            (part.label, at)
            for k, part in enumerate(parts)
            if part.name in named and (at := anchor(owner, k)) is not None
        ]
        sheet.callouts(anchors, left)
        for text, *places in picture.get("texts", []):  # where the words are, and what they mean
            ends = [view.pixels(np.array(point, dtype=float))[:2] for point in places]
            if len(ends) > 1:
                sheet.pointer(ends[0], ends[1])
            sheet.text_box(ends[0], text)
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
        if words := [said for said, *_ in step["picture"].get("texts", [])]:
            text += f" Words in the picture: {', '.join(words)}."
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
        side = max(label_width(part.label) for part in parts)
        view = fit(
            np.concatenate([part.mesh for part in parts]),
            axes_of(52.0, 24.0),
            WIDE,
            (side, side, 30),
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


def _filter_flat() -> dict[str, Any]:
    """The filter laid out on the bench, from the battery on the left to the camera on the right."""
    from build123d import Compound

    up, wire, apart = 5.0, 1.6, 13.0  # of the wires' middle, their diameter, half their distance
    ends = (-62.0, 62.0)
    joints = [rod((3.0, y, up - 1.5), (3.0, y, up + 1.5), 4.0) for y in (apart, -apart)]
    legs = [
        tube([(11.0, side * 2.0, up), (3.0, side * 2.0, up), (3.0, side * apart, up)], 0.9)
        for side in (1.0, -1.0)
    ]
    plus = [
        rod((begin, apart, up), (end, apart, up), wire)
        for begin, end in ((ends[0], -40.0), (-33.0, -20.0), (-10.0, ends[1]))
    ]
    minus = rod((ends[0], -apart, up), (ends[1], -apart, up), wire)
    return {
        "flat resistor": rod((-40.0, apart, up), (-33.0, apart, up), 2.5),
        "flat inductor": rod((-20.0, apart, up), (-10.0, apart, up), 10.0),
        "flat capacitor": rod((11.0, 0.0, up), (22.0, 0.0, up), 8.0),
        "flat wires": Compound(children=[*plus, minus, *legs, *joints]),
        "stripe": box((16.5, -2.2, up + 3.2), (11.0, 1.6, 1.4)),
    }


PAD = LandingPad()
PART_OF = {
    "jig as printed": "balance jig",
    "aircraft": "",
    "battery in its bag": "battery",
    **{f"flat {name}": name for name in ("resistor", "inductor", "capacitor", "wires")},
}
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
    **{
        name: lambda book, name=name: triangles(_filter_flat()[name])
        for name in ("flat resistor", "flat inductor", "flat capacitor", "flat wires", "stripe")
    },
    "battery in its bag": lambda book: triangles(_battery_at(book.sources, 240.0, 130.0)),
}


def _measure_lens(sources: Any) -> tuple[Any, Any, str]:
    x, _, z = sources.lens
    return (x, 0.0, 0.0), (x, 0.0, z), f"{z:.0f} mm over the axis"


def _measure_ahead(sources: Any) -> tuple[Any, Any, str]:
    camera, x = sources.camera.body_mm, sources.ahead("camera_analog")
    y, z = camera.width / 2.0 + 6.0, sources.lens[2] + 3.0
    return (x, y, z), (x + camera.lens_ahead, y, z), "lens_ahead"


def _measure_depth(sources: Any) -> tuple[Any, Any, str]:
    camera, x = sources.camera.body_mm, sources.ahead("camera_analog")
    y, z = camera.width / 2.0 + 6.0, sources.lens[2] + 3.0
    return (x, y, z), (x - camera.depth_behind, y, z), "depth_behind"


def _measure_disc(sources: Any) -> tuple[Any, Any, str]:
    x, _, z = sources.lens
    disc = 1000.0 * sources.airframe.propeller.x
    return (x, 0.0, z), (disc, 0.0, z), f"{disc - x:.0f} mm to the disc"


def _measure_mark(sources: Any) -> tuple[Any, Any, str]:
    x = sources.leading_edge
    bottom = sources.wing_top - sources.envelope["aircraft"]["wing_thickness"] - 22.0
    mark = next(1000.0 * item.x for item in sources.items if item.id == "airframe")
    gap = assembly_script().script("jig").GAP
    words = f"{mark:.1f} mm to the ridge, {mark + gap:.1f} from the wall"
    return (x, -90.0, bottom), (x - mark, -90.0, bottom), words


def _measure_wall(sources: Any) -> tuple[Any, Any, str]:
    jig = assembly_script().script("jig")
    wall = jig.wall_at(jig.load_wing(sources.items, sources.airframe, sources.envelope))
    y = -0.5 * jig.WIDE - 4.0
    return (0.0, y, 0.0), (wall, y, 0.0), f"{wall:.1f} mm from ridge to wall"


def _measure_behind(sources: Any) -> tuple[Any, Any, str]:
    y = 1000.0 * PAD.y_centre
    x = 1000.0 * float(Marker().T_world_marker[0, 3])
    return (x, y, 0.0), (1000.0 * PAD.x_start, y, 0.0), f"{PAD.x_start - x / 1000.0:g} m"


def _measure_aside(sources: Any) -> tuple[Any, Any, str]:
    x, y, _ = (1000.0 * float(value) for value in Marker().T_world_marker[:3, 3])
    return (x, y, 0.0), (x, 1000.0 * PAD.y_centre, 0.0), f"{y / 1000.0 - PAD.y_centre:g} m"


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
    "lens_ahead": _measure_ahead,
    "depth_behind": _measure_depth,
    "mark": _measure_mark,
    "wall": _measure_wall,
    "behind": _measure_behind,
    "aside": _measure_aside,
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
