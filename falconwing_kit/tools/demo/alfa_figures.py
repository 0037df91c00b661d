"""Figures of the real flight: its track, forecast errors, when the engine's loss shows, and what
could explain it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.tools.demo.alfa_gap import AlfaGap
from falconwing_kit.tools.demo.alfa_story import SETTLING_S, AlfaAnalysis
from falconwing_kit.tools.demo.figures import draw_predictions
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure


def draw_alfa_figures(story: AlfaAnalysis, folder: Path) -> tuple[Path, ...]:
    """Write the figures of the real flight.

    Args:
        story: what the flight showed.
        folder: where the files go; it must exist.

    Returns:
        alfa_track.png, alfa_predicted.png, alfa_forecasts.png and alfa_failure.png.
    """
    paths = tuple(
        folder / f"alfa_{name}.png" for name in ("track", "predicted", "forecasts", "failure")
    )
    draw_track(story, paths[0])
    draw_predictions(story.found, paths[1])
    draw_forecasts(story, paths[2])
    draw_failure(story, paths[3])
    return paths


def draw_track(story: AlfaAnalysis, path: Path) -> None:
    """The flight from above and its height and speed over time, with the engine's failure marked.

    Args:
        story: what the flight showed.
        path: the PNG to write.
    """
    table = story.table
    seen = table.has_pose
    t, p = table.t[seen], table.p_world[seen]
    after = t >= story.failure_time
    speed = np.sqrt(sum(table.extra[k] ** 2 for k in ("vx", "vy", "vz")))
    with figure(path, 2, 2, (11.0, 4.6), width_ratios=[1.15, 1.0]) as axes:
        grid = axes[0, 0].get_gridspec()
        for ax in axes[:, 0]:
            ax.remove()
        above = axes[0, 1].figure.add_subplot(grid[:, 0])
        above.plot(-p[~after, 1], p[~after, 0], "-", color=PREDICTED, lw=1.3, label="engine on")
        above.plot(-p[after, 1], p[after, 0], "-", color=ACCENT, lw=3.0, label="engine off")
        above.plot(-p[0, 1], p[0, 0], "o", color=QUIET, ms=5, label="start of the log")
        above.set_aspect("equal", adjustable="datalim")
        above.set_xlabel("east [m]")
        above.set_ylabel("north [m]")
        above.set_title("Measured track")
        above.legend(loc="center right")
        _over_time(axes[0, 1], t, p[:, 2], story, "height [m]")
        _over_time(axes[1, 1], table.t, speed, story, "speed over ground [m/s]")
        axes[1, 1].set_xlabel("time [s]")


def draw_forecasts(story: AlfaAnalysis, path: Path) -> None:
    """Errors of held-out forecasts before the failure: the model beside two simple guesses.

    Args:
        story: what the flight showed.
        path: the PNG to write.
    """
    looks = {
        "model": ("o-", PREDICTED, "fitted model"),
        "constant turn": ("s--", ACCENT, "constant turn for its bank"),
        "constant velocity": ("^:", MEASURED, "constant velocity"),
    }
    with figure(path, 1, 2, (11.0, 3.5), width_ratios=[1.9, 1.0]) as axes:
        over_time, shares = axes[0]
        for name, (mark, colour, label) in looks.items():
            forecasts = story.held_out[name]
            distance = np.linalg.norm(forecasts.error_position, axis=1)
            over_time.plot(
                forecasts.t, distance, mark[0], ms=2.6, color=colour, alpha=0.8, label=label
            )
            ordered = np.sort(distance)
            shares.plot(
                ordered,
                np.arange(1, len(ordered) + 1) / len(ordered) * 100.0,
                mark[1:],
                color=colour,
                lw=1.8,
            )
        over_time.set_ylim(0.0, 8.0)
        over_time.set_xlabel("time [s]")
        over_time.set_ylabel("distance from the measurement [m]")
        over_time.set_title("One second ahead, time the model was not fitted to")
        over_time.legend(loc="upper right")
        shares.set_xlim(0.0, 5.0)
        shares.set_xlabel("distance from the measurement [m]")
        shares.set_ylabel("forecasts within it [%]")
        shares.set_title("How often how far")


def draw_failure(story: AlfaAnalysis, path: Path) -> None:
    """The last minute: how far the forecasts of a healthy aircraft run ahead of the real one.

    Args:
        story: what the flight showed.
        path: the PNG to write.
    """
    begin = story.failure_time - 50.0
    with figure(path, 2, 1, (11.0, 5.2), sharex=True, height_ratios=[2.0, 1.0]) as axes:
        ax, below = axes[:, 0]
        looks = (
            (
                "healthy",
                "-",
                ACCENT,
                2.2,
                f"throttle held at {story.fixed_throttle:.2f}, its mean of the 20 s before",
            ),
            ("told", "--", PREDICTED, 1.6, "told the logged throttle, which falls to zero"),
        )
        for name, line, colour, width, label in looks:
            t, error = story.running[name]
            shown = t > begin
            ax.plot(t[shown], error[shown], line, color=colour, lw=width, label=label)
        ax.axhspan(-story.nominal_error, story.nominal_error, color="#eeeeee", zorder=0)
        note = f"largest error of held-out forecasts before the failure, from {SETTLING_S:.0f} s on"
        ax.annotate(
            note,
            (begin, -story.nominal_error),
            (6, 5),
            textcoords="offset points",
            fontsize=8,
            color=QUIET,
        )
        _mark_failure(ax, story)
        if story.detection_time is not None:
            ax.axvline(story.detection_time, color=QUIET, lw=1.0, ls="-.")
            late = story.detection_time - story.failure_time
            ax.annotate(
                f"parts from the measurement\n{late:.1f} s after the failure",
                (story.detection_time, 0.0), (8, -48), textcoords="offset points", fontsize=8.5,
            )  # fmt: skip
        ax.set_ylabel("forecast ahead of the aircraft [m]\n(one second ahead, mean of 2 s)")
        ax.set_title("A model of the healthy aircraft runs ahead once the engine is off")
        ax.legend(loc="upper left")
        shown = story.table.t > begin
        below.plot(
            story.table.t[shown], story.table.commands[shown, 0] * 100.0, "-", color=QUIET, lw=1.3
        )
        below.set_ylabel("logged throttle [%]")
        below.set_xlabel("time [s]")
        _mark_failure(below, story)


def draw_hypotheses(gap: AlfaGap, failure: float, path: Path) -> None:
    """Evidence for each effect, and when it would have set in.

    Args:
        gap: what the poses say about the failure.
        failure: when the engine went off [s].
        path: the PNG to write.
    """
    shown = gap.hypotheses[::-1]
    with figure(path, 1, 2, (11.0, 0.36 * len(shown) + 1.5), sharey=True) as axes:
        evidence, times = axes[0]
        for row, s in enumerate(shown):
            evidence.barh(
                row,
                max(s.delta_bic, 0.0),
                height=0.6,
                color=PREDICTED if s in gap.chosen else "#c9d4df",
            )
            times.plot([s.earliest, s.latest], [row, row], "-", color=QUIET, lw=2.0)
            times.plot(s.time, row, "o", color=PREDICTED, ms=6)
        evidence.axvline(
            gap.logged_throttle_gain,
            color=QUIET,
            lw=1.2,
            ls=":",
            label="the logged throttle alone, nothing fitted",
        )
        evidence.axvline(gap.threshold, color=ACCENT, lw=1.2, ls="--", label="needed")
        evidence.set_yticks(range(len(shown)), [s.effect.name.replace("_", " ") for s in shown])
        evidence.set_xlabel("evidence, from the best time on")
        evidence.set_title("What it could be")
        evidence.legend(loc="lower right", frameon=True, fontsize=8)
        times.axvline(failure, color=ACCENT, lw=1.4, ls=":")
        times.annotate(
            "engine off", (failure, 1.0), (4, -12), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8.5, color=ACCENT,
        )  # fmt: skip
        times.set_xlim(gap.end - 25.0, gap.end)
        times.set_xlabel("time [s]")
        times.set_title("Since when")


def _over_time(ax: Any, t: Any, values: Any, story: AlfaAnalysis, label: str) -> None:
    after = t >= story.failure_time
    ax.plot(t, values, "-", color=PREDICTED, lw=1.3)
    ax.plot(t[after], values[after], "-", color=ACCENT, lw=2.6)
    ax.set_ylabel(label)
    _mark_failure(ax, story)


def _mark_failure(ax: Any, story: AlfaAnalysis) -> None:
    ax.axvline(story.failure_time, color=ACCENT, lw=1.2, ls=":")
    ax.annotate(
        "engine off", (story.failure_time, 0.02), (-4, 2), xycoords=("data", "axes fraction"),
        textcoords="offset points", ha="right", fontsize=8.5, color=ACCENT,
    )  # fmt: skip
