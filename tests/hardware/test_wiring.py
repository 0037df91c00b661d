"""The wiring diagrams and the bracket's picture are what their scripts make, and say what the data
files say.
"""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.hardware.cameras import load_camera

ROOT = Path(__file__).resolve().parents[2]
FIGURES = ROOT / "manual" / "figures"
NAMES = ("wiring_camera", "wiring_trainer", "wiring_ground")
CURVES = ("filter", "balance")


def script(path):
    """A program of hardware/ as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / "hardware" / path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


wiring = script("wiring/wiring.py")


def words(svg):
    """The texts of an SVG."""
    return re.findall(r">([^<>\n]+)</t", svg)


@pytest.mark.parametrize(("path", "names"), [("wiring/wiring.py", NAMES), ("draw.py", CURVES)])
def test_committed_figures_are_what_the_command_makes(path, names, tmp_path):
    """Letter by letter; numbers to a thousandth of a point, since machines round differently."""
    assert script(path).main(["--out", str(tmp_path)]) == 0
    number = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
    for name in [f"{name}.{kind}" for name in names for kind in ("svg", "txt")]:
        ours, again = (
            (folder / name).read_text(encoding="utf-8") for folder in (FIGURES, tmp_path)
        )
        assert number.sub("#", ours) == number.sub("#", again)
        values = [[float(text) for text in number.findall(content)] for content in (ours, again)]
        assert values[0] == pytest.approx(values[1], abs=1e-3)
        assert (FIGURES / name).stat().st_size < 25_000


def test_filter_in_the_figure_is_the_one_in_the_camera_file(tmp_path):
    """Texts of the drawing against the file's values; the corner by hand: 1 / (2 pi sqrt(33e-6 *
    220e-6)) = 1868 Hz.
    """
    texts = words((FIGURES / "wiring_camera.svg").read_text(encoding="utf-8"))
    parts = load_camera().power_filter
    assert {
        f"{parts.damping_ohm:g} Ω",
        f"{parts.inductance_uh:g} µH",
        f"{parts.capacitance_uf:g} µF",
    } <= set(texts)
    assert any("corner 1.87 kHz" in text for text in texts)
    other = replace(load_camera(), power_filter=replace(parts, inductance_uh=47.0))
    wiring.draw_camera(tmp_path / "other.svg", other)
    assert "47 µH" in words((tmp_path / "other.svg").read_text(encoding="utf-8"))


def test_trainer_lead_is_the_firmwares():
    """Pins of the sketch, resistors of firmware/README.md."""
    sketch = (ROOT / "firmware" / "trainer_bridge" / "trainer_bridge.ino").read_text(
        encoding="utf-8"
    )
    assert f"PPM_OUT_PIN = {wiring.PPM_PIN}, PPM_IN_PIN = {wiring.PILOT_PIN}" in sketch
    guide = (ROOT / "firmware" / "README.md").read_text(encoding="utf-8")
    assert (
        "pin 11 --- 1k ---+--- 1k --- tip" in guide and "pin 49 --- 4.7k" in guide and "2k" in guide
    )
    texts = words((FIGURES / "wiring_trainer.svg").read_text(encoding="utf-8"))
    assert {"pin 11", "pin 49", "1 kΩ", "2 kΩ", "4.7 kΩ", "GND", "RESET"} <= set(texts)
    assert texts.count("1 kΩ") == 2


def test_levels_of_the_lead_are_those_by_hand():
    """5 * 2 / 3 = 3.333 V; against 5 V on the tip (5 - 3.333) / (667 + 1000) = 1.0 mA; 9 V on the
    pilot pin are (9 - 5.5) / 4700 = 0.745 mA, under the 1 mA of firmware/README.md. Pins of 3.3 V
    stand up to 3.6 V.
    """
    assert wiring.lead_levels(5.0) == pytest.approx(
        {"tip_v": 3.3333, "into_lead_a": 1e-3, "pilot_pin_a": 0.0}, rel=1e-4
    )
    assert wiring.lead_levels(9.0)["pilot_pin_a"] == pytest.approx(0.745e-3, rel=1e-3)
    assert wiring.lead_levels()["tip_v"] < 3.6


def test_levels_of_the_lead_solve_the_circuit():
    """The node's currents, written down separately, sum to zero."""
    radio_v = 4.0
    levels = wiring.lead_levels(radio_v)
    node_v = radio_v - levels["into_lead_a"] * wiring.PROTECTION
    out = (node_v - wiring.PIN_V) / wiring.DIVIDER_TOP + node_v / wiring.DIVIDER_BOTTOM
    assert out == pytest.approx(levels["into_lead_a"], rel=1e-9)


def test_planted_resistor_is_seen(monkeypatch):
    """Divider upside down: 1.67 V, which is neither the figure's value nor 3.3 V."""
    monkeypatch.setattr(wiring, "DIVIDER_TOP", 2000.0)
    monkeypatch.setattr(wiring, "DIVIDER_BOTTOM", 1000.0)
    assert wiring.lead_levels()["tip_v"] == pytest.approx(1.667, abs=1e-3)


def test_every_thing_on_the_ground_is_in_the_list_of_parts():
    """What the ground station's figure joins can be bought from hardware/parts.csv."""
    from falconwing_kit.tools.hardware.parts import load_parts

    ground = {item.id for item in load_parts() if item.used_in == "ground"}
    assert {
        "video_receiver",
        "capture_card",
        "computer",
        "trainer_board",
        "trainer_lead",
        "transmitter",
    } <= ground
    texts = " ".join(words((FIGURES / "wiring_ground.svg").read_text(encoding="utf-8")))
    for name in (
        "video receiver",
        "capture card",
        "computer",
        "Arduino Mega",
        "trainer lead",
        "transmitter",
        "2.4 GHz",
    ):
        assert name in texts


@pytest.mark.parametrize("name", [*NAMES, *CURVES, "bracket"])
def test_every_figure_has_a_text(name):
    """A sentence or more for those who cannot see it."""
    assert len((FIGURES / f"{name}.txt").read_text(encoding="utf-8").split()) > 30


def test_picture_of_the_brackets_can_be_made_again(tmp_path):
    """The same pixels, but for a few at edges."""
    from PIL import Image

    assert script("bracket/draw.py").main(["--out", str(tmp_path)]) == 0
    ours, again = (
        np.asarray(Image.open(folder / "bracket.png")).astype(float)
        for folder in (FIGURES, tmp_path)
    )
    assert ours.shape == again.shape == (420, 840)
    assert np.abs(ours - again).mean() < 0.5
    assert 0.15 < (ours < 250).mean() < 0.6  # there is something to see


def test_camera_without_a_filter_has_no_filter_to_draw(tmp_path):
    """A sentence, and no file."""
    with pytest.raises(InputError, match="power_filter"):
        wiring.draw_camera(tmp_path / "none.svg", load_camera("digital"))
    assert list(tmp_path.iterdir()) == []
