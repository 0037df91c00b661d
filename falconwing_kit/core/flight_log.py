"""Flight log: images, commands, states and events of a flight <-> an MCAP file that survives a crash.

While flying the file is not chunked and every record is handed to the system at once, so a killed program loses no
record; once a second the system is told to put it on the disk, so a lost battery costs about a second. At a clean end
the file is packed into compressed chunks with an index. Foxglove, PlotJuggler and others open it.
"""

import json
import os
import threading
import warnings as python_warnings
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import require_place, short_name, write_error
from falconwing_kit.core.flight_table import FlightTable, nearest_index
from falconwing_kit.core.mcap_records import read_records, rewrite
from falconwing_kit.core.messages import COMMAND_NAMES, STATE_NAMES, Command, Event, Image, State

IMAGE, COMMAND, STATE, EVENT = TOPICS = ("/image", "/command", "/state", "/event")
SYNC_PERIOD_S = 1.0
MAX_TIME_S = 1.8e10  # what 64 bits of nanoseconds hold


def _schema(numbers: tuple[str, ...], others: Mapping[str, str]) -> bytes:
    properties = {**{name: {"type": "number"} for name in numbers}, **{k: {"type": v} for k, v in others.items()}}
    return json.dumps({"type": "object", "properties": properties}).encode()


SCHEMAS = {
    COMMAND: _schema(("t", *COMMAND_NAMES), {"image_sequence": "integer", "saturated": "boolean"}),
    STATE: _schema(("t", *STATE_NAMES), {"image_sequence": "integer"}),
    EVENT: _schema(("t",), {"name": "string", "details": "object"}),
}


@dataclass(frozen=True, eq=False)
class FlightLog:
    """What a log holds. Images stay in the file: `images()` reads them one by one."""

    path: Path
    command_times: Array  # (N,) [s]
    commands: tuple[Command, ...]  # N, each with the sequence number of the image it answers
    state_times: Array  # (M,) [s]
    states: tuple[State, ...]  # M
    state_sequences: NDArray[np.int64]  # (M,) the image each state comes from, -1 where none
    image_times: Array  # (K,) [s]
    image_sequences: NDArray[np.int64]  # (K,)
    events: tuple[Event, ...]
    metadata: Mapping[str, str]
    warnings: tuple[str, ...]  # what was unusual, one sentence each

    def images(self) -> Iterator[Image]:
        """The images in the order they were logged, their pixels as JPEG bytes (n,)."""
        for topic, message in _messages(self.path, [], {}):
            if topic == IMAGE:
                pixels = np.frombuffer(message.data, dtype=np.uint8)
                yield Image(sequence=message.sequence, t=message.log_time / 1e9, pixels=pixels)


@dataclass(frozen=True)
class Recovery:
    """What `recover` saved."""

    commands: int
    images: int
    states: int
    events: int
    warnings: tuple[str, ...]  # what could not be saved; empty for a log that was whole


