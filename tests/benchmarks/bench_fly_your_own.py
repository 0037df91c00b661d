"""Lab 13 with all parts of a student, with none, and with 50 random mixtures: does each fly?

    python -m tests.benchmarks.bench_fly_your_own --mixtures 50

The student's parts are the solutions of twelve labs, collected as a student's; in a mixture each
function is the kit's with probability 1/2. A flight counts if it lands on the pad, inside the
walls, with the board ACTIVE all the time. Without pictures; the film is lab 13's own notebook.
"""

import argparse
import tempfile
import time
from pathlib import Path

from falconwing_kit.tools.grading.find import importable_given, load_module
from falconwing_kit.tools.grading.mine import load_parts, write_package
from tests.labs.test_fly_your_own import (
    FOLDER,
    fly_with,
    mixture,
    require_landing,
    students_labs,
)


def main() -> None:
    """Fly, and print one line for each package and the count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mixtures", type=int, default=50)
    mixtures = parser.parse_args().mixtures
    given, landed = load_module(FOLDER, "given"), 0
    with tempfile.TemporaryDirectory() as temporary, importable_given(given):
        everything = Path(temporary) / "everything"
        write_package(students_labs(), everything, verify=False)
        packages = {"none of the student": load_parts("kit"), "all": load_parts(everything)}
        for number in range(mixtures + 2):
            if number < 2:
                name, parts = list(packages.items())[number]
            else:
                parts, choices = mixture(Path(temporary) / f"mixed{number}", 1000 + number)
                mine = sum(each.mine for each in choices)
                name = f"mixture {number - 1}: {mine} of {len(choices)}"
            start = time.perf_counter()
            flown = fly_with(given, parts, pictures=False)
            try:
                require_landing(given, *flown)
                landed, word = landed + 1, "lands"
            except AssertionError:
                word = "DOES NOT LAND"
            x, offset, _, points = flown[2]
            took = time.perf_counter() - start
            print(
                f"{name:30} {word}, x {x:.2f} m, {offset:.3f} m off, {points:.1f} p, {took:.1f} s"
            )
    print(f"{landed} of {mixtures + 2} packages land")


if __name__ == "__main__":
    main()
