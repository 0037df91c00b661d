"""A small pool of processes that may die: items in, results out; what a lost process was doing is taken up again."""

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
TRIES = 3  # of an item whose process is lost each time


class LostError(RuntimeError):
    """An item's process ended every time before it had a result."""


def in_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int = 2
) -> Iterator[tuple[Item, Result | LostError]]:
    """Do a function on many items, in several processes.

    Args:
        function: can be pickled; its result depends on nothing but the item.
        items: can be pickled.
        workers: processes; 1 works in this process.

    Yields:
        Each item with its result, in the order of finishing; a LostError in place of a result that three processes died
        of.

    Raises:
        Exception: what the function raised; the others' work is dropped.
    """
    if workers <= 1:
        yield from ((item, function(item)) for item in items)
        return
    todo = deque((item, 1) for item in items)
    crew = [_Hand(function) for _ in range(min(workers, len(items)))]
    try:
        while todo or any(hand.given for hand in crew):
            for hand in crew:
                if todo and not hand.given:
                    hand.give(*todo.popleft())
            for hand in _ready(crew):
                item, tries = hand.given[0]
                try:
                    raised, result = hand.take()
                except (EOFError, OSError):
                    hand.replace()
                    if tries < TRIES:
                        todo.append((item, tries + 1))
                        continue
                    raised, result = False, LostError("the process that worked on this ended three times")
                if raised:
                    raise result
                yield item, result
    finally:
        for hand in crew:
            hand.end()


class _Hand:
    """One process, and what it was given to do: nothing, or one item with how often it was tried."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function
        self.start()

    def start(self) -> None:
        self.given: list[tuple[Any, int]] = []
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self.function), daemon=True)
        self.process.start()
        theirs.close()  # so that its end is seen here when the process is lost

    def give(self, item: Any, tries: int) -> None:
        self.given = [(item, tries)]
        with suppress(OSError):  # a lost process; taking the result will say so
            self.pipe.send(item)

    def take(self) -> tuple[bool, Any]:
        reply: tuple[bool, Any] = self.pipe.recv()
        self.given = []
        return reply

    def replace(self) -> None:
        self.end()
        self.start()

    def end(self) -> None:
        self.pipe.close()
        self.process.kill()
        self.process.join()


def _ready(crew: list[_Hand]) -> list[_Hand]:
    """Those that have a result, or are lost; waits for the first."""
    ready = wait([hand.pipe for hand in crew if hand.given])
    return [hand for hand in crew if hand.given and hand.pipe in ready]


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
