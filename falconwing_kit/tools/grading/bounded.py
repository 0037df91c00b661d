"""Bounded call: a function and its limits -> its result from a child process, or TooMuchError.

Python's parser has inputs on which its time and memory are quadratic or worse, so no limit of a
notebook's size alone bounds what reading its code costs. The kernel's limits do.
"""

import gc
import json
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

MAX_RESULT = 64 << 20  # bytes of a result


class TooMuchError(Exception):
    """A function took more time or memory than it may."""


def call_bounded(function: Callable[[], Any], seconds: float, memory_mib: int) -> Any:
    """Call a function of the kit in a child process with limits of its own.

    Args:
        function: the kit's own code, on data that are not trusted; its result is numbers, texts,
            and lists and dicts of them.
        seconds: limit of the child's computing time [s], rounded up.
        memory_mib: limit beyond the memory of this process [MiB].

    Returns:
        The function's result. Where processes cannot fork (Windows), it is called here, unbounded.

    Raises:
        TooMuchError: the child ended without a result, or the result is too large.
    """
    if not hasattr(os, "fork"):
        return function()
    reading, writing = os.pipe()
    with warnings.catch_warnings():  # of threads, which the child does not use
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        os.close(reading)
        _answer(function, writing, seconds, memory_mib)
    os.close(writing)
    try:
        with os.fdopen(reading, "rb") as pipe:
            data = pipe.read(MAX_RESULT + 1)
    finally:
        os.kill(child, signal.SIGKILL)  # still ours until waited for; it may be writing
        os.waitpid(child, 0)
    if not data.endswith(b"\n"):
        raise TooMuchError
    return json.loads(data)


def _answer(function: Callable[[], Any], writing: int, seconds: float, memory_mib: int) -> NoReturn:
    """The child's part: set the limits, write the result and a line's end, and leave."""
    gc.disable()  # it would write to, and so copy, every page that the child shares
    try:
        _limit(seconds, memory_mib)
        text = json.dumps(function()).encode() + b"\n"
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(text)
    finally:
        os._exit(0)


def _limit(seconds: float, memory_mib: int) -> None:
    import resource

    most = math.ceil(seconds)
    resource.setrlimit(resource.RLIMIT_CPU, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (taken + (memory_mib << 20),) * 2)
