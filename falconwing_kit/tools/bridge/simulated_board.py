"""Simulated board: the real firmware in a simulated ATmega2560, with serial bytes and PPM frames.

libsimavr simulates the chip cycle by cycle, behind a small C library (firmware/sim/simavr_shim.c
lists its differences from silicon). Time is virtual and advances only in `run_until`: a test is
exact, repeatable and faster than real time. `BoardOnPty` connects a board to the wall clock and to
a serial port that any program can open.
"""

import ctypes
import math
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.bridge.build import build_firmware, build_simulator
from falconwing_kit.tools.bridge.python_board import Board, PpmFrame

CLOCK_HZ = 16_000_000
CYCLES_PER_US = CLOCK_HZ // 1_000_000
SYNC_CYCLES = 3000 * CYCLES_PER_US  # minimum pause between frames; a channel is 2.1 ms at most
LOST_CYCLES = 40_000 * CYCLES_PER_US  # after a longer time without a frame the pulses have stopped
# The pilot's simulated radio, idle high.
PILOT_FRAME_US, PILOT_GAP_US, PILOT_PAUSE_US = 22_000, 400, 4000
STEP = 0.002  # s between two reads from the board
BUFFER_BYTES = 4096  # bytes or edges read from the simulator per call


class SimulatedBoard:
    """The firmware, as flashed, in a simulated ATmega2560.

    Args:
        elf: the program; None builds the kit's.
        seed: of the random content of the chip's memory at power-on.

    Raises:
        InputError: a tool is missing (the message names the package), or the file is no program
            for this chip.
    """

    kind = "the firmware in a simulated ATmega2560"

    def __init__(self, elf: Path | None = None, *, seed: int = 1) -> None:
        self._sim, self._seed = _library(), seed
        self._elf = build_firmware() if elf is None else elf
        self.t = 0.0  # s since it was created; continues over resets and power cycles
        self._past = 0  # cycles before the last power-on
        self._pilot: tuple[float, ...] = ()  # channels [us]; empty for silence
        self._chip: int | None = None  # handle of the simulator
        self._edges: list[int] = []  # cycles, of the incomplete frame
        self._at_start = False  # whether the first of them begins a frame
        self._max_edges = 4  # largest number of edges in a frame so far; no frame has fewer than 4
        self._pilot_next = 0  # cycle at which the pilot's next frame may begin
        self._switch_on()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, data: bytes) -> None:
        """Send bytes to the board; they arrive one by one at 115200 8N1, after earlier ones."""
        self._sim.sim_send(self._handle, 0, data, len(data))

    def read(self) -> bytes:
        """The bytes received from the board since the last call."""
        buffer, received = ctypes.create_string_buffer(BUFFER_BYTES), b""
        while count := self._sim.sim_receive(self._handle, buffer, BUFFER_BYTES):
            received += buffer.raw[:count]
        return received

    def run_until(self, t: float) -> None:
        """Advance virtual time to t [s], if it is earlier.

        Raises:
            InputError: t is not finite.
            RuntimeError: the program crashed or went to sleep permanently.
        """
        until = round(require_range("t", t) * CLOCK_HZ) - self._past
        self._drive_pilot(until)
        state = self._sim.sim_run(self._handle, until) if until > 0 else 0
        self.t = (self._past + int(self._sim.sim_cycle(self._handle))) / CLOCK_HZ
        if state:
            text = self._sim.sim_error().decode(errors="replace").strip()
            raise RuntimeError(
                f"{self._elf.name}: the program stopped at {self.t:.6f} s (state {state}): {text}"
            )

    def ppm_frames(self) -> list[PpmFrame]:
        """The frames completed on the pin since the last call, at the beginning of the next one."""
        at, levels = np.empty(BUFFER_BYTES, np.uint64), np.empty(BUFFER_BYTES, np.uint8)
        while count := self._sim.sim_take_edges(self._handle, at, levels, BUFFER_BYTES):
            self._edges += at[:count].tolist()
        # A long pause between two edges separates frames; the last frame stays incomplete.
        edges = np.array(self._edges, dtype=np.int64)
        starts = [
            *range(self._at_start and len(edges) > 0),
            *(np.flatnonzero(np.diff(edges) > SYNC_CYCLES) + 1),
        ]
        frames = [self._frame(edges[a:b], int(edges[b])) for a, b in pairwise(starts)]
        if starts:
            self._edges, self._at_start = edges[starts[-1] :].tolist(), True
            now = int(self._sim.sim_cycle(self._handle))
            if now - self._edges[0] > LOST_CYCLES:
                frames.append(self._frame(edges[starts[-1] :], now))
                self._edges = []
        return [frame for frame in frames if frame is not None]

    @property
    def led(self) -> bool:
        """Whether the LED on pin 13 is on."""
        return bool(self._sim.sim_led(self._handle))

    def set_pilot(self, channels_us: Sequence[float] | None) -> None:
        """PPM on the pilot's pin after the current frame: (n,) [us], or None for silence.

        Raises:
            InputError: the channels do not fit into a frame of the pilot's radio.
        """
        slots = () if channels_us is None else tuple(channels_us)
        for us in slots:
            require_range("pilot slot", us, low=2 * PILOT_GAP_US)
        if sum(slots) + PILOT_PAUSE_US > PILOT_FRAME_US:
            raise InputError(
                "pilot: expected slots that fit into a frame of 22 ms with a pause of 4, "
                f"got {channels_us}"
            )
        self._pilot = slots

    def hang(self) -> None:
        """Stop the main program: the first instruction of loop() becomes a jump to itself.

        Interrupts continue. The change is in the simulated flash memory and lasts until a reset.

        Raises:
            InputError: the program's symbol table has no loop().
        """
        if self._sim.sim_stop(self._handle, 0):
            raise InputError(
                f"{self._elf.name}: expected a program with a function loop(), "
                "its symbol table has none"
            )

    def reset(self) -> None:
        """Reset, as opening the port of a real board does; the memory keeps its content."""
        self._sim.sim_reset(self._handle)

    def power_cycle(self) -> None:
        """Switch the power off and on: the board loses its memory."""
        self._past += int(self._sim.sim_cycle(self._handle))
        self.close()
        self._seed += 1
        self._switch_on()

    def close(self) -> None:
        """Release the simulator's memory; the board cannot be used afterwards."""
        if self._chip is not None:
            self._sim.sim_close(self._chip)
        self._chip = None

    def _switch_on(self) -> None:
        self._chip = self._sim.sim_open(os.fsencode(self._elf), self._seed)
        if self._chip is None:
            text = self._sim.sim_error().decode(errors="replace").strip()
            raise InputError(
                f"{self._elf.name}: expected a program for the ATmega2560, got: {text}; "
                "build it again"
            )
        self._edges, self._at_start, self._pilot_next = [], False, 0

    @property
    def _handle(self) -> int:
        if self._chip is None:
            raise RuntimeError("simulated board: it was closed; make another one")
        return self._chip

    def _drive_pilot(self, until: int) -> None:
        """Drive the pilot's pin with the frames that begin before a cycle."""
        self._pilot_next = max(self._pilot_next, int(self._sim.sim_cycle(self._handle)) + 1)
        while self._pilot and self._pilot_next < until:
            pulses = PILOT_GAP_US * np.arange(2) + np.cumsum([0.0, *self._pilot])[:, None]
            at = self._pilot_next + np.round(pulses.ravel() * CYCLES_PER_US).astype(np.uint64)
            self._sim.sim_drive_pilot(
                self._handle, at, np.arange(len(at), dtype=np.uint8) % 2, len(at)
            )
            self._pilot_next += PILOT_FRAME_US * CYCLES_PER_US

    def _frame(self, edges: NDArray[np.int64], end: int) -> PpmFrame | None:
        """A frame from its edges and the next one's first; None if edges are missing (a reset)."""
        self._max_edges = max(self._max_edges, len(edges))
        if len(edges) < self._max_edges or len(edges) % 2:
            return None
        # Even edges begin a pulse, odd ones end it.
        seconds, us = (edges + self._past) / CLOCK_HZ, edges / CYCLES_PER_US
        stopped = end - edges[0] > LOST_CYCLES
        return PpmFrame(
            t_start=float(seconds[0]),
            t_slots=seconds[2::2],
            slots_us=np.diff(us[::2]),
            gap_us=us[1::2] - us[::2],
            frame_us=math.nan if stopped else float(end / CYCLES_PER_US - us[0]),
        )


