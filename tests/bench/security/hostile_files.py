"""Files made to hang or to fill whoever reads them, one kind for each way there is, written small.

python -m tests.bench.security.hostile_files        the table: file → CPU s, MB, sentence
"""

import atexit
import functools
import gzip
import io
import json
import lzma
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from fleet.telemetry.mavlink.parsing import scan
from fleet.telemetry.replay.offset_copies import write_checksums
from tests.bench.security import hostile_tables as tables
from tests.support.ulog_writer import flight, ulog

CPU_S, MEMORY_MB = 30.0, 300.0
_ROW = "vehicle_attitude"
_COLUMNS = """
[tables.all]
time = "t"
[position]
columns = ["x", 8.5, 500]
units = ["deg", "deg", "m"]
"""


def read_apart(path: Path, cpu_s: float = 60.0, memory_mb: float = 4000.0) -> dict[str, object]:
    """Read a file in its own process; return CPU time [s], peak memory [MB], number of messages, error or warning.

    The system ends a reader that exceeds the bounds; the sentence reports it.
    """
    columns = path.parent / "columns.toml"
    columns.write_text(_COLUMNS)
    request = json.dumps([str(path), str(columns), int(cpu_s), int(memory_mb * 2**20)])
    requests, answers = _reader()
    requests.write(request + "\n")
    requests.flush()
    answer = json.loads(answers.readline())
    if code := answer.pop("code"):
        words = answer.get("died", "ended by the system")
        return {"cpu_s": cpu_s, "mb": memory_mb, "news": 0, "sentence": f"DIED ({code}): {words}"}
    return answer


@functools.cache
def _reader() -> tuple[IO[str], IO[str]]:
    """Start the process whose children read; it ends with this one."""
    command = [sys.executable, "-m", "tests.bench.security.file_reader"]
    reader = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert reader.stdin and reader.stdout
    atexit.register(reader.communicate)
    return reader.stdin, reader.stdout


# --- ULog ------------------------------------------------------------------------------------------------------------

_HEAD = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000)


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def _topic(number: int, name: str = _ROW, instance: int = 0) -> bytes:
    return _message("A", struct.pack("<BH", instance, number) + name.encode())


def _rows(n: int, us: int = 1000, fields: int = 0) -> bytes:
    made = [_HEAD, _message("F", f"{_ROW}:uint64_t timestamp;float[{fields or 4}] q;".encode()), _topic(0)]
    made += [_message("D", struct.pack("<HQ", 0, 1_000_000 + k * us) + bytes(4 * (fields or 4))) for k in range(n)]
    return b"".join(made)


def regex() -> bytes:
    """A format of 254 bytes whose fields may be cut apart in 2^n ways."""
    return (_HEAD + _message("F", b"a:" + b"bb cc" * 45 + b"!"))[:254]


def nested() -> bytes:
    """Formats within formats, eight deep, thousands of numbers each, subscribed to again and again."""
    made = [_HEAD]
    inner = ["uint8_t", *(f"f{k}" for k in range(1, 6))]
    fields = [";".join(f"{kind} x{i}" for i in range(6)) for kind in inner]
    made += [_message("F", f"f{k}:{fields[k - 1]};".encode()) for k in range(1, 6)]
    made.append(_message("F", f"{_ROW}:uint64_t timestamp;{';'.join(f'f4 y{i}' for i in range(3))};".encode()))
    made.append(_message("F", f"big:uint64_t timestamp;{';'.join(f'f5 y{i}' for i in range(8))};".encode()))
    made += [_topic(k, _ROW if k % 2 else "big", k % 256) for k in range(2000)]
    return b"".join(made)


def many_formats() -> bytes:
    """A million formats."""
    return _HEAD + b"".join(_message("F", f"f{k}:uint64_t timestamp;".encode()) for k in range(1_000_000))


def false_starts() -> bytes:
    """Text in which a message begins at every fourth byte and none ends well."""
    block = (b"zzL7" * 5000 + b"\x01") * 50
    return _rows(50) + block * 40


def false_formats() -> bytes:
    """Formats in which others begin, all of them with a bad last field."""
    return _rows(50) + (b"zzFa:" + b"b c;" * 5 + b"!") * 800_000


def tiny_marks() -> bytes:
    """Millions of the smallest messages there are."""
    return _rows(50) + _message("O", b"\x01\x00") * 6_000_000


def lone_rows() -> bytes:
    """Rows a minute apart, for years."""
    return _rows(400_000, us=59_000_000)


def rows_unfolding() -> bytes:
    """Good rows without end, compressed a thousandfold."""
    return _rows(3_000_000, us=10)


# --- others ----------------------------------------------------------------------------------------------------------


