"""Board in plain Python: serial bytes, pilot channels -> bytes, PPM frames, in virtual time.

It has the protocol and the safety rules of the firmware, with ideal edges, so everything above it
works on a machine without AVR tools. It is NOT the firmware and proves nothing about the flashed
sketch: SimulatedBoard runs that, behind the same interface `Board`.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.trainer_port.protocol import (
    CommandFrame,
    Deframer,
    Message,
    PilotFrame,
    Status,
    SyncReply,
    SyncRequest,
    encode,
)
from falconwing_kit.trainer_port.safety import CLOCK, Safety, SafetyConfig, SafetyDecision

BYTE_S = 10 / 115200  # start bit, 8 bits, stop bit
STATUS_S = 1 / 20
WATCHDOG_S = 0.25  # from a hang of the program to the reset by the watchdog
SEND_BUFFER = 128  # bytes; a message that does not fit is dropped completely
PILOT_FRAME_S = 0.022  # of the pilot's radio
PILOT_PAUSE_S = 0.0045  # minimum pause at the end of a pilot frame
PILOT_LEARN = 3  # equal frames that define the number of channels of the pilot's radio
PILOT_US = (800.0, 2200.0)  # a pilot frame with a channel outside is rejected
POWER_ON, WATCHDOG = 0x01, 0x08  # bits of MCUSR


@dataclass(frozen=True)
class PpmFrame:
    """One frame on the PPM pin."""

    t_start: float  # its first edge [s], in the board's virtual time
    t_slots: Array  # (n,) end of each channel [s]
    slots_us: Array  # (n,) channels [us], from one pulse's first edge to the next one's
    gap_us: Array  # (n + 1,) widths of the pulses [us]
    frame_us: float  # [us] to the next frame's first edge; nan if the pulses stopped


class Board(Protocol):
    """A board in virtual time: PythonBoard, or SimulatedBoard with the real firmware."""

    kind: str  # description for the user
    t: float  # [s] since it was created; continues over resets and power cycles

    @property
    def led(self) -> bool:
        """Whether the LED is on: while ACTIVE."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def write(self, data: bytes) -> None:
        """Send bytes to the board; they arrive at UART speed."""

    def read(self) -> bytes:
        """The bytes received from the board since the last call."""

    def run_until(self, t: float) -> None:
        """Advance virtual time to t [s], if it is earlier."""

    def ppm_frames(self) -> list[PpmFrame]:
        """The frames completed on the pin since the last call, at the beginning of the next one."""

    def set_pilot(self, channels_us: Sequence[float] | None) -> None:
        """PPM on the pilot's pin from now on: (n,) [us], or None for silence."""

    def hang(self) -> None:
        """Stop the board's main program, as a fault would; the watchdog resets the board."""

    def power_cycle(self) -> None:
        """Switch the power off and on."""

    def close(self) -> None:
        """Release the board's resources."""


