"""hardware/README.md is true: its commands run, its numbers are those of the files."""

import io
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from falconwing_kit.aircraft.airframe import builder_airframe_path, load_airframe
from falconwing_kit.aircraft.sizing import largest_mass
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.hardware.cameras import load_camera
from falconwing_kit.tools.hardware.parts import balance_move, load_parts, roll_up

ROOT = Path(__file__).resolve().parents[2]
GUIDE = (ROOT / "hardware" / "README.md").read_text(encoding="utf-8")
COMMANDS = list(dict.fromkeys(re.findall(r"`(falconwing [^`]+)`", GUIDE)))


def test_commands_are_found():
    """The pattern sees the ones that are there."""
    assert len(COMMANDS) >= 6 and "falconwing doctor --bench" in COMMANDS


@pytest.mark.filterwarnings("ignore:the calibration")
@pytest.mark.parametrize(
    "line", [line for line in COMMANDS if len(line.split()) > 2 or line == "falconwing size"]
)
def test_command_runs(line, tmp_path, monkeypatch):
    """As printed, in an empty folder, without a terminal."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main(shlex.split(line)[1:]) == 0


def test_files_of_the_table_are_there():
    """Every file or folder that is named, and no data file left out."""
    rows = [line.split("|")[1] for line in GUIDE.splitlines() if line.startswith("| `")]
    named = set(re.findall(r"`([\w./]+)`", " ".join(rows)))
    there = {
        path.name for path in (ROOT / "hardware").iterdir() if path.suffix in (".csv", ".toml")
    }
    assert there <= named and all((ROOT / "hardware" / name).exists() for name in named)
    links = re.findall(r"\]\(([^)]+)\)", GUIDE)
    assert len(links) >= 5 and all((ROOT / "hardware" / link).exists() for link in links)


def test_numbers_are_those_of_the_list():
    """Mass, shift and move as printed, to the printed digit, from the list of parts."""
    items, built = load_parts(), load_airframe(builder_airframe_path())
    whole, bought = roll_up(items), next(item.x for item in items if item.id == "airframe")
    text = " ".join(GUIDE.split())
    assert f"{1000.0 * whole.mass:.1f} g with filter" in text
    assert f"move the centre of gravity {1000.0 * (bought - whole.x_cg):.0f} mm forward" in text
    assert f"to {1000.0 * whole.x_cg:.1f} mm behind the leading edge" in text
    back = 1000.0 * balance_move(items, "battery", bought)
    assert f"Moving the battery {back:.0f} mm back" in text
    limits = (
        largest_mass(25.0, built, margin=2.0, hold_height=True),
        largest_mass(20.0, built, hold_height=True),
        largest_mass(20.0, built),
    )
    for limit, words in zip(
        limits, ("at most {} g", "allows {} g", "{} g by the paper's"), strict=True
    ):
        assert words.format(f"{1000.0 * float(limit):.1f}") in text
    behind = 1000.0 * (built.propeller.x - built.p_body_camera[0])
    above = -1000.0 * built.p_body_camera[2]
    assert f"{above:.0f} mm above the propeller's axis and {behind:.0f} mm behind its disc" in text
    assert whole.cost == pytest.approx(1058.4, abs=0.05) and "about 1,058 US dollars" in GUIDE


def test_numbers_are_those_of_the_filter():
    """Corner, attenuation, peaks with and without the resistor, voltage lost, and the better
    capacitor, as printed.
    """
    camera = load_camera()
    parts, load = camera.power_filter, camera.supply.load_ohm
    assert (
        f"{parts.corner_hz / 1000.0:.2f} kHz, and at {parts.switching_khz:g} kHz, the switching"
        in GUIDE
    )
    weaker = float(parts.attenuation_db(24e3, load))
    assert f"attenuates ripple by {weaker:.0f} dB (to 1/{10 ** (weaker / 20.0):.0f})" in GUIDE
    bare = replace(parts, damping_ohm=0.0).peak_db(load)
    assert f"near the corner by {bare:.1f} dB, with it by {parts.peak_db(load):.1f} dB" in GUIDE
    assert f"its drop is {1000.0 * parts.series_ohm * camera.supply.current_a:.0f} mV" in GUIDE
    polymer = replace(parts, esr_ohm=0.010, damping_ohm=0.47)
    assert f"gives {float(polymer.attenuation_db(24e3, load)):.0f} dB" in GUIDE
    assert (
        polymer.peak_db(load) < 1.0 < replace(polymer, damping_ohm=parts.damping_ohm).peak_db(load)
    )
