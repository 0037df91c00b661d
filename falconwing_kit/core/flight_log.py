"""Flight log: images, commands, states and events of a flight <-> an MCAP file that survives a
crash.

While flying the file is not chunked and every record is handed to the system at once, so a killed
program loses no record; once a second the system is told to put it on the disk, so a lost battery
costs about a second. At a clean end the file is packed into compressed chunks with an index.
Foxglove, PlotJuggler and others open it.
"""

import json
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import require_writable_path, short_name, write_error
from falconwing_kit.core.flight_table import FlightTable, nearest_index
from falconwing_kit.core.mcap_records import read_mcap_records, rewrite
from falconwing_kit.core.messages import COMMAND_NAMES, STATE_NAMES, Command, Event, Image, State

IMAGE, COMMAND, STATE, EVENT = TOPICS = ("/image", "/command", "/state", "/event")
SYNC_PERIOD_S = 1.0
MAX_TIME_S = 1.8e10  # what 64 bits of nanoseconds hold


COLUMNS: dict[str, dict[str, Any]] = {  # of each JSON topic, with their JSON types
    COMMAND: {
        **dict.fromkeys(COMMAND_NAMES, "number"),
        "image_sequence": "integer",
        "saturated": "boolean",
    },
    STATE: {**{name: ["number", "null"] for name in STATE_NAMES}, "image_sequence": "integer"},
    EVENT: {"name": "string", "details": "object"},
}


@dataclass(frozen=True, eq=False)
class FlightLog:
    """What a log holds. Images stay in the file: `images()` reads them one by one."""

    path: Path
    command_times: Array  # (N,) [s]
    commands: tuple[Command, ...]  # N
    state_times: Array  # (M,) [s]
    states: tuple[State, ...]  # M
    state_sequences: NDArray[np.int64]  # (M,) the image each state comes from, -1 where none
    image_times: Array  # (K,) [s]
    image_sequences: NDArray[np.int64]  # (K,)
    events: tuple[Event, ...]
    metadata: Mapping[str, str]
    warnings: tuple[str, ...]  # what was unusual, one sentence each

    @property
    def command_sequences(self) -> NDArray[np.int64]:
        """(N,) the image each command answers, -1 where none."""
        return np.array([command.image_sequence for command in self.commands], dtype=np.int64)

    def images(self) -> Iterator[Image]:
        """The images in the order they were logged, their pixels as JPEG bytes (n,)."""
        for topic, message in _read_messages(self.path, [], {}):
            if topic == IMAGE:
                pixels = np.frombuffer(message.data, dtype=np.uint8)
                yield Image(sequence=message.sequence, t=message.log_time / 1e9, pixels=pixels)


@dataclass(frozen=True)
class Recovery:
    """What `recover` saved."""

    counts: Mapping[str, int]  # records of each topic: "/command", "/image", ...
    warnings: tuple[str, ...]  # what could not be saved; empty for a log that was whole


