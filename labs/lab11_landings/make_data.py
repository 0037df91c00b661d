"""Write the data of lab 11: the paper's table of landings, and 100 simulated ones of the expert.

    python labs/lab11_landings/make_data.py

takes about a minute and needs the kit.
"""

import csv
from pathlib import Path

from falconwing_kit.core import atomic_write
from falconwing_kit.flight import LandingTask
from falconwing_kit.tools.trials import fly_trials

DATA = Path(__file__).parent / "data"
HEADER = ("run", "sim_expert_cm", "sim_vision_cm", "real_vision_cm")
# "Controller Performance for Landing Case Study"; None: not landed on the pad, so no deviation
PAPER = (
    (1, 42, 54, 35),
    (2, 1, 4, 45),
    (3, 14, 38, None),
    (4, 1, 12, 40),
    (5, 27, 32, 40),
    (6, 37, 74, 70),
    (7, 13, 21, 20),
    (8, 14, 79, 80),
    (9, 2, 32, 78),
    (10, 2, 23, None),
)
SIMULATED = 100  # landings of the kit's expert, in the frozen order of its trials


def main() -> None:
    """Write both tables."""
    write(
        "landings.csv", HEADER, [["" if value is None else value for value in row] for row in PAPER]
    )
    task = LandingTask()
    flown = fly_trials(task, task.expert, SIMULATED, pilot="expert")
    rows = [
        [
            record["trial"],
            int(record["success"]),
            "" if record["ald_m"] is None else f"{100 * record['ald_m']:.1f}",
        ]
        for record in flown
    ]
    write("kit_expert_simulated.csv", ("trial", "success", "ald_cm"), rows)


def write(name: str, header: tuple[str, ...], rows: list[list[object]]) -> None:
    """Write a table whole or not at all."""
    with atomic_write(DATA / name, text=True) as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(header)
        table.writerows(rows)


if __name__ == "__main__":
    main()
