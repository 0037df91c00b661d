"""Lab 12, given: the candidates with their sizes, the channels, and the figures."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray

COHORT: dict[str, float] = json.loads(
    (Path(__file__).parent / "cohort.json").read_text(encoding="utf-8")
)
CAUTION = COHORT[
    "caution"
]  # evidence must exceed what chance finds on the baseline flight by this factor
LEAST_GAIN = 10.0  # evidence below which nothing is named, and within which two names are ambiguous
CUSHION_M = 0.5  # height over which ground effect fades

CHANNELS = ("px", "py", "pz", "roll", "pitch", "yaw")
BLUE, ORANGE, GREEN, GREY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#777777",
)  # distinguishable for colour-blind readers


@dataclass(frozen=True)
class Candidate:
    """One thing that may be different, and what its size means."""

    meaning: str
    size: str  # with its unit
    amplitudes: tuple[str, ...]  # parameters of the model that are zero without it
    step: float  # a small size, to see what it does
    largest: float  # that makes sense


# Your `augment_model` makes the loads of the first five; the others act on the wind or on the
# control inputs, by the kit's code.
CANDIDATES = {
    "extra_drag": Candidate(
        "something sticks out into the air", "drag added [1/m]", ("size",), 0.003, 0.1
    ),
    "thrust_loss": Candidate(
        "the propeller gives less", "share of the thrust lost [-]", ("size",), 0.05, 1.0
    ),
    "ground_effect": Candidate(
        "a cushion of air near the floor", "share added at the floor [-]", ("size",), 0.1, 2.0
    ),
    "aileron_loss": Candidate(
        "an aileron moves less", "share of its moment lost [-]", ("size",), 0.05, 1.0
    ),
    "adverse_yaw": Candidate(
        "aileron pulls the nose out of the turn", "moment [1/m^2]", ("size",), 0.02, 1.0
    ),
    "wind": Candidate("the air moves", "speed [m/s]", ("wind_x", "wind_y"), 0.1, 5.0),
    "trim_bias": Candidate(
        "the aileron's neutral moved", "command, with sign [-]", ("bias_aileron",), 0.02, 0.5
    ),
    "control_delay": Candidate(
        "the control inputs act later", "time [s]", ("control_delay",), 0.02, 0.4
    ),
    "actuator_lag": Candidate(
        "the servos are slower", "time constant [s]", ("actuator_lag",), 0.02, 0.6
    ),
    "mass_change": Candidate(
        "the aircraft is heavier", "share of the mass [-]", ("mass_added",), 0.03, 1.0
    ),
}
LOADS = ("extra_drag", "thrust_loss", "ground_effect", "aileron_loss", "adverse_yaw")


def rows_of(residual: Array, windows: Any) -> tuple[Array, dict[str, Array]]:
    """Residuals row by row, and what they may depend on.

    Args:
        residual: (W, L, 6) in sigmas.
        windows: the windows of the kit that were flown.

    Returns:
        (W * L, 6) residuals, nan where not measured; and by name with its unit, (W * L,) height,
        heading, and throttle and aileron as means over the last second, since the pose follows
        from earlier commands.
    """
    sticks = []
    for times, number in zip(windows.nodes, windows.flight, strict=True):
        log = windows.flights[number]
        total = np.cumsum(log.commands, axis=0)
        mean = (total - np.roll(total, 20, axis=0)) / 20.0
        mean[:20] = log.commands[:20]
        sticks.append([np.interp(times, log.t - log.t[0], mean[:, k]) for k in (0, 1)])
    throttle, aileron = np.moveaxis(np.array(sticks), 1, 0).reshape(2, -1)
    pose = windows.pose.reshape(-1, 6)
    heading = np.degrees(np.angle(np.exp(1j * pose[:, 5])))
    known = {
        "height [m]": pose[:, 2],
        "heading [deg]": heading,
        "throttle [-]": throttle,
        "aileron [-]": aileron,
    }
    return np.where(windows.weight > 0.0, residual, np.nan).reshape(-1, 6), known


def lap_numbers(yaw: Array) -> Array:
    """Number of the lap of each row: a lap ends where the nose has turned on to the right by 2 pi.

    Args:
        yaw: (N,) [rad], wrapped or not, of a flight mostly in right turns.

    Returns:
        (N,) 0 for the rows before the first whole lap, then 1, 2, ... (the last one not complete).
    """
    # the largest yaw so far: a short turn to the left does not go back to the lap before
    farthest = np.maximum.accumulate(np.unwrap(yaw))
    lap = np.floor(farthest / (2.0 * np.pi)).astype(int)
    return np.asarray(lap - lap.min())


def velocities(t: Array, p: Array) -> Array:
    """Velocity of each row from its two neighbours.

    Args:
        t: (N,) [s].
        p: (N, 2) positions, precise to a millimetre [m].

    Returns:
        (N, 2) [m/s], nan in the first and the last row.
    """
    v = np.full(p.shape, np.nan)
    v[1:-1] = (p[2:] - p[:-2]) / (t[2:] - t[:-2])[:, None]
    return v


def draw_map(axes: Sequence[Any], maps: Mapping[str, tuple[Array, Array]]) -> Any:
    """Draw residual maps side by side: channels in rows, bins in columns, dark for a large excess.

    Args:
        axes: as many as maps.
        maps: by the variable's name with its unit: edges (B + 1,) and excess (6, B), nan where too
            few were measured.

    Returns:
        The last image, for a colour bar.
    """
    top = max(1.0, max(float(np.nanmax(excess)) for _, excess in maps.values()))
    image = None
    for ax, (label, (edges, excess)) in zip(axes, maps.items(), strict=True):
        image = ax.imshow(excess, cmap="cividis_r", vmin=0.0, vmax=top, aspect="auto")
        for (row, column), value in np.ndenumerate(excess):
            text = "" if np.isnan(value) else f"{value:.1f}"
            ax.text(
                column,
                row,
                text,
                ha="center",
                va="center",
                fontsize=7,
                color="w" if value > 0.5 * top else "k",
            )
        ax.set_xticks(np.arange(len(edges)) - 0.5, [f"{edge:.3g}" for edge in edges], fontsize=7)
        ax.set(xlabel=label, yticks=range(6), yticklabels=CHANNELS)
    return image


def draw_evidence(ax: Any, gains: Mapping[str, float], threshold: float) -> None:
    """Bars of evidence, best on top, on a symmetric logarithmic scale, with the threshold."""
    names = sorted(gains, key=lambda name: gains[name])
    ax.barh(names, [gains[name] for name in names], color=BLUE)
    ax.axvline(threshold, color=ORANGE, ls="--", label=f"threshold {threshold:.0f}")
    ax.set_xscale("symlog", linthresh=10.0)
    ax.set(xlabel="evidence: chi2 gained less its price [-]", title="What the candidates explain")
    ax.legend(fontsize=8, loc="lower right")


def draw_gap(ax: Any, level: Mapping[str, float]) -> None:
    """Bars of the misfit on held-out time, by what was flown; the last is the calm flight's own."""
    colours = [ORANGE, GREY, BLUE, GREEN] if len(level) == 4 else [ORANGE, GREY, GREEN]
    ax.bar_label(
        ax.bar(list(level), list(level.values()), color=colours, edgecolor="k"), fmt="%.2f"
    )
    ax.axhline(1.0, color=GREY, ls=":", label="noise alone")
    ax.set(yscale="log", ylim=(0.5, 1.5 * max(level.values())), title="The gap on held-out time")
    ax.set_ylabel("chi2 per degree of freedom, 2 s ahead [-]")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("{x:g}")
    ax.legend(fontsize=8)


