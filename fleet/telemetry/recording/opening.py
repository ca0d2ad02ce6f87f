"""Read recordings in pieces, compressed or not, with progress and a size limit; and the pace of a replay."""

import bz2
import gzip
import lzma
import math
import stat
import threading
import time
import zlib
from collections.abc import Callable
from io import RawIOBase
from pathlib import Path
from typing import IO, Any

_OPENERS: dict[str, Callable[..., Any]] = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}
COMPRESSED = tuple(_OPENERS)
_READ_ERRORS = (EOFError, lzma.LZMAError, OSError, MemoryError, zlib.error)  # errors raised by damaged archives
MAX_RATIO = 12  # maximum compression ratio; recordings reach 5 to 10
MIN_UNPACKED_LIMIT = 1 << 24  # decompressed size allowed for any file [bytes]
MAX_UNPACKED = 1 << 28  # maximum decompressed size [bytes]


class RecordingFile:
    """One recording as a file: can be opened repeatedly, and stores the last read problem.

    Raises:
        OSError: if it is not a readable file; check path and permissions.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.name = self.path.name
        self.problem = ""
        self.stop: threading.Event | None = None  # set it to end reading
        try:
            status = self.path.stat()
        except OSError as error:
            reason = error.strerror or "not there"
            raise OSError(f"{self.path}: found no such file ({reason}), expected a recording; check the path") from None
        if stat.S_ISDIR(status.st_mode):
            raise OSError(f"{self.path}: found a folder, expected a recording; name a file in it")
        if not stat.S_ISREG(status.st_mode):
            raise OSError(f"{self.path}: found no regular file, expected a recording; copy it into one")
        self.size = status.st_size
        self._raw: IO[bytes] | None = None

    @property
    def share(self) -> float:
        """Return the progress of the latest read, fraction of the file 0..1."""
        if self._raw is None or not self.size:
            return 0.0
        return 1.0 if self._raw.closed else min(self._raw.tell() / self.size, 1.0)

    def open(self) -> "RecordingStream":
        """Open the file at the start.

        Raises:
            OSError: if it cannot be opened; the message has the reason.
        """
        try:
            self._raw = self.path.open("rb")
        except OSError as error:
            raise OSError(f"{self.path}: cannot be read ({error.strerror}); check its permissions") from None
        opener = _OPENERS.get(self.path.suffix)
        if opener is None:
            return RecordingStream(self, self._raw)
        max_bytes = min(max(MIN_UNPACKED_LIMIT, MAX_RATIO * self.size), MAX_UNPACKED)
        return RecordingStream(self, opener(self._raw), max_bytes)


class RecordingStream(RawIOBase):
    """Bytes of a recording; they end at damage or at the size limit, and the recording stores the problem."""

    def __init__(self, recording_file: RecordingFile, stream: Any, max_bytes: int | None = None) -> None:
        self._recording_file, self._stream, self._remaining, self._bytes_read = recording_file, stream, max_bytes, 0

    def readable(self) -> bool:
        """Return True: the stream is readable."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer; return the number of bytes, 0 at the end."""
        filled = 0
        if self._recording_file.stop is not None and self._recording_file.stop.is_set():
            return 0
        while filled < len(buffer):
            wanted = len(buffer) - filled if self._remaining is None else min(len(buffer) - filled, self._remaining)
            if not wanted:
                size = f"{self._recording_file.size:,} bytes that decompress to more than {self._bytes_read >> 20} MiB"
                self._recording_file.problem = f"found {size}, the rest was not read; decompress a trusted file first"
                break
            try:
                data = self._stream.read1(wanted)
            except _READ_ERRORS as error:
                self._recording_file.problem = f"the compressed file is damaged ({error}); the data before are used"
                break
            if not data:
                break
            buffer[filled : filled + len(data)] = data
            filled += len(data)
            self._bytes_read += len(data)
            self._remaining = None if self._remaining is None else self._remaining - len(data)
        return filled

    def close(self) -> None:
        """Close the stream and its file."""
        if not self.closed:
            self._stream.close()
            if self._recording_file._raw is not None:
                self._recording_file._raw.close()
        super().close()


class ReplayPace:
    """Replay at a multiple of real time.

    Args:
        speed: recorded seconds per second; inf: as fast as possible
    """

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self.passed_s = 0.0  # recorded time replayed [s]
        self._first_t: float | None = None
        self._started = self._newest = 0.0

    def wait(self, now: float, stop: threading.Event) -> bool:
        """Wait until recorded time `now` [s since 1970] is due; return True if stopped meanwhile."""
        if self._first_t is None:
            self._first_t, self._started = now, time.monotonic()
        due = self._started + (now - self._first_t) / self.speed - time.monotonic()
        stopped = stop.wait(due) if due > 0 else stop.is_set()
        self.passed_s, self._newest = now - self._first_t, time.monotonic()
        return stopped

    @property
    def elapsed_s(self) -> float:
        """Return the elapsed wall time [s]."""
        return self._newest - self._started

    @property
    def speed_reached(self) -> float:
        """Return the mean replay speed, recorded seconds per second; nan before the start."""
        return self.passed_s / self.elapsed_s if self.elapsed_s > 0 else math.nan

    def progress_text(self) -> str:
        """Return progress and speed as text."""
        minutes, seconds = divmod(int(self.passed_s), 60)
        hours, minutes = divmod(minutes, 60)
        speed_text = "" if math.isnan(self.speed_reached) else f", {self.speed_reached:.1f} times real time"
        return (f"{hours}:" if hours else "") + f"{minutes:02}:{seconds:02} recorded{speed_text}"


def read_speed(text: str, option: str = "speed") -> float:
    """Parse a replay speed: a multiple of real time, or `max`; `option` names it in errors.

    Raises:
        ValueError: if it is neither; pass a number above 0 or `max`.
    """
    try:
        speed = math.inf if text == "max" else float(text)
    except ValueError:
        speed = 0.0
    if not speed > 0:
        raise ValueError(f"{option}: found {text!r}, expected a number above 0 or max; write e.g. 4")
    return speed
