"""The paper's figures for its two tables and its robustness figure, to stand beside ours.

Leader-following: Table I (30 unseen trials). Landing: Table II; the paper's mean of the real
flights counts two failed ones as 0 cm, so the mean over its eight landings stands here.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperFigure:
    """One row of a table of the paper."""

    successes: float  # share, 0..1
    trials: int | None
    error_cm: float  # ALD of landings, or ATE
    runtime_ms: float | None  # of one step, on an RTX 4090
    note: str = ""


# (task, table's row, pilot) -> figure
PAPER: dict[tuple[str, str, str], PaperFigure] = {
    ("follow", "training", "expert"): PaperFigure(1.0, None, 72.0, 0.0),
    ("follow", "training", "rgb"): PaperFigure(1.0, None, 78.0, 20.0),
    ("follow", "training", "mask"): PaperFigure(1.0, None, 91.0, 80.0),
    ("follow", "training", "rgb_mask"): PaperFigure(1.0, None, 73.0, 130.0),
    ("follow", "unseen", "expert"): PaperFigure(1.0, 30, 79.0, 0.0),
    ("follow", "unseen", "rgb"): PaperFigure(0.3, 30, 102.0, 20.0),
    ("follow", "unseen", "mask"): PaperFigure(0.9, 30, 139.0, 80.0),
    ("follow", "unseen", "rgb_mask"): PaperFigure(1.0, 30, 94.0, 130.0),
    ("landing", "paper", "expert"): PaperFigure(1.0, 10, 15.3, None),
    ("landing", "paper", "rgb"): PaperFigure(1.0, 10, 36.9, None),
    ("landing", "reality", "rgb"): PaperFigure(0.8, 10, 51.0, None, "real flights"),
}
# Of its robustness figure (RGB+Mask, 10 runs a level) the text gives words only.
ROBUSTNESS = {
    "scale": "reliable from 0.5 to 2, worse only at 0.5",
    "salt and pepper": "robust up to 30 %",
}
# Where a sweep has a number of the paper: group, task, pilot -> level, success share, trials
DOTS = {
    ("scale", "follow", "rgb_mask"): (1.0, 1.0, 30),
    ("salt and pepper", "follow", "rgb_mask"): (0.0, 1.0, 30),
}
