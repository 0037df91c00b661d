"""Figure of an alignment: plan view of the hall with camera places and position uncertainty."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.tools.capture.align import Alignment
from falconwing_kit.tools.capture.photo_files import Reconstruction
from falconwing_kit.tools.capture.survey.points import MARKER_CORNERS, Survey
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure

HEIGHT = 1.5  # [m] above the floor, a typical flight height, at which the uncertainty is drawn


def draw_alignment(
    path: str | Path,
    reconstruction: Reconstruction,
    survey: Survey,
    alignments: Sequence[tuple[str, Alignment]],
) -> None:
    """Draw one plan view per alignment.

    Args:
        path: of the PNG.
        reconstruction: not aligned.
        alignments: with titles; one without covariance is drawn without uncertainty.

    Raises:
        InputError: the file cannot be written.
        FileNotFoundError: its folder does not exist.
    """
    best = alignments[-1][1]
    low, high = _bounds(best, reconstruction, survey)
    with figure(
        Path(path), 1, len(alignments), (5.2 * len(alignments), 3.9), sharex=True, sharey=True
    ) as axes:
        for ax, (title, alignment) in zip(axes[0], alignments, strict=True):
            places = alignment.points(reconstruction.T_world_camera[:, :3, 3])
            cloud = alignment.points(
                reconstruction.points[:: max(1, len(reconstruction.points) // 6000)]
            )
            ax.scatter(
                *cloud.T[:2], s=1.0, color=MEASURED, alpha=0.7, linewidths=0, rasterized=True
            )
            ax.scatter(*places.T[:2], s=5, color=PREDICTED, linewidths=0, label="photos")
            _draw_sigma(ax, alignment, low, high)
            corners = survey.places([name for name in MARKER_CORNERS if name in survey.names])
            ax.plot(*corners.T[:2], color=ACCENT, linewidth=3.0, label="marker")
            for face in survey.select("align").faces():
                outline = survey.places([*face, face[0]])
                ax.plot(*outline.T[:2], color=QUIET, linewidth=1.2, label=face[0].split("_")[0])
            ax.set(
                title=title,
                xlabel="x, landing direction [m]",
                xlim=(low[0], high[0]),
                ylim=(low[1], high[1]),
            )
            ax.set_aspect("equal")
        axes[0, 0].set_ylabel("y, left [m]")
        axes[0, -1].legend(loc="upper right", fontsize=8, frameon=True)


def _bounds(
    alignment: Alignment, reconstruction: Reconstruction, survey: Survey
) -> tuple[Array, Array]:
    """Lowest and highest x and y of cameras and survey, with a margin of 1 m."""
    shown = np.concatenate(
        [alignment.points(reconstruction.T_world_camera[:, :3, 3]), survey.p_world]
    )[:, :2]
    return shown.min(axis=0) - 1.0, shown.max(axis=0) + 1.0


def _draw_sigma(ax: object, alignment: Alignment, low: Array, high: Array) -> None:
    """Contours of the position uncertainty [cm] at flight height."""
    if not np.isfinite(alignment.covariance).all():
        return
    x, y = np.meshgrid(np.linspace(low[0], high[0], 60), np.linspace(low[1], high[1], 40))
    points = np.stack([x, y, np.full_like(x, HEIGHT)], axis=-1).reshape(-1, 3)
    sigma_cm = 100.0 * alignment.sigma(points).reshape(x.shape)
    lines = ax.contour(x, y, sigma_cm, levels=6, colors=ACCENT, linewidths=0.9)  # type: ignore[attr-defined]
    ax.clabel(lines, fmt="%.3g cm", fontsize=7)  # type: ignore[attr-defined]
