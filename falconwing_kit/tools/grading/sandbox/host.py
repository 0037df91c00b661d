"""Host side of the sandbox: a student's source text -> a function that runs in another process.

`sandbox_worker` starts a bubblewrap sandbox for the grader: no network, no home, no kit, no rights,
enforced limits. `process_worker` starts a plain process for a student's own check, on any system.
Both run worker.py with the protocol of protocol.py.
"""

import builtins
import json
import os
import re
import secrets
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from falconwing_kit.tools.grading.sandbox import limits, protocol, runtime, worker
from falconwing_kit.tools.grading.sandbox.protocol import FrameError, read_frame, write_frame
from falconwing_kit.tools.linux import require_linux

PROCESSES = 16  # limit of the student's threads; there are no further processes
STARTING = 120.0  # s to start and to load libraries, not counted as the student's time
_OUT_OF_TIME = 24  # Linux's SIGXCPU
SPARE = 512 << 20  # bytes for interpreter, libraries and temporary files, beyond the student's
# Error names that may leave the sandbox: Python's own; any other name could carry a message.
ERRORS = {
    name
    for name, kind in vars(builtins).items()
    if isinstance(kind, type)
    and issubclass(kind, Exception)
    and not issubclass(kind, OSError | Warning)
} | {"OSError", "SystemExit", "LinAlgError"}


class StudentError(Exception):
    """The student's function returned no answer.

    Attributes:
        category: "missing", "not written", "exception:TypeError" (a name of ERRORS) or plain
            "exception", "timeout", "memory", "died" or "bad answer". Never a text of the student.
    """

    def __init__(self, category: str) -> None:
        super().__init__(category)
        self.category = category


@dataclass(frozen=True)
class SandboxJob:
    """One function to run.

    Attributes:
        text: source that defines it, from `collect_source`.
        function: its name.
        folder: the lab's; only `given.py` and `data` are visible.
        constants: the course's, for `cohort.json`; None for the lab's own file.
        through: wrapper in `given.py`, called with the function as its first argument; empty: none.
        packages: "numpy", "scipy", "torch".
        seconds: computing time of all calls together [s]; the wall-clock limit is about twice that.
        memory_mib: limit beyond the libraries' own memory [MiB].
    """

    text: str
    function: str
    folder: Path
    constants: Mapping[str, float] | None = None
    through: str = ""
    packages: tuple[str, ...] = ("numpy",)
    seconds: float = 10.0
    memory_mib: int = 1024

    @property
    def used(self) -> tuple[str, ...]:
        """Packages that the source or `given` imports, loaded before the time limit starts."""
        given = self.folder / "given.py"
        texts = self.text + (given.read_text(encoding="utf-8") if given.is_file() else "")
        named = {name for name in self.packages if re.search(rf"\b(?:import|from) {name}\b", texts)}
        return tuple(dict.fromkeys(("numpy", *sorted(named))))


@dataclass
class _Clock:
    """Time that the worker has taken, and its limit [s]."""

    limit: float
    spent: float = 0.0
    since: float | None = None
    late: bool = False
    over: threading.Event = field(default_factory=threading.Event)

    def watch(self, end: Callable[[], None]) -> None:
        """End the process when it exceeds its limit."""
        while not self.over.wait(0.05):
            since = self.since
            if since is not None and self.spent + time.monotonic() - since > self.limit:
                self.late = True
                end()
                return


class Worker:
    """A function in another process: a context manager whose `call` calls the function.

    The process ends with the context, when it exceeds its time, and when it violates the protocol;
    every further call then raises the same StudentError.
    """

    def __init__(
        self,
        job: SandboxJob,
        process: "subprocess.Popen[bytes]",
        group: limits.ControlGroup,
        **order: Any,
    ) -> None:
        self._job, self._process, self._group = job, process, group
        self._clock, self._over, self._first = _Clock(STARTING), "", -1
        self._watch = threading.Thread(target=self._clock.watch, args=(self._kill,), daemon=True)
        self._order = {
            "packages": job.used,
            "seconds": float(job.seconds),
            "memory_mib": job.memory_mib,
            **order,
        }

    def __enter__(self) -> "Worker":
        """Start the process and run the source; errors of the source are raised by `call`.

        Raises:
            RuntimeError: the process did not start, which is not the student's fault.
        """
        self._watch.start()
        try:
            self._ask(self._order)
        except StudentError as error:
            self.close()
            advice = "run `falconwing sandbox probe`"
            raise RuntimeError(f"the sandbox did not start: {error.category}; {advice}") from None
        self._first = _first_inside(self._process.pid) if self._order["sandboxed"] else -1
        self._clock.limit, self._clock.spent = 2.0 * self._job.seconds + 5.0, 0.0
        try:
            self._ask(
                {
                    "text": self._job.text,
                    "function": self._job.function,
                    "through": self._job.through,
                }
            )
        except StudentError as error:
            self._over = error.category
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(self, *arguments: Any) -> Any:
        """Call the function.

        Args:
            arguments: numbers, texts, arrays, and tuples, lists and dicts of them.

        Returns:
            Its answer, of the same kinds, otherwise unchecked.

        Raises:
            StudentError: there is no answer.
        """
        if self._over:
            raise StudentError(self._over)
        return self._ask({"arguments": arguments})

    @property
    def process(self) -> int:
        """Process number of the worker, or of bubblewrap around it."""
        return self._process.pid

    def close(self) -> None:
        """End the process with all its children, and wait for their end."""
        self._clock.over.set()
        self._kill()
        self._process.wait()
        if self._first >= 0:  # the kernel ends all processes of the sandbox with its init process
            select.select([self._first], [], [], 10.0)
            os.close(self._first)
            self._first = -1
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                stream.close()  # type: ignore[union-attr]
        self._group.remove()

    def _ask(self, message: dict[str, Any]) -> Any:
        """Send a message and receive the reply, which must repeat the message's random number."""
        number = secrets.randbits(53)
        self._clock.since = time.monotonic()
        try:
            write_frame(self._process.stdin, {**message, "number": number})  # type: ignore[arg-type]
            reply = read_frame(self._process.stdout)  # type: ignore[arg-type]
        except FrameError:
            self._fail("bad answer")
        except (EOFError, OSError):
            self._fail(self._why_gone())
        finally:
            self._clock.spent += time.monotonic() - self._clock.since
            self._clock.since = None
        if not isinstance(reply, dict) or reply.get("number") != number or len(reply) != 2:
            self._fail("bad answer")
        if "answer" in reply:
            return reply["answer"]
        raise StudentError(_category(reply.get("error")))

    def _fail(self, category: str) -> None:
        self._kill()
        self._over = "timeout" if self._clock.late else category
        raise StudentError(self._over)

    def _why_gone(self) -> str:
        """Category of the process's end, from its exit code."""
        with suppress(subprocess.TimeoutExpired):
            code = self._process.wait(5.0)
            if code in (-_OUT_OF_TIME, 128 + _OUT_OF_TIME):
                return "timeout"
        return "memory" if self._group.out_of_memory() else "died"

    def _kill(self) -> None:
        if self._first >= 0:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._first, signal.SIGKILL)
        with suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg") and self._process.poll() is None:
                os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()


