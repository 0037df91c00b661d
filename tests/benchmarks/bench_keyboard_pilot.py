"""A person at the keyboard, scripted: how many of 40 landings succeed, with the beginner's assist
and without.

    python -m pytest -m benchmark tests/benchmarks/bench_keyboard_pilot.py

The pilot (keyboard_pilot.py) reacts 250 ms late with at most four key changes a second. It was
tuned on seeds below 10,000; these are the first of the frozen list. SIMULATED, without a browser.
"""

import numpy as np
import pytest

from falconwing_kit.flight.trial import trial_seed
from falconwing_kit.tools.trials.statistics import clopper_pearson_interval
from tests.benchmarks.keyboard_pilot import land_by_keys

pytestmark = pytest.mark.benchmark
FLIGHTS = 40
GOALS = {"with the beginner's assist": (True, 0.8), "without": (False, 0.4)}


def test_landings_by_keys(capsys):
    """Prints the table; the goals are 4 of 5 with the assist and 2 of 5 without."""
    lines = [
        "| keyboard pilot | landed | 95 % interval | ALD median [cm] | sink rate median [m/s] |"
        " key changes a second |",
        "|---|---|---|---|---|---|",
    ]
    shares = {}
    for name, (assist, _) in GOALS.items():
        found = [land_by_keys(trial_seed(k), assist) for k in range(FLIGHTS)]
        landed = [each for each in found if each["success"]]
        shares[name] = len(landed) / FLIGHTS
        low, high = clopper_pearson_interval(len(landed), FLIGHTS)
        ald, sink = (
            np.median([each[key] for each in landed]) for key in ("ald_m", "sink_rate_m_s")
        )
        rate = np.mean([each["key_changes"] / each["seconds"] for each in found])
        lines.append(
            f"| {name} | {len(landed)} of {FLIGHTS} | {100 * low:.0f} to {100 * high:.0f} % |"
            f" {100 * ald:.0f} | {sink:.2f} | {rate:.1f} |"
        )
    with capsys.disabled():
        print("\n\n" + "\n".join(lines))
    for name, (_, goal) in GOALS.items():
        assert shares[name] >= goal
