"""One look for all figures: colours that read well in grey too, and a file that appears whole."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from falconwing_kit.core.files import atomic_write

MEASURED, PREDICTED, ACCENT, QUIET = "#8c8c8c", "#0b5394", "#c1440e", "#444444"
STYLE: Any = {
    "figure.dpi": 110,
    "savefig.dpi": 130,
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


@contextmanager
def figure(path: Path, rows: int, columns: int, size: tuple[float, float], **grid: Any) -> Iterator[Any]:
    """Axes to draw on; the file appears whole when the block ends.

    Args:
        path: the PNG to write.
        rows: of axes.
        columns: of axes.
        size: width and height [inch].
        grid: handed to matplotlib's `subplots`.

    Yields:
        The array of axes, always two-dimensional.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        drawing = Figure(figsize=size)
        yield drawing.subplots(rows, columns, squeeze=False, **grid)
        with atomic_write(path) as handle:
            drawing.savefig(handle, format="png")
