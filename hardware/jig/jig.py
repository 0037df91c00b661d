"""Balance jig: mark, range and wing thickness of the files -> stand and spacer, STEP and STL.

    .venv/bin/python hardware/jig/jig.py                    the kit's own, to this folder
    .venv/bin/python hardware/jig/jig.py --parts mine.csv --wing-thickness 9.5 --out out

Print the file twice. The wing rests on the ridge of two stands, one under each half, its leading
edge a gap from the wall: the ridge is at the maker's mark. With the spacer against the wall it is
at the foremost balance point that the bench test accepts. Millimetres; the ridge is at x = 0, the
wall ahead of it, the print bed is z = 0. Building needs the extra `cad` (build123d).
"""

import argparse
import importlib.util
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe, builder_airframe_path, load_airframe
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.hardware.parts import Item, load_parts
from falconwing_kit.tools.hardware.parts_check import balance_range

FOLDER = Path(__file__).resolve().parent
GAP = 0.5  # between leading edge and wall, so that the wing tilts freely
BASE, WIDE = 3.0, 24.0  # thickness of the base, width of the stand along the wing
RIDGE_HEIGHT, RIDGE = 14.0, 3.0  # of the ridge's top over the bed; its thickness
WALL = 3.0  # thickness of the wall
OVER = 4.0  # of the wall over the upper side of the wing
BEHIND = 22.0  # of the base behind the ridge
APART = 8.0  # between stand and spacer on the bed
NAME = "balance_jig"


@dataclass(frozen=True)
class Wing:
    """What the jig measures [mm]."""

    mark: float  # balance mark behind the leading edge: the last point that passes
    first: float  # foremost point that passes
    thickness: float  # of the wing

    def __post_init__(self) -> None:
        require_range("wing thickness", self.thickness, low=3.0, high=40.0)
        require_range("mark", self.mark, low=15.0, high=200.0)
        if not 2.0 <= self.mark - self.first <= self.mark - 10.0:
            raise InputError(
                "balance: expected the foremost point 2 mm or more ahead of the mark, got "
                f"{self.first:.1f} and {self.mark:.1f} mm"
            )


def load_wing(
    items: Sequence[Item], airframe: Airframe, envelope: dict[str, Any] | None = None
) -> Wing:
    """The wing by the parts list, the airframe file and hardware/assembly/envelope.toml.

    Args:
        items: the list; its airframe's x is the mark.
        airframe: with the chord that the range of balance is a twentieth of.
        envelope: of envelope.toml, whose [aircraft] has the thickness; None reads the file.

    Raises:
        InputError: a number is missing or out of range.
    """
    if envelope is None:
        path = FOLDER.parent / "assembly" / "envelope.toml"
        envelope = tomllib.loads(path.read_text(encoding="utf-8"))
    first, mark = balance_range(items, airframe)
    return Wing(1000.0 * mark, 1000.0 * first, float(envelope["aircraft"]["wing_thickness"]))


def wall_at(wing: Wing) -> float:
    """Inner side of the wall ahead of the ridge [mm]: mark + gap."""
    return wing.mark + GAP


def spacer_thickness(wing: Wing) -> float:
    """Thickness of the spacer [mm]: from the foremost point to the mark."""
    return wing.mark - wing.first


def stand(wing: Wing) -> Any:
    """One stand: base, ridge with a rounded top, wall.

    Args:
        wing: its mark and thickness.

    Returns:
        A build123d solid [mm], lying on z = 0 as it is printed.
    """
    from build123d import Align, Box, Cylinder, Pos, Rot

    on_bed, inner = (Align.MIN, Align.CENTER, Align.MIN), wall_at(wing)
    base = Pos(-BEHIND, 0, 0) * Box(BEHIND + inner + WALL, WIDE, BASE, align=on_bed)
    straight = RIDGE_HEIGHT - RIDGE / 2.0
    ridge = Pos(-RIDGE / 2.0, 0, 0) * Box(RIDGE, WIDE, straight, align=on_bed)
    ridge += Pos(0, 0, straight) * Rot(90, 0, 0) * Cylinder(RIDGE / 2.0, WIDE)
    wall = Pos(inner, 0, 0) * Box(WALL, WIDE, RIDGE_HEIGHT + wing.thickness + OVER, align=on_bed)
    return base + ridge + wall


def spacer(wing: Wing) -> Any:
    """A block as thick as the range of balance, as high as the wall; it stands before the wall."""
    from build123d import Align, Box

    high = RIDGE_HEIGHT + wing.thickness + OVER - BASE
    return Box(spacer_thickness(wing), WIDE, high, align=(Align.MIN, Align.CENTER, Align.MIN))


def build(wing: Wing) -> Any:
    """Stand and spacer side by side as they are printed [mm]."""
    from build123d import Compound, Pos

    beside = Pos(-BEHIND, WIDE + APART, 0) * spacer(wing)
    return Compound(children=[stand(wing), beside])


def bracket_script() -> Any:
    """The module hardware/bracket/bracket.py, which writes and measures STL files."""
    spec = importlib.util.spec_from_file_location(
        "bracket", FOLDER.parent / "bracket" / "bracket.py"
    )
    if spec is None or spec.loader is None:
        raise ImportError("hardware/bracket/bracket.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(words: list[str] | None = None) -> int:
    """Build, write and measure.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0 where it prints without support, else 1.
    """
    parser = argparse.ArgumentParser(description="Balance jig as STEP and STL.")
    parser.add_argument("--parts", help="parts list; the kit's own if not given")
    parser.add_argument("--wing-thickness", type=float, help="[mm], as measured")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to")
    options = parser.parse_args(words)
    measure = bracket_script()
    try:
        wing = load_wing(load_parts(options.parts), load_airframe(builder_airframe_path()))
        if options.wing_thickness is not None:
            wing = Wing(wing.mark, wing.first, options.wing_thickness)
    except (InputError, FileNotFoundError) as mistake:
        print(mistake, file=sys.stderr)
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    step, stl = (options.out / f"{NAME}.{kind}" for kind in ("step", "stl"))
    with atomic_write(step) as first, atomic_write(stl) as second:
        measure.write(build(wing), Path(first.name), Path(second.name))
    mesh = measure.read_stl(stl)
    size = np.ptp(mesh.reshape(-1, 3), axis=0)
    print(
        f"{stl.name}: {' x '.join(f'{s:.1f}' for s in size)} mm, "
        f"{measure.PLA_G_PER_MM3 * measure.volume(mesh):.1f} g in PLA, "
        f"maximum overhang {measure.overhang_deg(mesh):.1f} deg; print it twice"
    )
    print(
        f"ridge {wing.mark:.1f} mm behind the leading edge, {wing.first:.1f} mm with the spacer "
        f"of {spacer_thickness(wing):.2f} mm"
    )
    return 0 if measure.overhang_deg(mesh) <= 45.5 else 1


if __name__ == "__main__":
    sys.exit(main())
