"""Sandbox: functions answer from inside, resources are limited, and the probe finds no hole."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.sandbox import limits, probe, runtime
from falconwing_kit.tools.grading.sandbox.host import (
    SandboxJob,
    StudentError,
    process_worker,
    sandbox_worker,
)
from tests.tools.grading import toys
from tests.tools.grading.plain_user import run_as_plain_user

BOXES = {"in_process": process_worker, "in_box": sandbox_worker}


def job(text, **more):
    return SandboxJob(text, "f", toys.LAB, **{"seconds": 1.0, "memory_mib": 128, **more})


@pytest.fixture(params=["in_process", pytest.param("in_box", marks=toys.needs_sandbox)])
def box(request):
    """Both kinds: the grader's and the student's own."""
    return BOXES[request.param]


def category(box, text, *arguments, **more):
    """The category of a call that gives no answer."""
    with box(job(text, **more)) as worker, pytest.raises(StudentError) as failed:
        worker.call(*arguments)
    return failed.value.category


def test_function_answers_like_a_local_one(box):
    """By hand: 3 x + 2.5 of the course's number, and the constants given instead of the lab's."""
    text = """from given import COHORT
def f(x, what):
    return 3 * x + COHORT['offset'], {'what': what}"""
    with box(job(text)) as worker:
        for _ in range(3):
            numbers, words = worker.call(np.arange(3.0), "β")
            np.testing.assert_array_equal(numbers, [2.5, 5.5, 8.5])
            assert words == {"what": "β"}
    with box(job(text, constants={"offset": 1.0})) as worker:
        assert worker.call(1.0, "")[0] == 4.0


def test_function_can_be_called_through_another(box):
    """`twice` of given.py: 3 (3 x) = 9 x."""
    with box(job("def f(x):\n    return 3 * x", through="twice")) as worker:
        assert worker.call(2.0) == 18.0


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("def g(): pass", "missing"),
        ("f = 3", "missing"),
        ("def f(): raise NotImplementedError('write f')", "not written"),
        ("def f(): return 1 / 0", "exception:ZeroDivisionError"),
        ("1 / 0\ndef f(): pass", "exception:ZeroDivisionError"),
        ("def f(:", "exception:SyntaxError"),
        ("class OwnError(Exception): pass\ndef f(): raise OwnError", "exception"),
        ("def f(): raise MemoryError", "memory"),
        ("def f(): return object()", "bad answer"),
        ("import os\ndef f(): os._exit(0)", "died"),
        ("import falconwing_kit\ndef f(): return 1", "exception:ModuleNotFoundError"),
    ],
)
def test_failures_have_a_category(box, text, wanted):
    """The list in StudentError's docstring."""
    assert category(box, text) == wanted


@pytest.mark.skipif(sys.platform != "linux", reason="limits of one's own are Linux's")
def test_time_and_memory_are_bound(box):
    """1 s of computing, 128 MiB: a loop and 1 GiB are too much.

    The loop ends well before a minute of waiting.
    """
    begin = time.monotonic()
    assert category(box, "def f():\n    while True: pass") == "timeout"
    assert time.monotonic() - begin < 60.0
    assert category(box, "def f(): return len(bytearray(1 << 30))") == "memory"


def test_after_a_failure_the_next_call_still_answers(box):
    """An exception ends a call, not the box; a box that ended says again why."""
    text = "import os\ndef f(x):\n    if x > 1: os._exit(0)\n    return 1 / x"
    with box(job(text)) as worker:
        with pytest.raises(StudentError, match="ZeroDivisionError"):
            worker.call(0)
        assert worker.call(1) == 1.0
        for _ in range(2):
            with pytest.raises(StudentError, match="died"):
                worker.call(2)


def test_prints_and_inputs_go_nowhere(box):
    """The pipe to the grader is not the program's output."""
    with box(job("def f():\n    print('x' * 100000)\n    return input.__name__")) as worker:
        assert worker.call() == "input"


