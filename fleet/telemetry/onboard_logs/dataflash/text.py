"""Parse text DataFlash logs to `Records`, block by block, like the binary parser."""

from collections.abc import Callable, Iterator
from typing import IO

import numpy as np

from fleet.telemetry.onboard_logs.dataflash.binary import pieces
from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records, form

LONGEST = 4096  # of a line [bytes]
MOST_FORMATS = 512
_WORDY = "nNZ"  # columns that may contain a comma


def blocks(opener: Callable[[], IO[bytes]], damage: Damage) -> Iterator[list[Records]]:
    """Read a log from the start: the records of each MiB, with line numbers from 1."""
    reader = Lines(damage)
    with opener() as stream:
        for data in pieces(stream, damage):
            yield reader.feed(data)
    yield reader.feed(b"\n")


class Lines:
    """Split text into messages, and group messages by format."""

    def __init__(self, damage: Damage) -> None:
        self._damage = damage
        self._carry = b""
        self._endless = False  # inside a line longer than the limit
        self._line = 0
        self._formats: dict[bytes, Format] = {}
        self._found: dict[Format, tuple[list[int], list[list[bytes]]]] = {}

    def feed(self, data: bytes) -> list[Records]:
        """Parse the next bytes; return the messages they complete."""
        lines = (self._carry + data).split(b"\n")
        self._carry = lines.pop()
        for line in lines:
            self._line += 1
            if self._endless or len(line) > LONGEST:
                self._bad("lines too long")
                self._endless = False
            else:
                self._take(line)
        if len(self._carry) > LONGEST:
            self._endless, self._carry = True, b""
        found, self._found = self._found, {}
        return [Records(known, np.array(places), rows) for known, (places, rows) in found.items()]

    def _take(self, line: bytes) -> None:
        head, comma, rest = line.partition(b",")
        if not comma:
            if self._formats and line.strip():  # text before the first format is allowed
                self._bad("lines without message")
            return
        known = self._formats.get(head)
        if known is None:
            self._other(head.strip(), rest)
            return
        cells = rest.split(b",")
        n = len(known.codes)
        if len(cells) != n:
            if len(cells) < n or known.codes[-1:] not in _WORDY:
                self._bad(f"lines of {known.name} with a wrong number of columns")
                return
            cells = rest.split(b",", n - 1)
        places, rows = self._found.setdefault(known, ([], []))
        places.append(self._line)
        rows.append(cells)

    def _other(self, head: bytes, rest: bytes) -> None:
        if head == b"FMT":
            self._define(rest)
        elif self._formats:
            self._bad("lines of an unknown name")

    def _define(self, rest: bytes) -> None:
        cells = [cell.decode("ascii", "replace").strip() for cell in rest.split(b",", 4)]
        if len(cells) < 4 or len(self._formats) >= MOST_FORMATS:
            self._bad("formats that contradict themselves")
            return
        name, codes, columns = cells[2], cells[3], cells[4] if len(cells) > 4 else ""
        if name == "FMT":
            return
        new = form(name, codes, columns.strip(", "))
        if new is None:
            self._bad("formats that contradict themselves")
        else:
            self._formats[name.encode()] = new

    def _bad(self, kind: str) -> None:
        self._damage.note(kind, self._line)