class FlightLogWriter:
    """Writes a flight log: `with FlightLogWriter(path) as log: log.command(t, command)`.

    When a method returns, its record survives a kill of the program. Times are seconds on one clock, not negative.

    Args:
        path: the file to write; it must not exist, for a log is never overwritten.

    Raises:
        InputError: from every method, when the disk is full or a value is not finite; what was logged before stays.
        FileNotFoundError: the folder does not exist.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = require_place(path)
        if self.path.exists():
            raise InputError(
                f"{self.path}: there is a file already, and a flight log is never overwritten; name another"
            )

    def __enter__(self) -> "FlightLogWriter":
        from mcap.writer import CompressionType, IndexType, Writer

        try:
            self._file = self.path.open("xb")
            self._writer = Writer(
                self._file, compression=CompressionType.NONE, index_types=IndexType.NONE, use_chunking=False
            )
            self._writer.start(profile="falconwing")
            self._channels = {}
            for topic in TOPICS:
                has_schema = topic in SCHEMAS
                schema = self._writer.register_schema(topic[1:], "jsonschema", SCHEMAS[topic]) if has_schema else 0
                self._channels[topic] = self._writer.register_channel(topic, "json" if has_schema else "jpeg", schema)
            self._file.flush()
        except OSError as error:
            raise write_error(self.path, error) from None
        self._closing = threading.Event()
        self._error: OSError | None = None
        self._sync = threading.Thread(target=self._sync_often, name="flight log to disk", daemon=True)
        self._sync.start()
        return self

    def image(self, image: Image) -> None:
        """Log one camera frame.

        Args:
            image: with pixels (height, width, 3) RGB, which are packed as JPEG here (needs OpenCV), or JPEG (n,).
        """
        if not 0 <= image.sequence < 2**32:
            raise InputError(f"image sequence: want a count from 0, got {image.sequence}")
        self._write(IMAGE, image.t, _jpeg(image.pixels), image.sequence)

    def command(self, t: float, command: Command, image: Image | None = None) -> None:
        """Log one command.

        Args:
            t: when it was given [s].
            command: what was given.
            image: the image it answers, logged right after it where that was not done before: if the disk fills up
                in between, the command is the one to have.
        """
        self._write_json(COMMAND, t, command.record)
        if image is not None:
            self.image(image)

    def state(self, t: float, state: State, image_sequence: int = -1) -> None:
        """Log one state; what is nan in it stays unknown.

        Args:
            t: the time it is valid for [s].
            state: the estimate.
            image_sequence: the image it comes from, -1 where there was none.
        """
        self._write_json(STATE, t, {**state.record, "image_sequence": int(image_sequence)})

    def event(self, t: float, name: str, details: Mapping[str, Any] | None = None) -> None:
        """Log something that happened once.

        Args:
            t: when [s].
            name: what, in a word or two.
            details: more about it; texts, finite numbers, lists and mappings.
        """
        self._write_json(EVENT, t, {"name": str(name), "details": dict(details or {})})

    def metadata(self, record: Mapping[str, object]) -> None:
        """Log what holds for the whole flight: aircraft, software version, place.

        Args:
            record: names and values; values are kept as text.
        """
        self._guarded(lambda: self._writer.add_metadata("flight", {str(k): str(v) for k, v in record.items()}))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._closing.set()
        self._sync.join()
        try:
            self._guarded(self._writer.finish)
            os.fsync(self._file.fileno())
        except (InputError, OSError) as failure:
            if kind is None:
                raise write_error(self.path, failure) if isinstance(failure, OSError) else failure from None
            return
        finally:
            with suppress(OSError):  # whatever the disk refused was reported above
                self._file.close()
        try:
            rewrite(self.path, self.path, [])
        except InputError as failure:
            python_warnings.warn(f"{failure}; the log is complete but stays unpacked", stacklevel=2)

    def _write_json(self, topic: str, t: float, values: Mapping[str, Any]) -> None:
        t = require_range("t", t, low=0.0, high=MAX_TIME_S)
        try:
            data = json.dumps({"t": t, **values}, allow_nan=False).encode()
        except (TypeError, ValueError) as error:
            raise InputError(f"flight log {topic}: want texts and finite numbers, got {values} ({error})") from None
        self._write(topic, t, data, 0)

    def _write(self, topic: str, t: float, data: bytes, sequence: int) -> None:
        nanoseconds = round(require_range("t", t, low=0.0, high=MAX_TIME_S) * 1e9)
        channel = self._channels[topic]
        self._guarded(lambda: self._writer.add_message(channel, nanoseconds, data, nanoseconds, sequence))

    def _guarded(self, write: Callable[[], None]) -> None:
        """Write and hand over to the system; after a disk's first refusal nothing more is written."""
        try:
            if self._error is not None:
                raise self._error
            write()
            self._file.flush()
        except OSError as error:
            self._error = error
            raise write_error(self.path, error) from None

    def _sync_often(self) -> None:
        """Put the file on the disk once a second, in its own thread: a slow disk must not delay the loop."""
        while not self._closing.wait(SYNC_PERIOD_S):
            try:
                os.fsync(self._file.fileno())
            except OSError as error:
                self._error = error
                return


