"""Frames between grader and sandbox: numbers, texts, arrays and tuples <-> checked bytes.

A frame is the mark b"FWK1", the lengths of header and body (4 bytes each, big-endian), the header
(JSON) and the body: the arrays' raw data, little-endian, one after the other. Replies from a
sandbox are untrusted, so lengths, kinds and shapes are checked before memory is allocated, and
nothing is unpickled.

This file is copied into the sandbox; it needs NumPy and nothing of the kit.
"""

import json
import math
import struct
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

MAX_HEADER, MAX_BODY = 1 << 20, 32 << 20  # bytes
MAX_DEPTH, MAX_ITEMS, MAX_TEXT, MAX_AXES = 16, 100_000, 10_000, 8
_INTEGERS = tuple(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64))
DTYPES = ("bool", *_INTEGERS, "float16", "float32", "float64")
_HEAD = struct.Struct(">4sII")
_MARK = b"FWK1"
_INT_LIMIT = 1 << 63


class FrameError(ValueError):
    """Bytes or a value that do not fit this protocol."""


def write_frame(stream: BinaryIO, value: Any) -> None:
    """Send a value.

    Args:
        stream: open for writing bytes.
        value: None, a truth value, number, text, array of DTYPES, or tuples, lists and dicts (with
            texts as keys) of them.

    Raises:
        FrameError: the value is of another kind, or too large; nothing was sent.
        OSError: the other side has closed the pipe.
    """
    stream.write(pack(value))
    stream.flush()


def read_frame(stream: BinaryIO, longest: int = MAX_TEXT) -> Any:
    """Receive a value; at most MAX_HEADER + MAX_BODY bytes are read for it.

    Args:
        stream: open for reading bytes; a read of n bytes gives fewer only at the end.
        longest: text that is accepted; the source of a function may be longer than any answer.

    Raises:
        FrameError: the bytes are not a frame, or too large.
        EOFError: the other side has closed the pipe.
    """
    mark, header_length, body_length = _HEAD.unpack(_read_exactly(stream, _HEAD.size))
    if mark != _MARK or header_length > MAX_HEADER or body_length > MAX_BODY:
        raise FrameError("expected the beginning of a frame, got other bytes or too large a frame")
    header = _read_exactly(stream, header_length)
    return unpack(header, _read_exactly(stream, body_length), longest)


def pack(value: Any) -> bytes:
    """The frame of a value; Raises as `write_frame`."""
    arrays: list[bytes] = []
    try:
        header = json.dumps(_plain(value, arrays, 0)).encode("ascii")
    except (TypeError, ValueError, RecursionError) as error:
        raise FrameError(str(error)) from None
    body = b"".join(arrays)
    if len(header) > MAX_HEADER or len(body) > MAX_BODY:
        raise FrameError(f"expected at most {MAX_BODY >> 20} MiB of numbers, got {len(body)} bytes")
    return _HEAD.pack(_MARK, len(header), len(body)) + header + body


def unpack(header: bytes, body: bytes, longest: int = MAX_TEXT) -> Any:
    """The value of a frame's header and body; no text in it is longer than `longest`.

    Raises:
        FrameError: they are not output of `pack`.
    """
    reader = _Reader(body, longest)
    try:
        value = reader.value(json.loads(header.decode("ascii")), 0)
    except FrameError:
        raise
    except (
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        OverflowError,
        RecursionError,
        MemoryError,
    ):
        raise FrameError("expected the header of a frame, got other bytes") from None
    if reader.at != len(body):
        raise FrameError("expected the bytes of the frame's arrays, got more")
    return value


def _plain(value: Any, arrays: list[bytes], depth: int) -> Any:
    """The value as JSON; the data of its arrays is appended to `arrays`."""
    if depth > MAX_DEPTH:
        raise FrameError(f"expected at most {MAX_DEPTH} tuples inside each other")
    if isinstance(value, np.ndarray | np.generic):  # before float, which np.float64 is too
        array = np.asarray(value)
        if array.dtype.name not in DTYPES:
            raise FrameError(f"expected an array of numbers, got one of {array.dtype}")
        arrays.append(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes())
        return {"array": [array.dtype.name, list(array.shape)]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, tuple | list | Mapping) and len(value) > MAX_ITEMS:
        raise FrameError(f"expected at most {MAX_ITEMS} values; send numbers as an array")
    if isinstance(value, tuple | list):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [_plain(each, arrays, depth + 1) for each in value]}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": [[key, _plain(each, arrays, depth + 1)] for key, each in value.items()]}
    raise FrameError(
        f"expected numbers, texts, arrays, or tuples of them, got {type(value).__name__}"
    )


class _Reader:
    """Converts a header's JSON back into values, with limits."""

    def __init__(self, body: bytes, longest: int) -> None:
        self.body, self.at, self.items, self.longest = body, 0, 0, longest

    def value(self, node: Any, depth: int) -> Any:
        """The value of a node of the header."""
        self.items += 1
        if depth > MAX_DEPTH or self.items > MAX_ITEMS:
            raise FrameError("expected fewer values, or less nesting")
        if isinstance(node, dict):
            ((kind, inner),) = node.items()
            return self._composed(kind, inner, depth)
        if isinstance(node, str):
            node.encode()  # half a character raises
        fits = (
            node is None
            or isinstance(node, bool | float | str)
            or (type(node) is int and abs(node) < _INT_LIMIT)
        )
        if not fits or (isinstance(node, str) and len(node) > self.longest):
            raise FrameError("expected a shorter number or text, or a value of another kind")
        return node

    def _composed(self, kind: str, inner: Any, depth: int) -> Any:
        if not isinstance(inner, list):
            raise FrameError("expected a list")
        if kind == "array":
            return self._array(*inner)
        if kind == "dict":
            return {
                str(self.value(key, depth + 1)): self.value(each, depth + 1) for key, each in inner
            }
        if kind not in ("tuple", "list"):
            raise FrameError("expected an array, dict, tuple or list, got another kind of value")
        values = [self.value(each, depth + 1) for each in inner]
        return tuple(values) if kind == "tuple" else values

    def _array(self, name: str, shape: list[int]) -> Any:
        """An array whose size is checked before allocation; without axes a NumPy number."""
        axes = isinstance(shape, list) and len(shape) <= MAX_AXES
        if (
            name not in DTYPES
            or not axes
            or not all(type(n) is int and 0 <= n < 1 << 31 for n in shape)
        ):
            raise FrameError("expected an array of a known type and shape, got another")
        dtype = np.dtype(name).newbyteorder("<")
        count = math.prod(shape)
        if count * dtype.itemsize > len(self.body) - self.at:
            raise FrameError("expected the array's data in the body, got too few bytes")
        raw = np.frombuffer(self.body, np.uint8 if name == "bool" else dtype, count, self.at)
        self.at += count * dtype.itemsize
        array = (raw != 0 if name == "bool" else raw.astype(name)).reshape(
            shape
        )  # a copy, and true is 1
        return array[()] if not shape else array


def _read_exactly(stream: BinaryIO, length: int) -> bytes:
    data = stream.read(length)
    if len(data) < length:
        raise EOFError("the other side has gone")
    return data
