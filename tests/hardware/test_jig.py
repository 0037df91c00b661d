"""The balance jig holds the wing at the list's mark and range, and prints without support."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import builder_airframe_path, load_airframe
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.hardware.parts import load_parts

ROOT = Path(__file__).resolve().parents[2]


def script(name):
    """A program of hardware/ as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "hardware" / name / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


jig, bracket = script("jig"), script("bracket")


def kits_wing():
    """The wing of the kit's own files."""
    return jig.load_wing(load_parts(), load_airframe(builder_airframe_path()))


def committed():
    """Triangles of the STL that ships."""
    return bracket.read_stl(ROOT / "hardware" / "jig" / "balance_jig.stl")


def made(wing, folder):
    """The jig of a wing as triangles."""
    bracket.write(jig.build(wing), folder / "a.step", folder / "a.stl")
    return bracket.read_stl(folder / "a.stl")


def ridge_to_wall(mesh):
    """From the middle of the ridge's top to the wall [mm], by lines through the triangles."""
    along = bracket.crossings(
        mesh, 0, 0.3, 11.1
    )  # above the base, below the ridge's top, off the edges
    assert len(along) == 4  # in and out of the ridge and of the wall
    return along[2] - (along[0] + along[1]) / 2.0


def spacer_thickness(mesh):
    """Of the block beside the stand [mm]."""
    along = bracket.crossings(mesh, 0, 32.3, 11.1)
    assert len(along) == 2
    return along[1] - along[0]


def test_the_ridge_is_at_the_mark_and_with_the_spacer_at_the_foremost_balance():
    """By hand: the list's airframe is at 36 mm, a gap of 0.5; a twentieth of the chord 0.076 / 0.70
    = 108.57 mm is 5.43 mm. Measured in the committed STL.
    """
    mesh = committed()
    assert ridge_to_wall(mesh) == pytest.approx(36.5, abs=0.02)
    assert spacer_thickness(mesh) == pytest.approx(5.43, abs=0.02)


def test_the_wall_stops_the_wing_and_the_ridge_is_below_it():
    """Ridge 14 mm over the bed, the file's wing of 12 mm on it, the wall 4 mm over that: 30 mm."""
    mesh = committed()
    assert mesh[..., 2].max() == pytest.approx(30.0, abs=0.01)
    (_, top) = bracket.crossings(mesh, 2, 0.05, 0.3)  # through the ridge, x and y
    assert top == pytest.approx(14.0, abs=0.05)


def test_committed_jig_is_what_the_script_makes(tmp_path):
    """Volume to a thousandth, box to a hundredth of a millimetre; the STEP by the CAD kernel."""
    from build123d import import_step

    ours, again = committed(), made(kits_wing(), tmp_path)
    assert bracket.volume(ours) == pytest.approx(bracket.volume(again), rel=1e-3)
    assert np.ptp(ours.reshape(-1, 3), axis=0) == pytest.approx(
        np.ptp(again.reshape(-1, 3), axis=0), abs=0.01
    )
    solid = import_step(ROOT / "hardware" / "jig" / "balance_jig.step")
    assert solid.volume == pytest.approx(bracket.volume(again), rel=1e-3)


def test_it_prints_without_support_and_lies_on_the_bed():
    """45 deg, as for the bracket; both bodies begin at z = 0."""
    mesh = committed()
    assert bracket.overhang_deg(mesh) <= 45.5
    for beside in (False, True):
        part = mesh[(mesh[..., 1].min(axis=1) > 15.0) == beside]
        assert part[..., 2].min() == pytest.approx(0.0, abs=1e-6)


def test_another_mark_or_thickness_moves_ridge_and_wall(tmp_path):
    """A planted list with its mark at 42 mm: 42.5 mm to the wall; a wing of 9 mm: 27 mm high."""
    items = tuple(
        replace(item, x=0.042) if item.id == "airframe" else item for item in load_parts()
    )
    wing = jig.load_wing(items, load_airframe(builder_airframe_path()))
    assert ridge_to_wall(made(wing, tmp_path)) == pytest.approx(42.5, abs=0.02)
    thin = made(replace(kits_wing(), thickness=9.0), tmp_path)
    assert thin[..., 2].max() == pytest.approx(27.0, abs=0.01)


def test_the_command_measures_and_refuses(tmp_path, capsys):
    """A thickness of another wing, and one that is no wing."""
    assert jig.main(["--wing-thickness", "9.5", "--out", str(tmp_path)]) == 0
    assert "27.5 mm" in capsys.readouterr().out
    assert jig.main(["--wing-thickness", "95", "--out", str(tmp_path / "no")]) == 1
    assert "wing thickness" in capsys.readouterr().err and not (tmp_path / "no").exists()
    with pytest.raises(InputError, match="foremost point"):
        jig.Wing(36.0, 35.5, 12.0)