def read_flight_log(path: str | Path) -> FlightLog:
    """Read a log, also one whose writing was cut short.

    Args:
        path: the MCAP file.

    Returns:
        Everything before the damage; what could not be read is in its warnings.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is not MCAP.
    """
    warnings: list[str] = []
    metadata: dict[str, str] = {}
    unreadable: Counter[str] = Counter()
    found: dict[str, list[Any]] = {topic: [] for topic in (COMMAND, STATE, EVENT)}
    image_times, image_sequences = array("d"), array("q")
    for topic, message in _messages(path, warnings, metadata):
        if topic == IMAGE:
            image_times.append(message.log_time / 1e9)
            image_sequences.append(message.sequence)
        else:
            try:
                found[topic].append(_PARSERS[topic](_json_record(message.data)))
            except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
                unreadable[topic] += 1
    warnings += [f"records of {topic} that could not be understood: {count}" for topic, count in unreadable.items()]
    return FlightLog(
        path=Path(path),
        command_times=np.array([t for t, _ in found[COMMAND]], dtype=np.float64),
        commands=tuple(command for _, command in found[COMMAND]),
        state_times=np.array([t for t, _, _ in found[STATE]], dtype=np.float64),
        states=tuple(state for _, state, _ in found[STATE]),
        state_sequences=np.array([sequence for _, _, sequence in found[STATE]], dtype=np.int64),
        image_times=np.array(image_times, dtype=np.float64),
        image_sequences=np.array(image_sequences, dtype=np.int64),
        events=tuple(found[EVENT]),
        metadata=metadata,
        warnings=tuple(f"{short_name(path)}: {sentence}" for sentence in warnings),
    )


def recover(path: str | Path, out: str | Path) -> Recovery:
    """Write what can be read of a log as a whole, indexed and compressed one.

    Args:
        path: the log, cut or damaged or whole; it is not changed.
        out: the new file.

    Returns:
        How much was saved and what was not.

    Raises:
        FileNotFoundError: there is no log, or no folder for the new file.
        InputError: the log is not MCAP, the two paths are the same, or the new file cannot be written.
    """
    if Path(out).resolve() == Path(path).resolve():
        raise InputError(f"{out}: want another name than the log's own, so that the damaged log is kept")
    warnings: list[str] = []
    counts = rewrite(path, out, warnings)
    sentences = tuple(f"{short_name(path)}: {sentence}" for sentence in warnings)
    return Recovery(counts[COMMAND], counts[IMAGE], counts[STATE], counts[EVENT], sentences)


def to_flight_table(log: FlightLog) -> FlightTable:
    """The log as one row per frame: states as poses, and the command that answered each frame.

    Rows are the images, or the states where there are no images, or the commands alone. A state or a command that
    names its image goes to that row. Where none does, the row takes the state nearest in time, at most half a frame
    away, and the last command given.

    Args:
        log: the flight.

    Returns:
        The flight table; a frame without a state has no pose.

    Raises:
        InputError: the log has no commands, or no frame comes after the first one.
    """
    name = short_name(log.path)
    if not log.commands:
        raise InputError(f"{name}: want a log with commands, got none; a flight table needs them")
    times, sequences = _frames(log)
    command_sequences = np.array([command.image_sequence for command in log.commands])
    command_row = _answering(sequences, command_sequences)
    order = np.argsort(log.command_times, kind="stable")
    last_given = np.searchsorted(log.command_times[order], times, side="right") - 1
    command_row = np.where(command_row >= 0, command_row, np.where(last_given >= 0, order[last_given], -1))
    # Rows before the first command cannot stand in a flight table.
    flown = command_row >= 0
    if not flown.any():
        raise InputError(f"{name}: want a frame after the first command, got none; the log is too short for a table")
    warnings = log.warnings
    if not flown.all():
        warnings += (f"{name}: frames left out because no command was given yet: {(~flown).sum()}",)
    times, sequences, command_row = times[flown], sequences[flown], command_row[flown]
    columns = np.full((len(times), len(STATE_NAMES)), np.nan)
    state_row = _state_rows(log, times, sequences)
    if log.states:
        vectors = np.array([state.vector for state in log.states])
        columns[state_row >= 0] = vectors[state_row[state_row >= 0]]
    # A state without velocities or rates holds zeros there, which must not pass for measurements.
    extra = {column: columns[:, i] for i, column in enumerate(STATE_NAMES) if i >= 6 and np.nansum(columns[:, i] ** 2)}
    return FlightTable(
        name=name,
        t=times,
        p_world=columns[:, 0:3],
        attitude=columns[:, [5, 3, 4]],
        commands=np.array([command.vector for command in log.commands])[command_row],
        extra=extra,
        warnings=warnings,
    )


