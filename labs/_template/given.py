"""Lab 0, given code: the course's numbers and the colours of the figure."""

import json
from pathlib import Path

COHORT: dict[str, float] = json.loads(
    (Path(__file__).parent / "cohort.json").read_text(encoding="utf-8")
)

BLUE, ORANGE = "#0072B2", "#D55E00"  # distinguishable for colour-blind readers (Okabe and Ito)
