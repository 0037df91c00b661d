"""CDR: the bytes of a ROS 2 message and the definition in its log -> the message as a dict.

A log carries the definition of each of its message types as text, so no message package is needed:
every type can be decoded, also those of somebody else's laboratory. Sources: the .msg format
[ROS 2 documentation, Interfaces]; its place in MCAP ["ros2msg", mcap.dev/spec/registry]; the bytes,
plain CDR [OMG, DDS-XTypes 1.3, section 7.4.3; RTPS 2.3, section 10.2]: a header of 4 bytes, then
all fields in order, each number aligned to its own size, counted from behind the header.
"""

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.core.checks import InputError

NUMBERS = {  # ROS type -> struct format
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
STRINGS = ("string", "wstring")
# Representation identifier, the header's first two bytes -> byte order and largest alignment.
ENCODINGS = {
    b"\0\0": (">", 8), b"\0\1": ("<", 8),  # plain CDR, what ROS 2 writes
    b"\0\6": (">", 4), b"\0\7": ("<", 4),  # plain CDR of XTypes 1.3: numbers of 8 bytes align to 4
}  # fmt: skip
MAX_DEPTH = 16  # of messages within messages; ROS's own have at most 6

_FIELD = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?"  # "geometry_msgs/Pose", "string<=10"
    r"(?P<array>\[(?:<=)?(?P<count>\d*)\])?"  # "[]", "[3]", "[<=8]"
    r"\s+(?P<name>[A-Za-z]\w*)(?P<rest>.*)"
)


@dataclass(frozen=True)
class Field:
    """One line of a message definition."""

    name: str
    type: str  # a key of NUMBERS, one of STRINGS, or the full name of a message type
    length: int | None = None  # of a fixed array; -1 for an array of any length; None for one value


@dataclass(frozen=True)
class Definition:
    """A message type and all types inside it, each as its fields in order."""

    name: str  # "geometry_msgs/PoseStamped"
    types: Mapping[str, tuple[Field, ...]]


def short_type(name: str) -> str:
    """The type's name without the middle: "geometry_msgs/msg/Pose" -> "geometry_msgs/Pose"."""
    return name.replace("/msg/", "/")


def parse_definition(name: str, text: str) -> Definition:
    """Parse a definition in the form "ros2msg".

    Args:
        name: the message's type, "geometry_msgs/msg/PoseStamped".
        text: its .msg text, then that of every type inside it below "MSG: package/Type", between
            lines of equals signs.

    Raises:
        InputError: a line is no field, a type has no definition, or a type contains itself.
    """
    name = short_type(name)
    first, *others = re.split(r"^=+[ \t]*\r?$", text, flags=re.MULTILINE)
    bodies = {name: first}
    for section in others:
        title, _, body = section.strip().partition("\n")
        bodies[short_type(title.removeprefix("MSG:").strip())] = body
    types = {kind: _parse_fields(kind, body, bodies) for kind, body in bodies.items()}
    _require_finite_depth(name, types, ())
    return Definition(name, types)


def decode(definition: Definition, data: bytes) -> dict[str, Any]:
    """The fields of a message by name; messages inside are dicts, arrays of numbers are arrays.

    Raises:
        InputError: the bytes are of another encoding, or end before the message does.
    """
    if data[:2] not in ENCODINGS:
        raise InputError(
            f"{definition.name}: expected a message in plain CDR, got one that starts with "
            f"0x{data[:2].hex()}"
        )
    try:
        return _Cursor(data, *ENCODINGS[data[:2]]).message(definition.types, definition.name)
    except (struct.error, ValueError, UnicodeDecodeError):
        raise InputError(
            f"{definition.name}: expected a message of this type, got {len(data)} bytes that end "
            "too soon or are of another one"
        ) from None


