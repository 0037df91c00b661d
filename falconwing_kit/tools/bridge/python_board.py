"""A board in plain Python: bytes and pilot sticks in, bytes and PPM frames out, in virtual time.

It speaks the same bytes and runs the same safety rules as the firmware, with ideal edges, so that
everything above it works on a machine without AVR tools. It is NOT the firmware: what it shows says
nothing about the sketch that is flashed. SimulatedBoard runs that one, behind the same interface,
`Board`.
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
WATCHDOG_S = 0.25  # how long the program may hang before the watchdog resets the board
SEND_BUFFER = 128  # bytes waiting to be sent; a message that comes then is dropped whole
PILOT_FRAME_S = 0.022  # of the pilot's radio
PILOT_PAUSE_S = 0.0045  # a pause so long ends a pilot frame
PILOT_LEARN = 3  # like frames that tell how many slots the pilot's radio sends
PILOT_US = (800.0, 2200.0)  # a slot outside makes a pilot frame bad
POWER_ON, WATCHDOG = 0x01, 0x08  # bits of MCUSR


@dataclass(frozen=True)
class PpmFrame:
    """One frame on the PPM pin."""

    t_start: float  # its first edge [s], on the board's virtual time
    t_slots: Array  # (n,) when each slot was complete [s]
    slots_us: Array  # (n,) [us], from one pulse's first edge to the next one's
    gap_us: Array  # (n + 1,) widths of the pulses [us]
    frame_us: float  # [us] to the next frame's first edge; nan where the pulses stopped behind it


class Board(Protocol):
    """A board in virtual time: PythonBoard, or SimulatedBoard with the real firmware."""

    kind: str  # what it is, in words for the user
    t: float  # [s] since it was made; runs on over resets and power cycles

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def write(self, data: bytes) -> None:
        """Put bytes on the wire to the board; from now on they arrive at UART speed."""

    def read(self) -> bytes:
        """The bytes that have come from the board since the last call."""

    def run_until(self, t: float) -> None:
        """Let virtual time run to t [s]; nothing happens if it is there already."""

    def ppm_frames(self) -> list[PpmFrame]:
        """The frames that were completed on the pin since the last call; a frame ends where the
        next one begins.
        """

    def set_pilot(self, channels_us: Sequence[float] | None) -> None:
        """PPM on the pilot's pin from now on: (n,) [us], or None for silence."""

    def hang(self) -> None:
        """Let the board's main program hang here, as a fault in it would; the watchdog resets the
        board.
        """

    def power_cycle(self) -> None:
        """Take the power off and put it on again at once."""

    def close(self) -> None:
        """Give back what the board holds."""


