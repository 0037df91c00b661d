"""Sandbox probe: known escape attempts -> which ones succeed. Grading requires that none does."""

import os
import secrets
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import falconwing_kit
from falconwing_kit.tools.grading.sandbox import limits, runtime
from falconwing_kit.tools.grading.sandbox.host import (
    PROCESSES,
    SPARE,
    SandboxJob,
    StudentError,
    sandbox_worker,
)
from falconwing_kit.tools.linux import require_linux

_MEMORY_MIB = 128  # of a function's process


@dataclass(frozen=True)
class ProbeResult:
    """Result of one attempt.

    Attributes:
        name: of the attempt.
        closed: whether it failed.
        said: description of the result.
    """

    name: str
    closed: bool
    said: str


# Runs in the sandbox. Each function returns what succeeded and must not, as a text; empty if
# nothing.
_PAYLOAD = """
import ctypes, os, socket, subprocess, sys, time

def tried(name, *arguments):
    return globals()[name](*arguments)

def network(port):
    found = [name for _, name in socket.if_nameindex() if name != "lo"]
    try:
        socket.create_connection(("127.0.0.1", port), 2.0)
        found.append("a port of this machine")
    except OSError:
        pass
    return " ".join(found)

def files(paths, home, wanted):
    seen = [path for path in paths if os.path.exists(path)]
    inside = set(os.listdir(home)) if os.path.isdir(home) else set()
    return " ".join(seen + sorted(inside - set(wanted)))

def modules(names):
    found = []
    for name in names:
        try:
            __import__(name)
            found.append(name)
        except ImportError:
            pass
    return " ".join(found)

def environment(known):
    return " ".join(sorted(set(os.environ) - set(known)))

def writing(folders):
    found = []
    for folder in folders:
        try:
            with open(os.path.join(folder, "probe"), "w") as handle:
                handle.write("x")
            found += [folder] if folder != "/tmp" else []  # the only one that is its own
        except OSError:
            pass
    return " ".join(found)

def rights():
    found = []
    library = ctypes.CDLL(None)
    if library.unshare(0x10000000) == 0 or library.unshare(0x20000) == 0:
        found.append("a namespace of its own")
    if library.mount(b"none", b"/tmp", b"tmpfs", 0, None) == 0:
        found.append("mounting")
    try:
        os.setuid(0)
        found.append("root")
    except OSError:
        pass
    status = open("/proc/self/status").read()
    if "NoNewPrivs:\\t1" not in status or "CapEff:\\t0000000000000000" not in status:
        found.append("new rights")
    return " ".join(found)

def others():
    seen = [name for name in os.listdir("/proc") if name.isdigit()]
    return f"{len(seen)} processes" if len(seen) > 3 else ""

def filling(limit):
    written = 0
    try:
        for number in range(40):
            with open(f"/tmp/{number}", "wb", buffering=0) as handle:
                for _ in range(4):
                    written += handle.write(bytes(1 << 20))
    except OSError:
        pass
    return f"{written >> 20} MiB" if written > limit else ""

def forking(limit):
    alive = 0
    try:
        for _ in range(4 * limit):
            if os.fork() == 0:
                time.sleep(60)
                os._exit(0)
            alive += 1
    except OSError:
        pass
    return f"{alive} processes" if alive > limit else ""

def memory(mib):
    block = bytearray(mib << 20)
    block[::4096] = bytes(len(block[::4096]))
    return f"{mib} MiB"

def children(size, limit):
    held, reader, writer = 1, *os.pipe()
    try:
        for _ in range(limit // size + 2):
            if os.fork() == 0:
                block = bytearray(size << 20)
                block[::4096] = bytes(len(block[::4096]))
                os.write(writer, b"x")
                time.sleep(60)
                os._exit(0)
            held += len(os.read(reader, 1))
    except OSError:
        pass
    return f"{held * size} MiB" if held * size > limit else ""

def memory_files(size, limit):
    held = []
    try:
        while len(held) * size <= limit:
            held.append(os.memfd_create("x"))
            os.write(held[-1], bytes(size << 20))
    except OSError:
        pass
    return f"{len(held) * size} MiB" if len(held) * size > limit else ""

def segments(size, limit):
    library, held = ctypes.CDLL(None), 0
    library.shmat.restype = ctypes.c_void_p
    while held * size <= limit:
        number = library.shmget(0, ctypes.c_size_t(size << 20), 0o1600)
        place = library.shmat(number, None, 0) if number >= 0 else None
        if place in (None, ctypes.c_void_p(-1).value):
            break
        ctypes.memset(place, 1, size << 20)
        library.shmdt(ctypes.c_void_p(place))
        held += 1
    return f"{held * size} MiB" if held * size > limit else ""

def endless():
    while True:
        pass

def daemon(token):
    import threading
    threading.Thread(target=time.sleep, args=(60,)).start()
    ctypes.CDLL(None).prctl(15, token.encode(), 0, 0, 0)  # PR_SET_NAME: this process's name
    try:
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                words = [sys.executable, "-S", "-c", "import time; time.sleep(60)", token]
                os.execv(sys.executable, words)
            os._exit(0)
    except OSError:
        pass
    time.sleep(0.3)
    return ""
"""


