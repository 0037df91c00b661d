"""A gap study -> measured and predicted traces of a typical and of the worst window, as figures."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.gap.study import GapStudy
from falconwing_kit.sysid.score import DIVERGED_RESIDUAL
from falconwing_kit.sysid.shooting import select_windows
from falconwing_kit.tools.reports.gap_plots import DPI, WIDTH_IN
from falconwing_kit.tools.reports.page import ACCENT, PREDICTED, figure

# Per channel: label, unit of the trace, unit of the error, and the factors from SI to each.
CHANNEL_AXES = (
    ("x", "m", "cm", 1.0, 100.0),
    ("y", "m", "cm", 1.0, 100.0),
    ("height", "m", "cm", 1.0, 100.0),
    ("roll", "°", "°", 180.0 / np.pi, 180.0 / np.pi),
    ("pitch", "°", "°", 180.0 / np.pi, 180.0 / np.pi),
    ("yaw", "°", "°", 180.0 / np.pi, 180.0 / np.pi),
)
BAND_SIGMAS = 1.96  # half width of the noise band: 95 % of Gaussian noise lies inside


@dataclass(frozen=True)
class TraceWindow:
    """One window of a flight with its predictions, L rows, 6 channels as in sysid's CHANNELS."""

    t: Array  # (L,) on the flight's clock [s]
    measured: Array  # (L, 6) [m, rad], nan where there is no pose
    before: Array  # (L, 6) error of the nominal model, predicted less measured [m, rad]
    after: Array | None  # (L, 6) the same with what was found; None where nothing was added
    sigma: Array  # (6,) standard deviation of the pose noise [m, rad]

    @property
    def chi2(self) -> tuple[float, ...]:
        """Mean square error in sigmas of the noise: before, and after where something was added."""
        errors = [self.before] if self.after is None else [self.before, self.after]
        return tuple(float(np.nanmean((error / self.sigma) ** 2)) for error in errors)


def example_windows(study: GapStudy) -> dict[str, TraceWindow]:
    """The windows "typical" and "worst": median and largest mean square error before.

    Of the windows that were held out of the fit; on a flight too short for that, of all. One
    window alone is the worst.
    """
    naming, closed = study.naming, study.closed
    windows = select_windows(study.base.with_measurement_weights(naming.windows), closed.held_out)
    errors = [_error(part.residual, windows.weight) for part in (closed.before, closed.after)]
    sigma = study.base.found.sigma
    size = np.nan_to_num(np.nanmean((errors[0] / sigma) ** 2, axis=(1, 2)), nan=np.inf)
    order = np.argsort(size, kind="stable")
    chosen = {"typical": order[(len(order) - 1) // 2], "worst": order[-1]}
    if len(order) == 1:
        del chosen["typical"]
    starts = np.array([flight.t[0] for flight in windows.flights])[windows.flight]
    poses = np.where(windows.weight > 0.0, windows.pose, np.nan)
    turn = 2.0 * np.pi  # whole turns of an unwrapped yaw carry no information
    poses[..., 5] -= turn * np.round(np.nanmedian(poses[..., 5], axis=1, keepdims=True) / turn)
    return {
        name: TraceWindow(
            starts[w] + windows.nodes[w],
            poses[w],
            errors[0][w],
            None if closed.after is closed.before else errors[1][w],
            sigma,
        )
        for name, w in chosen.items()
    }


def _error(residual: Array, weight: Array) -> Array:
    """(W, L, 6) residuals in sigmas -> errors in m and rad, nan where missing or diverged."""
    known = (weight > 0.0) & (np.abs(residual) < DIVERGED_RESIDUAL)
    return np.divide(residual, weight, out=np.full_like(residual, np.nan), where=known)


def draw_traces(window: TraceWindow, path: Path) -> None:
    """Left the measured pose and its predictions, right their errors with the band of the noise.

    Args:
        window: what was measured and predicted.
        path: the PNG to write.
    """
    if window.after is None:
        lines = [("predicted", window.before, ACCENT, "--", 1.3)]
    else:
        lines = [
            ("predicted, before", window.before, ACCENT, "--", 1.3),
            ("predicted, after", window.after, PREDICTED, "-", 1.4),
        ]
    margins = {"left": 0.13, "right": 0.985, "top": 0.895, "bottom": 0.075}
    with figure(
        path, 6, 2, (WIDTH_IN, 5.7), dpi=DPI, sharex=True,
        gridspec_kw={**margins, "hspace": 0.16, "wspace": 0.36}, margins=True,
    ) as axes:  # fmt: skip
        for k, (name, unit, error_unit, scale, error_scale) in enumerate(CHANNEL_AXES):
            trace, errors = axes[k]
            measured, band = window.measured[:, k], BAND_SIGMAS * window.sigma[k]
            seen = np.isfinite(measured)
            trace.plot(
                window.t[seen], scale * measured[seen], ".", color="#333333", ms=2.6,
                label="measured", zorder=3,
            )  # fmt: skip
            errors.axhspan(-error_scale * band, error_scale * band, color="#dddddd", lw=0)
            for label, error, colour, dashes, width in lines:
                known = np.isfinite(error[:, k])
                t, drawn = window.t[known], error[known, k]
                trace.plot(
                    t, scale * (measured[known] + drawn), color=colour, ls=dashes, lw=width,
                    label=label,
                )  # fmt: skip
                errors.plot(t, error_scale * drawn, color=colour, ls=dashes, lw=width)
            trace.set_ylabel(f"{name} [{unit}]", labelpad=2)
            errors.set_ylabel(f"[{error_unit}]", labelpad=0)
            for ax in (trace, errors):
                ax.locator_params(axis="y", nbins=4)
                ax.tick_params(labelsize=8, pad=1.5)
        axes[0, 0].set_title("Pose")
        axes[0, 1].set_title("Prediction error")
        for ax in axes[-1]:
            ax.set_xlabel("time [s]", labelpad=1)
        axes[0, 0].figure.legend(
            *axes[0, 0].get_legend_handles_labels(), loc="upper center", ncols=3, fontsize=8.5,
            handlelength=1.6, columnspacing=1.2, borderaxespad=0.1,
        )  # fmt: skip
