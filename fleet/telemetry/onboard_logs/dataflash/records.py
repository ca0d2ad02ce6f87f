"""Parsed content of binary and text DataFlash logs: `Records`, all messages of one format in a block."""

from typing import Any, NamedTuple

import numpy as np
from pymavlink.DFReader import FORMAT_TO_STRUCT

MAX_PLACES = 3  # positions reported for each kind of damage
MAX_DAMAGE_KINDS = 40
_INTEGER_CODES = "bBhHiIqQM"


class Format(NamedTuple):
    """One FMT: layout of the messages of a type."""

    name: str
    codes: str  # one letter per column, FORMAT_TO_STRUCT
    columns: tuple[str, ...]
    length: int  # of the message with header [bytes]
    layout: np.dtype | None  # of a binary message with header; None: text

    def divisor(self, i: int) -> float:
        """Return the divisor of the numbers of column `i`."""
        factor = FORMAT_TO_STRUCT[self.codes[i]][1]
        return 1.0 if factor is None else round(1.0 / factor)


def parse_format(name: str, codes: str, columns: str, length: int = 0) -> Format | None:
    """Parse one FMT, binary if `length` is given; return None if it is inconsistent."""
    names = tuple(column.strip() for column in columns.split(",")) if columns.strip() else ()
    if not name.isidentifier() or len(names) != len(codes) or not all(c in FORMAT_TO_STRUCT for c in codes):
        return None
    if not length:
        return Format(name, codes, names, 0, None)
    kinds = [FORMAT_TO_STRUCT[c][0] for c in codes]
    types = [f"S{kind[:-1]}" if kind.endswith("s") else f"<{kind}" for kind in kinds]
    layout = np.dtype([("", "V3"), *(("", dtype) for dtype in types)])
    return Format(name, codes, names, length, layout) if layout.itemsize == length else None


class Records:
    """Messages of one format by column: `records.Roll` is a float array for binary and text logs."""

    def __init__(self, format_: Format, place: np.ndarray, rows: Any) -> None:
        self.format_ = format_
        self.place = place  # (n,) byte offset or line number, increasing
        self.t = np.zeros(0)  # (n,) log time [s], set by `LogClock`
        self._rows = rows  # structured array, or a list of lists of bytes
        self._cache: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.place)

    def __getattr__(self, column: str) -> np.ndarray:
        if column not in self._cache:
            self._cache[column] = self._numbers(column)
        return self._cache[column]

    def has(self, *columns: str) -> bool:
        """Return whether the format has all these columns."""
        return all(column in self.format_.columns for column in columns)

    def is_integer(self, column: str) -> bool:
        """Return whether this column has an integer type."""
        return self.has(column) and self.format_.codes[self.format_.columns.index(column)] in _INTEGER_CODES

    def select(self, selection: np.ndarray) -> "Records":
        """Return a selection by mask or indices."""
        rows = self._rows[selection] if self.format_.layout is not None else _select(self._rows, selection)
        selected = Records(self.format_, self.place[selection], rows)
        selected.t = self.t[selection] if len(self.t) else self.t
        return selected

    def append(self, later: "Records") -> "Records":
        """Append later records of the same format."""
        binary = self.format_.layout is not None
        rows = np.concatenate([self._rows, later._rows]) if binary else self._rows + later._rows
        return Records(self.format_, np.concatenate([self.place, later.place]), rows)

    def texts(self, column: str) -> list[str]:
        """Return a text column, up to the first zero byte, without unprintable bytes."""
        column_index = self.format_.columns.index(column)
        cells = (
            (row[column_index] for row in self._rows)
            if self.format_.layout is None
            else self._rows[f"f{column_index + 1}"].tolist()
        )
        return [_to_text(cell) for cell in cells]

    def _numbers(self, column: str) -> np.ndarray:
        try:
            column_index = self.format_.columns.index(column)
        except ValueError:
            raise AttributeError(column) from None
        if self.format_.layout is None:
            return _floats([row[column_index] for row in self._rows])
        if self.format_.codes[column_index] in "anNZ":
            return np.full(len(self), np.nan)
        values = self._rows[f"f{column_index + 1}"].astype(float)
        scale = self.format_.divisor(column_index)
        return values if scale == 1.0 else values / scale


def _select(rows: list[Any], selection: np.ndarray) -> list[Any]:
    return [rows[i] for i in (np.flatnonzero(selection) if selection.dtype == bool else selection)]


def _to_text(cell: Any) -> str:
    raw = cell if isinstance(cell, bytes) else str(cell).encode()
    text = raw.split(b"\0")[0].decode("utf-8", "replace").strip()
    return "".join(char for char in text if char.isprintable() and char != "\ufffd")


def _floats(cells: list[bytes]) -> np.ndarray:
    try:
        return np.array(list(map(float, cells)))
    except ValueError:
        return np.array([_float(cell) for cell in cells])


def _float(cell: bytes) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


class Damage:
    """Unreadable parts by kind: first positions and total."""

    def __init__(self, unit: str) -> None:
        self.unit = unit  # byte or line
        self._kinds: dict[str, tuple[int, list[int]]] = {}

    def count(self, kind: str, place: int, n: int = 1) -> None:
        """Count `n` units of a kind of damage that begins at `place`, in bounded memory."""
        if kind not in self._kinds and len(self._kinds) >= MAX_DAMAGE_KINDS:
            kind = "other damage"
        total, places = self._kinds.get(kind, (0, []))
        self._kinds[kind] = (total + n, places if len(places) >= MAX_PLACES else [*places, int(place)])

    def messages(self) -> list[str]:
        """Return one message per kind of damage."""
        return [self._message(*entry) for entry in self._kinds.items()]

    def _message(self, kind: str, entry: tuple[int, list[int]]) -> str:
        total, places = entry
        where = ", ".join(map(str, places))
        return f"{kind}: {total}, first at {self.unit} {where}; skipped"
