"""Pool of processes that may be killed: items -> results; items of a lost process are repeated."""

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
MAX_ATTEMPTS = 3  # for an item whose process is lost each time
THREADS = "NUMBA_NUM_THREADS"  # what the renderer takes; numba's own variable


class WorkerLostError(RuntimeError):
    """An item's process ended before the result in every attempt."""


def map_in_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int = 2
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Each item with its result, in the order of completion, computed in several processes.

    A WorkerLostError replaces the result of an item after MAX_ATTEMPTS lost processes. The
    processes share the cores: each draws images with as many threads as it has cores, unless
    NUMBA_NUM_THREADS is set.

    Args:
        function: can be pickled; its result depends on the item only.
        items: can be pickled.
        workers: number of processes; 1 computes in this process.

    Raises:
        Exception: raised by the function; the other items are abandoned.
    """
    if workers <= 1:
        yield from ((item, function(item)) for item in items)
        return
    queue = deque((item, 1) for item in items)
    count = min(workers, len(items))
    pool = [_Worker(function, max(cores() // max(count, 1), 1)) for _ in range(count)]
    try:
        while queue or any(worker.assignment for worker in pool):
            for worker in pool:
                if queue and not worker.assignment:
                    worker.assign(*queue.popleft())
            for worker in _wait_for_results(pool):
                item, attempts = worker.assignment[0]
                try:
                    failed, result = worker.receive()
                except (EOFError, OSError):
                    worker.restart()
                    if attempts < MAX_ATTEMPTS:
                        queue.append((item, attempts + 1))
                        continue
                    failed = False
                    result = WorkerLostError("the process that worked on this ended three times")
                if failed:
                    raise result
                yield item, result
    finally:
        for worker in pool:
            worker.stop()


class _Worker:
    """One process and its assignment: nothing, or one item with the number of its attempts."""

    def __init__(self, function: Callable[[Any], Any], threads: int) -> None:
        self.function, self.threads = function, threads
        self.start()

    def start(self) -> None:
        self.assignment: list[tuple[Any, int]] = []
        context = multiprocessing.get_context("spawn")
        self.pipe, child_pipe = context.Pipe()
        self.process = context.Process(target=_serve, args=(child_pipe, self.function), daemon=True)
        is_own = THREADS not in os.environ
        os.environ.setdefault(THREADS, str(self.threads))  # read by numba as the process imports it
        try:
            self.process.start()
        finally:
            if is_own:
                del os.environ[THREADS]
        child_pipe.close()  # so that the end of the process closes the pipe

    def assign(self, item: Any, attempts: int) -> None:
        self.assignment = [(item, attempts)]
        with suppress(OSError):  # a lost process; `receive` reports it
            self.pipe.send(item)

    def receive(self) -> tuple[bool, Any]:
        reply: tuple[bool, Any] = self.pipe.recv()
        self.assignment = []
        return reply

    def restart(self) -> None:
        self.stop()
        self.start()

    def stop(self) -> None:
        self.pipe.close()
        self.process.kill()
        self.process.join()


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _wait_for_results(pool: list[_Worker]) -> list[_Worker]:
    """Wait for the first result or loss; the workers that have one."""
    ready = wait([worker.pipe for worker in pool if worker.assignment])
    return [worker for worker in pool if worker.assignment and worker.pipe in ready]


def _serve(pipe: "Connection[Any, Any]", function: Callable[[Any], Any]) -> None:
    """In the process: compute one item after the other until the pipe is closed."""
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            item = pipe.recv()
            try:
                reply = (False, function(item))
            except Exception as error:
                reply = (True, error)
            pipe.send(reply)