class PythonBoard:
    """The board in plain Python; see the head of this file for what it is and what not.

    Not modelled: the bootloader's seconds after a reset, and time that the program needs to run.
    """

    kind = "plain Python, not the firmware"

    def __init__(
        self, config: SafetyConfig | None = None, frame_us: int = 22000, gap_us: int = 400
    ) -> None:
        """Switch on.

        Args:
            config: settings of the safety rules; None takes those that ship.
            frame_us: length of a PPM frame [us].
            gap_us: width of a gap pulse [us].
        """
        self.t = 0.0
        self._config, self._frame_s, self._gap_us = (
            config or SafetyConfig(),
            frame_us * 1e-6,
            float(gap_us),
        )
        self._event_times = {
            "byte": self._take_byte,
            "tick": self._begin_frame,
            "status": self._send_status,
            "pilot": self._pilot_edge,
            "watchdog": self._watchdog,
        }
        self._due = dict.fromkeys(self._event_times, math.inf)  # when each of them happens next [s]
        self._arriving: deque[int] = deque()  # bytes on the wire to the board
        self._leaving: deque[tuple[float, int]] = (
            deque()
        )  # bytes on the wire to the host, and when they are there
        self._frames: list[PpmFrame] = []
        self._frame: tuple[float, tuple[int, ...]] | None = (
            None  # start and slots of the frame on the pin
        )
        self._pilot_us: tuple[float, ...] | None = None
        self._pilot_frame: tuple[float, tuple[float, ...]] | None = (
            None  # start and slots of the frame coming in
        )
        self.power_cycle()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def write(self, data: bytes) -> None:
        """Put bytes on the wire to the board; from now on they arrive at UART speed."""
        if data and not self._arriving:
            self._due["byte"] = self.t + BYTE_S
        self._arriving.extend(data)

    def read(self) -> bytes:
        """The bytes that have come from the board since the last call."""
        came = bytearray()
        while self._leaving and self._leaving[0][0] <= self.t:
            came.append(self._leaving.popleft()[1])
        return bytes(came)

    def run_until(self, t: float) -> None:
        """Let virtual time run to t [s]; nothing happens if it is there already.

        Raises:
            InputError: t is not finite.
        """
        require_range("t", t)
        while True:
            event = min(self._due, key=self._due.__getitem__)
            if self._due[event] > t:
                break
            self.t = max(self.t, self._due[event])
            self._event_times[event]()
        self.t = max(self.t, t)

    def ppm_frames(self) -> list[PpmFrame]:
        """The frames that were completed on the pin since the last call; a frame ends where the
        next one begins.
        """
        frames, self._frames = self._frames, []
        return frames

    def set_pilot(self, channels_us: Sequence[float] | None) -> None:
        """PPM on the pilot's pin from now on; a frame that is on its way is finished as it began.

        Args:
            channels_us: (n,) [us], or None for silence.

        Raises:
            InputError: the slots do not fit into a frame of the pilot's radio.
        """
        slots = tuple(require_range("pilot slot", us, low=0.0) for us in channels_us or ())
        if 1e-6 * sum(slots) + PILOT_PAUSE_S > PILOT_FRAME_S:
            raise InputError(
                f"pilot: expected slots that leave a pause of 4.5 ms in a frame of 22, got {channels_us}"
            )
        self._pilot_us = slots or None
        if slots and self._due["pilot"] == math.inf:
            self._due["pilot"] = self.t

    def hang(self) -> None:
        """Let the main program hang here: nothing is read or answered, until the watchdog resets
        the board.
        """
        self._due["watchdog"] = min(self._due["watchdog"], self.t + WATCHDOG_S)
        self._due["status"] = math.inf

    def power_cycle(self) -> None:
        """Take the power off and put it on again at once: the board forgets everything."""
        self._boot_count = 0
        self._boot(POWER_ON)

    def close(self) -> None:
        """Nothing to give back; the real boards have something."""

    @property
    def _is_hung(self) -> bool:
        return self._due["watchdog"] < math.inf

    @property
    def _clock_us(self) -> int:
        """What the board's own clock says [us]: it starts with every boot and wraps."""
        return round((self.t - self._booted) * 1e6) % CLOCK

    def _boot(self, cause: int) -> None:
        """Start as after a reset; MCUSR holds the cause."""
        self._booted, self._cause, self._boot_count = self.t, cause, (self._boot_count + 1) % 256
        self._safety = Safety(self._config, watchdog_reset=cause == WATCHDOG)
        self._deframer, self._verdicts = Deframer(), dict.fromkeys(SafetyDecision, 0)
        self._sent_frames, self._pilot_rejected = 0, 0
        self._pilot_slots, self._pilot_like = (
            0,
            (0, 0),
        )  # how many were learnt; how many came, and how often in a row
        self._leaving = deque((t, byte) for t, byte in self._leaving if t <= self.t)
        self._end_frame(math.nan)
        self._due.update(tick=self.t + self._frame_s, status=self.t + STATUS_S, watchdog=math.inf)

    def _watchdog(self) -> None:
        self._boot(WATCHDOG)

    def _take_byte(self) -> None:
        """The next byte from the host is there."""
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
                self._verdicts[SafetyDecision.FORM] += (
                    1  # one of its own: the host has no business to send it
                )

    def _begin_frame(self) -> None:
        """Time for a PPM frame: ask the safety rules what goes out."""
        self._due["tick"] = self.t + self._frame_s
        slots = self._safety.tick(self._clock_us)
        self._end_frame(math.nan if slots is None else self.t)
        if slots is not None:
            self._frame = (self.t, slots)
            self._sent_frames += 1

    def _end_frame(self, t_next: float) -> None:
        """Hand out the frame on the pin, unless the board stopped in the middle of it.

        Args:
            t_next: the next frame's first edge [s]; nan where there is none.
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
        """The pilot's radio begins a frame, and so the one before it is known to be complete; or it
        fell silent.
        """
        if self._pilot_us is None:
            self._pilot_frame, self._due["pilot"] = None, math.inf
            return
        if self._pilot_frame is not None:
            self._take_pilot_frame(*self._pilot_frame)
        self._pilot_frame, self._due["pilot"] = (self.t, self._pilot_us), self.t + PILOT_FRAME_S

    def _take_pilot_frame(self, start: float, slots: tuple[float, ...]) -> None:
        """Report a pilot frame, or count it as rejected; how many slots there shall be is learnt
        from like frames.
        """
        if len(slots) > 8 or not all(PILOT_US[0] <= us <= PILOT_US[1] for us in slots):
            self._pilot_rejected += 1
            return
        like, before = self._pilot_like
        self._pilot_like = (len(slots), before + 1 if like == len(slots) else 1)
        if self._pilot_like[1] >= PILOT_LEARN and len(slots) >= 4:
            self._pilot_slots = len(slots)
        if self._pilot_slots == len(slots):
            last_edge_us = round((start - self._booted) * 1e6 + sum(slots)) % CLOCK
            self._send(
                PilotFrame(
                    last_edge_us, 0, self._pilot_rejected % 65536, tuple(round(us) for us in slots)
                )
            )
        elif self._pilot_slots:
            self._pilot_rejected += 1

    def _send_status(self) -> None:
        """Twenty times a second."""
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
            )
        )

    def _send(self, message: Message) -> None:
        """Queue a message for the host; it leaves at UART speed."""
        t = max(self.t, self._leaving[-1][0] if self._leaving else self.t)  # when the wire is free
        if not self._is_hung and t - self.t < SEND_BUFFER * BYTE_S:
            self._leaving.extend(
                (t + (i + 1) * BYTE_S, byte) for i, byte in enumerate(encode(message))
            )
