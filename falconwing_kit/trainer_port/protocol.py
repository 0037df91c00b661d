"""Serial protocol of the trainer port: messages <-> frames of bytes, and a stream of bytes ->
messages.

A frame is COBS(payload + CRC-16) and one zero byte, little endian, 115200 8N1. The payload's first
byte is its type:

    host -> board    COMMAND 0x01   u16 sequence | u8 flags (bit 0 engage) | 4..8 x u16 channel [us]
                     SYNC    0x02   u32 token
    board -> host    STATUS  0x11   20 times a second: state, counters and what is in the PPM frame now
                     PILOT   0x12   for each good frame of the pilot's radio
                     SYNC_REPLY 0x13   u32 token | u32 time received | u32 time queued

COBS (consistent overhead byte stuffing, Cheshire and Baker 1999) takes the zeros out of the
payload, so that a zero ends a frame and nothing else does: after any garbage, the next zero brings
both sides back into step.
"""

import binascii
import operator
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command
from falconwing_kit.trainer_port.ppm import Calibration, shipped_calibration

VERSION = 1
STATES = ("BOOT", "SAFE", "ACTIVE", "LOST", "FAULT")
FAULTS = ("none", "range", "stall", "configuration")
RESET_CAUSES = (
    "power-on",
    "reset pin",
    "brown-out",
    "watchdog",
    "JTAG",
)  # bits 0..4 of MCUSR, ATmega2560 data sheet
PILOT_SOURCES = ("PPM", "Spektrum serial")
COMMAND, SYNC, STATUS, PILOT, SYNC_REPLY = 0x01, 0x02, 0x11, 0x12, 0x13
MIN_CHANNELS, MAX_CHANNELS = 4, 8
MAX_FRAME = 64  # bytes before the zero; the longest frame of version 1 has 47

_HEADS = {
    COMMAND: struct.Struct("<BHB"),
    SYNC: struct.Struct("<BI"),
    STATUS: struct.Struct("<BBIBBBBHIHHHIBB"),
    PILOT: struct.Struct("<BIBHB"),
    SYNC_REPLY: struct.Struct("<BIII"),
}


@dataclass(frozen=True)
class CommandFrame:
    """Host -> board: what the PPM slots shall be."""

    sequence: int  # 0..65535, advances with every command
    engage: bool  # True: the host wants to fly; False: hand back
    channels_us: tuple[int, ...]  # (4..8,) [us], in the order of the PPM slots


@dataclass(frozen=True)
class SyncRequest:
    """Host -> board: what does your clock say?"""

    token: int  # the host's clock, low 32 bits of its microseconds


@dataclass(frozen=True)
class Status:
    """Board -> host, 20 times a second. Counters wrap at their width and start at zero with every
    boot.
    """

    state: str  # one of STATES
    fault: str  # one of FAULTS
    boot_count: int  # 0..255, since the board was switched on
    reset_cause: int  # MCUSR at boot, see `reset_causes`
    last_sequence: int  # of the last command that was accepted
    accepted: int  # commands accepted
    bad_frames: int  # frames with a bad CRC or form
    bad_sequence: int  # commands whose sequence did not advance
    out_of_range: int  # commands with a channel outside 900..2100 us
    ppm_frames: int  # frames sent to the radio
    silent: bool  # True: no pulses
    channels_us: tuple[int, ...]  # (4..8,) [us], in the PPM frame now
    device_time_us: int  # the board's clock [us], wraps after 71 minutes
    version: int = VERSION

    @property
    def reset_causes(self) -> tuple[str, ...]:
        """What made the board boot, in words."""
        return tuple(name for bit, name in enumerate(RESET_CAUSES) if self.reset_cause >> bit & 1)


@dataclass(frozen=True)
class PilotFrame:
    """Board -> host: one good frame of the pilot's radio."""

    device_time_us: int  # when its last edge came [us], board's clock
    source: int  # index into PILOT_SOURCES
    rejected: int  # pilot frames rejected so far
    channels_us: tuple[int, ...]  # (1..8,) [us]


