"""Results on the terminal: numbers and texts -> aligned tables, JSON and the closing line."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from numbers import Real
from typing import Any


def print_table(
    headers: Sequence[str], rows: Sequence[Sequence[object]], *, title: str = ""
) -> None:
    """Print rows under their headers: numbers right-aligned, text left-aligned.

    Args:
        headers: one per column, with its unit, such as "speed [m/s]".
        rows: each as long as the headers. Floats have four significant digits, None and nan are
            "-".
        title: a line above the table; empty for none.

    Raises:
        ValueError: a row is not as long as the headers.
    """
    columns = list(zip(headers, *rows, strict=True))
    texts = []
    for header, *cells in columns:
        words = [header, *(cell_text(cell) for cell in cells)]
        width = max(len(word) for word in words)
        is_number = bool(cells) and all(cell is None or isinstance(cell, Real) for cell in cells)
        texts.append([word.rjust(width) if is_number else word.ljust(width) for word in words])
    lines = ["  ".join(line).rstrip() for line in zip(*texts, strict=True)]
    rule = "  ".join("-" * len(column[0]) for column in texts)
    print("\n".join([*([title] if title else []), lines[0], rule, *lines[1:]]))


def cell_text(value: object) -> str:
    """One cell as text: four significant digits, "-" for None and nan."""
    if hasattr(value, "item"):
        value = value.item()  # NumPy's scalars, without importing NumPy
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or (isinstance(value, Real) and math.isnan(value)):
        return "-"
    if isinstance(value, Real) and not isinstance(value, int):
        return f"{float(value):.4g}"
    return str(value)


def print_json(record: Mapping[str, object]) -> None:
    """Print a record as standard JSON; nan and infinity become null."""
    print(json.dumps(_plain(record), indent=2, allow_nan=False))


def json_line(record: Mapping[str, object]) -> str:
    """A record as one line of standard JSON; nan and infinity become null."""
    return json.dumps(_plain(record), allow_nan=False)


def json_fields(record: Any) -> dict[str, object]:
    """Fields of a dataclass for JSON; `advice` keeps the key "mend" of the kit's first version."""
    return {"mend" if name == "advice" else name: value for name, value in asdict(record).items()}


def next_line(text: str) -> None:
    """Print the last line of a verb's output: the command or step to take next."""
    print(f"next: {text}")


def _plain(value: object) -> object:
    """The value in JSON's types."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy arrays and scalars, without importing NumPy
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)
