"""falconwing grade: damaged notebooks, a killed worker, a killed run, and regrading."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli import grade as verbs
from falconwing_kit.tools.cli.grade import Grade
from falconwing_kit.tools.cli.sandbox import Sandbox
from falconwing_kit.tools.grading.records import last_records, read_grade_records
from falconwing_kit.tools.grading.sandbox.probe import ProbeResult
from tests.tools.grading import toys

pytestmark = toys.needs_sandbox
SPLIT = toys.STRETCH.split("\n")
SOURCES = (toys.HEAD, toys.STRETCH, toys.BRAKE)
# What happened to a right notebook, and the points that it still has: 50 for stretch, 25 for brake.
DAMAGE = {
    "whole": (toys.notebook_bytes(*SOURCES), 75.0),
    "duplicated": (toys.notebook_bytes(*SOURCES, *SOURCES), 75.0),
    "duplicated untouched": (
        toys.notebook_bytes(
            *SOURCES, "def stretch(x, gain):\n    raise NotImplementedError('write stretch')"
        ),
        75.0,
    ),
    "reordered": (toys.notebook_bytes(*reversed(SOURCES)), 75.0),
    "joined": (toys.notebook_bytes("\n".join(SOURCES)), 75.0),
    "ids and metadata lost": (
        toys.notebook_bytes(*SOURCES, nbformat=3, nbformat_minor=0, metadata=None),
        75.0,
    ),
    "split inside a function": (toys.notebook_bytes(toys.HEAD, *SPLIT, toys.BRAKE), 25.0),
    "split between functions": (toys.notebook_bytes("import numpy as np", *SOURCES), 75.0),
    "deleted": (toys.notebook_bytes(toys.HEAD, toys.BRAKE), 25.0),
    "turned to markdown": (
        toys.notebook_bytes(toys.HEAD, toys.cell(toys.STRETCH, "markdown"), toys.BRAKE),
        25.0,
    ),
    "no import": (toys.notebook_bytes(toys.STRETCH, toys.BRAKE), 25.0),
    "wrong kernel": (
        toys.notebook_bytes(
            "x <- c(1, 2)\nstretch <- function(x, gain) gain * x",
            metadata={"kernelspec": {"name": "ir"}},
        ),
        0.0,
    ),
    "20 MB of outputs": (
        toys.notebook_bytes(
            *SOURCES, toys.cell("1", outputs=[]) | {"outputs": [{"text": "x" * 20_000_000}]}
        ),
        75.0,
    ),
    "40 MB of outputs": (toys.notebook_bytes(*SOURCES) + b" " * 40_000_000, None),
    "cut off": (toys.notebook_bytes(*SOURCES)[:-20], None),
    "empty": (b"", None),
    "not text": (bytes(range(256)), None),
    "not a notebook": (b'{"cells": {}}', None),
    "deep": (b"[" * 1_000_000, None),
}


PROBED = verbs._require_sandbox


@pytest.fixture(scope="module", autouse=True)
def unprobed():
    """The box is probed in tests of its own; each run here would try it again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verbs, "_require_sandbox", lambda: None)
        yield


def write_class(folder, names_and_bytes):
    folder.mkdir()
    folder.chmod(0o755)
    for name, data in names_and_bytes:
        (folder / f"{name}.ipynb").write_bytes(data)
    return folder


def test_damaged_notebooks_never_stop_a_class(tmp_path, capsys):
    """Points by hand for what remains; unreadable notebooks have a message and no points."""
    students = write_class(
        tmp_path / "students", ((name, data) for name, (data, _) in DAMAGE.items())
    )
    assert Grade(str(toys.LAB), (students,), tmp_path / "out").run() == 0
    records = last_records(read_grade_records(tmp_path / "out"))
    found = {
        name: each["points"] if each["status"] in ("graded", "wrong lab") else None
        for name, each in records.items()
    }
    assert found == {name: points for name, (_, points) in DAMAGE.items()}
    assert all(each["problem"] for each in records.values() if each["status"] == "unreadable")
    assert "code cell 2 is not Python" in json.dumps(records["split inside a function"])
    shown = capsys.readouterr().out
    assert "! empty: unreadable: the notebook: expected a Jupyter notebook, got an empty" in shown
    assert "! wrong kernel: wrong lab: none of its functions" in shown
    assert (
        f"{sum(p is not None for _, p in DAMAGE.values()) - 1} of {len(DAMAGE)} submissions graded"
        in shown
    )


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A class of six, some right, some not, graded in one go: its folder and its run's."""
    folder = tmp_path_factory.mktemp("class")
    folder.chmod(0o755)
    half = "def stretch(x, gain):\n    return gain * x + COHORT['offset'] * (gain < 1.5)"
    students = write_class(
        folder / "students",
        (
            (
                f"student{n}",
                toys.notebook_bytes(toys.HEAD, half if n % 2 else toys.STRETCH, toys.BRAKE),
            )
            for n in range(6)
        ),
    )
    assert Grade(str(toys.LAB), (students,), folder / "out", workers=2, json=True).run() == 0
    return students, folder / "out"


def command(students, out, *more):
    """The verb as a program of its own, with the earlier run's secret."""
    words = [
        sys.executable,
        "-m",
        "falconwing_kit.tools.cli.main",
        "grade",
        str(toys.LAB),
        str(students),
        "--out",
        str(out),
    ]
    return subprocess.Popen(
        [*words, *more], cwd=Path(__file__).parents[3], stdout=subprocess.PIPE, text=True
    )


def with_secret_of(earlier, out):
    out.mkdir()
    (out / "run.json").write_bytes((earlier / "run.json").read_bytes())
    return out


def records_in(out):
    return last_records(read_grade_records(out))


