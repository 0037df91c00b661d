"""Sandbox side: source text and then arguments come in over a pipe, answers go out.

This file runs by its path, with `protocol.py`, NumPy and the lab's `given.py` beside it and without
the kit. Whatever the student's code does to this process, the host accepts only valid frames.
"""

import importlib
import importlib.abc
import os
import random
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO


def main() -> None:
    """Serve one function until the host closes the pipe."""
    sys.path[:0] = [str(Path(__file__).parent), *sys.argv[1:]]
    protocol = importlib.import_module("protocol")
    requests, answers = _private_pipes()
    order = protocol.read_frame(requests)
    for package in order["packages"]:
        importlib.import_module(package)
    sys.meta_path.insert(0, _Guard(order["foreign"]))
    _seed(order["packages"])
    _limit(order["seconds"], order["memory_mib"], order["processes"])
    protocol.write_frame(answers, {"number": order["number"], "answer": True})

    namespace: dict[str, Any] = {"__name__": "__main__"}
    while request := _next(protocol, requests):
        reply = {"number": request["number"]}
        try:
            reply["answer"] = _do(request, namespace)
            frame = protocol.pack(reply)
        except protocol.FrameError:
            frame = protocol.pack({"number": request["number"], "error": "bad answer"})
        except BaseException as error:  # SystemExit too: it is no answer
            reply.pop("answer", None)
            frame = protocol.pack({**reply, "error": type(error).__name__[:100]})
        answers.write(frame)
        answers.flush()


def _next(protocol: Any, requests: BinaryIO) -> dict[str, Any] | None:
    try:
        request: dict[str, Any] = protocol.read_frame(requests, protocol.MAX_HEADER)
        return request
    except EOFError:
        return None


def _do(request: dict[str, Any], namespace: dict[str, Any]) -> Any:
    """Run the source text, or call the function that it defined."""
    if "text" in request:
        exec(compile(request["text"], "notebook", "exec"), namespace)
        if not callable(namespace.get(request["function"])):
            raise _MissingError
        namespace[" function"] = namespace[request["function"]]
        if request["through"]:
            namespace[" through"] = getattr(importlib.import_module("given"), request["through"])
        return True
    if " through" in namespace:
        return namespace[" through"](namespace[" function"], *request["arguments"])
    return namespace[" function"](*request["arguments"])


class _MissingError(Exception):
    """The text does not define the function."""


class _Guard(importlib.abc.MetaPathFinder):
    """Import hook that hides packages, so that `check` has no more than the grader."""

    def __init__(self, foreign: Sequence[str]) -> None:
        self.foreign = frozenset(foreign)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> None:
        """Refuse the hidden packages by name; leave all others to Python."""
        if fullname.split(".")[0] in self.foreign:
            raise ModuleNotFoundError(f"the grader does not have {fullname}", name=fullname)


def _private_pipes() -> tuple[BinaryIO, BinaryIO]:
    """The two pipes to the host; the student's standard streams are /dev/null."""
    requests, answers = os.dup(0), os.dup(1)
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nothing, number)
    return os.fdopen(requests, "rb"), os.fdopen(answers, "wb")


def _seed(packages: Sequence[str]) -> None:
    """Seed the global generators, so that every grading draws the same numbers."""
    random.seed(0)
    sys.modules["numpy"].random.seed(0)
    if "torch" in packages:
        sys.modules["torch"].manual_seed(0)
        sys.modules["torch"].set_num_threads(1)


def _limit(seconds: float, memory_mib: int, processes: int) -> None:
    """Set kernel limits on the student's code, beyond what the loaded libraries use."""
    if sys.platform != "linux":  # elsewhere only the host's clock limits the process
        return
    import resource

    cpu_end = int(time.process_time() + seconds) + 1
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    kernel_limits = {
        resource.RLIMIT_CPU: (cpu_end, cpu_end + 1),
        resource.RLIMIT_AS: (taken + (memory_mib << 20),) * 2,
        resource.RLIMIT_FSIZE: (64 << 20,) * 2,
        resource.RLIMIT_NOFILE: (64,) * 2,
        resource.RLIMIT_CORE: (0,) * 2,
    }
    if processes:
        kernel_limits[resource.RLIMIT_NPROC] = (processes,) * 2
    for which, limits in kernel_limits.items():
        resource.setrlimit(which, limits)


if __name__ == "__main__":
    main()
