"""Drawings of the manual: the kit's data files -> SVG figures, and their descriptions.

All are drawn, none is a photo; greys and dashes only, for a monochrome printer. `make_figures.py`
calls the functions of DRAWINGS.
"""

import math
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from falconwing_kit.aircraft.airframe import Airframe, builder_airframe_path, load_airframe
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.messages import COMMAND_NAMES, Command
from falconwing_kit.tools.hardware.parts import load_parts, roll_up
from falconwing_kit.trainer_port.ppm import load_calibration

MANUAL = Path(__file__).resolve().parents[1]
DARK, MIDDLE, LIGHT, PALE = "0.1", "0.45", "0.7", "0.92"
STEADY = {
    "svg.fonttype": "none",
    "svg.hashsalt": "falconwing",
    "font.size": 9.5,
    "axes.labelsize": 9.5,
}
HALL = Hall()


@contextmanager
def drawing(
    path: Path, wide: float, high: float, rows: int = 1, columns: int = 1, **grid: Any
) -> Iterator[Any]:
    """Axes [rows, columns] without upper and right frame; on exit an SVG of that size [inch]."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STEADY):
        figure = Figure(figsize=(wide, high), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **grid)
        for each in axes.flat:
            each.spines[["top", "right"]].set_visible(False)
        yield axes
        with atomic_write(path) as file:
            figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})


def bare(axes: Any, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Set axes without frame and ticks, with equal scales."""
    axes.set(xlim=x, ylim=y, aspect="equal")
    axes.axis("off")


def box(
    axes: Any, x: float, y: float, text: str, wide: float = 2.3, high: float = 1.0, **look: Any
) -> None:
    """Draw a box with text, centred at a point."""
    from matplotlib.patches import FancyBboxPatch

    look = {"facecolor": "white", "edgecolor": DARK, "linewidth": 1.1, **look}
    corner = (x - wide / 2.0, y - high / 2.0)
    axes.add_patch(
        FancyBboxPatch(corner, wide, high, boxstyle="round,pad=0,rounding_size=0.12", **look)
    )
    axes.text(x, y, text, ha="center", va="center", fontsize=9.0)


def arrow(
    axes: Any, begin: tuple[float, float], end: tuple[float, float], text: str = "", **look: Any
) -> None:
    """Draw an arrow with text above its middle; `shift` moves the text, `bend` curves it."""
    shift, bend = look.pop("shift", (0.0, 0.13)), look.pop("bend", 0.0)
    style = {
        "arrowstyle": "-|>",
        "color": DARK,
        "lw": 1.1,
        "connectionstyle": f"arc3,rad={bend}",
        **look,
    }
    axes.annotate("", end, begin, arrowprops={**style, "shrinkA": 0.0, "shrinkB": 0.0})
    middle = ((begin[0] + end[0]) / 2.0 + shift[0], (begin[1] + end[1]) / 2.0 + shift[1])
    axes.text(*middle, text, ha="center", va="bottom", fontsize=8.2)