def test_draws_without_a_seed_are_the_same_each_time(box):
    """Else a regrade could not be bit-identical; sets of texts too are in the same order."""
    text = """import numpy as np, random
def f():
    return np.random.rand(), random.random(), ''.join({'a', 'b', 'c', 'd'})"""
    answers = []
    for _ in range(2):
        with box(job(text)) as worker:
            answers.append(worker.call())
    assert answers[0] == answers[1]


@toys.needs_sandbox
def test_a_function_sees_no_path_of_this_machine():
    """bubblewrap's command line can be read inside; its mounts name the grader's folders."""
    text = """import os
def f():
    seen = [each for each in os.listdir("/proc") if each.isdigit()]
    return [open(f"/proc/{each}/cmdline", "rb").read().decode() for each in seen]"""
    with sandbox_worker(job(text)) as worker:
        lines = worker.call()
    assert any("bwrap" in line for line in lines)
    assert not [line for line in lines if str(toys.LAB.parents[2]) in line or "given.py" in line]


@toys.needs_sandbox
def test_no_process_can_be_started_and_threads_can():
    """Only so does a process's own limit of memory bound the sandbox; by fork, spawn and shell."""
    python = "sys.executable, [sys.executable, '-c', '']"
    for start in ("os.fork()", f"os.posix_spawn({python}, {{}})", "subprocess.run(['true'])"):
        text = f"import os, subprocess, sys\ndef f(): return {start}"
        assert category(sandbox_worker, text) == "exception"  # PermissionError
    text = """import threading
def f():
    found = []
    one = threading.Thread(target=found.append, args=(7,))
    one.start(); one.join()
    return found"""
    with sandbox_worker(job(text)) as worker:
        assert worker.call() == [7]


@toys.needs_sandbox
@pytest.mark.parametrize("filtered", [True, False])
def test_plain_users_memory_is_bounded_or_the_probe_says_that_it_is_not(filtered):
    """Without control groups: children, files in memory and shared memory are denied by the filter
    of system calls; without the filter each holds more than 640 MiB, and the probe says so.
    """
    code = (
        "from pathlib import Path\n"
        "from falconwing_kit.tools.grading.sandbox import limits, probe, runtime\n"
        f"if not {filtered}: runtime.seccomp_filter = lambda processes: b''\n"
        "assert limits.controllers() == (), limits.controllers()\n"
        f"print(*[each.name for each in probe._bounds(Path('HOME')) if not each.closed],"
        " sep=',')"
    )
    done = run_as_plain_user(["-c", code], 100)
    assert done.returncode == 0, done.stderr[-2000:]
    open_ones = "" if filtered else "memory of children,files in memory,shared memory"
    assert done.stdout.strip() == open_ones


def test_memory_of_descendants_is_counted():
    """A child of a child holds 64 MiB; it is counted, with what three interpreters take."""
    deep = "x = bytearray(b'x') * (64 << 20); print(1, flush=True); input()"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {deep!r}])"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe) as process:
        assert process.stdout.readline()
        assert 64 << 20 <= limits.resident_bytes(process.pid) <= 200 << 20
        process.stdin.close()
    assert limits.resident_bytes(process.pid) == 0


@pytest.fixture
def without_filter(monkeypatch):
    """Sandboxes that may start processes, to see what else holds."""
    monkeypatch.setattr(runtime, "seccomp_filter", lambda processes: b"")


@toys.needs_sandbox
def test_nothing_outlives_a_box(without_filter):
    """A child that left its parents; and the control groups."""
    token = "token-of-test-box"
    text = (
        "import os, sys, time\ndef f():\n    if os.fork() == 0:\n        os.setsid()\n"
        "        os.execv(sys.executable, [sys.executable, '-S', '-c', 'import time; "
        f"time.sleep(99)', {token!r}])\n"
        "    time.sleep(0.3)\n    return 1"
    )
    with sandbox_worker(job(text)) as worker:
        assert worker.call() == 1
        assert len(toys.processes_with(token)) == 1
    assert toys.processes_with(token) == []
    assert toys.groups_left() == []