@dataclass(frozen=True)
class SyncReply:
    """Board -> host: the answer to a SyncRequest."""

    token: int  # as it was asked
    received_us: int  # when the request's last byte was read [us], board's clock
    sent_us: int  # when this reply was queued [us], board's clock


Message = CommandFrame | SyncRequest | Status | PilotFrame | SyncReply


def encode_command(
    sequence: int,
    throttle: float,
    aileron: float,
    elevator: float,
    rudder: float,
    engage: bool,
    calibration: Calibration | None = None,
) -> bytes:
    """One COMMAND as a serial frame, from stick positions.

    Args:
        sequence: a whole number from 0; its low 16 bits are sent.
        throttle: 0..1, cut to its limits.
        aileron: -1..1, positive right wing down, cut to its limits.
        elevator: -1..1, positive nose up, cut to its limits.
        rudder: -1..1, positive nose right, cut to its limits.
        engage: True to fly, False to hand back.
        calibration: sticks to microseconds; None takes the one that ships,
            hardware/trainer_port.toml.

    Returns:
        The frame with its zero byte.

    Raises:
        InputError: a stick is not finite, the sequence is not a whole number from 0, or engage is
            not a yes or no.
    """
    calibration = calibration or shipped_calibration()
    command = Command.clip(throttle, aileron, elevator, rudder)
    return encode_channels(sequence, calibration.channels_us(command), engage)


def encode_channels(sequence: int, channels_us: Sequence[int], engage: bool) -> bytes:
    """One COMMAND as a serial frame, from microseconds; nothing is cut, the board judges them.

    Args:
        sequence: a whole number from 0; its low 16 bits are sent.
        channels_us: (4..8,) whole numbers 0..65535 [us], in the order of the PPM slots.
        engage: True to fly, False to hand back.

    Returns:
        The frame with its zero byte.

    Raises:
        InputError: an argument is not as said above.
    """
    low_bits = _require_whole("sequence", sequence) & 0xFFFF
    if not isinstance(engage, (bool, np.bool_)) and engage not in (0, 1):
        raise InputError(f"engage: expected True or False, got {engage!r}")
    return encode(CommandFrame(low_bits, bool(engage), tuple(channels_us)))


def encode_sync(token: int) -> bytes:
    """One SYNC as a serial frame.

    Args:
        token: the host's clock [us], a whole number from 0; its low 32 bits are sent.

    Raises:
        InputError: the token is not a whole number from 0.
    """
    return encode(SyncRequest(_require_whole("token", token) & 0xFFFFFFFF))


def encode(message: Message) -> bytes:
    """Any message as a serial frame with its zero byte, the inverse of `decode`.

    Raises:
        InputError: it is no message, a number does not fit into its field, or there are too many or
            too few channels.
    """
    match message:
        case CommandFrame():
            _require_count(len(message.channels_us), MIN_CHANNELS, MAX_CHANNELS)
            head: tuple[Any, ...] = (COMMAND, message.sequence, int(message.engage))
        case SyncRequest():
            return _build_frame(SYNC, (SYNC, message.token))
        case Status():
            _require_count(len(message.channels_us), MIN_CHANNELS, MAX_CHANNELS)
            head = _status_fields(message)
        case PilotFrame():
            _require_count(len(message.channels_us), 1, MAX_CHANNELS)
            count = len(message.channels_us)
            head = (PILOT, message.device_time_us, message.source, message.rejected, count)
        case SyncReply():
            return _build_frame(
                SYNC_REPLY, (SYNC_REPLY, message.token, message.received_us, message.sent_us)
            )
        case _:
            raise InputError(
                f"message: expected one of this file's messages, got {type(message).__name__}"
            )
    return _build_frame(head[0], head, message.channels_us)


