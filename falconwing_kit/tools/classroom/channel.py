"""Channel: a step of the flight, a picture, a student's sticks <-> the bytes of the WebSocket.

Binary messages are little-endian and begin with their kind; everything else is JSON text with a
"type". Bytes from the network are judged here: whatever does not fit is None, never an exception.
page/channel.js holds the same in the browser.
"""

import json
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, State

STATE, PICTURE, STICKS = 1, 2, 3  # kinds
STATE_FORMAT = struct.Struct("<BBBBHHf21f")
PICTURE_HEAD = struct.Struct("<BBHI")
STICKS_FORMAT = struct.Struct("<BBHI4f")
HOLDERS = ("nobody", "autopilot", "student", "safe")  # index: the byte in STATE
# Flags of STATE.
LEADER, PAUSED, STRETCHED, OVER, PORT, ASSIST = 1, 2, 4, 8, 16, 32
HOLD, WANTS_ASSIST = 1, 2  # flags of STICKS
MAX_TEXT = 4096  # bytes of a JSON message from a client; the longest of the protocol has about 100
MAX_DIGITS = 15  # of an integer: below 2^53
MAX_DEPTH = 8  # of nested brackets, checked before parsing


@dataclass(frozen=True)
class StateMessage:
    """What every page needs of one step."""

    flags: int
    holder: int  # index into HOLDERS
    phase: int  # index into the phases of the flight
    flight: int
    step: int
    t: float  # [s]
    numbers: tuple[float, ...]  # 21, see `pack_state`


@dataclass(frozen=True)
class SticksMessage:
    """A student's sticks."""

    hold: bool
    assist: bool
    sequence: int  # wraps at 2^16
    client_ms: int  # the browser's clock, wraps at 2^32
    throttle: float  # 0..1
    aileron: float  # -1..1, positive right wing down
    elevator: float  # -1..1, positive nose up
    rudder: float  # -1..1, positive nose right


def pack_state(
    *, flags: int, holder: str, phase: int, flight: int, step: int, t: float, state: State,
    command: Command, leader: State | None = None, rate_hz: float = 0.0, speed: float = 1.0,
) -> bytes:  # fmt: skip
    """96 bytes of a step: place, attitude, velocity, sticks, leader, rate and speed of time.

    Args:
        flags: of LEADER, PAUSED, STRETCHED, OVER, PORT, ASSIST; LEADER is set where there is one.
        holder: one of HOLDERS.
        phase: 0..255, index into the phases of the flight's message.
        flight: number of the flight; wraps at 2^16, as `step` does.
        step: number of the step.
        t: time of the flight [s].
        state: the aircraft's.
        command: as sent.
        leader: the leader's state; None without one.
        rate_hz: steps a second, mean of the last second.
        speed: of time, 1 for real time.
    """
    leader_pose = (math.nan,) * 6
    if leader is not None:
        leader_pose = (*leader.p_world.tolist(), leader.roll, leader.pitch, leader.yaw)
        flags |= LEADER
    return STATE_FORMAT.pack(
        STATE, flags & 255, HOLDERS.index(holder), min(max(phase, 0), 255), flight & 0xFFFF,
        step & 0xFFFF, t, *state.p_world.tolist(), state.roll, state.pitch, state.yaw,
        *state.v_world.tolist(), *command.vector.tolist(), *leader_pose, rate_hz, speed,
    )  # fmt: skip


def unpack_state(data: bytes) -> StateMessage:
    """The message of `pack_state`; for tests and clients in Python.

    Raises:
        InputError: the bytes are not one.
    """
    if len(data) != STATE_FORMAT.size or data[0] != STATE:
        raise InputError(
            f"state message: expected {STATE_FORMAT.size} bytes of kind {STATE}, got {len(data)}"
        )
    _, flags, holder, phase, flight, step, t, *numbers = STATE_FORMAT.unpack(data)
    return StateMessage(flags, holder, phase, flight, step, t, tuple(numbers))


def pack_picture(flight: int, sequence: int, jpeg: bytes) -> bytes:
    """A JPEG of the nose camera with the numbers of its flight and of the image."""
    return PICTURE_HEAD.pack(PICTURE, 0, flight & 0xFFFF, sequence & 0xFFFFFFFF) + jpeg


def pack_sticks(
    sequence: int, command: Command, *, hold: bool = True, assist: bool = False, client_ms: int = 0
) -> bytes:
    """24 bytes of a student's sticks, as page/channel.js packs them."""
    flags = HOLD * hold | WANTS_ASSIST * assist
    return STICKS_FORMAT.pack(
        STICKS, flags, sequence & 0xFFFF, client_ms & 0xFFFFFFFF, *command.vector.tolist()
    )


def unpack_sticks(data: bytes) -> SticksMessage | None:
    """The sticks of a client's bytes; None where they are no sticks, not finite or out of range."""
    if len(data) != STICKS_FORMAT.size or data[0] != STICKS:
        return None
    _, flags, sequence, client_ms, throttle, aileron, elevator, rudder = STICKS_FORMAT.unpack(data)
    # Written so that nan fails too.
    if not (0.0 <= throttle <= 1.0 and max(abs(aileron), abs(elevator), abs(rudder)) <= 1.0):
        return None
    if not all(map(math.isfinite, (aileron, elevator, rudder))):
        return None
    return SticksMessage(
        bool(flags & HOLD), bool(flags & WANTS_ASSIST), sequence, client_ms,
        throttle, aileron, elevator, rudder,
    )  # fmt: skip


def read_text(text: str) -> dict[str, Any] | None:
    """A client's JSON message; None unless it is an object with a "type", short and flat."""
    if len(text) > MAX_TEXT or text.count("{") + text.count("[") > MAX_DEPTH:
        return None
    try:
        message = json.loads(text, parse_constant=lambda name: None, parse_int=_read_int)
    except (ValueError, RecursionError):
        return None
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        return None
    return message


def _read_int(digits: str) -> int | None:
    """An integer that a float holds exactly; None for a longer one."""
    return int(digits) if len(digits) <= MAX_DIGITS else None


def write_text(kind: str, **fields: Any) -> str:
    """A JSON message of the server; nan and infinity become null."""
    return json.dumps({"type": kind, **plain(fields)}, allow_nan=False, separators=(",", ":"))


def plain(value: Any) -> Any:
    """A value in JSON's types; nan and infinity become None, other objects their text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)