def draw_loop(path: Path) -> str:
    """Draw the 20 Hz loop and its two pairs of ends."""
    with drawing(path, 6.6, 2.65) as axes:
        (ax,) = axes.flat
        bare(ax, (-0.2, 13.4), (-0.4, 5.2))
        real = "camera, 5.8 GHz,\nreceiver, capture card", "Arduino board,\ntransmitter, aircraft"
        simulated = "splat scene,\nsimulated camera", "the same program,\nmodel of the aircraft"
        for y, names in ((4.0, real), (0.8, simulated)):
            look = {"facecolor": PALE} if y < 2.0 else {}
            box(ax, 1.5, y, names[0], 3.2, 1.2, **look)
            box(ax, 11.7, y, names[1], 3.2, 1.2, **look)
        for x, text in (
            (4.3, "frame\nmonitor"),
            (6.6, "pilot or\ncontroller"),
            (8.9, "trainer port\nand log"),
        ):
            box(ax, x, 2.4, text, 1.8, 1.0)
        for y, at in ((4.0, 2.55), (0.8, 2.25)):
            arrow(
                ax, (3.1, y), (3.75, at + (0.35 if y > 2.0 else -0.35)), ls="-" if y > 2.0 else "--"
            )
            arrow(
                ax,
                (9.45, at + (0.35 if y > 2.0 else -0.35)),
                (10.1, y),
                ls="-" if y > 2.0 else "--",
            )
        arrow(ax, (5.2, 2.4), (5.7, 2.4))
        arrow(ax, (7.5, 2.4), (8.0, 2.4))
        ax.text(6.6, 4.0, "with an aircraft", ha="center", va="center", fontsize=9.5, weight="bold")
        ax.text(6.6, 0.8, "in simulation", ha="center", va="center", fontsize=9.5, weight="bold")
        ax.text(6.6, 3.25, "20 times a second, the same program", ha="center", fontsize=8.5)
    return """The loop that runs 20 times a second. In the middle, the same for both: frame
        monitor, then pilot or controller, then trainer port and log. With an aircraft the picture
        comes from camera, 5.8 GHz link, receiver and capture card, and the command goes to the
        Arduino board, the transmitter and the aircraft. In simulation, dashed, the picture comes
        from a scene of splats through a simulated camera, and the command goes to the board's same
        program and a model of the aircraft."""


def draw_aircraft(path: Path) -> str:
    """Draw the positions of the added parts, from the left side and from above."""
    frame, items = load_airframe(builder_airframe_path()), load_parts()
    cg, span, chord = 1000.0 * roll_up(items).x_cg, 1000.0 * frame.span, 1000.0 * frame.mean_chord
    place = {
        item.id: 1000.0 * item.x for item in items if item.x is not None
    }  # behind the leading edge [mm]
    added = {
        "camera, bracket": (place["camera_analog"], -1000.0 * frame.p_body_camera[2], (-120, 88)),
        "filter and wires": ((place["filter_inductor"] + place["wires"]) / 2.0, 0, (-155, 64)),
        "battery": (place["battery"], 0, (-30, -75)),
        "receiver, inside": (30.0, 0, (60, -75)),  # the list gives it no place
    }
    with drawing(path, 6.6, 4.6, 2, 1, height_ratios=[1.0, 2.0]) as axes:
        side, top = axes.flat
        from_the_side(side, chord, frame)
        from_above(top, chord, span, frame)
        lens = place["camera_analog"]
        side.plot([lens, lens], [58, -1000.0 * frame.p_body_camera[2]], color=DARK, lw=1.0)
        for text, (x, y, at) in added.items():
            side.plot(x, y, "s", ms=7, color=DARK)
            pointed_at(side, text, (x, y), at)
            top.plot(x, 0, "s", ms=6, color=DARK)
        top.plot(cg, 0, "o", ms=10, mfc="white", mec=DARK)
        pointed_at(top, "balance with\nall parts on", (cg, 0), (-232, 300))
    return f"""The aircraft, drawn from the left side and from above, nose to the left; outlines
        are schematic, places along the fuselage are those of the list of parts, partly estimates.
        Above the wing, the lens flush with its leading edge, sit camera and bracket; ahead of them
        filter and wires; the battery in its hatch ahead of the wing; the receiver inside. Seen from
        above: {span / 10:.0f} cm of wing with ailerons outside and flaps inside, elevator at the
        tail; the rudder stands on the fin. With all parts on the balance is {cg:.0f} mm behind the
        wing's leading edge."""


def ends_of(frame: Airframe) -> tuple[float, float]:
    """Spinner's tip and tail [mm behind the leading edge]."""
    nose = 1000.0 * ((frame.x_leading_edge or 0.0) - frame.p_body_nose[0])
    return nose, nose + 1000.0 * frame.length


