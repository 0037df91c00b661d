"""Serial protocol: bytes by hand, by an independent library and by the firmware's C++; damage is
never accepted.
"""

import binascii
import contextlib
import dataclasses
import itertools
import math
import struct
import tracemalloc

import numpy as np
import pytest
from cobs import cobs

from falconwing_kit.core.checks import InputError
from falconwing_kit.trainer_port import protocol
from falconwing_kit.trainer_port.ppm import encode_command, load_calibration
from falconwing_kit.trainer_port.protocol import (
    CommandFrame,
    Deframer,
    PilotFrame,
    Status,
    SyncReply,
    SyncRequest,
    cobs_decode,
    cobs_encode,
    decode,
    decode_status,
    encode,
    encode_channels,
    encode_sync,
)
from falconwing_kit.trainer_port.safety import Safety, SafetyDecision
from tests.trainer_port import host_library

STATUS = Status(
    "LOST", "none", 2, 9, 513, 70000, 3, 4, 5, 80000, True, (1000, 1500, 1501, 2000), 4_000_000_000
)
MESSAGES = (
    CommandFrame(65535, True, (900, 2100, 1500, 1000)),
    CommandFrame(0, False, (0,) * 8),
    SyncRequest(0),
    SyncRequest(2**32 - 1),
    STATUS,
    dataclasses.replace(
        STATUS, state="FAULT", fault="stall", silent=False, channels_us=(1500,) * 8
    ),
    dataclasses.replace(STATUS, fault="memory", engages_without_pilot=True),
    dataclasses.replace(STATUS, silent=False, has_pilot=True, pilot_took_over=True),
    PilotFrame(123456, 0, 7, (1100, 1200, 1300, 1400, 1500)),
    SyncReply(1, 2, 3),
)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The firmware's C++ for this computer."""
    return host_library.build(tmp_path_factory.mktemp("host"))


def test_a_command_by_hand():
    """Sequence 7, engaged, half throttle, elevator fully up: laid out by hand, its CRC bit by bit.

    Payload 01 0700 01 dc05 dc05 d007 dc05 (1500, 1500, 2000, 1500 us); its one zero byte sits at 2
    and is stuffed away.
    """
    payload = bytes.fromhex("01 0700 01 dc05 dc05 d007 dc05")
    crc = crc_bit_by_bit(payload)
    body = payload + struct.pack("<H", crc)
    frame = b"\x03" + body[:2] + bytes([len(body) - 2]) + body[3:] + b"\0"
    assert encode_command(7, 0.5, 0.0, 1.0, 0.0, True) == frame
    assert len(frame) == 16


def crc_bit_by_bit(data):
    """CRC-16/CCITT-FALSE as its definition says, one bit after the other."""
    register = 0xFFFF
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1 ^ (0x1021 if register & 0x8000 else 0)) & 0xFFFF
    return register


def test_checksum_is_the_catalogued_one():
    """The catalogue's check value of CRC-16/CCITT-FALSE, and the definition bit by bit."""
    assert protocol.crc16(b"123456789") == crc_bit_by_bit(b"123456789") == 0x29B1


def test_stuffing_by_hand():
    """Worked by the rule: each run between zeros goes behind its length plus one."""
    examples = {
        "": "01",
        "00": "01 01",
        "11 22 00 33": "03 11 22 02 33",
        "11 00 00 00": "02 11 01 01 01",
    }
    for data, stuffed in examples.items():
        assert cobs_encode(bytes.fromhex(data)) == bytes.fromhex(stuffed)
        assert cobs_decode(bytes.fromhex(stuffed)) == bytes.fromhex(data)


