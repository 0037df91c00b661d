"""Flight log: images, commands, states and events <-> an MCAP file that survives a crash;
repair of a damaged log, and a log as a flight table.

In flight the file is unchunked and every record is passed to the system immediately, so a killed
program loses no record; once a second the file is synced to the disk, so a power loss costs about a
second. A clean end repacks it into compressed chunks with an index, and into the messages that
Foxglove draws (core/foxglove.py): an image, raw JPEG until then, becomes a CompressedImage; frames
of aircraft, camera and leader, motion in the units of plots and events as text are added. All of
this is derived from the records, so the loop does not wait for it. Logs with raw images, of earlier
versions or interrupted, are read as well; `recover` turns them into the present form.

Reading does not trust the file: the mcap library allocates the size in a damaged length field,
and its indexed reader refuses a file without its end. Records are therefore framed here (opcode,
8-byte length, body [https://mcap.dev/spec]) and only the body of a frame goes to the library.
"""

import json
import os
import struct
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core import foxglove
from falconwing_kit.core.checks import Array, InputError, require_file, require_range
from falconwing_kit.core.files import atomic_write, require_writable_path, short_name, write_error
from falconwing_kit.core.flight_table import FlightTable, nearest_index
from falconwing_kit.core.messages import COMMAND_NAMES, STATE_NAMES, Command, Event, Image, State

IMAGE, COMMAND, STATE, LEADER, EVENT = TOPICS = (
    "/image", "/command", "/state", "/leader", "/event",
)  # fmt: skip
RAW, JSON = "jpeg", "json"  # encodings of messages: an image in flight, and everything else
COLUMNS: dict[str, dict[str, Any]] = {  # of each JSON topic, with their JSON types
    COMMAND: {
        **dict.fromkeys(COMMAND_NAMES, "number"),
        "image_sequence": "integer",
        "saturated": "boolean",
    },
    STATE: {**{name: ["number", "null"] for name in STATE_NAMES}, "image_sequence": "integer"},
    LEADER: {name: ["number", "null"] for name in STATE_NAMES},
    EVENT: {"name": "string", "details": "object"},
}
SYNC_PERIOD_S = 1.0
MAX_TIME_S = 1.8e10  # 64 bits of nanoseconds
MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 32 * 1024**2
MAX_COMPRESSION = 200  # a chunk that claims a larger ratio is damaged or hostile
FREE_BYTES = 1024  # that a chunk may have beyond that ratio, for short ones
FRAME_HEAD = struct.Struct("<BQ")  # of a record: opcode and length of its body
DATA_END_BYTES = 4  # body of the record that ends the data: a checksum
# What a damaged or foreign record can raise while it is parsed.
UNPARSABLE = (ValueError, TypeError, KeyError, OverflowError, RecursionError)
POSE_STATES = 6  # the first of STATE_NAMES: position and attitude; then velocities and rates
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0C, 0x0F


@dataclass(frozen=True, eq=False)
class FlightLog:
    """Contents of a log. Images stay in the file; `images()` reads them one by one."""

    path: Path
    command_times: Array  # (N,) [s]
    commands: tuple[Command, ...]  # N
    state_times: Array  # (M,) [s]
    states: tuple[State, ...]  # M
    state_sequences: NDArray[np.int64]  # (M,) image of each state, -1 without
    image_times: Array  # (K,) [s]
    image_sequences: NDArray[np.int64]  # (K,)
    events: tuple[Event, ...]
    metadata: Mapping[str, str]
    warnings: tuple[str, ...]  # irregularities, one sentence each
    leader_times: Array = field(default_factory=lambda: np.zeros(0))  # (L,) [s]
    leaders: tuple[State, ...] = ()  # L, of the aircraft that is followed

    @property
    def command_sequences(self) -> NDArray[np.int64]:
        """(N,) image of each command, -1 without."""
        return np.array([command.image_sequence for command in self.commands], dtype=np.int64)

    def images(self) -> Iterator[Image]:
        """The images in logging order, their pixels as JPEG bytes (n,)."""
        for topic, encoding, message in _read_messages(self.path, [], {}):
            if topic == IMAGE:
                with suppress(*UNPARSABLE):  # counted in the warnings
                    pixels = np.frombuffer(_jpeg(encoding, message), dtype=np.uint8)
                    yield Image(sequence=message.sequence, t=message.log_time / 1e9, pixels=pixels)


