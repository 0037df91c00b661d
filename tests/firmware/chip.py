"""Test bench for the simulated chip: probes on pins and counters, and the host's side."""

import os
from collections.abc import Sequence

import numpy as np
import pytest

from falconwing_kit.tools.bridge.build import missing_tools
from falconwing_kit.tools.bridge.simulated_board import CLOCK_HZ, SimulatedBoard
from falconwing_kit.trainer_port.protocol import Deframer, Status, encode_channels

BYTE = 10 / 115200  # s: start bit, eight bits, stop bit
COMMAND_BYTES = 16  # four channels: 14, one of COBS, the zero
LOOP = 0.05  # s between two commands
SAFE = (1000, 1500, 1500, 1500)
FLOWN = (1250, 1600, 1400, 1500)  # within one slew step of SAFE, so one frame reaches it


def require_tools() -> None:
    """Skip where the chip's tools are missing, but fail in CI: there they have to be."""
    if missing := missing_tools():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(
            f"expected Debian's {' '.join(missing)} for a simulated chip"
        )


class ProbedBoard(SimulatedBoard):
    """A simulated board with access to its pins and to the simulator's counters."""

    def write_spektrum(self, data: bytes) -> None:
        """Send bytes on the line of a Spektrum remote receiver (Serial1, pin 19)."""
        self._sim.sim_send(self._handle, 1, data, len(data))

    def drive_pilot_pin(self, t: Sequence[float], levels: Sequence[int]) -> None:
        """Edges on the pilot's pin: (n,) increasing future times [s], and the levels after them."""
        at = np.array([round(when * CLOCK_HZ) - self._past for when in t], dtype=np.uint64)
        self._sim.sim_drive_pilot(self._handle, at, np.array(levels, dtype=np.uint8), len(at))

    def stop_pulses(self) -> None:
        """From now on Timer1's interrupt does nothing; a reset ends it."""
        self._sim.sim_stop(self._handle, 1)

    def flip(self, address: int, bit: int) -> None:
        """Turn over one bit of memory, or of a register."""
        self._sim.sim_flip(self._handle, address, bit)

    def peek(self, address: int) -> int:
        """A byte of memory, or a register."""
        return int(self._sim.sim_peek(self._handle, address))

    @property
    def pin_level(self) -> int:
        """Level of the PPM pin, 0 or 1."""
        return int(self._sim.sim_pin(self._handle))

    @property
    def artefacts(self) -> int:
        """Toggles of the PPM pin by libsimavr at wraps of Timer1, unlike silicon; in no frame."""
        return int(self._sim.sim_counter(self._handle, 0))

    @property
    def overruns(self) -> int:
        """Bytes to the board that were lost because its program did not read them in time."""
        return int(self._sim.sim_counter(self._handle, 1))

    @property
    def watchdog_resets(self) -> int:
        """Number of resets of the chip by its watchdog."""
        return int(self._sim.sim_counter(self._handle, 2))


class Bench:
    """A board and a host's side of its line.

    Args:
        board: switched on.
    """

    def __init__(self, board: ProbedBoard) -> None:
        self.board, self.messages, self.sequence = board, [], 0
        self._deframer = Deframer()
        self.wait(0.1)

    def wait(self, seconds: float) -> None:
        """Let time pass and take what the board sends."""
        self.board.run_until(self.board.t + seconds)
        self.messages += self._deframer.feed(self.board.read())

    def send(self, channels_us=FLOWN, engage=True) -> float:
        """A command with the next sequence number; when its last byte will have arrived [s], the
        line being idle.
        """
        self.sequence = (self.sequence + 1) % 65536
        return self.send_raw(encode_channels(self.sequence, channels_us, engage))

    def send_raw(self, data: bytes) -> float:
        """Bytes as they are; when the last one will have arrived [s], the line being idle."""
        self.board.write(data)
        return self.board.t + len(data) * BYTE

    def fly(self, loops: int, channels_us=FLOWN, engage=True) -> float:
        """So many commands, one every 50 ms; when the last one had arrived [s]."""
        for _ in range(loops):
            arrived = self.send(channels_us, engage)
            self.wait(LOOP)
        return arrived

    def engage(self) -> float:
        """Hand back, the edge and five commands at idle and neutral, then FLOWN; ACTIVE afterwards.
        When the last command had arrived [s].
        """
        self.fly(1, SAFE, engage=False)
        self.fly(5, SAFE)
        arrived = self.fly(2)
        assert self.status().state == "ACTIVE"
        return arrived

    def status(self) -> Status:
        """The newest STATUS, not older than 50 ms."""
        self.wait(0.055)
        return [message for message in self.messages if isinstance(message, Status)][-1]


def slots(frames) -> np.ndarray:
    """(frames, n) [us]."""
    return np.array([frame.slots_us for frame in frames])


def is_safe(frame) -> bool:
    """Throttle idle, the others neutral, to a microsecond."""
    return bool(np.abs(frame.slots_us - SAFE).max() <= 1.0)
