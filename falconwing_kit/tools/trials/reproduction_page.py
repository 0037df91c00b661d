"""Page of a reproduction: parts with their rows -> one HTML file and one JSON file."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import get_args

from falconwing_kit import __version__
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.reports.page import write_page
from falconwing_kit.tools.trials.evaluation import weights_digest
from falconwing_kit.tools.trials.reproduction import PARTS, Amount, Part, Verdict

PAGE = Path(__file__).with_name("reproduction.html.j2")


def count_verdicts(parts: Mapping[str, Part]) -> dict[str, int]:
    """How many rows have each verdict, all of them named."""
    counts = Counter(row.verdict for part in parts.values() for row in part.rows)
    return {verdict: counts[verdict] for verdict in get_args(Verdict)}


def write_reproduction(parts: Mapping[str, Part], amount: Amount, folder: Path) -> dict[str, Path]:
    """Write page and rows.

    Args:
        parts: by their names in PARTS.
        amount: how much was computed.
        folder: with the parts' figures.

    Returns:
        The files by page and rows.
    """
    files = {"page": folder / "index.html", "rows": folder / "reproduction.json"}
    counts = count_verdicts(parts)
    record = {
        "kit": __version__, "weights": weights_digest(), "amount": asdict(amount),
        "counts": counts, "parts": {name: asdict(part) for name, part in parts.items()},
    }  # fmt: skip
    with atomic_write(files["rows"], text=True) as file:
        file.write(json.dumps(record, indent=1, allow_nan=False) + "\n")
    missing = [name for name in PARTS if name not in parts]
    only = f" --only {','.join(parts)}" if missing else ""
    full = " --full" if amount.name == "full" else ""
    amounts = (
        f"{amount.landings} landings in each world, {amount.follows} flights behind each leader,"
        f" {amount.images} images"
    )
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    left_out = f" Left out: {', '.join(missing)}." if missing else ""
    write_page(
        files["page"], PAGE, lead=f"{amount.name.capitalize()} run: {amounts}. {left_out}".strip(),
        summary=f"Of {sum(counts.values())} numbers: {summary}.",
        parts=[
            {"title": PARTS[name][0], "rows": part.rows,
             "figures": [(folder / f.file, f.shows, f.caption) for f in part.figures]}
            for name, part in parts.items()
        ],
        version=__version__, weights=weights_digest(),
        command=f"falconwing reproduce{full}{only}",
    )  # fmt: skip
    return files