def moving_flights(folder: Path, seconds: float = 10.0) -> Any:
    """A film of the first seconds of both flights, from above and over time.

    Args:
        folder: with `calm.csv` and `flight.csv`.
        seconds: of flight.
    """
    from matplotlib.figure import Figure

    from falconwing_kit.core import read_flight_table
    from falconwing_kit.tools.grading import moving_figure, plan_view

    flights = [read_flight_table(folder / name) for name in ("calm.csv", "flight.csv")]
    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
    above, side = figure.subplots(1, 2, width_ratios=(1.4, 1.0))
    hall = [-22.5, 17.5, 17.5, -22.5, -22.5], [-12, -12, 8, 8, -12]
    above.plot(*hall, ":", color="0.6", lw=1, label="hall, for its size")  # they fly beyond it
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(-23.5, 18.5))
    above.set_ylim(-13.5, 11.5)
    side.set(xlabel="time [s]", ylabel="height [m]", xlim=(0, seconds), ylim=(0, 3.5))
    drawn = []
    for name, colour, line in (("baseline", GREY, "--"), ("under test", BLUE, "-")):
        track = above.plot([], [], line, color=colour, label=name)[0]
        drawn.append((track, above.fill([0], [0], color=colour)[0]))
        drawn[-1] += (side.plot([], [], line, color=colour, label=name)[0],)
    above.legend(fontsize=7, loc="lower left")

    def draw(number: int) -> None:
        for flight, (track, outline, height) in zip(flights, drawn, strict=True):
            rows = np.flatnonzero(flight.has_pose & (flight.t - flight.t[0] <= 0.2 * number))
            p = flight.p_world[rows]
            track.set_data(p[:, 0], p[:, 1])
            height.set_data(flight.t[rows] - flight.t[0], p[:, 2])
            if len(rows):
                outline.set_xy(plan_view(*p[-1, :2], flight.attitude[rows[-1], 2], span=2.0).T)
        above.set_title(f"Both flights, {0.2 * number:.1f} s (simulated)", fontsize=9)

    words = "Two aircraft go round the hall on different tracks; nothing wrong is seen by eye."
    return moving_figure(figure, draw, int(5 * seconds), 0.2, words)
