"""The channel's bytes, packed and read here by hand, and what is refused from a client."""

import math
import struct

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, State
from falconwing_kit.tools.classroom.channel import (
    PORT,
    pack_picture,
    pack_state,
    pack_sticks,
    read_text,
    unpack_state,
    unpack_sticks,
    write_text,
)

STATE = State(np.array([1.0, -2.0, 3.0]), 0.1, 0.2, 0.3, np.array([7.0, 0.5, -0.25]))


def test_state_has_the_bytes_of_the_protocol():
    """Offsets counted by hand from the table of the protocol: head of 12 bytes, then floats."""
    data = pack_state(
        flags=PORT, holder="student", phase=7, flight=65537, step=70000, t=2.5, state=STATE,
        command=Command(0.5, -1.0, 0.25, 0.75), leader=STATE, rate_hz=20.0, speed=0.25,
    )  # fmt: skip
    assert len(data) == 96
    assert list(data[:4]) == [1, 16 | 1, 2, 7]  # kind, port and leader, student, phase
    assert struct.unpack_from("<HH", data, 4) == (1, 70000 - 65536)
    assert struct.unpack_from("<f", data, 8) == (2.5,)
    assert struct.unpack_from("<3f", data, 12) == (1.0, -2.0, 3.0)
    # Roll, pitch, yaw in this order, which is not that of State.
    assert struct.unpack_from("<3f", data, 24) == pytest.approx((0.3, 0.1, 0.2), rel=1e-6)
    assert struct.unpack_from("<4f", data, 48) == (0.5, -1.0, 0.25, 0.75)
    assert struct.unpack_from("<2f", data, 88) == (20.0, 0.25)


def test_state_without_a_leader_has_nan_and_no_flag():
    """The page draws a leader by the flag; the numbers are there in any case."""
    message = unpack_state(
        pack_state(
            flags=0, holder="autopilot", phase=0, flight=1, step=0, t=0.0, state=STATE,
            command=Command(0.0, 0.0, 0.0, 0.0),
        )
    )  # fmt: skip
    assert message.flags == 0 and message.holder == 1
    assert all(math.isnan(value) for value in message.numbers[13:19])
    with pytest.raises(InputError, match="96 bytes"):
        unpack_state(b"\x01" * 95)


def test_sticks_are_read_from_bytes_packed_by_hand():
    """struct of the protocol's text: kind 3, hold and assist, sequence, clock, four floats."""
    data = struct.pack("<BBHI4f", 3, 3, 500, 123456, 0.25, -1.0, 0.5, 1.0)
    sticks = unpack_sticks(data)
    assert sticks is not None
    assert (sticks.hold, sticks.assist, sticks.sequence) == (True, True, 500)
    assert (sticks.throttle, sticks.aileron, sticks.elevator, sticks.rudder) == (0.25, -1, 0.5, 1)
    assert data == pack_sticks(
        500, Command(0.25, -1.0, 0.5, 1.0), hold=True, assist=True, client_ms=123456
    )


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x03",
        pack_sticks(1, Command(0.5, 0.0, 0.0, 0.0))[:-1],
        pack_sticks(1, Command(0.5, 0.0, 0.0, 0.0)) + b"\0",
        b"\x02" + pack_sticks(1, Command(0.5, 0.0, 0.0, 0.0))[1:],
        *(
            struct.pack("<BBHI4f", 3, 1, 1, 1, *values)
            for values in (
                (math.nan, 0, 0, 0), (-0.1, 0, 0, 0), (1.1, 0, 0, 0), (0.5, math.nan, 0, 0),
                (0.5, 0, math.inf, 0), (0.5, 0, 0, math.nan), (0.5, 0, -1.5, 0),
            )
        ),
    ],
)  # fmt: skip
def test_other_bytes_are_no_sticks(data):
    """Too short, too long, another kind, not finite, out of range: None, and no exception."""
    assert unpack_sticks(data) is None


@pytest.mark.parametrize(
    "text",
    ["", "{", "3", "[]", "{}", '{"type": 3}', "[" * 5000, '{"type":"name","name":"' + "x" * 9000],
)
def test_other_texts_are_no_messages(text):
    """Half messages, other types, deep brackets and long texts."""
    assert read_text(text) is None


def test_texts_go_both_ways():
    """nan is no JSON and becomes null."""
    assert read_text('{"type": "ask"}') == {"type": "ask"}
    assert write_text("board", rows=[float("nan"), np.float64(2.0)]) == (
        '{"type":"board","rows":[null,2.0]}'
    )
    assert pack_picture(3, 7, b"jpeg") == struct.pack("<BBHI", 2, 0, 3, 7) + b"jpeg"
