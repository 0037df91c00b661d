"""The airframe file: one record in SI units, or one sentence."""

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from falconwing_kit.aircraft.airframe import (
    Airframe,
    default_airframe_path,
    load_airframe,
    scaling_sentence,
)
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
        (lambda t: t.pop("wing_area_m2"), "missing key 'wing_area_m2'"),
        (
            lambda t: t.update(mass_g=0.15),
            "expected grams, 5 to 100000, got 0.15; did you give kil",
        ),
        (lambda t: t.update(span_m=70.0), "got 70; did you give centimetres"),
        (lambda t: t.update(span_m=700.0), "or millimetres?"),
        (lambda t: t.update(wing_area_m2=760.0), "square decimetres or square centimetres?"),
        (lambda t: t.update(wing_area_m2=7.6), "wing_area_m2: expected square metres that fit a"),
        (lambda t: t.update(mass_g=150.0, wing_area_m2=5.0, span_m=5.0), "kg/m^2"),
        (lambda t: t.update(length_m=52.0), "length_m: expected metres"),
        (lambda t: t.update(air_density_kg_m3=1225.0), "did you give g/m^3?"),
        (lambda t: t["inertia_kg_m2"].update(Ixx=-0.001), "Ixx"),
        (lambda t: t.update(wingspan_m=0.7), "perhaps you meant 'span_m'"),
        (lambda t: t["aero"].update(CL_max=0.0), "CL_max"),
        (lambda t: t.update(p_body_camera_m=[0.2, 0.0]), "p_body_camera_m"),
        (lambda t: t["wheels_m"].update(tail=[math.nan, 0.0, 0.0]), "wheels_m.tail[0]"),
        (lambda t: t["wheels_m"].update(main_left=[0.05, 0.09, 0.11]), "swap"),
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


THREE = {
    "mass_g": 1200.0,
    "wing_area_m2": 0.304,
    "span_m": 1.4,
}  # the kit's aircraft, twice as long


def test_three_keys_are_enough_and_the_rest_is_a_similar_aircraft(tmp_path):
    """Dynamic similarity by hand: lengths times 2, mass times 8, inertia times 8 * 2^2 = 32,
    coefficients, angles and the air as they were.
    """
    kit, large = load_airframe(), load(THREE, tmp_path)
    assert (large.name, large.parts) == ("airframe", ())
    assert (large.mass, large.wing_area, large.span) == pytest.approx((1.2, 0.304, 1.4), rel=1e-12)
    assert large.length == pytest.approx(1.04, rel=1e-12)
    assert large.p_body_camera == pytest.approx((0.40, 0.0, 0.0), abs=1e-12)
    assert large.wheels.points_body == pytest.approx(2.0 * kit.wheels.points_body, rel=1e-12)
    for axis in ("Ixx", "Iyy", "Izz"):
        expected = 32.0 * getattr(kit.inertia, axis)
        assert getattr(large.inertia, axis) == pytest.approx(expected, rel=1e-12)
    assert (large.aero, large.air_density, large.bank_limit) == (
        kit.aero, kit.air_density, kit.bank_limit
    )  # fmt: skip


def test_what_was_scaled_is_named_in_one_line(tmp_path):
    """The keys that the file lacks, by reading it; a complete file names none."""
    some = THREE | {"name": "Twin", "length_m": 1.1, "aero": {"CL_max": 0.8}}
    airframe = load(some, tmp_path)
    assert airframe.scaled == (
        "air_density_kg_m3", "bank_limit_deg", "p_body_camera_m", "p_body_nose_m",
        "aero.CL0", "aero.CLa", "aero.CD0", "aero.k", "wheels_m", "inertia_kg_m2",
    )  # fmt: skip
    assert (airframe.aero.CL_max, airframe.length) == (0.8, 1.1)
    sentence = scaling_sentence(airframe)
    assert sentence.startswith("Twin: scaled") and "aero.CLa, aero.CD0" in sentence
    assert "\n" not in sentence and "length_m" not in sentence
    assert load_airframe().scaled == () and scaling_sentence(load_airframe()) == ""


def test_pitch_inertia_follows_the_length_where_the_file_has_it(tmp_path):
    """By hand: mass times 8, length times 3, so Iyy times 8 * 9; Ixx still goes with the span."""
    kit, long = load_airframe(), load(THREE | {"length_m": 1.56}, tmp_path)
    assert long.inertia.Iyy == pytest.approx(72.0 * kit.inertia.Iyy, rel=1e-12)
    assert long.inertia.Ixx == pytest.approx(32.0 * kit.inertia.Ixx, rel=1e-12)
    assert long.wheels.tail[0] == pytest.approx(3.0 * kit.wheels.tail[0], rel=1e-12)


@pytest.mark.parametrize(
    ("inertia", "words"),
    [
        ({"Ixx": 1.229, "Iyy": 0.1702, "Izz": 0.8808, "Ixz": 0.9343}, "no solid body"),
        ({"Ixx": 335.0, "Iyy": 140.0, "Izz": 400.0}, "radius of gyration"),  # g m^2
        ({"Ixx": 3.35e-5, "Iyy": 1.4e-5, "Izz": 4e-5}, "radius of gyration"),
    ],
)
def test_an_inertia_that_contradicts_the_mass_is_scaled_and_reported(tmp_path, inertia, words):
    """The Skywalker X8's published moments (PyFly) break the triangle inequality, 1.229 > 0.1702 +
    0.8808; the others are a later measurement of it in g m^2, a thousand times too large, and one
    ten thousand times too small. By hand, the kit's Ixx times 3.364 / 0.150 times (2.1 / 0.7)^2.
    """
    x8 = {"mass_g": 3364.0, "wing_area_m2": 0.75, "span_m": 2.1, "inertia_kg_m2": inertia}
    airframe = load(x8, tmp_path)
    expected = load_airframe().inertia.Ixx * 3.364 / 0.150 * 9.0
    assert airframe.inertia.Ixx == pytest.approx(expected, rel=1e-12)
    assert "inertia_kg_m2" in airframe.scaled and words in airframe.contradictions[0]
    assert words in scaling_sentence(airframe)


@pytest.mark.parametrize(
    ("mass_g", "wing_area_m2", "span_m", "moments"),
    [
        (11000.0, 0.55, 2.8956, (0.8244, 1.135, 1.759, 0.1204)),
        (1560.0, 0.2589, 1.4224, (0.1147, 0.0576, 0.1712, 0.0015)),
        (3364.0, 0.75, 2.1, (0.335, 0.140, 0.400, -0.029)),
    ],
)
def test_published_inertias_are_kept(tmp_path, mass_g, wing_area_m2, span_m, moments):
    """Aerosonde and Zagi of Beard & McLain's appendix E, and the X8 as measured by Gryte et al.
    (2018): no contradiction is found in what was measured.
    """
    entries = dict(zip(("Ixx", "Iyy", "Izz", "Ixz"), moments, strict=True))
    of_file = {"mass_g": mass_g, "wing_area_m2": wing_area_m2, "span_m": span_m}
    airframe = load(of_file | {"inertia_kg_m2": entries}, tmp_path)
    assert airframe.contradictions == () and "inertia_kg_m2" not in airframe.scaled
    assert (airframe.inertia.Ixx, airframe.inertia.Ixz) == (moments[0], moments[3])


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
