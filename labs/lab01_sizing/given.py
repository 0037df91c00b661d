"""Lab 1, given: the paper's aircraft, air, your course's numbers, and the drawing of a turn."""

import json
from pathlib import Path
from typing import Any

import numpy as np

COHORT: dict[str, float] = json.loads(
    (Path(__file__).parent / "cohort.json").read_text(encoding="utf-8")
)

GRAVITY = 9.8  # [m/s^2], paper, Appendix
WING_AREA = 0.076  # S [m^2], paper, Appendix
LIFT_COEFFICIENT = 0.6  # C [-], design value, paper, Appendix; not the stall
SPAN = 0.70  # b [m], paper, hardware section
PAPER_AIR_DENSITY = 1.3  # rho [kg/m^3], paper, Appendix
PRESSURE = 101325.0  # p [Pa], air at sea level
AIR_GAS_CONSTANT = 287.05  # R [J/(kg K)], dry air

# What the paper lists: name, count, mass of one [g], place behind the leading edge [mm] (an
# estimate), weighed with.
PARTS = [
    ("airframe", 1, 137.0, 36.0, ""),
    ("receiver", 1, 13.5, 36.0, "airframe"),
    ("camera", 1, 9.0, 12.0, ""),
    ("bracket", 1, 5.0, 16.0, ""),
]

BLUE, ORANGE, GREEN = (
    "#0072B2",
    "#D55E00",
    "#009E73",
)  # distinguishable for colour-blind readers (Okabe and Ito)


def draw_turn(width: float, radius: float, bank_deg: float) -> None:
    """Draw a full circle between two walls, seen from above, centred between them.

    Args:
        width: of the hall [m].
        radius: of the path of the centre of gravity [m].
        bank_deg: bank angle [deg]; the wing reaches span / 2 * cos(bank) beyond the path, to both
            sides.
    """
    import matplotlib.pyplot as plt

    ax: Any = plt.subplots(figsize=(6, 6))[1]
    reach = 0.5 * SPAN * np.cos(np.radians(bank_deg))
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    ax.plot(radius * np.cos(angle), radius * np.sin(angle), color=BLUE, label="centre of gravity")
    for r in (radius - reach, radius + reach):
        ax.plot(
            r * np.cos(angle),
            r * np.sin(angle),
            ":",
            color=BLUE,
            label="wing tip" if r < radius else None,
        )
    half, clearance = 0.5 * width, COHORT["wall_clearance"]
    for side in (-1.0, 1.0):
        ax.axvline(side * half, color="black", linewidth=3, label="wall" if side < 0 else None)
        ax.axvline(
            side * (half - clearance),
            linestyle="--",
            color=ORANGE,
            label="clearance" if side < 0 else None,
        )
    limit = max(half, radius) + 1.5
    ax.set(
        xlim=(-limit, limit),
        ylim=(-limit, limit),
        aspect="equal",
        xlabel="across the hall [m]",
        ylabel="along [m]",
    )
    room = half - clearance - reach - radius
    verdict = (
        f"fits, {room:.2f} m to spare on each side"
        if room >= 0.0
        else f"{-room:.2f} m too wide on each side"
    )
    ax.set_title(f"bank {bank_deg:.0f}°: {verdict}")
    ax.legend(loc="center")