def test_stuffing_equals_the_library(rng):
    """`cobs` from the Python package index, over data rich in zeros; what it refuses we refuse."""
    for _ in range(3000):
        data = rng.integers(0, 4, rng.integers(1, 60)).astype(np.uint8).tobytes()
        assert cobs_encode(data) == cobs.encode(data)
        assert cobs_decode(cobs.encode(data)) == data
        try:
            expected = cobs.decode(data)
        except cobs.DecodeError:
            with pytest.raises(InputError):
                cobs_decode(data)
        else:
            assert cobs_decode(data) == expected
    with pytest.raises(InputError, match="253"):
        cobs_encode(bytes(254))


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_messages_go_over_the_wire_and_back(message):
    """Decoding inverts encoding, with and without the zero byte, the only one in the frame."""
    frame = encode(message)
    assert decode(frame) == decode(frame[:-1]) == decode(bytearray(frame)) == message
    assert frame.count(0) == 1 and frame[-1] == 0
    assert len(frame) <= 48 < protocol.MAX_FRAME


def test_sizes_are_those_of_the_specification():
    """Counted from its fields: payload + CRC 2 + COBS 1 + zero 1."""
    sizes = [len(encode(message)) for message in MESSAGES]
    assert sizes == [12 + 4, 20 + 4, 5 + 4, 5 + 4, 36 + 4, 44 + 4, 36 + 4, 36 + 4, 19 + 4, 13 + 4]


def test_status_has_its_fields_where_the_specification_says():
    """The payload laid out by hand, field by field."""
    hexes = (
        "11 02",
        "00286bee",
        "03 00 02 09",
        "0102",
        "70110100",
        "0300 0400 0500",
        "80380100",
        "01 04",
    )
    payload = bytes.fromhex("".join(hexes) + "e803 dc05 dd05 d007")
    body = payload + struct.pack("<H", crc_bit_by_bit(payload))
    assert decode_status(cobs_encode(body)) == STATUS
    assert STATUS.reset_causes == ("power-on", "watchdog")
    flags = {"silent": 1, "engages_without_pilot": 2, "has_pilot": 4, "pilot_took_over": 8}
    for name, bit in flags.items():
        only = dataclasses.replace(STATUS, **{other: other == name for other in flags})
        assert cobs_decode(encode(only)[:-1])[26] == bit
        assert decode_status(encode(only)) == only


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_firmware_writes_and_reads_the_same_bytes(library, message):
    """The C++ of the firmware, through its host library, both ways."""
    frame = encode(message)
    kind, values = host_library.decode(library, frame)
    assert kind == cobs_decode(frame[:-1])[0]
    channels = getattr(message, "channels_us", ())
    assert values[len(values) - len(channels) :] == channels
    assert host_library.encode(library, kind, values) == frame


def test_firmware_writes_what_we_read(library, rng):
    """Random values in every field of every type, from the C++ encoder to the Python decoder and
    back.
    """
    widths = {
        1: (16, 8),
        2: (32,),
        0x13: (32, 32, 32),
        0x12: (32, 8, 16),
        0x11: (8, 32, 8, 8, 8, 8, 16, 32, 16, 16, 16, 32, 8),
    }
    for _ in range(500):
        for kind, bits in widths.items():
            values = [int(rng.integers(2**width)) for width in bits]
            count = int(rng.integers(4, 9)) if kind in (1, 0x11, 0x12) else 0
            if kind == 1:
                values[1] &= 1
            if kind == 0x11:
                values[0], values[2], values[3], values[12] = (
                    2,
                    values[2] % 5,
                    values[3] % 4,
                    values[12] % 16,
                )
            values += [count] if kind in (0x11, 0x12) else []
            values += [int(us) for us in rng.integers(65536, size=count)]
            frame = host_library.encode(library, kind, values)
            assert encode(decode(frame)) == frame


# ---- what comes in from the program above ----


def test_sticks_beyond_their_limits_are_cut():
    """Full is full: 5 is sent as 1, -1 of throttle as 0."""
    assert encode_command(1, 5.0, -7, 1.5, -1.0001, False) == encode_command(
        1, 1.0, -1.0, 1.0, -1.0, False
    )
    assert encode_command(1, -1.0, 0, 0, 0, True) == encode_command(1, 0.0, 0, 0, 0, True)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, None, "much"])
