"""Tables, MATLAB files, bags and streams made to hang or to fill whoever reads them; see `hostile_files`."""

import struct
import tempfile
from pathlib import Path


def stream_of_false_starts(stamped: bytes) -> bytes:
    """A raw MAVLink stream: some frames, and then every byte begins another."""
    frames, at = [], 0
    while at < len(stamped):
        size = stamped[at + 9] + (12 if stamped[at + 8] == 0xFD else 8)
        frames.append(stamped[at + 8 : at + 8 + size])
        at += 8 + size
    return b"".join(frames) + b"\xfd\xff\x00\x00\x00\x01\x01\x1e\x00\x00" * 6_400_000


def one_line_table() -> bytes:
    """A table of one endless line, then of lines of a hundred thousand cells."""
    return b"t,x\n" + b"1," * 40_000_000 + b"\n" + (b"1," * 30_000 + b"\n") * 400


def matlab_of_a_billion() -> bytes:
    """A MATLAB file that declares a cell array of a billion elements."""

    def element(kind: int, body: bytes) -> bytes:
        return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)

    flags, dims = element(6, struct.pack("<II", 1, 0)), element(5, struct.pack("<ii", 1, 1_000_000_000))
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + element(14, flags + dims + element(1, b"a"))


def matlab_that_unfolds() -> bytes:
    """A MATLAB file of one variable that decompresses a thousandfold."""
    import zlib

    engine = zlib.compressobj(wbits=-15)
    block = engine.compress(bytes(1 << 20)) + engine.flush(zlib.Z_FULL_FLUSH)  # needs nothing before it
    checksum = (1 << 29) % 65_521 << 16 | 1  # Adler-32 of so many zeros
    packed = b"\x78\x9c" + block * (1 << 9) + b"\x03\x00" + checksum.to_bytes(4, "big")
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed


def mcap_that_unfolds() -> bytes:
    """An MCAP file with one chunk of a few kilobytes that decompresses to half a gigabyte."""
    import zstandard

    packed = zstandard.ZstdCompressor().compress(bytes(1 << 29))
    chunk = (
        struct.pack("<QQQI", 0, 1, 1 << 29, 0)
        + struct.pack("<I", 4)
        + b"zstd"
        + struct.pack("<Q", len(packed))
        + packed
    )
    return b"\x89MCAP0\r\n" + b"\x06" + struct.pack("<Q", len(chunk)) + chunk


def mcap_of_long_records() -> bytes:
    """An MCAP file whose records claim to be 16 exabytes long."""
    return b"\x89MCAP0\r\n" + (b"\x05" + b"\xff" * 8) * 100_000


def bag_without_end() -> bytes:
    """A SQLite bag whose table of messages is a view that never ends."""
    import sqlite3

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        base = sqlite3.connect(path)
        base.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        base.execute("CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)")
        base.execute("INSERT INTO topics VALUES(1, '/mavros/vfr_hud', 'a/msg/B', 'cdr')")
        base.execute("INSERT INTO message_definitions VALUES('a/msg/B', 'ros2msg', 'float32 airspeed')")
        base.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) "
            "SELECT 1 AS topic_id, k AS timestamp, x'00' AS data FROM n"
        )
        base.commit()
        base.close()
        return path.read_bytes()
