"""The camera bracket: what is committed is what the script makes, it fits its camera, weighs
little, and prints.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.hardware.cameras import load_camera
from falconwing_kit.tools.hardware.parts import load_parts

ROOT = Path(__file__).resolve().parents[2]
BOTH = ("analog", "digital")
CUBE = np.array(
    [  # unit cube, counter-clockwise from outside
        [(0, 0, 0), (1, 1, 0), (1, 0, 0)],
        [(0, 0, 0), (0, 1, 0), (1, 1, 0)],
        [(0, 0, 1), (1, 0, 1), (1, 1, 1)],
        [(0, 0, 1), (1, 1, 1), (0, 1, 1)],
        [(0, 0, 0), (1, 0, 0), (1, 0, 1)],
        [(0, 0, 0), (1, 0, 1), (0, 0, 1)],
        [(0, 1, 0), (1, 1, 1), (1, 1, 0)],
        [(0, 1, 0), (0, 1, 1), (1, 1, 1)],
        [(0, 0, 0), (0, 0, 1), (0, 1, 1)],
        [(0, 0, 0), (0, 1, 1), (0, 1, 0)],
        [(1, 0, 0), (1, 1, 0), (1, 1, 1)],
        [(1, 0, 0), (1, 1, 1), (1, 0, 1)],
    ],
    dtype=float,
)


def script():
    """hardware/bracket/bracket.py as a module."""
    spec = importlib.util.spec_from_file_location(
        "bracket", ROOT / "hardware" / "bracket" / "bracket.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


bracket = script()


def committed(name):
    return bracket.read_stl(ROOT / "hardware" / "bracket" / f"bracket_{name}.stl")


def built(camera, folder):
    """A bracket made now, through its STL."""
    bracket.write(bracket.build(camera), folder / "b.step", folder / "b.stl")
    return bracket.read_stl(folder / "b.stl")


def size(mesh):
    return np.ptp(mesh.reshape(-1, 3), axis=0)


def fits(mesh, camera):
    """Whether the camera's screws go through, sit in solid rings, and the camera has its room:
    measured by lines through the triangles, not from the script's own numbers.
    """
    mount, z = camera.mount, mesh[..., 2].max()
    across = 1 if mount.kind == "cheeks" else 0
    axis_z = bracket.axis_height(camera)
    angles = np.linspace(0.1, 6.2, 12)
    answers = []
    for first, up in mount.holes_mm:
        at = first if across == 1 else -first  # y is left, a board's holes are given to the right
        for around, there in ((mount.screw_mm / 2.0, False), (mount.screw_mm / 2.0 + 1.5, True)):
            for angle in angles:
                line = (at + around * np.cos(angle), axis_z + up + around * np.sin(angle))
                cuts = bracket.crossings(mesh, across, *line)
                answers.append((len(cuts) >= 2 and len(cuts) % 2 == 0) if there else len(cuts) == 0)
                if there and across == 1:
                    answers.append(
                        len(cuts) == 4
                        and camera.body_mm.width < cuts[2] - cuts[1] < camera.body_mm.width + 1
                    )
    return all(answers) and z > axis_z


def test_measures_of_a_cube_are_those_by_hand():
    """Volume 1, size 1; its top looks up, its walls hang over by 0 deg, its bottom lies on the bed.
    Lifted by half a bed's triangle, the bottom is a ceiling: 90 deg. A line through it goes in at 0
    and out at 1.
    """
    assert bracket.volume(CUBE) == pytest.approx(1.0)
    assert bracket.overhang_deg(CUBE) == pytest.approx(0.0)
    lower = CUBE[:1] - np.array([0.0, 0.0, 3.0])
    assert bracket.overhang_deg(np.concatenate([CUBE, lower])) == pytest.approx(90.0)
    for axis in range(3):
        assert bracket.crossings(CUBE, axis, 0.3, 0.6) == pytest.approx([0.0, 1.0])
        assert len(bracket.crossings(CUBE, axis, 1.3, 0.6)) == 0


def test_slope_of_a_wedge_is_found():
    """A wall whose foot is 1 inside its top of height 2 hangs over by atan(1 / 2) = 26.565 deg."""
    leaning = CUBE * np.array([1.0, 1.0, 2.0])
    leaning[..., 0] += leaning[..., 2] / 2.0 * (leaning[..., 0] > 0.5)
    assert bracket.overhang_deg(leaning) == pytest.approx(26.565, abs=1e-3)


@pytest.mark.parametrize("name", BOTH)
def test_committed_bracket_is_what_the_script_makes(name, tmp_path):
    """Made again from the camera file: volume to a thousandth, the box to a hundredth of a
    millimetre, the STEP read back by the CAD kernel to the same volume. An STL of 0.01 mm loses
    less than a thousandth.
    """
    from build123d import import_step

    ours, again = committed(name), built(load_camera(name), tmp_path)
    assert bracket.volume(ours) == pytest.approx(bracket.volume(again), rel=1e-3)
    assert size(ours) == pytest.approx(size(again), abs=0.01)
    solid = import_step(ROOT / "hardware" / "bracket" / f"bracket_{name}.step")
    assert solid.is_valid and solid.volume == pytest.approx(bracket.volume(again), rel=1e-3)


@pytest.mark.parametrize("name", BOTH)
def test_bracket_weighs_at_most_what_the_papers_does(name):
    """5 g in the paper; the list of parts says the mass of the committed STL to its last digit."""
    mass_g = bracket.PLA_G_PER_MM3 * bracket.volume(committed(name))
    rows = {item.id: item for item in load_parts()}
    listed_g = 1000.0 * rows["bracket" if name == "analog" else "bracket_digital"].unit_mass
    assert 1.0 < mass_g <= 5.0
    assert listed_g == pytest.approx(mass_g, abs=0.05)


@pytest.mark.parametrize("name", BOTH)
def test_bracket_prints_without_support(name):
    """45 deg is what printers bridge without help; half a degree is the triangles' own."""
    assert bracket.overhang_deg(committed(name)) <= 45.5


