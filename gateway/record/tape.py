"""Recording of one link on disk: rotated files, and a disk budget shared by all recordings."""

import contextlib
import os
import re
import time
from pathlib import Path
from typing import IO

_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def read_size(text: str, option: str) -> int:
    """Parse a size such as `500M` or `10G` [bytes], the value of a command line `option`.

    Raises:
        ValueError: when it is not a size.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kMGT]?)B?", text.strip())
    if match is None or float(match[1]) <= 0:
        raise ValueError(f"{option}: found {text!r}, expected a size such as 500M or 10G; correct it")
    return round(float(match[1]) * _UNITS[match[2]])


def format_size(size: float) -> str:
    """Format a size [bytes] with at most four digits."""
    for unit in ("", "k", "M", "G"):
        if size < 1000:
            return f"{size:.0f} {unit}B" if size >= 100 or not unit else f"{size:.1f} {unit}B"
        size /= 1000
    return f"{size:.1f} TB"


FILE_PATTERN = re.compile(r".+_\d{8}T\d{6}Z(-\d+)?\.tlog$")
MAX_FILE_S = 3600.0  # longest duration of one file
MAX_FILE, MIN_FILE = 256 << 20, 64 << 10  # size limit of one file [bytes]
PARTS = 4  # the size limit is at most this fraction of a link's share of the budget
RETRY_S = 2.0  # after a failure [s]


class DiskBudget:
    """Disk budget of the recordings in a folder; the oldest recordings are deleted.

    Args:
        folder: folder of the recordings, created if it does not exist
        max_bytes: recordings of earlier runs included; other files are neither counted nor deleted
    Raises:
        OSError: when the folder cannot be created or written to.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder, self.max_bytes = folder, max_bytes
        self.removed = 0  # files
        self._open: set[Path] = set()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = f"cannot be created ({error.strerror})"
            raise OSError(f"--record: {str(folder)!r} {reason}; name another folder") from None
        if not os.access(folder, os.W_OK | os.X_OK):
            raise OSError(f"--record: {str(folder)!r} is not writable; name another folder")
        recordings = [path for path in folder.iterdir() if FILE_PATTERN.match(path.name)]
        recordings.sort(key=lambda path: (path.stat().st_mtime, path.name))
        self._sizes = {path: path.stat().st_size for path in recordings}

    @property
    def used(self) -> int:
        """Return the size of the recordings [bytes]."""
        return sum(self._sizes.values())

    def update_size(self, path: Path, size: int) -> None:
        """Update the size of an open file [bytes]; delete the oldest closed files beyond the budget."""
        self._sizes[path] = size
        self._open.add(path)
        for oldest in [path for path in self._sizes if path not in self._open]:
            if self.used <= self.max_bytes:
                return
            del self._sizes[oldest]
            self.removed += 1
            with contextlib.suppress(OSError):  # deleted by another process
                oldest.unlink()

    def close_file(self, path: Path) -> None:
        """Mark a file as closed."""
        self._open.discard(path)


class TlogWriter(contextlib.AbstractContextManager):
    """Writer of the recording of one link; after a write error it later tries a new file.

    Args:
        name: name of the link
        budget: disk budget of all recordings
        links: number of links that share it
    """

    def __init__(self, name: str, budget: DiskBudget, links: int = 1) -> None:
        self.fault = ""  # error message while writing fails
        self._slug = re.sub(r"[^\w.-]+", "-", name).strip("-")
        self._budget = budget
        self._max_file = max(MIN_FILE, min(MAX_FILE, budget.max_bytes // (PARTS * links)))
        self._file: IO[bytes] | None = None
        self._path = Path()
        self._size, self._opened_t, self._retry_t = 0, 0.0, float("-inf")

    def write(self, records: bytes, now: float) -> int:
        """Write complete records and return the bytes lost; `now` is any monotonic clock [s]."""
        if not records:
            return 0
        if self._file is None and now < self._retry_t:
            return len(records)
        try:
            file, remaining = self._rotated(len(records), now), memoryview(records)
            while remaining:
                remaining = remaining[file.write(remaining) :]
        except OSError as error:
            self._fail(error, now)
            return len(records)
        self._size += len(records)
        self._budget.update_size(self._path, self._size)
        self.fault = ""
        return 0

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
        self._budget.close_file(self._path)
        self._file = None

    def __exit__(self, *_: object) -> None:
        self.close()

    def _rotated(self, added: int, now: float) -> IO[bytes]:
        """Return the file to write to: the open one, or a new one if it is full, old or closed."""
        if self._file is not None and (self._size + added > self._max_file or now - self._opened_t > MAX_FILE_S):
            self.close()
        if self._file is None:
            stem = f"{self._slug}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
            names = [f"{stem}.tlog", *(f"{stem}-{k}.tlog" for k in range(2, 1000))]
            self._path = next(candidate for name in names if not (candidate := self._budget.folder / name).exists())
            self._file, self._size, self._opened_t = self._path.open("xb", buffering=0), 0, now
        return self._file

    def _fail(self, error: OSError, now: float) -> None:
        """Truncate the file to its size before this write, delete it if empty, and pause writing."""
        self.fault = (
            f"recording of {self._slug} stopped ({error.strerror or error}), the gateway continues; "
            f"free space in {self._budget.folder} (recordings take {format_size(self._budget.used)})"
        )
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.truncate(self._size)
                if not self._size:
                    self._path.unlink()
        self.close()
        self._retry_t = now + RETRY_S
