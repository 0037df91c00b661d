"""Filled shapes of a PDF's pages, in millimetres: a reader of its own for the tests of prints.

Reads what a print needs of a page's content [ISO 32000-1, 8.5 and 8.6]: the matrix cm, paths of m,
l, h and re, filled by f in the grey or colour of g and rg. Anything painted in another way (a curve
with a fill, an image) is an error.
"""

import re
import zlib
from dataclasses import dataclass, field

import cv2
import numpy as np

MM = 25.4 / 72.0


@dataclass
class Sheet:
    """A page."""

    width: float
    height: float
    shapes: list = field(default_factory=list)  # (list of (N, 2) polygons [mm], rgb 0..1)
    lines: list = field(default_factory=list)  # (N, 2) polylines [mm]
    text: str = ""

    def picture(self, per_mm: int) -> np.ndarray:
        """(H, W) grey of the filled shapes, painted in their order; row 0 is the top."""
        image = np.full((round(self.height * per_mm), round(self.width * per_mm)), 255, np.uint8)
        for polygons, rgb in self.shapes:
            grey = float(255.0 * np.dot(rgb, (0.299, 0.587, 0.114)))
            flipped = [np.array([0.0, self.height]) + p * (1.0, -1.0) for p in polygons]
            # Coordinates are of pixel centres there, with 8 bits below the pixel.
            points = [np.round((p * per_mm - 0.5) * 256.0).astype(np.int32) for p in flipped]
            for polygon in points:  # neighbours share edges, so one after the other
                cv2.fillPoly(image, [polygon], grey, cv2.LINE_8, 8)
        return image


def read_sheets(data: bytes) -> list[Sheet]:
    """The pages of a PDF as matplotlib writes it: classic objects, deflated streams."""
    objects = {int(m[1]): m[2] for m in re.finditer(rb"(\d+) 0 obj\n?(.*?)endobj", data, re.DOTALL)}
    kids = next(o for o in objects.values() if b"/Type /Pages" in o)
    order = [int(k) for k in re.search(rb"/Kids \[([^\]]*)\]", kids)[1].split()[::3]]
    sheets = []
    for number in order:
        page = objects[number]
        box = [float(v) for v in re.search(rb"/MediaBox \[([^\]]*)\]", page)[1].split()]
        content = objects[int(re.search(rb"/Contents (\d+)", page)[1])]
        stream = re.search(rb"stream\r?\n(.*)\nendstream", content, re.DOTALL)[1]
        sheet = Sheet(box[2] * MM, box[3] * MM)
        _read(zlib.decompress(stream).decode("latin-1"), sheet)
        sheets.append(sheet)
    return sheets


def _read(content: str, sheet: Sheet) -> None:
    stack, saved, rgb, matrix = [], [], (0.0, 0.0, 0.0), np.eye(3)
    paths = []
    sheet.text = "".join(re.findall(r"\((.*?)\) Tj", content))
    content = re.sub(r"BT.*?ET", "", content, flags=re.DOTALL)
    for word in content.split():
        try:
            stack.append(float(word))
            continue
        except ValueError:
            pass
        if word in "ml":
            place = (np.array([*stack[-2:], 1.0]) @ matrix)[:2] * MM
            if word == "m":
                paths.append([])
            paths[-1].append(place)
        elif word == "re":
            x, y, w, h = stack[-4:]
            ring = [(x, y), (x + w, y), (x + w, y + h), (x, y + h)]
            paths.append([(np.array([*p, 1.0]) @ matrix)[:2] * MM for p in ring])
        elif word in ("rg", "g"):
            rgb = tuple(stack[-3:]) if word == "rg" else (stack[-1],) * 3
        elif word == "cm":
            a, b, c, d, e, f = stack[-6:]
            matrix = np.array([[a, b, 0.0], [c, d, 0.0], [e, f, 1.0]]) @ matrix
        elif word == "q":
            saved.append((rgb, matrix))
        elif word == "Q":
            rgb, matrix = saved.pop()
        elif word in ("f", "f*", "B"):
            sheet.shapes.append(([np.array(p) for p in paths], rgb))
            paths = []
        elif word == "S":
            sheet.lines += [np.array(p) for p in paths]
            paths = []
        elif word == "n":
            paths = []
        elif word in ("c", "v", "y", "sh", "BI"):
            raise AssertionError(f"{word}: not read here")
        stack = []
    assert not paths