def from_the_side(ax: Any, chord: float, frame: Airframe) -> None:
    """Fuselage, wing [mm], fin, wheels, propeller and its disc, seen from the left."""
    (nose, tail), cowl = ends_of(frame), ends_of(frame)[0] + 10
    radius = 500.0 * (frame.propeller.diameter if frame.propeller else 0.0)
    bare(ax, (-235.0, 395.0), (-95.0, 105.0))
    ax.fill(
        [cowl, cowl + 20, -30, 120, tail, tail, 120, cowl + 25, cowl],
        [-8, 25, 42, 34, 16, 4, -34, -34, -22],
        PALE,
        ec=DARK,
    )
    ax.fill([nose, cowl, cowl], [0, 9, -9], "white", ec=DARK)
    ax.fill([0, chord, chord, 0], [42, 42, 53, 58], LIGHT, ec=DARK)
    ax.fill([tail - 60, tail, tail, tail - 30], [16, 16, 80, 80], PALE, ec=DARK)
    ax.plot([nose, nose], [-radius, radius], color=DARK, lw=1.0, ls=":")
    for x, y, size in ((-50, -80, 13), (330, -10, 6)):
        ax.plot(x, y, "o", ms=size, mfc="white", mec=DARK)
    ax.plot([-35, -50], [-34, -74], color=DARK, lw=1.0)
    ax.text(tail + 7, 55, "rudder", va="center", fontsize=8.5)
    pointed_at(ax, "propeller", (nose, -0.8 * radius), (-232, -92))


def from_above(ax: Any, chord: float, span: float, frame: Airframe) -> None:
    """Fuselage, wing [mm], tail and their surfaces."""
    nose, tail = ends_of(frame)
    bare(ax, (-235.0, 395.0), (-385.0, 385.0))
    ax.fill(
        [nose, nose + 12, -30, tail, tail, -30, nose + 12, nose],
        [-12, -26, -32, -8, 8, 32, 26, 12],
        PALE,
        ec=DARK,
    )
    ax.fill([0, chord, chord, 0], [-span / 2, -span / 2, span / 2, span / 2], "white", ec=DARK)
    ax.fill([tail - 65, tail, tail, tail - 65], [-115, -115, 115, 115], "white", ec=DARK)
    for low, high, text in (
        (190, 335, "aileron"),
        (40, 185, "flap"),
        (-185, -40, "flap"),
        (-335, -190, "aileron"),
    ):
        ax.fill(
            [chord - 25, chord, chord, chord - 25], [low, low, high, high], LIGHT, ec=DARK, lw=0.8
        )
        ax.text(chord + 8, (low + high) / 2, text, va="center", fontsize=8.5)
    ax.text(tail + 7, 60, "elevator", va="center", fontsize=8.5)
    ax.annotate(
        "", (-22, span / 2), (-22, -span / 2), arrowprops={"arrowstyle": "<->", "color": MIDDLE}
    )
    ax.text(-28, -200, f"{span / 10:.0f} cm", ha="right", fontsize=8.5)
    ax.text(170, -330, "nose to the left", fontsize=8.5)


def pointed_at(ax: Any, text: str, place: tuple[float, float], at: tuple[float, float]) -> None:
    """Words somewhere with a line to a place."""
    ax.annotate(text, place, at, fontsize=8.5, arrowprops={"arrowstyle": "-", "color": MIDDLE})


def draw_hours(path: Path) -> str:
    """Minutes of each step of the assembly, added up."""
    with (MANUAL / "assembly.toml").open("rb") as file:
        steps = tomllib.load(file)["steps"]
    total = 0
    with drawing(path, 6.6, 0.9 + 0.14 * len(steps)) as axes:
        (ax,) = axes.flat
        for k, step in enumerate(steps):
            ax.barh(k, step["minutes"], left=total, color=LIGHT, edgecolor=DARK, lw=0.8)
            at = (total - 5, "right") if total > 200 else (total + step["minutes"] + 5, "left")
            ax.text(
                at[0],
                k,
                f"{step['title']}, {step['minutes']} min",
                ha=at[1],
                va="center",
                fontsize=8.5,
            )
            total += step["minutes"]
        ax.axvline(600, color=DARK, ls="--", lw=1.0)
        ax.text(596, 1.0, "paper: under 10 h", ha="right", fontsize=8.5)
        ax.set(
            ylim=(len(steps) - 0.4, -0.6),
            xlim=(0, 620),
            xlabel="hours of work, estimated",
            yticks=[],
        )
        ax.set_xticks([60 * hour for hour in range(0, 11)], [str(hour) for hour in range(0, 11)])
        ax.spines["left"].set_visible(False)
    listed = "; ".join(f"{step['title']} {step['minutes']}" for step in steps)
    return f"""Estimated minutes of each step, one after the other: {listed}. Together
        {total / 60:.1f} hours; the paper says under 10 hours."""


