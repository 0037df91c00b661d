"""Tests that need the machine to themselves are named, and parallel processes stay apart."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.alone import ALONE, LONGEST, TESTS, keep_apart, needs_the_machine, place_in_line

# What a test takes that there is once on a machine or that lives in real time.
SIGNS = re.compile(
    r"\b(?:ros_master|headless_chromium|BoardOnPty|WallClock|process_time|in_box|groups_left"
    r"|processes_with)\b"
)
ROOMS = [
    folder for folder in TESTS.iterdir() if folder.name not in ("benchmarks", "house")
]  # these only speak of them


def test_what_is_named_is_there():
    """A file that moved would be run beside others without a word."""
    assert [name for name in (*ALONE, *LONGEST) if not (TESTS / name).exists()] == []
    assert all(ALONE.values())


def test_what_takes_the_machine_is_named():
    """Its source speaks of ROS, a browser, a terminal's board, the wall's clock, processor time, a
    box, processes that are left: its file is named, or has tests with the mark.
    """
    tests = [path for room in ROOMS for path in room.rglob("test_*.py")]
    taking = [path for path in tests if SIGNS.search(path.read_text(encoding="utf-8"))]
    assert len(taking) > 10
    beside = [path for path in taking if not needs_the_machine(path)]
    assert [path for path in beside if "pytest.mark.alone" not in path.read_text("utf-8")] == []


def test_one_file_runs_the_long_demo():
    """Files are shared among processes: a second one would run it again."""
    files = [path for room in ROOMS for path in room.rglob("test_*.py")]
    using = [path for path in files if "demo_run" in path.read_text(encoding="utf-8")]
    assert using == [TESTS / "tools" / "demo" / "test_recorded.py"]


def test_a_room_is_named_with_its_files(monkeypatch):
    """By hand: a room that is named has every file; one of which a file is named has others."""
    monkeypatch.setitem(ALONE, "tools/caves", "dark")
    assert needs_the_machine(TESTS / "tools" / "caves" / "test_bats.py")
    assert needs_the_machine(TESTS / "manual" / "test_site.py")
    assert not needs_the_machine(TESTS / "manual" / "test_manual.py")


def test_the_longest_are_first_in_line():
    """As listed; what is not listed keeps its order among itself, for sorting is stable."""
    files = ["vision/test_ssim.py", *reversed(LONGEST), "aircraft/test_trim.py"]
    line = sorted(files, key=lambda name: place_in_line(TESTS / name))
    assert line == [*LONGEST, "vision/test_ssim.py", "aircraft/test_trim.py"]


def test_both_steps_are_all_the_tests():
    """pytest's own collection of a file of either step and of one of both: what the one step leaves
    the other takes.
    """
    readme = "tests/stories/test_readme.py"
    places = ["tests/house/test_start.py", "tests/tools/bridge/test_bus.py", readme]
    found = [
        collected(marks, places)
        for marks in ("not benchmark and not alone", "alone and not benchmark")
    ]
    assert {name.split("::")[0] for name in found[0]} == {places[0], readme}
    assert {name.split("::")[0] for name in found[1]} == {places[1], readme}
    commands = f"{readme}::test_command_runs"
    typed = [name for name in found[0] + found[1] if name.startswith(commands)]
    assert len(typed) > 10 and set(typed) <= set(found[1])
    assert set(found[0] + found[1]) == set(collected("not benchmark", places))


def collected(marks: str, places: list[str]) -> list[str]:
    """The tests that pytest would run in some files."""
    words = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", marks, *places]
    done = subprocess.run(
        words, cwd=TESTS.parent, capture_output=True, text=True, timeout=120, check=True
    )
    return [line for line in done.stdout.splitlines() if "::" in line]


@pytest.mark.parametrize(("worker", "own"), [(None, False), ("gw1", True)])
def test_a_process_of_several_has_its_own_cache(monkeypatch, worker, own):
    """One thread and a folder that is there, as long as somebody holds it; one process alone keeps
    what is set.
    """
    monkeypatch.setattr(
        os,
        "environ",
        {"OMP_NUM_THREADS": "3"} | ({"PYTEST_XDIST_WORKER": worker} if worker else {}),
    )
    held = keep_apart()
    assert (held is not None) == own
    assert os.environ["OMP_NUM_THREADS"] == ("1" if own else "3")
    assert Path(os.environ.get("NUMBA_CACHE_DIR", "nowhere")).is_dir() == own
