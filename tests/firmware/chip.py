"""A bench for the simulated chip: a board that is engaged, fed and asked as a host does it, in
virtual time.
"""

import os

import numpy as np
import pytest

from falconwing_kit.tools.bridge.build import missing_tools
from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard
from falconwing_kit.trainer_port.protocol import Deframer, Status, encode_channels

BYTE = 10 / 115200  # s: start bit, eight bits, stop bit
COMMAND_BYTES = 16  # four channels: 14, one of COBS, the zero
LOOP = 0.05  # s between two commands
SAFE = (1000, 1500, 1500, 1500)
FLOWN = (
    1250,
    1600,
    1400,
    1500,
)  # within one slew of SAFE in every slot, so that one frame goes all the way


def require_tools() -> None:
    """Skip where the chip's tools are missing, but fail in CI: there they have to be."""
    if missing := missing_tools():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(
            f"expected Debian's {' '.join(missing)} for a simulated chip"
        )


class Bench:
    """A board and a host's side of its line.

    Args:
        board: switched on.
    """

    def __init__(self, board: SimulatedBoard) -> None:
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
        """Hand back, then the edge and five commands; ACTIVE afterwards. When the last command had
        arrived [s].
        """
        self.fly(1, SAFE, engage=False)
        arrived = self.fly(6)
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
