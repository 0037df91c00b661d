"""Ten flights of an independent simulator (JSBSim): two ship with the kit, others may be in the
checkout.
"""

from pathlib import Path

import pytest

from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.data import data_path, shipped_names

FOLDER = Path(__file__).resolve().parents[3] / "shared/data/flights"
CASES = tuple(f"case{number:02d}" for number in range(10))


def calm_flight(case: str) -> FlightTable:
    """The baseline flight of a case; the test is skipped where it is missing."""
    shipped = f"{case}_calm.csv"
    if shipped in shipped_names():
        return read_flight_table(data_path(shipped))
    path = FOLDER / case / "calm.csv"
    if not path.is_file():
        pytest.skip(
            f"{case} does not ship with the kit and is not beside this checkout: {path} is missing"
        )
    return read_flight_table(path)
