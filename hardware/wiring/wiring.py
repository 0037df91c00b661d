"""Wiring diagrams: camera file and firmware pins -> three SVG figures with descriptions.

    .venv/bin/python hardware/wiring/wiring.py

Values of the filter are from hardware/camera_analog.toml, those of the trainer lead from the
constants below, as in firmware/README.md. Needs the extra `manual` (schemdraw).
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, write_figures
from falconwing_kit.tools.hardware.cameras import CameraHardware, load_camera

FIGURES = Path(__file__).resolve().parents[2] / "manual" / "figures"
PPM_PIN, PILOT_PIN = 11, 49  # of the Arduino Mega: OC1A and ICP4
PIN_V = 5.0  # of its pins
DIVIDER_TOP, DIVIDER_BOTTOM, PROTECTION, LISTENING = 1000.0, 2000.0, 1000.0, 4700.0  # [ohm]
DROP_OF_CLAMP_V = 0.5  # over its supply, at which a pin's own diode begins to conduct
WIDE, HIGH = 4.4, 1.9  # of a box of the ground station
BOXES = {  # column, row, what it is
    "camera": (0, 0, "aircraft: camera"),
    "video": (1, 0, "video receiver"),
    "card": (2, 0, "USB capture card"),
    "computer": (3, 0, "computer:\nfalconwing"),
    "board": (3, 1, "Arduino Mega\ntrainer bridge"),
    "radio": (2, 1, "transmitter\nwith trainer port"),
    "pilot": (2, 2, "safety pilot\nholds the switch"),
    "receiver": (1, 1, "aircraft: receiver"),
    "remote": (3, 2, "remote receiver"),
}
JOINTS = (  # from, to, by what
    ("camera", "video", "5.8 GHz"),
    ("video", "card", "composite"),
    ("card", "computer", "USB"),
    ("computer", "board", "USB"),
    ("board", "radio", "trainer\nlead 16a"),
    ("remote", "board", "pin 19"),
    ("pilot", "radio", ""),
    ("radio", "receiver", "2.4 GHz"),
)
FONT = {
    "fontsize": 13,
    "font": "sans-serif",
    "lw": 1.4,
    "margin": 0.6,
}  # text is wider than schemdraw thinks


def lead_levels(radio_v: float = 0.0) -> dict[str, float]:
    """Voltages and currents of the trainer lead, pin 11 high.

    Open: V = 5 R2 / (R1 + R2).  Radio at V_r: the divider is a source of that voltage behind R1 ||
        R2, the protection
    resistor in series; I = (V_r - V) / (R1 || R2 + R3).                       [Thevenin, textbook]

    Args:
        radio_v: what a radio that drives its jack as well puts on the tip [V].

    Returns:
        tip_v: open; into_lead_a: current from the radio's tip into the lead [A]; pilot_pin_a:
            current into the pilot
        pin's own diode if the radio's output had that voltage and the board 5 V [A].
    """
    tip_v = PIN_V * DIVIDER_BOTTOM / (DIVIDER_TOP + DIVIDER_BOTTOM)
    source = DIVIDER_TOP * DIVIDER_BOTTOM / (DIVIDER_TOP + DIVIDER_BOTTOM) + PROTECTION
    pilot = max(0.0, radio_v - PIN_V - DROP_OF_CLAMP_V) / LISTENING
    return {"tip_v": tip_v, "into_lead_a": (radio_v - tip_v) / source, "pilot_pin_a": pilot}


def draw_camera(path: Path, camera: CameraHardware) -> str:
    """Battery, speed controller, filter, camera.

    Args:
        path: the SVG to write.
        camera: with a power filter.

    Returns:
        The description.
    """
    import schemdraw.elements as elm

    parts = camera.power_filter
    if parts is None:
        raise InputError(
            f"{camera.name}: expected a camera with a power_filter to draw, got one without"
        )
    drawing = _drawing()
    battery = drawing.add(elm.Battery().up().reverse().label("2S LiPo\n6.0 to 8.4 V", loc="top"))
    drawing.add(elm.Line().right(2.2).at(battery.end))
    tap = drawing.add(elm.Dot())
    drawing.add(elm.Line().right(1.2))
    drawing.add(elm.Resistor().right().label(f"{parts.damping_ohm:g} Ω", loc="top"))
    drawing.add(elm.Inductor2().right().label(f"{parts.inductance_uh:g} µH", loc="top"))
    node = drawing.add(elm.Dot())
    drawing.add(elm.Line().right(2.6).label("+", loc="right"))
    right = drawing.here
    drawing.add(
        elm.Capacitor(polar=True)
        .down()
        .at(node.center)
        .label(f"{parts.capacitance_uf:g} µF\n16 V", loc="bot")
    )
    low = drawing.add(elm.Dot())
    drawing.add(elm.Line().left().tox(battery.start))
    drawing.add(elm.Line().right(2.6).at(low.center).label("−", loc="right"))
    eye = f"{camera.name}\ncamera and\n5.8 GHz video\ntransmitter"
    _box(drawing, (right[0] + 0.4, battery.start[1] - 0.4), 3.6, 3.8, eye)
    drawing.add(elm.Line().up(1.0).at((right[0] + 2.2, battery.end[1] + 0.4)))
    drawing.add(elm.Antenna())
    drawing.add(elm.Line().up(1.2).at(tap.center))
    motor = "speed controller, motor\n(its minus to battery −)"
    _box(drawing, (tap.center[0] - 2.6, tap.center[1] + 1.2), 5.2, 1.6, motor)
    drawing.add(elm.Label().at((7.6, -1.1)).label(f"filter: {_figures(camera)}"))
    _save(drawing, path)
    return _one_line(f"""The camera's supply. From the plus of the flight battery (2S, 6.0 to 8.4
        V) one branch goes to the speed controller and motor. The other goes through a resistor of
        {parts.damping_ohm:g} ohm and a coil of {parts.inductance_uh:g} uH to the plus of the
        {camera.name}, camera and video transmitter. Between coil and camera a capacitor of
        {parts.capacitance_uf:g} uF, 16 V, leads to the battery's minus, its plus leg at the coil
        and its striped leg at minus. Minus goes straight to the camera. The filter has
        {_figures(camera)}. The video antenna is on before power is.""")


def draw_trainer(path: Path) -> str:
    """Arduino, divider, protection, jack; pilot input; reset capacitor.

    Args:
        path: the SVG to write.

    Returns:
        The description.
    """
    import schemdraw.elements as elm

    drawing, open_v = _drawing(), lead_levels()["tip_v"]
    shared_ma, pilot_ma = (
        1e3 * lead_levels(5.0)["into_lead_a"],
        1e3 * lead_levels(9.0)["pilot_pin_a"],
    )
    names = [
        ("11", f"pin {PPM_PIN}"), ("gnd", "GND"), ("49", f"pin {PILOT_PIN}"), ("gnd_b", "GND"),
        ("3v3", "3.3V"), ("19", "RX1 19"), ("gnd_c", "GND"), ("rst", "RESET"),
    ]  # fmt: skip
    heights = (0.0, -2.6, -4.6, -6.0, -8.0, -9.3, -10.6, -12.6)
    pins = {name: (0.0, y) for (name, _), y in zip(names, heights, strict=True)}
    _box(drawing, (-4.2, -13.8), 4.2, 15.0, "Arduino\nMega 2560")
    for (_, text), (x, y) in zip(names, pins.values(), strict=True):
        drawing.add(elm.Label().at((x - 0.15, y)).label(text, halign="right", loc="center"))
    drawing.add(elm.Resistor().right().at(pins["11"]).label("1 kΩ", loc="top"))
    node = drawing.add(elm.Dot())
    drawing.add(elm.Resistor().right().label("1 kΩ", loc="top"))
    drawing.add(elm.Line().right(1.0))
    drawing.add(
        elm.Dot(open=True).label(f"16a: tip of a 3.5 mm\nmono plug, {open_v:.2f} V", loc="right")
    )
    drawing.add(elm.Resistor().down().at(node.center).toy(pins["gnd"]).label("2 kΩ", loc="bot"))
    low = drawing.add(elm.Dot())
    drawing.add(elm.Line().at(pins["gnd"]).to(low.center))
    drawing.add(elm.Line().right(4.0).at(low.center))
    drawing.add(elm.Dot(open=True).label("16a: its sleeve", loc="right"))
    drawing.add(elm.Resistor().right().at(pins["49"]).label("4.7 kΩ", loc="top"))
    drawing.add(elm.Line().right(4.0))
    drawing.add(
        elm.Dot(open=True).label("16b: tip of the second\nplug, radio's output", loc="right")
    )
    ends = [
        ("gnd_b", "16b: its sleeve"),
        ("3v3", "32: remote receiver, plus"),
        ("19", "32: its data"),
        ("gnd_c", "32: its minus"),
    ]
    for name, text in ends:
        drawing.add(elm.Line().right(7.0).at(pins[name]))
        drawing.add(elm.Dot(open=True).label(text, loc="right"))
    drawing.add(elm.Capacitor(polar=True).right().at(pins["rst"]))
    drawing.add(elm.Line().right(1.0))
    drawing.add(elm.Ground().label("10 µF, once flashed", loc="right"))
    _save(drawing, path)
    return _one_line(f"""The trainer lead. Pin {PPM_PIN} of the Arduino Mega goes through 1 kilohm
        to a node; from the node 2 kilohm go to ground and 1 kilohm to the tip of a 3.5 mm mono
        plug, which then carries {open_v:.2f} V where the pin has 5 V. Ground goes to the sleeve.
        The second 1 kilohm limits the current where the radio drives the line too: at 5 V
        {shared_ma:.1f} mA. To measure and record, the tip of the radio's own output goes through
        4.7 kilohm to pin {PILOT_PIN}, where 9 V push {pilot_ma:.2f} mA into the pin. A capacitor
        of 10 uF from RESET (plus) to ground is put in once the board is flashed. Levels and
        polarity of the radio are to be measured first. The second plug's sleeve goes to GND
        as well. The remote receiver has its plus at the board's 3.3 V, its data at pin 19
        (RX1) and its minus at GND. Pin {PPM_PIN} never meets the radio's output.""")


