"""Figures of the manual from the data files: ripple behind the camera's filter, mass balance.

    .venv/bin/python hardware/draw.py

Writes filter.svg and balance.svg with descriptions to manual/figures/.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import builder_airframe_path, load_airframe
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, write_figures
from falconwing_kit.tools.hardware.cameras import load_camera
from falconwing_kit.tools.hardware.parts import load_parts, roll_up

FIGURES = Path(__file__).resolve().parents[1] / "manual" / "figures"
DARK, LIGHT = "0.1", "0.55"
STEADY = {
    "svg.fonttype": "none",
    "svg.hashsalt": "falconwing",
    "font.size": 10.0,
}  # letters as text, the same each time


def draw_filter(path: Path) -> str:
    """How strong ripple is behind the filter, against its frequency, with the damping resistor and
    without.

    Args:
        path: the SVG to write.

    Returns:
        The description.
    """
    camera = load_camera("analog")
    parts, load = camera.power_filter, camera.supply.load_ohm
    if parts is None:
        raise InputError(
            f"{camera.name}: expected a camera with a power_filter to draw, got one without"
        )
    bare, frequency = replace(parts, damping_ohm=0.0), np.logspace(2.0, 5.3, 300)
    figure, axes = _figure(6.4, 3.2)
    for each, style, label in (
        (parts, "-", f"with {parts.damping_ohm:g} Ω"),
        (bare, "--", "without it"),
    ):
        axes.semilogx(
            frequency / 1e3, -each.attenuation_db(frequency, load), style, color=DARK, label=label
        )
    noise = float(-parts.attenuation_db(1e3 * parts.switching_khz, load))
    axes.plot(parts.switching_khz, noise, "o", color=DARK)
    text = f"speed controller,\n{parts.switching_khz:g} kHz: {noise:.0f} dB"
    axes.annotate(text, (parts.switching_khz, noise), xytext=(8, 8), textcoords="offset points")
    axes.axvline(parts.corner_hz / 1e3, color=LIGHT, linewidth=0.8)
    axes.text(parts.corner_hz / 1e3 * 1.08, -48.0, f"corner {parts.corner_hz / 1e3:.2f} kHz")
    axes.set(xlabel="frequency [kHz]", ylabel="ripple behind the filter [dB]", ylim=(-55.0, 10.0))
    axes.set_xticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])
    axes.legend(title="damping resistor", loc="lower left", frameon=False)
    _save(figure, path)
    text = f"""Ripple behind the camera's filter against frequency, computed. Below 1 kHz all of it
        passes. Near the corner at {parts.corner_hz / 1e3:.2f} kHz it is {parts.peak_db(load):.1f}
        dB stronger with the damping resistor and {bare.peak_db(load):.1f} dB without. Above, it
        falls; at {parts.switching_khz:g} kHz, where the speed controller is taken to switch, it is
        at {noise:.0f} dB."""
    return " ".join(text.split())


def draw_balance(path: Path) -> str:
    """Where each part weighs along the fuselage, and the centre of gravity as bought and with
    everything on.

    Args:
        path: the SVG to write.

    Returns:
        The description.
    """
    items, airframe = load_parts(), load_airframe(builder_airframe_path())
    chord_mm = 1000.0 * airframe.mean_chord
    cg_mm, flying = 1000.0 * roll_up(items).x_cg, [item for item in items if item.counts]
    bought_mm = next(1000.0 * (item.x or 0.0) for item in items if item.id == "airframe")
    figure, axes = _figure(6.4, 2.9)
    axes.plot([0.0, chord_mm], [0.0, 0.0], color=LIGHT, linewidth=9.0, solid_capstyle="butt")
    axes.text(chord_mm + 4.0, 0.0, "wing", va="center")
    places: dict[float, list[str]] = {}
    for item in flying:
        if item.id != "airframe":
            places.setdefault(1000.0 * (item.x or 0.0), []).append(
                f"{item.id.replace('_', ' ')} {1000.0 * item.mass:.1f} g"
            )
    for k, (x_mm, names) in enumerate(sorted(places.items(), reverse=True)):
        level = 1.0 + 0.9 * k
        axes.plot([x_mm, x_mm], [0.0, level], color=LIGHT, linewidth=0.8)
        axes.plot(x_mm, 0.0, "s", color=DARK, markersize=4)
        axes.text(x_mm, level, "; ".join(names), va="bottom", fontsize=8.5)
    if airframe.propeller is not None and airframe.x_leading_edge is not None:
        disc_mm = 1000.0 * (airframe.x_leading_edge - airframe.propeller.x)
        axes.plot([disc_mm, disc_mm], [-0.9, 0.9], color=DARK, linewidth=1.0, linestyle=":")
        axes.text(disc_mm, 1.0, "propeller", ha="center", fontsize=8.5)
    marks = (
        (bought_mm, f"as bought, {bought_mm:.0f} mm"),
        (cg_mm, f"all on, {cg_mm:.0f} mm"),
    )
    for k, (x_mm, text) in enumerate(marks):
        axes.plot(
            x_mm, 0.0, "o", markersize=10, color=DARK, markerfacecolor="white" if k == 0 else DARK
        )
        axes.annotate(
            text,
            (x_mm, -0.25),
            xytext=(60 - 170 * k, -32),
            textcoords="offset points",
            arrowprops={"arrowstyle": "-", "color": DARK},
        )
    axes.set(
        xlim=(-180.0, 180.0),
        ylim=(-1.9, 5.6),
        yticks=[],
        xlabel="behind the wing's leading edge [mm]; nose to the left",
    )
    axes.spines["left"].set_visible(False)
    _save(figure, path)
    listed = "; ".join(f"{x_mm:.0f} {', '.join(names)}" for x_mm, names in sorted(places.items()))
    text = f"""The aircraft from its left side, to scale along the fuselage; masses and places are
        partly estimates. The wing reaches from 0 to {chord_mm:.0f} mm. As bought, {bought_mm:.0f}
        mm behind its leading edge, the aircraft is in balance. Behind the leading edge,
        ahead of it negative [mm]: {listed}. With all of them on, the centre of gravity is at
        {cg_mm:.0f} mm."""
    return " ".join(text.split())


def _figure(wide: float, high: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(wide, high), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _save(figure: Any, path: Path) -> None:
    import matplotlib

    with matplotlib.rc_context(STEADY), atomic_write(path) as file:
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})


FIGURES_MADE: dict[str, Callable[[Path], str]] = {"filter": draw_filter, "balance": draw_balance}


def main(words: list[str] | None = None) -> int:
    """Draw both.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0.
    """
    parser = argparse.ArgumentParser(description="Figures from the hardware's data files.")
    parser.add_argument("--out", type=Path, default=FIGURES, help="folder to write to")
    for line in write_figures(parser.parse_args(words).out, FIGURES_MADE):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
