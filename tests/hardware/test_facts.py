"""The page of facts: every checked row is there with its origin; calculated numbers are right."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import builder_airframe_path, load_airframe
from falconwing_kit.aircraft.sizing import largest_mass, minimum_speed
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.hardware.parts import load_parts, roll_up
from falconwing_kit.tools.hardware.parts_check import balance_range

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "manual" / "site" / "builder" / "facts.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if re.match(r"\| \d", line)
]
KINDS = {"measured", "data sheet", "calculated", "paper", "estimate", "open"}


def row(number, words):
    """The number and source of the row that has these words."""
    (found,) = [r for r in ROWS if number in r[0].split(", ") and words in r[1]]
    return found[1] + " " + found[3]


def test_all_checked_rows_are_settled():
    """35 claims were checked; each has a row, a kind of the list at the top, and a source. Rows
    from 36 on are of the assembly's drawings.
    """
    assert {int(n) for r in ROWS for n in r[0].split(", ")} >= set(range(1, 36))
    assert all(len(r) == 4 and r[2] in KINDS and len(r[3]) > 20 for r in ROWS)
    for kind in KINDS:
        assert f"**{kind.capitalize()}**" in PAGE


def test_mass_and_balance_are_those_of_the_files():
    """The largest masses by the airframe files, the balance by the parts list."""
    paper, built, items = load_airframe(), load_airframe(builder_airframe_path()), load_parts()
    text = row("4", "largest mass of the bench test")
    bench = 1000.0 * float(largest_mass(25.0, built, margin=2.0, hold_height=True))
    small = 1000.0 * float(largest_mass(20.0, built, hold_height=True))
    assert f"{bench:.1f} g; the parts list weighs {1000.0 * roll_up(items).mass:.1f} g" in text
    assert f"20 m allows {small:.1f} g" in text
    text = row("3", "for 20 m")
    for hold in (False, True):
        assert f"{1000.0 * float(largest_mass(20.0, paper, hold_height=hold)):.1f} g" in text
    text = row("5", "accepted")
    first, last = (1000.0 * x for x in balance_range(items, built))
    assert f"accepted {first:.1f} to {last:.1f} mm" in text
    assert f"{1000.0 * roll_up(items).x_cg:.1f} mm behind the leading edge" in text
    text = row("1", "minimum speed")
    assert f"{float(minimum_speed(0.150, paper)):.2f} m/s" in text


def test_camera_and_propeller_are_those_of_the_file_and_the_drawing():
    """Place by the airframe file; the share of the image by rays through the disc, here over every
    pixel; the drawn wing's leading edge by its outer Gaussians.
    """
    built, camera = load_airframe(builder_airframe_path()), fpv_camera(320, 240)
    x, _, z = built.p_body_camera
    behind = built.propeller.x - x
    assert f"{x:.3f} m ahead of the mark, {-z:.3f} m above" in row("7", "builder's aircraft")
    assert f"{behind:.3f} m behind its disc" in row("7", "builder's aircraft")
    u, v = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    y_disc = behind * (u - camera.cx) / camera.fx
    z_disc = z + behind * (v - camera.cy) / camera.fy
    covered = np.hypot(y_disc, z_disc) < 0.5 * built.propeller.diameter
    text = row("7", "disc over")
    assert f"{100.0 * covered.mean():.0f} % of the image" in text
    assert f"{100.0 * covered[:120].mean():.1f} % of its upper half" in text
    leader = load_scene("leader")
    wing = leader.means[(leader.opacities > 0.4) & (np.abs(leader.means[:, 1]) > 0.1)]
    edge = 1000.0 * wing[:, 0].max()
    text = row("7", "drawn wing")
    assert f"is {edge:.0f} mm ahead of its origin" in text
    assert f"{edge - 1000.0 * built.x_leading_edge:.0f} mm further" in text


@pytest.mark.parametrize(
    ("number", "words", "value", "form"),
    [
        ("10", "Reynolds", 7 * 0.109 / 1.5e-5 / 1e4, "{:.1f}·10⁴"),
        ("9", "drag factor", 1 / (math.pi * 0.7**2 / 0.076 * 0.07), "{:.3f}"),
        ("8", "lift slope", 2 * math.pi * 6.447 / (2 + math.sqrt(6.447**2 + 4)), "{:.2f}"),
        ("35", "air", math.sqrt(1.3 / 1.2), "{:.3f}"),
        ("35", "air", 101325 / (287.05 * 293.15), "{:.2f} kg/m³"),
        ("14", "unpowered", (9 - 0.5) / 4.7, "{:.1f} mA into an unpowered"),
        ("14", "unpowered", (9 - 5.5) / 4.7, "{:.2f} mA into a powered"),
        ("15", "polarity", 100 * (1 - 5 * 0.4 / 22), "{:.0f} %"),
        ("21", "USA", (0.050 * 3) ** 2 / 30 * 1e3, "{:.2f} mW EIRP"),
        ("21", "EU", 25 * 10**0.2, "{:.0f} mW EIRP"),
        ("23", "marker", 0.8 * 8 / 6, "{:.3f} m square"),
        ("28", "10 of 10", 100 * 0.025 ** (1 / 10), "{:.0f} %"),
        ("28", "30 of 30", 100 * 0.025 ** (1 / 30), "{:.1f} %"),
    ],
)
def test_calculated_numbers_by_their_formulas(number, words, value, form):
    """Textbook formulas: Re, span efficiency, Helmbold, ideal gas, Ohm, mean of a pulse train,
    field strength of an isotropic source, decibels, marker of 6 cells and a border, binomial.
    """
    assert form.format(value) in row(number, words)
