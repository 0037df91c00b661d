"""Grader: submissions per second of a class of 200, beside what nbgrader and otter-grader took.

    python -m pytest -m benchmark tests/benchmarks/bench_grading.py -s   # toy lab, then torch lab
    python -m tests.benchmarks.bench_grading --lab lab03 --class-size 200 --workers 2

Every function runs in a fresh box, as in `falconwing grade`; the class hands in the lab's own
solution. The others' figures were measured once, on another day and on another load, with two
exercises a notebook; read them as ratios.
"""

import argparse
import os
import shutil
import tempfile
import time
from functools import partial
from pathlib import Path

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.find import lab_folder, load_checks, notebook_path
from falconwing_kit.tools.grading.judge import Assignment, GradingTask, grade_submission
from falconwing_kit.tools.grading.submissions import find_submissions
from falconwing_kit.tools.jobs.run import parallel_map
from tests.benchmarks.bench_rollouts import machine
from tests.tools.grading import toys

OTHERS = {
    "nbgrader 0.9.6, one after the other": 2.6,
    "otter-grader 7.0.0, `otter run`": 11.0,
}  # s a submission
GOALS = {"numpy": 180.0, "torch": 2700.0}  # s for 200 submissions on two cores


@pytest.mark.benchmark
@toys.needs_sandbox
def test_class_of_200_is_graded_in_three_minutes(capsys):
    """A NumPy lab of two exercises; every record has full marks, or the speed would be that of
    failing.
    """
    notebook = toys.notebook_bytes(toys.HEAD, toys.STRETCH, toys.BRAKE)
    took = seconds_for(toys.LAB, notebook, 200, 2)
    with capsys.disabled():
        print(table("toy lab, two exercises, NumPy", 200, took))
    assert took <= GOALS["numpy"]


@pytest.mark.benchmark
@toys.needs_sandbox
def test_torch_lab_would_be_graded_in_45_minutes(capsys):
    """Ten submissions of lab 8 stand for 200: none is faster for being one of many."""
    folder = lab_folder("lab08")
    took = seconds_for(folder, notebook_path(folder, solution=True).read_bytes(), 10, 2)
    with capsys.disabled():
        print(table(folder.name, 10, took))
    assert 20.0 * took <= GOALS["torch"]


def seconds_for(folder: Path, notebook: bytes, students: int, workers: int) -> float:
    """Time to grade a class that hands in the same notebook [s]; the pool's start is counted, the
    probe is not.
    """
    with tempfile.TemporaryDirectory() as name:
        for number in range(students):
            (Path(name) / f"student{number:03}.ipynb").write_bytes(notebook)
        works = [GradingTask(each) for each in find_submissions(name, load_checks(folder).name)]
        begin = time.perf_counter()
        records = [
            record
            for _, record in parallel_map(
                partial(grade_submission, assignment=Assignment(folder)), works, workers
            )
        ]
        took = time.perf_counter() - begin
    lost = [record for record in records if record["points"] != record["of"]]
    if lost:
        raise RuntimeError(
            f"{len(lost)} of {students} submissions have not full marks, such as {lost[0]}"
        )
    return took


def table(name: str, students: int, took: float) -> str:
    """The figures as a Markdown table."""
    load = f"load average {os.getloadavg()[0]:.1f}"
    rows = [f"| {name} | {students / took:.2f} | {200 * took / students:.0f} |"]
    rows += [f"| {other} | {1 / each:.2f} | {200 * each:.0f} |" for other, each in OTHERS.items()]
    head = "| grader | submissions/s | s for 200 |\n|---|---|---|\n"
    return f"\n\n{machine()}, {load}; {students} submissions in {took:.1f} s\n\n{head}" + "\n".join(
        rows
    )


def main() -> None:
    """Grade a lab's own solution many times and print how long it took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lab", default="lab01")
    parser.add_argument("--class-size", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    words = parser.parse_args()
    if shutil.which("bwrap") is None:
        raise InputError(
            "bwrap: expected bubblewrap, found none; Debian or Ubuntu: apt install bubblewrap"
        )
    folder = lab_folder(words.lab)
    notebook = notebook_path(folder, solution=True).read_bytes()
    print(
        table(
            folder.name,
            words.class_size,
            seconds_for(folder, notebook, words.class_size, words.workers),
        )
    )


if __name__ == "__main__":
    main()