class BoardOnPty:
    """A board in real time, behind a pseudo-terminal that opens like a serial port (POSIX only).

    A thread advances the board and transfers bytes both ways, with a delay of about a millisecond.
    Other threads use the board through `with line.pause() as board`.

    Args:
        board: a board in virtual time; it is closed with the line.

    Raises:
        InputError: this system has no pseudo-terminals.
    """

    def __init__(self, board: Board) -> None:
        try:
            import pty
            import tty
        except ImportError:
            raise InputError(
                "port: expected a system with pseudo-terminals for a simulated board, got Windows; "
                "take --port sim-python"
            ) from None
        self._board, self._lock, self._open = board, threading.Lock(), True
        # The slave stays open here, so the line survives its user's close.
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.worst_lag = 0.0  # maximum lag behind the wall clock [s]
        self.error: Exception | None = None  # that stopped the simulation
        self._zero = time.perf_counter() - board.t
        self._thread = threading.Thread(target=self._run, name=f"runs {self.path}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def pause(self) -> Iterator[Board]:
        """The board with its time stopped; it catches up afterwards."""
        with self._lock:
            yield self._board

    def ppm_frames(self) -> list[PpmFrame]:
        """The board's `ppm_frames`."""
        with self._lock:
            return self._board.ppm_frames()

    def to_host_time(self, t: float) -> float:
        """A time of the board [s] on the clock of `time.perf_counter` [s]."""
        return self._zero + t

    def close(self) -> None:
        """Stop the thread, close the line and the board."""
        self._open = False
        self._thread.join()
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
            self._board.close()
        self._master = -1

    def _run(self) -> None:
        import select

        while self._open:
            ready, _, _ = select.select([self._master], [], [], STEP)
            now = time.perf_counter() - self._zero
            try:
                with self._lock:
                    self._board.run_until(now)
                    if ready:
                        self._board.write(os.read(self._master, BUFFER_BYTES))
                    received = self._board.read()
                if received:
                    with suppress(BlockingIOError):  # without a reader bytes are lost, as on USB
                        os.write(self._master, received)
            except (OSError, RuntimeError) as error:
                self.error = error
                return
            self.worst_lag = max(self.worst_lag, time.perf_counter() - self._zero - now)


def _library() -> ctypes.CDLL:
    """The simulator, built if necessary."""
    sim = ctypes.CDLL(str(build_simulator()))
    board, size, cycles = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_uint64
    at, levels = np.ctypeslib.ndpointer(np.uint64), np.ctypeslib.ndpointer(np.uint8)
    functions: dict[str, tuple[object, list[object]]] = {
        "sim_open": (board, [ctypes.c_char_p, ctypes.c_uint32]),
        "sim_close": (None, [board]),
        "sim_run": (ctypes.c_int, [board, cycles]),
        "sim_error": (ctypes.c_char_p, []),
        "sim_cycle": (cycles, [board]),
        "sim_pin": (ctypes.c_int, [board]),
        "sim_led": (ctypes.c_int, [board]),
        "sim_counter": (ctypes.c_uint32, [board, ctypes.c_int]),
        "sim_send": (None, [board, ctypes.c_int, ctypes.c_char_p, size]),
        "sim_receive": (size, [board, ctypes.c_char_p, size]),
        "sim_drive_pilot": (None, [board, at, levels, size]),
        "sim_take_edges": (size, [board, at, levels, size]),
        "sim_stop": (ctypes.c_int, [board, ctypes.c_int]),
        "sim_peek": (ctypes.c_int, [board, ctypes.c_uint16]),
        "sim_flip": (None, [board, ctypes.c_uint16, ctypes.c_uint8]),
        "sim_reset": (None, [board]),
    }
    for name, (result, arguments) in functions.items():
        function = getattr(sim, name)
        function.restype, function.argtypes = result, arguments
    return sim
