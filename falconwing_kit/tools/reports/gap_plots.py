"""Figures of a gap: where a flight disagrees, how the effects rank, the gap before and after.

Each is one narrow column of panels, so that its labels can be read on a phone and two stand side by
side on a sheet of paper.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
from falconwing_kit.gap.study import GapStudy
from falconwing_kit.sysid.score import PredictionScore
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure

WIDTH_IN, DPI = 4.4, 170  # a phone shows the width at three quarters
IN_PLOTS = {"heading": (180.0 / np.pi, "°"), "bank": (180.0 / np.pi, "°")}
CHANNEL_WORDS = {
    "px": "Position x",
    "py": "Position y",
    "pz": "Height",
    "roll": "Roll",
    "pitch": "Pitch",
    "yaw": "Yaw",
}


def draw_gap(study: GapStudy, folder: Path) -> dict[str, Path]:
    """Write the figures of a gap.

    Args:
        study: what was found.
        folder: where the files go; it must exist.

    Returns:
        map, where, ranking and closed, each a PNG gap_NAME.png.
    """
    paths = {name: folder / f"gap_{name}.png" for name in ("map", "where", "ranking", "closed")}
    flight, calm = study.flight_replay, study.baseline_replay
    draw_map(flight, calm, paths["map"])
    draw_residual_profiles(flight, calm, study.residual_bins, paths["where"])
    draw_ranking(study.naming, paths["ranking"])
    draw_gap_closure(study.closed, paths["closed"], noise_floor(study))
    return paths


def draw_map(flight: FlightReplay, calm: FlightReplay, path: Path) -> None:
    """From above: mean residual of all channels wherever the aircraft was, both flights in one
    scale.

    Args:
        flight: the flight in the calm model.
        calm: the calm flight in its own model.
        path: the PNG to write.
    """
    values = [np.sqrt(np.mean(r.residual**2, axis=2)) for r in (calm, flight)]
    top = max(2.0, float(np.nanpercentile(values[1], 95)))
    with figure(path, 2, 1, (WIDTH_IN, 5.2), dpi=DPI, sharex=True, sharey=True) as axes:
        shown = None
        for ax, one, size, title in zip(
            axes[:, 0], (calm, flight), values, ("Calm flight", "Flight"), strict=True
        ):
            seen = np.isfinite(size)
            shown = ax.hexbin(
                one.variables["x"][seen],
                one.variables["y"][seen],
                size[seen],
                gridsize=24,
                cmap="cividis_r",
                vmin=0.5,
                vmax=top,
                linewidths=0.2,
            )
            ax.set_aspect("equal", adjustable="box")
            ax.set_title(title)
            ax.set_ylabel("y, to the left [m]")
        axes[1, 0].set_xlabel("x, along the runway [m]")
        axes[0, 0].figure.colorbar(
            shown, ax=list(axes[:, 0]), label="residual, all channels [sigma]",
            location="bottom", shrink=0.8, aspect=30,
        )  # fmt: skip


def draw_residual_profiles(
    flight: FlightReplay, calm: FlightReplay, residual_bins: Sequence[ResidualBin], path: Path
) -> None:
    """Root mean square residual against the variables that explain it best, the calm flight beside
    it.

    Args:
        flight: the flight in the calm model.
        calm: the calm flight in its own model.
        residual_bins: where the flight disagrees; the usual variables are drawn where there are
            fewer than three.
        path: the PNG to write.
    """
    wanted: dict[str, tuple[str, ResidualBin | None]] = {}  # one channel per variable
    for s in residual_bins:
        if s.contrast > 0.0:
            wanted.setdefault(s.variable, (s.channel, s))
    for variable, channel in (("height", "pz"), ("heading", "py"), ("throttle", "px")):
        wanted.setdefault(variable, (channel, None))
    margins = {"left": 0.12, "right": 0.96, "top": 0.96, "bottom": 0.075, "hspace": 0.5}
    with figure(
        path, 3, 1, (WIDTH_IN, 5.7), dpi=DPI, gridspec_kw=margins, margins=True
    ) as axes:  # fmt: skip
        for ax, (variable, (channel, residual_bin)) in zip(
            axes[:, 0], wanted.items(), strict=False
        ):
            _draw_profile(
                ax, profile(flight, calm, channel, variable), channel, variable, residual_bin
            )
            ax.set_ylabel("rms residual [sigma]")
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
    with figure(path, 1, 1, (WIDTH_IN, 0.3 * len(shown) + 1.1), dpi=DPI) as axes:
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
        ax.set_xlabel("evidence, delta BIC [-] (logarithmic beyond 10)")
        ax.grid(axis="y", visible=False)


@dataclass(frozen=True)
class NoiseFloor:
    """Prediction errors that the pose noise alone leaves, whatever the model."""

    position_m: float
    attitude_deg: float


def noise_floor(study: GapStudy) -> NoiseFloor:
    """The noise of position (root sum of squares) and attitude (rms) as a score would show it.

    Fitted initial states absorb n_states of the measured components of a window.
    """
    sigma, naming = study.base.found.sigma, study.naming
    windows = naming.windows
    absorbed = len(windows) * study.base.result.model.n_states / max(windows.count, 1)
    share = math.sqrt(max(1.0 - absorbed, 0.0))
    return NoiseFloor(
        share * float(np.linalg.norm(sigma[:3])),
        share * math.degrees(float(np.sqrt(np.mean(sigma[3:] ** 2)))),
    )


def gap_scores(closed: GapClosure) -> dict[str, PredictionScore]:
    """The scores to show: before, after and calm flight; flight and calm flight where nothing was
    added.
    """
    if closed.after is closed.before:
        return {"flight": closed.before, "calm flight": closed.calm}
    return {"before": closed.before, "after": closed.after, "calm flight": closed.calm}


def draw_gap_closure(closed: GapClosure, path: Path, floor: NoiseFloor | None = None) -> None:
    """Before, after and calm: chi2, position and attitude on held-out time.

    Args:
        closed: the gap.
        path: the PNG to write.
        floor: what the noise alone leaves; drawn as a line where it is given, as is a chi2 of 1.
    """
    scores = gap_scores(closed)
    colours = [ACCENT, PREDICTED, MEASURED] if len(scores) == 3 else [ACCENT, MEASURED]
    panels = (
        ("chi2 per degree of freedom [-]", [s.chi2 for s in scores.values()], 1.0),
        (
            "position error, rms [cm]",
            [100.0 * s.position_m for s in scores.values()],
            100.0 * floor.position_m if floor else None,
        ),
        (
            "attitude error, rms [°]",
            [s.attitude_deg for s in scores.values()],
            floor.attitude_deg if floor else None,
        ),
    )
    margins = {"left": 0.18, "right": 0.98, "top": 0.93, "bottom": 0.1, "hspace": 0.55}
    with figure(
        path, 3, 1, (WIDTH_IN, 4.4), dpi=DPI, gridspec_kw=margins, margins=True
    ) as axes:  # fmt: skip
        for ax, (label, values, noise) in zip(axes[:, 0], panels, strict=True):
            bars = ax.barh(list(scores), values, height=0.62, color=colours)
            ax.bar_label(bars, [f"{v:.3g}" for v in values], padding=3, fontsize=9)
            ax.invert_yaxis()
            ax.set_xlim(0.0, 1.18 * max(values))
            ax.set_xlabel(label, labelpad=1)
            ax.grid(axis="y", visible=False)
            if noise is not None:
                ax.axvline(noise, color="#222222", lw=1.2, ls=":")
        axes[0, 0].set_title("Two seconds ahead (dotted: noise alone)")
