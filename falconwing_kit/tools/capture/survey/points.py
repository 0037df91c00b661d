"""Survey files: CSV of measured points -> world points; CSV of clicks -> pixel observations."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import short_name
from falconwing_kit.tools.capture.photo_files import Reconstruction

Numbers = NDArray[np.int64]

SURVEY_COLUMNS, CLICK_COLUMNS = ("name", "x", "y", "z", "use"), ("name", "photo", "u", "v")
USES = ("align", "check")
MARKER_CORNERS = tuple(
    f"marker_corner_{corner}" for corner in ("top_left", "top_right", "bottom_right", "bottom_left")
)


@dataclass(frozen=True, eq=False)
class Survey:
    """Points measured by tape, in the kit's world."""

    names: tuple[str, ...]  # (N,)
    p_world: Array  # (N, 3) [m]
    uses: tuple[str, ...]  # (N,) "align": for the alignment; "check": for its evaluation only

    def select(self, use: str) -> "Survey":
        """The points of one use."""
        keep = [k for k, other in enumerate(self.uses) if other == use]
        return Survey(
            tuple(self.names[k] for k in keep),
            self.p_world[keep],
            tuple(self.uses[k] for k in keep),
        )

    def places(self, names: Iterable[str]) -> Array:
        """(K, 3) places of named points [m]."""
        return self.p_world[[self.names.index(name) for name in names]]

    def faces(self) -> list[tuple[str, ...]]:
        """Groups of four points with a common name prefix on a flat face, in order around it.

        The name's last two words are the corner (near_left, top_right ...), the words before them
        the face. The corner of a box may have one more word, as in pad_near_left_top; then its
        first word is the face. The marker's corners are excluded, since they are detected
        otherwise.
        """
        groups: dict[str, list[int]] = {}
        for number, name in enumerate(self.names):
            words = name.split("_")
            face = words[0] if words[1:2] in (["near"], ["far"]) else "_".join(words[:-2])
            if name not in MARKER_CORNERS:
                groups.setdefault(face, []).append(number)
        ordered = (_around(self.p_world[group]) for group in groups.values())
        return [
            tuple(self.names[group[k]] for k in order)
            for group, order in zip(groups.values(), ordered, strict=True)
            if order is not None
        ]


@dataclass(frozen=True, eq=False)
class PointObservations:
    """Pixels at which photos show points."""

    names: tuple[str, ...]  # (K,) which point
    photos: Numbers  # (K,) number of the photo
    pixels: Array  # (K, 2) u, v [px], the first pixel's centre at (0.5, 0.5)

    def __len__(self) -> int:
        return len(self.names)

    def __add__(self, other: "PointObservations") -> "PointObservations":
        return PointObservations(
            self.names + other.names,
            np.concatenate([self.photos, other.photos]),
            np.concatenate([self.pixels, other.pixels]),
        )

    @classmethod
    def join(cls, rows: Sequence[tuple[str, int, Sequence[float]]]) -> "PointObservations":
        """Observations from rows of name, photo number and pixel."""
        names, photos, pixels = zip(*rows, strict=True) if rows else ((), (), ())
        return cls(
            tuple(names), np.array(photos, np.int64), np.array(pixels, np.float64).reshape(-1, 2)
        )

    def of(self, name: str) -> tuple[Numbers, Array]:
        """Photo numbers and pixels (K, 2) of one point."""
        keep = np.array([other == name for other in self.names], bool)
        return self.photos[keep], self.pixels[keep]


def read_survey(path: str | Path) -> Survey:
    """Read a CSV with the columns name, x, y, z, use.

    Args:
        path: places in metres in the kit's world; use is align or check.

    Raises:
        FileNotFoundError: there is no file.
        InputError: a column is missing, a number is not finite, a use is unknown, or a name occurs
            twice.
    """
    rows = _read_rows(path, SURVEY_COLUMNS)
    names = tuple(row[0] for _, row in rows)
    for line, row in rows:
        if row[4] not in USES:
            raise InputError(
                f"{short_name(path)}, line {line}: expected use align or check, got {row[4][:40]!r}"
            )
    if len(set(names)) < len(names) or not names:
        raise InputError(
            f"{short_name(path)}: expected at least one point and each name once, "
            "got none or a name twice"
        )
    places = np.array([_numbers(path, line, row[1:4]) for line, row in rows])
    return Survey(names, places, tuple(row[4] for _, row in rows))


def read_clicks(
    path: str | Path, reconstruction: Reconstruction, survey: Survey
) -> PointObservations:
    """Read a CSV with the columns name, photo, u, v: manual clicks on surveyed points.

    Args:
        path: u to the right and v down from the image's upper left corner [px].
        reconstruction: of the photos; clicks in photos without a pose are ignored.
        survey: of the points.

    Raises:
        FileNotFoundError: there is no file.
        InputError: a column is missing, a number is wrong, or the survey has no such point.
    """
    number_of = {name: number for number, name in enumerate(reconstruction.names)}
    observations = []
    for line, (name, photo, *uv) in _read_rows(path, CLICK_COLUMNS):
        if name not in survey.names:
            raise InputError(
                f"{short_name(path)}, line {line}: expected a point of the survey, "
                f"got {name[:60]!r}"
            )
        pixel = _numbers(path, line, uv)
        if photo in number_of:
            observations.append((name, number_of[photo], pixel))
    return PointObservations.join(observations)


def _read_rows(path: str | Path, columns: tuple[str, ...]) -> list[tuple[int, list[str]]]:
    """Line number and stripped words of every row, in the order of the columns."""
    name = short_name(path)
    try:
        lines = require_file(path).read_text(encoding="utf-8-sig").splitlines()
        table = [
            (reader.line_num, row) for reader in [csv.reader(lines)] for row in reader if any(row)
        ]
    except (UnicodeDecodeError, csv.Error):
        raise InputError(
            f"{name}: expected a CSV file in UTF-8, got other bytes; save it as CSV"
        ) from None
    header = [word.strip() for word in table[0][1]] if table else []
    missing = [column for column in columns if column not in header]
    if missing:
        raise InputError(
            f"{name}: expected the columns {','.join(columns)} in the first line, "
            f"{missing[0]} is missing"
        )
    for line, row in table[1:]:
        if len(row) != len(header):
            raise InputError(
                f"{name}, line {line}: expected {len(header)} values as in the first line, "
                f"got {len(row)}"
            )
    return [
        (line, [row[header.index(column)].strip() for column in columns]) for line, row in table[1:]
    ]


def _numbers(path: str | Path, line: int, words: Sequence[str]) -> list[float]:
    """Finite numbers."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [np.nan]
    if not np.isfinite(numbers).all():
        raise InputError(
            f"{short_name(path)}, line {line}: expected finite numbers, "
            f"got {', '.join(words)[:60]!r}"
        )
    return numbers


def _around(corners: Array, tolerance: float = 0.05) -> list[int] | None:
    """The order of four points around a flat convex face; None if they do not span one."""
    if len(corners) != 4:
        return None
    from_centre = corners - corners.mean(axis=0)
    _, sizes, axes = np.linalg.svd(from_centre)
    if sizes[2] > tolerance or sizes[1] < 2 * tolerance:
        return None
    return [int(k) for k in np.argsort(np.arctan2(from_centre @ axes[1], from_centre @ axes[0]))]