def probe_sandbox() -> list[ProbeResult]:
    """Run all attempts, in sandboxes like a student's.

    Returns:
        One result per attempt; the sandbox is safe if all are closed. If no sandbox can be started,
        that is the only result.

    Raises:
        InputError: bubblewrap is missing, or this is not Linux.
    """
    require_linux("sandbox", "apt install bubblewrap")
    with tempfile.TemporaryDirectory(prefix="falconwing-probe-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "secret").write_text("only for the grader")
        try:
            return [*_walls(folder), *_bounds(folder), _leftover(folder)]
        except (RuntimeError, OSError) as error:
            return [ProbeResult("starting a sandbox", False, str(error))]


def open_holes(findings: list[ProbeResult]) -> list[str]:
    """The successful attempts, as texts."""
    return [f"{each.name}: {each.said}" for each in findings if not each.closed]


def _walls(folder: Path) -> Iterator[ProbeResult]:
    """Access from inside: network, files, modules, environment, rights, processes."""
    kit, home = Path(falconwing_kit.__file__).parent, Path.home()
    python = runtime.find_runtime(("numpy",))
    needed = {
        str(place.relative_to(home).parts[0])
        for _, place in python.mounts
        if place.is_relative_to(home)
    }
    paths = [
        folder / "secret",
        kit / "__init__.py",
        kit.parent / "labs",
        "/etc/passwd",
        "/etc/shadow",
        "/var",
        "/sys",
    ]
    places = [
        "/",
        "/sandbox",
        "/sandbox/work",
        "/usr",
        "/etc",
        "/dev",
        "/dev/shm",
        "/proc/sys",
        str(folder),
        str(home),
    ]
    with _listening() as port, sandbox_worker(_job(folder)) as worker:
        for name, what, *arguments in (
            ("network", "network", port),
            (
                "files of this machine",
                "files",
                [str(path) for path in paths],
                str(home),
                sorted(needed),
            ),
            (
                "the kit and the judge",
                "modules",
                ["falconwing_kit.tools.grading", "checks", "hidden"],
            ),
            ("environment", "environment", [*runtime.ENVIRONMENT, "PWD", "LC_CTYPE"]),
            ("writing", "writing", places),
            ("rights", "rights"),
            ("other processes", "others"),
        ):
            found = worker.call(what, *arguments)
            yield ProbeResult(name, found == "", str(found) or "no access")
        owner = _owner(worker.process)
        yield ProbeResult(
            "identity", owner != 0, "root" if owner == 0 else f"user {owner}, without rights"
        )


def _bounds(folder: Path) -> Iterator[ProbeResult]:
    """Resource limits, one sandbox per attempt, since some attempts kill it."""
    bound = runtime.TEMPORARY
    most = (_MEMORY_MIB << 20) + SPARE >> 20  # MiB of the whole sandbox
    for name, what, arguments, good in (
        ("disk", "filling", (bound,), f"ends at {bound >> 20} MiB"),
        ("processes", "forking", (PROCESSES,), f"ends at {PROCESSES}"),
        ("memory", "memory", (512,), "ends at the lab's limit"),
        ("memory of children", "children", (_MEMORY_MIB * 3 // 4, most), f"ends at {most} MiB"),
        ("files in memory", "memory_files", (32, most), f"end at {most} MiB"),
        ("shared memory", "segments", (32, most), f"ends at {most} MiB"),
        ("time", "endless", (), "ends at the exercise's limit"),
    ):
        with sandbox_worker(_job(folder)) as worker:
            try:
                found = str(worker.call(what, *arguments))
            except StudentError as error:
                fits = error.category in ("memory", "timeout", "died")
                found = "" if fits else error.category
        yield ProbeResult(name, found == "", found or good)
    groups = " and ".join(limits.controllers())
    yield ProbeResult(
        "control groups",
        True,
        f"limit {groups}" if groups else "not available; one process is allowed, with its limits",
    )


def _leftover(folder: Path) -> ProbeResult:
    """Whether a daemonised process outlives its sandbox."""
    token = secrets.token_hex(7)  # the kernel keeps 15 letters of a name
    with sandbox_worker(_job(folder)) as worker:
        worker.call("daemon", token)
        started = _running(token)
    left = _running(token)
    said = (
        "nothing stays"
        if started and not left
        else "a process stays"
        if left
        else "could not be tried"
    )
    return ProbeResult("after the end", bool(started) and not left, said)


def _job(folder: Path) -> SandboxJob:
    return SandboxJob(_PAYLOAD, "tried", folder, seconds=1.0, memory_mib=_MEMORY_MIB)


def _running(token: str) -> list[str]:
    """Processes of this machine with a token as their name or in their command line."""
    found = []
    for file in (*Path("/proc").glob("[0-9]*/cmdline"), *Path("/proc").glob("[0-9]*/comm")):
        try:
            if token.encode() in file.read_bytes():
                found.append(file.parent.name)
        except OSError:
            continue
    return found


def _owner(process: int) -> int:
    """User number of a process."""
    return os.stat(f"/proc/{process}").st_uid


@contextmanager
def _listening() -> Iterator[int]:
    """An open port of this machine."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]
