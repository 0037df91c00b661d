"""Make lab 12's practice flights again: data/calm.csv and data/flight.csv, simulated by the kit.

    python labs/lab12_gap/make_data.py

The hidden effect is defined in hidden.py, and given at the end of the solution.
"""

from pathlib import Path

from hidden import handout

from falconwing_kit.tools.grading import Course


def main() -> None:
    """Write both flights of the open course."""
    folder = Path(__file__).parent / "data"
    folder.mkdir(exist_ok=True)
    handout(Course({}), folder)


if __name__ == "__main__":
    main()