@dataclass(frozen=True)
class Recovery:
    """Result of `recover`."""

    counts: Mapping[str, int]  # records recovered for each topic: "/command", "/image", ...
    warnings: tuple[str, ...]  # what was lost; empty for an undamaged log


class FlightLogWriter:
    """Writes a flight log: `with FlightLogWriter(path) as log: log.command(t, command)`.

    When a method returns, its record survives a kill of the program. Times are seconds on one
    clock, not negative. The file must not exist: a log is never overwritten.

    Raises:
        InputError: from every method, if the disk is full or a value is not finite; earlier records
            are kept.
        FileNotFoundError: the folder does not exist.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = require_writable_path(path)
        if self.path.exists():
            raise InputError(
                f"{self.path}: expected a new file, for a flight log is never overwritten; "
                "choose another name"
            )

    def __enter__(self) -> "FlightLogWriter":
        from mcap.writer import IndexType, Writer

        try:
            self._file = self.path.open("xb")
            self._writer = Writer(self._file, index_types=IndexType.NONE, use_chunking=False)
            self._writer.start(profile="falconwing")
            self._channels = {topic: self._register(topic) for topic in TOPICS}
            self._file.flush()
        except OSError as error:
            raise write_error(self.path, error) from None
        self._closing = threading.Event()
        self._error: OSError | None = None
        self._sync = threading.Thread(
            target=self._sync_periodically, name="flight log to disk", daemon=True
        )
        self._sync.start()
        return self

    def image(self, image: Image) -> None:
        """Log one camera frame; pixels (height, width, 3) are encoded as JPEG here (by OpenCV)."""
        if not 0 <= image.sequence < 2**32:
            raise InputError(f"image sequence: expected a count from 0, got {image.sequence}")
        self._write(IMAGE, image.t, image.jpeg, image.sequence)

    def command(self, t: float, command: Command, image: Image | None = None) -> None:
        """Log one command given at t [s], then its image if that is not yet logged.

        The command comes first: if the disk fills up in between, it is the more important one.
        """
        self._write_json(COMMAND, t, command.record)
        if image is not None:
            self.image(image)

    def state(self, t: float, state: State, image_sequence: int = -1) -> None:
        """Log the state at t [s] (nan is written as null) and the image it was estimated from."""
        self._write_json(STATE, t, {**state.record, "image_sequence": int(image_sequence)})

    def leader(self, t: float, state: State) -> None:
        """Log the state of the aircraft that is followed, at t [s]."""
        self._write_json(LEADER, t, state.record)

    def event(self, t: float, name: str, details: Mapping[str, Any] | None = None) -> None:
        """Log a single occurrence; details are texts, finite numbers, arrays, lists, mappings."""
        self._write_json(EVENT, t, {"name": str(name), "details": dict(details or {})})

    def metadata(self, record: Mapping[str, object]) -> None:
        """Log facts about the whole flight (aircraft, version, place); values become text."""
        self._write_guarded(
            lambda: self._writer.add_metadata("flight", {str(k): str(v) for k, v in record.items()})
        )

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._closing.set()
        self._sync.join()
        try:
            self._write_guarded(self._writer.finish)
            os.fsync(self._file.fileno())
        except (InputError, OSError) as failure:
            if kind is None:
                raise (
                    write_error(self.path, failure) if isinstance(failure, OSError) else failure
                ) from None
            return
        finally:
            with suppress(OSError):  # a disk error was reported above
                self._file.close()
        try:
            _rewrite(self.path, self.path, [])
        except (InputError, OSError) as failure:
            warn(f"{failure}; the log is complete but stays unpacked", stacklevel=2)

    def _register(self, topic: str) -> int:
        """Register a topic, with a JSON schema unless it holds images; its channel number."""
        if topic not in COLUMNS:
            return int(self._writer.register_channel(topic, RAW, schema_id=0))
        properties = {
            name: {"type": kind} for name, kind in {"t": "number", **COLUMNS[topic]}.items()
        }
        schema = json.dumps({"type": "object", "properties": properties}).encode()
        number = self._writer.register_schema(topic[1:], "jsonschema", schema)
        return int(self._writer.register_channel(topic, JSON, number))

    def _write_json(self, topic: str, t: float, values: Mapping[str, Any]) -> None:
        """Write a record of a JSON topic at time t [s]; InputError for what JSON cannot hold."""
        t = require_range("t", t, low=0.0, high=MAX_TIME_S)
        try:
            data = json.dumps(
                {"t": t, **values}, allow_nan=False, default=lambda array: array.tolist()
            ).encode()
        except (AttributeError, TypeError, ValueError) as error:
            raise InputError(
                f"flight log {topic}: expected texts and finite numbers, got {values} ({error})"
            ) from None
        self._write(topic, t, data, 0)

    def _write(self, topic: str, t: float, data: bytes, sequence: int) -> None:
        """Write one message of a topic at time t [s]."""
        nanoseconds = round(require_range("t", t, low=0.0, high=MAX_TIME_S) * 1e9)
        channel = self._channels[topic]
        self._write_guarded(
            lambda: self._writer.add_message(channel, nanoseconds, data, nanoseconds, sequence)
        )

    def _write_guarded(self, write: Callable[[], None]) -> None:
        """Write and flush to the system; after the first disk error nothing more is written."""
        try:
            if self._error is not None:
                raise self._error
            write()
            self._file.flush()
        except OSError as error:
            self._error = error
            raise write_error(self.path, error) from None

    def _sync_periodically(self) -> None:
        """Sync the file once a second in a thread: a slow disk must not delay the control loop."""
        while not self._closing.wait(SYNC_PERIOD_S):
            try:
                os.fsync(self._file.fileno())
            except OSError as error:
                self._error = error
                return


def read_flight_log(path: str | Path) -> FlightLog:
    """Read an MCAP log, also an interrupted one.

    Returns:
        Everything before the damage; what is unreadable is in its warnings.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is not MCAP.
    """
    warnings: list[str] = []
    metadata: dict[str, str] = {}
    unreadable: Counter[str] = Counter()
    found: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
    for topic, encoding, message in _read_messages(path, warnings, metadata):
        try:
            found[topic].append(_parse(topic, encoding, message))
        except UNPARSABLE:
            unreadable[topic] += 1
    warnings += [
        f"records of {topic} that could not be parsed: {count}"
        for topic, count in unreadable.items()
    ]
    return FlightLog(
        path=Path(path),
        command_times=np.array([t for t, _ in found[COMMAND]], dtype=np.float64),
        commands=tuple(command for _, command in found[COMMAND]),
        state_times=np.array([t for t, _, _ in found[STATE]], dtype=np.float64),
        states=tuple(state for _, state, _ in found[STATE]),
        state_sequences=np.array([sequence for _, _, sequence in found[STATE]], dtype=np.int64),
        image_times=np.array([t for t, _ in found[IMAGE]], dtype=np.float64),
        image_sequences=np.array([sequence for _, sequence in found[IMAGE]], dtype=np.int64),
        events=tuple(found[EVENT]),
        metadata=metadata,
        warnings=tuple(f"{short_name(path)}: {sentence}" for sentence in warnings),
        leader_times=np.array([t for t, _ in found[LEADER]], dtype=np.float64),
        leaders=tuple(state for _, state in found[LEADER]),
    )


def recover(path: str | Path, out: str | Path) -> Recovery:
    """Copy the readable part of a log into a complete, indexed and compressed one for Foxglove.

    Raises:
        FileNotFoundError: there is no log, or no folder for the new file.
        InputError: the log is not MCAP, the paths are equal, or the new file cannot be written.
    """
    if Path(out).resolve() == Path(path).resolve():
        raise InputError(
            f"{out}: expected another name than the log's own, so that the damaged log is kept"
        )
    warnings: list[str] = []
    counts = _rewrite(path, out, warnings)
    return Recovery(counts, tuple(f"{short_name(path)}: {sentence}" for sentence in warnings))


def to_flight_table(log: FlightLog) -> FlightTable:
    """The log as one row per frame: the pose of its state, and the command computed from it.

    Rows are the images; without images the states; without both the commands. A state or a command
    with an image sequence belongs to that image's row. Other rows get the state nearest in time, at
    most half a frame away, and the latest command. A frame without a state has no pose.

    Raises:
        InputError: the log has no commands, or no frame comes after the first one.
    """
    name = short_name(log.path)
    if not log.commands:
        raise InputError(
            f"{name}: expected a log with commands, got none; a flight table needs them"
        )
    times, sequences = _frame_rows(log)
    command_row = _command_rows(log, times, sequences)
    has_command = command_row >= 0  # a flight table has no rows before the first command
    if not has_command.any():
        raise InputError(
            f"{name}: expected a frame after the first command, got none; the log is too short "
            "for a table"
        )
    warnings = log.warnings
    if not has_command.all():
        omitted = (~has_command).sum()
        warnings += (f"{name}: frames left out because no command was given yet: {omitted}",)
    times, sequences = times[has_command], sequences[has_command]
    command_row = command_row[has_command]
    columns = np.full((len(times), len(STATE_NAMES)), np.nan)
    state_row = _state_rows(log, times, sequences)
    if log.states:
        vectors = np.array([state.vector for state in log.states])
        columns[state_row >= 0] = vectors[state_row[state_row >= 0]]
    # States without velocities or rates are all zero there: not measurements.
    extra = {
        column: columns[:, i]
        for i, column in enumerate(STATE_NAMES)
        if i >= POSE_STATES and np.nansum(columns[:, i] ** 2)
    }
    return FlightTable(
        name=name,
        t=times,
        p_world=columns[:, 0:3],
        attitude=columns[:, [5, 3, 4]],
        commands=np.array([command.vector for command in log.commands])[command_row],
        extra=extra,
        warnings=warnings,
    )


def _frame_rows(log: FlightLog) -> tuple[Array, NDArray[np.int64]]:
    """Times and image sequence numbers of the rows, sorted by time."""
    if len(log.image_times):
        times, sequences = log.image_times, log.image_sequences
    elif len(log.state_times):
        times, sequences = log.state_times, log.state_sequences
    else:
        times, sequences = log.command_times, log.command_sequences
    times, first = np.unique(times, return_index=True)
    return times, sequences[first]


def _match_sequences(frames: NDArray[np.int64], records: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the first record with its sequence number, -1 without one."""
    row_of = {
        int(sequence): row for row, sequence in reversed(list(enumerate(records))) if sequence >= 0
    }
    return np.array([row_of.get(int(sequence), -1) for sequence in frames], dtype=np.int64)


