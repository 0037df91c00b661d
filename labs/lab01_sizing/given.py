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


def draw_turn(width: float, radius: float, bank_deg: float, ax: Any = None) -> None:
    """Draw a full circle between two walls, seen from above, centred between them.

    Args:
        width: of the hall [m].
        radius: of the path of the centre of gravity [m].
        bank_deg: bank angle [deg]; the wing reaches span / 2 * cos(bank) beyond the path, to both
            sides.
        ax: of matplotlib, to draw into; a new figure's if None.
    """
    if ax is None:
        import matplotlib.pyplot as plt

        ax = plt.subplots(figsize=(6, 6))[1]
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


def moving_circles() -> Any:
    """A film from above: the paper's 150 g and its "300 g" turn, each with the numbers printed."""
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure, plan_view

    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    ax: Any = figure.subplots()
    ax.plot([-20, 20, 20, -20, -20], [-10, -10, 10, 10, -10], color="black", linewidth=3)
    ax.set(xlabel="along the hall [m]", ylabel="across [m]", aspect="equal", ylim=(-13.5, 13))
    turns = (("150 g", 7.04, 8.7, BLUE, "-"), ("300 g", 10.0, 17.5, ORANGE, "--"))
    drawn = []
    for name, speed, radius, colour, line in turns:
        label = f"{name}: {speed:.0f} m/s, radius {radius} m"
        track = ax.plot([], [], line, color=colour, label=label)[0]
        drawn.append((track, ax.fill([0], [0], color=colour)[0]))
    ax.legend(loc="lower right", ncols=2)
    hit = ax.text(-19.5, 11.0, "", color=ORANGE)

    def draw(number: int) -> None:
        t = 0.2 * number
        ax.set_title(
            f"Both begin to turn to the right at the same place: {t:.1f} s (paper's numbers)"
        )
        for (_, speed, radius, _, _), (track, outline) in zip(turns, drawn, strict=True):
            reach = min(t, radius / speed * np.arccos(1.0 - 18.7 / radius)) if radius > 9.4 else t
            angle = speed / radius * np.linspace(0.0, reach, 60)
            x, y = radius * np.sin(angle), 8.7 - radius + radius * np.cos(angle)
            track.set_data(x, y)
            outline.set_xy(plan_view(x[-1], y[-1], angle[-1], span=2.0).T)
            if reach < t:
                hit.set_text(f"300 g meet the wall after {reach:.1f} s")
        if number == 0:
            hit.set_text("")

    words = "From above: 150 g fly a circle inside the hall, 300 g meet the opposite wall."
    return moving_figure(figure, draw, 41, 0.2, words)
