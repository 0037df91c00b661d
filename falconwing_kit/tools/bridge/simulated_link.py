"""Simulated boards in real time: the firmware in a simulated chip behind a pseudo-terminal, or
plain Python.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol
from warnings import warn

from falconwing_kit.tools.bridge.python_board import Board, PythonBoard

STEP = 0.002  # s of virtual time between two looks at what the board sent


class Simulation(Protocol):
    """A simulated board that time runs on for by itself."""

    def pause(self) -> AbstractContextManager[Board]:
        """The board, for a look or a change, while its time stands."""

    def close(self) -> None:
        """End the simulation."""


def open_simulation(name: str) -> tuple[Simulation, str, str]:
    """A simulated board in step with the host's clock.

    Args:
        name: "sim" for the firmware in a simulated chip, behind a pseudo-terminal; where the tools
            to build it are missing, plain Python there, and a warning. "sim-python" for plain
            Python without a pseudo-terminal.

    Returns:
        The board; the path of its serial port, "" where it has none and is a link itself; what it
        is, in words.

    Raises:
        InputError: the firmware cannot be built, or this system has no pseudo-terminals.
    """
    if name == "sim-python":
        return SteppedBoard(PythonBoard()), "", PythonBoard.kind
    from falconwing_kit.tools.bridge.build import missing_tools
    from falconwing_kit.tools.bridge.simulated_board import BoardOnPty, SimulatedBoard

    missing = missing_tools()
    if missing:
        warn(
            f"the firmware cannot be simulated here, a board in {PythonBoard.kind} takes its place; "
            f"Debian or Ubuntu: apt install {' '.join(missing)}",
            stacklevel=2,
        )
    board: Board = PythonBoard() if missing else SimulatedBoard()
    line = BoardOnPty(board)
    return line, line.path, board.kind


class SteppedBoard:
    """A board of virtual time as a link, run along with a clock whenever somebody reads or writes.

    Args:
        board: the board; it is closed with the link.
        now: the clock [s]: the host's, or the one of a simulated flight.
    """

    def __init__(self, board: Board, now: Callable[[], float] = time.perf_counter) -> None:
        self.board, self._now, self._zero = board, now, now() - board.t
        self._chunks: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        """Send bytes, at this moment."""
        self._run()
        self.board.write(data)

    def read(self) -> bytes:
        """What has come since the last call."""
        return b"".join(data for _, data in self.read_stamped())

    def read_stamped(self) -> list[tuple[float, bytes]]:
        """The same with the times they came [s], late by at most STEP."""
        self._run()
        chunks, self._chunks = self._chunks, []
        return chunks

    @contextmanager
    def pause(self) -> Iterator[Board]:
        """The board as it is now; its time runs only while somebody reads or writes."""
        self._run()
        yield self.board

    def close(self) -> None:
        """End the simulation."""
        self.board.close()

    def _run(self) -> None:
        end = self._now() - self._zero
        while self.board.t < end:
            self.board.run_until(min(self.board.t + STEP, end))
            if data := self.board.read():
                self._chunks.append((self._zero + self.board.t, data))
