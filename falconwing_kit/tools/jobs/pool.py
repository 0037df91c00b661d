"""Pool of processes that may be killed: items -> results; items of a lost process are repeated."""

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
MAX_ATTEMPTS = 3  # for an item whose process is lost each time


class WorkerLostError(RuntimeError):
    """An item's process ended before the result in every attempt."""


def map_in_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int = 2
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Each item with its result, in the order of completion, computed in several processes.

    A WorkerLostError replaces the result of an item after MAX_ATTEMPTS lost processes.

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
    pool = [_Worker(function) for _ in range(min(workers, len(items)))]
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

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function
        self.start()

    def start(self) -> None:
        self.assignment: list[tuple[Any, int]] = []
        context = multiprocessing.get_context("spawn")
        self.pipe, child_pipe = context.Pipe()
        self.process = context.Process(target=_serve, args=(child_pipe, self.function), daemon=True)
        self.process.start()
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
