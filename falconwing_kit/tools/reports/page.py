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
from falconwing_kit.tools.reports.mathematics import mathematics

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
    """Templates of a folder and of this one, with four filters: a number by a format, a PNG as a
    `data:` address, the width that it was drawn at, a text with its formulas drawn.
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
    environment.filters |= {
        "number": format,
        "embedded": _embedded,
        "drawn_width": _drawn_width,
        "mathematics": mathematics,
    }
    return environment


def _embedded(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def _drawn_width(path: Path) -> str:
    """Width at which a PNG was drawn as a length of CSS, "none" where the file does not say.

    From its pixels (chunk IHDR) and pixels per metre (chunk pHYs) [PNG specification, 11.2.1 and
    11.3.4.3], so that a page does not blow a small figure up.
    """
    data = path.read_bytes()[:512]
    at = data.find(b"pHYs")
    per_metre = int.from_bytes(data[at + 4 : at + 8], "big") if at > 0 else 0
    pixels = int.from_bytes(data[16:20], "big")
    return f"{pixels / per_metre / 0.0254:.2f}in" if per_metre else "none"


@contextmanager
def figure(
    path: Path,
    rows: int,
    columns: int,
    size: tuple[float, float],
    dpi: float = STYLE["savefig.dpi"],
    margins: bool = False,
    **grid: Any,
) -> Iterator[Any]:
    """Axes to draw on; the file appears whole when the block ends.

    Args:
        path: the PNG to write.
        rows: of axes.
        columns: of axes.
        size: width and height [inch].
        dpi: pixels per inch.
        margins: the grid's own margins hold; otherwise they are computed from what is drawn, which
            takes as long as drawing it.
        grid: handed to matplotlib's `subplots`.

    Yields:
        The array of axes, always two-dimensional.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        drawing = Figure(figsize=size, layout=None if margins else "constrained")
        yield drawing.subplots(rows, columns, squeeze=False, **grid)
        with atomic_write(path) as handle:
            drawing.savefig(handle, format="png", dpi=dpi)