def draw_ppm(path: Path) -> str:
    """One frame of pulses, throttle idle and the other sticks in the middle, as the shipped
    settings make it.
    """
    calibration = load_calibration(None)
    slots = calibration.channels_us(Command(0.0, 0.0, 0.0, 0.0))
    names = sorted(COMMAND_NAMES, key=lambda name: getattr(calibration, name).channel)
    t, level = [0.0], [1.0]
    edges = [500.0]
    for us in slots:
        edges.append(edges[-1] + us)
    for edge in [*edges, edges[0] + calibration.frame_us]:
        t += [edge, edge, edge + calibration.gap_us, edge + calibration.gap_us]
        level += [1.0, 0.0, 0.0, 1.0]
    with drawing(path, 6.6, 1.7) as axes:
        (ax,) = axes.flat
        ax.plot([us / 1000.0 for us in [*t, t[-1] + 700]], [*level, 1.0], color=DARK, lw=1.3)
        for k, (name, us) in enumerate(zip(names, slots, strict=True)):
            low, high = edges[k] / 1000.0, edges[k + 1] / 1000.0
            ax.annotate(
                "", (high, -0.28), (low, -0.28), arrowprops={"arrowstyle": "<->", "color": MIDDLE}
            )
            ax.text(
                (low + high) / 2, -0.85, f"{name}\n{us} µs", ha="center", va="center", fontsize=8.5
            )
        ax.text(
            8.6,
            1.12,
            f"pause; the next frame {calibration.frame_us / 1000:g} ms after this one",
            ha="center",
            fontsize=8.5,
        )
        ax.annotate(
            f"gap pulse {calibration.gap_us} µs",
            (edges[-1] / 1000 + 0.4, 0.1),
            (7.3, 0.3),
            fontsize=8.5,
            arrowprops={"arrowstyle": "-", "color": MIDDLE},
        )
        ax.set(ylim=(-1.3, 1.5), xlim=(0.0, 11.0), yticks=[], xlabel="time [ms]")
        ax.spines["left"].set_visible(False)
    said = ", ".join(f"{name} {us}" for name, us in zip(names, slots, strict=True))
    return f"""Pulses on the trainer port with the settings that ship, which no radio has
        confirmed. The line rests high; short low gap pulses of {calibration.gap_us} microseconds
        begin each slot. From gap to gap: {said} microseconds, which is throttle idle and the
        others in the middle. A long pause follows; frames come every
        {calibration.frame_us / 1000:g} milliseconds."""


