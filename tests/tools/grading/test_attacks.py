"""Attacks: a class of honest and dishonest students, graded in one run; no attack gains points."""

import json
import os
import secrets
import socket
from pathlib import Path

import pytest

from falconwing_kit.tools.cli.grade import Grade
from falconwing_kit.tools.grading.records import last_records, read_grade_records
from tests.tools.grading import toys
from tests.tools.grading.attacks import ATTACKS
from tests.tools.grading.plain_user import CHECKOUT, run_as_plain_user

pytestmark = toys.needs_sandbox
NAMES = {name: f"attack {number:02}" for number, name in enumerate(ATTACKS)}
WRONG = "def stretch(x, gain):\n    return attack(x, gain)"
PLAIN = {
    "wrong value",
    "wrong shape",
    "trial failed",
    "bad answer",
    "timeout",
    "memory",
    "died",
    "exception",
    "missing",
}


def selected(request):
    """The attacks of the tests that run: all, unless an option of pytest names some."""
    items = [each for each in request.session.items if each.path == request.path]
    params = [each.callspec.params if hasattr(each, "callspec") else {} for each in items]
    names = {each.get("name") for each in params}
    return [name for name in ATTACKS if name in names or names <= {None}]


@pytest.fixture(scope="module")
def graded(request, tmp_path_factory):
    """Records by student, and the run's folder, after grading by two workers."""
    folder = tmp_path_factory.mktemp("attacked")
    out, students, token = folder / "out", folder / "students", secrets.token_hex(16)
    students.mkdir()
    folder.chmod(0o755)
    for number in range(10):
        (students / f"good{number}.ipynb").write_bytes(
            toys.notebook_bytes(toys.HEAD, toys.STRETCH, toys.BRAKE)
        )
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("FALCONWING_SECRET", "a secret of the grader")
        places = {
            "OUT": out,
            "SUBMISSIONS": students,
            "TOKEN": token,
            "PORT": server.getsockname()[1],
        }
        for name, text in ((name, ATTACKS[name]) for name in selected(request)):
            for word, value in places.items():
                text = text.replace(word, str(value))
            cells = (toys.HEAD, text, WRONG)
            (students / f"{NAMES[name]}.ipynb").write_bytes(toys.notebook_bytes(*cells))
        before = _files(students)
        assert Grade(str(toys.LAB), (students,), out, workers=2, json=True).run() == 0
        server.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            server.accept()  # nobody has called
    assert _files(students) == before
    assert toys.processes_with(token) == []
    assert toys.groups_left() == []
    return last_records(read_grade_records(out)), out


def test_there_are_forty_attacks_and_more():
    """The number asked for; fewer would mean that some were lost on the way."""
    assert len(ATTACKS) >= 40


@pytest.mark.parametrize("name", ATTACKS)
def test_attack_gains_nothing(graded, name):
    """The wrong solution has no points, with or without the attack, and was graded normally."""
    record = graded[0][NAMES[name]]
    assert (record["status"], record["points"], record["sandboxed"]) == ("graded", 0.0, True)


@pytest.mark.parametrize("name", ATTACKS)
def test_record_tells_nothing_of_the_questions(graded, name):
    """Failure categories are the grader's own words; numbers are counts, points and versions."""
    record = graded[0][NAMES[name]]
    for result in record["exercises"].values():
        assert {each.split(":")[0] for each in result["categories"]} <= PLAIN
        assert sum(result["categories"].values()) == result["cases"] - result["right"]
    assert "SECRET" not in json.dumps(record)


QUICK = "equals or forged or pickle or memory or right or children or leave or crash or 3e12"


def test_quick_attacks_gain_nothing_from_a_plain_user_either():
    """The same tests of some attacks, by a user without control groups; all: bench_attacks.py."""
    done = run_as_plain_user(attack_tests("-k", f"gains_nothing and ({QUICK})"), 200)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert int(done.stdout.split(" passed")[0].split()[-1]) >= 10


def attack_tests(*options):
    """Python's arguments for the tests of this file, for `run_as_plain_user`."""
    plain = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "--basetemp=HOME/tests")
    return [*plain, str(Path(__file__).relative_to(CHECKOUT)), *options]


def test_good_students_among_them_have_full_marks(graded):
    """Ten correct solutions, graded by the same two workers before, between and after attacks."""
    assert [graded[0][f"good{number}"]["points"] for number in range(10)] == [75.0] * 10


def test_wrong_solution_alone_has_no_points(tmp_path, monkeypatch):
    """What the attacks are measured against; the box was probed for the class."""
    monkeypatch.setattr("falconwing_kit.tools.cli.grade._require_sandbox", lambda: None)
    cells = (
        toys.HEAD,
        "def attack(x, gain): return gain * x",
        WRONG,
        "def brake(position, speed): return 0.0",
    )
    (tmp_path / "wrong.ipynb").write_bytes(toys.notebook_bytes(*cells))
    assert (
        Grade(
            str(toys.LAB), (tmp_path / "wrong.ipynb",), tmp_path / "out", workers=1, json=True
        ).run()
        == 0
    )
    assert read_grade_records(tmp_path / "out")[0]["points"] == 0.0


def test_nothing_is_written_but_the_graders_own_files(graded):
    """The three files of a run; a record for each student, none for anyone else."""
    records, out = graded
    assert sorted(path.name for path in out.iterdir()) == [
        "gradebook.csv",
        "records.jsonl",
        "run.json",
    ]
    assert len(read_grade_records(out)) == len(records) == len(ATTACKS) + 10


def test_attacks_do_what_they_say(graded):
    """Where the end is known: loops time out, 10 GB is too much, others are "exception"."""
    ends = {
        "an endless loop": "timeout",
        "sleep": "timeout",
        "ten gigabytes": "memory",
        "leave at once": "died",
        "crash": "died",
        "leave politely": "exception:SystemExit",
        "an exception named after the question": "exception",
        "import the reference": "exception:ModuleNotFoundError",
        "endless recursion": "exception:RecursionError",
        "a reply before the question": "bad answer",
        "not a number": "wrong value",
        "an array of 3e12 numbers that are not there": "bad answer",
    }
    found = {
        name: list(graded[0][NAMES[name]]["exercises"]["stretch"]["categories"]) for name in ends
    }
    assert found == {name: [end] for name, end in ends.items()}


def _files(folder: Path) -> dict[str, bytes]:
    return {
        os.path.relpath(path, folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
