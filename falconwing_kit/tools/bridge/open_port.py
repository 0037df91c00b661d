"""Port name -> trainer port or simulated board: USB hardware, simulated chip, or plain Python."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol
from warnings import warn

from falconwing_kit.core.checks import InputError
from falconwing_kit.flight.loop import Clock
from falconwing_kit.tools.bridge.python_board import Board, PythonBoard
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.ppm import Calibration
from falconwing_kit.trainer_port.usb import SerialLink

PORTS = ("sim", "sim-python")  # names of simulated boards: the firmware, and plain Python
CLOCK_ROUNDING = 1e-6  # [s]; a cycle of the chip is 62.5 ns
STEP = 0.002  # s of virtual time between two reads from the board


class Simulation(Protocol):
    """A simulated board in real time."""

    def pause(self) -> AbstractContextManager[Board]:
        """The board, to read or change it while its time is stopped."""

    def close(self) -> None:
        """End the simulation."""


def open_port(name: str, calibration: Calibration | None = None) -> TrainerPort:
    """The port of this name, in real time.

    Args:
        name: a serial port ("/dev/ttyACM0", "COM3"); "sim": the firmware in a simulated ATmega2560
            behind a pseudo-terminal, or the plain Python board, with a warning, if the tools for it
            are missing; "sim-python": that board without a pseudo-terminal.
        calibration: control inputs to microseconds; None for the shipped one.

    Returns:
        The port; its `what` describes the board, and `simulation` is the board if it is SIMULATED.

    Raises:
        InputError: the port cannot be opened, the firmware cannot be built, or this system has no
            pseudo-terminals; the message says what to do.
    """
    if name not in PORTS:
        return TrainerPort(
            SerialLink(name), calibration, reopen=lambda: SerialLink(name), what=f"board on {name}"
        )
    board = simulated_board(name)
    what = f"SIMULATED board, {board.kind}"
    if name == "sim-python":
        stepped = SteppedBoard(board)
        port = TrainerPort(stepped, calibration, what=what)
        port.simulation = stepped
        return port
    from falconwing_kit.tools.bridge.simulated_board import BoardOnPty

    line = BoardOnPty(board)
    port = TrainerPort(
        SerialLink(line.path), calibration, reopen=lambda: SerialLink(line.path), what=what
    )
    port.simulation = line
    return port


def open_paced_port(name: str, clock: Clock, calibration: Calibration | None = None) -> TrainerPort:
    """The port of a simulated board in a simulated flight's time, ready.

    Nothing is late in it on a busy machine: a slow computer slows the flight down.

    Args:
        name: one of PORTS.
        clock: of the flight, started.
        calibration: control inputs to microseconds; None for the shipped one.

    Raises:
        InputError: there is no simulated board of this name, or calibration and board do not fit.
    """
    link = SteppedBoard(simulated_board(name), clock.now)
    what = f"SIMULATED board, {link.board.kind}"
    port = TrainerPort(link, calibration, now=clock.now, what=what)
    port.simulation = link
    try:
        port.wait_ready(sleep=lambda seconds: clock.wait_until(clock.now() + seconds))
    except InputError:
        port.close()
        raise
    return port


def simulated_board(name: str) -> Board:
    """A board in virtual time: "sim", the firmware in a simulated chip; "sim-python", plain Python.

    If the tools to build the firmware are missing, plain Python replaces it, with a warning.

    Raises:
        InputError: there is no simulated board of this name, or the firmware cannot be built.
    """
    if name not in PORTS:
        raise InputError(
            f"--port {name}: expected {' or '.join(PORTS)}, a simulated board, to fly in simulation"
        )
    if name == "sim-python":
        return PythonBoard()
    from falconwing_kit.tools.bridge.build import missing_tools

    if missing := missing_tools():
        warn(
            f"the firmware cannot be simulated here, a board in {PythonBoard.kind} takes its "
            f"place; Debian or Ubuntu: apt install {' '.join(missing)}",
            stacklevel=2,
        )
        return PythonBoard()
    from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard

    return SimulatedBoard()


class SteppedBoard:
    """A board in virtual time as a link; it follows a clock whenever it is read or written.

    Args:
        board: the board; it is closed with the link.
        now: the clock [s]: the host's, or that of a simulated flight.
    """

    def __init__(self, board: Board, now: Callable[[], float] = time.perf_counter) -> None:
        self.board, self._now, self._zero = board, now, now() - board.t
        self._chunks: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        """Send bytes, at this moment."""
        self._run()
        self.board.write(data)

    def read(self) -> bytes:
        """The bytes received since the last call."""
        return b"".join(data for _, data in self.read_stamped())

    def read_stamped(self) -> list[tuple[float, bytes]]:
        """The same in chunks with their times of arrival [s], late by at most STEP."""
        self._run()
        chunks, self._chunks = self._chunks, []
        return chunks

    @contextmanager
    def pause(self) -> Iterator[Board]:
        """The board as it is now; its time advances only on reading and writing."""
        self._run()
        yield self.board

    def close(self) -> None:
        """End the simulation."""
        self.board.close()

    def _run(self) -> None:
        end = self._now() - self._zero
        while end - self.board.t > CLOCK_ROUNDING:  # a chip stops at whole cycles
            self.board.run_until(min(self.board.t + STEP, end))
            if data := self.board.read():
                self._chunks.append((self._zero + self.board.t, data))