def draw_safety(path: Path) -> str:
    """When the board believes the computer."""
    with drawing(path, 6.6, 2.5) as axes:
        (ax,) = axes.flat
        bare(ax, (0.0, 14.2), (-1.4, 5.6))
        places = {"BOOT": (1.2, 3.3), "SAFE": (5.2, 3.3), "LOST": (12.0, 0.2), "FAULT": (4.8, 0.7)}
        for name, (x, y) in places.items():
            box(ax, x, y, name, 2.0, 1.1)
        box(ax, 12.0, 3.3, "ACTIVE\nthe computer flies", 3.6, 1.1, facecolor=LIGHT)
        arrow(ax, (2.2, 3.3), (4.2, 3.3), "first tick")
        asks = "engage on, and in 0.5 s\n5 commands near\nthe pilot's sticks"
        arrow(ax, (6.2, 3.55), (10.2, 3.55), asks)
        ends = "engage off, or the pilot\nmoves a stick by 12 %"
        arrow(ax, (10.2, 3.05), (6.2, 3.05), ends, shift=(0.1, -1.2))
        arrow(ax, (12.0, 2.75), (12.0, 0.75), "200 ms silence", shift=(1.3, -0.2))
        ax.plot([11.0, 6.05, 6.05], [0.2, 0.2, 2.4], color=DARK, lw=1.1)
        arrow(ax, (6.05, 2.3), (6.05, 2.75))
        ax.text(8.5, 0.35, "engage off", ha="center", fontsize=8.2)
        arrow(ax, (4.8, 1.25), (4.8, 2.75), "engage off,\n1 s later", shift=(-1.1, -0.35))
        arrow(ax, (0.4, 0.7), (3.8, 0.7), "from any state", shift=(-0.3, 0.1))
        ax.text(
            0.4,
            -0.4,
            "5 commands out of\nrange in 1 s, memory\ndisturbed, or restart\nby the watchdog",
            fontsize=8.2,
            va="center",
        )
        ax.text(
            9.6,
            -1.0,
            "outside ACTIVE: throttle idle, sticks in the middle",
            ha="center",
            fontsize=8.5,
            style="italic",
        )
    return """States of the board. After BOOT it is SAFE. Engage switched on and then 5 commands
        within half a second, all of them near the pilot's sticks, or idle and neutral where no
        pilot is measured, make it ACTIVE, the only state in which the computer moves the slots.
        Engage off, or a stick that the pilot moves by 12 percent, leads back to SAFE.
        200 milliseconds of silence lead to LOST; from there engage off leads to SAFE. From any
        state five commands out of range within a second, a disturbed memory, or a restart by the
        watchdog lead to FAULT, which engage off ends one second later. Outside ACTIVE the
        throttle is idle and the sticks are in the middle."""


def draw_surfaces(path: Path) -> str:
    """Which way each surface must go, seen from behind."""
    looks = (
        ("aileron stick right", "right aileron UP,\nleft aileron down"),
        ("elevator stick back", "elevator UP"),
        ("rudder stick right", "rudder to the RIGHT"),
    )
    with drawing(path, 6.6, 1.9, 1, 3) as axes:
        for k, (ax, (stick, answer)) in enumerate(zip(axes.flat, looks, strict=True)):
            bare(ax, (-1.15, 1.15), (-0.75, 0.85))
            ax.plot([-1.05, 1.05], [0.1, 0.1], color=DARK, lw=2.0)
            ax.plot(0.0, 0.0, "o", ms=15, mfc=PALE, mec=DARK)
            ax.plot([0.0, 0.0], [0.1, 0.5], color=DARK, lw=2.0)
            ax.plot([-0.4, 0.4], [0.28, 0.28], color=DARK, lw=1.4)
            moved = {"color": DARK, "lw": 1.0, "hatch": "////", "facecolor": "white"}
            if k == 0:
                ax.fill_between([0.6, 1.0], [0.1, 0.1], [0.3, 0.3], **moved)
                ax.fill_between([-1.0, -0.6], [-0.1, -0.1], [0.1, 0.1], **moved)
            elif k == 1:
                ax.fill_between([-0.36, 0.36], [0.28, 0.28], [0.42, 0.42], **moved)
            else:
                ax.fill_between([0.0, 0.2], [0.2, 0.2], [0.5, 0.5], **moved)
            ax.set_title(stick, fontsize=9.5)
            ax.text(0.0, -0.65, answer, ha="center", fontsize=9.0)
    return """The aircraft from behind, three times. Aileron stick to the right: the right aileron
        goes up, the left one down. Elevator stick back: the elevator goes up. Rudder stick to the
        right: the rudder goes to the right."""


