"""What all pages and figures share: parts -> one HTML file that needs no network; axes in one look -> a PNG."""

import base64
import html
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
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
CSS = """
:root { --ink: #222; --quiet: #666; --line: #ddd; --blue: #0b5394; --rust: #c1440e; }
body { font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; color: var(--ink);
       margin: 0 auto; max-width: 62rem; padding: 2rem 1.2rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.35rem; margin: 3rem 0 .4rem; padding-top: 1rem; border-top: 1px solid var(--line); }
p.lead { font-size: 1.1rem; color: var(--quiet); margin-top: 0; }
p { max-width: 46rem; }
.tag { display: inline-block; font-size: .8rem; font-weight: 600; padding: .1rem .55rem; border-radius: 1rem;
       border: 1px solid currentColor; margin-right: .5rem; }
.simulated { color: var(--blue); } .measured { color: var(--rust); }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: .3rem; }
th, td { text-align: right; padding: .25rem .9rem; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
tr.best td { font-weight: 700; }
figure { margin: 1.4rem 0; } figure img { width: 100%; height: auto; }
figcaption { color: var(--quiet); font-size: .93rem; max-width: 46rem; }
details { margin: 1rem 0; } summary { cursor: pointer; color: var(--blue); }
code { background: #f4f4f4; padding: .08rem .3rem; border-radius: .2rem; }
pre { background: #f4f4f4; padding: .7rem 1rem; overflow-x: auto; }
footer { margin-top: 3rem; padding-top: 1rem; border-top: 1px solid var(--line); color: var(--quiet);
         font-size: .9rem; }
@media print { h2 { break-before: page; } }
"""


@dataclass(frozen=True)
class Picture:
    """A figure with what it shows in words."""

    path: Path
    caption: str
    alt: str  # for who cannot see it


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph; the text may hold inline HTML.

    Args:
        text: its words.
        kind: a class of the style sheet, or none.

    Returns:
        HTML.
    """
    return f'<p class="{kind}">{text}</p>' if kind else f"<p>{text}</p>"


def table(caption: str, headers: Sequence[str], rows: Sequence[Sequence[str]], best: int | None = None) -> str:
    """A table whose first column names the rows.

    Args:
        caption: what it shows.
        headers: one per column, with units.
        rows: texts, each as long as the headers.
        best: the row to set in bold, if any.

    Returns:
        HTML.
    """
    head = "".join(f'<th scope="col">{html.escape(h)}</th>' for h in headers)
    body = "".join(
        f"<tr{' class=best' if i == best else ''}>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>"
        for i, row in enumerate(rows)
    )
    return (
        f"<table><caption>{html.escape(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


def picture(shown: Picture) -> str:
    """A figure, embedded.

    Args:
        shown: file, caption and text alternative.

    Returns:
        HTML.
    """
    data = base64.b64encode(shown.path.read_bytes()).decode("ascii")
    return (
        f'<figure><img alt="{html.escape(shown.alt, quote=True)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{shown.caption}</figcaption></figure>"
    )


def write_page(path: Path, title: str, parts: Sequence[str]) -> None:
    """Write the page, whole or not at all.

    Args:
        path: the HTML file.
        title: of the window.
        parts: HTML in reading order.
    """
    text = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{CSS}</style></head><body><main>"
        + "\n".join(parts)
        + "</main></body></html>\n"
    )
    with atomic_write(path, text=True) as handle:
        handle.write(text)


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
