"""Figures of a gap: where a flight disagrees, how the effects rank, the gap before and after."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.gap.close import GapClosure
from falconwing_kit.gap.measure import (
    VARIABLES,
    FlightReplay,
    ResidualBin,
    ResidualProfile,
    profile,
)
from falconwing_kit.gap.name import Naming
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure

IN_PLOTS = {"heading": (180.0 / np.pi, "deg"), "bank": (180.0 / np.pi, "deg")}
CHANNEL_WORDS = {
    "px": "Position x",
    "py": "Position y",
    "pz": "Height",
    "roll": "Roll",
    "pitch": "Pitch",
    "yaw": "Yaw",
}


def draw_gap(
    naming: Naming,
    closed: GapClosure,
    flight: FlightReplay,
    calm: FlightReplay,
    residual_bins: Sequence[ResidualBin],
    folder: Path,
) -> dict[str, Path]:
    """Write the four figures of a gap.

    Args:
        naming: the answer for the flight.
        closed: the gap before and after.
        flight: the flight in the calm model.
        calm: the calm flight in its own model.
        spots: where the flight disagrees.
        folder: where the files go; it must exist.

    Returns:
        gap_map, gap_where, gap_ranking and gap_closed, each a PNG.
    """
    paths = {name: folder / f"gap_{name}.png" for name in ("map", "where", "ranking", "closed")}
    draw_map(flight, calm, paths["map"])
    draw_residual_profiles(flight, calm, residual_bins, paths["where"])
    draw_ranking(naming, paths["ranking"])
    draw_gap_closure(closed, paths["closed"])
    return paths


def draw_map(flight: FlightReplay, calm: FlightReplay, path: Path) -> None:
    """The hall from above: mean residual of all channels wherever the aircraft was, both flights in
    one scale.

    Args:
        flight: the flight in the calm model.
        calm: the calm flight in its own model.
        path: the PNG to write.
    """
    values = [np.sqrt(np.mean(r.residual**2, axis=2)) for r in (calm, flight)]
    top = max(2.0, float(np.nanpercentile(values[1], 95)))
    with figure(path, 1, 2, (11.0, 4.2), sharex=True, sharey=True) as axes:
        shown = None
        for ax, one, size, title in zip(
            axes[0], (calm, flight), values, ("Calm flight", "Flight"), strict=True
        ):
            seen = np.isfinite(size)
            shown = ax.hexbin(
                one.variables["x"][seen],
                one.variables["y"][seen],
                size[seen],
                gridsize=26,
                cmap="cividis_r",
                vmin=0.5,
                vmax=top,
                linewidths=0.2,
            )
            ax.set_aspect("equal", adjustable="box")
            ax.set_title(title)
            ax.set_xlabel("x, along the runway [m]")
        axes[0, 0].set_ylabel("y, to the left [m]")
        axes[0, 0].figure.colorbar(
            shown, ax=list(axes[0]), label="residual, all channels [sigma]", shrink=0.85
        )


def draw_residual_profiles(
    flight: FlightReplay, calm: FlightReplay, residual_bins: Sequence[ResidualBin], path: Path
) -> None:
    """Root mean square residual against the variables that explain it best, the calm flight beside
    it.

    Args:
        flight: the flight in the calm model.
        calm: the calm flight in its own model.
        spots: where the flight disagrees; the usual variables are drawn where there are fewer than
            three.
        path: the PNG to write.
    """
    wanted: dict[str, tuple[str, ResidualBin | None]] = {}  # one channel per variable
    for s in residual_bins:
        if s.contrast > 0.0:
            wanted.setdefault(s.variable, (s.channel, s))
    for variable, channel in (("height", "pz"), ("heading", "py"), ("throttle", "px")):
        wanted.setdefault(variable, (channel, None))
    with figure(path, 1, 3, (11.0, 3.4)) as axes:
        for ax, (variable, (channel, residual_bin)) in zip(axes[0], wanted.items(), strict=False):
            _draw_profile(
                ax, profile(flight, calm, channel, variable), channel, variable, residual_bin
            )
        axes[0, 0].set_ylabel("rms residual, 2 s ahead [sigma]")
        axes[0, 0].legend(loc="best")


def _draw_profile(
    ax: Any, p: ResidualProfile, channel: str, variable: str, residual_bin: ResidualBin | None
) -> None:
    scale, unit = IN_PLOTS.get(variable, (1.0, VARIABLES[variable]))
    edges = p.edges * scale
    if residual_bin:
        ax.axvspan(residual_bin.low * scale, residual_bin.high * scale, color="#f6e3d8", zorder=0)
    low, high = (np.sqrt(np.maximum(p.calm + k * p.error, 0.0)) for k in (-2.0, 2.0))
    ax.fill_between(
        edges,
        np.append(low, low[-1]),
        np.append(high, high[-1]),
        step="post",
        color="#dddddd",
        lw=0,
    )
    ax.stairs(
        np.sqrt(p.calm),
        edges,
        color=MEASURED,
        lw=1.6,
        ls="--",
        baseline=None,
        label="calm flight (band: chance)",
    )
    ax.stairs(np.sqrt(p.flight), edges, color=PREDICTED, lw=2.2, baseline=None, label="flight")
    ax.set_ylim(0.0, 1.15 * float(np.sqrt(max(np.nanmax(p.flight), np.nanmax(p.calm), 1.5))))
    ax.set_xlabel(f"{variable} [{unit}]")
    ax.set_title(f"{CHANNEL_WORDS[channel]} against {variable}")


def draw_ranking(naming: Naming, path: Path) -> None:
    """Evidence for every effect that has some, and how much is needed.

    Args:
        naming: the answer for the flight.
        path: the PNG to write.
    """
    shown = naming.ranking[:8][::-1]
    chosen = {c.effect.name for c in naming.chosen}
    top = max(1.6 * max((c.delta_bic for c in shown), default=1.0), 4.0 * naming.threshold)
    with figure(path, 1, 1, (8.2, 0.34 * len(shown) + 1.3)) as axes:
        ax = axes[0, 0]
        for row, candidate in enumerate(shown):
            found = candidate.effect.name in chosen
            ax.barh(
                row,
                max(candidate.delta_bic, 0.0),
                height=0.62,
                color=PREDICTED if found else "#c9d4df",
            )
            ax.annotate(
                f"{candidate.delta_bic:.0f}",
                (max(candidate.delta_bic, 0.0), row),
                (4, -3),
                textcoords="offset points",
                fontsize=8.5,
                color=QUIET,
            )
        ax.set_yticks(range(len(shown)), [c.effect.name.replace("_", " ") for c in shown])
        ax.set_xscale("symlog", linthresh=10.0)
        ax.set_xlim(0.0, top)
        ax.axvline(naming.threshold, color=ACCENT, lw=1.4, ls="--")
        ax.annotate(
            "needed", (naming.threshold, 1.0), (4, 2), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8.5, color=ACCENT,
        )  # fmt: skip
        ax.set_xlabel(
            "evidence: chi2 explained, less the price of free parameters (logarithmic beyond 10)"
        )
        ax.grid(axis="y", visible=False)


def draw_gap_closure(closed: GapClosure, path: Path) -> None:
    """Before, after and calm: chi2, position and attitude on held-out time.

    Args:
        closed: the gap.
        path: the PNG to write.
    """
    scores = {"before": closed.before, "after": closed.after, "calm flight": closed.calm}
    panels = (
        ("chi2 per degree of freedom [-]", [s.chi2 for s in scores.values()]),
        ("position, rms [cm]", [100.0 * s.position_m for s in scores.values()]),
        ("attitude, rms [deg]", [s.attitude_deg for s in scores.values()]),
    )
    with figure(path, 1, 3, (11.0, 2.9)) as axes:
        for ax, (label, values) in zip(axes[0], panels, strict=True):
            bars = ax.bar(list(scores), values, width=0.6, color=[ACCENT, PREDICTED, MEASURED])
            ax.bar_label(bars, [f"{v:.3g}" for v in values], padding=2, fontsize=9)
            ax.set_ylim(0.0, 1.15 * max(values))
            ax.set_ylabel(label)
            ax.grid(axis="x", visible=False)
        axes[0, 0].axhline(closed.calm.chi2, color=QUIET, lw=0.8, ls=":")
        axes[0, 0].set_title("Two seconds ahead, held-out time")
