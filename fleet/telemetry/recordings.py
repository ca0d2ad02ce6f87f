"""Recordings as timed bytes: `.tlog` and `.tlog.xz`, whole, cut short or damaged.

A .tlog repeats: 8 bytes big-endian microseconds since 1970, one MAVLink frame.
"""

import logging
import lzma
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from fleet.telemetry.decode import frame_length
from fleet.telemetry.intake import Intake, News
from fleet.telemetry.restamp import Record, backlog_offset, restamped

SUFFIXES = (".tlog", ".tlog.xz")
CHUNK = 1 << 16
FLUSH_S = 0.1  # recorded time between two publications [s]
EARLIEST, LATEST = 3e8, 4e9  # believable stamps [s since 1970]
LONGEST_GAP_S = 86_400.0

_log = logging.getLogger("parauav.recordings")


def records(path: Path | str) -> Iterator[Record]:
    """Read a recording: (when it was received [s since 1970], frame bytes), as it stands in the file.

    Damage is skipped up to the next stamp that fits; what follows is still read. A sentence goes to the log.

    Raises:
        ValueError: when it is no .tlog or holds not a single frame.
        OSError: when it cannot be opened.
    """
    path = Path(path)
    if not path.name.endswith(SUFFIXES):
        raise ValueError(
            f"{path.name}: found {path.suffix or 'no suffix'}, expected {' or '.join(SUFFIXES)}; convert it"
        )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: found no such file, expected a recording; check the path")
    reader = _Reader(path.name)
    for chunk in _chunks(path):
        yield from reader.feed(chunk)
    yield from reader.feed(b"", last=True)
    if not reader.count:
        raise ValueError(f"{path.name}: found no MAVLink frame, expected a telemetry log; check the file")
    if reader.skipped:
        _log.warning("%s: %d damaged bytes skipped, %d frames read", path.name, reader.skipped, reader.count)


def timed(path: Path | str) -> Iterator[Record]:
    """Read a recording in the time the flight took, even where a backlog arrived in a rush.

    Raises:
        ValueError: when it is no recording.
    """
    offset_s = backlog_offset(records(path))
    return records(path) if offset_s is None else restamped(records(path), offset_s)


def _chunks(path: Path) -> Iterator[bytes]:
    with _open(path) as stream:
        while True:
            try:
                chunk = stream.read(CHUNK)
            except (EOFError, lzma.LZMAError) as error:
                _log.warning("%s: the compressed file is damaged (%s); what came before is used", path.name, error)
                return
            if not chunk:
                return
            yield chunk


def _open(path: Path) -> IO[bytes]:
    return lzma.open(path, "rb") if path.suffix == ".xz" else path.open("rb")


class _Reader:
    """Cut the byte stream of a .tlog into records."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.count = self.skipped = 0
        self._buf = bytearray()
        self._t: float | None = None

    def feed(self, chunk: bytes, last: bool = False) -> Iterator[Record]:
        self._buf += chunk
        buf, at = self._buf, 0
        while len(buf) - at >= 11:
            length = self._fits(at)
            if not length:
                at += 1
                self.skipped += 1
                continue
            end = at + 8 + length
            if end > len(buf) or (end + 9 > len(buf) and not last):
                break
            t = int.from_bytes(buf[at : at + 8], "big") * 1e-6
            self._t = t
            self.count += 1
            yield t, bytes(buf[at + 8 : end])
            at = end
        if last:
            self.skipped += len(buf) - at
            at = len(buf)
        del buf[:at]

    def _fits(self, at: int) -> int:
        """Give the frame length when a record starts at `at`, else 0."""
        length = frame_length(self._buf, at + 8)
        if length <= 0:
            return 0
        t = int.from_bytes(self._buf[at : at + 8], "big") * 1e-6
        if self._t is None:
            return length if EARLIEST < t < LATEST else 0
        return length if abs(t - self._t) < LONGEST_GAP_S else 0


def ticks(path: Path | str) -> Iterator[tuple[float, list[Record]]]:
    """Read a recording in steps of 0.1 s: (end of the step [s since 1970], what arrived within it).

    Raises:
        ValueError: when it is no recording.
    """
    due: float | None = None
    heard: list[Record] = []
    for record in timed(path):
        due = record[0] + FLUSH_S if due is None else due
        while record[0] >= due:
            yield due, heard
            due, heard = due + FLUSH_S, []
        heard.append(record)
    if due is not None:
        yield due, heard


def replay_messages(path: Path | str, offset: int = 0, intake: Intake | None = None) -> Iterator[News]:
    """Read a recording as the gateway would have heard it, in time order; fleet time is the recording's own.

    Args:
        path: .tlog or .tlog.xz
        offset: UAV id = MAVLink system id + offset
        intake: one of your own, to read its counters afterwards
    Raises:
        ValueError: when it is no recording.
    """
    intake = Intake(offset) if intake is None else intake
    for now, heard in ticks(path):
        for t, frame in heard:
            intake.hear(t, frame)
        yield from intake.flush(now)
