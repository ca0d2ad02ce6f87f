"""Read the needed columns of CSV files: one file, the files of one flight in a folder, or a tar archive of them."""

import codecs
import csv
import tarfile
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from fleet.telemetry.onboard_logs.columns.column_map import ColumnMap

MAX_VALUES = 12_000_000  # maximum numbers of a recording: 96 MB
_MAX_LINE = 1 << 16  # maximum length of a line [characters]
_MAX_COLUMNS = 2000  # maximum columns of a table
_MAX_MEMBERS = 5000  # maximum members of an archive
_MAX_TEXTS = 2_000_000  # maximum cells that are kept as texts
_MAX_CELL = 40  # maximum length of such a cell
_CHUNK = 1 << 20
_TRUE = {"true": 1.0, "True": 1.0, "TRUE": 1.0, "false": 0.0, "False": 0.0, "FALSE": 0.0}

TextColumn = list[str]


class Table(NamedTuple):
    """Needed columns of a table: numbers by name, and texts of the columns that contain modes."""

    numbers: dict[str, np.ndarray]
    texts: dict[str, TextColumn]


class TextTables:
    """Reader of the tables of one recording.

    Args:
        column_map: what is read
        skipped: filled with messages on unreadable parts
    """

    def __init__(self, column_map: ColumnMap, skipped: list[str]) -> None:
        self._map, self._skipped = column_map, skipped
        self._values = self._texts = 0
        self.tables: dict[str, Table] = {}

    def read_archive(self, stream: IO[bytes]) -> None:
        """Read the members that the map names."""
        try:
            with tarfile.open(fileobj=stream, mode="r|") as archive:
                for count, member in enumerate(archive):
                    if count >= _MAX_MEMBERS:
                        self._skipped.append(f"more than {_MAX_MEMBERS} members, the rest was not read; split it")
                        break
                    for table in self._tables_of(Path(member.name).name):
                        if member.isreg() and (file := archive.extractfile(member)) is not None:
                            self._read(table, member.name, file)
        except (tarfile.TarError, EOFError, OSError, ValueError) as error:
            self._skipped.append(f"the archive is damaged ({error}); the members before are used")

    def read_files(self, stream: IO[bytes], path: Path) -> None:
        """Read one file, and the other files of its flight in the same folder."""
        own = self._tables_of(path.name)
        unnamed = [table for table, spec in self._map.tables.items() if not spec.file]
        for table in own[:1] or unnamed[:1]:
            self._read(table, path.name, stream)
        flight = self._flight_of(path.name)
        for table, spec in self._map.tables.items():
            other = path.parent / spec.file.replace("*", flight)
            if table in self.tables or not spec.file or other == path or not other.is_file():
                continue
            with other.open("rb") as file:
                self._read(table, other.name, file)

    def _tables_of(self, name: str) -> list[str]:
        return [table for table, spec in self._map.tables.items() if spec.file and _star(spec.file, name) is not None]

    def _flight_of(self, name: str) -> str:
        stars = (_star(spec.file, name) for spec in self._map.tables.values() if spec.file)
        return next((star for star in stars if star is not None), "")

    def _read(self, table: str, name: str, stream: IO[bytes]) -> None:
        if table in self.tables:
            self._skipped.append(f"{name}: a second file for the table {table!r} was skipped; name one flight")
            return
        rows = _rows(stream)
        header = next(rows, [])
        names = [cell.strip() for cell in header[:_MAX_COLUMNS]]
        needed = [column for column in names if column in self._map.needed(table)]
        if self._map.tables[table].time not in needed:
            listed, time = ", ".join(names[:6]) or "nothing", self._map.tables[table].time
            self._skipped.append(
                f"{name}: found columns {listed[:120]!r}, expected {time!r} in table {table!r}; correct the column map"
            )
            return
        self.tables[table] = self._columns(table, rows, names, needed)

    def _columns(self, table: str, rows: Iterator[list[str]], names: list[str], needed: list[str]) -> Table:
        indices = [names.index(column) for column in needed]
        modes = {entry[1] for entry in self._mode_columns() if entry[0] == table}
        numbers, texts = (
            {column: array("d") for column in needed},
            {column: list[str]() for column in needed if column in modes},
        )
        short = 0
        for row in rows:
            if self._values > MAX_VALUES or self._texts > _MAX_TEXTS:
                self._skipped.append(f"over {MAX_VALUES:,} numbers, the rest was not read; split it")
                break
            if len(row) <= max(indices):
                short += bool(row)
                continue
            for column, index in zip(needed, indices, strict=True):
                numbers[column].append(_number(row[index]))
            for column, values in texts.items():
                values.append(row[names.index(column)].strip()[:_MAX_CELL])
            self._values += len(needed)
            self._texts += len(texts)
        if short:
            self._skipped.append(f"table {table!r}: {short} incomplete lines skipped")
        return Table({column: np.frombuffer(values, float) for column, values in numbers.items()}, texts)

    def _mode_columns(self) -> Iterator[tuple[str, str]]:
        for name in ("mode", "armed"):
            if name in self._map.fields and isinstance(entry := self._map.fields[name].columns[0], tuple):
                yield entry


def _star(pattern: str, name: str) -> str | None:
    """Return what * stands for in a name; None if the name does not match."""
    before, star, after = pattern.partition("*")
    if not star:
        return "" if name == pattern else None
    fits = len(name) >= len(before) + len(after) and name.startswith(before) and name.endswith(after)
    return name[len(before) : len(name) - len(after)] if fits else None


def _rows(stream: IO[bytes]) -> Iterator[list[str]]:
    """Yield the cells of each line; too long lines are skipped. Comma, semicolon, tab or blanks separate cells."""
    split: Callable[[str], list[str]] | None = None
    for line in _lines(stream):
        if line.startswith("#") or not line.strip():
            continue
        split = split or _separator(line)
        yield split(line)


def _separator(line: str) -> Callable[[str], list[str]]:
    for character in (",", ";", "\t"):
        if character in line:
            return lambda text: next(csv.reader([text], delimiter=character), [])
    return str.split


def _lines(stream: IO[bytes]) -> Iterator[str]:
    decoder = codecs.getincrementaldecoder("utf-8-sig")("replace")
    rest, in_long_line = "", False
    while data := stream.read(_CHUNK):
        *lines, rest = (rest + decoder.decode(data)).split("\n")
        for line in lines:
            if not in_long_line and len(line) <= _MAX_LINE:
                yield line.rstrip("\r")
            in_long_line = False
        if len(rest) > _MAX_LINE:
            rest, in_long_line = "", True
    if rest and not in_long_line:
        yield rest


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return _TRUE.get(cell.strip(), float("nan"))
