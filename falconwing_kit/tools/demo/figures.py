"""Figures of an identification: result of `identify` -> PNG files, readable in grey too."""

from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.forecast import Forecasts
from falconwing_kit.sysid.identify import Identification
from falconwing_kit.sysid.shooting import fly_windows, select_windows
from falconwing_kit.sysid.uncertainty import ordinary_size
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure

LABELS = ("x [m]", "y [m]", "height [m]", "roll [deg]", "pitch [deg]", "yaw [deg]")


def draw_identification(found: Identification, folder: Path) -> tuple[Path, ...]:
    """Write predicted.png, residuals.png and intervals.png to a folder, which must exist."""
    paths = tuple(folder / name for name in ("predicted.png", "residuals.png", "intervals.png"))
    draw_predictions(found, paths[0])
    draw_residuals(found, paths[1])
    draw_intervals(found, paths[2])
    return paths


def draw_predictions(found: Identification, path: Path) -> None:
    """Draw predicted and measured poses of the held-out data, and the track from above."""
    windows, scored, what = _scored_windows(found)
    shown = _first_block(windows.nodes)
    measured = np.where(windows.weight > 0, windows.pose, np.nan)[shown]
    predicted = fly_windows(
        found.train_model, select_windows(windows, shown), scored.initial_states[shown]
    )
    # unwrapped yaw: remove whole turns for the plot
    turns = np.round(np.nanmean(measured[..., 5]) / (2.0 * np.pi))
    nodes = windows.nodes[shown]
    scale = np.array([1.0, 1.0, 1.0, *[180.0 / np.pi] * 3])
    shift = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 360.0 * turns])
    with figure(path, 3, 3, (11.0, 6.6), width_ratios=[1.0, 1.0, 1.1]) as axes:
        for channel, label in enumerate(LABELS):
            ax = axes[channel % 3, channel // 3]
            for t, m, p in zip(nodes, measured[..., channel], predicted[..., channel], strict=True):
                _draw_window(
                    ax, t, t, *(values * scale[channel] - shift[channel] for values in (m, p))
                )
            ax.set_ylabel(label)
            if channel % 3 == 2:
                ax.set_xlabel("time [s]")
        axes[0, 0].set_title(f"2 s predictions from each dot, {what}")
        _draw_track(axes, measured, predicted)


def _draw_window(
    ax: Any, at_measured: Array, at_predicted: Array, measured: Array, predicted: Array
) -> None:
    ax.plot(at_predicted, predicted, "-", lw=1.6, color=PREDICTED)
    ax.plot(at_measured, measured, ".", ms=2.6, color=MEASURED)
    ax.plot(at_predicted[0], predicted[0], "o", ms=4.0, color=ACCENT)


def _first_block(nodes: Array) -> np.ndarray:
    """Indices of the first contiguous windows, ten at most."""
    breaks = np.flatnonzero(np.abs(nodes[1:, 0] - nodes[:-1, -1]) > 0.5)
    return np.arange(min(int(breaks[0]) + 1 if len(breaks) else len(nodes), 10))


def _draw_track(axes: Any, measured: Array, predicted: Array) -> None:
    """The right column: the same windows seen from above, and a legend."""
    grid = axes[0, 2].get_gridspec()
    for ax in axes[:, 2]:
        ax.remove()
    ax, below = (axes[0, 0].figure.add_subplot(grid[rows, 2]) for rows in (slice(0, 2), 2))
    for m, p in zip(measured, predicted, strict=True):
        _draw_window(ax, m[:, 0], p[:, 0], m[:, 1], p[:, 1])
    below.plot([], [], ".", color=MEASURED, label="measured pose")
    below.plot([], [], "-", color=PREDICTED, label="model, from logged inputs")
    below.plot([], [], "o", ms=4.0, color=ACCENT, label="initial state, estimated")
    below.axis("off")
    below.legend(loc="upper center")
    ax.set_aspect("equal", adjustable="box")
    ax.set_title("From above")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")


def draw_residuals(found: Identification, path: Path) -> None:
    """Draw the held-out residuals over the horizon, their distribution and autocorrelation."""
    windows, scored, what = _scored_windows(found)
    observed = windows.weight > 0
    ahead = (windows.nodes - windows.nodes[:, :1]).mean(axis=0)
    counts = np.maximum(observed.sum(axis=0), 1)
    spread = np.sqrt((scored.residual**2).sum(axis=0) / counts)
    with figure(path, 1, 3, (11.0, 3.4)) as axes:
        ahead_axis, histogram, correlation = axes[0]
        for half, (name, mark, colour) in enumerate(
            (("position", "o-", PREDICTED), ("attitude", "s--", ACCENT))
        ):
            mean = np.sqrt((spread[:, 3 * half : 3 * half + 3] ** 2).mean(axis=1))
            ahead_axis.plot(ahead, mean, mark, ms=3, color=colour, label=name)
        ahead_axis.axhline(1.0, color=QUIET, lw=0.8)
        ahead_axis.set_ylim(0.0, max(2.0, float(spread.max()) * 1.1))
        ahead_axis.set_title(f"Error, {what}")
        ahead_axis.set_xlabel("prediction horizon [s]")
        ahead_axis.set_ylabel("rms residual [sigma of the pose noise]")
        ahead_axis.legend(loc="upper right")
        values = scored.residual[observed]
        bins = np.linspace(-5.0, 5.0, 41)
        histogram.hist(
            np.clip(values, -5, 5), bins, density=True, color="#b9cde0", edgecolor="white", lw=0.4
        )
        grid = np.linspace(-5.0, 5.0, 200)
        histogram.plot(
            grid,
            np.exp(-0.5 * grid**2) / np.sqrt(2.0 * np.pi),
            color=QUIET,
            lw=1.2,
            label="white noise",
        )
        histogram.set_title("All channels")
        histogram.set_xlabel("residual [sigma]")
        histogram.set_ylabel("density [1/sigma]")
        histogram.legend(loc="upper right")
        lags, position, attitude = _autocorrelation(scored.residual, observed)
        correlation.plot(lags, position, "o-", ms=3, color=PREDICTED, label="position")
        correlation.plot(lags, attitude, "s--", ms=3, color=ACCENT, label="attitude")
        correlation.axhline(0.0, color=QUIET, lw=0.8)
        correlation.set_title("Remaining correlation")
        correlation.set_xlabel("lag [frames]")
        correlation.set_ylabel("autocorrelation [-]")
        correlation.legend(loc="upper right")


def draw_forecast_errors(
    forecasts: dict[str, Forecasts], path: Path, *, title: str, highest: float, every: int = 1
) -> None:
    """Draw distances of forecasts from the measurement over time, and their distribution.

    Args:
        forecasts: by the label of the predictor, four at most; the model first.
        path: the PNG file.
        title: what the dots are.
        highest: of the axis over time [m].
        every: show only each such dot over time; the distribution has all of them.
    """
    styles = [("o", "-", PREDICTED), ("s", "--", ACCENT), ("x", "-.", QUIET), ("^", ":", MEASURED)]
    if len(forecasts) < 4:
        del styles[2]
    with figure(path, 1, 2, (11.0, 3.5), width_ratios=[1.9, 1.0]) as axes:
        over_time, shares = axes[0]
        for (label, made), (mark, line, colour) in zip(forecasts.items(), styles, strict=False):
            distance = np.linalg.norm(made.error_position, axis=1)
            over_time.plot(
                made.t[::every],
                distance[::every],
                mark,
                ms=2.6,
                color=colour,
                alpha=0.8,
                label=label,
            )
            ordered = np.sort(distance)
            share = np.arange(1, len(ordered) + 1) / len(ordered) * 100.0
            shares.plot(ordered, share, line, color=colour, lw=1.8)
        over_time.set_ylim(0.0, highest)
        over_time.set_xlabel("time [s]")
        over_time.set_ylabel("distance from the measurement [m]")
        over_time.set_title(title)
        over_time.legend(loc="upper right", ncols=1 if len(forecasts) < 4 else 2)
        shares.set_xlim(0.0, 5.0 / 8.0 * highest)
        shares.set_xlabel("distance from the measurement [m]")
        shares.set_ylabel("predictions within it [%]")
        shares.set_title("Cumulative distribution")


def draw_intervals(found: Identification, path: Path) -> None:
    """Draw every parameter's 95 % interval relative to its value or its typical value."""
    model, confidence = found.model, found.uncertainty
    known = {p.name: p for p in model.parameters}
    names = [n for n in confidence.names if n not in confidence.at_bound]
    typical = np.array([ordinary_size(known[n], model.values[n]) for n in names])
    half = np.array([1.96 * confidence.sigma[n] for n in names]) / typical * 100.0
    order = np.argsort(half)
    with figure(path, 1, 1, (7.6, 0.24 * len(names) + 1.2)) as axes:
        ax = axes[0, 0]
        for row, i in enumerate(order[::-1]):
            weak = names[i] in confidence.not_excited
            colour = ACCENT if weak else PREDICTED
            ax.plot([0.05, half[i]], [row, row], "--" if weak else "-", color=colour, lw=2.2)
            ax.plot(half[i], row, "s" if weak else "o", ms=4.5, color=colour)
            unit = known[names[i]].unit
            text = f"{model.values[names[i]]:.4g} {'' if unit == '-' else unit}"
            ax.annotate(
                text, (half[i], row), (7, -3), textcoords="offset points", fontsize=8, color=QUIET
            )
        ax.set_yticks(range(len(names)), [names[i] for i in order[::-1]])
        ax.set_xscale("log")
        ax.set_xlim(0.05, 1000.0)
        ax.axvline(50.0, color=QUIET, lw=0.8, ls=":")
        ax.set_xlabel(
            "half width of the 95 % interval [% of a typical value]; "
            "right of the dotted line: not excited"
        )
        ax.set_title("Uncertainty of each parameter from this flight")


def _scored_windows(found: Identification) -> tuple[Any, Any, str]:
    if found.held_out is None:
        return found.windows, found.train, "fitted data"
    return select_windows(found.windows, found.held_out_index), found.held_out, "held-out data"


def _autocorrelation(
    residual: Array, observed: np.ndarray, lags: int = 15
) -> tuple[Array, Array, Array]:
    """Autocorrelation within windows, averaged over three position and three attitude channels."""
    shift = np.arange(1, min(lags, residual.shape[1] - 1) + 1)
    found = np.empty((len(shift), 6))
    for i, k in enumerate(shift):
        both = observed[:, k:] & observed[:, :-k]
        product = (residual[:, k:] * residual[:, :-k] * both).sum(axis=(0, 1)) / np.maximum(
            both.sum(axis=(0, 1)), 1
        )
        found[i] = product / np.maximum(
            (residual**2).sum(axis=(0, 1)) / np.maximum(observed.sum(axis=(0, 1)), 1), 1e-12
        )
    return shift, found[:, :3].mean(axis=1), found[:, 3:].mean(axis=1)
