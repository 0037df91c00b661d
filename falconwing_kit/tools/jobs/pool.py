"""A small pool of processes that may die: items in, results out; what a lost process was doing is
taken up again.
"""

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
MAX_ATTEMPTS = 3  # of an item whose process is lost each time


class WorkerLostError(RuntimeError):
    """An item's process ended every time before it had a result."""


def map_in_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int = 2
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Do a function on many items, in several processes.

    Args:
        function: can be pickled; its result depends on nothing but the item.
        items: can be pickled.
        workers: processes; 1 works in this process.

    Yields:
        Each item with its result, in the order of finishing; a WorkerLostError in place of a result that
        three processes died of.

    Raises:
        Exception: what the function raised; the others' work is dropped.
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
                    failed, result = (
                        False,
                        WorkerLostError("the process that worked on this ended three times"),
                    )
                if failed:
                    raise result
                yield item, result
    finally:
        for worker in pool:
            worker.stop()


class _Worker:
    """One process, and what it was given to do: nothing, or one item with how often it was tried."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function
        self.start()

    def start(self) -> None:
        self.assignment: list[tuple[Any, int]] = []
        context = multiprocessing.get_context("spawn")
        self.pipe, child_pipe = context.Pipe()
        self.process = context.Process(target=_serve, args=(child_pipe, self.function), daemon=True)
        self.process.start()
        child_pipe.close()  # so that its end is seen here when the process is lost

    def assign(self, item: Any, attempts: int) -> None:
        self.assignment = [(item, attempts)]
        with suppress(OSError):  # a lost process; taking the result will say so
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
    """Those that have a result, or are lost; waits for the first."""
    ready = wait([worker.pipe for worker in pool if worker.assignment])
    return [worker for worker in pool if worker.assignment and worker.pipe in ready]


def _serve(pipe: "Connection[Any, Any]", function: Callable[[Any], Any]) -> None:
    """In the process: do one item after the other until nobody asks any more."""
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            item = pipe.recv()
            try:
                reply = (False, function(item))
            except Exception as error:
                reply = (True, error)
            pipe.send(reply)