@pytest.mark.parametrize("stick", range(4))
def test_a_stick_that_is_no_number_is_refused(stick, bad):
    """nan must never leave as some microseconds; the sentence names the stick."""
    sticks = [0.5, 0.0, 0.0, 0.0]
    sticks[stick] = bad
    with pytest.raises(InputError, match=("throttle", "aileron", "elevator", "rudder")[stick]):
        encode_command(1, *sticks, True)


@pytest.mark.parametrize("bad", [-1, 1.5, 2.0, math.nan, None, "7", True])
def test_a_sequence_is_a_whole_number_from_0(bad):
    """Anything else is a bug in the loop above."""
    with pytest.raises(InputError, match="sequence: expected a whole number from 0"):
        encode_command(bad, 0.5, 0.0, 0.0, 0.0, True)


def test_a_sequence_is_sent_modulo_65536():
    """65536 + 3 is 3; NumPy's integers count too."""
    assert encode_command(65539, 0, 0, 0, 0, True) == encode_command(
        np.int64(3), 0, 0, 0, 0, np.True_
    )
    assert decode(encode_sync(2**32 + 5)) == SyncRequest(5)
    assert decode(encode_sync(2**32 - 1)) == SyncRequest(2**32 - 1)


@pytest.mark.parametrize("bad", ["no", None, 2, -1, 0.5, math.nan, []])
def test_engage_is_a_yes_or_a_no(bad):
    """The text "no" must not engage."""
    with pytest.raises(InputError, match="engage"):
        encode_command(1, 0, 0, 0, 0, bad)


@pytest.mark.parametrize(
    "bad", [(1500,) * 3, (1500,) * 9, (1500, 1500, 1500, -1), (1500, 1500, 1500, 65536), (1.5,) * 4]
)
def test_channels_must_fit_their_fields(bad):
    """4 to 8 of them, each in 16 bits."""
    with pytest.raises(InputError):
        encode_channels(1, bad, True)


@pytest.mark.parametrize(
    "bad", ["COMMAND", None, dataclasses.replace(STATUS, state="UP"), SyncReply(-1, 0, 0)], ids=repr
)
def test_what_is_no_message_is_not_sent(bad):
    """A text, nothing, a state that there is not, a negative time."""
    with pytest.raises(InputError, match="expected"):
        encode(bad)


def test_a_calibration_of_ones_own_is_used():
    """Throttle and rudder change places, aileron is reversed: by hand from its file's numbers."""
    shipped = load_calibration()
    own = dataclasses.replace(
        shipped,
        throttle=dataclasses.replace(shipped.throttle, channel=4),
        aileron=dataclasses.replace(shipped.aileron, reversed=True, low_us=1100),
        rudder=dataclasses.replace(shipped.rudder, channel=1),
    )
    assert decode(encode_command(1, 1.0, 1.0, 0.0, -0.5, True, own)) == CommandFrame(
        1, True, (1250, 1100, 1500, 2000)
    )


# ---- what comes in from the wire ----


@pytest.mark.parametrize(
    ("frame", "sentence"),
    [
        (b"", "expected a type and a checksum"),
        (b"\0", "expected a type and a checksum"),
        (b"\x05\x11", "expected a length that ends within"),
        (b"\x03\x11\0\x03\x11\x12", "expected no zero before its end"),
        (b"\x01" * 65, "expected at most 64 bytes"),
        (encode(STATUS)[:9] + b"\x55" + encode(STATUS)[10:], "expected checksum"),
        (encode(SyncReply(1, 2, 3)), "expected a status, got a SyncReply"),
        (encode(dataclasses.replace(STATUS, version=1)), "expected version 2, got 1; flash"),
        ("a text", "expected bytes"),
        (None, "expected bytes"),
    ],
)
def test_what_is_no_status_gets_one_sentence(frame, sentence):
    """Want, got and the way out."""
    with pytest.raises(InputError, match=sentence) as caught:
        decode_status(frame)
    assert "\n" not in str(caught.value)


