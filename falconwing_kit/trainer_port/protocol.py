"""Serial protocol of the trainer port: messages <-> frames of bytes; byte stream -> messages.

A frame is COBS(payload + CRC-16) and one zero byte, little endian, 115200 8N1. The payload's first
byte is its type:

    host -> board  COMMAND    0x01  u16 sequence | u8 flags (bit 0 engage) | 4..8 x u16 channel [us]
                   SYNC       0x02  u32 token
    board -> host  STATUS     0x11  20 Hz: state, counters and the channels of the current PPM frame
                   PILOT      0x12  one for each valid frame of the pilot's radio
                   SYNC_REPLY 0x13  u32 token | u32 time received | u32 time queued

Payloads of STATUS and PILOT by byte; at their end n channels of two bytes [us]:

    STATUS    0     u8   type 0x11                  PILOT    0     u8   type 0x12
              1     u8   version                             1..4  u32  time of last edge [us]
              2..5  u32  board's clock [us]                  5     u8   index into PILOT_SOURCES
              6     u8   index into STATES                   6..7  u16  pilot frames rejected
              7     u8   index into FAULTS                   8     u8   n, 1..8
              8     u8   boot count                          9..   u16  channels
              9     u8   reset cause (MCUSR)
             10..11 u16  last accepted sequence
             12..15 u32  commands accepted
             16..17 u16  frames with wrong CRC or format
             18..19 u16  commands with wrong sequence
             20..21 u16  commands out of range
             22..25 u32  PPM frames sent
             26     u8   flags, see STATUS_FLAGS
             27     u8   n, 4..8
             28..   u16  channels

COBS (consistent overhead byte stuffing, Cheshire and Baker 1999) removes the zeros from the
payload, so a zero byte always ends a frame: after any garbage, the next zero resynchronises both
sides.
"""

import binascii
import operator
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError

VERSION = 2
STATES = ("BOOT", "SAFE", "ACTIVE", "LOST", "FAULT")
FAULTS = ("none", "range", "stall", "memory")
# Bits 0..4 of the MCU status register MCUSR, ATmega2560 data sheet.
RESET_CAUSES = ("power-on", "reset pin", "brown-out", "watchdog", "JTAG")
# Bits of STATUS's flags: fields of `Status` in the order of the bits.
STATUS_FLAGS = ("silent", "engages_without_pilot", "has_pilot", "pilot_took_over")
PILOT_SOURCES = ("PPM", "Spektrum serial")
COMMAND, SYNC, STATUS, PILOT, SYNC_REPLY = 0x01, 0x02, 0x11, 0x12, 0x13
MIN_CHANNELS, MAX_CHANNELS = 4, 8
MAX_COBS_BYTES = 253  # a run of 254 would need the length 255, which COBS reserves
MIN_PAYLOAD_BYTES, CHECKSUM_BYTES = 1, 2  # the type alone; CRC-16
MAX_FRAME = 64  # bytes before the zero; the longest frame has 47

_HEADS = {  # fields before the channels
    COMMAND: struct.Struct("<BHB"),
    SYNC: struct.Struct("<BI"),
    STATUS: struct.Struct("<BBIBBBBHIHHHIBB"),
    PILOT: struct.Struct("<BIBHB"),
    SYNC_REPLY: struct.Struct("<BIII"),
}


@dataclass(frozen=True)
class CommandFrame:
    """Host -> board: set values of the PPM channels."""

    sequence: int  # 0..65535, advances with every command
    engage: bool  # True: the host requests control; False: it hands back
    channels_us: tuple[int, ...]  # (4..8,) [us], in the order of the PPM frame


@dataclass(frozen=True)
class SyncRequest:
    """Host -> board: request for the board's time."""

    token: int  # the host's clock, low 32 bits of its microseconds


@dataclass(frozen=True)
class Status:
    """Board -> host, 20 Hz. Counters wrap at their width and start at zero at every boot."""

    state: str  # one of STATES
    fault: str  # one of FAULTS
    boot_count: int  # 0..255, since power-on
    reset_cause: int  # MCUSR at boot, see `reset_causes`
    last_sequence: int  # of the last accepted command
    accepted: int  # commands accepted
    bad_frames: int  # frames with a wrong CRC or format
    bad_sequence: int  # commands whose sequence did not advance
    out_of_range: int  # commands with a channel outside 900..2100 us
    ppm_frames: int  # frames sent to the radio
    silent: bool  # True: PPM output is off
    channels_us: tuple[int, ...]  # (4..8,) [us], of the current PPM frame
    device_time_us: int  # the board's clock [us], wraps after 71 minutes
    version: int = VERSION
    # True: compiled to engage at any command where no pilot's signal is measured
    engages_without_pilot: bool = False
    has_pilot: bool = False  # True: a pilot's frame was measured in the last 100 ms
    # True: a stick of the pilot ended the engagement, and engage = 0 has not come since
    pilot_took_over: bool = False

    @property
    def reset_causes(self) -> tuple[str, ...]:
        """Names of the causes of the last reset."""
        return tuple(name for bit, name in enumerate(RESET_CAUSES) if self.reset_cause >> bit & 1)


