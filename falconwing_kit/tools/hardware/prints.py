"""Prints: marker, landing pad or checkerboard -> true-size shapes, cut into pages of a paper size.

All lengths are in millimetres. A poster has x to the right and y up from its lower left corner, as
seen by a viewer; a page has them from its own lower left corner. A poster that is wider than a page
is cut into windows that overlap by OVERLAP_MM, row 1 at the top. Margins hold cut marks, labels and
check lines, so that nothing but the poster is on it.
"""

import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.scene.arena import PLAN
from falconwing_kit.vision.marker import Marker

Paper = Literal["A4", "A3", "A2", "Letter"]
PAPERS: dict[str, tuple[float, float]] = {  # short and long side [ISO 216; ANSI Y14.1]
    "A4": (210.0, 297.0), "A3": (297.0, 420.0), "A2": (420.0, 594.0), "Letter": (215.9, 279.4),
}  # fmt: skip
MARGIN_MM = 15.0  # most printers leave 3 to 6 mm white
OVERLAP_MM = 10.0  # of neighbouring pages, to glue them
CHECK_MM = 100.0  # length of the check lines
CHECK_TOLERANCE_MM = 0.5  # what a tape resolves; half a per cent of the marker's distance
CARD_MM = (85.60, 53.98)  # a bank card [ISO/IEC 7810, ID-1]
MAX_PAGES = 1000
Colour = tuple[float, float, float]  # red, green, blue on a screen, 0..1
BLACK: Colour = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Poster:
    """Rectangles of one true-size drawing; later ones lie on earlier ones."""

    name: str
    width: float
    height: float
    boxes: tuple[tuple[Array, Colour], ...]  # (N, 4) x, y, width, height, and their colour
    notes: tuple[str, ...]  # sentences for the first page


@dataclass(frozen=True)
class Page:
    """One sheet of a poster: the window of the poster that it shows."""

    row: int  # 1 is the top
    column: int  # 1 is the left
    x: float  # lower left corner of the window on the poster
    y: float
    has_right: bool  # a neighbour to the right, which is laid on this page's overlap
    has_below: bool


@dataclass(frozen=True)
class Layout:
    """How a poster is cut."""

    paper: str
    page_width: float
    page_height: float
    rows: int
    columns: int
    pages: tuple[Page, ...]

    @property
    def window(self) -> tuple[float, float]:
        """Width and height of the part of a page that shows the poster."""
        return self.page_width - 2.0 * MARGIN_MM, self.page_height - 2.0 * MARGIN_MM


def marker_poster(marker: Marker | None = None) -> Poster:
    """The marker with a white quiet zone of one cell, which its detection needs.

    Args:
        marker: dictionary, id and size; None for the hall's.
    """
    import cv2

    marker = marker or Marker()
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    bits = (
        cv2.aruco.generateImageMarker(known, marker.id, marker.cells) < 128
    )  # black, row 0 on top
    cell = 1000.0 * marker.size / marker.cells
    side = cell * (marker.cells + 2)
    boxes = [
        (cell * (1 + first), cell * (marker.cells - row), cell * (last - first), cell)
        for row, line in enumerate(bits)
        for first, last in _runs(line)
    ]
    size = f"{1000.0 * marker.size:g} mm"
    return Poster(
        "marker", side, side, ((np.array(boxes), BLACK),),
        (
            f"ArUco marker {marker.dictionary}, id {marker.id}, black square {size}.",
            f"The white border of {cell:.1f} mm belongs to it: the board is {side:.0f} mm square.",
            "Glue it on something flat and stiff; matt paper, no lamination, no folds.",
            "Pages with no black can be left out where the board itself is white.",
        ),
    )  # fmt: skip