def decode(frame: bytes) -> Message:
    """The message in one frame, the inverse of `encode`.

    Args:
        frame: the bytes, with or without the zero at the end.

    Raises:
        InputError: the bytes are no frame, were damaged on the way, or their type is unknown; the
            text says which.
    """
    payload = _decode_payload(frame)
    kind = payload[0]
    if kind not in _HEADS:
        known = ", ".join(f"0x{known:02x}" for known in _HEADS)
        raise InputError(
            f"frame: expected a type of {known}, got 0x{kind:02x}; is the other side of another version?"
        )
    head_size = _HEADS[kind].size
    if len(payload) < head_size:
        raise InputError(
            f"frame: expected at least {head_size} bytes of type 0x{kind:02x}, got {len(payload)}; drop it"
        )
    head: list[Any] = list(_HEADS[kind].unpack_from(payload))[1:]
    tail = payload[head_size:]
    if kind == STATUS:
        return _build_status(head, _decode_channels(tail, head.pop(), MIN_CHANNELS, MAX_CHANNELS))
    if kind == PILOT:
        device_time_us, source, rejected, count = head
        return PilotFrame(
            device_time_us, source, rejected, _decode_channels(tail, count, 1, MAX_CHANNELS)
        )
    if kind == COMMAND:
        return CommandFrame(
            head[0],
            bool(head[1] & 1),
            _decode_channels(tail, len(tail) // 2, MIN_CHANNELS, MAX_CHANNELS),
        )
    if tail:
        raise InputError(
            f"frame: expected {head_size} bytes of type 0x{kind:02x}, got {len(payload)}; drop it"
        )
    return SyncRequest(*head) if kind == SYNC else SyncReply(*head)


def decode_status(frame: bytes) -> Status:
    """The board's status in one frame.

    Args:
        frame: the bytes, with or without the zero at the end.

    Raises:
        InputError: the bytes are no status frame; the text says why.
    """
    message = decode(frame)
    if not isinstance(message, Status):
        raise InputError(
            f"frame: expected a status, got a {type(message).__name__}; read on, one comes 20 times a second"
        )
    return message


class Deframer:
    """Bytes as they come from the port -> whole messages; what cannot be read is counted and left
    out.
    """

    def __init__(self) -> None:
        self.bad = 0  # frames that were damaged, of unknown type or too long
        self._part = b""  # what came since the last zero

    def feed(self, data: bytes) -> list[Message]:
        """Take more bytes of the stream.

        Args:
            data: any number of bytes; a frame may come in pieces.

        Returns:
            The messages that ended in these bytes, in order.
        """
        *frames, part = (self._part + data).split(b"\0")
        self._part = part[: MAX_FRAME + 1]  # enough to know that it is too long
        messages = []
        for frame in filter(
            None, frames
        ):  # two zeros in a row are no frame: senders may put one in front
            try:
                messages.append(decode(frame))
            except InputError:
                self.bad += 1
        return messages


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF; the check value of b"123456789" is
    0x29B1.

    In a command it sees every change of one, two or three bits; of changes of four bits 6 in
    100,000 pass it, and the safety rules see most of those.
    """
    return binascii.crc_hqx(data, 0xFFFF)


def cobs_encode(data: bytes) -> bytes:
    """Take the zeros out: every run between zeros is sent behind its length plus one.

    Args:
        data: at most 253 bytes, so that no run needs the length 255, which means something else in
            COBS.

    Raises:
        InputError: the data are longer.
    """
    if len(data) > 253:
        raise InputError(
            f"data: expected at most 253 bytes for one frame, got {len(data)}; split them"
        )
    return b"".join(bytes([len(run) + 1]) + run for run in data.split(b"\0"))


def cobs_decode(data: bytes) -> bytes:
    """Put the zeros back, the inverse of `cobs_encode`.

    Raises:
        InputError: there is a zero in the data, or the lengths do not end where the data end.
    """
    runs, at = [], 0
    while at < len(data):
        end = at + data[at]
        if not at < end <= len(data):
            raise InputError(
                f"frame: expected a length that ends within {len(data)} bytes, got {data[at]} at {at}; drop it"
            )
        runs.append(data[at + 1 : end])
        at = end
    if 0 in data:
        raise InputError(
            "frame: expected no zero before its end, got one; split the stream at zeros or use Deframer"
        )
    return b"\0".join(runs)


def _build_frame(kind: int, head: tuple[Any, ...], channels_us: tuple[int, ...] = ()) -> bytes:
    """Payload, checksum, stuffing and the zero."""
    try:
        payload = _HEADS[kind].pack(*head) + struct.pack(f"<{len(channels_us)}H", *channels_us)
    except struct.error as error:
        values = (*head[1:], *channels_us)
        raise InputError(
            f"frame: expected whole numbers that fit their fields, got {values}: {error}"
        ) from None
    return cobs_encode(payload + struct.pack("<H", crc16(payload))) + b"\0"


def _decode_payload(frame: bytes) -> bytes:
    """What the frame holds, once its checksum fits."""
    if not isinstance(frame, (bytes, bytearray, memoryview)):
        raise InputError(
            f"frame: expected bytes as they came from the port, got {type(frame).__name__}"
        )
    data = bytes(frame).removesuffix(b"\0")
    if len(data) > MAX_FRAME:
        raise InputError(
            f"frame: expected at most {MAX_FRAME} bytes, got {len(data)}; split the stream with Deframer"
        )
    content = cobs_decode(data)
    if len(content) < 3:
        raise InputError(
            f"frame: expected a type and a checksum, got {len(content)} bytes; drop it"
        )
    payload, sent = content[:-2], int.from_bytes(content[-2:], "little")
    if crc16(payload) != sent:
        raise InputError(
            f"frame: expected checksum 0x{crc16(payload):04x}, got 0x{sent:04x}; it was damaged, drop it"
        )
    return payload


def _decode_channels(tail: bytes, count: int, low: int, high: int) -> tuple[int, ...]:
    """The channels at the end of a payload."""
    _require_count(count, low, high)
    if len(tail) != 2 * count:
        raise InputError(
            f"frame: expected {count} channels of 2 bytes, got {len(tail)} bytes; drop it"
        )
    return struct.unpack(f"<{count}H", tail)


def _status_fields(status: Status) -> tuple[Any, ...]:
    """A status's fields in the order of the wire."""
    if status.state not in STATES or status.fault not in FAULTS:
        raise InputError(
            f"status: expected a state of {STATES} and a fault of {FAULTS}, got {status.state, status.fault}"
        )
    head = (
        STATUS,
        status.version,
        status.device_time_us,
        STATES.index(status.state),
        FAULTS.index(status.fault),
    )
    causes = (status.boot_count, status.reset_cause, status.last_sequence, status.accepted)
    counters = (status.bad_frames, status.bad_sequence, status.out_of_range, status.ppm_frames)
    return (*head, *causes, *counters, int(status.silent), len(status.channels_us))


def _build_status(head: list[Any], channels_us: tuple[int, ...]) -> Status:
    """A status from its fields in the order of the wire, without its type and its number of
    channels.
    """
    version, device_time_us, state, fault, *numbers, silent = head
    if version != VERSION:
        raise InputError(
            f"status: expected version {VERSION}, got {version}; flash the firmware that came with this kit"
        )
    if state >= len(STATES) or fault >= len(FAULTS):
        raise InputError(
            f"status: expected a known state and fault, got {state} and {fault}; flash this kit's firmware"
        )
    boots, cause, last, accepted, bad_frames, bad_sequence, out_of_range, ppm_frames = numbers
    counters = (accepted, bad_frames, bad_sequence, out_of_range, ppm_frames)
    after = (bool(silent), channels_us, device_time_us, version)
    return Status(STATES[state], FAULTS[fault], boots, cause, last, *counters, *after)


def _require_whole(name: str, value: int) -> int:
    """The value if it is a whole number from 0."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if number < 0 or isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name}: expected a whole number from 0, got {value!r}")
    return number


def _require_count(count: int, low: int, high: int) -> None:
    if not low <= count <= high:
        raise InputError(f"channels: expected {low} to {high} of them, got {count}")
