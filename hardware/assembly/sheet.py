"""Sheet: an image of a drawing -> the same with arrows, lengths and callouts, as a small PNG."""

import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from projection import DARK, NEW, SEE_THROUGH, SMOOTH, Mesh

ARROW = (20, 70, 150)
TEXT_PX = 30


def letters() -> Any:
    """The labels' font, oversampled."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    path = Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(path), SMOOTH * TEXT_PX)


def label_width(text: str) -> int:
    """Room that a label beside the drawing takes, with its box and a gap [px]."""
    return round(letters().getlength(text) / SMOOTH) + 40


class Sheet:
    """An image being labelled; coordinates are oversampled pixels."""

    def __init__(self, image: Mesh) -> None:
        from PIL import Image, ImageDraw

        self.image = Image.fromarray(np.clip(image, 0.0, 255.0).round().astype(np.uint8))
        self.pen = ImageDraw.Draw(self.image)
        self.font = letters()

    def text_box(self, middle: Sequence[float], text: str, colour: tuple[int, ...] = DARK) -> Any:
        """Words on white, centred or as near to it as the image's sides allow; their box."""
        wide = self.pen.textlength(text, font=self.font)
        half = (wide / 2.0 + 5 * SMOOTH, 0.68 * SMOOTH * TEXT_PX)
        x = min(max(float(middle[0]), half[0] + SMOOTH), self.image.width - half[0] - SMOOTH)
        middle = (x, float(middle[1]))
        box = (
            middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1]
        )  # fmt: skip
        self.pen.rounded_rectangle(
            box, 6 * SMOOTH, fill=(255, 255, 255), outline=colour, width=SMOOTH
        )
        self.pen.text(middle, text, fill=colour, font=self.font, anchor="mm")
        return box

    def pointer(self, begin: Mesh, end: Mesh) -> None:
        """A thin line from words to what they mean, with a dot at its end."""
        self.pen.line([tuple(begin), tuple(end)], fill=DARK, width=2 * SMOOTH)
        dot = 4 * SMOOTH
        box = (end[0] - dot, end[1] - dot, end[0] + dot, end[1] + dot)
        self.pen.ellipse(box, fill=DARK)

    def arrow(self, begin: Mesh, end: Mesh, both: bool = False) -> None:
        """A thick arrow, white around it; with two heads for a length."""
        along = end - begin
        length = float(np.hypot(*along))
        if length < 8 * SMOOTH:
            return
        along = along / length
        across = np.array([-along[1], along[0]])
        head = min((16 if not both else 11) * SMOOTH, 0.45 * length)
        heads = [(end, along)] + ([(begin, -along)] if both else [])
        first = begin + along * head * 0.8 if both else begin
        width = 6 if not both else 2
        for extra, colour in ((4, (255, 255, 255)), (0, ARROW)):
            line = [tuple(first), tuple(end - along * head * 0.8)]
            self.pen.line(line, fill=colour, width=(width + extra) * SMOOTH)
            for tip, way in heads:
                grow = extra * 0.7 * SMOOTH
                base = tip - way * head
                wing = across * (0.55 * head + grow)
                corners = [tip + way * grow, base + wing - way * grow, base - wing - way * grow]
                self.pen.polygon([tuple(corner) for corner in corners], fill=colour)

    def callouts(
        self, anchors: Iterable[tuple[str, Mesh]], left_side: dict[str, bool] | None = None
    ) -> None:
        """Labels in two columns beside the drawing, with lines to their parts.

        Args:
            anchors: label and seen pixel of each part.
            left_side: whether a label belongs into the left column; None shares them out.
        """
        wide, high = self.image.size
        placed = list(anchors)
        if left_side is None:
            sides = _sides(placed, wide)
        else:
            ordered = sorted(placed, key=lambda each: float(each[1][1]))
            sides = {
                left: [each for each in ordered if left_side[each[0]] == left]
                for left in (True, False)
            }
        step = 1.62 * SMOOTH * TEXT_PX
        for left, column in sides.items():
            group = _uncrossed(column, 0.0 if left else float(wide), step)
            rows = _spread([at[1] for _, at in group], step, 0.8 * step, high - 0.8 * step)
            for (text, at), row in zip(group, rows, strict=True):
                half = self.pen.textlength(text, font=self.font) / 2.0 + 9 * SMOOTH
                x = half if left else wide - half
                edge = 2.0 * half - 4 * SMOOTH if left else wide - 2.0 * half + 4 * SMOOTH
                self.pen.line([(edge, row), tuple(at)], fill=(255, 255, 255), width=4 * SMOOTH)
                self.pen.line([(edge, row), tuple(at)], fill=DARK, width=SMOOTH)
                dot = 4 * SMOOTH
                self.pen.ellipse((at[0] - dot, at[1] - dot, at[0] + dot, at[1] + dot), fill=DARK)
                self.text_box((x, row), text)

    def png(self) -> bytes:
        """The image at its final size, with a palette."""
        from PIL import Image

        size = (self.image.width // SMOOTH, self.image.height // SMOOTH)
        small = self.image.resize(size, Image.Resampling.BOX)
        small = small.quantize(palette=_palette(), dither=Image.Dither.NONE)
        content = io.BytesIO()
        small.save(content, format="PNG", optimize=True)
        return content.getvalue()


def _palette() -> Any:
    """Greys, and the two colours from dark over full to white, the same for every picture."""
    from PIL import Image

    shares = np.linspace(0.0, 1.0, 15)[1:-1]
    ends = np.array([0.0, 255.0])
    colours = [np.full(3, grey) for grey in np.linspace(0.0, 255.0, 38)]
    for full in (NEW, np.array(ARROW, dtype=float)):
        colours += [full, *(full + share * (end - full) for end in ends for share in shares)]
    veil = 255.0 + SEE_THROUGH * (NEW - 255.0)  # a coloured ghost
    colours += [veil + share * (240.0 - veil) for share in shares]
    image = Image.new("P", (1, 1))
    image.putpalette([round(value) for colour in colours for value in colour])
    return image


def _sides(placed: list[tuple[str, Mesh]], wide: int) -> dict[bool, list[tuple[str, Mesh]]]:
    """Labels of the left (True) and the right column, each from top to bottom, halves at most."""
    ordered = sorted(placed, key=lambda each: float(each[1][0]))
    count = sum(1 for _, at in ordered if at[0] < wide / 2.0)
    most = max(4, math.ceil(0.6 * len(ordered)))
    count = min(max(count, len(ordered) - most), most)
    groups = {True: ordered[:count], False: ordered[count:]}
    return {
        left: sorted(group, key=lambda each: float(each[1][1])) for left, group in groups.items()
    }


def _uncrossed(group: list[tuple[str, Mesh]], x: float, step: float) -> list[tuple[str, Mesh]]:
    """A column's labels in the order in which their lines to the column at x do not cross."""
    group = list(group)
    for _ in range(len(group)):
        for k in range(len(group) - 1):
            (_, a), (_, b) = group[k], group[k + 1]
            rows = [(a[1] + b[1]) / 2.0 - step / 2.0, (a[1] + b[1]) / 2.0 + step / 2.0]
            far = a if abs(a[0] - x) > abs(b[0] - x) else b
            near = b if far is a else a
            row = rows[0] if far is a else rows[1]
            share = (near[0] - x) / (far[0] - x) if far[0] != x else 0.0
            passes = row + share * (far[1] - row)  # of the longer line, above or below the nearer
            if (passes > near[1]) if far is a else (passes < near[1]):
                group[k], group[k + 1] = group[k + 1], group[k]
    return group


def _spread(rows: list[float], step: float, low: float, high: float) -> list[float]:
    """Rising rows at least a step apart, as near to the given ones as going down and up gives."""
    found = []
    for row in rows:
        found.append(max(row, low, found[-1] + step if found else low))
    for k in range(len(found) - 1, -1, -1):
        found[k] = min(found[k], found[k + 1] - step if k + 1 < len(found) else high)
    return found
