"""Serialised messages of ROS 2 bags in bounded memory: MCAP (own definitions inside) and SQLite (since ROS 2 Iron)."""

import io
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator
from typing import IO, Any, NamedTuple

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader

MAX_SCHEMA = 1 << 18  # maximum size of the definition of a message [bytes]
_MAX_RECORD = 1 << 25  # maximum size of a record, a chunk included [bytes]
_MAX_CHUNK = 1 << 25  # maximum size of a decompressed chunk [bytes]
_MAX_RATIO, _MIN_UNPACKED = 12, 1 << 24  # maximum compression ratio, and what is allowed to any file [bytes]
_MAX_TOPICS = 5000
_MAX_DATABASE = 1 << 30  # maximum size of a database [bytes]
_MAX_MESSAGE = 1 << 20  # longer messages are images or point clouds [bytes]
_STEPS_PER_CHECK, _MAX_CHECKS = 100_000, 20_000  # of SQLite's virtual machine, against queries without end


_DAMAGE = (McapError, EOFError, OSError, ValueError, KeyError, RuntimeError, struct.error, zstandard.ZstdError)


class BagMessage(NamedTuple):
    """One serialised message."""

    topic: str
    type: str  # e.g. sensor_msgs/msg/Imu
    definition: str  # of the type and those that it contains
    log_s: float  # when the bag received it [s since 1970]
    data: bytes


Opener = Callable[[], Any]


def mcap_messages(opener: Opener, skipped: list[str]) -> Iterator[BagMessage]:
    """Yield the messages of an MCAP file in the order of the file; damage ends it."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    foreign: set[str] = set()
    try:
        with opener() as stream:
            for record in _records(stream):
                if isinstance(record, Schema) and len(schemas) < _MAX_TOPICS and len(record.data) <= MAX_SCHEMA:
                    schemas[record.id] = record
                elif isinstance(record, Channel) and len(channels) < _MAX_TOPICS:
                    channels[record.id] = record
                elif isinstance(record, Message) and (channel := channels.get(record.channel_id)) is not None:
                    schema = schemas.get(channel.schema_id)
                    if schema is None or channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
                        foreign.add(channel.message_encoding[:20] or "unknown")
                    elif len(record.data) <= _MAX_MESSAGE:
                        text = schema.data.decode("utf-8", "replace")
                        yield BagMessage(channel.topic, schema.name, text, record.log_time * 1e-9, record.data)
    except (
        McapError,
        EOFError,
        OSError,
        ValueError,
        KeyError,
        RuntimeError,
        struct.error,
        zstandard.ZstdError,
    ) as error:
        skipped.append(f"the file is damaged ({type(error).__name__}: {error}); the messages before are used")
    if foreign:
        skipped.append(f"messages in the encoding {', '.join(sorted(foreign)[:5])} skipped, expected cdr with ros2msg")


def _records(stream: IO[bytes]) -> Iterator[object]:
    """Yield the records, those of chunks included, until the end of the data."""
    packed = unpacked = 0
    for record in StreamReader(stream, emit_chunks=True, record_size_limit=_MAX_RECORD).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        data = _decompressed(record)
        packed, unpacked = packed + len(record.data), unpacked + len(data)
        if unpacked > max(_MIN_UNPACKED, _MAX_RATIO * packed):
            raise ValueError("chunks decompress to far more than a flight has; decompress a trusted file")
        try:
            yield from StreamReader(io.BytesIO(data), skip_magic=True, record_size_limit=_MAX_CHUNK).records
        except (EOFError, McapError, struct.error):  # the end of the chunk
            continue


def _decompressed(chunk: Chunk) -> bytes:
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(chunk.data).read(_MAX_CHUNK + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=_MAX_CHUNK + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"found compression {chunk.compression[:20]!r}, expected zstd or lz4")
    if len(data) > _MAX_CHUNK:
        raise ValueError(f"found a chunk of over {_MAX_CHUNK >> 20} MiB, expected less; write smaller chunks")
    return data


def sqlite_messages(opener: Opener, skipped: list[str]) -> Iterator[BagMessage]:
    """Yield the messages of a SQLite bag in the order of time; a bag without definitions has none."""
    with tempfile.NamedTemporaryFile(suffix=".db3") as copy:
        with opener() as stream:
            shutil.copyfileobj(_Limited(stream, skipped), copy)
        copy.flush()
        try:
            with _connect(copy.name) as database:
                yield from _stored_messages(database, skipped)
        except (sqlite3.Error, ValueError, OverflowError) as error:
            skipped.append(f"the database is damaged ({error}); the messages before are used")


class _Limited(io.RawIOBase):
    """Stream that ends at the maximum size of a database."""

    def __init__(self, stream: IO[bytes], skipped: list[str]) -> None:
        self._stream, self._skipped, self._remaining = stream, skipped, _MAX_DATABASE

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(min(size if size > 0 else 1 << 20, self._remaining)) or b""
        self._remaining -= len(data)
        if not self._remaining:
            self._skipped.append(f"over {_MAX_DATABASE >> 20} MiB, the rest was not read; split it")
        return data


def _connect(path: str) -> sqlite3.Connection:
    database = sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)
    database.execute("PRAGMA trusted_schema = OFF")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 1 << 24)
    checks = iter(range(_MAX_CHECKS))
    database.set_progress_handler(lambda: next(checks, None) is None, _STEPS_PER_CHECK)
    database.text_factory = lambda raw: raw.decode("utf-8", "replace")
    return database


def _stored_messages(database: sqlite3.Connection, skipped: list[str]) -> Iterator[BagMessage]:
    stored = {
        name: sql or ""
        for name, sql in database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table' LIMIT 1000")
    }
    if not {"topics", "messages"} <= stored.keys() or any("VIRTUAL" in sql.upper() for sql in stored.values()):
        raise ValueError("found no tables topics and messages, expected a ROS 2 bag; check the file")
    definitions: dict[str, str] = {}
    if "message_definitions" in stored:
        query = "SELECT topic_type, encoded_message_definition, encoding FROM message_definitions LIMIT 5000"
        rows = database.execute(query).fetchall()
        definitions = {
            str(name): str(text) for name, text, kind in rows if kind == "ros2msg" and len(text) < MAX_SCHEMA
        }
    topics = database.execute("SELECT id, name, type, serialization_format FROM topics LIMIT 5000").fetchall()
    known = {
        number: (str(name), str(kind), definitions[str(kind)])
        for number, name, kind, encoding in topics
        if str(kind) in definitions and encoding == "cdr"
    }
    if undefined := sorted({str(kind) for _, _, kind, _ in topics} - definitions.keys()):
        skipped.append(
            f"{len(undefined)} types without definition in the bag ({', '.join(undefined[:3])[:120]} …); "
            "expected them as ROS 2 Iron and later write; convert it to MCAP with `ros2 bag convert`"
        )
    if not known:
        return
    for number, t_ns, data in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp"):
        if number in known and isinstance(data, bytes) and len(data) <= _MAX_MESSAGE and isinstance(t_ns, int):
            yield BagMessage(*known[number], t_ns * 1e-9, data)