@pytest.mark.parametrize("name", BOTH)
def test_bracket_fits_its_camera(name):
    """Screws pass, rings hold, cheeks leave the camera's width and less than a millimetre more."""
    assert fits(committed(name), load_camera(name))


def test_base_is_out_of_the_picture():
    """Tilted down as far as it goes, the front of the lens is still ahead of the base, so the base
    is behind it.
    """
    camera = load_camera()
    lens = camera.body_mm.lens_ahead * np.cos(np.radians(camera.mount.tilt_deg))
    assert committed("analog")[..., 0].max() < lens


@pytest.mark.parametrize(
    "change",
    [
        {"body_mm": {"width": 21.0}},
        {"body_mm": {"height": 24.0}},
        {"mount": {"screw_mm": 3.0}},
        {"mount": {"holes_mm": ((2.0, 3.0),)}},
    ],
)
def test_bracket_of_another_camera_does_not_fit_but_is_made(change, tmp_path):
    """A value changed in the camera's file: the committed bracket no longer fits, and a new one
    does.
    """
    camera = load_camera()
    for part, values in change.items():
        camera = replace(camera, **{part: replace(getattr(camera, part), **values)})
    assert not fits(committed("analog"), camera)
    mesh = built(camera, tmp_path)
    assert fits(mesh, camera) and bracket.overhang_deg(mesh) <= 45.5


def test_round_hole_would_need_support(tmp_path, monkeypatch):
    """Planted: without its roof a sideways hole has a ceiling, which the overhang check detects."""
    from build123d import Circle

    monkeypatch.setattr(bracket, "_teardrop", Circle)
    assert bracket.overhang_deg(built(load_camera(), tmp_path)) > 60.0


def test_thick_walls_would_weigh_too_much(tmp_path, monkeypatch, capsys):
    """Planted: a base of 8 mm passes 5 g, and the command says no."""
    monkeypatch.setattr(bracket, "BASE", 8.0)
    assert bracket.main(["analog", "--out", str(tmp_path)]) == 1
    assert "bracket_analog.stl" in capsys.readouterr().out


def test_broken_stl_is_one_sentence(tmp_path):
    """Cut short, or a text."""
    whole = (ROOT / "hardware" / "bracket" / "bracket_analog.stl").read_bytes()
    for content in (whole[:-7], b"solid bracket\nendsolid\n" * 9, b""):
        (tmp_path / "cut.stl").write_bytes(content)
        with pytest.raises(InputError, match="expected a binary STL"):
            bracket.read_stl(tmp_path / "cut.stl")