def children(process):
    found = []
    for file in Path(f"/proc/{process}/task").glob("*/children"):
        found += [int(text) for text in file.read_text().split()]
    return found


def wait_for(fulfilled):
    end = time.monotonic() + 60.0
    while not (found := fulfilled()):
        assert time.monotonic() < end, "it did not come about in a minute"
        time.sleep(0.01)
    return found


def test_some_students_have_some_points(undisturbed):
    """Else the next tests would compare nothing."""
    points = {record["points"] for record in records_in(undisturbed[1]).values()}
    assert 75.0 in points
    assert len(points) > 1


def test_killed_worker_changes_nothing(undisturbed, tmp_path):
    """One of two is killed after the first record; its submission is taken up again."""
    students, earlier = undisturbed
    out = with_secret_of(earlier, tmp_path / "out")
    run = command(students, out, "--json")
    wait_for(lambda: len(read_grade_records(out)) >= 1)
    workers = [
        each
        for each in children(run.pid)
        if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()
    ]
    assert len(workers) == 2
    os.kill(workers[0], signal.SIGKILL)
    run.communicate(timeout=120)
    assert run.returncode == 0
    assert records_in(out) == records_in(earlier)
    assert len(read_grade_records(out)) == 6
    assert toys.groups_left() == []


def test_killed_run_goes_on_where_it_was(undisturbed, tmp_path):
    """The whole run is killed after two records.

    --resume does the others and leaves those two as they are.
    """
    students, earlier = undisturbed
    out = with_secret_of(earlier, tmp_path / "out")
    run = command(students, out)
    wait_for(lambda: len(read_grade_records(out)) >= 2)
    workers = children(run.pid)
    run.kill()
    run.communicate()
    wait_for(lambda: not any(Path(f"/proc/{each}").exists() for each in workers))
    done = (out / "records.jsonl").read_bytes()
    assert len(read_grade_records(out)) < 6
    with (out / "records.jsonl").open("ab") as file:
        file.write(b'{"student": "half a li')
    assert Grade(str(toys.LAB), (students,), out, resume=True, json=True).run() == 0
    assert (out / "records.jsonl").read_bytes().startswith(done)
    assert records_in(out) == records_in(earlier)
    assert (out / "gradebook.csv").read_bytes() == (earlier / "gradebook.csv").read_bytes()
    assert toys.groups_left() == []


def test_regrade_is_bit_identical_and_resume_does_nothing_twice(undisturbed, capsys):
    """Nothing differs, so nothing is written; resuming a finished run grades nobody."""
    students, out = undisturbed
    before = (out / "records.jsonl").read_bytes()
    assert Grade(str(toys.LAB), (students,), out, regrade=True, workers=1, json=True).run() == 0
    assert json.loads(capsys.readouterr().out)["changed"] == 0
    assert (out / "records.jsonl").read_bytes() == before
    assert Grade(str(toys.LAB), (students,), out, resume=True, json=True).run() == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["graded_now"], shown["left"], shown["graded"]) == (0, 6, 6)


def test_salt_changes_the_course(undisturbed, tmp_path):
    """A function with the open course's number is wrong in another course, correct in its own."""
    fixed = "def stretch(x, gain):\n    return gain * x + 2.5"
    students = write_class(
        tmp_path / "students", [("ada", toys.notebook_bytes(toys.HEAD, fixed, toys.BRAKE))]
    )
    for salt, points in (("", 75.0), ("pepper", 25.0)):
        out = tmp_path / f"out{salt}"
        assert Grade(str(toys.LAB), (students,), out, workers=1, salt=salt, json=True).run() == 0
        assert records_in(out)["ada"]["points"] == points


def test_a_hole_stops_the_grading_unless_it_is_accepted(tmp_path, monkeypatch):
    """The probe is told to find one; accepted, every record says that it was not boxed."""
    students = write_class(tmp_path / "students", [("ada", toys.notebook_bytes(*SOURCES))])
    monkeypatch.setattr(verbs, "_require_sandbox", PROBED)
    monkeypatch.setattr(
        "falconwing_kit.tools.grading.sandbox.probe.probe_sandbox",
        lambda: [ProbeResult("network", False, "a port")],
    )
    with pytest.raises(InputError, match="network: a port"):
        Grade(str(toys.LAB), (students,), tmp_path / "out").run()
    assert not (tmp_path / "out").exists()
    assert (
        Grade(
            str(toys.LAB),
            (students,),
            tmp_path / "out",
            workers=1,
            unsafe_no_sandbox=True,
            json=True,
        ).run()
        == 0
    )
    assert [
        (each["points"], each["sandboxed"]) for each in read_grade_records(tmp_path / "out")
    ] == [(75.0, False)]
    assert Sandbox("probe", json=True).run() == 1
    assert Sandbox("probe").run() == 1


def test_judge_that_fails_is_for_a_person(tmp_path, capsys):
    """An error of the lab: no points are lost, exit code 1, and the message names the exercise."""
    lab = tmp_path / "lab"
    lab.mkdir()
    for name in ("given.py", "checks.py", "cohort.json"):
        (lab / name).write_bytes((toys.LAB / name).read_bytes())
    broken = (toys.LAB / "hidden.py").read_text().replace("gain * x + offset,", "gain * x + 1 / 0,")
    (lab / "hidden.py").write_text(broken)
    students = write_class(tmp_path / "students", [("ada", toys.notebook_bytes(*SOURCES))])
    assert (
        Grade(str(lab), (students,), tmp_path / "out", workers=1, unsafe_no_sandbox=True).run() == 1
    )
    record = read_grade_records(tmp_path / "out")[0]
    assert (record["status"], record["points"]) == ("error", None)
    assert "! ada: error: stretch: the judge's reference failed" in capsys.readouterr().out
