"""Print file: a poster and its pages -> a PDF of vectors at true size, with a first page of checks.

PDF counts in points of 1/72 inch [ISO 32000-1, 8.3.2.3], so a millimetre is 72 / 25.4 of them. One
axes covers each page with its millimetres as data units. No margin has anything to be read by a
detector: marks are grey hairlines.
"""

from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.hardware.prints import (
    CARD_MM,
    CHECK_MM,
    CHECK_TOLERANCE_MM,
    MARGIN_MM,
    OVERLAP_MM,
    PAPERS,
    Colour,
    Layout,
    Page,
    Poster,
    page_boxes,
)

MM_PER_INCH = 25.4
INK = "#555555"
MARK_MM = (1.0, 6.0)  # a cut mark begins and ends this far from its window
HAIRLINE_PT = 0.35


def write_print(poster: Poster, layout: Layout, path: Path) -> int:
    """Write the file, whole or not at all.

    Args:
        poster: what is printed.
        layout: how it is cut.
        path: the PDF.

    Returns:
        Number of pages, the first one included.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import PdfPages

    # Paths stay as they are: a simplified one may lose a corner.
    settings: Any = {"path.simplify": False, "pdf.fonttype": 42, "font.size": 8.0}
    title = f"FalconWing {poster.name}, true size on {layout.paper}"
    with (
        rc_context(settings),
        atomic_write(path) as handle,
        PdfPages(handle, metadata={"Title": title, "CreationDate": None}) as pdf,
    ):
        pdf.savefig(_first_page(poster, layout))
        for page in layout.pages:
            pdf.savefig(_page(poster, layout, page))
    return 1 + len(layout.pages)


def _sheet(width: float, height: float) -> tuple[Any, Any]:
    """A figure of a page, and axes over all of it in millimetres."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH), facecolor="none")
    ax = drawing.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set(xlim=(0.0, width), ylim=(0.0, height))
    ax.set_axis_off()
    return drawing, ax


def _page(poster: Poster, layout: Layout, page: Page) -> Any:
    """A sheet of the poster."""
    drawing, ax = _sheet(layout.page_width, layout.page_height)
    for boxes, colour in page_boxes(poster, layout, page):
        _fill(ax, boxes, colour)
    _cut_marks(ax, layout, page)
    many = len(layout.pages) > 1
    place = f"row {page.row} of {layout.rows}, column {page.column} of {layout.columns}"
    label = f"{poster.name}: {place}" if many else poster.name
    _check_lines(ax, layout.page_height)
    right = layout.page_width - MARGIN_MM
    ax.text(right, 4.5, label, ha="right", va="bottom", color=INK, fontsize=7.0)
    return drawing