def draw_ground(path: Path) -> str:
    """What is joined to what on the ground and in the air.

    Args:
        path: the SVG to write.

    Returns:
        The description.
    """
    import schemdraw.elements as elm

    drawing = _drawing()
    drawing.config(
        fontsize=17
    )  # the widest of the three: smaller letters could not be read on a page
    for column, row, text in BOXES.values():
        _box(drawing, (7.0 * column, -3.9 * row), WIDE, HIGH, text)
    for start, end, text in JOINTS:
        (a, b, _), (c, d, _) = BOXES[start], BOXES[end]
        ways = (c > a) - (c < a), (b > d) - (b < d)  # to the right, up
        from_end, to_end = (
            (
                7.0 * k + WIDE / 2.0 * (1 + side * ways[0]),
                -3.9 * m + HIGH / 2.0 * (1 + side * ways[1]),
            )
            for k, m, side in ((a, b, 1), (c, d, -1))
        )
        line = elm.Arrow().at(from_end).to(to_end).linestyle("--" if "GHz" in text else "-")
        drawing.add(line.label(text, loc="top" if ways[1] == 0 else "bot") if text else line)
    _save(drawing, path)
    return _one_line("""The ground station. The aircraft's camera sends its picture by radio at 5.8
        GHz to the video receiver; a composite cable leads to the USB capture card, and a USB cable
        to the computer, where falconwing runs. A second USB cable leads from the computer to the
        Arduino Mega, the trainer bridge; the trainer lead (16a) leads from it to the
        transmitter, and in its place the measuring lead (16b) from the transmitter to it while the
        radio is measured.
        A remote receiver on its pin 19 gives it the pilot's sticks. The
        safety pilot holds the transmitter and its trainer switch. The transmitter sends at 2.4 GHz
        to the receiver in the aircraft. Dashed lines are radio, the others are cables.""")