def draw_lanes(path: Path) -> str:
    """Where to stand for photos of the hall, and what to measure."""
    pad = LandingPad()
    with drawing(path, 6.6, 3.6) as axes:
        (ax,) = axes.flat
        hall_from_above(ax)
        for k, y in enumerate((-8.5, 1.5, 5.5)):
            ax.plot([HALL.x[0] + 2.0, HALL.x[1] - 2.0], [y, y], color=DARK, lw=1.0, ls="--")
            ax.plot([x + k % 2 for x in range(-20, 15, 2)], [y] * 18, ">", ms=4.5, color=DARK)
        for x, y in (
            (HALL.x[0] + 1.0, HALL.y[0] + 1.0),
            (HALL.x[0] + 1.0, HALL.y[1] - 1.0),
            (HALL.x[1] - 1.0, HALL.y[0] + 1.0),
            (HALL.x[1] - 1.0, HALL.y[1] - 1.0),
        ):
            ax.plot(x, y, "x", ms=7, color=DARK)
        corners = [
            (x, pad.y_centre + side)
            for x in (pad.x_start, pad.x_start + pad.length)
            for side in (-1.0, 1.0)
        ]
        ax.plot(*zip(*corners, strict=True), "o", ms=7, mfc="white", mec=DARK, ls="none")
        ax.plot([], [], "--", marker=">", ms=4.5, color=DARK, label="photo every step")
        ax.plot([], [], "x", ms=7, color=DARK, ls="none", label="photos from the corners")
        ax.plot([], [], "o", ms=7, mfc="white", mec=DARK, ls="none", label="measured by tape")
        ax.figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8.5)
    return """The hall from above, 40 by 20 metres, with blue pad and marker at its end. Three
        dashed lanes run along it; a photo is taken at every step. Crosses in the four corners:
        photos from there. Circles on the pad's corners: points measured by tape."""


