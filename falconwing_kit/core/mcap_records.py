"""MCAP: a log file, whole, cut or damaged -> the records that can be read; and those records
rewritten as a whole file.

The mcap library reads a damaged length field as an order to allocate that much, and its indexed
reader refuses every file without its end. Here the records are framed by hand, so nothing larger
than the file explains is ever allocated, and the library parses what is inside a frame. Format:
https://mcap.dev/spec (opcode, 8-byte length, body).
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 32 * 1024**2
MAX_COMPRESSION = 200  # a chunk that claims to unpack to more than this ratio is damaged or hostile
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0C, 0x0F


def read_mcap_records(path: str | Path, warnings: list[str]) -> Iterator[Any]:
    """Read a log from its start up to its end or to the first damage.

    Args:
        path: the MCAP file.
        warnings: gets one sentence for each kind of trouble met.

    Yields:
        Schema, Channel, Message and Metadata records of the mcap library, in the order of the file.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is not MCAP.
    """
    path = require_file(path)
    size = path.stat().st_size
    bad = 0
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            what = "another kind of file" if size else "an empty file"
            raise InputError(
                f"{short_name(path)}: expected a flight log in MCAP format, got {what}; check the path"
            )
        for opcode, body in _read_frames(file, size - len(MAGIC), warnings):
            records = _parse_frame(opcode, body)
            bad += records is None
            yield from records or ()
    if bad:
        warnings.append(f"damaged records left out: {bad}")


def rewrite(source: str | Path, target: str | Path, warnings: list[str]) -> Counter[str]:
    """Write what can be read of a log as a complete one: in compressed chunks, with the index that
    viewers want.

    Args:
        source: a log, whole, cut or damaged.
        target: the file to write, which appears only once it is complete; may be the source.
        warnings: gets one sentence for each kind of trouble met in the source.

    Returns:
        Messages written, by topic.

    Raises:
        FileNotFoundError: there is no source, or no folder for the target.
        InputError: the source is not MCAP, or the target cannot be written.
    """
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.writer import Writer

    schemas: dict[int, int] = {0: 0}
    channels: dict[int, tuple[int, str]] = {}
    counts: Counter[str] = Counter()
    with atomic_write(target) as file:
        writer = Writer(file)
        writer.start(profile="falconwing")
        for record in read_mcap_records(source, warnings):
            if isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = writer.register_schema(
                    record.name, record.encoding, record.data
                )
            elif isinstance(record, Channel) and record.id not in channels:
                schema = schemas.get(record.schema_id, 0)
                number = writer.register_channel(
                    record.topic, record.message_encoding, schema, record.metadata
                )
                channels[record.id] = number, record.topic
            elif isinstance(record, Message) and record.channel_id in channels:
                number, topic = channels[record.channel_id]
                writer.add_message(
                    number, record.log_time, record.data, record.publish_time, record.sequence
                )
                counts[topic] += 1
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
        writer.finish()
    return counts


def _read_frames(
    file: BinaryIO, remaining: int, warnings: list[str]
) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of each record up to the end of the data; a length beyond the file's end is
    damage.
    """
    while remaining >= 9:
        opcode, length = struct.unpack("<BQ", file.read(9))
        if opcode == _DATA_END and length == 4:
            return
        if opcode == 0 or length > remaining - 9:
            break
        remaining -= 9 + length
        yield opcode, file.read(length)
    lost = f"; its last {remaining} bytes cannot be read" if remaining else ""
    warnings.append(
        f"the log ends without its closing record, so writing it was interrupted or it was cut{lost}"
    )


def _parse_frame(opcode: int, body: bytes) -> list[Any] | None:
    """The records in a frame: one, many for a chunk, none for kinds that hold no data, None if it
    is damaged.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, Message, Metadata, Schema

    stream = ReadDataStream(BytesIO(body))
    readers = {_SCHEMA: Schema.read, _CHANNEL: Channel.read, _METADATA: Metadata.read}
    try:
        if opcode == _MESSAGE:
            return [Message.read(stream, len(body))]
        if opcode == _CHUNK:
            return _parse_chunk(Chunk.read(stream))
        return [readers[opcode](stream)] if opcode in readers else []
    except (McapError, struct.error, UnicodeDecodeError, OverflowError):
        return None


def _parse_chunk(chunk: Any) -> list[Any] | None:
    """The records in a chunk, None if its frames do not fill it."""
    data = _decompress(chunk)
    if data is None:
        return None
    frames = list(_read_frames(BytesIO(data), len(data), []))
    if sum(9 + len(body) for _, body in frames) != len(data):
        return None
    parsed = [_parse_frame(opcode, body) for opcode, body in frames if opcode != _CHUNK]
    return [record for records in parsed for record in records or ()]


def _decompress(chunk: Any) -> bytes | None:
    """The bytes of a chunk, None where they are not what the chunk promises."""
    import lz4.frame  # type: ignore[import-untyped]
    import zstandard

    size = chunk.uncompressed_size
    if size > min(MAX_CHUNK_BYTES, MAX_COMPRESSION * len(chunk.data) + 1024):
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