def _first_inside(bubblewrap: int) -> int:
    """Descriptor of the sandbox's init process, whose end ends all others; -1 if unavailable."""
    try:
        children = Path(f"/proc/{bubblewrap}/task/{bubblewrap}/children").read_text().split()
        return os.pidfd_open(int(children[0]))
    except (OSError, IndexError):
        return -1


def _category(name: object) -> str:
    """Category of an error by its type's name, from a fixed list."""
    special = {
        "NotImplementedError": "not written",
        "MemoryError": "memory",
        "_MissingError": "missing",
    }
    if not isinstance(name, str) or name == "bad answer":
        return "bad answer"
    return special.get(name) or (f"exception:{name}" if name in ERRORS else "exception")


def sandbox_worker(job: SandboxJob) -> Worker:
    """A worker in a bubblewrap sandbox.

    Raises:
        InputError: bubblewrap or a library is missing, or this is not Linux.
    """
    require_linux("sandbox", "apt install bubblewrap")
    own = {job.folder.resolve() / name: runtime.WORK / name for name in ("given.py", "data")}
    own |= {path: runtime.SANDBOX / path.name for path in _CODE}
    files = [os.memfd_create("cohort")]
    try:
        os.pwrite(files[0], _cohort(job), 0)
        inside = {files[0]: runtime.WORK / "cohort.json"}
        command = runtime.sandbox_command(job.packages, own, inside, _CODE[0].name)
        files += command.descriptors
        group = limits.make_group(PROCESSES + _OWN_PROCESSES, (job.memory_mib << 20) + SPARE)
        become = limits.make_preexec(group, command.staged)
        process = _start(
            command.words, {}, preexec_fn=become, pass_fds=files, start_new_session=True
        )
    finally:
        for each in files:
            os.close(each)
    return Worker(job, process, group, sandboxed=True, processes=PROCESSES, foreign=())


_OWN_PROCESSES = 8  # bubblewrap's, while it sets up the sandbox
_CODE = tuple(Path(module.__file__ or "") for module in (worker, protocol))


@contextmanager
def process_worker(job: SandboxJob) -> Iterator[Worker]:
    """A worker in a plain process with a copy of the lab's files; for trusted code only."""
    with tempfile.TemporaryDirectory(prefix="falconwing-") as name:
        work = Path(name)
        (work / "cohort.json").write_bytes(_cohort(job))
        if (job.folder / "given.py").is_file():
            shutil.copyfile(job.folder / "given.py", work / "given.py")
        if (job.folder / "data").is_dir():
            shutil.copytree(job.folder / "data", work / "data")
        words = [sys.executable, *runtime.PYTHON, str(_CODE[0]), str(work)]
        process = _start(words, os.environ | runtime.ENVIRONMENT, cwd=work, start_new_session=True)
        with Worker(
            job,
            process,
            limits.ControlGroup(()),
            sandboxed=False,
            processes=0,
            foreign=("falconwing_kit",),
        ) as worker_here:
            yield worker_here


def _start(
    words: Sequence[str], environment: Mapping[str, str], **options: Any
) -> "subprocess.Popen[bytes]":
    pipe = subprocess.PIPE
    return subprocess.Popen(
        words, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, env=environment, **options
    )


def _cohort(job: SandboxJob) -> bytes:
    """Content of `cohort.json` in this course."""
    if job.constants is not None:
        return json.dumps(dict(job.constants)).encode()
    file = job.folder / "cohort.json"
    return file.read_bytes() if file.is_file() else b"{}"
