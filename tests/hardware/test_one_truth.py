"""Parts list, airframe files, bracket, camera file, drawn aircraft and bench checklist agree on
mass, balance, camera pose, propeller and field of view; a planted disagreement is found.
"""

import importlib.util
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import builder_airframe_path, load_airframe
from falconwing_kit.aircraft.sizing import largest_mass
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.hardware.cameras import load_camera
from falconwing_kit.tools.hardware.checklists import load_checklists
from falconwing_kit.tools.hardware.parts import load_parts, roll_up
from falconwing_kit.tools.hardware.parts_check import balance_range, find_problems

ROOT = Path(__file__).resolve().parents[2]
TAPE = 0.001  # foam tape below the bracket [m]


@pytest.fixture(scope="module")
def built():
    return load_airframe(builder_airframe_path())


@pytest.fixture(scope="module")
def drawn():
    """Opaque Gaussians of the drawn aircraft, body axes."""
    leader = load_scene("leader")
    return leader.means[leader.opacities > 0.4]


def bracket():
    """hardware/bracket/bracket.py as a module."""
    spec = importlib.util.spec_from_file_location(
        "bracket", ROOT / "hardware" / "bracket" / "bracket.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def moved(part, x_mm):
    """The kit's list with one part elsewhere."""
    return tuple(
        replace(item, x=x_mm / 1000.0) if item.id == part else item for item in load_parts()
    )


def bench_hall():
    """The airframe's largest mass by the command that the bench checklist prints."""
    (step,) = [s for s in load_checklists().bench.steps if s.id == "weight"]
    (line,) = re.findall(r"falconwing size [-\w. ]*\d", step.see)
    return shlex.split(line)[1:]


def test_the_kits_list_passes_its_own_checks(built):
    """Mass by hand, level turn of 30 deg in 25 - 2 m of air of 1.2 kg/m^3: 1/2 * 1.2 * 0.076 *
    0.6 * 11.5 * sin(30 deg) = 157.3 g; the balance may be ahead by a twentieth of 108.6 mm.
    """
    largest = float(largest_mass(25.0, built, margin=2.0, hold_height=True))
    assert largest == pytest.approx(0.1573, abs=1e-4)
    assert find_problems(load_parts(), built, largest) == ()
    assert balance_range(load_parts(), built) == pytest.approx((0.030571, 0.036), abs=1e-5)


def test_the_bench_steps_own_command_accepts_the_kit(capsys):
    """Printed in the checklist, typed here; by the level turn, not the paper's formula."""
    line = bench_hall()
    assert "--hold-height" in line and "--parts" in line
    assert main(line) == 0 and "fits across 23 m" in capsys.readouterr().out


def test_builders_file_has_the_lists_mass_and_mark(built):
    """The sum of the rows, and the balance point of the aircraft as bought, from the list."""
    items = load_parts()
    assert built.mass == pytest.approx(roll_up(items).mass, abs=5e-5)
    assert built.x_leading_edge == pytest.approx(balance_range(items, built)[1], abs=1e-9)
    assert built.scaled == ()


def test_camera_stands_on_its_bracket_on_the_drawn_wing(built, drawn):
    """Down from the lens: half a camera and the bracket's base, foam tape, and the top of the drawn
    wing; to 2 mm, the accuracy of the ends of Gaussians.
    """
    middle = drawn[(np.abs(drawn[:, 1]) < 0.06) & (np.abs(drawn[:, 0]) < 0.05)]
    above_wing = bracket().axis_height(load_camera()) / 1000.0 + TAPE
    wing_top = -middle[:, 2].min()
    whole_wing = -drawn[np.abs(drawn[:, 0]) < 0.09, 2].min()
    assert wing_top == pytest.approx(whole_wing, abs=0.003)
    assert -built.p_body_camera[2] == pytest.approx(whole_wing + above_wing, abs=0.002)
    assert built.p_body_camera[1] == 0.0


def test_camera_is_clear_of_everything_drawn(built, drawn):
    """12 mm off all Gaussians, the wing's below it the nearest, and more than 100 mm behind the
    propeller. The simulated camera's place is in the spinner: the same measure is below 10 mm.
    """
    lens = np.array(built.p_body_camera)
    assert np.linalg.norm(drawn - lens, axis=1).min() > 0.012
    assert np.linalg.norm(drawn - load_airframe().p_body_camera, axis=1).min() < 0.010
    assert drawn[:, 0].min() < lens[0] < built.propeller.x - 0.100


def test_nose_and_propeller_are_the_drawn_ones(built, drawn):
    """The named point, and the outermost Gaussian of the blades, in the last centimetre."""
    nose = load_scene("leader").points["nose"]
    blades = drawn[drawn[:, 0] > 0.190]
    for airframe in (built, load_airframe()):
        assert airframe.p_body_nose == pytest.approx(tuple(nose), abs=0.005)
    assert built.propeller.x == pytest.approx(blades[:, 0].max(), abs=0.005)
    radius = np.hypot(blades[:, 1], blades[:, 2]).max()
    assert built.propeller.diameter == pytest.approx(2.0 * radius, abs=0.002)


def test_wings_and_body_are_the_papers_in_both_files(built):
    """The builder's aircraft is the simulated one but for camera, mass and air."""
    simulated = load_airframe()
    for name in ("span", "wing_area", "length", "bank_limit", "aero", "wheels", "inertia"):
        assert getattr(built, name) == getattr(simulated, name)
    assert simulated.p_body_camera == (0.2, 0.0, 0.0)


def fov_problems(camera_file, facts):
    """Where camera file and page of facts differ from the simulated lens; one line each."""
    simulated = fpv_camera(640, 480)
    fov_deg = 2.0 * math.degrees(math.atan2(0.5 * simulated.width, simulated.fx))
    found = []
    (line,) = [line for line in camera_file.splitlines() if line.startswith("fov_deg")]
    stated = float(line.split("#")[0].split("=")[1])
    if abs(stated - fov_deg) > 0.1:
        found.append(f"camera file: expected {fov_deg:.1f} deg, got {stated:g}")
    if "simulated" not in line or "falconwing bench" not in line:
        found.append("camera file: expected whose lens it is and how yours is measured")
    if f"field of view {fov_deg:.1f}°" not in facts:
        found.append(f"page of facts: expected {fov_deg:.1f}°")
    return found


def test_the_simulated_field_of_view_is_stated_as_the_path_tracers():
    """77.8 deg in the simulator; the camera's own file and the page of facts state the same, and
    that it is not its data sheet's; a planted other angle and a planted origin are found.
    """
    text = (ROOT / "hardware" / "camera_analog.toml").read_text(encoding="utf-8")
    facts = (ROOT / "manual" / "site" / "builder" / "facts.md").read_text(encoding="utf-8")
    assert load_camera("analog").image.fov_deg == 77.8 and fov_problems(text, facts) == []
    planted = fov_problems(text.replace("fov_deg = 77.8", "fov_deg = 120.0"), facts)
    assert planted == ["camera file: expected 77.8 deg, got 120"]
    planted = fov_problems(text.replace("of the simulated lens", "data sheet"), facts)
    assert planted == ["camera file: expected whose lens it is and how yours is measured"]
    assert fov_problems(text, facts.replace("view 77.8°", "view 120°")) == [
        "page of facts: expected 77.8°"
    ]


@pytest.mark.parametrize(
    ("part", "x_mm", "words"),
    [
        ("camera_analog", -140.0, ("balance:", "camera_analog at -140 mm", "nose-heavy")),
        ("camera_analog", -140.0, ("propeller:", "camera_analog", "got 12 mm")),
        ("camera_analog", -140.0, ("camera:", "begin with 0.188", "got 0.036")),
        ("wires", 350.0, ("balance:", "wires at 350 mm", "tail-heavy")),
        ("bracket", -150.0, ("propeller:", "bracket", "got 14 mm")),
    ],
)
def test_planted_place_is_said_with_the_part(built, part, x_mm, words):
    """By hand: disc at 36 - 200 = -164 mm; front of the lens at -140 - 12 = -152 mm, 12 mm behind
    it and body x 0.036 + 0.152 = 0.188. Of the balance, 33.0 mm, 9 g moved by -152 mm take 9.0
    mm, and 1.3 g moved by 365 mm add 3.1 mm: 36.1 mm, behind the mark.
    """
    found = find_problems(moved(part, x_mm), built, 0.2)
    assert any(all(word in sentence for word in words) for sentence in found), found


def test_planted_mass_is_said_with_the_part(built):
    """A bracket of 30 g in place of 2.4 g: 180.3 g, over 171.0."""
    items = tuple(
        replace(item, unit_mass=0.030) if item.id == "bracket" else item for item in load_parts()
    )
    (sentence,) = (s for s in find_problems(items, built, 0.171) if s.startswith("mass"))
    assert "got 180.3 g" in sentence and "bracket weighs 30.0 g, 27.6 g more" in sentence