def _parse_fields(kind: str, body: str, bodies: Mapping[str, str]) -> tuple[Field, ...]:
    fields = []
    for line in body.splitlines():
        line = line.partition("#")[0].strip()
        if not line:
            continue
        match = _FIELD.fullmatch(line)
        if match is None:
            raise InputError(f"{kind}: expected a field of a ROS message, got {line[:60]!r}")
        if match["rest"].lstrip().startswith("="):
            continue  # a constant, which is not in the bytes; other rests are default values
        length = None
        if match["array"]:
            bounded = "<=" in match["array"]
            length = int(match["count"]) if match["count"] and not bounded else -1
        fields.append(Field(match["name"], _full_name(match["type"], kind, bodies), length))
    return tuple(fields)


def _full_name(word: str, kind: str, bodies: Mapping[str, str]) -> str:
    """The type a field means: a plain one, of its own package, or the header of std_msgs."""
    if word in NUMBERS or word in STRINGS:
        return word
    package = kind.partition("/")[0]
    for candidate in (short_type(word), f"{package}/{word}", f"std_msgs/{word}"):
        if candidate in bodies:
            return candidate
    raise InputError(f"{kind}: expected a definition of the type {word}, got none in this log")


def _require_finite_depth(
    kind: str, types: Mapping[str, tuple[Field, ...]], above: tuple[str, ...]
) -> None:
    if kind in above or len(above) > MAX_DEPTH:
        raise InputError(f"{kind}: expected a message of finite depth, got one inside itself")
    for field in types[kind]:
        if field.type in types:
            _require_finite_depth(field.type, types, (*above, kind))


class _Cursor:
    """A place in the bytes of one message."""

    def __init__(self, data: bytes, order: str, largest: int) -> None:
        self.data, self.order, self.largest = data[4:], order, largest
        self.at = 0

    def message(self, types: Mapping[str, tuple[Field, ...]], kind: str) -> dict[str, Any]:
        """The message of this type here; one without fields takes a byte, as in ROS 2."""
        if not types[kind]:
            self.number("B")
        return {field.name: self.field(types, field) for field in types[kind]}

    def field(self, types: Mapping[str, tuple[Field, ...]], field: Field) -> Any:
        """The value of a field: a number, a text, a dict, or an array or list of these."""
        if field.length is None:
            return self.value(types, field.type)
        count = self.number("I") if field.length == -1 else field.length
        if field.type in NUMBERS:
            return self.numbers(NUMBERS[field.type], count)
        if count > len(self.data) - self.at:  # every element has at least one byte
            raise ValueError
        return [self.value(types, field.type) for _ in range(count)]

    def value(self, types: Mapping[str, tuple[Field, ...]], kind: str) -> Any:
        """One value of a type."""
        if kind in NUMBERS:
            return self.number(NUMBERS[kind])
        return self.text(kind) if kind in STRINGS else self.message(types, kind)

    def number(self, form: str) -> Any:
        """One number, aligned to its size."""
        self.align(struct.calcsize(form))
        (value,) = struct.unpack_from(self.order + form, self.data, self.at)
        self.at += struct.calcsize(form)
        return value

    def numbers(self, form: str, count: int) -> Any:
        """An array of numbers, (count,)."""
        kind = np.dtype(self.order + form)
        if count:
            self.align(kind.itemsize)
        values = np.frombuffer(self.data, kind, count, self.at)
        self.at += values.nbytes
        return values

    def text(self, kind: str) -> str:
        """A text: its length, then its letters; with a closing zero (string) or without."""
        count = self.number("I") * (1 if kind == "string" else 2)
        letters = self.data[self.at : self.at + count]
        if len(letters) < count:
            raise ValueError
        self.at += count
        if kind == "string":
            return letters.decode("utf-8", "replace").rstrip("\0")
        return letters.decode("utf-16-le" if self.order == "<" else "utf-16-be", "replace")

    def align(self, size: int) -> None:
        """Step to the next place that this size divides."""
        self.at += -self.at % min(size, self.largest)
