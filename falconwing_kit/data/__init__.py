"""Shipped data: the name of a recorded or simulated flight -> its file or its table. README.md says
where each comes from.
"""

from pathlib import Path

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable, read_flight_table

__all__ = ["data_path", "load_flight", "shipped_names"]

_FOLDER = Path(__file__).parent
_SUFFIXES = (".csv", ".toml", ".txt")


def shipped_names() -> tuple[str, ...]:
    """Names of all files that ship, sorted."""
    return tuple(sorted(path.name for path in _FOLDER.iterdir() if path.suffix in _SUFFIXES))


def data_path(name: str) -> Path:
    """Where a shipped file lies.

    Args:
        name: its name with the ending, "alfa_engine_failure.csv".

    Returns:
        The path of an existing file.

    Raises:
        InputError: nothing of that name ships; the text lists what does.
    """
    if name not in shipped_names():
        raise InputError(f"data: expected one of {', '.join(shipped_names())}, got {name!r}")
    return _FOLDER / name


def load_flight(name: str) -> FlightTable:
    """A shipped flight.

    Args:
        name: its name without the ending: "sport_cub" or "alfa_engine_failure" (recorded),
            "case08_flight" (simulated).

    Raises:
        InputError: no flight of that name ships; the text lists what does.
    """
    flights = [path.removesuffix(".csv") for path in shipped_names() if path.endswith(".csv")]
    if name not in flights:
        raise InputError(f"flight: expected one of {', '.join(flights)}, got {name!r}")
    return read_flight_table(_FOLDER / f"{name}.csv")