def _command_rows(log: FlightLog, times: Array, sequences: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the command computed from it, else the latest one, -1 before the first."""
    rows = _match_sequences(sequences, log.command_sequences)
    order = np.argsort(log.command_times, kind="stable")
    latest = np.searchsorted(log.command_times[order], times, side="right") - 1
    return np.where(rows >= 0, rows, np.where(latest >= 0, order[latest], -1))


def _state_rows(log: FlightLog, times: Array, sequences: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the state estimated from it, else the nearest in time, -1 without one."""
    rows = _match_sequences(sequences, log.state_sequences)
    if not log.states:
        return rows
    half_frame = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    order = np.argsort(log.state_times, kind="stable")
    nearest = order[nearest_index(log.state_times[order], times)]
    close = (np.abs(log.state_times[nearest] - times) <= half_frame) & (
        log.state_sequences[nearest] < 0
    )
    return np.where(rows >= 0, rows, np.where(close, nearest, -1))


def _read_messages(
    path: str | Path, warnings: list[str], metadata: dict[str, str]
) -> Iterator[tuple[str, str, Any]]:
    """Messages of the known TOPICS, with topic and encoding; fills in warnings and metadata."""
    from mcap.records import Channel, Message, Metadata

    channels: dict[int, tuple[str, str]] = {}
    for record in read_mcap_records(path, warnings):
        if isinstance(record, Channel):
            channels.setdefault(record.id, (record.topic, record.message_encoding))
        elif isinstance(record, Metadata):
            metadata.update(record.metadata)
        elif isinstance(record, Message):
            topic, encoding = channels.get(record.channel_id, ("", ""))
            if topic in TOPICS:
                yield topic, encoding, record


def _jpeg(encoding: str, message: Any) -> bytes:
    """The bytes of an image: raw, as in flight and in earlier versions, or Foxglove's."""
    return bytes(message.data) if encoding != JSON else foxglove.unpack_image(message.data)


def _parse(topic: str, encoding: str, message: Any) -> Any:
    """A message's content: (t, sequence), (t, Command), (t, State[, sequence]) or Event."""
    if topic == IMAGE:
        _jpeg(encoding, message)  # raises for one that `images` could not give
        return message.log_time / 1e9, message.sequence
    record = json.loads(message.data)
    if not isinstance(record, dict):
        raise InputError("expected a JSON object")
    t = require_range("t", record["t"], low=0.0, high=MAX_TIME_S)
    if topic == COMMAND:
        return t, Command.from_record(record)
    if topic == EVENT:
        return Event(t, str(record["name"]), dict(record["details"]))
    if topic == LEADER:
        return t, State.from_record(record)
    sequence = require_range("image_sequence", record["image_sequence"], low=-1, high=2**32)
    return t, State.from_record(record), int(sequence)


# The MCAP file: frames -> records, and records -> a repacked file.


def read_mcap_records(path: str | Path, warnings: list[str]) -> Iterator[Any]:
    """Schema, Channel, Message and Metadata records of an MCAP file, up to its end or first damage.

    Each kind of damage adds one sentence to the warnings.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is not MCAP.
    """
    path = require_file(path)
    size = path.stat().st_size
    damaged = 0
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            found = "another kind of file" if size else "an empty file"
            raise InputError(
                f"{short_name(path)}: expected a flight log in MCAP format, got {found}; "
                "check the path"
            )
        for opcode, body in _read_frames(file, size - len(MAGIC), warnings):
            records = _parse_frame(opcode, body)
            damaged += records is None
            yield from records or ()
    if damaged:
        warnings.append(f"damaged records left out: {damaged}")


def _rewrite(source: str | Path, target: str | Path, warnings: list[str]) -> Counter[str]:
    """Copy the readable records into compressed chunks with the index that viewers need.

    Images become Foxglove's, and what it draws besides is derived anew from the other records.

    Args:
        source: a log, complete or damaged.
        target: the file to write, atomically; may be the source.
        warnings: receives one sentence for each kind of damage in the source.

    Returns:
        Number of messages written, by topic, without the derived ones.
    """
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.writer import Writer

    with atomic_write(target) as file:
        writer = Writer(file)
        writer.start(profile="falconwing")
        copy = _Copy(writer)
        for record in read_mcap_records(source, warnings):
            if isinstance(record, Schema):
                copy.schema(record)
            elif isinstance(record, Channel):
                copy.channel(record)
            elif isinstance(record, Message):
                copy.message(record)
            elif isinstance(record, Metadata):
                copy.metadata(record)
        writer.finish()
    return copy.counts


class _Copy:
    """A log on its way into another file, record by record."""

    def __init__(self, writer: Any) -> None:
        self.counts: Counter[str] = Counter()
        self._writer = writer
        self._schemas: dict[int, Any] = {}  # of the source, by their number there
        self._schemas_copied: dict[int, int] = {}  # the same number -> the one in the new file
        # Of the source's channels, by their number there: the new number, topic and encoding.
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._added: dict[str, int] = {}  # topic or schema that Foxglove needs -> its new number
        self._p_body_camera = [0.0, 0.0, 0.0]

    def schema(self, record: Any) -> None:
        """Keep a schema until a channel needs it."""
        self._schemas.setdefault(record.id, record)

    def channel(self, record: Any) -> None:
        """Copy a channel that is new, unless its messages are derived from others."""
        schema = self._schemas.get(record.schema_id)
        is_derived = schema is not None and foxglove.TOPICS.get(record.topic) == schema.name
        if record.id in self._channels or is_derived:
            return
        if record.topic == IMAGE and record.message_encoding == RAW:
            number = self._add(IMAGE, foxglove.IMAGE_SCHEMA)
        else:
            number = self._writer.register_channel(
                record.topic, record.message_encoding, self._copy_schema(schema), record.metadata
            )
        self._channels[record.id] = number, record.topic, record.message_encoding

    def _copy_schema(self, schema: Any) -> int:
        """The number of a schema in the new file; 0 for none."""
        if schema is None:
            return 0
        if schema.id not in self._schemas_copied:
            self._schemas_copied[schema.id] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        return self._schemas_copied[schema.id]

    def metadata(self, record: Any) -> None:
        """Copy metadata; the camera's place is taken from it."""
        self._writer.add_metadata(record.name, record.metadata)
        with suppress(*UNPARSABLE):
            place = np.array(json.loads(record.metadata["p_body_camera"]), dtype=np.float64)
            if place.shape == (3,) and np.isfinite(place).all():
                self._p_body_camera = place.tolist()

    def message(self, record: Any) -> None:
        """Copy a message, and add what Foxglove draws of it."""
        if record.channel_id not in self._channels:
            return
        number, topic, encoding = self._channels[record.channel_id]
        is_raw = topic == IMAGE and encoding == RAW
        data = foxglove.pack_image(record.log_time, record.data) if is_raw else record.data
        self._writer.add_message(
            number, record.log_time, data, record.publish_time, record.sequence
        )
        self.counts[topic] += 1
        if topic in COLUMNS and encoding == JSON:
            with suppress(*UNPARSABLE):  # copied all the same
                for topic_added, data in self._derive(topic, record):
                    added = self._add(topic_added, foxglove.TOPICS[topic_added])
                    self._writer.add_message(added, record.log_time, data, record.publish_time)

    def _derive(self, topic: str, record: Any) -> list[tuple[str, bytes]]:
        """Topics and messages that Foxglove draws of a record."""
        if topic == COMMAND:
            return []
        at, content = record.log_time, _parse(topic, JSON, record)
        if topic == EVENT:
            return [foxglove.text_message(at, content.name, content.details)]
        if topic == LEADER:
            return foxglove.leader_messages(at, content[1])
        found = foxglove.aircraft_messages(at, content[1])
        if found and foxglove.CAMERA_TOPIC not in self._added:
            found.append(foxglove.camera_message(at, self._p_body_camera))
        return found

    def _add(self, topic: str, name: str) -> int:
        """The number of a channel for Foxglove, registered with its schema when first needed."""
        if name not in self._added:
            self._added[name] = self._writer.register_schema(
                name, "jsonschema", foxglove.SCHEMAS[name]
            )
        if topic not in self._added:
            self._added[topic] = self._writer.register_channel(topic, JSON, self._added[name])
        return self._added[topic]


def _read_frames(
    file: BinaryIO, remaining: int, warnings: list[str]
) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of each record up to the end of the data or to an impossible length."""
    while remaining >= FRAME_HEAD.size:
        opcode, length = FRAME_HEAD.unpack(file.read(FRAME_HEAD.size))
        if opcode == _DATA_END and length == DATA_END_BYTES:
            return
        if opcode == 0 or length > remaining - FRAME_HEAD.size:
            break
        remaining -= FRAME_HEAD.size + length
        yield opcode, file.read(length)
    lost = f"; its last {remaining} bytes cannot be read" if remaining else ""
    warnings.append(
        "the log ends without its closing record, so writing it was interrupted or it was cut"
        + lost
    )


def _parse_frame(opcode: int, body: bytes) -> list[Any] | None:
    """The records in a frame: several for a chunk, none for an index, None if damaged."""
    new_stream, McapError, readers = _mcap_readers()
    if opcode not in readers:
        return []
    try:
        record = readers[opcode](new_stream(BytesIO(body)), len(body))
        return _parse_chunk(record) if opcode == _CHUNK else [record]
    except (McapError, struct.error, UnicodeDecodeError, OverflowError):
        return None


@cache
def _mcap_readers() -> tuple[Any, Any, dict[int, Callable[[Any, int], Any]]]:
    """MCAP's stream of bytes, its error, and opcode -> reader of a record from stream and length.

    Kept, because these imports for each record would take as long as the reading.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, Message, Metadata, Schema

    readers: dict[int, Callable[[Any, int], Any]] = {
        _SCHEMA: lambda stream, length: Schema.read(stream),
        _CHANNEL: lambda stream, length: Channel.read(stream),
        _MESSAGE: Message.read,
        _CHUNK: lambda stream, length: Chunk.read(stream),
        _METADATA: lambda stream, length: Metadata.read(stream),
    }
    return ReadDataStream, McapError, readers


def _parse_chunk(chunk: Any) -> list[Any] | None:
    """The records in a chunk, None unless its frames fill it exactly."""
    data = _decompress(chunk)
    if data is None:
        return None
    frames = list(_read_frames(BytesIO(data), len(data), []))
    if sum(FRAME_HEAD.size + len(body) for _, body in frames) != len(data):
        return None
    parsed = [_parse_frame(opcode, body) for opcode, body in frames if opcode != _CHUNK]
    return [record for records in parsed for record in records or ()]


def _decompress(chunk: Any) -> bytes | None:
    """The uncompressed bytes of a chunk, None if size or checksum differ from its header."""
    import lz4.frame  # type: ignore[import-untyped]
    import zstandard

    size = chunk.uncompressed_size
    if size > min(MAX_CHUNK_BYTES, MAX_COMPRESSION * len(chunk.data) + FREE_BYTES):
        return None
    try:
        if chunk.compression == "zstd":
            unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
            data = unpacker.stream_reader(chunk.data).read(size)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
        else:
            data = chunk.data if chunk.compression == "" else b""
    except (zstandard.ZstdError, RuntimeError):
        return None
    crc_differs = chunk.uncompressed_crc not in (0, zlib.crc32(data))
    return None if len(data) != size or crc_differs else bytes(data)