class FlightLogWriter:
    """Writes a flight log: `with FlightLogWriter(path) as log: log.command(t, command)`.

    When a method returns, its record survives a kill of the program. Times are seconds on one
    clock, not negative.

    Args:
        path: the file to write; it must not exist, for a log is never overwritten.

    Raises:
        InputError: from every method, when the disk is full or a value is not finite; what was
            logged before stays.
        FileNotFoundError: the folder does not exist.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = require_writable_path(path)
        if self.path.exists():
            raise InputError(
                f"{self.path}: expected a new file, for a flight log is never overwritten; choose another name"
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
        """Log one camera frame.

        Args:
            image: with pixels (height, width, 3) RGB, which are packed as JPEG here (needs OpenCV),
                or JPEG (n,).
        """
        if not 0 <= image.sequence < 2**32:
            raise InputError(f"image sequence: expected a count from 0, got {image.sequence}")
        self._write(IMAGE, image.t, image.jpeg, image.sequence)

    def command(self, t: float, command: Command, image: Image | None = None) -> None:
        """Log one command.

        Args:
            t: when it was given [s].
            command: what was given.
            image: the image it answers, logged right after it where that was not done before: if
                the disk fills up in between, the command is the one to have.
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
            details: more about it; texts, finite numbers, arrays, lists and mappings.
        """
        self._write_json(EVENT, t, {"name": str(name), "details": dict(details or {})})

    def metadata(self, record: Mapping[str, object]) -> None:
        """Log what holds for the whole flight: aircraft, software version, place.

        Args:
            record: names and values; values are kept as text.
        """
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
            with suppress(OSError):  # whatever the disk refused was reported above
                self._file.close()
        try:
            rewrite(self.path, self.path, [])
        except (InputError, OSError) as failure:
            warn(f"{failure}; the log is complete but stays unpacked", stacklevel=2)

    def _register(self, topic: str) -> int:
        """Announce a topic, with a JSON schema unless it holds images; its number in the file."""
        if topic not in COLUMNS:
            return int(self._writer.register_channel(topic, "jpeg", schema_id=0))
        properties = {
            name: {"type": kind} for name, kind in {"t": "number", **COLUMNS[topic]}.items()
        }
        schema = json.dumps({"type": "object", "properties": properties}).encode()
        number = self._writer.register_schema(topic[1:], "jsonschema", schema)
        return int(self._writer.register_channel(topic, "json", number))

    def _write_json(self, topic: str, t: float, values: Mapping[str, Any]) -> None:
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
        nanoseconds = round(require_range("t", t, low=0.0, high=MAX_TIME_S) * 1e9)
        channel = self._channels[topic]
        self._write_guarded(
            lambda: self._writer.add_message(channel, nanoseconds, data, nanoseconds, sequence)
        )

    def _write_guarded(self, write: Callable[[], None]) -> None:
        """Write and hand over to the system; after a disk's first refusal nothing more is written."""
        try:
            if self._error is not None:
                raise self._error
            write()
            self._file.flush()
        except OSError as error:
            self._error = error
            raise write_error(self.path, error) from None

    def _sync_periodically(self) -> None:
        """Put the file on the disk once a second, in its own thread: a slow disk must not delay the
        loop.
        """
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
    found: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
    for topic, message in _read_messages(path, warnings, metadata):
        try:
            found[topic].append(_parse(topic, message))
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            unreadable[topic] += 1
    warnings += [
        f"records of {topic} that could not be understood: {count}"
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
        InputError: the log is not MCAP, the two paths are the same, or the new file cannot be
            written.
    """
    if Path(out).resolve() == Path(path).resolve():
        raise InputError(
            f"{out}: expected another name than the log's own, so that the damaged log is kept"
        )
    warnings: list[str] = []
    counts = rewrite(path, out, warnings)
    return Recovery(counts, tuple(f"{short_name(path)}: {sentence}" for sentence in warnings))


def to_flight_table(log: FlightLog) -> FlightTable:
    """The log as one row per frame: states as poses, and the command that answered each frame.

    Rows are the images, or the states where there are no images, or the commands alone. A state or
    a command that names its image goes to that row. Where none does, the row takes the state
    nearest in time, at most half a frame away, and the last command given.

    Args:
        log: the flight.

    Returns:
        The flight table; a frame without a state has no pose.

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
    flown = command_row >= 0  # rows before the first command cannot stand in a flight table
    if not flown.any():
        raise InputError(
            f"{name}: expected a frame after the first command, got none; the log is too short for a table"
        )
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
    extra = {
        column: columns[:, i]
        for i, column in enumerate(STATE_NAMES)
        if i >= 6 and np.nansum(columns[:, i] ** 2)
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
    """Times and image sequence numbers of the rows, in order of time."""
    if len(log.image_times):
        times, sequences = log.image_times, log.image_sequences
    elif len(log.state_times):
        times, sequences = log.state_times, log.state_sequences
    else:
        times, sequences = log.command_times, log.command_sequences
    times, first = np.unique(times, return_index=True)
    return times, sequences[first]


def _match_sequences(sequences: NDArray[np.int64], answers: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the first record that names it, -1 where none does."""
    row_of = {
        int(sequence): row for row, sequence in reversed(list(enumerate(answers))) if sequence >= 0
    }
    return np.array([row_of.get(int(sequence), -1) for sequence in sequences], dtype=np.int64)


def _command_rows(log: FlightLog, times: Array, sequences: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the command that answers it or else the last one given, -1 where there is none
    yet.
    """
    rows = _match_sequences(sequences, log.command_sequences)
    order = np.argsort(log.command_times, kind="stable")
    last = np.searchsorted(log.command_times[order], times, side="right") - 1
    return np.where(rows >= 0, rows, np.where(last >= 0, order[last], -1))


def _state_rows(log: FlightLog, times: Array, sequences: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each frame the state that names it or else the nearest in time, -1 where there is none."""
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
) -> Iterator[tuple[str, Any]]:
    """Messages of the topics that we know, each with its topic."""
    from mcap.records import Channel, Message, Metadata

    topics: dict[int, str] = {}
    for record in read_mcap_records(path, warnings):
        if isinstance(record, Channel):
            topics.setdefault(record.id, record.topic)
        elif isinstance(record, Metadata):
            metadata.update(record.metadata)
        elif isinstance(record, Message) and topics.get(record.channel_id) in TOPICS:
            yield topics[record.channel_id], record


def _parse(topic: str, message: Any) -> Any:
    """A message as what it stands for: (t, sequence), (t, Command), (t, State, sequence) or Event."""
    if topic == IMAGE:
        return message.log_time / 1e9, message.sequence
    record = json.loads(message.data)
    if not isinstance(record, dict):
        raise InputError("expected a JSON object")
    t = require_range("t", record["t"], low=0.0, high=MAX_TIME_S)
    if topic == COMMAND:
        return t, Command.from_record(record)
    if topic == EVENT:
        return Event(t, str(record["name"]), dict(record["details"]))
    sequence = require_range("image_sequence", record["image_sequence"], low=-1, high=2**32)
    return t, State.from_record(record), int(sequence)
