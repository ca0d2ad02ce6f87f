"""Audit of all commands: lines of JSON, only appended, on the disk before a message is sent.

    {"t": 1700000000.25, "time": "2023-11-14T22:13:20.250Z", "event": "approved", "proposal": "1a2b…", "who": "kim", …}

`approved` and `undo_approved` are also the memory of which proposals were executed: it outlasts a restart.
"""

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from fleet.process.private_files import ensure_private_folder

APPROVED, UNDO_APPROVED = "approved", "undo_approved"
_MAX_LINE = 1 << 20  # longest line that is read [bytes]


class _Line(msgspec.Struct):
    event: str = ""
    proposal: str = ""


class AuditLog:
    """Append-only audit file, writable by its owner only.

    Args:
        path: of the file; its folder is created
    Raises:
        ValueError: when other users can write to the folder or the file.
        OSError: when it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        ensure_private_folder(path.absolute().parent, "--audit")
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        self.path, self._file = path, os.open(path, flags, 0o600)
        mode = os.fstat(self._file).st_mode & 0o777
        if mode & 0o022:
            self.close()
            raise ValueError(f"--audit {path}: found mode {mode:04o}, expected one writable by its owner; chmod 600")
        self.executed = self._read_executed()
        size = os.fstat(self._file).st_size
        if size and os.pread(self._file, 1, size - 1) != b"\n":
            os.write(self._file, b"\n")  # end the line that a power failure has torn

    def _read_executed(self) -> set[tuple[str, bool]]:
        """Return the proposals that were approved before, and whether for undo."""
        executed = set()
        with os.fdopen(os.dup(self._file), "rb") as file:
            file.seek(0)
            while line := file.readline(_MAX_LINE):
                try:
                    entry = msgspec.json.decode(line, type=_Line)
                except (msgspec.DecodeError, UnicodeDecodeError):
                    continue  # the last line after a power failure
                if entry.event in (APPROVED, UNDO_APPROVED):
                    executed.add((entry.proposal, entry.event == UNDO_APPROVED))
        return executed

    def write(self, now: float, entries: Sequence[dict[str, Any]]) -> None:
        """Append entries and wait until they are on the disk.

        Args:
            now: fleet time [s since 1970]
            entries: each with `event`; numbers that are not finite become null
        Raises:
            OSError: when they cannot be written; then nothing may be sent.
        """
        time = datetime.fromtimestamp(now, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        data = b"".join(msgspec.json.encode({"t": now, "time": time, **entry}) + b"\n" for entry in entries)
        while data:
            data = data[os.write(self._file, data) :]
        os.fsync(self._file)
        for entry in entries:
            if entry["event"] in (APPROVED, UNDO_APPROVED):
                self.executed.add((entry["proposal"], entry["event"] == UNDO_APPROVED))

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)
