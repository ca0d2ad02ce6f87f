"""Read recordings in pieces, compressed or not, with progress and a size limit."""

import bz2
import gzip
import lzma
import stat
import threading
import zlib
from collections.abc import Callable
from io import RawIOBase
from pathlib import Path
from typing import IO, Any

_OPENERS: dict[str, Callable[..., Any]] = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}
COMPRESSED = tuple(_OPENERS)
_BROKEN = (EOFError, lzma.LZMAError, OSError, MemoryError, zlib.error)  # errors raised by damaged archives
RATIO = 12  # maximum compression ratio; recordings reach 5 to 10
UNFOLDED = 1 << 24  # decompressed size allowed for any file [bytes]
LARGEST_UNFOLDED = 1 << 28  # maximum decompressed size [bytes]


class Source:
    """One recording as a file: can be opened repeatedly, and stores the last read problem.

    Raises:
        OSError: if it is not a readable file; check path and permissions.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.name = self.path.name
        self.trouble = ""
        self.stop: threading.Event | None = None  # set it to end reading
        try:
            found = self.path.stat()
        except OSError as error:
            reason = error.strerror or "not there"
            raise OSError(f"{self.path}: found no such file ({reason}), expected a recording; check the path") from None
        if not stat.S_ISREG(found.st_mode):
            raise OSError(f"{self.path}: found no regular file, expected a recording; copy it into one")
        self.size = found.st_size
        self._raw: IO[bytes] | None = None

    @property
    def share(self) -> float:
        """Return the progress of the latest read, fraction of the file 0..1."""
        if self._raw is None or not self.size:
            return 0.0
        return 1.0 if self._raw.closed else min(self._raw.tell() / self.size, 1.0)

    def open(self) -> "Bytes":
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
            return Bytes(self, self._raw)
        return Bytes(self, opener(self._raw), min(max(UNFOLDED, RATIO * self.size), LARGEST_UNFOLDED))


class Bytes(RawIOBase):
    """Bytes of a recording; they end at damage or at the size limit, and the recording stores the problem."""

    def __init__(self, source: Source, stream: Any, most: int | None = None) -> None:
        self._source, self._stream, self._left, self._read = source, stream, most, 0

    def readable(self) -> bool:
        """Return True: the stream is readable."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer; return the number of bytes, 0 at the end."""
        filled = 0
        if self._source.stop is not None and self._source.stop.is_set():
            return 0
        while filled < len(buffer):
            wanted = len(buffer) - filled if self._left is None else min(len(buffer) - filled, self._left)
            if not wanted:
                size = f"{self._source.size:,} bytes that decompress to more than {self._read >> 20} MiB"
                self._source.trouble = f"found {size}, the rest was not read; decompress a trusted file first"
                break
            try:
                data = self._stream.read1(wanted)
            except _BROKEN as error:
                self._source.trouble = f"the compressed file is damaged ({error}); the data before are used"
                break
            if not data:
                break
            buffer[filled : filled + len(data)] = data
            filled += len(data)
            self._read += len(data)
            self._left = None if self._left is None else self._left - len(data)
        return filled

    def close(self) -> None:
        """Close the stream and its file."""
        if not self.closed:
            self._stream.close()
            if self._source._raw is not None:
                self._source._raw.close()
        super().close()
