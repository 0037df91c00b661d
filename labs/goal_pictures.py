"""Goal pictures: outputs of the solved notebooks -> `goal.webp` in each lab, shown at its top.

falconwing labs selftest --outputs build/lab_outputs
python labs/goal_pictures.py build/lab_outputs
"""

import base64
import io
import json
import sys
from pathlib import Path

from falconwing_kit.tools.grading.find import lab_folders
from falconwing_kit.tools.grading.notebooks import GOAL, read_cells

FIGURES = {  # the figure that a lab leads to
    "lab01": "radius",
    "lab02": "axes",
    "lab03": "render",
    "lab04": "turn",
    "lab05": "real",
    "lab06": "hall",
    "lab07": "circuit",
    "lab08": "drift",
    "lab09": "window",
    "lab10": "takeover",
    "lab11": "landings",
    "lab12": "real",  # the figure before it names what is hidden
    "lab13": "film",
}
WHOLE = (0.0, 0.0, 1.0, 1.0)  # left, top, right, bottom
PARTS = {"lab11": (0.0, 0.6, 0.72, 1.0)}  # the rest answers a question
WIDEST = 900  # [px]
LARGEST = 60_000  # [bytes]


def goal_picture(png: bytes, part: tuple[float, ...]) -> bytes:
    """A part of a figure as WebP of at most WIDEST pixels and LARGEST bytes."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB")
    (width, height), (left, top, right, bottom) = picture.size, part
    picture = picture.crop(
        (int(left * width), int(top * height), int(right * width), int(bottom * height))
    )
    picture.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
    for quality in (90, 80, 70, 60, 50, 40):
        buffer = io.BytesIO()
        picture.save(buffer, "WEBP", quality=quality, method=6)
        if buffer.tell() <= LARGEST:
            break
    return buffer.getvalue()


def write_goals(outputs: Path, labs: Path) -> list[Path]:
    """Write the picture of every lab that has outputs, and say how large it is.

    Args:
        outputs: as `falconwing labs selftest --outputs` wrote them.
        labs: the folder of the labs.
    """
    written = []
    for folder in lab_folders(labs):
        file = outputs / f"{folder.name}.json"
        name = FIGURES[folder.name[:5]]
        if not file.is_file():
            continue
        shown = json.loads(file.read_text(encoding="utf-8"))
        cell = next(
            each
            for each in read_cells(folder / "lab.py")
            if (each.kind, each.name) == ("figure", name)
        )
        pngs = [
            each["data"]["image/png"]
            for each in shown.get(cell.for_solution(), ())
            if "image/png" in each.get("data", {})
        ]
        if not pngs:
            print(f"{file}: figure {name} is not in it; run labs selftest --outputs again")
            continue
        target = folder / GOAL
        target.write_bytes(
            goal_picture(base64.b64decode(pngs[-1]), PARTS.get(folder.name[:5], WHOLE))
        )
        print(f"{target}: figure {name}, {target.stat().st_size / 1e3:.0f} kB")
        written.append(target)
    return written


if __name__ == "__main__":
    write_goals(Path(sys.argv[1]), Path(__file__).parent)