def _fill(ax: Any, boxes: Array, colour: Colour) -> None:
    """Rectangles (N, 4) as one path, so that no hairline shows between neighbours."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    x, y, w, h = boxes.T
    corners = np.stack([x, y, x + w, y, x + w, y + h, x, y + h, x, y], axis=1).reshape(-1, 2)
    codes = [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY] * len(boxes)
    ax.add_patch(PathPatch(Outline(corners, codes), facecolor=colour, linewidth=0.0, clip_on=False))


def _line(ax: Any, x: tuple[float, float], y: tuple[float, float], **style: Any) -> None:
    more = {"color": INK, "linewidth": HAIRLINE_PT, "solid_capstyle": "butt"} | style
    ax.plot(x, y, clip_on=False, **more)


def _cut_marks(ax: Any, layout: Layout, page: Page) -> None:
    """Solid marks: cut here, where a page lies on its left or upper neighbour. Dashed ones: the
    next page's edge comes here.
    """
    if len(layout.pages) == 1:
        return
    width, height = layout.window
    x0, y0, x1, y1 = MARGIN_MM, MARGIN_MM, MARGIN_MM + width, MARGIN_MM + height
    near, far = MARK_MM
    upright = [(x0, "-")] if page.column > 1 else []
    upright += [(x1 - OVERLAP_MM, "--")] if page.has_right else []
    lying = [(y1, "-")] if page.row > 1 else []
    lying += [(y0 + OVERLAP_MM, "--")] if page.has_below else []
    for x, style in upright:
        _line(ax, (x, x), (y1 + near, y1 + far), linestyle=style)
        _line(ax, (x, x), (y0 - near, y0 - far), linestyle=style)
    for y, style in lying:
        _line(ax, (x0 - near, x0 - far), (y, y), linestyle=style)
        _line(ax, (x1 + near, x1 + far), (y, y), linestyle=style)


def _check_lines(ax: Any, height: float) -> None:
    """A line of CHECK_MM across in the lower margin, and one up in the left margin."""
    low, base = 5.0, MARGIN_MM + 12.0
    _line(ax, (base, base + CHECK_MM), (low, low), linewidth=0.5)
    _line(ax, (low, low), (base, base + CHECK_MM), linewidth=0.5)
    for place, long in ((0.0, 2.4), (50.0, 1.4), (CARD_MM[0], 2.0), (CHECK_MM, 2.4)):
        _line(ax, (base + place,) * 2, (low, low + long))
        _line(ax, (low, low + long), (base + place,) * 2)
    words = (f"check: {CHECK_MM:g} mm", f"bank card {CARD_MM[0]:g}")
    for word, place, side in ((words[0], 2.0, "left"), (words[1], CARD_MM[0] - 1.0, "right")):
        ax.text(base + place, low + 0.6, word, ha=side, va="bottom", fontsize=5.5, color=INK)
        ax.text(
            low + 0.6, base + place, word, ha="left", fontsize=5.5, color=INK, rotation=90,
            va="bottom" if side == "left" else "top",
        )  # fmt: skip


def _first_page(poster: Poster, layout: Layout) -> Any:
    """What this is, what to measure, and the plan of the pages; upright, on the same paper."""
    width, height = PAPERS[layout.paper]
    drawing, ax = _sheet(width, height)
    left, top = MARGIN_MM + 5.0, height - 24.0
    ax.text(left, top, f"FalconWing {poster.name}", fontsize=20.0, fontweight="bold", va="top")
    sheets = len(layout.pages)
    pages = (
        "One page of print follows." if sheets == 1
        else f"{sheets} pages of print follow: {layout.rows} rows of {layout.columns}."
    )  # fmt: skip
    glue = (
        "Cut each page along its solid marks (its left and upper edge), and lay it on its"
        " neighbour's dashed marks: neighbours overlap by"
        f" {OVERLAP_MM:g} mm. Begin with row 1, column 1."
    )
    steps = [
        *poster.notes, pages, *([glue] if sheets > 1 else []),
        "Print at 100 % or \"actual size\". No \"fit to page\", no borderless enlargement.",
        f"Measure both check lines of a page with a steel rule: {CHECK_MM:g} mm within"
        f" {CHECK_TOLERANCE_MM:g}; or lay a bank card into the frame below.",
        "Type the length into falconwing doctor --bench, which refuses a wrong scale.",
    ]  # fmt: skip
    y = top - 14.0
    for number, step in enumerate(steps, 1):
        lines = _wrapped(step, width - 2.0 * left - 8.0)
        ax.text(left, y, f"{number}", fontsize=10.5, va="top", color=INK)
        ax.text(left + 8.0, y, "\n".join(lines), fontsize=10.5, va="top", linespacing=1.35)
        y -= 5.3 * len(lines) + 2.2
    _card(ax, left, y - CARD_MM[1] - 6.0)
    _plan(ax, poster, layout, (left, 24.0, width - 2.0 * left, y - CARD_MM[1] - 38.0))
    _check_lines(ax, height)
    return drawing


def _wrapped(text: str, width: float) -> list[str]:
    """Lines of at most about this width [mm] in letters of 10.5 points."""
    import textwrap

    return textwrap.wrap(text, int(width / 1.95))


def _card(ax: Any, x: float, y: float) -> None:
    """The frame of a bank card."""
    w, h = CARD_MM
    _line(ax, (x, x + w, x + w, x, x), (y, y, y + h, y + h, y), linewidth=0.6)  # type: ignore[arg-type]
    words = f"A bank card fits into this frame:\n{w:.2f} x {h:.2f} mm"
    ax.text(x + 0.5 * w, y + 0.5 * h, words, ha="center", va="center", color=INK, fontsize=9.0)


def _plan(ax: Any, poster: Poster, layout: Layout, box: tuple[float, float, float, float]) -> None:
    """The poster with its pages, in small."""
    x0, y0, wide, high = box
    if high < 20.0:
        return
    pages, (w, h) = layout.pages, layout.window
    low = np.array([min(page.x for page in pages), min(page.y for page in pages)])
    span = np.array([max(page.x for page in pages) + w, max(page.y for page in pages) + h]) - low
    scale = min(wide / span[0], high / span[1])
    at = np.array([x0, y0 + high - scale * span[1]])
    for boxes, colour in poster.boxes:
        placed = np.concatenate([at + scale * (boxes[:, :2] - low), scale * boxes[:, 2:]], axis=1)
        _fill(ax, placed, tuple(0.5 + 0.5 * part for part in colour))  # type: ignore[arg-type]
    for page in pages:
        x, y = at + scale * (np.array([page.x, page.y]) - low)
        a, b = x + scale * w, y + scale * h
        _line(ax, (x, a, a, x, x), (y, y, b, b, y))  # type: ignore[arg-type]
        if len(pages) > 1 and scale * min(w, h) > 8.0:
            name = f"{page.row}.{page.column}"
            ax.text(0.5 * (x + a), 0.5 * (y + b), name, ha="center", va="center", fontsize=7.0)
    words = "The pages, numbered row.column" if len(pages) > 1 else "The page"
    ax.text(x0, y0 + high + 2.0, words, va="bottom", fontsize=9.0, color=INK)
