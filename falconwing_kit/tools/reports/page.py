"""What all pages and figures share: a template -> one HTML file that needs no network; axes in one
look -> a PNG.
"""

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from falconwing_kit.core.files import atomic_write

# Colours that read well in grey too.
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
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}
FRAME = Path(
    __file__
).parent  # of page.html.j2, which every page extends, and parts.html.j2 with table and picture


def render(template: Path, **values: Any) -> str:
    """HTML of a template and its values; values are text, so markup in them is escaped.

    Args:
        template: a Jinja template; it may extend page.html.j2 and import from parts.html.j2.
        values: what it names.

    Returns:
        HTML, marked as such for a page that holds it.

    Raises:
        jinja2.UndefinedError: the template names a value that is not given.
    """
    from markupsafe import Markup

    return Markup(_environment(template.parent).get_template(template.name).render(values))


def write_page(path: Path, template: Path, **values: Any) -> None:
    """Write the page of a template and its values, as `render` takes them, whole or not at all.

    Args:
        path: the HTML file.
        template: the page's template.
        values: what it names.
    """
    text = render(template, **values)
    with atomic_write(path, text=True) as handle:
        handle.write(text)


@cache
def _environment(folder: Path) -> Any:
    """Templates of a folder and of this one, with two filters: a number by a format, a PNG as a
    `data:` address.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([folder, FRAME]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"number": format, "embedded": _embedded}
    return environment


def _embedded(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


@contextmanager
def figure(
    path: Path, rows: int, columns: int, size: tuple[float, float], **grid: Any
) -> Iterator[Any]:
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
