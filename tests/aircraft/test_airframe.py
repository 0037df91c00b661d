"""The airframe file: one record in SI units, or one sentence."""

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from falconwing_kit.aircraft.airframe import Airframe, default_airframe_path, load_airframe
from falconwing_kit.core.checks import InputError


@pytest.fixture
def table() -> dict:
    """The shipped file as plain tables."""
    return tomllib.loads(default_airframe_path().read_text(encoding="utf-8"))


def load(table: dict, folder: Path) -> Airframe:
    path = folder / "airframe.toml"
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return load_airframe(path)


def test_shipped_airframe_has_the_papers_numbers_in_si():
    """Paper, hardware section and appendix: 150 g, 0.076 m2, 70 cm, C 0.6, rho 1.3, 30 deg.
    Conversions by hand.
    """
    umx = load_airframe()
    assert umx.mass == pytest.approx(0.150, rel=1e-12)
    assert (umx.wing_area, umx.span, umx.air_density, umx.aero.CL_max) == (0.076, 0.70, 1.3, 0.6)
    assert umx.bank_limit == pytest.approx(math.pi / 6, rel=1e-12)
    assert umx.p_body_camera == (0.20, 0.0, 0.0)


def test_corners_are_nose_tail_and_wing_tips():
    """By hand: camera 0.20 m ahead, 0.52 m long, 0.70 m of span; body y points right."""
    expected = [(0.20, 0.0, 0.0), (-0.32, 0.0, 0.0), (0.0, 0.35, 0.0), (0.0, -0.35, 0.0)]
    assert load_airframe().corners_body == pytest.approx(np.array(expected), abs=1e-12)


def test_mean_chord_is_area_over_span():
    """By hand: 0.076 m2 / 0.70 m = 0.10857 m, to the five digits written."""
    assert load_airframe().mean_chord == pytest.approx(0.10857, abs=5e-6)


def test_receiver_inside_the_airframe_is_not_counted_twice():
    """By hand from the paper: 137 + 9 + 5 = 151 g; with the 13.5 g receiver added it would be 164.5
    g.
    """
    assert load_airframe().parts_mass == pytest.approx(0.151, rel=1e-12)


def test_inertia_follows_the_stated_radii_of_gyration():
    """By hand: 0.15 kg times (0.25 * 0.35 m)^2, (0.38 * 0.26 m)^2, (0.39 * 0.305 m)^2; the file
    keeps three digits.
    """
    inertia = load_airframe().inertia
    assert (inertia.Ixx, inertia.Iyy, inertia.Izz) == pytest.approx(
        (1.1484e-3, 1.4642e-3, 2.1224e-3), rel=5e-3
    )


def test_every_number_of_the_shipped_file_has_a_source():
    """House rule: a key's own comment, or the one above its table, names a source."""
    source, untold = re.compile(r"paper|hall data|estimate|not measured", re.IGNORECASE), []
    heading = ""
    for line in default_airframe_path().read_text(encoding="utf-8").splitlines():
        heading = heading + line if line.startswith("#") else "" if not line else heading
        if re.match(r"\w+ = [\d\[]", line) and not source.search(line.partition("#")[2] or heading):
            untold.append(line)
    assert untold == []


def test_written_and_read_again_is_the_same(table, tmp_path):
    """Inverse: a file with the same tables gives an equal record."""
    assert load(table, tmp_path) == load_airframe()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda t: t.update(mass_g=-150.0), "positive"),
        (lambda t: t.update(mass_g=0.0), "positive"),
        (lambda t: t.update(span_m=math.nan), "finite"),
        (lambda t: t.update(wing_area_m2=math.inf), "finite"),
        (lambda t: t.update(bank_limit_deg=90.0), "between 0 and 90 deg"),
        (lambda t: t.update(mass=150.0), "mass_g"),
        (lambda t: t.update(mass_g="heavy"), "mass_g"),
        (lambda t: t.update(wingspan_m=0.7), "perhaps you meant 'span_m'"),
        (lambda t: t.pop("length_m"), "length_m"),
        (lambda t: t.pop("aero"), "aero"),
        (lambda t: t["aero"].pop("CL_max"), "CL_max"),
        (lambda t: t["aero"].update(CL_max=0.0), "CL_max"),
        (lambda t: t.update(p_body_camera_m=[0.2, 0.0]), "p_body_camera_m"),
        (lambda t: t["wheels_m"].update(tail=[math.nan, 0.0, 0.0]), "wheels_m.tail[0]"),
        (lambda t: t["wheels_m"].update(main_left=[0.05, 0.09, 0.11]), "swap"),
        (lambda t: t["inertia_kg_m2"].update(Izz=0.1), "moments of a solid body"),
        (lambda t: t["parts"][2].update(mass_g=0.0), "mass of 'camera'"),
        (lambda t: t["parts"][1].update(inside="fuselage"), "fuselage"),
        (lambda t: t["parts"].append({"name": "camera", "mass_g": 9.0}), "camera"),
    ],
)
def test_a_damaged_file_is_refused_in_one_sentence_with_its_path(table, tmp_path, damage, words):
    """The sentence names the file and the wrong entry."""
    damage(table)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        load(table, tmp_path)
    assert "airframe.toml" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"mass_g = ", b"\xff\xfe\x00", b"[[[", b"parts = 3\n"])
def test_a_file_that_is_no_airframe_is_refused(tmp_path, content):
    """Empty, cut off, not text, not TOML, not an airframe: the message names the file."""
    path = tmp_path / "damaged.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged\.toml"):
        load_airframe(path)


def test_a_missing_file_is_named(tmp_path):
    """FileNotFoundError with the path."""
    with pytest.raises(FileNotFoundError, match=r"nowhere\.toml"):
        load_airframe(tmp_path / "nowhere.toml")


def test_a_changed_copy_is_checked_too():
    """`dataclasses.replace` makes a new record, which is checked again."""
    with pytest.raises(InputError, match="mass"):
        replace(load_airframe(), mass=-1.0)