class PythonBoard:
    """The board in plain Python.

    Not modelled: the boot loader's two seconds after a reset, and the run time of the program.
    """

    kind = "plain Python, not the firmware"

    def __init__(
        self, config: SafetyConfig | None = None, frame_us: int = 22000, gap_us: int = 400
    ) -> None:
        """Switch on.

        Args:
            config: settings of the safety rules; None for the shipped ones.
            frame_us: length of a PPM frame [us].
            gap_us: width of a gap pulse [us].
        """
        self.t = 0.0
        self._config = config or SafetyConfig()
        self._frame_s, self._gap_us = frame_us * 1e-6, float(gap_us)
        self._handlers = {
            "byte": self._take_byte,
            "tick": self._begin_frame,
            "status": self._send_status,
            "pilot": self._pilot_edge,
            "watchdog": self._watchdog,
        }
        self._due = dict.fromkeys(self._handlers, math.inf)  # time of the next event [s]
        self._arriving: deque[int] = deque()  # bytes on the wire to the board
        self._leaving: deque[tuple[float, int]] = deque()  # bytes to the host: arrival time, byte
        self._frames: list[PpmFrame] = []
        # Start and channels of the frame on the PPM pin, and of the frame on the pilot's pin.
        self._frame: tuple[float, tuple[int, ...]] | None = None
        self._pilot_us: tuple[float, ...] | None = None
        self._pilot_frame: tuple[float, tuple[float, ...]] | None = None
        self.power_cycle()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def write(self, data: bytes) -> None:
        """Send bytes to the board; they arrive at UART speed."""
        if data and not self._arriving:
            self._due["byte"] = self.t + BYTE_S
        self._arriving.extend(data)

    def read(self) -> bytes:
        """The bytes received from the board since the last call."""
        received = bytearray()
        while self._leaving and self._leaving[0][0] <= self.t:
            received.append(self._leaving.popleft()[1])
        return bytes(received)

    def run_until(self, t: float) -> None:
        """Advance virtual time to t [s], if it is earlier.

        Raises:
            InputError: t is not finite.
        """
        require_range("t", t)
        while True:
            event = min(self._due, key=self._due.__getitem__)
            if self._due[event] > t:
                break
            self.t = max(self.t, self._due[event])
            self._handlers[event]()
        self.t = max(self.t, t)

    def ppm_frames(self) -> list[PpmFrame]:
        """The frames completed on the pin since the last call, at the beginning of the next one."""
        frames, self._frames = self._frames, []
        return frames

    def set_pilot(self, channels_us: Sequence[float] | None) -> None:
        """PPM on the pilot's pin after the current frame: (n,) [us], or None for silence.

        Raises:
            InputError: the channels do not fit into a frame of the pilot's radio.
        """
        slots = tuple(require_range("pilot slot", us, low=0.0) for us in channels_us or ())
        if 1e-6 * sum(slots) + PILOT_PAUSE_S > PILOT_FRAME_S:
            raise InputError(
                "pilot: expected slots that leave a pause of 4.5 ms in a frame of 22, "
                f"got {channels_us}"
            )
        self._pilot_us = slots or None
        if slots and self._due["pilot"] == math.inf:
            self._due["pilot"] = self.t

    @property
    def led(self) -> bool:
        """Whether the LED is on: while ACTIVE."""
        return self._safety.state == "ACTIVE"

    def hang(self) -> None:
        """Stop the main program: nothing is read or sent until the watchdog resets the board."""
        self._due["watchdog"] = min(self._due["watchdog"], self.t + WATCHDOG_S)
        self._due["status"] = math.inf

    def power_cycle(self) -> None:
        """Switch the power off and on: the board loses its memory."""
        self._boot_count = 0
        self._boot(POWER_ON)

    def close(self) -> None:
        """Nothing to release."""

    @property
    def _is_hung(self) -> bool:
        return self._due["watchdog"] < math.inf

    @property
    def _clock_us(self) -> int:
        """The board's own clock [us]: it starts at every boot and wraps."""
        return round((self.t - self._booted) * 1e6) % CLOCK

    def _boot(self, cause: int) -> None:
        """Start as after a reset with this cause in MCUSR."""
        self._booted, self._cause, self._boot_count = self.t, cause, (self._boot_count + 1) % 256
        self._safety = Safety(self._config, watchdog_reset=cause == WATCHDOG)
        self._deframer, self._verdicts = Deframer(), dict.fromkeys(SafetyDecision, 0)
        self._sent_frames, self._pilot_rejected = 0, 0
        self._pilot_slots = 0  # number of channels of the pilot's radio; 0 while unknown
        self._pilot_new: tuple[int, ...] | None = None  # its frame since the last tick
        self._pilot_like = (0, 0)  # channels of the last frame, and equal frames in a row
        self._leaving = deque((t, byte) for t, byte in self._leaving if t <= self.t)
        self._end_frame(math.nan)
        self._due.update(tick=self.t + self._frame_s, status=self.t + STATUS_S, watchdog=math.inf)

    def _watchdog(self) -> None:
        self._boot(WATCHDOG)

    def _take_byte(self) -> None:
        """Read the next byte from the host."""
        byte = bytes([self._arriving.popleft()])
        self._due["byte"] = self.t + BYTE_S if self._arriving else math.inf
        for message in [] if self._is_hung else self._deframer.feed(byte):
            if isinstance(message, CommandFrame):
                verdict = self._safety.frame(
                    self._clock_us, message.sequence, message.engage, message.channels_us
                )
                self._verdicts[verdict] += 1
            elif isinstance(message, SyncRequest):
                self._send(SyncReply(message.token, self._clock_us, self._clock_us))
            else:
                self._verdicts[SafetyDecision.FORM] += 1  # a message type of the board

    def _begin_frame(self) -> None:
        """Start a PPM frame with the channels from the safety rules."""
        self._due["tick"] = self.t + self._frame_s
        slots = self._safety.tick(self._clock_us, self._pilot_new)
        self._pilot_new = None
        self._end_frame(math.nan if slots is None else self.t)
        if slots is not None:
            self._frame = (self.t, slots)
            self._sent_frames += 1

    def _end_frame(self, t_next: float) -> None:
        """Complete the frame on the pin, unless the board stopped within it.

        Args:
            t_next: the next frame's first edge [s]; nan without one.
        """
        if self._frame is None:
            return
        (t_start, slots), self._frame = self._frame, None
        t_slots = t_start + 1e-6 * np.cumsum(slots)
        if self.t >= t_slots[-1] + 1e-6 * self._gap_us:
            gaps = np.full(len(slots) + 1, self._gap_us)
            us = np.array(slots, dtype=np.float64)
            self._frames.append(PpmFrame(t_start, t_slots, us, gaps, (t_next - t_start) * 1e6))

    def _pilot_edge(self) -> None:
        """Start of a pilot frame, which completes the previous one; or silence."""
        if self._pilot_us is None:
            self._pilot_frame, self._due["pilot"] = None, math.inf
            return
        if self._pilot_frame is not None:
            self._take_pilot_frame(*self._pilot_frame)
        self._pilot_frame, self._due["pilot"] = (self.t, self._pilot_us), self.t + PILOT_FRAME_S

    def _take_pilot_frame(self, start: float, slots: tuple[float, ...]) -> None:
        """Report a pilot frame or reject it; equal frames define the number of channels."""
        if len(slots) > 8 or not all(PILOT_US[0] <= us <= PILOT_US[1] for us in slots):
            self._pilot_rejected += 1
            return
        like, before = self._pilot_like
        self._pilot_like = (len(slots), before + 1 if like == len(slots) else 1)
        if self._pilot_like[1] >= PILOT_LEARN and len(slots) >= 4:
            self._pilot_slots = len(slots)
        if self._pilot_slots == len(slots):
            last_edge_us = round((start - self._booted) * 1e6 + sum(slots)) % CLOCK
            channels_us = self._pilot_new = tuple(round(us) for us in slots)
            self._send(PilotFrame(last_edge_us, 0, self._pilot_rejected % 65536, channels_us))
        elif self._pilot_slots:
            self._pilot_rejected += 1

    def _send_status(self) -> None:
        """Send a STATUS and schedule the next one."""
        self._due["status"] = self.t + STATUS_S
        safety, count = self._safety, self._verdicts
        self._send(
            Status(
                state=safety.state,
                fault=safety.fault,
                boot_count=self._boot_count,
                reset_cause=self._cause,
                last_sequence=safety.last_sequence or 0,
                accepted=count[SafetyDecision.ACCEPTED] % 2**32,
                bad_frames=(self._deframer.bad + count[SafetyDecision.FORM]) % 65536,
                bad_sequence=count[SafetyDecision.SEQUENCE] % 65536,
                out_of_range=count[SafetyDecision.RANGE] % 65536,
                ppm_frames=self._sent_frames % 2**32,
                silent=safety.silent,
                channels_us=safety.slots_us,
                device_time_us=self._clock_us,
                engages_without_pilot=bool(self._config.engage_without_pilot),
                has_pilot=safety.has_pilot,
                pilot_took_over=safety.pilot_took_over,
            )
        )

    def _send(self, message: Message) -> None:
        """Queue a message for the host, at UART speed."""
        t = max(self.t, self._leaving[-1][0] if self._leaving else self.t)  # the wire is free
        if not self._is_hung and t - self.t < SEND_BUFFER * BYTE_S:
            self._leaving.extend(
                (t + (i + 1) * BYTE_S, byte) for i, byte in enumerate(encode(message))
            )
