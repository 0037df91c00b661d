"""Frames: values are unchanged by a round trip; all other bytes are refused before allocation."""

import io
import json
import struct
import tracemalloc

import numpy as np
import pytest

from falconwing_kit.tools.grading.sandbox.protocol import (
    DTYPES,
    MAX_BODY,
    MAX_DEPTH,
    FrameError,
    pack,
    read_frame,
    unpack,
    write_frame,
)


def there_and_back(value):
    stream = io.BytesIO()
    write_frame(stream, value)
    stream.seek(0)
    return read_frame(stream)


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        False,
        0,
        -(2**62),
        0.1,
        -0.0,
        "",
        "alpha β ✓",
        (),
        (1, 2.0, "x"),
        [1, [2, (3,)]],
        {"a": {"b": (1,)}},
    ],
)
def test_plain_values_come_back_as_they_were(value):
    """A law: there and back is nothing; the kinds too, tuples stay tuples and True is not 1."""
    back = there_and_back(value)
    assert back == value
    assert type(back) is type(value)
    assert repr(back) == repr(value)


@pytest.mark.parametrize("name", DTYPES)
def test_arrays_come_back_bit_by_bit(name):
    """A law, for transposed, big-endian, empty and read-only arrays; the copy is writable."""
    base = np.arange(-6, 6).reshape(3, 4).astype(name)
    for array in (base, base.T, base[:, ::2], base[:0], base.astype(base.dtype.newbyteorder(">"))):
        array.flags.writeable = False
        back = there_and_back(array)
        assert (back.dtype.name, back.shape) == (name, array.shape)
        assert back.tobytes() == array.astype(name).tobytes()
        assert back.flags.writeable


def test_not_a_number_and_infinity_come_back():
    """Student answers hold them; a judge must see them as they are."""
    back = there_and_back((float("nan"), float("inf"), np.array([np.nan, -np.inf])))
    assert np.isnan(back[0])
    assert back[1] == np.inf
    np.testing.assert_array_equal(back[2], [np.nan, -np.inf])


def test_numpy_numbers_keep_their_kind():
    """np.float64 is a float too; it comes back as NumPy's, np.bool_ as NumPy's."""
    assert type(there_and_back(np.float64(1.5))) is np.float64
    assert type(there_and_back(np.bool_(True))) is np.bool_


def loop():
    endless = []
    endless.append(endless)
    return endless


@pytest.mark.parametrize(
    "value",
    [
        object(),
        1j,
        b"bytes",
        {1: 2},
        {1, 2},
        np.array([1j]),
        np.array([None]),
        np.array(["text"]),
        np.zeros(1, dtype=[("a", float)]),
        np.zeros(MAX_BODY // 8 + 1),
        "x" * (1 << 20),
        loop(),
    ],
    ids=lambda value: type(value).__name__,
)
def test_other_values_are_not_sent(value):
    """The list in write_frame's docstring, and the caps."""
    stream = io.BytesIO()
    with pytest.raises(FrameError):
        write_frame(stream, value)
    assert stream.getvalue() == b""


def deep(levels):
    node = 1
    for _ in range(levels):
        node = {"list": [node]}
    return node


@pytest.mark.parametrize(
    "header",
    [
        {"array": ["float64", [3 * 10**12]]},
        {"array": ["float64", [-1]]},
        {"array": ["float64", [1 << 30, 1 << 30, 1 << 30]]},
        {"array": ["float64", [0, 1 << 62]]},
        {"array": ["float64", [True]]},
        {"array": ["float64", [1.0]]},
        {"array": ["float64", 1]},
        {"array": ["object", [1]]},
        {"array": ["O", [1]]},
        {"array": [["float64"], [1]]},
        {"array": ["float64"]},
        {"array": ["float64", [0] * 9]},
        {"tuple": 1},
        {"tuple": [1], "list": [1]},
        {"set": [1]},
        {"dict": [[1]]},
        {"dict": [[["a"], 1]]},
        {},
        [1],
        1 << 63,
        "x" * 10_001,
        "\ud800",
        deep(MAX_DEPTH + 2),
        {"list": [0] * 100_001},
    ],
    ids=lambda header: json.dumps(header)[:30],
)
def test_other_headers_are_refused(header):
    """Each breaks one rule of the protocol.

    The body has bytes to spare, so that no length explains it.
    """
    with pytest.raises(FrameError):
        unpack(json.dumps(header).encode(), bytes(64))


@pytest.mark.parametrize("header", [b"", b"{", b"[" * 1_000_000, b"\xff", b"1" * 5000, b"nul"])
def test_other_bytes_are_refused(header):
    """No JSON, or more than a parser bears."""
    with pytest.raises(FrameError):
        unpack(header, b"")


def test_bytes_beyond_the_arrays_are_refused():
    """Eight bytes for one number of eight: fine; nine: something is hidden."""
    header = json.dumps({"array": ["float64", [1]]}).encode()
    assert unpack(header, bytes(8)).shape == (1,)
    with pytest.raises(FrameError):
        unpack(header, bytes(9))


def test_true_is_one():
    """A truth value of 255 would be true, and yet unequal to true."""
    back = unpack(json.dumps({"array": ["bool", [2]]}).encode(), bytes([255, 0]))
    assert back.tobytes() == bytes([1, 0])


@pytest.mark.parametrize(
    ("head", "error"),
    [
        (struct.pack(">4sII", b"FWK1", 0xFFFFFFFF, 0), FrameError),
        (struct.pack(">4sII", b"FWK1", 2, 0xFFFFFFFF), FrameError),
        (struct.pack(">4sII", b"FWK2", 2, 0) + b"{}", FrameError),
        (struct.pack(">4sII", b"FWK1", 4, 0) + b"nu", EOFError),
        (b"FWK", EOFError),
        (b"", EOFError),
    ],
)
def test_lengths_are_checked_before_anything_is_read(head, error):
    """Less than a megabyte is allocated while four gigabytes are claimed."""
    tracemalloc.start()
    with pytest.raises(error):
        read_frame(io.BytesIO(head))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e6


def test_random_bytes_never_raise_anything_else():
    """2000 frames with one byte changed: a value, FrameError or EOFError."""
    frame = pack({"number": 7, "answer": (np.arange(3.0), "text", [True, None])})
    rng = np.random.default_rng(0)
    for _ in range(2000):
        damaged = bytearray(frame)
        damaged[rng.integers(len(frame))] = rng.integers(256)
        try:
            read_frame(io.BytesIO(bytes(damaged)))
        except (FrameError, EOFError):
            continue