def _figures(camera: CameraHardware) -> str:
    """What the filter does, in a line."""
    parts, load = camera.power_filter, camera.supply.load_ohm
    if parts is None:
        return "none"
    weaker = float(parts.attenuation_db(1e3 * parts.switching_khz, load))
    corner, damping = parts.corner_hz / 1e3, parts.damping(load)
    return (
        f"corner {corner:.2f} kHz, damping {damping:.2f}, "
        f"{weaker:.0f} dB less at {parts.switching_khz:g} kHz"
    )


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _drawing() -> Any:
    """An empty drawing that becomes an SVG with its letters as text."""
    import schemdraw
    from schemdraw.backends.svg import config

    schemdraw.use("svg")
    config.text = "text"
    drawing = schemdraw.Drawing(show=False)
    drawing.config(**FONT)
    return drawing


def _box(drawing: Any, corner: tuple[float, float], wide: float, high: float, text: str) -> None:
    """A named box; corner is its lower left one."""
    import schemdraw.elements as elm

    x, y = corner
    drawing.add(elm.Rect(corner1=(0, 0), corner2=(wide, high)).at((x, y)).right())
    drawing.add(elm.Label().at((x + wide / 2.0, y + high / 2.0)).label(text, loc="center"))


def _save(drawing: Any, path: Path) -> None:
    content = drawing.get_imagedata("svg").decode("utf-8")
    with atomic_write(path, text=True) as file:
        file.write("\n".join(line.rstrip() for line in content.splitlines()) + "\n")


FIGURES_MADE: dict[str, Callable[[Path], str]] = {
    "wiring_camera": lambda path: draw_camera(path, load_camera("analog")),
    "wiring_trainer": draw_trainer,
    "wiring_ground": draw_ground,
}


def main(words: list[str] | None = None) -> int:
    """Draw all three.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0.
    """
    parser = argparse.ArgumentParser(description="Wiring diagrams as SVG, with a text for each.")
    parser.add_argument("--out", type=Path, default=FIGURES, help="folder to write to")
    for line in write_figures(parser.parse_args(words).out, FIGURES_MADE):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
