"""Parse text DataFlash logs to `Records`, block by block, like the binary parser."""

from collections.abc import Callable, Iterator
from typing import IO

import numpy as np

from fleet.telemetry.onboard_logs.dataflash.binary import read_pieces
from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records, parse_format

MAX_LINE = 4096  # of a line [bytes]
MAX_FORMATS = 512
_TEXT_CODES = "nNZ"  # columns that may contain a comma


def read_blocks(opener: Callable[[], IO[bytes]], damage: Damage) -> Iterator[list[Records]]:
    """Read a log from the start: the records of each MiB, with line numbers from 1."""
    parser = TextParser(damage)
    with opener() as stream:
        for data in read_pieces(stream, damage):
            yield parser.feed(data)
    yield parser.feed(b"\n")


class TextParser:
    """Split text into messages, and group messages by format."""

    def __init__(self, damage: Damage) -> None:
        self._damage = damage
        self._carry = b""
        self._in_long_line = False  # inside a line longer than the limit
        self._line = 0
        self._formats: dict[bytes, Format] = {}
        self._collected: dict[Format, tuple[list[int], list[list[bytes]]]] = {}

    def feed(self, data: bytes) -> list[Records]:
        """Parse the next bytes; return the messages they complete."""
        lines = (self._carry + data).split(b"\n")
        self._carry = lines.pop()
        for line in lines:
            self._line += 1
            if self._in_long_line or len(line) > MAX_LINE:
                self._count_damage("lines too long")
                self._in_long_line = False
            else:
                self._parse_line(line)
        if len(self._carry) > MAX_LINE:
            self._in_long_line, self._carry = True, b""
        collected, self._collected = self._collected, {}
        return [Records(format_, np.array(places), rows) for format_, (places, rows) in collected.items()]

    def _parse_line(self, line: bytes) -> None:
        head, comma, rest = line.partition(b",")
        if not comma:
            if self._formats and line.strip():  # text before the first format is allowed
                self._count_damage("lines without message")
            return
        format_ = self._formats.get(head)
        if format_ is None:
            self._parse_other(head.strip(), rest)
            return
        cells = rest.split(b",")
        column_count = len(format_.codes)
        if len(cells) != column_count:
            if len(cells) < column_count or format_.codes[-1:] not in _TEXT_CODES:
                self._count_damage(f"lines of {format_.name} with a wrong number of columns")
                return
            cells = rest.split(b",", column_count - 1)
        places, rows = self._collected.setdefault(format_, ([], []))
        places.append(self._line)
        rows.append(cells)

    def _parse_other(self, head: bytes, rest: bytes) -> None:
        if head == b"FMT":
            self._declare_format(rest)
        elif self._formats:
            self._count_damage("lines of an unknown name")

    def _declare_format(self, rest: bytes) -> None:
        cells = [cell.decode("ascii", "replace").strip() for cell in rest.split(b",", 4)]
        if len(cells) < 4 or len(self._formats) >= MAX_FORMATS:
            self._count_damage("formats that contradict themselves")
            return
        name, codes, columns = cells[2], cells[3], cells[4] if len(cells) > 4 else ""
        if name == "FMT":
            return
        new_format = parse_format(name, codes, columns.strip(", "))
        if new_format is None:
            self._count_damage("formats that contradict themselves")
        else:
            self._formats[name.encode()] = new_format

    def _count_damage(self, kind: str) -> None:
        self._damage.count(kind, self._line)