def framed(payload):
    """A frame with a good checksum around any payload."""
    return cobs_encode(payload + struct.pack("<H", crc_bit_by_bit(payload))) + b"\0"


@pytest.mark.parametrize(
    "payload",
    [
        bytes([0x7F, 1, 2, 3]),
        bytes([0x01, 0, 0]),
        bytes([0x01, 0, 0, 1]) + bytes(6),
        bytes([0x01, 0, 0, 1]) + bytes(9),
        bytes([0x01, 0, 0, 1]) + bytes(18),
        bytes([0x02, 1, 2, 3]),
        bytes([0x02, 1, 2, 3, 4, 5]),
        bytes([0x12, 0, 0, 0, 0, 0, 0, 0, 3]) + bytes(4),
    ],
    ids=bytes.hex,
)
def test_a_good_checksum_does_not_excuse_a_wrong_form(library, payload):
    """Unknown type, too short, too long, odd, three and nine channels: refused here and in the
    firmware.
    """
    with pytest.raises(InputError):
        decode(framed(payload))
    assert host_library.decode(library, framed(payload)) is None


def test_only_the_lowest_flag_engages():
    """The other seven bits are kept for later versions; they must not engage."""
    for flags, engage in ((0xFE, False), (0x03, True)):
        message = decode(framed(bytes([0x01, 7, 0, flags]) + bytes(8)))
        assert message == CommandFrame(7, engage, (0,) * 4)


def test_random_bytes_are_refused_or_read(rng):
    """50,000 pieces: noise, noise with a good checksum, and a status's head before noise with a
    good checksum.

    An InputError or a Status comes out, never anything else.
    """
    read = 0
    for number in range(50_000):
        noise = rng.bytes(int(rng.integers(0, 80)))
        if number % 3 == 1:
            noise = framed(noise[:60])
        elif number % 3 == 2:
            noise = framed(
                bytes([0x11, 2, *rng.bytes(4), number % 7, number % 5])
                + rng.bytes(19)
                + b"\4"
                + noise[:8]
            )
        with contextlib.suppress(InputError):
            read += isinstance(decode_status(noise), Status)
    assert read > 1000