def draw_venue(path: Path) -> str:
    """The hall of the book from above: lap, approach, net and people."""
    venue = tomllib.loads((MANUAL / "builder" / "venue.toml").read_text(encoding="utf-8"))
    (wide, long), flight, pad = venue["hall_m"], venue["flight"], LandingPad()
    radius, straight = flight["circle_m"] / 2.0, flight["straight_m"]
    net = wide - flight["circle_m"] - 0.5 * venue["margin_m"] - flight["net_m"]
    middle, begin = net + flight["net_m"] + radius, 0.5 * (long - straight)
    with drawing(path, 6.6, 4.3) as axes:
        (ax,) = axes.flat
        bare(ax, (-4.5, long + 1.5), (-3.2, wide + 0.6))
        ax.plot([0, long, long, 0, 0], [0, 0, wide, wide, 0], color=DARK, lw=1.8)
        angles = [0.01 * math.pi * k for k in range(101)]
        right = [(begin + straight + radius * math.sin(a), -radius * math.cos(a)) for a in angles]
        left = [(begin - radius * math.sin(a), radius * math.cos(a)) for a in angles]
        lap = [*right, *left, right[0]]
        ax.plot([x for x, _ in lap], [middle + y for _, y in lap], color=DARK, lw=1.1)
        ax.plot([0, long], [net, net], color=MIDDLE, lw=2.4, ls=(0, (1.5, 0.8)))
        corner = (long - 8.0 - pad.length, middle - pad.width / 2.0)
        ax.fill_between(
            (corner[0], corner[0] + pad.length), corner[1], corner[1] + pad.width, color=LIGHT, lw=0
        )
        start = (corner[0] - 20.0, middle)  # chapter 12: 20 m before the pad
        arrow(ax, start, (corner[0], middle), "approach, 20 m")
        ax.plot(*start, "D", ms=6, color=DARK)
        ax.text(start[0] - 0.6, middle - 1.0, "hand-over", va="top", fontsize=8.5)
        ax.plot([corner[0] - pad.x_start] * 2, [middle + 1.5, middle + 2.5], color=DARK, lw=4.0)
        ax.text(corner[0] - pad.x_start, middle + 2.9, "marker", ha="center", fontsize=8.5)
        ax.text(corner[0] + 0.5 * pad.length, middle, "pad 13 x 2 m", ha="center", va="center")
        for x, side in ((0.0, 1.0), (float(long), -1.0)):
            ax.plot([x, x], [wide - 3.5, wide - 0.5], color=MIDDLE, lw=5.0)
            ax.plot(x - 0.9 * side, wide - 2.0, "v", ms=7, color=DARK, clip_on=False)
            where = {"ha": "left" if side > 0 else "right", "va": "top", "fontsize": 8.5}
            ax.text(x + 0.7 * side, wide - 0.6, "door,\nguard", **where)
        lap_words = f"lap {flight['circle_m']:g} m wide, straights of {straight:g} m"
        ax.text(0.5 * long, wide - 2.6, lap_words, ha="center")
        for x, mark, text in (
            (0.5 * long, "^", "safety pilot, operator"),
            (long - 7.0, "o", "helper, class"),
        ):
            ax.plot(x, 0.5 * net, mark, ms=8, color=DARK)
            ax.text(x, -0.4, text, ha="center", va="top", fontsize=8.5)
        ax.plot(-2.2, 0.5 * wide - 6.0, "s", ms=8, color=DARK, clip_on=False)
        charge = "charging, guard: outside, stone floor"
        ax.text(-3.0, 0.5 * wide - 5.0, charge, rotation=90, ha="right", va="bottom", fontsize=8.5)
        ax.text(0.5 * long + 7.0, net + 0.45, f"net, {net:.0f} m from the wall", fontsize=8.5)
        ax.text(0.5 * long, -2.0, f"{long} m", ha="center", va="top", fontsize=8.5)
        ax.text(-0.4, 0.5 * wide, f"{wide} m", rotation=90, ha="right", va="center", fontsize=8.5)
    return f"""The hall of the book from above, {long} by {wide} metres. A lap of two half circles
        and two straights of {straight:g} m is {flight["circle_m"]:g} m wide, one metre from the
        far wall and {flight["net_m"]:g} m from a net along the near one. Behind the net,
        {net:.0f} m from the wall: safety pilot and operator at the middle, helper and class; a
        guard stands outside each door, and the charging place with its guard is outside the hall,
        on a stone floor. In the middle of the hall the
        approach, from the hand-over point 20 m before the pad; the marker is {pad.x_start:g} m
        before the pad and 2 m to the left of its centre line."""


def hall_from_above(ax: Any) -> None:
    """Walls, pad, marker and axes of the kit's hall."""
    pad = LandingPad()
    ax.plot(
        [HALL.x[0], HALL.x[1], HALL.x[1], HALL.x[0], HALL.x[0]],
        [HALL.y[0], HALL.y[0], HALL.y[1], HALL.y[1], HALL.y[0]],
        color=DARK,
        lw=1.6,
    )
    ends, half = (pad.x_start, pad.x_start + pad.length), pad.width / 2.0
    ax.fill_between(ends, pad.y_centre - half, pad.y_centre + half, color=LIGHT, lw=0)
    ax.text(ends[1] - 1.0, pad.y_centre, "pad 13 x 2 m", ha="right", va="center", fontsize=8.5)
    ax.plot([0.0, 0.0], [-0.5, 0.5], color=DARK, lw=4.0)
    ax.annotate(
        "marker, origin",
        (0.0, 0.5),
        (0.0, 2.2),
        ha="center",
        fontsize=8.5,
        arrowprops={"arrowstyle": "-"},
    )
    ax.set(xlabel="x, landing direction [m]", ylabel="y, left [m]", aspect="equal")


DRAWINGS: dict[str, Callable[[Path], str]] = {
    "loop": draw_loop,
    "aircraft": draw_aircraft,
    "hours": draw_hours,
    "ppm": draw_ppm,
    "safety": draw_safety,
    "surfaces": draw_surfaces,
    "photo_lanes": draw_lanes,
    "venue": draw_venue,
}