def _frames(n: int, step_us: int = 10_000, system: int = 1) -> bytes:
    """Return frames of one aircraft, in tens: a heartbeat and nine of attitude."""
    from pymavlink.dialects.v20 import ardupilotmega as mav

    talker = mav.MAVLink(io.BytesIO(), system, 1)
    beat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3)
    attitude = mav.MAVLink_attitude_message(0, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0)
    ten = [beat.pack(talker), *[attitude.pack(talker)] * 9]
    start = np.cumsum([8, *(8 + len(frame) for frame in ten[:-1])])
    out = np.tile(np.frombuffer(b"".join(bytes(8) + frame for frame in ten), np.uint8), (n // 10, 1))
    number = np.arange(n).reshape(-1, 10)
    us, ms = 1_600_000_000_000_000 + number * step_us, number * step_us // 1000 % 2**32
    for k, at in enumerate(start.tolist()):
        out[:, at - 8 : at] = us[:, k : k + 1].astype(">u8").view(np.uint8)
        if k:
            out[:, at + 10 : at + 14] = ms[:, k : k + 1].astype("<u4").view(np.uint8)
    extra = np.array([beat.crc_extra, *[attitude.crc_extra] * 9], np.uint8)
    write_checksums(out, start, start + 10, np.array([len(frame) - 12 for frame in ten]), extra, scan.CRC)
    return out.tobytes()


def fd_everywhere() -> bytes:
    """One frame, and then every byte begins another."""
    return _frames(20) + b"\xfd\xff\x00\x00\x00\x01\x01\x1e\x00\x00" * 6_400_000


def zeros_after_a_frame() -> bytes:
    """Good frames, then 8 GB of zeros."""
    return _frames(20)


def lone_frames() -> bytes:
    """Frames an hour apart."""
    return _frames(300_000, step_us=3_600_000_000)


def many_senders() -> bytes:
    """All systems there may be, each in its turn."""
    return b"".join(_frames(300, system=k) for k in range(1, 255))


def formats_over_and_over() -> bytes:
    """A DataFlash log that declares a format, uses it, and declares it otherwise."""
    fmt = b"\xa3\x95\x80\x80\x59FMT\0BBnNZ\0\0\0\0\0\0\0\0\0\0\0Type,Length,Name,Format,Columns".ljust(89, b"\0")
    one = b"\xa3\x95\x80\x01\x0bATT\0Q" + b"\0" * 15 + b"TimeUS".ljust(64, b"\0")
    two = b"\xa3\x95\x80\x01\x0bIMU\0Q" + b"\0" * 15 + b"TimeUS".ljust(64, b"\0")
    return fmt + b"".join(f + b"\xa3\x95\x01" + struct.pack("<Q", k) for k in range(80_000) for f in (one, two))


def magic_everywhere() -> bytes:
    """A DataFlash log in which a message begins at every other byte."""
    return formats_over_and_over()[:2000] + b"\xa3\x95" * 16_000_000


def long_lines() -> bytes:
    """A DataFlash text log of one endless line, and lines of numbers of thousands of digits."""
    line = b"ATT, " + b"9" * 4000 + b"\n"
    return b"FMT, 1, 11, ATT, Q, TimeUS\n" + line * 8000 + b"ATT, " + b"1," * 16_000_000


def records_in_records() -> bytes:
    """A fleet recording in which a record of 4 MB begins at every twelfth byte."""
    return struct.pack("<4sII", b"\xc1UV1", 4_000_000, 1) * 1_000_000


def many_ids() -> bytes:
    """A fleet recording of a hundred thousand aircraft."""
    from fleet.bus.codec import encode, encoding
    from fleet.contract import Status
    from fleet.telemetry.recording.fleet_log import BusRecord

    made = (
        BusRecord(1.6e9 + k * 1e-3, encoding(Status), encode(Status(uav=k, t=1.6e9))).pack() for k in range(100_000)
    )
    return b"".join(made)


def _members(first: bytes, more: bytes, times: int) -> bytes:
    """Compress, and go on with the same member again and again: gigabytes cost nothing to make."""
    return gzip.compress(first) + gzip.compress(more) * times


def _bomb(make: Callable[[], bytes]) -> bytes:
    return _members(make(), bytes(1 << 26), 128)


FILES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "regex": ("254.ulg", regex),
    "nested formats": ("nested.ulg", nested),
    "a million formats": ("formats.ulg", many_formats),
    "false starts": ("starts.ulg", false_starts),
    "false formats": ("false.ulg", false_formats),
    "tiny marks": ("marks.ulg", tiny_marks),
    "lone rows": ("lone.ulg", lone_rows),
    "ULog that unfolds": ("rows.ulg.xz", lambda: lzma.compress(rows_unfolding(), preset=1)),
    "ULog and 8 GB": ("bomb.ulg.gz", lambda: _bomb(lambda: _rows(50))),
    "tlog of false starts": ("fd.tlog", fd_everywhere),
    "tlog and 8 GB": ("bomb.tlog.gz", lambda: _bomb(zeros_after_a_frame)),
    "tlog, good for 8 GB": ("good.tlog.gz", lambda: _members(_frames(20), _frames(10) * 20_000, 1000)),
    "tlog with gaps": ("lone.tlog", lone_frames),
    "tlog of all systems": ("many.tlog", many_senders),
    "DataFlash, formats over and over": ("over.bin", formats_over_and_over),
    "DataFlash, magic everywhere": ("magic.bin", magic_everywhere),
    "DataFlash and 8 GB": ("bomb.bin.gz", lambda: _bomb(lambda: formats_over_and_over()[:2000])),
    "text, long lines": ("long.log", long_lines),
    "text and 8 GB": ("bomb.log.gz", lambda: _bomb(lambda: long_lines()[:2000])),
    "records in records": ("records.parauav", records_in_records),
    "a hundred thousand ids": ("ids.parauav", many_ids),
    "stream of false starts": ("fd.mavlink", lambda: tables.stream_of_false_starts(_frames(200, step_us=100_000))),
    "table of one line": ("line.csv", tables.one_line_table),
    "table and 8 GB": ("bomb.csv.gz", lambda: _bomb(lambda: b"t,x\n1,2\n")),
    "MATLAB of a billion cells": ("cells.mat", tables.matlab_of_a_billion),
    "MATLAB that unfolds": ("packed.mat", tables.matlab_that_unfolds),
    "MCAP that unfolds": ("packed.mcap", tables.mcap_that_unfolds),
    "MCAP of long records": ("long.mcap", tables.mcap_of_long_records),
    "SQLite bag without end": ("endless.db3", tables.bag_without_end),
    "fleet recording and 8 GB": ("bomb.parauav.gz", lambda: _bomb(lambda: many_ids()[:20_000])),
}


def written(folder: Path, what: str) -> Path:
    """Write one of `FILES`."""
    name, make = FILES[what]
    path = folder / name
    path.write_bytes(make())
    return path


def table(names: list[str]) -> Iterator[tuple[str, int, dict[str, object]]]:
    """Read each file apart: (what, bytes on disk, what it cost)."""
    with tempfile.TemporaryDirectory() as folder:
        for what in names:
            path = written(Path(folder), what)
            size = path.stat().st_size
            yield what, size, read_apart(path)
            path.unlink()


def _attempt(what: str) -> Callable[[], str]:
    """Give an attempt that fails where a file takes more than the bounds."""

    def read() -> str:
        ((_, size, cost),) = table([what])
        words = f"{size:,} B: {cost['cpu_s']:.1f} s, {cost['mb']:.0f} MB; {cost['sentence']}"[:200]
        assert float(cost["cpu_s"]) <= CPU_S and float(cost["mb"]) <= MEMORY_MB, words  # type: ignore[arg-type]
        return words

    read.__name__, read.__doc__ = f"file_{what.replace(' ', '_')}", FILES[what][1].__doc__
    return read


def rightful_files() -> str:
    """A short log of each kind, whole: it is read, and the reader costs what it costs the hostile ones at least."""
    made = {"a.ulg": ulog(flight((1, 13), 20.0)), "a.tlog": a_flight(), "a.parauav": many_ids()[:20_000]}
    with tempfile.TemporaryDirectory() as folder:
        for name, data in made.items():
            path = Path(folder) / name
            path.write_bytes(data)
            cost = read_apart(path)
            assert cost["news"], f"{name}: {cost['sentence']}"
    return f"{', '.join(made)}: read"


def a_flight() -> bytes:
    """A minute of telemetry."""
    return _frames(600, step_us=100_000)


def main() -> int:
    """Print the table; exit code 1 where a file took too much."""
    over = 0
    for what, size, cost in table([name for name in FILES if not sys.argv[1:] or name in sys.argv[1:]]):
        bad = float(cost["cpu_s"]) > CPU_S or float(cost["mb"]) > MEMORY_MB  # type: ignore[arg-type]
        over += bad
        words = str(cost["sentence"])[:150]
        costs = f"{cost['cpu_s']:6.2f} s {cost['mb']:6.0f} MB"
        print(f"{'OVER' if bad else 'held':5}{what:34}{size:>14,} B {costs}  {words}", flush=True)
    return int(over > 0)


BY_FILE = (*map(_attempt, FILES), rightful_files)


if __name__ == "__main__":
    os.nice(5)
    sys.exit(main())