@dataclass(frozen=True)
class PilotFrame:
    """Board -> host: one valid frame of the pilot's radio."""

    device_time_us: int  # time of its last edge [us], board's clock
    source: int  # index into PILOT_SOURCES
    rejected: int  # pilot frames rejected so far
    channels_us: tuple[int, ...]  # (1..8,) [us]


@dataclass(frozen=True)
class SyncReply:
    """Board -> host: reply to a SyncRequest."""

    token: int  # of the request
    received_us: int  # time at which the request's last byte was read [us], board's clock
    sent_us: int  # time at which this reply was queued [us], board's clock


Message = CommandFrame | SyncRequest | Status | PilotFrame | SyncReply


def encode_channels(sequence: int, channels_us: Sequence[int], engage: bool) -> bytes:
    """Encode a COMMAND from channel microseconds: a serial frame with its zero byte, unclipped.

    Args:
        sequence: a whole number from 0; its low 16 bits are sent.
        channels_us: (4..8,) whole numbers 0..65535 [us], in the order of the PPM frame.
        engage: True to request control, False to hand back.

    Raises:
        InputError: an argument is outside these ranges.
    """
    low_bits = _require_whole("sequence", sequence) & 0xFFFF
    if not isinstance(engage, (bool, np.bool_)) and engage not in (0, 1):
        raise InputError(f"engage: expected True or False, got {engage!r}")
    return encode(CommandFrame(low_bits, bool(engage), tuple(channels_us)))


def encode_sync(token: int) -> bytes:
    """One SYNC as a serial frame; the token is the host's clock [us], of which 32 bits are sent.

    Raises:
        InputError: the token is not a whole number from 0.
    """
    return encode(SyncRequest(_require_whole("token", token) & 0xFFFFFFFF))


def encode(message: Message) -> bytes:
    """Any message as a serial frame with its zero byte; the inverse of `decode`.

    Raises:
        InputError: it is no message, a number does not fit into its field, or the number of
            channels is out of range.
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
                f"message: expected a message of this protocol, got {type(message).__name__}"
            )
    return _build_frame(head[0], head, message.channels_us)


def decode(frame: bytes) -> Message:
    """The message in one frame, with or without its final zero; the inverse of `encode`.

    Raises:
        InputError: the bytes are no frame, are corrupted, or have an unknown type.
    """
    payload = _decode_payload(frame)
    kind = payload[0]
    if kind not in _HEADS:
        known = ", ".join(f"0x{known:02x}" for known in _HEADS)
        raise InputError(
            f"frame: expected a type of {known}, got 0x{kind:02x}; "
            "is the other side of another version?"
        )
    head_size = _HEADS[kind].size
    if len(payload) < head_size:
        raise InputError(
            f"frame: expected at least {head_size} bytes of type 0x{kind:02x}, "
            f"got {len(payload)}; drop it"
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
    """The board's status in one frame, with or without its final zero.

    Raises:
        InputError: the bytes are no status frame.
    """
    message = decode(frame)
    if not isinstance(message, Status):
        raise InputError(
            f"frame: expected a status, got a {type(message).__name__}; "
            "read on, one comes 20 times a second"
        )
    return message


class Deframer:
    """Byte stream from the port -> complete messages; unreadable frames are counted and dropped."""

    def __init__(self) -> None:
        self.bad = 0  # frames that were corrupted, of unknown type or too long
        self._part = b""  # bytes since the last zero

    def feed(self, data: bytes) -> list[Message]:
        """The messages completed by these bytes, in order; a frame may arrive in pieces."""
        *frames, part = (self._part + data).split(b"\0")
        self._part = part[: MAX_FRAME + 1]  # long enough to be rejected as too long
        messages = []
        for frame in filter(None, frames):  # a sender may put an extra zero in front of a frame
            try:
                messages.append(decode(frame))
            except InputError:
                self.bad += 1
        return messages


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF; b"123456789" gives 0x29B1.

    In a COMMAND it detects every error of one, two or three bits; 6 in 100,000 errors of four bits
    pass, and the safety rules catch most of those.
    """
    return binascii.crc_hqx(data, 0xFFFF)