def _frames(log: FlightLog) -> tuple[Array, NDArray[np.int64]]:
    """Times and image sequence numbers of the rows, in order of time."""
    command_sequences = np.array([command.image_sequence for command in log.commands], dtype=np.int64)
    candidates = (
        (log.image_times, log.image_sequences),
        (log.state_times, log.state_sequences),
        (log.command_times, command_sequences),
    )
    times, sequences = next((t, s) for t, s in candidates if len(t))
    times, first = np.unique(times, return_index=True)
    return times, sequences[first]


def _answering(sequences: NDArray[np.int64], answers: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the first record that names it, -1 where none does."""
    row_of = {int(sequence): row for row, sequence in reversed(list(enumerate(answers))) if sequence >= 0}
    return np.array([row_of.get(int(sequence), -1) for sequence in sequences], dtype=np.int64)


def _state_rows(log: FlightLog, times: Array, sequences: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the state that names it or else the nearest in time, -1 where there is none."""
    rows = _answering(sequences, log.state_sequences)
    if not log.states:
        return rows
    half_frame = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    order = np.argsort(log.state_times, kind="stable")
    nearest = order[nearest_index(log.state_times[order], times)]
    close = (np.abs(log.state_times[nearest] - times) <= half_frame) & (log.state_sequences[nearest] < 0)
    return np.where(rows >= 0, rows, np.where(close, nearest, -1))


def _messages(path: str | Path, warnings: list[str], metadata: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Messages of the topics that we know, each with its topic."""
    from mcap.records import Channel, Message, Metadata

    topics: dict[int, str] = {}
    for record in read_records(path, warnings):
        if isinstance(record, Channel):
            topics.setdefault(record.id, record.topic)
        elif isinstance(record, Metadata):
            metadata.update(record.metadata)
        elif isinstance(record, Message) and topics.get(record.channel_id) in TOPICS:
            yield topics[record.channel_id], record


def _json_record(data: bytes) -> dict[str, Any]:
    record = json.loads(data)
    if not isinstance(record, dict):
        raise InputError("want a JSON object")
    record["t"] = require_range("t", record["t"], low=0.0, high=MAX_TIME_S)
    return record


def _parse_state(record: dict[str, Any]) -> tuple[float, State, int]:
    sequence = require_range("image_sequence", record["image_sequence"], low=-1, high=2**32)
    return record["t"], State.from_record(record), int(sequence)


_PARSERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    COMMAND: lambda record: (record["t"], Command.from_record(record)),
    STATE: _parse_state,
    EVENT: lambda record: Event(record["t"], str(record["name"]), dict(record["details"])),
}


def _jpeg(pixels: NDArray[np.uint8]) -> bytes:
    if pixels.ndim == 1:
        return pixels.tobytes()
    import cv2

    return bytes(cv2.imencode(".jpg", pixels[..., ::-1])[1])