def _runs(line: Array) -> Iterator[tuple[int, int]]:
    """Begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def pad_poster(pad: LandingPad | None = None) -> Poster:
    """The landing pad from above, x of the world to the right, in the colours of arena.toml.

    Args:
        pad: its length and width are used; None for the hall's. Seams are a metre apart, as there.

    Raises:
        InputError: the pad is less than 0.1 m wide or long.
    """
    pad = pad or LandingPad()
    for name, side in (("length", pad.length), ("width", pad.width)):
        require_range(f"pad {name}", side, low=0.1, high=100.0)
    plan = tomllib.loads(PLAN.read_text(encoding="utf-8"))
    panel = next(part for part in plan["panel"] if part["label"] == "pad")
    seam = panel["paint"][0]
    length, width = 1000.0 * pad.length, 1000.0 * pad.width
    wide, step = 1000.0 * seam["size"][0], 1000.0 * seam["every"][0]
    starts = 1000.0 * seam["at"][0] + step * np.arange(math.ceil(length / step))
    starts = starts[starts + wide < length]
    seams = np.stack([starts, 0.0 * starts, 0.0 * starts + wide, 0.0 * starts + width], axis=1)
    blue, dark = (tuple(plan["palette"][name]["rgb"]) for name in (panel["colour"], seam["colour"]))
    boxes = [(np.array([[0.0, 0.0, length, width]]), blue)]
    if len(seams):
        boxes.append((seams, dark))
    code = "#" + "".join(f"{round(255.0 * part):02x}" for part in blue)
    return Poster(
        "pad", length, width, tuple(boxes),
        (
            f"Landing pad {pad.length:g} x {pad.width:g} m, blue {code}, seams at {step:.0f} mm.",
            "It takes much ink: blue foil or cloth of this colour and size does the same.",
            f"Its top is {pad.height:g} m above the floor in the simulator; lay it on mats.",
        ),
    )  # fmt: skip


def checkerboard_poster(corners: tuple[int, int], paper: Paper, square: float = 0.0) -> Poster:
    """A checkerboard for one page, whose margins are its white border; tiles would not be flat.

    Args:
        corners: inner corners in a row, and rows, as `falconwing bench --checkerboard` has them.
        paper: on which it must fit.
        square: side of a square [mm]; 0 for the largest whole number that fits.

    Raises:
        InputError: it does not fit, or both numbers of corners are even or odd.
    """
    columns, rows = corners
    for name, number in (("in a row", columns), ("rows", rows)):
        require_range(f"checkerboard corners {name}", number, low=3, high=40)
    if (columns - rows) % 2 == 0:
        raise InputError(
            f"checkerboard: expected one even and one odd number of inner corners, got {columns} x"
            f" {rows}, which looks the same upside down; take 9x6"
        )
    short, long = (side - 2.0 * MARGIN_MM for side in PAPERS[paper])
    across = (long, short) if columns > rows else (short, long)
    largest = min(across[0] / (columns + 1), across[1] / (rows + 1))
    side = square or float(math.floor(largest))
    if not 1.0 <= side <= largest:
        raise InputError(
            f"checkerboard: expected squares of 1 to {largest:.1f} mm on one page of {paper}, got"
            f" {square or largest:g} mm; take larger paper or fewer corners"
        )
    boxes = [
        (side * column, side * row, side, side)
        for row in range(rows + 1)
        for column in range(columns + 1)
        if (row + column) % 2 == 0
    ]
    return Poster(
        "checkerboard", side * (columns + 1), side * (rows + 1), ((np.array(boxes), BLACK),),
        (
            f"Checkerboard of {columns} x {rows} inner corners, squares of {side:g} mm, for"
            f" falconwing bench --checkerboard {columns}x{rows}.",
            "Glue it on something flat and stiff; leave the white around it.",
        ),
    )  # fmt: skip


def lay_out(poster: Poster, paper: Paper) -> Layout:
    """Cut a poster into the fewest pages, upright or lying; the poster is centred on them.

    Raises:
        InputError: it takes more than MAX_PAGES pages.
    """
    choices = [_cut(poster, paper, size) for size in (PAPERS[paper], PAPERS[paper][::-1])]
    counts = [rows * columns for rows, columns, _ in choices]
    rows, columns, size = choices[int(np.argmin(counts))]
    if rows * columns > MAX_PAGES:
        raise InputError(
            f"print {poster.name}: expected at most {MAX_PAGES} pages, got {rows * columns} of"
            f" {paper}; take larger paper or a smaller size"
        )
    window = np.array(size) - 2.0 * MARGIN_MM
    step = window - OVERLAP_MM
    covered = step * (columns, rows) + OVERLAP_MM
    left, bottom = 0.5 * (np.array([poster.width, poster.height]) - covered)
    pages = tuple(
        Page(
            row, column, left + step[0] * (column - 1), bottom + step[1] * (rows - row),
            column < columns, row < rows,
        )
        for row in range(1, rows + 1)
        for column in range(1, columns + 1)
    )  # fmt: skip
    return Layout(paper, size[0], size[1], rows, columns, pages)


def _cut(
    poster: Poster, paper: Paper, size: tuple[float, float]
) -> tuple[int, int, tuple[float, float]]:
    """Rows and columns of pages of this size."""
    counts = []
    for total, side in ((poster.height, size[1]), (poster.width, size[0])):
        window = side - 2.0 * MARGIN_MM
        counts.append(max(1, math.ceil((total - OVERLAP_MM) / (window - OVERLAP_MM) - 1e-9)))
    return counts[0], counts[1], size


def page_boxes(poster: Poster, layout: Layout, page: Page) -> list[tuple[Array, Colour]]:
    """What a page shows of the poster: (N, 4) x, y, width, height on the page, and their colour."""
    width, height = layout.window
    low = np.array([page.x, page.y])
    high = np.array([page.x + width, page.y + height])
    shown = []
    for boxes, colour in poster.boxes:
        begin = np.maximum(boxes[:, :2], low)
        end = np.minimum(boxes[:, :2] + boxes[:, 2:], high)
        inside = (end > begin).all(axis=1)
        if inside.any():
            cut = np.concatenate([begin - low + MARGIN_MM, end - begin], axis=1)[inside]
            shown.append((cut, colour))
    return shown


def print_scale_fault(measured_mm: float) -> str:
    """What is wrong with a measured check line; empty if it has its length.

    Args:
        measured_mm: of the line of CHECK_MM on any printed page.

    Raises:
        InputError: it is no length.
    """
    require_range("print check length", measured_mm, low=1.0, high=1000.0)
    if abs(measured_mm - CHECK_MM) <= CHECK_TOLERANCE_MM + 1e-9:
        return ""
    per_cent = 100.0 * (measured_mm / CHECK_MM - 1.0)
    return (
        f"print check length: expected {CHECK_MM:g} mm within {CHECK_TOLERANCE_MM:g}, got"
        f" {measured_mm:g} of {CHECK_MM:g} mm, a scale error of {per_cent:+.1f} %, and every"
        " distance to the marker is wrong by as much; print again at 100 %, without fit to page"
    )
