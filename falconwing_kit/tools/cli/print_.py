"""falconwing print: write marker, landing pad or checkerboard as a true-size PDF in pages."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.tools.hardware.prints import Poster

MM = (10.0, 10_000.0)  # sides of marker and pad


@dataclass(frozen=True)
class Print:
    """Write a PDF at true size, cut into pages that overlap, with check lines on every page.

    Print it at 100 %, measure a check line of 100 mm and type its length into falconwing doctor
    --bench. The marker has the size and number of the simulated hall.
    """

    what: Annotated[Literal["marker", "pad", "checkerboard"], tyro.conf.Positional]
    """what to print"""
    paper: Literal["A4", "A3", "A2", "Letter"] = "A4"
    """paper size"""
    size_mm: float | None = None
    """side of the marker's black square; the hall's, 800 mm, if not given"""
    id: int | None = None
    """number of the marker; the hall's if not given"""
    length_mm: float | None = None
    """length of the pad, if not the hall's 13 m"""
    width_mm: float | None = None
    """width of the pad, if not the hall's 2 m"""
    checkerboard: str = "9x6"
    """its inner corners: in a row, and rows; as for falconwing bench"""
    square_mm: float | None = None
    """side of its squares; the largest that fits on the page if not given"""
    out: Path = Path("print")
    """folder for the PDF"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Write the file.

        Returns:
            0: it is written.

        Raises:
            InputError: an option is wrong or is of another print, or it does not fit.
        """
        from falconwing_kit.tools.hardware.print_pdf import write_print
        from falconwing_kit.tools.hardware.prints import lay_out

        self._check()
        poster = self._poster()
        layout = lay_out(poster, self.paper)
        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / f"{self.what}_{self.paper}.pdf"
        pages = write_print(poster, layout, path)
        record = {
            "file": str(path), "pages": pages, "rows": layout.rows, "columns": layout.columns,
            "paper": self.paper, "width_mm": poster.width, "height_mm": poster.height,
            "notes": list(poster.notes),
        }  # fmt: skip
        if self.json:
            print_json(record)
            return 0
        print_table(
            ("print", "size [mm]", "paper", "pages", "rows x columns", "file"),
            [(
                self.what, f"{poster.width:.1f} x {poster.height:.1f}", self.paper, pages,
                f"{layout.rows} x {layout.columns}", str(path),
            )],
        )  # fmt: skip
        print("\n" + "\n".join(poster.notes))
        next_line("print at 100 %, measure a check line of 100 mm, then falconwing doctor --bench")
        return 0

    def _check(self) -> None:
        """Refuse options of another print, and lengths out of range."""
        own = {
            "marker": ("size_mm", "id"), "pad": ("length_mm", "width_mm"),
            "checkerboard": ("square_mm",),
        }  # fmt: skip
        for what, names in own.items():
            for name in names:
                value, option = getattr(self, name), "--" + name.replace("_", "-")
                if value is not None and what != self.what:
                    raise InputError(
                        f"{option}: expected it with `print {what}`, got it with `print"
                        f" {self.what}`; leave it out"
                    )
                if value is not None and name in ("size_mm", "length_mm", "width_mm"):
                    require_range(option, value, low=MM[0], high=10.0 * MM[1])
        if self.square_mm is not None:
            require_range("--square-mm", self.square_mm, low=1.0, high=500.0)

    def _poster(self) -> "Poster":
        from falconwing_kit.aircraft.touchdown import LandingPad
        from falconwing_kit.tools.hardware.prints import (
            checkerboard_poster,
            marker_poster,
            pad_poster,
        )
        from falconwing_kit.vision.marker import Marker

        if self.what == "marker":
            marker = Marker()
            number = marker.id if self.id is None else self.id
            size = marker.size if self.size_mm is None else self.size_mm / 1000.0
            return marker_poster(replace(marker, id=number, size=size))
        if self.what == "pad":
            pad = LandingPad()
            length = pad.length if self.length_mm is None else self.length_mm / 1000.0
            width = pad.width if self.width_mm is None else self.width_mm / 1000.0
            return pad_poster(replace(pad, length=length, width=width))
        return checkerboard_poster(self._corners(), self.paper, self.square_mm or 0.0)

    def _corners(self) -> tuple[int, int]:
        """Inner corners in a row, and rows."""
        words = self.checkerboard.split("x")
        if len(words) != 2 or not all(word.isdigit() for word in words):
            raise InputError(
                f"--checkerboard: expected its inner corners such as 9x6, got {self.checkerboard!r}"
            )
        return int(words[0]), int(words[1])
