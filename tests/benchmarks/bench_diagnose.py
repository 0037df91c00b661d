"""Diagnosis of a long table: processor time of ten minutes at 20 Hz.

python -m pytest -m benchmark tests/benchmarks/bench_diagnose.py
"""

from time import process_time

import numpy as np
import pytest

from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.data import data_path
from falconwing_kit.sysid.diagnose import diagnose_table

pytestmark = pytest.mark.benchmark


def test_ten_minutes_cost_a_fifth_of_a_second():
    """12,000 rows: the two calm flights five times over; best of three, processor time."""
    table = read_flight_table(data_path("case02_calm.csv"))
    n, copies = len(table.t), 5
    t = np.concatenate([table.t - table.t[0] + i * 120.05 for i in range(copies)])
    many = FlightTable("long.csv", t, *(
        np.concatenate([values] * copies)
        for values in (table.p_world, table.attitude, table.commands)
    ))  # fmt: skip
    assert len(many.t) == copies * n >= 11_000
    seconds = []
    for _ in range(3):
        began = process_time()
        diagnose_table(many)
        seconds.append(process_time() - began)
    assert min(seconds) < 0.2