@toys.needs_sandbox
def test_box_ends_with_a_grader_that_is_killed():
    """The grader is killed while a function sleeps: the sandbox ends, the next grader sweeps it."""
    code = (
        "from pathlib import Path\n"
        "from falconwing_kit.tools.grading.sandbox.host import SandboxJob, sandbox_worker\n"
        'text = \'import os, sys\\ndef f(t): os.execv(sys.executable, [sys.executable, "-S", "-c", '
        '"import time; time.sleep(99)", t])\'\n'
        f"worker = sandbox_worker(SandboxJob(text, 'f', Path({str(toys.LAB)!r}))).__enter__()\n"
        "print(worker.process, flush=True)\n"
        "worker.call('token-of-killed-grader')"
    )
    grader = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=Path(__file__).parents[3]
    )
    assert grader.stdout.readline()
    _wait(
        lambda: len(toys.processes_with("token-of-killed-grader")) >= 2
    )  # the grader's own words hold it too
    grader.kill()
    grader.wait()
    grader.stdout.close()
    _wait(lambda: not toys.processes_with("token-of-killed-grader"))
    limits.sweep()
    assert toys.groups_left() == []


def _wait(fulfilled):
    end = time.monotonic() + 30.0
    while not fulfilled():
        assert time.monotonic() < end, "it did not come about in 30 s"
        time.sleep(0.05)


@toys.needs_sandbox
@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0,
    reason="root alone can make control groups anywhere",
)
def test_groups_bind_what_limits_do_not(without_filter):
    """Twelve children of 100 MiB each stay below one's own limit of 128.

    The box's memory ends some of them.
    """
    if limits.controllers() != ("memory", "pids"):
        pytest.skip("this system does not let root make control groups")
    text = (
        "import os, time\ndef f():\n    for _ in range(12):\n        if os.fork() == 0:\n"
        "            kept = bytearray(b'x') * (100 << 20)\n            time.sleep(2)\n            "
        "os._exit(0)\n"
        "    return sum(os.wait()[1] == 9 for _ in range(12))"
    )
    with sandbox_worker(job(text)) as worker:
        try:
            assert worker.call() > 0
        except StudentError as error:
            assert error.category == "memory"  # the kernel chose the one that had started them


@toys.needs_sandbox
def test_probe_finds_no_hole():
    """On a machine with bubblewrap every attempt fails."""
    findings = probe.probe_sandbox()
    assert probe.open_holes(findings) == []
    assert len(findings) >= 12


def test_probe_sees_holes_where_there_are_some(tmp_path):
    """The same attempts in a plain process: network, files, environment and writing are open."""
    (tmp_path / "secret").write_text("x")
    plain = SandboxJob(probe._PAYLOAD, "tried", tmp_path, seconds=1.0, memory_mib=128)
    with probe._listening() as port, process_worker(plain) as worker:
        assert "a port of this machine" in worker.call("network", port)
        assert worker.call("files", [str(tmp_path / "secret")], "/nowhere", []) == str(
            tmp_path / "secret"
        )
        assert "PATH" in worker.call("environment", [])
        assert str(tmp_path) in worker.call("writing", [str(tmp_path)])
        assert worker.call("modules", ["json"]) == "json"


@toys.needs_sandbox
def test_holes_stop_the_probe_from_being_green(tmp_path, monkeypatch):
    """A box that shares the network, made so on purpose, is found out, and nothing else is."""
    monkeypatch.setattr(runtime, "_WALLS", (*runtime._WALLS, "--share-net"))
    assert [hole.split(":")[0] for hole in probe.open_holes(list(probe._walls(tmp_path)))] == [
        "network"
    ]


def test_without_bubblewrap_the_sentence_says_what_to_install(monkeypatch):
    """An empty PATH has none."""
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match="apt install bubblewrap"):
        sandbox_worker(job("def f(): pass"))