def cobs_encode(data: bytes) -> bytes:
    """Remove the zeros: every run between zeros is sent after its length plus one.

    Raises:
        InputError: more than MAX_COBS_BYTES.
    """
    if len(data) > MAX_COBS_BYTES:
        raise InputError(
            f"data: expected at most {MAX_COBS_BYTES} bytes for one frame, got {len(data)};"
            " split them"
        )
    return b"".join(bytes([len(run) + 1]) + run for run in data.split(b"\0"))


def cobs_decode(data: bytes) -> bytes:
    """Restore the zeros; the inverse of `cobs_encode`.

    Raises:
        InputError: the data contain a zero, or the run lengths do not match their end.
    """
    runs, start = [], 0  # start: where a run's length stands
    while start < len(data):
        end = start + data[start]
        if not start < end <= len(data):
            raise InputError(
                f"frame: expected a length that ends within {len(data)} bytes, "
                f"got {data[start]} at {start}; drop it"
            )
        runs.append(data[start + 1 : end])
        start = end
    if 0 in data:
        raise InputError(
            "frame: expected no zero before its end, got one; "
            "split the stream at zeros or use Deframer"
        )
    return b"\0".join(runs)


def _build_frame(kind: int, head: tuple[Any, ...], channels_us: tuple[int, ...] = ()) -> bytes:
    """COBS(payload + checksum) and the zero."""
    try:
        payload = _HEADS[kind].pack(*head) + struct.pack(f"<{len(channels_us)}H", *channels_us)
    except struct.error as error:
        values = (*head[1:], *channels_us)
        raise InputError(
            f"frame: expected whole numbers that fit their fields, got {values}: {error}"
        ) from None
    return cobs_encode(payload + struct.pack("<H", crc16(payload))) + b"\0"


def _decode_payload(frame: bytes) -> bytes:
    """The payload of a frame, after the check of its checksum."""
    if not isinstance(frame, (bytes, bytearray, memoryview)):
        raise InputError(f"frame: expected bytes as read from the port, got {type(frame).__name__}")
    data = bytes(frame).removesuffix(b"\0")
    if len(data) > MAX_FRAME:
        raise InputError(
            f"frame: expected at most {MAX_FRAME} bytes, got {len(data)}; "
            "split the stream with Deframer"
        )
    content = cobs_decode(data)
    if len(content) < MIN_PAYLOAD_BYTES + CHECKSUM_BYTES:
        raise InputError(
            f"frame: expected a type and a checksum, got {len(content)} bytes; drop it"
        )
    payload = content[:-CHECKSUM_BYTES]
    sent = int.from_bytes(content[-CHECKSUM_BYTES:], "little")
    if crc16(payload) != sent:
        raise InputError(
            f"frame: expected checksum 0x{crc16(payload):04x}, got 0x{sent:04x}; "
            "it is corrupted, drop it"
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
    """A status's fields in the order of the frame."""
    if status.state not in STATES or status.fault not in FAULTS:
        raise InputError(
            f"status: expected a state of {STATES} and a fault of {FAULTS}, "
            f"got {status.state, status.fault}"
        )
    state, fault = STATES.index(status.state), FAULTS.index(status.fault)
    head = (STATUS, status.version, status.device_time_us, state, fault)
    boot = (status.boot_count, status.reset_cause, status.last_sequence, status.accepted)
    counters = (status.bad_frames, status.bad_sequence, status.out_of_range, status.ppm_frames)
    flags = sum(getattr(status, name) << bit for bit, name in enumerate(STATUS_FLAGS))
    return (*head, *boot, *counters, flags, len(status.channels_us))


def _build_status(head: list[Any], channels_us: tuple[int, ...]) -> Status:
    """A status from the fields of its frame, without type and number of channels."""
    version, device_time_us, state, fault, *numbers, flags = head
    if version != VERSION:
        raise InputError(
            f"status: expected version {VERSION}, got {version}; "
            "flash the firmware that came with this kit"
        )
    if state >= len(STATES) or fault >= len(FAULTS):
        raise InputError(
            f"status: expected a known state and fault, got {state} and {fault}; "
            "flash this kit's firmware"
        )
    boots, cause, last, accepted, bad_frames, bad_sequence, out_of_range, ppm_frames = numbers
    counters = (accepted, bad_frames, bad_sequence, out_of_range, ppm_frames)
    silent, *others = (bool(flags >> bit & 1) for bit in range(len(STATUS_FLAGS)))
    tail = (silent, channels_us, device_time_us, version, *others)
    return Status(STATES[state], FAULTS[fault], boots, cause, last, *counters, *tail)


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
    """Raise InputError unless a frame has low to high channels."""
    if not low <= count <= high:
        raise InputError(f"channels: expected {low} to {high} of them, got {count}")