def test_checksum_sees_every_change_of_up_to_three_bits():
    """All of them in the 112 bits of a command, by the linearity of a CRC: syndromes of 1, 2 and 3
    bits are not zero.

    Of four bits, 390 of the 6.2 million patterns pass the checksum (6e-5): there it is no theorem
    any more, and a frame must pass range and sequence too.
    """
    syndromes = []
    for bit in range(112):
        flipped = bytearray(14)
        flipped[bit // 8] = 0x80 >> bit % 8
        crc = binascii.crc_hqx(bytes(flipped[:12]), 0)
        syndromes.append(crc ^ int.from_bytes(flipped[12:], "little"))
    pairs = [a ^ b for a, b in itertools.combinations(syndromes, 2)]
    assert 0 not in syndromes and 0 not in pairs
    assert not set(syndromes) & set(pairs)
    values, counts = np.unique(pairs, return_counts=True)
    # Each pattern of four bits is found as three pairs of pairs.
    assert int((counts * (counts - 1) // 2).sum()) // 3 == 390
    assert len(values) < len(pairs)


def test_damaged_commands_are_never_accepted(rng):
    """200,000 commands with 1 to 4 flipped bits anywhere but in the zero at the end; seeded, so the
    same every time.

    Up to three flips that leave COBS's lengths alone cannot pass (see above), four can: in ten
    other draws, 2,000,000 frames, 12 passed the checksum and one of them range and sequence too,
    two in a million frames with four flips.
    """
    passed, accepted = 0, 0
    for number in range(200_000 // 50):
        sequence, engage = int(rng.integers(65536)), bool(rng.random() < 0.5)
        channels = tuple(int(us) for us in rng.integers(1000, 2001, 4))
        frame = np.frombuffer(encode_channels(sequence, channels, engage)[:-1], np.uint8)
        for damaged in flipped_copies(rng, frame, copies=50, flips=1 + number % 4):
            deframer = Deframer()
            messages = deframer.feed(damaged.tobytes() + b"\0")
            passed += len(messages)
            assert messages or deframer.bad
            for message in messages:
                safety = Safety()
                safety.frame(0, (sequence - 1) % 65536, False, channels)
                verdict = safety.frame(1, message.sequence, message.engage, message.channels_us)
                accepted += verdict == SafetyDecision.ACCEPTED
    assert accepted == 0
    assert (
        passed <= 3 + 4 * 3**0.5
    )  # at most 50,000 x 6e-5 = 3 are expected, and four times the scatter of a count


def flipped_copies(rng, frame, copies, flips):
    """Copies (copies, n) of a frame, each with so many different bits flipped."""
    order = np.argsort(rng.random((copies, 8 * len(frame))), axis=1)[:, :flips]
    damaged = np.tile(frame, (copies, 1))
    for column in order.T:
        damaged[np.arange(copies), column // 8] ^= (1 << column % 8).astype(np.uint8)
    return damaged


def test_a_stream_is_read_in_any_pieces(rng):
    """The same messages, however the bytes are cut."""
    stream = b"".join(encode(message) for message in MESSAGES * 20)
    deframer, messages, at = Deframer(), [], 0
    while at < len(stream):
        step = int(rng.integers(1, 30))
        messages += deframer.feed(stream[at : at + step])
        at += step
    assert tuple(messages) == MESSAGES * 20
    assert deframer.bad == 0


def test_the_frame_behind_garbage_is_read(rng):
    """One zero brings the reader back into step: garbage costs itself and at most the frame it runs
    into.
    """
    good = encode(STATUS)
    for _ in range(2000):
        deframer = Deframer()
        deframer.feed(rng.bytes(int(rng.integers(0, 200))))
        deframer.feed(b"\0")
        assert deframer.feed(good) == [STATUS]


def test_a_frame_without_end_is_dropped_and_counted_once():
    """A million bytes without a zero are one bad frame and are not kept; two zeros in a row are
    none.
    """
    deframer, chunk = Deframer(), b"\x55" * 1000
    tracemalloc.start()
    for _ in range(1000):
        assert deframer.feed(chunk) == []
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 20_000
    assert deframer.feed(b"\0\0\0" + encode(STATUS) + b"\0") == [STATUS]
    assert deframer.bad == 1


def test_firmware_counts_the_same_stream(library, rng):
    """Frames good, damaged, cut and noise, through both receivers: equally many accepted and
    equally many bad.
    """
    ours, theirs, safety = Deframer(), host_library.HostLink(library), Safety()
    accepted, bad_form = 0, 0
    for number in range(5000):
        data = encode_channels(
            number, [int(us) for us in rng.integers(1000, 2001, 4)], bool(number % 3)
        )
        kind = int(rng.integers(6))
        if kind == 1:
            data = data[: int(rng.integers(len(data)))]
        elif kind == 2:
            data = rng.bytes(int(rng.integers(1, 100)))
        elif kind == 3:
            data = (
                flipped_copies(rng, np.frombuffer(data[:-1], np.uint8), 1, 2)[0].tobytes() + b"\0"
            )
        elif kind == 4:
            data = encode(MESSAGES[number % len(MESSAGES)])
        theirs_accepted = theirs.feed(number, data)
        ours_accepted = 0
        for message in ours.feed(data):
            if isinstance(message, CommandFrame):
                verdict = safety.frame(
                    number, message.sequence, message.engage, message.channels_us
                )
                ours_accepted += verdict == SafetyDecision.ACCEPTED
                bad_form += verdict == SafetyDecision.FORM
            elif not isinstance(message, SyncRequest):
                bad_form += 1
        assert ours_accepted == theirs_accepted
        accepted += ours_accepted
        assert ours.bad + bad_form == theirs.bad
    assert accepted > 1000 and ours.bad > 1000
    theirs.close()
